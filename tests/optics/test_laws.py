"""Laws of refraction, checked on traced rays with nothing of the tracer's own arithmetic."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.camera import Camera
from aqualvs.optics.dome import Dome
from aqualvs.optics.refraction import refract
from optics_cases import (
    DECENTRINGS_MM,
    FISHEYE_LENS,
    PAPER_DOME,
    SIZE_PX,
    bare_camera,
    dome_camera,
    image_grid,
)

PIXELS = image_grid(72.0).reshape(-1, 2)

COORDINATE = st.floats(-1.0, 1.0)
CAMERAS = st.builds(
    lambda direction, share, rotvec, n, ratio: make_camera(direction, share, rotvec, n, ratio),
    st.tuples(COORDINATE, COORDINATE, COORDINATE),
    st.floats(0.0, 0.95),
    st.tuples(COORDINATE, COORDINATE, COORDINATE),
    st.tuples(st.floats(1.0, 1.0005), st.floats(1.3, 1.9), st.floats(1.0005, 1.5)),
    st.floats(0.005, 0.3),
)


def make_camera(
    direction: tuple[float, float, float],
    share: float,
    rotvec: tuple[float, float, float],
    n: tuple[float, float, float],
    relative_thickness: float,
) -> Camera:
    """A camera with its lens at `share` of the inner radius along `direction`."""
    inner = 0.044
    length = np.linalg.norm(direction)
    unit = np.array(direction) / length if length > 0.0 else np.array([0.0, 1.0, 0.0])
    x, y, z = (unit * share * inner * 1e3).tolist()
    return dome_camera(
        (x, y, z),
        lens=FISHEYE_LENS,
        dome=Dome(inner, relative_thickness * inner, n[1]),
        n_air=n[0],
        n_water=n[2],
        rotvec=rotvec,
    )


def path_of(camera: Camera) -> dict[str, np.ndarray]:
    """Corners and directions of the traced rays, those inside from the quadratic formula."""
    rays = camera.rays(PIXELS)
    assert rays.valid.all()
    lens = camera.dome_from_cam.translation
    in_air = camera.dome_from_cam.rotate(camera.lens.directions(PIXELS)[0])
    half_b = in_air @ lens
    c = lens @ lens - camera.housing.inner_radius**2
    inner = lens + (np.sqrt(half_b**2 - c) - half_b)[:, None] * in_air
    in_wall = rays.origins - inner
    return {
        "lens": np.broadcast_to(lens, inner.shape),
        "in_air": in_air,
        "inner": inner,
        "in_wall": in_wall / np.linalg.norm(in_wall, axis=-1, keepdims=True),
        "outer": rays.origins,
        "in_water": rays.directions,
    }


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle by the arc tangent, exact at every size, unlike the arc cosine."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(CAMERAS)
def test_snell_holds_at_both_surfaces(camera: Camera) -> None:
    p = path_of(camera)
    n_wall = camera.housing.n_acrylic
    incidence = angle_between(p["in_air"], p["inner"])
    refracted = np.arcsin(camera.n_air / n_wall * np.sin(incidence))
    # A rounding of the corners, 1e-17 m over 0.2 mm of wall at least.
    tolerance = 1e-11
    assert angle_between(p["in_wall"], p["inner"]) == pytest.approx(refracted, abs=tolerance)
    incidence = angle_between(p["in_wall"], p["outer"])
    refracted = np.arcsin(n_wall / camera.n_water * np.sin(incidence))
    assert angle_between(p["in_water"], p["outer"]) == pytest.approx(refracted, abs=tolerance)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(CAMERAS)
def test_a_ray_stays_in_the_plane_of_lens_and_centre(camera: Camera) -> None:
    p = path_of(camera)
    normal = np.cross(p["lens"], p["in_air"])
    length = np.linalg.norm(normal, axis=-1)
    keep = length > 1e-6
    normal = normal[keep] / length[keep, None]
    for name in ("inner", "outer", "in_water"):
        offset = np.abs(np.sum(normal * p[name][keep], axis=-1))
        # The normal of a nearly central ray is uncertain by 1e-17 / 1e-6.
        assert offset.max(initial=0.0) < 1e-10


@settings(max_examples=60, deadline=None, derandomize=True)
@given(CAMERAS)
def test_bouguers_invariant_is_one_number_along_a_ray(camera: Camera) -> None:
    p = path_of(camera)
    at_lens = camera.n_air * np.cross(p["lens"], p["in_air"])
    in_water = camera.n_water * np.cross(p["outer"], p["in_water"])
    far = p["outer"] + 3.0 * p["in_water"]
    # Roundings of 0.05 m times an index, and of 3 m.
    np.testing.assert_allclose(in_water, at_lens, rtol=0.0, atol=1e-16)
    at_distance = camera.n_water * np.cross(far, p["in_water"])
    np.testing.assert_allclose(at_distance, at_lens, rtol=0.0, atol=5e-15)


@pytest.mark.parametrize("lens_mm", DECENTRINGS_MM, ids=str)
def test_the_optical_path_is_stationary(lens_mm: tuple[float, float, float]) -> None:
    camera = dome_camera(lens_mm)
    p = path_of(camera)
    target = p["outer"] + 0.4 * p["in_water"]

    def optical_length(turn_inner: np.ndarray, turn_outer: np.ndarray) -> np.ndarray:
        inner = p["inner"] @ rotation_from_rotvec(turn_inner).T
        outer = p["outer"] @ rotation_from_rotvec(turn_outer).T
        return (
            camera.n_air * np.linalg.norm(inner - p["lens"], axis=-1)
            + camera.housing.n_acrylic * np.linalg.norm(outer - inner, axis=-1)
            + camera.n_water * np.linalg.norm(target - outer, axis=-1)
        )

    step, still = 3e-6, np.zeros(3)
    for axis in np.eye(3) * step:
        for a, b in ((axis, still), (still, axis), (axis, -axis)):
            slope = (optical_length(a, b) - optical_length(-a, -b)) / (2.0 * step)
            # Metres per radian: rounding 1e-16 / 3e-6, truncation step^2 times 5 m. A direction
            # in water that is off by 5e-9 rad would show.
            np.testing.assert_allclose(slope, 0.0, rtol=0.0, atol=3e-10)


@pytest.mark.parametrize("lens_mm", DECENTRINGS_MM, ids=str)
def test_equal_indices_give_the_bare_lens(lens_mm: tuple[float, float, float]) -> None:
    dome = Dome(PAPER_DOME.inner_radius, PAPER_DOME.thickness, 1.2)
    camera = dome_camera(lens_mm, dome=dome, n_air=1.2, n_water=1.2)
    bare = bare_camera(lens_mm)
    rays, straight = camera.rays(PIXELS), bare.rays(PIXELS)
    np.testing.assert_allclose(rays.directions, straight.directions, rtol=0.0, atol=1e-15)
    offset = np.cross(rays.origins - straight.origins, straight.directions)
    np.testing.assert_allclose(offset, 0.0, rtol=0.0, atol=1e-16)
    points = rays.points_at(np.full(len(PIXELS), 0.5))
    np.testing.assert_allclose(
        camera.project(points)[0], bare.project(points)[0], rtol=0.0, atol=1e-11
    )


def test_a_centred_dome_bends_nothing() -> None:
    camera, bare = dome_camera((0.0, 0.0, 0.0)), bare_camera((0.0, 0.0, 0.0))
    rays, straight = camera.rays(PIXELS), bare.rays(PIXELS)
    np.testing.assert_allclose(rays.directions, straight.directions, rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(rays.origins, 0.05 * straight.directions, rtol=0.0, atol=1e-16)
    points = rays.points_at(np.full(len(PIXELS), 0.5))
    np.testing.assert_allclose(
        camera.project(points)[0], bare.project(points)[0], rtol=0.0, atol=1e-11
    )


@pytest.mark.parametrize("n_acrylic", [1.2, 1.49, 1.9])
def test_an_infinitely_thin_dome_is_one_surface(n_acrylic: float) -> None:
    camera = dome_camera((10.0, 30.0, -5.0), dome=Dome(0.044, 0.0, n_acrylic))
    rays = camera.rays(PIXELS)
    in_air = camera.dome_from_cam.rotate(camera.lens.directions(PIXELS)[0])
    expected, valid = refract(in_air, -rays.origins / 0.044, n_in=1.0003, n_out=1.3333)
    assert valid.all()
    np.testing.assert_allclose(rays.directions, expected, rtol=0.0, atol=1e-14)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(CAMERAS)
def test_light_sent_back_arrives_at_the_lens(camera: Camera) -> None:
    p = path_of(camera)
    outer_normal = p["outer"] / camera.housing.outer_radius
    in_wall, valid = refract(
        -p["in_water"], outer_normal, n_in=camera.n_water, n_out=camera.housing.n_acrylic
    )
    assert valid.all()
    half_b = np.sum(p["outer"] * in_wall, axis=-1)
    c = camera.housing.outer_radius**2 - camera.housing.inner_radius**2
    inner = p["outer"] - (half_b + np.sqrt(half_b**2 - c))[:, None] * in_wall
    normal = inner / np.linalg.norm(inner, axis=-1, keepdims=True)
    in_air, valid = refract(in_wall, normal, n_in=camera.housing.n_acrylic, n_out=camera.n_air)
    assert valid.all()
    # Roundings grow where the way back meets the inner surface at up to 70 degrees.
    np.testing.assert_allclose(in_air, -p["in_air"], rtol=0.0, atol=1e-13)
    offset = np.cross(p["lens"] - inner, in_air)
    np.testing.assert_allclose(offset, 0.0, rtol=0.0, atol=1e-14)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(CAMERAS, st.floats(0.0, 20.0))
def test_projection_inverts_the_trace(camera: Camera, distance: float) -> None:
    rays = camera.rays(PIXELS)
    assert rays.valid.all()
    found, valid = camera.project(rays.points_at(np.full(len(PIXELS), distance)))
    assert valid.all()
    # Required: 1e-9 px.
    np.testing.assert_allclose(found, PIXELS, rtol=0.0, atol=2e-10)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(CAMERAS, st.tuples(COORDINATE, COORDINATE, COORDINATE))
def test_turning_everything_about_the_centre_changes_no_pixel(
    camera: Camera, rotvec: tuple[float, float, float]
) -> None:
    turn = SE3.from_rotvec(rotvec, np.zeros(3))
    turned = Camera(
        size_px=SIZE_PX,
        lens=camera.lens,
        dome_from_cam=turn @ camera.dome_from_cam,
        housing=camera.housing,
        n_air=camera.n_air,
        n_water=camera.n_water,
    )
    rays, expected = turned.rays(PIXELS), camera.rays(PIXELS)
    np.testing.assert_allclose(
        rays.directions, turn.rotate(expected.directions), rtol=0.0, atol=1e-13
    )
    points = expected.points_at(np.full(len(PIXELS), 0.3))
    np.testing.assert_allclose(turned.project(turn.apply(points))[0], PIXELS, rtol=0.0, atol=2e-10)


@pytest.mark.parametrize("scale", [0.1, 30.0])
def test_scaling_everything_changes_no_pixel(scale: float) -> None:
    camera = dome_camera()
    dome = Dome(PAPER_DOME.inner_radius * scale, PAPER_DOME.thickness * scale, 1.49)
    scaled = dome_camera((3.1 * scale, 41.8 * scale, 3.0 * scale), dome=dome)
    points = camera.rays(PIXELS).points_at(np.full(len(PIXELS), 0.4))
    np.testing.assert_allclose(scaled.project(points * scale)[0], PIXELS, rtol=0.0, atol=1e-10)
