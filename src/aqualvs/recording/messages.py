"""Messages of a recording and of Foxglove, and their creation from samples.

Their definitions are in `encoding.py`. All are in the frame `dome`, with angles in degrees, as
everywhere outside the library. Missing numbers are NaN.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from aqualvs.control.time_filter import FilteredPosture
from aqualvs.errors import OptionError
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import rig_to_mapping
from aqualvs.recording.encoding import (
    CHROMA,
    HEALTH,
    PICTURE,
    POINTS,
    POSTURE,
    RIG,
    STRIPES,
    CdrReader,
    CdrWriter,
    PictureFormat,
    RecordedTopic,
    jpeg_of,
    options_text,
    png_of,
    rig_exact,
)
from aqualvs.recording.sample import LiveSample
from aqualvs.scanner import ScannerOptions
from aqualvs.scanning.laser_bands import SearchAxis
from aqualvs.scanning.posture import Posture, Reason, Refusal, deviations
from aqualvs.scanning.scan import Frame, GyroRates, ScanPoints
from aqualvs.scanning.stripe import StripePeaks
from aqualvs.sources.base import Health, State
from aqualvs.yamlfile import rig_text

FRAME_ID = "dome"
_STATES = {State.OFF: 0, State.OK: 1, State.WARN: 2, State.FAULT: 3}
_POINT = np.dtype(
    [
        *((name, "<f4") for name in ("x", "y", "z", "quality")),
        *((name, "u1") for name in ("intensity", "laser", "label", "used")),
    ]
)


def posture_message(sample: LiveSample, stamp_ns: int) -> bytes:
    """Return the message with range, pitch and yaw, raw and filtered."""
    scan, posture, to = sample.scan, sample.scan.posture, CdrWriter()
    to.header(stamp_ns, FRAME_ID)
    to.numbers("q", scan.index)
    to.numbers("d", scan.time_s)
    to.numbers("?", bool(posture))
    to.text("" if isinstance(posture, Posture) else posture.reason.value)
    to.text("" if isinstance(posture, Posture) else posture.detail)
    values = _posture_values(posture)
    to.numbers("d", *values[:9], scan.n_water, *values[9:])
    to.numbers("i", posture.n_points if isinstance(posture, Posture) else 0, len(scan.points))
    filtered = sample.filtered
    to.numbers("?", filtered is not None, filtered is not None and filtered.accepted)
    to.numbers("d", *_filtered_values(filtered))
    instants = sample.instants
    to.numbers("d", 1e-9 * (instants.scanned_ns - instants.arrived_ns))
    to.numbers("d", *_rig_values(posture))
    return to.finish()


def stripes_message(sample: LiveSample, stamp_ns: int) -> bytes:
    """Return the message with the exact detected stripes, or the reason of a refusal."""
    scan, to = sample.scan, CdrWriter()
    refusal = scan.posture if not sample.peaks and not scan.posture else None
    to.header(stamp_ns, FRAME_ID)
    to.numbers("q", scan.index)
    to.numbers("d", scan.time_s, scan.n_water)
    to.text("" if refusal is None else refusal.reason.value)
    to.text("" if refusal is None else refusal.detail)
    to.numbers("I", len(sample.peaks))
    for axis, found in sample.peaks.items():
        to.text(axis.value)
        to.array(found.line.astype(np.uint32))
        for column in (found.position, found.height, found.width, found.likelihood):
            to.array(column)
    # New fields follow those of older recordings, so that one reader reads both.
    to.array(np.concatenate([np.empty(0), *(found.pull for found in sample.peaks.values())]))
    turning = scan.turning
    to.array(np.empty(0) if turning is None else np.append(turning.rates, turning.sigma))
    return to.finish()


@dataclass(frozen=True, slots=True)
class RecordedFrame:
    """Frame of a recording."""

    # As in `Frame`.
    index: int
    time_s: float

    n_water: float  # Refractive index of the water used for this frame.
    peaks: dict[SearchAxis, StripePeaks]  # Detected stripes.
    refusal: Refusal | None  # Reason if the frame was not measured; None if it was.
    turning: GyroRates | None  # Rates by the vehicle's gyros, if known.
    picture: Frame | None = None  # None if there is none, or pictures are not decoded.


def stripes_of(message: bytes) -> RecordedFrame:
    """Return the frame of a message, without its picture.

    Raises `ValueError` if the message is not from `stripes_message`.
    """
    of = CdrReader(message)
    of.header()
    index = of.number("q")
    time_s, n_water = of.numbers("d", 2)
    reason, detail = of.text(), of.text()
    peaks = {}
    for _ in range(of.number("I")):
        axis = SearchAxis(of.text())
        line = of.array("u4").astype(np.int64)
        measures = [of.array("f8") for _ in range(4)]
        if any(len(one) != len(line) for one in measures):
            raise ValueError(f"stripes of {len(line)} peaks have another number of measures")
        position, height, width, likelihood = measures
        # Recordings of 0.1.0 have grey levels here, of peaks that passed a colour gate, or NaN.
        likelihood = np.where(np.isnan(likelihood), 1.0, np.minimum(likelihood, 1.0))
        peaks[axis] = StripePeaks(line, position, height, width, likelihood, np.zeros(len(line)))
    if not of.at_end:
        *ends, n = np.cumsum([0, *(found.n for found in peaks.values())])
        pull = of.array("f8")
        if len(pull) != n:
            raise ValueError(f"stripes of {n} peaks have {len(pull)} pulls")
        pulls = np.split(pull, ends[1:])
        peaks = {
            axis: found._replace(pull=pull)
            for (axis, found), pull in zip(peaks.items(), pulls, strict=False)
        }
    gyros = np.empty(0) if of.at_end else of.array("f8")
    turning = GyroRates(gyros[:3], float(gyros[3])) if len(gyros) == 4 else None
    refusal = Refusal(Reason(reason), detail) if reason else None
    return RecordedFrame(index, time_s, n_water, peaks, refusal, turning)


def points_message(points: ScanPoints, stamp_ns: int) -> bytes:
    """Return the point cloud message; `label` is a number of `Label`, `laser` a laser's index."""
    cloud = np.empty(len(points), _POINT)
    cloud["x"], cloud["y"], cloud["z"] = points.points_in_dome.T
    cloud["quality"] = points.quality
    cloud["intensity"] = np.clip(points.intensity, 0.0, 255.0)
    cloud["laser"], cloud["label"], cloud["used"] = points.laser, points.label, points.used
    to = CdrWriter()
    to.header(stamp_ns, FRAME_ID)
    to.numbers("I", 1, len(points), len(_POINT.names or ()))
    float32, uint8 = 7, 2
    for name, (dtype, offset, *_) in (_POINT.fields or {}).items():
        to.text(name)
        to.numbers("I", offset)
        to.numbers("B", float32 if dtype.kind == "f" else uint8)
        to.numbers("I", 1)
    to.numbers("?", False)
    to.numbers("I", _POINT.itemsize, cloud.nbytes)
    to.blob(cloud.tobytes())
    to.numbers("?", True)
    return to.finish()


