"""Small remotely operated vehicles to simulate: hull, thrusters, and their own autopilot.

Body axes are forward, right, down (FRD) from the centre of gravity; hydrodynamics are diagonal, as
all three sources have them. The vehicles are fully under water.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias, TypeVar, cast

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.linear_algebra import Vec
from aqualvs.geometry.transforms import SE3
from aqualvs.simulation.vehicle.water_motion import GRAVITY

Six: TypeAlias = tuple[float, float, float, float, float, float]
Numbers = TypeVar("Numbers", Vec, Six)

_COS45 = math.sqrt(0.5)
# Least share of a thruster's unit force or lever in a motion that it takes part in.
_TAKES_PART = 0.2
# Columns of the mixing table.
ROLL, PITCH, YAW, DOWN, FORWARD, RIGHT = range(6)


@dataclass(frozen=True, slots=True)
class Thruster:
    """Thruster of a vehicle."""

    position: Vec  # In body axes, in metres.
    direction: Vec  # Unit vector of its force on the vehicle when it runs forward.


@dataclass(frozen=True, slots=True, kw_only=True)
class ThrustCurve:
    """Thrust over command, and its lag.

    Beyond the dead band the thrust is greatest * (linear x + (1 - linear) x²), where x is the share
    of the remaining travel.
    """

    # Greatest thrust either way, in newtons. The defaults are a T200's at 14 V, 4.52 and 3.52 kgf
    # (Blue Robotics' chart; 5.25 and 4.10 kgf at 16 V).
    forward: float = 44.3
    reverse: float = 34.5
    dead_band: float = 0.07  # Share of the command's travel without thrust. 0.07 is 28 of 400 µs.
    # 0.6 follows the same chart at 12 V within 3 % of the greatest thrust, both ways.
    linear: float = 0.6
    # Time constant in seconds; 0.1 is a round number for a small propeller, not measured.
    lag: float = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class StickInput:
    """Response of the vehicle to stick positions, as of ArduSub 4.5 and later to MANUAL_CONTROL.

    Its parameters are RCn_MIN 1100 and RCn_MAX 1900 us and, except for those below, ArduSub's after
    a reset. No axis has an expo.
    """

    gain: float = 0.5  # Pilot gain (JS_GAIN_DEFAULT): share of the full range at full stick.
    # At a pulse of 1900 us, in rad/s. ArduSub: 45 degrees times ACRO_YAW_P, 3.375 a second.
    turning_rate: float = math.radians(45.0) * 3.375
    # Greatest, in m/s. ArduSub's PILOT_SPEED_UP is 5 m/s by default, which none of these vehicles
    # reaches; 0.5 is a pilot's choice.
    climb_rate: float = 0.5
    yaw_dead_zone: int = 40  # RC4_DZ, in microseconds; shrinks with the gain, as the next one.
    throttle_dead_zone: int = 100  # THR_DZ, in thousandths of the throttle's travel.
    # RC4_TRIM (yaw), RC5_TRIM (forward) and RC6_TRIM (right), in microseconds.
    trims: tuple[int, int, int] = (1500, 1500, 1500)

    def __post_init__(self) -> None:
        if not 0.0 < self.gain <= 1.0:
            raise OptionError(f"sticks: gain {self.gain:g}; choose more than 0, at most 1")

    def asked(self, x: int, y: int, z: int, r: int) -> tuple[float, float, float, float]:
        """Return the request (forward, right, down, turn) of stick positions in depth hold.

        These are shares of the thrusters' motor input, of the greatest rate of descent and of the
        greatest turning rate. The sticks are as in MANUAL_CONTROL: z from 0 (down) over 500 to
        1000 (up).
        """
        yaw_trim, *level = self.trims
        forward, right = (
            _thrust_input(_pulse(0.4 * self.gain, one), trim)
            for one, trim in zip((x, y), level, strict=True)
        )
        return forward, right, -self._climb(z), self._turn(r, yaw_trim)

    def _turn(self, r: int, trim: int) -> float:
        """Return the share of the turning rate (`pwm_to_angle_dz_trim`, whole centidegrees)."""
        beyond = _pulse(0.4 * self.gain, r) - trim
        dead = int(self.yaw_dead_zone * self.gain)
        if abs(beyond) <= dead:
            return 0.0
        travel = (_MAX_US - trim if beyond > 0 else trim - _MIN_US) - dead
        return math.copysign(int(4500 * (abs(beyond) - dead) / travel) / 4500, beyond)

    def _climb(self, z: int) -> float:
        """Return the share of the rate of climb (`get_pilot_desired_climb_rate`)."""
        # The throttle is a range of 1000 from RC3_MIN + RC3_DZ on.
        low = _MIN_US + _THROTTLE_DEAD_US
        control = int(1000 * max(_pulse(0.8 * self.gain, z - 500) - low, 0) / (_MAX_US - low))
        middle = int(1000 * (0.5 * (_MIN_US + _MAX_US) - low) / (_MAX_US - low))
        dead = self.throttle_dead_zone * self.gain
        if control < middle - dead:
            return max((control - middle + dead) / (middle - dead), -1.0)
        if control > middle + dead:
            return min((control - middle - dead) / (1000.0 - middle - dead), 1.0)
        return 0.0


_MIN_US, _MAX_US, _THROTTLE_DEAD_US = 1100, 1900, 30


def _pulse(unit_us: float, units: int) -> int:
    """Return the pulse of a stick in microseconds, cut to whole ones (`set_override`)."""
    return min(max(int(1500 + unit_us * units), _MIN_US), _MAX_US)


def _thrust_input(pulse: int, trim: int) -> float:
    """Return the share of the way from the trim to the end (`norm_input`)."""
    return (pulse - trim) / (_MAX_US - trim if pulse > trim else trim - _MIN_US)


@dataclass(frozen=True, slots=True, kw_only=True)
class Autopilot:
    """Gains of the vehicle's own loops, in ArduSub's units: motor input is -1 to 1.

    Structure and defaults of the rate loops are ArduSub's (AC_AttitudeControl_Sub.h) without its
    filters and small D terms. The outer gains are lower than its 6 and 3 a second, which leave
    these models, with their thrusters' lag, hardly damped. The heading is held no better than the
    thrusters' dead band lets it: within dead_band / (rate * angle) where nothing else loads them.
    """

    angle: float = 4.5  # Requested rate per error of the angle, in rad/s per rad.
    # Of roll, pitch, yaw: motor input per rad/s, and per rad/s and second.
    rate: Vec = (0.135, 0.135, 0.18)
    rate_integral: Vec = (0.09, 0.09, 0.018)
    depth: float = 1.0  # Requested climb rate per error of the depth, in m/s per metre.
    # Motor input per m/s, and per m/s and second.
    climb: float = 1.5
    climb_integral: float = 0.75
    input_time: float = 0.15  # Time constant of requested turning rates, in seconds (ATC_INPUT_TC).
    acceleration: float = 1.0  # Acceleration to requested climb rates, in m/s² (PILOT_ACCEL_Z).
    # Time after the last requested turn during which the held heading follows the present one, in
    # seconds (ArduSub's mode_althold.cpp).
    settle: float = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleModel:
    """Parameters of a vehicle, in SI units."""

    name: str  # Name in reports.
    mass: float  # In air, in kg.
    inertia: Vec  # About forward, right and down, in kg m².
    buoyancy: float  # In newtons; it gives the displaced mass.
    centre_of_buoyancy: Vec  # In body axes, in metres; above the centre of gravity is negative.
    # Positive, along forward, right, down and about them.
    added_mass: Six
    linear_drag: Six
    quadratic_drag: Six
    thrusters: Sequence[Thruster]  # Any number; all with the same curve.
    curve: ThrustCurve = field(default_factory=ThrustCurve)  # Of every thruster.
    sticks: StickInput = field(default_factory=StickInput)  # Response to the sticks.
    autopilot: Autopilot = field(default_factory=Autopilot)  # Gains of the vehicle's own loops.
    dome_position: Vec = (0.20, 0.0, 0.0)  # Centre of the camera's dome in body axes, in metres.
    half_size: Vec = (0.2286, 0.169, 0.127)  # Half length, width and height of the hull, in metres.

    @property
    def weight(self) -> float:
        """Weight in newtons."""
        return self.mass * GRAVITY

    @property
    def body_from_dome(self) -> SE3:
        """Pose of the dome's axes (right, forward, up) in the body's (forward, right, down)."""
        turn = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
        return SE3(turn, np.array(self.dome_position))

    def scaled(self, mass: float = 1.0, drag: float = 1.0) -> "VehicleModel":
        """Return a vehicle with other mass and drag, by these factors.

        Inertia scales with the mass. Buoyancy changes with the weight so that their difference
        stays: a vehicle is trimmed before it dives.
        """
        if not (mass > 0.0 and drag > 0.0):
            raise OptionError(
                f"vehicle {self.name}: factors {mass:g} and {drag:g}; both are positive"
            )
        return replace(
            self,
            mass=self.mass * mass,
            inertia=_scaled(self.inertia, mass),
            buoyancy=self.buoyancy + (mass - 1.0) * self.weight,
            linear_drag=_scaled(self.linear_drag, drag),
            quadratic_drag=_scaled(self.quadratic_drag, drag),
        )

    def allocation(self) -> FloatArray:
        """Return force and moment on the body by unit thrust of every thruster, shape (6, n)."""
        directions = np.array([one.direction for one in self.thrusters])
        moments = np.cross([one.position for one in self.thrusters], directions)
        return np.ascontiguousarray(np.vstack([directions.T, moments.T]))

    def mixing(self) -> FloatArray:
        """Return factors of each motor input for every thruster, shape (n, 6): -1, 0 or 1.

        Columns: roll, pitch, yaw, down, forward, right. As in ArduSub's frames, upright thrusters
        do roll, pitch and depth, level ones the rest.
        """
        table = self.allocation().T
        mix = np.zeros((len(table), 6))
        for k, (force, moment) in enumerate(zip(table[:, :3], table[:, 3:], strict=True)):
            if abs(force[2]) > _TAKES_PART:
                reach = np.abs(table[:, 3:5]).max(axis=0) + 1e-9
                mix[k, [ROLL, PITCH]] = _sign(moment[:2] / reach)
                mix[k, DOWN] = np.sign(force[2])
            else:
                reach_yaw = np.abs(table[:, 5]).max() + 1e-9
                mix[k, YAW] = _sign(moment[2] / reach_yaw)
                mix[k, [FORWARD, RIGHT]] = _sign(force[:2])
        return mix


def _sign(values: FloatArray) -> FloatArray:
    return np.where(np.abs(values) > _TAKES_PART, np.sign(values), 0.0)


def _scaled(values: Numbers, factor: float) -> Numbers:
    return cast(Numbers, tuple(factor * value for value in values))


def _level_four(x: float, y: float, z: float) -> tuple[Thruster, ...]:
    """Return motors 1 to 4 of ArduSub's vectored frames: front right and left, rear right and left.

    The front ones run in reverse to go forward.
    """
    c = _COS45
    return (
        Thruster((x, y, z), (-c, c, 0.0)),
        Thruster((x, -y, z), (-c, -c, 0.0)),
        Thruster((-x, y, z), (c, c, 0.0)),
        Thruster((-x, -y, z), (c, -c, 0.0)),
    )


BLUEROV2_HEAVY = VehicleModel(
    name="bluerov2_heavy",
    mass=13.5,
    inertia=(0.26, 0.23, 0.37),
    buoyancy=0.0134 * 1025.0 * GRAVITY,
    centre_of_buoyancy=(0.0, 0.0, -0.01),
    added_mass=(6.36, 7.12, 18.68, 0.189, 0.135, 0.222),
    linear_drag=(13.7, 0.0, 33.0, 0.0, 0.8, 0.0),
    quadratic_drag=(141.0, 217.0, 190.0, 1.19, 0.47, 1.5),
    thrusters=(
        *_level_four(0.156, 0.111, 0.085),
        Thruster((0.120, 0.218, 0.0), (0.0, 0.0, -1.0)),
        Thruster((0.120, -0.218, 0.0), (0.0, 0.0, 1.0)),
        Thruster((-0.120, 0.218, 0.0), (0.0, 0.0, 1.0)),
        Thruster((-0.120, -0.218, 0.0), (0.0, 0.0, -1.0)),
    ),
    half_size=(0.2286, 0.2875, 0.127),
)
"""BlueROV2 Heavy in seawater: von Benzon et al. 2022, doi:10.3390/jmse10121898, Table A1."""

BLUEROV2 = VehicleModel(
    name="bluerov2",
    mass=11.5,
    inertia=(0.16, 0.16, 0.16),
    buoyancy=114.8,
    centre_of_buoyancy=(0.0, 0.0, -0.02),
    added_mass=(5.5, 12.7, 14.57, 0.12, 0.12, 0.12),
    linear_drag=(4.03, 6.22, 5.18, 0.07, 0.07, 0.07),
    quadratic_drag=(18.18, 21.66, 36.99, 1.55, 1.55, 1.55),
    thrusters=(
        *_level_four(0.1355, 0.1, 0.01),
        Thruster((0.0, 0.1105, 0.0), (0.0, 0.0, -1.0)),
        Thruster((0.0, -0.1105, 0.0), (0.0, 0.0, 1.0)),
    ),
)
"""BlueROV2 with six thrusters: Wu 2018, "6-DoF modelling and control of a remotely operated
vehicle", Flinders University.

