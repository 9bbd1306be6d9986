"""Intrinsics from simulated boards: recovery, honesty, and refusals."""

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest

from aqualvs.calibration.camera.calibrate import COVERAGE_CELLS, CameraCalibration, camera, coverage
from aqualvs.calibration.camera.problem import fitted_camera, gain_of_coefficients
from aqualvs.calibration.targets.targets import View
from aqualvs.errors import CalibrationError, RigError
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.camera import Camera
from aqualvs.optics.lens import Lens, LensModel
from dome_cases import board_points, see
from whole import WHOLE

SIZE = (720, 576)
FOUR = (-0.126, 0.0827, 6.2e-4, -4.5e-4)
LENS = Lens(fx=817.5, fy=878.0, cx=368.9, cy=281.7, distortion=FOUR)
FISHEYE = Lens(
    model=LensModel.FISHEYE,
    fx=310.0,
    fy=312.0,
    cx=362.0,
    cy=290.0,
    distortion=(-0.012, 0.004, -0.0021, 0.0003),
)


def _shots(
    lens: Lens = LENS,
    seed: int = 1,
    n: int = 14,
    *,
    tilt: float = 0.4,
    noise_px: float = 0.1,
    distance: tuple[float, float] = (0.3, 0.6),
) -> list[View]:
    """Return views of a board of 11 x 8 corners, all over the picture."""
    rng = np.random.default_rng(seed)
    points, seer = board_points(11, 8, 0.024), _camera(lens)
    views = []
    for i in range(n):
        turn = rotation_from_rotvec(rng.normal(0.0, tilt, 3))
        ahead = seer.rays(np.array(SIZE) * rng.uniform(0.25, 0.75, 2)).directions
        middle = ahead * rng.uniform(*distance)
        pose = SE3(turn, middle - turn @ points.mean(axis=0))
        views.append(see(seer, pose, points, rng, name=f"v{i}", noise_px=noise_px, at_most=80))
    return views


def _camera(lens: Lens) -> Camera:
    return Camera(size_px=SIZE, lens=lens, dome_from_cam=SE3.identity())


def _numbers(lens: Lens, n: int) -> np.ndarray:
    return np.array([lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion, *(0.0,) * 8])[:n]


def _normalised(found: CameraCalibration, true: Lens) -> np.ndarray:
    sigma = np.sqrt(np.diag(found.uncertainty.covariance))
    n = len(sigma)
    return (_numbers(found.lens, n) - _numbers(true, n)) / sigma


def test_recovers_the_intrinsics_and_their_uncertainty() -> None:
    errors, noise = [], []
    for seed in range(8 if WHOLE else 5):
        found = camera(_shots(seed=seed), SIZE)
        assert len(found.lens.distortion) == 4
        errors.append(_normalised(found, LENS))
        noise.append(found.noise_px)
    # 40 normalised errors, correlated in places: 1 ± 0.15.
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.35
    assert np.mean(noise) == pytest.approx(0.1, rel=0.04)


def test_reports_what_a_user_wants_to_know() -> None:
    found = camera(_shots(), SIZE)
    # Two coordinates of 0.1 px, less what 8 + 14 x 6 numbers take up of 2 x 1000.
    assert found.rms_px == pytest.approx(0.1 * np.sqrt(2.0), rel=0.07)
    assert found.cross_validation_rms_px == pytest.approx(0.1 * np.sqrt(2.0), rel=0.2)
    assert found.coverage.shape == COVERAGE_CELLS
    assert found.coverage.sum() == found.n_points
    assert len(found.views) == 14
    assert not found.left_out
    text = "\n".join(found.findings)
    assert "focal lengths: 81" in text
    assert "4 coefficients of the opencv model" in text
    assert "held out" in text


@pytest.mark.parametrize("distortion", [(), FOUR, (*FOUR, 0.25)])
def test_takes_as_many_coefficients_as_there_are(distortion: tuple[float, ...]) -> None:
    true = replace(LENS, distortion=distortion)
    found = camera(_shots(true, seed=3, n=20, noise_px=0.03), SIZE)
    assert len(found.lens.distortion) == len(distortion)
    assert np.abs(_normalised(found, true)).max() < 4.0


@pytest.mark.parametrize("distortion", [FOUR, (0.0,) * 4])
def test_superfluous_coefficients_promise_nothing(distortion: tuple[float, ...]) -> None:
    """The three of the rational model do next to nothing that five cannot, in a narrow view."""
    true = replace(LENS, distortion=distortion)
    for seed in range(3):
        views = _shots(true, seed=seed, n=20, tilt=0.2, noise_px=1e-3, distance=(0.5, 0.9))
        bundle, solution = fitted_camera(views, SIZE, LensModel.OPENCV, 5)
        promised = gain_of_coefficients(bundle, solution, 8)
        # Chance alone gives three, seldom more than 16.
        assert 0.0 <= promised < 16.0


def test_takes_the_rational_model_for_a_wide_lens() -> None:
    rational = (5.2, 1.9, 1e-4, -2e-4, 0.03, 5.5, 3.4, 0.36)
    true = Lens(fx=330.0, fy=332.0, cx=362.0, cy=290.0, distortion=rational)
    found = camera(_shots(true, seed=1, n=10, noise_px=0.05, distance=(0.1, 0.25)), SIZE)
    assert len(found.lens.distortion) == 8
    assert found.noise_px == pytest.approx(0.05, rel=0.1)


