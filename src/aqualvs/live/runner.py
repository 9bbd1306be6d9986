"""The live loop: it measures the latest frame and hands a sample to every output.

Only its owner ends the loop; faults of frames and outputs do not.

- `FrameReader`: the thread that reads the feed and puts frames into the mailbox.
- `Mailbox`: room for the latest frame, from the decoding thread to the measuring one, without
  adding delay.
- `LiveRunner`: the loop itself; `warm_up` loads the compiled kernels before it starts, so that the
  first frame does not wait.
- `OutputWorker`: a thread for each output, so that its faults do not affect anything else.
"""

import importlib.resources
import itertools
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self

import cv2
import numpy as np

from aqualvs.control.time_filter import PostureFilter
from aqualvs.errors import AqualvsError
from aqualvs.geometry.compiled import compiled_at_once
from aqualvs.live.health_monitor import FrozenOptions, FrozenPicture, HealthMonitor
from aqualvs.live.outputs.base import HearsVehicle, Output
from aqualvs.optics.expected_error import visible_stripe
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import load_rig
from aqualvs.optics.sheet import sheets_of
from aqualvs.optics.shutter import Field
from aqualvs.recording.sample import Instants, LiveSample
from aqualvs.scanner import Scanner
from aqualvs.scanning.laser_bands import SearchAxis
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.scanning.row_motion import REACH, RowMotion
from aqualvs.scanning.scan import Frame, Scan, ScanPoints
from aqualvs.scanning.stripe import StripePeaks
from aqualvs.sources import open_source
from aqualvs.sources.base import Feed, Health, PartHealth, State
from aqualvs.sources.fields import frames_of, size_of_frames
from aqualvs.terminal import told_if_slow


def warm_up(scanner: Scanner) -> Scan:
    """Compile or load the kernels that scanners use, by measuring a net and a made-up wall.

    Returns the scan of the wall, which is in the middle of the working range, square to the
    vehicle.
    """
    rounds = 2
    picture = wall_frame(scanner.rig)
    with told_if_slow("getting ready to measure"), compiled_at_once():
        _measure_net()
        for _ in range(rounds):
            for frame in frames_of([picture], scanner.rig.shutter):
                scan = scanner.process(frame)
    return scan


def _measure_net() -> None:
    """Measure the beginning of the bundled dive: a net takes a dozen kernels that no wall does."""
    # It imports what `aqualvs run` needs.
    from aqualvs.demo import bundled_dive

    # All of them have been used after seven.
    n_frames = 8
    with importlib.resources.as_file(bundled_dive()) as folder:
        scanner = Scanner(load_rig(folder / "rig.yaml"))
        with open_source(str(folder / "dive.mp4")) as source:
            for frame in itertools.islice(source, n_frames):
                scanner.process(frame)


