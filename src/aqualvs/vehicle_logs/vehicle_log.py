"""A vehicle's log of its own motion: signals over time, and position and bearing at dive times."""

import datetime
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.planes import normals_of

_TURN = 2.0 * math.pi


class Interpolation(StrEnum):
    """Interpolation of a signal between its samples."""

    LINEAR = "linear"
    """Linear."""
    ANGLE = "angle"
    """Linear along the shorter arc; results are in (-pi, pi]."""
    BEARING = "bearing"
    """As ANGLE, but results are in [0, 2 pi)."""


@dataclass(frozen=True, slots=True)
class Signal:
    """A quantity with its own time stamps."""

    time_s: FloatArray  # Shape (n,): log time, strictly increasing; n is at least 1.
    values: FloatArray  # Shape (n,): finite; SI units and radians.
    interpolation: Interpolation  # Between samples.
    max_gap_s: float  # Values between samples further apart than this are not valid.

    @classmethod
    def from_samples(
        cls,
        time_s: ArrayLike,
        values: ArrayLike,
        interpolation: Interpolation = Interpolation.LINEAR,
    ) -> Self | None:
        """Make a signal from samples in the order of the file; None if no sample is usable.

        Samples that are not finite are left out, and so are those whose time is not later than
        that of all samples before them.
        """
        times, found = np.asarray(time_s, float), np.asarray(values, float)
        finite = np.isfinite(times) & np.isfinite(found)
        times, found = times[finite], found[finite]
        if not len(times):
            return None
        later = np.ones(len(times), bool)
        later[1:] = times[1:] > np.maximum.accumulate(times)[:-1]
        times, found = times[later], found[later]
        # Single lost messages are common: a gap is longer than so many usual steps, and than half a
        # second, in which the motion of a vehicle under water hardly changes.
        gap_steps, shortest_gap_s = 4.0, 0.5
        usual_s = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        return cls(times, found, interpolation, max(gap_steps * usual_s, shortest_gap_s))

    def at(self, time_s: ArrayLike) -> tuple[FloatArray, BoolArray]:
        """Return the values (m,) at other log times (m,), in any order, and where they are valid.

        Before the first sample, after the last one and inside a gap they are NaN and not valid.
        """
        times = np.atleast_1d(np.asarray(time_s, float))
        last = len(self.time_s) - 1
        before = np.clip(np.searchsorted(self.time_s, times, side="right") - 1, 0, last)
        after = np.minimum(before + 1, last)
        start, end = self.time_s[before], self.time_s[after]
        inside = (times > start) & (times < end) & (end - start <= self.max_gap_s)
        valid = inside | (times == start) | (times == end)
        share = np.where(inside, (times - start) / np.where(end > start, end - start, 1.0), 0.0)
        # `before` is the sample itself where the times agree, because of side="right".
        step = self.values[after] - self.values[before]
        if self.interpolation is not Interpolation.LINEAR:
            step = wrap(step)
        values = self.values[before] + share * step
        if self.interpolation is Interpolation.ANGLE:
            values = wrap(values)
        elif self.interpolation is Interpolation.BEARING:
            values = bearing_of(values)
        values[~valid] = np.nan
        return values, valid


Found: TypeAlias = tuple[Signal | None, str]
"""A signal, None if the log does not have it, and the message or record, and field, it is from."""


def utc_seconds(text: str) -> float:
    """Return a time in ISO 8601 as seconds since 1970; UTC if it has no time zone.

    Raises `ValueError` for any other text.
    """
    moment = datetime.datetime.fromisoformat(text)
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=datetime.UTC)
    return moment.timestamp()


NETWORK_UTC_SIGMA_S = 2.0
"""Standard deviation of clocks that are set by the network; an upper limit."""
FIRST_BELIEVED_UTC_S = utc_seconds("1990-01-01")
"""Earliest plausible UTC: clocks that were never set begin in 1904, 1970 or 1980."""


def wrap(angle: FloatArray) -> FloatArray:
    """Return the equivalent angles in (-pi, pi]."""
    return math.pi - np.mod(math.pi - angle, _TURN)


def bearing_of(angle: FloatArray) -> FloatArray:
    """Return the equivalent angles in [0, 2 pi)."""
    turned = np.mod(angle, _TURN)
    # A tiny negative angle rounds up to a full turn.
    return np.where(turned >= _TURN, 0.0, turned)


