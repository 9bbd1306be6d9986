"""Readings: every return as a point of each laser that could have made it."""

import numpy as np

from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Rig
from aqualvs.scanning.candidates import Candidates, find_candidates
from aqualvs.scanning.laser_bands import SearchAxis, plan_bands
from aqualvs.scanning.observations import average_groups
from aqualvs.scanning.stripe import PULL_OF_STEP, StripePeaks
from aqualvs.scanning.triangulate import Triangulator
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig
from scanning_cases import everywhere, peaks_of, strands

WALL = Plane(np.array([0.0, 1.0, 0.0]), 0.5)
TILTED = Plane.from_normal([0.25, 1.0, -0.2], 0.55)


def read(rig: Rig, peaks: dict[SearchAxis, StripePeaks]) -> Candidates:
    camera = rig.camera()
    return find_candidates(peaks, plan_bands(rig, camera), Triangulator(rig, camera))


def test_every_return_is_read_as_the_laser_that_made_it() -> None:
    rig = example_rig()
    peaks = peaks_of(rig, [(TILTED, everywhere)])
    candidates = read(rig, peaks)
    n_peaks = sum(found.n for found in peaks.values())
    on_target = np.abs(TILTED.signed_distance(candidates.points)) < 1e-6
    # Exact positions, interpolated between projections half a pixel apart.
    assert len(np.unique(candidates.source[on_target])) == n_peaks
    assert set(candidates.laser[on_target].tolist()) == {0, 1, 2}
    # Every reading lies on the sheet of the laser it is read as.
    for i, laser in enumerate(rig.lasers):
        off = laser.plane.signed_distance(candidates.points[candidates.laser == i])
        assert np.abs(off).max() < 1e-9


def test_pixels_are_the_projections_of_the_points() -> None:
    rig = example_rig()
    candidates = read(rig, peaks_of(rig, [(WALL, strands)]))
    pixels, valid = rig.camera().project(candidates.points)
    assert valid.all()
    np.testing.assert_allclose(pixels, candidates.pixels, rtol=0.0, atol=1e-6)


def test_a_return_lies_in_the_middle_of_a_search_line_two_pixels_wide() -> None:
    rig = bluerov2_rig()
    laser_bands = plan_bands(rig, rig.camera())
    assert {search.line_px for search in laser_bands} == {2}
    line = np.arange(200, 240)
    plain = {
        axis: StripePeaks(line, np.full(40, 640.25), *(np.full(40, 50.0) for _ in range(4)))
        for axis in SearchAxis
    }
    candidates = read(rig, plain)
    upright = np.isin(
        candidates.laser, [i for i, s in enumerate(laser_bands) if s.axis.value == "x"]
    )
    assert upright.any()
    assert (~upright).any()
    for mine, across, along in ((upright, 1, 0), (~upright, 0, 1)):
        np.testing.assert_array_equal(
            candidates.pixels[mine, across], 2.0 * candidates.line[mine] + 0.5
        )
        np.testing.assert_array_equal(candidates.pixels[mine, along], 640.25)


def test_sources_tell_returns_of_both_searches_apart() -> None:
    rig = example_rig()
    peaks = peaks_of(rig, [(WALL, everywhere)])
    candidates = read(rig, peaks)
    # Readings of one return share its pixel.
    for source in np.unique(candidates.source)[::25]:
        same = candidates.pixels[candidates.source == source]
        assert np.ptp(same, axis=0).max() == 0.0
    assert len(np.unique(candidates.source)) <= sum(found.n for found in peaks.values())


def test_groups_of_different_lasers_differ_and_chunks_ascend() -> None:
    rig = example_rig()
    candidates = read(rig, peaks_of(rig, [(WALL, strands)]))
    assert np.all(np.diff(candidates.laser) >= 0)
    assert np.all(np.diff(candidates.subsegment) >= 0)
    for group in (candidates.subsegment, candidates.component):
        laser_of = [len(np.unique(candidates.laser[group == k])) for k in np.unique(group)]
        assert set(laser_of) == {1}


def test_sigma_grows_with_width_over_height() -> None:
    rig = example_rig()
    plain = peaks_of(rig, [(WALL, everywhere)])
    faint = {
        axis: StripePeaks(
            found.line,
            found.position,
            found.height / 4.0,
            found.width,
            found.likelihood,
            found.pull,
        )
        for axis, found in plain.items()
    }
    one, other = read(rig, plain), read(rig, faint)
    # Flanks of 5 px and 80 grey levels: 0.45 * 3 * 5 / 80 px by noise of 3 grey levels, and a
    # floor of a tenth of a pixel that no brightness removes.
    assert np.all((one.sigma_px > 0.1) & (one.sigma_px < 0.2))
    assert np.all((other.sigma_px > 0.3) & (other.sigma_px < 0.5))


