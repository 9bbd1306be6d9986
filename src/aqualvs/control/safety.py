"""Safety gate for every effort, and detection of postures that do not respond to the efforts.

`SafetyGate` sits between controllers and vehicle, whoever steers, and protects vehicle and net. It
never adds thrust towards the target, never arms, never changes the mode; docs/missions.md has its
rules as a table.

`AnswerWatch` detects postures that stand still while the vehicle moves. It does not use the
pictures: it compares postures, efforts and the autopilot's reports.
"""

import math
from collections import deque
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from typing import NamedTuple

from aqualvs.control.gains import VehicleFacts
from aqualvs.control.vehicle import NEUTRAL, Effort, Mode, VehicleState
from aqualvs.errors import OptionError
from aqualvs.scanning.posture import Posture


class LimitReason(StrEnum):
    """Reason why an effort was changed or stopped; the value is what logs write in `reason`."""

    NOT_ENGAGED = "not_engaged"
    NO_HEARTBEAT = "no_heartbeat"
    DISARMED = "disarmed"
    PILOT_MODE = "pilot_mode"
    NO_STATION = "no_station"
    IGNORED = "ignored"
    CONFLICT = "conflict"
    UNKNOWN_MODE = "unknown_mode"
    PILOT_STICKS = "pilot_sticks"
    CLOCK = "clock"
    FROZEN = "frozen"
    NO_ANSWER = "no_answer"
    NO_POSTURE = "no_posture"
    NOT_FINITE = "not_finite"
    TOO_CLOSE = "too_close"
    TOO_FAST = "too_fast"
    NO_SETPOINT = "no_setpoint"
    MISSION_OVER = "mission_over"
    TIPPING = "tipping"
    GAVE_UP = "gave_up"

    @property
    def words(self) -> str:
        """Text for the pilot."""
        return _WORDS[self]

    @property
    def takes_over(self) -> bool:
        """Whether the pilot must engage again before efforts pass."""
        return self in _TAKES_OVER


_WORDS = {
    LimitReason.NOT_ENGAGED: "not engaged: the pilot steers until told otherwise",
    LimitReason.NO_HEARTBEAT: "the vehicle is silent; stopped until engaged again",
    LimitReason.DISARMED: "the vehicle is disarmed; arm it and engage again",
    LimitReason.PILOT_MODE: "the pilot chose another mode; stopped until engaged again",
    LimitReason.NO_STATION: "no ground station heard; stopped until engaged again",
    LimitReason.IGNORED: "the vehicle ignores our sticks; stopped until engaged again",
    LimitReason.CONFLICT: "two speak as the vehicle; stopped until engaged again",
    LimitReason.UNKNOWN_MODE: "not a vehicle that can be steered; stopped until engaged again",
    LimitReason.PILOT_STICKS: "the pilot took the sticks; stopped until engaged again",
    LimitReason.CLOCK: "time ran backwards; stopped for this update",
    LimitReason.FROZEN: "the picture stands still; neutral until it moves",
    LimitReason.NO_ANSWER: (
        "the posture does not answer to the efforts; stopped until engaged again"
    ),
    LimitReason.NO_POSTURE: "no valid posture; neutral until it is back",
    LimitReason.NOT_FINITE: "a number is not finite; neutral for this update",
    LimitReason.TOO_CLOSE: "closer than the least range; backing away",
    LimitReason.TOO_FAST: "closing in too fast; braking",
    LimitReason.NO_SETPOINT: "no range is set to hold",
    LimitReason.MISSION_OVER: "the plan is done; holding until the pilot takes over",
    LimitReason.TIPPING: "the vehicle tips over; take the sticks while the target is in sight",
    LimitReason.GAVE_UP: "the target was lost for too long; stopped until engaged again",
}
_TAKES_OVER = frozenset(
    {
        LimitReason.NOT_ENGAGED,
        LimitReason.NO_HEARTBEAT,
        LimitReason.DISARMED,
        LimitReason.PILOT_MODE,
        LimitReason.NO_STATION,
        LimitReason.IGNORED,
        LimitReason.CONFLICT,
        LimitReason.UNKNOWN_MODE,
        LimitReason.PILOT_STICKS,
        LimitReason.NO_ANSWER,
        LimitReason.GAVE_UP,
    }
)

