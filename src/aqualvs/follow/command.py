"""The command `aqualvs follow --sim`: a simulated loop with log, figures and summary.

`LoopPage` shows the loop on the pilot's page, in real time. `RunWatch` reports progress in the
terminal and ends the run.
"""

import math
import time
from collections import deque
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from aqualvs.control.autopilot import Decision
from aqualvs.control.follow_log import FollowLog
from aqualvs.control.missions import HoldMission, Mission, Stage
from aqualvs.control.plan import load_plan
from aqualvs.control.safety import LimitReason, SafetyLimits
from aqualvs.control.tune import tune, usable_gains
from aqualvs.control.vehicle import Setpoint, SetpointHolder, VehicleState
from aqualvs.errors import OptionError
from aqualvs.follow.case import SimCase, sea, vehicle_model
from aqualvs.follow.log import write_log
from aqualvs.follow.loop import RangeSensor, SimulatedLoop, Timing
from aqualvs.follow.report import FIGURE_FILES, PAGE, summary_lines, write_report
from aqualvs.follow.sensor_model import Blind, LossOfSight, RenderedSensor, SampledSensor
from aqualvs.live.options import Page
from aqualvs.live.outputs.base import Output
from aqualvs.live.pilot import PilotReport
from aqualvs.optics.rig import Rig
from aqualvs.optics.shutter import Shutter
from aqualvs.recording.sample import Instants, LiveSample
from aqualvs.report.figure_style import check_matplotlib
from aqualvs.results.files import Claim
from aqualvs.scanning.posture import Posture, Refusal
from aqualvs.scanning.scan import Frame, Scan, ScanPoints
from aqualvs.simulation.cameras import simulated_camera
from aqualvs.simulation.dive import check_shutter, shutter_from_words
from aqualvs.simulation.net_motion import NetWall
from aqualvs.simulation.scenarios import example_rig
from aqualvs.sources.base import Health, PartHealth, State
from aqualvs.terminal import Echo, StopSignals


class LoopPage:
    """Page that shows a loop step by step, not faster than real time.

    `page`: its server. `rig`: of the samples that it shows. `holder`: holds the setpoint chosen on
    the page; a hold mission takes it over.
    """

    def __init__(self, page: Output, rig: Rig, loop: SimulatedLoop, holder: SetpointHolder) -> None:
        n_share = 50  # Number of frames over which the share of valid ones is computed.
        self._page, self._rig, self._loop, self._holder = page, rig, loop, holder
        self._start_s = time.monotonic()
        self._valid: deque[bool] = deque(maxlen=n_share)

    def keep_pace(self, now_s: float) -> None:
        """Take over the page's setpoint, and wait until the clock reaches a simulated time."""
        late_s = 0.2  # A larger lag behind the clock is not caught up.
        mission = self._loop.steering.mission
        if isinstance(mission, HoldMission):
            mission.setpoint = self._holder.setpoint
        ahead_s = self._start_s + now_s - time.monotonic()
        if ahead_s > 0.0:
            time.sleep(ahead_s)
        elif ahead_s < -late_s:
            self._start_s -= ahead_s

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
        report = PilotReport(at_ns=now_ns, frame=scan.index, decision=decision, state=state)
        sample = LiveSample(
            rig=self._rig,
            scan=scan,
            peaks={},
            frame=frame,
            utc_ns=time.time_ns(),
            instants=Instants(now_ns, now_ns, now_ns),
            filtered=self._loop.filtered,
            health=self._health(report),
        )
        self._page.send(sample)

    def close(self) -> None:
        """Close the page."""
        self._page.close()

    def _seen(self, frame_s: float, posture: Posture | Refusal) -> tuple[Frame | None, Scan]:
        """Return the picture and the scan of a step; without rendering, None and an empty scan."""
        sensor = self._loop.sensor
        if isinstance(sensor, RenderedSensor):
            for frame, scan in sensor.shots:
                if scan.posture is posture:
                    return frame, scan
        index = round(frame_s * self._loop.timing.fps)
        return None, Scan(index, frame_s, posture, ScanPoints.none(), self._rig.n_water)

    def _health(self, report: PilotReport) -> Health:
        link = self._loop.link
        kind = "rendered" if isinstance(self._loop.sensor, RenderedSensor) else "no"
        vehicle = f"{report.state.mode_name}, effort forward {report.decision.effort.forward:+.2f}"
        return Health(
            rate_hz=self._loop.timing.fps,
            valid_share=sum(self._valid) / len(self._valid),
            n_frames=report.frame + 1,
            source=PartHealth("simulation", State.OK, f"{kind} pictures"),
            outputs=(
                PartHealth("pilot", report.health_state, report.words),
                PartHealth(link.name, State.OK, vehicle),
            ),
        )


