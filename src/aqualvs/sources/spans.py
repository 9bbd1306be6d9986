"""Spans of a dive that can be decoded independently, and readers of their frames.

A span of a video must begin at a picture from which decoding can start without any earlier picture.
In H.264 and HEVC that is an instantaneous decoding refresh (IDR): by the standards (ITU-T H.264,
7.4.1.2.4; H.265, 7.4.2.2) no later picture refers to one before it, and none that follows it in the
file is shown before it. Other key frames promise less; the video is not cut there. If any doubt is
left, the dive stays in one span.
"""

import itertools
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, cast

import av
import numpy as np
from av.container import InputContainer
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from aqualvs.closing import Closing
from aqualvs.errors import SourceError
from aqualvs.scanning.scan import Frame
from aqualvs.sources.base import frame_of
from aqualvs.sources.images import ImageSource, images_in

if TYPE_CHECKING:
    from aqualvs.sources.h264 import UnitReader

# Codecs without prediction between pictures.
_INTRA_ONLY = frozenset({"mjpeg", "prores", "dnxhd", "rawvideo", "huffyuv", "ffvhuff", "utvideo"})
# Tolerance in the time of the last picture before the end that the container states; the serial
# reader allows more.
_EARLY_FRAMES, _EARLY_SHARE = 2.0, 0.01
_TIMEOUT_S = 10.0


class SpanKind(StrEnum):
    """Method by which the frames of a span are read."""

    WHOLE = "whole"
    """All of them, as a run reads them."""
    VIDEO = "video"
    IMAGES = "images"


@dataclass(frozen=True, slots=True, kw_only=True)
class Span:
    """Consecutive frames of a dive."""

    kind: SpanKind
    # Frames `first` to `stop` - 1, by their index; 0 and 0 for a whole dive of unknown length.
    first: int = 0
    stop: int = 0
    # Time of the first packet and of the dive's first picture, in ticks of the stream.
    start_pts: int = 0
    origin_pts: int = 0
    n_bytes: int = 0  # Size of the packets, or of the files.
    checksum: int = 0  # CRC-32 of the packets with their times.
    # Frames at the beginning and at the end that are those of the spans beside it, for what depends
    # on a frame's neighbours; they count in `first`, `stop` and `checksum`.
    lead: int = 0
    trail: int = 0


@dataclass(frozen=True, slots=True)
class VideoSpans:
    """Spans into which a video may be cut."""

    # In order, without gaps between their own frames; empty if the video must stay whole.
    spans: tuple[Span, ...]
    why_whole: str  # Why it must; empty if it need not.
    # Of all packets.
    checksum: int
    n_bytes: int


def video_spans(path: Path, n_min: int, margin: int = 0) -> VideoSpans:
    """Read a video's packets, without decoding them, and find where it may be cut.

    `n_min`: frames that a part has at least, but for the last. `margin`: frames that it holds at
    least of those beside it. Raises `av.error.FFmpegError` or `OSError` as FFmpeg says it, if the
    file cannot be opened.
    """
    with av.open(str(path), timeout=_TIMEOUT_S) as container:
        stream = container.streams.video[0]
        packets = _PacketIndex(stream)
        try:
            for packet in container.demux(stream):
                packets.add(packet)
        except av.error.FFmpegError as fault:
            packets.doubt(f"the file breaks off ({fault.strerror})")
        if has_decoding_times(stream):
            packets.doubt("pictures without a time of their own")
        why = packets.why_whole() or _missing_end(stream, packets)
        spans = () if why else packets.spans(n_min, margin)
        return VideoSpans(spans, why, joint_checksum(packets.checksums), sum(packets.sizes))


def image_spans(sizes: Sequence[int], n_min: int, margin: int = 0) -> tuple[Span, ...]:
    """Cut a folder of images into parts.

    `sizes`: of the files, in bytes, in their order. `n_min`: images that a part has, but for the
    last. `margin`: as in `video_spans`.
    """
    edges = [*range(0, len(sizes), n_min), len(sizes)]
    found = []
    for first, stop in itertools.pairwise(edges):
        lead, trail = min(margin, first), min(margin, len(sizes) - stop)
        found.append(
            Span(
                kind=SpanKind.IMAGES,
                first=first - lead,
                stop=stop + trail,
                n_bytes=sum(sizes[first:stop]),
                lead=lead,
                trail=trail,
            )
        )
    return tuple(found)


