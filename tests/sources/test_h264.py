"""Fields that are coded each by itself: one picture of two packets, whatever counts packets."""

from fractions import Fraction

import av
import numpy as np
import pytest

from aqualvs.sources import open_source
from aqualvs.sources.base import packet_with
from aqualvs.sources.fields import FieldEvidence
from aqualvs.sources.h264 import FieldPairs
from aqualvs.sources.live_frames import LiveFrames, Reception
from aqualvs.sources.spans import video_spans
from aqualvs.sources.video import sampled_pictures
from paff_cases import SIDE, field_packets, pictures, write

N = 6


@pytest.fixture(scope="module")
def images():
    return pictures(N)


@pytest.mark.parametrize("first", ["top", "bottom"])
@pytest.mark.parametrize("singly", [True, False])
@pytest.mark.parametrize("suffix", ["ts", "mp4"])
def test_a_file_has_as_many_pictures_as_pairs_of_fields(tmp_path, images, suffix, singly, first):
    path = write(tmp_path / f"dive.{suffix}", images, first=first, singly=singly)
    with open_source(str(path)) as source:
        assert (source.fps, source.n_frames) == (25.0, N)
        frames = list(source)
    assert [frame.index for frame in frames] == list(range(N))
    assert np.allclose([frame.time_s for frame in frames], np.arange(N) / 25.0, atol=1e-4)
    for frame, image in zip(frames, images, strict=True):
        assert frame.is_interlaced
        assert np.array_equal(frame.luma, image[:SIDE])


@pytest.mark.parametrize("first", ["top", "bottom"])
def test_the_stream_says_which_field_comes_first(tmp_path, images, first):
    path = write(tmp_path / "dive.ts", images, first=first, singly=True)
    groups, told = sampled_pictures(path)
    evidence = FieldEvidence.of(groups, told)
    assert evidence.is_marked
    assert told == first


def test_a_file_of_single_fields_is_not_cut(tmp_path, images):
    found = video_spans(write(tmp_path / "dive.mp4", images, singly=True), 2)
    assert found.why_whole == "fields in packets of their own"


@pytest.mark.parametrize("reports_losses", [True, False])
def test_live_pictures_of_two_packets_leave_no_gap(images, reports_losses):
    live = LiveFrames(Reception("camera", "camera"))
    live.connect(av.CodecContext.create("h264", "r"), 0.02, reports_losses=reports_losses)
    frames = []
    for i, data in enumerate(field_packets(images)):
        packet = packet_with(data)
        packet.pts, packet.time_base = i, Fraction(1, 50)
        frames += live.feed(packet)
    assert [frame.index for frame in frames] == list(range(N))
    assert np.allclose(np.diff([frame.time_s for frame in frames]), 0.04)


def test_a_lost_field_shifts_no_later_pair(images):
    packets = field_packets(images)
    pairs = FieldPairs(b"")
    assert [pairs.is_second(one) for one in packets] == N * [False, True]
    # The second field of the first picture, and the first one of the fourth.
    kept = [one for i, one in enumerate(packets) if i not in (1, 6)]
    pairs = FieldPairs(b"")
    found = [pairs.is_second(one) for one in kept]
    assert found == [False, False, True, False, True, False, False, True, False, True]
