"""The node: parameters in, a live run, topics out."""

import sys
import threading
from collections.abc import Sequence
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from aqualvs.control.time_filter import PostureFilter
from aqualvs.errors import AqualvsError
from aqualvs.live.outputs.ros_messages import RosOptions
from aqualvs.live.runner import FixedScanner, LiveRunner
from aqualvs.optics.rigfile import load_rig
from aqualvs.scanner import Scanner
from aqualvs.sources.opening import open_feed
from aqualvs_ros.output import RclpyOutput

PARAMETERS: dict[str, Any] = {
    "source": "",
    "rig": "",
    "frame_id": "aqualvs_dome",
    "reliable": True,
    "filter": False,
}


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
    feed = open_feed(asked["source"])
    options = RosOptions(frame_id=asked["frame_id"], reliable=asked["reliable"])
    return LiveRunner(
        feed,
        FixedScanner(Scanner(rig)),
        [RclpyOutput(node, options)],
        posture_filter=PostureFilter() if asked["filter"] else None,
    )


def _spin(node: Node) -> None:
    """Serve parameters until ROS shuts down."""
    try:
        rclpy.spin(node)
    except ExternalShutdownException:
        return


if __name__ == "__main__":
    sys.exit(main())
