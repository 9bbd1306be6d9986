"""The mean plane of a net that is mostly folds, and the doubt that it casts on another."""

from dataclasses import replace

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.scanning.plane_fit import PlaneFit
from aqualvs.scanning.posture import Posture

_TUKEY = 4.685  # 95 % efficiency for normal errors
_ITERATIONS = 5
_EXACT = 1e-9
_SINGULAR = 1e12


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
    m = start.normal / start.offset
    for _ in range(_ITERATIONS):
        off = points @ m - 1.0
        z = off / (_TUKEY * 1.4826 * max(float(np.median(np.abs(off))), _EXACT))
        weights = np.maximum(1.0 - z**2, 0.0) ** 2
        normal = (weights[:, None] * points).T @ points
        try:
            m = np.asarray(np.linalg.solve(normal, weights @ points), np.float64)
        except np.linalg.LinAlgError:
            return None
    if np.linalg.cond(normal) > _SINGULAR:
        return None
    square = float(weights @ (points @ m - 1.0) ** 2)
    rms = float(np.sqrt(square / weights.sum()) / np.linalg.norm(m))
    covariance = (
        np.asarray(np.linalg.inv(normal), np.float64)
        * square
        / (weights.sum() * (1.0 - 3.0 / len(points)))
    )
    return PlaneFit(m, covariance, weights, rms)


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
