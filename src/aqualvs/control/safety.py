"""Safety gate for every effort.

`SafetyGate` sits between controllers and vehicle, whoever steers, and protects vehicle and net. It
never adds thrust towards the target, never arms, never changes the mode; docs/missions.md has its
rules as a table.
"""

import math
from collections import deque
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple, Self

from aqualvs.control.vehicle import NEUTRAL, Effort, Mode, VehicleState, clipped
from aqualvs.errors import OptionError, check_positive
from aqualvs.scanning.posture import Posture


class LimitReason(StrEnum):
    """Reason why an effort was changed or stopped; the value is what logs write in `reason`."""

    words: str  # Text for the pilot.

    def __new__(cls, value: str, words: str = "") -> Self:
        """Return a member that has its words."""
        one = str.__new__(cls, value)
        one._value_, one.words = value, words
        return one

    NOT_ENGAGED = "not_engaged", "not engaged: the pilot steers until told otherwise"
    NO_HEARTBEAT = "no_heartbeat", "the vehicle is silent; stopped until engaged again"
    DISARMED = "disarmed", "the vehicle is disarmed; arm it and engage again"
    PILOT_MODE = "pilot_mode", "the pilot chose another mode; stopped until engaged again"
    NO_STATION = "no_station", "no ground station heard; stopped until engaged again"
    IGNORED = "ignored", "the vehicle ignores our sticks; stopped until engaged again"
    CONFLICT = "conflict", "two senders claim to be the vehicle; stopped until engaged again"
    UNKNOWN_MODE = (
        "unknown_mode",
        "this kind of vehicle cannot be steered; stopped until engaged again",
    )
    PILOT_STICKS = "pilot_sticks", "the pilot took the sticks; stopped until engaged again"
    CLOCK = "clock", "time ran backwards; stopped for this update"
    FROZEN = "frozen", "the picture stands still; neutral until it moves"
    NO_ANSWER = (
        "no_answer",
        "the posture does not respond to the efforts; stopped until engaged again",
    )
    NO_POSTURE = "no_posture", "no valid posture; neutral until it is back"
    NOT_FINITE = "not_finite", "a value is not finite; neutral for this update"
    TOO_CLOSE = "too_close", "closer than the least range; backing away"
    TOO_FAST = "too_fast", "closing in too fast; braking"
    NO_SETPOINT = "no_setpoint", "no range is set to hold"
    MISSION_OVER = "mission_over", "the plan is done; holding until the pilot takes over"
    TIPPING = "tipping", "the vehicle is tipping over; take the sticks while the target is in sight"
    GAVE_UP = "gave_up", "the target was lost for too long; stopped until engaged again"

    @property
    def takes_over(self) -> bool:
        """Whether the pilot must engage again before efforts pass."""
        return not (self in _PASSING or self.steers)

    @property
    def steers(self) -> bool:
        """Whether an effort still passes, changed or with a warning."""
        return self in _STEERS


_STEERS = frozenset(
    {LimitReason.TOO_CLOSE, LimitReason.TOO_FAST, LimitReason.MISSION_OVER, LimitReason.TIPPING}
)
# What stops a vehicle for as long as it lasts.
_PASSING = frozenset(
    {
        LimitReason.CLOCK,
        LimitReason.FROZEN,
        LimitReason.NO_POSTURE,
        LimitReason.NOT_FINITE,
        LimitReason.NO_SETPOINT,
    }
)

_REFUSED_MODES = {
    Mode.PILOT: LimitReason.PILOT_MODE,
    Mode.NO_STATION: LimitReason.NO_STATION,
    Mode.IGNORED: LimitReason.IGNORED,
    Mode.CONFLICT: LimitReason.CONFLICT,
    Mode.UNKNOWN: LimitReason.UNKNOWN_MODE,
}


class Brake(NamedTuple):
    """Push astern that stops a vehicle whose posture is not to be trusted."""

    effort: float  # Astern, 0 to 1.
    until_s: float  # When neutral follows, by the clock of `VehicleState.heard_s`.


