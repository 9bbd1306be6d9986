"""The records of an MCAP file as bytes (format 0, https://mcap.dev/spec)."""

import struct
from collections.abc import Mapping, Sequence
from enum import IntEnum

MAGIC = b"\x89MCAP0\r\n"
HEAD_BYTES = 9
"""Of every record: its kind and the length of what follows."""


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
    """Return the first bytes of a record of no meaning that spans so many bytes, its head included.

    Raises
    ------
    ValueError
        If it cannot even hold its head.
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
    """Return what describes a kind of message, in ROS 2's language for messages."""
    content = definition.encode("utf-8")
    head_part = struct.pack("<H", number) + text(name) + text("ros2msg")
    return record(Op.SCHEMA, head_part, struct.pack("<I", len(content)), content)


def channel(number: int, schema_number: int, topic: str) -> bytes:
    """Return what says that messages of a schema come on a topic, in ROS 2's encoding."""
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

    Parameters
    ----------
    times_ns : (int, int)
        Of its first and last message.
    at, length : int
        Of the chunk's record in the file.
    index_offsets : mapping
        Where each channel's message index is in the file.
    index_length : int
        Of all these indexes together.
    compression : str
    sizes : (int, int)
        Compressed and raw.
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

    Parameters
    ----------
    n_schemas, n_chunks : int
    times_ns : (int, int)
        Of the first and the last message.
    counts : mapping
        Number of messages of every channel, also of those without.
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
