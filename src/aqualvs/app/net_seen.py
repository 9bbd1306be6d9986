"""What the vehicle's log says of the net that a dive looked at, moment by moment."""

from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.live.logs import PostureTrack, VehiclePlaces

# What belongs to a moment is averaged over so many seconds before and after it.
_MOMENT_S = 0.5


@dataclass(frozen=True, slots=True)
class DivePostures:
    """Postures to the net over a dive, N of them, all valid.

    Attributes
    ----------
    time_s : array, shape (N,)
        Dive time, increasing.
    range, pitch, yaw : array, shape (N,)
        Metres and radians.
    """

    time_s: FloatArray
    range: FloatArray
    pitch: FloatArray
    yaw: FloatArray

    def track(self) -> PostureTrack:
        """Return them as the search for a log's time offset takes them."""
        return PostureTrack(self.time_s, self.yaw, self.pitch, np.isfinite(self.range))

    def normals(self) -> FloatArray:
        """Return the net's far unit normals in `dome`, shape (N, 3)."""
        along = np.stack([np.tan(self.yaw), np.ones(len(self.yaw)), np.tan(self.pitch)], axis=-1)
        normals: FloatArray = along / np.linalg.norm(along, axis=-1, keepdims=True)
        return normals


@dataclass(frozen=True, slots=True)
class Seen:
    """The net at the moments of a dive's postures; NaN where not known.

    Attributes
    ----------
    time_s : array, shape (N,)
        Dive time.
    foot_depth : array, shape (N,)
        Depth of the foot of the perpendicular on the net, in metres.
    net, nose : array, shape (N,)
        Bearing of the net and heading of the vehicle, in radians.
    lean : array, shape (N,)
        Elevation of the net's far normal, in radians; a level vehicle is assumed where the log
        does not know better.
    """

    time_s: FloatArray
    foot_depth: FloatArray
    net: FloatArray
    nose: FloatArray
    lean: FloatArray

    @classmethod
    def of(cls, postures: DivePostures, vehicle: VehiclePlaces | None) -> "Seen":
        """Look a dive's postures up in the log."""
        normals = postures.normals()
        level = np.arctan2(normals[:, 2], np.hypot(normals[:, 0], normals[:, 1]))
        if vehicle is None:
            nothing = np.full(len(postures.time_s), np.nan)
            return cls(postures.time_s, nothing, nothing, nothing, level)
        at = vehicle.at(postures.time_s, postures.yaw, postures.pitch)
        lean = np.where(at.lean_valid, at.lean, level)
        depth = np.where(at.depth_valid, at.depth, np.nan) - postures.range * np.sin(lean)
        net = np.where(at.bearing_valid, at.bearing, np.nan)
        nose = np.where(at.heading_valid, at.heading, np.nan)
        return cls(postures.time_s, depth, net, nose, lean)

    def upright(self) -> float:
        """Return plumb metres per metre up in the net's plane."""
        return float(np.cos(np.median(self.lean))) if len(self.lean) else 1.0

    def depths(self, times: FloatArray) -> FloatArray:
        """Return the depth of the foot at some times."""
        return np.array([_mean(self._at(self.foot_depth, t, t)) for t in times])

    def bearings(self, times: FloatArray) -> FloatArray:
        """Return the bearing of the net at some times, in [0, 2 pi)."""
        return np.array([_direction(self._at(self.net, t, t)) for t in times])

    def bearing(self, begin_s: float, end_s: float | None = None) -> float | None:
        """Return the net's mean bearing around a moment, or over a time; None if not known."""
        return _or_none(_direction(self._at(self.net, begin_s, end_s)))

    def heading(self, begin_s: float, end_s: float | None = None) -> float | None:
        """Return the vehicle's mean heading around a moment, or over a time; None if not known."""
        return _or_none(_direction(self._at(self.nose, begin_s, end_s)))

    def _at(self, values: FloatArray, begin_s: float, end_s: float | None) -> FloatArray:
        """Return what is known between two times, or around the first."""
        last = begin_s if end_s is None else end_s
        found = values[
            slice(*np.searchsorted(self.time_s, (begin_s - _MOMENT_S, last + _MOMENT_S)))
        ]
        return np.asarray(found[np.isfinite(found)])


def _mean(values: FloatArray) -> float:
    return float(values.mean()) if len(values) else np.nan


def _direction(angles: FloatArray) -> float:
    """Return the mean of directions in [0, 2 pi); NaN without any."""
    if not len(angles):
        return np.nan
    return float(np.arctan2(np.sin(angles).mean(), np.cos(angles).mean())) % (2.0 * np.pi)


def _or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None
