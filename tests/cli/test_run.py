"""`aqualvs run` as a user types it: every bad input gives one line and exit code 2."""

import contextlib
import csv
import os
import resource
import shutil
import signal
import subprocess
import sys
import time

import cv2
import pyarrow as pa
import pytest
import yaml
from pyarrow import parquet

from aqualvs.cli.main import main
from aqualvs.simulation.scenarios import example_rig
from aqualvs.workers.start_method import n_cores
from complaints import complaints
from processes import children_of, on_proc, still_there
from shell_cases import (
    all_key_frames,
    cut_after,
    destroy_frame,
    rig_file,
    wall_picture,
    write_video,
)
from whole import part_of

PROGRAM = [sys.executable, "-m", "aqualvs"]
# The first run on a machine compiles its kernels.
TIMEOUT_S = 240


@pytest.fixture
def rig(tmp_path):
    return rig_file(tmp_path)


@pytest.fixture(scope="module")
def dive(tmp_path_factory):
    return write_video(tmp_path_factory.mktemp("dive") / "dive.mp4", 5)


def rows(folder):
    return list(csv.DictReader((folder / "posture.csv").read_text().splitlines()))


def run_file(folder):
    return yaml.safe_load((folder / "run.yaml").read_text())


def test_without_a_folder_the_results_are_beside_the_dive(dive, rig, tmp_path, refused):
    copy = shutil.copy(dive, tmp_path / "may.mp4")
    assert main(["run", str(copy), "--rig", str(rig), "--no-report"]) == 0
    assert (tmp_path / "may_run" / "posture.csv").is_file()
    assert "--overwrite" in refused("run", copy, "--rig", rig, "--no-report")
    assert "--out: missing" in refused("run", "udp://127.0.0.1:5600", "--rig", rig)


def test_a_dive_from_video_to_report(tmp_path, rig, capsys):
    image = wall_picture(example_rig(), 0.5)
    for i in range(4):
        cv2.imwrite(str(tmp_path / f"{i}.png"), image)
    out = tmp_path / "out"
    assert main(["run", str(tmp_path), "--rig", str(rig), "-o", str(out), "--overlay"]) == 0
    said = capsys.readouterr().out
    assert f"report: {out / 'report.html'}" in said
    assert "posture in 4 of 4 frames (100.0 %)" in said
    for row in rows(out):
        # Lines drawn pixel by pixel: the wall is at 0.5 m, square to the vehicle.
        assert float(row["range_m"]) == pytest.approx(0.5, rel=3e-3)
        assert abs(float(row["pitch_deg"])) < 0.5
        assert abs(float(row["yaw_deg"])) < 0.5
        assert float(row["n_water"]) == pytest.approx(1.3333)
    assert sorted(path.name for path in out.glob("[!.]*")) == [
        *("overlay.mp4", "points.parquet", "points.ply"),
        *("posture.csv", "posture_bare.csv", "report.html", "run.yaml"),
    ]


@pytest.mark.parametrize(
    ("content", "words"),
    [(None, "no such file"), (b"", "is empty"), (b"not a video\n" * 40, "not a video")],
)
def test_a_source_that_is_no_video(tmp_path, rig, refused, content, words):
    source = tmp_path / "dive.mp4"
    if content is not None:
        source.write_bytes(content)
    said = refused("run", source, "--rig", rig, "-o", tmp_path / "out")
    assert str(source) in said
    assert words in said
    assert not (tmp_path / "out").exists()


def test_a_video_without_frames(tmp_path, rig, refused):
    source = all_key_frames(tmp_path / "dive.mp4", 3)
    for i in range(3):
        destroy_frame(source, i)
    said = refused("run", source, "--rig", rig, "-o", tmp_path / "out")
    assert "only 0 of 3 frames" in said
    assert not (tmp_path / "out").exists()


def test_a_truncated_video_keeps_what_was_measured(tmp_path, rig, refused):
    source = all_key_frames(tmp_path / "dive.mp4", 8)
    cut_after(source, 5)
    out = tmp_path / "out"
    said = refused("run", source, "--rig", rig, "-o", out)
    assert "only 5 of 8 frames" in said
    assert len(rows(out)) == 5
    assert run_file(out)["status"] == "failed"
    parquet.read_table(out / "points.parquet")
    assert (out / "report.html").is_file()


