"""Batch kernels of the camera: pixels to rays, points to pixels, and the Jacobians of both.

Every kernel writes into arrays that it is given, and NaN wherever it writes False into `valid`. The
block layout of the scratch array is that of `aqualvs.optics.lens`.
"""

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.compiled import inline_kernel, kernel
from aqualvs.optics.dome import (
    ROUNDS,
    CameraParams,
    across_axis,
    back_derivative,
    cam_from_dome,
    cross,
    direction_to_point,
    dome_from_cam,
    dot,
    is_outside,
    paraxial_start,
    perpendicular,
    polar_angle,
    solve_guarded,
    surfaces_at,
    three_steps,
    trace_direction,
    trace_tangent,
)
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
    Vector,
    fisheye_pixel,
    fisheye_pixel_jacobian,
    lens_direction_jacobian,
    lens_pixel,
    opencv_pixel,
    opencv_pixel_jacobian,
)

# Rows of the scratch array after those of the lens: the origin of the ray.
OX, OY, OZ = ((N_LENS_ROWS + i_row) * BLOCK for i_row in range(3))
N_RAY_ROWS = N_LENS_ROWS + 3


@inline_kernel
def trace_block(camera: CameraParams, w: FloatArray) -> None:
    """Turn unit directions in `dome` into rays in the outer medium, all lanes of a block."""
    for j in range(BLOCK):
        passed, ox, oy, oz, dx, dy, dz = trace_direction(camera, w[DX + j], w[DY + j], w[DZ + j])
        w[OX + j], w[OY + j], w[OZ + j] = ox, oy, oz
        w[DX + j], w[DY + j], w[DZ + j] = dx, dy, dz
        w[LENS_OK + j] = w[LENS_OK + j] if passed else -1.0


@inline_kernel
def rotate_block(camera: CameraParams, w: FloatArray) -> None:
    """Rotate directions from `cam` to `dome` and start them at the lens, all lanes of a block."""
    cx, cy, cz = camera.centre
    for j in range(BLOCK):
        x, y, z = dome_from_cam(camera, w[DX + j], w[DY + j], w[DZ + j])
        w[DX + j], w[DY + j], w[DZ + j] = x, y, z
        w[OX + j], w[OY + j], w[OZ + j] = cx, cy, cz


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
        if camera.has_dome:
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
    """Write rays of unit directions (N, 3) at the lens, in `dome`: the dome alone."""
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
            o_dot = (0.0, 0.0, 0.0)
            if camera.has_dome:
                o_dot, d_dot = trace_tangent(camera, d, d_dot)
            for j in range(3):
                origin_jacobian[i, j, k] = o_dot[j]
                direction_jacobian[i, j, k] = d_dot[j]


# Rows of the scratch array: the point, which becomes the direction at the lens, then the pixel;
# its polar coordinates (distance inverted); the unit vector across the axis; the solution; a
# sign, positive where valid.
PX, PY, PZ, FAR, COS_T, SIN_T, EX, EY, EZ, COS_A, SIN_A, OK = (i_row * BLOCK for i_row in range(12))
N_POINT_ROWS = 12


@inline_kernel
def project_point(camera: CameraParams, x: float, y: float, z: float) -> tuple[bool, float, float]:
    """Project a point (metres, in `dome`); return (valid, u, v).

    Where `valid` is False the numbers are meaningless.
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
    """Solve for the ray's angle at the lens, all lanes of a block; set the signs of validity.

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
