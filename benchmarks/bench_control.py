"""The closed loop in simulation: trials against what is asked for, and 500 random dives.

Run `python -m benchmarks control`. Vehicle, sea, net and delays are those of
`aqualvs.follow.case` and `random_dives`; postures are sampled with the scanner's
noise. Set AQUALVS_LOOP_RENDERED=1 for the trials through rendered pictures as well (half an hour).
References are what the loop must reach.
"""

import math
import os
from dataclasses import replace
from typing import Any

import numpy as np
from benchmarks.random_dives import DiveResult, random_dives

from aqualvs.control.gains_file import load_gains
from aqualvs.control.missions import HoldMission
from aqualvs.control.safety import SafetyLimits
from aqualvs.control.tune import tune
from aqualvs.control.vehicle import Setpoint
from aqualvs.follow.case import (
    FROM_REST_S,
    HOLD_END_S,
    RANGE,
    STEP,
    STEP_S,
    SimCase,
    Trials,
    sea,
    vehicle_model,
)
from aqualvs.follow.log import LoopLog, effort_measures, hold_measures, step_measures
from aqualvs.follow.sensor_model import SampledSensor
from aqualvs.simulation.vehicle.models import VehicleModel
from aqualvs.simulation.vehicle.water_motion import WaterMotion

_VEHICLES = ("bluerov2", "bluerov2-heavy")
_DIVES = {"bluerov2": 200, "bluerov2-heavy": 200, "videoray": 100}
_SEEDS = (1, 2, 3)


def run() -> list[dict[str, Any]]:
    """Return one row for each figure."""
    rows = [row for name in _VEHICLES for row in _trials(name, rendered=False)]
    if "AQUALVS_LOOP_RENDERED" in os.environ:
        rows += [row for name in _VEHICLES for row in _trials(name, rendered=True)]
    rows += [row for name in _DIVES for row in _holds(name)]
    for name, n in _DIVES.items():
        rows += _dives(name, n)
    return rows


def _trials(name: str, *, rendered: bool) -> list[dict[str, Any]]:
    """Return the worst of all seeds, and the step of their mean."""
    model = vehicle_model(name)
    gains, fps = tune(model).gains, 12.5 if rendered else 25.0
    seeds = _SEEDS[:1] if rendered else _SEEDS
    each = [Trials(model, gains, rendered=rendered, fps=fps, seed=seed) for seed in seeds]
    runs = [one.hold_and_step() for one in each]
    holds = [hold for _, hold, _ in runs]
    mean = np.mean([log.column("range") for log, _, _ in runs], axis=0)
    step = step_measures(runs[0][0].column("time_s"), mean, STEP_S, RANGE, RANGE + STEP)
    follows = [one.follow()[1] for one in each]
    what = f"{name}, rendered" if rendered else name

    def degrees(angle: float) -> float:
        return math.degrees(angle)

    return [
        _row(f"{what}: hold, range rms", 1e3 * max(h.range_rms for h in holds), "mm", 15.0),
        _row(f"{what}: hold, yaw rms", degrees(max(h.yaw_rms for h in holds)), "deg", 1.5),
        _row(f"{what}: step, settling", step.settling, "s", 4.0),
        _row(f"{what}: step, overshoot", 100.0 * step.overshoot, "%", 15.0),
        _row(f"{what}: follow, range rms", 1e3 * max(f.range_rms for f in follows), "mm", 30.0),
        _row(f"{what}: follow, yaw rms", degrees(max(f.yaw_rms for f in follows)), "deg", 3.0),
        _row(f"{what}: follow, frames lost", float(sum(f.n_lost for f in follows)), "", None),
        _row(f"{what}: follow, nearest", min(f.min_clearance for f in follows), "m", None),
    ]


def _holds(name: str) -> list[dict[str, Any]]:
    """Return the worst of all seeds in a current from each side, and in still water."""
    model = vehicle_model(name)
    waters = {f"current to {to} deg": sea(current_to=math.radians(to)) for to in (0, 45, 90, 180)}
    rows = []
    for what, water in {**waters, "still water": sea(current=0.0, waves=0.0)}.items():
        logs = [_held(model, replace(water, seed=seed)) for seed in _SEEDS]
        holds = [hold_measures(log, FROM_REST_S) for log in logs]
        turns = max(effort_measures(log, "forward", FROM_REST_S).reversals for log in logs)
        named = f"{name}: hold, {what}"
        rows += [
            _row(f"{named}, range rms", 1e3 * max(h.range_rms for h in holds), "mm", 15.0),
            _row(f"{named}, yaw rms", math.degrees(max(h.yaw_rms for h in holds)), "deg", 1.5),
            _row(f"{named}, reversals", turns, "1/min", 20.0),
        ]
    return rows


def _held(model: VehicleModel, water: WaterMotion) -> LoopLog:
    case = SimCase(model=model, gains=load_gains(model.name), water=water, seed=water.seed)
    sensor = SampledSensor(case.net, np.random.default_rng([water.seed, 53]))
    return case.loop(sensor, HoldMission(Setpoint(RANGE))).run(HOLD_END_S)


def _dives(name: str, n: int) -> list[dict[str, Any]]:
    model = vehicle_model(name, pilot_gain=1.0)
    found = list(random_dives(model, tune(model).gains, range(n), workers=2))

    def count(of: list[bool]) -> float:
        return float(sum(of))

    late = max(dive.safety.neutral_late for dive in found)
    nearest = min(dive.safety.min_clearance for dive in found)
    return [
        _row(f"{name}: {n} dives, contacts", count([d.safety.contact for d in found]), "", None),
        _row(f"{name}: {n} dives, unstable", count([_unstable(d) for d in found]), "", None),
        _row(f"{name}: {n} dives, sight lost", count([_lost(d) for d in found]), "", None),
        _row(f"{name}: {n} dives, warned of tipping", count([_warned(d) for d in found]), "", None),
        _row(f"{name}: {n} dives, nearest", nearest, "m", None),
        _row(f"{name}: {n} dives, neutral after", late, "s", 0.2),
    ]


def _unstable(dive: DiveResult) -> bool:
    return not dive.safety.stable


def _warned(dive: DiveResult) -> bool:
    return dive.safety.greatest_tilt > SafetyLimits().tilt


def _lost(dive: DiveResult) -> bool:
    return math.isfinite(dive.safety.lost_s)


def _row(name: str, value: float, unit: str, reference: float | None) -> dict[str, Any]:
    ratio = None if reference is None or value == 0.0 else reference / value
    return {"name": name, "value": value, "unit": unit, "reference": reference, "ratio": ratio}
