"""Surfaces: planes that stripes of several lasers agree on, and which of them is the target.

One pixel may belong to the bands of several lasers. Every reading of it is triangulated; wrong
readings scatter in space, right ones share a plane. A deterministic RANSAC with sampling from
neighbours (after NAPSAC, Myatt et al. 2002, doi:10.5244/C.16.44) over chunks of stripe finds the
planes one after another. A net shows up as short lit stretches between long dark ones.
"""

from dataclasses import dataclass, fields
from enum import StrEnum

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import inline_kernel, kernel
from aqualvs.geometry.planes import Plane

_MAX_SURFACES = 5
_MAX_HYPOTHESES = 1500
# A neighbour for sampling lies at most this many chunks away in the same laser's list.
_NEIGHBOURHOOD = 8
# Normals farther than this from the vehicle's forward axis are not a target in front of it.
_MIN_FACING = float(np.cos(np.deg2rad(55.0)))
# Distance of a chunk from a plane: this share of the range, and this shift of the stripe.
_GATE_RANGE_SHARE = 0.003
_GATE_PX = 1.0
# Gate of a hypothesis before it is refined, and how near the best one it must come for that.
_WIDE_GATE = 3.0
_WORTH_REFINING = 0.8
_MIN_LINES_PER_LASER = 8
_MIN_CHUNKS = 6
_MIN_LINES = 30
# A typical lit stretch over itself and a typical gap: below, it is a mesh. Strands of a net leave
# longer gaps than they light; a wall behind a net is lit between short shadows.
_MESH_DUTY = 0.6
# Lit stretches with fewer dark search lines between them are one.
_MIN_GAP_LINES = 3
_MIN_STRETCHES = 3
# The light on one strand is typically shorter than this, in metres.
_LONGEST_STRETCH = 0.03
# Light within cells of this size is the same, by whichever laser or search it was read.
_SAME_LIGHT_CELL_PX = 6
# A net beside a solid surface shows at least this share of its search lines.
_MESH_SHARE = 0.08
# Among meshes, one reaches far with this share of the widest one's extent.
_EXTENT_SHARE = 0.75
# Share of the lines at each end of a stripe that may be stragglers.
_STRAGGLERS = 0.1


class TargetKind(StrEnum):
    """What the posture is measured to."""

    AUTO = "auto"
    """A net where there is one, else the largest solid surface."""
    NET = "net"
    """Only a mesh-like surface."""
    SOLID = "solid"
    """Only a surface with unbroken stripes."""


@dataclass(frozen=True, slots=True)
class Chunks:
    """Pieces of stripe, C of them: a chunk is the unit that agrees with a surface or does not.

    Attributes
    ----------
    centroid : array, shape (C, 3)
        Weighted mean of its points in `dome`, in metres.
    sensitivity : array, shape (C, 3)
        Mean derivative of its points by the stripe's position, in m/px.
    n_lines : int array, shape (C,)
        Search lines in it.
    weight : array, shape (C,)
        Its voice when surfaces are sought: its search lines, but a long stretch has no more voice
        than a few strands, because all of it may follow one strand off the sheet's middle.
    first_line, last_line : int array, shape (C,)
        Its extent in search lines; tells lit from dark stretches.
    laser : int array, shape (C,)
        Index of the laser; ascending.
    """

    centroid: FloatArray
    sensitivity: FloatArray
    n_lines: IntArray
    weight: FloatArray
    first_line: IntArray
    last_line: IntArray
    laser: IntArray

    def __len__(self) -> int:
        """Return the number of chunks."""
        return len(self.laser)

    def where(self, mask: BoolArray) -> "Chunks":
        """Return the chunks that a mask of shape (C,) selects."""
        return Chunks(*(getattr(self, item.name)[mask] for item in fields(self)))


@dataclass(frozen=True, slots=True)
class Surface:
    """A plane that chunks of at least two lasers agree on.

    Attributes
    ----------
    plane : Plane
        In `dome`, offset > 0.
    members : bool array, shape (C,)
        Chunks on it.
    n_lines : int
        Search lines on it.
    support : int
        The same, but without what one laser has beyond three times the second: a plane rests on
        two lasers.
    extent : float
        Search lines over which its broken stripes reach, summed over the lasers, stragglers left
        out.
    is_mesh : bool
        Whether its stripes are broken as those on a net are.
    """

    plane: Plane
    members: BoolArray
    n_lines: int
    support: int
    extent: float
    is_mesh: bool


