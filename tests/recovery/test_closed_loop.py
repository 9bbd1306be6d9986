"""The closed loop against what it must reach, on the simulated vehicles.

Set AQUALVS_LOOP_RUNS=500 for as many random dives, and AQUALVS_LOOP_RENDERED=1 for the trials with
rendered pictures at full length.
"""

import math
import os
from functools import cache

import numpy as np
import pytest
from benchmarks.random_dives import DiveResult, dive_and_measure, random_dive, random_dives

from aqualvs.control.gains_file import load_gains
from aqualvs.control.missions import HoldMission
from aqualvs.control.tune import tune
from aqualvs.control.vehicle import Setpoint
from aqualvs.follow import sensor_model
from aqualvs.follow.case import FROM_REST_S, RANGE, STEP, STEP_S, SimCase, Trials, vehicle_model
from aqualvs.follow.log import effort_measures, hold_measures, step_measures
from aqualvs.follow.sensor_model import SampledSensor
from quick_pictures import QuickRenderer
from whole import WHOLE

N_RUNS = int(os.environ.get("AQUALVS_LOOP_RUNS", "0"))
# Some of any kind (of which one is kept in an ordinary run), and the hardest that were met: a
# BlueROV2 Heavy that swings its pitch up with too high a gain, strong currents onto the net (104,
# 173).
SEEDS_OF_ANY_KIND = {"bluerov2": (2, 0, 1, 3), "bluerov2-heavy": (1, 0, 29, 49)}
HARD_SEEDS = {"bluerov2": (104, 173), "bluerov2-heavy": (104, 151, 173)}
RENDERED = "AQUALVS_LOOP_RENDERED" in os.environ
BOTH = pytest.mark.parametrize("name", ["bluerov2", "bluerov2-heavy"])
SEEDS = (1, 2, 3) if WHOLE else (1, 2)


def trials(name: str, seed: int, *, rendered: bool = False) -> Trials:
    model = vehicle_model(name)
    fps = 12.5 if rendered else 25.0
    return Trials(model, load_gains(model.name), rendered=rendered, fps=fps, seed=seed)


@BOTH
def test_holds_and_steps_in_current_and_waves(name: str) -> None:
    runs = [trials(name, seed).hold_and_step() for seed in SEEDS]
    for log, hold, step in runs:
        assert hold.range_rms <= 15e-3
        assert math.degrees(hold.yaw_rms) <= 1.5
        assert hold.n_lost == hold.n_guarded == 0
        assert effort_measures(log, "forward", FROM_REST_S).reversals <= 20.0
        assert step.overshoot <= 0.15
    # The waves of several runs cancel in part: what is left is the answer to the step. In one run
    # by itself a wave may leave the band of 20 mm some seconds after.
    mean = np.mean([log.column("range") for log, _, _ in runs], axis=0)
    answer = step_measures(runs[0][0].column("time_s"), mean, STEP_S, RANGE, RANGE + STEP)
    assert answer.settling <= 4.0
    assert answer.overshoot <= 0.15


@BOTH
def test_holds_and_turns_in_calm_water(name: str) -> None:
    """Through the dead zones of the vehicle's sticks, which the link takes out, and thrusters."""
    model = vehicle_model(name)
    for seed in SEEDS[: 2 if WHOLE else 1]:
        case = SimCase(
            model=model,
            gains=load_gains(model.name),
            start_range=RANGE + 0.03,
            start_yaw=math.radians(3.0),
            seed=seed,
        )
        mission = HoldMission(Setpoint(RANGE))

        def step(now_s: float, mission: HoldMission = mission) -> None:
            if now_s >= 40.0:
                mission.setpoint = Setpoint(RANGE, math.radians(10.0))

        sensor = SampledSensor(case.net, np.random.default_rng(seed))
        log = case.loop(sensor, mission).run(48.0, step)
        hold = hold_measures(log, FROM_REST_S, 40.0)
        assert hold.range_rms <= 15e-3
        assert math.degrees(hold.yaw_rms) <= 0.3
        assert effort_measures(log, "forward", FROM_REST_S, 40.0).reversals <= 20.0
        assert effort_measures(log, "turn", FROM_REST_S, 40.0).reversals <= 20.0
        time_s, yaw = log.column("time_s"), np.degrees(log.column("yaw"))
        away = time_s[(time_s > 40.0) & (np.abs(yaw - 10.0) > 1.0)]
        assert away[-1] - 40.0 <= 3.5


