"""Refusal of special files: pipes, devices and sockets, which may block or never end."""

import stat
from pathlib import Path

from aqualvs.errors import AqualvsError, SourceError

_KINDS = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


def refuse_special(
    path: Path,
    error: type[AqualvsError] = SourceError,
    remedy: str = "give a file or a folder",
) -> None:
    """Refuse a path at which there is neither a file nor a folder; one that is free is fine.

    Raises
    ------
    AqualvsError
        Of type `error`, if there is a pipe, a device or a socket.
    """
    try:
        kind = _KINDS.get(stat.S_IFMT(path.stat().st_mode))
    except (OSError, ValueError):
        # Whoever opens the path says what is wrong with it.
        return
    if kind is not None:
        raise error(f"{path}: is {kind}; {remedy}")
