"""The safety gate, rule by rule, and laws that hold whatever comes."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aqualvs.control.safety import Brake, LimitReason, SafetyGate, SafetyLimits
from aqualvs.control.vehicle import NEUTRAL, Effort, Mode
from aqualvs.errors import OptionError
from control_cases import posture_at, state_at

ASKED = Effort(forward=0.3, right=0.2, down=0.1, yaw=-0.4)


def engaged(now_s: float = 100.0, limits: SafetyLimits | None = None) -> SafetyGate:
    gate = SafetyGate(limits)
    assert gate.engage(now_s, state_at(now_s)) is None
    return gate


def test_a_sound_effort_passes_unchanged() -> None:
    assert engaged().check(100.0, 0.0, posture_at(), state_at(100.0), ASKED) == (ASKED, None)


def test_nothing_passes_before_engaging() -> None:
    found = SafetyGate().check(1.0, 0.0, posture_at(), state_at(1.0), ASKED)
    assert found == (NEUTRAL, LimitReason.NOT_ENGAGED)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"pilot_moves": True}, LimitReason.PILOT_STICKS),
        ({"mode": Mode.PILOT}, LimitReason.PILOT_MODE),
        ({"mode": Mode.NO_STATION}, LimitReason.NO_STATION),
        ({"mode": Mode.IGNORED}, LimitReason.IGNORED),
        ({"mode": Mode.CONFLICT}, LimitReason.CONFLICT),
        ({"mode": Mode.UNKNOWN}, LimitReason.UNKNOWN_MODE),
        ({"armed": False}, LimitReason.DISARMED),
        ({"heard_s": 98.9}, LimitReason.NO_HEARTBEAT),
        ({"heard_s": -math.inf}, LimitReason.NO_HEARTBEAT),
        ({"heard_s": math.nan}, LimitReason.NO_HEARTBEAT),
        ({"heard_s": 200.0}, LimitReason.NO_HEARTBEAT),
    ],
)
def test_the_vehicle_stops_us_until_engaged_again(
    change: dict[str, object], reason: LimitReason
) -> None:
    gate = engaged()
    spoilt = state_at(100.0, **change)
    assert gate.check(100.0, 0.0, posture_at(), spoilt, ASKED) == (NEUTRAL, reason)
    assert reason.takes_over
    # All is well again, yet it is the pilot who lets us go on.
    for k in range(1, 100):
        now = 100.0 + 0.04 * k
        assert gate.check(now, 0.0, posture_at(), state_at(now), ASKED) == (NEUTRAL, reason)
    assert gate.engage(now, state_at(now)) is None
    now += 0.04
    assert gate.check(now, 0.0, posture_at(), state_at(now), ASKED) == (ASKED, None)


def test_a_rival_keeps_us_from_engaging_but_does_not_stop_us() -> None:
    gate = SafetyGate()
    assert gate.engage(5.0, state_at(5.0, rival="two addresses")) is LimitReason.CONFLICT
    assert gate.engage(5.0, state_at(5.0)) is None
    rival = state_at(5.1, rival="two addresses")
    assert gate.check(5.1, 0.0, posture_at(), rival, ASKED) == (ASKED, None)


def test_engaging_is_refused_while_the_vehicle_is_not_ours() -> None:
    gate = SafetyGate()
    assert gate.engage(5.0, state_at(5.0, armed=False)) is LimitReason.DISARMED
    assert gate.engage(5.0, state_at(5.0, pilot_moves=True)) is LimitReason.PILOT_STICKS
    assert gate.latched is LimitReason.NOT_ENGAGED
    assert gate.check(5.0, 0.0, posture_at(), state_at(5.0), ASKED)[0] == NEUTRAL


def test_no_posture_is_neutral_within_the_time_and_not_for_good() -> None:
    gate = engaged()
    limits = gate.limits
    assert limits.posture_age <= 0.2
    young = gate.check(100.04, limits.posture_age - 0.01, posture_at(), state_at(100.04), ASKED)
    assert young == (ASKED, None)
    old = gate.check(100.08, limits.posture_age, posture_at(), state_at(100.08), ASKED)
    assert old == (NEUTRAL, LimitReason.NO_POSTURE)
    back = gate.check(100.12, 0.0, posture_at(), state_at(100.12), ASKED)
    assert back == (ASKED, None)


@pytest.mark.parametrize("age", [math.inf, math.nan, -0.1])
def test_an_age_that_makes_no_sense_is_no_posture(age: float) -> None:
    found = engaged().check(100.0, age, posture_at(), state_at(100.0), ASKED)
    assert found == (NEUTRAL, LimitReason.NO_POSTURE)


def test_never_a_posture_is_no_posture() -> None:
    found = engaged().check(100.0, 0.0, None, state_at(100.0), ASKED)
    assert found == (NEUTRAL, LimitReason.NO_POSTURE)


@pytest.mark.parametrize("spoilt", ["forward", "right", "down", "yaw"])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_efforts_that_are_no_numbers(spoilt: str, bad: float) -> None:
    effort = replace(ASKED, **{spoilt: bad})
    found = engaged().check(100.0, 0.0, posture_at(), state_at(100.0), effort)
    assert found == (NEUTRAL, LimitReason.NOT_FINITE)


def test_postures_that_are_no_numbers() -> None:
    for posture in (posture_at(math.nan), posture_at(yaw=math.nan), posture_at(nearest=math.nan)):
        found = engaged().check(100.0, 0.0, posture, state_at(100.0), ASKED)
        assert found == (NEUTRAL, LimitReason.NOT_FINITE)


def test_time_that_runs_backwards_stops_one_update() -> None:
    gate = engaged()
    gate.check(100.0, 0.0, posture_at(), state_at(100.0), ASKED)
    found = gate.check(90.0, 0.0, posture_at(), state_at(90.0), ASKED)
    assert found == (NEUTRAL, LimitReason.CLOCK)
    assert gate.check(90.04, 0.0, posture_at(), state_at(90.04), ASKED) == (ASKED, None)
    found = gate.check(math.nan, 0.0, posture_at(), state_at(90.04), ASKED)
    assert found == (NEUTRAL, LimitReason.CLOCK)


def test_too_close_backs_away_and_does_nothing_else() -> None:
    gate = engaged()
    near = posture_at(gate.limits.least_range - 0.01)
    effort, reason = gate.check(100.0, 0.0, near, state_at(100.0), ASKED)
    assert reason is LimitReason.TOO_CLOSE
    # 10 of the 50 mm over which the retreat grows firm.
    back = -(0.25 + 0.2 * (0.5 - 0.25))
    assert effort.forward == pytest.approx(back)
    assert (effort.right, effort.down, effort.yaw) == (0.0, 0.0, ASKED.yaw)
    stronger = replace(ASKED, forward=-0.8)
    assert gate.check(100.04, 0.0, near, state_at(100.04), stronger)[0].forward == -0.8


@pytest.mark.parametrize(("within", "back"), [(0.0005, 0.25), (0.025, 0.375), (0.2, 0.5)])
def test_the_retreat_grows_firm_where_the_water_pushes_on(within: float, back: float) -> None:
    gate = engaged()
    near = posture_at(gate.limits.least_range - within)
    effort, _ = gate.check(100.0, 0.0, near, state_at(100.0), NEUTRAL)
    assert effort.forward == pytest.approx(-back, abs=0.003)
    # Never less than asked for, even where braking is set to be gentler than retreating.
    odd = engaged(limits=SafetyLimits(retreat_effort=0.4, brake_effort=0.2))
    assert odd.check(100.0, 0.0, near, state_at(100.0), NEUTRAL)[0].forward == -0.4


def test_a_posture_that_ages_is_taken_to_have_come_closer() -> None:
    """0.1 m/s towards the target, 76 mm left: allowed when seen, too fast 0.1 s later."""
    gate, posture = engaged(), posture_at(0.426)
    young = gate.check(100.0, 0.0, posture, state_at(100.0), ASKED, range_rate=-0.1)
    assert young == (ASKED, None)
    old = gate.check(100.1, 0.1, posture, state_at(100.1), ASKED, range_rate=-0.1)
    assert old[1] is LimitReason.TOO_FAST


def test_the_nearest_point_counts_where_it_is_nearer_than_the_plane() -> None:
    gate = engaged()
    fold = posture_at(0.6, nearest=gate.limits.least_range - 0.01)
    assert gate.check(100.0, 0.0, fold, state_at(100.0), ASKED)[1] is LimitReason.TOO_CLOSE


@pytest.mark.parametrize(
    ("distance", "range_rate", "reason", "sent"),
    [
        (1.0, -0.29, None, 0.3),
        # 0.04 m/s too fast, of the 0.2 m/s (two thirds of what is allowed) that brake in full.
        (1.0, -0.34, LimitReason.TOO_FAST, -0.1),
        (1.0, -0.6, LimitReason.TOO_FAST, -0.5),
        # 70 mm are left: 0.1 m/s for 0.7 s.
        (0.42, -0.09, None, 0.3),
        (0.42, -0.14, LimitReason.TOO_FAST, -0.3),
        (0.42, 0.5, None, 0.3),
    ],
)
def test_closing_speed_is_limited_by_the_way_that_is_left(
    distance: float, range_rate: float, reason: LimitReason | None, sent: float
) -> None:
    posture = posture_at(distance)
    effort, found = engaged().check(
        100.0, 0.0, posture, state_at(100.0), ASKED, range_rate=range_rate
    )
    assert found is reason
    assert effort.forward == pytest.approx(sent, abs=1e-5)


@pytest.mark.parametrize(("speed", "reason"), [(0.25, None), (0.4, LimitReason.TOO_FAST)])
def test_closing_speed_is_known_without_a_filter(speed: float, reason: LimitReason | None) -> None:
    gate = engaged()
    for k in range(10):
        now = 100.0 + 0.04 * k
        posture = posture_at(1.2 - speed * 0.04 * k)
        found = gate.check(now, 0.0, posture, state_at(now), ASKED)[1]
    assert found is reason


@given(
    now=st.floats(0.0, 10.0),
    age=st.floats(-1.0, 1.0),
    distance=st.floats(0.05, 3.0),
    rate=st.one_of(st.none(), st.floats(-2.0, 2.0)),
    asked=st.tuples(*[st.floats(-3.0, 3.0)] * 4),
    armed=st.booleans(),
    moves=st.booleans(),
)
def test_whatever_comes_the_gate_never_adds_approach(
    now: float,
    age: float,
    distance: float,
    rate: float | None,
    asked: tuple[float, float, float, float],
    armed: bool,
    moves: bool,
) -> None:
    gate = engaged(0.0)
    effort = Effort(forward=asked[0], right=asked[1], down=asked[2], yaw=asked[3])
    state = state_at(now, armed=armed, pilot_moves=moves)
    sent, reason = gate.check(now, age, posture_at(distance), state, effort, range_rate=rate)
    assert max(abs(sent.forward), abs(sent.right), abs(sent.down), abs(sent.yaw)) <= 1.0
    assert sent.forward <= max(effort.forward, 0.0)
    if distance < gate.limits.least_range or not armed or moves:
        assert sent.forward <= 0.0
    if not armed or moves or not 0.0 <= age < 0.2:
        assert sent == NEUTRAL
    if reason is None:
        assert sent.forward == min(max(effort.forward, -1.0), 1.0)


@pytest.mark.parametrize("doubt", [LimitReason.FROZEN, LimitReason.NO_ANSWER])
def test_a_doubt_brakes_for_a_moment_then_stops(doubt: LimitReason) -> None:
    gate, sent = engaged(), []
    for k in range(6):
        now = 100.0 + 0.04 * k
        # Later doubts change nothing, nor does one that passes if it gives the vehicle back.
        late = doubt if k == 0 or not doubt.takes_over else None
        found = gate.check(
            now,
            0.0,
            posture_at(),
            state_at(now),
            ASKED,
            doubt=late,
            brake=Brake(0.9 - 0.1 * k, now + 0.12),
        )
        assert found[1] is doubt
        sent.append(found[0])
    back = Effort(forward=-0.9)
    assert sent == [back] * 3 + [NEUTRAL] * 3
    assert gate.latched is (doubt if doubt.takes_over else None)
    # A pilot, and a vehicle that is not ours, come first.
    gate = engaged()
    moved = state_at(100.0, pilot_moves=True)
    found = gate.check(100.0, 0.0, posture_at(), moved, ASKED, doubt=doubt, brake=0.3)
    assert found == (NEUTRAL, LimitReason.PILOT_STICKS)


def test_a_tilted_vehicle_is_not_engaged() -> None:
    gate, limit = SafetyGate(), SafetyLimits().tilt
    for axis in ("roll", "pitch"):
        for sign in (-1.0, 1.0):
            tilted = state_at(5.0, **{axis: sign * (limit + 0.01)})
            assert gate.engage(5.0, tilted) is LimitReason.TIPPING
            assert gate.engage(5.0, state_at(5.0, **{axis: sign * (limit - 0.01)})) is None
    # A vehicle that does not tell its attitude can be engaged, and is not stopped.
    assert gate.engage(5.0, state_at(5.0)) is None
    assert gate.check(5.0, 0.0, posture_at(), tilted, ASKED) == (ASKED, None)


def test_every_reason_has_words() -> None:
    for reason in LimitReason:
        assert reason.words
        assert "\n" not in reason.words


@pytest.mark.parametrize(
    "wrong",
    [
        {"posture_age": 0.5},
        {"posture_age": 0.0},
        {"least_range": -0.1},
        {"approach_speed": math.nan},
        {"retreat_effort": 1.5},
    ],
)
def test_limits_that_cannot_work_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(OptionError, match=f"safety, {next(iter(wrong))}"):
        SafetyLimits(**wrong)
