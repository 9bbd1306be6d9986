"""`aqualvs live` as users run it: a process of its own, a real stream, faults and every end."""

import contextlib
import json
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from aqualvs.cli.main import main
from aqualvs.control.vehicle import SetpointHolder
from aqualvs.errors import SourceError
from aqualvs.live.command import Console, LiveRequest, make_runner, status_line
from aqualvs.live.runner import ScannerProvider
from aqualvs.optics.rigfile import load_rig
from aqualvs.recording import DiveRecording, is_recording
from aqualvs.results.folder import POSTURE_COLUMNS
from aqualvs.sources.base import Health, PartHealth, State, bgr_of
from aqualvs.sources.opening import open_feed
from complaints import complaints
from live_cases import demo_frames, demo_rig, first_sample
from ports import free_port
from shell_cases import all_key_frames, cut_after
from stream_sender import make_clip, send_here
from waiting import TIMEOUT_S, until

N_CLIP = 36
# A busy machine measures fewer frames than come; what needs this many is sent again until then.
N_AT_LEAST = 10
# A recording grows by so many bytes at a time here: the second time fails.
STEP = 2_000_000
LIMIT = STEP + 1_500_000


def demo_pictures(_size: tuple[int, int], n: int) -> Iterator[Any]:
    frames = demo_frames(N_CLIP)
    for i in range(n):
        yield bgr_of(frames[i % N_CLIP])


def demo_pictures_halved(size: tuple[int, int], n: int) -> Iterator[Any]:
    for image in demo_pictures(size, n):
        yield cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def demo_pictures_frozen(size: tuple[int, int], n: int) -> Iterator[Any]:
    """Half of it moves; then an encoder gets the last picture again and again."""
    *moving, last = demo_pictures(size, n // 2)
    yield from moving
    for _ in range(n - len(moving)):
        yield last


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("clips")
    size, small = demo_rig().size_px, (360, 288)
    # Two slices of the dive, as its range jumps where it begins again.
    return {
        "dive": make_clip(folder / "dive", size, N_CLIP, gop=12, content=demo_pictures),
        "small": make_clip(folder / "small", small, 15, content=demo_pictures_halved),
        "frozen": make_clip(folder / "frozen", size, 100, gop=12, content=demo_pictures_frozen),
    }


@pytest.fixture(scope="module")
def rig_file() -> Path:
    import importlib.resources

    return Path(str(importlib.resources.files("aqualvs") / "data" / "demo" / "rig.yaml"))


@dataclass
class Live:
    """The command under test, and the JSON lines that it sends."""

    process: subprocess.Popen[str]
    port: int
    told: list[str] = field(default_factory=list)
    lines: list[tuple[float, dict[str, Any]]] = field(default_factory=list)

    def wait(self, condition: Callable[[], object], what: str) -> None:
        try:
            until(condition, what)
        except AssertionError as fault:
            raise AssertionError(f"{fault}; it said {self.told[-12:]}") from None

    def send(self, *clips: Path, **options: object) -> None:
        send_here(*clips, port=self.port, **options)

    def send_until(
        self, clip: Path, condition: Callable[[], object], what: str, **options: object
    ) -> None:
        """Send a clip again and again: how many of its frames are measured is up to the machine."""

        def sent() -> object:
            self.send(clip, **options)
            return condition()

        self.wait(sent, what)

    @contextlib.contextmanager
    def sending(self, clip: Path) -> Iterator[None]:
        """Send a clip again and again meanwhile."""
        enough = threading.Event()

        def fill() -> None:
            while not enough.is_set():
                self.send(clip)

        sender = threading.Thread(target=fill)
        sender.start()
        try:
            yield
        finally:
            enough.set()
            sender.join()

    def valid(self, since: float = 0.0) -> list[tuple[float, dict[str, Any]]]:
        return [(at, line) for at, line in list(self.lines) if line["valid"] and at > since]

    def reasons(self, since: float = 0.0) -> list[str]:
        return [line["reason"] for at, line in list(self.lines) if at > since and line["reason"]]

    def end(self, how: signal.Signals) -> int:
        self.process.send_signal(how)
        return self.process.wait(TIMEOUT_S)


@contextlib.contextmanager
def live(rig: Path, *options: str, before: str = "", **process: Any) -> Iterator[Live]:
    """Run the command on a port of its own, after other code, listening to its JSON."""
    port = free_port()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.bind(("127.0.0.1", 0))
        wire.settimeout(0.2)
        json_port = wire.getsockname()[1]
        source = f"udp://127.0.0.1:{port}"
        code = f"{before}\nfrom aqualvs.cli.main import main; exit(main())"
        command = [sys.executable, "-c", code, "live"]
        command += [source, "--rig", str(rig), "--json", f"127.0.0.1:{json_port}", *options]
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **process
        ) as running:
            found = Live(running, port)
            stop = threading.Event()

            def listen() -> None:
                while not stop.is_set():
                    with contextlib.suppress(TimeoutError):
                        line = json.loads(wire.recv(65536))
                        found.lines.append((time.monotonic(), line))

            def read() -> None:
                assert running.stdout is not None
                for text in running.stdout:
                    found.told.append(text.rstrip())

            threads = [threading.Thread(target=listen), threading.Thread(target=read)]
            for thread in threads:
                thread.start()
            try:
                # Silence is told from the start: the command is ready.
                found.wait(lambda: found.lines, "first line")
                yield found
            finally:
                running.kill()
                running.wait()
                stop.set()
                for thread in threads:
                    thread.join()


