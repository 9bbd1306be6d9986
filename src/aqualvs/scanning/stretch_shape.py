"""The shape of single stretches of light: straight, bent smoothly, or as high as they are wide.

A flank of a fish bends the stripe in one smooth sweep; a face of a box keeps it straight, and its
edge breaks it; a bubble is a spot.
"""

from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import inline_borrowing_kernel, kernel
from aqualvs.geometry.symmetric import solve_symmetric

# A bend of this height over its chord is no lens error.
_LEAST_SAGITTA_PX = 1.0
# What may be left over of a smooth bend: a floor, and a share of its height. A corner leaves more.
_ROUGH_PX = 0.3
_ROUGH_SHARE = 0.05
# A bend of this height lies beyond the gate for planes.
_CURVED_PX = 2.0
# Shorter pieces are as short as the light on a strand and have no shape of their own.
_LEAST_LINES = 16
# A spot is as long as it is wide within these factors, and no larger than that.
_ROUND_FROM, _ROUND_TO = 0.5, 2.6
_SPOT_LINES = 4
_LARGEST_SPOT = 0.012
# And it glints: as bright as the frame's bright returns, or nearly.
_GLINT_SHARE = 0.75


class StretchShapes(NamedTuple):
    """What stretches look like, one row a stretch number.

    Attributes
    ----------
    n_lines : array, shape (S,)
        Search lines in it.
    sagitta_px : array, shape (S,)
        Height of its bend over its chord, as a shift of the stripe.
    rough_px : array, shape (S,)
        Root mean square of what a parabola leaves.
    size : array, shape (S,)
        Chord in metres.
    thickness : array, shape (S,)
        Mean width of its returns in search lines.
    height : array, shape (S,)
        Mean height of its returns in grey levels.
    """

    n_lines: FloatArray
    sagitta_px: FloatArray
    rough_px: FloatArray
    size: FloatArray
    thickness: FloatArray
    height: FloatArray

    def bent(self) -> BoolArray:
        """Tell which are bent smoothly, as the flank of a fish."""
        smooth = self.rough_px < _ROUGH_PX + _ROUGH_SHARE * self.sagitta_px
        return (self.n_lines >= _LEAST_LINES) & (self.sagitta_px > _LEAST_SAGITTA_PX) & smooth

    def curved(self) -> BoolArray:
        """Tell which are no straight lines, whatever the cause: not on a plane."""
        return (self.n_lines >= _LEAST_LINES) & (self.sagitta_px > _CURVED_PX)

    def straight(self) -> BoolArray:
        """Tell which are long and straight, as on a plane."""
        return (self.n_lines >= 2 * _LEAST_LINES) & (self.sagitta_px <= _LEAST_SAGITTA_PX)

    def round(self, bright: float) -> BoolArray:
        """Tell which are spots of at least nearly the height `bright`."""
        ratio = self.n_lines / np.maximum(self.thickness, 1.0)
        spot = (ratio >= _ROUND_FROM) & (ratio <= _ROUND_TO) & (self.n_lines >= _SPOT_LINES)
        return spot & (self.size < _LARGEST_SPOT) & (self.height >= _GLINT_SHARE * bright)


def stretch_shapes(
    stretch: IntArray,
    line: IntArray,
    points: FloatArray,
    sensitivity: FloatArray,
    width: FloatArray,
    height: FloatArray,
) -> StretchShapes:
    """Describe the stretches of N readings.

    Parameters
    ----------
    stretch, line, points, sensitivity, width, height
        As in `Readings`.

    Returns
    -------
    StretchShapes
        S rows, one more than the highest stretch number.
    """
    n = int(stretch.max()) + 1 if len(stretch) else 0
    shapes = StretchShapes(*np.zeros((6, n)))
    if n:
        _describe(stretch, line, points, sensitivity, width, height, *shapes)
    return shapes


@inline_borrowing_kernel
def _beside(
    points: FloatArray, sensitivity: FloatArray, i: int, a: int, b: int, length: float
) -> tuple[float, float]:
    """Place of reading i along the chord from a to b (0 to 1), and beside it in pixels."""
    along = 0.0
    slope = 0.0
    for k in range(3):
        e = (points[b, k] - points[a, k]) / length
        along += e * (points[i, k] - points[a, k])
        slope += e * sensitivity[i, k]
    product = 0.0
    square = 0.0
    for k in range(3):
        e = (points[b, k] - points[a, k]) / length
        across = sensitivity[i, k] - slope * e
        product += across * (points[i, k] - points[a, k] - along * e)
        square += across * across
    return along / length, product / square if square > 0.0 else 0.0


@kernel
def _describe(
    stretch: IntArray,
    line: IntArray,
    points: FloatArray,
    sensitivity: FloatArray,
    width: FloatArray,
    height: FloatArray,
    n_lines: FloatArray,
    sagitta_px: FloatArray,
    rough_px: FloatArray,
    size: FloatArray,
    thickness: FloatArray,
    mean_height: FloatArray,
) -> None:
    n = n_lines.shape[0]
    first, last = np.full(n, -1), np.full(n, -1)
    for i in range(stretch.shape[0]):
        s = stretch[i]
        n_lines[s] += 1.0
        thickness[s] += width[i]
        mean_height[s] += height[i]
        if first[s] < 0 or line[i] < line[first[s]]:
            first[s] = i
        if last[s] < 0 or line[i] > line[last[s]]:
            last[s] = i
    for s in range(n):
        if n_lines[s] > 0.0:
            thickness[s] /= n_lines[s]
            mean_height[s] /= n_lines[s]
            for k in range(3):
                size[s] += (points[last[s], k] - points[first[s], k]) ** 2
            size[s] = np.sqrt(size[s])
    powers, moments = np.zeros((n, 5)), np.zeros((n, 3))
    squares = np.zeros(n)
    for i in range(stretch.shape[0]):
        s = stretch[i]
        if size[s] > 0.0:
            t, y = _beside(points, sensitivity, i, first[s], last[s], size[s])
            power = 1.0
            for k in range(5):
                powers[s, k] += power
                if k < 3:
                    moments[s, k] += power * y
                power *= t
            squares[s] += y * y
    normal, inverse, parabola = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for s in range(n):
        if n_lines[s] < 5.0 or size[s] <= 0.0:
            continue
        for j in range(3):
            for k in range(3):
                normal[j, k] = powers[s, j + k]
        if solve_symmetric(normal, moments[s], inverse, parabola):
            sagitta_px[s] = 0.25 * abs(parabola[2])
            explained = 0.0
            for k in range(3):
                explained += parabola[k] * moments[s, k]
            rough_px[s] = np.sqrt(max(squares[s] - explained, 0.0) / n_lines[s])
