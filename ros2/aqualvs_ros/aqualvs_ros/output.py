"""Outputs of a live run that publish by rclpy: what is measured, and coordinate frames."""

import array
import importlib
from typing import Any

from aqualvs.live.outputs.ros_messages import (
    TYPE_NAMES,
    MessageMaker,
    PublishedTopic,
    RosOptions,
    RosTypes,
)
from aqualvs.recording.sample import LiveSample
from aqualvs.scanning.posture import Posture
from aqualvs.sources.base import PartHealth, State
from aqualvs_ros.frames import FrameNames, fixed_transforms, target_transform, tf_message
from aqualvs_ros.pictures import StampOf, stamped

_DEPTH = 5
_PARTS = (
    "builtin_interfaces/msg/Time",
    "std_msgs/msg/Header",
    "geometry_msgs/msg/Point",
    "geometry_msgs/msg/Quaternion",
    "geometry_msgs/msg/Pose",
    "geometry_msgs/msg/PoseWithCovariance",
    "geometry_msgs/msg/Vector3",
    "geometry_msgs/msg/Transform",
    "geometry_msgs/msg/TransformStamped",
    "tf2_msgs/msg/TFMessage",
    "sensor_msgs/msg/PointField",
    "diagnostic_msgs/msg/DiagnosticStatus",
    "diagnostic_msgs/msg/KeyValue",
)


class RclpyOutput:
    """Publishes posture, range, cloud and diagnostics from a node.

    Parameters
    ----------
    node : rclpy.node.Node
        Topics are private to it, `diagnostics` is not.
    options : RosOptions, optional
        Defaults if left out.
    stamp_of : callable, optional
        Takes the number of a frame, gives the time in the header of its picture, or None. The time
        of arrival counts if left out.
    """

    name = "ros2"
    inline = False
    keeps_all = False

    def __init__(
        self, node: Any, options: RosOptions | None = None, stamp_of: StampOf | None = None
    ) -> None:
        self._stamp_of = stamp_of
        types = installed_types()
        self._maker = MessageMaker(options or RosOptions(), types)
        self._node, self._closed = node, False
        reliable = options is None or options.reliable
        self._publishers = {
            topic: node.create_publisher(
                types.classes[TYPE_NAMES[topic]],
                "/diagnostics" if topic is PublishedTopic.DIAGNOSTICS else f"~/{topic}",
                quality(reliable or topic is PublishedTopic.DIAGNOSTICS),
            )
            for topic in PublishedTopic
        }
        self._n_topics = 0

    def send(self, sample: LiveSample) -> None:
        """Publish what a sample has to say, on the topics that somebody listens to."""
        if self._closed:
            return
        sample, publishers = stamped(sample, self._stamp_of), self._publishers
        wanted = {topic for topic, one in publishers.items() if one.get_subscription_count()}
        for topic, message in self._maker.messages(sample, wanted):
            publishers[topic].publish(message)
        self._n_topics = len(wanted)

    def health(self) -> PartHealth:
        """Return how many topics are listened to."""
        if self._closed:
            return PartHealth(self.name, State.OFF, "closed")
        n = self._n_topics
        told = f"{n or 'no'} topic{'s' * (n != 1)} listened to"
        return PartHealth(self.name, State.OK, told)

    def close(self) -> None:
        """Give the publishers back to the node."""
        if not self._closed:
            self._closed = True
            for publisher in self._publishers.values():
                self._node.destroy_publisher(publisher)


class FramesOutput:
    """Broadcasts the fixed frames once, for late comers too, and the target's with each posture.

    Parameters
    ----------
    node : rclpy.node.Node
    names : FrameNames
    stamp_of : callable, optional
        As for `RclpyOutput`.
    """

    name = "tf"
    inline = False
    keeps_all = False

    def __init__(self, node: Any, names: FrameNames, stamp_of: StampOf | None = None) -> None:
        self._node, self._names, self._stamp_of = node, names, stamp_of
        self._types = installed_types()
        kind = self._types.classes["tf2_msgs/msg/TFMessage"]
        stays = quality(reliable=True, depth=1, stays=True)
        self._fixed = node.create_publisher(kind, "/tf_static", stays)
        self._moving = node.create_publisher(kind, "/tf", quality(reliable=True, depth=100))
        self._told = self._closed = False

    def send(self, sample: LiveSample) -> None:
        """Broadcast where the target is, and the fixed frames before it."""
        if self._closed:
            return
        sample = stamped(sample, self._stamp_of)
        posture, at_ns = sample.scan.posture, sample.utc_ns
        if not self._told:
            self._told = True
            fixed = fixed_transforms(sample.rig, self._names)
            self._fixed.publish(tf_message(self._types, at_ns, fixed))
        if isinstance(posture, Posture):
            target = target_transform(posture, self._names)
            self._moving.publish(tf_message(self._types, at_ns, [target]))

    def health(self) -> PartHealth:
        """Return that it works."""
        return PartHealth(self.name, State.OFF if self._closed else State.OK)

    def close(self) -> None:
        """Give the publishers back to the node."""
        if not self._closed:
            self._closed = True
            self._node.destroy_publisher(self._fixed)
            self._node.destroy_publisher(self._moving)


def installed_types() -> RosTypes:
    """Return the message classes of the ROS 2 that is installed."""
    classes = {}
    for name in {*_PARTS, *TYPE_NAMES.values()}:
        package, _, short = name.split("/")
        classes[name] = getattr(importlib.import_module(f"{package}.msg"), short)
    fields = classes[TYPE_NAMES[PublishedTopic.RANGE]].get_fields_and_field_types()
    return RosTypes(
        classes=classes,
        range_has_variance="variance" in fields,
        octet=lambda value: bytes((value,)),
        # Of anything but an array each value would be looked at.
        octets=lambda data: array.array("B", data.tobytes()),
    )


def quality(reliable: bool, depth: int = _DEPTH, stays: bool = False) -> Any:
    """Return a quality of service; with `stays`, those who come late get the last messages."""
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    wish = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    more = {"durability": DurabilityPolicy.TRANSIENT_LOCAL} if stays else {}
    return QoSProfile(depth=depth, reliability=wish, **more)
