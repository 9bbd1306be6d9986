"""The recorder as an output, and what independent readers find in its files."""

import errno
import io
import math
import re
import threading
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from mcap.reader import SeekingReader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from aqualvs.control.time_filter import FilteredPosture
from aqualvs.errors import OptionError, OutputError
from aqualvs.live.outputs.base import Output
from aqualvs.optics.rigfile import rig_to_mapping
from aqualvs.recording import (
    DiveRecording,
    PictureFormat,
    Recorder,
    RecorderOptions,
    RecorderSwitch,
    Recording,
    is_recording,
    recorder,
)
from aqualvs.recording.encoding import (
    HEALTH,
    PICTURE,
    POINTS,
    POSTURE,
    RIG,
    STRIPES,
    TOPICS,
    CdrReader,
    CdrWriter,
    rig_exact,
    rig_from_record,
)
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.scanning.scan import ScanPoints
from aqualvs.simulation.scenarios import flat_port_rig
from aqualvs.sources.base import Health, PartHealth, StageDelay, State
from aqualvs.sources.mcap_file import McapFile
from aqualvs.yamlfile import rig_text
from live_cases import demo_frames, demo_rig, demo_samples
from recorder_cases import counted, read_by_mcap, read_by_rosbags
from waiting import TIMEOUT_S, until

EVERY = RecorderOptions(points_hz=None)


def recorded(path, samples, options=EVERY):
    recording = Recording(path, options)
    for sample in samples:
        recording.write(sample)
    recording.close()
    return path


def decoded(path):
    """Messages by topic, taken apart by rosbags with the definitions that are in the file."""
    found = {topic.name: [] for topic in TOPICS}
    reader = Reader(path)
    reader.open()
    store = get_typestore(Stores.EMPTY)
    for one in reader.connections:
        store.register(get_types_from_msg(one.msgdef.data, one.msgtype))
    for of, _, data in reader.messages():
        found[of.topic].append(store.deserialize_cdr(data, of.msgtype))
    reader.close()
    return found


@pytest.fixture(scope="module")
def samples():
    return demo_samples(8)


def same_bits(left, right):
    return left.dtype == right.dtype and left.tobytes() == right.tobytes()


def test_rosbags_understands_every_message(tmp_path, samples):
    path = recorded(tmp_path / "dive.mcap", samples)
    found = decoded(path)
    assert [len(found[t.name]) for t in (POSTURE, STRIPES, POINTS, HEALTH, RIG)] == [8, 8, 8, 1, 2]
    for sample, message in zip(samples, found[POSTURE.name], strict=True):
        posture = sample.scan.posture
        assert (message.frame, message.time_s, message.valid) == (
            sample.scan.index,
            sample.scan.time_s,
            True,
        )
        assert message.range_m == posture.range
        assert message.pitch_deg == math.degrees(posture.pitch)
        assert message.sigma_yaw_deg == pytest.approx(
            math.degrees(math.sqrt(posture.covariance[2, 2]))
        )
        assert same_bits(message.covariance, posture.covariance.ravel())
        assert same_bits(message.normal, posture.normal_in_dome)
        assert message.n_points == posture.n_points
        assert message.n_water == sample.scan.n_water
        assert not message.filtered
        assert math.isnan(message.filtered_range_m)
        assert message.delay_s == pytest.approx(1.5e-3)
    for sample, message in zip(samples, found[POINTS.name], strict=True):
        kinds = {1: "i1", 2: "u1", 7: "<f4"}
        dtype = np.dtype(
            {
                "names": [field.name for field in message.fields],
                "formats": [kinds[field.datatype] for field in message.fields],
                "offsets": [field.offset for field in message.fields],
                "itemsize": message.point_step,
            }
        )
        cloud = np.frombuffer(message.data, dtype)
        points = sample.scan.points
        assert message.width == len(points) == len(cloud)
        for i, name in enumerate("xyz"):
            assert np.array_equal(cloud[name], points.points_in_dome[:, i].astype("f4"))
        assert np.array_equal(cloud["label"], points.label)
        assert np.array_equal(cloud["laser"], points.laser)
        assert np.array_equal(cloud["used"], points.used)
        assert np.allclose(cloud["quality"], points.quality)
    for sample, message in zip(samples, found[STRIPES.name], strict=True):
        assert message.refusal == ""
        for (axis, stripes), part in zip(sample.peaks.items(), message.returns, strict=True):
            assert part.axis == axis.value
            assert np.array_equal(part.line, stripes.line)
            for name in ("position", "height", "width", "likelihood"):
                assert same_bits(getattr(part, name), getattr(stripes, name))


