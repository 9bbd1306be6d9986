"""MCAP files: encoding of their records, and a reader that also reads truncated or damaged files.

Records are those of format 0 (https://mcap.dev/spec). `McapFile` reads; the functions above it
encode records for `aqualvs.recording`.
"""

import contextlib
import struct
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import BinaryIO, NamedTuple

import pyarrow as pa

from aqualvs.errors import SourceError

MAGIC = b"\x89MCAP0\r\n"
HEAD_BYTES = 9
"""Head of every record: its kind and the length of its content."""


class Op(IntEnum):
    """Kinds of records."""

    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    CHUNK_INDEX = 0x08
    STATISTICS = 0x0B
    DATA_END = 0x0F
    PADDING = 0x80
    """Of no meaning: the format leaves kinds from 0x80 on to applications, readers skip them."""


def record(kind: Op, *parts: bytes) -> bytes:
    """Return a whole record."""
    return b"".join((head(kind, sum(map(len, parts))), *parts))


def head(kind: Op, length: int) -> bytes:
    """Return the first nine bytes of a record whose content has a length."""
    return struct.pack("<BQ", kind, length)


def padding_head(span: int) -> bytes:
    """Return the head of a padding record that spans this many bytes, its head included.

    Raises `ValueError` if it cannot even hold its head.
    """
    if span < HEAD_BYTES:
        raise ValueError(f"a record cannot span {span} bytes")
    return head(Op.PADDING, span - HEAD_BYTES)


def text(words: str) -> bytes:
    """Return a string with its length before it."""
    content = words.encode("utf-8")
    return struct.pack("<I", len(content)) + content


def header(profile: str, library: str) -> bytes:
    """Return the first record of a file."""
    return record(Op.HEADER, text(profile), text(library))


def schema(number: int, name: str, definition: str) -> bytes:
    """Return the record of a message definition, in ROS 2's language for messages."""
    content = definition.encode("utf-8")
    head_part = struct.pack("<H", number) + text(name) + text("ros2msg")
    return record(Op.SCHEMA, head_part, struct.pack("<I", len(content)), content)


def channel(number: int, schema_number: int, topic: str) -> bytes:
    """Return the record of a topic and the schema of its messages, in ROS 2's encoding."""
    numbers = struct.pack("<HH", number, schema_number)
    return record(Op.CHANNEL, numbers, text(topic), text("cdr"), struct.pack("<I", 0))


def message(
    channel_number: int, sequence: int, log_ns: int, publish_ns: int, data: bytes
) -> tuple[bytes, bytes]:
    """Return a message in two parts, so that `data` need not be copied."""
    numbers = struct.pack("<HIQQ", channel_number, sequence & 0xFFFFFFFF, log_ns, publish_ns)
    return head(Op.MESSAGE, len(numbers) + len(data)) + numbers, data


def chunk(
    start_ns: int, end_ns: int, raw_size: int, crc: int, compression: str, data: bytes
) -> bytes:
    """Return a chunk of messages, `data`, compressed."""
    numbers = struct.pack("<QQQI", start_ns, end_ns, raw_size, crc)
    return record(Op.CHUNK, numbers, text(compression), struct.pack("<Q", len(data)), data)


def message_index(channel_number: int, entries: Sequence[tuple[int, int]]) -> bytes:
    """Return where a channel's messages are in a chunk: (log time, offset in the raw data)."""
    flat = [value for entry in entries for value in entry]
    numbers = struct.pack(f"<HI{len(flat)}Q", channel_number, 16 * len(entries), *flat)
    return record(Op.MESSAGE_INDEX, numbers)


def chunk_index(
    times_ns: tuple[int, int],
    at: int,
    length: int,
    index_offsets: Mapping[int, int],
    index_length: int,
    compression: str,
    sizes: tuple[int, int],
) -> bytes:
    """Return where a chunk is.

    `times_ns`: of its first and last message. `at`, `length`: of the chunk's record in the file.
    `index_offsets`: where each channel's message index is in the file, `index_length`: of all these
    together. `sizes`: compressed and raw.
    """
    offsets = b"".join(struct.pack("<HQ", *item) for item in index_offsets.items())
    return record(
        Op.CHUNK_INDEX,
        struct.pack("<QQQQI", *times_ns, at, length, len(offsets)),
        offsets,
        struct.pack("<Q", index_length),
        text(compression),
        struct.pack("<QQ", *sizes),
    )


def statistics(
    n_schemas: int, n_chunks: int, times_ns: tuple[int, int], counts: Mapping[int, int]
) -> bytes:
    """Return the counts of a file; of the same length for the same channels.

    `times_ns`: of the first and the last message. `counts`: messages of every channel, also of
    those without.
    """
    of_channel = b"".join(struct.pack("<HQ", *item) for item in counts.items())
    numbers = struct.pack(
        "<QHIIIIQQI",
        *(sum(counts.values()), n_schemas, len(counts), 0, 0, n_chunks),
        *times_ns,
        len(of_channel),
    )
    return record(Op.STATISTICS, numbers, of_channel)


