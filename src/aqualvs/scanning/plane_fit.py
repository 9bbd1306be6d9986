"""Plane fits to triangulated stripes: the paper's pseudo-inverse and the robust default."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import inner_kernel, lazy_kernel
from aqualvs.geometry.linear_algebra import (
    cholesky,
    cholesky_solve,
    invert_symmetric,
    median_of,
    n_bins,
    solve_symmetric,
    squared,
)

SHARED_ERROR_PX = 0.015
"""Standard deviations of the shift of one laser's stripe in one frame, and of its tilt at the image
border, in pixels.

Optics, sampling and compression move a whole stripe by about this much in a good picture. Residuals
of single points do not show it, but the common plane of the stripes of one frame does.
"""
# Squared factors on the standard deviations of shared errors, among which a frame's is estimated.
_SQUARES = 4.0 ** np.linspace(-3.0, 3.0, 13)
TWINE_SHARE = 0.006
"""Standard deviation of the shift of the light on twine, as a share of the stripe's width.

Twine is round and brightest in front. The shift is a length on the target, and so is proportional
to the stripe's width in every picture.
"""
GLOW_PX = 0.5
"""Standard deviation of the shift of a stripe, in pixels, for a background that is as much brighter
on one side as the stripe is high.

Glow in the water ends at the stripe, at a position that the camera blurs. This error remains after
the pull of a ramp is subtracted.
"""
GLOW_SHARE = 1.0
"""The same for the light on twine, as a share of the stripe's width.

Beside strands that run across the search line the glow on both flanks is the same, so that the
smaller part is measured and subtracted. On rendered nets, in clear and turbid water, the remaining
shift is 0.4 to 1.4 of this.
"""


class SharedError(NamedTuple):
    """Errors that points share, as standard deviations at each of N points in pixels."""

    # Shape (N,): shift of the stripe of one laser, and equally its tilt at the image border.
    own: FloatArray
    # Shape (K, N): shift of all stripes together, one row for each cause, with its sign.
    common: FloatArray


def shared_error(
    glow_px: FloatArray, twine_px: FloatArray | None = None, position_px: FloatArray | float = 1.0
) -> SharedError:
    """Return the errors that N points on a solid surface or on a net share.

    Parameters
    ----------
    glow_px : array, shape (N,)
        Shift by glow in the water, with its sign. All stripes share it.
    twine_px : array, shape (N,), optional
        Shift of the light on twine, with the sign that brings the point nearer. All stripes share
        it, and those of one laser a second error of the same size. None on something solid.
    position_px : float or array, shape (N,)
        Pixels from one position of the search line to the next; 2 along the columns of a field.
    """
    own = np.full(len(glow_px), SHARED_ERROR_PX) * position_px
    if twine_px is None:
        return SharedError(own, glow_px[None])
    return SharedError(np.hypot(own, twine_px), np.array([glow_px, twine_px]))


TUKEY = 4.685
"""Cut of Tukey's biweight, in standard deviations: 95 % efficiency for normal errors."""
_ITERATIONS = 6
# Weight of the stated errors relative to the scatter of the residuals, in observations.
_STATED_COUNT = 10.0


@dataclass(frozen=True, slots=True)
class PlaneFit:
    """A fitted plane m·X = 1 with its covariance."""

    m: FloatArray  # Shape (3,): normal divided by distance (paper, Eq. 23), in 1/m.
    covariance: FloatArray  # Shape (3, 3): of `m`, in 1/m².
    weights: FloatArray  # Shape (N,): robust weight of each point, 0 (outlier) to 1.
    rms: float  # Weighted root mean square distance of the points from the plane, in metres.


