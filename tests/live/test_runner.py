"""The live loop: latest frame, silence, faults of every part, and an end in good order."""

import math
import threading
import time
from collections.abc import Callable

import pytest

from aqualvs.errors import SourceError
from aqualvs.live.frozen import FrozenOptions
from aqualvs.live.health import State
from aqualvs.live.mailbox import Mailbox
from aqualvs.live.runner import FixedScanner, LiveOptions, LiveRunner
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.scanning.scan import Frame, Scan
from live_cases import (
    Collector,
    ScriptedFeed,
    Step,
    broken_feed,
    demo_frames,
    demo_rig,
    demo_scanner,
    of_size,
    renumbered,
)

FRAME = demo_frames(1)[0]


def never() -> bool:
    return False


def after(seconds: float) -> Callable[[], bool]:
    end = time.monotonic() + seconds
    return lambda: time.monotonic() > end


def runner(
    steps: list[Step],
    *outputs: Collector,
    endless: bool = False,
    keep_every: bool = False,
    scanner: object = None,
    watches: bool = False,
) -> LiveRunner:
    return LiveRunner(
        ScriptedFeed(steps, endless=endless),
        FixedScanner(scanner or demo_scanner()),  # type: ignore[arg-type]
        outputs,
        # Most of these steps show one picture again and again.
        LiveOptions(keep_every=keep_every, frozen=FrozenOptions() if watches else None),
    )


def reasons(output: Collector) -> list[Reason | None]:
    return [
        scan.reason if isinstance(scan := s.scan.posture, Refusal) else None for s in output.samples
    ]


def test_every_frame_of_a_file_gives_what_the_scanner_alone_gives() -> None:
    output = Collector()
    assert runner(list(demo_frames()), output, keep_every=True).run(never) is None
    assert [s.scan.index for s in output.samples] == list(range(8))
    for sample, frame in zip(output.samples, demo_frames(), strict=True):
        expected = demo_scanner().process(frame).posture
        assert sample.scan.posture
        assert expected
        assert sample.scan.posture.range == expected.range
        assert sample.instants.arrived_ns <= sample.instants.taken_ns <= sample.instants.scanned_ns
    assert output.closed


