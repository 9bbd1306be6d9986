"""From a path or an address to the source that reads it."""

from pathlib import Path

from aqualvs.errors import OptionError, SourceError
from aqualvs.live.sources.base import FrameSource
from aqualvs.live.sources.images import IMAGE_SUFFIXES, ImageSource
from aqualvs.live.sources.video import VideoSource

STREAM_SCHEMES = ("http", "https", "rtmp", "rtp", "rtsp", "srt", "tcp", "udp")
"""Addresses that FFmpeg opens; everything else is a path."""


def open_source(where: str | Path, *, fps: float | None = None) -> FrameSource:
    """Open a source of frames.

    =====================================  ===============
    `where`                                source
    =====================================  ===============
    address, `scheme://...`                `VideoSource`
    folder                                 `ImageSource`
    one image (suffix `IMAGE_SUFFIXES`)    `ImageSource`
    any other file                         `VideoSource`
    =====================================  ===============

    Parameters
    ----------
    where : str or Path
        Path of a file or folder, or an address.
    fps : float or None
        Frame rate of images (1 if None); videos have their own clock.

    Raises
    ------
    SourceError
        If there is nothing at `where`, or it cannot be read.
    OptionError
        If `fps` is given for a video, or is not positive.
    """
    if fps is not None and not fps > 0:
        raise OptionError(f"frame rate {fps:g}: must be positive")
    if is_address(where):
        return _video(str(where), fps)
    path = Path(where)
    if not path.exists():
        raise SourceError(f"{path}: no such file or folder; check the path")
    if path.is_dir():
        return ImageSource(path, fps=fps or 1.0)
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return ImageSource([path], fps=fps or 1.0)
    return _video(str(path), fps)


def is_address(where: str | Path) -> bool:
    """Return whether `where` is the address of a stream rather than a path."""
    return isinstance(where, str) and where.partition("://")[0].lower() in STREAM_SCHEMES


def _video(where: str, fps: float | None) -> VideoSource:
    if fps is not None:
        raise OptionError(f"{where}: a video has its own clock; leave the frame rate out")
    return VideoSource(where)