def find_surfaces(
    chunks: Chunks,
    chunk_index: IntArray,
    pixels: FloatArray,
    n_lasers: int,
    working_range: tuple[float, float],
    focal_px: float,
) -> list[Surface]:
    """Find the planes in a frame, best supported first.

    Parameters
    ----------
    chunks : Chunks
        All readings of all returns.
    chunk_index : int array, shape (N,)
        Row of each reading's chunk.
    pixels : array, shape (N, 2)
        Each reading's place in the image: what one surface explains is free for no other.
    n_lasers : int
        Lasers of the rig.
    working_range : (float, float)
        Planes nearer or farther are not believed, in metres.
    focal_px : float
        Pixels per radian, roughly: turns search lines into lengths on the surface.

    Returns
    -------
    list of Surface
        Deterministic: the same chunks give the same surfaces.
    """
    surfaces: list[Surface] = []
    free = np.ones(len(chunks), np.bool_)
    normal_and_offset = np.empty(4)
    for attempt in range(_MAX_SURFACES):
        if np.count_nonzero(free) < _MIN_CHUNKS:
            break
        members = np.zeros(len(free), np.bool_)
        found = _search_plane(
            chunks.centroid,
            chunks.sensitivity,
            chunks.weight,
            chunks.n_lines,
            chunks.laser,
            np.flatnonzero(free),
            n_lasers,
            working_range[0],
            working_range[1],
            attempt,
            normal_and_offset,
            members,
        )
        if not found:
            break
        plane = Plane(normal_and_offset[:3].copy(), float(normal_and_offset[3]))
        surfaces.append(_describe(plane, members, chunks.where(members), n_lasers, focal_px))
        _claim_light(pixels, chunk_index, members, free)
    return surfaces


def choose_target(surfaces: list[Surface], kind: TargetKind) -> Surface | None:
    """Pick the surface that the posture is measured to, or None where the kind is absent.

    A net is wanted before anything solid: what stands in front of it (a fish, a box) or behind it
    (a tank wall) may have more stripe points, but is not what the vehicle follows. Of several
    meshes the nearest well supported one is the net; a wall behind it is lit through its openings
    and may look broken as well. A handful of left-over points that look like a mesh is no net.
    """
    most = max((surface.support for surface in surfaces), default=0)
    meshes = [one for one in surfaces if one.is_mesh and one.support >= _MESH_SHARE * most]
    solids = [one for one in surfaces if not one.is_mesh]
    solid = max(solids, key=lambda surface: surface.support, default=None)
    net = _nearest_far_reaching(meshes)
    return {
        TargetKind.AUTO: net or solid,
        TargetKind.NET: net,
        TargetKind.SOLID: solid,
    }[kind]


def _nearest_far_reaching(meshes: list[Surface]) -> Surface | None:
    farthest = max((surface.extent for surface in meshes), default=0.0)
    wide = [one for one in meshes if one.extent >= _EXTENT_SHARE * farthest]
    return min(wide, key=lambda surface: surface.plane.offset, default=None)


def _describe(
    plane: Plane, members: BoolArray, chunks: Chunks, n_lasers: int, focal_px: float
) -> Surface:
    lines = np.bincount(chunks.laser, weights=chunks.n_lines, minlength=n_lasers)
    first, second = np.sort(lines)[::-1][:2]
    support = int(min(lines.sum(), lines.sum() - first + 3.0 * second))
    measured = [
        chunks.where(chunks.laser == index)
        for index in np.flatnonzero(lines >= _MIN_LINES_PER_LASER)
    ]
    broken = [mine for mine in measured if _is_broken(mine, focal_px)]
    extent = sum(_extent(mine) for mine in broken)
    is_mesh = len(broken) >= min(2, len(measured))
    return Surface(plane, members, int(lines.sum()), support, extent, is_mesh)


def _extent(chunks: Chunks) -> float:
    """Search lines between the 10 % and the 90 % point of one laser's light."""
    order = np.argsort(chunks.first_line)
    share = np.cumsum(chunks.n_lines[order])
    if not len(share):
        return 0.0
    first = order[np.searchsorted(share, _STRAGGLERS * share[-1])]
    last = order[np.searchsorted(share, (1.0 - _STRAGGLERS) * share[-1])]
    return float(chunks.last_line[last] - chunks.first_line[first] + 1)


