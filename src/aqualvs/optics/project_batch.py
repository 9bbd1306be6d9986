"""Batch kernels of the camera, backward: rows of points to rows of pixels.

Every kernel writes into arrays it is given, and NaN wherever it writes False into `valid`. See
`lens_batch` for how the blocks work.
"""

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.compiled import inline_kernel, kernel
from aqualvs.optics.dome_back import (
    ROUNDS,
    direction_to_point,
    is_outside,
    paraxial_start,
    polar_angle,
    solve_guarded,
    surfaces_at,
    three_steps,
)
from aqualvs.optics.dome_forward import CameraParams, cam_from_dome
from aqualvs.optics.lens_batch import BLOCK
from aqualvs.optics.lens_kernels import fisheye_pixel, lens_pixel, opencv_pixel

# Rows of the scratch array: the point, which becomes the direction at the lens, then the pixel;
# its polar coordinates (distance inverted); the unit vector across the axis; the solution; a
# sign, positive where valid.
PX, PY, PZ, FAR, COS_T, SIN_T, EX, EY, EZ, COS_A, SIN_A, OK = (i_row * BLOCK for i_row in range(12))
N_POINT_ROWS = 12


@inline_kernel
def project_point(camera: CameraParams, x: float, y: float, z: float) -> tuple[bool, float, float]:
    """Project a point (metres, in `dome`); returns (valid, u, v).

    Where `valid` is False the numbers mean nothing.
    """
    if camera.has_dome:
        reached, dx, dy, dz = direction_to_point(camera, x, y, z)
    else:
        c = camera.centre
        reached, dx, dy, dz = True, x - c[0], y - c[1], z - c[2]
    x, y, z = cam_from_dome(camera, dx, dy, dz)
    seen, u, v = lens_pixel(camera.lens, x, y, z)
    return reached and seen, u, v


@inline_kernel
def load_points(points: FloatArray, start: int, count: int, w: FloatArray) -> None:
    """Write `count` points from row `start` into the scratch `w`."""
    for j in range(count):
        w[PX + j] = points[start + j, 0]
        w[PY + j] = points[start + j, 1]
        w[PZ + j] = points[start + j, 2]


@inline_kernel
def bare_block(camera: CameraParams, w: FloatArray) -> None:
    """Turn points into directions from the lens, all lanes of a block."""
    cx, cy, cz = camera.centre
    for j in range(BLOCK):
        w[PX + j], w[PY + j], w[PZ + j] = w[PX + j] - cx, w[PY + j] - cy, w[PZ + j] - cz
        w[OK + j] = 1.0


@inline_kernel
def polar_block(camera: CameraParams, w: FloatArray) -> None:
    """Turn points into polar coordinates and the start of the search, all lanes of a block."""
    n_l = camera.n_air * camera.decentring
    for j in range(BLOCK):
        far, cos_t, sin_t, e = polar_angle(camera, w[PX + j], w[PY + j], w[PZ + j])
        w[FAR + j], w[COS_T + j], w[SIN_T + j] = far, cos_t, sin_t
        w[EX + j], w[EY + j], w[EZ + j] = e
        w[OK + j] = 0.0 if is_outside(camera, far) else -1.0
        s = surfaces_at(camera, far)
        w[COS_A + j], w[SIN_A + j] = paraxial_start(s, n_l, cos_t, sin_t)


@inline_kernel
def solve_block(camera: CameraParams, count: int, w: FloatArray) -> None:
    """Solve for the ray's angle at the lens, all lanes of a block; a zero becomes a sign.

    Lanes that no round of steps solves are searched one by one.
    """
    n_l = camera.n_air * camera.decentring
    n_open = count
    for _ in range(ROUNDS):
        if n_open == 0:
            return
        for j in range(BLOCK):
            s = surfaces_at(camera, w[FAR + j])
            c, k, solved = three_steps(
                s, n_l, w[COS_T + j], w[SIN_T + j], w[COS_A + j], w[SIN_A + j]
            )
            w[COS_A + j], w[SIN_A + j] = c, k
            w[OK + j] = 1.0 if solved & (w[OK + j] >= 0.0) else w[OK + j]
        n_open = 0
        for j in range(count):
            n_open += w[OK + j] == 0.0
    for j in range(count):
        if w[OK + j] == 0.0:
            s = surfaces_at(camera, w[FAR + j])
            found, w[COS_A + j], w[SIN_A + j] = solve_guarded(s, n_l, w[COS_T + j], w[SIN_T + j])
            w[OK + j] = 1.0 if found else -1.0


@inline_kernel
def aim_block(camera: CameraParams, w: FloatArray) -> None:
    """Turn solved angles into directions at the lens, in `dome`, all lanes of a block."""
    ax, ay, az = camera.axis
    for j in range(BLOCK):
        c, k = w[COS_A + j], w[SIN_A + j]
        w[PX + j] = c * ax + k * w[EX + j]
        w[PY + j] = c * ay + k * w[EY + j]
        w[PZ + j] = c * az + k * w[EZ + j]


@inline_kernel
def see_block(camera: CameraParams, count: int, w: FloatArray) -> None:
    """Turn directions in `dome` into pixels, all lanes of a block."""
    for j in range(BLOCK):
        x, y, z = cam_from_dome(camera, w[PX + j], w[PY + j], w[PZ + j])
        w[PX + j], w[PY + j], w[PZ + j] = x, y, z
    if camera.lens.fisheye:
        for j in range(count):
            seen, u, v = fisheye_pixel(camera.lens, w[PX + j], w[PY + j], w[PZ + j])
            w[PX + j], w[PY + j] = u, v
            w[OK + j] = w[OK + j] if seen else -1.0
        return
    for j in range(BLOCK):
        seen, u, v = opencv_pixel(camera.lens, w[PX + j], w[PY + j], w[PZ + j])
        w[PX + j], w[PY + j] = u, v
        w[OK + j] = w[OK + j] if seen else -1.0


@kernel
def project_all(
    camera: CameraParams, points: FloatArray, pixels: FloatArray, valid: BoolArray
) -> None:
    """Write pixels (N, 2) of points (N, 3)."""
    w = np.zeros(N_POINT_ROWS * BLOCK)
    for start in range(0, points.shape[0], BLOCK):
        count = min(BLOCK, points.shape[0] - start)
        load_points(points, start, count, w)
        if camera.has_dome:
            polar_block(camera, w)
            solve_block(camera, count, w)
            aim_block(camera, w)
        else:
            bare_block(camera, w)
        see_block(camera, count, w)
        for j in range(count):
            ok = w[OK + j] > 0.0
            valid[start + j] = ok
            pixels[start + j, 0] = w[PX + j] if ok else np.nan
            pixels[start + j, 1] = w[PY + j] if ok else np.nan
