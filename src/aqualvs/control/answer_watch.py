"""Detection of postures that do not respond to the efforts, or to the vehicle's attitude.

`AnswerWatch` detects postures that stand still while the vehicle moves. It does not use the
pictures: it compares postures, efforts and the autopilot's reports.
"""

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from statistics import fmean, median
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from aqualvs.control.gains import VehicleFacts
from aqualvs.control.safety import NO_BRAKE, Brake, LimitReason
from aqualvs.control.vehicle import NEUTRAL, Effort, VehicleState
from aqualvs.geometry.arrays import FloatArray
from aqualvs.scanning.posture import Posture

# Number of consecutive postures whose second differences, of three quantities, measure the noise.
_N_NOISE, _N_USUAL = 8, 50
_ORDER = 6.0
# Postures with less noise come from a simulation without noise: metres and radians.
_MIN_RANGE, _MIN_ANGLE = 2e-5, math.radians(0.005)
# The force that holds the vehicle in place is the mean thrust over so many seconds; known after so
# many. Before that, a current that the controller has yet to find takes as much.
_BALANCE_S, _BALANCED_S = 4.0, 10.0
# A longer gap between postures begins anew; and the time of a speed before a period.
_GAP_S = 0.3
# Greatest difference between means over parts of a period where a posture stands still, as share
# of the range and in radians; and the length of a part in seconds.
_STILL_RANGE, _STILL_ANGLE, _PART_S = 0.006, math.radians(0.6), 0.28
# A picture that stands still is noticed within so many seconds: older postures are live. So many
# of them tell the speed. Slower vehicles, in m/s, coast by little and are not braked: noise of 2 mm
# makes 0.003 of a line over 15 postures.
_TRUSTED_S, _N_SPEED, _SLOW = 0.6, 3, 0.03
# Greatest change between two reports of a heading; a greater one is a reset compass.
_MAX_TURN = math.radians(20.0)
# An approach is predicted over the first time by a line through the second, in seconds.
_STOP_S, _LINE_S, _N_LINE = 0.32, 0.6, 6
# An approach has stopped where less than this share of it is seen, and two means over three
# postures differ by less than so many metres.
_SEEN_SHARE, _N_STOPPED, _STOPPED = 0.35, 3, 0.004
# Time over which attitudes are compared, in seconds; the part of it in which the posture must stand
# still; the greatest delay of a posture against the autopilot; and the least number of postures.
_ATTITUDE_S, _STILL_S, _LATE_S, _N_ATTITUDE = 1.6, 0.8, 0.24, 16


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerLimits:
    """Limits beyond which a posture counts as not responding."""

    # Time after which a posture that is the same to the bit, while an effort is in force, counts as
    # a frozen picture.
    repeats_s: float = 0.2
    # Noise of the postures, as share of the usual standard deviation, below which the picture is
    # frozen. Twelve and more differences are looked at: sound noise is so small by chance once in
    # 10^10 frames.
    quiet: float = 0.1
    # Efforts and motion are compared over these times, in seconds.
    window_s: float = 1.7
    long_window_s: float = 3.0
    # Way towards the target by the efforts, in metres, that a posture which stands still must
    # answer to, in water that does not change. Standing still is 0.6 % of the range and 0.6
    # degrees.
    promised: float = 0.22
    # Turn of the heading within `window_s` that a posture which stands still must answer to, in
    # radians. An even way along a curved net turns the heading, too: at 0.8 m/s, the current's
    # speed included, and a radius of 8 m by 10 degrees.
    turned: float = math.radians(12.0)
    # An approach that ends at once, short of what is predicted by so many times the usual error of
    # the prediction, and by so many metres, is that of a posture which stands still.
    short: float = 4.0
    short_of: float = 0.01
    # Greatest usual error of the prediction, in metres, at which it is used: in swell an approach
    # may end at any moment.
    usual: float = 0.005
    # Standard deviation of the autopilot's pitch or heading about an even turn, in radians, that a
    # posture must follow by more than this share.
    swung: float = math.radians(1.0)
    follows: float = 0.35


