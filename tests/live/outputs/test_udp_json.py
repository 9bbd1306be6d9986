"""JSON over UDP: keys, values as in `posture.csv`, several receivers, and what goes wrong."""

import contextlib
import csv
import errno
import io
import json
import math
import re
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aqualvs.control.time_filter import FilteredPosture
from aqualvs.errors import OptionError
from aqualvs.live.outputs.udp_json import UdpJsonOutput, json_fields, json_line, receiver_address
from aqualvs.recording.sample import LiveSample
from aqualvs.results.folder import POSTURE_COLUMNS, posture_row
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.sources.base import Health, State
from live_cases import first_sample
from ports import free_port
from repository import ROOT
from waiting import TIMEOUT_S, until

PAGE = ROOT / "docs" / "json.md"


def with_posture(posture: Posture | Refusal) -> LiveSample:
    return replace(first_sample(), scan=replace(first_sample().scan, posture=posture))


def measured() -> Posture:
    assert isinstance(first_sample().scan.posture, Posture)
    return first_sample().scan.posture


def curved() -> LiveSample:
    return with_posture(replace(measured(), curvature=(0.1, -0.2), sigma_curvature=(0.01, 0.02)))


def decoded(sample: LiveSample) -> dict[str, Any]:
    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is not JSON")

    found: dict[str, Any] = json.loads(json_line(sample), parse_constant=refuse)
    return found


@pytest.fixture
def receiver() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.bind(("127.0.0.1", 0))
        made.settimeout(TIMEOUT_S)
        yield made


def address_of(receiver: socket.socket) -> str:
    return f"127.0.0.1:{receiver.getsockname()[1]}"


@pytest.mark.parametrize(
    "make", [first_sample, curved, lambda: with_posture(Refusal(Reason.ONE_LASER))]
)
def test_values_are_those_of_the_csv(make: Callable[[], LiveSample]) -> None:
    sample = make()
    row = next(csv.reader(io.StringIO(posture_row(sample.scan))))
    fields = decoded(sample)
    assert set(POSTURE_COLUMNS) <= set(fields)
    for name, text in zip(POSTURE_COLUMNS, row, strict=True):
        value = fields[name]
        if name == "reason":
            assert (value or "") == text
        elif text:
            assert value == float(text), name
        elif name != "n_water":
            # The water's index is known without a posture too.
            assert value is None, name


def test_a_sigma_that_is_a_whole_number_is_no_integer() -> None:
    """Receivers with static types read each key as one type."""
    exact = with_posture(replace(measured(), rig_covariance=np.zeros((3, 3))))
    found = decoded(exact)
    assert type(found["sigma_range_rig_m"]) is float
    assert type(found["n_points"]) is int


def test_what_is_live_comes_along() -> None:
    health = Health(rate_hz=24.98, n_frames=3)
    fields = decoded(replace(first_sample(), health=health))
    assert fields["utc_ns"] == first_sample().utc_ns
    assert fields["rate_hz"] == 24.98
    assert fields["delay_s"] == 0.0015
    assert fields["state"] == health.state.value == "off"
    assert fields["aqualvs_sample"] == 1
    assert fields["valid"] is True
    refused = decoded(with_posture(Refusal(Reason.NOT_A_PLANE, "12 mm rms")))
    assert refused["valid"] is False
    assert (refused["reason"], refused["detail"]) == ("not_a_plane", "12 mm rms")
    assert decoded(replace(first_sample(), frame=None))["delay_s"] is None


