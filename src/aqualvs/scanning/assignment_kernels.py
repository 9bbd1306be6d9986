"""Compiled kernels of `AssignmentTest`: rivals of a plane, and the evidence for each of them."""

import math
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import (
    ZERO,
    inline_borrowing_kernel,
    inner_borrowing_kernel,
    inner_kernel,
    lazy_kernel,
)
from aqualvs.geometry.linear_algebra import flatnonzero, n_bins, solve_symmetric, squared, sum_of
from aqualvs.scanning.candidates import Candidates, Subsegments
from aqualvs.scanning.plane_search import (
    JX,
    JY,
    JZ,
    MIN_FACING,
    X,
    Y,
    Z,
    refine_plane,
    squared_gate,
)

INTENSITY_WEIGHT, PER_LASER, DARK, VARIANCE, FREEDOM = range(5)
"""Measures of a hypothesis: intensity weight that it explains, the same divided by the number of
lasers, number of dark lasers, variance of half stripes (px²) and its degrees of freedom."""
N_MEASURES = 5
CELL_LINES = 16
"""Search lines per cell along a stripe."""
SAME_RANGE, SAME_ANGLE = 0.004, math.radians(0.4)
"""Largest differences of hypotheses that count as the same (share of the range, radians)."""


class _LightOptions(NamedTuple):
    """Light of the lasers on a plane, and what counts as dark or faint."""

    # Least intensity weight that a rival must explain, as a share of the surface's.
    rival_share: float = 0.5
    # Subsegments within this many gates of a plane are on it: lasers whose calibration is less
    # accurate than the peaks must not count as dark, nor their light as foreign.
    wide: float = 2.5
    # Ratio of a peak's width to that of a surface's stripes from which it is no laser's.
    wide_peak: float = 2.5
    # Least number of cells to judge a laser; with a smaller share of lit cells than this, relative
    # to that of the other lasers, it is dark.
    min_cells: int = 3
    dark_share: float = 0.25
    # A laser is faint with a visible share below this share of the best laser's.
    faint: float = 0.4
    # Light is in front of a plane beyond this share of its distance; components of this many search
    # lines are those of walls and fish, not the light on strands.
    before: float = 0.03
    long_component: float = 24.0


_LIGHT = _LightOptions()

# Columns of sums over the peaks of one laser's stripe, assigned to some laser: second moments and
# first moments of the points, sum of the confidences, sums of the sensitivities.
_XX, _XY, _XZ, _YY, _YZ, _ZZ, _SX, _SY, _SZ, _N, _SJX, _SJY, _SJZ, _N_SUMS = range(14)


@lazy_kernel
def find_rivals(
    candidates: Candidates,
    of_candidate: IntArray,
    table: FloatArray,
    members: BoolArray,
    nearest: float,
    farthest: float,
    n_lasers: int,
    planes: FloatArray,
) -> int:
    """Write planes that explain a surface's peaks as those of other lasers; return their number.

    Parameters
    ----------
    candidates : Candidates
        N of them.
    of_candidate : int array, shape (N,)
    table : array, shape (7, C)
        As in `Subsegments`.
    members : bool array, shape (C,)
        Subsegments on the surface.
    nearest, farthest : float
        Limits of the planes that are considered, in metres.
    n_lasers : int
        Lasers of the rig.
    planes : array, shape (1 + n, 4)
        Normals and offsets. The first is that of the surface, and is refined; the others are
        written.
    """
    sums = np.zeros((n_lasers, n_lasers, _N_SUMS))
    place = np.zeros((n_lasers, 3))
    _sum_candidates(candidates, of_candidate, members, sums)
    total, other = 0.0, 0.0
    for i in range(n_lasers):
        own = sums[i, i, _N]
        total += own
        most = 0.0
        for a in range(n_lasers):
            if a != i:
                most = max(most, sums[i, a, _N])
        other += min(most, own)
        if own > 0.0:
            for k in range(3):
                place[i, k] = sums[i, i, _SX + k] / own
    if other < _LIGHT.rival_share * total:
        return 0
    seeds = _choose_seeds(sums, place)
    score = np.zeros(planes.shape[0])
    n = ZERO
    for p in range(seeds.shape[0]):
        for q in range(p + 1, seeds.shape[0]):
            n = _try_pair(sums, seeds[p], seeds[q], nearest, farthest, total, planes, score, n)
    return _refine_rivals(table, nearest, farthest, planes, n)