class RunWatch:
    """Callback before each frame that prints events and decides whether to continue.

    `seconds`: duration of the whole run, which a signal to `stop` ends early. `slow`: whether it is
    slow, as with rendering, so that progress is printed.
    """

    def __init__(
        self, loop: SimulatedLoop, seconds: float, echo: Echo, stop: StopSignals, *, slow: bool
    ) -> None:
        self._loop, self._seconds, self._echo, self._stop = loop, seconds, echo, stop
        self._reported_s = 0.0 if slow else math.inf
        self._over_s = math.inf

    def __call__(self, now_s: float) -> bool:
        """Report changes; return False to end the run."""
        min_s = 1.0  # Shortest run: the report needs some rows.
        holds_on_s = 5.0  # Time to show that the vehicle keeps holding after the plan's end.
        report_every_s = 10.0  # Simulated time between reports of progress.
        if now_s - self._reported_s >= report_every_s:
            self._reported_s = now_s
            self._echo(f"simulated {now_s:.0f} of {self._seconds:g} s")
        steering, rows = self._loop.steering, self._loop.log.rows
        if not steering.engaged:
            reason = steering.gate.latched
            words = "disengaged" if reason is None else reason.words
            self._echo(f"at {now_s:.1f} s: {words}; here a pilot takes over")
            return False
        if self._over_s == math.inf and rows and rows[-1].stage == Stage.OVER.value:
            self._over_s = now_s
            self._echo(f"at {now_s:.1f} s: {LimitReason.MISSION_OVER.words}")
        stopped = self._stop.caught is not None and now_s >= min_s
        return not stopped and now_s < self._over_s + holds_on_s


FOLLOW_CSV, TRUTH_CSV = "follow.csv", "truth.csv"


@dataclass(frozen=True, slots=True, kw_only=True)
class Aim:
    """Aim of the loop: a plan file, or a range and yaw to hold."""

    plan: Path | None = None
    range: float | None = None  # Metres; 0.6 if neither range nor plan is given.
    yaw: float = 0.0  # Radians.

    def mission(self, working_range: tuple[float, float]) -> tuple[Mission, SafetyLimits, Setpoint]:
        """Return the mission, the limits of the safety gate, and the first setpoint.

        Raises `OptionError` if both are given, the plan cannot be used, or the range cannot be
        measured.
        """
        default_range = 0.6
        holder = SetpointHolder(working_range)
        if self.plan is not None:
            if self.range is not None or self.yaw:
                raise OptionError("--plan: brings its own range and yaw; leave --range, --yaw out")
            plan = load_plan(self.plan)
            holder.put(plan.setpoint)
            return plan.mission(), plan.limits, plan.setpoint
        setpoint = Setpoint(default_range if self.range is None else self.range, self.yaw)
        holder.put(setpoint)
        return HoldMission(setpoint), SafetyLimits(), setpoint


@dataclass(frozen=True, slots=True, kw_only=True)
class SimRequest:
    """Request of `aqualvs follow --sim`, see its `--help`."""

    out: Path  # Folder to write.
    aim: Aim
    vehicle: str = "bluerov2"  # A name of `VEHICLE_NAMES`.
    gains: str | None = None  # Gains file, or a vehicle's name; tuned for the vehicle if left out.
    pilot_gain: float = 0.5  # ArduSub's pilot gain.
    # Speed in m/s, and direction of flow, in radians clockwise from the direction of view.
    current: float = 0.3
    current_to: float = math.radians(60.0)
    waves: float = 0.1  # Amplitude in metres.
    cage_radius: float = 0.0  # Radius of a round net seen from inside, in metres; 0 for a flat net.
    net_sway: float = 0.0  # Amplitude of the net's own motion, in metres.

    seconds: float = 60.0
    fps: float = 25.0  # Frames a second.
    # Render every frame and measure in it, instead of sampling the scanner's noise.
    rendered: bool = False
    # Simulated camera that takes the rendered frames; the ideal one if left out.
    camera: str | None = None
    # Shutter of that camera, for `shutter_from_words`; all rows at once if left out.
    shutter: str | None = None

    seed: int = 0
    # Time from which on the picture is frozen, in seconds; never if left out.
    freeze: float | None = None
    page: Page | None = None  # The pilot's page; with it, the run is in real time.
    overwrite: bool = False  # Whether to replace earlier output of this command in `out`.

    def __post_init__(self) -> None:
        """Raise `OptionError` naming the value if it cannot be simulated."""
        # A second to a day; frame rates of the slowest and the fastest cameras.
        min_s, max_s, min_fps, max_fps = 1.0, 86_400.0, 1.0, 1000.0
        # Metres.
        min_radius = 2.0
        if not min_s <= self.seconds <= max_s:
            raise OptionError(
                f"--seconds {self.seconds:g}: choose at least {min_s:g}, at most {max_s:g}"
            )
        if not min_fps <= self.fps <= max_fps:
            raise OptionError(f"--fps {self.fps:g}: choose {min_fps:g} to {max_fps:g}")
        if self.camera is not None and not self.rendered:
            raise OptionError(f"--camera {self.camera}: takes rendered frames; add --rendered")
        if self.shutter is not None:
            if not self.rendered:
                raise OptionError(f"--shutter {self.shutter}: of rendered frames; add --rendered")
            check_shutter(shutter_from_words(self.shutter, self.fps), self.fps)
        if self.cage_radius and not self.cage_radius >= min_radius:
            raise OptionError(
                f"--cage-radius {self.cage_radius:g}: choose at least {min_radius:g} m, or 0 "
                "for a flat net"
            )
        if not (0.0 <= self.current <= 2.0 and 0.0 <= self.net_sway <= 1.0):
            raise OptionError(
                f"--current {self.current:g} m/s, --net-sway {self.net_sway:g} m: choose 0 to 2, "
                "and 0 to 1"
            )
        if self.freeze is not None and not 0.0 <= self.freeze < self.seconds:
            raise OptionError(
                f"--freeze {self.freeze:g}: choose 0 s or later, but before the end after "
                f"{self.seconds:g} s (--seconds)"
            )


