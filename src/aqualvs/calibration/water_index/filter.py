"""Robust, iterated Kalman update of the medium's refractive index by one frame.

The index may change from frame to frame. The target's place on the vehicle, the camera's numbers
and the constant error of each corner (printing, detection) do not. They are known with limited
accuracy and are estimated along with the index: frames average out the noise of the corners, never
the error of the constants.

`FrameCorners` holds the corners of a picture that the estimate uses, `IndexModel` predicts their
pixels and the derivatives by the state, `compare` gives the innovation, `believe` the updated
state.
"""

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from aqualvs.calibration.solver.bundle import moved_target, point_by_pose
from aqualvs.calibration.solver.least_squares import RobustLoss
from aqualvs.calibration.targets.targets import View
from aqualvs.calibration.water_index.state import (
    FAR,
    FIRST_CAMERA,
    POSE,
    IndexOptions,
    IndexState,
    N,
    first_state,
)
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.camera import parameter_names
from aqualvs.optics.rig import Rig, RigUncertainty, rig_moved_by

MIN_POINTS = 4
"""Least number of corners of a frame: with fewer, an outlier cannot be recognised."""

MAX_POINTS = 64
"""Greatest number of corners: more cost time and add little."""


@dataclass(frozen=True, slots=True)
class FrameCorners:
    """Corners of one picture for the estimate."""

    time: float  # In seconds.
    ids: tuple[int, ...]  # Corners.
    points: FloatArray  # Shape (M, 3): places by `target.yaml`, in `dome`, metres.
    pixels: FloatArray  # Shape (M, 2): measured places.

    @classmethod
    def of(cls, time: float, view: View, known: tuple[int, ...] = ()) -> "FrameCorners":
        """Return the finite corners of a view, at most `MAX_POINTS` together with known ones."""
        finite = np.all(np.isfinite(view.pixels), axis=1) & np.all(np.isfinite(view.points), axis=1)
        _, first = np.unique(view.ids, return_index=True)
        once = np.zeros(len(view), np.bool_)
        once[first] = True
        old = once & finite & np.isin(view.ids, known)
        new = np.flatnonzero(once & finite & ~old)
        room = min(len(new), max(MAX_POINTS - len(known), 0))
        keep = np.flatnonzero(old).tolist()
        if room:
            keep += new[np.linspace(0, len(new) - 1, room).astype(int)].tolist()
        ids = tuple(int(view.ids[i]) for i in keep)
        return cls(time, ids, view.points[keep], view.pixels[keep])

    def where(self, keep: BoolArray) -> "FrameCorners":
        """Return the corners that `keep` (M,) marks."""
        ids = tuple(i for i, kept in zip(self.ids, keep, strict=True) if kept)
        return replace(self, ids=ids, points=self.points[keep], pixels=self.pixels[keep])


BLIND = 1e-6
"""Motion of the picture, in pixels per unit of index, below which the index is unobservable."""
LINEAR = 1e-4
"""Steps of the index up to this are linear to far below the noise of a corner."""

_LOWEST, _HIGHEST = 1.0, 1.7


class Line(NamedTuple):
    """Prediction of a frame near a state."""

    residuals: FloatArray  # Shape (2M,): measured minus predicted pixels.
    slopes: FloatArray  # Shape (2M, D): derivative of the prediction by the state's mean.


