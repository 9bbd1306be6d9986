"""Where each laser's stripe runs in one frame, in a few robust numbers, whatever its label.

A laser that has drifted leaves the target's plane, and its points are then labelled as clutter or
as another surface; here they count all the same.
"""

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import kernel
from aqualvs.scanning.scan import ScanPoints

N_BINS = 12
"""Pieces of a stripe, from one border of the picture to the other."""

# Points farther from the target's plane than this share of the range belong to something else: two
# degrees of a laser are a quarter of the range at worst.
_GATE = 0.4
# In a piece, points within three times the typical scatter of the median are the stripe, but no
# fewer than those within the first of these shares of the range and no more than the second.
_NEAR, _FAR = 0.003, 0.02
_SCATTER = 4.4  # three sigmas in median absolute deviations
_MIN_POINTS = 4
_MIN_SHARE = 0.6


def bin_stripes(
    points: ScanPoints, m: FloatArray, along_x: IntArray, size_px: tuple[int, int]
) -> FloatArray:
    """Return the middle of the light in each piece of each laser's stripe.

    Parameters
    ----------
    points : ScanPoints
        Of one frame.
    m : array, shape (3,)
        The target's plane m·X = 1 in `dome`, roughly.
    along_x : int array, shape (L,)
        1 for lasers whose stripe is searched along x, and so runs along y.
    size_px : (int, int)
        Image width and height.

    Returns
    -------
    array, shape (L, N_BINS, 2)
        In `image`; NaN where a piece shows no stripe, or too much beside it.
    """
    middle = np.full((len(along_x), N_BINS, 2), np.nan)
    _bin_stripes(
        points.laser,
        points.pixels,
        points.points_in_dome,
        points.intensity,
        points.width,
        m,
        along_x,
        float(size_px[0]),
        float(size_px[1]),
        middle,
    )
    return middle


@kernel
def _bin_stripes(
    laser: NDArray[np.int8],
    pixels: FloatArray,
    points: FloatArray,
    intensity: FloatArray,
    width: FloatArray,
    m: FloatArray,
    along_x: IntArray,
    size_x: float,
    size_y: float,
    middle: FloatArray,
) -> None:
    n = laser.shape[0]
    n_cells = middle.shape[0] * N_BINS
    cell, off = np.empty(n, np.int64), np.empty(n)
    start = np.zeros(n_cells + 1, np.int64)
    for i in range(n):
        a = laser[i]
        off[i] = m[0] * points[i, 0] + m[1] * points[i, 1] + m[2] * points[i, 2] - 1.0
        share = pixels[i, 1] / size_y if along_x[a] else pixels[i, 0] / size_x
        piece = min(max(int(share * N_BINS), 0), N_BINS - 1)
        cell[i] = a * N_BINS + piece if abs(off[i]) < _GATE else -1
        if cell[i] >= 0:
            start[cell[i] + 1] += 1
    for c in range(n_cells):
        start[c + 1] += start[c]
    order, fill = np.empty(start[n_cells], np.int64), start[:-1].copy()
    for i in range(n):
        if cell[i] >= 0:
            order[fill[cell[i]]] = i
            fill[cell[i]] += 1
    for c in range(n_cells):
        rows = order[start[c] : start[c + 1]]
        if rows.shape[0] >= _MIN_POINTS:
            _middle(rows, off, pixels, intensity, width, middle[c // N_BINS, c % N_BINS])


@kernel
def _middle(
    rows: IntArray,
    off: FloatArray,
    pixels: FloatArray,
    intensity: FloatArray,
    width: FloatArray,
    out: FloatArray,
) -> None:
    """Write the middle of the light of those points that lie together."""
    values = off[rows]
    median = np.median(values)
    near_by = min(max(_SCATTER * np.median(np.abs(values - median)), _NEAR), _FAR)
    total, x, y = 0.0, 0.0, 0.0
    near = 0
    for i in rows:
        if abs(off[i] - median) < near_by:
            light = intensity[i] * width[i]
            near += 1
            total += light
            x += light * pixels[i, 0]
            y += light * pixels[i, 1]
    if near >= _MIN_POINTS and near >= _MIN_SHARE * rows.shape[0]:
        out[0], out[1] = x / total, y / total
