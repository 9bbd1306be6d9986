"""From the dome's axes to those of ROS and MAVLink, and the target's plane as a ROS pose.

=======  =======  =======  ====  ================================
frame    x        y        z     used by
=======  =======  =======  ====  ================================
dome     right    forward  up    the library
FLU      forward  left     up    ROS (REP-103), Foxglove
FRD      forward  right    down  MAVLink
=======  =======  =======  ====  ================================
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from aqualvs.geometry.arrays import FloatArray, as_vectors

FLU_FROM_DOME: FloatArray = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Rotation from `dome` to forward, left, up."""
FRD_FROM_DOME: FloatArray = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Rotation from `dome` to forward, right, down."""
FLU_FROM_DOME.flags.writeable = False
FRD_FROM_DOME.flags.writeable = False

UNOBSERVABLE_VARIANCE = 1.0e4
"""Variance, in m² and rad², of what a plane tells nothing about: 100 m, 100 rad."""


@dataclass(frozen=True, slots=True)
class PlanePose:
    """Pose of the target's plane in FLU axes at the dome's centre.

    Attributes
    ----------
    position : array, shape (3,)
        Foot of the perpendicular from the dome's centre, in metres.
    quaternion : array, shape (4,)
        Orientation as (x, y, z, w): x along the normal away from the vehicle, y horizontal to the
        left as the vehicle sees it, z up the plane. Identity where the vehicle looks squarely at
        the target.
    covariance : array, shape (6, 6)
        Of (x, y, z, roll, pitch, yaw) in FLU, m and rad, angles about fixed axes (REP-103).
    """

    position: FloatArray
    quaternion: FloatArray
    covariance: FloatArray


def flu_from_dome(vectors_in_dome: ArrayLike) -> FloatArray:
    """Return vectors (..., 3) of `dome` in forward, left, up."""
    vectors = as_vectors(vectors_in_dome, 3, "vectors_in_dome")
    return np.stack((vectors[..., 1], -vectors[..., 0], vectors[..., 2]), axis=-1)


def frd_from_dome(vectors_in_dome: ArrayLike) -> FloatArray:
    """Return vectors (..., 3) of `dome` in forward, right, down."""
    vectors = as_vectors(vectors_in_dome, 3, "vectors_in_dome")
    return np.stack((vectors[..., 1], vectors[..., 0], -vectors[..., 2]), axis=-1)


def normal_in_dome(pitch: float, yaw: float) -> FloatArray:
    """Return the unit normal (3,) in `dome` of a target plane before the vehicle.

    Parameters
    ----------
    pitch, yaw : float
        As in `Posture`, in radians, within a right angle.
    """
    x, z = math.tan(yaw), math.tan(pitch)
    return np.array([x, 1.0, z]) / math.sqrt(1.0 + x * x + z * z)


def flu_angles(pitch: float, yaw: float) -> tuple[float, float]:
    """Return pitch and yaw (rad) by which FLU axes turn until x is the target's normal.

    Positive yaw turns to the left, positive pitch turns downwards (REP-103): both signs are the
    opposite of the posture's. The posture's pitch is seen from the side, in the plane x = 0 of the
    dome; this one is measured from the horizontal: tan(pitch_flu) = -tan(pitch) cos(yaw).
    """
    return -math.atan(math.tan(pitch) * math.cos(yaw)), -yaw


def plane_pose(distance: float, pitch: float, yaw: float, covariance: FloatArray) -> PlanePose:
    """Return the pose of the target's plane.

    A plane has a place along its normal and two angles, no more. Along the plane and about its
    normal the covariance has `UNOBSERVABLE_VARIANCE`, so that an estimator that takes the pose for
    that of a fixed mark learns nothing from it there.

    Parameters
    ----------
    distance, pitch, yaw : float
        Range and angles as in `Posture`, in metres and radians.
    covariance : array, shape (3, 3)
        Of (range, pitch, yaw).
    """
    turn = flu_angles(pitch, yaw)
    rotation = _rotation(*turn)
    jacobian = pose_jacobian(distance, pitch, yaw)
    known = jacobian @ covariance @ jacobian.T
    along = rotation[:, 1:]
    known[:3, :3] += UNOBSERVABLE_VARIANCE * (along @ along.T)
    known[3, 3] += UNOBSERVABLE_VARIANCE
    return PlanePose(
        position=distance * rotation[:, 0],
        quaternion=_quaternion(*turn),
        covariance=0.5 * (known + known.T),
    )


def pose_jacobian(distance: float, pitch: float, yaw: float) -> FloatArray:
    """Return the derivative (6, 3) of (x, y, z, roll, pitch, yaw) in FLU by (range, pitch, yaw).

    Of the foot of the perpendicular, and of the fixed-axis angles of `plane_pose`, whose roll is
    zero by definition.
    """
    a, b = math.tan(yaw), math.tan(pitch)
    length = math.sqrt(1.0 + a * a + b * b)
    normal = np.array([1.0, -a, b]) / length
    across = np.eye(3) - np.outer(normal, normal)
    tilt = b * math.cos(yaw)
    jacobian = np.zeros((6, 3))
    jacobian[:3, 0] = normal
    jacobian[:3, 1] = distance / length * (1.0 + b * b) * across[:, 2]
    jacobian[:3, 2] = -distance / length * (1.0 + a * a) * across[:, 1]
    jacobian[4, 1] = -math.cos(yaw) * (1.0 + b * b) / (1.0 + tilt * tilt)
    jacobian[4, 2] = b * math.sin(yaw) / (1.0 + tilt * tilt)
    jacobian[5, 2] = -1.0
    return jacobian


def _rotation(pitch: float, yaw: float) -> FloatArray:
    """Return Rz(yaw) Ry(pitch)."""
    cp, sp, cy, sy = math.cos(pitch), math.sin(pitch), math.cos(yaw), math.sin(yaw)
    return np.array([[cy * cp, -sy, cy * sp], [sy * cp, cy, sy * sp], [-sp, 0.0, cp]])


def _quaternion(pitch: float, yaw: float) -> FloatArray:
    """Return Rz(yaw) Ry(pitch) as (x, y, z, w), w >= 0."""
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    return np.array([-sy * sp, cy * sp, sy * cp, cy * cp])
