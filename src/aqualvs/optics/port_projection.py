"""Projection through a port: the direction at the lens whose ray meets a point, and derivatives.

**Dome.** In concentric spheres n * rho * sin(incidence) is constant along a ray (Bouguer; Born and
Wolf, Principles of Optics, 3.2.1). With the lens at distance l from the centre and alpha the ray's
angle to the axis L/l, that constant is b = n_air l sin(alpha), and the ray reaches distance rho at
the polar angle

    theta(alpha) = alpha - asin(b/(n_air r)) + asin(b/(n_acrylic r))
                         - asin(b/(n_acrylic R)) + asin(b/(n_water R)) - asin(b/(n_water rho)).

Solving theta(alpha) = angle of the point takes a few Newton steps. No angle is ever formed: each
asin is the unit complex number (sqrt(1 - s^2), s), sums are products, and the residual is the sine
of theta - target. Sines are carried divided by b, so that nothing breaks when the lens is in the
centre, where b vanishes.

The derivatives of the projection follow from the implicit function theorem (`dome_derivative`).
With u the unit vector along which the direction turns as alpha grows, m the normal of the plane of
refraction, and D = theta - alpha, the derivative of the direction is

    by the point   u (u_target / rho - theta_rho p)^T / theta_alpha + (k / rho) m m^T
    by the lens    (n_air dD/db / theta_alpha) u u^T + n_air (sin D / b) k m m^T
    by any other   -u theta_x / theta_alpha

where k = sin alpha / sin theta, which becomes 1 / theta_alpha on the axis. No term divides by the
decentring.

**Flat port.** It stands at a distance D along its normal m in front of the lens, and has the
thickness T. Every ray lies in a plane that contains m through the lens (Agrawal et al., A theory of
multi-layer flat refractive geometry, CVPR 2012), and n sin(incidence) is constant along it. With t
the tangent of the ray's angle alpha to m at the lens and k = n_air / n for each medium, the light
that meets a point at the height h above the outer face passes the distance from the axis

    rho(t) = D t + T g + h w,    g, w = k t / sqrt(1 + (1 - k^2) t^2) with k of the port, the water.

For k < 1 all terms grow and bend downwards; Halley's steps for rho(t) = rho of the point converge
from the straight line of the paraxial image, within three steps up to 60 degrees.

With e the unit vector from the axis to the point, p the point seen from the lens, u the unit vector
along which the direction d turns as alpha grows, and m' = m x e, the derivative of d is

    by the point        u (e - w m)^T alpha_rho + (sin alpha / rho) m' m'^T
    by D, T, an index   -u rho_x alpha_rho
    by a turn of m      that of turning point and direction, less that of the point

where alpha_rho = cos^2 alpha / rho'(t), and t / rho is rho's own factor of t: nothing is divided by
the distance from the axis.
"""

import math
from typing import NamedTuple

from aqualvs.geometry.compiled import inline_kernel, inner_kernel
from aqualvs.geometry.linear_algebra import Vec, cross, dot
from aqualvs.optics.dome import DomeParams
from aqualvs.optics.flat_port import FlatParams

# A last Newton step below this leaves an error of its square times a factor of order one.
STEP_SOLVED = 3e-8
# Rounds of three steps: one is enough for a lens that looks outwards, two for one at 95 % of the
# inner radius that looks sideways; the remaining cases are searched (`bisect_dome`).
ROUNDS = 3
# Points this much (relative) inside the outer surface are still on it: rounding, not geometry.
SURFACE_SLACK = 1e-9
_TINY = 1e-300


@inline_kernel
def perpendicular(a: Vec) -> Vec:
    """Return a unit vector perpendicular to the unit vector a."""
    if abs(a[0]) < 0.6:
        length = math.sqrt(a[1] * a[1] + a[2] * a[2])
        return 0.0, -a[2] / length, a[1] / length
    length = math.sqrt(a[0] * a[0] + a[1] * a[1])
    return -a[1] / length, a[0] / length, 0.0


@inline_kernel
def blend(p: float, a: Vec, q: float, b: Vec) -> Vec:
    """Return p a + q b."""
    return p * a[0] + q * b[0], p * a[1] + q * b[1], p * a[2] + q * b[2]


@inline_kernel
def across_axis(axis: Vec, e: Vec, spare: Vec) -> Vec:
    """Return e made exactly perpendicular to the axis, or `spare` where e is parallel to it.

    Near the axis e is the quotient of two rounding errors. Any perpendicular vector serves there:
    the derivatives do not depend on the azimuth.
    """
    along = dot(e, axis)
    e = blend(1.0, e, -along, axis)
    norm_sq = dot(e, e)
    good = norm_sq > 0.25
    scale = 1.0 / math.sqrt(norm_sq if good else 1.0)
    return (
        e[0] * scale if good else spare[0],
        e[1] * scale if good else spare[1],
        e[2] * scale if good else spare[2],
    )


