"""Surfaces of a frame: planes that several lasers agree on.

A peak may lie in the bands of several lasers, and has a candidate for each: wrong candidates
scatter in space, right ones share a plane. Planes are found one after another; peaks that one
explains are not available to the next, whichever laser they were assigned to.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import (
    ZERO,
    inline_borrowing_kernel,
    inner_borrowing_kernel,
    inner_kernel,
    lazy_borrowing_kernel,
    lazy_kernel,
)
from aqualvs.geometry.linear_algebra import flatnonzero, n_bins, sum_of
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Rig
from aqualvs.scanning.candidates import (
    Cells,
    LinkedCandidates,
    Subsegments,
    mark_cells,
    number_cells,
)
from aqualvs.scanning.laser_bands import search_range
from aqualvs.scanning.net_surfaces import (
    MIN_LINES_PER_LASER,
    describe_pattern,
    is_continuation,
    merged_plane,
    seen_through,
)
from aqualvs.scanning.plane_search import (
    JX,
    JY,
    JZ,
    MAX_TO_SECOND,
    N_ROWS,
    WEIGHT,
    X,
    Y,
    Z,
    search_plane,
    squared_gate,
)

MAX_SURFACES = 5
"""Largest number of surfaces in a frame."""
_MIN_LINES = 30  # Least number of search lines of a surface.
WORTH_SHARE = 0.08
"""Least search lines and sampling weight of a surface, as a share of the best one's; less is what
other surfaces have left over."""
# Least intensity weight of a surface that stands out, as a share of that of all candidates. In a
# photograph with 15 lasers and five candidates a peak, the wall has 0.18; this limit adds no
# posture to 775 rendered nets without lasers.
_CLEAR_SHARE = 0.1
# The same where the sampling weights show no plane at all: 0.1 would give a posture to one of 96
# rendered frames of caustics with the lasers off, this to none. A wall has 0.9 in such caustics.
_MAIN_SHARE = 0.3
LINES, INLIER_WEIGHT, SAMPLING_WEIGHT = range(3)
"""Sums over a surface: search lines on it, intensity weight, and sampling weight."""


class SurfaceSearch(NamedTuple):
    """The light of a frame, and limits of the planes that are searched in it."""

    subsegments: Subsegments  # C of them.
    pixels: FloatArray  # Shape (N, 2): each candidate's place in the image.
    n_lasers: int  # Lasers of the rig.
    nearest: float  # Limits of the planes' offsets, in metres.
    farthest: float


@lazy_kernel
def search_surfaces(
    search: SurfaceSearch, planes: FloatArray, members: BoolArray, sums: FloatArray
) -> int:
    """Find planes that two lasers agree on, best supported first; return their number.

    Parameters
    ----------
    search : SurfaceSearch
    planes : array, shape (5, 4)
        Written: normals and offsets.
    members : bool array, shape (5, C)
        Written: subsegments on each; False at first.
    sums : array, shape (5, 3)
        Written: search lines, intensity weight and sampling weight of each; those weights of the
        best laser count up to three times those of the second.
    """
    n_subsegments = search.subsegments.laser.shape[0]
    free = np.empty(n_subsegments, np.bool_)
    for c in range(n_subsegments):
        free[c] = True
    found = _search_all(search, free, planes, members, sums)
    if found == 0 or found == MAX_SURFACES:
        return found
    plane, mine = planes[found], members[found]
    # The search that ended may have left marks.
    mine[:] = False
    # More subsegments than this are specks.
    most = ZERO + 500
    return found + _find_before(search, free, planes[0], most, plane, mine, sums[found])


@lazy_kernel
def _search_before(
    search: SurfaceSearch,
    others: BoolArray,
    behind: FloatArray,
    plane: FloatArray,
    members: BoolArray,
    sums: FloatArray,
) -> bool:
    """Find a plane with most of the light in front of another one that no surface explains.

    `others` (C,) are the subsegments on any surface, `behind` (4,) is the other plane. Writes one
    row each of what `search_surfaces` writes; `members` is False at first.
    """
    free = np.full(others.shape[0], True)
    _claim_peaks(search.subsegments.of_candidate, number_cells(search.pixels), others, free)
    return bool(_find_before(search, free, behind, free.shape[0], plane, members, sums))


@inner_kernel
def _find_before(
    search: SurfaceSearch,
    free: BoolArray,
    behind: FloatArray,
    most: int,
    plane: FloatArray,
    members: BoolArray,
    sums: FloatArray,
) -> bool:
    """Find a plane with most of the free light in front of another one, `behind` (4,).

    A coarse net is lit in few places: a small share of the light on the wall behind it. It is
    looked for among at most `most` subsegments.
    """
    subsegments = search.subsegments
    before, weight = _mark_before(subsegments, behind, free), subsegments.table[WEIGHT]
    rows = flatnonzero(before)
    fewest = 6
    if not fewest <= rows.shape[0] <= most:
        return False
    if not _find_plane(search, weight, rows, ZERO + 1, plane):
        return False
    by_laser = np.zeros((3, search.n_lasers))
    _collect_inliers(subsegments, rows, plane, members, by_laser)
    if not _sum_lasers(by_laser, sums):
        return False
    cells = number_cells(search.pixels)
    _claim_peaks(subsegments.of_candidate, cells, members, before)
    left = _light_once(subsegments.of_candidate, cells, before, weight)
    return bool(sums[SAMPLING_WEIGHT] > left)


@inner_kernel
def _light_once(
    subsegment_index: IntArray, cells: Cells, some: BoolArray, weight: FloatArray
) -> float:
    """Return the weight of some subsegments, light that several of them share counted once."""
    is_lit, cell = np.zeros(cells.n, np.bool_), cells.of_candidate
    n, n_lit = np.zeros(some.shape[0], np.int64), np.zeros(some.shape[0], np.int64)
    for i in range(subsegment_index.shape[0]):
        c = subsegment_index[i]
        if some[c]:
            n[c] += 1
            n_lit[c] += not is_lit[cell[i]]
            is_lit[cell[i]] = True
    light = 0.0
    for c in range(some.shape[0]):
        light += weight[c] * n_lit[c] / max(n[c], 1)
    return light


@inner_kernel
def _mark_before(subsegments: Subsegments, plane: FloatArray, free: BoolArray) -> BoolArray:
    """Mark the free subsegments (C,) in front of a plane (4,)."""
    table, before = subsegments.table, np.zeros(free.shape[0], np.bool_)
    # Least distance in front of the plane, as a share of that of the plane.
    before_share = 0.03
    for c in range(free.shape[0]):
        along = plane[0] * table[X, c] + plane[1] * table[Y, c] + plane[2] * table[Z, c]
        before[c] = free[c] and along < (1.0 - before_share) * plane[3]
    return before


@inner_kernel
def _search_all(
    search: SurfaceSearch, free: BoolArray, planes: FloatArray, members: BoolArray, sums: FloatArray
) -> int:
    """Find the planes that have much of the light; return their number.

    `free` (C,) are the subsegments that no plane explains, all at first; other arguments as of
    `search_surfaces`.
    """
    subsegments = search.subsegments
    enough = float(_MIN_LINES)
    min_subsegments = 6
    # Least intensity weight, as a share of that of all candidates; planes through noise have up to
    # 0.01.
    min_share = 0.03
    weight, found, again = subsegments.table[WEIGHT], ZERO, False
    while found < MAX_SURFACES:
        rows, left = flatnonzero(free), 0
        for k in range(rows.shape[0]):
            left += subsegments.n_lines[rows[k]]
        if left < enough or rows.shape[0] < min_subsegments:
            return found
        plane, mine = planes[found], members[found]
        by_laser, n = np.zeros((3, search.n_lasers)), 0
        if _find_plane(search, weight, rows, found, plane):
            n = _collect_inliers(subsegments, rows, plane, mine, by_laser)
        is_plane = _sum_lasers(by_laser, sums[found]) and n >= min_subsegments
        light = sum_of(by_laser[INLIER_WEIGHT])
        if not is_plane or light < min_share * sum_of(subsegments.intensity_weight):
            if found > 0 or again:
                return found
            # The sampling weights of long stripes are limited, too much between many specks: of
            # caustics, of a camera that sharpens, or of another laser on thin twine. Search again
            # by intensity weight, but only for a surface that stands out.
            again, weight = True, subsegments.intensity_weight
            min_share = _CLEAR_SHARE if is_plane else _MAIN_SHARE
            mine[:] = False
            continue
        enough = max(enough, WORTH_SHARE * sums[found, LINES])
        if found == 0:
            cells = number_cells(search.pixels)
        _claim_peaks(subsegments.of_candidate, cells, mine, free)
        found += 1
    return MAX_SURFACES


@inner_kernel
def _find_plane(
    search: SurfaceSearch, weight: FloatArray, rows: IntArray, seed: int, plane: FloatArray
) -> bool:
    """Search a plane among the subsegments of some rows, with these weights (C,)."""
    subsegments, n_lasers = search.subsegments, search.n_lasers
    table, laser = subsegments.table, subsegments.laser
    n = rows.shape[0]
    some, intensity_weight = np.empty((N_ROWS, n)), np.empty(n)
    its_laser = np.empty(n, np.int64)
    start = np.zeros(n_lasers + 1, np.int64)
    for k in range(n):
        c = rows[k]
        for j in range(WEIGHT):
            some[j, k] = table[j, c]
        some[WEIGHT, k], intensity_weight[k] = weight[c], subsegments.intensity_weight[c]
        its_laser[k] = laser[c]
        start[laser[c] + 1] += 1
    for i in range(n_lasers):
        start[i + 1] += start[i]
    limits = search.nearest, search.farthest
    return search_plane(some, intensity_weight, its_laser, start, *limits, seed, plane)


@inner_borrowing_kernel
def _collect_inliers(
    subsegments: Subsegments,
    rows: IntArray,
    plane: FloatArray,
    members: BoolArray,
    by_laser: FloatArray,
) -> int:
    """Mark the subsegments of some rows on the plane, and return their number.

    `by_laser`, shape (3, n_lasers), gets their sums for each laser, rows as `LINES` and the others.
    """
    table, n = subsegments.table, 0
    nx, ny, nz, offset = plane[0], plane[1], plane[2], plane[3]
    for k in range(rows.shape[0]):
        c = rows[k]
        residual = nx * table[X, c] + ny * table[Y, c] + nz * table[Z, c] - offset
        per_px = nx * table[JX, c] + ny * table[JY, c] + nz * table[JZ, c]
        if residual * residual < squared_gate(per_px, offset):
            members[c] = True
            _add_subsegment(subsegments, c, by_laser)
            n += 1
    return n


@inline_borrowing_kernel
def _add_subsegment(subsegments: Subsegments, c: int, by_laser: FloatArray) -> None:
    """Add subsegment c to the sums of its laser."""
    i = subsegments.laser[c]
    by_laser[LINES, i] += subsegments.n_lines[c]
    by_laser[INLIER_WEIGHT, i] += subsegments.intensity_weight[c]
    by_laser[SAMPLING_WEIGHT, i] += subsegments.table[WEIGHT, c]


@inner_borrowing_kernel
def _sum_lasers(by_laser: FloatArray, sums: FloatArray) -> bool:
    """Write the sums over all lasers (3,); return whether they are a surface's."""
    sums[LINES] = sum_of(by_laser[LINES])
    sums[INLIER_WEIGHT] = limited_sum(by_laser[INLIER_WEIGHT])
    sums[SAMPLING_WEIGHT] = limited_sum(by_laser[SAMPLING_WEIGHT])
    supporting = 0
    for i in range(by_laser.shape[1]):
        supporting += by_laser[LINES, i] >= MIN_LINES_PER_LASER
    return supporting >= 2 and sums[LINES] >= _MIN_LINES


