"""`aqualvs simulate`, and what it writes through `aqualvs run`."""

import re

import av
import pytest

from aqualvs.cli.main import main
from aqualvs.experiments.simulate import CALIBRATION
from aqualvs.simulation.cameras import list_cameras
from aqualvs.simulation.scenarios import list_scenarios
from shell_cases import rig_file


def test_the_list_names_every_scenario(capsys):
    assert main(["simulate", "--list"]) == 0
    said = capsys.readouterr().out
    assert [line.split()[0] for line in said.splitlines()] == [*list_scenarios(), CALIBRATION]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "SCENARIO"),
        (["wall"], "--out"),
        (["nowhere", "-o", "x"], "nowhere"),
        (["missing.yaml", "-o", "x"], "missing.yaml"),
        (["wall", "-o", "x", "--rig", "missing-rig.yaml"], "missing-rig.yaml"),
        (["wall", "-o", "x", "--camera", "gopro"], "--camera gopro"),
        (["wall", "-o", "x", "--shutter", "roll:20"], "such as rolling:20:8"),
        (["wall", "-o", "x", "--shutter", "rolling:90:8"], "lower the scenario's fps"),
        (["calibration", "-o", "x", "--shutter", "rolling:20"], "boards stand still"),
    ],
)
def test_bad_input_gives_one_line(arguments, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", *arguments]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert words in said
    assert list(tmp_path.iterdir()) == []


def test_the_help_names_every_camera(capsys):
    assert main(["simulate", "--help"]) == 0
    words = set(re.findall(r"[a-z]+", capsys.readouterr().out))
    assert words >= set(list_cameras())


def test_an_existing_dive_is_kept(tmp_path, capsys):
    (tmp_path / "dive.mp4").write_bytes(b"precious")
    rig = rig_file(tmp_path).rename(tmp_path / "mine.yaml")
    assert main(["simulate", "wall", "-o", str(tmp_path), "--rig", str(rig), "--overwrite"]) == 2
    assert "did not write it" in capsys.readouterr().err
    assert (tmp_path / "dive.mp4").read_bytes() == b"precious"


def test_an_existing_set_of_calibration_pictures_is_kept(tmp_path, capsys):
    (tmp_path / "box").mkdir()
    assert main(["simulate", "calibration", "-o", str(tmp_path)]) == 2
    assert "did not write it" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["box"]


def test_a_simulated_dive_runs_against_its_truth(tmp_path, capsys):
    scenario = tmp_path / "short.yaml"
    scenario.write_text("duration_s: 0.12\nmotion: {range_mm: [500, 520]}\nwalls: [{}]\n")
    dive = tmp_path / "dive"
    assert main(["simulate", str(scenario), "-o", str(dive)]) == 0
    names = [".aqualvs.json", "dive.mp4", "rig.yaml", "truth.csv"]
    assert sorted(p.name for p in dive.iterdir()) == names
    assert main(["simulate", str(scenario), "-o", str(dive)]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main(["simulate", str(scenario), "-o", str(dive), "--overwrite"]) == 0
    said = capsys.readouterr().out
    command = next(line for line in said.splitlines() if line.startswith("next: aqualvs "))
    assert main([*command.removeprefix("next: aqualvs ").split(), "--no-report"]) == 0
    assert "against the truth in 3 frames" in capsys.readouterr().out


def test_a_real_camera_s_dive_is_another_picture_of_the_same_truth(tmp_path):
    scenario = tmp_path / "short.yaml"
    scenario.write_text("duration_s: 0.04\nmotion: {range_mm: 500}\nwalls: [{}]\n")
    for camera in ("ideal", "webcam"):
        arguments = ["--camera", camera, "--rig", str(rig_file(tmp_path))]
        assert main(["simulate", str(scenario), "-o", str(tmp_path / camera), *arguments]) == 0
    ideal, webcam = (tmp_path / name for name in ("ideal", "webcam"))
    assert (ideal / "truth.csv").read_bytes() == (webcam / "truth.csv").read_bytes()
    codecs = []
    for folder in (ideal, webcam):
        with av.open(str(folder / "dive.mp4")) as container:
            codecs.append(container.streams.video[0].codec_context.name)
    assert codecs == ["h264", "mjpeg"]
