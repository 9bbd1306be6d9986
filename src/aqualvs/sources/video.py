"""Frames from a video file or stream, decoded by FFmpeg through PyAV.

`FrameCounter` numbers the pictures by their packets, so that lost pictures leave a gap in the
index.
"""

import contextlib
import heapq
import itertools
import threading
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NoReturn

import av
from av.container import InputContainer
from av.packet import Packet
from av.stream import Disposition
from av.video.codeccontext import VideoCodecContext
from av.video.frame import PictureType, VideoFrame
from av.video.stream import VideoStream

from aqualvs.closing import Closing
from aqualvs.errors import SourceError
from aqualvs.optics.shutter import Field
from aqualvs.scanning.scan import Frame
from aqualvs.sources.base import frame_of
from aqualvs.sources.h264 import FieldPairs, field_pairs
from aqualvs.sources.spans import frame_rate, has_decoding_times, stated_duration, time_slots


class FrameCounter:
    """Numbers of pictures by the packets that announced them; lost ones leave a gap.

    `counts_packets`: whether each packet shows a picture.
    """

    def __init__(self, *, counts_packets: bool) -> None:
        self.first_pts: int | None = None  # Of the first picture, in ticks of its stream.
        # Packets noted; of these, those that complete the picture of the one before (`FieldPairs`).
        self.n_packets = self.n_second_fields = 0
        self._counts_packets = counts_packets
        self._fields: FieldPairs | None = None
        self._pending: list[int] = []
        self._lost: set[int] = set()
        self._earliest: int | None = None
        self._latest = self._next = 0

    @property
    def n_known(self) -> int:
        """Pictures numbered so far and announced ones that have not come."""
        return self._next + len(self._pending)

    @property
    def passed(self) -> int:
        """Ticks from the earliest packet to the latest."""
        return 0 if self._earliest is None else self._latest - self._earliest

    def begin(self, codec: VideoCodecContext) -> None:
        """Count the pictures of a stream from here on."""
        self._fields = field_pairs(codec.name, codec.extradata)

    def expect(self, packet: "Packet[VideoStream]") -> None:
        """Note a packet; the empty one that flushes the decoder does not count."""
        if packet.size == 0:
            return
        self.n_packets += 1
        if packet.pts is not None:
            if self._earliest is None:
                self._earliest = self._latest = packet.pts
            self._earliest = min(self._earliest, packet.pts)
            self._latest = max(self._latest, packet.pts)
        if self._fields is not None and self._fields.is_second(memoryview(packet)):
            self.n_second_fields += 1
            return
        if packet.pts is None or packet.is_discard or not self._counts_packets:
            return
        heapq.heappush(self._pending, packet.pts)

    def lose(self, packet: "Packet[VideoStream]") -> None:
        """Note that no picture comes of a packet, so that `time_in_order` leaves its time out."""
        if packet.pts is not None:
            self._lost.add(packet.pts)

    def time_in_order(self, picture: VideoFrame) -> int | None:
        """Return the time of a picture whose own is that of decoding: the earliest left.

        No picture after an instantaneous refresh is shown before it, so that its own time holds
        even if pictures were lost unnoticed. Before other key frames some are, of later times.
        """
        earliest = min((pts for pts in self._pending if pts not in self._lost), default=None)
        if earliest is None or picture.pts is None:
            return picture.pts
        return max(earliest, picture.pts) if picture.key_frame else earliest

    def number(self, pts: int | None) -> int:
        """Return the number of a picture, counting those lost before it; numbers only grow.

        `pts`: its time, in ticks of its stream.
        """
        if self.first_pts is None and pts is not None:
            self.first_pts = min([pts, *self._pending[:1]])
        while pts is not None and self._pending and self._pending[0] < pts:
            heapq.heappop(self._pending)
            self._next += 1
        while pts is not None and self._pending and self._pending[0] == pts:
            heapq.heappop(self._pending)
        self._next += 1
        return self._next - 1

    def skip(self, n: int) -> None:
        """Count pictures as lost whose packets never came."""
        self._next += n

    def restart(self) -> None:
        """Count announced pictures that have not come as lost; the stream's ticks begin anew."""
        self._next = self.n_known
        self._pending.clear()


_HIDDEN_PACKETS = frozenset({"vp8"})
"""Codecs whose packets need not show a picture, so that packets cannot be counted as frames."""

