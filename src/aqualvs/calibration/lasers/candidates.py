"""Candidates for laser planes, from straight stripes on flat surfaces, with their evidence.

`lines_on_patch` finds the straight lines among the stripe points on one surface: a laser plane cuts
the surface in such a line. Two lines on different surfaces that lie in one plane suggest it. Such
pairs also occur by accident; the plane of a laser meets lines of further surfaces as well. The
evidence of each further line follows from how often planes of accidental pairs meet it: an
a-contrario test (Desolneux, Moisan & Morel 2000, doi:10.1023/A:1026593302236) whose chance rates
come from the pictures themselves. The number of points does not count.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import gammaln

from aqualvs.calibration.lasers.stripes_on_planes import PlacedStripes, PooledStripes
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Plane


class _LineOptions(NamedTuple):
    """Search for straight stripes on a surface of the target."""

    # Largest tangent of the angle between a point's stripe and the line, in the image.
    aligned: float = 0.35
    min_points: int = 12
    min_length_px: float = 20.0
    max_lines: int = 40
    n_guesses: int = 800
    n_sampled: int = 600
    n_fits: int = 3


_LINES = _LineOptions()


@dataclass(frozen=True, slots=True)
class StripeLine:
    """A straight stripe on a surface."""

    patch: int  # Index of the surface of a view.
    members: IntArray  # Shape (M,): indices of its points among those of all patches.


def lines_on_patch(pooled: PooledStripes, members: IntArray, patch: int) -> list[StripeLine]:
    """Find the straight stripes among the points `members` (M,) of one surface.

    Longest first; no point belongs to two.
    """
    placed, normal = pooled.placed, pooled.patch_planes[patch].normal
    points, across = placed.points_in_dome[members], placed.by_across[members]
    along = placed.by_along[members]
    some = slice(None, None, -(-len(members) // _LINES.n_sampled) or 1)
    i, j = _pairs(pooled.chain[members], patch)
    # Lines m·X = c through the pairs, m in the surface; NaN for equal points.
    guessed = np.cross(normal, points[j] - points[i])
    length = np.linalg.norm(guessed, axis=1)
    guessed /= np.where(length > 1e-6, length, np.nan)[:, None]
    offsets = np.einsum("ni,ni->n", guessed, points[i])
    # Most pairs are of two stripes; their directions are not that of the line through both points.
    good = _runs_along(across[i], along[i], guessed) & _runs_along(across[j], along[j], guessed)
    guessed, offsets = guessed[good], offsets[good]
    # Points this near to a line, in pixels across their stripe, belong to it.
    tolerance_px = 2.0
    votes = _near(points[some], across[some], along[some], guessed, offsets, tolerance_px)
    counts = np.count_nonzero(votes, axis=0)
    lines: list[StripeLine] = []
    free = np.ones(len(members), np.bool_)
    # Points this near are removed with it: the halo of a stripe is no second stripe.
    halo_px = 6.0
    while len(lines) < _LINES.max_lines and len(guessed):
        best = int(np.argmax(counts))
        m, c = guessed[best], float(offsets[best])
        for _ in range(_LINES.n_fits):
            near = free & _near(points, across, along, m[None], c, tolerance_px)[:, 0]
            if np.count_nonzero(near) < _LINES.min_points:
                return lines
            m, c = _fitted(points[near], across[near], normal, m)
        near = free & _near(points, across, along, m[None], c, tolerance_px)[:, 0]
        if _length_px(points[near], along[near]) >= _LINES.min_length_px:
            lines.append(StripeLine(patch, members[near]))
        taken = free & (near | _near(points, across, along, m[None], c, halo_px)[:, 0])
        free &= ~taken
        counts -= np.count_nonzero(votes[taken[some]], axis=0)
    return lines


def _pairs(chain: IntArray, seed: int) -> tuple[IntArray, IntArray]:
    """Return random pairs of points (N), half of them within a chain."""
    n = len(chain)
    if n < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    rng = np.random.default_rng(seed)
    i, j = rng.integers(0, n, (2, _LINES.n_guesses))
    half = slice(0, _LINES.n_guesses // 2)
    order = np.argsort(chain, kind="stable")
    first = np.searchsorted(chain[order], chain[i[half]], "left")
    last = np.searchsorted(chain[order], chain[i[half]], "right")
    j[half] = order[rng.integers(first, last)]
    return i, j


def _runs_along(across: FloatArray, along: FloatArray, m: FloatArray) -> BoolArray:
    """Return the mask of points (N) whose stripe runs along their line (N)."""
    gain = np.abs(np.einsum("ni,ni->n", across, m))
    aligned: BoolArray = np.abs(np.einsum("ni,ni->n", along, m)) <= _LINES.aligned * gain
    return aligned


def _near(
    points: FloatArray,
    across: FloatArray,
    along: FloatArray,
    m: FloatArray,
    c: FloatArray | float,
    tolerance_px: float,
) -> BoolArray:
    """Return the mask (N, H) of points that are near lines and run along them."""
    gain = np.abs(across @ m.T)
    near: BoolArray = np.abs(points @ m.T - c) <= tolerance_px * gain
    near &= np.abs(along @ m.T) <= _LINES.aligned * gain
    return near


def _fitted(
    points: FloatArray, across: FloatArray, normal: FloatArray, m: FloatArray
) -> tuple[FloatArray, float]:
    """Fit a line by least squares, with the points' weights of the image."""
    weight = 1.0 / np.maximum(np.abs(across @ m), 1e-9) ** 2
    middle = weight @ points / weight.sum()
    t = np.cross(m, normal)
    u, v = (points - middle) @ t, (points - middle) @ m
    turned = m - t * float(weight @ (u * v)) / max(float(weight @ (u * u)), 1e-30)
    turned /= np.linalg.norm(turned)
    return turned, float(turned @ middle)


