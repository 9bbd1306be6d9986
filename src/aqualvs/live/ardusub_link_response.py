"""Whether the vehicle does what our sticks say, as far as it tells.

ArduSub drops sticks of others than its ground station without a word, and answers nothing to those
that it takes. What it makes of them shows in `RC_CHANNELS`: 400 us times the pilot gain for a full
stick (joystick.cpp). Where no channels are told, a yaw stick must turn it.
"""

import math
import time
from collections import deque
from typing import Any

from aqualvs.control.sticks import FULL, Sticks
from aqualvs.live.mavlink_link import MavlinkLink

# Sticks and answers are looked at for so long, and are so many at least: six messages of three
# channels, or as many of the attitude.
_WINDOW_S, _LEAST_PAIRS = 6.0, 18
# Of the squares of all sticks together: six at a tenth say enough of channels.
_LEAST_SQUARES = 6 * 0.1**2
# The least pilot gain is 0.1, 40 us for a full stick; half of the messages may hold the pilot's
# own sticks, so that a quarter of that is an answer still.
_LEAST_SLOPE_US = 10.0
# Sticks to and fro may be faster than channels are told; the channels then move all the same.
_STILL_US = 3.0
# Below that a stick may lie within the dead zone of the channel. A vehicle that turns by less for
# a full stick does not turn by it.
_TURNING_STICK, _LEAST_TURN = 0.5, math.radians(2.0)
_LONGEST_STICK_S = 0.3
_CENTRE_US, _LEAST_US, _MOST_US = 1500, 800, 2200
_AXES = (("chan5_raw", "x"), ("chan6_raw", "y"), ("chan4_raw", "r"))


class StickResponse:
    """Compares our sticks with the channels and the turning that follow.

    Parameters
    ----------
    link : MavlinkLink
    """

    def __init__(self, link: MavlinkLink) -> None:
        self._link = link
        self._stick: tuple[float, Sticks] | None = None
        self._began_s = math.inf
        self._seen_ns = {"RC_CHANNELS": 0, "ATTITUDE": 0}
        self._channels = {channel: _Pairs() for channel, _ in _AXES}
        self._turns = _Pairs()

    def note(self, sticks: Sticks) -> None:
        """Remember what we send now."""
        now_s = time.monotonic()
        if self._stick is None or now_s - self._stick[0] > _LONGEST_STICK_S:
            self._began_s = now_s
        self._stick = now_s, sticks

    def doubt(self) -> str:
        """Return why the vehicle seems not to obey, empty if it does or nothing is known."""
        now_s, stick = time.monotonic(), self._stick
        if stick is None or now_s - stick[0] > _LONGEST_STICK_S:
            for pairs in (*self._channels.values(), self._turns):
                pairs.clear()
            return ""
        self._take(now_s, stick[1])
        channels = [pair for pairs in self._channels.values() for pair in pairs.since(now_s)]
        still = all(pairs.swing <= _STILL_US for pairs in self._channels.values())
        if still and _slope(channels) < _LEAST_SLOPE_US:
            return "RC_CHANNELS does not follow our sticks: the vehicle does not obey them"
        if channels or now_s - self._began_s < 0.5 * _WINDOW_S:
            return ""
        if _slope(self._turns.since(now_s)) < _LEAST_TURN:
            return "the vehicle does not turn as our yaw stick says"
        return "RC_CHANNELS is not told: whether our sticks are obeyed is not seen"

    def _take(self, now_s: float, sticks: Sticks) -> None:
        """Pair what has come since the last look with our stick."""
        told = self._new("RC_CHANNELS")
        if told is not None:
            for channel, axis in _AXES:
                share, pulse_us = getattr(sticks, axis) / FULL, getattr(told, channel)
                # 0 and 65535 stand for a channel that nobody moves.
                off_us = pulse_us - _CENTRE_US if _LEAST_US < pulse_us < _MOST_US else 0
                self._channels[channel].add(now_s, share, float(off_us))
        told = self._new("ATTITUDE")
        turn = sticks.r / FULL
        if told is not None and abs(turn) >= _TURNING_STICK:
            self._turns.add(now_s, turn, float(told.yawspeed))

    def _new(self, kind: str) -> Any:
        found = self._link.latest(kind, system=self._link.system)
        if found is None or found.received_ns <= self._seen_ns[kind]:
            return None
        self._seen_ns[kind] = found.received_ns
        return found.message


class _Pairs:
    """What a stick said and what the vehicle answered, over the last seconds."""

    def __init__(self) -> None:
        self._pairs: deque[tuple[float, float, float]] = deque()

    def add(self, now_s: float, share: float, answer: float) -> None:
        """Add a pair."""
        self._pairs.append((now_s, share, answer))

    def clear(self) -> None:
        """Forget all."""
        self._pairs.clear()

    def since(self, now_s: float) -> list[tuple[float, float]]:
        """Return the pairs of the window that ends now; older ones are forgotten."""
        while self._pairs and now_s - self._pairs[0][0] > _WINDOW_S:
            self._pairs.popleft()
        return [(share, answer) for _, share, answer in self._pairs]

    @property
    def swing(self) -> float:
        """Greatest answer less the least."""
        answers = [answer for _, _, answer in self._pairs]
        return max(answers, default=0.0) - min(answers, default=0.0)


def _slope(pairs: list[tuple[float, float]]) -> float:
    """Return the answer to a full stick by least squares; infinite where too little is known."""
    squares = sum(share * share for share, _ in pairs)
    if len(pairs) < _LEAST_PAIRS or squares < _LEAST_SQUARES:
        return math.inf
    return sum(share * answer for share, answer in pairs) / squares
