"""Health of a live run: rates, delays, lasers that moved, and frozen pictures.

`FrozenPicture` detects a picture that stands still while its time stamps run on: encoders and
capture cards repeat their last picture when the camera fails, and the stream looks alive.
`DriftWatch` detects a laser that has moved, in a thread of its own, because its test takes long.
"""

import contextlib
import itertools
import math
import queue
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from aqualvs.errors import RigError
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.optics.rig import Rig
from aqualvs.recording.sample import Instants
from aqualvs.results.agreement import AgreementState, LaserAgreement
from aqualvs.scanning.posture import Reason
from aqualvs.scanning.scan import ImagePlane, Scan
from aqualvs.sources.base import Health, PartHealth, StageDelay, State

# Side of a cell in pixels; every fourth row of cells is compared.
_CELL, _EVERY = 8, 4
_ONES = np.ones(_CELL, np.float32)
# Number of stored changes of a live picture, and the least number for their quantile: a vehicle in
# swell has turned round by then, so that its slowest moments are known.
_N_KEPT, _N_KNOWN = 250, 50
_QUIET_QUANTILE = 0.05
# Width to which a picture is reduced for its motion, and the side of a patch there, in pixels.
_REDUCED_PX, _PATCH = 360, 16
# Share of the patches that are compared: those with the strongest edges. The quantile of their
# displacements leaves room for text that is drawn into the picture, whose edges never move.
_STRONG, _PATCH_QUANTILE = 0.15, 0.8
# Number of motions before a stop that give their median.
_N_BEFORE = 3
_EPS_S = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class FrozenOptions:
    """Thresholds by which a picture counts as frozen."""

    # Pictures so far apart, in seconds, are compared: long enough for cameras that repeat each
    # picture two or four times, as they do in dim light.
    span_s: float = 0.24
    # A greater change is never that of a frozen picture, in grey levels. An encoder's improvements
    # of a still are less after 0.4 s.
    greatest: float = 0.8
    # A smaller change is always that of a frozen picture, in grey levels.
    least: float = 0.1
    # Between these two: as share of the change that this stream shows at its quietest (5 % of its
    # last pictures change less).
    share: float = 0.65
    # Motion within `span_s`, in pixels of a picture that is reduced to a width of about 360, from
    # which on a sudden stop is one of the picture and not of the vehicle.
    motion: float = 0.15
    # The picture has stopped where its motion stays below this share of the motion before.
    stop: float = 0.25
    # For so long, in seconds. A vehicle that turns round stops for a moment: at constant
    # acceleration its motion, `stopped_s` / 2 from the turning point, is a third of the median over
    # the `span_s` before.
    stopped_s: float = 0.16
    # Within this time, in seconds, the changes of a stopped picture must fall below the limits
    # above, or it counts as live again.
    confirmed_s: float = 2.0


class _Patches(NamedTuple):
    """Patches of a reduced picture with the strongest edges."""

    at: IntArray  # Shape (N,): numbers of the patches.
    # Shape (N, pixels): derivative across the main direction of the edges of the patch.
    edges: NDArray[np.float32]
    # Shape (N, pixels): grey levels.
    pixels: NDArray[np.float32]


class _Kept(NamedTuple):
    """What is kept of a picture to compare later ones with."""

    time_s: float
    shape: tuple[int, int]
    cells: FloatArray
    patches: _Patches