def _length_px(points: FloatArray, along: FloatArray) -> float:
    """Return the approximate length of a line in the image."""
    if not len(points):
        return 0.0
    spread = points.max(axis=0) - points.min(axis=0)
    per_px = float(np.median(np.linalg.norm(along, axis=1)))
    return float(np.linalg.norm(spread)) / per_px


# Limits within which two surfaces are the same: sine between normals, distance in metres.
_SAME_NORMAL, _SAME_OFFSET = 0.05, 0.02
_N_PLANE_FITS = 5


class _AccidentOptions(NamedTuple):
    """Test of how often lines meet in a plane by accident."""

    # Prior of the rate of accidents, for when few are seen: spread of the lines in pixels, and its
    # weight as a number of observed planes. Then the shift in pixels, the number of shifts and the
    # number of pairs in the random test of how often lines meet by accident.
    spread_px: float = 1000.0
    prior_weight: float = 20.0
    moved_px: float = 250.0
    n_moves: int = 8
    max_moved: int = 1000
    # A line nearer than this share of the tolerance is no better evidence: poses are not more
    # accurate.
    nearest: float = 0.1
    # Accidents of a line are counted on lines of its surface of at least this share of its length.
    as_long: float = 0.5
    # Rounds of removing the lines of found planes from the accidents.
    n_rounds: int = 3
    max_trials: int = 60


_ACCIDENTS = _AccidentOptions()


@dataclass(frozen=True, slots=True)
class PlaneCandidate:
    """A plane that may be a laser's."""

    plane: Plane  # In `dome`.
    lines: IntArray  # Shape (K,): indices of the lines in it.
    members: IntArray  # Shape (M,): indices of their points.
    # Natural logarithm of the number of accidental planes as good as this one that are expected in
    # these pictures.
    log_false_alarms: float
    # Root mean square over surfaces of the distance of lines from the plane, at their worst end.
    residual_px: float


