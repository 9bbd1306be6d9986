"""Summary of a run: counts and ranges, frame by frame, and the comparison with the truth."""

import contextlib
import csv
import json
import math
import statistics
from array import array
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from aqualvs.errors import SourceError, check_commas
from aqualvs.geometry.arrays import FloatArray
from aqualvs.nets.target_file import NetCheck
from aqualvs.results.agreement import LaserAgreement
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.scan import Scan
from aqualvs.text import count_text

Row: TypeAlias = dict[str, str | None]

RANGE_UNITS = {"range_m": 1.0, "range_mm": 1e-3}
"""Names of a column of ranges, and their units in metres."""

_ANGLES = ("pitch_deg", "yaw_deg")
_AGREEMENT = "agreement_"
"""Begin of the names of the agreement's arrays in a stored summary."""
_LIT_PLANE = ("visible_fit_range_mm", "visible_fit_pitch_deg", "visible_fit_yaw_deg")


@dataclass(frozen=True, slots=True)
class Deviation:
    """Root mean square and largest absolute value of a deviation."""

    rms: float
    max: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TruthComparison:
    """Deviation of a run's postures from the truth."""

    n_compared: int  # Frames with a posture and a truth.
    n_missed: int  # Frames with a truth but without a posture.
    # NaN where no frame is compared.
    range_percent: Deviation  # Of the range, in percent of the true range.
    # In degrees.
    pitch_deg: Deviation
    yaw_deg: Deviation
    doubt: str = ""  # Why the truth may be that of another dive.

    def lines(self) -> list[str]:
        """Return the comparison as lines of text."""
        return [*self._lines(), *([f"warning: {self.doubt}"] if self.doubt else [])]

    def _lines(self) -> list[str]:
        if not self.n_compared and not self.n_missed:
            return ["against the truth: it states no posture in any of its frames"]
        if not self.n_compared:
            return [f"against the truth: no posture in its {count_text(self.n_missed, 'frame')}"]
        return [
            f"against the truth in {count_text(self.n_compared, 'frame')} "
            f"({self.n_missed} with truth but without posture):",
            f"  range  rms {self.range_percent.rms:.3f} %   max {self.range_percent.max:.3f} %",
            f"  pitch  rms {self.pitch_deg.rms:.3f} deg max {self.pitch_deg.max:.3f} deg",
            f"  yaw    rms {self.yaw_deg.rms:.3f} deg max {self.yaw_deg.max:.3f} deg",
        ]


def compare_with_truth(posture_csv: Path, truth_csv: Path) -> TruthComparison:
    """Compare the valid postures of a run with the truth of the same frames, as of `read_truth`.

    Raises `SourceError` if a file cannot be read, lacks a column, or no frame is in both. A truth
    without any posture, as of empty water, is of all dives.
    """
    measured_rows, true_rows = _rows(posture_csv), _rows(truth_csv)
    in_fields, of_fields = ("field" in rows[0] for rows in (measured_rows, true_rows))
    if of_fields and not in_fields:
        raise SourceError(
            f"{truth_csv}: of the fields of an interlaced camera, but the run took whole pictures; "
            "set camera.shutter in the rig file to kind: interlaced"
        )
    measured = _postures(posture_csv, measured_rows)
    truth = _truth(truth_csv, true_rows)
    frames = {_number(row["frame"]) for row in measured_rows}
    known = {frame for frame in truth if frame in frames}
    if truth and not known:
        raise SourceError(
            f"{truth_csv}: covers {count_text(len(truth), 'frame')}, none of them in "
            f"{posture_csv}; give the truth of this dive"
        )
    common = sorted(measured.keys() & known)
    got, true = (
        np.array([postures[frame] for frame in common]).reshape(-1, 3)
        for postures in (measured, truth)
    )
    error = got - true
    return TruthComparison(
        n_compared=len(common),
        n_missed=len(known) - len(common),
        range_percent=_deviation(100 * error[:, 0] / true[:, 0]),
        pitch_deg=_deviation(error[:, 1]),
        yaw_deg=_deviation(error[:, 2]),
        doubt=_other_times(truth_csv, _times_s(true_rows), posture_csv, _times_s(measured_rows)),
    )


