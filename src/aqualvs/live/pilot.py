"""The output that closes the control loop: each sample becomes an effort, or none.

`Watchdog` stops the thrusters when no new effort comes in time. `PilotReport` describes each step
for the pilot's page and the health list.
"""

import logging
import math
import threading
import time
from dataclasses import dataclass, replace

from aqualvs.control.autopilot import Decision, NetPilot, motion_of
from aqualvs.control.missions import Guidance, HoldMission
from aqualvs.control.safety import LimitReason
from aqualvs.control.vehicle import NEUTRAL, Effort, Mode, SetpointHolder, VehicleLink, VehicleState
from aqualvs.errors import OptionError
from aqualvs.live.outputs.base import Output
from aqualvs.recording.sample import LiveSample
from aqualvs.scanning.posture import Posture, Refusal
from aqualvs.scanning.posture import Reason as NoPosture
from aqualvs.sources.base import PartHealth, State

_log = logging.getLogger(__name__)


class Watchdog:
    """Watchdog of efforts: passes them on, and sends neutral after one that is not renewed.

    Neither a frame that takes seconds to measure nor a controller that hangs must leave thrust
    standing; the vehicle's own fail-safe comes later, and does not act while others send it sticks.

    `timeout_s`: time that an effort may stay in force.
    """

    def __init__(self, vehicle: VehicleLink, timeout_s: float) -> None:
        self._vehicle, self._timeout_s = vehicle, timeout_s
        # Held only for calls that return at once, so that nothing can delay neutral.
        self._sending = threading.Lock()
        self._known_s = float("-inf")
        self._thrusting = threading.Event()
        self._closing = threading.Event()
        self.n_barks = 0  # How often it had to act.
        self._thread = threading.Thread(target=self._run, name="pilot watchdog", daemon=True)
        self._thread.start()

    def send(self, effort: Effort, known_s: float) -> Effort:
        """Send an effort, or neutral if it is already too old; return the sent effort.

        `known_s`: time at which its posture was known, by `time.monotonic`. Raises `OSError` or
        `ValueError` as `VehicleLink.send`.
        """
        with self._sending:
            if time.monotonic() - known_s > self._timeout_s:
                effort = NEUTRAL
            self._known_s = known_s
            # Before sending: an effort that was sent despite an error is stopped all the same.
            if effort == NEUTRAL:
                self._thrusting.clear()
            else:
                self._thrusting.set()
            self._vehicle.send(effort)
        return effort

    def close(self) -> None:
        """End the thread; further calls do nothing."""
        self._closing.set()
        self._thrusting.set()
        self._thread.join(1.0)

    def _run(self) -> None:
        look_s = 0.02
        self._thrusting.wait()
        while not self._closing.wait(look_s):
            self._look()
            self._thrusting.wait()

    def _look(self) -> None:
        """Stop the thrusters if their effort has stood for too long."""
        with self._sending:
            late_s = time.monotonic() - self._known_s
            if not self._thrusting.is_set() or late_s <= self._timeout_s:
                return
            try:
                self._vehicle.send(NEUTRAL)
            except OSError:
                # Tried again in a moment.
                return
            self._thrusting.clear()
            self.n_barks += 1
        _log.warning("no new posture for %.2f s: neutral", late_s)


