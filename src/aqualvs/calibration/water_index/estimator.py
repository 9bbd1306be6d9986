"""Estimator of the medium's refractive index, frame by frame, from a target fixed on the vehicle.

Section 2.2 of the paper solves for the index alone. Here the uncertainty of the target's place and
of the camera's numbers counts too; see `water_index.filter`.

`calibrate_water` applies the estimator to a set of pictures, as `aqualvs calibrate water` reports
it.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from aqualvs.calibration.targets.targets import View
from aqualvs.calibration.water_index.filter import (
    MIN_POINTS,
    FrameCorners,
    IndexModel,
    Innovation,
    Update,
    believe,
    compare,
)
from aqualvs.calibration.water_index.state import (
    ANCHOR,
    FIRST_CAMERA,
    POSE,
    WIDE,
    CusumTest,
    IndexOptions,
    IndexPrior,
    IndexReading,
    IndexState,
    IndexStep,
    N,
)
from aqualvs.errors import CalibrationError, RigError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.rig import Rig, RigUncertainty


class _FilterOptions(NamedTuple):
    """Noise of the corners in pixels, and the treatment of frames that contradict."""

    # Noise of a corner before any residuals, least estimate from a first frame, and least of all.
    nominal_noise: float = 0.1
    first_noise: float = 0.03
    min_noise: float = 0.005
    noise_memory: int = 100
    first_rounds: int = 4
    # A frame with a larger innovation waits for the next ones before it is used.
    wait: float = 4.0
    # Number of frames that can be taken back after a step.
    kept: int = 50
    misfit: float = 2.0


_FILTER = _FilterOptions()
# Number of standard deviations beyond which the target counts as moved.
_MOVED = 4.0
_LOST_FRAMES = 10


@dataclass(slots=True)
class IndexEstimator:
    """Recursive estimator of the index of the medium; time comes from the data.

    One estimator serves one target, one rig and one dive. Started in air (`IndexPrior.air`), it
    learns the target's place better than by a ruler, and keeps that in the water.

    Raises `CalibrationError` if the rig has no housing.
    """

    rig: Rig  # Behind a housing.
    uncertainty: RigUncertainty = field(default_factory=RigUncertainty.none)  # Of the rig.
    # Assumptions about target and medium.
    options: IndexOptions = field(default_factory=IndexOptions)
    # Prior of the index at the first frame.
    prior: IndexPrior | None = None
    # All alarms so far.
    steps: list[IndexStep] = field(default_factory=list)

    _model: IndexModel = field(init=False, repr=False)
    _state: IndexState | None = None
    _noise: float = _FILTER.nominal_noise
    _n_frames: int = 0
    _n_lost: int = 0
    _contradicted: bool = False
    _moved: bool = False
    _last_time: float = -math.inf
    _since_prior: float = 0.0
    _sigma_frame: float = math.inf
    _test: CusumTest = field(default_factory=CusumTest, repr=False)
    _recent: deque[tuple[IndexState, Innovation]] = field(
        default_factory=lambda: deque(maxlen=_FILTER.kept), repr=False
    )

    def __post_init__(self) -> None:
        self._model = self._model_about(np.zeros(3))

    def add(self, time: float, view: View) -> IndexReading:
        """Add a frame and return the reading after it.

        Parameters
        ----------
        time : float
            In seconds; frames older than the last one are refused.
        view : View
            Points of the target in `dome` (metres) and their pixels. Corners that are missing,
            NaN or wrong do no harm if most are right.
        """
        known = () if self._state is None else self._state.ids
        frame = FrameCorners.of(time, view, known)
        refused = self._refusal(frame)
        if refused:
            return self._reading(time, view.name, refused)
        try:
            if self._state is None:
                return self._first(view.name, frame)
            return self._next(view.name, self._state, frame)
        except RigError as error:
            return self._reading(time, view.name, f"no camera sees the target so ({error})")

    @property
    def state(self) -> IndexState | None:
        """Joint estimate with the prior, None before the first used frame."""
        state = self._own
        if state is None or self.prior is None or self._contradicted:
            return state
        return state.given_anchor(self.prior.n, self.prior.sigma)

    @property
    def _own(self) -> IndexState | None:
        """Estimate without the prior, at the time of the last frame, used or not."""
        if self._state is None:
            return None
        return self._state.later(max(self._last_time, self._state.time), self.options.drift)

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Numbers of the camera in `state`, after the target's place."""
        return self._model.camera_names

    def residuals(self, view: View) -> FloatArray:
        """Return measured minus predicted pixels (M, 2) of a view by the present estimate.

        Raises `CalibrationError` before the first used frame.
        """
        if self.state is None:
            raise CalibrationError("no picture shows enough of the target yet; add one that does")
        frame = FrameCorners.of(self.state.time, view, self.state.ids)
        return self._model.line(self.state, frame).residuals.reshape(-1, 2)

    def _model_about(self, middle: FloatArray) -> IndexModel:
        return IndexModel(self.rig, self.uncertainty, self.options, middle)

    def _refusal(self, frame: FrameCorners) -> str:
        if not math.isfinite(frame.time):
            return "it has no time"
        if self._state is not None and frame.time < self._last_time:
            return (
                f"its time {frame.time:.3f} s lies before that of an earlier frame, "
                f"{self._last_time:.3f} s"
            )
        if len(frame.ids) < MIN_POINTS:
            return f"{len(frame.ids)} corners of the target are seen; {MIN_POINTS} are needed"
        return ""

    def _first(self, name: str, frame: FrameCorners) -> IndexReading:
        self._model = self._model_about(frame.points.mean(axis=0))
        start = self.rig.n_water if self.prior is None else self.prior.n
        state, noise = self._model.first(frame, start), _FILTER.nominal_noise
        for _ in range(_FILTER.first_rounds):
            seen = compare(self._model, state, frame, noise)
            if not seen.fits:
                return self._reading(frame.time, name, _not_there(seen))
            update = believe(self._model, state, seen.frame, noise)
            noise = max(update.noise, _FILTER.first_noise)
        self._last_time, self._noise = frame.time, noise
        return self._accept(name, seen, update, state.n)

    def _next(self, name: str, last: IndexState, frame: FrameCorners) -> IndexReading:
        state = self._until(last, frame)
        self._since_prior += self.options.drift**2 * (frame.time - self._last_time)
        self._last_time = frame.time
        noise = self._noise * self._test.inflation
        seen = compare(self._model, state, frame, noise)
        # Corners that fit one by one may still be those of a plate that has moved slightly.
        self._n_lost = 0 if seen.fits and seen.misfit < _FILTER.misfit else self._n_lost + 1
        if not seen.fits:
            return self._reading(frame.time, name, _not_there(seen))
        self._recent.append((last, seen))
        standardised = seen.shift / seen.sigma
        began = self._test.add(standardised)
        if began:
            return self._jump(name, min(began, len(self._recent)))
        if abs(standardised) > _FILTER.wait:
            n = state.n + seen.shift
            waits = f"alone it gives an index of {n:.4f}; the next frames will tell"
            return self._reading(frame.time, name, waits, n_frame=n)
        update = believe(self._model, state, seen.frame, noise)
        return self._accept(name, seen, update, state.n)

    def _accept(self, name: str, seen: Innovation, update: Update, n: float) -> IndexReading:
        self._state = update.state
        self._n_frames += 1
        share = max(1.0 / self._n_frames, 1.0 / _FILTER.noise_memory)
        square = self._noise**2 + share * (update.noise**2 - self._noise**2)
        self._noise = max(
            math.sqrt(square), _FILTER.first_noise if self._n_frames < 2 else _FILTER.min_noise
        )
        self._sigma_frame = seen.sigma_frame
        return self._reading(seen.frame.time, name, n_frame=n + seen.shift, update=update)

    def _jump(self, name: str, began: int) -> IndexReading:
        """Take the last frames back and use them again with a free jump of the index."""
        since = list(self._recent)[-began:]
        since = since[_onset(np.array([s.shift / s.sigma for _, s in since])) :]
        self._recent.clear()
        try:
            state, update = self._accept_again(since)
        except RigError:
            state, update = self._accept_again(since[-1:])
        self._state, self._since_prior = state, WIDE**2
        size, sigma = state.step
        slope = self._model.slope_uncertainty(state, since[-1][1].frame)
        sigma, step = math.hypot(sigma, slope * size), None
        if abs(size) > max(self.options.smallest_step, 3.0 * sigma):
            misfit = float(np.median([seen.misfit for _, seen in since]))
            step = IndexStep(since[0][1].frame.time, size, sigma, misfit < _FILTER.misfit)
            self.steps.append(step)
            self._moved = self._moved or not step.by_medium
        return self._reading(self._last_time, name, n_frame=state.n, update=update, step=step)

    def _accept_again(
        self, since: Sequence[tuple[IndexState, Innovation]]
    ) -> tuple[IndexState, Update]:
        before, seen = since[0]
        noise = self._noise * self._test.inflation
        state = self._model.jumped(self._until(before, seen.frame), seen.frame)
        update = believe(self._model, state, seen.frame, noise)
        for _, later in since[1:]:
            state = self._until(update.state, later.frame)
            seen = compare(self._model, state, later.frame, noise)
            if seen.fits and abs(seen.shift) < _FILTER.wait * seen.sigma:
                update = believe(self._model, state, seen.frame, noise)
        return update.state.later(self._last_time, self.options.drift), update

    def _until(self, state: IndexState, frame: FrameCorners) -> IndexState:
        later = state.later(frame.time, self.options.drift)
        return later.with_corners(frame.ids, self.options.sigma_corner_px)

    def _reading(
        self,
        time: float,
        name: str,
        refused: str = "",
        *,
        n_frame: float = math.nan,
        update: Update | None = None,
        step: IndexStep | None = None,
    ) -> IndexReading:
        own, prior = self._own, self.prior
        if own is not None and prior is not None:
            # With hysteresis, in standard deviations.
            limit = 3.0 if self._contradicted else 4.0
            sigma = math.hypot(math.sqrt(own.covariance[ANCHOR, ANCHOR]), prior.sigma)
            self._contradicted = abs(float(own.mean[ANCHOR]) - prior.n) > limit * sigma
        sigma_frame = self._sigma_frame * self._test.inflation
        joint = self.state
        observable = self._is_observable(own, joint)
        about_sight = "" if observable or own is None else self._about_sight(own, sigma_frame)
        remarks = (
            about_sight,
            self._about_prior(own),
            self._about_place(joint),
            self._about_lost(),
        )
        unknown = (math.nan, math.inf) if prior is None else (prior.n, prior.sigma)
        n, sigma = unknown if joint is None else (joint.n, joint.sigma)
        return IndexReading(
            name=name,
            time=time,
            refused=refused,
            n=n,
            sigma=sigma,
            sigma_random=math.inf if own is None else math.sqrt(own.random_variance),
            n_pictures=math.nan if own is None else own.n,
            sigma_pictures=math.inf if own is None else own.sigma,
            n_frame=n_frame,
            sigma_frame=math.inf if update is None else sigma_frame,
            n_points=0 if update is None else update.used,
            rms_px=math.nan if update is None else update.rms,
            observable=observable,
            prior_used=prior is not None and not self._contradicted,
            step=step,
            remarks=tuple(remark for remark in remarks if remark),
        )

    def _is_observable(self, own: IndexState | None, joint: IndexState | None) -> bool:
        """Return whether the pictures determine the index, by the states without and with prior."""
        if own is None or joint is None or self._moved or self._n_lost >= _LOST_FRAMES:
            return False
        largest = self.options.largest_sigma
        if self.prior is None or self._contradicted:
            return own.sigma < largest
        alone = math.sqrt(self.prior.sigma**2 + self._since_prior)
        # After a step the prior is of another medium; its information on the target stays valid.
        sigma = joint.sigma if alone > largest else own.sigma
        return sigma < min(alone, largest)

    def _about_sight(self, own: IndexState, sigma_frame: float) -> str:
        """Return why the index is not observable; `sigma_frame` is its noise from one frame."""
        if self._moved or self._n_lost >= _LOST_FRAMES:
            return ""
        if sigma_frame > self.options.largest_sigma:
            lens = "the target is small, "
            if self.rig.flat_port is None:
                decentring = float(np.linalg.norm(self.rig.dome_from_cam.translation))
                lens = f"the lens is {decentring * 1e3:.1f} mm from the dome's centre, "
            return (
                f"unobservable: {lens}so the picture of the target hardly moves with the index; "
                "give --temperature-c and --salinity"
            )
        if self.prior is not None and not self._contradicted:
            return (
                f"unobservable: the pictures alone give the index to {own.sigma:.1e}, the "
                f"prior ({self.prior.source}) to {self.prior.sigma:.1e}; changes are still detected"
            )
        return (
            f"unobservable: the uncertainty of the target's position and of the camera leaves the "
            f"index uncertain by {own.sigma:.1e}; measure them better, begin with pictures in "
            "air, or give --temperature-c and --salinity"
        )

    def _about_prior(self, own: IndexState | None) -> str:
        if self.prior is None or own is None or not self._contradicted:
            return ""
        n, sigma = float(own.mean[ANCHOR]), math.sqrt(own.covariance[ANCHOR, ANCHOR])
        return (
            f"the pictures give {n:.4f} +- {sigma:.4f}, the prior ({self.prior.source}) "
            f"{self.prior.n:.4f} +- {self.prior.sigma:.4f}: a leak, a pollutant, another medium "
            "than the prior's, or a target that is not where target.yaml has it; the prior is "
            "left out"
        )

    def _about_place(self, joint: IndexState | None) -> str:
        if self._moved:
            return (
                "the target or the lens has moved: the index is unreliable until the target is "
                "measured again"
            )
        if joint is None:
            return ""
        moved = np.abs(joint.mean[POSE])
        if np.any(moved > _MOVED * self.options.pose_sigmas):
            turn, shift = np.rad2deg(np.linalg.norm(moved[:3])), 1e3 * np.linalg.norm(moved[3:])
            return (
                f"the target seems {shift:.2f} mm and {turn:.2f}° from where target.yaml has it, "
                "more than the stated uncertainty of its position"
            )
        corners = joint.mean[FIRST_CAMERA + len(self.camera_names) :]
        off = float(np.sqrt(np.mean(corners**2))) if len(corners) else 0.0
        # Ratio of the corners' errors to the expected ones that is reported.
        crooked = 2.0
        if off > crooked * self.options.sigma_corner_px:
            return (
                f"corners are always off by {off:.2f} px, more than was assumed; check the "
                "target's print and the camera's calibration"
            )
        return ""

    def _about_lost(self) -> str:
        if self._n_lost < _LOST_FRAMES:
            return ""
        return (
            f"the target has not been where it should be for {self._n_lost} frames: it is "
            "hidden or has moved; the last index is kept"
        )


