"""A camera of this machine, by Video4Linux."""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import av
from av.container import InputContainer

from aqualvs.errors import SourceError
from aqualvs.live.sources.remote import RemoteFeed
from aqualvs.scanning.scan import Frame

_DEVICES = Path("/dev")
_OPEN_S, _SILENT_S = 5.0, 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraOptions:
    """What is asked of a camera; what is left out, the camera chooses.

    Attributes
    ----------
    size_px : (int, int) or None
        Width and height.
    fps : float or None
        Frames per second.
    pixel_format : str or None
        As FFmpeg calls it: `h264`, `mjpeg`, `yuyv422`. Many cameras reach their full rate with the
        first two only.
    """

    size_px: tuple[int, int] | None = None
    fps: float | None = None
    pixel_format: str | None = None

    def for_ffmpeg(self) -> dict[str, str]:
        """Return the options of FFmpeg's `v4l2` input."""
        found = {}
        if self.size_px is not None:
            found["video_size"] = f"{self.size_px[0]}x{self.size_px[1]}"
        if self.fps is not None:
            found["framerate"] = f"{self.fps:g}"
        if self.pixel_format is not None:
            found["input_format"] = self.pixel_format
        return found


class CameraFeed(RemoteFeed):
    """Frames from a camera; opened again when it is unplugged and comes back.

    Parameters
    ----------
    where : str
        `/dev/video0`, `camera:0`, or `camera:` and a path.
    options : CameraOptions
    """

    def __init__(self, where: str, options: CameraOptions) -> None:
        self._device = camera_device(where)
        asked = options.for_ffmpeg()

        def opener() -> InputContainer:
            return av.open(
                self._device, "r", format="v4l2", options=asked, timeout=(_OPEN_S, _SILENT_S)
            )

        super().__init__(self._device, opener, content="camera")

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames until closed.

        Raises
        ------
        SourceError
            If there is no such camera, or no Video4Linux, at the start.
        """
        if not sys.platform.startswith("linux"):
            raise SourceError(
                f"{self._device}: cameras are read on Linux only; send the picture by RTSP"
            )
        if not Path(self._device).exists():
            raise SourceError(f"{self._device}: no such camera; {_what_there_is()}")
        return super().__iter__()


def camera_device(where: str) -> str:
    """Return the device that `camera:0`, `camera:/dev/video2` or `/dev/video0` names.

    Parameters
    ----------
    where : str

    Raises
    ------
    SourceError
        If nothing follows `camera:`.
    """
    name = where.removeprefix("camera:")
    if not name:
        raise SourceError(f"{where}: names no camera; type camera:0 for /dev/video0")
    return str(_DEVICES / f"video{int(name)}") if name.isdecimal() else name


def is_camera(where: str) -> bool:
    """Return whether `where` names a camera.

    Parameters
    ----------
    where : str
    """
    return where.startswith(("camera:", f"{_DEVICES}/video", f"{_DEVICES}/v4l/"))


def _what_there_is() -> str:
    found = sorted(str(path) for path in _DEVICES.glob("video*"))
    return f"there is {', '.join(found)}" if found else "no camera is plugged in"
