"""Common coordinates (u, d) on a net for all dives, a raster of its wall, and the dives' alignment.

u is in metres. Around a round net it is radius times bearing, on which dives agree up to the error
of their compasses. Along a flat net that faces one way it is the distance from where each dive
began. d is the depth in metres. The raster cells record what a dive passed over, looked at, and
found.

Alignment: compasses and depth sensors have a small offset that differs from dive to dive. The
pattern of growth and the holes that are still there reveal it: each shift in u and d is scored by
the likelihood of the later dive's stretches and holes at the places of the earlier dives. Where no
single shift stands out, none is applied, and the places keep the uncertainty of their instruments.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.net_survey.surveys import Survey
from aqualvs.nets.places import metres_per_radian

_MIN_KNOWN = 3
# Flat nets are the same side of a pen if they face the same way up to a compass's error.
_FLAT_SPREAD, _SAME_SIDE = np.deg2rad(10.0), np.deg2rad(25.0)
# Own error of a place within a dive, in metres: at least that of bearing and depth.
_MIN_SIGMA_U, _SIGMA_D = 0.05, 0.05
_MAD = 1.4826


@dataclass(frozen=True, slots=True)
class WallFrame:
    """Meaning of the coordinate u on a wall: around a round net, or along a flat one."""

    round: bool  # Around a round net, else along a flat one.
    radius: float = 0.0  # Metres; 0 for a flat net.
    sign: float = 1.0  # -1 where bearings fall to the right: the net is seen from outside.

    @property
    def period(self) -> float:
        """Metres around the net; infinite along a flat one."""
        return 2.0 * np.pi * self.radius if self.round else np.inf


@dataclass(frozen=True, slots=True)
class PlacedSurvey:
    """A dive's stretches (K, only usable ones) and holes (H) in a common frame."""

    survey: Survey
    rows: IntArray  # Shape (K,): which stretches of the survey.
    outline: FloatArray  # Shape (K, 4, 2): u and d.
    holes: FloatArray  # Shape (H, 2): u and d.
    sigma: FloatArray  # Shape (2,): error of a place within the dive.

    @property
    def solidity(self) -> FloatArray:
        """Of the stretches."""
        return np.asarray(self.survey.stretches.solidity[self.rows])


def common_frame(surveys: Sequence[Survey]) -> tuple[WallFrame | None, str]:
    """Return what the dives' places have in common, or None and the reason in words."""
    known = [one for one in surveys if has_places(one)]
    if len({one.date for one in known}) < 2:
        return None, (
            f"depth and bearing are known on fewer than two dates, of {_MIN_KNOWN} stretches or "
            "more; add the vehicles' logs: aqualvs net RUN --log LOG --overwrite"
        )
    radii = [radius for radius in map(_radius, known) if radius is not None]
    if radii:
        radius = float(np.median(radii))
        if np.any(np.sign(radii) != np.sign(radius)):
            return None, "some dives see the net from inside, others from outside; compare alike"
        return WallFrame(True, abs(radius), float(np.sign(radius))), ""
    facing = np.array([_facing(one) for one in known])
    off = np.angle(np.exp(1j * (facing - facing[0])))
    tracked = all(one.stretches.placed.all() for one in known)
    if np.all(np.isfinite(facing)) and np.ptp(off) < _SAME_SIDE and tracked:
        return WallFrame(False), ""
    return None, (
        "the net shows no roundness (its bearing does not grow along the way), and the dives do "
        "not all face one flat side of it"
    )


def place_survey(survey: Survey, frame: WallFrame) -> PlacedSurvey:
    """Lay a dive into a common frame; its stretches without place or solidity are left out."""
    one = survey.stretches
    good = one.usable & np.isfinite(one.depth)
    if frame.round:
        good &= np.isfinite(one.bearing)
    rows = np.flatnonzero(good)
    middle = frame.radius * one.bearing[rows] if frame.round else one.along[rows]
    outline = one.outline[rows].copy()
    if survey.by_bearing:
        outline[..., 0] = frame.radius * np.deg2rad(outline[..., 0])
    elif frame.round:
        off = outline[..., 0] - one.along[rows, None]
        outline[..., 0] = middle[:, None] + frame.sign * off
    outline[..., 1] *= -1.0
    sigma = np.array([_bearing_noise(survey, rows, frame), _SIGMA_D])
    return PlacedSurvey(survey, rows, outline, _holes(survey, frame), sigma)


