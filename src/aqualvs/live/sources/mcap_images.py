"""Images from MCAP files: Foxglove's messages, and those of ROS 1 and ROS 2."""

import contextlib
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, BinaryIO, TypeAlias, cast

from aqualvs.errors import OptionError, SourceError
from aqualvs.live.recorder.reader import MAX_RECORD_BYTES, decompressed
from aqualvs.live.recorder.records import HEAD_BYTES
from aqualvs.live.sources.image_messages import ImageMessage
from aqualvs.live.sources.image_schemas import (
    image_of_json,
    image_of_protobuf,
    image_of_ros,
    kind_of_schema,
)
from aqualvs.live.sources.message_source import (
    MAX_BYTES,
    Logged,
    MessageSource,
    Topic,
    choose_topic,
)

_Reader: TypeAlias = Callable[[bytes], ImageMessage]

_INSTALL = "pip install 'aqualvs[bags]'"


def open_mcap(path: Path, topic: str | None = None) -> MessageSource:
    """Open the images of an MCAP file.

    Parameters
    ----------
    path : Path
    topic : str or None
        Needed where several topics have images.

    Returns
    -------
    source : MessageSource

    Raises
    ------
    SourceError
        If the file cannot be read or has no images.
    OptionError
        If the topic is missing or wrong, or a package is missing.
    """
    try:
        import mcap.reader  # noqa: F401
    except ImportError:
        raise OptionError(f"{path}: MCAP files need a package; type {_INSTALL}") from None
    chosen = choose_topic(str(path), _image_topics(path), topic)

    def messages() -> Iterator[Logged]:
        return _messages(path, chosen.name)

    return MessageSource(f"{path}#{chosen.name}", messages, chosen.n_messages)


def _image_topics(path: Path) -> list[Topic]:
    with _opened(path) as stream:
        summary = _summary(stream)
        if summary is None:
            return _listed(path, stream)
        counts = summary.statistics.channel_message_counts if summary.statistics else {}
        return [
            Topic(channel.topic, counts.get(channel.id))
            for channel in summary.channels.values()
            if channel.schema_id in summary.schemas
            and kind_of_schema(summary.schemas[channel.schema_id].name)
        ]


def _listed(path: Path, stream: "_Bounded") -> list[Topic]:
    """Find the topics of a file without index by reading it to its end, or as far as it goes."""
    found: dict[str, Topic] = {}
    try:
        for schema, channel, _ in _read(path, stream, None):
            if schema is not None and kind_of_schema(schema.name):
                found[channel.topic] = Topic(channel.topic, None)
    except SourceError:
        if not found:
            raise
    return list(found.values())


def _messages(path: Path, topic: str) -> Iterator[Logged]:
    readers: dict[int, _Reader] = {}
    with _opened(path) as stream:
        for schema, channel, message in _read(path, stream, topic):
            if schema is None:
                continue
            if schema.id not in readers:
                readers[schema.id] = _reader(path, schema, channel.message_encoding)
            try:
                yield message.log_time, readers[schema.id](message.data)
            except (ValueError, struct.error, IndexError, AssertionError):
                yield message.log_time, None


def _read(path: Path, stream: "_Bounded", topic: str | None) -> Iterator[tuple[Any, Any, Any]]:
    """Yield schemas, channels and messages; says in one line where the file breaks off."""
    summary = _summary(stream)
    try:
        if summary is not None and summary.chunk_indexes:
            yield from _by_index(stream, summary, topic)
        else:
            yield from _by_order(stream, topic)
    except _faults() as fault:
        raise SourceError(
            f"{path}: no MCAP file, damaged, or cut short ({type(fault).__name__}); "
            "what could be read was, copy it again for the rest"
        ) from fault


