"""The native ROS 2 node, with stand-ins for rclpy; its messages are those of rosbags."""

import array
import itertools
import runpy
import subprocess
import sys
import threading
import time
import tomllib
import types
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar
from unittest import mock

import numpy as np
import pytest
import yaml
from rosbags.typesys import Stores, get_typestore

from aqualvs.errors import OptionError
from aqualvs.live.outputs.dds import dds_types
from aqualvs.live.outputs.ros_messages import (
    POINT_TYPE,
    TYPE_NAMES,
    MessageMaker,
    PublishedTopic,
    RosOptions,
    flu_from_dome,
)
from aqualvs.recording.encoding import jpeg_of
from aqualvs.recording.sample import LiveSample
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.scan import Frame, planes_of_image
from aqualvs.sources.base import PartHealth, State, bgr_of
from aqualvs.sources.opening import open_feed
from live_cases import demo_frames, demo_rig, demo_samples, renumbered
from repository import ROOT

PACKAGE = ROOT / "ros2" / "aqualvs_ros"
ENOUGH = 12
# Topics that have a message for each posture, where a node has them; outputs work side by side.
MOVING = {"~/posture", "~/cloud", "/tf"}
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
    # By topic: what is published there, one after the other.
    heard_by_all: ClassVar[dict[str, Iterator[Any]]] = {}

    def __init__(self, name: str = "aqualvs") -> None:
        self.name = name
        self.publishers: dict[str, Publisher] = {}
        self.published: dict[str, list[Any]] = {}
        self.parameters: dict[str, Any] = {}
        self.errors: list[str] = []
        self.warnings: list[str] = []
        self.heard: dict[str, tuple[type, Callable[[Any], None], Any]] = {}
        self.destroyed = False
        self.made.append(self)

    def declare_parameter(self, name: str, default: Any) -> None:
        self.parameters[name] = self.asked.get(name, default)

    def get_parameter(self, name: str) -> Any:
        return types.SimpleNamespace(value=self.parameters[name])

    def get_logger(self) -> Any:
        return types.SimpleNamespace(error=self.errors.append, warning=self.warnings.append)

    def create_subscription(
        self, kind: type, topic: str, callback: Callable[[Any], None], quality: Any
    ) -> None:
        self.heard[topic] = kind, callback, quality

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
    quality.QoSProfile = lambda **wishes: wishes
    quality.ReliabilityPolicy = types.SimpleNamespace(
        RELIABLE="reliable", BEST_EFFORT="best effort"
    )
    quality.DurabilityPolicy = types.SimpleNamespace(TRANSIENT_LOCAL="transient local")
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
            for topic, (kind, callback, _) in list(node.heard.items()):
                message = next(node.heard_by_all.get(topic, iter(())), None)
                if message is not None:
                    assert isinstance(message, kind)
                    callback(message)
                    time.sleep(0.03)
            if node.published and all(
                len(node.published[topic]) >= ENOUGH for topic in MOVING & set(node.published)
            ):
                # As an interrupt does, in the middle of the dive.
                running.clear()
        raise rclpy.executors.ExternalShutdownException

    rclpy.spin = spin
    for module in (rclpy, rclpy.executors, rclpy.node):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.delitem(sys.modules, "aqualvs_ros.node", raising=False)
    monkeypatch.setattr(Node, "made", [])
    monkeypatch.setattr(Node, "heard_by_all", {})


@pytest.fixture(scope="module")
def sample() -> LiveSample:
    return demo_samples(2)[1]


