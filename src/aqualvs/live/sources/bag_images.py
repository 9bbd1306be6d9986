"""Images from ROS bags: `.bag` of ROS 1, `.db3` and MCAP folders of ROS 2."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from aqualvs.errors import OptionError, SourceError
from aqualvs.live.sources.image_schemas import image_of_ros, kind_of_schema
from aqualvs.live.sources.message_source import Logged, MessageSource, Topic, choose_topic


def open_bag(path: Path, topic: str | None = None) -> MessageSource:
    """Open the images of a ROS bag.

    Parameters
    ----------
    path : Path
        A `.bag` file, a folder with `metadata.yaml`, or a `.db3` file within such a folder.
    topic : str or None
        Needed where several topics have images.

    Returns
    -------
    source : MessageSource

    Raises
    ------
    SourceError
        If the bag cannot be read or has no images.
    OptionError
        If the topic is missing or wrong, or a package is missing.
    """
    try:
        import rosbags.highlevel  # noqa: F401
    except ImportError:
        raise OptionError(
            f"{path}: ROS bags need a package; type pip install 'aqualvs[bags]'"
        ) from None
    folder = path.parent if path.suffix.lower() == ".db3" else path
    if folder != path and not (folder / "metadata.yaml").is_file():
        raise SourceError(
            f"{path}: its metadata.yaml is missing; make it with ros2 bag reindex, "
            "and give the folder"
        )
    chosen = choose_topic(str(path), _image_topics(folder), topic)

    def messages() -> Iterator[Logged]:
        return _messages(folder, chosen.name)

    return MessageSource(f"{path}#{chosen.name}", messages, chosen.n_messages)


def _image_topics(path: Path) -> list[Topic]:
    counts: dict[str, int] = {}
    with _opened(path) as reader:
        for connection in reader.connections:
            if kind_of_schema(connection.msgtype):
                counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
    return [Topic(name, n) for name, n in counts.items()]


def _messages(path: Path, topic: str) -> Iterator[Logged]:
    with _opened(path) as reader:
        wanted = [c for c in reader.connections if c.topic == topic]
        try:
            for connection, log_ns, content in reader.messages(connections=wanted):
                yield log_ns, _image(reader, content, connection.msgtype)
        except _faults() as fault:
            raise SourceError(f"{path}: the bag breaks off ({_words(fault)})") from fault


def _image(reader: Any, content: bytes, kind: str) -> Any:
    try:
        return image_of_ros(reader.deserialize(content, kind))
    except _faults():
        return None


def _opened(path: Path) -> Any:
    """Return the reader of a bag, not yet entered."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    # Bags of ROS 2 before Iron do not define their messages; those of images never changed.
    store = get_typestore(Stores.ROS2_HUMBLE)
    reader = None
    try:
        reader = AnyReader([path], default_typestore=store)
        reader.open()
        reader.close()
    except _faults() as fault:
        raise SourceError(
            f"{path}: no ROS bag, or damaged ({_words(fault)}); check it with ros2 bag info "
            "or rosbag reindex"
        ) from fault
    return reader


def _faults() -> tuple[type[Exception], ...]:
    """Return what `rosbags` raises on damaged files."""
    import sqlite3
    import struct

    from rosbags.highlevel import AnyReaderError
    from rosbags.rosbag1 import ReaderError as Reader1Error
    from rosbags.rosbag2 import ReaderError as Reader2Error

    return (
        AnyReaderError,
        Reader1Error,
        Reader2Error,
        sqlite3.Error,
        struct.error,
        OSError,
        ValueError,
        KeyError,
        IndexError,
        AssertionError,
    )


def _words(fault: Exception) -> str:
    return f"{type(fault).__name__}: {fault}".splitlines()[0][:120]
