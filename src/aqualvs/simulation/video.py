"""Video files, as an ROV's recorder would write them or without any loss."""

from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Literal, Self, TypeAlias, cast

import av
import numpy as np
from av.container import OutputContainer
from av.video.stream import VideoStream
from numpy.typing import NDArray

from aqualvs.errors import OptionError, OutputError

Quality: TypeAlias = Literal["h264", "lossless"]

# First of these that the installed PyAV carries.
_LOSSY = ("libx264", "libopenh264", "mpeg4")
_FALLBACK_BIT_RATE = 6_000_000


class VideoWriter:
    """Writes RGB frames; use it as a context manager, so that the file is always closed well.

    Parameters
    ----------
    path : Path
        File to write; the suffix chooses the container.
    size_px : (int, int)
        Width and height of every frame.
    fps : float
        Frames a second.
    quality : {"h264", "lossless"}
        H.264 with chroma at half resolution (4:2:0), as ROVs record; or lossless H.264 in RGB.
    crf : int
        Quality of "h264", 0 to 51; smaller is better. Ignored when `bit_rate` is given.
    bit_rate : int or None
        Bits a second of "h264".

    Raises
    ------
    OptionError
        If an option makes no sense.
    OutputError
        If the file cannot be written or the encoder is missing.
    """

    def __init__(
        self,
        path: Path,
        size_px: tuple[int, int],
        fps: float,
        *,
        quality: Quality = "h264",
        crf: int = 20,
        bit_rate: int | None = None,
    ) -> None:
        _check(size_px, fps, quality, crf, bit_rate)
        self._path = path
        codec = "libx264rgb" if quality == "lossless" else _lossy_codec()
        try:
            self._container = av.open(str(path), "w")
            self._stream = _add_stream(self._container, codec, fps)
            self._stream.width, self._stream.height = size_px
            self._set_quality(codec, crf, bit_rate)
            self._container.start_encoding()
        except (OSError, ValueError, av.error.FFmpegError) as error:
            raise OutputError(f"{path}: cannot write video ({error}); {_REMEDY}") from None

    def _set_quality(self, codec: str, crf: int, bit_rate: int | None) -> None:
        stream = self._stream
        stream.pix_fmt = "yuv420p"
        if codec == "libx264rgb":
            stream.pix_fmt = "rgb24"
            stream.options = {"qp": "0", "preset": "veryfast"}
        elif codec == "libx264" and bit_rate is None:
            stream.options = {"crf": str(crf), "preset": "veryfast"}
        else:
            stream.bit_rate = bit_rate or _FALLBACK_BIT_RATE

    def write(self, image: NDArray[np.uint8]) -> None:
        """Append one frame, uint8 RGB of shape (height, width, 3).

        Raises
        ------
        OutputError
            If the disk refuses it.
        """
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        self._encode(frame)

    def close(self) -> None:
        """Write what the encoder still holds and close the file."""
        try:
            self._encode(None)
        finally:
            self._container.close()

    def _encode(self, frame: av.VideoFrame | None) -> None:
        try:
            for packet in self._stream.encode(frame):
                self._container.mux(packet)
        except (OSError, av.error.FFmpegError) as error:
            raise OutputError(f"{self._path}: cannot write video ({error}); {_REMEDY}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


_REMEDY = "choose a folder that can be written, with space left"


def _add_stream(container: OutputContainer, codec: str, fps: float) -> VideoStream:
    rate = Fraction(fps).limit_denominator(1001)
    return cast(VideoStream, container.add_stream(codec, rate=rate))


def _lossy_codec() -> str:
    for name in _LOSSY:
        if name in av.codecs_available:
            return name
    raise OutputError(
        f"the installed PyAV has none of the encoders {', '.join(_LOSSY)}; install PyAV's wheel"
    )


def _check(
    size_px: tuple[int, int], fps: float, quality: str, crf: int, bit_rate: int | None
) -> None:
    if quality not in {"h264", "lossless"}:
        raise OptionError(f"quality is {quality!r}; choose h264 or lossless")
    if quality == "h264" and any(side % 2 for side in size_px):
        raise OptionError(
            f"size is {size_px[0]}x{size_px[1]} px; 4:2:0 video needs even sides, or choose "
            "lossless"
        )
    if not 0.0 < fps <= 1000.0:
        raise OptionError(f"fps is {fps:g}; it must lie between 0 and 1000")
    if not 0 <= crf <= 51:
        raise OptionError(f"crf is {crf}; it must lie between 0 and 51")
    if bit_rate is not None and bit_rate <= 0:
        raise OptionError(f"bit rate is {bit_rate}; it must be positive")
