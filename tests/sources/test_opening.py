"""What a user types, and the feed that reads it."""

import base64
import sys
import threading
import time

import cv2
import numpy as np
import pytest

from aqualvs.errors import OptionError, SourceError
from aqualvs.sources import ImageSource, open_feed, open_source
from aqualvs.sources.base import State
from aqualvs.sources.datagrams import UdpAddress, parse_udp
from aqualvs.sources.opening import PacedFeed
from aqualvs.sources.remote import CameraFeed, RemoteFeed, camera_device, camera_options
from aqualvs.sources.udp import UdpFeed, read_sdp
from aqualvs.sources.video import FrameCounter
from shell_cases import cut_after, picture, write_video
from waiting import TIMEOUT_S, until

SDP = """v=0
o=- 1188340656180883 1 IN IP4 192.168.2.2
s=BlueROV2
t=0 0
m=audio 5000 RTP/AVP 97
m=video 5600 RTP/AVP 96
c=IN IP4 {host}
a=rtpmap:96 {codec}/90000
a=fmtp:96 packetization-mode=1; sprop-parameter-sets={sets}
"""


@pytest.mark.parametrize(
    ("where", "kind"),
    [
        ("bluerov", UdpFeed),
        ("udp://:5600", UdpFeed),
        ("udp://@:5600", UdpFeed),
        ("UDP://0.0.0.0:5600?overrun_nonfatal=1", UdpFeed),
        ("rtp://239.1.2.3:5600", UdpFeed),
        ("rtsp://192.168.2.2:8554/video", RemoteFeed),
        ("srt://192.168.2.2:7000", RemoteFeed),
        ("tcp://192.168.2.2:7000", RemoteFeed),
        ("camera:0", CameraFeed),
        ("/dev/video3", CameraFeed),
        ("/dev/v4l/by-id/usb-camera", CameraFeed),
    ],
)
def test_the_table_of_feeds(where, kind):
    feed = open_feed(where)
    assert type(feed) is kind
    assert feed.health().state is State.FAULT
    feed.close()
    assert (feed.health().state, feed.name) == (State.OFF, feed.health().name)


@pytest.mark.parametrize(
    ("where", "host", "port"),
    [
        ("udp://:5600", "", 5600),
        ("udp://@:5600", "", 5600),
        ("udp://@239.255.1.2:1234", "239.255.1.2", 1234),
        ("udp://0.0.0.0:5600", "0.0.0.0", 5600),
        ("rtp://localhost:5004", "127.0.0.1", 5004),
        ("udp://[::]:5600", "::", 5600),
    ],
)
def test_addresses_to_listen_on(where, host, port):
    assert parse_udp(where) == UdpAddress(host, port)


@pytest.mark.parametrize(
    ("where", "words"),
    [
        ("udp://192.168.2.1", "no port"),
        ("udp://:99999", "Port out of range"),
        ("udp://[", "no address"),
        ("rtsp://[::1/video", "no address"),
        ("http://\n", "control character"),
        ("rtsp://a b/video", "space"),
        ("rtsp://", "neither host nor port"),
        ("tcp://127.0.0.1:0", "port 0"),
        ("udp://blueos.local:5600", r"numeric address.*udp://:5600"),
    ],
)
def test_addresses_that_cannot_work_are_refused_in_one_line(where, words):
    with pytest.raises(SourceError, match=words) as fault:
        open_feed(where)
    assert "\n" not in str(fault.value)


@pytest.mark.parametrize("where", ["udp://[", "rtsp://", "http://a:99999/", "tcp://\n:5600"])
def test_what_is_no_address_is_refused_before_ffmpeg_waits_for_it(where):
    with pytest.raises(SourceError, match="SCHEME://HOST:PORT"):
        open_source(where)


