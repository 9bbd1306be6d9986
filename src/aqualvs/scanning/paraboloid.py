"""Curved nets: fit of a paraboloid, if the residuals of a plane show curvature.

Over the plane that the search found, the net has the height

    h(u, v) = a + b u + c v + (p u² + 2 q u v + r v²) / 2

with u to the right and v upward in that plane, in metres. The plane touches the net along a band
only; the fit starts there and grows outward, because the fitted band predicts the net beside it.
Each step is a weighted least-squares fit of the six coefficients.
"""

from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import ZERO, inner_borrowing_kernel, inner_kernel, lazy_kernel
from aqualvs.geometry.linear_algebra import (
    cholesky,
    cholesky_inverse,
    cholesky_solve,
    median_of,
    n_bins,
    squared,
)
from aqualvs.geometry.planes import Plane
from aqualvs.scanning.observations import Observations
from aqualvs.scanning.patch import (
    COEFFICIENTS,
    NORMAL,
    OFFSET,
    SIGMA_CURVATURE,
    SIGMA_TWIST,
    nearest_tangent,
    packed_plane,
    write_terms,
)
from aqualvs.scanning.patch import N_COEFFICIENTS as N
from aqualvs.scanning.plane_fit import TUKEY, SharedError, add_error

GATE_SHARE, GATE_PX = 0.004, 1.2
"""Largest distance of observations from a patch: as a share of the range, and in pixels."""
MIN_OBSERVATIONS = 12
"""Least number of observations of a patch."""


@lazy_kernel
def fit_over(
    seen: Observations,
    gates: float,
    shared: SharedError,
    min_bend: float,
    inside: BoolArray,
    patch: FloatArray,
    covariance: FloatArray,
    weights: FloatArray,
) -> tuple[bool, bool, float]:
    """Fit a patch over its base plane, grown from observations near the plane, or from `inside`.

    Parameters
    ----------
    seen : Observations
        M of them.
    gates : float
        The fit begins with observations within this many gates of the base; if 0, with `inside`.
    shared : SharedError
        Errors that they share.
    min_bend : float
        Least bend of the net between its visible points, as a share of the range.
    inside : bool array, shape (M,)
        Initial observations, unless `gates` selects them; then those of the grown fit.
    patch : array, shape (16,)
        The base, as `packed_plane` gives it; completed by the coefficients.
    covariance : array, shape (6, 6), weights : array, shape (M,)
        Written.

    Returns
    -------
    found, is_clear : bool
        Whether there is a fit, and whether it is clearly better than the plane.
    rms : float
        Weighted root mean square distance from the patch, in metres.
    """
    n, coefficients = seen.line.shape[0], patch[COEFFICIENTS:]
    terms, height, per_px = np.empty((n, N)), np.empty(n), np.empty(n)
    over_plane(seen.points, seen.sensitivity, patch, terms, height, per_px)
    gate, sigma, pull = np.empty(n), np.empty(n), np.empty(n)
    by_range = GATE_SHARE * patch[OFFSET]
    n_on_plane = ZERO
    for i in range(n):
        by_pixel = GATE_PX * abs(per_px[i])
        sigma[i] = abs(per_px[i]) * seen.sigma_px[i]
        gate[i] = np.sqrt(by_range * by_range + by_pixel * by_pixel + sigma[i] * sigma[i])
        n_on_plane += abs(height[i]) < gate[i]
        inside[i] = abs(height[i]) < gates * gate[i] if gates > 0.0 else inside[i]
    if not grow(terms, height, gate, inside, coefficients):
        return False, False, np.nan
    scale, rms, inverse = reweight(terms, height, sigma, inside, coefficients, weights)
    for j in range(N):
        for k in range(N):
            covariance[j, k] = inverse[j, k] * squared(max(scale, 1.0))
    for i in range(n):
        pull[i] = weights[i] * per_px[i] / (sigma[i] * sigma[i])
    add_shared(terms, pull, seen.line, seen.laser, shared, inverse, covariance)
    enough = min_bend * patch[OFFSET]
    is_clear = _is_clear(terms, height, inside, coefficients, covariance, n_on_plane, enough, rms)
    return True, is_clear, rms


