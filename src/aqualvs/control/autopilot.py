"""Mission, controller and safety gate combined, updated frame by frame.

Uses no clock, no threads and no link.
"""

import math
from dataclasses import dataclass

from aqualvs.control.answer_watch import AnswerWatch
from aqualvs.control.controller import RangeYawController
from aqualvs.control.missions import Guidance, Mission, Stage
from aqualvs.control.safety import NO_BRAKE, LimitReason, SafetyGate
from aqualvs.control.time_filter import FilteredPosture
from aqualvs.control.vehicle import NEUTRAL, Effort, VehicleState
from aqualvs.errors import OptionError
from aqualvs.scanning.posture import Posture, Refusal
from aqualvs.scanning.posture import Reason as NoPosture


@dataclass(frozen=True, slots=True)
class Motion:
    """Range and yaw with their rates, which are None where no time filter knows them."""

    # Metres and radians, as in `Posture`.
    range: float
    yaw: float
    # Per second.
    range_rate: float | None
    yaw_rate: float | None


def motion_of(filtered: FilteredPosture | None) -> Motion | None:
    """Return the answer of the package's own filter."""
    if filtered is None:
        return None
    range_rate, _, yaw_rate = filtered.rates.tolist()
    return Motion(filtered.range, filtered.yaw, range_rate, yaw_rate)


@dataclass(frozen=True, slots=True)
class Decision:
    """Result of one step."""

    effort: Effort  # What may be sent; neutral unless engaged.
    # Why it is not what the controller asked for, or why that is no more than to stay.
    reason: LimitReason | None
    guidance: Guidance  # What the mission wanted.
    engaged: bool  # Whether efforts pass; False until `NetPilot.engage`.


