"""Addresses and ports of MAVLink peers: UDP, TCP and serial lines, all non-blocking.

Addresses have the forms that pymavlink and ground stations use (`parse_address`). Serial ports are
those of pyserial: Linux, macOS and Windows.
"""

import contextlib
import errno
import ipaddress
import os
import re
import select
import socket
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from aqualvs.errors import OptionError
from aqualvs.live.mavlink.peers import Peer

DEFAULT_BAUD = 115_200
_FORMS = (
    "write udpout:HOST:PORT, udpin:HOST:PORT, udpbcast:HOST:PORT, tcp:HOST:PORT "
    "or a serial port: serial:/dev/ttyACM0:115200, on Windows serial:COM3:115200"
)
_NET_KINDS: dict[str, "NetKind"] = {
    "udpout": "udpout",
    "udpin": "udpin",
    "udp": "udpin",
    "udpbcast": "udpbcast",
    "tcp": "tcp",
    "udpclient": "udpout",
    "udpserver": "udpin",
    "tcpclient": "tcp",
}

NetKind: TypeAlias = Literal["udpout", "udpin", "udpbcast", "tcp"]


@dataclass(frozen=True, slots=True)
class NetAddress:
    """A peer in the network, or the port that peers send to."""

    # `udpout` sends to the address; `udpin` listens there and answers all known senders; `udpbcast`
    # sends to a broadcast address; `tcp` connects.
    kind: NetKind
    host: str  # Name or number.
    port: int  # 1 to 65535; 0, any free one, for `udpin`.
    url: str = field(default="", compare=False)  # As the user wrote it.

    def __str__(self) -> str:
        """Return the address as messages show it."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"


@dataclass(frozen=True, slots=True)
class SerialAddress:
    """A serial device and its speed in baud."""

    device: str
    baud: int
    url: str = field(default="", compare=False)  # As the user wrote it.

    def __str__(self) -> str:
        """Return the device as messages show it."""
        return self.device


Address: TypeAlias = NetAddress | SerialAddress


def parse_address(url: str) -> Address:
    """Read a connection in the forms that pymavlink, MAVProxy and ground stations use.

    - `udpout:HOST:PORT`, `udpin:HOST:PORT`, `udp:HOST:PORT` (the same as `udpin`, as in pymavlink),
      `udpbcast:HOST:PORT`, `tcp:HOST:PORT`; two slashes after the colon are allowed, and
      `udpclient`, `udpserver` and `tcpclient`, as BlueOS calls them. An empty host to listen at
      means every address of this computer.
    - `/dev/ttyACM0`, `/dev/ttyACM0,57600`, `serial:/dev/ttyACM0:57600`, `COM3`, `COM3,57600`,
      `serial:COM3:57600`; 115200 baud if left out.

    Raises `OptionError` if it is none of these.
    """
    scheme, colon, rest = url.partition(":")
    kind = _NET_KINDS.get(scheme.lower()) if colon else None
    if kind is not None:
        return _net_address(kind, rest.removeprefix("//"), url)
    if scheme.lower() == "serial" and colon:
        device = rest.removeprefix("//") if rest.startswith("///") else rest
        return _serial_address(device, url)
    if url.startswith("/dev/") or re.match(r"COM\d+\b", url):
        return _serial_address(url, url)
    raise OptionError(f"MAVLink connection {url!r}: not understood; {_FORMS}")


class AllowedPeers:
    """Addresses that are heard.

    `rules`: each `ADDRESS`, `ADDRESS:PORT` or `NETWORK/BITS`, in numbers; everybody if there is
    none. Raises `OptionError` if one is none of these.
    """

    def __init__(self, rules: Sequence[str] = ()) -> None:
        self._rules = [_peer_rule(text) for text in rules]

    def __contains__(self, peer: Sequence[object]) -> bool:
        """Return whether an address, as the system writes it, may speak."""
        if not self._rules or not peer:
            return True
        address = ipaddress.ip_address(str(peer[0]).partition("%")[0])
        return any(address in network and port in (None, peer[1]) for network, port in self._rules)


def _peer_rule(text: str) -> tuple[ipaddress.IPv4Network | ipaddress.IPv6Network, int | None]:
    host, port = parse_host_port(text) or (text, None)
    try:
        return ipaddress.ip_network(host, strict=False), port
    except ValueError:
        raise OptionError(
            f"MAVLink peer {text!r}: not understood; write numbers, such as 192.168.2.2, "
            "192.168.2.2:14550 or 192.168.2.0/24"
        ) from None


PORTS = "with a port from 1 to 65535"
"""Remedy for addresses that `parse_host_port` refuses."""


def parse_host_port(text: str) -> tuple[str, int] | None:
    """Return host and port of `HOST:PORT` or `[IPV6]:PORT`, None if it is neither."""
    match = re.fullmatch(r"(?:\[([0-9A-Fa-f:.%\w]+)\]|([^:\s\[\]/]*)):(\d{1,5})", text)
    if match is None or int(match[3]) > 65535:
        return None
    return match[1] or match[2], int(match[3])


def _net_address(kind: NetKind, rest: str, url: str) -> NetAddress:
    found = parse_host_port(rest)
    if found is None:
        raise OptionError(
            f"MAVLink connection {url!r}: no HOST:PORT after the scheme; {_FORMS}; {PORTS}"
        )
    host, port = found
    if kind != "udpin" and not all(found):
        raise OptionError(f"MAVLink connection {url!r}: whom to send to is missing; {_FORMS}")
    return NetAddress(kind, host or "0.0.0.0", port, url)


def _serial_address(text: str, url: str) -> SerialAddress:
    match = re.fullmatch(r"([^,]+?)(?:[,:](\d+))?", text)
    if match is None:
        raise OptionError(f"MAVLink connection {url!r}: no serial device; {_FORMS}")
    return SerialAddress(match[1], int(match[2] or DEFAULT_BAUD), url)


# A stream port reads at most so many bytes at once.
_READ_BYTES = 4096
# A stream that accepts no data for this time is broken.
_STALLED_S = 5.0
_SEND_BUFFER = 16_384
_NOT_NOW = (errno.EAGAIN, errno.EWOULDBLOCK, errno.ENOBUFS, errno.EINTR)


class Port:
    """Open connection to a peer; its faults are raised as OSError."""

    many = False  # Whether there may be several senders, kept apart by their addresses.
    whole = False  # Whether each read returns a datagram.
    # Time of the peer's refusal because its port is closed (`time.monotonic`), if any.
    refused_s: float | None = None

    @property
    def unsent(self) -> bool:
        """Whether the end of a message waits for room."""
        return False

    @property
    def lag_s(self) -> float:
        """Time that the driver needs to send its buffered data."""
        return 0.0

    def fileno(self) -> int:
        """Return the number to wait on."""
        raise NotImplementedError

    def read(self) -> tuple[bytes, Peer]:
        """Return the received data, possibly empty, and their sender."""
        raise NotImplementedError

    def write(self, frames: bytes, peer: Peer, /) -> bool:
        """Send all of it, or nothing if there is no room; return whether it was sent.

        Where there is only one peer, its address is left empty.
        """
        raise NotImplementedError

    def write_all(self, frames: bytes, heard: Sequence[Peer], /) -> bool:
        """Send to all known peers, where the port has no address of its own."""
        raise NotImplementedError

    def flush(self) -> None:
        """Send waiting data, as far as there is room."""

    def close(self) -> None:
        """Free the port at once; waiting data are lost."""
        raise NotImplementedError


def open_port(address: Address) -> Port:
    """Open the way to a peer; may take a second for TCP, and longer for names.

    Raises `OSError` if it cannot be opened now; later it may.
    """
    if isinstance(address, SerialAddress):
        return SerialPort(address)
    if address.kind == "tcp":
        return _TcpPort(address)
    flags = socket.AI_PASSIVE if address.kind == "udpin" else 0
    kinds = {"udpout": UdpPort, "udpbcast": _UdpBroadcaster, "udpin": _UdpListener}
    return kinds[address.kind](address, *find_host(address.host, address.port, flags))


def check_address(address: Address) -> None:
    """Raise `OptionError` for a serial port without pyserial, or of a speed unknown to it."""
    if not isinstance(address, SerialAddress):
        return
    try:
        from serial import Serial
    except ImportError as fault:
        raise OptionError(
            f"MAVLink connection {address.device}: serial ports need pyserial: "
            "pip install 'aqualvs[mavlink]'"
        ) from fault
    if address.baud not in Serial.BAUDRATES:
        known = ", ".join(str(baud) for baud in Serial.BAUDRATES if baud >= 9600)
        raise OptionError(
            f"MAVLink connection {address.device}: speed {address.baud} baud is unknown here; "
            f"use one of {known}"
        )


def find_host(host: str, port: int, flags: int) -> tuple[int, tuple[object, ...]]:
    """Return family and address of a host for datagrams.

    It is IPv4 where the name has both kinds of address: autopilots and their routers listen there.
    `flags`: of `getaddrinfo`, whose exceptions it raises.
    """
    found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM, flags=flags)
    family, _, _, _, where = min(found, key=lambda entry: entry[0] != socket.AF_INET)
    return family, where


class UdpPort(Port):
    """Port to one address, which hears only that; a datagram goes at once or not at all.

    `family`, `where`: from `find_host`.
    """

    whole = True

    def __init__(self, address: NetAddress, family: int, where: Peer) -> None:
        self._address = address
        self._where: Peer = ()  # Where all goes; empty where the socket knows.
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._prepare(where)
        except OSError:
            self._socket.close()
            raise

    def _prepare(self, where: Peer) -> None:
        # Connected, so that the system reports a closed port and filters other senders.
        self._socket.connect(where)

    def fileno(self) -> int:
        """Return the number of the socket."""
        return self._socket.fileno()

    def close(self) -> None:
        """Free the socket."""
        self._socket.close()

    def read(self) -> tuple[bytes, Peer]:
        """Return a datagram and its sender; empty if none has come."""
        datagram = 65_535
        try:
            data, peer = self._socket.recvfrom(datagram)
            return data, peer if self.many else ()
        except (ConnectionRefusedError, ConnectionResetError):
            self.refused_s = time.monotonic()
        except OSError as fault:
            if fault.errno not in _NOT_NOW:
                raise
        return b"", ()

    def write_all(self, frames: bytes, _heard: Sequence[Peer], /) -> bool:
        """Send to the port's own address."""
        return self.write(frames, self._where)

    def write(self, frames: bytes, where: Peer, /) -> bool:
        """Send a datagram to an address, or to the connected peer if that is empty."""
        # A refusal belongs to an earlier datagram; this one has not been tried yet.
        for _ in range(2):
            try:
                if where:
                    self._socket.sendto(frames, where)
                else:
                    self._socket.send(frames)
            except (ConnectionRefusedError, ConnectionResetError):
                self.refused_s = time.monotonic()
            except OSError as fault:
                if fault.errno in _NOT_NOW:
                    return False
                raise
            else:
                return True
        return False