@inner_borrowing_kernel
def _is_clear(
    terms: FloatArray,
    height: FloatArray,
    inside: BoolArray,
    coefficients: FloatArray,
    covariance: FloatArray,
    n_on_plane: int,
    min_bend: float,
    rms: float,
) -> bool:
    """Return whether a patch bends significantly, and fits clearly better than its base plane."""
    n_inside, square = 0, 0.0
    lowest, highest = np.inf, -np.inf
    for i in range(height.shape[0]):
        if inside[i]:
            bend = 0.0
            for k in range(3, N):
                bend += terms[i, k] * coefficients[k]
            lowest, highest = min(lowest, bend), max(highest, bend)
            square += height[i] * height[i]
            n_inside += 1
    if highest - lowest < min_bend:
        return False
    # Nets bulge; a strand along a diagonal stripe, off the middle of its sheet, looks like a twist.
    sigmas = 0.0
    for k in (3, 5):
        sigmas = max(sigmas, abs(coefficients[k]) / np.sqrt(covariance[k, k]))
    significant = 6.0  # In standard deviations.
    if sigmas < significant:
        return False
    # Least ratio of the observations on the patch to those on the plane, or largest ratio of their
    # scatter.
    more_observations = 1.10
    less_scatter = 0.6
    less = rms < less_scatter * np.sqrt(square / n_inside)
    return bool(n_inside >= more_observations * n_on_plane or less)


@inner_borrowing_kernel
def over_plane(
    points: FloatArray,
    sensitivity: FloatArray,
    patch: FloatArray,
    terms: FloatArray,
    height: FloatArray,
    per_px: FloatArray,
) -> None:
    """Write the terms of a fit over a patch's base for M observations.

    Parameters
    ----------
    points, sensitivity : array, shape (M, 3)
        In `dome`: metres, and m/px.
    patch : array, shape (16,)
        Only its base is used.
    terms : array, shape (M, 6)
        Written.
    height, per_px : array, shape (M,)
        Written: distance behind the plane, and its change by the stripe's position.
    """
    write_terms(points, patch, terms)
    for i in range(points.shape[0]):
        h, d = -patch[OFFSET], 0.0
        for k in range(3):
            h += patch[NORMAL + k] * points[i, k]
            d += patch[NORMAL + k] * sensitivity[i, k]
        height[i], per_px[i] = h, d


@inner_kernel
def _solve(
    terms: FloatArray,
    height: FloatArray,
    weight: FloatArray,
    factor: FloatArray,
    coefficients: FloatArray,
) -> bool:
    """Fit the coefficients (6,); write the Cholesky factor (6, 6) of the normal matrix to `factor`.

    The prior of the curvatures is included. Return False if the observations do not determine them.
    """
    right = np.zeros(N)
    factor[:] = 0.0
    for k in (3, 5):
        factor[k, k] = 1.0 / squared(SIGMA_CURVATURE)
    factor[4, 4] = 1.0 / squared(SIGMA_TWIST)
    for i in range(terms.shape[0]):
        w = weight[i]
        if w == 0.0:
            continue
        for j in range(N):
            part = w * terms[i, j]
            right[j] += part * height[i]
            for k in range(j + 1):
                factor[j, k] += part * terms[i, k]
    # Least pivot as a share of its diagonal element; a smaller one is rounding error.
    min_pivot = 1e-13
    if not cholesky(factor, 0.0, min_pivot, factor):
        return False
    cholesky_solve(factor, right, coefficients)
    return True


