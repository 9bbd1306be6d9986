"""A pool of processes that measure parts of a dive; results are yielded in the order of the dive.

`pool_job` decides whether and how processes can share a run; `WorkerPool` begins them and collects
their results; `serve` is the loop of each process.

Messages between the processes are blocks of measured frames, and the `Ended` of each part. The
points go into shared memory and the pipe only announces them: a pipe holds less than the points of
a few frames, so that both processes would be woken a dozen times for each block.
"""

import contextlib
import itertools
import math
import mmap
import os
import pickle
import signal
import sys
from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from enum import Enum, auto
from multiprocessing import reduction
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Self, TypeAlias, cast

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from aqualvs.closing import Closing
from aqualvs.optics.rig import Rig
from aqualvs.optics.shutter import Shutter
from aqualvs.results.run_request import FrameWindow
from aqualvs.scanner import Scanner, ScannerOptions
from aqualvs.scanning.scan import Frame, Scan, ScanPoints
from aqualvs.sources import FrameSource, ImageSource, VideoSource
from aqualvs.sources.fields import frames_in, frames_of, source_of_pictures
from aqualvs.sources.images import images_in
from aqualvs.sources.spans import Span, SpanMismatchError, SpanReader, image_spans, video_spans
from aqualvs.workers.frame_results import FrameProcessor, FrameResult, in_blocks
from aqualvs.workers.start_method import blocked_interrupts, context, ignored_interrupts


class Ended(Enum):
    """Message that a part has ended, and its outcome."""

    WHOLE = auto()
    MISMATCH = auto()
    """It does not hold what it should; what was sent before is sound."""


Message: TypeAlias = list[FrameResult] | Ended

_COLUMNS = {field.name: getattr(ScanPoints.none(), field.name) for field in fields(ScanPoints)}
_BYTES = [column.itemsize * math.prod(column.shape[1:]) for column in _COLUMNS.values()]


def pack(message: Message, memory: NDArray[np.uint8]) -> bytes:
    """Return a message as bytes, but for the points of frames, which are written to memory.

    Pictures stay behind. The points of all frames travel together: a dozen arrays for each frame,
    and objects put together one by one, would cost many times as much.
    """
    if isinstance(message, Ended):
        return pickle.dumps(message)
    points = [result.scan.points for result in message]
    stops = np.cumsum([len(one) for one in points]).tolist()
    for name, column in zip(_COLUMNS, _columns(memory, stops[-1]), strict=True):
        np.concatenate([getattr(one, name) for one in points], out=column, casting="no")
    scans = ((result.scan, result.bare) for result in message)
    heads = [(scan.index, scan.time_s, scan.posture, scan.n_water, bare) for scan, bare in scans]
    return pickle.dumps((heads, stops), pickle.HIGHEST_PROTOCOL)


def unpack(parcel: bytes, memory: NDArray[np.uint8]) -> Message:
    """Return the message of `pack`, which a process of this program has sent.

    The points stay in `memory`.
    """
    whole = pickle.loads(parcel)
    if isinstance(whole, Ended):
        return whole
    heads, stops = whole
    columns = list(_columns(memory, stops[-1]))
    found, first = [], 0
    for (index, time_s, posture, n_water, bare), stop in zip(heads, stops, strict=True):
        points = ScanPoints(*[column[first:stop] for column in columns])
        scan = Scan(index, time_s, posture, points, n_water)
        found.append(FrameResult(scan, bare))
        first = stop
    return found


def _columns(memory: NDArray[np.uint8], n_points: int) -> Iterator[NDArray[Any]]:
    """Yield views on the columns of points in memory."""
    for like, (first, stop) in zip(_COLUMNS.values(), _column_ranges(n_points), strict=True):
        yield memory[first:stop].view(like.dtype).reshape(n_points, *like.shape[1:])


