"""Videos: what arrives is what was encoded, and what is missing is said."""

import contextlib
import functools
import gc
import http.server
import itertools
import os
import threading
from fractions import Fraction

import av
import numpy as np
import pytest
from av.video.frame import VideoFrame

from aqualvs.errors import OptionError, SourceError
from aqualvs.sources import VideoSource, open_source
from aqualvs.sources.base import planes_of
from aqualvs.sources.spans import video_spans
from shell_cases import (
    all_key_frames,
    cut_after,
    damage_frame,
    destroy_frame,
    grain,
    luma_level,
    packets,
    picture,
    write_video,
)

SMALL = (96, 64)

# Less than half of the step between two pictures; lossy encoders miss a flat level by up to 3.
LEVEL_TOLERANCE = 4.0


def luma_levels(source):
    with source:
        return {f.index: float(f.luma.mean()) for f in source}


@pytest.mark.parametrize(
    ("name", "codec", "pix_fmt", "options"),
    [
        ("a.mp4", "libx264", "yuv420p", {"bf": "2"}),
        ("a.mkv", "libx264", "yuv420p", {"bf": "2"}),
        ("a.ts", "libx264", "yuv420p", {"bf": "2"}),
        ("h264.avi", "libx264", "yuv420p", {"bf": "3", "b-pyramid": "normal"}),
        ("a.avi", "mpeg4", "yuv420p", {"bf": "2", "qscale": "2"}),
        ("a.webm", "libvpx", "yuv420p", {"b:v": "1M", "cpu-used": "8", "auto-alt-ref": "1"}),
        ("a.nut", "rawvideo", "nv12", {}),
        ("a10.mkv", "ffv1", "yuv420p10le", {}),
        ("a422.mkv", "ffv1", "yuv422p", {}),
        ("rgb.mkv", "ffv1", "bgr0", {}),
    ],
)
def test_every_frame_arrives_in_order_with_its_time(tmp_path, name, codec, pix_fmt, options):
    path = tmp_path / name
    write_video(path, 12, size=SMALL, codec=codec, pix_fmt=pix_fmt, options=options)
    with open_source(path) as source:
        assert source.size_px == SMALL
        assert source.fps == pytest.approx(25.0)
        frames = list(source)
    assert [f.index for f in frames] == list(range(12))
    # Matroska rounds times to a millisecond.
    assert [f.time_s for f in frames] == pytest.approx([i / 25 for i in range(12)], abs=1e-3)
    for i, frame in enumerate(frames):
        assert frame.luma.shape == (64, 96)
        assert frame.luma.mean() == pytest.approx(luma_level(i), abs=LEVEL_TOLERANCE)
        assert [c.shape for c in frame.chroma] == [(32, 48), (32, 48)]
        assert np.abs(np.stack(frame.chroma).astype(int) - 128).max() <= 2


def test_grey_video_has_no_chroma(tmp_path):
    path = write_video(tmp_path / "g.mkv", 3, size=SMALL, codec="ffv1", pix_fmt="gray", options={})
    with open_source(path) as source:
        frames = list(source)
    assert len(frames) == 3
    assert all(f.chroma is None and f.luma.shape == (64, 96) for f in frames)


