"""Images in MCAP files and ROS bags, written by the projects' own writers."""

import base64
import contextlib
import json
import os
import struct
from fractions import Fraction

import av
import cv2
import numpy as np
import pyarrow as pa
import pytest

from aqualvs.errors import OptionError, SourceError
from aqualvs.recording import PictureFormat, RecorderOptions, Recording
from aqualvs.sources import bags, image_messages, open_feed, open_source
from aqualvs.sources.fields import FieldEvidence, first_pairs
from aqualvs.sources.image_messages import ImageMessage, planes_of_message, protobuf_fields
from aqualvs.sources.mcap_file import decompressed
from live_cases import demo_samples
from shell_cases import luma_level, picture

mcap_writer = pytest.importorskip("mcap.writer")
rosbag1 = pytest.importorskip("rosbags.rosbag1")
rosbag2 = pytest.importorskip("rosbags.rosbag2")
typesys = pytest.importorskip("rosbags.typesys")

SIZE = (96, 64)
START_NS = 1_700_000_000_000_000_000
STEP_NS = 40_000_000

# JPEG and BT.601 round to a level or two; pictures differ by ten.
LEVEL_TOLERANCE = 3.0


def stamp(i):
    return divmod(START_NS + i * STEP_NS, 1_000_000_000)


def jpeg(i):
    return cv2.imencode(".jpg", picture(i, SIZE))[1].tobytes()


def check(source, n=6):
    with source:
        assert source.size_px == SIZE
        assert source.n_frames in (n, None)
        assert source.fps == pytest.approx(25.0)
        frames = list(source)
    assert [f.index for f in frames] == list(range(n))
    assert [f.time_s for f in frames] == pytest.approx([0.04 * i for i in range(n)], abs=1e-6)
    for i, frame in enumerate(frames):
        assert frame.luma.mean() == pytest.approx(luma_level(i), abs=LEVEL_TOLERANCE)


def varint(value):
    found = bytearray()
    while value > 0x7F:
        found.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*found, value])


def protobuf(**fields):
    """A message of Protobuf; names are letters and field numbers, `f` for fixed 32 bits."""
    found = b""
    for name, value in fields.items():
        number = int(name[1:])
        if name[0] == "f":
            found += varint(number << 3 | 5) + struct.pack("<I", value)
        elif isinstance(value, int):
            found += varint(number << 3) + varint(value)
        else:
            found += varint(number << 3 | 2) + varint(len(value)) + value
    return found


def protobuf_stamp(i):
    seconds, nanoseconds = stamp(i)
    return protobuf(n1=seconds, n2=nanoseconds)


def write_mcap(path, topics, *, finish=True, **options):
    """Write topics: name, schema name, schema encoding and text, message encoding, messages."""
    with path.open("wb") as stream:
        writer = mcap_writer.Writer(stream, chunk_size=20_000, **options)
        writer.start()
        for name, schema, (kind, text), encoding, messages in topics:
            schema_id = writer.register_schema(schema, kind, text)
            channel = writer.register_channel(name, encoding, schema_id)
            for i, data in enumerate(messages):
                at = START_NS + i * STEP_NS + 3_000_000
                writer.add_message(channel, at, data, at)
        if finish:
            writer.finish()
    return path


def compressed_image(n=6, name="/camera", start=0):
    messages = [
        protobuf(n1=protobuf_stamp(i), n2=jpeg(start + i), n3=b"jpeg", n4=b"cam") for i in range(n)
    ]
    return name, "foxglove.CompressedImage", ("protobuf", b""), "protobuf", messages


def raw_image():
    messages = [
        protobuf(
            n1=protobuf_stamp(i),
            f2=SIZE[0],
            f3=SIZE[1],
            n4=b"bgr8",
            f5=3 * SIZE[0],
            n6=picture(i, SIZE).tobytes(),
        )
        for i in range(6)
    ]
    return "/camera", "foxglove.RawImage", ("protobuf", b""), "protobuf", messages


