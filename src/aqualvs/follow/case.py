"""Setup of a simulated run (vehicle, sea, net, delays), and the trials that evaluate a loop.

The trials are: hold a range, make a step of the range, and follow a curved, moving net.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from aqualvs.control.autopilot import NetPilot
from aqualvs.control.controller import RangeYawController
from aqualvs.control.gains import ControlGains
from aqualvs.control.missions import FollowMission, HoldMission, Mission
from aqualvs.control.safety import SafetyGate, SafetyLimits
from aqualvs.control.vehicle import Setpoint
from aqualvs.errors import OptionError
from aqualvs.follow.log import HoldMeasures, LoopLog, StepMeasures, hold_measures, step_measures
from aqualvs.follow.loop import RangeSensor, SimulatedLink, SimulatedLoop, Timing
from aqualvs.follow.sensor_model import RenderedSensor, SampledSensor
from aqualvs.simulation.net_motion import NetWall
from aqualvs.simulation.scenarios import example_rig
from aqualvs.simulation.vehicle.models import VEHICLES, VehicleModel
from aqualvs.simulation.vehicle.vehicle import SimulatedVehicle
from aqualvs.simulation.vehicle.water_motion import Tether, WaterMotion, Waves

VEHICLE_NAMES = ("bluerov2", "bluerov2-heavy", "videoray")


@dataclass(frozen=True, slots=True, kw_only=True)
class SimCase:
    """One simulated run."""

    model: VehicleModel  # The simulated vehicle.
    gains: ControlGains  # Of the controller, possibly tuned for another model.
    water: WaterMotion = field(default_factory=WaterMotion)
    net: NetWall = field(default_factory=NetWall)
    # Posture at the start, at rest, in metres and radians.
    start_range: float = 0.6
    start_yaw: float = 0.0
    timing: Timing = field(default_factory=Timing)  # Of the frames.
    wire: float = 0.02  # Latency from sending an effort to its arrival at the vehicle, in seconds.
    limits: SafetyLimits = field(default_factory=SafetyLimits)  # Of the safety gate.
    seed: int = 0  # Random seed of the noise of the vehicle's sensors.

    def loop(self, sensor: RangeSensor, mission: Mission) -> SimulatedLoop:
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
        return SimulatedLoop(SimulatedLink(vehicle), self.net, sensor, steering, self.timing)


def vehicle_model(name: str, pilot_gain: float = 0.5) -> VehicleModel:
    """Return a vehicle by its name on the command line.

    `pilot_gain`: ArduSub's pilot gain, the share of the thrust that a full effort demands. Raises
    `OptionError` if there is no such vehicle, or the gain is out of range.
    """
    model = VEHICLES.get(name.replace("-", "_"))
    if model is None:
        raise OptionError(f"--vehicle {name}: not known; choose one of {', '.join(VEHICLE_NAMES)}")
    return replace(model, sticks=replace(model.sticks, gain=pilot_gain))


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

    `current`: speed in m/s, in the direction `current_to`, in radians clockwise from that of the
    view onto the net (north): 0 pushes the vehicle towards the net. `wander`: standard deviation of
    its slow changes, in m/s. `waves`: amplitude at the surface, in metres, of waves of `period`
    seconds that travel in the direction `waves_to`; 0 for none. The net's origin is 5 m deep.
    `tether`: its length in the water, in metres. `seed`: of the waves' phases and the wander.
    """
    flow = (current * math.cos(current_to), current * math.sin(current_to), 0.0)
    swell = Waves(amplitude=waves, period=period, direction=waves_to, n=6) if waves else None
    return WaterMotion(
        current=flow, wander=wander, waves=swell, tether=Tether(length=tether), seed=seed
    )


RANGE, STEP, SWAY = 0.6, 0.2, 0.2
"""Range to hold and its step, in metres; speed along the net, in m/s."""
FROM_REST_S = 10.0
"""Time to settle, in seconds, in a run that begins at rest in the current."""
STEP_S, HOLD_END_S, FOLLOW_END_S = 40.0, 52.0, 70.0
"""Times of the step and of the ends of the two runs, in seconds."""
CURVED = NetWall(curvature=-0.1, sway=0.05, sway_period=8.0, rock=math.radians(1.0))
"""Inside of a cage of 10 m radius that sways and rocks."""


@dataclass(frozen=True, slots=True)
class Trials:
    """Trials of one vehicle."""

    model: VehicleModel
    gains: ControlGains
    rendered: bool = False  # Render and scan pictures; otherwise, sample postures with noise.
    fps: float = 25.0  # Frames a second.
    seed: int = 0  # Random seed of waves and noise.

    def begin(self, seconds: float) -> LoopLog:
        """Hold the range to a flat net, from rest in the current."""
        case = self._case(NetWall())
        return case.loop(self._sensor(case), HoldMission(Setpoint(RANGE))).run(seconds)

    def hold_and_step(self) -> tuple[LoopLog, HoldMeasures, StepMeasures]:
        """Hold the range to a flat net, then increase it by a step."""
        case = self._case(NetWall())
        mission = HoldMission(Setpoint(RANGE))

        def step(now_s: float) -> None:
            if now_s >= STEP_S:
                mission.setpoint = Setpoint(RANGE + STEP)

        log = case.loop(self._sensor(case), mission).run(HOLD_END_S, step)
        answer = step_measures(
            log.column("time_s"), log.column("range"), STEP_S, RANGE, RANGE + STEP
        )
        # The setpoint in force lags the frame by its delay.
        return log, hold_measures(log, FROM_REST_S, STEP_S), answer

    def follow(
        self, seconds: float = FOLLOW_END_S, every_frame: Callable[[float], object] | None = None
    ) -> tuple[LoopLog, HoldMeasures]:
        """Follow a curved net that moves."""
        case = self._case(CURVED)
        mission = FollowMission(Setpoint(RANGE), SWAY)
        log = case.loop(self._sensor(case), mission).run(seconds, every_frame)
        return log, hold_measures(log, FROM_REST_S)

    def _case(self, net: NetWall) -> SimCase:
        return SimCase(
            model=self.model,
            gains=self.gains,
            water=sea(seed=self.seed),
            net=net,
            start_range=RANGE,
            timing=Timing(fps=self.fps),
            seed=self.seed,
        )

    def _sensor(self, case: SimCase) -> RangeSensor:
        rng = np.random.default_rng([self.seed, 53])
        if self.rendered:
            return RenderedSensor(case.net, example_rig(), rng)
        return SampledSensor(case.net, rng)
