"""A recording that is written in the caller's own time, as `aqualvs run` does it."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import BinaryIO

from aqualvs import __version__
from aqualvs.live.recorder import records, schemas
from aqualvs.live.recorder.chunk import ChunkBuilder
from aqualvs.live.recorder.growing_file import GrowingFile
from aqualvs.live.recorder.sample_encoder import RecordClock, RecorderOptions, SampleEncoder
from aqualvs.live.recorder.schemas import Topic
from aqualvs.live.sample import LiveSample

MAX_CHUNK_BYTES = 4 << 20


class SampleChunks:
    """Gathers the messages of samples in a chunk until it is due.

    Parameters
    ----------
    options : RecorderOptions

    Attributes
    ----------
    n_samples : int
        In the present chunk.
    """

    def __init__(self, options: RecorderOptions) -> None:
        self._encoder, self._clock = SampleEncoder(options), RecordClock()
        self._chunk_ns = round(1e9 * options.chunk_s)
        self._sequence = self._publish_ns = 0
        self._begin()

    def _begin(self) -> None:
        self._builder = ChunkBuilder()
        self._from_ns = 0
        self._holds_rig = False
        self.n_samples = 0

    def add(self, sample: LiveSample) -> bool:
        """Add a sample; returns whether the chunk is due."""
        stamp_ns = self._clock.stamp_ns(sample)
        self._from_ns = self._from_ns or stamp_ns
        self._publish_ns = max(sample.utc_ns, 0)
        self._add(self._encoder.messages(sample, stamp_ns), stamp_ns)
        self._sequence += 1
        self.n_samples += 1
        long = stamp_ns - self._from_ns >= self._chunk_ns
        return long or self._builder.n_bytes >= MAX_CHUNK_BYTES

    def finish(self) -> None:
        """Add the rig once more, unless the present chunk holds it already."""
        if not self._holds_rig:
            stamp_ns = self._clock.last_ns
            self._add(self._encoder.rig_again(stamp_ns), stamp_ns)

    def _add(self, messages: Iterable[tuple[Topic, bytes]], stamp_ns: int) -> None:
        for topic, data in messages:
            self._holds_rig = self._holds_rig or topic is schemas.RIG
            self._builder.add(topic.number, self._sequence, stamp_ns, self._publish_ns, data)

    def take(self) -> ChunkBuilder:
        """Return the messages so far, perhaps none, and begin anew."""
        found = self._builder
        self._begin()
        return found


class Recording:
    """Writes samples to a file that is readable at any time.

    Parameters
    ----------
    path : Path
        Must not exist.
    options : RecorderOptions

    Raises
    ------
    OSError
        From every method, as the system says it; what was written stays readable.
    """

    def __init__(self, path: Path, options: RecorderOptions) -> None:
        self._chunks = SampleChunks(options)
        self._file = recording_file(path)
        self._closed = False

    def write(self, sample: LiveSample) -> None:
        """Add a sample; it is in the file after `RecorderOptions.chunk_s` at the latest."""
        if self._chunks.add(sample):
            self._flush()

    def close(self) -> None:
        """Write what is left and close the file; further calls do nothing."""
        if self._closed:
            return
        self._closed = True
        self._chunks.finish()
        try:
            self._flush()
        except OSError:
            self._file.abandon()
            raise
        self._file.close()

    def _flush(self) -> None:
        messages = self._chunks.take()
        if len(messages):
            self._file.append(messages.seal())


def recording_file(path: Path, open_file: Callable[[Path], BinaryIO] | None = None) -> GrowingFile:
    """Begin a file with the topics of a recording.

    Raises
    ------
    OSError
        As `GrowingFile`.
    """
    repeated = b"".join(
        records.schema(topic.number, topic.kind, topic.definition)
        + records.channel(topic.number, topic.number, topic.name)
        for topic in schemas.TOPICS
    )
    return GrowingFile(
        path,
        # The profile tells rosbag2 and its kin that the messages are ROS 2's.
        front=records.MAGIC + records.header("ros2", f"aqualvs {__version__}") + repeated,
        repeated=repeated,
        n_schemas=len(schemas.TOPICS),
        channels=[topic.number for topic in schemas.TOPICS],
        open_file=open_file,
    )
