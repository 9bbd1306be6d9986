"""Writing of files: append and replace without torn results, one-line errors, and overwriting.

`AppendFile` appends a piece entirely or not at all. Errors of the operating system become one line
that names the remedy (`writing`, `explain`).

`Claim` is the one rule for overwriting: commands replace only files that they wrote themselves, and
only when asked. Every folder notes in `.aqualvs.json` which command wrote which of its files, and
the size and checksum that the file had. A file that is not noted there, or has changed since,
belongs to the user: no option replaces it. Rig files follow a rule of their own: `save_rig` keeps a
dated copy.
"""

import contextlib
import errno
import json
import math
import os
import uuid
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from aqualvs.closing import Closing
from aqualvs.errors import OutputError
from aqualvs.yamlfile import read_text

try:
    import fcntl
except ImportError:  # Windows locks open files anyway.
    fcntl = None  # type: ignore[assignment]


class AppendFile:
    """Write pieces to a file, each handed to the system at once.

    What has been appended survives the death of the process, though not a loss of power. A piece
    that does not fit on the disk is taken back. The file is created or, unless `exclusive`,
    overwritten. The constructor and `append` raise `OSError` as the system says it.
    """

    def __init__(self, path: Path, *, exclusive: bool = False) -> None:
        self._file = path.open("xb" if exclusive else "wb", buffering=0)
        self._n_bytes = 0

    def append(self, piece: bytes | memoryview) -> None:
        """Write one piece."""
        rest = memoryview(piece)
        try:
            while len(rest):
                # A disk that fills up takes a part; the next attempt raises the reason.
                rest = rest[self._file.write(rest) :]
        except OSError:
            # What was written of the piece is taken back.
            if os.fstat(self._file.fileno()).st_size > self._n_bytes:
                self._file.truncate(self._n_bytes)
            raise
        self._n_bytes += len(piece)

    def lock(self) -> None:
        """Mark the file as being written until it is closed, also by the death of the process."""
        if fcntl is not None:
            fcntl.flock(self._file.fileno(), fcntl.LOCK_EX)

    def close(self) -> None:
        """Close the file; further calls do nothing."""
        self._file.close()


@contextlib.contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Let one process at a time in; where folders cannot be locked, all."""
    number = None
    try:
        if fcntl is not None:
            with contextlib.suppress(OSError):
                number = os.open(folder, os.O_RDONLY)
                fcntl.flock(number, fcntl.LOCK_EX)
        yield
    finally:
        if number is not None:
            os.close(number)


def is_locked(path: Path) -> bool:
    """Return whether a process holds the lock of `AppendFile.lock` on a file."""
    if fcntl is None or not path.exists():
        return False
    with path.open("rb") as file:
        try:
            fcntl.flock(file.fileno(), fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_REMEDIES = dict.fromkeys(
    (errno.EACCES, errno.EPERM, errno.EROFS), "choose a folder that you may write to"
) | {
    errno.ENOTDIR: "a part of this path is a file; choose another folder",
    errno.EEXIST: "this path is a file; choose another folder",
    errno.EISDIR: "this path is a folder; choose another name",
    errno.ENAMETOOLONG: "choose a shorter name",
}


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn any `OSError` while writing to `path` into an `OutputError` of one line."""
    try:
        yield
    except OSError as fault:
        raise OutputError(explain(path, fault)) from fault


def replace_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all: the old one stays until the new one is complete.

    Raises `OSError` as the system says it.
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

    Raises `OSError` as the system says it, `ValueError` if it is no JSON in UTF-8, or nested too
    deeply.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except RecursionError as fault:
        raise ValueError("nested too deeply") from fault