def test_chunks_are_centroids_and_their_errors_shrink() -> None:
    rig = example_rig()
    candidates = read(rig, peaks_of(rig, [(WALL, strands)], noise_px=0.1))
    subsegments = candidates.linked().subsegments
    index = subsegments.of_candidate
    assert index.shape == (candidates.n,)
    assert np.all(np.diff(index) >= 0)
    n = int(index[-1]) + 1
    assert subsegments.n == n == len(np.unique(candidates.subsegment))
    np.testing.assert_array_equal(subsegments.n_lines, np.bincount(index))
    for c in range(0, n, 7):
        mine = index == c
        assert subsegments.laser[c] == candidates.laser[mine][0]
        assert subsegments.first_line[c] == candidates.line[mine].min()
        assert subsegments.last_line[c] == candidates.line[mine].max()


def test_observations_are_weighed_by_light() -> None:
    rig = example_rig()
    candidates = read(rig, peaks_of(rig, [(WALL, everywhere)]))
    mine = candidates.where(candidates.component == candidates.component[0])
    light = np.linspace(10.0, 100.0, mine.n)
    shaded = mine._replace(height=light)
    index = np.zeros(mine.n, np.int64)
    seen = average_groups(shaded, index, 1, WALL.normal, False)
    weight = light * mine.width
    expected = np.average(mine.points, axis=0, weights=weight)
    np.testing.assert_allclose(seen.points[0], expected, atol=1e-12)
    expected = np.average(mine.sensitivity, axis=0, weights=weight)
    np.testing.assert_allclose(seen.sensitivity[0], expected, atol=1e-12)
    assert seen.laser[0] == mine.laser[0]
    # Many returns are better than one, but neighbours share errors.
    assert 0.05 < seen.sigma_px[0] < mine.sigma_px.min()


def test_dim_ends_of_a_strand_do_not_count() -> None:
    candidates = read(example_rig(), peaks_of(example_rig(), [(WALL, everywhere)]))
    strand = candidates.where(candidates.component == candidates.component[0])
    light = np.full(strand.n, 100.0)
    light[: strand.n // 2] = 39.0
    index = np.zeros(strand.n, np.int64)
    seen = average_groups(strand._replace(height=light), index, 1, WALL.normal, True)
    bright = light == 100.0
    expected = np.average(strand.points[bright], axis=0, weights=strand.width[bright])
    np.testing.assert_allclose(seen.points[0], expected, atol=1e-12)


def test_glow_that_ends_at_the_strands_of_a_laser_is_taken_off_all_of_them() -> None:
    """All of the difference between flanks is measured at one of two strands."""
    found = read(example_rig(), peaks_of(example_rig(), [(WALL, everywhere)]))
    found = found.where(found.laser == found.laser[0])
    strand = np.arange(found.n) * 2 // found.n
    dark = found._replace(height=np.full(found.n, 100.0), width=np.full(found.n, 5.0))
    lit = dark._replace(pull=np.where(strand == 0, 0.02, 0.0))
    clear, moved = (average_groups(one, strand, 2, WALL.normal, True) for one in (dark, lit))
    alone = average_groups(lit, np.where(strand == 0, 0, -1), 1, WALL.normal, True)
    glow = float(alone.glow[0]) * np.mean(strand == 0)
    np.testing.assert_allclose(moved.glow, [glow, glow], rtol=1e-12)
    assert glow > 0.0
    expected = clear.points - PULL_OF_STEP * 5.0 * glow * clear.sensitivity
    np.testing.assert_allclose(moved.points, expected, atol=1e-12)


def test_nothing_in_nothing_out() -> None:
    rig = example_rig()
    nothing = {
        axis: StripePeaks(np.empty(0, np.int64), *(np.empty(0) for _ in range(5)))
        for axis in SearchAxis
    }
    candidates = read(rig, nothing)
    assert candidates.n == 0
    subsegments = candidates.linked().subsegments
    index = subsegments.of_candidate
    assert subsegments.n == len(index) == 0


def test_where_keeps_the_columns_together() -> None:
    rig = example_rig()
    candidates = read(rig, peaks_of(rig, [(WALL, strands)]))
    mask = candidates.laser == 1
    some = candidates.where(mask)
    assert some.n == np.count_nonzero(mask)
    np.testing.assert_array_equal(some.points, candidates.points[mask])
    np.testing.assert_array_equal(some.source, candidates.source[mask])
