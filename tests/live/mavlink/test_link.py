"""MAVLink against a real peer in another process: messages, lost links, stalls, leaks."""

import contextlib
import itertools
import json
import math
import os
import queue
import signal
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aqualvs.live.mavlink import link as mavlink_link
from aqualvs.live.mavlink import ports as mavlink_ports
from aqualvs.live.mavlink.link import LinkOptions, MavlinkLink
from aqualvs.live.outputs.mavlink import MavlinkOutput
from aqualvs.recording.sample import LiveSample
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.sources.base import State
from live_cases import first_sample
from ports import free_port
from repository import HELPERS
from waiting import TIMEOUT_S, until

pytest.importorskip("pymavlink")

# No call may wait for the other side, which would take a quarter of a second at least; a busy
# machine holds up some calls, but not half of them for so long.
CALL_S = 0.05


def without_posture() -> LiveSample:
    scan = replace(first_sample().scan, posture=Refusal(Reason.NO_FRAMES))
    return replace(first_sample(), scan=scan)


class Peer:
    """The other process."""

    def __init__(self, url: str, *options: str) -> None:
        script = HELPERS / "mavlink_peer.py"
        self.process = subprocess.Popen(
            [sys.executable, str(script), url, *options], stdout=subprocess.PIPE, text=True
        )
        self._lines: queue.Queue[dict[str, Any]] = queue.Queue()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        self.port = int(self._lines.get(timeout=TIMEOUT_S)["port"])

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with contextlib.suppress(json.JSONDecodeError):
                self._lines.put(json.loads(line))

    def wait_for(self, kind: str, **fields: object) -> dict[str, Any]:
        """Return the next message of a kind with such fields."""
        end = time.monotonic() + TIMEOUT_S
        while (left := end - time.monotonic()) > 0:
            with contextlib.suppress(queue.Empty):
                found = self._lines.get(timeout=left)
                told = found["fields"]
                if told["mavpackettype"] == kind and fields.items() <= told.items():
                    return found
        raise AssertionError(f"no {kind} with {fields}")

    def kinds_during(self, seconds: float) -> list[str]:
        """Return the kinds of all messages of the next seconds."""
        self.forget()
        time.sleep(seconds)
        return [entry["fields"]["mavpackettype"] for entry in self.forget()]

    def forget(self) -> list[dict[str, Any]]:
        found = []
        with contextlib.suppress(queue.Empty):
            while True:
                found.append(self._lines.get_nowait())
        return found

    def stop(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait(TIMEOUT_S)
        self._reader.join(TIMEOUT_S)
        if self.process.stdout is not None:
            self.process.stdout.close()


class Lab:
    """Makes peers and outputs, and cleans up after a test."""

    def __init__(self) -> None:
        self._stack = contextlib.ExitStack()

    def peer(self, url: str, *options: str) -> Peer:
        peer = Peer(url, *options)
        self._stack.callback(peer.stop)
        return peer

    def output(self, url: str) -> MavlinkOutput:
        output = MavlinkOutput(url)
        self._stack.callback(output.close)
        return output

    def close(self) -> None:
        self._stack.close()


@pytest.fixture
def lab() -> Iterator[Lab]:
    """Peers and outputs that end with the test, which must leave no thread and no file behind."""
    threads, files = threading.active_count(), open_files()
    made = Lab()
    try:
        yield made
    finally:
        made.close()
    assert threading.active_count() == threads
    assert open_files() == files


def open_files() -> int:
    folder = Path("/proc/self/fd")
    return len(os.listdir(folder)) if folder.is_dir() else 0


def becomes(output: MavlinkOutput, state: State, words: str) -> None:
    def reached() -> bool:
        found = output.health()
        return found.state is state and words in found.detail

    try:
        until(reached, f"{state} {words!r}")
    except AssertionError as fault:
        raise AssertionError(f"{fault}; health is {output.health()}") from None


def stream(output: MavlinkOutput, condition: Callable[[], object], what: str) -> list[float]:
    """Send samples until something happens, ten at least; return how long each call took."""
    sample = first_sample()
    took: list[float] = []

    def sent() -> object:
        start = time.perf_counter()
        output.send(sample)
        took.append(time.perf_counter() - start)
        return condition() and len(took) >= 10

    until(sent, what)
    return took


def test_the_autopilot_gets_what_was_measured(lab: Lab) -> None:
    peer = lab.peer("udpin:127.0.0.1:0")
    output = lab.output(f"udpout:127.0.0.1:{peer.port}")
    beat = peer.wait_for("HEARTBEAT")
    # MAVLink 2 begins with 0xFD. 18 is an onboard controller, 8 says that it is no autopilot.
    assert (beat["magic"], beat["system"], beat["component"]) == (0xFD, 1, 191)
    assert (beat["fields"]["type"], beat["fields"]["autopilot"]) == (18, 8)
    becomes(output, State.OK, "autopilot sysid 1 ArduSub seen 0.")

    sample = first_sample()
    assert sample.scan.posture
    # The rig of the bundled dive is exact: its part, 2 cm, is put in by hand.
    posture = replace(sample.scan.posture, rig_covariance=np.diag([4e-4, 0.0, 0.0]))
    output.send(replace(sample, scan=replace(sample.scan, posture=posture)))
    found = peer.wait_for("DISTANCE_SENSOR")["fields"]
    assert found["current_distance"] == round(100 * posture.range)
    assert (found["min_distance"], found["max_distance"]) == (29, 101)
    # 0 is a laser that looks forward; the rig's part of the variance counts, in cm².
    variance = math.ceil(1e4 * float(posture.total_covariance[0, 0]))
    assert variance > math.ceil(1e4 * float(posture.covariance[0, 0]))
    assert (found["type"], found["orientation"], found["covariance"]) == (0, 0, variance)
    assert 2 <= found["signal_quality"] <= 100
    assert found["time_boot_ms"] == first_sample().instants.arrived_ns // 1_000_000
    value = peer.wait_for("NAMED_VALUE_FLOAT", name="aq_range")["fields"]["value"]
    # A float of 32 bits has 7 digits.
    assert value == pytest.approx(1e3 * posture.range, rel=1e-6)

    output.send(without_posture())
    assert peer.wait_for("DISTANCE_SENSOR")["fields"]["current_distance"] == 0
    assert peer.wait_for("NAMED_VALUE_FLOAT", name="aq_valid")["fields"]["value"] == 0.0
    assert peer.wait_for("NAMED_VALUE_FLOAT", name="aq_range")["fields"]["value"] is None

    sequence = []
    peer.forget()
    output.send(first_sample())

    def nine() -> bool:
        sequence.extend(entry["seq"] for entry in peer.forget())
        return len(sequence) >= 9

    until(nine, "nine messages")
    assert all((b - a) % 256 == 1 for a, b in itertools.pairwise(sequence))


def test_heartbeats_go_out_without_frames_and_messages_come_in(lab: Lab) -> None:
    peer = lab.peer("udpin:127.0.0.1:0", "--garbage")
    output = lab.output(f"udpout:127.0.0.1:{peer.port}")
    at_s = [1e-9 * peer.wait_for("HEARTBEAT")["at_ns"] for _ in range(4)]
    # One a second; one that comes late is followed by one in time.
    assert at_s[-1] - at_s[0] > 2.0
    # Sent between pieces of noise.
    until(lambda: output.link.latest("ATTITUDE"), "a message from the peer")
    found = output.link.latest("ATTITUDE", system=1, component=1)
    assert found is not None
    assert found.message.yaw == pytest.approx(0.3)
    assert found.age_s < TIMEOUT_S
    assert output.link.latest("ATTITUDE", system=2) is None


def test_a_peer_that_goes_and_returns(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mavlink_link, "SILENT_AFTER_S", 0.5)
    peer = lab.peer("udpin:127.0.0.1:0")
    output = lab.output(f"udpout:127.0.0.1:{peer.port}")
    becomes(output, State.OK, "ArduSub")
    os.kill(peer.process.pid, signal.SIGSTOP)
    becomes(output, State.WARN, "no heartbeat for")
    os.kill(peer.process.pid, signal.SIGCONT)
    becomes(output, State.OK, "ArduSub")
    files = open_files()

    peer.stop()
    took = stream(
        output, lambda: "nobody listens" in output.health().detail, "the refusal of the system"
    )
    assert output.health().state is State.FAULT
    assert statistics.median(took) < CALL_S
    # The peer's pipe is closed, nothing else has changed.
    assert open_files() == files - 1

    back = lab.peer(f"udpin:127.0.0.1:{peer.port}")
    stream(output, lambda: "NAMED_VALUE_FLOAT" in kinds(back), "a sample at the peer")
    becomes(output, State.OK, "ArduSub")
    n_dropped = output.health().n_dropped
    output.send(first_sample())
    assert output.health().n_dropped == n_dropped


def kinds(peer: Peer) -> list[str]:
    return [entry["fields"]["mavpackettype"] for entry in peer.forget()]


def test_listening_for_a_peer(lab: Lab) -> None:
    port = free_port()
    output = lab.output(f"udpin:127.0.0.1:{port}")
    becomes(output, State.WARN, "no heartbeat of sysid 1 yet")
    output.send(first_sample())
    assert output.health().n_dropped == 1
    peer = lab.peer(f"udpout:127.0.0.1:{port}", "--system", "7", "--autopilot", "12")
    # Another vehicle is heard, but it is not the one that this computer belongs to.
    becomes(output, State.WARN, "no heartbeat of sysid 1, but of sysid 7 PX4")
    output.send(first_sample())
    peer.wait_for("DISTANCE_SENSOR")


def test_a_server_that_goes_and_returns(lab: Lab) -> None:
    peer = lab.peer("tcpin:127.0.0.1:0")
    output = lab.output(f"tcp:127.0.0.1:{peer.port}")
    becomes(output, State.OK, "ArduSub")
    output.send(first_sample())
    peer.wait_for("DISTANCE_SENSOR")
    peer.stop()
    becomes(output, State.FAULT, "tried again")
    assert f"127.0.0.1:{peer.port}: " in output.health().detail
    output.send(first_sample())
    back = lab.peer(f"tcpin:127.0.0.1:{peer.port}")
    becomes(output, State.OK, "ArduSub")
    output.send(first_sample())
    back.wait_for("DISTANCE_SENSOR")


@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo terminals")
def test_a_serial_line_that_is_unplugged(lab: Lab, tmp_path: Path) -> None:
    device = tmp_path / "ttyACM0"
    output = lab.output(f"serial:{device}:115200")
    becomes(output, State.FAULT, "No such file")
    peer = lab.peer(f"pty:{device}")
    becomes(output, State.OK, "ArduSub")
    output.send(first_sample())
    assert peer.wait_for("DISTANCE_SENSOR")["magic"] == 0xFD
    peer.stop()
    becomes(output, State.FAULT, "tried again")
    output.send(first_sample())
    back = lab.peer(f"pty:{device}")
    becomes(output, State.OK, "ArduSub")
    output.send(first_sample())
    back.wait_for("DISTANCE_SENSOR")


@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo terminals")
def test_a_slow_line_carries_the_distance_first(
    lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from aqualvs.live.mavlink.ports import SerialPort

    peer = lab.peer(f"pty:{tmp_path / 'ttyACM0'}")
    output = lab.output(f"serial:{tmp_path / 'ttyACM0'}")
    becomes(output, State.OK, "ArduSub")
    # A pseudo terminal has no speed, so the driver's queue is pretended.
    monkeypatch.setattr(SerialPort, "lag_s", 0.05)
    peer.forget()
    output.send(first_sample())
    peer.wait_for("DISTANCE_SENSOR")
    assert "NAMED_VALUE_FLOAT" not in peer.kinds_during(0.2)
    assert output.health().n_dropped == 1
    monkeypatch.setattr(SerialPort, "lag_s", 0.2)
    output.send(first_sample())
    assert "DISTANCE_SENSOR" not in peer.kinds_during(0.2)


@pytest.mark.parametrize("kind", ["tcp", "serial"])
def test_a_peer_that_takes_nothing_holds_nobody_up(lab: Lab, tmp_path: Path, kind: str) -> None:
    device = tmp_path / "ttyACM0"
    peer = lab.peer("tcpin:127.0.0.1:0" if kind == "tcp" else f"pty:{device}")
    output = lab.output(f"tcp:127.0.0.1:{peer.port}" if kind == "tcp" else f"serial:{device}")
    becomes(output, State.OK, "ArduSub")
    os.kill(peer.process.pid, signal.SIGSTOP)
    found_full: list[float] = []
    n_dropped = 0
    end = time.monotonic() + TIMEOUT_S
    while n_dropped < 50:
        start = time.perf_counter()
        output.send(first_sample())
        took = time.perf_counter() - start
        before, n_dropped = n_dropped, output.health().n_dropped
        if n_dropped > before:
            found_full.append(took)
        assert time.monotonic() < end, "the line never filled"
    # A busy machine holds up some of the calls that found the line full, but not half of them.
    assert statistics.median(found_full) < CALL_S
    os.kill(peer.process.pid, signal.SIGCONT)
    peer.forget()
    stream(output, lambda: "DISTANCE_SENSOR" in kinds(peer), "a sample after the stall")
    becomes(output, State.OK, "ArduSub")


def test_a_connection_that_takes_nothing_for_long_is_made_anew(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mavlink_ports, "_STALLED_S", 0.2)
    peer = lab.peer("tcpin:127.0.0.1:0")
    output = lab.output(f"tcp:127.0.0.1:{peer.port}")
    becomes(output, State.OK, "ArduSub")
    os.kill(peer.process.pid, signal.SIGSTOP)
    end = time.monotonic() + TIMEOUT_S
    while "does not accept data any more" not in (found := output.health()).detail:
        # At full speed, to fill the buffers of both systems.
        output.send(first_sample())
        assert time.monotonic() < end, found
    assert found.state is State.FAULT


def test_several_share_one_link(lab: Lab) -> None:
    peer = lab.peer("udpin:127.0.0.1:0")
    link = MavlinkLink(f"udpout:127.0.0.1:{peer.port}", LinkOptions(component=192))
    with contextlib.closing(link):
        until(link.autopilot, "a heartbeat")
        output = MavlinkOutput(link)
        output.send(first_sample())
        assert peer.wait_for("DISTANCE_SENSOR")["component"] == 192
        output.close()
        assert link.send(link.dialect.MAVLink_manual_control_message(1, 0, 0, 500, 0, 0))
        assert peer.wait_for("MANUAL_CONTROL")["fields"]["z"] == 500


def test_a_closed_link_is_quiet(lab: Lab) -> None:
    output = lab.output("udpout:127.0.0.1:9")
    output.close()
    output.close()
    output.send(first_sample())
    found = output.health()
    assert (found.state, found.detail, found.n_dropped) == (State.OFF, "closed", 1)


@pytest.mark.parametrize(
    "url",
    [
        # No name may be so long, which needs no server to find out.
        f"udpout:{'x' * 70}:14550",
        "udpin:192.0.2.1:14550",
        "serial:/dev/null",
        "tcp:127.0.0.1:1",
    ],
)
def test_what_cannot_be_opened_is_told_and_tried_again(lab: Lab, url: str) -> None:
    output = lab.output(url)
    becomes(output, State.FAULT, "tried again every")
    # Each time after a longer pause: a poll of a busy machine may miss the first.

    def pause_s() -> float:
        return float(output.health().detail.rpartition("every ")[2].split()[0])

    first_s = pause_s()
    until(lambda: pause_s() > first_s, "a longer pause")
    output.send(first_sample())
    assert output.health().n_dropped == 1