def fit_pseudo_inverse(points: FloatArray, n_groups: int, covariance: FloatArray) -> PlaneFit:
    """Fit m·X = 1 by the left pseudo-inverse (paper, Eq. 24), with equal weights for all points.

    Parameters
    ----------
    points : array, shape (N, 3)
        In `dome`, metres; N >= 3 and not collinear.
    n_groups : int
        Number of weights to return, all 1.
    covariance : array, shape (3, 3)
        Covariance to return: the pseudo-inverse itself gives none.
    """
    m = np.asarray(np.linalg.lstsq(points, np.ones(len(points)))[0], dtype=np.float64)
    residual = (points @ m - 1.0) / np.linalg.norm(m)
    rms = float(np.sqrt(np.mean(residual**2)))
    return PlaneFit(m, covariance, np.ones(n_groups), rms)


def fit_robust(
    points: FloatArray,
    sensitivity: FloatArray,
    sigma_px: FloatArray,
    laser: IntArray,
    along: FloatArray,
    start: FloatArray,
    shared: SharedError,
) -> PlaneFit | None:
    """Fit m·X = 1 by iteratively re-weighted least squares with Tukey's biweight.

    Each residual is divided by its standard deviation from the observation's position error, so
    that near and far, square and grazing observations are weighted correctly.

    Parameters
    ----------
    points, sensitivity : array, shape (N, 3)
        Points in `dome` (m) and their derivatives by the stripe's position (m/px). Errors of
        different points should be independent: take centroids of subsegments rather than single
        peaks, which share the errors of their neighbours.
    sigma_px : array, shape (N,)
        Standard deviation of the stripe's position. If the residuals scatter more, the covariance
        increases accordingly; if they scatter less, only in part.
    laser : int array, shape (N,)
        Index of the laser.
    along : array, shape (N,)
        Place along the stripe, from -1 at one image border to 1 at the other.
    start : array, shape (3,)
        Initial m, as from RANSAC.
    shared : SharedError
        Errors that the points share. The size of `own` in this frame is estimated from the distance
        of the lasers' stripes from their common plane.

    Returns
    -------
    PlaneFit or None
        None if the points do not determine a plane. The covariance follows from the actual
        residuals (Huber 1981, section 7.6), inflated by the errors that stripes share.
    """
    m = np.array(start, dtype=np.float64)
    covariance = np.empty((3, 3))
    weights = np.empty(len(points))
    rms = _fit(points, sensitivity, sigma_px, laser, along, shared, m, covariance, weights)
    if not math.isfinite(rms):
        return None
    return PlaneFit(m, covariance, weights, rms)


@lazy_kernel
def plane_of_all(points: FloatArray, m: FloatArray) -> bool:
    """Write m of the least-squares plane m·X = 1 of points (N, 3); False if undetermined."""
    normal, right, inverse = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    one = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        one[i] = 1.0
    normal_equations(points, one, one, normal, right)
    return solve_symmetric(normal, right, inverse, m)


@inner_kernel
def _normalised_residuals(
    points: FloatArray,
    sensitivity: FloatArray,
    sigma_px: FloatArray,
    m: FloatArray,
    sigma: FloatArray,
    z: FloatArray,
) -> None:
    """Write the residuals z (N,) of m·X = 1 in sigmas, and these sigmas (N,)."""
    for i in range(points.shape[0]):
        per_px = m[0] * sensitivity[i, 0] + m[1] * sensitivity[i, 1] + m[2] * sensitivity[i, 2]
        sigma[i] = abs(per_px) * sigma_px[i] + 1e-12
        value = m[0] * points[i, 0] + m[1] * points[i, 1] + m[2] * points[i, 2]
        z[i] = (value - 1.0) / sigma[i]


@inner_kernel
def normal_equations(
    points: FloatArray,
    sigma: FloatArray,
    weights: FloatArray,
    normal: FloatArray,
    right: FloatArray,
) -> None:
    """Write the weighted normal equations of X·m = 1: lower triangle (3, 3) and right side (3,)."""
    normal[:] = 0.0
    right[:] = 0.0
    for i in range(points.shape[0]):
        w = weights[i] / (sigma[i] * sigma[i])
        for j in range(3):
            right[j] += w * points[i, j]
            for k in range(j + 1):
                normal[j, k] += w * points[i, j] * points[i, k]


