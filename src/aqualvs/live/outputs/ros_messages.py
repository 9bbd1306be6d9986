"""ROS messages: pose, range, cloud and diagnostics, in the classes of rclpy, rosbags or DDS.

Vectors of the dome are converted to the axes of ROS and MAVLink, all at the dome's centre:

=======  =======  =======  ====  ================================
frame    x        y        z     used by
=======  =======  =======  ====  ================================
dome     right    forward  up    the library
FLU      forward  left     up    ROS (REP-103), Foxglove
FRD      forward  right    down  MAVLink
=======  =======  =======  ====  ================================

Messages are in FLU. `plane_pose` gives the target's plane as a ROS pose. Health becomes ROS
diagnostics, one status with figures for each part of the run.
"""

import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray, as_vectors
from aqualvs.optics.rig import Rig
from aqualvs.recording.sample import LiveSample
from aqualvs.scanning.posture import Posture, Reason, deviations
from aqualvs.scanning.scan import Label
from aqualvs.sources.base import Health, PartHealth, State

FLU_FROM_DOME: FloatArray = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Rotation from `dome` to forward, left, up."""
FLU_FROM_DOME.flags.writeable = False

UNOBSERVABLE_VARIANCE = 1.0e4
"""Variance, in m² and rad², of what a plane leaves undetermined: 100 m, 100 rad."""


@dataclass(frozen=True, slots=True)
class PlanePose:
    """Pose of the target's plane in FLU axes at the dome's centre."""

    position: FloatArray  # Shape (3,): foot of the perpendicular from the dome's centre, in metres.
    # Shape (4,): orientation as (x, y, z, w): x along the normal away from the vehicle, y
    # horizontal to the left as the vehicle sees it, z up the plane. Identity where the vehicle
    # looks squarely at the target.
    quaternion: FloatArray
    # Shape (6, 6): of (x, y, z, roll, pitch, yaw) in FLU, m and rad, angles about fixed axes
    # (REP-103).
    covariance: FloatArray


def flu_from_dome(vectors_in_dome: ArrayLike) -> FloatArray:
    """Return vectors (..., 3) of `dome` in forward, left, up."""
    vectors = as_vectors(vectors_in_dome, 3, "vectors_in_dome")
    return np.stack((vectors[..., 1], -vectors[..., 0], vectors[..., 2]), axis=-1)


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

    `distance`, `pitch`, `yaw`: as in `Posture`, in metres and radians; with their covariance, shape
    (3, 3).
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


_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")


POINT_TYPE = np.dtype(
    [
        *((name, "<f4") for name in ("x", "y", "z", "intensity", "sigma")),
        ("laser", "i1"),
        ("label", "u1"),
        ("used", "u1"),
    ],
    align=True,
)
"""One point of the cloud, 24 bytes: metres, grey levels, indices, `Label` and 0 or 1."""


class PublishedTopic(StrEnum):
    """Published topic; the value is the last part of its name."""

    POSTURE = "posture"
    FILTERED = "posture_filtered"
    RANGE = "range"
    CLOUD = "cloud"
    DIAGNOSTICS = "diagnostics"

    @property
    def full_name(self) -> str:
        """The whole name; ROS looks for diagnostics at the root."""
        return f"/{self}" if self is PublishedTopic.DIAGNOSTICS else f"/aqualvs/{self}"


TYPE_NAMES = {
    PublishedTopic.POSTURE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    PublishedTopic.FILTERED: "geometry_msgs/msg/PoseWithCovarianceStamped",
    PublishedTopic.RANGE: "sensor_msgs/msg/Range",
    PublishedTopic.CLOUD: "sensor_msgs/msg/PointCloud2",
    PublishedTopic.DIAGNOSTICS: "diagnostic_msgs/msg/DiagnosticArray",
}
"""Type of each topic."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RosTypes:
    """Message classes to use; each is called with its fields by name."""

    classes: Mapping[str, Any]  # By name, such as `sensor_msgs/msg/Range`.
    range_has_variance: bool  # False before ROS 2 Iron.
    # Makes a value of the type `byte`, which rclpy wants as one byte and others as a number.
    octet: Callable[[int], Any] = int
    # Makes a sequence of `uint8` of an array; rclpy copies an `array` without looking at each.
    octets: Callable[[np.ndarray], Any] = np.asarray

    def make(self, name: str, /, **fields: Any) -> Any:
        """Return a message."""
        return self.classes[name](**fields)

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        """Return a header."""
        sec, nanosec = divmod(stamp_ns, 10**9)
        stamp = self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


