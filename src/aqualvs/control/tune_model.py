"""What a controller should know of a simulated vehicle."""

import math
from dataclasses import dataclass

import numpy as np

from aqualvs.control.gains import Drag, VehicleFacts
from aqualvs.control.gains_thrust import Layout, ThrustMap
from aqualvs.control.sticks import StickChannel, StickShaping
from aqualvs.errors import OptionError
from aqualvs.simulation.vehicle_models import FORWARD, RIGHT, YAW, VehicleModel


def facts_of(model: VehicleModel) -> VehicleFacts:
    """Return what a controller should know of a simulated vehicle, its pilot gain included."""
    sticks, shaping = model.sticks, shaping_of_model(model)
    return VehicleFacts(
        name=model.name,
        mass=tidy(model.mass + model.added_mass[0]),
        forward_drag=Drag(model.linear_drag[0], model.quadratic_drag[0]),
        right_drag=Drag(model.linear_drag[1], model.quadratic_drag[1]),
        thrust=_thrust_map(model),
        turning_rate=math.radians(tidy(math.degrees(sticks.turning_rate * shaping.turning_share))),
        climb_rate=tidy(sticks.climb_rate * shaping.climbing_share),
        dome_forward=model.dome_position[0],
    )


def shaping_of_model(model: VehicleModel) -> StickShaping:
    """Return what a link must take out of a simulated vehicle's sticks."""
    sticks, own = model.sticks, StickShaping()
    yaw, forward, right = sticks.trims
    return StickShaping(
        gain=sticks.gain,
        throttle_dead_zone=sticks.throttle_dead_zone,
        throttle=own.throttle,
        yaw=StickChannel(trim=yaw, dead_zone=sticks.yaw_dead_zone),
        forward=StickChannel(trim=forward),
        right=StickChannel(trim=right),
    )


def _thrust_map(model: VehicleModel) -> ThrustMap:
    """Return thrust over effort: the thrusters' curve, as far as the pilot gain lets it."""
    curve, gain = model.curve, model.sticks.gain
    travel = (gain - curve.dead_band) / (1.0 - curve.dead_band)
    if not travel > 0.0:
        raise OptionError(
            f"vehicle {model.name}: pilot gain {gain:g} stays in the thrusters' dead band "
            f"{curve.dead_band:g}; raise the gain"
        )
    straight = curve.linear * travel
    bent = (1.0 - curve.linear) * travel * travel
    along, mixing = model.allocation(), model.mixing()
    askew = bool(np.any((mixing[:, FORWARD] != 0.0) & (mixing[:, RIGHT] != 0.0)))

    def most(axis: int, column: int, sign: float) -> float:
        drive = sign * along[axis] * mixing[:, column]
        runs_forward = sign * mixing[:, column] > 0.0
        each = np.where(runs_forward, curve.forward, curve.reverse)
        return tidy(float(np.sum(np.abs(drive) * each)) * (straight + bent))

    return ThrustMap(
        forward=most(0, FORWARD, 1.0),
        backward=most(0, FORWARD, -1.0),
        right=most(1, RIGHT, 1.0),
        dead_band=tidy(curve.dead_band / gain),
        linear=tidy(straight / (straight + bent)),
        layout=Layout.VECTORED if askew else Layout.STRAIGHT,
    )


@dataclass(frozen=True, slots=True)
class Turning:
    """How late a vehicle's own autopilot follows a turning rate, in seconds.

    The shaping of the stick, the thrusters' lag, and the rate loop: inertia over the moment that it
    gives for a rate.

    Attributes
    ----------
    shaping, thrusters, rate_loop : float
    """

    shaping: float
    thrusters: float
    rate_loop: float

    def lag(self, slower: float = 1.0) -> float:
        """Return the whole, with a rate loop that is so many times slower."""
        return self.shaping + self.thrusters + slower * self.rate_loop


def turning_of(model: VehicleModel) -> Turning:
    """Return how late a model's autopilot follows a turning rate."""
    curve = model.curve
    lever = float(np.abs(model.allocation()[5] @ model.mixing()[:, YAW]))
    each = 0.5 * (curve.forward + curve.reverse) * curve.linear / (1.0 - curve.dead_band)
    inertia = model.inertia[2] + model.added_mass[5]
    rate_loop = inertia / (model.autopilot.rate[2] * lever * each)
    return Turning(model.autopilot.input_time, curve.lag, rate_loop)


def tidy(value: float) -> float:
    """Return a number rounded to what a file for people should hold: four digits."""
    return float(f"{value:.4g}")
