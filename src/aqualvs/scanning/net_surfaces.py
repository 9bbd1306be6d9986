"""Net surfaces: classification of stripes as a net's, joining of its planes, and its mean plane.

`describe_pattern` classifies the stripes on a surface by their lit intervals and gaps. A net is the
only surface through which another one is visible: along a stripe, light on it alternates with light
behind it (`seen_through`). The flanks of a fold are found as separate planes, which lie side by
side, and one begins where the other ends (`is_continuation`); `merged_plane` gives their plane.
`fit_mean_plane` fits the mean plane of a net that is mostly folds, and `inflate_covariance` adds
the difference from another posture to the covariance of a posture.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import inner_kernel, lazy_borrowing_kernel, lazy_kernel
from aqualvs.geometry.linear_algebra import (
    invert_symmetric,
    median_of,
    n_bins,
    solve_symmetric,
    squared,
)
from aqualvs.geometry.planes import Plane
from aqualvs.scanning.candidates import Candidates, Subsegments
from aqualvs.scanning.patch import height_over
from aqualvs.scanning.plane_fit import TUKEY, PlaneFit, normal_equations
from aqualvs.scanning.plane_search import WEIGHT, X, Z
from aqualvs.scanning.posture import Posture, range_pitch_yaw

# Transitions between two surfaces along the stripes, as a share of their expected number in random
# order: with fewer than the first, the surfaces are side by side; with more than the second, one is
# seen through the other, if there are enough transitions.
_MAX_TRANSITIONS = 0.5
_MIN_TRANSITIONS = 0.6
_ENOUGH_TRANSITIONS = 8


def is_continuation(
    plane: Plane, first: BoolArray, second: BoolArray, subsegments: Subsegments
) -> bool:
    """Return whether one surface continues beside another one.

    Parameters
    ----------
    plane : Plane
        Of the first.
    first, second : bool array, shape (C,)
        Subsegments on them.
    subsegments : Subsegments
        C of them.
    """
    packed = plane.packed()
    transitions, at_random, met = _count_transitions(subsegments, first, second, packed)
    # Share of the transitions at which one surface must begin where the other ends.
    min_share = 0.5
    side_by_side = 0 < transitions <= max(_MAX_TRANSITIONS * at_random, 1.0)
    return side_by_side and met >= min_share * transitions


def seen_through(first: BoolArray, second: BoolArray, subsegments: Subsegments) -> bool:
    """Return whether one surface is seen through the gaps of another.

    Parameters
    ----------
    first, second : bool array, shape (C,)
        Subsegments on them.
    subsegments : Subsegments
        C of them.
    """
    transitions, at_random, _ = _count_transitions(subsegments, first, second, np.zeros(4))
    return bool(transitions >= _ENOUGH_TRANSITIONS and transitions >= _MIN_TRANSITIONS * at_random)


def has_strands_before(
    candidates: Candidates,
    of_candidate: IntArray,
    n_lines: FloatArray,
    members: BoolArray,
    plane: Plane,
) -> bool:
    """Return whether light in front of a surface may lie on the strands of a net.

    It is in pieces of several search lines, hardly fainter than the surface's stripes and not
    much wider; of the lasers that may have made a peak, one lights something in front.

    Parameters
    ----------
    candidates : Candidates
        N of them.
    of_candidate : int array, shape (N,)
        Row of each one's subsegment.
    n_lines : array, shape (S,)
        Search lines of each component.
    members : bool array, shape (C,)
        Subsegments on the surface.
    plane : Plane
        Of the surface.
    """
    # Noise and edges make shorter pieces; least distance in front; limits of height and width.
    min_lines, before_share, lowest, widest = 25, 0.03, 0.75, 2.5
    source, confidence, height = candidates.source, candidates.confidence, candidates.height
    mine, own = members[of_candidate], np.zeros(n_bins(source), np.bool_)
    own[source[mine]] = True
    width = np.average(candidates.width[mine], weights=confidence[mine])
    off = candidates.points @ plane.normal - plane.offset
    in_front = off < -before_share * plane.offset
    strand = in_front & ~own[source] & (n_lines[candidates.component] >= min_lines)
    strand &= (candidates.width <= widest * width) & (height >= lowest * np.median(height[mine]))
    light, on_strand = np.zeros(len(own)), np.zeros(len(own), np.bool_)
    light[source], on_strand[source[strand]] = confidence, True
    # Blocks of search lines with a stripe of the surface, and the share of them with strands.
    block_lines = 32
    block = candidates.laser * n_bins(candidates.line) + candidates.line // block_lines
    spread = np.isin(np.unique(block[mine]), block[strand]).mean()
    # Least light, as a share of the surface's own, and least spread. Of 33 walls that eight lasers
    # showed behind a net, 24 have more of both; walls among fish, fans with false edges, and real
    # walls with 15 lasers, overexposed or in noise, do not.
    min_share, min_spread = 0.07, 0.28
    return bool(light[on_strand].sum() > min_share * light[own].sum() and spread > min_spread)


def _count_transitions(
    subsegments: Subsegments, first: BoolArray, second: BoolArray, plane: FloatArray
) -> tuple[int, float, int]:
    """Return the number of transitions between two surfaces along the stripes.

    Return also the number that is expected in random order, and the number of transitions whose
    step off the plane (4,) a fold can make.
    """
    rows = np.flatnonzero(first | second)
    rows = rows[np.lexsort((subsegments.first_line[rows], subsegments.laser[rows]))]
    laser, on_second = subsegments.laser[rows], second[rows]
    total, n_second = np.bincount(laser), np.bincount(laser, weights=on_second)
    seen = total > 0
    total, n_second = total[seen], n_second[seen]
    at_random = float(np.sum(2.0 * n_second * (total - n_second) / total))
    transitions = np.flatnonzero((laser[1:] == laser[:-1]) & (on_second[1:] != on_second[:-1]))
    difference = (
        subsegments.table[X : Z + 1, rows[transitions + 1]]
        - subsegments.table[X : Z + 1, rows[transitions]]
    )
    step = plane[:3] @ difference
    beside = np.sqrt(np.maximum((difference * difference).sum(axis=0) - step * step, 0.0))
    # Slope of the steepest flank of a fold, and noise of the step between two subsegments, as a
    # share of the range.
    steepest = 2.0
    noise_share = 0.01
    met = np.abs(step) <= steepest * beside + noise_share * plane[3]
    return len(transitions), at_random, int(np.count_nonzero(met))


def merged_plane(
    planes: Sequence[Plane], members: Sequence[BoolArray], subsegments: Subsegments
) -> Plane:
    """Return the plane of a net that consists of several: the main one, or the mean if none is.

    Parameters
    ----------
    planes : sequence of Plane
        Of its parts.
    members : sequence of bool array, shape (C,)
        Subsegments on them.
    subsegments : Subsegments
        C of them.
    """
    sampling_weight = np.array([subsegments.table[WEIGHT] @ mine for mine in members])
    main = int(np.argmax(sampling_weight))
    # A plane with more than this share of the sampling weight is the main one; the rest is folds.
    main_share = 0.5
    if sampling_weight[main] > main_share * sampling_weight.sum():
        return planes[main]
    mine = np.logical_or.reduce(members)
    weight = np.sqrt(subsegments.table[WEIGHT, mine])
    points = subsegments.table[X : Z + 1, mine].T
    m = np.linalg.lstsq(weight[:, None] * points, weight)[0]
    length = float(np.linalg.norm(m))
    return Plane(m / length, 1.0 / length)


@lazy_borrowing_kernel
def share_near(points: FloatArray, laser: IntArray, patch: FloatArray, near: float) -> float:
    """Return the share of strands that are nearer to a surface than `near`, in metres.

    It is that of the second best laser: a line and a point share a plane, so that a plane may hold
    all strands of one laser by chance.

    Parameters
    ----------
    points : array, shape (N, 3), laser : int array, shape (N,)
        Of the strands.
    patch : array, shape (16,)
        The surface as a patch.
    """
    best, second = 0.0, 0.0
    for k in range(n_bins(laser)):
        n, on = 0, 0
        for i in range(laser.shape[0]):
            if laser[i] == k:
                n += 1
                x, y, z = points[i, 0], points[i, 1], points[i, 2]
                on += abs(height_over(patch, x, y, z)) < near
        share = on / max(n, 1)
        best, second = max(best, share), max(min(best, share), second)
    return second


def fit_mean_plane(
    points: FloatArray, laser: IntArray, start: Plane, *, reject: bool = True
) -> PlaneFit | None:
    """Fit m·X = 1 to the strands of a folded net, with equal weights.

    The scatter about the plane is due to the folds, and gives the covariance.

    Parameters
    ----------
    points : array, shape (N, 3), laser : int array, shape (N,)
        Of the strands, in `dome`, metres.
    start : Plane
        Initial guess, from which outliers are judged.
    reject : bool
        Whether strands have Tukey's weights; else all have the weight 1.

    Returns
    -------
    PlaneFit or None
        None where the points do not determine a plane.
    """
    if len(points) <= 3:
        return None
    m, weights, covariance = start.normal / start.offset, np.empty(len(points)), np.empty((3, 3))
    rms = _fit_mean_plane(points, laser, reject, m, weights, covariance)
    return PlaneFit(m, covariance, weights, rms) if np.isfinite(rms) else None


@lazy_kernel
def _fit_mean_plane(
    points: FloatArray,
    laser: IntArray,
    reject: bool,
    m: FloatArray,
    weights: FloatArray,
    covariance: FloatArray,
) -> float:
    """Refine m (3,) in place, write weights (N,) and covariance (3, 3).

    Return the rms in metres, NaN if the points do not determine m.
    """
    n, one = points.shape[0], np.empty(points.shape[0])
    for i in range(n):
        one[i] = 1.0
    off, normal, right, inverse = np.empty(n), np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    iterations = 5
    exact = 1e-9  # Least typical distance, as a share of the range.
    for _ in range(iterations):
        _distances(points, m, off)
        typical = max(_typical_distance(off, laser), exact) if reject else np.inf
        cut = TUKEY * 1.4826 * typical
        for i in range(n):
            weights[i] = squared(max(1.0 - squared(off[i] / cut), 0.0))
        normal_equations(points, one, weights, normal, right)
        if not solve_symmetric(normal, right, inverse, m):
            return np.nan
    if not invert_symmetric(normal, covariance):
        return np.nan
    _distances(points, m, off)
    square, weight = 0.0, 0.0
    for i in range(n):
        square += weights[i] * off[i] * off[i]
        weight += weights[i]
    factor = square / (weight * (1.0 - 3.0 / n))
    for j in range(3):
        for k in range(3):
            covariance[j, k] *= factor
    return float(np.sqrt(square / weight / (m[0] * m[0] + m[1] * m[1] + m[2] * m[2])))


@inner_kernel
def _typical_distance(off: FloatArray, laser: IntArray) -> float:
    """Return the median |m·X - 1| of the second best laser's strands, as in `share_near`."""
    best, second, mine = np.inf, np.inf, np.empty(off.shape[0])
    for k in range(n_bins(laser)):
        n = 0
        for i in range(off.shape[0]):
            if laser[i] == k:
                mine[n] = abs(off[i])
                n += 1
        if n > 0:
            median = median_of(mine[:n])
            best, second = min(best, median), min(max(best, median), second)
    return second if second < np.inf else best


