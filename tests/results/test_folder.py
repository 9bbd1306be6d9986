"""The folder of a run: exact, cheap, and readable however the run ends."""

import csv
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import yaml
from pyarrow import parquet

from aqualvs.cli.main import main
from aqualvs.errors import OutputError
from aqualvs.results.files import RECORD, AppendFile, explain
from aqualvs.results.folder import PostureCsv, RunOutputs, posture_row, prepare_folder, recover
from aqualvs.results.points import (
    POINTS_SCHEMA,
    PointsExport,
    PointsStream,
    export_points,
    points_batch,
    read_points_stream,
)
from aqualvs.results.run_request import Status
from aqualvs.results.summary import summary_of
from aqualvs.scanning.posture import Reason
from aqualvs.scanning.scan import Label
from shell_cases import scan

HEADER = (
    "frame,time_s,valid,reason,range_m,pitch_deg,yaw_deg,sigma_range_m,sigma_pitch_deg,"
    "sigma_yaw_deg,slant_range_m,nearest_m,n_points,n_water,"
    "curvature_x_per_m,curvature_z_per_m,sigma_curvature_x_per_m,sigma_curvature_z_per_m,"
    "sigma_range_rig_m,sigma_pitch_rig_deg,sigma_yaw_rig_deg,"
    "sigma_range_total_m,sigma_pitch_total_deg,sigma_yaw_total_deg"
)


def outputs(folder):
    return RunOutputs(folder, source={"name": "dive.mp4"}, rig={"name": "r"}, options={"a": 1})


def run_file(folder):
    return yaml.safe_load((folder / "run.yaml").read_text())


def read_ply(path):
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = int(next(line.split()[2] for line in lines if line.startswith("element vertex")))
    names = [line.split()[2] for line in lines if line.startswith("property")]
    assert names == ["x", "y", "z", "red", "green", "blue"]
    kinds = ["<f4"] * 3 + ["u1"] * 3
    vertices = np.frombuffer(body, np.dtype(list(zip(names, kinds, strict=True))))
    assert len(vertices) == count
    return vertices


def test_a_posture_row_holds_the_posture_in_file_units():
    measured = scan(3)
    by_rig = np.diag([4e-3, 1e-3, 4e-3]) ** 2
    measured = replace(measured, posture=replace(measured.posture, rig_covariance=by_rig))
    cells = dict(zip(HEADER.split(","), posture_row(measured).strip().split(","), strict=True))
    assert cells["frame"] == "3"
    assert cells["valid"] == "1"
    assert cells["reason"] == ""
    expected = {
        "time_s": 0.12,
        "range_m": 0.53,
        "pitch_deg": 3.0,
        "yaw_deg": -7.0,
        "sigma_range_m": 1e-3,
        "sigma_pitch_deg": np.rad2deg(2e-3),
        "sigma_yaw_deg": np.rad2deg(3e-3),
        "slant_range_m": 0.54,
        "nearest_m": 0.52,
        "n_points": 60,
        "n_water": 1.3333,
        "sigma_range_rig_m": 4e-3,
        "sigma_pitch_rig_deg": np.rad2deg(1e-3),
        "sigma_yaw_rig_deg": np.rad2deg(4e-3),
        "sigma_range_total_m": np.hypot(1e-3, 4e-3),
        "sigma_pitch_total_deg": np.rad2deg(np.hypot(2e-3, 1e-3)),
        "sigma_yaw_total_deg": np.rad2deg(5e-3),
    }
    assert not any(cells[name] for name in HEADER.split(",")[-10:-6])
    found = {name: float(cells[name]) for name in expected}
    # The file keeps a micrometre, a hundred-thousandth of a degree, four digits of a sigma.
    assert found == pytest.approx(expected, rel=2e-4, abs=1e-6)


def test_a_curved_net_has_its_curvature_in_its_columns():
    flat = scan(3)
    bent = replace(flat.posture, curvature=(0.5, -0.25), sigma_curvature=(0.02, 0.0345678))
    cells = posture_row(replace(flat, posture=bent)).strip().split(",")
    assert cells[-10:-6] == ["0.5", "-0.25", "0.02", "0.03457"]
    plain = posture_row(flat).strip().split(",")
    assert cells[:-10] + cells[-6:] == plain[:-10] + plain[-6:]