@dataclass(frozen=True, slots=True)
class LineTable:
    """L lines with their ends and middles: planes are guessed from them and tested on them."""

    pooled: PooledStripes  # Points of all views.
    lines: Sequence[StripeLine]  # Straight stripes of all surfaces.
    tolerance_px: float  # Greatest distance of a stripe from its plane.
    patch: IntArray  # Shape (L,): index of the line's surface of a view.
    length: FloatArray  # Shape (L,): in metres.
    points: FloatArray  # Shape (L, 3, 3): ends and middle, in `dome`.
    # Shape (L, 3, 3): their derivative by the pixel across the stripe, metres per pixel.
    by_across: FloatArray

    @classmethod
    def of(
        cls, pooled: PooledStripes, lines: Sequence[StripeLine], tolerance_px: float
    ) -> "LineTable":
        """Return the table of some lines."""
        points, by_across = np.zeros((len(lines), 3, 3)), np.zeros((len(lines), 3, 3))
        for i, line in enumerate(lines):
            mine = pooled.placed.points_in_dome[line.members]
            middle = mine.mean(axis=0)
            direction = np.linalg.svd(mine - middle, full_matrices=False)[2][0]
            way = (mine - middle) @ direction
            ends = np.quantile(way, [0.02, 0.5, 0.98])
            points[i] = middle + ends[:, None] * direction
            nearest = np.argmin(np.abs(way[:, None] - ends), axis=0)
            by_across[i] = pooled.placed.by_across[line.members][nearest]
        patch = np.array([line.patch for line in lines], np.int64)
        length = np.linalg.norm(points[:, 2] - points[:, 0], axis=1)
        return cls(pooled, lines, tolerance_px, patch, length, points, by_across)

    def worst_px(self, normals: FloatArray, offsets: FloatArray) -> FloatArray:
        """Return the distance of lines from planes at their worst end, in pixels, shape (H, L)."""
        distance = np.abs(np.einsum("hi,lki->hlk", normals, self.points) - offsets[:, None, None])
        gain = np.abs(np.einsum("hi,lki->hlk", normals, self.by_across))
        with np.errstate(divide="ignore", invalid="ignore"):
            worst: FloatArray = np.max(distance / gain, axis=2)
        return np.nan_to_num(worst, nan=np.inf)

    def worst_of(self, plane: Plane) -> FloatArray:
        """Return the distance of lines from a plane at their worst end, in pixels, shape (1, L)."""
        return self.worst_px(plane.normal[None], np.array([plane.offset]))

    def members(self, lines: IntArray) -> IntArray:
        """Return the indices of the points of some lines."""
        return np.concatenate([self.lines[int(i)].members for i in lines])


@dataclass(frozen=True, slots=True)
class _Hypotheses:
    """H planes through pairs of lines that meet."""

    pairs: IntArray
    worst: FloatArray
    normals: FloatArray
    offsets: FloatArray
    n_expected: float
    kept_share: float

    @classmethod
    def of(cls, table: LineTable) -> "_Hypotheses":
        # Pairs of lines that lie on different surfaces.
        different = ~_same_surfaces(table.pooled.patch_planes)
        i, j = np.triu_indices(len(table.patch), 1)
        apart = different[table.patch[i], table.patch[j]]
        pairs = np.stack([i[apart], j[apart]], axis=-1)
        n_expected = len(pairs) * _meeting_rate(table, pairs)
        points, by_across = table.points[pairs], table.by_across[pairs]
        normals, offsets = _planes_of_pairs(points)
        kept = np.flatnonzero(_meet(points, by_across, normals, offsets, table.tolerance_px))
        # Number of pairs beyond which they are sampled; number of planes tried at a time.
        max_planes, at_once = 6000, 500
        share = min(1.0, max_planes / max(len(kept), 1))
        if share < 1.0:
            kept = np.sort(np.random.default_rng(0).choice(kept, max_planes, replace=False))
        pairs, normals, offsets = pairs[kept], normals[kept], offsets[kept]
        worst = np.empty((len(kept), len(table.patch)))
        for first in range(0, len(kept), at_once):
            some = slice(first, first + at_once)
            worst[some] = table.worst_px(normals[some], offsets[some])
        return cls(pairs, worst, normals, offsets, n_expected, share)


@dataclass(frozen=True, slots=True)
class _Accidents:
    """Rates at which planes and lines of different lasers meet."""

    # Shape (L,): probability that an accidental plane meets a line of this length on its surface.
    rate: FloatArray
    # Number of accidental pairs of lines that meet.
    n_planes: float


def find_candidates(table: LineTable) -> list[PlaneCandidate]:
    """Find planes of straight stripes, the best first; no line is used twice.

    The expected number of accidents of each plane is below one.
    """
    planes = _Hypotheses.of(table)
    found: list[PlaneCandidate] = []
    if not len(planes.pairs):
        return found
    accidental = np.zeros(len(planes.pairs), np.bool_)
    for _ in range(_ACCIDENTS.n_rounds):
        found = _collected(table, planes, _accidents(table, planes, accidental))
        # Accidental are the pairs that are not of two lines of one found plane.
        owner = np.full(len(table.patch), -1)
        for i, candidate in enumerate(found):
            owner[candidate.lines] = i
        of_pair = owner[planes.pairs]
        accidental = (of_pair[:, 0] != of_pair[:, 1]) | (of_pair[:, 0] < 0)
    return found


