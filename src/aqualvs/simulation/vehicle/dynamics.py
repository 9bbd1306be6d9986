"""Compiled dynamics of a vehicle in moving water, and its autopilot.

Rigid body (Fossen 2011, Handbook of marine craft hydrodynamics, ch. 6-8): with nu the body's
velocity, nu_r that relative to the water and v_c, a_c velocity and acceleration of the water, all
along body axes and diagonal matrices,

    (M_RB + M_A) nu' = tau - C_RB(nu) nu - C_A(nu_r) nu_r - D(nu_r) nu_r - g
                       + M_A (a_c - omega x v_c) + m_displaced a_c,

the last term being the Froude-Krylov force of waves on a body much shorter than they are. The
state is a row of 13 numbers: position in the world (north, east, down), attitude as the unit
quaternion (w, x, y, z) of world_from_body, velocity and turning rate along body axes.

Autopilot: ArduSub's depth hold (mode_althold.cpp). Roll and pitch are held at zero and depth at its
present value; the sticks set rates of descent and of turning; forward and right go straight to
the thrusters. The autopilot gets the true attitude, rates and depth: a good estimator's errors are
smaller than the errors of control.
"""

from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel
from aqualvs.geometry.linear_algebra import Vec, cross, minus
from aqualvs.simulation.vehicle.models import DOWN, FORWARD, PITCH, RIGHT, ROLL, YAW, VehicleModel
from aqualvs.simulation.vehicle.water_motion import Flow, orbit_at, stream_at, tether_force

POSITION, ATTITUDE, VELOCITY, TURNING, N_STATE = 0, 3, 7, 10, 13
# Rows of the body's table.
_RIGID, _ADDED, _LINEAR, _QUADRATIC, _RESTORING = range(5)
N_ROWS = 5

Turn = tuple[Vec, Vec, Vec]


class Body(NamedTuple):
    """Numbers of a hull and its thrusters, for kernels."""

    # Shape (5, 6): rigid and added inertia, linear and quadratic drag; weight, buoyancy, centre of
    # buoyancy, displaced mass.
    hull: FloatArray
    allocation: FloatArray  # Shape (6, n): force and moment of every thruster's unit thrust.
    lag: float  # Time constant of the thrusters, in seconds.


class Work(NamedTuple):
    """Working memory of the integrator: `slopes` (4, 13), `probe` (13,), `wrench` (3, 6)."""

    slopes: FloatArray
    probe: FloatArray
    wrench: FloatArray


def make_work() -> Work:
    """Return working memory for the integrator."""
    return Work(np.zeros((4, N_STATE)), np.zeros(N_STATE), np.zeros((3, 6)))


@inline_borrowing_kernel
def turn_of(y: FloatArray) -> Turn:
    """Return the rows of world_from_body."""
    w, i, j, k = y[3], y[4], y[5], y[6]
    return (
        (1.0 - 2.0 * (j * j + k * k), 2.0 * (i * j - w * k), 2.0 * (i * k + w * j)),
        (2.0 * (i * j + w * k), 1.0 - 2.0 * (i * i + k * k), 2.0 * (j * k - w * i)),
        (2.0 * (i * k - w * j), 2.0 * (j * k + w * i), 1.0 - 2.0 * (i * i + j * j)),
    )


@inline_borrowing_kernel
def to_body(r: Turn, v: Vec) -> Vec:
    """Turn a vector from the world's axes into the body's."""
    return (
        r[0][0] * v[0] + r[1][0] * v[1] + r[2][0] * v[2],
        r[0][1] * v[0] + r[1][1] * v[1] + r[2][1] * v[2],
        r[0][2] * v[0] + r[1][2] * v[1] + r[2][2] * v[2],
    )


@inline_borrowing_kernel
def to_world(r: Turn, v: Vec) -> Vec:
    """Turn a vector from the body's axes into the world's."""
    return (
        r[0][0] * v[0] + r[0][1] * v[1] + r[0][2] * v[2],
        r[1][0] * v[0] + r[1][1] * v[1] + r[1][2] * v[2],
        r[2][0] * v[0] + r[2][1] * v[1] + r[2][2] * v[2],
    )


