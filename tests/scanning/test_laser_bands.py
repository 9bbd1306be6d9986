"""Bands and slope bounds hold what a laser can show within the working range."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Laser, Rig
from aqualvs.optics.sheet import sheets_of
from aqualvs.scanning.laser_bands import SLOPE_CELL, LaserBand, SearchAxis, plan_bands
from aqualvs.simulation.lasers import default_sources
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig
from windowed_cases import windowed

RIGS = [example_rig, bluerov2_rig]
N_TARGETS = 60


def random_targets(rig: Rig, rng: np.random.Generator) -> list[Plane]:
    """Planes over the whole working range, tilted up to 40 degrees about any axis across y."""
    targets = []
    for _ in range(N_TARGETS):
        tilt, about = np.deg2rad(rng.uniform(0.0, 40.0)), rng.uniform(0.0, 2.0 * np.pi)
        normal = np.array(
            [np.sin(tilt) * np.cos(about), np.cos(tilt), np.sin(tilt) * np.sin(about)]
        )
        targets.append(Plane(normal, float(rng.uniform(*rig.working_range))))
    return targets


def stripe_pixels(rig: Rig, laser: Plane, target: Plane) -> FloatArray:
    """Exact projections (N, 2) of the line where sheet and target meet, inside the picture."""
    along = np.cross(laser.normal, target.normal)
    point = np.linalg.solve(
        np.array([laser.normal, target.normal, along]), [laser.offset, target.offset, 0.0]
    )
    steps = np.linspace(-1.5, 1.5, 6001)[:, None]
    points = point + steps * along / np.linalg.norm(along)
    camera = rig.camera()
    pixels, valid = camera.project(points)
    # Off the axis a tilted target goes on far beyond its range; bands reach half as far again.
    near = np.linalg.norm(points, axis=1) <= 1.5 * rig.working_range[1]
    return pixels[valid & near & camera.inside_image(pixels)]


def across_and_line(search: LaserBand, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Position along the search line, and the number of the line, with fractions."""
    x, y = pixels.T
    position, across = (x, y) if search.axis is SearchAxis.ALONG_X else (y, x)
    return position, (across - 0.5 * (search.line_px - 1)) / search.line_px


def in_band(search: LaserBand, position: FloatArray, line: FloatArray) -> BoolArray:
    nearest: IntArray = np.rint(line).astype(np.int64).clip(0, len(search.lowest) - 1)
    inside: BoolArray = (position >= search.lowest[nearest]) & (position <= search.highest[nearest])
    return inside


@pytest.mark.parametrize("make_rig", RIGS)
def test_bands_hold_every_stripe_within_the_working_range(make_rig: Callable[[], Rig]) -> None:
    rig = make_rig()
    laser_bands = plan_bands(rig, rig.camera())
    seen = np.zeros(len(laser_bands), np.int64)
    for target in random_targets(rig, np.random.default_rng(1)):
        for i, search in enumerate(laser_bands):
            pixels = stripe_pixels(rig, rig.lasers[i].plane, target)
            position, line = across_and_line(search, pixels)
            # Half a pixel beyond the first and last pixel's centre is still the picture.
            length = rig.size_px[0] if search.axis is SearchAxis.ALONG_X else rig.size_px[1]
            inside = in_band(search, position.clip(0.0, length - 1.0), line)
            missed = pixels[~inside]
            assert len(missed) == 0, f"{rig.lasers[i].name}, {target}: {missed[:3]}"
            seen[i] += len(pixels)
    assert np.all(seen > 5000)


def bent_stripe_pixels(rig: Rig, i: int, target: Plane) -> FloatArray:
    """Exact projections (N, 2) of light through a laser's window onto a target, in the picture."""
    sheet, source = sheets_of(rig)[i], default_sources(rig)[i]
    angle = np.linspace(-0.9, 0.9, 6001)[:, None]
    side = np.cross(sheet.plane.normal, source.direction)
    rays, _ = sheet.shine(np.cos(angle) * source.direction + np.sin(angle) * side)
    points, lit = target.intersect(rays)
    camera = rig.camera()
    pixels, valid = camera.project(points)
    near_enough = np.linalg.norm(points, axis=1) <= 1.5 * rig.working_range[1]
    return pixels[lit & valid & camera.inside_image(pixels) & near_enough]


@pytest.mark.parametrize("make_rig", RIGS)
def test_bands_and_slopes_hold_bent_stripes(make_rig: Callable[[], Rig]) -> None:
    rig = windowed(make_rig())
    laser_bands = plan_bands(rig, rig.camera())
    seen = np.zeros(len(laser_bands), np.int64)
    for target in random_targets(rig, np.random.default_rng(3)):
        for i, search in enumerate(laser_bands):
            position, line = across_and_line(search, bent_stripe_pixels(rig, i, target))
            length = rig.size_px[0] if search.axis is SearchAxis.ALONG_X else rig.size_px[1]
            assert in_band(search, position.clip(0.0, length - 1.0), line).all()
            seen[i] += len(line)
            step = np.diff(line)
            usable = (np.abs(step) > 1e-6) & (np.hypot(step, np.diff(position)) < 8.0)
            slope = (np.diff(position)[usable] / step[usable]).clip(-5.0, 5.0)
            row = position[:-1][usable].astype(np.int64) // SLOPE_CELL
            column = line[:-1][usable].astype(np.int64) // SLOPE_CELL
            assert np.all(slope >= search.slope_low[row, column] - 0.15)
            assert np.all(slope <= search.slope_high[row, column] + 0.15)
    assert np.all(seen > 5000)


