"""Coordinate frames of the rig and of the target, as messages of TF.

    base_link -> aqualvs_dome -> aqualvs_camera_optical
                      |
                      +-------> aqualvs_target

Axes are those of REP-103 (x forward, y left, z up; the camera's `_optical` frame has z forward,
x right, y down), names those of REP-105. Where the vehicle is in `odom` or `map` is for others to
say: a plane tells the distance from it and two angles, no place.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import quaternion_from_rotation
from aqualvs.live.outputs.ros_messages import FLU_FROM_DOME, RosTypes, flu_from_dome, plane_pose
from aqualvs.optics.rig import Rig
from aqualvs.scanning.posture import Posture


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameNames:
    """Names of the frames, and the place of the dome on the vehicle.

    Attributes
    ----------
    base : str
        Frame of the vehicle; empty where others say where the dome is.
    dome, camera, target : str
    mount_xyz_m, mount_rpy_deg : sequence of 3 float
        Of the dome in `base`; angles about its fixed x, y and z axes.
    """

    base: str = ""
    dome: str = "aqualvs_dome"
    camera: str = "aqualvs_camera_optical"
    target: str = "aqualvs_target"
    mount_xyz_m: Sequence[float] = (0.0, 0.0, 0.0)
    mount_rpy_deg: Sequence[float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("mount_xyz_m", "mount_rpy_deg"):
            values = getattr(self, name)
            if len(values) != 3 or not np.isfinite(values).all():
                raise OptionError(f"{name} {list(values)}: give three finite numbers")


@dataclass(frozen=True, slots=True)
class FrameTransform:
    """Place of the frame `child` in `parent`: metres, and a quaternion (x, y, z, w)."""

    parent: str
    child: str
    position: FloatArray
    quaternion: Sequence[float]


def fixed_transforms(rig: Rig, names: FrameNames) -> list[FrameTransform]:
    """Return the transforms that do not change: dome on the vehicle, camera behind the dome."""
    pose = rig.dome_from_cam
    camera = FrameTransform(
        names.dome,
        names.camera,
        flu_from_dome(pose.translation),
        quaternion_from_rotation(FLU_FROM_DOME @ pose.rotation),
    )
    if not names.base:
        return [camera]
    roll, pitch, yaw = np.deg2rad(names.mount_rpy_deg)
    rotation = _about(2, yaw) @ _about(1, pitch) @ _about(0, roll)
    place = np.array(names.mount_xyz_m, np.float64)
    mount = FrameTransform(names.base, names.dome, place, quaternion_from_rotation(rotation))
    return [mount, camera]


def target_transform(posture: Posture, names: FrameNames) -> FrameTransform:
    """Return the place of the target: the foot of the perpendicular, x away along the normal."""
    pose = plane_pose(posture.range, posture.pitch, posture.yaw, posture.total_covariance)
    return FrameTransform(names.dome, names.target, pose.position, pose.quaternion.tolist())


def tf_message(types: RosTypes, stamp_ns: int, transforms: Sequence[FrameTransform]) -> Any:
    """Return transforms as `tf2_msgs/TFMessage`."""

    def stamped(one: FrameTransform) -> Any:
        make = types.make
        x, y, z = one.position.tolist()
        qx, qy, qz, qw = one.quaternion
        return make(
            "geometry_msgs/msg/TransformStamped",
            header=types.header(stamp_ns, one.parent),
            child_frame_id=one.child,
            transform=make(
                "geometry_msgs/msg/Transform",
                translation=make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
                rotation=make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
            ),
        )

    return types.make("tf2_msgs/msg/TFMessage", transforms=[stamped(one) for one in transforms])


def _about(axis: int, angle: float) -> FloatArray:
    turn = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turn[i, i] = turn[j, j] = np.cos(angle)
    turn[j, i], turn[i, j] = np.sin(angle), -np.sin(angle)
    return turn
