"""Missions by themselves, and the pilot that joins mission, controller and gate."""

import math
from dataclasses import replace

import pytest

from aqualvs.control.autopilot import Decision, Motion, NetPilot
from aqualvs.control.controller import RangeYawController
from aqualvs.control.gains_file import load_gains
from aqualvs.control.missions import (
    FollowMission,
    Guidance,
    HoldMission,
    Leg,
    LegOptions,
    LossOptions,
    Mission,
    Sector,
    Stage,
    SurveyMission,
    SurveyOptions,
    Turn,
)
from aqualvs.control.safety import LimitReason, SafetyGate
from aqualvs.control.vehicle import NEUTRAL, Setpoint, VehicleState
from aqualvs.errors import OptionError
from aqualvs.scanning.posture import Reason as NoPosture
from aqualvs.scanning.posture import Refusal
from control_cases import FRAME_S, PlanePlant, posture_at, state_at

HOLD = Setpoint(0.6)
NONE = Refusal(NoPosture.NO_TARGET)


def run(
    mission: Mission, seconds: float, begin: float = 0.0, *, there: bool = True, **state: object
) -> Guidance:
    """Update a mission frame by frame; return the last guidance."""
    for k in range(round(seconds / FRAME_S)):
        now = begin + FRAME_S * k
        guidance = mission.update(now, posture_at() if there else None, state_at(now, **state))
    return guidance


def test_hold_ends_after_its_time_with_the_target() -> None:
    mission = HoldMission(HOLD, duration=5.0)
    assert run(mission, 4.0).stage is Stage.HOLDING
    # Time without the target does not count.
    assert run(mission, 4.0, 4.0, there=False).stage is Stage.WAITING
    assert run(mission, 0.9, 8.0).stage is Stage.HOLDING
    over = run(mission, 1.0, 8.9)
    assert (over.stage, over.setpoint) == (Stage.OVER, HOLD)
    # It holds on, and without the target it waits and gives up as it did before.
    assert run(mission, 1.0, 9.9, there=False).stage is Stage.WAITING
    assert run(mission, 1.0, 10.9).stage is Stage.OVER
    assert run(mission, 11.0, 11.9, there=False).stage is Stage.GAVE_UP


def test_a_short_loss_is_ridden_out_a_longer_one_waited_for_a_long_one_ends() -> None:
    mission = FollowMission(HOLD, 0.2, loss=LossOptions(after=0.15, steady=0.3, give_up=5.0))
    assert run(mission, 1.0).sway == 0.2
    assert run(mission, 0.12, 1.0, there=False).stage is Stage.FOLLOWING
    waiting = run(mission, 1.0, 1.12, there=False)
    assert (waiting.stage, waiting.sway) == (Stage.WAITING, 0.0)
    # Back for less than it takes to trust it.
    assert run(mission, 0.2, 2.12).stage is Stage.WAITING
    assert run(mission, 0.4, 2.32).stage is Stage.FOLLOWING
    assert run(mission, 5.2, 2.72, there=False).stage is Stage.GAVE_UP
    assert run(mission, 5.0, 7.92).stage is Stage.GAVE_UP
    mission.restart()
    assert run(mission, 1.0, 13.0).stage is Stage.FOLLOWING


def test_a_target_that_flickers_is_not_waited_for_twice_as_long() -> None:
    """Coming back for a frame does not start the waiting anew."""
    mission = FollowMission(HOLD, 0.2, loss=LossOptions(after=0.15, steady=0.3, give_up=5.0))
    run(mission, 1.0)
    stages = []
    for k in range(round(7.0 / FRAME_S)):
        now = 1.0 + FRAME_S * k
        there = k % 10 == 9
        guidance = mission.update(now, posture_at() if there else None, state_at(now))
        stages.append(guidance.stage)
    assert stages[-1] is Stage.GAVE_UP


def test_a_gap_in_time_is_not_time_spent() -> None:
    mission = HoldMission(HOLD, duration=5.0)
    run(mission, 1.0)
    assert run(mission, 1.0, 500.0).stage is Stage.HOLDING
    assert run(mission, 1.0, 3.0).stage is Stage.HOLDING


@pytest.mark.parametrize(
    ("leg", "seconds"), [(LegOptions(time=4.0), 4.0), (LegOptions(distance=1.0), 5.0)]
)
def test_follow_ends_by_time_or_distance(leg: LegOptions, seconds: float) -> None:
    mission = FollowMission(HOLD, -0.2, leg=leg)
    assert run(mission, seconds - 0.1).stage is Stage.FOLLOWING
    over = run(mission, 0.3, seconds - 0.1)
    assert (over.stage, over.setpoint, over.sway) == (Stage.OVER, HOLD, 0.0)


