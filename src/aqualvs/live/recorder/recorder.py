"""The recorder of a live run: an output that loses nothing and holds nobody up."""

import errno
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from aqualvs.errors import OutputError
from aqualvs.live.health import PartHealth, State
from aqualvs.live.recorder.chunk import Chunk, ChunkBuilder
from aqualvs.live.recorder.growing_file import GrowingFile
from aqualvs.live.recorder.recording import SampleChunks, recording_file
from aqualvs.live.recorder.sample_encoder import RecorderOptions
from aqualvs.live.sample import LiveSample

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
# How often a disk that refused is tried again, and a chunk without company is looked at.
_RETRY_S, _LOOK_S = 2.0, 0.25
_PATIENCE_S = 4.0


class Recorder:
    """Writes samples to a file that is readable at any time, by a thread of its own.

    Parameters
    ----------
    path : Path
        Must not exist.
    options : RecorderOptions, optional
        Defaults if left out.
    open_file : callable, optional
        As in `GrowingFile`; for tests.

    Attributes
    ----------
    name, inline, keeps_all
        As in `Output`.
    path : Path

    Raises
    ------
    OutputError
        If the file exists or cannot be begun. Later faults are told by `health`: what does not fit
        on the disk waits, as far as memory is granted, and is tried again.
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
        self._file = _begun(path, open_file)
        self._changed = threading.Condition()
        self._waiting: deque[tuple[ChunkBuilder, int]] = deque()
        self._waiting_bytes = 0
        self._n_samples = self._n_dropped = 0
        self._fault = ""
        self._closing = False
        self._began_s = self._chunk_s = self._synced_s = time.monotonic()
        self._thread = threading.Thread(target=self._work, name=self.name, daemon=True)
        self._thread.start()

    def send(self, sample: LiveSample) -> None:
        """Take a sample; returns without waiting for the disk."""
        with self._changed:
            if self._closing:
                return
            self._n_samples += 1
            if self._chunks.add(sample):
                self._hand_over()

    def health(self) -> PartHealth:
        """Return how much was recorded, or why no more is."""
        n_dropped = self._n_dropped
        size = f"{1e-6 * self._file.n_bytes:.1f} MB"
        if self._fault:
            return PartHealth(self.name, State.FAULT, f"{self._fault}; {size} kept", n_dropped)
        if self._closing:
            return PartHealth(self.name, State.OFF, f"{self.path.name}, {size}", n_dropped)
        seconds = time.monotonic() - self._began_s
        detail = f"{self.path.name}, {size} in {seconds:.0f} s"
        if n_dropped:
            return PartHealth(self.name, State.WARN, f"{detail}, {n_dropped} lost", n_dropped)
        return PartHealth(self.name, State.OK, detail)

    def close(self) -> None:
        """Write what is left and close the file; further calls do nothing."""
        with self._changed:
            if not self._closing:
                self._chunks.finish()
                self._hand_over()
                self._closing = True
                self._changed.notify()
        self._thread.join(_PATIENCE_S)

    def _hand_over(self) -> None:
        """Leave the present chunk to the thread, or drop it where too much waits already."""
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

    def _work(self) -> None:
        while (messages := self._next()) is not None:
            written = self._write(messages.seal())
            with self._changed:
                _, n_samples = self._waiting.popleft()
                self._waiting_bytes -= messages.n_bytes
                if not written:
                    self._n_dropped += n_samples
        self._end()

    def _next(self) -> ChunkBuilder | None:
        """Return the oldest chunk, which waits until it is written; None at the end."""
        with self._changed:
            while not self._waiting:
                if self._closing:
                    return None
                self._changed.wait(_LOOK_S)
                if time.monotonic() - self._chunk_s > self._options.chunk_s + _LOOK_S:
                    self._hand_over()
            return self._waiting[0][0]

    def _write(self, chunk: Chunk) -> bool:
        """Write a chunk, however often it takes; False if the recording ends before it worked."""
        while True:
            try:
                self._file.append(chunk)
            except OSError as fault:
                self._fault = _words(fault)
            else:
                self._fault = ""
                self._sync_if_due()
                return True
            if self._must_end():
                return False

    def _sync_if_due(self) -> None:
        every_s, now_s = self._options.sync_s, time.monotonic()
        if every_s is None or now_s - self._synced_s < every_s:
            return
        self._synced_s = now_s
        try:
            self._file.sync()
        except OSError as fault:
            self._fault = _words(fault)

    def _must_end(self) -> bool:
        """Wait before the disk is tried again; returns whether there is no time left for it."""
        with self._changed:
            return self._closing or self._changed.wait_for(lambda: self._closing, _RETRY_S)

    def _end(self) -> None:
        try:
            self._file.close()
        except OSError as fault:
            self._fault = _words(fault)


def _begun(path: Path, open_file: Callable[[Path], BinaryIO] | None) -> GrowingFile:
    try:
        return recording_file(path, open_file)
    except FileExistsError:
        raise OutputError(f"{path}: exists; give the recording another name") from None
    except OSError as fault:
        raise OutputError(f"{path}: {_words(fault)}; choose another place") from fault


def _words(fault: OSError) -> str:
    if fault.errno in _FULL:
        return "the disk is full"
    return f"cannot be written ({fault.strerror or fault})"
