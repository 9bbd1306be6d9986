"""`aqualvs score`: answers in plain CSV compared with the truth of a benchmark set.

Systems that come with aqualvs can be run on the set as well: aqualvs itself, and its baselines
(`OWN_SYSTEMS`).
"""

import csv
import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.experiments.benchmark_set import (
    TARGET_FILE,
    Answers,
    BenchmarkSet,
    DiveTruth,
    System,
    load_set,
    read_system,
)
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.nets.target_file import target_dict
from aqualvs.pipeline import run
from aqualvs.results.files import Claim, without_nan, writing
from aqualvs.results.folder import POSTURE_BARE_CSV
from aqualvs.results.run_request import RunRequest, scanner_options
from aqualvs.scanning.target import TargetKind
from aqualvs.simulation.benchmark import VISIBLE_LIMIT
from aqualvs.terminal import Echo
from aqualvs.text import count_text

WRONG_PERCENT = 5.0
"""Range error above which an answer counts as wrong: it is not that of the target."""


@dataclass(frozen=True, slots=True)
class FrameAnswers:
    """Comparison of answers with the truth of N frames, of one dive or several."""

    valid: BoolArray  # Shape (N,): frames with an answer.
    n_visible: FloatArray  # Shape (N,): visible stripe points.
    # Shape (N, 3): errors of range in percent of the true one, of pitch and yaw in degrees; NaN
    # without answer or target.
    error: FloatArray
    sigma: FloatArray  # Shape (N, 3): standard deviations that the system states, same units.

    @property
    def measurable(self) -> BoolArray:
        """Mask (N,) of frames with enough visible points, in which an answer is required."""
        return self.n_visible >= VISIBLE_LIMIT


@dataclass(frozen=True, slots=True)
class ErrorSpread:
    """Statistics of absolute errors; NaN without errors."""

    rms: float
    median: float
    p95: float
    max: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """Score of a system on some frames."""

    n_frames: int
    n_measurable: int  # Frames with at least `VISIBLE_LIMIT` visible stripe points.
    n_available: int  # Measurable frames with an answer.
    # Share of measurable frames with an answer; NaN if no frame is measurable.
    available_percent: float
    # Errors of the answers in measurable frames.
    range_percent: ErrorSpread
    pitch_deg: ErrorSpread
    yaw_deg: ErrorSpread
    # Answers off by more than `WRONG_PERCENT` of the range, in frames with a visible point.
    n_wrong: int
    # Frames without a visible point, and those of them with an answer.
    n_empty: int
    n_false: int
    # Rms of error over stated sigma in measurable frames: 1 is consistent, more is overconfident;
    # NaN if no sigma is stated.
    z_range: float
    z_pitch: float
    z_yaw: float
    # Medians of the stated sigmas in measurable frames.
    sigma_range_percent: float
    sigma_pitch_deg: float
    sigma_yaw_deg: float


def compare(truth: DiveTruth, answers: Answers) -> FrameAnswers:
    """Compare the answers to a dive with its truth."""
    shown = np.where(answers.valid[:, None], answers.posture, np.nan)
    error = shown - truth.posture
    scale = 100.0 / truth.posture[:, 0]
    error[:, 0] *= scale
    sigma = np.where(answers.valid[:, None], answers.sigma, np.nan)
    sigma[:, 0] *= scale
    return FrameAnswers(answers.valid, truth.n_visible.astype(np.float64), error, sigma)


def pooled(parts: Sequence[FrameAnswers]) -> FrameAnswers:
    """Return the frames of several dives as one."""
    names = FrameAnswers.__dataclass_fields__
    return FrameAnswers(*(np.concatenate([getattr(part, n) for part in parts]) for n in names))


