"""A dive that several processes measure is, byte for byte, the one that one process measures."""

import contextlib
import errno
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from aqualvs.cli.main import main
from aqualvs.errors import SourceError
from aqualvs.optics.rigfile import load_rig
from aqualvs.pipeline import run
from aqualvs.results.run_request import FrameWindow, RunRequest
from aqualvs.scanner import Scanner, ScannerOptions
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.scan import Scan, ScanPoints
from aqualvs.sources import open_source
from aqualvs.workers import pool
from aqualvs.workers.frame_results import (
    FrameProcessor,
    FrameResult,
    block_length,
    in_blocks,
    read_ahead,
)
from aqualvs.workers.pool import Ended, Receiver, Sender, SharedMemory, WorkerPool, pool_job
from batch_cases import DEMO, RESULTS, demo_dive, without_times
from complaints import complaints
from shell_cases import destroy_frame

N, GROUP = 24, 6
RIG = DEMO / "rig.yaml"


@pytest.fixture(scope="module")
def dive(tmp_path_factory):
    return demo_dive(tmp_path_factory.mktemp("dive") / "dive.mp4", N, GROUP)


@pytest.fixture(autouse=True)
def short_dives_are_shared(monkeypatch):
    monkeypatch.setattr(pool, "_MIN_FRAMES", 8)
    monkeypatch.setattr(pool, "_PART_FRAMES", GROUP)


@pytest.fixture
def worker_pools(monkeypatch):
    """The pools that runs have had."""
    seen = []
    entered = WorkerPool.__enter__
    monkeypatch.setattr(
        WorkerPool,
        "__enter__",
        lambda worker_pool: seen.append(worker_pool) or entered(worker_pool),
    )
    return seen


def work_of(source):
    with open_source(source, fps=25 if Path(source).is_dir() else None) as opened:
        return pool_job(opened, FrameWindow(), load_rig(RIG), ScannerOptions())


def results(source, out, n_processes, **more):
    """What a run writes, by name, and how it went."""
    request = RunRequest(
        source=str(source), rig=RIG, out=out, report=False, n_processes=n_processes, **more
    )
    result = run(request)
    return {name: without_times(out / name) for name in RESULTS}, result


def assert_same(source, folder, worker_pools, **more):
    alone, _ = results(source, folder / "alone", 1, **more)
    assert not worker_pools
    shared, result = results(source, folder / "shared", 2, **more)
    assert len(worker_pools) == 1
    assert [name for name in RESULTS if alone[name] == shared[name]] == list(RESULTS)
    assert not multiprocessing.active_children()
    return result


def test_two_processes_find_what_one_finds(tmp_path, dive, worker_pools):
    result = assert_same(dive, tmp_path, worker_pools)
    assert worker_pools[0].is_done
    assert result.summary.n_frames == N
    assert result.summary.n_valid > N - 4


def test_so_they_do_in_a_window_that_cuts_through_parts(tmp_path, dive, worker_pools):
    result = assert_same(dive, tmp_path, worker_pools, frames=FrameWindow(4, 15))
    assert worker_pools[0].is_done
    assert result.summary.n_frames == 11


def test_so_they_do_in_a_folder_of_images(tmp_path, dive, worker_pools):
    folder = tmp_path / "images"
    folder.mkdir()
    with av.open(str(dive)) as container:
        for i, picture in zip(range(2 * GROUP), container.decode(video=0), strict=False):
            cv2.imwrite(str(folder / f"{i}.png"), picture.to_ndarray(format="bgr24"))
    assert_same(folder, tmp_path, worker_pools, fps=12.5)
    assert worker_pools[0].is_done


def test_from_damage_on_one_process_goes_on(tmp_path, dive, worker_pools):
    damaged = tmp_path / "damaged.mp4"
    damaged.write_bytes(dive.read_bytes())
    destroy_frame(damaged, 15)
    result = assert_same(damaged, tmp_path, worker_pools)
    assert not worker_pools[0].is_done
    assert 12 <= worker_pools[0].next_frame <= 15
    assert result.summary.refused["corrupt_frame"] >= 1


def test_from_the_death_of_a_process_on_one_goes_on(tmp_path, dive, worker_pools, monkeypatch):
    """Nothing is lost, and nothing is there twice."""
    whole, _ = results(dive, tmp_path / "alone", 1)
    of_part = WorkerPool._results_of

    def one_dies(worker_pool, number):
        if number == 1:
            for worker in worker_pool._workers:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(worker.process.pid, signal.SIGKILL)
        return of_part(worker_pool, number)

    monkeypatch.setattr(WorkerPool, "_results_of", one_dies)
    shared, result = results(dive, tmp_path / "shared", 2)
    assert result.summary.n_frames == N
    assert whole == shared
    assert GROUP <= worker_pools[0].next_frame <= N


def test_what_is_given_up_leaves_no_process(dive):
    work = work_of(dive)
    with WorkerPool(work, 3) as worker_pool:
        first, *_ = next(worker_pool.blocks())
        assert len(multiprocessing.active_children()) == 3
    assert first.scan.index == 0
    assert not multiprocessing.active_children()


@pytest.mark.parametrize(
    "more",
    [{"overlay": True}, {"mcap": True}, {"frames": FrameWindow(0, 7)}],
    ids=["pictures", "stripes", "few-frames"],
)
def test_what_needs_this_process_is_done_by_it(tmp_path, dive, worker_pools, more):
    if "mcap" in more:
        pytest.importorskip("foxglove")
    results(dive, tmp_path / "out", 2, **{"frames": FrameWindow(0, 9), **more})
    assert not worker_pools


