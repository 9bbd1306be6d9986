"""A simulated vehicle in its water, controlled by sticks as under ArduSub's depth hold.

Its telemetry holds depth and attitude with the errors of sensors: noise, bias, slow drift and a
limited rate (`Sensors`, `Telemetry`).
"""

import math
from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.compiled import python_of
from aqualvs.geometry.transforms import SE3, rotvec_from_rotation
from aqualvs.simulation.vehicle.dynamics import (
    DEPTH,
    HEADING,
    N_MEMORY,
    N_ROWS,
    N_STATE,
    POSITION,
    SINCE_TURN,
    TURNING,
    VELOCITY,
    Body,
    fly,
    make_work,
    pack_pilot,
    turn_of,
)
from aqualvs.simulation.vehicle.models import VehicleModel
from aqualvs.simulation.vehicle.water_motion import GRAVITY, WaterMotion


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorErrors:
    """Errors of a sensor, in the unit of its quantity."""

    noise: float = 0.0  # Standard deviation of the white noise of a reading.
    bias: float = 0.0  # Constant error.
    # Standard deviation and correlation time in seconds of a slow error (first-order Gauss-Markov).
    wander: float = 0.0
    wander_time: float = 30.0
    rate: float = 10.0  # Readings a second.


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensors:
    """All sensors of a vehicle."""

    # Metres. The default noise is a Bar30's with the sea on top.
    depth: SensorErrors = field(default_factory=lambda: SensorErrors(noise=0.005))
    # Radians; tilt is roll and pitch.
    heading: SensorErrors = field(
        default_factory=lambda: SensorErrors(noise=math.radians(0.2), wander=math.radians(1.0))
    )
    tilt: SensorErrors = field(default_factory=lambda: SensorErrors(noise=math.radians(0.2)))


class Telemetry(NamedTuple):
    """Readings of the vehicle's sensors, as MAVLink would carry them."""

    depth: float  # Metres, down positive.
    # Radians; heading clockwise from north, -pi to pi.
    heading: float
    roll: float
    pitch: float


class Reading:
    """Readings of one sensor over time."""

    def __init__(self, sensor: SensorErrors, rng: np.random.Generator) -> None:
        self._sensor = sensor
        self._rng = rng
        self._slow = sensor.wander * rng.normal()
        self._due = 0.0
        self._last_s = 0.0
        self._value = math.nan

    def of(self, truth: float, time_s: float) -> float:
        """Return the latest reading; a new one if it is due."""
        if time_s >= self._due - 1e-9:
            sensor = self._sensor
            left = math.exp(-(time_s - self._last_s) / sensor.wander_time)
            fresh = sensor.wander * math.sqrt(1.0 - left * left)
            self._slow = left * self._slow + fresh * self._rng.normal()
            error = sensor.bias + self._slow + sensor.noise * self._rng.normal()
            self._value, self._last_s = truth + error, time_s
            self._due = (math.floor(time_s * sensor.rate + 1e-6) + 1.0) / sensor.rate
        return self._value


RATE = 400.0
"""Least steps a second: ArduSub's main loop."""
_STILL = np.zeros(4)


class StickPositions(Protocol):
    """Positions of the sticks, -1 to 1 of full deflection."""

    @property
    def forward(self) -> float:
        """Ahead."""

    @property
    def right(self) -> float:
        """To starboard."""

    @property
    def down(self) -> float:
        """Deeper."""

    @property
    def yaw(self) -> float:
        """Clockwise from above."""


