"""The test of a surface against rival assignments of the same peaks to lasers.

Where lasers are nearly parallel, a picture in which every stripe is read as its neighbour's may
show a plane as well: shifted and tilted, with small residuals. The rivals of a surface are found by
reading the peaks of two of its stripes as other lasers', which gives a plane, and refining that
plane on all peaks. Each hypothesis is then judged by

- the light that it explains: peaks of the same looks that are left over count against it;
- the light that it misses: a laser whose stripe would lie in the picture, beside others that are
  seen, and shows nothing. It may be switched off or hidden, so this is a cost and no gate;
- the residuals of each laser's stripe as a whole: the log-likelihood ratio of two fits with unknown
  noise is half the degrees of freedom times the logarithm of the ratio of the variances.

The order of the stripes needs no rule of its own: on a plane in front of camera and emitter a fan's
stripes appear in the order of its lasers, and only such planes are considered.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from enum import Enum
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel, kernel
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.symmetric import solve_symmetric
from aqualvs.scanning.chunks import Chunks
from aqualvs.scanning.measure import Measurement
from aqualvs.scanning.net_mean import doubted
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
from aqualvs.scanning.posture import Refusal, range_pitch_yaw
from aqualvs.scanning.readings import Readings
from aqualvs.scanning.search import SearchAxis, StripeSearch
from aqualvs.scanning.surfaces import Surface
from aqualvs.scanning.triangulate import Triangulator

# Log-odds: a laser that shows nothing though it should is that unlikely (7 %), so is a stripe as
# good as the others that is none (5 %); odds of 20 to 1 decide.
_DARK_LASER, _FOREIGN_STRIPE, _DECIDED = 2.6, 3.0, 3.0
# Residuals of half stripes count as at most so many independent ones: errors of the rig are no noise.
# The noise (px) that half a stripe has at least, and what residuals may say at most.
_MOST_FREEDOM, _HALF_STRIPE_PX, _MOST_BY_RESIDUALS = 10.0, 0.1, 12.0
# Rivals that explain less of the light, as a share of the surface's, are none.
_RIVAL_SHARE = 0.5
# Hypotheses that are so near each other (share of the range, radians) are one.
_SAME_RANGE, _SAME_ANGLE = 0.004, math.radians(0.4)
# Those that are nearer than this are joined by a greater sigma instead of a refusal.
_NEAR_RANGE, _NEAR_ANGLE = 0.02, math.radians(2.0)
# Stripes of so many lasers start rivals; so many rivals are refined.
_N_SEEDS, _N_RIVALS = 4, 6
# Lines to a cell along a stripe, and samples across a band, where the picture's lasers are looked
# up.
_CELL_LINES, _N_SAMPLES = 16, 16
# What lies within this many gates of a plane is on it: lasers that a calibration knows less well
# than a peak is measured must not count as dark, nor their light as foreign.
_WIDE = 2.5
# Fewer cells say nothing of a laser; with a smaller share of the typical one's light it is dark.
_LEAST_CELLS, _DARK_SHARE = 3, 0.25
# A cell is lit if this share of the other lasers that can be there is seen there.
_LIT_SHARE = 0.15
# Half a stripe with fewer search lines says nothing.
_LEAST_LINES = 8
# A surface with less than this share of the light that no other explains, or a solid one whose
# stripes are nowhere seen over this share of their way through the picture, must be seen evenly:
# caustics and fish are not. A laser is faint with this share of the best one's way; this share of
# the lasers may be. Found on rendered dives: planes through caustics have up to 0.14 of the light,
# most below 0.1; nets come down to 0.15, folded ones to 0.14.
_LITTLE_LIGHT, _SHORT_WAY, _FAINT, _MAY_BE_FAINT = 0.12, 0.15, 0.4, 0.25
# Columns of sums over the peaks of one laser's stripe, read as some laser's.
_XX, _XY, _XZ, _YY, _YZ, _ZZ, _SX, _SY, _SZ, _N, _SJX, _SJY, _SJZ, _N_SUMS = range(14)
# What is found of a hypothesis.
_LIGHT, _PER_LASER, _DARK, _VARIANCE, _FREEDOM, _N_FACTS = range(6)


class Verdict(Enum):
    """What the test says of a surface."""

    CLEAR = "clear"
    """No rival comes near it."""
    RIVAL = "rival"
    """Another plane explains the picture better."""
    NEAR = "near"
    """Another plane is as good, and near: the posture's sigma must cover both."""
    AMBIGUOUS = "ambiguous"
    """Another plane is as good, and far off."""


