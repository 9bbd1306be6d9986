"""What Foxglove's 3D panel shows beside the points: frames, target plane, laser lines."""

import math
from typing import TYPE_CHECKING

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import rotvec_from_rotation
from aqualvs.live.recorder.messages import FRAME_ID
from aqualvs.optics.rig import Laser, Rig
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.scan import Scan, ScanPoints

if TYPE_CHECKING:
    from foxglove.messages import (
        CubePrimitive,
        FrameTransform,
        FrameTransforms,
        LinePrimitive,
        Pose,
        Quaternion,
        SceneUpdate,
        TextPrimitive,
        Timestamp,
        Vector3,
    )

VEHICLE = "vehicle"
"""Axes of REP-103: x forward, y left, z up, as 3D views expect them; origin as `dome`."""

_VEHICLE_FROM_DOME: FloatArray = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_LIFETIME_S = 0.5
# Sides of the square that stands for the target, as a share of its range.
_SIDE_SHARE = 1.0
_GREEN, _BLUE = (0.1, 1.0, 0.3, 1.0), (0.2, 0.6, 1.0, 0.25)
_LINE_PX = 2.0


def transforms(rig: Rig, stamp_ns: int) -> "FrameTransforms":
    """Return where dome and camera are on the vehicle."""
    from foxglove.messages import FrameTransforms

    camera = rig.dome_from_cam
    return FrameTransforms(
        transforms=[
            _transform(VEHICLE, FRAME_ID, _VEHICLE_FROM_DOME, np.zeros(3), stamp_ns),
            _transform(FRAME_ID, "cam", camera.rotation, camera.translation, stamp_ns),
        ]
    )


def scene(rig: Rig, scan: Scan, stamp_ns: int) -> "SceneUpdate":
    """Return the target's plane with the lasers' lines on it; nothing without a posture.

    What was drawn before vanishes by itself after half a second.
    """
    from foxglove.messages import Duration, SceneEntity, SceneUpdate

    posture = scan.posture
    if not isinstance(posture, Posture):
        return SceneUpdate()
    entity = SceneEntity(
        timestamp=_stamp(stamp_ns),
        frame_id=FRAME_ID,
        id="target",
        lifetime=Duration.from_secs(_LIFETIME_S),
        cubes=[_plate(posture)],
        lines=[
            _line(ends) for ends in laser_lines(rig.lasers, posture.normal_in_dome, scan.points)
        ],
        texts=[_caption(posture)],
    )
    return SceneUpdate(entities=[entity])


def laser_lines(
    lasers: tuple[Laser, ...], normal: FloatArray, points: ScanPoints
) -> list[FloatArray]:
    """Return the ends, shape (2, 3), of the line that each laser was seen to draw on the target.

    Parameters
    ----------
    lasers : tuple of Laser
    normal : array, shape (3,)
        Of the target.
    points : ScanPoints
        Those that the posture rests on count.
    """
    found = []
    for i, laser in enumerate(lasers):
        mine = points.points_in_dome[points.used & (points.laser == i)]
        if len(mine) < 2:
            continue
        along = mine @ np.cross(normal, laser.plane.normal)
        found.append(mine[[np.argmin(along), np.argmax(along)]])
    return found


def quaternion(rotation: FloatArray) -> tuple[float, float, float, float]:
    """Return a rotation matrix as x, y, z, w."""
    turn = rotvec_from_rotation(rotation)
    angle = float(np.linalg.norm(turn))
    x, y, z = turn * (0.5 * np.sinc(angle / (2.0 * math.pi)))
    return float(x), float(y), float(z), math.cos(0.5 * angle)


def _plate(posture: Posture) -> "CubePrimitive":
    """Return the target as a thin square about the foot of the perpendicular."""
    from foxglove.messages import Color, CubePrimitive, Vector3

    side = _SIDE_SHARE * posture.range
    foot = posture.range * posture.normal_in_dome
    across = np.cross(posture.normal_in_dome, (0.0, 0.0, 1.0))
    across /= max(float(np.linalg.norm(across)), 1e-9)
    up = np.cross(across, posture.normal_in_dome)
    axes = np.stack([across, posture.normal_in_dome, up], axis=1)
    return CubePrimitive(
        pose=_pose(axes, foot), size=Vector3(x=side, y=1e-3, z=side), color=Color(**_rgba(_BLUE))
    )


def _caption(posture: Posture) -> "TextPrimitive":
    from foxglove.messages import Color, TextPrimitive

    return TextPrimitive(
        pose=_pose(np.eye(3), posture.range * posture.normal_in_dome),
        billboard=True,
        font_size=14.0,
        scale_invariant=True,
        color=Color(r=1.0, g=1.0, b=1.0, a=1.0),
        text=f"{posture.range:.3f} m",
    )


def _line(ends: FloatArray) -> "LinePrimitive":
    from foxglove.messages import Color, LinePrimitive, LinePrimitiveLineType, Point3

    return LinePrimitive(
        type=LinePrimitiveLineType.LineStrip,
        pose=_pose(np.eye(3), np.zeros(3)),
        thickness=_LINE_PX,
        scale_invariant=True,
        points=[Point3(x=float(x), y=float(y), z=float(z)) for x, y, z in ends],
        color=Color(**_rgba(_GREEN)),
    )


def _transform(
    parent: str, child: str, rotation: FloatArray, origin: FloatArray, stamp_ns: int
) -> "FrameTransform":
    from foxglove.messages import FrameTransform

    return FrameTransform(
        timestamp=_stamp(stamp_ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=_vector(origin),
        rotation=_turn(rotation),
    )


def _pose(rotation: FloatArray, origin: FloatArray) -> "Pose":
    from foxglove.messages import Pose

    return Pose(position=_vector(origin), orientation=_turn(rotation))


def _vector(values: FloatArray) -> "Vector3":
    from foxglove.messages import Vector3

    x, y, z = values.tolist()
    return Vector3(x=x, y=y, z=z)


def _turn(rotation: FloatArray) -> "Quaternion":
    from foxglove.messages import Quaternion

    x, y, z, w = quaternion(rotation)
    return Quaternion(x=x, y=y, z=z, w=w)


def _stamp(stamp_ns: int) -> "Timestamp":
    from foxglove.messages import Timestamp

    return Timestamp(sec=stamp_ns // 10**9, nsec=stamp_ns % 10**9)


def _rgba(color: tuple[float, float, float, float]) -> dict[str, float]:
    return dict(zip("rgba", color, strict=True))
