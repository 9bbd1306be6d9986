"""The log of a real dive under control; the disk never holds the pilot up."""

import threading
from pathlib import Path
from queue import SimpleQueue
from typing import TypeAlias

from aqualvs.control.autopilot import Decision
from aqualvs.control.follow_log import FollowLog
from aqualvs.errors import OutputError
from aqualvs.live.health import PartHealth, State
from aqualvs.live.pilot import Pilot
from aqualvs.live.pilot_report import PilotReport
from aqualvs.live.sample import LiveSample
from aqualvs.scanning.posture import Posture, Refusal

_Step: TypeAlias = tuple[PilotReport, float, Posture | Refusal]


class FollowLogOutput:
    """Writes what the pilot did, step by step; comes after the pilot among the outputs.

    Parameters
    ----------
    path : Path
        Written anew.
    pilot : Pilot

    Raises
    ------
    OutputError
        If it cannot be written.
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
        """Take in the pilot's last step; returns at once."""
        report = self._pilot.latest
        if report is None or report is self._told:
            return
        self._told = report
        self._waiting.put((report, sample.scan.time_s, sample.scan.posture))

    def health(self) -> PartHealth:
        """Return whether it can be written."""
        if self._trouble:
            return PartHealth(self.name, State.FAULT, self._trouble)
        return PartHealth(self.name, State.OK)

    def close(self) -> None:
        """Write what is left and close the file; further calls do nothing."""
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
