"""The native ROS 2 node, with stand-ins for rclpy; its messages are those of rosbags."""

import array
import sys
import threading
import time
import tomllib
import types
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from aqualvs.live.outputs.dds import dds_types
from aqualvs.live.outputs.ros2_messages import TYPE_NAMES, to_ros2
from aqualvs.live.outputs.ros_messages import MessageMaker, PublishedTopic, RosOptions
from aqualvs.recording.sample import LiveSample
from aqualvs.sources.base import State
from live_cases import demo_samples
from repository import ROOT

PACKAGE = ROOT / "ros2" / "aqualvs_ros"
ENOUGH = 12
STORE = get_typestore(Stores.ROS2_JAZZY)


@dataclass
class Publisher:
    kind: type
    topic: str
    quality: Any
    n_subscribers: int = 1
    published: list[Any] = field(default_factory=list)

    def get_subscription_count(self) -> int:
        return self.n_subscribers

    def publish(self, message: Any) -> None:
        assert isinstance(message, self.kind)
        self.published.append(message)


class Node:
    """What the package needs of a node."""

    asked: ClassVar[dict[str, Any]] = {}
    made: ClassVar[list["Node"]] = []

    def __init__(self, name: str = "aqualvs") -> None:
        self.name = name
        self.publishers: dict[str, Publisher] = {}
        self.published: dict[str, list[Any]] = {}
        self.parameters: dict[str, Any] = {}
        self.errors: list[str] = []
        self.destroyed = False
        self.made.append(self)

    def declare_parameter(self, name: str, default: Any) -> None:
        self.parameters[name] = self.asked.get(name, default)

    def get_parameter(self, name: str) -> Any:
        return types.SimpleNamespace(value=self.parameters[name])

    def get_logger(self) -> Any:
        return types.SimpleNamespace(error=self.errors.append)

    def destroy_node(self) -> None:
        self.destroyed = True

    def create_publisher(self, kind: type, topic: str, quality: Any) -> Publisher:
        self.publishers[topic] = Publisher(kind, topic, quality)
        self.published[topic] = self.publishers[topic].published
        return self.publishers[topic]

    def destroy_publisher(self, publisher: Publisher) -> None:
        del self.publishers[publisher.topic]


def message_class(name: str) -> type:
    """A class that takes its fields by name, and says which it has, as those of rclpy do."""
    base: Any = STORE.types[name]
    fields = {field_name: "" for field_name, _ in STORE.fielddefs[name][1]}
    return type(base.__name__, (base,), {"get_fields_and_field_types": lambda: fields})


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Maker of the output under test, rclpy and the messages replaced."""
    for name in STORE.types:
        package, _, short = name.split("/")
        module = sys.modules.get(f"{package}.msg")
        if module is None:
            module = types.ModuleType(f"{package}.msg")
            monkeypatch.setitem(sys.modules, package, types.ModuleType(package))
            monkeypatch.setitem(sys.modules, f"{package}.msg", module)
        setattr(module, short, message_class(name))
    quality = types.ModuleType("rclpy.qos")
    quality.QoSProfile = lambda **wishes: wishes  # type: ignore[attr-defined]
    quality.ReliabilityPolicy = types.SimpleNamespace(  # type: ignore[attr-defined]
        RELIABLE="reliable", BEST_EFFORT="best effort"
    )
    monkeypatch.setitem(sys.modules, "rclpy.qos", quality)
    replace_rclpy(monkeypatch)
    monkeypatch.syspath_prepend(str(PACKAGE))
    from aqualvs_ros.output import RclpyOutput

    return RclpyOutput


def replace_rclpy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a context in its place that can be shut down, once."""
    running = threading.Event()
    rclpy: Any = types.ModuleType("rclpy")
    rclpy.init = lambda **_: running.set()
    rclpy.ok = running.is_set
    rclpy.try_shutdown = running.clear
    rclpy.executors = types.ModuleType("rclpy.executors")
    rclpy.executors.ExternalShutdownException = type("Ended", (Exception,), {})
    rclpy.node = types.ModuleType("rclpy.node")
    rclpy.node.Node = Node

    def spin(node: Node) -> None:
        while running.is_set():
            time.sleep(0.01)
            if len(node.published.get("~/posture", ())) >= ENOUGH:
                # As an interrupt does, in the middle of the dive.
                running.clear()
        raise rclpy.executors.ExternalShutdownException

    rclpy.spin = spin
    for module in (rclpy, rclpy.executors, rclpy.node):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.delitem(sys.modules, "aqualvs_ros.node", raising=False)
    monkeypatch.setattr(Node, "made", [])


