"""Whether a posture answers to what is done, or stands still while the vehicle moves.

Independent of the pictures: it looks at postures, efforts and what the autopilot tells.
"""

import math
from collections import deque
from dataclasses import dataclass, fields
from typing import NamedTuple

from aqualvs.control.gains import VehicleFacts
from aqualvs.control.safety import Reason
from aqualvs.control.vehicle import NEUTRAL, Effort, VehicleState
from aqualvs.errors import OptionError
from aqualvs.scanning.posture import Posture

# Second differences of three quantities from so many postures in a row tell their noise.
_N_NOISE, _N_USUAL = 8, 50
_ORDER = 6.0
# Postures of less noise come from a simulation without any: metres and radians.
_LEAST_RANGE, _LEAST_ANGLE = 2e-5, math.radians(0.005)
# The force that holds the vehicle in its place is the mean over so many seconds of thrust; known
# after so many. Before, a current that the controller has yet to find takes as much.
_BALANCE_S, _BALANCED_S = 4.0, 10.0
_SLOPE_S = 0.3
# Means over parts of the window do not differ by more where a posture stands still: as share of the
# range, in radians; and how many parts there are.
_STILL_RANGE, _STILL_YAW, _N_MEANS = 0.006, math.radians(0.6), 6
# Efforts towards the target must have lasted so long, in seconds.
_PUSHED_S = 0.5
# The range must lie so far beyond the one asked for, in metres.
_OFF = 0.05
# Between two reports of a heading; more is a compass that was set anew.
_GREATEST_TURN = math.radians(20.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerLimits:
    """What counts as no answer.

    Attributes
    ----------
    repeats_s : float
        So long the same posture to the last bit, while an effort is in force, is a frozen picture.
    quiet : float
        Noise of the postures, as share of the usual standard deviation, below which the picture is
        frozen. Twelve and more differences are looked at: sound noise is so small by chance once in
        10^10 frames.
    window_s : float
        Efforts and motion are compared over so many seconds.
    promised : float
        Way towards the target by the efforts, in metres, that a posture which stands still must
        answer to. Standing still is 0.6 % of the range and 0.6 degrees: waters that take so much
        from the efforts move the vehicle by more.
    turned : float
        Turn of the heading within `window_s` that a yaw which stands still must answer to, in
        radians. An even way along a curved net turns the heading, too: at 0.3 m/s and a radius of
        8 m by 4 degrees.
    """

    repeats_s: float = 0.2
    quiet: float = 0.1
    window_s: float = 1.7
    promised: float = 0.45
    turned: float = math.radians(8.0)

    def __post_init__(self) -> None:
        """Refuse limits that cannot work.

        Raises
        ------
        OptionError
            Naming the first.
        """
        for field in fields(self):
            value = getattr(self, field.name)
            if not (value > 0.0 and math.isfinite(value)):
                raise OptionError(f"safety, {field.name} {value:g}: must be positive")


class _Moment(NamedTuple):
    """One posture, and what had been done until then."""

    time_s: float
    range: float
    yaw: float
    # Closing speed and way that the efforts beyond the balance have given since the start.
    speed: float
    way: float
    # Heading without jumps.
    heading: float


class AnswerWatch:
    """Looks for postures that do not answer.

    `Reason.FROZEN` while postures repeat to the bit, or their noise has all but vanished: a picture
    that stands still. `Reason.NO_ANSWER` where the efforts must have brought the vehicle nearer, or
    the autopilot tells that it has turned, and the posture shows nothing of it: a picture that
    stands still in spite of its noise, a vehicle that is caught, sticks that turn the other way.

    Parameters
    ----------
    vehicle : VehicleFacts
        Its mass and thrust.
    limits : AnswerLimits, optional
        Defaults if left out.
    """

    def __init__(self, vehicle: VehicleFacts, limits: AnswerLimits | None = None) -> None:
        self.limits = limits or AnswerLimits()
        self._vehicle = vehicle
        self._noise = _Noise(self.limits.quiet)
        self.reset()

    def reset(self) -> None:
        """Forget everything, as for another stream."""
        self._noise.reset()
        self._last: tuple[float, float, float] | None = None
        self._same_s = self._pushed_s = -math.inf
        self._frozen = False
        self.restart()

    def restart(self) -> None:
        """Begin to compare anew: nothing was done and nothing seen yet."""
        self._moments: deque[_Moment] = deque()
        self._now_s = math.nan
        self._effort = NEUTRAL
        self._balance, self._thrust_s = 0.0, 0.0
        self._backed_s, self._wanted = -math.inf, math.inf
        self._speed = self._way = 0.0
        self._heading, self._told = 0.0, math.nan

    def done(self, now_s: float, effort: Effort, wanted: float | None = None) -> None:
        """Take in which effort was sent, and for which range in metres."""
        self._wanted = math.inf if wanted is None else wanted
        if effort != NEUTRAL:
            self._pushed_s = now_s
        self._effort = effort

    def see(self, now_s: float, posture: Posture, state: VehicleState) -> Reason | None:
        """Take in a new posture; return why it is not to be trusted, None if it may be.

        Parameters
        ----------
        now_s : float
        posture : Posture
            Of a frame that has not been seen before.
        state : VehicleState
            What the vehicle tells.
        """
        if not all(map(math.isfinite, (now_s, posture.range, posture.pitch, posture.yaw))):
            return None
        self._go_on(now_s, posture.yaw, state)
        if self._repeats(now_s, posture) or self._noise.vanished(posture):
            return Reason.FROZEN
        moment = _Moment(now_s, posture.range, posture.yaw, self._speed, self._way, self._heading)
        self._moments.append(moment)
        while now_s - self._moments[0].time_s > self.limits.window_s + _SLOPE_S:
            self._moments.popleft()
        return Reason.NO_ANSWER if self._is_unanswered() else None

    def _repeats(self, now_s: float, posture: Posture) -> bool:
        """Return whether the posture has been the same to the bit while an effort was in force."""
        found = (posture.range, posture.pitch, posture.yaw)
        if found != self._last:
            self._last, self._same_s, self._frozen = found, now_s, False
        elif self._pushed_s >= self._same_s and now_s - self._same_s >= self.limits.repeats_s:
            self._frozen = True
        return self._frozen

    def _go_on(self, now_s: float, yaw: float, state: VehicleState) -> None:
        """Let the efforts act until now."""
        step = now_s - self._now_s
        self._now_s = now_s
        if not 0.0 < step < _SLOPE_S:
            self._moments.clear()
            self._told = math.nan
            step = 0.0
        # Thrust to the side is for the drag of a way along the target, and promises nothing.
        forward, _ = self._vehicle.thrust.forces(self._effort.forward, self._effort.right)
        push = forward * math.cos(yaw) / self._vehicle.mass
        if push <= 0.0:
            self._backed_s = now_s
        if self._effort != NEUTRAL and step > 0.0:
            self._thrust_s += step
            share = step / (step + min(self._thrust_s, _BALANCE_S))
            self._balance += share * (push - self._balance)
        self._way += step * self._speed
        self._speed += step * (push - self._balance)
        if state.heading is None:
            return
        turn = math.remainder(state.heading - self._told, 2.0 * math.pi)
        if abs(turn) < _GREATEST_TURN:
            self._heading += turn
        self._told = state.heading

    def _is_unanswered(self) -> bool:
        first, last = self._moments[0], self._moments[-1]
        begin = next((m for m in self._moments if m.time_s - first.time_s >= _SLOPE_S), None)
        if begin is None:
            return False
        span = last.time_s - begin.time_s
        before = (first.range - begin.range) / (begin.time_s - first.time_s)
        promised = last.way - begin.way + (before - begin.speed) * span
        turned = abs(last.heading - begin.heading)
        pushed = last.time_s - self._backed_s > _PUSHED_S and self._thrust_s > _BALANCED_S
        # Near its setpoint the vehicle leans on the water as that changes.
        pushed = pushed and last.range - self._wanted > _OFF
        promises = promised > self.limits.promised and pushed
        if not promises and turned < self.limits.turned:
            return False
        lately = [m for m in self._moments if m.time_s >= begin.time_s]
        if _swing([m.yaw for m in lately]) > _STILL_YAW:
            return False
        still = _swing([m.range for m in lately]) < _STILL_RANGE * last.range
        return (promises and still) or turned >= self.limits.turned


def _swing(values: list[float]) -> float:
    """Return by how much the means over some values in a row differ, at most."""
    n = max(len(values) // _N_MEANS, 1)
    means = [sum(values[k : k + n]) / n for k in range(0, len(values) - n + 1, n)]
    return max(means) - min(means)


class _Noise:
    """Compares the noise of the last postures with what it usually is."""

    def __init__(self, quiet: float) -> None:
        self._quiet = quiet * quiet
        self.reset()

    def reset(self) -> None:
        self._postures: deque[tuple[float, float, float]] = deque(maxlen=3)
        self._recent: deque[float] = deque(maxlen=_N_NOISE - 2)
        self._usual = [0.0, 0.0, 0.0]
        self._n = 0

    def vanished(self, posture: Posture) -> bool:
        """Take in a posture; return whether the noise has all but vanished."""
        self._postures.append((posture.range, posture.pitch, posture.yaw))
        if len(self._postures) < 3:
            return False
        rows = zip(*self._postures, strict=True)
        squares = [(a - 2.0 * b + c) ** 2 / _ORDER for a, b, c in rows]
        known = self._n >= _N_USUAL and self._usual[0] > _LEAST_RANGE**2
        known = known and min(self._usual[1:]) > _LEAST_ANGLE**2
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
