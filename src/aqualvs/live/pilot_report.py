"""What the pilot's page and the health list show of the pilot that aqualvs is."""

import math
from dataclasses import dataclass

from aqualvs.control.mission import Guidance
from aqualvs.control.safety import Reason
from aqualvs.control.vehicle import Effort, Mode, VehicleState
from aqualvs.live.health import State

_TELL_MODE = (
    Reason.PILOT_MODE,
    Reason.NO_STATION,
    Reason.IGNORED,
    Reason.CONFLICT,
    Reason.UNKNOWN_MODE,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class PilotReport:
    """One step of the pilot.

    Attributes
    ----------
    at_ns : int
        By `time.monotonic_ns`.
    frame : int
        Number of the frame that it rests on; the last one's where the stream is silent.
    engaged : bool
        Whether efforts go out.
    effort : Effort
        What was sent; neutral where nothing was.
    reason : Reason or None
        Why it is not what the controller asked for.
    guidance : Guidance
        What the mission wants.
    state : VehicleState
        What the vehicle told.
    """

    at_ns: int
    frame: int
    engaged: bool
    effort: Effort
    reason: Reason | None
    guidance: Guidance
    state: VehicleState

    @property
    def words(self) -> str:
        """What it does, or why it does not, in one line."""
        told = words_of(self.reason, self.state) if self.reason else _aim(self.guidance)
        return f"{told}; {self.state.doubt}" if self.engaged and self.state.doubt else told

    @property
    def colour(self) -> State:
        """How it is, for the health list."""
        if not self.engaged:
            return State.OFF
        return State.WARN if self.reason or self.state.doubt else State.OK


def words_of(reason: Reason, state: VehicleState) -> str:
    """Return why efforts do not pass, with what the vehicle says of it."""
    told = state.mode_name if reason in _TELL_MODE else ""
    if reason is Reason.CONFLICT and state.mode is not Mode.CONFLICT:
        told = state.rival
    return f"{reason.words} ({told})" if told else reason.words


def _aim(guidance: Guidance) -> str:
    """Return what a mission aims at."""
    setpoint = guidance.setpoint
    if setpoint is None:
        return guidance.stage.value.replace("_", " ")
    aim = f"{setpoint.range:.2f} m, yaw {math.degrees(setpoint.yaw):.0f} deg"
    sway = f", {guidance.sway:+.2f} m/s to the right" if guidance.sway else ""
    return f"{guidance.stage.value.replace('_', ' ')}: {aim}{sway}"