def _onset(standardised: FloatArray) -> int:
    """Return the first of a run's frames (K,) after the jump.

    By truncated least squares of a change of the mean from zero.
    """
    # Number of last frames of a run that determine the size of a jump, and largest cost of a frame.
    telling, gross = 5, 16.0
    after = float(np.median(standardised[-telling:]))
    without = np.minimum(standardised**2, gross)
    with_jump = np.minimum((standardised - after) ** 2, gross)
    costs = np.concatenate([[0.0], np.cumsum(without - with_jump)[:-1]])
    return int(np.argmin(costs))


def _not_there(seen: Innovation) -> str:
    return (
        f"only {len(seen.frame.ids)} of {seen.n_points} corners are where the target should be; "
        "it is hidden, has moved, or is not the one that target.yaml describes"
    )


N_WATER = "n_water"
_DEFAULT_OPTIONS = IndexOptions()


@dataclass(frozen=True, slots=True, kw_only=True)
class WaterCalibration:
    """Result of a calibration of the water's index: a rig in its medium."""

    rig: Rig  # With the index found at the last picture.
    # Of the rig's numbers, with `n_water` and its covariance with the others.
    uncertainty: RigUncertainty
    # Standard deviation of the index, and its part that more pictures reduce.
    sigma: float
    sigma_random: float
    # False if the pictures do not determine the index; `remarks` says why.
    observable: bool
    # Alarms.
    steps: tuple[IndexStep, ...]
    # Estimate after each picture.
    readings: tuple[IndexReading, ...] = field(repr=False)
    # Root mean square residual of the used corners.
    rms_px: float
    # By the name of each used picture: measured minus predicted pixels (M, 2) by the last estimate.
    residuals: dict[str, FloatArray] = field(repr=False)
    # Remarks for the user, one sentence each.
    remarks: tuple[str, ...]

    @property
    def n(self) -> float:
        """Index of the medium, relative to vacuum."""
        return self.rig.n_water


