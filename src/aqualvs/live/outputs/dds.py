"""ROS 2 topics without ROS: a publisher by Cyclone DDS, compatible with subscribers of ROS 2.

The messages are types of Cyclone DDS. Names of the types, and names, order and types of their
members are those that ROS 2 uses (plain CDR, all types final), so that its subscribers match and
read them.
"""

import functools
import importlib
import os
import struct
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from aqualvs.errors import OptionError
from aqualvs.live.outputs.ros2_messages import (
    TYPE_NAMES,
    Ros2Types,
    distro_of_this_machine,
    range_has_variance,
    to_ros2,
)
from aqualvs.live.outputs.ros_messages import MessageMaker, PublishedTopic, RosOptions
from aqualvs.recording.sample import LiveSample
from aqualvs.sources.base import PartHealth, State

_TIME, _HEADER = "builtin_interfaces/msg/Time", "std_msgs/msg/Header"
_POINT, _QUATERNION = "geometry_msgs/msg/Point", "geometry_msgs/msg/Quaternion"
_POSE, _POSE_COV = "geometry_msgs/msg/Pose", "geometry_msgs/msg/PoseWithCovariance"
_FIELD = "sensor_msgs/msg/PointField"
_STATUS, _PAIR = "diagnostic_msgs/msg/DiagnosticStatus", "diagnostic_msgs/msg/KeyValue"

# Ordered so that every type comes after its parts.
_DEFINITIONS = {
    _TIME: "int32 sec, uint32 nanosec",
    _HEADER: f"{_TIME} stamp, string frame_id",
    _POINT: "float64 x, float64 y, float64 z",
    _QUATERNION: "float64 x, float64 y, float64 z, float64 w",
    _POSE: f"{_POINT} position, {_QUATERNION} orientation",
    _POSE_COV: f"{_POSE} pose, float64[36] covariance",
    TYPE_NAMES[PublishedTopic.POSTURE]: f"{_HEADER} header, {_POSE_COV} pose",
    TYPE_NAMES[PublishedTopic.RANGE]: (
        f"{_HEADER} header, uint8 radiation_type, float32 field_of_view, "
        "float32 min_range, float32 max_range, float32 range, float32 variance"
    ),
    _FIELD: "string name, uint32 offset, uint8 datatype, uint32 count",
    TYPE_NAMES[PublishedTopic.CLOUD]: (
        f"{_HEADER} header, uint32 height, uint32 width, {_FIELD}[] fields, bool is_bigendian, "
        "uint32 point_step, uint32 row_step, uint8[] data, bool is_dense"
    ),
    _PAIR: "string key, string value",
    _STATUS: f"uint8 level, string name, string message, string hardware_id, {_PAIR}[] values",
    TYPE_NAMES[PublishedTopic.DIAGNOSTICS]: f"{_HEADER} header, {_STATUS}[] status",
}

_HASHES = {
    PublishedTopic.POSTURE: "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    PublishedTopic.RANGE: "b42b62562e93cbfe9d42b82fe5994dfa3d63d7d5c90a317981703f7388adff3a",
    PublishedTopic.CLOUD: "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
    PublishedTopic.DIAGNOSTICS: "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
}


def type_hash(topic: PublishedTopic) -> bytes:
    """Return the user data that identify the version of a topic's type since ROS 2 Iron.

    Subscribers match without it, but warn (ROS REP-2016).
    """
    kind = PublishedTopic.POSTURE if topic is PublishedTopic.FILTERED else topic
    return f"typehash=RIHS01_{_HASHES[kind]};".encode()