def score(frames: FrameAnswers) -> Score:
    """Return the score of some frames."""
    measurable, empty = frames.measurable, frames.n_visible == 0
    n_measurable, n_available = int(measurable.sum()), int((measurable & frames.valid).sum())
    off = np.abs(frames.error[:, 0]) > WRONG_PERCENT
    error, sigma = frames.error[measurable], frames.sigma[measurable]
    z_range, z_pitch, z_yaw = map(_normalised, error.T, sigma.T)
    sigma_range, sigma_pitch, sigma_yaw = map(_median, sigma.T)
    return Score(
        n_frames=len(frames.valid),
        n_measurable=n_measurable,
        n_available=n_available,
        available_percent=100.0 * n_available / n_measurable if n_measurable else np.nan,
        range_percent=_spread(error[:, 0]),
        pitch_deg=_spread(error[:, 1]),
        yaw_deg=_spread(error[:, 2]),
        n_wrong=int((off & ~empty).sum()),
        n_empty=int(empty.sum()),
        n_false=int((empty & frames.valid).sum()),
        z_range=z_range,
        z_pitch=z_pitch,
        z_yaw=z_yaw,
        sigma_range_percent=sigma_range,
        sigma_pitch_deg=sigma_pitch,
        sigma_yaw_deg=sigma_yaw,
    )


def bars_against(frames: FrameAnswers, clear: FrameAnswers) -> FloatArray:
    """Return the ratio (N, 3) of error bars to those of the same frames in clear water.

    It is that of the sigmas of range (in percent), pitch and yaw; NaN where a frame is not
    measurable or lacks a sigma. Both are of the same motion before the same target.
    """
    both = frames.measurable & clear.measurable
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(both[:, None], frames.sigma / clear.sigma, np.nan)


def _spread(errors: FloatArray) -> ErrorSpread:
    sizes = np.abs(errors[np.isfinite(errors)])
    if not len(sizes):
        return ErrorSpread(np.nan, np.nan, np.nan, np.nan)
    rms, p95 = np.sqrt(np.mean(sizes**2)), np.percentile(sizes, 95.0)
    return ErrorSpread(float(rms), float(np.median(sizes)), float(p95), float(sizes.max()))


def _normalised(errors: FloatArray, sigmas: FloatArray) -> float:
    known = np.isfinite(errors) & (sigmas > 0.0)
    if not known.any():
        return np.nan
    return float(np.sqrt(np.mean((errors[known] / sigmas[known]) ** 2)))