class _Moment(NamedTuple):
    """Posture with the efforts and the autopilot's attitude."""

    time_s: float
    range: float
    pitch: float
    yaw: float
    # Acceleration towards the target by the efforts, and the part that holds the vehicle in place.
    push: float
    balance: float
    # Closing speed and way due to the efforts beyond the balance, since the start.
    speed: float
    way: float
    # Of the autopilot; the heading without jumps, NaN where it is not known.
    heading: float
    attitude: float


class AnswerWatch:
    """Detector of postures that do not respond to efforts or attitude.

    `LimitReason.FROZEN` while postures repeat to the bit, or their noise has all but vanished: a
    picture that stands still. `LimitReason.NO_ANSWER` where the vehicle must have moved and the
    posture shows nothing of it: a picture that stands still in spite of its noise, a vehicle that
    is caught, sticks that turn the other way. So it must where

    - it closed in evenly, and no effort has stopped it;
    - the efforts must have brought it nearer;
    - the autopilot reports that it has turned, or that it pitches or swings to and fro.

    `vehicle`: its mass and thrust.
    """

    def __init__(self, vehicle: VehicleFacts, limits: AnswerLimits | None = None) -> None:
        # Water that passes at this speed and grows faster by so much, in m/s, takes efforts that
        # promise a way: the more the greater the drag.
        water, water_change = 0.4, 0.024
        self.limits = limits or AnswerLimits()
        self._vehicle = vehicle
        # Acceleration that a growing current takes.
        self._change = vehicle.forward_drag.slope(water) * water_change / vehicle.mass
        self._noise = _Noise(self.limits.quiet)
        self.reset()

    def reset(self) -> None:
        """Forget everything, as for another stream."""
        self._noise.reset()
        self._last: tuple[float, float, float] | None = None
        self._same_s = self._pushed_s = -math.inf
        self._frozen = False
        # Squared error of the predicted approach, and the number of predictions.
        self._usual, self._n_predicted = 0.0, 0
        self.restart()

    def restart(self) -> None:
        """Begin to compare anew: nothing was done and nothing seen yet."""
        # In the order of their times.
        self._moments: list[_Moment] = []
        self._now_s = math.nan
        self._effort = NEUTRAL
        self._balance, self._thrust_s = 0.0, 0.0
        self._speed = self._way = 0.0
        self._heading, self._last_heading = 0.0, math.nan
        # For how long the posture has stood still, and the age from which on it is live.
        self._still_s, self._blind_s = 0.0, _TRUSTED_S

    def done(self, now_s: float, effort: Effort) -> None:
        """Add a sent effort."""
        if effort != NEUTRAL:
            self._pushed_s = now_s
        self._effort = effort

    def see(self, now_s: float, posture: Posture, state: VehicleState) -> LimitReason | None:
        """Add the posture of a new frame; return why it cannot be used, None if it can."""
        seen = (posture.range, posture.pitch, posture.yaw)
        if not all(map(math.isfinite, (now_s, *seen))):
            return None
        push = self._advance(now_s, posture.yaw, state)
        vanished = self._noise.vanished(seen)
        if self._repeats(now_s, seen) or vanished:
            self._blind_s = _TRUSTED_S
            if vanished:
                # None where frames were missing just before, or the watch has begun anew.
                n = min(_N_NOISE, len(self._moments))
                self._still_s = now_s - self._moments[-n].time_s if n else 0.0
            return LimitReason.FROZEN
        heading = math.nan if state.heading is None else self._heading
        attitude = math.nan if state.pitch is None else state.pitch
        moved = (push, self._balance, self._speed, self._way)
        self._moments.append(_Moment(now_s, *seen, *moved, heading, attitude))
        del self._moments[: self._first_within(self.limits.long_window_s + _GAP_S)]
        stands = self._has_stopped() or self._is_unanswered() or self._does_not_follow()
        return LimitReason.NO_ANSWER if stands else None

    def brake(self, now_s: float, still_s: float | None = None) -> Brake:
        """Return the push astern that stops the vehicle after a doubt.

        Its speed is that of the last live postures and what the efforts since have added.

        `still_s`: for how long the picture has stood still, if the picture tells it; else as the
        last posture has told.
        """
        # Greatest length of the brake, and the time from the first still picture to neutral: 0.1 s
        # of half a second are left to what happens before a picture arrives, and on the wire.
        brake_s, neutral_s = 0.12, 0.4
        tick_s = 1e-3
        if still_s is not None:
            self._still_s, self._blind_s = still_s, _TRUSTED_S
        before = [m for m in self._moments if now_s - m.time_s >= self._blind_s]
        if not before:
            return NO_BRAKE
        last = before[-1]
        line = [m for m in before if last.time_s - m.time_s <= _LINE_S]
        if len(line) < _N_SPEED:
            return NO_BRAKE
        # A brake ends with a frame.
        frame_s = self._moments[-1].time_s - self._moments[-2].time_s
        left_s = min(brake_s, neutral_s - self._still_s) + tick_s
        length_s = math.floor(left_s / frame_s) * frame_s
        if length_s <= 0.0:
            return NO_BRAKE
        # Without the way by the efforts the approach is even.
        slope, _ = _line([m.time_s for m in line], [m.range + m.way for m in line])
        kept = math.exp(-self._damping(self._balance) * (now_s - last.time_s))
        speed = self._speed - kept * slope
        if speed <= _SLOW:
            return NO_BRAKE
        thrust = self._vehicle.thrust
        force = self._vehicle.mass * speed / length_s
        return Brake(thrust.effort(force / thrust.backward), now_s + length_s)

    def _repeats(self, now_s: float, found: tuple[float, float, float]) -> bool:
        """Return whether the posture has been the same to the bit while an effort was in force."""
        if found != self._last:
            self._last, self._same_s, self._frozen = found, now_s, False
        elif self._pushed_s >= self._same_s and now_s - self._same_s >= self.limits.repeats_s:
            self._frozen = True
        self._still_s = now_s - self._same_s
        return self._frozen

    def _first_within(self, period_s: float) -> int:
        """Return the index of the first moment that is no older than a period before now."""
        now_s = self._now_s
        return bisect_left(self._moments, True, key=lambda m: now_s - m.time_s <= period_s)

    def _advance(self, now_s: float, yaw: float, state: VehicleState) -> float:
        """Let the efforts act until now; return their acceleration towards the target."""
        step = now_s - self._now_s
        self._now_s = now_s
        if not 0.0 < step < _GAP_S:
            self._moments.clear()
            self._last_heading = math.nan
            # It has drifted: other efforts may be needed to hold it.
            step = self._thrust_s = 0.0
        # Sideways thrust balances the drag of a way along the target; it predicts no approach.
        forward, _ = self._vehicle.thrust.forces(self._effort.forward, self._effort.right)
        push = forward * math.cos(yaw) / self._vehicle.mass
        if self._effort != NEUTRAL and step > 0.0:
            self._thrust_s += step
            share = step / (step + min(self._thrust_s, _BALANCE_S))
            self._balance += share * (push - self._balance)
        self._way += step * self._speed
        kept = math.exp(-self._damping(self._balance) * step)
        self._speed = kept * self._speed + step * (push - self._balance)
        if state.heading is not None:
            turn = math.remainder(state.heading - self._last_heading, 2.0 * math.pi)
            if abs(turn) < _MAX_TURN:
                self._heading += turn
            self._last_heading = state.heading
        return push

    def _damping(self, balance: float) -> float:
        """Return the rate, per second, at which drag takes away a speed.

        The balance is the drag of the water that passes.
        """
        drag, mass = self._vehicle.forward_drag, self._vehicle.mass
        return drag.slope(drag.speed(mass * balance)) / mass

    def _has_stopped(self) -> bool:
        """Return whether an even approach has ended at once, and no effort has ended it."""
        # The prediction's usual error follows so many postures, and is known after so many.
        n_followed, n_predicted = 250, 100
        begin_s = self._now_s - _STOP_S
        if self._moments[0].time_s > begin_s - _LINE_S:
            return False
        first = bisect_left(self._moments, begin_s - _LINE_S, key=_time_of)
        line = self._moments[first : bisect_left(self._moments, begin_s, first, key=_time_of)]
        if len(line) < _N_LINE or len(self._moments) < 2 * _N_STOPPED:
            return False
        c, b, a, third, second, last = self._moments[-2 * _N_STOPPED :]
        late = (third, second, last)
        # Without the way by the efforts the approach is even.
        at = line[-1]
        slope, begin = _line([m.time_s - at.time_s for m in line], [m.range + m.way for m in line])
        took_s = fmean(m.time_s for m in late) - at.time_s
        predicted = fmean(m.way for m in late) - at.way - slope * took_s
        now = median(m.range for m in late)
        seen = begin - at.way - now
        error = predicted - seen
        # Efforts may end an approach; one that they only begin is seen later, for thrusters lag.
        predicted = min(predicted, (at.speed - slope) * took_s)
        short = predicted - seen
        limits, usual = self.limits, math.sqrt(self._usual)
        known = self._n_predicted >= n_predicted
        stopped = abs(median((a.range, b.range, c.range)) - now) < _STOPPED
        if (
            (known and stopped and abs(seen) < _SEEN_SHARE * predicted)
            and short > max(limits.short * usual, limits.short_of)
            and usual < limits.usual
        ):
            # A stop before the line's end bends the line, and is taken to be younger than it is.
            self._still_s = max(_STOP_S, short * took_s / predicted)
            self._blind_s = _TRUSTED_S
            return True
        self._n_predicted += 1
        square = min(error**2, 9.0 * self._usual) if known else error**2
        self._usual += (square - self._usual) / min(self._n_predicted, n_followed)
        return False

    def _is_unanswered(self) -> bool:
        """Return whether efforts or the heading promise a motion that is not seen."""
        limits, last = self.limits, self._moments[-1]
        for window_s in (limits.window_s, limits.long_window_s):
            first = self._first_within(window_s)
            lately = self._moments[first:]
            gap = (m for m in self._moments[:first] if lately[0].time_s - m.time_s <= _GAP_S)
            before = next(gap, None)
            if before is None or last.time_s - before.time_s < window_s:
                return False
            turned = window_s == limits.window_s
            turned = turned and abs(last.heading - lately[0].heading) >= limits.turned
            promises = self._thrust_s > _BALANCED_S
            promised = limits.promised + 0.5 * self._change * window_s**2
            promises = promises and self._way_of(before, lately) > promised
            if (turned or promises) and _stands_still(lately):
                self._still_s, self._blind_s = 0.0, window_s
                return True
        return False

    def _way_of(self, before: _Moment, lately: Sequence[_Moment]) -> float:
        """Return the way towards the target that the efforts of a period must have made.

        The balance is that of its begin: what the efforts have become since makes a way.
        """
        begin = lately[0]
        damping = self._damping(begin.balance)
        speed = (before.range - begin.range) / (begin.time_s - before.time_s)
        way, then_s = 0.0, begin.time_s
        for moment in lately[1:]:
            step, then_s = moment.time_s - then_s, moment.time_s
            way += step * speed
            speed = math.exp(-damping * step) * speed + step * (moment.push - begin.balance)
        return way

    def _does_not_follow(self) -> bool:
        """Return whether the autopilot pitches or turns to and fro, and the posture does not."""
        limits = self.limits
        if self._now_s - self._moments[0].time_s < _ATTITUDE_S + _LATE_S:
            return False
        lately = self._moments[self._first_within(_STILL_S) :]
        if not _stands_still(lately) or _swing([m.pitch for m in lately], lately) > _STILL_ANGLE:
            return False
        moments = self._moments[self._first_within(_ATTITUDE_S + _LATE_S) :]
        n = len(self._moments) - self._first_within(_ATTITUDE_S)
        if n < _N_ATTITUDE:
            return False
        pitch, attitude = [m.pitch for m in moments], [m.attitude for m in moments]
        yaw, heading = [m.yaw for m in moments], [m.heading for m in moments]
        # A posture that follows one of them is live, however the net moves the other.
        follows = [
            _share(_about_lines(seen[-n:], n)[0], about) >= limits.follows
            for seen, reported in ((pitch, attitude), (yaw, heading))
            if min((about := _about_lines(reported, n)).std(axis=1).tolist()) > limits.swung
        ]
        if not follows or any(follows):
            return False
        self._still_s, self._blind_s = 0.0, _ATTITUDE_S
        return True