def test_health_and_filter_as_rosbags_reads_them(tmp_path, samples):
    health = Health(
        rate_hz=24.5,
        valid_share=0.9,
        n_dropped=3,
        delays=(StageDelay("scan", 0.002, 0.004),),
        source=PartHealth("dive.mp4", State.OK, "gut, 1 µs"),
        lasers=(PartHealth("left", State.WARN, "", 2),),
        outputs=(PartHealth("mavlink", State.FAULT, "no peer", 7),),
    )
    rates = np.array([0.1, 0.02, -0.03])
    filtered = FilteredPosture(0.5, 0.1, -0.2, rates, np.eye(6), 0.04, True)
    sample = replace(samples[0], health=health, filtered=filtered)
    found = decoded(recorded(tmp_path / "dive.mcap", [sample]))
    (message,) = found[HEALTH.name]
    assert (message.state, message.rate_hz, message.n_dropped) == (3, 24.5, 3)
    assert math.isnan(message.quality)
    assert [(p.kind, p.name, p.state, p.detail, p.n_dropped) for p in message.parts] == [
        ("source", "dive.mp4", 1, "gut, 1 µs", 0),
        ("laser", "left", 2, "", 2),
        ("output", "mavlink", 3, "no peer", 7),
    ]
    assert [(d.name, d.median_s, d.p99_s) for d in message.delays] == [("scan", 0.002, 0.004)]
    (posture,) = found[POSTURE.name]
    assert posture.filtered
    assert posture.filter_accepted
    assert posture.filtered_range_m == 0.5
    assert posture.filtered_yaw_deg == math.degrees(-0.2)
    assert posture.filtered_pitch_rate_deg_per_s == math.degrees(0.02)


def test_stripes_come_back_bit_for_bit(tmp_path, samples):
    path = recorded(tmp_path / "dive.mcap", samples)
    assert is_recording(path)
    frames = list(DiveRecording(path).frames(with_pictures=False))
    for sample, frame in zip(samples, frames, strict=True):
        assert (frame.index, frame.time_s) == (sample.scan.index, sample.scan.time_s)
        assert frame.n_water == sample.scan.n_water
        assert list(frame.peaks) == list(sample.peaks)
        for axis, stripes in sample.peaks.items():
            for name in stripes._fields:
                assert same_bits(getattr(frame.peaks[axis], name), getattr(stripes, name))


def test_a_direction_without_stripes_stays_one(tmp_path, samples):
    sample = samples[0]
    empty = {
        axis: type(found)(*(getattr(found, name)[:0] for name in found._fields))
        for axis, found in sample.peaks.items()
    }
    path = recorded(tmp_path / "dive.mcap", [replace(sample, peaks=empty)])
    (frame,) = DiveRecording(path).frames(with_pictures=False)
    assert list(frame.peaks) == list(empty)
    assert [found.n for found in frame.peaks.values()] == [0] * len(empty)
    (message,) = decoded(path)[STRIPES.name]
    assert [len(part.position) for part in message.returns] == [0] * len(empty)


