"""Levenberg-Marquardt for one marker's model, compiled."""

import math

import numpy as np

from aqualvs.calibration.pixel_fit import LEAST_PIVOT
from aqualvs.calibration.tag_model import BLUR, GAMMA, N_UNKNOWNS, U8Array, tag_sums
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.cholesky import factorise, inverse_of, solve_factorised
from aqualvs.geometry.compiled import kernel

_SETTLED_PX = 5e-3
_SETTLED_LOG_BLUR = 0.03
# Steps stay where the model still sees the edges.
_MAX_STEP_PX = 1.5
_MAX_STEP_LOG_BLUR = 0.4
_LOG_BLUR = (math.log(0.25), math.log(8.0))
_LOG_GAMMA = (math.log(0.5), math.log(5.0))


@kernel
def descend(
    image: U8Array,
    corner: FloatArray,
    weights: FloatArray,
    cells: FloatArray,
    reach: float,
    prior: FloatArray,
    unknowns: FloatArray,
    residuals: FloatArray,
    covariance: FloatArray,
    n_steps: int,
    every: int,
) -> bool:
    """Improve `unknowns` (22,) in place; False where the pixels do not determine them.

    Parameters
    ----------
    image, corner, weights, cells, reach
        As in `tag_model.tag_sums`.
    prior : array, shape (2, 22)
        Expected values, and their weight in the sum of squares.
    unknowns : array, shape (22,)
        Start and result.
    residuals : array, shape (rows, columns)
        Written: picture minus model.
    covariance : array, shape (22, 22)
        Written: the inverse of the normal matrix; times the noise variance it is the covariance.
    n_steps : int
        At most so many steps.
    every : int
        Take one pixel of so many.
    """
    normal, gradient = np.empty((N_UNKNOWNS, N_UNKNOWNS)), np.empty(N_UNKNOWNS)
    new_normal, new_gradient = np.empty((N_UNKNOWNS, N_UNKNOWNS)), np.empty(N_UNKNOWNS)
    lower, step = np.zeros((N_UNKNOWNS, N_UNKNOWNS)), np.empty(N_UNKNOWNS)
    new_residuals = np.empty_like(residuals)
    squares = tag_sums(
        image, corner, weights, cells, reach, unknowns, normal, gradient, residuals, every
    ) + _add_prior(prior, unknowns, normal, gradient)
    damping = 1e-3
    for _ in range(n_steps):
        if not factorise(normal, damping, LEAST_PIVOT, lower):
            return False
        solve_factorised(lower, gradient, step)
        _shorten(step, unknowns)
        tried = unknowns + step
        tried[BLUR] = min(max(tried[BLUR], _LOG_BLUR[0]), _LOG_BLUR[1])
        tried[GAMMA] = min(max(tried[GAMMA], _LOG_GAMMA[0]), _LOG_GAMMA[1])
        new_squares = tag_sums(
            image,
            corner,
            weights,
            cells,
            reach,
            tried,
            new_normal,
            new_gradient,
            new_residuals,
            every,
        ) + _add_prior(prior, tried, new_normal, new_gradient)
        if not new_squares <= squares:
            damping = 10.0 * max(damping, 1e-3)
            continue
        squares, damping = new_squares, 0.1 * damping
        unknowns[:] = tried
        normal[:, :] = new_normal
        gradient[:] = new_gradient
        residuals[:, :] = new_residuals
        if np.max(np.abs(step[:6])) < _SETTLED_PX and abs(step[BLUR]) < _SETTLED_LOG_BLUR:
            break
    if not factorise(normal, 0.0, LEAST_PIVOT, lower):
        return False
    covariance[:, :] = inverse_of(lower)
    return True


@kernel
def _add_prior(
    prior: FloatArray, unknowns: FloatArray, normal: FloatArray, gradient: FloatArray
) -> float:
    squares = 0.0
    for i in range(N_UNKNOWNS):
        off = prior[0, i] - unknowns[i]
        squares += prior[1, i] * off * off
        gradient[i] += prior[1, i] * off
        normal[i, i] += prior[1, i]
    return squares


@kernel
def _shorten(step: FloatArray, unknowns: FloatArray) -> None:
    """Limit how far the marker's points move, and the blur's change."""
    side = np.sqrt(abs(unknowns[2] * unknowns[5] - unknowns[3] * unknowns[4])) + 1e-9
    moved = np.max(np.abs(step[:6])) + side * np.max(np.abs(step[6:8]))
    share = min(1.0, _MAX_STEP_PX / (moved + 1e-12))
    share = min(share, _MAX_STEP_LOG_BLUR / (abs(step[BLUR]) + 1e-12))
    step *= share
