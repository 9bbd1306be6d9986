"""The live decoder: exact pictures, or none."""

import hashlib
import time
from fractions import Fraction
from itertools import pairwise

import av
import cv2
import numpy as np
import pytest
from av.video.frame import VideoFrame

from aqualvs.sources.base import State, packet_with
from aqualvs.sources.h264 import FrameNumbers
from aqualvs.sources.live_frames import LiveDecoder, LiveFrames, Reception

SIZE = (192, 128)
ONE_SLICE = "sliced-threads=0:slices=1"
KINDS = {
    "several slices": {"tune": "zerolatency"},
    "one slice": {"tune": "zerolatency", "x264-params": ONE_SLICE},
    "baseline": {"tune": "zerolatency", "profile": "baseline"},
    "two-way prediction": {"x264-params": "bframes=2:rc-lookahead=3"},
    "gradual refresh": {"tune": "zerolatency", "x264-params": f"intra-refresh=1:{ONE_SLICE}"},
}


def encoded(n, options, codec="libx264", gop=12):
    """Packets of a sliding pattern, and their numbers in order of presentation."""
    context = av.CodecContext.create(codec, "w")
    context.width, context.height = SIZE
    context.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    context.time_base, context.framerate = Fraction(1, 25), 25
    context.gop_size = gop
    context.options = {"preset": "veryfast", **options} if codec == "libx264" else options
    rng = np.random.default_rng(1)
    board = cv2.resize(rng.integers(0, 256, (40, 60, 3), dtype=np.uint8), None, fx=8, fy=8)
    packets = []
    for i in range(n):
        x, y = 2 * i % 200, i % 100
        image = np.ascontiguousarray(board[y : y + SIZE[1], x : x + SIZE[0]])
        frame = VideoFrame.from_ndarray(image, format="bgr24")
        frame.pts = i
        packets += context.encode(frame)
    packets += context.encode(None)
    return [(bytes(p), p.pts) for p in packets]


def packet(data, pts):
    made = packet_with(data)
    made.pts, made.time_base = pts, Fraction(1, 25)
    return made


def digest(picture):
    return hashlib.md5(picture.to_ndarray().tobytes()).hexdigest()


def exact(packets, codec="h264"):
    decoder = av.CodecContext.create(codec, "r")
    decoder.thread_count = 1
    found = {}
    for data, pts in packets:
        found |= {f.pts: digest(f) for f in decoder.decode(packet(data, pts))}
    found |= {f.pts: digest(f) for f in decoder.decode(None)}
    return found


def delivered(packets, *, reports_losses, lost=(), codec="h264"):
    decoder = LiveDecoder(av.CodecContext.create(codec, "r"), reports_losses=reports_losses)
    found = {}
    for i, (data, pts) in enumerate(packets):
        if i in lost:
            if reports_losses:
                decoder.reset()
            continue
        found |= {f.pts: digest(f) for f in decoder.decode(packet(data, pts))}
    return found


