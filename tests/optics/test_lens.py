"""The lens against OpenCV, against itself backwards, and against its own derivatives."""

import cv2
import numpy as np
import pytest

from aqualvs.errors import RigError
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.camera import POSE_PARAMETERS, Camera
from aqualvs.optics.lens import Lens, LensModel
from optics_cases import FISHEYE_LENS, PAPER_LENS, central_difference, image_grid, relative_error

INTRINSICS = {"fx": 817.5, "fy": 878.0, "cx": 368.9, "cy": 281.7}
RATIONAL = (0.31, -0.11, 5e-4, -3e-4, 0.012, 0.42, -0.06, 0.021)
LENSES = {
    "pinhole": Lens(**INTRINSICS),
    "four": Lens(**INTRINSICS, distortion=(-0.126, 0.0827, 6.2e-4, -4.5e-4)),
    "five": PAPER_LENS,
    "rational": Lens(**INTRINSICS, distortion=RATIONAL),
    "fisheye": FISHEYE_LENS,
    "equidistant": Lens(model=LensModel.FISHEYE, **INTRINSICS),
}


@pytest.fixture(params=LENSES, ids=str)
def lens(request: pytest.FixtureRequest) -> Lens:
    return LENSES[request.param]


def directions_in_view(n: int = 400, angle: float = 0.6) -> np.ndarray:
    rng = np.random.default_rng(7)
    theta, phi = angle * np.sqrt(rng.random(n)), 2.0 * np.pi * rng.random(n)
    theta[:2] = 0.0, 1e-9
    unit = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    return unit * rng.uniform(0.2, 5.0, (n, 1))


def bare(lens: Lens) -> Camera:
    """Return a camera whose points are directions of its lens."""
    return Camera(size_px=(720, 576), lens=lens, dome_from_cam=SE3.identity())


def camera_matrix(lens: Lens) -> np.ndarray:
    return np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])


def opencv_pixels(lens: Lens, directions: np.ndarray) -> np.ndarray:
    coefficients = np.array(lens.distortion or (0.0,) * 4)
    project = cv2.fisheye.projectPoints if lens.model is LensModel.FISHEYE else cv2.projectPoints
    zero = np.zeros(3)
    args = (zero, zero, camera_matrix(lens), coefficients)
    return project(directions.reshape(-1, 1, 3), *args)[0].reshape(-1, 2)


def test_pixels_agree_with_opencv(lens: Lens) -> None:
    d = directions_in_view()
    expected = opencv_pixels(lens, d)
    found, valid = lens.pixels(d)
    assert valid.all()
    # Both are closed-form; only roundings of numbers near 1000 px differ.
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)


def test_opencv_sees_our_directions_at_their_pixels(lens: Lens) -> None:
    pixels = image_grid(60.0).reshape(-1, 2)
    d, valid = lens.directions(pixels)
    assert valid.all()
    # OpenCV's own inverse stops early; its forward map is exact.
    np.testing.assert_allclose(opencv_pixels(lens, d), pixels, rtol=0.0, atol=1e-9)


def test_round_trip_is_exact(lens: Lens) -> None:
    pixels = image_grid(20.0)
    d, valid = lens.directions(pixels)
    assert valid.all()
    np.testing.assert_allclose(np.linalg.norm(d, axis=-1), 1.0, rtol=0.0, atol=1e-15)
    back, seen = lens.pixels(d)
    assert seen.all()
    # A few roundings of 1000 px.
    np.testing.assert_allclose(back, pixels, rtol=0.0, atol=2e-12)


def max_angle(lens: Lens) -> float:
    """Angle to the optical axis, in radians, inside which directions are valid."""
    limit = lens.params.limit
    return limit if lens.model is LensModel.FISHEYE else float(np.arctan(np.sqrt(limit)))