@dataclass(frozen=True, slots=True)
class IndexModel:
    """Model of a target on the vehicle, seen through media of different index.

    Raises `CalibrationError` if the rig has no housing.
    """

    rig: Rig  # Behind a housing; its own `n_water` plays no part.
    uncertainty: RigUncertainty  # Of the camera's numbers.
    options: IndexOptions  # Uncertainty of the target's place and corners.
    # Shape (3,): centre of the target's turn, in `dome`.
    middle: FloatArray
    # Numbers of the camera that are uncertain, in the state's order.
    camera_names: tuple[str, ...] = field(init=False)

    _moved: "_MovedRig" = field(init=False, repr=False, compare=False)
    _cache: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.rig.housing is None:
            raise CalibrationError(
                f"rig {self.rig.name} has no housing: a bare lens looks the same in every medium, "
                "so its index cannot be found; add the dome or the flat port to the rig"
            )
        sigmas = self.uncertainty.sigmas
        names = parameter_names(self.rig.camera())
        uncertain = tuple(n for n in names if n != "n_water" and sigmas.get(n, 0.0) > 0.0)
        object.__setattr__(self, "camera_names", uncertain)
        scale = np.array([sigmas[name] for name in uncertain])
        object.__setattr__(self, "_moved", _MovedRig(self.rig, uncertain, scale))

    def first(self, frame: FrameCorners, n: float) -> IndexState:
        """Return the state before a first frame, with the index searched from `n`."""
        known = self.options.pose_sigmas, self.uncertainty.of(self.camera_names)
        n = self.nearest(first_state(frame.time, n, *known), frame)
        state = first_state(frame.time, n, *known)
        return state.with_corners(frame.ids, self.options.sigma_corner_px)

    def jumped(self, state: IndexState, frame: FrameCorners) -> IndexState:
        """Return the state after a jump of the index to the value by a frame."""
        n = self.nearest(state, frame)
        line = self.line(at_index(state, n, slopes_too=True), frame)
        return self.settled(state, line, frame).stepped(n)

    def settled(self, state: IndexState, line: Line, frame: FrameCorners) -> IndexState:
        """Return a state with corner errors for the picture that `line` predicts."""
        predicted = frame.pixels - line.residuals.reshape(-1, 2)
        visible = np.isfinite(predicted[:, 0])
        ids = frame.where(visible).ids
        sigma_px = self.options.sigma_corner_px
        return state.with_corners_at(ids, predicted[visible], sigma_px) if ids else state

    def line(self, state: IndexState, frame: FrameCorners) -> Line:
        """Return the prediction of a frame near a state; residuals are NaN for unseen corners.

        Derivatives are taken at the constants' first guesses and at `state.n_of_slopes`. Taken
        anew for every frame they would vary with the noise of the estimate, and make
        unobservable combinations appear observable (first-estimates Jacobian, Huang et al. 2010,
        doi:10.1177/0278364909353640).
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

    def slope_uncertainty(self, state: IndexState, frame: FrameCorners) -> float:
        """Return the relative standard deviation of a change of index by the state's uncertainty.

        The derivative of the picture by the index depends on the constants: a product of unknowns
        that a joint Gaussian does not represent.
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
        power = max(float(np.sum(reference**2)), BLIND**2)
        return float(np.sqrt(max(float(variance), 0.0))) / power

    def _slope_at(self, mean: FloatArray, n: float, frame: FrameCorners) -> FloatArray:
        """Return the derivative (M, 2) of pixels by the index, all constants as in `mean`."""
        rig = rig_moved_by(self.rig, self.camera_names, mean[FIRST_CAMERA:])
        camera = rig.in_water(min(max(n, _LOWEST), _HIGHEST)).camera()
        target = moved_target(SE3.identity(), self.middle, mean[POSE])
        slopes = camera.project_with_parameter_jacobian(target.apply(frame.points))[3]
        return slopes[..., parameter_names(camera).index("n_water")]

    def _slopes(self, n: float, frame: FrameCorners) -> FloatArray:
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

    def nearest(self, state: IndexState, frame: FrameCorners) -> float:
        """Return the index that fits most corners, with all constants fixed.

        Newton's method on the weighted median of the corners' single estimates: half of them may
        be wrong.
        """
        n = min(max(state.n, _LOWEST), _HIGHEST)
        newton = 30
        for _ in range(newton):
            step = median_shift(self.line(at_index(state, n, slopes_too=True), frame))
            new = min(max(n + step, _LOWEST), _HIGHEST)
            if abs(new - n) < LINEAR:
                return n + step
            n = new
        return n


