"""One quantity over time, as a vehicle logged it."""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray

IndexArray: TypeAlias = NDArray[np.intp]

_TURN = 2.0 * math.pi
_GAP_STEPS = 4.0
"""A step this many times the usual one is a gap: single messages get lost all the time."""
_SHORTEST_GAP_S = 0.5
"""Within half a second a vehicle under water hardly changes what it does, so no step is a gap."""


class Interpolation(StrEnum):
    """What a signal does between its samples."""

    LINEAR = "linear"
    """Changes evenly."""
    ANGLE = "angle"
    """Changes evenly along the shorter way round; answers lie in (-pi, pi]."""
    BEARING = "bearing"
    """As ANGLE, but answers lie in [0, 2 pi)."""
    HELD = "held"
    """Keeps the value of the last sample."""


@dataclass(frozen=True, slots=True)
class Signal:
    """A quantity with its own time stamps.

    Attributes
    ----------
    time_s : array, shape (n,)
        Log time, strictly increasing; n is at least 1.
    values : array, shape (n,) or (n, k)
        Finite; SI units and radians.
    interpolation : Interpolation
        How values between samples are found.
    max_gap_s : float
        No value is told between samples that are further apart than this.
    """

    time_s: FloatArray
    values: FloatArray
    interpolation: Interpolation
    max_gap_s: float

    @classmethod
    def from_samples(
        cls,
        time_s: ArrayLike,
        values: ArrayLike,
        interpolation: Interpolation = Interpolation.LINEAR,
    ) -> Self | None:
        """Make a signal from samples in the order of the file; None where none is usable.

        Samples that are not finite are left out, and so are those whose time is not later than
        that of all samples before them: such a value has no place on the time axis.
        """
        times, found = np.asarray(time_s, float), np.asarray(values, float)
        if not len(times):
            return None
        finite = np.isfinite(times) & np.isfinite(found.reshape(len(times), -1)).all(axis=1)
        times, found = times[finite], found[finite]
        if not len(times):
            return None
        later = np.ones(len(times), bool)
        later[1:] = times[1:] > np.maximum.accumulate(times)[:-1]
        times, found = times[later], found[later]
        return cls(times, found, interpolation, usual_gap(times))

    @property
    def n_gaps(self) -> int:
        """Number of gaps between the first and the last sample."""
        return int(np.count_nonzero(np.diff(self.time_s) > self.max_gap_s))

    @property
    def rate_hz(self) -> float:
        """Usual rate of the samples; 0 for a single one."""
        steps = np.diff(self.time_s)
        return 1.0 / float(np.median(steps)) if len(steps) else 0.0

    def at(self, time_s: ArrayLike) -> tuple[FloatArray, BoolArray]:
        """Return the values at other times.

        Parameters
        ----------
        time_s : array, shape (m,)
            Log time, in any order.

        Returns
        -------
        values : array, shape (m,) or (m, k)
            NaN where not valid.
        valid : bool array, shape (m,)
            False before the first sample, after the last one and inside a gap.
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
        values = self._between(before, after, share)
        values[~valid] = np.nan
        return values, valid

    def _between(self, before: IndexArray, after: IndexArray, share: FloatArray) -> FloatArray:
        first: FloatArray = self.values[before]
        if self.interpolation is Interpolation.HELD:
            return first.copy()
        step = self.values[after] - first
        if self.interpolation is not Interpolation.LINEAR:
            step = wrap(step)
        between: FloatArray = first + (share if first.ndim == 1 else share[:, None]) * step
        if self.interpolation is Interpolation.ANGLE:
            return wrap(between)
        return bearing_of(between) if self.interpolation is Interpolation.BEARING else between

    def unwrapped(self) -> FloatArray:
        """Return an angle's samples without jumps of a full turn.

        Across a gap the shorter way round is assumed.
        """
        whole: FloatArray = np.unwrap(self.values, axis=0)
        return whole


def usual_gap(time_s: FloatArray) -> float:
    """Return the longest step between increasing times that is not a gap, in seconds."""
    steps = np.diff(time_s)
    usual = float(np.median(steps)) if len(steps) else 0.0
    return max(_GAP_STEPS * usual, _SHORTEST_GAP_S)


def wrap(angle: FloatArray) -> FloatArray:
    """Return angles as their equals in (-pi, pi]."""
    wrapped: FloatArray = math.pi - np.mod(math.pi - angle, _TURN)
    return wrapped


def bearing_of(angle: FloatArray) -> FloatArray:
    """Return angles as their equals in [0, 2 pi)."""
    turned = np.mod(angle, _TURN)
    # A tiny negative angle rounds up to a full turn.
    return np.where(turned >= _TURN, 0.0, turned)
