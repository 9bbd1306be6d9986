"""Tuning: margins that are known by hand, gains that keep what they promise, the report."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aqualvs.control.gains_file import VEHICLES as PACKAGED
from aqualvs.control.gains_file import gains_text, load_gains
from aqualvs.control.tune import Loop, Tuned, TuneOptions, facts_of, margins, tune, usable_gains
from aqualvs.errors import OptionError
from aqualvs.follow.tune import StepOptions, run_tune, simulate_step
from aqualvs.simulation.vehicle.models import BLUEROV2, BLUEROV2_HEAVY, VEHICLES, VIDEORAY


@pytest.fixture(scope="module")
def tuned() -> dict[str, Tuned]:
    return {name: tune(model) for name, model in VEHICLES.items()}


def test_margins_of_an_integrator_with_delay() -> None:
    """k exp(-T s) / s: crossover k, phase pi/2 - k T, gain pi / (2 k T)."""
    k, delay = 1.5, 0.3
    found = margins(Loop(np.array([k]), np.array([1.0, 0.0]), delay))
    # The grid of frequencies is 0.6 % fine.
    assert found.stable
    assert found.crossover == pytest.approx(k, rel=0.01)
    assert found.phase == pytest.approx(math.pi / 2 - k * delay, abs=0.01)
    assert found.gain == pytest.approx(math.pi / (2.0 * k * delay), rel=0.01)
    assert found.delay == pytest.approx(found.phase / k, rel=0.01)


@pytest.mark.parametrize(("factor", "stable"), [(0.97, True), (1.03, False)])
def test_stability_ends_where_it_should(factor: float, stable: bool) -> None:
    """k exp(-T s) / s is stable for k T < pi / 2."""
    loop = Loop(np.array([factor * math.pi / 2.0]), np.array([1.0, 0.0]), 1.0)
    assert margins(loop).stable is stable


def test_modulus_of_a_first_order_loop() -> None:
    # |1 + k/s| is least at high frequencies, where it is 1.
    found = margins(Loop(np.array([2.0]), np.array([1.0, 0.0]), 0.0))
    # The frequencies end at 100 rad/s.
    assert found.modulus == pytest.approx(1.0, abs=1e-3)


def test_packaged_gains_are_what_tuning_gives(tuned: dict[str, Tuned]) -> None:
    assert tuple(VEHICLES) == PACKAGED
    for name, one in tuned.items():
        assert gains_text(one.gains) == gains_text(load_gains(name))


def test_every_vehicle_keeps_its_margins(tuned: dict[str, Tuned]) -> None:
    options = TuneOptions()
    for one in tuned.values():
        left = [
            one.range_corner.modulus - options.least_modulus,
            one.range_late.modulus - options.least_late_modulus,
        ]
        # Bisection ends within half a percent of the gain; one of the two limits it.
        assert 0.0 <= min(left) <= 0.02
        assert 0.0 <= one.yaw_late.modulus - options.least_yaw_modulus <= 0.02
        for margins_left in (one.range_corner, one.range_late, one.yaw_late):
            assert margins_left.stable
        # All is off at once at 200 ms: a quarter more gain and 50 ms more are still stable.
        assert one.range_late.gain >= 1.25
        assert one.range_late.delay >= 0.05
        for usual in (one.range_usual, one.yaw_usual):
            assert usual.modulus >= 0.39
            assert usual.delay >= 0.19
            assert usual.gain >= 2.5


def test_promised_delay_margin_is_that_of_the_simulator(tuned: dict[str, Tuned]) -> None:
    """Beyond the delay that the model can stand, the simulated vehicle swings as well."""
    gains, promised = tuned["bluerov2"].gains, 0.12 + tuned["bluerov2"].range_usual.delay
    calm = simulate_step(BLUEROV2, gains, StepOptions(delay=0.6 * promised))
    wild = simulate_step(BLUEROV2, gains, StepOptions(delay=1.6 * promised))
    late = calm.time > 9.0
    assert np.std(calm.range[late]) < 0.01
    assert np.std(wild.range[late]) > 3.0 * np.std(calm.range[late])


@pytest.mark.parametrize("model", [BLUEROV2_HEAVY, BLUEROV2, VIDEORAY], ids=lambda m: m.name)
@pytest.mark.parametrize(("begin", "end"), [(0.8, 0.6), (0.6, 0.8)])
def test_step_on_the_simulated_vehicle(model: object, begin: float, end: float) -> None:
    assert isinstance(model, type(BLUEROV2))
    answer = simulate_step(model, load_gains(model.name), StepOptions(begin=begin, end=end))
    assert answer.overshoot <= 0.15
    assert answer.settling <= 4.0


def test_less_delay_gives_faster_gains(tuned: dict[str, Tuned]) -> None:
    quick = tune(BLUEROV2, TuneOptions(delay=0.05, greatest_delay=0.1))
    assert quick.gains.range.speed > 1.2 * tuned["bluerov2"].gains.range.speed
    assert quick.gains.yaw.proportional > tuned["bluerov2"].gains.yaw.proportional


def test_facts_follow_the_pilot_gain() -> None:
    full = replace(BLUEROV2, sticks=replace(BLUEROV2.sticks, gain=1.0))
    half, whole = facts_of(BLUEROV2), facts_of(full)
    # 200 of 400 us, less the 20 of 40 that the dead zone takes.
    assert whole.turning_rate == pytest.approx(BLUEROV2.sticks.turning_rate, rel=1e-3)
    assert half.turning_rate == pytest.approx(whole.turning_rate * 180.0 / 380.0, rel=1e-3)
    assert whole.thrust.dead_band == pytest.approx(BLUEROV2.curve.dead_band)
    # Four thrusters at 45 degrees, two of them in reverse.
    most = math.sqrt(0.5) * 2.0 * (BLUEROV2.curve.forward + BLUEROV2.curve.reverse)
    assert whole.thrust.forward == pytest.approx(most, rel=1e-3)
    with pytest.raises(OptionError, match="dead band"):
        facts_of(replace(BLUEROV2, sticks=replace(BLUEROV2.sticks, gain=0.05)))


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(OptionError, match="no gains leave"):
        tune(BLUEROV2, TuneOptions(delay=20.0, greatest_delay=40.0))
    with pytest.raises(OptionError, match="delay"):
        TuneOptions(delay=0.3, greatest_delay=0.2)
    with pytest.raises(OptionError, match="no such model"):
        run_tune("submarine", print)


def test_report_says_margins_and_steps(tmp_path: Path) -> None:
    lines: list[str] = []
    path = tmp_path / "gains.yaml"
    run_tune("bluerov2", lines.append, output=path)
    text = "\n".join(lines)
    assert text.count("range") == 3
    assert "range  200 ms, worst" in text
    assert text.count("overshoot") == 2
    assert load_gains(path).vehicle.name == "bluerov2"
    printed: list[str] = []
    run_tune("bluerov2", printed.append)
    assert printed[-1] == path.read_text()


@pytest.mark.parametrize("name", PACKAGED)
def test_gains_that_would_swing_up_are_refused(name: str, tmp_path: Path) -> None:
    gains = usable_gains(name)
    for axis, keys in (("range", ("position", "speed", "integral")), ("yaw", ("proportional",))):
        own = getattr(gains, axis)
        for factor, sound in ((1.4, True), (3.0, False), (1000.0, False)):
            more = replace(own, **{key: factor * getattr(own, key) for key in keys})
            path = tmp_path / "gains.yaml"
            path.write_text(gains_text(replace(gains, **{axis: more})))
            if sound:
                usable_gains(path)
            else:
                with pytest.raises(OptionError, match=rf"gains\.yaml: the {axis} loop"):
                    usable_gains(path)
