"""Patches: parts of paraboloids over a base plane, and their point nearest to the vehicle.

A patch is an array of 16 numbers: normal and offset of its base plane in `dome`, the two unit
vectors in that plane along which u and v run, and the coefficients a (m), b, c, p, q, r (1/m) of
its height along the normal (see `paraboloid`).
"""

import math

import numpy as np

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import inline_borrowing_kernel, lazy_borrowing_kernel, lazy_kernel
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig_covariance import FittedSurface, posture_by_plane

NORMAL, OFFSET, RIGHT, UP, COEFFICIENTS, PACKED = 0, 3, 4, 7, 10, 16
"""Indices of the parts of a patch, and its length."""
N_COEFFICIENTS = 6

SIGMA_CURVATURE, SIGMA_TWIST = 2.0, 0.5
"""Prior standard deviations of the curvatures p, r and of the twist q of nets, in 1/m."""


@inline_borrowing_kernel
def height_over(patch: FloatArray, x: float, y: float, z: float) -> float:
    """Return the distance of a point behind a patch (16,), along the base normal, in metres."""
    u = patch[4] * x + patch[5] * y + patch[6] * z
    v = patch[7] * x + patch[8] * y + patch[9] * z
    height = patch[10] + patch[11] * u + patch[12] * v
    height += 0.5 * (patch[13] * u * u + patch[15] * v * v) + patch[14] * u * v
    return float(patch[0] * x + patch[1] * y + patch[2] * z - patch[OFFSET] - height)


@lazy_borrowing_kernel
def heights_over(points: FloatArray, patch: FloatArray, off: FloatArray) -> None:
    """Write the distances (N,) of points (N, 3) behind a patch (16,), in metres."""
    for i in range(points.shape[0]):
        off[i] = height_over(patch, points[i, 0], points[i, 1], points[i, 2])


@lazy_borrowing_kernel
def write_tangent(patch: FloatArray, m: FloatArray) -> bool:
    """Write m = n/d of the tangent plane at the point nearest to the origin, if any."""
    a, b, c, p, q, r = patch[10], patch[11], patch[12], patch[13], patch[14], patch[15]
    u, v, h, slope_u, slope_v = 0.0, 0.0, 0.0, 0.0, 0.0
    # Newton steps to the nearest point; the Hessian of half the squared distance, and its first
    # element, must be clearly positive.
    foot_steps = 12
    min_curved = 0.05
    for _ in range(foot_steps):
        h = a + b * u + c * v + 0.5 * (p * u * u + r * v * v) + q * u * v
        slope_u, slope_v = b + p * u + q * v, c + q * u + r * v
        # Half the squared distance is (u² + v² + (d + h)²) / 2.
        reach = patch[OFFSET] + h
        by_u, by_v = u + reach * slope_u, v + reach * slope_v
        uu, vv = 1.0 + slope_u * slope_u + reach * p, 1.0 + slope_v * slope_v + reach * r
        uv = slope_u * slope_v + reach * q
        determinant = uu * vv - uv * uv
        if determinant <= min_curved or uu <= min_curved:
            return False
        u -= (vv * by_u - uv * by_v) / determinant
        v -= (uu * by_v - uv * by_u) / determinant
    along = 0.0
    for k in range(3):
        normal, right, up = patch[k], patch[RIGHT + k], patch[UP + k]
        m[k] = normal - slope_u * right - slope_v * up
        along += m[k] * (u * right + v * up + (patch[OFFSET] + h) * normal)
    for k in range(3):
        m[k] /= along
    return True


@lazy_kernel
def tangent_jacobian(patch: FloatArray, sigma: FloatArray, m: FloatArray, out: FloatArray) -> bool:
    """Write the derivatives (3, 6) of m by the coefficients; False if undefined.

    By one-sided differences, of 1e-4 times the coefficients' standard deviations `sigma` (6,).
    """
    moved, other = patch.copy(), np.empty(3)
    for k in range(6):
        step = 1e-4 * max(sigma[k], 1e-6)
        moved[COEFFICIENTS + k] = patch[COEFFICIENTS + k] + step
        if not write_tangent(moved, other):
            return False
        moved[COEFFICIENTS + k] = patch[COEFFICIENTS + k]
        for j in range(3):
            out[j, k] = (other[j] - m[j]) / step
    return True


@lazy_kernel
def tangent_covariance(patch: FloatArray, covariance: FloatArray, m: FloatArray) -> FloatArray:
    """Return the covariance (3, 3) of `nearest_tangent`, in 1/m²; infinite if undefined.

    To first order, from that of the coefficients (6, 6), by `tangent_jacobian`.
    """
    jacobian, out = np.empty((3, 6)), np.full((3, 3), np.inf)
    if not tangent_jacobian(patch, np.sqrt(np.diag(covariance)), m, jacobian):
        return out
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(6):
                for n in range(6):
                    total += jacobian[i, k] * covariance[k, n] * jacobian[j, n]
            out[i, j] = total
    return out