@lazy_kernel
def _fit(
    points: FloatArray,
    sensitivity: FloatArray,
    sigma_px: FloatArray,
    laser: IntArray,
    along: FloatArray,
    shared: SharedError,
    m: FloatArray,
    covariance: FloatArray,
    weights: FloatArray,
) -> float:
    """Refine m (3,) in place, write covariance (3, 3) and weights (N,); return the rms in metres.

    NaN if the points do not determine a plane. Arguments as of `fit_robust`.
    """
    n = points.shape[0]
    z = np.empty(n)
    sigma = np.empty(n)
    normal = np.empty((3, 3))
    inverse = np.empty((3, 3))
    right = np.empty(3)
    scale = 1.0
    for _ in range(_ITERATIONS):
        _normalised_residuals(points, sensitivity, sigma_px, m, sigma, z)
        for i in range(n):
            weights[i] = abs(z[i])
        scale = max(1.4826 * median_of(weights), 0.1)
        for i in range(n):
            ratio = z[i] / (TUKEY * scale)
            kept = max(1.0 - ratio * ratio, 0.0)
            weights[i] = kept * kept
        normal_equations(points, sigma, weights, normal, right)
        if not solve_symmetric(normal, right, inverse, m):
            return np.nan
    _normalised_residuals(points, sensitivity, sigma_px, m, sigma, z)
    factor = _huber_factor(z, TUKEY * scale)
    if factor < 1.0:
        # With few observations, a scatter below the stated errors may be chance.
        factor = (_STATED_COUNT + n * factor) / (_STATED_COUNT + n)
    weight, per_px = np.empty(n), np.empty(n)
    for i in range(n):
        weight[i] = 1.0
    normal_equations(points, sigma, weight, normal, right)
    if not (invert_symmetric(normal, covariance) and math.isfinite(factor)):
        return np.nan
    for j in range(3):
        for k in range(3):
            covariance[j, k] *= factor
    # From here on `z` is m·X - 1.
    for i in range(n):
        weight[i] = weights[i] / (sigma[i] * sigma[i])
        per_px[i] = m[0] * sensitivity[i, 0] + m[1] * sensitivity[i, 1] + m[2] * sensitivity[i, 2]
        z[i] *= sigma[i]
    _add_own_errors(
        points, per_px, weight, z, laser, along, shared.own, factor, inverse, covariance
    )
    for k in range(shared.common.shape[0]):
        for j in range(3):
            right[j] = 0.0
        for i in range(n):
            for j in range(3):
                right[j] += per_px[i] * weight[i] * shared.common[k, i] * points[i, j]
        add_error(right, inverse, covariance)
    for j in range(3):
        for k in range(3):
            if not math.isfinite(covariance[j, k]):
                return np.nan
    return _weighted_rms(z, weights, m)


@inner_kernel
def _huber_factor(z: FloatArray, cut: float) -> float:
    """Return the factor on the inverse of the unweighted normal matrix (Huber 1981, section 7.6).

    With it, outliers add no information. Infinite if undetermined.
    """
    n = z.shape[0]
    if n <= 3:
        return np.inf
    scatter = 0.0
    slope = 0.0
    for i in range(n):
        u = squared(z[i] / cut)
        if u < 1.0:
            scatter += squared(z[i] * squared(1.0 - u))
            slope += (1.0 - u) * (1.0 - 5.0 * u)
    slope /= n
    if not slope > 0.0:
        return np.inf
    correction = 1.0 + 3.0 / n * (1.0 - slope) / slope
    return float(squared(correction) * scatter / (n - 3) / squared(slope))


