"""Common coordinates (u, d) on a net for all dives, and a raster of its wall.

u is in metres. Around a round net it is radius times bearing, on which dives agree up to the error
of their compasses. Along a flat net that faces one way it is the distance from where each dive
began. d is the depth in metres. The raster cells record what a dive passed over, looked at, and
found.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.net_survey.surveys import Survey

# A round net shows in how its bearing grows along the way (as in `nets.places`).
_MIN_TURN, _MIN_AGREEMENT = np.deg2rad(5.0), 0.9
_MIN_KNOWN = 3
# Flat nets are the same side of a pen if they face the same way up to a compass's error.
_FLAT_SPREAD, _SAME_SIDE = np.deg2rad(10.0), np.deg2rad(25.0)
# Own error of a place within a dive, in metres: at least that of bearing and depth.
_MIN_SIGMA_U, _SIGMA_D = 0.05, 0.05
_MAD = 1.4826


@dataclass(frozen=True, slots=True)
class WallFrame:
    """Meaning of the coordinate u on a wall: around a round net, or along a flat one.

    Attributes
    ----------
    round : bool
        Around a round net, else along a flat one.
    radius : float
        Metres; 0 for a flat net.
    sign : float
        -1 where bearings fall to the right: the net is seen from outside.
    """

    round: bool
    radius: float = 0.0
    sign: float = 1.0

    @property
    def period(self) -> float:
        """Metres around the net; infinite along a flat one."""
        return 2.0 * np.pi * self.radius if self.round else np.inf


@dataclass(frozen=True, slots=True)
class PlacedSurvey:
    """A dive's stretches (K, only usable ones) and holes (H) in a common frame.

    Attributes
    ----------
    survey : Survey
    rows : int array, shape (K,)
        Which stretches of the survey.
    outline : array, shape (K, 4, 2)
        u and d.
    holes : array, shape (H, 2)
        u and d.
    sigma : array, shape (2,)
        Error of a place within the dive.
    """

    survey: Survey
    rows: IntArray
    outline: FloatArray
    holes: FloatArray
    sigma: FloatArray

    @property
    def solidity(self) -> FloatArray:
        """Of the stretches."""
        return np.asarray(self.survey.stretches.solidity[self.rows])


def common_frame(surveys: Sequence[Survey]) -> tuple[WallFrame | None, str]:
    """Return what the dives' places have in common.

    Returns
    -------
    frame : WallFrame or None
        None where places cannot be compared.
    why : str
        Then in words; "" otherwise.
    """
    known = [one for one in surveys if has_places(one)]
    if len({one.date for one in known}) < 2:
        return None, (
            "depth and bearing are known on fewer than two dates; add the vehicles' logs: "
            "aqualvs net RUN --log LOG --overwrite"
        )
    radii = [radius for radius in map(_radius, known) if radius is not None]
    if radii:
        radius = float(np.median(radii))
        if np.any(np.sign(radii) != np.sign(radius)):
            return None, "some dives see the net from inside, others from outside; compare alike"
        return WallFrame(True, abs(radius), float(np.sign(radius))), ""
    facing = np.array([_facing(one) for one in known])
    off = np.angle(np.exp(1j * (facing - facing[0])))
    if np.all(np.isfinite(facing)) and np.ptp(off) < _SAME_SIDE and not _untracked(known):
        return WallFrame(False), ""
    return None, (
        "the net shows no roundness (its bearing does not grow along the way), and the dives do "
        "not all face one flat side of it"
    )


def place_survey(survey: Survey, frame: WallFrame) -> PlacedSurvey:
    """Lay a dive into a common frame; its stretches without place or solidity are left out."""
    one = survey.stretches
    good = one.usable & np.isfinite(one.depth)
    if frame.round:
        good &= np.isfinite(one.bearing)
    rows = np.flatnonzero(good)
    middle = frame.radius * one.bearing[rows] if frame.round else one.along[rows]
    outline = one.outline[rows].copy()
    if survey.by_bearing:
        outline[..., 0] = frame.radius * np.deg2rad(outline[..., 0])
    elif frame.round:
        off = outline[..., 0] - one.along[rows, None]
        outline[..., 0] = middle[:, None] + frame.sign * off
    outline[..., 1] *= -1.0
    sigma = np.array([_bearing_noise(survey, rows, frame), _SIGMA_D])
    return PlacedSurvey(survey, rows, outline, _holes(survey, frame), sigma)


def has_places(survey: Survey) -> bool:
    """Return whether depth and bearing are known for enough of a dive."""
    one = survey.stretches
    known = np.isfinite(one.depth) & np.isfinite(one.bearing) & one.usable
    return survey.by_depth and int(np.count_nonzero(known)) >= _MIN_KNOWN


def _radius(survey: Survey) -> float | None:
    """Return metres along the net per radian of bearing; None where it shows no roundness."""
    one = survey.stretches
    known = np.flatnonzero(np.isfinite(one.bearing) & one.placed)
    if len(known) < _MIN_KNOWN or survey.by_bearing:
        return None
    turn, along = np.unwrap(one.bearing[known]), one.along[known]
    turn, along = turn - turn.mean(), along - along.mean()
    spread = float(np.sqrt(turn @ turn * (along @ along)))
    if np.std(turn) < _MIN_TURN or abs(turn @ along) < _MIN_AGREEMENT * spread:
        return None
    return float(turn @ along) / float(turn @ turn)


def _facing(survey: Survey) -> float:
    """Return the one bearing of a flat net; NaN where there is none."""
    bearing = survey.stretches.bearing
    known = bearing[np.isfinite(bearing)]
    mean = np.exp(1j * known).mean()
    off = np.angle(np.exp(1j * known) / mean)
    return float(np.angle(mean)) if np.std(off) < _FLAT_SPREAD else np.nan


def _untracked(surveys: Sequence[Survey]) -> bool:
    return any(not one.stretches.placed.all() for one in surveys)


def _bearing_noise(survey: Survey, rows: IntArray, frame: WallFrame) -> float:
    """Return how far bearing and track part from one stretch to the next, in metres."""
    one = survey.stretches
    if not frame.round or survey.by_bearing or len(rows) < _MIN_KNOWN:
        return _MIN_SIGMA_U if not frame.round else max(_MIN_SIGMA_U, np.deg2rad(1.0))
    off = frame.radius * np.unwrap(one.bearing[rows]) - frame.sign * one.along[rows]
    step = np.diff(off)
    return float(max(_MAD * np.median(np.abs(step - np.median(step))) / np.sqrt(2.0), 0.05))


def _holes(survey: Survey, frame: WallFrame) -> FloatArray:
    """Return u and d of the holes: as far from the stretch that they are in as the track says."""
    holes, one = survey.holes, survey.stretches
    if not len(holes.number):
        return np.empty((0, 2))
    u = holes.along
    if frame.round:
        u = frame.radius * holes.bearing
        known = np.flatnonzero(np.isfinite(one.bearing) & one.placed)
        if len(known):
            inside = np.searchsorted(one.begin_s[known], holes.time_s, side="right") - 1
            mine = known[np.maximum(inside, 0)]
            off = frame.sign * (holes.along - one.along[mine])
            u = frame.radius * one.bearing[mine] + off
    return np.stack([u, holes.depth], axis=-1)


# Places in a stretch along and across, so that none of the raster is left out between them.
_DENSE, _LEAST, _MOST = 1.5, 4, 48


@dataclass(frozen=True, slots=True)
class Raster:
    """Squares on the wall.

    Attributes
    ----------
    low : array, shape (2,)
        Least u and d.
    size : array, shape (2,)
        Of a square; round a net it goes round it in whole squares.
    shape : (int, int)
        Squares along u and d.
    periodic : bool
        Whether u goes round.
    """

    low: FloatArray
    size: FloatArray
    shape: tuple[int, int]
    periodic: bool

    @classmethod
    def over(cls, low: FloatArray, high: FloatArray, side: float, frame: WallFrame) -> "Raster":
        """Cover a rectangle with squares of about a side; their edges are multiples of it."""
        size = np.array([side, side])
        first = np.floor(low / size)
        count = np.maximum(np.ceil(high / size) - first, 1.0)
        if frame.round:
            count[0] = max(round(frame.period / side), 1)
            size[0], first[0] = frame.period / count[0], 0.0
        return cls(first * size, size, (int(count[0]), int(count[1])), frame.round)

    @property
    def n(self) -> int:
        """Number of squares."""
        return self.shape[0] * self.shape[1]

    def index(self, places: FloatArray) -> IntArray:
        """Return the squares (...) in which places (..., 2) are; -1 where in none."""
        i = np.floor((places - self.low) / self.size)
        column, row = i[..., 0], i[..., 1]
        if self.periodic:
            column = np.mod(column, self.shape[0])
        # Comparisons with what is not a number are false.
        inside = (column >= 0) & (column < self.shape[0]) & (row >= 0) & (row < self.shape[1])
        found = np.where(inside, column * self.shape[1] + row, -1.0)
        return np.asarray(found.astype(np.int64))

    def middle(self, index: IntArray) -> FloatArray:
        """Return the middles (..., 2) of squares."""
        column, row = np.divmod(index, self.shape[1])
        return np.asarray(self.low + (np.stack([column, row], axis=-1) + 0.5) * self.size)


def spread_over(outline: FloatArray, side: float, share: float = 1.0) -> FloatArray:
    """Return places (K, n, 2) that fill outlines (K, 4, 2) evenly.

    Parameters
    ----------
    outline : array, shape (K, 4, 2)
        Corners in turn, beginning with an edge along the way.
    side : float
        Places are no farther apart than this, unless the outline is very large.
    share : float
        Of the width across the way, about the middle.
    """
    if not len(outline):
        return np.empty((0, 1, 2))
    edge = np.linalg.norm(outline - np.roll(outline, 1, axis=1), axis=-1).max(initial=side)
    n = int(np.clip(np.ceil(_DENSE * edge / side), _LEAST, _MOST))
    at = (np.arange(n) + 0.5) / n
    s, t = (one.ravel() for one in np.meshgrid(at, 0.5 + share * (at - 0.5)))
    weights = np.stack([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t], axis=-1)
    return np.asarray(np.einsum("nc,kcx->knx", weights, outline))


def looked_at(one: PlacedSurvey, raster: Raster) -> BoolArray:
    """Mark the squares (n,) where a dive's lasers looked for holes."""
    places = spread_over(one.outline, float(raster.size.min()), one.survey.lasers_share)
    found = np.zeros(raster.n, np.bool_)
    index = raster.index(places).ravel()
    found[index[index >= 0]] = True
    return found


def wrapped(off: FloatArray, frame: WallFrame) -> FloatArray:
    """Return differences (..., 2) the short way round the net."""
    if not frame.round:
        return off
    found = off.copy()
    half = 0.5 * frame.period
    found[..., 0] = np.mod(found[..., 0] + half, frame.period) - half
    return found
