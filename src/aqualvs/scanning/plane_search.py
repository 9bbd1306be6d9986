"""Search for one plane among subsegments: a deterministic, locally optimised RANSAC.

Samples are taken among neighbours (after NAPSAC, Myatt et al. 2002, doi:10.5244/C.16.44):
subsegments next to each other on a stripe more likely share a surface than distant ones, and those
with a larger sampling weight more likely lie on any surface than specks.
Hypotheses are scored by MSAC (Torr & Zisserman 2000, doi:10.1006/cviu.1999.0832), and the promising
ones are refined.

Subsegments are the columns of a table, quantities its rows, so that scoring a hypothesis reads
memory in order and is vectorised; the scores are then summed subsegment by subsegment, in a fixed
order.
"""

import numpy as np

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import (
    inline_borrowing_kernel,
    inline_kernel,
    inner_borrowing_kernel,
    inner_kernel,
)
from aqualvs.geometry.linear_algebra import solve_symmetric, sum_of, take

X, Y, Z, JX, JY, JZ, WEIGHT = range(7)
"""Rows of the table: centroid (m), sensitivity (m/px), sampling weight (search lines)."""
N_ROWS = 7

_MAX_HYPOTHESES = 6000
# Trials for a plane: the first number over the square of the plane's share of the sampling weight.
# If that is more than the second number, the third one is a factor on it.
_TRIALS, _MANY, _SOME = 45.0, 2500.0, 0.55
# Largest number of hypotheses times subsegments: a frame full of noise must not delay a live run.
# With a sixth of it, every second search missed the board in a photograph with 15 lasers, where
# most of 10,000 subsegments were JPEG artefacts.
_MAX_WORK = 60_000_000
# Subsegments scored between checks whether the rest can change the result.
_STEP = 32
# The second subsegment of a sample is at most this many places after the first one, on the same
# laser.
_NEIGHBOURHOOD = 8
# Subsegments with a smaller share of the weighted median of the sampling weights are not sampled.
_LIGHTEST_SHARE = 0.5
MIN_FACING = float(np.cos(np.deg2rad(55.0)))
"""Least cosine of a target's normal to the forward axis: others are not ahead of the vehicle."""
# Factor on the gate of a hypothesis before it is refined, and least score, as a share of the best
# one, for which it is refined.
_WIDE_GATE = 3.0
_WORTH_REFINING = 0.8
# Largest weight of the best laser relative to the second: a plane needs two lasers.
MAX_TO_SECOND = 3.0


@inline_kernel
def squared_gate(per_px: float, offset: float) -> float:
    """Return the square of the largest distance (m) at which a subsegment belongs to a plane."""
    # Root sum of squares of a share of the range and of the distance for a shift of the stripe,
    # which is limited to the second share: where the line of sight is nearly parallel to the sheet,
    # a pixel moves a wrong candidate so far that it would be on any plane.
    gate_range_share, max_range_share = 0.003, 0.25
    gate_px = 1.0
    by_range = gate_range_share * offset
    by_pixel = min(gate_px * abs(per_px), max_range_share * offset)
    return by_range * by_range + by_pixel * by_pixel


@inner_borrowing_kernel
def _score(
    table: FloatArray,
    laser_start: IntArray,
    plane: FloatArray,
    gate_scale: float,
    weight_after: FloatArray,
    enough: float,
    lanes: FloatArray,
) -> float:
    """Return the MSAC score of a plane (normal, offset) with a gate `gate_scale` times as wide.

    The score is 0 if a partial sum shows that it cannot exceed `enough`. `weight_after` holds the
    sampling weight of each subsegment and all after it; `lanes` is overwritten.
    """
    first = 0.0
    second = 0.0
    total = 0.0
    for i_laser in range(laser_start.shape[0] - 1):
        value = 0.0
        at, end = laser_start[i_laser], laser_start[i_laser + 1]
        while at < end:
            stop = min(at + _STEP, end)
            value += _near(table, at, stop, plane, gate_scale * gate_scale, lanes)
            if total + value + weight_after[stop] <= enough:
                return 0.0
            at = stop
        total += value
        second = max(second, min(first, value))
        first = max(first, value)
    return min(total, total - first + MAX_TO_SECOND * second)


