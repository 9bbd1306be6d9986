"""Triangulation: exact where the projection is exact, sensitive as the camera says."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import Laser, Rig
from aqualvs.optics.sheet import sheets_of
from aqualvs.scanning.triangulate import Triangulation, Triangulator
from aqualvs.simulation.lasers import default_sources
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig
from windowed_cases import windowed

RIGS = [example_rig, bluerov2_rig]


def random_sheet_points(rig: Rig, camera: Camera, n: int = 4000) -> tuple[FloatArray, IntArray]:
    """Points anywhere on the laser sheets that the camera sees, and their lasers."""
    rng = np.random.default_rng(3)
    laser = rng.integers(0, len(rig.lasers), n)
    normals = np.array([one.plane.normal for one in rig.lasers])[laser]
    offsets = np.array([one.plane.offset for one in rig.lasers])[laser]
    points = rng.uniform([-0.5, 0.2, -0.4], [0.5, 1.3, 0.4], (n, 3))
    points -= (np.sum(normals * points, axis=1) - offsets)[:, None] * normals
    pixels, valid = camera.project(points)
    seen = valid & camera.inside_image(pixels) & (points[:, 1] > 0.15)
    return points[seen], laser[seen]


def triangulate(
    rig: Rig, camera: Camera, pixels: FloatArray, along_x: BoolArray, laser: IntArray
) -> Triangulation:
    return Triangulator(rig, camera).triangulate(pixels, along_x, laser)


@pytest.mark.parametrize("make_rig", RIGS)
@pytest.mark.parametrize("bare", [False, True])
def test_exact_projections_give_their_points_back(make_rig: Callable[[], Rig], bare: bool) -> None:
    rig = make_rig()
    camera = rig.bare_camera() if bare else rig.camera()
    points, laser = random_sheet_points(rig, camera)
    assert len(points) > 500
    assert len(np.unique(laser)) == 3
    pixels, _ = camera.project(points)
    found = triangulate(rig, camera, pixels, laser == 1, laser)
    # A ray within 5 degrees of a sheet magnifies rounding; others are exact.
    rays = camera.rays(pixels)
    normals = np.array([one.plane.normal for one in rig.lasers])[laser]
    steep = np.abs(np.sum(rays.directions * normals, axis=1)) > np.sin(np.deg2rad(5.0))
    assert steep.mean() > 0.8
    assert found.valid[steep].all()
    np.testing.assert_allclose(found.points_in_dome[steep], points[steep], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("make_rig", RIGS)
@pytest.mark.parametrize("axis", [0, 1])
def test_sensitivity_against_central_differences(make_rig: Callable[[], Rig], axis: int) -> None:
    rig = make_rig()
    camera = rig.camera()
    points, laser = random_sheet_points(rig, camera)
    # Position along x says nothing about a level sheet, nor y about an upright one.
    useful = laser != (0 if axis == 0 else 1)
    points, laser = points[useful], laser[useful]
    pixels, _ = camera.project(points)
    along_x = np.full(len(points), axis == 0)
    found = triangulate(rig, camera, pixels, along_x, laser)
    step = 1e-3 * np.eye(2)[axis]
    after = triangulate(rig, camera, pixels + step, along_x, laser).points_in_dome
    before = triangulate(rig, camera, pixels - step, along_x, laser).points_in_dome
    expected = (after - before) / 2e-3
    size = np.linalg.norm(expected, axis=1)
    ordinary = (size < 5e-3) & (points[:, 1] > 0.25)
    assert np.count_nonzero(ordinary) > 200
    error = np.linalg.norm(found.sensitivity - expected, axis=1)[ordinary] / size[ordinary]
    # The one-sided step of a quarter pixel costs about 1 % far out, where a pixel is 5 mm.
    assert error.max() < 0.02
    assert np.median(error) < 0.002


def test_the_sensitivity_stays_on_the_sheet() -> None:
    rig = example_rig()
    points, laser = random_sheet_points(rig, rig.camera())
    pixels, _ = rig.camera().project(points)
    found = triangulate(rig, rig.camera(), pixels, np.zeros(len(pixels), np.bool_), laser)
    normals = np.array([one.plane.normal for one in rig.lasers])[laser]
    off = np.abs(np.sum(found.sensitivity * normals, axis=1))[found.valid]
    along = np.linalg.norm(found.sensitivity, axis=1)[found.valid]
    assert np.all(off < 1e-9 * np.maximum(along, 1.0))


def bent_sheet_points(rig: Rig, camera: Camera, n: int = 3000) -> tuple[FloatArray, IntArray]:
    """Points on the rig's bent sheets that the camera sees, and their lasers, stripe by stripe."""
    rng = np.random.default_rng(5)
    parts = []
    for sheet, source in zip(sheets_of(rig), default_sources(rig), strict=True):
        angle = np.sort(rng.uniform(-0.5, 0.5, n))[:, None]
        side = np.cross(sheet.plane.normal, source.direction)
        rays, _ = sheet.shine(np.cos(angle) * source.direction + np.sin(angle) * side)
        points = rays.points_at(0.6 + 0.1 * np.sin(9.0 * angle[:, 0]))
        pixels, valid = camera.project(points)
        parts.append(points[valid & camera.inside_image(pixels)])
    laser = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    return np.concatenate(parts), laser


