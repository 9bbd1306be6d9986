"""The Foxglove server, watched by a WebSocket client in a process of its own.

Run as a program it is that client: it subscribes to topics, takes messages apart with the
definitions that the server sent, and prints what it found as JSON.
"""

import json
import math
import os
import re
import struct
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from repository import HELPERS
from waiting import TIMEOUT_S, until

_PATHS = os.pathsep.join([str(HELPERS), os.environ.get("PYTHONPATH", "")])
TOPICS = ("posture", "points", "picture", "health", "rig", "scene", "transforms")


def client(port, n_postures):
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    from websockets.sync.client import connect

    url = f"ws://127.0.0.1:{port}"
    store, channels, found = get_typestore(Stores.EMPTY), {}, {}
    counts, times = dict.fromkeys(TOPICS, 0), []
    with connect(url, subprotocols=["foxglove.sdk.v1"], max_size=None) as server:
        while len(channels) < len(TOPICS):
            told = json.loads(server.recv(TIMEOUT_S))
            for one in told.get("channels", ()) if told["op"] == "advertise" else ():
                channels[one["id"]] = one
                if one["encoding"] == "cdr":
                    store.register(get_types_from_msg(one["schema"], one["schemaName"]))
        wanted = [{"id": number, "channelId": number} for number in channels]
        server.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        print("ready", flush=True)
        while counts["posture"] < n_postures:
            told = server.recv(TIMEOUT_S)
            if isinstance(told, str) or told[0] != 1:
                continue
            number, at_ns = struct.unpack_from("<IQ", told, 1)
            channel = channels[number]
            name = channel["topic"].removeprefix("/aqualvs/")
            counts[name] += 1
            found[name] = facts(store, channel, name, bytes(told[13:]))
            if name == "posture":
                times.append(at_ns)
        kinds = {one["topic"]: one["schemaName"] for one in channels.values()}
    print(json.dumps({"found": found, "counts": counts, "times": times, "kinds": kinds}))


def facts(store, channel, name, content):
    """What the test compares of a message."""
    if channel["encoding"] == "protobuf":
        return {"n_bytes": len(content)}
    message = store.deserialize_cdr(content, channel["schemaName"])
    if name == "posture":
        return {
            "frame": message.frame,
            "range_m": message.range_m,
            "yaw_deg": message.yaw_deg,
            "covariance": message.covariance.tolist(),
            "valid": bool(message.valid),
            "reason": message.reason,
        }
    if name == "points":
        return {"n": message.width, "data": bytes(message.data).hex()}
    if name == "picture":
        return {"format": message.format, "data": bytes(message.data).hex()}
    if name == "rig":
        return {"yaml": message.yaml, "options": message.options}
    return {"rate_hz": message.rate_hz, "parts": [part.name for part in message.parts]}


@pytest.fixture
def output():
    from aqualvs.live.outputs.foxglove import FoxgloveOutput
    from aqualvs.scanner import ScannerOptions
    from aqualvs.scanning.stripe import StripeOptions

    options = ScannerOptions(detector=StripeOptions(min_contrast=17))
    made = FoxgloveOutput(port=0, scanner=options, points_hz=1000.0)
    yield made
    made.close()
    made.close()


@pytest.fixture
def watch():
    """Start a client that waits for so many postures."""
    processes = []

    def start(port, n):
        process = subprocess.Popen(
            [sys.executable, __file__, str(port), str(n)],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": _PATHS, "OMP_NUM_THREADS": "1"},
        )
        processes.append(process)
        assert process.stdout.readline() == "ready\n"
        return process

    yield start
    for process in processes:
        process.kill()
        process.wait(TIMEOUT_S)
        process.stdout.close()


@pytest.fixture(scope="module")
def samples():
    from live_cases import demo_samples

    return demo_samples(8)


def is_watched(output, n):
    """Whether so many viewers have subscribed, each to every topic."""
    n_subscriptions = sum(output._viewers._n_topics.values())
    return f"{n} watching" in output.health().detail and n_subscriptions == n * len(TOPICS)


def answer(process):
    text, _ = process.communicate(timeout=TIMEOUT_S)
    return json.loads(text)


