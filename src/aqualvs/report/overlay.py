"""Overlay of stripe points and posture on a picture, and the video of such pictures."""

import math
import re
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from av.container import OutputContainer
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from numpy.typing import NDArray

from aqualvs.closing import Closing
from aqualvs.errors import OutputError
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.optics.rig import Rig
from aqualvs.scanning.posture import Posture, Refusal, deviations
from aqualvs.scanning.scan import ImagePlane, ScanPoints
from aqualvs.text import bgr, laser_colour, reason_text

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_AMBER = bgr("#F0E442")
_DOT = tuple((y, x) for y in (-1, 0, 1) for x in (-1, 0, 1))


def draw_overlay(
    image: ImagePlane, points: ScanPoints, posture: Posture | Refusal, rig: Rig
) -> ImagePlane:
    """Draw the stripe points, the posture with its sigma or the refusal, and the lasers' names.

    Target points are drawn full in their laser's colour, all others as faint crosses, into a copy
    of a BGR picture of shape (height, width, 3).
    """
    drawn = draw_points(image, points.laser, points.pixels, points.used)
    draw_caption(drawn, posture_lines(posture), warn=not posture)
    draw_legend(drawn, [laser.name for laser in rig.lasers])
    return drawn


def draw_points(
    image: ImagePlane, laser: NDArray[np.integer], pixels: FloatArray, used: BoolArray
) -> ImagePlane:
    """Return a copy of a BGR picture (height, width, 3) with N stripe points drawn into it.

    `pixels`, shape (N, 2): those outside of the picture, or not finite, are left out. `used`,
    shape (N,): points that entered the posture become dots; others are faint crosses.
    """
    drawn = np.array(image, dtype=np.uint8)
    scale = max(1, round(int(drawn.shape[0]) / 800))
    finite = np.isfinite(pixels).all(axis=1)
    cross = ((-2, -2), (-1, -1), (1, 1), (2, 2), (-2, 2), (-1, 1), (1, -1), (2, -2))
    faint = 0.45
    for index in np.unique(laser):
        colour = np.array(bgr(laser_colour(int(index))), dtype=np.float64)
        mine = finite & (laser == index)
        _stamp(drawn, pixels[mine & ~used], _grown(cross, scale), colour, faint)
        _stamp(drawn, pixels[mine & used], _grown(_DOT, scale), colour, 1.0)
    return drawn


def posture_lines(posture: Posture | Refusal) -> list[str]:
    """Return what the overlay says of a posture, line by line."""
    if isinstance(posture, Refusal):
        lines = ["no posture", reason_text(posture.reason)]
        return [*lines, posture.detail] if posture.detail else lines
    sigma_range, sigma_pitch, sigma_yaw = deviations(posture.total_covariance)
    pitch, yaw = math.degrees(posture.pitch), math.degrees(posture.yaw)
    return [
        f"range {posture.range * 1e3:7.1f} ± {sigma_range * 1e3:.1f} mm",
        f"pitch {pitch:+7.2f} ± {sigma_pitch:.2f}°",
        f"yaw   {yaw:+7.2f} ± {sigma_yaw:.2f}°",
    ]


def draw_caption(image: ImagePlane, lines: list[str], *, warn: bool) -> None:
    """Write lines into the top left corner, on a darkened ground; changes `image`."""
    size = _font_size(image)
    step = round(34 * size)
    width = max(_text_width(line, size) for line in lines) + round(24 * size)
    ground = image[: step * len(lines) + round(16 * size), :width]
    ground[:] = ground // 4
    white = (255, 255, 255)
    for row, line in enumerate(lines):
        _put(image, line, (round(12 * size), (row + 1) * step), size, _AMBER if warn else white)


def draw_legend(image: ImagePlane, names: list[str]) -> None:
    """Write the lasers' names in their colours along the lower edge; changes `image`."""
    size = 0.8 * _font_size(image)
    strip = image[image.shape[0] - round(34 * size) :]
    strip[:] = strip // 4
    x, y = round(12 * size), image.shape[0] - round(11 * size)
    for index, name in enumerate(names):
        _put(image, name, (x, y), size, bgr(laser_colour(index)))
        x += _text_width(name, size) + round(24 * size)


