"""Health of a live run: rates, delays, lasers that moved, and frozen pictures.

`FrozenPicture` detects a picture that stands still while its time stamps run on: encoders and
capture cards repeat their last picture when the camera fails, and the stream looks alive.
`DriftWatch` detects a laser that has moved, in a thread of its own, because its test takes long.
"""

import itertools
import math
import queue
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.errors import OptionError, RigError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.rig import Rig
from aqualvs.recording.sample import Instants
from aqualvs.scanning.agreement import AgreementState, LaserAgreement
from aqualvs.scanning.posture import Reason
from aqualvs.scanning.scan import ImagePlane, Scan
from aqualvs.sources.base import Health, PartHealth, StageDelay, State

# Side of a cell in pixels; every fourth row of cells is compared.
_CELL, _EVERY = 8, 4
_ONES = np.ones(_CELL, np.float32)
# Laser stripes fill at least a hundredth of a picture.
_QUANTILE = 0.99
# Number of stored changes of a live picture, and the least number for their quantile.
_N_KEPT, _N_KNOWN = 250, 25
_USUAL = 0.05
# A stream that returns after this time counts as a new one, in seconds.
_GAP_S = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FrozenOptions:
    """Thresholds by which a picture counts as frozen.

    Attributes
    ----------
    span_s : float
        Pictures so far apart, in seconds, are compared: long enough for cameras that repeat each
        picture two or four times, as they do in dim light.
    greatest : float
        A greater change is never that of a frozen picture, in grey levels. An encoder's
        improvements of a still are less after 0.4 s.
    least : float
        A smaller change is always that of a frozen picture, in grey levels.
    share : float
        Between these two: as share of the change that this stream shows at its quietest (5 % of
        its last pictures change less).
    """

    span_s: float = 0.24
    greatest: float = 0.8
    least: float = 0.1
    share: float = 0.65

    def __post_init__(self) -> None:
        """Refuse impossible values.

        Raises
        ------
        OptionError
            Naming the value.
        """
        for name in ("span_s", "greatest", "least", "share"):
            value = getattr(self, name)
            if not (value > 0.0 and math.isfinite(value)):
                raise OptionError(f"frozen pictures, {name} {value:g}: must be positive")


class FrozenPicture:
    """Detector of frozen pictures: compares each with one a quarter of a second older.

    The statistic is the 99 % quantile, over cells of 8 x 8 pixels in a quarter of the rows, of how
    much a cell's mean luma has changed. Means separate motion, and noise of the sensor, from the
    encoder's changes of a still: it adds detail to the cells and leaves their means. A stripe that
    moves by a thirtieth of a pixel changes its cells by half a grey level.

    Parameters
    ----------
    options : FrozenOptions, optional
        Defaults if left out.

    Attributes
    ----------
    change : float
        The statistic of the last picture, in grey levels; NaN where there was nothing to compare.
    """

    def __init__(self, options: FrozenOptions | None = None) -> None:
        self.options = options or FrozenOptions()
        self._usual: deque[float] = deque(maxlen=_N_KEPT)
        self._begin()

    def update(self, time_s: float, luma: ImagePlane) -> float:
        """Return for how long the picture has stood still, in seconds; 0 for a live one.

        Parameters
        ----------
        time_s : float
            By the stream's clock.
        luma : uint8 array, shape (height, width)
        """
        cells = _cell_means(luma)
        if self._kept and not self._continues(time_s, cells):
            self._begin()
        while len(self._kept) > 1 and time_s - self._kept[1][0] >= self._span_s:
            self._kept.popleft()
        self._change_since(time_s, cells)
        self._kept.append((time_s, cells))
        self._judge(time_s)
        return 0.0 if math.isnan(self._since_s) else time_s - self._since_s

    def _begin(self) -> None:
        self._kept: deque[tuple[float, FloatArray]] = deque()
        self._span_s = self.options.span_s - 1e-6
        self.change = math.nan
        self._since_s = self._moved_s = math.nan

    def _continues(self, time_s: float, cells: FloatArray) -> bool:
        last_s, last = self._kept[-1]
        return last_s <= time_s <= last_s + _GAP_S and last.shape == cells.shape

    def _change_since(self, time_s: float, cells: FloatArray) -> None:
        """Compare with the oldest picture kept, if it is old enough."""
        self.change = math.nan
        if not (self._kept and time_s - self._kept[0][0] >= self._span_s) or not cells.size:
            return
        changes = np.abs(cells - self._kept[0][1]).ravel()
        rank = min(int(_QUANTILE * changes.size), changes.size - 1)
        self.change = float(np.partition(changes, rank)[rank])

    def _limit(self) -> float:
        """Return the change below which a picture stands still."""
        options = self.options
        if len(self._usual) < _N_KNOWN:
            return options.least
        quiet = float(np.quantile(np.array(self._usual), _USUAL))
        return min(max(options.share * quiet, options.least), options.greatest)

    def _judge(self, time_s: float) -> None:
        if math.isnan(self.change):
            return
        still = self.change < self._limit()
        if math.isnan(self._since_s):
            if still:
                self._since_s, self._moved_s = self._kept[0][0], math.nan
            else:
                self._usual.append(self.change)
            return
        if still:
            self._moved_s = math.nan
        elif math.isnan(self._moved_s):
            self._moved_s = time_s
        elif time_s - self._moved_s > self.options.span_s:
            # A key frame changes a still once, so it affects the comparison for one span.
            self._since_s = self._moved_s = math.nan


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