@BOTH
def test_follows_a_curved_net_that_moves(name: str) -> None:
    seconds = 60.0 if WHOLE else 40.0
    log, follow = trials(name, 1).follow(seconds)
    assert follow.range_rms <= 30e-3
    assert math.degrees(follow.yaw_rms) <= 3.0
    assert follow.n_lost == 0
    assert follow.min_clearance > 0.0
    along = log.column("along")
    # 0.2 m/s through the water; in 40 s the current alone carries the vehicles 8.2 and 9.8 m.
    assert along[-1] - along[0] > 10.2


@cache
def dived(name: str, seed: int) -> DiveResult:
    # A full stick is full thrust: half of it does not hold every drag and current drawn here.
    model = vehicle_model(name, pilot_gain=1.0)
    return dive_and_measure(random_dive(model, tune(model).gains, seed))


@BOTH
def test_random_dives_are_safe(name: str) -> None:
    if N_RUNS:
        model = vehicle_model(name, pilot_gain=1.0)
        found = list(random_dives(model, tune(model).gains, range(N_RUNS // 2)))
    else:
        any_kind = SEEDS_OF_ANY_KIND[name][: None if WHOLE else 1]
        found = [dived(name, seed) for seed in (*any_kind, *HARD_SEEDS[name])]
    assert not any(dive.safety.contact for dive in found)
    assert max(dive.safety.neutral_late for dive in found) <= 0.2
    assert sum(dive.safety.n_blind for dive in found) > 2 * len(found)
    assert all(dive.safety.stable for dive in found)
    assert _share_lost(found) <= 0.1


def test_swings_after_a_loss_of_sight_stay_small() -> None:
    """Blind for 0.9 s in a strong current, with a delay of 190 ms, on a vehicle that pitches."""
    dive = dived("bluerov2-heavy", 151)
    assert dive.hold.range_rms <= 0.06
    assert math.isinf(dive.safety.lost_s)


@pytest.mark.parametrize("seed", [80094, 80103, 110492])
def test_full_thrust_after_a_loss_of_sight_does_not_end_in_the_net(seed: int) -> None:
    """Blind in 0.42 to 0.48 m/s, thrown back at several m/s²: the filtered range must follow."""
    dive = dived("bluerov2-heavy", seed)
    assert dive.safety.min_clearance > 0.3
    assert math.isinf(dive.safety.lost_s)


def _share_lost(found: list[DiveResult]) -> float:
    return sum(math.isfinite(dive.safety.lost_s) for dive in found) / len(found)


@BOTH
def test_a_rendered_loop_takes_hold(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Through pictures and scanner: hold for some seconds, or for as long as it is judged by."""
    if not RENDERED:
        # Rendering is most of the time, and the pictures of both vehicles are alike.
        monkeypatch.setattr(sensor_model, "Renderer", QuickRenderer)
    run = trials(name, 1, rendered=True)
    if not RENDERED:
        log = run.begin(0.8)
        error = log.column("range") - RANGE
        # From rest in the current: pushed off by less than 0.1 m, and seen in every frame.
        assert np.abs(error).max() < 0.1
        assert all(row.refusal == "" for row in log.rows)
        scanned = log.column("measured_range") - log.column("range")
        # The scanner sees the front of the twine, 1 mm before the net's middle.
        assert np.abs(scanned + 1e-3).max() < 4e-3
        return
    _, hold, step = run.hold_and_step()
    assert hold.range_rms <= 15e-3
    assert math.degrees(hold.yaw_rms) <= 1.5
    assert step.settling <= 4.0
    assert step.overshoot <= 0.15
    _, follow = run.follow()
    assert follow.range_rms <= 30e-3
    assert math.degrees(follow.yaw_rms) <= 3.0
    assert follow.n_lost == 0
    assert follow.min_clearance > 0.0
