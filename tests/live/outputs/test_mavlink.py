"""MAVLink messages, address forms and units, decoded by pymavlink from a loopback socket."""

import contextlib
import math
import os
import re
import socket
import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aqualvs.control.time_filter import FilteredPosture
from aqualvs.errors import OptionError
from aqualvs.live.mavlink.link import LinkOptions
from aqualvs.live.mavlink.ports import (
    NetAddress,
    NetKind,
    SerialAddress,
    check_address,
    open_port,
    parse_address,
)
from aqualvs.live.outputs.mavlink import (
    FILTERED_NAMES,
    NAMES,
    MavlinkOutput,
    boot_ms,
    distance_limits_cm,
    signal_quality,
    variance_cm2,
)
from aqualvs.optics.shutter import Shutter, ShutterKind
from aqualvs.recording.sample import LiveSample
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.scan import ScanPoints
from live_cases import first_sample
from repository import ROOT

pytest.importorskip("pymavlink")


def with_posture(posture: Posture | Refusal) -> LiveSample:
    return replace(first_sample(), scan=replace(first_sample().scan, posture=posture))


def measured() -> Posture:
    posture = first_sample().scan.posture
    assert isinstance(posture, Posture)
    return posture


class Bench:
    """An output and the socket that it sends to."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(60.0)
        self.output = MavlinkOutput(f"udpout:127.0.0.1:{self._socket.getsockname()[1]}")
        self.dialect = self.output.link.dialect
        self._parser = self.dialect.MAVLink(None)
        # The heartbeat says that the port is open.
        assert self._receive()[0].get_type() == "HEARTBEAT"

    def send(self, sample: LiveSample) -> tuple[Any, dict[str, float]]:
        """Return the distance and the named values that a sample becomes."""
        self.output.send(sample)
        distance = self._next("DISTANCE_SENSOR")[0]
        values = self._next("NAMED_VALUE_FLOAT")
        assert {value.time_boot_ms for value in values} == {distance.time_boot_ms}
        return distance, {value.name: value.value for value in values}

    def _next(self, kind: str) -> list[Any]:
        messages = self._receive()
        while messages[0].get_type() == "HEARTBEAT":
            messages = self._receive()
        assert {message.get_type() for message in messages} == {kind}
        return messages

    def _receive(self) -> list[Any]:
        data = self._socket.recv(65535)
        # What a network passes on in one piece.
        assert len(data) < 1400
        return list(self._parser.parse_buffer(data))

    def close(self) -> None:
        self.output.close()
        self._socket.close()


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    with contextlib.closing(Bench()) as made:
        yield made


def test_a_posture_becomes_messages(bench: Bench) -> None:
    # The rig of the bundled dive is exact: its part is put in by hand.
    rig_part = np.diag([1e-6, 2e-6, 3e-6])
    posture = replace(measured(), rig_covariance=rig_part)
    distance, values = bench.send(with_posture(posture))
    assert distance.current_distance == round(100 * posture.range)
    assert distance.time_boot_ms == first_sample().instants.arrived_ns // 1_000_000
    rolling = Shutter(kind=ShutterKind.ROLLING, readout=0.02, exposure=0.008)
    rig = replace(first_sample().rig, shutter=rolling)
    late, _ = bench.send(replace(with_posture(posture), rig=rig))
    assert late.time_boot_ms == (first_sample().instants.arrived_ns - 14_000_000) // 1_000_000
    assert distance.signal_quality > 50
    assert tuple(values) == NAMES
    sigmas = np.sqrt(np.diag(posture.total_covariance))
    expected = {
        "aq_valid": 1.0,
        "aq_range": 1e3 * posture.range,
        "aq_pitch": math.degrees(posture.pitch),
        "aq_yaw": math.degrees(posture.yaw),
        "aq_s_range": 1e3 * sigmas[0],
        "aq_s_pitch": math.degrees(sigmas[1]),
        "aq_s_yaw": math.degrees(sigmas[2]),
        "aq_n": first_sample().scan.n_water,
    }
    # A float of 32 bits has 7 digits.
    assert values == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("reason", list(Reason))
def test_without_a_posture_there_is_no_distance(bench: Bench, reason: Reason) -> None:
    distance, values = bench.send(with_posture(Refusal(reason)))
    # Below the least distance, invalid quality, unknown variance: no receiver takes that for one.
    assert distance.current_distance == 0 < distance.min_distance < distance.max_distance
    assert (distance.signal_quality, distance.covariance) == (1, 255)
    assert values.pop("aq_valid") == 0.0
    assert values.pop("aq_n") == pytest.approx(first_sample().scan.n_water)
    assert all(math.isnan(value) for value in values.values())


@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0, 1e300, 0.0])
def test_a_range_without_sense_is_no_distance(bench: Bench, value: float) -> None:
    distance, values = bench.send(with_posture(replace(measured(), range=value)))
    assert (distance.current_distance, distance.signal_quality) == (0, 1)
    assert math.isnan(values["aq_range"]) or values["aq_range"] == 1e3 * value


def test_filtered_values_have_their_own_names(bench: Bench) -> None:
    filtered = FilteredPosture(0.5, 0.1, -0.2, np.array([-0.03, 0.0, 0.0]), np.eye(6), 0.0, True)
    _, values = bench.send(replace(first_sample(), filtered=filtered))
    assert tuple(values) == NAMES + FILTERED_NAMES
    assert values["aq_range"] == pytest.approx(1e3 * measured().range, rel=1e-6)
    expected = (1.0, 500.0, math.degrees(0.1), math.degrees(-0.2), -30.0)
    assert [values[name] for name in FILTERED_NAMES] == pytest.approx(expected, rel=1e-6)
    # Once seen, its end is told, not left to be guessed.
    _, values = bench.send(first_sample())
    assert values["aqf_valid"] == 0.0
    assert all(math.isnan(values[name]) for name in FILTERED_NAMES[1:])


def test_names_fit_and_differ() -> None:
    names = NAMES + FILTERED_NAMES
    assert all(0 < len(name.encode("ascii")) <= 10 for name in names)
    assert len(set(names)) == len(names)


def test_stations_find_what_the_recipe_names() -> None:
    """Cockpit's variables have system, component and name in their path."""
    options = LinkOptions()
    named = re.findall(
        r"/mavlink/(\d+)/(\d+)/NAMED_VALUE_FLOAT/(\w+)", (ROOT / "docs/mavlink.md").read_text()
    )
    assert {name for _, _, name in named} == {"aq_range", "aq_yaw", "aq_s_range", "aq_valid"}
    assert {name for _, _, name in named} <= set(NAMES)
    ids = {(int(system), int(component)) for system, component, _ in named}
    assert ids == {(options.system, options.component)}


