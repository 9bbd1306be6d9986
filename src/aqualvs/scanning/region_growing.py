"""Region growing: candidates of the target that the search for planes left out.

Planes are searched with a narrow gate, among whole subsegments, so that no foreign candidate enters
the posture. For labels the gate may be wider (`recruit_candidates`): a strand's light is off the
plane by the strand's thickness, a net bulges, and lasers share the light where their stripes cross.

`grow_region` follows a net along each stripe, from strand to strand. Where a net folds, its light
leaves the plane gradually: from one strand to the next the distance changes by no more than the
steepest flank allows. Wrong candidates, bubbles, and light seen through the net have no such
neighbours, or are farther away than the right candidate of the same peak.
"""

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import inner_kernel, lazy_kernel
from aqualvs.geometry.linear_algebra import argsort, median_of, n_bins, squared
from aqualvs.scanning.candidates import Candidates
from aqualvs.scanning.net_surfaces import LONGEST_INTERVAL

# Largest distances of candidates on a plane, and of those beside it, as shares of the range.
_ON_IT, _BESIDE = 0.008, 0.04
MUCH_BESIDE, MODERATELY_BESIDE = 0.85, 0.5
"""Ratios of the number of candidates beside a plane to that on it, from which a net may bend."""


def has_much_beside(off: FloatArray, much: float = MUCH_BESIDE) -> bool:
    """Return whether so many candidates lie just beside a plane that the net may bend away from it.

    Where stripes cross, wrong candidates lie there as well.

    Parameters
    ----------
    off : array, shape (N,)
        Distances of the candidates from the plane, as shares of the range.
    much : float
        Least ratio of their number to that of the candidates on the plane.
    """
    on_it, near = np.count_nonzero(off < _ON_IT), np.count_nonzero(off < _BESIDE)
    return bool(near - on_it > much * on_it)


@inner_kernel
def recruit_candidates(
    candidates: Candidates,
    of_candidate: IntArray,
    n_subsegments: int,
    patch: FloatArray,
    other: BoolArray,
    taken: BoolArray,
    on_target: BoolArray,
) -> None:
    """Mark candidates near the target as on it, if most of their subsegment is near.

    Parameters
    ----------
    candidates : Candidates
        N of them.
    of_candidate : int array, shape (N,)
        Row of each one's subsegment, below `n_subsegments`.
    patch : array, shape (16,)
        The target as a patch.
    other : bool array, shape (N,)
        Candidates that another surface explains.
    taken : bool array, shape (N,)
        Candidates of peaks that have a candidate on another surface.
    on_target : bool array, shape (N,)
        Candidates on the target; completed in place.
    """
    points, sensitivity = candidates.points, candidates.sensitivity
    n = points.shape[0]
    near = np.zeros(n, np.bool_)
    n_near, n_all = np.zeros(n_subsegments), np.zeros(n_subsegments)
    # Largest distance of candidates on the target: a share of the range and pixels, combined as a
    # root sum of squares.
    near_share = 0.010
    near_px = 2.0
    by_range = near_share * patch[3]
    for i in range(n):
        off = -patch[3]
        per_px = 0.0
        u = 0.0
        v = 0.0
        for k in range(3):
            off += patch[k] * points[i, k]
            per_px += patch[k] * sensitivity[i, k]
            u += patch[4 + k] * points[i, k]
            v += patch[7 + k] * points[i, k]
        off -= patch[10] + patch[11] * u + patch[12] * v
        off -= 0.5 * (patch[13] * u * u + patch[15] * v * v) + patch[14] * u * v
        by_pixel = near_px * per_px
        near[i] = off * off < by_range * by_range + by_pixel * by_pixel
        n_all[of_candidate[i]] += 1.0
        n_near[of_candidate[i]] += near[i]
    # Least share of a subsegment that must be near.
    min_share = 0.5
    for i in range(n):
        c = of_candidate[i]
        if near[i] and n_near[c] >= min_share * n_all[c] and (other[i] or not taken[i]):
            on_target[i] = True


# Rows of the table of components: number of search lines; means of height (m), search line and
# confidence; shares of candidates on the net, and of those whose peak is on it by another
# candidate; laser; length in metres.
LINES, HEIGHT, LINE, CONFIDENCE, ON_NET, TAKEN, LASER, SIZE, _N_FACTS = range(9)

# Slope of the steepest flank that is followed, and noise of a step, as a share of the range.
_STEEPEST = 1.2
_LOOSE_SHARE = 0.006
# A single strand is accepted up to this distance from the surface, as a share of the range; farther
# away only as part of a flank.
_LONELY_SHARE = 0.015
# A strand is linked to one of this many preceding strands of the net.
_MAX_TRIED = 2


