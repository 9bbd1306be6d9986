"""RTP: packets in order (RFC 3550), and pictures from the payload of H.264 (RFC 6184).

Of RFC 6184, single NAL units, STAP-A and FU-A are read.
"""

from dataclasses import dataclass
from typing import NamedTuple

from aqualvs.sources.h264 import DELIMITER, SEI, SPS, START_CODE
from aqualvs.sources.live_frames import Unwrapper

_MAX_STEP = 3000
"""Packets that may be missing in a row; a greater step is a restarted sender."""

_RESTART_SILENCE_S = 0.1
"""Time for which the sender in use must be silent before another takes its place."""


@dataclass(frozen=True, slots=True)
class RtpPacket:
    """One packet.

    Attributes
    ----------
    payload_type : int
    marker : bool
        Ends a picture.
    sequence : int
        16 bits.
    timestamp : int
        32 bits, in ticks of the payload's clock.
    sender : int
        Synchronisation source (SSRC).
    payload : bytes
    """

    payload_type: int
    marker: bool
    sequence: int
    timestamp: int
    sender: int
    payload: bytes


def parse_rtp(datagram: bytes) -> RtpPacket | None:
    """Return the packet in a datagram, or None if there is none.

    Parameters
    ----------
    datagram : bytes

    Returns
    -------
    packet : RtpPacket or None
    """
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
    """A packet in its place.

    Attributes
    ----------
    packet : RtpPacket
    after_loss : bool
        Packets right before it are missing.
    is_restart : bool
        The first of another sender, or of a restarted one.
    """

    packet: RtpPacket
    after_loss: bool
    is_restart: bool


class RtpOrder:
    """Reordering buffer for the packets of one sender, which also detects losses.

    Parameters
    ----------
    depth : int
        So many later packets are kept while one is missing.
    patience : float
        Seconds for which a missing packet is awaited.

    Notes
    -----
    A stray packet, of another sender or with a damaged number, is ignored. Two in a row that fit
    each other are a restarted sender; if it has another identity, the old one must be
    silent, so that of two senders to one port the first is kept.
    """

    def __init__(self, *, depth: int = 32, patience: float = 0.02) -> None:
        self._depth = depth
        self._timeout = patience
        self._sender: int | None = None
        self._next = 0
        self._kept: dict[int, RtpPacket] = {}
        self._missing_since = 0.0
        self._heard = 0.0
        self._strays: list[RtpPacket] = []

    def push(self, packet: RtpPacket, arrival: float) -> list[Ordered]:
        """Return the packets whose turn has come.

        Parameters
        ----------
        packet : RtpPacket
        arrival : float
            Seconds on the monotonic clock.

        Returns
        -------
        ordered : list of Ordered
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
        return self._due(arrival)

    @property
    def wait(self) -> float | None:
        """Seconds after which to call `overdue` if nothing comes; None if nothing is missing."""
        return self._timeout if self._kept else None

    def overdue(self, arrival: float) -> list[Ordered]:
        """Return the packets that have waited too long for a missing one.

        Parameters
        ----------
        arrival : float
            Now, in seconds on the monotonic clock.
        """
        return self._due(arrival)

    def _due(self, arrival: float) -> list[Ordered]:
        ready = self._run(after_loss=False)
        late = arrival - self._missing_since >= self._timeout
        while self._kept and (late or len(self._kept) > self._depth):
            self._next = min(self._kept, key=self._distance)
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

    def _distance(self, sequence: int) -> int:
        return (sequence - self._next) % 0x10000

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


@dataclass(frozen=True, slots=True)
class AccessUnit:
    """One coded picture.

    Attributes
    ----------
    ticks : int
        Time, 90 kHz, continued past 32 bits.
    data : bytes
        Its units as a byte stream; empty if `is_whole` is False.
    is_whole : bool
        Nothing of it is missing.
    after_loss : bool
        Packets before it, or of it, are lost.
    is_restart : bool
        The first of a restarted sender.
    """

    ticks: int
    data: bytes
    is_whole: bool
    after_loss: bool
    is_restart: bool


class H264Depacketizer:
    """Depacketizer of H.264: builds pictures from packets in order.

    Attributes
    ----------
    n_foreign : int
        Packets in a row that are no H.264.
    """

    def __init__(self) -> None:
        self.n_foreign = 0
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

        Parameters
        ----------
        ordered : Ordered

        Returns
        -------
        pictures : list of AccessUnit
            None, one, or two: one that was left open, and its own.
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
        if self._gap_before and kind not in (DELIMITER, SPS):
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
        if self._is_whole and all(unit[0] & 31 >= SEI for unit in self._units):
            return []
        whole, lossy = self._is_whole, self._after_loss or not self._is_whole
        data = b"".join(START_CODE + unit for unit in self._units) if whole else b""
        unit = AccessUnit(self._unwrap(timestamp), data, whole, lossy, self._is_restart)
        self._units, self._fragments = [], []
        self._is_whole, self._after_loss, self._is_restart = True, False, False
        return [unit]