_REFUSED_MODES = {
    Mode.PILOT: LimitReason.PILOT_MODE,
    Mode.NO_STATION: LimitReason.NO_STATION,
    Mode.IGNORED: LimitReason.IGNORED,
    Mode.CONFLICT: LimitReason.CONFLICT,
    Mode.UNKNOWN: LimitReason.UNKNOWN_MODE,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyLimits:
    """Limits at which the gate intervenes.

    Attributes
    ----------
    posture_age : float
        Seconds after the last valid posture from which on there is no thrust. The rule is 0.2 s;
        0.15 s leaves room for the frame at which it is noticed.
    heartbeat_age : float
        Seconds of silence after which the vehicle counts as lost. Where the link counts nothing
        but heartbeats, which come once a second, choose 2.5.
    least_range : float
        Metres to the target, from the dome's centre, within which nothing approaches.
    approach_speed : float
        Greatest closing speed far from the target, in m/s.
    stopping_time : float
        Seconds to the least range, at the present closing speed, that must remain: the speed
        allowed shrinks with the way that is left.
    retreat_effort : float
        With which it backs away from too close; more where the controller asks for more. Must
        exceed the thrusters' dead band. It grows to `brake_effort` within the next 50 mm: a
        vehicle that still comes closer is pushed by the water.
    brake_effort : float
        With which it brakes what closes in by two thirds or more faster than allowed; likewise.
        Below it is less in proportion: braking is not to throw the vehicle out of sight.
    tilt : float
        Angle in radians by which roll or pitch may be off level; beyond, the pilot is warned.
    """

    posture_age: float = 0.15
    heartbeat_age: float = 1.0
    least_range: float = 0.35
    approach_speed: float = 0.3
    stopping_time: float = 0.7
    retreat_effort: float = 0.25
    brake_effort: float = 0.5
    tilt: float = math.radians(45.0)

    def __post_init__(self) -> None:
        """Refuse limits that cannot work.

        Raises
        ------
        OptionError
            If one makes no sense.
        """
        for field in fields(self):
            value = getattr(self, field.name)
            if not (value > 0.0 and math.isfinite(value)):
                raise OptionError(f"safety, {field.name} {value:g}: must be positive")
        if self.posture_age > 0.2:
            raise OptionError(
                f"safety, posture_age {self.posture_age:g} s: choose at most 0.2 s; a vehicle "
                "that cannot see must not push"
            )
        for name in ("retreat_effort", "brake_effort"):
            if getattr(self, name) > 1.0:
                raise OptionError(f"safety, {name} {getattr(self, name):g}: choose at most 1")


class SafetyGate:
    """Gate that passes, changes or stops efforts; pure, all time comes from outside.

    It starts disengaged.

    Parameters
    ----------
    limits : SafetyLimits, optional
        Defaults if left out.

    Attributes
    ----------
    latched : LimitReason or None
        Why nothing passes until `engage`; None while engaged.
    """

    def __init__(self, limits: SafetyLimits | None = None) -> None:
        self.limits = limits or SafetyLimits()
        self.latched: LimitReason | None = LimitReason.NOT_ENGAGED
        self._last_s = -math.inf
        self._seen: deque[tuple[float, float]] = deque(maxlen=32)
        # The doubt in force, since when, and the effort that brakes.
        self._doubt: LimitReason | None = None
        self._doubt_s, self._brake = -math.inf, 0.0

    def engage(self, now_s: float, state: VehicleState) -> LimitReason | None:
        """Let efforts pass from now on, as the pilot wants it; return why not, None if so."""
        refused = self._vehicle_refuses(now_s, state)
        if refused is None and state.rival:
            # At the start it is unknown which of them is the vehicle; later, the newcomer is not.
            refused = LimitReason.CONFLICT
        if refused is None and self.tips(state):
            refused = LimitReason.TIPPING
        self.latched = LimitReason.NOT_ENGAGED if refused else None
        self._doubt = None
        return refused

    def tips(self, state: VehicleState) -> bool:
        """Return whether the vehicle reports that it is tilted beyond the limit."""
        return max(abs(state.roll or 0.0), abs(state.pitch or 0.0)) > self.limits.tilt

    def stop(self, reason: LimitReason = LimitReason.NOT_ENGAGED) -> None:
        """Let nothing pass until `engage`."""
        self.latched = reason

    def check(
        self,
        now_s: float,
        posture_age_s: float,
        posture: Posture | None,
        state: VehicleState,
        effort: Effort,
        *,
        range_rate: float | None = None,
        doubt: LimitReason | None = None,
        brake: float = 0.0,
    ) -> tuple[Effort, LimitReason | None]:
        """Return the effort that may be sent, and the reason if it differs from the request.

        Parameters
        ----------
        now_s : float
            By the clock of `VehicleState.heard_s`.
        posture_age_s : float
            Time since the last valid posture.
        posture : Posture or None
            The last valid one; None if there never was any.
        state : VehicleState
            As the vehicle reports it.
        effort : Effort
            What controllers ask for.
        range_rate : float, optional
            In m/s, where a filter knows it; else it follows from postures in a row.
        doubt : LimitReason, optional
            Why the posture is not to be trusted, where something has noticed.
        brake : float
            Effort astern, 0 or more, for `BRAKE_S` from the first of a row of doubts on.
        """
        refused = self._clock_refuses(now_s) or self._vehicle_stops(now_s, state)
        if refused is None and self._doubts(now_s, doubt, brake) is not None:
            return self._effort_in_doubt(now_s), self._doubt
        refused = refused or self._sight_refuses(posture_age_s, posture) or _refused_effort(effort)
        if refused is not None or posture is None:
            return NEUTRAL, refused or LimitReason.NO_POSTURE
        near = min(posture.range, posture.nearest)
        closing = self._closing_speed(now_s - posture_age_s, near, range_rate)
        # A target that approached is assumed to approach further while it is not seen.
        return self._guarded(effort, near - max(closing, 0.0) * posture_age_s, closing)

    def _clock_refuses(self, now_s: float) -> LimitReason | None:
        backwards = not now_s >= self._last_s
        # Continue from the new time: a clock that was set back must not stop the gate for good.
        self._last_s = now_s if math.isfinite(now_s) else -math.inf
        if backwards or not math.isfinite(now_s):
            self._seen.clear()
            return LimitReason.CLOCK
        return None

    def _vehicle_stops(self, now_s: float, state: VehicleState) -> LimitReason | None:
        """Return why the vehicle may not be steered, until engaged again."""
        if self.latched is None:
            self.latched = self._vehicle_refuses(now_s, state)
        return self.latched

    def _doubts(self, now_s: float, doubt: LimitReason | None, brake: float) -> LimitReason | None:
        """Return the doubt in force; one that gives the vehicle back stays while it brakes."""
        stays = self._doubt is not None and self._doubt.takes_over
        if doubt is not self._doubt and not stays:
            self._doubt, self._doubt_s = doubt, now_s
            self._brake = min(max(brake, 0.0), 1.0)
        return self._doubt

    def _effort_in_doubt(self, now_s: float) -> Effort:
        """Return the brake while it lasts, then neutral."""
        if self._brake > 0.0 and now_s - self._doubt_s < BRAKE_S - _TICK_S:
            return Effort(forward=-self._brake)
        if self._doubt is not None and self._doubt.takes_over:
            self.latched = self._doubt
        return NEUTRAL

    def _vehicle_refuses(self, now_s: float, state: VehicleState) -> LimitReason | None:
        # A heartbeat from the future is by another clock, and useless.
        if not -self.limits.heartbeat_age <= now_s - state.heard_s <= self.limits.heartbeat_age:
            return LimitReason.NO_HEARTBEAT
        if not state.armed:
            return LimitReason.DISARMED
        if state.mode is not Mode.OURS:
            return _REFUSED_MODES[state.mode]
        if state.pilot_moves:
            return LimitReason.PILOT_STICKS
        return None

    def _sight_refuses(self, age_s: float, posture: Posture | None) -> LimitReason | None:
        if posture is None or not 0.0 <= age_s < self.limits.posture_age:
            return LimitReason.NO_POSTURE
        known = (posture.range, posture.pitch, posture.yaw, posture.nearest)
        if not all(map(math.isfinite, known)):
            return LimitReason.NOT_FINITE
        return None

    def _closing_speed(self, seen_s: float, near: float, range_rate: float | None) -> float:
        """Return how fast the nearest point comes closer, in m/s."""
        if not self._seen or seen_s > self._seen[-1][0]:
            self._seen.append((seen_s, near))
        while self._seen[-1][0] - self._seen[0][0] > _SPEED_WINDOW_S:
            self._seen.popleft()
        if range_rate is not None and math.isfinite(range_rate):
            return -range_rate
        (first_s, first), (last_s, last) = self._seen[0], self._seen[-1]
        if last_s - first_s < _MIN_WINDOW_S:
            return 0.0
        return (first - last) / (last_s - first_s)

    def _retreat(self, within: float) -> float:
        """Return the effort with which it backs away so far within the least range."""
        gentle, firm = self.limits.retreat_effort, self.limits.brake_effort
        return gentle + max(firm - gentle, 0.0) * min(within / _FIRM_WITHIN_M, 1.0)

    def _guarded(
        self, effort: Effort, near: float, closing: float
    ) -> tuple[Effort, LimitReason | None]:
        """Return the effort without the part that brings the target too close."""
        limits = self.limits
        left = near - limits.least_range
        if left < 0.0:
            return _backing(effort, self._retreat(-left)), LimitReason.TOO_CLOSE
        allowed = min(limits.approach_speed, left / limits.stopping_time)
        if closing > allowed:
            share = min((closing - allowed) / (_FIRM_ABOVE * allowed + 1e-6), 1.0)
            return _backing(effort, share * limits.brake_effort), LimitReason.TOO_FAST
        return _clipped(effort), None


BRAKE_S = 0.12
"""Time in seconds for which a vehicle whose picture stands still is braked: with the time until
that is noticed less than 0.5 s, and within the pilot's 0.2 s after the last posture."""
_TICK_S = 1e-3
# The dome's centre is some 30 mm behind the hull's front, and pictures end at 0.3 m: the retreat
# reaches its full effort before that.
_FIRM_WITHIN_M = 0.05
_FIRM_ABOVE = 2.0 / 3.0
# Postures this far apart give the closing speed to some cm/s in spite of their noise.
_SPEED_WINDOW_S = 0.4
_MIN_WINDOW_S = 0.15


def _refused_effort(effort: Effort) -> LimitReason | None:
    parts = (effort.forward, effort.right, effort.down, effort.yaw)
    return None if all(map(math.isfinite, parts)) else LimitReason.NOT_FINITE


def _backing(effort: Effort, least: float) -> Effort:
    """Return a push back, the controller's where it is stronger; turning stays allowed."""
    back = min(effort.forward, -least)
    return _clipped(replace(effort, forward=back, right=0.0, down=0.0))


def _clipped(effort: Effort) -> Effort:
    def clip(value: float) -> float:
        return min(max(value, -1.0), 1.0)

    return Effort(
        forward=clip(effort.forward),
        right=clip(effort.right),
        down=clip(effort.down),
        yaw=clip(effort.yaw),
    )


# Number of consecutive postures whose second differences, of three quantities, measure the noise.
_N_NOISE, _N_USUAL = 8, 50
_ORDER = 6.0
# Postures with less noise come from a simulation without noise: metres and radians.
_MIN_RANGE, _MIN_ANGLE = 2e-5, math.radians(0.005)
# The force that holds the vehicle in place is the mean thrust over so many seconds; known after so
# many. Before that, a current that the controller has yet to find takes as much.
_BALANCE_S, _BALANCED_S = 4.0, 10.0
_SLOPE_S = 0.3
# Greatest difference between means over parts of the window where a posture stands still, as share
# of the range and in radians; and the number of parts.
_STILL_RANGE, _STILL_YAW, _N_MEANS = 0.006, math.radians(0.6), 6
# Least duration of efforts towards the target, in seconds.
_PUSHED_S = 0.5
# Least distance of the range beyond its setpoint, in metres.
_OFF = 0.05
# A picture that stands still is noticed within so many seconds: older postures are live. Slower
# vehicles, in m/s, coast by little and are not braked: a hold in swell swings at 0.03.
_TRUSTED_S, _SLOW = 0.6, 0.05
# Water that passes at this speed and grows faster by so much, in m/s, takes efforts that promise a
# way: the more the greater the drag.
_WATER, _WATER_CHANGE = 0.4, 0.024
# Greatest change between two reports of a heading; a greater one is a reset compass.
_MAX_TURN = math.radians(20.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerLimits:
    """Limits beyond which a posture counts as not responding.

    Attributes
    ----------
    repeats_s : float
        Time after which a posture that is the same to the bit, while an effort is in force, counts
        as a frozen picture.
    quiet : float
        Noise of the postures, as share of the usual standard deviation, below which the picture is
        frozen. Twelve and more differences are looked at: sound noise is so small by chance once in
        10^10 frames.
    window_s : float
        Efforts and motion are compared over this time, in seconds.
    promised : float
        Way towards the target by the efforts, in metres, that a posture which stands still must
        answer to, in water that does not change. Standing still is 0.6 % of the range and 0.6
        degrees.
    turned : float
        Turn of the heading within `window_s` that a posture which stands still must answer to, in
        radians. An even way along a curved net turns the heading, too: at 0.8 m/s, the current's
        speed included, and a radius of 8 m by 10 degrees.
    """

    repeats_s: float = 0.2
    quiet: float = 0.1
    window_s: float = 1.7
    promised: float = 0.11
    turned: float = math.radians(12.0)

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
    """Posture with the integrals of the efforts until then."""

    time_s: float
    range: float
    yaw: float
    # Closing speed and way due to the efforts beyond the balance, since the start.
    speed: float
    way: float
    # Heading without jumps.
    heading: float


class AnswerWatch:
    """Detector of postures that do not respond to efforts.

    `LimitReason.FROZEN` while postures repeat to the bit, or their noise has all but vanished: a
    picture that stands still. `LimitReason.NO_ANSWER` where the efforts must have brought the
    vehicle nearer, or the autopilot reports that it has turned, and the posture shows nothing of
    it: a picture that stands still in spite of its noise, a vehicle that is caught, sticks that
    turn the other way.

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
        change = vehicle.forward_drag.slope(_WATER) * _WATER_CHANGE / vehicle.mass
        self._promised = self.limits.promised + 0.5 * change * self.limits.window_s**2
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
        """Add a sent effort, and the range in metres that it was for."""
        self._wanted = math.inf if wanted is None else wanted
        if effort != NEUTRAL:
            self._pushed_s = now_s
        self._effort = effort

    def see(self, now_s: float, posture: Posture, state: VehicleState) -> LimitReason | None:
        """Add a new posture; return why it cannot be used, None if it can.

        Parameters
        ----------
        now_s : float
        posture : Posture
            Of a frame that has not been seen before.
        state : VehicleState
            As the vehicle reports it.
        """
        if not all(map(math.isfinite, (now_s, posture.range, posture.pitch, posture.yaw))):
            return None
        self._go_on(now_s, posture.yaw, state)
        if self._repeats(now_s, posture) or self._noise.vanished(posture):
            return LimitReason.FROZEN
        moment = _Moment(now_s, posture.range, posture.yaw, self._speed, self._way, self._heading)
        self._moments.append(moment)
        while now_s - self._moments[0].time_s > self.limits.window_s + _SLOPE_S:
            self._moments.popleft()
        return LimitReason.NO_ANSWER if self._is_unanswered() else None

    def brake(self, doubt: LimitReason) -> float:
        """Return the effort astern that stops the vehicle within `BRAKE_S`; 0 if it is slow.

        Its speed is that of the last trusted postures and what the efforts since have added.

        Parameters
        ----------
        doubt : LimitReason
            Of the last posture.
        """
        blind_s = _TRUSTED_S if doubt is LimitReason.FROZEN else self.limits.window_s
        before = [m for m in self._moments if self._now_s - m.time_s >= blind_s]
        if len(before) < 2:
            return 0.0
        last = before[-1]
        first = next(m for m in before if last.time_s - m.time_s <= _SLOPE_S)
        if first is last:
            return 0.0
        speed = (first.range - last.range) / (last.time_s - first.time_s)
        kept = math.exp(-self._damping() * (self._now_s - last.time_s))
        speed = kept * (speed - last.speed) + self._speed
        thrust = self._vehicle.thrust
        force = self._vehicle.mass * speed / BRAKE_S
        return thrust.effort(force / thrust.backward) if speed > _SLOW else 0.0

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
            # It has drifted: other efforts may be needed to hold it.
            step = self._thrust_s = 0.0
        # Sideways thrust balances the drag of a way along the target; it predicts no approach.
        forward, _ = self._vehicle.thrust.forces(self._effort.forward, self._effort.right)
        push = forward * math.cos(yaw) / self._vehicle.mass
        if push <= 0.0:
            self._backed_s = now_s
        if self._effort != NEUTRAL and step > 0.0:
            self._thrust_s += step
            share = step / (step + min(self._thrust_s, _BALANCE_S))
            self._balance += share * (push - self._balance)
        self._way += step * self._speed
        kept = math.exp(-self._damping() * step)
        self._speed = kept * self._speed + step * (push - self._balance)
        if state.heading is None:
            return
        turn = math.remainder(state.heading - self._told, 2.0 * math.pi)
        if abs(turn) < _MAX_TURN:
            self._heading += turn
        self._told = state.heading

    def _damping(self) -> float:
        """Return the rate, per second, at which drag takes away a speed.

        The balance is the drag of the water that passes.
        """
        drag, mass = self._vehicle.forward_drag, self._vehicle.mass
        return drag.slope(drag.speed(mass * self._balance)) / mass

    def _is_unanswered(self) -> bool:
        first, last = self._moments[0], self._moments[-1]
        begin = next((m for m in self._moments if m.time_s - first.time_s >= _SLOPE_S), None)
        if begin is None:
            return False
        span = last.time_s - begin.time_s
        before = (first.range - begin.range) / (begin.time_s - first.time_s)
        damping = self._damping()
        coasting = -math.expm1(-damping * span) / damping if damping else span
        promised = last.way - begin.way + (before - begin.speed) * coasting
        turned = abs(last.heading - begin.heading)
        pushed = last.time_s - self._backed_s > _PUSHED_S and self._thrust_s > _BALANCED_S
        # Near its setpoint the vehicle's thrust balances the changing current.
        pushed = pushed and last.range - self._wanted > _OFF
        promises = promised > self._promised and pushed
        if not promises and turned < self.limits.turned:
            return False
        lately = [m for m in self._moments if m.time_s >= begin.time_s]
        if _swing([m.yaw for m in lately]) > _STILL_YAW:
            return False
        return _swing([m.range for m in lately]) < _STILL_RANGE * last.range


def _swing(values: list[float]) -> float:
    """Return by how much the means over some values in a row differ, at most."""
    n = max(len(values) // _N_MEANS, 1)
    means = [sum(values[k : k + n]) / n for k in range(0, len(values) - n + 1, n)]
    return max(means) - min(means)


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

    def vanished(self, posture: Posture) -> bool:
        """Add a posture; return whether the noise has almost vanished."""
        self._postures.append((posture.range, posture.pitch, posture.yaw))
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
