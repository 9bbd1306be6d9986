"""Which stripe points belong to which laser, when all lasers shine at once.

Points on known surfaces fall apart into laser planes in space. On each surface a laser plane draws
a straight line; two lines on different surfaces span a plane, and the lines of other surfaces and
views say whether a laser shines there.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.calibration.stripe_lines import StripeLine, lines_on_patch
from aqualvs.calibration.stripes_on_planes import PlacedStripes
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Plane

TOLERANCE_PX = 3.0
"""A stripe this near to a plane may be the plane's; poses add to the noise of stripes."""
BENT_TOLERANCE_PX = 10.0
"""Likewise where the light may be bent at a window, so that no plane fits well."""
# Points this near to the stripe of a second laser have its light in their centre.
_CROSSING_PX = 9.0
# Surfaces of which the normals differ by less (sine), at one distance, are one surface.
_SAME_NORMAL, _SAME_OFFSET = 0.05, 0.02
# Stripes of what is no laser of its own, reflections between surfaces above all, are short.
_LEAST_SHARE = 0.1
_LEAST_POINTS = 40
_N_FITS = 5
# A point's stripe runs along the plane's to within this tangent, as seen in the image.
_ALIGNED = 0.35


@dataclass(frozen=True, slots=True)
class PooledStripes:
    """Stripe points of all views, on all surfaces.

    Attributes
    ----------
    placed : PlacedStripes
        N points of all views; `index` counts within each view.
    patch : int array, shape (N,)
        Which surface of which view a point lies on, counted through.
    patch_planes : tuple of Plane
        Surface of every patch, in `dome`.
    """

    placed: PlacedStripes
    patch: IntArray
    patch_planes: tuple[Plane, ...]


@dataclass(frozen=True, slots=True)
class LaserSplit:
    """Points sorted by laser.

    Attributes
    ----------
    planes : tuple of Plane
        Rough planes, those with the most points first.
    laser : int array, shape (N,)
        Index into `planes`; -1 for points of none, or near where two stripes cross.
    unmatched : tuple of StripeLine
        Long stripes that belong to none of the planes, the longest first.
    n_further : int
        Points of the best further plane, beyond as many as were asked for.
    """

    planes: tuple[Plane, ...]
    laser: IntArray
    unmatched: tuple[StripeLine, ...]
    n_further: int = 0


def split_lasers(
    pooled: PooledStripes, *, n_lasers: int | None = None, tolerance_px: float = TOLERANCE_PX
) -> LaserSplit:
    """Sort stripe points by the laser plane that they lie in.

    Parameters
    ----------
    pooled : PooledStripes
        Points of all views.
    n_lasers : int, optional
        How many lasers shine; as many as have enough points if left out.
    tolerance_px : float
        How far a stripe may be from its plane.

    Returns
    -------
    LaserSplit
        Fewer planes than `n_lasers` where only so many are seen on two surfaces.
    """
    lines = _all_lines(pooled)
    table = _LineTable.of(pooled, lines)
    free = np.ones(len(lines), np.bool_)
    planes: list[Plane] = []
    most = n_further = 0
    while True:
        found = _best_plane(pooled, lines, table, free, tolerance_px)
        if found is None:
            break
        plane, mine = found
        n_points = int(table.n_points[mine].sum())
        most = max(most, n_points)
        wanted = n_lasers is not None and len(planes) < n_lasers
        if n_points < _LEAST_POINTS or (not wanted and n_points < _LEAST_SHARE * most):
            break
        if n_lasers is not None and not wanted:
            n_further = n_points
            break
        planes.append(plane)
        free[mine] = False
    planes = _refined(pooled, planes, tolerance_px)
    laser = assigned(pooled, planes, tolerance_px)
    return LaserSplit(tuple(planes), laser, _unmatched(lines, laser), n_further)