@pytest.mark.parametrize(
    "coefficients",
    [(-0.35, 0.12, 1e-3, -2e-3), (0.5, 0.3, -2e-3, 1e-3), (-0.3, 0.1, 1e-3, -1e-3, -0.01)],
)
def test_round_trip_of_a_strongly_distorted_lens(coefficients: tuple[float, ...]) -> None:
    lens = Lens(fx=350.0, fy=350.0, cx=360.0, cy=288.0, distortion=coefficients)
    d = directions_in_view(4000, 0.95 * min(max_angle(lens), 1.2))
    pixels, valid = lens.pixels(d)
    back, seen = lens.directions(pixels)
    assert valid.all()
    assert seen.all()
    unit = d / np.linalg.norm(d, axis=-1, keepdims=True)
    # At 95 % of the limit the map flattens and multiplies roundings by about 50.
    np.testing.assert_allclose(back, unit, rtol=0.0, atol=3e-14)


def test_pixel_jacobians_are_the_derivatives(lens: Lens) -> None:
    d = directions_in_view(60)
    pixels, valid, jacobian, by_parameter = bare(lens).project_with_parameter_jacobian(d)
    by_parameter = by_parameter[..., len(POSE_PARAMETERS) :]
    assert valid.all()
    np.testing.assert_allclose(pixels, lens.pixels(d)[0], rtol=0.0, atol=1e-12)
    numeric = central_difference(lambda x: lens.pixels(x)[0], d, 1e-6)
    assert relative_error(jacobian, numeric) < 1e-8
    assert by_parameter.shape == (60, 2, len(lens.parameter_names))
    values = np.array([lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion])

    def pixels_of(values: np.ndarray) -> np.ndarray:
        intrinsics = dict(zip(("fx", "fy", "cx", "cy"), values[:4].tolist(), strict=True))
        moved = Lens(model=lens.model, **intrinsics, distortion=tuple(values[4:].tolist()))
        return moved.pixels(d)[0]

    numeric = central_difference(pixels_of, values, 1e-5)
    assert relative_error(by_parameter, numeric) < 1e-7


def test_the_limit_is_where_the_radial_map_turns() -> None:
    lens = Lens(fx=500.0, fy=500.0, cx=0.0, cy=0.0, distortion=(-0.5, 0.0, 0.0, 0.0))
    # r (1 - r^2/2) grows up to r^2 = 2/3, where it is 0.5443.
    assert max_angle(lens) == pytest.approx(np.arctan(np.sqrt(2.0 / 3.0)), abs=1e-12)
    turn = 500.0 * np.sqrt(2.0 / 3.0) * (2.0 / 3.0)
    pixels = np.array([[0.999 * turn, 0.0], [1.001 * turn, 0.0], [0.0, -2.0 * turn]])
    d, valid = lens.directions(pixels)
    np.testing.assert_array_equal(valid, [True, False, False])
    assert np.isnan(d[1:]).all()
    np.testing.assert_allclose(lens.pixels(d[:1])[0], pixels[:1], atol=1e-11)
    # Beyond the turn a direction would land on a pixel that already belongs to another.
    seen, valid = lens.pixels([[0.81, 0.0, 1.0], [0.82, 0.0, 1.0], [1.2, 0.0, 1.0]])
    np.testing.assert_array_equal(valid, [True, False, False])
    assert np.isnan(seen[1:]).all()


@pytest.mark.parametrize(
    ("coefficients", "turn"),
    [
        # r (1 - r^2/2 + r^4/10) rises to 0.6 at r = 1, falls to 0.566 at r = sqrt 2, rises again.
        ((-0.5, 0.1, 0.0, 0.0), 1.0),
        # Here Newton's method, left alone, ends on the branch beyond the image centre.
        ((0.181, 0.652, 0.0, 0.0, -0.633), 1.0271),
        ((0.516, 0.081, 0.0, 0.0, -0.701), 0.8932),
    ],
)
def test_pixels_that_only_another_branch_reaches_are_invalid(
    coefficients: tuple[float, ...], turn: float
) -> None:
    lens = Lens(fx=1.0, fy=1.0, cx=0.0, cy=0.0, distortion=coefficients)
    assert np.tan(max_angle(lens)) == pytest.approx(turn, rel=1e-3)
    top = np.linalg.norm(lens.pixels([(1.0 - 1e-9) * np.tan(max_angle(lens)), 0.0, 1.0])[0])
    share = np.append(np.linspace(0.8, 0.999, 200), np.linspace(1.001, 1.2, 400))
    pixels = top * share[:, None] * [0.6, -0.8]
    d, valid = lens.directions(pixels)
    np.testing.assert_array_equal(valid, share < 1.0)
    np.testing.assert_allclose(lens.pixels(d[valid])[0], pixels[valid], rtol=0.0, atol=1e-14)