def test_the_clock_wraps(bench: Bench) -> None:
    late = 2**32 * 10**6 + 7 * 10**6
    assert boot_ms(late - 8 * 10**6) == 2**32 - 1
    assert boot_ms(late) == 7
    distance, _ = bench.send(
        replace(first_sample(), instants=replace(first_sample().instants, arrived_ns=late))
    )
    assert distance.time_boot_ms == 7


@given(st.floats(0.0, 700.0), st.floats(0.0, 700.0))
def test_limits_hold_every_range_that_is_believed(one: float, other: float) -> None:
    near, far = sorted((one, other))
    least, most = distance_limits_cm((near, far))
    assert 1 <= least <= most <= 65535
    # A valid distance, rounded, never lies outside; 0, which means none, always below.
    assert least <= max(1, round(99 * near))
    assert most >= min(65535, round(101 * far))


@pytest.mark.parametrize(
    ("variance", "expected"),
    [
        (0.0, 0),
        (1e-6, 1),
        (1e-4, 1),
        (1.01e-4, 2),
        (0.0254, 254),
        (0.0256, 255),
        (math.nan, 255),
        (math.inf, 255),
        (-1e-9, 255),
    ],
)
def test_variance_is_never_understated(variance: float, expected: int) -> None:
    assert variance_cm2(variance) == expected


