"""What goes wrong with files and folders, in one line that names the remedy."""

import contextlib
import errno
import json
import os
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from aqualvs.errors import OutputError

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_REMEDIES = {
    errno.EACCES: "choose a folder that you may write to",
    errno.EPERM: "choose a folder that you may write to",
    errno.EROFS: "choose a folder that you may write to",
    errno.ENOTDIR: "a part of this path is a file; choose another folder",
    errno.EEXIST: "this path is a file; choose another folder",
    errno.EISDIR: "this path is a folder; choose another name",
    errno.ENAMETOOLONG: "choose a shorter name",
}


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn a fault of the operating system while writing to `path` into one line.

    Raises
    ------
    OutputError
        In place of any `OSError`.
    """
    try:
        yield
    except OSError as fault:
        raise OutputError(explain(path, fault)) from fault


def replace_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all: the old one stays until the new one is complete.

    Raises
    ------
    OSError
        As the system says it.
    """
    # A name of its own: two processes may write the same file at the same moment.
    draft = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}.part")
    try:
        draft.write_text(text, encoding="utf-8")
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)


def read_json(path: Path) -> Any:
    """Return the content of a JSON file.

    Raises
    ------
    OSError
        As the system says it.
    ValueError
        If it is no JSON in UTF-8, or nested too deeply.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except RecursionError as fault:
        raise ValueError("nested too deeply") from fault


def explain(path: Path, fault: OSError) -> str:
    """Return what is wrong with `path` and what to do about it."""
    if fault.errno in _FULL:
        return (
            f"{path}: the disk is full ({fault.strerror}); what was written stays readable, "
            "free some space and run again"
        )
    remedy = _REMEDIES.get(fault.errno or 0, "check the path and the disk")
    return f"{path}: cannot be written ({fault.strerror or fault}); {remedy}"