def data_end() -> bytes:
    """Return the end of the data; no checksum, for that of a growing file never settles."""
    return record(Op.DATA_END, bytes(4))


def footer(summary_at: int) -> bytes:
    """Return the last record, which says where the summary is, and the file's last bytes."""
    return record(Op.FOOTER, struct.pack("<QQI", summary_at, 0, 0)) + MAGIC


FOOTER_BYTES = len(footer(0))
DATA_END_BYTES = len(data_end())


_CHUNK_HEAD = struct.Struct("<QQQI")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
MAX_RECORD_BYTES = 1 << 29
"""Greatest size of a record, also when decompressed; more is damage or an attack."""
# The records of a summary are far smaller than chunks.
_MAX_SUMMARY_BYTES = 1 << 24
_KNOWN = frozenset(Op)


class StoredMessage(NamedTuple):
    """One message."""

    topic: str
    log_ns: int
    data: bytes


@dataclass(slots=True)
class _Listing:
    """Contents of a file as stated by one of its ends."""

    channels: list[tuple[int, str]] = field(default_factory=list)  # Numbers and topics.
    # From a chunk's place in the file to the length of its record; None where not known.
    chunks: dict[int, int | None] = field(default_factory=dict)
    counts: dict[int, int] | None = None  # Messages by channel.
    n_chunks: int | None = None  # As the statistics have it.
    whole: bool = False  # Whether it was read to its end.