@inner_kernel
def _sum_candidates(
    candidates: Candidates, of_candidate: IntArray, members: BoolArray, sums: FloatArray
) -> None:
    """Sum the moments of each laser's peaks on the surface, assigned to every laser (L, L, 13)."""
    source, laser, points = candidates.source, candidates.laser, candidates.points
    sensitivity = candidates.sensitivity
    owner = np.full(n_bins(source), -1)
    for i in range(source.shape[0]):
        if members[of_candidate[i]]:
            owner[source[i]] = laser[i]
    for i in range(source.shape[0]):
        own = owner[source[i]]
        if own < 0:
            continue
        w, row = candidates.confidence[i], sums[own, laser[i]]
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        row[_XX] += w * x * x
        row[_XY] += w * x * y
        row[_XZ] += w * x * z
        row[_YY] += w * y * y
        row[_YZ] += w * y * z
        row[_ZZ] += w * z * z
        row[_SX] += w * x
        row[_SY] += w * y
        row[_SZ] += w * z
        row[_N] += w
        row[_SJX] += w * sensitivity[i, 0]
        row[_SJY] += w * sensitivity[i, 1]
        row[_SJZ] += w * sensitivity[i, 2]


@inner_kernel
def _choose_seeds(sums: FloatArray, place: FloatArray) -> IntArray:
    """Return lasers whose stripes on the surface are bright and far from each other."""
    n_lasers = place.shape[0]
    # Number of lasers whose stripes start rivals.
    n_seeds = 4
    seeds, n = np.empty(min(n_seeds, n_lasers), np.int64), 0
    while n < seeds.shape[0]:
        best, most = -1, 0.0
        for i in range(n_lasers):
            value = sums[i, i, _N]
            apart = np.inf
            for k in range(n):
                square = 0.0
                for j in range(3):
                    square += squared(place[i, j] - place[seeds[k], j])
                apart = min(apart, np.sqrt(square))
            value *= 1.0 if n == 0 else apart
            if value > most:
                best, most = i, value
        if best < 0:
            break
        seeds[n] = best
        n += 1
    return seeds[:n]


@inner_kernel
def _try_pair(
    sums: FloatArray,
    i: int,
    k: int,
    nearest: float,
    farthest: float,
    total: float,
    planes: FloatArray,
    score: FloatArray,
    n: int,
) -> int:
    """Assign the stripes i and k to any two lasers; keep the best planes, and return their number.

    `total` is the intensity weight of the surface; `planes` and `score` are as in `_keep_best`.
    """
    n_lasers = sums.shape[0]
    plane = np.empty(4)
    normal, scratch, right, m = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    for a in range(n_lasers):
        for b in range(n_lasers):
            if a == b or (a == i and b == k):
                continue
            first, second = sums[i, a], sums[k, b]
            if first[_N] < _LIGHT.rival_share * sums[i, i, _N]:
                continue
            if second[_N] < _LIGHT.rival_share * sums[k, k, _N]:
                continue
            if not _fit_two(first, second, normal, scratch, right, m, plane):
                continue
            if plane[3] < nearest or plane[3] > farthest or plane[1] < MIN_FACING:
                continue
            value = _explained(sums, plane)
            if value >= _LIGHT.rival_share * total:
                n = _keep_best(plane, value, planes, score, n)
    return n


@inline_borrowing_kernel
def _fit_two(
    first: FloatArray,
    second: FloatArray,
    normal: FloatArray,
    scratch: FloatArray,
    right: FloatArray,
    m: FloatArray,
    plane: FloatArray,
) -> bool:
    """Fit X·m = 1 to the peaks of two stripes with equal weights, given their sums.

    Write normal and offset to `plane`; return False if the fit is singular.
    """
    u, v = 1.0 / first[_N], 1.0 / second[_N]
    normal[0, 0] = u * first[_XX] + v * second[_XX]
    normal[1, 0] = u * first[_XY] + v * second[_XY]
    normal[2, 0] = u * first[_XZ] + v * second[_XZ]
    normal[1, 1] = u * first[_YY] + v * second[_YY]
    normal[2, 1] = u * first[_YZ] + v * second[_YZ]
    normal[2, 2] = u * first[_ZZ] + v * second[_ZZ]
    for j in range(3):
        right[j] = u * first[_SX + j] + v * second[_SX + j]
    if not solve_symmetric(normal, right, scratch, m):
        return False
    length = np.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
    if not (length > 0.0 and length < np.inf):
        return False
    for j in range(3):
        plane[j] = m[j] / length
    plane[3] = 1.0 / length
    return True


