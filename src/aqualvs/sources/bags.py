"""Images from ROS bags and MCAP files.

Bags are `.bag` files of ROS 1, and `.db3` or MCAP folders of ROS 2, read by the package `rosbags`.
Lone MCAP files hold images as messages of Foxglove, ROS 1 or ROS 2, read by the package `mcap`.
Both give a `MessageSource` for one topic.
"""

import contextlib
import errno
import functools
import importlib
import itertools
import shutil
import struct
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any, BinaryIO, TypeAlias, cast

from aqualvs.errors import OptionError, SourceError
from aqualvs.sources.image_messages import (
    MAX_BYTES,
    ImageMessage,
    ImageTopic,
    Logged,
    MessageSource,
    choose_topic,
    holds_images,
    image_of_json,
    image_of_protobuf,
    image_of_ros,
)
from aqualvs.sources.mcap_file import HEAD_BYTES, MAX_RECORD_BYTES, Op, decompressed, record_places
from aqualvs.special_files import refuse_special

# Disk space to keep free where bags compressed as whole files are unpacked.
_FREE_BYTES = 1 << 30
# Records of a chunk. A chunk of some megabytes, as recorders make them, holds 100,000 empty ones.
_MAX_RECORDS = 1 << 20
_INSTALL = "pip install 'aqualvs[bags]'"
_Reader: TypeAlias = Callable[[bytes], ImageMessage]
_REMEDY = "check it with ros2 bag info or rosbag reindex"


def open_bag(path: Path, topic: str | None = None) -> MessageSource:
    """Open the images of a ROS bag.

    `path`: a `.bag` file, a folder with `metadata.yaml`, or a `.db3` file within such a folder.
    `topic`: needed where several topics have images. Raises `SourceError` if the bag cannot be read
    or has no images. Raises `OptionError` if the topic is missing or wrong, or a package is
    missing.
    """
    _require("rosbags.highlevel", path, "ROS bags")
    folder = path.parent if path.suffix.lower() == ".db3" else path
    if folder != path and not (folder / "metadata.yaml").is_file():
        raise SourceError(
            f"{path}: its metadata.yaml is missing; make it with ros2 bag reindex, "
            "and give the folder"
        )
    for one in folder.iterdir() if folder.is_dir() else ():
        refuse_special(one)
    return _source(path, topic, _image_topics(folder), functools.partial(_bag_messages, folder))


def _require(module: str, path: Path, what: str) -> None:
    """Refuse to read a file whose package is missing."""
    try:
        importlib.import_module(module)
    except ImportError:
        raise OptionError(f"{path}: {what} need a package; type {_INSTALL}") from None


def _source(
    path: Path,
    wanted: str | None,
    topics: list[ImageTopic],
    messages: Callable[[str], Iterator[Logged]],
) -> MessageSource:
    """Return the images of the topic wanted, or of the only one."""
    chosen = choose_topic(str(path), topics, wanted)
    read = functools.partial(messages, chosen.name)
    return MessageSource(f"{path}#{chosen.name}", read, chosen.n_messages)


def _image_topics(path: Path) -> list[ImageTopic]:
    counts: Counter[str] = Counter()
    with _opened(path) as reader:
        for connection in reader.connections:
            if holds_images(connection.msgtype):
                counts[connection.topic] += connection.msgcount
    return [ImageTopic(name, n) for name, n in counts.items()]


def _bag_messages(path: Path, topic: str) -> Iterator[Logged]:
    with _opened(path) as reader:
        wanted = [c for c in reader.connections if c.topic == topic]
        try:
            for connection, log_ns, content in reader.messages(connections=wanted):
                read = functools.partial(_ros_image, reader, connection.msgtype)
                yield log_ns, _image_or_none(read, content)
        # Damaged files raise anything in the package, from AssertionError to ZstdError.
        except Exception as fault:
            raise SourceError(f"{path}: the bag breaks off ({_words(fault)})") from fault


def _ros_image(reader: Any, kind: str, content: bytes) -> ImageMessage:
    return image_of_ros(reader.deserialize(content, kind))


def _image_or_none(read: _Reader, content: bytes) -> ImageMessage | None:
    """Return the image in a message; None for a damaged one, whatever the packages raise for it."""
    try:
        return read(content)
    except Exception:
        return None


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    _bound_unpacking()
    # Bags of ROS 2 before Iron do not define their messages; those of images never changed.
    store = get_typestore(Stores.ROS2_HUMBLE)
    try:
        reader = AnyReader([path], default_typestore=store)
        reader.open()
    except Exception as fault:
        raise SourceError(f"{path}: no ROS bag, or damaged ({_words(fault)}); {_REMEDY}") from fault
    with contextlib.closing(reader):
        # Metadata are passed on as they are.
        if not all(
            isinstance(c.topic, str) and isinstance(c.msgtype, str) and isinstance(c.msgcount, int)
            for c in reader.connections
        ):
            raise SourceError(f"{path}: damaged (no name, type or count of a topic); {_REMEDY}")
        yield reader


