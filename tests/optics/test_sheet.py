"""Bent sheets: where light from the source goes, and every derivative of it."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane, Rays
from aqualvs.optics.rig import Laser, Window, moved_plane, tangent_basis
from aqualvs.optics.sheet import COLUMNS, START, Sheet, packed_sheets, sheet_in, sheets_of
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig
from optics_cases import central_difference
from windowed_cases import windowed

N_WATER = 1.3333
SEEDS = range(12)


def random_sheet(seed: int, n_water: float = N_WATER) -> tuple[Sheet, FloatArray]:
    """A sheet anywhere, behind a window tilted up to 30 degrees both ways, and its fan (40, 3)."""
    rng = np.random.default_rng(seed)
    plane = Plane.from_normal(rng.normal(size=3), 0.1 * rng.normal())
    along = rng.normal(size=2) @ tangent_basis(plane.normal)
    along /= np.linalg.norm(along)
    side = np.cross(plane.normal, along)
    across, slant = np.tan(np.deg2rad(rng.uniform(-30.0, 30.0, 2)))
    face = along + across * plane.normal + slant * side
    face /= np.linalg.norm(face)
    source = plane.normal * plane.offset + rng.uniform(-0.1, 0.1, 2) @ tangent_basis(plane.normal)
    offset = float(face @ source) + rng.uniform(0.005, 0.05)
    # The face's normal may point either way.
    sign = rng.choice([-1.0, 1.0])
    window = Window(Plane(sign * face, sign * offset), source)
    angle = rng.uniform(-0.6, 0.6, 40)[:, None]
    fan = np.cos(angle) * along + np.sin(angle) * side
    return Sheet(plane=plane, window=window, n_air=1.0003, n_water=n_water), fan


def lit_points(sheet: Sheet, fan: FloatArray, seed: int = 0) -> FloatArray:
    """Points on the sheet, from light traced through the window by Snell's law in vector form."""
    rays, _ = sheet.shine(fan)
    assert rays.valid.all()
    return rays.points_at(np.random.default_rng(seed).uniform(0.2, 1.3, len(fan)))


def beside(points: FloatArray, seed: int = 0) -> FloatArray:
    return points + 0.02 * np.random.default_rng(seed).normal(size=points.shape)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("n_water", [1.0, 1.0003, N_WATER, 1.5])
def test_light_from_the_source_is_on_the_sheet(seed: int, n_water: float) -> None:
    sheet, fan = random_sheet(seed, n_water)
    # Rounding only.
    assert np.abs(sheet.signed_distance(lit_points(sheet, fan))).max() < 1e-13


@pytest.mark.parametrize("seed", SEEDS)
def test_light_aimed_off_the_plane_is_off_the_sheet_by_as_much(seed: int) -> None:
    sheet, fan = random_sheet(seed)
    turn = 1e-3
    off = np.cos(turn) * fan + np.sin(turn) * sheet.plane.normal
    points = lit_points(sheet, off)
    distance = sheet.signed_distance(points)
    # On the side of the plane's normal, and not far from 1 mrad times the way, which refraction
    # makes shorter, and slanting to the sheet a little longer.
    way = np.linalg.norm(points - sheet.source, axis=1)
    assert np.all(distance > 0.6 * turn * way)
    assert np.all(distance < 1.1 * turn * way)


