"""One frame's say about the index of the medium: a robust, iterated Kalman update.

The index may change from frame to frame. What else decides where the target is seen does not: its
place on the vehicle, the camera's numbers, and how far a corner is always off (its printing, its
detection). Known only as well as they are, these are estimated along with the index: frames
average out the noise of the corners and never the constants.
"""

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from aqualvs.calibration.index_frame import MIN_POINTS, Frame
from aqualvs.calibration.index_state import FAR, FIRST_CAMERA, POSE, IndexState, N, first_state
from aqualvs.calibration.losses import Loss
from aqualvs.calibration.pose_steps import moved_target, point_by_pose
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.camera import parameter_names
from aqualvs.optics.rig import Rig
from aqualvs.optics.uncertainty import RigUncertainty, rig_moved_by

WIDE = 0.2
"""Standard deviation of an index that is not known at all, or has just jumped."""

_LOWEST, _HIGHEST = 1.0, 1.7
_REJECT = 5.0
_PASSES = 3
_NEWTON = 30
# Below this motion of the picture, pixels per unit of index, nothing is seen at all.
_BLIND = 1e-6
# Steps of the index up to this are linear to far below the noise of a corner.
_LINEAR = 1e-4
# Changes of a camera's number up to this many standard deviations are added linearly.
_NEARLY = 0.02
# Square of a normal deviate that half of all lie below.
_HALF = 0.4549


class Line(NamedTuple):
    """Prediction of a frame near a state.

    Attributes
    ----------
    residuals : array, shape (2M,)
        Measured less predicted pixels.
    slopes : array, shape (2M, D)
        Derivative of the prediction by the state's mean.
    """

    residuals: FloatArray
    slopes: FloatArray


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