@functools.cache
def _bound_unpacking() -> None:
    """Have `rosbags` unpack no more at once than `MAX_BYTES`, and no more than the disk takes.

    It has no such option, and a megabyte of packed zeros would fill the memory. What is replaced
    is the package's own, for the whole process.
    """
    import bz2

    import lz4.frame
    import rosbags.rosbag1.reader as ros1
    import rosbags.rosbag2.reader as ros2
    import rosbags.rosbag2.storage_mcap as mcap

    zstd: Any = vars(ros2)["zstd"]

    class File(zstd.ZstdFile):  # type: ignore[misc]
        """A file that is packed as a whole; it is unpacked to the disk."""

        def read(self, size: int | None = -1) -> bytes:
            if shutil.disk_usage(tempfile.gettempdir()).free < _FREE_BYTES:
                raise OSError(errno.ENOSPC, "unpacked, it would fill the disk")
            return bytes(super().read(size))

    by_bz2 = _bounded(bz2.BZ2Decompressor)
    by_lz4 = _bounded(lz4.frame.LZ4FrameDecompressor)
    by_zstd = _bounded(zstd.ZstdDecompressor)
    ros1.decompressors.update(bz2=by_bz2, lz4=by_lz4)
    mcap.DECOMPRESSORS.update(lz4=by_lz4, zstd=by_zstd)
    vars(ros2)["zstd"] = SimpleNamespace(decompress=by_zstd, open=File)


def _bounded(unpacker: Callable[[], Any]) -> Callable[..., bytes]:
    """Return a decompressor that limits the size of its output."""

    def unpack(packed: bytes, _size: int = 0) -> bytes:
        one = unpacker()
        found = bytes(one.decompress(packed, MAX_BYTES))
        if not one.eof:
            raise ValueError(f"torn, or unpacked more than {MAX_BYTES >> 20} MB")
        return found

    return unpack


def _words(fault: Exception) -> str:
    return f"{type(fault).__name__}: {fault}".splitlines()[0][:120]


def open_mcap(path: Path, topic: str | None = None) -> MessageSource:
    """Open the images of an MCAP file.

    `topic`: needed where several topics have images. Raises `SourceError` if the file cannot be
    read or has no images. Raises `OptionError` if the topic is missing or wrong, or a package is
    missing.
    """
    _require("mcap.reader", path, "MCAP files")
    topics = _mcap_image_topics(path)
    if topic is None:
        _check_own_recording(path, topics)
    return _source(path, topic, topics, functools.partial(_mcap_messages, path))


# Topics of the recordings that `aqualvs.recording` writes. The second one is of PNG pictures, whose
# luma the first one has then; a recording of other pictures knows it, but has none there.
_OWN_PICTURE, _OWN_CHROMA = "/aqualvs/picture", "/aqualvs/picture/chroma"


def _check_own_recording(path: Path, topics: list[ImageTopic]) -> None:
    """Refuse a recording of aqualvs without pictures, or with luma and chroma apart."""
    counts = {topic.name: topic.n_messages for topic in topics}
    if not {_OWN_PICTURE, _OWN_CHROMA} <= counts.keys():
        return
    again = "aqualvs run measures its stripes again"
    if not any(n is None or n > 0 for n in counts.values()):
        raise SourceError(
            f"{path}: a recording of aqualvs without pictures; {again}, and aqualvs live "
            "--record-video keeps pictures"
        )
    if counts[_OWN_CHROMA] != 0:
        raise SourceError(
            f"{path}: a recording of aqualvs that is torn, or whose pictures are in two parts "
            f"(PNG); {again}, and {path}#{_OWN_PICTURE} is its pictures, of PNG without colour"
        )


def _mcap_image_topics(path: Path) -> list[ImageTopic]:
    with _opened_mcap(path) as stream:
        summary = _summary(stream)
        if summary is None:
            return _topics_by_reading(path, stream)
        counts = summary.statistics.channel_message_counts if summary.statistics else {}
        return [
            ImageTopic(channel.topic, counts.get(channel.id))
            for channel in summary.channels.values()
            if channel.schema_id in summary.schemas
            and holds_images(summary.schemas[channel.schema_id].name)
        ]


def _topics_by_reading(path: Path, stream: "_Bounded") -> list[ImageTopic]:
    """Find the topics of a file without index by reading it to its end, or as far as it goes."""
    found: dict[str, ImageTopic] = {}
    try:
        with _faults_in_one_line(path):
            for schema, channel, _ in _messages_in_order(stream, None, only_channels=True):
                if schema is not None and holds_images(schema.name):
                    found[channel.topic] = ImageTopic(channel.topic, None)
    except SourceError:
        if not found:
            raise
    return list(found.values())


def _mcap_messages(path: Path, topic: str) -> Iterator[Logged]:
    readers: dict[int, _Reader] = {}
    with _opened_mcap(path) as stream:
        for schema, channel, message in _read(path, stream, topic):
            if schema is None:
                continue
            if schema.id not in readers:
                readers[schema.id] = _reader(path, schema, channel.message_encoding)
            yield message.log_time, _image_or_none(readers[schema.id], message.data)