def without_nan(value: Any) -> Any:
    """Return the same with null in place of NaN, which JSON does not have."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def explain(path: Path, fault: OSError) -> str:
    """Return the fault of `path` and its remedy."""
    if fault.errno in _FULL:
        return (
            f"{path}: the disk is full ({fault.strerror}); what was written stays readable, "
            "free some space and run again"
        )
    remedy = _REMEDIES.get(fault.errno or 0, "check the path and the disk")
    return f"{path}: cannot be written ({fault.strerror or fault}); {remedy}"


RECORD = ".aqualvs.json"
"""File of a folder that records which command wrote its files."""

_WRITER, _MARK = "writer", "mark"


class Claim(Closing):
    """Files that a command is about to write; a context manager that notes their checksums.

    A command that is killed leaves its files noted without a checksum: they stay its own.

    Parameters
    ----------
    writer : str
        Command, as messages and records name it. Commands that write the same files share one.
    paths : sequence of Path
        Files, or folders that are the command's as a whole.
    known : sequence of Path
        Files of one folder that the caller knows for the command's own, to be noted as such where
        the folder has no record at all: that of an earlier version, or a copy without its hidden
        files.

    Raises `OutputError` if one of the files exists and may not be replaced, or the folder cannot be
    written.
    """

    def __init__(
        self, writer: str, paths: Sequence[Path], *, overwrite: bool, known: Sequence[Path] = ()
    ) -> None:
        self._writer = writer
        self._adopt([path for path in known if os.path.lexists(path)])
        self._names: dict[Path, list[str]] = {}
        for path in paths:
            self._names.setdefault(path.parent, []).append(path.name)
        self.found = [path for path in paths if os.path.lexists(path)]
        for path in self.found:
            self._check(path, overwrite=overwrite)
        for folder, names in self._names.items():
            with writing(folder):
                folder.mkdir(parents=True, exist_ok=True)
                _update_record(folder, {name: {_WRITER: writer, _MARK: None} for name in names})

    def close(self) -> None:
        """Note size and checksum of the files; call it when they are complete."""
        for folder, names in self._names.items():
            written = {
                name: {_WRITER: self._writer, _MARK: _fingerprint(folder / name)}
                if os.path.lexists(folder / name)
                else None
                for name in names
            }
            # The files matter more than the note; without it they stay noted as incomplete.
            with contextlib.suppress(OSError):
                _update_record(folder, written)

    def _adopt(self, known: Sequence[Path]) -> None:
        if known and not os.path.lexists(known[0].parent / RECORD):
            with writing(known[0].parent):
                entries = {
                    path.name: {_WRITER: self._writer, _MARK: _fingerprint(path)} for path in known
                }
                _update_record(known[0].parent, entries)

    def _check(self, path: Path, *, overwrite: bool) -> None:
        noted = _read_record(path.parent).get(path.name)
        remedy = "move it away, or choose another place with -o"
        if not isinstance(noted, dict) or noted.get(_WRITER) != self._writer:
            raise OutputError(
                f"{path}: exists, and 'aqualvs {self._writer}' did not write it; {remedy}"
            )
        if noted.get(_MARK) not in (None, _fingerprint(path)):
            raise OutputError(
                f"{path}: has changed since 'aqualvs {self._writer}' wrote it; {remedy}"
            )
        if not overwrite:
            raise OutputError(f"{path}: exists; choose another place with -o, or add --overwrite")


def _read_record(folder: Path) -> dict[str, Any]:
    """Return the record of a folder; empty where there is none that can be read."""
    try:
        content = json.loads(read_text(folder / RECORD, "a record", OutputError))
    except (OutputError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _update_record(folder: Path, entries: Mapping[str, dict[str, Any] | None]) -> None:
    """Write entries into the record of a folder; those of None are taken out."""
    merged = {**_read_record(folder), **entries}
    content = {name: one for name, one in merged.items() if one is not None}
    replace_text(folder / RECORD, json.dumps(content, indent=1, sort_keys=True))


def _fingerprint(path: Path) -> list[int] | None:
    """Return size and checksum of a file's two ends; None for a folder or an unreadable file."""
    # A video has gigabytes: its beginning and end, with the size, identify it.
    ends = 1 << 16
    try:
        if not path.is_file():
            return None
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
            checksum = zlib.crc32(file.read(ends))
            file.seek(max(0, size - ends))
            return [size, zlib.crc32(file.read(ends), checksum)]
    except OSError:
        return None