def ordered_candidates(table: LineTable, n_lasers: int) -> list[PlaneCandidate]:
    """Find the planes of lasers whose stripes lie side by side, in one order on every surface.

    Near-parallel stripes meet accidental planes so often that three surfaces are no evidence for a
    single plane. But if each of them shows as many stripes as lasers shine, their order tells which
    belong together.

    Returns as many planes as lasers shine; none if there are fewer than three such surfaces, a
    stripe is farther from its plane than the tolerance, or stripes shifted by one place fit nearly
    as well.
    """
    of_patches = [
        mine
        for patch in np.unique(table.patch)
        if len(mine := _longest(table, np.flatnonzero(table.patch == patch), n_lasers))
    ]
    # Enough surfaces to test the order; more are not needed.
    fewest, most = 3, 4
    planes = table.pooled.patch_planes
    same = _same_surfaces([planes[table.patch[mine[0]]] for mine in of_patches])
    apart = [
        mine for mine, others in zip(of_patches, np.tril(same, -1), strict=True) if not others.any()
    ]
    if n_lasers < 2 or len(apart) < fewest:
        return []
    order = _side_by_side(table, apart[:most])
    found = [_plane_of_lines(table, mine) for mine in order.T]
    if max(one.residual_px for one in found) > table.tolerance_px:
        return []
    error = _rms_px(found)
    # The assignments by shifted orders that must be worse, and by which factor.
    clearly_worse = 3.0
    for shifts in filter(any, itertools.product((-1, 0, 1), repeat=len(order) - 1)):
        rivals = [_plane_of_lines(table, mine) for mine in _shifted(order, (0, *shifts)).T]
        if rivals and _rms_px(rivals) < clearly_worse * error:
            return []
    return found


def _longest(table: LineTable, mine: IntArray, n: int) -> IntArray:
    """Return the n longest of some lines if the others are much shorter; else none."""
    size = np.array([len(table.lines[int(i)].members) for i in mine])
    longest = np.argsort(-size, kind="stable")
    # Largest length of another line, as a share of theirs: a reflection, or part of an edge.
    much_shorter = 0.5
    if len(mine) < n or np.any(size[longest[n:]] >= much_shorter * size[longest[n - 1]]):
        return mine[:0]
    return mine[longest[:n]]


def _side_by_side(table: LineTable, of_patches: Sequence[IntArray]) -> IntArray:
    """Return the lines (P, n) of patches, in their order across the stripes as the lens sees it."""
    along = table.points[:, 2] - table.points[:, 0]
    along *= np.sign(along @ along[of_patches[0][0]])[:, None]
    rows = []
    for mine in of_patches:
        middle = table.points[mine, 1]
        across = np.cross(middle.mean(axis=0), along[mine].sum(axis=0))
        rows.append(mine[np.argsort(middle @ across)])
    return np.stack(rows)


def _shifted(order: IntArray, shifts: Sequence[int]) -> IntArray:
    """Return the lines (P, m) of the places that all patches have after shifts of each."""
    n = order.shape[1] - (max(shifts) - min(shifts))
    starts = [shift - min(shifts) for shift in shifts]
    return np.stack([row[start : start + n] for row, start in zip(order, starts, strict=True)])


def _plane_of_lines(table: LineTable, mine: IntArray) -> PlaneCandidate:
    """Return the plane that some lines lie in, as certain."""
    normals, offsets = _planes_of_pairs(table.points[mine[None, :2]])
    plane = Plane(normals[0], float(offsets[0]))
    members = table.members(mine)
    for _ in range(_N_PLANE_FITS):
        plane = fitted_plane(table.pooled.placed, members, plane)
    worst = table.worst_of(plane)[0, mine]
    return PlaneCandidate(plane, mine, members, -np.inf, float(np.sqrt(np.mean(worst**2))))


def _rms_px(candidates: Sequence[PlaneCandidate]) -> float:
    return float(np.sqrt(np.mean([one.residual_px**2 for one in candidates])))