@lazy_kernel
def _collect_surface(
    subsegments: Subsegments, n_lasers: int, plane: FloatArray, members: BoolArray, sums: FloatArray
) -> None:
    """Mark the subsegments on a plane (4,), and write the sums of its surface (3,)."""
    by_laser = np.zeros((3, n_lasers))
    rows = np.arange(subsegments.laser.shape[0])
    _collect_inliers(subsegments, rows, plane, members, by_laser)
    _sum_lasers(by_laser, sums)


@lazy_kernel
def _collect_left_over(
    search: SurfaceSearch, others: BoolArray, members: BoolArray, sums: FloatArray
) -> bool:
    """Remove another surface's light from a surface; return whether enough is left of it.

    Writes False to `members` (C,) where their light is that of the other surface's subsegments,
    `others` (C,); and the sums of the rest (3,).
    """
    subsegments = search.subsegments
    _claim_peaks(subsegments.of_candidate, number_cells(search.pixels), others, members)
    by_laser = np.zeros((3, search.n_lasers))
    for c in range(members.shape[0]):
        if members[c]:
            _add_subsegment(subsegments, c, by_laser)
    return _sum_lasers(by_laser, sums)


@lazy_borrowing_kernel
def limited_sum(weight: FloatArray) -> float:
    """Return the sum over lasers (n_lasers,), the largest limited to three times the second.

    A plane needs two lasers: the surplus of one is no evidence for it.
    """
    total, first, second = 0.0, 0.0, 0.0
    for i in range(weight.shape[0]):
        total += weight[i]
        second = max(second, min(first, weight[i]))
        first = max(first, weight[i])
    return min(total, total - first + MAX_TO_SECOND * second)