def test_a_viewer_sees_what_was_sent(output, watch, samples):
    from aqualvs.recording.encoding import jpeg_of
    from aqualvs.recording.messages import points_message

    for sample in samples[:2]:
        output.send(sample)
    assert "nobody watches" in output.health().detail
    viewer = watch(output.port, 6)
    until(lambda: is_watched(output, 1), "a viewer of every topic")
    for sample in samples[2:]:
        output.send(sample)
    told = answer(viewer)
    found, last = told["found"], samples[-1]
    posture = last.scan.posture
    assert found["posture"] == {
        "frame": last.scan.index,
        "range_m": posture.range,
        "yaw_deg": math.degrees(posture.yaw),
        "covariance": posture.covariance.ravel().tolist(),
        "valid": True,
        "reason": "",
    }
    assert told["times"] == [sample.utc_ns for sample in samples[2:]]
    # The last posture ends the client, before what comes after it.
    assert told["counts"]["posture"] == 6
    assert told["counts"]["scene"] == told["counts"]["points"] == 5
    assert found["points"]["n"] > 500
    shown = {points_message(s.scan.points, 0)[-1000:-1].hex() for s in samples[2:]}
    assert any(found["points"]["data"].endswith(data) for data in shown)
    # At 5 Hz of 25.
    assert told["counts"]["picture"] == 1
    assert found["picture"]["format"] == "jpeg"
    pictures = [jpeg_of(sample.frame, 75).hex() for sample in samples]
    assert found["picture"]["data"] in pictures
    # What is sent seldom comes at once to a viewer who has just arrived.
    assert told["counts"]["rig"] == told["counts"]["transforms"] == 1
    assert found["health"] == {"rate_hz": 25.0, "parts": ["source"]}
    assert "aqualvs_rig: 1" in found["rig"]["yaml"]
    assert json.loads(found["rig"]["options"])["detector"]["min_contrast"] == 17
    assert told["kinds"]["/aqualvs/points"] == "sensor_msgs/msg/PointCloud2"
    assert told["kinds"]["/aqualvs/scene"] == "foxglove.SceneUpdate"
    until(lambda: "nobody watches" in output.health().detail)


def test_a_refusal_is_shown_too(output, watch, samples):
    from aqualvs.scanning.posture import Reason, Refusal
    from aqualvs.scanning.scan import ScanPoints

    silent = Refusal(Reason.NO_FRAMES, "no picture for 0.2 s")
    scan = replace(samples[0].scan, posture=silent, points=ScanPoints.none())
    viewer = watch(output.port, 1)
    until(lambda: is_watched(output, 1), "a viewer of every topic")
    output.send(replace(samples[0], scan=scan, peaks={}, frame=None))
    told = answer(viewer)
    assert not told["found"]["posture"]["valid"]
    assert told["found"]["posture"]["reason"] == "no_frames"
    assert told["counts"]["points"] == told["counts"]["picture"] == 0


def test_a_viewer_that_vanishes_disturbs_nobody(output, watch, samples):
    gone, stays = watch(output.port, 1000), watch(output.port, 8)
    until(lambda: is_watched(output, 2), "two viewers of every topic")
    gone.kill()
    for sample in samples:
        output.send(sample)
    assert answer(stays)["found"]["posture"]["frame"] == 7
    until(lambda: "nobody watches" in output.health().detail)


def test_it_listens_on_this_machine_alone_and_frees_its_port(samples):
    from aqualvs.live.outputs.base import Output
    from aqualvs.live.outputs.foxglove import FoxgloveOutput
    from aqualvs.sources.base import State

    made = FoxgloveOutput(port=0)
    output: Output = made
    listening = _listening(made.port)
    assert listening == {"0100007F"}
    with pytest.raises(Exception, match=f"cannot listen on 127.0.0.1:{made.port}"):
        FoxgloveOutput(port=made.port)
    output.close()
    output.send(samples[0])
    assert output.health().state is State.OFF
    until(lambda: not _listening(made.port))


def _listening(port):
    """Addresses that this machine listens on at a port, as /proc/net/tcp has them."""
    if not os.path.exists("/proc/net/tcp"):
        pytest.skip("no /proc/net/tcp on this system")
    with open("/proc/net/tcp") as table:
        rows = [line.split() for line in table][1:]
    ends = [row[1].split(":") for row in rows if row[3] == "0A"]
    return {address for address, at in ends if int(at, 16) == port}


def test_without_the_sdk_it_says_what_to_install(monkeypatch):
    from aqualvs.errors import OptionError
    from aqualvs.live.outputs.foxglove import FoxgloveOutput

    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(OptionError, match=re.escape("pip install 'aqualvs[foxglove]'")):
        FoxgloveOutput(port=0)


def test_nothing_is_made_that_nobody_watches(output, samples, monkeypatch):
    from aqualvs.live.outputs import foxglove

    def made(*_):
        raise AssertionError("a picture for nobody")

    monkeypatch.setattr(foxglove, "jpeg_of", made)
    for sample in samples:
        output.send(sample)