def has_places(survey: Survey) -> bool:
    """Return whether depth and bearing are known for enough of a dive."""
    one = survey.stretches
    known = np.isfinite(one.depth) & np.isfinite(one.bearing) & one.usable
    return survey.by_depth and int(np.count_nonzero(known)) >= _MIN_KNOWN


def _radius(survey: Survey) -> float | None:
    """Return metres along the net per radian of bearing; None where it shows no roundness."""
    one = survey.stretches
    known = np.flatnonzero(np.isfinite(one.bearing) & one.placed)
    if len(known) < _MIN_KNOWN or survey.by_bearing:
        return None
    turn, along = np.unwrap(one.bearing[known]), one.along[known]
    return metres_per_radian(turn - turn.mean(), along - along.mean())


def _facing(survey: Survey) -> float:
    """Return the one bearing of a flat net; NaN where there is none."""
    bearing = survey.stretches.bearing
    known = bearing[np.isfinite(bearing)]
    mean = np.exp(1j * known).mean()
    off = np.angle(np.exp(1j * known) / mean)
    return float(np.angle(mean)) if np.std(off) < _FLAT_SPREAD else np.nan


def _bearing_noise(survey: Survey, rows: IntArray, frame: WallFrame) -> float:
    """Return how far bearing and track part from one stretch to the next, in metres."""
    one = survey.stretches
    if not frame.round or survey.by_bearing or len(rows) < _MIN_KNOWN:
        return _MIN_SIGMA_U if not frame.round else max(_MIN_SIGMA_U, np.deg2rad(1.0))
    off = frame.radius * np.unwrap(one.bearing[rows]) - frame.sign * one.along[rows]
    step = np.diff(off)
    return float(max(_MAD * np.median(np.abs(step - np.median(step))) / np.sqrt(2.0), 0.05))


def _holes(survey: Survey, frame: WallFrame) -> FloatArray:
    """Return u and d of the holes: as far from the stretch that they are in as the track says."""
    holes, one = survey.holes, survey.stretches
    if not len(holes.number):
        return np.empty((0, 2))
    u = holes.along
    if frame.round:
        u = frame.radius * holes.bearing
        known = np.flatnonzero(np.isfinite(one.bearing) & one.placed)
        if len(known):
            inside = np.searchsorted(one.begin_s[known], holes.time_s, side="right") - 1
            mine = known[np.maximum(inside, 0)]
            off = frame.sign * (holes.along - one.along[mine])
            u = frame.radius * one.bearing[mine] + off
    return np.stack([u, holes.depth], axis=-1)


@dataclass(frozen=True, slots=True)
class Raster:
    """Squares on the wall."""

    low: FloatArray  # Shape (2,): least u and d.
    size: FloatArray  # Shape (2,): of a square; round a net it goes round it in whole squares.
    shape: tuple[int, int]  # Squares along u and d.
    periodic: bool  # Whether u goes round.

    @classmethod
    def around(cls, dives: Sequence[PlacedSurvey], side: float, frame: WallFrame) -> "Raster":
        """Cover what dives passed over with squares of about a side."""
        return cls.over(*corners_of(dives), side, frame)

    @classmethod
    def over(cls, low: FloatArray, high: FloatArray, side: float, frame: WallFrame) -> "Raster":
        """Cover a rectangle with squares of about a side; their edges are multiples of it."""
        size = np.array([side, side])
        first = np.floor(low / size)
        count = np.maximum(np.ceil(high / size) - first, 1.0)
        if frame.round:
            count[0] = max(round(frame.period / side), 1)
            size[0], first[0] = frame.period / count[0], 0.0
        return cls(first * size, size, (int(count[0]), int(count[1])), frame.round)

    @property
    def n(self) -> int:
        """Number of squares."""
        return self.shape[0] * self.shape[1]

    def index(self, places: FloatArray) -> IntArray:
        """Return the squares (...) in which places (..., 2) are; -1 where in none."""
        i = np.floor((places - self.low) / self.size)
        column, row = i[..., 0], i[..., 1]
        if self.periodic:
            column = np.mod(column, self.shape[0])
        # Comparisons with what is not a number are false.
        inside = (column >= 0) & (column < self.shape[0]) & (row >= 0) & (row < self.shape[1])
        found = np.where(inside, column * self.shape[1] + row, -1.0)
        return np.asarray(found.astype(np.int64))

    def middle(self, index: IntArray) -> FloatArray:
        """Return the middles (..., 2) of squares."""
        column, row = np.divmod(index, self.shape[1])
        return np.asarray(self.low + (np.stack([column, row], axis=-1) + 0.5) * self.size)


