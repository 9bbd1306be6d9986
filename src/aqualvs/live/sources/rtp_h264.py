"""Pictures from the RTP payload of H.264 (RFC 6184), single units, STAP-A and FU-A."""

from dataclasses import dataclass

from aqualvs.live.sources.clock import Unwrapper
from aqualvs.live.sources.h264 import DELIMITER, SEI, SPS, START_CODE
from aqualvs.live.sources.rtp import Ordered

TICKS_HZ = 90_000
"""Clock of video in RTP."""

_STAP_A, _FU_A = 24, 28
_SINGLE = range(1, 24)
_UNUSED = frozenset({0, 2, 3, 4, 30, 31})
"""Types that no H.264 encoder sends, but H.265 in RTP shows all the time."""


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
        The first of a sender that begins anew.
    """

    ticks: int
    data: bytes
    is_whole: bool
    after_loss: bool
    is_restart: bool


class H264Depacketizer:
    """Builds pictures from packets in order.

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
        """Keep in mind what is missing before a packet."""
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
            self._spoil()  # Begins within another, or goes on with none.
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