def test_without_memory_to_share_all_goes_through_the_pipe(
    tmp_path, dive, worker_pools, monkeypatch
):
    def refused(_):
        raise OSError(errno.EMFILE, "none")

    monkeypatch.setattr(os, "memfd_create", refused, raising=False)
    assert SharedMemory.new() is None
    assert_same(dive, tmp_path, worker_pools)
    assert worker_pools[0].is_done


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are copied on Linux")
@pytest.mark.parametrize(("threads", "how"), [(0, "fork"), (1, "forkserver")])
def test_a_process_is_copied_only_while_it_has_no_threads(threads, how):
    program = f"""
import threading
from aqualvs.workers.start_method import context
held = threading.Event()
for _ in range({threads}):
    threading.Thread(target=held.wait, daemon=True).start()
print(context().get_start_method())
"""
    said = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=300
    )
    assert said.stdout.strip() == how


def test_a_video_without_key_frames_inside_is_not_shared(tmp_path):
    assert work_of(demo_dive(tmp_path / "one.mp4", 12, 100)) is None


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are copied on Linux")
def test_the_command_shares_a_dive_by_default(tmp_path):
    """In a process of its own, which may copy itself."""
    dive = demo_dive(tmp_path / "dive.mp4", 108, 36)
    one, two = tmp_path / "one", tmp_path / "two"
    words = ["run", str(dive), "--rig", str(RIG), "--no-report"]
    command = [sys.executable, "-m", "aqualvs", *words, "-o", str(two), "--workers", "2"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert "108 frames" in done.stdout
    assert not complaints(done.stderr)
    assert main([*words, "-o", str(one), "--workers", "1"]) == 0
    assert all(without_times(one / n) == without_times(two / n) for n in RESULTS)


@pytest.fixture(scope="module")
def block(dive):
    rig = load_rig(RIG)
    with open_source(dive) as source:
        frames = [frame for _, frame in zip(range(3), source, strict=False)]
    return FrameProcessor(rig, Scanner(rig)).measure(frames)


@pytest.fixture
def ends():
    """Both ends of what messages pass through, and a thread that ends when they are closed."""
    mine, theirs = multiprocessing.Pipe()
    memory = SharedMemory.new()
    if memory is None:
        pytest.skip("the system has no memory to share")
    memory.seal()
    with theirs, ThreadPoolExecutor(1) as thread, mine:
        yield Sender(theirs, memory), Receiver(mine, memory), thread


def assert_like(block, found):
    assert [m.frame for m in found] == [None] * len(block)
    for one, other in zip(block, found, strict=True):
        assert (one.scan.index, one.scan.time_s) == (other.scan.index, other.scan.time_s)
        assert one.scan.n_water == other.scan.n_water
        for mine, theirs in [(one.scan.posture, other.scan.posture), (one.bare, other.bare)]:
            assert type(mine) is type(theirs)
            assert repr(mine) == repr(theirs)
            if isinstance(mine, Posture):
                # What is printed is rounded.
                assert np.array_equal(mine.covariance, theirs.covariance)
                assert np.array_equal(mine.normal_in_dome, theirs.normal_in_dome)
        for field in fields(ScanPoints):
            mine, theirs = (getattr(m.scan.points, field.name) for m in (one, other))
            assert mine.dtype == theirs.dtype
            assert np.array_equal(mine, theirs)


def test_messages_arrive_as_they_were(block, ends):
    sender, receiver, _ = ends
    refused = Scan(7, 0.5, Refusal(Reason.NO_STRIPES, "dark"), ScanPoints.none(), 1.34)
    dark = [FrameResult(refused, refused.posture), FrameResult(refused, None)]
    for message in (block, dark, [*dark, *block], block[:1], block, dark):
        sender.send(message)
        assert_like(message, receiver.receive())
    for message in Ended:
        sender.send(message)
        assert receiver.receive() is message


def test_so_do_those_that_are_too_large_for_their_place(block, ends, monkeypatch):
    sender, receiver, thread = ends
    monkeypatch.setattr(pool, "_SLOT_BYTES", 4096)
    sent = thread.submit(sender.send, block)
    assert_like(block, receiver.receive())
    sent.result(timeout=60)


def test_a_sender_waits_until_there_is_a_place(block, ends):
    """Nothing is written over that has not been taken out, and parts come in between."""
    sender, receiver, thread = ends
    messages = [[one] * n for n in range(1, 5) for one in block]

    def send():
        for message in messages:
            sender.send(message)
        sender.send(Ended.WHOLE)
        return sender.next_part()

    sent = thread.submit(send)
    time.sleep(0.2)
    assert not sent.done()
    for message in messages:
        assert_like(message, receiver.receive())
    assert receiver.receive() is Ended.WHOLE
    receiver.assign(5)
    assert sent.result(timeout=60) == 5


def breaking_off(n):
    yield from range(n)
    raise SourceError("the end is missing")


@pytest.mark.parametrize("ahead", [False, True])
def test_what_came_before_a_break_is_in_blocks(ahead):
    blocks = in_blocks(breaking_off(7), 3)
    found = []
    with pytest.raises(SourceError, match="the end is missing"):  # noqa: PT012
        for block in read_ahead(blocks) if ahead else blocks:
            found.append(block)
    assert found == [[0, 1, 2], [3, 4, 5], [6]]


def test_reading_ahead_ends_with_its_reader():
    fetched, n_before = [], threading.active_count()

    def items():
        for i in range(1000):
            fetched.append(i)
            yield i

    reader = read_ahead(items())
    assert [next(reader) for _ in range(3)] == [0, 1, 2]
    time.sleep(0.05)
    assert len(fetched) <= 6
    reader.close()
    assert threading.active_count() == n_before


def test_blocks_of_large_pictures_are_short():
    assert block_length((720, 576)) == 8
    assert 1 <= block_length((3840, 2160)) < 4
    assert block_length((16000, 12000)) == 1