@inner_kernel
def _distances(points: FloatArray, m: FloatArray, off: FloatArray) -> None:
    """Write m·X - 1 of each point (N,)."""
    for i in range(points.shape[0]):
        off[i] = m[0] * points[i, 0] + m[1] * points[i, 1] + m[2] * points[i, 2] - 1.0


def inflate_covariance(posture: Posture, other: Posture, share: float) -> Posture:
    """Return a posture with its covariance inflated by its difference from another one.

    Parameters
    ----------
    posture, other : Posture
        Two estimates of the same posture.
    share : float
        Weight of the squared difference: the share of the light that supports the other one.
    """
    difference = _difference(posture, other)
    return replace(
        posture, covariance=posture.covariance + share * np.outer(difference, difference)
    )


def inflate_for_plane(posture: Posture, plane: Plane, share: float) -> Posture:
    """Return a posture with its covariance inflated by its difference from a plane's posture.

    `share`: as in `inflate_covariance`.
    """
    distance, pitch, yaw = range_pitch_yaw(plane.normal / plane.offset)
    return inflate_covariance(
        posture, replace(posture, range=distance, pitch=pitch, yaw=yaw), share
    )


def disagreement(posture: Posture, other: Posture) -> float:
    """Return the squared Mahalanobis distance of a posture from another, by the other's sigmas."""
    return _squared_distance(_difference(posture, other), other.covariance)


