"""Live video over UDP: RTP with H.264, MPEG-TS, or a bare H.264 byte stream.

`UdpFeed` listens on a port and reads its content by `rtp_frames`, `transport_frames` or
`bare_frames`. `read_sdp` reads the session description (RFC 8866) of an RTP stream.
"""

import base64
import binascii
import re
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple, cast

import av
from av.video.codeccontext import VideoCodecContext

from aqualvs.errors import SourceError
from aqualvs.scanning.scan import Frame
from aqualvs.sources.base import PartHealth, packet_with
from aqualvs.sources.datagrams import (
    BARE,
    MAX_FOREIGN,
    RTP,
    TS,
    WAIT_S,
    Datagram,
    Datagrams,
    UdpAddress,
    kind_of,
    listening_fault,
    transport_content,
)
from aqualvs.sources.h264 import START_CODE
from aqualvs.sources.live_frames import LiveFrames, Reception
from aqualvs.sources.rtp import (
    TICKS_HZ,
    AccessUnit,
    H264Depacketizer,
    RtpOrder,
    TransportStream,
    parse_rtp,
)
from aqualvs.special_files import refuse_special


class SdpVideo(NamedTuple):
    """The video that a session description announces."""

    address: UdpAddress  # Where it arrives; the host is kept for multicast only.
    payload_type: int
    codec: str  # As in RTP, upper case: "H264".
    # SPS and PPS of H.264 as a byte stream; empty if they come in the stream.
    parameter_sets: bytes


def read_sdp(path: Path) -> SdpVideo:
    """Read the first video from an SDP file.

    Raises `SourceError` if the file cannot be read or announces no video over RTP and UDP.
    """
    refuse_special(path)
    max_bytes = 64 << 10
    try:
        text = path.read_bytes()[:max_bytes].decode("utf-8", "replace")
    except OSError as fault:
        raise SourceError(f"{path}: cannot be read ({fault.strerror})") from fault
    session, *media = re.split(r"^(?=m=)", text, flags=re.MULTILINE)
    for part in media:
        found = re.match(r"m=video (\d{1,5})(?:/\d+)? RTP/AVPF? (\d{1,3})\b", part)
        if found:
            port, payload_type = int(found[1]), int(found[2])
            return SdpVideo(
                UdpAddress(_group(part) or _group(session), port),
                payload_type,
                _codec(part, payload_type),
                _parameter_sets(part, payload_type),
            )
    raise SourceError(
        f"{path}: announces no video over RTP; it needs a line m=video PORT RTP/AVP 96"
    )


def _group(part: str) -> str:
    """Return the multicast group of the connection line; empty for the vehicle's own address."""
    found = re.search(r"^c=IN IP[46] ([^/\s]+)", part, re.MULTILINE)
    host = found[1] if found else ""
    first = host.partition(".")[0]
    is_group = host.lower().startswith("ff") or bool(re.fullmatch("22[4-9]|23[0-9]", first))
    return host if is_group else ""


def _codec(part: str, payload_type: int) -> str:
    found = re.search(rf"^a=rtpmap:{payload_type} ([^/\s]+)/", part, re.MULTILINE)
    return found[1].upper() if found else "unknown"


def _parameter_sets(part: str, payload_type: int) -> bytes:
    found = re.search(
        rf"^a=fmtp:{payload_type} .*sprop-parameter-sets=([^;\s]+)", part, re.MULTILINE
    )
    if not found:
        return b""
    try:
        sets = [base64.b64decode(text, validate=True) for text in found[1].split(",") if text]
    except binascii.Error:
        return b""
    return b"".join(START_CODE + each for each in sets)


def rtp_frames(
    frames: LiveFrames, datagrams: Datagrams, parameter_sets: bytes, payload_type: int | None
) -> Iterator[Frame]:
    """Yield the frames of RTP with H.264 until the feed ends or another kind comes."""
    order, pictures = RtpOrder(), H264Depacketizer()
    frames.connect(decoder_of("h264", parameter_sets), 1 / TICKS_HZ, reports_losses=True)
    while not datagrams.ended.is_set():
        datagram = datagrams.get(order.wait or WAIT_S)
        if datagram is None:
            due = order.overdue(time.monotonic())
        elif datagrams.is_late(datagram):
            frames.lose()
            continue
        else:
            packet = parse_rtp(datagram.content)
            if datagrams.is_foreign(datagram, fits=packet is not None):
                return
            # Without a type that is wanted, every dynamic one is.
            wanted = range(96, 128) if payload_type is None else (payload_type,)
            if packet is None or packet.payload_type not in wanted:
                continue
            due = order.push(packet, datagram.arrival)
            if pictures.n_foreign > MAX_FOREIGN:
                fault = "RTP comes, but not of H.264; set the camera to H.264"
                datagrams.reception.note_fault(fault)
            else:
                datagrams.reception.note_arrival(RTP)
        for ordered in due:
            for picture in pictures.push(ordered):
                yield from decoded(frames, picture)


