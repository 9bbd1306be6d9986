"""The public benchmark set on disk, and the answers of a system to it.

`aqualvs benchmark` renders the set or a part of it: dives, the truth of their frames, and a README.
The answers of a system are plain CSV, frame by frame.
"""

import csv
import math
import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from aqualvs import __version__
from aqualvs.errors import OptionError, SourceError, check_commas
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.results.files import Claim, writing
from aqualvs.results.summary import RANGE_UNITS, Row, check_range_unit, range_column
from aqualvs.simulation.benchmark import (
    BENCHMARK_NAME,
    CONTRAST_LIMIT,
    LEVELS,
    N_FRAMES,
    VISIBLE_LIMIT,
    BenchmarkDive,
    benchmark_checksum,
    benchmark_dives,
    benchmark_rig,
    render_benchmark_dive,
)
from aqualvs.simulation.dive import shutter_from_words
from aqualvs.simulation.render import Renderer
from aqualvs.special_files import refuse_special
from aqualvs.terminal import Echo, progress
from aqualvs.text import count_text
from aqualvs.yamlfile import read_yaml

SET_FILE = "benchmark.yaml"
TRUTH_FILE = "truth.csv"
TARGET_FILE = "target.yaml"

_VERSION_KEY = "aqualvs_benchmark"
_COLUMNS = ("frame", "range_m", "pitch_deg", "yaw_deg", "n_visible")


@dataclass(frozen=True, slots=True)
class DiveTruth:
    """Truth of one dive, N frames."""

    name: str
    level: str
    frames: IntArray  # Shape (N,): frame numbers, from 0.
    posture: FloatArray  # Shape (N, 3): range (m), pitch and yaw (deg); NaN without a target.
    # Shape (N,): number of stripe points on the target that are visible in the picture.
    n_visible: IntArray


@dataclass(frozen=True, slots=True)
class BenchmarkSet:
    """Set of dives with truth."""

    name: str
    checksum: str  # Of the set's definition.
    # False for a part of the set, or fewer frames: scores cannot be compared with the whole set's.
    whole: bool

    folder: Path
    dives: tuple[DiveTruth, ...]

    @property
    def title(self) -> str:
        """Title of the set in scores."""
        frames = sum(len(dive.frames) for dive in self.dives)
        part = "" if self.whole else ", a PART of the set: not to be compared with the whole"
        size = f"{count_text(len(self.dives), 'dive')}, {count_text(frames, 'frame')}"
        return f"{self.name} (checksum {self.checksum}): {size}{part}"

    @property
    def levels(self) -> list[str]:
        """Levels in the order of the dives."""
        return list(dict.fromkeys(dive.level for dive in self.dives))


def load_set(folder: Path) -> BenchmarkSet:
    """Read a set that `aqualvs benchmark` wrote.

    Raises `SourceError` if the folder contains no set, or a file of it cannot be read.
    """
    path = folder / SET_FILE
    content = read_yaml(path, "a set that 'aqualvs benchmark -o DIR' wrote", SourceError)
    if not isinstance(content, dict) or content.get(_VERSION_KEY) != 1:
        raise SourceError(f"{path}: not a benchmark set of version 1; make the set again")
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

    Raises `SourceError` if the file cannot be read, lacks a column, or has a value that is no
    number.
    """
    rows = read_rows(path, _COLUMNS)
    cells = [[cell(path, i, row, column) for column in _COLUMNS] for i, row in enumerate(rows)]
    table = np.array(cells, dtype=np.float64)
    if not np.isfinite(table[:, [0, 4]]).all():
        raise SourceError(f"{path}: a row lacks its frame or n_visible; make the set again")
    if len(np.unique(table[:, 0])) < len(table):
        raise SourceError(f"{path}: a frame is there twice; make the set again")
    return DiveTruth(
        name, level, table[:, 0].astype(np.int64), table[:, 1:4], table[:, 4].astype(np.int64)
    )


def read_rows(path: Path, needed: tuple[str, ...]) -> list[Row]:
    """Return the rows of a CSV file with a header, whose names are stripped.

    Raises `SourceError` if it cannot be read, has no rows, or lacks a column.
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
    check_commas(table.fieldnames, path, SourceError)
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
    """Return the number in a cell; NaN if it is empty.

    Raises `SourceError` for any other text.
    """
    text = (row.get(column) or "").strip()
    try:
        return float(text) if text else math.nan
    except ValueError:
        raise SourceError(
            f"{path}: line {i_row + 2}: {column} is {text!r}; write a number or leave it empty"
        ) from None


