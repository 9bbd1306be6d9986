"""A pool of processes that measure parts of a dive; results are yielded in the order of the dive.

`pool_job` decides whether and how processes can share a run; `WorkerPool` begins them and collects
their results; `serve` is the loop of each process.
"""

import contextlib
import itertools
import os
import signal
from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Self, cast

import av
import cv2

from aqualvs.closing import Closing
from aqualvs.optics.rig import Rig
from aqualvs.optics.shutter import Shutter
from aqualvs.results.run_request import FrameWindow
from aqualvs.scanner import Scanner, ScannerOptions
from aqualvs.scanning.scan import Frame
from aqualvs.sources import FrameSource, ImageSource, VideoSource
from aqualvs.sources.fields import frames_in, frames_of, source_of_pictures
from aqualvs.sources.images import images_in
from aqualvs.sources.spans import (
    Span,
    SpanKind,
    UnlikeProbeError,
    VideoParts,
    image_frames,
    image_spans,
    video_spans,
)
from aqualvs.workers.channel import Ended, Message, Receiver, Sender, SharedMemory
from aqualvs.workers.frame_results import FrameProcessor, FrameResult, in_blocks
from aqualvs.workers.start_method import context, deaf_to_interrupts, interrupts_blocked


@dataclass(frozen=True, slots=True)
class SpanPart:
    """Wanted frames of a span.

    Attributes
    ----------
    span : Span
    first, stop : int
        Frames `first` to `stop` - 1, which lie in the span; numbers of fields if the camera is
        interlaced, while spans count pictures.
    """

    span: Span
    first: int
    stop: int


@dataclass(frozen=True, slots=True, kw_only=True)
class PoolJob:
    """Work of a pool: the dive, its parts, and what measures it.

    Attributes
    ----------
    path : Path
        A video, or a folder of images.
    parts : tuple of SpanPart
        In the order of the dive.
    rig : Rig
    options : ScannerOptions
    fps : float
        Frame rate of images.
    """

    path: Path
    parts: tuple[SpanPart, ...]
    rig: Rig
    options: ScannerOptions
    fps: float


def serve(
    work: PoolJob,
    pipe: Connection,
    memory: SharedMemory | None,
    others: Sequence[Connection],
) -> None:
    """Measure the parts whose numbers come through a pipe, until its other end is closed.

    What is found goes back block by block, and an `Ended` after each part. `others` are pipes that
    this process has inherited and that are not its own.
    """
    for other in others:
        other.close()
    # A terminal sends Ctrl-C to all processes; the parent process decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    cv2.setNumThreads(1)
    sender = Sender(pipe, memory)
    try:
        processor = FrameProcessor(work.rig, Scanner(work.rig, work.options))
        with VideoParts(work.path, work.rig.size_px) as video:
            while True:
                part = work.parts[sender.next_part()]
                frames = frames_of(_pictures(work, part, video), work.rig.shutter)
                for message in _messages(part, work.rig.shutter, frames, processor):
                    sender.send(message)
    except (EOFError, ConnectionError):
        # The other end is closed; buffered data are discarded.
        os._exit(1)


def _messages(
    part: SpanPart, shutter: Shutter, frames: Iterator[Frame], processor: FrameProcessor
) -> Iterator[Message]:
    first, stop = frames_in(part.span, shutter)
    wanted = itertools.islice(
        frames,
        part.first - first,
        # To its end, where the reader compares the span with its description.
        None if part.stop == stop else part.stop - first,
    )
    try:
        for block in in_blocks(wanted, processor.block_length, UnlikeProbeError):
            yield processor.measure(block)
    except UnlikeProbeError:
        yield Ended.UNLIKE_PROBE
    else:
        yield Ended.WHOLE


def _pictures(work: PoolJob, part: SpanPart, video: VideoParts) -> Iterator[Frame]:
    if part.span.kind is SpanKind.VIDEO:
        return video.frames(part.span)
    return image_frames(work.path, part.span, work.fps)


_MIN_FRAMES = 100
"""Least number of frames to share: fewer are measured before more processes are ready."""

_PART_FRAMES = 32
"""Least number of frames in a part, because the first frames of each cost more."""


def pool_job(
    source: FrameSource,
    window: FrameWindow,
    rig: Rig,
    options: ScannerOptions,
) -> PoolJob | None:
    """Return how a dive can be shared, or None where it cannot, or is too short.

    Reads a video once without decoding it: 25 ms for 1000 frames of standard definition.

    Parameters
    ----------
    source : FrameSource
        Of the dive; a video file or a folder of images can be shared.
    window : FrameWindow
    rig : Rig
    options : ScannerOptions
    """
    pictures = source_of_pictures(source)
    spans = [(span, *frames_in(span, rig.shutter)) for span in _spans(pictures)]
    parts = tuple(
        SpanPart(span, max(first, window.first), _earlier(stop, window.stop))
        for span, first, stop in spans
        if max(first, window.first) < _earlier(stop, window.stop)
    )
    if len(parts) < 2 or parts[-1].stop - parts[0].first < _MIN_FRAMES:
        return None
    fps = pictures.fps or 1.0
    return PoolJob(path=Path(source.name), parts=parts, rig=rig, options=options, fps=fps)


