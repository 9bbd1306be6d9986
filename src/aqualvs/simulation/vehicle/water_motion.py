"""Motion of the water around a simulated vehicle, and the force of its tether.

The world is north, east, down (NED) with its origin at the still surface. A current is the same
everywhere and wanders slowly; waves are linear (Airy) waves in deep water, whose motion fades
with depth as exp(-k z); k = omega² / g. They hold where the water is deeper than half a wavelength
and the waves are not steep.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.compiled import inline_borrowing_kernel
from aqualvs.geometry.linear_algebra import Vec

GRAVITY = 9.81
"""In m/s²."""
# Columns of the tables: of waves, and of the wandering current.
_OMEGA, _NUMBER, _NORTH, _EAST, _HEIGHT, _PHASE, _WAVE_COLUMNS = range(7)
_DRIFT_NORTH, _DRIFT_EAST, _DRIFT_COLUMNS = 2, 3, 4
_DRIFT_TERMS = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class Waves:
    """Surface waves."""

    # Half the height from trough to crest, in metres. Irregular waves have the same mean square.
    amplitude: float
    period: float = 5.0  # In seconds; of irregular waves the middle one.
    direction: float = 0.0  # Direction of propagation, in radians clockwise from north.
    n: int = 1  # Number of sine waves; 1 is a regular swell.
    # Periods of irregular waves are spread evenly over this share of the period to either side,
    # directions at random over as many radians.
    spread: float = 0.25

    def __post_init__(self) -> None:
        # Steeper waves break (Stokes' limit is 0.44 for amplitude times wave number).
        steepest = 0.44
        if not (self.amplitude >= 0.0 and self.period > 0.0 and self.n >= 1):
            raise OptionError(
                f"waves: amplitude {self.amplitude:g} m, period {self.period:g} s, n {self.n}; "
                "amplitudes are 0 or more, periods positive, and there is at least one wave"
            )
        number = (2.0 * math.pi / self.period) ** 2 / GRAVITY
        if self.amplitude * number > steepest:
            raise OptionError(
                f"waves: amplitude {self.amplitude:g} m at a period of {self.period:g} s would "
                f"break; choose at most {steepest / number:.2f} m"
            )

    def table(self, rng: np.random.Generator) -> FloatArray:
        """Return one row for each sine wave, shape (n, 6), phases from `rng`."""
        rows = np.zeros((self.n, _WAVE_COLUMNS))
        share = np.linspace(-1.0, 1.0, self.n) if self.n > 1 else np.zeros(1)
        aside = rng.uniform(-1.0, 1.0, self.n) if self.n > 1 else np.zeros(1)
        rows[:, _OMEGA] = 2.0 * np.pi / (self.period * (1.0 + self.spread * share))
        rows[:, _NUMBER] = rows[:, _OMEGA] ** 2 / GRAVITY
        way = self.direction + self.spread * aside
        rows[:, _NORTH], rows[:, _EAST] = np.cos(way), np.sin(way)
        rows[:, _HEIGHT] = self.amplitude / math.sqrt(self.n)
        rows[:, _PHASE] = rng.uniform(0.0, 2.0 * np.pi, self.n)
        return rows


@dataclass(frozen=True, slots=True, kw_only=True)
class Tether:
    """A neutrally buoyant cable from a fixed point at the surface straight down to the vehicle.

    Each element of it has the drag of a cylinder across the flow; the force at the vehicle's end
    follows from the balance of moments about the upper end; the cable's velocity falls linearly to
    zero at that end.
    """

    length: float = 0.0  # In the water, in metres; 0 is no drag.
    diameter: float = 0.0076  # In metres; 7.6 mm is Blue Robotics' Fathom tether.
    # Drag coefficient across the flow; about 1.2 for a smooth cylinder at these Reynolds numbers.
    drag: float = 1.2
    # On the vehicle, in body axes (forward, right, down), in metres.
    attached_at: Vec = (-0.15, 0.0, -0.05)
    # Steady pull beside the drag, in world axes (north, east, down), in newtons.
    pull: Vec = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class WaterMotion:
    """Motion of the water: current, waves, and the tether that they move."""

    # Mean velocity of the water in world axes (north, east, down), in m/s.
    current: Vec = (0.0, 0.0, 0.0)
    # Standard deviation of the current's slow changes, in m/s along north and along east each, and
    # their period, in seconds.
    wander: float = 0.0
    wander_period: float = 40.0
    waves: Waves | None = None  # None for calm water.
    tether: Tether = field(default_factory=Tether)  # Drags and pulls at the vehicle.
    density: float = 1025.0  # In kg/m³.
    seed: int = 0  # Seed of the phases of waves and wander.

    def pack(self) -> "Flow":
        """Return the water for kernels; the same seed gives the same water."""
        rng = np.random.default_rng([self.seed, 61])
        waves = self.waves.table(rng) if self.waves else np.zeros((0, _WAVE_COLUMNS))
        tether = self.tether
        thickness = 0.5 * self.density * tether.drag * tether.diameter
        line = np.array([thickness * tether.length, *tether.attached_at, *tether.pull], np.float64)
        return Flow(np.array(self.current, dtype=np.float64), self._drift(rng), waves, line)

    def _drift(self, rng: np.random.Generator) -> FloatArray:
        """Return a few slow sine waves along north and along east, shape (2 * _DRIFT_TERMS, 4)."""
        if self.wander == 0.0:
            return np.zeros((0, _DRIFT_COLUMNS))
        rows = np.zeros((2 * _DRIFT_TERMS, _DRIFT_COLUMNS))
        rows[:, 0] = 2.0 * np.pi / (self.wander_period * rng.uniform(0.5, 2.0, len(rows)))
        rows[:, 1] = rng.uniform(0.0, 2.0 * np.pi, len(rows))
        size = self.wander * math.sqrt(2.0 / _DRIFT_TERMS)
        rows[:_DRIFT_TERMS, _DRIFT_NORTH] = size
        rows[_DRIFT_TERMS:, _DRIFT_EAST] = size
        return rows


class Flow(NamedTuple):
    """Numbers of `WaterMotion`, for kernels."""

    current: FloatArray  # Shape (3,): as there.
    drift: FloatArray  # Shape (m, 4): angular frequency, phase, amplitudes along north and east.
    # Shape (n, 6): angular frequency, wave number, direction as north and east, amplitude, phase.
    waves: FloatArray
    # Shape (7,): of the tether: half density times drag times area; where it is attached; its pull.
    line: FloatArray


@inline_borrowing_kernel
def stream_at(t: float, flow: Flow) -> tuple[Vec, Vec]:
    """Return velocity and acceleration of the water without its waves."""
    north, east, down = flow.current[0], flow.current[1], flow.current[2]
    to_north, to_east = 0.0, 0.0
    for i in range(flow.drift.shape[0]):
        omega = flow.drift[i, 0]
        angle = omega * t + flow.drift[i, 1]
        sine, cosine = np.sin(angle), omega * np.cos(angle)
        north += flow.drift[i, _DRIFT_NORTH] * sine
        east += flow.drift[i, _DRIFT_EAST] * sine
        to_north += flow.drift[i, _DRIFT_NORTH] * cosine
        to_east += flow.drift[i, _DRIFT_EAST] * cosine
    return (north, east, down), (to_north, to_east, 0.0)


@inline_borrowing_kernel
def orbit_at(t: float, place: Vec, flow: Flow) -> tuple[Vec, Vec]:
    """Return velocity and acceleration of the water by its waves (Airy, deep water)."""
    north, east, down = 0.0, 0.0, 0.0
    to_north, to_east, to_down = 0.0, 0.0, 0.0
    for i in range(flow.waves.shape[0]):
        omega, number = flow.waves[i, _OMEGA], flow.waves[i, _NUMBER]
        c, s = flow.waves[i, _NORTH], flow.waves[i, _EAST]
        angle = number * (c * place[0] + s * place[1]) - omega * t + flow.waves[i, _PHASE]
        speed = flow.waves[i, _HEIGHT] * omega * np.exp(-number * max(place[2], 0.0))
        sine, cosine = speed * np.sin(angle), speed * np.cos(angle)
        north, east, down = north + c * cosine, east + s * cosine, down - sine
        to_north += omega * c * sine
        to_east += omega * s * sine
        to_down += omega * cosine
    return (north, east, down), (to_north, to_east, to_down)


# Three-point Gauss rule on 0..1: exact for the quintic that a line in one direction gives.
_GAUSS_AT = (0.5 - math.sqrt(0.15), 0.5, 0.5 + math.sqrt(0.15))
_GAUSS_WEIGHT = (5.0 / 18.0, 8.0 / 18.0, 5.0 / 18.0)


@inline_borrowing_kernel
def tether_force(stream: Vec, velocity: Vec, flow: Flow) -> Vec:
    """Return the force of the tether on the vehicle, in the world, in newtons.

    `stream`, `velocity`: of the water without waves, and of the vehicle, in the world, in m/s.
    """
    north, east = 0.0, 0.0
    for i in range(3):
        s = _GAUSS_AT[i]
        u, v = stream[0] - s * velocity[0], stream[1] - s * velocity[1]
        weight = _GAUSS_WEIGHT[i] * s * flow.line[0] * np.sqrt(u * u + v * v)
        north, east = north + weight * u, east + weight * v
    return north + flow.line[4], east + flow.line[5], flow.line[6]
