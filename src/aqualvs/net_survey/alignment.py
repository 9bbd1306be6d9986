"""Alignment of a dive's bearings and depths with those of earlier dives along the same net.

Compasses and depth sensors have a small offset that differs from dive to dive. The pattern of
growth and the holes that are still there reveal it: each shift in u and d is scored by the
likelihood of the later dive's stretches and holes at the places of the earlier dives. Where no
single shift stands out, none is applied, and the places keep the uncertainty of their instruments.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.net_survey.frames import PlacedSurvey, Raster, WallFrame, spread_over, wrapped

# What compass and depth sensor are off by between dives, one standard deviation.
PRIOR_BEARING, PRIOR_DEPTH = np.deg2rad(5.0), 0.5
_REACH = 3.0
STEP = 0.1
"""Shifts that are tried are this far apart, in metres."""
# A shift is told if so much of the chance lies so near (in prior deviations, and in metres).
_MASS, _NEAR, _MIN_NEAR = 0.95, 0.5, 0.3
_FLAT_NEAR = 0.5
# Agreement of patterns that chance alone would show in one of so many cases does not count.
_CHANCE = 0.01
# Places this far apart in a pattern of growth count as independent.
_PATTERN = 0.7
_MIN_STRETCHES, _MIN_OVERLAP = 8, 0.5
# Stretches that follow each other by no more than this belong to one lane.
_LANE = 3
# All pairs of so many stretches fit into memory, and tell how alike neighbours are.
_MAX_BESIDE = 2000
# A hole is still there with this chance. Its diameter is then mostly found again to the first
# factor (log), else, seen in part, to the second, by which diameters of any holes differ.
_KEPT, _SEEN_ALIKE = 0.5, 0.7
_SIZE, _SIZES = 0.15, 0.5
_CLIP, _MAD = 3.0, 1.4826
# Places in a stretch that are compared, along and across.
_SAMPLES = 5
_MAX_SHIFTS = 40_000


@dataclass(frozen=True, slots=True)
class SurveyShift:
    """Offset added to a dive's places to align them with those of the first dive.

    Attributes
    ----------
    value, sigma : array, shape (2,)
        Metres in u and d; the value is 0 where it is not told.
    told : bool array, shape (2,)
        Whether what stayed tells it.
    by_pattern, by_holes : bool
        What told it: agreement of the growth's pattern beyond chance; holes found again.
    """

    value: FloatArray
    sigma: FloatArray
    told: BoolArray
    by_pattern: bool = False
    by_holes: bool = False

    @classmethod
    def first(cls) -> "SurveyShift":
        """Return that of the dive on which the others are laid."""
        return cls(np.zeros(2), np.zeros(2), np.ones(2, np.bool_))


@dataclass(frozen=True, slots=True)
class ShiftGrid:
    """Grid of the shifts that are tried.

    Attributes
    ----------
    steps : (int array, int array)
        In u and d, as multiples of `STEP`.
    log_prior : array, shape (n_u, n_d)
    """

    steps: tuple[FloatArray, FloatArray]
    log_prior: FloatArray


def prior_sigma(frame: WallFrame) -> FloatArray:
    """Return what instruments alone leave open, in metres; infinite along a flat net."""
    along = frame.radius * PRIOR_BEARING if frame.round else np.inf
    return np.array([along, PRIOR_DEPTH])


def align(
    later: PlacedSurvey,
    earlier: Sequence[PlacedSurvey],
    frame: WallFrame,
) -> SurveyShift:
    """Return the shift that lays a dive on earlier ones, which are laid already."""
    sigma = prior_sigma(frame)
    grid = _grid(later, earlier, frame)
    pattern = _pattern_gain(later, earlier, frame, grid)
    holes = _holes_gain(later, earlier, frame, grid)
    log_chance = grid.log_prior + pattern + holes
    chance = np.exp(log_chance - log_chance.max())
    chance /= chance.sum()
    value, spread, told = np.zeros(2), sigma.copy(), np.zeros(2, np.bool_)
    for axis in range(2):
        near = max(_NEAR * sigma[axis], _MIN_NEAR) if np.isfinite(sigma[axis]) else _FLAT_NEAR
        shifts = STEP * grid.steps[axis]
        marginal = chance.sum(axis=1 - axis)
        inside = np.abs(shifts - shifts[np.argmax(marginal)]) <= near
        mass = float(marginal[inside].sum())
        if mass < _MASS:
            continue
        told[axis] = True
        value[axis] = marginal[inside] @ shifts[inside] / mass
        variance = marginal[inside] @ (shifts[inside] - value[axis]) ** 2 / mass
        spread[axis] = np.sqrt(variance + STEP**2 / 4.0)
    return SurveyShift(value, spread, told, bool(pattern.max() > 0.0), bool(holes.max() > 0.0))


def shifted(one: PlacedSurvey, shift: SurveyShift) -> PlacedSurvey:
    """Return a dive with its places shifted; what the shift leaves open is not in its sigma."""
    return PlacedSurvey(
        one.survey, one.rows, one.outline + shift.value, one.holes + shift.value, one.sigma
    )


def _grid(later: PlacedSurvey, earlier: Sequence[PlacedSurvey], frame: WallFrame) -> ShiftGrid:
    sigma = prior_sigma(frame)
    reach = np.minimum(_REACH * sigma, 0.5 * frame.period)
    centre = 0.0
    if not frame.round:
        known = np.concatenate([one.outline.reshape(-1, 2) for one in earlier])[:, 0]
        mine = later.outline[..., 0]
        least, most = known.min() - mine.max(), known.max() - mine.min()
        centre, reach[0] = 0.5 * (least + most), 0.5 * (most - least)
    n = np.ceil(reach / STEP)
    depths = np.arange(-n[1], n[1] + 1)
    n[0] = min(n[0], _MAX_SHIFTS // len(depths) // 2)
    across = np.round(centre / STEP) + np.arange(-n[0], n[0] + 1)
    log_prior = -0.5 * (STEP * depths / sigma[1]) ** 2 + np.zeros((len(across), 1))
    if frame.round:
        log_prior -= 0.5 * (STEP * across[:, None] / sigma[0]) ** 2
    return ShiftGrid((across, depths), log_prior)


def _pattern_gain(
    later: PlacedSurvey, earlier: Sequence[PlacedSurvey], frame: WallFrame, grid: ShiftGrid
) -> FloatArray:
    """Return by how much each shift explains the growth better than none; 0 if by chance only."""
    nothing = np.zeros(grid.log_prior.shape)
    if len(later.rows) < _MIN_STRETCHES:
        return nothing
    raster, known = _pattern(earlier, frame)
    places = spread_over(later.outline, 1e9)
    mine = _clipped(later.solidity)
    count, agreement = nothing.copy(), nothing.copy()
    best, best_told = -np.inf, None
    for i, du in enumerate(STEP * grid.steps[0]):
        for j, dd in enumerate(STEP * grid.steps[1]):
            told = _mean_over(known, raster.index(places + np.array([du, dd])))
            good = np.isfinite(told)
            count[i, j] = np.count_nonzero(good)
            if count[i, j] < _MIN_STRETCHES:
                continue
            agreement[i, j] = _correlation(mine[good], _clipped(told[good]))
            value = -count[i, j] * np.log1p(-(agreement[i, j] ** 2)) * (agreement[i, j] > 0.0)
            if value > best:
                best, best_told = value, told
    if best_told is None:
        return nothing
    agreement[(agreement < 0.0) | (count < _MIN_OVERLAP * count.max())] = 0.0
    gain = -0.5 * count * np.log1p(-(np.minimum(agreement, 0.9999) ** 2))
    alike, rest = _independent(mine, best_told, later.outline.mean(axis=1))
    n_shifts = max(grid.log_prior.size * (STEP / _PATTERN) ** 2, 1.0)
    if alike * gain.max() < np.log(n_shifts / _CHANCE):
        return nothing
    return np.asarray(rest * gain)


def _pattern(earlier: Sequence[PlacedSurvey], frame: WallFrame) -> tuple[Raster, FloatArray]:
    """Return the solidity of earlier dives less their median, NaN where they have not been."""
    corners = np.concatenate([one.outline.reshape(-1, 2) for one in earlier])
    raster = Raster.over(corners.min(axis=0), corners.max(axis=0), STEP, frame)
    total, weight = np.zeros(raster.n), np.zeros(raster.n)
    for one in earlier:
        if not len(one.rows):
            continue
        index = raster.index(spread_over(one.outline, STEP))
        off = one.solidity - np.median(one.solidity)
        inside = index.ravel() >= 0
        flat = index.ravel()[inside]
        total += np.bincount(flat, np.repeat(off, index.shape[1])[inside], raster.n)
        weight += np.bincount(flat, minlength=raster.n)
    with np.errstate(invalid="ignore", divide="ignore"):
        return raster, total / weight


def _mean_over(known: FloatArray, index: IntArray) -> FloatArray:
    """Return means (K,) of what is known at squares (K, n); NaN where for less than half."""
    found = np.where(index >= 0, known[index], np.nan)
    there = np.isfinite(found)
    count = there.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(there, found, 0.0).sum(axis=1) / count
    return np.where(2 * count >= index.shape[1], mean, np.nan)


def _clipped(values: FloatArray) -> FloatArray:
    """Return values with outliers drawn in."""
    middle = np.median(values)
    spread = max(_MAD * float(np.median(np.abs(values - middle))), 1e-6)
    return np.clip(values, middle - _CLIP * spread, middle + _CLIP * spread)


def _correlation(a: FloatArray, b: FloatArray) -> float:
    a, b = a - a.mean(), b - b.mean()
    spread = float(np.sqrt(a @ a * (b @ b)))
    return float(a @ b) / spread if spread > 0.0 else 0.0


def _independent(mine: FloatArray, told: FloatArray, middle: FloatArray) -> tuple[float, float]:
    """Return the share of stretches that count as independent: of patterns, and of what is left.

    Neighbours are alike, along the way and across lanes: by Bartlett's formula for series with a
    memory of one step, in both directions.
    """
    good = np.isfinite(told)
    a, b = mine[good] - mine[good].mean(), told[good] - told[good].mean()
    left = a - b * float(a @ b) / max(float(b @ b), 1e-12)
    beside = _beside(middle[good])
    alike = rest = 1.0
    for pairs in (np.stack([np.arange(len(a) - 1), np.arange(1, len(a))]), beside):
        both = _memory(a, pairs) * _memory(b, pairs)
        own = _memory(left, pairs)
        alike *= (1.0 - both) / (1.0 + both)
        rest *= (1.0 - own) / (1.0 + own)
    return alike, rest


def _beside(middle: FloatArray) -> IntArray:
    """Return pairs (2, n): stretches, and the nearest of another time, where one is near."""
    middle = middle[:_MAX_BESIDE]
    gap = np.abs(np.subtract.outer(np.arange(len(middle)), np.arange(len(middle))))
    distance = np.hypot(*(middle[:, None] - middle[None]).transpose(2, 0, 1))
    distance[gap <= _LANE] = np.inf
    nearest = np.argmin(distance, axis=1)
    rows = np.arange(len(middle))
    near = distance[rows, nearest] < 2.0 * _PATTERN
    return np.stack([rows[near], nearest[near]])


def _memory(values: FloatArray, pairs: IntArray) -> float:
    if pairs.shape[1] < _MIN_STRETCHES:
        return 0.0
    return float(np.clip(_correlation(values[pairs[0]], values[pairs[1]]), 0.0, 0.95))


def _holes_gain(
    later: PlacedSurvey, earlier: Sequence[PlacedSurvey], frame: WallFrame, grid: ShiftGrid
) -> FloatArray:
    """Return by how much each shift explains the later holes better than if all were new."""
    gain = np.zeros(grid.log_prior.shape)
    parts = [(one, k) for one in earlier for k in range(len(one.holes))]
    if not parts or not len(later.holes):
        return gain
    known = np.array([one.holes[k] for one, k in parts])
    size = np.array([one.survey.holes.diameter[k] for one, k in parts])
    spread = np.array([one.sigma for one, _ in parts])
    corners = np.concatenate([one.outline.reshape(-1, 2) for one in earlier])
    area = max(float(np.prod(np.ptp(corners, axis=0))), 1.0)
    shift = np.stack(np.meshgrid(*(STEP * s for s in grid.steps), indexing="ij"), axis=-1)
    for place, diameter in zip(later.holes, later.survey.holes.diameter, strict=True):
        density = np.zeros(gain.shape)
        for at, other, sigma in zip(known, size, spread, strict=True):
            off = wrapped(place + shift - at, frame)
            middle = 0.25 * max(diameter, other)
            variance = sigma**2 + later.sigma**2 + middle**2 + STEP**2 / 4.0
            peak = _size_gain(diameter, other) / (2.0 * np.pi * np.sqrt(np.prod(variance)))
            density += peak * np.exp(-0.5 * (off**2 / variance).sum(axis=-1))
        gain += np.log((1.0 - _KEPT) + _KEPT * density * area / len(known))
    return gain


def _size_gain(one: float, other: float) -> float:
    """Return how much more likely two diameters are those of one hole than of any two."""
    off = float(np.log(one / other))
    again = _SIZES / _SIZE * np.exp(-0.5 * off**2 * (_SIZE**-2 - _SIZES**-2))
    return _SEEN_ALIKE * float(again) + 1.0 - _SEEN_ALIKE