def test_a_frame_that_was_not_measured_keeps_its_reason(tmp_path, samples):
    nothing = ScanPoints.none()
    refusal = Refusal(Reason.WRONG_SIZE, "picture of 320x240 px")
    silent = Refusal(Reason.NO_FRAMES, "no picture for 0.2 s")
    scan = samples[1].scan
    refused = replace(
        samples[1], scan=replace(scan, posture=refusal, points=nothing), peaks={}, frame=None
    )
    quiet = replace(
        samples[1], scan=replace(scan, posture=silent, points=nothing), peaks={}, frame=None
    )
    path = recorded(tmp_path / "dive.mcap", [samples[0], refused, quiet, samples[2]])
    frames = list(DiveRecording(path).frames(with_pictures=False))
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert [frame.refusal for frame in frames] == [None, refusal, None]
    postures = decoded(path)[POSTURE.name]
    assert [(m.valid, m.reason) for m in postures] == [
        (True, ""),
        (False, "wrong_size"),
        (False, "no_frames"),
        (True, ""),
    ]
    assert math.isnan(postures[1].range_m)


def test_the_rig_comes_back_to_the_last_bit(tmp_path, samples):
    turn = demo_rig().dome_from_cam
    # A rotation that no rounded rotation vector leads back to.
    c, s = math.cos(1e-3 / 3), math.sin(1e-3 / 3)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ turn.rotation
    lasers = tuple(replace(one, wavelength_nm=450.1) for one in demo_rig().lasers)
    rig = replace(
        demo_rig(),
        dome_from_cam=replace(turn, rotation=rotation),
        n_water=1 / 0.7477,
        lasers=(demo_rig().lasers[0], *lasers[1:]),
    )
    path = recorded(tmp_path / "dive.mcap", [replace(samples[0], rig=rig)])
    found = DiveRecording(path).rig
    assert same_bits(found.dome_from_cam.rotation, rotation)
    assert same_bits(found.dome_from_cam.translation, turn.translation)
    for left, right in zip(found.lasers, rig.lasers, strict=True):
        assert left.name == right.name
        assert same_bits(left.plane.normal, right.plane.normal)
        assert left.plane.offset == right.plane.offset
        assert left.wavelength_nm == right.wavelength_nm
    assert found.lens == rig.lens
    assert found.dome == rig.dome
    assert (found.n_air, found.n_water) == (rig.n_air, rig.n_water)
    assert found.working_range == rig.working_range


def test_the_rig_is_told_again_only_when_more_than_its_water_changed(tmp_path, samples):
    rig = samples[0].rig
    other = replace(rig, working_range=(0.2, 0.9))
    rigs = [rig, rig.in_water(1.341), replace(rig), other, other]
    path = recorded(
        tmp_path / "dive.mcap",
        [replace(sample, rig=rig) for sample, rig in zip(samples, rigs, strict=False)],
    )
    assert len(decoded(path)[RIG.name]) == 2


def test_times_rise_though_the_clock_jumps(tmp_path, samples):
    jumps = [0, 3600, -7200, -7200, 0, 5, 5, 5]
    jumped = [
        replace(sample, utc_ns=sample.utc_ns + 10**9 * jump)
        for sample, jump in zip(samples, jumps, strict=True)
    ]
    path = recorded(tmp_path / "dive.mcap", jumped)
    reader = SeekingReader(io.BytesIO(path.read_bytes()))
    found = [m for _, c, m in reader.iter_messages(topics=[POSTURE.name])]
    assert [m.log_time for m in found] == [sample.utc_ns for sample in samples]
    assert [m.publish_time for m in found] == [sample.utc_ns for sample in jumped]


def test_jpeg_shows_the_picture_and_png_holds_it(tmp_path, samples):
    frames = demo_frames(8)
    kept = list(
        DiveRecording(
            recorded(tmp_path / "png.mcap", samples, RecorderOptions(pictures=PictureFormat.PNG))
        ).frames(with_pictures=True)
    )
    for frame, found in zip(frames, kept, strict=True):
        assert np.array_equal(found.picture.luma, frame.luma)
        assert np.array_equal(found.picture.chroma[0], frame.chroma[0])
        assert np.array_equal(found.picture.chroma[1], frame.chroma[1])
    path = recorded(tmp_path / "jpeg.mcap", samples, RecorderOptions(pictures=PictureFormat.JPEG))
    shown = list(DiveRecording(path).frames(with_pictures=True))
    for frame, found in zip(frames, shown, strict=True):
        off = found.picture.luma.astype(float) - frame.luma
        # JPEG at quality 90, there and back through colour: a few grey levels.
        assert np.sqrt(np.mean(off**2)) < 3.0
    message = decoded(path)[PICTURE.name][0]
    assert message.format == "jpeg"
    assert bytes(message.data[:2]) == b"\xff\xd8"


