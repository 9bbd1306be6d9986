"""The laws of a flat port, checked on traced rays with nothing of the tracer's own arithmetic."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.errors import RigError
from aqualvs.optics.camera import Camera, parameter_names
from aqualvs.optics.flat_port import FlatPort
from aqualvs.optics.refraction import refract
from optics_cases import FISHEYE_LENS, PAPER_LENS, bare_camera, flat_camera, image_grid, moved_by

PIXELS = image_grid(72.0).reshape(-1, 2)
# 57 degrees off the axis in the corners.
WIDE_LENS = replace(FISHEYE_LENS, fx=450.0, fy=452.0)
COORDINATE = st.floats(-1.0, 1.0)
CAMERAS = st.builds(
    lambda sizes, tilts, rotvec, n, wide: flat_camera(
        FlatPort(sizes[0], sizes[1], n[1], 0.25 * tilts[0], 0.25 * tilts[1]),
        lens=WIDE_LENS if wide else PAPER_LENS,
        n_air=n[0],
        n_water=n[2],
        rotvec=rotvec,
    ),
    st.tuples(st.floats(1e-3, 0.3), st.floats(0.0, 0.03)),
    st.tuples(COORDINATE, COORDINATE),
    st.tuples(COORDINATE, COORDINATE, COORDINATE),
    st.tuples(st.floats(1.0, 1.0005), st.floats(1.3, 1.9), st.floats(1.0005, 1.5)),
    st.booleans(),
)


def normal_of(camera: Camera) -> np.ndarray:
    """The port's normal in `dome`, by two rotations of the optical axis."""
    x, y = camera.housing.tilt_x, camera.housing.tilt_y
    about_y = np.array([[math.cos(y), 0, math.sin(y)], [0, 1, 0], [-math.sin(y), 0, math.cos(y)]])
    about_x = np.array([[1, 0, 0], [0, math.cos(x), -math.sin(x)], [0, math.sin(x), math.cos(x)]])
    return camera.dome_from_cam.rotate(about_x @ about_y @ np.array([0.0, 0.0, 1.0]))


