"""The plan file: mission, safety limits, and behaviour without the target."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from aqualvs.control.missions import (
    FollowMission,
    HoldMission,
    LegOptions,
    LossOptions,
    Mission,
    Sector,
    SurveyMission,
    SurveyOptions,
    Turn,
)
from aqualvs.control.safety import SafetyLimits
from aqualvs.control.vehicle import Setpoint, SetpointHolder
from aqualvs.errors import OptionError
from aqualvs.schema import NotNegative, Number, Positive, StrictPart, load_settings, si_values

VERSION = 1
"""Version of the format that is read."""
_KEY = "aqualvs_plan"

Two = Annotated[list[Number], Field(min_length=2, max_length=2)]
Speed = Annotated[float, Field(ge=-1.0, le=1.0, allow_inf_nan=False)]


class LegPart(StrictPart):
    """`leg`: where one way along the net ends."""

    time_s: Positive | None = None
    distance_m: Positive | None = None
    bearings_deg: Two | None = None


class SurveyPart(StrictPart):
    """Section `survey`: the depths, and what happens between them."""

    depths_m: Annotated[list[NotNegative], Field(min_length=1)]
    step_m: Positive | None = None
    turn: Literal["back", "on"] = "back"
    descent_m_s: Positive = 0.1
    patience_s: Positive = 20.0


class LossPart(StrictPart):
    """Section `loss`: behaviour without the target."""

    after_s: Positive = 0.15
    steady_s: NotNegative = 0.1
    give_up_s: Positive = 10.0


class SafetyPart(StrictPart):
    """`safety`: where the gate steps in."""

    posture_age_s: Positive = 0.15
    heartbeat_age_s: Positive = 1.0
    least_range_m: Positive = 0.35
    approach_speed_m_s: Positive = 0.3
    stopping_time_s: Positive = 0.7
    retreat_effort: Positive = 0.25
    brake_effort: Positive = 0.5
    tilt_deg: Positive = 45.0


class PlanFile(StrictPart):
    """A whole plan file."""

    aqualvs_plan: int
    mission: Literal["hold", "follow", "survey"]
    range_m: Positive
    yaw_deg: Number = 0.0
    sway_m_s: Speed | None = None
    duration_s: Positive | None = None
    leg: LegPart | None = None
    survey: SurveyPart | None = None
    loss: LossPart = LossPart()
    safety: SafetyPart = SafetyPart()


@dataclass(frozen=True, slots=True)
class Plan:
    """Contents of a plan file."""

    name: str  # Of the mission: hold, follow or survey.
    setpoint: Setpoint
    limits: SafetyLimits
    _file: PlanFile

    def mission(self) -> Mission:
        """Return a new mission, at its beginning."""
        content = self._file
        loss = LossOptions(**si_values(content.loss))
        leg, sway = _leg(content), content.sway_m_s or 0.0
        if (survey := content.survey) is not None:
            options = SurveyOptions(
                depths=_depths(survey),
                sway=sway,
                leg=leg,
                turn=Turn(survey.turn),
                descent=survey.descent_m_s,
                patience=survey.patience_s,
            )
            return SurveyMission(self.setpoint, options, loss=loss)
        if self.name == "follow":
            return FollowMission(self.setpoint, sway, leg=leg, loss=loss)
        return HoldMission(self.setpoint, duration=content.duration_s or math.inf, loss=loss)


def load_plan(path: Path | str) -> Plan:
    """Return the plan of a file.

    Raises `OptionError` with one line: file, place, value, remedy.
    """
    path = Path(path)
    content = load_settings(path, PlanFile, _KEY, VERSION)
    try:
        _check_together(content)
        setpoint = Setpoint(content.range_m, math.radians(content.yaw_deg))
        limits = SafetyLimits(**si_values(content.safety))
        _check_setpoint(setpoint, limits)
        plan = Plan(content.mission, setpoint, limits, content)
        # A plan that cannot begin must be refused now, not under water.
        plan.mission()
    except OptionError as fault:
        raise OptionError(f"{path}: {fault}") from fault
    return plan


def _check_together(content: PlanFile) -> None:
    """Refuse keys that the mission does not use, and missions that lack one."""
    name = content.mission
    moves = name != "hold"
    if moves and content.sway_m_s is None:
        raise OptionError(f"sway_m_s is missing; a mission '{name}' needs a speed, such as 0.2")
    if name == "survey" and content.survey is None:
        raise OptionError("survey is missing; add 'survey: {depths_m: [2, 8], step_m: 1}'")
    idle = {
        "sway_m_s": not moves and content.sway_m_s is not None,
        "leg": not moves and content.leg is not None,
        "duration_s": moves and content.duration_s is not None,
        "survey": name != "survey" and content.survey is not None,
    }
    for key, is_idle in idle.items():
        if is_idle:
            remedy = "use leg.time_s" if key == "duration_s" else "leave it out"
            raise OptionError(f"{key} does nothing in a mission '{name}'; {remedy}")


def _check_setpoint(setpoint: Setpoint, limits: SafetyLimits) -> None:
    room = 0.1  # Least distance of a setpoint from the least range, in metres: room to swing.
    if setpoint.range < limits.least_range + room:
        raise OptionError(
            f"range_m is {setpoint.range:g}, but nothing approaches within safety.least_range_m, "
            f"{limits.least_range:g}; choose at least {limits.least_range + room:.2f}"
        )
    if not abs(setpoint.yaw) <= SetpointHolder.MAX_YAW:
        raise OptionError(
            f"yaw_deg is {math.degrees(setpoint.yaw):g}; choose at most "
            f"{math.degrees(SetpointHolder.MAX_YAW):.0f} to either side"
        )


def _leg(content: PlanFile) -> LegOptions:
    part = content.leg or LegPart()
    sector = None if part.bearings_deg is None else Sector(*map(math.radians, part.bearings_deg))
    return LegOptions(
        time=part.time_s or math.inf, distance=part.distance_m or math.inf, sector=sector
    )


def _depths(part: SurveyPart) -> tuple[float, ...]:
    """Return the depths themselves, or those from the first to the last by a step."""
    max_depths = 1000  # Greatest number of depths of a survey; more are a typing error.
    if part.step_m is None:
        return tuple(part.depths_m)
    if len(part.depths_m) != 2:
        raise OptionError(
            f"survey.depths_m holds {len(part.depths_m)} depths; with step_m give two, from and to"
        )
    first, last = part.depths_m
    n = math.floor(abs(last - first) / part.step_m + 1e-9) + 1
    if n > max_depths:
        raise OptionError(f"survey.step_m {part.step_m:g} makes {n} legs; choose a greater one")
    step = math.copysign(part.step_m, last - first)
    depths = [first + i * step for i in range(n)]
    # The last depth is included even if the step does not meet it.
    if abs(depths[-1] - last) > 1e-6:
        depths.append(last)
    return tuple(depths)
