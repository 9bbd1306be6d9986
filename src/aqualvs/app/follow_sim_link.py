"""The simulated vehicle behind the link that control knows."""

import math

from aqualvs.control.tune_model import shaping_of_model
from aqualvs.control.vehicle import NEUTRAL, Effort, Mode, VehicleState
from aqualvs.simulation.vehicle import SimulatedVehicle

# A vehicle tells its attitude ten times a second.
_TELLS_HZ = 10.0


class SimulatedLink:
    """Commands a simulated vehicle and hears from it, in its own time.

    Parameters
    ----------
    vehicle : SimulatedVehicle
        Its latency is that of the wire.

    Attributes
    ----------
    vehicle : SimulatedVehicle
    effort : Effort
        The last that was sent.
    """

    def __init__(self, vehicle: SimulatedVehicle) -> None:
        self.vehicle = vehicle
        self.effort = NEUTRAL
        self._shaping = shaping_of_model(vehicle.model)
        self._unsent: Effort | None = None
        self._closed = False

    @property
    def name(self) -> str:
        """How messages call it."""
        return f"simulated {self.vehicle.model.name}"

    def state(self) -> VehicleState:
        """Return what the vehicle tells of itself, by the vehicle's clock."""
        told = self.vehicle.telemetry()
        return VehicleState(
            heard_s=math.floor(told.time_s * _TELLS_HZ) / _TELLS_HZ,
            armed=told.armed,
            mode=Mode.OURS if told.obeys else Mode.PILOT,
            mode_name="ALT_HOLD" if told.obeys else "MANUAL",
            depth=told.depth,
            heading=told.heading,
            roll=told.roll,
            pitch=told.pitch,
        )

    def send(self, effort: Effort) -> None:
        """Ask for an effort."""
        if not self._closed:
            self.effort = effort
            self._unsent = self._shaping.position(effort)

    def pass_time(self, until_s: float) -> None:
        """Let the vehicle move until a time; nothing if that is not ahead."""
        step = until_s - self.vehicle.time_s
        if step > 1e-9:
            self.vehicle.step(self._unsent, step)
            self._unsent = None

    def close(self) -> None:
        """Send neutral; further calls do nothing."""
        self.send(NEUTRAL)
        self._closed = True
