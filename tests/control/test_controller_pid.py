"""The PID controller: each rule by itself, on plants simple enough to calculate."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aqualvs.control.controller import Pid, PidOptions

STEP = 0.04


def times(n: int) -> list[float]:
    return [STEP * k for k in range(n)]


def test_output_is_the_sum_of_its_parts() -> None:
    pid = Pid(PidOptions(proportional=2.0, integral=3.0, derivative=0.5))
    pid.update(0.0, 1.0, 0.0, rate=0.0)
    output = pid.update(0.1, 1.0, 0.4, rate=0.2, forward=0.05)
    # P 2 * 0.6, I 3 * 0.6 * 0.1, D -0.5 * 0.2.
    assert output == pytest.approx(1.2 + 0.18 - 0.1 + 0.05)
    assert pid.integral == pytest.approx(0.18)


def test_derivative_ignores_the_setpoint() -> None:
    options = PidOptions(proportional=0.0, derivative=1.0)
    calm, kicked = Pid(options), Pid(options)
    for k, time in enumerate(times(20)):
        here = 0.3 * math.sin(time)
        assert kicked.update(time, float(k % 2), here) == calm.update(time, 0.0, here)


def test_derivative_filter_reaches_the_slope_with_its_time_constant() -> None:
    pid = Pid(PidOptions(proportional=0.0, derivative=1.0, derivative_time=0.2))
    outputs = [pid.update(time, 0.0, 0.5 * time) for time in times(100)]
    after = round(0.2 / STEP)
    # Backward Euler of 5 steps a time constant: within 10 % of 1 - 1/e.
    assert -outputs[after] == pytest.approx(0.5 * (1.0 - math.exp(-1.0)), rel=0.1)
    assert -outputs[-1] == pytest.approx(0.5, rel=1e-6)


def test_measured_rate_replaces_the_filter() -> None:
    pid = Pid(PidOptions(proportional=0.0, derivative=1.0))
    assert pid.update(0.0, 0.0, 5.0, rate=0.25) == -0.25


@given(
    st.lists(
        st.tuples(st.floats(-10, 10), st.floats(-10, 10), st.floats(-0.2, 1.0)),
        min_size=1,
        max_size=40,
    )
)
def test_limits_of_output_and_rate_always_hold(steps: list[tuple[float, float, float]]) -> None:
    options = PidOptions(
        proportional=3.0, integral=2.0, derivative=0.4, low=-0.5, high=0.8, output_rate=2.0
    )
    pid, time, before = Pid(options), 0.0, 0.0
    for setpoint, measured, dt in steps:
        time += dt
        output = pid.update(time, setpoint, measured)
        assert -0.5 <= output <= 0.8
        assert abs(output - before) <= 2.0 * max(abs(dt), STEP) + 1e-12
        before = output


def integrator(pid: Pid, seconds: float, setpoint: float, start: float = 0.0) -> np.ndarray:
    """Run dx/dt = u and return x."""
    x, track = start, []
    for time in times(round(seconds / STEP)):
        x += STEP * pid.update(time, setpoint, x)
        track.append(x)
    return np.array(track)


def test_integral_does_not_wind_up_while_saturated() -> None:
    free = {"proportional": 2.0, "integral": 1.0}
    track = integrator(Pid(PidOptions(**free, low=-0.2, high=0.2)), 40.0, 2.0)
    # It takes 10 s at the limit. The linear loop overshoots by less than 15 %; wound up by 10 s of
    # an error of 1 on the mean, it would overshoot by metres.
    assert track.max() < 2.0 * 1.15
    assert track[-1] == pytest.approx(2.0, abs=0.01)


def test_integral_does_not_wind_up_against_the_rate_limit() -> None:
    slow = PidOptions(proportional=1.0, integral=0.3, output_rate=0.05)
    pid = Pid(slow)
    for time in times(50):
        pid.update(time, 1.0, 0.0)
    # Two seconds of error 1 would make 0.6; the output could go to 0.1 alone.
    assert pid.integral <= 0.02


def test_pause_keeps_the_integral_and_starts_from_zero() -> None:
    pid = Pid(PidOptions(proportional=1.0, integral=2.0, output_rate=5.0))
    for time in times(26):
        pid.update(time, 1.0, 0.5)
    known = pid.integral
    pid.pause()
    assert pid.integral == known
    # A second of an error of 0.5, less the steps in which the output's rate was at its limit.
    assert 0.8 < known < 1.0
    assert pid.update(60.0, 0.5, 0.5) == pytest.approx(5.0 * STEP)


def test_time_that_stands_still_or_steps_back_changes_nothing() -> None:
    pid = Pid(PidOptions(proportional=1.0, integral=1.0))
    pid.update(1.0, 1.0, 0.0)
    output, integral = pid.update(1.04, 1.0, 0.0), pid.integral
    assert pid.update(1.04, 9.0, 0.0) == output
    assert pid.update(0.9, 9.0, 0.0) == output
    assert pid.integral == integral


def test_another_stream_and_a_gap_start_anew() -> None:
    for time in (1.0, 500.0):
        pid = Pid(PidOptions(proportional=1.0, integral=1.0, derivative=1.0))
        pid.update(100.0, 1.0, 0.0)
        pid.update(100.04, 1.0, 0.0)
        integral = pid.integral
        # Nothing is integrated, and the jump of the measurement is no rate.
        assert pid.update(time, 1.0, 0.7) == pytest.approx(0.3 + integral)
        assert pid.integral == integral


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_finite_changes_nothing(bad: float) -> None:
    pid = Pid(PidOptions(proportional=1.0, integral=1.0))
    pid.update(0.0, 1.0, 0.0)
    output = pid.update(0.04, 1.0, 0.0)
    for arguments in ((bad, 1.0, 0.0), (0.08, bad, 0.0), (0.08, 1.0, bad)):
        assert pid.update(*arguments) == output
    assert pid.update(0.08, 1.0, 0.0, rate=bad) == output
    assert math.isfinite(pid.update(0.08, 1.0, 0.0))


def test_applied_output_is_where_the_rate_limit_starts() -> None:
    pid = Pid(PidOptions(proportional=10.0, output_rate=1.0))
    pid.update(0.0, 1.0, 0.0)
    pid.applied(-0.5)
    assert pid.update(0.04, 1.0, 0.0) == pytest.approx(-0.46)


def test_schedule_scales_proportional_and_integral() -> None:
    pid = Pid(PidOptions(proportional=2.0, integral=3.0))
    pid.update(0.0, 1.0, 0.0)
    assert pid.update(0.1, 1.0, 0.0, schedule=(2.0, 3.0)) == pytest.approx(4.0 + 0.9)