_LOSSY_CONTAINERS = frozenset({"mpegts", "rtsp"})
"""Containers in which a packet marked as damaged still holds most of its picture, which helps to
predict the next ones. Elsewhere it is the torn end of a file; its error would discard the intact
pictures that the decoder still holds."""


_STALL_S = 10.0
"""A stream that sends nothing for this time has ended."""

_MAX_HELD = 16
"""Pictures that H.264 and HEVC can reorder."""


class VideoSource(Closing):
    """A video file, or a stream that FFmpeg can open, by path or address.

    Raises `SourceError` if the file is missing, empty or cut off before its index, or is not a
    video.

    Pictures that the decoder had to patch up are dropped, not delivered, and all that may be
    predicted from them, up to the next picture that needs no other: a stripe copied from the
    picture before would give a posture that looks sound. Damage that happens to be valid code goes
    unseen.
    """

    def __init__(self, where: str | Path) -> None:
        self.name = str(where)
        self._container = _open(self.name)
        self._stream = self._video_stream()
        # Of video in the file, cover pictures left out; the first one is read.
        self.n_tracks = sum(
            not one.disposition & Disposition.attached_pic for one in self._container.streams.video
        )
        # Slice threads leave patched pictures unmarked; frame threads do not wait for each other's
        # patches, so that the following pictures would depend on timing.
        self._stream.codec_context.thread_count = 1
        if self._stream.codec_context.name == "hevc":
            # FFmpeg does not mark HEVC pictures that it had to patch up; this drops them instead.
            self._stream.codec_context.options = {"err_detect": "explode"}
        self.size_px = (self._stream.codec_context.width, self._stream.codec_context.height)
        rate = frame_rate(self._stream)
        self.fps = float(rate) if rate else None
        self._damage_is_partial = self._container.format.name in _LOSSY_CONTAINERS
        self._has_decoding_times = has_decoding_times(self._stream)
        self._promised_s = stated_duration(self._stream)
        self._slots = time_slots(self._stream)
        self._n_exact = 0 if self._slots is not None else self._stream.frames
        self.n_frames: int | None = self._n_exact or None
        if not self._n_exact and self._promised_s is not None and self.fps is not None:
            self.n_frames = round(self._promised_s * self.fps)
        self._frame_counter = FrameCounter(
            counts_packets=self._stream.codec_context.name not in _HIDDEN_PACKETS
        )
        self._frame_counter.begin(self._stream.codec_context)
        self._tick = self._stream.time_base
        self._n_delivered, self._last_index, self._last_time_s = 0, -1, 0.0
        # Time of the latest damage, None while pictures are sound; of the key packets since then.
        self._damage: int | None = None
        self._refreshes: list[int] = []
        self._last_was_corrupt = False
        # Pictures predicted from both sides, until the later side proves sound.
        self._held: deque[Frame] = deque()
        self._is_closed = self._is_at_end = False
        # FFmpeg reads from memory that closing frees.
        self._in_ffmpeg = threading.Lock()
        self._packets: Iterator[Packet[VideoStream]] = self._read_packets()
        if self._packets_are_fields():
            self.fps = None if self.fps is None else 0.5 * self.fps
            self.n_frames = None if self.n_frames is None else self.n_frames // 2

    def __iter__(self) -> Iterator[Frame]:
        """Yield the sound frames; lost ones leave a gap in the index.

        Raises `SourceError` at the end, if frames that the container promised did not come; or when
        the picture size changes, a stream stalls, or the source is closed or at its end.
        """
        if self._is_at_end:
            raise SourceError(f"{self.name}: has been read to its end; open it again")
        codec = self._stream.codec_context
        for picture in self._pictures():
            if self._has_decoding_times:
                picture.pts = self._frame_counter.time_in_order(picture)
            index = self._frame_counter.number(picture.pts)
            if self._is_sound(picture):
                self._held.append(self._frame(picture, index))
                is_last = picture.pict_type != PictureType.B or not codec.has_b_frames
                if is_last or len(self._held) > _MAX_HELD:
                    yield from self._released()
        yield from self._released()
        self._is_at_end = True
        self._check_complete()

    def _is_sound(self, picture: VideoFrame) -> bool:
        """Return whether neither a picture nor one that it is predicted from is damaged."""
        time = picture.pts or 0
        if picture.is_corrupt:
            self._distrust(time)
        # Pictures of before the damage may be shown after it was found. A gradual refresh is
        # complete where the next one begins.
        elif self._damage is not None and time >= self._damage:
            needs_no_other = picture.key_frame or picture.pict_type == PictureType.I
            if needs_no_other or sum(pts <= time for pts in self._refreshes) > 1:
                self._damage = None
        return self._damage is None

    def _distrust(self, time: int) -> None:
        """Wait for a picture that needs no other: something was lost."""
        self._damage = time if self._damage is None else max(self._damage, time)
        self._refreshes = []
        self._held.clear()

    def _released(self) -> Iterator[Frame]:
        while self._held:
            frame = self._held.popleft()
            self._n_delivered += 1
            self._last_index, self._last_time_s = frame.index, frame.time_s
            yield frame

    def _pictures(self) -> Iterator[VideoFrame]:
        """Decode all undamaged pictures, in order of presentation."""
        while True:
            with self._in_ffmpeg:
                if self._is_closed:
                    raise SourceError(f"{self.name}: has been closed; open it again")
                packet = next(self._packets, None)
                if packet is None:
                    return
                pictures = self._decoded(packet)
            yield from pictures

    def _decoded(self, packet: "Packet[VideoStream]") -> list[VideoFrame]:
        """Return the pictures that a packet completes; none if it is damaged."""
        self._frame_counter.expect(packet)
        if packet.is_corrupt and not self._damage_is_partial:
            self._frame_counter.lose(packet)
            return []
        # FFmpeg marks H.264 pictures that it had to patch up, but not HEVC's. Of these it marks the
        # packet that lacks a part, or the one before it, if a parser joins the parts of packets.
        is_suspect = packet.is_corrupt or self._last_was_corrupt
        self._last_was_corrupt = packet.is_corrupt
        if is_suspect:
            # Even if the packet's own picture claims to need no other.
            self._distrust((packet.pts or 0) + 1)
        elif packet.is_keyframe and self._damage is not None:
            self._refreshes.append(packet.pts or 0)
        try:
            pictures = packet.decode()
        except av.error.InvalidDataError:
            self._frame_counter.lose(packet)
            self._distrust(packet.pts or 0)
            return []
        return [picture for picture in pictures if isinstance(picture, VideoFrame)]

    def _packets_are_fields(self) -> bool:
        """Return whether every packet is one field and has a time, which containers count."""
        codec = self._stream.codec_context
        pairs = field_pairs(codec.name, codec.extradata)
        if pairs is None:
            return False
        first: list[Packet[VideoStream]] = []
        try:
            for packet in itertools.islice(self._packets, 2):
                first.append(packet)
        except SourceError as fault:
            self._packets = map(_raise, [fault])
        self._packets = itertools.chain(first, self._packets)
        coded = [packet for packet in first if packet.size]
        seconds = [packet for packet in coded if pairs.is_second(memoryview(packet))]
        return any(packet.pts is not None for packet in seconds)

    def _read_packets(self) -> Iterator["Packet[VideoStream]"]:
        """Read packets; a damaged container ends early, which the promise then reveals."""
        try:
            yield from self._container.demux(self._stream)
        except av.error.InvalidDataError:
            return
        except av.error.ExitError as fault:
            raise SourceError(self._broke_off(f"nothing came in {_STALL_S:g} s")) from fault
        except av.error.FFmpegError as fault:
            raise SourceError(self._broke_off(fault.strerror)) from fault

    def _broke_off(self, why: str | None) -> str:
        words = f"{self.name}: the stream broke off ({why})"
        return words if self._frame_counter.n_packets else f"{words}{_hint(self.name)}"

    def _frame(self, picture: VideoFrame, index: int) -> Frame:
        if (picture.width, picture.height) != self.size_px:
            raise SourceError(
                f"{self.name}: the picture size changes from {self.size_px[0]}x{self.size_px[1]} "
                f"to {picture.width}x{picture.height} px at frame {index}; cut the video there"
            )
        # Since the start of the stream, by its own clock where it has one.
        time_s = index / (self.fps or 1.0)
        if picture.pts is not None and self._tick is not None:
            time_s = float((picture.pts - (self._frame_counter.first_pts or 0)) * self._tick)
        return frame_of(index, time_s, picture)

    def _check_complete(self) -> None:
        """Raise if the file ended before its promise, or if its last frames are lost."""
        time_s = self._last_time_s
        if not self._is_cut() and self._last_index + 1 == self._frame_counter.n_known:
            return
        n_promised = max(self.n_frames or 0, self._frame_counter.n_known)
        promised = f"{self.n_frames}" if self._n_exact else f"about {n_promised}"
        raise SourceError(
            f"{self.name}: only {self._n_delivered} of {promised} frames could be decoded, the "
            f"last at {time_s:.2f} s; the file is cut short or damaged, copy it again from the "
            "recorder"
        )

    def _is_cut(self) -> bool:
        """Return whether packets are missing, or the last frame is clearly before the end."""
        counter = self._frame_counter
        if self._n_exact:
            return counter.n_packets < self._n_exact
        if self._slots is not None:
            n_pictures = counter.n_packets - counter.n_second_fields
            return not self._slots.are_filled(counter.passed, n_pictures)
        if self._promised_s is None or self.fps is None:
            return False
        return self._last_time_s + max(3 / self.fps, 0.02 * self._promised_s) < self._promised_s

    def _video_stream(self) -> VideoStream:
        if not self._container.streams.video:
            self._container.close()
            raise SourceError(f"{self.name}: holds no video; give a video file")
        stream = self._container.streams.video[0]
        if stream.codec_context is None or not stream.codec_context.width:
            self._container.close()
            remedy = _hint(self.name) or "; record it again"
            raise SourceError(f"{self.name}: no picture in this video{remedy}")
        return stream

    def close(self) -> None:
        """Close the file; frames already delivered stay valid. May be called by any thread."""
        self._is_closed = True
        with self._in_ffmpeg:
            self._container.close()


