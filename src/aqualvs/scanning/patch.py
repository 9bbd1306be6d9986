"""Patches: pieces of paraboloids over a plane, and the point of them nearest to the vehicle."""

import math
from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.scanning.quadric_kernels import heights_over

FLAT = np.zeros(6)
"""Coefficients (a, b, c, p, q, r) of a plane."""

# The nearest point lies at most so far beside what is seen, in shares of its width and height, and
# its normal no farther off the vehicle's forward axis than 55 degrees.
_BESIDE_VIEW = 0.6
_FACING = 0.57
# The nearest point is looked for in so many Newton steps.
_FOOT_STEPS = 12


@dataclass(frozen=True, slots=True)
class Patch:
    """A curved piece of net over a base plane.

    Attributes
    ----------
    base : Plane
        In `dome`; heights are measured along its normal.
    right, up : array, shape (3,)
        Unit vectors in the base plane along which u and v run, in `dome`.
    coefficients : array, shape (6,)
        a (m), b, c, p, q, r (1/m) of the height.
    """

    base: Plane
    right: FloatArray
    up: FloatArray
    coefficients: FloatArray

    def height(self, points: FloatArray) -> FloatArray:
        """Return by how much points (N, 3) lie behind the patch, along the base's normal, in m."""
        return heights_over(
            points, self.base.normal, self.base.offset, self.right, self.up, self.coefficients
        )

    def packed(self) -> FloatArray:
        """Return the patch as 16 numbers for kernels: normal, offset, right, up, coefficients."""
        return np.concatenate(
            [self.base.normal, [self.base.offset], self.right, self.up, self.coefficients]
        )


@dataclass(frozen=True, slots=True)
class PatchFit:
    """A patch and how well the observations determine it.

    Attributes
    ----------
    patch : Patch
        Least squares, robust.
    covariance : array, shape (6, 6)
        Of its coefficients.
    weights : array, shape (M,)
        Robust weight of each observation, 0 to 1.
    rms : float
        Weighted root mean square distance from the patch, in metres.
    """

    patch: Patch
    covariance: FloatArray
    weights: FloatArray
    rms: float


def flat_patch(plane: Plane) -> Patch:
    """Return a plane as a patch: u to the right, v upward."""
    a, b, c = plane.normal.tolist()
    level = math.hypot(a, b)
    right, ahead = b / level, -a / level
    up = np.array([ahead * c, -right * c, right * b - ahead * a])
    return Patch(plane, np.array([right, ahead, 0.0]), up, FLAT)


def nearest_in_view(m: FloatArray, points: FloatArray) -> bool:
    """Tell whether the point at which a tangent touches is not far beside what is seen of a net.

    Farther out a paraboloid says nothing of the net.

    Parameters
    ----------
    m : array, shape (3,)
        From `nearest_tangent`.
    points : array, shape (N, 3)
        What is seen of the net, in `dome`.
    """
    foot = m / float(m @ m)
    low, high = points.min(axis=0), points.max(axis=0)
    beyond = np.maximum(low - foot, foot - high)[[0, 2]]
    facing = m[1] > _FACING * np.linalg.norm(m)
    return bool(facing and (beyond < _BESIDE_VIEW * (high - low)[[0, 2]]).all())


def nearest_tangent(patch: Patch) -> FloatArray | None:
    """Return m = n/d of the tangent plane at the point nearest to the dome's centre.

    A plane has its range and its angles at the foot of the perpendicular; so has a curved net.

    Returns
    -------
    array, shape (3,), or None
        None where there is no such point: the net curls around the vehicle.
    """
    a, b, c, p, q, r = patch.coefficients
    u = v = 0.0
    normal, right, up = patch.base.normal, patch.right, patch.up
    for _ in range(_FOOT_STEPS):
        h = a + b * u + c * v + 0.5 * (p * u * u + r * v * v) + q * u * v
        slope_u, slope_v = b + p * u + q * v, c + q * u + r * v
        # Half the squared distance is (u² + v² + (d + h)²) / 2.
        reach = patch.base.offset + h
        gradient = np.array([u + reach * slope_u, v + reach * slope_v])
        hessian = np.array(
            [
                [1.0 + slope_u**2 + reach * p, slope_u * slope_v + reach * q],
                [slope_u * slope_v + reach * q, 1.0 + slope_v**2 + reach * r],
            ]
        )
        if np.linalg.det(hessian) <= 0.05 or hessian[0, 0] <= 0.05:
            return None
        step = np.linalg.solve(hessian, gradient)
        u, v = u - step[0], v - step[1]
    tangent = normal - slope_u * right - slope_v * up
    tangent /= np.linalg.norm(tangent)
    point = u * right + v * up + (patch.base.offset + h) * normal
    m: FloatArray = tangent / float(tangent @ point)
    return m


def tangent_covariance(fit: PatchFit, m: FloatArray) -> FloatArray:
    """Return the covariance (3, 3) of `nearest_tangent`, by differences of the coefficients."""
    jacobian = np.zeros((3, 6))
    for k in range(6):
        step = 1e-4 * max(np.sqrt(fit.covariance[k, k]), 1e-6)
        moved = fit.patch.coefficients.copy()
        moved[k] += step
        patch = Patch(fit.patch.base, fit.patch.right, fit.patch.up, moved)
        other = nearest_tangent(patch)
        if other is None:
            return np.full((3, 3), np.inf)
        jacobian[:, k] = (other - m) / step
    covariance: FloatArray = jacobian @ fit.covariance @ jacobian.T
    return covariance
