"""Stick positions for efforts, with ArduSub's dead zones compensated.

ArduSub 4.5 and later (joystick.cpp, Attitude.cpp, mode_althold.cpp, mode_poshold.cpp and
RC_Channel.cpp of ArduPilot) turns `MANUAL_CONTROL` into pulses about 1500 us, 0.4 us times the
pilot gain a unit, and these into rates and thrust:

- yaw: nothing within RC4_DZ times the gain of RC4_TRIM, then a turning rate in proportion up to
  RC4_MIN or RC4_MAX;
- down: nothing within THR_DZ times the gain of the middle of RC3, then a rate of climb likewise;
  its pulses are scaled by JS_THR_GAIN, too;
- forward and right: thrust in proportion to the way from RC5_TRIM and RC6_TRIM, without a dead
  zone; in POSHOLD a speed beyond THR_DZ times the gain.

There is no expo on these axes. Before 4.5 dead zones do not shrink with the gain.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from aqualvs.control.vehicle import Effort, clipped

FULL, MIDDLE = 1000, 500
"""Full deflection of x, y and r; z runs from 0 (down) over 500 (neutral) to 1000 (up)."""

_CENTRE_US = 1500.0
# Microseconds of a unit of x, y and r, and of z, at a pilot gain of 1.
_LEVEL_US, _UPRIGHT_US = 0.4, 0.8
# ArduPilot's parameters are whole microseconds within these.
_MIN_US, _MAX_US = 800.0, 2200.0
_CHANNELS = {"throttle": 3, "yaw": 4, "forward": 5, "right": 6}


@dataclass(frozen=True, slots=True)
class Sticks:
    """The axes of `MANUAL_CONTROL` as ArduSub takes them."""

    x: int = 0  # Forward, -1000 to 1000.
    y: int = 0  # Right, as far.
    z: int = MIDDLE  # Up, 0 to 1000; 500 is neutral, contrary to the MAVLink specification.
    r: int = 0  # Clockwise, as far as `x`.


@dataclass(frozen=True, slots=True, kw_only=True)
class StickChannel:
    """Parameters RCn_MIN, RCn_TRIM, RCn_MAX, RCn_DZ (in microseconds) and RCn_REVERSED."""

    least: float = 1100.0
    trim: float = 1500.0
    most: float = 1900.0
    dead_zone: float = 0.0
    reverse: bool = False

    @property
    def is_sound(self) -> bool:
        """Whether ArduSub can use it."""
        inside = _MIN_US <= self.least < self.trim < self.most <= _MAX_US
        return inside and 0.0 <= self.dead_zone < 0.5 * (self.most - self.least)


@dataclass(frozen=True, slots=True, kw_only=True)
class StickShaping:
    """ArduSub's conversion of sticks; the defaults are its own."""

    # Pilot gain (JS_GAIN_DEFAULT). Where trims are 1500 us it does not matter but for the rate of
    # climb.
    gain: float = 0.5
    throttle_gain: float = 1.0  # JS_THR_GAIN.
    throttle_dead_zone: float = 100.0  # THR_DZ, in thousandths of the throttle's travel.
    # RC3 to RC6.
    throttle: StickChannel = field(default_factory=lambda: StickChannel(dead_zone=30.0))
    yaw: StickChannel = field(default_factory=lambda: StickChannel(dead_zone=40.0))
    forward: StickChannel = field(default_factory=StickChannel)
    right: StickChannel = field(default_factory=StickChannel)

    def sticks(self, effort: Effort, *, keeps_place: bool = False) -> Sticks:
        """Return the stick positions that make ArduSub carry out an effort.

        An effort of 1 is a full stick, one of 0 the middle of the dead zone, and what is between
        is in proportion to what the vehicle does. Pulses are whole microseconds.

        `effort`: of finite parts; limited to full deflection. `keeps_place`: whether the mode is
        POSHOLD, whose level sticks have a dead zone.
        """
        level = self.throttle_dead_zone * self.gain * 2.0 if keeps_place else 0.0
        return Sticks(
            x=self._axis(effort.forward, self.forward, _share_us(self.forward, level)),
            y=self._axis(effort.right, self.right, _share_us(self.right, level)),
            z=self._upright(-effort.down),
            r=self._axis(effort.yaw, self.yaw, math.floor(self.yaw.dead_zone * self.gain)),
        )

    def position(self, effort: Effort) -> Effort:
        """Return the stick positions for an effort as shares of their full deflection."""
        sticks = self.sticks(effort)
        return Effort(
            forward=sticks.x / FULL,
            right=sticks.y / FULL,
            down=(MIDDLE - sticks.z) / MIDDLE,
            yaw=sticks.r / FULL,
        )

    @property
    def turning_share(self) -> float:
        """Share of the greatest turning rate that a full stick to the right asks for."""
        dead = math.floor(self.yaw.dead_zone * self.gain)
        full = min(_CENTRE_US + FULL * _LEVEL_US * self.gain, self.yaw.most)
        return max(full - self.yaw.trim - dead, 0.0) / (self.yaw.most - self.yaw.trim - dead)

    @property
    def climbing_share(self) -> float:
        """Share of the greatest rate of climb or descent that full sticks ask for, either way."""
        channel, middle = self.throttle, self._middle()
        low = channel.least + channel.dead_zone
        swing_us = 0.5 * FULL * _UPRIGHT_US * self.gain * self.throttle_gain
        per_us, dead = 1000.0 / (channel.most - low), self.throttle_dead_zone * self.gain
        top = min(_CENTRE_US + swing_us, channel.most)
        bottom = max(_CENTRE_US - swing_us, low)
        up = ((top - low) * per_us - middle - dead) / (1000.0 - middle - dead)
        down = (middle - dead - (bottom - low) * per_us) / (middle - dead)
        return min(max(up, 0.0), min(max(down, 0.0), 1.0))

    def _axis(self, share: float, channel: StickChannel, dead_us: float) -> int:
        """Return the position of x, y or r."""
        unit_us = _LEVEL_US * self.gain
        share = clipped(-share if channel.reverse else share)
        if share == 0.0:
            pulse_us = channel.trim
        elif share > 0.0:
            full = min(_CENTRE_US + FULL * unit_us, channel.most)
            pulse_us = channel.trim + dead_us + share * max(full - channel.trim - dead_us, 0.0)
        else:
            full = max(_CENTRE_US - FULL * unit_us, channel.least)
            pulse_us = channel.trim - dead_us + share * max(channel.trim - dead_us - full, 0.0)
        return min(max(_units(pulse_us, unit_us), -FULL), FULL)

    def _upright(self, up: float) -> int:
        """Return the position of z."""
        unit_us = _UPRIGHT_US * self.gain * self.throttle_gain
        up, channel = clipped(up), self.throttle
        if up == 0.0:
            return MIDDLE
        middle, dead = self._middle(), self.throttle_dead_zone * self.gain
        reach = self.climbing_share * abs(up)
        if up > 0.0:
            control = middle + dead + reach * (1000.0 - middle - dead)
        else:
            control = (middle - dead) * (1.0 - reach)
        low = channel.least + channel.dead_zone
        pulse_us = low + control * (channel.most - low) / 1000.0
        if channel.reverse:
            pulse_us = channel.least + channel.most - pulse_us
        return min(max(MIDDLE + _units(pulse_us, unit_us), 0), FULL)

    def _middle(self) -> float:
        """Return the throttle in its middle, in thousandths (`get_control_mid`)."""
        channel = self.throttle
        low = channel.least + channel.dead_zone
        return 1000.0 * (0.5 * (channel.least + channel.most) - low) / (channel.most - low)