@inner_kernel
def _claim_peaks(
    subsegment_index: IntArray, cells: Cells, members: BoolArray, free: BoolArray
) -> None:
    """Remove the members, and subsegments mostly of the same light, from the free ones (C,)."""
    lit, cell = np.zeros(cells.n, np.uint8), cells.of_candidate
    for i in range(subsegment_index.shape[0]):
        if members[subsegment_index[i]]:
            mark_cells(cell[i], cells.n_columns, lit)
    claimed = np.zeros(free.shape[0], np.int64)
    for i in range(subsegment_index.shape[0]):
        claimed[subsegment_index[i]] += 1 if lit[cell[i]] else -1
    for c in range(free.shape[0]):
        if members[c] or claimed[c] > 0:
            free[c] = False


# A surface with a larger share of its search lines on another surface is a part of that one.
_MAX_SHARED = 0.5


@dataclass(frozen=True, slots=True)
class Surface:
    """A plane that subsegments of at least two lasers agree on."""

    plane: Plane  # In `dome`, offset > 0.
    members: BoolArray  # Shape (C,): subsegments on it.
    n_lines: int  # Search lines on it.
    # Intensity weight on it, that of the best laser up to three times the second's.
    inlier_weight: float
    # Sampling weight on it, limited likewise.
    sampling_weight: float
    # Search lines from end to end of its gappy stripes, summed over the lasers, without stragglers.
    extent: float
    # Pattern of its stripes (`describe_pattern`): as on a net; with gaps at least, as on a dense
    # net or in a net's shadows; and with long lit intervals, as on a table with gaps.
    is_mesh: bool
    is_gappy: bool = False
    is_unbroken: bool = False
    # Number of planes that were joined, because a folded or bent net continues from one to the
    # next. `plane` is then that of the largest, or their mean if none has half of the weight.
    n_planes: int = 1


