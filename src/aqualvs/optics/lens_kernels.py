"""Scalar kernels of a lens: both distortion models of OpenCV, and their inverses.

`LensParams` holds a lens as compiled kernels take it: the rational pinhole model (`opencv`) or the
fisheye model (`fisheye`; Kannala and Brandt 2006). "Normalised" coordinates are x/z and y/z of a
direction in `cam`, "distorted" ones are those after the distortion: (u - cx)/fx and (v - cy)/fy.
"""

import functools
import math
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.compiled import inline_kernel, inner_kernel, python_of


class LensParams(NamedTuple):
    """Numbers of a lens; `Lens.params` makes it."""

    fisheye: bool  # Model: equidistant fisheye, else the rational model of OpenCV.
    # Pixels.
    fx: float
    fy: float
    cx: float
    cy: float
    # Distortion; the fisheye model uses k1 to k4.
    k1: float
    k2: float
    p1: float
    p2: float
    k3: float
    k4: float
    k5: float
    k6: float
    # Where the distortion stops being monotone: squared normalised radius (opencv), angle to the
    # axis in radians (fisheye).
    limit: float
    # Squared distorted radius that nothing inside `limit` exceeds.
    limit_distorted: float


_STEPS_AT_MOST = 60


@inline_kernel
def fisheye_distort(lens: LensParams, theta: float) -> tuple[float, float]:
    """Return the distorted angle and its derivative with respect to theta."""
    q = theta * theta
    value = theta * (1.0 + q * (lens.k1 + q * (lens.k2 + q * (lens.k3 + q * lens.k4))))
    slope = 1.0 + q * (
        3.0 * lens.k1 + q * (5.0 * lens.k2 + q * (7.0 * lens.k3 + q * 9.0 * lens.k4))
    )
    return value, slope


@inline_kernel
def fisheye_undistort(lens: LensParams, radius: float) -> tuple[bool, float, float]:
    """Solve fisheye_distort(theta) = radius; return (valid, theta, slope there).

    Newton's method kept inside a bracket: the map is monotone up to `limit`.
    """
    low, high = 0.0, lens.limit
    if not radius * radius < lens.limit_distorted:
        return False, 0.0, 1.0
    theta = min(radius, 0.5 * high)
    # A Newton step below this leaves an error of its square.
    step_solved = 1e-9
    for _ in range(_STEPS_AT_MOST):
        value, slope = fisheye_distort(lens, theta)
        error = radius - value
        if error > 0.0:
            low = theta
        else:
            high = theta
        following = theta + error / slope
        if not low <= following <= high:
            following = 0.5 * (low + high)
        done = abs(following - theta) <= step_solved
        theta = following
        if done:
            break
    value, slope = fisheye_distort(lens, theta)
    return True, theta, slope


def fisheye_limits(lens: LensParams) -> tuple[float, float]:
    """Return `LensParams.limit`, at most pi, and `limit_distorted`."""
    distort = python_of(fisheye_distort)
    inside, outside = 0.0, math.pi
    for i_step in range(1, 1025):
        outside = math.pi * i_step / 1024.0
        if not distort(lens, outside)[1] > 0.0:
            break
        inside = outside
    while outside - inside > 1e-15:
        middle = 0.5 * (inside + outside)
        if not inside < middle < outside:
            break
        if distort(lens, middle)[1] > 0.0:
            inside = middle
        else:
            outside = middle
    widest, _ = distort(lens, inside)
    return inside, widest * widest


# The last of three steps uses the slopes of the second, so its error is the product of the last
# two: a step below this leaves less than a rounding.
STEP_SOLVED = 1e-11
# Rounds of three steps: one is enough for ordinary lenses, two for the corners of wide ones.
ROUNDS = 2
_HALVINGS_AT_MOST = 40
# Residual, in distorted coordinates near 1, at which a guarded solution counts: some roundings.
_RESIDUAL_SOLVED = 1e-14
# Of the search for the limit of a distortion: directions (x, y) from the image centre; tangents of
# the first steps, a quarter of a degree each; parts into which the step that holds it is divided.
_PHI = 2.0 * np.pi * np.arange(32) / 32
_SPOKES = np.array([np.cos(_PHI), np.sin(_PHI)])
_TANGENTS = np.tan(np.arange(360) * np.pi / 720.0)
_DIVISIONS = 64


