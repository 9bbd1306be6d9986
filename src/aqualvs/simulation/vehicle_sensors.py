"""What a simulated vehicle tells of itself: depth and attitude, with the faults of sensors."""

import math
from dataclasses import dataclass, field

import numpy as np

from aqualvs.errors import OptionError


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensor:
    """Faults of a sensor, in the unit of what it senses.

    Attributes
    ----------
    noise : float
        Standard deviation of a reading by itself.
    bias : float
        Constant error.
    wander, wander_time : float
        Standard deviation of a slow error, and the time in seconds in which it forgets itself
        (first-order Gauss-Markov).
    rate : float
        Readings a second.
    """

    noise: float = 0.0
    bias: float = 0.0
    wander: float = 0.0
    wander_time: float = 30.0
    rate: float = 10.0

    def __post_init__(self) -> None:
        if not (min(self.noise, self.wander) >= 0.0 and min(self.wander_time, self.rate) > 0.0):
            raise OptionError(
                f"sensor: noise {self.noise:g}, wander {self.wander:g}, wander time "
                f"{self.wander_time:g} s, rate {self.rate:g} Hz; the first two are 0 or more, the "
                "others positive"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensors:
    """All sensors of a vehicle.

    Attributes
    ----------
    depth : Sensor
        Metres. The default noise is a Bar30's with the sea on top.
    heading, tilt : Sensor
        Radians; tilt is roll and pitch.
    """

    depth: Sensor = field(default_factory=lambda: Sensor(noise=0.005))
    heading: Sensor = field(
        default_factory=lambda: Sensor(noise=math.radians(0.2), wander=math.radians(1.0))
    )
    tilt: Sensor = field(default_factory=lambda: Sensor(noise=math.radians(0.2)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Telemetry:
    """What the vehicle tells, as MAVLink would carry it.

    Attributes
    ----------
    time_s : float
        When it was read, in the vehicle's time.
    armed : bool
    obeys : bool
        Whether it is in a mode in which it takes efforts.
    lapsed : bool
        Whether no effort has come for so long that it holds still by itself.
    depth : float
        Metres, down positive.
    heading, roll, pitch : float
        Radians; heading clockwise from north, -pi to pi.
    """

    time_s: float
    armed: bool
    obeys: bool
    lapsed: bool
    depth: float
    heading: float
    roll: float
    pitch: float


class Reading:
    """One sensor over time.

    Parameters
    ----------
    sensor : Sensor
        Its faults.
    rng : Generator
        Source of its noise.
    """

    def __init__(self, sensor: Sensor, rng: np.random.Generator) -> None:
        self._sensor = sensor
        self._rng = rng
        self._slow = sensor.wander * rng.normal()
        self._due = 0.0
        self._last_s = 0.0
        self._value = math.nan

    def of(self, truth: float, time_s: float) -> float:
        """Return the latest reading; a new one where one is due."""
        if time_s >= self._due - 1e-9:
            sensor = self._sensor
            left = math.exp(-(time_s - self._last_s) / sensor.wander_time)
            fresh = sensor.wander * math.sqrt(1.0 - left * left)
            self._slow = left * self._slow + fresh * self._rng.normal()
            error = sensor.bias + self._slow + sensor.noise * self._rng.normal()
            self._value, self._last_s = truth + error, time_s
            self._due = (math.floor(time_s * sensor.rate + 1e-6) + 1.0) / sensor.rate
        return self._value
