"""Plane fits to triangulated stripes: the paper's pseudo-inverse and the robust default."""

import math
from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import kernel
from aqualvs.geometry.linear_algebra import invert_symmetric, solve_symmetric


@dataclass(frozen=True, slots=True)
class SharedError:
    """Error common to all of one laser's stripe in one frame, as standard deviations.

    Texture, compression, the sheet's own profile and the glow beside it move a whole stripe, not
    only single points; residuals of the fit do not show this error.

    Attributes
    ----------
    shift_px : float
        Of the whole stripe.
    tilt_px : float
        At the image border, of a shift that grows from the image centre.
    """

    shift_px: float
    tilt_px: float


# Found on the simulator and on independently rendered dives alike.
SOLID_ERROR = SharedError(shift_px=0.035, tilt_px=0.035)
"""For unbroken stripes."""
MESH_ERROR = SharedError(shift_px=0.08, tilt_px=0.12)
"""For the broken stripes of a net: strands are cut off by knots, seams and each other."""
# A strand's light is brightest on the twine's front, and blur takes away the light on its edges:
# its centroid lies before the mean of the surface it lights. On rendered nets of twelve kinds, in
# clear and turbid water, all strands alike were 0.05 to 0.18 px off, to the near side; how far
# depends on twine, growth and water, so that it is an error and no correction.
TWINE_ERROR_PX = 0.11
"""Standard deviation of the shift of all strands of a net alike, along the search lines."""

_TUKEY = 4.685  # 95 % efficiency for normal errors
_ITERATIONS = 6
# The stated errors count as much as the scatter of this many observations.
_STATED_COUNT = 30.0


@dataclass(frozen=True, slots=True)
class PlaneFit:
    """A fitted plane m·X = 1 with its covariance.

    Attributes
    ----------
    m : array, shape (3,)
        Normal divided by distance (paper, Eq. 23), in 1/m.
    covariance : array, shape (3, 3)
        Of `m`, in 1/m².
    weights : array, shape (N,)
        Robust weight of each point, 0 (outlier) to 1.
    rms : float
        Weighted root mean square distance of the points from the plane, in metres.
    """

    m: FloatArray
    covariance: FloatArray
    weights: FloatArray
    rms: float


def fit_pseudo_inverse(points: FloatArray, n_groups: int, covariance: FloatArray) -> PlaneFit:
    """Fit m·X = 1 by the left pseudo-inverse (paper, Eq. 24): equal weights, outliers included.

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
    common: FloatArray | None = None,
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
        Least standard deviation of the stripe's position; greater scatter is recognised.
    laser : int array, shape (N,)
        Index of the laser.
    along : array, shape (N,)
        Place along the stripe, from -1 at one image border to 1 at the other.
    start : array, shape (3,)
        A first m, such as RANSAC gives.
    shared : SharedError
        Error that each laser's stripe shares.
    common : array, shape (N,), optional
        Error that all stripes share: one standard deviation of it at each point, in pixels, with
        its sign. None if left out.

    Returns
    -------
    PlaneFit or None
        None where the points do not determine a plane. The covariance follows from the actual
        residuals (Huber 1981, section 7.6), widened by the errors that stripes share.
    """
    m = np.array(start, dtype=np.float64)
    covariance = np.empty((3, 3))
    weights = np.empty(len(points))
    modes = shared.shift_px, shared.tilt_px
    common = np.zeros(len(points)) if common is None else common
    rms = _fit(points, sensitivity, sigma_px, laser, along, common, modes, m, covariance, weights)
    if not math.isfinite(rms):
        return None
    return PlaneFit(m, covariance, weights, rms)


@kernel
def plane_of_all(points: FloatArray, m: FloatArray) -> bool:
    """Write the m of m·X = 1 that best fits points (N, 3), unweighted; False if undetermined."""
    normal, right, inverse = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    one = np.ones(points.shape[0])
    normal_equations(points, one, one, normal, right)
    return solve_symmetric(normal, right, inverse, m)


