"""`aqualvs run` on a recording: the same numbers, to the last digit, or others on demand."""

import csv
import importlib.resources
import re
import statistics
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from pyarrow import parquet

from aqualvs.cli.main import main
from aqualvs.errors import OptionError, OutputError, SourceError
from aqualvs.optics.rigfile import load_rig, save_rig
from aqualvs.optics.shutter import Shutter, ShutterKind
from aqualvs.pipeline import run
from aqualvs.recording import DiveRecording, PictureFormat, Recorder, RecorderOptions, Recording
from aqualvs.recording.encoding import TOPICS
from aqualvs.recording.messages import stripes_message, stripes_of
from aqualvs.results.run_request import FrameWindow, RunRequest, Water
from aqualvs.scanner import Scanner, ScannerOptions
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.scanning.scan import GyroRates, Scan, ScanPoints
from aqualvs.scanning.stripe import ThresholdOptions
from aqualvs.scanning.target import TargetKind
from live_cases import demo_rig, demo_samples
from repository import ROOT
from whole import WHOLE

FEW = FrameWindow(0, 12)
# Of the bundled dive.
N = 150 if WHOLE else 110


@pytest.fixture(scope="module")
def demo():
    folder = importlib.resources.files("aqualvs") / "data" / "demo"
    with importlib.resources.as_file(folder) as path:
        yield Path(path)


@pytest.fixture(scope="module")
def whole(demo, tmp_path_factory):
    """A run of the bundled dive, with its recording."""
    out = tmp_path_factory.mktemp("whole") / "out"
    again(demo / "dive.mp4", out, demo / "rig.yaml", mcap=True, frames=FrameWindow(0, N))
    return out


@pytest.fixture(scope="module")
def pictured(tmp_path_factory):
    """A recording of a few frames with their pictures."""
    path = tmp_path_factory.mktemp("pictured") / "dive.mcap"
    recording = Recording(path, RecorderOptions(pictures=PictureFormat.PNG))
    for sample in demo_samples(12):
        recording.write(sample)
    recording.close()
    return path


def again(source, out, rig=None, **more):
    return run(RunRequest(source=str(source), rig=rig, out=out, **{"report": False, **more}))


def same_results(left, right):
    assert (left / "posture.csv").read_bytes() == (right / "posture.csv").read_bytes()
    assert (left / "posture_bare.csv").read_bytes() == (right / "posture_bare.csv").read_bytes()
    tables = [parquet.read_table(folder / "points.parquet") for folder in (left, right)]
    assert len(tables[0]) > 1000
    assert tables[0].equals(tables[1])
    return True


def rows(out):
    return list(csv.DictReader((out / "posture.csv").read_text().splitlines()))


def test_a_recorded_run_replays_bit_for_bit(whole, tmp_path):
    result = again(whole / "dive.mcap", tmp_path / "out")
    assert result.summary.n_frames == N
    assert same_results(whole, tmp_path / "out")
    said = yaml.safe_load((tmp_path / "out" / "run.yaml").read_text())
    assert said["options"]["rig_file"] is None
    first = yaml.safe_load((whole / "run.yaml").read_text())
    assert said["rig"] == first["rig"]


def test_stripes_of_recordings_before_pulls_were_measured_have_none():
    (sample,) = demo_samples(1)
    message = stripes_message(sample, 0)
    peaks = stripes_of(message).peaks
    pulls = {axis: found.pull for axis, found in sample.peaks.items()}
    assert len(peaks) == 2
    for axis, found in peaks.items():
        np.testing.assert_array_equal(found.pull, pulls[axis])
        assert np.count_nonzero(found.pull) > 0.5 * found.n
    # Their number, aligned to 8 bytes, the numbers, and no gyros (4 bytes).
    old = stripes_of(message[: -8 * (1 + sum(found.n for found in peaks.values())) - 4])
    assert old.turning is None
    for axis, found in old.peaks.items():
        np.testing.assert_array_equal(found.position, peaks[axis].position)
        np.testing.assert_array_equal(found.pull, np.zeros(found.n))