def wall_frame(rig: Rig) -> Frame:
    """Return a picture of the stripes on a wall in the middle of the working range."""
    grey, light, thick_px, blur_px = 30, 150, 3, 1.2
    camera = rig.camera()
    width, height = rig.size_px
    luma = np.full((height, width), grey, np.uint8)
    for sheet in sheets_of(rig):
        stripe = visible_stripe(camera, sheet, 0.5 * sum(rig.working_range))
        # OpenCV takes fixed-point coordinates, here in 1/16 px.
        pixels = np.rint(16.0 * stripe.pixels).astype(np.int32)
        cv2.polylines(luma, [pixels], False, light, thick_px, cv2.LINE_AA, shift=4)
    luma = np.asarray(cv2.GaussianBlur(luma, (0, 0), blur_px), np.uint8)
    half = (-(-width // 2), -(-height // 2))
    lit = cv2.resize(luma, half, interpolation=cv2.INTER_AREA).astype(np.float64) - grey
    u = np.clip(120.0 - 0.4 * lit, 0.0, 255.0).astype(np.uint8)
    return Frame(0, 0.0, luma, (u, np.full_like(u, 110)))


# Samples that may wait for a recorder, with their pictures: 300 MB at 1920x1080.
_QUEUE = 100
_TIMEOUT_S = 5.0
_log = logging.getLogger(__name__)


class OutputWorker:
    """Worker of one output: a thread of its own, unless the output never waits.

    `output`: owned from here on.
    """

    def __init__(self, output: Output) -> None:
        self._output, self.name = output, output.name
        self._fault = ""
        self._n_dropped = 0
        self._waiting: deque[LiveSample] = deque()
        self.keeps_all = output.keeps_all
        self._room = _QUEUE if output.keeps_all else 1
        self._changed = threading.Condition()
        self._closing = False
        self._thread: threading.Thread | None = None
        if not output.inline:
            self._thread = threading.Thread(target=self._run, name=output.name, daemon=True)
            self._thread.start()

    def offer(self, sample: LiveSample) -> None:
        """Pass a sample on; return at once."""
        if self._thread is None:
            self._send(sample)
            return
        with self._changed:
            if len(self._waiting) >= self._room:
                self._waiting.popleft()
                self._n_dropped += 1
            self._waiting.append(sample)
            self._changed.notify()

    def health(self) -> PartHealth:
        """Return the state of the output, with the number of dropped samples."""
        try:
            found = self._output.health()
        except Exception as fault:
            return PartHealth(self.name, State.FAULT, f"{fault}", self._n_dropped)
        if self._fault:
            found = PartHealth(found.name, State.FAULT, self._fault, found.n_dropped)
        elif self.keeps_all and self._n_dropped and found.state is State.OK:
            found = replace(found, state=State.WARN)
        return replace(found, n_dropped=found.n_dropped + self._n_dropped)

    def close(self) -> None:
        """Send waiting samples, for a few seconds at most, and close the output."""
        if self._thread is not None:
            with self._changed:
                self._closing = True
                self._changed.notify()
            self._thread.join(_TIMEOUT_S)
            if self._thread.is_alive():
                _log.warning("%s: did not end in time", self.name)
        try:
            self._output.close()
        except Exception:
            _log.exception("%s: closing failed", self.name)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closing)
                if not self._waiting:
                    return
                sample = self._waiting.popleft()
            self._send(sample)

    def _send(self, sample: LiveSample) -> None:
        try:
            self._output.send(sample)
        except Exception as fault:
            text = f"{fault}" or type(fault).__name__
            if text != self._fault:
                _log.warning("%s: %s", self.name, text)
            self._fault = text
        else:
            self._fault = ""


class Arrival(NamedTuple):
    """A frame and when it came."""

    frame: Frame
    arrived_ns: int  # By `time.monotonic_ns`.
    utc_ns: int  # By the system clock.


class Mailbox:
    """Room for one picture: the latest, or both its fields.

    `keep_every`: let the writer wait until its frame has been taken, instead of replacing one that
    has not.
    """

    def __init__(self, *, keep_every: bool = False) -> None:
        self.n_dropped = 0  # Frames that were replaced by a newer one before they were taken.
        self._keep_every = keep_every
        self._changed = threading.Condition()
        self._waiting: deque[Arrival] = deque()
        self._closed = False

    def put(self, frame: Frame) -> None:
        """Leave a frame; after `close` it is thrown away."""
        arrival = Arrival(frame, time.monotonic_ns(), time.time_ns())
        with self._changed:
            if self._keep_every:
                self._changed.wait_for(lambda: not self._waiting or self._closed)
            if self._closed:
                return
            while self._waiting and not _are_one_picture(self._waiting[0].frame, frame):
                self._waiting.popleft()
                self.n_dropped += 1
            self._waiting.append(arrival)
            self._changed.notify_all()

    def take(self, timeout_s: float) -> Arrival | None:
        """Take the frame that is there, or wait for one; None if there is none in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closed, timeout_s)
            arrival = self._waiting.popleft() if self._waiting else None
            self._changed.notify_all()
        return arrival

    def close(self) -> None:
        """No more frames come; one that waits can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def exhausted(self) -> bool:
        """Whether no frame waits and none will come."""
        with self._changed:
            return self._closed and not self._waiting


def _are_one_picture(first: Frame, second: Frame) -> bool:
    """Return whether two frames are the fields of one picture, which come at the same moment."""
    return second.field is not None and first.index // 2 == second.index // 2


class FrameReader:
    """Reader of a feed in a thread of its own; a context manager.

    `mailbox`: closed when the feed ends.
    """

    def __init__(self, feed: Feed, mailbox: Mailbox) -> None:
        self.n_lost = 0  # Frames that the feed could not decode, by the gaps in their numbers.
        self.fault: AqualvsError | None = None  # What ended the feed, if it did not end by itself.
        self._feed, self._mailbox = feed, mailbox
        self._read_error = ""
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._read, name="frames", daemon=True)

    def health(self) -> PartHealth:
        """Return how the feed is; what ends it is the owner's to tell, once."""
        if self._read_error:
            return PartHealth(self._feed.name, State.FAULT, self._read_error)
        return self._feed.health()

    def __enter__(self) -> Self:
        """Begin to read."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End the feed and the thread."""
        reader_timeout_s = 3.0  # A feed promises to end within a second of being closed.
        self._closing.set()
        self._feed.close()
        self._mailbox.close()
        self._thread.join(reader_timeout_s)
        if self._thread.is_alive():
            _log.warning("%s: did not end in time", self._feed.name)

    def _read(self) -> None:
        again_s = 1.0  # After an unexpected exception the feed is restarted.
        try:
            while not self._closing.is_set():
                try:
                    return self._read_feed()
                except AqualvsError as fault:
                    self.fault = fault
                    return None
                except Exception as fault:
                    # The thread must not die silently: the pilot would see an old picture.
                    _log.exception("%s: reading failed; trying again", self._feed.name)
                    self._read_error = f"{type(fault).__name__}: {fault}"
                    self._closing.wait(again_s)
        finally:
            self._mailbox.close()

    def _read_feed(self) -> None:
        expected = None
        for frame in self._feed:
            if expected is not None:
                self.n_lost += max(0, frame.index - expected)
            expected = frame.index + 1
            self._read_error = ""
            self._mailbox.put(frame)


