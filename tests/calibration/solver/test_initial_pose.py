"""Poses of targets from one picture, with no starting values."""

import numpy as np
import pytest

from aqualvs.calibration.solver.bundle import point_by_pose
from aqualvs.calibration.solver.initial_pose import (
    TargetPose,
    square_rotation,
    start_pose,
    target_pose,
    thinned,
    turned_square,
)
from aqualvs.calibration.targets.targets import View
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec, rotvec_from_rotation
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig
from dome_cases import AIR, WATER, board_points, pose_difference, see

BOARD = board_points(10, 7, 0.024)
CAMERAS = {
    "behind a dome in air": example_rig().in_water(AIR).camera(),
    "behind a dome in water": bluerov2_rig().in_water(WATER).camera(),
    "bare": example_rig().bare_camera(),
}


def _box(rng: np.random.Generator) -> FloatArray:
    """Return corners on three planes of a box."""
    points = rng.uniform(-0.15, 0.15, (60, 3))
    points[::3, 1], points[1::3, 0], points[2::3, 2] = 0.15, 0.15, -0.15
    return points


def _placed(camera: Camera, points: FloatArray, rng: np.random.Generator) -> SE3:
    turn = rotation_from_rotvec(rng.normal(0.0, 0.3, 3)) @ DOME_FROM_CAM_NOMINAL
    middle_px = np.array(camera.size_px) * rng.uniform(0.4, 0.6, 2)
    middle = camera.rays(middle_px).directions * rng.uniform(0.4, 0.9)
    return SE3(turn, middle - turn @ points.mean(axis=0))


def _chi_squared(camera: Camera, found: TargetPose, true: SE3, view: View) -> float:
    """Return by how much a pose is off in sigmas that corners of 0.1 px leave at best, squared."""
    pose = found.dome_from_target
    points = pose.apply(view.points[found.inliers])
    by_pose = camera.project_with_jacobian(points)[2] @ point_by_pose(
        points, pose.apply(view.middle)
    )
    slopes = by_pose.reshape(-1, 6) / 0.1
    off = pose_difference(true, pose, view.middle)
    return float(np.sum((slopes @ off) ** 2))


@pytest.mark.parametrize("where", CAMERAS)
@pytest.mark.parametrize("shape", ["board", "box", "marker"])
@pytest.mark.parametrize("outliers", [0.0, 0.25])
def test_finds_the_pose_as_corners_allow(where: str, shape: str, outliers: float) -> None:
    if shape == "marker" and outliers:
        pytest.skip("four corners cannot tell which is wrong")
    camera, rng = CAMERAS[where], np.random.default_rng(1)
    squares, n = [], 12
    for _ in range(n):
        points = {"board": BOARD, "box": _box(rng), "marker": board_points(2, 2, 0.08)}[shape]
        pose = _placed(camera, points, rng)
        view = see(camera, pose, points, rng)
        bad = rng.permutation(len(view)) < outliers * len(view)
        view.pixels[bad] += rng.uniform(20.0, 200.0, (int(bad.sum()), 2))
        found = target_pose(camera, view)
        assert not found.inliers[bad].any()
        squares.append(_chi_squared(camera, found, pose, view))
    # 12 times 6 degrees of freedom: 72 ± 12.
    assert 36.0 < np.sum(squares) < 120.0


def test_more_noise_is_told() -> None:
    camera, rng = CAMERAS["bare"], np.random.default_rng(2)
    pose = _placed(camera, BOARD, rng)
    quiet, loud = (
        target_pose(camera, see(camera, pose, BOARD, rng, noise_px=s)) for s in (0.05, 0.5)
    )
    # Two coordinates of noise, less what the pose takes up.
    assert quiet.rms_px == pytest.approx(0.05 * np.sqrt(2.0), rel=0.2)
    assert loud.rms_px == pytest.approx(0.5 * np.sqrt(2.0), rel=0.2)


def test_far_small_targets_are_ambiguous_and_near_ones_are_not() -> None:
    camera, rng = CAMERAS["bare"], np.random.default_rng(3)
    marker = board_points(2, 2, 0.05)
    turn = rotation_from_rotvec([0.0, 0.0, 0.3]) @ DOME_FROM_CAM_NOMINAL
    near, far = (
        target_pose(camera, see(camera, SE3(turn, np.array([-0.02, y, 0.02])), marker, rng))
        for y in (0.25, 3.0)
    )
    assert not near.ambiguous
    assert far.ambiguous


