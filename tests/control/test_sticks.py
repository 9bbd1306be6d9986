"""Sticks: what a link sends for an effort, through ArduSub's dead zones, trims and limits."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aqualvs.control.sticks import PARAMETERS, StickChannel, StickShaping, shaping_of
from aqualvs.control.tune import shaping_of_model
from aqualvs.control.vehicle import NEUTRAL, Effort
from aqualvs.simulation.vehicle.models import BLUEROV2, StickInput

SHARES = st.floats(-1.0, 1.0)


def answered(effort: Effort, own: StickInput) -> tuple[float, float, float, float]:
    """What a vehicle does for an effort, as shares of what it does for a full one."""
    model = replace(BLUEROV2, sticks=own)
    shaping = shaping_of_model(model)

    def asked(one: Effort) -> tuple[float, float, float, float]:
        sticks = shaping.sticks(one)
        return own.asked(sticks.x, sticks.y, sticks.z, sticks.r)

    parts = asked(effort)
    full = tuple(
        abs(asked(Effort(**{name: math.copysign(1.0, getattr(effort, name))}))[k])
        for k, name in enumerate(("forward", "right", "down", "yaw"))
    )
    return tuple(a / b for a, b in zip(parts, full, strict=True))


@given(
    SHARES,
    SHARES,
    SHARES,
    SHARES,
    st.sampled_from([0.25, 0.5, 0.6, 0.75, 1.0]),
    st.sampled_from([0, 20, 40, 100]),
    st.sampled_from([0, 50, 100, 200]),
    st.tuples(*[st.integers(1490, 1510)] * 3),
)
def test_the_vehicle_does_what_the_effort_says(
    forward: float,
    right: float,
    down: float,
    yaw: float,
    gain: float,
    yaw_zone: int,
    throttle_zone: int,
    trims: tuple[int, int, int],
) -> None:
    own = StickInput(
        gain=gain, yaw_dead_zone=yaw_zone, throttle_dead_zone=throttle_zone, trims=trims
    )
    effort = Effort(forward=forward, right=right, down=down, yaw=yaw)
    # A whole microsecond of the 400 at full gain, less what the dead zone takes; the throttle cuts
    # to thousandths on the way.
    fine = 1.5 / (400.0 * gain - 10.0)
    found = answered(effort, own)
    assert found[0] == pytest.approx(forward, abs=fine)
    assert found[1] == pytest.approx(right, abs=fine)
    assert found[3] == pytest.approx(yaw, abs=fine / (1.0 - yaw_zone / 400.0))
    # Both ways it goes as fast as the slower of full sticks up and down.
    share = shaping_of_model(replace(BLUEROV2, sticks=own)).climbing_share
    sticks = shaping_of_model(replace(BLUEROV2, sticks=own)).sticks(effort)
    descent = own.asked(sticks.x, sticks.y, sticks.z, sticks.r)[2]
    assert descent == pytest.approx(down * share, abs=6e-3)


def test_nothing_is_nothing() -> None:
    neutral = StickShaping().sticks(NEUTRAL)
    assert (neutral.x, neutral.y, neutral.z, neutral.r) == (0, 0, 500, 0)
    # The trim is where the vehicle does nothing.
    own = StickInput(trims=(1500, 1510, 1500))
    sticks = shaping_of_model(replace(BLUEROV2, sticks=own)).sticks(NEUTRAL)
    assert own.asked(sticks.x, sticks.y, sticks.z, sticks.r) == (0.0, 0.0, 0.0, 0.0)
    assert sticks.x != 0


def test_a_small_yaw_is_past_the_dead_zone() -> None:
    sticks = StickShaping().sticks(Effort(yaw=0.02))
    # 40 us times the gain of 0.5 are a tenth of the stick.
    assert 100 < sticks.r < 130
    assert StickShaping().sticks(Effort(yaw=-1.0)).r == pytest.approx(-1000, abs=2)


def test_poshold_has_a_dead_zone_on_the_level_sticks() -> None:
    free, held = (
        StickShaping().sticks(Effort(forward=0.1), keeps_place=keeps) for keeps in (False, True)
    )
    assert free.x == pytest.approx(100, abs=5)
    # THR_DZ 100 is a quarter of the stick there.
    assert held.x == pytest.approx(250 + 75, abs=5)


def test_parameters_that_the_vehicle_told() -> None:
    told = {"RC4_DZ": 20.0, "RC4_TRIM": 1510.0, "THR_DZ": 60.0, "JS_GAIN_DEFAULT": 0.75}
    shaping = shaping_of(told)
    assert shaping.yaw == StickChannel(trim=1510.0, dead_zone=20.0)
    assert (shaping.throttle_dead_zone, shaping.gain) == (60.0, 0.75)
    assert shaping_of({}) == StickShaping()
    # A throttle's trim at its bottom is ArduSub's own default, and means nothing.
    assert shaping_of({"RC3_TRIM": 1100.0}) == StickShaping()
    assert set(told) < set(PARAMETERS)


@pytest.mark.parametrize(
    "broken",
    [
        {"RC4_MIN": 0.0},
        {"RC4_TRIM": 5.0},
        {"RC5_MAX": 1000.0},
        {"RC4_DZ": math.nan},
        {"JS_GAIN_DEFAULT": 9.0},
        {"THR_DZ": -1.0},
    ],
)
def test_parameters_that_cannot_be_count_as_untold(broken: dict[str, float]) -> None:
    assert shaping_of(broken) == StickShaping()


def test_a_reversed_channel_turns_the_sign() -> None:
    shaping = shaping_of({"RC4_REVERSED": 1.0, "RC3_REVERSED": 1.0})
    turned, plain = (
        shaping.sticks(Effort(yaw=0.5, down=0.5)),
        StickShaping().sticks(Effort(yaw=0.5, down=0.5)),
    )
    assert turned.r == pytest.approx(-plain.r, abs=5)
    assert turned.z == pytest.approx(1000 - plain.z, abs=6)
