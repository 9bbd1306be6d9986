"""Selection of the frames that a report shows, decoded again from the source."""

import contextlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from fractions import Fraction
from html import escape
from pathlib import Path

import av
import cv2
import numpy as np
from av.container import InputContainer

from aqualvs.errors import SourceError
from aqualvs.geometry.arrays import IntArray
from aqualvs.optics.shutter import FIRST_ROW
from aqualvs.report import html
from aqualvs.report.charts import stretches
from aqualvs.report.overlay import draw_points
from aqualvs.report.points import FramePoints
from aqualvs.report.run_data import Track
from aqualvs.scanning.posture import Reason
from aqualvs.scanning.scan import ImagePlane
from aqualvs.sources.base import bgr_of
from aqualvs.sources.images import IMAGE_SUFFIXES, images_in, read_image
from aqualvs.sources.spans import has_decoding_times
from aqualvs.sources.video import VideoSource
from aqualvs.text import bgr

N_PICTURES = 6
N_SAMPLES = 24


# What a file raises that is no video, has no picture, or breaks off.
_BROKEN = (av.error.FFmpegError, OSError, IndexError, StopIteration)
# Colour at full resolution, else the lasers' colours bleed into the green stripes below.
_JPEG = (
    *(cv2.IMWRITE_JPEG_QUALITY, 80),
    *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
)
_HOLE_COLOUR = bgr("#ffb347")


@dataclass(frozen=True, slots=True)
class SampleFrame:
    """A sample frame ready for the page."""

    address: str  # With the picture in it.
    size_px: tuple[int, int]  # Width and height as embedded.
    # Share of the target points that lie on a saturated pixel; NaN without target points.
    saturated: float = float("nan")

    def tag(self, words: str) -> html.Raw:
        """Return the picture as HTML, with words for those who cannot see it."""
        width, height = self.size_px
        return html.Raw(
            f'<img src="{self.address}" width="{width}" height="{height}" alt="{escape(words)}">'
        )


def choose_pictures(track: Track, source: Path | None = None) -> list[int]:
    """Return rows of the frames worth a picture: refusals, the worst posture, an even spread.

    `source`: of a video, those of the spread are at key frames where one is near: others can only
    be decoded with all frames from there on.
    """
    chosen = _refused_rows(track)
    spread = np.arange(len(track))
    valid = np.flatnonzero(track.valid)
    if len(valid):
        relative = track.sigma[valid, 0] / track.posture[valid, 0]
        chosen.append(int(valid[np.nan_to_num(relative).argmax()]))
        spread = valid
    special = set(chosen)
    while len(set(chosen)) < min(N_PICTURES, len(set(chosen) | set(spread.tolist()))):
        chosen.append(_farthest(spread, chosen))
    rows = sorted(set(chosen))
    if source is None or not source.is_file():
        return rows
    ordinary = [row for row in rows if row not in special]
    for row, moved in zip(ordinary, _rows_at_key_frames(source, track, ordinary), strict=False):
        if moved not in chosen and moved in spread and row - moved <= len(track) / N_PICTURES:
            chosen[chosen.index(row)] = moved
    return sorted(set(chosen))


def choose_samples(track: Track, pictures: list[int]) -> list[int]:
    """Return rows for the laser-plane view: the pictures' and an even spread over the dive."""
    even = _evenly(np.arange(len(track)), N_SAMPLES)
    room = N_SAMPLES - len(pictures)
    others = [row for row in even if row not in pictures]
    return sorted([*pictures, *(others[i] for i in _evenly(np.arange(len(others)), room))])


def decode_frames(source: Path, track: Track, rows: list[int]) -> dict[int, ImagePlane]:
    """Decode the frames of some rows again: BGR pictures by row, those absent that cannot be."""
    if source.is_dir():
        return _from_images(images_in(source), track, rows)
    if source.suffix.lower() in IMAGE_SUFFIXES:
        return _from_images([source], track, rows)
    if _has_decoding_times(source):
        return _from_beginning(source, track, rows)
    decoders = 2
    with ThreadPoolExecutor(decoders) as pool:
        parts = [rows[i::decoders] for i in range(decoders)]
        found = pool.map(lambda part: _from_video(source, track, part), parts)
        return {row: picture for pictures in found for row, picture in pictures.items()}


