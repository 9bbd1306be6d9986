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
    nearest_tangent,
    packed_plane,
    tangent_covariance,
)
from aqualvs.scanning.patch_kernels import COEFFICIENTS, RIGHT, UP
from aqualvs.scanning.plane_fit import SharedError
from aqualvs.scanning.quadric_kernels import N, fit_over, hinted_curvature
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

_WIDE_GATE = 3.0
_HINT = 2.0
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
    flat = packed_plane(plane)
    hint = hinted_curvature(seen.points, seen.sensitivity, seen.sigma_px, weights, flat)
    return bool(hint > _HINT)


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
    n = len(seen.line)
    inside = np.empty(n, np.bool_) if isinstance(start, float) else start.copy()
    patch, covariance, weights = packed_plane(plane), np.empty((N, N)), np.empty(n)
    found, asked_for, rms = fit_over(
        seen.points,
        seen.sensitivity,
        seen.sigma_px,
        seen.line,
        seen.laser,
        start if isinstance(start, float) else 0.0,
        shared.shift_px,
        shared.tilt_px,
        least_bend,
        inside,
        patch,
        covariance,
        weights,
    )
    if not found:
        return None
    bent = Patch(plane, patch[RIGHT:UP], patch[UP:COEFFICIENTS], patch[COEFFICIENTS:])
    return _Attempt(PatchFit(bent, covariance, weights, rms), asked_for)
