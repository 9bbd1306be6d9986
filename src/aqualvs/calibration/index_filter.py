"""One frame's say about the index of the medium: a robust, iterated Kalman update.

The index may change from frame to frame. What else decides where the target is seen does not: its
place on the vehicle, the camera's numbers, and how far a corner is always off (its printing, its
detection). Known only as well as they are, these are estimated along with the index: frames
average out the noise of the corners and never the constants.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from aqualvs.calibration.index_frame import MIN_POINTS, Frame
from aqualvs.calibration.index_model import BLIND, LINEAR, IndexModel, Line, at_index, median_shift
from aqualvs.calibration.index_state import FAR, IndexState, N
from aqualvs.calibration.losses import Loss
from aqualvs.geometry.arrays import BoolArray, FloatArray

_REJECT = 5.0
_REJECTED = 1e-6
_PASSES = 5
# Square of a normal deviate that half of all lie below.
_HALF = 0.4549


@dataclass(frozen=True, slots=True)
class Innovation:
    """How a frame differs from what a state predicts.

    Attributes
    ----------
    frame : Frame
        Its corners that fit.
    n_points : int
        Corners before the misfits were left out.
    shift, sigma : float
        Change of the index that explains the frame best, and the standard deviation it should
        have if there was none. Infinite sigma where the index cannot be seen.
    sigma_frame : float
        Part of `sigma` that is the frame's own noise.
    misfit : float
        Squared residuals that no change of index explains, in terms of their covariance and over
        their number: about 1.
    """

    frame: Frame
    n_points: int
    shift: float
    sigma: float
    sigma_frame: float
    misfit: float

    @property
    def fits(self) -> bool:
        """Whether most of the target is where the state has it."""
        return 2 * len(self.frame.ids) > self.n_points and len(self.frame.ids) >= MIN_POINTS


@dataclass(frozen=True, slots=True)
class Update:
    """A state after a frame.

    Attributes
    ----------
    state : IndexState
    used : int
        Corners that counted.
    rms : float
        Root mean square residual of a coordinate of those, in pixels.
    noise : float
        Noise of a coordinate that the residuals speak for, in pixels.
    """

    state: IndexState
    used: int
    rms: float
    noise: float


def compare(model: IndexModel, state: IndexState, frame: Frame, noise: float) -> Innovation:
    """Return how a frame differs from what a state predicts.

    Parameters
    ----------
    model : IndexModel
    state : IndexState
        At the frame's time, with entries for its corners.
    frame : Frame
        At least one corner.
    noise : float
        Standard deviation of a coordinate, in pixels.
    """
    line, moved = model.line(state, frame), 0.0
    if abs(median_shift(line)) > LINEAR:
        n = model.nearest(state, frame)
        far = abs(n - state.n_of_slopes) > FAR
        line, moved = model.line(at_index(state, n, slopes_too=far), frame), n - state.n
        state = model.settled(state, line, frame)
    keep = np.isfinite(line.residuals[::2])
    keep[keep] &= _left_over(state, _rows(line, keep), noise) < _REJECT
    line = _rows(line, keep)
    shift, variance, misfit = _best_shift(state, line, noise)
    squares = float(np.sum(line.slopes[:, N] ** 2))
    own = noise / np.sqrt(squares) if squares > BLIND**2 else np.inf
    return Innovation(
        frame.where(keep), len(keep), moved + shift, float(np.sqrt(variance)), own, misfit
    )


def believe(model: IndexModel, state: IndexState, frame: Frame, noise: float) -> Update:
    """Return the state after a frame whose corners fit it.

    Parameters
    ----------
    model : IndexModel
    state : IndexState
        At the frame's time, with entries for its corners.
    frame : Frame
        At least one corner, all of them visible.
    noise : float
        Standard deviation of a coordinate, in pixels.
    """
    state = state.with_slopes_near()
    state = model.settled(state, model.line(state, frame), frame)
    at, weights = state, np.ones(len(frame.ids))
    for _ in range(_PASSES):
        used = weights
        step = _kalman_step(state, at, model.line(at, frame), np.repeat(noise**2 / used, 2))
        lengths = _lengths(step.left / np.sqrt(step.expected))
        close = abs(step.mean[N] - at.n) < LINEAR
        at = replace(state, mean=step.mean)
        weights = np.where(lengths < _REJECT, Loss.HUBER.weight(lengths), _REJECTED)
        if close and np.allclose(weights, used, atol=0.05):
            break
    good = np.repeat(used > _REJECTED, 2)
    rms = float(np.sqrt(np.mean(step.left[good] ** 2))) if np.any(good) else np.nan
    estimate = noise * np.sqrt(np.median(step.left**2 / step.expected) / _HALF)
    information = 1.0 / state.random_variance + step.information
    after = replace(at, covariance=step.covariance(), random_variance=1.0 / information)
    return Update(after, int(np.count_nonzero(good)) // 2, rms, float(estimate))


class _KalmanStep(NamedTuple):
    """A state's new mean, what is left of the residuals, and what that should be.

    `left` and `expected` (2M,) are in pixels and their squares; `information` is what the frame
    says of the index if all else was known.
    """

    mean: FloatArray
    left: FloatArray
    expected: FloatArray
    information: float
    old_covariance: FloatArray
    reach: FloatArray
    factor: tuple[FloatArray, bool]

    def covariance(self) -> FloatArray:
        """Return the new covariance."""
        new = self.old_covariance - self.reach @ cho_solve(self.factor, self.reach.T)
        symmetric: FloatArray = 0.5 * (new + new.T)
        return symmetric


def _kalman_step(
    state: IndexState, at: IndexState, line: Line, variances: FloatArray
) -> _KalmanStep:
    """Solve for the mean with a prediction that is linear about `at`."""
    differences = line.residuals + line.slopes @ (at.mean - state.mean)
    reach = state.covariance @ line.slopes.T
    spread = line.slopes @ reach
    spread.flat[:: len(spread) + 1] += variances
    factor = cho_factor(spread)
    mean = state.mean + reach @ cho_solve(factor, differences)
    left = differences - line.slopes @ (mean - state.mean)
    expected = variances**2 * np.diag(cho_solve(factor, np.eye(len(spread))))
    information = float(np.sum(line.slopes[:, N] ** 2 / variances))
    return _KalmanStep(mean, left, expected, information, state.covariance, reach, factor)


def _rows(line: Line, keep: BoolArray) -> Line:
    both = np.repeat(keep, 2)
    return Line(line.residuals[both], line.slopes[both])


def _lengths(residuals: FloatArray) -> FloatArray:
    lengths: FloatArray = np.linalg.norm(residuals.reshape(-1, 2), axis=1)
    return lengths


def _spread(state: IndexState, line: Line, noise: float) -> FloatArray:
    spread: FloatArray = line.slopes @ state.covariance @ line.slopes.T
    spread.flat[:: len(spread) + 1] += noise**2
    return spread


def _left_over(state: IndexState, line: Line, noise: float) -> FloatArray:
    """Lengths (M,) of residuals that no change of index explains, in standard deviations."""
    left = line.residuals - line.slopes[:, N] * median_shift(line)
    spread = _spread(state, line, noise)
    return _lengths(left / np.sqrt(np.diag(spread) - _by_index(spread, line)[0]))


def _by_index(spread: FloatArray, line: Line) -> tuple[FloatArray, float, FloatArray]:
    """Variances (2M,) that a free index explains, that index's variance, weights (2M,) for it."""
    slopes = line.slopes[:, N]
    if float(np.sum(slopes**2)) < BLIND**2:
        return np.zeros_like(slopes), np.inf, np.zeros_like(slopes)
    pull = cho_solve(cho_factor(spread), slopes)
    variance = 1.0 / float(slopes @ pull)
    return variance * slopes**2, variance, variance * pull


def _best_shift(state: IndexState, line: Line, noise: float) -> tuple[float, float, float]:
    """Change of index by generalised least squares, its variance, and what it leaves over."""
    if not len(line.residuals):
        return 0.0, np.inf, np.inf
    spread = _spread(state, line, noise)
    _, variance, weights = _by_index(spread, line)
    shift = float(weights @ line.residuals)
    left = line.residuals - line.slopes[:, N] * shift
    misfit = float(left @ cho_solve(cho_factor(spread), left)) / max(len(left) - 1, 1)
    return shift, variance, misfit
