"""A ROS 1 subscriber by rospy, in a process of its own: one line of JSON for each message.

Run by the Python that rospy belongs to, not by that of the tests.

usage: ros1_subscriber.py NAMESPACE
"""

import base64
import json
import sys
import threading
import time

import rospy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import PointCloud2, Range

LONGEST_S = 180.0
lock = threading.Lock()


def echo(**values):
    with lock:
        print(json.dumps(values), flush=True)


def plain(value):
    """The message as what JSON knows; data of clouds as base 64."""
    if hasattr(value, "__slots__") and hasattr(value, "_type"):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    if hasattr(value, "nsecs"):
        return {"secs": value.secs, "nsecs": value.nsecs}
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    if isinstance(value, (list, tuple)):
        return [plain(one) for one in value]
    return value


def listener(topic):
    def hear(message):
        echo(topic=topic, at_ns=time.time_ns(), message=plain(message))

    return hear


def main(namespace):
    rospy.init_node("listener", anonymous=True, disable_signals=True, disable_rosout=True)
    topics = {
        f"/{namespace}/posture": PoseWithCovarianceStamped,
        f"/{namespace}/posture_filtered": PoseWithCovarianceStamped,
        f"/{namespace}/range": Range,
        f"/{namespace}/cloud": PointCloud2,
        "/diagnostics": DiagnosticArray,
    }
    for topic, kind in topics.items():
        rospy.Subscriber(topic, kind, listener(topic), tcp_nodelay=True)
    echo(ready=True)
    time.sleep(LONGEST_S)


if __name__ == "__main__":
    main(*sys.argv[1:])
