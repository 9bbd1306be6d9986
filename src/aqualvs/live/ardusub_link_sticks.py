"""Whether the pilot moves his sticks, as far as an onboard computer can see it.

Two ways, for no one of them works everywhere:

- `MANUAL_CONTROL` of the ground station, where the router passes it on. The message's `target` is
  no target field to MAVLink's routing tables, so mavlink-router and ArduPilot's own routing treat
  it as broadcast.
- `RC_CHANNELS` of the vehicle: what all senders together made of the stick channels. Ours are among
  them, scaled by a pilot gain that is not told; whatever lies outside of what we sent in the last
  second is the pilot's.
"""

import time
from collections import deque
from typing import Any

from aqualvs.control.sticks import FULL, MIDDLE, Sticks
from aqualvs.live.mavlink_link import MavlinkLink, Received

FRESH_S = 1.0
"""An older message says nothing of now; ground stations send sticks 5 to 50 times a second."""

_INVALID = 32767
# ArduSub turns full deflection at a pilot gain of 1 into 400 us about 1500 us (joystick.cpp).
_CENTRE_US, _FULL_US = 1500, 400
_LEAST_US, _MOST_US = 800, 2200
_YAW, _FORWARD, _LATERAL, _VERTICAL = "chan4_raw", "chan5_raw", "chan6_raw", "chan3_raw"
_KEPT = 200


class PilotSticks:
    """Watches the pilot's sticks.

    Parameters
    ----------
    link : MavlinkLink
    own : (int, int)
        System and component in whose name we send sticks ourselves.
    dead_band : float
        Deflection, as a share of the full one, that counts as centred.
    """

    def __init__(self, link: MavlinkLink, *, own: tuple[int, int], dead_band: float) -> None:
        self._link, self._own, self._dead_band = link, own, dead_band
        self._sent: deque[tuple[int, Sticks]] = deque(maxlen=_KEPT)

    def note(self, sticks: Sticks) -> None:
        """Remember what we sent ourselves, now."""
        self._sent.append((time.monotonic_ns(), sticks))

    def moved(self) -> bool:
        """Return whether the pilot's sticks are off their centre."""
        return self._joystick_moved() or self._channels_moved()

    def _joystick_moved(self) -> bool:
        # One who holds his sticks still must not hide another who moves his.
        return any(self._moves(found) for found in self._link.every("MANUAL_CONTROL"))

    def _moves(self, found: Received) -> bool:
        if found.age_s > FRESH_S or (found.system, found.component) == self._own:
            return False
        sticks = found.message
        swings = (sticks.x, sticks.y, sticks.r, _swing_of_z(sticks.z))
        return any(abs(s) > FULL * self._dead_band for s in swings if s != _INVALID)

    def _channels_moved(self) -> bool:
        found = self._link.latest("RC_CHANNELS", system=self._link.system)
        if found is None or found.age_s > FRESH_S:
            return False
        since = found.received_ns - round(1e9 * FRESH_S)
        # The thread that sends may add while this one reads.
        ours = [s for at, s in self._sent.copy() if since <= at <= found.received_ns]
        told = found.message
        if self._beyond(told, _FORWARD, [s.x for s in ours]):
            return True
        if self._beyond(told, _LATERAL, [s.y for s in ours]):
            return True
        if self._beyond(told, _YAW, [s.r for s in ours]):
            return True
        # JS_THR_GAIN scales the vertical by up to 4: where we use that axis, it tells nothing.
        vertical_is_ours = any(s.z != MIDDLE for s in ours)
        return not vertical_is_ours and self._beyond(told, _VERTICAL, [])

    def _beyond(self, told: Any, channel: str, ours: list[int]) -> bool:
        """Return whether a channel lies outside of what our own sticks can have made of it."""
        pulse_us = getattr(told, channel)
        if not _LEAST_US <= pulse_us <= _MOST_US:
            return False
        swing = (pulse_us - _CENTRE_US) / _FULL_US
        least, most = min((0, *ours)) / FULL, max((0, *ours)) / FULL
        return not least - self._dead_band <= swing <= most + self._dead_band


def _swing_of_z(z: int) -> int:
    """Return the vertical stick as the others count, -1000 to 1000."""
    return z if z == _INVALID else 2 * (z - MIDDLE)
