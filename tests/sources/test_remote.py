"""Streams from a process of its own, on loopback: all that arrives whole, and nothing else."""

import hashlib
import os
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

import stream_sender
from aqualvs.sources import datagrams, live_frames, open_feed, remote
from aqualvs.sources.base import State
from aqualvs.sources.remote import RemoteFeed
from ports import free_port
from stream_sender import send_here as send
from waiting import TIMEOUT_S, until

SD, HD = (720, 576), (1920, 1080)
SENDER = Path(stream_sender.__file__)

# An end that waits for nothing takes a fifth of a second; this is what a busy machine may add.
END_S = 5.0


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """A machine that is busy is no silence, and what it does not keep up with is kept."""
    monkeypatch.setattr(live_frames, "_SILENT_S", TIMEOUT_S)
    monkeypatch.setattr(datagrams, "_MAX_LAG_S", TIMEOUT_S)


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    """Clips by name: both sizes, and long ones of small packets and frequent key frames.

    Of these, one has a slice for each packet, and one refreshes its pictures column by column.
    """
    folder = tmp_path_factory.mktemp("clips")
    stripes = {"gop": 12, "bitrate": 800_000, "content": stream_sender.moving_stripes}
    kinds = {"slices": "slice-max-size=1000", "refresh": "slice-max-size=1000:intra-refresh=1"}
    return {
        "sd": stream_sender.make_clip(folder / "sd", SD, 50),
        "hd": stream_sender.make_clip(folder / "hd", HD, 30, bitrate=8_000_000),
        "stripes": stream_sender.make_clip(folder / "stripes", SD, 150, **stripes),
    } | {
        name: stream_sender.make_clip(folder / name, SD, 150, **stripes, **{"x264-params": how})
        for name, how in kinds.items()
    }


def digest(luma):
    return hashlib.md5(luma.tobytes()).hexdigest()


def pictures_of(*paths):
    """Return the numbers of a clip's pictures by their content, as decoded without loss."""
    found = {}
    for path in paths:
        decoder = av.CodecContext.create("h264", "r")
        decoder.thread_count = 1
        for i, data in enumerate(stream_sender.read_clip(path)[1]):
            (picture,) = decoder.decode(av.Packet(data))
            plane = picture.planes[0]
            rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
            found[digest(rows[: picture.height, : picture.width])] = i
    return found


class Listener:
    """Takes the frames of a feed in a thread of its own, as the live run does."""

    def __init__(self, feed):
        self.feed = feed
        self.indices, self.times, self.contents = [], [], []
        self.sizes, self.arrivals, self.states = [], [], []
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        for frame in self.feed:
            self.arrivals.append(time.monotonic())
            self.times.append(frame.time_s)
            self.sizes.append(frame.luma.shape[::-1])
            self.contents.append(digest(frame.luma))
            self.states.append(self.feed.health().state)
            # The last of all: who waits for a frame finds the rest.
            self.indices.append(frame.index)

    def wait(self, condition):
        end = time.monotonic() + TIMEOUT_S
        while not condition():
            assert time.monotonic() < end, self.feed.health()
            time.sleep(0.005)

    def close(self):
        """Close the feed and return how long that took."""
        began = time.monotonic()
        self.feed.close()
        self._thread.join(TIMEOUT_S)
        assert not self._thread.is_alive()
        return time.monotonic() - began


@contextmanager
def listening(feed):
    listener = Listener(feed)
    try:
        yield listener
    finally:
        assert listener.close() < END_S
    assert all(b > a for a, b in pairwise(listener.indices))
    assert all(b >= a for a, b in pairwise(listener.times))
    assert feed.health().state is State.OFF


@contextmanager
def udp_listener():
    """Listen on a free port."""
    feed: Any = open_feed("udp://127.0.0.1:0")
    with listening(feed) as listener:
        listener.wait(lambda: feed.port)
        yield listener


