"""Log of a simulated loop, frame by frame with the truth, and measures of its performance."""

import csv
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from aqualvs.control.missions import Stage
from aqualvs.control.safety import LimitReason
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.results.files import writing

NEUTRAL_WITHIN_S = 0.2
"""Longest time, in seconds, with thrust but without a valid posture."""


class LoopRow(NamedTuple):
    """State at the exposure of one frame; SI units and radians, NaN for unknown values."""

    time_s: float
    # True values, as in `NetPosture`.
    range: float
    pitch: float
    yaw: float
    along: float
    up: float
    clearance: float  # Least distance between hull and net.
    tilt: float  # Angle between the vehicle's vertical axis and the plumb line.
    # Measured by the lasers in this frame.
    measured_range: float
    measured_pitch: float
    measured_yaw: float
    # Of the time filter at its last update.
    filtered_range: float
    filtered_yaw: float
    # Setpoint of the mission.
    wanted_range: float
    wanted_yaw: float
    sway: float
    # The last effort sent.
    forward: float
    right: float
    down: float
    turn: float
    # As the vehicle reports them.
    depth: float
    heading: float

    engaged: bool
    stage: str  # Of the mission.
    reason: str  # Of the safety gate for changing the effort; empty if it did not.
    refusal: str  # Reason for a missing posture; empty if there is one.


@dataclass(slots=True)
class LoopLog:
    """Rows of all frames, and durations of thrust without sight of the net."""

    rows: list[LoopRow] = field(default_factory=list)
    # For each period of more than `NEUTRAL_WITHIN_S` without a valid posture that began with
    # thrust: time from the last valid posture to neutral.
    blind_thrust_s: list[float] = field(default_factory=list)
    n_blind: int = 0  # Number of such periods, with or without thrust.

    # Time from the last valid posture to neutral in the present period; infinite if not reached.
    _neutral_s: float = math.inf

    def column(self, name: str) -> FloatArray:
        """Return one column of numbers, shape (n,)."""
        return np.array([getattr(row, name) for row in self.rows], dtype=np.float64)

    def note_neutral(self, seen_s: float, now_s: float) -> None:
        """Note that thrust ended now; `seen_s` is the time of the last valid posture."""
        self._neutral_s = now_s - seen_s

    def note_sight(self, seen_s: float, now_s: float, thrusts: bool) -> None:
        """Note a valid posture now.

        `seen_s` is the time of the previous one; `thrusts`: whether there was thrust until now.
        """
        gap = now_s - seen_s
        if NEUTRAL_WITHIN_S < gap < math.inf:
            self.n_blind += 1
            if thrusts or self._neutral_s < math.inf:
                self.blind_thrust_s.append(gap if thrusts else self._neutral_s)
        self._neutral_s = math.inf


# Heading with unit, factor and decimals of columns that `_column` has no rule for.
_UNITS = {
    "time_s": ("time_s", 1.0, 3),
    "along": ("along_m", 1.0, 4),
    "up": ("up_m", 1.0, 4),
    "clearance": ("clearance_m", 1.0, 4),
    "sway": ("sway_m_s", 1.0, 3),
    "depth": ("depth_m", 1.0, 3),
}


def write_log(log: LoopLog, path: Path) -> None:
    """Write the rows as CSV, with units in the column names and empty cells for unknown values.

    Raises `OutputError` if the file cannot be written.
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


SETTLED_SHARE = 0.1
"""A step has settled when the error of the range stays below this share of the step."""
LOST_AFTER_S = 2.5
"""Time without sight, in seconds, after which a human has to take over."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HoldMeasures:
    """Measures of a period with a constant setpoint."""

    # Rms deviation of the true posture from the setpoint, in metres and radians.
    range_rms: float
    yaw_rms: float
    range_worst: float  # Largest deviation of the range, in metres.
    min_clearance: float  # Least distance between hull and net, in metres; negative for contact.
    n_lost: int  # Frames without a posture.
    n_guarded: int  # Frames at which the safety gate changed the effort.


@dataclass(frozen=True, slots=True, kw_only=True)
class StepMeasures:
    """Response to a step of the range."""

    # Seconds until the range stays within `SETTLED_SHARE` of the step; infinite if it never does.
    settling: float
    overshoot: float  # Share of the step by which it is exceeded; 0 if it is not.


@dataclass(frozen=True, slots=True, kw_only=True)
class EffortMeasures:
    """Rates of an effort's reversals and jumps, which wear thrusters and shake the camera."""

    reversals: float  # Changes of sign per minute, not counting neutral in between.
    jumps: float  # Changes by more than `JUMP` from one frame to the next, per minute.