class Tested(NamedTuple):
    """The verdict, the other plane where there is one, and the log-odds of the better one."""

    verdict: Verdict
    other: Plane | None = None
    log_odds: float = math.inf


UNTESTED = Tested(Verdict.CLEAR)
"""Where there is nothing to test, or nothing against it."""


class AssignmentTest:
    """Tests surfaces of one rig against rival assignments.

    Parameters
    ----------
    searches : sequence of StripeSearch
        One for each laser.
    triangulator : Triangulator
        Of the same rig.
    searched : (float, float)
        Nearest and farthest plane that is considered, in metres.
    """

    def __init__(
        self,
        searches: Sequence[StripeSearch],
        triangulator: Triangulator,
        searched: tuple[float, float],
    ) -> None:
        self._searched = searched
        self._along_x = np.array([one.axis is SearchAxis.ALONG_X for one in searches], np.bool_)
        self._bands = _sample_bands(searches, triangulator)

    def by_chance(
        self,
        readings: Readings,
        chunks: Chunks,
        chunk_index: IntArray,
        surfaces: Sequence[Surface],
        target: Surface,
    ) -> bool:
        """Tell whether a surface is so small, and seen so unevenly, that it may be no surface.

        Parameters
        ----------
        readings, chunks, chunk_index
            As in `test`.
        surfaces : sequence of Surface
            All that were found: light on the others does not speak against this one.
        target : Surface
            The one to judge.
        """
        others = np.zeros(len(chunks), np.bool_)
        for one in surfaces:
            if one is not target:
                others |= one.members
        plane = np.append(target.plane.normal, target.plane.offset)
        light = _light_left(readings.source, readings.trust, chunk_index, target.members, others)
        most, faint = _seen_of(plane, target.members, chunks.n_lines, chunks.laser, self._bands)
        small = light < _LITTLE_LIGHT or (most < _SHORT_WAY and not target.is_mesh)
        return small and faint > _MAY_BE_FAINT

    def test(
        self, readings: Readings, chunks: Chunks, chunk_index: IntArray, surface: Surface
    ) -> Tested:
        """Test a surface.

        Parameters
        ----------
        readings : Readings
            N of them.
        chunks : Chunks
            C of them.
        chunk_index : int array, shape (N,)
            Row of each reading's chunk.
        surface : Surface
            The one to test.
        """
        n_lasers = len(self._along_x)
        if n_lasers < 2:
            return UNTESTED
        planes = np.empty((_N_RIVALS + 1, 4))
        facts = np.empty((_N_RIVALS + 1, _N_FACTS))
        planes[0, :3], planes[0, 3] = surface.plane.normal, surface.plane.offset
        n = _find_rivals(
            readings.source,
            readings.laser,
            readings.trust,
            readings.points,
            readings.sensitivity,
            chunk_index,
            surface.members,
            chunks.table,
            *self._searched,
            n_lasers,
            planes,
        )
        if n == 0:
            return UNTESTED
        _judge_planes(
            planes[: n + 1],
            chunks.table,
            chunks.n_lines,
            chunks.first_line,
            chunks.last_line,
            chunks.laser,
            readings.source,
            readings.trust,
            chunk_index,
            self._along_x,
            self._bands,
            facts,
        )
        return _verdict(planes[: n + 1], facts[: n + 1])


def widened(found: Measurement, tested: Tested) -> Measurement:
    """Return a measurement with its covariance widened by a near rival.

    Parameters
    ----------
    found : Measurement
        Of the surface that was tested.
    tested : Tested
        What the test said of it.
    """
    posture, other = found.posture, tested.other
    if tested.verdict is not Verdict.NEAR or other is None or isinstance(posture, Refusal):
        return found
    distance, pitch, yaw = range_pitch_yaw(other.normal / other.offset)
    rival = replace(posture, range=distance, pitch=pitch, yaw=yaw)
    share = 1.0 / (1.0 + math.exp(tested.log_odds))
    return replace(found, posture=doubted(posture, rival, share))


