"""MPEG-TS as FFmpeg's muxer writes it: pictures come whole, at once, or not at all."""

import random
from itertools import groupby

import av
import numpy as np
import pytest
from av.video.frame import VideoFrame
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from aqualvs.sources.datagrams import BARE, RTP, TS, kind_of
from aqualvs.sources.rtp import PACKET_BYTES, TransportStream
from shell_cases import grain

N_PICTURES = 24


def write_stream(path, *, codec="libx264", sound=False, mux=None):
    """Returns the stream's bytes and the coded pictures, as FFmpeg reads them back."""
    with av.open(str(path), "w", format="mpegts", options=mux or {}) as container:
        stream = container.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = 192, 128, "yuv420p"
        if codec == "libx264":
            stream.options = {"preset": "ultrafast", "tune": "zerolatency", "g": "8"}
        voice = container.add_stream("mp2", rate=48000) if sound else None
        for i in range(N_PICTURES):
            frame = VideoFrame.from_ndarray(grain(i, (192, 128)), format="bgr24")
            container.mux(stream.encode(frame))
            if voice is not None:
                made = av.AudioFrame.from_ndarray(np.zeros((1, 1152), np.int16), "s16", "mono")
                made.sample_rate, made.pts = 48000, 1152 * i
                container.mux(voice.encode(made))
        container.mux(stream.encode(None))
    with av.open(str(path)) as container:
        pictures = [bytes(p) for p in container.demux(video=0) if p.size]
    return path.read_bytes(), pictures


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return write_stream(tmp_path_factory.mktemp("ts") / "a.ts")


def packets_of(content):
    return [content[at : at + PACKET_BYTES] for at in range(0, len(content), PACKET_BYTES)]


@pytest.mark.parametrize(
    ("codec", "name", "sound"),
    [("libx264", "h264", False), ("libx264", "h264", True), ("mpeg2video", "mpeg2video", False)],
)
def test_every_picture_comes_with_its_last_packet(tmp_path, codec, name, sound):
    content, pictures = write_stream(tmp_path / "a.ts", codec=codec, sound=sound)
    stream = TransportStream()
    found, n_at_once = [], 0
    for packet in packets_of(content):
        done = stream.push(packet)
        found += done
        n_at_once += len(done) if not packet[1] & 0x40 else 0
    assert stream.codec == name
    # All but a picture that happens to fill its last packet, and so is ended by the next one.
    assert n_at_once >= len(pictures) - 2
    assert [u.data for u in found] == pictures[: len(found)]
    assert len(found) >= len(pictures) - 1
    assert all(u.is_whole and not u.after_loss for u in found)
    assert [u.ticks - found[0].ticks for u in found] == [3600 * i for i in range(len(found))]
    assert [u.is_restart for u in found] == [True] + [False] * (len(found) - 1)


def stream_of(packet):
    """Number of the stream that a packet belongs to."""
    return int.from_bytes(packet[1:3], "big") & 0x1FFF