def test_a_stream_comes_goes_returns_and_the_recording_replays(
    clips: dict[str, Path], rig_file: Path, tmp_path: Path
) -> None:
    options = ["--record", "--record-to", str(tmp_path / "dives"), "--filter"]
    with live(rig_file, *options) as run:
        run.send_until(clips["dive"], lambda: len(run.valid()) >= N_AT_LEAST, "postures")
        run.wait(lambda: "no_frames" in run.reasons(run.valid()[-1][0]), "silence")
        silent_s = run.lines[-1][0]
        run.send_until(clips["dive"], lambda: run.valid(silent_s), "posture after the return")
        run.send_until(clips["small"], lambda: "wrong_size" in run.reasons(), "other size")
        other_s = next(at for at, line in list(run.lines) if line["reason"] == "wrong_size")
        run.send_until(clips["dive"], lambda: run.valid(other_s), "posture after the other size")
        lines = [line for _, line in run.lines]
        assert run.end(signal.SIGTERM) == 0
    assert [line["frame"] for line in lines] == sorted(line["frame"] for line in lines)
    (recording,) = (tmp_path / "dives").glob("*.mcap")
    assert is_recording(recording)
    rows = replayed(recording, tmp_path / "run")
    sent = {line["frame"]: line for line in lines if line["valid"]}
    found = {int(row["frame"]): row for row in rows if row["valid"] == "1"}
    assert set(sent) <= set(found)
    for frame, line in sent.items():
        assert float(found[frame]["range_m"]) == line["range_m"]
        assert float(found[frame]["yaw_deg"]) == line["yaw_deg"]
    assert {row["reason"] for row in rows if row["valid"] == "0"} >= {"wrong_size"}


def replayed(recording: Path, out: Path) -> list[dict[str, str]]:
    assert main(["run", str(recording), "-o", str(out), "--no-report", "--workers", "1"]) == 0
    text = (out / "posture.csv").read_text().splitlines()
    assert tuple(text[0].split(",")) == POSTURE_COLUMNS
    return [dict(zip(POSTURE_COLUMNS, line.split(","), strict=True)) for line in text[1:]]


@pytest.fixture(scope="module")
def plain(rig_file: Path) -> Iterator[Live]:
    """The command without a recording, for several streams one after the other."""
    with live(rig_file) as run:
        yield run
        assert run.end(signal.SIGTERM) == 0