@inner_borrowing_kernel
def _explained(sums: FloatArray, plane: FloatArray) -> float:
    """Return the weight of the stripes on a plane, each assigned to the laser that fits best.

    A stripe counts less, the larger its mean square distance from the plane is.
    """
    x, y, z, d = plane[0], plane[1], plane[2], plane[3]
    total = 0.0
    for i in range(sums.shape[0]):
        best = 0.0
        for a in range(sums.shape[0]):
            row = sums[i, a]
            n = row[_N]
            if n <= best:
                continue
            square = x * (x * row[_XX] + 2.0 * (y * row[_XY] + z * row[_XZ]))
            square += y * (y * row[_YY] + 2.0 * z * row[_YZ]) + z * z * row[_ZZ]
            square += -2.0 * d * (x * row[_SX] + y * row[_SY] + z * row[_SZ]) + n * d * d
            per_px = (x * row[_SJX] + y * row[_SJY] + z * row[_SJZ]) / n
            gate = _LIGHT.wide * _LIGHT.wide * squared_gate(per_px, d)
            best = max(best, n * (1.0 - square / (n * gate)))
        total += best
    return total


@inner_kernel
def _keep_best(
    plane: FloatArray, value: float, planes: FloatArray, score: FloatArray, n: int
) -> int:
    """Put a plane with the score `value` among the n best rivals, in rows 1 to n of `planes`.

    It replaces a similar one if it is better, else the worst one if all rows are filled; planes
    similar to that of the surface, in row 0, are dropped. Return the new n.
    """
    if _same(plane, planes[0], 2.0):
        return n
    at = 1
    while at <= n and not _same(plane, planes[at], 2.0):
        at += 1
    if at == planes.shape[0]:
        at = 1
        for k in range(2, n + 1):
            if score[k] < score[at]:
                at = k
    if at <= n and value <= score[at]:
        return n
    _copy_plane(plane, planes[at])
    score[at] = value
    return max(n, at)


@inline_borrowing_kernel
def _copy_plane(plane: FloatArray, out: FloatArray) -> None:
    """Copy a plane (4,): an assigned slice would compile error messages about shapes as well."""
    for k in range(4):
        out[k] = plane[k]


@inline_borrowing_kernel
def _same(one: FloatArray, other: FloatArray, times: float) -> bool:
    """Return whether planes differ by less than `times` the limits of equal hypotheses."""
    cosine = one[0] * other[0] + one[1] * other[1] + one[2] * other[2]
    near = abs(one[3] - other[3]) < times * SAME_RANGE * other[3]
    return bool(near and 2.0 * (1.0 - cosine) < squared(times * SAME_ANGLE))


@inner_kernel
def _refine_rivals(
    table: FloatArray, nearest: float, farthest: float, planes: FloatArray, n: int
) -> int:
    """Refine the surface's plane and n rivals in place; drop duplicates, return the number left."""
    normal, scratch, lanes = np.empty((3, 3)), np.empty((5, 3)), np.empty(table.shape[1])
    kept = 0
    for _ in range(2):
        refine_plane(table, planes[0], _LIGHT.wide, normal, scratch, lanes)
    for k in range(1, n + 1):
        plane = planes[k]
        good = True
        for gate_scale in (_LIGHT.wide, 1.0, 1.0, _LIGHT.wide, _LIGHT.wide):
            good = good and refine_plane(table, plane, gate_scale, normal, scratch, lanes)
        good = good and nearest <= plane[3] <= farthest and plane[1] >= MIN_FACING
        for j in range(kept + 1):
            good = good and not _same(plane, planes[j], 1.0)
        if good:
            kept += 1
            _copy_plane(plane, planes[kept])
    return kept


