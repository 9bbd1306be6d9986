"""Controller gains, facts about the vehicle that they are for, and the map from force to effort.

Controllers compute forces; thrusters have a dead band and a curved response. `ThrustMap` inverts
the response, and `DeadBandCrossing` crosses the dead band with hysteresis.
"""

import math
from dataclasses import dataclass
from enum import StrEnum

from aqualvs.control.vehicle import clipped
from aqualvs.errors import OptionError, check_not_negative, check_positive


class Layout(StrEnum):
    """Arrangement of the horizontal thrusters."""

    VECTORED = "vectored"
    """Askew, in two pairs: one does forward plus right, the other forward minus right."""
    STRAIGHT = "straight"
    """Forward and sideways have thrusters of their own, or there are none sideways."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ThrustMap:
    """Thrust over effort, and back.

    Beyond the dead band thrust is full * (linear x + (1 - linear) x²), x being the rest of the
    effort's travel.
    """

    # Thrust at effort 1 along the axis alone, in newtons; `right` is 0 where the vehicle cannot
    # move sideways.
    forward: float
    backward: float
    right: float
    dead_band: float = 0.0  # Effort below which nothing happens.
    linear: float = 1.0  # Share of the curve that is straight.
    layout: Layout = Layout.VECTORED  # Of the level thrusters.

    def __post_init__(self) -> None:
        """Raise `OptionError` if a thrust is not positive or a share none: no inverse exists."""
        if not (min(self.forward, self.backward) > 0.0 and self.right >= 0.0):
            raise OptionError(
                f"thrust: forward {self.forward:g}, backward {self.backward:g}, right "
                f"{self.right:g} N; the first two are positive, the last 0 or more"
            )
        if not (0.0 <= self.dead_band < 1.0 and 0.0 < self.linear <= 1.0):
            raise OptionError(
                f"thrust: dead band {self.dead_band:g}, linear {self.linear:g}; shares between 0 "
                "and 1"
            )

    def effort(self, share: float) -> float:
        """Return the effort for a share of the full thrust, both -1 to 1."""
        size, bent = min(abs(share), 1.0), 1.0 - self.linear
        if not size > 0.0:
            return 0.0
        # Root of bent x² + linear x = size, in the form that is valid for bent = 0.
        x = 2.0 * size / (self.linear + math.sqrt(self.linear**2 + 4.0 * bent * size))
        return math.copysign(self.dead_band + (1.0 - self.dead_band) * x, share)

    def share(self, effort: float) -> float:
        """Return the share of the full thrust that an effort gives, both -1 to 1."""
        x = (min(abs(effort), 1.0) - self.dead_band) / (1.0 - self.dead_band)
        if x <= 0.0:
            return 0.0
        return math.copysign(x * (self.linear + (1.0 - self.linear) * x), effort)

    def shares(self, forward: float, right: float) -> tuple[float, float]:
        """Return shares of the full thrust of both pairs of thrusters for forces in newtons.

        What is beyond the thrusters is cut: sideways first, for distance matters more.
        """
        full = self.forward if forward > 0.0 else self.backward
        ahead = clipped(forward / full)
        aside = 0.0 if self.right == 0.0 else clipped(right / self.right)
        if self.layout is Layout.VECTORED:
            aside = clipped(aside, 1.0 - abs(ahead))
        return self.split(ahead, aside)

    def split(self, forward: float, right: float) -> tuple[float, float]:
        """Return the efforts of both pairs of thrusters for those forward and right."""
        if self.layout is Layout.STRAIGHT:
            return forward, right
        return forward + right, forward - right

    def joined(self, one: float, other: float) -> tuple[float, float]:
        """Return efforts forward and right for those of both pairs of thrusters."""
        if self.layout is Layout.STRAIGHT:
            return one, other
        return 0.5 * (one + other), 0.5 * (one - other)

    def forces(self, forward: float, right: float) -> tuple[float, float]:
        """Return the forces in newtons that two efforts give together."""
        ahead, aside = self.joined(*map(self.share, self.split(forward, right)))
        return ahead * (self.forward if ahead > 0.0 else self.backward), aside * self.right


class DeadBandCrossing:
    """Effort of one pair of thrusters, whose dead band is crossed once, with hysteresis.

    Where the thrust asked for changes its sign, the effort waits at the edge of the dead band, with
    the thrusters about to start, until the impulse that it owes is great, or the thrust is. What
    is owed is taken off the thrust that follows on the side in force: so the mean thrust is the one
    asked for, and noise about zero neither crosses nor pushes.

    `impulse`: share of the full thrust, times seconds. `great`: share that crosses at once.
    """

    def __init__(self, thrust: ThrustMap, impulse: float, great: float) -> None:
        self._thrust, self._impulse, self._great = thrust, impulse, great
        self.reset()

    def reset(self) -> None:
        """Begin in the dead band, on the side asked for next."""
        self._side = self._owed = 0.0
        self._stood_s = math.inf

    @property
    def turns(self) -> bool:
        """Whether thrust waits to change its side, or has just done so."""
        # Noise of postures owes less than this share of the impulse; and thrust must stay on one
        # side for this time, in seconds, before it is more than a correction of the last one.
        waiting_share, stands_s = 1.0 / 3.0, 2.0
        waits = abs(self._owed) > waiting_share * self._impulse
        return waits or (self._stood_s < stands_s and self._impulse > 0.0)

    def effort(self, share: float, step: float) -> float:
        """Return the effort for a share of the full thrust, `step` seconds after the last one."""
        if not self._side and share:
            self._side = math.copysign(1.0, share)
        self._stood_s += step
        owed = self._owed + share * step
        if share * self._side <= 0.0 and not step > 0.0:
            return self._edge()
        if owed * self._side < 0.0:
            if abs(owed) <= self._impulse and abs(share) < self._great:
                self._owed = owed
                return self._edge()
            # Delayed thrust is dropped: the loop requests it again if it is still needed.
            self._side, self._stood_s, owed = -self._side, 0.0, share * step
        self._owed = 0.0
        given = owed / step if step > 0.0 else share
        return self._thrust.effort(given) if given * self._side > 0.0 else self._edge()

    def _edge(self) -> float:
        return self._side * self._thrust.dead_band


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

    def coasting_speed(self, way: float, seconds: float, mass: float) -> float:
        """Return the speed from which a mass in kg coasts so many metres in a time."""
        max_exponent = 50.0  # Keeps exponentials finite.
        share, rate = self.quadratic / mass, self.linear / mass
        grown = math.expm1(min(share * way, max_exponent)) / share if share else way
        slowed = -math.expm1(-rate * seconds) / rate if rate else seconds
        return grown / slowed

    def speed(self, force: float) -> float:
        """Return the speed that a force keeps, in m/s."""
        root = math.sqrt(self.linear**2 + 4.0 * self.quadratic * abs(force))
        return 0.0 if force == 0.0 else 2.0 * force / (self.linear + root)


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleFacts:
    """Assumed properties of a vehicle."""

    name: str
    mass: float  # Of the vehicle and the water that moves with it, forward, in kg.
    forward_drag: Drag
    right_drag: Drag
    thrust: ThrustMap
    # At effort 1, in rad/s and m/s.
    turning_rate: float
    climb_rate: float
    dome_forward: float = 0.0  # Distance of the dome's centre ahead of the vehicle's, in metres.

    def __post_init__(self) -> None:
        """Raise `OptionError` if a number is not positive."""
        check_positive(f"vehicle {self.name}", self, "mass", "turning_rate", "climb_rate")
        for drag in (self.forward_drag, self.right_drag):
            if not (min(drag.linear, drag.quadratic) >= 0.0 < drag.linear + drag.quadratic):
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
    """Gains of the cascade that holds the range."""

    position: float  # Speed asked for by an error of the range, in m/s per m.
    speed: float  # Acceleration asked for by an error of the speed, in m/s² per m/s.
    integral: float  # Acceleration by that error and second, in m/s² per m.
    # Time from an effort until pictures show it, in seconds: so much later a setpoint's change is
    # expected to be seen.
    lag: float
    greatest_speed: float = 0.25  # Asked for towards and away from the target, in m/s.
    ramp_speed: float = 0.15  # With which a new setpoint is approached, in m/s and m/s².
    # In place of `ramp_speed` towards the target, where that is faster, in m/s: for vehicles that
    # coast far when the picture stands still and thrust ends.
    approach_speed: float = 0.15
    ramp_acceleration: float = 0.12  # As `ramp_speed`.
    # Greatest change of the acceleration asked for, per second. What it holds back comes late: with
    # 8 the pitch of a BlueROV2 Heavy, which thrust below its centre moves, swings up.
    jerk: float = 30.0
    # Thrust across the thrusters' dead band that must be owed before it is crossed: as share of the
    # full thrust, summed over seconds, or at once. 0 crosses at every change of sign.
    crossing_impulse: float = 0.0175
    crossing_share: float = 0.4
    # Share by which `speed` is greater for errors that swing with the swell's period; 0 for calm
    # water.
    swell: float = 0.0
    # In seconds, and the width of the band over its middle, halved.
    swell_period: float = 5.0
    swell_damping: float = 0.15

    def __post_init__(self) -> None:
        """Raise `OptionError` naming the first gain that is negative, or 0 where it must not be."""
        free = ("integral", "lag", "swell", "crossing_impulse", "crossing_share")
        check_positive("range", self, *(name for name in self.__slots__ if name not in free))
        check_not_negative("range", self, *free)


@dataclass(frozen=True, slots=True, kw_only=True)
class YawGains:
    """Gains of the loop that holds the yaw."""

    proportional: float  # Turning rate by the yaw's error, in rad/s per rad.
    # Turning rate by error and second, in rad/s² per rad: what a curved target asks for.
    integral: float
    lag: float  # As of the range.
    derivative: float = 0.0  # Turning rate by the yaw's rate; 0 or more.
    greatest_rate: float = math.radians(30.0)  # Turning rate, in rad/s.
    # With which a new setpoint is approached, in rad/s and rad/s².
    ramp_rate: float = math.radians(15.0)
    ramp_acceleration: float = math.radians(15.0)
    # Greatest change of the turning rate asked for, in rad/s².
    acceleration: float = math.radians(200.0)
    quiet_rate: float = math.radians(0.8)  # Turning rate below which no turn begins, in rad/s.

    def __post_init__(self) -> None:
        """Raise `OptionError` naming the first gain that is negative, or 0 where it must not be."""
        free = ("integral", "derivative", "lag", "quiet_rate")
        check_positive("yaw", self, *(name for name in self.__slots__ if name not in free))
        check_not_negative("yaw", self, *free)


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlGains:
    """All that a controller needs for one vehicle."""

    vehicle: VehicleFacts
    range: RangeGains
    yaw: YawGains
    # Time constant in seconds of the filters on differences, where no time filter gives rates.
    rate_time: float = 0.1
    # Seconds for which a stopped controller remembers the disturbance it had found.
    memory: float = 10.0

    def __post_init__(self) -> None:
        """Raise `OptionError` naming the first time that is not positive."""
        check_positive("controller", self, "rate_time", "memory")


def gain_schedule(gains: RangeGains, damping: float) -> tuple[float, float]:
    """Return the factors on speed's gain and integral of the range where drag damps the vehicle.

    `damping`: slope of the drag over mass, in 1/s.
    """
    # Drag damps like the speed's gain, but its assumed value may be twice the truth. The limit
    # allows for that, and for pitch: with 3, thrust makes a BlueROV2 Heavy in 0.45 m/s pitch ever
    # more.
    damping_share, max_schedule = 0.8, 2.2
    relative = damping / gains.speed
    return (
        min(1.0 + damping_share * relative, max_schedule),
        min(1.0 + _INTEGRAL_SHARE * relative, _MAX_INTEGRAL),
    )


# Drag makes the loop stiff in position; without a greater gain, the integral takes 10 s to find the
# force of a strong current.
_INTEGRAL_SHARE, _MAX_INTEGRAL = 1.2, 6.0