def corners_of(dives: Sequence[PlacedSurvey]) -> tuple[FloatArray, FloatArray]:
    """Return the least and the greatest u and d, shape (2,) each, that dives passed over."""
    corners = np.concatenate([one.outline.reshape(-1, 2) for one in dives])
    return corners.min(axis=0), corners.max(axis=0)


def spread_over(outline: FloatArray, side: float, share: float = 1.0) -> FloatArray:
    """Return places (K, n, 2) that fill outlines (K, 4, 2) evenly.

    Corners are in turn, beginning with an edge along the way. Places are no farther apart than
    `side`, unless the outline is very large. `share`: of the width across the way, about the
    middle, that is filled.
    """
    if not len(outline):
        return np.empty((0, 1, 2))
    edge = np.linalg.norm(outline - np.roll(outline, 1, axis=1), axis=-1).max(initial=side)
    # Places in a stretch along and across, so that none of the raster is left out between them.
    dense, least, most = 1.5, 4, 48
    n = int(np.clip(np.ceil(dense * edge / side), least, most))
    at = (np.arange(n) + 0.5) / n
    s, t = (one.ravel() for one in np.meshgrid(at, 0.5 + share * (at - 0.5)))
    weights = np.stack([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t], axis=-1)
    return np.asarray(np.einsum("nc,kcx->knx", weights, outline))


def looked_at(one: PlacedSurvey, raster: Raster) -> BoolArray:
    """Mark the squares (n,) where a dive's lasers looked for holes."""
    places = spread_over(one.outline, float(raster.size.min()), one.survey.lasers_share)
    found = np.zeros(raster.n, np.bool_)
    index = raster.index(places).ravel()
    found[index[index >= 0]] = True
    return found


def wrapped(off: FloatArray, frame: WallFrame) -> FloatArray:
    """Return differences (..., 2) the short way round the net."""
    if not frame.round:
        return off
    found = off.copy()
    half = 0.5 * frame.period
    found[..., 0] = np.mod(found[..., 0] + half, frame.period) - half
    return found


# What compass and depth sensor are off by between dives, one standard deviation.
PRIOR_BEARING, PRIOR_DEPTH = np.deg2rad(5.0), 0.5


class _AlignmentOptions(NamedTuple):
    """Alignment of a dive with earlier ones by the pattern of growth."""

    # Places this far apart in a pattern of growth count as independent.
    pattern: float = 0.7
    min_stretches: int = 8


_ALIGNMENT = _AlignmentOptions()

STEP = 0.1
"""Shifts that are tried are this far apart, in metres."""


@dataclass(frozen=True, slots=True)
class SurveyShift:
    """Offset added to a dive's places to align them with those of the first dive."""

    # Shape (2,): metres in u and d; the value is 0 where it is not determined.
    value: FloatArray
    sigma: FloatArray
    # Shape (2,): whether what stayed determines it.
    determined: BoolArray
    # By what: agreement of the growth's pattern beyond chance; holes found again.
    by_pattern: bool = False
    by_holes: bool = False

    @classmethod
    def first(cls) -> "SurveyShift":
        """Return that of the dive on which the others are laid."""
        return cls(np.zeros(2), np.zeros(2), np.ones(2, np.bool_))


class ShiftGrid(NamedTuple):
    """Grid of the shifts that are tried."""

    steps: tuple[FloatArray, FloatArray]  # In u and d, as multiples of `STEP`.
    log_prior: FloatArray  # Shape (n_u, n_d).


def prior_sigma(frame: WallFrame) -> FloatArray:
    """Return what instruments alone leave open, in metres; infinite along a flat net."""
    along = frame.radius * PRIOR_BEARING if frame.round else np.inf
    return np.array([along, PRIOR_DEPTH])


