"""Lengths and salinities in another unit than the option's."""

import pytest
import yaml

from shell_cases import rig_file


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["net", "run", "--twine-mm", "0.002"],
            "--twine-mm 0.002: give the diameter of one twine in millimetres, 0.1 to 50",
        ),
        (
            ["net", "run", "--twine-mm", "200"],
            "--twine-mm 200: give the diameter of one twine in millimetres, 0.1 to 50",
        ),
        (
            ["run", ".", "--rig", "rig.yaml", "--target", "net.yaml"],
            "net.yaml: net.twine_mm is 30, not thinner than the bar of 25 mm; write the diameter "
            "of one twine in millimetres",
        ),
        (
            ["board", "charuco", "-o", "board", "--square-mm", "0.02"],
            "--square-mm 0.02: give millimetres, 1 or more",
        ),
        (
            [
                *("calibrate", "dome", "x.png", "--board", "b.yaml", "--rig", "rig.yaml"),
                *("-o", "r.yaml", "--radius-tolerance-mm", "-1"),
            ],
            "--radius-tolerance-mm -1: give 0 or more",
        ),
        (
            [
                *("calibrate", "water", "dive.mp4", "--target", "t.yaml", "--rig", "rig.yaml"),
                *("-o", "r.yaml", "--turn-sigma-deg", "-1"),
            ],
            "--turn-sigma-deg -1: give 0 or more",
        ),
        (
            ["check", "metres.yaml"],
            "metres.yaml: working_range_mm is [0.3, 1], but these are millimetres; write [300, "
            "1000] if metres are meant",
        ),
    ],
)
def test_other_units_are_refused(arguments, said, refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    content = yaml.safe_load(rig_file(tmp_path).read_text())
    (tmp_path / "metres.yaml").write_text(
        yaml.safe_dump({**content, "working_range_mm": [0.3, 1.0]})
    )
    (tmp_path / "net.yaml").write_text("kind: net\nnet: {bar_mm: 25, twine_mm: 30}\n")
    assert refused(*arguments) == said


def test_a_design_in_metres_is_refused(refused):
    said = refused("design", "--range-mm", "0.3:1.2")
    assert "[0.3, 1.2], but these are millimetres; write [300, 1200] if" in said


@pytest.mark.parametrize("command", ["run", "live", "batch", "calibrate water"])
@pytest.mark.parametrize(
    ("option", "value", "remedy"),
    [
        ("--salinity", "0.035", "give per mille, from 0 to 40: 0 for fresh water, 35 if a share"),
        ("--salinity", "-1", "give per mille, from 0 to 40"),
        ("--salinity", "350", "give per mille, from 0 to 40"),
        ("--temperature-c", "288", "give degrees Celsius, from 0 to 30; 14.85 if kelvin are meant"),
        ("--temperature-c", "59", "give degrees Celsius, from 0 to 30; 15 if degrees Fahrenheit"),
        ("--temperature-c", "33", "give degrees Celsius, from 0 to 30; for warmer water give its"),
        ("--temperature-c", "-3", "give degrees Celsius, from 0 to 30"),
    ],
)
def test_every_command_refuses_what_is_no_water(command, option, value, remedy, refused, tmp_path):
    rig = rig_file(tmp_path)
    arguments = [*command.split(), "dive.mp4", "--rig", rig, option, value]
    if command != "live":
        arguments += ["-o", tmp_path / "out"]
    if command == "calibrate water":
        arguments += ["--target", "target.yaml"]
    assert f"{option} {value}: {remedy}" in refused(*arguments)


@pytest.mark.parametrize("salinity", ["35", "0", "0.5"])
def test_water_is_taken(salinity, refused):
    run = ["run", "nothing.mp4", "--rig", "rig.yaml", "--temperature-c", "12"]
    assert "per mille" not in refused(*run, "--salinity", salinity)


@pytest.mark.parametrize(
    ("option", "value", "remedy"),
    [
        ("--inner-radius-mm", "0.044", "give millimetres, from 1 to 2000; 44 if metres are meant"),
        ("--inner-radius-mm", "44000", "give millimetres, from 1 to 2000"),
        ("--thickness-mm", "0.006", "give millimetres, from 0.1 to 200; 6 if metres are meant"),
        ("--port-distance-mm", "0.012", "give millimetres, from 0.1 to 2000; 12 if metres are"),
        ("--n-acrylic", "149", "give a refractive index, 1 to 3; acrylic has 1.49"),
    ],
)
def test_housings_that_cannot_be_are_refused(option, value, remedy, refused):
    dome = ["calibrate", "dome", "x.png", "--board", "b.yaml", "--rig", "rig.yaml", "-o", "r.yaml"]
    assert f"{option} {value}: {remedy}" in refused(*dome, option, value)


@pytest.mark.parametrize(
    ("part", "said"),
    [
        (
            {"dome": {"inner_radius_mm": 0.044, "thickness_mm": 0.006, "n_acrylic": 1.49}},
            "dome.inner_radius_mm is 0.044, but these are millimetres; write 44 if metres are",
        ),
        (
            {"water": {"temperature_c": 15, "salinity_permille": 0.038}},
            "water.salinity_permille is 0.038; give per mille, from 0 to 40: 0 for fresh water, 38",
        ),
    ],
)
def test_rig_files_in_other_units_are_refused(part, said, refused, tmp_path):
    path = rig_file(tmp_path)
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), **part}))
    assert said in refused("check", path)
