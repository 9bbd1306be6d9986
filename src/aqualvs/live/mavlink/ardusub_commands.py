"""Commands to ArduSub: efforts as stick positions, or as speeds over the ground in GUIDED.

`StickResponse` checks whether the vehicle follows our sticks. ArduSub silently ignores sticks of
senders other than its ground station, and does not acknowledge those that it accepts. Their effect
shows in `RC_CHANNELS`: 400 us times the pilot gain for a full stick (joystick.cpp). Where no
channels are reported, a yaw stick must turn the vehicle.
"""

import math
import time
from collections import deque
from enum import StrEnum
from typing import Any

from aqualvs.control.sticks import FULL, MIDDLE, Sticks, StickShaping
from aqualvs.control.vehicle import Effort, clipped
from aqualvs.live.mavlink.link import MavlinkLink

# Length of the window of sticks and responses, and their least number: six messages of three
# channels, or as many of the attitude.
_WINDOW_S, _MIN_PAIRS = 6.0, 18
# Smaller sticks may lie within the dead zone of the channel. A vehicle that turns by less for a
# full stick does not respond to it.
_TURNING_STICK, _MIN_TURN = 0.5, math.radians(2.0)
_LONGEST_STICK_S = 0.3
CENTRE_US, MIN_US, MAX_US = 1500, 800, 2200
"""Pulses of a centred channel, and the least and greatest of one that is in use."""
STICK_CHANNELS = (("chan5_raw", "x"), ("chan6_raw", "y"), ("chan4_raw", "r"))
"""Fields of `RC_CHANNELS` and the axes of `Sticks` that move them; the vertical is apart."""


class StickResponse:
    """Comparison of our sticks with the channels and the turning that follow."""

    def __init__(self, link: MavlinkLink) -> None:
        self._link = link
        self._stick: tuple[float, Sticks] | None = None
        self._began_s = math.inf
        self._seen_ns = {"RC_CHANNELS": 0, "ATTITUDE": 0}
        self._channels = {channel: _Pairs() for channel, _ in STICK_CHANNELS}
        self._turns = _Pairs()

    def note(self, sticks: Sticks) -> None:
        """Remember the sticks that we send now."""
        now_s = time.monotonic()
        if self._stick is None or now_s - self._stick[0] > _LONGEST_STICK_S:
            self._began_s = now_s
        self._stick = now_s, sticks

    def doubt(self) -> str:
        """Return why the vehicle seems not to obey; empty if it does or nothing is known."""
        # Sticks may alternate faster than channels are reported; the channels then move all the
        # same.
        still_us = 3.0
        # The least pilot gain is 0.1, 40 us for a full stick; half of the messages may hold the
        # pilot's own sticks, so that a quarter of that still counts as a response.
        min_slope_us = 10.0
        now_s, stick = time.monotonic(), self._stick
        if stick is None or now_s - stick[0] > _LONGEST_STICK_S:
            for pairs in (*self._channels.values(), self._turns):
                pairs.clear()
            return ""
        self._add_pairs(now_s, stick[1])
        channels = [pair for pairs in self._channels.values() for pair in pairs.since(now_s)]
        still = all(pairs.swing <= still_us for pairs in self._channels.values())
        if still and _slope(channels) < min_slope_us:
            return "RC_CHANNELS does not follow our sticks: the vehicle does not obey them"
        if channels or now_s - self._began_s < 0.5 * _WINDOW_S:
            return ""
        if _slope(self._turns.since(now_s)) < _MIN_TURN:
            return "the vehicle does not turn as our yaw stick says"
        return "RC_CHANNELS is not received: cannot check whether our sticks are obeyed"

    def _add_pairs(self, now_s: float, sticks: Sticks) -> None:
        """Pair the messages since the last call with our stick."""
        message = self._new_message("RC_CHANNELS")
        if message is not None:
            for channel, axis in STICK_CHANNELS:
                share, pulse_us = getattr(sticks, axis) / FULL, getattr(message, channel)
                # 0 and 65535 mean an unused channel.
                off_us = pulse_us - CENTRE_US if MIN_US < pulse_us < MAX_US else 0
                self._channels[channel].append((now_s, share, float(off_us)))
        message = self._new_message("ATTITUDE")
        turn = sticks.r / FULL
        if message is not None and abs(turn) >= _TURNING_STICK:
            self._turns.append((now_s, turn, float(message.yawspeed)))

    def _new_message(self, kind: str) -> Any:
        found = self._link.latest(kind, system=self._link.system)
        if found is None or found.received_ns <= self._seen_ns[kind]:
            return None
        self._seen_ns[kind] = found.received_ns
        return found.message


