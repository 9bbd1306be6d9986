"""Batch kernels of the camera, backward with derivatives: points to pixels and their Jacobians.

Every kernel writes into arrays it is given, and NaN wherever it writes False into `valid`. See
`lens_batch` for how the blocks work.
"""

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.compiled import inline_kernel, kernel
from aqualvs.optics.dome_back import surfaces_at
from aqualvs.optics.dome_forward import CameraParams, cam_from_dome, dome_from_cam
from aqualvs.optics.dome_jacobian import across_axis, back_derivative, cross, dot, perpendicular
from aqualvs.optics.lens_batch import BLOCK, write_intrinsics_jacobian
from aqualvs.optics.lens_kernels import fisheye_pixel_jacobian, opencv_pixel_jacobian
from aqualvs.optics.lens_params import Vector
from aqualvs.optics.project_batch import (
    COS_A,
    COS_T,
    EX,
    EY,
    EZ,
    FAR,
    N_POINT_ROWS,
    OK,
    PX,
    PY,
    PZ,
    SIN_A,
    SIN_T,
    aim_block,
    bare_block,
    load_points,
    polar_block,
    solve_block,
)

# Columns of the parameter Jacobian before the intrinsics: lens position 3, rotation 3, and these
# of the dome.
N_POSE = 6
N_DOME = 5
# Rows of the scratch array after those of the projection: direction in `cam`, pixel, gradients of
# u and v by the direction in `dome`, then for u and for v the gradients by point, pose and dome.
CX, CY, CZ, U, V, GUX, GUY, GUZ, GVX, GVY, GVZ = (
    (N_POINT_ROWS + i_row) * BLOCK for i_row in range(11)
)
N_GRADIENT = 3 + N_POSE + N_DOME
JU = (N_POINT_ROWS + 11) * BLOCK
JV = JU + N_GRADIENT * BLOCK
N_ROWS = N_POINT_ROWS + 11 + 2 * N_GRADIENT


@inline_kernel
def _see_lane(
    camera: CameraParams,
    w: FloatArray,
    j: int,
    seen: tuple[bool, float, float, Vector, Vector],
) -> None:
    """Write what a lens sees into lane j."""
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
def dome_gradients_block(camera: CameraParams, w: FloatArray) -> None:
    """Write the gradients of u and v by point, lens position and dome, all lanes of a block."""
    spare = perpendicular(camera.axis)
    for j in range(BLOCK):
        back = back_derivative(
            camera,
            surfaces_at(camera, w[FAR + j]),
            (w[FAR + j], w[COS_T + j], w[SIN_T + j]),
            across_axis(camera.axis, (w[EX + j], w[EY + j], w[EZ + j]), spare),
            (w[COS_A + j], w[SIN_A + j]),
        )
        for g, row in (
            ((w[GUX + j], w[GUY + j], w[GUZ + j]), JU),
            ((w[GVX + j], w[GVY + j], w[GVZ + j]), JV),
        ):
            g_u, g_m = dot(g, back.turn), dot(g, back.normal)
            by_point, by_lens = g_m * back.across_point, g_m * back.across_lens
            for k in range(3):
                w[row + k * BLOCK + j] = g_u * back.along_point[k] + by_point * back.normal[k]
                w[row + (3 + k) * BLOCK + j] = (
                    g_u * back.along_lens * back.turn[k] + by_lens * back.normal[k]
                )
            w[row + 9 * BLOCK + j] = g_u * back.by_inner
            w[row + 10 * BLOCK + j] = g_u * back.by_thickness
            w[row + 11 * BLOCK + j] = g_u * back.by_n_air
            w[row + 12 * BLOCK + j] = g_u * back.by_n_acrylic
            w[row + 13 * BLOCK + j] = g_u * back.by_n_water


@inline_kernel
def bare_gradients_block(w: FloatArray) -> None:
    """Write the gradients of u and v by point and lens position, all lanes of a block."""
    for row, g in ((JU, GUX), (JV, GVX)):
        for k in range(3):
            for j in range(BLOCK):
                w[row + k * BLOCK + j] = w[g + k * BLOCK + j]
                w[row + (3 + k) * BLOCK + j] = -w[g + k * BLOCK + j]


@inline_kernel
def turn_gradients_block(w: FloatArray) -> None:
    """Write the gradients of u and v by the camera's rotation, all lanes of a block.

    exp(w) R seen from `cam` turns the direction d by -w: g . (d x w) = w . (g x d).
    """
    for row, g in ((JU, GUX), (JV, GVX)):
        for j in range(BLOCK):
            x, y, z = cross(
                (w[g + j], w[g + BLOCK + j], w[g + 2 * BLOCK + j]),
                (w[PX + j], w[PY + j], w[PZ + j]),
            )
            w[row + 6 * BLOCK + j] = x
            w[row + 7 * BLOCK + j] = y
            w[row + 8 * BLOCK + j] = z


@inline_kernel
def store_parameters(
    camera: CameraParams, start: int, count: int, w: FloatArray, jacobian: FloatArray
) -> None:
    """Write `count` parameter Jacobians from the scratch `w` to the rows from `start`."""
    n_before = N_POSE + N_DOME if camera.has_dome else N_POSE
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
) -> None:
    """Write pixels (N, 2) of points (N, 3), derivatives by the point and, if asked, the parameters.

    `parameter_jacobian` has shape (N, 2, P) in the order of `camera.parameter_names`, or
    (0, 2, P) to leave it out.
    """
    w = np.zeros(N_ROWS * BLOCK)
    for start in range(0, points.shape[0], BLOCK):
        count = min(BLOCK, points.shape[0] - start)
        load_points(points, start, count, w)
        if camera.has_dome:
            polar_block(camera, w)
            solve_block(camera, count, w)
            aim_block(camera, w)
            see_jacobian_block(camera, count, w)
            dome_gradients_block(camera, w)
        else:
            bare_block(camera, w)
            see_jacobian_block(camera, count, w)
            bare_gradients_block(w)
        for j in range(count):
            ok = w[OK + j] > 0.0
            valid[start + j] = ok
            pixels[start + j, 0] = w[U + j] if ok else np.nan
            pixels[start + j, 1] = w[V + j] if ok else np.nan
            for k in range(3):
                point_jacobian[start + j, 0, k] = w[JU + k * BLOCK + j] if ok else np.nan
                point_jacobian[start + j, 1, k] = w[JV + k * BLOCK + j] if ok else np.nan
        if parameter_jacobian.shape[0] > 0:
            turn_gradients_block(w)
            store_parameters(camera, start, count, w, parameter_jacobian)
