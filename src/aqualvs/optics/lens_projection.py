"""Directions in `cam` to pixels, for both distortion models, and every derivative.

The scalar kernels leave their numbers meaningless where `valid` is False; the batch kernels behind
`Lens.pixels` write NaN there.
"""

import math

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.compiled import inline_kernel, kernel
from aqualvs.optics.lens_kernels import LensParams, Vector, fisheye_distort, opencv_distort


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


@kernel
def pixels_all(
    lens: LensParams, directions: FloatArray, pixels: FloatArray, valid: BoolArray
) -> None:
    """Write pixels (N, 2) of directions (N, 3)."""
    for i in range(directions.shape[0]):
        ok, u, v = lens_pixel(lens, directions[i, 0], directions[i, 1], directions[i, 2])
        valid[i] = ok
        pixels[i, 0] = u if ok else np.nan
        pixels[i, 1] = v if ok else np.nan


@kernel
def pixels_jacobian_all(
    lens: LensParams,
    directions: FloatArray,
    pixels: FloatArray,
    valid: BoolArray,
    jacobian: FloatArray,
) -> None:
    """Write pixels (N, 2) of directions (N, 3) with their Jacobians (N, 2, 3)."""
    for i in range(directions.shape[0]):
        ok, u, v, u_d, v_d = lens_pixel_jacobian(
            lens, directions[i, 0], directions[i, 1], directions[i, 2]
        )
        valid[i] = ok
        pixels[i, 0] = u if ok else np.nan
        pixels[i, 1] = v if ok else np.nan
        for k in range(3):
            jacobian[i, 0, k] = u_d[k] if ok else np.nan
            jacobian[i, 1, k] = v_d[k] if ok else np.nan


@inline_kernel
def write_intrinsics_jacobian(
    lens: LensParams, x: float, y: float, z: float, jacobian: FloatArray
) -> None:
    """Write d(u, v) / d(fx, fy, cx, cy, distortion...) of one direction into (2, 4 + n)."""
    jacobian[:] = 0.0
    if lens.fisheye:
        _write_fisheye(lens, x, y, z, jacobian)
    else:
        _write_opencv(lens, x / z, y / z, jacobian)
    jacobian[0, 2] = 1.0
    jacobian[1, 3] = 1.0


@inline_kernel
def _write_opencv(lens: LensParams, x: float, y: float, jacobian: FloatArray) -> None:
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


@kernel
def intrinsics_jacobian_all(
    lens: LensParams, directions: FloatArray, valid: BoolArray, jacobian: FloatArray
) -> None:
    """Write derivatives (N, 2, 4 + n) of pixels by fx, fy, cx, cy and n distortion coefficients."""
    for i in range(directions.shape[0]):
        if valid[i]:
            write_intrinsics_jacobian(
                lens, directions[i, 0], directions[i, 1], directions[i, 2], jacobian[i]
            )
        else:
            jacobian[i] = np.nan