def begun_anew(run: Live) -> float:
    """Wait until nothing is left of the stream before, and return the time."""
    run.wait(lambda: run.lines[-1][1]["reason"] == "no_frames", "silence")
    return run.lines[-1][0]


def test_a_stream_that_repeats_its_picture_has_no_posture(
    clips: dict[str, Path], plain: Live
) -> None:
    since = begun_anew(plain)
    plain.send(clips["frozen"])
    plain.wait(lambda: "frozen" in plain.reasons(since), "the reason")
    numbered = [line for at, line in plain.lines if at > since and line["reason"] != "no_frames"]
    # From the first that was measured.
    lines = [line | {"frame": line["frame"] - numbered[0]["frame"]} for line in numbered]
    # Time stamps run on: by these it is noticed, however few pictures a busy machine measures.
    told = next(line["frame"] for line in lines if line["reason"] == "frozen")
    before = [line for line in lines if line["frame"] < told]
    assert told > 50
    assert before[-1]["frame"] <= 50 + 12
    assert any(line["valid"] for line in before)
    assert not any(line["valid"] for line in lines if line["frame"] > told)


def test_after_a_kill_the_recording_holds_all_but_the_last_moment(
    clips: dict[str, Path], rig_file: Path, tmp_path: Path
) -> None:
    options = ["--record", "--record-to", str(tmp_path / "dives")]
    with live(rig_file, *options) as run, run.sending(clips["dive"]):
        run.wait(lambda: len(run.valid()) >= N_AT_LEAST, "postures")
        frame = run.valid()[-1][1]["frame"]
        (recording,) = (tmp_path / "dives").glob("*.mcap")
        run.wait(lambda: frame in frames_of(recording), "these on the disk")
        run.process.kill()
    rows = replayed(recording, tmp_path / "run")
    assert int(rows[-1]["frame"]) >= frame


def frames_of(recording: Path) -> set[int]:
    """Numbers of the frames in a recording that is still being written."""
    # Not again and again: reading it is work.
    time.sleep(0.2)
    try:
        dive = DiveRecording(recording)
    except SourceError:
        # Its first part is not on the disk yet.
        return set()
    return {frame.index for frame in dive.frames(with_pictures=False)}


def test_a_full_disk_ends_the_recording_and_nothing_else(
    clips: dict[str, Path], rig_file: Path, tmp_path: Path
) -> None:
    def no_more() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT, LIMIT))

    environment = os.environ | {"NUMBA_CACHE_DIR": os.environ.get("NUMBA_CACHE_DIR", "")}
    with live(
        rig_file,
        "--record",
        "--record-video",
        "--record-to",
        str(tmp_path / "dives"),
        before=f"from aqualvs.recording import growing_file; growing_file._DATA_BYTES = {STEP}",
        preexec_fn=no_more,
        env=environment,
    ) as run:
        with run.sending(clips["dive"]):
            # How soon depends on how many frames a busy machine measures, and so records.
            run.wait(lambda: any("recorder: fault" in text for text in run.told), "the fault")
        before = len(run.valid())
        enough = before + N_AT_LEAST
        run.send_until(clips["dive"], lambda: len(run.valid()) >= enough, "postures afterwards")
        assert run.end(signal.SIGINT) == 2
        run.wait(lambda: any("samples lost" in text for text in run.told), "what was lost")
    (recording,) = (tmp_path / "dives").glob("*.mcap")
    assert recording.stat().st_size <= LIMIT
    assert replayed(recording, tmp_path / "run")