PARAMETERS: tuple[str, ...] = (
    "JS_GAIN_DEFAULT",
    "JS_THR_GAIN",
    "THR_DZ",
    *(
        f"RC{n}_{part}"
        for n in _CHANNELS.values()
        for part in ("MIN", "TRIM", "MAX", "DZ", "REVERSED")
    ),
)
"""ArduSub's parameters that `shaping_of` takes."""


def shaping_of(parameters: Mapping[str, float]) -> StickShaping:
    """Return the shaping of a vehicle by its reported parameters.

    `parameters`: by name, any of `PARAMETERS`. What is missing, or cannot be, has ArduSub's
    default.
    """
    own = StickShaping()
    found = {}
    for name, n in _CHANNELS.items():
        default: StickChannel = getattr(own, name)
        channel = StickChannel(
            least=parameters.get(f"RC{n}_MIN", default.least),
            trim=parameters.get(f"RC{n}_TRIM", default.trim),
            most=parameters.get(f"RC{n}_MAX", default.most),
            dead_zone=parameters.get(f"RC{n}_DZ", default.dead_zone),
            reverse=parameters.get(f"RC{n}_REVERSED", 0.0) == 1.0,
        )
        if name == "throttle":
            # A range channel: its middle is that of its limits, and its trim is not used.
            channel = replace(channel, trim=0.5 * (channel.least + channel.most))
        found[name] = channel if channel.is_sound else default
    shaping = StickShaping(
        gain=_within(parameters.get("JS_GAIN_DEFAULT"), 0.1, 1.0, own.gain),
        throttle_gain=_within(parameters.get("JS_THR_GAIN"), 0.5, 4.0, own.throttle_gain),
        throttle_dead_zone=_within(parameters.get("THR_DZ"), 0.0, 400.0, own.throttle_dead_zone),
        **found,
    )
    # Trims beyond the reach of the sticks cannot be compensated.
    return shaping if shaping.turning_share > 0.0 and shaping.climbing_share > 0.0 else own


def _share_us(channel: StickChannel, thousandths: float) -> float:
    """Return a dead zone of POSHOLD in microseconds (`get_pilot_desired_horizontal_rate`)."""
    share = thousandths / (channel.most - channel.least)
    return share * (channel.most - channel.trim)


def _units(pulse_us: float, unit_us: float) -> int:
    """Return the units whose pulse ArduSub cuts to whole microseconds, the nearest to a pulse."""
    whole = round(pulse_us)
    if whole == _CENTRE_US:
        return 0
    return round((whole + 0.5 - _CENTRE_US) / unit_us)


def _within(value: float | None, least: float, most: float, default: float) -> float:
    return default if value is None or not least <= value <= most else value
