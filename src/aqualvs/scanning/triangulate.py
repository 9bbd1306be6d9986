"""Triangulation: pixels on a laser's stripe to points in the water, with their uncertainty."""

from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import (
    borrowing_kernel,
    inline_borrowing_kernel,
    inner_borrowing_kernel,
    lazy_borrowing_kernel,
)
from aqualvs.optics.camera import Camera, rays_all
from aqualvs.optics.rig import Rig
from aqualvs.optics.sheet import WINDOWED, intersect_ray, packed_sheets, planes_and_bent

# Step of the one-sided difference, in pixels; the second derivative of a point by the pixel is
# about 1e-2 of the first, so the error stays below 1 % of a sensitivity.
_DIFFERENCE_PX = 0.25


class Triangulation(NamedTuple):
    """Points on laser sheets, N of them."""

    points_in_dome: FloatArray  # Shape (N, 3): metres; NaN where not valid.
    # Shape (N, 3): derivative of the point by the stripe's position along the search line, in m/px.
    # The covariance of a point is sigma_px² times its outer product: an error along the stripe
    # stays on the stripe.
    sensitivity: FloatArray
    # Shape (N,): False where the pixel sees nothing or its ray misses the sheet.
    valid: BoolArray
    all_valid: bool


class Triangulator:
    """Triangulation of pixels with a rig's laser sheets (paper, Eq. 17-21, for planes).

    Parameters
    ----------
    rig : Rig
        Lasers, with the indices of air and water for those behind windows.
    camera : Camera
        Of the rig, behind its dome or bare.
    """

    def __init__(self, rig: Rig, camera: Camera) -> None:
        self._camera = camera
        # Shape (n_lasers, 4): normals and offsets in `dome`; the middles of bent sheets.
        self.planes, self._bent = planes_and_bent(packed_sheets(rig, camera))

    def triangulate(
        self, pixels: FloatArray, along_x: IntArray, laser: IntArray, group: IntArray | None = None
    ) -> Triangulation:
        """Triangulate pixels (N, 2), each with the laser whose index is given.

        Parameters
        ----------
        pixels : array, shape (N, 2)
            In `image`.
        along_x : int array, shape (N,)
            1 where the position was measured along x, 0 where along y.
        laser : int array, shape (N,)
            Index into the rig's lasers.
        group : int array, shape (N,), optional
            Successive pixels with equal numbers share the sensitivity of the first of them; over a
            few pixels of one stripe it hardly changes.
        """
        n = len(pixels)
        if group is None:
            group = np.arange(n)
        rays_px, owner = np.empty((2 * n, 2)), np.empty(n, np.int64)
        n_rays = _place_rays(pixels, along_x, group, rays_px, owner)
        origins, directions = np.empty((2, n_rays, 3))
        seen = np.empty(n_rays, np.bool_)
        rays_all(self._camera.params, rays_px[:n_rays], origins, directions, seen)
        points, sensitivity, valid = np.empty((n, 3)), np.empty((n, 3)), np.empty(n, np.bool_)
        all_valid = _intersect(
            self.planes,
            self._bent,
            laser,
            owner,
            origins,
            directions,
            seen,
            points,
            sensitivity,
            valid,
        )
        return Triangulation(points, sensitivity, valid, all_valid)


@borrowing_kernel
def _intersect(
    planes: FloatArray,
    bent: FloatArray | None,
    laser: IntArray,
    owner: IntArray,
    origins: FloatArray,
    directions: FloatArray,
    seen: BoolArray,
    points: FloatArray,
    sensitivity: FloatArray,
    valid: BoolArray,
) -> bool:
    """Intersect the rays with n·X = d (Eq. 20) or bent sheets; return whether all points are valid.

    The moved ray of each group gives the sensitivity of its points.
    """
    sx, sy, sz = np.nan, np.nan, np.nan
    for i in range(points.shape[0]):
        plane = laser[i]
        reach = _distance_to_sheet(origins, directions, i, planes, plane)
        hit = seen[i] and 0.0 < reach < np.inf
        x = origins[i, 0] + reach * directions[i, 0] if hit else np.nan
        y = origins[i, 1] + reach * directions[i, 1] if hit else np.nan
        z = origins[i, 2] + reach * directions[i, 2] if hit else np.nan
        j = owner[i]
        if i == 0 or j != owner[i - 1]:
            moved = _distance_to_sheet(origins, directions, j, planes, plane)
            moved = moved if seen[j] and 0.0 < moved < np.inf else np.nan
            sx = (origins[j, 0] + moved * directions[j, 0] - x) / _DIFFERENCE_PX
            sy = (origins[j, 1] + moved * directions[j, 1] - y) / _DIFFERENCE_PX
            sz = (origins[j, 2] + moved * directions[j, 2] - z) / _DIFFERENCE_PX
        known = hit and sx == sx
        valid[i] = known
        points[i, 0] = x if known else np.nan
        points[i, 1] = y if known else np.nan
        points[i, 2] = z if known else np.nan
        sensitivity[i, 0], sensitivity[i, 1], sensitivity[i, 2] = sx, sy, sz
    if bent is not None:
        _intersect_bent_sheets(
            bent, laser, owner, origins, directions, seen, points, sensitivity, valid
        )
    all_valid = True
    for i in range(points.shape[0]):
        all_valid &= valid[i]
    return all_valid


