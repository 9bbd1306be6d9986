"""Publishing to ROS 1: a real roscore, and a subscriber by rospy in another process."""

import contextlib
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import xmlrpc.client
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aqualvs.errors import OptionError
from aqualvs.live.outputs.ros1 import Ros1Output, advertised_host, master_host
from aqualvs.live.outputs.ros_messages import plane_pose
from aqualvs.recording.sample import LiveSample
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.sources.base import State
from live_cases import demo_samples
from ports import free_port
from processes import children_of
from repository import HELPERS
from ros_listener import (
    TIMEOUT_S,
    Listener,
    expected_points,
    n_threads,
    points_of,
    send_until,
    typical_send,
    until,
)

SUBSCRIBER = HELPERS / "ros1_subscriber.py"
# rospy and roscore belong to the system's Python, whichever one runs the tests.
PYTHON = "/usr/bin/python3"
# An end waits for a roscore that says nothing; without end it would be seen after this long.
END_S = 15.0
PACKAGES = "python3-rospy python3-roslaunch python3-sensor-msgs python3-diagnostic-msgs"
POSE_MD5 = "953b798c0f514ff060a53a3498ce6246"


def ros_is_installed() -> bool:
    if shutil.which("roscore") is None:
        return False
    imports = "import rospy, sensor_msgs.msg, geometry_msgs.msg, diagnostic_msgs.msg"
    return subprocess.run([PYTHON, "-c", imports], timeout=TIMEOUT_S, check=False).returncode == 0


# Where everything must be tested, absence is a failure.
needs_ros = pytest.mark.skipif(
    os.environ.get("CI") != "true" and not ros_is_installed(),
    reason=f"ROS 1 is not installed (Debian: apt-get install {PACKAGES})",
)