@inline_kernel
def opencv_distort(
    lens: LensParams, x: float, y: float
) -> tuple[float, float, float, float, float]:
    """Return the distorted (xd, yd) and the symmetric Jacobian (j_xx, j_xy, j_yy) at (x, y)."""
    q = x * x + y * y
    numerator = 1.0 + q * (lens.k1 + q * (lens.k2 + q * lens.k3))
    numerator_slope = lens.k1 + q * (2.0 * lens.k2 + q * 3.0 * lens.k3)
    inverse = 1.0 / (1.0 + q * (lens.k4 + q * (lens.k5 + q * lens.k6)))
    denominator_slope = lens.k4 + q * (2.0 * lens.k5 + q * 3.0 * lens.k6)
    f = numerator * inverse
    two_slope = 2.0 * (numerator_slope - f * denominator_slope) * inverse
    cross = 2.0 * (lens.p1 * y + lens.p2 * x)
    xd = x * (f + cross) + lens.p2 * q
    yd = y * (f + cross) + lens.p1 * q
    j_xx = f + x * x * two_slope + cross + 4.0 * lens.p2 * x
    j_xy = x * y * two_slope + 2.0 * (lens.p1 * x + lens.p2 * y)
    j_yy = f + y * y * two_slope + cross + 4.0 * lens.p1 * y
    return xd, yd, j_xx, j_xy, j_yy


@inline_kernel
def opencv_pull(lens: LensParams, xd: float, yd: float, x: float, y: float) -> tuple[float, float]:
    """Return (distort(x, y) - (xd, yd)) times the denominator of the rational model."""
    q = x * x + y * y
    numerator = 1.0 + q * (lens.k1 + q * (lens.k2 + q * lens.k3))
    denominator = 1.0 + q * (lens.k4 + q * (lens.k5 + q * lens.k6))
    cross = 2.0 * (lens.p1 * y + lens.p2 * x)
    return (
        x * numerator + (cross * x + lens.p2 * q - xd) * denominator,
        y * numerator + (cross * y + lens.p1 * q - yd) * denominator,
    )


@inline_kernel
def _newton(
    lens: LensParams, xd: float, yd: float, x: float, y: float
) -> tuple[float, float, float, float, float, float]:
    """Return (x, y) after a Newton step on `opencv_pull` and the inverse slopes it used."""
    q = x * x + y * y
    numerator = 1.0 + q * (lens.k1 + q * (lens.k2 + q * lens.k3))
    denominator = 1.0 + q * (lens.k4 + q * (lens.k5 + q * lens.k6))
    a = 2.0 * lens.k1 + q * (4.0 * lens.k2 + q * 6.0 * lens.k3)
    b = 2.0 * lens.k4 + q * (4.0 * lens.k5 + q * 6.0 * lens.k6)
    cross = 2.0 * (lens.p1 * y + lens.p2 * x)
    tx, ty = cross * x + lens.p2 * q - xd, cross * y + lens.p1 * q - yd
    gx, gy = x * numerator + tx * denominator, y * numerator + ty * denominator
    ax, ay = a * x + b * tx, a * y + b * ty
    shear = 2.0 * (lens.p1 * x + lens.p2 * y) * denominator
    g_xx = numerator + x * ax + (cross + 4.0 * lens.p2 * x) * denominator
    g_yy = numerator + y * ay + (cross + 4.0 * lens.p1 * y) * denominator
    g_xy, g_yx = y * ax + shear, x * ay + shear
    inverse = 1.0 / (g_xx * g_yy - g_xy * g_yx)
    i_xx, i_xy, i_yx, i_yy = g_yy * inverse, -g_xy * inverse, -g_yx * inverse, g_xx * inverse
    return x - (i_xx * gx + i_xy * gy), y - (i_yx * gx + i_yy * gy), i_xx, i_xy, i_yx, i_yy


@inline_kernel
def opencv_undistort_start(lens: LensParams, xd: float, yd: float) -> tuple[float, float]:
    """Return (xd, yd) without its own radial factor, where that is not far from one."""
    q = xd * xd + yd * yd
    numerator = 1.0 + q * (lens.k1 + q * (lens.k2 + q * lens.k3))
    denominator = 1.0 + q * (lens.k4 + q * (lens.k5 + q * lens.k6))
    scale = denominator / numerator if numerator > 0.5 * denominator else 1.0
    return xd * scale, yd * scale