# Period of samples that report a silent stream, and of checks for a request to stop.
_SILENT_EVERY_S, _LOOK_EVERY_S, _HEALTH_EVERY_S = 0.1, 0.05, 0.1


class ScannerProvider:
    """Provider of the scanner for the next frame: always the same, but for subclasses."""

    def __init__(self, scanner: Scanner, sigma_n_water: float = math.nan) -> None:
        self.scanner = scanner
        self.sigma_n_water = sigma_n_water  # Of its index; NaN where that is not measured.

    def offer(self, frame: Frame) -> None:
        """Look at a frame if it is of use; returns at once."""

    def close(self) -> None:
        """Stop looking."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveOptions:
    """Options of the live loop."""

    stale_after_s: float = 0.15  # A stream that is silent for this time has no posture any more.
    keep_every: bool = False  # Measure every frame regardless of the delay: for files.
    # When a picture counts as frozen, and has no posture; None where none does.
    frozen: FrozenOptions | None = field(default_factory=FrozenOptions)


class LiveRunner:
    """Live loop: measures a feed as it comes and passes the results to the outputs.

    Feed, provider and outputs are closed at the end. `posture_filter` smooths over time, in
    addition to the raw values. The first output that an autopilot answers tells how the vehicle
    turns, for a rolling shutter.
    """

    def __init__(
        self,
        feed: Feed,
        provider: ScannerProvider,
        outputs: Sequence[Output],
        options: LiveOptions | None = None,
        posture_filter: PostureFilter | None = None,
    ) -> None:
        self.n_measured = self.n_postures = 0  # Frames until now; those with a posture.
        self._options = options or LiveOptions()
        self._provider, self._filter = provider, posture_filter
        self._mailbox = Mailbox(keep_every=self._options.keep_every)
        self._reader = FrameReader(feed, self._mailbox)
        self._monitor = HealthMonitor(provider.scanner.rig)
        # Outputs that never wait come first: waking a thread takes longer than a datagram.
        ordered = sorted(outputs, key=lambda output: not output.inline)
        self._workers = [OutputWorker(output) for output in ordered]
        self._frozen: dict[Field | None, FrozenPicture] = {}
        rig = provider.scanner.rig
        self._row_motion = RowMotion(rig) if rig.shutter.needs_neighbours else None
        self._gyros = next((one for one in outputs if isinstance(one, HearsVehicle)), None)
        self._before: deque[Scan] = deque(maxlen=REACH)
        self._last: Frame | None = None
        self._heard_ns = self._silence_sent_ns = 0
        self._fault = ""
        self._health, self._health_ns = Health(), 0

    def run(self, stop: Callable[[], bool]) -> AqualvsError | None:
        """Run until the feed ends or `stop` returns True; return the fault that ended the feed.

        Whatever fails meanwhile is logged and shown in the samples' health.
        """
        self._heard_ns = time.monotonic_ns()
        try:
            with self._reader:
                while not stop() and not self._mailbox.exhausted:
                    arrival = self._mailbox.take(_LOOK_EVERY_S)
                    if arrival is not None:
                        self._distribute(self._measure(arrival))
                    elif self._is_silent():
                        self._distribute(self._silent_sample())
        finally:
            self._provider.close()
            self._monitor.close()
            for worker in self._workers:
                worker.close()
        return self._reader.fault

    def incomplete(self) -> list[PartHealth]:
        """Return the state of outputs that were to keep everything and, at the end, have not."""
        parts = (worker.health() for worker in self._workers if worker.keeps_all)
        return [one for one in parts if one.n_dropped or one.state is State.FAULT]

    def health(self) -> Health:
        """Return the health of the run; figures are at most a tenth of a second old."""
        now_ns = time.monotonic_ns()
        if now_ns - self._health_ns > 1e9 * _HEALTH_EVERY_S:
            self._health_ns = now_ns
            self._health = replace(
                self._monitor.health(now_ns),
                source=self._reader.health(),
                outputs=tuple(worker.health() for worker in self._workers),
                n_dropped=self._mailbox.n_dropped,
                n_lost=self._reader.n_lost,
                n_water=self._provider.scanner.rig.n_water,
                sigma_n_water=self._provider.sigma_n_water,
            )
        return self._health

    def _measure(self, arrival: Arrival) -> LiveSample:
        """Return the sample of a frame that came."""
        taken_ns = time.monotonic_ns()
        frame = self._last = arrival.frame
        self._heard_ns = arrival.arrived_ns
        scanner = self._provider.scanner
        peaks, scan = self._scan(scanner, arrival)
        self.n_measured += 1
        self.n_postures += bool(scan.posture)
        shutter, age_ns = scanner.rig.shutter, 0
        if frame.field == shutter.first_field:
            # It waited for the second field, with which it came.
            age_ns = round(1e9 * shutter.readout)
        utc_ns = arrival.utc_ns - age_ns
        instants = Instants(arrival.arrived_ns - age_ns, taken_ns, time.monotonic_ns())
        return self._sample(scanner.rig, scan, peaks, frame, utc_ns, instants, scan.time_s)

    def _scan(
        self, scanner: Scanner, arrival: Arrival
    ) -> tuple[dict[SearchAxis, StripePeaks], Scan]:
        rig, frame = scanner.rig, arrival.frame
        height, width = frame.luma.shape
        wanted = size_of_frames(rig)
        if (width, height) != wanted:
            need = "x".join(map(str, wanted))
            what = "picture" if frame.field is None else "field"
            refusal = Refusal(
                Reason.WRONG_SIZE, f"{what} of {width}x{height} px, but the rig has {need} px"
            )
        elif (still_s := self._still_s(frame)) > 0.0:
            refusal = Refusal(Reason.FROZEN, f"the same picture for {still_s:.1f} s", still_s)
        else:
            try:
                peaks, scan = scanner.scan(frame)
                return peaks, self._at_middle(scan, rig, arrival.arrived_ns)
            except Exception as fault:
                # One bad frame must not end a dive.
                if str(fault) != self._fault:
                    _log.exception("frame %d could not be measured", frame.index)
                    self._fault = str(fault)
                refusal = Refusal(Reason.CORRUPT_FRAME, f"could not be measured: {fault}")
        return {}, Scan(frame.index, frame.time_s, refusal, ScanPoints.none(), rig.n_water)

    def _still_s(self, frame: Frame) -> float:
        """Return how long the picture has been the same; fields are compared with their like."""
        if self._options.frozen is None:
            return 0.0
        frozen = self._frozen.setdefault(frame.field, FrozenPicture(self._options.frozen))
        return frozen.update(frame.time_s, frame.luma)

    def _at_middle(self, scan: Scan, rig: Rig, arrived_ns: int) -> Scan:
        """Return a scan as it is at its picture's middle, by those before it and gyros."""
        if self._row_motion is None:
            return scan
        if self._gyros is not None:
            middle_ns = arrived_ns - round(1e9 * rig.shutter.middle_to_end)
            scan = replace(scan, turning=self._gyros.turning(middle_ns))
        before = list(self._before)
        self._before.append(scan)
        return self._row_motion.correct(scan, before)

    def _is_silent(self) -> bool:
        now_ns = time.monotonic_ns()
        return (
            now_ns - self._heard_ns > 1e9 * self._options.stale_after_s
            and now_ns - self._silence_sent_ns > 1e9 * _SILENT_EVERY_S
            and not self._mailbox.exhausted
        )

    def _silent_sample(self) -> LiveSample:
        """Return the sample that says that no frames come."""
        now_ns = time.monotonic_ns()
        self._silence_sent_ns = now_ns
        silent_s = 1e-9 * (now_ns - self._heard_ns)
        index, time_s = (-1, 0.0) if self._last is None else (self._last.index, self._last.time_s)
        refusal = Refusal(Reason.NO_FRAMES, f"no picture for {silent_s:.1f} s")
        rig = self._provider.scanner.rig
        scan = Scan(index, time_s, refusal, ScanPoints.none(), rig.n_water)
        instants = Instants(now_ns, now_ns, now_ns)
        return self._sample(rig, scan, {}, None, time.time_ns(), instants, time_s + silent_s)

    def _sample(
        self,
        rig: Rig,
        scan: Scan,
        peaks: dict[SearchAxis, StripePeaks],
        frame: Frame | None,
        utc_ns: int,
        instants: Instants,
        time_s: float,
    ) -> LiveSample:
        filtered = None if self._filter is None else self._filter.update(time_s, scan.posture)
        return LiveSample(
            rig=rig,
            scan=scan,
            peaks=peaks,
            frame=frame,
            utc_ns=utc_ns,
            instants=instants,
            filtered=filtered,
            health=self.health(),
        )

    def _distribute(self, sample: LiveSample) -> None:
        for worker in self._workers:
            worker.offer(sample)
        if sample.frame is not None:
            self._provider.offer(sample.frame)
        self._monitor.add(sample.scan, sample.instants, time.monotonic_ns())