@lazy_borrowing_kernel
def write_terms(points: FloatArray, patch: FloatArray, terms: FloatArray) -> None:
    """Write the derivatives (N, 6) of a patch's height at points (N, 3) by its coefficients."""
    for i in range(points.shape[0]):
        u, v = 0.0, 0.0
        for k in range(3):
            u += patch[RIGHT + k] * points[i, k]
            v += patch[UP + k] * points[i, k]
        terms[i, 0], terms[i, 1], terms[i, 2] = 1.0, u, v
        terms[i, 3], terms[i, 4], terms[i, 5] = 0.5 * u * u, u * v, 0.5 * v * v


CURVATURE_PRIOR: FloatArray = np.array(
    [0.0, 0.0, 0.0, SIGMA_CURVATURE**-2, SIGMA_TWIST**-2, SIGMA_CURVATURE**-2]
)
"""Information on the coefficients that fits add to that of the observations."""

# Scale of the coefficients for `tangent_jacobian`, if they have no covariance: m, 1, 1/m.
_SCALES = np.full(6, 0.1)
# Largest distance of the nearest point from the visible area, as a share of its width and height;
# least cosine of its normal to the vehicle's forward axis, that of 55 degrees.
_BESIDE_VIEW = 0.6
_FACING = 0.57


def packed_plane(plane: Plane) -> FloatArray:
    """Return a plane as a patch (16,): u to the right, v upward, no curvature."""
    a, b, c = plane.normal.tolist()
    level = math.sqrt(a * a + b * b)
    right, ahead = b / level, -a / level
    packed = np.zeros(PACKED)
    packed[:RIGHT] = a, b, c, plane.offset
    packed[RIGHT:UP] = right, ahead, 0.0
    packed[UP:COEFFICIENTS] = ahead * c, -right * c, right * b - ahead * a
    return packed


def nearest_in_view(m: FloatArray, points: FloatArray) -> bool:
    """Return whether a tangent plane touches a net near its visible part.

    Farther away a paraboloid does not describe the net.

    Parameters
    ----------
    m : array, shape (3,)
        From `nearest_tangent`.
    points : array, shape (N, 3)
        Visible points of the net, in `dome`.
    """
    foot = m / float(m @ m)
    low, high = points.min(axis=0), points.max(axis=0)
    beyond = np.maximum(low - foot, foot - high)[[0, 2]]
    facing = m[1] > _FACING * np.linalg.norm(m)
    return bool(facing and (beyond < _BESIDE_VIEW * (high - low)[[0, 2]]).all())


def nearest_tangent(patch: FloatArray) -> FloatArray | None:
    """Return m = n/d of the plane that touches a patch (16,) nearest to the dome's centre.

    The posture to a plane is that at the foot of the perpendicular; so is that to a curved net.

    Returns
    -------
    array, shape (3,), or None
        In 1/m. None if there is no such point: the net curls around the vehicle.
    """
    m = np.empty(3)
    return m if write_tangent(patch, m) else None


def fitted_patch(patch: FloatArray, m: FloatArray, points: FloatArray) -> FittedSurface:
    """Return a patch as a surface fitted to points (N, 3), with the posture to its tangent plane.

    Parameters
    ----------
    patch : array, shape (16,)
    m : array, shape (3,)
        From `nearest_tangent`.
    points : array, shape (N, 3)
        In `dome`, metres.
    """
    terms, by_terms = np.empty((len(points), N_COEFFICIENTS)), np.empty((3, N_COEFFICIENTS))
    write_terms(points, patch, terms)
    if not tangent_jacobian(patch, _SCALES, m, by_terms):
        by_terms[:] = np.nan
    _, b, c, p, q, r = patch[COEFFICIENTS:].tolist()
    right, up = patch[RIGHT:UP], patch[UP:COEFFICIENTS]
    across = np.outer(right, up)
    bend = p * np.outer(right, right) + q * (across + across.T) + r * np.outer(up, up)
    normal = patch[:OFFSET] - b * right - c * up
    return FittedSurface(terms, CURVATURE_PRIOR, normal, -bend, posture_by_plane(m) @ by_terms)


@lazy_kernel
def intensity_share_near(
    group: IntArray, confidence: FloatArray, points: FloatArray, patch: FloatArray, near: float
) -> float:
    """Return the share of the light in observations nearer to a patch than `near`, in metres.

    Parameters
    ----------
    group : int array, shape (N,)
        As in `Observed`.
    confidence : array, shape (N,)
        Of the candidates.
    points : array, shape (M, 3)
        Of the observations, in `dome`.
    patch : array, shape (16,)
    """
    height = np.empty(points.shape[0])
    heights_over(points, patch, height)
    total, on = 0.0, 0.0
    for i in range(group.shape[0]):
        if group[i] >= 0:
            total += confidence[i]
            on += confidence[i] if abs(height[group[i]]) < near else 0.0
    return on / max(total, 1e-12)