@lazy_kernel
def _squared_distance(difference: FloatArray, covariance: FloatArray) -> float:
    """Return the squared Mahalanobis distance; infinite if the covariance is singular."""
    solved = np.empty(3)
    if not solve_symmetric(covariance, difference, np.empty((3, 3)), solved):
        return np.inf
    return float(difference[0] * solved[0] + difference[1] * solved[1] + difference[2] * solved[2])


def _difference(posture: Posture, other: Posture) -> FloatArray:
    """Return the difference (3,) of range, pitch and yaw, in m and rad."""
    return np.array(
        [other.range - posture.range, other.pitch - posture.pitch, other.yaw - posture.yaw]
    )


MIN_LINES_PER_LASER = 8
"""Least number of search lines with which a laser supports a surface."""
# Largest duty of gappy stripes, as on a dense net or a wall in a net's shadows; above it the gaps
# are specks. The duty is a typical lit interval over the sum of it and a typical gap.
_GAPPY_DUTY = 0.9
# Lit intervals with fewer dark search lines between them are one.
_MIN_GAP_LINES = 3
# Least number of lit intervals of a gappy stripe.
_MIN_INTERVALS = 3
# This many short intervals on all lasers, and no long ones, are a net of which little is visible.
_FEW_INTERVALS = 5
LONGEST_INTERVAL = 0.03
"""Largest length of the light on one strand, typically, in metres."""
# A stripe with this share of its lit search lines in intervals of more than twice that length lies
# on something solid, partly hidden or broken by its texture; growth and strands along a laser make
# few of them.
_UNBROKEN_SHARE, _UNBROKEN_LENGTHS = 0.4, 2.0


