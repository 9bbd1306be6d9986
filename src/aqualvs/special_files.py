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
    path: Path, error: type[AqualvsError] = SourceError, remedy: str = "give a file or a folder"
) -> None:
    """Refuse a path of a pipe, device or socket; accept files, folders and free paths.

    Raises `AqualvsError` of type `error`, if there is a pipe, a device or a socket.
    """
    try:
        kind = _KINDS.get(stat.S_IFMT(path.stat().st_mode))
    except (OSError, ValueError):
        # Opening the path will report the fault.
        return
    if kind is not None:
        raise error(f"{path}: is {kind}; {remedy}")
