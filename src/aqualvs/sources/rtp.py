"""Pictures from packets: RTP (RFC 3550) with H.264 (RFC 6184), and MPEG-TS (ITU-T H.222.0).

Of RFC 6184, single NAL units, STAP-A and FU-A are read.
"""

from typing import NamedTuple

from aqualvs.sources.h264 import START_CODE, NalType
from aqualvs.sources.live_frames import Unwrapper

_MAX_STEP = 3000
"""Packets that may be missing in a row; a greater step is a restarted sender."""

_RESTART_SILENCE_S = 0.1
"""Time for which the sender in use must be silent before another takes its place."""


class RtpPacket(NamedTuple):
    """One packet."""

    payload_type: int
    marker: bool  # Ends a picture.
    sequence: int  # 16 bits.
    timestamp: int  # 32 bits, in ticks of the payload's clock.
    sender: int  # Synchronisation source (SSRC).
    payload: bytes


def parse_rtp(datagram: bytes) -> RtpPacket | None:
    """Return the packet in a datagram, or None if there is none."""
    if len(datagram) < 13 or datagram[0] >> 6 != 2:
        return None
    first, second = datagram[0], datagram[1]
    if 200 <= second <= 211:  # RTCP on the same port (RFC 5761).
        return None
    start = 12 + 4 * (first & 15)
    if first & 0x10:
        start += 4 + 4 * int.from_bytes(datagram[start + 2 : start + 4], "big")
    end = len(datagram) - (datagram[-1] if first & 0x20 else 0)
    if start >= end:
        return None
    return RtpPacket(
        payload_type=second & 0x7F,
        marker=second > 0x7F,
        sequence=int.from_bytes(datagram[2:4], "big"),
        timestamp=int.from_bytes(datagram[4:8], "big"),
        sender=int.from_bytes(datagram[8:12], "big"),
        payload=datagram[start:end],
    )


class Ordered(NamedTuple):
    """A packet in its place."""

    packet: RtpPacket
    after_loss: bool  # Packets right before it are missing.
    is_restart: bool  # The first of another sender, or of a restarted one.


class RtpOrder:
    """Reordering buffer for the packets of one sender, which also detects losses.

    `patience`: seconds for which a missing packet is awaited.

    A stray packet, of another sender or with a damaged number, is ignored. Two in a row that fit
    each other are a restarted sender; if it has another identity, the old one must be
    silent, so that of two senders to one port the first is kept.
    """

    def __init__(self, *, patience: float = 0.02) -> None:
        self._timeout = patience
        self._sender: int | None = None
        self._next = 0
        self._kept: dict[int, RtpPacket] = {}
        self._missing_since = 0.0
        self._heard = 0.0
        self._strays: list[RtpPacket] = []

    def push(self, packet: RtpPacket, arrival: float) -> list[Ordered]:
        """Return the packets whose turn has come.

        `arrival`: seconds on the monotonic clock.
        """
        if self._sender is None:
            return self._begin([packet], arrival)
        step = (packet.sequence - self._next + 0x8000) % 0x10000 - 0x8000
        if packet.sender != self._sender or abs(step) > _MAX_STEP:
            return self._consider(packet, arrival)
        if step < 0:
            # A duplicate, or too late; after a silence, a restarted sender with a close number.
            silent = arrival - self._heard >= _RESTART_SILENCE_S
            return self._consider(packet, arrival) if silent else []
        self._heard = arrival
        self._strays.clear()
        if step > 0 and not self._kept:
            self._missing_since = arrival
        self._kept[packet.sequence] = packet
        return self.overdue(arrival)

    @property
    def wait(self) -> float | None:
        """Seconds after which to call `overdue` if nothing comes; None if nothing is missing."""
        return self._timeout if self._kept else None

    def overdue(self, arrival: float) -> list[Ordered]:
        """Return the packets whose turn has come, or that have waited too long for a missing one.

        `arrival`: now, in seconds on the monotonic clock.
        """
        most_kept = 32  # Later packets kept while one is missing.
        ready = self._run(after_loss=False)
        late = arrival - self._missing_since >= self._timeout
        while self._kept and (late or len(self._kept) > most_kept):
            self._next = min(self._kept, key=lambda number: (number - self._next) % 0x10000)
            ready += self._run(after_loss=True)
            self._missing_since = arrival
            late = False
        return ready

    def _run(self, *, after_loss: bool) -> list[Ordered]:
        """Take packets as long as none is missing."""
        run: list[Ordered] = []
        while (packet := self._kept.pop(self._next, None)) is not None:
            run.append(Ordered(packet, after_loss and not run, False))
            self._next = (self._next + 1) % 0x10000
        return run

    def _consider(self, packet: RtpPacket, arrival: float) -> list[Ordered]:
        """Keep packets that do not fit until they show that a sender begins anew."""
        run = self._strays
        fits = bool(run) and run[-1].sender == packet.sender
        if not fits or (run[-1].sequence + 1) % 0x10000 != packet.sequence:
            run.clear()
        run.append(packet)
        is_other = packet.sender != self._sender
        if len(run) < 2 or (is_other and arrival - self._heard < _RESTART_SILENCE_S):
            del run[:-_MAX_STEP]
            return []
        return self._begin(run.copy(), arrival)

    def _begin(self, packets: list[RtpPacket], arrival: float) -> list[Ordered]:
        self._sender = packets[0].sender
        self._next = (packets[-1].sequence + 1) % 0x10000
        self._heard = arrival
        self._strays.clear()
        self._kept.clear()
        return [Ordered(packet, False, i == 0) for i, packet in enumerate(packets)]


