"""What ROS is told, in the message classes of rosbags, and the bytes it takes."""

import dataclasses
import functools
import math
import struct
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from aqualvs.control.time_filter import FilteredPosture
from aqualvs.errors import OptionError
from aqualvs.live.outputs.dds import dds_types, range_has_variance, type_hash
from aqualvs.live.outputs.ros1 import ros1_store, ros1_type, ros1_types
from aqualvs.live.outputs.ros_messages import (
    FLU_FROM_DOME,
    POINT_TYPE,
    TYPE_NAMES,
    Level,
    MessageMaker,
    PublishedTopic,
    RosOptions,
    RosTypes,
    plane_pose,
)
from aqualvs.recording.sample import LiveSample
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.scanning.scan import ScanPoints
from aqualvs.sources.base import Health, PartHealth, StageDelay, State
from live_cases import demo_samples

# Releases of ROS 2.
STORES = {
    store.value.removeprefix("ros2_"): store for store in Stores if store.value.startswith("ros2_")
}
# As roscore and subscribers of Noetic, and those of ROS 2 since Iron know the types.
MD5_SUMS = {
    PublishedTopic.POSTURE: "953b798c0f514ff060a53a3498ce6246",
    PublishedTopic.FILTERED: "953b798c0f514ff060a53a3498ce6246",
    PublishedTopic.RANGE: "c005c34273dc426c67a020a87bc24148",
    PublishedTopic.CLOUD: "1158d486dd51d683ce2f1be655c3c181",
    PublishedTopic.DIAGNOSTICS: "60810da900de1dd6ddd437c3503511da",
}
HASHES = {
    PublishedTopic.POSTURE: "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    PublishedTopic.FILTERED: "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    PublishedTopic.RANGE: "b42b62562e93cbfe9d42b82fe5994dfa3d63d7d5c90a317981703f7388adff3a",
    PublishedTopic.CLOUD: "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
    PublishedTopic.DIAGNOSTICS: "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
}


@functools.cache
def sample() -> LiveSample:
    found = demo_samples(2)[1]
    assert found.scan.posture
    return found


def refused(reason: Reason) -> LiveSample:
    """A sample without posture, its points kept."""
    found = sample()
    return replace(found, scan=replace(found.scan, posture=Refusal(reason, "because")))


def shifted(found: LiveSample, forward: float) -> LiveSample:
    points = found.scan.points
    moved = points.points_in_dome + np.array([0.0, forward, 0.0])
    scan = replace(found.scan, points=replace(points, points_in_dome=moved))
    return replace(found, scan=scan)


@functools.cache
def types() -> RosTypes:
    classes = get_typestore(Stores.ROS2_JAZZY).types
    return RosTypes(classes=classes, range_has_variance=True)


def told(
    found: LiveSample, options: RosOptions | None = None, kinds: RosTypes | None = None
) -> dict[PublishedTopic, Any]:
    maker = MessageMaker(options or RosOptions(), kinds or types())
    return dict(maker.messages(found, set(PublishedTopic)))


def smooth_sample() -> LiveSample:
    """A sample with a filtered posture, and text beyond ASCII."""
    cov = np.diag([1e-6, 1e-4, 4e-4, 1.0, 1.0, 1.0])
    smooth = FilteredPosture(0.8, 0.0, 0.0, np.zeros(3), cov, 0.02, True)
    health = Health(source=PartHealth("udp", State.WARN, "Käfig: ✗", 4))
    return replace(sample(), filtered=smooth, health=health)


@pytest.mark.parametrize("distro", ["humble", "jazzy"])
def test_cyclone_dds_reads_the_messages(distro: str) -> None:
    for found in (smooth_sample(), refused(Reason.NO_STRIPES), shifted(sample(), math.nan)):
        for topic, message in told(found, kinds=dds_types(distro)).items():
            data = message.serialize(use_version_2=False)
            kind = type(message)
            # Its own serialiser, which takes numbers one by one.
            again = kind.__idl__.serialize(kind.deserialize(data), use_version_2=False)
            assert again == data, topic


def test_bytes_of_ros1() -> None:
    store = ros1_store()
    message = told(sample(), kinds=ros1_types(store))[PublishedTopic.RANGE]
    message.header.seq = 7
    frame = b"aqualvs_dome"
    head = struct.pack("<4I", 7, *divmod(sample().utc_ns, 10**9), len(frame)) + frame
    ranges = message.field_of_view, message.min_range, message.max_range, message.range
    data = store.serialize_ros1(message, TYPE_NAMES[PublishedTopic.RANGE])
    assert bytes(data) == head + struct.pack("<B4f", 1, *ranges)


@pytest.mark.parametrize("topic", PublishedTopic)
def test_ros1_types_are_noetic_s(topic: PublishedTopic) -> None:
    full, kind = TYPE_NAMES[topic], ros1_type(ros1_store(), topic)
    assert kind.name == full.replace("/msg/", "/")
    assert kind.md5sum == MD5_SUMS[topic]
    # The text alone says it all, and leads to the same checksum.
    told_only = get_typestore(Stores.EMPTY)
    told_only.register(get_types_from_msg(kind.definition, full))
    assert told_only.generate_msgdef(full, ros_version=1)[1] == kind.md5sum


