"""The state of the nets of a batch: as `aqualvs net` tells it, and told again where needed."""

import os
import shutil
from dataclasses import replace

import pytest
from pyarrow import dataset as arrow_dataset

from aqualvs.batch.dives import DiveState
from aqualvs.batch.scheduler import Scheduler, known_net
from aqualvs.batch.summary_page import write_summary
from aqualvs.batch.work import probe
from aqualvs.errors import OptionError
from aqualvs.net_survey.command import NetSource, net_of_run
from aqualvs.nets.target_file import NetRequest, net_request
from aqualvs.results.folder import NET_FILES
from aqualvs.results.run_request import scanner_options
from batch_cases import InlineWorkers, Listener, demo_dive, work_for
from net_app_cases import leave_maps_blank

BARE = NetRequest()


@pytest.fixture(scope="module")
def dive(tmp_path_factory):
    """Three seconds in which a stretch of the net and its hole pass."""
    return demo_dive(tmp_path_factory.mktemp("dive") / "dive.mp4", 75, 25)


def season(work):
    """How the dive stands after a batch, and what was done."""
    workers, listener = InlineWorkers(), Listener()
    records = Scheduler([(work, 1000)], workers, listener).run(lambda: False)
    return records[work.name], workers.done, listener.lines


@pytest.fixture(scope="module")
def told(tmp_path_factory, dive):
    """The folder of a batch whose net was told, and its dive's record."""
    folder = tmp_path_factory.mktemp("season")
    work = work_for(folder, dive, piece_frames=25, net=BARE, report=True)
    record, done, lines = season(work)
    assert done.count("measure_piece") == 3
    return folder, work, record, lines


@pytest.fixture
def finished(tmp_path, told, dive, monkeypatch):
    """A copy of it, of which no further map is drawn."""
    leave_maps_blank(monkeypatch)
    folder = tmp_path / "season"
    # Links keep what two places of a batch share one file.
    shutil.copytree(told[0], folder)
    return work_for(folder, dive, piece_frames=25, net=BARE, report=True)


def test_it_is_what_the_net_command_tells(tmp_path, told):
    _, work, record, lines = told
    out, own = work.request.out, tmp_path / "own"
    net_of_run(NetSource(source=str(out), out=own), BARE, lambda _: None)
    assert [n for n in NET_FILES if (own / n).read_bytes() == (out / n).read_bytes()] == list(
        NET_FILES
    )
    assert record.state is DiveState.FINISHED
    assert record.net["n_stretches"] >= 1
    assert record.net["bar_mm"] == pytest.approx(25.0, abs=1.0)
    assert record.net_text() in lines[0]
    assert '<section id="net">' in (out / "report.html").read_text()


def test_it_is_in_the_data_set_and_on_the_page(told):
    folder, work, record, _ = told
    tables = {
        name: arrow_dataset.dataset(
            folder / "dataset" / name, format="parquet", partitioning="hive"
        ).to_table()
        for name in ("net", "holes")
    }
    assert tables["net"]["dive"].unique().to_pylist() == ["dive"]
    rows = (work.request.out / "net.csv").read_text().splitlines()
    assert tables["net"].num_rows == len(rows) - 1 == record.net["n_stretches"]
    assert tables["holes"].num_rows == record.net["n_holes"]
    assert tables["net"]["bar_mm"].to_pylist()[0] == pytest.approx(25.0, abs=1.0)
    # What was not known is null, of whatever type.
    assert tables["net"]["depth_m"].null_count == tables["net"].num_rows
    row = record.row()
    assert row["net_bar_mm"] == record.net["bar_mm"]
    assert row["net_holes"] == record.net["n_holes"]
    page = write_summary(folder, [record]).read_text()
    assert f'<a href="dives/dive/net_map.png" title="map of the net">{record.net_text()}' in page


def test_a_net_that_moves_too_fast_for_its_track_is_warned_of(told):
    folder, _, record, _ = told
    words = "meshes may be miscounted"
    assert words not in record.line()
    net = {**record.net, "fast_frames": record.net["n_net_frames"]}
    record = replace(record, facts={**record.facts, "net": net})
    assert "; warning: the net moves by about half a mesh" in record.line()
    assert words in write_summary(folder, [record]).read_text()


