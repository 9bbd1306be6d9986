"""Points of the outer medium, and directions at a lens, to pixels; with every derivative.

Functions of blocks work on a scratch array whose rows are named here, `BLOCK` lanes long. What
differs between a bare camera, a dome and a flat port is chosen by the class of the camera's `port`
when a kernel is compiled. Scalar kernels leave their numbers meaningless where `valid` is False,
batch kernels write NaN there.
"""

import math

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.compiled import dispatch_by_class, inline_kernel, kernel
from aqualvs.geometry.linear_algebra import Vec, combine, cross, dot
from aqualvs.optics.camera import BareParams, CameraParams, rotate_to_dome
from aqualvs.optics.dome import DomeParams
from aqualvs.optics.flat_port import FLAT_PARAMETERS, FlatParams
from aqualvs.optics.lens import BLOCK
from aqualvs.optics.lens_kernels import LensParams, fisheye_distort, opencv_distort
from aqualvs.optics.port_projection import (
    ROUNDS,
    across_axis,
    angle_sines,
    bisect_dome,
    bisect_flat,
    blend,
    dome_derivative,
    flat_derivative,
    halley_start,
    height_and_radius,
    is_in_front,
    is_outside,
    newton_start,
    perpendicular,
    polar_angle,
    three_halley_steps,
    three_newton_steps,
)


@inline_kernel
def opencv_pixel(
    lens: LensParams, x: float, y: float, z: float
) -> tuple[bool, float, float, Vec, Vec]:
    """Return (valid, u, v, gradient of u, gradient of v) of a direction of any length.

    Without branches; LLVM drops gradients that a caller does not use.
    """
    inverse = 1.0 / z
    xn, yn = x * inverse, y * inverse
    xd, yd, j_xx, j_xy, j_yy = opencv_distort(lens, xn, yn)
    a, b = lens.fx * inverse, lens.fy * inverse
    return (
        (z > 0.0) & (xn * xn + yn * yn < lens.limit),
        lens.fx * xd + lens.cx,
        lens.fy * yd + lens.cy,
        (a * j_xx, a * j_xy, -a * (j_xx * xn + j_xy * yn)),
        (b * j_xy, b * j_yy, -b * (j_xy * xn + j_yy * yn)),
    )


@inline_kernel
def fisheye_pixel(
    lens: LensParams, x: float, y: float, z: float
) -> tuple[bool, float, float, Vec, Vec]:
    """Return (valid, u, v, gradient of u, gradient of v) of a direction of any length."""
    radius = math.sqrt(x * x + y * y)
    theta = math.atan2(radius, z)
    value, slope = fisheye_distort(lens, theta)
    scale = value / radius if radius > 0.0 else 1.0 / z
    ex = x / radius if radius > 0.0 else 1.0
    ey = y / radius if radius > 0.0 else 0.0
    norm_sq = x * x + y * y + z * z
    along = slope * z / norm_sq
    deep = -slope * radius / norm_sq
    xx = scale + (along - scale) * ex * ex
    xy = (along - scale) * ex * ey
    yy = scale + (along - scale) * ey * ey
    return (
        theta < lens.limit and 0.0 < norm_sq < math.inf,
        lens.fx * x * scale + lens.cx,
        lens.fy * y * scale + lens.cy,
        (lens.fx * xx, lens.fx * xy, lens.fx * deep * ex),
        (lens.fy * xy, lens.fy * yy, lens.fy * deep * ey),
    )


@kernel
def pixels_all(
    lens: LensParams, directions: FloatArray, pixels: FloatArray, valid: BoolArray
) -> None:
    """Write pixels (N, 2) of directions (N, 3)."""
    for i in range(directions.shape[0]):
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        seen = fisheye_pixel(lens, x, y, z) if lens.fisheye else opencv_pixel(lens, x, y, z)
        ok, u, v, _, _ = seen
        valid[i] = ok
        pixels[i, 0] = u if ok else np.nan
        pixels[i, 1] = v if ok else np.nan