Only buoyancy stabilises its pitch. Its level thrusters are placed 10 mm below the centre of
gravity, not about 70 mm: with that and a centre of buoyancy 20 mm up, half of the thrust would turn
the model over. Above about 0.5 m/s ahead its pitch is unstable nevertheless: the Munk moment of the
added mass exceeds the righting moment.
"""

VIDEORAY = VehicleModel(
    name="videoray",
    mass=3.6,
    inertia=(0.028, 0.041, 0.043),
    buoyancy=3.6 * GRAVITY + 0.3,
    centre_of_buoyancy=(0.0, 0.0, -0.03),
    added_mass=(1.94, 6.05, 3.95, 0.012, 0.012, 0.0118),
    linear_drag=(0.95, 5.87, 3.70, 0.023, 0.023, 0.023),
    quadratic_drag=(6.04, 30.73, 26.36, 0.45, 0.45, 0.45),
    thrusters=(
        Thruster((-0.10, 0.085, 0.0), (1.0, 0.0, 0.0)),
        Thruster((-0.10, -0.085, 0.0), (1.0, 0.0, 0.0)),
        Thruster((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    ),
    curve=ThrustCurve(forward=5.7, reverse=4.3, lag=0.15),
    autopilot=Autopilot(angle=2.0, rate=(0.0, 0.0, 0.6), rate_integral=(0.0, 0.0, 0.05), climb=2.0),
    dome_position=(0.12, 0.0, 0.0),
    half_size=(0.1525, 0.1125, 0.105),
)
"""Like a VideoRay Pro III: two level thrusters and an upright one, no sway.

Added mass and drag of surge, sway, heave and yaw: Wang & Clark 2006, "Modeling and simulation of
the VideoRay Pro III underwater vehicle", OCEANS Asia Pacific, and W. Wang's
thesis, as K. DeMarco's `videoray_pro_3_params.m` (SyllogismRXS/syllo-ros) quotes them. Chosen, not
measured: inertias of a box of that mass and size, roll and pitch as yaw, buoyancy, and thrusts
that reach 1.3 m/s. It has ArduSub's loops (frame SimpleROV-3) in place of its own.
"""

VEHICLES = {model.name: model for model in (BLUEROV2_HEAVY, BLUEROV2, VIDEORAY)}
"""All models by name."""
