"""The live loop: the latest frame in, a sample to every output; nothing stops it but its owner."""

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from aqualvs.errors import AqualvsError
from aqualvs.live.frame_reader import FrameReader
from aqualvs.live.frozen import FrozenOptions, FrozenPicture
from aqualvs.live.health import Health
from aqualvs.live.health_monitor import HealthMonitor
from aqualvs.live.mailbox import Arrival, Mailbox
from aqualvs.live.output_worker import OutputWorker
from aqualvs.live.outputs.base import Output
from aqualvs.live.sample import Instants, LiveSample
from aqualvs.live.sources.feed import Feed
from aqualvs.live.time_filter import PostureFilter
from aqualvs.optics.rig import Rig
from aqualvs.scanning.pipeline import Scanner
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.scanning.scan import Frame, Scan, ScanPoints
from aqualvs.scanning.search import SearchAxis
from aqualvs.scanning.stripe import Returns

# How often a silent stream is told to the outputs, and a request to stop is looked for.
_SILENT_EVERY_S, _LOOK_EVERY_S, _HEALTH_EVERY_S = 0.1, 0.05, 0.1
_log = logging.getLogger(__name__)


class ScannerSupply(Protocol):
    """Gives the scanner to measure with; another one as the water's index is followed."""

    @property
    def scanner(self) -> Scanner:
        """The one to use for the next frame."""

    @property
    def sigma_n_water(self) -> float:
        """Standard deviation of its index; NaN where it is not measured."""

    def offer(self, frame: Frame) -> None:
        """Look at a frame if it is of use; returns at once."""

    def close(self) -> None:
        """Stop looking."""