@lazy_kernel
def describe_pattern(
    subsegments: Subsegments, members: BoolArray, focal_px: float, on_strands: FloatArray
) -> tuple[bool, bool, bool, int, float]:
    """Describe the pattern of lit intervals and gaps of the stripes on a surface.

    Parameters
    ----------
    subsegments : Subsegments
        C of them.
    members : bool array, shape (C,)
        Those on the surface.
    focal_px : float
        Pixels per radian, roughly.
    on_strands : array, shape (n_lasers,)
        Written: intensity weight in intervals as short or as narrow as those on strands, not
        curved; 0 at first.

    Returns
    -------
    is_mesh : bool
        As on a net: two lasers (or the only one with enough lines) have short lit intervals between
        longer gaps. One laser may run along a strand and be unbroken even on a net. If little is
        visible, a few short intervals and no long ones are enough.
    is_gappy : bool
        As on a dense net, or on a wall in the shadows of a net: short intervals between any gaps.
    is_unbroken : bool
        As on something solid, perhaps with gaps: on two lasers (or the only one with enough lines)
        many search lines are in intervals longer than those on strands.
    n_strands : int
        Number of lit intervals of the stripes that are broken as on a net.
    extent : float
        Search lines from end to end of the gappy stripes, summed over the lasers.
    """
    asked, broken, gappy, long, unbroken, n_intervals = 0, 0, 0, 0, 0, 0
    total, n_strands = 0.0, 0
    # Largest duty of a mesh. The gaps of a net are longer than the lit strands; a wall behind a net
    # is lit between short shadows.
    mesh_duty = 0.6
    for index in range(on_strands.shape[0]):
        order, n_mine = _in_order(subsegments, members, index)
        if n_mine < MIN_LINES_PER_LASER:
            continue
        asked += 1
        n, duty, length, extent, on_strands[index], share = _describe_stripe(
            subsegments, order, focal_px
        )
        n_intervals += n
        unbroken += share >= _UNBROKEN_SHARE
        is_short = length < LONGEST_INTERVAL
        long += not is_short
        is_gappy = n >= _MIN_INTERVALS and is_short and duty < _GAPPY_DUTY
        gappy += is_gappy
        if is_gappy and duty < mesh_duty:
            broken += 1
            n_strands += n
        total += extent if is_gappy else 0.0
    few = not long and gappy == broken and n_intervals >= _FEW_INTERVALS
    # Of many lasers, two broken stripes among unbroken ones are no net.
    enough = min(2, asked)
    is_mesh = (broken >= enough and broken >= unbroken) or few
    is_gappy = gappy >= enough or few
    return is_mesh, is_gappy, unbroken >= enough, n_strands, total


@inner_kernel
def _in_order(subsegments: Subsegments, members: BoolArray, index: int) -> tuple[IntArray, int]:
    """Return a laser's subsegments on a surface, ordered along the stripe, and their search lines.

    By insertion, because subsegments are almost in order.
    """
    first_line = subsegments.first_line
    order, n, total = np.empty(members.shape[0], np.int64), 0, 0
    for c in range(members.shape[0]):
        if not members[c] or subsegments.laser[c] != index:
            continue
        at = n
        while at > 0 and first_line[order[at - 1]] > first_line[c]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = c
        n += 1
        total += subsegments.n_lines[c]
    return order[:n], total


