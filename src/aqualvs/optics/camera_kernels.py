"""Batch kernels of the camera: pixels to rays, points to pixels, and the Jacobians of both.

Every kernel writes into arrays that it is given, and NaN wherever it writes False into `valid`. The
block layout of the scratch array is that of `aqualvs.optics.lens`; what refracts is a camera's
`port`, see `aqualvs.optics.port_kernels`.
"""

from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.compiled import inline_kernel, kernel
from aqualvs.optics.dome import DomeParams
from aqualvs.optics.flat_port import FlatParams
from aqualvs.optics.lens import (
    BLOCK,
    DX,
    DY,
    DZ,
    LENS_OK,
    N_LENS_ROWS,
    directions_block,
    load_pixels,
    write_intrinsics_jacobian,
)
from aqualvs.optics.lens_kernels import (
    LensParams,
    Vector,
    fisheye_pixel,
    fisheye_pixel_jacobian,
    lens_direction,
    lens_direction_jacobian,
    lens_pixel,
    opencv_pixel,
    opencv_pixel_jacobian,
)
from aqualvs.optics.port_kernels import (
    CX,
    CY,
    CZ,
    GUX,
    GUY,
    GUZ,
    GVX,
    GVY,
    GVZ,
    JU,
    JV,
    N_POINT_ROWS,
    N_ROWS,
    OK,
    PX,
    PY,
    PZ,
    BareParams,
    U,
    V,
    aim,
    aim_block,
    gradients_block,
    trace_port,
    trace_port_tangent,
    turn_gradients_block,
)


class CameraParams(NamedTuple):
    """A camera as kernels take it; `camera.params` makes it.

    Attributes
    ----------
    lens : LensParams
        Intrinsics.
    rotation : tuple of 9 float
        `dome_from_cam`, row by row.
    port : BareParams, DomeParams or FlatParams
        What stands between the lens and the outer medium, and the lens position.
    """

    lens: LensParams
    rotation: tuple[float, float, float, float, float, float, float, float, float]
    port: BareParams | DomeParams | FlatParams


@inline_kernel
def dome_from_cam(camera: CameraParams, x: float, y: float, z: float) -> Vector:
    """Rotate a direction from `cam` to `dome`."""
    r = camera.rotation
    return (
        r[0] * x + r[1] * y + r[2] * z,
        r[3] * x + r[4] * y + r[5] * z,
        r[6] * x + r[7] * y + r[8] * z,
    )


@inline_kernel
def cam_from_dome(camera: CameraParams, x: float, y: float, z: float) -> Vector:
    """Rotate a direction from `dome` to `cam`."""
    r = camera.rotation
    return (
        r[0] * x + r[3] * y + r[6] * z,
        r[1] * x + r[4] * y + r[7] * z,
        r[2] * x + r[5] * y + r[8] * z,
    )


@inline_kernel
def trace_pixel(
    camera: CameraParams, u: float, v: float
) -> tuple[bool, float, float, float, float, float, float]:
    """Trace the pixel (u, v) into the outer medium; callable from other kernels.

    Returns
    -------
    valid, ox, oy, oz, dx, dy, dz
        Origin (metres) and unit direction in `dome`, as in `Rays`. Where `valid` is False the
        numbers are meaningless.
    """
    seen, cx, cy, cz = lens_direction(camera.lens, u, v)
    dx, dy, dz = dome_from_cam(camera, cx, cy, cz)
    passed, ox, oy, oz, dx, dy, dz = trace_port(camera.port, dx, dy, dz)
    return seen and passed, ox, oy, oz, dx, dy, dz


# Rows of the scratch array after those of the lens: the origin of the ray.
OX, OY, OZ = ((N_LENS_ROWS + i_row) * BLOCK for i_row in range(3))
N_RAY_ROWS = N_LENS_ROWS + 3


@inline_kernel
def trace_block(camera: CameraParams, w: FloatArray) -> None:
    """Turn unit directions in `dome` into rays in the outer medium, all lanes of a block."""
    for j in range(BLOCK):
        passed, ox, oy, oz, dx, dy, dz = trace_port(camera.port, w[DX + j], w[DY + j], w[DZ + j])
        w[OX + j], w[OY + j], w[OZ + j] = ox, oy, oz
        w[DX + j], w[DY + j], w[DZ + j] = dx, dy, dz
        w[LENS_OK + j] = w[LENS_OK + j] if passed else -1.0


