"""Choice of the source or feed for a path or an address; `PacedFeed`, a recording as a live feed.

Modules that read streams, cameras and recordings are imported where they are used, because most
dives are videos.
"""

import math
import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import av
from av.container import InputContainer

from aqualvs.errors import AqualvsError, OptionError, SourceError
from aqualvs.scanning.scan import Frame
from aqualvs.sources.base import Feed, FrameSource, PartHealth, State
from aqualvs.sources.images import IMAGE_SUFFIXES, ImageSource
from aqualvs.sources.video import VideoSource
from aqualvs.special_files import refuse_special

if TYPE_CHECKING:
    from aqualvs.sources.remote import Transport


class PacedFeed:
    """Recording as a feed: its frames by their own clock, or as fast as they are taken.

    `source`: closed at the end. `realtime`: whether each frame waits for its time; a consumer that
    is late is not made later: frames that are due come at once.
    """

    def __init__(self, source: FrameSource, *, realtime: bool) -> None:
        self.name = source.name
        self._source = source
        self._realtime = realtime
        self._closed = threading.Event()
        self._state, self._progress = State.OK, "not begun"
        self._n_lost, self._last_index = 0, -1

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames until the source ends or `close` is called.

        Raises `SourceError` at the end, if the recording is cut short; and for whatever reading it
        raises: unlike a stream, a file is no better the next time.
        """
        if self._closed.is_set():
            return
        try:
            yield from self._frames()
        except AqualvsError:
            raise
        except Exception as fault:
            told = f"{type(fault).__name__}: {fault}".splitlines()[0]
            raise SourceError(f"{self.name}: cannot be read on ({told}); check the file") from fault
        self._state, self._progress = State.OFF, "closed" if self._closed.is_set() else "at its end"

    def _frames(self) -> Iterator[Frame]:
        with self._source as source:
            began = time.monotonic()
            for frame in source:
                wait_s = began + frame.time_s - time.monotonic() if self._realtime else 0.0
                if self._closed.wait(max(0.0, wait_s)):
                    break
                self._n_lost += frame.index - self._last_index - 1
                self._last_index = frame.index
                total = f" of {source.n_frames}" if source.n_frames else ""
                self._progress = f"frame {frame.index + 1}{total}, {frame.time_s:.1f} s"
                yield frame

    def health(self) -> PartHealth:
        """Return how far it is."""
        return PartHealth(self.name, self._state, self._progress, self._n_lost)

    def close(self) -> None:
        """End the iteration."""
        self._closed.set()


STREAM_SCHEMES = ("http", "https", "rtmp", "rtp", "rtsp", "rtsps", "srt", "tcp", "udp")
"""Addresses of streams; everything else is a path."""

BLUEROV_PORT = 5600
"""Port to which BlueOS and ArduSub send the main camera, and where QGroundControl listens."""


def open_source(
    where: str | Path, *, fps: float | None = None, topic: str | None = None
) -> FrameSource:
    """Open a source of frames.

    =====================================  ====================
    `where`                                source
    =====================================  ====================
    address, `scheme://...`                `VideoSource`
    ROS bag (`.bag`, `.db3`, or a folder
    with `metadata.yaml`)                  images of a topic
    `.mcap`                                images of a topic
    folder                                 `ImageSource`
    one image (suffix `IMAGE_SUFFIXES`)    `ImageSource`
    any other file                         `VideoSource`
    =====================================  ====================

    Parameters
    ----------
    where : str or Path
        Path of a file or folder, or an address. `PATH#TOPIC` names the topic of a recording.
    fps : float or None
        Frame rate of images (1 if None); everything else has its own clock.
    topic : str or None
        Of a bag or MCAP file, where it holds images on several.

    Raises
    ------
    SourceError
        If there is nothing at `where`, it is no address, or it cannot be read.
    OptionError
        If `fps` is given for a video or is not positive; if `topic` is missing, wrong, or given
        for what has none; if a package is missing.
    """
    if fps is not None and not 0 < fps < math.inf:
        raise OptionError(f"frame rate {fps:g}: must be positive and finite")
    if is_address(where):
        _check_address(str(where))
        _refuse(topic, where, "a stream has no topics; leave the topic out")
        return _video(str(where), fps)
    path, topic = existing_path(where, topic)
    refuse_special(path)
    if path.suffix.lower() == ".mcap" or is_bag(path):
        _refuse(fps, path, "a recording has its own clock; leave the frame rate out")
        from aqualvs.sources.bags import open_bag, open_mcap

        return open_bag(path, topic) if is_bag(path) else open_mcap(path, topic)
    _refuse(topic, path, "only bags and MCAP files have topics; leave the topic out")
    if path.is_dir():
        return ImageSource(path, fps=fps or 1.0)
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return ImageSource([path], fps=fps or 1.0)
    if path.suffix.lower() == ".sdp":
        raise SourceError(f"{path}: describes a live stream; give it to aqualvs live")
    return _video(str(path), fps)


def open_feed(
    where: str | Path,
    *,
    realtime: bool = True,
    fps: float | None = None,
    size_px: tuple[int, int] | None = None,
    pixel_format: str | None = None,
    transport: "Transport | None" = None,
) -> Feed:
    """Open a source for a live run.

    =====================================  =================================================
    `where`                                feed
    =====================================  =================================================
    `bluerov`                              `UdpFeed` on port 5600
    `udp://...`, `rtp://...`               `UdpFeed`: RTP H.264, MPEG-TS or bare H.264
    `.sdp` file, H.264                     `UdpFeed` on its port
    `.sdp` file, other codecs              `RemoteFeed` by FFmpeg
    `rtsp://...` and other addresses       `RemoteFeed` by FFmpeg
    `camera:0`, `/dev/video0`              `CameraFeed`
    whatever `open_source` takes           `PacedFeed`
    =====================================  =================================================

    Parameters
    ----------
    realtime : bool
        Whether a recording is played at its own pace, or as fast as it is taken. Streams and
        cameras have one pace only: True.
    fps : float or None
        Of images, or asked of a camera.
    size_px : (int, int) or None
        Width and height asked of a camera.
    pixel_format : str or None
        Asked of a camera: `h264`, `mjpeg`, `yuyv422`.
    transport : {"tcp", "udp"} or None
        How RTSP shall send; TCP if None.

    Raises
    ------
    SourceError
        If it can never work: no such file, an address without port.
    OptionError
        If an option does not go with the source.
    """
    from aqualvs.sources.remote import CameraFeed, camera_options, is_camera

    text = str(where)
    if fps is not None and not 0 < fps < math.inf:
        raise OptionError(f"frame rate {fps:g}: must be positive and finite")
    if is_camera(text) or _is_stream(text):
        _refuse(not realtime, text, "only a recording can be read faster; leave --fast out")
    if is_camera(text):
        _refuse(transport, text, "a camera has no transport; leave it out")
        return CameraFeed(text, camera_options(size_px, fps, pixel_format))
    _refuse(size_px or pixel_format, text, "only a camera takes a size or format; leave it out")
    if not text.lower().startswith("rtsp"):
        _refuse(transport, text, "only RTSP has a choice of transport; leave it out")
    if not _is_stream(text):
        return PacedFeed(open_source(where, fps=fps), realtime=realtime)
    _refuse(fps, text, "a stream has its own clock; leave the frame rate out")
    return _stream_feed(text, transport or "tcp")


def is_address(where: str | Path) -> bool:
    """Return whether `where` is the address of a stream rather than a path."""
    return isinstance(where, str) and where.partition("://")[0].lower() in STREAM_SCHEMES


def existing_path(where: str | Path, topic: str | None = None) -> tuple[Path, str | None]:
    """Return path and topic of a source that is no address.

    Raises `SourceError` if nothing is there.
    """
    path, topic = _split_topic(where, topic)
    if not path.exists():
        if re.match(r"[a-z][a-z\d+.-]*://", str(where), re.IGNORECASE):
            raise SourceError(
                f"{where}: unknown kind of address; give one that begins with "
                f"{', '.join(STREAM_SCHEMES[:-1])} or {STREAM_SCHEMES[-1]}, or a path"
            )
        raise SourceError(f"{path}: no such file or folder; check the path{_hint(str(path))}")
    return path, topic


def _hint(where: str) -> str:
    """Return what to type instead of a port or a camera's number; empty for anything else."""
    if port := re.fullmatch(r"(?:(?:udp|rtp):)?(?:[\d.]*:)?(\d{4,5})", where.lower()):
        return f", or type udp://:{port[1]} for the stream at this port"
    if camera := re.fullmatch(r"(?:camera)?(\d?)", where.lower()):
        return f", or type camera:{camera[1] or 0} for a camera"
    return ""


