"""Live video over UDP: RTP with H.264, MPEG-TS, or a bare H.264 byte stream."""

import threading
from collections.abc import Callable, Iterator
from contextlib import closing

from aqualvs.live.health import PartHealth
from aqualvs.live.sources.datagrams import Datagrams, UdpAddress, why_not
from aqualvs.live.sources.inbox import BARE, RTP, TS, Inbox
from aqualvs.live.sources.live_frames import LiveFrames
from aqualvs.live.sources.reception import Reception
from aqualvs.live.sources.udp_readers import BareReader, RtpReader, TransportReader
from aqualvs.scanning.scan import Frame

_RETRY_S = 0.5
"""Between two tries to listen."""


class UdpFeed:
    """Listens on a UDP port and takes what comes; satisfies `Feed`.

    Parameters
    ----------
    name : str
        How health and messages call it.
    address : UdpAddress
    parameter_sets : bytes
        SPS and PPS as a byte stream, where an SDP file tells them; else they come in the stream.
    payload_type : int or None
        Of RTP; None takes every dynamic one (96 to 127).

    Notes
    -----
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
        while not self._closed.is_set():
            datagrams = self._listen(self._address)
            if datagrams is None:
                self._closed.wait(_RETRY_S)
                continue
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

    def _listen(self, address: UdpAddress) -> Datagrams | None:
        try:
            found = Datagrams(address)
        except OSError as fault:
            self._reception.complain(why_not(address, fault))
            return None
        self._reception.complain("")
        return found

    def _receive(self, datagrams: Datagrams) -> Iterator[Frame]:
        """Yield frames of whatever kind comes, which may change."""
        readers: dict[str, Callable[[Inbox], Iterator[Frame]]] = {
            RTP: RtpReader(self._frames, self._parameter_sets, self._payload_type).frames,
            TS: TransportReader(self._frames).frames,
            BARE: BareReader(self._frames).frames,
        }
        inbox = Inbox(datagrams, self._closed, self._reception)
        while not self._closed.is_set():
            kind = inbox.peek_kind()
            if kind is not None:
                yield from readers[kind](inbox)
