"""The time filter: consistent with simulated motion, deaf to outliers, honest about silence."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import chdtri

from aqualvs.control.time_filter import FilteredPosture, PostureFilter, PostureFilterOptions
from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.scanning.posture import Posture, Reason, Refusal
from whole import WHOLE

NOTHING = Refusal(Reason.NO_STRIPES)
# As dives show it: 1 mm, 0.3 and 0.2 degrees, range and yaw correlated.
SIGMA = np.array([1e-3, np.deg2rad(0.3), np.deg2rad(0.2)])
COV = np.outer(SIGMA, SIGMA) * np.array([[1.0, 0.2, -0.6], [0.2, 1.0, 0.1], [-0.6, 0.1, 1.0]])


def posture(values: FloatArray, cov: FloatArray = COV) -> Posture:
    distance, pitch, yaw = (float(value) for value in values)
    return Posture(
        range=distance,
        pitch=pitch,
        yaw=yaw,
        covariance=cov,
        normal_in_dome=np.array([0.0, 1.0, 0.0]),
        slant_range=distance,
        nearest=distance,
        n_points=500,
        rms=1e-3,
    )


def values_of(filtered: FilteredPosture | None) -> FloatArray:
    assert filtered is not None
    return np.array([filtered.range, filtered.pitch, filtered.yaw])


@dataclass
class Dive:
    """Motion drawn from the filter's own model, and its measurements."""

    times: FloatArray
    truth: FloatArray
    measured: FloatArray


