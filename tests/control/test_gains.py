"""Gains: the thrusters' curve turned round, drag, and the file."""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from aqualvs.control.controller import QuietZone
from aqualvs.control.gains import ControlGains, DeadBandCrossing, Drag, Layout, ThrustMap
from aqualvs.control.gains_file import VEHICLES, gains_text, load_gains, save_gains
from aqualvs.errors import OptionError

MAP = ThrustMap(forward=40.0, backward=30.0, right=35.0, dead_band=0.14, linear=0.7)


def efforts(thrust: ThrustMap, forward: float, right: float) -> tuple[float, float]:
    one, other = thrust.shares(forward, right)
    return thrust.joined(thrust.effort(one), thrust.effort(other))


@given(st.floats(-1.0, 1.0))
def test_effort_turns_the_curve_round(share: float) -> None:
    effort = MAP.effort(share)
    assert abs(effort) <= 1.0
    assert MAP.share(effort) == pytest.approx(share, abs=1e-9)


@pytest.mark.parametrize("linear", [1.0, 0.5, 0.05])
def test_curve_is_monotone_and_odd(linear: float) -> None:
    curve = ThrustMap(forward=1.0, backward=1.0, right=1.0, dead_band=0.1, linear=linear)
    efforts = [curve.effort(k / 100.0) for k in range(101)]
    assert all(b > a for a, b in pairwise(efforts))
    assert (efforts[0], efforts[-1]) == (0.0, pytest.approx(1.0))
    assert curve.effort(-0.3) == -curve.effort(0.3)


@given(st.floats(-25.0, 25.0), st.floats(-10.0, 10.0))
def test_vectored_thrusters_give_both_forces_at_once(forward: float, right: float) -> None:
    one = ThrustMap(forward=40.0, backward=40.0, right=40.0, dead_band=0.14, linear=0.7)
    found = one.forces(*efforts(one, forward, right))
    assert found == pytest.approx((forward, right), abs=1e-4)


def test_forward_comes_before_sideways_where_thrust_ends() -> None:
    forward, right = MAP.forces(*efforts(MAP, 36.0, 35.0))
    assert forward == pytest.approx(36.0)
    assert right == pytest.approx(3.5)


def test_straight_thrusters_do_not_share() -> None:
    both = ThrustMap(forward=5.0, backward=4.0, right=3.0, layout=Layout.STRAIGHT)
    assert efforts(both, 5.0, 3.0) == (1.0, 1.0)
    none = ThrustMap(forward=5.0, backward=4.0, right=0.0, layout=Layout.STRAIGHT)
    assert efforts(none, -2.0, 3.0) == (-0.5, 0.0)


def crossings(shares: list[float], impulse: float = 0.005, great: float = 0.1) -> list[float]:
    pair = DeadBandCrossing(MAP, impulse, great)
    return [pair.effort(share, 0.04) for share in shares]


def test_noise_about_zero_crosses_no_dead_band() -> None:
    rng = np.random.default_rng(1)
    noise = (0.01 * rng.normal(size=1000)).tolist()
    signs = np.sign([one for one in crossings(noise) if one])
    n_noise = np.count_nonzero(np.diff(np.sign(noise)))
    assert n_noise > 400
    assert np.count_nonzero(np.diff(signs)) < 0.1 * n_noise


def test_noise_does_not_push_in_the_dead_band() -> None:
    """What is owed is taken off: the mean thrust is the one asked for, on either side."""
    rng = np.random.default_rng(2)
    for mean in (0.002, -0.002):
        shares = mean + 0.02 * rng.normal(size=4000)
        given = [MAP.share(one) for one in crossings(shares.tolist(), impulse=0.1, great=1.0)]
        assert np.mean(given) == pytest.approx(np.mean(shares), abs=1e-4)


def test_a_pair_turns_while_much_is_owed_and_for_a_while_after_the_crossing() -> None:
    pair = DeadBandCrossing(MAP, 0.019, 1.0)
    turns = []
    for share in [0.05] * 2 + [-0.05] * 62:
        pair.effort(share, 0.04)
        turns.append(pair.turns)
    # A third of the impulse is owed after 0.16 s, all of it after 0.4 s, and 2 s later it is over.
    assert not any(turns[:5])
    assert all(turns[5:60])
    assert not any(turns[62:])


def test_a_dead_band_is_crossed_once_an_impulse_is_lacking() -> None:
    found = crossings([0.1] * 3 + [-0.02] * 10)
    assert found[:3] == [MAP.effort(0.1)] * 3
    # 0.02 of the thrust for 0.25 s: until then the thrusters wait at the edge.
    assert found[3:9] == [MAP.dead_band] * 6
    assert found[9:] == [MAP.effort(-0.02)] * 4


def test_a_great_thrust_crosses_at_once_and_nothing_is_at_rest() -> None:
    assert crossings([0.1, -0.1, 0.0]) == [MAP.effort(0.1), MAP.effort(-0.1), -MAP.dead_band]
    assert crossings([0.0, 0.0]) == [0.0, 0.0]
    assert crossings([1e-4, -1e-4], impulse=0.0) == [MAP.effort(1e-4), MAP.effort(-1e-4)]


