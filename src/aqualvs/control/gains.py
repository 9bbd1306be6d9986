"""What a controller must know: the vehicle it steers, and how hard to steer it."""

import math
from dataclasses import dataclass, fields

from aqualvs.control.gains_thrust import ThrustMap
from aqualvs.errors import OptionError


@dataclass(frozen=True, slots=True)
class Drag:
    """Resistance of the water: linear * v + quadratic * v |v|, in newtons for m/s."""

    linear: float
    quadratic: float

    def force(self, speed: float) -> float:
        """Return the force that keeps a speed, in newtons."""
        return speed * (self.linear + self.quadratic * abs(speed))

    def slope(self, speed: float) -> float:
        """Return the force that a change of a speed takes, in newtons for m/s."""
        return self.linear + 2.0 * self.quadratic * abs(speed)

    def speed(self, force: float) -> float:
        """Return the speed that a force keeps, in m/s."""
        root = math.sqrt(self.linear**2 + 4.0 * self.quadratic * abs(force))
        return 0.0 if force == 0.0 else 2.0 * force / (self.linear + root)


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleFacts:
    """What is taken for granted of a vehicle.

    Attributes
    ----------
    name : str
    mass : float
        Of the vehicle and the water that moves with it, forward, in kg.
    forward_drag, right_drag : Drag
    thrust : ThrustMap
    turning_rate, climb_rate : float
        At effort 1, in rad/s and m/s.
    dome_forward : float
        Distance of the dome's centre ahead of the vehicle's, in metres.
    """

    name: str
    mass: float
    forward_drag: Drag
    right_drag: Drag
    thrust: ThrustMap
    turning_rate: float
    climb_rate: float
    dome_forward: float = 0.0

    def __post_init__(self) -> None:
        """Refuse a vehicle that cannot exist.

        Raises
        ------
        OptionError
            If a number is not positive.
        """
        _check_positive(self, f"vehicle {self.name}", ("mass", "turning_rate", "climb_rate"))
        for drag in (self.forward_drag, self.right_drag):
            if not (drag.linear >= 0.0 and drag.quadratic >= 0.0 and sum(_pair(drag)) > 0.0):
                raise OptionError(
                    f"vehicle {self.name}: drag {drag.linear:g} and {drag.quadratic:g}; 0 or "
                    "more, and one of them positive"
                )

    @property
    def can_sway(self) -> bool:
        """Whether it moves sideways without turning."""
        return self.thrust.right > 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeGains:
    """Of the cascade that holds the range.

    Attributes
    ----------
    position : float
        Speed asked for by an error of the range, in m/s per m.
    speed : float
        Acceleration asked for by an error of the speed, in m/s² per m/s.
    integral : float
        Acceleration by that error and second, in m/s² per m.
    greatest_speed : float
        Asked for towards and away from the target, in m/s.
    ramp_speed, ramp_acceleration : float
        With which a new setpoint is approached, in m/s and m/s².
    jerk : float
        Greatest change of the acceleration asked for, per second. What it holds back comes late:
        with 8 the pitch of a BlueROV2 Heavy, which thrust below its centre moves, swings up.
    lag : float
        Time from an effort until pictures show it, in seconds: so much later a setpoint's change
        is expected to be seen.
    crossing_impulse, crossing_share : float
        Thrust across the thrusters' dead band that must be owed before it is crossed: as share of
        the full thrust, summed over seconds, or at once. 0 crosses at every change of sign.
    swell : float
        Share by which `speed` is greater for errors that swing with the swell's period; 0 for
        calm water.
    swell_period, swell_damping : float
        In seconds, and the width of the band over its middle, halved.
    """

    position: float
    speed: float
    integral: float
    lag: float
    greatest_speed: float = 0.25
    ramp_speed: float = 0.15
    ramp_acceleration: float = 0.12
    jerk: float = 30.0
    crossing_impulse: float = 0.0175
    crossing_share: float = 0.4
    swell: float = 0.0
    swell_period: float = 5.0
    swell_damping: float = 0.15

    def __post_init__(self) -> None:
        """Refuse gains that are not positive; integral and swell may be 0.

        Raises
        ------
        OptionError
            Naming the first.
        """
        free = ("integral", "lag", "swell", "crossing_impulse", "crossing_share")
        _check_positive(self, "range", [f.name for f in fields(self) if f.name not in free])
        _check_not_negative(self, "range", free)


