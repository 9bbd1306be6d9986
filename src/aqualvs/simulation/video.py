"""Video files, as an ROV's recorder would write them or without any loss."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal, TypeAlias, cast

import av
import cv2
import numpy as np
from av.video.stream import VideoStream
from numpy.typing import NDArray

from aqualvs.closing import Closing
from aqualvs.errors import OptionError, OutputError
from aqualvs.optics.shutter import Field

Codec: TypeAlias = Literal["h264", "lossless", "mjpeg"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Compression:
    """Compression of a video.

    Raises `OptionError` if a value makes no sense.
    """

    # {"h264", "lossless", "mjpeg"}: H.264 with chroma at half resolution (4:2:0), as ROVs record;
    # lossless H.264 in RGB; or every frame as a separate JPEG (4:2:0, full range), as from USB
    # cameras.
    codec: Codec = "h264"
    # Quality of "h264", 0 to 51; smaller is better. Ignored when `bit_rate` is given.
    crf: int = 20
    bit_rate: int | None = None  # Bits a second of "h264".
    jpeg_quality: int = 80  # Of "mjpeg", 1 to 100; larger is better.

    def __post_init__(self) -> None:
        if self.codec not in {"h264", "lossless", "mjpeg"}:
            raise OptionError(f"codec is {self.codec!r}; choose h264, lossless or mjpeg")
        if not 0 <= self.crf <= 51:
            raise OptionError(f"crf is {self.crf}; it must lie between 0 and 51")
        if self.bit_rate is not None and self.bit_rate <= 0:
            raise OptionError(f"bit rate is {self.bit_rate}; it must be positive")
        if not 1 <= self.jpeg_quality <= 100:
            raise OptionError(f"JPEG quality is {self.jpeg_quality}; it must lie between 1 and 100")


# Lossy encoders, in the order of preference.
_LOSSY = ("libx264", "libopenh264", "mpeg4")
_FALLBACK_BIT_RATE = 6_000_000
# OpenCV's CPU_AVX512_SKX, all that x264 asks for, which its Python module does not name.
_AVX_512 = 256
_CODECS = {"lossless": "libx264rgb", "mjpeg": "mjpeg"}


class VideoWriter(Closing):
    """Writer of RGB frames to a video file; use it as a context manager to close the file.

    Parameters
    ----------
    path : Path
        File to write; the suffix chooses the container.
    size_px : (int, int)
        Width and height of every frame.
    fps : float
        Frames a second.
    first_field : {"top", "bottom"} or None
        Field that comes first in interlaced pictures: "h264" codes them as such, with chroma of
        each field by itself, as capture devices do; the other codecs know no fields. None for
        whole pictures.

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
        recording: Compression | None = None,
        *,
        first_field: Field | None = None,
    ) -> None:
        self._recording = Compression() if recording is None else recording
        check_size(size_px, self._recording, first_field)
        if not 0.0 < fps <= 1000.0:
            raise OptionError(f"fps is {fps:g}; it must lie between 0 and 1000")
        self._path, self._n_frames, self._first_field = path, 0, first_field
        codec = _CODECS.get(self._recording.codec) or _lossy_codec()
        with _writing_video(path, ValueError):
            self._container = av.open(str(path), "w")
            rate = Fraction(fps).limit_denominator(1001)
            self._stream = cast(VideoStream, self._container.add_stream(codec, rate=rate))
            self._stream.width, self._stream.height = size_px
            self._set_quality(codec)
            self._container.start_encoding()

    def _set_quality(self, codec: str) -> None:
        stream, recording = self._stream, self._recording
        stream.pix_fmt = "yuv420p"
        if codec == "mjpeg":
            stream.pix_fmt = "yuvj420p"
        elif codec == "libx264rgb":
            stream.pix_fmt = "rgb24"
            stream.options = {"qp": "0", "preset": "veryfast"}
        elif codec == "libx264" and recording.bit_rate is None:
            stream.options = {"crf": str(recording.crf), "preset": "veryfast"}
        else:
            stream.bit_rate = recording.bit_rate or _FALLBACK_BIT_RATE
        if codec == "libx264":
            stream.options |= self._x264_options()

    def _x264_options(self) -> dict[str, str]:
        options: dict[str, str] = {}
        params = []
        if cv2.checkHardwareSupport(_AVX_512):
            # With it the x264 of 2025 makes another file of the same pictures each time, even in
            # one thread, unless `mbtree=0`.
            params.append("asm=AVX2")
        if self._first_field is not None:
            options["flags"] = "+ilme+ildct"
            params.append("tff=1" if self._first_field == "top" else "bff=1")
        return options | {"x264-params": ":".join(params)}

    def write(self, image: NDArray[np.uint8]) -> None:
        """Append one frame, uint8 RGB of shape (height, width, 3).

        Raises `OutputError` if it cannot be written.
        """
        if self._recording.codec == "mjpeg":
            packet = self._jpeg_packet(image)
            with _writing_video(self._path):
                self._container.mux(packet)
        else:
            self._encode(self._picture(np.ascontiguousarray(image)))
        self._n_frames += 1

    def close(self) -> None:
        """Flush the encoder and close the file."""
        try:
            if self._recording.codec != "mjpeg":
                self._encode(None)
        finally:
            self._container.close()

    def _picture(self, image: NDArray[np.uint8]) -> av.VideoFrame:
        if self._first_field is None or self._stream.pix_fmt != "yuv420p":
            return av.VideoFrame.from_ndarray(image, format="rgb24")
        # The conversion takes pictures for progressive, and would mix the colours of the fields.
        height, width = image.shape[:2]
        whole = np.empty((height * 3 // 2, width), np.uint8)
        for first in range(2):
            rows = np.ascontiguousarray(image[first::2])
            field = av.VideoFrame.from_ndarray(rows, "rgb24").reformat(format="yuv420p")
            planes = _planes(np.asarray(field.to_ndarray(), np.uint8), height // 2)
            for plane, part in zip(_planes(whole, height), planes, strict=True):
                plane[first::2] = part
        return av.VideoFrame.from_ndarray(whole, format="yuv420p")

    def _jpeg_packet(self, image: NDArray[np.uint8]) -> "av.Packet[Any]":
        """Return a frame as a JPEG with the standard tables, as from USB cameras."""
        packet = av.Packet(jpeg(image, self._recording.jpeg_quality))
        packet.stream = self._stream
        packet.time_base = 1 / cast(Fraction, self._stream.average_rate)
        packet.pts = packet.dts = self._n_frames
        packet.is_keyframe = True
        return packet

    def _encode(self, frame: av.VideoFrame | None) -> None:
        with _writing_video(self._path):
            self._container.mux(self._stream.encode(frame))


@contextlib.contextmanager
def _writing_video(path: Path, *more: type[Exception]) -> Iterator[None]:
    """Turn faults of the encoder and the disk, and `more`, into an `OutputError`."""
    faults: tuple[type[Exception], ...] = (OSError, av.error.FFmpegError, *more)
    try:
        yield
    except faults as error:
        raise OutputError(
            f"{path}: cannot write video ({error}); choose a folder that can be written, with "
            "space left"
        ) from None


def _planes(stacked: NDArray[np.uint8], height: int) -> tuple[NDArray[np.uint8], ...]:
    """Return views on Y, U and V of a 4:2:0 picture with its planes one after the other."""
    width = stacked.shape[1]
    chroma = stacked[height:].reshape(2, height // 2, width // 2)
    return stacked[:height], chroma[0], chroma[1]


def _lossy_codec() -> str:
    for name in _LOSSY:
        if name in av.codecs_available:
            return name
    raise OutputError(
        f"the installed PyAV has none of the encoders {', '.join(_LOSSY)}; install PyAV's wheel"
    )


def jpeg(image: NDArray[np.uint8], quality: int) -> bytes:
    """Return an RGB picture (height, width, 3) as a JPEG file, chroma at half resolution (4:2:0).

    `quality`: 1 to 100; larger is better.
    """
    how = [cv2.IMWRITE_JPEG_QUALITY, quality]
    how += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
    _, data = cv2.imencode(".jpg", image[..., ::-1], how)
    return data.tobytes()


def check_size(
    size_px: tuple[int, int], recording: Compression, first_field: Field | None, place: str = "size"
) -> None:
    """Raise `OptionError`, which names `place`, if a video cannot hold pictures of this size.

    `recording` and `first_field` are those of `VideoWriter`.
    """
    if recording.codec != "h264":
        return
    # Chroma has half the rows of the picture, or of each of its fields.
    sides = (2, 2) if first_field is None else (2, 4)
    width, height = (-(-side // by) * by for side, by in zip(size_px, sides, strict=True))
    if (width, height) == tuple(size_px):
        return
    needs = "4:2:0 video needs even sides"
    if first_field is not None:
        needs = "interlaced 4:2:0 video needs an even width and a height that 4 divides"
    raise OptionError(
        f"{place} is {size_px[0]}x{size_px[1]} px, but {needs}; write {width}x{height}"
    )