@inline_kernel
def _write_opencv(lens: LensParams, x: float, y: float, jacobian: FloatArray) -> None:
    """Write d(u, v) / d(fx, fy, cx, cy, distortion...) of (x, y, 1) into (2, 4 + n)."""
    q = x * x + y * y
    inverse = 1.0 / (1.0 + q * (lens.k4 + q * (lens.k5 + q * lens.k6)))
    f = (1.0 + q * (lens.k1 + q * (lens.k2 + q * lens.k3))) * inverse
    cross = 2.0 * (lens.p1 * y + lens.p2 * x)
    jacobian[0, 0] = x * (f + cross) + lens.p2 * q
    jacobian[1, 1] = y * (f + cross) + lens.p1 * q
    # Order of OpenCV: k1 k2 p1 p2 k3 k4 k5 k6.
    by_coefficient = (
        (x * q * inverse, y * q * inverse),
        (x * q * q * inverse, y * q * q * inverse),
        (2.0 * x * y, q + 2.0 * y * y),
        (q + 2.0 * x * x, 2.0 * x * y),
        (x * q * q * q * inverse, y * q * q * q * inverse),
        (-x * f * q * inverse, -y * f * q * inverse),
        (-x * f * q * q * inverse, -y * f * q * q * inverse),
        (-x * f * q * q * q * inverse, -y * f * q * q * q * inverse),
    )
    for k in range(jacobian.shape[1] - 4):
        jacobian[0, 4 + k] = lens.fx * by_coefficient[k][0]
        jacobian[1, 4 + k] = lens.fy * by_coefficient[k][1]


@inline_kernel
def _write_fisheye(lens: LensParams, x: float, y: float, z: float, jacobian: FloatArray) -> None:
    radius = math.sqrt(x * x + y * y)
    theta = math.atan2(radius, z)
    value, _ = fisheye_distort(lens, theta)
    ex = x / radius if radius > 0.0 else 0.0
    ey = y / radius if radius > 0.0 else 0.0
    jacobian[0, 0], jacobian[1, 1] = value * ex, value * ey
    power = theta
    for k in range(jacobian.shape[1] - 4):
        power = power * theta * theta
        jacobian[0, 4 + k] = lens.fx * power * ex
        jacobian[1, 4 + k] = lens.fy * power * ey


# Rows of the scratch array: the point, which becomes the direction at the lens, then the pixel;
# its polar coordinates (distance inverted), or, of a flat port, its height above the outer face
# and its distance from the axis; the unit vector across the axis; the solution; a sign, positive
# where valid.
PX, PY, PZ, FAR, COS_T, SIN_T, EX, EY, EZ, COS_A, SIN_A, OK = (i_row * BLOCK for i_row in range(12))
N_POINT_ROWS = 12


@inline_kernel
def bare_directions_block(port: BareParams, _count: int, w: FloatArray) -> None:
    """Turn points into directions from the lens, all lanes of a block."""
    cx, cy, cz = port.centre
    for j in range(BLOCK):
        w[PX + j], w[PY + j], w[PZ + j] = w[PX + j] - cx, w[PY + j] - cy, w[PZ + j] - cz
        w[OK + j] = 1.0


@inline_kernel
def dome_directions_block(port: DomeParams, count: int, w: FloatArray) -> None:
    """Turn points into directions at the lens, in `dome`, all lanes of a block.

    Lanes that no round of steps solves are searched one by one.
    """
    n_l = port.n_air * port.decentring
    for j in range(BLOCK):
        far, cos_t, sin_t, e = polar_angle(port, w[PX + j], w[PY + j], w[PZ + j])
        w[FAR + j], w[COS_T + j], w[SIN_T + j] = far, cos_t, sin_t
        w[EX + j], w[EY + j], w[EZ + j] = e
        w[OK + j] = 0.0 if is_outside(port, far) else -1.0
        w[COS_A + j], w[SIN_A + j] = newton_start(angle_sines(port, far), n_l, cos_t, sin_t)
    n_open = count
    for _ in range(ROUNDS):
        if n_open == 0:
            break
        for j in range(BLOCK):
            s = angle_sines(port, w[FAR + j])
            c, k, solved = three_newton_steps(
                s, n_l, w[COS_T + j], w[SIN_T + j], w[COS_A + j], w[SIN_A + j]
            )
            w[COS_A + j], w[SIN_A + j] = c, k
            w[OK + j] = 1.0 if solved & (w[OK + j] >= 0.0) else w[OK + j]
        n_open = 0
        for j in range(count):
            n_open += w[OK + j] == 0.0
    for j in range(count):
        if w[OK + j] == 0.0:
            s = angle_sines(port, w[FAR + j])
            found, w[COS_A + j], w[SIN_A + j] = bisect_dome(s, n_l, w[COS_T + j], w[SIN_T + j])
            w[OK + j] = 1.0 if found else -1.0
    for j in range(BLOCK):
        e = (w[EX + j], w[EY + j], w[EZ + j])
        x, y, z = blend(w[COS_A + j], port.axis, w[SIN_A + j], e)
        w[PX + j], w[PY + j], w[PZ + j] = x, y, z