@pytest.mark.parametrize("column", ["position", "height", "width", "likelihood", "pull"])
def test_stripes_with_columns_of_different_lengths_are_not_understood(column):
    (sample,) = demo_samples(1)
    axis, found = next(iter(sample.peaks.items()))
    cut = found._replace(**{column: getattr(found, column)[1:]})
    with pytest.raises(ValueError, match=f"{found.n} peaks|pulls"):
        stripes_of(stripes_message(replace(sample, peaks={**sample.peaks, axis: cut}), 0))


def test_gyros_are_recorded_and_used_again(demo, tmp_path):
    shutter = Shutter(kind=ShutterKind.ROLLING, readout=0.02)
    rig = replace(load_rig(demo / "rig.yaml"), shutter=shutter)
    turning = GyroRates(np.deg2rad([15.0, 0.0, -20.0]), np.deg2rad(2.0))
    sample = demo_samples(1)[0]
    for name, known in (("with", turning), ("without", None)):
        recording = Recording(tmp_path / f"{name}.mcap", RecorderOptions())
        recording.write(replace(sample, rig=rig, scan=replace(sample.scan, turning=known)))
        recording.close()
        again(tmp_path / f"{name}.mcap", tmp_path / name)
    (kept,) = DiveRecording(tmp_path / "with.mcap").frames(with_pictures=False)
    np.testing.assert_array_equal(kept.turning.rates, turning.rates)
    assert kept.turning.sigma == turning.sigma
    (found,), (without,) = rows(tmp_path / "with"), rows(tmp_path / "without")
    assert float(found["sigma_yaw_deg"]) < 0.7 * float(without["sigma_yaw_deg"])
    assert found["yaw_deg"] != without["yaw_deg"]


def test_the_same_rig_from_its_file_gives_the_same(whole, demo, tmp_path):
    again(whole / "dive.mcap", tmp_path / "out", demo / "rig.yaml", mcap=True, frames=FEW)
    assert rows(tmp_path / "out") == rows(whole)[:12]
    again(tmp_path / "out" / "dive.mcap", tmp_path / "third")
    assert same_results(tmp_path / "out", tmp_path / "third")


def test_what_the_live_recorder_kept_replays_bit_for_bit(whole, demo, tmp_path):
    """As a live run hands samples on, with a frame that it skipped, and a silence."""
    path = tmp_path / "live.mcap"
    recorder = Recorder(path)
    for sample in demo_samples(12):
        if sample.scan.index != 5:
            recorder.send(sample)
    recorder.close()
    again(path, tmp_path / "out")
    expected = [row for row in rows(whole)[:12] if row["frame"] != "5"]
    assert rows(tmp_path / "out") == expected


def test_another_rig_measures_the_same_stripes_anew(whole, demo, tmp_path):
    rig = load_rig(demo / "rig.yaml")
    moved = replace(rig, lasers=tuple(_moved(laser) for laser in rig.lasers))
    save_rig(moved, tmp_path / "moved.yaml")
    again(whole / "dive.mcap", tmp_path / "replay", tmp_path / "moved.yaml", frames=FEW)
    again(demo / "dive.mp4", tmp_path / "video", tmp_path / "moved.yaml", frames=FEW)
    ranges = [float(row["range_m"]) for row in rows(tmp_path / "replay")]
    expected = [float(row["range_m"]) for row in rows(tmp_path / "video")]
    before = [float(row["range_m"]) for row in rows(whole)[:12]]
    # The bands that stripes are looked for in moved a little too.
    assert ranges == pytest.approx(expected, rel=1e-3)
    assert max(abs(a - b) for a, b in zip(ranges, before, strict=True)) > 3e-3


def _moved(laser):
    return replace(laser, plane=replace(laser.plane, offset=laser.plane.offset * 1.01))