@lazy_kernel
def grow_region(
    candidates: Candidates,
    height: FloatArray,
    distance: float,
    m_per_line: float,
    on_net: BoolArray,
) -> None:
    """Mark the strands that continue those on the net.

    Parameters
    ----------
    candidates : Candidates
        N of them.
    height : array, shape (N,)
        Distance of the candidates behind the net's surface, in metres.
    distance : float
        Range, in metres.
    m_per_line : float
        Width of a search line at that distance, in metres.
    on_net : bool array, shape (N,)
        Candidates on the net; completed in place.
    """
    component, source = candidates.component, candidates.source
    n_components = n_bins(component)
    taken = np.zeros(n_bins(source), np.bool_)
    for i in range(component.shape[0]):
        taken[source[i]] |= on_net[i]
    table = np.zeros((_N_FACTS, n_components))
    _describe(candidates, height, on_net, taken, table)
    order, dimmest = _strands_in_order(table, distance)
    typical = _exclude_between_strands(order, table)
    # Largest distance to the next strand, as a share of the range and in typical distances.
    farthest_share, farthest_gap = 0.15, 2.5
    farthest = min(farthest_share * distance, farthest_gap * typical * m_per_line)
    cost = np.full(n_components, np.inf)
    for way in (1, -1):
        _sweep(order, way, table, distance, m_per_line, farthest, dimmest, cost)
    _drop_isolated(table[HEIGHT], _LONELY_SHARE * distance, cost)
    _mark_reached(component, source, cost, taken, on_net)


@inner_kernel
def _describe(
    candidates: Candidates,
    height: FloatArray,
    on_net: BoolArray,
    taken: BoolArray,
    table: FloatArray,
) -> None:
    """Write the table (8, S) of the components."""
    component, points = candidates.component, candidates.points
    n_components = table.shape[1]
    first, last = np.full(n_components, -1), np.full(n_components, -1)
    for i in range(component.shape[0]):
        s = component[i]
        table[LINES, s] += 1.0
        table[HEIGHT, s] += height[i]
        table[LINE, s] += candidates.line[i]
        table[CONFIDENCE, s] += candidates.confidence[i]
        table[ON_NET, s] += on_net[i]
        table[TAKEN, s] += taken[candidates.source[i]] and not on_net[i]
        table[LASER, s] = candidates.laser[i]
        if first[s] < 0:
            first[s] = i
        last[s] = i
    for s in range(n_components):
        if table[LINES, s] == 0.0:
            continue
        for k in (HEIGHT, LINE, CONFIDENCE, ON_NET, TAKEN):
            table[k, s] /= table[LINES, s]
        for k in range(3):
            table[SIZE, s] += squared(points[first[s], k] - points[last[s], k])
        table[SIZE, s] = np.sqrt(table[SIZE, s])


@inner_kernel
def _strands_in_order(table: FloatArray, distance: float) -> tuple[IntArray, float]:
    """Return strands that may be on the net, ordered along the stripes, and the least confidence.

    They are the components on the net, and short loose ones near it; ordered by laser and line.
    """
    n = table.shape[1]
    key = np.full(n, np.inf)
    total = 0.0
    n_seeds, n_listed = 0, 0
    # Largest distance of a net from its plane, as a share of the range.
    deepest_share = 0.2
    # Least number of search lines of a strand, less is a speck; and its least confidence, as a
    # share of the mean of the components on the net.
    speck_lines = 3
    dimmest = 0.6
    for s in range(n):
        if table[LINES, s] < speck_lines:
            continue
        seed = table[ON_NET, s] >= 0.5
        if seed:
            total += table[CONFIDENCE, s]
            n_seeds += 1
        short = table[SIZE, s] < LONGEST_INTERVAL
        near = abs(table[HEIGHT, s]) < deepest_share * distance
        loose = table[TAKEN, s] < 0.5 and table[ON_NET, s] == 0.0
        if seed or (short and near and loose):
            key[s] = table[LASER, s] * 1e6 + table[LINE, s]
            n_listed += 1
    return argsort(key)[:n_listed], dimmest * total / max(n_seeds, 1)


@inner_kernel
def _drop_isolated(height: FloatArray, lonely: float, cost: FloatArray) -> None:
    """Remove the components away from the surface if they are too few to be a fold."""
    n_far = 0
    for s in range(cost.shape[0]):
        n_far += cost[s] < np.inf and abs(height[s]) >= lonely
    # Least number of strands of folds farther away than `lonely` metres, of all lasers.
    min_strands = 6
    if n_far < min_strands:
        for s in range(cost.shape[0]):
            if abs(height[s]) >= lonely:
                cost[s] = np.inf


