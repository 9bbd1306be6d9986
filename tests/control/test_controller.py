"""Range and yaw on plants of the project's equations: signs, decoupling, steps, faults."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.control.controller import Ramp, RangeYawController, SwellFilter
from aqualvs.control.gains import ControlGains
from aqualvs.control.gains_file import VEHICLES, load_gains
from aqualvs.control.vehicle import NEUTRAL, Effort, Setpoint
from control_cases import FRAME_S, PlanePlant, fly, overshoot_and_settling

HOLD = Setpoint(0.6)
BLUE = ("bluerov2_heavy", "bluerov2")


@pytest.fixture(scope="module")
def gains() -> ControlGains:
    return load_gains("bluerov2")


def first_efforts(
    gains: ControlGains, distance: float, yaw: float, setpoint: Setpoint = HOLD, sway: float = 0.0
) -> Effort:
    """Return the effort after a second before a target that does not react."""
    controller = RangeYawController(gains)
    effort = NEUTRAL
    for k in range(26):
        effort = controller.update(FRAME_S * k, distance, yaw, 0.0, 0.0, setpoint, sway)
    return effort


def test_signs(gains: ControlGains) -> None:
    assert first_efforts(gains, 0.9, 0.0).forward > 0.05
    assert first_efforts(gains, 0.4, 0.0).forward < -0.05
    # The far normal points right: turn right, clockwise.
    assert first_efforts(gains, 0.6, 0.2).yaw > 0.05
    assert first_efforts(gains, 0.6, -0.2).yaw < -0.05
    assert first_efforts(gains, 0.6, 0.0, sway=0.2).right > 0.05
    assert first_efforts(gains, 0.6, 0.0, sway=-0.2).right < -0.05


def test_down_is_a_share_of_the_climb_rate(gains: ControlGains) -> None:
    controller = RangeYawController(gains)
    effort = controller.update(0.0, 0.6, 0.0, 0.0, 0.0, HOLD, 0.0, 0.1)
    assert effort.down == pytest.approx(0.1 / gains.vehicle.climb_rate)
    assert controller.update(0.04, 0.6, 0.0, 0.0, 0.0, HOLD, 0.0, -9.0).down == -1.0


@pytest.mark.parametrize("name", VEHICLES)
@pytest.mark.parametrize(("begin", "end"), [(0.8, 0.6), (0.6, 0.8)])
def test_step_of_the_range(name: str, begin: float, end: float) -> None:
    gains = load_gains(name)
    plant, controller = PlanePlant(gains, distance=begin), RangeYawController(gains)
    fly(plant, controller, Setpoint(begin), 3.0)
    run = fly(plant, controller, Setpoint(end), 12.0)
    overshoot, settling = overshoot_and_settling(run.time, run.range, begin, end)
    assert overshoot <= 0.15
    assert settling <= 4.0


@pytest.mark.parametrize("name", BLUE)
def test_step_in_a_current_is_no_slower(name: str) -> None:
    gains = load_gains(name)
    plant = PlanePlant(gains, distance=0.8, current=(-0.3, 0.1))
    controller = RangeYawController(gains)
    fly(plant, controller, Setpoint(0.8), 30.0)
    run = fly(plant, controller, Setpoint(0.6), 12.0)
    overshoot, settling = overshoot_and_settling(run.time, run.range, 0.8, 0.6)
    assert overshoot <= 0.15
    assert settling <= 4.0


@pytest.mark.parametrize("onto", [0.35, -0.35])
def test_the_force_of_a_strong_current_is_found_in_seconds(onto: float) -> None:
    """Drag makes the Heavy's loop stiff there; the integral keeps up with that."""
    gains = load_gains("bluerov2_heavy")
    plant = PlanePlant(gains, current=(onto, 0.0))
    run = fly(plant, RangeYawController(gains), HOLD, 12.0)
    # Pushed off by 139 mm, 24 mm after 9 s; 201 and 128 mm where the integral does not rise.
    assert np.abs(run.range - 0.6).max() < 0.16
    assert np.abs(run.range[run.time > 9.0] - 0.6).max() < 0.03


@pytest.mark.parametrize("name", VEHICLES)
def test_step_of_the_yaw(name: str) -> None:
    gains = load_gains(name)
    plant, controller = PlanePlant(gains), RangeYawController(gains)
    fly(plant, controller, HOLD, 2.0)
    goal = math.radians(15.0)
    run = fly(plant, controller, Setpoint(0.6, goal), 12.0)
    overshoot, settling = overshoot_and_settling(run.time, run.yaw, 0.0, goal)
    assert overshoot <= 0.15
    assert settling <= 4.5
    # The dome swings by 50 mm in that turn; the range is to stay, but for what the thrusters wait
    # in their dead band.
    assert np.abs(run.range - 0.6).max() < 0.012


