"""The wall as a raster: what a dive passed over, looked at, and found there."""

from dataclasses import dataclass

import numpy as np

from aqualvs.app.net_change.frames import PlacedSurvey, WallFrame
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray

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
        """How many squares there are."""
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