_README_MD = "README.md"


def make_set(
    out: Path,
    names: Sequence[str],
    echo: Echo,
    *,
    n_frames: int | None,
    shutter: str | None = None,
    overwrite: bool,
) -> None:
    """Render dives of the set, with truth and a README, into a folder.

    Options are those of `aqualvs benchmark`, see its `--help`. The shutter is that of a camera of
    25 frames a second, from which the set's frames are taken; a set with a shutter counts as a part
    of the set.

    Raises `OptionError` if a name is not known or the number of frames makes no sense,
    `OutputError` if the folder contains a set already or cannot be written.
    """
    dives = chosen_dives(names, n_frames)
    written = [out / name for name in (SET_FILE, _README_MD, *(dive.name for dive in dives))]
    claim = Claim("benchmark", written, overwrite=overwrite)
    rig = benchmark_rig()
    if shutter is not None:
        camera_fps = 25.0
        rig = replace(rig, shutter=shutter_from_words(shutter, camera_fps))
    renderer = Renderer(rig, threads=os.cpu_count() or 1)
    total = sum(dive.scenario.n_frames for dive in dives)
    with claim, writing(out), progress(BENCHMARK_NAME, total) as tick:
        # Written last, so that an interrupted set is not complete.
        (out / SET_FILE).unlink(missing_ok=True)
        for dive in dives:
            render_benchmark_dive(dive, renderer, out / dive.name, tick=tick)
            (out / dive.name / TARGET_FILE).write_text(target_text(dive), encoding="utf-8")
        readme = files("aqualvs.experiments") / "assets" / "benchmark.md"
        (out / _README_MD).write_text(readme.read_text(encoding="utf-8"), encoding="utf-8")
        facts = set_facts(dives)
        if shutter is not None:
            facts |= {"whole": False, "shutter": shutter}
        content = yaml.safe_dump(facts, sort_keys=False, width=100)
        (out / SET_FILE).write_text(content, encoding="utf-8")
    echo(f"{count_text(len(dives), 'dive')}, {count_text(total, 'frame')}: {out}")
    echo(f"what is in it, and what to write: {out / _README_MD}")
    echo("next, with the folder of your results for RESULTS:")
    echo(f"  aqualvs {shlex.join(['score', 'mine=RESULTS', '--truth', str(out)])}")


def chosen_dives(names: Sequence[str], n_frames: int | None) -> list[BenchmarkDive]:
    """Return the dives of some levels or names, in the set's order.

    `n_frames`: number of frames to shorten them to; None for all.

    Raises `OptionError` if a name is not known or the number of frames makes no sense.
    """
    dives = benchmark_dives()
    known = [*LEVELS, *(dive.name for dive in dives)]
    for name in names:
        if name not in known:
            raise OptionError(f"{name}: no such level or dive; choose from {', '.join(known)}")
    if n_frames is not None and not 2 <= n_frames <= N_FRAMES:
        raise OptionError(f"--frames {n_frames}: give 2 to {N_FRAMES}")
    chosen = [dive for dive in dives if not names or dive.level in names or dive.name in names]
    if n_frames is None:
        return chosen
    return [dive.shortened(n_frames) for dive in chosen]


def target_text(dive: BenchmarkDive) -> str:
    """Return the target file of a dive, with what a user may know beforehand."""
    if dive.level == "empty":
        return "kind: auto\n"
    if not dive.scenario.nets:
        return "kind: solid\n"
    net = dive.scenario.nets[0]
    bar, twine = 1e3 * net.bar, 1e3 * net.twine
    return f"kind: net\nnet: {{mesh: {net.mesh}, bar_mm: {bar:g}, twine_mm: {twine:g}}}\n"


def set_facts(dives: Sequence[BenchmarkDive]) -> dict[str, Any]:
    """Return the content of the set's file."""
    whole = len(dives) == len(benchmark_dives())
    whole &= all(dive.scenario.n_frames == N_FRAMES for dive in dives)
    return {
        _VERSION_KEY: 1,
        "name": BENCHMARK_NAME,
        "checksum": benchmark_checksum(),
        "whole": whole,
        "rendered_with": f"aqualvs {__version__}",
        "visible_contrast_grey_levels": CONTRAST_LIMIT,
        "measurable_from_visible_points": VISIBLE_LIMIT,
        "levels": dict(LEVELS),
        "dives": {
            dive.name: {
                "level": dive.level,
                "n_frames": dive.scenario.n_frames,
                "fps": dive.scenario.fps,
                "seed": dive.scenario.seed,
            }
            for dive in dives
        },
    }