@dataclass(frozen=True, slots=True, kw_only=True)
class LoggedStates:
    """State of the vehicle at some times; NaN and False where the log has no value."""

    time_s: FloatArray  # Shape (n,): log time.
    # Shape (n,): metres, positive down; radians, heading in [0, 2 pi).
    depth: FloatArray
    heading: FloatArray
    roll: FloatArray
    pitch: FloatArray
    # Shape (n,): where the log has them.
    depth_valid: BoolArray
    heading_valid: BoolArray
    roll_valid: BoolArray
    pitch_valid: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleLog:
    """A vehicle's log: signals on one clock, each with its own time stamps."""

    name: str  # In messages: the file's path.
    kind: str  # 'csv', 'tlog' (MAVLink telemetry), 'dataflash' or 'dataflash text'.
    depth: Signal | None = None  # Metres below the surface, positive down.
    # Radians clockwise from the vehicle's north, in [0, 2 pi).
    heading: Signal | None = None
    # Radians, MAVLink's axes (forward, right, down): roll is positive with the right side down,
    # pitch with the nose up.
    roll: Signal | None = None
    pitch: Signal | None = None
    # UTC (seconds since 1970) of log time 0, and its standard deviation; None if unknown.
    start_utc_s: float | None = None
    start_utc_sigma_s: float | None = None
    # By signal: message or record, and field, that it was read from.
    sources: Mapping[str, str] = field(default_factory=dict)
    # Faults of the file, one line each: truncation, corrupt sections, clock steps.
    notes: tuple[str, ...] = ()

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last log time of any signal; both NaN for a log without signals."""
        signals = (self.depth, self.heading, self.roll, self.pitch)
        times = [one.time_s for one in signals if one is not None] or [np.array([np.nan])]
        return float(min(one[0] for one in times)), float(max(one[-1] for one in times))

    def at(self, time_s: ArrayLike) -> LoggedStates:
        """Return the vehicle's state at other times; values in gaps are not valid.

        `time_s`, shape (n,): log time, in any order.
        """
        times = np.atleast_1d(np.asarray(time_s, float))
        nothing = np.full(len(times), np.nan), np.zeros(len(times), bool)
        found: dict[str, Any] = {}
        for name in ("depth", "heading", "roll", "pitch"):
            signal = getattr(self, name)
            values, valid = nothing if signal is None else signal.at(times)
            found |= {name: values, f"{name}_valid": valid}
        return LoggedStates(time_s=times, **found)


def log_of(
    path: Path,
    kind: str,
    found: Mapping[str, Found],
    *,
    start_utc_s: float | None,
    start_utc_sigma_s: float | None,
    notes: tuple[str, ...],
    utc_source: str = "",
) -> VehicleLog:
    """Return the log of signals with their sources, by name; `utc_source` is that of its UTC."""
    known = {name: pair for name, pair in found.items() if pair[0] is not None}
    signals: dict[str, Any] = {name: signal for name, (signal, _) in known.items()}
    sources = {name: source for name, (_, source) in known.items()}
    if utc_source:
        sources["start_utc_s"] = utc_source
    return VehicleLog(
        name=str(path),
        kind=kind,
        sources=sources,
        start_utc_s=start_utc_s,
        start_utc_sigma_s=start_utc_sigma_s,
        notes=notes,
        **signals,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Places:
    """Vehicle and net in `world` at some dive times; NaN where not valid."""

    time_s: FloatArray  # Shape (n,): dive time.
    depth: FloatArray  # Shape (n,): of the vehicle's depth sensor, in metres, positive down.
    # Shape (n,): of the dome's y axis, radians clockwise from north, in [0, 2 pi).
    heading: FloatArray
    # Shape (n,): compass direction of the net's far normal, the direction of view square to the
    # net, radians in [0, 2 pi). Inside a round cage it gives the position along the wall.
    bearing: FloatArray
    # Shape (n,): elevation of the far normal, radians: 0 for a vertical net, positive if the net's
    # top leans towards the vehicle. Needs the vehicle's roll and pitch.
    lean: FloatArray
    # Shape (n,): where the values are known.
    depth_valid: BoolArray
    heading_valid: BoolArray
    bearing_valid: BoolArray
    lean_valid: BoolArray
    # Shape (n, 3, 3): rotations from `dome` to `world` (north, east, down). The depth of a point in
    # `dome` is `depth + (ned_from_dome @ p_in_dome)[2]`, if the lever arm between the depth sensor
    # and the dome is neglected. NaN where the heading is not known.
    ned_from_dome: FloatArray
    # Shape (n,): where roll or pitch is not known, so that the vehicle is assumed level in
    # `ned_from_dome` and `bearing`.
    level: BoolArray


@dataclass(frozen=True, slots=True)
class VehiclePlaces:
    """Log of a dive with the offset of their clocks, evaluated at dive times."""

    log: VehicleLog  # The vehicle's log.
    offset_s: float = 0.0  # Log time = dive time + offset_s.

    def __post_init__(self) -> None:
        if not np.isfinite(self.offset_s):
            raise OptionError(
                f"{self.log.name}: time offset is {self.offset_s}; give a number of seconds"
            )

    def at(
        self, time_s: ArrayLike, yaw: ArrayLike, pitch: ArrayLike, valid: ArrayLike | None = None
    ) -> Places:
        """Return depth, heading and orientation of vehicle and net at dive times.

        Parameters
        ----------
        time_s : array, shape (n,)
            Dive time.
        yaw, pitch : array, shape (n,)
            Posture to the net (paper, Eq. 24-26) at those times.
        valid : bool array, shape (n,), optional
            Where the posture is valid; wherever it is finite, if left out.

        Notes
        -----
        The far normal is (tan yaw, 1, tan pitch) in `dome`, up to its length. Level, its bearing
        is heading + yaw: yaw is positive when the far normal points to the right, headings grow
        clockwise. Roll and pitch of the vehicle are taken into account where the log has them.
        """
        times = np.atleast_1d(np.asarray(time_s, float))
        state = self.log.at(times + self.offset_s)
        level = ~(state.roll_valid & state.pitch_valid)
        ned_from_dome = ned_from_dome_of(
            state.heading, np.where(level, 0.0, state.pitch), np.where(level, 0.0, state.roll)
        )
        across, up = (np.broadcast_to(np.asarray(a, float), len(times)) for a in (yaw, pitch))
        posture_valid = np.isfinite(across) & np.isfinite(up)
        if valid is not None:
            posture_valid &= np.broadcast_to(np.asarray(valid, bool), len(times))
        normal_in_ned = np.einsum("nij,nj->ni", ned_from_dome, normals_of(up, across))
        north, east, down = normal_in_ned.T
        horizontal = np.hypot(north, east)
        seen = posture_valid & state.heading_valid
        # A vertical normal has no bearing.
        min_horizontal = 0.05
        bearing_valid = seen & (horizontal > min_horizontal)
        lean_valid = seen & ~level
        return Places(
            time_s=times,
            depth=state.depth,
            heading=state.heading,
            bearing=np.where(bearing_valid, bearing_of(np.arctan2(east, north)), np.nan),
            lean=np.where(lean_valid, np.arctan2(-down, horizontal), np.nan),
            depth_valid=state.depth_valid,
            heading_valid=state.heading_valid,
            bearing_valid=bearing_valid,
            lean_valid=lean_valid,
            ned_from_dome=ned_from_dome,
            level=level,
        )


def ned_from_dome_of(heading: ArrayLike, pitch: ArrayLike, roll: ArrayLike) -> FloatArray:
    """Return rotations from `dome` (right, forward, up) to north, east, down.

    The angles are the vehicle's, shape (n,), in radians, as in MAVLink's ATTITUDE: heading
    clockwise from north, pitch positive with the nose up, roll positive with the right side down;
    applied in the order roll, pitch, heading. The result has shape (n, 3, 3).
    """
    turn, nod, tilt = np.broadcast_arrays(*(np.asarray(a, float) for a in (heading, pitch, roll)))
    ch, sh, cp, sp = np.cos(turn), np.sin(turn), np.cos(nod), np.sin(nod)
    cr, sr = np.cos(tilt), np.sin(tilt)
    forward = np.stack([ch * cp, sh * cp, -sp], axis=-1)
    right = np.stack([ch * sp * sr - sh * cr, sh * sp * sr + ch * cr, cp * sr], axis=-1)
    down = np.stack([ch * sp * cr + sh * sr, sh * sp * cr - ch * sr, cp * cr], axis=-1)
    return np.stack([right, forward, -down], axis=-1)