@pytest.mark.parametrize("clockwise", [True, False])
def test_a_leg_ends_where_it_leaves_the_sector(clockwise: bool) -> None:
    """From 350 to 20 degrees, through north; it begins outside."""
    sector = Sector(math.radians(350.0), math.radians(20.0))
    leg = Leg(LegOptions(sector=sector))
    bearings = list(range(-40, 60))
    for bearing in bearings if clockwise else reversed(bearings):
        leg.go(FRAME_S, 0.2, math.radians(bearing % 360))
        if leg.done:
            break
    assert bearing == (21 if clockwise else -11)


def test_a_leg_without_a_known_bearing_goes_on() -> None:
    leg = Leg(LegOptions(sector=Sector(0.0, 1.0), time=1.0))
    for _ in range(20):
        leg.go(FRAME_S, 0.2, None)
    assert not leg.done


def survey(**others: object) -> SurveyMission:
    given = {"depths": (2.0, 2.5, 3.0), "sway": 0.2, "leg": LegOptions(time=4.0), **others}
    return SurveyMission(HOLD, SurveyOptions(**given))


class Sinking:
    """A vehicle that follows the speed of descent at once, and drifts along as asked."""

    def __init__(self, depth: float) -> None:
        self.depth, self.now = depth, 0.0
        self.legs: list[tuple[int, float]] = []

    def go(self, mission: SurveyMission, seconds: float) -> Guidance:
        for _ in range(round(seconds / FRAME_S)):
            guidance = mission.update(self.now, posture_at(), state_at(self.now, depth=self.depth))
            assert guidance.sway == 0.0 or guidance.down == 0.0
            self.depth += FRAME_S * guidance.down
            self.now += FRAME_S
            if guidance.stage is Stage.FOLLOWING and guidance.sway:
                step = (round(2 * self.depth), math.copysign(1.0, guidance.sway))
                if not self.legs or self.legs[-1] != step:
                    self.legs.append(step)
        return guidance


@pytest.mark.parametrize(("turn", "second"), [(Turn.BACK, -1.0), (Turn.ON, 1.0)])
def test_a_survey_mows_leg_by_leg(turn: Turn, second: float) -> None:
    vehicle, mission = Sinking(1.0), survey(turn=turn)
    over = vehicle.go(mission, 60.0)
    assert vehicle.legs == [(4, 1.0), (5, second), (6, 1.0)]
    assert (over.stage, over.sway, over.down) == (Stage.OVER, 0.0, 0.0)
    vehicle.now += FRAME_S
    mission.restart()
    assert vehicle.go(mission, 5.0).stage is Stage.OVER


def test_depth_is_changed_no_faster_than_asked_and_upward_too() -> None:
    vehicle, mission = Sinking(4.0), survey(depths=(2.0,), descent=0.15)
    guidance = mission.update(0.0, posture_at(), state_at(0.0, depth=4.0))
    assert guidance.stage is Stage.CHANGING_DEPTH
    assert (guidance.sway, guidance.down) == (0.0, -0.15)
    vehicle.go(mission, 25.0)
    assert vehicle.depth == pytest.approx(2.0, abs=0.07)


def test_a_depth_that_cannot_be_reached_does_not_hold_up_the_survey() -> None:
    mission = survey(patience=5.0)
    # Half a metre at 0.1 m/s, and 5 s of patience.
    assert run(mission, 9.8, depth=1.5).stage is Stage.CHANGING_DEPTH
    assert run(mission, 0.6, 9.8, depth=1.5).stage is Stage.FOLLOWING


def test_without_a_known_depth_a_survey_waits() -> None:
    guidance = run(survey(), 100.0, depth=None)
    assert (guidance.stage, guidance.down) == (Stage.CHANGING_DEPTH, 0.0)


def test_a_survey_goes_on_where_it_was_after_a_loss() -> None:
    vehicle, mission = Sinking(2.0), survey()
    vehicle.go(mission, 3.0)
    for k in range(50):
        now = vehicle.now + FRAME_S * k
        mission.update(now, None, state_at(now, depth=2.0))
    vehicle.now += 2.0
    assert vehicle.go(mission, 1.0).stage is Stage.FOLLOWING
    assert mission.i_leg == 0


def test_missions_that_make_no_sense_are_refused() -> None:
    with pytest.raises(OptionError, match="duration"):
        HoldMission(HOLD, duration=0.0)
    with pytest.raises(OptionError, match="speed 0"):
        FollowMission(HOLD, 0.0)
    with pytest.raises(OptionError, match="no end"):
        survey(leg=LegOptions())
    with pytest.raises(OptionError, match="depths"):
        survey(depths=())
    with pytest.raises(OptionError, match="give up"):
        LossOptions(give_up=0.1)