@pytest.mark.parametrize("make_rig", RIGS)
def test_slope_bounds_hold_the_true_slopes(make_rig: Callable[[], Rig]) -> None:
    rig = make_rig()
    laser_bands = plan_bands(rig, rig.camera())
    for target in random_targets(rig, np.random.default_rng(2)):
        for i, search in enumerate(laser_bands):
            position, line = across_and_line(
                search, stripe_pixels(rig, rig.lasers[i].plane, target)
            )
            step = np.diff(line)
            usable = (np.abs(step) > 1e-6) & (np.hypot(step, np.diff(position)) < 8.0)
            slope = np.diff(position)[usable] / step[usable]
            row = position[:-1][usable].astype(np.int64) // SLOPE_CELL
            column = line[:-1][usable].astype(np.int64) // SLOPE_CELL
            low, high = search.slope_low[row, column], search.slope_high[row, column]
            # What is steeper than 5 counts as 5; tables are per cell, stripes are curved.
            slope = slope.clip(-5.0, 5.0)
            assert np.all(slope >= low - 0.15), rig.lasers[i].name
            assert np.all(slope <= high + 0.15), rig.lasers[i].name


@pytest.mark.parametrize("make_rig", RIGS)
def test_bounds_say_something(make_rig: Callable[[], Rig]) -> None:
    """A band that is the whole picture, or a slope that may be anything, would be no use."""
    rig = make_rig()
    width, height = rig.size_px
    # The paper's lens, far off the centre of its dome, sees the lower sheet in nearly every pixel.
    for search, most in zip(plan_bands(rig, rig.camera()), (0.99, 0.85, 0.85), strict=True):
        assert search.visible
        lit_px = search.line_px * np.maximum(search.highest - search.lowest + 1, 0).sum()
        assert 0.02 < lit_px / (width * height) < most
        assert np.median(search.slope_high - search.slope_low) < 4.0


@pytest.mark.parametrize("make_rig", RIGS)
def test_search_runs_across_the_stripe(make_rig: Callable[[], Rig]) -> None:
    rig = make_rig()
    lower, left, _ = plan_bands(rig, rig.camera())
    assert lower.axis is SearchAxis.ALONG_Y
    assert left.axis is SearchAxis.ALONG_X
    width, height = rig.size_px
    for search, length, across in ((lower, height, width), (left, width, height)):
        n_lines = across // search.line_px
        assert search.lowest.shape == search.highest.shape == (n_lines,)
        rows, columns = -(-length // SLOPE_CELL), -(-n_lines // SLOPE_CELL)
        for table in (search.slope_low, search.slope_high):
            assert table.shape[0] >= rows
            assert table.shape[1] >= columns


@pytest.mark.parametrize("make_rig", RIGS)
def test_bands_stay_inside_the_picture(make_rig: Callable[[], Rig]) -> None:
    rig = make_rig()
    for search in plan_bands(rig, rig.camera()):
        length = rig.size_px[0] if search.axis is SearchAxis.ALONG_X else rig.size_px[1]
        used = search.lowest <= search.highest
        assert search.lowest[used].min() >= 0
        assert search.highest[used].max() <= length - 1


def test_a_laser_behind_the_camera_is_not_visible() -> None:
    rig = example_rig()
    behind = replace(rig, lasers=(Laser("behind", Plane.from_normal((0.0, 1.0, 0.0), -0.4)),))
    (search,) = plan_bands(behind, behind.camera())
    assert not search.visible


def test_a_narrower_working_range_gives_a_narrower_band() -> None:
    rig = example_rig()
    wide, narrow = (
        plan_bands(replace(rig, working_range=limits), rig.camera())
        for limits in ((0.3, 1.0), (0.5, 0.6))
    )
    for a, b in zip(wide, narrow, strict=True):
        used = b.lowest <= b.highest
        assert np.all(a.lowest[used] <= b.lowest[used])
        assert np.all(a.highest[used] >= b.highest[used])
        size_a, size_b = ((s.highest - s.lowest + 1).clip(0).sum() for s in (a, b))
        assert size_b < 0.9 * size_a


def test_a_picture_that_is_no_multiple_of_a_cell() -> None:
    rig = replace(example_rig(), size_px=(717, 571))
    for i, search in enumerate(plan_bands(rig, rig.camera())):
        pixels = stripe_pixels(rig, rig.lasers[i].plane, Plane(np.array([0.0, 1.0, 0.0]), 0.5))
        position, line = across_and_line(search, pixels)
        length = 717 if search.axis is SearchAxis.ALONG_X else 571
        across = 571 if search.axis is SearchAxis.ALONG_X else 717
        assert len(search.lowest) == across // search.line_px
        assert in_band(search, position.clip(0.0, length - 1.0), line).all()


def test_without_its_dome_the_camera_has_other_bands() -> None:
    rig = example_rig()
    with_dome = plan_bands(rig, rig.camera())
    without = plan_bands(rig, rig.bare_camera())
    assert any(np.any(a.lowest != b.lowest) for a, b in zip(with_dome, without, strict=True))


@pytest.mark.parametrize("field", [None, "top", "bottom"])
def test_positions_on_the_columns_of_a_field_are_two_pixels_apart(field) -> None:
    rig = example_rig()
    for search in plan_bands(rig, rig.camera(), field):
        doubled = field is not None and search.axis is SearchAxis.ALONG_Y
        assert search.position_px == (2.0 if doubled else 1.0)
