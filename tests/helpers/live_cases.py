"""Feeds and outputs for tests of live runs: scripted, without hardware or network."""

import functools
import importlib.resources
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from aqualvs.errors import SourceError
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import load_rig
from aqualvs.recording.sample import Instants, LiveSample
from aqualvs.scanner import Scanner
from aqualvs.scanning.scan import Frame
from aqualvs.sources import open_source
from aqualvs.sources.base import Health, PartHealth, State

Step = Frame | float | Exception


@functools.cache
def demo_rig() -> Rig:
    """Rig of the dive that comes with the package."""
    folder = importlib.resources.files("aqualvs") / "data" / "demo"
    with importlib.resources.as_file(folder / "rig.yaml") as path:
        return load_rig(path)


@functools.cache
def demo_frames(n: int = 8) -> tuple[Frame, ...]:
    """First frames of the dive that comes with the package, free of the decoder."""
    folder = importlib.resources.files("aqualvs") / "data" / "demo"
    frames = []
    with importlib.resources.as_file(folder / "dive.mp4") as path, open_source(path) as source:
        for frame in source:
            chroma = frame.chroma
            copied = None if chroma is None else (chroma[0].copy(), chroma[1].copy())
            frames.append(replace(frame, luma=frame.luma.copy(), chroma=copied))
            if len(frames) == n:
                break
    return tuple(frames)


@functools.cache
def demo_scanner() -> Scanner:
    """Scanner for the dive that comes with the package."""
    return Scanner(demo_rig())


def demo_samples(n: int = 8) -> list[LiveSample]:
    """Samples of the dive that comes with the package, 40 ms apart."""
    scanner = demo_scanner()
    found = []
    for frame in demo_frames(n):
        peaks = scanner.detect(frame)
        scan = scanner.measure(frame.index, frame.time_s, peaks)
        at = 10**9 + 40_000_000 * frame.index
        found.append(
            LiveSample(
                rig=scanner.rig,
                scan=scan,
                peaks=peaks,
                frame=frame,
                utc_ns=1_790_000_000_000_000_000 + 40_000_000 * frame.index,
                instants=Instants(at, at + 100_000, at + 1_500_000),
                filtered=None,
                health=Health(rate_hz=25.0, n_frames=frame.index + 1),
            )
        )
    return found


@functools.cache
def first_sample() -> LiveSample:
    """The first sample of the dive; measured when first asked for, not at the import."""
    return demo_samples(1)[0]


def renumbered(frame: Frame, index: int) -> Frame:
    """The same picture as another frame of a 25 Hz stream."""
    return Frame(index, 0.04 * index, frame.luma, frame.chroma)


def of_size(width: int, height: int, index: int) -> Frame:
    """A grey frame of any size."""
    return Frame(index, 0.04 * index, np.full((height, width), 40, np.uint8))


class ScriptedFeed:
    """Plays steps: a frame is delivered, a number is a pause in seconds, an exception is raised.

    Parameters
    ----------
    steps : sequence
    endless : bool
        Stay silent after the last step, until it is closed, as a stream does.
    """

    def __init__(self, steps: Sequence[Step], *, endless: bool = False) -> None:
        self.name = "script"
        self._steps = list(steps)
        self._endless = endless
        self._closed = threading.Event()

    def __iter__(self) -> Iterator[Frame]:
        while self._steps and not self._closed.is_set():
            step = self._steps.pop(0)
            if isinstance(step, Exception):
                raise step
            if isinstance(step, Frame):
                yield step
            else:
                self._closed.wait(step)
        if self._endless:
            self._closed.wait(20.0)

    def health(self) -> PartHealth:
        return PartHealth(self.name, State.OK, f"{len(self._steps)} steps left")

    def close(self) -> None:
        self._closed.set()


@dataclass
class Collector:
    """Keeps what it is sent, and when (monotonic seconds)."""

    name: str = "collector"
    inline: bool = True
    keeps_all: bool = False
    disturb: Callable[[int], None] | None = None
    samples: list[LiveSample] = field(default_factory=list)
    at_s: list[float] = field(default_factory=list)
    closed: bool = False

    def send(self, sample: LiveSample) -> None:
        if self.disturb is not None:
            self.disturb(len(self.samples))
        self.samples.append(sample)
        self.at_s.append(time.monotonic())

    def health(self) -> PartHealth:
        return PartHealth(self.name, State.OK, f"{len(self.samples)} samples")

    def close(self) -> None:
        self.closed = True


def broken_feed(message: str = "no such camera") -> ScriptedFeed:
    """A feed that can never work."""
    return ScriptedFeed([SourceError(message)])
