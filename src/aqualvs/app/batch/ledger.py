"""Folders that are whole or not there: finished work with its checksums, kept for the next time."""

import contextlib
import json
import os
import shutil
import uuid
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from aqualvs.app.disk import read_json

SEAL = "done.json"
"""Written last; says for what the content of a folder was made, and what it is."""

_BLOCK = 1 << 20


def seal(
    folder: Path,
    key: str,
    facts: Mapping[str, Any],
    names: Sequence[str],
    place: Path | None = None,
) -> None:
    """Declare files in a folder finished.

    Parameters
    ----------
    folder : Path
    key : str
        What the files were made from.
    facts : mapping
        To be had back; ready for JSON.
    names : sequence of str
        The files, which are read for their checksums.
    place : Path or None
        Where the files are, if not in `folder`.

    Raises
    ------
    OSError
        As the system says it.
    """
    files = {name: _fingerprint((place or folder) / name) for name in names}
    content = {"key": key, "files": files, "facts": dict(facts)}
    draft = folder / f"{SEAL}.{uuid.uuid4().hex[:8]}.part"
    draft.write_text(json.dumps(content), encoding="utf-8")
    os.replace(draft, folder / SEAL)


def sealed(folder: Path, key: str, place: Path | None = None) -> dict[str, Any] | None:
    """Return the facts of finished work, None unless it is there, made for `key`, and intact.

    Parameters
    ----------
    folder : Path
        With the seal.
    key : str
        As in `seal`.
    place : Path or None
        Where the files are, if not in `folder`.
    """
    content = read_seal(folder)
    if content is None or content["key"] != key:
        return None
    try:
        for name, fingerprint in content["files"].items():
            if _fingerprint((place or folder) / name) != fingerprint:
                return None
    except OSError:
        return None
    facts: dict[str, Any] = content["facts"]
    return facts


def read_seal(folder: Path) -> dict[str, Any] | None:
    """Return the content of a seal, None where there is none that can be read."""
    try:
        content = read_json(folder / SEAL)
    except (OSError, ValueError):
        return None
    whole = isinstance(content, dict) and {"key", "files", "facts"} <= set(content)
    return content if whole else None


@contextlib.contextmanager
def drafted(folder: Path) -> Iterator[Path]:
    """Yield a folder to fill, which becomes `folder` at the end; nothing is left after a fault.

    Two processes may fill the same folder at a time, as when one of them was taken for dead: the
    first to finish wins, and the other's work is dropped.

    Raises
    ------
    OSError
        As the system says it.
    """
    draft = folder.with_name(f"{folder.name}.{uuid.uuid4().hex[:8]}.part")
    draft.mkdir(parents=True)
    try:
        yield draft
        _publish(draft, folder)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


@contextlib.contextmanager
def scratch(home: Path, name: str) -> Iterator[Path]:
    """Yield a new folder below another, which is gone at the end."""
    folder = home / f"{name}-{uuid.uuid4().hex[:8]}.part"
    folder.mkdir(parents=True)
    try:
        yield folder
    finally:
        clear(folder)


def clear(folder: Path) -> None:
    """Remove a folder and all that is in it, if it is there."""
    shutil.rmtree(folder, ignore_errors=True)


def _publish(draft: Path, folder: Path) -> None:
    try:
        os.rename(draft, folder)
    except OSError:
        seal_ours, seal_theirs = read_seal(draft), read_seal(folder)
        if (
            seal_ours is not None
            and seal_theirs is not None
            and (sealed(folder, seal_ours["key"]) is not None)
        ):
            return
        clear(folder)
        os.rename(draft, folder)


def _fingerprint(path: Path) -> list[int]:
    """Return size and CRC-32 of a file."""
    size, checksum = 0, 0
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            size += len(block)
            checksum = zlib.crc32(block, checksum)
    return [size, checksum]
