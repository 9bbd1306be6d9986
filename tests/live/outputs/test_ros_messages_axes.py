"""Axes of ROS and MAVLink, and the target's plane as a pose with covariance."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from aqualvs.geometry.arrays import FloatArray
from aqualvs.live.outputs.ros_messages import (
    UNOBSERVABLE_VARIANCE,
    flu_angles,
    flu_from_dome,
    plane_pose,
    pose_jacobian,
)
from aqualvs.scanning.posture import range_pitch_yaw

RIGHT, FORWARD, UP = np.eye(3)
FLU_FROM_DOME = np.array([FORWARD, -RIGHT, UP])
angles = st.floats(-1.2, 1.2)
ranges = st.floats(0.1, 5.0)


def normal_in_dome(pitch: float, yaw: float) -> FloatArray:
    """Unit normal of the target's plane, by the definition of pitch and yaw."""
    normal = np.array([math.tan(yaw), 1.0, math.tan(pitch)])
    return normal / np.linalg.norm(normal)


def pose_parameters(distance: float, pitch: float, yaw: float) -> FloatArray:
    """(x, y, z, roll, pitch, yaw) in FLU by SciPy, from the posture's definition alone."""
    foot = FLU_FROM_DOME @ (distance * normal_in_dome(pitch, yaw))
    turn = Rotation.from_quat(plane_pose(distance, pitch, yaw, np.eye(3)).quaternion)
    return np.concatenate([foot, turn.as_euler("xyz")])


def test_body_axes() -> None:
    assert flu_from_dome([FORWARD, -RIGHT, UP]).tolist() == np.eye(3).tolist()


def test_matrices_agree_with_functions_and_are_rotations() -> None:
    points = np.random.default_rng(1).normal(size=(4, 5, 3))
    assert np.array_equal(flu_from_dome(points), points @ FLU_FROM_DOME.T)
    assert np.linalg.det(FLU_FROM_DOME) == pytest.approx(1.0)


@given(distance=ranges, pitch=angles, yaw=angles)
def test_normal_inverts_the_posture(distance: float, pitch: float, yaw: float) -> None:
    found = range_pitch_yaw(normal_in_dome(pitch, yaw) / distance)
    assert found == pytest.approx((distance, pitch, yaw), rel=1e-12, abs=1e-12)


def test_square_to_the_target_is_identity() -> None:
    pose = plane_pose(0.7, 0.0, 0.0, np.zeros((3, 3)))
    assert pose.position.tolist() == [0.7, 0.0, 0.0]
    assert pose.quaternion.tolist() == pytest.approx([0.0, 0.0, 0.0, 1.0])


def test_signs() -> None:
    # Posture: positive yaw is a far normal to the right, positive pitch one that points up.
    right = plane_pose(1.0, 0.0, 0.2, np.zeros((3, 3)))
    assert right.position[1] < 0.0
    assert flu_angles(0.0, 0.2)[1] == -0.2
    up = plane_pose(1.0, 0.2, 0.0, np.zeros((3, 3)))
    assert up.position[2] > 0.0
    assert flu_angles(0.2, 0.0)[0] == pytest.approx(-0.2)


@given(distance=ranges, pitch=angles, yaw=angles)
def test_orientation(distance: float, pitch: float, yaw: float) -> None:
    pose = plane_pose(distance, pitch, yaw, np.eye(3))
    axes = Rotation.from_quat(pose.quaternion).as_matrix()
    normal = FLU_FROM_DOME @ normal_in_dome(pitch, yaw)
    np.testing.assert_allclose(axes[:, 0], normal, atol=1e-12)
    np.testing.assert_allclose(pose.position, distance * normal, atol=1e-12)
    assert axes[2, 1] == pytest.approx(0.0, abs=1e-12)
    assert axes[1, 1] > 0.0
    roll, turn_pitch, turn_yaw = Rotation.from_quat(pose.quaternion).as_euler("xyz")
    assert (turn_pitch, turn_yaw) == pytest.approx(flu_angles(pitch, yaw), abs=1e-12)
    assert roll == pytest.approx(0.0, abs=1e-12)