_MODE_REASONS = (
    LimitReason.PILOT_MODE,
    LimitReason.NO_STATION,
    LimitReason.IGNORED,
    LimitReason.CONFLICT,
    LimitReason.UNKNOWN_MODE,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class PilotReport:
    """One step of the pilot."""

    at_ns: int  # By `time.monotonic_ns`.
    frame: int  # Number of the frame that it rests on; the last one's where the stream is silent.
    decision: Decision  # With the effort that was sent; neutral where nothing was.
    state: VehicleState  # As the vehicle reported it.

    @property
    def words(self) -> str:
        """Action of the pilot, or the reason for none, in one line."""
        reason, doubt = self.decision.reason, self.state.doubt
        text = words_of(reason, self.state) if reason else _aim_text(self.decision.guidance)
        return f"{text}; {doubt}" if self.decision.engaged and doubt else text

    @property
    def health_state(self) -> State:
        """State for the health list."""
        if not self.decision.engaged:
            return State.OFF
        return State.WARN if self.decision.reason or self.state.doubt else State.OK


def words_of(reason: LimitReason, state: VehicleState) -> str:
    """Return the reason why efforts do not pass, with the vehicle's report of it."""
    text = state.mode_name if reason in _MODE_REASONS else ""
    if reason is LimitReason.CONFLICT and state.mode is not Mode.CONFLICT:
        text = state.rival
    return f"{reason.words} ({text})" if text else reason.words


def _aim_text(guidance: Guidance) -> str:
    """Return the aim of a mission."""
    stage, setpoint = guidance.stage.value.replace("_", " "), guidance.setpoint
    if setpoint is None:
        return stage
    aim = f"{setpoint.range:.2f} m, yaw {math.degrees(setpoint.yaw):.0f} deg"
    sway = f", {guidance.sway:+.2f} m/s to the right" if guidance.sway else ""
    return f"{stage}: {aim}{sway}"


# Several, as datagrams may be lost; only one while the pilot moves his sticks, not to disturb him.
_NEUTRALS, _NEUTRALS_TO_STICKS = 3, 1


class Pilot(Output):
    """Output of a live run that steers a vehicle by the measured posture.

    It starts disengaged and sends nothing. `engage` lets efforts pass; a mode change, the pilot's
    sticks, disarming and a silent vehicle end that until `engage` is called again. Then neutral
    goes out a few times, and nothing more: further sticks of ours would be in the pilot's way.

    `vehicle`: closed with this output. `holder`: where the page puts the setpoint; a mission that
    holds follows it.
    """

    name = "pilot"
    inline = True

    def __init__(
        self, steering: NetPilot, vehicle: VehicleLink, holder: SetpointHolder | None = None
    ) -> None:
        self._steering, self._vehicle, self._holder = steering, vehicle, holder
        self._timeout_s = steering.gate.limits.posture_age
        self._watchdog = Watchdog(vehicle, self._timeout_s)
        # Samples come from one thread, engaging from another.
        self._stepping = threading.Lock()
        # Neutrals still to be sent; negative while engaged.
        self._neutrals_left = 0
        self._seen_s = float("-inf")
        self._latest: PilotReport | None = None
        self._fault = ""
        self._unsent = ""
        self._n_unsent = 0
        self._logged: tuple[bool, LimitReason | None, str] = (False, LimitReason.NOT_ENGAGED, "")

    @property
    def engaged(self) -> bool:
        """Whether efforts pass."""
        return self._steering.engaged

    @property
    def latest(self) -> PilotReport | None:
        """The last step; None before the first."""
        return self._latest

    def engage(self) -> None:
        """Engage on request of the user.

        Raises `OptionError` if that cannot be: no setpoint, another mode, disarmed, sticks off
        their centre.
        """
        with self._stepping:
            holds = isinstance(self._steering.mission, HoldMission)
            if holds and self._holder is not None and self._holder.setpoint is None:
                raise OptionError(f"pilot: {LimitReason.NO_SETPOINT.words}; choose one first")
            try:
                state = self._vehicle.state()
                refused = self._steering.engage(time.monotonic(), state)
            except BaseException:
                self._steering.disengage()
                raise
            if refused is not None:
                raise OptionError(f"pilot: not engaged: {words_of(refused, state)}")
            self._fault, self._neutrals_left = "", 0
            self._logged = (True, None, "")
        _log.info("pilot: engaged")

    def disengage(self) -> None:
        """Give the vehicle back: neutral at once."""
        with self._stepping:
            if not self._steering.engaged:
                return
            self._steering.disengage()
            self._logged = (False, LimitReason.NOT_ENGAGED, "")
            self._neutrals_left = _NEUTRALS
            self._send(NEUTRAL)
        _log.info("pilot: disengaged")

    def send(self, sample: LiveSample) -> None:
        """Take one step; never waits, and never raises faults of control or vehicle."""
        with self._stepping:
            now_s = time.monotonic()
            try:
                state = self._vehicle.state()
                decision = self._decide(sample, now_s, state)
            except Exception as fault:
                self._stop_after(fault)
                return
            sent = replace(decision, effort=self._execute(decision))
            at_ns, frame = round(1e9 * now_s), sample.scan.index
            report = PilotReport(at_ns=at_ns, frame=frame, decision=sent, state=state)
            self._latest = report
        told = (report.decision.engaged, report.decision.reason, report.state.doubt)
        if told != self._logged:
            self._logged = told
            level = logging.INFO if report.health_state is State.OK else logging.WARNING
            _log.log(level, "pilot, frame %d: %s", report.frame, report.words)

    def health(self) -> PartHealth:
        """Return the pilot's action, or the reason for none."""
        latest, engaged = self._latest, self.engaged
        if fault := self._fault or self._unsent:
            state, words = State.FAULT, fault
        elif latest is not None and latest.decision.engaged is engaged:
            state, words = latest.health_state, latest.words
        elif engaged:
            state, words = State.OK, "engaged"
        else:
            state, words = State.OFF, LimitReason.NOT_ENGAGED.words
        return PartHealth(self.name, state, words, self._n_unsent)

    def close(self) -> None:
        """Stop, send neutral and free the vehicle; further calls do nothing."""
        self.disengage()
        self._watchdog.close()
        self._vehicle.close()

    def _decide(self, sample: LiveSample, now_s: float, state: VehicleState) -> Decision:
        mission = self._steering.mission
        if self._holder is not None and isinstance(mission, HoldMission):
            mission.setpoint = self._holder.setpoint
        return self._steering.step(
            now_s,
            sample.scan.time_s,
            self._current_posture(sample, now_s),
            motion_of(sample.filtered),
            state,
        )

    def _current_posture(self, sample: LiveSample, now_s: float) -> Posture | Refusal:
        """Return the posture, unless measuring took so long that it is outdated."""
        posture, arrived_s = sample.scan.posture, 1e-9 * sample.instants.arrived_ns
        if not posture:
            return posture
        if now_s - arrived_s > self._timeout_s:
            return Refusal(NoPosture.NO_FRAMES, f"measured {now_s - arrived_s:.2f} s late")
        self._seen_s = arrived_s
        return posture

    def _execute(self, decision: Decision) -> Effort:
        """Send the decided effort; return the sent one."""
        if decision.engaged:
            self._neutrals_left = -1
            return self._send(decision.effort)
        by_sticks = decision.reason is LimitReason.PILOT_STICKS
        self._send_neutral(_NEUTRALS_TO_STICKS if by_sticks else _NEUTRALS)
        return NEUTRAL

    def _send_neutral(self, n_after_effort: int) -> None:
        """Send neutral, a limited number of times after an effort."""
        if self._neutrals_left < 0:
            self._neutrals_left = n_after_effort
        if self._neutrals_left > 0:
            self._neutrals_left -= 1
            self._send(NEUTRAL)

    def _send(self, effort: Effort) -> Effort:
        """Send an effort that rests on the last posture; return the sent one."""
        try:
            sent = self._watchdog.send(effort, self._seen_s)
        except (OSError, ValueError) as fault:
            self._n_unsent += 1
            self._unsent = str(fault)
            return NEUTRAL
        self._unsent = ""
        return sent

    def _stop_after(self, fault: Exception) -> None:
        """Stop after an exception of control, until engaged again."""
        words = f"stopped by a fault: {fault}"
        if words != self._fault:
            _log.exception("pilot: %s", words)
        self._fault = words
        self._steering.disengage()
        self._logged = (False, LimitReason.NOT_ENGAGED, "")
        if self._latest is not None:
            guidance = self._latest.decision.guidance
            stopped = Decision(NEUTRAL, LimitReason.NOT_ENGAGED, guidance, engaged=False)
            self._latest = replace(self._latest, decision=stopped)
        self._send_neutral(_NEUTRALS)
