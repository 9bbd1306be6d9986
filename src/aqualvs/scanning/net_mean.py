"""The mean plane of a net that is mostly folds, and the doubt that it casts on another."""

from dataclasses import replace

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.compiled import kernel
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.symmetric import invert_symmetric, solve_symmetric
from aqualvs.scanning.plane_fit import PlaneFit, normal_equations
from aqualvs.scanning.posture import Posture

_TUKEY = 4.685  # 95 % efficiency for normal errors
_ITERATIONS = 5
_EXACT = 1e-9


def fit_mean(points: FloatArray, start: Plane) -> PlaneFit | None:
    """Fit m·X = 1 to the strands of a folded net: all alike, whatever the errors of their places.

    Their scatter about the plane is that of the folds, and gives the covariance.

    Parameters
    ----------
    points : array, shape (N, 3)
        Of the strands, in `dome`, metres.
    start : Plane
        A first guess: tells outliers.

    Returns
    -------
    PlaneFit or None
        None where the points do not determine a plane.
    """
    if len(points) <= 3:
        return None
    m, weights, covariance = start.normal / start.offset, np.empty(len(points)), np.empty((3, 3))
    rms = _fit_mean(points, m, weights, covariance)
    return PlaneFit(m, covariance, weights, rms) if np.isfinite(rms) else None


@kernel
def _fit_mean(
    points: FloatArray, m: FloatArray, weights: FloatArray, covariance: FloatArray
) -> float:
    """Refine m in place, write weights and covariance; the rms, NaN where no plane is fixed."""
    n, one = points.shape[0], np.ones(points.shape[0])
    off, normal, right, inverse = np.empty(n), np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for _ in range(_ITERATIONS):
        _distances(points, m, off)
        cut = _TUKEY * 1.4826 * max(np.median(np.abs(off)), _EXACT)
        for i in range(n):
            weights[i] = max(1.0 - (off[i] / cut) ** 2, 0.0) ** 2
        normal_equations(points, one, weights, normal, right)
        if not solve_symmetric(normal, right, inverse, m):
            return np.nan
    if not invert_symmetric(normal, covariance):
        return np.nan
    _distances(points, m, off)
    square, weight = 0.0, 0.0
    for i in range(n):
        square += weights[i] * off[i] * off[i]
        weight += weights[i]
    covariance *= square / (weight * (1.0 - 3.0 / n))
    return float(np.sqrt(square / weight / (m[0] * m[0] + m[1] * m[1] + m[2] * m[2])))


@kernel
def _distances(points: FloatArray, m: FloatArray, off: FloatArray) -> None:
    """Write m·X - 1 of each point."""
    for i in range(points.shape[0]):
        off[i] = m[0] * points[i, 0] + m[1] * points[i, 1] + m[2] * points[i, 2] - 1.0


def doubted(posture: Posture, other: Posture, share: float) -> Posture:
    """Return a posture with its covariance widened by another opinion.

    Parameters
    ----------
    posture, other : Posture
        Both opinions.
    share : float
        Of the light that holds the other one.
    """
    apart = np.array(
        [other.range - posture.range, other.pitch - posture.pitch, other.yaw - posture.yaw]
    )
    return replace(posture, covariance=posture.covariance + share * np.outer(apart, apart))
