"""Dated copies of files that are about to be replaced: `rig.2026-11-23T141503.yaml`, in UTC."""

import os
import re
from datetime import UTC, datetime
from pathlib import Path

from aqualvs.errors import OutputError

_STAMP = re.compile(r"\.(\d{4}-\d\d-\d\dT\d{6})(?:-(\d+))?")


def keep_dated(path: Path, now: datetime | None = None) -> Path:
    """Copy a file beside itself, under a name with the time that no other file has.

    Parameters
    ----------
    path : Path
    now : datetime, optional
        With a time zone; the current time if left out.

    Returns
    -------
    copy : Path

    Raises
    ------
    OutputError
        If it cannot be copied.
    """
    stamp = (now or datetime.now(UTC)).astimezone(UTC).strftime("%Y-%m-%dT%H%M%S")
    number = 1
    while True:
        again = f"-{number}" if number > 1 else ""
        copy = path.with_name(f"{path.stem}.{stamp}{again}{path.suffix}")
        number += 1
        try:
            content = path.read_bytes()
            file = copy.open("xb")
        except FileExistsError:
            continue
        except OSError as fault:
            raise _uncopied(path, fault) from fault
        try:
            with file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        except OSError as fault:
            copy.unlink(missing_ok=True)
            raise _uncopied(path, fault) from fault
        return copy


def dated_copies(path: Path) -> list[Path]:
    """Return the dated copies of a file, the newest first."""
    found = []
    for copy in path.parent.glob("*"):
        middle = copy.name.removeprefix(path.stem).removesuffix(path.suffix)
        stamp = _STAMP.fullmatch(middle)
        if stamp is not None and copy.name == f"{path.stem}{middle}{path.suffix}":
            found.append((stamp[1], int(stamp[2] or 1), copy))
    return [copy for _, _, copy in sorted(found, reverse=True)]


def _uncopied(path: Path, fault: OSError) -> OutputError:
    return OutputError(
        f"{path}: cannot be kept as a dated copy ({fault.strerror}), so it is not replaced; free "
        "the disk or choose another place"
    )
