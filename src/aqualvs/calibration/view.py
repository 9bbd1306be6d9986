"""What one picture of a target says: known points of the target and the pixels they are seen at."""

from dataclasses import dataclass, replace

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class View:
    """Points of one target, found in one picture.

    Attributes
    ----------
    name : str
        File name of the picture, for messages and reports.
    ids : int array, shape (N,)
        Which point of the target: corner of a board, or four times the index of a marker plus the
        corner's place.
    points : array, shape (N, 3)
        The points in the target's own frame (`board`, `box`, or `dome` for an index target), in
        metres.
    pixels : array, shape (N, 2)
        Where they were found, in `image`.
    notes : tuple of str
        What a user should know of how they were found.
    """

    name: str
    ids: IntArray
    points: FloatArray
    pixels: FloatArray
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.ids)

    @property
    def middle(self) -> FloatArray:
        """Mean (3,) of the points, which small turns of the target leave in its place."""
        middle: FloatArray = np.add.reduce(self.points) / len(self.points)
        return middle

    def where(self, keep: BoolArray) -> "View":
        """Return the points that `keep` (N,) marks."""
        return replace(self, ids=self.ids[keep], points=self.points[keep], pixels=self.pixels[keep])