def plane_residuals_px(placed: PlacedStripes, planes: Sequence[Plane]) -> FloatArray:
    """Return how far points are from the stripes of planes, across their own stripe, (N, L) px.

    Infinite where a point's stripe runs along none of the directions that the plane's could.
    """
    normals = np.array([p.normal for p in planes]).reshape(-1, 3)
    offsets = np.array([p.offset for p in planes])
    gain = np.abs(placed.by_across @ normals.T)
    slant = np.abs(placed.by_along @ normals.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        residuals: FloatArray = (placed.points_in_dome @ normals.T - offsets) / gain
        residuals[~(slant <= _ALIGNED * gain)] = np.inf
    return residuals


def _all_lines(pooled: PooledStripes) -> list[StripeLine]:
    lines = []
    for patch, plane in enumerate(pooled.patch_planes):
        members = np.flatnonzero(pooled.patch == patch)
        lines += lines_on_patch(pooled.placed, plane.normal, members, patch)
    return lines


@dataclass(frozen=True, slots=True)
class _LineTable:
    """Ends and middles of lines: what planes are guessed from and tried on."""

    patch: IntArray
    n_points: FloatArray
    points: FloatArray
    by_across: FloatArray

    @classmethod
    def of(cls, pooled: PooledStripes, lines: Sequence[StripeLine]) -> "_LineTable":
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
        return cls(
            np.array([line.patch for line in lines], np.int64),
            np.array([float(len(line.members)) for line in lines]),
            points,
            by_across,
        )

    def worst_px(self, normals: FloatArray, offsets: FloatArray) -> FloatArray:
        """Return how far each line (L) is from planes (H) at its worst end, shape (H, L)."""
        distance = np.abs(np.einsum("hi,lki->hlk", normals, self.points) - offsets[:, None, None])
        gain = np.abs(np.einsum("hi,lki->hlk", normals, self.by_across))
        with np.errstate(divide="ignore", invalid="ignore"):
            worst: FloatArray = np.max(distance / gain, axis=2)
        return np.nan_to_num(worst, nan=np.inf)


def _best_plane(
    pooled: PooledStripes,
    lines: Sequence[StripeLine],
    table: _LineTable,
    free: BoolArray,
    tolerance_px: float,
) -> tuple[Plane, IntArray] | None:
    """Return the plane with the most points among free lines, and its lines."""
    pairs = _pairs(pooled, table, free)
    if not len(pairs):
        return None
    normals, offsets = _planes_of_pairs(table, pairs)
    worst = table.worst_px(normals, offsets)
    believed = np.max(np.take_along_axis(worst, pairs, axis=1), axis=1) <= tolerance_px
    support = np.where(free, np.clip(1.0 - (worst / tolerance_px) ** 2, 0.0, 1.0), 0.0)
    scores = np.where(believed, support @ table.n_points, 0.0)
    best = int(np.argmax(scores))
    if scores[best] <= 0.0:
        return None
    plane, mine = Plane(normals[best], float(offsets[best])), np.zeros(0, np.int64)
    for _ in range(_N_FITS):
        worst_now = table.worst_px(plane.normal[None], np.array([plane.offset]))[0]
        mine = np.flatnonzero(free & (worst_now <= tolerance_px))
        if not _on_two_surfaces(pooled, table.patch[mine]):
            return None
        members = np.concatenate([lines[int(i)].members for i in mine])
        plane = fitted_plane(pooled.placed, members, plane)
    return plane, mine


def _pairs(pooled: PooledStripes, table: _LineTable, free: BoolArray) -> IntArray:
    """Return pairs of free lines (H, 2) that lie on different surfaces."""
    different = ~_same_surfaces(pooled.patch_planes)
    i, j = np.triu_indices(len(free), 1)
    keep = free[i] & free[j] & different[table.patch[i], table.patch[j]]
    return np.stack([i[keep], j[keep]], axis=-1)


def _same_surfaces(planes: Sequence[Plane]) -> BoolArray:
    """Return which patches (P, P) lie in one plane of `dome`, nearly."""
    normals = np.array([p.normal for p in planes]).reshape(-1, 3)
    offsets = np.array([p.offset for p in planes])
    sine = np.linalg.norm(np.cross(normals[:, None], normals[None]), axis=2)
    apart = np.abs(np.abs(offsets[:, None]) - np.abs(offsets[None]))
    same: BoolArray = (sine < _SAME_NORMAL) & (apart < _SAME_OFFSET)
    return same


def _on_two_surfaces(pooled: PooledStripes, patches: IntArray) -> bool:
    some = np.unique(patches)
    if len(some) < 2:
        return False
    return not bool(np.all(_same_surfaces([pooled.patch_planes[i] for i in some])))


def _planes_of_pairs(table: _LineTable, pairs: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return planes (H, 3), (H,) through two lines each, by their ends."""
    ends = table.points[pairs][:, :, [0, 2]].reshape(len(pairs), 4, 3)
    middle = ends.mean(axis=1)
    normals = np.linalg.svd(ends - middle[:, None], full_matrices=False)[2][:, 2]
    offsets: FloatArray = np.einsum("hi,hi->h", normals, middle)
    return normals, offsets


def fitted_plane(placed: PlacedStripes, members: IntArray, start: Plane) -> Plane:
    """Fit a plane to some of the points, each weighed as the image measures it."""
    points = placed.points_in_dome[members]
    gain = np.abs(placed.by_across[members] @ start.normal)
    weight = 1.0 / np.maximum(gain, 1e-9) ** 2
    middle = weight @ points / weight.sum()
    offsets = points - middle
    normal = np.linalg.eigh((weight[:, None] * offsets).T @ offsets)[1][:, 0]
    normal = normal if normal @ start.normal > 0.0 else -normal
    return Plane(normal, float(normal @ middle))


def _refined(pooled: PooledStripes, planes: list[Plane], tolerance_px: float) -> list[Plane]:
    """Fit planes to all points near them and near no other."""
    for _ in range(_N_FITS):
        laser = assigned(pooled, planes, tolerance_px)
        planes = [
            fitted_plane(pooled.placed, np.flatnonzero(laser == i), plane)
            if np.count_nonzero(laser == i) >= _LEAST_POINTS
            else plane
            for i, plane in enumerate(planes)
        ]
    return planes


def assigned(
    pooled: PooledStripes, planes: Sequence[Plane], tolerance_px: float = TOLERANCE_PX
) -> IntArray:
    """Return which plane each point (N,) belongs to; -1 for none, or where stripes cross."""
    n = len(pooled.patch)
    if not planes:
        return np.full(n, -1)
    residuals = np.abs(plane_residuals_px(pooled.placed, planes))
    nearest = np.argmin(residuals, axis=1)
    clear = residuals[np.arange(n), nearest] <= tolerance_px
    clear &= np.count_nonzero(_crossed_px(pooled.placed, planes) <= _CROSSING_PX, axis=1) <= 1
    laser: IntArray = np.where(clear, nearest, -1)
    return laser


def _crossed_px(placed: PlacedStripes, planes: Sequence[Plane]) -> FloatArray:
    """Return how far points are from where planes cut their surface, in pixels, (N, L)."""
    normals = np.array([p.normal for p in planes])
    offsets = np.array([p.offset for p in planes])
    gain = np.hypot(placed.by_across @ normals.T, placed.by_along @ normals.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance: FloatArray = np.abs(placed.points_in_dome @ normals.T - offsets) / gain
    return np.nan_to_num(distance, nan=np.inf)


def _unmatched(lines: Sequence[StripeLine], laser: IntArray) -> tuple[StripeLine, ...]:
    """Return lines of which hardly a point was given to a laser."""
    free = [
        line
        for line in lines
        if len(line.members) >= _LEAST_POINTS and np.mean(laser[line.members] >= 0) < 0.2
    ]
    return tuple(sorted(free, key=lambda line: -len(line.members)))