@inner_kernel
def _add_own_errors(
    points: FloatArray,
    per_px: FloatArray,
    weight: FloatArray,
    off: FloatArray,
    laser: IntArray,
    along: FloatArray,
    own: FloatArray,
    factor: float,
    inverse: FloatArray,
    covariance: FloatArray,
) -> None:
    """Inflate the covariance by a shift and a tilt of each laser, as large as the frame shows.

    `off` (N,) is m·X - 1, `per_px` (N,) its derivative by the stripe's position; `factor` is the
    factor on the points' variances, `inverse` (3, 3) that of the weighted normal matrix.
    """
    n_modes = 2 * n_bins(laser)
    pull, residual = np.zeros((n_modes, 3)), np.zeros(n_modes)
    matrix = np.zeros((n_modes, n_modes))
    for i in range(points.shape[0]):
        shift = per_px[i] * own[i]
        tilt = shift * along[i]
        a = 2 * laser[i]
        for k in range(3):
            pull[a, k] += weight[i] * shift * points[i, k]
            pull[a + 1, k] += weight[i] * tilt * points[i, k]
        residual[a] -= weight[i] * shift * off[i]
        residual[a + 1] -= weight[i] * tilt * off[i]
        matrix[a, a] += weight[i] * shift * shift
        matrix[a + 1, a] += weight[i] * shift * tilt
        matrix[a + 1, a + 1] += weight[i] * tilt * tilt
    moved = np.zeros((n_modes, 3))
    for a in range(n_modes):
        for j in range(3):
            for k in range(3):
                moved[a, j] += inverse[j, k] * pull[a, k]
    # The part of the errors that a plane can follow does not show in the residuals.
    for a in range(n_modes):
        for b in range(a + 1):
            for k in range(3):
                matrix[a, b] -= moved[a, k] * pull[b, k]
    for a in range(n_modes):
        residual[a] /= factor
        for b in range(n_modes):
            matrix[a, b] /= factor
    scale = _expected_square(matrix, residual)
    for a in range(n_modes):
        for j in range(3):
            for k in range(3):
                covariance[j, k] += scale * moved[a, j] * moved[a, k]


@inner_kernel
def _expected_square(matrix: FloatArray, residual: FloatArray) -> float:
    """Return the expected squared factor t on shared errors, given the residuals of a frame.

    The mean over `_SQUARES`, weighted by the marginal likelihood of normal errors with variance t
    (Rasmussen and Williams 2006, Eq. 2.30) times the prior of t. `matrix` (K, K) is the information
    of the frame on the K errors, in its lower triangle; `residual` (K,) is that times their
    estimate.
    """
    # Prior: the logarithm of the standard deviation has that of this factor as its own. Rendered
    # walls have 0.01 to 0.06 px, the most with strong compression.
    pictures_differ = 4.0
    n_modes, spread = residual.shape[0], 2.0 * math.log(pictures_differ)
    lower, solved = np.empty((n_modes, n_modes)), np.empty(n_modes)
    log_weight, most = np.empty(_SQUARES.shape[0]), -np.inf
    for f in range(_SQUARES.shape[0]):
        t = _SQUARES[f]
        log_weight[f] = -np.inf
        for a in range(n_modes):
            for b in range(a):
                lower[a, b] = matrix[a, b]
            lower[a, a] = max(matrix[a, a], 0.0) + 1.0 / t
        if not cholesky(lower, 0.0, 0.0, lower):
            continue
        cholesky_solve(lower, residual, solved)
        total = -squared(math.log(t) / spread) - n_modes * math.log(t)
        for a in range(n_modes):
            total += residual[a] * solved[a] - 2.0 * math.log(lower[a, a])
        log_weight[f] = 0.5 * total
        if math.isnan(log_weight[f]):
            return 1.0
        most = max(most, log_weight[f])
    if not math.isfinite(most):
        return 1.0
    weighted, weight = 0.0, 0.0
    for f in range(_SQUARES.shape[0]):
        one = math.exp(log_weight[f] - most)
        weighted += one * _SQUARES[f]
        weight += one
    return float(weighted / weight)