def is_bag(path: Path) -> bool:
    """Return whether a path is a ROS bag; a lone MCAP file is none."""
    return path.suffix.lower() in (".bag", ".db3") or (path / "metadata.yaml").is_file()


def _is_stream(where: str) -> bool:
    return where == "bluerov" or is_address(where) or where.lower().endswith(".sdp")


def _check_address(where: str) -> None:
    """Refuse impossible addresses, which FFmpeg would try again and again."""
    shown = where if where.isprintable() else repr(where)
    remedy = "write SCHEME://HOST:PORT, such as rtsp://192.168.2.10:554/video or udp://:5600"
    try:
        parts = urlsplit(where)
        host, port = parts.hostname, parts.port
    except ValueError as fault:
        raise SourceError(f"{shown}: no address ({fault}); {remedy}") from None
    if not where.isprintable() or " " in where:
        raise SourceError(f"{shown}: no address (a space or control character in it); {remedy}")
    if not host and port is None:
        raise SourceError(f"{shown}: neither host nor port; {remedy}")
    # Listening at UDP port 0 takes a free port; sending to port 0 is impossible.
    if port == 0 and parts.scheme.lower() not in ("udp", "rtp"):
        raise SourceError(f"{shown}: port 0 cannot be reached; {remedy}")


def _stream_feed(where: str, transport: "Transport") -> Feed:
    from aqualvs.sources.datagrams import UdpAddress, parse_udp
    from aqualvs.sources.remote import remote_feed
    from aqualvs.sources.udp import UdpFeed

    if where == "bluerov":
        return UdpFeed(where, UdpAddress("", BLUEROV_PORT))
    if where.lower().endswith(".sdp"):
        return _sdp_feed(Path(where))
    _check_address(where)
    if where.lower().startswith(("udp://", "rtp://")):
        return UdpFeed(where, parse_udp(where))
    return remote_feed(where, transport=transport)