@kernel
def _normalised_residuals(
    points: FloatArray,
    sensitivity: FloatArray,
    sigma_px: FloatArray,
    m: FloatArray,
    sigma: FloatArray,
    z: FloatArray,
) -> None:
    """Return the residuals of m·X = 1 over their sigma by pixel error (written to `sigma`)."""
    for i in range(points.shape[0]):
        per_px = m[0] * sensitivity[i, 0] + m[1] * sensitivity[i, 1] + m[2] * sensitivity[i, 2]
        sigma[i] = abs(per_px) * sigma_px[i] + 1e-12
        value = m[0] * points[i, 0] + m[1] * points[i, 1] + m[2] * points[i, 2]
        z[i] = (value - 1.0) / sigma[i]


@kernel
def normal_equations(
    points: FloatArray,
    sigma: FloatArray,
    weights: FloatArray,
    normal: FloatArray,
    right: FloatArray,
) -> None:
    """Write the weighted normal equations of X·m = 1; the lower half of the matrix suffices."""
    normal[:] = 0.0
    right[:] = 0.0
    for i in range(points.shape[0]):
        w = weights[i] / (sigma[i] * sigma[i])
        for j in range(3):
            right[j] += w * points[i, j]
            for k in range(j + 1):
                normal[j, k] += w * points[i, j] * points[i, k]


@kernel
def _fit(
    points: FloatArray,
    sensitivity: FloatArray,
    sigma_px: FloatArray,
    laser: IntArray,
    along: FloatArray,
    common: FloatArray,
    modes: tuple[float, float],
    m: FloatArray,
    covariance: FloatArray,
    weights: FloatArray,
) -> float:
    n = points.shape[0]
    z = np.empty(n)
    sigma = np.empty(n)
    normal = np.empty((3, 3))
    inverse = np.empty((3, 3))
    right = np.empty(3)
    scale = 1.0
    for _ in range(_ITERATIONS):
        _normalised_residuals(points, sensitivity, sigma_px, m, sigma, z)
        scale = max(1.4826 * np.median(np.abs(z)), 0.1)
        for i in range(n):
            ratio = z[i] / (_TUKEY * scale)
            kept = max(1.0 - ratio * ratio, 0.0)
            weights[i] = kept * kept
        normal_equations(points, sigma, weights, normal, right)
        if not solve_symmetric(normal, right, inverse, m):
            return np.nan
    _normalised_residuals(points, sensitivity, sigma_px, m, sigma, z)
    factor = _huber_factor(z, _TUKEY * scale)
    if factor < 1.0:
        # With few observations, a scatter below the stated errors is chance.
        factor = (_STATED_COUNT + n * factor) / (_STATED_COUNT + n)
    normal_equations(points, sigma, np.ones(n), normal, right)
    if not invert_symmetric(normal, covariance):
        return np.nan
    covariance *= factor
    _add_shared_error(
        points, sensitivity, sigma, weights, laser, along, common, modes, m, inverse, covariance
    )
    if not np.isfinite(covariance).all():
        return np.nan
    return _weighted_rms(sigma, z, weights, m)


@kernel
def _huber_factor(z: FloatArray, cut: float) -> float:
    """Return the factor on the unweighted inverse of the normal matrix (Huber 1981, section 7.6).

    Accounts for outliers: they add no information, and the fit ignores them.
    """
    n = z.shape[0]
    if n <= 3:
        return np.inf
    scatter = 0.0
    slope = 0.0
    for i in range(n):
        u = (z[i] / cut) ** 2
        if u < 1.0:
            scatter += (z[i] * (1.0 - u) ** 2) ** 2
            slope += (1.0 - u) * (1.0 - 5.0 * u)
    slope /= n
    if not slope > 0.0:
        return np.inf
    correction = 1.0 + 3.0 / n * (1.0 - slope) / slope
    return float(correction**2 * scatter / (n - 3) / slope**2)