def run_simulation(request: SimRequest, echo: Echo) -> int:
    """Run the loop, write log, figures and page, and print the summary; return 0.

    Raises `AqualvsError` if an input cannot be used, or the folder cannot be written.
    """
    check_matplotlib("aqualvs follow --sim")
    rig = example_rig()
    if request.shutter is not None:
        rig = replace(rig, shutter=shutter_from_words(request.shutter, request.fps))
    mission, limits, setpoint = request.aim.mission(rig.working_range)
    case = _case(request, limits, setpoint, rig.shutter)
    files = [request.out / name for name in (FOLLOW_CSV, TRUTH_CSV, PAGE, *FIGURE_FILES)]
    with Claim("follow", files, overwrite=request.overwrite):
        rng = np.random.default_rng([request.seed, 53])
        freeze_s = math.inf if request.freeze is None else request.freeze
        frozen = (Blind(freeze_s, math.inf, LossOfSight.FROZEN),)
        sensor: RangeSensor = SampledSensor(
            case.net, rng, blind=frozen, working_range=rig.working_range
        )
        if request.rendered:
            camera = simulated_camera(request.camera or "ideal")
            sensor = RenderedSensor(case.net, rig, rng, camera=camera, freeze_s=freeze_s)
        loop = case.loop(sensor, mission)
        with ExitStack() as stack:
            page = None
            if request.page is not None:
                holder = SetpointHolder(rig.working_range)
                holder.put(setpoint)
                served = request.page.serve(rig, holder, None, echo, loop.link.state)
                page = stack.enter_context(closing(LoopPage(served, rig, loop, holder)))
            _run(loop, request, page, echo)
        write_log(loop.log, request.out / TRUTH_CSV)
        measured = "rendered pictures, measured" if request.rendered else "sampled postures"
        setup = (
            f"{case.model.name}, current {request.current:g} m/s, waves of {request.waves:g} m "
            f"amplitude, {measured} at {case.timing.fps:g} Hz"
        )
        report = write_report(loop.log, setup, request.out)
    for line in summary_lines(loop.log, setup):
        echo(line)
    echo(f"written: {report}")
    return 0


def _case(
    request: SimRequest, limits: SafetyLimits, setpoint: Setpoint, shutter: Shutter
) -> SimCase:
    """Return the simulated run of a request."""
    timing = Timing(fps=request.fps)
    if shutter.is_interlaced:
        timing = Timing(fps=2.0 * request.fps, field=shutter.readout)
    model = vehicle_model(request.vehicle, request.pilot_gain)
    return SimCase(
        model=model,
        gains=tune(model).gains if request.gains is None else usable_gains(request.gains),
        water=sea(
            current=request.current,
            current_to=request.current_to,
            waves=request.waves,
            seed=request.seed,
        ),
        net=NetWall(
            curvature=-1.0 / request.cage_radius if request.cage_radius else 0.0,
            sway=request.net_sway,
            sway_period=8.0,
        ),
        start_range=setpoint.range,
        start_yaw=setpoint.yaw,
        timing=timing,
        limits=limits,
        seed=request.seed,
    )


def _run(loop: SimulatedLoop, request: SimRequest, page: LoopPage | None, echo: Echo) -> None:
    """Run the loop and write its log; Ctrl-C ends it early."""
    with StopSignals() as stop, FollowLog(request.out / FOLLOW_CSV) as follow_log:
        watch = RunWatch(loop, request.seconds, echo, stop, slow=request.rendered)
        if page is None:
            loop.on_step = follow_log.write
            loop.run(request.seconds, watch)
            return

        def show(*step: Any) -> None:
            follow_log.write(*step)
            page.take(*step)

        def every_frame(now_s: float) -> bool:
            page.keep_pace(now_s)
            return watch(now_s)

        loop.on_step = show
        echo("in real time; Ctrl-C ends it")
        loop.run(request.seconds, every_frame)
