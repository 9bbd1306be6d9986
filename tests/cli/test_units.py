"""Lengths and salinities in another unit than the option's."""

import pytest
import yaml

from aqualvs.cli.main import main
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


def test_a_share_of_salt_is_remarked(capfd, refused):
    run = ["run", "nothing.mp4", "--rig", "rig.yaml", "--temperature-c", "12"]
    for salinity in ("35", "0", "0.5"):
        assert "per mille" not in refused(*run, "--salinity", salinity)
    assert main([*run, "--salinity", "0.035"]) == 2
    first = capfd.readouterr().err.splitlines()[0]
    assert first == "aqualvs: remark: --salinity 0.035: salinity is per mille; sea water has 35"
