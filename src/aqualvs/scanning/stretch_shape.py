"""The shape of single stretches of light: straight, bent smoothly, or as high as they are wide.

A flank of a fish bends the stripe in one smooth sweep; a face of a box keeps it straight, and its
edge breaks it; a bubble is a spot.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel, kernel
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
# What is summed over a stretch: powers 0 to 4 of the place, its moments, and squares.
_MOMENTS, _SQUARES, _N_SUMS = 5, 8, 9


class StretchShapes(NamedTuple):
    """What stretches look like, one row a stretch number.

    Attributes
    ----------
    n_lines : array, shape (S,)
        Search lines in it.
    sagitta_px : array, shape (S,)
        Height of its bend over its chord, as a shift of the stripe; 0 where it is too short to have
        a shape.
    rough_px : array, shape (S,)
        Root mean square of what a parabola leaves, likewise.
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
        return self._those(is_bent)

    def curved(self) -> BoolArray:
        """Tell which are no straight lines, whatever the cause: not on a plane."""
        return self._those(is_curved)

    def straight(self) -> BoolArray:
        """Tell which are long and straight, as on a plane."""
        return self._those(is_straight)

    def round(self, bright: float) -> BoolArray:
        """Tell which are spots of at least nearly the height `bright`."""
        return self._those(lambda shapes, s: is_round(shapes, s, bright))

    def _those(self, asked: Callable[["StretchShapes", int], bool]) -> BoolArray:
        return np.array([asked(self, s) for s in range(len(self.n_lines))], np.bool_)


@inline_borrowing_kernel
def is_bent(shapes: StretchShapes, s: int) -> bool:
    """Tell whether stretch s is bent smoothly, as the flank of a fish."""
    sagitta_px = shapes.sagitta_px[s]
    smooth = shapes.rough_px[s] < _ROUGH_PX + _ROUGH_SHARE * sagitta_px
    bent = sagitta_px > _LEAST_SAGITTA_PX and smooth
    return bool(shapes.n_lines[s] >= _LEAST_LINES and bent)


@inline_borrowing_kernel
def is_curved(shapes: StretchShapes, s: int) -> bool:
    """Tell whether stretch s is no straight line, whatever the cause: not on a plane."""
    return bool(shapes.n_lines[s] >= _LEAST_LINES and shapes.sagitta_px[s] > _CURVED_PX)


@inline_borrowing_kernel
def is_straight(shapes: StretchShapes, s: int) -> bool:
    """Tell whether stretch s is long and straight, as on a plane."""
    is_long = shapes.n_lines[s] >= 2 * _LEAST_LINES
    return bool(is_long and shapes.sagitta_px[s] <= _LEAST_SAGITTA_PX)


@inline_borrowing_kernel
def is_round(shapes: StretchShapes, s: int, bright: float) -> bool:
    """Tell whether stretch s is a spot of at least nearly the height `bright`."""
    n_lines = shapes.n_lines[s]
    ratio = n_lines / max(shapes.thickness[s], 1.0)
    spot = _ROUND_FROM <= ratio <= _ROUND_TO and n_lines >= _SPOT_LINES
    small = shapes.size[s] < _LARGEST_SPOT
    return bool(spot and small and shapes.height[s] >= _GLINT_SHARE * bright)


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
    return StretchShapes(*describe_stretches(stretch, line, points, sensitivity, width, height))


@kernel
def describe_stretches(
    stretch: IntArray,
    line: IntArray,
    points: FloatArray,
    sensitivity: FloatArray,
    width: FloatArray,
    height: FloatArray,
) -> FloatArray:
    """Do as `stretch_shapes`; the answer is a table, shape (6, S)."""
    n = 0
    for i in range(stretch.shape[0]):
        n = max(n, stretch[i] + 1)
    table = np.zeros((6, n))
    shapes = StretchShapes(table[0], table[1], table[2], table[3], table[4], table[5])
    first, last = np.full(n, -1), np.full(n, -1)
    _measure_stretches(stretch, line, width, height, shapes, first, last)
    chord = np.empty((n, 3))
    for s in range(n):
        if shapes.n_lines[s] == 0.0:
            continue
        shapes.thickness[s] /= shapes.n_lines[s]
        shapes.height[s] /= shapes.n_lines[s]
        square = 0.0
        for k in range(3):
            chord[s, k] = points[last[s], k] - points[first[s], k]
            square += chord[s, k] * chord[s, k]
        shapes.size[s] = np.sqrt(square)
    _fit_parabolas(stretch, points, sensitivity, first, chord, shapes)
    return table


