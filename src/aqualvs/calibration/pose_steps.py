"""Small changes of a target's pose, in which poses are solved and their covariance is told."""

from collections.abc import Sequence

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec, skew


def moved_target(pose: SE3, middle: FloatArray, step: FloatArray) -> SE3:
    """Return `dome_from_target` turned about a point of the target, then shifted.

    Parameters
    ----------
    pose : SE3
    middle : array, shape (3,)
        In the target's frame; stays in its place under the turn.
    step : array, shape (6,)
        Rotation vector (radians) and shift (metres), both in `dome`.
    """
    return _moved(pose, middle, rotation_from_rotvec(step[:3]), step[3:])


def moved_targets(
    poses: Sequence[SE3], middles: Sequence[FloatArray], steps: FloatArray
) -> list[SE3]:
    """Return several poses, each moved by its own of the steps (N, 6), as `moved_target` does."""
    turns = rotation_from_rotvec(steps[:, :3])
    moves = zip(poses, middles, turns, steps[:, 3:], strict=True)
    return [_moved(pose, middle, turn, shift) for pose, middle, turn, shift in moves]


def _moved(pose: SE3, middle: FloatArray, turn: FloatArray, shift: FloatArray) -> SE3:
    arm = pose.rotation @ middle
    # The middle lies at arm + translation, and stays there under the turn.
    return SE3(turn @ pose.rotation, arm - turn @ arm + pose.translation + shift)


def point_by_pose(points_in_dome: FloatArray, centre: FloatArray) -> FloatArray:
    """Return the derivative (N, 3, 6) of points by the step of `moved_target` at zero.

    Parameters
    ----------
    points_in_dome : array, shape (N, 3)
        Points of the target.
    centre : array, shape (3,)
        What the target turns about, in `dome`.
    """
    by_pose = np.zeros((len(points_in_dome), 3, 6))
    by_pose[:, :, :3] = -skew(points_in_dome - centre)
    by_pose[:, :, 3:] = np.eye(3)
    return by_pose
