"""Scores of systems side by side: tables to read, tables to compute with."""

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aqualvs.app.score_measures import Frames, Score, bars_against, compare, pooled, score
from aqualvs.app.score_results import System
from aqualvs.app.score_set import BenchmarkSet
from aqualvs.geometry.arrays import FloatArray

TOTAL = "total"
_CLEAR = "clear"
_HEADER = (
    *("level", "system", "frames", "available %", "range rms %", "median", "p95", "max"),
    *("pitch rms deg", "yaw rms deg", "wrong", "false", "z range", "z pitch", "z yaw"),
)


@dataclass(frozen=True, slots=True)
class Entry:
    """A score and what it is of.

    Attributes
    ----------
    system : str
    scope : {"dive", "level", "total"}
    name : str
        Of the dive or level; "total" for all.
    score : Score
    """

    system: str
    scope: str
    name: str
    score: Score


@dataclass(frozen=True, slots=True)
class Bars:
    """How long error bars are on a level, in those of the clear twins: medians.

    Attributes
    ----------
    system, level : str
    range, pitch, yaw : float
        NaN where the system claims none.
    """

    system: str
    level: str
    range: float
    pitch: float
    yaw: float


@dataclass(frozen=True, slots=True)
class Scores:
    """Everything that was found of some systems.

    Attributes
    ----------
    title : str
        The set's.
    entries : tuple of Entry
        By system: dives, levels, total.
    bars : tuple of Bars
    """

    title: str
    entries: tuple[Entry, ...]
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


def _bars(system: str, level: str, names: list[str], frames: dict[str, Frames]) -> list[Bars]:
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
    """Return the table to read: level after level, the systems below each other.

    Parameters
    ----------
    scores : Scores
    dives : bool
        Whether to show every dive before its level.
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


def markdown(scores: Scores, *, dives: bool) -> str:
    """Return the same table in Markdown."""
    rows = [_HEADER, tuple("---" for _ in _HEADER), *_rows(scores, dives=dives)]
    table = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    bars = "".join(f"- {_bar_line(bar)}\n" for bar in scores.bars)
    return f"{scores.title}\n\n{table}\n\n{bars}"


SCORE_FILES = ("scores.csv", "scores.json", "scores.md")
"""What `write_scores` writes."""


def write_scores(scores: Scores, folder: Path) -> list[Path]:
    """Write `scores.csv`, `scores.json` and `scores.md`; return their paths.

    Raises
    ------
    OSError
        If the folder or a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    table, data, text = (folder / name for name in SCORE_FILES)
    records = [_record(entry) for entry in scores.entries]
    with table.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(records[0]))
        writer.writeheader()
        writer.writerows(
            {key: "" if value is None else value for key, value in record.items()}
            for record in records
        )
    bars = [_without_nan(asdict(bar)) for bar in scores.bars]
    content = {"set": scores.title, "scores": records, "error_bars_against_clear": bars}
    data.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    text.write_text(markdown(scores, dives=True), encoding="utf-8")
    return [table, data, text]


def _record(entry: Entry) -> dict[str, Any]:
    """Return an entry as one flat mapping; None where a number does not exist."""
    flat: dict[str, Any] = {"system": entry.system, "scope": entry.scope, "name": entry.name}
    for key, value in asdict(entry.score).items():
        if isinstance(value, dict):
            flat |= {f"{key}_{kind}": number for kind, number in value.items()}
        else:
            flat[key] = value
    return _without_nan(flat)


def _without_nan(record: dict[str, Any]) -> dict[str, Any]:
    return {
        key: None if isinstance(value, float) and math.isnan(value) else value
        for key, value in record.items()
    }


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
