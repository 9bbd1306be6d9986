"""The camera behind a dome: samples, round trips, derivatives, validity."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aqualvs.errors import RigError
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.camera import Camera, parameter_names
from aqualvs.optics.dome import Dome
from aqualvs.optics.flat_port import FlatPort
from aqualvs.optics.lens import Lens
from optics_cases import (
    DECENTRINGS_MM,
    FISHEYE_LENS,
    NOMINAL,
    PAPER_DOME,
    PAPER_LENS,
    SIZE_PX,
    bare_camera,
    central_difference,
    dome_camera,
    flat_camera,
    image_grid,
    moved_by,
    pose,
    relative_error,
)

DISTANCES = (0.0, 1e-3, 0.5, 1e3)


@pytest.mark.parametrize("lens_mm", DECENTRINGS_MM, ids=str)
@pytest.mark.parametrize("n_water", [1.0003, 1.3333])
def test_back_projection_inverts_the_trace(
    lens_mm: tuple[float, float, float], n_water: float
) -> None:
    camera = dome_camera(lens_mm, n_water=n_water)
    pixels = image_grid()
    rays = camera.rays(pixels)
    assert rays.valid.all()
    for distance in DISTANCES:
        points = rays.points_at(np.full(pixels.shape[:-1], distance))
        found, valid = camera.project(points)
        assert valid.all()
        # Required: 1e-9 px. A rounding of a point on the dome is worth up to 1e-11 px.
        np.testing.assert_allclose(found, pixels, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("lens_mm", DECENTRINGS_MM, ids=str)
def test_round_trip_of_a_fisheye_that_sees_backwards(lens_mm: tuple[float, float, float]) -> None:
    camera = dome_camera(lens_mm, lens=FISHEYE_LENS)
    pixels = image_grid(30.0)
    rays = camera.rays(pixels)
    assert rays.valid.all()
    found, valid = camera.project(rays.points_at(np.full(pixels.shape[:-1], 0.7)))
    assert valid.all()
    np.testing.assert_allclose(found, pixels, rtol=0.0, atol=1e-10)


def test_rays_start_on_the_outer_surface_and_run_outwards() -> None:
    rays = dome_camera().rays(image_grid())
    radius = np.linalg.norm(rays.origins, axis=-1)
    np.testing.assert_allclose(radius, PAPER_DOME.outer_radius, rtol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(rays.directions, axis=-1), 1.0, rtol=1e-15)
    assert (np.sum(rays.origins * rays.directions, axis=-1) > 0.0).all()


def test_bare_rays_start_at_the_lens() -> None:
    camera = bare_camera()
    rays = camera.rays(image_grid())
    assert (rays.origins == camera.dome_from_cam.translation).all()
    expected = camera.dome_from_cam.rotate(camera.lens.directions(image_grid())[0])
    np.testing.assert_allclose(rays.directions, expected, rtol=0.0, atol=1e-15)


@pytest.mark.samples
def test_projects_the_independent_samples(samples: Path) -> None:
    truth = json.loads((samples / "lab-paper/truth/rig_truth.json").read_text())
    c, d = truth["camera"], truth["dome"]
    rotation = rotation_from_rotvec(truth["camera_rotvec"]) @ NOMINAL
    camera = Camera(
        size_px=(c["width"], c["height"]),
        lens=Lens(fx=c["fx"], fy=c["fy"], cx=c["cx"], cy=c["cy"], distortion=tuple(c["dist"])),
        dome_from_cam=SE3(rotation, np.array(truth["lens_mm"]) * 1e-3),
        housing=Dome(d["inner_mm"] * 1e-3, d["thickness_mm"] * 1e-3, d["n_acrylic"]),
        n_air=truth["n_air"],
        n_water=truth["n_water"],
    )
    files = sorted((samples / "lab-paper/truth/dives").glob("*/points_*.npz"))
    assert files
    for file in files:
        with np.load(file) as data:
            pixels, valid = camera.project(data["xyz"] * 1e-3)
            assert valid.all()
            # Both sides solve to machine precision; the files hold mm in float64.
            np.testing.assert_allclose(pixels, data["px"], rtol=0.0, atol=1e-9)


def cameras_for_derivatives() -> dict[str, Camera]:
    cameras: dict[str, Camera] = {f"dome{mm}": dome_camera(mm) for mm in DECENTRINGS_MM}
    cameras["in air"] = dome_camera(n_water=1.0003)
    cameras["fisheye"] = dome_camera((10.0, -20.0, 5.0), lens=FISHEYE_LENS)
    cameras["flat"] = flat_camera()
    cameras["flat in air"] = flat_camera(n_water=1.0003)
    cameras["flat fisheye"] = flat_camera(
        FlatPort(0.02, 0.004, 1.52, -0.2, 0.1), lens=replace(FISHEYE_LENS, fx=450.0, fy=452.0)
    )
    cameras["bare"] = bare_camera()
    cameras["bare fisheye"] = bare_camera(lens=FISHEYE_LENS)
    return cameras


CAMERAS = cameras_for_derivatives()


@pytest.fixture(params=CAMERAS, ids=str)
def camera(request: pytest.FixtureRequest) -> Camera:
    return CAMERAS[request.param]


def points_in_view(camera: Camera, distance: float = 0.5) -> np.ndarray:
    rays = camera.rays(image_grid(144.0).reshape(-1, 2))
    return rays.points_at(np.linspace(0.02, 2.0 * distance, len(rays.origins)))


def test_projection_jacobian_is_the_derivative(camera: Camera) -> None:
    points = points_in_view(camera)
    pixels, valid, jacobian = camera.project_with_jacobian(points)
    assert valid.all()
    np.testing.assert_allclose(pixels, camera.project(points)[0], rtol=0.0, atol=1e-10)
    numeric = central_difference(lambda x: camera.project(x)[0], points, 2e-6)
    assert relative_error(jacobian, numeric) < 1e-7


def test_parameter_jacobian_is_the_derivative(camera: Camera) -> None:
    points = points_in_view(camera)
    _, valid, by_point, by_parameter = camera.project_with_parameter_jacobian(points)
    assert valid.all()
    names = parameter_names(camera)
    assert by_parameter.shape == (len(points), 2, len(names))
    np.testing.assert_array_equal(by_point, camera.project_with_jacobian(points)[2])
    at = np.zeros(len(names))
    step = np.array(
        [1e-6 if name.startswith(("lens", "inner", "thick", "port_d")) else 1e-5 for name in names]
    )
    numeric = central_difference(lambda s: moved_by(camera, s).project(points)[0], at, step)
    # Each column against its own size; a rounding of 1e-12 px over the step is 1e-6 px per unit,
    # which matters where the true derivative vanishes, as for the indices of a centred dome.
    scale = np.abs(numeric).max(axis=(0, 1)) + 1.0
    error = np.abs(by_parameter - numeric).max(axis=(0, 1)) / scale
    assert dict(zip(names, error < 1e-6, strict=True)) == dict.fromkeys(names, True)


@pytest.mark.parametrize("lens_mm", [(0, 20, 0), (0, -20, 0), (0, 0, 0), (3, 20, 4), (-7, 11, 13)])
def test_derivatives_on_the_axis(lens_mm: tuple[int, int, int]) -> None:
    camera = dome_camera(lens_mm, lens=FISHEYE_LENS, rotvec=(0.0, 0.0, 0.0))
    near = np.array([0.0, 1e-16, 1e-13, 1e-11, 1e-9, 1e-7, 1e-5, 1e-4])[:, None]
    lens = np.array(lens_mm)
    axis = lens / np.linalg.norm(lens) if lens.any() else np.array([0.0, 1.0, 0.0])
    axis = axis * np.sign(axis[1])
    points = 0.4 * axis + near * np.array([axis[1], -axis[0], 0.3])
    pixels, valid, by_point, by_parameter = camera.project_with_parameter_jacobian(points)
    assert valid.all()
    straight = camera.dome_from_cam.inverse().rotate(axis)
    np.testing.assert_allclose(pixels[0], FISHEYE_LENS.pixels(straight)[0], atol=1e-12)
    numeric = central_difference(lambda x: camera.project(x)[0], points, 2e-6)
    assert relative_error(by_point, numeric) < 1e-7
    at = np.zeros(by_parameter.shape[-1])
    numeric = central_difference(lambda s: moved_by(camera, s).project(points)[0], at, 1e-6)
    assert relative_error(by_parameter[..., :3], numeric[..., :3]) < 1e-6


def test_invalid_points_are_masked_and_nan() -> None:
    camera = dome_camera()
    points = np.array(
        [
            [0.0, 0.049, 0.0],  # inside the acrylic
            [0.0, 0.0, 0.0],  # the dome's centre
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


def test_pixels_outside_the_lens_model_have_no_ray() -> None:
    lens = Lens(fx=500.0, fy=500.0, cx=360.0, cy=288.0, distortion=(-0.5, 0.0, 0.0, 0.0))
    rays = dome_camera(lens=lens).rays(image_grid(30.0))
    radius = np.linalg.norm(image_grid(30.0) - [360.0, 288.0], axis=-1)
    np.testing.assert_array_equal(rays.valid, radius < 500.0 * np.sqrt(2 / 3) * 2 / 3)
    assert not rays.valid.all()
    for values in (rays.origins, rays.directions):
        assert np.isnan(values[~rays.valid]).all()
        assert np.isfinite(values[rays.valid]).all()


def test_total_reflection_is_invalid() -> None:
    # Oil inside, air outside: rays at grazing incidence never leave.
    camera = dome_camera(
        (0.0, 0.0, 40.0),
        lens=FISHEYE_LENS,
        dome=Dome(0.04425, 0.00575, 1.5),
        n_air=1.45,
        n_water=1.0,
    )
    pixels = image_grid(20.0)
    rays = camera.rays(pixels)
    assert 0.05 < rays.valid.mean() < 0.95
    lens_to_inner = camera.dome_from_cam.rotate(camera.lens.directions(pixels)[0])
    bouguer = 1.45 * np.linalg.norm(
        np.cross(camera.dome_from_cam.translation, lens_to_inner), axis=-1
    )
    np.testing.assert_array_equal(rays.valid, bouguer <= 1.0 * camera.housing.outer_radius)
    assert np.isnan(rays.directions[~rays.valid]).all()
    points = rays.points_at(np.full(rays.valid.shape, 0.3))
    found, valid = camera.project(points)
    assert not (valid & ~rays.valid).any()
    # Points where two rays merge may be refused; a hundredth of the picture is generous.
    assert valid.sum() > 0.99 * rays.valid.sum()
    # Near the critical angle two pixels may see one point: any of them will do.
    again = camera.rays(found[valid])
    offset = np.cross(points[valid] - again.origins, again.directions)
    np.testing.assert_allclose(offset, 0.0, rtol=0.0, atol=1e-9)


def test_a_lens_outside_the_inner_sphere_is_refused() -> None:
    with pytest.raises(
        RigError, match=r"lens at \[0.0, 45.0, 0.0\] mm is 45.000 mm from.*44.250 mm"
    ):
        dome_camera((0.0, 45.0, 0.0))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"n_water": 0.9}, "n_water = 0.9"),
        ({"n_air": float("nan")}, "n_air = nan"),
        ({"size_px": (0, 576)}, r"size \(0, 576\)"),
        ({"dome_from_cam": SE3(np.eye(3) * 1.01, np.zeros(3))}, "not a rotation matrix"),
        ({"dome_from_cam": SE3(np.diag([1.0, 1.0, -1.0]), np.zeros(3))}, "not a rotation matrix"),
        ({"dome_from_cam": SE3(np.eye(3), np.full(3, np.nan))}, "not finite"),
        ({"dome_from_cam": SE3(np.eye(3), np.zeros((2, 3)))}, "shapes"),
    ],
)
def test_impossible_cameras_are_refused(change: dict[str, object], words: str) -> None:
    good: dict[str, object] = {
        "size_px": SIZE_PX,
        "lens": PAPER_LENS,
        "dome_from_cam": pose((0.0, 5.0, 0.0)),
        "housing": PAPER_DOME,
        "n_air": 1.0003,
        "n_water": 1.3333,
    }
    with pytest.raises(RigError, match=words):
        Camera(**(good | change))


def test_moved_by_follows_the_documented_order() -> None:
    camera = dome_camera((1.0, 2.0, 3.0))
    names = parameter_names(camera)
    assert names[:6] == ("lens_x", "lens_y", "lens_z", "rotation_x", "rotation_y", "rotation_z")
    assert names[6:11] == ("inner_radius", "thickness", "n_air", "n_acrylic", "n_water")
    assert names[11:] == ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    moved = moved_by(camera, np.arange(1.0, 21.0) * 1e-4)
    np.testing.assert_allclose(moved.dome_from_cam.translation, [0.0011, 0.0022, 0.0033])
    turn = moved.dome_from_cam.rotation @ camera.dome_from_cam.rotation.T
    np.testing.assert_allclose(turn, rotation_from_rotvec([4e-4, 5e-4, 6e-4]), atol=1e-15)
    assert moved.housing == Dome(0.04425 + 7e-4, 0.00575 + 8e-4, 1.49 + 10e-4)
    assert (moved.n_air, moved.n_water) == (1.0003 + 9e-4, 1.3333 + 11e-4)
    assert moved.lens.distortion[-1] == pytest.approx(0.01 + 20e-4)
    assert parameter_names(bare_camera()) == names[:6] + names[11:]


def test_inside_image_includes_whole_border_pixels() -> None:
    camera = bare_camera()
    pixels = [[-0.5, -0.5], [719.49, 575.49], [719.5, 0.0], [0.0, -0.51], [np.nan, 1.0]]
    np.testing.assert_array_equal(camera.inside_image(pixels), [1, 1, 0, 0, 0])


def test_shapes_follow_the_batch() -> None:
    camera = dome_camera()
    assert camera.rays([300.0, 200.0]).origins.shape == (3,)
    assert camera.rays(np.empty((0, 2))).valid.shape == (0,)
    assert camera.project(np.full((2, 5, 3), 0.3))[0].shape == (2, 5, 2)
    assert camera.project_with_parameter_jacobian(np.full((2, 5, 3), 0.3))[3].shape == (2, 5, 2, 20)
    with pytest.raises(ValueError, match="points_in_dome has shape"):
        camera.project([1.0, 2.0])
