"""Videos are cut where decoding can begin anew, and their parts are what the whole is."""

import av
import numpy as np
import pytest

from aqualvs.sources import open_source
from aqualvs.sources.h264 import unit_reader
from aqualvs.sources.spans import (
    Span,
    SpanKind,
    SpanMismatchError,
    SpanReader,
    image_spans,
    video_spans,
)
from shell_cases import cut_after, damage_frame, destroy_frame, grain, packets, write_video

SIZE = (96, 64)
N = 40


def options(**more):
    return {"preset": "ultrafast", "g": "10", "sc_threshold": "0", **more}


def dive(path, n=N, content=grain, **more):
    given = {"size": SIZE, "content": content, "options": options()}
    return write_video(path, n, **{**given, **more})


def frames_of(path, spans):
    with SpanReader(path, SIZE) as parts:
        for span in spans:
            yield from parts.frames(span)


def by_index(frames):
    return sorted(frames, key=lambda frame: frame.index)


def assert_same_frames(path, spans):
    with open_source(path) as source:
        whole = list(source)
    parts = list(frames_of(path, spans))
    # What the reader has read before must not matter.
    for one, other in zip(parts, by_index(frames_of(path, spans[::-1])), strict=True):
        assert (one.index, one.time_s) == (other.index, other.time_s)
        assert np.array_equal(one.luma, other.luma)
    assert [frame.index for frame in parts] == [frame.index for frame in whole]
    # The clock must be the same number, not one close by.
    assert [frame.time_s for frame in parts] == [frame.time_s for frame in whole]
    for part, one in zip(parts, whole, strict=True):
        assert np.array_equal(part.luma, one.luma)
        assert np.array_equal(part.chroma, one.chroma)


@pytest.mark.parametrize("suffix", ["mp4", "mkv", "ts"])
@pytest.mark.parametrize(
    "codec_options",
    [options(), options(bf="3", preset="fast"), options(bf="2", preset="fast", refs="4")],
    ids=["plain", "b-frames", "references"],
)
def test_the_parts_of_h264_are_the_whole(tmp_path, suffix, codec_options):
    path = dive(tmp_path / f"dive.{suffix}", options=codec_options)
    found = video_spans(path, 10)
    assert found.why_whole == ""
    assert [span.first for span in found.spans] == [0, 10, 20, 30]
    assert [span.stop for span in found.spans] == [10, 20, 30, 40]
    assert_same_frames(path, found.spans)


@pytest.mark.parametrize("codec", ["libx265", "mjpeg"])
def test_the_parts_of_other_codecs_are_the_whole(tmp_path, codec):
    more = {"options": {}, "pix_fmt": "yuvj420p"}
    if codec == "libx265":
        words = "keyint=10:min-keyint=10:scenecut=0:open-gop=0:log-level=none"
        more = {"options": {"preset": "ultrafast", "x265-params": words}}
    path = dive(tmp_path / "dive.mkv", codec=codec, **more)
    found = video_spans(path, 10)
    assert [span.first for span in found.spans] == [0, 10, 20, 30]
    assert_same_frames(path, found.spans)


def test_parts_with_a_margin_reach_into_those_beside_them(tmp_path):
    path = dive(tmp_path / "dive.mp4")
    spans = video_spans(path, 20, 2).spans
    assert [(one.first, one.lead, one.stop, one.trail) for one in spans] == [
        (0, 0, 30, 10),
        (10, 10, 40, 0),
    ]
    assert [frame.index for frame in frames_of(path, spans)] == [*range(30), *range(10, 40)]
    images = image_spans([1] * 7, 3, 2)
    assert [(one.first, one.lead, one.stop, one.trail, one.n_bytes) for one in images] == [
        (0, 0, 5, 2, 3),
        (1, 2, 7, 1, 3),
        (4, 2, 7, 0, 1),
    ]


def test_parts_have_as_many_frames_as_asked(tmp_path):
    path = dive(tmp_path / "dive.mp4")
    assert [span.first for span in video_spans(path, 11).spans] == [0, 20]
    assert [span.first for span in video_spans(path, 100).spans] == [0]


@pytest.mark.parametrize("codec", ["libx264", "libx265"])
def test_open_groups_are_no_place_to_cut(tmp_path, codec):
    """Pictures before such a key frame refer to it: only what is an IDR counts."""
    words = "open-gop=1:keyint=10:min-keyint=10:scenecut=0:bframes=3"
    name = "x264-params" if codec == "libx264" else "x265-params"
    more = {"preset": "medium", name: words + ("" if codec == "libx264" else ":log-level=none")}
    path = dive(tmp_path / "dive.mkv", codec=codec, options=more)
    with av.open(str(path)) as container:
        assert sum(p.is_keyframe for p in container.demux(video=0) if p.size) > 1
    found = video_spans(path, 1)
    assert [span.first for span in found.spans] == [0]
    assert_same_frames(path, found.spans)


def test_a_codec_about_which_nothing_is_known_stays_whole(tmp_path):
    path = dive(tmp_path / "dive.mp4", codec="mpeg4", options={"g": "10"})
    found = video_spans(path, 10)
    assert (found.spans, found.why_whole) == ((), "videos in mpeg4 stay whole")