def test_filtered_values_stand_beside_the_raw_ones() -> None:
    cov = np.diag([1e-6, 4e-6, 9e-6, 1.0, 1.0, 1.0])
    filtered = FilteredPosture(0.5, 0.1, -0.2, np.array([-0.03, 0.2, 0.3]), cov, 0.04, False)
    fields = decoded(replace(first_sample(), filtered=filtered))
    assert fields["range_m"] == round(measured().range, 6)
    expected = {
        "filtered_range_m": 0.5,
        "filtered_pitch_deg": math.degrees(0.1),
        "filtered_yaw_deg": math.degrees(-0.2),
        "filtered_sigma_range_m": 1e-3,
        "filtered_sigma_pitch_deg": math.degrees(2e-3),
        "filtered_sigma_yaw_deg": math.degrees(3e-3),
        "filtered_speed_m_per_s": -0.03,
        "filtered_pitch_rate_deg_per_s": math.degrees(0.2),
        "filtered_yaw_rate_deg_per_s": math.degrees(0.3),
        "filtered_age_s": 0.04,
        "filtered_accepted": False,
    }
    # Sigmas are rounded to four digits.
    assert {name: fields[name] for name in expected} == pytest.approx(expected, rel=2e-4)
    without = decoded(first_sample())
    assert [without[name] for name in expected] == [None] * len(expected)


def test_every_sample_has_the_same_keys() -> None:
    kinds = (first_sample(), curved(), with_posture(Refusal(Reason.NO_FRAMES)))
    assert len({tuple(json_fields(sample)) for sample in kinds}) == 1


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_numbers_that_are_none_are_null(value: float) -> None:
    spoilt = replace(measured(), range=value, slant_range=value, covariance=np.full((3, 3), value))
    fields = decoded(replace(with_posture(spoilt), health=Health(rate_hz=value)))
    names = ("range_m", "slant_range_m", "sigma_range_m", "sigma_yaw_deg", "rate_hz")
    assert [fields[name] for name in names] == [None] * len(names)


def test_one_line_of_utf8_that_a_network_passes_on() -> None:
    line = json_line(with_posture(Refusal(Reason.CORRUPT_FRAME, "Bild zerstört\nund mehr")))
    assert line.endswith(b"\n")
    assert line.count(b"\n") == 1
    assert "zerstört" in line.decode("utf-8")
    assert len(json_line(curved())) < 1400


def output_to(*receivers: str) -> UdpJsonOutput:
    return UdpJsonOutput([receiver_address(text) for text in receivers])


def test_every_receiver_gets_every_sample(receiver: socket.socket) -> None:
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as other:
        try:
            other.bind(("::1", 0))
        except OSError:
            pytest.skip("no IPv6 here")
        other.settimeout(TIMEOUT_S)
        both = (address_of(receiver), f"[::1]:{other.getsockname()[1]}")
        with contextlib.closing(output_to(*both)) as output:
            output.send(first_sample())
            assert receiver.recv(65535) == other.recv(65535) == json_line(first_sample())
            found = output.health()
            assert (found.state, found.detail, found.n_dropped) == (State.OK, "sent to 2", 0)


def test_broadcast_is_allowed() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("", 0))
        listener.settimeout(TIMEOUT_S)
        address = f"127.255.255.255:{listener.getsockname()[1]}"
        with contextlib.closing(output_to(address)) as output:
            output.send(first_sample())
            assert listener.recv(65535) == json_line(first_sample())