def test_points_at_the_rate_asked_for(tmp_path, samples):
    for hz, n in ((None, 8), (0.0, 0), (5.0, 2), (1000.0, 8)):
        options = RecorderOptions(points_hz=hz)
        path = recorded(tmp_path / f"{hz}.mcap", samples, options)
        assert counted(read_by_mcap(path))[POINTS.name] == n


@pytest.mark.parametrize("wrong", [{"jpeg_quality": 0}, {"jpeg_quality": 101}, {"points_hz": -1.0}])
def test_options_that_cannot_work_are_refused(wrong):
    with pytest.raises(OptionError, match=next(iter(wrong)).split("_")[0]):
        RecorderOptions(**wrong)


def test_a_live_recorder_writes_what_it_is_sent(tmp_path, samples):
    path = tmp_path / "dive.mcap"
    output: Output = Recorder(path, EVERY)
    for sample in samples:
        output.send(sample)
    # On disk a moment after it was sent, while the recording goes on.
    until(lambda: counted(read_by_mcap(path))[POSTURE.name] == 8)
    assert output.health().state is State.OK
    output.close()
    output.close()
    output.send(samples[0])
    assert counted(read_by_rosbags(path))[STRIPES.name] == 8
    assert output.health().state is State.OFF


def test_a_name_that_is_taken_or_impossible_is_refused(tmp_path):
    path = tmp_path / "dive.mcap"
    path.write_bytes(b"mine")
    with pytest.raises(OutputError, match=re.escape(str(path)) + ": exists"):
        Recorder(path)
    assert path.read_bytes() == b"mine"
    with pytest.raises(OutputError, match="choose another place"):
        Recorder(tmp_path / "none" / "dive.mcap")


class Disk:
    """A file on a disk that can be full or asleep."""

    def __init__(self, path):
        self._file = path.open("w+b", buffering=0)
        self.full = False
        self.awake = threading.Event()
        self.awake.set()

    def write(self, content):
        self.awake.wait(2 * TIMEOUT_S)
        if self.full:
            raise OSError(errno.ENOSPC, "No space left on device")
        return self._file.write(content)

    def __getattr__(self, name):
        return getattr(self._file, name)

    def __enter__(self):
        return self

    def __exit__(self, *fault):
        self._file.close()


@pytest.fixture
def disk():
    disks = []

    def open_file(path):
        disks.append(Disk(path))
        return disks[0]

    open_file.disks = disks
    return open_file


def far_apart(samples, first=0):
    """Samples one second apart, so that every one ends a chunk."""
    found = []
    for i, sample in enumerate(samples):
        at = 10**9 * (first + i)
        instants = replace(sample.instants, arrived_ns=at, scanned_ns=at)
        found.append(replace(sample, instants=instants))
    return found


def test_a_full_disk_is_told_and_the_rest_comes_when_there_is_room(
    tmp_path, samples, disk, monkeypatch
):
    monkeypatch.setattr(recorder, "_RETRY_S", 0.05)
    path = tmp_path / "dive.mcap"
    output = Recorder(path, RecorderOptions(chunk_s=0.01), disk)
    for sample in far_apart(samples[:4]):
        output.send(sample)
    until(lambda: counted(read_by_mcap(path))[STRIPES.name] == 4)
    disk.disks[0].full = True
    for sample in far_apart(samples[4:6], 4):
        output.send(sample)
    until(lambda: output.health().state is State.FAULT)
    assert "the disk is full" in output.health().detail
    assert counted(read_by_rosbags(path))[STRIPES.name] == 4
    disk.disks[0].full = False
    until(lambda: output.health().state is State.OK)
    for sample in far_apart(samples[6:], 6):
        output.send(sample)
    output.close()
    frames = DiveRecording(path).frames(with_pictures=False)
    assert [frame.index for frame in frames] == list(range(8))
    assert output.health().n_dropped == 0


