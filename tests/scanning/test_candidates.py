"""Readings: every return as a point of each laser that could have made it."""

from dataclasses import replace

import numpy as np

from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Rig
from aqualvs.scanning.candidates import Readings, read_returns
from aqualvs.scanning.laser_bands import SearchAxis, plan_searches
from aqualvs.scanning.stripe import Returns
from aqualvs.scanning.triangulate import Triangulator
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig
from scanning_cases import everywhere, returns_of, strands

WALL = Plane(np.array([0.0, 1.0, 0.0]), 0.5)
TILTED = Plane.from_normal([0.25, 1.0, -0.2], 0.55)


def read(rig: Rig, returns: dict[SearchAxis, Returns]) -> Readings:
    camera = rig.camera()
    return read_returns(returns, plan_searches(rig, camera), Triangulator(rig, camera))


def test_every_return_is_read_as_the_laser_that_made_it() -> None:
    rig = example_rig()
    returns = returns_of(rig, [(TILTED, everywhere)])
    readings = read(rig, returns)
    n_returns = sum(len(found) for found in returns.values())
    on_target = np.abs(TILTED.signed_distance(readings.points)) < 1e-6
    # Exact positions, interpolated between projections half a pixel apart.
    assert len(np.unique(readings.source[on_target])) == n_returns
    assert set(readings.laser[on_target].tolist()) == {0, 1, 2}
    # Every reading lies on the sheet of the laser it is read as.
    for i, laser in enumerate(rig.lasers):
        off = laser.plane.signed_distance(readings.points[readings.laser == i])
        assert np.abs(off).max() < 1e-9


def test_pixels_are_the_projections_of_the_points() -> None:
    rig = example_rig()
    readings = read(rig, returns_of(rig, [(WALL, strands)]))
    pixels, valid = rig.camera().project(readings.points)
    assert valid.all()
    np.testing.assert_allclose(pixels, readings.pixels, rtol=0.0, atol=1e-6)


def test_a_return_lies_in_the_middle_of_a_search_line_two_pixels_wide() -> None:
    rig = bluerov2_rig()
    searches = plan_searches(rig, rig.camera())
    assert {search.line_px for search in searches} == {2}
    line = np.arange(200, 240)
    plain = {
        axis: Returns(line, np.full(40, 640.25), *(np.full(40, 50.0) for _ in range(3)))
        for axis in SearchAxis
    }
    readings = read(rig, plain)
    upright = np.isin(readings.laser, [i for i, s in enumerate(searches) if s.axis.value == "x"])
    assert upright.any()
    assert (~upright).any()
    for mine, across, along in ((upright, 1, 0), (~upright, 0, 1)):
        np.testing.assert_array_equal(
            readings.pixels[mine, across], 2.0 * readings.line[mine] + 0.5
        )
        np.testing.assert_array_equal(readings.pixels[mine, along], 640.25)


def test_sources_tell_returns_of_both_searches_apart() -> None:
    rig = example_rig()
    returns = returns_of(rig, [(WALL, everywhere)])
    readings = read(rig, returns)
    # Readings of one return share its pixel.
    for source in np.unique(readings.source)[::25]:
        same = readings.pixels[readings.source == source]
        assert np.ptp(same, axis=0).max() == 0.0
    assert len(np.unique(readings.source)) <= sum(len(found) for found in returns.values())


def test_groups_of_different_lasers_differ_and_chunks_ascend() -> None:
    rig = example_rig()
    readings = read(rig, returns_of(rig, [(WALL, strands)]))
    assert np.all(np.diff(readings.laser) >= 0)
    assert np.all(np.diff(readings.chunk) >= 0)
    for group in (readings.chunk, readings.stretch):
        laser_of = [len(np.unique(readings.laser[group == k])) for k in np.unique(group)]
        assert set(laser_of) == {1}


def test_sigma_grows_with_width_over_height() -> None:
    rig = example_rig()
    plain = returns_of(rig, [(WALL, everywhere)])
    faint = {
        axis: Returns(found.line, found.position, found.height / 4.0, found.width, found.likelihood)
        for axis, found in plain.items()
    }
    one, other = read(rig, plain), read(rig, faint)
    # Flanks of 5 px and 80 grey levels: 0.45 * 3 * 5 / 80 px by noise of 3 grey levels, and a
    # floor of a tenth of a pixel that no brightness removes.
    assert np.all((one.sigma_px > 0.1) & (one.sigma_px < 0.2))
    assert np.all((other.sigma_px > 0.3) & (other.sigma_px < 0.5))


def test_chunks_are_centroids_and_their_errors_shrink() -> None:
    rig = example_rig()
    readings = read(rig, returns_of(rig, [(WALL, strands)], noise_px=0.1))
    chunks, index = readings.chunks()
    assert index.shape == (len(readings),)
    assert np.all(np.diff(index) >= 0)
    n = int(index[-1]) + 1
    assert len(chunks) == n == len(np.unique(readings.chunk))
    np.testing.assert_array_equal(chunks.n_lines, np.bincount(index))
    for c in range(0, n, 7):
        mine = index == c
        assert chunks.laser[c] == readings.laser[mine][0]
        assert chunks.first_line[c] == readings.line[mine].min()
        assert chunks.last_line[c] == readings.line[mine].max()


def test_observations_are_weighed_by_light() -> None:
    rig = example_rig()
    readings = read(rig, returns_of(rig, [(WALL, everywhere)]))
    mine = readings.where(readings.stretch == readings.stretch[0])
    light = np.linspace(10.0, 100.0, len(mine))
    shaded = replace(mine, height=light)
    index = np.zeros(len(mine), np.int64)
    seen = shaded.observations(index, 1, WALL.normal)
    weight = light * mine.width
    expected = np.average(mine.points, axis=0, weights=weight)
    np.testing.assert_allclose(seen.points[0], expected, atol=1e-12)
    expected = np.average(mine.sensitivity, axis=0, weights=weight)
    np.testing.assert_allclose(seen.sensitivity[0], expected, atol=1e-12)
    assert seen.laser[0] == mine.laser[0]
    # Many returns are better than one, but neighbours share errors.
    assert 0.05 < seen.sigma_px[0] < mine.sigma_px.min()


def test_nothing_in_nothing_out() -> None:
    rig = example_rig()
    nothing = {
        axis: Returns(np.empty(0, np.int64), *(np.empty(0) for _ in range(4)))
        for axis in SearchAxis
    }
    readings = read(rig, nothing)
    assert len(readings) == 0
    chunks, index = readings.chunks()
    assert len(chunks) == len(index) == 0


def test_where_keeps_the_columns_together() -> None:
    rig = example_rig()
    readings = read(rig, returns_of(rig, [(WALL, strands)]))
    mask = readings.laser == 1
    some = readings.where(mask)
    assert len(some) == np.count_nonzero(mask)
    np.testing.assert_array_equal(some.points, readings.points[mask])
    np.testing.assert_array_equal(some.source, readings.source[mask])
