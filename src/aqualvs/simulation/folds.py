"""Folds and slack: a height over a net's surface, and where rays cross it."""

import math

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.compiled import inline_borrowing_kernel
from aqualvs.simulation.scene import Fold

NET, DIRECTION_U, DIRECTION_V, PLACE, HEIGHT, WIDTH, PERIOD, N_COLUMNS = range(8)


def pack_fold(i_net: int, fold: Fold) -> FloatArray:
    """Return one row of the fold table, shape (N_COLUMNS,).

    Raises
    ------
    OptionError
        If the width is not positive, or the folds of a row run into each other.
    """
    if not fold.width > 0.0:
        raise OptionError(f"fold of a net: width is {1e3 * fold.width:g} mm; it must be positive")
    if 0.0 < fold.period < 2.0 * fold.width:
        raise OptionError(
            f"fold of a net: period is {1e3 * fold.period:g} mm, less than the "
            f"{2e3 * fold.width:g} mm from foot to foot; make it longer or 0"
        )
    way = (math.cos(fold.direction), math.sin(fold.direction))
    return np.array([i_net, *way, fold.place, fold.height, fold.width, fold.period])


@inline_borrowing_kernel
def folded(u: float, v: float, folds: FloatArray, i: int) -> tuple[float, float, float]:
    """Return height (m) and slopes along u and v of the folds of net i."""
    height, slope_u, slope_v = 0.0, 0.0, 0.0
    for k in range(folds.shape[0]):
        if folds[k, NET] != i:
            continue
        s = folds[k, DIRECTION_U] * u + folds[k, DIRECTION_V] * v - folds[k, PLACE]
        if folds[k, PERIOD] > 0.0:
            s -= folds[k, PERIOD] * np.floor(s / folds[k, PERIOD] + 0.5)
        if abs(s) >= folds[k, WIDTH]:
            continue
        phase = np.pi * s / folds[k, WIDTH]
        height += 0.5 * folds[k, HEIGHT] * (1.0 + np.cos(phase))
        slope = -0.5 * folds[k, HEIGHT] * np.pi / folds[k, WIDTH] * np.sin(phase)
        slope_u += slope * folds[k, DIRECTION_U]
        slope_v += slope * folds[k, DIRECTION_V]
    return height, slope_u, slope_v


@inline_borrowing_kernel
def fold_limits(folds: FloatArray, i: int) -> tuple[float, float, float]:
    """Return what folds of net i can add at most: lowest (0 or less), highest, steepest slope."""
    low, high, steepest = 0.0, 0.0, 0.0
    for k in range(folds.shape[0]):
        if folds[k, NET] == i:
            low += min(folds[k, HEIGHT], 0.0)
            high += max(folds[k, HEIGHT], 0.0)
            steepest += 0.5 * np.pi * abs(folds[k, HEIGHT]) / folds[k, WIDTH]
    return low, high, steepest
