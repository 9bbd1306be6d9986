"""Live video received by FFmpeg: RTSP, SRT, HTTP, TCP, and cameras of this machine (Video4Linux).

A thread of its own reads each connection (`Connection`), because FFmpeg may block without end.
"""

import queue
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal, TypeAlias

import av
from av.container import InputContainer
from av.packet import Packet
from av.video.stream import VideoStream

from aqualvs.errors import SourceError
from aqualvs.scanning.scan import Frame
from aqualvs.sources.base import PartHealth
from aqualvs.sources.live_frames import LiveFrames, Reception

VideoPacket: TypeAlias = "Packet[VideoStream]"
Opener: TypeAlias = Callable[[], InputContainer]


class Connection:
    """Connection opened in the background, and the packets of its first video.

    FFmpeg waits without end where a network is silent, and can't be woken. So the thread is not
    joined: it ends by itself when FFmpeg's time runs out, and closes what it opened.

    `opener`: returns an open container, or raises what PyAV raises; its timeouts must be set.
    """

    def __init__(self, opener: Opener) -> None:
        self.reason = ""  # Why the connection ended, in a few words; empty for a plain end.
        self.fault: Exception | None = None  # What PyAV raised when opening.
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
            # Any exception: the reader must be notified, because nothing joins this thread.
            self.fault = fault
            self.reason = _words(fault)
        self._packets.put(None)

    def _read(self, container: InputContainer) -> None:
        if not container.streams.video:
            self.reason = "holds no video"
            return
        # Packets kept for a late decoder; beyond it the connection is given up.
        max_waiting = 250
        try:
            for packet in container.demux(container.streams.video[0]):
                if self._abandoned.is_set():
                    return
                if self._packets.qsize() > max_waiting:
                    self.reason = "this machine does not keep up"
                    return
                self._packets.put(packet)
            self.reason = "the sender ended it"
        except av.error.FFmpegError as fault:
            self.reason = _words(fault)


def _words(fault: Exception) -> str:
    """Return the fault in a few words."""
    if isinstance(fault, av.error.ExitError):
        return "no answer in time"
    if isinstance(fault, OSError | av.error.FFmpegError) and fault.strerror:
        return fault.strerror
    return f"{type(fault).__name__}: {fault}".splitlines()[0]


Transport: TypeAlias = Literal["tcp", "udp"]

_OPEN_S, _SILENT_S = 5.0, 2.0
"""Time to connect and find the first key frame; silence after which a connection is dead."""


_PROBE = {"fpsprobesize": "0", "analyzeduration": "1000000"}
"""The rate is not probed, so that the first pictures need not wait for it. FFmpeg's
`nobuffer` is not set: it drops packets read meanwhile, often the only key frame for seconds."""


class RemoteFeed:
    """Feed of a container that FFmpeg opens, and reopens; satisfies `Feed`.

    `opener`: opens the container; must not wait without end. `content`: what arrives, for health.
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
        # Pauses before retries, the last one repeated: the vehicle may return at any time.
        retry_s = (0.1, 0.2, 0.5)
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
                        self._frames.connect(codec, tick, reports_losses=False)
                    n_packets += 1
                    self._reception.note_arrival()
                    yield from self._frames.feed(packet)
            finally:
                connection.abandon()
            n_failed = 0 if n_packets else n_failed + 1
            if not self._closed.is_set():
                self._reception.note_fault(f"no connection ({connection.reason}); trying again")
                self._closed.wait(retry_s[min(n_failed, len(retry_s) - 1)])

    def health(self) -> PartHealth:
        """Return how the stream is."""
        return self._reception.health()

    def close(self) -> None:
        """End the iteration; pending calls of FFmpeg end by themselves within seconds."""
        self._closed.set()
        self._reception.end("closed")
        if self._connection is not None:
            self._connection.abandon()


def remote_feed(address: str, *, transport: Transport = "tcp") -> RemoteFeed:
    """Return a feed from an address that FFmpeg knows: `rtsp://...`, `srt://...` and the like.

    `transport`: how RTSP sends: TCP repeats lost packets; UDP never waits for them.
    """
    scheme = address.partition("://")[0].lower()
    options = dict(_PROBE)
    if scheme in ("rtsp", "rtsps"):
        options |= {"rtsp_transport": transport, "max_delay": "50000"}

    def opener() -> InputContainer:
        return av.open(address, "r", options=options, timeout=(_OPEN_S, _SILENT_S))

    return RemoteFeed(address, opener, content=scheme.upper())


_DEVICES = Path("/dev")


def camera_options(
    size_px: tuple[int, int] | None, fps: float | None, pixel_format: str | None
) -> dict[str, str]:
    """Return the options of FFmpeg's `v4l2` input; the camera chooses those that are None.

    `pixel_format`: as FFmpeg calls it: `h264`, `mjpeg`, `yuyv422`. Many cameras reach their full
    rate with the first two only.
    """
    found = {
        "video_size": None if size_px is None else "x".join(map(str, size_px)),
        "framerate": None if fps is None else f"{fps:g}",
        "input_format": pixel_format,
    }
    return {name: text for name, text in found.items() if text is not None}


class CameraFeed(RemoteFeed):
    """Feed of a camera; reopened when it is unplugged and returns.

    `where`: `/dev/video0`, `camera:0`, or `camera:` and a path. `asked`: from `camera_options`.
    """

    def __init__(self, where: str, asked: dict[str, str]) -> None:
        self._device = camera_device(where)

        def opener() -> InputContainer:
            return av.open(
                self._device, "r", format="v4l2", options=asked, timeout=(_OPEN_S, _SILENT_S)
            )

        super().__init__(self._device, opener, content="camera")

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames until closed.

        Raises `SourceError` if there is no such camera, or no Video4Linux, at the start.
        """
        if not sys.platform.startswith("linux"):
            raise SourceError(
                f"{self._device}: cameras are read on Linux only; send the picture by RTSP"
            )
        if not Path(self._device).exists():
            found = ", ".join(sorted(str(path) for path in _DEVICES.glob("video*")))
            present = f"there is {found}" if found else "no camera is plugged in"
            raise SourceError(f"{self._device}: no such camera; {present}")
        return super().__iter__()


def camera_device(where: str) -> str:
    """Return the device that `camera:0`, `camera:/dev/video2` or `/dev/video0` names.

    Raises `SourceError` if nothing follows `camera:`.
    """
    name = where.removeprefix("camera:")
    if not name:
        raise SourceError(f"{where}: names no camera; type camera:0 for /dev/video0")
    return str(_DEVICES / f"video{int(name)}") if name.isdecimal() else name


def is_camera(where: str) -> bool:
    """Return whether `where` names a camera."""
    return where.startswith(("camera:", f"{_DEVICES}/video", f"{_DEVICES}/v4l/"))