TICKS_HZ = 90_000
"""Clock of video in RTP."""

_STAP_A, _FU_A = 24, 28
_SINGLE = range(1, 24)
_UNUSED = frozenset({0, 2, 3, 4, 30, 31})
"""Types that no H.264 encoder sends, but that H.265 in RTP often contains."""


class AccessUnit(NamedTuple):
    """One coded picture."""

    ticks: int  # Time, 90 kHz, continued past 32 bits.
    data: bytes  # Its units as a byte stream; empty if `is_whole` is False.
    is_whole: bool  # Nothing of it is missing.
    after_loss: bool  # Packets before it, or of it, are lost.
    is_restart: bool  # The first of a restarted sender.


class H264Depacketizer:
    """Depacketizer of H.264: builds pictures from packets in order."""

    def __init__(self) -> None:
        self.n_foreign = 0  # Packets in a row that are no H.264.
        self._unwrap = Unwrapper(32)
        self._timestamp: int | None = None
        self._units: list[bytes] = []
        self._fragments: list[bytes] = []
        self._is_whole = True
        self._after_loss = False
        self._is_restart = False
        self._gap_before = False

    def push(self, ordered: Ordered) -> list[AccessUnit]:
        """Return the pictures that a packet completes.

        There is none, one, or two: one that was left open, and its own.
        """
        packet, done = ordered.packet, []
        if self._timestamp is not None and (
            packet.timestamp != self._timestamp or ordered.is_restart
        ):
            if ordered.after_loss or ordered.is_restart:
                self._is_whole = False
            done += self._close()
        self._note(ordered)
        if self._timestamp is None:
            self._open(packet.timestamp, packet.payload)
        self._take(packet.payload)
        if packet.marker:
            done += self._close()
        return done

    def _note(self, ordered: Ordered) -> None:
        """Remember that packets are missing before a packet."""
        if ordered.is_restart:
            self._is_restart = self._gap_before = True
            self._unwrap = Unwrapper(32)
        if ordered.after_loss:
            self._after_loss = True
            if self._timestamp is None:
                self._gap_before = True
            else:
                self._is_whole = False

    def _open(self, timestamp: int, payload: bytes) -> None:
        """Begin a picture; after a gap its beginning is only there if that shows."""
        self._timestamp = timestamp
        kind = payload[0] & 31
        if kind == _STAP_A and len(payload) > 3:
            kind = payload[3] & 31
        if self._gap_before and kind not in (NalType.DELIMITER, NalType.SPS):
            self._is_whole = False
        self._gap_before = False

    def _take(self, payload: bytes) -> None:
        kind = payload[0] & 31
        self.n_foreign = self.n_foreign + 1 if kind in _UNUSED else 0
        if self._fragments and kind != _FU_A:
            self._spoil()
        if kind in _SINGLE:
            self._units.append(payload)
        elif kind == _STAP_A:
            self._take_several(payload)
        elif kind == _FU_A and len(payload) > 2:
            self._take_fragment(payload)
        else:
            self._spoil()

    def _take_several(self, payload: bytes) -> None:
        at = 1
        while at + 2 < len(payload):
            size = int.from_bytes(payload[at : at + 2], "big")
            unit = payload[at + 2 : at + 2 + size]
            if not size or len(unit) < size:
                self._spoil()
                return
            self._units.append(unit)
            at += 2 + size

    def _take_fragment(self, payload: bytes) -> None:
        indicator, header = payload[0], payload[1]
        if bool(header & 0x80) == bool(self._fragments):
            self._spoil()  # Starts within another unit, or continues none.
        if header & 0x80:
            self._fragments = [bytes([indicator & 0xE0 | header & 31])]
        self._fragments.append(payload[2:])
        if header & 0x40:
            self._units.append(b"".join(self._fragments))
            self._fragments = []

    def _spoil(self) -> None:
        self._is_whole = False
        self._fragments = []

    def _close(self) -> list[AccessUnit]:
        """End the picture; parameter sets alone wait for the next one."""
        timestamp, self._timestamp = self._timestamp or 0, None
        if self._fragments:
            self._spoil()
        if self._is_whole and all(unit[0] & 31 >= NalType.SEI for unit in self._units):
            return []
        whole, lossy = self._is_whole, self._after_loss or not self._is_whole
        data = b"".join(START_CODE + unit for unit in self._units) if whole else b""
        unit = AccessUnit(self._unwrap(timestamp), data, whole, lossy, self._is_restart)
        self._units, self._fragments = [], []
        self._is_whole, self._after_loss, self._is_restart = True, False, False
        return [unit]


