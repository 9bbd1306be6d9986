"""Back through the dome: from a point in the outer medium to the direction at the lens.

In concentric spheres n * rho * sin(incidence) is constant along a ray (Bouguer; Born and Wolf,
Principles of Optics, 3.2.1). With the lens at distance l from the centre and alpha the ray's angle
to the axis L/l, that constant is b = n_air l sin(alpha), and the ray reaches distance rho at the
polar angle

    theta(alpha) = alpha - asin(b/(n_air r)) + asin(b/(n_acrylic r))
                         - asin(b/(n_acrylic R)) + asin(b/(n_water R)) - asin(b/(n_water rho)).

Solving theta(alpha) = angle of the point takes a few Newton steps. No angle is ever formed: each
asin is the unit complex number (sqrt(1 - s^2), s), sums are products, and the residual is the sine
of theta - target. Sines are carried divided by b, so that nothing breaks when the lens sits in the
centre, where b vanishes.
"""

import math
from typing import NamedTuple

from aqualvs.geometry.compiled import inline_kernel, kernel
from aqualvs.optics.dome_forward import CameraParams
from aqualvs.optics.lens_params import Vector

# A last Newton step below this leaves an error of its square times a factor of order one.
STEP_SOLVED = 3e-8
# Rounds of three steps: one is enough for a lens that looks outwards, two for one at 95 % of the
# inner radius that looks sideways; what is left is searched for.
ROUNDS = 3
# Points this much (relative) inside the outer surface are still on it: rounding, not geometry.
SURFACE_SLACK = 1e-9
_TINY = 1e-300
# Parts of each branch of theta(alpha) that the slow search looks at for a crossing.
_SLICES = 32


class Surfaces(NamedTuple):
    """Sines of the five angles per unit of b: 1 / (n * radius), in the order of theta(alpha)."""

    q1: float
    q2: float
    q3: float
    q4: float
    q5: float


@inline_kernel
def surfaces_at(camera: CameraParams, inverse_rho: float) -> Surfaces:
    """Return the sines per unit of b for a point at distance 1 / inverse_rho from the centre."""
    return Surfaces(
        1.0 / (camera.n_air * camera.inner_radius),
        1.0 / (camera.n_acrylic * camera.inner_radius),
        1.0 / (camera.n_acrylic * camera.outer_radius),
        1.0 / (camera.n_water * camera.outer_radius),
        inverse_rho / camera.n_water,
    )


@inline_kernel
def cosine_of(sine_per_b: float, b: float) -> float:
    """Return the cosine of asin(b * sine_per_b); tiny and positive under total reflection."""
    s = b * sine_per_b
    return math.sqrt(max(1.0 - s * s, 1e-30))


@inline_kernel
def deflection(s: Surfaces, b: float) -> tuple[float, float, float, float]:
    """Return (cos D, sin D / b, p, q) of the angle D(b) = theta - alpha; dD/db is p / q."""
    c1, c2, c3 = cosine_of(s.q1, b), cosine_of(s.q2, b), cosine_of(s.q3, b)
    c4, c5 = cosine_of(s.q4, b), cosine_of(s.q5, b)
    bb = b * b
    inner_sin, inner_cos = s.q2 * c1 - s.q1 * c2, c1 * c2 + bb * s.q1 * s.q2
    outer_sin, outer_cos = s.q4 * c3 - s.q3 * c4, c3 * c4 + bb * s.q3 * s.q4
    dome_sin = inner_sin * outer_cos + inner_cos * outer_sin
    dome_cos = inner_cos * outer_cos - bb * inner_sin * outer_sin
    sine_per_b = dome_sin * c5 - dome_cos * s.q5
    cosine = dome_cos * c5 + bb * dome_sin * s.q5
    # The slope is a sum of +-q/c: over a common denominator it needs no division here.
    c12, c34 = c1 * c2, c3 * c4
    slope = c5 * (inner_sin * c34 + outer_sin * c12) - s.q5 * c12 * c34
    return cosine, sine_per_b, slope, c12 * c34 * c5


@inline_kernel
def newton_step(
    s: Surfaces,
    n_l: float,
    cos_target: float,
    sin_target: float,
    cos_alpha: float,
    sin_alpha: float,
) -> tuple[float, float, bool]:
    """Return (cos, sin) of alpha after one step towards theta(alpha) = target, and solved.

    Alpha turns by twice the arc tangent of half the step, which needs no square root and shares
    its division with the step. Solved is whether the step was below `STEP_SOLVED` and theta on the
    near side of the target. `n_l` is n_air times the decentring.
    """
    b = n_l * sin_alpha
    cos_d, sin_d_per_b, slope, scale = deflection(s, b)
    sin_d = b * sin_d_per_b
    # Direction of the target seen from alpha, then from theta.
    cos_t = cos_alpha * cos_target + sin_alpha * sin_target
    sin_t = cos_alpha * sin_target - sin_alpha * cos_target
    sine = sin_t * cos_d - cos_t * sin_d
    cosine = cos_t * cos_d + sin_t * sin_d
    run, half_rise = scale + n_l * cos_alpha * slope, 0.5 * sine * scale
    inverse = 1.0 / (run * run + half_rise * half_rise)
    turn_cos = (run * run - half_rise * half_rise) * inverse
    turn_sin = 2.0 * run * half_rise * inverse
    solved = (2.0 * abs(half_rise) < STEP_SOLVED * run) & (cosine > 0.0)
    return (
        cos_alpha * turn_cos - sin_alpha * turn_sin,
        sin_alpha * turn_cos + cos_alpha * turn_sin,
        solved,
    )


