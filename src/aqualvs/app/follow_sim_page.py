"""A simulated loop on the pilot's page, in real time."""

import time
from collections import deque

from aqualvs.app.follow_rendered import RenderedEye
from aqualvs.app.follow_sim import SimulatedLoop
from aqualvs.control.autopilot import Decision
from aqualvs.control.mission import HoldMission
from aqualvs.control.setpoint import SetpointHolder
from aqualvs.control.vehicle import VehicleState
from aqualvs.live.health import Health, PartHealth, State
from aqualvs.live.outputs.base import Output
from aqualvs.live.pilot_report import PilotReport
from aqualvs.live.sample import Instants, LiveSample
from aqualvs.optics.rig import Rig
from aqualvs.scanning.posture import Posture, Refusal
from aqualvs.scanning.scan import Frame, Scan, ScanPoints

# So far behind the clock, a run does not try to catch up.
_LATE_S = 0.2
# Frames that the share of valid ones counts.
_N_SHARE = 50


class LoopPage:
    """Shows a loop step by step, and lets it run no faster than the clock.

    Parameters
    ----------
    page : Output
        Closed with this.
    rig : Rig
    loop : SimulatedLoop
    holder : SetpointHolder
        Where the page puts the setpoint; a mission that holds follows it.
    """

    def __init__(self, page: Output, rig: Rig, loop: SimulatedLoop, holder: SetpointHolder) -> None:
        self._page, self._rig, self._loop, self._holder = page, rig, loop, holder
        self._began_s = time.monotonic()
        self._valid: deque[bool] = deque(maxlen=_N_SHARE)

    def keep_pace(self, now_s: float) -> None:
        """Take over the page's setpoint, and wait for the clock to reach a simulated time."""
        mission = self._loop.steering.mission
        if isinstance(mission, HoldMission):
            mission.setpoint = self._holder.setpoint
        ahead_s = self._began_s + now_s - time.monotonic()
        if ahead_s > 0.0:
            time.sleep(ahead_s)
        elif ahead_s < -_LATE_S:
            self._began_s -= ahead_s

    def take(
        self,
        _now_s: float,
        frame_s: float,
        posture: Posture | Refusal,
        decision: Decision,
        state: VehicleState,
    ) -> None:
        """Show one step of the pilot."""
        frame, scan = self._seen(frame_s, posture)
        self._valid.append(bool(posture))
        now_ns = time.monotonic_ns()
        report = PilotReport(
            at_ns=now_ns,
            frame=scan.index,
            engaged=decision.engaged,
            effort=decision.effort,
            reason=decision.reason,
            guidance=decision.guidance,
            state=state,
        )
        sample = LiveSample(
            rig=self._rig,
            scan=scan,
            returns={},
            frame=frame,
            utc_ns=time.time_ns(),
            instants=Instants(now_ns, now_ns, now_ns),
            filtered=self._loop.filtered,
            health=self._health(report),
        )
        self._page.send(sample)

    def close(self) -> None:
        """End the page."""
        self._page.close()

    def _seen(self, frame_s: float, posture: Posture | Refusal) -> tuple[Frame | None, Scan]:
        """Return the picture of a step with its points, where pictures are rendered."""
        eye = self._loop.eye
        if isinstance(eye, RenderedEye):
            for frame, scan in eye.shots:
                if scan.posture is posture:
                    return frame, scan
        index = round(frame_s * self._loop.timing.fps)
        return None, Scan(index, frame_s, posture, ScanPoints.none(), self._rig.n_water)

    def _health(self, report: PilotReport) -> Health:
        link = self._loop.link
        eye = "rendered pictures" if isinstance(self._loop.eye, RenderedEye) else "no pictures"
        vehicle = f"{report.state.mode_name}, effort forward {report.effort.forward:+.2f}"
        return Health(
            rate_hz=self._loop.timing.fps,
            valid_share=sum(self._valid) / len(self._valid),
            n_frames=report.frame + 1,
            source=PartHealth("simulation", State.OK, eye),
            outputs=(
                PartHealth("pilot", report.colour, report.words),
                PartHealth(link.name, State.OK, vehicle),
            ),
        )
