"""The offset between dive and log: found where the motion tells it, refused where it does not."""

import math
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from aqualvs.vehicle_logs import (
    Interpolation,
    OffsetRefusal,
    PostureTrack,
    Signal,
    TimeOffset,
    VehicleLog,
    dive_start_utc,
    find_time_offset,
    offset_from_clocks,
    read_vehicle_log,
)
from whole import WHOLE

OFFSET_S = 123.456
FPS = 25.0


def wandering(rng: np.random.Generator, duration_s: float, rms_deg: float) -> np.ndarray:
    """An angle at 50 Hz that turns as vehicles do: most within periods of 3 to 30 s."""
    n = round(50.0 * duration_s)
    frequency = np.fft.rfftfreq(n, 0.02)
    size = np.where(frequency > 0.02, 1.0 / (1.0 + (frequency / 0.15) ** 2), 0.0)
    waves = rng.normal(size=(2, len(frequency)))
    angle = np.fft.irfft(size * (waves[0] + 1j * waves[1]), n)
    scaled: np.ndarray = np.radians(rms_deg / angle.std()) * angle
    return scaled


def swell(rng: np.random.Generator, duration_s: float, width: float) -> np.ndarray:
    """Like `wandering`, but all of one period: 5 s."""
    n = round(50.0 * duration_s)
    frequency = np.fft.rfftfreq(n, 0.02)
    size = np.exp(-0.5 * ((frequency - 0.2) / (0.2 * width)) ** 2)
    waves = rng.normal(size=(2, len(frequency)))
    angle = np.fft.irfft(size * (waves[0] + 1j * waves[1]), n)
    scaled: np.ndarray = np.radians(3.0 / angle.std()) * angle
    return scaled


def dive(
    rng: np.random.Generator,
    heading: np.ndarray,
    pitch: np.ndarray,
    *,
    dive_s: float = 120.0,
    offset_s: float = OFFSET_S,
    share: float = 1.0,
    dropped: float = 0.2,
    wrong: float = 0.01,
    log_hz: float = 10.0,
) -> tuple[VehicleLog, PostureTrack]:
    """Return log and posture of one motion given at 50 Hz.

    Posture has 0.4 degrees of noise a frame, lost stretches and wrong targets; the net's bearing
    swings by 15 degrees in 40 s. The heading has 0.5 degrees of noise and drifts by 1.2 degrees a
    minute.
    """
    true_s = np.arange(len(heading)) / 50.0
    log_s = np.arange(0.0, true_s[-1], 1.0 / log_hz)
    noisy = np.interp(log_s, true_s, heading) + np.radians(0.02) * log_s
    noisy = noisy + np.radians(0.5) * rng.normal(size=len(log_s))
    nodding = np.interp(log_s, true_s, pitch) + np.radians(0.1) * rng.normal(size=len(log_s))
    log = VehicleLog(
        name="log",
        kind="csv",
        heading=Signal.from_samples(log_s, np.mod(noisy + 6.0, 2 * np.pi), Interpolation.BEARING),
        pitch=Signal.from_samples(log_s, nodding, Interpolation.ANGLE),
    )
    time_s = np.arange(0.0, dive_s, 1.0 / FPS)
    noise = np.radians(0.4) * rng.normal(size=(2, len(time_s)))
    bearing = np.radians(15.0) * np.sin(2.0 * np.pi * time_s / 40.0)
    yaw = bearing - share * np.interp(time_s + offset_s, true_s, heading) + noise[0]
    lean = -np.interp(time_s + offset_s, true_s, pitch) + noise[1]
    valid = np.ones(len(time_s), bool)
    while dropped and valid.mean() > 1.0 - dropped:
        start = int(rng.integers(len(time_s)))
        valid[start : start + int(FPS * rng.exponential(2.0))] = False
    strange = rng.random(len(time_s)) < wrong
    yaw[strange] += np.radians(rng.uniform(-40.0, 40.0, int(strange.sum())))
    yaw[~valid] = np.nan
    return log, PostureTrack(time_s, yaw, lean, valid)


def usual(
    rng: np.random.Generator, rms_deg: float = 4.0, **how: float
) -> tuple[VehicleLog, PostureTrack]:
    motion = wandering(rng, 500.0, rms_deg), wandering(rng, 500.0, rms_deg / 5.0)
    return dive(rng, motion[0], motion[1], **how)


def is_offset(found: TimeOffset | OffsetRefusal) -> TimeOffset:
    assert isinstance(found, TimeOffset), found
    return found


def test_offset_and_its_sigma_hold_over_many_dives() -> None:
    """At our posture's noise; sigma must neither promise too much nor hide what is known."""
    rng = np.random.default_rng(2)
    found = [is_offset(find_time_offset(*usual(rng, 2.0))) for _ in range(30 if WHOLE else 20)]
    errors = np.array([one.offset_s - OFFSET_S for one in found])
    scores = errors / np.array([one.sigma_s for one in found])
    assert np.abs(errors).max() < 0.06
    # The mean square of 30 normal scores lies in (0.5, 1.7) with 99.5 %, of 20 in (0.3, 2.1); the
    # rest is for tails that are not quite normal.
    assert 0.45 < np.mean(scores**2) < 2.0
    # No bias: the mean of 20 is known to 0.22 sigma.
    assert abs(scores.mean()) < 0.7