@inline_kernel
def paraxial_start(
    s: Surfaces, n_l: float, cos_target: float, sin_target: float
) -> tuple[float, float]:
    """Return (cos, sin) of alpha for the straight line from the lens's image to the point.

    The image is where rays near the axis seem to come from: dD/db at b = 0 moves the lens along
    the axis. Exact without refraction, and on the axis.
    """
    shift = n_l * (s.q2 - s.q1 + s.q4 - s.q3 - s.q5)
    along = cos_target + shift
    scale = 1.0 / math.sqrt(along * along + sin_target * sin_target)
    return along * scale, sin_target * scale


@inline_kernel
def three_steps(
    s: Surfaces, n_l: float, cos_target: float, sin_target: float, c: float, k: float
) -> tuple[float, float, bool]:
    """Return (cos alpha, sin alpha, solved) after three steps from (c, k), without branches."""
    c, k, _ = newton_step(s, n_l, cos_target, sin_target, c, k)
    c, k, _ = newton_step(s, n_l, cos_target, sin_target, c, k)
    c, k, solved = newton_step(s, n_l, cos_target, sin_target, c, k)
    return c, k, solved & (n_l * abs(k) * steepest(s) < 1.0)


@kernel
def solve_guarded(
    s: Surfaces, n_l: float, cos_target: float, sin_target: float
) -> tuple[bool, float, float]:
    """Solve theta(alpha) = target slowly and surely; returns (found, cos alpha, sin alpha).

    Where total reflection is possible, theta may turn back near the critical angle and several
    rays may reach a point. The one nearest to the forward axis is found; a point within a hair of
    the caustic, where two of them merge, may be refused.
    """
    target = math.atan2(sin_target, cos_target)
    sine = min(1.0 / max(n_l * steepest(s), _TINY), 1.0)
    bound = math.asin(sine)
    for start in (0.0, math.pi - bound):
        for i in range(_SLICES):
            low = start + bound * i / _SLICES
            high = start + bound * (i + 1) / _SLICES
            below = _theta(s, n_l, low) <= target
            if below == (_theta(s, n_l, high) < target):
                continue
            for _ in range(60):
                middle = 0.5 * (low + high)
                if (_theta(s, n_l, middle) <= target) == below:
                    low = middle
                else:
                    high = middle
            return True, math.cos(low), math.sin(low)
    return False, math.nan, math.nan


@inline_kernel
def steepest(s: Surfaces) -> float:
    """Return the largest sine per unit of b: the surface that reflects totally first."""
    return max(max(s.q1, s.q2), max(max(s.q3, s.q4), s.q5))


@inline_kernel
def _theta(s: Surfaces, n_l: float, alpha: float) -> float:
    cos_d, sin_d_per_b, _, _ = deflection(s, n_l * math.sin(alpha))
    return alpha + math.atan2(n_l * math.sin(alpha) * sin_d_per_b, cos_d)


@inline_kernel
def solve_alpha(
    s: Surfaces, n_l: float, cos_target: float, sin_target: float
) -> tuple[bool, float, float]:
    """Solve theta(alpha) = target; returns (found, cos alpha, sin alpha)."""
    c, k = paraxial_start(s, n_l, cos_target, sin_target)
    for _ in range(ROUNDS):
        c, k, solved = three_steps(s, n_l, cos_target, sin_target, c, k)
        if solved:
            return True, c, k
    return solve_guarded(s, n_l, cos_target, sin_target)


@inline_kernel
def polar_angle(
    camera: CameraParams, x: float, y: float, z: float
) -> tuple[float, float, float, Vector]:
    """Return (1/rho, cos, sin, e) of a point: cos a + sin e is its direction, a the lens axis.

    e is a unit vector, or zero for a point exactly on the axis.
    """
    a = camera.axis
    inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
    x, y, z = x * inverse, y * inverse, z * inverse
    cosine = x * a[0] + y * a[1] + z * a[2]
    ex, ey, ez = x - cosine * a[0], y - cosine * a[1], z - cosine * a[2]
    sine = math.sqrt(ex * ex + ey * ey + ez * ez)
    scale = 1.0 / max(sine, _TINY)
    return inverse, cosine, sine, (ex * scale, ey * scale, ez * scale)


@inline_kernel
def is_outside(camera: CameraParams, inverse_rho: float) -> bool:
    """Return whether a point at distance 1 / inverse_rho lies in the outer medium."""
    return (inverse_rho > 0.0) & (inverse_rho * camera.outer_radius <= 1.0 + SURFACE_SLACK)


@inline_kernel
def direction_to_point(
    camera: CameraParams, x: float, y: float, z: float
) -> tuple[bool, float, float, float]:
    """Return (valid, dx, dy, dz): the unit direction at the lens whose ray meets the point.

    Both in `dome`. Not valid for a point inside the dome or one that no ray reaches.
    """
    inverse_rho, cos_target, sin_target, e = polar_angle(camera, x, y, z)
    s = surfaces_at(camera, inverse_rho)
    n_l = camera.n_air * camera.decentring
    found, c, k = solve_alpha(s, n_l, cos_target, sin_target)
    a = camera.axis
    return (
        found and is_outside(camera, inverse_rho),
        c * a[0] + k * e[0],
        c * a[1] + k * e[1],
        c * a[2] + k * e[2],
    )