class Roscore:
    """A roscore on a port of its own, that can be stopped and started again.

    `roscore` is a master and `rosout`, and a parent that sees to both. It takes a second to start,
    and sometimes far more to stop; most tests have the master alone, started as the parent does.
    """

    def __init__(self, folder: Path, port: int) -> None:
        self.environment = {
            **os.environ,
            "ROS_MASTER_URI": f"http://127.0.0.1:{port}",
            "ROS_IP": "127.0.0.1",
            "ROS_HOME": str(folder),
            "ROS_LOG_DIR": str(folder),
        }
        self._port = port
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, *, complete: bool = False) -> None:
        command = ["roscore"] if complete else ["rosmaster", "--core", "-w", "3"]
        command += ["-p", str(self._port)]
        self._process = subprocess.Popen(
            command, env=self.environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        assert until(self._answers), "roscore did not start"

    def _answers(self) -> bool:
        try:
            with xmlrpc.client.ServerProxy(self.environment["ROS_MASTER_URI"]) as master:
                return bool(master.getPid("/test"))
        except OSError:
            return False

    def stop(self) -> None:
        if self._process is None:
            return
        family = [self._process.pid, *children_of(self._process.pid)]
        self._process.terminate()
        try:
            self._process.wait(3.0)
        except subprocess.TimeoutExpired:
            for pid in family:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            self._process.wait(TIMEOUT_S)
        self._process = None


Listen = Callable[[], Listener]
Publish = Callable[..., Ros1Output]


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def roscore(tmp_path: Path, port: int) -> Iterator[Roscore]:
    core = Roscore(tmp_path, port)
    yield core
    core.stop()


@pytest.fixture
def listen(roscore: Roscore) -> Iterator[Listen]:
    listeners = []

    def start() -> Listener:
        command = [PYTHON, str(SUBSCRIBER), "aqualvs"]
        listeners.append(Listener(command, roscore.environment))
        return listeners[-1]

    yield start
    for listener in listeners:
        listener.close()


@pytest.fixture
def publish(roscore: Roscore) -> Iterator[Publish]:
    outputs = []

    def start(**more: Any) -> Ros1Output:
        outputs.append(Ros1Output(environment=roscore.environment, **more))
        return outputs[-1]

    yield start
    for output in outputs:
        output.close()


@pytest.fixture(scope="module")
def sample() -> LiveSample:
    found = demo_samples(2)[1]
    assert found.scan.posture
    return found


def is_known(output: Ros1Output) -> bool:
    return output.health().state is State.OK


@needs_ros
def test_values_arrive(
    roscore: Roscore, listen: Listen, publish: Publish, sample: LiveSample
) -> None:
    roscore.start(complete=True)
    output, listener = publish(), listen()
    assert send_until(output, sample, lambda: len(listener.messages("/posture")) > 25)
    heard = ("/range", "/cloud", "/diagnostics")
    assert send_until(output, sample, lambda: listener.has_heard(*heard))
    check_values(listener, sample)
    assert until(lambda: "5 subscribers" in output.health().detail)
    assert output.health().state is State.OK
    # Measured: 1 ms. What the way itself takes is in all of them; a busy machine adds to most.
    assert min(listener.delays_ms("/aqualvs/posture")) < 50.0

    silent = replace(sample, scan=replace(sample.scan, posture=Refusal(Reason.NO_STRIPES)))
    assert send_until(output, silent, lambda: np.isnan(listener.messages("/range")[-1]["range"]))


def check_values(listener: Listener, sample: LiveSample) -> None:
    posture = sample.scan.posture
    assert posture
    pose = plane_pose(posture.range, posture.pitch, posture.yaw, posture.total_covariance)
    first, *_, message = listener.messages("/aqualvs/posture")
    assert message["header"]["frame_id"] == "aqualvs_dome"
    assert message["header"]["seq"] > first["header"]["seq"]
    assert [*message["pose"]["pose"]["position"].values()] == pose.position.tolist()
    assert [*message["pose"]["pose"]["orientation"].values()] == pose.quaternion.tolist()
    assert message["pose"]["covariance"] == pose.covariance.ravel().tolist()
    assert listener.messages("/aqualvs/range")[-1]["range"] == np.float32(posture.range)
    cloud = listener.messages("/aqualvs/cloud")[-1]
    assert cloud["width"] == len(sample.scan.points)
    assert points_of(cloud).tolist() == expected_points(sample).tolist()
    diagnostics = listener.messages("/diagnostics")[0]
    pairs = {pair["key"]: pair["value"] for pair in diagnostics["status"][0]["values"]}
    assert float(pairs["range_m"]) == pytest.approx(posture.range, rel=1e-5)


@needs_ros
def test_roscore_late_gone_and_back(
    roscore: Roscore, listen: Listen, publish: Publish, sample: LiveSample
) -> None:
    output = publish()
    assert until(lambda: "no roscore at" in output.health().detail)
    assert output.health().state is State.FAULT
    assert typical_send(output, sample, 9) < 0.1

    roscore.start()
    assert until(lambda: is_known(output))
    first = listen()
    assert send_until(output, sample, lambda: first.messages("/range"))

    roscore.stop()
    assert until(lambda: output.health().state is State.WARN)
    assert "no roscore at" in output.health().detail
    # Those who listen already need no roscore.
    last = replace(sample, utc_ns=sample.utc_ns + 10**12)
    output.send(last)
    assert until(lambda: first.latest_ns("/range") == last.utc_ns)

    roscore.start()
    assert until(lambda: is_known(output))
    second = listen()
    assert send_until(output, sample, lambda: second.messages("/range"))


@needs_ros
def test_subscriber_that_stands_still(
    roscore: Roscore, listen: Listen, publish: Publish, sample: LiveSample
) -> None:
    roscore.start()
    output, listener = publish(), listen()
    assert send_until(output, sample, lambda: listener.has_heard("/range", "/cloud"))
    listener.pause()
    assert typical_send(output, sample, 400) < 0.25
    # 400 clouds of 40 kB are more than sockets hold: most were passed over.
    assert output.health().n_dropped > 100
    listener.resume()
    last = replace(sample, utc_ns=sample.utc_ns + 10**12)
    output.send(last)
    # Of what waits for a slow subscriber, the newest is kept.
    assert until(lambda: listener.latest_ns("/range") == last.utc_ns)


@needs_ros
def test_name_taken_by_another(roscore: Roscore, publish: Publish) -> None:
    roscore.start()
    first = publish()
    assert until(lambda: is_known(first))
    second = publish()
    assert until(lambda: is_known(second))
    assert until(lambda: first.health().state is State.FAULT)
    assert "ended by ROS" in first.health().detail
    # They must not drive each other out for ever.
    time.sleep(2.5)
    assert is_known(second)


@needs_ros
def test_close_tells_roscore(roscore: Roscore, publish: Publish, sample: LiveSample) -> None:
    roscore.start()
    before = n_threads()
    output = publish()
    assert until(lambda: is_known(output))
    with xmlrpc.client.ServerProxy(roscore.environment["ROS_MASTER_URI"]) as master:
        state: Any = master.getSystemState("/test")
        assert "/aqualvs" in str(state)
        began = time.monotonic()
        output.close()
        assert time.monotonic() - began < END_S
        state = master.getSystemState("/test")
        assert "/aqualvs" not in str(state)
    assert until(lambda: n_threads() <= before)
    output.send(sample)
    output.close()
    assert output.health().state is State.OFF


def test_close_without_roscore(publish: Publish, sample: LiveSample) -> None:
    before = n_threads()
    output = publish()
    output.send(sample)
    began = time.monotonic()
    output.close()
    assert time.monotonic() - began < END_S
    assert until(lambda: n_threads() <= before)


def test_roscore_that_does_not_answer(publish: Publish, port: int) -> None:
    with socket.create_server(("127.0.0.1", port)):
        output = publish()
        assert until(lambda: "timed out" in output.health().detail)
        began = time.monotonic()
        output.close()
        assert time.monotonic() - began < END_S


def test_something_else_answers_for_roscore(publish: Publish, port: int) -> None:
    deaf = socket.create_server(("127.0.0.1", port))

    def answer() -> None:
        connection, _ = deaf.accept()
        with connection:
            connection.recv(4096)
            connection.sendall(b"SSH-2.0-hello\r\n\r\n")

    thread = threading.Thread(target=answer)
    thread.start()
    output = publish()
    assert until(lambda: "no roscore at" in output.health().detail)
    thread.join(TIMEOUT_S)
    deaf.close()


def port_of(output: Ros1Output) -> int:
    """Where a subscriber would connect, by the protocol."""
    with xmlrpc.client.ServerProxy(output.uri) as node:
        answer: Any = node.requestTopic("/test", "/aqualvs/posture", [["TCPROS"]])
    code, _, (protocol, host, port) = answer
    assert (code, protocol, host) == (1, "TCPROS", "127.0.0.1")
    return int(port)


def shake_hands(output: Ros1Output, **fields: str) -> bytes:
    """Answer to a header of a subscriber."""
    parts = [f"{key}={value}".encode() for key, value in fields.items()]
    body = b"".join(struct.pack("<I", len(part)) + part for part in parts)
    return say(output, struct.pack("<I", len(body)) + body)


def say(output: Ros1Output, data: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", port_of(output)), 5.0) as link:
        link.sendall(data)
        answer = b""
        while len(answer) < 4 or len(answer) < 4 + struct.unpack_from("<I", answer)[0]:
            piece = link.recv(65536)
            if not piece:
                break
            answer += piece
    return answer


def test_handshake(publish: Publish) -> None:
    output = publish()
    sound = {
        "topic": "/aqualvs/posture",
        "type": "geometry_msgs/PoseWithCovarianceStamped",
        "md5sum": POSE_MD5,
        "callerid": "/test",
    }
    assert POSE_MD5.encode() in shake_hands(output, **sound)
    assert b"message_definition=std_msgs/Header header\n" in shake_hands(output, **sound)
    # Tools that take any type ask for a star.
    assert POSE_MD5.encode() in shake_hands(output, **{**sound, "md5sum": "*", "type": "*"})


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [
        ({"topic": "/other"}, b"error=/other is not published by /aqualvs"),
        ({"md5sum": "0" * 32}, b"has md5sum 953b798c0f514ff060a53a3498ce6246"),
        ({"type": "std_msgs/String"}, b"has type geometry_msgs/PoseWithCovarianceStamped"),
    ],
)
def test_handshake_refused(publish: Publish, wrong: dict[str, str], complaint: bytes) -> None:
    fields = {"topic": "/aqualvs/posture", "md5sum": POSE_MD5, "callerid": "/test", **wrong}
    assert complaint in shake_hands(publish(), **fields)


@pytest.mark.parametrize(
    ("nonsense", "complaint"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", b"too long"),
        (struct.pack("<II", 8, 2**31) + b"abcd", b"damaged"),
        (struct.pack("<I", 2) + b"ab", b"damaged"),
    ],
)
def test_nonsense_is_refused(
    publish: Publish, sample: LiveSample, nonsense: bytes, complaint: bytes
) -> None:
    output = publish()
    assert complaint in say(output, nonsense)
    # And others are served all the same.
    assert POSE_MD5.encode() in shake_hands(output, topic="/aqualvs/posture", md5sum="*")
    output.send(sample)


def test_calls_that_are_not_understood(publish: Publish) -> None:
    output = publish()
    with xmlrpc.client.ServerProxy(output.uri) as node:
        refusal: Any = node.requestTopic("/test", "/other", [["TCPROS"]])
        assert refusal[0] == -1
        refusal = node.requestTopic("/test", "/aqualvs/range", [["UDPROS"]])
        assert refusal[0] == 0
        refusal = node.requestTopic("/test")
        assert refusal[0] == -1
        refusal = node.system.listMethods()
        assert refusal[0] == -1
        assert node.getPid("/test") == [1, "", os.getpid()]


@pytest.mark.parametrize(
    "uri", ["", "localhost:11311", "https://rov:11311", "http://:11311", "http://rov:99999"]
)
def test_wrong_master(uri: str) -> None:
    with pytest.raises(OptionError, match="ROS_MASTER_URI"):
        master_host(uri)


def test_without_rosbags(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(OptionError, match=r"pip install 'aqualvs\[bags\]'"):
        Ros1Output()


def test_advertised_host() -> None:
    assert advertised_host("localhost", {"ROS_HOSTNAME": "rov.local"}) == "rov.local"
    assert advertised_host("localhost", {"ROS_IP": "192.168.2.2"}) == "192.168.2.2"
    own = advertised_host("localhost", {})
    # An address of this machine: one can listen there.
    socket.create_server((own, 0)).close()
