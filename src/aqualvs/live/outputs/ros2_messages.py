"""Messages in the form of ROS 2, as classes of rclpy, rosbags or DDS: all take the same fields."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from aqualvs.live.outputs.ros_messages import (
    POINT_FIELDS,
    POINT_TYPE,
    CloudMessage,
    DiagnosticsMessage,
    DiagnosticStatus,
    Message,
    PoseMessage,
    PublishedTopic,
    RangeMessage,
)

INFRARED = 1
"""`Range.radiation_type`: the message knows sound and light only."""

DEFAULT_DISTRO = "jazzy"
_WITHOUT_VARIANCE = frozenset(
    {"ardent", "bouncy", "crystal", "dashing", "eloquent", "foxy", "galactic", "humble"}
)

TYPE_NAMES = {
    PublishedTopic.POSTURE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    PublishedTopic.FILTERED: "geometry_msgs/msg/PoseWithCovarianceStamped",
    PublishedTopic.RANGE: "sensor_msgs/msg/Range",
    PublishedTopic.CLOUD: "sensor_msgs/msg/PointCloud2",
    PublishedTopic.DIAGNOSTICS: "diagnostic_msgs/msg/DiagnosticArray",
}
"""Type of each topic."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Ros2Types:
    """The message classes to use; each is called with its fields by name."""

    classes: dict[str, Any]  # By name, such as `sensor_msgs/msg/Range`.
    range_has_variance: bool  # False before ROS 2 Iron.
    # Makes a value of the type `byte`, which rclpy wants as one byte and DDS as a number.
    octet: Callable[[int], Any]
    # Makes a sequence of `uint8` of bytes; rclpy copies an `array` without looking at each.
    octets: Callable[[bytes], Any]

    def make(self, name: str, /, **fields: Any) -> Any:
        """Return a message."""
        return self.classes[name](**fields)


def range_has_variance(distro: str) -> bool:
    """Return whether a release of ROS 2 has `Range.variance`, as all since Iron have."""
    return distro.lower() not in _WITHOUT_VARIANCE


def distro_of_this_machine() -> str:
    """Return the release of ROS 2 that the environment names, or the default."""
    return os.environ.get("ROS_DISTRO", "") or DEFAULT_DISTRO


def to_ros2(types: Ros2Types, message: Message) -> Any:
    """Return a message as one of `types`."""
    match message:
        case PoseMessage():
            return _pose(types, message)
        case RangeMessage():
            return _range(types, message)
        case CloudMessage():
            return _cloud(types, message)
        case DiagnosticsMessage():
            return _diagnostics(types, message)


def _header(types: Ros2Types, stamp_ns: int, frame_id: str) -> Any:
    sec, nanosec = divmod(stamp_ns, 10**9)
    stamp = types.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return types.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def _pose(types: Ros2Types, message: PoseMessage) -> Any:
    x, y, z = message.position.tolist()
    qx, qy, qz, qw = message.quaternion.tolist()
    pose = types.make(
        "geometry_msgs/msg/Pose",
        position=types.make("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=types.make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
    )
    return types.make(
        TYPE_NAMES[PublishedTopic.POSTURE],
        header=_header(types, message.stamp_ns, message.frame_id),
        pose=types.make(
            "geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=message.covariance
        ),
    )


def _range(types: Ros2Types, message: RangeMessage) -> Any:
    extra = {"variance": message.variance} if types.range_has_variance else {}
    return types.make(
        TYPE_NAMES[PublishedTopic.RANGE],
        header=_header(types, message.stamp_ns, message.frame_id),
        radiation_type=INFRARED,
        field_of_view=message.field_of_view,
        min_range=message.min_range,
        max_range=message.max_range,
        range=message.range,
        **extra,
    )


def _cloud(types: Ros2Types, message: CloudMessage) -> Any:
    step = POINT_TYPE.itemsize
    return types.make(
        TYPE_NAMES[PublishedTopic.CLOUD],
        header=_header(types, message.stamp_ns, message.frame_id),
        height=1,
        width=message.width,
        fields=[
            types.make(
                "sensor_msgs/msg/PointField",
                name=field.name,
                offset=field.offset,
                datatype=field.datatype,
                count=1,
            )
            for field in POINT_FIELDS
        ],
        is_bigendian=False,
        point_step=step,
        row_step=step * message.width,
        data=types.octets(message.data),
        is_dense=message.is_dense,
    )


def _diagnostics(types: Ros2Types, message: DiagnosticsMessage) -> Any:
    return types.make(
        TYPE_NAMES[PublishedTopic.DIAGNOSTICS],
        header=_header(types, message.stamp_ns, ""),
        status=[_status(types, status) for status in message.statuses],
    )


def _status(types: Ros2Types, status: DiagnosticStatus) -> Any:
    return types.make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=types.octet(status.level),
        name=status.name,
        message=status.message,
        hardware_id=status.hardware_id,
        values=[
            types.make("diagnostic_msgs/msg/KeyValue", key=key, value=value)
            for key, value in status.values
        ],
    )