def _read(path: Path, stream: "_Bounded", topic: str) -> Iterator[tuple[Any, Any, Any]]:
    """Yield schemas, channels and messages of a topic."""
    summary = _summary(stream)
    with _faults_in_one_line(path):
        if summary is not None and summary.chunk_indexes:
            yield from _messages_by_index(stream, summary, topic)
        else:
            yield from _messages_in_order(stream, topic)


@contextlib.contextmanager
def _faults_in_one_line(path: Path) -> Iterator[None]:
    """Turn the faults of a damaged file into one line."""
    try:
        yield
    except _mcap_faults() as fault:
        raise SourceError(
            f"{path}: no MCAP file, damaged, or cut short ({type(fault).__name__}); "
            "what could be read was, copy it again for the rest"
        ) from fault


def _messages_by_index(stream: "_Bounded", summary: Any, topic: str) -> Iterator[tuple[Any, ...]]:
    """Yield the messages in the chunks of a topic, in the order of their times."""
    from mcap.data_stream import ReadDataStream
    from mcap.records import Chunk, Message

    wanted = {n for n, one in summary.channels.items() if one.topic == topic}
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


def _messages_in_order(
    stream: "_Bounded", topic: str | None, *, only_channels: bool = False
) -> Iterator[tuple[Any, Any, Any]]:
    """Yield the messages of a file without index, from its beginning on, or its channels only."""
    from mcap.records import Channel, Chunk, Message, Schema
    from mcap.stream_reader import StreamReader

    schemas, channels = {}, {}
    stream.seek(0)
    for record in StreamReader(cast("IO[bytes]", stream), emit_chunks=True).records:
        whole = isinstance(record, Chunk)
        for one in _records_of(record, messages=not only_channels) if whole else [record]:
            if isinstance(one, Schema):
                schemas[one.id] = one
            elif isinstance(one, Channel):
                channels[one.id] = one
                if only_channels:
                    yield schemas.get(one.schema_id), one, None
            elif isinstance(one, Message) and not only_channels:
                channel = channels[one.channel_id]
                if topic is None or channel.topic == topic:
                    yield schemas.get(channel.schema_id), channel, one


def _records_of(chunk: Any, *, messages: bool = True) -> list[Any]:
    """Return the records in a chunk, or those that are no messages.

    The package would take any amount of memory for them.
    """
    from mcap.stream_reader import breakup_chunk

    if max(chunk.uncompressed_size, len(chunk.data)) > MAX_BYTES:
        raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes")
    raw = decompressed(chunk.compression, chunk.data, chunk.uncompressed_size)
    places = list(itertools.islice(record_places(raw), _MAX_RECORDS + 1))
    # As objects, the smallest records take ten times the memory of their bytes.
    if len(places) > _MAX_RECORDS:
        raise ValueError(f"a chunk of more than {_MAX_RECORDS} records")
    if not messages:
        raw = b"".join(raw[a:b] for a, b in places if raw[a] != Op.MESSAGE)
    return list(breakup_chunk(replace(chunk, compression="", data=raw)))


def _summary(stream: "_Bounded") -> Any:
    """Return the summary of a file, None where it has none that can be read."""
    from mcap.reader import SeekingReader

    try:
        stream.seek(0)
        return SeekingReader(cast("IO[bytes]", stream)).get_summary()
    except _mcap_faults():
        return None


def _mcap_faults() -> tuple[type[Exception], ...]:
    """Return the exceptions that a damaged file causes, here and in the package that reads it."""
    from mcap.exceptions import McapError
    from pyarrow import ArrowException

    faults = (McapError, ArrowException, struct.error, OSError, EOFError, ValueError, LookupError)
    # Lengths that no file can hold.
    return (*faults, OverflowError)


class _Bounded:
    """A file of which no more is read at once than a record may hold."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable

    def read(self, n: int = -1) -> bytes:
        """Return the next bytes.

        Raises `ValueError` if these are too many.
        """
        if not 0 <= n <= MAX_RECORD_BYTES:
            raise ValueError(f"a record of {n} bytes")
        return self._file.read(n)


@contextlib.contextmanager
def _opened_mcap(path: Path) -> Iterator[_Bounded]:
    try:
        file = path.open("rb")
    except OSError as fault:
        raise SourceError(f"{path}: cannot be read ({fault.strerror}); check the path") from fault
    with file:
        yield _Bounded(file)


def _reader(path: Path, schema: Any, encoding: str) -> _Reader:
    """Return the function that decodes the messages of a schema."""
    if encoding == "protobuf":
        return image_of_protobuf(schema.name)
    if encoding == "json":
        return image_of_json
    if encoding in ("cdr", "ros1"):
        return _ros_reader(path, schema, encoding)
    raise SourceError(f"{path}: images in encoding {encoding!r}; known: protobuf, json, cdr, ros1")


def _ros_reader(path: Path, schema: Any, encoding: str) -> _Reader:
    _require("rosbags.typesys", path, "ROS messages")
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    name = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/")
    text = schema.data.decode("utf-8", "replace")
    store = get_typestore(Stores.EMPTY)
    store.register(
        get_types_from_idl(text) if schema.encoding == "ros2idl" else get_types_from_msg(text, name)
    )
    decode = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    return lambda content: image_of_ros(decode(content, name))