def test_a_corrupt_frame_is_no_failure(tmp_path, rig):
    source = all_key_frames(tmp_path / "dive.mp4", 6)
    destroy_frame(source, 2)
    out = tmp_path / "out"
    assert main(["run", str(source), "--rig", str(rig), "-o", str(out), "--no-report"]) == 0
    assert [row["reason"] for row in rows(out)][2] == "corrupt_frame"
    assert len(rows(out)) == 6
    assert not (out / "report.html").exists()


def test_pictures_of_another_size(tmp_path, rig, refused):
    source = write_video(tmp_path / "small.mp4", 3, size=(96, 64))
    assert "96x64 px" in refused("run", source, "--rig", rig, "-o", tmp_path / "out")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "no such file"),
        ("", "rig.yaml"),
        ("just words", "rig.yaml"),
        ("a: [", "rig.yaml"),
        ("lasers: []", "rig.yaml"),
    ],
)
def test_a_rig_that_cannot_be_used(tmp_path, dive, refused, content, words):
    rig = tmp_path / "bad-rig.yaml"
    if content is not None:
        rig.write_text(content)
    assert words in refused("run", dive, "--rig", rig, "-o", tmp_path / "out")


def test_a_rig_without_lasers_or_with_nan(tmp_path, rig, dive, refused):
    content = yaml.safe_load(rig.read_text())
    rig.write_text(yaml.safe_dump({**content, "lasers": []}))
    assert "lasers" in refused("run", dive, "--rig", rig, "-o", tmp_path / "out")
    content["lasers"][0]["offset_mm"] = float("nan")
    rig.write_text(yaml.safe_dump(content))
    assert "offset_mm" in refused("run", dive, "--rig", rig, "-o", tmp_path / "out")


def test_an_output_folder_that_cannot_be_made(tmp_path, rig, dive, refused):
    (tmp_path / "file").write_text("")
    said = refused("run", dive, "--rig", rig, "-o", tmp_path / "file" / "out")
    assert "choose another folder" in said


def test_an_existing_run_is_kept_unless_told_otherwise(tmp_path, rig, dive, refused):
    arguments = ["run", str(dive), "--rig", str(rig), "-o", str(tmp_path / "out"), "--no-report"]
    assert main(arguments) == 0
    assert "--overwrite" in refused(*arguments)
    assert main([*arguments, "--overwrite", "--frames", "1:3"]) == 0
    assert [row["frame"] for row in rows(tmp_path / "out")] == ["1", "2"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--frames", "9:3"], "--frames 9:3"),
        (["--frames", "100:"], "no such frames"),
        (["--water-n", "5"], "--water-n 5"),
        (["--water-n", "wet"], "--water-n"),
        (["--temperature-c", "12"], "--salinity"),
        (["--temperature-c", "99", "--salinity", "35"], "99"),
        (["--target", "fish"], "--target"),
        (["--detector", "magic"], "--detector"),
        (["--mesh-filter", "magic"], "--mesh-filter"),
        (["--fit", "magic"], "--fit"),
        (["--fps", "10"], "own clock"),
        (["--truth", "missing.csv"], "missing.csv"),
        (["--bogus"], "--bogus"),
    ],
)
def test_options_that_make_no_sense(tmp_path, rig, dive, refused, options, words):
    assert words in refused("run", dive, "--rig", rig, "-o", tmp_path / "out", *options)
    assert not (tmp_path / "out").exists()


def test_missing_arguments(refused, dive):
    assert "--rig" in refused("run", dive)
    assert "source" in refused("run").lower()
    assert "bogus" in refused("bogus")


@pytest.fixture(scope="module")
def long_dive(tmp_path_factory):
    """A dive of 8000 pictures, links to one: it lasts until it is stopped."""
    folder = tmp_path_factory.mktemp("long") / "images"
    folder.mkdir()
    picture = folder.with_name("wall.png")
    cv2.imwrite(str(picture), wall_picture(example_rig(), 0.5))
    for i in range(8_000):
        os.link(picture, folder / f"{i}.png")
    return folder


@contextlib.contextmanager
def under_way(source, rig, out, *more, limit=None):
    """Start a run as its own process and wait until it has written 20 rows."""
    arguments = [*PROGRAM, "run", str(source), "--rig", str(rig), "-o", str(out), *more]
    process = subprocess.Popen(
        arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=limit
    )
    try:
        deadline = time.monotonic() + TIMEOUT_S
        table = out / "posture.csv"
        while not (table.exists() and table.read_bytes().count(b"\n") > 20):
            assert process.poll() is None, process.stderr.read()
            assert time.monotonic() < deadline
            time.sleep(0.02)
        yield process
    finally:
        process.kill()
        process.communicate()