@inline_borrowing_kernel
def _plus(a: Vec, b: Vec) -> Vec:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inline_borrowing_kernel
def _times(hull: FloatArray, row: int, first: int, v: Vec) -> Vec:
    """Multiply by part of a diagonal."""
    a, b, c = hull[row, first], hull[row, first + 1], hull[row, first + 2]
    return a * v[0], b * v[1], c * v[2]


@inline_borrowing_kernel
def _drag(hull: FloatArray, first: int, v: Vec) -> Vec:
    """Return the drag, against the motion, from linear and quadratic coefficients."""
    x = hull[_LINEAR, first] + hull[_QUADRATIC, first] * abs(v[0])
    y = hull[_LINEAR, first + 1] + hull[_QUADRATIC, first + 1] * abs(v[1])
    z = hull[_LINEAR, first + 2] + hull[_QUADRATIC, first + 2] * abs(v[2])
    return -x * v[0], -y * v[1], -z * v[2]


@inline_borrowing_kernel
def slope(
    y: FloatArray, wrench: FloatArray, t: float, hull: FloatArray, flow: Flow, out: FloatArray
) -> None:
    """Write the state's rate of change at time `t` under thrust `wrench`, shape (6,), to `out`."""
    r = turn_of(y)
    v, turning = (y[7], y[8], y[9]), (y[10], y[11], y[12])
    v_world = to_world(r, v)
    stream, stream_change = stream_at(t, flow)
    orbit, orbit_change = orbit_at(t, (y[0], y[1], y[2]), flow)
    water = to_body(r, _plus(stream, orbit))
    change = to_body(r, _plus(stream_change, orbit_change))
    relative = minus(v, water)
    momentum = _times(hull, _RIGID, 0, v)
    added = _times(hull, _ADDED, 0, relative)
    spin = _plus(_times(hull, _RIGID, 3, turning), _times(hull, _ADDED, 3, turning))
    carried = cross(turning, _plus(momentum, added))
    gyration = _plus(cross(turning, spin), cross(relative, added))
    inflow = _times(hull, _ADDED, 0, minus(change, cross(turning, water)))
    force, moment = _drag(hull, 0, relative), _drag(hull, 3, turning)
    lift = -hull[_RESTORING, 1]
    down = r[2]
    lever = (hull[_RESTORING, 2], hull[_RESTORING, 3], hull[_RESTORING, 4])
    righting = cross(lever, (lift * down[0], lift * down[1], lift * down[2]))
    line = to_body(r, tether_force(stream, v_world, flow))
    jerk = cross((flow.line[1], flow.line[2], flow.line[3]), line)
    heavy, displaced = hull[_RESTORING, 0] + lift, hull[_RESTORING, 5]
    for i in range(3):
        out[POSITION + i] = v_world[i]
        total = wrench[i] + force[i] - carried[i] + inflow[i] + displaced * change[i]
        total += heavy * down[i] + line[i]
        out[VELOCITY + i] = total / (hull[_RIGID, i] + hull[_ADDED, i])
        total = wrench[3 + i] + moment[i] - gyration[i] + righting[i] + jerk[i]
        out[TURNING + i] = total / (hull[_RIGID, 3 + i] + hull[_ADDED, 3 + i])
    w, i, j, k = y[3], y[4], y[5], y[6]
    p, q, s = turning
    out[3] = -0.5 * (i * p + j * q + k * s)
    out[4] = 0.5 * (w * p + j * s - k * q)
    out[5] = 0.5 * (w * q + k * p - i * s)
    out[6] = 0.5 * (w * s + i * q - j * p)


@inline_borrowing_kernel
def wrench_of(thrusts: FloatArray, allocation: FloatArray, out: FloatArray) -> None:
    """Write force and moment of all thrusters to `out`, shape (6,)."""
    for i in range(6):
        total = 0.0
        for k in range(thrusts.shape[0]):
            total += allocation[i, k] * thrusts[k]
        out[i] = total


@inline_borrowing_kernel
def _stage(
    y: FloatArray, k: int, t: float, left: float, body: Body, flow: Flow, work: Work
) -> None:
    """Write slope k; `left` is the remaining share of the step to the wanted wrench."""
    for i in range(6):
        wanted = work.wrench[1, i]
        work.wrench[2, i] = wanted + (work.wrench[0, i] - wanted) * left
    slope(y, work.wrench[2], t, body.hull, flow, work.slopes[k])


@inline_borrowing_kernel
def _probe(y: FloatArray, k: int, h: float, work: Work) -> None:
    for i in range(N_STATE):
        work.probe[i] = y[i] + h * work.slopes[k, i]