class SurfaceFinder:
    """Finder of surfaces in the frames of one rig.

    Parameters
    ----------
    rig : Rig
        Lasers, working range, and focal length, which turns search lines into lengths.
    """

    def __init__(self, rig: Rig) -> None:
        self._n_lasers, self._focal_px = len(rig.lasers), rig.focal_px
        self._limits = search_range(rig.working_range)

    def find(self, linked: LinkedCandidates) -> list[Surface]:
        """Find the planes in a frame, best supported first.

        Deterministic: the same candidates give the same surfaces.
        """
        candidates, subsegments, _ = linked
        planes, sums = np.empty((MAX_SURFACES, 4)), np.empty((MAX_SURFACES, 3))
        members = np.zeros((MAX_SURFACES, subsegments.n), np.bool_)
        search = SurfaceSearch(subsegments, candidates.pixels, self._n_lasers, *self._limits)
        n = search_surfaces(search, planes, members, sums)
        surfaces = [self._describe(subsegments, planes[i], members[i], sums[i]) for i in range(n)]
        if n < 2:
            return surfaces
        classified = [
            replace(one, is_mesh=True) if _is_dense_net(one, surfaces, subsegments) else one
            for one in surfaces
        ]
        return _merge_coplanar(classified, subsegments)

    def find_before(
        self, linked: LinkedCandidates, surfaces: Sequence[Surface], target: Surface
    ) -> Surface | None:
        """Find a surface in front of another one that has most of the light left there.

        A peak has a candidate for each laser of a fan, so that a net before a wall has a small
        share of all candidates, and is found only once the wall's peaks are set aside.

        Parameters
        ----------
        linked : LinkedCandidates
            Of the frame.
        surfaces : sequence of Surface
            All surfaces found; their light is set aside.
        target : Surface
            The surface behind.

        Returns
        -------
        Surface or None
            None unless it has a twentieth of the light of the surface behind, and stripes about as
            narrow.
        """
        # Specks before a wall make planes by chance, with little light. Peaks that are this many
        # times as wide as its stripes are its texture.
        least_share, widest = 0.05, 2.5
        candidates, subsegments, _ = linked
        search = SurfaceSearch(subsegments, candidates.pixels, self._n_lasers, *self._limits)
        plane, members, sums = np.empty(4), np.zeros(subsegments.n, np.bool_), np.zeros(3)
        others = np.any([one.members for one in surfaces], axis=0)
        if not _search_before(search, others, target.plane.packed(), plane, members, sums):
            return None
        width = subsegments.width
        if np.mean(width[members]) > widest * np.mean(width[target.members]):
            return None
        if sums[INLIER_WEIGHT] < least_share * target.inlier_weight:
            return None
        return self._describe(subsegments, plane, members, sums)

    def on_plane(self, subsegments: Subsegments, plane: Plane) -> Surface:
        """Return the surface of all subsegments on a plane, whatever other surfaces explain."""
        packed, members, sums = plane.packed(), np.zeros(subsegments.n, np.bool_), np.empty(3)
        _collect_surface(subsegments, self._n_lasers, packed, members, sums)
        return self._describe(subsegments, packed, members, sums)

    def left_over(self, linked: LinkedCandidates, one: Surface, other: Surface) -> Surface | None:
        """Return a surface without another one's light; None if that leaves too little of it."""
        candidates, subsegments, _ = linked
        members, sums = one.members.copy(), np.empty(3)
        search = SurfaceSearch(subsegments, candidates.pixels, self._n_lasers, *self._limits)
        if not _collect_left_over(search, other.members, members, sums):
            return None
        return self._describe(subsegments, one.plane.packed(), members, sums)

    def _describe(
        self, subsegments: Subsegments, plane: FloatArray, members: BoolArray, sums: FloatArray
    ) -> Surface:
        """Make a surface from a plane (4,), its subsegments and their sums."""
        lines, inlier_weight, sampling_weight = sums.tolist()
        light, on_strands = np.zeros((2, self._n_lasers))
        is_mesh, is_gappy, is_unbroken, n_strands, extent = describe_pattern(
            subsegments, members, self._focal_px, on_strands
        )
        np.add.at(light, subsegments.laser[members], subsegments.intensity_weight[members])
        # Least share of a net's light on strands; a fish has more in long or bent components. Where
        # each laser lights many strands, long components lie along others, and so do whole stripes.
        least, many, share_of_many = 0.4, 6, 0.2
        brightest, along = light.argmax(), on_strands <= 0.1 * light
        if is_mesh and n_strands >= many * self._n_lasers:
            light[along], least = 0.0, share_of_many
        elif is_mesh and on_strands[brightest] == 0.0:
            light[brightest] = 0.0
        # Near the vehicle, strands are long in search lines, and limited in sampling weight.
        weight = max(sampling_weight, limited_sum(on_strands))
        may_be_net = weight > least * limited_sum(light)
        return Surface(
            plane=Plane(plane[:3], float(plane[3])),
            members=members,
            n_lines=int(lines),
            inlier_weight=inlier_weight,
            sampling_weight=sampling_weight,
            extent=extent,
            is_mesh=is_mesh and may_be_net,
            is_gappy=is_gappy and may_be_net,
            is_unbroken=is_unbroken,
        )