def test_a_source_faster_than_the_pipeline_costs_frames_but_no_delay() -> None:
    frames: list[Step] = [renumbered(FRAME, i) for i in range(400)]
    output = Collector()
    live = runner(frames, output)
    live.run(never)
    health = output.samples[-1].health
    assert output.samples[-1].scan.index == 399
    assert len(output.samples) < 400
    # Health is at most a tenth of a second old, so it may miss the last few.
    dropped = 400 - len(output.samples)
    assert 0 < health.n_dropped <= dropped
    assert health.n_lost == 0
    waits = [1e-9 * (s.instants.taken_ns - s.instants.arrived_ns) for s in output.samples]
    # No frame is older than the measurement of the one before; the machine may be busy.
    assert sorted(waits)[len(waits) // 2] < 0.02


def test_silence_is_told_within_a_fifth_of_a_second_and_ends_with_the_next_frame() -> None:
    steps: list[Step] = [FRAME, 0.5, renumbered(FRAME, 40), 0.12, renumbered(FRAME, 41)]
    output = Collector()
    runner(steps, output).run(never)
    found = reasons(output)
    assert found[0] is None
    assert found[-2:] == [None, None]
    silent = found[1:-2]
    assert set(silent) == {Reason.NO_FRAMES}
    assert len(silent) >= 2
    assert output.at_s[1] - output.at_s[0] < 0.2
    assert output.samples[1].scan.index == FRAME.index
    assert output.samples[1].frame is None
    assert output.samples[-1].health.n_lost == 39


def test_a_picture_that_stands_still_has_no_posture_until_it_moves() -> None:
    moving: list[Step] = list(demo_frames(30))
    still: list[Step] = [renumbered(demo_frames(30)[-1], i) for i in range(30, 50)]
    again: list[Step] = [renumbered(demo_frames(30)[i % 30], i) for i in range(50, 80)]
    output = Collector()
    runner([*moving, *still, *again], output, keep_every=True, watches=True).run(never)
    found = reasons(output)
    assert Reason.FROZEN not in found[:30]
    assert set(found[36:50]) == {Reason.FROZEN}
    assert Reason.FROZEN not in found[-15:]
    refusal = output.samples[45].scan.posture
    assert isinstance(refusal, Refusal)
    assert refusal.detail == "the same picture for 0.6 s"


def test_a_picture_of_another_size_is_refused_and_the_next_is_measured() -> None:
    output = Collector()
    steps: list[Step] = [FRAME, of_size(640, 480, 1), renumbered(FRAME, 2)]
    runner(steps, output, keep_every=True).run(never)
    assert reasons(output) == [None, Reason.WRONG_SIZE, None]
    refusal = output.samples[1].scan.posture
    assert isinstance(refusal, Refusal)
    assert "640x480" in refusal.detail


class _Stumbling:
    """A scanner that fails on one frame."""

    rig = demo_rig()

    def detect(self, frame: Frame) -> object:
        if frame.index == 1:
            raise ZeroDivisionError("bad luck")
        return demo_scanner().detect(frame)

    def measure(self, index: int, time_s: float, returns: object) -> Scan:
        return demo_scanner().measure(index, time_s, returns)  # type: ignore[arg-type]


def test_a_frame_that_the_scanner_fails_on_ends_nothing() -> None:
    output = Collector()
    steps: list[Step] = [renumbered(FRAME, i) for i in range(3)]
    runner(steps, output, keep_every=True, scanner=_Stumbling()).run(never)
    assert reasons(output) == [None, Reason.CORRUPT_FRAME, None]


@pytest.mark.parametrize("inline", [True, False])
def test_an_output_that_fails_is_told_and_disturbs_no_other(inline: bool) -> None:
    def fail(n: int) -> None:
        raise ConnectionRefusedError("nobody there")

    bad, good = Collector("bad", inline=inline, disturb=fail), Collector("good")
    steps: list[Step] = [renumbered(FRAME, 0), 0.25, renumbered(FRAME, 1), 0.25]
    runner([*steps, renumbered(FRAME, 2)], bad, good, keep_every=True).run(never)
    assert [s.scan.index for s in good.samples if s.frame is not None] == [0, 1, 2]
    told = {part.name: part for part in good.samples[-1].health.outputs}
    assert told["bad"].state is State.FAULT
    assert "nobody there" in told["bad"].detail
    assert told["good"].state is State.OK
    assert bad.closed


def test_a_slow_output_gets_the_latest_and_delays_nobody() -> None:
    slow = Collector("slow", inline=False, disturb=lambda _n: time.sleep(0.2))
    quick = Collector("quick")
    steps: list[Step] = [part for i in range(20) for part in (renumbered(FRAME, i), 0.04)]
    runner(steps, slow, quick, endless=False).run(never)
    assert len([s for s in quick.samples if s.frame is not None]) == 20
    assert len(slow.samples) < 12
    indices = [s.scan.index for s in slow.samples]
    assert indices == sorted(indices)
    assert indices[-1] == 19
    part = next(p for p in quick.samples[-1].health.outputs if p.name == "slow")
    assert part.n_dropped > 3


def test_an_output_that_keeps_all_loses_nothing_at_the_end() -> None:
    kept = Collector("kept", inline=False, keeps_all=True, disturb=lambda _n: time.sleep(0.02))
    runner([renumbered(FRAME, i) for i in range(30)], kept, keep_every=True).run(never)
    assert [s.scan.index for s in kept.samples] == list(range(30))


def test_a_feed_that_can_never_work_ends_the_run_with_its_reason() -> None:
    fault = LiveRunner(broken_feed(), FixedScanner(demo_scanner()), []).run(never)
    assert isinstance(fault, SourceError)
    assert "no such camera" in str(fault)


def test_a_feed_that_fails_unexpectedly_is_begun_again() -> None:
    output = Collector()
    steps: list[Step] = [FRAME, ValueError("surprise"), renumbered(FRAME, 1)]
    began = time.monotonic()
    runner(steps, output).run(never)
    assert [s.scan.index for s in output.samples if s.frame is not None] == [0, 1]
    assert time.monotonic() - began < 3.0
    between = [s.health.source for s in output.samples if s.frame is None]
    assert any(part.state is State.FAULT and "surprise" in part.detail for part in between)


def test_a_request_to_stop_is_followed_at_once_and_leaves_no_thread() -> None:
    before = set(threading.enumerate())
    output = Collector("waits", inline=False)
    began = time.monotonic()
    runner([FRAME], output, endless=True).run(after(0.3))
    assert time.monotonic() - began < 1.5
    assert output.closed
    assert set(threading.enumerate()) == before


def test_health_counts_and_watches_the_lasers() -> None:
    output = Collector()
    steps: list[Step] = [part for i in range(12) for part in (renumbered(FRAME, i), 0.04)]
    runner(steps, output).run(never)
    health = output.samples[-1].health
    assert 10.0 < health.rate_hz < 26.0
    assert health.valid_share == 1.0
    assert [d.name for d in health.delays] == ["wait", "measure", "send", "total"]
    assert all(0.0 <= d.median_s <= d.p99_s < 1.0 for d in health.delays)
    assert 0.0 < health.quality <= 1.0
    assert [laser.state for laser in health.lasers] == [State.OK] * len(demo_rig().lasers)
    assert math.isnan(health.sigma_n_water)
    assert health.state is State.OK


def test_the_clock_of_the_system_may_jump(monkeypatch: pytest.MonkeyPatch) -> None:
    jumps = iter([10**18, 5 * 10**17, 2 * 10**18] * 20)
    monkeypatch.setattr(time, "time_ns", lambda: next(jumps))
    output = Collector()
    steps: list[Step] = [part for i in range(6) for part in (renumbered(FRAME, i), 0.03)]
    runner(steps, output).run(never)
    assert len([s for s in output.samples if s.scan.posture]) == 6
    assert 0.0 <= output.samples[-1].health.delays[-1].p99_s < 1.0


def test_a_closed_mailbox_gives_its_last_frame_and_then_nothing() -> None:
    box = Mailbox()
    box.put(FRAME)
    box.close()
    box.put(renumbered(FRAME, 1))
    assert not box.exhausted
    arrival = box.take(0.0)
    assert arrival is not None
    assert arrival.frame is FRAME
    assert box.exhausted
    assert box.take(0.0) is None