def calibrate_water(
    rig: Rig,
    views: Sequence[View],
    times: Sequence[float] | None = None,
    *,
    uncertainty: RigUncertainty | None = None,
    prior: IndexPrior | None = None,
    options: IndexOptions = _DEFAULT_OPTIONS,
) -> WaterCalibration:
    """Find the index of the medium from pictures of a target fixed on the vehicle.

    Parameters
    ----------
    rig : Rig
        Behind a housing; its own index is the initial guess without a prior.
    views : sequence of View
        Points of the target in `dome`, metres.
    times : sequence of float, optional
        Of the pictures, in seconds, ascending. Without them all pictures are simultaneous.
    uncertainty : RigUncertainty, optional
        Of the rig; without it the rig is taken as exact.
    prior : IndexPrior, optional
        Prior of the index at the first picture.
    options : IndexOptions
        Assumptions about target and medium.

    Raises
    ------
    CalibrationError
        If the rig has no housing or no picture can be used.
    """
    known = RigUncertainty.none() if uncertainty is None else uncertainty
    estimator = IndexEstimator(rig, uncertainty=known, options=options, prior=prior)
    moments = np.zeros(len(views)) if times is None else np.asarray(times, np.float64)
    readings = tuple(
        estimator.add(float(time), view) for time, view in zip(moments, views, strict=True)
    )
    state = estimator.state
    if not readings:
        raise CalibrationError(
            "no pictures of the target; give some on which the whole target is seen"
        )
    if state is None:
        raise CalibrationError(
            f"none of {len(readings)} pictures can be used: {readings[0].name}: "
            f"{readings[0].refused}; check that target.yaml gives the target's corners in the "
            "frame of the dome, in millimetres"
        )
    last = readings[-1]
    return WaterCalibration(
        rig=rig.in_water(max(state.n, 1.0)),
        uncertainty=_with_index(known, state, estimator.camera_names),
        sigma=last.sigma,
        sigma_random=last.sigma_random,
        observable=last.observable,
        steps=tuple(estimator.steps),
        readings=readings,
        rms_px=_rms(readings),
        residuals={
            view.name: estimator.residuals(view)
            for view, reading in zip(views, readings, strict=True)
            if reading
        },
        remarks=last.remarks,
    )


