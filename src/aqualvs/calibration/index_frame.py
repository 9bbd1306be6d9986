"""What an index estimate takes of a picture."""

from dataclasses import dataclass, replace

import numpy as np

from aqualvs.calibration.view import View
from aqualvs.geometry.arrays import BoolArray, FloatArray

MIN_POINTS = 4
"""Corners that a frame needs: with fewer, a bad one cannot be told from a good one."""

MOST_POINTS = 64
"""Corners beyond these would cost time and add little."""


@dataclass(frozen=True, slots=True)
class Frame:
    """Corners of one picture that the estimate can use.

    Attributes
    ----------
    time : float
        In seconds.
    ids : tuple of int
        Corners.
    points : array, shape (M, 3)
        Where `target.yaml` has them, in `dome`, metres.
    pixels : array, shape (M, 2)
        Where they were found.
    """

    time: float
    ids: tuple[int, ...]
    points: FloatArray
    pixels: FloatArray

    @classmethod
    def of(cls, time: float, view: View, known: tuple[int, ...] = ()) -> "Frame":
        """Return the finite corners of a view, at most `MOST_POINTS` with those that are known."""
        finite = np.all(np.isfinite(view.pixels), axis=1) & np.all(np.isfinite(view.points), axis=1)
        _, first = np.unique(view.ids, return_index=True)
        once = np.zeros(len(view), np.bool_)
        once[first] = True
        old = once & finite & np.isin(view.ids, known)
        new = np.flatnonzero(once & finite & ~old)
        room = min(len(new), max(MOST_POINTS - len(known), 0))
        keep = np.flatnonzero(old).tolist()
        if room:
            keep += new[np.linspace(0, len(new) - 1, room).astype(int)].tolist()
        ids = tuple(int(view.ids[i]) for i in keep)
        return cls(time, ids, view.points[keep], view.pixels[keep])

    def where(self, keep: BoolArray) -> "Frame":
        """Return the corners that `keep` (M,) marks."""
        ids = tuple(i for i, kept in zip(self.ids, keep, strict=True) if kept)
        return replace(self, ids=ids, points=self.points[keep], pixels=self.pixels[keep])