def test_five_percent_of_loss_gives_no_false_posture(
    clips: dict[str, Path], plain: Live, rig_file: Path
) -> None:
    since = begun_anew(plain)
    # A lost packet costs all pictures up to the next key frame: few are left, but these are true.
    lossy = {"loss": 0.05, "seed": 3, "repeat": 3}
    plain.send_until(clips["dive"], lambda: len(plain.valid(since)) >= 3, "postures", **lossy)
    ranges = {line["frame"]: line["range_m"] for _, line in plain.valid(since)}
    rig = load_rig(rig_file)
    near, far = rig.working_range
    # The dive goes between these; a stripe patched up from another picture would leave them.
    from aqualvs.scanner import Scanner

    scanner = Scanner(rig)
    true = [p.range for f in demo_frames(N_CLIP) if (p := scanner.process(f).posture)]
    assert min(true) - 0.01 < min(ranges.values())
    assert max(ranges.values()) < max(true) + 0.01
    assert near < min(ranges.values()) < far


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["no_such.mp4"], "no_such.mp4"),
        (["camera:77"], "video77"),
        (["udp://127.0.0.1:1", "--mavlink", "nonsense"], "nonsense"),
        (["udp://127.0.0.1:1", "--dashboard", "--token", "short"], "--token"),
        (["udp://127.0.0.1:1", "--json", "nowhere"], "nowhere"),
    ],
)
def test_what_cannot_work_is_told_in_one_line(
    arguments: list[str],
    words: str,
    rig_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["live", *arguments, "--rig", str(rig_file)]) == 2
    said = capfd.readouterr().err
    # Libraries that open cameras say something of their own.
    (line,) = [text for text in said.splitlines() if text.startswith("aqualvs: error: ")]
    assert words in line
    assert "Traceback" not in said