def _accidents(table: LineTable, planes: _Hypotheses, accidental: BoolArray) -> _Accidents:
    """Count how often planes of accidental pairs (H,) meet lines."""
    n = np.count_nonzero(accidental)
    met = np.count_nonzero(planes.worst[accidental] <= table.tolerance_px, axis=0)
    # A pair's own lines are met by construction.
    met = met - np.bincount(planes.pairs[accidental].ravel(), minlength=len(table.patch))
    prior = min(1.0, 2.0 * table.tolerance_px / _ACCIDENTS.spread_px)
    own_rate = (np.maximum(met, 0) + _ACCIDENTS.prior_weight * prior) / (
        n + _ACCIDENTS.prior_weight
    )
    as_long = table.length[None] >= _ACCIDENTS.as_long * table.length[:, None]
    rivals = (table.patch[:, None] == table.patch[None]) & as_long
    rate = np.minimum(rivals @ own_rate, 1.0)
    # One of the pairs that meet is the plane's own; the rate is the same for lines elsewhere.
    n_planes = max(n / planes.kept_share, planes.n_expected)
    return _Accidents(rate, float(n_planes))


def _collected(
    table: LineTable, planes: _Hypotheses, accidents: _Accidents
) -> list[PlaneCandidate]:
    """Extract the best plane and its lines, as long as one is better than accidents."""
    found: list[PlaneCandidate] = []
    free = np.ones(len(table.patch), np.bool_)
    alive = np.ones(len(planes.pairs), np.bool_)
    nearness = _nearness(planes.worst, table.tolerance_px)
    for _ in range(_ACCIDENTS.max_trials):
        alive &= np.all(free[planes.pairs], axis=1)
        alarms = _log_false_alarms(table, np.where(free, nearness, np.inf), accidents)
        alarms[~alive] = np.inf
        best = int(np.argmin(alarms))
        if not np.isfinite(alarms[best]):
            break
        alive[best] = False
        start = Plane(planes.normals[best], float(planes.offsets[best]))
        candidate = _fitted_candidate(table, free, start, accidents)
        if candidate is None:
            continue
        if candidate.log_false_alarms > 0.0:
            if alarms[best] > 0.0:
                break
            continue
        found.append(candidate)
        free[candidate.lines] = False
    return sorted(found, key=lambda candidate: candidate.log_false_alarms)


def _nearness(worst: FloatArray, tolerance_px: float) -> FloatArray:
    """Return distances (H, L) as a share of the tolerance; infinite beyond it."""
    near: FloatArray = np.maximum(worst / tolerance_px, _ACCIDENTS.nearest)
    near[near > 1.0] = np.inf
    return near


def _log_false_alarms(table: LineTable, nearness: FloatArray, accidents: _Accidents) -> FloatArray:
    """Return the logarithm of the expected number (H,) of accidents as good as these planes.

    Two lines define a plane, so that only their distance is evidence; for all further lines, on any
    surface, the evidence is that the plane meets them, and their distance.
    """
    order = np.argsort(table.patch, kind="stable")
    starts = np.flatnonzero(np.diff(table.patch[order], prepend=-1))
    chance = np.minimum(nearness * accidents.rate, 1.0)[:, order]
    by_patch = np.minimum.reduceat(chance, starts, axis=1)
    by_patch.sort(axis=1)
    # The two lines with the most evidence count as those that define the plane.
    further = by_patch[:, 2:]
    n, k = further.shape[1], np.count_nonzero(further < 1.0, axis=1)
    choices = gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1)
    alarms: FloatArray = np.log(accidents.n_planes) + choices + np.log(further).sum(axis=1)
    meeting = np.where(np.isfinite(nearness), nearness, 0.0).max(axis=1)
    return alarms + np.where(k == 0, np.log(np.maximum(meeting, _ACCIDENTS.nearest)), 0.0)


def _fitted_candidate(
    table: LineTable, free: BoolArray, plane: Plane, accidents: _Accidents
) -> PlaneCandidate | None:
    """Fit a plane to the points of the free lines near it, and evaluate its evidence anew."""
    for fits_left in range(_N_PLANE_FITS, -1, -1):
        worst = table.worst_of(plane)
        mine = np.flatnonzero(free & (worst[0] <= table.tolerance_px))
        patches = np.unique(table.patch[mine])
        if _same_surfaces([table.pooled.patch_planes[i] for i in patches]).all():
            return None
        members = table.members(mine)
        if fits_left:
            plane = fitted_plane(table.pooled.placed, members, plane)
    nearness = np.where(free, _nearness(worst, table.tolerance_px), np.inf)
    alarms = _log_false_alarms(table, nearness, accidents)
    residual = float(np.sqrt(np.mean(worst[0, mine] ** 2)))
    return PlaneCandidate(plane, mine, members, float(alarms[0]), residual)