def test_names_are_looked_up_without_waiting(
    receiver: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    lookup, answered = socket.getaddrinfo, threading.Event()

    def slow(host: str, *args: Any, flags: int = 0, **more: Any) -> Any:
        if flags != socket.AI_NUMERICHOST:
            assert answered.wait(TIMEOUT_S)
            host = "127.0.0.1"
        return lookup(host, *args, flags=flags, **more)

    monkeypatch.setattr(socket, "getaddrinfo", slow)
    output = output_to(f"vehicle.local:{receiver.getsockname()[1]}")
    with contextlib.closing(output):
        # It returns although there is no answer yet.
        output.send(first_sample())
        assert output.health().n_dropped == 1
        assert output.health().state is State.FAULT
        answered.set()

        def arrived() -> bool:
            output.send(first_sample())
            return output.health().state is State.OK

        until(arrived)
        assert receiver.recv(65535) == json_line(first_sample())


def test_a_receiver_that_goes_and_returns(receiver: socket.socket) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
        gone.bind(("127.0.0.1", 0))
        address = address_of(gone)
    with contextlib.closing(output_to(address_of(receiver), address)) as output:

        def refused() -> bool:
            output.send(first_sample())
            return output.health().state is State.WARN

        until(refused)
        assert output.health().detail == f"nobody listens at {address}"
        assert receiver.recv(65535) == json_line(first_sample())
        # Its refusal waits for the next call.
        output.send(first_sample())
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as back:
            host, _, port = address.partition(":")
            back.bind((host, int(port)))
            back.settimeout(TIMEOUT_S)
            output.send(first_sample())
            # The first datagram after its return arrives: the old refusal costs none.
            assert back.recv(65535) == json_line(first_sample())


def test_a_network_that_fails_is_told_and_tried_again(
    receiver: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = output_to(address_of(receiver))
    with contextlib.closing(output):
        with monkeypatch.context() as broken:
            broken.setattr(socket.socket, "connect", unreachable)
            output.send(first_sample())
            found = output.health()
            assert (found.state, found.n_dropped) == (State.FAULT, 1)
            assert found.detail == f"{address_of(receiver)}: Network is unreachable"

        def recovered() -> bool:
            output.send(first_sample())
            return output.health().state is State.OK

        until(recovered)
        assert receiver.recv(65535) == json_line(first_sample())


def test_a_full_buffer_drops_and_does_not_wait(
    receiver: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    with contextlib.closing(output_to(address_of(receiver))) as output:
        made: list[bool] = []

        def full(sender: socket.socket, _data: bytes) -> int:
            made.append(sender.getblocking())
            raise BlockingIOError(errno.EAGAIN, "full")

        with monkeypatch.context() as busy:
            busy.setattr(socket.socket, "send", full)
            output.send(first_sample())
        assert made == [False]
        assert (output.health().state, output.health().n_dropped) == (State.OK, 1)
        output.send(first_sample())
        assert receiver.recv(65535) == json_line(first_sample())


def unreachable(_socket: socket.socket, _address: object) -> None:
    raise OSError(101, "Network is unreachable")


def test_after_closing_nothing_is_sent(receiver: socket.socket) -> None:
    output = output_to(address_of(receiver))
    output.close()
    output.close()
    output.send(first_sample())
    assert output.health().state is State.OFF
    receiver.setblocking(False)
    with pytest.raises(BlockingIOError):
        receiver.recv(65535)


@pytest.mark.parametrize("receiver", ["host", "host:", ":7000", "host:0", "host:99999", ""])
def test_receivers_without_sense_are_refused(receiver: str) -> None:
    with pytest.raises(OptionError, match="HOST:PORT"):
        receiver_address(receiver)


def test_the_documented_receiver_works(tmp_path: Path) -> None:
    """The example runs as it stands, but for its port."""
    example = re.search(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert example is not None
    assert len(example[1].strip().splitlines()) == 6
    port = free_port()
    script = tmp_path / "receive.py"
    assert "14660" in example[1]
    script.write_text(example[1].replace("14660", str(port)))
    printed = tmp_path / "printed"
    with printed.open("w") as file:
        process = subprocess.Popen([sys.executable, "-u", str(script)], stdout=file)
    try:
        with contextlib.closing(output_to(f"127.0.0.1:{port}")) as output:
            # It takes a moment to start.
            until(lambda: output.send(first_sample()) or printed.read_text().endswith("\n"))
    finally:
        process.kill()
        process.wait(TIMEOUT_S)
    assert set(printed.read_text().split()) == {str(round(measured().range, 6))}


def test_every_key_is_documented() -> None:
    page = PAGE.read_text(encoding="utf-8")
    missing = [name for name in json_fields(first_sample()) if f"`{name}`" not in page]
    assert missing == []
