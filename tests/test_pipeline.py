"""The body of `aqualvs run`, with a scanner whose answer is the grey level of the frame."""

import csv
import json
import signal
import threading
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import yaml
from pyarrow import parquet

from aqualvs.errors import AqualvsError, OptionError, OutputError, SourceError
from aqualvs.optics.water import seawater_index_vacuum
from aqualvs.pipeline import run, summary_lines
from aqualvs.report.run_page import write_report
from aqualvs.results.run_request import (
    FrameWindow,
    RunRequest,
    Water,
    prepared_rig,
    scanner_options,
)
from aqualvs.results.summary import compare_with_truth
from aqualvs.scanner import Scanner, ScannerOptions
from aqualvs.sources import open_source
from aqualvs.terminal import StopSignals
from rerun_stand_in import replace_sdk
from shell_cases import (
    SIZE,
    LumaScanner,
    all_key_frames,
    cut_after,
    destroy_frame,
    luma_level,
    picture,
    rig_file,
    write_video,
)


@pytest.fixture(scope="module")
def dive(tmp_path_factory):
    return write_video(tmp_path_factory.mktemp("dive") / "dive.mp4", 8)


@pytest.fixture
def request_for(tmp_path):
    def make(source, **more):
        rig = rig_file(tmp_path)
        return RunRequest(
            source=str(source), rig=rig, out=tmp_path / "out", **{"report": False, **more}
        )

    return make


def rows(folder):
    return list(csv.DictReader((folder / "posture.csv").read_text().splitlines()))


def run_file(folder):
    return yaml.safe_load((folder / "run.yaml").read_text())


def test_every_frame_is_measured_and_written(request_for, dive):
    request = request_for(dive)
    result = run(request, scanner_for=LumaScanner(dark=60))
    assert (result.exit_code, result.fault, result.report) == (0, None, None)
    found = rows(request.out)
    assert [int(row["frame"]) for row in found] == list(range(8))
    assert [float(row["time_s"]) for row in found] == pytest.approx([i / 25 for i in range(8)])
    refused = [luma_level(i) < 60 for i in range(8)]
    assert [row["reason"] for row in found] == ["no_stripes" if r else "" for r in refused]
    for i, row in enumerate(found):
        if not refused[i]:
            # Lossy video keeps a flat grey to within a few levels; the scanner divides by 100.
            assert float(row["range_m"]) == pytest.approx(luma_level(i) / 100, abs=0.04)
    assert parquet.read_table(request.out / "points.parquet").num_rows == 8 * 60
    assert result.summary.n_valid == 8 - sum(refused)


def test_a_scanner_with_a_process_of_its_own_is_asked(request_for, dive):
    class Late(Scanner):
        def process(self, frame):
            scan = super().process(frame)
            return replace(scan, time_s=scan.time_s + 1.0)

    request = request_for(dive)
    run(request, scanner_for=Late)
    expected = [1.0 + i / 25 for i in range(8)]
    assert [float(row["time_s"]) for row in rows(request.out)] == pytest.approx(expected)


def test_the_run_file_tells_source_rig_and_options(request_for, dive):
    request = request_for(dive, scanner=scanner_options("net", "threshold", "paper", "robust"))
    run(request, scanner_for=LumaScanner())
    content = run_file(request.out)
    assert content["status"] == "finished"
    assert content["source"]["path"] == str(dive)
    assert content["source"]["size_bytes"] == dive.stat().st_size
    assert content["source"]["n_frames"] == 8
    assert content["rig"] == yaml.safe_load(request.rig.read_text())
    scanner = content["options"]["scanner"]
    assert scanner["target"] == "net"
    assert scanner["detector"]["kind"] == "threshold"
    assert scanner["mesh_filter"]["rd_theta"] > 0
    json.dumps(content)


def test_a_video_of_two_tracks_says_which_is_measured(request_for, tmp_path):
    path = tmp_path / "two.mkv"
    with av.open(str(path), "w") as container:
        streams = [container.add_stream("ffv1", rate=25) for _ in range(2)]
        for stream in streams:
            stream.width, stream.height = SIZE
        for i in range(3):
            for stream in streams:
                frame = av.VideoFrame.from_ndarray(picture(i), format="bgr24")
                container.mux(stream.encode(frame))
        for stream in streams:
            container.mux(stream.encode(None))
    request = request_for(path)
    result = run(request, scanner_for=LumaScanner())
    assert len(rows(request.out)) == 3
    (told,) = [line for line in summary_lines(request, result) if "warning" in line]
    assert told.startswith("warning: the video holds 2 tracks, the first is measured")