def health_message(health: Health, stamp_ns: int) -> bytes:
    """Return the message with the health of the run and its parts."""
    to = CdrWriter()
    to.header(stamp_ns, "")
    to.numbers("B", _STATES[health.state])
    to.numbers("d", health.rate_hz, health.valid_share, health.quality)
    to.numbers("d", health.n_water, health.sigma_n_water)
    to.numbers("q", health.n_frames, health.n_dropped, health.n_lost)
    parts = [("source", health.source)]
    parts += [("laser", part) for part in health.lasers]
    parts += [("output", part) for part in health.outputs]
    to.numbers("I", len(parts))
    for kind, part in parts:
        to.text(kind)
        to.text(part.name)
        to.numbers("B", _STATES[part.state])
        to.text(part.detail)
        to.numbers("q", part.n_dropped)
    to.numbers("I", len(health.delays))
    for delay in health.delays:
        to.text(delay.name)
        to.numbers("d", delay.median_s, delay.p99_s)
    return to.finish()


def rig_texts(rig: Rig, options: ScannerOptions) -> tuple[str, str, str]:
    """Return the texts of a rig message: rig file, exact numbers and scanner's options."""
    return rig_text(rig_to_mapping(rig)), rig_exact(rig), options_text(options)


def rig_message(texts: tuple[str, str, str], stamp_ns: int) -> bytes:
    """Return the message with rig and options, from `rig_texts`."""
    to = CdrWriter()
    to.header(stamp_ns, FRAME_ID)
    for text in texts:
        to.text(text)
    return to.finish()