@inline_kernel
def rotate_block(camera: CameraParams, w: FloatArray) -> None:
    """Rotate directions from `cam` to `dome`, all lanes of a block."""
    for j in range(BLOCK):
        x, y, z = dome_from_cam(camera, w[DX + j], w[DY + j], w[DZ + j])
        w[DX + j], w[DY + j], w[DZ + j] = x, y, z


@inline_kernel
def store_rays(
    start: int,
    count: int,
    w: FloatArray,
    origins: FloatArray,
    directions: FloatArray,
    valid: BoolArray,
) -> None:
    """Write `count` rays from the scratch `w` to the rows from `start`."""
    for j in range(count):
        ok = w[LENS_OK + j] > 0.0
        valid[start + j] = ok
        origins[start + j, 0] = w[OX + j] if ok else np.nan
        origins[start + j, 1] = w[OY + j] if ok else np.nan
        origins[start + j, 2] = w[OZ + j] if ok else np.nan
        directions[start + j, 0] = w[DX + j] if ok else np.nan
        directions[start + j, 1] = w[DY + j] if ok else np.nan
        directions[start + j, 2] = w[DZ + j] if ok else np.nan


@kernel
def rays_all(
    camera: CameraParams,
    pixels: FloatArray,
    origins: FloatArray,
    directions: FloatArray,
    valid: BoolArray,
) -> None:
    """Write rays of pixels (N, 2): origins (N, 3), directions (N, 3), valid (N)."""
    w = np.zeros(N_RAY_ROWS * BLOCK)
    for start in range(0, pixels.shape[0], BLOCK):
        count = min(BLOCK, pixels.shape[0] - start)
        load_pixels(camera.lens, pixels, start, count, w)
        directions_block(camera.lens, count, w)
        rotate_block(camera, w)
        trace_block(camera, w)
        store_rays(start, count, w, origins, directions, valid)


@kernel
def trace_all(
    camera: CameraParams,
    directions_at_lens: FloatArray,
    origins: FloatArray,
    directions: FloatArray,
    valid: BoolArray,
) -> None:
    """Write rays of unit directions (N, 3) at the lens, in `dome`: the port alone."""
    w = np.zeros(N_RAY_ROWS * BLOCK)
    for start in range(0, directions_at_lens.shape[0], BLOCK):
        count = min(BLOCK, directions_at_lens.shape[0] - start)
        for j in range(count):
            w[DX + j] = directions_at_lens[start + j, 0]
            w[DY + j] = directions_at_lens[start + j, 1]
            w[DZ + j] = directions_at_lens[start + j, 2]
            w[LENS_OK + j] = 1.0
        trace_block(camera, w)
        store_rays(start, count, w, origins, directions, valid)


@kernel
def rays_jacobian_all(
    camera: CameraParams,
    pixels: FloatArray,
    valid: BoolArray,
    origin_jacobian: FloatArray,
    direction_jacobian: FloatArray,
) -> None:
    """Write derivatives (N, 3, 2) of origins and directions by the pixel, where `valid` says so."""
    for i in range(pixels.shape[0]):
        if not valid[i]:
            origin_jacobian[i] = np.nan
            direction_jacobian[i] = np.nan
            continue
        _, d, d_u, d_v = lens_direction_jacobian(camera.lens, pixels[i, 0], pixels[i, 1])
        d = dome_from_cam(camera, d[0], d[1], d[2])
        for k in range(2):
            d_dot = d_u if k == 0 else d_v
            d_dot = dome_from_cam(camera, d_dot[0], d_dot[1], d_dot[2])
            o_dot, d_dot = trace_port_tangent(camera.port, d, d_dot)
            for j in range(3):
                origin_jacobian[i, j, k] = o_dot[j]
                direction_jacobian[i, j, k] = d_dot[j]