def make_picture(image: ImagePlane, points: FramePoints | None) -> SampleFrame:
    """Draw the points of a frame into its picture and compress it for the page."""
    width_px = 800
    scale = min(1.0, width_px / image.shape[1])
    small = image
    if scale < 1.0:
        resized = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        small = np.asarray(resized, np.uint8)
    if points is not None:
        pixels = (points.pixels + 0.5) * scale - 0.5
        small = draw_points(small, points.laser, pixels, points.used)
    return replace(_embedded(small), saturated=saturated_share(image, points))


def make_crop(image: ImagePlane, middle: tuple[float, float], diameter: float) -> SampleFrame:
    """Cut the surroundings of a place out of a BGR picture, with a ring around the place.

    `middle`: its column and row. `diameter`: of the ring, in pixels.
    """
    # Pictures of holes: least side and size on the page in pixels, and hole diameters across.
    px, shown_px, diameters = 160, 320, 2.5
    height, width = map(int, image.shape[:2])
    side = min(round(max(diameters * diameter, px)), width, height)
    left, top = (
        min(max(round(at - 0.5 * side), 0), most - side)
        for at, most in zip(middle, (width, height), strict=True)
    )
    crop = image[top : top + side, left : left + side]
    scale = shown_px / side
    shown = cv2.resize(crop, (shown_px, shown_px), interpolation=cv2.INTER_AREA)
    centre = (round(scale * (middle[0] - left)), round(scale * (middle[1] - top)))
    radius = round(0.5 * scale * diameter)
    cv2.circle(shown, centre, radius, _HOLE_COLOUR, 2, cv2.LINE_AA)
    return _embedded(np.asarray(shown, np.uint8))


def _embedded(image: ImagePlane) -> SampleFrame:
    _, jpeg = cv2.imencode(".jpg", image, _JPEG)
    return SampleFrame(html.data_url(jpeg.tobytes(), "jpeg"), (image.shape[1], image.shape[0]))


def saturated_share(image: ImagePlane, points: FramePoints | None) -> float:
    """Return the share of target points on a pixel with a channel at 250 or above."""
    if points is None:
        return float("nan")
    pixels = points.pixels[points.used & np.isfinite(points.pixels).all(axis=1)]
    columns, rows = np.round(pixels).astype(np.int64).T
    inside = (rows >= 0) & (rows < image.shape[0]) & (columns >= 0) & (columns < image.shape[1])
    if not inside.any():
        return float("nan")
    brightest = image[rows[inside], columns[inside]].max(axis=-1)
    saturated = 250
    return float((brightest >= saturated).mean())


def _refused_rows(track: Track) -> list[int]:
    """Return the middle of the longest refusal, for the two commonest reasons with a picture."""
    longest: dict[str, tuple[int, int]] = {}
    for stretch in stretches(track):
        middle = (stretch.first + stretch.last) // 2
        reason = track.reasons[track.reason[middle]]
        length = stretch.last - stretch.first + 1
        if reason != Reason.CORRUPT_FRAME and length > longest.get(reason, (0, 0))[0]:
            longest[reason] = (length, middle)
    return [middle for _, middle in sorted(longest.values(), reverse=True)[:2]]


def _evenly(rows: IntArray, count: int) -> list[int]:
    """Return `count` of `rows`, evenly spread, both ends included."""
    if count <= 0 or not len(rows):
        return []
    places = np.linspace(0, len(rows) - 1, count).round().astype(int).tolist()
    return [int(rows[i]) for i in dict.fromkeys(places)]


def _farthest(rows: IntArray, chosen: list[int]) -> int:
    """Return the row that lies farthest from all chosen ones."""
    if not chosen:
        return int(rows[0])
    distance = np.abs(rows[:, None] - np.array(chosen)).min(axis=1)
    return int(rows[distance.argmax()])