def _planes_of_pairs(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return planes (P, 3), (P,) through two lines each, by the ends in their points (P, 2, 3, 3).

    `points`: as in `LineTable`.
    """
    ends = points[:, :, [0, 2]].reshape(len(points), 4, 3)
    middle = ends.mean(axis=1)
    offsets = ends - middle[:, None]
    normals = np.linalg.eigh(offsets.transpose(0, 2, 1) @ offsets)[1][:, :, 0]
    distances: FloatArray = np.einsum("hi,hi->h", normals, middle)
    return normals, distances


def _meet(
    points: FloatArray,
    by_across: FloatArray,
    normals: FloatArray,
    offsets: FloatArray,
    tolerance_px: float,
) -> BoolArray:
    """Return the mask of pairs (P,) of lines that lie in their plane to within the tolerance."""
    distance = np.abs(np.einsum("pi,pski->psk", normals, points) - offsets[:, None, None])
    gain = np.abs(np.einsum("pi,pski->psk", normals, by_across))
    meet: BoolArray = np.all(distance <= tolerance_px * gain, axis=(1, 2))
    return meet


def _meeting_rate(table: LineTable, pairs: IntArray) -> float:
    """Return the rate at which pairs (P, 2) of lines meet after a random shift of one.

    Parallel lines always meet; the rate falls with the angle between them.
    """
    if not len(pairs):
        return 0.0
    rng = np.random.default_rng(1)
    some = pairs[rng.permutation(len(pairs))[: _ACCIDENTS.max_moved]]
    by_across = table.by_across[some]
    met = 0
    for _ in range(_ACCIDENTS.n_moves):
        moves = rng.uniform(-_ACCIDENTS.moved_px, _ACCIDENTS.moved_px, len(some))[:, None, None]
        points = table.points[some]
        points[:, 1] += moves * by_across[:, 1]
        meet = _meet(points, by_across, *_planes_of_pairs(points), table.tolerance_px)
        met += int(np.count_nonzero(meet))
    return (met + 1.0) / (_ACCIDENTS.n_moves * len(some) + 1.0)


def _same_surfaces(planes: Sequence[Plane]) -> BoolArray:
    """Return the mask (P, P) of patches that lie nearly in one plane of `dome`."""
    normals = np.array([p.normal for p in planes]).reshape(-1, 3)
    offsets = np.array([p.offset for p in planes])
    sine = np.linalg.norm(np.cross(normals[:, None], normals[None]), axis=2)
    apart = np.abs(np.abs(offsets[:, None]) - np.abs(offsets[None]))
    same: BoolArray = (sine < _SAME_NORMAL) & (apart < _SAME_OFFSET)
    return same


def fitted_plane(
    placed: PlacedStripes, members: IntArray, start: Plane, through: FloatArray | None = None
) -> Plane:
    """Fit a plane to some of the points, with the weights of the image.

    `through`: a point (3,) that the plane must contain.
    """
    points = placed.points_in_dome[members]
    gain = np.abs(placed.by_across[members] @ start.normal)
    weight = 1.0 / np.maximum(gain, 1e-9) ** 2
    middle = weight @ points / weight.sum() if through is None else through
    offsets = points - middle
    normal = np.linalg.eigh((weight[:, None] * offsets).T @ offsets)[1][:, 0]
    normal = normal if normal @ start.normal > 0.0 else -normal
    return Plane(normal, float(normal @ middle))


def plane_residuals_px(placed: PlacedStripes, planes: Sequence[Plane]) -> FloatArray:
    """Return distances (N, L) of points from the stripes of planes, across their stripe, in px.

    Infinite where the direction of a point's stripe is not that of the plane's stripe.
    """
    normals = np.array([p.normal for p in planes]).reshape(-1, 3)
    offsets = np.array([p.offset for p in planes])
    gain = np.abs(placed.by_across @ normals.T)
    slant = np.abs(placed.by_along @ normals.T)
    # Largest tangent of the angle between a point's stripe and the plane's, in the image.
    aligned_with_plane = 0.35
    with np.errstate(divide="ignore", invalid="ignore"):
        residuals: FloatArray = (placed.points_in_dome @ normals.T - offsets) / gain
        residuals[~(slant <= aligned_with_plane * gain)] = np.inf
    return residuals
