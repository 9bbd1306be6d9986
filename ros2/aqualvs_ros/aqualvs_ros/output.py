"""An output of a live run that publishes by rclpy."""

import array
import importlib
from typing import Any

from aqualvs.live.outputs.ros2_messages import TYPE_NAMES, Ros2Types, to_ros2
from aqualvs.live.outputs.ros_messages import MessageMaker, PublishedTopic, RosOptions
from aqualvs.recording.sample import LiveSample
from aqualvs.sources.base import PartHealth, State

_DEPTH = 5
_PARTS = (
    "builtin_interfaces/msg/Time",
    "std_msgs/msg/Header",
    "geometry_msgs/msg/Point",
    "geometry_msgs/msg/Quaternion",
    "geometry_msgs/msg/Pose",
    "geometry_msgs/msg/PoseWithCovariance",
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
        Defaults if left out; `namespace` is not used, the node has one.
    """

    name = "ros2"
    inline = False
    keeps_all = False

    def __init__(self, node: Any, options: RosOptions | None = None) -> None:
        self._maker = MessageMaker(options or RosOptions())
        self._types = installed_types()
        self._node, self._closed = node, False
        reliable = options is None or options.reliable
        self._publishers = {
            topic: node.create_publisher(
                self._types.classes[TYPE_NAMES[topic]],
                "/diagnostics" if topic is PublishedTopic.DIAGNOSTICS else f"~/{topic}",
                _quality(reliable or topic is PublishedTopic.DIAGNOSTICS),
            )
            for topic in PublishedTopic
        }
        self._n_topics = 0

    def send(self, sample: LiveSample) -> None:
        """Publish what a sample has to say, on the topics that somebody listens to."""
        if self._closed:
            return
        publishers = self._publishers
        wanted = {topic for topic, one in publishers.items() if one.get_subscription_count()}
        for topic, message in self._maker.messages(sample, wanted):
            publishers[topic].publish(to_ros2(self._types, message))
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


def installed_types() -> Ros2Types:
    """Return the message classes of the ROS 2 that is installed."""
    classes = {}
    for name in {*_PARTS, *TYPE_NAMES.values()}:
        package, _, short = name.split("/")
        classes[name] = getattr(importlib.import_module(f"{package}.msg"), short)
    fields = classes[TYPE_NAMES[PublishedTopic.RANGE]].get_fields_and_field_types()
    return Ros2Types(
        classes=classes,
        range_has_variance="variance" in fields,
        octet=lambda value: bytes((value,)),
        # Of anything but an array each value would be looked at.
        octets=lambda data: array.array("B", data),
    )


def _quality(reliable: bool) -> Any:
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    wish = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(depth=_DEPTH, reliability=wish)