def _in_time(frames: LiveFrames, datagrams: Datagrams) -> Iterator[Datagram]:
    """Yield datagrams as they come, until the feed ends; late ones are lost."""
    while not datagrams.ended.is_set():
        datagram = datagrams.get()
        if datagram is None:
            continue
        if datagrams.is_late(datagram):
            frames.lose()
        else:
            yield datagram


def transport_frames(frames: LiveFrames, datagrams: Datagrams) -> Iterator[Frame]:
    """Yield the frames of MPEG-TS until the feed ends or another kind comes."""
    stream, codec = TransportStream(), None
    for datagram in _in_time(frames, datagrams):
        content = transport_content(datagram.content)
        if datagrams.is_foreign(datagram, fits=content is not None):
            return
        datagrams.reception.note_arrival(TS)
        for picture in stream.push(content or b""):
            if codec != stream.codec:
                codec = stream.codec or ""
                # A loss of 16 packets, or a multiple of that, shows in no counter.
                frames.connect(decoder_of(codec), 1 / TICKS_HZ, reports_losses=False)
            yield from decoded(frames, picture)


def bare_frames(frames: LiveFrames, datagrams: Datagrams) -> Iterator[Frame]:
    """Yield the frames of H.264 without a container, cut into datagrams anywhere.

    Ends with the feed, or when another kind comes.
    """
    codec = decoder_of("h264")
    frames.connect(codec, 1e-6, reports_losses=False)
    for datagram in _in_time(frames, datagrams):
        other = kind_of(datagram.content) in (RTP, TS)
        if datagrams.is_foreign(datagram, fits=not other):
            return
        datagrams.reception.note_arrival(BARE)
        for unit in codec.parse(datagram.content):
            unit.pts, unit.time_base = int(1e6 * datagram.arrival), Fraction(1, 1_000_000)
            yield from frames.feed(unit)


def decoded(frames: LiveFrames, picture: AccessUnit) -> Iterator[Frame]:
    """Yield the frames that a picture completes; a torn one is counted only."""
    if picture.is_restart:
        frames.restart()
    if picture.after_loss:
        frames.lose()
    packet = packet_with(picture.data if picture.is_whole else b"\x00")
    packet.pts, packet.time_base = picture.ticks, Fraction(1, TICKS_HZ)
    if picture.is_whole:
        yield from frames.feed(packet)
    else:
        frames.announce(packet)


def decoder_of(codec: str, parameter_sets: bytes = b"") -> VideoCodecContext:
    """Return a decoder, not yet opened, by FFmpeg's name.

    `parameter_sets`: SPS and PPS as a byte stream, or nothing.
    """
    found = cast("VideoCodecContext", av.CodecContext.create(codec, "r"))
    if parameter_sets:
        found.extradata = parameter_sets
    return found


class UdpFeed:
    """Feed from a UDP port, whatever kind of stream arrives; satisfies `Feed`.

    `name`: how health and messages call it. `parameter_sets`: SPS and PPS as a byte stream, where
    an SDP file has them; else they come in the stream. `payload_type`: of RTP; None takes every
    dynamic one (96 to 127).

    RTP and MPEG-TS are unpacked here and not by FFmpeg, whose interface hides which packets are
    lost, and which probes a stream before it shows a picture and holds one or two back. What a
    bare stream loses is found by the pictures' numbers only, and each of its pictures waits for
    the next, which ends it.
    """

    def __init__(
        self,
        name: str,
        address: UdpAddress,
        *,
        parameter_sets: bytes = b"",
        payload_type: int | None = None,
    ) -> None:
        self.name = name
        self._address = address
        self._parameter_sets = parameter_sets
        self._payload_type = payload_type
        self._closed = threading.Event()
        self._datagrams: Datagrams | None = None
        self._reception = Reception(name)
        self._frames = LiveFrames(self._reception)

    @property
    def port(self) -> int:
        """Port in use; that of the address until frames are asked for."""
        return self._address.port if self._datagrams is None else self._datagrams.port

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames until closed; waits for a sender."""
        # Pause between two attempts to listen.
        retry_s = 0.5
        while not self._closed.is_set():
            try:
                datagrams = Datagrams(self._address, self._closed, self._reception)
            except OSError as fault:
                self._reception.note_fault(listening_fault(self._address, fault))
                self._closed.wait(retry_s)
                continue
            self._reception.note_fault("")
            self._datagrams = datagrams
            with closing(datagrams):
                yield from self._receive(datagrams)

    def health(self) -> PartHealth:
        """Return how the stream is."""
        return self._reception.health()

    def close(self) -> None:
        """End the iteration."""
        self._closed.set()
        self._reception.end("closed")
        if self._datagrams is not None:
            self._datagrams.wake()

    def _receive(self, datagrams: Datagrams) -> Iterator[Frame]:
        """Yield frames of any kind of content, which may change."""
        frames = self._frames
        while not self._closed.is_set():
            kind = datagrams.peek_kind()
            if kind == RTP:
                rtp = self._parameter_sets, self._payload_type
                yield from rtp_frames(frames, datagrams, *rtp)
            elif kind == TS:
                yield from transport_frames(frames, datagrams)
            elif kind == BARE:
                yield from bare_frames(frames, datagrams)