@inline_kernel
def opencv_undistort_round(
    lens: LensParams, xd: float, yd: float, x: float, y: float
) -> tuple[float, float, bool]:
    """Return (x, y, solved) after two Newton steps and one more with the slopes of the second.

    No branches. Solved means to machine precision and inside the limit.
    """
    x, y, _, _, _, _ = _newton(lens, xd, yd, x, y)
    x, y, i_xx, i_xy, i_yx, i_yy = _newton(lens, xd, yd, x, y)
    gx, gy = opencv_pull(lens, xd, yd, x, y)
    sx, sy = i_xx * gx + i_xy * gy, i_yx * gx + i_yy * gy
    x, y = x - sx, y - sy
    return x, y, (abs(sx) + abs(sy) < STEP_SOLVED) & (x * x + y * y < lens.limit)


@inner_kernel
def opencv_undistort_guarded(lens: LensParams, xd: float, yd: float) -> tuple[bool, float, float]:
    """Solve distort(x, y) = (xd, yd) inside the limit by damped steps; return (found, x, y).

    Newton's method from the image centre; every step that leaves the limit or does not lower the
    residual is halved. Slow, but safe.
    """
    x, y = 0.0, 0.0
    residual = math.hypot(xd, yd)
    if not residual * residual <= lens.limit_distorted or residual == math.inf:
        return False, x, y
    solved = _RESIDUAL_SOLVED * (1.0 + residual)
    ax, ay, j_xx, j_xy, j_yy = opencv_distort(lens, x, y)
    for _ in range(_STEPS_AT_MOST):
        inverse = 1.0 / (j_xx * j_yy - j_xy * j_xy)
        ex, ey = xd - ax, yd - ay
        sx, sy = (j_yy * ex - j_xy * ey) * inverse, (j_xx * ey - j_xy * ex) * inverse
        better = False
        for _half in range(_HALVINGS_AT_MOST):
            tx, ty = x + sx, y + sy
            if tx * tx + ty * ty < lens.limit:
                ax, ay, j_xx, j_xy, j_yy = opencv_distort(lens, tx, ty)
                trial = math.hypot(xd - ax, yd - ay)
                better = trial < residual
                if better or residual <= solved:
                    break
            sx, sy = 0.5 * sx, 0.5 * sy
        if not better:
            break
        x, y, residual = tx, ty, trial
    return residual <= solved, x, y


def opencv_limits(lens: LensParams) -> tuple[float, float]:
    """Return `LensParams.limit` and `limit_distorted`.

    The first is the squared radius of the largest disc round the image centre with a positive
    Jacobian determinant, searched along spokes in steps of a quarter of a degree, then finer ones.
    """
    # Calibrations of lasers and derivatives by a rig's numbers make many lenses of one distortion.
    return _limits_of_distortion(lens._replace(fx=1.0, fy=1.0, cx=0.0, cy=0.0))


@functools.lru_cache(maxsize=64)
def _limits_of_distortion(lens: LensParams) -> tuple[float, float]:
    radii, spokes = _TANGENTS, _SPOKES
    # Each search divides the step that holds the limit; the last one, between neighbouring numbers.
    while True:
        # Beyond the limit the model may have poles.
        with np.errstate(all="ignore"):
            points = spokes[:, :, None] * radii[1:]
            _, _, j_xx, j_xy, j_yy = python_of(opencv_distort)(lens, *points)
            # Where the Jacobian is positive definite: beyond two sign changes the determinant is
            # positive again, the trace is not.
            monotone = (j_xx * j_yy - j_xy * j_xy > 0.0) & (j_xx + j_yy > 0.0)
        if monotone.all():
            return math.inf, math.inf
        first = int(np.argmin(monotone.all(axis=0)))
        inside, outside = radii[first : first + 2].tolist()
        if not inside < 0.5 * (inside + outside) < outside:
            break
        radii, spokes = np.linspace(inside, outside, _DIVISIONS + 1), spokes[:, ~monotone[:, first]]
    xd, yd, _, _, _ = python_of(opencv_distort)(lens, *(inside * _SPOKES))
    # The distorted radius between two spokes may exceed that on both, by tangential terms.
    between_spokes = 1.02
    return inside * inside, between_spokes * float((xd * xd + yd * yd).max())


@inline_kernel
def fisheye_direction(lens: LensParams, xd: float, yd: float) -> tuple[bool, float, float, float]:
    """Return (valid, x, y, z): the unit direction of distorted coordinates."""
    radius = math.sqrt(xd * xd + yd * yd)
    valid, theta, _ = fisheye_undistort(lens, radius)
    scale = math.sin(theta) / radius if radius > 0.0 else 1.0
    return valid, xd * scale, yd * scale, math.cos(theta)