@pytest.mark.parametrize(
    "options", [["--dashboard", "--token", "abc"], ["--json", "nowhere"], ["--mavlink", "nonsense"]]
)
def test_options_are_checked_before_anything_is_opened(
    options: list[str], rig_file: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    dives = tmp_path / "dives"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.bind(("127.0.0.1", 0))
        autopilot.setblocking(False)
        sent_to = f"udpout:127.0.0.1:{autopilot.getsockname()[1]}"
        outputs = ["--mavlink", sent_to, *options, "--record", "--record-to", str(dives)]
        assert main(["live", "udp://127.0.0.1:1", "--rig", str(rig_file), *outputs]) == 2
        with pytest.raises(BlockingIOError):
            autopilot.recv(1000)
    assert "recording:" not in capfd.readouterr().out
    assert not dives.exists()


def test_a_part_that_cannot_be_made_leaves_no_recording(rig_file: Path, tmp_path: Path) -> None:
    dives, missing = tmp_path / "dives", tmp_path / "target.yaml"
    record = ["--record", "--record-to", str(dives)]
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        for options in (["--index-target", str(missing)], ["--dashboard-address", address]):
            command = ["live", "udp://127.0.0.1:1", "--rig", str(rig_file), *options, *record]
            assert main(command) == 2
            assert not dives.exists()


def test_a_video_that_is_cut_short_is_told_in_one_line(
    rig_file: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """At its end; until then its frames are measured."""
    content = bgr_of(demo_frames(1)[0])
    cut = all_key_frames(
        tmp_path / "cut.mp4", 6, size=demo_rig().size_px, content=lambda *_: content
    )
    cut_after(cut, 4)
    assert main(["live", str(cut), "--rig", str(rig_file), "--fast"]) == 2
    said = capfd.readouterr()
    (line,) = complaints(said.err)
    assert line.startswith("aqualvs: error: ")
    assert "cut short" in line
    assert said.out == "4 frames measured, 4 with a posture\n"


def test_the_line_of_the_terminal_shows_a_sigma_below_a_millimetre() -> None:
    line = status_line(first_sample())
    said = (
        r"range 0\.\d{3} m ± 0\.\d mm  yaw \+1\d\.\d ± 0\.\d\d deg  pitch -6\.\d ± 0\.\d\d deg  \|"
    )
    assert re.match(said, line)


def test_the_log_tells_a_fault_of_another_cause_once(capsys: pytest.CaptureFixture[str]) -> None:
    console = Console()
    for detail in ("waiting for 2 s", "waiting for 3.5 s", "not H.264", "not H.264"):
        source = PartHealth("udp", State.FAULT, detail)
        console.send(replace(first_sample(), health=replace(Health(), source=source)))
    assert capsys.readouterr().err == "udp: fault: waiting for 2 s\nudp: fault: not H.264\n"


def test_a_stop_while_getting_ready_leaves_no_recording(rig_file: Path, tmp_path: Path) -> None:
    def stop() -> ScannerProvider:
        raise KeyboardInterrupt

    rig, dives = load_rig(rig_file), tmp_path / "dives"
    request = LiveRequest(
        feed=lambda: open_feed("udp://127.0.0.1:0", realtime=True),
        rig=rig_file,
        record=True,
        record_to=dives,
    )
    with pytest.raises(KeyboardInterrupt):
        make_runner(request, rig, stop, SetpointHolder(rig.working_range), print)
    assert not dives.exists()


def test_the_log_tells_a_part_that_is_well_again(capsys: pytest.CaptureFixture[str]) -> None:
    console, sample = Console(), first_sample()
    for state, detail in ((State.FAULT, "the disk is full"), (State.OK, "")):
        health = Health(outputs=(PartHealth("follow log", state, detail),))
        console.send(replace(sample, health=health))
    said = capsys.readouterr().err
    assert said == "follow log: fault: the disk is full\nfollow log: ok\n"


def test_memory_and_handles_stay_flat_over_a_long_run(tmp_path: Path) -> None:
    """As fast as they go, every frame through every cheap output, JSON and recorder included.

    160 frames; AQUALVS_SOAK_FRAMES=90000 makes it an hour of a stream of 25 frames a second.
    """
    n_frames = int(os.environ.get("AQUALVS_SOAK_FRAMES", "160"))
    from aqualvs.control.time_filter import PostureFilter
    from aqualvs.live.outputs.udp_json import UdpJsonOutput, receiver_address
    from aqualvs.live.runner import LiveOptions, LiveRunner, ScannerProvider
    from aqualvs.recording import RecorderSwitch
    from live_cases import Collector, ScriptedFeed, demo_scanner, renumbered

    frames = demo_frames(N_CLIP)
    sizes: list[tuple[int, int]] = []

    def look(n: int) -> None:
        if n % (n_frames // 8) == 0:
            # What waits for the disk depends on how busy that is.
            recorder = switch._recorder
            until(lambda: recorder is not None and not recorder._waiting_bytes, "an idle recorder")
            sizes.append((_resident_kb(), len(os.listdir("/proc/self/fd"))))
            print(n, *sizes[-1])

    class Looks(Collector):
        def send(self, sample: Any) -> None:
            self.at_s.append(float(sample.scan.index))
            look(len(self.at_s))

    class Endless(ScriptedFeed):
        def __iter__(self) -> Iterator[Any]:
            return (renumbered(frames[i % N_CLIP], i) for i in range(n_frames))

    feed = Endless([])
    switch = RecorderSwitch(tmp_path)
    switch.start()
    outputs = [Looks(), UdpJsonOutput([receiver_address("127.0.0.1:9")]), switch]
    LiveRunner(
        feed,
        ScannerProvider(demo_scanner()),
        outputs,
        LiveOptions(keep_every=True),
        PostureFilter(),
    ).run(lambda: False)
    memory, handles = np.array(sizes).T
    assert len(memory) == 8
    assert set(handles[2:]) == {handles[2]}
    # After warming up: no growth that would make 100 MB an hour, but for what the recorder may
    # have waiting for the disk at one moment or the other.
    hours = 5 / 8 * n_frames / 90_000
    assert memory[-1] - memory[2] < 100_000 * hours + 12_000


def _resident_kb() -> int:
    text = Path("/proc/self/status").read_text()
    return int(text.split("VmRSS:")[1].split()[0])