@pytest.mark.parametrize("reports_losses", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_after_a_loss_only_exact_pictures_come(kind, reports_losses):
    packets = encoded(70, KINDS[kind])
    true = exact(packets)
    found = delivered(packets, reports_losses=reports_losses, lost=(17, 30))
    assert all(true[pts] == content for pts, content in found.items())
    assert len(found) >= 25
    assert max(found) >= 65


@pytest.mark.parametrize("kind", KINDS)
def test_without_loss_every_picture_comes_at_once(kind):
    packets = encoded(40, KINDS[kind])
    decoder = LiveDecoder(av.CodecContext.create("h264", "r"), reports_losses=False)
    held = [i + 1 for i in range(40)]
    n = 0
    for i, (data, pts) in enumerate(packets):
        n += len(decoder.decode(packet(data, pts)))
        held[i] -= n
    # Pictures predicted both ways come after those that they need.
    assert max(held) <= (3 if kind == "two-way prediction" else 0)


@pytest.mark.parametrize("lost", range(1, 11))
def test_every_single_missing_picture_is_found_by_the_numbers(lost):
    packets = encoded(12, KINDS["one slice"])
    numbers = FrameNumbers()
    gaps = [numbers.is_gap_before(d) for i, (d, _) in enumerate(packets) if i != lost]
    assert [i for i, gap in enumerate(gaps) if gap] == [lost]


@pytest.mark.parametrize("kind", KINDS)
def test_no_picture_is_missed_where_none_is_missing(kind):
    """Longer than the numbers of pictures, which begin anew."""
    numbers = FrameNumbers()
    packets = encoded(60, KINDS[kind], gop=50)
    assert not any(numbers.is_gap_before(data) for data, _ in packets)


def test_a_damaged_picture_and_its_followers_are_not_delivered():
    packets = encoded(40, KINDS["one slice"])
    true = exact(packets)
    data = bytearray(packets[15][0])
    data[len(data) // 2 : len(data) // 2 + 30] = bytes(range(30, 60))
    packets[15] = bytes(data), packets[15][1]
    found = delivered(packets, reports_losses=True)
    assert all(true[pts] == content for pts, content in found.items())
    assert sorted(found) == [*range(15), *range(24, 40)]


def test_other_codecs_wait_for_a_key_frame_too():
    packets = encoded(40, {"qscale": "3"}, codec="mpeg4", gop=10)
    true = exact(packets, "mpeg4")
    found = delivered(packets[5:], reports_losses=True, lost=(18,), codec="mpeg4")
    assert all(true[pts] == content for pts, content in found.items())
    # Packets are counted from the fifth picture.
    assert sorted(found) == [*range(10, 23), *range(30, 40)]


def test_motion_jpeg_loses_only_what_is_damaged():
    packets = encoded(12, {}, codec="mjpeg")
    true = exact(packets, "mjpeg")
    packets[5] = b"no picture at all" * 9, packets[5][1]
    found = delivered(packets, reports_losses=False, codec="mjpeg")
    assert found == {pts: true[pts] for pts in range(12) if pts != 5}


def frames_of(packets, *, lost=(), announced=()):
    """Frames of a stream whose lost pictures are noticed, some of them by a damaged packet."""
    reception = Reception("test")
    frames = LiveFrames(reception)
    frames.connect(av.CodecContext.create("h264", "r"), 1 / 25, reports_losses=True)
    found = []
    for i, (data, pts) in enumerate(packets):
        if i in announced:
            frames.announce(packet(b"\x00", pts))
        if i in announced or i in lost:
            frames.lose()
            continue
        found += frames.feed(packet(data, pts))
    return found, reception.health().n_dropped


@pytest.mark.parametrize(
    ("lost", "announced"), [((17,), ()), ((), (17,)), ((17, 18, 20), (19, 21)), (range(14, 24), ())]
)
def test_lost_pictures_leave_a_gap_as_wide_as_they_are_many(lost, announced):
    packets = encoded(40, KINDS["one slice"])
    found, n_dropped = frames_of(packets, lost=lost, announced=announced)
    first = min([*lost, *announced])
    assert [f.index for f in found] == [*range(first), *range(24, 40)]
    assert [f.time_s for f in found] == pytest.approx([f.index / 25 for f in found])
    assert n_dropped == 24 - first


def test_what_was_sent_before_the_first_key_frame_is_not_lost():
    packets = encoded(30, KINDS["one slice"])[5:]
    found, n_dropped = frames_of(packets)
    assert [f.index for f in found] == list(range(18))
    assert (found[0].time_s, n_dropped) == (0.0, 0)


def test_a_stream_joined_before_a_key_frame_is_neither_damaged_nor_running(monkeypatch):
    """A live run listens for some seconds before it reads."""
    reception, now = Reception("test"), time.monotonic()
    for later, waited in ((30.0, "0.0"), (32.4, "2.4")):
        monkeypatch.setattr(time, "monotonic", lambda later=later: now + later)
        reception.note_arrival("RTP H.264")
        reception.note_held(1)
        health = reception.health()
        assert health.state is State.FAULT
        waits = f"waiting for a whole key frame with SPS and PPS for {waited} s"
        assert health.detail == f"RTP H.264: {waits}"
    for i in range(27):
        monkeypatch.setattr(time, "monotonic", lambda i=i: now + 33.0 + 0.04 * i)
        reception.note_arrival()
        reception.note_frame((720, 576), 0)
        if i == 3:
            assert reception.health().detail == "RTP H.264 720x576 px"
    assert reception.health().detail == "RTP H.264 720x576 px, 25.0 frames/s"


def test_numbers_rise_over_a_new_connection():
    packets = encoded(24, KINDS["one slice"])
    frames = LiveFrames(Reception("test"))
    found = []
    for _ in range(3):
        frames.connect(av.CodecContext.create("h264", "r"), 1 / 25, reports_losses=False)
        for data, pts in packets:
            found += frames.feed(packet(data, pts))
    assert [f.index for f in found] == list(range(72))
    assert all(b.time_s >= a.time_s for a, b in pairwise(found))


def test_a_sender_that_was_off_has_lost_nothing(monkeypatch):
    """It begins with another number and another time, as a camera does that was switched on."""
    packets, now = encoded(24, KINDS["one slice"]), [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    reception = Reception("test")
    frames = LiveFrames(reception)
    frames.connect(av.CodecContext.create("h264", "r"), 1 / 25, reports_losses=True)
    found = []
    for pause_s in (0.0, 8.0):
        now[0] += pause_s
        for data, pts in packets:
            now[0] += 0.04
            found += frames.feed(packet(data, pts))
        frames.restart()
    assert [f.index for f in found] == list(range(48))
    assert found[24].time_s - found[23].time_s == pytest.approx(8.04)
    assert reception.health().n_dropped == 0