def _spans(source: FrameSource) -> tuple[Span, ...]:
    path = Path(source.name)
    if isinstance(source, ImageSource) and path.is_dir():
        return image_spans([image.stat().st_size for image in images_in(path)], _PART_FRAMES)
    if isinstance(source, VideoSource) and path.is_file():
        try:
            return video_spans(path, _PART_FRAMES).spans
        except (av.error.FFmpegError, OSError):
            # The serial reader reports the fault.
            return ()
    return ()


def _earlier(stop: int, wanted: int | None) -> int:
    return stop if wanted is None else min(stop, wanted)


_MAX_WAITING = 100
"""Blocks for each process that may wait for earlier parts; beyond it, only those are read."""

_TIMEOUT_S = 2.0


@dataclass(slots=True)
class _Worker:
    """A process, and the number of the part that it works on; -1 if there is none left for it."""

    process: BaseProcess
    pipe: Connection
    receiver: Receiver
    number: int = -1


class WorkerPool(Closing):
    """Pool of processes that measure the parts of a dive; a context manager that ends them.

    Parameters
    ----------
    work : PoolJob
    n_processes : int
        There are no more than parts.

    Attributes
    ----------
    next_frame : int
        The first frame of which nothing has come yet.
    is_done : bool
        Whether all has come.
    """

    def __init__(self, work: PoolJob, n_processes: int) -> None:
        self._work = work
        self.next_frame = work.parts[0].first
        self.is_done = False
        self._n_given = 0
        self._workers: list[_Worker] = []
        self._found: defaultdict[int, deque[Message]] = defaultdict(deque)
        self._n_processes = min(n_processes, len(work.parts))

    def blocks(self) -> Iterator[list[FrameResult]]:
        """Yield the results, in the order of the dive.

        It ends early where a part differs from its description, or a process has died:
        `is_done` is False then, and the rest is to be measured by other means, from `next_frame`.
        """
        try:
            for number in range(len(self._work.parts)):
                for block in self._of_part(number):
                    yield block
                    self.next_frame += len(block)
        except (_UnlikeProbeError, EOFError, OSError):
            return
        self.is_done = self.next_frame == self._work.parts[-1].stop

    def _of_part(self, number: int) -> Iterator[list[FrameResult]]:
        found = self._found[number]
        while True:
            while not found:
                self._take_in(number)
            message = found.popleft()
            if message is Ended.UNLIKE_PROBE:
                raise _UnlikeProbeError
            if message is Ended.WHOLE:
                break
            yield message
        del self._found[number]

    def _take_in(self, number: int) -> None:
        """Wait for messages about a part, and take in others unless too many wait."""
        crowded = sum(map(len, self._found.values())) > _MAX_WAITING * len(self._workers)
        workers = {
            worker.pipe: worker
            for worker in self._workers
            if worker.number == number or (worker.number >= 0 and not crowded)
        }
        for pipe in wait(list(workers)):
            worker = workers[cast("Connection", pipe)]
            message = worker.receiver.receive()
            self._found[worker.number].append(message)
            if isinstance(message, Ended):
                self._give(worker)

    def _give(self, worker: _Worker) -> None:
        """Give a process its next part, if there is one."""
        worker.number = self._n_given if self._n_given < len(self._work.parts) else -1
        if worker.number >= 0:
            self._n_given += 1
            worker.receiver.give_part(worker.number)

    def __enter__(self) -> Self:
        """Start the processes."""
        for _ in range(self._n_processes):
            worker = self._start()
            self._workers.append(worker)
            self._give(worker)
        return self

    def _start(self) -> _Worker:
        how, memory = context(), SharedMemory.new()
        mine, theirs = how.Pipe()
        is_copy = how.get_start_method() == "fork"
        # Copies of this process inherit these; a pipe is closed when no process has it open.
        mines = [*(worker.pipe for worker in self._workers), mine] if is_copy else []
        process = how.Process(target=serve, args=(self._work, theirs, memory, mines), daemon=True)
        with interrupts_blocked() if is_copy else deaf_to_interrupts():
            process.start()
        theirs.close()
        if memory is not None:
            memory.seal()
        return _Worker(process, mine, Receiver(mine, memory))

    def close(self) -> None:
        """End the processes."""
        for worker in self._workers:
            with contextlib.suppress(OSError):
                worker.pipe.close()
            worker.process.terminate()
        for worker in self._workers:
            worker.process.join(_TIMEOUT_S)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()
            worker.process.close()


class _UnlikeProbeError(Exception):
    pass