def packet_checksum(packet: "Packet[VideoStream]") -> int:
    """Return the CRC-32 of a packet with its time."""
    return zlib.crc32(packet, zlib.crc32(str(packet.pts).encode()))


def joint_checksum(checksums: Sequence[int]) -> int:
    """Return one checksum of those of several packets, in their order."""
    return zlib.crc32(np.asarray(checksums, "<u4").tobytes())


class _PacketIndex:
    """Packets read so far, and the first reason found not to cut the video."""

    def __init__(self, stream: VideoStream) -> None:
        from aqualvs.sources.h264 import field_pairs, unit_reader

        self._stream = stream
        context = stream.codec_context
        self._name = context.name
        self._pts: list[int] = []
        self.sizes: list[int] = []  # Of all packets but empty ones, in bytes.
        self.checksums: list[int] = []
        self._cuts: list[int] = []
        self._doubt = ""
        self._units: UnitReader | None = None
        try:
            self._units = unit_reader(context.name, context.extradata or b"")
        except ValueError as fault:
            self.doubt(str(fault))
        self._fields = field_pairs(context.name, context.extradata)
        self._sets_in_band = False

    def doubt(self, words: str) -> None:
        """Note that the video must stay whole."""
        self._doubt = self._doubt or words

    def add(self, packet: "Packet[VideoStream]") -> None:
        """Note the next packet of the file; the empty one at the end does not count."""
        if packet.size == 0:
            return
        if packet.pts is None:
            self.doubt("pictures without a time")
        if packet.is_corrupt or packet.is_discard:
            self.doubt("damaged or hidden pictures")
        if self._fields is not None and self._fields.is_second(memoryview(packet)):
            self.doubt("fields in packets of their own")
        if self._can_start_at(packet):
            self._cuts.append(len(self._pts))
        self._pts.append(packet.pts or 0)
        self.sizes.append(packet.size)
        self.checksums.append(packet_checksum(packet))

    def why_whole(self) -> str:
        """Return why the video must stay whole, empty if it need not."""
        if self._doubt:
            return self._doubt
        if self._units is None and self._name not in _INTRA_ONLY:
            return f"videos in {self._name} stay whole"
        if len(set(self._pts)) != len(self._pts):
            return "pictures that share a time"
        return "" if self._cuts[:1] == [0] else "no key frame at the beginning"

    def spans(self, n_min: int, margin: int) -> tuple[Span, ...]:
        """Return the spans, each of which begins at a picture that needs none before it."""
        cuts, n = self._usable_cuts(), len(self._pts)
        origin, found, chosen = min(self._pts), [], cuts[:1]
        for cut in cuts:
            if cut - chosen[-1] >= n_min:
                chosen.append(cut)
        for first, stop in itertools.pairwise([*chosen, n]):
            begin = max(cut for cut in cuts if cut <= max(first - margin, 0))
            end = min(cut for cut in (*cuts, n) if cut >= min(stop + margin, n))
            found.append(
                Span(
                    kind=SpanKind.VIDEO,
                    first=begin,
                    stop=end,
                    start_pts=self._pts[begin],
                    origin_pts=origin,
                    n_bytes=sum(self.sizes[first:stop]),
                    checksum=joint_checksum(self.checksums[begin:end]),
                    lead=first - begin,
                    trail=end - stop,
                )
            )
        return tuple(found)

    def latest_s(self) -> float:
        """Return the time of the last picture after the first, in seconds."""
        base = self._stream.time_base
        return float((max(self._pts) - min(self._pts)) * base) if base and self._pts else 0.0

    def _usable_cuts(self) -> list[int]:
        """Return the cuts at which the order of the file is that of the pictures."""
        pts = np.asarray(self._pts, np.int64)
        latest = np.maximum.accumulate(pts)
        earliest = np.minimum.accumulate(pts[::-1])[::-1]
        return [
            cut
            for cut in self._cuts
            if earliest[cut] == pts[cut] and (cut == 0 or latest[cut - 1] < pts[cut])
        ]

    def _can_start_at(self, packet: "Packet[VideoStream]") -> bool:
        if self._units is None:
            return packet.is_keyframe
        found = self._units(memoryview(packet))
        # Parameter sets within the file apply from there on; a span must contain its own.
        self._sets_in_band = self._sets_in_band or found.has_parameter_sets
        return found.is_refresh and (found.has_all_parameter_sets or not self._sets_in_band)


