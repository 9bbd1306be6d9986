"""Region growing: light of the target that the search for planes left out.

A plane is sought with a narrow gate, among whole pieces of stripe, so that nothing foreign enters
the posture. To label points the gate may be wider (`recruit_candidates`): a strand's light is off
the plane by the strand's thickness, a net bulges, and where stripes cross two lasers share the
light.

`grow_region` follows a net along each stripe, from strand to strand. Where a net folds, its light
leaves the plane gradually: the next strand is about as far away as the last one, within the
steepness of a flank. Candidates of other lasers' light, bubbles and light seen through the net have
no such neighbours, or are farther off than the right candidate of the same light.
"""

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import inner_kernel, lazy_kernel
from aqualvs.geometry.linear_algebra import argsort, median_of, n_bins, squared
from aqualvs.scanning.candidates import Candidates
from aqualvs.scanning.net_surfaces import LONGEST_INTERVAL

# Limits of light on a plane, and of light beside it, as shares of the range.
_ON_IT, _BESIDE = 0.008, 0.04
MUCH, SOME = 0.85, 0.5
"""Light beside a plane over light on it."""


def has_much_beside(off: FloatArray, much: float = MUCH) -> bool:
    """Return whether enough light lies just off a plane for the net to bend away from it.

    Where stripes cross, wrong candidates lie there as well.

    Parameters
    ----------
    off : array, shape (N,)
        Distances of the candidates from the plane, as shares of the range.
    much : float
        Light beside the plane over light on it.
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
    """Mark candidates near the target as on it.

    Parameters
    ----------
    candidates : Candidates
        N of them.
    of_candidate : int array, shape (N,)
        Subsegment of each one, below `n_subsegments`.
    patch : array, shape (16,)
        The target as `Patch.packed` gives it.
    other : bool array, shape (N,)
        Candidates that another surface explains.
    taken : bool array, shape (N,)
        Candidates of light that another surface explains by some candidate.
    on_target : bool array, shape (N,)
        Candidates on the target; completed in place.
    """
    points, sensitivity = candidates.points, candidates.sensitivity
    n = points.shape[0]
    near = np.zeros(n, np.bool_)
    n_near, n_all = np.zeros(n_subsegments), np.zeros(n_subsegments)
    # Largest distance of light on the target: a share of the range, and pixels.
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
    # Share of a piece that must be near.
    most = 0.5
    for i in range(n):
        c = of_candidate[i]
        if near[i] and n_near[c] >= most * n_all[c] and (other[i] or not taken[i]):
            on_target[i] = True


# Rows of the table of components: search lines, means of height, line and confidence, shares of
# light on the net and of light that is on it by another candidate, laser, length in metres.
LINES, HEIGHT, LINE, CONFIDENCE, ON_NET, TAKEN, LASER, SIZE, _N_FACTS = range(9)

# The steepest flank that is followed, and the noise of a step, as a share of the range.
_STEEPEST = 1.2
_LOOSE_SHARE = 0.006
# A single strand is accepted within this share of the range; farther off only as part of a flank.
_LONELY_SHARE = 0.015
# A strand continues one of this many last strands on the net.
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
        By how much the candidates lie behind the net's surface, in metres.
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
    facts = np.zeros((_N_FACTS, n_components))
    _describe(candidates, height, on_net, taken, facts)
    order, dimmest = _listed(facts, distance)
    usual = _drop_between(order, facts)
    # Largest distance to the next strand: a share of the range, and in usual distances.
    farthest_share, farthest_gap = 0.15, 2.5
    farthest = min(farthest_share * distance, farthest_gap * usual * m_per_line)
    cost = np.full(n_components, np.inf)
    for way in (1, -1):
        _sweep(order, way, facts, distance, m_per_line, farthest, dimmest, cost)
    _drop_few(facts[HEIGHT], _LONELY_SHARE * distance, cost)
    _settle(component, source, cost, taken, on_net)


@inner_kernel
def _describe(
    candidates: Candidates,
    height: FloatArray,
    on_net: BoolArray,
    taken: BoolArray,
    facts: FloatArray,
) -> None:
    """Write the table of the components of light."""
    component, points = candidates.component, candidates.points
    n_components = facts.shape[1]
    first, last = np.full(n_components, -1), np.full(n_components, -1)
    for i in range(component.shape[0]):
        s = component[i]
        facts[LINES, s] += 1.0
        facts[HEIGHT, s] += height[i]
        facts[LINE, s] += candidates.line[i]
        facts[CONFIDENCE, s] += candidates.confidence[i]
        facts[ON_NET, s] += on_net[i]
        facts[TAKEN, s] += taken[candidates.source[i]] and not on_net[i]
        facts[LASER, s] = candidates.laser[i]
        if first[s] < 0:
            first[s] = i
        last[s] = i
    for s in range(n_components):
        if facts[LINES, s] == 0.0:
            continue
        for k in (HEIGHT, LINE, CONFIDENCE, ON_NET, TAKEN):
            facts[k, s] /= facts[LINES, s]
        for k in range(3):
            facts[SIZE, s] += squared(points[first[s], k] - points[last[s], k])
        facts[SIZE, s] = np.sqrt(facts[SIZE, s])


@inner_kernel
def _listed(facts: FloatArray, distance: float) -> tuple[IntArray, float]:
    """Return seeds and candidates in their order along the stripes, and the lowest confidence."""
    n = facts.shape[1]
    key = np.full(n, np.inf)
    total = 0.0
    n_seeds, n_listed = 0, 0
    # A net strays from its plane by at most this share of the range.
    deepest_share = 0.2
    # Least lines of a strand, less is a speck; and its least brightness as a share of the net's
    # light.
    speck_lines = 3
    dimmest = 0.6
    for s in range(n):
        if facts[LINES, s] < speck_lines:
            continue
        seed = facts[ON_NET, s] >= 0.5
        if seed:
            total += facts[CONFIDENCE, s]
            n_seeds += 1
        short = facts[SIZE, s] < LONGEST_INTERVAL
        near = abs(facts[HEIGHT, s]) < deepest_share * distance
        loose = facts[TAKEN, s] < 0.5 and facts[ON_NET, s] == 0.0
        if seed or (short and near and loose):
            key[s] = facts[LASER, s] * 1e6 + facts[LINE, s]
            n_listed += 1
    return argsort(key)[:n_listed], dimmest * total / max(n_seeds, 1)


@inner_kernel
def _drop_few(height: FloatArray, lonely: float, cost: FloatArray) -> None:
    """Remove components that leave the surface, where they are too few to be a fold."""
    n_far = 0
    for s in range(cost.shape[0]):
        n_far += cost[s] < np.inf and abs(height[s]) >= lonely
    # Least number of strands of a fold beyond that share, of all lasers.
    min_strands = 6
    if n_far < min_strands:
        for s in range(cost.shape[0]):
            if abs(height[s]) >= lonely:
                cost[s] = np.inf


@inner_kernel
def _drop_between(order: IntArray, facts: FloatArray) -> float:
    """Remove components between regularly spaced strands on the plane.

    Return the usual distance of the strands in search lines; infinite where there are none.
    """
    n = order.shape[0]
    before, after = np.full(n, np.nan), np.full(n, np.nan)
    gaps = np.empty(n)
    n_gaps = 0
    for at in range(n):
        s = order[at]
        if at > 0 and facts[LASER, order[at - 1]] == facts[LASER, s]:
            p = order[at - 1]
            before[at] = facts[LINE, p] if facts[ON_NET, p] > 0.0 else before[at - 1]
        if facts[ON_NET, s] > 0.0 and before[at] == before[at]:
            gaps[n_gaps] = facts[LINE, s] - before[at]
            n_gaps += 1
    for at in range(n - 2, -1, -1):
        s = order[at]
        if facts[LASER, order[at + 1]] == facts[LASER, s]:
            p = order[at + 1]
            after[at] = facts[LINE, p] if facts[ON_NET, p] > 0.0 else after[at + 1]
    if n_gaps == 0:
        return np.inf
    usual = median_of(gaps[:n_gaps])
    # In a fold the plane itself has no strands: least gap in usual distances, or half of that where
    # the net's last strand is on one side only.
    fold_gap = 1.7
    for at in range(n):
        s = order[at]
        if facts[ON_NET, s] > 0.0:
            continue
        both = after[at] - before[at]
        one = abs(facts[LINE, s] - (before[at] if after[at] != after[at] else after[at]))
        wide = both > fold_gap * usual if both == both else one > 0.5 * fold_gap * usual
        if not wide:
            facts[CONFIDENCE, s] = 0.0
    return usual


@inner_kernel
def _sweep(
    order: IntArray,
    way: int,
    facts: FloatArray,
    distance: float,
    m_per_line: float,
    farthest: float,
    dimmest: float,
    cost: FloatArray,
) -> None:
    """Go along the stripes in one direction, from strand to strand; keep the least cost of each.

    The cost of a strand is that of the most expensive step of the path to it.
    """
    n = order.shape[0]
    n_components = cost.shape[0]
    reached, parent = np.full(n_components, np.inf), np.full(n_components, -1)
    has_next = np.zeros(n_components, np.bool_)
    loose = _LOOSE_SHARE * distance
    # Number of preceding components that are compared, so that the cost does not grow with clutter.
    look_back = 16
    for at in range(n):
        s = order[at] if way > 0 else order[n - 1 - at]
        if facts[ON_NET, s] > 0.0:
            reached[s] = 0.0
            continue
        if facts[CONFIDENCE, s] < dimmest:
            continue
        tried = 0
        for back in range(at - 1, max(at - 1 - look_back, -1), -1):
            p = order[back] if way > 0 else order[n - 1 - back]
            if facts[LASER, p] != facts[LASER, s]:
                break
            if reached[p] == np.inf:
                continue
            # Along the stripe only: the position across it follows from the height.
            beside = abs(facts[LINE, s] - facts[LINE, p]) * m_per_line
            if beside > farthest or tried == _MAX_TRIED:
                break
            tried += 1
            step = abs(facts[HEIGHT, s] - facts[HEIGHT, p])
            dear = step / (_STEEPEST * beside + loose)
            if dear < 1.0:
                reached[s] = max(dear, reached[p])
                parent[s] = p
                has_next[p] = True
                break
    for at in range(n):
        s = order[at]
        if parent[s] < 0:
            continue
        alone = facts[ON_NET, parent[s]] > 0.0 and not has_next[s]
        if not alone or abs(facts[HEIGHT, s]) < _LONELY_SHARE * distance:
            cost[s] = min(cost[s], reached[s])


@inner_kernel
def _settle(
    component: IntArray, source: IntArray, cost: FloatArray, taken: BoolArray, on_net: BoolArray
) -> None:
    """Mark the candidates of the strands reached; only the cheapest of each peak."""
    best = np.full(taken.shape[0], np.inf)
    for i in range(component.shape[0]):
        best[source[i]] = min(best[source[i]], cost[component[i]])
    for i in range(component.shape[0]):
        mine = cost[component[i]]
        if mine < np.inf and mine <= best[source[i]] and not taken[source[i]]:
            on_net[i] = True
