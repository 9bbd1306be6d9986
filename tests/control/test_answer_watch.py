"""Postures that do not answer: frozen ones, and a vehicle that moves unseen."""

import math
from copy import deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from aqualvs.control.answer_watch import AnswerLimits, AnswerWatch
from aqualvs.control.autopilot import Decision
from aqualvs.control.gains_file import load_gains
from aqualvs.control.missions import HoldMission
from aqualvs.control.safety import NO_BRAKE, LimitReason
from aqualvs.control.vehicle import NEUTRAL, Effort, Setpoint
from aqualvs.follow.case import SimCase, sea, vehicle_model
from aqualvs.follow.loop import SimulatedLoop
from aqualvs.follow.sensor_model import Blind, LossOfSight, SampledSensor
from aqualvs.geometry.transforms import SE3
from aqualvs.scanning.posture import Posture, Reason, Refusal
from control_cases import FRAME_S, posture_at, state_at
from whole import WHOLE

GAINS = load_gains("bluerov2")
HELD = Effort(forward=0.3)
DOUBTS = (LimitReason.FROZEN, LimitReason.NO_ANSWER)
# No prediction is usually so good, and no attitude so still.
EFFORTS_ALONE = AnswerLimits(usual=1e-9, swung=1.0)


def noisy(rng: np.random.Generator, distance: float = 0.6, yaw: float = 0.0) -> Posture:
    seen = posture_at(distance + 1e-3 * rng.normal(), yaw + 3e-3 * rng.normal())
    return replace(seen, pitch=3e-3 * rng.normal())


def watched(postures: list[Posture], effort: Effort = HELD) -> list[LimitReason | None]:
    watch, found = AnswerWatch(GAINS.vehicle), []
    for k, seen in enumerate(postures):
        now_s = FRAME_S * k
        found.append(watch.see(now_s, seen, state_at(now_s)))
        watch.done(now_s, effort)
    return found


def test_noise_passes() -> None:
    rng = np.random.default_rng(1)
    assert set(watched([noisy(rng) for _ in range(3000 if WHOLE else 1500)])) == {None}


def test_a_posture_that_repeats_under_thrust_is_frozen_until_it_changes() -> None:
    rng = np.random.default_rng(2)
    found = watched([noisy(rng)] * 20 + [noisy(rng) for _ in range(5)])
    first = found.index(LimitReason.FROZEN)
    assert first * FRAME_S == pytest.approx(0.2, abs=FRAME_S)
    assert set(found[first:20]) == {LimitReason.FROZEN}
    assert found[20:] == [None] * 5


def test_time_that_stands_still_changes_nothing() -> None:
    """The very first step after engaging, and one after a pause, last no time."""
    watch, rng = AnswerWatch(GAINS.vehicle), np.random.default_rng(5)
    watch.done(0.0, HELD)
    for now_s in (0.0, 0.0, 0.04, 0.04, 9.0, 8.0):
        assert watch.see(now_s, noisy(rng), state_at(now_s)) is None
        watch.done(now_s, HELD)


def test_without_thrust_nothing_need_move() -> None:
    assert set(watched([posture_at(0.6)] * 50, NEUTRAL)) == {None}


def still_of(last: Posture, rng: np.random.Generator) -> Posture:
    """Return the posture of a picture that an encoder repeats: it differs by next to nothing."""
    return replace(
        last,
        range=last.range + 3e-5 * rng.normal(),
        yaw=last.yaw + 1e-4 * rng.normal(),
        pitch=last.pitch + 1e-4 * rng.normal(),
    )


def test_noise_that_vanishes_is_a_still_that_an_encoder_repeats() -> None:
    rng = np.random.default_rng(3)
    live = [noisy(rng) for _ in range(100)]
    found = watched(live + [still_of(live[-1], rng) for _ in range(30)])
    assert set(found[:100]) == {None}
    # Eight postures tell it.
    assert set(found[107:]) == {LimitReason.FROZEN}


@pytest.mark.parametrize("begins_anew", ["gap", "engaged"])
def test_a_still_that_goes_on_after_a_gap_is_neutral_at_once(begins_anew: str) -> None:
    """No brake: nothing tells how fast the vehicle is by now."""
    rng, watch = np.random.default_rng(3), AnswerWatch(GAINS.vehicle)
    live = [noisy(rng) for _ in range(100)]
    found, brakes, gap_s = [], [], 0.0
    for k, seen in enumerate(live + [still_of(live[-1], rng) for _ in range(40)]):
        if k == 120 and begins_anew == "gap":
            gap_s = 0.5
        elif k == 120:
            watch.restart()
        now_s = FRAME_S * k + gap_s
        found.append(watch.see(now_s, seen, state_at(now_s)))
        brakes.append(watch.brake(now_s))
        watch.done(now_s, NEUTRAL if found[-1] else HELD)
    assert set(found[107:]) == {LimitReason.FROZEN}
    assert set(brakes[120:]) == {NO_BRAKE}


