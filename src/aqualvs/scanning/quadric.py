"""Curved nets: a paraboloid where a plane leaves too much over.

Over the plane that the search found, the net is a height

    h(u, v) = a + b u + c v + (p u² + 2 q u v + r v²) / 2

with u to the right and v upward in that plane. The plane touches the net along a band only; the fit
starts there and grows outward, because what it has learned in the band predicts the net beside it.
"""

from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.scanning.plane_fit import SharedError
from aqualvs.scanning.readings import Observations

FLAT = np.zeros(6)
"""Coefficients (a, b, c, p, q, r) of a plane."""

# Growth: steps, and the gate in shares of the range and in pixels.
_STEPS = 16
_GATE_SHARE = 0.004
_GATE_PX = 1.2
_TUKEY = 4.685
_REWEIGHTS = 6
# What is expected of nets before looking, in 1/m: bent by a metre's radius, hardly twisted.
_SIGMA_CURVATURE = 2.0
_SIGMA_TWIST = 0.5
# The residual asks for curvature when it gains so much of the light or of the scatter ...
_MORE_LIGHT = 1.10
_LESS_SCATTER = 0.6
# ... and the curvature is no chance and bends the net by so much of the range where it is seen.
_SIGNIFICANT = 4.0
_HINT = 2.0
_LEAST_BEND = 0.003
# Steeper bends than a radius of half a metre are something else.
_STRONGEST = 2.0
_MIN_PIECES = 12
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
        terms = _terms(points @ self.right, points @ self.up)
        off: FloatArray = self.base.signed_distance(points) - terms @ self.coefficients
        return off

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
    right = np.cross(plane.normal, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return Patch(plane, right, np.cross(right, plane.normal), FLAT)


def hints_at_curvature(seen: Observations, weights: FloatArray, plane: Plane) -> bool:
    """Whether the residuals of a plane fit look bent: a cheap look before the fit of a patch.

    Parameters
    ----------
    seen : Observations
        Those that the plane was fitted to, M of them.
    weights : array, shape (M,)
        Their weights in that fit.
    plane : Plane
        The fit.
    """
    flat = flat_patch(plane)
    terms = _terms(seen.points @ flat.right, seen.points @ flat.up)
    height = plane.signed_distance(seen.points)
    sigma = np.abs(seen.sensitivity @ plane.normal) * seen.sigma_px
    solved = _solve(terms, height, weights / sigma**2)
    if solved is None or len(height) <= len(FLAT):
        return False
    coefficients, normal = solved
    off = (height - terms @ coefficients) / sigma
    scale = np.sqrt(np.sum(weights * off**2) / (len(height) - len(FLAT)))
    sigmas = np.sqrt(np.diag(np.linalg.inv(normal))[3:]) * max(scale, 1.0)
    return bool(np.abs(coefficients[3:] / sigmas).max() > _HINT)


def fit_patch(seen: Observations, plane: Plane, shared: SharedError) -> PatchFit | None:
    """Fit a patch to what lies on it among M observations, if they ask for one.

    Parameters
    ----------
    seen : Observations
        Of strands on the target and of any others that may lie on it, wrong readings included.
    plane : Plane
        As the search found it.
    shared : SharedError
        What each laser's stripe shares.

    Returns
    -------
    PatchFit or None
        None where a plane is as good, or the curvature is not determined.
    """
    flat = flat_patch(plane)
    u, v = seen.points @ flat.right, seen.points @ flat.up
    terms = _terms(u, v)
    height = plane.signed_distance(seen.points)
    per_px = np.abs(seen.sensitivity @ plane.normal)
    gate = np.hypot(_GATE_SHARE * plane.offset, _GATE_PX * per_px)
    sigma = per_px * seen.sigma_px
    on_plane = np.abs(height) < gate
    found = _grow(terms, height, gate, on_plane)
    if found is None:
        return None
    coefficients, inside = found
    if np.count_nonzero(inside) < _MIN_PIECES:
        return None
    coefficients, normal, weights, scale = _reweighted(terms, height, sigma, inside, coefficients)
    covariance = np.asarray(np.linalg.inv(normal), np.float64) * max(scale, 1.0) ** 2
    covariance += _shared(terms, per_px, sigma, weights, seen, normal, shared)
    patch = Patch(plane, flat.right, flat.up, coefficients)
    off = height - terms @ coefficients
    rms = float(np.sqrt(np.sum(weights * off**2) / np.sum(weights)))
    fit = PatchFit(patch, covariance, weights, rms)
    return fit if _asked_for(fit, terms, height, inside, on_plane, plane.offset) else None


def _terms(u: FloatArray, v: FloatArray) -> FloatArray:
    return np.stack([np.ones_like(u), u, v, 0.5 * u * u, u * v, 0.5 * v * v], axis=-1)


def _prior() -> FloatArray:
    sigmas = np.array([np.inf, np.inf, np.inf, _SIGMA_CURVATURE, _SIGMA_TWIST, _SIGMA_CURVATURE])
    return np.diag(1.0 / sigmas**2)


def _solve(
    terms: FloatArray, height: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    normal = (terms * weight[:, None]).T @ terms + _prior()
    if np.linalg.cond(normal) > 1e14:
        return None
    solution = np.asarray(np.linalg.solve(normal, terms.T @ (weight * height)), np.float64)
    return solution, normal


def _grow(
    terms: FloatArray,
    height: FloatArray,
    gate: FloatArray,
    inside: BoolArray,
) -> tuple[FloatArray, BoolArray] | None:
    """Refit and take in what the fit predicts until nothing changes."""
    coefficients = FLAT
    for _ in range(_STEPS):
        if np.count_nonzero(inside) < _MIN_PIECES:
            return None
        solved = _solve(terms[inside], height[inside], 1.0 / gate[inside] ** 2)
        if solved is None or np.abs(solved[0][3:]).max() > _STRONGEST:
            return None
        coefficients = solved[0]
        now = np.abs(height - terms @ coefficients) < gate
        if np.array_equal(now, inside):
            break
        inside = now
    return coefficients, inside


def _reweighted(
    terms: FloatArray,
    height: FloatArray,
    sigma: FloatArray,
    inside: BoolArray,
    coefficients: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Tukey's biweight from the grown fit: coefficients, normal matrix, weights, scale."""
    scale = 1.0
    normal = np.eye(6)
    weights = inside.astype(np.float64)
    for _ in range(_REWEIGHTS):
        z = (height - terms @ coefficients) / sigma
        scale = max(1.4826 * float(np.median(np.abs(z[inside]))), 0.1)
        weights = np.where(inside, np.maximum(1.0 - (z / (_TUKEY * scale)) ** 2, 0.0) ** 2, 0.0)
        solved = _solve(terms, height, weights / sigma**2)
        if solved is None:
            break
        coefficients, normal = solved
    return coefficients, normal, weights, scale


def _shared(
    terms: FloatArray,
    per_px: FloatArray,
    sigma: FloatArray,
    weights: FloatArray,
    seen: Observations,
    normal: FloatArray,
    shared: SharedError,
) -> FloatArray:
    """Covariance of a shift and a tilt that all of a laser's stripe may share."""
    inverse = np.linalg.inv(normal)
    total = np.zeros((6, 6))
    pull = terms * (weights * per_px / sigma**2)[:, None]
    for laser in np.unique(seen.laser):
        mine = seen.laser == laser
        line = seen.line[mine]
        along = 2.0 * (line - line.min()) / max(np.ptp(line), 1.0) - 1.0
        for size, mode in ((shared.shift_px, np.ones_like(along)), (shared.tilt_px, along)):
            shift = size * inverse @ (pull[mine].T @ mode)
            total += np.outer(shift, shift)
    return total


def _asked_for(
    fit: PatchFit,
    terms: FloatArray,
    height: FloatArray,
    inside: BoolArray,
    on_plane: BoolArray,
    distance: float,
) -> bool:
    """Whether the residual of the plane asks for curvature."""
    bend = terms[inside, 3:] @ fit.patch.coefficients[3:]
    if np.ptp(bend) < _LEAST_BEND * distance:
        return False
    sigmas = np.sqrt(np.diag(fit.covariance)[3:])
    if np.abs(fit.patch.coefficients[3:] / sigmas).max() < _SIGNIFICANT:
        return False
    more = np.count_nonzero(inside) >= _MORE_LIGHT * np.count_nonzero(on_plane)
    return bool(more or fit.rms < _LESS_SCATTER * np.sqrt(np.mean(height[inside] ** 2)))


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