@inline_kernel
def flat_directions_block(port: FlatParams, count: int, w: FloatArray) -> None:
    """Turn points into directions at the lens, in `dome`, all lanes of a block."""
    for j in range(BLOCK):
        height, rho, e = height_and_radius(port, w[PX + j], w[PY + j], w[PZ + j])
        w[FAR + j], w[SIN_T + j] = height, rho
        w[EX + j], w[EY + j], w[EZ + j] = e
        t, solved = three_halley_steps(port, height, rho, halley_start(port, height, rho))
        w[SIN_A + j] = t
        in_front = is_in_front(port, height)
        w[OK + j] = (1.0 if solved else 0.0) if in_front else -1.0
    for j in range(count):
        if w[OK + j] == 0.0:
            found, w[SIN_A + j] = bisect_flat(port, w[FAR + j], w[SIN_T + j])
            w[OK + j] = 1.0 if found else -1.0
    for j in range(BLOCK):
        t = w[SIN_A + j]
        c = 1.0 / math.sqrt(1.0 + t * t)
        w[COS_A + j], w[SIN_A + j] = c, t * c
        x, y, z = blend(c, port.normal, t * c, (w[EX + j], w[EY + j], w[EZ + j]))
        w[PX + j], w[PY + j], w[PZ + j] = x, y, z


port_directions_block = dispatch_by_class(
    {
        BareParams: bare_directions_block,
        DomeParams: dome_directions_block,
        FlatParams: flat_directions_block,
    }
)
"""`port_directions_block(port, count, w)`: points to directions at the lens, in `dome`."""


# Columns of the parameter Jacobian before the intrinsics: lens position 3, rotation 3, and those of
# the port, seven at most.
N_POSE = 6
N_PORT = len(FLAT_PARAMETERS)
# Rows of the scratch array after those of the projection: direction in `cam`, pixel, gradients of
# u and v by the direction in `dome`, then for u and for v the gradients by point, pose and port.
CX, CY, CZ, U, V, GUX, GUY, GUZ, GVX, GVY, GVZ = (
    (N_POINT_ROWS + i_row) * BLOCK for i_row in range(11)
)
N_GRADIENT = 3 + N_POSE + N_PORT
JU = (N_POINT_ROWS + 11) * BLOCK
JV = JU + N_GRADIENT * BLOCK
N_ROWS = N_POINT_ROWS + 11 + 2 * N_GRADIENT


