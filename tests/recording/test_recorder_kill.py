"""Recordings whose process was killed at any moment, read by independent readers.

Run as a program it is the process that starts those which are killed: it imports everything once,
and forks for each.
"""

import errno
import os
import random
import signal
import struct
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from repository import HELPERS
from waiting import TIMEOUT_S, until

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs processes as POSIX has them")

N_KILLS = int(os.environ.get("AQUALVS_KILLS", "24"))
_ROOM = 20 << 20


def child(path, kind):
    """Record without end; what is surely in the file is told in a file beside it."""
    from aqualvs.recording import Recorder, RecorderOptions, Recording

    options = RecorderOptions(chunk_s=0.04, points_hz=None, sync_s=None)
    told = os.open(path.with_suffix(".told"), os.O_CREAT | os.O_WRONLY)
    if kind == "full":
        import resource

        resource.setrlimit(resource.RLIMIT_FSIZE, (_ROOM, _ROOM))
    recorder = Recorder(path, options) if kind == "thread" else Recording(path, options)
    for i, sample in endless():
        try:
            recorder.write(sample) if kind != "thread" else recorder.send(sample)
        except OSError as full:
            os._exit(0 if full.errno == errno.EFBIG else 3)
        # Chunks are 40 ms of samples 40 ms apart: two frames each, the last one perhaps begun.
        os.pwrite(told, struct.pack("<Q", max(0, i - 1)), 0)
        if kind == "thread":
            time.sleep(0.002)


def endless():
    from live_cases import demo_samples

    samples, i = demo_samples(4), 0
    while True:
        sample = samples[i % 4]
        at = 10**9 + 40_000_000 * i
        yield (
            i,
            replace(
                sample,
                scan=replace(sample.scan, index=i, time_s=0.04 * i),
                instants=replace(sample.instants, arrived_ns=at, scanned_ns=at + 10**6),
            ),
        )
        i += 1


def launcher():
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    next(endless())
    print("ready", flush=True)
    for line in sys.stdin:
        path, kind = line.rstrip("\n").split("\t")
        pid = os.fork()
        if not pid:
            try:
                child(Path(path), kind)
            finally:
                os._exit(4)
        print(pid, flush=True)


@pytest.fixture(scope="module")
def start():
    """Start a process that records; returns its number."""
    folders = os.pathsep.join([str(HELPERS), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": folders, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, __file__],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    )
    assert process.stdout.readline() == "ready\n"

    def begin(path, kind):
        process.stdin.write(f"{path}\t{kind}\n")
        process.stdin.flush()
        pid = int(process.stdout.readline())
        until(path.exists, "a recording")
        return pid

    yield begin
    process.stdin.close()
    process.wait(TIMEOUT_S)
    process.stdout.close()


def kill(pid):
    os.kill(pid, signal.SIGKILL)
    gone(pid)


def gone(pid):
    """Wait until a process is no more."""

    def is_gone():
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        return False

    until(is_gone, f"the end of process {pid}")


def told_by(path):
    """Frames that a process says it has recorded."""
    told = path.with_suffix(".told")
    content = told.read_bytes() if told.exists() else b""
    return struct.unpack("<Q", content)[0] if content else 0


def check(path):
    """Read a file in every way; returns the number of frames in it."""
    from aqualvs.recording import DiveRecording
    from aqualvs.recording.encoding import POSTURE, STRIPES
    from recorder_cases import counted, read_by_mcap, read_by_rosbags

    found, linear = read_by_mcap(path), read_by_mcap(path, linear=True)
    n = counted(found)[STRIPES.name]
    assert counted(found)[POSTURE.name] == n
    # The record of a chunk comes before its entry in the summary.
    assert linear[: len(found)] == found
    assert sorted(read_by_rosbags(path)) == sorted(found)
    if n:
        frames = DiveRecording(path).frames(with_pictures=False)
        assert [frame.index for frame in frames] == list(range(n))
    return n, counted(linear)[STRIPES.name]


def test_a_kill_at_any_moment_leaves_a_readable_file(start, tmp_path):
    moments = random.Random(5)
    sizes = []
    for i in range(N_KILLS):
        path = tmp_path / f"dive{i}.mcap"
        kind = ("thread", "plain")[i % 2]
        pid = start(path, kind)
        goal = moments.choice([0, 4, 15, 30, 150]) * moments.random()
        until(lambda path=path, goal=goal: told_by(path) >= goal, f"{goal} frames")
        time.sleep(0.003 * moments.random())
        kill(pid)
        n, n_linear = check(path)
        sizes.append(n)
        if kind == "plain":
            assert n_linear >= told_by(path)
        path.unlink()
    assert max(sizes) > 20
    assert len(set(sizes)) > 5


def test_a_limit_on_file_size_is_a_full_disk(start, tmp_path):
    """The system's own refusal: what was written before it stays readable."""
    path = tmp_path / "dive.mcap"
    gone(start(path, "full"))
    n, n_linear = check(path)
    assert path.stat().st_size <= _ROOM
    assert n == n_linear > 50


if __name__ == "__main__":
    launcher()