@lazy_kernel
def shows_curvature(seen: Observations, weights: FloatArray, patch: FloatArray) -> bool:
    """Return whether the residuals of a plane fit may be curved: a cheap test before a patch fit.

    Parameters
    ----------
    seen : Observations
        Those that the plane was fitted to, M of them.
    weights : array, shape (M,)
        Their weights in that fit.
    patch : array, shape (16,)
        The fit, from `packed_plane`.
    """
    # Least significance of the curvature, in sigmas, for which a patch is fitted. A robust plane
    # fit drops the strands that bend away from it: of 150 simulated nets that bulge, clearly bent
    # ones have 1.0 and more.
    hint = 1.0
    n = weights.shape[0]
    terms, height, weight = np.empty((n, N)), np.empty(n), np.empty(n)
    factor, coefficients = np.empty((N, N)), np.empty(N)
    over_plane(seen.points, seen.sensitivity, patch, terms, height, weight)
    for i in range(n):
        weight[i] = weights[i] / squared(abs(weight[i]) * seen.sigma_px[i])
    if not _solve(terms, height, weight, factor, coefficients) or n <= N:
        return False
    square = 0.0
    for i in range(n):
        off = height[i]
        for k in range(N):
            off -= terms[i, k] * coefficients[k]
        square += weight[i] * off * off
    scale = max(np.sqrt(square / (n - N)), 1.0)
    inverse = cholesky_inverse(factor)
    strongest = 0.0
    for k in range(3, N):
        strongest = max(strongest, abs(coefficients[k]) / (np.sqrt(inverse[k, k]) * scale))
    return bool(strongest > hint)


@inner_kernel
def grow(
    terms: FloatArray,
    height: FloatArray,
    gate: FloatArray,
    inside: BoolArray,
    coefficients: FloatArray,
) -> bool:
    """Fit the observations `inside`, and select those near the fit anew, until nothing changes.

    `inside` (M,) holds the initial observations, and is overwritten. Return False if too few
    observations are left, or if the fit is implausible.
    """
    n = height.shape[0]
    weight, factor = np.empty(n), np.empty((N, N))
    steps = 16
    # Largest curvature in 1/m: a net does not bend with a radius below half a metre.
    strongest = 2.0
    for _ in range(steps):
        n_inside = 0
        for i in range(n):
            weight[i] = 1.0 / (gate[i] * gate[i]) if inside[i] else 0.0
            n_inside += inside[i]
        if n_inside < MIN_OBSERVATIONS or not _solve(terms, height, weight, factor, coefficients):
            return False
        for k in range(3, N):
            if abs(coefficients[k]) > strongest:
                return False
        changed, n_inside = False, 0
        for i in range(n):
            off = height[i]
            for k in range(N):
                off -= terms[i, k] * coefficients[k]
            now = abs(off) < gate[i]
            changed |= now != inside[i]
            inside[i] = now
            n_inside += now
        if not changed:
            break
    return n_inside >= MIN_OBSERVATIONS


@inner_kernel
def reweight(
    terms: FloatArray,
    height: FloatArray,
    sigma: FloatArray,
    inside: BoolArray,
    coefficients: FloatArray,
    weights: FloatArray,
) -> tuple[float, float, FloatArray]:
    """Refine the coefficients of a grown fit with Tukey's biweight, in place; write `weights` (M,).

    Return the scale of the residuals in sigmas, the weighted rms in metres, and the inverse (6, 6)
    of the normal matrix.
    """
    n = height.shape[0]
    z, weight = np.empty(n), np.empty(n)
    factor, known = np.empty((N, N)), np.zeros((N, N))
    for k in range(N):
        known[k, k] = 1.0
    scale = 1.0
    reweights = 6
    for _ in range(reweights):
        n_inside = 0
        for i in range(n):
            off = height[i]
            for k in range(N):
                off -= terms[i, k] * coefficients[k]
            z[i] = off / sigma[i]
            if inside[i]:
                weight[n_inside] = abs(z[i])
                n_inside += 1
        scale = max(1.4826 * median_of(weight[:n_inside]), 0.1)
        for i in range(n):
            rest = max(1.0 - squared(z[i] / (TUKEY * scale)), 0.0)
            weights[i] = rest * rest if inside[i] else 0.0
            weight[i] = weights[i] / (sigma[i] * sigma[i])
        if not _solve(terms, height, weight, factor, coefficients):
            break
        factor, known = known, factor
    square, total = 0.0, 0.0
    for i in range(n):
        off = height[i]
        for k in range(N):
            off -= terms[i, k] * coefficients[k]
        square += weights[i] * off * off
        total += weights[i]
    return scale, np.sqrt(square / total), cholesky_inverse(known)