@pytest.mark.parametrize("topic", PublishedTopic)
def test_type_hashes(topic: PublishedTopic) -> None:
    assert type_hash(topic) == f"typehash=RIHS01_{HASHES[topic]};".encode()


@pytest.mark.parametrize("distro", STORES)
def test_releases_differ_in_the_variance_of_range_only(distro: str) -> None:
    store = get_typestore(STORES[distro])
    for topic, name in TYPE_NAMES.items():
        if topic is PublishedTopic.RANGE:
            fields = [field for field, _ in store.fielddefs[name][1]]
            assert ("variance" in fields) is range_has_variance(distro)
        else:
            assert store.hash_rihs01(name) == f"RIHS01_{HASHES[topic]}"


def numbers(part: Any, names: str = "xyz") -> list[float]:
    return [getattr(part, name) for name in names]


def test_posture_is_told_as_pose() -> None:
    found = sample()
    posture = found.scan.posture
    assert posture
    pose = told(found)[PublishedTopic.POSTURE]
    expected = plane_pose(posture.range, posture.pitch, posture.yaw, posture.total_covariance)
    stamp = pose.header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == found.utc_ns
    assert pose.header.frame_id == "aqualvs_dome"
    np.testing.assert_allclose(
        numbers(pose.pose.pose.position),
        posture.range * FLU_FROM_DOME @ posture.normal_in_dome,
        atol=1e-12,
    )
    assert numbers(pose.pose.pose.orientation, "xyzw") == expected.quaternion.tolist()
    assert pose.pose.covariance.tolist() == expected.covariance.ravel().tolist()


def test_filtered_posture_has_its_own_topic() -> None:
    pose = told(smooth_sample())[PublishedTopic.FILTERED].pose
    assert numbers(pose.pose.position) == pytest.approx([0.8, 0.0, 0.0])
    assert pose.covariance.reshape(6, 6)[5, 5] == pytest.approx(4e-4)
    assert PublishedTopic.FILTERED not in told(sample())


def test_cloud_holds_every_point() -> None:
    found = sample()
    points, cloud = found.scan.points, told(found)[PublishedTopic.CLOUD]
    rows = np.frombuffer(cloud.data, POINT_TYPE)
    assert len(rows) == cloud.width == len(points) > 500
    xyz = np.column_stack([rows["x"], rows["y"], rows["z"]])
    # Single precision: 1e-7 of a metre.
    np.testing.assert_allclose(xyz, points.points_in_dome @ FLU_FROM_DOME.T, atol=1e-6)
    for name in ("intensity", "sigma", "laser", "label", "used"):
        np.testing.assert_allclose(rows[name], getattr(points, name), rtol=1e-6)
    assert cloud.is_dense


def test_fields_describe_the_points() -> None:
    cloud = told(sample())[PublishedTopic.CLOUD]
    datatypes = {1: np.int8, 2: np.uint8, 7: np.float32}
    layout = {
        "names": [field.name for field in cloud.fields],
        "formats": [datatypes[field.datatype] for field in cloud.fields],
        "offsets": [field.offset for field in cloud.fields],
        "itemsize": cloud.point_step,
    }
    assert np.dtype(layout) == POINT_TYPE
    assert {field.count for field in cloud.fields} == {1}
    assert cloud.point_step == 24
    assert cloud.row_step == len(cloud.data) == 24 * cloud.width
    assert (cloud.height, cloud.is_bigendian) == (1, False)


def test_cloud_says_that_a_point_is_missing() -> None:
    assert not told(shifted(sample(), math.nan))[PublishedTopic.CLOUD].is_dense


def test_no_points() -> None:
    found = sample()
    empty = replace(found, scan=replace(found.scan, points=ScanPoints.none()))
    cloud = told(empty)[PublishedTopic.CLOUD]
    assert (cloud.width, len(cloud.data), cloud.is_dense) == (0, 0, True)


def test_range() -> None:
    found = sample()
    posture = found.scan.posture
    assert posture
    told_range = told(found)[PublishedTopic.RANGE]
    assert told_range.range == posture.range
    assert told_range.variance == posture.total_covariance[0, 0]
    assert (told_range.min_range, told_range.max_range) == found.rig.working_range
    # The demo's camera sees 36 degrees of water.
    assert 0.6 < told_range.field_of_view < 0.66


def test_a_range_that_is_believed_lies_between_the_limits() -> None:
    found = sample()
    posture = found.scan.posture
    assert posture
    near, far = found.rig.working_range
    beyond = replace(posture, range=1.005 * far)
    told_range = told(replace(found, scan=replace(found.scan, posture=beyond)))[
        PublishedTopic.RANGE
    ]
    assert told_range.min_range == near
    assert told_range.max_range == told_range.range == 1.005 * far


@pytest.mark.parametrize("reason", [r for r in Reason if r is not Reason.OUT_OF_RANGE])
def test_without_posture(reason: Reason) -> None:
    found = told(refused(reason))
    assert PublishedTopic.POSTURE not in found
    assert math.isnan(found[PublishedTopic.RANGE].range)
    assert found[PublishedTopic.RANGE].min_range < found[PublishedTopic.RANGE].max_range
    assert found[PublishedTopic.CLOUD].width > 0