_VERDICT_EVERY_S, _PATIENCE_S = 5.0, 3.0


class DriftWatch:
    """Detector of lasers that moved: tests every few seconds, in a thread of its own.

    Parameters
    ----------
    rig : Rig
        With one laser, or without a dome, there is nothing to watch.

    Attributes
    ----------
    off : dict
        Number of the laser to what is wrong with it; empty where nothing is.
    """

    def __init__(self, rig: Rig) -> None:
        self.off: dict[int, str] = {}
        self._scans: queue.Queue[Scan | None] = queue.Queue(8)
        self._thread: threading.Thread | None = None
        agreement = _agreement_of(rig)
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
        self._thread.join(_PATIENCE_S)
        self._thread = None

    def _watch(self, agreement: LaserAgreement) -> None:
        judged_s = time.monotonic()
        while (scan := self._scans.get()) is not None:
            agreement.add(scan)
            if time.monotonic() - judged_s > _VERDICT_EVERY_S:
                self.off = _off(agreement)
                judged_s = time.monotonic()


def _agreement_of(rig: Rig) -> LaserAgreement | None:
    if rig.dome is None or len(rig.lasers) < 2:
        return None
    try:
        return LaserAgreement(rig)
    except RigError:
        # The rig's uncertainty cannot be parsed; measuring does not need it.
        return None


def _off(agreement: LaserAgreement) -> dict[int, str]:
    verdict = agreement.verdict()
    if verdict.state not in (AgreementState.DRIFTED, AgreementState.DISAGREE):
        return {}
    return dict.fromkeys(verdict.suspects, verdict.sentence())


WINDOW_S = 5.0
"""Time over which rates and delays are taken, in seconds."""

STAGES = ("wait", "measure", "send", "total")
"""Delay from the decoded frame until the measuring thread takes it; of the measurement; of sending
to outputs that never wait; and of all of it."""

# A laser without points on the target for this time, while others have some, is off or covered.
_DARK_S = 2.0


@dataclass(frozen=True, slots=True)
class _Passed:
    """Figures kept of one frame."""

    at_ns: int
    valid: bool
    quality: float
    delays_s: tuple[float, float, float, float]


class HealthMonitor:
    """Health statistics, gathered frame by frame; `health` is cheap.

    Parameters
    ----------
    rig : Rig
        Whose lasers are watched.
    """

    def __init__(self, rig: Rig) -> None:
        self._names = [laser.name for laser in rig.lasers]
        self._drift = DriftWatch(rig)
        self._passed: deque[_Passed] = deque()
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
        total = wait + measure + send
        self._passed.append(
            _Passed(sent_ns, bool(scan.posture), quality, (wait, measure, send, total))
        )
        if scan.posture:
            self._valid_ns = sent_ns
            for i in np.unique(scan.points.laser[used]).tolist():
                self._lit_ns[i] = sent_ns
        self._drift.offer(scan)

    def close(self) -> None:
        """Stop watching the lasers."""
        self._drift.close()

    def health(
        self,
        now_ns: int,
        *,
        source: PartHealth,
        outputs: Sequence[PartHealth],
        n_dropped: int,
        n_lost: int,
        n_water: float,
        sigma_n_water: float,
    ) -> Health:
        """Return the state of things."""
        while self._passed and now_ns - self._passed[0].at_ns > 1e9 * WINDOW_S:
            self._passed.popleft()
        recent = self._passed
        return Health(
            rate_hz=self._rate_hz(now_ns),
            valid_share=sum(p.valid for p in recent) / len(recent) if recent else float("nan"),
            n_frames=self._n_frames,
            n_dropped=n_dropped,
            n_lost=n_lost,
            delays=self._delays(),
            source=source,
            lasers=self._laser_health(),
            outputs=tuple(outputs),
            quality=_mean([p.quality for p in recent]),
            n_water=n_water,
            sigma_n_water=sigma_n_water,
        )

    def _rate_hz(self, now_ns: int) -> float:
        if len(self._passed) < 2:
            return 0.0
        # While frames come the span ends with the last one; in silence the rate falls.
        period_ns = (self._passed[-1].at_ns - self._passed[0].at_ns) / (len(self._passed) - 1)
        silent_ns = now_ns - self._passed[-1].at_ns
        span_ns = self._passed[-1].at_ns - self._passed[0].at_ns + max(0.0, silent_ns - period_ns)
        return (len(self._passed) - 1) / max(1e-9 * span_ns, 1e-9)

    def _delays(self) -> tuple[StageDelay, ...]:
        if not self._passed:
            return ()
        delays = np.array([p.delays_s for p in self._passed])
        middle, worst = np.quantile(delays, [0.5, 0.99], axis=0)
        return tuple(
            StageDelay(name, float(m), float(w))
            for name, m, w in zip(STAGES, middle, worst, strict=True)
        )

    def _laser_health(self) -> tuple[PartHealth, ...]:
        return tuple(self._one_laser(i) for i in range(len(self._names)))

    def _one_laser(self, i: int) -> PartHealth:
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
