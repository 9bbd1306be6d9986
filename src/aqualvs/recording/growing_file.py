"""An MCAP file that is valid after every single write, and the compressed chunks appended to it.

The format ends in a summary and a footer, so a file to which data are only appended cannot be read
until it has been closed. This file always has both. Its size is ahead of the data:

::

    header, schemas, chunks | padding ........ | data end, summary | padding ..... | footer
                            ^ frontier                             ^ tail

New data, except for the first nine bytes, are written into the padding, which readers skip, with
the head of the smaller padding after them. Then the nine bytes of the old padding's head are
replaced. They never cross a page boundary, and the system copies within a page at once: a reader,
or the end of the process, finds the record complete or not at all. Records of the summary are added
in the same way. When a padding is used up, the file is extended by a new footer alone, in one write
after a hole; that footer refers to a second copy of the summary, because a footer in the middle of
a summary is no valid file. Holes take no space on the disk.

After a loss of power, pages may have reached the disk in any order, so that data written since the
last `sync` may be torn; `McapFile` leaves out chunks with a wrong checksum.

A `Chunk` holds the messages of about half a second, compressed together.
"""

import contextlib
import errno
import os
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

import pyarrow as pa

from aqualvs import __version__
from aqualvs.recording.encoding import TOPICS
from aqualvs.sources import mcap_file
from aqualvs.sources.mcap_file import DATA_END_BYTES, FOOTER_BYTES, HEAD_BYTES

_COMPRESSION = "zstd"


@dataclass(frozen=True, slots=True)
class Chunk:
    """Chunk of compressed messages with its indexes."""

    content: bytes  # The chunk's record and its message indexes.
    length: int  # Of the record alone, in bytes.
    # By channel: offset of its message index from the chunk's start.
    index_offsets: dict[int, int]
    times_ns: tuple[int, int]  # Log times of the first and the last message.
    sizes: tuple[int, int]  # Compressed and uncompressed size, in bytes.
    counts: dict[int, int]  # By channel: number of messages.

    def index_at(self, at: int) -> bytes:
        """Return the index record for the summary, for the chunk at an offset in the file."""
        return mcap_file.chunk_index(
            self.times_ns,
            at,
            self.length,
            {number: at + offset for number, offset in self.index_offsets.items()},
            len(self.content) - self.length,
            _COMPRESSION,
            self.sizes,
        )


class ChunkBuilder:
    """Builder of a chunk: collects messages; `seal` compresses them."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._entries: dict[int, list[tuple[int, int]]] = {}
        self.n_bytes = 0

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self._parts) // 2

    def add(self, channel: int, sequence: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Append a message; log times must not decrease."""
        parts = mcap_file.message(channel, sequence, log_ns, publish_ns, data)
        self._entries.setdefault(channel, []).append((log_ns, self.n_bytes))
        self._parts += parts
        self.n_bytes += len(parts[0]) + len(parts[1])

    def seal(self) -> Chunk:
        """Return the chunk of the collected messages, of which there must be one at least."""
        raw = b"".join(self._parts)
        packed = _codec().compress(raw, asbytes=True)
        times = [entries[end][0] for entries in self._entries.values() for end in (0, -1)]
        times_ns = (min(times), max(times))
        whole = mcap_file.chunk(*times_ns, len(raw), zlib.crc32(raw), _COMPRESSION, packed)
        parts, offsets, counts, at = [whole], {}, {}, len(whole)
        for number, entries in self._entries.items():
            offsets[number], counts[number] = at, len(entries)
            parts.append(mcap_file.message_index(number, entries))
            at += len(parts[-1])
        sizes = len(packed), len(raw)
        return Chunk(b"".join(parts), len(whole), offsets, times_ns, sizes, counts)


@cache
def _codec() -> Any:
    # The fastest level: higher ones save 3 % of sub-pixel positions, for twice the time.
    level = 1
    return pa.Codec(_COMPRESSION, compression_level=level)


# Unit, in bytes, within which the system copies at once.
PAGE = 4096
# Least space for chunks, and for their index records, by which the file is extended.
_DATA_BYTES = 8 << 20
_INDEX_BYTES = 1 << 16
# Margin for rounding to pages.
_SPARE_BYTES = 3 * PAGE
# Least ratio of new data to the summary that is copied when the file is extended.
_DATA_PER_SUMMARY = 8


