"""The node: parameters in, a live run, topics out."""

import sys
import threading
from collections.abc import Sequence
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from aqualvs.control.time_filter import PostureFilter
from aqualvs.errors import AqualvsError, OptionError
from aqualvs.live.outputs.base import Output
from aqualvs.live.outputs.ros_messages import RosOptions
from aqualvs.live.runner import LiveRunner, ScannerProvider
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import load_rig
from aqualvs.scanner import Scanner
from aqualvs.sources.opening import open_feed
from aqualvs_ros.frames import FrameNames
from aqualvs_ros.output import FramesOutput, RclpyOutput, quality
from aqualvs_ros.pictures import TopicFeed, camera_info_doubts

PARAMETERS: dict[str, Any] = {
    "rig": "",
    "source": "",
    "image_topic": "",
    "image_transport": "raw",
    "camera_info_topic": "",
    "frame_id": "aqualvs_dome",
    "publish_tf": True,
    "base_frame": "",
    "mount_xyz_m": [0.0, 0.0, 0.0],
    "mount_rpy_deg": [0.0, 0.0, 0.0],
    "reliable": True,
    "filter": False,
}
"""With their defaults; `config/aqualvs.yaml` says what they mean."""


def main(args: Sequence[str] | None = None) -> int:
    """Run until the source ends or ROS shuts down; returns the exit code."""
    rclpy.init(args=args)
    node = Node("aqualvs")
    spinning = threading.Thread(target=_spin, args=(node,), daemon=True)
    spinning.start()
    try:
        fault = make_runner(node).run(lambda: not rclpy.ok())
        if fault is not None:
            raise fault
    except AqualvsError as fault:
        node.get_logger().error(str(fault))
        return 2
    finally:
        rclpy.try_shutdown()
        spinning.join(2.0)
        node.destroy_node()
    return 0


def make_runner(node: Node) -> LiveRunner:
    """Make what the node's parameters ask for.

    Raises
    ------
    AqualvsError
        If source or rig cannot be used.
    """
    for name, default in PARAMETERS.items():
        node.declare_parameter(name, default)
    asked = {name: node.get_parameter(name).value for name in PARAMETERS}
    rig = load_rig(asked["rig"])
    topics = TopicFeed(asked["image_topic"]) if asked["image_topic"] else None
    options = RosOptions(frame_id=asked["frame_id"], reliable=asked["reliable"])
    outputs: list[Output] = [
        RclpyOutput(node, options, None if topics is None else topics.stamp_ns)
    ]
    if asked["publish_tf"]:
        names = FrameNames(
            base=asked["base_frame"],
            dome=asked["frame_id"],
            mount_xyz_m=asked["mount_xyz_m"],
            mount_rpy_deg=asked["mount_rpy_deg"],
        )
        outputs.append(FramesOutput(node, names, None if topics is None else topics.stamp_ns))
    if topics is None:
        feed = open_feed(asked["source"])
    else:
        feed = topics
        subscribe(node, topics, rig, asked["image_transport"], asked["camera_info_topic"])
    return LiveRunner(
        feed,
        ScannerProvider(Scanner(rig)),
        outputs,
        posture_filter=PostureFilter() if asked["filter"] else None,
    )


def subscribe(node: Node, feed: TopicFeed, rig: Rig, transport: str, info_topic: str) -> None:
    """Hand the pictures of a topic to the feed, and say once what its CameraInfo objects to.

    Raises
    ------
    OptionError
        If there is no such transport.
    """
    from sensor_msgs.msg import CameraInfo, CompressedImage, Image

    if transport not in ("raw", "compressed"):
        raise OptionError(f"image_transport {transport}: use raw or compressed")
    kind, topic = Image, feed.name
    if transport == "compressed":
        kind, topic = CompressedImage, f"{feed.name}/compressed"
    heard: list[bool] = []

    def compare(info: Any) -> None:
        if not heard:
            heard.append(True)
            for doubt in camera_info_doubts(info, rig):
                node.get_logger().warning(f"camera_info: {doubt}")

    latest = quality(reliable=False, depth=1)
    node.create_subscription(kind, topic, feed.put, latest)
    beside = f"{feed.name.rpartition('/')[0]}/camera_info"
    node.create_subscription(CameraInfo, info_topic or beside, compare, latest)


def _spin(node: Node) -> None:
    """Serve parameters until ROS shuts down."""
    try:
        rclpy.spin(node)
    except ExternalShutdownException:
        return


if __name__ == "__main__":
    sys.exit(main())
