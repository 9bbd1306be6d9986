"""From datagrams to frames, for each kind of content."""

import time
from collections.abc import Iterator
from fractions import Fraction
from typing import cast

import av
from av.packet import Packet
from av.video.codeccontext import VideoCodecContext
from av.video.stream import VideoStream

from aqualvs.live.sources.inbox import (
    BARE,
    MAX_FOREIGN,
    RTP,
    TS,
    WAIT_S,
    Inbox,
    kind_of,
    transport_content,
)
from aqualvs.live.sources.live_frames import LiveFrames
from aqualvs.live.sources.packets import packet_with
from aqualvs.live.sources.reception import Reception
from aqualvs.live.sources.rtp import RtpOrder, RtpPacket, parse_rtp
from aqualvs.live.sources.rtp_h264 import TICKS_HZ, AccessUnit, H264Depacketizer
from aqualvs.live.sources.transport_stream import TransportStream
from aqualvs.scanning.scan import Frame


class RtpReader:
    """Reads RTP with H.264.

    Parameters
    ----------
    frames : LiveFrames
    parameter_sets : bytes
        SPS and PPS as a byte stream, or nothing.
    payload_type : int or None
        None takes every dynamic one.
    """

    def __init__(self, frames: LiveFrames, parameter_sets: bytes, payload_type: int | None) -> None:
        self._frames = frames
        self._parameter_sets = parameter_sets
        self._payload_type = payload_type

    def frames(self, inbox: Inbox) -> Iterator[Frame]:
        """Yield frames until the feed ends or another kind comes.

        Parameters
        ----------
        inbox : Inbox
        """
        order, pictures = RtpOrder(), H264Depacketizer()
        self._frames.connect(
            decoder_of("h264", self._parameter_sets), 1 / TICKS_HZ, hears_losses=True
        )
        while not inbox.is_closed:
            datagram = inbox.get(order.wait or WAIT_S)
            if datagram is None:
                due = order.overdue(time.monotonic())
            elif inbox.is_late(datagram):
                self._frames.lose()
                continue
            else:
                packet = parse_rtp(datagram.content)
                if inbox.is_foreign(datagram, fits=packet is not None):
                    return
                if packet is None or not self._is_video(packet):
                    continue
                due = order.push(packet, datagram.arrival)
                self._tell(inbox.reception, pictures)
            for ordered in due:
                for picture in pictures.push(ordered):
                    yield from decoded(self._frames, picture)

    def _is_video(self, packet: RtpPacket) -> bool:
        if self._payload_type is None:
            return packet.payload_type >= 96
        return packet.payload_type == self._payload_type

    def _tell(self, reception: Reception, pictures: H264Depacketizer) -> None:
        if pictures.n_foreign > MAX_FOREIGN:
            reception.complain("RTP comes, but not of H.264; set the camera to H.264")
        else:
            reception.hear(RTP)


class TransportReader:
    """Reads MPEG-TS.

    Parameters
    ----------
    frames : LiveFrames
    """

    def __init__(self, frames: LiveFrames) -> None:
        self._frames = frames

    def frames(self, inbox: Inbox) -> Iterator[Frame]:
        """Yield frames until the feed ends or another kind comes.

        Parameters
        ----------
        inbox : Inbox
        """
        stream, codec = TransportStream(), None
        while not inbox.is_closed:
            datagram = inbox.get()
            if datagram is None:
                continue
            if inbox.is_late(datagram):
                self._frames.lose()
                continue
            content = transport_content(datagram.content)
            if inbox.is_foreign(datagram, fits=content is not None):
                return
            inbox.reception.hear(TS)
            for picture in stream.push(content or b""):
                if codec != stream.codec:
                    codec = stream.codec or ""
                    # A loss of 16 packets, or as many times that, shows in no counter.
                    self._frames.connect(decoder_of(codec), 1 / TICKS_HZ, hears_losses=False)
                yield from decoded(self._frames, picture)


class BareReader:
    """Reads H.264 without any container, cut into datagrams anywhere.

    Parameters
    ----------
    frames : LiveFrames
    """

    def __init__(self, frames: LiveFrames) -> None:
        self._frames = frames

    def frames(self, inbox: Inbox) -> Iterator[Frame]:
        """Yield frames until the feed ends or another kind comes.

        Parameters
        ----------
        inbox : Inbox
        """
        codec = decoder_of("h264")
        self._frames.connect(codec, 1e-6, hears_losses=False)
        while not inbox.is_closed:
            datagram = inbox.get()
            if datagram is None:
                continue
            if inbox.is_late(datagram):
                self._frames.lose()
                continue
            other = kind_of(datagram.content) in (RTP, TS)
            if inbox.is_foreign(datagram, fits=not other):
                return
            inbox.reception.hear(BARE)
            for unit in codec.parse(datagram.content):
                unit.pts, unit.time_base = int(1e6 * datagram.arrival), Fraction(1, 1_000_000)
                yield from self._frames.feed(unit)


def decoded(frames: LiveFrames, picture: AccessUnit) -> Iterator[Frame]:
    """Yield the frames that a picture completes; a torn one is counted only.

    Parameters
    ----------
    frames : LiveFrames
    picture : AccessUnit
    """
    if picture.is_restart:
        frames.restart()
    if picture.after_loss:
        frames.lose()
    if picture.is_whole:
        yield from frames.feed(packet_of(picture.data, picture.ticks))
    else:
        frames.announce(packet_of(b"\x00", picture.ticks))


def decoder_of(codec: str, parameter_sets: bytes = b"") -> VideoCodecContext:
    """Return a decoder, not yet opened.

    Parameters
    ----------
    codec : str
        FFmpeg's name.
    parameter_sets : bytes
        SPS and PPS as a byte stream, or nothing.
    """
    found = cast("VideoCodecContext", av.CodecContext.create(codec, "r"))
    if parameter_sets:
        found.extradata = parameter_sets
    return found


def packet_of(data: bytes, ticks: int) -> "Packet[VideoStream]":
    """Return a packet of a stream with the clock of video in RTP.

    Parameters
    ----------
    data : bytes
        One picture as a byte stream.
    ticks : int
        90 kHz.
    """
    packet = packet_with(data)
    packet.pts, packet.time_base = ticks, Fraction(1, TICKS_HZ)
    return packet