@given(st.sets(st.integers(0, 400), max_size=12), st.integers(1, 7))
@settings(max_examples=60, deadline=None)
def test_a_picture_comes_whole_or_not_at_all(plain, lost, n_each):
    """Datagrams of several packets are lost; the next picture tells of it."""
    content, pictures = plain
    packets = packets_of(content)
    # The last packet is a picture's. Counters of four bits cannot tell of 16 lost ones.
    streams = [stream_of(packet) for packet in packets]
    gone = [i // n_each in lost for i, stream in enumerate(streams) if stream == streams[-1]]
    assume(not any(is_gone and len(list(run)) % 16 == 0 for is_gone, run in groupby(gone)))
    groups = [packets[at : at + n_each] for at in range(0, len(packets), n_each)]
    stream, found = TransportStream(), []
    for k, group in enumerate(groups):
        if k not in lost:
            found += stream.push(b"".join(group))
    whole = [u for u in found if u.is_whole]
    order = [pictures.index(u.data) for u in whole]
    assert order == sorted(set(order))
    last = -1
    for unit in found:
        if unit.is_whole:
            i = pictures.index(unit.data)
            assert unit.after_loss or i == last + 1 or last < 0
            last = i
        else:
            last = -1


def test_a_packet_that_comes_twice_does_no_harm(plain):
    content, pictures = plain
    twice = b"".join(packet + packet for packet in packets_of(content))
    found = TransportStream().push(twice)
    assert [u.data for u in found] == pictures[: len(found)]
    assert len(found) >= len(pictures) - 1


def test_joined_in_the_middle_it_waits_for_tables_and_a_picture_s_beginning(plain):
    content, pictures = plain
    packets = packets_of(content)
    found = TransportStream().push(b"".join(packets[len(packets) // 3 :]))
    assert found
    assert all(u.data in pictures for u in found)


def test_a_muxer_that_fills_up_packets_in_the_middle_costs_one_picture(plain):
    """Each filled packet is cut in two filled ones, so that filling tells nothing."""
    content, pictures = plain
    count, spoilt = {}, []
    for packet in packets_of(content):
        pid = (packet[1] & 0x1F) << 8 | packet[2]
        pieces = [packet]
        if pid == 0x100 and packet[3] >> 4 & 3 == 1:
            pieces = [filled(packet, packet[4:100], first=True), filled(packet, packet[100:])]
        for piece in pieces:
            count[pid] = (count.get(pid, -1) + 1) % 16
            spoilt.append(piece[:3] + bytes([piece[3] & 0xF0 | count[pid]]) + piece[4:])
    found = TransportStream().push(b"".join(spoilt))
    whole = [u.data for u in found if u.is_whole]
    assert all(data in pictures for data in whole[2:])
    assert len(whole) >= N_PICTURES - 3


def filled(packet, payload, *, first=False):
    """A packet with the same head and less content."""
    n = PACKET_BYTES - 4 - len(payload)
    flags = packet[1] if first else packet[1] & ~0x40
    field = bytes([n - 1, 0]) + bytes([0xFF]) * (n - 2)
    return bytes([packet[0], flags, packet[2], packet[3] | 0x30]) + field + payload


def test_a_sender_that_begins_anew_is_told(plain, tmp_path):
    content, pictures = plain
    other, _ = write_stream(tmp_path / "b.ts", mux={"output_ts_offset": "4000"})
    stream = TransportStream()
    first = stream.push(content)
    second = stream.push(other)
    assert len(first) + len(second) >= 2 * len(pictures) - 2
    restarts = [u.is_restart for u in second]
    assert restarts.count(True) == 1
    assert restarts[:2].count(True) == 1


@given(st.binary(max_size=600))
@settings(max_examples=200)
def test_no_content_whatever_breaks_it(content):
    stream = TransportStream()
    stream.push(content)
    stream.push(b"\x47\x40\x00\x10" + content.ljust(184, b"\xff")[:184])


def test_damaged_bytes_anywhere_do_not_break_it(plain):
    content, _ = plain
    rng = random.Random(5)
    for _ in range(40):
        spoilt = bytearray(content)
        for _ in range(30):
            spoilt[rng.randrange(len(spoilt))] ^= 1 << rng.randrange(8)
        TransportStream().push(bytes(spoilt))


def test_kinds_of_datagrams(plain):
    content, pictures = plain
    assert kind_of(content[: 7 * PACKET_BYTES]) == TS
    in_rtp = bytes([0x80, 33]) + bytes(10) + content[: 7 * PACKET_BYTES]
    assert kind_of(in_rtp) == TS
    assert kind_of(pictures[0][:1400]) == BARE
    assert kind_of(bytes([0x80, 96]) + bytes(10) + b"\x65rest") == RTP
    for other in (b"", b"hello", content[:190], bytes([0x80, 26]) + bytes(40)):
        assert kind_of(other) is None
