"""The vehicle's own autopilot: ArduSub's depth hold (mode_althold.cpp), compiled.

Roll and pitch are held at zero and depth where it is; the sticks ask for rates of descent and of
turning, forward and right go straight to the thrusters. It knows attitude, rates and depth as
they are: what an estimator makes of good sensors is better than what it is asked to hold.
"""

from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel
from aqualvs.simulation.vectors import Vec
from aqualvs.simulation.vehicle_kernels import Body, Work, advance, to_world, turn_of
from aqualvs.simulation.vehicle_models import DOWN, FORWARD, PITCH, RIGHT, ROLL, YAW, VehicleModel
from aqualvs.simulation.water_motion import Flow

# Memory of the autopilot.
DEPTH, HEADING, SINCE_TURN, TURN_RATE, DESCENT, INTEGRAL, N_MEMORY = 0, 1, 2, 3, 4, 5, 9
# Gains in one row.
_ANGLE, _RATE, _RATE_I, _DEPTH, _CLIMB, _CLIMB_I, _INPUT, _ACCELERATION, _SETTLE = (
    *(0, 1, 4, 7, 8, 9, 10, 11, 12),
)
_FULL_TURN, _FULL_CLIMB = 13, 14
# Thrust curve in one row.
_FORWARD, _REVERSE, _DEAD, _LINEAR = range(4)
# Limits of the integrators (ATC_RAT_*_IMAX), of the heading's error and of the depth's.
_MOST_ROLL_PITCH, _MOST_YAW, _MOST_DOWN = 0.444, 0.222, 0.8
_MOST_TURN_ERROR = float(np.deg2rad(30.0))
_MOST_DEPTH_ERROR = 0.5


class Pilot(NamedTuple):
    """The numbers of an autopilot.

    Attributes
    ----------
    gains : array, shape (15,)
        Of `Autopilot` and `Sticks`.
    mixing : array, shape (n, 6)
        See `VehicleModel.mixing`.
    curve : array, shape (4,)
        Of `ThrustCurve`.
    inputs : array, shape (6,)
        Memory for the motor inputs.
    wanted : array, shape (n,)
        Memory for the thrusts asked for, in newtons.
    """

    gains: FloatArray
    mixing: FloatArray
    curve: FloatArray
    inputs: FloatArray
    wanted: FloatArray


def pack_pilot(model: VehicleModel) -> Pilot:
    """Return a model's autopilot as kernels need it."""
    own, sticks, curve = model.autopilot, model.sticks, model.curve
    gains = [own.angle, *own.rate, *own.rate_integral, own.depth, own.climb, own.climb_integral]
    gains += [own.input_time, own.acceleration, own.settle]
    gains += [sticks.turning_rate, sticks.climb_rate]
    return Pilot(
        np.array(gains),
        model.mixing(),
        np.array([curve.forward, curve.reverse, curve.dead_band, curve.linear]),
        np.zeros(6),
        np.zeros(len(model.thrusters)),
    )


@inline_borrowing_kernel
def _clip(value: float, most: float) -> float:
    return min(max(value, -most), most)


@inline_borrowing_kernel
def _past(value: float, dead: float) -> float:
    """Return what of a deflection is past the dead zone, rescaled to reach 1 (ArduPilot)."""
    return float(np.copysign(max(abs(value) - dead, 0.0) / (1.0 - dead), value))


@inline_borrowing_kernel
def thrust_of(command: float, curve: FloatArray) -> float:
    """Return the thrust in newtons that a command of -1 to 1 tends to."""
    x = _past(_clip(command, 1.0), curve[_DEAD])
    most = curve[_FORWARD] if x > 0.0 else curve[_REVERSE]
    return float(most * x * (curve[_LINEAR] + (1.0 - curve[_LINEAR]) * abs(x)))


@inline_borrowing_kernel
def _wrapped(angle: float) -> float:
    return float(angle - 2.0 * np.pi * np.floor(angle / (2.0 * np.pi) + 0.5))


@inline_borrowing_kernel
def _rate_loop(
    axis: int, wanted: float, rate: float, most: float, h: float, memory: FloatArray, pilot: Pilot
) -> None:
    error = wanted - rate
    integral = memory[INTEGRAL + axis] + pilot.gains[_RATE_I + axis] * error * h
    memory[INTEGRAL + axis] = _clip(integral, most)
    pilot.inputs[axis] = pilot.gains[_RATE + axis] * error + memory[INTEGRAL + axis]


@inline_borrowing_kernel
def _hold_heading(
    effort: FloatArray, heading: float, h: float, m: FloatArray, g: FloatArray
) -> float:
    """Return the turning rate that stick and held heading ask for."""
    asked = g[_FULL_TURN] * effort[3]
    m[TURN_RATE] += (asked - m[TURN_RATE]) * (1.0 - np.exp(-h / g[_INPUT]))
    m[SINCE_TURN] = m[SINCE_TURN] + h if asked == 0.0 else 0.0
    if asked == 0.0 and m[SINCE_TURN] < g[_SETTLE]:
        m[HEADING] = heading
    else:
        m[HEADING] += m[TURN_RATE] * h
    error = _clip(_wrapped(m[HEADING] - heading), _MOST_TURN_ERROR)
    m[HEADING] = heading + error
    return float(m[TURN_RATE] + g[_ANGLE] * error)