PACKET_BYTES = 188
SYNC = 0x47

_CODECS = {0x01: "mpeg1video", 0x02: "mpeg2video", 0x10: "mpeg4", 0x1B: "h264", 0x24: "hevc"}
"""FFmpeg's names by stream type (table 2-34)."""

_RESTART_TICKS = 10 * TICKS_HZ
"""A step in time beyond this is a restarted sender."""


class TransportStream:
    """Demultiplexer of the first video of an MPEG-TS, from packets of 188 bytes.

    The stream does not say where a picture ends, only where the next one begins. Muxers fill up
    the last packet of a picture; so a filled packet ends it, and no picture waits for the next.
    Where that proves wrong once, it is given up.
    """

    def __init__(self) -> None:
        self.codec: str | None = None  # FFmpeg's name; None until the tables have come.
        self._tables: int | None = None
        self._video: int | None = None
        self._counts: dict[int, int] = {}
        self._unwrap = Unwrapper(33)
        self._ticks: int | None = None
        self._parts: list[bytes] | None = None
        self._n_bytes = 0
        self._last = b""
        self._after_loss = self._is_restart = False
        self._ends_by_filling = True
        self._ended_early = False

    def push(self, content: bytes) -> list[AccessUnit]:
        """Return the pictures that whole packets complete; what does not begin as one is ignored.

        `is_whole` is False for pictures that miss a packet; their `data` is empty.
        """
        done: list[AccessUnit] = []
        for at in range(0, len(content) - PACKET_BYTES + 1, PACKET_BYTES):
            if content[at] == SYNC:
                done += self._packet(content[at : at + PACKET_BYTES])
        return done

    def _packet(self, packet: bytes) -> list[AccessUnit]:
        pid = (packet[1] & 0x1F) << 8 | packet[2]
        control = packet[3] >> 4 & 3
        if not control & 1 or pid not in (0, self._tables, self._video):
            return []
        start, filled = (4, False) if control == 1 else _adaptation(packet)
        begins = bool(packet[1] & 0x40)
        if pid == self._video:
            if packet == self._last:  # Sent or received twice.
                return []
            self._last = packet
            done = []
            if packet[1] & 0x80 or not self._follows(pid, packet[3] & 15):
                # The picture misses a packet.
                self._after_loss = True
                done = self._close(is_whole=False)
            return done + self._video_packet(packet[start:], begins, filled)
        if begins and start < PACKET_BYTES:
            self._table(pid, packet[start + 1 + packet[start] :])
        return []

    def _follows(self, pid: int, count: int) -> bool:
        last = self._counts.get(pid)
        self._counts[pid] = count
        return last is None or count == (last + 1) % 16

    def _table(self, pid: int, section: bytes) -> None:
        """Read a programme association (table 2-30) or map (2-33) that fits into one packet."""
        if len(section) < 12:
            return
        end = min(3 + ((section[1] & 15) << 8 | section[2]) - 4, len(section))
        if pid == 0 and section[0] == 0:
            for at in range(8, end - 3, 4):
                if section[at : at + 2] != b"\x00\x00":  # 0 is the network, not a programme.
                    self._tables = _pid(section, at + 2)
                    return
        elif pid == self._tables and section[0] == 2:
            self._choose(section, end)

    def _choose(self, section: bytes, end: int) -> None:
        """Take the first video of a programme."""
        at = 12 + ((section[10] & 15) << 8 | section[11])
        while at + 5 <= end:
            codec, video = _CODECS.get(section[at]), _pid(section, at + 1)
            if codec is not None:
                if (codec, video) != (self.codec, self._video):
                    self.codec, self._video, self._parts = codec, video, None
                return
            at += 5 + ((section[at + 3] & 15) << 8 | section[at + 4])

    def _video_packet(self, payload: bytes, begins: bool, filled: bool) -> list[AccessUnit]:
        done = []
        if begins:
            done = self._close(is_whole=True)
            self._open(payload)
        elif self._parts is not None:
            self._parts.append(payload)
            self._n_bytes += len(payload)
        elif self._ended_early and payload:
            self._ends_by_filling = False
            self._after_loss = True
        self._ended_early = False
        # No picture is larger; larger data have lost their end.
        max_bytes = 16 << 20
        if self._parts is not None and (
            (filled and self._ends_by_filling) or self._n_bytes > max_bytes
        ):
            done += self._close(is_whole=self._n_bytes <= max_bytes)
            self._ended_early = True
        return done

    def _open(self, payload: bytes) -> None:
        """Read the head of a picture's packet (2.4.3.6)."""
        self._parts = None
        if len(payload) < 9 or payload[:3] != b"\x00\x00\x01" or payload[3] & 0xF0 != 0xE0:
            return
        start = 9 + payload[8]
        self._parts, self._n_bytes = [payload[start:]], len(payload) - start
        self._is_restart = False
        if payload[7] & 0x80 and len(payload) >= 14:
            before, self._ticks = self._ticks, self._unwrap(_time(payload))
            self._is_restart = before is None or abs(self._ticks - before) > _RESTART_TICKS

    def _close(self, *, is_whole: bool) -> list[AccessUnit]:
        parts, self._parts = self._parts, None
        if parts is None:
            return []
        data = b"".join(parts) if is_whole else b""
        lossy, self._after_loss = self._after_loss, not is_whole
        return [AccessUnit(self._ticks or 0, data, is_whole, lossy, self._is_restart)]


def _adaptation(packet: bytes) -> tuple[int, bool]:
    """Return where the payload begins, and whether the field before it fills the packet up."""
    length = packet[4]
    if length == 0:
        return 5, True
    used = 1 + (6 if packet[5] & 0x10 else 0)
    only_clock = not packet[5] & 0x0F
    return min(5 + length, PACKET_BYTES), only_clock and length > used


def _pid(section: bytes, at: int) -> int:
    return (section[at] & 0x1F) << 8 | section[at + 1]


def _time(payload: bytes) -> int:
    """Return the time of presentation, 33 bits at 90 kHz."""
    a, b, c, d, e = payload[9:14]
    return (a >> 1 & 7) << 30 | b << 22 | (c >> 1) << 15 | d << 7 | e >> 1
