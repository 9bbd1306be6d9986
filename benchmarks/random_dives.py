"""Monte Carlo simulation of short dives: evidence for the safety of the loop."""

import math
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np

from aqualvs.control.gains import ControlGains
from aqualvs.control.missions import FollowMission, HoldMission, Mission
from aqualvs.control.safety import LimitReason
from aqualvs.control.vehicle import Setpoint
from aqualvs.follow.case import SimCase, sea
from aqualvs.follow.log import (
    LOST_AFTER_S,
    HoldMeasures,
    LoopLog,
    SafetyMeasures,
    hold_measures,
    safety_measures,
)
from aqualvs.follow.loop import Timing
from aqualvs.follow.sensor_model import Blind, LossOfSight, PostureNoise, SampledSensor
from aqualvs.simulation.net_motion import NetWall
from aqualvs.simulation.scenarios import bluerov2_rig
from aqualvs.simulation.vehicle.models import VehicleModel

SECONDS = 40.0
"""Length of a random dive."""
# Sight is not lost before the loop has started.
_FIRST_LOSS_S, _MAX_LOSS_S = 6.0, 1.0
_GIVEN_UP_S = LOST_AFTER_S + 0.5
# Range that a careful pilot holds: in metres, and in metres more for each m/s of current.
_ROOM, _ROOM_BY_SPEED = 0.5, 0.6
_WORKING_RANGE = bluerov2_rig().working_range


@dataclass(frozen=True, slots=True)
class RandomDive:
    """One dive, as drawn."""

    seed: int
    case: SimCase
    setpoint: Setpoint
    sway: float  # In m/s; 0 is a dive that holds.
    blind: tuple[Blind, ...]  # Periods without sight.

    def mission(self) -> Mission:
        """Return a new mission."""
        if self.sway:
            return FollowMission(self.setpoint, self.sway)
        return HoldMission(self.setpoint)

    def run(self, seconds: float = SECONDS) -> LoopLog:
        """Dive until the end, or until a human has had time to take over, and return the log."""
        rng = np.random.default_rng([self.seed, 43])
        noise = PostureNoise(outliers=0.005)
        sensor = SampledSensor(self.case.net, rng, noise, self.blind, _WORKING_RANGE)
        loop = self.case.loop(sensor, self.mission())
        told_s = math.inf

        def goes_on(now_s: float) -> bool:
            nonlocal told_s
            if loop.log.rows and loop.log.rows[-1].reason == LimitReason.TIPPING.value:
                told_s = min(told_s, now_s)
            return now_s - min(max(loop.seen_s, 0.0), told_s) < _GIVEN_UP_S

        return loop.run(seconds, goes_on)


@dataclass(frozen=True, slots=True)
class DiveResult:
    """Result of one dive; `hold` counts from 10 s on, or the second half of a shorter one."""

    seed: int
    safety: SafetyMeasures
    hold: HoldMeasures


@dataclass(frozen=True, slots=True, kw_only=True)
class DiveSpread:
    """Widths of the distributions that dives are drawn from."""

    mass: float = 0.2  # Greatest deviation from the controller's value, as a share.
    drag: float = 2.0  # Greatest factor either way.
    current: float = 0.5  # Greatest speed, in m/s, in any direction.
    delay: float = 0.2  # Greatest time from the exposure to the vehicle, in seconds.


def random_dive(
    model: VehicleModel, gains: ControlGains, seed: int, spread: DiveSpread | None = None
) -> RandomDive:
    """Draw a dive; the same seed gives the same dive."""
    spread = spread or DiveSpread()
    rng = np.random.default_rng([seed, 47])
    true = model.scaled(
        mass=rng.uniform(1.0 - spread.mass, 1.0 + spread.mass),
        drag=spread.drag ** rng.uniform(-1.0, 1.0),
    )
    delay = rng.uniform(0.04, spread.delay)
    wire = rng.uniform(0.1, 0.5) * delay
    current = rng.uniform(0.0, spread.current)
    room = _ROOM + _ROOM_BY_SPEED * current + rng.uniform(0.0, 0.1)
    setpoint = Setpoint(room, math.radians(rng.uniform(-20.0, 20.0)))
    sways = gains.vehicle.can_sway and rng.uniform() < 0.5
    case = SimCase(
        model=true,
        gains=gains,
        water=sea(
            current=current,
            current_to=rng.uniform(-math.pi, math.pi),
            wander=0.02,
            waves=rng.uniform(0.0, 0.2),
            period=rng.uniform(4.0, 7.0),
            waves_to=rng.uniform(-math.pi, math.pi),
            tether=rng.uniform(0.0, 30.0),
            seed=seed,
        ),
        net=_net(rng),
        start_range=setpoint.range + rng.uniform(-0.05, 0.1),
        start_yaw=math.radians(rng.uniform(-10.0, 10.0)),
        timing=Timing(delay=delay - wire),
        wire=wire,
        seed=seed,
    )
    return RandomDive(
        seed, case, setpoint, 0.2 * float(rng.choice((-1.0, 1.0))) if sways else 0.0, _blind(rng)
    )


def dive_and_measure(dive: RandomDive) -> DiveResult:
    """Run one dive."""
    log = dive.run()
    start_s = min(10.0, 0.5 * log.rows[-1].time_s)
    return DiveResult(dive.seed, safety_measures(log), hold_measures(log, start_s))


def random_dives(
    model: VehicleModel,
    gains: ControlGains,
    seeds: Iterable[int],
    *,
    spread: DiveSpread | None = None,
    workers: int = 1,
) -> Iterator[DiveResult]:
    """Run dives, in other processes where there is more than one worker; yields in order."""
    dives = [random_dive(model, gains, seed, spread) for seed in seeds]
    if workers == 1:
        yield from map(dive_and_measure, dives)
        return
    with ProcessPoolExecutor(workers) as pool:
        yield from pool.map(dive_and_measure, dives, chunksize=8)


def _net(rng: np.random.Generator) -> NetWall:
    return NetWall(
        curvature=float(rng.choice((-1.0, 0.0, 1.0))) * rng.uniform(0.02, 0.12),
        sway=rng.uniform(0.0, 0.08),
        sway_period=rng.uniform(5.0, 10.0),
        sway_phase=rng.uniform(0.0, 2.0 * math.pi),
        tilt=math.radians(rng.uniform(-8.0, 8.0)),
        rock=math.radians(rng.uniform(0.0, 2.0)),
        rock_phase=rng.uniform(0.0, 2.0 * math.pi),
    )


def _blind(rng: np.random.Generator) -> tuple[Blind, ...]:
    """Draw periods without sight of up to a second, a few seconds apart."""
    stretches: list[Blind] = []
    start_s = _FIRST_LOSS_S + rng.exponential(3.0)
    while start_s < SECONDS - 2.0:
        end_s = start_s + rng.uniform(0.04, _MAX_LOSS_S)
        loss = LossOfSight.TARGET if rng.uniform() < 0.5 else LossOfSight.STREAM
        stretches.append(Blind(start_s, end_s, loss))
        start_s = end_s + 2.0 + rng.exponential(6.0)
    return tuple(stretches)
