"""The command `aqualvs live`: from a stream to pilot, autopilot and recording.

`WaterFollower` tracks the water's refractive index in a thread of its own, so that no frame waits
for it. `Console` reports in the terminal: a status line that stays, or occasional lines in a log.
"""

import math
import queue
import re
import sys
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from aqualvs.control.time_filter import PostureFilter
from aqualvs.control.vehicle import SetpointHolder, VehicleState
from aqualvs.errors import OptionError, OutputError
from aqualvs.live.options import Page, vehicle_reader
from aqualvs.live.outputs.base import Output
from aqualvs.live.runner import LiveOptions, LiveRunner, ScannerProvider, warm_up
from aqualvs.optics.rig import Rig
from aqualvs.recording import PictureFormat, RecorderOptions, RecorderSwitch
from aqualvs.recording.sample import LiveSample
from aqualvs.results.run_request import Water, prepared_rig
from aqualvs.scanner import Scanner, ScannerOptions
from aqualvs.scanning.posture import Posture, deviations
from aqualvs.scanning.scan import Frame
from aqualvs.sources.base import Feed, PartHealth, State
from aqualvs.sources.fields import FrameFeed
from aqualvs.terminal import Echo, StopSignals
from aqualvs.workers.run_frames import WaterFollowingScanner

_TIMEOUT_S = 3.0


class WaterFollower(ScannerProvider):
    """Provider of the scanner for the present water; a thread reads the target.

    `following`: looks at the target; used by the thread alone from here on.
    """

    def __init__(self, following: WaterFollowingScanner) -> None:
        self._following = following
        self._frames: queue.Queue[Frame | None] = queue.Queue(1)
        super().__init__(following.scanner, following.sigma_n_water)
        self._thread = threading.Thread(target=self._run, name="water", daemon=True)
        self._thread.start()

    def offer(self, frame: Frame) -> None:
        """Pass on a frame for reading the target, when one is due and the thread is idle."""
        if self._following.is_due(frame) and self._frames.empty():
            self._frames.put_nowait(frame)

    def close(self) -> None:
        """End the thread."""
        if not self._thread.is_alive():
            return
        while not self._frames.empty():
            self._frames.get_nowait()
        self._frames.put(None)
        self._thread.join(_TIMEOUT_S)

    def _run(self) -> None:
        while (frame := self._frames.get()) is not None:
            self._following.look(frame)
            self.scanner = self._following.scanner
            self.sigma_n_water = self._following.sigma_n_water


_SCREEN_EVERY_S, _LOG_EVERY_S = 0.2, 10.0
_NUMBER = re.compile(r"\d+(\.\d+)?")


class Console(Output):
    """Output to the terminal of the user who started the run, by standard error."""

    name = "console"

    def __init__(self) -> None:
        self._stream = sys.stderr
        self._on_screen = self._stream.isatty()
        # A log begins with what goes wrong: of a run that ends at once, nothing else is told.
        self._next_s = -math.inf if self._on_screen else time.monotonic() + _LOG_EVERY_S
        # The state of each part, and the cause of a fault: its words without their numbers.
        self._told: dict[str, tuple[State, str]] = {}

    def send(self, sample: LiveSample) -> None:
        """Tell of parts that have changed at once, and of the posture when it is time."""
        self._report_changes(sample)
        now_s = time.monotonic()
        if now_s < self._next_s:
            return
        self._next_s = now_s + (_SCREEN_EVERY_S if self._on_screen else _LOG_EVERY_S)
        self._write(status_line(sample), stays=False)

    def health(self) -> PartHealth:
        """Return that all is well: the terminal shows by itself if not."""
        return PartHealth(self.name, State.OK)

    def close(self) -> None:
        """Leave the line that stayed."""
        if self._on_screen and math.isfinite(self._next_s):
            self._stream.write("\n")
            self._stream.flush()

    def _report_changes(self, sample: LiveSample) -> None:
        health = sample.health
        for part in (health.source, *health.lasers, *health.outputs):
            before = self._told.get(part.name, (State.OFF, ""))
            cause = _NUMBER.sub("", part.detail) if part.state is State.FAULT else ""
            self._told[part.name] = now = (part.state, cause)
            if now != before and {part.state, before[0]} & {State.WARN, State.FAULT}:
                detail = part.detail and f": {part.detail}"
                self._write(f"{part.name}: {part.state.value}{detail}", stays=True)

    def _write(self, line: str, *, stays: bool) -> None:
        if self._on_screen:
            self._stream.write(f"\r\x1b[K{line}" + ("\n" if stays else ""))
        else:
            self._stream.write(f"{line}\n")
        self._stream.flush()


def status_line(sample: LiveSample) -> str:
    """Return posture and health of a sample in one line."""
    posture, health = sample.scan.posture, sample.health
    if isinstance(posture, Posture):
        sigma = deviations(posture.total_covariance)
        text = (
            f"range {posture.range:.3f} m ± {1e3 * sigma[0]:.1f} mm  "
            f"yaw {math.degrees(posture.yaw):+.1f} ± {sigma[2]:.2f} deg  "
            f"pitch {math.degrees(posture.pitch):+.1f} ± {sigma[1]:.2f} deg"
        )
    else:
        text = f"no posture: {posture.detail or posture.reason.value}"
    total = health.delays[-1] if health.delays else None
    delay = "" if total is None else f"  {1e3 * total.median_s:.1f} ms"
    dropped = f"  {health.n_dropped} dropped" if health.n_dropped else ""
    return f"{text}  | {health.rate_hz:.0f} Hz{delay}{dropped}"


