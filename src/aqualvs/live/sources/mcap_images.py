"""Images from MCAP files: Foxglove's messages, and those of ROS 1 and ROS 2."""

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any, TypeAlias

from aqualvs.errors import OptionError, SourceError
from aqualvs.live.sources.image_messages import ImageMessage
from aqualvs.live.sources.image_schemas import (
    image_of_json,
    image_of_protobuf,
    image_of_ros,
    kind_of_schema,
)
from aqualvs.live.sources.message_source import Logged, MessageSource, Topic, choose_topic

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
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    with path.open("rb") as stream:
        try:
            summary = make_reader(stream).get_summary()
        except (McapError, struct.error, OSError, ValueError):
            summary = None
        if summary is None:
            return _listed(path, stream)
        counts = summary.statistics.channel_message_counts if summary.statistics else {}
        return [
            Topic(channel.topic, counts.get(channel.id))
            for channel in summary.channels.values()
            if channel.schema_id in summary.schemas
            and kind_of_schema(summary.schemas[channel.schema_id].name)
        ]


def _listed(path: Path, stream: IO[bytes]) -> list[Topic]:
    """Find the topics of a file without index by reading it to its end, or as far as it goes."""
    found: dict[str, Topic] = {}
    stream.seek(0)
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
    with path.open("rb") as stream:
        for schema, channel, message in _read(path, stream, topic):
            if schema is None:
                continue
            if schema.id not in readers:
                readers[schema.id] = _reader(path, schema, channel.message_encoding)
            try:
                yield message.log_time, readers[schema.id](message.data)
            except (ValueError, struct.error, IndexError, AssertionError):
                yield message.log_time, None


def _read(path: Path, stream: IO[bytes], topic: str | None) -> Iterator[tuple[Any, Any, Any]]:
    """Yield schemas, channels and messages; says in one line where the file breaks off."""
    from mcap.exceptions import McapError
    from mcap.reader import NonSeekingReader, make_reader

    try:
        reader = make_reader(stream)
        try:
            has_index = reader.get_summary() is not None
        except (McapError, struct.error, OSError, ValueError):
            has_index = False
        if not has_index:
            stream.seek(0)
            reader = NonSeekingReader(stream)
        yield from reader.iter_messages(topic, log_time_order=has_index)
    except (McapError, struct.error, EOFError, ValueError) as fault:
        raise SourceError(
            f"{path}: no MCAP file, or cut short ({type(fault).__name__}); "
            "what could be read was, copy it again for the rest"
        ) from fault


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
