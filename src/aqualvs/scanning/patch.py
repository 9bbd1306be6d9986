"""Patches: pieces of paraboloids over a plane, and the point of them nearest to the vehicle."""

from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig_covariance import FittedSurface, posture_by_plane
from aqualvs.scanning.patch_kernels import (
    COEFFICIENTS,
    PACKED,
    RIGHT,
    SIGMA_CURVATURE,
    SIGMA_TWIST,
    UP,
    carry_to_tangent,
    heights_over,
    tangent_jacobian,
    write_flat,
    write_tangent,
    write_terms,
)

FLAT = np.zeros(6)
"""Coefficients (a, b, c, p, q, r) of a plane."""
CURVATURE_PRIOR: FloatArray = np.array(
    [0.0, 0.0, 0.0, SIGMA_CURVATURE**-2, SIGMA_TWIST**-2, SIGMA_CURVATURE**-2]
)
"""Information on the coefficients that fits add to that of the observations."""

# Coefficients differ by so much where their derivatives are taken: metres, shares, 1/m.
_ALIKE = np.full(6, 0.1)
# The nearest point lies at most so far beside what is seen, in shares of its width and height, and
# its normal no farther off the vehicle's forward axis than 55 degrees.
_BESIDE_VIEW = 0.6
_FACING = 0.57


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
        off = np.empty(len(points))
        heights_over(points, self.packed(), off)
        return off

    def packed(self) -> FloatArray:
        """Return the patch as 16 numbers for kernels: normal, offset, right, up, coefficients."""
        packed = np.empty(PACKED)
        packed[:3], packed[3] = self.base.normal, self.base.offset
        packed[RIGHT:UP], packed[UP:COEFFICIENTS] = self.right, self.up
        packed[COEFFICIENTS:] = self.coefficients
        return packed


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
    packed = packed_plane(plane)
    return Patch(plane, packed[RIGHT:UP], packed[UP:COEFFICIENTS], FLAT)


def packed_plane(plane: Plane) -> FloatArray:
    """Return `flat_patch(plane).packed()`."""
    packed = np.empty(PACKED)
    write_flat(plane.normal, plane.offset, packed)
    return packed


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
    m = np.empty(3)
    return m if write_tangent(patch.packed(), m) else None


def tangent_covariance(fit: PatchFit, m: FloatArray) -> FloatArray:
    """Return the covariance (3, 3) of `nearest_tangent`, by differences of the coefficients."""
    covariance = np.empty((3, 3))
    carry_to_tangent(fit.patch.packed(), fit.covariance, m, covariance)
    return covariance


def fitted_patch(patch: Patch, m: FloatArray, points: FloatArray) -> FittedSurface:
    """Return a patch as it is fitted to points (N, 3); the posture is that of its tangent.

    Parameters
    ----------
    patch : Patch
    m : array, shape (3,)
        From `nearest_tangent`.
    points : array, shape (N, 3)
        In `dome`, metres.
    """
    packed, terms = patch.packed(), np.empty((len(points), len(FLAT)))
    by_plane, by_terms = np.empty((3, 3)), np.empty((3, len(FLAT)))
    write_terms(points, packed, terms)
    posture_by_plane(m, by_plane)
    if not tangent_jacobian(packed, _ALIKE, m, by_terms):
        by_terms[:] = np.nan
    _, b, c, p, q, r = patch.coefficients.tolist()
    right, up = patch.right, patch.up
    across = np.outer(right, up)
    bend = p * np.outer(right, right) + q * (across + across.T) + r * np.outer(up, up)
    normal = patch.base.normal - b * right - c * up
    return FittedSurface(terms, CURVATURE_PRIOR, normal, -bend, by_plane @ by_terms)
