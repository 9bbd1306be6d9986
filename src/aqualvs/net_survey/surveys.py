"""Surveys of a net: runs read from the files that `aqualvs net` wrote, and their dates.

The date of a dive is what the user gives, else what the names say, else the clock of its video.
"""

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from aqualvs.errors import OptionError, SourceError
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.report.run_data import source_name
from aqualvs.results.files import read_json
from aqualvs.results.folder import HOLES_CSV, NET_CSV, NET_GEOJSON, POSTURE_CSV, check_run_files
from aqualvs.results.run_request import read_run_yaml
from aqualvs.text import are_holes_searched
from aqualvs.vehicle_logs import dive_start_utc

_NAMED = re.compile(r"(?<!\d)(20\d\d)([-_.]?)(\d\d)\2(\d\d)(?!\d)")
AUTO = "auto"
"""Instead of a date: find it."""


def given_dates(texts: Sequence[str], n: int) -> list[date | None]:
    """Return the dates that the user gives for `n` folders; None where to be found.

    Raises `OptionError` if there is not one for every folder, or one is no date.
    """
    if texts and len(texts) != n:
        raise OptionError(
            f"--date is given {len(texts)} times for {n} folders; give it once for every RUN, in "
            f"their order ({AUTO} where it is to be found)"
        )
    return [_parse_date(text) for text in texts] or [None] * n


def date_of_run(folder: Path) -> tuple[date, str]:
    """Return the day of a run's dive, and what says so.

    The date in the name of its folder counts first, then that in the name of the video, then the
    time that the video's container states. When it was evaluated says nothing.

    Raises `OptionError` if nothing tells.
    """
    source = _source(folder)
    names = [(folder.resolve().name, "the folder's name"), (source.name, "the video's name")]
    for name, words in names:
        if (found := named_date(name)) is not None:
            return found, words
    start = dive_start_utc(source) if source.is_file() else None
    if start is not None:
        return datetime.fromtimestamp(start, UTC).date(), "the video's clock"
    raise OptionError(
        f"{folder}: neither its name nor its video gives the date of the dive; add --date "
        f"YYYY-MM-DD, once for every RUN in their order ({AUTO} where it is to be found)"
    )


def named_date(name: str) -> date | None:
    """Return the first date in a name such as `cage3_2026-05-01` or `20260501_1030.mp4`."""
    for year, _, month, day in _NAMED.findall(name):
        try:
            return date(int(year), int(month), int(day))
        except ValueError:
            continue
    return None


def _parse_date(text: str) -> date | None:
    if text == AUTO:
        return None
    try:
        return datetime.fromisoformat(text).date()
    except ValueError as fault:
        raise OptionError(f"--date {text}: is not a date; write it as 2026-05-01") from fault


def _source(folder: Path) -> Path:
    """Return the video of a run, which may be gone; an empty path where it is not known."""
    try:
        return Path(source_name(read_run_yaml(folder)))
    except SourceError:
        return Path()


Row: TypeAlias = Mapping[str, str]

# Part of what a picture passed over in which lasers look for holes, where the files do not tell.
_LASERS_SHARE = 0.4
_DIVES = "dives"


@dataclass(frozen=True, slots=True)
class Stretches:
    """Stretches of a dive, K of them; NaN where not known."""

    # Shape (K,): dive time; metres along the net; metres; radians; metres of laser line looked at.
    begin_s: FloatArray
    along: FloatArray
    depth: FloatArray
    bearing: FloatArray
    seen: FloatArray
    # Shape (K,): share of the area, and its standard deviation as `net.csv` has it.
    solidity: FloatArray
    sigma: FloatArray
    # Shape (K,): enough of the mesh was seen to rely on it.
    usable: BoolArray
    # Shape (K,): there is a track: `along` means something.
    placed: BoolArray
    # Shape (K, 4, 2): of what the picture passed over, as `net.geojson` has it.
    outline: FloatArray


