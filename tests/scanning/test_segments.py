"""Segments: what follows on what, what cannot be this laser, and what belongs to one strand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.scanning.laser_bands import LaserBand, SearchAxis
from aqualvs.scanning.segments import SUBSEGMENT_LINES, Segments, link_segments
from aqualvs.scanning.stripe import StripePeaks

N_LINES, LENGTH = 400, 300


def search_for(
    slopes: tuple[float, float] = (-1.0, 1.0),
    band: tuple[int, int] = (0, LENGTH - 1),
    line_px: int = 1,
) -> LaserBand:
    cells = np.ones((-(-LENGTH // 8), -(-N_LINES // 8)))
    return LaserBand(
        axis=SearchAxis.ALONG_Y,
        line_px=line_px,
        lowest=np.full(N_LINES, band[0]),
        highest=np.full(N_LINES, band[1]),
        slope_low=slopes[0] * cells,
        slope_high=slopes[1] * cells,
    )


def peaks_at(*stripes: tuple[IntArray, FloatArray]) -> StripePeaks:
    """Returns on stripes given as (line, position), in the order that detectors keep."""
    line = np.concatenate([line for line, _ in stripes])
    position = np.concatenate([position for _, position in stripes])
    order = np.lexsort((position, line))
    n = len(line)
    return StripePeaks(
        line=line[order],
        position=position[order],
        height=np.full(n, 80.0),
        width=np.full(n, 5.0),
        likelihood=np.full(n, 20.0),
        pull=np.zeros(n),
    )


def straight(first: int, last: int, at: float, slope: float = 0.0) -> tuple[IntArray, FloatArray]:
    line = np.arange(first, last + 1)
    return line, at + slope * (line - first)


def members(segments: Segments, of: IntArray) -> list[set[int]]:
    """Sets of returns that share a number."""
    return [set(segments.order[of == k].tolist()) for k in np.unique(of)]


def test_a_wall_s_stripe_is_one_stretch_in_small_chunks() -> None:
    peaks = peaks_at(straight(20, 219, 100.0, 0.3))
    found = link_segments(peaks, search_for())
    np.testing.assert_array_equal(found.order, np.arange(200))
    assert len(np.unique(found.component)) == 1
    sizes = np.bincount(found.subsegment)
    assert sizes.sum() == 200
    assert sizes.max() <= SUBSEGMENT_LINES
    # Even pieces: no chunk of one line at the end.
    assert sizes.min() >= SUBSEGMENT_LINES - 4
    assert np.all(np.diff(found.subsegment) >= 0)


@pytest.mark.parametrize("slope", [-0.9, 0.0, 0.9])
def test_a_missing_line_does_not_part_a_stripe_and_a_wide_gap_does(slope: float) -> None:
    line, position = straight(10, 109, 150.0, slope)
    one_missing = line != 60
    found = link_segments(peaks_at((line[one_missing], position[one_missing])), search_for())
    assert len(found.order) == 99
    assert len(np.unique(found.component)) == 1
    # One segment of 99 in even pieces, not two of 50 and 49.
    assert len(np.unique(found.subsegment)) == -(-99 // SUBSEGMENT_LINES)
    wide = (line < 55) | (line > 75)
    found = link_segments(peaks_at((line[wide], position[wide])), search_for())
    assert members(found, found.component) == [set(range(45)), set(range(45, 79))]


def test_a_jump_across_the_line_parts_a_stripe() -> None:
    # A box before a wall: the stripe goes on elsewhere.
    found = link_segments(peaks_at(straight(10, 69, 100.0), straight(70, 129, 160.0)), search_for())
    assert members(found, found.component) == [set(range(60)), set(range(60, 120))]
    subsegment_of_last, subsegment_of_first = found.subsegment[59], found.subsegment[60]
    assert subsegment_of_first != subsegment_of_last


def test_two_strands_that_meet_at_a_knot_are_one_stretch_but_not_one_chunk() -> None:
    # Ten lines each; the second goes on three lines after the first's end, three pixels beside.
    found = link_segments(peaks_at(straight(10, 19, 100.0), straight(23, 32, 103.0)), search_for())
    assert len(np.unique(found.component)) == 1
    assert len(np.unique(found.subsegment)) == 2
    apart = link_segments(peaks_at(straight(10, 19, 100.0), straight(30, 39, 103.0)), search_for())
    assert len(np.unique(apart.component)) == 2


def test_meeting_is_transitive() -> None:
    dashes = [straight(10 + 13 * k, 19 + 13 * k, 100.0 + 3.0 * k) for k in range(6)]
    found = link_segments(peaks_at(*dashes), search_for())
    assert len(found.order) == 60
    assert len(np.unique(found.component)) == 1


@pytest.mark.parametrize("slope", [0.4, 0.8])
def test_crossing_stripes_keep_their_direction(slope: float) -> None:
    a = straight(100, 199, 100.0, slope)
    b = straight(100, 199, 100.0 + 99.0 * slope + 0.7, -slope)
    peaks = peaks_at(a, b)
    found = link_segments(peaks, search_for())
    assert len(np.unique(found.order)) == len(found.order) == 200
    on_a = np.abs(peaks.position - (100.0 + slope * (peaks.line - 100))) < 1e-9
    # Before the crossing and after it each follows its own line.
    for subsegment in np.unique(found.subsegment):
        rows = found.order[found.subsegment == subsegment]
        far = np.abs(peaks.line[rows] - 149.5) > 6
        if far.all():
            share = on_a[rows].mean()
            assert share in {0.0, 1.0}


def test_a_long_segment_in_a_wrong_direction_is_dropped_and_a_dash_is_kept() -> None:
    narrow = search_for(slopes=(-0.1, 0.1))
    right, wrong = straight(10, 89, 50.0, 0.05), straight(10, 89, 150.0, 0.9)
    dash = straight(200, 211, 150.0, 0.9)
    peaks = peaks_at(right, wrong, dash)
    found = link_segments(peaks, narrow)
    kept = peaks.position[found.order]
    assert np.count_nonzero(kept < 60.0) == 80
    np.testing.assert_allclose(np.sort(kept[kept > 60.0]), dash[1])
    # Where a laser may run so, the same stripe stays.
    assert len(link_segments(peaks, search_for()).order) == peaks.n


@pytest.mark.parametrize("line_px", [1, 2])
@pytest.mark.parametrize("slope", [1.3, 1.8])
def test_a_steep_line_of_another_laser_is_dropped_on_wide_search_lines_too(
    slope: float, line_px: int
) -> None:
    peaks = peaks_at(straight(10, 79, 5.0, slope * line_px))
    assert not len(link_segments(peaks, search_for((-line_px, line_px), line_px=line_px)).order)
    as_steep = search_for((-2.0 * line_px, 2.0 * line_px), line_px=line_px)
    found = link_segments(peaks, as_steep)
    assert len(found.order) == peaks.n
    assert len(np.unique(found.subsegment)) == -(-peaks.n // SUBSEGMENT_LINES)


def test_a_dash_is_one_chunk() -> None:
    found = link_segments(peaks_at(straight(10, 29, 50.0)), search_for())
    assert len(found.order) == 20
    assert len(np.unique(found.subsegment)) == 1


def test_what_lies_outside_the_band_is_left_out() -> None:
    peaks = peaks_at(straight(10, 89, 50.0), straight(10, 89, 150.0), straight(10, 89, 250.0))
    found = link_segments(peaks, search_for(band=(100, 200)))
    np.testing.assert_array_equal(peaks.position[found.order], np.full(80, 150.0))


@pytest.mark.parametrize("line", [-1, -(10**9), N_LINES, 10**12])
def test_peaks_of_a_damaged_recording_outside_the_picture_are_left_out(line: int) -> None:
    inside, nowhere = straight(0, 9, 100.0), (np.array([5]), np.array([np.nan]))
    peaks = peaks_at(inside, (np.full(3, line), np.full(3, 100.0)), nowhere)
    kept = link_segments(peaks, search_for()).order
    assert set(peaks.line[kept]) == set(inside[0])
    assert np.isfinite(peaks.position[kept]).all()
    assert len(kept) == 10


def test_no_returns() -> None:
    nothing = peaks_at((np.empty(0, np.int64), np.empty(0)))
    found = link_segments(nothing, search_for())
    assert len(found.order) == len(found.component) == len(found.subsegment) == 0


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
    peaks = peaks_at((line, position))
    found = link_segments(peaks, search_for(slopes=(-5.0, 5.0)))
    assert len(np.unique(found.order)) == len(found.order)
    assert np.all(np.diff(found.subsegment) >= 0)
    for subsegment in np.unique(found.subsegment):
        rows = found.order[found.subsegment == subsegment]
        # Along the segment, one return a line, in one stretch.
        assert np.all(np.diff(peaks.line[rows]) > 0)
        assert len(np.unique(found.component[found.subsegment == subsegment])) == 1