@pytest.mark.parametrize("make_rig", RIGS)
@pytest.mark.parametrize("grouped", [False, True])
def test_bent_sheets(make_rig: Callable[[], Rig], grouped: bool) -> None:
    rig = windowed(make_rig())
    camera = rig.camera()
    points, laser = bent_sheet_points(rig, camera)
    assert np.all(np.bincount(laser) > 500)
    pixels, _ = camera.project(points)
    along_x = (laser == 1).astype(np.int64)
    group = 1000 * laser + np.arange(len(laser)) // 16 if grouped else None
    triangulator = Triangulator(rig, camera)
    found = triangulator.triangulate(pixels, along_x, laser, group)
    assert found.valid.all()
    np.testing.assert_allclose(found.points_in_dome, points, rtol=0.0, atol=1e-9)
    step = 1e-3 * np.stack([along_x, 1 - along_x], axis=-1)
    after = triangulator.triangulate(pixels + step, along_x, laser).points_in_dome
    before = triangulator.triangulate(pixels - step, along_x, laser).points_in_dome
    expected = (after - before) / 2e-3
    size = np.linalg.norm(expected, axis=1)
    error = np.linalg.norm(found.sensitivity - expected, axis=1)[size < 5e-3]
    # One-sided differences of a quarter of a pixel; neighbours share that of the first.
    assert np.median(error / size[size < 5e-3]) < 0.01
    assert np.max(error / size[size < 5e-3]) < 0.05


def test_windows_of_some_lasers_leave_the_others_alone() -> None:
    plain = example_rig()
    bent = windowed(plain)
    mixed = replace(plain, lasers=(plain.lasers[0], bent.lasers[1], plain.lasers[2]))
    camera = plain.camera()
    pixels = np.random.default_rng(0).uniform([0, 0], plain.size_px, (900, 2))
    laser, along_x = np.repeat([0, 1, 2], 300), np.zeros(900, np.int64)
    found, planes, windows = (
        Triangulator(rig, camera).triangulate(pixels, along_x, laser)
        for rig in (mixed, plain, bent)
    )
    mine = laser == 1
    for one, other in ((found, planes), (found, windows)):
        same = mine if other is windows else ~mine
        np.testing.assert_array_equal(one.points_in_dome[same], other.points_in_dome[same])
        np.testing.assert_array_equal(one.sensitivity[same], other.sensitivity[same])
        np.testing.assert_array_equal(one.valid[same], other.valid[same])
    assert not found.valid.all()
    assert found.valid[mine].sum() > 50


def test_rays_that_miss_the_sheet_are_not_valid() -> None:
    lasers = (
        Laser("behind", Plane.from_normal((0.0, 1.0, 0.0), -0.4)),
        Laser("ahead", Plane.from_normal((0.0, 1.0, 0.0), 0.4)),
    )
    rig = replace(example_rig(), lasers=lasers)
    pixels = np.full((2, 2), 300.0)
    found = triangulate(rig, rig.camera(), pixels, np.zeros(2, np.bool_), np.array([0, 1]))
    np.testing.assert_array_equal(found.valid, [False, True])
    assert np.isnan(found.points_in_dome[0]).all()
    assert np.isnan(found.sensitivity[0]).all()
    assert np.isfinite(found.points_in_dome[1]).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_pixels_that_are_no_numbers_are_not_valid(bad: float) -> None:
    rig = example_rig()
    pixels = np.array([[bad, 400.0], [360.0, bad], [360.0, 400.0]])
    found = triangulate(
        rig, rig.camera(), pixels, np.zeros(3, np.bool_), np.zeros(3, dtype=np.int64)
    )
    np.testing.assert_array_equal(found.valid, [False, False, True])


def test_no_pixels_give_no_points() -> None:
    rig = example_rig()
    found = triangulate(
        rig, rig.camera(), np.empty((0, 2)), np.empty(0, np.bool_), np.empty(0, np.int64)
    )
    assert found.points_in_dome.shape == found.sensitivity.shape == (0, 3)
    assert found.valid.shape == (0,)


def test_the_pixels_given_are_left_alone() -> None:
    rig = example_rig()
    pixels = np.array([[360.0, 400.0], [300.0, 410.0]])
    before = pixels.copy()
    triangulate(rig, rig.camera(), pixels, np.array([True, False]), np.zeros(2, np.int64))
    np.testing.assert_array_equal(pixels, before)
