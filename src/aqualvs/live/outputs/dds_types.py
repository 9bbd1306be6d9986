"""The ROS 2 messages that are published, as types of Cyclone DDS.

Names of the types, names, order and types of their members are those that ROS 2 uses (plain CDR,
all types final), so that its subscribers match and read them.
"""

import functools
import importlib
import struct
from collections.abc import Mapping
from typing import Any

from aqualvs.errors import OptionError
from aqualvs.live.outputs.ros2_messages import TYPE_NAMES, Ros2Types, range_has_variance
from aqualvs.live.outputs.ros_messages import Topic

_TIME, _HEADER = "builtin_interfaces/msg/Time", "std_msgs/msg/Header"
_POINT, _QUATERNION = "geometry_msgs/msg/Point", "geometry_msgs/msg/Quaternion"
_POSE, _POSE_COV = "geometry_msgs/msg/Pose", "geometry_msgs/msg/PoseWithCovariance"
_FIELD = "sensor_msgs/msg/PointField"
_STATUS, _PAIR = "diagnostic_msgs/msg/DiagnosticStatus", "diagnostic_msgs/msg/KeyValue"

# In an order in which every type comes after those that it is made of.
_DEFINITIONS = {
    _TIME: "int32 sec, uint32 nanosec",
    _HEADER: f"{_TIME} stamp, string frame_id",
    _POINT: "float64 x, float64 y, float64 z",
    _QUATERNION: "float64 x, float64 y, float64 z, float64 w",
    _POSE: f"{_POINT} position, {_QUATERNION} orientation",
    _POSE_COV: f"{_POSE} pose, float64[36] covariance",
    TYPE_NAMES[Topic.POSTURE]: f"{_HEADER} header, {_POSE_COV} pose",
    TYPE_NAMES[Topic.RANGE]: (
        f"{_HEADER} header, uint8 radiation_type, float32 field_of_view, "
        "float32 min_range, float32 max_range, float32 range, float32 variance"
    ),
    _FIELD: "string name, uint32 offset, uint8 datatype, uint32 count",
    TYPE_NAMES[Topic.CLOUD]: (
        f"{_HEADER} header, uint32 height, uint32 width, {_FIELD}[] fields, bool is_bigendian, "
        "uint32 point_step, uint32 row_step, uint8[] data, bool is_dense"
    ),
    _PAIR: "string key, string value",
    _STATUS: f"uint8 level, string name, string message, string hardware_id, {_PAIR}[] values",
    TYPE_NAMES[Topic.DIAGNOSTICS]: f"{_HEADER} header, {_STATUS}[] status",
}

_HASHES = {
    Topic.POSTURE: "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    Topic.RANGE: "b42b62562e93cbfe9d42b82fe5994dfa3d63d7d5c90a317981703f7388adff3a",
    Topic.CLOUD: "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
    Topic.DIAGNOSTICS: "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
}


def type_hash(topic: Topic) -> bytes:
    """Return the user data by which ROS 2 since Iron tells the version of a topic's type.

    Subscribers match without it, but warn (ROS REP-2016).
    """
    kind = Topic.POSTURE if topic is Topic.FILTERED else topic
    return f"typehash=RIHS01_{_HASHES[kind]};".encode()


@functools.cache
def dds_types(distro: str) -> Ros2Types:
    """Return the types as a release of ROS 2 has them.

    Raises
    ------
    OptionError
        If cyclonedds is not installed.
    """
    try:
        from cyclonedds.idl import make_idl_struct
    except ImportError as fault:
        raise OptionError(
            "ROS 2 by DDS needs Cyclone DDS; install it with: pip install 'aqualvs[dds]'"
        ) from fault
    with_variance = range_has_variance(distro)
    classes: dict[str, Any] = {}
    for name, text in _DEFINITIONS.items():
        package, kind, short = name.split("/")
        members = dict(_member(part, classes) for part in text.split(", "))
        if not with_variance:
            members.pop("variance", None)
        classes[name] = make_idl_struct(f"{short}_", f"{package}.{kind}.dds_.{short}_", members)
    classes[TYPE_NAMES[Topic.CLOUD]].serialize = _serialize_cloud
    return Ros2Types(
        classes=classes, range_has_variance=with_variance, octet=int, octets=_unchanged
    )


def _member(text: str, classes: Mapping[str, Any]) -> tuple[str, Any]:
    """Return name and type of a member such as `float64[36] covariance`."""
    types: Any = importlib.import_module("cyclonedds.idl.types")
    kind, name = text.split(" ")
    kind, bracket, length = kind.rstrip("]").partition("[")
    plain = {"string": str, "bool": bool}
    single = classes.get(kind) or plain.get(kind) or getattr(types, kind)
    if not bracket:
        return name, single
    return name, types.array[single, int(length)] if length else types.sequence[single]


def _unchanged(data: bytes) -> bytes:
    return data


def _serialize_cloud(
    cloud: Any, buffer: Any = None, endianness: Any = None, use_version_2: bool | None = None
) -> bytes:
    """Serialise a cloud without packing `data` number by number, which takes milliseconds.

    `data` is the last member but one, and one octet follows: the rest is serialised without data,
    and the data put in where its length, nought, stands.
    """
    data, cloud.data = cloud.data, b""
    try:
        rest = cloud.__idl__.serialize(
            cloud, buffer=buffer, endianness=endianness, use_version_2=use_version_2
        )
    finally:
        cloud.data = data
    length = struct.pack("<I" if rest[1] & 1 else ">I", len(data))
    return b"".join((rest[:-5], length, data, rest[-1:]))
