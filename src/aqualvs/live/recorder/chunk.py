"""Chunks: messages of about half a second, compressed together."""

import zlib
from collections import Counter
from dataclasses import dataclass
from functools import cache
from typing import Any

import pyarrow as pa

from aqualvs.live.recorder import records

_COMPRESSION = "zstd"
# The fastest level: higher ones gain 3 % on sub-pixel positions, for twice the time.
_LEVEL = 1


@dataclass(frozen=True, slots=True)
class Chunk:
    """A chunk ready for the file.

    Attributes
    ----------
    content : bytes
        The chunk's record and its message indexes.
    length : int
        Of the record alone.
    index_offsets : dict
        Where each channel's message index begins, from the chunk's start.
    times_ns : (int, int)
        Log times of the first and the last message.
    sizes : (int, int)
        Compressed and raw.
    counts : dict
        Messages by channel.
    """

    content: bytes
    length: int
    index_offsets: dict[int, int]
    times_ns: tuple[int, int]
    sizes: tuple[int, int]
    counts: dict[int, int]

    def index_at(self, at: int) -> bytes:
        """Return the record for the summary, with the chunk at a place in the file."""
        return records.chunk_index(
            self.times_ns,
            at,
            self.length,
            {number: at + offset for number, offset in self.index_offsets.items()},
            len(self.content) - self.length,
            _COMPRESSION,
            self.sizes,
        )


class ChunkBuilder:
    """Gathers messages; `seal` compresses them."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._entries: dict[int, list[tuple[int, int]]] = {}
        self.n_bytes = 0

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self._parts) // 2

    def add(self, channel: int, sequence: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Append a message; log times never fall."""
        parts = records.message(channel, sequence, log_ns, publish_ns, data)
        self._entries.setdefault(channel, []).append((log_ns, self.n_bytes))
        self._parts += parts
        self.n_bytes += len(parts[0]) + len(parts[1])

    def seal(self) -> Chunk:
        """Return the chunk of what was gathered: at least one message."""
        raw = b"".join(self._parts)
        packed = _codec().compress(raw, asbytes=True)
        times = [entries[end][0] for entries in self._entries.values() for end in (0, -1)]
        times_ns = (min(times), max(times))
        whole = records.chunk(*times_ns, len(raw), zlib.crc32(raw), _COMPRESSION, packed)
        indexes = [records.message_index(*item) for item in self._entries.items()]
        offsets, at = {}, len(whole)
        for number, index in zip(self._entries, indexes, strict=True):
            offsets[number] = at
            at += len(index)
        return Chunk(
            b"".join((whole, *indexes)),
            len(whole),
            offsets,
            times_ns,
            (len(packed), len(raw)),
            Counter({number: len(entries) for number, entries in self._entries.items()}),
        )


@cache
def _codec() -> Any:
    return pa.Codec(_COMPRESSION, compression_level=_LEVEL)