@dataclass(frozen=True, slots=True)
class Holes:
    """Holes of a dive, H of them; NaN where not known."""

    number: list[str]  # As `holes.csv` numbers them.
    # Shape (H,).
    time_s: FloatArray
    along: FloatArray
    depth: FloatArray
    bearing: FloatArray
    # Shape (H,): in metres.
    diameter: FloatArray
    sigma: FloatArray


@dataclass(frozen=True, slots=True)
class Survey:
    """A dive along the net."""

    folder: Path
    date: date  # On which it took place.
    stretches: Stretches
    holes: Holes
    # Whether x of the outlines is a bearing in degrees instead of metres along the net, and y minus
    # the depth instead of metres above the start.
    by_bearing: bool
    by_depth: bool
    # Part of the height of what the picture passed over in which lasers looked for holes.
    lasers_share: float
    # Member `aqualvs_net` of `net.geojson`.
    facts: Mapping[str, Any]

    @property
    def name(self) -> str:
        """Name of the survey in messages."""
        return self.folder.name or str(self.folder)

    @property
    def searched(self) -> bool:
        """Whether holes were searched for."""
        area_m2 = self.facts.get("summary", {}).get("area_m2")
        return are_holes_searched(len(self.holes.number), area_m2)


def find_runs(folder: Path) -> list[Path]:
    """Return the runs that a folder is or, as that of a batch, holds.

    Raises `SourceError` if there is none with the state of a net.
    """
    if (folder / NET_CSV).is_file():
        return [folder]
    if (folder / POSTURE_CSV).is_file():
        raise SourceError(
            f"{folder}: is a run whose net has not been evaluated ({NET_CSV}); "
            f"run: aqualvs net {folder} --log LOG"
        )
    found = sorted(path.parent for path in folder.glob(f"{_DIVES}/*/{NET_CSV}"))
    if found:
        return found
    if (folder / _DIVES).is_dir():
        raise SourceError(
            f"{folder}: is a batch in which no net has been evaluated ({NET_CSV}); "
            f"run: aqualvs net {folder / _DIVES}/NAME --log LOG, for each"
        )
    raise SourceError(f"{folder}: no run is there ({NET_CSV} is missing); name folders of runs")


def left_out(folder: Path) -> list[str]:
    """Return messages on the dives of a batch whose net was not evaluated; mostly none."""
    if (folder / NET_CSV).is_file():
        return []
    runs = sorted(path.parent for path in folder.glob(f"{_DIVES}/*/{POSTURE_CSV}"))
    missing = [run.name for run in runs if not (run / NET_CSV).is_file()]
    if not missing:
        return []
    words = "dives whose nets have not been evaluated are"
    if len(missing) == 1:
        words = "dive whose net has not been evaluated is"
    return [f"{folder}: {len(missing)} {words} left out: {', '.join(missing)} (aqualvs net)"]


def read_survey(folder: Path, day: date) -> Survey:
    """Read the state of a net from a run's folder.

    Raises `SourceError` if a file is missing or cannot be understood.
    """
    check_run_files(folder)
    rows, holes = _rows(folder / NET_CSV), _rows(folder / HOLES_CSV)
    content = _json(folder / NET_GEOJSON)
    facts = content["aqualvs_net"]
    try:
        outline = _outlines(content["features"], len(rows))
        stretches, found = _stretches(rows, outline), _holes(holes)
        n_holes = facts.get("summary", {}).get("n_holes", len(holes))
        if n_holes != len(holes):
            raise ValueError(f"{HOLES_CSV} holds {len(holes)} of {n_holes} holes")
        coordinates = facts["coordinates"]
        by_bearing = coordinates["x"].startswith("bearing")
        by_depth = coordinates["y"].startswith("minus")
    except (KeyError, ValueError, TypeError, AttributeError) as fault:
        raise SourceError(
            f"{folder}: {NET_CSV}, {HOLES_CSV} and {NET_GEOJSON} do not belong together or are "
            f"damaged ({fault}); run: aqualvs net {folder} --overwrite"
        ) from fault
    share = _lasers_share(facts, outline) if not by_bearing else _LASERS_SHARE
    return Survey(folder, day, stretches, found, by_bearing, by_depth, share, facts)