@dataclass(frozen=True, slots=True, kw_only=True)
class YawGains:
    """Of the loop that holds the yaw.

    Attributes
    ----------
    proportional : float
        Turning rate by the yaw's error, in rad/s per rad.
    integral : float
        Turning rate by error and second, in rad/s² per rad: what a curved target asks for.
    derivative : float
        Turning rate by the yaw's rate; 0 or more.
    greatest_rate : float
        Turning rate, in rad/s.
    ramp_rate, ramp_acceleration : float
        With which a new setpoint is approached, in rad/s and rad/s².
    acceleration : float
        Greatest change of the turning rate asked for, in rad/s².
    lag : float
        As of the range.
    quiet_rate : float
        Turning rate below which none is begun, in rad/s.
    """

    proportional: float
    integral: float
    lag: float
    derivative: float = 0.0
    greatest_rate: float = math.radians(30.0)
    ramp_rate: float = math.radians(15.0)
    ramp_acceleration: float = math.radians(15.0)
    acceleration: float = math.radians(200.0)
    quiet_rate: float = math.radians(0.8)

    def __post_init__(self) -> None:
        """Refuse gains that are not positive; integral, derivative and lag may be 0.

        Raises
        ------
        OptionError
            Naming the first.
        """
        free = ("integral", "derivative", "lag", "quiet_rate")
        _check_positive(self, "yaw", [f.name for f in fields(self) if f.name not in free])
        _check_not_negative(self, "yaw", free)


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlGains:
    """All that a controller needs for one vehicle.

    Attributes
    ----------
    vehicle : VehicleFacts
    range : RangeGains
    yaw : YawGains
    rate_time : float
        Time constant in seconds of the filters on differences, where no time filter gives rates.
    memory : float
        Seconds for which a stopped controller remembers the disturbance it had found.
    """

    vehicle: VehicleFacts
    range: RangeGains
    yaw: YawGains
    rate_time: float = 0.1
    memory: float = 10.0

    def __post_init__(self) -> None:
        """Refuse times that are not positive.

        Raises
        ------
        OptionError
            Naming the first.
        """
        _check_positive(self, "controller", ("rate_time", "memory"))


def gain_schedule(gains: RangeGains, damping: float) -> tuple[float, float]:
    """Return the factors on speed's gain and integral of the range where drag damps the vehicle.

    Parameters
    ----------
    gains : RangeGains
    damping : float
        Slope of the drag over mass, in 1/s.
    """
    relative = damping / gains.speed
    return (
        min(1.0 + _DAMPING_SHARE * relative, _GREATEST_SCHEDULE),
        min(1.0 + _INTEGRAL_SHARE * relative, _GREATEST_INTEGRAL),
    )


# Drag damps as the speed's gain does, but what is known of it may be twice the truth. The limit is
# for that too: with 3, thrust makes a BlueROV2 Heavy in 0.45 m/s pitch ever more.
_DAMPING_SHARE, _GREATEST_SCHEDULE = 0.8, 2.2
# Drag makes the loop stiff in position; the integral has to keep up with that, or it takes 10 s to
# find the force of a strong current.
_INTEGRAL_SHARE, _GREATEST_INTEGRAL = 1.2, 6.0


def _check_positive(owner: object, what: str, names: tuple[str, ...] | list[str]) -> None:
    for name in names:
        value = getattr(owner, name)
        if not (value > 0.0 and math.isfinite(value)):
            raise OptionError(f"{what}, {name} {value:g}: must be positive")


def _check_not_negative(owner: object, what: str, names: tuple[str, ...]) -> None:
    for name in names:
        value = getattr(owner, name)
        if not (value >= 0.0 and math.isfinite(value)):
            raise OptionError(f"{what}, {name} {value:g}: must be 0 or more")


def _pair(drag: Drag) -> tuple[float, float]:
    return drag.linear, drag.quadratic