class McapFile:
    """An MCAP file whose chunks can be read one after the other.

    The summary at the end is checked against the chunks themselves. Where they differ,
    or the end is missing, as after a loss of power or with a bit that flipped on the disk, the file
    is read from its beginning as far as it goes, and further contents of the summary are added:
    damage in one place loses the chunk that it is in.

    Raises `SourceError` if the file is missing or no MCAP file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._torn: set[int] = set()
        with self._opened() as file:
            size = file.seek(0, 2)
            file.seek(0)
            begins = file.read(len(MAGIC)) == MAGIC
            file.seek(max(0, size - len(MAGIC)))
            if not begins and file.read() != MAGIC:
                raise SourceError(f"{path}: no MCAP file; give a recording")
            front, summary = _front(file, size, only_channels=True), _summary(file, size)
            sound = _is_sound(file, summary)
            if not sound:
                front = _front(file, size, only_channels=False)
        # Where the ends give a channel two names both count: a damaged name matches no request.
        self._names = [
            *dict.fromkeys(pair for one in (front, summary) for pair in _consistent(one.channels))
        ]
        self._counts = summary.counts if sound else None
        # A file that was read to its end needs no summary, which may itself be damaged.
        listed = summary.chunks if sound else front.chunks
        if not (sound or front.whole):
            listed = front.chunks | summary.chunks
        self._chunks = sorted(listed)

    @property
    def n_torn(self) -> int:
        """Return how many damaged chunks were left out so far."""
        return len(self._torn)

    @property
    def topics(self) -> tuple[str, ...]:
        """Topics that the file knows, also those without messages."""
        return tuple(dict.fromkeys(name for _, name in self._names))

    def count(self, topic: str) -> int | None:
        """Return the number of messages of a topic; None where the file does not say."""
        if self._counts is None:
            return None
        return sum(n for number, n in self._counts.items() if (number, topic) in self._names)

    def messages(self, topics: Collection[str]) -> Iterator[StoredMessage]:
        """Yield the messages of some topics in the order of the file.

        Raises `SourceError` if the file cannot be read any more.
        """
        wanted = {number: name for number, name in self._names if name in topics}
        with self._opened() as file:
            for at in self._chunks:
                raw = _chunk_at(file, at)
                if raw is None:
                    self._torn.add(at)
                else:
                    yield from _messages(raw, wanted)

    def _opened(self) -> BinaryIO:
        try:
            return self.path.open("rb")
        except FileNotFoundError:
            raise SourceError(f"{self.path}: no such file; check the path") from None
        except OSError as fault:
            raise SourceError(f"{self.path}: cannot be read ({fault.strerror})") from fault


def _summary(file: BinaryIO, size: int) -> _Listing:
    """Return the contents of the summary; empty if it cannot be read to its end."""
    file.seek(max(0, size - FOOTER_BYTES))
    end = file.read(FOOTER_BYTES)
    if len(end) < FOOTER_BYTES or end[0] != Op.FOOTER:
        return _Listing()
    (at,) = struct.unpack_from("<Q", end, HEAD_BYTES)
    if not 0 < at < size:
        return _Listing()
    found = _Listing()
    try:
        for kind, content in _records(file, at):
            if kind == Op.FOOTER:
                found.whole = True
                return found
            _note(found, kind, content)
    except (struct.error, ValueError):
        pass
    return found


def _front(file: BinaryIO, size: int, *, only_channels: bool) -> _Listing:
    """Return the contents found from the beginning on, or before the first chunk."""
    found, at = _Listing(), len(MAGIC)
    while (first := _record_head(file, at)) is not None:
        kind, length = first
        if kind == Op.CHUNK:
            if only_channels:
                break
            found.chunks[at] = length
        elif kind == Op.CHANNEL and length <= _MAX_SUMMARY_BYTES:
            with contextlib.suppress(struct.error, ValueError):
                _note(found, kind, file.read(length))
        elif kind == Op.DATA_END and length == DATA_END_BYTES - HEAD_BYTES:
            found.whole = True
            break
        at += HEAD_BYTES + length
        if at > size:
            # A record that seems to reach beyond the end is damaged; a chunk is cut off.
            break
    return found


def _is_sound(file: BinaryIO, summary: _Listing) -> bool:
    """Return whether a summary is whole and agrees with itself and with the chunks."""
    if not summary.whole or summary.n_chunks != len(summary.chunks) or not summary.chunks:
        return False
    if summary.channels != _consistent(summary.channels) or summary.counts is None:
        return False
    return all(
        _record_head(file, at) == (Op.CHUNK, length) for at, length in summary.chunks.items()
    )


def _consistent(channels: list[tuple[int, str]]) -> list[tuple[int, str]]:
    """Return the channels of one end of a file; none if it gives a number twice."""
    return channels if len(dict(channels)) == len(channels) else []


def _note(found: _Listing, kind: int, content: bytes) -> None:
    """Add a record to the contents.

    Raises `struct.error` or `ValueError` if it is none.
    """
    if kind == Op.CHANNEL:
        number, _, n_bytes = struct.unpack_from("<HHI", content)
        found.channels.append((number, content[8 : 8 + n_bytes].decode("utf-8", "replace")))
    elif kind == Op.CHUNK_INDEX:
        at, length = struct.unpack_from("<QQ", content, 16)
        found.chunks[at] = length - HEAD_BYTES
    elif kind == Op.STATISTICS:
        n_messages, _, _, _, _, n_chunks = struct.unpack_from("<QHIIII", content)
        counts = dict(struct.iter_unpack("<HQ", content[46:]))
        found.n_chunks = n_chunks
        found.counts = counts if sum(counts.values()) == n_messages else None


def _records(file: BinaryIO, at: int) -> Iterator[tuple[int, bytes]]:
    """Yield kind and content of the records from a place on; paddings without their content."""
    while (first := _record_head(file, at)) is not None:
        kind, length = first
        content = b""
        if kind < Op.PADDING:
            content = file.read(min(length, _MAX_SUMMARY_BYTES))
            if len(content) < length:
                return
        yield kind, content
        at += HEAD_BYTES + length


def _record_head(file: BinaryIO, at: int) -> tuple[int, int] | None:
    """Return kind and length of a record; None where there is none."""
    try:
        file.seek(at)
    except (OSError, OverflowError):
        # A skipped record's damaged length leads beyond what a file can hold.
        return None
    head = file.read(HEAD_BYTES)
    if len(head) < HEAD_BYTES or head[0] == 0:
        return None
    kind, length = struct.unpack("<BQ", head)
    # Paddings run ahead of the data, attachments are skipped.
    skipped = kind >= Op.PADDING or kind not in _KNOWN
    return None if length > MAX_RECORD_BYTES and not skipped else (kind, length)


def _chunk_at(file: BinaryIO, at: int) -> bytes | None:
    """Return the raw content of a chunk, None where it is torn."""
    first = _record_head(file, at)
    if first is None or first[0] != Op.CHUNK:
        return None
    content = file.read(first[1])
    try:
        _, _, raw_size, crc = _CHUNK_HEAD.unpack_from(content)
        (n_name,) = struct.unpack_from("<I", content, _CHUNK_HEAD.size)
        name_at = _CHUNK_HEAD.size + 4
        compression = content[name_at : name_at + n_name].decode("ascii")
        data = content[name_at + n_name + 8 :]
        raw = decompressed(compression, data, raw_size)
    except (struct.error, ValueError, OSError, pa.ArrowException):
        return None
    return raw if crc in (0, zlib.crc32(raw)) else None


def decompressed(compression: str, data: bytes, raw_size: int) -> bytes:
    """Return the raw content of a chunk.

    Raises `ValueError`, `OSError` or `ArrowException` if it has another size than its head says, or
    is too large.
    """
    if not compression:
        return data
    if raw_size > MAX_RECORD_BYTES:
        raise ValueError(f"a chunk of {raw_size} bytes")
    found: bytes = pa.decompress(data, raw_size, codec=compression, asbytes=True)
    return found


def _messages(raw: bytes, topics: dict[int, str]) -> Iterator[StoredMessage]:
    for first, stop in record_places(raw):
        if raw[first] == Op.MESSAGE:
            start = first + HEAD_BYTES
            number, _, log_ns, _ = _MESSAGE_HEAD.unpack_from(raw, start)
            if number in topics:
                data = raw[start + _MESSAGE_HEAD.size : stop]
                yield StoredMessage(topics[number], log_ns, data)


def record_places(raw: bytes) -> Iterator[tuple[int, int]]:
    """Yield where each record of a chunk's raw content begins and ends."""
    at = 0
    while at + HEAD_BYTES <= len(raw):
        end = at + HEAD_BYTES + int.from_bytes(raw[at + 1 : at + HEAD_BYTES], "little")
        yield at, end
        at = end
