"""Interface of a vehicle for the controllers: state, efforts, and the setpoint to hold.

A vehicle is a simulated one, or ArduSub by MAVLink. Body axes are forward, right, down (FRD), at
the vehicle's centre; yaw is clockwise from above. `SetpointHolder` shares the range and yaw to hold
between pilot and controller.
"""

import math
import threading
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

from aqualvs.errors import OptionError


@dataclass(frozen=True, slots=True)
class Setpoint:
    """Wanted posture to the target."""

    range: float  # Metres.
    yaw: float = 0.0  # Radians, as `Posture.yaw`; 0 is square to the target.


class SetpointHolder:
    """One setpoint for all threads; None until somebody sets it.

    `working_range`: a range outside of it, in metres, cannot be measured, so it cannot be held.
    `followed`: whether a controller follows it; else it is only what a pilot steers by.
    """

    MAX_YAW = math.radians(45.0)
    """Beyond this the lasers leave the target, in radians."""

    def __init__(self, working_range: tuple[float, float], *, followed: bool = True) -> None:
        self.working_range, self.followed = working_range, followed
        self._lock = threading.Lock()
        self._setpoint: Setpoint | None = None

    @property
    def setpoint(self) -> Setpoint | None:
        """The setpoint in force."""
        with self._lock:
            return self._setpoint

    def put(self, setpoint: Setpoint | None) -> None:
        """Set, or take back.

        Raises `OptionError` if it cannot be held; the one in force stays.
        """
        near, far = self.working_range
        if setpoint is not None and not near <= setpoint.range <= far:
            raise OptionError(
                f"setpoint: range {setpoint.range:g} m is outside the working range; "
                f"choose {near:.2f} to {far:.2f} m"
            )
        if setpoint is not None and not abs(setpoint.yaw) <= self.MAX_YAW:
            raise OptionError(
                f"setpoint: yaw {math.degrees(setpoint.yaw):g} deg; choose at most "
                f"{math.degrees(self.MAX_YAW):.0f} deg to either side"
            )
        with self._lock:
            self._setpoint = setpoint


def clipped(value: float, most: float = 1.0) -> float:
    """Return a value within `most` of 0."""
    return min(max(value, -most), most)


@dataclass(frozen=True, slots=True, kw_only=True)
class Effort:
    """Effort as by a pilot's sticks, -1 to 1, as ArduSub's depth hold takes it."""

    # Share of the greatest thrust along the body axes.
    forward: float = 0.0
    right: float = 0.0
    # Share of the greatest rate of descent; in depth hold the vehicle keeps its depth at 0.
    down: float = 0.0
    # Share of the greatest turning rate, clockwise from above positive; the vehicle keeps its
    # heading at 0.
    yaw: float = 0.0

    @property
    def is_finite(self) -> bool:
        """Whether every part is a number."""
        return all(map(math.isfinite, (self.forward, self.right, self.down, self.yaw)))


NEUTRAL = Effort()
"""No thrust in any direction."""


class Mode(StrEnum):
    """Flight mode that the pilot has chosen on the vehicle: who steers."""

    OURS = "ours"
    """A mode in which the vehicle takes our efforts (depth hold: it keeps its own depth)."""
    PILOT = "pilot"
    """Any other: manual, stabilise, surface."""
    NO_STATION = "no_station"
    """Ours, but the ground station that must be there is not heard."""
    IGNORED = "ignored"
    """Ours, but the vehicle takes efforts in another ground station's name only."""
    CONFLICT = "conflict"
    """Messages in the vehicle's name contradict each other."""
    UNKNOWN = "unknown"
    """Nothing heard yet, or nothing that could be steered."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleState:
    """State as the vehicle reports it; None where it does not, or not recently."""

    # When its last heartbeat came, on the clock of `time.monotonic`; -inf if never.
    heard_s: float = float("-inf")

    armed: bool = False
    mode: Mode = Mode.UNKNOWN
    mode_name: str = ""  # As the vehicle calls it.
    pilot_moves: bool = False  # Whether the pilot's sticks are off their centre.
    depth: float | None = None  # Metres, down positive.
    # Radians; heading clockwise from north.
    heading: float | None = None
    roll: float | None = None
    pitch: float | None = None
    doubt: str = ""  # Why it seems not to obey; empty if it does, or nothing is known.
    # Other sender that speaks as the vehicle, and agrees with it; empty if there is none.
    rival: str = ""


class VehicleLink(Protocol):
    """Interface to command a vehicle and read its state; never arms it or changes its mode."""

    name: str  # In messages.

    def state(self) -> VehicleState:
        """Return the latest state; returns at once."""

    def send(self, effort: Effort) -> None:
        """Ask for an effort; returns at once.

        The vehicle must forget it by itself if no other comes (ArduSub: after its pilot-input
        fail-safe time).

        Raises `OSError` if it could not be sent.
        """

    def close(self) -> None:
        """Send neutral and free everything; further calls do nothing."""