def json_image():
    messages = []
    for i in range(6):
        seconds, nanoseconds = stamp(i)
        data = base64.b64encode(jpeg(i)).decode()
        message = {"timestamp": {"sec": seconds, "nsec": nanoseconds}, "data": data}
        messages.append(json.dumps({**message, "frame_id": "", "format": "jpeg"}).encode())
    return "/camera", "foxglove.CompressedImage", ("jsonschema", b"{}"), "json", messages


def video_packets(n=6, gop=3, **more):
    codec = av.CodecContext.create("libx264", "w")
    codec.width, codec.height = SIZE
    codec.pix_fmt, codec.time_base, codec.gop_size = "yuv420p", Fraction(1, 25), gop
    codec.options = {"preset": "ultrafast", "tune": "zerolatency", **more}
    packets = []
    for i in range(n):
        frame = av.VideoFrame.from_ndarray(picture(i, SIZE), format="bgr24")
        frame.pts = i
        packets += codec.encode(frame)
    return [bytes(p) for p in packets + codec.encode(None)]


def compressed_video(packets=None):
    messages = [
        protobuf(n1=protobuf_stamp(i), n2=b"cam", n3=data, n4=b"h264")
        for i, data in enumerate(packets or video_packets())
    ]
    return "/video", "foxglove.CompressedVideo", ("protobuf", b""), "protobuf", messages


def ros_image(store, i, *, ros1=False):
    """Serialised `sensor_msgs/Image` of a picture, grey."""
    types = store.types
    seconds, nanoseconds = stamp(i)
    header = {"seq": i} if ros1 else {}
    image = cv2.cvtColor(picture(i, SIZE), cv2.COLOR_BGR2YUV_I420)[: SIZE[1]]
    return types["sensor_msgs/msg/Image"](
        header=types["std_msgs/msg/Header"](
            stamp=types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds),
            frame_id="cam",
            **header,
        ),
        height=SIZE[1],
        width=SIZE[0],
        encoding="mono8",
        is_bigendian=0,
        step=SIZE[0],
        data=image.reshape(-1),
    )


def ros2_topic(name="/camera/image"):
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    kind = "sensor_msgs/msg/Image"
    text = store.generate_msgdef(kind, ros_version=2)[0].encode()
    messages = [bytes(store.serialize_cdr(ros_image(store, i), kind)) for i in range(6)]
    return name, kind, ("ros2msg", text), "cdr", messages


@pytest.mark.parametrize("make", [compressed_image, raw_image, json_image, ros2_topic])
def test_images_of_an_mcap_file(tmp_path, make):
    check(open_source(write_mcap(tmp_path / "a.mcap", [make()])))


def test_video_of_an_mcap_file(tmp_path):
    check(open_source(write_mcap(tmp_path / "a.mcap", [compressed_video()])))


def test_video_of_fields_says_so(tmp_path):
    packets = video_packets(flags="+ilme+ildct", **{"x264-params": "tff=1"})
    for given, interlaced in ((packets, True), (None, False)):
        path = write_mcap(tmp_path / f"{interlaced}.mcap", [compressed_video(given)])
        with open_source(path) as source:
            assert FieldEvidence.of(first_pairs(source)).is_marked == interlaced
            assert {frame.is_interlaced for frame in source} == {interlaced}


def test_video_with_a_lost_packet_waits_for_the_next_key_frame(tmp_path):
    packets = video_packets(9)
    packets[4] = b""
    path = write_mcap(tmp_path / "a.mcap", [compressed_video(packets)])
    with open_source(path) as source:
        assert [f.index for f in source] == [0, 1, 2, 3, 6, 7, 8]


def bag1(path, packed=None):
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    kind = "sensor_msgs/msg/Image"
    with contextlib.closing(rosbag1.Writer(path)) as writer:
        if packed is not None:
            writer.set_compression(packed)
        writer.open()
        connection = writer.add_connection("/camera/image", kind, typestore=store)
        for i in range(6):
            data = store.serialize_ros1(ros_image(store, i, ros1=True), kind)
            writer.write(connection, START_NS + i * STEP_NS, data)
    return path