class _Pairs(deque[tuple[float, float, float]]):
    """Times, stick positions and the vehicle's responses to them, over the last seconds."""

    def since(self, now_s: float) -> list[tuple[float, float]]:
        """Return the pairs of the window that ends now; older ones are forgotten."""
        while self and now_s - self[0][0] > _WINDOW_S:
            self.popleft()
        return [(share, answer) for _, share, answer in self]

    @property
    def swing(self) -> float:
        """Greatest answer less the least."""
        answers = [answer for _, _, answer in self]
        return max(answers, default=0.0) - min(answers, default=0.0)


def _slope(pairs: list[tuple[float, float]]) -> float:
    """Return the answer to a full stick by least squares; infinite where too little is known."""
    # Least sum of the squares of all sticks: six at a tenth are enough for channels.
    least_squares = 6 * 0.1**2
    squares = sum(share * share for share, _ in pairs)
    if len(pairs) < _MIN_PAIRS or squares < least_squares:
        return math.inf
    return sum(share * answer for share, answer in pairs) / squares


class Command(StrEnum):
    """Kind of command that steers ArduSub; the value is the user's word for it."""

    STICKS = "sticks"
    """`MANUAL_CONTROL`: what a pilot's joystick would send."""
    GUIDED = "guided"
    """`SET_POSITION_TARGET_LOCAL_NED`: speeds in the body's axes, by the vehicle's own position
    estimate."""


class StickCommander:
    """Converter to `MANUAL_CONTROL`, in the name of the ground station that ArduSub obeys.

    `sender`: system and component. The system must be the vehicle's MAV_GCS_SYSID (SYSID_MYGCS),
    the component not the ground station's own, or a router would take the two for one.
    """

    def __init__(self, link: MavlinkLink, sender: tuple[int, int]) -> None:
        # How the vehicle converts sticks; ArduSub's default until it has reported its own.
        self.shaping = StickShaping()
        self.keeps_place = False  # Whether its mode is POSHOLD.
        self.packer = link.make_packer(*sender)
        kind = link.dialect.MAVLink_manual_control_message
        self._message = kind(link.system, 0, 0, MIDDLE, 0, 0)

    def sticks(self, effort: Effort) -> Sticks:
        """Return the stick positions for an effort of finite parts."""
        return self.shaping.sticks(effort, keeps_place=self.keeps_place)

    def message(self, effort: Effort) -> Any:
        """Return the message for an effort of finite parts; no button is ever pressed."""
        sticks, message = self.sticks(effort), self._message
        message.x, message.y, message.z, message.r = sticks.x, sticks.y, sticks.z, sticks.r
        return message


class GuidedCommander:
    """Converter to speeds in the body's axes, for a vehicle that knows its position.

    `speed`, `turning_rate`: what an effort of 1 asks for, in m/s and rad/s.
    """

    packer = None  # The link's own: ArduSub obeys any sender.

    def __init__(self, link: MavlinkLink, *, speed: float, turning_rate: float) -> None:
        self._speed, self._turning_rate = speed, turning_rate
        dialect = link.dialect
        ignored = (
            getattr(dialect, f"POSITION_TARGET_TYPEMASK_{axis}_IGNORE")
            for axis in ("X", "Y", "Z", "AX", "AY", "AZ", "YAW")
        )
        self._message = dialect.MAVLink_set_position_target_local_ned_message(
            0,
            link.system,
            dialect.MAV_COMP_ID_AUTOPILOT1,
            dialect.MAV_FRAME_BODY_NED,
            sum(ignored),
            *(0.0,) * 11,
        )

    def message(self, effort: Effort) -> Any:
        """Return the message for an effort of finite parts."""
        message = self._message
        message.time_boot_ms = (time.monotonic_ns() // 1_000_000) & 0xFFFF_FFFF
        message.vx = self._speed * clipped(effort.forward)
        message.vy = self._speed * clipped(effort.right)
        message.vz = self._speed * clipped(effort.down)
        message.yaw_rate = self._turning_rate * clipped(effort.yaw)
        return message