def test_a_recording_that_ends_on_a_full_disk_counts_what_is_lost(tmp_path, samples, disk):
    path = tmp_path / "dive.mcap"
    output = Recorder(path, RecorderOptions(chunk_s=0.01), disk)
    output.send(far_apart(samples)[0])
    until(lambda: counted(read_by_mcap(path))[STRIPES.name] == 1)
    disk.disks[0].full = True
    for sample in far_apart(samples[1:4], 1):
        output.send(sample)
    output.close()
    assert output.health().state is State.FAULT
    assert output.health().n_dropped == 3
    assert "the disk is full" in output.health().detail
    assert output.health().detail.endswith("3 samples lost")
    assert counted(read_by_mcap(path))[STRIPES.name] == 1


def test_a_slow_disk_holds_nobody_up_and_loses_nothing(tmp_path, samples, disk):
    path = tmp_path / "dive.mcap"
    output = Recorder(path, RecorderOptions(chunk_s=0.01), disk)
    disk.disks[0].awake.clear()
    longest = 0.0
    for i in range(15):
        for sample in far_apart(samples, 8 * i):
            began = time.perf_counter()
            output.send(sample)
            longest = max(longest, time.perf_counter() - began)
    # The disk sleeps until it is woken below.
    assert longest < TIMEOUT_S
    disk.disks[0].awake.set()
    output.close()
    assert counted(read_by_mcap(path))[STRIPES.name] == 120
    assert output.health().n_dropped == 0


def test_memory_has_its_bound_and_what_exceeds_it_is_counted(tmp_path, samples, disk):
    path = tmp_path / "dive.mcap"
    options = RecorderOptions(chunk_s=0.01, max_waiting_bytes=1 << 20)
    output = Recorder(path, options, disk)
    disk.disks[0].awake.clear()
    for i in range(15):
        for sample in far_apart(samples, 8 * i):
            output.send(sample)
    health = output.health()
    assert health.state is State.WARN
    assert 80 < health.n_dropped < 120
    disk.disks[0].awake.set()
    output.close()
    assert counted(read_by_mcap(path))[STRIPES.name] == 120 - output.health().n_dropped


def test_the_switch_makes_a_file_of_its_own_each_time(tmp_path, samples):
    switch = RecorderSwitch(tmp_path / "dives")
    switch.send(samples[0])
    assert switch.health().state is State.OFF
    switch.stop()
    paths = []
    for n in (2, 3):
        paths.append(switch.start())
        assert switch.start() == paths[-1] == switch.path
        for sample in samples[:n]:
            switch.send(sample)
        assert switch.health().state is State.OK
        switch.stop()
    switch.send(samples[0])
    assert switch.path is None
    assert switch.health().state is State.OFF
    assert [counted(read_by_mcap(path))[STRIPES.name] for path in paths] == [2, 3]
    assert all(re.fullmatch(r"dive_\d{8}T\d{6}Z(_\d+)?\.mcap", path.name) for path in paths)
    blocked = RecorderSwitch(paths[-1] / "folder")
    with pytest.raises(OutputError, match="choose another folder"):
        blocked.start()


def test_torn_chunks_are_left_out_and_counted(tmp_path, samples):
    path = recorded(tmp_path / "dive.mcap", far_apart(samples), RecorderOptions(chunk_s=0.5))
    data = bytearray(path.read_bytes())
    file = McapFile(path)
    at = file._chunks[2]
    data[at + 200 : at + 900] = bytes(700)
    path.write_bytes(data)
    recording = DiveRecording(path)
    frames = list(recording.frames(with_pictures=False))
    assert 8 - len(frames) == 2
    assert recording.n_torn >= 1


