"""Scenarios: built in, from files, at random."""

import numpy as np
import pytest
from benchmarks.random_scenes import random_scene

from aqualvs.errors import OptionError
from aqualvs.simulation.scenarios import list_scenarios, load_scenario


@pytest.mark.parametrize("name", list_scenarios())
def test_every_built_in_scenario_loads_and_moves(name):
    scenario = load_scenario(name)
    assert scenario.n_frames == len(list(scenario.times())) >= 25
    for t in scenario.times():
        plane = scenario.scene_at(t).target_plane()
        assert 0.25 < plane.offset < 1.3
    expected = "net" if scenario.nets else "wall"
    assert scenario.target == ("none" if name == "empty" else expected)


def test_lasers_off_and_clutter_do_what_they_are_called():
    assert not load_scenario("lasers_off").lasers_on
    clutter = load_scenario("net_clutter")
    assert clutter.nets[0].holes
    assert clutter.walls[0].depth > 0
    assert clutter.fish
    assert clutter.bubbles
    assert clutter.boxes


def _file(tmp_path, text):
    path = tmp_path / "dive.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_file_is_read_in_its_units(tmp_path):
    scenario = load_scenario(
        _file(
            tmp_path,
            """
            duration_s: 2
            fps: 10
            seed: 5
            motion: {range_mm: [400, 800], yaw_deg: {values: [10], sway: 2, period_s: 8}}
            net: {mesh: hexagon, bar_mm: 30, twine_mm: 3, roll_deg: 90, holes_mm: [[10, 20, 30]]}
            walls: [{behind_mm: 500}]
            water: {attenuation_per_m: [1, 2, 3], caustics: 0.5}
            lasers_on: false
            """,
        )
    )
    assert (scenario.name, scenario.n_frames, scenario.seed) == ("dive", 20, 5)
    assert scenario.scene_at(0.0).target_plane().offset == pytest.approx(0.4)
    normal = scenario.scene_at(2.0).target_plane().normal
    assert np.rad2deg(np.arctan2(normal[0], normal[1])) == pytest.approx(12.0)
    net = scenario.nets[0]
    assert (net.bar, net.twine, *net.holes[0]) == pytest.approx((0.03, 0.003, 0.01, 0.02, 0.03))
    assert net.roll == pytest.approx(np.pi / 2)
    assert scenario.walls[0].depth == pytest.approx(0.5)
    assert scenario.water.attenuation == (1.0, 2.0, 3.0)
    assert not scenario.lasers_on


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("nett: {}", "nett is not a key of this file; did you mean 'net'?"),
        ("net: {bar: 25}", "net.bar is not a key of this file; did you mean 'bar_mm'?"),
        ("motion: {rolling: 3}", "allowed here: range_mm"),
        ("net: {bar_mm: -3}", "net.bar_mm is -3"),
        (
            "net: {twine_mm: 40}",
            "net.twine_mm is 40, not thinner than the bar of 25 mm; write the diameter of one "
            "twine in millimetres",
        ),
        ("net: {bar_mm: 2}", "net.twine_mm is 2, not thinner than the bar of 2 mm"),
        ("net: {mesh: round}", "net.mesh is 'round'"),
        ("duration_s: .nan", "duration_s is nan"),
        (
            "walls: [{behind: 3}]",
            "walls[0].behind is not a key of this file; did you mean 'behind_mm'?",
        ),
        (
            "motion: {range_mm: {values: [500], mode: jump}}",
            "motion.range_mm.mode is 'jump'; write 'smooth' or 'steps'",
        ),
        ("motion: {range_mm: {sway: 5}}", "motion.range_mm.values is missing; add it"),
        (
            "motion: {range_mm: {values: [500], swey: 3}}",
            "motion.range_mm.swey is not a key of this file; did you mean 'sway'?",
        ),
        ("motion: {range_mm: [500, abc]}", "motion.range_mm[1] is 'abc'; write a plain number"),
        ("motion: {range_mm: abc}", "motion.range_mm is 'abc'; write a plain number"),
        ("motion: {range_mm: []}", "motion.range_mm is []; write one value or more"),
        ("motion: {yaw_deg: {values: []}}", "motion.yaw_deg.values is []; write one value or more"),
        ("fish: 2.5", "fish is 2.5; write a whole number"),
        ("lasers_on: maybe", "lasers_on is 'maybe'; write true or false"),
        ("water: {veil: 3}", "water.veil is 3; write a list"),
        ("[1, 2", "not YAML"),
        ("- 1", "the file is [1]"),
    ],
)
def test_a_faulty_file_gets_one_line_with_file_value_and_remedy(tmp_path, text, says):
    path = _file(tmp_path, text)
    with pytest.raises(OptionError) as caught:
        load_scenario(path)
    message = str(caught.value)
    assert says in message
    assert str(path) in message
    assert "\n" not in message


def test_missing_file_and_unknown_name_are_told_apart(tmp_path):
    with pytest.raises(OptionError, match="no such file"):
        load_scenario(tmp_path / "none.yaml")
    with pytest.raises(OptionError, match="choose one of wall, wall_range"):
        load_scenario("walll")


def test_random_scenes_stay_in_their_limits_and_repeat():
    seen = [random_scene(np.random.default_rng([3, i]), "hard") for i in range(200)]
    again = random_scene(np.random.default_rng([3, 17]), "hard")
    assert again.nets == seen[17].nets
    assert again.fish == seen[17].fish
    ranges = np.array([scene.target_plane().offset for scene in seen])
    nets = [scene.nets[0] for scene in seen]
    assert 0.3 <= ranges.min() < 0.35
    assert 0.95 < ranges.max() <= 1.0
    assert all(0.015 <= net.bar <= 0.05 and 0.001 <= net.twine <= 0.004 for net in nets)
    assert max(net.fouling for net in nets) > 0.5
    assert {net.mesh for net in nets} == {"diamond", "square", "hexagon"}
    clean = random_scene(np.random.default_rng(1), "clean")
    assert not clean.fish
    assert not clean.bubbles
    assert clean.nets[0].fouling == 0.0
    with pytest.raises(OptionError, match="choose one of clean, usual, hard"):
        random_scene(np.random.default_rng(1), "easy")