@inline_kernel
def dome_gradients_block(port: DomeParams, w: FloatArray) -> None:
    """Write the gradients of u and v by point, lens position and dome, all lanes of a block."""
    spare = perpendicular(port.axis)
    for j in range(BLOCK):
        back = dome_derivative(
            port,
            angle_sines(port, w[FAR + j]),
            (w[FAR + j], w[COS_T + j], w[SIN_T + j]),
            across_axis(port.axis, (w[EX + j], w[EY + j], w[EZ + j]), spare),
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
def bare_gradients_block(_port: BareParams, w: FloatArray) -> None:
    """Write the gradients of u and v by point and lens position, all lanes of a block."""
    for row, g in ((JU, GUX), (JV, GVX)):
        for k in range(3):
            for j in range(BLOCK):
                w[row + k * BLOCK + j] = w[g + k * BLOCK + j]
                w[row + (3 + k) * BLOCK + j] = -w[g + k * BLOCK + j]


@inline_kernel
def flat_gradients_block(port: FlatParams, w: FloatArray) -> None:
    """Write the gradients of u and v by point, pose and port, all lanes of a block.

    The port goes with the camera: moving both by a step is moving the point by its opposite, and
    turning them by a small w turns the point p, seen from the lens, by -w: w . (gradient x p). A
    turn of the normal alone turns direction and point together, and the point back.
    """
    m = port.normal
    spare = perpendicular(m)
    for j in range(BLOCK):
        e = across_axis(m, (w[EX + j], w[EY + j], w[EZ + j]), spare)
        back = flat_derivative(port, w[FAR + j], e, (w[COS_A + j], w[SIN_A + j]))
        across = cross(m, e)
        d = (w[PX + j], w[PY + j], w[PZ + j])
        p = blend(w[FAR + j] + port.distance + port.thickness, m, w[SIN_T + j], e)
        for g, row in (
            ((w[GUX + j], w[GUY + j], w[GUZ + j]), JU),
            ((w[GVX + j], w[GVY + j], w[GVZ + j]), JV),
        ):
            g_u = dot(g, back.turn)
            by_reach, by_across = g_u * back.by_reach, dot(g, across) * back.across_point
            by_height = -by_reach * back.water_tangent
            by_point = combine(e, by_reach, m, by_height, across, by_across)
            by_turn = cross(by_point, p)
            by_normal = blend(1.0, cross(d, g), 1.0, by_turn)
            x, y, z = by_point
            w[row + j], w[row + BLOCK + j], w[row + 2 * BLOCK + j] = x, y, z
            w[row + 3 * BLOCK + j], w[row + 4 * BLOCK + j], w[row + 5 * BLOCK + j] = -x, -y, -z
            x, y, z = by_turn
            w[row + 6 * BLOCK + j], w[row + 7 * BLOCK + j], w[row + 8 * BLOCK + j] = x, y, z
            w[row + 9 * BLOCK + j] = g_u * back.by_distance
            w[row + 10 * BLOCK + j] = g_u * back.by_thickness
            w[row + 11 * BLOCK + j] = g_u * back.by_n_air
            w[row + 12 * BLOCK + j] = g_u * back.by_n_port
            w[row + 13 * BLOCK + j] = g_u * back.by_n_water
            w[row + 14 * BLOCK + j] = dot(by_normal, port.turn_x)
            w[row + 15 * BLOCK + j] = dot(by_normal, port.turn_y)


gradients_block = dispatch_by_class(
    {
        BareParams: bare_gradients_block,
        DomeParams: dome_gradients_block,
        FlatParams: flat_gradients_block,
    }
)
"""`gradients_block(port, w)`: the gradients of u and v by the point, and by the parameters but for
the rotation, all lanes of a block."""


@inline_kernel
def _rotation_gradients_block(_port: BareParams | DomeParams, w: FloatArray) -> None:
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
def _flat_rotation_gradients_block(_port: FlatParams, _w: FloatArray) -> None:
    """Leave the gradients by the rotation as `flat_gradients_block` wrote them."""


rotation_gradients_block = dispatch_by_class(
    {
        BareParams: _rotation_gradients_block,
        DomeParams: _rotation_gradients_block,
        FlatParams: _flat_rotation_gradients_block,
    }
)
"""`rotation_gradients_block(port, w)`: gradients by the camera's rotation, all lanes of a block."""


@inline_kernel
def rotate_to_cam(camera: CameraParams, x: float, y: float, z: float) -> Vec:
    """Rotate a direction from `dome` to `cam`."""
    r = camera.rotation
    return (
        r[0] * x + r[3] * y + r[6] * z,
        r[1] * x + r[4] * y + r[7] * z,
        r[2] * x + r[5] * y + r[8] * z,
    )


@inline_kernel
def load_points(points: FloatArray, start: int, count: int, w: FloatArray) -> None:
    """Write `count` points from row `start` into the scratch `w`."""
    for j in range(count):
        w[PX + j] = points[start + j, 0]
        w[PY + j] = points[start + j, 1]
        w[PZ + j] = points[start + j, 2]


@kernel
def project_all(
    camera: CameraParams, points: FloatArray, pixels: FloatArray, valid: BoolArray
) -> None:
    """Write pixels (N, 2) of points (N, 3)."""
    w = np.zeros(N_POINT_ROWS * BLOCK)
    for start in range(0, points.shape[0], BLOCK):
        count = min(BLOCK, points.shape[0] - start)
        load_points(points, start, count, w)
        port_directions_block(camera.port, count, w)
        for j in range(BLOCK):
            x, y, z = rotate_to_cam(camera, w[PX + j], w[PY + j], w[PZ + j])
            w[PX + j], w[PY + j], w[PZ + j] = x, y, z
        if camera.lens.fisheye:
            for j in range(count):
                seen, u, v, _, _ = fisheye_pixel(camera.lens, w[PX + j], w[PY + j], w[PZ + j])
                w[PX + j], w[PY + j] = u, v
                w[OK + j] = w[OK + j] if seen else -1.0
        else:
            for j in range(BLOCK):
                seen, u, v, _, _ = opencv_pixel(camera.lens, w[PX + j], w[PY + j], w[PZ + j])
                w[PX + j], w[PY + j] = u, v
                w[OK + j] = w[OK + j] if seen else -1.0
        for j in range(count):
            ok = w[OK + j] > 0.0
            valid[start + j] = ok
            pixels[start + j, 0] = w[PX + j] if ok else np.nan
            pixels[start + j, 1] = w[PY + j] if ok else np.nan


@inline_kernel
def _store_pixel_jacobian(
    camera: CameraParams, w: FloatArray, j: int, seen: tuple[bool, float, float, Vec, Vec]
) -> None:
    """Write the pixel and its gradients into lane j."""
    ok, w[U + j], w[V + j], u_d, v_d = seen
    w[GUX + j], w[GUY + j], w[GUZ + j] = rotate_to_dome(camera, u_d[0], u_d[1], u_d[2])
    w[GVX + j], w[GVY + j], w[GVZ + j] = rotate_to_dome(camera, v_d[0], v_d[1], v_d[2])
    w[OK + j] = w[OK + j] if ok else -1.0


@inline_kernel
def pixels_jacobian_block(camera: CameraParams, count: int, w: FloatArray) -> None:
    """Turn directions in `dome` into pixels and their gradients, all lanes of a block."""
    lens = camera.lens
    for j in range(BLOCK):
        x, y, z = rotate_to_cam(camera, w[PX + j], w[PY + j], w[PZ + j])
        w[CX + j], w[CY + j], w[CZ + j] = x, y, z
    if lens.fisheye:
        for j in range(count):
            seen = fisheye_pixel(lens, w[CX + j], w[CY + j], w[CZ + j])
            _store_pixel_jacobian(camera, w, j, seen)
        return
    for j in range(BLOCK):
        seen = opencv_pixel(lens, w[CX + j], w[CY + j], w[CZ + j])
        _store_pixel_jacobian(camera, w, j, seen)


@inline_kernel
def store_parameters(
    camera: CameraParams, n_before: int, start: int, count: int, w: FloatArray, jacobian: FloatArray
) -> None:
    """Write `count` parameter Jacobians from the scratch `w` to the rows from `start`."""
    for j in range(count):
        if w[OK + j] < 0.0:
            jacobian[start + j] = np.nan
            continue
        by_lens, x, y, z = jacobian[start + j, :, n_before:], w[CX + j], w[CY + j], w[CZ + j]
        by_lens[:] = 0.0
        if camera.lens.fisheye:
            _write_fisheye(camera.lens, x, y, z, by_lens)
        else:
            _write_opencv(camera.lens, x / z, y / z, by_lens)
        by_lens[0, 2] = by_lens[1, 3] = 1.0
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
        port_directions_block(camera.port, count, w)
        pixels_jacobian_block(camera, count, w)
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
            rotation_gradients_block(camera.port, w)
            store_parameters(camera, n_before, start, count, w, parameter_jacobian)