@inline_borrowing_kernel
def _hold_depth(
    effort: FloatArray, depth: float, descent: float, h: float, m: FloatArray, g: FloatArray
) -> float:
    """Return the motor input for down."""
    asked = g[_FULL_CLIMB] * effort[2]
    m[DESCENT] += _clip(asked - m[DESCENT], g[_ACCELERATION] * h)
    error = _clip(m[DEPTH] + m[DESCENT] * h - depth, _MOST_DEPTH_ERROR)
    m[DEPTH] = depth + error
    lack = m[DESCENT] + g[_DEPTH] * error - descent
    out = g[_CLIMB] * lack + m[INTEGRAL + 3]
    if abs(out) < 1.0 or out * lack < 0.0:
        m[INTEGRAL + 3] = _clip(m[INTEGRAL + 3] + g[_CLIMB_I] * lack * h, _MOST_DOWN)
    return float(out)


@inline_borrowing_kernel
def euler_of(r: tuple[Vec, Vec, Vec]) -> Vec:
    """Return roll, pitch and heading of the rows of world_from_body, in radians."""
    return (
        np.arctan2(r[2][1], r[2][2]),
        -np.arcsin(_clip(r[2][0], 1.0)),
        np.arctan2(r[1][0], r[0][0]),
    )


@inline_borrowing_kernel
def mix_inputs(pilot: Pilot) -> None:
    """Turn `pilot.inputs` into `pilot.wanted` as ArduSub's AP_Motors6DOF does.

    Roll, pitch and depth are one group, yaw, forward and right another; a group that asks more
    than a thruster has is scaled down as a whole.
    """
    inputs, mixing, n = pilot.inputs, pilot.mixing, pilot.mixing.shape[0]
    upright, level = 1.0, 1.0
    for k in range(n):
        a = inputs[ROLL] * mixing[k, ROLL] + inputs[PITCH] * mixing[k, PITCH]
        upright = max(upright, abs(a + inputs[DOWN] * mixing[k, DOWN]))
        b = inputs[YAW] * mixing[k, YAW] + inputs[FORWARD] * mixing[k, FORWARD]
        level = max(level, abs(b + inputs[RIGHT] * mixing[k, RIGHT]))
    for k in range(n):
        a = inputs[ROLL] * mixing[k, ROLL] + inputs[PITCH] * mixing[k, PITCH]
        a = (a + inputs[DOWN] * mixing[k, DOWN]) / upright
        b = inputs[YAW] * mixing[k, YAW] + inputs[FORWARD] * mixing[k, FORWARD]
        b = (b + inputs[RIGHT] * mixing[k, RIGHT]) / level
        pilot.wanted[k] = thrust_of(a + b, pilot.curve)


@inline_borrowing_kernel
def steer(y: FloatArray, effort: FloatArray, h: float, memory: FloatArray, pilot: Pilot) -> None:
    """Write the thrusts that the autopilot asks for to `pilot.wanted`."""
    g = pilot.gains
    r = turn_of(y)
    roll, pitch, heading = euler_of(r)
    turn = _hold_heading(effort, heading, h, memory, g)
    # Rates about body axes that turn the heading while roll and pitch stay.
    _rate_loop(ROLL, -g[_ANGLE] * roll + turn * r[2][0], y[10], _MOST_ROLL_PITCH, h, memory, pilot)
    _rate_loop(
        PITCH, -g[_ANGLE] * pitch + turn * r[2][1], y[11], _MOST_ROLL_PITCH, h, memory, pilot
    )
    _rate_loop(YAW, turn * r[2][2], y[12], _MOST_YAW, h, memory, pilot)
    descent = to_world(r, (y[7], y[8], y[9]))[2]
    pilot.inputs[DOWN] = _hold_depth(effort, y[2], descent, h, memory, g)
    pilot.inputs[FORWARD] = effort[0]
    pilot.inputs[RIGHT] = effort[1]
    for i in range(4):
        pilot.inputs[i] = _clip(pilot.inputs[i], 1.0)
    mix_inputs(pilot)


@borrowing_kernel
def fly(
    y: FloatArray,
    thrusts: FloatArray,
    memory: FloatArray,
    effort: FloatArray,
    t: float,
    h: float,
    n: int,
    pilot: Pilot,
    body: Body,
    flow: Flow,
    work: Work,
) -> None:
    """Carry the vehicle on by `n` steps of `h` seconds under one effort.

    Parameters
    ----------
    y : array, shape (13,)
        State; see `vehicle_kernels`.
    thrusts : array, shape (n_thrusters,)
        In newtons.
    memory : array, shape (N_MEMORY,)
        Of the autopilot.
    effort : array, shape (4,)
        What the sticks ask for; see `Sticks.asked`.
    """
    for i in range(n):
        steer(y, effort, h, memory, pilot)
        advance(y, thrusts, pilot.wanted, t + i * h, h, body, flow, work)