class _UdpBroadcaster(UdpPort):
    """Port that sends to a broadcast address and hears all that answer."""

    many = True

    def _prepare(self, where: Peer) -> None:
        self._where = where
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        # Bound, so that it can be read before the first datagram goes out.
        self._socket.bind(("", 0))


class _UdpListener(UdpPort):
    """Listens, and sends to those it has heard."""

    many = True

    def _prepare(self, where: Peer) -> None:
        try:
            self._socket.bind(where)
        except OSError as fault:
            if fault.errno != errno.EADDRNOTAVAIL:
                raise
            raise OSError(
                fault.errno,
                f"{self._address.host} is not an address of this computer; "
                "to send there use udpout:",
            ) from fault

    def write(self, frames: bytes, peer: Peer, /) -> bool:
        """Send to one peer; one that cannot be reached must not keep it from the others."""
        try:
            return super().write(frames, peer)
        except OSError:
            return False

    def write_all(self, frames: bytes, heard: Sequence[Peer], /) -> bool:
        sent = [self.write(frames, peer) for peer in heard]
        return any(sent)


class StreamPort(Port):
    """Common base of TCP and serial ports: the rest of a partly sent message goes first."""

    def __init__(self) -> None:
        self._rest = b""
        self._moved_s = time.monotonic()

    @property
    def unsent(self) -> bool:
        """Whether the end of a message waits for room."""
        return bool(self._rest)

    def read(self) -> tuple[bytes, Peer]:
        """Return the received data, possibly empty, and their sender, the only peer."""
        try:
            data = self._take()
        except BlockingIOError:
            return b"", ()
        if not data:
            raise ConnectionResetError(errno.ECONNRESET, "the peer has closed the connection")
        return data, ()

    def write_all(self, frames: bytes, _heard: Sequence[Peer], /) -> bool:
        """Send to the only peer."""
        return self.write(frames, ())

    def write(self, frames: bytes, _peer: Peer, /) -> bool:
        """Send all of it, or nothing if there is no room; return whether it was sent."""
        self.flush()
        if self._rest:
            return False
        self._rest = frames
        self.flush()
        return True

    def flush(self) -> None:
        """Send waiting data, as far as there is room."""
        if not self._rest:
            self._moved_s = time.monotonic()
            return
        try:
            n_sent = self._give(self._rest)
        except BlockingIOError:
            n_sent = 0
        if n_sent:
            self._rest = self._rest[n_sent:]
            self._moved_s = time.monotonic()
        elif time.monotonic() - self._moved_s > _STALLED_S:
            raise TimeoutError(errno.ETIMEDOUT, "the peer does not accept data any more")

    def _take(self) -> bytes:
        raise NotImplementedError

    def _give(self, data: bytes) -> int:
        raise NotImplementedError