def test_the_limit_is_the_largest_disc_of_positive_determinant() -> None:
    # Decentring so strong that the fold is nearer on one side than on the other.
    lens = Lens(fx=1.0, fy=1.0, cx=0.0, cy=0.0, distortion=(-0.3, 0.0, 0.03, -0.02))
    phi = np.linspace(0.0, 2.0 * np.pi, 2000)
    radius = 0.999 * np.tan(max_angle(lens))
    d = np.stack([radius * np.cos(phi), radius * np.sin(phi), np.ones_like(phi)], axis=-1)
    _, valid, jacobian = bare(lens).project_with_jacobian(d)
    assert valid.all()
    determinant = np.linalg.det(jacobian[..., :2])
    assert (determinant > 0.0).all()
    # On the nearest side the determinant has almost reached zero, on the farthest not.
    assert determinant.min() < 5e-3 < 0.1 < determinant.max()
    assert not lens.pixels(d * [1.002, 1.002, 1.0])[1].any()


def test_behind_the_camera_is_invalid_for_opencv_only() -> None:
    behind = [[0.1, 0.2, -1.0], [0.3, 0.0, 0.0], [0.0, 0.0, 0.0]]
    pixels, valid = PAPER_LENS.pixels(behind)
    assert not valid.any()
    assert np.isnan(pixels).all()
    # 110 degrees off the axis is ordinary for a fisheye.
    wide = np.array([np.sin(np.deg2rad(110.0)), 0.0, np.cos(np.deg2rad(110.0))])
    pixels, valid = FISHEYE_LENS.pixels(wide)
    assert valid
    np.testing.assert_allclose(FISHEYE_LENS.directions(pixels)[0], wide, rtol=0.0, atol=1e-14)


def test_fisheye_ends_where_its_polynomial_turns() -> None:
    lens = Lens(
        model=LensModel.FISHEYE, fx=300.0, fy=300.0, cx=0.0, cy=0.0, distortion=(-0.1, 0, 0, 0)
    )
    # theta - theta^3/10 grows up to sqrt(10/3).
    assert max_angle(lens) == pytest.approx(np.sqrt(10.0 / 3.0), abs=1e-12)
    top = 300.0 * np.sqrt(10.0 / 3.0) * (2.0 / 3.0)
    np.testing.assert_array_equal(lens.directions([[0.99 * top, 0], [1.01 * top, 0]])[1], [1, 0])


def test_nan_in_gives_invalid_out(lens: Lens) -> None:
    d, valid = lens.directions([[np.nan, 3.0], [300.0, 200.0]])
    np.testing.assert_array_equal(valid, [False, True])
    assert np.isnan(d[0]).all()
    pixels, valid = lens.pixels([[np.nan, 0.0, 1.0], [np.inf, 0.0, 1.0]])
    assert not valid.any()
    assert np.isnan(pixels).all()


def test_shapes_follow_the_batch() -> None:
    d, valid = PAPER_LENS.directions([300.0, 200.0])
    assert (d.shape, valid.shape) == ((3,), ())
    d, valid = PAPER_LENS.directions(np.empty((0, 2)))
    assert (d.shape, valid.shape) == ((0, 3), (0,))
    with pytest.raises(ValueError, match="pixels has shape"):
        PAPER_LENS.directions([1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fx": 0.0}, "focal lengths fx = 0"),
        ({"cy": float("nan")}, "finite"),
        ({"distortion": (0.1, 0.2)}, "2 distortion coefficients.*0 or 4 or 5 or 8"),
        ({"model": LensModel.FISHEYE, "distortion": (0.0,) * 5}, "fisheye model takes 0 or 4"),
    ],
)
def test_impossible_lenses_are_refused(change: dict[str, object], words: str) -> None:
    with pytest.raises(RigError, match=words):
        Lens(**(INTRINSICS | change))