def read_truth(path: Path) -> dict[int, tuple[float, float, float]]:
    """Return range (m), pitch and yaw (deg) by frame, of rows where all are finite.

    `path`: columns `frame`, `range_m` or `range_mm`, `pitch_deg`, `yaw_deg`. Where a row has
    `visible_fit_range_mm`, `visible_fit_pitch_deg` and `visible_fit_yaw_deg` as well, these count:
    the plane through what the lasers light. Light falls on the front of a net's twine, a radius
    before the net's own plane. Other columns are ignored. Raises `SourceError` if the file cannot
    be read or lacks a column.
    """
    return _truth(path, _rows(path))


def _truth(path: Path, rows: list[Row]) -> dict[int, tuple[float, float, float]]:
    """Return what `read_truth` reads, from rows of a file."""
    found = _postures(path, rows)
    if found:
        check_range_unit(path, rows[0], max(value for value, _, _ in found.values()))
    return found


def _times_s(rows: Sequence[Row]) -> dict[int, float]:
    """Return the times by frame, of rows that have both."""
    pairs = ((_number(row["frame"]), _number(row.get("time_s"))) for row in rows)
    return {int(frame): time_s for frame, time_s in pairs if math.isfinite(frame + time_s)}


def _other_times(
    truth_csv: Path, true_s: Mapping[int, float], posture_csv: Path, own_s: Mapping[int, float]
) -> str:
    """Return where frames of a truth are half a frame before or after a run's, "" if nowhere."""
    common = sorted(true_s.keys() & own_s.keys())
    if len(common) < 2:
        return ""
    frames = np.array(common)
    true, own = (np.array([times[i] for i in common]) for times in (true_s, own_s))
    # A clock that began elsewhere is no fault, nor is one that runs so much faster: a rate of
    # 29.97 is often called 30.
    same_rate = 0.005
    true, own = true - true[0], own - own[0]
    frame_s = float(np.median(np.diff(own) / np.diff(frames)))
    off = np.flatnonzero(np.abs(true - own) > 0.5 * frame_s + same_rate * np.abs(own))
    if not len(off):
        return ""
    i = off[0]
    return (
        f"{truth_csv}: frame {frames[i]} is {true[i]:.3f} s after frame {frames[0]}, but "
        f"{own[i]:.3f} s in {posture_csv}; is it the truth of this dive, or does the run of "
        "images lack --fps?"
    )


def check_range_unit(path: Path, first: Row, range_m: float) -> None:
    """Raise `SourceError` where metres are in millimetres' place, or the other way round.

    `first`: row to show. `range_m`: a typical range by the name of its column.
    """
    # No camera sees as near, or as far.
    nearest, farthest = 0.02, 50.0
    if not nearest < range_m < farthest:
        own_column = range_column(path, first)
        raise SourceError(
            f"{path}: {own_column} is {first[own_column]} in the first row, which is another "
            "unit; name the column range_m for metres, range_mm for millimetres"
        )


def _postures(path: Path, rows: list[Row]) -> dict[int, tuple[float, float, float]]:
    """Return range, pitch and yaw by frame, from rows of a file."""
    own_column = range_column(path, rows[0])
    found = {}
    for row in rows:
        frame = _number(row["frame"])
        lit = [_number(row.get(name)) for name in _LIT_PLANE]
        values, unit = [_number(row[name]) for name in (own_column, *_ANGLES)], own_column
        if all(map(math.isfinite, lit)):
            values, unit = lit, "range_mm"
        if all(map(math.isfinite, [frame, *values])):
            if int(frame) in found:
                raise SourceError(f"{path}: has frame {int(frame)} twice; keep one row of it")
            found[int(frame)] = (values[0] * RANGE_UNITS[unit], values[1], values[2])
    return found


