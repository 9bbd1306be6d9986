"""An interlaced picture is taken apart into its rows, exactly."""

import itertools
from dataclasses import replace

import av
import numpy as np
import pytest

from aqualvs.optics.shutter import AT_ONCE, Shutter, ShutterKind
from aqualvs.scanning.scan import Frame
from aqualvs.sources import open_source
from aqualvs.sources.base import bgr_of
from aqualvs.sources.fields import (
    FieldEvidence,
    FieldSource,
    FieldWatch,
    combed_share,
    field_of,
    frames_of,
    whole_luma,
)
from aqualvs.sources.video import sampled_pictures
from batch_cases import DEMO
from field_cases import FIELDS, woven_dive

_BOTTOM = Shutter(kind=ShutterKind.INTERLACED, readout=0.02, first_field="bottom")


def picture(height=8, *, is_interlaced=False, index=3):
    rng = np.random.default_rng(1)
    luma = rng.integers(0, 256, (height, 6), np.uint8)
    u, v = rng.integers(0, 256, (2, -(-height // 2), 3), np.uint8)
    return Frame(index, 0.12, luma, (u, v), is_interlaced=is_interlaced)


@pytest.mark.parametrize(("field", "first"), [("top", 0), ("bottom", 1)])
def test_a_field_is_every_other_row(field, first):
    whole = picture(is_interlaced=True)
    found = field_of(whole, field)
    assert np.shares_memory(found.luma, whole.luma)
    assert np.array_equal(found.luma, whole.luma[first::2])
    for plane, mine in zip(whole.chroma, found.chroma, strict=True):
        assert np.array_equal(mine, plane[first::2])
    assert found.field == field


def test_chroma_of_a_picture_coded_as_progressive_is_of_both_fields():
    whole = picture()
    for field in ("top", "bottom"):
        for plane, mine in zip(whole.chroma, field_of(whole, field).chroma, strict=True):
            mean = 0.5 * (plane[::2].astype(float) + plane[1::2])
            assert np.abs(mine - mean).max() <= 0.5


@pytest.mark.parametrize("is_interlaced", [True, False])
@pytest.mark.parametrize("height", [5, 6, 7, 9, 10])
def test_fields_of_any_height_are_alike_and_an_odd_last_row_is_left_out(height, is_interlaced):
    whole = picture(height, is_interlaced=is_interlaced)
    for first, field in enumerate(("top", "bottom")):
        found = field_of(whole, field)
        assert np.array_equal(found.luma, whole.luma[first : height // 2 * 2 : 2])
        assert {plane.shape for plane in found.chroma} == {((height // 2 + 1) // 2, 3)}


def test_fields_are_frames_with_numbers_and_times_of_their_own():
    one, other = frames_of([picture(index=3)], _BOTTOM)
    assert (one.index, one.time_s, one.field) == (6, 0.12, "bottom")
    assert (other.index, other.time_s, other.field) == (7, pytest.approx(0.14), "top")
    assert [_BOTTOM.field_of(i) for i in (6, 7)] == [one.field, other.field]


def test_pictures_of_other_cameras_stay_as_they_are():
    whole = picture()
    assert next(frames_of([whole], AT_ONCE)) is whole


def test_a_field_is_shown_with_its_rows_where_they_lie():
    grey = Frame(0, 0.0, picture().luma)
    shown = bgr_of(field_of(grey, "bottom"))[..., 0]
    assert np.array_equal(shown[1::2], grey.luma[1::2])
    assert np.array_equal(shown[::2], shown[1::2])


@pytest.mark.parametrize("first", ["top", "bottom"])
def test_fields_of_a_coded_video_are_the_pictures_that_it_was_woven_from(tmp_path, first):
    shutter = Shutter(kind=ShutterKind.INTERLACED, readout=0.04, first_field=first)
    video = woven_dive(tmp_path / "dive.mp4", 3, shutter=shutter)
    with FieldSource(open_source(video), shutter) as source:
        assert (source.n_frames, source.fps, source.size_px) == (6, 25.0, (720, 576))
        fields = list(source)
    assert [frame.time_s for frame in fields] == pytest.approx([0.04 * i for i in range(6)])
    with av.open(str(DEMO / "dive.mp4")) as dive:
        for frame, whole in zip(fields, dive.decode(video=0), strict=False):
            row = 0 if frame.field == "top" else 1
            stacked = whole.to_ndarray()
            luma, chroma = stacked[:576], stacked[576:].reshape(2, 288, 360)
            # By H.264 alone; rows of the other field, 40 ms away, differ by far more.
            assert np.abs(frame.luma.astype(int) - luma[row::2]).mean() < 1.5
            for mine, plane in zip(frame.chroma, chroma, strict=True):
                assert np.abs(mine.astype(int) - plane[row::2]).mean() < 1.0


@pytest.mark.parametrize("field", ["top", "bottom"])
def test_a_field_at_the_size_of_its_picture_has_its_rows_where_they_were(field):
    ramp = np.repeat(np.arange(0, 160, 10, np.uint8)[:, None], 6, axis=1)
    found = whole_luma(field_of(Frame(0, 0.0, ramp), field))
    assert np.array_equal(found[1:-1], ramp[1:-1])
    assert np.array_equal(whole_luma(Frame(0, 0.0, ramp)), ramp)


def test_the_stream_says_that_it_is_interlaced(tmp_path):
    for coded in (True, False):
        with open_source(woven_dive(tmp_path / "dive.mp4", 2, coded=coded)) as source:
            assert {frame.is_interlaced for frame in source} == {coded}


def test_the_fields_of_a_lost_picture_are_lost():
    frames = list(frames_of([picture(index=0), picture(index=2)], FIELDS))
    assert [frame.index for frame in frames] == [0, 1, 4, 5]


def evidence(video):
    return FieldEvidence.of(*sampled_pictures(video))


@pytest.mark.parametrize("coded", [True, False], ids=["marked", "combed"])
def test_fields_are_recognised_by_the_stream_and_by_the_comb(tmp_path, coded):
    found = evidence(woven_dive(tmp_path / "dive.mp4", 6, shutter=_BOTTOM, coded=coded))
    assert (found.is_marked, found.first_field) == ((True, "bottom") if coded else (False, None))
    assert found.combed > 0.005
    remedy = "camera.shutter: {kind: interlaced, readout_ms: 40, first_field: bottom}"
    for whole in (AT_ONCE, Shutter(kind=ShutterKind.ROLLING, readout=0.02)):
        assert remedy in found.contradiction(whole, 12.5)
    assert found.contradiction(_BOTTOM, 12.5) == ""
    assert found.first_by_motion == "bottom"
    assert "camera.shutter.first_field: bottom" in found.contradiction(FIELDS, 12.5)


@pytest.mark.parametrize("first", ["top", "bottom"])
def test_motion_tells_the_order_of_fields_where_the_stream_is_wrong(tmp_path, first):
    shutter = replace(FIELDS, first_field=first)
    other = replace(FIELDS, first_field="top" if first == "bottom" else "bottom")
    found = replace(
        evidence(woven_dive(tmp_path / "dive.mp4", 6, shutter=shutter)),
        first_field=other.first_field,
    )
    assert found.contradiction(shutter, 12.5) == ""
    said = found.contradiction(other, 12.5)
    assert f"the {first} field comes first, as what moves shows" in said
    assert f"set camera.shutter.first_field: {first} in the rig file" in said


def test_the_stream_tells_the_order_where_nothing_moves(tmp_path):
    with open_source(woven_dive(tmp_path / "dive.mp4", 4, shutter=_BOTTOM)) as source:
        still = 3 * [next(iter(source))]
    found = FieldEvidence.of([still], "bottom")
    assert found.first_by_motion is None
    assert "if the postures go to and fro" in found.contradiction(FIELDS, 12.5)
    assert FieldEvidence.of([still]).contradiction(FIELDS, 12.5) == ""


def test_whole_pictures_are_recognised_where_something_moves():
    found = evidence(DEMO / "dive.mp4")
    assert found.combed < 1e-5 < 0.01 < found.woven
    assert found.contradiction(AT_ONCE, 25.0) == ""
    assert "take camera.shutter out" in found.contradiction(FIELDS, 25.0)


def test_what_stands_still_tells_nothing_against_a_rig():
    with open_source(DEMO / "dive.mp4") as source:
        still = 3 * [next(iter(source))]
    for shutter in (AT_ONCE, FIELDS):
        assert FieldEvidence.of([still]).contradiction(shutter, 25.0) == ""
    assert FieldEvidence.of([]).contradiction(FIELDS, None) == ""


def test_a_progressive_picture_in_an_interlaced_stream_is_whole():
    with open_source(DEMO / "dive.mp4") as source:
        marked = [replace(one, is_interlaced=True) for one in itertools.islice(source, 3)]
    found = FieldEvidence.of([marked])
    assert found.is_marked
    assert found.contradiction(AT_ONCE, 25.0) == ""


def watched(pictures, shutter, every=25):
    """Warn after a stream that goes to and fro over some pictures, and say how long it took."""
    watch = FieldWatch(shutter)
    to_and_fro = itertools.islice(itertools.cycle([*pictures, *pictures[-2:0:-1]]), 12 * every)
    for i, one in enumerate(to_and_fro):
        watch.look(replace(one, index=i, time_s=i / every))
    return watch.warning


def test_a_stream_of_fields_is_noticed_and_named_with_its_remedy(tmp_path):
    with open_source(woven_dive(tmp_path / "dive.mp4", 4, coded=False)) as source:
        fields = list(source)
    said = "camera.shutter: {kind: interlaced, readout_ms: 20}"
    assert said in watched(fields, AT_ONCE)
    assert "readout_ms: 16.667" in watched(fields, AT_ONCE, 30)


@pytest.mark.parametrize("first", ["top", "bottom"])
def test_a_stream_shows_which_field_comes_first(tmp_path, first):
    video = woven_dive(tmp_path / "dive.mp4", 30, shutter=replace(FIELDS, first_field=first))
    with open_source(video) as source:
        fields = list(source)

    def said(shutter):
        watch = FieldWatch(shutter)
        for one in fields:
            watch.look(replace(one, is_interlaced=False))
        return watch.warning

    other = "top" if first == "bottom" else "bottom"
    assert said(replace(FIELDS, first_field=first)) == ""
    wrong = said(replace(FIELDS, first_field=other))
    assert f"set camera.shutter.first_field: {first} in the rig file" in wrong


def test_a_still_stream_is_interlaced_if_it_says_so():
    with open_source(DEMO / "dive.mp4") as source:
        still = next(iter(source))
    assert watched([still], AT_ONCE) == ""
    assert "the stream says so" in watched([replace(still, is_interlaced=True)], AT_ONCE)


def test_a_stream_of_whole_pictures_under_a_rig_of_fields_is_noticed():
    with open_source(DEMO / "dive.mp4") as source:
        whole = [replace(one, is_interlaced=True) for one in itertools.islice(source, 4)]
    assert watched(whole, AT_ONCE) == ""
    assert "take camera.shutter out" in watched(whole, FIELDS)


def test_thin_lines_and_noise_are_no_comb():
    rng = np.random.default_rng(2)
    noisy = np.clip(rng.normal(90.0, 6.0, (240, 320)), 0, 255).astype(np.uint8)
    assert combed_share(noisy) < 1e-5
    lined = noisy.copy()
    lined[::8] = 220
    assert combed_share(lined) < 1e-5
    combs = noisy.copy()
    combs[::2, 100:104] = 220
    assert 3 / 320 < combed_share(combs) < 9 / 320


def test_a_damaged_video_gives_the_signs_that_it_has(tmp_path):
    broken = tmp_path / "dive.mp4"
    broken.write_bytes((DEMO / "dive.mp4").read_bytes()[:200_000])
    assert evidence(broken) == FieldEvidence(is_marked=False, combed=0.0, woven=0.0)


def test_chroma_at_full_height_is_reduced_field_by_field(tmp_path):
    """4:2:2, as capture devices deliver it, becomes 4:2:0 without mixing the fields."""
    rows = np.where(np.arange(96) % 2, 170, 90).astype(np.uint8)
    planes = [np.full((96, 64), 100, np.uint8), *2 * [np.repeat(rows[:, None], 32, axis=1)]]
    video = tmp_path / "dive.mkv"
    with av.open(str(video), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 96, "yuv422p"
        stream.options = {"flags": "+ilme+ildct", "x264-params": "tff=1", "qp": "0"}
        coded = av.VideoFrame(64, 96, "yuv422p")
        for plane, values in zip(coded.planes, planes, strict=True):
            padded = np.zeros((plane.height, plane.line_size), np.uint8)
            padded[:, : values.shape[1]] = values
            plane.update(padded.tobytes())
        container.mux(stream.encode(coded))
        container.mux(stream.encode(None))
    with open_source(video) as source:
        whole = next(iter(source))
    for field, level in (("top", 90), ("bottom", 170)):
        assert {int(v) for plane in field_of(whole, field).chroma for v in plane.flat} == {level}