def test_another_water_is_as_for_the_video(whole, demo, tmp_path):
    water = {"water": Water(n_water=1.36)}
    again(whole / "dive.mcap", tmp_path / "replay", frames=FEW, **water)
    again(demo / "dive.mp4", tmp_path / "video", demo / "rig.yaml", frames=FEW, **water)
    both = _valid_in_both(tmp_path / "replay", tmp_path / "video", whole)
    assert both
    for found, expected, before in both:
        assert found == pytest.approx(expected, rel=1e-3)
        assert abs(found - before) > 1e-4


def test_no_dome_is_mostly_as_for_the_video(whole, demo, tmp_path):
    again(whole / "dive.mcap", tmp_path / "replay", no_dome=True)
    window = FrameWindow(0, N)
    again(demo / "dive.mp4", tmp_path / "video", demo / "rig.yaml", no_dome=True, frames=window)
    # Without its dome the rig refuses most frames, for the lasers disagree. Its bands are others
    # than those the recording's stripes were looked for in, so a plane found by few readings may
    # be another.
    both = _valid_in_both(tmp_path / "replay", tmp_path / "video", whole)
    assert len(both) >= 2
    off = [abs(found / expected - 1.0) for found, expected, _ in both]
    assert statistics.median(off) < 1e-3
    assert all(abs(found - before) > 1e-4 for found, _, before in both)


def _valid_in_both(replay, video, whole):
    """Ranges of the frames that both accept, and those of the first run."""
    return [
        (float(found["range_m"]), float(expected["range_m"]), float(before["range_m"]))
        for found, expected, before in zip(rows(replay), rows(video), rows(whole), strict=False)
        if found["valid"] == expected["valid"] == "1"
    ]


def test_the_water_that_the_run_followed_is_followed_again(tmp_path):
    path = tmp_path / "dive.mcap"
    recording = Recording(path, RecorderOptions())
    expected = []
    for i, sample in enumerate(demo_samples(6)):
        scanner = Scanner(demo_rig().in_water(1.3333 if i < 3 else 1.345))
        scan = scanner.measure(i, sample.scan.time_s, sample.peaks)
        recording.write(replace(sample, rig=scanner.rig, scan=scan))
        expected.append((f"{scan.posture.range:.6f}", f"{scan.n_water:.6f}"))
    recording.close()
    again(path, tmp_path / "out")
    assert [(row["range_m"], row["n_water"]) for row in rows(tmp_path / "out")] == expected
    again(path, tmp_path / "fixed", water=Water(n_water=1.3333))
    assert {row["n_water"] for row in rows(tmp_path / "fixed")} == {"1.333300"}


def test_frames_that_were_lost_stay_lost(demo, tmp_path):
    path = tmp_path / "dive.mcap"
    samples = demo_samples(4)
    again(demo / "dive.mp4", tmp_path / "video", demo / "rig.yaml", frames=FEW, mcap=True)
    recording = DiveRecording(tmp_path / "video" / "dive.mcap")
    assert recording.n_frames == 12
    scan = Scan(1, 0.04, Refusal(Reason.CORRUPT_FRAME), ScanPoints.none(), 1.3333)
    lost = replace(samples[1], scan=scan, peaks={}, frame=None)
    kept = Recording(path, RecorderOptions())
    for sample in (samples[0], lost, samples[2]):
        kept.write(sample)
    kept.close()
    again(path, tmp_path / "out")
    assert [(row["valid"], row["reason"]) for row in rows(tmp_path / "out")] == [
        ("1", ""),
        ("0", "corrupt_frame"),
        ("1", ""),
    ]


def test_another_detector_looks_at_the_pictures(pictured, demo, tmp_path):
    options = ScannerOptions(detector=ThresholdOptions(level=120))
    again(pictured, tmp_path / "replay", scanner=options)
    again(demo / "dive.mp4", tmp_path / "video", demo / "rig.yaml", frames=FEW, scanner=options)
    assert same_results(tmp_path / "video", tmp_path / "replay")