def n_points_rows(folder):
    return parquet.read_table(folder / "points.parquet").num_rows


@pytest.mark.parametrize(("number", "code"), part_of([(signal.SIGTERM, 143), (signal.SIGINT, 130)]))
def test_a_run_is_left_alone_while_under_way_and_complete_when_stopped(
    long_dive, rig, tmp_path, refused, number, code
):
    out = tmp_path / "out"
    with under_way(long_dive, rig, out) as process:
        assert "still writing" in refused("report", out)
        again = ("run", long_dive, "--rig", rig, "-o", out, "--overwrite", "--workers", "1")
        assert "still writing" in refused(*again)
        process.send_signal(number)
        said, complaint = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == code
    assert complaints(complaint) == []
    assert f"stopped by {number.name} after {len(rows(out))} frames" in said
    assert run_file(out)["status"] == "interrupted"
    assert n_points_rows(out) > 0
    assert (out / "report.html").is_file()
    assert not (out / "points.arrows").exists()


@pytest.fixture(scope="module")
def killed(long_dive, tmp_path_factory):
    """The folder of a run that was killed, the processes that it had, and those that live on."""
    folder = tmp_path_factory.mktemp("killed")
    with under_way(long_dive, rig_file(folder), folder / "out") as process:
        others = children_of(process.pid) if os.path.isdir("/proc") else []
        process.kill()
        process.wait()
        left = still_there(others, 20.0)
        for pid in left:
            os.kill(pid, signal.SIGKILL)
    return folder / "out", others, left


def test_a_killed_run_can_be_read_and_completed(killed, capsys):
    out, _, _ = killed
    table = (out / "posture.csv").read_text()
    assert table.endswith("\n")
    measured = {int(row["frame"]) for row in rows(out)}
    in_journal = set()
    with pa.memory_map(str(out / "points.arrows")) as file, contextlib.suppress(pa.ArrowInvalid):
        for batch in pa.ipc.open_stream(file):
            in_journal.update(batch["frame"].to_pylist())
    # A frame's points are written before its row.
    assert measured <= in_journal

    assert main(["report", str(out)]) == 0
    assert "points completed" in capsys.readouterr().out
    assert run_file(out)["status"] == "interrupted"
    assert run_file(out)["summary"]["n_frames"] == len(measured)
    found = parquet.read_table(out / "points.parquet", columns=["frame"])["frame"].unique()
    assert measured <= set(found.to_pylist())
    assert (out / "points.ply").stat().st_size > 1000
    assert (out / "report.html").is_file()
    assert not (out / "points.arrows").exists()


@on_proc
@pytest.mark.skipif(n_cores() < 2, reason="one core is one process")
def test_the_processes_of_a_killed_run_end_with_it(killed):
    _, others, left = killed
    assert len(others) >= 2
    assert left == []


@on_proc
@pytest.mark.skipif(n_cores() < 2, reason="one core is one process")
def test_ctrl_c_reaches_the_processes_of_a_run_and_does_nothing_there(long_dive, rig, tmp_path):
    """A terminal sends it to all of them; what they have measured is written."""
    out = tmp_path / "out"
    with under_way(long_dive, rig, out, "--no-report") as process:
        for pid in [*children_of(process.pid), process.pid]:
            os.kill(pid, signal.SIGINT)
        _, complaint = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 130
    assert complaints(complaint) == []
    assert run_file(out)["status"] == "interrupted"


def test_a_full_disk_is_said_and_what_is_there_can_be_read(long_dive, rig, tmp_path, capsys):
    """The system refuses to let any file grow beyond a limit, as it does on a full disk."""
    out = tmp_path / "out"

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (4_000_000, 4_000_000))

    alone = ("--no-report", "--workers", "1")
    with under_way(long_dive, rig, out, *alone, limit=limit) as process:
        _, complaint = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 2
    assert len(complaints(complaint)) == 1
    assert "disk is full" in complaint
    assert run_file(out)["status"] == "failed"
    measured = {int(row["frame"]) for row in rows(out)}
    assert len(measured) > 20
    away = long_dive.rename(long_dive.with_name("away"))
    try:
        assert main(["report", str(out)]) == 0
    finally:
        away.rename(long_dive)
    found = parquet.read_table(out / "points.parquet", columns=["frame"])["frame"].unique()
    assert measured <= set(found.to_pylist())
