"""Scores: numbers that can be reckoned by hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aqualvs.experiments.benchmark_score import bars_against, compare, pooled, score
from aqualvs.experiments.benchmark_set import Answers, DiveTruth

NAN = math.nan


def truth(n_visible, ranges=None):
    n = len(n_visible)
    posture = np.column_stack([np.full(n, 0.5) if ranges is None else ranges, np.zeros((n, 2))])
    return DiveTruth("clear_near", "clear", np.arange(n), posture, np.array(n_visible))


def answers(ranges, sigma=NAN, pitch=0.0):
    ranges = np.array(ranges, dtype=float)
    posture = np.column_stack([ranges, np.full((len(ranges), 2), pitch)])
    return Answers(np.isfinite(ranges), posture, np.full((len(ranges), 3), sigma))


def test_frames_count_by_what_they_show():
    # Measurable: the first four. Dim: two, one of them answered wrongly. Empty: two, one answered.
    seen = truth([500, 40, 41, 300, 39, 10, 0, 0], [0.5] * 6 + [NAN, 0.5])
    given_ = answers([0.5, NAN, 0.51, 0.6, NAN, 0.4, NAN, 0.7])
    found = score(compare(seen, given_))
    assert (found.n_frames, found.n_measurable, found.n_available) == (8, 4, 3)
    assert found.available_percent == 75.0
    assert found.n_wrong == 2
    assert (found.n_empty, found.n_false) == (2, 1)
    # Errors of 0, 2 and 20 %; the dim frame's is no part of them.
    assert found.range_percent.rms == pytest.approx(math.sqrt((4 + 400) / 3))
    assert found.range_percent.median == pytest.approx(2.0)
    assert found.range_percent.p95 == pytest.approx(18.2)
    assert found.range_percent.max == pytest.approx(20.0)
    assert math.isnan(found.z_range)


def test_an_invalid_answer_is_none_even_if_it_has_numbers():
    given_ = answers([0.5, 0.9])
    given_.valid[1] = False
    found = score(compare(truth([100, 100]), given_))
    assert (found.n_available, found.n_wrong) == (1, 0)
    assert found.range_percent.max == 0.0


def test_nothing_measurable_gives_no_numbers_rather_than_good_ones():
    found = score(compare(truth([0, 0]), answers([NAN, NAN])))
    assert math.isnan(found.available_percent)
    assert math.isnan(found.range_percent.rms)


def test_an_honest_system_has_z_one():
    rng = np.random.default_rng(5)
    n = 4000
    noise = rng.normal(0.0, 0.002, n)
    claimed = answers(0.5 + noise, sigma=0.002)
    found = score(compare(truth([100] * n), claimed))
    # The rms of 4000 normal numbers scatters by 1.1 %.
    assert found.z_range == pytest.approx(1.0, abs=0.04)
    assert found.sigma_range_percent == pytest.approx(0.4)
    proud = answers(0.5 + noise, sigma=0.0005)
    assert score(compare(truth([100] * n), proud)).z_range == pytest.approx(4.0, abs=0.16)


@given(st.lists(st.floats(0.3, 1.3), min_size=2, max_size=12), st.data())
def test_dives_pool_as_one_long_dive(ranges, data):
    n = len(ranges)
    answered = answers(data.draw(st.lists(st.floats(0.3, 1.3), min_size=n, max_size=n)), 0.01)
    whole = compare(truth([100] * n, ranges), answered)
    cut = data.draw(st.integers(1, n - 1))
    halves = [
        compare(
            truth([100] * len(ranges[part]), ranges[part]),
            Answers(answered.valid[part], answered.posture[part], answered.sigma[part]),
        )
        for part in (slice(cut), slice(cut, None))
    ]
    assert score(pooled(halves)) == score(whole)


def test_error_bars_compare_frame_by_frame_where_both_are_measured():
    clear = compare(truth([100, 100, 100]), answers([0.5, 0.5, 0.5], sigma=0.001))
    harder = compare(truth([100, 100, 20]), answers([0.5, NAN, 0.5], sigma=0.002))
    ratios = bars_against(harder, clear)
    assert ratios[0] == pytest.approx([2.0, 2.0, 2.0])
    assert np.isnan(ratios[1:]).all()
