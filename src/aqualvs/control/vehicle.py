"""What the controllers know of a vehicle, whoever it is: a simulated one, or ArduSub by MAVLink.

Body axes are forward, right, down (FRD), at the vehicle's centre; yaw is clockwise from above.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol


@dataclass(frozen=True, slots=True, kw_only=True)
class Effort:
    """What a pilot's sticks would ask for, -1 to 1: what ArduSub's depth hold takes.

    Attributes
    ----------
    forward, right : float
        Share of the greatest thrust along the body axes.
    down : float
        Share of the greatest rate of descent; in depth hold the vehicle keeps its depth at 0.
    yaw : float
        Share of the greatest turning rate, clockwise from above positive; the vehicle keeps its
        heading at 0.
    """

    forward: float = 0.0
    right: float = 0.0
    down: float = 0.0
    yaw: float = 0.0


NEUTRAL = Effort()
"""No thrust in any direction."""


class Mode(StrEnum):
    """Who steers; what the pilot has chosen on the vehicle."""

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
    """What a vehicle tells of itself; None where it does not, or has not of late.

    Attributes
    ----------
    heard_s : float
        When its last heartbeat came, on the clock of `time.monotonic`; -inf if never.
    armed : bool
    mode : Mode
    mode_name : str
        As the vehicle calls it.
    pilot_moves : bool
        Whether the pilot's sticks are off their centre.
    depth : float or None
        Metres, down positive.
    heading, roll, pitch : float or None
        Radians; heading clockwise from north.
    doubt : str
        Why it seems not to do what it is told; empty if it does, or nothing is known.
    rival : str
        Who else speaks as the vehicle, and agrees with it; empty if nobody does.
    """

    heard_s: float = float("-inf")
    armed: bool = False
    mode: Mode = Mode.UNKNOWN
    mode_name: str = ""
    pilot_moves: bool = False
    depth: float | None = None
    heading: float | None = None
    roll: float | None = None
    pitch: float | None = None
    doubt: str = ""
    rival: str = ""


class VehicleLink(Protocol):
    """Commands a vehicle and hears from it; never arms it, never changes its mode."""

    @property
    def name(self) -> str:
        """How messages call it."""

    def state(self) -> VehicleState:
        """Return the latest state; returns at once."""

    def send(self, effort: Effort) -> None:
        """Ask for an effort; returns at once.

        The vehicle must forget it by itself if no other comes (ArduSub: after its pilot-input
        fail-safe time).

        Raises
        ------
        OSError
            If it could not be sent.
        """

    def close(self) -> None:
        """Send neutral and free everything; further calls do nothing."""