def test_a_refused_frame_has_its_reason_and_no_numbers():
    row = posture_row(scan(7, reason=Reason.ONE_LASER))
    assert row == "7,0.280000,0,one_laser" + "," * 20 + "\n"
    assert row.count(",") == HEADER.count(",")


def test_every_row_is_on_disk_at_once(tmp_path):
    path = tmp_path / "posture.csv"
    with PostureCsv(path) as rows:
        assert path.read_text() == HEADER + "\n"
        for i in range(3):
            rows.write(scan(i))
            assert path.read_text().count("\n") == 2 + i


class NearlyFull:
    """A file on a disk that has room for 20 more bytes."""

    def __init__(self, file):
        self.file = file
        self.room = 20

    def write(self, data):
        if not self.room:
            raise OSError(28, "No space left on device")
        n_written = self.file.write(data[: self.room])
        self.room -= n_written
        return n_written

    def __getattr__(self, name):
        return getattr(self.file, name)


@pytest.mark.parametrize("kind", [PostureCsv, PointsStream])
def test_a_frame_that_does_not_fit_is_taken_back(tmp_path, kind):
    path = tmp_path / "file"
    writer = kind(path)
    writer.write(scan(0))
    whole = path.read_bytes()
    writer._file._file = NearlyFull(writer._file._file)
    with pytest.raises(OSError, match="No space"):
        writer.write(scan(1))
    writer._file.close()
    assert path.read_bytes() == whole


def test_a_piece_that_the_system_takes_in_parts_arrives_whole(tmp_path, monkeypatch):
    file = AppendFile(tmp_path / "file")
    raw = file._file

    class Slow:
        def write(self, data):
            return raw.write(data[:7])

    monkeypatch.setattr(file, "_file", Slow())
    file.append(bytes(range(50)))
    raw.close()
    assert (tmp_path / "file").read_bytes() == bytes(range(50))


def test_points_become_columns_of_the_schema():
    made = scan(5, 40)
    batch = points_batch(made)
    assert batch.schema == POINTS_SCHEMA
    assert [field.name for field in POINTS_SCHEMA] == [
        *("frame", "time_s", "laser", "u_px", "v_px", "x_m", "y_m", "z_m"),
        *("sigma_m", "quality", "label", "used", "intensity", "width_px"),
    ]
    table = batch.to_pydict()
    assert table["frame"] == [5] * 40
    assert table["time_s"] == [0.2] * 40
    assert table["laser"] == made.points.laser.tolist()
    pixels = np.stack([table["u_px"], table["v_px"]], -1)
    np.testing.assert_array_equal(pixels, made.points.pixels.astype(np.float32))
    points = np.stack([table["x_m"], table["y_m"], table["z_m"]], -1)
    np.testing.assert_array_equal(points, made.points.points_in_dome.astype(np.float32))
    np.testing.assert_array_equal(table["intensity"], made.points.intensity.astype(np.float32))
    np.testing.assert_array_equal(table["width_px"], made.points.width.astype(np.float32))
    assert table["label"] == [Label(i).name.lower() for i in made.points.label]
    assert table["used"] == made.points.used.tolist()
    np.testing.assert_array_equal(table["sigma_m"], made.points.sigma.astype(np.float32))
    np.testing.assert_array_equal(table["quality"], made.points.quality.astype(np.float32))


def test_every_frame_of_the_journal_can_be_read_while_it_is_written(tmp_path):
    path = tmp_path / "points.arrows"
    with PointsStream(path) as points_stream:
        for i in range(4):
            points_stream.write(scan(i, 10 + i))
            assert [b.num_rows for b in read_points_stream(path)] == [10 + k for k in range(i + 1)]


