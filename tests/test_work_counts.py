"""How much work a frame takes, counted: seconds say little on a machine that others share.

Counted are Python calls and bytes, which are the same on every machine. Compiled kernels are one
call each, so what these counts guard is everything around them: loops that slipped into Python,
copies of pictures, tables that grow with the dive. Bounds are what was counted and a tolerance;
they fail in both directions, so that a saving is written down here and cannot be lost again.
"""

import gc
import sys
import threading
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import pytest

import aqualvs
from aqualvs.demo import bundled_dive
from aqualvs.geometry.compiled import compiled_at_once
from aqualvs.optics.rigfile import load_rig
from aqualvs.pipeline import run
from aqualvs.results.run_request import FrameWindow, RunRequest
from aqualvs.scanner import Scanner
from aqualvs.scanning.scan import Frame
from aqualvs.sources import open_source

DIVE = Path(str(bundled_dive() / "dive.mp4"))
RIG = Path(str(bundled_dive() / "rig.yaml"))
OWN = str(Path(aqualvs.__file__).parent)
KIB = 1024.0

# Counted on the frames of the bundled dive, with Python 3.11 and NumPy 2.
SCAN_CALLS, SCAN_FOREIGN, SCAN_PEAK_KIB = 227.0, 75.0, 960.0
RUN_CALLS, RUN_FOREIGN = 325.0, 115.0


@dataclass
class Calls:
    """Python functions that were called: the project's, and those of the packages it uses."""

    own: int = 0
    foreign: int = 0


@contextmanager
def counted() -> Iterator[Calls]:
    """Count the calls of this thread and of those that it begins.

    Comprehensions, which are calls in Python 3.11 only, are none.
    """
    calls, is_own = Calls(), dict[CodeType, bool]()

    def note(frame: FrameType, event: str, _argument: Any) -> None:
        code = frame.f_code
        if event != "call" or code.co_name.startswith("<"):
            return
        if is_own.setdefault(code, code.co_filename.startswith(OWN)):
            calls.own += 1
        else:
            calls.foreign += 1

    before = sys.getprofile()
    sys.setprofile(note)
    threading.setprofile(note)
    try:
        yield calls
    finally:
        threading.setprofile(None)
        sys.setprofile(before)


def peak_kib(call: Callable[[], object]) -> float:
    """Return how much Python and NumPy hold at most during a call, above what they hold before."""
    gc.collect()
    tracemalloc.start()
    try:
        at_first = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        call()
        return (tracemalloc.get_traced_memory()[1] - at_first) / KIB
    finally:
        tracemalloc.stop()


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    """Every tenth frame of the bundled dive."""
    with open_source(str(DIVE)) as source:
        return list(source)[::10]


@pytest.fixture(scope="module")
def scanner(frames: list[Frame]) -> Scanner:
    """A scanner that has seen the frames, so that no kernel remains to be loaded."""
    ready = Scanner(load_rig(RIG))
    with compiled_at_once():
        assert all(ready.process(frame).posture for frame in frames)
    return ready


def measure(out: Path, stop: int) -> None:
    request = RunRequest(
        source=str(DIVE),
        rig=RIG,
        out=out,
        overwrite=True,
        report=False,
        frames=FrameWindow(0, stop),
    )
    with compiled_at_once():
        assert run(request).summary.n_frames == stop


def test_calls_of_a_scan(scanner: Scanner, frames: list[Frame]) -> None:
    # Some hundred calls a frame stand for the stages, their surfaces and lasers. A loop over
    # search lines (576) or stripe points (2000) in Python would at least treble them.
    with counted() as calls:
        for frame in frames:
            scanner.process(frame)
    assert calls.own / len(frames) == pytest.approx(SCAN_CALLS, rel=0.15)
    # Helpers of NumPy, written in Python; their number depends on NumPy's version.
    assert SCAN_FOREIGN / 3 < calls.foreign / len(frames) < 2 * SCAN_FOREIGN


def test_calls_of_a_further_frame_of_a_run(tmp_path: Path) -> None:
    # What remains of a scan's cost: decoding, rows of the tables, tally, progress. The first run
    # loads what is loaded once; the difference of two leaves out what every run does once.
    found = []
    for stop in (15, 15, 35):
        with counted() as calls:
            measure(tmp_path / "out", stop)
        found.append(calls)
    own = (found[2].own - found[1].own) / 20
    foreign = (found[2].foreign - found[1].foreign) / 20
    assert own == pytest.approx(RUN_CALLS, rel=0.15)
    assert RUN_FOREIGN / 3 < foreign < 2 * RUN_FOREIGN


def test_memory_of_a_scan(scanner: Scanner, frames: list[Frame]) -> None:
    # A picture has 405 KiB of luma and as much again in halves of float32; a copy of the luma as
    # float64 would be 3240 KiB.
    peaks = [peak_kib(lambda frame=frame: scanner.process(frame)) for frame in frames[::3]]
    assert max(peaks) == pytest.approx(SCAN_PEAK_KIB, rel=0.15)


def test_scans_leave_nothing_behind(scanner: Scanner, frames: list[Frame]) -> None:
    # Eight rounds of the same frames, all watched: the first ones fill what Python keeps for reuse.
    # A leak adds to each of the last three rounds. Ten thousand such frames, seven minutes, may
    # keep 10 MiB.
    held_kib = []
    tracemalloc.start()
    try:
        for _ in range(8):
            for frame in frames:
                scanner.process(frame)
            gc.collect()
            held_kib.append(tracemalloc.get_traced_memory()[0] / KIB)
    finally:
        tracemalloc.stop()
    kept_kib = min(after - before for before, after in pairwise(held_kib[-4:]))
    assert kept_kib / len(frames) < 1.0


def test_decoded_pictures_are_not_copied() -> None:
    # All planes of one picture are 608 KiB, which NumPy would own if they were copied.
    def decode() -> None:
        with open_source(str(DIVE)) as source:
            assert sum(1 for _ in source) == 150

    decode()
    assert peak_kib(decode) < 100.0


def test_memory_of_a_run_is_flat(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Points wait for a row group of Parquet to be full: of a hundred frames, and here of three.
    monkeypatch.setattr("aqualvs.results.points._ROWS_PER_GROUP", 1 << 12)
    # Tables are written as they come: a run of twice the frames holds no more, once all that
    # is read ahead is there. The 60 more frames would bring 3 MiB if only their points were kept.
    measure(tmp_path / "out", 10)
    short, long = (peak_kib(lambda n=n: measure(tmp_path / "out", n)) for n in (40, 100))
    assert long < short + 256.0