def test_small_turning_rates_are_not_begun() -> None:
    zone = QuietZone(0.1)
    asked = (0.05, 0.2, 0.05, -0.05, 0.05, -0.2, -0.01, 0.0)
    assert [zone.rate(one) for one in asked] == [0.0, 0.2, 0.05, 0.0, 0.0, -0.2, -0.01, 0.0]


@given(st.floats(-2.0, 2.0), st.floats(0.0, 40.0), st.floats(0.0, 200.0))
def test_drag_turns_round(speed: float, linear: float, quadratic: float) -> None:
    drag = Drag(linear + 0.1, quadratic)
    assert drag.speed(drag.force(speed)) == pytest.approx(speed, abs=1e-9)
    h = 1e-6
    # Away from 0, where the slope has a corner.
    if abs(speed) > 1e-3:
        slope = (drag.force(speed + h) - drag.force(speed - h)) / (2.0 * h)
        assert drag.slope(speed) == pytest.approx(slope, rel=1e-4)


@pytest.mark.parametrize("name", VEHICLES)
def test_packaged_gains_survive_the_file(name: str, tmp_path: Path) -> None:
    gains = load_gains(name)
    assert gains.vehicle.name == name
    path = tmp_path / "deep" / "gains.yaml"
    save_gains(gains, path)
    again = load_gains(path)
    assert gains_text(again) == gains_text(gains)
    assert again.range == gains.range
    assert again.yaw.greatest_rate == pytest.approx(gains.yaw.greatest_rate)


@pytest.fixture
def content() -> dict[str, object]:
    loaded: dict[str, object] = yaml.safe_load(gains_text(load_gains("bluerov2")))
    return loaded


def refusal(content: object, tmp_path: Path) -> str:
    path = tmp_path / "gains.yaml"
    path.write_text(yaml.safe_dump(content) if not isinstance(content, str) else content)
    with pytest.raises(OptionError) as caught:
        load_gains(path)
    text = str(caught.value)
    assert text.startswith(str(path))
    assert "\n" not in text
    return text.removeprefix(f"{path}: ")


@pytest.mark.parametrize(
    ("part", "key", "value", "words"),
    [
        ("range", "positon_per_s", 1.0, "did you mean 'position_per_s'?"),
        ("range", "speed_per_s", -1.0, "range.speed_per_s is -1.0"),
        ("range", "speed_per_s", "fast", "range.speed_per_s is 'fast'"),
        ("range", "lag_s", math.nan, "range.lag_s is nan"),
        ("yaw", "proportional_per_s", None, "yaw.proportional_per_s is empty"),
        ("vehicle", "mass_kg", 0.0, "vehicle.mass_kg is 0.0"),
    ],
)
def test_faults_are_told_in_one_line(
    content: dict[str, object], tmp_path: Path, part: str, key: str, value: object, words: str
) -> None:
    content[part][key] = value
    assert words in refusal(content, tmp_path)


def test_other_files_are_refused(content: dict[str, object], tmp_path: Path) -> None:
    assert "aqualvs_gains is missing" in refusal("- 1", tmp_path)
    assert "appears twice in line 2" in refusal("aqualvs_gains: 1\naqualvs_gains: 1", tmp_path)
    assert "is 2, but this aqualvs reads version 1" in refusal(
        {**content, "aqualvs_gains": 2}, tmp_path
    )
    thin = {key: value for key, value in content.items() if key != "yaw"}
    assert "yaw is missing" in refusal(thin, tmp_path)
    with pytest.raises(OptionError, match="neither a gains file nor one of"):
        load_gains("bluerov3")
    with pytest.raises(OptionError, match="no such file"):
        load_gains(tmp_path / "none.yaml")


def test_impossible_vehicles_are_refused() -> None:
    with pytest.raises(OptionError, match="thrust"):
        ThrustMap(forward=0.0, backward=1.0, right=1.0)
    with pytest.raises(OptionError, match="dead band"):
        ThrustMap(forward=1.0, backward=1.0, right=1.0, dead_band=1.0)


def test_default_gains_are_whole(content: dict[str, object]) -> None:
    assert isinstance(load_gains("videoray"), ControlGains)
    assert load_gains("videoray").vehicle.can_sway is False
    assert load_gains("bluerov2").vehicle.can_sway is True


@pytest.mark.parametrize("drag", [Drag(4.0, 18.0), Drag(0.0, 18.0), Drag(4.0, 0.0), Drag(0.0, 0.0)])
def test_coasting_speed_is_that_of_the_way(drag: Drag) -> None:
    speed, way, step = drag.coasting_speed(0.3, 5.0, 17.0), 0.0, 1e-3
    for _ in range(5000):
        speed -= 0.5 * step * drag.force(speed) / 17.0
        way += step * speed
        speed -= 0.5 * step * drag.force(speed) / 17.0
    assert way == pytest.approx(0.3, rel=1e-3)


def test_a_greater_drag_than_any_vehicles_gives_a_finite_speed() -> None:
    assert math.isfinite(Drag(0.0, 1e9).coasting_speed(0.3, 5.0, 1.0))