@kernel
def _add_shared_error(
    points: FloatArray,
    sensitivity: FloatArray,
    sigma: FloatArray,
    weights: FloatArray,
    laser: IntArray,
    along: FloatArray,
    common: FloatArray,
    modes: tuple[float, float],
    m: FloatArray,
    inverse: FloatArray,
    covariance: FloatArray,
) -> None:
    """Widen by one shift and one tilt for each laser, each of its own, and by the common error."""
    n_lasers = 0
    for i in range(laser.shape[0]):
        n_lasers = max(n_lasers, laser[i] + 1)
    pull, together = np.zeros((n_lasers, 2, 3)), np.zeros(3)
    shift = np.empty(3)
    for i in range(points.shape[0]):
        per_px = m[0] * sensitivity[i, 0] + m[1] * sensitivity[i, 1] + m[2] * sensitivity[i, 2]
        w = weights[i] * per_px / (sigma[i] * sigma[i])
        for k in range(3):
            pull[laser[i], 0, k] += w * points[i, k]
            pull[laser[i], 1, k] += w * points[i, k] * along[i]
            together[k] += w * points[i, k] * common[i]
    for index in range(n_lasers):
        for mode in range(2):
            for j in range(3):
                shift[j] = 0.0
                for k in range(3):
                    shift[j] += inverse[j, k] * pull[index, mode, k]
                shift[j] *= modes[mode]
            for j in range(3):
                for k in range(3):
                    covariance[j, k] += shift[j] * shift[k]
    for j in range(3):
        shift[j] = 0.0
        for k in range(3):
            shift[j] += inverse[j, k] * together[k]
    for j in range(3):
        for k in range(3):
            covariance[j, k] += shift[j] * shift[k]


@kernel
def _weighted_rms(sigma: FloatArray, z: FloatArray, weights: FloatArray, m: FloatArray) -> float:
    total = 0.0
    weight = 0.0
    for i in range(z.shape[0]):
        distance = z[i] * sigma[i]
        total += weights[i] * distance * distance
        weight += weights[i]
    length = np.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
    return float(np.sqrt(total / weight) / length)


@kernel
def mark_inliers(
    group: IntArray,
    laser: IntArray,
    weights: FloatArray,
    of_all: bool,
    points: FloatArray,
    inliers: BoolArray,
) -> tuple[int, float, int]:
    """Mark the inliers of a fit.

    Parameters
    ----------
    group : int array, shape (N,)
        From `select_units`.
    laser : int array, shape (M,), weights : array, shape (M,)
        Of the observations.
    of_all : bool
        Whether observations without weight are counted in `second`.
    points : array, shape (N, 3)
        Of the candidates.
    inliers : bool array, shape (N,)
        Written.

    Returns
    -------
    n_points : int
        Number of inliers.
    nearest : float
        Distance of the nearest of them from the origin.
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
    n_lasers = 0
    for k in range(laser.shape[0]):
        n_lasers = max(n_lasers, laser[k] + 1)
    observations = np.zeros(n_lasers, np.int64)
    for k in range(laser.shape[0]):
        observations[laser[k]] += of_all or weights[k] > 0.0
    best, second = 0, 0
    for index in range(n_lasers):
        second = max(second, min(best, observations[index]))
        best = max(best, observations[index])
    return n, np.sqrt(square), second


@kernel
def weigh_candidates(
    group: IntArray,
    m: FloatArray,
    sensitivity: FloatArray,
    sigma_px: FloatArray,
    fit_weights: FloatArray,
    alike: bool,
    weights: FloatArray,
) -> None:
    """Write the weight of each candidate in a fit of m·X = 1: an equal share of its piece's.

    Parameters
    ----------
    group : int array, shape (N,)
        From `select_units`.
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