def test_a_lost_frame_has_its_row(request_for, tmp_path):
    path = all_key_frames(tmp_path / "a.mp4", 8)
    for i in (0, 3, 4):
        destroy_frame(path, i)
    request = request_for(path, overlay=True)
    result = run(request, scanner_for=LumaScanner())
    found = rows(request.out)
    assert [int(row["frame"]) for row in found] == list(range(8))
    assert [row["reason"] for row in found] == [
        "corrupt_frame" if i in (0, 3, 4) else "" for i in range(8)
    ]
    assert [float(row["time_s"]) for row in found] == pytest.approx([i / 25 for i in range(8)])
    assert result.summary.refused == {"corrupt_frame": 3}
    # The overlay keeps every frame's number; the lost ones are black.
    with open_source(request.out / "overlay.mp4") as source:
        levels = [float(frame.luma[250:300].mean()) for frame in source]
    assert len(levels) == 8
    assert levels[3] == pytest.approx(16, abs=3)
    assert levels[5] == pytest.approx(luma_level(5), abs=6)


def test_a_truncated_dive_is_complete_up_to_its_end(request_for, tmp_path):
    path = all_key_frames(tmp_path / "a.mp4", 8)
    cut_after(path, 5)
    request = request_for(path, report=True)
    result = run(request, scanner_for=LumaScanner())
    assert isinstance(result.fault, SourceError)
    assert "only 5 of 8 frames" in str(result.fault)
    assert len(rows(request.out)) == 5
    assert parquet.read_table(request.out / "points.parquet").num_rows == 5 * 60
    assert run_file(request.out)["status"] == "failed"
    assert "only 5 of 8" in run_file(request.out)["error"]
    assert result.report.is_file()
    assert any("5 frames" in line for line in summary_lines(request, result))


def test_only_the_frames_asked_for_are_measured(request_for, dive):
    request = request_for(dive, frames=FrameWindow.parse("2:5"))
    run(request, scanner_for=LumaScanner())
    assert [row["frame"] for row in rows(request.out)] == ["2", "3", "4"]


