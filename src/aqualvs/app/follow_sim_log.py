"""What a simulated loop did, frame by frame, with the truth beside it."""

import csv
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from aqualvs.app.disk import writing
from aqualvs.geometry.arrays import FloatArray

NEUTRAL_WITHIN_S = 0.2
"""Without a valid posture for so long there must be no thrust."""


class LoopRow(NamedTuple):
    """The state at one frame's exposure; SI units and radians, NaN where nothing is known.

    Attributes
    ----------
    time_s : float
    range, pitch, yaw, along, up : float
        In truth, as `NetPosture`.
    clearance : float
        Least distance between hull and net.
    tilt : float
        Angle between the vehicle's upright and the plumb line.
    measured_range, measured_pitch, measured_yaw : float
        By the lasers in this frame.
    filtered_range, filtered_yaw : float
        From the time filter, as known by now.
    wanted_range, wanted_yaw, sway : float
        What the mission asks for.
    forward, right, down, turn : float
        The last effort sent.
    depth, heading : float
        As the vehicle tells.
    engaged : bool
    stage, reason, refusal : str
        Of the mission; why the effort was changed; why there is no posture.
    """

    time_s: float
    range: float
    pitch: float
    yaw: float
    along: float
    up: float
    clearance: float
    tilt: float
    measured_range: float
    measured_pitch: float
    measured_yaw: float
    filtered_range: float
    filtered_yaw: float
    wanted_range: float
    wanted_yaw: float
    sway: float
    forward: float
    right: float
    down: float
    turn: float
    depth: float
    heading: float
    engaged: bool
    stage: str
    reason: str
    refusal: str


@dataclass(slots=True)
class LoopLog:
    """All rows, and how long thrust outlived the sight of the net.

    Attributes
    ----------
    rows : list of LoopRow
    blind_thrust_s : list of float
        For each stretch of more than `NEUTRAL_WITHIN_S` without a valid posture into which thrust
        reached: time from the last valid posture to neutral.
    n_blind : int
        Such stretches, with or without thrust.
    """

    rows: list[LoopRow] = field(default_factory=list)
    blind_thrust_s: list[float] = field(default_factory=list)
    n_blind: int = 0
    _neutral_s: float = math.inf

    def column(self, name: str) -> FloatArray:
        """Return one column of numbers, shape (n,)."""
        return np.array([getattr(row, name) for row in self.rows], dtype=np.float64)

    def note_neutral(self, seen_s: float, now_s: float) -> None:
        """Take in that thrust ended, at a time after the last valid posture."""
        self._neutral_s = now_s - seen_s

    def note_sight(self, seen_s: float, now_s: float, thrusts: bool) -> None:
        """Take in that a valid posture came, when one had come before, and the effort till now."""
        gap = now_s - seen_s
        if NEUTRAL_WITHIN_S < gap < math.inf:
            self.n_blind += 1
            if thrusts or self._neutral_s < math.inf:
                self.blind_thrust_s.append(gap if thrusts else self._neutral_s)
        self._neutral_s = math.inf


_UNITS = {
    "time_s": ("time_s", 1.0, 3),
    "along": ("along_m", 1.0, 4),
    "up": ("up_m", 1.0, 4),
    "clearance": ("clearance_m", 1.0, 4),
    "sway": ("sway_m_s", 1.0, 3),
    "depth": ("depth_m", 1.0, 3),
}


def write_log(log: LoopLog, path: Path) -> None:
    """Write the rows as CSV; units are in the names, cells of what is not known are empty.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    columns = [_column(name) for name in LoopRow._fields]
    with writing(path), path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow([name for name, _, _ in columns])
        for row in log.rows:
            cells = zip(row, columns, strict=True)
            table.writerow([_cell(value, factor, digits) for value, (_, factor, digits) in cells])


def _column(name: str) -> tuple[str, float, int]:
    """Return a column's heading, factor and decimals."""
    if name in _UNITS:
        return _UNITS[name]
    if name.endswith("range"):
        return f"{name}_m", 1.0, 4
    if name.endswith(("pitch", "yaw", "heading", "tilt")):
        return f"{name}_deg", 180.0 / math.pi, 3
    if name in {"forward", "right", "down", "turn"}:
        return f"effort_{name}", 1.0, 4
    return name, 1.0, 0


def _cell(value: object, factor: float, digits: int) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return str(int(value))
    number = float(value) if isinstance(value, float) else math.nan
    return f"{factor * number:.{digits}f}" if math.isfinite(number) else ""
