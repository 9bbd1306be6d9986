"""Segments: what follows on what, what cannot be this laser, and what belongs to one strand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.scanning.laser_bands import SearchAxis, StripeSearch
from aqualvs.scanning.segments import CHUNK_LINES, Segments, link_segments
from aqualvs.scanning.stripe import Returns

N_LINES, LENGTH = 400, 300


def search_for(
    slopes: tuple[float, float] = (-1.0, 1.0), band: tuple[int, int] = (0, LENGTH - 1)
) -> StripeSearch:
    cells = np.ones((-(-LENGTH // 8), -(-N_LINES // 8)))
    return StripeSearch(
        axis=SearchAxis.ALONG_Y,
        line_px=1,
        lowest=np.full(N_LINES, band[0]),
        highest=np.full(N_LINES, band[1]),
        slope_low=slopes[0] * cells,
        slope_high=slopes[1] * cells,
    )


def returns_at(*stripes: tuple[IntArray, FloatArray]) -> Returns:
    """Returns on stripes given as (line, position), in the order that detectors keep."""
    line = np.concatenate([line for line, _ in stripes])
    position = np.concatenate([position for _, position in stripes])
    order = np.lexsort((position, line))
    n = len(line)
    return Returns(
        line=line[order],
        position=position[order],
        height=np.full(n, 80.0),
        width=np.full(n, 5.0),
        likelihood=np.full(n, 20.0),
    )


def straight(first: int, last: int, at: float, slope: float = 0.0) -> tuple[IntArray, FloatArray]:
    line = np.arange(first, last + 1)
    return line, at + slope * (line - first)


def members(segments: Segments, of: IntArray) -> list[set[int]]:
    """Sets of returns that share a number."""
    return [set(segments.order[of == k].tolist()) for k in np.unique(of)]


def test_a_wall_s_stripe_is_one_stretch_in_small_chunks() -> None:
    returns = returns_at(straight(20, 219, 100.0, 0.3))
    found = link_segments(returns, search_for())
    np.testing.assert_array_equal(found.order, np.arange(200))
    assert len(np.unique(found.stretch)) == 1
    sizes = np.bincount(found.chunk)
    assert sizes.sum() == 200
    assert sizes.max() <= CHUNK_LINES
    # Even pieces: no chunk of one line at the end.
    assert sizes.min() >= CHUNK_LINES - 4
    assert np.all(np.diff(found.chunk) >= 0)


@pytest.mark.parametrize("slope", [-0.9, 0.0, 0.9])
def test_a_missing_line_does_not_part_a_stripe_and_a_wide_gap_does(slope: float) -> None:
    line, position = straight(10, 109, 150.0, slope)
    one_missing = line != 60
    found = link_segments(returns_at((line[one_missing], position[one_missing])), search_for())
    assert len(found.order) == 99
    assert len(np.unique(found.stretch)) == 1
    # One segment of 99 in even pieces, not two of 50 and 49.
    assert len(np.unique(found.chunk)) == -(-99 // CHUNK_LINES)
    wide = (line < 55) | (line > 75)
    found = link_segments(returns_at((line[wide], position[wide])), search_for())
    assert members(found, found.stretch) == [set(range(45)), set(range(45, 79))]


def test_a_jump_across_the_line_parts_a_stripe() -> None:
    # A box before a wall: the stripe goes on elsewhere.
    found = link_segments(
        returns_at(straight(10, 69, 100.0), straight(70, 129, 160.0)), search_for()
    )
    assert members(found, found.stretch) == [set(range(60)), set(range(60, 120))]
    chunk_of_last, chunk_of_first = found.chunk[59], found.chunk[60]
    assert chunk_of_first != chunk_of_last


def test_two_strands_that_meet_at_a_knot_are_one_stretch_but_not_one_chunk() -> None:
    # Ten lines each; the second goes on three lines after the first's end, three pixels beside.
    found = link_segments(
        returns_at(straight(10, 19, 100.0), straight(23, 32, 103.0)), search_for()
    )
    assert len(np.unique(found.stretch)) == 1
    assert len(np.unique(found.chunk)) == 2
    apart = link_segments(
        returns_at(straight(10, 19, 100.0), straight(30, 39, 103.0)), search_for()
    )
    assert len(np.unique(apart.stretch)) == 2


def test_meeting_is_transitive() -> None:
    dashes = [straight(10 + 13 * k, 19 + 13 * k, 100.0 + 3.0 * k) for k in range(6)]
    found = link_segments(returns_at(*dashes), search_for())
    assert len(found.order) == 60
    assert len(np.unique(found.stretch)) == 1


@pytest.mark.parametrize("slope", [0.4, 0.8])
def test_crossing_stripes_keep_their_direction(slope: float) -> None:
    a = straight(100, 199, 100.0, slope)
    b = straight(100, 199, 100.0 + 99.0 * slope + 0.7, -slope)
    returns = returns_at(a, b)
    found = link_segments(returns, search_for())
    assert len(np.unique(found.order)) == len(found.order) == 200
    on_a = np.abs(returns.position - (100.0 + slope * (returns.line - 100))) < 1e-9
    # Before the crossing and after it each follows its own line.
    for chunk in np.unique(found.chunk):
        rows = found.order[found.chunk == chunk]
        far = np.abs(returns.line[rows] - 149.5) > 6
        if far.all():
            share = on_a[rows].mean()
            assert share in {0.0, 1.0}


def test_a_long_segment_in_a_wrong_direction_is_dropped_and_a_dash_is_kept() -> None:
    narrow = search_for(slopes=(-0.1, 0.1))
    right, wrong = straight(10, 89, 50.0, 0.05), straight(10, 89, 150.0, 0.9)
    dash = straight(200, 211, 150.0, 0.9)
    returns = returns_at(right, wrong, dash)
    found = link_segments(returns, narrow)
    kept = returns.position[found.order]
    assert np.count_nonzero(kept < 60.0) == 80
    np.testing.assert_allclose(np.sort(kept[kept > 60.0]), dash[1])
    # Where a laser may run so, the same stripe stays.
    assert len(link_segments(returns, search_for()).order) == len(returns)


def test_a_dash_is_one_chunk() -> None:
    found = link_segments(returns_at(straight(10, 29, 50.0)), search_for())
    assert len(found.order) == 20
    assert len(np.unique(found.chunk)) == 1


def test_what_lies_outside_the_band_is_left_out() -> None:
    returns = returns_at(straight(10, 89, 50.0), straight(10, 89, 150.0), straight(10, 89, 250.0))
    found = link_segments(returns, search_for(band=(100, 200)))
    np.testing.assert_array_equal(returns.position[found.order], np.full(80, 150.0))


def test_no_returns() -> None:
    nothing = returns_at((np.empty(0, np.int64), np.empty(0)))
    found = link_segments(nothing, search_for())
    assert len(found.order) == len(found.stretch) == len(found.chunk) == 0


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(0, 400), smooth=st.booleans())
def test_every_return_is_used_at_most_once_and_groups_are_unbroken(
    seed: int, n: int, smooth: bool
) -> None:
    rng = np.random.default_rng(seed)
    line = rng.integers(0, N_LINES, n)
    position = rng.uniform(0.0, LENGTH - 1.0, n)
    if smooth:
        position = 150.0 + rng.normal(0.0, 1.5, n)
    returns = returns_at((line, position))
    found = link_segments(returns, search_for(slopes=(-5.0, 5.0)))
    assert len(np.unique(found.order)) == len(found.order)
    assert np.all(np.diff(found.chunk) >= 0)
    for chunk in np.unique(found.chunk):
        rows = found.order[found.chunk == chunk]
        # Along the segment, one return a line, in one stretch.
        assert np.all(np.diff(returns.line[rows]) > 0)
        assert len(np.unique(found.stretch[found.chunk == chunk])) == 1