def test_a_frame_without_points_leaves_no_trace_in_the_journal(tmp_path):
    path = tmp_path / "points.arrows"
    with PointsStream(path) as points_stream:
        points_stream.write(scan(0, 0))
        points_stream.write(scan(1, 5))
    assert [b.num_rows for b in read_points_stream(path)] == [5]


def test_a_journal_cut_at_any_byte_gives_its_whole_frames(tmp_path):
    path = tmp_path / "points.arrows"
    ends = []
    with PointsStream(path) as points_stream:
        for i in range(3):
            points_stream.write(scan(i, 20))
            ends.append(path.stat().st_size)
    data = path.read_bytes()
    cut = tmp_path / "cut.arrows"
    for size in range(0, len(data), 37):
        cut.write_bytes(data[:size])
        n_whole = sum(end <= size for end in ends)
        batches = list(read_points_stream(cut))
        assert len(batches) == n_whole
        assert all(b["frame"][0].as_py() == i for i, b in enumerate(batches))


def test_a_full_disk_is_said_by_the_journal_and_by_the_rows():
    """`/dev/full` answers every write as a full disk does."""
    if not os.path.exists("/dev/full"):
        pytest.skip("this system has no /dev/full")
    with pytest.raises(OSError, match="No space left") as fault:
        PostureCsv(Path("/dev/full"))
    assert "disk is full" in explain(Path("out"), fault.value)
    with (
        pytest.raises(OSError, match="No space left") as fault,
        PointsStream(Path("/dev/full")) as w,
    ):
        w.write(scan(0))
    assert "disk is full" in explain(Path("out"), fault.value)


def test_export_keeps_every_point_and_colours_the_targets(tmp_path, monkeypatch):
    # Groups of two frames, the last of them incomplete.
    monkeypatch.setattr("aqualvs.results.points._ROWS_PER_GROUP", 100)
    scans = [scan(i, 60) for i in range(5)]
    points_stream = tmp_path / "points.arrows"
    with PointsStream(points_stream) as writer:
        for made in scans:
            writer.write(made)
    export_points(read_points_stream(points_stream), tmp_path / "p.parquet", tmp_path / "p.ply")
    file = parquet.ParquetFile(tmp_path / "p.parquet")
    assert file.metadata.num_rows == 300
    assert file.num_row_groups == 3
    for i in range(file.num_row_groups):
        group = file.metadata.row_group(i)
        told = {
            c.path_in_schema for c in map(group.column, range(group.num_columns)) if c.statistics
        }
        assert told == {"frame", "time_s"}
    expected = pa.Table.from_batches([points_batch(made) for made in scans])
    assert file.read().equals(expected)

    vertices = read_ply(tmp_path / "p.ply")
    target = np.concatenate([s.points.used for s in scans])
    points = np.concatenate([s.points.points_in_dome for s in scans])[target]
    found = np.stack([vertices[axis] for axis in "xyz"], -1)
    np.testing.assert_array_equal(found, points.astype(np.float32))
    laser = np.concatenate([s.points.laser for s in scans])[target]
    colours = np.stack([vertices[c] for c in ("red", "green", "blue")], -1)
    assert [len(np.unique(colours[laser == i], axis=0)) for i in range(3)] == [1, 1, 1]
    assert len(np.unique(colours, axis=0)) == 3


def test_an_empty_journal_gives_empty_files(tmp_path):
    points_stream = tmp_path / "points.arrows"
    points_stream.write_bytes(b"")
    export_points(read_points_stream(points_stream), tmp_path / "p.parquet", tmp_path / "p.ply")
    table = parquet.read_table(tmp_path / "p.parquet")
    assert (table.schema, table.num_rows) == (POINTS_SCHEMA, 0)
    assert len(read_ply(tmp_path / "p.ply")) == 0


def test_a_failed_export_leaves_no_half_files(tmp_path, monkeypatch):
    points_stream = tmp_path / "points.arrows"
    with PointsStream(points_stream) as writer:
        writer.write(scan(0))

    def fail(table):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("aqualvs.results.points._vertices", fail)
    with pytest.raises(OSError, match="No space"):
        export_points(
            read_points_stream(points_stream), tmp_path / "points.parquet", tmp_path / "points.ply"
        )
    assert [p.name for p in tmp_path.iterdir()] == ["points.arrows"]