def test_the_domes_swing_in_a_turn_is_made_up_for() -> None:
    def worst(gains: ControlGains) -> float:
        plant = PlanePlant(load_gains("bluerov2_heavy"), yaw=math.radians(20.0))
        controller = RangeYawController(gains)
        fly(plant, controller, Setpoint(0.6, math.radians(20.0)), 3.0)
        run = fly(plant, controller, Setpoint(0.6, math.radians(40.0)), 8.0)
        return float(np.abs(run.range - 0.6).max())

    gains = load_gains("bluerov2_heavy")
    # Without what the thrusters wait in their dead band.
    gains = replace(gains, range=replace(gains.range, crossing_impulse=0.0))
    unaware = replace(gains, vehicle=replace(gains.vehicle, dome_forward=0.0))
    assert worst(gains) < 0.75 * worst(unaware)


def test_another_stream_starts_anew(gains: ControlGains) -> None:
    """Frame times that jump back: the ramp begins at the range that is found there."""
    controller = RangeYawController(gains)
    for k in range(50):
        controller.update(100.0 + FRAME_S * k, 0.6, 0.0, 0.0, 0.0, HOLD)
    first = controller.update(1.0, 1.2, 0.0, 0.0, 0.0, HOLD)
    assert abs(first.forward) < 0.02


@pytest.mark.parametrize("name", BLUE)
@settings(max_examples=12, deadline=None, derandomize=True)
@given(
    mass=st.floats(0.8, 1.2),
    drag=st.floats(0.5, 2.0),
    delay=st.integers(0, 5),
    along=st.floats(-0.3, 0.3),
    across=st.floats(-0.25, 0.25),
)
def test_one_set_of_gains_stands_every_corner(
    name: str, mass: float, drag: float, delay: int, along: float, across: float
) -> None:
    gains = load_gains(name)
    plant = PlanePlant(
        gains, mass=mass, drag=drag, delay=delay, current=(across, along), distance=0.7
    )
    run = fly(plant, RangeYawController(gains), HOLD, 45.0, noise=np.random.default_rng(3))
    settled = run.time > 30.0
    # Delays are up to 200 ms beyond the lag; the slowest recovery leaves some millimetres.
    assert np.abs(run.range[settled] - 0.6).max() < 0.025
    assert np.degrees(np.abs(run.yaw[settled])).max() < 1.5


def test_both_vehicles_hold_without_known_rates() -> None:
    for name in BLUE:
        gains = load_gains(name)
        plant = PlanePlant(gains, distance=0.75, current=(0.15, 0.0))
        run = fly(
            plant,
            RangeYawController(gains),
            HOLD,
            30.0,
            rates=False,
            noise=np.random.default_rng(1),
        )
        assert np.abs(run.range[run.time > 20.0] - 0.6).max() < 0.02


def sway_error(gains: ControlGains, yaw: float, *, beforehand: bool) -> tuple[float, float]:
    """Return the worst error of the range and the way along the target, over 10 s at 0.2 m/s."""
    plant, controller = PlanePlant(gains, yaw=yaw), RangeYawController(gains)
    wanted, facts = Setpoint(0.6, yaw), gains.vehicle
    fly(plant, controller, wanted, 3.0)
    start, worst = plant.along, 0.0
    for _ in range(250):
        sway = 0.2 if beforehand else 0.0
        effort = controller.update(
            plant.time, plant.distance, plant.yaw, *plant.rates(), wanted, sway
        )
        if not beforehand:
            forward, _ = facts.thrust.forces(effort.forward, effort.right)
            side = facts.right_drag.force(0.2 * math.cos(yaw))
            pairs = map(facts.thrust.effort, facts.thrust.shares(forward, side))
            ahead, aside = facts.thrust.joined(*pairs)
            effort = replace(effort, forward=ahead, right=aside)
        plant.step(effort)
        worst = max(worst, abs(plant.distance - 0.6))
    return worst, plant.along - start


@pytest.mark.parametrize("name", BLUE)
@pytest.mark.parametrize("yaw_deg", [-35.0, 20.0, 35.0])
def test_sway_does_not_disturb_the_range_before_a_slanting_target(
    name: str, yaw_deg: float
) -> None:
    gains, yaw = load_gains(name), math.radians(yaw_deg)
    worst, along = sway_error(gains, yaw, beforehand=True)
    bare, _ = sway_error(gains, yaw, beforehand=False)
    # Sideways alone it would come up to 1.1 m nearer, and 15 to 40 mm with feedback only.
    assert worst < 0.01
    assert worst < 0.45 * bare
    # As fast along the target as asked, after a start without a push.
    assert along == pytest.approx(2.0, abs=0.4)


def test_a_curved_net_is_followed_square(gains: ControlGains) -> None:
    """A target that turns at 2 deg/s, as a net of 6 m radius does at 0.2 m/s."""
    plant, controller = PlanePlant(gains), RangeYawController(gains)
    for _ in range(round(30.0 / FRAME_S)):
        range_rate, yaw_rate = plant.rates()
        turn = math.radians(2.0)
        effort = controller.update(
            plant.time, plant.distance, plant.yaw, range_rate, yaw_rate + turn, HOLD
        )
        plant.step(effort)
        plant.yaw += turn * FRAME_S
    assert abs(math.degrees(plant.yaw)) < 0.3


