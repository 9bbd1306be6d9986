"""Words that several outputs share."""

from aqualvs.batch.dives import DiveRecord, DiveState
from aqualvs.results.summary import RunSummary
from aqualvs.text import count_text, with_sign


def test_one_thing_is_in_the_singular():
    assert [count_text(n, "frame") for n in (0, 1, 2)] == ["0 frames", "1 frame", "2 frames"]
    assert count_text(12_000, "frame") == "12000 frames"
    assert count_text(12_000, "frame", commas=True) == "12,000 frames"


def test_what_rounds_to_zero_has_no_sign():
    assert [with_sign(x, 1) for x in (-0.04, 0.04, 0.0)] == ["0.0", "0.0", "0.0"]
    assert [with_sign(x, 1) for x in (-0.06, 0.06, 12.0)] == ["-0.1", "+0.1", "+12.0"]


def test_a_run_of_one_frame_is_told_in_the_singular():
    summary = RunSummary()
    summary.refuse("no_stripes")
    assert summary.lines()[0] == "posture in 0 of 1 frame (0.0 %)"
    facts = {"n_frames": 1, "summary": {}, "net": {}}
    record = DiveRecord(name="dive", source="dive.mp4", state=DiveState.FINISHED, facts=facts)
    assert record.line() == "dive: 1 frame, posture in 0.0 %"
