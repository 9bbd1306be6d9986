"""Refraction by the dome: two concentric spheres with acrylic or glass between them.

Unprojection (`trace_direction`) follows a ray from the lens into the outer medium. Projection
(`direction_to_point`) finds the direction at the lens whose ray meets a point in the outer medium.

In concentric spheres n * rho * sin(incidence) is constant along a ray (Bouguer; Born and Wolf,
Principles of Optics, 3.2.1). With the lens at distance l from the centre and alpha the ray's angle
to the axis L/l, that constant is b = n_air l sin(alpha), and the ray reaches distance rho at the
polar angle

    theta(alpha) = alpha - asin(b/(n_air r)) + asin(b/(n_acrylic r))
                         - asin(b/(n_acrylic R)) + asin(b/(n_water R)) - asin(b/(n_water rho)).

Solving theta(alpha) = angle of the point takes a few Newton steps. No angle is ever formed: each
asin is the unit complex number (sqrt(1 - s^2), s), sums are products, and the residual is the sine
of theta - target. Sines are carried divided by b, so that nothing breaks when the lens is in the
centre, where b vanishes.

The derivatives of the projection follow from the implicit function theorem (`back_derivative`).
With u the unit vector along which the direction turns as alpha grows, m the normal of the plane of
refraction, and D = theta - alpha, the derivative of the direction is

    by the point   u (u_target / rho - theta_rho p)^T / theta_alpha + (k / rho) m m^T
    by the lens    (n_air dD/db / theta_alpha) u u^T + n_air (sin D / b) k m m^T
    by any other   -u theta_x / theta_alpha

where k = sin alpha / sin theta, which becomes 1 / theta_alpha on the axis. No term divides by the
decentring.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from aqualvs.errors import RigError
from aqualvs.geometry.compiled import inline_kernel, inner_kernel
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.lens_kernels import Vector
from aqualvs.optics.refraction import as_triple, check_index, leave_sphere, leave_sphere_tangent

DOME_PARAMETERS = ("inner_radius", "thickness", "n_air", "n_acrylic", "n_water")
"""Parameters of a camera behind a dome, after those of its pose; `inner_radius` moves the outer
sphere along."""


class DomeParams(NamedTuple):
    """A dome as kernels take it; `Dome.params` makes it.

    Attributes
    ----------
    centre : tuple of 3 float
        The lens position L in `dome`, metres.
    inner_radius, outer_radius : float
        Metres.
    n_air, n_acrylic, n_water : float
        Refractive indices, vacuum = 1.
    decentring : float
        |L| in metres.
    axis : tuple of 3 float
        L/|L| in `dome`; any unit vector when L is zero.
    """

    centre: Vector
    inner_radius: float
    outer_radius: float
    n_air: float
    n_acrylic: float
    n_water: float
    decentring: float
    axis: Vector

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return DOME_PARAMETERS


@inline_kernel
def trace_direction(
    port: DomeParams, dx: float, dy: float, dz: float
) -> tuple[bool, float, float, float, float, float, float]:
    """Trace a unit direction in `dome` from the lens through both surfaces of the dome.

    Returns
    -------
    valid, ox, oy, oz, dx, dy, dz
        False under total reflection; origin on the outer surface and unit direction in the outer
        medium, both in `dome`.
    """
    inner, px, py, pz, dx, dy, dz = leave_sphere(
        port.centre[0],
        port.centre[1],
        port.centre[2],
        dx,
        dy,
        dz,
        port.inner_radius,
        port.n_air / port.n_acrylic,
    )
    outer, px, py, pz, dx, dy, dz = leave_sphere(
        px, py, pz, dx, dy, dz, port.outer_radius, port.n_acrylic / port.n_water
    )
    return (inner >= 0.0) & (outer >= 0.0), px, py, pz, dx, dy, dz


@inline_kernel
def trace_tangent(
    port: DomeParams,
    direction: Vector,
    direction_dot: Vector,
) -> tuple[Vector, Vector]:
    """Return the derivative of `trace_direction`'s origin and direction along direction_dot."""
    still = (0.0, 0.0, 0.0)
    ratio = port.n_air / port.n_acrylic
    c = port.centre
    d = direction
    _, px, py, pz, ex, ey, ez = leave_sphere(
        c[0], c[1], c[2], d[0], d[1], d[2], port.inner_radius, ratio
    )
    p_dot, e_dot = leave_sphere_tangent(c, d, still, direction_dot, port.inner_radius, ratio)
    return leave_sphere_tangent(
        (px, py, pz),
        (ex, ey, ez),
        p_dot,
        e_dot,
        port.outer_radius,
        port.n_acrylic / port.n_water,
    )