@inner_kernel
def add_shared(
    terms: FloatArray,
    pull: FloatArray,
    line: FloatArray,
    laser: IntArray,
    shared: SharedError,
    inverse: FloatArray,
    covariance: FloatArray,
) -> None:
    """Add the covariance of the errors that one laser's stripe shares, and those that all share.

    Parameters
    ----------
    terms : array, shape (M, 6)
        From `over_plane`.
    pull : array, shape (M,)
        Weight of each observation times the derivative of its height by the stripe's position.
    line : array, shape (M,)
        Search lines.
    laser : int array, shape (M,)
    shared : SharedError
    inverse : array, shape (6, 6)
        Of the normal matrix.
    covariance : array, shape (6, 6)
        Completed in place.
    """
    for index in range(n_bins(laser)):
        low, high = np.inf, -np.inf
        for i in range(laser.shape[0]):
            if laser[i] == index:
                low, high = min(low, line[i]), max(high, line[i])
        if low == np.inf:
            continue
        sums = np.zeros((2, N))
        for i in range(laser.shape[0]):
            if laser[i] == index:
                along = 2.0 * (line[i] - low) / max(high - low, 1.0) - 1.0
                for k in range(N):
                    sums[0, k] += shared.own[i] * pull[i] * terms[i, k]
                    sums[1, k] += shared.own[i] * pull[i] * terms[i, k] * along
        add_error(sums[0], inverse, covariance)
        add_error(sums[1], inverse, covariance)
    for cause in range(shared.common.shape[0]):
        together = np.zeros(N)
        for i in range(laser.shape[0]):
            for k in range(N):
                together[k] += shared.common[cause, i] * pull[i] * terms[i, k]
        add_error(together, inverse, covariance)


MIN_BEND = 0.003
"""Least bend of a curved net between its visible points, as a share of the range."""


@dataclass(frozen=True, slots=True)
class PatchFit:
    """A patch that was fitted over a base plane."""

    patch: FloatArray  # Shape (16,): by robust least squares.
    covariance: FloatArray  # Shape (6, 6): of its coefficients.
    weights: FloatArray  # Shape (M,): robust weight of each observation, 0 to 1.
    rms: float  # Weighted root mean square distance from the patch, in metres.
    is_clear: bool  # Whether it is clearly better than the plane.


def fit_patch(
    seen: Observations, plane: Plane, shared: SharedError, min_bend: float = MIN_BEND
) -> PatchFit | None:
    """Fit a patch to M observations, and compare it with the plane.

    Parameters
    ----------
    seen : Observations
        Of strands on the target and of any others that may lie on it, wrong candidates included.
    plane : Plane
        As the search found it.
    shared : SharedError
        Errors that they share.
    min_bend : float
        Least bend of the net between its visible points, as a share of the range.

    Returns
    -------
    PatchFit or None
        None if the curvature is not determined.
    """
    first = _fit_over(seen, plane, shared, 1.0, min_bend)
    # In gates. Few strands of a coarse net are on the plane, but the others not far from it.
    wide_gate = 3.0
    return first or _fit_over(seen, plane, shared, wide_gate, min_bend)


def refit_at_nearest(fit: PatchFit, seen: Observations, shared: SharedError) -> PatchFit | None:
    """Fit a patch once more, over the plane that touches it at its point nearest to the vehicle.

    p and r are then the curvatures of the net at that point.

    Parameters
    ----------
    fit : PatchFit
        From `fit_patch`.
    seen, shared
        As there.

    Returns
    -------
    PatchFit or None
        None if there is no such point.
    """
    m = nearest_tangent(fit.patch)
    if m is None:
        return None
    length = float(np.linalg.norm(m))
    return _fit_over(seen, Plane(m / length, 1.0 / length), shared, fit.weights > 0.0) or fit


def _fit_over(
    seen: Observations,
    plane: Plane,
    shared: SharedError,
    start: BoolArray | float,
    min_bend: float = MIN_BEND,
) -> PatchFit | None:
    """Fit a patch over a plane, grown from `start`: so many gates, or a mask to be overwritten."""
    n = seen.n
    gates, inside = (start, np.empty(n, np.bool_)) if isinstance(start, float) else (0.0, start)
    patch, covariance, weights = packed_plane(plane), np.empty((N, N)), np.empty(n)
    found, is_clear, rms = fit_over(
        seen, gates, shared, min_bend, inside, patch, covariance, weights
    )
    return PatchFit(patch, covariance, weights, rms, is_clear) if found else None
