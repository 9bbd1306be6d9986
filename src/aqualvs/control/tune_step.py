"""A step of the range in the simulator: what tuning promises, tried on the whole vehicle."""

import math
from dataclasses import dataclass

import numpy as np

from aqualvs.control.controller import RangeYawController
from aqualvs.control.gains import ControlGains
from aqualvs.control.setpoint import Setpoint
from aqualvs.control.tune_model import shaping_of_model
from aqualvs.geometry.arrays import FloatArray
from aqualvs.simulation.vehicle import SimulatedVehicle, level_pose
from aqualvs.simulation.vehicle_models import VehicleModel
from aqualvs.simulation.water_motion import WaterMotion

# The wall stands across north, so far from the origin; the vehicle is so deep, in metres.
_WALL, _DEPTH = 5.0, 5.0
_REST_S, _AFTER_S = 6.0, 12.0
_BAND = 0.05


@dataclass(frozen=True, slots=True)
class StepOptions:
    """What is tried.

    Attributes
    ----------
    begin, end : float
        Ranges before and after, in metres.
    delay : float
        From a frame to its effort at the vehicle, in seconds.
    frame : float
        Seconds between frames.
    """

    begin: float = 0.8
    end: float = 0.6
    delay: float = 0.1
    frame: float = 0.04


@dataclass(frozen=True, slots=True)
class StepAnswer:
    """What came of it.

    Attributes
    ----------
    time, range : array, shape (N,)
        Seconds since the step, from before it on; metres.
    overshoot : float
        Share of the step.
    settling : float
        Seconds after which the range stays within 5 % of the step; infinite if it does not.
    """

    time: FloatArray
    range: FloatArray
    overshoot: float
    settling: float


def simulate_step(
    model: VehicleModel,
    gains: ControlGains,
    options: StepOptions | None = None,
    water: WaterMotion | None = None,
) -> StepAnswer:
    """Hold a range before a wall, then another one; postures are exact.

    Parameters
    ----------
    model : VehicleModel
        Need not be the one that the gains are for.
    gains : ControlGains
    options : StepOptions, optional
    water : WaterMotion, optional
        Still if left out.
    """
    options = options or StepOptions()
    ahead = _WALL - options.begin - model.dome_position[0]
    pose = level_pose(np.array([ahead, 0.0, _DEPTH]), 0.0)
    vehicle = SimulatedVehicle(
        model, water or WaterMotion(), np.random.default_rng(0), pose, latency=options.delay
    )
    controller, shaping = RangeYawController(gains), shaping_of_model(model)
    n_rest, n_after = (round(span / options.frame) for span in (_REST_S, _AFTER_S))
    time = options.frame * np.arange(-n_rest, n_after, dtype=np.float64)
    ranges = np.empty(len(time))
    before = _posture(vehicle)
    for k, now in enumerate(time.tolist()):
        goal = options.begin if now < 0.0 else options.end
        ranges[k], yaw = _posture(vehicle)
        rates = ((ranges[k] - before[0]) / options.frame, (yaw - before[1]) / options.frame)
        before = (ranges[k], yaw)
        effort = controller.update(now, *before, *rates, Setpoint(goal))
        vehicle.step(shaping.position(effort), options.frame)
    return _answer(time, ranges, options)


def _posture(vehicle: SimulatedVehicle) -> tuple[float, float]:
    """Return range and yaw to the wall."""
    world_from_dome = vehicle.dome_pose
    normal = world_from_dome.rotation[0]
    return _WALL - float(world_from_dome.translation[0]), math.atan2(normal[0], normal[1])


def _answer(time: FloatArray, ranges: FloatArray, options: StepOptions) -> StepAnswer:
    after = time >= 0.0
    size = options.end - options.begin
    beyond = (ranges[after] - options.end) / size
    outside = np.flatnonzero(np.abs(beyond) > _BAND)
    last = int(outside[-1]) + 1 if len(outside) else 0
    settling = float(time[after][last]) if last < len(beyond) else math.inf
    return StepAnswer(time, ranges, max(0.0, float(beyond.max())), settling)
