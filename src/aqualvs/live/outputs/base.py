"""Interface of all outputs of a live run."""

from typing import Protocol, runtime_checkable

from aqualvs.control.vehicle import VehicleState
from aqualvs.recording.sample import LiveSample
from aqualvs.scanning.scan import GyroRates
from aqualvs.sources.base import PartHealth


class Output(Protocol):
    """Interface of an output: a small class for each kind of receiver.

    Made by its constructor without waiting for a peer; a peer that is absent, leaves or returns is
    reported by `health` and raises no exception.
    """

    name: str  # In health reports and messages.
    # Whether `send` never waits (a datagram), so that it may run between two frames; others get a
    # thread of their own.
    inline: bool = False
    # Whether samples may wait in a queue for their turn (a recorder); for others a newer sample
    # replaces one that is still waiting.
    keeps_all: bool = False

    def send(self, sample: LiveSample) -> None:
        """Send one sample.

        Raises `OSError` or `RuntimeError` if it could not be sent; the next one is tried all the
        same.
        """

    def health(self) -> PartHealth:
        """Return how the link is; called from another thread."""

    def close(self) -> None:
        """Say good-bye and free everything; further calls do nothing."""


@runtime_checkable
class HearsVehicle(Protocol):
    """Interface of an output that an autopilot answers."""

    def vehicle_state(self) -> VehicleState:
        """Return what the autopilot tells; returns at once."""

    def turning(self, at_ns: int) -> GyroRates | None:
        """Return what its gyros tell of a time by `time.monotonic_ns`; returns at once."""