def test_a_yaw_that_does_not_follow_the_heading() -> None:
    rng, watch = np.random.default_rng(4), AnswerWatch(GAINS.vehicle)
    answering = []
    for answers in (True, False):
        watch.reset()
        found = set()
        for k in range(60):
            now_s, turned = FRAME_S * k, math.radians(10.0) * FRAME_S * k
            seen = noisy(rng, yaw=-turned if answers else 0.0)
            found.add(watch.see(now_s, seen, state_at(now_s, heading=turned)))
            watch.done(now_s, HELD)
        answering.append(found)
    assert answering == [{None}, {None, LimitReason.NO_ANSWER}]


@pytest.mark.parametrize(("turned_deg_s", "receding_m_s"), [(5.3, 0.0), (10.0, 0.02)])
def test_a_way_along_a_curved_net_is_an_answer(turned_deg_s: float, receding_m_s: float) -> None:
    """At 0.8 m/s with the current, well held; or faster, as the range shows that it is live."""
    rng, watch = np.random.default_rng(6), AnswerWatch(GAINS.vehicle)
    for k in range(100):
        now_s = FRAME_S * k
        state = state_at(now_s, heading=math.radians(turned_deg_s) * now_s)
        assert watch.see(now_s, noisy(rng, 0.6 + receding_m_s * now_s), state) is None
        watch.done(now_s, HELD)


# The setpoint changes after the first, at most 2.25 s before the second.
SAME_S, FREEZE_S = 11.7, 14.0


class NoticingSensor(SampledSensor):
    """One whose frozen picture is known for one from some time on, as the live run does."""

    noticed_s = math.inf

    def look(self, world_from_dome: SE3, time_s: float) -> Posture | Refusal | None:
        seen = super().look(world_from_dome, time_s)
        if time_s < self.noticed_s:
            return seen
        return Refusal(Reason.FROZEN, still_s=time_s - FREEZE_S)


@cache
def held(
    name: str, before: float, seed: int, waves: float
) -> tuple[SimulatedLoop, HoldMission, NoticingSensor]:
    """A loop that has held a range for as long as all frozen ones do alike."""
    mission = HoldMission(Setpoint(before))
    model = vehicle_model(name)
    case = SimCase(
        model=model,
        gains=load_gains(model.name),
        water=sea(current=0.0, waves=waves, seed=seed),
        start_range=before,
        seed=seed,
    )
    eye = NoticingSensor(case.net, np.random.default_rng(seed))
    loop = case.loop(eye, mission)
    loop.run(SAME_S)
    return loop, mission, eye


def frozen_hold(
    name: str,
    loss: LossOfSight,
    *,
    before: float = 0.6,
    since_s: float = 0.3,
    noticed_s: float = math.inf,
    seed: int = 1,
    waves: float = 0.0,
) -> tuple[float, float, list[Decision]]:
    """Hold 0.6 m; sight freezes some time after the setpoint came.

    Return the time from the freeze to neutral that stays, the nearest range and the decisions.
    """
    loop, mission, eye = deepcopy(held(name, before, seed, waves))
    eye._blind = (Blind(FREEZE_S, math.inf, loss),)
    eye.noticed_s = FREEZE_S + noticed_s
    decisions = []

    def keep(now_s: float, *step: object) -> None:
        if now_s > FREEZE_S:
            assert isinstance(step[2], Decision)
            decisions.append((now_s, step[2]))

    def step(now_s: float) -> None:
        if now_s >= FREEZE_S - since_s:
            mission.setpoint = Setpoint(0.6)

    loop.on_step = keep
    log = loop.run(FREEZE_S + 5.0, step)
    doubted_s = next((at for at, one in decisions if one.reason in DOUBTS), math.inf)
    after_it = [(at, one) for at, one in decisions if at >= doubted_s]
    neutral_s = next((at for at, one in after_it if one.effort == NEUTRAL), math.inf) - FREEZE_S
    after = log.column("time_s") >= FREEZE_S
    return neutral_s, float(log.column("range")[after].min()), [one for _, one in decisions]


NAMES = pytest.mark.parametrize("name", ["bluerov2", "bluerov2-heavy"])


@NAMES
@pytest.mark.parametrize("before", [0.6, 0.75])
def test_a_frozen_posture_stops_the_vehicle_in_time(name: str, before: float) -> None:
    neutral_s, nearest, decisions = frozen_hold(name, LossOfSight.FROZEN, before=before)
    assert neutral_s <= 0.5
    assert nearest >= 0.45
    assert decisions[-1].effort == NEUTRAL
    assert decisions[-1].reason is LimitReason.FROZEN