def dive(
    rng: np.random.Generator, options: PostureFilterOptions, n: int = 60, dt: float = 0.04
) -> Dive:
    noise = np.array(
        [options.range_acceleration, options.pitch_acceleration, options.yaw_acceleration]
    )
    rates = rng.normal(size=3) * [
        options.initial_speed,
        options.initial_turn_rate,
        options.initial_turn_rate,
    ]
    place = np.array([0.6, 0.1, -0.1])
    spread = np.linalg.cholesky([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    truth = np.empty((n, 6))
    for i in range(n):
        truth[i] = np.concatenate((place, rates))
        kick = spread @ rng.normal(size=(2, 3)) * noise
        place, rates = place + dt * rates + kick[0], rates + kick[1]
    measured = truth[:, :3] + rng.normal(size=(n, 3)) @ np.linalg.cholesky(COV).T
    return Dive(dt * np.arange(n), truth, measured)


def run(smoother: PostureFilter, motion: Dive) -> list[FilteredPosture]:
    found = [
        smoother.update(t, posture(z)) for t, z in zip(motion.times, motion.measured, strict=True)
    ]
    return [entry for entry in found if entry is not None]


def track_of(place: FloatArray, seconds: float, dt: float = 0.04) -> PostureFilter:
    """A filter that has seen a still target without noise."""
    smoother = PostureFilter()
    for i in range(round(seconds / dt) + 1):
        smoother.update(i * dt, posture(place))
    return smoother


STILL = np.array([0.6, 0.05, -0.1])


def test_covariance_is_that_of_the_errors() -> None:
    """Two-sided: neither too sure nor too shy (Bar-Shalom 2001, 5.4.2, NEES)."""
    rng = np.random.default_rng(1)
    # The gate would cut the tail that the statistic counts.
    options = PostureFilterOptions(gate_probability=1.0 - 1e-12)
    n_runs, errors = 200 if WHOLE else 60, []
    for _ in range(n_runs):
        motion = dive(rng, options)
        found = run(PostureFilter(options), motion)
        assert len(found) == len(motion.times)
        for i in (0, 1, 5, 59):
            entry = found[i]
            error = np.concatenate((values_of(entry), entry.rates)) - motion.truth[i]
            errors.append((i, error @ np.linalg.solve(entry.covariance, error)))
    for i in (0, 1, 5, 59):
        sum_of = sum(value for where, value in errors if where == i)
        # Runs are independent, so the sum is chi2 with 6 degrees of freedom a run; 1 in 10000.
        low, high = chdtri(6 * n_runs, [1 - 5e-5, 5e-5])
        assert low < sum_of < high, f"frame {i}: mean NEES {sum_of / n_runs:.2f}, expected 6"


def test_it_is_better_than_what_it_is_given() -> None:
    rng = np.random.default_rng(2)
    options = PostureFilterOptions()
    ratios = []
    for _ in range(20):
        motion = dive(rng, options, n=150)
        found = np.array([values_of(entry) for entry in run(PostureFilter(options), motion)])
        settled = slice(25, None)
        after = np.sqrt(np.mean((found - motion.truth[:, :3])[settled] ** 2, axis=0))
        before = np.sqrt(np.mean((motion.measured - motion.truth[:, :3])[settled] ** 2, axis=0))
        ratios.append(after / before)
    assert np.all(np.mean(ratios, axis=0) < 0.95)


def test_rates_follow_a_constant_motion_without_lag() -> None:
    smoother = PostureFilter()
    rates = np.array([0.2, -0.1, 0.3])
    for i in range(100):
        found = smoother.update(0.04 * i, posture(STILL + 0.04 * i * rates))
    assert found is not None
    # No noise was added; what is left of the unknown initial rates has died away.
    np.testing.assert_allclose(values_of(found), STILL + 0.04 * 99 * rates, atol=1e-6)
    np.testing.assert_allclose(found.rates, rates, atol=1e-5)


@pytest.mark.parametrize("period_s", [2.0, 5.0])
def test_lag_is_short(period_s: float) -> None:
    """Swaying before the net at the amplitude of a swell: how late is the filter?"""
    amplitude = np.array([0.1, 0.1, 0.2])
    times = 0.04 * np.arange(round(4 * period_s / 0.04))
    wave = np.sin(2 * np.pi * times / period_s)
    smoother = PostureFilter()
    found = np.array(
        [
            values_of(smoother.update(t, posture(STILL + a * amplitude)))
            for t, a in zip(times, wave, strict=True)
        ]
    )
    # The last whole period, correlated with sine and cosine, gives the phase.
    last = times >= times[-1] - period_s + 0.02
    turn = 2 * np.pi * times[last] / period_s
    centred = found[last] - STILL
    phase = np.arctan2(centred.T @ np.cos(turn), centred.T @ np.sin(turn))
    lag_s = -phase * period_s / (2 * np.pi)
    # Measured: 2.1 ms at most, of pitch, which is least well known; a frame takes 40.
    assert np.all(np.abs(lag_s) < 4e-3), lag_s
    gain = np.hypot(centred.T @ np.cos(turn), centred.T @ np.sin(turn)) * 2 / last.sum() / amplitude
    # Measured: 2.3 % too far at most; a filter of rates overshoots a little.
    np.testing.assert_allclose(gain, 1.0, atol=0.04)


def test_a_jump_is_rejected() -> None:
    smoother = track_of(STILL, 1.0)
    jump = 30 * SIGMA * [1.0, 0.0, 0.0]
    found = smoother.update(1.04, posture(STILL + jump))
    assert found is not None
    assert not found.accepted
    assert found.age_s == pytest.approx(0.04)
    np.testing.assert_allclose(values_of(found), STILL, atol=1e-6)
    after = smoother.update(1.08, posture(STILL))
    assert after is not None
    assert after.accepted


@pytest.mark.parametrize("axis", [1, 2])
def test_an_angle_that_jumps_is_left_out_alone(axis: int) -> None:
    smoother = track_of(STILL, 1.0)
    jump = np.zeros(3)
    jump[0], jump[axis] = SIGMA[0], 100 * SIGMA[axis]
    seen = []
    for i in range(1, 9):
        found = smoother.update(1.0 + 0.04 * i, posture(STILL + jump))
        assert found is not None
        assert found.accepted
        seen.append(values_of(found))
    # The range follows its measurements, the other angle stays.
    assert abs(seen[3][0] - STILL[0] - SIGMA[0]) < 0.2 * SIGMA[0]
    assert seen[-1][3 - axis] == pytest.approx(STILL[3 - axis], abs=SIGMA[3 - axis])
    # The angle begins anew where it stays.
    assert [one[axis] == pytest.approx(STILL[axis], abs=SIGMA[axis]) for one in seen] == [
        *[True] * 2,
        *[False] * 6,
    ]
    assert seen[-1][axis] == pytest.approx(STILL[axis] + jump[axis], abs=SIGMA[axis])


def test_a_vehicle_that_pitches_over_keeps_its_range() -> None:
    """At 200 degrees/s and more; the range must not coast away with the speed of before."""
    smoother, rng = PostureFilter(), np.random.default_rng(6)
    for i in range(100):
        time_s = 0.04 * i
        late = max(time_s - 2.0, 0.0)
        # It closes in at 0.5 m/s, is braked within half a second, and pitches to and fro.
        braked = min(late, 0.5)
        way = 0.5 * min(time_s, 2.0) + 0.5 * braked - 0.5 * braked**2
        true = STILL + np.array([1.5 - way, 0.8 * math.sin(5.0 * late), 0.0])
        found = smoother.update(time_s, posture(true + SIGMA * rng.normal(size=3)))
        assert found is not None
        if time_s > 2.0:
            # By the brake's 1 m/s², which is five times the model's: its lag.
            assert found.range == pytest.approx(true[0], abs=0.03)


def test_full_thrust_is_followed() -> None:
    """It closes in at 0.5 m/s, and its whole thrust throws it back at 4 m/s²."""
    sigma = np.array([2.4e-3, 7e-3, 7e-3])
    times = 0.04 * np.arange(75)
    pushed, free = np.clip(times - 2.0, 0.0, 0.375), np.maximum(times - 2.375, 0.0)
    true, rates = 1.6 - 0.5 * (times - free) + 2.0 * pushed**2 + free, -0.5 + 4.0 * pushed
    worst = []
    for seed in range(20):
        smoother, rng, errors = PostureFilter(), np.random.default_rng(seed), []
        for time_s, near, rate in zip(times, true, rates, strict=True):
            place = np.array([near, 0.0, 0.0]) + sigma * rng.normal(size=3)
            found = smoother.update(time_s, posture(place, np.diag(sigma**2)))
            assert found is not None
            errors.append((abs(found.range - near), abs(found.rates[0] - rate)))
        worst.append(np.max(errors[25:], axis=0))
    # Measured: 6 mm and 0.2 m/s in most, where no posture is left out; 44 mm and 0.6 m/s at worst.
    assert np.all(np.median(worst, axis=0) < [0.012, 0.35])
    assert np.all(np.max(worst, axis=0) < [0.06, 0.8])


def test_a_true_step_is_believed_after_a_few_frames() -> None:
    smoother = track_of(STILL, 1.0)
    step = STILL + np.array([0.2, 0.0, 0.1])
    found = [smoother.update(1.0 + 0.04 * i, posture(step)) for i in range(1, 5)]
    assert [entry is not None and entry.accepted for entry in found] == [False] * 2 + [True] * 2
    np.testing.assert_allclose(values_of(found[2]), step, atol=1e-6)


def test_outliers_that_disagree_are_never_believed() -> None:
    rng = np.random.default_rng(3)
    smoother = track_of(STILL, 1.0)
    for i in range(1, 12):
        wild = STILL + rng.choice([-1, 1], 3) * rng.uniform(0.1, 0.3, 3)
        found = smoother.update(1.0 + 0.04 * i, posture(wild))
        assert found is not None
        assert not found.accepted
        np.testing.assert_allclose(values_of(found), STILL, atol=1e-5)


def test_a_brisk_manoeuvre_passes_the_gate() -> None:
    """A pilot who starts, stops and turns as hard as a small vehicle can."""
    rng = np.random.default_rng(4)
    times = 0.04 * np.arange(100)
    push = np.where(np.sin(2 * np.pi * times) > 0, 1.0, -1.0)
    rates = np.cumsum(0.04 * push[:, None] * [1.0, 1.0, 2.0], axis=0)
    places = STILL + np.cumsum(0.04 * rates, axis=0)
    noisy = places + rng.normal(size=(100, 3)) @ np.linalg.cholesky(COV).T
    smoother = PostureFilter()
    found = [smoother.update(t, posture(z)) for t, z in zip(times, noisy, strict=True)]
    assert all(entry is not None and entry.accepted for entry in found)


def test_it_coasts_and_then_gives_up() -> None:
    smoother = PostureFilter()
    rates = np.array([0.1, 0.0, 0.0])
    for i in range(51):
        smoother.update(0.04 * i, posture(STILL + 0.04 * i * rates))
    sigmas = []
    for ahead_s in (0.1, 0.3, 0.5):
        found = smoother.update(2.0 + ahead_s, NOTHING)
        assert found is not None
        assert not found.accepted
        assert found.age_s == pytest.approx(ahead_s)
        np.testing.assert_allclose(values_of(found), STILL + (2.0 + ahead_s) * rates, atol=1e-4)
        sigmas.append(math.sqrt(found.covariance[0, 0]))
    assert sigmas == sorted(sigmas)
    assert smoother.update(2.51, NOTHING) is None
    assert smoother.update(2.52, NOTHING) is None


def test_it_starts_anew_after_a_gap() -> None:
    smoother = track_of(STILL, 1.0)
    elsewhere = STILL + np.array([0.3, 0.0, 0.0])
    found = smoother.update(1.6, posture(elsewhere))
    assert found is not None
    assert found.accepted
    np.testing.assert_allclose(values_of(found), elsewhere)
    np.testing.assert_array_equal(found.rates, 0.0)
    assert found.covariance[3, 3] == pytest.approx(0.25)


def test_nothing_before_the_first_measurement() -> None:
    smoother = PostureFilter()
    assert smoother.update(0.0, NOTHING) is None
    found = smoother.update(0.04, posture(STILL))
    assert found is not None
    assert found.accepted
    assert found.age_s == 0.0


def test_a_dropout_does_not_disturb() -> None:
    smoother = track_of(STILL, 1.0)
    for i in range(1, 10):
        smoother.update(1.0 + 0.04 * i, NOTHING)
    found = smoother.update(1.4, posture(STILL))
    assert found is not None
    assert found.accepted
    np.testing.assert_allclose(values_of(found), STILL, atol=1e-6)


def test_two_measurements_at_one_time_are_averaged() -> None:
    smoother = PostureFilter()
    smoother.update(1.0, posture(STILL))
    beside = STILL + np.array([SIGMA[0], 0.0, 0.0])
    found = smoother.update(1.0, posture(beside))
    assert found is not None
    assert found.accepted
    np.testing.assert_allclose(values_of(found), (STILL + beside) / 2, atol=1e-9)
    np.testing.assert_allclose(found.covariance[:3, :3], COV / 2, rtol=1e-5)


def test_time_that_steps_back_a_little_is_left_out() -> None:
    smoother = track_of(STILL, 1.0)
    found = smoother.update(0.9, posture(STILL + 0.001))
    assert found is not None
    assert not found.accepted
    assert found.age_s == 0.0
    np.testing.assert_allclose(values_of(found), STILL, atol=1e-9)
    following = smoother.update(1.04, posture(STILL))
    assert following is not None
    assert following.accepted


def test_time_that_steps_back_far_is_another_stream() -> None:
    smoother = track_of(STILL, 1.0)
    found = smoother.update(0.0, posture(STILL + 0.2))
    assert found is not None
    assert found.accepted
    np.testing.assert_allclose(values_of(found), STILL + 0.2)


def test_frames_that_were_held_up_still_count() -> None:
    """A stall of the network: silence is told at a later time than the frames then carry."""
    smoother = track_of(STILL, 1.0)
    assert smoother.update(1.3, NOTHING) is not None
    found = smoother.update(1.04, posture(STILL))
    assert found is not None
    assert found.accepted


def test_the_frame_rate_does_not_matter() -> None:
    """The same light at twice the rate: half the variance per second is the same knowledge."""
    # A calm vehicle: the filter looks back over many frames even at the lowest rate.
    calm = PostureFilterOptions(
        range_acceleration=0.01, pitch_acceleration=0.03, yaw_acceleration=0.03
    )
    final = []
    for fps in (12.5, 25.0, 50.0, 100.0):
        smoother = PostureFilter(calm)
        for i in range(round(4 * fps) + 1):
            t = i / fps
            place = STILL + np.array([0.02, 0.05, 0.05]) * math.sin(t)
            found = smoother.update(t, posture(place, COV * fps / 25.0))
        assert found is not None
        final.append((values_of(found), found.rates, np.sqrt(np.diag(found.covariance))))
    reference = final[-1]
    for places, rates, sigmas in final[:-1]:
        np.testing.assert_allclose(places, reference[0], atol=1e-3)
        np.testing.assert_allclose(rates, reference[1], atol=0.02)
        # A frame that has just come counts for more the rarer frames are.
        np.testing.assert_allclose(sigmas, reference[2], rtol=0.25)


def test_a_forecast_does_not_depend_on_its_steps() -> None:
    stepped, direct = track_of(STILL, 1.0), track_of(STILL, 1.0)
    for i in range(1, 10):
        stepped.update(1.0 + 0.04 * i, NOTHING)
    one, other = stepped.update(1.4, NOTHING), direct.update(1.4, NOTHING)
    assert one is not None
    assert other is not None
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-12)


@pytest.mark.parametrize(
    "spoilt",
    [
        replace(posture(STILL), range=math.nan),
        posture(STILL, np.full((3, 3), np.nan)),
        posture(STILL, np.diag([1e-6, -1e-6, 1e-6])),
    ],
)
def test_a_posture_without_sense_does_not_enter(spoilt: Posture) -> None:
    smoother = track_of(STILL, 1.0)
    found = smoother.update(1.04, spoilt)
    assert found is not None
    assert not found.accepted
    np.testing.assert_allclose(values_of(found), STILL, atol=1e-6)


def test_exact_measurements_are_no_trouble() -> None:
    smoother = PostureFilter()
    for i in range(20):
        found = smoother.update(0.04 * (i // 2), posture(STILL, np.zeros((3, 3))))
    np.testing.assert_allclose(values_of(found), STILL, atol=1e-9)


def test_raw_values_stay_as_they_are() -> None:
    raw = posture(STILL, COV.copy())
    smoother = PostureFilter()
    found = smoother.update(0.0, raw)
    assert found is not None
    found.covariance[:], found.rates[:] = 0.0, 9.0
    np.testing.assert_array_equal(raw.covariance, COV)
    again = smoother.update(0.04, NOTHING)
    assert again is not None
    assert again.covariance[0, 0] > 0.0
    assert again.rates[0] == 0.0


times = st.floats(-2.0, 2.0) | st.sampled_from([0.0, 1e9, math.inf, math.nan])
changes = st.lists(st.tuples(times, st.floats(-0.3, 0.3), st.booleans()), max_size=30)


@given(changes)
@settings(max_examples=100, deadline=None)
def test_it_survives_any_clock(steps: list[tuple[float, float, bool]]) -> None:
    smoother, t = PostureFilter(), 0.0
    for dt, offset, seen in steps:
        t = t + dt if math.isfinite(dt) else dt
        found = smoother.update(t, posture(STILL + offset) if seen else NOTHING)
        t = t if math.isfinite(t) else 0.0
        if found is not None:
            assert np.isfinite(values_of(found)).all()
            assert 0.0 <= found.age_s <= smoother.options.max_coast
            assert np.linalg.eigvalsh(found.covariance)[0] > -1e-12


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("range_acceleration", 0.0),
        ("yaw_acceleration", math.nan),
        ("max_coast", -1.0),
        ("gate_probability", 1.0),
        ("n_rejected", 0),
    ],
)
def test_options_without_sense_are_refused(name: str, value: float) -> None:
    with pytest.raises(OptionError, match=name):
        PostureFilterOptions(**{name: value})