def print_dives(echo: Echo) -> None:
    """Print the levels and their dives, one line each."""
    for level, about in LEVELS.items():
        names = (dive.name for dive in benchmark_dives() if dive.level == level)
        echo(f"{level:8} {about}: {', '.join(names)}")


_ANSWER = ("pitch_deg", "yaw_deg")
_SIGMAS = ("sigma_pitch_deg", "sigma_yaw_deg")
# Total sigmas of our own runs, which include the rig's uncertainty.
_TOTALS = ("sigma_range_total_m", "sigma_pitch_total_deg", "sigma_yaw_total_deg")
_YES, _NO = {"1", "true", "yes"}, {"0", "false", "no"}
_RUN_FILE = "posture.csv"


@dataclass(frozen=True, slots=True)
class Answers:
    """Answers of a system to the N frames of one dive, in the order of the truth."""

    valid: BoolArray  # Shape (N,).
    posture: FloatArray  # Shape (N, 3): range (m), pitch and yaw (deg); NaN if missing.
    # Shape (N, 3): standard deviations that the system states, same units; NaN if missing.
    sigma: FloatArray


@dataclass(frozen=True, slots=True)
class System:
    """System under test."""

    name: str
    answers: dict[str, Answers]  # By dive, for every dive of the set.
    missing: tuple[str, ...]  # Dives without a file, which have no valid answers.


def read_system(argument: str, benchmark: BenchmarkSet) -> System:
    """Read the results of a system for the dives of a set.

    `argument`: NAME=PATH, or a path whose last part is the name. The path is a folder with DIVE.csv
    or DIVE/posture.csv for every dive, or one CSV with a column `dive`.

    Raises `SourceError` if a file cannot be read or is malformed, `OptionError` if there are no
    results for any dive.
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
    """Read the answers from one file for each dive."""
    found = {}
    for dive in benchmark.dives:
        for path in (folder / f"{dive.name}.csv", folder / dive.name / _RUN_FILE):
            if path.is_file():
                rows = read_rows(path, ("frame", *_ANSWER))
                found[dive.name] = _answers(path, list(enumerate(rows)), dive)
                break
    return found


def _from_file(path: Path, benchmark: BenchmarkSet) -> dict[str, Answers]:
    """Read the answers from one file with a column `dive`."""
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
    """Return the rows of a dive in the order of its truth; frames without a row have no answer."""
    own_range = range_column(path, rows[0][1])
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
        unit = RANGE_UNITS[own_range]
        numbers = [cell(path, i, row, column) for column in (own_range, *_ANSWER)]
        own = (f"sigma_{own_range}", *_SIGMAS)
        claimed = _TOTALS if set(_TOTALS) <= row.keys() and unit == 1.0 else own
        sigmas = [cell(path, i, row, column) for column in claimed]
        found.valid[place] = _valid(path, i, row, numbers[0])
        found.posture[place] = [numbers[0] * unit, *numbers[1:]]
        found.sigma[place] = [sigmas[0] * unit, *sigmas[1:]]
    if found.valid.any():
        check_range_unit(path, rows[0][1], float(np.median(found.posture[found.valid, 0])))
    return found


def _place(path: Path, i: int, row: Row, places: dict[int, int], dive: str) -> int:
    number = cell(path, i, row, "frame")
    if not math.isfinite(number) or number not in places:
        raise SourceError(
            f"{path}: line {i + 2}: frame {row['frame']!r} is not in {dive}; its frames are "
            f"{min(places)} to {max(places)}"
        )
    return places[int(number)]


def _valid(path: Path, i: int, row: Row, distance: float) -> bool:
    """Return whether a row has an answer: by its column `valid`, or else if it has a range."""
    valid = (row.get("valid") or "").strip().lower()
    if valid in _NO:
        return False
    if valid and valid not in _YES:
        raise SourceError(f"{path}: line {i + 2}: valid is {valid!r}; write 1 or 0")
    if math.isfinite(distance) and distance > 0.0:
        return True
    if valid or not math.isnan(distance):
        raise SourceError(
            f"{path}: line {i + 2}: a valid row with the range {distance:g}; give a positive range "
            "or valid 0"
        )
    return False
