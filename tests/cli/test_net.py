"""`aqualvs net` and `aqualvs run --net`, from scans and pictures to the files."""

import csv
import json
import os
import signal

import numpy as np
import pytest
import yaml
from pyarrow import parquet

from aqualvs.cli.main import main
from aqualvs.net_survey import command as body
from aqualvs.nets.target_file import NetRequest
from aqualvs.optics.rigfile import rig_to_mapping
from aqualvs.results.folder import NET_FILES, RunOutputs
from aqualvs.results.net_survey import NetPass, read_run
from aqualvs.results.points import PointsStream
from aqualvs.simulation.scenarios import example_rig
from aqualvs.simulation.scene import Net
from net_app_cases import leave_maps_blank
from net_cases import passing
from shell_cases import rig_file, write_video

SPEED, SECONDS, FPS = 0.2, 6.2, 25.0
HOLE = (0.3, 0.02, 0.06)
FEW = 36
DEPTH = 7.0
OFFSET_S = 12.5


def write_run(folder, scans, rig=None):
    """Write the folder of a run of these scans."""
    folder.mkdir(parents=True, exist_ok=True)
    rig = rig or example_rig()
    with RunOutputs(
        folder, source={"name": "dive.mp4"}, rig=rig_to_mapping(rig), options={}
    ) as out:
        for scan in scans:
            out.write(scan)
    return folder


def write_log(path, *, heading_deg=80.0):
    """Write a log of a vehicle that keeps its depth and heading; its clock is `OFFSET_S` ahead."""
    times = np.arange(0.0, 25.0, 0.1)
    rows = "".join(f"{t:.1f},{DEPTH:.2f},{heading_deg:.1f}\n" for t in times)
    path.write_text(f"time_s,depth_m,heading_deg\n{rows}")
    return path


@pytest.fixture(scope="module")
def scans():
    net = Net(mesh="square", bar=0.025, twine=0.0025, roll=0.3, holes=(HOLE,))
    n_frames = round(SECONDS * FPS)
    return passing(net, distance=0.5, speed=(SPEED, 0.0), n_frames=n_frames, fps=FPS, yaw_deg=5.0)


@pytest.fixture
def blank_maps(monkeypatch):
    leave_maps_blank(monkeypatch)


@pytest.fixture
def run_folder(scans, tmp_path, blank_maps):
    """The first second and a half of it: enough for what is no matter of the net."""
    return write_run(tmp_path / "run", scans[:FEW])


def rows(path):
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


def test_from_a_run_to_the_state_of_its_net(scans, tmp_path, capsys):
    run_folder = write_run(tmp_path / "run", scans)
    log = write_log(tmp_path / "vehicle.csv")
    arguments = ["--log", str(log), "--log-offset-s", str(OFFSET_S), "--stretch-m", "0.25"]
    assert main(["net", str(run_folder), *arguments]) == 0
    said = capsys.readouterr().out
    assert "four-sided meshes of 2" in said
    assert "1 hole" in said
    assert f"its clock minus the dive's is {OFFSET_S:.2f} s (given by the user)" in said
    assert str(run_folder / "net_map.png") in said
    assert {path.name for path in run_folder.iterdir()} > set(NET_FILES)
    stretches = rows(run_folder / "net.csv")
    assert len(stretches) >= 2
    for row in stretches:
        assert float(row["bar_mm"]) == pytest.approx(25.0, rel=0.05)
        # The vehicle is level, the net leans back by the posture's pitch of 3 degrees.
        assert float(row["depth_m"]) == pytest.approx(
            DEPTH - 0.5 * np.sin(np.deg2rad(3.0)), abs=0.01
        )
        assert float(row["bearing_deg"]) == pytest.approx(85.0, abs=0.1)
    way = float(stretches[-1]["right_m"])
    assert way == pytest.approx(SPEED * (SECONDS - 1.0 / FPS), abs=0.02)
    (hole,) = rows(run_folder / "holes.csv")
    assert float(hole["along_m"]) == pytest.approx(HOLE[0], abs=0.03)
    up = DEPTH - 0.5 * np.sin(np.deg2rad(3.0)) - float(hole["depth_m"])
    assert up == pytest.approx(HOLE[1], abs=0.03)
    # Seen through a few lines only: good to a bar.
    assert float(hole["diameter_mm"]) == pytest.approx(2e3 * HOLE[2], abs=30.0)
    facts = json.loads((run_folder / "net.geojson").read_text())["aqualvs_net"]
    assert facts["log"]["used"]
    assert facts["log"]["covered"] == 1.0
    assert (facts["summary"]["n_holes"], facts["summary"]["track_slip_m"]) == (1, 0.0)


