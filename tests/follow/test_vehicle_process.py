"""`aqualvs follow` as users run it: a process of its own that steers the fake vehicle."""

import contextlib
import csv
import importlib.resources
import json
import signal
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from aqualvs.follow.command import FOLLOW_CSV
from aqualvs.recording import DiveRecording, is_recording
from aqualvs.sources.base import bgr_of
from live_cases import demo_frames, demo_rig
from ports import free_port
from repository import HELPERS
from shell_cases import write_video
from waiting import TIMEOUT_S, until

pytest.importorskip("pymavlink")

from fake_ardusub_cases import Fake, is_neutral
from stream_sender import make_clip

SENDER = HELPERS / "stream_sender.py"
# As the installed command ends; the interpreter's own `exit` would wait for the keys.
COMMAND = (sys.executable, "-c", "import sys; from aqualvs.cli.main import main; sys.exit(main())")


FPS = 25
# The noise of a camera repeats after so many pictures, and clips begin again at a multiple.
N_NOISE = 11
N_FRAMES, N_STILL = 5 * N_NOISE, 3 * FPS


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    """A net that stands still at 0.47 m, with the noise of a camera."""
    image, rng = bgr_of(demo_frames(40)[-1]), np.random.default_rng(4)
    noise = (rng.normal(0.0, 3.0, image.shape) for _ in range(N_NOISE))
    return [np.clip(image + one, 0, 255).astype(np.uint8) for one in noise]


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory, pictures: list[np.ndarray]) -> Path:
    """Before it for longer than anything is waited for: the same pictures again and again."""
    folder = tmp_path_factory.mktemp("clip")
    short = write_video(
        folder / "short.mp4",
        N_FRAMES,
        size=demo_rig().size_px,
        options={"preset": "ultrafast", "crf": "23"},
        content=lambda i, _size: pictures[i % len(pictures)],
    )
    path = folder / "live.mp4"
    with av.open(str(short)) as source, av.open(str(path), "w") as container:
        stream = container.add_stream_from_template(source.streams.video[0])
        packets = [packet for packet in source.demux(video=0) if packet.size]
        assert packets[0].is_keyframe
        for i in range(round(TIMEOUT_S * FPS)):
            packet = av.Packet(bytes(packets[i % N_FRAMES]))
            packet.stream, packet.time_base = stream, Fraction(1, FPS)
            packet.pts = packet.dts = i
            packet.is_keyframe = packets[i % N_FRAMES].is_keyframe
            container.mux(packet)
    return path


@pytest.fixture(scope="module")
def freezing(tmp_path_factory: pytest.TempPathFactory, pictures: list[np.ndarray]) -> Path:
    """Before it, as a stream; then an encoder gets one picture again and again."""

    def content(_size: tuple[int, int], n: int) -> Iterator[np.ndarray]:
        return (pictures[min(i, N_FRAMES - 1) % len(pictures)] for i in range(n))

    path = tmp_path_factory.mktemp("clip") / "freezing"
    return make_clip(path, demo_rig().size_px, N_FRAMES + N_STILL, content=content)


@dataclass
class Follow:
    """The command under test, its terminal and its keys."""

    process: subprocess.Popen[str]
    told: list[str] = field(default_factory=list)

    def wait(self, words: str, n_before: int = 0) -> None:
        until(lambda: any(words in line for line in self.told[n_before:]), words, TIMEOUT_S)

    def press(self) -> str:
        """Press Enter; return the answer."""
        assert self.process.stdin is not None
        n = len(self.told)
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        until(lambda: len(self.told) > n, "an answer", TIMEOUT_S)
        return self.told[n]

    def engage(self) -> None:
        """Press Enter until the vehicle has been heard."""
        end = time.monotonic() + TIMEOUT_S
        while (answer := self.press()) != "engaged":
            assert "not engaged" in answer
            assert time.monotonic() < end
            time.sleep(0.2)


@contextlib.contextmanager
def follow(fake: Fake, source: Path | str, out: Path, *options: str) -> Iterator[Follow]:
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
            # Noise pushes too, and frames that a busy machine holds up make single steps large.
            assert statistics.median(fields["x"] for fields in told) < 0
            assert statistics.median(fields["r"] for fields in told) < 0
            assert {(fields["y"], fields["z"], fields["buttons"]) for fields in told} == {
                (0, 500, 0)
            }
            assert one.press() == "disengaged"
            until(lambda: all(map(is_neutral, fake.steered()[-3:])), "neutral")
            one.engage()
            again = time.monotonic()
            until(lambda: len(sticks(fake, again)) > 3, "efforts again")
            one.process.send_signal(signal.SIGTERM)
            assert one.process.wait(TIMEOUT_S) == 0
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
        with follow(fake, clip, tmp_path / "refused") as one:
            until(
                lambda: "set MAV_GCS_SYSID 255, or ground_station 250" in one.press(),
                "the reason why not",
                TIMEOUT_S,
            )
        file.write_text("aqualvs_vehicle: 1\nground_station: 250\n", encoding="utf-8")
        with follow(fake, clip, tmp_path / "obeyed", "--vehicle-file", str(file)) as one:
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
    # It begins at neutral, at the range it finds; noise is all that pushes then, and single steps
    # are large where a busy machine holds frames up: half of them are small.
    forward = sorted(float(row["forward"]) for row in rows)
    assert forward[len(forward) // 2] < 0.05
    assert {row["forward"] for row in rows if row["engaged"] == "0"} == {"0.0000"}


def test_a_picture_that_stands_still_ends_the_thrust(freezing: Path, tmp_path: Path) -> None:
    fake = Fake("--lapse", "0.5")
    try:
        port = free_port()
        source = f"udp://127.0.0.1:{port}"
        with follow(fake, source, tmp_path, "--range", "0.9") as one:
            one.engage()
            sender = [sys.executable, str(SENDER), str(freezing), "--port", str(port)]
            with subprocess.Popen(
                [*sender, "--again", str(N_FRAMES)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            ) as stream:
                try:
                    until(lambda: len(sticks(fake)) > 20, "efforts")
                    told, _ = stream.communicate("\n", timeout=TIMEOUT_S)
                finally:
                    stream.kill()
            n_sent = json.loads(told.splitlines()[-1])["frames"]
            one.process.send_signal(signal.SIGTERM)
            one.process.wait(TIMEOUT_S)
    finally:
        fake.stop()
    with (tmp_path / FOLLOW_CSV).open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    pushed = [float(row["frame_time_s"]) for row in rows if float(row["forward"]) != 0.0]
    frozen_from_s = (n_sent - N_STILL) / FPS
    assert pushed[0] < frozen_from_s
    # By the stream's clock. A busy machine skips frames, and the stream's usual noise is then known
    # later; tests/control/test_safety_answer.py has the half second.
    assert pushed[-1] <= frozen_from_s + 1.0
    frozen = [row for row in rows if float(row["frame_time_s"]) > frozen_from_s + 1.0]
    assert {row["posture"] for row in frozen} <= {"frozen", "no_frames"}
    assert "frozen" in {row["reason"] for row in frozen}