@dataclass(slots=True)
class _MovedRig:
    """Cache of a rig moved by small changes: making a rig takes longer than a projection."""

    rig: Rig
    names: tuple[str, ...]
    sigmas: FloatArray
    _step: FloatArray = field(init=False)
    _last: Rig = field(init=False)

    def __post_init__(self) -> None:
        self._step, self._last = np.zeros(len(self.names)), self.rig

    def near(self, step: FloatArray) -> tuple[Rig, FloatArray]:
        """Return the rig moved by nearly `step`, and the remainder to be added linearly."""
        # Changes of the camera's numbers up to this many standard deviations are linearised.
        nearly = 0.02
        if np.any(np.abs(step - self._step) > nearly * self.sigmas):
            self._last = rig_moved_by(self.rig, self.names, step)
            self._step = step.copy()
        return self._last, step - self._step


def at_index(state: IndexState, n: float, *, slopes_too: bool = False) -> IndexState:
    """Return the state with another index, all else the same."""
    mean = state.mean.copy()
    mean[N] = n
    return replace(state, mean=mean, n_of_slopes=n if slopes_too else state.n_of_slopes)


def median_shift(line: Line) -> float:
    """Return the weighted median of the changes of index by each corner alone."""
    slopes, residuals = line.slopes[:, N].reshape(-1, 2), line.residuals.reshape(-1, 2)
    weights = np.sum(slopes**2, axis=1)
    seen = np.isfinite(residuals[:, 0]) & (weights > BLIND**2)
    if not np.any(seen):
        return 0.0
    shifts = np.sum(slopes[seen] * residuals[seen], axis=1) / weights[seen]
    order = np.argsort(shifts)
    # Weights are slopes, not their squares: else the corners that move most would dominate.
    along = np.cumsum(np.sqrt(weights[seen])[order])
    return float(shifts[order[np.searchsorted(along, 0.5 * along[-1])]])


_REJECT = 5.0


@dataclass(frozen=True, slots=True)
class Innovation:
    """Innovation: difference between a frame and the prediction by a state."""

    frame: FrameCorners  # Its corners that fit.
    n_points: int  # Number of corners before the misfits were left out.
    # Change of the index that explains the frame best, and its expected standard deviation without
    # a change. Infinite sigma if the index is not observable.
    shift: float
    sigma: float
    # Part of `sigma` that is the frame's own noise.
    sigma_frame: float
    # Squared residuals that no change of index explains, normalised by their covariance and number:
    # about 1.
    misfit: float

    @property
    def fits(self) -> bool:
        """True if most of the target is where the state predicts it."""
        return 2 * len(self.frame.ids) > self.n_points and len(self.frame.ids) >= MIN_POINTS


class Update(NamedTuple):
    """Updated state after a frame."""

    state: IndexState
    used: int  # Number of used corners.
    rms: float  # Root mean square residual of a coordinate of those, in pixels.
    noise: float  # Noise of a coordinate estimated from the residuals, in pixels.


def compare(model: IndexModel, state: IndexState, frame: FrameCorners, noise: float) -> Innovation:
    """Return the innovation of a frame: its difference from the prediction by a state.

    The state is at the frame's time, with entries for its corners, of which there is at least one;
    `noise` is the standard deviation of a coordinate, in pixels.
    """
    line, moved = model.line(state, frame), 0.0
    if abs(median_shift(line)) > LINEAR:
        n = model.nearest(state, frame)
        far = abs(n - state.n_of_slopes) > FAR
        line, moved = model.line(at_index(state, n, slopes_too=far), frame), n - state.n
        state = model.settled(state, line, frame)
    keep = np.isfinite(line.residuals[::2])
    seen = _rows(line, keep)
    # Residuals that no change of index explains, in standard deviations.
    left = seen.residuals - seen.slopes[:, N] * median_shift(seen)
    spread = _spread(state, seen, noise)
    keep[keep] &= _lengths(left / np.sqrt(np.diag(spread) - _by_index(spread, seen)[0])) < _REJECT
    line = _rows(line, keep)
    shift, variance, misfit = _best_shift(state, line, noise)
    squares = float(np.sum(line.slopes[:, N] ** 2))
    own = noise / np.sqrt(squares) if squares > BLIND**2 else np.inf
    return Innovation(
        frame.where(keep), len(keep), moved + shift, float(np.sqrt(variance)), own, misfit
    )