@inline_borrowing_kernel
def advance(
    y: FloatArray,
    thrusts: FloatArray,
    wanted: FloatArray,
    t: float,
    h: float,
    body: Body,
    flow: Flow,
    work: Work,
) -> None:
    """Advance state and thrusts by one Runge-Kutta step while thrusts approach `wanted`.

    All thrusters have one lag, so the decay of their wrench is exact and the order remains four.
    """
    half = np.exp(-0.5 * h / body.lag)
    wrench_of(thrusts, body.allocation, work.wrench[0])
    wrench_of(wanted, body.allocation, work.wrench[1])
    _stage(y, 0, t, 1.0, body, flow, work)
    _probe(y, 0, 0.5 * h, work)
    _stage(work.probe, 1, t + 0.5 * h, half, body, flow, work)
    _probe(y, 1, 0.5 * h, work)
    _stage(work.probe, 2, t + 0.5 * h, half, body, flow, work)
    _probe(y, 2, h, work)
    _stage(work.probe, 3, t + h, half * half, body, flow, work)
    s = work.slopes
    for i in range(N_STATE):
        y[i] += h / 6.0 * (s[0, i] + 2.0 * (s[1, i] + s[2, i]) + s[3, i])
    length = np.sqrt(y[3] * y[3] + y[4] * y[4] + y[5] * y[5] + y[6] * y[6])
    for i in range(4):
        y[ATTITUDE + i] /= length
    for k in range(thrusts.shape[0]):
        thrusts[k] = wanted[k] + (thrusts[k] - wanted[k]) * half * half


# Memory of the autopilot.
DEPTH, HEADING, SINCE_TURN, TURN_RATE, DESCENT, INTEGRAL, N_MEMORY = 0, 1, 2, 3, 4, 5, 9
# Gains in one row.
_ANGLE, _RATE, _RATE_I, _DEPTH, _CLIMB, _CLIMB_I, _INPUT, _ACCELERATION, _SETTLE = (
    *(0, 1, 4, 7, 8, 9, 10, 11, 12),
)
_FULL_TURN, _FULL_CLIMB = 13, 14
# Thrust curve in one row.
_FORWARD, _REVERSE, _DEAD, _AUTOPILOT_LINEAR = range(4)
# Limits of the integrators (ATC_RAT_*_IMAX), of the heading's error and of the depth's.
_MAX_ROLL_PITCH, _MAX_YAW, _MAX_DOWN = 0.444, 0.222, 0.8
_MAX_TURN_ERROR = float(np.deg2rad(30.0))
_MAX_DEPTH_ERROR = 0.5


class PackedAutopilot(NamedTuple):
    """Numbers and working memory of an autopilot, for kernels."""

    gains: FloatArray  # Shape (15,): of `Autopilot` and `Sticks`.
    mixing: FloatArray  # Shape (n, 6): see `VehicleModel.mixing`.
    curve: FloatArray  # Shape (4,): of `ThrustCurve`.
    inputs: FloatArray  # Shape (6,): memory for the motor inputs.
    wanted: FloatArray  # Shape (n,): memory for the requested thrusts, in newtons.


