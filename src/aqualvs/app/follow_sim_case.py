"""What is simulated in one run: vehicle, sea, net, delays; and how it becomes a loop."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from aqualvs.app.follow_sim import Eye, SimulatedLoop, Timing
from aqualvs.app.follow_sim_link import SimulatedLink
from aqualvs.control.autopilot import NetPilot
from aqualvs.control.controller import RangeYawController
from aqualvs.control.gains import ControlGains
from aqualvs.control.mission import Mission
from aqualvs.control.safety import SafetyGate, SafetyLimits
from aqualvs.control.tune import tune
from aqualvs.errors import OptionError
from aqualvs.simulation.net_motion import NetWall
from aqualvs.simulation.vehicle import SimulatedVehicle
from aqualvs.simulation.vehicle_models import BLUEROV2, BLUEROV2_HEAVY, VIDEORAY, VehicleModel
from aqualvs.simulation.water_motion import Tether, WaterMotion, Waves

VEHICLE_NAMES = ("bluerov2", "bluerov2-heavy", "videoray")
_MODELS = dict(zip(VEHICLE_NAMES, (BLUEROV2, BLUEROV2_HEAVY, VIDEORAY), strict=True))


@dataclass(frozen=True, slots=True, kw_only=True)
class SimCase:
    """One simulated run.

    Attributes
    ----------
    model : VehicleModel
        The true vehicle.
    gains : ControlGains
        Of the controller, for what it believes the vehicle to be.
    water : WaterMotion
    net : NetWall
    start_range, start_yaw : float
        Posture at the start, at rest, in metres and radians.
    timing : Timing
        Of the frames.
    wire : float
        Time from an effort to its arrival at the vehicle, in seconds.
    limits : SafetyLimits
        Of the safety gate.
    seed : int
        Of the noise of sensors and pictures.
    """

    model: VehicleModel
    gains: ControlGains
    water: WaterMotion = field(default_factory=WaterMotion)
    net: NetWall = field(default_factory=NetWall)
    start_range: float = 0.6
    start_yaw: float = 0.0
    timing: Timing = field(default_factory=Timing)
    wire: float = 0.02
    limits: SafetyLimits = field(default_factory=SafetyLimits)
    seed: int = 0

    def loop(self, eye: Eye, mission: Mission) -> SimulatedLoop:
        """Return the loop, ready to run."""
        dome = self.net.station(self.start_range, yaw=self.start_yaw)
        vehicle = SimulatedVehicle(
            self.model,
            self.water,
            np.random.default_rng([self.seed, 41]),
            dome @ self.model.body_from_dome.inverse(),
            latency=self.wire,
        )
        controller = RangeYawController(self.gains)
        steering = NetPilot(mission, controller, SafetyGate(self.limits))
        return SimulatedLoop(SimulatedLink(vehicle), self.net, eye, steering, self.timing)


def vehicle_model(name: str, pilot_gain: float = 0.5) -> VehicleModel:
    """Return a vehicle by the name that the command line knows.

    Parameters
    ----------
    name : str
    pilot_gain : float
        ArduSub's: the share of the thrust that a full effort asks for.

    Raises
    ------
    OptionError
        If there is no such vehicle, or the gain is none.
    """
    model = _MODELS.get(name.replace("_", "-"))
    if model is None:
        raise OptionError(f"--vehicle {name}: not known; choose one of {', '.join(VEHICLE_NAMES)}")
    return replace(model, sticks=replace(model.sticks, gain=pilot_gain))


def tuned_gains(model: VehicleModel) -> ControlGains:
    """Return the gains that `aqualvs tune` gives for a vehicle."""
    return tune(model).gains


def sea(
    *,
    current: float = 0.3,
    current_to: float = math.radians(60.0),
    wander: float = 0.0,
    waves: float = 0.1,
    period: float = 5.0,
    waves_to: float = math.radians(20.0),
    tether: float = 15.0,
    seed: int = 0,
) -> WaterMotion:
    """Return a sea with a current, irregular waves and a tether.

    Parameters
    ----------
    current : float
        Speed in m/s.
    current_to : float
        Direction it flows to, in radians clockwise from the direction in which one looks at the
        net (north): 0 presses the vehicle against the net.
    wander : float
        Standard deviation of slow changes of the current, in m/s.
    waves : float
        Amplitude in metres at the surface; 0 is a calm. The net hangs 5 m deep.
    period : float
        Of the waves, in seconds.
    waves_to : float
        Direction they go, as of the current.
    tether : float
        Its length in the water, in metres.
    seed : int
        Of the phases.
    """
    flow = (current * math.cos(current_to), current * math.sin(current_to), 0.0)
    swell = Waves(amplitude=waves, period=period, direction=waves_to, n=6) if waves else None
    return WaterMotion(
        current=flow,
        wander=wander,
        waves=swell,
        tether=Tether(length=tether),
        seed=seed,
    )
