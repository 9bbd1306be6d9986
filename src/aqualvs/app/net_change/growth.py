"""Fouling growth from the history of a wall: per cell, over the whole wall, date by date."""

from dataclasses import replace

import numpy as np
from scipy import stats

from aqualvs.app.net_change.cells import FALSE_SHARE, CellChange, Growth, WallHistory
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray


def cell_changes(wall: WallHistory) -> list[CellChange]:
    """Return what became of every cell that was seen on two dates or more.

    Notes
    -----
    The rate is that of a straight line through the dates, each weighed by its variance. Which
    cells changed beyond chance is told by the procedure of Benjamini and Hochberg (1995),
    doi:10.1111/j.2517-6161.1995.tb02031.x.
    """
    cells = np.flatnonzero(wall.known.sum(axis=1) >= 2)
    factors = _wall_factors(wall)
    whole = wall.weights.T @ factors.ravel() * wall.sigma
    growth = wall.estimate(factors)
    place = float(np.sum(factors**2 * wall.place_variance))
    found = [_cell(wall, int(c), (growth, whole, place)) for c in cells]
    changed = _discoveries(np.array([one.difference.z for one in found]))
    apart = _discoveries(np.array([one.excess.z for one in found]))
    return [
        replace(one, changed=bool(c), apart=bool(a))
        for one, c, a in zip(found, changed, apart, strict=True)
    ]


def wall_growth(wall: WallHistory) -> Growth | None:
    """Return growth per day over all cells seen on two dates or more; None without one.

    Each cell has its own level, all have one rate: least squares with equal weights.
    """
    if not np.any(wall.known.sum(axis=1) >= 2):
        return None
    return wall.estimate(_wall_factors(wall))


def common_cells(wall: WallHistory) -> BoolArray:
    """Mark the cells (C,) that were seen on every date."""
    return np.asarray(wall.known.all(axis=1))


def date_means(wall: WallHistory) -> list[Growth | None]:
    """Return the mean solidity of the cells common to all dates, date by date."""
    common = common_cells(wall)
    if not common.any():
        return [None] * len(wall.dates)
    found: list[Growth | None] = []
    for v in range(len(wall.dates)):
        factors = np.zeros(wall.solidity.shape)
        factors[common, v] = 1.0 / np.count_nonzero(common)
        found.append(wall.estimate(factors))
    return found


def _wall_factors(wall: WallHistory) -> FloatArray:
    """Return what each cell and date (C, V) contributes to the growth of the wall."""
    known = wall.known & (wall.known.sum(axis=1) >= 2)[:, None]
    days = np.where(known, wall.days, 0.0)
    mean = days.sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    off = np.where(known, wall.days - mean[:, None], 0.0)
    return np.asarray(off / max(float(np.sum(off**2)), 1e-12))


def _cell(wall: WallHistory, cell: int, of_wall: tuple[Growth, FloatArray, float]) -> CellChange:
    dates = np.flatnonzero(wall.known[cell])
    first, last = int(dates[0]), int(dates[-1])
    single = [_on(wall, cell, int(v)) for v in dates]
    weights = np.array([one.sigma for one in single]) ** -2
    off = wall.days[dates] - weights @ wall.days[dates] / weights.sum()
    rate = weights * off / (weights @ off**2)
    growth, whole, place = of_wall
    per_day, of_stretches, own_place = _parts(wall, cell, dates, rate)
    return CellChange(
        cell=cell,
        first=first,
        last=last,
        n_dates=len(dates),
        before=single[0],
        after=single[-1],
        difference=_sum(wall, cell, dates[[0, -1]], np.array([-1.0, 1.0])),
        per_day=wall.variance_of(per_day, of_stretches, own_place),
        excess=wall.variance_of(per_day - growth.value, of_stretches - whole, own_place + place),
        seen=(float(wall.seen[cell, first]), float(wall.seen[cell, last])),
    )


def _on(wall: WallHistory, cell: int, visit: int) -> Growth:
    return _sum(wall, cell, np.array([visit]), np.ones(1))


def _sum(wall: WallHistory, cell: int, dates: IntArray, factors: FloatArray) -> Growth:
    """Return a sum over dates of one cell."""
    return wall.variance_of(*_parts(wall, cell, dates, factors))


def _parts(
    wall: WallHistory, cell: int, dates: IntArray, factors: FloatArray
) -> tuple[float, FloatArray, float]:
    """Return value, factors of stretches times sigmas, and variance for places, of such a sum."""
    rows = wall.weights[cell * len(wall.dates) + dates]
    return (
        float(factors @ wall.solidity[cell, dates]),
        np.asarray(rows.T @ factors * wall.sigma),
        float(factors**2 @ wall.place_variance[cell, dates]),
    )


def _discoveries(z: FloatArray) -> BoolArray:
    """Mark what is beyond chance among many, at most a share `FALSE_SHARE` of it falsely."""
    if not len(z):
        return np.zeros(0, np.bool_)
    chance = 2.0 * stats.norm.sf(np.abs(z))
    order = np.sort(chance)
    below = order <= FALSE_SHARE * np.arange(1, len(z) + 1) / len(z)
    limit = order[np.flatnonzero(below)[-1]] if below.any() else -1.0
    return np.asarray(chance <= limit)
