"""Recorders of dives: for `aqualvs run`, for a live run, and switchable during a live run.

`Recording` writes in the calling thread. `Recorder` is an output of a live run with its own thread,
which records every sample without blocking the run. `RecorderSwitch` starts and stops recorders
during the run.
"""

import errno
import itertools
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from aqualvs.errors import OutputError
from aqualvs.recording.encoding import RIG, STRIPES, RecordedTopic
from aqualvs.recording.growing_file import Chunk, ChunkBuilder, GrowingFile
from aqualvs.recording.messages import RecordClock, RecorderOptions, SampleEncoder
from aqualvs.recording.sample import LiveSample
from aqualvs.sources.base import PartHealth, State
from aqualvs.text import count_text

# Size of uncompressed messages at which a chunk is written before it is due.
MAX_CHUNK_BYTES = 4 << 20


class SampleChunks:
    """Chunk under construction, with the messages of samples until it is due."""

    def __init__(self, options: RecorderOptions) -> None:
        self._encoder, self._clock = SampleEncoder(options), RecordClock()
        self._chunk_ns = round(1e9 * options.chunk_s)
        self._sequence = self._publish_ns = 0
        self._has_frame = False
        self._begin()

    def _begin(self) -> None:
        self._builder = ChunkBuilder()
        self._from_ns = 0
        self._holds_rig = False
        self.n_samples = 0  # In the present chunk.

    def add(self, sample: LiveSample) -> bool:
        """Add a sample; return whether the chunk is due.

        A chunk is due at once with the first frame: that and the rig fit where a disk is nearly
        full.
        """
        stamp_ns = self._clock.stamp_ns(sample)
        self._from_ns = self._from_ns or stamp_ns
        self._publish_ns = max(sample.utc_ns, 0)
        had_frame = self._has_frame
        self._add(self._encoder.messages(sample, stamp_ns), stamp_ns)
        self._sequence += 1
        self.n_samples += 1
        long = stamp_ns - self._from_ns >= self._chunk_ns
        is_first_frame = self._has_frame and not had_frame
        return is_first_frame or long or self._builder.n_bytes >= MAX_CHUNK_BYTES

    def finish(self) -> None:
        """Add the rig again, unless the present chunk contains it already."""
        if not self._holds_rig:
            stamp_ns = self._clock.last_ns
            self._add(self._encoder.rig_again(stamp_ns), stamp_ns)

    def _add(self, messages: Iterable[tuple[RecordedTopic, bytes]], stamp_ns: int) -> None:
        for topic, data in messages:
            self._holds_rig = self._holds_rig or topic is RIG
            self._has_frame = self._has_frame or topic is STRIPES
            self._builder.add(topic.number, self._sequence, stamp_ns, self._publish_ns, data)

    def take(self) -> ChunkBuilder:
        """Return the messages so far, possibly none, and begin a new chunk."""
        found = self._builder
        self._begin()
        return found


class Recording:
    """Writer of samples to a file that is readable at any time.

    `path`: must not exist. All methods raise `OSError` if a write fails; the file stays readable.
    """

    def __init__(self, path: Path, options: RecorderOptions) -> None:
        self._chunks = SampleChunks(options)
        self._file = GrowingFile(path)
        self._closed = False

    def write(self, sample: LiveSample) -> None:
        """Add a sample; it is in the file after `RecorderOptions.chunk_s` at the latest."""
        if self._chunks.add(sample):
            self._flush()

    def close(self) -> None:
        """Write the remaining messages and close the file; further calls do nothing."""
        if self._closed:
            return
        self._closed = True
        self._chunks.finish()
        try:
            self._flush()
        except OSError:
            self._file.abandon()
            raise
        self._file.close()

    def _flush(self) -> None:
        messages = self._chunks.take()
        if len(messages):
            self._file.append(messages.seal())


