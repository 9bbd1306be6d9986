"""A connection that FFmpeg holds, read by a thread of its own."""

import queue
import threading
from collections.abc import Callable
from typing import TypeAlias

import av
from av.container import InputContainer
from av.packet import Packet
from av.video.stream import VideoStream

VideoPacket: TypeAlias = "Packet[VideoStream]"
Opener: TypeAlias = Callable[[], InputContainer]

_MAX_WAITING = 250
"""Packets kept for a decoder that does not come; then the connection is given up."""


class Connection:
    """Opens a container and reads its first video in the background.

    FFmpeg waits without end where a network is silent, and can't be woken. So nobody waits for
    this thread: it ends by itself when FFmpeg's time runs out, and closes what it opened.

    Parameters
    ----------
    opener : callable
        Returns an open container, or raises what PyAV raises; its timeouts must be set.

    Attributes
    ----------
    reason : str
        Why the connection ended, in a few words; empty for a plain end.
    fault : Exception or None
        What PyAV raised when opening.
    """

    def __init__(self, opener: Opener) -> None:
        self.reason = ""
        self.fault: Exception | None = None
        self._opener = opener
        self._abandoned = threading.Event()
        self._packets: queue.SimpleQueue[VideoPacket | None] = queue.SimpleQueue()
        threading.Thread(target=self._run, name="connection", daemon=True).start()

    def get(self) -> "VideoPacket | None":
        """Return the next packet, or None when the connection has ended or is abandoned."""
        return self._packets.get()

    def abandon(self) -> None:
        """Let the thread end; a `get` that waits returns."""
        self._abandoned.set()
        self._packets.put(None)

    def _run(self) -> None:
        try:
            with self._opener() as container:
                self._read(container)
        except Exception as fault:
            # Whatever it is: the reader must be told, for nobody waits for this thread.
            self.fault = fault
            self.reason = _words(fault)
        self._packets.put(None)

    def _read(self, container: InputContainer) -> None:
        if not container.streams.video:
            self.reason = "holds no video"
            return
        try:
            for packet in container.demux(container.streams.video[0]):
                if self._abandoned.is_set():
                    return
                if self._packets.qsize() > _MAX_WAITING:
                    self.reason = "this machine does not keep up"
                    return
                self._packets.put(packet)
            self.reason = "the sender ended it"
        except av.error.FFmpegError as fault:
            self.reason = _words(fault)


def _words(fault: Exception) -> str:
    """Return what went wrong in a few words."""
    if isinstance(fault, av.error.ExitError):
        return "no answer in time"
    if isinstance(fault, OSError | av.error.FFmpegError) and fault.strerror:
        return fault.strerror
    return f"{type(fault).__name__}: {fault}".splitlines()[0]