def _missing_end(stream: VideoStream, packets: _PacketIndex) -> str:
    """Return why the file may hold less than its container states; empty if it does not."""
    if stream.time_base is None:
        return "no clock"
    slots = time_slots(stream)
    if slots is not None:
        passed = packets.latest_s() / float(stream.time_base)
        filled = slots.are_filled(passed, len(packets.sizes))
        return "" if filled else "ends before its promise"
    if stream.frames:
        return "" if len(packets.sizes) >= stream.frames else "fewer pictures than promised"
    promised_s, rate = stated_duration(stream), frame_rate(stream)
    if promised_s is None or not rate:
        return ""
    timeout_s = max(_EARLY_FRAMES / float(rate), _EARLY_SHARE * promised_s)
    return "" if packets.latest_s() + timeout_s >= promised_s else "ends before its promise"


def has_decoding_times(stream: VideoStream) -> bool:
    """Return whether a packet's time says when it is decoded, not when its picture is shown.

    AVI has no other times; FFmpeg derives them where it knows the order, but for these codecs.
    """
    context = stream.codec_context
    return _is_avi(stream) and context.name in ("h264", "hevc") and context.has_b_frames


def _is_avi(stream: VideoStream) -> bool:
    return cast("InputContainer", stream.container).format.name == "avi"


def frame_rate(stream: VideoStream) -> Fraction | None:
    """Return the nominal rate in Hz; where FFmpeg takes the clock's for it, its better guess."""
    average, guess, tick = stream.average_rate, stream.guessed_rate, stream.time_base
    if average and guess and tick and average * tick == 1 and guess < average:
        return guess
    return average or guess or None


@dataclass(frozen=True, slots=True)
class TimeSlots:
    """Ticks of the clock that AVI counts instead of pictures.

    It holds nothing where a picture was dropped, and its clock may be faster than the pictures.
    """

    n: int
    period: float  # From one picture to the next at the nominal rate, in ticks.

    def are_filled(self, passed: float, n_pictures: int) -> bool:
        """Return whether pictures reach the end; `passed`: from first to last, in ticks."""
        # The last one may be shown for longer than the mean. At a steady rate less than two, so
        # that one missing picture is noticed.
        longer = 1.5
        mean = passed / max(n_pictures - 1, 1)
        return passed + max(longer * mean, self.period) >= self.n


def time_slots(stream: VideoStream) -> TimeSlots | None:
    """Return the slots that the container counts; None if it counts pictures or nothing."""
    rate, tick = frame_rate(stream), stream.time_base
    if not (_is_avi(stream) and stream.frames and rate and tick):
        return None
    return TimeSlots(stream.frames, float(1 / (rate * tick)))


def stated_duration(stream: VideoStream) -> float | None:
    """Return the duration in seconds that the container states for the video, if it does."""
    slots = time_slots(stream)
    if slots is not None and stream.time_base is not None:
        # FFmpeg shortens the duration of AVI that is cut short.
        return float(slots.n * stream.time_base)
    if stream.duration is not None and stream.time_base is not None:
        return float(stream.duration * stream.time_base)
    clock = stream.metadata.get("DURATION", "").split(":")
    if len(clock) != 3:
        return None
    hours, minutes, seconds = (float(part) for part in clock)
    return 3600 * hours + 60 * minutes + seconds


class SpanMismatchError(Exception):
    """Difference between a span and its description; the dive must be measured in one piece."""


