"""The frames of a part of a dive, read by themselves."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import av
from av.container import InputContainer
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from aqualvs.closing import Closing
from aqualvs.errors import SourceError
from aqualvs.live.sources.images import ImageSource, images_in
from aqualvs.live.sources.planes import planes_of
from aqualvs.live.sources.spans import Span, joint_checksum, packet_checksum
from aqualvs.scanning.scan import Frame

_PATIENCE_S = 10.0
_SEEK_BEFORE_S = (0, 2, 20, 1_000_000)


class UnlikeSurveyError(Exception):
    """A part of a dive does not hold what it should; the dive must be measured in one piece."""


class VideoParts(Closing):
    """Reads parts of a video, opened once for all of them; a context manager.

    Parameters
    ----------
    path : Path
    size_px : (int, int)
        Width and height of every picture.
    """

    def __init__(self, path: Path, size_px: tuple[int, int]) -> None:
        self._path, self._size_px = path, size_px
        self._container: InputContainer | None = None

    def frames(self, span: Span) -> Iterator[Frame]:
        """Decode a part; frames have the index and the time that the whole video gives them.

        Parameters
        ----------
        span : Span
            From `video_spans` of the same file.

        Raises
        ------
        UnlikeSurveyError
            If any picture is damaged or missing: only the whole video tells what becomes of those
            that follow.
        """
        index, latest = span.first, span.origin_pts - 1
        try:
            stream = self._stream(span)
            for picture in _pictures(stream, span):
                if picture.is_corrupt or picture.pts is None or picture.pts <= latest:
                    raise UnlikeSurveyError(f"picture {index} is damaged")
                if (picture.width, picture.height) != self._size_px:
                    raise UnlikeSurveyError(f"picture {index} has another size")
                latest = picture.pts
                ticks = picture.pts - span.origin_pts
                luma, chroma = planes_of(picture)
                yield Frame(index, float(ticks * (stream.time_base or 0)), luma, chroma)
                index += 1
        except (av.error.FFmpegError, OSError) as fault:
            raise UnlikeSurveyError(
                f"picture {index} or a later one is damaged ({fault})"
            ) from fault
        if index != span.stop:
            raise UnlikeSurveyError(f"{index - span.first} pictures of {span.stop - span.first}")

    def close(self) -> None:
        """Close the file; frames already delivered stay valid."""
        if self._container is not None:
            self._container.close()
            self._container = None

    def _stream(self, span: Span) -> VideoStream:
        if not span.first:
            # Some containers cannot be wound back.
            self.close()
        if self._container is None:
            self._container = av.open(str(self._path), timeout=_PATIENCE_S)
            _prepare(self._container.streams.video[0])
        return self._container.streams.video[0]


def image_frames(folder: Path, span: Span, fps: float) -> Iterator[Frame]:
    """Read a part of a folder of images, as `ImageSource` reads all of it.

    Raises
    ------
    UnlikeSurveyError
        If an image cannot be read, or there are others than there were.
    """
    try:
        source = ImageSource(images_in(folder)[span.first : span.stop], fps=fps)
        index = span.first
        for frame in source:
            if frame.index + span.first != index:
                raise UnlikeSurveyError(f"image {index} cannot be read")
            yield Frame(index, index / fps, frame.luma, frame.chroma)
            index += 1
    except SourceError as fault:
        raise UnlikeSurveyError(str(fault)) from fault
    if index != span.stop:
        raise UnlikeSurveyError(f"{index - span.first} images of {span.stop - span.first}")


def _prepare(stream: VideoStream) -> None:
    """Decode on one thread, and stop at any damage instead of patching it up."""
    context = stream.codec_context
    context.thread_count = 1
    context.options = {"err_detect": "explode"}


def _pictures(stream: VideoStream, span: Span) -> Iterator[VideoFrame]:
    """Yield the pictures of exactly the packets of a part."""
    checksums = []
    for packet in itertools.islice(_packets_from(stream, span), span.stop - span.first):
        checksums.append(packet_checksum(packet))
        yield from packet.decode()
    if joint_checksum(checksums) != span.checksum:
        raise UnlikeSurveyError("the file has changed since it was looked through")
    yield from stream.codec_context.decode(None)


def _packets_from(stream: VideoStream, span: Span) -> "Iterator[Packet[VideoStream]]":
    """Yield the packets of a stream from where a part begins.

    Seeking has the decoder forget what it holds, as if nothing had been decoded before.
    """
    container = cast("InputContainer", stream.container)
    if not span.first:
        return (packet for packet in container.demux(stream) if packet.size)
    for before_s in _SEEK_BEFORE_S:
        # Some containers seek by the order of the file, where a picture may come before its time.
        ticks = before_s / (stream.time_base or 1)
        container.seek(max(span.origin_pts, round(span.start_pts - ticks)), stream=stream)
        packets = (packet for packet in container.demux(stream) if packet.size)
        for packet in packets:
            if packet.pts == span.start_pts:
                return itertools.chain([packet], packets)
            if packet.is_keyframe and (packet.pts is None or packet.pts > span.start_pts):
                break
    raise UnlikeSurveyError(f"picture {span.first} is not found")
