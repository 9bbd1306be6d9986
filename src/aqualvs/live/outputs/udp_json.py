"""Posture as one line of JSON in a UDP datagram."""

import json
import math
import socket
import threading
import time
from collections.abc import Sequence
from typing import TypeAlias

from aqualvs.control.time_filter import FilteredPosture
from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.live.mavlink.peers import Peer
from aqualvs.live.mavlink.ports import PORTS, NetAddress, UdpPort, find_host, parse_host_port, why
from aqualvs.live.outputs.base import Output
from aqualvs.recording.sample import LiveSample
from aqualvs.results.folder import POSTURE_COLUMNS, posture_cells
from aqualvs.scanning.posture import Refusal, deviations
from aqualvs.sources.base import PartHealth, State

FORMAT_VERSION = 1
"""Increased when a key changes its meaning or is removed; keys may be added at any time."""

Value: TypeAlias = str | int | float | bool | None

# The numbers of `posture.csv` that follow from the posture.
_POSTURE_KEYS = tuple(
    name for name in POSTURE_COLUMNS[POSTURE_COLUMNS.index("range_m") :] if name != "n_water"
)
_FILTERED_KEYS = (
    *("filtered_range_m", "filtered_pitch_deg", "filtered_yaw_deg"),
    *("filtered_sigma_range_m", "filtered_sigma_pitch_deg", "filtered_sigma_yaw_deg"),
    *("filtered_speed_m_per_s", "filtered_pitch_rate_deg_per_s", "filtered_yaw_rate_deg_per_s"),
    *("filtered_age_s", "filtered_accepted", "filtered_sigma_range_total_m"),
    *("filtered_sigma_pitch_total_deg", "filtered_sigma_yaw_total_deg"),
)


def json_line(sample: LiveSample) -> bytes:
    """Return a sample as one line of JSON in UTF-8, with its line end."""
    text = json.dumps(json_fields(sample), ensure_ascii=False, separators=(",", ":"))
    return text.encode("utf-8") + b"\n"


def json_fields(sample: LiveSample) -> dict[str, Value]:
    """Return a sample as plain values: the rounded ones of `posture.csv`, and the live ones.

    Unknown values and numbers that are not finite are None.
    """
    scan, posture = sample.scan, sample.scan.posture
    refusal = posture if isinstance(posture, Refusal) else None
    fields: dict[str, Value] = {
        "aqualvs_sample": FORMAT_VERSION,
        "frame": scan.index,
        "time_s": _fixed(scan.time_s, 6),
        "utc_ns": sample.utc_ns,
        "valid": refusal is None,
        "reason": None,
        "detail": None,
    }
    if refusal is not None:
        fields["reason"], fields["detail"] = refusal.reason.value, refusal.detail or None
    cells = posture_cells(scan)
    fields |= {
        key: _number(cells[key], int if key == "n_points" else float) for key in _POSTURE_KEYS
    }
    fields["n_water"] = _fixed(scan.n_water, 6)
    fields |= _filtered_fields(sample.filtered)
    fields["rate_hz"] = _fixed(sample.health.rate_hz, 3)
    # From the decoded frame to its posture.
    delay_s = 1e-9 * (sample.instants.scanned_ns - sample.instants.arrived_ns)
    fields["delay_s"] = None if sample.frame is None else _fixed(delay_s, 6)
    fields["state"] = sample.health.state.value
    return fields


def _number(cell: str, kind: type[int] | type[float] = float) -> Value:
    """Return the number in a cell of `posture.csv`; None where there is none."""
    return kind(cell) if cell and math.isfinite(float(cell)) else None


def _filtered_fields(filtered: FilteredPosture | None) -> dict[str, Value]:
    if filtered is None:
        return dict.fromkeys(_FILTERED_KEYS)
    speed, pitch_rate, yaw_rate = filtered.rates.tolist()
    values = (
        _fixed(filtered.range, 6),
        _fixed(math.degrees(filtered.pitch), 5),
        _fixed(math.degrees(filtered.yaw), 5),
        *_sigmas(filtered.covariance),
        _fixed(speed, 6),
        _fixed(math.degrees(pitch_rate), 5),
        _fixed(math.degrees(yaw_rate), 5),
        _fixed(filtered.age_s, 6),
        filtered.accepted,
        *_sigmas(filtered.total_covariance),
    )
    return dict(zip(_FILTERED_KEYS, values, strict=True))


def _sigmas(covariance: FloatArray) -> list[Value]:
    return [_number(f"{sigma:.4g}") for sigma in deviations(covariance)]


