"""Live video that FFmpeg receives: RTSP, SRT, HTTP, TCP, cameras of this machine."""

import threading
from collections.abc import Iterator
from typing import Literal, TypeAlias

import av
from av.container import InputContainer

from aqualvs.live.health import PartHealth
from aqualvs.live.sources.connection import Connection, Opener
from aqualvs.live.sources.live_frames import LiveFrames
from aqualvs.live.sources.reception import Reception
from aqualvs.scanning.scan import Frame

Transport: TypeAlias = Literal["tcp", "udp"]

_OPEN_S, _SILENT_S = 5.0, 2.0
"""Time to connect and find the first key frame; silence after which a connection is dead."""

_RETRY_S = (0.1, 0.2, 0.5)
"""Pauses before new tries, the last for ever: the vehicle may come back at any time."""

_PROBE = {"fpsprobesize": "0", "analyzeduration": "1000000"}
"""The rate need not be known; the first pictures shall not wait until it is measured. FFmpeg's
`nobuffer` is not set: it drops what was read meanwhile, often the only key frame for seconds."""


class RemoteFeed:
    """Frames from a container that FFmpeg opens, and opens again; satisfies `Feed`.

    Parameters
    ----------
    name : str
        How health and messages call it.
    opener : callable
        Opens the container; must not wait without end.
    content : str
        What arrives, for health.
    """

    def __init__(self, name: str, opener: Opener, *, content: str = "") -> None:
        self.name = name
        self._opener = opener
        self._closed = threading.Event()
        self._connection: Connection | None = None
        self._reception = Reception(name, content)
        self._frames = LiveFrames(self._reception)

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames until closed; connects anew when the stream breaks off."""
        n_failed = 0
        while not self._closed.is_set():
            connection = self._connection = Connection(self._opener)
            if self._closed.is_set():
                connection.abandon()
            n_packets = 0
            try:
                while (packet := connection.get()) is not None and not self._closed.is_set():
                    if n_packets == 0:
                        codec, tick = packet.stream.codec_context, float(packet.time_base)
                        self._frames.connect(codec, tick, hears_losses=False)
                    n_packets += 1
                    self._reception.hear()
                    yield from self._frames.feed(packet)
            finally:
                connection.abandon()
            n_failed = 0 if n_packets else n_failed + 1
            self._rest(connection, n_failed)

    def health(self) -> PartHealth:
        """Return how the stream is."""
        return self._reception.health()

    def close(self) -> None:
        """End the iteration; what FFmpeg still waits for ends by itself within seconds."""
        self._closed.set()
        self._reception.end("closed")
        if self._connection is not None:
            self._connection.abandon()

    def _rest(self, connection: Connection, n_failed: int) -> None:
        """Say why there is no connection, and wait a little."""
        if self._closed.is_set():
            return
        self._reception.complain(f"no connection ({connection.reason}); trying again")
        self._closed.wait(_RETRY_S[min(n_failed, len(_RETRY_S) - 1)])


def remote_feed(address: str, *, transport: Transport = "tcp") -> RemoteFeed:
    """Return a feed from an address that FFmpeg knows.

    Parameters
    ----------
    address : str
        `rtsp://...`, `srt://...`, `http://...`, `tcp://...` and the like.
    transport : {"tcp", "udp"}
        How RTSP sends: TCP repeats lost packets; UDP never waits for them.
    """
    scheme = address.partition("://")[0].lower()
    options = dict(_PROBE)
    if scheme in ("rtsp", "rtsps"):
        options |= {"rtsp_transport": transport, "max_delay": "50000"}

    def opener() -> InputContainer:
        return av.open(address, "r", options=options, timeout=(_OPEN_S, _SILENT_S))

    return RemoteFeed(address, opener, content=scheme.upper())