def _from_images(files: list[Path], track: Track, rows: list[int]) -> dict[int, ImagePlane]:
    pictures = {}
    for row in rows:
        number, _ = _picture_of(track, row)
        image = read_image(files[number], cv2.IMREAD_COLOR) if number < len(files) else None
        if image is not None:
            pictures[row] = _shown(image, track, row)
    return pictures


def _from_video(source: Path, track: Track, rows: list[int]) -> dict[int, ImagePlane]:
    """Return pictures by row; a broken file gives what came before the fault.

    Jumps to the key frame before each frame that is wanted.
    """
    pictures: dict[int, ImagePlane] = {}
    half = 0.5 * _step_s(track)
    with contextlib.suppress(*_BROKEN), av.open(str(source)) as container:
        stream = container.streams.video[0]
        stream.codec_context.thread_count = 1
        start = next(container.decode(stream)).time or 0.0
        for row in rows:
            wanted = start + _picture_of(track, row)[1]
            _seek(container, wanted)
            decoded = (one for one in container.decode(video=0) if one.time is not None)
            found = next((one for one in decoded if one.time >= wanted - half), None)
            if found is not None and abs((found.time or 0.0) - wanted) <= 2.0 * half:
                image = np.asarray(found.to_ndarray(format="bgr24"), dtype=np.uint8)
                pictures[row] = _shown(image, track, row)
    return pictures


def _has_decoding_times(source: Path) -> bool:
    with contextlib.suppress(*_BROKEN), av.open(str(source)) as container:
        return has_decoding_times(container.streams.video[0])
    return False


def _from_beginning(source: Path, track: Track, rows: list[int]) -> dict[int, ImagePlane]:
    """Return pictures by row from a video whose times do not tell which picture is which."""
    pictures: dict[int, ImagePlane] = {}
    left = {row: _picture_of(track, row)[0] for row in rows}
    with contextlib.suppress(SourceError), VideoSource(source) as frames:
        for frame in frames:
            for row in [row for row, number in left.items() if number == frame.index]:
                pictures[row] = _shown(bgr_of(frame), track, row)
                del left[row]
            if not left:
                break
    return pictures


def _picture_of(track: Track, row: int) -> tuple[int, float]:
    """Return number and time of the picture that a frame is, or is a field of."""
    frame, time_s = int(track.frame[row]), float(track.time_s[row])
    if track.first_field is None:
        return frame, time_s
    return frame // 2, time_s - frame % 2 * _step_s(track)


def _shown(image: ImagePlane, track: Track, row: int) -> ImagePlane:
    """Return a picture, or the rows of the frame's field, each twice."""
    if track.first_field is None:
        return image
    first = (FIRST_ROW[track.first_field] + int(track.frame[row])) % 2
    return np.repeat(image[first::2], 2, axis=0)[: len(image)]


def _rows_at_key_frames(source: Path, track: Track, rows: list[int]) -> list[int]:
    """Return the row of the last key frame up to each row, as far as the file states it."""
    found: list[int] = []
    half = 0.5 * _step_s(track)
    with contextlib.suppress(*_BROKEN), av.open(str(source)) as container:
        start = _next_time(container)
        for row in rows:
            _seek(container, start + float(track.time_s[row]))
            time_s = _next_time(container) - start
            found.append(min(int(np.searchsorted(track.time_s, time_s - half)), row))
    return found


def _next_time(container: InputContainer) -> float:
    """Return the time at which the next packet's picture is shown."""
    packet = next(container.demux(video=0))
    return float(packet.pts or 0) * float(packet.time_base or 0.0)


def _seek(container: InputContainer, time_s: float) -> None:
    stream = container.streams.video[0]
    base = stream.time_base or Fraction(1, 90_000)
    container.seek(round(time_s / base), stream=stream, backward=True)


def _step_s(track: Track) -> float:
    """Return the usual time between frames of the source, in seconds."""
    frames = np.diff(track.frame)
    if not len(frames):
        return 0.04
    return float(np.nanmedian(np.diff(track.time_s) / np.maximum(frames, 1)))
