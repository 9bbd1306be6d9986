"""Interfaces of all sources of frames, `FrameSource` and `Feed`, and their common parts."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol, Self, cast, runtime_checkable

import cv2
import numpy as np
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.plane import VideoPlane
from av.video.reformatter import ColorRange
from av.video.stream import VideoStream

from aqualvs.scanning.scan import Frame, ImagePlane, Planes


class State(StrEnum):
    """State of a part of the system; pilots see it as a colour."""

    OK = "ok"
    WARN = "warn"
    """Works, but not as it should."""
    FAULT = "fault"
    """Does not work; it is tried again."""
    OFF = "off"
    """Not in use."""


@dataclass(frozen=True, slots=True)
class PartHealth:
    """Health of one part: the stream, an output or a laser."""

    name: str
    state: State
    detail: str = ""  # In a few words, also for a part that is well.
    n_dropped: int = 0  # Samples, or frames, that it could not take.


@dataclass(frozen=True, slots=True)
class StageDelay:
    """Delay that a stage adds, over the last seconds, in seconds."""

    name: str
    median_s: float
    p99_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Health:
    """Health of a live run, over the last seconds."""

    rate_hz: float = 0.0  # Frames measured per second.
    valid_share: float = float("nan")  # Share of them with a posture; NaN without frames.
    # Since the start: measured; skipped because a newer one had come; not decoded.
    n_frames: int = 0
    n_dropped: int = 0
    n_lost: int = 0
    # From the decoded frame on.
    delays: tuple[StageDelay, ...] = ()

    source: PartHealth = field(default_factory=lambda: PartHealth("source", State.OFF))
    lasers: tuple[PartHealth, ...] = ()
    outputs: tuple[PartHealth, ...] = ()
    quality: float = float("nan")  # Mean stripe quality on the target, 0 to 1; NaN without points.
    # Refractive index in use, and its standard deviation where it is measured on line (else NaN).
    n_water: float = float("nan")
    sigma_n_water: float = float("nan")

    @property
    def state(self) -> State:
        """The worst state of any part in use."""
        parts = (self.source, *self.lasers, *self.outputs)
        order = (State.FAULT, State.WARN, State.OK)
        return next((s for s in order if any(part.state is s for part in parts)), State.OFF)


def bgr_of(frame: Frame) -> ImagePlane:
    """Return a frame as a BGR picture, shape (height, width, 3), grey where it has no chroma.

    A field has each of its rows twice, so that pixels of the picture lie where they do in the
    picture.
    """
    if frame.chroma is None:
        image = cast(ImagePlane, cv2.cvtColor(frame.luma, cv2.COLOR_GRAY2BGR))
    else:
        height, width = frame.luma.shape
        rows, columns = frame.chroma[0].shape
        i420 = np.empty((3 * rows, 2 * columns), np.uint8)
        # With an odd height or width, the even picture has a row or column too many.
        i420[: 2 * rows] = 0
        i420[:height, :width] = frame.luma
        i420[2 * rows :] = np.stack(frame.chroma).reshape(rows, 2 * columns)
        whole = cv2.cvtColor(i420, cv2.COLOR_YUV2BGR_I420)
        image = np.ascontiguousarray(whole[:height, :width], dtype=np.uint8)
    return image if frame.field is None else np.repeat(image, 2, axis=0)


def planes_of(picture: VideoFrame) -> Planes:
    """Return luma, shape (height, width), and chroma of a decoded picture.

    Chroma is U and V, shape (ceil(height/2), ceil(width/2)), or None for a grey picture. Pictures
    in 4:2:0 with 8 bits and in 8-bit grey are viewed in place, others converted. The arrays keep
    the decoder's buffer alive, and are read-only, because it still predicts later pictures from it.
    """
    kind = picture.format.name
    if kind in ("yuv420p", "yuvj420p"):
        y, u, v = picture.planes
        return _view(y), (_view(u), _view(v))
    if kind == "nv12":
        y, uv = picture.planes
        return _view(y), (_view(uv, first=0, step=2), _view(uv, first=1, step=2))
    if kind == "gray":
        return _view(picture.planes[0]), None
    # In the same range, so that luma keeps its values.
    full = kind.startswith("yuvj") or picture.color_range == int(ColorRange.JPEG)
    return planes_of(picture.reformat(format="yuvj420p" if full else "yuv420p"))


def _view(plane: VideoPlane, *, first: int = 0, step: int = 1) -> ImagePlane:
    """Return a read-only view on every `step`-th byte of a plane's rows."""
    strides = (plane.line_size, step)
    shape = (plane.height, plane.width)
    view: ImagePlane = np.ndarray(shape, np.uint8, memoryview(plane), first, strides)
    view.flags.writeable = False
    return view


def frame_of(index: int, time_s: float, picture: VideoFrame) -> Frame:
    """Return the frame that a decoded picture makes, as `planes_of` takes it."""
    luma, chroma = planes_of(picture)
    return Frame(index, time_s, luma, chroma, is_interlaced=bool(picture.interlaced_frame))


def packet_with(data: bytes) -> "Packet[VideoStream]":
    """Return a packet with a copy of one coded picture.

    Decoders read a few dozen bytes beyond a packet's end and count on zeros there
    (AV_INPUT_BUFFER_PADDING_SIZE of FFmpeg). Memory that FFmpeg allocates has them; Python's bytes
    end where they end, so that an intact picture may count as damaged.
    """
    packet = cast("Packet[VideoStream]", Packet(len(data)))
    packet.update(data)
    return packet


class Feed(Protocol):
    """Frames of a live stream, which may stall, change its size, break off and return."""

    name: str  # In health reports and messages.

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames until the source ends (a file) or `close` is called (a stream).

        `Frame.index` rises strictly, `Frame.time_s` never falls, also over a reconnection; a gap
        in the index says that frames were lost. Frames may change their size.

        Raises `SourceError` if it can never work: no such file, no such camera. A stream that is
        merely not there is tried again.
        """

    def health(self) -> PartHealth:
        """Return how the source is; called from another thread."""

    def close(self) -> None:
        """End the iteration within a second; called from another thread."""


@runtime_checkable
class FrameSource(Protocol):
    """Frames in the order of their time; a context manager that can be iterated once.

    `Frame.index` rises strictly. A gap in it says that the frames in between existed but could
    not be decoded. A source that ends before its promise, or whose last frames are lost, delivers
    what it has and then raises `SourceError`.
    """

    name: str  # How messages call it: a path or an address.
    size_px: tuple[int, int]  # Width and height, the same for every frame.

    @property
    def fps(self) -> float | None:
        """Nominal frame rate; None where there is none."""

    @property
    def n_frames(self) -> int | None:
        """Frames that the container promises, perhaps estimated; None for a live stream."""

    def __iter__(self) -> Iterator[Frame]: ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...