@given(distance=ranges, pitch=angles, yaw=angles)
def test_jacobian_by_finite_differences(distance: float, pitch: float, yaw: float) -> None:
    values = np.array([distance, pitch, yaw])
    step = 1e-6
    numeric = np.column_stack(
        [
            (pose_parameters(*(values + step * e)) - pose_parameters(*(values - step * e)))
            / (2.0 * step)
            for e in np.eye(3)
        ]
    )
    # Central differences: truncation and rounding are both below 1e-8 of derivatives up to 100.
    np.testing.assert_allclose(pose_jacobian(distance, pitch, yaw), numeric, atol=1e-6, rtol=1e-6)


def test_covariance_by_monte_carlo() -> None:
    mean = (0.8, 0.25, -0.4)
    sigma = np.array([0.004, 0.01, 0.015])
    correlation = np.array([[1.0, 0.3, -0.5], [0.3, 1.0, 0.2], [-0.5, 0.2, 1.0]])
    covariance = correlation * np.outer(sigma, sigma)
    rng = np.random.default_rng(7)
    draws = rng.multivariate_normal(mean, covariance, size=4000)
    spread = np.cov(np.array([pose_parameters(*draw) for draw in draws]).T)

    pose = plane_pose(*mean, covariance)
    axes = Rotation.from_quat(pose.quaternion).as_matrix()
    known = pose.covariance.copy()
    known[:3, :3] -= UNOBSERVABLE_VARIANCE * (axes[:, 1:] @ axes[:, 1:].T)
    known[3, 3] -= UNOBSERVABLE_VARIANCE
    # 4000 draws give variances to 2 %; what the plane's curvature in the angles adds is less.
    scale = np.sqrt(np.outer(np.diag(spread), np.diag(spread)))
    np.testing.assert_allclose(
        known[np.ix_([0, 1, 2, 4, 5], [0, 1, 2, 4, 5])],
        spread[np.ix_([0, 1, 2, 4, 5], [0, 1, 2, 4, 5])],
        atol=0.08 * scale.max(),
    )
    ratio = np.diag(known)[[0, 1, 2, 4, 5]] / np.diag(spread)[[0, 1, 2, 4, 5]]
    np.testing.assert_allclose(ratio, 1.0, atol=0.08)


@given(distance=ranges, pitch=angles, yaw=angles)
def test_only_the_normal_and_two_angles_are_known(
    distance: float, pitch: float, yaw: float
) -> None:
    sigma = np.diag([1e-3, 4e-3, 5e-3])
    pose = plane_pose(distance, pitch, yaw, sigma @ sigma)
    axes = Rotation.from_quat(pose.quaternion).as_matrix()
    in_target = axes.T @ pose.covariance[:3, :3] @ axes
    # The normal's variance is a difference of numbers of 1e4, hence good to 1e-11.
    assert in_target[0, 0] == pytest.approx(1e-6, abs=1e-10)
    assert in_target[1, 1] >= UNOBSERVABLE_VARIANCE
    assert in_target[2, 2] >= UNOBSERVABLE_VARIANCE
    assert pose.covariance[3, 3] == UNOBSERVABLE_VARIANCE
    assert not pose.covariance[3, :3].any()
    assert not pose.covariance[3, 4:].any()
    assert pose.covariance[5, 5] == pytest.approx(25e-6)
    # Invertible, as filters want it.
    assert np.linalg.eigvalsh(pose.covariance).min() > 1e-9
    np.testing.assert_array_equal(pose.covariance, pose.covariance.T)


def test_pitch_is_the_posture_s_where_yaw_is_nought() -> None:
    pitch, yaw = flu_angles(0.3, 0.0)
    assert (pitch, yaw) == pytest.approx((-0.3, 0.0))
    tilted, _ = flu_angles(0.3, 0.5)
    assert math.tan(tilted) == pytest.approx(-math.tan(0.3) * math.cos(0.5))