def traced(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions of the rays, by intersection with planes and by `refract`."""
    normal, port, lens = normal_of(camera), camera.housing, camera.dome_from_cam.translation
    in_air = camera.dome_from_cam.rotate(camera.lens.directions(PIXELS)[0])
    inner = lens + (port.distance / (in_air @ normal))[:, None] * in_air
    in_wall, valid = refract(in_air, -normal, n_in=camera.n_air, n_out=port.n_port)
    outer = inner + (port.thickness / (in_wall @ normal))[:, None] * in_wall
    in_water, still_valid = refract(in_wall, -normal, n_in=port.n_port, n_out=camera.n_water)
    assert valid.all()
    assert still_valid.all()
    return outer, in_water


@settings(max_examples=30, deadline=None, derandomize=True)
@given(CAMERAS)
def test_snell_holds_at_both_faces(camera: Camera) -> None:
    rays = camera.rays(PIXELS)
    origins, directions = traced(camera)
    assert rays.valid.all()
    np.testing.assert_allclose(rays.origins, origins, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(rays.directions, directions, rtol=0.0, atol=1e-14)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(CAMERAS, st.floats(0.0, 20.0))
def test_projection_inverts_the_trace(camera: Camera, distance: float) -> None:
    rays = camera.rays(PIXELS)
    found, valid = camera.project(rays.points_at(np.full(len(PIXELS), distance)))
    assert valid.all()
    # Required: 1e-9 px.
    np.testing.assert_allclose(found, PIXELS, rtol=0.0, atol=2e-10)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(CAMERAS)
def test_all_rays_meet_the_axis(camera: Camera) -> None:
    """Behind a flat port a camera is axial (Agrawal et al. 2012)."""
    rays = camera.rays(PIXELS)
    across = np.cross(rays.directions, normal_of(camera))
    offset = np.sum((rays.origins - camera.dome_from_cam.translation) * across, axis=-1)
    np.testing.assert_allclose(offset, 0.0, rtol=0.0, atol=1e-14)


def test_the_optical_path_is_stationary() -> None:
    camera = flat_camera()
    rays, normal, port = camera.rays(PIXELS), normal_of(camera), camera.housing
    lens = camera.dome_from_cam.translation
    target = rays.origins + 0.4 * rays.directions
    in_air = camera.dome_from_cam.rotate(camera.lens.directions(PIXELS)[0])
    inner = lens + (port.distance / (in_air @ normal))[:, None] * in_air

    def optical_length(shift_inner: np.ndarray, shift_outer: np.ndarray) -> np.ndarray:
        p, q = inner + shift_inner, rays.origins + shift_outer
        return (
            camera.n_air * np.linalg.norm(p - lens, axis=-1)
            + port.n_port * np.linalg.norm(q - p, axis=-1)
            + camera.n_water * np.linalg.norm(target - q, axis=-1)
        )

    first = np.cross(normal, [0.3, 0.1, 0.9])
    step, still = 1e-6, np.zeros(3)
    for axis in (first, np.cross(normal, first)):
        shift = axis / np.linalg.norm(axis) * step
        for a, b in ((shift, still), (still, shift)):
            slope = (optical_length(a, b) - optical_length(-a, -b)) / (2.0 * step)
            # Truncation: step^2 over the square of 0.006 m. A direction off by 1e-8 rad would show.
            np.testing.assert_allclose(slope, 0.0, rtol=0.0, atol=1e-8)


def test_equal_indices_bend_nothing() -> None:
    camera = flat_camera(FlatPort(0.03, 0.006, 1.2, 0.1, -0.2), n_air=1.2, n_water=1.2)
    bare = bare_camera()
    rays, straight = camera.rays(PIXELS), bare.rays(PIXELS)
    np.testing.assert_allclose(rays.directions, straight.directions, rtol=0.0, atol=1e-15)
    points = rays.points_at(np.full(len(PIXELS), 0.5))
    np.testing.assert_allclose(
        camera.project(points)[0], bare.project(points)[0], rtol=0.0, atol=1e-11
    )


@pytest.mark.parametrize("n_port", [1.2, 1.49, 1.9])
def test_an_infinitely_thin_port_is_one_surface(n_port: float) -> None:
    camera = flat_camera(FlatPort(0.03, 0.0, n_port, 0.1, -0.2))
    in_air = camera.dome_from_cam.rotate(camera.lens.directions(PIXELS)[0])
    expected, valid = refract(in_air, -normal_of(camera), n_in=1.0003, n_out=1.3333)
    assert valid.all()
    np.testing.assert_allclose(camera.rays(PIXELS).directions, expected, rtol=0.0, atol=1e-14)


def test_far_points_near_the_axis_are_magnified_by_the_index() -> None:
    camera = flat_camera(FlatPort(0.03, 0.006, 1.49), lens=FISHEYE_LENS)
    bare = bare_camera(lens=FISHEYE_LENS)
    ahead = camera.dome_from_cam.apply([[0.0, 0.0, 1e4], [1.0, 0.0, 1e4], [0.0, 1.0, 1e4]])
    seen, straight = camera.project(ahead)[0], bare.project(ahead)[0]
    ratio = np.linalg.norm(seen[1:] - seen[0], axis=-1)
    ratio /= np.linalg.norm(straight[1:] - straight[0], axis=-1)
    # Off by the square of 1e-4 rad, and by 0.04 m over 1e4 m.
    np.testing.assert_allclose(ratio, 1.3333 / 1.0003, rtol=1e-5)


def test_directions_that_miss_the_port_are_invalid() -> None:
    camera = flat_camera(FlatPort(0.03, 0.006, 1.49, 0.7, 0.0), lens=FISHEYE_LENS)
    rays = camera.rays(image_grid())
    in_air = camera.dome_from_cam.rotate(camera.lens.directions(image_grid())[0])
    np.testing.assert_array_equal(rays.valid, in_air @ normal_of(camera) > 0.0)
    assert 0.05 < rays.valid.mean() < 0.95
    assert np.isnan(rays.directions[~rays.valid]).all()


def test_total_reflection_is_invalid() -> None:
    # Oil inside, air outside: light beyond the critical angle never leaves.
    camera = flat_camera(
        FlatPort(0.03, 0.006, 1.5, 0.1, 0.0), lens=FISHEYE_LENS, n_air=1.45, n_water=1.0
    )
    rays = camera.rays(image_grid())
    in_air = camera.dome_from_cam.rotate(camera.lens.directions(image_grid())[0])
    sine = 1.45 * np.linalg.norm(np.cross(in_air, normal_of(camera)), axis=-1)
    np.testing.assert_array_equal(rays.valid, sine < 1.0)
    assert 0.05 < rays.valid.mean() < 0.95
    seen = image_grid()[rays.valid]
    points = rays.points_at(np.full(rays.valid.shape, 0.3))[rays.valid]
    found, valid = camera.project(points)
    assert valid.all()
    # Next to the critical angle a rounding of the point moves the pixel more.
    steep = sine[rays.valid] > 0.999
    np.testing.assert_allclose(found[~steep], seen[~steep], rtol=0.0, atol=1e-9)
    again = camera.rays(found)
    offset = np.cross(points - again.origins, again.directions)
    np.testing.assert_allclose(offset, 0.0, rtol=0.0, atol=1e-9)


def test_invalid_points_are_masked_and_nan() -> None:
    camera = flat_camera(lens_mm=(0.0, 0.0, 0.0), rotvec=(0.0, 0.0, 0.0))
    points = np.array(
        [
            [0.0, 0.034, 0.0],  # inside the port
            [0.0, 0.0, 0.0],  # the lens
            [0.0, -0.5, 0.0],  # behind the camera
            [np.nan, 0.5, 0.0],
            [np.inf, 0.5, 0.0],
            [0.0, 0.5, 0.0],
        ]
    )
    pixels, valid, by_point, by_parameter = camera.project_with_parameter_jacobian(points)
    np.testing.assert_array_equal(valid, [False] * 5 + [True])
    np.testing.assert_array_equal(camera.project(points)[1], valid)
    for values in (pixels, by_point, by_parameter, camera.project(points)[0]):
        assert np.isnan(values[:5]).all()
        assert np.isfinite(values[5]).all()


def test_derivatives_on_the_axis() -> None:
    camera = flat_camera(lens=FISHEYE_LENS)
    beside = np.cross(normal_of(camera), [0.3, 0.1, 0.9])
    near = np.array([0.0, 1e-16, 1e-13, 1e-11, 1e-9, 1e-7, 1e-5, 1e-4])[:, None]
    points = camera.dome_from_cam.translation + 0.4 * normal_of(camera) + near * beside
    _, valid, by_point, by_parameter = camera.project_with_parameter_jacobian(points)
    assert valid.all()
    step = 2e-6
    for i, axis in enumerate(np.eye(3) * step):
        slope = (camera.project(points + axis)[0] - camera.project(points - axis)[0]) / (2 * step)
        np.testing.assert_allclose(by_point[..., i], slope, rtol=0.0, atol=1e-3)
    for i, axis in enumerate(np.eye(by_parameter.shape[-1]) * step):
        ahead, back = moved_by(camera, axis).project(points)[0], moved_by(camera, -axis)
        slope = (ahead - back.project(points)[0]) / (2 * step)
        np.testing.assert_allclose(by_parameter[..., i], slope, rtol=0.0, atol=1e-3)


def test_the_port_goes_with_the_camera() -> None:
    camera = flat_camera()
    step = np.zeros(len(parameter_names(camera)))
    step[:6] = 0.01, -0.02, 0.03, 0.1, -0.2, 0.15
    moved = moved_by(camera, step)
    points = camera.rays(PIXELS).points_at(np.full(len(PIXELS), 0.3))
    carried = moved.dome_from_cam.apply(camera.dome_from_cam.inverse().apply(points))
    np.testing.assert_allclose(moved.project(carried)[0], PIXELS, rtol=0.0, atol=2e-10)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ((0.0, 0.005, 1.49), "0 mm from the lens"),
        ((float("nan"), 0.005, 1.49), "nan mm from the lens"),
        ((0.03, -0.001, 1.49), "thickness -1 mm"),
        ((0.03, 0.005, 0.5), "n_port = 0.5"),
        ((0.03, 0.005, 1.49, 0.0, 0.9), "tilted by 51.5662 degrees"),
        ((0.03, 0.005, 1.49, float("nan"), 0.0), "tilted by nan degrees"),
    ],
)
def test_impossible_ports_are_refused(values: tuple[float, ...], words: str) -> None:
    with pytest.raises(RigError, match=words):
        FlatPort(*values)