def _rows(path: Path) -> list[Row]:
    """Return the rows of a file that has the columns of `read_truth`, at least one."""
    try:
        # Excel begins a file in UTF-8 with a byte order mark.
        with path.open(newline="", encoding="utf-8-sig") as file:
            table = csv.DictReader(file)
            check_commas(table.fieldnames or (), path, SourceError)
            rows = list(table)
    except OSError as fault:
        raise SourceError(f"{path}: cannot be read ({fault.strerror}); check the path") from fault
    except (UnicodeDecodeError, csv.Error) as fault:
        raise SourceError(f"{path}: not a CSV file in UTF-8; save it as one") from fault
    if not rows:
        raise SourceError(f"{path}: holds no rows; give a CSV with one row for every frame")
    for name in ("frame", *_ANGLES):
        if name not in rows[0]:
            raise SourceError(f"{path}: no column {name}; name it in the first line")
    return rows


def range_column(path: Path, row: Row) -> str:
    """Return which of `RANGE_UNITS` a row of a file has.

    Raises `SourceError` if it has none.
    """
    found = next((name for name in RANGE_UNITS if name in row), None)
    if found is None:
        raise SourceError(f"{path}: no column range_m or range_mm; name it in the first line")
    return found


def _number(text: str | None) -> float:
    try:
        return float(text or "nan")
    except ValueError:
        return math.nan


def _deviation(values: FloatArray) -> Deviation:
    if not len(values):
        return Deviation(rms=math.nan, max=math.nan)
    return Deviation(rms=float(np.sqrt(np.mean(values**2))), max=float(np.abs(values).max()))