@inline_borrowing_kernel
def _near(
    table: FloatArray,
    at: int,
    stop: int,
    plane: FloatArray,
    squared_gate_scale: float,
    lanes: FloatArray,
) -> float:
    """Return the sum over subsegments [at, stop) of their sampling weight times their nearness.

    The nearness to the plane is 1 on it and 0 beyond the gate; `lanes` is overwritten.
    """
    x, y, z, weight = table[X], table[Y], table[Z], table[WEIGHT]
    jx, jy, jz = table[JX], table[JY], table[JZ]
    nx, ny, nz, offset = plane[0], plane[1], plane[2], plane[3]
    for k in range(at, stop):
        residual = nx * x[k] + ny * y[k] + nz * z[k] - offset
        gate = squared_gate(nx * jx[k] + ny * jy[k] + nz * jz[k], offset)
        near = 1.0 - residual * residual / (squared_gate_scale * gate)
        lanes[k - at] = weight[k] * max(near, 0.0)
    value = 0.0
    for k in range(stop - at):
        value += lanes[k]
    return value


@inner_kernel
def refine_plane(
    table: FloatArray,
    plane: FloatArray,
    gate_scale: float,
    normal: FloatArray,
    scratch: FloatArray,
    lanes: FloatArray,
) -> bool:
    """Refit the plane X·m = 1 (paper, Eq. 24) to the subsegments in its gate times `gate_scale`.

    `plane` (4,) is overwritten; `normal` (3, 3), `scratch` (5, 3) and `lanes` (C,) are buffers.
    Return False, and leave the plane, if the subsegments do not determine it.
    """
    x, y, z, weight = table[X], table[Y], table[Z], table[WEIGHT]
    jx, jy, jz = table[JX], table[JY], table[JZ]
    nx, ny, nz, offset = plane[0], plane[1], plane[2], plane[3]
    n = x.shape[0]
    for k in range(n):
        residual = nx * x[k] + ny * y[k] + nz * z[k] - offset
        gate = squared_gate(nx * jx[k] + ny * jy[k] + nz * jz[k], offset)
        lanes[k] = weight[k] / gate if residual * residual < gate_scale * gate_scale * gate else 0.0
    xx = yy = zz = xy = yz = zx = sx = sy = sz = 0.0
    for k in range(n):
        w = lanes[k]
        if w == 0.0:
            continue
        wx, wy, wz = w * x[k], w * y[k], w * z[k]
        sx += wx
        sy += wy
        sz += wz
        xx += wx * x[k]
        yy += wy * y[k]
        zz += wz * z[k]
        xy += wx * y[k]
        yz += wy * z[k]
        zx += wz * x[k]
    normal[0, 0], normal[1, 1], normal[2, 2] = xx, yy, zz
    normal[1, 0], normal[2, 1], normal[2, 0] = xy, yz, zx
    right, m = scratch[3], scratch[4]
    right[0], right[1], right[2] = sx, sy, sz
    if not solve_symmetric(normal, right, scratch, m):
        return False
    length = np.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
    if not (length > 0.0 and length < np.inf):
        return False
    plane[0], plane[1], plane[2] = m[0] / length, m[1] / length, m[2] / length
    plane[3] = 1.0 / length
    return True


@inline_kernel
def _plane_through(table: FloatArray, i: int, j: int, k: int, plane: FloatArray) -> bool:
    """Write the plane (4,) through three subsegments, its offset positive; False if collinear."""
    ax, ay, az = table[X, i], table[Y, i], table[Z, i]
    ux, uy, uz = table[X, j] - ax, table[Y, j] - ay, table[Z, j] - az
    vx, vy, vz = table[X, k] - ax, table[Y, k] - ay, table[Z, k] - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    if length < 1e-9:
        return False
    offset = (nx * ax + ny * ay + nz * az) / length
    if offset < 0.0:
        length, offset = -length, -offset
    plane[0], plane[1], plane[2], plane[3] = nx / length, ny / length, nz / length, offset
    return True


