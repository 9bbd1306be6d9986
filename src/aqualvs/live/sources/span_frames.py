"""The frames of a part of a dive, read by themselves."""

import itertools
from collections.abc import Iterator
from pathlib import Path

import av
from av.container import InputContainer
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from aqualvs.errors import SourceError
from aqualvs.live.sources.images import ImageSource, images_in
from aqualvs.live.sources.planes import planes_of
from aqualvs.live.sources.spans import Span, joint_checksum, packet_checksum
from aqualvs.scanning.scan import Frame

_PATIENCE_S = 10.0
_SEEK_BEFORE_S = (0, 2, 20, 1_000_000)


class UnlikeSurveyError(Exception):
    """A part of a dive does not hold what it should; the dive must be measured in one piece."""


def video_frames(path: Path, span: Span, size_px: tuple[int, int]) -> Iterator[Frame]:
    """Decode a part of a video; frames have the index and the time that the whole video gives them.

    Parameters
    ----------
    path : Path
    span : Span
        From `video_spans` of the same file.
    size_px : (int, int)
        Width and height of every picture.

    Raises
    ------
    UnlikeSurveyError
        If any picture is damaged or missing: only the whole video tells what becomes of those that
        follow.
    """
    index, latest = span.first, span.origin_pts - 1
    try:
        with av.open(str(path), timeout=_PATIENCE_S) as container:
            stream = container.streams.video[0]
            _prepare(stream)
            for picture in _pictures(container, stream, span):
                if picture.is_corrupt or picture.pts is None or picture.pts <= latest:
                    raise UnlikeSurveyError(f"picture {index} is damaged")
                if (picture.width, picture.height) != size_px:
                    raise UnlikeSurveyError(f"picture {index} has another size")
                latest = picture.pts
                ticks = picture.pts - span.origin_pts
                luma, chroma = planes_of(picture)
                yield Frame(index, float(ticks * (stream.time_base or 0)), luma, chroma)
                index += 1
    except (av.error.FFmpegError, OSError) as fault:
        raise UnlikeSurveyError(f"picture {index} or a later one is damaged ({fault})") from fault
    if index != span.stop:
        raise UnlikeSurveyError(f"{index - span.first} pictures of {span.stop - span.first}")


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


def _pictures(container: InputContainer, stream: VideoStream, span: Span) -> Iterator[VideoFrame]:
    """Yield the pictures of exactly the packets of a part."""
    checksums = []
    for packet in itertools.islice(_packets_from(container, stream, span), span.stop - span.first):
        checksums.append(packet_checksum(packet))
        yield from packet.decode()
    if joint_checksum(checksums) != span.checksum:
        raise UnlikeSurveyError("the file has changed since it was looked through")
    yield from stream.codec_context.decode(None)


def _packets_from(
    container: InputContainer, stream: VideoStream, span: Span
) -> "Iterator[Packet[VideoStream]]":
    """Yield the packets of a stream from where a part begins."""
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