def test_a_file_that_breaks_off_stays_whole(tmp_path):
    path = dive(tmp_path / "dive.mp4", mux={"movflags": "faststart"})
    cut_after(path, 25)
    assert video_spans(path, 10).why_whole != ""
    matroska = dive(tmp_path / "dive.mkv")
    matroska.write_bytes(matroska.read_bytes()[: matroska.stat().st_size // 2])
    assert video_spans(matroska, 10).why_whole == "ends before its promise"


def test_avi_whose_times_are_those_of_decoding_stays_whole(tmp_path):
    path = dive(tmp_path / "dive.avi", options=options(bf="2", preset="fast"))
    assert video_spans(path, 10).why_whole == "pictures without a time of their own"
    path = dive(tmp_path / "other.avi", options=options(bf="0", preset="fast"))
    assert video_spans(path, 10).why_whole == ""
    assert_same_frames(path, video_spans(path, 10).spans)


@pytest.mark.parametrize("damage", [damage_frame, destroy_frame])
def test_a_damaged_part_is_noticed_and_the_others_are_not_touched(tmp_path, damage):
    path = dive(tmp_path / "dive.mp4")
    damage(path, 14)
    spans = video_spans(path, 10).spans
    assert len(spans) == 4
    with pytest.raises(SpanMismatchError):
        list(SpanReader(path, SIZE).frames(spans[1]))
    for span in (spans[0], spans[2], spans[3]):
        assert len(list(SpanReader(path, SIZE).frames(span))) == 10


@pytest.mark.parametrize("seed", range(12))
def test_no_damage_goes_unnoticed_that_the_whole_video_shows(tmp_path, seed):
    """Where a part claims to be sound, it is what decoding the whole video gives."""
    path = dive(tmp_path / "dive.mp4")
    rng = np.random.default_rng(seed)
    position, size = packets(path)[int(rng.integers(10, 20))]
    data = bytearray(path.read_bytes())
    for place in rng.integers(position + 5, position + size, 3):
        data[place] ^= 1 << int(rng.integers(8))
    path.write_bytes(data)
    spans = video_spans(path, 10).spans
    try:
        list(SpanReader(path, SIZE).frames(spans[1]))
    except SpanMismatchError:
        return
    assert_same_frames(path, spans)


def test_a_file_that_was_changed_since_is_noticed(tmp_path):
    path = dive(tmp_path / "dive.mp4")
    spans = video_spans(path, 10).spans
    dive(path, content=lambda i, size: grain(i + 1, size))
    with pytest.raises(SpanMismatchError):
        list(frames_of(path, spans[2:3]))


def test_pictures_of_another_size_are_noticed(tmp_path):
    path = dive(tmp_path / "dive.mp4")
    with pytest.raises(SpanMismatchError, match="another size"):
        list(SpanReader(path, (64, 96)).frames(video_spans(path, 10).spans[1]))


def test_the_parts_of_a_folder_of_images_are_the_whole(tmp_path):
    import cv2

    for i in range(7):
        cv2.imwrite(str(tmp_path / f"{i}.png"), grain(i, SIZE))
    with open_source(tmp_path, fps=5.0) as source:
        whole = list(source)
    spans = [Span(kind=SpanKind.IMAGES, first=first, stop=stop) for first, stop in ((0, 3), (3, 7))]
    parts = [frame for span in spans for frame in SpanReader(tmp_path, SIZE, 5.0).frames(span)]
    assert [(f.index, f.time_s) for f in parts] == [(f.index, f.time_s) for f in whole]
    for part, one in zip(parts, whole, strict=True):
        assert np.array_equal(part.luma, one.luma)
    (tmp_path / "4.png").write_bytes(b"torn")
    with pytest.raises(SpanMismatchError):
        list(SpanReader(tmp_path, SIZE, 5.0).frames(spans[1]))


def units(codec, *heads, extradata=b""):
    reader = unit_reader(codec, extradata)
    length = bool(extradata)
    join = (lambda h: bytes([0, 0, 0, 2, h, 9])) if length else (lambda h: bytes([0, 0, 1, h, 9]))
    return reader(memoryview(b"".join(join(h) for h in heads)))


@pytest.mark.parametrize("extradata", [b"", b"\x01\x00\x00\x00\xff\x00"])
def test_units_of_h264_are_told_apart(extradata):
    idr = units("h264", 0x67, 0x68, 0x65, extradata=extradata)
    assert (idr.is_refresh, idr.has_parameter_sets, idr.has_all_parameter_sets) == (True,) * 3
    plain = units("h264", 0x09, 0x41, 0x65, extradata=extradata)
    assert (plain.is_refresh, plain.has_parameter_sets) == (False, False)
    half = units("h264", 0x68, 0x65, extradata=extradata)
    assert (half.has_parameter_sets, half.has_all_parameter_sets) == (True, False)


def test_a_cut_needs_the_parameter_sets_that_count_there(tmp_path):
    """Sets that stand in the midst of a file count from there on, but not for a part's decoder."""
    path = tmp_path / "dive.h264"
    write_video(path, 30, size=SIZE, content=grain, options=options())
    data = path.read_bytes()
    first = data.index(b"\x00\x00\x00\x01\x67")
    second = data.index(b"\x00\x00\x00\x01\x67", first + 4)
    third = data.index(b"\x00\x00\x01\x65", second + 4)
    bare = tmp_path / "bare.h264"
    bare.write_bytes(data[:second] + data[third:])
    with av.open(str(path)) as whole, av.open(str(bare)) as other:
        reader = unit_reader("h264", b"")
        found = [reader(memoryview(p)) for p in whole.demux(video=0) if p.size]
        cut = [reader(memoryview(p)) for p in other.demux(video=0) if p.size]
    refreshes = [one.has_all_parameter_sets for one in found if one.is_refresh]
    assert refreshes == [True, True, True]
    assert [one.has_all_parameter_sets for one in cut if one.is_refresh] == [True, False, True]
