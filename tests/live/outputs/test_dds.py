"""Publishing to ROS 2 by DDS: a subscriber in another process, on the loopback interface."""

import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from aqualvs.errors import OptionError
from aqualvs.live.outputs import dds as types_module
from aqualvs.live.outputs.dds import (
    DdsOutput,
    domain_of_this_machine,
    stays_on_this_machine,
    type_hash,
)
from aqualvs.live.outputs.ros_messages import TYPE_NAMES, PublishedTopic, RosOptions, plane_pose
from aqualvs.recording.sample import LiveSample
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.sources.base import State
from live_cases import demo_samples
from repository import HELPERS
from ros_listener import (
    Listener,
    expected_points,
    n_threads,
    points_of,
    send_now,
    send_until,
    typical_send,
    until,
)

SUBSCRIBER = HELPERS / "dds_subscriber.py"
# One for each test run on a machine; every domain has ports of its own.
DOMAIN = 100 + os.getpid() % 100
LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface address='127.0.0.1'/>"
    "</Interfaces></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<Peers><Peer address='localhost'/></Peers></Discovery></Domain></CycloneDDS>"
)
NOWHERE = LOOPBACK.replace("127.0.0.1", "203.0.113.77")

Listen = Callable[..., Listener]
Publish = Callable[..., DdsOutput]


