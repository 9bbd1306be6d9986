"""The rigid body in water: what physics forbids and what it demands."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.simulation.vehicle.dynamics import N_STATE, Body
from aqualvs.simulation.vehicle.models import (
    BLUEROV2,
    BLUEROV2_HEAVY,
    VEHICLES,
    VIDEORAY,
    Thruster,
    VehicleModel,
)
from aqualvs.simulation.vehicle.vehicle import pack_body, pose_of, state_at
from aqualvs.simulation.vehicle.water_motion import Flow, Tether, WaterMotion, Waves
from water_cases import coast, water_at
from whole import part_of

MODELS = pytest.mark.parametrize("model", VEHICLES.values(), ids=VEHICLES)
STEP = 1.0 / 400.0
CALM = WaterMotion()
SEEDS = st.integers(0, 2**32 - 1)


def neutral(model: VehicleModel, *thrusters: Thruster) -> VehicleModel:
    """The model without buoyancy or righting moment, with these thrusters only."""
    return replace(
        model, buoyancy=model.weight, centre_of_buoyancy=(0.0, 0.0, 0.0), thrusters=thrusters
    )


def carried_on(
    state: np.ndarray,
    thrusts: np.ndarray,
    body: Body,
    flow: Flow,
    n: int,
    h: float = STEP,
    wanted: np.ndarray | None = None,
) -> np.ndarray:
    """State after n steps under thrusts that change to `wanted`, if that is given."""
    y, forces = state.copy(), np.array(thrusts, dtype=np.float64)
    aim = forces.copy() if wanted is None else np.array(wanted, dtype=np.float64)
    coast(y, forces, aim, h, n, body, flow)
    return y


def slope_of(state: np.ndarray, thrusts: np.ndarray, body: Body, flow: Flow) -> np.ndarray:
    """Rate of change, by a step so short that RK4 is exact to rounding."""
    h = 1e-6
    return (carried_on(state, thrusts, body, flow, 1, h) - state) / h


def random_state(rng: np.random.Generator, speed: float = 0.8, turning: float = 1.0) -> np.ndarray:
    pose = SE3(rotation_from_rotvec(rng.normal(size=3)), np.array([0.0, 0.0, 20.0]))
    state = state_at(pose)
    state[7:10] = speed * rng.normal(size=3)
    state[10:13] = turning * rng.normal(size=3)
    return state


def energy(state: np.ndarray, model: VehicleModel) -> float:
    """Kinetic energy with the water's, and potential energy of weight and buoyancy."""
    pose = pose_of(state)
    masses = np.array([model.mass] * 3 + list(model.inertia)) + np.array(model.added_mass)
    kinetic = 0.5 * float(masses @ state[7:13] ** 2)
    float_depth = pose.apply(model.centre_of_buoyancy)[2]
    return kinetic - model.weight * state[2] + model.buoyancy * float_depth


@MODELS
@settings(max_examples=15, deadline=None)
@given(seed=SEEDS)
def test_energy_never_grows_without_thrust(model: VehicleModel, seed: int) -> None:
    rng = np.random.default_rng(seed)
    state, body = random_state(rng), pack_body(model)
    flow = WaterMotion(tether=Tether(length=20.0)).pack()
    silent = np.zeros(len(model.thrusters))
    before = energy(state, model)
    for _ in range(40):
        state = carried_on(state, silent, body, flow, 20)
        now = energy(state, model)
        # Rounding, of energies of some kilojoules.
        assert now <= before + 1e-9
        before = now


@settings(max_examples=15, deadline=None)
@given(seed=SEEDS)
def test_energy_stays_without_drag(seed: int) -> None:
    # Coriolis and added-mass terms only move energy about.
    model = replace(BLUEROV2_HEAVY, linear_drag=(0.0,) * 6, quadratic_drag=(0.0,) * 6)
    state = random_state(np.random.default_rng(seed))
    after = carried_on(state, np.zeros(8), pack_body(model), CALM.pack(), 800)
    # What the fourth order leaves in 2 s of 2.5 ms steps.
    assert energy(after, model) == pytest.approx(energy(state, model), abs=1e-5)
    assert np.linalg.norm(after[3:7]) == pytest.approx(1.0, abs=1e-12)


