"""Files for tests of the recorder: their history step by step, and independent readers."""

import io
from collections import Counter
from pathlib import Path
from typing import IO

import numpy as np
from mcap.reader import NonSeekingReader, SeekingReader
from rosbags.rosbag2 import Reader

from aqualvs.recording.encoding import POSTURE, STRIPES
from aqualvs.recording.growing_file import Chunk, ChunkBuilder

STEP_NS = 1_000_000_000


class HistoryFile(io.RawIOBase):
    """A file in memory that remembers every step: ("write", place, bytes) or ("truncate", size)."""

    def __init__(self) -> None:
        self.steps: list[tuple[str, int, bytes]] = []
        self._at = 0

    def seek(self, offset: int, whence: int = 0) -> int:
        assert whence == 0
        self._at = offset
        return offset

    def write(self, content) -> int:
        self.steps.append(("write", self._at, bytes(content)))
        self._at += len(content)
        return len(content)

    def truncate(self, size: int | None = None) -> int:
        assert size is not None
        self.steps.append(("truncate", size, b""))
        return size

    def fileno(self) -> int:
        raise OSError("in memory")


def played(image: bytearray, step: tuple[str, int, bytes]) -> None:
    """Do a step to the bytes of a file."""
    kind, at, content = step
    if kind == "truncate":
        del image[at:]
        return
    if at > len(image):
        image.extend(bytes(at - len(image)))
    image[at : at + len(content)] = content


def chunk_of(n: int, *, n_messages: int = 3, n_bytes: int = 200) -> Chunk:
    """Chunk number `n`, with messages on two topics that tell who they are."""
    messages, noise = ChunkBuilder(), np.random.default_rng(n)
    for i in range(n_messages):
        log_ns = n * STEP_NS + i
        content = f"{n}.{i} ".encode() + noise.bytes(n_bytes)
        topic = POSTURE if i % 2 == 0 else STRIPES
        messages.add(topic.number, n, log_ns, log_ns + 7, content)
    return messages.seal()


def read_by_mcap(source: Path | bytes, *, linear: bool = False) -> list[tuple[str, int, bytes]]:
    """Messages as the `mcap` library reads them: by the summary, or from front to end.

    A file is read in that order, not as a whole first: one that grows meanwhile would have an end
    that is younger than its beginning.
    """
    if isinstance(source, Path):
        with source.open("rb") as file:
            return _messages_in(file, linear=linear)
    return _messages_in(io.BytesIO(source), linear=linear)


def _messages_in(file: IO[bytes], *, linear: bool) -> list[tuple[str, int, bytes]]:
    kind = NonSeekingReader if linear else SeekingReader
    reader = kind(file, validate_crcs=True)
    found = reader.iter_messages(log_time_order=False)
    return [(channel.topic, message.log_time, message.data) for _, channel, message in found]


def read_by_rosbags(path: Path) -> list[tuple[str, int, bytes]]:
    """Messages as the `rosbags` library reads them."""
    reader = Reader(path)
    reader.open()
    try:
        found = [(of.topic, at_ns, bytes(data)) for of, at_ns, data in reader.messages()]
        # A process that is killed after it has listed a chunk leaves the count before it.
        assert reader.message_count <= len(found)
    finally:
        reader.close()
    return found


def counted(messages: list[tuple[str, int, bytes]]) -> Counter[str]:
    """Messages by topic."""
    return Counter(topic for topic, _, _ in messages)