def _fixed(value: float, digits: int) -> Value:
    return round(float(value), digits) if math.isfinite(value) else None


class UdpJsonOutput(Output):
    """Output that sends every sample to every receiver.

    `receivers`: at least one, from `receiver_address`; a broadcast address reaches all that listen
    in the network.
    """

    inline = True

    def __init__(self, receivers: Sequence[NetAddress]) -> None:
        self.name = f"json {','.join(map(str, receivers))}"
        self._receivers = [_Receiver(address) for address in receivers]
        self._closed = False

    def send(self, sample: LiveSample) -> None:
        """Send one sample without waiting; drop it for receivers that cannot be reached."""
        if self._closed:
            return
        line = json_line(sample)
        for receiver in self._receivers:
            receiver.send(line)

    def health(self) -> PartHealth:
        """Return the number of reached receivers, and the faults of the others."""
        n_dropped = sum(receiver.n_dropped for receiver in self._receivers)
        if self._closed:
            return PartHealth(self.name, State.OFF, "closed", n_dropped)
        faults = [fault for receiver in self._receivers if (fault := receiver.fault())]
        n_all = len(self._receivers)
        if not faults:
            return PartHealth(self.name, State.OK, f"sent to {n_all}", n_dropped)
        state = State.FAULT if len(faults) == n_all else State.WARN
        return PartHealth(self.name, state, "; ".join(faults), n_dropped)

    def close(self) -> None:
        """Free the sockets; further calls do nothing."""
        self._closed = True
        for receiver in self._receivers:
            receiver.close()


def receiver_address(text: str) -> NetAddress:
    """Return the address of a receiver, `HOST:PORT` or `[IPV6]:PORT`.

    Raises `OptionError` if one of them is missing or makes no sense.
    """
    found = parse_host_port(text)
    if found is None or not all(found):
        raise OptionError(f"JSON over UDP, receiver {text!r}: write HOST:PORT, {PORTS}")
    return NetAddress("udpout", *found, text)


class _BroadcastingPort(UdpPort):
    def _prepare(self, where: Peer) -> None:
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        super()._prepare(where)


class _Receiver:
    """One address, found once and then sent to by a socket that never waits."""

    def __init__(self, address: NetAddress) -> None:
        self._address = address
        self.n_dropped = 0
        self._fault = ""
        self._opened_s = -math.inf
        self._port: UdpPort | None = None
        self._closing = threading.Event()
        self._where = self._lookup(socket.AI_NUMERICHOST)
        if self._where is None:
            # Looking a name up may take seconds.
            threading.Thread(target=self._resolve, name=f"find {address.host}", daemon=True).start()

    def fault(self) -> str:
        """Return the fault of this receiver, empty if there is none."""
        refused_for_s = 3.0
        refused_s = None if self._port is None else self._port.refused_s
        if refused_s is not None and time.monotonic() - refused_s < refused_for_s:
            return f"nobody listens at {self._address}"
        return f"{self._address}: {self._fault}" if self._fault else ""

    def send(self, line: bytes) -> None:
        """Send a line or drop it."""
        try:
            port = self._opened()
            sent = port is not None and port.write(line, ())
        except OSError as fault:
            self._fault = why(fault)
            self._drop_port()
            sent = False
        if sent:
            self._fault = ""
        self.n_dropped += not sent

    def close(self) -> None:
        self._closing.set()
        self._drop_port()

    def _opened(self) -> UdpPort | None:
        """Return the port, opened if necessary; None while that cannot be tried."""
        reopen_every_s = 0.25
        now = time.monotonic()
        due = now - self._opened_s >= reopen_every_s
        if self._port is None and self._where is not None and due:
            self._opened_s = now
            self._port = _BroadcastingPort(self._address, *self._where)
        return self._port

    def _drop_port(self) -> None:
        if self._port is not None:
            self._port.close()
            self._port = None

    def _resolve(self) -> None:
        resolve_every_s = 2.0
        while self._where is None and not self._closing.is_set():
            self._where = self._lookup(0)
            if self._where is None:
                self._closing.wait(resolve_every_s)

    def _lookup(self, flags: int) -> tuple[int, Peer] | None:
        """Return family and address of the host, IPv4 first; None if it is not known."""
        try:
            found = find_host(self._address.host, self._address.port, flags)
        except (OSError, UnicodeError) as fault:
            self._fault = why(fault)
            return None
        self._fault = ""
        return found
