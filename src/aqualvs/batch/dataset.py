"""Parquet data set of a batch, one partition a dive in folders `dive=NAME`, and sealed folders.

::

    dataset/posture/dive=NAME/posture.parquet   one row for every frame
    dataset/points/dive=NAME/points.parquet     one row for every stripe point
    dataset/net/dive=NAME/net.parquet           one row for every stretch of net, if evaluated
    dataset/holes/dive=NAME/holes.parquet       one row for every hole in it, if evaluated
    dataset/dives.parquet                       one row for every dive

A folder of finished work is complete or absent: it is filled as a draft, then renamed, and its seal
records the checksums of its files, so that a later batch can reuse it.
"""

import contextlib
import json
import os
import shutil
import uuid
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import csv, parquet

from aqualvs.results.files import read_json, replace_text
from aqualvs.results.folder import HOLES_CSV, NET_CSV, POINTS_PARQUET, POSTURE_CSV

MANIFEST = "done.json"
"""Written last; says for what the content of a folder was made, and what it is."""


def write_manifest(
    folder: Path,
    key: str,
    facts: Mapping[str, Any],
    names: Sequence[str],
    place: Path | None = None,
) -> None:
    """Declare the files `names` finished, which are in `place`, or else in `folder`.

    `key` says what they were made from. `facts`, ready for JSON, are kept with the checksums of the
    files, which are read for them. Raises `OSError` as the system says it.
    """
    files = {name: _fingerprint((place or folder) / name) for name in names}
    content = {"key": key, "files": files, "facts": dict(facts)}
    replace_text(folder / MANIFEST, json.dumps(content))


def read_valid_manifest(folder: Path, key: str, place: Path | None = None) -> dict[str, Any] | None:
    """Return the facts of finished work, None unless it is there, made for `key`, and intact.

    `folder` has the seal; `key` and `place` are as in `write_manifest`.
    """
    content = read_manifest(folder)
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


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """Return the content of a seal, None if it is missing or unreadable."""
    try:
        content = read_json(folder / MANIFEST)
    except (OSError, ValueError):
        return None
    whole = isinstance(content, dict) and {"key", "files", "facts"} <= set(content)
    return content if whole else None


@contextlib.contextmanager
def drafted(folder: Path) -> Iterator[Path]:
    """Yield a folder to fill, which becomes `folder` at the end; nothing is left after a fault.

    Two processes may fill the same folder at a time, as when one of them was taken for dead: the
    first to finish wins, and the other's work is dropped.

    Raises `OSError` as the system says it.
    """
    with scratch(folder.parent, folder.name) as draft:
        yield draft
        _publish(draft, folder)


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
        ours = read_manifest(draft)
        if ours is not None and read_valid_manifest(folder, ours["key"]) is not None:
            return
        clear(folder)
        os.rename(draft, folder)


def _fingerprint(path: Path) -> list[int]:
    """Return size and CRC-32 of a file."""
    size, checksum = 0, 0
    block_bytes = 1 << 20
    with path.open("rb") as file:
        while block := file.read(block_bytes):
            size += len(block)
            checksum = zlib.crc32(block, checksum)
    return [size, checksum]


DIVES_PARQUET = "dives.parquet"

