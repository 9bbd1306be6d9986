"""ROS 2 topics without ROS: a publisher by Cyclone DDS, compatible with subscribers of ROS 2.

The messages are types of Cyclone DDS with the names and members that rosbags knows of ROS 2, and
its encoding (plain CDR, all types final), so that subscribers of ROS 2 match and read them.
"""

import functools
import importlib
import os
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from aqualvs.errors import OptionError
from aqualvs.live.outputs.base import Output
from aqualvs.live.outputs.ros_messages import (
    TYPE_NAMES,
    MessageMaker,
    PublishedTopic,
    RosOptions,
    RosTypes,
)
from aqualvs.recording.sample import LiveSample
from aqualvs.sources.base import PartHealth, State

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

DEFAULT_DISTRO = "jazzy"
_BEFORE_IRON = frozenset(
    {"ardent", "bouncy", "crystal", "dashing", "eloquent", "foxy", "galactic", "humble"}
)


def range_has_variance(distro: str) -> bool:
    """Return whether a release of ROS 2 has `Range.variance`, as all since Iron have."""
    return distro.lower() not in _BEFORE_IRON


def type_hash(topic: PublishedTopic) -> bytes:
    """Return the user data that identify the version of a topic's type since ROS 2 Iron.

    Subscribers match without it, but warn (ROS REP-2016).
    """
    from rosbags.typesys import Stores, get_typestore

    return f"typehash={get_typestore(Stores.ROS2_JAZZY).hash_rihs01(TYPE_NAMES[topic])};".encode()


@functools.cache
def dds_types(distro: str) -> RosTypes:
    """Return the types as a release of ROS 2 has them: published ones of DDS, parts of rosbags.

    Raises `OptionError` if cyclonedds or rosbags is not installed.
    """
    try:
        from cyclonedds.idl import make_idl_struct
        from rosbags.interfaces import Nodetype
        from rosbags.typesys import Stores, get_typestore
    except ImportError as fault:
        raise OptionError(
            "ROS 2 by DDS needs Cyclone DDS and rosbags; "
            "install them with: pip install 'aqualvs[dds]'"
        ) from fault
    with_variance = range_has_variance(distro)
    store = get_typestore(Stores.ROS2_JAZZY if with_variance else Stores.ROS2_HUMBLE)
    types: Any = importlib.import_module("cyclonedds.idl.types")
    plain = {"string": str, "bool": bool, "byte": types.uint8}

    @functools.cache
    def struct(name: str) -> Any:
        package, kind, short = name.split("/")
        members = {field: member(*node) for field, node in store.fielddefs[name][1]}
        return make_idl_struct(f"{short}_", f"{package}.{kind}.dds_.{short}_", members)

    def member(kind: Nodetype, what: Any) -> Any:
        if kind is Nodetype.NAME:
            return struct(what)
        if kind is Nodetype.BASE:
            return plain.get(what[0]) or getattr(types, what[0])
        one, length = member(*what[0]), what[1]
        return types.array[one, length] if kind is Nodetype.ARRAY else types.sequence[one]

    published = {name: struct(name) for name in TYPE_NAMES.values()}
    for name, made in published.items():
        made.serialize = _serializer(store, name)
    return RosTypes(classes={**store.types, **published}, range_has_variance=with_variance)


def _serializer(store: "Typestore", name: str) -> Callable[..., bytes]:
    """Return a method in place of Cyclone DDS's own, which packs clouds number by number."""
    return lambda message, **_: bytes(store.serialize_cdr(message, name))


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
_SHORT_LINGER = (
    "<CycloneDDS><Domain><Internal><WriterLingerDuration>100 ms</WriterLingerDuration>"
    "</Internal></Domain></CycloneDDS>"
)


class _Link(NamedTuple):
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


class DdsOutput(Output):
    """Publisher of ROS 2 topics, whether ROS 2 is installed or not.

    `domain_id`: None for `ROS_DOMAIN_ID`, 0 where that is not set. `distro`: release of ROS 2 of
    the subscribers, such as `humble`: `Range` has changed; None for `ROS_DISTRO`, Jazzy where that
    is not set.

    Raises `OptionError` if cyclonedds or rosbags is not installed, or the domain is none.
    """

    name = "ros2"

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
        self._types = dds_types(distro or os.environ.get("ROS_DISTRO") or DEFAULT_DISTRO)
        self._maker = MessageMaker(self._options, self._types)
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
                self._write(link.writers[topic], message)
        except DDSException as fault:
            self._disconnect_after(fault)
        else:
            self._health = self._connected_health(len(wanted))

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

    def _connected_health(self, n_topics: int) -> PartHealth:
        where = f"domain {self._domain_id}"
        if time.monotonic() < self._slow_until_s:
            text = f"{where}: a reliable subscriber is too slow"
            return PartHealth(self.name, State.WARN, text, self._n_dropped)
        text = f"{where}: {n_topics or 'no'} topic{'s' * (n_topics != 1)} listened to"
        return PartHealth(self.name, State.OK, text, self._n_dropped)

    def _disconnect_after(self, fault: Exception) -> None:
        self._drop_link()
        self._n_dropped += 1
        self._retry_s = time.monotonic() + self._wait_s
        text = f"domain {self._domain_id}: {fault}; tried again in {self._wait_s:g} s"
        self._wait_s = min(2.0 * self._wait_s, _LONGEST_WAIT_S)
        self._health = PartHealth(self.name, State.FAULT, text, self._n_dropped)

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
            f"ROS_DOMAIN_ID {text!r} is not a number; unset it or use 0 to {_MAX_DOMAIN}"
        ) from None


def stays_on_this_machine(environment: Mapping[str, str] = os.environ) -> bool:
    """Return whether ROS 2 is configured for this machine only, and Cyclone DDS not at all."""
    local = (
        environment.get("ROS_LOCALHOST_ONLY", "") == "1"
        or environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() == "LOCALHOST"
    )
    return local and not environment.get("CYCLONEDDS_URI")


def _join(domain_id: int, options: RosOptions, types: RosTypes) -> _Link:
    """Enter the domain and offer all topics."""
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic as DdsTopic

    domain = _domain(domain_id)
    participant = DomainParticipant(domain_id)
    writers = {}
    for topic in PublishedTopic:
        kind = types.classes[TYPE_NAMES[topic]]
        offered = DdsTopic(participant, f"rt{topic.full_name}", kind)
        writers[topic] = DataWriter(participant, offered, _qos(topic, options, types))
    return _Link(domain, participant, writers)


def _domain(domain_id: int) -> Any:
    """Return a domain as the environment wants it; None where the process has it already."""
    from cyclonedds.core import DDSException
    from cyclonedds.domain import Domain

    config = _LOCALHOST if stays_on_this_machine() else os.environ.get("CYCLONEDDS_URI", "")
    try:
        return Domain(domain_id, ",".join(filter(None, (config, _SHORT_LINGER))))
    except DDSException as fault:
        if fault.code == DDSException.DDS_RETCODE_PRECONDITION_NOT_MET:
            return None
        raise


def _qos(topic: PublishedTopic, options: RosOptions, types: RosTypes) -> Any:
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