@pytest.mark.parametrize("where", CAMERAS)
def test_a_start_that_is_known_roughly_ends_where_none_does(where: str) -> None:
    camera, rng = CAMERAS[where], np.random.default_rng(7)
    pose = _placed(camera, BOARD, rng)
    view = see(camera, pose, BOARD, rng)
    near = SE3(rotation_from_rotvec([0.05, -0.04, 0.03]), np.array([0.02, 0.03, -0.01])) @ pose
    found, without = target_pose(camera, view, start=near), target_pose(camera, view)
    # A step shorter than a fiftieth of a sigma ends the search.
    assert _chi_squared(camera, without, found.dome_from_target, view) < 0.05**2
    # Of a start that is far off, nothing is left.
    lost = target_pose(camera, view, start=SE3(pose.rotation, -pose.translation))
    assert _chi_squared(camera, without, lost.dome_from_target, view) < 0.05**2


def test_too_few_points_are_refused() -> None:
    camera, rng = CAMERAS["bare"], np.random.default_rng(4)
    view = see(camera, _placed(camera, BOARD, rng), BOARD, rng, at_most=3)
    with pytest.raises(CalibrationError, match="view: 3 points of the target"):
        target_pose(camera, view)


def test_points_on_a_line_are_refused() -> None:
    camera, rng = CAMERAS["bare"], np.random.default_rng(5)
    view = see(camera, _placed(camera, BOARD, rng), BOARD[:10], rng)
    with pytest.raises(CalibrationError, match="lie on one line"):
        target_pose(camera, view)


def test_another_target_is_refused() -> None:
    camera, rng = CAMERAS["bare"], np.random.default_rng(6)
    view = see(camera, _placed(camera, BOARD, rng), BOARD, rng)
    wrong = View(view.name, view.ids, rng.permutation(view.points), view.pixels)
    with pytest.raises(CalibrationError, match="no pose of the target explains"):
        target_pose(camera, wrong)
    with pytest.raises(CalibrationError, match="no pose of the target explains"):
        target_pose(camera, see(camera, _placed(camera, BOARD, rng), BOARD, rng), max_rms_px=1e-3)


def test_starts_bear_a_lens_that_is_far_off() -> None:
    rig, rng = example_rig(), np.random.default_rng(7)
    camera = rig.in_water(AIR).camera()
    pose = _placed(camera, BOARD, rng)
    view = see(camera, pose, BOARD, rng)
    wrong = rig.in_water(AIR).bare_camera()
    start = start_pose(wrong, view)
    assert not isinstance(start, str)
    off = pose_difference(pose, start.dome_from_target, view.middle)
    assert np.linalg.norm(off[:3]) < 0.1
    assert np.linalg.norm(off[3:]) < 0.05


def test_thinning_keeps_points_spread() -> None:
    view = View("v", np.arange(300), board_points(20, 15), np.zeros((300, 2)))
    few = thinned(view)
    assert len(few) == 48
    assert np.ptp(few.points[:, 0]) > 0.8 * np.ptp(view.points[:, 0])
    assert np.ptp(few.points[:, 1]) > 0.8 * np.ptp(view.points[:, 1])
    assert thinned(few) is few


@pytest.mark.parametrize("quarter", range(4))
def test_boards_may_stand_on_any_side(quarter: int) -> None:
    rng = np.random.default_rng(8)
    upright = rotation_from_rotvec([0.0, quarter * np.pi / 2.0, 0.0]) @ DOME_FROM_CAM_NOMINAL
    boards = [rotation_from_rotvec(rng.normal(0.0, 0.1, 3)) @ upright for _ in range(5)]
    np.testing.assert_allclose(square_rotation(boards), upright, atol=1e-12)


def test_the_square_majority_decides_the_turn() -> None:
    rig, rng = example_rig(), np.random.default_rng(9)
    turn = rotation_from_rotvec([0.05, -0.03, 0.02])
    poses = []
    for i in range(9):
        tilt = rng.uniform(-0.05, 0.05, 3) if i % 2 else rng.normal(0.0, 1e-4, 3)
        rotation = turn @ rotation_from_rotvec(tilt) @ DOME_FROM_CAM_NOMINAL
        poses.append(SE3(rotation, np.array([0.0, 0.5, 0.0])))
    moved, turned = turned_square(rig, poses, DOME_FROM_CAM_NOMINAL, range(9), 2e-3)
    expected = turn.T @ rig.dome_from_cam.rotation
    off = rotvec_from_rotation(moved.dome_from_cam.rotation @ expected.T)
    # One of the five good boards is taken as exactly square.
    assert np.linalg.norm(off) < 1e-3
    # Camera and boards turn together.
    before = rig.dome_from_cam.inverse() @ poses[3]
    after = moved.dome_from_cam.inverse() @ turned[3]
    np.testing.assert_allclose(after.translation, before.translation, atol=1e-12)