class NetPilot:
    """Autopilot that holds and follows by the measured posture.

    Raises `OptionError` if the mission moves sideways and the vehicle of the controller cannot.
    """

    def __init__(
        self, mission: Mission, controller: RangeYawController, gate: SafetyGate | None = None
    ) -> None:
        if mission.sways and not controller.gains.vehicle.can_sway:
            raise OptionError(
                f"vehicle {controller.gains.vehicle.name}: cannot move sideways; choose a mission "
                "that holds"
            )
        self.mission, self.controller = mission, controller
        self.gate = gate or SafetyGate()
        self._watch = AnswerWatch(controller.gains.vehicle)
        self._doubt: LimitReason | None = None
        # For how long the picture has stood still, where it tells so.
        self._still_s: float | None = None
        self._posture: Posture | None = None
        self._seen_s = self._frame_s = -math.inf
        self._asked: Effort | None = None

    @property
    def engaged(self) -> bool:
        """Whether efforts pass."""
        return self.gate.latched is None

    def engage(self, now_s: float, state: VehicleState) -> LimitReason | None:
        """Begin, or go on, as the pilot wants it; return why not, None if so."""
        refused = self.gate.engage(now_s, state)
        if refused is None:
            self.mission.restart()
            self.controller.reset()
            self._watch.restart()
            self._asked = self._doubt = None
        return refused

    def disengage(self) -> None:
        """Stop: neutral from the next step on, until `engage`."""
        self.gate.stop()

    def step(
        self,
        now_s: float,
        time_s: float,
        posture: Posture | Refusal | None,
        filtered: Motion | None,
        state: VehicleState,
    ) -> Decision:
        """Return the effort for one frame, or for a silent stream.

        Parameters
        ----------
        now_s : float
            By the clock of `VehicleState.heard_s`.
        time_s : float
            Of the frame, by the stream's clock.
        posture : Posture or Refusal or None
            As measured in the frame.
        filtered : Motion or None
            From the time filter, as of this frame, where there is one.
        state : VehicleState
            As the vehicle reports it.
        """
        if self._stream_restarted(time_s):
            _, reason = self.gate.check(now_s, math.inf, None, state, NEUTRAL)
            stopped = reason if reason is not None and reason.takes_over else LimitReason.CLOCK
            return Decision(NEUTRAL, stopped, _IDLE, self.engaged)
        present = self._new_posture(now_s, time_s, posture, state)
        guidance = self.mission.update(now_s, present, state) if self.engaged else _IDLE
        asked = self._request_effort(time_s, present, filtered, guidance)
        effort, reason = self.gate.check(
            now_s,
            now_s - self._seen_s,
            self._posture,
            state,
            asked or NEUTRAL,
            range_rate=None if filtered is None else filtered.range_rate,
            doubt=self._doubt,
            brake=NO_BRAKE if self._doubt is None else self._watch.brake(now_s, self._still_s),
        )
        self._watch.done(now_s, effort)
        self._report_sent(asked, effort, reason)
        if guidance.stage is Stage.GAVE_UP:
            # The target stayed away: the pilot gets the vehicle back.
            reason = LimitReason.GAVE_UP
            self.gate.stop(reason)
        reason = reason or _mission_reason(guidance)
        if reason is None and self.gate.tips(state):
            reason = LimitReason.TIPPING
        return Decision(effort, reason, guidance, self.engaged)

    def _stream_restarted(self, time_s: float) -> bool:
        """Return whether frame times have jumped back; then all that was seen is forgotten."""
        if not time_s < self._frame_s - _LATE_S:
            return False
        self._frame_s = time_s
        self._posture, self._seen_s, self._asked = None, -math.inf, None
        self.controller.reset()
        self._watch.reset()
        return True

    def _new_posture(
        self, now_s: float, time_s: float, posture: Posture | Refusal | None, state: VehicleState
    ) -> Posture | None:
        """Return the posture of a new frame; a picture that stands still is none."""
        if isinstance(posture, Refusal) and posture.reason is NoPosture.FROZEN:
            self._doubt, self._still_s = LimitReason.FROZEN, posture.still_s
            return None
        if not (isinstance(posture, Posture) and time_s > self._frame_s):
            return None
        self._frame_s = time_s
        self._doubt, self._still_s = self._watch.see(now_s, posture, state), None
        if self._doubt is LimitReason.FROZEN:
            return None
        self._posture, self._seen_s = posture, now_s
        return posture

    def _request_effort(
        self, time_s: float, posture: Posture | None, filtered: Motion | None, guidance: Guidance
    ) -> Effort | None:
        """Return the controller's effort; None, and the controller at rest, if it must not act."""
        motion = _motion(posture, filtered)
        if guidance.setpoint is None or guidance.stage.halts:
            return None
        if motion is None:
            # A frame or two without a posture: the gate limits the duration.
            return self._asked
        return self.controller.update(
            time_s,
            motion.range,
            motion.yaw,
            motion.range_rate,
            motion.yaw_rate,
            guidance.setpoint,
            guidance.sway,
            guidance.down,
        )

    def _report_sent(
        self, asked: Effort | None, effort: Effort, reason: LimitReason | None
    ) -> None:
        """Report the sent effort to the controller."""
        self._asked = asked
        if asked is None or (reason is not None and effort == NEUTRAL):
            self.controller.pause()
            self._asked = None
        elif reason is not None:
            self.controller.applied(effort)


# Frames delayed by the network may be this late; older ones belong to another stream.
_LATE_S = 0.5
_IDLE = Guidance(setpoint=None, stage=Stage.IDLE)


def _mission_reason(guidance: Guidance) -> LimitReason | None:
    """Return why a mission asks for nothing, or for no more than to stay."""
    if guidance.stage is Stage.WAITING:
        return LimitReason.NO_POSTURE
    if guidance.setpoint is None:
        return LimitReason.NO_SETPOINT
    return LimitReason.MISSION_OVER if guidance.stage is Stage.OVER else None


def _motion(posture: Posture | None, filtered: Motion | None) -> Motion | None:
    """Return the filter's view, else the raw one; None where either is not finite."""
    seen = filtered
    if seen is None and posture is not None:
        seen = Motion(posture.range, posture.yaw, None, None)
    if seen is None:
        return None
    known = (seen.range, seen.yaw, seen.range_rate or 0.0, seen.yaw_rate or 0.0)
    return seen if all(map(math.isfinite, known)) else None
