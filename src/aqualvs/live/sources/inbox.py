"""Datagrams of one kind, told by their content."""

import threading
import time

from aqualvs.live.sources.datagrams import Datagram, Datagrams
from aqualvs.live.sources.reception import Reception
from aqualvs.live.sources.rtp import parse_rtp
from aqualvs.live.sources.transport_stream import PACKET_BYTES, SYNC

RTP, TS, BARE = "RTP H.264", "MPEG-TS", "bare H.264"
"""Kinds of content, in the words of health."""

_TS_IN_RTP = 33

WAIT_S = 0.2
"""A wait for datagrams is no longer, so that an end is noticed."""

MAX_FOREIGN = 5
"""So many datagrams in a row of another kind: the sender sends something else now."""

_MAX_LAG_S = 2.0
"""What waits longer for decoding is dropped: this machine does not keep up."""


def kind_of(datagram: bytes) -> str | None:
    """Return what a datagram holds, or None if that is none of the kinds known here.

    Parameters
    ----------
    datagram : bytes

    Returns
    -------
    kind : str or None
        "RTP H.264", "MPEG-TS" or "bare H.264".
    """
    if transport_content(datagram) is not None:
        return TS
    if datagram.startswith((b"\x00\x00\x01", b"\x00\x00\x00\x01")):
        return BARE
    packet = parse_rtp(datagram)
    return None if packet is None or packet.payload_type < 96 else RTP


def transport_content(datagram: bytes) -> bytes | None:
    """Return the MPEG-TS packets in a datagram, bare or in RTP (RFC 2250), or None.

    Parameters
    ----------
    datagram : bytes
    """
    if datagram[:1] != bytes([SYNC]):
        packet = parse_rtp(datagram)
        if packet is None or packet.payload_type != _TS_IN_RTP:
            return None
        datagram = packet.payload
    whole = len(datagram) % PACKET_BYTES == 0
    return datagram if whole and set(datagram[::PACKET_BYTES]) == {SYNC} else None


class Inbox:
    """Datagrams of one kind, until something else comes.

    Parameters
    ----------
    datagrams : Datagrams
    closed : Event
        Set when the feed ends.
    reception : Reception
        Told of what cannot be used.
    """

    def __init__(self, datagrams: Datagrams, closed: threading.Event, reception: Reception) -> None:
        self.reception = reception
        self._datagrams = datagrams
        self._closed = closed
        self._peeked: Datagram | None = None
        self._n_foreign = 0

    @property
    def is_closed(self) -> bool:
        """Whether the feed ends."""
        return self._closed.is_set()

    def peek_kind(self) -> str | None:
        """Look at the next datagram; None if none comes, or one of no known kind."""
        datagram = self._datagrams.get(WAIT_S)
        if datagram is None:
            return None
        kind = kind_of(datagram.content)
        if kind is None:
            self.reception.complain("something comes, but neither RTP H.264 nor MPEG-TS nor H.264")
        self._peeked = None if kind is None else datagram
        return kind

    def get(self, timeout: float = WAIT_S) -> Datagram | None:
        """Return the next datagram, or None if none comes in time.

        Parameters
        ----------
        timeout : float
            Seconds.
        """
        peeked, self._peeked = self._peeked, None
        return peeked or self._datagrams.get(timeout)

    def is_late(self, datagram: Datagram) -> bool:
        """Return whether decoding lags too far behind; what waits is then dropped.

        Parameters
        ----------
        datagram : Datagram
            The oldest.
        """
        if time.monotonic() - datagram.arrival < _MAX_LAG_S:
            return False
        self._datagrams.forget()
        return True

    def is_foreign(self, datagram: Datagram, *, fits: bool) -> bool:
        """Return whether the sender has changed to another kind.

        Parameters
        ----------
        datagram : Datagram
        fits : bool
            Whether it is of the kind that is being read.
        """
        self._n_foreign = 0 if fits else self._n_foreign + 1
        if self._n_foreign < MAX_FOREIGN:
            return False
        self._n_foreign = 0
        return kind_of(datagram.content) is not None
