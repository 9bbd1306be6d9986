"""Sigmas of the intrinsics that survive halves of the views, and boards that are not flat."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from aqualvs.calibration.camera.calibrate import camera
from aqualvs.calibration.camera.problem import fitted_camera
from aqualvs.calibration.solver.covariance import shared_covariance
from aqualvs.calibration.targets.targets import View
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.camera import Camera
from aqualvs.optics.lens import Lens, LensModel
from dome_cases import board_points, see
from whole import WHOLE

SIZE = (720, 576)
LENS = Lens(fx=817.5, fy=878.0, cx=368.9, cy=281.7, distortion=(-0.126, 0.0827, 6.2e-4, -4.5e-4))
NAMES = ("fx", "fy", "cx", "cy")
N_VIEWS = 28
N_SEEDS = 10 if WHOLE else 5
POINTS = board_points(11, 8, 0.024)
MIDDLE = POINTS.mean(axis=0)
# From the middle to the short sides.
HALF = 0.12


def _bent(bend: FloatArray) -> FloatArray:
    """Corners of a board bent by so many metres at its short sides: x², xy, y², x³."""
    x, y = (POINTS - MIDDLE)[:, :2].T / HALF
    z = np.stack([x * x, x * y, y * y, x**3], axis=-1)[:, : len(bend)] @ bend
    return POINTS + np.stack([0.0 * z, 0.0 * z, z], axis=-1)


def _views(seed: int, bend: Callable[[], FloatArray], n: int = N_VIEWS) -> list[View]:
    """Views of a board all over the picture; `bend` is asked for each."""
    rng = np.random.default_rng(seed)
    seer = Camera(size_px=SIZE, lens=LENS, dome_from_cam=SE3.identity())
    views = []
    for i in range(n):
        turn = rotation_from_rotvec(rng.normal(0.0, 0.4, 3))
        ahead = seer.rays(np.array(SIZE) * rng.uniform(0.25, 0.75, 2)).directions
        pose = SE3(turn, ahead * rng.uniform(0.3, 0.6) - turn @ MIDDLE)
        seen = see(seer, pose, _bent(bend()), rng, name=f"v{i}", noise_px=0.1, at_most=80)
        views.append(replace(seen, points=POINTS[seen.ids]))
    return views


def _flat() -> FloatArray:
    return np.zeros(3)


def _clean(seed: int) -> list[View]:
    return _views(seed, _flat)


def _moved(seed: int) -> list[View]:
    """Row by row exposed, while the camera moves and is jerked: differently in each view."""
    rng = np.random.default_rng(1000 + seed)
    views = []
    for view in _views(seed, _flat):
        late = (view.pixels[:, 1] / SIZE[1] - 0.5)[:, None]
        pixels = view.pixels + late * rng.normal(0.0, 1.5, 2) + late**2 * rng.normal(0.0, 1.5, 2)
        inside = np.all((pixels > 0.0) & (pixels < np.array(SIZE) - 1.0), axis=1)
        views.append(replace(view, pixels=pixels).where(inside))
    return views


def _flexed(seed: int) -> list[View]:
    """A sheet that is held by hand: bent differently in each view."""
    rng = np.random.default_rng(1000 + seed)
    return _views(seed, lambda: rng.normal(0.0, 1e-3, 3))


def _rms(values: list[FloatArray]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(
    ("shoot", "before"), [(_clean, (0.7, 1.4)), (_moved, (3.0, 9.0)), (_flexed, (3.0, 9.0))]
)
def test_halves_of_the_views_differ_by_their_sigmas(
    shoot: Callable[[int], list[View]], before: tuple[float, float]
) -> None:
    by_corners, by_views, larger = [], [], []
    for seed in range(N_SEEDS):
        halves = []
        views = shoot(seed)
        for half in (views[::2], views[1::2]):
            bundle, solution = fitted_camera(half, SIZE, LensModel.OPENCV, 4)
            lens = solution.state.rig.lens
            numbers = np.array([*(getattr(lens, name) for name in NAMES), *lens.distortion])
            found = shared_covariance(bundle, solution)
            halves.append((numbers, np.diag(found.by_corners), np.diag(found.by_views)))
            larger.append(np.sqrt(np.diag(found.by_views) / np.diag(found.by_corners)))
        (a, a_corners, a_views), (b, b_corners, b_views) = halves
        by_corners.append((a - b) / np.sqrt(a_corners + b_corners))
        by_views.append((a - b) / np.sqrt(a_views + b_views))
    # 40 differences or more, correlated in places: 1 ± 0.22.
    assert 0.7 < _rms(by_views) < 1.4
    assert before[0] < _rms(by_corners) < before[1]
    if shoot is _clean:
        # Fourteen views tell their scatter to 20 %, smoothed over the parameters to less.
        assert 0.99 < np.mean(larger) < 1.2


def test_few_views_promise_no_more_than_they_hold() -> None:
    """Six views; none of the sigmas may be small by chance."""
    errors = []
    for seed in range(N_SEEDS if WHOLE else 3):
        moved = _moved(seed)
        for part in range(4):
            views = moved[part : part + 21 : 4]
            bundle, solution = fitted_camera(views, SIZE, LensModel.OPENCV, 4)
            sigma = np.sqrt(np.diag(shared_covariance(bundle, solution).by_views))[:4]
            lens = solution.state.rig.lens
            errors.append(np.array([getattr(lens, n) - getattr(LENS, n) for n in NAMES]) / sigma)
    assert _rms(errors) < 1.4


# One of third degree, and a slight one.
BENDS = [(-0.2e-3, 0.1e-3, 0.0, 1e-3), (0.2e-3, 0.0, 0.0, 0.0)]
if WHOLE:
    BENDS.append((0.9e-3, 0.2e-3, -0.4e-3, 0.0))


@pytest.mark.parametrize("bend", BENDS)
def test_a_bent_board_is_recognised_and_solved_for(bend: tuple[float, ...]) -> None:
    bent = _bent(np.array(bend))
    plane = np.column_stack([bent[:, :2], np.ones(len(bent))])
    height = np.ptp(bent[:, 2] - plane @ np.linalg.lstsq(plane, bent[:, 2], rcond=None)[0])
    errors = []
    for seed in range(4 if WHOLE else 3):
        found = camera(_views(seed, lambda: np.array(bend), n=16), SIZE)
        assert found.bend_height == pytest.approx(height, rel=0.05, abs=2e-5)
        assert found.noise_px == pytest.approx(0.1, rel=0.06)
        assert "the board is not flat" in "\n".join(found.findings)
        sigmas = found.uncertainty.sigmas
        errors.append([(getattr(found.lens, n) - getattr(LENS, n)) / sigmas[n] for n in NAMES])
    # 12 errors or more, of pairs that go together: 1 ± 0.3.
    assert 0.4 < _rms(errors) < 1.6


def test_a_flat_board_is_left_flat() -> None:
    """Also where views share errors, which a bend that is common to all could seem to explain."""
    for seed in range(5 if WHOLE else 1):
        for shoot in (_clean, _moved):
            found = camera(shoot(seed), SIZE)
            assert found.bend_height == 0.0
            assert "not flat" not in "\n".join(found.findings)
    assert "views disagree more than their corners' noise explains" in "\n".join(found.findings)
