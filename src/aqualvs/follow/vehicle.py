"""The command `aqualvs follow SOURCE`: hold and follow with a real vehicle, with a log.

A separate thread writes the log, so that the disk never delays the pilot.
"""

import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from queue import SimpleQueue
from typing import TextIO, TypeAlias

from aqualvs.control.autopilot import NetPilot
from aqualvs.control.controller import RangeYawController
from aqualvs.control.follow_log import FollowLog
from aqualvs.control.safety import SafetyGate
from aqualvs.control.tune import usable_gains
from aqualvs.control.vehicle import SetpointHolder
from aqualvs.errors import AqualvsError, OutputError
from aqualvs.follow.command import FOLLOW_CSV, Aim
from aqualvs.live.command import LiveRequest, make_runner, run_and_sum_up
from aqualvs.live.mavlink.ardusub import ArduSubLink
from aqualvs.live.mavlink.link import MavlinkLink
from aqualvs.live.options import VehicleSetup
from aqualvs.live.outputs.base import Output
from aqualvs.live.outputs.mavlink import MavlinkOutput
from aqualvs.live.pilot import Pilot, PilotReport
from aqualvs.live.runner import ScannerProvider, warm_up
from aqualvs.recording.sample import LiveSample
from aqualvs.results.files import Claim
from aqualvs.results.run_request import prepared_rig
from aqualvs.scanner import Scanner
from aqualvs.scanning.posture import Posture, Refusal
from aqualvs.sources.base import PartHealth, State
from aqualvs.terminal import Echo

_Step: TypeAlias = tuple[PilotReport, float, Posture | Refusal]


class FollowLogOutput(Output):
    """Output that logs the pilot's steps; it must follow the pilot in the list of outputs.

    `path` is created, or overwritten. Raises `OutputError` if it cannot be written.
    """

    name = "follow log"
    inline = True

    def __init__(self, path: Path, pilot: Pilot) -> None:
        self._log, self._pilot = FollowLog(path), pilot
        self._last: PilotReport | None = None
        self._waiting: SimpleQueue[_Step | None] = SimpleQueue()
        self._fault = ""
        self._thread = threading.Thread(target=self._write, name=self.name, daemon=True)
        self._thread.start()

    def send(self, sample: LiveSample) -> None:
        """Queue the pilot's last step, without waiting for the disk."""
        report = self._pilot.latest
        if report is None or report is self._last:
            return
        self._last = report
        self._waiting.put((report, sample.scan.time_s, sample.scan.posture))

    def health(self) -> PartHealth:
        """Return whether the log can be written."""
        if self._fault:
            return PartHealth(self.name, State.FAULT, self._fault)
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
            at_s = 1e-9 * report.at_ns
            try:
                self._log.write(at_s, frame_s, posture, report.decision, report.state)
                self._fault = ""
            except (OutputError, ValueError) as fault:
                self._fault = str(fault)


@dataclass(frozen=True, slots=True, kw_only=True)
class FollowRequest:
    """Request to steer a vehicle."""

    live: LiveRequest  # Source, rig, page and recordings; postures are smoothed in any case.
    mavlink: str  # Address of the vehicle.
    gains: str  # Gains file, or the name of a vehicle whose gains come with the package.
    out: Path  # Folder for the log.
    aim: Aim
    # Expected systems, and options of steering.
    vehicle: VehicleSetup = field(default_factory=VehicleSetup)
    overwrite: bool = False


def run_follow(request: FollowRequest, echo: Echo, keys: TextIO | None = None) -> int:
    """Steer until the source ends or the user stops it; return 0.

    The pilot starts disengaged: a line on `keys` (by default the terminal) engages or disengages
    it.

    Raises `AqualvsError` if an input cannot be used, or the source fails for good.
    """
    live, log = replace(request.live, smooth=True), request.out / FOLLOW_CSV
    rig = prepared_rig(live.rig, live.water, no_dome=False)
    mission, limits, setpoint = request.aim.mission(rig.working_range)
    holder = SetpointHolder(rig.working_range)
    holder.put(setpoint)
    gains = usable_gains(request.gains)
    steering = NetPilot(mission, RangeYawController(gains), SafetyGate(limits))
    scanner = Scanner(rig, live.scanner)
    with Claim("follow", [log], overwrite=request.overwrite):
        warm_up(scanner)
        with (
            closing(MavlinkLink(request.mavlink, request.vehicle.link)) as link,
            closing(Pilot(steering, ArduSubLink(link, request.vehicle.steering), holder)) as pilot,
        ):
            runner = make_runner(
                live,
                rig,
                lambda: ScannerProvider(scanner),
                holder,
                echo,
                first=_outputs(link, pilot, log),
                vehicle=lambda: pilot.latest.state if pilot.latest else None,
            )
            echo("disengaged: Enter engages, Enter again gives the vehicle back; Ctrl-C ends")
            listen(pilot, sys.stdin if keys is None else keys, echo)
            code = run_and_sum_up(runner, echo)
    echo(f"written: {log}")
    return code


def _outputs(link: MavlinkLink, pilot: Pilot, log: Path) -> Iterator[Output]:
    # The pilot first: other outputs must not delay an effort.
    yield pilot
    yield MavlinkOutput(link)
    yield FollowLogOutput(log, pilot)


def listen(pilot: Pilot, keys: TextIO, echo: Echo) -> threading.Thread:
    """Engage and disengage by lines of a terminal, in a separate thread; return the thread."""

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
