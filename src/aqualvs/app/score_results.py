"""What a system answered: plain CSV, frame by frame."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aqualvs.app.score_set import BenchmarkSet, DiveTruth, cell, read_rows
from aqualvs.errors import OptionError, SourceError
from aqualvs.geometry.arrays import BoolArray, FloatArray

_ANSWER = ("pitch_deg", "yaw_deg")
_SIGMAS = ("sigma_pitch_deg", "sigma_yaw_deg")
# What our own runs claim in all, next to what a frame's noise makes of it.
_TOTALS = ("sigma_range_total_m", "sigma_pitch_total_deg", "sigma_yaw_total_deg")
# Names and units of the range, and of its sigma.
_RANGES = {"range_m": 1.0, "range_mm": 1e-3}
_YES, _NO = {"1", "true", "yes"}, {"0", "false", "no"}
_RUN_FILE = "posture.csv"

Row = dict[str, str | None]


@dataclass(frozen=True, slots=True)
class Answers:
    """Answers of a system to the N frames of one dive, in the order of the truth.

    Attributes
    ----------
    valid : bool array, shape (N,)
    posture : array, shape (N, 3)
        Range (m), pitch and yaw (deg); NaN where a frame has none.
    sigma : array, shape (N, 3)
        Standard deviations that the system claims, same units; NaN where it claims none.
    """

    valid: BoolArray
    posture: FloatArray
    sigma: FloatArray


@dataclass(frozen=True, slots=True)
class System:
    """A system under test.

    Attributes
    ----------
    name : str
    answers : dict of str to Answers
        By dive; every dive of the set is there.
    missing : tuple of str
        Dives for which it brought no file; it has no valid answer in them.
    """

    name: str
    answers: dict[str, Answers]
    missing: tuple[str, ...]


def read_system(argument: str, benchmark: BenchmarkSet) -> System:
    """Read the results of a system.

    Parameters
    ----------
    argument : str
        NAME=PATH, or a path, which is then called as its last part. The path is a folder with
        DIVE.csv or DIVE/posture.csv for every dive, or one CSV with a column `dive`.
    benchmark : BenchmarkSet
        The set whose dives they are.

    Raises
    ------
    SourceError
        If a file cannot be read or makes no sense.
    OptionError
        If there is nothing for any dive.
    """
    given, equals, rest = argument.partition("=")
    path = Path(rest if equals else argument)
    name = given if equals else path.stem
    if not name or not path.exists():
        raise OptionError(f"{argument}: no such results; give NAME=PATH of a folder or a CSV file")
    found = _from_folder(path, benchmark) if path.is_dir() else _from_file(path, benchmark)
    missing = tuple(dive.name for dive in benchmark.dives if dive.name not in found)
    if not found:
        first = benchmark.dives[0].name
        raise OptionError(
            f"{path}: nothing for any dive of {benchmark.name}; name the files {first}.csv or "
            f"{first}/{_RUN_FILE} and so on"
        )
    for dive in benchmark.dives:
        found.setdefault(dive.name, _nothing(len(dive.frames)))
    return System(name, found, missing)


def _nothing(n: int) -> Answers:
    return Answers(np.zeros(n, dtype=np.bool_), np.full((n, 3), np.nan), np.full((n, 3), np.nan))


def _from_folder(folder: Path, benchmark: BenchmarkSet) -> dict[str, Answers]:
    found = {}
    for dive in benchmark.dives:
        for path in (folder / f"{dive.name}.csv", folder / dive.name / _RUN_FILE):
            if path.is_file():
                rows = read_rows(path, ("frame", *_ANSWER))
                found[dive.name] = _answers(path, list(enumerate(rows)), dive)
                break
    return found


def _from_file(path: Path, benchmark: BenchmarkSet) -> dict[str, Answers]:
    rows = read_rows(path, ("dive", "frame", *_ANSWER))
    of_dive: dict[str, list[tuple[int, Row]]] = {dive.name: [] for dive in benchmark.dives}
    for i, row in enumerate(rows):
        name = (row["dive"] or "").strip()
        if name not in of_dive:
            raise SourceError(
                f"{path}: line {i + 2}: dive {name!r} is not in {benchmark.name}; use the names of "
                "its folders"
            )
        of_dive[name].append((i, row))
    dives = (dive for dive in benchmark.dives if of_dive[dive.name])
    return {dive.name: _answers(path, of_dive[dive.name], dive) for dive in dives}


def _answers(path: Path, rows: list[tuple[int, Row]], dive: DiveTruth) -> Answers:
    """Put the rows of a dive into the order of its truth; frames without a row have no answer."""
    range_column = _range_column(path, rows[0][1])
    places = {int(frame): k for k, frame in enumerate(dive.frames)}
    found = _nothing(len(places))
    answered: set[int] = set()
    for i, row in rows:
        place = _place(path, i, row, places, dive.name)
        if place in answered:
            raise SourceError(
                f"{path}: line {i + 2}: frame {row['frame']} is there twice; give one row a frame"
            )
        answered.add(place)
        unit = _RANGES[range_column]
        numbers = [cell(path, i, row, column) for column in (range_column, *_ANSWER)]
        own = (f"sigma_{range_column}", *_SIGMAS)
        claimed = _TOTALS if set(_TOTALS) <= row.keys() and unit == 1.0 else own
        sigmas = [cell(path, i, row, column) for column in claimed]
        found.valid[place] = _valid(path, i, row, numbers[0])
        found.posture[place] = [numbers[0] * unit, *numbers[1:]]
        found.sigma[place] = [sigmas[0] * unit, *sigmas[1:]]
    return found


def _range_column(path: Path, row: Row) -> str:
    for name in _RANGES:
        if name in row:
            return name
    raise SourceError(f"{path}: no column range_m or range_mm; name it in the first line")


def _place(path: Path, i: int, row: Row, places: dict[int, int], dive: str) -> int:
    number = cell(path, i, row, "frame")
    if not math.isfinite(number) or number not in places:
        raise SourceError(
            f"{path}: line {i + 2}: frame {row['frame']!r} is not in {dive}; its frames are "
            f"{min(places)} to {max(places)}"
        )
    return places[int(number)]


def _valid(path: Path, i: int, row: Row, distance: float) -> bool:
    """Return whether a row holds an answer: as it says, or else if it has a range."""
    said = (row.get("valid") or "").strip().lower()
    if said in _NO:
        return False
    if said and said not in _YES:
        raise SourceError(f"{path}: line {i + 2}: valid is {said!r}; write 1 or 0")
    if math.isfinite(distance) and distance > 0.0:
        return True
    if said or not math.isnan(distance):
        raise SourceError(
            f"{path}: line {i + 2}: a valid row with the range {distance:g}; give a positive range "
            "or valid 0"
        )
    return False