_COUNTS = (
    *("frame", "n_points", "first_frame", "last_frame", "n_frames", "picture_frame"),
    *("stretch", "piece", "hole", "n_looks"),
)
# Of columns in CSV files; all others hold numbers.
_TYPES = dict.fromkeys(_COUNTS, pa.int32()) | {
    **dict.fromkeys(("reason", "mesh", "placed_by", "field"), pa.string()),
    "valid": pa.bool_(),
}
# Columns that only some dives have, and nulls in the others: readers expect one schema.
_OF_SOME = {POSTURE_CSV: ("field",)}
OF_DIVE, OF_NET = (POSTURE_CSV, POINTS_PARQUET), (NET_CSV, HOLES_CSV)
"""Files of a run that are tables of the data set: of its dive, and of its net."""
NET_FACTS = ("area_m2", "bar_mm", "twine_mm", "solidity", "fouling", "largest_hole_mm")
"""Numbers of a net's condition that are columns of `dives.parquet`, behind `net_`."""
DIVES_SCHEMA = pa.schema(
    [
        *((name, pa.string()) for name in ("dive", "source", "rig", "rig_file", "state", "words")),
        *((name, pa.int64()) for name in ("n_frames", "n_valid")),
        *(
            (name, pa.float64())
            for name in ("duration_s", "range_median_m", "range_min_m", "range_max_m", "n_water")
        ),
        ("lasers", pa.string()),
        ("net_holes", pa.int64()),
        *((f"net_{name}", pa.float64()) for name in NET_FACTS),
    ]
)
"""Columns of `dives.parquet`; `state` is finished, incomplete or failed, `words` says why.

Those of the net are null where its state was not told."""


def put_dive(dataset: Path, name: str, run_folder: Path) -> None:
    """Put a run's posture and points into the data set, in place of what is there of this dive.

    The points are not stored twice where the file system can give one file two names.

    Raises `OSError` as the system says it.
    """
    _put_table(dataset, name, run_folder / POSTURE_CSV, null_words=False)
    with _replacing(_partition(dataset, name, POINTS_PARQUET)) as draft:
        try:
            os.link(run_folder / POINTS_PARQUET, draft)
        except OSError:
            shutil.copyfile(run_folder / POINTS_PARQUET, draft)


def put_net(dataset: Path, name: str, folder: Path) -> None:
    """Put the state of a dive's net into the data set, in place of what is there of this dive.

    `folder` holds `net.csv` and `holes.csv`. Raises `OSError` as the system says it.
    """
    for table in OF_NET:
        _put_table(dataset, name, folder / table, null_words=True)


def write_dives(dataset: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write `dives.parquet`.

    `rows`: with the columns of `DIVES_SCHEMA`; absent ones are null. Raises `OSError` as the system
    says it.
    """
    table = pa.Table.from_pylist([dict(row) for row in rows], schema=DIVES_SCHEMA)
    with _replacing(dataset / DIVES_PARQUET) as draft:
        parquet.write_table(table, draft, compression="zstd")


def _put_table(dataset: Path, name: str, path: Path, *, null_words: bool) -> None:
    """Put a CSV file into the data set; numbers that are not there are null, words if wanted."""
    with path.open(encoding="utf-8") as file:
        columns = file.readline().rstrip("\n").split(",")
    columns += [column for column in _OF_SOME.get(path.name, ()) if column not in columns]
    convert = csv.ConvertOptions(
        column_types={column: _TYPES.get(column, pa.float64()) for column in columns},
        include_columns=columns,
        include_missing_columns=True,
        null_values=[""],
        strings_can_be_null=null_words,
        true_values=["1"],
        false_values=["0"],
    )
    # One thread: the process has one core to itself.
    read = csv.ReadOptions(use_threads=False)
    with _replacing(_partition(dataset, name, path.name)) as draft:
        table = csv.read_csv(path, read_options=read, convert_options=convert)
        parquet.write_table(table, draft, compression="zstd")


def holds(dataset: Path, name: str, tables: Iterable[str]) -> bool:
    """Return whether all these partitions of a dive are there."""
    return all(_partition(dataset, name, table).is_file() for table in tables)


def drop(dataset: Path, name: str, tables: Iterable[str]) -> None:
    """Remove these partitions of a dive, if they are there."""
    for table in tables:
        clear(_partition(dataset, name, table).parent)


def _partition(dataset: Path, name: str, table: str) -> Path:
    """Return where a dive's part of a table is, which is called after a file of its run."""
    stem = Path(table).stem
    return dataset / stem / f"dive={name}" / f"{stem}.parquet"


@contextlib.contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """Yield the path of a draft that takes the place of a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # Readers of data sets pass over what begins with an underscore.
    draft = path.with_name(f"_{path.stem}.{uuid.uuid4().hex[:8]}.part")
    try:
        yield draft
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)
