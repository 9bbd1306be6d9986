"""Time filter of range, pitch and yaw; optional, raw values stay available."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from aqualvs.errors import OptionError, check_positive
from aqualvs.geometry.arrays import FloatArray
from aqualvs.scanning.posture import Posture, Refusal

# A micrometre and a microradian: keeps the covariance of an exact measurement invertible.
_MIN_VARIANCE = 1e-12 * np.eye(3)


@dataclass(frozen=True, slots=True)
class FilteredPosture:
    """State of the time filter."""

    # Metres and radians, as in `Posture`.
    range: float
    pitch: float
    yaw: float
    rates: FloatArray  # Shape (3,): their time derivatives, in m/s and rad/s.
    # Shape (6, 6): of (range, pitch, yaw) and the rates, by the noise of the frames and the unknown
    # motion.
    covariance: FloatArray
    age_s: float  # Time since the last measurement that entered.
    # Whether this frame's measurement entered; False where it was refused by the gate, or there was
    # none.
    accepted: bool
    # Shape (3, 3): of (range, pitch, yaw) by the uncertainty of the rig, as the last measurement
    # that entered had it: common to all frames, so no filter reduces it.
    rig_covariance: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))

    @property
    def total_covariance(self) -> FloatArray:
        """Covariance (3, 3) of (range, pitch, yaw) by noise, motion and rig together."""
        return self.covariance[:3, :3] + self.rig_covariance


@dataclass(frozen=True, slots=True, kw_only=True)
class PostureFilterOptions:
    """Motion model and gate of the filter."""

    # Random acceleration towards and from the target, in m/s², that acts for about a second: the
    # speed a second ahead is uncertain by the same number in m/s.
    range_acceleration: float = 0.2
    # The same for the angles, in rad/s².
    pitch_acceleration: float = 0.3
    yaw_acceleration: float = 0.5
    # Standard deviation of the rates when the filter starts, in m/s and rad/s.
    initial_speed: float = 0.5
    initial_turn_rate: float = 0.5
    gate_probability: float = 0.9999  # Share of sound measurements that pass the gate.
    # Rejected measurements in a row that agree with each other, after which the filter accepts
    # them: the target itself is elsewhere. An angle alone begins anew after so many.
    n_rejected: int = 3
    # Seconds without an accepted measurement after which there is no filtered posture.
    max_coast: float = 0.5

    def __post_init__(self) -> None:
        """Raise `OptionError` if a value makes no sense."""
        check_positive("time filter", self, *self.__slots__)
        if not self.gate_probability < 1.0:
            raise OptionError(
                f"time filter, gate_probability {self.gate_probability:g}: must lie between 0 and 1"
            )


class PostureFilter:
    """Kalman filter for range, pitch and yaw at constant rates, with a gate.

    The default options are for a small vehicle.

    Notes
    -----
    White-noise acceleration (Bar-Shalom, Li and Kirubarajan 2001, section 6.2.2) in continuous
    time, so that the frame rate does not matter. Only measurements move the state; what `update`
    returns between them is a forecast. A measurement beyond the gate starts a rival track; the
    rival replaces the track once enough measurements in a row have agreed with it.

    A vehicle under full thrust, or in a swell that tosses it, accelerates by more than the model
    allows. The innovations of the range show it: where the mean of their normalised squares exceeds
    2, the range's noise grows with it (adjustable level, Bar-Shalom et al. 2001, section 11.2). So
    the filter is as smooth in calm water, and not late in a manoeuvre.

    An angle alone beyond its gate is left out, and the rest of the measurement enters: a vehicle
    that pitches over faster than the model allows must not lose its range. An angle that is left
    out often enough in a row begins anew.

    Pitch and yaw stay within 90 degrees of the target's normal by their definition, so that no
    angle wraps. Errors of the rig are constant in time; no filter reduces them, and the covariance
    does not hold them.
    """

    def __init__(self, options: PostureFilterOptions | None = None) -> None:
        self.options = options or PostureFilterOptions()
        self._motion = _Motion(self.options)
        self._track: _Track | None = None
        self._rival: _Track | None = None

    def update(self, time_s: float, posture: Posture | Refusal) -> FilteredPosture | None:
        """Update by the measurement of one frame, and return the state at its time.

        Parameters
        ----------
        time_s : float
            Of the frame, by the stream's clock. Where no frames come the caller lets it advance. A
            measurement older than the last accepted one is left out; one older by more than
            `max_coast` is that of another stream, and starts the filter anew.
        posture : Posture or Refusal
            As measured; never changed.

        Returns
        -------
        filtered : FilteredPosture or None
            None before the first measurement, and when none has been accepted for `max_coast`.
        """
        self._track = self._still_known(self._track, time_s)
        self._rival = self._still_known(self._rival, time_s)
        accepted = False
        if isinstance(posture, Posture) and math.isfinite(time_s):
            measured = _measurement(posture)
            accepted = measured is not None and self._take(time_s, *measured)
            if accepted and self._track is not None:
                self._track = replace(self._track, rig_covariance=posture.rig_covariance)
        if self._track is None:
            return None
        ahead = self._motion.forecast(self._track, time_s)
        distance, pitch, yaw = ahead.state[:3].tolist()
        return FilteredPosture(
            distance,
            pitch,
            yaw,
            ahead.state[3:].copy(),
            ahead.cov.copy(),
            max(0.0, time_s - self._track.time_s),
            accepted,
            self._track.rig_covariance,
        )

    def _still_known(self, track: "_Track | None", time_s: float) -> "_Track | None":
        """Return the track unless it is too old, or from another stream."""
        if track is None or abs(time_s - track.time_s) > self.options.max_coast:
            return None
        return track

    def _take(self, time_s: float, measured: FloatArray, cov: FloatArray) -> bool:
        """Update the track or its rival by a measurement; return whether it entered the track."""
        if self._track is None:
            self._track = self._motion.started(time_s, measured, cov)
            return True
        if time_s < self._track.time_s:
            return False
        updated = self._motion.updated(self._track, time_s, measured, cov)
        if updated is not None:
            self._track, self._rival = updated, None
            return True
        self._rival = self._rival_with(time_s, measured, cov)
        if self._rival.n_measurements < self.options.n_rejected:
            return False
        self._track, self._rival = self._rival, None
        return True

    def _rival_with(self, time_s: float, measured: FloatArray, cov: FloatArray) -> "_Track":
        """Return the rival track with a measurement that did not fit the track."""
        if self._rival is not None and time_s >= self._rival.time_s:
            updated = self._motion.updated(self._rival, time_s, measured, cov)
            if updated is not None and not any(updated.n_left_out):
                return updated
        return self._motion.started(time_s, measured, cov)


@dataclass(frozen=True, slots=True)
class _Track:
    """State (6,) = (range, pitch, yaw, rates) and its covariance at the last measurement."""

    time_s: float
    state: FloatArray
    cov: FloatArray
    n_measurements: int
    rig_covariance: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    n_left_out: tuple[int, int] = (0, 0)  # How often in a row pitch and yaw have been left out.
    # Mean normalised square of the range's innovations; 1 where it moves as the model allows.
    surprise: float = 1.0


class _Motion:
    """Motion model: forecast of a track, and its update by measurements."""

    def __init__(self, options: PostureFilterOptions) -> None:
        angles = options.pitch_acceleration, options.yaw_acceleration
        self._noise = np.diag(np.square((options.range_acceleration, *angles)))
        self._n_rejected = options.n_rejected
        turn = options.initial_turn_rate
        self._initial_rates = np.diag(np.square((options.initial_speed, turn, turn)))
        # Imported here: a run that filters nothing need not wait for SciPy.
        from scipy.special import chdtri

        # Below this squared Mahalanobis distance lies the share of three normal variables.
        self._gate = float(chdtri(3.0, 1.0 - options.gate_probability))
        # The same for one of them.
        self._gate_alone = float(chdtri(1.0, 1.0 - options.gate_probability))

    def started(self, time_s: float, measured: FloatArray, cov: FloatArray) -> _Track:
        """Return a track from its first measurement: its rates are unknown."""
        full = np.zeros((6, 6))
        full[:3, :3], full[3:, 3:] = cov, self._initial_rates
        return _Track(time_s, np.concatenate((measured, np.zeros(3))), full, 1)

    def forecast(self, track: _Track, time_s: float) -> _Track:
        """Return the track at a later time; at an earlier one, as it is."""
        dt = time_s - track.time_s
        if not dt > 0.0:
            return track
        move = np.eye(6)
        move[0, 3] = move[1, 4] = move[2, 5] = dt
        cov = move @ track.cov @ move.T
        noise = self._noise.copy()
        # Twice the expected square is no manoeuvre: noise alone exceeds it in one frame of eleven,
        # by little.
        noise[0, 0] *= max(1.0, track.surprise / 2.0) ** 2
        cov[:3, :3] += noise * (dt**3 / 3.0)
        cov[:3, 3:] += noise * (dt**2 / 2.0)
        cov[3:, :3] += noise * (dt**2 / 2.0)
        cov[3:, 3:] += noise * dt
        return replace(track, time_s=time_s, state=move @ track.state, cov=cov)

    def updated(
        self, track: _Track, time_s: float, measured: FloatArray, cov: FloatArray
    ) -> _Track | None:
        """Return the track after a measurement, None if that lies beyond the gate."""
        # A range forecast over a longer time is too uncertain to tell an angle alone from a wild
        # posture.
        fresh_s = 0.15
        ahead = self.forecast(track, time_s)
        innovation = measured - ahead.state[:3]
        of_innovation = ahead.cov[:3, :3] + cov
        inverse = np.linalg.inv(of_innovation)
        at, of_used, n_left_out = [0, 1, 2], cov, (0, 0)
        if innovation @ inverse @ innovation > self._gate:
            used = innovation**2 <= self._gate_alone * np.diag(of_innovation)
            if not used[0] or used.all() or time_s - track.time_s > fresh_s:
                return None
            at = np.flatnonzero(used).tolist()
            inverse = np.linalg.inv(of_innovation[np.ix_(at, at)])
            of_used = cov[np.ix_(at, at)]
            pitch, yaw = ahead.n_left_out
            n_left_out = (0 if used[1] else pitch + 1, 0 if used[2] else yaw + 1)
        gain = ahead.cov[:, at] @ inverse
        # Joseph's form stays positive whatever rounding does.
        keep = np.eye(6)
        keep[:, at] -= gain
        after = keep @ ahead.cov @ keep.T + gain @ of_used @ gain.T
        state = ahead.state + gain @ innovation[at]
        # The mean is over about two and a half frames.
        surprise = float(innovation[0] ** 2 / of_innovation[0, 0])
        updated = replace(
            ahead,
            surprise=ahead.surprise + 0.4 * (surprise - ahead.surprise),
            state=state,
            cov=0.5 * (after + after.T),
            n_measurements=track.n_measurements + 1,
            n_left_out=n_left_out,
        )
        return self._angles_begun(updated, measured, cov)

    def _angles_begun(self, track: _Track, measured: FloatArray, cov: FloatArray) -> _Track:
        """Return the track with an angle that has been left out too often begun anew."""
        out = [k for k, n in enumerate(track.n_left_out, 1) if n >= self._n_rejected]
        if not out:
            return track
        state, after = track.state.copy(), track.cov.copy()
        for k in out:
            for at, value, variance in (
                (k, measured[k], cov[k, k]),
                (k + 3, 0.0, self._initial_rates[k, k]),
            ):
                state[at] = value
                after[at] = after[:, at] = 0.0
                after[at, at] = variance
        pitch, yaw = (n if n < self._n_rejected else 0 for n in track.n_left_out)
        return replace(track, state=state, cov=after, n_left_out=(pitch, yaw))


def _measurement(posture: Posture) -> tuple[FloatArray, FloatArray] | None:
    """Return (range, pitch, yaw) and their covariance, None where there is nothing to use."""
    measured = np.array([posture.range, posture.pitch, posture.yaw])
    cov = 0.5 * (posture.covariance + posture.covariance.T) + _MIN_VARIANCE
    if not (np.isfinite(measured).all() and np.isfinite(cov).all()):
        return None
    try:
        np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        return None
    return measured, cov