@dataclass(frozen=True, slots=True)
class IndexModel:
    """How a target on the vehicle is seen through media of different index.

    Attributes
    ----------
    rig : Rig
        Behind a dome; its own `n_water` plays no part.
    uncertainty : RigUncertainty
        How well the camera's numbers are known.
    pose_sigmas : array, shape (6,)
        How well the target's place is known: turn about its middle (radians), shift (metres).
    sigma_corner : float
        What a corner is always off, standard deviation in pixels.
    middle : array, shape (3,)
        What the target turns about, in `dome`.
    camera_names : tuple of str
        Numbers of the camera that are uncertain, in the state's order.

    Raises
    ------
    CalibrationError
        If the rig has no dome.
    """

    rig: Rig
    uncertainty: RigUncertainty
    pose_sigmas: FloatArray
    sigma_corner: float
    middle: FloatArray
    camera_names: tuple[str, ...] = field(init=False)
    _moved: "_MovedRig" = field(init=False, repr=False, compare=False)
    _cache: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.rig.dome is None:
            raise CalibrationError(
                f"rig {self.rig.name} has no dome: a bare lens looks the same in every medium, so "
                "its index cannot be found; add the dome to the rig"
            )
        sigmas = self.uncertainty.sigmas
        names = parameter_names(self.rig.camera())
        uncertain = tuple(n for n in names if n != "n_water" and sigmas.get(n, 0.0) > 0.0)
        object.__setattr__(self, "camera_names", uncertain)
        scale = np.array([sigmas[name] for name in uncertain])
        object.__setattr__(self, "_moved", _MovedRig(self.rig, uncertain, scale))

    def first(self, frame: Frame, n: float) -> IndexState:
        """Return the state before a first frame, its index looked for from `n` on."""
        camera = self.uncertainty.of(self.camera_names)
        blank = first_state(frame.time, n, WIDE, self.pose_sigmas, camera)
        return first_state(
            frame.time, self.nearest(blank, frame), WIDE, self.pose_sigmas, camera
        ).with_corners(frame.ids, self.sigma_corner)

    def jumped(self, state: IndexState, frame: Frame) -> IndexState:
        """Return the state after a jump of the index to where a frame has it."""
        return state.stepped(self.nearest(state, frame), WIDE)

    def line(self, state: IndexState, frame: Frame) -> Line:
        """Return the prediction of a frame near a state; residuals are NaN where none is seen.

        Slopes are those at the constants' first guesses and at `state.n_of_slopes`: taken anew
        for every frame they would differ by the noise of the estimate, and seem to tell apart what
        no frame can (first-estimates Jacobian, Huang et al. 2010, doi:10.1177/0278364909353640).
        """
        slopes = np.zeros((len(frame.ids), 2, len(state.mean)))
        first_corner = FIRST_CAMERA + len(self.camera_names)
        known = self._slopes(state.n_of_slopes, frame)
        slopes[..., :first_corner] = known
        off = np.zeros((len(frame.ids), 2))
        for row, i in enumerate(frame.ids):
            if i in state.ids:
                at = first_corner + 2 * state.ids.index(i)
                off[row] = state.mean[at : at + 2]
                slopes[row, 0, at] = slopes[row, 1, at + 1] = 1.0
        n = min(max(state.n, _LOWEST), _HIGHEST)
        rig, rest = self._moved.near(state.mean[FIRST_CAMERA:first_corner])
        target = moved_target(SE3.identity(), self.middle, state.mean[POSE])
        pixels, _ = rig.in_water(n).camera().project(target.apply(frame.points))
        off += known[..., N] * (state.n - n) + known[..., FIRST_CAMERA:] @ rest
        residuals = frame.pixels - pixels - off
        return Line(residuals.reshape(-1), slopes.reshape(-1, len(state.mean)))

    def slope_uncertainty(self, state: IndexState, frame: Frame) -> float:
        """Return the relative standard deviation of a change of index for what a state leaves open.

        The constants decide how far the picture moves with the index: a product of unknowns that a
        joint Gaussian does not hold.
        """
        mean, size = state.mean, FIRST_CAMERA + len(self.camera_names)
        reference = self._slope_at(mean[:size], state.n, frame)
        by_constant = np.zeros(size)
        for i in range(POSE.start, size):
            sigma = np.sqrt(state.covariance[i, i])
            if sigma > 0.0:
                moved = mean[:size].copy()
                moved[i] += sigma
                change = self._slope_at(moved, state.n, frame) - reference
                by_constant[i] = float(np.sum(change * reference)) / sigma
        variance = by_constant @ state.covariance[:size, :size] @ by_constant
        return float(np.sqrt(max(variance, 0.0)) / max(np.sum(reference**2), _BLIND**2))

    def _slope_at(self, mean: FloatArray, n: float, frame: Frame) -> FloatArray:
        """Return the derivative (M, 2) of pixels by the index, all constants as in `mean`."""
        rig = rig_moved_by(self.rig, self.camera_names, mean[FIRST_CAMERA:])
        camera = rig.in_water(min(max(n, _LOWEST), _HIGHEST)).camera()
        target = moved_target(SE3.identity(), self.middle, mean[POSE])
        slopes = camera.project_with_parameter_jacobian(target.apply(frame.points))[3]
        by_n: FloatArray = slopes[..., parameter_names(camera).index("n_water")]
        return by_n

    def _slopes(self, n: float, frame: Frame) -> FloatArray:
        """Return derivatives (M, 2, 9 + C) of pixels by all but the corners' errors."""
        if self._cache.get("n") != n or self._cache.get("ids") != frame.ids:
            camera = self.rig.in_water(min(max(n, _LOWEST), _HIGHEST)).camera()
            _, _, by_point, by_number = camera.project_with_parameter_jacobian(frame.points)
            names = parameter_names(camera)
            slopes = np.zeros((len(frame.ids), 2, FIRST_CAMERA + len(self.camera_names)))
            slopes[..., N] = by_number[..., names.index("n_water")]
            slopes[..., POSE] = by_point @ point_by_pose(frame.points, self.middle)
            columns = [names.index(name) for name in self.camera_names]
            slopes[..., FIRST_CAMERA:] = by_number[..., columns]
            self._cache.update(n=n, ids=frame.ids, slopes=slopes)
        known: FloatArray = self._cache["slopes"]
        return known

    def nearest(self, state: IndexState, frame: Frame) -> float:
        """Return the index that puts most corners where they are, all constants as they are.

        Newton's method on the weighted median of what the corners say one by one: half of them
        may be wrong.
        """
        n = min(max(state.n, _LOWEST), _HIGHEST)
        for _ in range(_NEWTON):
            step = _median_shift(self.line(_at(state, n, slopes_too=True), frame))
            new = min(max(n + step, _LOWEST), _HIGHEST)
            if abs(new - n) < _LINEAR:
                return n + step
            n = new
        return n

    def innovation(self, state: IndexState, frame: Frame, noise: float) -> Innovation:
        """Return how a frame differs from what a state predicts.

        Parameters
        ----------
        state : IndexState
            At the frame's time, with entries for its corners.
        frame : Frame
            At least one corner.
        noise : float
            Standard deviation of a coordinate, in pixels.
        """
        line, moved = self.line(state, frame), 0.0
        if abs(_median_shift(line)) > _LINEAR:
            n = self.nearest(state, frame)
            far = abs(n - state.n_of_slopes) > FAR
            line, moved = self.line(_at(state, n, slopes_too=far), frame), n - state.n
        keep = np.isfinite(line.residuals[::2])
        keep[keep] &= _left_over(state, _rows(line, keep), noise) < _REJECT
        line = _rows(line, keep)
        shift, variance, misfit = _best_shift(state, line, noise)
        squares = float(np.sum(line.slopes[:, N] ** 2))
        own = noise / np.sqrt(squares) if squares > _BLIND**2 else np.inf
        return Innovation(
            frame.where(keep), len(keep), moved + shift, float(np.sqrt(variance)), own, misfit
        )

    def update(self, state: IndexState, frame: Frame, noise: float) -> Update:
        """Return the state after a frame whose corners fit it.

        Parameters
        ----------
        state : IndexState
            At the frame's time, with entries for its corners.
        frame : Frame
            At least one corner, all of them visible.
        noise : float
            Standard deviation of a coordinate, in pixels.
        """
        state = state.with_slopes_near()
        at, weights = state, np.ones(len(frame.ids))
        for _ in range(_PASSES):
            line = self.line(at, frame)
            variances = np.repeat(noise**2 / weights, 2)
            innovation = line.residuals + line.slopes @ (at.mean - state.mean)
            reach = state.covariance @ line.slopes.T
            spread = line.slopes @ reach
            spread.flat[:: len(spread) + 1] += variances
            factor = cho_factor(spread)
            new = replace(state, mean=state.mean + reach @ cho_solve(factor, innovation))
            left = innovation - line.slopes @ (new.mean - state.mean)
            expected = variances**2 * np.diag(cho_solve(factor, np.eye(len(spread))))
            lengths = _lengths(left / np.sqrt(expected)) / np.sqrt(2.0)
            close = abs(new.n - at.n) < _LINEAR
            at = new
            if close and np.all(lengths < _REJECT):
                break
            weights = np.maximum(Loss.HUBER.weight(lengths), 1e-6)
        gain = cho_solve(factor, reach.T)
        covariance = state.covariance - reach @ gain
        information = 1.0 / state.random_variance + float(
            np.sum(line.slopes[:, N] ** 2 / variances)
        )
        estimate = noise * np.sqrt(np.median(left**2 / expected) / _HALF)
        after = replace(
            at, covariance=0.5 * (covariance + covariance.T), random_variance=1.0 / information
        )
        good = np.repeat(weights == 1.0, 2)
        rms = float(np.sqrt(np.mean(left[good] ** 2))) if np.any(good) else np.nan
        return Update(after, int(np.count_nonzero(weights == 1.0)), rms, float(estimate))