def _column_ranges(n_points: int) -> list[tuple[int, int]]:
    """Return the range of bytes of each column."""
    ranges, first = [], 0
    # Size of a cache line: no two columns share one.
    aligned = 64
    for n_bytes in _BYTES:
        stop = first + n_points * n_bytes
        ranges.append((first, stop))
        first = -(-stop // aligned) * aligned
    return ranges


_N_SLOTS = 3
_SLOT_BYTES = 4 << 20
_TAKEN = -1
"""Sent instead of a part's number: the data of a slot have been read."""


class SharedMemory:
    """Memory that this process shares with a process that it starts.

    It lies in no folder: none has to have room for it, and nothing is left behind.

    `file`: descriptor of a file in memory; stays open until `seal`. Raises `OSError` if the memory
    is not available.
    """

    def __init__(self, file: int) -> None:
        self._file = file
        os.ftruncate(file, _N_SLOTS * _SLOT_BYTES)
        memory = mmap.mmap(file, _N_SLOTS * _SLOT_BYTES)
        # Shape (n_slots, n_bytes).
        self.slots = np.frombuffer(memory, np.uint8).reshape(_N_SLOTS, _SLOT_BYTES)

    @classmethod
    def new(cls) -> Self | None:
        """Return new memory; None where the system has none to share."""
        try:
            file = os.memfd_create("aqualvs")
        except (AttributeError, OSError):
            return None
        try:
            return cls(file)
        except OSError:
            os.close(file)
            return None

    def seal(self) -> None:
        """Close the descriptor: no further process can attach to the memory."""
        os.close(self._file)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pass the memory to a process that is being started."""
        return _attached, (reduction.DupFd(self._file),)


def _attached(file: Any) -> SharedMemory:
    memory = SharedMemory(file.detach())
    memory.seal()
    return memory


class Sender:
    """The sending end of the channel, in a process that measures.

    `memory`: without it all goes through the pipe. Raises `EOFError` or `OSError` from both
    methods, once the other end has gone.
    """

    def __init__(self, pipe: Connection, memory: SharedMemory | None) -> None:
        self._pipe, self._memory = pipe, memory
        self._next, self._n_free = 0, _N_SLOTS

    def next_part(self) -> int:
        """Wait for the number of a part."""
        while (number := int(self._pipe.recv())) == _TAKEN:
            self._n_free += 1
        return number

    def send(self, message: Message) -> None:
        """Send a message; waits while all slots are full."""
        n_bytes = 0
        if not isinstance(message, Ended):
            n_bytes = _column_ranges(sum(len(result.scan.points) for result in message))[-1][1]
        if self._memory is None or n_bytes == 0 or n_bytes > _SLOT_BYTES:
            own = np.empty(n_bytes, np.uint8)
            self._pipe.send((pack(message, own), own, n_bytes))
            return
        while self._n_free == 0:
            # A part is given only to a process without one, so this is always `_TAKEN`.
            self._pipe.recv()
            self._n_free += 1
        parcel = pack(message, self._memory.slots[self._next])
        self._pipe.send((parcel, self._next, n_bytes))
        self._next, self._n_free = (self._next + 1) % _N_SLOTS, self._n_free - 1


class Receiver:
    """The receiving end of the channel, in the process that writes; see `Sender`."""

    def __init__(self, pipe: Connection, memory: SharedMemory | None) -> None:
        self._pipe, self._memory = pipe, memory

    def assign(self, number: int) -> None:
        """Have a part measured, after the one before has ended."""
        self._pipe.send(number)

    def receive(self) -> Message:
        """Wait for a message."""
        parcel, place, n_bytes = self._pipe.recv()
        if self._memory is None or not isinstance(place, int):
            return unpack(parcel, place)
        points = self._memory.slots[place, :n_bytes].copy()
        self._pipe.send(_TAKEN)
        return unpack(parcel, points)


@dataclass(frozen=True, slots=True)
class SpanPart:
    """Wanted frames of a span."""

    span: Span
    # Frames `first` to `stop` - 1, which lie in the span; numbers of fields if the camera is
    # interlaced, while spans count pictures.
    first: int
    stop: int


@dataclass(frozen=True, slots=True, kw_only=True)
class PoolJob:
    """Work of a pool: the dive, its parts, and what measures it."""

    path: Path  # A video, or a folder of images.
    parts: tuple[SpanPart, ...]  # In the order of the dive.
    rig: Rig
    options: ScannerOptions
    fps: float  # Frame rate of images.


def serve(
    job: PoolJob, pipe: Connection, memory: SharedMemory | None, others: Sequence[Connection]
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
        processor = FrameProcessor(job.rig, Scanner(job.rig, job.options))
        with SpanReader(job.path, job.rig.size_px, job.fps) as pictures:
            while True:
                part = job.parts[sender.next_part()]
                frames = frames_of(pictures.frames(part.span), job.rig.shutter)
                for message in _messages(part, job.rig.shutter, frames, processor):
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
        for block in in_blocks(wanted, processor.block_length, SpanMismatchError):
            yield processor.measure(block)
    except SpanMismatchError:
        yield Ended.MISMATCH
    else:
        yield Ended.WHOLE


_MIN_FRAMES = 100
"""Least number of frames to share: fewer are measured before more processes are ready."""

_PART_FRAMES = 32
"""Least number of frames in a part, because the first frames of each cost more."""


def pool_job(
    source: FrameSource, window: FrameWindow, rig: Rig, options: ScannerOptions
) -> PoolJob | None:
    """Return the job of measuring a dive in parts; None if it cannot be cut, or is too short.

    Reads a video once without decoding it: 25 ms for 1000 frames of standard definition.

    `source`: of the dive; a video file or a folder of images can be shared.
    """
    pictures = source_of_pictures(source)
    last = sys.maxsize if window.stop is None else window.stop
    spans = [(span, *frames_in(span, rig.shutter)) for span in _spans(pictures)]
    found = (SpanPart(one, max(first, window.first), min(stop, last)) for one, first, stop in spans)
    parts = tuple(part for part in found if part.first < part.stop)
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


@dataclass(slots=True)
class _Worker:
    """A process, and the number of the part that it measures; -1 if none is left for it."""

    process: BaseProcess
    pipe: Connection
    receiver: Receiver
    number: int = -1


class WorkerPool(Closing):
    """Pool of processes that measure the parts of a dive; a context manager that ends them.

    `n_processes`: there are no more than parts.
    """

    def __init__(self, job: PoolJob, n_processes: int) -> None:
        self._job = job
        self.next_frame = job.parts[0].first  # The first frame of which nothing has come yet.
        self.is_done = False  # Whether all has come.
        self._n_given = 0
        self._workers: list[_Worker] = []
        self._found: defaultdict[int, deque[Message]] = defaultdict(deque)
        self._n_processes = min(n_processes, len(job.parts))

    def blocks(self) -> Iterator[list[FrameResult]]:
        """Yield the results, in the order of the dive.

        It ends early where a part differs from its description, or a process has died:
        `is_done` is False then, and the rest is to be measured by other means, from `next_frame`.
        """
        try:
            for number in range(len(self._job.parts)):
                for block in self._results_of(number):
                    yield block
                    self.next_frame += len(block)
        except (SpanMismatchError, EOFError, OSError):
            return
        self.is_done = self.next_frame == self._job.parts[-1].stop

    def _results_of(self, number: int) -> Iterator[list[FrameResult]]:
        found = self._found[number]
        while True:
            while not found:
                self._receive(number)
            message = found.popleft()
            if message is Ended.MISMATCH:
                raise SpanMismatchError
            if message is Ended.WHOLE:
                break
            yield message
        del self._found[number]

    def _receive(self, number: int) -> None:
        """Wait for a message about a part; receive others too unless too many are waiting."""
        # Blocks for each process that may wait for earlier parts; beyond it, only those are read.
        max_waiting = 100
        crowded = sum(map(len, self._found.values())) > max_waiting * len(self._workers)
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
                self._assign_next(worker)

    def _assign_next(self, worker: _Worker) -> None:
        """Give a process its next part, if there is one."""
        worker.number = self._n_given if self._n_given < len(self._job.parts) else -1
        if worker.number >= 0:
            self._n_given += 1
            worker.receiver.assign(worker.number)

    def __enter__(self) -> Self:
        """Start the processes."""
        for _ in range(self._n_processes):
            worker = self._start()
            self._workers.append(worker)
            self._assign_next(worker)
        return self

    def _start(self) -> _Worker:
        how, memory = context(), SharedMemory.new()
        mine, theirs = how.Pipe()
        is_copy = how.get_start_method() == "fork"
        # Copies of this process inherit these; a pipe is closed when no process has it open.
        mines = [*(worker.pipe for worker in self._workers), mine] if is_copy else []
        process = how.Process(target=serve, args=(self._job, theirs, memory, mines), daemon=True)
        with blocked_interrupts() if is_copy else ignored_interrupts():
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
        timeout_s = 2.0
        for worker in self._workers:
            worker.process.join(timeout_s)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()
            worker.process.close()
