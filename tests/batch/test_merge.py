"""A dive that was cut and joined is, byte for byte, the one that was run as a whole."""

from functools import partial

import numpy as np
import pytest
import yaml

import batch_cases
from aqualvs.batch.dataset import OF_DIVE, holds
from aqualvs.batch.dives import DiveState
from aqualvs.batch.scheduler import Scheduler, WorkersLostError, look
from aqualvs.optics.rigfile import load_rig, save_rig
from aqualvs.pipeline import run
from aqualvs.results.run_request import scanner_options
from batch_cases import DEMO, RESULTS, InlineWorkers, Listener, demo_dive, without_times
from shell_cases import cut_after, damage_frame, destroy_frame, rig_file, write_video

N, GROUP = 16, 4
work_for = partial(batch_cases.work_for, piece_frames=GROUP)


@pytest.fixture(scope="module")
def dive(tmp_path_factory):
    return demo_dive(tmp_path_factory.mktemp("dive") / "dive.mp4", N, GROUP)


@pytest.fixture(scope="module")
def net_file(tmp_path_factory):
    """A target file that says what the net is, so that a run checks it."""
    path = tmp_path_factory.mktemp("net") / "net.yaml"
    path.write_text("kind: net\nnet: {mesh: diamond, bar_mm: 25}\n")
    return path


def options(net_file):
    target = str(net_file)
    return {"target": target, "scanner": scanner_options(target, "ridge", "none", "robust")}


@pytest.fixture(scope="module")
def serial(dive, net_file, tmp_path_factory):
    folder = tmp_path_factory.mktemp("serial")
    request = work_for(folder, dive, report=True, **options(net_file)).request
    run(request)
    return request.out


def season(works, workers=None):
    listener = Listener()
    sized = [(work, 1000) for work in works]
    return Scheduler(sized, workers or InlineWorkers(), listener).run(lambda: False), listener


def same_files(one, other, names=RESULTS):
    return [name for name in names if without_times(one / name) == without_times(other / name)]


def test_four_pieces_give_what_the_run_gives(tmp_path, dive, net_file, serial):
    work = work_for(tmp_path, dive, report=True, **options(net_file))
    workers = InlineWorkers()
    records, listener = season([work], workers)
    assert workers.done.count("measure_piece") == 4
    names = (*RESULTS, "report.html")
    assert same_files(serial, work.request.out, names) == list(names)
    assert records["dive"].state is DiveState.FINISHED
    assert listener.n_frames == N
    # All that was expected was done, in bytes too.
    assert 0 < listener.expected == listener.measured_bytes <= dive.stat().st_size


def test_what_is_watched_over_the_dive_is_in_the_summary(serial):
    """Else the test above would compare nothing."""
    summary = yaml.safe_load((serial / "run.yaml").read_text())["summary"]
    assert summary["laser_agreement"]["n_frames"] > 5
    assert summary["net_check"]["n_frames"] >= 4
    assert summary["n_valid"] > N - 4


@pytest.mark.parametrize("piece_frames", [7, 1000])
def test_the_length_of_the_pieces_changes_nothing(tmp_path, dive, net_file, serial, piece_frames):
    work = work_for(tmp_path, dive, piece_frames=piece_frames, **options(net_file))
    season([work])
    assert same_files(serial, work.request.out) == list(RESULTS)


def test_dying_workers_change_nothing(tmp_path, dive, net_file, serial):
    """Tasks are lost at random; what was finished before is not done again."""
    work, rng = work_for(tmp_path, dive, **options(net_file)), np.random.default_rng(3)
    lost = []

    def fail(name, _number):
        if name == "measure_piece" and len(lost) < 2 and rng.random() < 0.5:
            lost.append(name)
            raise WorkersLostError("gone")

    records, _ = season([work], InlineWorkers(fail))
    assert len(lost) == 2
    assert records["dive"].state is DiveState.FINISHED
    assert same_files(serial, work.request.out) == list(RESULTS)


def test_workers_that_always_die_fail_the_dive(tmp_path, dive):
    def fail(name, _number):
        if name == "measure_piece":
            raise WorkersLostError("the processes died")

    records, listener = season([work_for(tmp_path, dive)], InlineWorkers(fail))
    assert records["dive"].state is DiveState.FAILED
    assert listener.lines == ["dive: failed: the processes died"]


def test_a_batch_that_was_stopped_goes_on(tmp_path, dive, net_file, serial):
    work = work_for(tmp_path, dive, **options(net_file))
    first = InlineWorkers()
    stopped = Scheduler([(work, 1)], first, Listener())
    records = stopped.run(lambda: first.done.count("measure_piece") == 2)
    assert records["dive"].state is DiveState.UNFINISHED
    kept = list(work.home.glob("pieces-*/*/done.json"))
    assert len(kept) == 2
    records, listener = season([work])
    # Two pieces were taken as they were.
    assert listener.n_frames == N // 2
    assert listener.expected == listener.measured_bytes
    assert same_files(serial, work.request.out) == list(RESULTS)