@pytest.mark.parametrize("kind", ["yuv420p", "yuvj420p", "nv12"])
@pytest.mark.parametrize("size", [(96, 64), (97, 65)])
def test_planes_are_views_on_the_decoder_s_memory(kind, size):
    width, height = size
    frame = VideoFrame(width, height, kind)
    rng = np.random.default_rng(3)
    content = []
    for plane in frame.planes:
        content.append(rng.integers(0, 256, plane.buffer_size, dtype=np.uint8))
        plane.update(content[-1].tobytes())
    luma, chroma = planes_of(frame)
    addresses = [plane.buffer_ptr for plane in frame.planes]
    assert luma.ctypes.data == addresses[0]
    assert chroma[0].ctypes.data == addresses[1]
    # The semi-planar V starts one byte after U.
    assert chroma[1].ctypes.data == (addresses[1] + 1 if kind == "nv12" else addresses[2])
    width, height = size
    rows = content[0].reshape(-1, frame.planes[0].line_size)
    np.testing.assert_array_equal(luma, rows[:height, :width])
    assert chroma[0].shape == chroma[1].shape == (-(-height // 2), -(-width // 2))
    uv = content[1].reshape(-1, frame.planes[1].line_size)
    step = 2 if kind == "nv12" else 1
    last = chroma[0].shape[1] - 1
    assert chroma[0][3, last] == uv[3, last * step]
    assert not luma.flags.writeable


@pytest.mark.parametrize("kind", ["yuvj422p", "yuv422p", "yuvj444p", "yuv444p", "nv21"])
def test_conversion_of_other_formats_keeps_luma(kind):
    frame = VideoFrame(96, 64, kind)
    rng = np.random.default_rng(4)
    for plane in frame.planes:
        plane.update(rng.integers(0, 256, plane.buffer_size, dtype=np.uint8).tobytes())
    luma, _ = planes_of(frame)
    given = np.frombuffer(frame.planes[0], np.uint8).reshape(64, -1)[:, :96]
    np.testing.assert_array_equal(luma, given)


def test_frames_outlive_the_source_and_later_frames(tmp_path):
    path = write_video(tmp_path / "a.mp4", 12, size=SMALL)
    with open_source(path) as source:
        kept = list(source)
    expected = [luma_level(i) for i in range(12)]
    del source
    gc.collect()
    assert [f.luma.mean() for f in kept] == pytest.approx(expected, abs=LEVEL_TOLERANCE)


def test_a_corrupt_frame_leaves_a_gap_and_the_rest_arrives(tmp_path):
    path = all_key_frames(tmp_path / "a.mp4", 10, size=SMALL)
    destroy_frame(path, 4)
    found = luma_levels(open_source(path))
    assert sorted(found) == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    for i, mean in found.items():
        assert mean == pytest.approx(luma_level(i), abs=LEVEL_TOLERANCE)


@pytest.mark.parametrize("lost", [20, 23])
def test_a_lost_picture_shifts_no_time_where_avi_has_those_of_decoding(tmp_path, lost):
    """Without a key frame, FFmpeg drops pictures unnoticed until the next one, the thirtieth."""
    options = {"preset": "veryfast", "bf": "2", "g": "10", "sc_threshold": "0"}
    path = write_video(tmp_path / "a.avi", 40, size=SMALL, options=options)
    destroy_frame(path, lost)
    with open_source(path) as source:
        frames = list(source)
    indices = [frame.index for frame in frames]
    assert indices == sorted(set(indices))
    assert 1 <= 40 - len(frames) <= 13
    for frame in frames:
        assert frame.time_s == pytest.approx(frame.index / 25)
        assert frame.luma.mean() == pytest.approx(luma_level(frame.index), abs=LEVEL_TOLERANCE)


@pytest.mark.parametrize(
    ("options", "damaged"),
    [
        ({"bf": "0"}, 14),
        ({"bf": "3", "b-pyramid": "normal"}, 13),
        ({"bf": "3", "b-pyramid": "normal"}, 17),
        ({"bf": "3", "x264-params": "open-gop=1"}, 13),
        ({"bf": "0", "x264-params": "intra-refresh=1"}, 14),
    ],
)
def test_after_damage_only_pictures_as_they_were_recorded_are_delivered(tmp_path, options, damaged):
    path = write_video(
        tmp_path / "a.mp4",
        50,
        size=(192, 128),
        options={"preset": "veryfast", "g": "12", **options},
        content=lambda i, size: np.roll(grain(0, size), i, axis=1),
    )
    with open_source(path) as source:
        recorded = {frame.index: frame.luma.copy() for frame in source}
    damage_frame(path, damaged)
    with open_source(path) as source:
        frames = list(source)
    assert 0 < len(recorded) - len(frames) <= 26
    assert frames[-1].index == 49
    for frame in frames:
        np.testing.assert_array_equal(frame.luma, recorded[frame.index])


@pytest.mark.parametrize("seed", range(4, 8))
@pytest.mark.parametrize("codec", ["libx264", "libx265"])
def test_of_a_recorded_stream_with_losses_only_sound_pictures_are_delivered(tmp_path, codec, seed):
    """FFmpeg marks the packets that lack a part, and of their pictures those of H.264 only."""
    path = write_video(
        tmp_path / "a.ts",
        50,
        size=(192, 128),
        codec=codec,
        options={"preset": "veryfast", "g": "10", "x265-params": "log-level=none"},
        content=lambda i, size: np.roll(grain(0, size), i, axis=1),
    )
    with open_source(path) as source:
        recorded = {round(frame.time_s, 3): frame.luma.copy() for frame in source}
    datagrams = np.frombuffer(path.read_bytes(), np.uint8).reshape(-1, 188)
    of_video = np.flatnonzero((datagrams[:, 1] & 0x1F == 1) & (datagrams[:, 2] == 0))
    # Nobody marks a first picture that lacks a part.
    later = of_video[len(of_video) // 4 :]
    lost = np.random.default_rng(seed).choice(later, 3, replace=False)
    path.write_bytes(np.delete(datagrams, lost, axis=0).tobytes())
    frames = []
    with open_source(path) as source, contextlib.suppress(SourceError):
        frames += source
    assert 0 < len(frames) < 50
    for frame in frames:
        np.testing.assert_array_equal(frame.luma, recorded[round(frame.time_s, 3)])


def test_time_counts_from_the_first_frame_even_if_that_is_lost(tmp_path):
    path = all_key_frames(tmp_path / "a.mp4", 6, size=SMALL)
    destroy_frame(path, 0)
    with open_source(path) as source:
        first = next(iter(source))
    assert first.index == 1
    assert first.time_s == pytest.approx(0.04)


def test_a_lost_last_frame_is_said(tmp_path):
    path = all_key_frames(tmp_path / "a.mp4", 6, size=SMALL)
    destroy_frame(path, 5)
    delivered = []
    with open_source(path) as source, pytest.raises(SourceError, match="only 5 of 6 frames"):
        delivered.extend(source)
    assert [f.index for f in delivered] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    ("name", "mux", "promise"),
    [
        ("a.mp4", {"movflags": "faststart"}, "of 40"),
        ("a.mp4", {"movflags": "frag_keyframe+empty_moov"}, "of about 2"),
        ("a.mkv", {}, "of about 40"),
    ],
)
def test_a_truncated_file_gives_what_it_has_then_says_what_is_missing(tmp_path, name, mux, promise):
    # Key frames at 0, 5, ... and no frame that refers to a later one: packet 23 is picture 23.
    options = {"preset": "veryfast", "g": "5", "bf": "0"}
    path = write_video(
        tmp_path / name, 40, size=(192, 128), options=options, mux=mux, content=grain
    )
    cut_after(path, 23)
    delivered = []
    with open_source(path) as source, pytest.raises(SourceError) as fault:
        delivered.extend(source)
    assert [f.index for f in delivered] == list(range(23))
    assert f"only 23 {promise}" in str(fault.value)
    assert "\n" not in str(fault.value)


def test_the_torn_end_of_a_file_costs_no_sound_picture(tmp_path):
    """The decoder still holds pictures when it meets the torn packet."""
    options = {"preset": "veryfast", "bf": "2"}
    mux = {"movflags": "faststart"}
    path = write_video(
        tmp_path / "a.mp4", 20, size=(192, 128), options=options, mux=mux, content=grain
    )
    cut_after(path, 9)
    delivered = []
    with open_source(path) as source, pytest.raises(SourceError, match="only 9 of 20 frames"):
        delivered.extend(source)
    assert len(delivered) == 9


def test_a_whole_file_raises_nothing_even_if_its_rate_varies(tmp_path):
    path = tmp_path / "vfr.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height = SMALL
        stream.pix_fmt = "yuv420p"
        ticks = [0, 1, 2, 10, 11, 30, 31, 32]
        for i, tick in enumerate(ticks):
            frame = VideoFrame.from_ndarray(picture(i, SMALL), format="bgr24")
            frame.pts = tick
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    with open_source(path) as source:
        frames = list(source)
    assert [f.index for f in frames] == list(range(8))
    assert [f.time_s for f in frames] == pytest.approx([t / 25 for t in ticks], abs=1e-3)


def write_slots(path, ticks, tick, codec="mjpeg"):
    """A video whose pictures are at `ticks` of a clock of `tick` seconds."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.width, stream.height = SMALL
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.codec_context.time_base = tick
        for i, at in enumerate(ticks):
            frame = VideoFrame.from_ndarray(picture(i, SMALL), format="bgr24")
            frame.pts, frame.time_base = at, tick
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


@pytest.mark.parametrize(
    ("codec", "tick", "ticks"),
    [
        ("mjpeg", Fraction(1, 25), [i for i in range(20) if i not in (5, 11, 12)]),
        ("mpeg4", Fraction(1, 25), [i for i in range(20) if i not in (5, 11, 12)]),
        ("mjpeg", Fraction(1, 1000), range(0, 800, 40)),
        ("mjpeg", Fraction(1, 25), [0]),
    ],
)
def test_avi_counts_ticks_of_its_clock_not_pictures(tmp_path, codec, tick, ticks):
    path = write_slots(tmp_path / "a.avi", ticks, tick, codec)
    with open_source(path) as source:
        frames = list(source)
    assert source.fps == pytest.approx(25.0)
    assert source.n_frames == (1 if len(ticks) == 1 else 20)
    assert [f.index for f in frames] == list(range(len(ticks)))
    assert [f.time_s for f in frames] == pytest.approx([at * float(tick) for at in ticks])
    spans = video_spans(path, 5)
    assert spans.why_whole == ("videos in mpeg4 stay whole" if codec == "mpeg4" else "")


@pytest.mark.parametrize("tick", [1, 40])
@pytest.mark.parametrize("n_left", [1, 2, 23, 38, 39])
def test_avi_that_is_cut_short_is_told(tmp_path, n_left, tick):
    path = write_slots(tmp_path / "a.avi", range(0, 1600 // tick, 40 // tick), Fraction(tick, 1000))
    position, _ = packets(path)[n_left]
    path.write_bytes(path.read_bytes()[: position - 8])
    delivered = []
    with open_source(path) as source, pytest.raises(SourceError) as fault:
        delivered.extend(source)
    assert len(delivered) == n_left
    # Few pictures of a fast clock do not tell their rate.
    assert f"only {n_left} of about {40 if n_left > 2 else ''}" in str(fault.value)
    assert video_spans(path, 5).why_whole != ""


def test_a_rate_that_is_only_the_clock_s_is_not_believed(tmp_path):
    """Raw DV, whose average rate FFmpeg states as 60000 Hz."""
    path = write_video(
        tmp_path / "a.dv", 20, size=(720, 576), codec="dvvideo", options={}, content=grain
    )
    with open_source(path) as source:
        assert (source.fps, source.n_frames) == (25.0, 20)
        assert len(list(source)) == 20


def test_a_change_of_picture_size_is_refused(tmp_path):
    whole = tmp_path / "two.ts"
    parts = [
        write_video(tmp_path / "a.ts", 4, size=SMALL),
        write_video(tmp_path / "b.ts", 4, size=(128, 64)),
    ]
    whole.write_bytes(b"".join(part.read_bytes() for part in parts))
    with (
        open_source(whole) as source,
        pytest.raises(SourceError, match="picture size changes from"),
    ):
        list(source)


@pytest.mark.parametrize(
    ("content", "words"), [(None, "no such file"), (b"", "empty"), (b"hello\n" * 50, "not a video")]
)
def test_what_is_no_video_is_refused_in_one_line(tmp_path, content, words):
    path = tmp_path / "a.mp4"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SourceError, match=words) as fault:
        open_source(path)
    assert str(path) in str(fault.value)
    assert "\n" not in str(fault.value)


def test_a_file_cut_before_its_index_is_refused(tmp_path):
    path = write_video(tmp_path / "a.mp4", 8, size=SMALL)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(SourceError, match="cut short"):
        open_source(path)


def test_sound_alone_is_refused(tmp_path):
    path = tmp_path / "a.wav"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), "s16", "mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
    with pytest.raises(SourceError, match="holds no video"):
        open_source(path)


def test_a_frame_rate_for_a_video_is_refused(tmp_path):
    path = write_video(tmp_path / "a.mp4", 2, size=SMALL)
    with pytest.raises(OptionError, match="own clock"):
        open_source(path, fps=10.0)
    with pytest.raises(OptionError, match="positive"):
        open_source(tmp_path, fps=0.0)


@contextlib.contextmanager
def served(folder):
    """Serve a folder by HTTP, without ranges; yield the address."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *arguments):
            pass

    handler = functools.partial(Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_an_address_is_read_like_a_file(tmp_path):
    """An MPEG-TS over HTTP, served here."""
    write_video(tmp_path / "a.ts", 10, size=SMALL)
    with served(tmp_path) as address:
        with open_source(f"{address}/a.ts") as source:
            assert isinstance(source, VideoSource)
            assert [f.index for f in source] == list(range(10))
        with pytest.raises(SourceError, match="cannot be opened"):
            open_source(f"{address}/missing.ts")


@pytest.mark.parametrize("codec", ["libx264", "mpeg4"])
def test_a_server_that_cannot_send_the_pictures_is_blamed_and_not_the_file(tmp_path, codec):
    """The index is behind the pictures, to which FFmpeg cannot return."""
    write_video(tmp_path / "a.mp4", 40, size=(320, 240), codec=codec, options={}, content=grain)
    with (
        served(tmp_path) as address,
        pytest.raises(SourceError, match="cannot send parts of a file, download it"),
        open_source(f"{address}/a.mp4") as source,
    ):
        list(source)


def test_a_closed_video_is_refused_and_not_read_from_freed_memory(tmp_path):
    path = write_video(tmp_path / "a.mp4", 30, size=SMALL)
    source = VideoSource(path)
    source.close()
    with pytest.raises(SourceError, match=r"a\.mp4: has been closed; open it again"):
        list(source)
    source = VideoSource(path)
    frames = iter(source)
    next(frames)
    source.close()
    source.close()
    with pytest.raises(SourceError, match="has been closed"):
        next(frames)


def test_a_video_may_be_closed_by_another_thread(tmp_path):
    source = VideoSource(write_video(tmp_path / "a.mp4", 30, size=(320, 240), content=grain))
    closing = threading.Thread(target=source.close)
    frames = iter(source)
    next(frames)
    closing.start()
    # It may be closed before any of these.
    with contextlib.suppress(SourceError):
        list(itertools.islice(frames, 25))
    closing.join()
    with pytest.raises(SourceError, match="has been closed"):
        list(source)


def test_a_video_that_is_iterated_twice_goes_on_or_says_that_it_is_at_its_end(tmp_path):
    with open_source(write_video(tmp_path / "a.mp4", 10, size=SMALL)) as source:
        frames = iter(source)
        assert [next(frames).index for _ in range(10)] == list(range(10))
        assert list(source) == []
        with pytest.raises(SourceError, match="read to its end; open it again"):
            list(source)


def test_what_is_neither_file_nor_folder_is_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe.mp4")
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "loop.mp4").symlink_to(tmp_path / "loop.mp4")
    for name, why in (
        ("pipe.mp4", "is a pipe"),
        ("pipe.png", "is a pipe"),
        ("loop.mp4", "no such"),
    ):
        with pytest.raises(SourceError, match=why):
            open_source(tmp_path / name)
    with pytest.raises(SourceError, match="is a device"):
        open_source("/dev/zero")
    with pytest.raises(SourceError, match="not a readable image"):
        open_source(tmp_path)