def align(later: PlacedSurvey, earlier: Sequence[PlacedSurvey], frame: WallFrame) -> SurveyShift:
    """Return the shift that lays a dive on earlier ones, which are laid already."""
    sigma = prior_sigma(frame)
    grid = _grid(later, earlier, frame)
    pattern = _pattern_gain(later, earlier, frame, grid)
    holes = _holes_gain(later, earlier, frame, grid)
    log_chance = grid.log_prior + pattern + holes
    chance = np.exp(log_chance - log_chance.max())
    chance /= chance.sum()
    value, spread, determined = np.zeros(2), sigma.copy(), np.zeros(2, np.bool_)
    # A shift is determined if so much of the chance lies so near: in metres along a flat net, else
    # in prior deviations, and at least so many metres.
    min_mass, flat_near, near_share, min_near = 0.95, 0.5, 0.5, 0.3
    for axis in range(2):
        near = max(near_share * sigma[axis], min_near) if np.isfinite(sigma[axis]) else flat_near
        shifts = STEP * grid.steps[axis]
        marginal = chance.sum(axis=1 - axis)
        inside = np.abs(shifts - shifts[np.argmax(marginal)]) <= near
        mass = float(marginal[inside].sum())
        if mass < min_mass:
            continue
        determined[axis] = True
        value[axis] = marginal[inside] @ shifts[inside] / mass
        variance = marginal[inside] @ (shifts[inside] - value[axis]) ** 2 / mass
        spread[axis] = np.sqrt(variance + STEP**2 / 4.0)
    return SurveyShift(
        value, spread, determined, bool(pattern.max() > 0.0), bool(holes.max() > 0.0)
    )


def shifted(one: PlacedSurvey, shift: SurveyShift) -> PlacedSurvey:
    """Return a dive with its places shifted; what the shift leaves open is not in its sigma."""
    return replace(one, outline=one.outline + shift.value, holes=one.holes + shift.value)