class GrowingFile:
    """Writer of one file with the topics of a recording, chunk by chunk.

    Every method raises `OSError` if the system refuses a write. The file is then as before the
    call, which may be repeated.

    `path`: the file appears there as soon as it is readable; `FileExistsError` if it exists.
    `open_file`: opens a path for unbuffered reading and writing; for tests.
    """

    def __init__(self, path: Path, open_file: Callable[[Path], BinaryIO] | None = None) -> None:
        # For the beginning of the file and for the summary.
        self._repeated = b"".join(
            mcap_file.schema(topic.number, topic.kind, topic.definition)
            + mcap_file.channel(topic.number, topic.number, topic.name)
            for topic in TOPICS
        )
        # The profile identifies the messages as those of ROS 2, for rosbag2 and similar tools.
        header = mcap_file.header("ros2", f"aqualvs {__version__}")
        self._counts = {topic.number: 0 for topic in TOPICS}
        self._n_chunks = 0
        self._times_ns = (0, 0)
        self._indexes: list[bytes] = []
        self._index_bytes = 0
        self._unlisted: list[bytes] = []
        self._frontier = self._limit = self._summary_at = self._tail = self._size = 0
        self._summary_placed = True
        draft = path.with_name(path.name + ".part")
        self._file = draft.open("w+b", buffering=0) if open_file is None else open_file(draft)
        try:
            self._begin(mcap_file.MAGIC + header + self._repeated)
            _publish(draft, path)
        except BaseException:
            self._file.close()
            draft.unlink(missing_ok=True)
            raise

    @property
    def n_bytes(self) -> int:
        """Size of the data so far, in bytes, without the summary."""
        return self._frontier

    def append(self, chunk: Chunk) -> None:
        """Write one chunk, which then survives the end of the process."""
        self._list_pending()
        index = chunk.index_at(self._frontier)
        self._make_room(len(chunk.content), len(index))
        self._frontier = self._insert(self._frontier, chunk.content, self._limit)
        self._count(chunk, index)
        # The chunk is in the file; the next call adds index records that fail now.
        with contextlib.suppress(OSError):
            self._list_pending()

    def sync(self) -> None:
        """Wait until all written data are on the disk."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Truncate the unused end of the file and close it; further calls do nothing.

        Even after an error the file is closed and readable.
        """
        if self._file.closed:
            return
        with self._file:
            self._list_pending()
            self._make_room(0, 0)
            at = self._frontier
            end = mcap_file.data_end() + self._summary() + mcap_file.footer(at + DATA_END_BYTES)
            self._write(at + HEAD_BYTES, end[HEAD_BYTES:])
            self._write(at, end[:HEAD_BYTES])
            self._file.truncate(at + len(end))
            self.sync()

    def abandon(self) -> None:
        """Close the file as it is, readable; further calls do nothing."""
        self._file.close()

    def _begin(self, front: bytes) -> None:
        """Write a file without messages."""
        self._frontier = len(front)
        fill = self._fill(self._frontier)
        self._frontier += len(fill)
        self._write(0, front + fill)
        self._size = self._size_for(self._frontier, 0)
        self._place_summary()

    def _insert(self, at: int, content: bytes, limit: int) -> int:
        """Replace the beginning of the padding at `at`, which ends at `limit`, by whole records.

        Returns the offset at which the padding begins now.
        """
        content += self._fill(at + len(content))
        end = at + len(content)
        self._write(at + HEAD_BYTES, content[HEAD_BYTES:] + mcap_file.padding_head(limit - end))
        self._write(at, content[:HEAD_BYTES])
        return end

    def _count(self, chunk: Chunk, index: bytes) -> None:
        """Add a written chunk to the statistics and to the index records to be written."""
        start_ns, end_ns = chunk.times_ns
        first_ns, last_ns = self._times_ns if self._n_chunks else chunk.times_ns
        self._times_ns = (min(first_ns, start_ns), max(last_ns, end_ns))
        self._n_chunks += 1
        for number, n in chunk.counts.items():
            self._counts[number] += n
        self._indexes.append(index)
        self._index_bytes += len(index)
        self._unlisted.append(index)

    def _list_pending(self) -> None:
        """Add missing index records to the summary."""
        while self._unlisted:
            limit = self._size - FOOTER_BYTES
            self._tail = self._insert(self._tail, self._unlisted[0], limit)
            del self._unlisted[0]
            self._write(self._summary_at, self._statistics())

    def _make_room(self, n_data: int, n_index: int) -> None:
        """Extend the file if a chunk or its index, and the end of the file after it, do not fit."""
        if not self._summary_placed:
            self._place_summary()
        data_end = self._frontier + n_data + self._summary_bytes() + _SPARE_BYTES
        index_end = self._tail + n_index + _SPARE_BYTES
        if data_end > self._limit or index_end > self._size - FOOTER_BYTES:
            self._grow(n_data)
            self._place_summary()

    def _grow(self, n_data: int) -> None:
        """Extend the file, with a copy of the summary at the end of the old space for data."""
        size = self._size_for(self._size, n_data)
        at = _page_down(self._limit - self._summary_bytes() - PAGE)
        tail = self._write_summary(at, size)
        self._write(size - FOOTER_BYTES, mcap_file.footer(at))
        self._summary_at, self._tail, self._size, self._summary_placed = at, tail, size, False

    def _size_for(self, size: int, n_data: int) -> int:
        """Return a file size with space for more data and their summary."""
        summary_bytes = self._summary_bytes()
        data_bytes = max(_DATA_BYTES, _DATA_PER_SUMMARY * summary_bytes) + n_data
        end = size + data_bytes + summary_bytes + self._summary_room() + 2 * _SPARE_BYTES
        return _page_down(end + PAGE - 1)

    def _place_summary(self) -> None:
        """Move the summary near the end of the file and free the space before it."""
        at = _page_down(self._size - FOOTER_BYTES - self._summary_room())
        limit = at - DATA_END_BYTES
        # Zeros instead of a hole: the disk space for additions to the summary is allocated now.
        tail = self._write_summary(at, self._size, zeros=_INDEX_BYTES // 2)
        self._write(self._frontier, mcap_file.padding_head(limit - self._frontier))
        self._write(self._size - FOOTER_BYTES, mcap_file.footer(at))
        self._summary_at, self._tail, self._limit, self._summary_placed = at, tail, limit, True

    def _write_summary(self, at: int, size: int, zeros: int = 0) -> int:
        """Write the end of the data and a summary, padded to the footer.

        Returns the offset of the padding.
        """
        summary = self._summary()
        summary += self._fill(at + len(summary))
        tail = at + len(summary)
        padding = mcap_file.padding_head(size - FOOTER_BYTES - tail)
        self._write(at - DATA_END_BYTES, mcap_file.data_end() + summary + padding + bytes(zeros))
        return tail

    def _summary(self) -> bytes:
        listed = self._indexes[: len(self._indexes) - len(self._unlisted)]
        return b"".join((self._statistics(), self._repeated, *listed))

    def _summary_bytes(self) -> int:
        return len(self._statistics()) + len(self._repeated) + self._index_bytes

    def _summary_room(self) -> int:
        """Return the space that is reserved for the summary."""
        return self._summary_bytes() * 5 // 4 + _INDEX_BYTES + 2 * _SPARE_BYTES

    def _statistics(self) -> bytes:
        return mcap_file.statistics(len(TOPICS), self._n_chunks, self._times_ns, self._counts)

    def _fill(self, at: int) -> bytes:
        """Return a padding record if a record's head at `at` would cross a page boundary."""
        left = PAGE - at % PAGE
        if left >= HEAD_BYTES:
            return b""
        return mcap_file.padding_head(left + HEAD_BYTES) + bytes(left)

    def _write(self, at: int, content: bytes) -> None:
        self._file.seek(at)
        rest = memoryview(content)
        while len(rest):
            # A full disk accepts a part; the next write raises the error.
            rest = rest[self._file.write(rest) :]


def _page_down(n: int) -> int:
    return n // PAGE * PAGE


def _publish(draft: Path, path: Path) -> None:
    """Rename a draft; raise `FileExistsError` instead of replacing a file."""
    try:
        os.link(draft, path)
    except FileExistsError:
        raise
    except OSError:
        # A file system without hard links, as on memory cards.
        if path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path)) from None
        os.rename(draft, path)
    else:
        draft.unlink()