@dataclass(frozen=True, slots=True, kw_only=True)
class RosOptions:
    """Name of the frame, and how hard it is tried to deliver.

    Raises `OptionError` if the name is none that ROS allows.
    """

    # Name of the frame at the dome's centre, forward, left, up.
    frame_id: str = "aqualvs_dome"
    # ROS 2: offer to repeat what gets lost. Then every subscriber fits, whichever it asks for;
    # without, only those that ask for best effort.
    reliable: bool = True

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.frame_id):
            raise OptionError(
                f"ROS frame {self.frame_id!r}: use letters, digits and _, starting with a letter; "
                "parts are joined by /, without one in front"
            )


class MessageMaker:
    """Converter of samples to messages of some types; diagnostics once a second."""

    def __init__(self, options: RosOptions, types: RosTypes) -> None:
        self._options, self._types = options, types
        self._rig: Rig | None = None
        self._field_of_view = 0.0
        self._next_diagnostics_ns: int | None = None

    def messages(
        self, sample: LiveSample, wanted: Collection[PublishedTopic]
    ) -> Iterator[tuple[PublishedTopic, Any]]:
        """Yield the messages of a sample, on the topics that have subscribers.

        Without a posture there is no pose, and the range is not a number.
        """
        postures = {
            PublishedTopic.POSTURE: sample.scan.posture,
            PublishedTopic.FILTERED: sample.filtered,
        }
        for topic, found in postures.items():
            if topic in wanted and found:
                pose = plane_pose(found.range, found.pitch, found.yaw, found.total_covariance)
                yield topic, self._pose(sample, pose)
        if PublishedTopic.RANGE in wanted:
            yield PublishedTopic.RANGE, self._range(sample)
        if PublishedTopic.CLOUD in wanted:
            yield PublishedTopic.CLOUD, self._cloud(sample)
        if PublishedTopic.DIAGNOSTICS in wanted and self._diagnostics_are_due(sample):
            yield PublishedTopic.DIAGNOSTICS, _diagnostics(self._types, sample)

    def _header(self, sample: LiveSample) -> Any:
        return self._types.header(sample.utc_ns, self._options.frame_id)

    def _pose(self, sample: LiveSample, pose: PlanePose) -> Any:
        make = self._types.make
        x, y, z = pose.position.tolist()
        qx, qy, qz, qw = pose.quaternion.tolist()
        place = make(
            "geometry_msgs/msg/Pose",
            position=make("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        )
        return make(
            TYPE_NAMES[PublishedTopic.POSTURE],
            header=self._header(sample),
            pose=make(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=place,
                covariance=pose.covariance.ravel(),
            ),
        )

    def _range(self, sample: LiveSample) -> Any:
        # The message knows sound and light only.
        infrared = 1
        rig, posture = sample.rig, sample.scan.posture
        if rig is not self._rig:
            self._rig, self._field_of_view = rig, field_of_view(rig)
        near, far = rig.working_range
        value = posture.range if posture else _no_range(sample)
        if posture:
            # Ranges that the scanner accepts just outside must not be discarded by the receiver.
            near, far = min(near, value), max(far, value)
        variance = float(posture.total_covariance[0, 0]) if posture else 0.0
        return self._types.make(
            TYPE_NAMES[PublishedTopic.RANGE],
            header=self._header(sample),
            radiation_type=infrared,
            field_of_view=self._field_of_view,
            min_range=near,
            max_range=far,
            range=value,
            **({"variance": variance} if self._types.range_has_variance else {}),
        )

    def _cloud(self, sample: LiveSample) -> Any:
        """Return all stripe points of a frame in one row, in forward, left, up."""
        types, points = self._types, sample.scan.points
        packed = np.zeros(len(points), POINT_TYPE)
        xyz = flu_from_dome(points.points_in_dome)
        packed["x"], packed["y"], packed["z"] = xyz.T
        for name in ("intensity", "sigma", "laser", "label", "used"):
            packed[name] = getattr(points, name)
        return types.make(
            TYPE_NAMES[PublishedTopic.CLOUD],
            header=self._header(sample),
            height=1,
            width=len(packed),
            fields=_point_fields(types),
            is_bigendian=False,
            point_step=packed.itemsize,
            row_step=packed.nbytes,
            data=types.octets(packed.view(np.uint8)),
            is_dense=bool(np.isfinite(xyz).all()),
        )

    def _diagnostics_are_due(self, sample: LiveSample) -> bool:
        now = sample.instants.scanned_ns
        if self._next_diagnostics_ns is not None and now < self._next_diagnostics_ns:
            return False
        second_ns = 1_000_000_000
        self._next_diagnostics_ns = now + second_ns
        return True


def _point_fields(types: RosTypes) -> list[Any]:
    """Return the description of `POINT_TYPE`."""
    kind: Any = types.classes["sensor_msgs/msg/PointField"]
    return [
        # The numbers of the datatypes are constants such as FLOAT32.
        kind(name=name, offset=offset, datatype=getattr(kind, dtype.name.upper()), count=1)
        for name, (dtype, offset, *_) in (POINT_TYPE.fields or {}).items()
    ]


def field_of_view(rig: Rig) -> float:
    """Return the angle (rad) that the picture spans from left to right in the water."""
    width, height = rig.size_px
    middle = 0.5 * (height - 1)
    rays = rig.camera().rays([[0.0, middle], [width - 1.0, middle]])
    if not rays.valid.all():
        return float(2.0 * np.arctan(0.5 * width / rig.focal_px))
    left, right = rays.directions
    return float(np.arctan2(np.linalg.norm(np.cross(left, right)), left @ right))


def _no_range(sample: LiveSample) -> float:
    """Return the value of REP-117 for a missing range.

    Minus infinity for a target that is too near, infinity for one that is too far, else not a
    number: a picture without stripes is no promise that the way is free.
    """
    posture, points = sample.scan.posture, sample.scan.points
    assert not isinstance(posture, Posture)
    # A wall behind a net that is too near may well give more points than the net.
    to_target = points.label != Label.BACKGROUND
    if posture.reason is not Reason.OUT_OF_RANGE or not to_target.any():
        return float("nan")
    near, far = sample.rig.working_range
    ahead = float(np.median(points.points_in_dome[to_target, 1]))
    return float("-inf") if ahead < 0.5 * (near + far) else float("inf")


class Level(IntEnum):
    """As in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


_LEVELS = {State.WARN: Level.WARN, State.FAULT: Level.ERROR}


def _diagnostics(types: RosTypes, sample: LiveSample) -> Any:
    """Return how the run is: posture, pipeline, source, lasers, outputs."""
    health, make = sample.health, types.make
    parts = [
        ("posture", _posture_status(sample)),
        ("pipeline", _pipeline_status(health)),
        ("source", _part_status(health.source)),
        *((f"laser {part.name}", _part_status(part)) for part in health.lasers),
        *((f"output {part.name}", _part_status(part)) for part in health.outputs),
    ]
    return make(
        TYPE_NAMES[PublishedTopic.DIAGNOSTICS],
        header=types.header(sample.utc_ns, ""),
        status=[
            make(
                "diagnostic_msgs/msg/DiagnosticStatus",
                level=types.octet(level),
                name=f"aqualvs: {name}",
                message=message,
                hardware_id=sample.rig.name,
                values=[
                    make("diagnostic_msgs/msg/KeyValue", key=key, value=value)
                    for key, value in figures.items()
                ],
            )
            for name, (level, message, figures) in parts
        ],
    )


_Status: TypeAlias = tuple[Level, str, dict[str, str]]
"""Level, message and figures."""


def _posture_status(sample: LiveSample) -> _Status:
    posture = sample.scan.posture
    if not posture:
        text = f"{posture.reason}: {posture.detail}" if posture.detail else str(posture.reason)
        return Level.WARN, text, {"reason": str(posture.reason)}
    pitch, yaw = math.degrees(posture.pitch), math.degrees(posture.yaw)
    frame, whole = deviations(posture.covariance), deviations(posture.total_covariance)
    figures = _figure_texts(
        range_m=posture.range,
        pitch_deg=pitch,
        yaw_deg=yaw,
        sigma_range_m=frame[0],
        sigma_pitch_deg=frame[1],
        sigma_yaw_deg=frame[2],
        sigma_range_total_m=whole[0],
        sigma_pitch_total_deg=whole[1],
        sigma_yaw_total_deg=whole[2],
        slant_range_m=posture.slant_range,
        nearest_m=posture.nearest,
        n_points=posture.n_points,
    )
    return Level.OK, f"{posture.range:.3f} m, pitch {pitch:+.1f} deg, yaw {yaw:+.1f} deg", figures


def _pipeline_status(health: Health) -> _Status:
    share = "" if math.isnan(health.valid_share) else f", {health.valid_share:.0%} with a posture"
    delays = {
        f"{stage.name}_{which}_ms": 1e3 * delay_s
        for stage in health.delays
        for which, delay_s in (("median", stage.median_s), ("p99", stage.p99_s))
    }
    figures = _figure_texts(
        rate_hz=health.rate_hz,
        valid_share=health.valid_share,
        n_frames=health.n_frames,
        n_dropped=health.n_dropped,
        n_lost=health.n_lost,
        quality=health.quality,
        n_water=health.n_water,
        sigma_n_water=health.sigma_n_water,
        **delays,
    )
    level = Level.OK if health.rate_hz > 0.0 else Level.WARN
    return level, f"{health.rate_hz:.1f} frames/s{share}", figures


def _part_status(part: PartHealth) -> _Status:
    text = part.detail
    if part.state is State.OFF:
        text = f"not in use: {text}" if text else "not in use"
    figures = {"state": str(part.state), "n_dropped": str(part.n_dropped)}
    return _LEVELS.get(part.state, Level.OK), text, figures


def _figure_texts(**figures: float) -> dict[str, str]:
    return {key: f"{value:.6g}" for key, value in figures.items()}