@pytest.mark.parametrize(
    "how",
    [
        {"share": 0.4},
        {"log_hz": 1.0},
        {"log_hz": 50.0},
        {"dropped": 0.5, "wrong": 0.05},
        {"offset_s": -60.0, "dive_s": 200.0},
        {"offset_s": 430.0, "dive_s": 200.0},
    ],
    ids=["net turns along", "slow log", "fast log", "lost and wrong", "dive first", "log ends"],
)
def test_offset_survives(how: dict[str, float]) -> None:
    rng = np.random.default_rng(4)
    found = is_offset(find_time_offset(*usual(rng, **how)))
    assert abs(found.offset_s - how.get("offset_s", OFFSET_S)) < max(0.05, 4.0 * found.sigma_s)
    assert found.sigma_s < 0.05
    assert found.correlation is not None
    assert found.correlation > 0.7


def test_the_sign_of_yaw_matters() -> None:
    """Posture that turned with the heading would be no net that stands still."""
    rng = np.random.default_rng(5)
    log, track = usual(rng)
    turned = PostureTrack(track.time_s, -track.yaw, -track.pitch, track.valid)
    assert find_time_offset(log, track)
    assert not find_time_offset(log, turned)


def test_a_false_start_does_not_mislead() -> None:
    """The camera ran on deck first: a minute of postures that are none."""
    rng = np.random.default_rng(6)
    log, track = usual(rng, dive_s=180.0)
    early = track.time_s < 60.0
    yaw = np.where(early, np.radians(20.0) * rng.normal(size=len(early)), track.yaw)
    found = is_offset(
        find_time_offset(log, PostureTrack(track.time_s, yaw, track.pitch, track.valid))
    )
    assert abs(found.offset_s - OFFSET_S) < 0.1


def test_heading_alone_and_pitch_alone_suffice() -> None:
    rng = np.random.default_rng(7)
    log, track = usual(rng)
    for bare in (
        VehicleLog(name="log", kind="csv", heading=log.heading),
        VehicleLog(name="log", kind="csv", pitch=log.pitch),
    ):
        assert abs(is_offset(find_time_offset(bare, track)).offset_s - OFFSET_S) < 0.1


@pytest.mark.parametrize("width", [0.3, 0.1])
def test_a_swell_is_told_from_its_neighbours(width: float) -> None:
    rng = np.random.default_rng(8)
    heading = swell(rng, 500.0, width)
    found = is_offset(find_time_offset(*dive(rng, heading, 0.0 * heading)))
    assert abs(found.offset_s - OFFSET_S) < 0.05


def test_motion_that_repeats_itself_is_refused_unless_clocks_help() -> None:
    rng = np.random.default_rng(9)
    heading = np.radians(3.0) * np.sin(2.0 * np.pi * np.arange(25000) / 50.0 / 12.0)
    log, track = dive(rng, heading, 0.0 * heading)
    alone = find_time_offset(log, track)
    assert isinstance(alone, OffsetRefusal)
    assert not alone
    assert "explain the motion almost equally well" in alone.reason
    start = TimeOffset(OFFSET_S + 0.8, 0.5, None, "clocks of dive and log")
    found = is_offset(find_time_offset(log, track, start=start))
    # A single slow wave tells the time far less well than motion of all periods.
    assert abs(found.offset_s - OFFSET_S) < 4.0 * found.sigma_s < 1.0
    assert "the clocks agree" in found.how


def test_clocks_that_are_wrong_are_overruled_by_clear_motion() -> None:
    rng = np.random.default_rng(10)
    start = TimeOffset(OFFSET_S - 3600.0, 5.0, None, "clocks of dive and log")
    found = is_offset(find_time_offset(*usual(rng), start=start))
    assert abs(found.offset_s - OFFSET_S) < 0.05
    assert "the clocks are not to be trusted (-3600.0 s off)" in found.how


def turning(rng: np.random.Generator, duration_s: float) -> np.ndarray:
    """A course with few turns, all of much the same shape."""
    time_s = np.arange(0.0, duration_s, 0.02)
    course = np.zeros(len(time_s))
    for middle in rng.uniform(0.0, duration_s, round(duration_s / 30.0)):
        late = np.clip((time_s - middle) / rng.uniform(0.5, 1.5), -50.0, 50.0)
        course += np.radians(rng.uniform(-60.0, 60.0)) / (1.0 + np.exp(-late))
    return course


@pytest.mark.parametrize(
    "motion",
    [
        lambda rng: wandering(rng, 500.0, 4.0),
        lambda rng: swell(rng, 500.0, 0.1),
        lambda rng: swell(rng, 500.0, 0.01),
        lambda rng: turning(rng, 500.0),
    ],
    ids=["wandering", "swell", "narrow swell", "turns"],
)
def test_a_log_of_another_dive_is_refused(
    motion: Callable[[np.random.Generator], np.ndarray],
) -> None:
    rng = np.random.default_rng(12)
    for _ in range(12 if WHOLE else 6):
        still = np.zeros(25000)
        log, _ = dive(rng, motion(rng), still)
        _, track = dive(rng, motion(rng), still)
        found = find_time_offset(log, track)
        assert isinstance(found, OffsetRefusal), found


