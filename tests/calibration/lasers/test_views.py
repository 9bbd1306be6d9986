"""The paper's pose in the box, against reprojection."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.calibration.lasers.views import planes_with_points, pose_difference, spatial_pose
from aqualvs.calibration.solver.bundle import moved_target
from aqualvs.errors import CalibrationError
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.simulation.scenarios import example_rig
from laser_cases import BOX_PLANES, Noise, box_views, dome_from_box

RIG = example_rig()


def moved(pose: SE3) -> SE3:
    return moved_target(pose, np.zeros(3), np.array([0.05, -0.03, 0.04, 0.02, -0.01, 0.03]))


@pytest.mark.parametrize("i", range(3))
def test_without_noise_the_pose_is_exact(i: int) -> None:
    view, pose = box_views(RIG)[i].view, dome_from_box(i)
    found = spatial_pose(RIG.camera(), view, moved(pose))
    angle, shift = pose_difference(found, pose, view.points.mean(axis=0))
    assert angle < 1e-9
    assert shift < 1e-9


def test_the_pose_minimises_the_papers_cost() -> None:
    """Eq. 32 is evaluated as printed, with lambda by its own least squares."""
    view = box_views(RIG, noise=Noise(corner_px=0.5))[0].view
    found = spatial_pose(RIG.camera(), view, moved(dome_from_box(0)))
    rays = RIG.camera().rays(view.pixels)
    box_from_dome = found.inverse()
    s, r = box_from_dome.translation, box_from_dome.rotation
    total = 0.0
    for p, origin, direction in zip(view.points, rays.origins, rays.directions, strict=True):
        offset = -p + s + r @ origin
        # d/d lambda of |offset + lambda R n|^2 = 0.
        distance = -float(offset @ (r @ direction))
        total += float(np.sum((offset + distance * (r @ direction)) ** 2))
    for step in np.vstack([np.eye(6), -np.eye(6)]) * 1e-4:
        # It is a minimum: a ray behind which the pose is moved costs more.
        there = moved_target(found, view.points.mean(axis=0), step)
        in_dome = there.apply(view.points)
        along = np.sum((in_dome - rays.origins) * rays.directions, axis=1)
        beside = in_dome - rays.origins - along[:, None] * rays.directions
        assert np.sum(beside**2) > total


def test_three_corners_are_the_least() -> None:
    view = box_views(RIG)[0].view
    two = view.where(np.arange(len(view)) < 2)
    with pytest.raises(CalibrationError, match=r"view_0\.png: 2 corners"):
        spatial_pose(RIG.camera(), two, dome_from_box(0))


def test_planes_are_told_by_their_points() -> None:
    view = box_views(RIG)[0].view
    planes = list(BOX_PLANES.values())
    seen = planes_with_points(view, planes)
    assert 2 in seen
    assert len(seen) >= 2
    forward = view.where(np.abs(view.points[:, 1] - 0.7) < 1e-9)
    assert planes_with_points(forward, planes) == (2,)


def test_differences_of_poses() -> None:
    pose = dome_from_box(1)
    turn = rotation_from_rotvec((0.0, 0.0, 1e-6))
    turned = replace(pose, rotation=turn @ pose.rotation)
    angle, shift = pose_difference(pose, turned, np.array([0.3, 0.0, 0.0]))
    assert angle == pytest.approx(1e-6, rel=1e-6)
    assert shift == pytest.approx(3e-7, rel=1e-3)