class OverlayWriter(Closing):
    """Write pictures to an MP4 that stays readable if the program dies before `close`.

    `size`: width and height of the pictures; an odd one is padded to even, as H.264 needs. Raises
    `OutputError` if the file cannot be written.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: float) -> None:
        self._size = size
        self._closed = False
        # A fragment per key frame needs no index at the end of the file.
        flags = {"movflags": "frag_keyframe+empty_moov+default_base_moof", "flush_packets": "1"}
        try:
            self._container: OutputContainer = av.open(str(path), "w", format="mp4", options=flags)
            self._stream = _video_stream(self._container, size, fps)
            self._container.start_encoding()
        except OSError as fault:
            raise OutputError(
                f"{path}: cannot write the overlay video ({fault.strerror}); "
                "choose a folder that can be written"
            ) from fault

    def write(self, image: ImagePlane) -> None:
        """Append a BGR picture of the size given at the start.

        Raises `ValueError` if the picture has another size.
        """
        width, height = self._size
        if image.shape != (height, width, 3):
            raise ValueError(f"picture has shape {image.shape}, expected {(height, width, 3)}")
        even = cv2.copyMakeBorder(image, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
        picture = VideoFrame.from_ndarray(np.asarray(even, dtype=np.uint8), format="bgr24")
        self._container.mux(self._stream.encode(picture))

    def close(self) -> None:
        """Finish the file; further calls do nothing."""
        if self._closed:
            return
        self._closed = True
        self._container.mux(self._stream.encode(None))
        self._container.close()


def _video_stream(container: OutputContainer, size: tuple[int, int], fps: float) -> VideoStream:
    codec = "libx264" if "libx264" in av.codecs_available else "mpeg4"
    rate = Fraction(fps).limit_denominator(1001)
    stream = container.add_stream(codec, rate=rate)
    assert isinstance(stream, VideoStream)
    stream.width, stream.height = size[0] + size[0] % 2, size[1] + size[1] % 2
    stream.pix_fmt = "yuv420p"
    stream.codec_context.gop_size = max(1, round(2 * fps))
    if codec == "libx264":
        stream.options = {"preset": "veryfast", "crf": "20", "tune": "zerolatency"}
    return stream


def _font_size(image: ImagePlane) -> float:
    height, width = map(int, image.shape[:2])
    return max(0.4, min(height / 900, width / 700))


def _grown(stamp: tuple[tuple[int, int], ...], scale: int) -> NDArray[np.int64]:
    """Return a stamp's pixels, each grown to a square of `scale` pixels."""
    square = [(i, j) for i in range(scale) for j in range(scale)]
    return np.array([(y * scale + i, x * scale + j) for y, x in stamp for i, j in square])


def _stamp(
    image: ImagePlane, pixels: FloatArray, stamp: NDArray[np.int64], colour: FloatArray, ink: float
) -> None:
    """Blend `colour` into the stamp's pixels around every point."""
    height, width = image.shape[:2]
    centre = np.clip(np.round(pixels[:, ::-1]), -1e6, 1e6).astype(np.int64)
    spots = (centre[:, None, :] + stamp[None, :, :]).reshape(-1, 2)
    inside = ((spots >= 0) & (spots < (height, width))).all(axis=1)
    rows, columns = spots[inside].T
    image[rows, columns] = np.round((1.0 - ink) * image[rows, columns] + ink * colour)


def _text_width(text: str, size: float) -> int:
    return sum(
        round(18 * size)
        if part in "±°"
        else cv2.getTextSize(part, _FONT, size, _thickness(size))[0][0]
        for part in _drawable(text)
    )


def _thickness(size: float) -> int:
    return max(1, round(2 * size))


def _drawable(text: str) -> list[str]:
    """Split a text into what the font can draw and the two signs that it lacks."""
    safe = "".join(c if " " <= c <= "~" or c in "±°" else "?" for c in text)
    return [part for part in re.split("([±°])", safe) if part]


def _put(
    image: ImagePlane, text: str, at: tuple[int, int], size: float, colour: tuple[int, int, int]
) -> None:
    """Write text with its baseline at `at`."""
    x, y = at
    thick = _thickness(size)
    for part in _drawable(text):
        if part == "±":
            _plus_minus(image, (x, y), size, colour, thick)
        elif part == "°":
            centre = (x + round(6 * size), y - round(18 * size))
            cv2.circle(image, centre, max(1, round(3.5 * size)), colour, thick, cv2.LINE_AA)
        else:
            cv2.putText(image, part, (x, y), _FONT, size, colour, thick, cv2.LINE_AA)
        x += _text_width(part, size)


def _plus_minus(
    image: ImagePlane, at: tuple[int, int], size: float, colour: tuple[int, int, int], thick: int
) -> None:
    left, right = at[0] + round(2 * size), at[0] + round(15 * size)
    centre, middle, reach = (left + right) // 2, at[1] - round(11 * size), round(6 * size)
    bars = (
        ((left, middle), (right, middle)),
        ((centre, middle - reach), (centre, middle + reach)),
        ((left, at[1] - 1), (right, at[1] - 1)),
    )
    for start, end in bars:
        cv2.line(image, start, end, colour, thick, cv2.LINE_AA)