class Loop:
    """A pilot in the loop with a plant: postures can be withheld, the state spoilt."""

    def __init__(self, mission: Mission, name: str = "bluerov2", **plant: object) -> None:
        gains = load_gains(name)
        self.plant = PlanePlant(gains, **plant)
        self.pilot = NetPilot(mission, RangeYawController(gains))
        self.decisions: list[Decision] = []

    @property
    def now(self) -> float:
        return self.plant.time

    def engage(self) -> LimitReason | None:
        return self.pilot.engage(self.now, state_at(self.now))

    def go(
        self, seconds: float, *, there: bool = True, state: VehicleState | None = None
    ) -> list[Decision]:
        taken = []
        for _ in range(round(seconds / FRAME_S)):
            seen = posture_at(self.plant.distance, self.plant.yaw) if there else NONE
            range_rate, yaw_rate = self.plant.rates()
            motion = Motion(self.plant.distance, self.plant.yaw, range_rate, yaw_rate)
            now = self.now
            told = state_at(now) if state is None else replace(state, heard_s=now)
            decision = self.pilot.step(now, now, seen, motion if there else None, told)
            taken.append(decision)
            self.plant.step(decision.effort)
        self.decisions += taken
        return taken


def test_the_pilot_does_nothing_until_engaged_then_holds() -> None:
    loop = Loop(HoldMission(HOLD), distance=0.8)
    idle = loop.go(1.0)
    assert {(one.effort, one.reason, one.guidance.stage) for one in idle} == {
        (NEUTRAL, LimitReason.NOT_ENGAGED, Stage.IDLE)
    }
    assert loop.engage() is None
    loop.go(12.0)
    assert loop.plant.distance == pytest.approx(0.6, abs=0.005)
    assert loop.decisions[-1].engaged


def test_neutral_within_a_fifth_of_a_second_without_a_posture() -> None:
    loop = Loop(HoldMission(HOLD), current=(0.2, 0.0))
    loop.engage()
    loop.go(15.0)
    lost = loop.go(3.0, there=False)
    n_pushing = sum(one.effort != NEUTRAL for one in lost)
    assert n_pushing * FRAME_S <= 0.2
    assert all(one.effort == NEUTRAL for one in lost[n_pushing:])
    assert {one.reason for one in lost[n_pushing:]} == {LimitReason.NO_POSTURE}
    # It goes on by itself, and knows the current.
    loop.go(10.0)
    assert loop.plant.distance == pytest.approx(0.6, abs=0.02)


def test_it_gives_up_for_good_after_the_time_set() -> None:
    loop = Loop(HoldMission(HOLD, loss=LossOptions(give_up=2.0)))
    loop.engage()
    loop.go(2.0)
    loop.go(3.0, there=False)
    assert not loop.pilot.engaged
    back = loop.go(3.0)
    assert {(one.effort, one.reason) for one in back} == {(NEUTRAL, LimitReason.GAVE_UP)}
    assert loop.engage() is None
    assert loop.go(1.0)[-1].reason is None


@pytest.mark.parametrize(
    "mission",
    [HoldMission(HOLD, duration=1.0), FollowMission(HOLD, 0.2, leg=LegOptions(time=1.0))],
    ids=["hold", "follow"],
)
def test_a_mission_that_is_over_holds_until_the_pilot_takes_over(mission: Mission) -> None:
    """A vehicle without thrust would drift onto the net."""
    loop = Loop(mission, current=(0.2, 0.0))
    loop.engage()
    last = loop.go(25.0)[-1]
    assert (last.reason, last.engaged, last.guidance.sway) == (LimitReason.MISSION_OVER, True, 0.0)
    assert loop.plant.distance == pytest.approx(0.6, abs=0.01)
    assert last.effort.forward < -0.05
    touched = loop.go(FRAME_S, state=state_at(0.0, pilot_moves=True))[0]
    assert (touched.effort, touched.reason) == (NEUTRAL, LimitReason.PILOT_STICKS)
    assert not touched.engaged


def test_a_vehicle_that_tips_is_told_of_and_held_on() -> None:
    """Without thrust the water would carry it onto the net."""
    taken = []
    for pitch in (0.0, -math.radians(50.0)):
        loop = Loop(HoldMission(HOLD), current=(0.2, 0.0))
        loop.engage()
        loop.go(5.0)
        taken.append(loop.go(5.0, state=state_at(0.0, pitch=pitch)))
    level, tipped = taken
    assert [one.effort for one in tipped] == [one.effort for one in level]
    assert {(one.reason, one.engaged) for one in level} == {(None, True)}
    assert {(one.reason, one.engaged) for one in tipped} == {(LimitReason.TIPPING, True)}