@inner_kernel
def _exclude_between_strands(order: IntArray, table: FloatArray) -> float:
    """Exclude components between regularly spaced strands on the plane: set their confidence to 0.

    Return the typical distance of the strands in search lines; infinite if there are none.
    """
    n = order.shape[0]
    before, after = np.full(n, np.nan), np.full(n, np.nan)
    gaps = np.empty(n)
    n_gaps = 0
    for at in range(n):
        s = order[at]
        if at > 0 and table[LASER, order[at - 1]] == table[LASER, s]:
            p = order[at - 1]
            before[at] = table[LINE, p] if table[ON_NET, p] > 0.0 else before[at - 1]
        if table[ON_NET, s] > 0.0 and before[at] == before[at]:
            gaps[n_gaps] = table[LINE, s] - before[at]
            n_gaps += 1
    for at in range(n - 2, -1, -1):
        s = order[at]
        if table[LASER, order[at + 1]] == table[LASER, s]:
            p = order[at + 1]
            after[at] = table[LINE, p] if table[ON_NET, p] > 0.0 else after[at + 1]
    if n_gaps == 0:
        return np.inf
    typical = median_of(gaps[:n_gaps])
    # In a fold the plane itself has no strands. Least gap of a fold in typical distances, half of
    # that if the net has strands on one side only.
    fold_gap = 1.7
    for at in range(n):
        s = order[at]
        if table[ON_NET, s] > 0.0:
            continue
        both = after[at] - before[at]
        one = abs(table[LINE, s] - (before[at] if after[at] != after[at] else after[at]))
        wide = both > fold_gap * typical if both == both else one > 0.5 * fold_gap * typical
        if not wide:
            table[CONFIDENCE, s] = 0.0
    return typical


@inner_kernel
def _sweep(
    order: IntArray,
    way: int,
    table: FloatArray,
    distance: float,
    m_per_line: float,
    farthest: float,
    dimmest: float,
    cost: FloatArray,
) -> None:
    """Follow the stripes in one direction, from strand to strand, and write the costs (S,).

    The cost of a step is the change of height over the largest change that is allowed; that of a
    strand is the cost of the most expensive step of the path to it. A lower cost is kept.
    """
    n = order.shape[0]
    n_components = cost.shape[0]
    reached, parent = np.full(n_components, np.inf), np.full(n_components, -1)
    has_next = np.zeros(n_components, np.bool_)
    loose = _LOOSE_SHARE * distance
    # Number of preceding components that are compared: bounds the time in clutter.
    look_back = 16
    for at in range(n):
        s = order[at] if way > 0 else order[n - 1 - at]
        if table[ON_NET, s] > 0.0:
            reached[s] = 0.0
            continue
        if table[CONFIDENCE, s] < dimmest:
            continue
        tried = 0
        for back in range(at - 1, max(at - 1 - look_back, -1), -1):
            p = order[back] if way > 0 else order[n - 1 - back]
            if table[LASER, p] != table[LASER, s]:
                break
            if reached[p] == np.inf:
                continue
            # Distance along the stripe only: the position across it follows from the height.
            beside = abs(table[LINE, s] - table[LINE, p]) * m_per_line
            if beside > farthest or tried == _MAX_TRIED:
                break
            tried += 1
            step = abs(table[HEIGHT, s] - table[HEIGHT, p])
            step_cost = step / (_STEEPEST * beside + loose)
            if step_cost < 1.0:
                reached[s] = max(step_cost, reached[p])
                parent[s] = p
                has_next[p] = True
                break
    for at in range(n):
        s = order[at]
        if parent[s] < 0:
            continue
        alone = table[ON_NET, parent[s]] > 0.0 and not has_next[s]
        if not alone or abs(table[HEIGHT, s]) < _LONELY_SHARE * distance:
            cost[s] = min(cost[s], reached[s])


@inner_kernel
def _mark_reached(
    component: IntArray, source: IntArray, cost: FloatArray, taken: BoolArray, on_net: BoolArray
) -> None:
    """Mark the candidates of the strands reached as on the net; the cheapest of each peak."""
    best = np.full(taken.shape[0], np.inf)
    for i in range(component.shape[0]):
        best[source[i]] = min(best[source[i]], cost[component[i]])
    for i in range(component.shape[0]):
        mine = cost[component[i]]
        if mine < np.inf and mine <= best[source[i]] and not taken[source[i]]:
            on_net[i] = True