def test_a_finished_run_is_complete(tmp_path):
    reasons = [None, Reason.NO_STRIPES, None, Reason.CORRUPT_FRAME, Reason.NO_STRIPES]
    with outputs(tmp_path) as out:
        assert run_file(tmp_path)["status"] == "running"
        for i, reason in enumerate(reasons):
            out.write(scan(i, reason=reason))
    names = sorted(p.name for p in tmp_path.iterdir())
    assert names == ["points.parquet", "points.ply", "posture.csv", "run.yaml"]
    content = run_file(tmp_path)
    assert content["status"] == "finished"
    assert content["summary"] == {
        "n_frames": 5,
        "n_valid": 2,
        "valid_share": 0.4,
        "range_median_m": 0.51,
        "range_min_m": 0.5,
        "range_max_m": 0.52,
        "refused": {"no_stripes": 2, "corrupt_frame": 1},
    }
    assert content["source"] == {"name": "dive.mp4"}
    assert content["rig"] == {"name": "r"}
    assert set(content["versions"]) >= {"aqualvs", "python", "numpy", "numba", "av"}
    assert summary_of(tmp_path / "posture.csv").to_dict() == content["summary"]
    rows = list(csv.DictReader((tmp_path / "posture.csv").read_text().splitlines()))
    assert [row["frame"] for row in rows] == list("01234")


@pytest.mark.parametrize(
    ("fault", "status"), [(ValueError("odd"), "failed"), (KeyboardInterrupt(), "interrupted")]
)
def test_a_run_that_dies_of_an_exception_is_complete(tmp_path, fault, status):
    def run():
        with outputs(tmp_path) as out:
            out.write(scan(0))
            raise fault

    with pytest.raises(type(fault)):
        run()
    assert run_file(tmp_path)["status"] == status
    assert run_file(tmp_path)["error"] in ("odd", "KeyboardInterrupt")
    assert parquet.read_table(tmp_path / "points.parquet").num_rows == 60
    assert not (tmp_path / "points.arrows").exists()


def test_a_full_disk_leaves_what_was_written_for_later(tmp_path, monkeypatch):
    def full(made):
        raise OSError(28, "No space left on device")

    def run():
        with outputs(tmp_path) as out:
            out.write(scan(0))
            monkeypatch.setattr(out._points, "write", full)
            out.write(scan(1))

    with pytest.raises(OutputError, match="disk is full") as fault:
        run()
    assert "\n" not in str(fault.value)
    assert run_file(tmp_path)["status"] == "failed"
    assert (tmp_path / "posture.csv").read_text().count("\n") == 2
    assert not (tmp_path / "points.parquet").exists()
    assert recover(tmp_path)
    assert parquet.read_table(tmp_path / "points.parquet").num_rows == 60


def full_disk(*_):
    raise OSError(28, "No space left on device")


def test_a_disk_that_fills_up_during_the_export_is_said(tmp_path, monkeypatch):
    def run():
        with outputs(tmp_path) as out:
            out.write(scan(0))

    monkeypatch.setattr(PointsExport, "finish", full_disk)
    with pytest.raises(OutputError, match="disk is full"):
        run()
    assert run_file(tmp_path)["status"] == "failed"
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "points.arrows",
        "posture.csv",
        "run.yaml",
    ]


def test_an_export_that_fails_on_the_way_is_done_at_the_end(tmp_path, monkeypatch):
    with outputs(tmp_path) as out:
        out.write(scan(0))
        with monkeypatch.context() as patched:
            patched.setattr(PointsExport, "add", full_disk)
            out.write(scan(1))
        assert not (tmp_path / "points.parquet.part").exists()
        out.write(scan(2))
    assert parquet.read_table(tmp_path / "points.parquet").num_rows == 180
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "points.parquet",
        "points.ply",
        "posture.csv",
        "run.yaml",
    ]