@lazy_kernel
def judge_planes(
    planes: FloatArray,
    candidates: Candidates,
    subsegments: Subsegments,
    along_x: BoolArray,
    bands: FloatArray,
    measures: FloatArray,
) -> None:
    """Write the evidence for every plane.

    Parameters
    ----------
    planes : array, shape (P, 4)
        Normals and offsets.
    candidates : Candidates
        N of them.
    subsegments : Subsegments
        C of them.
    along_x : bool array, shape (n_lasers,)
        Whether each laser's search lines run along x.
    bands : array, shape (n_lasers, cells, samples, 4)
        Points P that each laser's band sees, as (P, 1) / |P|; NaN where nothing is seen.
    measures : array, shape (P, 5)
        Written, see `INTENSITY_WEIGHT`.
    """
    n_lasers, n_cells = bands.shape[0], bands.shape[1]
    seen, near = np.full(n_bins(candidates.source), -1), np.empty(subsegments.laser.shape[0])
    lit, expected = np.empty((n_lasers, n_cells), np.bool_), np.empty((n_lasers, n_cells), np.bool_)
    for k in range(planes.shape[0]):
        plane, found = planes[k], measures[k]
        _mark_lit_cells(plane, subsegments, near, lit)
        found[INTENSITY_WEIGHT] = _intensity_weight_on(
            k, near, candidates, subsegments.of_candidate, seen
        )
        found[VARIANCE], found[FREEDOM], n_lit = _variance(plane, subsegments, near, n_lasers)
        found[PER_LASER] = found[INTENSITY_WEIGHT] / max(n_lit, 1)
        _mark_expected(plane, bands, expected)
        found[DARK] = _dark_lasers(lit, expected, along_x)


