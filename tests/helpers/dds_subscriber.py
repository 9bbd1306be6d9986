"""A ROS 2 subscriber in a process of its own: one line of JSON for each message.

Its types are made here of the definitions that rosbags holds, whose hashes the tests pin.

usage: dds_subscriber.py DOMAIN STORE RELIABILITY NAMESPACE
"""

import base64
import dataclasses
import json
import sys
import time
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

LONGEST_S = 180.0
PLAIN = {"string": str, "bool": bool, "octet": types.uint8, "byte": types.uint8}
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"


class Definitions:
    """DDS types of the messages of one release of ROS 2."""

    def __init__(self, store: str) -> None:
        self._fields = get_typestore(Stores(store)).fielddefs
        self._made: dict[str, Any] = {}

    def type(self, name: str) -> Any:
        if name not in self._made:
            package, kind, short = name.split("/")
            members = {field: self._node(node) for field, node in self._fields[name][1]}
            typename = f"{package}.{kind}.dds_.{short}_"
            self._made[name] = make_idl_struct(f"{short}_", typename, members)
        return self._made[name]

    def _node(self, node: Any) -> Any:
        kind, what = node
        if kind is Nodetype.NAME:
            return self.type(what)
        if kind is Nodetype.BASE:
            return PLAIN.get(what[0]) or getattr(types, what[0])
        inner = self._node(what[0])
        return types.array[inner, what[1]] if kind is Nodetype.ARRAY else types.sequence[inner]


def plain(value: Any) -> Any:
    """The message as what JSON knows; data of clouds as base 64."""
    if dataclasses.is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, list):
        if len(value) > 100:
            return base64.b64encode(bytes(value)).decode()
        return [plain(one) for one in value]
    return value


def quality_of(offer: Any) -> dict[str, Any]:
    """What a publisher says of itself."""
    has = {policy.__scope__: policy for policy in offer.qos}
    representation = has["DataRepresentation"]
    return {
        "topic": offer.topic_name,
        "type": offer.type_name,
        "user_data": has["Userdata"].data.decode() if "Userdata" in has else "",
        "reliability": repr(has["Reliability"]),
        "durability": repr(has["Durability"]),
        "representation": [
            representation.use_cdrv0_representation,
            representation.use_xcdrv2_representation,
        ],
    }


def main(domain: str, store: str, reliability: str, namespace: str) -> None:
    definitions = Definitions(store)
    participant = DomainParticipant(int(domain))
    wish = (
        Policy.Reliability.Reliable(duration(milliseconds=100))
        if reliability == "reliable"
        else Policy.Reliability.BestEffort
    )
    quality = Qos(wish, Policy.Durability.Volatile, Policy.History.KeepLast(10))
    topics = {
        f"rt/{namespace}/posture": POSE,
        f"rt/{namespace}/posture_filtered": POSE,
        f"rt/{namespace}/range": "sensor_msgs/msg/Range",
        f"rt/{namespace}/cloud": "sensor_msgs/msg/PointCloud2",
        "rt/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    }
    readers = {
        topic: DataReader(participant, Topic(participant, topic, definitions.type(kind)), quality)
        for topic, kind in topics.items()
    }
    print(json.dumps({"ready": True}), flush=True)
    offers = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
    end = time.monotonic() + LONGEST_S
    while time.monotonic() < end:
        for topic, reader in readers.items():
            for message in reader.take(10):
                at = time.time_ns()
                if hasattr(message, "header"):
                    told = {"topic": topic, "at_ns": at, "message": plain(message)}
                    print(json.dumps(told), flush=True)
        for offer in offers.take(10):
            # Without a quality it is not an offer but the end of one.
            if offer.qos is not None:
                print(json.dumps({"offer": quality_of(offer)}), flush=True)
        time.sleep(0.0005)


if __name__ == "__main__":
    main(*sys.argv[1:])
