"""How the water moves: Airy waves, a wandering current, a tether's drag."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.errors import OptionError
from aqualvs.geometry.transforms import SE3
from aqualvs.simulation.vehicle.models import BLUEROV2_HEAVY
from aqualvs.simulation.vehicle.vehicle import pack_body, state_at
from aqualvs.simulation.vehicle.water_motion import GRAVITY, Tether, WaterMotion, Waves
from water_cases import coast, water_at

SEEDS = st.integers(0, 1000)
SEA = Waves(amplitude=0.4, period=5.0, direction=0.7, n=6)


def velocity_at(water: WaterMotion, time_s: float, place: np.ndarray) -> np.ndarray:
    return water_at(water, time_s, place)[0]


@settings(max_examples=20, deadline=None)
@given(seed=SEEDS, t=st.floats(0.0, 100.0))
def test_acceleration_is_the_rate_of_velocity(seed: int, t: float) -> None:
    water = WaterMotion(current=(0.2, 0.1, 0.0), wander=0.1, waves=SEA, seed=seed)
    place, h = np.array([3.0, -2.0, 1.2]), 1e-5
    rate = (velocity_at(water, t + h, place) - velocity_at(water, t - h, place)) / (2.0 * h)
    assert water_at(water, t, place)[1] == pytest.approx(rate, abs=1e-7)


@settings(max_examples=20, deadline=None)
@given(seed=SEEDS)
def test_waves_neither_compress_nor_turn_the_water(seed: int) -> None:
    water = WaterMotion(waves=SEA, seed=seed)
    place, h = np.array([3.0, -2.0, 1.2]), 1e-5
    step = h * np.eye(3)
    slopes = np.array(
        [
            (velocity_at(water, 2.0, place + d) - velocity_at(water, 2.0, place - d)) / (2.0 * h)
            for d in step
        ]
    )
    assert np.trace(slopes) == pytest.approx(0.0, abs=1e-7)
    assert slopes == pytest.approx(slopes.T, abs=1e-7)


def test_waves_fade_with_depth_and_go_where_they_say() -> None:
    waves = Waves(amplitude=0.3, period=4.0, direction=np.deg2rad(90.0))
    water = WaterMotion(waves=waves, seed=2)
    omega = 2.0 * np.pi / 4.0
    number = omega**2 / GRAVITY
    shallow = velocity_at(water, 0.0, np.array([0.0, 0.0, 1.0]))
    deep = velocity_at(water, 0.0, np.array([0.0, 0.0, 4.0]))
    assert deep == pytest.approx(shallow * np.exp(-3.0 * number), rel=1e-12)
    # A crest that goes east: what is here now is there later.
    later = velocity_at(water, 1.0, np.array([0.0, omega / number, 1.0]))
    assert later == pytest.approx(shallow, rel=1e-9)
    assert shallow[0] == pytest.approx(0.0, abs=1e-12)
    speeds = [
        np.linalg.norm(velocity_at(water, t, np.array([0.0, 0.0, 0.0])))
        for t in np.linspace(0, 4, 9)
    ]
    # On a circle, at amplitude times frequency.
    assert speeds == pytest.approx([0.3 * omega] * 9, rel=1e-9)


def test_irregular_waves_are_as_strong() -> None:
    place, times = np.array([0.0, 0.0, 0.0]), np.linspace(0.0, 1500.0, 4000)
    one = WaterMotion(waves=Waves(amplitude=0.3, spread=0.05))
    many = WaterMotion(waves=Waves(amplitude=0.3, spread=0.05, n=8))
    power = [np.mean([velocity_at(w, t, place)[2] ** 2 for t in times]) for w in (one, many)]
    # Periods differ by 5 %, and so do speeds.
    assert power[1] == pytest.approx(power[0], rel=0.05)


def test_current_wanders_as_much_as_it_says() -> None:
    water = WaterMotion(current=(0.3, 0.0, 0.0), wander=0.05, wander_period=20.0, seed=3)
    place = np.zeros(3)
    speed = np.array([velocity_at(water, t, place) for t in np.linspace(0.0, 4000.0, 4000)])
    assert np.mean(speed, axis=0) == pytest.approx([0.3, 0.0, 0.0], abs=0.005)
    assert np.std(speed[:, :2], axis=0) == pytest.approx(0.05, rel=0.1)
    assert not np.array_equal(
        velocity_at(WaterMotion(wander=0.05, seed=1), 5.0, place),
        velocity_at(WaterMotion(wander=0.05, seed=2), 5.0, place),
    )


def pulled(water: WaterMotion, velocity: tuple[float, float, float]) -> np.ndarray:
    """Force on a vehicle by the tether alone: the difference that it makes."""
    flows = [water.pack(), WaterMotion(current=water.current).pack()]
    body = pack_body(BLUEROV2_HEAVY)
    ends = []
    for flow in flows:
        state = state_at(SE3(np.eye(3), np.array([0.0, 0.0, 5.0])))
        state[7:10] = velocity
        coast(state, np.zeros(8), np.zeros(8), 1e-6, 1, body, flow)
        ends.append(state[7:10])
    masses = BLUEROV2_HEAVY.mass + np.array(BLUEROV2_HEAVY.added_mass[:3])
    force: np.ndarray = masses * (ends[0] - ends[1]) / 1e-6
    return force


def test_tether_in_a_current_and_behind_a_vehicle() -> None:
    tether = Tether(length=40.0)
    half = 0.5 * 1025.0 * 1.2 * 0.0076 * 40.0
    # A vehicle at rest carries half of the drag, a moving one the part of the quadratic's moment.
    held = pulled(WaterMotion(current=(0.3, 0.4, 0.0), tether=tether), (0.0, 0.0, 0.0))
    assert held == pytest.approx([half * 0.5 * 0.5 * 0.3, half * 0.5 * 0.5 * 0.4, 0.0], abs=1e-3)
    towed = pulled(WaterMotion(tether=tether), (0.5, 0.0, 0.0))
    assert towed == pytest.approx([-half * 0.25 / 4.0, 0.0, 0.0], abs=1e-3)
    steady = pulled(WaterMotion(tether=Tether(pull=(1.0, -2.0, 3.0))), (0.0, 0.0, 0.0))
    assert steady == pytest.approx([1.0, -2.0, 3.0], abs=1e-3)


def test_faults_are_refused() -> None:
    with pytest.raises(OptionError, match="break"):
        Waves(amplitude=2.0, period=2.0)
    with pytest.raises(OptionError, match="waves"):
        Waves(amplitude=-0.1)
