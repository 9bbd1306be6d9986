"""Straight lines among stripe points on one flat surface: where laser planes cut it."""

from dataclasses import dataclass

import numpy as np

from aqualvs.calibration.stripes_on_planes import PooledStripes
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray

# Points this near to a line, in pixels across their stripe, belong to it.
_TOLERANCE_PX = 2.0
# Points this near are taken away with it: the halo of a stripe is no second one.
_HALO_PX = 6.0
# A point's stripe runs along the line to within this tangent, as seen in the image.
_ALIGNED = 0.35
_MIN_POINTS = 12
_MIN_LENGTH_PX = 20.0
_MAX_LINES = 40
_N_GUESSES, _N_SAMPLED, _N_FITS = 800, 600, 3


@dataclass(frozen=True, slots=True)
class StripeLine:
    """A straight stripe on a surface.

    Attributes
    ----------
    patch : int
        Which surface of which view.
    members : int array, shape (M,)
        Indices of its points among those of all patches.
    """

    patch: int
    members: IntArray


def lines_on_patch(pooled: PooledStripes, members: IntArray, patch: int) -> list[StripeLine]:
    """Find the straight stripes among points of one surface.

    Parameters
    ----------
    pooled : PooledStripes
        Points of all patches.
    members : int array, shape (M,)
        Which points lie on the surface.
    patch : int
        Its number.

    Returns
    -------
    list of StripeLine
        The longest first; no point belongs to two.
    """
    placed, normal = pooled.placed, pooled.patch_planes[patch].normal
    points, across = placed.points_in_dome[members], placed.by_across[members]
    along = placed.by_along[members]
    some = slice(None, None, -(-len(members) // _N_SAMPLED) or 1)
    i, j = _pairs(pooled.chain[members], patch)
    guessed, offsets = _guesses(points, normal, i, j)
    # Most pairs are of two stripes, which do not run along the line through both points.
    good = _runs_along(across[i], along[i], guessed) & _runs_along(across[j], along[j], guessed)
    guessed, offsets = guessed[good], offsets[good]
    votes = _near(points[some], across[some], along[some], guessed, offsets, _TOLERANCE_PX)
    counts = np.count_nonzero(votes, axis=0)
    lines: list[StripeLine] = []
    free = np.ones(len(members), np.bool_)
    while len(lines) < _MAX_LINES and len(guessed):
        best = int(np.argmax(counts))
        m, c = guessed[best], float(offsets[best])
        for _ in range(_N_FITS):
            near = free & _near(points, across, along, m[None], c, _TOLERANCE_PX)[:, 0]
            if np.count_nonzero(near) < _MIN_POINTS:
                return lines
            m, c = _fitted(points[near], across[near], normal, m)
        near = free & _near(points, across, along, m[None], c, _TOLERANCE_PX)[:, 0]
        if _length_px(points[near], along[near]) >= _MIN_LENGTH_PX:
            lines.append(StripeLine(patch, members[near]))
        taken = free & (near | _near(points, across, along, m[None], c, _HALO_PX)[:, 0])
        free &= ~taken
        counts -= np.count_nonzero(votes[taken[some]], axis=0)
    return lines


def _pairs(chain: IntArray, seed: int) -> tuple[IntArray, IntArray]:
    """Return random pairs of points (N), half of them within a chain."""
    n = len(chain)
    if n < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    rng = np.random.default_rng(seed)
    i, j = rng.integers(0, n, (2, _N_GUESSES))
    half = slice(0, _N_GUESSES // 2)
    order = np.argsort(chain, kind="stable")
    first = np.searchsorted(chain[order], chain[i[half]], "left")
    last = np.searchsorted(chain[order], chain[i[half]], "right")
    j[half] = order[rng.integers(first, last)]
    return i, j


def _guesses(
    points: FloatArray, normal: FloatArray, i: IntArray, j: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return lines m·X = c through pairs of points, m in the surface; NaN for equal points."""
    m = np.cross(normal, points[j] - points[i])
    length = np.linalg.norm(m, axis=1)
    m /= np.where(length > 1e-6, length, np.nan)[:, None]
    return m, np.einsum("ni,ni->n", m, points[i])


def _runs_along(across: FloatArray, along: FloatArray, m: FloatArray) -> BoolArray:
    """Return which points (N) have a stripe that runs along their line (N)."""
    gain = np.abs(np.einsum("ni,ni->n", across, m))
    aligned: BoolArray = np.abs(np.einsum("ni,ni->n", along, m)) <= _ALIGNED * gain
    return aligned


def _near(
    points: FloatArray,
    across: FloatArray,
    along: FloatArray,
    m: FloatArray,
    c: FloatArray | float,
    tolerance_px: float,
) -> BoolArray:
    """Return which points (N) are near which lines (H) and run along them, shape (N, H)."""
    gain = np.abs(across @ m.T)
    near: BoolArray = np.abs(points @ m.T - c) <= tolerance_px * gain
    near &= np.abs(along @ m.T) <= _ALIGNED * gain
    return near


def _fitted(
    points: FloatArray, across: FloatArray, normal: FloatArray, m: FloatArray
) -> tuple[FloatArray, float]:
    """Fit a line by least squares, weighing points as the image measures them."""
    weight = 1.0 / np.maximum(np.abs(across @ m), 1e-9) ** 2
    middle = weight @ points / weight.sum()
    t = np.cross(m, normal)
    u, v = (points - middle) @ t, (points - middle) @ m
    turned = m - t * float(weight @ (u * v)) / max(float(weight @ (u * u)), 1e-30)
    turned /= np.linalg.norm(turned)
    return turned, float(turned @ middle)


def _length_px(points: FloatArray, along: FloatArray) -> float:
    """Return how long a line is in the image, roughly."""
    if not len(points):
        return 0.0
    spread = points.max(axis=0) - points.min(axis=0)
    per_px = float(np.median(np.linalg.norm(along, axis=1)))
    return float(np.linalg.norm(spread)) / per_px