def test_a_dive_of_which_frames_are_missing_is_told(run_folder, capsys):
    """No hole in what is left of a dive says nothing of the rest."""
    path, run_yaml = run_folder / "posture.csv", run_folder / "run.yaml"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:10]))
    assert main(["net", str(run_folder)]) == 0
    said = capsys.readouterr().out
    assert f"posture.csv holds 9 of the run's {FEW} frames" in said
    assert main(["report", str(run_folder)]) == 0
    page = (run_folder / "report.html").read_text(encoding="utf-8")
    assert f"posture.csv holds 9 of the run&#x27;s {FEW} frames" in page
    path.write_text("".join(lines))
    run_yaml.write_text(run_yaml.read_text().replace("finished", "interrupted"))
    assert main(["net", str(run_folder), "--overwrite"]) == 0
    said = capsys.readouterr().out
    assert (
        f"warning: the run did not finish (status: interrupted): the net is that of its first {FEW}"
        in said
    )


def test_another_folder_keeps_the_run_as_it_is(run_folder, tmp_path):
    before = sorted(path.name for path in run_folder.iterdir())
    assert main(["net", str(run_folder), "-o", str(tmp_path / "net")]) == 0
    assert sorted(path.name for path in (tmp_path / "net").glob("[!.]*")) == sorted(NET_FILES)
    assert sorted(path.name for path in run_folder.iterdir()) == before


def test_the_state_of_a_net_is_not_overwritten_unasked(run_folder, refused):
    (run_folder / "holes.csv").write_text("precious")
    assert "--overwrite" in refused("net", run_folder)
    assert (run_folder / "holes.csv").read_text() == "precious"
    assert main(["net", str(run_folder), "--overwrite"]) == 0
    assert (run_folder / "holes.csv").read_text().startswith("hole,piece,")


def test_files_of_others_in_the_nets_place_stay(run_folder, tmp_path, refused):
    out = tmp_path / "out"
    out.mkdir()
    (out / "holes.csv").write_text("precious")
    assert "did not write it" in refused("net", run_folder, "-o", out, "--overwrite")
    assert (out / "holes.csv").read_text() == "precious"


def test_the_report_of_the_run_gets_its_section(run_folder):
    (run_folder / "report.html").write_text("old")
    assert main(["net", str(run_folder)]) == 0
    assert '<section id="net">' in (run_folder / "report.html").read_text(encoding="utf-8")


def test_a_log_of_another_time_is_not_used_and_the_rest_is_written(run_folder, tmp_path, capsys):
    log = write_log(tmp_path / "vehicle.csv")
    assert main(["net", str(run_folder), "--log", str(log), "--log-offset-s", "1000"]) == 0
    assert "is not used: it covers 0.0 to 24.9 s of its own clock" in capsys.readouterr().out
    assert rows(run_folder / "net.csv")[0]["depth_m"] == ""


def test_an_offset_that_cannot_be_found_is_told(run_folder, tmp_path, capsys):
    log = write_log(tmp_path / "vehicle.csv")
    assert main(["net", str(run_folder), "--log", str(log)]) == 0
    said = capsys.readouterr().out
    assert "is not used: dive and log share at most" in said
    assert "--log-offset-s" in said
    assert (run_folder / "net_map.png").exists()
    facts = json.loads((run_folder / "net.geojson").read_text())["aqualvs_net"]
    assert not facts["log"]["used"]
    assert facts["log"]["refused"]


def test_stopping_tells_of_what_came_before(run_folder, monkeypatch, capsys):
    def interrupted(folder):
        for i, scan in enumerate(read_run(folder)):
            if i == 20:
                os.kill(os.getpid(), signal.SIGINT)
            yield scan

    monkeypatch.setattr(body, "read_run", interrupted)
    assert main(["net", str(run_folder)]) == 130
    assert "stopped by SIGINT" in capsys.readouterr().out
    assert int(rows(run_folder / "net.csv")[-1]["last_frame"]) == 20


@pytest.mark.usefixtures("blank_maps")
def test_a_killed_run_is_completed_first(scans, tmp_path, capsys):
    folder = write_run(tmp_path / "run", scans[:FEW])
    content = yaml.safe_load((folder / "run.yaml").read_text())
    (folder / "points.parquet").unlink()
    with PointsStream(folder / "points.arrows") as points_stream:
        for scan in scans[:FEW]:
            points_stream.write(scan)
    (folder / "run.yaml").write_text(yaml.safe_dump(content | {"status": "running"}))
    assert main(["net", str(folder)]) == 0
    assert "points completed" in capsys.readouterr().out
    assert int(rows(folder / "net.csv")[-1]["last_frame"]) == FEW - 1