def sender(*clips, port, **options):
    """Start the sender in a process of its own, which waits where it is told to."""
    command = [sys.executable, str(SENDER), *stream_sender.words_of(clips, port, options)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def go_on(process):
    """Let a sender that holds go on; returns when."""
    at = time.monotonic()
    process.stdin.write("\n")
    process.stdin.flush()
    return at


@pytest.mark.parametrize(("name", "size", "n"), [("sd", SD, 50), ("hd", HD, 30)])
def test_rtp_at_25_frames_a_second_arrives_whole(clips, name, size, n):
    """Also where the 32 bits of its time run out, one second in.

    No picture waits for the next one: the last one, after which nothing comes, arrives as well.
    """
    with udp_listener() as heard:
        told = send(clips[name], port=heard.feed.port, first_time=2**32 - 90_000)
        heard.wait(lambda: len(heard.indices) == n)
    assert set(heard.states) == {State.OK}
    assert told["frames"] == n
    assert heard.indices == list(range(n))
    assert heard.times == pytest.approx([i / 25 for i in range(n)], abs=1e-4)
    assert set(heard.sizes) == {size}
    known = pictures_of(clips[name])
    assert [known[content] for content in heard.contents] == list(range(n))


@pytest.mark.parametrize(("kind", "n_held"), [("mpegts", 0), ("bare", 1)])
def test_other_kinds_over_udp_are_recognised(clips, kind, n_held):
    """The last picture of a bare stream waits for the next one that never comes."""
    with udp_listener() as heard:
        send(clips["sd"], port=heard.feed.port, kind=kind, speed=4)
        heard.wait(lambda: len(heard.indices) == 50 - n_held)
    known = pictures_of(clips["sd"])
    assert [known[content] for content in heard.contents] == list(range(50 - n_held))
    if kind == "mpegts":
        assert heard.times == pytest.approx([i / 25 for i in range(50)], abs=1e-3)


# The last key frame of the stripes; nothing is lost from it on, so that the end arrives.
SOUND_FROM = 144


@pytest.mark.parametrize(
    ("clip", "kind", "sound_from"),
    [
        ("stripes", "rtp", SOUND_FROM),
        ("stripes", "mpegts", SOUND_FROM),
        ("slices", "rtp", SOUND_FROM),
        # A refresh begins every twelve frames, and takes as long.
        ("refresh", "rtp", 120),
    ],
)
def test_five_percent_of_loss_costs_frames_but_shows_no_false_one(clips, clip, kind, sound_from):
    """Every frame is exact, and its number counts those that were lost."""
    with udp_listener() as heard:
        known = pictures_of(clips[clip])
        options = {"loss": 0.05, "seed": 3, "sound_from": sound_from, "speed": 8}
        told = send(clips[clip], port=heard.feed.port, kind=kind, **options)
        # A picture of MPEG-TS may wait for the next one after a loss, so the last may be missing.
        heard.wait(lambda: heard.indices and known[heard.contents[-1]] >= 148)
        health = heard.feed.health()
    assert told["lost"] > 0.03 * told["packets"]
    true = [known[content] for content in heard.contents]
    assert 6 <= len(true) < 150
    # What came before the first frame was joined too late, not lost.
    assert (health.n_dropped > 0) == (len(true) <= true[-1] - true[0])
    if kind == "rtp":
        first = true[0]
        assert heard.indices == [i - first for i in true]
        assert heard.times == pytest.approx([(i - first) / 25 for i in true], abs=1e-4)


def test_damaged_packets_cost_frames_and_the_rest_is_exact(clips):
    with udp_listener() as heard:
        known = pictures_of(clips["stripes"])
        options = {"damage": 0.02, "seed": 2, "sound_from": SOUND_FROM, "speed": 8}
        told = send(clips["stripes"], port=heard.feed.port, **options)
        heard.wait(lambda: heard.indices and known[heard.contents[-1]] == 149)
    assert told["damaged"] >= 5
    true = [known[content] for content in heard.contents]
    assert 40 < len(true) < 150


def test_a_stream_that_stops_is_a_fault_and_goes_on_when_it_returns(clips, monkeypatch):
    """First the same sender pauses; then another one comes, with pictures of another size."""
    with udp_listener() as heard:
        port = heard.feed.port
        with sender(clips["sd"], port=port, hold=30, speed=2, first_time=1000) as first:
            heard.wait(lambda: len(heard.indices) >= 30)
            with monkeypatch.context() as usual:
                usual.setattr(live_frames, "_SILENT_S", 0.1)
                heard.wait(lambda: heard.feed.health().state is State.FAULT)
                assert "silent" in heard.feed.health().detail
            assert len(heard.indices) == 30
            last_sent = go_on(first)
            heard.wait(lambda: len(heard.indices) == 50)
        told = send(clips["hd"], port=port, ssrc=77, first_time=2**31)
        heard.wait(lambda: len(heard.indices) == 80)
    assert set(heard.states) == {State.OK}
    assert heard.indices == list(range(80))
    assert heard.sizes == 50 * [SD] + 30 * [HD]
    # The second sender's time begins anywhere; ours goes on by the clock, from the arrival of one
    # picture to that of the next. Each arrived after it was sent and before it was heard of.
    gap = heard.times[50] - heard.times[49]
    assert told["began"] - heard.arrivals[49] <= gap <= heard.arrivals[50] - last_sent
    assert gap > 0.0
    assert heard.times[79] - heard.times[50] == pytest.approx(29 / 25, abs=1e-4)


def test_what_came_while_the_process_stood_still_is_late(monkeypatch):
    """Pictures of then would be measured one after the other as if they were new."""
    lag_s, goes_on = 1.0, threading.Event()

    class Standing(socket.socket):
        def recv(self, *arguments):
            goes_on.wait(TIMEOUT_S)
            return super().recv(*arguments)

    monkeypatch.setattr(datagrams, "_MAX_LAG_S", lag_s)
    monkeypatch.setattr(socket, "socket", Standing)
    address, reception = datagrams.UdpAddress("127.0.0.1", 0), live_frames.Reception("test")
    heard = datagrams.Datagrams(address, threading.Event(), reception)
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as outlet:
            outlet.connect(("127.0.0.1", heard.port))
            for content in (b"1", b"2", b"3"):
                outlet.send(content)
            time.sleep(1.2 * lag_s)
            goes_on.set()
            late = heard.get(TIMEOUT_S)
            outlet.send(b"4")
            fresh = heard.get(TIMEOUT_S)
        assert late
        assert fresh
        assert (late.content, heard.is_late(late)) == (b"3", True)
        assert fresh.content == b"4"
        assert fresh.arrival - late.arrival > lag_s
    finally:
        heard.close()


def test_rtsp_connects_again_when_the_server_returns(clips):
    """The first pictures come while the server holds the others back: probing is short."""
    port = free_port()
    with listening(open_feed(f"rtsp://127.0.0.1:{port}/camera")) as heard:
        heard.wait(lambda: "Connection refused" in heard.feed.health().detail)
        for n in (50, 100):
            with sender(clips["sd"], port=port, rtsp=True, speed=4, hold=25) as server:
                heard.wait(lambda n=n: len(heard.indices) >= n - 49)
                go_on(server)
                heard.wait(lambda n=n: len(heard.indices) == n)
    assert heard.indices == list(range(100))
    known = pictures_of(clips["sd"])
    assert [known[content] for content in heard.contents] == 2 * list(range(50))


def test_without_a_sender_it_waits_and_says_so(clips):
    with udp_listener() as heard:
        time.sleep(0.3)
        health = heard.feed.health()
        assert (health.state, heard.indices) == (State.FAULT, [])
        assert "waiting for the stream" in health.detail


def test_a_server_that_is_mute_does_not_delay_the_end(monkeypatch):
    monkeypatch.setattr(remote, "_OPEN_S", 4 * END_S)
    with (
        socket.create_server(("127.0.0.1", 0)) as mute,
        listening(open_feed(f"rtsp://127.0.0.1:{mute.getsockname()[1]}/camera")) as heard,
    ):
        time.sleep(0.3)
        assert heard.feed.health().state is State.FAULT


def test_a_taken_port_is_said_and_used_once_it_is_free(clips):
    other = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        with listening(open_feed(f"udp://127.0.0.1:{port}")) as heard:
            heard.wait(lambda: "taken by another program" in heard.feed.health().detail)
            other.close()
            heard.wait(lambda: "waiting" in heard.feed.health().detail or heard.indices)
            send(clips["sd"], port=port, speed=10)
            heard.wait(lambda: heard.indices)


def test_something_else_on_the_port_is_said():
    with udp_listener() as heard, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stray:
        stray.sendto(b"hello, is this the echo sounder?", ("127.0.0.1", heard.feed.port))
        heard.wait(lambda: "neither RTP" in heard.feed.health().detail)


def n_handles():
    return len(os.listdir("/proc/self/fd"))


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs Linux's list of handles")
def test_many_reconnections_leave_no_handle_open(tmp_path):
    """A server that breaks off after every second."""
    path = tmp_path / "short.ts"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        for i in range(5):
            image = np.full((64, 96, 3), 40 * i, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode(None))

    def opener():
        return av.open(str(path), "r", timeout=(5.0, 2.0))

    before, threads = n_handles(), threading.active_count()
    with listening(RemoteFeed("breaking", opener)) as heard:
        heard.wait(lambda: len(heard.indices) >= 40)
    for _ in range(10):
        with udp_listener():
            pass
    until(lambda: (n_handles(), threading.active_count()) <= (before, threads), "an end of all")
