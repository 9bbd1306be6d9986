"""`aqualvs follow` as users run it: a process of its own that steers the fake vehicle."""

import contextlib
import csv
import importlib.resources
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from aqualvs.app.follow import FOLLOW_CSV
from aqualvs.live.colour import bgr_of
from aqualvs.live.recorder import DiveRecording, is_recording
from live_cases import demo_frames, demo_rig
from shell_cases import write_video
from waiting import PATIENCE_S

pytest.importorskip("pymavlink")

from fake_ardusub_cases import Fake, is_neutral, until

# As the installed command ends; the interpreter's own `exit` would wait for the keys.
COMMAND = (sys.executable, "-c", "import sys; from aqualvs.app.cli import main; sys.exit(main())")


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty seconds before a net that stands still, at 0.47 m."""
    image = bgr_of(demo_frames(40)[-1])
    path = tmp_path_factory.mktemp("clip") / "still.mp4"
    options = {"preset": "ultrafast", "crf": "18"}
    write_video(
        path, 500, size=demo_rig().size_px, options=options, content=lambda _i, _size: image
    )
    return path


@dataclass
class Follow:
    """The command under test, its terminal and its keys."""

    process: subprocess.Popen[str]
    told: list[str] = field(default_factory=list)

    def wait(self, words: str, n_before: int = 0) -> None:
        until(lambda: any(words in line for line in self.told[n_before:]), words, PATIENCE_S)

    def press(self) -> str:
        """Press Enter; return the answer."""
        assert self.process.stdin is not None
        n = len(self.told)
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        until(lambda: len(self.told) > n, "an answer", PATIENCE_S)
        return self.told[n]

    def engage(self) -> None:
        """Press Enter until the vehicle has been heard."""
        end = time.monotonic() + PATIENCE_S
        while (answer := self.press()) != "engaged":
            assert "not engaged" in answer
            assert time.monotonic() < end
            time.sleep(0.2)


@contextlib.contextmanager
def follow(fake: Fake, source: Path, out: Path, *options: str) -> Iterator[Follow]:
    rig = importlib.resources.files("aqualvs") / "data" / "demo" / "rig.yaml"
    command = [*COMMAND, "follow", str(source), "--rig", str(rig), "--mavlink", fake.url]
    command += ["--gains", "bluerov2", "-o", str(out), *options]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        found = Follow(process)

        def read() -> None:
            assert process.stdout is not None
            for line in process.stdout:
                found.told.append(line.rstrip())

        reader = threading.Thread(target=read)
        reader.start()
        try:
            found.wait("disengaged: Enter engages")
            yield found
        finally:
            process.kill()
            reader.join()


def sticks(fake: Fake, since: float = 0.0) -> list[dict[str, Any]]:
    return [message["fields"] for message in fake.steered(since) if not is_neutral(message)]


def test_steers_by_a_video_until_told_to_end(clip: Path, tmp_path: Path) -> None:
    fake = Fake("--lapse", "0.5")
    try:
        with follow(fake, clip, tmp_path, "--range", "0.9", "--yaw", "20", "--record") as one:
            time.sleep(0.3)
            assert not fake.steered()
            one.engage()
            until(lambda: len(sticks(fake)) > 20, "efforts")
            told = sticks(fake)
            # Too close: back. The net's far normal is left of where it shall be: turn to the left.
            # Noise pushes too, of the first steps most of all where a busy machine holds frames up.
            assert all(fields["x"] < 50 and fields["r"] < 50 for fields in told)
            assert told[-1]["x"] < 0
            assert told[-1]["r"] < 0
            assert {(fields["y"], fields["z"], fields["buttons"]) for fields in told} == {
                (0, 500, 0)
            }
            assert one.press() == "disengaged"
            until(lambda: all(map(is_neutral, fake.steered()[-3:])), "neutral")
            one.engage()
            again = time.monotonic()
            until(lambda: len(sticks(fake, again)) > 3, "efforts again")
            one.process.send_signal(signal.SIGTERM)
            assert one.process.wait(PATIENCE_S) == 0
        ended = time.monotonic()
        until(lambda: len(fake.steered()) > 3 and is_neutral(fake.steered()[-1]), "neutral")
        time.sleep(0.2)
        assert all(map(is_neutral, fake.steered()[-3:]))
        assert not fake.steered(ended + 0.2)
        assert {m["kind"] for m in fake.wire} == {
            "DISTANCE_SENSOR",
            "HEARTBEAT",
            "MANUAL_CONTROL",
            "NAMED_VALUE_FLOAT",
            "PARAM_REQUEST_READ",
        }
        distances = [m["fields"] for m in fake.wire if m["kind"] == "DISTANCE_SENSOR"]
        # The net of the clip is at 0.47 m.
        assert {d["orientation"] for d in distances} == {0}
        assert any(45 <= d["current_distance"] <= 49 for d in distances)
    finally:
        fake.stop()
    assert_logged(tmp_path / FOLLOW_CSV)
    (recorded,) = tmp_path.glob("*.mcap")
    assert is_recording(recorded)
    frames = list(DiveRecording(recorded).frames(with_pictures=False))
    assert len(frames) > 20


def test_a_vehicle_file_says_who_steers(clip: Path, tmp_path: Path) -> None:
    fake = Fake("--lapse", "0.5")
    fake.play(parameters={"MAV_GCS_SYSID": 250.0}, station_id=250)
    file = tmp_path / "vehicle.yaml"
    try:
        with follow(fake, clip, tmp_path) as one:
            until(
                lambda: "set MAV_GCS_SYSID 255, or ground_station 250" in one.press(),
                "the reason why not",
                PATIENCE_S,
            )
        file.write_text("aqualvs_vehicle: 1\nground_station: 250\n", encoding="utf-8")
        with follow(fake, clip, tmp_path, "--vehicle-file", str(file)) as one:
            one.engage()
            until(lambda: fake.steered(), "efforts")
            assert {message["system"] for message in fake.steered()} == {250}
    finally:
        fake.stop()


def assert_logged(path: Path) -> None:
    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    engaged = [row for row in rows if row["engaged"] == "1"]
    assert 20 < len(engaged) < len(rows)
    assert {row["mode"] for row in engaged} == {"ALT_HOLD"}
    assert {row["range_setpoint_m"] for row in engaged} == {"0.9000"}
    assert min(float(row["forward"]) for row in engaged) < 0.0
    # It begins at neutral, at the range it finds; noise is all that pushes then.
    assert max(float(row["forward"]) for row in rows) < 0.05
    assert {row["forward"] for row in rows if row["engaged"] == "0"} == {"0.0000"}