def _verdict(planes: FloatArray, facts: FloatArray) -> Tested:
    """Compare the surface, the first plane, with its rivals, and those with each other."""
    best = 0
    for k in range(1, len(planes)):
        if _log_odds(facts[best], facts[k]) < 0.0:
            best = k
    # The nearest rival of the best one.
    second, odds = -1, math.inf
    for k in range(len(planes)):
        one = _log_odds(facts[best], facts[k]) if not _alike(planes[best], planes[k]) else math.inf
        if one < odds:
            second, odds = k, one
    if odds < _DECIDED:
        other = Plane(planes[second, :3], float(planes[second, 3]))
        first = 0 if _alike(planes[best], planes[0]) else best
        if not _alike(planes[best], planes[second], _NEAR_RANGE, _NEAR_ANGLE):
            return Tested(Verdict.AMBIGUOUS, other, odds)
        if first == 0:
            return Tested(Verdict.NEAR, other, odds)
    if _alike(planes[best], planes[0]):
        return UNTESTED
    return Tested(Verdict.RIVAL, Plane(planes[best, :3], float(planes[best, 3])), odds)


def _log_odds(one: FloatArray, other: FloatArray) -> float:
    """Return the log-odds of one hypothesis against another."""
    per_laser = max(one[_PER_LASER], other[_PER_LASER], 1e-9)
    light = _FOREIGN_STRIPE * (one[_LIGHT] - other[_LIGHT]) / per_laser
    dark = _DARK_LASER * (other[_DARK] - one[_DARK])
    freedom = min(one[_FREEDOM], other[_FREEDOM], _MOST_FREEDOM)
    residuals = 0.0
    if freedom > 0.0:
        residuals = 0.5 * freedom * math.log(other[_VARIANCE] / one[_VARIANCE])
    return float(light + dark + min(max(residuals, -_MOST_BY_RESIDUALS), _MOST_BY_RESIDUALS))


def _alike(
    one: FloatArray, other: FloatArray, share: float = _SAME_RANGE, angle: float = _SAME_ANGLE
) -> bool:
    cosine = float(one[:3] @ other[:3])
    return bool(abs(one[3] / other[3] - 1.0) < share and cosine > math.cos(angle))


