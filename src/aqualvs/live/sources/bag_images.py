"""Images from ROS bags: `.bag` of ROS 1, `.db3` and MCAP folders of ROS 2."""

import contextlib
import errno
import functools
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from aqualvs.errors import OptionError, SourceError
from aqualvs.live.sources.image_messages import ImageMessage
from aqualvs.live.sources.image_schemas import image_of_ros, kind_of_schema
from aqualvs.live.sources.message_source import (
    MAX_BYTES,
    Logged,
    MessageSource,
    Topic,
    choose_topic,
)
from aqualvs.special_files import refuse_special

# Room that is left on the disk where bags are unpacked that are packed as whole files.
_FREE_BYTES = 1 << 30
_REMEDY = "check it with ros2 bag info or rosbag reindex"


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
    for one in folder.iterdir() if folder.is_dir() else ():
        refuse_special(one)
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
        # The package lets through whatever damage leads to, from AssertionError to ZstdError.
        except Exception as fault:
            raise SourceError(f"{path}: the bag breaks off ({_words(fault)})") from fault


def _image(reader: Any, content: bytes, kind: str) -> ImageMessage | None:
    try:
        return image_of_ros(reader.deserialize(content, kind))
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
    """Return what unpacks bytes that are whole and not too many."""

    def unpack(packed: bytes, _size: int = 0) -> bytes:
        one = unpacker()
        found = bytes(one.decompress(packed, MAX_BYTES))
        if not one.eof:
            raise ValueError(f"torn, or unpacked more than {MAX_BYTES >> 20} MB")
        return found

    return unpack


def _words(fault: Exception) -> str:
    return f"{type(fault).__name__}: {fault}".splitlines()[0][:120]