def _is_broken(chunks: Chunks, focal_px: float) -> bool:
    """Whether one laser's stripe is lit as on a net: short stretches, longer gaps.

    Medians, so that what hides behind a fish or a box for a while does not count.
    """
    order = np.argsort(chunks.first_line)
    begin = chunks.first_line[order]
    end = np.maximum.accumulate(chunks.last_line[order]) + 1
    dark = begin[1:] - end[:-1]
    broken = dark >= _MIN_GAP_LINES
    if np.count_nonzero(broken) < _MIN_STRETCHES - 1:
        return False
    starts = begin[np.concatenate([[True], broken])]
    stops = end[np.concatenate([broken, [True]])]
    lit = float(np.median(stops - starts))
    length = lit / focal_px * float(np.median(np.linalg.norm(chunks.centroid, axis=1)))
    duty = lit / (lit + float(np.median(dark[broken])))
    return duty < _MESH_DUTY and length < _LONGEST_STRETCH


@kernel
def _claim_light(
    pixels: FloatArray, chunk_index: IntArray, members: BoolArray, free: BoolArray
) -> None:
    """Take the members, and every other reading of the same light, out of the free chunks."""
    rows = int(pixels[:, 1].max()) // _SAME_LIGHT_CELL_PX + 3
    columns = int(pixels[:, 0].max()) // _SAME_LIGHT_CELL_PX + 3
    lit = np.zeros((rows, columns), np.bool_)
    for i in range(pixels.shape[0]):
        if members[chunk_index[i]]:
            row = max(int(pixels[i, 1]) // _SAME_LIGHT_CELL_PX, 0)
            column = max(int(pixels[i, 0]) // _SAME_LIGHT_CELL_PX, 0)
            lit[row : row + 3, column : column + 3] = True
    claimed = np.zeros(free.shape[0])
    for i in range(pixels.shape[0]):
        row = max(int(pixels[i, 1]) // _SAME_LIGHT_CELL_PX, 0) + 1
        column = max(int(pixels[i, 0]) // _SAME_LIGHT_CELL_PX, 0) + 1
        claimed[chunk_index[i]] += 1.0 if lit[row, column] else -1.0
    for c in range(free.shape[0]):
        if members[c] or claimed[c] > 0.0:
            free[c] = False


@inline_kernel
def _residual_gate(
    n: FloatArray, offset: float, centroid: FloatArray, sensitivity: FloatArray
) -> tuple[float, float]:
    """Distance of a chunk from the plane, and the largest that still belongs to it."""
    residual = n[0] * centroid[0] + n[1] * centroid[1] + n[2] * centroid[2] - offset
    per_px = n[0] * sensitivity[0] + n[1] * sensitivity[1] + n[2] * sensitivity[2]
    by_range = _GATE_RANGE_SHARE * offset
    by_pixel = _GATE_PX * per_px
    return residual, np.sqrt(by_range * by_range + by_pixel * by_pixel)


@inline_kernel
def _plane_through(a: FloatArray, b: FloatArray, c: FloatArray, n: FloatArray) -> float:
    """Write the unit normal through three points, facing outward; return the offset, or -1."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = np.sqrt(x * x + y * y + z * z)
    if length < 1e-9:
        return -1.0
    if x * a[0] + y * a[1] + z * a[2] < 0.0:
        length = -length
    n[0], n[1], n[2] = x / length, y / length, z / length
    return float(n[0] * a[0] + n[1] * a[1] + n[2] * a[2])


@inline_kernel
def _next_random(state: np.uint64, bound: int) -> tuple[np.uint64, int]:
    """One step of a 64-bit linear congruential generator (Knuth's MMIX constants)."""
    state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
    return state, int((state >> np.uint64(33)) % np.uint64(bound))


@kernel
def _score(
    centroid: FloatArray,
    sensitivity: FloatArray,
    weight: FloatArray,
    laser: IntArray,
    free: IntArray,
    n: FloatArray,
    offset: float,
    stretch: float,
    per_laser: FloatArray,
) -> float:
    """MSAC score, capped so that the best laser cannot outvote the second by more than 3 to 1."""
    per_laser[:] = 0.0
    for k in range(free.shape[0]):
        c = free[k]
        residual, gate = _residual_gate(n, offset, centroid[c], sensitivity[c])
        ratio = residual / (stretch * gate)
        if ratio * ratio < 1.0:
            per_laser[laser[c]] += weight[c] * (1.0 - ratio * ratio)
    first = 0.0
    second = 0.0
    total = 0.0
    for k in range(per_laser.shape[0]):
        value = per_laser[k]
        total += value
        if value > first:
            first, second = value, first
        elif value > second:
            second = value
    return min(total, total - first + 3.0 * second)


@kernel
def _refine(
    centroid: FloatArray,
    sensitivity: FloatArray,
    weight: FloatArray,
    free: IntArray,
    n: FloatArray,
    offset: float,
    stretch: float,
) -> float:
    """One weighted least-squares step on the inliers, X·m = 1 (Eq. 24); returns the offset."""
    normal = np.zeros((3, 3))
    right = np.zeros(3)
    for k in range(free.shape[0]):
        c = free[k]
        residual, gate = _residual_gate(n, offset, centroid[c], sensitivity[c])
        if abs(residual) >= stretch * gate:
            continue
        w = weight[c] / (gate * gate)
        for i in range(3):
            right[i] += w * centroid[c, i]
            for j in range(3):
                normal[i, j] += w * centroid[c, i] * centroid[c, j]
    determinant = np.linalg.det(normal)
    if not abs(determinant) > 0.0:
        return offset
    m = np.linalg.solve(normal, right)
    length = np.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
    if not (length > 0.0 and length < np.inf):
        return offset
    for i in range(3):
        n[i] = m[i] / length
    return float(1.0 / length)


@kernel
def _search_plane(
    centroid: FloatArray,
    sensitivity: FloatArray,
    weight: FloatArray,
    n_lines: IntArray,
    laser: IntArray,
    free: IntArray,
    n_lasers: int,
    nearest: float,
    farthest: float,
    seed: int,
    plane: FloatArray,
    members: BoolArray,
) -> bool:
    n_free = free.shape[0]
    state = np.uint64(seed + 1)
    per_laser = np.zeros(n_lasers)
    n = np.zeros(3)
    best = 0.0
    best_rough = 0.0
    total = 0.0
    for k in range(n_free):
        total += weight[free[k]]
    needed = _MAX_HYPOTHESES
    trial = 0
    while trial < needed:
        trial += 1
        state, i = _next_random(state, n_free)
        state, step = _next_random(state, _NEIGHBOURHOOD)
        state, k = _next_random(state, n_free)
        j = i + 1 + step
        if j >= n_free or laser[free[i]] != laser[free[j]] or laser[free[k]] == laser[free[i]]:
            continue
        offset = _plane_through(centroid[free[i]], centroid[free[j]], centroid[free[k]], n)
        if offset < nearest or offset > farthest or n[1] < _MIN_FACING:
            continue
        # A plane through neighbours is rough: judged by a wide gate, drawn in by narrower ones.
        score = _score(centroid, sensitivity, weight, laser, free, n, offset, _WIDE_GATE, per_laser)
        if score <= _WORTH_REFINING * best_rough:
            continue
        best_rough = max(best_rough, score)
        for stretch in (_WIDE_GATE, 0.5 * (1.0 + _WIDE_GATE), 1.0):
            offset = _refine(centroid, sensitivity, weight, free, n, offset, stretch)
        score = _score(centroid, sensitivity, weight, laser, free, n, offset, 1.0, per_laser)
        if score <= best:
            continue
        best = score
        plane[:3] = n
        plane[3] = offset
        # With a share s of good chunks a trial succeeds with probability of about s^3 / 4: the
        # neighbour and the other laser must fit as well.
        share = min(best / total, 1.0)
        needed = min(_MAX_HYPOTHESES, int(60.0 / (share * share * share)) + 20)
    if best <= 0.0:
        return False
    for _ in range(3):
        plane[3] = _refine(centroid, sensitivity, weight, free, plane[:3], plane[3], 1.0)
    return _collect(centroid, sensitivity, n_lines, laser, free, n_lasers, plane, members)


@kernel
def _collect(
    centroid: FloatArray,
    sensitivity: FloatArray,
    n_lines: IntArray,
    laser: IntArray,
    free: IntArray,
    n_lasers: int,
    plane: FloatArray,
    members: BoolArray,
) -> bool:
    """Mark the members; whether they are enough, from two lasers at least."""
    per_laser = np.zeros(n_lasers, np.int64)
    n_members = 0
    total = 0
    for k in range(free.shape[0]):
        c = free[k]
        residual, gate = _residual_gate(plane[:3], plane[3], centroid[c], sensitivity[c])
        if abs(residual) < gate:
            members[c] = True
            n_members += 1
            total += n_lines[c]
            per_laser[laser[c]] += n_lines[c]
    supported = 0
    for k in range(n_lasers):
        if per_laser[k] >= _MIN_LINES_PER_LASER:
            supported += 1
    return supported >= 2 and n_members >= _MIN_CHUNKS and total >= _MIN_LINES
