"""The distortion of OpenCV's fisheye model (Kannala and Brandt 2006) and its inverse."""

import math

from aqualvs.geometry.compiled import inline_kernel, kernel
from aqualvs.optics.lens_params import LensParams

_STEPS_AT_MOST = 60
# A Newton step below this leaves an error of its square.
_STEP_SOLVED = 1e-9


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
    """Solve fisheye_distort(theta) = radius; returns (valid, theta, slope there).

    Newton's method kept inside a bracket: the map is monotone up to `limit`.
    """
    low, high = 0.0, lens.limit
    if not radius * radius < lens.limit_distorted:
        return False, 0.0, 1.0
    theta = min(radius, 0.5 * high)
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
        done = abs(following - theta) <= _STEP_SOLVED
        theta = following
        if done:
            break
    value, slope = fisheye_distort(lens, theta)
    return True, theta, slope


@kernel
def fisheye_limits(lens: LensParams) -> tuple[float, float]:
    """Return `LensParams.limit`, at most pi, and `limit_distorted`."""
    inside, outside = 0.0, math.pi
    for i_step in range(1, 1025):
        outside = math.pi * i_step / 1024.0
        if not fisheye_distort(lens, outside)[1] > 0.0:
            break
        inside = outside
    while outside - inside > 1e-15:
        middle = 0.5 * (inside + outside)
        if not inside < middle < outside:
            break
        if fisheye_distort(lens, middle)[1] > 0.0:
            inside = middle
        else:
            outside = middle
    widest, _ = fisheye_distort(lens, inside)
    return inside, widest * widest