@dataclass(slots=True)
class RunSummary:
    """Statistics over the frames of a run: refusals, ranges, agreement of the lasers, the net.

    Summaries of consecutive parts of a dive add up to that of the dive: `save` and `extend`.
    """

    refused: Counter[str] = field(default_factory=Counter)  # Frames without posture, by reason.
    # The first of these frames with a detail in words: its index, and the words.
    examples: dict[str, tuple[int, str]] = field(default_factory=dict)
    # Metres, one for each frame; NaN without a posture.
    ranges: "array[float]" = field(default_factory=lambda: array("d"))
    # Monitor of the lasers, if they are monitored.
    agreement: LaserAgreement | None = None
    # Comparison of the net with the target file's, if the file describes one.
    net_check: NetCheck | None = None
    # Of the source and the rig, before anything is measured.
    warnings: list[str] = field(default_factory=list)

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.ranges)

    @property
    def n_valid(self) -> int:
        """Number of frames with a posture."""
        return self.n_frames - self.refused.total()

    def add(self, scan: Scan) -> None:
        """Add one frame."""
        if self.agreement is not None:
            self.agreement.add(scan)
        if self.net_check is not None:
            self.net_check.add(scan)
        if isinstance(scan.posture, Posture):
            self.ranges.append(scan.posture.range)
        else:
            reason = scan.posture.reason.value
            self.refuse(reason)
            if scan.posture.detail:
                self.examples.setdefault(reason, (scan.index, scan.posture.detail))

    def refuse(self, reason: str) -> None:
        """Add a frame without a posture."""
        self.ranges.append(math.nan)
        self.refused[reason] += 1

    def example(self) -> str:
        """Return a refusal for the commonest reason in words; empty if none has a detail."""
        for reason, _ in self.refused.most_common(1):
            if reason in self.examples:
                index, detail = self.examples[reason]
                return f"frame {index}, {reason}: {detail}"
        return ""

    def save(self, path: Path) -> None:
        """Write the summary of a part of a dive to a file, in NumPy's npz format.

        Raises `OSError` as the system says it.
        """
        refusals = json.dumps([self.refused, self.examples])
        stored = {"ranges": np.asarray(self.ranges), "refusals": np.array(refusals)}
        if self.agreement is not None:
            stored |= {_AGREEMENT + key: value for key, value in self.agreement.arrays().items()}
        if self.net_check is not None:
            stored["bars"] = np.asarray(self.net_check.bars)
        np.savez(path, allow_pickle=False, **stored)

    def extend(self, path: Path) -> None:
        """Add the frames of a part of the dive, as `save` has written them.

        Raises `OSError` or `ValueError` if the file cannot be read.
        """
        with np.load(path) as file:
            stored: dict[str, NDArray[Any]] = {name: file[name] for name in file.files}
        self.ranges.extend(stored["ranges"].tolist())
        refused, examples = json.loads(str(stored["refusals"]))
        self.refused.update(refused)
        for reason, (index, detail) in examples.items():
            self.examples.setdefault(reason, (index, detail))
        if self.agreement is not None:
            n = len(_AGREEMENT)
            arrays = {key[n:]: value for key, value in stored.items() if key[:n] == _AGREEMENT}
            self.agreement.extend(arrays)
        if self.net_check is not None:
            self.net_check.bars.extend(stored["bars"].tolist())

    def _known_ranges(self) -> list[float]:
        return [one for one in self.ranges if not math.isnan(one)]

    def to_dict(self) -> dict[str, Any]:
        """Return the summary for `run.yaml`; ranges are absent where no frame is valid."""
        found: dict[str, Any] = {"n_frames": self.n_frames, "n_valid": self.n_valid}
        if self.n_frames:
            found["valid_share"] = round(self.n_valid / self.n_frames, 4)
        if ranges := self._known_ranges():
            found["range_median_m"] = round(statistics.median(ranges), 6)
            found["range_min_m"] = round(min(ranges), 6)
            found["range_max_m"] = round(max(ranges), 6)
        if self.refused:
            found["refused"] = dict(self.refused.most_common())
        if example := self.example():
            found["refused_example"] = example
        if self.agreement is not None:
            found["laser_agreement"] = self.agreement.verdict().to_dict()
        if self.net_check is not None:
            found["net_check"] = self.net_check.to_dict()
        if self.warnings:
            found["warnings"] = list(self.warnings)
        return found

    def lines(self) -> list[str]:
        """Return the summary as lines of text."""
        if not self.n_frames:
            return ["no frame was measured"]
        share = 100 * self.n_valid / self.n_frames
        text = [
            f"posture in {self.n_valid} of {count_text(self.n_frames, 'frame')} ({share:.1f} %)"
        ]
        if ranges := self._known_ranges():
            low, high, middle = min(ranges), max(ranges), statistics.median(ranges)
            text.append(f"range {middle:.3f} m (median), from {low:.3f} to {high:.3f} m")
        if self.refused:
            counts = (f"{n} {reason}" for reason, n in self.refused.most_common())
            text.append(f"no posture: {', '.join(counts)}")
        if example := self.example():
            text.append(f"  {example}")
        sentence = self.agreement and self.agreement.verdict().sentence()
        about_net = self.net_check and self.net_check.sentence()
        text += [words for words in (sentence, about_net) if words]
        return text + [f"warning: {words}" for words in self.warnings]


def summary_of(posture_csv: Path) -> RunSummary:
    """Gather the summary of a run from its `posture.csv`; damaged and cut rows are left out."""
    summary = RunSummary()
    with (
        posture_csv.open(newline="", encoding="ascii", errors="replace") as file,
        contextlib.suppress(csv.Error),
    ):
        for row in csv.DictReader(file):
            if row.get("n_water") is None:
                continue
            if row.get("valid") == "1":
                with contextlib.suppress(ValueError):
                    summary.ranges.append(float(row.get("range_m") or math.nan))
            else:
                summary.refuse(str(row.get("reason")))
    return summary