@inline_kernel
def project_point(camera: CameraParams, x: float, y: float, z: float) -> tuple[bool, float, float]:
    """Project a point (metres, in `dome`); return (valid, u, v).

    Where `valid` is False the numbers are meaningless.
    """
    reached, dx, dy, dz = aim(camera.port, x, y, z)
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
        aim_block(camera.port, count, w)
        see_block(camera, count, w)
        for j in range(count):
            ok = w[OK + j] > 0.0
            valid[start + j] = ok
            pixels[start + j, 0] = w[PX + j] if ok else np.nan
            pixels[start + j, 1] = w[PY + j] if ok else np.nan


@inline_kernel
def _see_lane(
    camera: CameraParams,
    w: FloatArray,
    j: int,
    seen: tuple[bool, float, float, Vector, Vector],
) -> None:
    """Write the pixel and its gradients into lane j."""
    ok, w[U + j], w[V + j], u_d, v_d = seen
    w[GUX + j], w[GUY + j], w[GUZ + j] = dome_from_cam(camera, u_d[0], u_d[1], u_d[2])
    w[GVX + j], w[GVY + j], w[GVZ + j] = dome_from_cam(camera, v_d[0], v_d[1], v_d[2])
    w[OK + j] = w[OK + j] if ok else -1.0


@inline_kernel
def see_jacobian_block(camera: CameraParams, count: int, w: FloatArray) -> None:
    """Turn directions in `dome` into pixels and their gradients, all lanes of a block."""
    lens = camera.lens
    for j in range(BLOCK):
        x, y, z = cam_from_dome(camera, w[PX + j], w[PY + j], w[PZ + j])
        w[CX + j], w[CY + j], w[CZ + j] = x, y, z
    if lens.fisheye:
        for j in range(count):
            seen = fisheye_pixel_jacobian(lens, w[CX + j], w[CY + j], w[CZ + j])
            _see_lane(camera, w, j, seen)
        return
    for j in range(BLOCK):
        seen = opencv_pixel_jacobian(lens, w[CX + j], w[CY + j], w[CZ + j])
        _see_lane(camera, w, j, seen)


@inline_kernel
def store_parameters(
    camera: CameraParams,
    n_before: int,
    start: int,
    count: int,
    w: FloatArray,
    jacobian: FloatArray,
) -> None:
    """Write `count` parameter Jacobians from the scratch `w` to the rows from `start`."""
    for j in range(count):
        if w[OK + j] < 0.0:
            jacobian[start + j] = np.nan
            continue
        write_intrinsics_jacobian(
            camera.lens, w[CX + j], w[CY + j], w[CZ + j], jacobian[start + j, :, n_before:]
        )
        for k in range(n_before):
            jacobian[start + j, 0, k] = w[JU + (3 + k) * BLOCK + j]
            jacobian[start + j, 1, k] = w[JV + (3 + k) * BLOCK + j]


@kernel
def project_jacobian_all(
    camera: CameraParams,
    points: FloatArray,
    pixels: FloatArray,
    valid: BoolArray,
    point_jacobian: FloatArray,
    parameter_jacobian: FloatArray,
    n_before: int,
) -> None:
    """Write pixels (N, 2) of points (N, 3), derivatives by the point and, if asked, the parameters.

    `parameter_jacobian` has shape (N, 2, P) in the order of `camera.parameter_names`, of which
    `n_before` stand before the intrinsics, or (0, 2, P) to leave it out.
    """
    w = np.zeros(N_ROWS * BLOCK)
    for start in range(0, points.shape[0], BLOCK):
        count = min(BLOCK, points.shape[0] - start)
        load_points(points, start, count, w)
        aim_block(camera.port, count, w)
        see_jacobian_block(camera, count, w)
        gradients_block(camera.port, w)
        for j in range(count):
            ok = w[OK + j] > 0.0
            valid[start + j] = ok
            pixels[start + j, 0] = w[U + j] if ok else np.nan
            pixels[start + j, 1] = w[V + j] if ok else np.nan
            for k in range(3):
                point_jacobian[start + j, 0, k] = w[JU + k * BLOCK + j] if ok else np.nan
                point_jacobian[start + j, 1, k] = w[JV + k * BLOCK + j] if ok else np.nan
        if parameter_jacobian.shape[0] > 0:
            turn_gradients_block(camera.port, w)
            store_parameters(camera, n_before, start, count, w, parameter_jacobian)
