"""Plane fits to triangulated stripes: the paper's pseudo-inverse and the robust default."""

from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import kernel

COMMON_MODE_PX = 0.05
"""Shift that all points of one laser may share in one frame, as a standard deviation.

Texture, compression and the sheet's own profile move a whole stripe, not only single points.
"""

_TUKEY = 4.685  # 95 % efficiency for normal errors
_ITERATIONS = 6


@dataclass(frozen=True, slots=True)
class PlaneFit:
    """The plane m·X = 1 and how well the points determine it.

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
    """Fit m·X = 1 by the left pseudo-inverse (paper, Eq. 24): all points alike, outliers too.

    Parameters
    ----------
    points : array, shape (N, 3)
        In `dome`, metres; N >= 3 and not collinear.
    n_groups : int
        How many weights to answer with, all 1.
    covariance : array, shape (3, 3)
        Passed on: the pseudo-inverse itself says nothing about its uncertainty.
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
    start: FloatArray,
) -> PlaneFit | None:
    """Fit m·X = 1 by iteratively re-weighted least squares with Tukey's biweight.

    An observation's residual is compared with what its own position error makes of it, so that
    near and far, square and grazing ones weigh as they should.

    Parameters
    ----------
    points, sensitivity : array, shape (N, 3)
        Points in `dome` (m) and their derivatives by the stripe's position (m/px). Errors of
        different points should be independent: take centroids of chunks rather than single
        returns, which share the errors of their neighbours.
    sigma_px : array, shape (N,)
        Standard deviation of the stripe's position, up to a common factor.
    laser : int array, shape (N,)
        Index of the laser.
    start : array, shape (3,)
        A first m, such as RANSAC gives.

    Returns
    -------
    PlaneFit or None
        None where the points do not determine a plane. The covariance follows from the real
        residuals (Huber 1981, section 7.6), widened by `COMMON_MODE_PX` for each laser.
    """
    m = np.array(start, dtype=np.float64)
    covariance = np.empty((3, 3))
    weights = np.empty(len(points))
    rms = _fit(points, sensitivity, sigma_px, laser, m, covariance, weights)
    if not np.isfinite(rms):
        return None
    return PlaneFit(m, covariance, weights, rms)


@kernel
def _normalised_residuals(
    points: FloatArray,
    sensitivity: FloatArray,
    sigma_px: FloatArray,
    m: FloatArray,
    sigma: FloatArray,
    z: FloatArray,
) -> None:
    """Residuals of m·X = 1 over what the pixel error makes of them (written to `sigma`)."""
    for i in range(points.shape[0]):
        per_px = m[0] * sensitivity[i, 0] + m[1] * sensitivity[i, 1] + m[2] * sensitivity[i, 2]
        sigma[i] = abs(per_px) * sigma_px[i] + 1e-12
        value = m[0] * points[i, 0] + m[1] * points[i, 1] + m[2] * points[i, 2]
        z[i] = (value - 1.0) / sigma[i]


@kernel
def _normal_equations(
    points: FloatArray,
    sigma: FloatArray,
    weights: FloatArray,
    normal: FloatArray,
    right: FloatArray,
) -> None:
    normal[:] = 0.0
    right[:] = 0.0
    for i in range(points.shape[0]):
        w = weights[i] / (sigma[i] * sigma[i])
        for j in range(3):
            right[j] += w * points[i, j]
            for k in range(j + 1):
                normal[j, k] += w * points[i, j] * points[i, k]
    normal[0, 1], normal[0, 2], normal[1, 2] = normal[1, 0], normal[2, 0], normal[2, 1]


@kernel
def _fit(
    points: FloatArray,
    sensitivity: FloatArray,
    sigma_px: FloatArray,
    laser: IntArray,
    m: FloatArray,
    covariance: FloatArray,
    weights: FloatArray,
) -> float:
    n = points.shape[0]
    z = np.empty(n)
    sigma = np.empty(n)
    normal = np.empty((3, 3))
    right = np.empty(3)
    scale = 1.0
    for _ in range(_ITERATIONS):
        _normalised_residuals(points, sensitivity, sigma_px, m, sigma, z)
        scale = max(1.4826 * np.median(np.abs(z)), 0.1)
        for i in range(n):
            ratio = z[i] / (_TUKEY * scale)
            kept = max(1.0 - ratio * ratio, 0.0)
            weights[i] = kept * kept
        _normal_equations(points, sigma, weights, normal, right)
        if not np.linalg.det(normal) > 0.0:
            return np.nan
        m[:] = np.linalg.solve(normal, right)
    inverse = np.linalg.inv(normal).astype(np.float64)
    _normalised_residuals(points, sensitivity, sigma_px, m, sigma, z)
    factor = _huber_factor(z, _TUKEY * scale)
    _normal_equations(points, sigma, np.ones(n), normal, right)
    covariance[:] = np.linalg.inv(normal) * factor
    _add_common_mode(points, sensitivity, sigma, weights, laser, m, inverse, covariance)
    return _weighted_rms(sigma, z, weights, m)


@kernel
def _huber_factor(z: FloatArray, cut: float) -> float:
    """Factor on the unweighted inverse of the normal matrix (Huber 1981, section 7.6).

    Counts what the outliers cost: they add no information, though the fit ignores them.
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
def _add_common_mode(
    points: FloatArray,
    sensitivity: FloatArray,
    sigma: FloatArray,
    weights: FloatArray,
    laser: IntArray,
    m: FloatArray,
    inverse: FloatArray,
    covariance: FloatArray,
) -> None:
    """Widen by one shared shift of `COMMON_MODE_PX` for each laser."""
    n_lasers = 0
    for i in range(laser.shape[0]):
        n_lasers = max(n_lasers, laser[i] + 1)
    pull = np.zeros((n_lasers, 3))
    for i in range(points.shape[0]):
        per_px = m[0] * sensitivity[i, 0] + m[1] * sensitivity[i, 1] + m[2] * sensitivity[i, 2]
        w = weights[i] * per_px / (sigma[i] * sigma[i])
        for k in range(3):
            pull[laser[i], k] += w * points[i, k]
    for index in range(n_lasers):
        shift = COMMON_MODE_PX * (inverse @ pull[index])
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