# A last Newton step below this leaves an error of its square times a factor of order one.
STEP_SOLVED = 3e-8
# Rounds of three steps: one is enough for a lens that looks outwards, two for one at 95 % of the
# inner radius that looks sideways; the remaining cases are searched (`solve_guarded`).
ROUNDS = 3
# Points this much (relative) inside the outer surface are still on it: rounding, not geometry.
SURFACE_SLACK = 1e-9
_TINY = 1e-300


class AngleSines(NamedTuple):
    """Sines of the five angles per unit of b: 1 / (n * radius), in the order of theta(alpha)."""

    q1: float
    q2: float
    q3: float
    q4: float
    q5: float


@inline_kernel
def surfaces_at(port: DomeParams, inverse_rho: float) -> AngleSines:
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
def paraxial_start(
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
def three_steps(
    s: AngleSines, n_l: float, cos_target: float, sin_target: float, c: float, k: float
) -> tuple[float, float, bool]:
    """Return (cos alpha, sin alpha, solved) after three steps from (c, k), without branches."""
    c, k, _ = newton_step(s, n_l, cos_target, sin_target, c, k)
    c, k, _ = newton_step(s, n_l, cos_target, sin_target, c, k)
    c, k, solved = newton_step(s, n_l, cos_target, sin_target, c, k)
    return c, k, solved & (n_l * abs(k) * steepest(s) < 1.0)


@inner_kernel
def solve_guarded(
    s: AngleSines, n_l: float, cos_target: float, sin_target: float
) -> tuple[bool, float, float]:
    """Solve theta(alpha) = target by bracketing; return (found, cos alpha, sin alpha).

    Slow, but safe. Where total reflection is possible, theta may turn back near the critical angle
    and several rays may reach a point. The one nearest to the forward axis is found; a point very
    close to the caustic, where two of them merge, may be refused.
    """
    target = math.atan2(sin_target, cos_target)
    sine = min(1.0 / max(n_l * steepest(s), _TINY), 1.0)
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
def steepest(s: AngleSines) -> float:
    """Return the largest sine per unit of b: the surface that reflects totally first."""
    return max(max(s.q1, s.q2), max(max(s.q3, s.q4), s.q5))


@inline_kernel
def _theta(s: AngleSines, n_l: float, alpha: float) -> float:
    cos_d, sin_d_per_b, _, _ = deflection(s, n_l * math.sin(alpha))
    return alpha + math.atan2(n_l * math.sin(alpha) * sin_d_per_b, cos_d)


@inline_kernel
def solve_alpha(
    s: AngleSines, n_l: float, cos_target: float, sin_target: float
) -> tuple[bool, float, float]:
    """Solve theta(alpha) = target; return (found, cos alpha, sin alpha)."""
    c, k = paraxial_start(s, n_l, cos_target, sin_target)
    for _ in range(ROUNDS):
        c, k, solved = three_steps(s, n_l, cos_target, sin_target, c, k)
        if solved:
            return True, c, k
    return solve_guarded(s, n_l, cos_target, sin_target)


@inline_kernel
def polar_angle(
    port: DomeParams, x: float, y: float, z: float
) -> tuple[float, float, float, Vector]:
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


@inline_kernel
def direction_to_point(
    port: DomeParams, x: float, y: float, z: float
) -> tuple[bool, float, float, float]:
    """Return (valid, dx, dy, dz): the unit direction at the lens whose ray meets the point.

    Both in `dome`. Not valid for a point inside the dome or one that no ray reaches.
    """
    inverse_rho, cos_target, sin_target, e = polar_angle(port, x, y, z)
    s = surfaces_at(port, inverse_rho)
    n_l = port.n_air * port.decentring
    found, c, k = solve_alpha(s, n_l, cos_target, sin_target)
    a = port.axis
    return (
        found and is_outside(port, inverse_rho),
        c * a[0] + k * e[0],
        c * a[1] + k * e[1],
        c * a[2] + k * e[2],
    )


class BackDerivative(NamedTuple):
    """Terms of the derivatives of a solved projection.

    Attributes
    ----------
    turn, normal : vector
        u and m of the module's docstring.
    along_point : vector
        d alpha / d point, 1/m.
    across_point : float
        Factor of m m^T for the point, 1/m.
    along_lens, across_lens : float
        Factors of u u^T and m m^T for the lens position, 1/m.
    by_inner, by_thickness : float
        d alpha by inner radius and thickness, 1/m.
    by_n_air, by_n_acrylic, by_n_water : float
        d alpha by the indices.
    """

    turn: Vector
    normal: Vector
    along_point: Vector
    across_point: float
    along_lens: float
    across_lens: float
    by_inner: float
    by_thickness: float
    by_n_air: float
    by_n_acrylic: float
    by_n_water: float


@inline_kernel
def perpendicular(a: Vector) -> Vector:
    """Return a unit vector perpendicular to the unit vector a."""
    if abs(a[0]) < 0.6:
        length = math.sqrt(a[1] * a[1] + a[2] * a[2])
        return 0.0, -a[2] / length, a[1] / length
    length = math.sqrt(a[0] * a[0] + a[1] * a[1])
    return -a[1] / length, a[0] / length, 0.0


@inline_kernel
def cross(a: Vector, b: Vector) -> Vector:
    """Return a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inline_kernel
def dot(a: Vector, b: Vector) -> float:
    """Return a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inline_kernel
def blend(p: float, a: Vector, q: float, b: Vector) -> Vector:
    """Return p a + q b."""
    return p * a[0] + q * b[0], p * a[1] + q * b[1], p * a[2] + q * b[2]


@inline_kernel
def across_axis(axis: Vector, e: Vector, spare: Vector) -> Vector:
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


@inline_kernel
def back_derivative(
    port: DomeParams,
    s: AngleSines,
    target: tuple[float, float, float],
    e: Vector,
    solution: tuple[float, float],
) -> BackDerivative:
    """Return the derivatives at a solution, without branches.

    Parameters
    ----------
    port : DomeParams
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
    return BackDerivative(
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


@dataclass(frozen=True, slots=True)
class Dome:
    """A hemispherical port; its centre is the origin of `dome`.

    Attributes
    ----------
    inner_radius : float
        In metres.
    thickness : float
        In metres; zero gives an infinitely thin dome.
    n_acrylic : float
        Refractive index of the dome's material, vacuum = 1.

    Raises
    ------
    RigError
        If a value is not finite, the inner radius is not positive, the thickness is negative, or
        the index lies outside 1 to 3.
    """

    inner_radius: float
    thickness: float
    n_acrylic: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.inner_radius) and self.inner_radius > 0.0):
            raise RigError(
                f"dome has inner radius {self.inner_radius * 1e3:g} mm; it must be positive"
            )
        if not (math.isfinite(self.thickness) and self.thickness >= 0.0):
            raise RigError(
                f"dome has thickness {self.thickness * 1e3:g} mm; it must not be negative"
            )
        check_index("dome", "n_acrylic", self.n_acrylic)

    @property
    def outer_radius(self) -> float:
        """Radius of the outer sphere in metres."""
        return self.inner_radius + self.thickness

    def numbers(self) -> dict[str, float]:
        """Return the sizes and the index by the names of their parameters."""
        return {
            "inner_radius": self.inner_radius,
            "thickness": self.thickness,
            "n_acrylic": self.n_acrylic,
        }

    def moved_by(self, step: Mapping[str, float]) -> "Dome":
        """Return the dome with steps added to the parameters that are named."""
        return Dome(**{name: value + step.get(name, 0.0) for name, value in self.numbers().items()})

    def params(self, dome_from_cam: SE3, n_air: float, n_water: float) -> DomeParams:
        """Return the dome around a camera as kernels take it.

        Raises
        ------
        RigError
            If the lens lies outside the inner sphere.
        """
        centre = np.asarray(dome_from_cam.translation, dtype=np.float64)
        decentring = float(np.linalg.norm(centre))
        if decentring >= self.inner_radius:
            raise RigError(
                f"lens at {np.round(centre * 1e3, 3).tolist()} mm is {decentring * 1e3:.3f} mm "
                f"from the dome's centre but the inner radius is {self.inner_radius * 1e3:.3f} mm; "
                "move the lens inside or correct the radius"
            )
        axis = centre / decentring if decentring > 0.0 else np.array([0.0, 0.0, 1.0])
        return DomeParams(
            centre=as_triple(centre),
            inner_radius=float(self.inner_radius),
            outer_radius=float(self.outer_radius),
            n_air=float(n_air),
            n_acrylic=float(self.n_acrylic),
            n_water=float(n_water),
            decentring=decentring,
            axis=as_triple(axis),
        )