def _line(times: list[float], values: list[float]) -> tuple[float, float]:
    """Return slope and value at 0 of a line by least squares."""
    t, v = fmean(times), fmean(values)
    slope = sum((a - t) * (b - v) for a, b in zip(times, values, strict=True))
    slope /= sum((a - t) ** 2 for a in times)
    return slope, v - slope * t


def _stands_still(moments: Sequence[_Moment]) -> bool:
    """Return whether means of range and yaw over parts of a period hardly differ."""
    if _swing([m.yaw for m in moments], moments) > _STILL_ANGLE:
        return False
    return _swing([m.range for m in moments], moments) < _STILL_RANGE * moments[-1].range


def _swing(values: list[float], moments: Sequence[_Moment]) -> float:
    """Return by how much the means over parts of some moments differ, at most."""
    n_parts = max(round((moments[-1].time_s - moments[0].time_s) / _PART_S), 1)
    n = max(len(values) // n_parts, 1)
    means = [sum(values[k : k + n]) / n for k in range(0, len(values) - n + 1, n)]
    return max(means) - min(means)


def _about_lines(values: list[float], n: int) -> FloatArray:
    """Return each `n` values in a row, without their mean and even change."""
    ramp = np.linspace(-1.0, 1.0, n)
    rows = sliding_window_view(np.array(values), n)
    rows = rows - rows.mean(axis=1, keepdims=True)
    slopes = np.array([ramp @ row for row in rows])
    rest: FloatArray = rows - ramp * slopes[:, None] / (ramp @ ramp)
    return rest


def _share(seen: FloatArray, reported: FloatArray) -> float:
    """Return the greatest share of what the autopilot reports that is seen, over the delays."""
    return max(abs(float(seen @ one)) / float(one @ one) for one in reported)


_time_of = attrgetter("time_s")


class _Noise:
    """Comparison of the noise of the last postures with the usual noise."""

    def __init__(self, quiet: float) -> None:
        self._quiet = quiet * quiet
        self.reset()

    def reset(self) -> None:
        self._postures: deque[tuple[float, float, float]] = deque(maxlen=3)
        self._recent: deque[float] = deque(maxlen=_N_NOISE - 2)
        self._usual = [0.0, 0.0, 0.0]
        self._n = 0

    def vanished(self, posture: tuple[float, float, float]) -> bool:
        """Add range, pitch and yaw; return whether the noise has almost vanished."""
        self._postures.append(posture)
        if len(self._postures) < 3:
            return False
        rows = zip(*self._postures, strict=True)
        squares = [(a - 2.0 * b + c) ** 2 / _ORDER for a, b, c in rows]
        known = self._n >= _N_USUAL and self._usual[0] > _MIN_RANGE**2
        known = known and min(self._usual[1:]) > _MIN_ANGLE**2
        if known:
            shares = [one / usual for one, usual in zip(squares, self._usual, strict=True)]
            self._recent.append(sum(shares) / 3.0)
            if len(self._recent) == self._recent.maxlen:
                mean = sum(self._recent) / len(self._recent)
                if mean < self._quiet:
                    return True
        self._learn(squares)
        return False

    def _learn(self, squares: list[float]) -> None:
        """Follow the usual noise; a wild posture counts as ten of the usual at most."""
        self._n += 1
        share = 1.0 / min(self._n, 2 * _N_USUAL)
        for i, one in enumerate(squares):
            usual = self._usual[i]
            bounded = min(one, 10.0 * usual) if self._n > _N_USUAL else one
            self._usual[i] = usual + share * (bounded - usual)