def rig_texts_of(message: bytes) -> tuple[str, str, str]:
    """Return the rig file, its exact numbers and the scanner's options of a message.

    Raises `ValueError` if the message is not from `rig_message`.
    """
    of = CdrReader(message)
    of.header()
    return of.text(), of.text(), of.text()


def image_message(kind: str, data: bytes, stamp_ns: int) -> bytes:
    """Return the message with a picture; `kind` is jpeg or png."""
    to = CdrWriter()
    to.header(stamp_ns, "cam")
    to.text(kind)
    to.blob(data)
    return to.finish()


def image_of(message: bytes) -> tuple[str, bytes]:
    """Return kind and content of a picture's message.

    Raises `ValueError` if the message is not from `image_message`.
    """
    of = CdrReader(message)
    of.header()
    return of.text(), of.blob()


def _posture_values(posture: Posture | Refusal) -> list[float]:
    """Return nine scalars, normal (3), covariance (9) and curvatures (4)."""
    if not isinstance(posture, Posture):
        return [math.nan] * 25
    curvature = posture.curvature or (math.nan, math.nan)
    sigma_curvature = posture.sigma_curvature or (math.nan, math.nan)
    return [
        *(posture.range, math.degrees(posture.pitch), math.degrees(posture.yaw)),
        *deviations(posture.covariance),
        *(posture.slant_range, posture.nearest, posture.rms),
        *posture.normal_in_dome,
        *np.ravel(posture.covariance),
        *curvature,
        *sigma_curvature,
    ]


def _rig_values(posture: Posture | Refusal) -> list[float]:
    """Return standard deviations by the rig (3), total ones (3), and the rig's covariance (9)."""
    if not isinstance(posture, Posture):
        return [math.nan] * 15
    return [
        *deviations(posture.rig_covariance),
        *deviations(posture.total_covariance),
        *np.ravel(posture.rig_covariance),
    ]


