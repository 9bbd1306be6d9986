"""Curved nets: a paraboloid where a plane leaves too much over.

Over the plane that the search found, the net is a height

    h(u, v) = a + b u + c v + (p u² + 2 q u v + r v²) / 2

with u to the right and v upward in that plane. The plane touches the net along a band only; the fit
starts there and grows outward, because what it has learned in the band predicts the net beside it.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.scanning.patch import (
    FLAT,
    Patch,
    PatchFit,
    flat_patch,
    height_terms,
    nearest_tangent,
    tangent_covariance,
)
from aqualvs.scanning.plane_fit import SharedError
from aqualvs.scanning.readings import Observations

__all__ = (
    "FLAT",
    "LEAST_BEND",
    "Patch",
    "PatchFit",
    "fit_patch",
    "flat_patch",
    "hints_at_curvature",
    "nearest_tangent",
    "refit_at_nearest",
    "tangent_covariance",
)

LEAST_BEND = 0.003
"""By so much of the range a net must bend where it is seen, or it is flat."""

# Growth: steps, and the gate in shares of the range and in pixels.
_STEPS = 16
_GATE_SHARE = 0.004
_GATE_PX = 1.2
_WIDE_GATE = 3.0
_TUKEY = 4.685
_REWEIGHTS = 6
# What is expected of nets before looking, in 1/m: bent by a metre's radius, hardly twisted.
_SIGMA_CURVATURE = 2.0
_SIGMA_TWIST = 0.5
# The residual asks for curvature when it gains so much of the light or of the scatter ...
_MORE_LIGHT = 1.10
_LESS_SCATTER = 0.6
# ... and the curvature is no chance.
_SIGNIFICANT = 6.0
_HINT = 2.0
# Steeper bends than a radius of half a metre are something else.
_STRONGEST = 2.0
_MIN_PIECES = 12
# Strands on a bend err together more than on a plane: found on simulated nets.
_LOOSENED = 1.5


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
    terms = height_terms(seen.points @ flat.right, seen.points @ flat.up)
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


def fit_patch(
    seen: Observations, plane: Plane, shared: SharedError, least_bend: float = LEAST_BEND
) -> PatchFit | None:
    """Fit a patch to what lies on it among M observations, if they ask for one.

    Parameters
    ----------
    seen : Observations
        Of strands on the target and of any others that may lie on it, wrong readings included.
    plane : Plane
        As the search found it.
    shared : SharedError
        What each laser's stripe shares.
    least_bend : float
        Share of the range by which the net must bend where it is seen.

    Returns
    -------
    PatchFit or None
        None where a plane is as good, or the curvature is not determined.
    """
    # Of a coarse net few strands are on the plane, and the others not far from it.
    first = _fit_over(seen, plane, shared, 1.0, least_bend)
    first = first or _fit_over(seen, plane, shared, _WIDE_GATE, least_bend)
    return first.fit if first is not None and first.asked_for else None


def refit_at_nearest(fit: PatchFit, seen: Observations, shared: SharedError) -> PatchFit | None:
    """Fit a patch once more, over the plane that touches it at its point nearest to the vehicle.

    p and r are then the curvatures of the net at that point. The covariance is widened.

    Parameters
    ----------
    fit : PatchFit
        From `fit_patch`.
    seen, shared
        As there.

    Returns
    -------
    PatchFit or None
        None where there is no such point.
    """
    m = nearest_tangent(fit.patch)
    if m is None:
        return None
    inside = fit.weights > 0.0
    length = float(np.linalg.norm(m))
    again = _fit_over(seen, Plane(m / length, 1.0 / length), shared, inside)
    best = fit if again is None else again.fit
    return replace(best, covariance=_LOOSENED**2 * best.covariance)


class _Attempt(NamedTuple):
    """A patch over one base plane, and whether the base leaves too much over."""

    fit: PatchFit
    asked_for: bool


def _fit_over(
    seen: Observations,
    plane: Plane,
    shared: SharedError,
    start: BoolArray | float,
    least_bend: float = LEAST_BEND,
) -> _Attempt | None:
    """Fit a patch over a plane, grown from some observations or from those in so many gates."""
    flat = flat_patch(plane)
    u, v = seen.points @ flat.right, seen.points @ flat.up
    terms = height_terms(u, v)
    height = plane.signed_distance(seen.points)
    per_px = np.abs(seen.sensitivity @ plane.normal)
    gate = np.hypot(_GATE_SHARE * plane.offset, _GATE_PX * per_px)
    sigma = per_px * seen.sigma_px
    on_plane = np.abs(height) < gate
    inside = np.abs(height) < start * gate if isinstance(start, float) else start
    found = _grow(terms, height, gate, inside)
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
    asked = _asked_for(fit, terms, height, inside, on_plane, plane.offset, least_bend)
    return _Attempt(fit, asked)


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
    least_bend: float,
) -> bool:
    """Whether the residual of the plane asks for curvature."""
    bend = terms[inside, 3:] @ fit.patch.coefficients[3:]
    if np.ptp(bend) < least_bend * distance:
        return False
    sigmas = np.sqrt(np.diag(fit.covariance)[3:])
    if np.abs(fit.patch.coefficients[3:] / sigmas).max() < _SIGNIFICANT:
        return False
    more = np.count_nonzero(inside) >= _MORE_LIGHT * np.count_nonzero(on_plane)
    return bool(more or fit.rms < _LESS_SCATTER * np.sqrt(np.mean(height[inside] ** 2)))