class AngleSines(NamedTuple):
    """Sines of the five angles per unit of b: 1 / (n * radius), in the order of theta(alpha)."""

    q1: float
    q2: float
    q3: float
    q4: float
    q5: float


@inline_kernel
def angle_sines(port: DomeParams, inverse_rho: float) -> AngleSines:
    """Return the sines per unit of b for a point at distance 1 / inverse_rho from the centre."""
    return AngleSines(
        1.0 / (port.n_air * port.inner_radius),
        1.0 / (port.n_acrylic * port.inner_radius),
        1.0 / (port.n_acrylic * port.outer_radius),
        1.0 / (port.n_water * port.outer_radius),
        inverse_rho / port.n_water,
    )


@inline_kernel
def cosine_of(sine_per_b: float, b: float) -> float:
    """Return the cosine of asin(b * sine_per_b); tiny and positive under total reflection."""
    s = b * sine_per_b
    return math.sqrt(max(1.0 - s * s, 1e-30))


@inline_kernel
def deflection(s: AngleSines, b: float) -> tuple[float, float, float, float]:
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
    s: AngleSines,
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
def newton_start(
    s: AngleSines, n_l: float, cos_target: float, sin_target: float
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
def three_newton_steps(
    s: AngleSines, n_l: float, cos_target: float, sin_target: float, c: float, k: float
) -> tuple[float, float, bool]:
    """Return (cos alpha, sin alpha, solved) after three steps from (c, k), without branches."""
    c, k, _ = newton_step(s, n_l, cos_target, sin_target, c, k)
    c, k, _ = newton_step(s, n_l, cos_target, sin_target, c, k)
    c, k, solved = newton_step(s, n_l, cos_target, sin_target, c, k)
    return c, k, solved & (n_l * abs(k) * largest_sine(s) < 1.0)


@inner_kernel
def bisect_dome(
    s: AngleSines, n_l: float, cos_target: float, sin_target: float
) -> tuple[bool, float, float]:
    """Solve theta(alpha) = target by bracketing; return (found, cos alpha, sin alpha).

    Slow, but safe. Where total reflection is possible, theta may turn back near the critical angle
    and several rays may reach a point. The one nearest to the forward axis is found; a point very
    close to the caustic, where two of them merge, may be refused.
    """
    target = math.atan2(sin_target, cos_target)
    sine = min(1.0 / max(n_l * largest_sine(s), _TINY), 1.0)
    bound = math.asin(sine)
    # Parts of each branch of theta(alpha) that the slow search looks at for a crossing.
    slices = 32
    for start in (0.0, math.pi - bound):
        for i in range(slices):
            low = start + bound * i / slices
            high = start + bound * (i + 1) / slices
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
def largest_sine(s: AngleSines) -> float:
    """Return the largest sine per unit of b: the surface that reflects totally first."""
    return max(max(s.q1, s.q2), max(max(s.q3, s.q4), s.q5))


@inline_kernel
def _theta(s: AngleSines, n_l: float, alpha: float) -> float:
    cos_d, sin_d_per_b, _, _ = deflection(s, n_l * math.sin(alpha))
    return alpha + math.atan2(n_l * math.sin(alpha) * sin_d_per_b, cos_d)


@inline_kernel
def polar_angle(port: DomeParams, x: float, y: float, z: float) -> tuple[float, float, float, Vec]:
    """Return (1/rho, cos, sin, e) of a point: cos a + sin e is its direction, a the lens axis.

    e is a unit vector, or zero for a point exactly on the axis.
    """
    a = port.axis
    inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
    x, y, z = x * inverse, y * inverse, z * inverse
    cosine = x * a[0] + y * a[1] + z * a[2]
    ex, ey, ez = x - cosine * a[0], y - cosine * a[1], z - cosine * a[2]
    sine = math.sqrt(ex * ex + ey * ey + ez * ez)
    scale = 1.0 / max(sine, _TINY)
    return inverse, cosine, sine, (ex * scale, ey * scale, ez * scale)


@inline_kernel
def is_outside(port: DomeParams, inverse_rho: float) -> bool:
    """Return whether a point at distance 1 / inverse_rho lies in the outer medium."""
    return (inverse_rho > 0.0) & (inverse_rho * port.outer_radius <= 1.0 + SURFACE_SLACK)


class DomeDerivative(NamedTuple):
    """Terms of the derivatives of a solved projection."""

    # u and m of the module's docstring.
    turn: Vec
    normal: Vec
    # d alpha / d point, 1/m.
    along_point: Vec
    # Factor of m m^T for the point, 1/m.
    across_point: float
    # Factors of u u^T and m m^T for the lens position, 1/m.
    along_lens: float
    across_lens: float
    # d alpha by inner radius and thickness, 1/m.
    by_inner: float
    by_thickness: float
    # d alpha by the indices.
    by_n_air: float
    by_n_acrylic: float
    by_n_water: float


@inline_kernel
def dome_derivative(
    port: DomeParams,
    s: AngleSines,
    target: tuple[float, float, float],
    e: Vec,
    solution: tuple[float, float],
) -> DomeDerivative:
    """Return the derivatives at a solution, without branches.

    Parameters
    ----------
    s : AngleSines
        Of the point.
    target : (float, float, float)
        1/rho, cos and sin of the point as `polar_angle` gives them.
    e : vector
        Unit vector from the axis to the point, perpendicular to the axis.
    solution : (float, float)
        (cos alpha, sin alpha).
    """
    (inverse_rho, cos_t, sin_t), (c, k) = target, solution
    n_l = port.n_air * port.decentring
    b = n_l * k
    _, sin_d_per_b, slope, scale = deflection(s, b)
    slope = slope / scale
    inverse = 1.0 / (1.0 + n_l * c * slope)
    by_rho = inverse * inverse_rho
    # Sine of the polar angle below which sin alpha / sin theta is taken as its limit: the limit is
    # off by the square of this, the quotient by a rounding over it.
    on_axis = 1e-5
    ratio = k / max(sin_t, on_axis) if sin_t > on_axis else inverse
    t1, t2 = b * s.q1 / cosine_of(s.q1, b), b * s.q2 / cosine_of(s.q2, b)
    t3, t4 = b * s.q3 / cosine_of(s.q3, b), b * s.q4 / cosine_of(s.q4, b)
    t5 = b * s.q5 / cosine_of(s.q5, b)
    by_outer = (t4 - t3) / port.outer_radius * inverse
    axis = port.axis
    return DomeDerivative(
        turn=blend(-k, axis, c, e),
        normal=cross(axis, e),
        along_point=blend((-sin_t - t5 * cos_t) * by_rho, axis, (cos_t - t5 * sin_t) * by_rho, e),
        across_point=ratio * inverse_rho,
        along_lens=port.n_air * slope * inverse,
        across_lens=port.n_air * sin_d_per_b * ratio,
        by_inner=(t2 - t1) / port.inner_radius * inverse + by_outer,
        by_thickness=by_outer,
        by_n_air=(t3 - t2 + t5 - t4) / port.n_air * inverse,
        by_n_acrylic=(t2 - t3) / port.n_acrylic * inverse,
        by_n_water=(t4 - t5) / port.n_water * inverse,
    )


@inline_kernel
def height_and_radius(port: FlatParams, x: float, y: float, z: float) -> tuple[float, float, Vec]:
    """Return (h, rho, e) of a point: its height above the outer face, and where it is beside m.

    e is a unit vector, or zero for a point exactly on the axis.
    """
    m = port.normal
    x, y, z = x - port.centre[0], y - port.centre[1], z - port.centre[2]
    along = x * m[0] + y * m[1] + z * m[2]
    ex, ey, ez = x - along * m[0], y - along * m[1], z - along * m[2]
    rho = math.sqrt(ex * ex + ey * ey + ez * ez)
    scale = 1.0 / max(rho, _TINY)
    return along - port.distance - port.thickness, rho, (ex * scale, ey * scale, ez * scale)


@inline_kernel
def is_in_front(port: FlatParams, height: float) -> bool:
    """Return whether a point at this height above the outer face lies in the outer medium."""
    return height >= -SURFACE_SLACK * (port.distance + port.thickness)


@inline_kernel
def layer(k: float, t: float) -> tuple[float, float]:
    """Return (1 + (1 - k^2) t^2, its inverse square root); tiny under total reflection."""
    square = max(1.0 + (1.0 - k * k) * t * t, 1e-30)
    return square, 1.0 / math.sqrt(square)


@inline_kernel
def halley_start(port: FlatParams, height: float, rho: float) -> float:
    """Return t of the straight line from the lens's image to the point, exact near the axis.

    Or, far from the axis, the least t with which the air alone can bridge what glass and water
    cannot: the larger of two lower bounds.
    """
    glass, water = port.n_air / port.n_port, port.n_air / port.n_water
    start = rho / (port.distance + port.thickness * glass + height * water)
    rest = rho - port.thickness * _critical_tangent(glass) - height * _critical_tangent(water)
    return max(start, rest / port.distance)


@inline_kernel
def _critical_tangent(k: float) -> float:
    """Return the tangent of the critical angle, 1e30 where there is none."""
    return k / math.sqrt(max(1.0 - k * k, 1e-60))


@inline_kernel
def three_halley_steps(port: FlatParams, height: float, rho: float, t: float) -> tuple[float, bool]:
    """Return (t, solved) after three of Halley's steps towards rho(t) = rho, without branches."""
    t, _ = halley_step(port, height, rho, t)
    t, _ = halley_step(port, height, rho, t)
    return halley_step(port, height, rho, t)


@inline_kernel
def halley_step(port: FlatParams, height: float, rho: float, t: float) -> tuple[float, bool]:
    """Return t after one of Halley's steps, and whether that step was the last needed."""
    glass, water = port.n_air / port.n_port, port.n_air / port.n_water
    square_g, inverse_g = layer(glass, t)
    square_w, inverse_w = layer(water, t)
    g, w = port.thickness * glass * inverse_g, height * water * inverse_w
    g_slope, w_slope = g * inverse_g * inverse_g, w * inverse_w * inverse_w
    off = t * (port.distance + g + w) - rho
    slope = port.distance + g_slope + w_slope
    curve = (1.0 - glass * glass) * g_slope * inverse_g * inverse_g
    curve += (1.0 - water * water) * w_slope * inverse_w * inverse_w
    # Halley: off / (slope - off * second derivative / (2 slope)), that derivative -3 t curve.
    step = off * slope / (slope * slope + 1.5 * t * curve * off)
    t -= step
    # Halley's next error is about the cube of its step.
    step_solved = 1e-6
    solved = abs(step) < step_solved * (1.0 + t * t)
    return t, solved & (t >= 0.0) & (min(square_g, square_w) > 1e-20)


@inner_kernel
def bisect_flat(port: FlatParams, height: float, rho: float) -> tuple[bool, float]:
    """Solve rho(t) = rho by bisection over alpha; return (found, t). Slow, but safe."""
    low, high = 0.0, math.asin(min(1.0, min(port.n_port, port.n_water) / port.n_air))
    glass, water = port.n_air / port.n_port, port.n_air / port.n_water
    for _ in range(60):
        middle = 0.5 * (low + high)
        t = math.tan(middle)
        g, w = layer(glass, t)[1], layer(water, t)[1]
        if t * (port.distance + port.thickness * glass * g + height * water * w) <= rho:
            low = middle
        else:
            high = middle
    t = math.tan(low)
    return math.isfinite(rho) & math.isfinite(t), t


class FlatDerivative(NamedTuple):
    """Terms of the derivatives of a solved projection behind a flat port."""

    turn: Vec  # u of the module's docstring.
    by_reach: float  # d alpha / d rho, 1/m.
    across_point: float  # sin alpha / rho, 1/m.
    water_tangent: float  # w, the tangent of the angle in the water.
    # d alpha by the parameters.
    by_distance: float
    by_thickness: float
    by_n_air: float
    by_n_port: float
    by_n_water: float


@inline_kernel
def flat_derivative(
    port: FlatParams, height: float, e: Vec, solution: tuple[float, float]
) -> FlatDerivative:
    """Return the derivatives at a solution (cos alpha, sin alpha), without branches."""
    c, s = solution
    t = s / c
    glass, water = port.n_air / port.n_port, port.n_air / port.n_water
    _, inverse_g = layer(glass, t)
    _, inverse_w = layer(water, t)
    cube_g, cube_w = inverse_g * inverse_g * inverse_g, inverse_w * inverse_w * inverse_w
    slope = port.distance + port.thickness * glass * cube_g + height * water * cube_w
    factor = port.distance + port.thickness * glass * inverse_g + height * water * inverse_w
    by_reach = c * c / slope
    g, w = glass * t * inverse_g, water * t * inverse_w
    # rho by k of the port and of the water: 1 + t^2 is 1 / c^2, which by_reach undoes.
    by_k = t / slope
    by_glass, by_water = by_k * port.thickness * cube_g, by_k * height * cube_w
    m = port.normal
    return FlatDerivative(
        turn=(c * e[0] - s * m[0], c * e[1] - s * m[1], c * e[2] - s * m[2]),
        by_reach=by_reach,
        across_point=c / factor,
        water_tangent=w,
        by_distance=-by_reach * (t - w),
        by_thickness=-by_reach * (g - w),
        by_n_air=-(by_glass / port.n_port + by_water / port.n_water),
        by_n_port=by_glass * glass / port.n_port,
        by_n_water=by_water * water / port.n_water,
    )