class SimulatedVehicle:
    """Simulated vehicle under a pilot's sticks.

    The world is north, east, down from the still surface; the body forward, right, down. The same
    model, water, sticks and `rng` give the same dive.

    Parameters
    ----------
    model : VehicleModel
        Hull, thrusters and autopilot.
    water : WaterMotion
        Current, waves and tether.
    rng : Generator
        Source of the sensors' noise.
    world_from_body : SE3
        Initial pose, at rest; it holds this heading and depth.
    sensors : Sensors, optional
        Errors of its sensors.
    latency : float
        Delay of stick positions, in seconds.
    lapse : float
        Time after the last ones until it holds still, in seconds (FS_PILOT_TIMEOUT).

    Attributes
    ----------
    armed, obeys : bool
        Disarmed, its thrusters stand still; if it does not obey, it holds heading and depth and
        ignores the sticks. Both may be set, as by a pilot.
    """

    def __init__(
        self,
        model: VehicleModel,
        water: WaterMotion,
        rng: np.random.Generator,
        world_from_body: SE3,
        *,
        sensors: Sensors | None = None,
        latency: float = 0.0,
        lapse: float = 3.0,
    ) -> None:
        if not (latency >= 0.0 and lapse > 0.0):
            raise OptionError(
                f"vehicle: latency {latency:g} s, lapse {lapse:g} s; the first is 0 or more, the "
                "second positive"
            )
        self.model, self.water = model, water
        self.latency, self.lapse = latency, lapse
        self.armed, self.obeys = True, True
        self._body, self._pilot = pack_body(model), pack_pilot(model)
        self._idle = self._pilot._replace(curve=np.array([0.0, 0.0, 0.0, 1.0]))
        self._flow, self._work = water.pack(), make_work()
        self._state = state_at(world_from_body)
        self._thrusts = np.zeros(len(model.thrusters))
        self._memory = np.zeros(N_MEMORY)
        self._engage()
        self._time = 0.0
        self._coming: deque[tuple[float, FloatArray]] = deque()
        self._effort, self._heard = _STILL, -math.inf
        readings = sensors or Sensors()
        kinds = (readings.depth, readings.heading, readings.tilt, readings.tilt)
        self._readings = [Reading(kind, one) for kind, one in zip(kinds, rng.spawn(4), strict=True)]

    @property
    def time_s(self) -> float:
        """Time since the start, in seconds."""
        return self._time

    @property
    def pose(self) -> SE3:
        """world_from_body."""
        return pose_of(self._state)

    @property
    def dome_pose(self) -> SE3:
        """world_from_dome, the dome's axes being right, forward, up."""
        return self.pose @ self.model.body_from_dome

    @property
    def velocity(self) -> FloatArray:
        """Velocity over ground along the body's axes, shape (3,), in m/s."""
        return self._state[VELOCITY : VELOCITY + 3].copy()

    @property
    def turning(self) -> FloatArray:
        """Turning rates about the body's axes, shape (3,), in rad/s."""
        return self._state[TURNING : TURNING + 3].copy()

    @property
    def thrusts(self) -> FloatArray:
        """Thrust of every thruster, shape (n,), in newtons."""
        return self._thrusts.copy()

    @property
    def heading(self) -> float:
        """True heading, clockwise from north, -pi to pi."""
        forward = self.pose.rotation[:, 0]
        return math.atan2(forward[1], forward[0])

    @property
    def lapsed(self) -> bool:
        """True if no stick positions have come for `lapse` seconds."""
        return self._time - self._heard >= self.lapse - 1e-9

    def step(self, sticks: StickPositions | None, dt: float) -> None:
        """Send stick positions, or none, and advance by `dt` seconds.

        Raises `OptionError` if `dt` is not positive, or a position is no number.
        """
        if not dt > 0.0:
            raise OptionError(f"vehicle: step of {dt:g} s; it must be positive")
        if sticks is not None:
            parts = (sticks.forward, sticks.right, sticks.down, sticks.yaw)
            if not all(map(math.isfinite, parts)):
                raise OptionError(f"vehicle: sticks {list(parts)}; every part must be a number")
            x, y, down, r = (round(1000 * min(max(part, -1.0), 1.0)) for part in parts)
            # The vertical axis of MANUAL_CONTROL has half the range of the others.
            asked = self.model.sticks.asked(x, y, 500 - round(0.5 * down), r)
            self._coming.append((self._time + self.latency, np.array(asked)))
        end = self._time + dt
        while self._time < end:
            self._take_what_has_come()
            # Until the stick positions in force change.
            arrives = self._coming[0][0] if self._coming else end
            lapses = self._heard + self.lapse
            self._fly(min(end, arrives, lapses if lapses > self._time + 1e-9 else end))
        self._take_what_has_come()

    def telemetry(self) -> Telemetry:
        """Return the present readings of the sensors."""
        r = self.pose.rotation
        truth = (
            float(self._state[POSITION + 2]),
            self.heading,
            math.atan2(r[2, 1], r[2, 2]),
            -math.asin(min(max(r[2, 0], -1.0), 1.0)),
        )
        depth, heading, roll, pitch = (
            reading.of(value, self._time)
            for reading, value in zip(self._readings, truth, strict=True)
        )
        return Telemetry(depth, math.remainder(heading, 2.0 * math.pi), roll, pitch)

    def _engage(self) -> None:
        """Hold the present depth and heading."""
        self._memory[:] = 0.0
        self._memory[DEPTH] = self._state[POSITION + 2]
        self._memory[HEADING] = self.heading
        self._memory[SINCE_TURN] = math.inf

    def _take_what_has_come(self) -> None:
        while self._coming and self._coming[0][0] <= self._time + 1e-12:
            self._heard, self._effort = self._coming.popleft()

    def _fly(self, end: float) -> None:
        duration = end - self._time
        n = max(1, math.ceil(duration * RATE - 1e-6))
        still = self.lapsed or not (self.obeys and self.armed)
        fly(
            self._state,
            self._thrusts,
            self._memory,
            _STILL if still else self._effort,
            self._time,
            duration / n,
            n,
            self._pilot if self.armed else self._idle,
            self._body,
            self._flow,
            self._work,
        )
        if not self.armed:
            self._engage()
        self._time = end


def pack_body(model: VehicleModel) -> Body:
    """Return hull and thrusters of a model for kernels."""
    hull = np.zeros((N_ROWS, 6))
    hull[0] = (model.mass, model.mass, model.mass, *model.inertia)
    hull[1:4] = model.added_mass, model.linear_drag, model.quadratic_drag
    displaced = model.buoyancy / GRAVITY
    hull[4] = (model.weight, model.buoyancy, *model.centre_of_buoyancy, displaced)
    return Body(hull, model.allocation(), float(model.curve.lag))


def state_at(world_from_body: SE3) -> FloatArray:
    """Return the state, shape (13,), of a body at rest at a pose."""
    state = np.zeros(N_STATE)
    state[:3] = world_from_body.translation
    state[3:7] = _quaternion(world_from_body.rotation)
    return state


def pose_of(state: FloatArray) -> SE3:
    """Return world_from_body of a state, shape (13,)."""
    turn = python_of(turn_of)(state.tolist())
    return SE3(np.array(turn), state[:3].copy())


def _quaternion(rotation: FloatArray) -> FloatArray:
    """Return (w, x, y, z) of a rotation, from its rotation vector."""
    rotvec = rotvec_from_rotation(rotation)
    angle = float(np.linalg.norm(rotvec))
    if angle < 1e-12:
        return np.array([1.0, 0.0, 0.0, 0.0])
    return np.concatenate([[math.cos(angle / 2.0)], math.sin(angle / 2.0) / angle * rotvec])