@inline_kernel
def _next_random(state: np.uint64) -> tuple[np.uint64, float]:
    """Step a 64-bit linear congruential generator (Knuth's MMIX constants); value in [0, 1)."""
    state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
    return state, float(state >> np.uint64(11)) / 9007199254740992.0


@inline_borrowing_kernel
def _pick(cumulative_weight: FloatArray, guide: IntArray, draw: float) -> int:
    """Return the subsegment for a uniform `draw` in [0, 1): probability as its sampling weight."""
    wanted = draw * cumulative_weight[cumulative_weight.shape[0] - 1]
    at = guide[int(draw * guide.shape[0])]
    while at > 0 and cumulative_weight[at - 1] > wanted:
        at -= 1
    while cumulative_weight[at] <= wanted and at < cumulative_weight.shape[0] - 1:
        at += 1
    return int(at)


@inner_borrowing_kernel
def _guide(cumulative_weight: FloatArray, guide: IntArray) -> None:
    """Write the start of the search in `_pick` for equally spaced draws, as many as subsegments."""
    n = guide.shape[0]
    step = cumulative_weight[n - 1] / n
    at = 0
    for k in range(n):
        while at < n - 1 and cumulative_weight[at] <= k * step:
            at += 1
        guide[k] = at


@inner_kernel
def _median_weight(sampling_weight: FloatArray) -> float:
    """Return the weighted median of the sampling weights."""
    values = np.empty(sampling_weight.shape[0])
    for c in range(sampling_weight.shape[0]):
        values[c] = sampling_weight[c]
    wanted, below = 0.5 * sum_of(sampling_weight), 0.0
    low, high = 0, values.shape[0]
    while high - low > 1:
        pivot = values[(low + high) // 2]
        # Partition: smaller weights to the front, larger ones to the end.
        first, last, k = low, high, low
        lighter, same = 0.0, 0.0
        while k < last:
            one = values[k]
            if one < pivot:
                lighter += one
                values[k], values[first] = values[first], one
                first += 1
                k += 1
            elif one > pivot:
                last -= 1
                values[k], values[last] = values[last], one
            else:
                same += one
                k += 1
        if below + lighter >= wanted:
            high = first
        elif below + lighter + same >= wanted:
            return float(pivot)
        else:
            below += lighter + same
            low = last
    return float(values[min(low, values.shape[0] - 1)])


@inner_kernel
def _heavy(sampling_weight: FloatArray) -> IntArray:
    """Return the subsegments to sample: those not much below the weighted median.

    Where glare makes thousands of specks, most neighbours on a stripe would be specks.
    """
    least = _LIGHTEST_SHARE * _median_weight(sampling_weight)
    heavy, n = np.empty(sampling_weight.shape[0], np.int64), 0
    for c in range(sampling_weight.shape[0]):
        if sampling_weight[c] >= least:
            heavy[n] = c
            n += 1
    return heavy[:n]


@inner_kernel
def _are_enough(heavy: IntArray, laser: IntArray, intensity_weight: FloatArray) -> bool:
    """Return whether the heavy subsegments show two lasers, and enough of the light.

    A sample needs two lasers. On a wall in caustics, the sampling weight of long stripes is limited
    to less than that of specks.
    """
    enough = 0.4  # Least share of the intensity weight.
    of_two = laser[heavy[0]] != laser[heavy[heavy.shape[0] - 1]]
    return bool(
        of_two and sum_of(take(intensity_weight, heavy)) > enough * sum_of(intensity_weight)
    )


@inner_kernel
def search_plane(
    table: FloatArray,
    intensity_weight: FloatArray,
    laser: IntArray,
    laser_start: IntArray,
    nearest: float,
    farthest: float,
    seed: int,
    best_plane: FloatArray,
) -> bool:
    """Find the plane that subsegments of at least two lasers agree on best.

    Parameters
    ----------
    table : array, shape (7, C)
        Subsegments, ordered by laser.
    intensity_weight : array, shape (C,)
        As in `Subsegments`.
    laser : int array, shape (C,)
        Index of each subsegment's laser.
    laser_start : int array, shape (n_lasers + 1,)
        First subsegment of each laser, and C.
    nearest, farthest : float
        Limits of the hypotheses, in metres.
    seed : int
        The same seed and subsegments give the same plane. With 0, for the first plane of a frame,
        all subsegments are sampled if the heavy ones are of one laser, or have little of the
        intensity weight.
    best_plane : array, shape (4,)
        Written: unit normal, pointing outward, and offset.

    Returns
    -------
    bool
        Whether there is a plane.
    """
    n = table.shape[1]
    state = np.uint64(seed + 1)
    plane, normal, scratch = np.empty(4), np.empty((3, 3)), np.empty((5, 3))
    best = 0.0
    best_rough = 0.0
    heavy = _heavy(table[WEIGHT])
    if seed == 0 and not _are_enough(heavy, laser, intensity_weight):
        # Later in a frame, the others are left over of a surface, or flanks of fish.
        heavy = np.empty(n, np.int64)
        for c in range(n):
            heavy[c] = c
    n_heavy = heavy.shape[0]
    cumulative_weight = take(table[WEIGHT], heavy)
    for k in range(1, n_heavy):
        cumulative_weight[k] += cumulative_weight[k - 1]
    guide = np.empty(n_heavy, np.int64)
    _guide(cumulative_weight, guide)
    weight_after = np.zeros(n + 1)
    for c in range(n - 1, -1, -1):
        weight_after[c] = weight_after[c + 1] + table[WEIGHT, c]
    lanes = np.empty(max(n, _STEP))
    total = weight_after[0]
    most = min(_MAX_HYPOTHESES, _MAX_WORK // n)
    needed = most
    trial = 0
    while trial < needed:
        trial += 1
        state, draw = _next_random(state)
        at = _pick(cumulative_weight, guide, draw)
        state, draw = _next_random(state)
        beside = at + 1 + int(draw * _NEIGHBOURHOOD)
        state, draw = _next_random(state)
        if beside >= n_heavy or laser[heavy[at]] != laser[heavy[beside]]:
            continue
        i, j, k = heavy[at], heavy[beside], heavy[_pick(cumulative_weight, guide, draw)]
        if laser[k] == laser[i]:
            continue
        if not _plane_through(table, i, j, k, plane):
            continue
        if plane[3] < nearest or plane[3] > farthest or plane[1] < MIN_FACING:
            continue
        # A plane through neighbours is inaccurate: score it with a wide gate, refine it with
        # narrower ones.
        score = _score(
            table, laser_start, plane, _WIDE_GATE, weight_after, _WORTH_REFINING * best_rough, lanes
        )
        if score <= _WORTH_REFINING * best_rough:
            continue
        best_rough = max(best_rough, score)
        for gate_scale in (_WIDE_GATE, 0.5 * (1.0 + _WIDE_GATE), 1.0):
            refine_plane(table, plane, gate_scale, normal, scratch, lanes)
        score = _score(table, laser_start, plane, 1.0, weight_after, best, lanes)
        if score <= best:
            continue
        best = score
        for k in range(4):
            best_plane[k] = plane[k]
        # With a share s of the weight on the plane a trial succeeds with a probability of s^2 / 12
        # to s^2 / 5: at most half of the neighbours fit, and a third of the draws are of one laser.
        # If two thirds of a net's weight make a plane of their own, one search in 1000 misses the
        # whole net with these trials. Planes through noise get fewer.
        share = min(best / total, 1.0)
        trials = _TRIALS / (share * share)
        needed = min(most, int(max(min(trials, _MANY), _SOME * trials)) + 20)
    for _ in range(3):
        if best > 0.0:
            refine_plane(table, best_plane, 1.0, normal, scratch, lanes)
    return best > 0.0