def test_the_pilots_stick_takes_over_at_once_and_for_good() -> None:
    loop = Loop(HoldMission(HOLD), distance=0.8)
    loop.engage()
    loop.go(0.6)
    touched = loop.go(FRAME_S, state=state_at(0.0, pilot_moves=True))
    assert (touched[0].effort, touched[0].reason) == (NEUTRAL, LimitReason.PILOT_STICKS)
    assert {one.effort for one in loop.go(5.0)} == {NEUTRAL}
    assert loop.engage() is None
    first = loop.go(FRAME_S)[0]
    # Without a jump: it starts from neutral, at the posture it finds.
    assert abs(first.effort.forward) < 0.2
    loop.go(12.0)
    assert loop.plant.distance == pytest.approx(0.6, abs=0.01)


def test_engaging_again_knows_nothing_of_the_time_before() -> None:
    """Whoever moved the vehicle in between: it starts as it did the first time."""
    fresh = Loop(HoldMission(HOLD))
    fresh.engage()
    used = Loop(HoldMission(HOLD), current=(0.4, 0.0))
    used.engage()
    used.go(15.0)
    used.pilot.disengage()
    used.go(1.0)
    used.plant = replace_plant(fresh.plant, used.now)
    used.engage()
    first = [one.effort for one in fresh.go(1.0)]
    again = [one.effort for one in used.go(1.0)]
    for a, b in zip(first, again, strict=True):
        assert b.forward == pytest.approx(a.forward, abs=1e-6)


def replace_plant(plant: PlanePlant, time: float) -> PlanePlant:
    return PlanePlant(plant.gains, distance=plant.distance, yaw=plant.yaw, time=time)


def test_no_setpoint_is_neutral() -> None:
    mission = HoldMission(None)
    loop = Loop(mission)
    loop.engage()
    last = loop.go(1.0)[-1]
    assert (last.effort, last.reason, last.engaged) == (NEUTRAL, LimitReason.NO_SETPOINT, True)
    mission.setpoint = Setpoint(0.7)
    loop.go(10.0)
    # In still water the thrusters' dead band leaves some millimetres.
    assert loop.plant.distance == pytest.approx(0.7, abs=0.01)


def test_a_picture_that_stands_still_is_no_posture() -> None:
    loop = Loop(HoldMission(HOLD), distance=0.8)
    loop.engage()
    loop.go(1.0)
    frozen, state = loop.now, state_at
    for k in range(10):
        now = frozen + FRAME_S * k
        decision = loop.pilot.step(now, frozen, posture_at(0.8), None, state(now))
    assert (decision.effort, decision.reason) == (NEUTRAL, LimitReason.NO_POSTURE)


def test_frame_times_that_jump_back_stop_one_step_and_start_anew() -> None:
    loop = Loop(HoldMission(HOLD), distance=0.8)
    loop.engage()
    loop.go(1.0)
    now = loop.now
    jumped = loop.pilot.step(now, 0.0, posture_at(0.8), None, state_at(now))
    assert (jumped.effort, jumped.reason) == (NEUTRAL, LimitReason.CLOCK)
    for k in range(1, 30):
        now = loop.now + FRAME_S * k
        seen = posture_at(0.8 + 1e-4 * (k % 2))
        decision = loop.pilot.step(now, FRAME_S * k, seen, None, state_at(now))
    assert decision.reason is None
    assert decision.effort.forward > 0.1


def test_a_vehicle_without_sway_does_not_follow() -> None:
    with pytest.raises(OptionError, match="cannot move sideways"):
        NetPilot(FollowMission(HOLD, 0.2), RangeYawController(load_gains("videoray")))


def test_it_stops_before_the_least_range_whatever_the_controller_wants() -> None:
    """A controller gone wild pushes forward; the gate brakes in time, from full speed."""

    class Wild(RangeYawController):
        def update(self, *arguments: object, **others: object):
            return replace(super().update(*arguments, **others), forward=0.6)

    gains = load_gains("bluerov2")
    plant, pilot = PlanePlant(gains, distance=1.2), NetPilot(HoldMission(HOLD), Wild(gains))
    pilot.engage(0.0, state_at(0.0))
    nearest, reasons = math.inf, set()
    for _ in range(500):
        rates = plant.rates()
        decision = pilot.step(
            plant.time,
            plant.time,
            posture_at(plant.distance, plant.yaw),
            Motion(plant.distance, plant.yaw, *rates),
            state_at(plant.time),
        )
        plant.step(decision.effort)
        nearest = min(nearest, plant.distance)
        reasons.add(decision.reason)
    assert {LimitReason.TOO_FAST} <= reasons
    assert nearest > SafetyGate().limits.least_range - 0.05