def _median(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan


TOTAL = "total"
_CLEAR = "clear"
_HEADER = (
    *("level", "system", "frames", "available %", "range rms %", "median", "p95", "max"),
    *("pitch rms deg", "yaw rms deg", "wrong", "false", "z range", "z pitch", "z yaw"),
)


@dataclass(frozen=True, slots=True)
class Entry:
    """Score of a system on a dive, a level or the whole set."""

    system: str
    scope: str  # "dive", "level" or "total".
    name: str  # Name of the dive or level; "total" for all.
    score: Score


@dataclass(frozen=True, slots=True)
class Bars:
    """Median length of error bars on a level, relative to those of the clear twins."""

    system: str
    level: str
    # NaN if the system states no sigma.
    range: float
    pitch: float
    yaw: float


@dataclass(frozen=True, slots=True)
class Scores:
    """Scores of some systems on a set."""

    title: str  # The set's.
    entries: tuple[Entry, ...]  # By system: dives, levels, total.
    bars: tuple[Bars, ...]


def score_systems(benchmark: BenchmarkSet, systems: Sequence[System]) -> Scores:
    """Score systems on a set."""
    entries: list[Entry] = []
    bars: list[Bars] = []
    for system in systems:
        frames = {dive.name: compare(dive, system.answers[dive.name]) for dive in benchmark.dives}
        entries += [Entry(system.name, "dive", name, score(part)) for name, part in frames.items()]
        for level in benchmark.levels:
            names = [dive.name for dive in benchmark.dives if dive.level == level]
            together = pooled([frames[name] for name in names])
            entries.append(Entry(system.name, "level", level, score(together)))
            if level != _CLEAR:
                bars += _bars(system.name, level, names, frames)
        entries.append(Entry(system.name, TOTAL, TOTAL, score(pooled(list(frames.values())))))
    return Scores(benchmark.title, tuple(entries), tuple(bars))


def _bars(system: str, level: str, names: list[str], frames: dict[str, FrameAnswers]) -> list[Bars]:
    """Compare dives with their clear twins; empty without twins or without claimed sigmas."""
    found = []
    for name in names:
        twin = frames.get(f"{_CLEAR}_{name.removeprefix(f'{level}_')}")
        if twin is not None and len(twin.valid) == len(frames[name].valid):
            found.append(bars_against(frames[name], twin))
    ratios: FloatArray = np.concatenate([np.empty((0, 3)), *found])
    ratios = ratios[np.isfinite(ratios).all(axis=1)]
    if not len(ratios):
        return []
    return [Bars(system, level, *(float(value) for value in np.median(ratios, axis=0)))]


def lines(scores: Scores, *, dives: bool) -> list[str]:
    """Return the lines of the table: all systems of a level, then those of the next.

    `dives`: whether to include every dive.
    """
    rows = _rows(scores, dives=dives)
    widths = [max(len(row[k]) for row in (_HEADER, *rows)) for k in range(len(_HEADER))]
    text = [scores.title]
    for row in (_HEADER, *rows):
        cells = [
            value.ljust(width) if k < 2 else value.rjust(width)
            for k, (value, width) in enumerate(zip(row, widths, strict=True))
        ]
        text.append("  ".join(cells).rstrip())
    return [*text, *(_bar_line(bar) for bar in scores.bars)]


def markdown(scores: Scores) -> str:
    """Return the same table in Markdown, with every dive."""
    rows = [_HEADER, tuple("---" for _ in _HEADER), *_rows(scores, dives=True)]
    table = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    bars = "".join(f"- {_bar_line(bar)}\n" for bar in scores.bars)
    return f"{scores.title}\n\n{table}\n\n{bars}"


SCORE_FILES = ("scores.csv", "scores.json", "scores.md")
"""Files that `write_scores` writes."""


def write_scores(scores: Scores, folder: Path) -> list[Path]:
    """Write `scores.csv`, `scores.json` and `scores.md`; return their paths.

    Raises `OSError` if the folder or a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    table, data, text = (folder / name for name in SCORE_FILES)
    records = [_record(entry) for entry in scores.entries]
    with table.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(records[0]))
        writer.writeheader()
        writer.writerows(records)
    bars = [without_nan(asdict(bar)) for bar in scores.bars]
    content = {"set": scores.title, "scores": records, "error_bars_against_clear": bars}
    data.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    text.write_text(markdown(scores), encoding="utf-8")
    return [table, data, text]


def _record(entry: Entry) -> dict[str, Any]:
    """Return an entry as one flat mapping, with None for missing numbers."""
    flat: dict[str, Any] = {"system": entry.system, "scope": entry.scope, "name": entry.name}
    for key, value in asdict(entry.score).items():
        if isinstance(value, dict):
            flat |= {f"{key}_{kind}": number for kind, number in value.items()}
        else:
            flat[key] = value
    found: dict[str, Any] = without_nan(flat)
    return found


def _rows(scores: Scores, *, dives: bool) -> list[tuple[str, ...]]:
    """Return the cells of the table, the entries of the same name together."""
    shown = [entry for entry in scores.entries if dives or entry.scope != "dive"]
    names = list(dict.fromkeys(entry.name for entry in shown))
    return [_cells(entry) for name in names for entry in shown if entry.name == name]


def _cells(entry: Entry) -> tuple[str, ...]:
    found = entry.score
    spread = found.range_percent
    return (
        entry.name,
        entry.system,
        f"{found.n_measurable}/{found.n_frames}",
        _number(found.available_percent, 1),
        *(_number(value, 3) for value in (spread.rms, spread.median, spread.p95, spread.max)),
        _number(found.pitch_deg.rms, 2),
        _number(found.yaw_deg.rms, 2),
        str(found.n_wrong),
        f"{found.n_false}/{found.n_empty}",
        *(_number(value, 2) for value in (found.z_range, found.z_pitch, found.z_yaw)),
    )


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _bar_line(bar: Bars) -> str:
    return (
        f"{bar.system}: error bars on {bar.level} are {bar.range:.2f} (range), {bar.pitch:.2f} "
        f"(pitch), {bar.yaw:.2f} (yaw) times those of the same frames on {_CLEAR}"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class OwnSystem:
    """System that comes with aqualvs: options of `aqualvs run`."""

    name: str
    detector: str = "ridge"  # "ridge" or "threshold".
    mesh_filter: str = "none"  # "none" or "paper".
    fit: str = "robust"  # "robust" or "pseudo_inverse".
    no_dome: bool = False


OWN_SYSTEMS = (
    OwnSystem(name="aqualvs"),
    OwnSystem(name="no-dome", no_dome=True),
    OwnSystem(name="threshold", detector="threshold"),
    OwnSystem(name="paper-filter", mesh_filter="paper"),
    OwnSystem(name="paper", detector="threshold", mesh_filter="paper", fit="pseudo_inverse"),
)
"""aqualvs with default options; without its dome model; with the paper's detector; with the paper's
filter for nets, which gets the net's parameters; and with the paper's detector, filter and fit, and
the dome model."""

BARE_LENS = "bare-lens"
"""Points of aqualvs triangulated again without the dome, which is used to detect the stripes."""


def run_own(benchmark: BenchmarkSet, folder: Path, echo: Echo, *, overwrite: bool) -> list[str]:
    """Measure every dive of a set with every system of `OWN_SYSTEMS`, into SYSTEM/DIVE of a folder.

    Returns NAME=PATH of every system, for `read_system`. Raises `AqualvsError` if a dive cannot be
    read or the folder cannot be written.
    """
    for system in OWN_SYSTEMS:
        for dive in benchmark.dives:
            out = folder / system.name / dive.name
            run(_request(system, benchmark.folder / dive.name, out, overwrite))
        dives = count_text(len(benchmark.dives), "dive")
        echo(f"{system.name}: {dives} measured into {folder / system.name}")
    bare = folder / BARE_LENS
    files = [bare / f"{dive.name}.csv" for dive in benchmark.dives]
    with Claim("score", files, overwrite=overwrite), writing(bare):
        for dive in benchmark.dives:
            found = folder / OWN_SYSTEMS[0].name / dive.name / POSTURE_BARE_CSV
            shutil.copyfile(found, bare / f"{dive.name}.csv")
    names = [*(system.name for system in OWN_SYSTEMS), BARE_LENS]
    return [f"{name}={folder / name}" for name in names]


def _request(system: OwnSystem, source: Path, out: Path, overwrite: bool) -> RunRequest:
    """Return the run of a system on a dive; filters for nets are not applied to walls."""
    target, mesh_filter = "auto", "none"
    if system.mesh_filter == "paper":
        file = str(source / TARGET_FILE)
        if target_dict(file).kind is not TargetKind.SOLID:
            target, mesh_filter = file, system.mesh_filter
    return RunRequest(
        source=str(source / "dive.mp4"),
        rig=source / "rig.yaml",
        out=out,
        overwrite=overwrite,
        no_dome=system.no_dome,
        scanner=scanner_options(target, system.detector, mesh_filter, system.fit),
        report=False,
    )


def run_score(
    results: Sequence[str],
    truth: Path,
    echo: Echo,
    *,
    own: Path | None,
    out: Path | None,
    dives: bool,
    overwrite: bool = False,
) -> None:
    """Score systems and print the table.

    Options are those of `aqualvs score`, see its `--help`. Raises `AqualvsError` if truth or
    results cannot be used, or a folder cannot be written.
    """
    if not results and own is None:
        raise OptionError(
            "RESULTS: missing; give NAME=PATH of what a system answered, or --own DIR"
        )
    benchmark = load_set(truth)
    files = [] if out is None else [out / name for name in SCORE_FILES]
    with Claim("score", files, overwrite=overwrite):
        systems = [read_system(argument, benchmark) for argument in results]
        if own is not None:
            mine = run_own(benchmark, own, echo, overwrite=overwrite)
            systems += [read_system(argument, benchmark) for argument in mine]
        names = [system.name for system in systems]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise OptionError(f"{twice}: two systems of this name; give NAME=PATH")
        scores = score_systems(benchmark, systems)
        for line in lines(scores, dives=dives):
            echo(line)
        for system in systems:
            if system.missing:
                echo(
                    f"{system.name}: no file for {', '.join(system.missing)}: counted as no answer"
                )
        if out is not None:
            with writing(out):
                written = write_scores(scores, out)
            echo(f"scores: {', '.join(map(str, written))}")
