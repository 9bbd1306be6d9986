"""The one rule for what commands replace: what they wrote themselves, and only when asked.

Every folder notes in `.aqualvs.json` which command wrote which of its files, and the size and
checksum that the file had. A file that is not noted there, or has changed since, belongs to the
user: no option replaces it. Rig files follow a rule of their own: `save_rig` keeps a dated copy.
"""

import contextlib
import json
import os
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from aqualvs.app.disk import replace_text, writing
from aqualvs.closing import Closing
from aqualvs.errors import OutputError
from aqualvs.yamlfile import read_text

RECORD = ".aqualvs.json"
"""File in which a folder notes who wrote its files."""

_WRITER, _MARK = "writer", "mark"
# A video has gigabytes: its beginning and end, with the size, tell it from another.
_ENDS = 1 << 16


class Claim(Closing):
    """Files that a command is about to write; a context manager that notes what they became.

    A command that is killed leaves its files noted without a checksum: they stay its own.

    Parameters
    ----------
    writer : str
        Command, as messages and records name it. Commands that write the same files share one.
    paths : sequence of Path
        Files, or folders that are the command's as a whole.
    overwrite : bool
        Whether to replace what the same command wrote.
    known : sequence of Path
        Files of one folder that the caller knows for the command's own, to be noted as such where
        the folder has no record at all: that of an earlier version, or a copy without its hidden
        files.

    Raises
    ------
    OutputError
        If one of the files exists and may not be replaced, or the folder cannot be written.
    """

    def __init__(
        self,
        writer: str,
        paths: Sequence[Path],
        *,
        overwrite: bool,
        known: Sequence[Path] = (),
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
                _note(folder, {name: {_WRITER: writer, _MARK: None} for name in names})

    def close(self) -> None:
        """Note what the files are now; call it when they are complete."""
        for folder, names in self._names.items():
            written = {
                name: {_WRITER: self._writer, _MARK: _mark(folder / name)}
                if os.path.lexists(folder / name)
                else None
                for name in names
            }
            # The files are more worth than the note; without it they stay noted as begun.
            with contextlib.suppress(OSError):
                _note(folder, written)

    def _adopt(self, known: Sequence[Path]) -> None:
        if known and not os.path.lexists(known[0].parent / RECORD):
            with writing(known[0].parent):
                entries = {path.name: {_WRITER: self._writer, _MARK: _mark(path)} for path in known}
                _note(known[0].parent, entries)

    def _check(self, path: Path, *, overwrite: bool) -> None:
        noted = _noted(path.parent).get(path.name)
        if not isinstance(noted, dict) or noted.get(_WRITER) != self._writer:
            raise OutputError(
                f"{path}: exists, and 'aqualvs {self._writer}' did not write it; move it away, or "
                "choose another place with -o"
            )
        mark = noted.get(_MARK)
        if mark is not None and mark != _mark(path):
            raise OutputError(
                f"{path}: has changed since 'aqualvs {self._writer}' wrote it; move it away, or "
                "choose another place with -o"
            )
        if not overwrite:
            raise OutputError(f"{path}: exists; choose another place with -o, or add --overwrite")


def _noted(folder: Path) -> dict[str, Any]:
    """Return the record of a folder; empty where there is none that can be read."""
    try:
        content = json.loads(read_text(folder / RECORD, "a record", OutputError))
    except (OutputError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _note(folder: Path, entries: Mapping[str, dict[str, Any] | None]) -> None:
    """Write entries into the record of a folder; those of None are taken out."""
    merged = {**_noted(folder), **entries}
    content = {name: one for name, one in merged.items() if one is not None}
    replace_text(folder / RECORD, json.dumps(content, indent=1, sort_keys=True))


def _mark(path: Path) -> list[int] | None:
    """Return size and checksum of a file's two ends; None for a folder or what cannot be read."""
    try:
        if not path.is_file():
            return None
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
            checksum = zlib.crc32(file.read(_ENDS))
            file.seek(max(0, size - _ENDS))
            return [size, zlib.crc32(file.read(_ENDS), checksum)]
    except OSError:
        return None