def test_another_batch_takes_it_as_it_is(finished):
    out = finished.request.out
    before = {name: (out / name).stat().st_mtime_ns for name in NET_FILES}
    record, done, _ = season(finished)
    assert done == ["look"]
    assert record.reused
    assert record.net["n_stretches"] >= 1
    assert before == {name: (out / name).stat().st_mtime_ns for name in NET_FILES}


def test_other_options_tell_it_again_but_measure_nothing(finished):
    request = replace(finished.request, net=NetRequest(twine_mm=4.0))
    before = (finished.request.out / "net.csv").read_bytes()
    record, done, _ = season(replace(finished, request=request))
    assert done == ["look"]
    assert record.net["fouling"] < 0.0
    assert (finished.request.out / "net.csv").read_bytes() != before


@pytest.mark.parametrize("lost", ["net_map.png", "dataset"])
def test_what_is_lost_is_told_again(finished, lost):
    if lost == "dataset":
        path = finished.dataset / "holes" / "dive=dive" / "holes.parquet"
    else:
        path = finished.request.out / lost
    path.unlink()
    record, done, _ = season(finished)
    assert done == ["look"]
    assert record.net
    assert path.is_file()


def test_a_batch_that_does_not_ask_still_knows_it(finished):
    request = replace(finished.request, net=None)
    record, done, _ = season(replace(finished, request=request))
    assert done == ["look"]
    assert record.net["n_stretches"] >= 1
    key = probe(finished).key
    assert known_net(finished.home, key)["net"] == record.net
    assert known_net(finished.home, f"{key[:-1]}x") == {}


def test_that_of_another_result_does_not_count(finished):
    """A dive that is measured again without its net has none."""
    water = replace(finished.request.water, n_water=1.34)
    request = replace(finished.request, net=None, water=water)
    record, done, _ = season(replace(finished, request=request))
    assert "measure_piece" in done
    assert not record.net
    assert not any((finished.request.out / name).exists() for name in NET_FILES)
    assert not list((finished.dataset / "net").rglob("*.parquet"))


def test_a_log_that_cannot_be_used_leaves_the_dive_measured(finished, tmp_path):
    log = tmp_path / "dive.csv"
    log.write_text("no log\n")
    request = replace(finished.request, net=NetRequest(log=log))
    record, done, _ = season(replace(finished, request=request))
    assert done == ["look"]
    assert record.state is DiveState.INCOMPLETE
    assert record.words.startswith("condition of the net: ")
    assert str(log) in record.words
    assert (finished.request.out / "points.parquet").is_file()
    os.unlink(log)
    record, _, _ = season(replace(finished, request=request))
    assert "cannot be read" in record.words
    # Nothing stands in the way of the next one.
    assert season(finished)[0].state is DiveState.FINISHED


def test_a_dive_without_a_net_has_none_to_tell_of(tmp_path):
    source = demo_dive(tmp_path / "dive.mp4", 12)
    scanner = scanner_options("solid", "ridge", "none", "robust")
    work = work_for(tmp_path, source, piece_frames=1000, net=BARE, target="solid", scanner=scanner)
    record, _, lines = season(work)
    assert record.net["n_stretches"] == 0
    assert "no net seen" in lines[0]
    assert (tmp_path / "dataset" / "net" / "dive=dive" / "net.parquet").is_file()


@pytest.mark.parametrize("said", [{"twine_mm": 2.0}, {"stretch_m": 1.0}])
def test_what_is_said_about_a_net_that_nobody_asks_for_is_refused(said):
    values = {"twine_mm": None, "stretch_m": None} | said
    with pytest.raises(OptionError, match="add --net"):
        net_request(wanted=False, **values)
    assert net_request(wanted=True, **values) == NetRequest(**said)
    assert net_request(wanted=False, twine_mm=None, stretch_m=None) is None
