"""Scalar kernels of a lens of either model, with exact Jacobians."""

import math

from aqualvs.geometry.compiled import inline_kernel
from aqualvs.optics.lens_fisheye import fisheye_distort, fisheye_undistort
from aqualvs.optics.lens_opencv import opencv_distort, opencv_undistort
from aqualvs.optics.lens_params import LensParams, Vector


@inline_kernel
def fisheye_direction(lens: LensParams, xd: float, yd: float) -> tuple[bool, float, float, float]:
    """Return (valid, x, y, z): the unit direction of distorted coordinates."""
    radius = math.sqrt(xd * xd + yd * yd)
    valid, theta, _ = fisheye_undistort(lens, radius)
    scale = math.sin(theta) / radius if radius > 0.0 else 1.0
    return valid, xd * scale, yd * scale, math.cos(theta)


@inline_kernel
def lens_direction(lens: LensParams, u: float, v: float) -> tuple[bool, float, float, float]:
    """Return (valid, x, y, z): the unit direction in `cam` that the pixel (u, v) sees."""
    xd, yd = (u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy
    if lens.fisheye:
        return fisheye_direction(lens, xd, yd)
    valid, x, y = opencv_undistort(lens, xd, yd)
    z = 1.0 / math.sqrt(1.0 + x * x + y * y)
    return valid, x * z, y * z, z


@inline_kernel
def lens_direction_jacobian(
    lens: LensParams, u: float, v: float
) -> tuple[bool, Vector, Vector, Vector]:
    """Return (valid, direction, its derivative along u, its derivative along v)."""
    valid, dx, dy, dz = lens_direction(lens, u, v)
    if lens.fisheye:
        xd, yd = (u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy
        radius = math.sqrt(xd * xd + yd * yd)
        sine = math.sqrt(dx * dx + dy * dy)
        _, slope = fisheye_distort(lens, math.atan2(sine, dz))
        across = sine / radius if radius > 0.0 else 1.0
        ex = xd / radius if radius > 0.0 else 1.0
        ey = yd / radius if radius > 0.0 else 0.0
        along = dz / slope
        xx = across + (along - across) * ex * ex
        xy = (along - across) * ex * ey
        yy = across + (along - across) * ey * ey
        zx, zy = -sine / slope * ex, -sine / slope * ey
        return (
            valid,
            (dx, dy, dz),
            (xx / lens.fx, xy / lens.fx, zx / lens.fx),
            (xy / lens.fy, yy / lens.fy, zy / lens.fy),
        )
    x, y = dx / dz, dy / dz
    _, _, j_xx, j_xy, j_yy = opencv_distort(lens, x, y)
    inverse = 1.0 / (j_xx * j_yy - j_xy * j_xy)
    x_u, y_u = j_yy * inverse / lens.fx, -j_xy * inverse / lens.fx
    x_v, y_v = -j_xy * inverse / lens.fy, j_xx * inverse / lens.fy
    z_u = -dz * dz * (dx * x_u + dy * y_u)
    z_v = -dz * dz * (dx * x_v + dy * y_v)
    return (
        valid,
        (dx, dy, dz),
        (dz * x_u + x * z_u, dz * y_u + y * z_u, z_u),
        (dz * x_v + x * z_v, dz * y_v + y * z_v, z_v),
    )


@inline_kernel
def opencv_pixel(lens: LensParams, x: float, y: float, z: float) -> tuple[bool, float, float]:
    """Return (valid, u, v) of a direction of any length, without branches."""
    inverse = 1.0 / z
    xn, yn = x * inverse, y * inverse
    xd, yd, _, _, _ = opencv_distort(lens, xn, yn)
    valid = (z > 0.0) & (xn * xn + yn * yn < lens.limit)
    return valid, lens.fx * xd + lens.cx, lens.fy * yd + lens.cy


@inline_kernel
def fisheye_pixel(lens: LensParams, x: float, y: float, z: float) -> tuple[bool, float, float]:
    """Return (valid, u, v) of a direction of any length."""
    radius = math.sqrt(x * x + y * y)
    theta = math.atan2(radius, z)
    value, _ = fisheye_distort(lens, theta)
    scale = value / radius if radius > 0.0 else 1.0 / z
    valid = theta < lens.limit and 0.0 < x * x + y * y + z * z < math.inf
    return valid, lens.fx * x * scale + lens.cx, lens.fy * y * scale + lens.cy


@inline_kernel
def lens_pixel(lens: LensParams, x: float, y: float, z: float) -> tuple[bool, float, float]:
    """Return (valid, u, v): where the direction (x, y, z) in `cam`, of any length, is seen."""
    if lens.fisheye:
        return fisheye_pixel(lens, x, y, z)
    return opencv_pixel(lens, x, y, z)


@inline_kernel
def opencv_pixel_jacobian(
    lens: LensParams, x: float, y: float, z: float
) -> tuple[bool, float, float, Vector, Vector]:
    """Return `lens_pixel_jacobian` of the opencv model, without branches."""
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
def fisheye_pixel_jacobian(
    lens: LensParams, x: float, y: float, z: float
) -> tuple[bool, float, float, Vector, Vector]:
    """Return `lens_pixel_jacobian` of the fisheye model."""
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


@inline_kernel
def lens_pixel_jacobian(
    lens: LensParams, x: float, y: float, z: float
) -> tuple[bool, float, float, Vector, Vector]:
    """Return (valid, u, v, gradient of u, gradient of v) with respect to the direction."""
    if lens.fisheye:
        return fisheye_pixel_jacobian(lens, x, y, z)
    return opencv_pixel_jacobian(lens, x, y, z)