def shares_peaks(one: Surface, other: Surface, subsegments: Subsegments) -> bool:
    """Return whether most search lines of a surface are on another one as well."""
    shared = subsegments.n_lines[one.members & other.members].sum()
    return bool(shared > _MAX_SHARED * subsegments.n_lines[one.members].sum())


def not_on_others(
    source: IntArray, subsegments: Subsegments, surfaces: Sequence[Surface], target: Surface
) -> BoolArray | None:
    """Mark the candidates of a net's peaks, and of those that are on no other surface.

    Parameters
    ----------
    source : int array, shape (N,)
        Number of each candidate's peak.
    subsegments : Subsegments
        Of all candidates.
    surfaces : sequence of Surface
        All surfaces of the frame.
    target : Surface
        The net.

    Returns
    -------
    bool array, shape (N,), or None
        None if no other surface is apart from the net; one that is not may be a fold of it.
    """
    others = [one.members for one in surfaces if _is_apart(one, target, subsegments)]
    if not others:
        return None
    peaks, rows = np.zeros(n_bins(source), np.bool_), subsegments.of_candidate
    peaks[source[np.any(others, axis=0)[rows]]] = True
    peaks[source[target.members[rows]]] = False
    return np.logical_not(peaks[source])


def _is_apart(one: Surface, net: Surface, subsegments: Subsegments) -> bool:
    """Return whether most of a surface's light is farther from a net's plane than folds reach."""
    deepest = 0.15  # As a share of the range.
    table, plane = subsegments.table[:, one.members], net.plane
    off = np.abs(plane.normal @ table[X : Z + 1] - plane.offset)
    far = off > deepest * plane.offset
    return bool(table[WEIGHT, far].sum() > 0.5 * table[WEIGHT].sum())


