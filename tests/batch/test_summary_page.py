"""The summary page and the data set of a batch, as readers see them."""

import importlib.util

import numpy as np
import pytest
from pyarrow import dataset as arrow_dataset
from pyarrow import parquet

from aqualvs.batch.dataset import OF_DIVE, drop, holds, put_dive, write_dives
from aqualvs.batch.dives import DiveRecord, DiveState
from aqualvs.batch.summary_page import range_steps, range_svg, write_summary
from aqualvs.results.folder import PostureCsv
from aqualvs.results.points import PointsStream, export_points, read_points_stream
from aqualvs.scanning.posture import Reason
from shell_cases import scan

NAMES = ("april", "dive_0012")


def facts(n_frames=100, **summary):
    found = {"n_frames": n_frames, "n_valid": n_frames // 2, "valid_share": 0.5}
    found |= {"range_median_m": 0.61, "range_min_m": 0.5, "range_max_m": 0.7} | summary
    return {
        "n_frames": n_frames,
        "n_valid": n_frames // 2,
        "duration_s": 4.0,
        "fault": "",
        "summary": found,
        "range_steps": [0.5, None, 0.7],
        "rig": "tank",
        "rig_file": "/rigs/tank.yaml",
        "n_water": 1.34,
    }


def record(name="april", state=DiveState.FINISHED, words="", **more):
    given = facts() if state is DiveState.FINISHED else {}
    return DiveRecord(
        name=name, source=f"/dives/{name}.mp4", state=state, words=words, facts=given, **more
    )


def test_warnings_of_a_run_are_those_of_the_batch(tmp_path):
    told = DiveRecord.of("april", "a.mp4", facts(warnings=["no <good> rig"]), reused=False)
    assert told.line().endswith("; warning: no <good> rig")
    write_summary(tmp_path, [told])
    assert "april: no &lt;good&gt; rig" in (tmp_path / "summary.html").read_text()


def test_why_a_dive_failed_takes_the_room_of_what_it_lacks(tmp_path):
    """In the width of its state alone a sentence was twenty lines tall."""
    write_summary(
        tmp_path, [record(), record("may", DiveState.FAILED, "may.mp4: the file is empty")]
    )
    page = (tmp_path / "summary.html").read_text()
    columns = page.count("</th>")
    assert f'<td colspan="{columns - 1}">failed<div class="why">may.mp4' in page


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Two dives: six frames each, of which one is refused."""
    folder = tmp_path_factory.mktemp("season")
    for k, name in enumerate(NAMES):
        run = folder / name
        run.mkdir()
        points_stream = run / "points.arrows"
        with PostureCsv(run / "posture.csv") as rows, PointsStream(points_stream) as points:
            for i in range(6):
                one = scan(i, 20 + k, reason=Reason.ONE_LASER if i == 3 else None)
                rows.write(one)
                points.write(one)
        export_points(read_points_stream(points_stream), run / "points.parquet", run / "points.ply")
        put_dive(folder / "dataset", name, run)
    return folder / "dataset"


def needs(package):
    return pytest.mark.skipif(
        importlib.util.find_spec(package) is None, reason=f"{package} is not installed"
    )


def test_arrow_reads_the_partitions(dataset):
    table = arrow_dataset.dataset(dataset / "posture", partitioning="hive").to_table()
    assert table.num_rows == 12
    assert set(table["dive"].to_pylist()) == set(NAMES)
    refused = [row for row in table.to_pylist() if not row["valid"]]
    assert [row["reason"] for row in refused] == ["one_laser"] * 2
    assert {row["range_m"] for row in refused} == {None}
    points = arrow_dataset.dataset(dataset / "points", partitioning="hive").to_table()
    assert points.num_rows == 6 * (20 + 21)


@needs("duckdb")
def test_duckdb_reads_the_partitions(dataset):
    import duckdb

    query = "SELECT dive, count(*), avg(range_m) FROM read_parquet(?, hive_partitioning = true) "
    rows = duckdb.execute(
        query + "GROUP BY dive ORDER BY dive", [f"{dataset}/posture/**/*.parquet"]
    ).fetchall()
    expected = np.mean([0.5 + 0.01 * i for i in range(6) if i != 3])
    assert [(dive, n) for dive, n, _ in rows] == [("april", 6), ("dive_0012", 6)]
    assert [mean for *_, mean in rows] == pytest.approx([expected] * 2)
    labels = duckdb.execute(
        "SELECT DISTINCT label FROM read_parquet(?, hive_partitioning = true)",
        [f"{dataset}/points/**/*.parquet"],
    ).fetchall()
    assert ("net",) in labels


@needs("polars")
def test_polars_reads_the_partitions(dataset):
    import polars

    table = polars.scan_parquet(f"{dataset}/posture/**/*.parquet", hive_partitioning=True)
    counted = table.group_by("dive").agg(polars.len()).sort("dive").collect()
    assert counted.rows() == [("april", 6), ("dive_0012", 6)]
    points = polars.scan_parquet(f"{dataset}/points/**/*.parquet", hive_partitioning=True)
    assert points.collect().height == 6 * (20 + 21)


@needs("pandas")
def test_pandas_reads_the_partitions(dataset):
    import pandas

    table = pandas.read_parquet(dataset / "posture", filters=[("valid", "==", True)])
    assert len(table) == 10
    assert sorted(table["dive"].unique()) == list(NAMES)


def test_points_are_not_stored_twice(dataset):
    stored = dataset / "points" / "dive=april" / "points.parquet"
    assert stored.stat().st_ino == (dataset.parent / "april" / "points.parquet").stat().st_ino


def test_a_dive_can_be_taken_out(tmp_path, dataset):
    put_dive(tmp_path, "april", dataset.parent / "april")
    assert holds(tmp_path, "april", OF_DIVE)
    drop(tmp_path, "april", OF_DIVE)
    assert not holds(tmp_path, "april", OF_DIVE)
    assert not list(tmp_path.rglob("*.parquet"))


def test_every_dive_has_its_row(tmp_path):
    failed = record("may", DiveState.FAILED, "no rig")
    write_dives(tmp_path, [record().row(), failed.row()])
    rows = parquet.read_table(tmp_path / "dives.parquet").to_pylist()
    assert [(row["dive"], row["state"], row["words"]) for row in rows] == [
        ("april", "finished", ""),
        ("may", "failed", "no rig"),
    ]
    assert rows[0]["range_median_m"] == 0.61
    assert rows[1]["n_frames"] is None


def test_the_page_tells_all_dives_and_escapes_what_they_say(tmp_path):
    nasty = "</td><script>alert(1)</script>"
    reports = tmp_path / "dives" / "april"
    reports.mkdir(parents=True)
    (reports / "report.html").touch()
    records = [record(), record("may", DiveState.FAILED, nasty), record("june")]
    text = write_summary(tmp_path, records).read_text()
    assert '<a href="dives/april/report.html"' in text
    assert 'href="dives/june' not in text
    assert "<script" not in text
    assert "&lt;script&gt;alert(1)" in text
    assert "2 finished, 1 failed" in text
    assert "100 of 200" in text
    assert text.count("<svg") == 2


def test_a_page_without_any_result_can_be_written(tmp_path):
    text = write_summary(tmp_path, [record("may", DiveState.UNFINISHED)]).read_text()
    assert "1 unfinished" in text


def test_warnings_of_dives_are_on_the_page(tmp_path):
    drifted = DiveRecord.of(
        "april",
        "/dives/april.mp4",
        facts(laser_agreement={"state": "drifted", "words": "laser 2 is off by 1 deg"}),
        reused=False,
    )
    text = write_summary(tmp_path, [drifted]).read_text()
    assert "april: laser 2 is off by 1 deg" in text
    assert drifted.row()["lasers"] == "drifted"


def test_ranges_over_time_keep_their_gaps():
    ranges = np.concatenate([np.full(300, 0.5), np.full(300, np.nan), np.full(300, 0.7)])
    steps = range_steps(ranges)
    assert len(steps) == 120
    assert set(steps) == {0.5, None, 0.7}
    drawn = range_svg(steps, 0.5, 0.7)
    assert drawn.count("M") == 2
    assert range_steps([]) == []
    assert range_svg([], 0.0, 1.0) == ""


def test_a_line_says_how_a_dive_went():
    assert record().line() == "april: 100 frames, posture in 50.0 %, range 0.610 m"
    assert record("may", DiveState.FAILED, "no rig").line() == "may: failed: no rig"