_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
# Period of retries after a failed write, and of checks for a chunk that is due.
_RETRY_S, _CHECK_S = 2.0, 0.25
# Longest wait for the thread when a recorder is closed.
_TIMEOUT_S = 4.0


class Recorder:
    """Writer of samples in its own thread, to a file that is readable at any time.

    `path`: must not exist. `open_file`: as in `GrowingFile`; for tests. Raises `OutputError` if the
    file exists or cannot be created. `health` reports later faults: data that cannot be written
    wait in memory, up to the limit of the options, and are tried again.
    """

    name = "recorder"
    inline = False
    keeps_all = True

    def __init__(
        self,
        path: Path,
        options: RecorderOptions | None = None,
        open_file: Callable[[Path], BinaryIO] | None = None,
    ) -> None:
        self.path = path
        self._options = options or RecorderOptions()
        self._chunks = SampleChunks(self._options)
        try:
            self._file = GrowingFile(path, open_file)
        except FileExistsError:
            raise OutputError(f"{path}: exists; give the recording another name") from None
        except OSError as fault:
            raise OutputError(f"{path}: {_fault_text(fault)}; choose another place") from fault
        self._changed = threading.Condition()
        self._waiting: deque[tuple[ChunkBuilder, int]] = deque()
        self._waiting_bytes = 0
        self._n_dropped = 0
        self._fault = ""
        self._closing = False
        self._began_s = self._chunk_s = self._synced_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, name=self.name, daemon=True)
        self._thread.start()

    def send(self, sample: LiveSample) -> None:
        """Record a sample, without waiting for the disk."""
        with self._changed:
            if self._closing:
                return
            if self._chunks.add(sample):
                self._enqueue_chunk()

    def health(self) -> PartHealth:
        """Return size and duration of the recording, or the fault that stops it."""
        n_dropped = self._n_dropped
        size = f"{1e-6 * self._file.n_bytes:.1f} MB"
        lost = f", {count_text(n_dropped, 'sample')} lost" if n_dropped else ""
        if self._fault:
            # Until the recording ends, what waits in memory may still be written.
            waiting_mb = 1e-6 * self._waiting_bytes
            lost = f", {waiting_mb:.1f} MB waiting{lost}" if self._waiting_bytes else lost
            detail = f"{self.path.name}: {self._fault}; {size} kept{lost}"
            return PartHealth(self.name, State.FAULT, detail, n_dropped)
        if self._closing:
            state = State.WARN if n_dropped else State.OFF
            return PartHealth(self.name, state, f"{self.path.name}, {size}{lost}", n_dropped)
        seconds = time.monotonic() - self._began_s
        state = State.WARN if n_dropped else State.OK
        detail = f"{self.path.name}, {size} in {seconds:.0f} s{lost}"
        return PartHealth(self.name, state, detail, n_dropped)

    def close(self) -> None:
        """Write the remaining messages and close the file; further calls do nothing."""
        with self._changed:
            if not self._closing:
                self._chunks.finish()
                self._enqueue_chunk()
                self._closing = True
                self._changed.notify()
        self._thread.join(_TIMEOUT_S)

    def _enqueue_chunk(self) -> None:
        """Pass the present chunk to the thread, or drop it if too much waits already."""
        n_samples, messages = self._chunks.n_samples, self._chunks.take()
        self._chunk_s = time.monotonic()
        if not len(messages):
            return
        if self._waiting_bytes + messages.n_bytes > self._options.max_waiting_bytes:
            self._n_dropped += n_samples
            return
        self._waiting.append((messages, n_samples))
        self._waiting_bytes += messages.n_bytes
        self._changed.notify()

    def _run(self) -> None:
        """Write chunks until the recorder is closed; the body of the thread."""
        unwritten = ""
        while (messages := self._next_chunk()) is not None:
            written = self._write(messages.seal())
            with self._changed:
                _, n_samples = self._waiting.popleft()
                self._waiting_bytes -= messages.n_bytes
                if not written:
                    self._n_dropped += n_samples
                    unwritten = self._fault
        # A last small chunk may have found room.
        self._fault = self._fault or unwritten
        try:
            self._file.close()
        except OSError as fault:
            self._fault = _fault_text(fault)

    def _next_chunk(self) -> ChunkBuilder | None:
        """Return the oldest chunk, which stays in the queue; None at the end."""
        with self._changed:
            while not self._waiting:
                if self._closing:
                    return None
                self._changed.wait(_CHECK_S)
                if time.monotonic() - self._chunk_s > self._options.chunk_s + _CHECK_S:
                    self._enqueue_chunk()
            return self._waiting[0][0]

    def _write(self, chunk: Chunk) -> bool:
        """Write a chunk, with retries; return False if the recording ends before it succeeds."""
        while True:
            try:
                self._file.append(chunk)
            except OSError as fault:
                self._fault = _fault_text(fault)
            else:
                self._fault = ""
                self._sync_if_due()
                return True
            # A closing recorder tries no more.
            with self._changed:
                if self._changed.wait_for(lambda: self._closing, _RETRY_S):
                    return False

    def _sync_if_due(self) -> None:
        """Flush the file to the disk if the interval has passed."""
        every_s, now_s = self._options.sync_s, time.monotonic()
        if every_s is None or now_s - self._synced_s < every_s:
            return
        self._synced_s = now_s
        try:
            self._file.sync()
        except OSError as fault:
            self._fault = _fault_text(fault)


