"""The command `aqualvs follow SOURCE`: hold and follow with a real vehicle, with a log.

A thread of its own writes the log, so that the disk never delays the pilot.
"""

import contextlib
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import TextIO, TypeAlias

from aqualvs.control.autopilot import Decision, NetPilot
from aqualvs.control.controller import RangeYawController
from aqualvs.control.follow_log import FollowLog
from aqualvs.control.safety import SafetyGate
from aqualvs.control.time_filter import PostureFilter
from aqualvs.control.tune import usable_gains
from aqualvs.control.vehicle import SetpointHolder
from aqualvs.errors import AqualvsError, OutputError
from aqualvs.follow.command import FOLLOW_CSV, Aim
from aqualvs.live.command import SWITCH_S, Console, FeedRequest, recorder_options
from aqualvs.live.mavlink.ardusub import ArduSubLink
from aqualvs.live.mavlink.link import MavlinkLink
from aqualvs.live.options import VehicleSetup, serve_page
from aqualvs.live.outputs.base import Output
from aqualvs.live.outputs.mavlink import MavlinkOutput
from aqualvs.live.pilot import Pilot, PilotReport
from aqualvs.live.runner import LiveRunner, ScannerSupply, warm_up
from aqualvs.recording import RecorderSwitch
from aqualvs.recording.sample import LiveSample
from aqualvs.results.files import Claim
from aqualvs.results.run_request import Water, prepared_rig
from aqualvs.scanner import Scanner, ScannerOptions
from aqualvs.scanning.posture import Posture, Refusal
from aqualvs.sources.base import PartHealth, State
from aqualvs.sources.fields import FrameFeed
from aqualvs.terminal import StopSignals

_Step: TypeAlias = tuple[PilotReport, float, Posture | Refusal]


class FollowLogOutput:
    """Writer of the pilot's steps; comes after the pilot among the outputs.

    `path`: created, or overwritten. Raises `OutputError` if it cannot be written.
    """

    name = "follow log"
    inline = True
    keeps_all = False

    def __init__(self, path: Path, pilot: Pilot) -> None:
        self._log, self._pilot = FollowLog(path), pilot
        self._told: PilotReport | None = None
        self._waiting: SimpleQueue[_Step | None] = SimpleQueue()
        self._trouble = ""
        self._thread = threading.Thread(target=self._write, name=self.name, daemon=True)
        self._thread.start()

    def send(self, sample: LiveSample) -> None:
        """Take the pilot's last step; return at once."""
        report = self._pilot.latest
        if report is None or report is self._told:
            return
        self._told = report
        self._waiting.put((report, sample.scan.time_s, sample.scan.posture))

    def health(self) -> PartHealth:
        """Return whether the log can be written."""
        if self._trouble:
            return PartHealth(self.name, State.FAULT, self._trouble)
        return PartHealth(self.name, State.OK)

    def close(self) -> None:
        """Write the remaining rows and close the file; further calls do nothing."""
        if self._thread.is_alive():
            self._waiting.put(None)
            self._thread.join(2.0)
        self._log.close()

    def _write(self) -> None:
        while (step := self._waiting.get()) is not None:
            report, frame_s, posture = step
            decision = Decision(report.effort, report.reason, report.guidance, report.engaged)
            try:
                self._log.write(1e-9 * report.at_ns, frame_s, posture, decision, report.state)
                self._trouble = ""
            except (OutputError, ValueError) as fault:
                self._trouble = str(fault)


@dataclass(frozen=True, slots=True, kw_only=True)
class FollowRequest:
    """Request to steer a vehicle."""

    source: str  # As `open_feed` takes it.
    rig: Path
    mavlink: str  # Address of the vehicle.
    gains: str  # Gains file, or the name of a vehicle whose gains come with the package.
    out: Path  # Folder for the log.
    aim: Aim
    # Who is there, and how it is steered.
    vehicle: VehicleSetup = field(default_factory=VehicleSetup)

    feed: FeedRequest = field(default_factory=FeedRequest)
    dashboard: str | None = None  # Address HOST:PORT of the pilot's page.
    token: str | None = None  # Its password.
    # Whether to record from the start; the page's button begins and ends recordings, too.
    record: bool = False
    # Folder of recordings; `out` if left out.
    record_to: Path | None = None

    record_video: bool = False
    water: Water = field(default_factory=Water)
    scanner: ScannerOptions = field(default_factory=ScannerOptions)
    overwrite: bool = False