@pytest.mark.parametrize(("forward", "expected"), [(-0.5, -math.inf), (0.5, math.inf)])
def test_too_near_and_too_far(forward: float, expected: float) -> None:
    found = told(shifted(refused(Reason.OUT_OF_RANGE), forward))
    assert found[PublishedTopic.RANGE].range == expected


def test_out_of_range_without_points_is_unknown() -> None:
    found = refused(Reason.OUT_OF_RANGE)
    found = replace(found, scan=replace(found.scan, points=ScanPoints.none()))
    assert math.isnan(told(found)[PublishedTopic.RANGE].range)


def test_only_what_is_wanted_is_made() -> None:
    maker = MessageMaker(RosOptions(), types())
    assert [topic for topic, _ in maker.messages(sample(), {PublishedTopic.RANGE})] == [
        PublishedTopic.RANGE
    ]


def test_diagnostics_come_once_a_second() -> None:
    maker, found = MessageMaker(RosOptions(), types()), sample()
    count: Counter[PublishedTopic] = Counter()
    for i in range(101):
        at = replace(found.instants, scanned_ns=40_000_000 * i)
        # The system's clock may jump; the pace must not.
        jumping = replace(found, instants=at, utc_ns=found.utc_ns - 10**12 * (i % 2))
        count.update(topic for topic, _ in maker.messages(jumping, set(PublishedTopic)))
    assert count[PublishedTopic.RANGE] == 101
    assert count[PublishedTopic.DIAGNOSTICS] == 5


def figures(status: Any) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


def test_diagnostics() -> None:
    health = Health(
        rate_hz=24.9,
        valid_share=0.97,
        n_frames=250,
        n_dropped=3,
        n_lost=1,
        delays=(StageDelay("total", 0.0031, 0.0072),),
        source=PartHealth("udp", State.WARN, "packets lost", 4),
        lasers=(PartHealth("left", State.OK), PartHealth("right", State.OFF, "not seen yet")),
        outputs=(PartHealth("mavlink", State.FAULT, "no peer", 2),),
        quality=0.8,
        n_water=1.339,
    )
    found = told(replace(sample(), health=health))[PublishedTopic.DIAGNOSTICS]
    by_name = {status.name: status for status in found.status}
    assert list(by_name) == [
        "aqualvs: posture",
        "aqualvs: pipeline",
        "aqualvs: source",
        "aqualvs: laser left",
        "aqualvs: laser right",
        "aqualvs: output mavlink",
    ]
    assert {status.hardware_id for status in found.status} == {sample().rig.name}
    pipeline = by_name["aqualvs: pipeline"]
    assert pipeline.message == "24.9 frames/s, 97% with a posture"
    values = figures(pipeline)
    assert values["rate_hz"] == "24.9"
    assert values["n_dropped"] == "3"
    assert values["n_water"] == "1.339"
    assert values["sigma_n_water"] == "nan"
    assert values["total_median_ms"] == "3.1"
    assert values["total_p99_ms"] == "7.2"
    assert by_name["aqualvs: source"].level == Level.WARN
    assert figures(by_name["aqualvs: source"])["n_dropped"] == "4"
    assert by_name["aqualvs: laser right"].message == "not in use: not seen yet"
    assert by_name["aqualvs: laser right"].level == Level.OK
    assert by_name["aqualvs: output mavlink"].level == Level.ERROR
    posture = by_name["aqualvs: posture"]
    assert posture.level == Level.OK
    assert float(figures(posture)["range_m"]) == pytest.approx(
        sample().scan.posture.range, rel=1e-5
    )


def test_diagnostics_without_posture() -> None:
    found = replace(refused(Reason.NO_STRIPES), health=Health())
    posture, pipeline, *_ = told(found)[PublishedTopic.DIAGNOSTICS].status
    assert (posture.level, posture.message) == (Level.WARN, "no_stripes: because")
    assert (pipeline.level, pipeline.message) == (Level.WARN, "0.0 frames/s")


def test_names() -> None:
    assert PublishedTopic.CLOUD.full_name == "/aqualvs/cloud"
    assert PublishedTopic.DIAGNOSTICS.full_name == "/diagnostics"
    messages = told(sample(), RosOptions(frame_id="rov1/dome"))
    assert messages[PublishedTopic.RANGE].header.frame_id == "rov1/dome"


@pytest.mark.parametrize("name", ["/dome", "2nd", "rov 1", ""])
def test_wrong_frames(name: str) -> None:
    with pytest.raises(OptionError):
        RosOptions(frame_id=name)


def test_dds_types_hold_their_fields() -> None:
    # Guards against two releases sharing the types of one.
    humble, jazzy = dds_types("humble"), dds_types("jazzy")
    name = TYPE_NAMES[PublishedTopic.RANGE]
    fields = {field.name for field in dataclasses.fields(jazzy.classes[name])}
    assert fields - {f.name for f in dataclasses.fields(humble.classes[name])} == {"variance"}