@pytest.mark.parametrize(
    ("where", "options", "words"),
    [
        ("udp://:5600", {"transport": "tcp"}, "only RTSP"),
        ("udp://:5600", {"fps": 25.0}, "own clock"),
        ("rtsp://a/b", {"size_px": (640, 480)}, "only a camera"),
        ("camera:0", {"transport": "tcp"}, "no transport"),
        ("camera:0", {"fps": -1.0}, "must be positive"),
        ("udp://:5600", {"realtime": False}, "only a recording can be read faster"),
        ("camera:0", {"realtime": False}, "only a recording can be read faster"),
    ],
)
def test_options_that_do_not_go_with_a_source_are_refused(where, options, words):
    with pytest.raises(OptionError, match=words):
        open_feed(where, **options)


def sdp_file(tmp_path, *, host="192.168.2.1", codec="H264", sets=""):
    path = tmp_path / "camera.sdp"
    path.write_text(SDP.format(host=host, codec=codec, sets=sets).replace("\n", "\r\n"))
    return path


def test_a_session_description_gives_port_type_and_parameter_sets(tmp_path):
    sets = b"\x67\x42\x00\x1e", b"\x68\xce\x38\x80"
    text = ",".join(base64.b64encode(each).decode() for each in sets)
    video = read_sdp(sdp_file(tmp_path, sets=text))
    assert (video.address, video.payload_type, video.codec) == (UdpAddress("", 5600), 96, "H264")
    assert video.parameter_sets == b"".join(b"\x00\x00\x00\x01" + each for each in sets)
    feed = open_feed(tmp_path / "camera.sdp")
    assert type(feed) is UdpFeed
    assert feed.port == 5600


def test_a_session_of_a_group_or_of_another_codec(tmp_path):
    assert read_sdp(sdp_file(tmp_path, host="239.1.2.3/64")).address.host == "239.1.2.3"
    assert type(open_feed(sdp_file(tmp_path, codec="H265"))) is RemoteFeed


@pytest.mark.parametrize("media", ["audio 5000 RTP/AVP 97", f"video {'9' * 5000} RTP/AVP 96"])
def test_a_session_without_video_is_refused(tmp_path, media):
    path = tmp_path / "sound.sdp"
    path.write_text(f"v=0\nm={media}\n")
    with pytest.raises(SourceError, match="announces no video"):
        open_feed(path)
    with pytest.raises(SourceError, match="cannot be read"):
        open_feed(tmp_path / "missing.sdp")
    with pytest.raises(SourceError, match="aqualvs live"):
        open_source(path)


@pytest.mark.parametrize(
    ("where", "device"),
    [
        ("camera:2", "/dev/video2"),
        ("/dev/video0", "/dev/video0"),
        ("camera:/dev/v4l/by-id/usb", "/dev/v4l/by-id/usb"),
    ],
)
def test_names_of_cameras(where, device):
    assert camera_device(where) == device


def test_what_is_asked_of_a_camera():
    assert camera_options((1920, 1080), 29.97, "h264") == {
        "video_size": "1920x1080",
        "framerate": "29.97",
        "input_format": "h264",
    }
    assert camera_options(None, None, None) == {}


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Video4Linux")
def test_a_missing_camera_is_said_in_one_line():
    with pytest.raises(SourceError, match=r"/dev/video987: no such camera") as fault:
        next(iter(open_feed("camera:987")))
    assert "\n" not in str(fault.value)
    with pytest.raises(SourceError, match="names no camera"):
        open_feed("camera:")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Video4Linux")
def test_a_device_that_is_no_camera_is_tried_again(tmp_path):
    """A file stands for a camera that another program holds: it exists and cannot be opened."""
    path = tmp_path / "video0"
    path.write_bytes(b"")
    feed = CameraFeed(f"camera:{path}", {})
    thread = threading.Thread(target=lambda: list(feed), daemon=True)
    thread.start()
    until(lambda: "no connection" in feed.health().detail)
    assert feed.health().state is State.FAULT
    feed.close()
    thread.join(TIMEOUT_S)
    assert not thread.is_alive()


def images(folder, n):
    for i in range(n):
        cv2.imwrite(str(folder / f"{i}.png"), picture(i, (96, 64)))
    return folder