@pytest.fixture(scope="module")
def dive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dive")
    return write_video(folder / "dive.mp4", 4), rig_file(folder)


@pytest.mark.parametrize("command", ["net", "run"])
def test_a_dive_without_a_net_says_so(command, dive, tmp_path, capsys):
    video, rig = dive
    out = tmp_path / "out"
    more = ["--net"] if command == "run" else []
    assert main([command, str(video), "--rig", str(rig), "-o", str(out), *more]) == 0
    assert "no net was seen in 4 frames" in capsys.readouterr().out
    assert rows(out / "net.csv") == []
    assert {path.name for path in out.iterdir()} > {*NET_FILES, "posture.csv", "report.html"}
    assert "No net was seen" in (out / "report.html").read_text(encoding="utf-8")
    # A run that replaces this one takes the net's files with it.
    assert main(["run", str(video), "--rig", str(rig), "-o", str(out), "--overwrite"]) == 0
    assert not {path.name for path in out.iterdir()} & set(NET_FILES)


@pytest.mark.usefixtures("blank_maps")
def test_running_tells_the_same_as_evaluating_the_run(scans, tmp_path):
    """The files keep float32; that must not change what is found."""
    direct = tmp_path / "direct"
    direct.mkdir()
    net = NetPass(example_rig(), NetRequest())
    for scan in scans:
        net.add(scan)
    net.write(direct)
    stored = write_run(tmp_path / "run", scans)
    assert main(["net", str(stored)]) == 0
    for name in ("net.csv", "holes.csv"):
        for one, other in zip(rows(direct / name), rows(stored / name), strict=True):
            assert one.keys() == other.keys()
            for key, cell in one.items():
                try:
                    assert float(other[key]) == pytest.approx(float(cell), rel=0.01, abs=0.01)
                except ValueError:
                    assert other[key] == cell


def test_faults_are_told_in_one_line(dive, run_folder, tmp_path, refused):
    video, rig = dive
    out = tmp_path / "out"
    assert "--rig" in refused("net", video, "-o", out)
    assert "--out: missing" in refused("net", "udp://127.0.0.1:5600", "--rig", rig)
    assert "nowhere" in refused("net", tmp_path / "nowhere", "--rig", rig, "-o", out)
    assert "leave --rig out" in refused("net", run_folder, "--rig", rig)
    missing = tmp_path / "missing.csv"
    assert str(missing) in refused("net", run_folder, "--log", missing)
    assert str(missing) in refused("net", video, "--rig", rig, "-o", out, "--log", missing)
    assert "add --log" in refused("net", run_folder, "--log-offset-s", "3")
    assert "--twine-mm -2" in refused("net", run_folder, "--twine-mm=-2")
    said = refused("net", run_folder, "--twine-mm=45", "--overwrite")
    assert "--twine-mm 45: not thinner than the mesh's bar, measured as 2" in said
    assert "--stretch-m 0" in refused("net", run_folder, "--stretch-m", "0")
    assert "--log-offset-s nan" in refused("net", run_folder, "--log-offset-s", "nan")
    assert not out.exists()
    assert not (run_folder / "net.csv").exists()


def test_an_older_or_broken_run_is_told_in_one_line(run_folder, tmp_path, refused):
    (run_folder / "run.yaml").write_text("status: finished\n")
    out = tmp_path / "out"
    assert "holds no rig" in refused("net", run_folder, "-o", out)
    (run_folder / "run.yaml").unlink()
    assert "run.yaml: no such file" in refused("net", run_folder, "-o", out)
    path = run_folder / "points.parquet"
    table = parquet.read_table(path)
    parquet.write_table(table.drop_columns(["intensity", "width_px"]), path)
    assert "run the dive again" in refused("net", run_folder, "-o", out)
    assert not out.exists()


@pytest.mark.parametrize("make", [os.mkfifo, lambda at: at.symlink_to(at), lambda _: None])
def test_a_run_without_its_postures_is_told_by_name(make, run_folder, refused):
    path = run_folder / "posture.csv"
    path.unlink()
    make(path)
    assert f"{run_folder}: holds no run (no posture.csv)" in refused("net", run_folder)