@NAMES
@pytest.mark.parametrize(
    ("noticed_s", "all_since_s"),
    # An ordinary run meets each delay and each time of an approach, not each with each.
    [(0.24, (0.9, 2.25)), (0.32, (1.8,)), (0.4, (0.9, 2.25))]
    if not WHOLE
    else [(noticed_s, (0.9, 1.8, 2.25)) for noticed_s in (0.24, 0.32, 0.4)],
)
def test_a_vehicle_that_approaches_a_frozen_net_is_braked_while_there_is_time(
    name: str, noticed_s: float, all_since_s: tuple[float, ...]
) -> None:
    """Half a second after the freeze at the latest it is neutral, and comes to rest."""
    for since_s in all_since_s:
        neutral_s, nearest, decisions = frozen_hold(
            name, LossOfSight.STUCK, before=0.75, since_s=since_s, noticed_s=noticed_s
        )
        assert neutral_s <= 0.5
        # Without a brake the BlueROV2 coasts by 0.3 m. Not thrown back either.
        assert 0.3 < nearest <= 0.75
        doubted = [one for one in decisions if one.reason in DOUBTS]
        pushes = [one.effort for one in doubted if one.effort != NEUTRAL]
        assert len(pushes) <= 3
        assert all(-1.0 <= one.forward < 0.0 and one.right == one.yaw == 0.0 for one in pushes)
        assert doubted[-1].effort == NEUTRAL
        if noticed_s < 0.3:
            assert nearest >= 0.45


@NAMES
def test_an_approach_that_ends_at_once_is_a_still(name: str) -> None:
    """It has noise of its own; no effort has ended the approach."""
    neutral_s, nearest, decisions = frozen_hold(name, LossOfSight.STUCK, before=0.75, since_s=1.2)
    assert neutral_s <= 0.55
    assert nearest >= 0.45
    assert decisions[-1].reason is LimitReason.NO_ANSWER
    assert not decisions[-1].engaged
    assert LimitReason.NO_ANSWER.takes_over


@pytest.mark.parametrize(
    ("name", "since_s", "seed"), [("bluerov2", 0.9, 3), ("bluerov2-heavy", 1.5, 2)]
)
def test_the_brake_of_an_approach_that_ends_leaves_time(
    name: str, since_s: float, seed: int
) -> None:
    """A stop that is noticed late looks younger than it is."""
    neutral_s, nearest, decisions = frozen_hold(
        name, LossOfSight.STUCK, before=0.75, since_s=since_s, seed=seed
    )
    doubted = [one for one in decisions if one.reason is LimitReason.NO_ANSWER]
    assert doubted[0].effort.forward < 0.0
    assert neutral_s <= 0.5 + 1e-9
    assert nearest >= 0.45


@NAMES
def test_a_vehicle_that_moves_unseen_is_given_back(name: str) -> None:
    """What the efforts promise is enough, in a sea where approaches may end at any moment."""
    watch = AnswerWatch(load_gains(name.replace("-", "_")).vehicle, EFFORTS_ALONE)
    rng, found = np.random.default_rng(9), []
    for k in range(500):
        now_s = FRAME_S * k
        found.append(watch.see(now_s, noisy(rng), state_at(now_s)))
        # Thrust that grows as an error in the range stays.
        watch.done(now_s, Effort(forward=0.3 + max(now_s - 14.0, 0.0) * 0.2))
    first = found.index(LimitReason.NO_ANSWER) * FRAME_S
    assert 14.0 < first < 18.0


def rolling(k: int, degrees: float) -> float:
    """Pitch or heading of a vehicle that swings."""
    return math.radians(degrees) * math.sin(2.0 * math.pi * FRAME_S * k / 2.5)


@pytest.mark.parametrize("part", ["pitch", "yaw"])
@pytest.mark.parametrize("late", [0, 5])
def test_a_posture_that_does_not_follow_the_attitude(part: str, late: int) -> None:
    """The autopilot's attitude is known earlier than the posture."""
    answering = []
    for answers in (1.0, 0.0):
        watch, rng = AnswerWatch(GAINS.vehicle), np.random.default_rng(10)
        found = set()
        for k in range(250):
            now_s, told = FRAME_S * k, rolling(k, 3.0)
            seen = noisy(rng)
            value = getattr(seen, part) - answers * rolling(k - late, 3.0)
            state = replace(state_at(now_s, heading=told if part == "yaw" else 0.0), pitch=0.0)
            state = replace(state, pitch=told) if part == "pitch" else state
            found.add(watch.see(now_s, replace(seen, **{part: value}), state))
            watch.done(now_s, HELD)
        answering.append(found)
    assert answering == [{None}, {None, LimitReason.NO_ANSWER}]


@NAMES
def test_a_still_in_swell_is_told_by_the_attitude(name: str) -> None:
    neutral_s, _, decisions = frozen_hold(
        name, LossOfSight.STUCK, before=0.75, since_s=1.2, seed=2, waves=0.1
    )
    assert neutral_s <= 2.5
    assert decisions[-1].reason is LimitReason.NO_ANSWER
