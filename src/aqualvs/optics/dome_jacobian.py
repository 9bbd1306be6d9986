"""Derivatives of the direction at the lens, by the implicit function theorem.

With u the unit vector along which the direction turns as alpha grows, m the normal of the plane of
refraction, and theta(alpha; rho, r, R, n) of `dome_back`, the derivative of the direction is

    by the point   u (u_target / rho - theta_rho p)^T / theta_alpha + (k / rho) m m^T
    by the lens    (n_air dD/db / theta_alpha) u u^T + n_air (sin D / b) k m m^T
    by any other   -u theta_x / theta_alpha

where k = sin alpha / sin theta, which becomes 1 / theta_alpha on the axis. None of it divides by
the decentring.
"""

import math
from typing import NamedTuple

from aqualvs.geometry.compiled import inline_kernel
from aqualvs.optics.dome_back import Surfaces, cosine_of, deflection
from aqualvs.optics.dome_forward import CameraParams
from aqualvs.optics.lens_params import Vector

# Sine of the polar angle below which sin alpha / sin theta is taken as its limit: the limit is off
# by the square of this, the quotient by a rounding over it.
_ON_AXIS = 1e-5


class BackDerivative(NamedTuple):
    """What the derivatives of a solved back projection are made of.

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
    """Return e made exactly perpendicular to the axis, or `spare` where nothing of it remains.

    Near the axis e is the quotient of two roundings. Any perpendicular vector will do there: the
    derivatives do not depend on the azimuth.
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
    camera: CameraParams,
    s: Surfaces,
    target: tuple[float, float, float],
    e: Vector,
    solution: tuple[float, float],
) -> BackDerivative:
    """Return the derivatives at a solution, without branches.

    Parameters
    ----------
    camera : CameraParams
    s : Surfaces
        Of the point.
    target : (float, float, float)
        1/rho, cos and sin of the point as `polar_angle` gives them.
    e : vector
        Unit vector from the axis to the point, perpendicular to the axis.
    solution : (float, float)
        (cos alpha, sin alpha).
    """
    (inverse_rho, cos_t, sin_t), (c, k) = target, solution
    n_l = camera.n_air * camera.decentring
    b = n_l * k
    _, sin_d_per_b, slope, scale = deflection(s, b)
    slope = slope / scale
    inverse = 1.0 / (1.0 + n_l * c * slope)
    by_rho = inverse * inverse_rho
    ratio = k / max(sin_t, _ON_AXIS) if sin_t > _ON_AXIS else inverse
    t1, t2 = b * s.q1 / cosine_of(s.q1, b), b * s.q2 / cosine_of(s.q2, b)
    t3, t4 = b * s.q3 / cosine_of(s.q3, b), b * s.q4 / cosine_of(s.q4, b)
    t5 = b * s.q5 / cosine_of(s.q5, b)
    by_outer = (t4 - t3) / camera.outer_radius * inverse
    axis = camera.axis
    return BackDerivative(
        turn=blend(-k, axis, c, e),
        normal=cross(axis, e),
        along_point=blend((-sin_t - t5 * cos_t) * by_rho, axis, (cos_t - t5 * sin_t) * by_rho, e),
        across_point=ratio * inverse_rho,
        along_lens=camera.n_air * slope * inverse,
        across_lens=camera.n_air * sin_d_per_b * ratio,
        by_inner=(t2 - t1) / camera.inner_radius * inverse + by_outer,
        by_thickness=by_outer,
        by_n_air=(t3 - t2 + t5 - t4) / camera.n_air * inverse,
        by_n_acrylic=(t2 - t3) / camera.n_acrylic * inverse,
        by_n_water=(t4 - t5) / camera.n_water * inverse,
    )