@inner_kernel
def _describe_stripe(
    subsegments: Subsegments, order: IntArray, focal_px: float
) -> tuple[int, float, float, float, float, float]:
    """Return number, duty, typical length (m), extent and weight on strands of a laser's intervals.

    The last value is the share of the lit search lines in intervals much longer than a strand's
    light. Typical values are medians, so that parts hidden by a fish or a box do not count.
    """
    table, intensity_weight = subsegments.table, subsegments.intensity_weight
    first_line, last_line = subsegments.first_line, subsegments.last_line
    n = order.shape[0]
    lit, dark, distance, bright = np.empty(n), np.empty(n), np.empty(n), np.zeros(n)
    wide = np.zeros(n)
    n_intervals = 0
    begin = first_line[order[0]]
    end = last_line[order[0]] + 1
    # A subsegment whose sampling weight is a smaller share of its intensity weight lies in a curved
    # component.
    curved_weight = 0.21
    for k in range(n):
        c = order[k]
        distance[k] = np.sqrt(squared(table[0, c]) + squared(table[1, c]) + squared(table[2, c]))
        gap = first_line[c] - end
        if gap >= _MIN_GAP_LINES:
            lit[n_intervals] = end - begin
            dark[n_intervals] = gap
            n_intervals += 1
            begin = first_line[c]
        end = max(end, last_line[c] + 1)
        if table[WEIGHT, c] > curved_weight * intensity_weight[c]:
            bright[n_intervals] += intensity_weight[c]
        wide[n_intervals] += subsegments.width[c] * subsegments.n_lines[c]
    extent = _extent(subsegments, order)
    gap = median_of(dark[:n_intervals]) if n_intervals else 0.0
    lit[n_intervals] = end - begin
    n_intervals += 1
    m_per_line = median_of(distance) / focal_px
    for k in range(n_intervals):
        dark[k] = lit[k]
    length = median_of(dark[:n_intervals])
    short_lines, short_wide = 0.0, 0.0
    for k in range(n_intervals):
        if lit[k] * m_per_line < LONGEST_INTERVAL:
            short_lines += lit[k]
            short_wide += wide[k]
    # A stripe along a strand is narrower than this share of the width of the light across strands:
    # thin twine shows only a part of the sheet.
    narrow_share = 0.7
    narrow = narrow_share * short_wide / max(short_lines, 1.0)
    on_strands, all_lines, unbroken = 0.0, 0.0, 0.0
    for k in range(n_intervals):
        all_lines += lit[k]
        if lit[k] * m_per_line < LONGEST_INTERVAL or wide[k] < narrow * lit[k]:
            on_strands += bright[k]
        elif lit[k] * m_per_line > _UNBROKEN_LENGTHS * LONGEST_INTERVAL:
            unbroken += lit[k]
    share = float(unbroken / all_lines)
    duty = float(length / (length + gap))
    return n_intervals, duty, float(length * m_per_line), extent, on_strands, share


@inner_kernel
def _extent(subsegments: Subsegments, order: IntArray) -> float:
    """Return the search lines between the 10 % and the 90 % quantile of one laser's light."""
    n_lines, total = subsegments.n_lines, 0
    for k in range(order.shape[0]):
        total += n_lines[order[k]]
    seen = 0
    begin = 0
    end = 0
    # Share of the lit search lines at each end of a stripe that may be stragglers.
    stragglers = 0.1
    for k in range(order.shape[0]):
        c = order[k]
        if seen <= stragglers * total:
            begin = subsegments.first_line[c]
        if seen < (1.0 - stragglers) * total:
            end = subsegments.last_line[c]
        seen += n_lines[c]
    return float(end - begin + 1)


@lazy_borrowing_kernel
def distances_off(points: FloatArray, normal: FloatArray, offset: float, off: FloatArray) -> None:
    """Write the distances (N,) of points (N, 3) from a plane, as shares of its offset."""
    nx, ny, nz = normal[0] / offset, normal[1] / offset, normal[2] / offset
    for i in range(points.shape[0]):
        off[i] = abs(nx * points[i, 0] + ny * points[i, 1] + nz * points[i, 2] - 1.0)


@lazy_kernel
def mark_beside(
    source: IntArray, net_mask: BoolArray, off: FloatArray, most: float, beside: BoolArray
) -> None:
    """Mark the candidates of a net, and those near its plane whose peak is not on the net.

    Parameters
    ----------
    source : int array, shape (N,)
        Number of each candidate's peak.
    net_mask : bool array, shape (N,)
        Candidates of the net.
    off : array, shape (N,)
        From `distances_off`.
    most : float
        Largest distance from the plane, as a share of its offset.
    beside : bool array, shape (N,)
        Written.
    """
    explained = np.zeros(n_bins(source), np.bool_)
    for i in range(source.shape[0]):
        if net_mask[i]:
            explained[source[i]] = True
    for i in range(source.shape[0]):
        beside[i] = net_mask[i] or (off[i] < most and not explained[source[i]])