class FrozenPicture:
    """Detector of frozen pictures: compares each with one a quarter of a second older.

    Two statistics tell. The *change* is the 99 % quantile, over cells of 8 x 8 pixels in a quarter
    of the rows, of how much a cell's mean luma has changed. Means separate motion, and noise of the
    sensor, from the encoder's changes of a still: it adds detail to the cells and leaves their
    means. A stripe that moves by a thirtieth of a pixel changes its cells by half a grey level.

    At low bit rates the encoder takes a second and more to improve a still. The *motion* tells
    earlier: the 80 % quantile of the displacements of patches across their edges. What an encoder
    improves moves no edge. A vehicle slows down little by little, and one that turns round moves
    again soon; a picture whose motion ends at once, and does not return, has stopped itself.
    """

    def __init__(self, options: FrozenOptions | None = None) -> None:
        self.options = options or FrozenOptions()
        self._changes: deque[float] = deque(maxlen=_N_KEPT)
        self._restart()

    def update(self, time_s: float, luma: ImagePlane) -> float:
        """Return for how long the picture has stood still at most, in seconds; 0 for a live one.

        `time_s`: by the stream's clock.
        """
        cells, reduced = _cell_means(luma), _reduced(luma)
        height, width = luma.shape
        gap_s = 2.0  # A stream that returns after this time counts as a new one, in seconds.
        if self._kept:
            last = self._kept[-1]
            if last.shape != luma.shape or not last.time_s <= time_s <= last.time_s + gap_s:
                self._restart()
        while len(self._kept) > 1 and time_s - self._kept[1].time_s >= self._span_s:
            self._kept.popleft()
        self._compare(time_s, cells, reduced)
        self._kept.append(_Kept(time_s, (height, width), cells, _strong_patches(reduced)))
        self._update_state(time_s)
        return 0.0 if math.isnan(self._since_s) else time_s - self._since_s

    def _restart(self) -> None:
        self._kept: deque[_Kept] = deque()
        self._span_s = self.options.span_s - _EPS_S
        self._motions: deque[tuple[float, float]] = deque()
        # Of the last picture, in grey levels, and in pixels of the reduced one; NaN where there was
        # nothing to compare.
        self.change = self.motion = math.nan
        self._assume_live()

    def _assume_live(self) -> None:
        """Take the picture for a live one."""
        self._since_s = self._moved_s = self._doubted_s = self._pace = self._moving_s = math.nan

    def _compare(self, time_s: float, cells: FloatArray, reduced: NDArray[np.float32]) -> None:
        """Compare with the oldest picture kept, if it is old enough."""
        quantile = 0.99  # Laser stripes fill at least a hundredth of a picture.
        self.change = self.motion = math.nan
        if not (self._kept and time_s - self._kept[0].time_s >= self._span_s) or not cells.size:
            return
        before = self._kept[0]
        self.change = _upper(np.abs(cells - before.cells).ravel(), quantile)
        if before.patches.at.size:
            displacements = np.abs(_displacements(before.patches, reduced))
            self.motion = _upper(displacements, _PATCH_QUANTILE)
            self._motions.append((time_s, self.motion))

    def _limit(self) -> float:
        """Return the change below which a picture stands still."""
        options = self.options
        if len(self._changes) < _N_KNOWN:
            return options.least
        quiet = float(np.quantile(np.array(self._changes), _QUIET_QUANTILE))
        return min(max(options.share * quiet, options.least), options.greatest)

    def _has_stopped(self, time_s: float) -> bool:
        """Return whether a motion has ended at once."""
        options = self.options
        stop_s = time_s - options.stopped_s - _EPS_S
        while self._motions and self._motions[0][0] < stop_s - options.span_s:
            self._motions.popleft()
        before = [motion for at_s, motion in self._motions if at_s < stop_s]
        if len(before) < _N_BEFORE:
            return False
        self._pace = float(np.median(before))
        self._moving_s = max(at_s for at_s, _ in self._motions if at_s < stop_s)
        lately = max(motion for at_s, motion in self._motions if at_s >= stop_s)
        return self._pace >= options.motion and lately < options.stop * self._pace

    def _update_state(self, time_s: float) -> None:
        if math.isnan(self.change):
            return
        still = self.change < self._limit()
        if not math.isnan(self._since_s):
            self._check_for_motion(time_s, still=still)
        elif still | self._has_stopped(time_s):
            # The picture before the stop was compared with one so old: all until that may be live.
            self._since_s = self._kept[0].time_s if still else self._moving_s - self._span_s
            self._doubted_s = math.nan if still else time_s
        else:
            self._changes.append(self.change)

    def _check_for_motion(self, time_s: float, *, still: bool) -> None:
        """Look for signs of life in a frozen picture."""
        if still:
            self._doubted_s = math.nan
        # A key frame moves the edges of a still a little; a live picture moves by more.
        if still or self.motion < min(0.5 * self._pace, self.options.motion):
            self._moved_s = math.nan
        elif math.isnan(self._moved_s):
            self._moved_s = time_s
        # A key frame changes a still once, so it affects the comparison for one span.
        moves = time_s - self._moved_s > self.options.span_s
        if moves or time_s - self._doubted_s > self.options.confirmed_s:
            self._assume_live()


def _upper(values: FloatArray | NDArray[np.float32], quantile: float) -> float:
    rank = min(int(quantile * values.size), values.size - 1)
    return float(np.partition(values, rank)[rank])