def _hint(where: str) -> str:
    """Return what to do if nothing can be read from a server; empty for anything else."""
    if not where.startswith(("http://", "https://")):
        return ""
    return "; if the server cannot send parts of a file, download it and give the file"


def _raise(fault: SourceError) -> NoReturn:
    raise fault


# Pictures that are looked at for fields: so many in a row, at so many places of a file.
_GROUP, _PLACES = 3, 3
_FIRST_FIELD: Final[dict[int, Field]] = {2: "top", 5: "top", 3: "bottom", 4: "bottom"}
"""AVFieldOrder of FFmpeg: by the field that is shown first, whichever is coded first."""


def sampled_pictures(path: Path) -> tuple[list[list[Frame]], Field | None]:
    """Return a few pictures in a row from some places of a video, and which field comes first.

    The pictures have no numbers and times; there are none from where the file is damaged. The field
    is as the stream states it, None if it does not.
    """
    groups: list[list[Frame]] = []
    first_field: Field | None = None
    with contextlib.suppress(av.error.FFmpegError, OSError), av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.codec_context.thread_count = 1
        for place in range(_PLACES):
            if place:
                container.seek(place * (container.duration or 0) // _PLACES)
            pictures = itertools.islice(container.decode(stream), _GROUP)
            groups.append([frame_of(0, 0.0, one) for one in pictures if not one.is_corrupt])
        first_field = _FIRST_FIELD.get(stream.codec_context.field_order)
    return groups, first_field


def _open(where: str) -> InputContainer:
    """Open a container, or say in one line why not."""
    try:
        return av.open(where, timeout=_STALL_S)
    except FileNotFoundError as fault:
        raise SourceError(f"{where}: no such file; check the path") from fault
    except (av.error.InvalidDataError, av.error.EOFError) as fault:
        path = Path(where)
        if path.is_file() and path.stat().st_size == 0:
            what = "the file is empty (0 bytes)"
            raise SourceError(f"{where}: {what}; copy it again from the recorder") from fault
        raise SourceError(
            f"{where}: not a video, or cut short before its index was written; "
            "check the file or copy it again from the recorder"
        ) from fault
    except av.error.ExitError as fault:
        raise SourceError(f"{where}: nothing came in {_STALL_S:g} s; is the sender on?") from fault
    except (av.error.FFmpegError, OSError) as fault:
        raise SourceError(f"{where}: cannot be opened ({fault.strerror})") from fault