@pytest.fixture(scope="module")
def sample() -> LiveSample:
    return demo_samples(2)[1]


def test_topics(make: Callable[..., Any]) -> None:
    node = Node()
    make(node)
    assert set(node.publishers) == {
        "~/posture",
        "~/posture_filtered",
        "~/range",
        "~/cloud",
        "/diagnostics",
    }
    assert node.publishers["~/cloud"].quality == {"depth": 5, "reliability": "reliable"}


def test_best_effort_but_for_diagnostics(make: Callable[..., Any]) -> None:
    node = Node()
    make(node, RosOptions(reliable=False))
    kinds = {topic: one.quality["reliability"] for topic, one in node.publishers.items()}
    assert kinds.pop("/diagnostics") == "reliable"
    assert set(kinds.values()) == {"best effort"}


def test_messages_are_those_of_dds(make: Callable[..., Any], sample: LiveSample) -> None:
    node = Node()
    output = make(node)
    output.send(sample)
    dds = dds_types("jazzy")
    for topic, message in MessageMaker(RosOptions()).messages(sample, set(PublishedTopic)):
        name = "/diagnostics" if topic is PublishedTopic.DIAGNOSTICS else f"~/{topic}"
        (published,) = node.publishers[name].published
        expected = to_ros2(dds, message).serialize(use_version_2=False)
        assert serialized(published, topic) == expected
    assert output.health().state is State.OK


def serialized(message: Any, topic: PublishedTopic) -> bytes:
    """Bytes of a message, after the kinds of values that rclpy insists on were put in order."""
    if topic is PublishedTopic.CLOUD:
        assert isinstance(message.data, array.array)
        message.data = np.array(message.data, np.uint8)
    if topic is PublishedTopic.POSTURE:
        message.pose.covariance = np.array(message.pose.covariance)
    if topic is PublishedTopic.DIAGNOSTICS:
        for status in message.status:
            assert isinstance(status.level, bytes)
            status.level = status.level[0]
    return bytes(STORE.serialize_cdr(message, TYPE_NAMES[topic]))


def test_nothing_is_made_for_nobody(make: Callable[..., Any], sample: LiveSample) -> None:
    node = Node()
    output = make(node)
    for publisher in node.publishers.values():
        publisher.n_subscribers = 0
    node.publishers["~/range"].n_subscribers = 1
    output.send(sample)
    assert [topic for topic, one in node.publishers.items() if one.published] == ["~/range"]
    assert output.health().detail == "1 topic listened to"


def test_close(make: Callable[..., Any], sample: LiveSample) -> None:
    node = Node()
    output = make(node)
    output.close()
    output.close()
    output.send(replace(sample))
    assert node.publishers == {}
    assert output.health().state is State.OFF


def run_node(monkeypatch: pytest.MonkeyPatch, **parameters: Any) -> tuple[int, Node]:
    from aqualvs_ros.node import main

    monkeypatch.setattr(Node, "asked", parameters)
    code = main()
    (node,) = Node.made
    assert node.destroyed
    return code, node


def test_node_measures_a_dive(make: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    folder = ROOT / "src" / "aqualvs" / "data" / "demo"
    code, node = run_node(
        monkeypatch,
        source=str(folder / "dive.mp4"),
        rig=str(folder / "rig.yaml"),
        frame_id="rov1/dome",
        filter=True,
    )
    assert (code, node.errors) == (0, [])
    assert ENOUGH <= len(node.published["~/posture"]) < 100
    assert len(node.published["~/posture_filtered"]) >= ENOUGH
    assert node.published["~/range"][0].header.frame_id == "rov1/dome"
    assert node.publishers == {}


@pytest.mark.parametrize("wrong", ["source", "rig"])
def test_node_says_what_is_wrong(
    make: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, wrong: str
) -> None:
    folder = ROOT / "src" / "aqualvs" / "data" / "demo"
    sound = {"source": str(folder / "dive.mp4"), "rig": str(folder / "rig.yaml")}
    code, node = run_node(monkeypatch, **{**sound, wrong: str(folder / "nothing.mp4")})
    assert code == 2
    assert "nothing.mp4" in node.errors[0]


def test_versions_agree() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    manifest = ElementTree.parse(PACKAGE / "package.xml").getroot()
    assert manifest.findtext("version") == project["version"]
    assert f'version="{project["version"]}"' in (PACKAGE / "setup.py").read_text()
    # What the project carries besides, a library for its pages, is no part of the ROS package.
    assert manifest.findtext("license") == "Apache-2.0"
    assert "Apache-2.0" in project["license"].split()