class FixedScanner:
    """Always the same scanner.

    Parameters
    ----------
    scanner : Scanner
    """

    def __init__(self, scanner: Scanner) -> None:
        self.scanner = scanner
        self.sigma_n_water = float("nan")

    def offer(self, frame: Frame) -> None:
        """Do nothing: there is nothing to learn."""

    def close(self) -> None:
        """Do nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveOptions:
    """How the loop runs.

    Attributes
    ----------
    stale_after_s : float
        A stream that is silent for so long has no posture any more.
    keep_every : bool
        Measure every frame, whatever delay that adds: for files.
    frozen : FrozenOptions or None
        When a picture counts as frozen, and has no posture; None where none does.
    """

    stale_after_s: float = 0.15
    keep_every: bool = False
    frozen: FrozenOptions | None = field(default_factory=FrozenOptions)


class LiveRunner:
    """Measures a feed as it comes and hands the answers on.

    Parameters
    ----------
    feed : Feed
    supply : ScannerSupply
        Closed at the end.
    outputs : sequence of Output
        Closed at the end.
    options : LiveOptions, optional
        Defaults if left out.
    posture_filter : PostureFilter or None
        Smooths over time, in addition to the raw values.
    """

    def __init__(
        self,
        feed: Feed,
        supply: ScannerSupply,
        outputs: Sequence[Output],
        options: LiveOptions | None = None,
        posture_filter: PostureFilter | None = None,
    ) -> None:
        self._options = options or LiveOptions()
        self._supply, self._filter = supply, posture_filter
        self._mailbox = Mailbox(keep_every=self._options.keep_every)
        self._reader = FrameReader(feed, self._mailbox)
        self._monitor = HealthMonitor(supply.scanner.rig)
        # Those that never wait come first: waking a thread takes longer than a datagram.
        ordered = sorted(outputs, key=lambda output: not output.inline)
        self._workers = [OutputWorker(output) for output in ordered]
        frozen = self._options.frozen
        self._frozen = None if frozen is None else FrozenPicture(frozen)
        self._last: Frame | None = None
        self._heard_ns = self._told_ns = 0
        self._trouble = ""
        self._health, self._health_ns = Health(), 0

    def run(self, stop: Callable[[], bool]) -> AqualvsError | None:
        """Run until the feed ends or `stop` returns True; returns what ended the feed, if a fault.

        Whatever fails meanwhile is logged and shown in the samples' health.
        """
        self._heard_ns = time.monotonic_ns()
        try:
            with self._reader:
                while not stop() and not self._mailbox.exhausted:
                    arrival = self._mailbox.take(_LOOK_EVERY_S)
                    if arrival is not None:
                        self._pass_on(self._measured(arrival))
                    elif self._is_silent():
                        self._pass_on(self._silence())
        finally:
            self._supply.close()
            self._monitor.close()
            for worker in self._workers:
                worker.close()
        return self._reader.fault

    def health(self) -> Health:
        """Return how the run goes; figures are at most a tenth of a second old."""
        now_ns = time.monotonic_ns()
        if now_ns - self._health_ns > 1e9 * _HEALTH_EVERY_S:
            self._health_ns = now_ns
            self._health = self._monitor.health(
                now_ns,
                source=self._reader.health(),
                outputs=[worker.health() for worker in self._workers],
                n_dropped=self._mailbox.n_dropped,
                n_lost=self._reader.n_lost,
                n_water=self._supply.scanner.rig.n_water,
                sigma_n_water=self._supply.sigma_n_water,
            )
        return self._health

    def _measured(self, arrival: Arrival) -> LiveSample:
        """Return the sample of a frame that came."""
        taken_ns = time.monotonic_ns()
        frame = self._last = arrival.frame
        self._heard_ns = arrival.arrived_ns
        scanner = self._supply.scanner
        returns, scan = self._scan(scanner, frame)
        return self._sample(
            scanner.rig,
            scan,
            returns,
            frame,
            arrival.utc_ns,
            Instants(arrival.arrived_ns, taken_ns, time.monotonic_ns()),
            scan.time_s,
        )

    def _scan(self, scanner: Scanner, frame: Frame) -> tuple[dict[SearchAxis, Returns], Scan]:
        rig = scanner.rig
        height, width = frame.luma.shape
        if (width, height) != rig.size_px:
            need = "x".join(map(str, rig.size_px))
            refusal = Refusal(
                Reason.WRONG_SIZE, f"picture of {width}x{height} px, but the rig has {need} px"
            )
            return {}, Scan(frame.index, frame.time_s, refusal, ScanPoints.none(), rig.n_water)
        still_s = self._frozen.update(frame.time_s, frame.luma) if self._frozen else 0.0
        if still_s > 0.0:
            refusal = Refusal(Reason.FROZEN, f"the same picture for {still_s:.1f} s")
            return {}, Scan(frame.index, frame.time_s, refusal, ScanPoints.none(), rig.n_water)
        try:
            returns = scanner.detect(frame)
            return returns, scanner.measure(frame.index, frame.time_s, returns)
        except Exception as fault:
            # One bad frame must not end a dive.
            if str(fault) != self._trouble:
                _log.exception("frame %d could not be measured", frame.index)
                self._trouble = str(fault)
            refusal = Refusal(Reason.CORRUPT_FRAME, f"could not be measured: {fault}")
            return {}, Scan(frame.index, frame.time_s, refusal, ScanPoints.none(), rig.n_water)

    def _is_silent(self) -> bool:
        now_ns = time.monotonic_ns()
        return (
            now_ns - self._heard_ns > 1e9 * self._options.stale_after_s
            and now_ns - self._told_ns > 1e9 * _SILENT_EVERY_S
            and not self._mailbox.exhausted
        )

    def _silence(self) -> LiveSample:
        """Return the sample that says that no frames come."""
        now_ns = time.monotonic_ns()
        self._told_ns = now_ns
        silent_s = 1e-9 * (now_ns - self._heard_ns)
        index, time_s = (-1, 0.0) if self._last is None else (self._last.index, self._last.time_s)
        refusal = Refusal(Reason.NO_FRAMES, f"no picture for {silent_s:.1f} s")
        rig = self._supply.scanner.rig
        scan = Scan(index, time_s, refusal, ScanPoints.none(), rig.n_water)
        instants = Instants(now_ns, now_ns, now_ns)
        return self._sample(rig, scan, {}, None, time.time_ns(), instants, time_s + silent_s)

    def _sample(
        self,
        rig: Rig,
        scan: Scan,
        returns: dict[SearchAxis, Returns],
        frame: Frame | None,
        utc_ns: int,
        instants: Instants,
        time_s: float,
    ) -> LiveSample:
        filtered = None if self._filter is None else self._filter.update(time_s, scan.posture)
        return LiveSample(
            rig=rig,
            scan=scan,
            returns=returns,
            frame=frame,
            utc_ns=utc_ns,
            instants=instants,
            filtered=filtered,
            health=self.health(),
        )

    def _pass_on(self, sample: LiveSample) -> None:
        for worker in self._workers:
            worker.offer(sample)
        if sample.frame is not None:
            self._supply.offer(sample.frame)
        self._monitor.add(sample.scan, sample.instants, time.monotonic_ns())