def test_a_damaged_piece_is_measured_again(tmp_path, dive, net_file, serial):
    work = work_for(tmp_path, dive, **options(net_file))
    first = InlineWorkers()
    Scheduler([(work, 1)], first, Listener()).run(lambda: first.done.count("measure_piece") == 3)
    piece = next(work.home.glob("pieces-*/*"))
    rows = (piece / "posture.csv").read_bytes()
    (piece / "posture.csv").write_bytes(rows.replace(b"1", b"2", 1))
    _, listener = season([work])
    assert listener.n_frames == 2 * N // 4
    assert same_files(serial, work.request.out) == list(RESULTS)


def test_a_finished_dive_is_checked_and_taken_as_it_is(tmp_path, dive):
    work = work_for(tmp_path, dive)
    season([work])
    assert list(work.home.glob("pieces-*")) == []
    workers = InlineWorkers()
    records, _ = season([work], workers)
    assert workers.done == ["look"]
    assert records["dive"].reused
    rows = work.request.out / "posture.csv"
    rows.write_bytes(rows.read_bytes()[:-1])
    workers = InlineWorkers()
    season([work], workers)
    assert workers.done.count("measure_piece") == 4


def test_another_rig_makes_another_result(tmp_path, dive):
    rig = tmp_path / "rig.yaml"
    save_rig(load_rig(DEMO / "rig.yaml"), rig)
    work = work_for(tmp_path, dive, rig=rig)
    season([work])
    before = (work.request.out / "posture.csv").read_bytes()
    # The same rig under another comment is the same.
    rig.write_text("# checked in May\n" + rig.read_text())
    assert look(work)[1] is not None
    save_rig(load_rig(rig).in_water(1.36), rig)
    assert look(work)[1] is None
    season([work])
    assert (work.request.out / "posture.csv").read_bytes() != before


@pytest.mark.parametrize("damage", [damage_frame, destroy_frame])
def test_a_damaged_dive_is_what_its_run_is(tmp_path, damage):
    """What becomes of the pictures after the damage only the whole video tells."""
    source = demo_dive(tmp_path / "dive.mp4", 15, 5)
    damage(source, 8)
    work = work_for(tmp_path, source, piece_frames=5)
    workers = InlineWorkers()
    records, listener = season([work], workers)
    whole = work_for(tmp_path / "serial", source).request
    run(whole)
    assert same_files(whole.out, work.request.out) == list(RESULTS)
    assert records["dive"].facts["n_pieces"] == 1
    assert records["dive"].facts["why_whole"] != ""
    assert listener.expected == listener.measured_bytes


def test_a_dive_that_breaks_off_is_incomplete_and_what_its_run_is(tmp_path):
    source = write_video(
        tmp_path / "dive.mp4",
        12,
        options={"preset": "ultrafast", "g": "3"},
        mux={"movflags": "faststart"},
    )
    cut_after(source, 7)
    work = work_for(tmp_path, source, piece_frames=3, rig=rig_file(tmp_path))
    records, _ = season([work])
    whole = work_for(tmp_path / "serial", source, rig=rig_file(tmp_path)).request
    fault = run(whole).fault
    assert records["dive"].state is DiveState.INCOMPLETE
    assert records["dive"].words == str(fault)
    assert same_files(whole.out, work.request.out) == list(RESULTS)
    # It is the source's fault, not ours: there is nothing to be done again.
    assert look(work)[1] is not None


def test_a_failed_dive_is_told_and_does_not_stop_the_others(tmp_path, dive):
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(b"no video")
    wrong = write_video(tmp_path / "wrong.mp4", 3, size=(64, 48))
    works = [
        work_for(tmp_path, broken, "broken"),
        work_for(tmp_path, wrong, "wrong"),
        work_for(tmp_path, dive, "good"),
    ]
    records, listener = season(works)
    states = {name: record.state for name, record in records.items()}
    assert states == {
        "broken": DiveState.FAILED,
        "wrong": DiveState.FAILED,
        "good": DiveState.FINISHED,
    }
    assert "not a video" in records["broken"].words
    assert "pictures of 64x48 px" in records["wrong"].words
    assert len(listener.lines) == 3


def test_a_fault_of_ours_fails_the_dive_alone(tmp_path, dive):
    works = [work_for(tmp_path, dive, "one"), work_for(tmp_path, dive, "two")]
    failed_once = []

    def fail(name, _number):
        if name == "join" and not failed_once:
            failed_once.append(name)
            raise ZeroDivisionError("oops")

    records, _ = season(works, InlineWorkers(fail))
    assert sorted(record.state for record in records.values()) == ["failed", "finished"]
    failed = next(name for name, r in records.items() if r.state is DiveState.FAILED)
    assert records[failed].words == "ZeroDivisionError: oops"
    assert not holds(works[0].dataset, failed, OF_DIVE)