def bag2(path, plugin, packed=None):
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    kind = "sensor_msgs/msg/Image"
    with contextlib.closing(rosbag2.Writer(path, version=8, storage_plugin=plugin)) as writer:
        if packed is not None:
            writer.set_compression(packed, rosbag2.CompressionFormat.ZSTD)
        writer.open()
        connection = writer.add_connection("/camera/image", kind, typestore=store)
        for i in range(6):
            data = store.serialize_cdr(ros_image(store, i), kind)
            writer.write(connection, START_NS + i * STEP_NS, data)
    return path


def test_images_of_a_bag_of_ros_1(tmp_path):
    check(open_source(bag1(tmp_path / "dive.bag")))


@pytest.mark.parametrize("plugin", list(rosbag2.StoragePlugin))
def test_images_of_a_bag_of_ros_2(tmp_path, plugin):
    folder = bag2(tmp_path / "dive", plugin)
    check(open_source(folder))
    file = next(p for p in folder.iterdir() if p.suffix in (".db3", ".mcap"))
    check(open_source(file))


def test_a_bag_whose_metadata_count_nothing_is_refused_in_one_line(tmp_path):
    folder = bag2(tmp_path / "dive", rosbag2.StoragePlugin.SQLITE3)
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("message_count: 6", "message_count: null"))
    with pytest.raises(SourceError, match="count of a topic") as fault:
        open_source(folder)
    assert str(folder) in str(fault.value)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with names")
def test_a_pipe_in_the_place_of_a_bags_file_is_not_waited_for(tmp_path):
    folder = bag2(tmp_path / "dive", rosbag2.StoragePlugin.SQLITE3)
    (folder / "dive.db3").unlink()
    os.mkfifo(folder / "dive.db3")
    with pytest.raises(SourceError, match="is a pipe"):
        open_source(folder)


SQLITE, MCAP = rosbag2.StoragePlugin.SQLITE3, rosbag2.StoragePlugin.MCAP
PACKED = {
    "ROS 1 bz2": lambda path: bag1(path / "a.bag", rosbag1.Writer.CompressionFormat.BZ2),
    "ROS 1 lz4": lambda path: bag1(path / "a.bag", rosbag1.Writer.CompressionFormat.LZ4),
    "messages": lambda path: bag2(path / "a", SQLITE, rosbag2.CompressionMode.MESSAGE),
    "file": lambda path: bag2(path / "a", SQLITE, rosbag2.CompressionMode.FILE),
    "MCAP chunks": lambda path: bag2(path / "a", MCAP, rosbag2.CompressionMode.STORAGE),
}


@pytest.mark.parametrize("kind", list(PACKED))
def test_packed_bags_are_read_and_never_unpacked_without_bound(tmp_path, monkeypatch, kind):
    path = PACKED[kind](tmp_path)
    check(open_source(path))
    # A picture has 6 kB.
    monkeypatch.setattr(bags, "MAX_BYTES", 3_000)
    monkeypatch.setattr(bags, "_FREE_BYTES", 1 << 60)
    with pytest.raises(SourceError, match="unpacked") as fault:
        list(open_source(path))
    assert str(path) in str(fault.value)
    assert "\n" not in str(fault.value)


def test_one_of_several_topics_must_be_named(tmp_path):
    topics = [compressed_image(), compressed_image(name="/rear/camera", start=3)]
    path = write_mcap(tmp_path / "a.mcap", topics)
    with pytest.raises(OptionError, match=r"/camera, /rear/camera.*a\.mcap#") as fault:
        open_source(path)
    assert "\n" not in str(fault.value)
    for source in (
        open_source(f"{path}#/rear/camera"),
        open_source(f"{path}#rear/camera"),
        open_source(path, topic="/rear/camera"),
    ):
        with source:
            first = next(iter(source))
        assert first.luma.mean() == pytest.approx(luma_level(3), abs=LEVEL_TOLERANCE)
    with pytest.raises(OptionError, match="no images on topic /sonar; there is"):
        open_source(path, topic="/sonar")