def test_swell_term_halves_what_a_swell_does(gains: ControlGains) -> None:
    def error(chosen: ControlGains) -> float:
        plant, controller = PlanePlant(chosen), RangeYawController(chosen)
        errors = []
        for _ in range(round(60.0 / FRAME_S)):
            swell = 0.08 * math.sin(2.0 * math.pi * plant.time / 5.0)
            plant.current = (0.1 + swell, 0.0)
            effort = controller.update(plant.time, plant.distance, plant.yaw, *plant.rates(), HOLD)
            plant.step(effort)
            errors.append(plant.distance - 0.6)
        return float(np.std(errors[-750:]))

    calm = replace(gains, range=replace(gains.range, swell=0.0))
    assert error(gains) < 0.65 * error(calm)


def test_after_a_pause_it_starts_from_neutral_and_knows_the_current(gains: ControlGains) -> None:
    plant, controller = PlanePlant(gains, current=(0.4, 0.0)), RangeYawController(gains)
    run = fly(plant, controller, HOLD, 25.0)
    held = run.efforts[-1].forward
    assert held < -0.15
    controller.pause()
    later = plant.time + 0.4
    first = controller.update(later, 0.6, 0.0, 0.0, 0.0, HOLD)
    assert abs(first.forward) < abs(held)
    second = controller.update(later + FRAME_S, 0.6, 0.0, 0.0, 0.0, HOLD)
    third = controller.update(later + 0.4, 0.6, 0.0, 0.0, 0.0, HOLD)
    assert first.forward >= second.forward >= third.forward
    assert third.forward == pytest.approx(held, abs=0.05)
    controller.pause()
    forgotten = later + 1.0 + gains.memory
    for k in range(10):
        effort = controller.update(forgotten + FRAME_S * k, 0.6, 0.0, 0.0, 0.0, HOLD)
    assert abs(effort.forward) < 0.02


def test_repeated_and_late_frames_change_nothing(gains: ControlGains) -> None:
    controller = RangeYawController(gains)
    controller.update(1.0, 0.7, 0.1, 0.0, 0.0, HOLD)
    effort = controller.update(1.04, 0.7, 0.1, 0.0, 0.0, HOLD)
    assert controller.update(1.04, 5.0, 0.1, 0.0, 0.0, HOLD) == effort
    assert controller.update(0.8, 5.0, 0.1, 0.0, 0.0, HOLD) == effort


def test_new_setpoint_comes_in_slowly(gains: ControlGains) -> None:
    controller = RangeYawController(gains)
    before = controller.update(0.0, 0.6, 0.0, 0.0, 0.0, HOLD)
    jumps = []
    for k in range(1, 60):
        effort = controller.update(FRAME_S * k, 0.6, 0.0, 0.0, 0.0, Setpoint(1.0, 0.5))
        jumps.append(max(abs(effort.forward - before.forward), abs(effort.yaw - before.yaw)))
        before = effort
    # The dead band (0.14) is crossed in one go; all else is gradual.
    assert max(jumps) < gains.vehicle.thrust.dead_band + 0.08


@given(goal=st.floats(-2.0, 2.0), dt=st.floats(0.005, 0.2))
def test_ramp_keeps_its_limits_and_stops_on_the_goal(goal: float, dt: float) -> None:
    ramp = Ramp(0.5, 0.4)
    for _ in range(round(12.0 / dt)):
        before = ramp.rate
        ramp.step(goal, dt)
        assert abs(ramp.rate) <= 0.5 + 1e-9
        assert abs(ramp.rate - before) <= 0.4 * dt + 1e-9
        # One step's worth is what a bounded acceleration in steps may overrun.
        assert abs(ramp.value) <= abs(goal) + 0.4 * dt * dt
    assert ramp.value == pytest.approx(goal, abs=1e-6 + 0.4 * dt * dt)


def test_swell_filter_passes_its_period_alone() -> None:
    def gain(period: float) -> float:
        swell, outputs = SwellFilter(5.0, 0.15), []
        for k in range(4000):
            outputs.append(swell.update(0.02, math.sin(2.0 * math.pi * 0.02 * k / period)))
        return float(np.max(np.abs(outputs[2000:])))

    # Backward Euler at 20 ms damps a little.
    assert gain(5.0) == pytest.approx(1.0, abs=0.1)
    assert gain(20.0) < 0.1
    assert gain(1.0) < 0.1
    still = SwellFilter(5.0, 0.15)
    assert still.update(0.0, 1.0) == 0.0


def test_a_ramp_may_fall_more_slowly_than_it_rises() -> None:
    ramp = Ramp(0.5, 4.0, falling=0.1)
    for goal, speed in ((1.0, 0.5), (0.0, -0.1)):
        for _ in range(25):
            ramp.step(goal, 0.04)
        assert ramp.rate == pytest.approx(speed)
        ramp.start(goal)
