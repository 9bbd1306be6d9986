"""The live loop: latest frame, silence, faults of every part, and an end in good order."""

import itertools
import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from aqualvs.control.vehicle import VehicleState
from aqualvs.errors import SourceError
from aqualvs.live import runner as live_runner
from aqualvs.live.health_monitor import FrozenOptions
from aqualvs.live.outputs.base import Output
from aqualvs.live.runner import Arrival, LiveOptions, LiveRunner, Mailbox, ScannerProvider
from aqualvs.optics.shutter import AT_ONCE, Shutter, ShutterKind
from aqualvs.recording import DiveRecording, Recorder
from aqualvs.scanner import Scanner
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.row_motion import RowMotion
from aqualvs.scanning.scan import Frame, GyroRates, Scan
from aqualvs.sources.base import PartHealth, State
from aqualvs.sources.fields import FrameFeed, frames_of
from field_cases import FIELDS
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
from waiting import TIMEOUT_S

FRAME = demo_frames(1)[0]


def never() -> bool:
    return False


def after(seconds: float) -> Callable[[], bool]:
    end = time.monotonic() + seconds
    return lambda: time.monotonic() > end


def runner(
    steps: list[Step],
    *outputs: Output,
    endless: bool = False,
    keep_every: bool = False,
    scanner: object = None,
    watches: bool = False,
) -> LiveRunner:
    return LiveRunner(
        ScriptedFeed(steps, endless=endless),
        ScannerProvider(scanner or demo_scanner()),
        outputs,
        # Most of these steps show one picture again and again.
        LiveOptions(keep_every=keep_every, frozen=FrozenOptions() if watches else None),
    )


class Clock:
    """Stands for the clock of the live loop, and for its mailbox: waiting moves the time on.

    Parameters
    ----------
    arrivals : list of (float, Frame)
        When each frame comes, in seconds.
    """

    n_dropped = 0

    def __init__(self, arrivals: list[tuple[float, Frame]]) -> None:
        self._now_ns, self._coming = 10**9, arrivals
        self.time = SimpleNamespace(monotonic_ns=lambda: self._now_ns, time_ns=lambda: self._now_ns)

    def take(self, timeout_s: float) -> Arrival | None:
        due_ns = 10**9 + round(1e9 * self._coming[0][0])
        if due_ns > self._now_ns + round(1e9 * timeout_s):
            self._now_ns += round(1e9 * timeout_s)
            return None
        self._now_ns = max(self._now_ns, due_ns)
        return Arrival(self._coming.pop(0)[1], due_ns, due_ns)

    def close(self) -> None:
        """Do nothing: nobody waits."""

    @property
    def exhausted(self) -> bool:
        return not self._coming


