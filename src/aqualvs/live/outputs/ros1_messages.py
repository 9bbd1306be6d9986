"""Messages as ROS 1 has them on the wire: definitions, checksums, bytes.

Little endian and without padding; a string or list follows its length
(http://wiki.ros.org/ROS/Connection%20Header and msg).
"""

import struct
from collections.abc import Iterable
from dataclasses import dataclass

from aqualvs.live.outputs.ros_messages import (
    POINT_FIELDS,
    POINT_TYPE,
    CloudMessage,
    Message,
    PoseMessage,
    RangeMessage,
    Topic,
)
from aqualvs.live.outputs.ros_messages_diagnostics import DiagnosticsMessage, Status

_INFRARED = 1
_RULE = 80 * "="

_PARTS = {
    "std_msgs/Header": "uint32 seq\ntime stamp\nstring frame_id",
    "geometry_msgs/PoseWithCovariance": "Pose pose\nfloat64[36] covariance",
    "geometry_msgs/Pose": "Point position\nQuaternion orientation",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "sensor_msgs/PointField": (
        "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\n"
        "uint8 UINT32=6\nuint8 FLOAT32=7\nuint8 FLOAT64=8\n"
        "string name\nuint32 offset\nuint8 datatype\nuint32 count"
    ),
    "diagnostic_msgs/DiagnosticStatus": (
        "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\nbyte level\nstring name\n"
        "string message\nstring hardware_id\nKeyValue[] values"
    ),
    "diagnostic_msgs/KeyValue": "string key\nstring value",
}


@dataclass(frozen=True, slots=True)
class Ros1Type:
    """A message type as publishers and subscribers agree on it.

    Attributes
    ----------
    name : str
    md5sum : str
        Of the definition; subscribers with another one are refused.
    definition : str
        Its text and those of all parts, as bags keep it.
    """

    name: str
    md5sum: str
    definition: str


def _type(name: str, text: str, parts: Iterable[str], md5sum: str) -> Ros1Type:
    more = (f"{_RULE}\nMSG: {part}\n{_PARTS[part]}\n" for part in parts)
    return Ros1Type(name, md5sum, "".join((f"{text}\n", *more)))


_POSE_TYPE = _type(
    "geometry_msgs/PoseWithCovarianceStamped",
    "Header header\nPoseWithCovariance pose",
    (
        "std_msgs/Header",
        "geometry_msgs/PoseWithCovariance",
        "geometry_msgs/Pose",
        "geometry_msgs/Point",
        "geometry_msgs/Quaternion",
    ),
    "953b798c0f514ff060a53a3498ce6246",
)

ROS1_TYPES = {
    Topic.POSTURE: _POSE_TYPE,
    Topic.FILTERED: _POSE_TYPE,
    Topic.RANGE: _type(
        "sensor_msgs/Range",
        "Header header\nuint8 ULTRASOUND=0\nuint8 INFRARED=1\nuint8 radiation_type\n"
        "float32 field_of_view\nfloat32 min_range\nfloat32 max_range\nfloat32 range",
        ("std_msgs/Header",),
        "c005c34273dc426c67a020a87bc24148",
    ),
    Topic.CLOUD: _type(
        "sensor_msgs/PointCloud2",
        "Header header\nuint32 height\nuint32 width\nPointField[] fields\nbool is_bigendian\n"
        "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense",
        ("std_msgs/Header", "sensor_msgs/PointField"),
        "1158d486dd51d683ce2f1be655c3c181",
    ),
    Topic.DIAGNOSTICS: _type(
        "diagnostic_msgs/DiagnosticArray",
        "Header header\nDiagnosticStatus[] status",
        ("std_msgs/Header", "diagnostic_msgs/DiagnosticStatus", "diagnostic_msgs/KeyValue"),
        "60810da900de1dd6ddd437c3503511da",
    ),
}
"""Type of each topic."""


def to_ros1(message: Message, seq: int) -> bytes:
    """Return a message as bytes.

    Parameters
    ----------
    message : Message
    seq : int
        Number of the message on its topic.
    """
    match message:
        case PoseMessage():
            return _pose(message, seq)
        case RangeMessage():
            return _range(message, seq)
        case CloudMessage():
            return _cloud(message, seq)
        case DiagnosticsMessage():
            return _diagnostics(message, seq)


def text(value: str) -> bytes:
    """Return a string behind its length."""
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def _header(seq: int, stamp_ns: int, frame_id: str) -> bytes:
    secs, nsecs = divmod(stamp_ns, 10**9)
    return struct.pack("<III", seq & 0xFFFFFFFF, secs, nsecs) + text(frame_id)


def _pose(message: PoseMessage, seq: int) -> bytes:
    numbers = (*message.position, *message.quaternion, *message.covariance)
    return _header(seq, message.stamp_ns, message.frame_id) + struct.pack("<43d", *numbers)


def _range(message: RangeMessage, seq: int) -> bytes:
    return _header(seq, message.stamp_ns, message.frame_id) + struct.pack(
        "<B4f",
        _INFRARED,
        message.field_of_view,
        message.min_range,
        message.max_range,
        message.range,
    )


_FIELDS = struct.pack("<I", len(POINT_FIELDS)) + b"".join(
    text(field.name) + struct.pack("<IBI", field.offset, field.datatype, 1)
    for field in POINT_FIELDS
)


def _cloud(message: CloudMessage, seq: int) -> bytes:
    step = POINT_TYPE.itemsize
    return b"".join(
        (
            _header(seq, message.stamp_ns, message.frame_id),
            struct.pack("<II", 1, message.width),
            _FIELDS,
            struct.pack("<BIII", 0, step, step * message.width, len(message.data)),
            message.data,
            struct.pack("<B", message.is_dense),
        )
    )


def _diagnostics(message: DiagnosticsMessage, seq: int) -> bytes:
    return b"".join(
        (
            _header(seq, message.stamp_ns, ""),
            struct.pack("<I", len(message.statuses)),
            *(_status(status) for status in message.statuses),
        )
    )


def _status(status: Status) -> bytes:
    return b"".join(
        (
            struct.pack("<b", status.level),
            text(status.name),
            text(status.message),
            text(status.hardware_id),
            struct.pack("<I", len(status.values)),
            *(text(one) for pair in status.values for one in pair),
        )
    )