def test_a_vehicle_that_does_not_move_is_refused() -> None:
    rng = np.random.default_rng(13)
    still = np.zeros(25000)
    found = find_time_offset(*dive(rng, still, still))
    assert isinstance(found, OffsetRefusal)
    # Without noise, nothing at all correlates.
    time_s = np.arange(0.0, 100.0, 0.1)
    bare = VehicleLog(name="log", kind="csv", heading=Signal.from_samples(time_s, 0.0 * time_s))
    track = PostureTrack(time_s, 0.0 * time_s, 0.0 * time_s, np.ones(len(time_s), bool))
    found = find_time_offset(bare, track)
    assert isinstance(found, OffsetRefusal)
    assert "no common motion" in found.reason


def test_too_little_to_compare_is_refused_with_its_reason() -> None:
    rng = np.random.default_rng(14)
    log, track = usual(rng)
    few = track.time_s < 20.0
    short = PostureTrack(track.time_s[few], track.yaw[few], track.pitch[few], track.valid[few])
    none = PostureTrack(track.time_s, track.yaw, track.pitch, np.zeros(len(few), bool))
    one = PostureTrack(np.zeros(1), np.zeros(1), np.zeros(1), np.ones(1, bool))
    bare = VehicleLog(name="log.csv", kind="csv", depth=log.heading)
    weeks = Signal.from_samples([0.0, 1e6], [0.0, 1.0])
    for which, posture, words in (
        (log, short, "share at most"),
        (log, one, "share at most 0 s"),
        (log, none, "no valid posture"),
        (bare, track, "log.csv holds neither heading nor pitch"),
        (VehicleLog(name="log.csv", kind="csv", heading=weeks), track, "log.csv covers 278 hours"),
    ):
        found = find_time_offset(which, posture)
        assert isinstance(found, OffsetRefusal)
        assert words in found.reason
    with pytest.raises(ValueError, match="give one length"):
        PostureTrack(np.zeros(2), np.zeros(1), np.zeros(1), np.ones(1, bool))


@pytest.mark.samples
def test_real_motion_is_recognised(samples: Path) -> None:
    """Heading and pitch of a real vehicle at the surface, seen from a net with our noise."""
    log = read_vehicle_log(samples / "ardusub-logs" / "small.tlog")
    assert log.heading is not None
    assert log.pitch is not None
    rng = np.random.default_rng(15)
    time_s = np.arange(0.0, 90.0, 1.0 / FPS)
    noise = np.radians(0.4) * rng.normal(size=(2, len(time_s)))
    for offset_s in (10.0, 87.7, 150.3):
        when = time_s + offset_s
        yaw = 3.0 - np.interp(when, log.heading.time_s, np.unwrap(log.heading.values)) + noise[0]
        pitch = -np.interp(when, log.pitch.time_s, log.pitch.values) + noise[1]
        found = is_offset(
            find_time_offset(log, PostureTrack(time_s, yaw, pitch, np.ones(len(time_s), bool)))
        )
        assert abs(found.offset_s - offset_s) < 0.03
        assert found.sigma_s < 0.02


def test_clocks_give_a_start_with_its_doubt() -> None:
    log = VehicleLog(name="log", kind="csv", start_utc_s=1000.0, start_utc_sigma_s=2.0)
    offset = is_offset(offset_from_clocks(log, 1100.0, 5.0))
    assert offset.offset_s == 100.0
    assert offset.sigma_s == pytest.approx(math.hypot(5.0, 2.0))
    assert offset.correlation is None
    assert not offset_from_clocks(log, None)
    assert not offset_from_clocks(VehicleLog(name="log", kind="csv"), 1100.0)


def video(path: Path, stamp: str | None) -> Path:
    with av.open(str(path), "w") as container:
        if stamp is not None:
            container.metadata["creation_time"] = stamp
        stream = container.add_stream("mpeg4", rate=Fraction(25))
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
        frame = av.VideoFrame.from_ndarray(np.zeros((64, 64, 3), np.uint8), "rgb24")
        for packet in [*stream.encode(frame), *stream.encode(None)]:
            container.mux(packet)
    return path


def test_a_video_tells_when_it_was_created(tmp_path: Path) -> None:
    stated = video(tmp_path / "a.mp4", "2026-05-31T12:00:00Z")
    assert dive_start_utc(stated) == 1780228800.0
    assert dive_start_utc(video(tmp_path / "b.mp4", None)) is None
    # A camera whose clock was never set.
    assert dive_start_utc(video(tmp_path / "c.mp4", "1970-01-01T00:00:05Z")) is None
    (tmp_path / "d.mp4").write_bytes(b"no video")
    assert dive_start_utc(tmp_path / "d.mp4") is None
    assert dive_start_utc(tmp_path / "missing.mp4") is None
