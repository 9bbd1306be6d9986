"""Frames from the image messages of a recording."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeAlias, cast

import av
from av.video.codeccontext import VideoCodecContext

from aqualvs.closing import Closing
from aqualvs.errors import OptionError, SourceError
from aqualvs.scanning.scan import Frame, Planes
from aqualvs.sources.base import packet_with, planes_of
from aqualvs.sources.image_messages import ENCODINGS, ImageMessage, planes_of_message
from aqualvs.sources.live_frames import LiveDecoder

MAX_BYTES = 1 << 27
"""Size of a chunk or message when unpacked; an RGB picture of 40 megapixels takes 120 MB."""

_MAX_UNREADABLE = 20_000
"""Messages in a row without a picture after which a recording is given up: 13 minutes at 25 Hz."""

Logged: TypeAlias = tuple[int, ImageMessage | None]
"""Time of the log in nanoseconds, and the image; None for a message that cannot be read."""


@dataclass(frozen=True, slots=True)
class ImageTopic:
    """A topic with images.

    Attributes
    ----------
    name : str
    n_messages : int or None
        None where the recording does not state it.
    """

    name: str
    n_messages: int | None


def choose_topic(where: str, topics: list[ImageTopic], wanted: str | None) -> ImageTopic:
    """Return the topic wanted, or the only one.

    Parameters
    ----------
    where : str
        For messages.
    topics : list of ImageTopic
        With images.
    wanted : str or None

    Raises
    ------
    SourceError
        If there are no images at all.
    OptionError
        If several topics have images and none is named, or the one named has none.
    """
    listed = ", ".join(sorted(topic.name for topic in topics))
    if not topics:
        raise SourceError(f"{where}: holds no images; record a camera's topic too")
    if wanted is None and len(topics) > 1:
        raise OptionError(
            f"{where}: images on several topics ({listed}); "
            f"name one, as in {where}#{topics[0].name}"
        )
    for topic in topics:
        if wanted is None or topic.name.strip("/") == wanted.strip("/"):
            return topic
    raise OptionError(f"{where}: no images on topic {wanted}; there is {listed}")


class MessageSource(Closing):
    """Source of the images of one topic; satisfies `FrameSource`.

    Parameters
    ----------
    name : str
        Path and topic.
    messages : callable
        Begins to read, from the first message on; ends early where the recording is cut short,
        by raising `SourceError`.
    n_frames : int or None
        Messages that the recording promises.

    Raises
    ------
    SourceError
        If no picture can be decoded at the start, or its encoding is unknown.

    Notes
    -----
    Times are those of the pictures where the messages have them, else those of the log. Pictures of
    a video that are predicted from a lost one are not delivered (see `LiveDecoder`).
    """

    def __init__(
        self, name: str, messages: Callable[[], Iterator[Logged]], n_frames: int | None
    ) -> None:
        self.name = name
        self.n_frames = n_frames
        self._messages = messages
        self.size_px, self.fps = self._survey()

    def __iter__(self) -> Iterator[Frame]:
        """Yield the readable images; others leave a gap in the index.

        Raises
        ------
        SourceError
            When the size changes, and at the end if the recording is cut short or its last images
            cannot be decoded.
        """
        last = -1
        for frame in self._frames():
            height, width = frame.luma.shape
            if (width, height) != self.size_px:
                raise SourceError(
                    f"{self.name}: the picture size changes from {self.size_px[0]}x"
                    f"{self.size_px[1]} to {width}x{height} px at frame {frame.index}; "
                    "cut the recording there"
                )
            last = frame.index
            yield frame
        if self.n_frames is not None and last + 1 < self.n_frames:
            raise SourceError(
                f"{self.name}: the last {self.n_frames - last - 1} of {self.n_frames} images "
                "cannot be decoded; the recording is damaged"
            )

    def _survey(self) -> tuple[tuple[int, int], float | None]:
        """Return the size of the first picture, and the rate of the first ones."""
        size, times = None, []
        try:
            for frame in self._frames():
                size = size or (frame.luma.shape[1], frame.luma.shape[0])
                times.append((frame.index, frame.time_s))
                if len(times) == 10:
                    break
        except SourceError:
            # Messages before the damage count; the damage is reported when it is reached again.
            if size is None:
                raise
        if size is None:
            raise SourceError(f"{self.name}: no image can be decoded")
        (first, began), (last, ended) = times[0], times[-1]
        return size, (last - first) / (ended - began) if ended > began else None

    def _frames(self) -> Iterator[Frame]:
        decoder = _Decoder(self._planes)
        clock, shown = _Clock(), -1
        for index, (log_ns, message) in enumerate(self._messages()):
            if message is not None:
                clock.note(index, message.stamp_ns or log_ns)
                for at, planes in decoder.decode(index, message):
                    shown = index
                    yield Frame(at, clock.time(at), *planes)
            if index - shown > _MAX_UNREADABLE:
                raise SourceError(
                    f"{self.name}: {index - shown} messages in a row hold no image that can be "
                    "read; cut the recording before them, or record it again"
                )

    def _planes(self, message: ImageMessage) -> Planes | None:
        raw = message.size_px is not None
        if raw and message.encoding.lower() not in ENCODINGS:
            raise SourceError(
                f"{self.name}: images of encoding {message.encoding!r} cannot be read; "
                f"known are {', '.join(ENCODINGS)}"
            )
        return planes_of_message(message)


class _Clock:
    """Clock of a topic: times since the first image, which never fall."""

    def __init__(self) -> None:
        self._first_ns: int | None = None
        self._last = 0.0
        self._times: dict[int, float] = {}

    def note(self, index: int, time_ns: int) -> None:
        if self._first_ns is None:
            self._first_ns = time_ns
        self._last = max(self._last, 1e-9 * (time_ns - self._first_ns))
        self._times[index] = self._last
        self._times.pop(index - 64, None)

    def time(self, index: int) -> float:
        return self._times.get(index, self._last)


class _Decoder:
    """Decoder of pictures, and of the packets of a video, which are numbered by their messages."""

    def __init__(self, planes_of_picture: Callable[[ImageMessage], Planes | None]) -> None:
        self._planes_of_picture = planes_of_picture
        self._video: LiveDecoder | None = None

    def decode(self, index: int, message: ImageMessage) -> Iterator[tuple[int, Planes]]:
        if message.codec is None:
            planes = self._planes_of_picture(message)
            if planes is not None:
                yield index, planes
            return
        if self._video is None:
            context = cast("VideoCodecContext", av.CodecContext.create(message.codec, "r"))
            self._video = LiveDecoder(context, hears_losses=False)
        packet = packet_with(message.data)
        packet.pts = index
        for picture in self._video.decode(packet):
            yield index if picture.pts is None else picture.pts, planes_of(picture)