def run_by_clock(
    arrivals: list[tuple[float, Frame]], output: Collector, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Run the loop at times that do not depend on the machine."""
    clock = Clock(arrivals)
    monkeypatch.setattr(live_runner, "time", clock.time)
    live = runner([], output)
    monkeypatch.setattr(live, "_mailbox", clock)
    live.run(never)


def told_at_s(output: Collector) -> list[float]:
    return [1e-9 * s.instants.scanned_ns - 1.0 for s in output.samples]


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


def test_a_rolling_shutter_is_corrected_by_frames_of_the_past() -> None:
    shutter = Shutter(kind=ShutterKind.ROLLING, readout=0.02, exposure=0.008)
    scanner = Scanner(replace(demo_rig(), shutter=shutter))
    output = Collector()
    runner(list(demo_frames()), output, keep_every=True, scanner=scanner).run(never)
    seen = [scanner.scan(frame)[1] for frame in demo_frames()]
    motion = RowMotion(scanner.rig)
    for i, sample in enumerate(output.samples):
        expected = motion.correct(seen[i], seen[max(i - 2, 0) : i]).posture
        assert isinstance(sample.scan.posture, Posture)
        assert isinstance(expected, Posture)
        assert (sample.scan.posture.numbers == expected.numbers).all()
        # Half of readout and exposure.
        assert sample.instants.arrived_ns - sample.posture_ns == 14_000_000
    assert len(output.samples) == 8


class _Autopilot(Collector):
    """An output that an autopilot answers: the vehicle turns to the right by 10 degrees/s."""

    def __init__(self) -> None:
        super().__init__()
        self.asked_ns: list[int] = []

    def vehicle_state(self) -> VehicleState:
        return VehicleState()

    def turning(self, at_ns: int) -> GyroRates:
        self.asked_ns.append(at_ns)
        return GyroRates(np.array([0.0, 0.0, math.radians(-10.0)]), math.radians(3.0))


def test_an_autopilot_tells_how_a_rolling_camera_turns() -> None:
    shutter = Shutter(kind=ShutterKind.ROLLING, readout=0.02, exposure=0.008)
    scanner, output = Scanner(replace(demo_rig(), shutter=shutter)), _Autopilot()
    runner(list(demo_frames(3)), output, keep_every=True, scanner=scanner).run(never)
    assert output.asked_ns == [sample.posture_ns for sample in output.samples]
    first, motion = output.samples[0].scan, RowMotion(scanner.rig)
    _, seen = scanner.scan(demo_frames(1)[0])
    without = motion.correct(seen, []).posture
    expected = motion.correct(replace(seen, turning=first.turning), []).posture
    assert first.posture
    assert expected
    assert without
    assert (first.posture.numbers == expected.numbers).all()
    assert not (first.posture.numbers == without.numbers).all()
    # Nobody asks for what is taken at once.
    other = _Autopilot()
    runner(list(demo_frames(2)), other, keep_every=True).run(never)
    assert other.asked_ns == []
    assert other.samples[0].scan.turning is None


class _Waiting:
    """A scanner that begins with a frame, and ends only when it is let go."""

    rig = demo_rig()

    def __init__(self) -> None:
        self.begun, self.let_go = threading.Event(), threading.Event()

    def detect(self, frame: Frame) -> object:
        self.begun.set()
        assert self.let_go.wait(TIMEOUT_S)
        return demo_scanner().detect(frame)

    def scan(self, frame: Frame) -> tuple[object, Scan]:
        peaks = self.detect(frame)
        return peaks, demo_scanner().measure(frame.index, frame.time_s, peaks)


def test_a_source_faster_than_the_pipeline_costs_frames_but_no_delay(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """399 frames come while the first is measured: the next one measured is the latest of them."""
    monkeypatch.setattr(live_runner, "_HEALTH_EVERY_S", -1.0)
    scanner = _Waiting()

    class Fast(ScriptedFeed):
        def __iter__(self) -> Iterator[Frame]:
            yield renumbered(FRAME, 0)
            assert scanner.begun.wait(TIMEOUT_S)
            yield from (renumbered(FRAME, i) for i in range(1, 400))
            scanner.let_go.set()

    output = Collector()
    LiveRunner(Fast([]), ScannerProvider(scanner), [output]).run(never)
    measured = [s for s in output.samples if s.frame is not None]
    assert [s.scan.index for s in measured] == [0, 399]
    assert (measured[-1].health.n_dropped, measured[-1].health.n_lost) == (398, 0)


def test_a_recorder_as_an_output_records_from_the_start(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "dive.mcap")
    frames = [renumbered(FRAME, index) for index in range(3)]
    runner(frames, recorder, keep_every=True).run(never)
    found = DiveRecording(recorder.path).frames(with_pictures=False)
    assert [one.index for one in found] == [0, 1, 2]


def test_silence_is_told_within_a_fifth_of_a_second_and_ends_with_the_next_frame(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    output = Collector()
    arrivals = [(0.0, FRAME), (0.5, renumbered(FRAME, 40)), (0.62, renumbered(FRAME, 41))]
    run_by_clock(arrivals, output, monkeypatch)
    found = reasons(output)
    assert found[0] is None
    assert found[-2:] == [None, None]
    silent = found[1:-2]
    assert set(silent) == {Reason.NO_FRAMES}
    assert told_at_s(output)[1] <= 0.2 + 1e-9
    # Told again and again.
    gaps = [b - a for a, b in itertools.pairwise(told_at_s(output)[1:-2])]
    assert len(gaps) >= 1
    assert max(gaps) <= 0.15 + 1e-9
    assert output.samples[1].scan.index == FRAME.index
    assert output.samples[1].frame is None


def test_frames_lost_before_a_frame_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_runner, "_HEALTH_EVERY_S", -1.0)
    output = Collector()
    runner([FRAME, renumbered(FRAME, 40)], output, keep_every=True).run(never)
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

    def scan(self, frame: Frame) -> tuple[object, Scan]:
        peaks = self.detect(frame)
        return peaks, demo_scanner().measure(frame.index, frame.time_s, peaks)


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
    end = time.monotonic() + TIMEOUT_S

    def parts() -> dict[str, PartHealth]:
        return {part.name: part for part in good.samples[-1].health.outputs}

    def both_are_told() -> bool:
        # Health comes with every sample; samples go on in silence.
        assert time.monotonic() < end, parts()
        n_frames = sum(s.frame is not None for s in good.samples)
        return n_frames == 3 and parts()["bad"].state is State.FAULT

    steps: list[Step] = [renumbered(FRAME, i) for i in range(3)]
    runner(steps, bad, good, endless=True, keep_every=True).run(both_are_told)
    assert [s.scan.index for s in good.samples if s.frame is not None] == [0, 1, 2]
    assert "nobody there" in parts()["bad"].detail
    assert parts()["good"].state is State.OK
    assert bad.closed


def test_a_slow_output_gets_the_latest_and_delays_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes all the time that twenty frames need for its first one."""
    monkeypatch.setattr(live_runner, "_HEALTH_EVERY_S", -1.0)
    begun, let_go = threading.Event(), threading.Event()

    def slow_down(_n: int) -> None:
        begun.set()
        assert let_go.wait(TIMEOUT_S)

    def follow(n: int) -> None:
        if n == 19:
            let_go.set()

    slow = Collector("slow", inline=False, disturb=slow_down)
    quick = Collector("quick", disturb=follow)
    steps: list[Step] = [renumbered(FRAME, i) for i in range(20)]

    class Late(ScriptedFeed):
        def __iter__(self) -> Iterator[Frame]:
            yield renumbered(FRAME, 0)
            assert begun.wait(TIMEOUT_S)
            yield from super().__iter__()

    LiveRunner(
        Late(steps[1:]),
        ScannerProvider(demo_scanner()),
        [slow, quick],
        LiveOptions(keep_every=True),
    ).run(never)
    measured = [s for s in quick.samples if s.frame is not None]
    assert [s.scan.index for s in measured] == list(range(20))
    assert [s.scan.index for s in slow.samples if s.frame is not None] == [0, 19]
    part = next(p for p in measured[-1].health.outputs if p.name == "slow")
    assert part.n_dropped == 17


def test_an_output_that_keeps_all_loses_nothing_at_the_end() -> None:
    kept = Collector("kept", inline=False, keeps_all=True, disturb=lambda _n: time.sleep(0.02))
    runner([renumbered(FRAME, i) for i in range(30)], kept, keep_every=True).run(never)
    assert [s.scan.index for s in kept.samples] == list(range(30))


def test_a_feed_that_can_never_work_ends_the_run_with_its_reason() -> None:
    fault = LiveRunner(broken_feed(), ScannerProvider(demo_scanner()), []).run(never)
    assert isinstance(fault, SourceError)
    assert "no such camera" in str(fault)


def test_a_feed_that_fails_unexpectedly_is_begun_again() -> None:
    output = Collector()
    steps: list[Step] = [FRAME, ValueError("surprise"), renumbered(FRAME, 1)]
    runner(steps, output, keep_every=True).run(never)
    assert [s.scan.index for s in output.samples if s.frame is not None] == [0, 1]
    between = [s.health.source for s in output.samples if s.frame is None]
    assert any(part.state is State.FAULT and "surprise" in part.detail for part in between)


def test_a_request_to_stop_is_followed_at_once_and_leaves_no_thread() -> None:
    before = set(threading.enumerate())
    output = Collector("waits", inline=False)
    began = time.monotonic()
    runner([FRAME], output, endless=True).run(after(0.3))
    # The feed would go on for twenty seconds.
    assert time.monotonic() - began < 10.0
    assert output.closed
    assert set(threading.enumerate()) == before


def test_health_counts_and_watches_the_lasers(monkeypatch: pytest.MonkeyPatch) -> None:
    output = Collector()
    arrivals = [(0.04 * i, renumbered(FRAME, i)) for i in range(12)]
    run_by_clock(arrivals, output, monkeypatch)
    health = output.samples[-1].health
    assert health.rate_hz == pytest.approx(25.0)
    assert health.valid_share == 1.0
    assert [d.name for d in health.delays] == ["wait", "measure", "send", "total"]
    # The clock moves only while the loop waits for a frame.
    assert all(d.median_s == d.p99_s == 0.0 for d in health.delays)
    assert 0.0 < health.quality <= 1.0
    assert [laser.state for laser in health.lasers] == [State.OK] * len(demo_rig().lasers)
    assert math.isnan(health.sigma_n_water)
    assert health.state is State.OK


def test_the_clock_of_the_system_may_jump(monkeypatch: pytest.MonkeyPatch) -> None:
    jumps = itertools.cycle([10**18, 5 * 10**17, 2 * 10**18])
    monkeypatch.setattr(time, "time_ns", lambda: next(jumps))
    monkeypatch.setattr(live_runner, "_HEALTH_EVERY_S", -1.0)
    output = Collector()
    steps: list[Step] = [renumbered(FRAME, i) for i in range(6)]
    runner(steps, output, keep_every=True).run(never)
    assert len([s for s in output.samples if s.scan.posture]) == 6
    # The jumps are of years.
    assert 0.0 <= output.samples[-1].health.delays[-1].p99_s < TIMEOUT_S


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


def woven_pictures(n: int) -> list[Frame]:
    """Pictures of two fields each, 40 ms apart, from two frames of the dive each."""
    frames = demo_frames(2 * n)
    pictures = []
    for early, late in zip(frames[::2], frames[1::2], strict=True):
        luma = early.luma.copy()
        luma[1::2] = late.luma[1::2]
        chroma = []
        for one, other in zip(early.chroma or (), late.chroma or (), strict=True):
            chroma.append(one.copy())
            chroma[-1][1::2] = other[1::2]
        index, chroma_planes = early.index // 2, (chroma[0], chroma[1])
        pictures.append(Frame(index, early.time_s, luma, chroma_planes, is_interlaced=True))
    return pictures


def test_both_fields_of_a_picture_are_measured_with_their_own_times() -> None:
    scanner = Scanner(replace(demo_rig(), shutter=FIELDS))
    steps: list[Step] = list(woven_pictures(4))
    feed, output = FrameFeed(ScriptedFeed(steps), FIELDS), Collector()
    options = LiveOptions(keep_every=True)
    assert LiveRunner(feed, ScannerProvider(scanner), [output], options).run(never) is None
    assert [sample.scan.index for sample in output.samples] == list(range(8))
    assert sum(bool(sample.scan.posture) for sample in output.samples) >= 7
    for sample, frame in zip(output.samples, demo_frames(8), strict=True):
        assert sample.frame is not None
        assert sample.frame.field == ("top" if frame.index % 2 == 0 else "bottom")
        assert sample.scan.time_s == pytest.approx(frame.time_s)
    for first, second in zip(output.samples[::2], output.samples[1::2], strict=True):
        # Both come with the second; the autopilot is told when each was exposed.
        apart = second.instants.arrived_ns - first.instants.arrived_ns
        assert 0.04e9 <= apart < 0.04e9 + 1e9 * TIMEOUT_S
        assert second.utc_ns - first.utc_ns >= 0.04e9 - 1


def test_the_health_of_a_source_names_fields_that_the_rig_does_not_know() -> None:
    pictures = [replace(one, index=i, time_s=0.4 * i) for i, one in enumerate(woven_pictures(4))]
    for shutter, state in ((AT_ONCE, State.WARN), (FIELDS, State.OK)):
        feed = FrameFeed(ScriptedFeed(list(pictures)), shutter)
        assert feed.health().state is State.OK
        assert len(list(feed)) == (len(pictures) if state is State.WARN else 2 * len(pictures))
        assert feed.health().state is state
        assert ("camera.shutter" in feed.health().detail) == (state is State.WARN)


def test_a_mailbox_has_room_for_both_fields_of_the_latest_picture() -> None:
    box, fields = Mailbox(), list(frames_of(woven_pictures(3), FIELDS))
    for frame in fields[:4]:
        box.put(frame)
    assert box.n_dropped == 2
    taken = [box.take(1.0), box.take(1.0)]
    assert [one.frame.index for one in taken if one] == [2, 3]
    box.put(fields[2])
    box.put(fields[4])
    assert box.n_dropped == 3
    found = box.take(1.0)
    assert found is not None
    assert found.frame.index == 4


def _again(picture: Frame, index: int) -> Frame:
    return replace(picture, index=index, time_s=0.08 * index)


def test_a_still_interlaced_picture_is_noticed_though_its_fields_differ() -> None:
    pictures = woven_pictures(12)
    steps: list[Step] = [*pictures, *(_again(pictures[-1], i) for i in range(12, 32))]
    feed, output = FrameFeed(ScriptedFeed(steps), FIELDS), Collector()
    scanner = ScannerProvider(Scanner(replace(demo_rig(), shutter=FIELDS)))
    LiveRunner(feed, scanner, [output], LiveOptions(keep_every=True)).run(never)
    found = reasons(output)
    assert Reason.FROZEN not in found[:24]
    assert set(found[-10:]) == {Reason.FROZEN}