class SpanReader(Closing):
    """Reader of spans of a video, opened once for all of them, or of a folder of images.

    `size_px`: width and height of every picture of the video. `fps`: frame rate of the images.
    """

    def __init__(self, path: Path, size_px: tuple[int, int], fps: float = 1.0) -> None:
        self._path, self._size_px, self._fps = path, size_px, fps
        self._container: InputContainer | None = None

    def frames(self, span: Span) -> Iterator[Frame]:
        """Decode a part; frames have the index and the time that the whole dive gives them.

        `span`: from `video_spans` or `image_spans` of the same dive. Raises `SpanMismatchError` if
        any picture is damaged or missing: the whole dive decides what becomes of those that follow.
        """
        if span.kind is SpanKind.IMAGES:
            yield from _image_frames(self._path, span, self._fps)
            return
        index, latest = span.first, span.origin_pts - 1
        try:
            stream = self._stream(span)
            for picture in _pictures(stream, span):
                if picture.is_corrupt or picture.pts is None or picture.pts <= latest:
                    raise SpanMismatchError(f"picture {index} is damaged")
                if (picture.width, picture.height) != self._size_px:
                    raise SpanMismatchError(f"picture {index} has another size")
                latest = picture.pts
                ticks = picture.pts - span.origin_pts
                yield frame_of(index, float(ticks * (stream.time_base or 0)), picture)
                index += 1
        except (av.error.FFmpegError, OSError) as fault:
            raise SpanMismatchError(
                f"picture {index} or a later one is damaged ({fault})"
            ) from fault
        if index != span.stop:
            raise SpanMismatchError(f"{index - span.first} pictures of {span.stop - span.first}")

    def close(self) -> None:
        """Close the file; frames already delivered stay valid."""
        if self._container is not None:
            self._container.close()
            self._container = None

    def _stream(self, span: Span) -> VideoStream:
        if not span.first:
            # Some containers cannot seek to the start.
            self.close()
        if self._container is None:
            self._container = av.open(str(self._path), timeout=_TIMEOUT_S)
            context = self._container.streams.video[0].codec_context
            # Stop at any damage instead of patching it up.
            context.thread_count, context.options = 1, {"err_detect": "explode"}
        return self._container.streams.video[0]


def _image_frames(folder: Path, span: Span, fps: float) -> Iterator[Frame]:
    """Read a part of a folder of images, as `ImageSource` reads all of it."""
    try:
        source = ImageSource(images_in(folder)[span.first : span.stop], fps=fps)
        index = span.first
        for frame in source:
            if frame.index + span.first != index:
                raise SpanMismatchError(f"image {index} cannot be read")
            yield Frame(index, index / fps, frame.luma, frame.chroma)
            index += 1
    except SourceError as fault:
        raise SpanMismatchError(str(fault)) from fault
    if index != span.stop:
        raise SpanMismatchError(f"{index - span.first} images of {span.stop - span.first}")


def _pictures(stream: VideoStream, span: Span) -> Iterator[VideoFrame]:
    """Yield the pictures of exactly the packets of a part."""
    checksums = []
    for packet in itertools.islice(_packets_from(stream, span), span.stop - span.first):
        checksums.append(packet_checksum(packet))
        yield from packet.decode()
    if joint_checksum(checksums) != span.checksum:
        raise SpanMismatchError("the file has changed since it was looked through")
    yield from stream.codec_context.decode(None)


def _packets_from(stream: VideoStream, span: Span) -> "Iterator[Packet[VideoStream]]":
    """Yield the packets of a stream from where a part begins.

    Seeking has the decoder forget what it holds, as if nothing had been decoded before.
    """
    container = cast("InputContainer", stream.container)
    if not span.first:
        return (packet for packet in container.demux(stream) if packet.size)
    seek_before_s = (0, 2, 20, 1_000_000)
    for before_s in seek_before_s:
        # Some containers seek by the order of the file, where a picture may come before its time.
        ticks = before_s / (stream.time_base or 1)
        container.seek(max(span.origin_pts, round(span.start_pts - ticks)), stream=stream)
        packets = (packet for packet in container.demux(stream) if packet.size)
        for packet in packets:
            if packet.pts == span.start_pts:
                return itertools.chain([packet], packets)
            if packet.is_keyframe and (packet.pts is None or packet.pts > span.start_pts):
                break
    raise SpanMismatchError(f"picture {span.first} is not found")