def test_images_are_a_dive(request_for, tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for i in range(3):
        cv2.imwrite(str(folder / f"a{i}.png"), picture(i))
    request = request_for(folder, fps=5.0)
    run(request, scanner_for=LumaScanner())
    assert [float(row["time_s"]) for row in rows(request.out)] == pytest.approx([0, 0.2, 0.4])
    assert run_file(request.out)["source"]["path"] == str(folder)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_after_the_current_frame(request_for, dive, number):
    def ask_to_stop(frame):
        if frame.index == 3:
            signal.raise_signal(number)

    before = signal.getsignal(number)
    request = request_for(dive)
    result = run(request, scanner_for=LumaScanner(after=ask_to_stop))
    assert result.exit_code == 128 + number
    assert result.stopped_by == number.name
    assert len(rows(request.out)) == 4
    assert run_file(request.out)["status"] == "interrupted"
    assert parquet.read_table(request.out / "points.parquet").num_rows == 4 * 60
    assert signal.getsignal(number) is before


@pytest.fixture
def interruptible():
    """SIGINT interrupts Python, as usual; what a script starts in the background ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_the_second_signal_is_not_caught():
    with StopSignals() as stop:
        signal.raise_signal(signal.SIGINT)
        assert stop.caught is signal.SIGINT
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_outside_of_the_main_thread_no_signal_is_caught():
    seen = []

    def work():
        with StopSignals() as stop:
            seen.append(stop.exit_code)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [0]


def test_a_fault_in_the_scanner_leaves_a_complete_folder(request_for, dive):
    def fail(frame):
        if frame.index == 2:
            raise ZeroDivisionError("odd")

    request = request_for(dive)
    with pytest.raises(ZeroDivisionError):
        run(request, scanner_for=LumaScanner(after=fail))
    assert len(rows(request.out)) == 2
    assert run_file(request.out)["status"] == "failed"
    assert parquet.read_table(request.out / "points.parquet").num_rows == 2 * 60


def test_memory_stays_flat(request_for, tmp_path, monkeypatch):
    """Python's own and NumPy's allocations do not grow with the number of frames."""
    import tracemalloc

    # What waits for its row group is bounded: here by ten frames.
    monkeypatch.setattr("aqualvs.results.points._ROWS_PER_GROUP", 600)
    path = write_video(tmp_path / "long.mp4", 60)
    traced = []

    def measure(frame):
        if frame.index in (10, 55):
            traced.append(tracemalloc.get_traced_memory()[0])

    tracemalloc.start()
    try:
        run(request_for(path), scanner_for=LumaScanner(after=measure))
    finally:
        tracemalloc.stop()
    # A frame's points alone are 60 x 100 bytes; 45 frames kept would be 270 kB.
    assert traced[1] - traced[0] < 100_000


@pytest.mark.parametrize(
    ("change", "kind", "words"),
    [
        ({"source": "missing.mp4"}, SourceError, "no such file"),
        ({"frames": FrameWindow(100)}, OptionError, "no such frames"),
        ({"water": Water(n_water=1.34, salinity=35.0)}, OptionError, "not both"),
        ({"water": Water(salinity=35.0)}, OptionError, "--temperature-c: missing"),
        ({"water": Water(temperature_c=10.0)}, OptionError, "--salinity: missing"),
        ({"fps": 5.0}, OptionError, "own clock"),
        ({"rerun": Path("dive.mcap")}, OptionError, "--rerun dive.mcap: give a file that ends in"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(request_for, dive, change, kind, words):
    request = replace(request_for(dive), **change)
    with pytest.raises(kind, match=words) as fault:
        run(request, scanner_for=LumaScanner())
    assert "\n" not in str(fault.value)
    assert not request.out.exists()


def test_a_file_of_rerun_has_every_frame(request_for, dive, tmp_path, monkeypatch):
    streams = replace_sdk(monkeypatch)
    request = request_for(dive, rerun=tmp_path / "out" / "dive.rrd")
    run(request, scanner_for=LumaScanner())
    (stream,) = streams
    assert (stream.place, stream.closed) == (request.rerun, 1)
    ranges = stream.at("posture/range_m", "Scalars")
    assert [when["frame"] for when, _ in ranges] == list(range(8))
    assert stream.at("target/vehicle/camera/picture", "EncodedImage")
    before = (request.out / "posture.csv").read_bytes()
    with pytest.raises(OutputError, match=r"dive.rrd: exists; .* --overwrite"):
        run(replace(request, out=tmp_path / "other"), scanner_for=LumaScanner())
    run(replace(request, overwrite=True), scanner_for=LumaScanner())
    assert (request.out / "posture.csv").read_bytes() == before
    # What somebody else has put there stays.
    request.rerun.write_bytes(b"mine")
    with pytest.raises(OutputError, match="has changed since"):
        run(replace(request, overwrite=True), scanner_for=LumaScanner())
    assert request.rerun.read_bytes() == b"mine"


def test_pictures_of_another_size_are_refused(request_for, tmp_path):
    small = write_video(tmp_path / "small.mp4", 3, size=(96, 64))
    request = request_for(small)
    with pytest.raises(SourceError, match="96x64 px, but the rig 'example' has 720x576 px"):
        run(request, scanner_for=LumaScanner())
    assert not request.out.exists()


def test_an_existing_run_is_refused_and_kept(request_for, dive):
    request = request_for(dive)
    run(request, scanner_for=LumaScanner())
    before = (request.out / "posture.csv").read_bytes()
    with pytest.raises(OutputError, match="--overwrite"):
        run(replace(request, frames=FrameWindow(0, 2)), scanner_for=LumaScanner())
    assert (request.out / "posture.csv").read_bytes() == before
    run(replace(request, frames=FrameWindow(0, 2), overwrite=True), scanner_for=LumaScanner())
    assert len(rows(request.out)) == 2


@pytest.mark.parametrize(
    ("text", "window"), [(":", (0, None)), ("3:", (3, None)), (":7", (0, 7)), ("3:7", (3, 7))]
)
def test_windows_are_understood(text, window):
    assert FrameWindow.parse(text) == FrameWindow(*window)


@pytest.mark.parametrize("text", ["", "3", "a:b", "7:3", "3:3", "-1:3", "1:2:3"])
def test_other_windows_are_refused(text):
    with pytest.raises(OptionError, match="--frames"):
        FrameWindow.parse(text)


def test_the_water_reaches_the_rig(tmp_path):
    path = rig_file(tmp_path)
    plain = prepared_rig(path, Water(), no_dome=False)
    assert plain.dome is not None
    assert prepared_rig(path, Water(n_water=1.341), no_dome=False).n_water == 1.341
    sea = prepared_rig(path, Water(temperature_c=12.0, salinity=38.0), no_dome=False)
    assert sea.n_water == pytest.approx(seawater_index_vacuum(12.0, 38.0, n_air=plain.n_air))
    assert prepared_rig(path, Water(), no_dome=True).dome is None


def test_default_words_mean_default_options():
    assert scanner_options("auto", "ridge", "none", "robust") == ScannerOptions()


def write_csv(path, header, *lines):
    path.write_text("\n".join([header, *lines]) + "\n")
    return path


@pytest.mark.parametrize(("column", "unit"), [("range_m", 1.0), ("range_mm", 1000.0)])
def test_the_error_against_the_truth(tmp_path, column, unit):
    posture = write_csv(
        tmp_path / "posture.csv",
        "frame,valid,range_m,pitch_deg,yaw_deg",
        "0,1,0.505,1.0,-2.0",
        "1,1,1.000,4.0,0.0",
        "2,0,,,",
        "9,1,1.0,0,0",
    )
    truth = write_csv(
        tmp_path / "truth.csv",
        f"frame,{column},pitch_deg,yaw_deg,medium",
        f"0,{0.5 * unit},0.0,-2.0,water",
        f"1,{1.0 * unit},1.0,0.5,water",
        f"2,{1.0 * unit},1.0,0.5,water",
        "9,,,,water",
    )
    found = compare_with_truth(posture, truth)
    assert (found.n_compared, found.n_missed) == (2, 1)
    assert found.range_percent.max == pytest.approx(1.0)
    assert found.range_percent.rms == pytest.approx(np.sqrt(0.5))
    assert found.pitch_deg.rms == pytest.approx(np.sqrt(5.0))
    assert found.pitch_deg.max == pytest.approx(3.0)
    assert found.yaw_deg.max == pytest.approx(0.5)
    assert "rms 0.707 %" in "\n".join(found.lines())


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "cannot be read"),
        ("", "no rows"),
        ("a,b\n1,2\n", "no column frame"),
        ("frame,pitch_deg,yaw_deg\n0,0,0\n", "no column range_m"),
        ("frame,range_m,pitch_deg,yaw_deg\n77,1,0,0\n", "covers 1 frame, none of them in"),
        ("frame\0,range_m", "no rows"),
    ],
)
def test_a_truth_that_cannot_be_used_is_said(tmp_path, content, words):
    posture = write_csv(
        tmp_path / "posture.csv", "frame,valid,range_m,pitch_deg,yaw_deg", "0,1,0.505,1.0,-2.0"
    )
    truth = tmp_path / "truth.csv"
    if content is not None:
        truth.write_text(content)
    with pytest.raises(AqualvsError, match=words) as fault:
        compare_with_truth(posture, truth)
    assert str(truth) in str(fault.value)


def test_a_dive_without_any_posture_is_compared_too(tmp_path):
    posture = write_csv(
        tmp_path / "posture.csv", "frame,valid,range_m,pitch_deg,yaw_deg", "0,0,,,", "1,0,,,"
    )
    truth = write_csv(
        tmp_path / "truth.csv", "frame,range_m,pitch_deg,yaw_deg", "0,0.5,0,0", "1,0.6,0,0"
    )
    found = compare_with_truth(posture, truth)
    assert (found.n_compared, found.n_missed) == (0, 2)
    assert found.lines() == ["against the truth: no posture in its 2 frames"]


def test_a_run_compares_with_its_truth(request_for, dive, tmp_path):
    lines = [f"{i},{10 * luma_level(i)},3.0,-7.0" for i in range(8)]
    truth = write_csv(tmp_path / "truth.csv", "frame,range_mm,pitch_deg,yaw_deg", *lines)
    result = run(request_for(dive, truth=truth, report=True), scanner_for=LumaScanner())
    assert result.comparison.n_compared == 8
    assert result.comparison.yaw_deg.max < 1e-4
    # A grey level that lossy video misses by 2 of at least 30 is 7 percent.
    assert result.comparison.range_percent.max < 10
    assert "Error against truth" in result.report.read_text(encoding="utf-8")
    # As a later `aqualvs report` or `net` writes it.
    assert "Error against truth" in write_report(result.report.parent).read_text(encoding="utf-8")


def test_a_truth_without_a_posture_compares_nothing(request_for, dive, tmp_path):
    truth = write_csv(tmp_path / "truth.csv", "frame,range_mm,pitch_deg,yaw_deg", "0,,,", "1,,,")
    result = run(request_for(dive, truth=truth, report=True), scanner_for=LumaScanner())
    assert result.comparison.lines() == [
        "against the truth: it states no posture in any of its frames"
    ]
    assert result.report.is_file()


def test_the_truth_of_another_dive_does_not_cost_the_report(request_for, dive, tmp_path):
    truth = write_csv(tmp_path / "truth.csv", "frame,range_mm,pitch_deg,yaw_deg", "99,500,0,0")
    request = request_for(dive, truth=truth, report=True)
    with pytest.raises(AqualvsError, match="covers 1 frame, none of them in"):
        run(request, scanner_for=LumaScanner())
    assert "no frame in common" in (request.out / "report.html").read_text(encoding="utf-8")
