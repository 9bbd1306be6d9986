"""The try-out dive `net_holes`: its log and truth agree with its scenes, and its holes are found.

With it: the commands that a simulated set of calibration pictures comes with.

Scans come from the true lit points instead of pictures, which would take minutes to render.
"""

import csv
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from aqualvs.cli.main import main
from aqualvs.errors import OptionError
from aqualvs.experiments import simulate as body
from aqualvs.optics.lens import LensModel
from aqualvs.optics.rigfile import rig_to_mapping
from aqualvs.optics.shutter import AT_ONCE
from aqualvs.results.folder import RunOutputs
from aqualvs.simulation.calibration_set import CalibrationFiles
from aqualvs.simulation.dive import (
    LEAD_S,
    NET_BEARING,
    NET_DEPTH,
    check_motion,
    shutter_from_words,
    write_hole_truth,
    write_vehicle_log,
)
from aqualvs.simulation.scenarios import example_rig, load_scenario
from aqualvs.vehicle_logs import VehiclePlaces, read_vehicle_log
from aqualvs.yamlfile import yaml_text
from net_cases import NetCamera

MEASURED = ["--temperature-c=4", "--salinity=30.5"]


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("net_holes")


@pytest.fixture(scope="module")
def log_file(scenario, tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "vehicle.csv"
    write_vehicle_log(scenario, path)
    return path


def rows(path):
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


def test_the_log_lies_on_the_dive_as_the_docs_say(scenario, log_file):
    """Bearing and depth of the plumb net come out of log and true posture, all the time."""
    log = read_vehicle_log(log_file)
    times = np.array(list(scenario.times()))
    normals = np.array([scenario.scene_at(t).target_plane().normal for t in times])
    yaw = np.arctan2(normals[:, 0], normals[:, 1])
    pitch = np.arctan2(normals[:, 2], normals[:, 1])
    places = VehiclePlaces(log, LEAD_S).at(times, yaw, pitch)
    assert places.bearing_valid.all()
    # The log's noise: 0.2 degrees and 5 mm.
    assert np.abs(np.rad2deg(places.bearing - NET_BEARING)).max() < 1.0
    assert np.abs(np.rad2deg(places.lean)).max() < 1.0
    assert np.rad2deg(np.std(places.bearing)) == pytest.approx(0.17, abs=0.08)
    middle = [
        scenario.trajectory.pose_at(t, scenario.duration).inverse().translation for t in times
    ]
    assert places.depth == pytest.approx(NET_DEPTH - np.array(middle)[:, 2], abs=0.03)
    begins, ends = log.span_s
    assert (begins, ends) == pytest.approx((0.0, scenario.duration + 2 * LEAD_S), abs=0.2)


def test_the_log_half_a_second_off_does_not_lie_on_the_dive(scenario, log_file):
    """Guard of the test above: then the bearing of the net is no longer steady."""
    times = np.array(list(scenario.times()))
    normals = np.array([scenario.scene_at(t).target_plane().normal for t in times])
    yaw = np.arctan2(normals[:, 0], normals[:, 1])
    places = VehiclePlaces(read_vehicle_log(log_file), LEAD_S + 0.5).at(times, yaw, 0.0)
    assert np.rad2deg(np.std(places.bearing)) > 1.0


def test_simulate_writes_log_and_holes_beside_a_dive_along_a_net(tmp_path, capsys):
    short = tmp_path / "short.yaml"
    short.write_text(
        "duration_s: 0.04\nmotion: {range_mm: 500, slide_x_mm: [0, -10]}\n"
        "net: {holes_mm: [[100, 50, 30]]}\n"
    )
    out = tmp_path / "dive"
    body.simulate(str(short), None, out, print, camera="ideal", overwrite=False)
    names = ["dive.mp4", "rig.yaml", "truth.csv", "truth_holes.csv", "vehicle.csv"]
    assert sorted(path.name for path in out.glob("[!.]*")) == names
    (hole,) = rows(out / "truth_holes.csv")
    expected = {"right_m": 0.1, "up_m": 0.05, "diameter_mm": 60.0, "depth_m": NET_DEPTH - 0.05}
    assert {name: float(hole[name]) for name in expected} == pytest.approx(expected)
    said = capsys.readouterr().out
    assert f"aqualvs net {out / 'run'} --log {out / 'vehicle.csv'} --log-offset-s 20" in said


@pytest.fixture
def files():
    """Names of a simulated set, of which nothing is rendered."""
    paths = {field.name: Path("out", field.name) for field in fields(CalibrationFiles)}
    return CalibrationFiles(**{**paths, "n_pictures": 43})


@pytest.mark.parametrize("model", list(LensModel))
def test_the_camera_s_step_names_the_model_of_a_fisheye_lens(files, model):
    rig = example_rig()
    rig = replace(rig, lens=replace(rig.lens, model=model))
    camera = body.calibration_commands(files, Path("out"), rig)[0]
    assert camera[:2] == ["calibrate", "camera"]
    assert ("--model fisheye" in " ".join(camera)) == (model is LensModel.FISHEYE)


@pytest.mark.parametrize(
    ("water", "steps"),
    [({"n": 1.34}, {}), ({"temperature_c": 4, "salinity_permille": 30.5}, {"water": MEASURED})],
)
def test_measured_water_goes_to_the_step_that_takes_it(
    files, tmp_path, monkeypatch, capsys, water, steps
):
    rig = rig_to_mapping(example_rig()) | {"water": water}
    (tmp_path / "rig.yaml").write_text(yaml_text(rig))
    monkeypatch.setattr(body, "simulate_calibration", lambda *_, **__: files)
    arguments = ["calibration", "--rig", str(tmp_path / "rig.yaml"), "-o", str(tmp_path / "out")]
    assert main(["simulate", *arguments]) == 0
    commands = [
        line.split() for line in capsys.readouterr().out.splitlines() if " aqualvs " in line
    ]
    told = {line[2] if line[1] == "calibrate" else line[1]: line for line in commands}
    found = {step: [word for word in line if word in MEASURED] for step, line in told.items()}
    assert {step: words for step, words in found.items() if words} == steps


@pytest.mark.parametrize(
    ("text", "n_notes"),
    [
        ("walls: [{yaw_deg: 20, pitch_deg: -10}]", 1),
        ("boxes: [{centre_mm: [0, 200, 0]}]", 1),
        ("walls: [{yaw_deg: 20}, {}]", 0),
        ("fish: 1", 0),
    ],
)
def test_simulate_says_that_what_is_ahead_has_no_true_posture(
    text, n_notes, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(body, "simulate_dive", lambda *_, **__: None)
    file = tmp_path / "dive.yaml"
    file.write_text(f"duration_s: 0.04\n{text}\n")
    body.simulate(str(file), None, tmp_path / "dive", print, camera="ideal", overwrite=False)
    assert capsys.readouterr().out.count("note: truth.csv states no posture") == n_notes


def test_without_lasers_no_state_of_the_net_is_offered(tmp_path, capsys):
    dark = tmp_path / "dark.yaml"
    dark.write_text("duration_s: 0.04\nnet: {}\nlasers_on: false\n")
    body.simulate(str(dark), None, tmp_path / "dive", print, camera="ideal", overwrite=False)
    said = capsys.readouterr().out
    assert "aqualvs run " in said
    assert "aqualvs net " not in said


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("motion: {range_mm: -300}", "range is -300 mm; it must be positive"),
        ("motion: {yaw_deg: [0, 95]}", "pitch 0 and yaw 8.* deg: the target would be seen edge on"),
        # The log goes on before and after the dive.
        ("motion: {range_mm: {values: [300], sway: 400}}", "range is -.* mm; it must be positive"),
    ],
)
def test_a_motion_that_cannot_be_is_refused_before_anything_is_written(
    text, said, tmp_path, capsys
):
    file, out = tmp_path / "dive.yaml", tmp_path / "dive"
    file.write_text(f"duration_s: 0.4\nnet: {{}}\n{text}\n")
    with pytest.raises(OptionError, match=rf"^scenario .*dive\.yaml: motion: {said}"):
        body.simulate(str(file), None, out, print, camera="ideal", overwrite=False)
    assert not out.exists()
    assert "frames" not in capsys.readouterr().err


