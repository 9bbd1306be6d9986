"""`aqualvs batch` as a user types it, with processes of its own that are killed on the way."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest
import yaml

from aqualvs.cli.main import main
from batch_cases import DEMO, RESULTS, demo_dive, without_times
from processes import children_of, on_proc
from shell_cases import rig_file, write_video

pytest.importorskip("distributed")

PROGRAM = [sys.executable, "-m", "aqualvs", "batch"]
# The first run on a machine compiles its kernels.
TIMEOUT_S = 240


@pytest.fixture(scope="module")
def season(tmp_path_factory):
    """Three dives of the same name in three folders, and one that is no video."""
    folder = tmp_path_factory.mktemp("season")
    for name in ("a", "b", "c"):
        (folder / name).mkdir()
        demo_dive(folder / name / "dive.mp4", 12)
    (folder / "c" / "torn.mp4").write_bytes(b"no video")
    (folder / "rig.yaml").write_bytes((DEMO / "rig.yaml").read_bytes())
    return folder


def command(season, out):
    rig = ["--rig", str(season / "rig.yaml")]
    return [*PROGRAM, str(season), "-o", str(out), *rig, "--workers", "2", "--no-report"]


def begun(season, out):
    return subprocess.Popen(
        command(season, out),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def workers_of(process):
    """Processes that work for a batch: copies of the one it has begun for that."""
    return children_of(*children_of(process.pid))


@on_proc
def test_an_interrupted_batch_whose_workers_are_killed_gives_what_runs_give(tmp_path, season):
    out = tmp_path / "out"
    with begun(season, out) as first:
        said = first.stdout.readline()
        # As a terminal does it: to the workers too.
        os.killpg(first.pid, signal.SIGINT)
        rest, errors = first.communicate(timeout=TIMEOUT_S)
    assert first.returncode == 130, errors
    assert "run the same command to resume" in rest
    assert "Traceback" not in errors
    assert (out / "summary.html").exists()

    killed = []
    with begun(season, out) as second:
        over = threading.Event()

        def kill_one():
            until = time.monotonic() + TIMEOUT_S
            homes = out / ".batch" / "dives"
            while not over.is_set() and time.monotonic() < until:
                if len(list(homes.glob("*/survey"))) >= 2 and (pids := workers_of(second)):
                    os.kill(pids[0], signal.SIGKILL)
                    killed.append(pids[0])
                    return
                time.sleep(0.05)

        killer = threading.Thread(target=kill_one)
        killer.start()
        told, errors = second.communicate(timeout=TIMEOUT_S)
        over.set()
        killer.join()
    assert killed
    # One of them is no video; the others are not held up by it.
    assert second.returncode == 1, errors
    assert "Traceback" not in errors
    assert "torn: failed" in said + told
    assert "3 finished" in told
    names = {f"{name}_dive" for name in "abc"}
    assert {path.name for path in (out / "dives").iterdir()} == names
    assert not list(out.rglob("*.part"))

    serial = tmp_path / "serial"
    source = season / "b" / "dive.mp4"
    rig = str(season / "rig.yaml")
    assert main(["run", str(source), "--rig", rig, "-o", str(serial), "--no-report"]) == 0
    result = out / "dives" / "b_dive"
    same = [
        name for name in RESULTS if without_times(serial / name) == without_times(result / name)
    ]
    assert same == list(RESULTS)
    assert yaml.safe_load((result / "run.yaml").read_text())["status"] == "finished"


def test_a_recording_that_shows_no_stripes_is_finished_as_by_run(tmp_path, capfd):
    video, run = write_video(tmp_path / "dark.mp4", 3), tmp_path / "run"
    recorded = ["--rig", str(rig_file(tmp_path)), "-o", str(run), "--mcap"]
    assert main(["run", str(video), *recorded]) == 0
    words = [str(run / "dive.mcap"), "--no-report"]
    assert main(["run", *words, "-o", str(tmp_path / "again")]) == 0
    assert main(["batch", *words, "-o", str(tmp_path / "out"), "--workers", "1"]) == 0
    assert "dive: 3 frames, posture in 0.0 %" in capfd.readouterr().out


def test_a_folder_that_is_renamed_is_not_another_season(tmp_path, capfd):
    source = tmp_path / "may" / "dive.mp4"
    source.parent.mkdir()
    demo_dive(source, 6)
    out, rig = tmp_path / "out", str(DEMO / "rig.yaml")
    words = ["batch", str(tmp_path), "-o", str(out), "--rig", rig, "--workers", "1", "--no-report"]
    assert main(words) == 0
    source.parent.rename(tmp_path / "2026-05")
    assert main(words) == 0
    assert "was finished" in capfd.readouterr().out
    assert [path.name for path in (out / "dataset" / "posture").iterdir()] == ["dive=dive"]
    # A dive of the same name and another content is another dive.
    (tmp_path / "2026-05" / "dive.mp4").unlink()
    source.parent.mkdir()
    demo_dive(source, 7)
    assert main(words) == 0
    assert len(list((out / "dataset" / "posture").iterdir())) == 2


def test_bad_input_is_refused_in_one_line(tmp_path, season, refused):
    out = tmp_path / "out"
    assert "no such file" in refused("batch", tmp_path / "none.mp4", "-o", out)
    lonely = tmp_path / "lonely.mp4"
    lonely.touch()
    assert "has no rig" in refused("batch", lonely, "-o", out)
    both = ("--workers", "2", "--scheduler", "tcp://127.0.0.1:1")
    assert "--workers" in refused("batch", season, "-o", out, *both)
    assert "give at least 1" in refused("batch", season, "-o", out, "--workers", "0")
    (tmp_path / "file").touch()
    rig = ("--rig", season / "rig.yaml")
    assert "choose another folder" in refused("batch", season, "-o", tmp_path / "file", *rig)
    assert "another folder for the results" in refused("batch", season, "-o", season, *rig)
    assert "no such file" in refused("batch", season, "-o", out, "--rig", tmp_path / "no.yaml")
    assert not out.exists()


def test_help_shows_an_example(capsys):
    assert main(["batch", "--help"]) == 0
    said = capsys.readouterr().out
    assert "Example: aqualvs batch season/2026 --rig rig.yaml -o out/2026" in " ".join(said.split())


def test_the_nets_of_a_season_and_what_changed(tmp_path, capfd):
    """As the manual has it: two commands from videos to a comparison."""
    for day in ("2026-05-01", "2026-05-22"):
        demo_dive(tmp_path / f"cage3_{day}.mp4", 75)
    (tmp_path / "rig.yaml").write_bytes((DEMO / "rig.yaml").read_bytes())
    out = tmp_path / "out"
    command = ["batch", str(tmp_path / "cage3*.mp4"), "-o", str(out), "--workers", "1"]
    assert main([*command, "--net", "--no-report", "--twine-mm", "2.5"]) == 0
    assert capfd.readouterr().out.count("fouling ") == 2
    assert (out / "dives" / "cage3_2026-05-01" / "net_map.png").is_file()
    assert main(["net-change", str(out), "-o", str(tmp_path / "change")]) == 0
    assert "2 dives on 2 dates, 2026-05-01 to 2026-05-22" in capfd.readouterr().out


def test_what_is_said_about_nets_without_net_is_refused(season, refused, tmp_path):
    assert "add --net" in refused("batch", season, "-o", tmp_path / "out", "--twine-mm", "2")
    said = refused("batch", season, "-o", tmp_path / "out", "--net", "--stretch-m", "-1")
    assert "--stretch-m -1: must be positive" in said
    assert not (tmp_path / "out").exists()


def test_a_reader_that_has_seen_enough_is_no_fault(season, tmp_path):
    """As with `aqualvs batch ... | head -1`: what is finished is kept."""
    with begun(season, tmp_path / "out") as process:
        process.stdout.readline()
        process.stdout.close()
        errors = process.stderr.read()
        process.wait(timeout=TIMEOUT_S)
    assert errors == ""