def test_a_topic_for_what_has_none_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), picture(0, SIZE))
    with pytest.raises(OptionError, match="topic"):
        open_source(tmp_path, topic="/camera")
    with pytest.raises(OptionError, match="frame rate"):
        open_source(write_mcap(tmp_path / "a.mcap", [compressed_image()]), fps=3.0)


def test_a_file_without_images_is_refused(tmp_path):
    topic = "/depth", "foxglove.Log", ("protobuf", b""), "protobuf", [b""]
    with pytest.raises(SourceError, match="holds no images"):
        open_source(write_mcap(tmp_path / "a.mcap", [topic]))


@pytest.mark.parametrize("kind", [None, PictureFormat.PNG])
def test_a_recording_of_aqualvs_without_whole_pictures_says_what_it_is(tmp_path, kind):
    path = own_recording(tmp_path / "dive.mcap", kind)
    words = "without pictures" if kind is None else r"in two parts \(PNG\)"
    with pytest.raises(SourceError, match=f"a recording of aqualvs .*{words}.*aqualvs run") as told:
        open_feed(path)
    assert "\n" not in str(told.value)
    with pytest.raises(OptionError, match="no images on topic /sonar"):
        open_source(path, topic="/sonar")


def test_pictures_of_a_recording_of_aqualvs_are_a_source(tmp_path):
    """As `aqualvs live --record-video` keeps them; the topic of chroma is known, but empty."""
    with open_source(own_recording(tmp_path / "dive.mcap", PictureFormat.JPEG)) as source:
        assert source.name.endswith("#/aqualvs/picture")
        frames = list(source)
    assert len(frames) == 3
    assert all(frame.chroma is not None for frame in frames)


def own_recording(path, kind):
    recording = Recording(path, RecorderOptions(pictures=kind))
    for sample in demo_samples(3):
        recording.write(sample)
    recording.close()
    return path