@MODELS
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("force", part_of([-9.0, 1.0, 20.0]))
def test_terminal_speed_balances_drag(model: VehicleModel, axis: int, force: float) -> None:
    way = np.eye(3)[axis]
    body = pack_body(neutral(model, Thruster((0.0, 0.0, 0.0), tuple(way))))
    state = carried_on(state_at(SE3.identity()), np.array([force]), body, CALM.pack(), 24000)
    linear, quadratic = model.linear_drag[axis], model.quadratic_drag[axis]
    root = np.sqrt(linear**2 + 4.0 * quadratic * abs(force))
    speed = np.sign(force) * (root - linear) / (2.0 * quadratic)
    assert state[7 + axis] == pytest.approx(speed, rel=1e-3)
    assert np.delete(state[7:13], axis) == pytest.approx(0.0, abs=1e-12)


@MODELS
def test_terminal_turn_balances_drag(model: VehicleModel) -> None:
    couple = (
        Thruster((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)),
        Thruster((0.0, -1.0, 0.0), (1.0, 0.0, 0.0)),
    )
    body = pack_body(neutral(model, *couple))
    state = carried_on(state_at(SE3.identity()), np.full(2, 0.4), body, CALM.pack(), 24000)
    rate = state[12]
    drag = model.linear_drag[5] * rate + model.quadratic_drag[5] * rate * abs(rate)
    assert drag == pytest.approx(0.8, rel=1e-3)
    assert rate > 0.0


@MODELS
@pytest.mark.parametrize("axis", range(3))
def test_first_acceleration_carries_added_mass(model: VehicleModel, axis: int) -> None:
    body = pack_body(neutral(model, Thruster((0.0, 0.0, 0.0), tuple(np.eye(3)[axis]))))
    slope = slope_of(state_at(SE3.identity()), np.array([7.0]), body, CALM.pack())
    assert slope[7 + axis] == pytest.approx(7.0 / (model.mass + model.added_mass[axis]), rel=1e-5)


@MODELS
def test_buoyancy_rights_and_lifts(model: VehicleModel) -> None:
    tilted = SE3(rotation_from_rotvec([0.35, -0.2, 0.4]), np.array([0.0, 0.0, 90.0]))
    silent = np.zeros(len(model.thrusters))
    state = carried_on(state_at(tilted), silent, pack_body(model), CALM.pack(), 80000)
    excess = model.buoyancy - model.weight
    rise = -state[9]
    drag = model.linear_drag[2] * rise + model.quadratic_drag[2] * rise * abs(rise)
    # Level, and rising at the speed whose drag holds the buoyancy. The heavy one has no linear drag
    # in roll, so that its last degree dies out as 1/t only.
    level = 0.02 if model is BLUEROV2_HEAVY else 1e-6
    assert pose_of(state).rotation[2, :2] == pytest.approx(0.0, abs=level)
    assert drag == pytest.approx(excess, rel=1e-3)


@MODELS
@settings(max_examples=20, deadline=None)
@given(seed=SEEDS)
def test_no_force_in_water_that_goes_along(model: VehicleModel, seed: int) -> None:
    rng = np.random.default_rng(seed)
    current = rng.normal(size=3)
    state = random_state(rng)
    turn = pose_of(state).rotation
    state[7:10] = turn.T @ current
    body = pack_body(neutral(model, *model.thrusters))
    flow = WaterMotion(current=tuple(current)).pack()
    after = carried_on(state, np.zeros(len(model.thrusters)), body, flow, 400)
    # However it turns, it goes on with the water.
    assert pose_of(after).rotation @ after[7:10] == pytest.approx(current, abs=1e-6)
    assert after[:3] - state[:3] == pytest.approx(current, abs=1e-6)