class _TcpPort(StreamPort):
    """A TCP connection to a server."""

    def __init__(self, address: NetAddress) -> None:
        connect_s = 1.0
        super().__init__()
        self._socket = socket.create_connection((address.host, address.port), connect_s)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # Data beyond this buffer would be too old when sent.
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)

    def fileno(self) -> int:
        """Return the number to wait on."""
        return self._socket.fileno()

    def close(self) -> None:
        """Free the port at once; waiting data are lost."""
        self._socket.close()

    def _take(self) -> bytes:
        return self._socket.recv(_READ_BYTES)

    def _give(self, data: bytes) -> int:
        return self._socket.send(data)


class SerialPort(StreamPort):
    """A serial port with eight bits, no parity, one stop bit and no flow control.

    A thread reads, because Windows cannot wait for serial ports and sockets together.

    Raises `OSError` if it is not there, not a serial port, or not ours to open.
    """

    def __init__(self, address: SerialAddress) -> None:
        # How long the reader waits for a byte before it looks whether the port was closed.
        read_s = 0.1
        bits_per_byte = 10
        super().__init__()
        # Only those who have a serial line need it.
        from serial import Serial

        self._bytes_per_s = address.baud / bits_per_byte
        # On Windows, a write that the driver does not take at once is given up after this time.
        write_s = 0.0 if os.name == "posix" else 0.1
        try:
            self._serial = Serial(
                address.device, address.baud, timeout=read_s, write_timeout=write_s
            )
        except Exception as fault:
            raise _as_os_error(fault) from fault
        self._received, self._incoming = socket.socketpair()
        self._received.setblocking(False)
        self._closing = False
        self._reader = threading.Thread(
            target=self._pour, name=f"serial {address.device}", daemon=True
        )
        self._reader.start()

    @property
    def lag_s(self) -> float:
        """How long the driver is going to send what it holds already."""
        return float(self._serial.out_waiting) / self._bytes_per_s

    def fileno(self) -> int:
        """Return the number to wait on."""
        return self._received.fileno()

    def close(self) -> None:
        """Free the port at once; what waits is lost."""
        if self._closing:
            return
        self._closing = True
        # The reader may wait for room.
        self._received.close()
        with contextlib.suppress(OSError):
            self._serial.cancel_read()
        self._reader.join()
        # Without this, closing waits until the driver has sent what it holds. Of a device that has
        # gone, pyserial also passes on errors of the system that are no OSError.
        with contextlib.suppress(Exception):
            self._serial.reset_output_buffer()
        self._serial.close()

    def _pour(self) -> None:
        """Pass on what comes until the port is closed or gone."""
        with self._incoming, contextlib.suppress(OSError):
            while not self._closing:
                size = min(_READ_BYTES, max(1, self._serial.in_waiting))
                self._incoming.sendall(self._serial.read(size))

    def _take(self) -> bytes:
        return self._received.recv(_READ_BYTES)

    def _give(self, data: bytes) -> int:
        # pyserial tries again and again while there is no room.
        if os.name == "posix" and not select.select((), (self._serial,), (), 0)[1]:
            raise BlockingIOError
        return self._serial.write(data) or 0


def _as_os_error(fault: Exception) -> OSError:
    """Return why a port cannot be opened; pyserial's own text names the device three times."""
    number = fault.args[0] if fault.args and isinstance(fault.args[0], int) else None
    if number is None:
        return OSError(0, "this is not a serial port")
    return OSError(number, os.strerror(number))


def why(fault: Exception) -> str:
    """Return the cause of a fault in a few words."""
    return (fault.strerror if isinstance(fault, OSError) else None) or str(fault)