def believe(model: IndexModel, state: IndexState, frame: FrameCorners, noise: float) -> Update:
    """Return the state updated by a frame whose corners, all of them visible, fit it.

    Arguments as in `compare`.
    """
    if abs(state.n - state.n_of_slopes) > FAR:
        state = replace(state, n_of_slopes=state.n)
    state = model.settled(state, model.line(state, frame), frame)
    at, weights = state, np.ones(len(frame.ids))
    rejected = 1e-6
    passes = 5
    for _ in range(passes):
        used = weights
        line, variances = model.line(at, frame), np.repeat(noise**2 / used, 2)
        # Kalman update with a prediction that is linear about `at`.
        differences = line.residuals + line.slopes @ (at.mean - state.mean)
        reach = state.covariance @ line.slopes.T
        spread = line.slopes @ reach
        spread.flat[:: len(spread) + 1] += variances
        factor = cho_factor(spread)
        mean = state.mean + reach @ cho_solve(factor, differences)
        # Remaining residuals and their expected squares.
        left = differences - line.slopes @ (mean - state.mean)
        expected = variances**2 * np.diag(cho_solve(factor, np.eye(len(spread))))
        lengths = _lengths(left / np.sqrt(expected))
        close = abs(mean[N] - at.n) < LINEAR
        at = replace(state, mean=mean)
        weights = np.where(lengths < _REJECT, RobustLoss.HUBER.weight(lengths), rejected)
        if close and np.allclose(weights, used, atol=0.05):
            break
    good = np.repeat(used > rejected, 2)
    rms = float(np.sqrt(np.mean(left[good] ** 2))) if np.any(good) else np.nan
    # Median of the square of a normal deviate.
    half = 0.4549
    estimate = noise * np.sqrt(np.median(left**2 / expected) / half)
    # Of the frame on the index if all else was known.
    information = 1.0 / state.random_variance + float(np.sum(line.slopes[:, N] ** 2 / variances))
    covariance = state.covariance - reach @ cho_solve(factor, reach.T)
    after = replace(
        at, covariance=0.5 * (covariance + covariance.T), random_variance=1.0 / information
    )
    return Update(after, int(np.count_nonzero(good)) // 2, rms, float(estimate))


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


def _by_index(spread: FloatArray, line: Line) -> tuple[FloatArray, float, FloatArray]:
    """Return variances (2M,) explained by a free index, its variance, and its weights (2M,)."""
    slopes = line.slopes[:, N]
    if float(np.sum(slopes**2)) < BLIND**2:
        return np.zeros_like(slopes), np.inf, np.zeros_like(slopes)
    pull = cho_solve(cho_factor(spread), slopes)
    variance = 1.0 / float(slopes @ pull)
    return variance * slopes**2, variance, variance * pull


def _best_shift(state: IndexState, line: Line, noise: float) -> tuple[float, float, float]:
    """Return the change of index by generalised least squares, its variance and the residuals."""
    if not len(line.residuals):
        return 0.0, np.inf, np.inf
    spread = _spread(state, line, noise)
    _, variance, weights = _by_index(spread, line)
    shift = float(weights @ line.residuals)
    left = line.residuals - line.slopes[:, N] * shift
    misfit = float(left @ cho_solve(cho_factor(spread), left)) / max(len(left) - 1, 1)
    return shift, variance, misfit