def test_takes_the_number_that_it_is_told() -> None:
    found = camera(_shots(), SIZE, n_coefficients=5)
    assert len(found.lens.distortion) == 5
    # k3 is not there, and its uncertainty says so.
    assert abs(_normalised(found, LENS)[8]) < 3.0


@pytest.mark.parametrize("n_coefficients", [3, -1])
def test_refuses_a_number_of_coefficients_that_no_lens_has(n_coefficients: int) -> None:
    with pytest.raises(RigError, match="takes 0 or 4 or 5 or 8"):
        camera(_shots(), SIZE, n_coefficients=n_coefficients)


def test_solves_a_fisheye_lens() -> None:
    views = _shots(FISHEYE, seed=4, n=10, distance=(0.12, 0.3))
    found = camera(views, SIZE, model=LensModel.FISHEYE)
    assert found.lens.model is LensModel.FISHEYE
    assert np.abs(_normalised(found, FISHEYE)).max() < 4.0
    assert found.noise_px == pytest.approx(0.1, rel=0.1)


def test_a_model_that_does_not_fit_a_fisheye_lens_is_named() -> None:
    with pytest.raises(CalibrationError, match=r"come to rest; try --model fisheye, or take more"):
        camera(_shots(FISHEYE, n=10, distance=(0.12, 0.3)), SIZE)


def test_outlying_corners_and_views_are_named() -> None:
    views, rng = _shots(), np.random.default_rng(5)
    views[3].pixels[:6] += rng.uniform(3.0, 9.0, (6, 2))
    views[7].pixels[:] += rng.normal(0.0, 1.5, views[7].pixels.shape)
    found = camera(views, SIZE)
    assert set(found.left_out) == {"v7"}
    fit = next(v for v in found.views if v.label == "v3")
    assert not fit.inliers[:6].any()
    assert fit.inliers[6:].all()
    text = "\n".join(found.findings)
    assert "left out, v7" in text
    assert "v3: 6 of its" in text
    assert np.abs(_normalised(found, LENS)).max() < 4.0


@pytest.mark.parametrize("turned", [(4,), range(0, 12, 2)])
def test_pictures_turned_by_half_a_turn_are_named(turned: Iterable[int]) -> None:
    """Their corners fit ten times worse than the others', by too little to leave all out."""
    views = _shots(noise_px=0.01)
    for i in turned:
        views[i] = replace(views[i], pixels=np.array(SIZE) - 1.0 - views[i].pixels)
    named = [words for words in camera(views, SIZE).findings if "upside down" in words]
    assert len(named) == 1
    assert any(f"v{i} (" in named[0] for i in turned)


def test_tells_where_the_picture_was_not_covered() -> None:
    views = []
    for view in _shots(n=20):
        left = view.where(view.pixels[:, 0] < 300.0)
        if len(left) >= 12:
            views.append(left)
    found = camera(views, SIZE)
    assert found.coverage[:, 5:].sum() == 0
    text = "\n".join(found.findings)
    assert "show the board in all parts" in text
    assert "the intrinsics are uncertain by" in text


def test_where_the_model_does_not_reach_a_fisheye_model_is_named() -> None:
    found = camera(_shots(FISHEYE, seed=5, n=10), SIZE)
    text = "\n".join(found.findings)
    assert "does not reach all corners of the picture; try --model fisheye" in text


def test_coverage_counts_border_pixels() -> None:
    corners = np.array([[-0.5, -0.5], [719.4, 575.4], [719.4, 0.0]])
    counts = coverage(corners, SIZE)
    assert counts[0, 0] == counts[-1, -1] == counts[0, -1] == 1
    assert counts.sum() == 3


def _fewer(views: list[View]) -> list[View]:
    return views[:2]


def _parallel(_views: list[View]) -> list[View]:
    return _shots(tilt=0.0)


def _same(views: list[View]) -> list[View]:
    return [replace(views[0], name=f"v{i}") for i in range(6)]


def _other_board(views: list[View]) -> list[View]:
    """Corners counted along rows of 10, where the print has 11."""
    points = board_points(10, 9, 0.024)
    return [View(v.name, v.ids, points[v.ids], v.pixels) for v in views[:3]]


def _in_metres(views: list[View]) -> list[View]:
    """Squares of 24 mm, written as 0.024 mm."""
    return [View(v.name, v.ids, 1e-3 * v.points, v.pixels) for v in views]


def _in_micrometres(views: list[View]) -> list[View]:
    return [View(v.name, v.ids, 1e3 * v.points, v.pixels) for v in views]


def _other_size(views: list[View]) -> list[View]:
    return [*views[:-1], View("big", views[0].ids, views[0].points, 2.0 * views[0].pixels)]


def _few_corners(views: list[View]) -> list[View]:
    return [v.where(np.arange(len(v)) < 6) for v in views[:5]]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_fewer, "pictures that show the board: 2; the camera needs 3"),
        (_few_corners, "board corners in all pictures together: 30"),
        (_parallel, "focal length .* parallel within .* tilt the board by 20 to 40"),
        (_same, "do not determine the (focal length|principal point)"),
        (_other_board, "no camera (explains|can have taken)"),
        (_in_metres, "would stand 0.* mm away; is square_mm in its file in millimetres"),
        (_in_micrometres, "would stand .*e\\+05 mm away; is square_mm"),
        (_other_size, "big: corners outside a picture of 720x576"),
    ],
)
def test_refuses_what_determines_nothing(
    spoil: Callable[[list[View]], list[View]], message: str
) -> None:
    with pytest.raises(CalibrationError, match=message):
        camera(spoil(_shots()), SIZE)