def _by_index(stream: "_Bounded", summary: Any, topic: str | None) -> Iterator[tuple[Any, ...]]:
    """Yield what the chunks of a topic hold, in the order of their times."""
    from mcap.data_stream import ReadDataStream
    from mcap.records import Chunk, Message

    wanted = {n for n, one in summary.channels.items() if topic is None or one.topic == topic}
    for index in sorted(summary.chunk_indexes, key=lambda one: int(one.message_start_time)):
        listed = index.message_index_offsets
        if listed and wanted.isdisjoint(listed):
            continue
        stream.seek(index.chunk_start_offset + HEAD_BYTES)
        records = _records_of(Chunk.read(ReadDataStream(cast("IO[bytes]", stream))))
        found = [one for one in records if isinstance(one, Message) and one.channel_id in wanted]
        for message in sorted(found, key=lambda one: int(one.log_time)):
            channel = summary.channels[message.channel_id]
            yield summary.schemas.get(channel.schema_id), channel, message


def _by_order(stream: "_Bounded", topic: str | None) -> Iterator[tuple[Any, Any, Any]]:
    """Yield what a file without index holds, from its beginning on."""
    from mcap.records import Channel, Chunk, Message, Schema
    from mcap.stream_reader import StreamReader

    schemas, channels = {}, {}
    stream.seek(0)
    for record in StreamReader(cast("IO[bytes]", stream), emit_chunks=True).records:
        for one in _records_of(record) if isinstance(record, Chunk) else [record]:
            if isinstance(one, Schema):
                schemas[one.id] = one
            elif isinstance(one, Channel):
                channels[one.id] = one
            elif isinstance(one, Message):
                channel = channels[one.channel_id]
                if topic is None or channel.topic == topic:
                    yield schemas.get(channel.schema_id), channel, one


def _records_of(chunk: Any) -> list[Any]:
    """Return the records in a chunk; the package would take any amount of memory for them."""
    from mcap.stream_reader import breakup_chunk

    # Of the smallest messages, records take ten times the room that their bytes take.
    if max(chunk.uncompressed_size, len(chunk.data)) > MAX_BYTES:
        raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes")
    raw = decompressed(chunk.compression, chunk.data, chunk.uncompressed_size)
    return list(breakup_chunk(replace(chunk, compression="", data=raw)))


def _summary(stream: "_Bounded") -> Any:
    """Return the summary of a file, None where it has none that can be read."""
    from mcap.reader import SeekingReader

    try:
        stream.seek(0)
        return SeekingReader(cast("IO[bytes]", stream)).get_summary()
    except _faults():
        return None


def _faults() -> tuple[type[Exception], ...]:
    """Return what a damaged file raises, here and in the package that reads it."""
    from mcap.exceptions import McapError
    from pyarrow import ArrowException

    return (McapError, ArrowException, struct.error, OSError, EOFError, ValueError, LookupError)


class _Bounded:
    """A file of which no more is read at once than a record may hold."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable

    def read(self, n: int = -1) -> bytes:
        """Return the next bytes.

        Raises
        ------
        ValueError
            If these are too many.
        """
        if not 0 <= n <= MAX_RECORD_BYTES:
            raise ValueError(f"a record of {n} bytes")
        return self._file.read(n)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[_Bounded]:
    try:
        file = path.open("rb")
    except OSError as fault:
        raise SourceError(f"{path}: cannot be read ({fault.strerror}); check the path") from fault
    with file:
        yield _Bounded(file)


def _reader(path: Path, schema: Any, encoding: str) -> _Reader:
    """Return what reads the messages of a schema."""
    if encoding == "protobuf":
        return image_of_protobuf(schema.name)
    if encoding == "json":
        return image_of_json
    if encoding in ("cdr", "ros1"):
        return _ros_reader(path, schema, encoding)
    raise SourceError(f"{path}: images in encoding {encoding!r}; known: protobuf, json, cdr, ros1")


def _ros_reader(path: Path, schema: Any, encoding: str) -> _Reader:
    try:
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    except ImportError:
        raise OptionError(f"{path}: ROS messages need a package; type {_INSTALL}") from None
    name = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/")
    text = schema.data.decode("utf-8", "replace")
    store = get_typestore(Stores.EMPTY)
    store.register(
        get_types_from_idl(text) if schema.encoding == "ros2idl" else get_types_from_msg(text, name)
    )
    decode = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    return lambda content: image_of_ros(decode(content, name))