def test_a_file_without_its_end_is_read_as_far_as_it_goes(tmp_path, samples):
    path = recorded(tmp_path / "dive.mcap", far_apart(samples), RecorderOptions(chunk_s=0.5))
    whole = path.read_bytes()
    chunks = McapFile(path)._chunks
    path.write_bytes(whole[: chunks[-1] + 1000])
    assert is_recording(path)
    n = len(list(DiveRecording(path).frames(with_pictures=False)))
    assert n == 1 + 2 * (len(chunks) - 2)


def test_the_first_sample_is_in_the_file_at_once_and_the_rig_with_it(tmp_path, samples):
    """A disk that is full, or a kill, in the first half second leaves what can be replayed."""
    path = tmp_path / "dive.mcap"
    recording = Recording(path, RecorderOptions())
    for sample in samples[:2]:
        recording.write(sample)
    dive = DiveRecording(path)
    assert len(list(dive.frames(with_pictures=False))) == 1
    assert dive.rig is not None
    recording.close()


@pytest.mark.parametrize("length", [1 << 62, (1 << 64) - 1])
def test_a_length_beyond_any_file_ends_what_is_read(tmp_path, samples, length):
    """Records that programs add for themselves are skipped, by the length that they say."""
    path = recorded(tmp_path / "dive.mcap", samples[:3])
    damaged = bytearray(path.read_bytes())
    # The footer's content, of 20 bytes, is before the magic at the end.
    start = int.from_bytes(damaged[-28:-20], "little")
    damaged[start : start + 9] = b"\x80" + length.to_bytes(8, "little")
    path.write_bytes(damaged)
    assert len(list(DiveRecording(path).frames(with_pictures=False))) == 3


def test_cdr_is_that_of_rosbags():
    """All alignments, empty sequences among them."""
    store = get_typestore(Stores.EMPTY)
    definition = "uint8 a\nfloat64[] b\nuint8 c\nstring d\nint64 e\nuint16[] f\nfloat64[2] g\n"
    store.register(get_types_from_msg(definition, "x/msg/T"))
    for b, d in (([], ""), ([1.5, -2.0], "höhe"), ([math.inf], "x" * 7)):
        to = CdrWriter()
        to.numbers("B", 7)
        to.array(np.array(b, "f8"))
        to.numbers("B", 9)
        to.text(d)
        to.numbers("q", -5)
        to.array(np.array([3, 4, 5], "u2"))
        to.numbers("d", 0.25, 4.0)
        content = to.finish()
        found: Any = store.deserialize_cdr(content, "x/msg/T")
        assert (found.a, list(found.b), found.c, found.d, found.e) == (7, b, 9, d, -5)
        assert (list(found.f), list(found.g)) == ([3, 4, 5], [0.25, 4.0])
        assert bytes(store.serialize_cdr(found, "x/msg/T")) == content
        of = CdrReader(content)
        assert of.number("B") == 7
        assert list(of.array("f8")) == b
        assert (of.number("B"), of.text(), of.number("q")) == (9, d, -5)
        assert list(of.array("u2")) == [3, 4, 5]
        assert of.numbers("d", 2) == (0.25, 4.0)
        with pytest.raises(ValueError, match="cut short"):
            of.number("d")
    with pytest.raises(ValueError, match="CDR"):
        CdrReader(b"\x00\x00\x00\x00")


@pytest.mark.parametrize("rig", [flat_port_rig(), replace(flat_port_rig(), housing=None)])
def test_a_recorded_rig_comes_back_to_the_last_bit_whatever_its_housing(rig):
    exact = replace(rig, housing=rig.housing and rig.housing.moved_by({"port_tilt_x": 1e-15}))
    back = rig_from_record(rig_text(rig_to_mapping(exact)), rig_exact(exact), "dive.mcap")
    assert back.housing == exact.housing