@inner_kernel
def add_error(pull: FloatArray, inverse: FloatArray, covariance: FloatArray) -> None:
    """Inflate a covariance (K, K) by an error that all observations share.

    `pull` (K,) is the change of the right side of the normal equations by one standard deviation,
    `inverse` (K, K) the inverse of their matrix.
    """
    moved = np.zeros(pull.shape[0])
    for j in range(pull.shape[0]):
        for k in range(pull.shape[0]):
            moved[j] += inverse[j, k] * pull[k]
    for j in range(pull.shape[0]):
        for k in range(pull.shape[0]):
            covariance[j, k] += moved[j] * moved[k]


@inner_kernel
def _weighted_rms(off: FloatArray, weights: FloatArray, m: FloatArray) -> float:
    """Return the weighted rms distance in metres, given m·X - 1."""
    total, weight = 0.0, 0.0
    for i in range(off.shape[0]):
        total += weights[i] * off[i] * off[i]
        weight += weights[i]
    length = np.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
    return float(np.sqrt(total / weight) / length)


@lazy_kernel
def mark_inliers(
    group: IntArray,
    laser: IntArray,
    weights: FloatArray,
    of_all: bool,
    points: FloatArray,
    inliers: BoolArray,
) -> tuple[int, float, int]:
    """Mark the inliers of a fit to M observations among N candidates.

    Parameters
    ----------
    group : int array, shape (N,)
        As in `Observed`.
    laser : int array, shape (M,), weights : array, shape (M,)
        Of the observations.
    of_all : bool
        Whether `second` counts observations without weight, too.
    points : array, shape (N, 3)
        Of the candidates.
    inliers : bool array, shape (N,)
        Written.

    Returns
    -------
    n_points : int
        Number of inliers.
    nearest : float
        Distance of the nearest of them from the origin, in metres.
    second : int
        Number of observations of the second best laser.
    """
    n, square = 0, np.inf
    for i in range(group.shape[0]):
        inliers[i] = group[i] >= 0 and weights[group[i]] > 0.0
        if inliers[i]:
            n += 1
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            square = min(square, x * x + y * y + z * z)
    n_lasers = n_bins(laser)
    observations = np.zeros(n_lasers, np.int64)
    for k in range(laser.shape[0]):
        observations[laser[k]] += of_all or weights[k] > 0.0
    best, second = 0, 0
    for index in range(n_lasers):
        second = max(second, min(best, observations[index]))
        best = max(best, observations[index])
    return n, np.sqrt(square), second


@lazy_kernel
def weigh_candidates(
    group: IntArray,
    m: FloatArray,
    sensitivity: FloatArray,
    sigma_px: FloatArray,
    fit_weights: FloatArray,
    alike: bool,
    weights: FloatArray,
) -> None:
    """Write the weight of each candidate in a fit: an equal share of its observation's.

    Parameters
    ----------
    group : int array, shape (N,)
        As in `Observed`.
    m : array, shape (3,)
        Of the plane.
    sensitivity, sigma_px, fit_weights : array, shape (M, 3), (M,), (M,)
        Of the observations.
    alike : bool
        Whether the fit gave all observations equal weights, regardless of their errors.
    weights : array, shape (N,)
        Written: 1 over the variance of m·X; 0 for outliers.
    """
    count, weight = np.zeros(sigma_px.shape[0]), np.empty(sigma_px.shape[0])
    for i in range(group.shape[0]):
        if group[i] >= 0:
            count[group[i]] += 1.0
    for c in range(sigma_px.shape[0]):
        per_px = m[0] * sensitivity[c, 0] + m[1] * sensitivity[c, 1] + m[2] * sensitivity[c, 2]
        sigma = 1.0 if alike else abs(per_px) * sigma_px[c] + 1e-12
        weight[c] = fit_weights[c] / (sigma * sigma * count[c])
    for i in range(group.shape[0]):
        weights[i] = weight[group[i]] if group[i] >= 0 else 0.0