NO_BRAKE = Brake(0.0, -math.inf)
"""Neutral at once."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyLimits:
    """Limits at which the gate intervenes."""

    # Seconds after the last valid posture from which on there is no thrust. The rule is 0.2 s; 0.15
    # s leaves room for the frame at which it is noticed.
    posture_age: float = 0.15
    # Seconds of silence after which the vehicle counts as lost. Where the link counts nothing but
    # heartbeats, which come once a second, choose 2.5.
    heartbeat_age: float = 1.0
    # Metres to the target, from the dome's centre, within which nothing approaches.
    least_range: float = 0.35
    approach_speed: float = 0.3  # Greatest closing speed far from the target, in m/s.
    # Seconds to the least range, at the present closing speed, that must remain: the speed allowed
    # shrinks with the way that is left.
    stopping_time: float = 0.7
    # With which it backs away from too close; more where the controller asks for more. Must exceed
    # the thrusters' dead band. It grows to `brake_effort` within the next 50 mm: a vehicle that
    # still comes closer is pushed by the water.
    retreat_effort: float = 0.25
    # With which it brakes what closes in by two thirds or more faster than allowed; likewise. Below
    # it is less in proportion: braking is not to throw the vehicle out of sight.
    brake_effort: float = 0.5
    # Angle in radians by which roll or pitch may be off level; beyond, the pilot is warned.
    tilt: float = math.radians(45.0)

    def __post_init__(self) -> None:
        """Raise `OptionError` if a limit makes no sense."""
        check_positive("safety", self, *self.__slots__)
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
    """

    def __init__(self, limits: SafetyLimits | None = None) -> None:
        self.limits = limits or SafetyLimits()
        # Why nothing passes until `engage`; None while engaged.
        self.latched: LimitReason | None = LimitReason.NOT_ENGAGED
        self._last_s = -math.inf
        self._seen: deque[tuple[float, float]] = deque(maxlen=32)
        # The doubt in force, and its brake.
        self._doubt: LimitReason | None = None
        self._brake = NO_BRAKE

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
        brake: Brake = NO_BRAKE,
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
        brake : Brake
            That of the first of a row of doubts counts.
        """
        refused = self._clock_refuses(now_s)
        if refused is None and self.latched is None:
            self.latched = self._vehicle_refuses(now_s, state)
        refused = refused or self.latched
        if refused is None and self._doubts(doubt, brake) is not None:
            return self._effort_in_doubt(now_s), self._doubt
        refused = refused or self._sight_refuses(posture_age_s, posture)
        if refused is None and not effort.is_finite:
            refused = LimitReason.NOT_FINITE
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

    def _doubts(self, doubt: LimitReason | None, brake: Brake) -> LimitReason | None:
        """Return the doubt in force; one that gives the vehicle back stays while it brakes."""
        stays = self._doubt is not None and self._doubt.takes_over
        if doubt is not self._doubt and not stays:
            self._doubt, self._brake = doubt, brake
        return self._doubt

    def _effort_in_doubt(self, now_s: float) -> Effort:
        """Return the brake while it lasts, then neutral."""
        tick_s = 1e-3
        if self._brake.effort > 0.0 and now_s < self._brake.until_s - tick_s:
            return Effort(forward=-min(self._brake.effort, 1.0))
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

    def _guarded(
        self, effort: Effort, near: float, closing: float
    ) -> tuple[Effort, LimitReason | None]:
        """Return the effort without the part that brings the target too close."""
        limits = self.limits
        left = near - limits.least_range
        if left < 0.0:
            gentle, firm = limits.retreat_effort, limits.brake_effort
            back = gentle + max(firm - gentle, 0.0) * min(-left / _FIRM_WITHIN_M, 1.0)
            return _backing(effort, back), LimitReason.TOO_CLOSE
        allowed = min(limits.approach_speed, left / limits.stopping_time)
        if closing > allowed:
            share = min((closing - allowed) / (_FIRM_ABOVE * allowed + 1e-6), 1.0)
            return _backing(effort, share * limits.brake_effort), LimitReason.TOO_FAST
        return _clipped(effort), None


# The dome's centre is some 30 mm behind the hull's front, and pictures end at 0.3 m: the retreat
# reaches its full effort before that.
_FIRM_WITHIN_M = 0.05
_FIRM_ABOVE = 2.0 / 3.0
# Postures this far apart give the closing speed to some cm/s in spite of their noise.
_SPEED_WINDOW_S = 0.4
_MIN_WINDOW_S = 0.15


def _backing(effort: Effort, least: float) -> Effort:
    """Return a push back, the controller's where it is stronger; turning stays allowed."""
    back = min(effort.forward, -least)
    return _clipped(replace(effort, forward=back, right=0.0, down=0.0))


def _clipped(effort: Effort) -> Effort:
    return Effort(
        forward=clipped(effort.forward),
        right=clipped(effort.right),
        down=clipped(effort.down),
        yaw=clipped(effort.yaw),
    )