@pytest.fixture(autouse=True)
def loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    for name in ("ROS_DOMAIN_ID", "ROS_DISTRO", "ROS_LOCALHOST_ONLY"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def listen() -> Iterator[Listen]:
    listeners = []

    def start(distro: str = "jazzy", reliability: str = "reliable") -> Listener:
        command = [sys.executable, SUBSCRIBER, DOMAIN, f"ros2_{distro}", reliability, "aqualvs"]
        listeners.append(Listener([str(c) for c in command], {**os.environ, "LANG": "C"}))
        return listeners[-1]

    yield start
    for listener in listeners:
        listener.close()


@pytest.fixture
def publish() -> Iterator[Publish]:
    outputs = []

    def start(options: RosOptions | None = None, **more: Any) -> DdsOutput:
        outputs.append(DdsOutput(options, domain_id=DOMAIN, **more))
        return outputs[-1]

    yield start
    for output in outputs:
        output.close()


@pytest.fixture(scope="module")
def sample() -> LiveSample:
    found = demo_samples(2)[1]
    assert found.scan.posture
    return found


@pytest.mark.parametrize(
    ("distro", "reliability"), [("jazzy", "reliable"), ("humble", "best_effort")]
)
def test_values_arrive(
    distro: str, reliability: str, listen: Listen, publish: Publish, sample: LiveSample
) -> None:
    output, listener = publish(distro=distro), listen(distro, reliability)
    heard = ("/posture", "/range", "/cloud", "diagnostics")
    assert send_until(output, sample, lambda: listener.has_heard(*heard))
    check_values(listener, sample, variance=distro == "jazzy")
    assert output.health().state is State.OK
    check_offers(listener, hashes=distro == "jazzy")


def check_values(listener: Listener, sample: LiveSample, *, variance: bool) -> None:
    posture = sample.scan.posture
    assert posture
    pose = plane_pose(posture.range, posture.pitch, posture.yaw, posture.total_covariance)
    message = listener.messages("/aqualvs/posture")[-1]
    assert message["header"]["frame_id"] == "aqualvs_dome"
    assert [*message["pose"]["pose"]["position"].values()] == pose.position.tolist()
    assert [*message["pose"]["pose"]["orientation"].values()] == pose.quaternion.tolist()
    assert message["pose"]["covariance"] == pose.covariance.ravel().tolist()

    message = listener.messages("/aqualvs/range")[-1]
    assert message["range"] == np.float32(posture.range)
    assert message["radiation_type"] == 1
    if variance:
        assert message["variance"] == np.float32(posture.total_covariance[0, 0])

    cloud = listener.messages("/aqualvs/cloud")[-1]
    assert cloud["width"] == len(sample.scan.points)
    assert cloud["row_step"] == cloud["width"] * cloud["point_step"]
    assert points_of(cloud).tolist() == expected_points(sample).tolist()

    diagnostics = listener.messages("diagnostics")[0]
    assert diagnostics["status"][0]["name"] == "aqualvs: posture"
    pairs = {pair["key"]: pair["value"] for pair in diagnostics["status"][0]["values"]}
    assert float(pairs["range_m"]) == pytest.approx(posture.range, rel=1e-5)


def check_offers(listener: Listener, *, hashes: bool) -> None:
    """Names and quality as subscribers of ROS 2 look for them."""

    def offers() -> dict[str, Any]:
        return {h["offer"]["topic"]: h["offer"] for h in listener.heard if "offer" in h}

    names = {topic: f"rt{topic.full_name}" for topic in PublishedTopic}
    assert until(lambda: set(names.values()) <= set(offers()))
    for topic, name in names.items():
        offer = offers()[name]
        package, kind, short = TYPE_NAMES[topic].split("/")
        assert offer["type"] == f"{package}::{kind}::dds_::{short}_"
        assert offer["user_data"] == (type_hash(topic).decode() if hashes else "")
        assert "Reliable" in offer["reliability"]
        assert "Volatile" in offer["durability"]
        assert offer["representation"] == [True, False]


def test_without_posture(listen: Listen, publish: Publish, sample: LiveSample) -> None:
    output, listener = publish(), listen()
    silent = replace(
        sample, scan=replace(sample.scan, posture=Refusal(Reason.NO_FRAMES)), frame=None
    )
    assert send_until(output, silent, lambda: len(listener.messages("/range")) > 2)
    assert np.isnan(listener.messages("/range")[-1]["range"])
    assert listener.messages("/posture") == []


def test_delay_between_processes(listen: Listen, publish: Publish, sample: LiveSample) -> None:
    output, listener = publish(), listen()
    assert send_until(output, sample, lambda: len(listener.messages("/posture")) > 25)
    # Measured: 1 ms. What the way itself takes is in all of them; a busy machine adds to most.
    assert min(listener.delays_ms("/aqualvs/posture")) < 50.0


def test_best_effort_does_not_serve_those_who_want_more(
    listen: Listen, publish: Publish, sample: LiveSample
) -> None:
    output, listener = publish(RosOptions(reliable=False)), listen("jazzy", "reliable")
    assert send_until(output, sample, lambda: listener.messages("diagnostics"))
    for _ in range(10):
        send_now(output, sample)
    assert listener.messages("/range") == []


def test_subscriber_that_stands_still(listen: Listen, publish: Publish, sample: LiveSample) -> None:
    output, listener = publish(), listen()
    assert send_until(output, sample, lambda: listener.has_heard("/range", "/cloud"))
    listener.pause()
    typical = typical_send(output, sample, 60)
    listener.resume()
    # Every topic may wait for 50 ms.
    assert typical < 0.5
    # What the writer still has to repeat may hold up more than one; in the end they come again.
    resumed_ns = time.time_ns()
    assert send_until(output, sample, lambda: listener.latest_ns("/range") > resumed_ns)


def test_subscriber_gone_and_another_come(
    listen: Listen, publish: Publish, sample: LiveSample
) -> None:
    output, first = publish(), listen()
    assert send_until(output, sample, lambda: first.messages("/range"))
    first.close()
    second = listen()
    assert send_until(output, sample, lambda: second.messages("/range"))
    assert output.health().state is State.OK
    second.close()
    send_now(output, sample)
    began = time.monotonic()
    output.close()
    # A tenth of a second for each topic, for a subscriber that says nothing any more; the rest is
    # for a busy machine.
    assert time.monotonic() - began < 10.0


def test_network_missing_and_back(
    listen: Listen, publish: Publish, sample: LiveSample, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", NOWHERE)
    output = publish()
    send_now(output, sample)
    health = output.health()
    assert health.state is State.FAULT
    assert "tried again" in health.detail
    assert health.n_dropped == 1
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    # It is not tried again at once: that takes a moment, and may print a line each time.
    send_now(output, sample)
    assert output.health().state is State.FAULT
    listener = listen()
    assert send_until(output, sample, lambda: listener.messages("/range"))
    assert output.health().state is State.OK


def test_ros_localhost_only(
    listen: Listen, publish: Publish, sample: LiveSample, monkeypatch: pytest.MonkeyPatch
) -> None:
    listener = listen()
    monkeypatch.delenv("CYCLONEDDS_URI")
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    output = publish()
    assert send_until(output, sample, lambda: listener.messages("/range"))


def test_close_leaves_nothing_behind(publish: Publish, sample: LiveSample) -> None:
    before = n_threads()
    output = publish()
    output.send(sample)
    assert n_threads() > before
    output.close()
    assert until(lambda: n_threads() <= before)
    output.send(sample)
    output.close()
    assert n_threads() <= before
    assert output.health().state is State.OFF


def test_domain(monkeypatch: pytest.MonkeyPatch) -> None:
    assert domain_of_this_machine({}) == 0
    assert domain_of_this_machine({"ROS_DOMAIN_ID": " 42 "}) == 42
    with pytest.raises(OptionError, match="'abc' is not a number"):
        domain_of_this_machine({"ROS_DOMAIN_ID": "abc"})
    monkeypatch.setenv("ROS_DOMAIN_ID", "233")
    with pytest.raises(OptionError, match="domain 233: must be 0 to 232"):
        DdsOutput()


@pytest.mark.parametrize(
    ("environment", "local"),
    [
        ({}, False),
        ({"ROS_LOCALHOST_ONLY": "1"}, True),
        ({"ROS_LOCALHOST_ONLY": "0"}, False),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}, True),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, False),
        ({"ROS_LOCALHOST_ONLY": "1", "CYCLONEDDS_URI": LOOPBACK}, False),
    ],
)
def test_stays_on_this_machine(environment: dict[str, str], local: bool) -> None:
    assert stays_on_this_machine(environment) is local


@pytest.mark.parametrize("missing", ["cyclonedds.idl", "rosbags.typesys"])
def test_without_a_package(missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    types_module.dds_types.cache_clear()
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(OptionError, match=r"pip install 'aqualvs\[dds\]'"):
        DdsOutput()
