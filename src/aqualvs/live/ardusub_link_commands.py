"""What ArduSub is told: efforts as stick positions, or as speeds over the ground in GUIDED."""

import math
import time
from enum import StrEnum
from typing import Any, Protocol

from aqualvs.control.sticks import MIDDLE, Sticks, StickShaping
from aqualvs.control.vehicle import Effort

_MAX_SEQ = 256


class Command(StrEnum):
    """How ArduSub is steered; the value is what a user writes."""

    STICKS = "sticks"
    """`MANUAL_CONTROL`: what a pilot's joystick would send."""
    GUIDED = "guided"
    """`SET_POSITION_TARGET_LOCAL_NED`: speeds in the body's axes, by the vehicle's own position
    estimate."""


class Packable(Protocol):
    """A message as `MavlinkLink.send` takes it."""

    def pack(self, packer: Any, /) -> bytes:
        """Return the frame."""


class Commander(Protocol):
    """Puts efforts into messages."""

    def message(self, effort: Effort) -> Packable:
        """Return what to send for an effort of finite parts."""


def is_finite(effort: Effort) -> bool:
    """Return whether every part of an effort is a number."""
    return all(map(math.isfinite, (effort.forward, effort.right, effort.down, effort.yaw)))


class StickCommander:
    """Efforts as `MANUAL_CONTROL`, in the name of the ground station that ArduSub obeys.

    Parameters
    ----------
    dialect : module
        pymavlink's messages.
    packer : object
        Of the sender, see `MavlinkLink.make_packer`; its system id must be the vehicle's
        MAV_GCS_SYSID (SYSID_MYGCS), its component must not be the ground station's own, or a router
        would take the two for one.
    target : int
        System id of the vehicle.

    Attributes
    ----------
    shaping : StickShaping
        What the vehicle makes of sticks; ArduSub's default until it has told.
    keeps_place : bool
        Whether its mode is POSHOLD.
    """

    def __init__(self, dialect: Any, packer: Any, *, target: int) -> None:
        self.shaping, self.keeps_place = StickShaping(), False
        self._message = dialect.MAVLink_manual_control_message(target, 0, 0, MIDDLE, 0, 0)
        self._packer = packer

    def sticks(self, effort: Effort) -> Sticks:
        """Return the stick positions for an effort of finite parts."""
        return self.shaping.sticks(effort, keeps_place=self.keeps_place)

    def message(self, effort: Effort) -> Packable:
        """Return the message; no button is ever pressed."""
        sticks, told = self.sticks(effort), self._message
        told.x, told.y, told.z, told.r = sticks.x, sticks.y, sticks.z, sticks.r
        return _OnBehalf(told, self._packer)


class GuidedCommander:
    """Efforts as speeds in the body's axes, for a vehicle that knows where it is.

    Parameters
    ----------
    dialect : module
        pymavlink's messages.
    target : int
        System id of the vehicle.
    speed : float
        What an effort of 1 forward, right or down asks for, in m/s.
    turning_rate : float
        What an effort of 1 in yaw asks for, in rad/s.
    """

    def __init__(self, dialect: Any, *, target: int, speed: float, turning_rate: float) -> None:
        self._speed, self._turning_rate = speed, turning_rate
        ignored = (
            "POSITION_TARGET_TYPEMASK_X_IGNORE",
            "POSITION_TARGET_TYPEMASK_Y_IGNORE",
            "POSITION_TARGET_TYPEMASK_Z_IGNORE",
            "POSITION_TARGET_TYPEMASK_AX_IGNORE",
            "POSITION_TARGET_TYPEMASK_AY_IGNORE",
            "POSITION_TARGET_TYPEMASK_AZ_IGNORE",
            "POSITION_TARGET_TYPEMASK_YAW_IGNORE",
        )
        self._message = dialect.MAVLink_set_position_target_local_ned_message(
            0,
            target,
            dialect.MAV_COMP_ID_AUTOPILOT1,
            dialect.MAV_FRAME_BODY_NED,
            sum(getattr(dialect, name) for name in ignored),
            *(0.0,) * 11,
        )

    def message(self, effort: Effort) -> Packable:
        """Return the message."""
        told = self._message
        told.time_boot_ms = (time.monotonic_ns() // 1_000_000) & 0xFFFF_FFFF
        told.vx = self._speed * _limited(effort.forward)
        told.vy = self._speed * _limited(effort.right)
        told.vz = self._speed * _limited(effort.down)
        told.yaw_rate = self._turning_rate * _limited(effort.yaw)
        packable: Packable = told
        return packable


class _OnBehalf:
    """A message that is packed in another sender's name than the link's."""

    def __init__(self, message: Any, packer: Any) -> None:
        self._message, self._packer = message, packer

    def pack(self, _packer: Any, /) -> bytes:
        frame: bytes = self._message.pack(self._packer)
        self._packer.seq = (self._packer.seq + 1) % _MAX_SEQ
        return frame


def _limited(share: float) -> float:
    return min(max(share, -1.0), 1.0)