def test_a_recording_comes_at_its_own_pace_or_as_fast_as_it_is_taken(tmp_path):
    images(tmp_path, 5)
    # At the slower rate, waiting for the last of five tiny pictures would take 400 s.
    for realtime, fps in ((True, 20.0), (False, 0.01)):
        feed = open_feed(tmp_path, realtime=realtime, fps=fps)
        began = time.monotonic()
        frames = list(feed)
        span = time.monotonic() - began
        assert [f.index for f in frames] == list(range(5))
        assert [f.time_s for f in frames] == pytest.approx([i / fps for i in range(5)])
        assert feed.health().state is State.OFF
        assert span >= 0.2 if realtime else span < TIMEOUT_S


def test_a_paced_recording_can_be_closed_while_it_waits(tmp_path):
    feed = open_feed(images(tmp_path, 2), fps=0.01)
    frames = iter(feed)
    next(frames)
    threading.Timer(0.1, feed.close).start()
    # The second picture is due after 100 s.
    began = time.monotonic()
    assert list(frames) == []
    assert time.monotonic() - began < TIMEOUT_S
    assert feed.health().detail == "closed"


def test_lost_frames_of_a_recording_are_counted_and_its_faults_told(tmp_path):
    images(tmp_path, 5)
    (tmp_path / "2.png").write_bytes(b"broken")
    feed = PacedFeed(ImageSource(tmp_path, fps=1000.0), realtime=False)
    assert [f.index for f in feed] == [0, 1, 3, 4]
    assert feed.health().n_dropped == 1
    mux = {"movflags": "faststart"}
    path = write_video(tmp_path / "a.mp4", 20, size=(96, 64), mux=mux)
    cut_after(path, 9)
    with pytest.raises(SourceError, match="of 20 frames"):
        list(open_feed(path, realtime=False))


@pytest.mark.parametrize(
    ("typed", "hint"),
    [
        ("5600", "udp://:5600"),
        ("udp:5600", "udp://:5600"),
        ("0.0.0.0:5602", "udp://:5602"),
        ("camera", "camera:0"),
        ("1", "camera:1"),
        ("dive5600", ""),
    ],
)
def test_a_mistyped_port_or_camera_is_told_what_to_type(typed, hint, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SourceError, match="no such file or folder; check the path") as fault:
        open_feed(typed)
    assert hint in str(fault.value)
    assert ("or type" in str(fault.value)) == bool(hint)


@pytest.mark.parametrize("opener", [open_source, open_feed])
def test_an_address_of_an_unknown_kind_is_shown_as_typed_with_those_that_are_known(opener):
    words = r"foo://bar: unknown kind of address; give one .* http, .* tcp or udp, or a path"
    with pytest.raises(SourceError, match=words):
        opener("foo://bar")


def test_a_missing_file_is_refused_at_once(tmp_path):
    with pytest.raises(SourceError, match="no such file"):
        open_feed(tmp_path / "missing.mp4")


def test_pictures_of_a_paced_video_are_those_of_the_source(tmp_path):
    path = write_video(tmp_path / "a.mp4", 6, size=(96, 64))
    with open_source(path) as source:
        true = [f.luma for f in source]
    found = [f.luma for f in open_feed(str(path), realtime=False)]
    assert all(np.array_equal(a, b) for a, b in zip(found, true, strict=True))


def test_a_feed_of_a_file_that_has_ended_or_was_closed_is_not_read_again(tmp_path):
    path = write_video(tmp_path / "a.mp4", 5, size=(64, 48))
    feed = open_feed(path, realtime=False)
    assert len(list(feed)) == 5
    with pytest.raises(SourceError, match="open it again"):
        list(feed)
    feed.close()
    assert list(feed) == []


def test_a_failure_of_reading_a_file_is_one_line(tmp_path, monkeypatch):
    """A feed that raises anything else is begun again, which no file can be."""
    write_video(tmp_path / "a.mp4", 5, size=(64, 48))

    def fail(*_):
        raise TypeError("surprise\nin two lines")

    monkeypatch.setattr(FrameCounter, "number", fail)
    feed = open_feed(tmp_path / "a.mp4", realtime=False)
    with pytest.raises(SourceError, match=r"a\.mp4: cannot be read on \(TypeError: surprise\)"):
        list(feed)