def test_lines_and_plate_lie_where_the_points_are(samples):
    from aqualvs.geometry.transforms import quaternion_from_rotation
    from aqualvs.live.outputs.foxglove import laser_lines

    sample = samples[0]
    posture = sample.scan.posture
    lines = laser_lines(sample.rig.lasers, posture.normal_in_dome, sample.scan.points)
    assert len(lines) == len(sample.rig.lasers)
    for ends in lines:
        assert np.linalg.norm(ends[1] - ends[0]) > 0.1
        # On the target, to what a single point at its edge is off.
        assert np.allclose(ends @ posture.normal_in_dome, posture.range, atol=0.03)
    turn = sample.rig.dome_from_cam.rotation
    x, y, z, w = quaternion_from_rotation(turn)
    again = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    assert np.allclose(again, turn, atol=1e-12)
    assert quaternion_from_rotation(np.eye(3)) == (0.0, 0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def layout():
    from aqualvs.live.outputs.foxglove import LAYOUT

    return json.loads(LAYOUT.read_text())


def test_the_layout_is_in_the_words_of_the_panels(layout):
    """The SDK's classes of panels are the published schema; the file is as the app exports it."""
    from foxglove import layouts

    panels = set(re.findall(r'"(\w+!\w+)"', json.dumps(layout["layout"])))
    assert panels == set(layout["configById"])
    classes = {
        "Plot": layouts.PlotPanel,
        "3D": layouts.ThreeDeePanel,
        "Image": layouts.ImagePanel,
        "StateTransitions": layouts.StateTransitionsPanel,
        "RawMessages": layouts.RawMessagesPanel,
    }
    series = {"Plot": layouts.PlotSeries, "StateTransitions": layouts.StateTransitionsSeries}
    for name, config in layout["configById"].items():
        kind = name.partition("!")[0]
        panel = classes[kind]()._to_dict()
        # What the app exports calls this one panel otherwise.
        assert panel["panelType"].replace("ThreeDee", "3D") == kind
        assert not set(config) - set(panel["config"]._to_dict()), name
        for one in config.get("paths", ()):
            assert not set(one) - set(series[kind](value="/a.b")._to_dict()), name
    scene = layout["configById"]["3D!scene"]
    cloud, entities = scene["topics"]["/aqualvs/points"], scene["topics"]["/aqualvs/scene"]
    point_keys = layouts.BaseRendererPointCloudTopicSettings()._to_dict()
    for given, known in (
        (cloud, point_keys),
        (entities, layouts.BaseRendererSceneUpdateTopicSettings()._to_dict()),
        (scene["layers"]["grid"], layouts.BaseRendererGridLayerSettings()._to_dict()),
        (scene["cameraState"], layouts.ThreeDeeCameraState()._to_dict()),
        (layout["configById"]["Image!picture"]["imageMode"], layouts.ImageModeConfig()._to_dict()),
    ):
        assert not set(given) - set(known)


def test_what_the_layout_names_is_in_a_recording(layout, samples, tmp_path):
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    from aqualvs.recording import PictureFormat, RecorderOptions, Recording
    from aqualvs.sources.base import StageDelay

    health = replace(samples[0].health, delays=(StageDelay("scan", 0.001, 0.002),))
    path = tmp_path / "dive.mcap"
    recording = Recording(path, RecorderOptions(pictures=PictureFormat.JPEG))
    for sample in samples:
        recording.write(replace(sample, health=health))
    recording.close()
    store = get_typestore(Stores.EMPTY)
    found: dict[str, Any] = {}
    with Reader(path) as reader:
        for one in reader.connections:
            store.register(get_types_from_msg(one.msgdef.data, one.msgtype))
        for one, _, data in reader.messages():
            found[one.topic] = store.deserialize_cdr(data, one.msgtype)
    # Coordinate frames and the scene are sent live only.
    live_only = {"/aqualvs/scene"}
    named = re.findall(r'"(/aqualvs/[\w/]+)((?:\.\w+|\[:\])*)"', json.dumps(layout))
    assert len(named) > 10
    for topic, place in named:
        if topic not in live_only:
            values = [found[topic]]
            for step in re.findall(r"\w+|\[:\]", place):
                values = (
                    [one for several in values for one in several]
                    if step == "[:]"
                    else [getattr(value, step) for value in values]
                )
            assert values, (topic, place)
    cloud = layout["configById"]["3D!scene"]["topics"]["/aqualvs/points"]
    assert cloud["colorField"] in [field.name for field in found["/aqualvs/points"].fields]


if __name__ == "__main__":
    client(int(sys.argv[1]), int(sys.argv[2]))
