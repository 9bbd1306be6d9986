"""Fouling growth: solidity of the same places on several dates, by cell and over the whole wall.

The solidity of a cell on a date is a weighted mean over stretches. Every number here is a linear
combination of the stretches' solidities, so that its variance follows exactly from theirs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import date

import numpy as np
from scipy import sparse
from scipy.special import ndtr

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.net_survey.frames import PlacedSurvey, Raster, SurveyShift, WallFrame, spread_over
from aqualvs.net_survey.surveys import areas

SIGMA_SCALE = 1.4
"""By which sigmas of solidity are too small (docs/net-condition.md)."""
COMMON = 0.5
"""Share of the variance of solidity that all stretches of a dive have in common."""
# A date knows of a cell if stretches passed over so much of it.
_MIN_COVER = 0.25
FALSE_SHARE = 0.05
"""Share of false ones among the cells that are said to have changed."""


@dataclass(frozen=True, slots=True)
class Growth:
    """Growth with its sigma: a rate per day, or a difference."""

    # Of solidity, 0 to 1.
    value: float
    sigma: float

    @property
    def z(self) -> float:
        """Value by sigma."""
        return self.value / self.sigma


@dataclass(frozen=True, slots=True)
class CellChange:
    """Change of a cell between dates."""

    cell: int  # In the raster.
    # Dates between which it is told.
    first: int
    last: int
    # On which it was seen.
    n_dates: int
    # Solidity on those two dates, and its change.
    before: Growth
    after: Growth
    difference: Growth
    per_day: Growth
    # Metres of laser line on those two dates.
    seen: tuple[float, float]
    # Rate less that of the whole wall: what is common to a dive's errors is not in its sigma.
    excess: Growth
    # Whether difference and excess are beyond chance, among all cells.
    changed: bool = False
    apart: bool = False


@dataclass(frozen=True, slots=True)
class WallHistory:
    """Solidity of cells (C) on dates (V), of stretches (K) of all dives."""

    dates: list[date]  # Increasing.
    raster: Raster  # C squares.
    # Shape (C, V): NaN, and 0, where not seen.
    solidity: FloatArray
    seen: FloatArray
    # Shape (C, V): for the places' uncertainty and for having seen another part of the cell.
    place_variance: FloatArray
    # Shape (C * V, K): of the stretches in each cell and date.
    weights: sparse.csr_array
    # Shape (K,): of the stretches.
    sigma: FloatArray
    # Shape (K,): of the stretches.
    dive: IntArray

    @property
    def known(self) -> BoolArray:
        """True for the dates on which a cell was seen, shape (C, V)."""
        return np.isfinite(self.solidity)

    @property
    def days(self) -> FloatArray:
        """Days since the first date."""
        return np.array([(one - self.dates[0]).days for one in self.dates], np.float64)

    def parts(self, factors: FloatArray) -> tuple[float, FloatArray, float]:
        """Return a sum of solidities times factors (C, V), 0 where unknown, for `variance_of`."""
        value = float(np.nansum(np.where(factors != 0.0, factors * self.solidity, 0.0)))
        of_stretches = self.weights.T @ factors.ravel() * self.sigma
        return value, of_stretches, float(np.sum(factors**2 * self.place_variance))

    def variance_of(self, value: float, of_stretches: FloatArray, place: float) -> Growth:
        """Return a sum with its standard deviation.

        `of_stretches`, shape (K,): factors of the stretches times their sigmas. `place`: variance
        for the places.
        """
        own = (1.0 - COMMON) * float(of_stretches @ of_stretches)
        of_dives = np.bincount(self.dive, of_stretches)
        common = COMMON * float(of_dives @ of_dives)
        return Growth(value, float(np.sqrt(own + common + place)))


def history(
    placed: Sequence[PlacedSurvey], shifts: Sequence[SurveyShift], frame: WallFrame, cell: float
) -> WallHistory:
    """Lay dives, already shifted, over cells with sides of `cell` metres.

    What each shift leaves open is in its sigma.
    """
    dates = sorted({one.survey.date for one in placed})
    raster = Raster.around(placed, cell, frame)
    n_cells, n_dates, blocks = raster.n, len(dates), []
    cover, seen = np.zeros((2, n_cells, n_dates))
    offset, open_shift = np.zeros((n_cells, n_dates, 2)), np.zeros((n_dates, 2))
    for one, shift in zip(placed, shifts, strict=True):
        visit = dates.index(one.survey.date)
        area, share, sums = _shares(one, raster)
        length = one.survey.stretches.seen[one.rows]
        cover[:, visit] += share @ area
        seen[:, visit] += share @ length
        offset[:, visit] += sums
        open_shift[visit] = np.maximum(open_shift[visit], np.hypot(shift.sigma, one.sigma))
        coo = sparse.coo_array(share @ sparse.diags_array(length))
        at = (coo.row * n_dates + visit, coo.col)
        blocks.append(sparse.coo_array((coo.data, at), shape=(n_cells * n_dates, len(area))))
    known = (cover >= _MIN_COVER * np.prod(raster.size)) & (seen > 0.0)
    scale = np.where(known, 1.0 / np.where(known, seen, 1.0), 0.0).ravel()
    weights = sparse.csr_array(sparse.diags_array(scale) @ sparse.hstack(blocks).tocsr())
    values = np.concatenate([one.solidity for one in placed])
    solidity = np.where(known, (weights @ values).reshape(n_cells, n_dates), np.nan)
    offset = np.where(known[..., None], offset / np.maximum(cover, 1e-9)[..., None], np.nan)
    return WallHistory(
        dates=dates,
        raster=raster,
        solidity=solidity,
        seen=np.where(known, seen, 0.0),
        place_variance=_place_variance(raster, solidity, offset, open_shift),
        weights=weights,
        sigma=SIGMA_SCALE * np.concatenate([p.survey.stretches.sigma[p.rows] for p in placed]),
        dive=np.repeat(np.arange(len(placed)), [len(p.rows) for p in placed]),
    )


def _shares(one: PlacedSurvey, raster: Raster) -> tuple[FloatArray, sparse.csr_array, FloatArray]:
    """Return areas of stretches, shares of them in cells (C, K), and sums of places (C, 2)."""
    places = spread_over(one.outline, 0.2 * float(raster.size.min()))
    count, n = places.shape[:2]
    index = raster.index(places)
    inside = index.ravel() >= 0
    flat, stretch = index.ravel()[inside], np.repeat(np.arange(count), n)[inside]
    share = sparse.csr_array(
        (np.full(len(flat), 1.0 / n), (flat, stretch)), shape=(raster.n, count)
    )
    area = areas(one.outline)
    middle = raster.middle(flat)
    inner = places.reshape(-1, 2)[inside] - middle
    if raster.periodic:
        period = raster.shape[0] * raster.size[0]
        inner[:, 0] -= period * np.round(inner[:, 0] / period)
    weight = (area[stretch] / n)[:, None] * inner
    sums: FloatArray = np.stack([np.bincount(flat, w, raster.n) for w in weight.T], axis=-1)
    return area, share, sums


def _place_variance(
    raster: Raster, solidity: FloatArray, offset: FloatArray, open_shift: FloatArray
) -> FloatArray:
    """Return what uncertain places, and other parts of a cell, do to its solidity, (C, V)."""
    slope = _slope(raster, solidity)
    count = np.isfinite(offset[..., 0]).sum(axis=1, keepdims=True)[..., None]
    mean = np.nansum(offset, axis=1, keepdims=True) / np.maximum(count, 1)
    away = np.nan_to_num(offset - mean) ** 2 + open_shift[None] ** 2
    return np.asarray(np.einsum("cx,cvx->cv", slope**2, away))


def _slope(raster: Raster, solidity: FloatArray) -> FloatArray:
    """Return how fast solidity changes from cell to cell, (C, 2) per metre; usual where unknown."""
    known = np.isfinite(solidity)
    count = known.sum(axis=1)
    off = solidity - np.nanmean(solidity, axis=0) if known.any() else solidity
    mean = np.where(count > 0, np.nansum(off, axis=1) / np.maximum(count, 1), np.nan)
    wall = mean.reshape(raster.shape)
    found = np.empty((*raster.shape, 2))
    for axis in range(2):
        sides = [(int(k == axis), int(k == axis)) for k in range(2)]
        around = np.pad(wall, sides, constant_values=np.nan)
        if axis == 0 and raster.periodic:
            around = np.pad(wall, sides, mode="wrap")
        step = np.diff(around, axis=axis) / raster.size[axis]
        steps = np.stack([np.delete(step, 0, axis), np.delete(step, -1, axis)])
        n = np.isfinite(steps).sum(axis=0)
        own = np.where(n > 0, np.nansum(steps, axis=0) / np.maximum(n, 1), np.nan)
        usual = np.sqrt(np.nanmean(own**2)) if np.isfinite(own).any() else 0.0
        found[..., axis] = np.where(np.isfinite(own), own, usual)
    return found.reshape(-1, 2)


def cell_changes(wall: WallHistory) -> list[CellChange]:
    """Return what became of every cell that was seen on two dates or more.

    Notes
    -----
    The rate is that of a straight line through the dates, each weighed by its variance. Which
    cells changed beyond chance is told by the procedure of Benjamini and Hochberg (1995),
    doi:10.1111/j.2517-6161.1995.tb02031.x.
    """
    cells = np.flatnonzero(wall.known.sum(axis=1) >= 2)
    of_wall = wall.parts(_wall_factors(wall))
    found = [_cell(wall, int(c), of_wall) for c in cells]
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
    return wall.variance_of(*wall.parts(_wall_factors(wall)))


def date_means(wall: WallHistory) -> list[Growth | None]:
    """Return the mean solidity of the cells common to all dates, date by date."""
    common = np.asarray(wall.known.all(axis=1))
    if not common.any():
        return [None] * len(wall.dates)
    share = common[:, None] / np.count_nonzero(common)
    of_dates = np.eye(len(wall.dates))
    return [wall.variance_of(*wall.parts(share * of_date)) for of_date in of_dates]


def _wall_factors(wall: WallHistory) -> FloatArray:
    """Return what each cell and date (C, V) contributes to the growth of the wall."""
    known = wall.known & (wall.known.sum(axis=1) >= 2)[:, None]
    days = np.where(known, wall.days, 0.0)
    mean = days.sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    off = np.where(known, wall.days - mean[:, None], 0.0)
    return np.asarray(off / max(float(np.sum(off**2)), 1e-12))


def _cell(wall: WallHistory, cell: int, of_wall: tuple[float, FloatArray, float]) -> CellChange:
    dates = np.flatnonzero(wall.known[cell])
    first, last = int(dates[0]), int(dates[-1])
    single = [_sum(wall, cell, np.array([visit]), np.ones(1)) for visit in dates]
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
        excess=wall.variance_of(per_day - growth, of_stretches - whole, own_place + place),
        seen=(float(wall.seen[cell, first]), float(wall.seen[cell, last])),
    )


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
    # All of SciPy's statistics: half a second that no other part of a comparison needs.
    from scipy.stats import false_discovery_control

    return np.asarray(false_discovery_control(2.0 * ndtr(-np.abs(z))) <= FALSE_SHARE)