def _sample_bands(searches: Sequence[StripeSearch], triangulator: Triangulator) -> FloatArray:
    """Sample the points that each laser's band sees: (n_lasers, cells, samples, 4).

    A point P is kept as (P, 1) / |P|: with it (m·X - 1) / |X| changes nearly evenly across a band.
    NaN where nothing is seen.
    """
    n_cells = max((len(one.lowest) for one in searches), default=0) // _CELL_LINES + 1
    bands = np.full((len(searches), n_cells, _N_SAMPLES, 4), np.nan)
    for i, search in enumerate(searches):
        lines = np.arange(_CELL_LINES // 2, len(search.lowest), _CELL_LINES)
        lines = lines[search.lowest[lines] <= search.highest[lines]]
        if not len(lines):
            continue
        places = np.linspace(search.lowest[lines], search.highest[lines], _N_SAMPLES, axis=1)
        across = np.broadcast_to((lines + 0.5)[:, None] * search.line_px - 0.5, places.shape)
        along_x = search.axis is SearchAxis.ALONG_X
        pixels = np.stack([places, across] if along_x else [across, places], axis=-1)
        n = places.size
        found = triangulator.triangulate(
            np.ascontiguousarray(pixels.reshape(n, 2)), np.full(n, int(along_x)), np.full(n, i)
        )
        points = found.points_in_dome
        share = 1.0 / np.linalg.norm(points, axis=1)
        packed = np.column_stack([points * share[:, None], share])
        packed[~found.valid] = np.nan
        bands[i, lines // _CELL_LINES] = packed.reshape(*places.shape, 4)
    return bands


@kernel
def _find_rivals(
    source: IntArray,
    laser: IntArray,
    trust: FloatArray,
    points: FloatArray,
    sensitivity: FloatArray,
    chunk_index: IntArray,
    members: BoolArray,
    table: FloatArray,
    nearest: float,
    farthest: float,
    n_lasers: int,
    planes: FloatArray,
) -> int:
    """Write planes on which the surface's peaks are other lasers' from the second row on."""
    sums = np.zeros((n_lasers, n_lasers, _N_SUMS))
    place = np.zeros((n_lasers, 3))
    _sum_readings(source, laser, trust, points, sensitivity, chunk_index, members, sums)
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
    if other < _RIVAL_SHARE * total:
        return 0
    seeds = _choose_seeds(sums, place)
    score = np.zeros(planes.shape[0])
    n = 0
    for p in range(seeds.shape[0]):
        for q in range(p + 1, seeds.shape[0]):
            n = _try_pair(sums, seeds[p], seeds[q], nearest, farthest, total, planes, score, n)
    return _refine_rivals(table, nearest, farthest, planes, n)


@kernel
def _sum_readings(
    source: IntArray,
    laser: IntArray,
    trust: FloatArray,
    points: FloatArray,
    sensitivity: FloatArray,
    chunk_index: IntArray,
    members: BoolArray,
    sums: FloatArray,
) -> None:
    """Sum the moments of each laser's peaks on the surface, read as each laser's."""
    last = 0
    for i in range(source.shape[0]):
        last = max(last, source[i])
    owner = np.full(last + 1, -1)
    for i in range(source.shape[0]):
        if members[chunk_index[i]]:
            owner[source[i]] = laser[i]
    for i in range(source.shape[0]):
        own = owner[source[i]]
        if own < 0:
            continue
        w, row = trust[i], sums[own, laser[i]]
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


@kernel
def _choose_seeds(sums: FloatArray, place: FloatArray) -> IntArray:
    """Choose lasers whose stripes are bright and far from each other."""
    n_lasers = place.shape[0]
    seeds, n = np.empty(min(_N_SEEDS, n_lasers), np.int64), 0
    while n < seeds.shape[0]:
        best, most = -1, 0.0
        for i in range(n_lasers):
            value = sums[i, i, _N]
            apart = np.inf
            for k in range(n):
                square = 0.0
                for j in range(3):
                    square += (place[i, j] - place[seeds[k], j]) ** 2
                apart = min(apart, np.sqrt(square))
            value *= 1.0 if n == 0 else apart
            if value > most:
                best, most = i, value
        if best < 0:
            break
        seeds[n] = best
        n += 1
    return seeds[:n]


@kernel
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
    """Read two stripes as those of any two lasers, and keep the planes that explain most light."""
    n_lasers = sums.shape[0]
    plane = np.empty(4)
    normal, scratch, right, m = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    for a in range(n_lasers):
        for b in range(n_lasers):
            if a == b or (a == i and b == k):
                continue
            first, second = sums[i, a], sums[k, b]
            if first[_N] < _RIVAL_SHARE * sums[i, i, _N]:
                continue
            if second[_N] < _RIVAL_SHARE * sums[k, k, _N]:
                continue
            if not _fit_two(first, second, normal, scratch, right, m, plane):
                continue
            if plane[3] < nearest or plane[3] > farthest or plane[1] < MIN_FACING:
                continue
            value = _explained(sums, plane)
            if value >= _RIVAL_SHARE * total:
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
    """Fit X·m = 1 to the peaks of two stripes, each with the same weight."""
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


@borrowing_kernel
def _explained(sums: FloatArray, plane: FloatArray) -> float:
    """Return the light of the stripes that lie on a plane, each read as the laser that fits best.

    A stripe counts less the farther it is off, by the root mean square over its length.
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
            gate = _WIDE * _WIDE * squared_gate(per_px, d)
            best = max(best, n * (1.0 - square / (n * gate)))
        total += best
    return total


@kernel
def _keep_best(
    plane: FloatArray, value: float, planes: FloatArray, score: FloatArray, n: int
) -> int:
    """Keep a plane from the second row on, unless one like it is better; the best come first."""
    if _same(plane, planes[0], 2.0):
        return n
    for k in range(1, n + 1):
        if _same(plane, planes[k], 2.0):
            if value > score[k]:
                planes[k], score[k] = plane, value
            return n
    if n + 1 < planes.shape[0]:
        n += 1
        planes[n], score[n] = plane, value
        return n
    worst = 1
    for k in range(2, n + 1):
        if score[k] < score[worst]:
            worst = k
    if value > score[worst]:
        planes[worst], score[worst] = plane, value
    return n


@inline_borrowing_kernel
def _same(one: FloatArray, other: FloatArray, times: float) -> bool:
    cosine = one[0] * other[0] + one[1] * other[1] + one[2] * other[2]
    angle = times * _SAME_ANGLE
    near = abs(one[3] - other[3]) < times * _SAME_RANGE * other[3]
    return bool(near and 2.0 * (1.0 - cosine) < angle * angle)


@kernel
def _refine_rivals(
    table: FloatArray, nearest: float, farthest: float, planes: FloatArray, n: int
) -> int:
    """Refine the planes from the second row on; drop those that become another; count the rest."""
    normal, scratch, lanes = np.empty((3, 3)), np.empty((5, 3)), np.empty(table.shape[1])
    kept = 0
    for _ in range(2):
        refine_plane(table, planes[0], _WIDE, normal, scratch, lanes)
    for k in range(1, n + 1):
        plane = planes[k]
        good = True
        for stretch in (_WIDE, 1.0, 1.0, _WIDE, _WIDE):
            good = good and refine_plane(table, plane, stretch, normal, scratch, lanes)
        good = good and nearest <= plane[3] <= farthest and plane[1] >= MIN_FACING
        for j in range(kept + 1):
            good = good and not _same(plane, planes[j], 1.0)
        if good:
            kept += 1
            planes[kept] = plane
    return kept


@kernel
def _judge_planes(
    planes: FloatArray,
    table: FloatArray,
    n_lines: IntArray,
    first_line: IntArray,
    last_line: IntArray,
    laser: IntArray,
    source: IntArray,
    trust: FloatArray,
    chunk_index: IntArray,
    along_x: BoolArray,
    bands: FloatArray,
    facts: FloatArray,
) -> None:
    """Write the facts of every plane."""
    n_lasers, n_cells = bands.shape[0], bands.shape[1]
    last = 0
    for i in range(source.shape[0]):
        last = max(last, source[i])
    seen = np.empty(last + 1, np.int64)
    seen[:] = -1
    near = np.empty(laser.shape[0])
    lit, expected = np.empty((n_lasers, n_cells), np.bool_), np.empty((n_lasers, n_cells), np.bool_)
    for k in range(planes.shape[0]):
        plane, found = planes[k], facts[k]
        _mark_light(plane, table, first_line, last_line, laser, near, lit)
        found[_LIGHT] = _light_on(k, near, source, trust, chunk_index, seen)
        found[_VARIANCE], found[_FREEDOM], n_lit = _variance(
            plane, table, n_lines, first_line, laser, near, n_lasers
        )
        found[_PER_LASER] = found[_LIGHT] / max(n_lit, 1)
        _mark_expected(plane, bands, expected)
        found[_DARK] = _dark_lasers(lit, expected, along_x)


@borrowing_kernel
def _mark_light(
    plane: FloatArray,
    table: FloatArray,
    first_line: IntArray,
    last_line: IntArray,
    laser: IntArray,
    near: FloatArray,
    lit: BoolArray,
) -> None:
    """Write how near each chunk is to a plane, 0 to 1; mark the cells in which each laser shows something near it."""
    lit[:] = False
    x, y, z, offset = plane[0], plane[1], plane[2], plane[3]
    for c in range(laser.shape[0]):
        residual = x * table[X, c] + y * table[Y, c] + z * table[Z, c] - offset
        per_px = x * table[JX, c] + y * table[JY, c] + z * table[JZ, c]
        gate = _WIDE * _WIDE * squared_gate(per_px, offset)
        near[c] = max(1.0 - residual * residual / gate, 0.0)
        if near[c] > 0.0:
            for cell in range(first_line[c] // _CELL_LINES, last_line[c] // _CELL_LINES + 1):
                lit[laser[c], cell] = True


@borrowing_kernel
def _light_on(
    number: int,
    near: FloatArray,
    source: IntArray,
    trust: FloatArray,
    chunk_index: IntArray,
    seen: IntArray,
) -> float:
    """Sum the trust of the peaks on a plane, each once, by how near it is."""
    total = 0.0
    for i in range(source.shape[0]):
        share = near[chunk_index[i]]
        if share > 0.0 and seen[source[i]] != number:
            seen[source[i]] = number
            total += trust[i] * share
    return total


@borrowing_kernel
def _variance(
    plane: FloatArray,
    table: FloatArray,
    n_lines: IntArray,
    first_line: IntArray,
    laser: IntArray,
    near: FloatArray,
    n_lasers: int,
) -> tuple[float, float, int]:
    """Variance (px²) of half stripes about a plane, its degrees of freedom, and lasers seen."""
    x, y, z, offset = plane[0], plane[1], plane[2], plane[3]
    square, n, n_lit = 0.0, 0, 0
    begin = 0
    for i in range(n_lasers):
        end = begin
        middle, lines = 0.0, 0
        while end < laser.shape[0] and laser[end] == i:
            if near[end] > 0.0:
                middle += n_lines[end] * first_line[end]
                lines += n_lines[end]
            end += 1
        middle /= max(lines, 1)
        n_lit += lines >= _LEAST_LINES
        for half in range(2):
            total, lines = 0.0, 0
            for c in range(begin, end):
                if near[c] > 0.0 and (first_line[c] >= middle) == (half == 1):
                    residual = x * table[X, c] + y * table[Y, c] + z * table[Z, c] - offset
                    per_px = x * table[JX, c] + y * table[JY, c] + z * table[JZ, c]
                    total += n_lines[c] * residual / per_px
                    lines += n_lines[c]
            if lines >= _LEAST_LINES:
                square += (total / lines) ** 2
                n += 1
        begin = end
    freedom = n - 3.0
    if freedom <= 0.0:
        return 1.0, 0.0, n_lit
    return square / freedom + _HALF_STRIPE_PX * _HALF_STRIPE_PX, freedom, n_lit


@borrowing_kernel
def _mark_expected(plane: FloatArray, bands: FloatArray, expected: BoolArray) -> None:
    """Mark the cells in which each laser's stripe on a plane lies in its band in the picture."""
    x, y, z, offset = plane[0], plane[1], plane[2], plane[3]
    for i in range(bands.shape[0]):
        for cell in range(bands.shape[1]):
            before = np.nan
            found = False
            for s in range(bands.shape[2]):
                row = bands[i, cell, s]
                here = x * row[0] + y * row[1] + z * row[2] - offset * row[3]
                if here * before <= 0.0:
                    found = True
                    break
                before = here
            expected[i, cell] = found


@kernel
def _light_left(
    source: IntArray,
    trust: FloatArray,
    chunk_index: IntArray,
    members: BoolArray,
    others: BoolArray,
) -> float:
    """Return the share of the light on a surface, that on others left out."""
    last = 0
    for i in range(source.shape[0]):
        last = max(last, source[i])
    light, owner = np.zeros(last + 1), np.zeros(last + 1, np.int64)
    for i in range(source.shape[0]):
        c, r = chunk_index[i], source[i]
        light[r] = trust[i]
        owner[r] = max(owner[r], 2 if members[c] else int(others[c]))
    total, on = 0.0, 0.0
    for r in range(last + 1):
        total += light[r] if owner[r] != 1 else 0.0
        on += light[r] if owner[r] == 2 else 0.0
    return on / max(total, 1e-12)


@kernel
def _seen_of(
    plane: FloatArray,
    members: BoolArray,
    n_lines: IntArray,
    laser: IntArray,
    bands: FloatArray,
) -> tuple[float, float]:
    """Return how much of its best stripe's way a surface shows, and the share of faint lasers."""
    n_lasers, n_cells = bands.shape[0], bands.shape[1]
    expected, way = np.empty((n_lasers, n_cells), np.bool_), np.zeros(n_lasers)
    _mark_expected(plane, bands, expected)
    for c in range(laser.shape[0]):
        if members[c]:
            way[laser[c]] += n_lines[c]
    most, asked, faint = 0.0, 0, 0
    for i in range(n_lasers):
        cells = np.sum(expected[i])
        way[i] = way[i] / (_CELL_LINES * cells) if cells >= _LEAST_CELLS else np.nan
        if way[i] > most:
            most = way[i]
    for i in range(n_lasers):
        if way[i] == way[i]:
            asked += 1
            faint += way[i] < _FAINT * most
    return most, faint / max(asked, 1)


@borrowing_kernel
def _dark_lasers(lit: BoolArray, expected: BoolArray, along_x: BoolArray) -> float:
    """Count the lasers that show nothing where they should and others do; in part if dim."""
    n_lasers, n_cells = lit.shape
    dark = 0.0
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
            if shown < 1 or shown < _LIT_SHARE * there:
                continue
            asked += 1
            seen += lit[i, cell]
            of_others += there
            by_others += shown
        if asked < _LEAST_CELLS:
            continue
        typical = _DARK_SHARE * by_others / of_others
        share = seen / asked
        if share < typical:
            dark += 1.0 - share / typical
    return dark