def _merge_coplanar(surfaces: list[Surface], subsegments: Subsegments) -> list[Surface]:
    """Join the planes that are parts of one net."""
    rest, done = list(surfaces), []
    while rest:
        net = rest.pop(0)
        parts = [net]
        while net.is_mesh:
            more = [
                one
                for one in rest
                if one.is_mesh
                and any(
                    is_continuation(p.plane, p.members, one.members, subsegments) for p in parts
                )
            ]
            if not more:
                break
            parts += more
            rest = [one for one in rest if all(one is not part for part in more)]
        done.append(_merge(parts, subsegments) if len(parts) > 1 else net)
    return done


def _merge(parts: list[Surface], subsegments: Subsegments) -> Surface:
    """Return the net that consists of several planes."""
    members = [part.members for part in parts]
    return Surface(
        plane=merged_plane([part.plane for part in parts], members, subsegments),
        members=np.logical_or.reduce(members),
        n_lines=sum(part.n_lines for part in parts),
        inlier_weight=sum(part.inlier_weight for part in parts),
        sampling_weight=sum(part.sampling_weight for part in parts),
        extent=max(part.extent for part in parts),
        is_mesh=True,
        is_gappy=True,
        n_planes=len(parts),
    )


def _is_dense_net(surface: Surface, surfaces: list[Surface], subsegments: Subsegments) -> bool:
    """Return whether a surface, broken by this one's shadows, is seen through its gaps.

    A near net may fill most of the stripes; it then has more light than the surface behind it.
    """
    # Least extent of the surface behind, as a share of the net's: shadows are where the net is.
    extent_share = 0.6
    return not surface.is_mesh and any(
        other.is_gappy
        and (surface.is_gappy or surface.inlier_weight > other.inlier_weight)
        and other.plane.offset > surface.plane.offset
        and other.extent >= extent_share * surface.extent
        and seen_through(surface.members, other.members, subsegments)
        for other in surfaces
    )