def test_needs_no_rosbags() -> None:
    code = (
        f"import sys; sys.modules['rosbags'] = None; sys.path.append({str(PACKAGE)!r}); "
        "import aqualvs_ros.output, aqualvs_ros.frames, aqualvs_ros.pictures"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


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
    maker = MessageMaker(RosOptions(), dds_types("jazzy"))
    for topic, message in maker.messages(sample, set(PublishedTopic)):
        name = "/diagnostics" if topic is PublishedTopic.DIAGNOSTICS else f"~/{topic}"
        (published,) = node.publishers[name].published
        assert serialized(published, topic) == message.serialize(use_version_2=False)
    assert output.health().state is State.OK


def serialized(message: Any, topic: PublishedTopic) -> bytes:
    """Bytes of a message, after the kinds of values that rclpy insists on were put in order."""
    if topic is PublishedTopic.CLOUD:
        assert isinstance(message.data, array.array)
        message.data = np.array(message.data, np.uint8)
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


class Again:
    """A source that is played again and again: a dive that nothing but an interrupt ends."""

    def __init__(self, where: str) -> None:
        self.name, self._where = where, where
        self._feed = open_feed(where)
        self._closed = False

    def __iter__(self) -> Iterator[Frame]:
        numbers = itertools.count()
        while not self._closed:
            for frame in self._feed:
                yield renumbered(frame, next(numbers))
            self._feed = open_feed(self._where)

    def health(self) -> PartHealth:
        return self._feed.health()

    def close(self) -> None:
        self._closed = True
        self._feed.close()


def test_node_measures_a_dive(make: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    import aqualvs_ros.node

    # Loading kernels may take longer than the dive, and more pictures are passed over then.
    monkeypatch.setattr(aqualvs_ros.node, "open_feed", Again)
    folder = ROOT / "src" / "aqualvs" / "data" / "demo"
    code, node = run_node(
        monkeypatch,
        source=str(folder / "dive.mp4"),
        rig=str(folder / "rig.yaml"),
        frame_id="rov1/dome",
        filter=True,
    )
    assert (code, node.errors) == (0, [])
    assert len(node.published["~/posture"]) >= ENOUGH
    assert len(node.published["~/posture_filtered"]) >= ENOUGH
    assert node.published["~/range"][0].header.frame_id == "rov1/dome"
    assert node.publishers == {}


def ros(kind: str, **fields: Any) -> Any:
    """A message as rclpy's classes make it, of the definitions of Jazzy."""
    package, short = kind.split("/")
    return getattr(sys.modules[f"{package}.msg"], short)(**fields)


def header(stamp_ns: int) -> Any:
    sec, nanosec = divmod(stamp_ns, 10**9)
    return ros(
        "std_msgs/Header",
        stamp=ros("builtin_interfaces/Time", sec=sec, nanosec=nanosec),
        frame_id="camera",
    )


def image_messages(transport: str, stamps_ns: list[int]) -> list[Any]:
    """Pictures of the bundled dive."""
    made = []
    for frame, stamp_ns in zip(demo_frames(len(stamps_ns)), stamps_ns, strict=True):
        image = bgr_of(frame)
        if transport == "raw":
            height, width = image.shape[:2]
            fields = {"height": height, "width": width, "encoding": "bgr8", "is_bigendian": 0}
            fields |= {"step": 3 * width, "data": array.array("B", image.tobytes())}
            made.append(ros("sensor_msgs/Image", header=header(stamp_ns), **fields))
        else:
            data = array.array("B", jpeg_of(frame, 95))
            # As image_transport words it.
            words = "bgr8; jpeg compressed bgr8"
            kind = "sensor_msgs/CompressedImage"
            made.append(ros(kind, header=header(stamp_ns), format=words, data=data))
    return made


def camera(transport: str, stamps_ns: list[int]) -> Iterator[Any]:
    """Film the bundled dive again and again at 25 Hz, and note the stamps.

    The node measures the latest picture: how many it passes over depends on the machine.
    """
    images = image_messages(transport, [0] * (ENOUGH + 4))
    for i, image in enumerate(itertools.cycle(images)):
        stamps_ns.append(5 * 10**9 + 40_000_000 * i)
        yield replace(image, header=header(stamps_ns[-1]))


def camera_info(**more: Any) -> Any:
    rig = demo_rig()
    width, height = rig.size_px
    lens = rig.lens
    k = np.array([lens.fx, 0.0, lens.cx, 0.0, lens.fy, lens.cy, 0.0, 0.0, 1.0])
    whole = ros(
        "sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    fields = {"height": height, "width": width, "distortion_model": "plumb_bob", "k": k}
    fields |= {"d": np.zeros(5), "r": np.eye(3).ravel(), "p": np.zeros(12)}
    fields |= {"binning_x": 0, "binning_y": 0, "roi": whole, **more}
    return ros("sensor_msgs/CameraInfo", header=header(0), **fields)


@pytest.mark.parametrize("transport", ["raw", "compressed"])
def test_node_measures_an_image_topic(
    make: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, transport: str
) -> None:
    stamps: list[int] = []
    topic = "/camera/image_raw" + ("" if transport == "raw" else "/compressed")
    Node.heard_by_all[topic] = camera(transport, stamps)
    Node.heard_by_all["/camera/camera_info"] = iter([camera_info()])
    code, node = run_node(
        monkeypatch,
        image_topic="/camera/image_raw",
        image_transport=transport,
        rig=str(ROOT / "src" / "aqualvs" / "data" / "demo" / "rig.yaml"),
        base_frame="base_link",
        mount_xyz_m=[0.21, 0.0, -0.05],
    )
    assert (code, node.errors, node.warnings) == (0, [], [])
    assert node.heard[topic][2] == {"depth": 1, "reliability": "best effort"}
    for name in ("~/posture", "~/cloud", "/tf"):
        # A cloud without points tells of silence, which a busy machine makes too.
        messages = [one for one in node.published[name] if getattr(one, "width", 1)]
        headers = [getattr(one, "header", None) or one.transforms[0].header for one in messages]
        # The times of the pictures, not those of their arrival.
        found = [head.stamp.sec * 10**9 + head.stamp.nanosec for head in headers]
        assert len(found) >= ENOUGH
        assert set(found) <= set(stamps)
    (fixed,) = node.published["/tf_static"]
    assert [(one.header.frame_id, one.child_frame_id) for one in fixed.transforms] == [
        ("base_link", "aqualvs_dome"),
        ("aqualvs_dome", "aqualvs_camera_optical"),
    ]


def test_camera_info_that_is_another_camera_s(make: Callable[..., Any]) -> None:
    from aqualvs_ros.pictures import camera_info_doubts

    rig = demo_rig()
    assert camera_info_doubts(camera_info(), rig) == []
    assert camera_info_doubts(camera_info(k=np.zeros(9)), rig) == []
    k = camera_info().k.copy()
    k[0] *= 1.34
    (doubt,) = camera_info_doubts(camera_info(k=k), rig)
    assert doubt == f"fx {1.34 * rig.lens.fx:.1f}, but the rig has {rig.lens.fx:.1f}"
    (doubt,) = camera_info_doubts(camera_info(width=1920, height=1080), rig)
    assert doubt.startswith("pictures of 1920x1080 px, but the rig")
    assert "binned" in camera_info_doubts(camera_info(binning_x=2), rig)[0]


def test_feed_keeps_the_latest_and_tells_what_it_cannot_read(make: Callable[..., Any]) -> None:
    from aqualvs_ros.pictures import TopicFeed

    feed = TopicFeed("/camera/image_raw")
    assert feed.health().state is State.WARN
    first, second, third = image_messages("raw", [10**9, 2 * 10**9, 3 * 10**9])
    frames = iter(feed)
    feed.put(first)
    assert (frame := next(frames)).index == 0
    assert np.array_equal(frame.luma, planes_of_image(bgr_of(demo_frames(1)[0]))[0])
    feed.put(second)
    feed.put(third)
    # A gap in the numbers says that one was replaced; its time is that of its header.
    assert ((frame := next(frames)).index, frame.time_s) == (2, 2.0)
    assert (feed.stamp_ns(2), feed.stamp_ns(1)) == (3 * 10**9, None)
    assert feed.health().n_dropped == 1
    third.encoding = "32FC1"
    feed.put(third)
    feeder = threading.Timer(0.2, feed.close)
    feeder.start()
    assert list(frames) == []
    assert "cannot be decoded (encoding '32FC1')" in feed.health().detail


def test_frames_agree_with_the_library(make: Callable[..., Any], sample: LiveSample) -> None:
    from aqualvs_ros.frames import FrameNames, fixed_transforms, target_transform
    from aqualvs_ros.output import FramesOutput

    rig, posture = sample.rig, sample.scan.posture
    assert isinstance(posture, Posture)
    names = FrameNames(base="base_link", mount_xyz_m=(0.2, 0.0, 0.1), mount_rpy_deg=(0, 90, 0))
    mount, camera = fixed_transforms(rig, names)
    # Pitched down by a right angle, forward becomes down.
    assert rotated(mount.quaternion, [1.0, 0.0, 0.0]) == pytest.approx([0.0, 0.0, -1.0])
    axis = rig.dome_from_cam.rotate([0.0, 0.0, 1.0])
    assert rotated(camera.quaternion, [0.0, 0.0, 1.0]) == pytest.approx(flu_from_dome(axis))
    target = target_transform(posture, names)
    normal = flu_from_dome(posture.normal_in_dome)
    assert rotated(target.quaternion, [1.0, 0.0, 0.0]) == pytest.approx(normal)
    assert target.position == pytest.approx(posture.range * normal)
    node = Node()
    output = FramesOutput(node, names)
    fixed, moving = node.published["/tf_static"], node.published["/tf"]
    # Who comes late hears of the fixed frames too.
    assert node.publishers["/tf_static"].quality["durability"] == "transient local"
    output.send(sample)
    output.send(sample)
    refused = replace(sample.scan, posture=Refusal(Reason.NO_STRIPES))
    output.send(replace(sample, scan=refused))
    assert (len(fixed), len(moving)) == (1, 2)
    # Real definitions: what does not fit them cannot be encoded.
    again = STORE.deserialize_cdr(
        STORE.serialize_cdr(moving[0], "tf2_msgs/msg/TFMessage"), "tf2_msgs/msg/TFMessage"
    )
    (one,) = again.transforms
    assert (one.header.frame_id, one.child_frame_id) == ("aqualvs_dome", "aqualvs_target")
    assert one.transform.translation.x == target.position[0]
    output.close()
    output.send(sample)
    assert len(moving) == 2


def rotated(quaternion: Any, vector: list[float]) -> Any:
    x, y, z, w = quaternion
    turn = np.array([x, y, z])
    v = np.array(vector)
    return v + 2.0 * np.cross(turn, np.cross(turn, v) + w * v)


def test_a_mount_without_sense_is_refused(make: Callable[..., Any]) -> None:
    from aqualvs_ros.frames import FrameNames

    with pytest.raises(OptionError, match="mount_xyz_m"):
        FrameNames(mount_xyz_m=[0.0, float("nan"), 0.0])


def test_files_of_the_package_agree_with_the_node(
    make: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    from aqualvs_ros.node import PARAMETERS

    file = yaml.safe_load((PACKAGE / "config" / "aqualvs.yaml").read_text())
    assert file["/**"]["ros__parameters"] == PARAMETERS
    rviz = yaml.safe_load((PACKAGE / "rviz" / "aqualvs.rviz").read_text())["Visualization Manager"]
    assert rviz["Global Options"]["Fixed Frame"] == PARAMETERS["frame_id"]
    topics = {one["Topic"]["Value"] for one in rviz["Displays"] if "Topic" in one}
    node = Node()
    make(node)
    assert topics <= {topic.replace("~", "/aqualvs") for topic in node.publishers}
    (cloud,) = (one for one in rviz["Displays"] if one["Class"].endswith("PointCloud2"))
    assert cloud["Channel Name"] in POINT_TYPE.names
    launch = launch_file(monkeypatch)
    assert set(launch["ARGUMENTS"]) - {"params_file", "rviz"} <= set(PARAMETERS)
    given = {"rig": "rig.yaml", "source": "", "filter": "True", "rviz": "true"}
    assert launch["parameters"](given) == {"rig": "rig.yaml", "filter": True}
    installed = (PACKAGE / "setup.py").read_text()
    for folder in ("config", "launch", "rviz"):
        assert all(f"{folder}/{one.name}" in installed for one in (PACKAGE / folder).glob("*.*"))


def launch_file(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Names of the launch file, with stand-ins for what it imports."""
    for name in ("ament_index_python.packages", "launch.actions", "launch.substitutions"):
        for part in (name.partition(".")[0], name):
            monkeypatch.setitem(sys.modules, part, mock.MagicMock())
    for name in ("launch_ros", "launch_ros.actions"):
        monkeypatch.setitem(sys.modules, name, mock.MagicMock())
    return runpy.run_path(str(PACKAGE / "launch" / "aqualvs.launch.py"))


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