def _filtered_values(filtered: FilteredPosture | None) -> list[float]:
    if filtered is None:
        return [math.nan] * 7
    rates: Any = filtered.rates
    return [
        *(filtered.range, math.degrees(filtered.pitch), math.degrees(filtered.yaw)),
        *(float(rates[0]), math.degrees(rates[1]), math.degrees(rates[2])),
        filtered.age_s,
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecorderOptions:
    """Options of a recording: its content, and how often it is written."""

    pictures: PictureFormat | None = None  # Format of all pictures; None leaves them out.
    jpeg_quality: int = 90  # 1 to 100.
    # Point clouds per second, for viewers only: stripes, from which all points can be computed
    # exactly, are always recorded. 0 for none, None for every frame.
    points_hz: float | None = 5.0
    # Options of the run, for replays.
    scanner: ScannerOptions = field(default_factory=ScannerOptions)
    # Interval of writing: data lost if the process is killed.
    chunk_s: float = 0.5
    # Interval of flushing to the disk: data lost after a loss of power. None leaves it to the
    # system.
    sync_s: float | None = 5.0
    # Limit of the memory for data that wait for the disk.
    max_waiting_bytes: int = 64 << 20

    def __post_init__(self) -> None:
        """Raise `OptionError` for values out of range."""
        if not 1 <= self.jpeg_quality <= 100:
            raise OptionError(f"jpeg quality {self.jpeg_quality}: use 1 to 100")
        if self.points_hz is not None and not self.points_hz >= 0.0:
            raise OptionError(f"points_hz {self.points_hz:g}: use 0 or more")


class SampleEncoder:
    """Encoder of samples as messages."""

    def __init__(self, options: RecorderOptions) -> None:
        self._options = options
        self._rig: Rig | None = None
        self._exact = ""
        self._rig_texts: tuple[str, str, str] | None = None
        self._rig_wait_ns = self._rig_from_ns = 0
        self._health_from_ns = 0
        hz = options.points_hz
        self._points_due = RateLimit(math.inf if hz is None else hz)

    def messages(self, sample: LiveSample, stamp_ns: int) -> Iterator[tuple[RecordedTopic, bytes]]:
        """Yield topic and content of each message; pictures precede the stripes of their frame."""
        yield from self.rig_messages(sample.rig, stamp_ns)
        if sample.frame is not None:
            yield from self._pictures(sample.frame, stamp_ns)
        posture = sample.scan.posture
        # A silent stream has no frame.
        if posture or posture.reason is not Reason.NO_FRAMES:
            yield STRIPES, stripes_message(sample, stamp_ns)
        yield POSTURE, posture_message(sample, stamp_ns)
        if len(sample.scan.points) and self._points_due.at(stamp_ns):
            yield POINTS, points_message(sample.scan.points, stamp_ns)
        health_every_ns = 1_000_000_000
        if stamp_ns >= self._health_from_ns:
            self._health_from_ns = stamp_ns + health_every_ns
            yield HEALTH, health_message(sample.health, stamp_ns)

    def rig_messages(self, rig: Rig, stamp_ns: int) -> Iterator[tuple[RecordedTopic, bytes]]:
        """Yield the rig's message if the rig has changed or is due again.

        A change of the water alone does not count: its index is in every frame.
        """
        # The rig is recorded again after a second, then at intervals that double up to a minute,
        # and at the end, so that damage of a part of the file does not lose it.
        rig_again_ns, rig_every_ns = 1_000_000_000, 60_000_000_000
        if self._is_new(rig):
            self._rig, self._exact = rig, rig_exact(rig)
            self._rig_texts = rig_texts(rig, self._options.scanner)
            self._rig_wait_ns = rig_again_ns
        elif stamp_ns >= self._rig_from_ns:
            self._rig_wait_ns = min(2 * self._rig_wait_ns, rig_every_ns)
        else:
            return
        self._rig_from_ns = stamp_ns + self._rig_wait_ns
        yield from self.rig_again(stamp_ns)

    def rig_again(self, stamp_ns: int) -> Iterator[tuple[RecordedTopic, bytes]]:
        """Yield the message of the last recorded rig again."""
        if self._rig_texts is not None:
            yield RIG, rig_message(self._rig_texts, stamp_ns)

    def _is_new(self, rig: Rig) -> bool:
        if self._rig is None:
            return True
        if rig is self._rig:
            return False
        return self._exact != rig_exact(rig.in_water(self._rig.n_water))

    def _pictures(self, frame: Frame, stamp_ns: int) -> Iterator[tuple[RecordedTopic, bytes]]:
        kind = self._options.pictures
        if kind is PictureFormat.JPEG:
            data = jpeg_of(frame, self._options.jpeg_quality)
            yield PICTURE, image_message(kind, data, stamp_ns)
        elif kind is PictureFormat.PNG:
            luma, chroma = png_of(frame)
            yield PICTURE, image_message(kind, luma, stamp_ns)
            if chroma is not None:
                yield CHROMA, image_message(kind, chroma, stamp_ns)


class RecordClock:
    """Clock of a recording, whose times always increase.

    It starts with the system's clock at the first sample, and continues with the monotonic clock.
    """

    def __init__(self) -> None:
        self._offset_ns: int | None = None
        self.last_ns = 0  # Time of the last sample.

    def stamp_ns(self, sample: LiveSample) -> int:
        """Return the time of a sample's arrival, nanoseconds since 1970."""
        arrived_ns = sample.instants.arrived_ns
        if self._offset_ns is None:
            self._offset_ns = sample.utc_ns - arrived_ns
        self.last_ns = max(self._offset_ns + arrived_ns, self.last_ns + 1)
        return self.last_ns


class RateLimit:
    """Rate limit of a message.

    `hz`: 0 for no message, infinite for all.
    """

    def __init__(self, hz: float) -> None:
        # A tenth of a period of tolerance: otherwise jitter would delay a message by a frame.
        self._every_ns = round(0.9e9 / hz) if hz else None
        self._from_ns = -math.inf

    def at(self, stamp_ns: int) -> bool:
        """Return whether the message is due; if so, start the next period."""
        if self._every_ns is None or stamp_ns < self._from_ns:
            return False
        self._from_ns = stamp_ns + self._every_ns
        return True
