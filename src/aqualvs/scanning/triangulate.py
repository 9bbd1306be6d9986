"""Triangulation: pixels on a laser's stripe to points in the water, with their uncertainty."""

from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import inline_kernel, kernel
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import Rig

# Step of the one-sided difference, in pixels; the second derivative of a point by the pixel is
# about 1e-2 of the first, so the error stays below 1 % of a sensitivity.
_DIFFERENCE_PX = 0.25


@dataclass(frozen=True, slots=True)
class Triangulation:
    """Points on laser sheets, N of them.

    Attributes
    ----------
    points_in_dome : array, shape (N, 3)
        Metres; NaN where not valid.
    sensitivity : array, shape (N, 3)
        Derivative of the point by the stripe's position along the search line, in m/px. The
        covariance of a point is sigma_px² times its outer product: an error along the stripe
        stays on the stripe.
    valid : bool array, shape (N,)
        False where the pixel sees nothing or its ray misses the sheet.
    """

    points_in_dome: FloatArray
    sensitivity: FloatArray
    valid: BoolArray


class Triangulator:
    """Triangulates pixels with a rig's laser planes (paper, Eq. 17-21).

    Parameters
    ----------
    rig : Rig
        Laser planes.
    camera : Camera
        Of the rig, behind its dome or bare.
    """

    def __init__(self, rig: Rig, camera: Camera) -> None:
        self._camera = camera
        self._planes = np.array(
            [[*laser.plane.normal, laser.plane.offset] for laser in rig.lasers]
        ).reshape(-1, 4)

    def triangulate(self, pixels: FloatArray, along_x: IntArray, laser: IntArray) -> Triangulation:
        """Triangulate pixels (N, 2), each with the laser whose index is given.

        Parameters
        ----------
        pixels : array, shape (N, 2)
            In `image`.
        along_x : int array, shape (N,)
            1 where the position was measured along x, 0 where along y.
        laser : int array, shape (N,)
            Index into the rig's lasers.
        """
        n = len(pixels)
        pairs = np.empty((2 * n, 2))
        _pair_pixels(pixels, along_x, pairs)
        origins, directions = np.empty((2 * n, 3)), np.empty((2 * n, 3))
        seen = np.empty(2 * n, np.bool_)
        self._camera.rays_into(pairs, origins, directions, seen)
        points, sensitivity, valid = np.empty((n, 3)), np.empty((n, 3)), np.empty(n, np.bool_)
        _intersect_sheets(
            self._planes, laser, origins, directions, seen, points, sensitivity, valid
        )
        return Triangulation(points, sensitivity, valid)


@kernel
def _pair_pixels(pixels: FloatArray, along_x: IntArray, pairs: FloatArray) -> None:
    """Write the pixels, and after them the same pixels moved along the search line."""
    n = pixels.shape[0]
    for i in range(n):
        pairs[i, 0] = pixels[i, 0]
        pairs[i, 1] = pixels[i, 1]
        pairs[n + i, 0] = pixels[i, 0] + (_DIFFERENCE_PX if along_x[i] else 0.0)
        pairs[n + i, 1] = pixels[i, 1] + (0.0 if along_x[i] else _DIFFERENCE_PX)


@kernel
def _intersect_sheets(
    planes: FloatArray,
    laser: IntArray,
    origins: FloatArray,
    directions: FloatArray,
    seen: BoolArray,
    points: FloatArray,
    sensitivity: FloatArray,
    valid: BoolArray,
) -> None:
    """Intersect pairs of rays (i, n + i) with n·X = d (Eq. 20)."""
    n = points.shape[0]
    for i in range(n):
        nx, ny, nz, offset = planes[laser[i]]
        j = n + i
        reach = _distance_to_sheet(origins[i], directions[i], nx, ny, nz, offset)
        moved = _distance_to_sheet(origins[j], directions[j], nx, ny, nz, offset)
        hit = seen[i] and seen[j] and 0.0 < reach < np.inf and 0.0 < moved < np.inf
        valid[i] = hit
        for k in range(3):
            point = origins[i, k] + reach * directions[i, k]
            other = origins[j, k] + moved * directions[j, k]
            points[i, k] = point if hit else np.nan
            sensitivity[i, k] = (other - point) / _DIFFERENCE_PX if hit else np.nan


@inline_kernel
def _distance_to_sheet(
    origin: FloatArray, direction: FloatArray, nx: float, ny: float, nz: float, offset: float
) -> float:
    approach = nx * direction[0] + ny * direction[1] + nz * direction[2]
    return float((offset - nx * origin[0] - ny * origin[1] - nz * origin[2]) / approach)