def test_small_body_rides_a_wave() -> None:
    # Froude-Krylov and added mass together: a neutral body that goes with the water stays with it.
    water = WaterMotion(waves=Waves(amplitude=0.3, period=4.0, direction=0.4), seed=3)
    place = np.array([1.0, 2.0, 1.5])
    velocity, acceleration = water_at(water, 0.0, place)
    state = state_at(SE3(np.eye(3), place))
    state[7:10] = velocity
    model = neutral(BLUEROV2_HEAVY, *BLUEROV2_HEAVY.thrusters)
    slope = slope_of(state, np.zeros(8), pack_body(model), water.pack())
    # The displaced mass is the body's own, so that it goes as the water does.
    assert slope[7:10] == pytest.approx(acceleration, abs=1e-5)


def test_step_size_converges_with_the_fourth_order() -> None:
    water = WaterMotion(
        current=(0.3, -0.1, 0.0),
        wander=0.05,
        waves=Waves(amplitude=0.3, period=4.0, n=3),
        tether=Tether(length=25.0, pull=(1.0, 0.0, -1.0)),
    )
    # Quadratic drag has a kink at rest; turning passes through it, so that it goes without here.
    quadratic = (*BLUEROV2_HEAVY.quadratic_drag[:3], 0.0, 0.0, 0.0)
    body = pack_body(replace(BLUEROV2_HEAVY, quadratic_drag=quadratic))
    flow = water.pack()
    state = random_state(np.random.default_rng(5), speed=0.2, turning=0.5)
    state[7:10] += [2.0, -1.5, 1.5]
    silent, wanted = np.zeros(8), 5.0 * np.arange(8.0)

    def after(n: int) -> np.ndarray:
        return carried_on(state, silent, body, flow, n, 0.2 / n, wanted)

    truth = after(2560)
    errors = [float(np.linalg.norm(after(n) - truth)) for n in (20, 40, 80, 160)]
    ratios = [a / b for a, b in pairwise(errors)]
    # Halving the step leaves a sixteenth.
    assert ratios == pytest.approx([16.0] * 3, rel=0.15)
    # 80 is the step in use: nanometres, at speeds that no such vehicle reaches.
    assert errors[2] < 1e-7


def test_thrust_approaches_with_its_lag() -> None:
    body, flow = pack_body(BLUEROV2), CALM.pack()
    y, thrusts = state_at(SE3.identity()), np.zeros(6)
    coast(y, thrusts, np.full(6, 10.0), STEP, 40, body, flow)
    assert thrusts == pytest.approx(10.0 * (1.0 - np.exp(-1.0)), rel=1e-9)


def test_scaling_keeps_trim() -> None:
    heavy = BLUEROV2.scaled(mass=1.2, drag=0.5)
    assert heavy.mass == pytest.approx(13.8)
    assert heavy.buoyancy - heavy.weight == pytest.approx(BLUEROV2.buoyancy - BLUEROV2.weight)
    assert heavy.quadratic_drag[0] == pytest.approx(9.09)
    assert heavy.inertia[2] == pytest.approx(0.192)
    assert heavy.added_mass == BLUEROV2.added_mass


def test_every_motion_moves_only_itself() -> None:
    # Unit inputs through mixing and allocation: force or moment along the axis that was asked for.
    wanted = {"yaw": 5, "down": 2, "forward": 0, "right": 1}
    for model in (BLUEROV2_HEAVY, BLUEROV2):
        done = model.allocation() @ model.mixing()
        for column, name in ((2, "yaw"), (3, "down"), (4, "forward"), (5, "right")):
            row = wanted[name]
            assert done[row, column] > 0.5, (model.name, name)
            assert np.delete(done[[0, 1, 2, 5], column], [0, 1, 2, 5].index(row)) == pytest.approx(
                0.0, abs=1e-12
            )
    assert (BLUEROV2_HEAVY.allocation() @ BLUEROV2_HEAVY.mixing())[3, 0] > 0.0
    assert (BLUEROV2_HEAVY.allocation() @ BLUEROV2_HEAVY.mixing())[4, 1] > 0.0
    assert not (VIDEORAY.allocation() @ VIDEORAY.mixing())[1].any()


def test_state_and_pose_agree() -> None:
    state = random_state(np.random.default_rng(2))
    again = state_at(pose_of(state))
    assert len(again) == N_STATE
    assert pose_of(again).rotation == pytest.approx(pose_of(state).rotation, abs=1e-12)