@dataclass(slots=True)
class _MovedRig:
    """A rig moved by small changes of its numbers; making one takes longer than a projection."""

    rig: Rig
    names: tuple[str, ...]
    sigmas: FloatArray
    _step: FloatArray = field(init=False)
    _last: Rig = field(init=False)

    def __post_init__(self) -> None:
        self._step, self._last = np.zeros(len(self.names)), self.rig

    def near(self, step: FloatArray) -> tuple[Rig, FloatArray]:
        """Return the rig moved by nearly `step`, and what is left of that to be added linearly."""
        if np.any(np.abs(step - self._step) > _NEARLY * self.sigmas):
            self._last = rig_moved_by(self.rig, self.names, step)
            self._step = step.copy()
        return self._last, step - self._step


def _at(state: IndexState, n: float, *, slopes_too: bool = False) -> IndexState:
    mean = state.mean.copy()
    mean[N] = n
    return replace(state, mean=mean, n_of_slopes=n if slopes_too else state.n_of_slopes)


def _rows(line: Line, keep: BoolArray) -> Line:
    both = np.repeat(keep, 2)
    return Line(line.residuals[both], line.slopes[both])


def _lengths(residuals: FloatArray) -> FloatArray:
    lengths: FloatArray = np.linalg.norm(residuals.reshape(-1, 2), axis=1)
    return lengths


def _median_shift(line: Line) -> float:
    """Weighted median of the changes of index that corners, each alone, ask for."""
    slopes, residuals = line.slopes[:, N].reshape(-1, 2), line.residuals.reshape(-1, 2)
    weights = np.sum(slopes**2, axis=1)
    seen = np.isfinite(residuals[:, 0]) & (weights > _BLIND**2)
    if not np.any(seen):
        return 0.0
    shifts = np.sum(slopes[seen] * residuals[seen], axis=1) / weights[seen]
    order = np.argsort(shifts)
    # Slopes, not their squares: corners that move most would outvote all others.
    along = np.cumsum(np.sqrt(weights[seen])[order])
    return float(shifts[order[np.searchsorted(along, 0.5 * along[-1])]])


def _spread(state: IndexState, line: Line, noise: float) -> FloatArray:
    spread: FloatArray = line.slopes @ state.covariance @ line.slopes.T
    spread.flat[:: len(spread) + 1] += noise**2
    return spread


def _left_over(state: IndexState, line: Line, noise: float) -> FloatArray:
    """Lengths (M,) of residuals that no change of index explains, in standard deviations."""
    left = line.residuals - line.slopes[:, N] * _median_shift(line)
    spread = _spread(state, line, noise)
    return _lengths(left / np.sqrt(np.diag(spread) - _by_index(spread, line)[0]))


def _by_index(spread: FloatArray, line: Line) -> tuple[FloatArray, float, FloatArray]:
    """Variances (2M,) that a free index explains, that index's variance, weights (2M,) for it."""
    slopes = line.slopes[:, N]
    if float(np.sum(slopes**2)) < _BLIND**2:
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