@inline_borrowing_kernel
def run_end(numbers: IntArray, begin: int) -> int:
    """Return where those readings end that have the same number and stand together from `begin`."""
    end, number = begin + 1, numbers[begin]
    while end < numbers.shape[0] and numbers[end] == number:
        end += 1
    return end


@borrowing_kernel
def _measure_stretches(
    stretch: IntArray,
    line: IntArray,
    width: FloatArray,
    height: FloatArray,
    shapes: StretchShapes,
    first: IntArray,
    last: IntArray,
) -> None:
    """Sum lines, widths and heights, and find the readings at the ends."""
    begin = 0
    while begin < stretch.shape[0]:
        s, end = stretch[begin], run_end(stretch, begin)
        widths, heights = 0.0, 0.0
        low, high = begin, begin
        for i in range(begin, end):
            widths += width[i]
            heights += height[i]
            low = i if line[i] < line[low] else low
            high = i if line[i] > line[high] else high
        if first[s] < 0 or line[low] < line[first[s]]:
            first[s] = low
        if last[s] < 0 or line[high] > line[last[s]]:
            last[s] = high
        shapes.n_lines[s] += end - begin
        shapes.thickness[s] += widths
        shapes.height[s] += heights
        begin = end


@kernel
def _fit_parabolas(
    stretch: IntArray,
    points: FloatArray,
    sensitivity: FloatArray,
    first: IntArray,
    chord: FloatArray,
    shapes: StretchShapes,
) -> None:
    """Fit a parabola over the chord of each stretch that is long enough to have a shape."""
    n = shapes.n_lines.shape[0]
    sums = np.zeros((n, _N_SUMS))
    begin = 0
    while begin < stretch.shape[0]:
        s, end = stretch[begin], run_end(stretch, begin)
        if shapes.n_lines[s] >= _LEAST_LINES and shapes.size[s] > 0.0:
            _add_powers(
                points, sensitivity, begin, end, first[s], chord[s], shapes.size[s], sums[s]
            )
        begin = end
    normal, inverse, parabola = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for s in range(n):
        if sums[s, 0] == 0.0:
            continue
        moments = sums[s, _MOMENTS:]
        for j in range(3):
            for k in range(3):
                normal[j, k] = sums[s, j + k]
        if solve_symmetric(normal, moments, inverse, parabola):
            shapes.sagitta_px[s] = 0.25 * abs(parabola[2])
            explained = 0.0
            for k in range(3):
                explained += parabola[k] * moments[k]
            left = max(sums[s, _SQUARES] - explained, 0.0)
            shapes.rough_px[s] = np.sqrt(left / shapes.n_lines[s])


@inline_borrowing_kernel
def _add_powers(
    points: FloatArray,
    sensitivity: FloatArray,
    begin: int,
    end: int,
    first: int,
    chord: FloatArray,
    length: float,
    sums: FloatArray,
) -> None:
    """Add the powers of the places along a chord, 0 to 1, and their products with those beside it.

    Places beside the chord are in pixels.
    """
    scale = 1.0 / length
    ex, ey, ez = chord[0] * scale, chord[1] * scale, chord[2] * scale
    ax, ay, az = points[first, 0], points[first, 1], points[first, 2]
    p1, p2, p3, p4, m0, m1, m2, squares = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(begin, end):
        x, y, z = points[i, 0] - ax, points[i, 1] - ay, points[i, 2] - az
        jx, jy, jz = sensitivity[i, 0], sensitivity[i, 1], sensitivity[i, 2]
        along = ex * x + ey * y + ez * z
        slope = ex * jx + ey * jy + ez * jz
        across_x, across_y, across_z = jx - slope * ex, jy - slope * ey, jz - slope * ez
        product = (
            across_x * (x - along * ex) + across_y * (y - along * ey) + across_z * (z - along * ez)
        )
        square = across_x * across_x + across_y * across_y + across_z * across_z
        beside = product / square if square > 0.0 else 0.0
        t = along * scale
        tt = t * t
        p1, p2, p3, p4 = p1 + t, p2 + tt, p3 + t * tt, p4 + tt * tt
        m0, m1, m2 = m0 + beside, m1 + t * beside, m2 + tt * beside
        squares += beside * beside
    sums[0] += end - begin
    sums[1] += p1
    sums[2] += p2
    sums[3] += p3
    sums[4] += p4
    sums[_MOMENTS] += m0
    sums[_MOMENTS + 1] += m1
    sums[_MOMENTS + 2] += m2
    sums[_SQUARES] += squares