@inner_borrowing_kernel
def _mark_lit_cells(
    plane: FloatArray, subsegments: Subsegments, near: FloatArray, lit: BoolArray
) -> None:
    """Write how near each subsegment is to a plane, 0 to 1; mark the cells with light near it.

    `lit` has the shape (n_lasers, cells).
    """
    table, laser = subsegments.table, subsegments.laser
    lit[:] = False
    x, y, z, offset = plane[0], plane[1], plane[2], plane[3]
    for c in range(laser.shape[0]):
        residual = x * table[X, c] + y * table[Y, c] + z * table[Z, c] - offset
        per_px = x * table[JX, c] + y * table[JY, c] + z * table[JZ, c]
        gate = _LIGHT.wide * _LIGHT.wide * squared_gate(per_px, offset)
        near[c] = max(1.0 - residual * residual / gate, 0.0)
        if near[c] > 0.0:
            first, last = subsegments.first_line[c], subsegments.last_line[c]
            for cell in range(first // CELL_LINES, last // CELL_LINES + 1):
                lit[laser[c], cell] = True


@inner_borrowing_kernel
def _intensity_weight_on(
    number: int, near: FloatArray, candidates: Candidates, of_candidate: IntArray, seen: IntArray
) -> float:
    """Return the sum over the peaks on plane `number` of their confidence times nearness.

    Each peak counts once, whatever the number of its candidates on the plane.
    """
    source, total = candidates.source, 0.0
    for i in range(source.shape[0]):
        share = near[of_candidate[i]]
        if share > 0.0 and seen[source[i]] != number:
            seen[source[i]] = number
            total += candidates.confidence[i] * share
    return total


@inner_kernel
def _variance(
    plane: FloatArray, subsegments: Subsegments, near: FloatArray, n_lasers: int
) -> tuple[float, float, int]:
    """Return variance (px²) of half stripes about a plane, degrees of freedom, visible lasers."""
    table, n_lines, laser = subsegments.table, subsegments.n_lines, subsegments.laser
    first_line = subsegments.first_line
    x, y, z, offset = plane[0], plane[1], plane[2], plane[3]
    square, n, most, n_lit = 0.0, 0, 0, 0
    begin, lit_lines = 0, np.zeros(n_lasers, np.int64)
    # Least number of search lines of half a stripe, and of a visible laser, as a share of the most:
    # a stripe of another plane is near this one where it crosses it.
    min_lines, min_share = 8, 0.15
    for i in range(n_lasers):
        end, middle, lines = begin, 0.0, 0
        while end < laser.shape[0] and laser[end] == i:
            if near[end] > 0.0:
                middle += n_lines[end] * first_line[end]
                lines += n_lines[end]
            end += 1
        middle /= max(lines, 1)
        lit_lines[i], most = lines, max(most, lines)
        for half in range(2):
            total, lines = 0.0, 0
            for c in range(begin, end):
                if near[c] > 0.0 and (first_line[c] >= middle) == (half == 1):
                    residual = x * table[X, c] + y * table[Y, c] + z * table[Z, c] - offset
                    per_px = x * table[JX, c] + y * table[JY, c] + z * table[JZ, c]
                    total += n_lines[c] * residual / per_px
                    lines += n_lines[c]
            if lines >= min_lines:
                square += squared(total / lines)
                n += 1
        begin = end
    for i in range(n_lasers):
        n_lit += lit_lines[i] >= max(min_lines, min_share * most)
    freedom = n - 3.0
    if freedom <= 0.0:
        return 1.0, 0.0, n_lit
    # Least noise (px) of half a stripe.
    half_stripe_px = 0.1
    return square / freedom + half_stripe_px * half_stripe_px, freedom, n_lit


@inner_borrowing_kernel
def _mark_expected(plane: FloatArray, bands: FloatArray, expected: BoolArray) -> None:
    """Mark the cells (n_lasers, cells) where each laser's stripe on a plane lies in its band.

    There m·P - 1 changes its sign between two samples.
    """
    x, y, z, offset = plane[0], plane[1], plane[2], plane[3]
    for i in range(bands.shape[0]):
        for cell in range(bands.shape[1]):
            before, found = np.nan, False
            for s in range(bands.shape[2]):
                row = bands[i, cell, s]
                here = x * row[0] + y * row[1] + z * row[2] - offset * row[3]
                if here * before <= 0.0:
                    found = True
                    break
                before = here
            expected[i, cell] = found


@lazy_kernel
def exclusive_share(
    source: IntArray,
    confidence: FloatArray,
    subsegments: Subsegments,
    members: BoolArray,
    others: BoolArray,
    inlier_weight: float,
) -> float:
    """Return the light on a surface, as a share of all light that is not on other surfaces.

    Parameters
    ----------
    source, confidence
        As in `Candidates`, N of them.
    subsegments : Subsegments
        C of them.
    members, others : bool array, shape (C,)
        Subsegments on the surface, and on other surfaces.
    inlier_weight : float
        Of the surface: less than its intensity weight if one laser dominates, because the surplus
        of one laser is no evidence for a plane.
    """
    n = n_bins(source)
    # For each peak: its confidence, and 2 if it is on the surface, 1 if only on others, else 0.
    light, owner = np.zeros(n), np.zeros(n, np.int64)
    for i in range(source.shape[0]):
        c, r = subsegments.of_candidate[i], source[i]
        light[r] = confidence[i]
        owner[r] = max(owner[r], 2 if members[c] else int(others[c]))
    total, on = 0.0, 0.0
    for r in range(n):
        total += light[r] if owner[r] != 1 else 0.0
        on += light[r] if owner[r] == 2 else 0.0
    of_members = 0.0
    for c in range(members.shape[0]):
        of_members += subsegments.intensity_weight[c] if members[c] else 0.0
    return on / max(total, 1e-12) * (inlier_weight / of_members)


@lazy_kernel
def loose_share_before(
    candidates: Candidates,
    of_candidate: IntArray,
    n_lines: FloatArray,
    members: BoolArray,
    explained: BoolArray,
    plane: FloatArray,
    nearest: float,
) -> float:
    """Return the loose light in front of a surface, over the surface's own light.

    Loose light is that of peaks in short components on no surface, about as wide as the stripes on
    the surface: wider ones are its texture, or caustics. Peaks that some laser may have made at or
    behind the surface are not counted: with many lasers, these are nearly all noise.

    Parameters
    ----------
    candidates : Candidates
        N of them.
    of_candidate : int array, shape (N,)
        Row of each one's subsegment.
    n_lines : array, shape (S,)
        Search lines of each component.
    members, explained : bool array, shape (C,)
        Subsegments on the surface, and on any surface.
    plane : array, shape (4,)
        Normal and offset of the surface.
    nearest : float
        Least distance along the forward axis, in metres.
    """
    source, points, n = candidates.source, candidates.points, n_bins(candidates.source)
    light, width = np.zeros((2, n))
    own, bound = np.zeros((2, n), np.bool_)
    for i in range(source.shape[0]):
        c, r = of_candidate[i], source[i]
        off = -plane[3]
        for k in range(3):
            off += plane[k] * points[i, k]
        light[r], width[r] = candidates.confidence[i], candidates.width[i]
        own[r] |= members[c]
        # A peak is bound if any of its candidates is, whatever the laser.
        bound[r] |= (
            explained[c]
            or n_lines[candidates.component[i]] >= _LIGHT.long_component
            or off > -_LIGHT.before * plane[3]
            or points[i, 1] <= nearest
        )
    of_surface, total_width = 1e-12, 0.0
    for r in range(n):
        if own[r]:
            of_surface += light[r]
            total_width += light[r] * width[r]
    widest, loose = _LIGHT.wide_peak * total_width / of_surface, 0.0
    for r in range(n):
        loose += light[r] if not bound[r] and width[r] <= widest else 0.0
    return loose / of_surface


@lazy_kernel
def two_longest_stripes(
    subsegments: Subsegments, members: BoolArray, n_lasers: int
) -> tuple[int, int, float]:
    """Return the two lasers with most search lines on a surface, and the share of the others'.

    Parameters
    ----------
    subsegments : Subsegments
        C of them.
    members : bool array, shape (C,)
        Those on the surface.
    n_lasers : int
        Lasers of the rig, two at least.
    """
    lines = np.zeros(n_lasers)
    for c in range(members.shape[0]):
        if members[c]:
            lines[subsegments.laser[c]] += subsegments.n_lines[c]
    first, second = 0, -1
    for i in range(1, n_lasers):
        if lines[i] > lines[first]:
            first, second = i, first
        elif second < 0 or lines[i] > lines[second]:
            second = i
    total = sum_of(lines)
    return first, second, (total - lines[first] - lines[second]) / max(total, 1e-12)


@lazy_kernel
def stripe_visibility(
    plane: FloatArray,
    members: BoolArray,
    subsegments: Subsegments,
    bands: FloatArray,
    along_strand: bool,
) -> tuple[float, float, float, int]:
    """Return the visible share of a surface's best stripe; shares of faint and of dark lasers.

    The visible share of a stripe is the number of its search lines on the surface, over that of the
    cells in which the stripe lies in the picture. Lasers in few cells are not judged. The last
    number is that of the lasers that are judged and not faint.

    Parameters
    ----------
    plane : array, shape (4,)
        Normal and offset.
    members : bool array, shape (C,)
        Subsegments on the surface.
    subsegments : Subsegments
        C of them.
    bands
        As in `judge_planes`.
    along_strand : bool
        Whether the best stripe may lie along a strand: lasers are then faint beside the second
        best one.
    """
    laser = subsegments.laser
    n_lasers, n_cells = bands.shape[0], bands.shape[1]
    expected, visible = np.empty((n_lasers, n_cells), np.bool_), np.zeros(n_lasers)
    _mark_expected(plane, bands, expected)
    for c in range(laser.shape[0]):
        if members[c]:
            visible[laser[c]] += subsegments.n_lines[c]
    most, second, asked, faint, dark = 0.0, 0.0, 0, 0, 0
    for i in range(n_lasers):
        cells = flatnonzero(expected[i]).shape[0]
        visible[i] = visible[i] / (CELL_LINES * cells) if cells >= _LIGHT.min_cells else np.nan
        if visible[i] == visible[i]:
            second = max(second, min(most, visible[i]))
            most = max(most, visible[i])
    for i in range(n_lasers):
        if visible[i] == visible[i]:
            asked += 1
            faint += visible[i] < _LIGHT.faint * (second if along_strand else most)
            dark += visible[i] == 0.0
    return most, faint / max(asked, 1), dark / max(asked, 1), asked - faint


@inner_borrowing_kernel
def _dark_lasers(lit: BoolArray, expected: BoolArray, along_x: BoolArray) -> float:
    """Return the number of lasers that are dark where others are visible; dim ones count in part.

    `lit` and `expected` have the shape (n_lasers, cells).
    """
    n_lasers, n_cells = lit.shape
    dark = 0.0
    # A cell counts if this share of the other lasers that can be visible there is.
    lit_share = 0.15
    for i in range(n_lasers):
        asked, seen, of_others, by_others = 0, 0, 0.0, 0.0
        for cell in range(n_cells):
            if not expected[i, cell]:
                continue
            there, shown = 0, 0
            for k in range(n_lasers):
                if k != i and along_x[k] == along_x[i] and expected[k, cell]:
                    there += 1
                    shown += lit[k, cell]
            if shown < 1 or shown < lit_share * there:
                continue
            asked += 1
            seen += lit[i, cell]
            of_others += there
            by_others += shown
        if asked < _LIGHT.min_cells:
            continue
        typical = _LIGHT.dark_share * by_others / of_others
        share = seen / asked
        if share < typical:
            dark += 1.0 - share / typical
    return dark