@lazy_borrowing_kernel
def _place_rays(
    pixels: FloatArray, along_x: IntArray, group: IntArray, rays_px: FloatArray, owner: IntArray
) -> int:
    """Write the pixels to trace: all N, then the first of each group moved along the search line.

    `owner` (N,) gets the row of the moved pixel that gives each pixel's sensitivity. Return the
    number of pixels to trace.
    """
    n = pixels.shape[0]
    n_rays = n
    for i in range(n):
        rays_px[i, 0] = pixels[i, 0]
        rays_px[i, 1] = pixels[i, 1]
        if i == 0 or group[i] != group[i - 1]:
            rays_px[n_rays, 0] = pixels[i, 0] + (_DIFFERENCE_PX if along_x[i] else 0.0)
            rays_px[n_rays, 1] = pixels[i, 1] + (0.0 if along_x[i] else _DIFFERENCE_PX)
            n_rays += 1
        owner[i] = n_rays - 1
    return int(n_rays)


@inline_borrowing_kernel
def _distance_to_sheet(
    origins: FloatArray, directions: FloatArray, i: int, planes: FloatArray, plane: int
) -> float:
    """Return the distance along ray i to a plane, in metres; negative behind its origin."""
    nx, ny, nz = planes[plane, 0], planes[plane, 1], planes[plane, 2]
    approach = nx * directions[i, 0] + ny * directions[i, 1] + nz * directions[i, 2]
    behind = nx * origins[i, 0] + ny * origins[i, 1] + nz * origins[i, 2] - planes[plane, 3]
    return float(-behind / approach)


@inner_borrowing_kernel
def _intersect_bent_sheets(
    sheets: FloatArray,
    laser: IntArray,
    owner: IntArray,
    origins: FloatArray,
    directions: FloatArray,
    seen: BoolArray,
    points: FloatArray,
    sensitivity: FloatArray,
    valid: BoolArray,
) -> None:
    """Replace the points on the planes of bent sheets by points on the sheets themselves.

    The tangent plane at a point approximates the sheet along the moved ray; along the next ray of
    the group it gives the first guess.
    """
    sx, sy, sz = np.nan, np.nan, np.nan
    near = np.nan
    for i in range(points.shape[0]):
        sheet = sheets[laser[i]]
        if sheet[WINDOWED] == 0.0:
            continue
        ox, oy, oz = origins[i, 0], origins[i, 1], origins[i, 2]
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        j = owner[i]
        first = i == 0 or j != owner[i - 1]
        if first or near != near:
            nx, ny, nz, offset = sheet[0], sheet[1], sheet[2], sheet[3]
        near = (offset - nx * ox - ny * oy - nz * oz) / (nx * dx + ny * dy + nz * dz)
        near, nx, ny, nz = intersect_ray(sheet, ox, oy, oz, dx, dy, dz, near)
        x, y, z = ox + near * dx, oy + near * dy, oz + near * dz
        offset = nx * x + ny * y + nz * z
        if first:
            ox, oy, oz = origins[j, 0], origins[j, 1], origins[j, 2]
            dx, dy, dz = directions[j, 0], directions[j, 1], directions[j, 2]
            moved = (offset - nx * ox - ny * oy - nz * oz) / (nx * dx + ny * dy + nz * dz)
            moved = moved if seen[j] and 0.0 < moved < np.inf else np.nan
            sx = (ox + moved * dx - x) / _DIFFERENCE_PX
            sy = (oy + moved * dy - y) / _DIFFERENCE_PX
            sz = (oz + moved * dz - z) / _DIFFERENCE_PX
        valid[i] = seen[i] and near == near and sx == sx
        points[i, 0], points[i, 1], points[i, 2] = x, y, z
        sensitivity[i, 0], sensitivity[i, 1], sensitivity[i, 2] = sx, sy, sz
        if not valid[i]:
            points[i, 0], points[i, 1], points[i, 2] = np.nan, np.nan, np.nan