def _rms(readings: Sequence[IndexReading]) -> float:
    counted = [r for r in readings if r and r.n_points]
    weights = np.array([r.n_points for r in counted], np.float64)
    squares = np.array([r.rms_px for r in counted]) ** 2
    return float(np.sqrt(np.sum(weights * squares) / np.sum(weights)))


def _with_index(
    known: RigUncertainty, state: IndexState, camera_names: tuple[str, ...]
) -> RigUncertainty:
    """Return the covariance of the rig's unchanged numbers and of the index.

    The estimate of the camera's errors is not used, as the rig keeps its numbers: errors of these
    and of the index have the covariance between the two in the state. Lasers are correlated with
    the index through the camera alone.
    """
    old = known.only([name for name in known.names if name != N_WATER])
    camera = slice(FIRST_CAMERA, FIRST_CAMERA + len(camera_names))
    with_camera = state.covariance[camera, N]
    reach = np.zeros(len(old.names))
    if camera_names:
        columns = [old.names.index(name) for name in camera_names]
        reach = old.covariance[:, columns] @ _solve(old.of(camera_names), with_camera)
    covariance = np.zeros((len(old.names) + 1,) * 2)
    covariance[:-1, :-1] = old.covariance
    covariance[-1, :-1] = covariance[:-1, -1] = reach
    covariance[-1, -1] = state.sigma**2
    return RigUncertainty((*old.names, N_WATER), covariance)


def _solve(covariance: FloatArray, right: FloatArray) -> FloatArray:
    """Solve with a covariance of different units that may be singular."""
    size = np.sqrt(np.diag(covariance))
    scaled = np.linalg.pinv(covariance / np.outer(size, size), hermitian=True)
    return scaled @ (right / size) / size