def follow_and_tell(
    request: FollowRequest, echo: Callable[[str], object], keys: TextIO | None = None
) -> int:
    """Run until the source ends or the user stops it; return 0.

    It starts disengaged: a line on `keys` (the terminal) engages or disengages.

    Raises `AqualvsError` if an input cannot be used, or the source can never work.
    """
    rig = prepared_rig(request.rig, request.water, no_dome=False)
    mission, limits, setpoint = request.aim.mission(rig.working_range)
    holder = SetpointHolder(rig.working_range)
    holder.put(setpoint)
    gains = usable_gains(request.gains)
    steering = NetPilot(mission, RangeYawController(gains), SafetyGate(limits))
    scanner = Scanner(rig, request.scanner)
    with Claim("follow", [request.out / FOLLOW_CSV], overwrite=request.overwrite):
        warm_up(scanner)
        with contextlib.closing(MavlinkLink(request.mavlink, request.vehicle.link)) as link:
            pilot = Pilot(steering, ArduSubLink(link, request.vehicle.steering), holder)
            runner = _runner(request, scanner, link, pilot, holder, echo)
            echo("disengaged: Enter engages, Enter again gives the vehicle back; Ctrl-C ends")
            listen(pilot, sys.stdin if keys is None else keys, echo)
            with StopSignals() as stop:
                fault = runner.run(lambda: stop.caught is not None)
    if fault is not None:
        raise fault
    return 0


def _runner(
    request: FollowRequest,
    scanner: Scanner,
    link: MavlinkLink,
    pilot: Pilot,
    holder: SetpointHolder,
    echo: Callable[[str], object],
) -> LiveRunner:
    """Make the live loop; if a part fails, the parts made before it are closed."""
    sys.setswitchinterval(SWITCH_S)
    with ExitStack() as undo:
        undo.callback(pilot.close)
        pictures = request.feed.opened(request.source, realtime=True)
        feed = FrameFeed(pictures, scanner.rig.shutter)
        undo.callback(feed.close)
        # The pilot first: other outputs must not delay an effort.
        outputs: list[Output] = [pilot, MavlinkOutput(link)]
        outputs.append(FollowLogOutput(request.out / FOLLOW_CSV, pilot))
        undo.callback(outputs[-1].close)
        recorder = RecorderSwitch(
            request.out if request.record_to is None else request.record_to,
            recorder_options(request.scanner, video=request.record_video),
        )
        undo.callback(recorder.close)
        outputs += [recorder, Console()]
        if request.record:
            echo(f"recording: {recorder.start()}")
        if request.dashboard is not None:
            page = (request.dashboard, request.token, scanner.rig, holder, recorder, echo)
            outputs.append(serve_page(*page, lambda: pilot.latest.state if pilot.latest else None))
        runner = LiveRunner(feed, ScannerSupply(scanner), outputs, posture_filter=PostureFilter())
        undo.pop_all()
    return runner


def listen(pilot: Pilot, keys: TextIO, echo: Callable[[str], object]) -> threading.Thread:
    """Engage and disengage by lines of a terminal, in a thread of its own."""

    def toggle() -> None:
        for _ in keys:
            try:
                if pilot.engaged:
                    pilot.disengage()
                    echo("disengaged")
                else:
                    pilot.engage()
                    echo("engaged")
            except (AqualvsError, OSError) as fault:
                echo(str(fault))

    thread = threading.Thread(target=toggle, name="follow keys", daemon=True)
    thread.start()
    return thread