def test_a_file_cut_short_gives_what_it_has(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", [compressed_image(60)])
    data = path.read_bytes()
    path.write_bytes(data[: int(0.6 * len(data))])
    delivered = []
    with open_source(path) as source, pytest.raises(SourceError, match="cut short"):
        delivered.extend(source)
    assert [f.index for f in delivered] == list(range(len(delivered)))
    assert 20 < len(delivered) < 60


@pytest.mark.parametrize("name", ["a.mcap", "a.bag", "a.db3"])
@pytest.mark.parametrize("content", [b"", b"nothing of the kind\n" * 20])
def test_what_is_no_recording_is_refused_in_one_line(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(SourceError) as fault:
        open_source(path)
    assert str(path) in str(fault.value)
    assert "\n" not in str(fault.value)


def test_a_damaged_message_leaves_a_gap_and_a_damaged_end_is_said(tmp_path):
    topic = compressed_image(8)
    topic[-1][3] = b"\x0a\xff\xff\xff"
    topic[-1][5] = protobuf(n1=protobuf_stamp(5), n2=b"no picture", n3=b"jpeg")
    with open_source(write_mcap(tmp_path / "a.mcap", [topic])) as source:
        assert [f.index for f in source] == [0, 1, 2, 4, 6, 7]
    topic[-1][7] = b""
    delivered = []
    path = write_mcap(tmp_path / "b.mcap", [topic])
    with open_source(path) as source, pytest.raises(SourceError, match="last 1 of 8 images"):
        delivered.extend(source)
    assert len(delivered) == 5


def test_a_change_of_size_is_refused(tmp_path):
    topic = compressed_image(3)
    small = cv2.imencode(".jpg", picture(0, (32, 32)))[1].tobytes()
    topic[-1][2] = protobuf(n1=protobuf_stamp(2), n2=small, n3=b"jpeg")
    with (
        open_source(write_mcap(tmp_path / "a.mcap", [topic])) as source,
        pytest.raises(SourceError, match="changes from 96x64 to 32x32 px at frame 2"),
    ):
        list(source)


def test_a_recording_as_a_live_feed(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", [compressed_image()])
    assert len(list(open_feed(path, realtime=False))) == 6


RNG = np.random.default_rng(8)
BGR = RNG.integers(0, 256, (4, 6, 3), dtype=np.uint8)
GREY = RNG.integers(0, 256, (4, 6), dtype=np.uint8)


def raw(encoding, image, **more):
    size = (image.shape[1], image.shape[0])
    return ImageMessage(stamp_ns=0, encoding=encoding, data=image.tobytes(), size_px=size, **more)


@pytest.mark.parametrize(
    ("encoding", "image"),
    [
        ("bgr8", BGR),
        ("8UC3", BGR),
        ("rgb8", BGR[..., ::-1]),
        ("bgra8", np.dstack([BGR, GREY])),
        ("rgba8", np.dstack([BGR[..., ::-1], GREY])),
    ],
)
def test_orders_of_colours(encoding, image):
    luma, _ = planes_of_message(raw(encoding, image))
    true, _ = planes_of_message(raw("bgr8", BGR))
    np.testing.assert_array_equal(luma, true)


def test_grey_and_its_deeper_forms():
    for message in (
        raw("mono8", GREY),
        raw("mono16", GREY.astype("<u2") * 256 + 7),
        raw("16UC1", (GREY.astype("u2") * 256 + 7).astype(">u2"), is_big_endian=True),
        raw("mono8", np.pad(GREY, ((0, 0), (0, 3)))[:, :9], step=9),
    ):
        if message.step:
            message = ImageMessage(
                stamp_ns=0, encoding="mono8", data=message.data, size_px=(6, 4), step=9
            )
        luma, chroma = planes_of_message(message)
        np.testing.assert_array_equal(luma, GREY)
        assert chroma is None


@pytest.mark.parametrize(("encoding", "first"), [("yuv422_yuy2", 0), ("yuv422", 1), ("uyvy", 1)])
def test_packed_colour_keeps_luma(encoding, first):
    packed = RNG.integers(0, 256, (4, 6, 2), dtype=np.uint8)
    luma, (u, v) = planes_of_message(raw(encoding, packed))
    np.testing.assert_array_equal(luma, packed[..., first])
    both = packed[..., 1 - first].astype(int)
    mean = (both[0::2] + both[1::2] + 1) // 2
    np.testing.assert_array_equal(u, mean[:, 0::2])
    np.testing.assert_array_equal(v, mean[:, 1::2])


@pytest.mark.parametrize(
    ("encoding", "red_at"),
    [
        ("bayer_rggb8", (0, 0)),
        ("bayer_bggr8", (1, 1)),
        ("bayer_gbrg8", (1, 0)),
        ("bayer_grbg8", (0, 1)),
    ],
)
def test_colour_filters(encoding, red_at):
    """A red scene: only the red pixels of the pattern are bright."""
    mosaic = np.zeros((16, 16), np.uint8)
    mosaic[red_at[0] :: 2, red_at[1] :: 2] = 200
    luma, (_, v) = planes_of_message(raw(encoding, mosaic))
    # BT.601: red of 200 has luma 67 and a V far above grey.
    assert luma[4:12, 4:12].mean() == pytest.approx(16 + 200 * 65.481 / 255, abs=2)
    assert v[2:6, 2:6].min() > 190


def test_too_few_pixels_are_no_picture():
    assert planes_of_message(raw("bgr8", BGR[:3], step=18)) is not None
    short = ImageMessage(stamp_ns=0, encoding="bgr8", data=bytes(20), size_px=(6, 4))
    assert planes_of_message(short) is None


def test_an_unknown_encoding_is_refused_with_those_known(tmp_path):
    name, schema, text, encoding, messages = raw_image()
    messages = [m.replace(b"bgr8", b"xyz9") for m in messages]
    path = write_mcap(tmp_path / "a.mcap", [(name, schema, text, encoding, messages)])
    with pytest.raises(SourceError, match=r"encoding 'xyz9'.*mono8"):
        open_source(path)


def test_protobuf_fields():
    content = protobuf(n1=300, n2=b"abc", f3=7) + varint(4 << 3 | 1) + struct.pack("<Q", 2**40)
    assert protobuf_fields(content) == {1: 300, 2: b"abc", 3: 7, 4: 2**40}
    for cut in (b"\x0a", b"\x0a\x05ab", b"\xff" * 12, b"\x0b"):
        with pytest.raises(ValueError, match=r"cut short|wire type"):
            protobuf_fields(cut)


@pytest.mark.parametrize("finish", [True, False], ids=["with index", "without"])
@pytest.mark.parametrize("codec", ["lz4", "zstd"])
def test_a_chunk_that_would_fill_the_memory_is_refused_and_what_is_before_it_kept(
    tmp_path, codec, finish
):
    path = tmp_path / "bomb.mcap"
    *head, messages = compressed_image(6)
    name, schema, (kind, text), encoding = head
    with path.open("wb") as stream:
        compression = getattr(mcap_writer.CompressionType, codec.upper())
        writer = mcap_writer.Writer(stream, chunk_size=1, compression=compression)
        writer.start()
        schema_id = writer.register_schema(schema, kind, text)
        channel = writer.register_channel(name, encoding, schema_id)
        for i, data in enumerate([*messages, bytes(3_000_000)]):
            at = START_NS + i * STEP_NS
            writer.add_message(channel, at, data, at)
        if finish:
            writer.finish()
    data = path.read_bytes()
    # What a chunk claims to hold is what is believed.
    at = data.index((3_000_000 + 31).to_bytes(8, "little"))
    path.write_bytes(data[:at] + (1 << 40).to_bytes(8, "little") + data[at + 8 :])
    delivered = []
    with open_source(path) as source, pytest.raises(SourceError, match="damaged, or cut short"):
        delivered.extend(source)
    assert len(delivered) == 6


@pytest.mark.parametrize("codec", ["lz4", "zstd"])
def test_a_chunk_larger_than_it_claims_is_damaged(codec):
    packed = pa.compress(bytes(500_000), codec=codec, asbytes=True)
    assert len(decompressed(codec, packed, 500_000)) == 500_000
    with pytest.raises((ValueError, OSError)):
        decompressed(codec, packed, 1_000)
    with pytest.raises(ValueError, match="1099511627776"):
        decompressed(codec, packed, 1 << 40)


def test_a_record_in_a_chunk_that_is_longer_than_any_file_is_damaged(tmp_path):
    plain = mcap_writer.CompressionType.NONE
    path = write_mcap(tmp_path / "long.mcap", [compressed_image(6)], compression=plain)
    data = bytearray(path.read_bytes())
    # Before a message's data stand 22 bytes of numbers and times, and before them its length.
    data[data.index(compressed_image(6)[-1][3]) - 23] = 0x80
    path.write_bytes(data)
    with pytest.raises(SourceError, match="damaged"), open_source(path) as source:
        list(source)


def test_empty_messages_of_ros_2_are_left_out(tmp_path):
    """The package that decodes them raises an exception of its own."""
    text = "uint8[] data"
    topic = ("/camera", "sensor_msgs/msg/CompressedImage", ("ros2msg", text.encode()), "cdr")
    path = write_mcap(tmp_path / "empty.mcap", [(*topic, [b""] * 5)])
    with pytest.raises(SourceError, match="no image can be decoded"):
        open_source(path)


def test_messages_without_any_picture_are_given_up(tmp_path, monkeypatch):
    monkeypatch.setattr(image_messages, "_MAX_UNREADABLE", 30)
    name, *rest, messages = compressed_image(12)
    damaged = write_mcap(tmp_path / "gap.mcap", [(name, *rest, [*messages, *[b""] * 60])])
    with open_source(damaged) as source, pytest.raises(SourceError, match="31 messages in a row"):
        list(source)
    gap = write_mcap(tmp_path / "gap.mcap", [(name, *rest, [*messages, *[b""] * 30, *messages])])
    with open_source(gap) as source:
        assert len(list(source)) == 24


def test_a_chunk_of_too_many_records_is_damaged(tmp_path, monkeypatch):
    path = write_mcap(tmp_path / "many.mcap", [compressed_image(6)])
    monkeypatch.setattr(bags, "_MAX_RECORDS", 5)
    with pytest.raises(SourceError, match="damaged"):
        open_source(path)