def test_a_recording_without_pictures_says_so(whole, tmp_path):
    options = ScannerOptions(detector=ThresholdOptions())
    with pytest.raises(OptionError, match=r"--detector: .*dive\.mcap does not hold"):
        again(whole / "dive.mcap", tmp_path / "out", scanner=options)
    with pytest.raises(OptionError, match=r"--index-target: .*does not hold"):
        again(whole / "dive.mcap", tmp_path / "out", index_target=tmp_path / "target.yaml")
    assert not (tmp_path / "out").exists()


def test_the_recorded_options_hold_unless_others_are_asked_for(tmp_path):
    path = tmp_path / "dive.mcap"
    solid = ScannerOptions(target=TargetKind.SOLID)
    scanner = Scanner(demo_rig(), solid)
    recording = Recording(path, RecorderOptions(scanner=solid))
    for sample in demo_samples(4):
        scan = scanner.measure(sample.scan.index, sample.scan.time_s, sample.peaks)
        recording.write(replace(sample, scan=scan))
    recording.close()
    for given, target in (
        ([], "solid"),
        (["--target", "auto"], "auto"),
        (["--fit", "robust"], "solid"),
    ):
        out = tmp_path / "-".join([target, *given])
        assert main(["run", str(path), "-o", str(out), "--no-report", *given]) == 0
        said = yaml.safe_load((out / "run.yaml").read_text())["options"]["scanner"]
        assert said["target"] == target


def test_other_sources_need_a_rig(demo, tmp_path, capsys):
    assert main(["run", str(demo / "dive.mp4"), "-o", str(tmp_path / "out")]) == 2
    assert "--rig: missing; give the rig file" in capsys.readouterr().err


def test_a_recording_has_its_own_clock(whole, tmp_path):
    with pytest.raises(OptionError, match=r"--fps: .*dive\.mcap has its own clock"):
        again(whole / "dive.mcap", tmp_path / "out", fps=5.0)


def test_a_run_never_removes_what_it_reads(whole, tmp_path):
    before = (whole / "dive.mcap").read_bytes()
    with pytest.raises(OptionError, match="is what the run reads; write to another folder"):
        again(whole / "dive.mcap", whole, overwrite=True)
    assert (whole / "dive.mcap").read_bytes() == before


def test_an_old_recording_goes_with_its_run(demo, tmp_path):
    out = tmp_path / "out"
    few = {"rig": demo / "rig.yaml", "frames": FrameWindow(0, 2)}
    again(demo / "dive.mp4", out, mcap=True, **few)
    with pytest.raises(OutputError, match="exists; choose another place"):
        again(demo / "dive.mp4", out, mcap=True, **few)
    again(demo / "dive.mp4", out, overwrite=True, **few)
    assert not (out / "dive.mcap").exists()


def test_files_that_are_no_recordings_get_one_line(tmp_path):
    path = tmp_path / "dive.mcap"
    path.write_bytes(b"no mcap at all")
    with pytest.raises(SourceError, match="no MCAP file"):
        DiveRecording(path)
    with pytest.raises(SourceError, match="no such file"):
        DiveRecording(tmp_path / "none.mcap")
    Recording(tmp_path / "empty.mcap", RecorderOptions()).close()
    with pytest.raises(SourceError, match="holds no stripes"):
        DiveRecording(tmp_path / "empty.mcap")


def test_the_guide_names_what_there_is():
    guide = (ROOT / "docs" / "recording.md").read_text()
    for topic in TOPICS:
        assert f"`{topic.name}`" in guide
        assert f"`{topic.kind}`" in guide
    for name in re.findall(r"`(points_hz|sync_s|\w+_hz|\w+_s)`", guide):
        assert hasattr(RecorderOptions(), name)
