"""Reading recordings back, torn ones too."""

import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import pyarrow as pa

from aqualvs.errors import SourceError
from aqualvs.live.recorder.records import FOOTER_BYTES, HEAD_BYTES, MAGIC, Op

_CHUNK_HEAD = struct.Struct("<QQQI")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
MAX_RECORD_BYTES = 1 << 29
"""Size of a record, also when decompressed; more is garbage, or meant to fill the memory."""


@dataclass(frozen=True, slots=True)
class StoredMessage:
    """One message.

    Attributes
    ----------
    topic : str
    log_ns, publish_ns : int
    data : bytes
    """

    topic: str
    log_ns: int
    publish_ns: int
    data: bytes


@dataclass(slots=True)
class _Index:
    """What a file holds."""

    topics: dict[int, str] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    chunks: list[int] = field(default_factory=list)


class McapFile:
    """An MCAP file whose chunks can be read one after the other.

    A file without a sound summary, torn by a loss of power, is read from its beginning as far as it
    goes.

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    n_torn : int
        Chunks left out so far because their checksum was wrong.

    Raises
    ------
    SourceError
        If the file is missing or no MCAP file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.n_torn = 0
        with self._opened() as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise SourceError(f"{path}: no MCAP file; give a recording")
            self._index = _from_summary(file) or _from_scan(file)

    @property
    def topics(self) -> tuple[str, ...]:
        """Topics that the file knows, also those without messages."""
        return tuple(self._index.topics.values())

    def count(self, topic: str) -> int | None:
        """Return the number of messages of a topic; None where the file does not say."""
        counts = self._index.counts
        return next((counts.get(n) for n, name in self._index.topics.items() if name == topic), 0)

    def messages(self, topics: Collection[str]) -> Iterator[StoredMessage]:
        """Yield the messages of some topics in the order of the file.

        Raises
        ------
        SourceError
            If the file cannot be read any more.
        """
        wanted = {n: name for n, name in self._index.topics.items() if name in topics}
        with self._opened() as file:
            for at in self._index.chunks:
                raw = _chunk_at(file, at)
                if raw is None:
                    self.n_torn += 1
                else:
                    yield from _messages(raw, wanted)

    def _opened(self) -> BinaryIO:
        try:
            return self.path.open("rb")
        except FileNotFoundError:
            raise SourceError(f"{self.path}: no such file; check the path") from None
        except OSError as fault:
            raise SourceError(f"{self.path}: cannot be read ({fault.strerror})") from fault


def _from_summary(file: BinaryIO) -> _Index | None:
    """Return what the summary tells, None where there is none."""
    size = file.seek(0, 2)
    if size < FOOTER_BYTES:
        return None
    file.seek(size - FOOTER_BYTES)
    end = file.read(FOOTER_BYTES)
    if end[0] != Op.FOOTER or not end.endswith(MAGIC):
        return None
    (at,) = struct.unpack_from("<Q", end, HEAD_BYTES)
    if not 0 < at < size:
        return None
    found = _Index()
    for kind, content in _records(file, at):
        if kind == Op.FOOTER:
            return found
        _note(found, kind, content)
    return None


def _from_scan(file: BinaryIO) -> _Index:
    """Return what is found from the beginning on."""
    found, at = _Index(), len(MAGIC)
    while (first := _record_head(file, at)) is not None:
        kind, length = first
        if kind in (Op.DATA_END, Op.FOOTER):
            break
        if kind == Op.CHUNK:
            found.chunks.append(at)
        elif kind == Op.CHANNEL:
            _note(found, kind, file.read(length))
        at += HEAD_BYTES + length
    return found


def _note(found: _Index, kind: int, content: bytes) -> None:
    """Take in a record of the summary."""
    if kind == Op.CHANNEL:
        number, _, n_bytes = struct.unpack_from("<HHI", content)
        found.topics[number] = content[8 : 8 + n_bytes].decode("utf-8", "replace")
    elif kind == Op.CHUNK_INDEX:
        found.chunks.append(struct.unpack_from("<Q", content, 16)[0])
    elif kind == Op.STATISTICS:
        found.counts = dict(struct.iter_unpack("<HQ", content[46:]))


def _records(file: BinaryIO, at: int) -> Iterator[tuple[int, bytes]]:
    """Yield kind and content of the records from a place on; paddings without their content."""
    while (first := _record_head(file, at)) is not None:
        kind, length = first
        content = b"" if kind >= Op.PADDING else file.read(length)
        if kind < Op.PADDING and len(content) < length:
            return
        yield kind, content
        at += HEAD_BYTES + length


def _record_head(file: BinaryIO, at: int) -> tuple[int, int] | None:
    """Return kind and length of a record; None where there is none."""
    file.seek(at)
    head = file.read(HEAD_BYTES)
    if len(head) < HEAD_BYTES or head[0] == 0:
        return None
    kind, length = struct.unpack("<BQ", head)
    return None if length > MAX_RECORD_BYTES else (kind, length)


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

    Raises
    ------
    ValueError, OSError, ArrowException
        If it has another size than its head says, or is too large.
    """
    if not compression:
        return data
    if raw_size > MAX_RECORD_BYTES:
        raise ValueError(f"a chunk of {raw_size} bytes")
    found: bytes = pa.decompress(data, raw_size, codec=compression, asbytes=True)
    return found


def _messages(raw: bytes, topics: dict[int, str]) -> Iterator[StoredMessage]:
    at = 0
    while at + HEAD_BYTES <= len(raw):
        kind, length = struct.unpack_from("<BQ", raw, at)
        start, at = at + HEAD_BYTES, at + HEAD_BYTES + length
        if kind == Op.MESSAGE:
            number, _, log_ns, publish_ns = _MESSAGE_HEAD.unpack_from(raw, start)
            if number in topics:
                data = raw[start + _MESSAGE_HEAD.size : at]
                yield StoredMessage(topics[number], log_ns, publish_ns, data)