def test_recover_completes_a_killed_run_once(tmp_path):
    out = outputs(tmp_path)
    for i in range(3):
        out.write(scan(i, reason=Reason.COLLINEAR if i == 1 else None))
    # A killed process closes its files and nothing else; its last row may be cut short.
    out._points.abandon()
    out._posture.close()
    out._export._open_files.close()
    assert (tmp_path / "points.parquet.part").exists()
    with (tmp_path / "posture.csv").open("a") as rows:
        rows.write("3,0.12,1,,0.5")
    assert recover(tmp_path)
    assert not list(tmp_path.glob("*.part"))
    assert parquet.read_table(tmp_path / "points.parquet").num_rows == 180
    assert len(read_ply(tmp_path / "points.ply")) > 0
    content = run_file(tmp_path)
    assert content["status"] == Status.INTERRUPTED
    assert content["summary"]["n_frames"] == 3
    assert content["summary"]["n_valid"] == 2
    assert content["rig"] == {"name": "r"}
    assert not recover(tmp_path)


def test_recover_leaves_a_run_alone_that_is_under_way(tmp_path):
    pytest.importorskip("fcntl")
    with outputs(tmp_path) as out:
        out.write(scan(0))
        with pytest.raises(OutputError, match="still writing"):
            recover(tmp_path)
        with pytest.raises(OutputError, match="still writing"):
            prepare_folder(tmp_path, overwrite=True)
        out.write(scan(1))
    assert parquet.read_table(tmp_path / "points.parquet").num_rows == 120


def test_recover_refuses_a_folder_without_a_run(tmp_path):
    with pytest.raises(OutputError, match="holds no run"):
        recover(tmp_path)


def test_a_run_is_only_replaced_on_demand_and_nothing_else_ever(tmp_path):
    with outputs(tmp_path) as out:
        out.write(scan(0))
    (tmp_path / "dive.mp4").write_bytes(b"precious")
    with pytest.raises(OutputError, match="--overwrite"):
        prepare_folder(tmp_path, overwrite=False)
    assert (tmp_path / "posture.csv").exists()
    prepare_folder(tmp_path, overwrite=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == [RECORD, "dive.mp4"]


def test_a_report_of_others_stays(tmp_path, capsys):
    with prepare_folder(tmp_path, overwrite=False), outputs(tmp_path) as out:
        out.write(scan(0))
    (tmp_path / "report.html").write_text("precious")
    assert main(["report", str(tmp_path)]) == 2
    assert "did not write it" in capsys.readouterr().err
    assert (tmp_path / "report.html").read_text() == "precious"
    (tmp_path / "report.html").unlink()
    assert main(["report", str(tmp_path)]) == 0
    assert main(["report", str(tmp_path)]) == 0
    # A copy without its hidden files, or the run of an earlier version.
    (tmp_path / RECORD).unlink()
    assert main(["report", str(tmp_path)]) == 0
    prepare_folder(tmp_path, overwrite=True)


def test_a_folder_that_cannot_be_made_is_said_in_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OutputError, match="choose another folder") as fault:
            prepare_folder(folder, overwrite=False)
        assert "\n" not in str(fault.value)


def test_of_two_runs_that_begin_at_the_same_moment_one_is_refused(tmp_path):
    for _ in range(2):
        prepare_folder(tmp_path, overwrite=False)
    with outputs(tmp_path) as out:
        with pytest.raises(OutputError, match="another run has just begun here"):
            outputs(tmp_path)
        out.write(scan(0))
    assert run_file(tmp_path)["status"] == Status.FINISHED
    assert len((tmp_path / "posture.csv").read_text().splitlines()) == 2


def test_a_damaged_row_does_not_keep_a_run_from_being_completed(tmp_path):
    out = outputs(tmp_path)
    out.write(scan(0), scan(1))
    out._points.abandon()
    out._posture.close()
    out._export._open_files.close()
    table = tmp_path / "posture.csv"
    table.write_bytes(table.read_bytes().replace(b"0.500000", b"0.5\x00\xff00") + b"\x00,,,\n")
    assert recover(tmp_path)
    assert run_file(tmp_path)["status"] == Status.INTERRUPTED