JUMP = 0.25
"""Least change of an effort that counts as a jump: about the width of a dead band."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyMeasures:
    """Safety measures of a whole run."""

    min_clearance: float  # In metres; negative for contact.
    n_blind: int  # Periods of more than `NEUTRAL_WITHIN_S` without a valid posture.
    # Longest time from a last valid posture to neutral, in seconds; 0 without such thrust.
    neutral_late: float
    stable: bool  # True if oscillations of the range do not grow while the net is in sight.
    lost_s: float  # Time at which sight was lost for good; infinite if it was not.
    greatest_tilt: float  # Largest tilt of the vehicle, in radians.

    # Share of frames at which efforts reached the vehicle: engaged and not stopped by the gate.
    steered_share: float

    @property
    def contact(self) -> bool:
        """Whether the hull touched the net."""
        return self.min_clearance <= 0.0


def hold_measures(log: LoopLog, start_s: float, end_s: float = math.inf) -> HoldMeasures:
    """Return the measures of a period; frames without a setpoint are compared with the last one."""
    here = _between(log, start_s, end_s)
    range_error = log.column("range")[here] - _filled(log.column("wanted_range"))[here]
    yaw_error = log.column("yaw")[here] - _filled(log.column("wanted_yaw"))[here]
    rows = [row for row, kept in zip(log.rows, here, strict=True) if kept]
    return HoldMeasures(
        range_rms=_rms(range_error),
        yaw_rms=_rms(yaw_error),
        range_worst=float(np.abs(range_error).max()),
        min_clearance=float(log.column("clearance")[here].min()),
        n_lost=sum(row.refusal != "" for row in rows),
        n_guarded=sum(row.reason != "" for row in rows),
    )


def effort_measures(
    log: LoopLog, name: str, start_s: float = 0.0, end_s: float = math.inf
) -> EffortMeasures:
    """Return the rates of reversals and jumps of an effort between two times.

    `name`: "forward", "right", "down" or "turn".
    """
    return _measured(log, log.column(name), start_s, end_s)


def thruster_measures(log: LoopLog, start_s: float = 0.0) -> EffortMeasures:
    """Return the rates of reversals and jumps of the horizontal thrusters, the worse of two pairs.

    Efforts forward and to the right add up in one pair of vectored thrusters and cancel in the
    other. While the vehicle moves along a target, the pairs push against each other: the small
    forward effort changes sign with the noise, but no thruster reverses.
    """
    forward, right = log.column("forward"), log.column("right")
    one, other = (_measured(log, pair, start_s) for pair in (forward + right, forward - right))
    return EffortMeasures(
        reversals=max(one.reversals, other.reversals), jumps=max(one.jumps, other.jumps)
    )


def _measured(
    log: LoopLog, efforts: FloatArray, start_s: float, end_s: float = math.inf
) -> EffortMeasures:
    here = _between(log, start_s, end_s)
    efforts, time_s = efforts[here], log.column("time_s")[here]
    minutes = max((time_s[-1] - time_s[0]) / 60.0, 1e-9) if len(time_s) else math.inf
    signs = np.sign(efforts)
    reversals = np.count_nonzero(np.diff(signs[signs != 0.0]))
    jumps = np.count_nonzero(np.abs(np.diff(efforts)) > JUMP)
    return EffortMeasures(reversals=reversals / minutes, jumps=jumps / minutes)


def step_measures(
    time_s: FloatArray, ranges: FloatArray, step_s: float, before: float, after: float
) -> StepMeasures:
    """Return settling time and overshoot of a step.

    `time_s`, `ranges`, shape (n,): times in seconds, and true ranges in metres or their mean over
    several runs. `step_s`: when the setpoint changed from `before` to `after`, in metres.
    """
    later = time_s > step_s
    share = (ranges[later] - before) / (after - before)
    outside = np.flatnonzero(np.abs(share - 1.0) > SETTLED_SHARE)
    times = time_s[later] - step_s
    settling = 0.0 if len(outside) == 0 else float(times[outside[-1]])
    if len(outside) and outside[-1] == len(times) - 1:
        settling = math.inf
    return StepMeasures(settling=settling, overshoot=max(0.0, float(share.max()) - 1.0))


def safety_measures(log: LoopLog) -> SafetyMeasures:
    """Return the safety measures of a whole run."""
    seen_s = _last_seen_s(log)
    lost = log.rows[-1].time_s - seen_s > LOST_AFTER_S
    return SafetyMeasures(
        min_clearance=float(log.column("clearance").min()),
        n_blind=log.n_blind,
        neutral_late=max(log.blind_thrust_s, default=0.0),
        stable=_is_stable(log),
        lost_s=seen_s if lost else math.inf,
        greatest_tilt=float(log.column("tilt").max()),
        steered_share=sum(map(_is_steered, log.rows)) / len(log.rows),
    )


def _is_steered(row: LoopRow) -> bool:
    """Return whether an effort of the controllers, or of the gate, reached the vehicle."""
    if not row.engaged or row.stage == "" or Stage(row.stage).halts:
        return False
    return row.reason == "" or LimitReason(row.reason).steers


def _last_seen_s(log: LoopLog) -> float:
    """Return the exposure time of the last valid posture; 0 if there is none."""
    seen = np.flatnonzero(np.isfinite(log.column("measured_range")))
    return float(log.column("time_s")[seen[-1]]) if len(seen) else 0.0


def _is_stable(log: LoopLog) -> bool:
    """Return whether the deviations in the last third of a run do not exceed those in the second.

    Only the time with sight of the net counts.
    """
    # Factor and margin, in metres, by which the rms may increase.
    max_factor, margin = 2.0, 0.05
    error = log.column("range") - _filled(log.column("wanted_range"))
    error = error[log.column("time_s") <= _last_seen_s(log)]
    third = len(error) // 3
    if third == 0 or not np.isfinite(error[-1]):
        return third == 0
    middle, last = _rms(error[third : 2 * third]), _rms(error[2 * third :])
    return last <= max_factor * middle + margin


def _between(log: LoopLog, start_s: float, end_s: float) -> BoolArray:
    time_s = log.column("time_s")
    return (time_s >= start_s) & (time_s <= end_s)


def _filled(values: FloatArray) -> FloatArray:
    """Return values in which NaN is replaced by the last finite value, or else by the first."""
    known = np.isfinite(values)
    if not known.any():
        return values
    last = np.maximum.accumulate(np.where(known, np.arange(len(values)), -1))
    first = int(np.argmax(known))
    return values[np.where(last < 0, first, last)]


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