def test_the_motion_is_checked_in_every_row_that_a_shutter_takes(tmp_path):
    file = tmp_path / "dive.yaml"
    # At the time of each frame the sway is at rest; its peaks are halfway between them.
    file.write_text(
        "duration_s: 0.4\nwalls: [{}]\n"
        "motion: {range_mm: {values: [300], sway: 400, period_s: 0.08}}\n"
    )
    course = load_scenario(file)
    check_motion(course, AT_ONCE, "here")
    with pytest.raises(OptionError, match="here: range is -100 mm"):
        check_motion(course, shutter_from_words("rolling:40", course.fps), "here")


def test_the_holes_of_the_try_out_are_found_where_they_are(scenario, log_file, tmp_path):
    """The first of them, to save time."""
    rig = example_rig()
    run, truth = tmp_path / "run", tmp_path / "truth_holes.csv"
    run.mkdir()
    write_hole_truth(scenario, truth)
    camera = NetCamera(rig)
    with RunOutputs(run, source={}, rig=rig_to_mapping(rig), options={}) as outputs:
        for i, t in enumerate(t for t in scenario.times() if t < 3.6):
            outputs.write(camera.scan(scenario.scene_at(t), t, i))
    assert main(["net", str(run), "--log", str(log_file), "--log-offset-s", str(LEAD_S)]) == 0
    found, true = rows(run / "holes.csv"), rows(truth)[:1]
    assert len(found) == 1
    for one, other in zip(found, true, strict=True):
        # The middle of what three lasers saw of a hole is within two meshes of the hole's.
        assert float(one["along_m"]) == pytest.approx(float(other["right_m"]), abs=0.05)
        assert float(one["depth_m"]) == pytest.approx(float(other["depth_m"]), abs=0.06)
        assert float(one["bearing_deg"]) == pytest.approx(float(other["bearing_deg"]), abs=0.5)
        assert float(one["time_s"]) == pytest.approx(float(other["time_s"]), abs=0.8)
        assert float(one["diameter_mm"]) == pytest.approx(float(other["diameter_mm"]), rel=0.45)
    (stretch,) = rows(run / "net.csv")
    assert float(stretch["bar_mm"]) == pytest.approx(25.0, rel=0.05)
    assert float(stretch["fouling"]) > 0.02
