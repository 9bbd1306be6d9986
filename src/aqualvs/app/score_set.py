"""A benchmark set on disk: what its dives are, and the truth of their frames."""

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aqualvs.errors import SourceError
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.special_files import refuse_special
from aqualvs.yamlfile import read_yaml

SET_FILE = "benchmark.yaml"
TRUTH_FILE = "truth.csv"
TARGET_FILE = "target.yaml"

_VERSION_KEY = "aqualvs_benchmark"
_COLUMNS = ("frame", "range_m", "pitch_deg", "yaw_deg", "n_visible")


@dataclass(frozen=True, slots=True)
class DiveTruth:
    """Truth of one dive, N frames.

    Attributes
    ----------
    name, level : str
    frames : int array, shape (N,)
        Numbers from 0.
    posture : array, shape (N, 3)
        Range (m), pitch and yaw (deg); NaN where there is no target.
    n_visible : int array, shape (N,)
        Stripe points on the target that the picture truly shows.
    """

    name: str
    level: str
    frames: IntArray
    posture: FloatArray
    n_visible: IntArray


@dataclass(frozen=True, slots=True)
class BenchmarkSet:
    """A set of dives with truth.

    Attributes
    ----------
    name, checksum : str
        Of the set's definition.
    whole : bool
        False for a part of the set, or one in fewer frames: its scores stand for themselves.
    folder : Path
    dives : tuple of DiveTruth
    """

    name: str
    checksum: str
    whole: bool
    folder: Path
    dives: tuple[DiveTruth, ...]

    @property
    def title(self) -> str:
        """What scores say they were made with."""
        frames = sum(len(dive.frames) for dive in self.dives)
        part = "" if self.whole else ", a PART of the set: not to be compared with the whole"
        size = f"{len(self.dives)} dives, {frames} frames"
        return f"{self.name} (checksum {self.checksum}): {size}{part}"

    @property
    def levels(self) -> list[str]:
        """Levels in the order of the dives."""
        return list(dict.fromkeys(dive.level for dive in self.dives))


def load_set(folder: Path) -> BenchmarkSet:
    """Read a set that `aqualvs benchmark` wrote.

    Raises
    ------
    SourceError
        If the folder holds none, or a file of it cannot be read.
    """
    path = folder / SET_FILE
    content = _read_yaml(path)
    try:
        name, checksum = str(content["name"]), str(content["checksum"])
        whole = bool(content["whole"])
        levels = {str(dive): str(facts["level"]) for dive, facts in content["dives"].items()}
    except (KeyError, TypeError, AttributeError) as fault:
        raise SourceError(f"{path}: {fault} is missing; make the set again") from fault
    dives = tuple(
        read_dive(folder / dive / TRUTH_FILE, dive, level) for dive, level in levels.items()
    )
    if not dives:
        raise SourceError(f"{path}: names no dive; make the set again")
    return BenchmarkSet(name, checksum, whole, folder, dives)


def read_dive(path: Path, name: str, level: str) -> DiveTruth:
    """Read the truth of one dive.

    Raises
    ------
    SourceError
        If the file cannot be read, lacks a column, or holds what is no number.
    """
    rows = read_rows(path, _COLUMNS)
    cells = [[cell(path, i, row, column) for column in _COLUMNS] for i, row in enumerate(rows)]
    table = np.array(cells, dtype=np.float64)
    if not np.isfinite(table[:, [0, 4]]).all():
        raise SourceError(f"{path}: a row lacks its frame or n_visible; make the set again")
    return DiveTruth(
        name, level, table[:, 0].astype(np.int64), table[:, 1:4], table[:, 4].astype(np.int64)
    )


def read_rows(path: Path, needed: tuple[str, ...]) -> list[dict[str, str | None]]:
    """Return the rows of a CSV file with a header, its names without space around them.

    Raises
    ------
    SourceError
        If it cannot be read, holds no row, or lacks a column.
    """
    refuse_special(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            table = csv.DictReader(file)
            table.fieldnames = [name.strip() for name in table.fieldnames or ()]
            rows = list(table)
    except OSError as fault:
        raise SourceError(f"{path}: cannot be read ({fault.strerror}); check the path") from fault
    except (UnicodeDecodeError, csv.Error) as fault:
        raise SourceError(f"{path}: not a CSV file in UTF-8; save it as one") from fault
    for name in needed:
        if name not in table.fieldnames:
            have = ", ".join(table.fieldnames) or "none"
            raise SourceError(
                f"{path}: no column {name} (its first line names {have}); name the columns "
                f"{','.join(needed)}"
            )
    if not rows:
        raise SourceError(f"{path}: holds no rows; write one for every frame")
    return rows


def cell(path: Path, i_row: int, row: dict[str, str | None], column: str) -> float:
    """Return the number in a cell; NaN where it is empty.

    Raises
    ------
    SourceError
        If it holds something else.
    """
    text = (row.get(column) or "").strip()
    try:
        return float(text) if text else math.nan
    except ValueError:
        raise SourceError(
            f"{path}: line {i_row + 2}: {column} is {text!r}; write a number or leave it empty"
        ) from None


def _read_yaml(path: Path) -> dict[str, Any]:
    content = read_yaml(path, "a set that 'aqualvs benchmark -o DIR' wrote", SourceError)
    if not isinstance(content, dict) or content.get(_VERSION_KEY) != 1:
        raise SourceError(f"{path}: not a benchmark set of version 1; make the set again")
    return content