@pytest.mark.parametrize(
    ("qualities", "expected"), [([0.0], 2), ([0.5, 0.7], 60), ([1.0], 100), ([], 0), ([np.nan], 0)]
)
def test_quality_leaves_one_to_the_invalid(qualities: list[float], expected: int) -> None:
    n = len(qualities)
    # A point that the posture does not rest on must not count.
    points = replace(
        ScanPoints.none(), quality=np.array([*qualities, 0.9]), used=np.array([True] * n + [False])
    )
    assert signal_quality(points) == expected


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        ("udpout:192.168.2.2:14550", NetAddress("udpout", "192.168.2.2", 14550)),
        ("udpout://blueos.local:14550", NetAddress("udpout", "blueos.local", 14550)),
        ("udpin:0.0.0.0:14550", NetAddress("udpin", "0.0.0.0", 14550)),
        ("udp:0.0.0.0:14550", NetAddress("udpin", "0.0.0.0", 14550)),
        ("udp://:14550", NetAddress("udpin", "0.0.0.0", 14550)),
        ("udpin:[::1]:14550", NetAddress("udpin", "::1", 14550)),
        ("udpbcast:192.168.2.255:14550", NetAddress("udpbcast", "192.168.2.255", 14550)),
        ("TCP:127.0.0.1:5760", NetAddress("tcp", "127.0.0.1", 5760)),
        ("udpclient://192.168.2.1:14550", NetAddress("udpout", "192.168.2.1", 14550)),
        ("udpserver://0.0.0.0:14550", NetAddress("udpin", "0.0.0.0", 14550)),
        ("tcpclient://127.0.0.1:5777", NetAddress("tcp", "127.0.0.1", 5777)),
        ("/dev/ttyACM0", SerialAddress("/dev/ttyACM0", 115200)),
        ("/dev/ttyACM0,57600", SerialAddress("/dev/ttyACM0", 57600)),
        ("serial:/dev/ttyUSB0:921600", SerialAddress("/dev/ttyUSB0", 921600)),
        ("serial:///dev/ttyUSB0,9600", SerialAddress("/dev/ttyUSB0", 9600)),
        (
            "/dev/serial/by-id/usb-3D_Robotics_PX4_FMU-if00",
            SerialAddress("/dev/serial/by-id/usb-3D_Robotics_PX4_FMU-if00", 115200),
        ),
        ("COM3,57600", SerialAddress("COM3", 57600)),
        ("COM12", SerialAddress("COM12", 115200)),
        ("serial:COM3:57600", SerialAddress("COM3", 57600)),
    ],
)
def test_addresses_as_pilots_write_them(url: str, expected: object) -> None:
    assert parse_address(url) == expected


@pytest.mark.parametrize(
    "url",
    [
        "",
        "192.168.2.2:14550",
        "udpout:192.168.2.2",
        "udpout::14550",
        "udpout:host:0",
        "udpout:host:70000",
        "tcp:host:port",
        "http://host:80",
        "serial:",
        "ttyACM0",
    ],
)
def test_other_addresses_are_refused_with_the_forms(url: str) -> None:
    with pytest.raises(OptionError, match="udpout:HOST:PORT") as caught:
        parse_address(url)
    assert repr(url) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(sys.platform == "win32", reason="the system does not tell")
@pytest.mark.parametrize("kind", ["udpout", "udpin", "udpbcast", "tcp"])
def test_no_port_ever_waits(kind: NetKind) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = 0 if kind == "udpin" else server.getsockname()[1]
        with contextlib.closing(open_port(NetAddress(kind, "127.0.0.1", port))) as opened:
            assert not os.get_blocking(opened.fileno())
            assert opened.read() == (b"", ())


def test_a_speed_that_the_system_does_not_know_is_refused() -> None:
    with pytest.raises(OptionError, match=r"123456 baud.*115200"):
        check_address(SerialAddress("/dev/ttyACM0", 123456))


@pytest.mark.parametrize(("name", "value"), [("system", 0), ("component", 256)])
def test_ids_out_of_range_are_refused(name: str, value: int) -> None:
    with pytest.raises(OptionError, match=f"{name} id {value}"):
        LinkOptions(**{name: value})


def test_without_pymavlink_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20.ardupilotmega", None)
    with pytest.raises(OptionError, match=r"aqualvs\[mavlink\]"):
        MavlinkOutput("udpout:127.0.0.1:9")