# Longest wait of a thread for the interpreter; Python's default of 5 ms would show in the delays.
SWITCH_S = 0.0005


def camera_size(text: str) -> tuple[int, int]:
    """Return the size that `WIDTHxHEIGHT` asks of a camera.

    Raises `OptionError` if it is none.
    """
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise OptionError(f"--size {text}: not understood; give WIDTHxHEIGHT, such as 1920x1080")
    return int(width), int(height)


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveRequest:
    """Request for a live run."""

    feed: Callable[[], Feed]  # Opens the source.
    rig: Path
    outputs: tuple[Callable[[], Output], ...] = ()  # From `output_makers`.
    page: Page | None = None
    # Whether to record from the start; the page's button begins and ends recordings, too.
    record: bool = False
    record_to: Path = Path("dives")  # Folder of recordings.
    record_video: bool = False
    smooth: bool = False  # Whether the time filter runs.
    fast: bool = False  # Measure every frame of a file, as fast as possible.
    water: Water = field(default_factory=Water)
    scanner: ScannerOptions = field(default_factory=ScannerOptions)
    index_target: Path | None = None  # Markers on the vehicle that show the water's index.


def run_live(request: LiveRequest, echo: Echo) -> int:
    """Run until the source ends or the user stops it, the normal end of a live run; return 0.

    Raises `AqualvsError` if an input cannot be used, or the source can never work.
    """
    if request.index_target is not None:
        from aqualvs.calibration.targets.target_files import load_target

        # Refused before anything is opened, sent or written.
        load_target(request.index_target)
    rig = prepared_rig(request.rig, request.water, no_dome=False)
    holder = SetpointHolder(rig.working_range, followed=False)
    runner = make_runner(request, rig, lambda: _provider(request, rig), holder, echo)
    return run_and_sum_up(runner, echo)


def run_and_sum_up(runner: LiveRunner, echo: Echo) -> int:
    """Run until the source ends or the user stops it; print what was measured, and return 0.

    Raises `AqualvsError` if the source failed for good, or a recording could not be written.
    """
    with StopSignals() as stop:
        fault = runner.run(lambda: stop.caught is not None)
    echo(f"{runner.n_measured} frames measured, {runner.n_postures} with a posture")
    for part in runner.incomplete():
        if part.state is State.FAULT and fault is None:
            fault = OutputError(f"{part.name}: {part.detail}")
        else:
            echo(f"{part.name}: {part.detail}")
    if fault is not None:
        raise fault
    return 0


def make_runner(
    request: LiveRequest,
    rig: Rig,
    provider: Callable[[], ScannerProvider],
    holder: SetpointHolder,
    echo: Echo,
    *,
    first: Iterable[Output] = (),
    vehicle: Callable[[], VehicleState | None] | None = None,
) -> LiveRunner:
    """Make the live loop; if a part fails, the parts made before it are closed.

    `provider`: makes the provider of the scanner, after everything else. `holder`: where the page
    puts what is to be held. `first`: outputs before all others; taken once the source is open.
    `vehicle`: as `Page.serve` takes it; by default of the first output that an autopilot answers.
    """
    sys.setswitchinterval(SWITCH_S)
    options = RecorderOptions(
        pictures=PictureFormat.JPEG if request.record_video else None, scanner=request.scanner
    )
    with ExitStack() as closing:
        outputs: list[Output] = []

        def add(more: Iterable[Output]) -> None:
            for output in more:
                outputs.append(output)
                closing.callback(output.close)

        feed = FrameFeed(request.feed(), rig.shutter)
        closing.callback(feed.close)
        add(first)
        recorder = RecorderSwitch(request.record_to, options)
        add([recorder, Console()])
        add(make() for make in request.outputs)
        if request.page is not None:
            reader = vehicle or vehicle_reader(outputs)
            add([request.page.serve(rig, holder, recorder, echo, reader)])
        smoothing = PostureFilter() if request.smooth else None
        every = LiveOptions(keep_every=request.fast)
        provided = provider()
        closing.callback(provided.close)
        if request.record:
            # Last: where a part cannot be made, or is stopped while kernels are compiled, no file
            # is left.
            echo(f"recording: {recorder.start()}")
        runner = LiveRunner(feed, provided, outputs, every, smoothing)
        closing.pop_all()
    return runner


def _provider(request: LiveRequest, rig: Rig) -> ScannerProvider:
    if request.index_target is None:
        scanner = Scanner(rig, request.scanner)
        warm_up(scanner)
        return ScannerProvider(scanner)
    following = WaterFollowingScanner(rig, request.scanner, request.index_target, request.water)
    warm_up(following.scanner)
    return WaterFollower(following)