@pytest.mark.parametrize("seed", SEEDS)
def test_gradient_against_central_differences(seed: int) -> None:
    sheet, fan = random_sheet(seed)
    points = beside(lit_points(sheet, fan))
    expected = central_difference(lambda p: sheet.signed_distance(p)[..., None], points, 1e-6)
    # The difference's own error: rounding of 1e-16 m over 1e-6 m, and its step squared.
    np.testing.assert_allclose(sheet.gradient(points), expected[:, 0], rtol=0.0, atol=2e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_all_derivatives_against_central_differences(seed: int) -> None:
    sheet, fan = random_sheet(seed)
    points = beside(lit_points(sheet, fan))
    distance, by_point, by_parameter = sheet.signed_distance_with_parameter_jacobian(points)
    np.testing.assert_allclose(distance, sheet.signed_distance(points), rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(by_point, sheet.gradient(points), rtol=0.0, atol=1e-14)
    expected = central_difference(
        lambda step: sheet.moved_by(step).signed_distance(points), np.zeros(9), 1e-6
    )
    assert by_parameter.shape == (40, 9)
    assert np.all(np.abs(expected).max(axis=0) > 1e-3)
    np.testing.assert_allclose(by_parameter, expected, rtol=0.0, atol=2e-8)


def test_derivatives_of_a_plane() -> None:
    sheet, fan = random_sheet(3)
    sheet = Sheet(plane=sheet.plane)
    points = beside(fan)
    distance, by_point, by_parameter = sheet.signed_distance_with_parameter_jacobian(points)
    np.testing.assert_allclose(distance, sheet.plane.signed_distance(points), rtol=0.0, atol=1e-15)
    np.testing.assert_array_equal(by_point, np.tile(sheet.plane.normal, (40, 1)))
    expected = central_difference(
        lambda step: sheet.moved_by(step).signed_distance(points), np.zeros(3), 1e-5
    )
    # The normal's length is kept to second order: 1e-10 at a step of 1e-5.
    np.testing.assert_allclose(by_parameter, expected, rtol=0.0, atol=1e-9)
    assert sheet.parameter_names == ("tilt_1", "tilt_2", "offset")


def test_distances_are_metres() -> None:
    """A step of a millimetre off the sheet is a millimetre, as the documentation says."""
    normal, forward = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    angle = np.linspace(-0.6, 0.6, 41)[:, None]
    fan = np.cos(angle) * forward + np.sin(angle) * np.array([0.0, 0.0, 1.0])
    for along_deg, least in ((0.0, 0.988), (25.0, 0.949)):
        tilt, slant = np.tan(np.deg2rad([25.0, along_deg]))
        face = Plane.from_normal(forward + tilt * normal + [0.0, 0.0, slant], 0.0)
        window = Window(Plane(face.normal, 0.02), np.zeros(3))
        sheet = Sheet(plane=Plane(normal, 0.0), window=window, n_air=1.0003, n_water=N_WATER)
        for far in (0.5, 1.0, 1.5):
            rays, _ = sheet.shine(fan)
            length = np.linalg.norm(sheet.gradient(rays.points_at(np.full(41, far))), axis=1)
            assert least < length.min()
            assert length.max() < 1.001


@pytest.mark.parametrize("seed", SEEDS)
def test_rays_meet_the_sheet_where_they_should(seed: int) -> None:
    sheet, fan = random_sheet(seed)
    points = lit_points(sheet, fan)
    origins = 0.05 * np.random.default_rng(seed).normal(size=points.shape)
    directions = points - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    steep = np.abs(np.sum(directions * sheet.gradient(points), axis=1)) > np.sin(np.deg2rad(6.0))
    found, valid = sheet.intersect(Rays(origins, directions, np.ones(len(points), np.bool_)))
    assert valid[steep].all()
    np.testing.assert_allclose(found[steep], points[steep], rtol=0.0, atol=1e-11)
    assert np.isnan(found[~valid]).all()


def test_rays_that_see_nothing() -> None:
    sheet, fan = random_sheet(1)
    points = lit_points(sheet, fan)
    # In the housing's air, behind the source.
    behind = sheet.source - 0.05 * fan
    origins = np.concatenate([points[:2], behind[:1]]) - 0.1 * sheet.plane.normal
    directions = np.tile(sheet.plane.normal, (3, 1))
    directions[1] *= -1.0
    valid = np.array([False, True, True])
    found, seen = sheet.intersect(Rays(origins, directions, valid))
    # No such ray; one that leads away; one that meets the plane of the light, but in air.
    assert not seen.any()
    assert np.isnan(found).all()
    found, seen = sheet.intersect(Rays(origins[0], directions[0], np.bool_(True)))
    assert found.shape == (3,)
    assert seen


@pytest.mark.parametrize("make_rig", [example_rig, bluerov2_rig])
def test_the_best_plane_is_best(make_rig: type) -> None:
    rig = windowed(make_rig())
    camera = rig.camera()
    for sheet, laser in zip(sheets_of(rig), rig.lasers, strict=True):
        best = sheet.best_plane(camera, rig.working_range)
        pixels = np.random.default_rng(0).uniform([0, 0], rig.size_px, (4000, 2))
        points, valid = sheet.intersect(camera.rays(pixels))
        distance = np.linalg.norm(points, axis=1)
        near, far = rig.working_range
        points = points[valid & (distance > near) & (distance < far)]
        assert len(points) > 100

        def rms(plane: Plane, at: FloatArray = points) -> float:
            return float(np.sqrt(np.mean(plane.signed_distance(at) ** 2)))

        # Centimetres off by the light's turn at the window, millimetres by its bend.
        assert rms(best) < 0.01 < 0.5 * rms(laser.plane)
        for tilt in tangent_basis(best.normal):
            # Finer turns would tell the pixels of this test from those of the fit.
            for step in (-0.03, 0.03):
                turned = Plane.from_normal(best.normal + step * tilt, 0.0)
                middle = float(points.mean(axis=0) @ turned.normal)
                assert rms(Plane(turned.normal, middle)) > rms(best)
        assert best.normal @ laser.plane.normal > 0.9


def test_a_plane_is_its_own_best_plane() -> None:
    rig = example_rig()
    for sheet, laser in zip(sheets_of(rig), rig.lasers, strict=True):
        assert sheet.is_plane
        assert sheet.best_plane(rig.camera(), rig.working_range) is laser.plane
        assert sheet.tangent_plane([0.0, 1.0, 0.0]) is laser.plane
        red = Laser("x", moved_plane(laser.plane, 0.1, 0.0, 0.0), wavelength_nm=650.0)
        assert sheet.laser(red) == Laser("x", laser.plane, wavelength_nm=650.0)


def test_a_sheet_out_of_sight_has_a_plane_all_the_same() -> None:
    rig = windowed(example_rig())
    sheet = sheets_of(rig)[0]
    nowhere = sheet.best_plane(rig.camera(), (50.0, 60.0))
    rays, _ = sheet.shine(np.array([0.0, 1.0, 0.0]) - sheet.plane.normal[1] * sheet.plane.normal)
    assert abs(nowhere.signed_distance(rays.points_at(np.array(0.6)))) < 0.02


@pytest.mark.parametrize("seed", SEEDS)
def test_the_tangent_plane_touches(seed: int) -> None:
    sheet, fan = random_sheet(seed)
    rays, _ = sheet.shine(fan)
    points, nearby = (rays.points_at(np.full(len(fan), far)) for far in (0.6, 0.61))
    for point, other in zip(points, nearby, strict=True):
        plane = sheet.tangent_plane(point)
        assert abs(plane.signed_distance(point)) < 1e-13
        # The sheet is made of straight rays: each lies in the planes that touch it.
        assert abs(plane.signed_distance(other)) < 1e-12


def test_the_face_may_point_either_way_and_the_source_be_a_little_off() -> None:
    sheet, fan = random_sheet(5)
    assert sheet.window is not None
    points = beside(lit_points(sheet, fan))
    face = sheet.window.face
    flipped = Window(Plane(-face.normal, -face.offset), sheet.window.source)
    off = Window(face, sheet.window.source + 0.003 * sheet.plane.normal)
    for window in (flipped, off):
        same = replace(sheet, window=window)
        np.testing.assert_allclose(
            same.signed_distance(points), sheet.signed_distance(points), rtol=0.0, atol=1e-15
        )


def test_moves_keep_the_source_in_the_plane() -> None:
    sheet, _ = random_sheet(7)
    step = np.array([0.02, -0.01, 0.004, 0.03, 0.01, -0.002, 0.005, -0.006, 0.004])
    moved = sheet.moved_by(step)
    assert moved.window is not None
    assert sheet.window is not None
    assert abs(moved.plane.signed_distance(moved.window.source)) < 1e-16
    assert moved.n_water == sheet.n_water + 0.004
    assert moved.window.face.offset == sheet.window.face.offset - 0.002
    turned = np.arccos(moved.window.face.normal @ sheet.window.face.normal)
    # To third order of the angle.
    assert turned == pytest.approx(np.hypot(0.03, 0.01), rel=1e-3)
    with pytest.raises(ValueError, match="step"):
        sheet.moved_by(np.zeros(3))
    same = sheet.moved_by(np.zeros(9))
    np.testing.assert_allclose(same.packed(), sheet.packed(), rtol=0.0, atol=1e-16)


def test_behind_the_window_the_sheet_is_the_plane() -> None:
    sheet, fan = random_sheet(9)
    points = beside(sheet.source - 0.2 * fan)
    np.testing.assert_allclose(
        sheet.signed_distance(points), sheet.plane.signed_distance(points), rtol=0.0, atol=1e-16
    )
    np.testing.assert_array_equal(sheet.gradient(points), np.tile(sheet.plane.normal, (40, 1)))


def test_light_that_misses_the_window() -> None:
    sheet, fan = random_sheet(2)
    rays, way = sheet.shine(-fan)
    assert not rays.valid.any()
    assert np.isnan(rays.directions).all()
    assert np.isnan(way).all()
    for call in (
        lambda: Sheet(plane=sheet.plane).shine(fan),
        lambda: Sheet(plane=sheet.plane).source,
    ):
        with pytest.raises(ValueError, match="without a window"):
            call()


def test_shapes_follow_the_points() -> None:
    sheet, fan = random_sheet(4)
    points = lit_points(sheet, fan)
    assert sheet.signed_distance(points[0]).shape == ()
    assert sheet.signed_distance(points.reshape(5, 8, 3)).shape == (5, 8)
    assert sheet.gradient(points.reshape(5, 8, 3)).shape == (5, 8, 3)
    assert sheet.signed_distance(np.empty((0, 3))).shape == (0,)
    swapped: NDArray[np.float64] = np.asfortranarray(points)
    np.testing.assert_array_equal(sheet.signed_distance(swapped), sheet.signed_distance(points))


def test_rows_for_kernels_begin_with_the_best_plane() -> None:
    rig = windowed(example_rig())
    rows = packed_sheets(rig, rig.camera())
    assert rows.shape == (3, COLUMNS)
    for row, laser in zip(rows, rig.lasers, strict=True):
        best = sheet_in(laser, rig.n_air, rig.n_water).best_plane(rig.camera(), rig.working_range)
        np.testing.assert_array_equal(row[START : START + 4], [*best.normal, best.offset])
    assert packed_sheets(replace(rig, lasers=()), rig.camera()).shape == (0, COLUMNS)