def _sdp_feed(path: Path) -> Feed:
    from aqualvs.sources.remote import RemoteFeed
    from aqualvs.sources.udp import UdpFeed, read_sdp

    video = read_sdp(path)
    if video.codec == "H264":
        return UdpFeed(
            str(path),
            video.address,
            parameter_sets=video.parameter_sets,
            payload_type=video.payload_type,
        )

    def opener() -> InputContainer:
        allowed = {"protocol_whitelist": "file,udp,rtp"}
        return av.open(str(path), "r", format="sdp", options=allowed, timeout=(5.0, 2.0))

    return RemoteFeed(str(path), opener, content=f"RTP {video.codec}")


def folder_beside(where: str) -> Path:
    """Return where the results of a source go by default: a folder beside it, `NAME_run`.

    Raises `OptionError` if the source is an address.
    """
    if is_address(where):
        raise OptionError(f"--out: missing; give the folder to write for {where}")
    path = _split_topic(where, None)[0]
    if path.name in ("", ".."):
        path = path.resolve()
    return path.with_name(f"{path.name if path.is_dir() else path.stem}_run")


def _split_topic(where: str | Path, topic: str | None) -> tuple[Path, str | None]:
    """Return path and topic of `PATH#TOPIC`; a path that exists is taken as it is."""
    path, mark, name = str(where).rpartition("#")
    if topic is not None or not mark or Path(where).exists():
        return Path(where), topic
    return Path(path), name


def _refuse(value: object, where: str | Path, words: str) -> None:
    """Refuse an option that does not go with a source."""
    if value:
        raise OptionError(f"{where}: {words}")


def _video(where: str, fps: float | None) -> VideoSource:
    _refuse(fps, where, "a video has its own clock; leave the frame rate out")
    return VideoSource(where)
