"""Posture against truth."""

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aqualvs.errors import SourceError
from aqualvs.geometry.arrays import FloatArray

_RANGE_UNITS = {"range_m": 1.0, "range_mm": 1e-3}
_LIT_PLANE = ("visible_fit_range_mm", "visible_fit_pitch_deg", "visible_fit_yaw_deg")


@dataclass(frozen=True, slots=True)
class Deviation:
    """Root mean square and largest absolute value of a deviation."""

    rms: float
    max: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TruthComparison:
    """How far the postures of a run are from the truth.

    Attributes
    ----------
    n_compared : int
        Frames with a posture and a truth.
    n_missed : int
        Frames with a truth but without a posture.
    range_percent : Deviation
        Of the range, in percent of the true range.
    pitch_deg, yaw_deg : Deviation
        In degrees.
    """

    n_compared: int
    n_missed: int
    range_percent: Deviation
    pitch_deg: Deviation
    yaw_deg: Deviation

    def lines(self) -> list[str]:
        """Return the comparison in words."""
        return [
            f"against the truth in {self.n_compared} frames "
            f"({self.n_missed} with truth but without posture):",
            f"  range  rms {self.range_percent.rms:.3f} %   max {self.range_percent.max:.3f} %",
            f"  pitch  rms {self.pitch_deg.rms:.3f} deg max {self.pitch_deg.max:.3f} deg",
            f"  yaw    rms {self.yaw_deg.rms:.3f} deg max {self.yaw_deg.max:.3f} deg",
        ]


def compare_with_truth(posture_csv: Path, truth_csv: Path) -> TruthComparison:
    """Compare the valid postures of a run with the truth of the same frames.

    Parameters
    ----------
    posture_csv : Path
        As a run writes it.
    truth_csv : Path
        As `read_truth` takes it.

    Raises
    ------
    SourceError
        If a file cannot be read, lacks a column, or no frame is in both.
    """
    measured = read_truth(posture_csv)
    truth = read_truth(truth_csv)
    common = sorted(measured.keys() & truth.keys())
    if not common:
        raise SourceError(
            f"{truth_csv}: none of its {len(truth)} frames has a posture in {posture_csv}; "
            "give the truth of this dive"
        )
    got = np.array([measured[frame] for frame in common])
    true = np.array([truth[frame] for frame in common])
    error = got - true
    return TruthComparison(
        n_compared=len(common),
        n_missed=len(truth.keys() & _frames(posture_csv)) - len(common),
        range_percent=_deviation(100 * error[:, 0] / true[:, 0]),
        pitch_deg=_deviation(error[:, 1]),
        yaw_deg=_deviation(error[:, 2]),
    )


def read_truth(path: Path) -> dict[int, tuple[float, float, float]]:
    """Return range (m), pitch and yaw (deg) by frame, of rows where all are finite.

    Parameters
    ----------
    path : Path
        Columns `frame`, `range_m` or `range_mm`, `pitch_deg`, `yaw_deg`. Where a row has
        `visible_fit_range_mm`, `visible_fit_pitch_deg` and `visible_fit_yaw_deg` as well, these
        count: the plane through what the lasers light. Light falls on the front of a net's twine,
        a radius before the net's own plane. Other columns are ignored.

    Raises
    ------
    SourceError
        If the file cannot be read or lacks a column.
    """
    rows = _rows(path)
    range_column = _range_column(path, rows)
    unit = _RANGE_UNITS[range_column]
    found = {}
    for row in rows:
        frame = _number(row["frame"])
        lit = [_number(row.get(name)) for name in _LIT_PLANE]
        values = [_number(row[name]) for name in (range_column, "pitch_deg", "yaw_deg")]
        if all(map(math.isfinite, lit)):
            values, scale = lit, _RANGE_UNITS["range_mm"]
        else:
            scale = unit
        if all(map(math.isfinite, [frame, *values])):
            found[int(frame)] = (values[0] * scale, values[1], values[2])
    return found


def _frames(path: Path) -> set[int]:
    numbers = (_number(row["frame"]) for row in _rows(path))
    return {int(number) for number in numbers if math.isfinite(number)}


def _rows(path: Path) -> list[dict[str, str | None]]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))
    except OSError as fault:
        raise SourceError(f"{path}: cannot be read ({fault.strerror}); check the path") from fault
    except (UnicodeDecodeError, csv.Error) as fault:
        raise SourceError(f"{path}: not a CSV file; check the path") from fault


def _range_column(path: Path, rows: list[dict[str, str | None]]) -> str:
    """Return the range column, after a check that the others are there as well."""
    if not rows:
        raise SourceError(f"{path}: holds no rows; give a CSV with one row for every frame")
    columns = rows[0].keys()
    for name in ("frame", "pitch_deg", "yaw_deg"):
        if name not in columns:
            raise SourceError(f"{path}: no column {name}; name it in the first line")
    for name in _RANGE_UNITS:
        if name in columns:
            return name
    raise SourceError(f"{path}: no column range_m or range_mm; name it in the first line")


def _number(text: str | None) -> float:
    try:
        return float(text or "nan")
    except ValueError:
        return math.nan


def _deviation(values: FloatArray) -> Deviation:
    return Deviation(rms=float(np.sqrt(np.mean(values**2))), max=float(np.abs(values).max()))
