"""What a vehicle wrote down of its own motion during a dive."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.live.logs.signals import Signal


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleState:
    """The vehicle at some times; NaN and False where the log does not tell.

    Attributes
    ----------
    time_s : array, shape (n,)
        Log time.
    depth, heading, roll, pitch : array, shape (n,)
        Metres, positive down; radians, heading in [0, 2 pi).
    depth_valid, heading_valid, roll_valid, pitch_valid : bool array, shape (n,)
        Where the log tells them.
    """

    time_s: FloatArray
    depth: FloatArray
    heading: FloatArray
    roll: FloatArray
    pitch: FloatArray
    depth_valid: BoolArray
    heading_valid: BoolArray
    roll_valid: BoolArray
    pitch_valid: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleLog:
    """A vehicle's log: signals on one clock, each with its own time stamps.

    Attributes
    ----------
    name : str
        How messages call it: the file's path.
    kind : str
        'csv', 'tlog' (MAVLink telemetry), 'dataflash' or 'dataflash text'.
    depth : Signal or None
        Metres below the surface, positive down.
    heading : Signal or None
        Radians clockwise from north as the vehicle knows it, in [0, 2 pi).
    roll, pitch : Signal or None
        Radians, MAVLink's axes (forward, right, down): roll is positive with the right side down,
        pitch with the nose up.
    velocity_ned : Signal or None
        North, east and down, in m/s.
    armed : Signal or None
        1 while the thrusters could turn, else 0.
    modes : tuple of (float, str)
        Log time of each change of the flight mode, and the new mode.
    start_utc_s : float or None
        UTC (seconds since 1970) of log time 0, where the log knows it.
    start_utc_sigma_s : float or None
        How far to trust it.
    sources : mapping of str to str
        Signal to what in the file it was read from, and why where there was a choice.
    notes : tuple of str
        What is wrong with the file, one line each: cut short, corrupt stretches, clock steps.
    """

    name: str
    kind: str
    depth: Signal | None = None
    heading: Signal | None = None
    roll: Signal | None = None
    pitch: Signal | None = None
    velocity_ned: Signal | None = None
    armed: Signal | None = None
    modes: tuple[tuple[float, str], ...] = ()
    start_utc_s: float | None = None
    start_utc_sigma_s: float | None = None
    sources: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def signals(self) -> dict[str, Signal]:
        """The continuous signals that the log has, by name."""
        named = {
            "depth": self.depth,
            "heading": self.heading,
            "roll": self.roll,
            "pitch": self.pitch,
            "velocity_ned": self.velocity_ned,
        }
        return {name: signal for name, signal in named.items() if signal is not None}

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last log time of any signal; both NaN for a log without signals."""
        found = list(self.signals.values())
        if not found:
            return float("nan"), float("nan")
        return (
            float(min(signal.time_s[0] for signal in found)),
            float(max(signal.time_s[-1] for signal in found)),
        )

    def at(self, time_s: ArrayLike) -> VehicleState:
        """Return the vehicle's state at other times; nothing is told across gaps.

        Parameters
        ----------
        time_s : array, shape (n,)
            Log time, in any order.
        """
        times = np.atleast_1d(np.asarray(time_s, float))
        depth, depth_valid = _at(self.depth, times)
        heading, heading_valid = _at(self.heading, times)
        roll, roll_valid = _at(self.roll, times)
        pitch, pitch_valid = _at(self.pitch, times)
        return VehicleState(
            time_s=times,
            depth=depth,
            heading=heading,
            roll=roll,
            pitch=pitch,
            depth_valid=depth_valid,
            heading_valid=heading_valid,
            roll_valid=roll_valid,
            pitch_valid=pitch_valid,
        )

    def mode_at(self, time_s: float) -> str | None:
        """Return the flight mode at a log time; None before the first that is known."""
        known = [mode for since, mode in self.modes if since <= time_s]
        return known[-1] if known else None


def _at(signal: Signal | None, times: FloatArray) -> tuple[FloatArray, BoolArray]:
    if signal is None:
        return np.full(len(times), np.nan), np.zeros(len(times), bool)
    return signal.at(times)