@functools.cache
def dds_types(distro: str) -> Ros2Types:
    """Return the types as a release of ROS 2 has them.

    Raises `OptionError` if cyclonedds is not installed.
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
    classes[TYPE_NAMES[PublishedTopic.CLOUD]].serialize = _serialize_cloud
    return Ros2Types(classes=classes, range_has_variance=with_variance, octet=int, octets=bytes)


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


# Longest time that a slow reader blocks a reliable writer.
_MAX_BLOCKING_NS = 50_000_000
_MAX_DOMAIN = 232
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.5, 8.0
_SLOW_FOR_S = 2.0

_LOCALHOST = (
    "<CycloneDDS><Domain><General><Interfaces>"
    '<NetworkInterface address="127.0.0.1"/></Interfaces></General>'
    "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
    '<Peers><Peer address="localhost"/></Peers></Discovery></Domain></CycloneDDS>'
)
# By default every topic waits a second for dead subscribers when it is closed.
_SHORT_FAREWELL = (
    "<CycloneDDS><Domain><Internal><WriterLingerDuration>100 ms</WriterLingerDuration>"
    "</Internal></Domain></CycloneDDS>"
)


@dataclass(frozen=True, slots=True)
class _Link:
    """Objects of Cyclone DDS that must stay alive while it publishes."""

    domain: Any
    participant: Any
    writers: dict[PublishedTopic, Any]

    def wanted(self) -> frozenset[PublishedTopic]:
        """Return the topics that have subscribers."""
        return frozenset(
            topic
            for topic, writer in self.writers.items()
            if writer.get_publication_matched_status().current_count
        )


class DdsOutput:
    """Publisher of ROS 2 topics, whether ROS 2 is installed or not.

    Parameters
    ----------
    domain_id : int or None
        None for `ROS_DOMAIN_ID`, 0 where that is not set.
    distro : str or None
        Release of ROS 2 of the subscribers, such as `humble`: `Range` has changed. None for
        `ROS_DISTRO`, Jazzy where that is not set.

    Raises
    ------
    OptionError
        If cyclonedds is not installed, or the domain is none.
    """

    name = "ros2"
    inline = False
    keeps_all = False

    def __init__(
        self,
        options: RosOptions | None = None,
        *,
        domain_id: int | None = None,
        distro: str | None = None,
    ) -> None:
        self._options = options or RosOptions()
        self._domain_id = domain_of_this_machine() if domain_id is None else domain_id
        if not 0 <= self._domain_id <= _MAX_DOMAIN:
            raise OptionError(f"ROS domain {self._domain_id}: must be 0 to {_MAX_DOMAIN}")
        self._types = dds_types(distro or distro_of_this_machine())
        self._maker = MessageMaker(self._options)
        self._link: _Link | None = None
        self._closed = False
        self._wait_s, self._retry_s = _FIRST_WAIT_S, 0.0
        self._n_dropped = 0
        self._slow_until_s = 0.0
        self._health = PartHealth(self.name, State.WARN, "not connected yet")

    def send(self, sample: LiveSample) -> None:
        """Publish a sample on the topics that have subscribers.

        A network that is not there is looked for again after half a second, then less and less
        often, up to every eight seconds.
        """
        from cyclonedds.core import DDSException

        try:
            link = self._link or self._connect()
            if link is None:
                self._n_dropped += 1
                return
            wanted = link.wanted()
            for topic, message in self._maker.messages(sample, wanted):
                self._write(link.writers[topic], to_ros2(self._types, message))
        except DDSException as fault:
            self._give_up(fault)
        else:
            self._health = self._well(len(wanted))

    def health(self) -> PartHealth:
        """Return how the link is."""
        return self._health

    def close(self) -> None:
        """Leave the domain; further samples are ignored."""
        self._closed = True
        self._drop_link()
        self._health = PartHealth(self.name, State.OFF, "closed", self._n_dropped)

    def _connect(self) -> _Link | None:
        """Return a link; None while there is reason to wait."""
        if self._closed or time.monotonic() < self._retry_s:
            return None
        self._link = _join(self._domain_id, self._options, self._types)
        self._wait_s = _FIRST_WAIT_S
        return self._link

    def _write(self, writer: Any, message: Any) -> None:
        from cyclonedds.core import DDSException

        try:
            writer.write(message)
        except DDSException as fault:
            if fault.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise
            self._n_dropped += 1
            self._slow_until_s = time.monotonic() + _SLOW_FOR_S

    def _well(self, n_topics: int) -> PartHealth:
        where = f"domain {self._domain_id}"
        if time.monotonic() < self._slow_until_s:
            told = f"{where}: a reliable subscriber is too slow"
            return PartHealth(self.name, State.WARN, told, self._n_dropped)
        told = f"{where}: {n_topics or 'no'} topic{'s' * (n_topics != 1)} listened to"
        return PartHealth(self.name, State.OK, told, self._n_dropped)

    def _give_up(self, fault: Exception) -> None:
        self._drop_link()
        self._n_dropped += 1
        self._retry_s = time.monotonic() + self._wait_s
        told = f"domain {self._domain_id}: {fault}; tried again in {self._wait_s:g} s"
        self._wait_s = min(2.0 * self._wait_s, _LONGEST_WAIT_S)
        self._health = PartHealth(self.name, State.FAULT, told, self._n_dropped)

    def _drop_link(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.writers.clear()


def domain_of_this_machine(environment: Mapping[str, str] = os.environ) -> int:
    """Return the domain that `ROS_DOMAIN_ID` names, 0 without.

    Raises `OptionError` if it is no number.
    """
    text = environment.get("ROS_DOMAIN_ID", "").strip()
    try:
        return int(text or "0")
    except ValueError:
        raise OptionError(
            f"ROS_DOMAIN_ID {text!r} is no number; unset it or use 0 to {_MAX_DOMAIN}"
        ) from None


def stays_on_this_machine(environment: Mapping[str, str] = os.environ) -> bool:
    """Return whether ROS 2 is configured for this machine only, and Cyclone DDS not at all."""
    local = (
        environment.get("ROS_LOCALHOST_ONLY", "") == "1"
        or environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() == "LOCALHOST"
    )
    return local and not environment.get("CYCLONEDDS_URI")


def _join(domain_id: int, options: RosOptions, types: Ros2Types) -> _Link:
    """Enter the domain and offer all topics."""
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic as DdsTopic

    domain = _domain(domain_id)
    participant = DomainParticipant(domain_id)
    writers = {}
    for topic in PublishedTopic:
        kind = types.classes[TYPE_NAMES[topic]]
        offered = DdsTopic(participant, f"rt{options.topic_name(topic)}", kind)
        writers[topic] = DataWriter(participant, offered, _quality(topic, options, types))
    return _Link(domain, participant, writers)


def _domain(domain_id: int) -> Any:
    """Return a domain as the environment wants it; None where the process has it already."""
    from cyclonedds.core import DDSException
    from cyclonedds.domain import Domain

    wishes = _LOCALHOST if stays_on_this_machine() else os.environ.get("CYCLONEDDS_URI", "")
    try:
        return Domain(domain_id, ",".join(filter(None, (wishes, _SHORT_FAREWELL))))
    except DDSException as fault:
        if fault.code == DDSException.DDS_RETCODE_PRECONDITION_NOT_MET:
            return None
        raise


def _quality(topic: PublishedTopic, options: RosOptions, types: Ros2Types) -> Any:
    depth = 5
    from cyclonedds.qos import Policy, Qos

    reliable = options.reliable or topic is PublishedTopic.DIAGNOSTICS
    policies = [
        Policy.Reliability.Reliable(max_blocking_time=_MAX_BLOCKING_NS)
        if reliable
        else Policy.Reliability.BestEffort,
        Policy.Durability.Volatile,
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
    ]
    if types.range_has_variance:
        # Releases before Iron have no type hashes, and another Range.
        policies.append(Policy.Userdata(type_hash(topic)))
    return Qos(*policies)