def check_surveys(surveys: Sequence[Survey]) -> None:
    """Refuse runs that cannot be compared at all.

    Raises `OptionError` if there are fewer than two, or all are of one day, or one is named twice.
    """
    folders = [one.folder.resolve() for one in surveys]
    for one, folder in zip(surveys, folders, strict=True):
        if folders.count(folder) > 1:
            raise OptionError(f"{one.folder}: is named twice; name every run once")
    if len(surveys) < 2:
        raise OptionError("one run cannot be compared; name runs of at least two dates")
    if len({one.date for one in surveys}) < 2:
        raise OptionError(
            f"all {len(surveys)} runs are of {surveys[0].date}; name runs of another date too, or "
            "correct it by --date, once for every RUN"
        )


def _stretches(rows: Sequence[Row], outline: FloatArray) -> Stretches:
    strands = _column(rows, "n_strands")
    solidity, sigma = _column(rows, "solidity"), _column(rows, "sigma_solidity")
    # A row that rests on fewer strands in a frame is not to be relied on (docs/net-condition.md).
    min_strands = 5.0
    return Stretches(
        begin_s=_column(rows, "begin_s"),
        along=_column(rows, "along_m"),
        depth=_column(rows, "depth_m"),
        bearing=np.deg2rad(_column(rows, "bearing_deg")),
        seen=_column(rows, "seen_m"),
        solidity=solidity,
        sigma=sigma,
        usable=(strands >= min_strands) & np.isfinite(solidity) & (sigma > 0.0),
        placed=np.array([row["placed_by"] != "nothing" for row in rows], np.bool_),
        outline=outline,
    )


def _holes(rows: Sequence[Row]) -> Holes:
    return Holes(
        number=[row["hole"] for row in rows],
        time_s=_column(rows, "time_s"),
        along=_column(rows, "along_m"),
        depth=_column(rows, "depth_m"),
        bearing=np.deg2rad(_column(rows, "bearing_deg")),
        diameter=1e-3 * _column(rows, "diameter_mm"),
        sigma=1e-3 * _column(rows, "sigma_diameter_mm"),
    )


def _lasers_share(facts: Mapping[str, Any], outline: FloatArray) -> float:
    """Return how much of the height of the picture's bands lasers looked at."""
    looked, passed = facts.get("summary", {}).get("area_m2"), float(areas(outline).sum())
    if not isinstance(looked, int | float) or not passed > 0.0:
        return _LASERS_SHARE
    return float(np.clip(looked / passed, 0.1, 1.0))


def areas(outline: FloatArray) -> FloatArray:
    """Return the areas (K,) in outlines (K, 4, 2)."""
    x, y = outline[..., 0], outline[..., 1]
    turned = x * np.roll(y, -1, axis=-1) - y * np.roll(x, -1, axis=-1)
    return np.asarray(0.5 * np.abs(turned.sum(axis=-1)), np.float64)


def _outlines(features: Sequence[Mapping[str, Any]], n: int) -> FloatArray:
    rings = [
        one["geometry"]["coordinates"][0][:4]
        for one in features
        if one["properties"]["kind"] == "stretch"
    ]
    if len(rings) != n:
        raise ValueError(f"{len(rings)} outlines of {n} stretches")
    return np.array(rings, np.float64).reshape(n, 4, 2)


def _column(rows: Sequence[Row], name: str) -> FloatArray:
    return np.array([float(row[name] or "nan") for row in rows], np.float64)


def _rows(path: Path) -> list[Row]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as fault:
        raise _unreadable(path) from fault


def _json(path: Path) -> Mapping[str, Any]:
    try:
        content = read_json(path)
    except (OSError, ValueError) as fault:
        raise _unreadable(path) from fault
    if not isinstance(content, dict) or not isinstance(content.get("aqualvs_net"), dict):
        raise _unreadable(path)
    return content


def _unreadable(path: Path) -> SourceError:
    return SourceError(
        f"{path}: is missing or cannot be read; run: aqualvs net {path.parent} --overwrite"
    )