def _reduced(luma: ImagePlane) -> NDArray[np.float32]:
    """Return the picture reduced to whole patches, about `_REDUCED_PX` wide."""
    height, width = luma.shape
    factor = max(round(width / _REDUCED_PX), 1)
    rows, columns = (side // factor // _PATCH * _PATCH for side in (height, width))
    if not (rows and columns):
        return np.zeros((0, 0), np.float32)
    part = luma[: rows * factor, : columns * factor]
    small = cv2.resize(part, (columns, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32)


def _patches_at(image: NDArray[np.float32], at: IntArray) -> NDArray[np.float32]:
    """Return the pixels of some patches, shape (N, pixels)."""
    rows, columns = image.shape[0] // _PATCH, image.shape[1] // _PATCH
    row, column = np.divmod(at, columns)
    found = image.reshape(rows, _PATCH, columns, _PATCH)[row, :, column]
    return found.reshape(-1, _PATCH**2)


def _strong_patches(reduced: NDArray[np.float32]) -> _Patches:
    """Return the patches of a picture with the strongest edges."""
    if not reduced.size:
        return _Patches(np.empty(0, np.int64), reduced, reduced)
    along_x = cv2.Sobel(reduced, cv2.CV_32F, 1, 0, ksize=1, scale=0.5)
    along_y = cv2.Sobel(reduced, cv2.CV_32F, 0, 1, ksize=1, scale=0.5)
    rows, columns = reduced.shape[0] // _PATCH, reduced.shape[1] // _PATCH
    xx, xy, yy = (
        cv2.resize(a * b, (columns, rows), interpolation=cv2.INTER_AREA).ravel()
        for a, b in ((along_x, along_x), (along_x, along_y), (along_y, along_y))
    )
    # The greater eigenvalue of the structure tensor, and the direction across the edges.
    strength = 0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)
    n = max(int(_STRONG * strength.size), 1)
    at = np.argpartition(strength, -n)[-n:]
    angle = 0.5 * np.arctan2(2.0 * xy[at], xx[at] - yy[at])[:, None]
    edges = np.cos(angle) * _patches_at(along_x, at) + np.sin(angle) * _patches_at(along_y, at)
    return _Patches(at, edges, _patches_at(reduced, at))


def _displacements(before: _Patches, reduced: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return by how much patches have moved across their edges, in pixels; least squares."""
    flat = 1e-3  # Keeps patches without edges at rest, in squared grey levels per pixel.
    changes = _patches_at(reduced, before.at) - before.pixels
    squares = np.einsum("ij,ij->i", before.edges, before.edges)
    moved = np.einsum("ij,ij->i", before.edges, changes)
    return np.asarray(-moved / (squares + flat * _PATCH**2))


def _cell_means(luma: ImagePlane) -> FloatArray:
    """Return the means of the cells, shape (rows, columns)."""
    rows, columns = luma.shape[0] // (_EVERY * _CELL), luma.shape[1] // _CELL
    step = luma.strides[0]
    bands = np.lib.stride_tricks.as_strided(
        luma,
        (rows, _CELL, columns * _CELL),
        (_EVERY * _CELL * step, step, luma.strides[1]),
        writeable=False,
    )
    sums = bands[:, 0].astype(np.uint16)
    for k in range(1, _CELL):
        sums += bands[:, k]
    return np.asarray(sums.reshape(rows, columns, _CELL) @ _ONES / _CELL**2, np.float64)


_VERDICT_EVERY_S, _TIMEOUT_S = 5.0, 3.0


class DriftWatch:
    """Detector of lasers that moved: tests every few seconds, in a thread of its own.

    `rig`: with one laser, or without a dome, there is nothing to watch.
    """

    def __init__(self, rig: Rig) -> None:
        # Number of the laser to what is wrong with it; empty where nothing is.
        self.off: dict[int, str] = {}
        self._scans: queue.Queue[Scan | None] = queue.Queue(8)
        self._thread: threading.Thread | None = None
        agreement = None
        if rig.housing is not None and len(rig.lasers) > 1:
            # A rig's uncertainty that cannot be parsed is not needed to measure.
            with contextlib.suppress(RigError):
                agreement = LaserAgreement(rig)
        if agreement is not None:
            self._thread = threading.Thread(
                target=self._watch, args=(agreement,), name="drift", daemon=True
            )
            self._thread.start()

    def offer(self, scan: Scan) -> None:
        """Pass a scan on; scans are skipped while the thread is busy."""
        if self._thread is not None and not self._scans.full():
            self._scans.put_nowait(scan)

    def close(self) -> None:
        """End the thread."""
        if self._thread is None:
            return
        while not self._scans.empty():
            self._scans.get_nowait()
        self._scans.put(None)
        self._thread.join(_TIMEOUT_S)
        self._thread = None

    def _watch(self, agreement: LaserAgreement) -> None:
        judged_s = time.monotonic()
        while (scan := self._scans.get()) is not None:
            agreement.add(scan)
            if time.monotonic() - judged_s > _VERDICT_EVERY_S:
                self.off = suspects_of(agreement)
                judged_s = time.monotonic()


def suspects_of(agreement: LaserAgreement) -> dict[int, str]:
    """Return what is wrong with the lasers that may be off, by their numbers."""
    verdict = agreement.verdict()
    # A zoom moves the stripes of all lasers.
    is_zoomed = verdict.state is AgreementState.ZOOMED
    suspects = range(agreement.n_lasers) if is_zoomed else verdict.suspects
    return dict.fromkeys(suspects, verdict.sentence())


WINDOW_S = 5.0
"""Time over which rates and delays are taken, in seconds."""

STAGES = ("wait", "measure", "send", "total")
"""Delay from the decoded frame until the measuring thread takes it; of the measurement; of sending
to outputs that never wait; and of all of it."""

# A laser without points on the target for this time, while others have some, is off or covered.
_DARK_S = 2.0


class _FrameFigures(NamedTuple):
    """Figures kept of one frame."""

    at_ns: int
    valid: bool
    quality: float
    delays_s: tuple[float, float, float, float]


class HealthMonitor:
    """Health statistics, gathered frame by frame; `health` is cheap.

    `rig`: whose lasers are watched.
    """

    def __init__(self, rig: Rig) -> None:
        self._names = [laser.name for laser in rig.lasers]
        self._drift = DriftWatch(rig)
        self._frames: deque[_FrameFigures] = deque()
        self._lit_ns = [0] * len(self._names)
        self._valid_ns = 0
        self._n_frames = 0

    def add(self, scan: Scan, instants: Instants, sent_ns: int) -> None:
        """Take note of a frame that has been measured and sent."""
        if not scan.posture and scan.posture.reason is Reason.NO_FRAMES:
            return
        self._n_frames += 1
        used = scan.points.used
        quality = float(scan.points.quality[used].mean()) if used.any() else float("nan")
        times = (instants.arrived_ns, instants.taken_ns, instants.scanned_ns, sent_ns)
        wait, measure, send = (1e-9 * (b - a) for a, b in itertools.pairwise(times))
        delays_s = wait, measure, send, wait + measure + send
        self._frames.append(_FrameFigures(sent_ns, bool(scan.posture), quality, delays_s))
        if scan.posture:
            self._valid_ns = sent_ns
            for i in np.unique(scan.points.laser[used]).tolist():
                self._lit_ns[i] = sent_ns
        self._drift.offer(scan)

    def close(self) -> None:
        """Stop watching the lasers."""
        self._drift.close()

    def health(self, now_ns: int) -> Health:
        """Return the state of things, as far as the frames and the lasers show it."""
        while self._frames and now_ns - self._frames[0].at_ns > 1e9 * WINDOW_S:
            self._frames.popleft()
        recent = self._frames
        return Health(
            rate_hz=self._rate_hz(now_ns),
            valid_share=sum(p.valid for p in recent) / len(recent) if recent else float("nan"),
            n_frames=self._n_frames,
            delays=self._delays(),
            lasers=tuple(map(self._laser_health, range(len(self._names)))),
            quality=_mean([p.quality for p in recent]),
        )

    def _rate_hz(self, now_ns: int) -> float:
        n = len(self._frames) - 1
        if n < 1:
            return 0.0
        # While frames come the span ends with the last one; in silence the rate falls.
        span_ns = self._frames[-1].at_ns - self._frames[0].at_ns
        silent_ns, period_ns = now_ns - self._frames[-1].at_ns, span_ns / n
        return n / max(1e-9 * (span_ns + max(0.0, silent_ns - period_ns)), 1e-9)

    def _delays(self) -> tuple[StageDelay, ...]:
        if not self._frames:
            return ()
        delays = np.array([p.delays_s for p in self._frames])
        middle, worst = np.quantile(delays, [0.5, 0.99], axis=0)
        return tuple(
            StageDelay(name, float(m), float(w))
            for name, m, w in zip(STAGES, middle, worst, strict=True)
        )

    def _laser_health(self, i: int) -> PartHealth:
        name = self._names[i]
        if not self._valid_ns:
            return PartHealth(name, State.OFF, "not seen yet")
        dark_s = 1e-9 * (self._valid_ns - self._lit_ns[i])
        if dark_s > _DARK_S:
            return PartHealth(name, State.WARN, "not on the target: off, covered or out of view")
        off = self._drift.off.get(i, "")
        return PartHealth(name, State.WARN if off else State.OK, off)


def _mean(values: list[float]) -> float:
    known = [value for value in values if value == value]
    return sum(known) / len(known) if known else float("nan")
