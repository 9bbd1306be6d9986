"""`aqualvs simulate`, and what it writes through `aqualvs run`."""

import csv
import re
import shlex
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial

import av
import pytest

from aqualvs.calibration.targets.target_files import load_board
from aqualvs.cli.main import main
from aqualvs.experiments.simulate import CALIBRATION
from aqualvs.optics.rigfile import load_rig, save_rig
from aqualvs.optics.shutter import AT_ONCE, Shutter, ShutterKind
from aqualvs.simulation import dive as dive_of
from aqualvs.simulation.calibration_set import SetSize
from aqualvs.simulation.cameras import CAMERAS
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenarios import list_scenarios
from aqualvs.sources import open_source
from complaints import complaints
from panel_cases import small_rig
from shell_cases import rig_file
from waiting import TIMEOUT_S, until

INTERLACED = Shutter(kind=ShutterKind.INTERLACED, readout=0.02)


@pytest.fixture(autouse=True)
def one_ray_a_pixel(monkeypatch):
    """What is tested is what is written; the pictures of processes have all rays."""
    monkeypatch.setattr(dive_of, "Renderer", partial(Renderer, samples=1))


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
        (["wall", "-o", "x", "--shutter", "rolling:90:8"], "lower fps"),
        (["calibration", "-o", "x", "--shutter", "rolling:20"], "boards stand still"),
    ],
)
def test_bad_input_gives_one_line(arguments, words, refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert words in refused("simulate", *arguments)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("what", ["wall", "calibration"])
@pytest.mark.parametrize(
    ("size_px", "shutter", "written"),
    [
        ((361, 289), AT_ONCE, "needs even sides; write 362x290"),
        ((360, 290), INTERLACED, "a height that 4 divides; write 360x292"),
    ],
)
def test_a_size_that_no_video_holds_is_refused_before_rendering(
    tmp_path, refused, what, size_px, shutter, written
):
    rig, out = tmp_path / "odd.yaml", tmp_path / "out"
    save_rig(replace(small_rig(), size_px=size_px, shutter=shutter), rig)
    said = refused("simulate", what, "--rig", rig, "-o", out)
    assert f"{rig}: image is {size_px[0]}x{size_px[1]} px" in said
    assert written in said
    assert not out.exists()


def test_a_shutter_too_slow_for_the_dive_of_a_set_is_refused_before_rendering(tmp_path, refused):
    rig, out = tmp_path / "slow.yaml", tmp_path / "out"
    slow = Shutter(kind=ShutterKind.ROLLING, readout=0.06)
    save_rig(replace(small_rig(), shutter=slow), rig)
    assert "takes 60 ms for a picture" in refused(
        "simulate", "calibration", "--rig", rig, "-o", out
    )
    assert not out.exists()


def test_the_help_names_every_camera(capsys):
    assert main(["simulate", "--help"]) == 0
    words = set(re.findall(r"[a-z]+", capsys.readouterr().out))
    assert words >= set(CAMERAS)


def test_an_existing_dive_is_kept(tmp_path, refused):
    (tmp_path / "dive.mp4").write_bytes(b"precious")
    rig = rig_file(tmp_path).rename(tmp_path / "mine.yaml")
    said = refused("simulate", "wall", "-o", tmp_path, "--rig", rig, "--overwrite")
    assert "did not write it" in said
    assert (tmp_path / "dive.mp4").read_bytes() == b"precious"


def test_an_existing_set_of_calibration_pictures_is_kept(tmp_path, refused):
    (tmp_path / "box").mkdir()
    assert "did not write it" in refused("simulate", "calibration", "-o", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["box"]


def test_a_simulated_dive_runs_against_its_truth(tmp_path, capfd, refused):
    scenario = tmp_path / "short.yaml"
    scenario.write_text("duration_s: 0.12\nmotion: {range_mm: [500, 520]}\nwalls: [{}]\n")
    dive = tmp_path / "a dive"
    assert main(["simulate", str(scenario), "-o", str(dive)]) == 0
    names = [".aqualvs.json", "dive.mp4", "rig.yaml", "truth.csv"]
    assert sorted(p.name for p in dive.iterdir()) == names
    assert "--overwrite" in refused("simulate", scenario, "-o", dive)
    assert main(["simulate", str(scenario), "-o", str(dive), "--overwrite"]) == 0
    said = capfd.readouterr().out
    command = next(line for line in said.splitlines() if line.startswith("  aqualvs run "))
    assert main([*shlex.split(command)[1:], "--no-report"]) == 0
    assert "against the truth in 3 frames" in capfd.readouterr().out


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


def interrupted(begun, *arguments):
    """Send SIGINT once the simulation has come so far, and return what it says on its output."""
    command = [sys.executable, "-m", "aqualvs", "simulate", *map(str, arguments)]
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True)
    # Once it tells of its progress, signals are caught.
    assert "frames" in process.stderr.readline() or begun is not None
    if begun is not None:
        until(begun.exists, f"{begun}")
    process.send_signal(signal.SIGINT)
    said, errors = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 128 + signal.SIGINT, errors
    assert complaints(errors) == []
    return said


def test_ctrl_c_leaves_a_dive_that_can_be_measured(tmp_path):
    said = interrupted(None, "wall", "-o", tmp_path)
    n_done, n_all = map(
        int, re.search(r"stopped by SIGINT after (\d+) of (\d+) frames", said).groups()
    )
    assert 0 < n_done < n_all
    n_rows = len((tmp_path / "truth.csv").read_text().splitlines()) - 1
    with open_source(tmp_path / "dive.mp4") as source:
        assert sum(1 for _ in source) == n_rows == n_done
    command = next(line for line in said.splitlines() if line.startswith("  aqualvs run "))
    assert main([*shlex.split(command)[1:], "--no-report"]) == 0


def test_ctrl_c_leaves_whole_folders_of_calibration_pictures(tmp_path):
    save_rig(small_rig(), tmp_path / "small.yaml")
    out = tmp_path / "out"
    rig = ("--rig", tmp_path / "small.yaml")
    said = interrupted(out / "dome_air", "calibration", *rig, "-o", out)
    complete = re.search(r"stopped by SIGINT after \d+ of 43 pictures; complete in .*: (.*)", said)
    assert "camera_air" in complete[1].split(", ")
    assert "dive" not in complete[1].split(", ")
    assert len(list((out / "camera_air").glob("*.png"))) == SetSize().camera
    load_board(out / "camera_air" / "board.yaml")
    assert (out / "nominal.yaml").is_file()


def test_a_camera_with_a_sensor_of_its_own_refuses_that_of_a_scenario(tmp_path, refused):
    dive, out = tmp_path / "dive.yaml", tmp_path / "out"
    dive.write_text("walls: [{}]\nsensor: {defocus_px: 3}\n")
    said = refused("simulate", str(dive), "--camera", "webcam", "-o", str(out))
    assert f"scenario {dive}: sensor: --camera webcam has its own" in said
    assert not out.exists()


def test_a_scenario_may_state_the_shutter(tmp_path, refused):
    small = rig_file(tmp_path)
    dive = tmp_path / "dive.yaml"
    dive.write_text("duration_s: 0.08\nfps: 25\nwalls: [{}]\nshutter: interlaced\n")
    out = tmp_path / "out"
    assert main(["simulate", str(dive), "--rig", str(small), "-o", str(out)]) == 0
    shutter = load_rig(out / "rig.yaml").shutter
    assert (shutter.kind.value, shutter.readout) == ("interlaced", 0.02)
    with (out / "truth.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    found = [(row["frame"], float(row["time_s"]), row["field"]) for row in rows]
    fields = [("0", 0.0, "top"), ("1", 0.02, "bottom"), ("2", 0.04, "top"), ("3", 0.06, "bottom")]
    assert found == fields
    with open_source(out / "dive.mp4") as source:
        assert {frame.is_interlaced for frame in source} == {True}
    # The option counts before the file, and a fault in the file is the file's.
    out = tmp_path / "other"
    arguments = ["simulate", str(dive), "--rig", str(small), "-o", str(out)]
    assert main([*arguments, "--shutter", "global"]) == 0
    assert load_rig(out / "rig.yaml").shutter == AT_ONCE
    dive.write_text("walls: [{}]\nshutter: comb\n")
    assert f"scenario {dive}: shutter: 'comb' is none" in refused(*arguments, "--overwrite")