def _fault_text(fault: OSError) -> str:
    if fault.errno in _FULL:
        return "the disk is full"
    return f"cannot be written ({fault.strerror or fault})"


class RecorderSwitch:
    """Output whose recording can be switched on and off; each start creates a new file.

    `folder`: created when needed.
    """

    name = "recorder"
    inline = False
    keeps_all = True

    def __init__(self, folder: Path, options: RecorderOptions | None = None) -> None:
        self._folder, self._options = folder, options or RecorderOptions()
        self._lock = threading.Lock()
        self._recorder: Recorder | None = None
        self._last: PartHealth | None = None
        self._began_s = time.monotonic()

    @property
    def path(self) -> Path | None:
        """File that is being written; None if there is none."""
        recorder = self._recorder
        return None if recorder is None else recorder.path

    @property
    def seconds(self) -> float:
        """Time since the last recording was started."""
        return time.monotonic() - self._began_s

    def start(self) -> Path:
        """Start a recording, unless one is running; return its file, named by the time (UTC).

        Raises `OutputError` if the file cannot be created.
        """
        with self._lock:
            if self._recorder is None:
                self._recorder = Recorder(self._free_path(), self._options)
                self._began_s = time.monotonic()
            return self._recorder.path

    def stop(self) -> None:
        """Close the file; does nothing if there is no recording."""
        with self._lock:
            recorder, self._recorder = self._recorder, None
        if recorder is not None:
            recorder.close()
            self._last = recorder.health()

    def send(self, sample: LiveSample) -> None:
        """Record a sample, if recording is on."""
        recorder = self._recorder
        if recorder is not None:
            recorder.send(sample)

    def health(self) -> PartHealth:
        """Return the state of the recording; when off, that of the last one."""
        recorder = self._recorder
        if recorder is not None:
            return recorder.health()
        return self._last or PartHealth(self.name, State.OFF, "not recording")

    def close(self) -> None:
        """Stop; further calls do nothing."""
        self.stop()

    def _free_path(self) -> Path:
        """Return a path, named by the time, that does not exist yet."""
        stem = f"dive_{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as fault:
            raise OutputError(
                f"{self._folder}: cannot be made ({fault.strerror}); choose another folder"
            ) from fault
        names = itertools.chain([stem], (f"{stem}_{n}" for n in itertools.count(2)))
        paths = (self._folder / f"{name}.mcap" for name in names)
        return next(path for path in paths if not path.exists())