def _grid(later: PlacedSurvey, earlier: Sequence[PlacedSurvey], frame: WallFrame) -> ShiftGrid:
    sigma = prior_sigma(frame)
    # Shifts up to this many prior deviations are tried, up to this number.
    deviations, max_shifts = 3.0, 40_000
    reach = np.minimum(deviations * sigma, 0.5 * frame.period)
    centre = 0.0
    if not frame.round:
        known = np.concatenate([one.outline.reshape(-1, 2) for one in earlier])[:, 0]
        mine = later.outline[..., 0]
        least, most = known.min() - mine.max(), known.max() - mine.min()
        centre, reach[0] = 0.5 * (least + most), 0.5 * (most - least)
    n = np.ceil(reach / STEP)
    depths = np.arange(-n[1], n[1] + 1)
    n[0] = min(n[0], max_shifts // len(depths) // 2)
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
    if len(later.rows) < _ALIGNMENT.min_stretches:
        return nothing
    raster, known = _pattern(earlier, frame)
    places = spread_over(later.outline, 1e9)
    mine = _clipped(later.solidity)
    count, agreement = nothing.copy(), nothing.copy()
    best, best_theirs = -np.inf, None
    for i, du in enumerate(STEP * grid.steps[0]):
        for j, dd in enumerate(STEP * grid.steps[1]):
            theirs = _mean_over(known, raster.index(places + np.array([du, dd])))
            good = np.isfinite(theirs)
            count[i, j] = np.count_nonzero(good)
            if count[i, j] < _ALIGNMENT.min_stretches:
                continue
            agreement[i, j] = _correlation(mine[good], _clipped(theirs[good]))
            value = -count[i, j] * np.log1p(-(agreement[i, j] ** 2)) * (agreement[i, j] > 0.0)
            if value > best:
                best, best_theirs = value, theirs
    if best_theirs is None:
        return nothing
    min_overlap = 0.5
    agreement[(agreement < 0.0) | (count < min_overlap * count.max())] = 0.0
    gain = -0.5 * count * np.log1p(-(np.minimum(agreement, 0.9999) ** 2))
    alike, rest = _independent_shares(mine, best_theirs, later.outline.mean(axis=1))
    n_shifts = max(grid.log_prior.size * (STEP / _ALIGNMENT.pattern) ** 2, 1.0)
    # Agreement of patterns that chance alone would show in one of so many cases does not count.
    chance = 0.01
    if alike * gain.max() < np.log(n_shifts / chance):
        return nothing
    return np.asarray(rest * gain)


def _pattern(earlier: Sequence[PlacedSurvey], frame: WallFrame) -> tuple[Raster, FloatArray]:
    """Return the solidity of earlier dives less their median, NaN where they have not been."""
    raster = Raster.around(earlier, STEP, frame)
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
    clip = 3.0
    return np.clip(values, middle - clip * spread, middle + clip * spread)


def _correlation(a: FloatArray, b: FloatArray) -> float:
    a, b = a - a.mean(), b - b.mean()
    spread = float(np.sqrt(a @ a * (b @ b)))
    return float(a @ b) / spread if spread > 0.0 else 0.0


def _independent_shares(
    mine: FloatArray, theirs: FloatArray, middle: FloatArray
) -> tuple[float, float]:
    """Return the share of stretches that count as independent: of patterns, and of what is left.

    Neighbours are alike, along the way and across lanes: by Bartlett's formula for series with a
    memory of one step, in both directions.
    """
    good = np.isfinite(theirs)
    a, b = mine[good] - mine[good].mean(), theirs[good] - theirs[good].mean()
    left = a - b * float(a @ b) / max(float(b @ b), 1e-12)
    beside = _nearest_pairs(middle[good])
    alike = rest = 1.0
    for pairs in (np.stack([np.arange(len(a) - 1), np.arange(1, len(a))]), beside):
        both = _autocorrelation(a, pairs) * _autocorrelation(b, pairs)
        own = _autocorrelation(left, pairs)
        alike *= (1.0 - both) / (1.0 + both)
        rest *= (1.0 - own) / (1.0 + own)
    return alike, rest


def _nearest_pairs(middle: FloatArray) -> IntArray:
    """Return pairs (2, n): stretches, and the nearest of another time, where one is near."""
    # All pairs of so many stretches fit into memory, and tell how alike neighbours are.
    max_beside = 2000
    middle = middle[:max_beside]
    gap = np.abs(np.subtract.outer(np.arange(len(middle)), np.arange(len(middle))))
    distance = np.hypot(*(middle[:, None] - middle[None]).transpose(2, 0, 1))
    # Stretches that follow each other by no more than this belong to one lane.
    lane = 3
    distance[gap <= lane] = np.inf
    nearest = np.argmin(distance, axis=1)
    rows = np.arange(len(middle))
    near = distance[rows, nearest] < 2.0 * _ALIGNMENT.pattern
    return np.stack([rows[near], nearest[near]])


def _autocorrelation(values: FloatArray, pairs: IntArray) -> float:
    if pairs.shape[1] < _ALIGNMENT.min_stretches:
        return 0.0
    return float(np.clip(_correlation(values[pairs[0]], values[pairs[1]]), 0.0, 0.95))


def _holes_gain(
    later: PlacedSurvey, earlier: Sequence[PlacedSurvey], frame: WallFrame, grid: ShiftGrid
) -> FloatArray:
    """Return by how much each shift explains the later holes better than if all were new."""
    kept = 0.5  # Chance that a hole is still there.
    gain = np.zeros(grid.log_prior.shape)
    parts = [(one, k) for one in earlier for k in range(len(one.holes))]
    if not parts or not len(later.holes):
        return gain
    known = np.array([one.holes[k] for one, k in parts])
    size = np.array([one.survey.holes.diameter[k] for one, k in parts])
    spread = np.array([one.sigma for one, _ in parts])
    low, high = corners_of(earlier)
    area = max(float(np.prod(high - low)), 1.0)
    shift = np.stack(np.meshgrid(*(STEP * s for s in grid.steps), indexing="ij"), axis=-1)
    for place, diameter in zip(later.holes, later.survey.holes.diameter, strict=True):
        density = np.zeros(gain.shape)
        for at, other, sigma in zip(known, size, spread, strict=True):
            off = wrapped(place + shift - at, frame)
            middle = 0.25 * max(diameter, other)
            variance = sigma**2 + later.sigma**2 + middle**2 + STEP**2 / 4.0
            peak = _size_gain(diameter, other) / (2.0 * np.pi * np.sqrt(np.prod(variance)))
            density += peak * np.exp(-0.5 * (off**2 / variance).sum(axis=-1))
        gain += np.log((1.0 - kept) + kept * density * area / len(known))
    return gain


def _size_gain(one: float, other: float) -> float:
    """Return how much more likely two diameters are those of one hole than of any two."""
    # A diameter is mostly found again to the first factor (log), else, seen in part, to the second,
    # by which diameters of any holes differ.
    size, sizes, seen_alike = 0.15, 0.5, 0.7
    off = float(np.log(one / other))
    again = sizes / size * np.exp(-0.5 * off**2 * (size**-2 - sizes**-2))
    return seen_alike * float(again) + 1.0 - seen_alike
