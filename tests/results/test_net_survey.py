"""Scans read back from a run's folder are those that went in, up to what the files keep."""

import tracemalloc

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from aqualvs.errors import SourceError
from aqualvs.results import net_survey as module
from aqualvs.results.folder import RunOutputs
from aqualvs.results.net_survey import check_stored, read_run
from aqualvs.results.points import PointsStream, export_points, read_points_stream
from aqualvs.scanning.posture import Reason
from shell_cases import scan

COLUMNS = ("laser", "pixels", "points_in_dome", "sigma", "intensity", "width", "quality")


def written(folder, scans):
    folder.mkdir(exist_ok=True)
    with RunOutputs(folder, source={}, rig={}, options={}) as outputs:
        for one in scans:
            outputs.write(one)
    return folder


def dive():
    """Scans with a refusal, and frames without points at the start, in the middle and at the end"""
    numbers = (0, 40, 35, 0, 0, 200, 1, 0)
    refused = {0: Reason.NO_STRIPES, 3: Reason.CORRUPT_FRAME, 6: Reason.ONE_LASER}
    return [scan(i, n, reason=refused.get(i)) for i, n in enumerate(numbers)]


def same(found, made):
    assert (found.index, found.time_s) == (made.index, pytest.approx(made.time_s, abs=1e-6))
    assert len(found.points) == len(made.points)
    for name in COLUMNS:
        kept = getattr(made.points, name).astype(np.float32)
        np.testing.assert_array_equal(getattr(found.points, name), kept)
        assert getattr(found.points, name).shape == kept.shape
    np.testing.assert_array_equal(found.points.label, made.points.label)
    np.testing.assert_array_equal(found.points.used, made.points.used)
    assert bool(found.posture) == bool(made.posture)
    if not made.posture:
        assert found.posture.reason is made.posture.reason
        return
    # The file keeps a micrometre and 1e-5 degrees.
    assert found.posture.range == pytest.approx(made.posture.range, abs=1e-6)
    assert found.posture.pitch == pytest.approx(made.posture.pitch, abs=2e-7)
    assert found.posture.yaw == pytest.approx(made.posture.yaw, abs=2e-7)
    n = found.posture.normal_in_dome
    assert np.arctan2(n[2], n[1]) == pytest.approx(made.posture.pitch, abs=2e-7)
    assert np.arctan2(n[0], n[1]) == pytest.approx(made.posture.yaw, abs=2e-7)
    assert np.linalg.norm(n) == pytest.approx(1.0)
    assert found.posture.slant_range == pytest.approx(made.posture.slant_range, abs=1e-6)
    variances = np.diag(found.posture.covariance)
    assert variances == pytest.approx(np.diag(made.posture.covariance), rel=1e-3)
    assert found.n_water == pytest.approx(made.n_water, abs=1e-6)


@pytest.mark.parametrize("batch", [1 << 15, 30, 1])
def test_scans_come_back_however_the_file_is_cut(tmp_path, monkeypatch, batch):
    monkeypatch.setattr(module, "_BATCH", batch)
    made = dive()
    found = list(read_run(written(tmp_path / "run", made)))
    assert len(found) == len(made)
    for one, other in zip(found, made, strict=True):
        same(one, other)


def test_a_run_that_was_killed_is_read_from_its_journal(tmp_path):
    made = dive()
    folder = written(tmp_path / "run", made)
    (folder / "points.parquet").unlink()
    with PointsStream(folder / "points.arrows") as points_stream:
        for one in made:
            points_stream.write(one)
    # What was cut short counts for nothing: half a row, half a batch.
    with (folder / "posture.csv").open("a") as file:
        file.write("8,0.32,1,,0.5")
    found = list(read_run(folder))
    for one, other in zip(found, made, strict=True):
        same(one, other)


def test_points_of_a_frame_without_a_row_go_to_no_other_frame(tmp_path):
    made = dive()
    folder = written(tmp_path / "run", made)
    path = folder / "posture.csv"
    kept = [line for line in path.read_text().splitlines() if not line.startswith("2,")]
    path.write_text("\n".join(kept) + "\n")
    found = list(read_run(folder))
    assert [one.index for one in found] == [0, 1, 3, 4, 5, 6, 7]
    for one in found:
        same(one, made[one.index])


def without(folder, *names):
    path = folder / "points.parquet"
    parquet.write_table(parquet.read_table(path).drop_columns(list(names)), path)


def test_a_run_of_an_older_version_says_what_to_do(tmp_path):
    folder = written(tmp_path / "run", dive())
    without(folder, "intensity", "width_px")
    with pytest.raises(SourceError, match=r"no column intensity and no width_px.*run the dive aga"):
        check_stored(folder)


def test_an_older_run_without_a_single_point_is_told_too(tmp_path):
    folder = written(tmp_path / "run", [scan(0, 0)])
    without(folder, "width_px")
    with pytest.raises(SourceError, match="no column width_px"):
        list(read_run(folder))


def test_an_older_journal_still_becomes_parquet(tmp_path):
    points_stream, old = tmp_path / "points.arrows", tmp_path / "old.arrows"
    with PointsStream(points_stream) as writer:
        writer.write(scan(0))
    with pa.ipc.open_stream(points_stream) as stream:
        table = stream.read_all().drop_columns(["intensity", "width_px"])
    with pa.ipc.new_stream(old, table.schema) as stream:
        stream.write_table(table)
    export_points(read_points_stream(old), tmp_path / "p.parquet", tmp_path / "p.ply")
    export = parquet.read_table(tmp_path / "p.parquet")
    assert (export.schema, export.num_rows) == (table.schema, 60)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda f: (f / "points.parquet").unlink(), "points.parquet: no such file"),
        (lambda f: (f / "points.parquet").write_bytes(b"PAR1"), "cannot be read"),
        (lambda f: (f / "posture.csv").unlink(), "posture.csv: no such file"),
        (lambda f: (f / "posture.csv").write_text("a,b\n1,2\n"), "no column frame"),
    ],
)
def test_a_broken_folder_gives_one_line(tmp_path, spoil, words):
    folder = written(tmp_path / "run", dive())
    spoil(folder)
    with pytest.raises(SourceError) as caught:
        list(read_run(folder))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_word_where_a_number_belongs_is_told(tmp_path):
    folder = written(tmp_path / "run", dive())
    path = folder / "posture.csv"
    path.write_text(path.read_text().replace("0.510000", "much", 1))
    with pytest.raises(
        SourceError, match=r"posture\.csv: frame 1 holds a value that is not a number"
    ):
        list(read_run(folder))


def test_memory_does_not_grow_with_the_dive(tmp_path):
    def peak(n):
        folder = written(tmp_path / str(n), (scan(i, 400) for i in range(n)))
        tracemalloc.start()
        count = sum(len(one.points) for one in read_run(folder))
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert count == 400 * n
        return most

    # 200 frames fill more than two batches of 32768 points; four times as many take no more memory.
    peak(10)
    assert peak(800) < 1.3 * peak(200)
