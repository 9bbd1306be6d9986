"""The closed loop in simulated time: frames, time filter, pilot, vehicle, water and net.

The time filter and `NetPilot` with mission, controller and safety gate are those of a live run; the
rules of the live pilot's watchdog are repeated here. Delays are simulated event by event: a frame
is exposed, arrives later, and its effort reaches the vehicle after the latency of the link.

`SimulatedLink` gives the simulated vehicle the interface that the controllers use.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeAlias

from aqualvs.control.autopilot import Decision, NetPilot, motion_of
from aqualvs.control.time_filter import FilteredPosture, PostureFilter
from aqualvs.control.tune import shaping_of_model
from aqualvs.control.vehicle import NEUTRAL, Effort, Mode, VehicleState
from aqualvs.errors import OptionError
from aqualvs.follow.log import LoopLog, LoopRow
from aqualvs.geometry.transforms import SE3
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.simulation.net_motion import NetWall
from aqualvs.simulation.vehicle.vehicle import SimulatedVehicle


class SimulatedLink:
    """Link to a simulated vehicle, whose latency is that of the link, in simulated time."""

    def __init__(self, vehicle: SimulatedVehicle) -> None:
        self.vehicle = vehicle
        self.name = f"simulated {vehicle.model.name}"
        self.effort = NEUTRAL  # Last effort sent.
        self._shaping = shaping_of_model(vehicle.model)
        self._unsent: Effort | None = None

    def state(self) -> VehicleState:
        """Return the vehicle's reported state, by the vehicle's clock."""
        report_hz = 10.0  # Rate at which a vehicle reports its attitude.
        vehicle = self.vehicle
        return VehicleState(
            heard_s=math.floor(vehicle.time_s * report_hz) / report_hz,
            armed=vehicle.armed,
            mode=Mode.OURS if vehicle.obeys else Mode.PILOT,
            mode_name="ALT_HOLD" if vehicle.obeys else "MANUAL",
            **vehicle.telemetry()._asdict(),
        )

    def send(self, effort: Effort) -> None:
        """Send an effort to the vehicle."""
        self.effort = effort
        self._unsent = self._shaping.position(effort)

    def pass_time(self, until_s: float) -> None:
        """Simulate the vehicle until a time; do nothing if that has passed."""
        step = until_s - self.vehicle.time_s
        if step > 1e-9:
            self.vehicle.step(self._unsent, step)
            self._unsent = None


# As in the live run: time after which a silent stream is reported, and periods of further reports
# and of the watchdog's checks.
_SILENT_AFTER_S, _SILENT_EVERY_S, _WATCHDOG_EVERY_S = 0.20, 0.10, 0.02


OnStep: TypeAlias = Callable[[float, float, Posture | Refusal, Decision, VehicleState], object]


class RangeSensor(Protocol):
    """Interface of a sensor that measures the net's posture from a vehicle."""

    def look(self, world_from_dome: SE3, time_s: float) -> Posture | Refusal | None:
        """Return the result for the frame exposed now; None for a lost frame."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """Timing of the frames."""

    fps: float = 25.0  # Frames a second.
    delay: float = 0.06  # From the exposure to the measured posture, in seconds.
    # Additional delay of every other frame, from the first on, in seconds: the first field of an
    # interlaced picture arrives with the second.
    field: float = 0.0


class _Arrival(NamedTuple):
    """Result of a frame that has not reached the pilot yet."""

    at_s: float
    exposed_s: float
    posture: Posture | Refusal


class SimulatedLoop:
    """Simulation of a vehicle in front of a net, steered by what its lasers measure.

    `steering`: the pilot, which is engaged at the start.
    """

    def __init__(
        self,
        link: SimulatedLink,
        net: NetWall,
        sensor: RangeSensor,
        steering: NetPilot,
        timing: Timing | None = None,
    ) -> None:
        self.link, self.net, self.sensor, self.steering = link, net, sensor, steering
        self.timing = timing or Timing()
        self._filter = PostureFilter()
        # Called after every step of the pilot with the time, the frame's time, the posture or
        # refusal, the decision and the vehicle's state.
        self.on_step: OnStep | None = None
        # Longest age of a posture for thrust.
        self._timeout_s = steering.gate.limits.posture_age
        self._coming: deque[_Arrival] = deque()
        # Arrival of the last frame; last report of a silent stream.
        self._heard_s, self._reported_s = 0.0, -math.inf
        self._exposed_s = 0.0  # Exposure of the last frame.
        self.seen_s = -math.inf  # Arrival of the last valid posture.
        self._decision: Decision | None = None
        # State of the time filter at the last step; None while it has none.
        self.filtered: FilteredPosture | None = None
        self.log = LoopLog()

    def run(self, seconds: float, every_frame: Callable[[float], object] | None = None) -> LoopLog:
        """Simulate and return the log; a further call continues the run.

        Parameters
        ----------
        seconds : float
            Simulated time at which to end.
        every_frame : callable, optional
            Called with the time before each frame; may change the setpoint, and ends the run by
            returning False.

        Raises
        ------
        OptionError
            If the pilot refuses to engage.
        """
        if not self.log.rows:
            refused = self.steering.engage(0.0, self.link.state())
            if refused is not None:
                raise OptionError(f"simulated loop: not engaged: {refused.words}")
        frame = len(self.log.rows)
        while frame / self.timing.fps <= seconds:
            now_s = frame / self.timing.fps
            self._pass_time(now_s)
            if every_frame is not None and every_frame(now_s) is False:
                break
            self._expose(now_s)
            frame += 1
        return self.log

    def _pass_time(self, until_s: float) -> None:
        """Process all events until a time, in their order."""
        while True:
            arrives_s = self._coming[0].at_s if self._coming else math.inf
            silence_s = max(self._heard_s + _SILENT_AFTER_S, self._reported_s + _SILENT_EVERY_S)
            # When the watchdog stops the thrusters.
            stop_s = self.seen_s + self._timeout_s + _WATCHDOG_EVERY_S
            if self.link.effort == NEUTRAL:
                stop_s = math.inf
            next_s = min(arrives_s, silence_s, stop_s)
            if next_s > until_s:
                break
            self.link.pass_time(next_s)
            if arrives_s == next_s:
                self._receive(self._coming.popleft())
            elif stop_s == next_s:
                self._send(NEUTRAL, next_s)
            else:
                self._report_silence(next_s)
        self.link.pass_time(until_s)

    def _expose(self, now_s: float) -> None:
        """Expose a frame, and log the state."""
        posture = self.sensor.look(self.link.vehicle.dome_pose, now_s)
        if posture is not None:
            wait_s = 0.0 if len(self.log.rows) % 2 else self.timing.field
            at_s = now_s + self.timing.delay + wait_s
            # Both fields of a picture arrive at the same time, up to rounding.
            at_s = max(at_s, self._coming[-1].at_s) if self._coming else at_s
            self._coming.append(_Arrival(at_s, now_s, posture))
        self.log.rows.append(self._row(now_s, posture))

    def _receive(self, arrival: _Arrival) -> None:
        """Step the pilot with the posture of a frame."""
        self._heard_s, self._exposed_s = arrival.at_s, arrival.exposed_s
        if arrival.posture:
            self.log.note_sight(self.seen_s, arrival.at_s, self.link.effort != NEUTRAL)
            self.seen_s = arrival.at_s
        self._step(arrival.at_s, arrival.exposed_s, arrival.exposed_s, arrival.posture)

    def _report_silence(self, now_s: float) -> None:
        """Step the pilot without a frame."""
        self._reported_s = now_s
        silent_s = now_s - self._heard_s
        refusal = Refusal(Reason.NO_FRAMES, f"no picture for {silent_s:.1f} s")
        self._step(now_s, self._exposed_s, self._exposed_s + silent_s, refusal)

    def _step(
        self, now_s: float, frame_s: float, filter_s: float, posture: Posture | Refusal
    ) -> None:
        """Step time filter and pilot, and send the effort; `filter_s` is the filter's time."""
        self.filtered = self._filter.update(filter_s, posture)
        state = self.link.state()
        decision = self._decision = self.steering.step(
            now_s, frame_s, posture, motion_of(self.filtered), state
        )
        if self.on_step is not None:
            self.on_step(now_s, frame_s, posture, decision, state)
        self._send(decision.effort if decision.engaged else NEUTRAL, now_s)

    def _send(self, effort: Effort, now_s: float) -> None:
        """Send an effort, or neutral if the last valid posture is too old."""
        if now_s - self.seen_s > self._timeout_s:
            effort = NEUTRAL
        if effort == NEUTRAL and self.link.effort != NEUTRAL:
            self.log.note_neutral(self.seen_s, now_s)
        self.link.send(effort)

    def _row(self, now_s: float, posture: Posture | Refusal | None) -> LoopRow:
        """Return the row of the log for the present state."""
        vehicle, decision, seen = self.link.vehicle, self._decision, self.filtered
        truth = self.net.posture_at(vehicle.dome_pose, now_s)
        state = self.link.state()
        guidance = decision.guidance if decision else None
        setpoint = guidance.setpoint if guidance else None
        measured = posture if isinstance(posture, Posture) else None
        effort = self.link.effort
        return LoopRow(
            time_s=now_s,
            **truth._asdict(),
            clearance=self.net.clearance(vehicle.pose, vehicle.model.half_size, now_s),
            tilt=math.acos(min(max(float(vehicle.pose.rotation[2, 2]), -1.0), 1.0)),
            measured_range=measured.range if measured else math.nan,
            measured_pitch=measured.pitch if measured else math.nan,
            measured_yaw=measured.yaw if measured else math.nan,
            filtered_range=seen.range if seen else math.nan,
            filtered_yaw=seen.yaw if seen else math.nan,
            wanted_range=setpoint.range if setpoint else math.nan,
            wanted_yaw=setpoint.yaw if setpoint else math.nan,
            sway=guidance.sway if guidance else 0.0,
            forward=effort.forward,
            right=effort.right,
            down=effort.down,
            turn=effort.yaw,
            depth=state.depth if state.depth is not None else math.nan,
            heading=state.heading if state.heading is not None else math.nan,
            engaged=decision.engaged if decision else True,
            stage=guidance.stage.value if guidance else "",
            reason=decision.reason.value if decision and decision.reason else "",
            refusal=_refusal_of(posture),
        )


def _refusal_of(posture: Posture | Refusal | None) -> str:
    if posture is None:
        return Reason.NO_FRAMES.value
    return posture.reason.value if isinstance(posture, Refusal) else ""