def pack_pilot(model: VehicleModel) -> PackedAutopilot:
    """Return a model's autopilot for kernels."""
    own, sticks, curve = model.autopilot, model.sticks, model.curve
    gains = [own.angle, *own.rate, *own.rate_integral, own.depth, own.climb, own.climb_integral]
    gains += [own.input_time, own.acceleration, own.settle]
    gains += [sticks.turning_rate, sticks.climb_rate]
    return PackedAutopilot(
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
    """Return a deflection beyond the dead zone, rescaled to reach 1 (ArduPilot)."""
    return float(np.copysign(max(abs(value) - dead, 0.0) / (1.0 - dead), value))


@inline_borrowing_kernel
def thrust_of(command: float, curve: FloatArray) -> float:
    """Return the steady thrust in newtons of a command of -1 to 1."""
    x = _past(_clip(command, 1.0), curve[_DEAD])
    most = curve[_FORWARD] if x > 0.0 else curve[_REVERSE]
    return float(most * x * (curve[_AUTOPILOT_LINEAR] + (1.0 - curve[_AUTOPILOT_LINEAR]) * abs(x)))


@inline_borrowing_kernel
def _wrapped(angle: float) -> float:
    return float(angle - 2.0 * np.pi * np.floor(angle / (2.0 * np.pi) + 0.5))


@inline_borrowing_kernel
def _rate_loop(
    axis: int,
    wanted: float,
    rate: float,
    most: float,
    h: float,
    memory: FloatArray,
    pilot: PackedAutopilot,
) -> None:
    error = wanted - rate
    integral = memory[INTEGRAL + axis] + pilot.gains[_RATE_I + axis] * error * h
    memory[INTEGRAL + axis] = _clip(integral, most)
    pilot.inputs[axis] = pilot.gains[_RATE + axis] * error + memory[INTEGRAL + axis]


@inline_borrowing_kernel
def _hold_heading(
    effort: FloatArray, heading: float, h: float, m: FloatArray, g: FloatArray
) -> float:
    """Return the turning rate requested by stick and held heading."""
    asked = g[_FULL_TURN] * effort[3]
    m[TURN_RATE] += (asked - m[TURN_RATE]) * (1.0 - np.exp(-h / g[_INPUT]))
    m[SINCE_TURN] = m[SINCE_TURN] + h if asked == 0.0 else 0.0
    if asked == 0.0 and m[SINCE_TURN] < g[_SETTLE]:
        m[HEADING] = heading
    else:
        m[HEADING] += m[TURN_RATE] * h
    error = _clip(_wrapped(m[HEADING] - heading), _MAX_TURN_ERROR)
    m[HEADING] = heading + error
    return float(m[TURN_RATE] + g[_ANGLE] * error)


@inline_borrowing_kernel
def _hold_depth(
    effort: FloatArray, depth: float, descent: float, h: float, m: FloatArray, g: FloatArray
) -> float:
    """Return the motor input for down."""
    asked = g[_FULL_CLIMB] * effort[2]
    m[DESCENT] += _clip(asked - m[DESCENT], g[_ACCELERATION] * h)
    error = _clip(m[DEPTH] + m[DESCENT] * h - depth, _MAX_DEPTH_ERROR)
    m[DEPTH] = depth + error
    lack = m[DESCENT] + g[_DEPTH] * error - descent
    out = g[_CLIMB] * lack + m[INTEGRAL + 3]
    if abs(out) < 1.0 or out * lack < 0.0:
        m[INTEGRAL + 3] = _clip(m[INTEGRAL + 3] + g[_CLIMB_I] * lack * h, _MAX_DOWN)
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
def mix_inputs(pilot: PackedAutopilot) -> None:
    """Convert `pilot.inputs` to `pilot.wanted` like ArduSub's AP_Motors6DOF.

    Roll, pitch and depth are one group, yaw, forward and right another; a group that exceeds the
    range of a thruster is scaled down as a whole.
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
def steer(
    y: FloatArray, effort: FloatArray, h: float, memory: FloatArray, pilot: PackedAutopilot
) -> None:
    """Write the thrusts requested by the autopilot to `pilot.wanted`."""
    g = pilot.gains
    r = turn_of(y)
    roll, pitch, heading = euler_of(r)
    turn = _hold_heading(effort, heading, h, memory, g)
    # Rates about body axes that change the heading at constant roll and pitch.
    _rate_loop(ROLL, -g[_ANGLE] * roll + turn * r[2][0], y[10], _MAX_ROLL_PITCH, h, memory, pilot)
    _rate_loop(PITCH, -g[_ANGLE] * pitch + turn * r[2][1], y[11], _MAX_ROLL_PITCH, h, memory, pilot)
    _rate_loop(YAW, turn * r[2][2], y[12], _MAX_YAW, h, memory, pilot)
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
    pilot: PackedAutopilot,
    body: Body,
    flow: Flow,
    work: Work,
) -> None:
    """Advance the vehicle by `n` steps of `h` seconds under one effort.

    Parameters
    ----------
    y : array, shape (13,)
        State, see the docstring of this module.
    thrusts : array, shape (n_thrusters,)
        In newtons.
    memory : array, shape (N_MEMORY,)
        Of the autopilot.
    effort : array, shape (4,)
        Request of the sticks; see `StickInput.asked`.
    """
    for i in range(n):
        steer(y, effort, h, memory, pilot)
        advance(y, thrusts, pilot.wanted, t + i * h, h, body, flow, work)
