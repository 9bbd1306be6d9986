"""UDP datagrams: addresses, a receiver with its own thread, and detection of their content.

`Datagrams` takes datagrams from the system as they arrive, and tells when their kind (RTP with
H.264, MPEG-TS, bare H.264) changes.
"""

import contextlib
import errno
import queue
import socket
import struct
import threading
import time
from dataclasses import dataclass
from ipaddress import IPv6Address, ip_address
from typing import NamedTuple
from urllib.parse import urlsplit

from aqualvs.errors import SourceError
from aqualvs.sources.live_frames import Reception
from aqualvs.sources.rtp import PACKET_BYTES, SYNC, parse_rtp


@dataclass(frozen=True, slots=True)
class UdpAddress:
    """Address and port to listen on."""

    host: str  # An address of this machine, a multicast group, or empty for every address.
    port: int  # 0 for any free one.

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"


def parse_udp(where: str) -> UdpAddress:
    """Return where to listen, from `udp://HOST:PORT`, `rtp://HOST:PORT` and the like.

    `where`: host may be missing, or written as `@` or `@HOST`; options after `?` are ignored.
    Raises `SourceError` if there is no port, or the host is no numeric address.
    """
    scheme = where.partition("://")[0]
    try:
        parts = urlsplit(where)
        host, port = (parts.hostname or "").strip("@"), parts.port
    except ValueError:
        port = None
    if port is None:
        raise SourceError(f"{where}: no port; type {scheme}://:5600, for instance")
    if host == "localhost":
        host = "127.0.0.1"
    try:
        return UdpAddress(str(ip_address(host)) if host else "", port)
    except ValueError:
        raise SourceError(
            f"{where}: listening needs a numeric address of this machine, or none; "
            f"type {scheme}://:{port}"
        ) from None


class Datagram(NamedTuple):
    """Content of a datagram, and its arrival by the monotonic clock (seconds)."""

    content: bytes
    arrival: float


def listening_fault(address: UdpAddress, fault: OSError) -> str:
    """Return in a few words why the system refuses to listen."""
    if fault.errno == errno.EADDRINUSE:
        return f"port {address.port} is taken by another program, such as QGroundControl"
    if fault.errno == errno.EADDRNOTAVAIL:
        return (
            f"{address.host} is not an address of this machine; connect the tether, "
            f"or listen on all with udp://:{address.port}"
        )
    return f"cannot listen on {address} ({fault.strerror})"


def _listen(address: UdpAddress) -> socket.socket:
    host = ip_address(address.host) if address.host else None
    family = socket.AF_INET6 if isinstance(host, IPv6Address) else socket.AF_INET
    made = socket.socket(family, socket.SOCK_DGRAM)
    # Size of the receive buffer; the system may grant less. A key frame comes in one burst.
    buffer_bytes = 4 << 20
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer_bytes)
        if host is not None and host.is_multicast:
            made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            made.bind(("", address.port))
            if isinstance(host, IPv6Address):
                group = host.packed + struct.pack("@I", 0)
                made.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, group)
            else:
                # On any interface.
                group = host.packed + bytes(4)
                made.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
        else:
            made.bind((address.host, address.port))
    except BaseException:
        made.close()
        raise
    return made


RTP, TS, BARE = "RTP H.264", "MPEG-TS", "bare H.264"
"""Kinds of content, as health reports name them."""


WAIT_S = 0.2
"""Longest wait for datagrams, so that an end is noticed."""

MAX_FOREIGN = 5
"""Datagrams in a row of another kind, after which the sender has changed its content."""

_MAX_LAG_S = 2.0
"""Datagrams that wait longer for decoding are dropped: this machine does not keep up."""


def kind_of(datagram: bytes) -> str | None:
    """Return "RTP H.264", "MPEG-TS" or "bare H.264" for a datagram's content, or None."""
    if transport_content(datagram) is not None:
        return TS
    if datagram.startswith((b"\x00\x00\x01", b"\x00\x00\x00\x01")):
        return BARE
    packet = parse_rtp(datagram)
    return None if packet is None or packet.payload_type < 96 else RTP


def transport_content(datagram: bytes) -> bytes | None:
    """Return the MPEG-TS packets in a datagram, bare or in RTP (RFC 2250), or None."""
    ts_in_rtp = 33
    if datagram[:1] != bytes([SYNC]):
        packet = parse_rtp(datagram)
        if packet is None or packet.payload_type != ts_in_rtp:
            return None
        datagram = packet.payload
    whole = len(datagram) % PACKET_BYTES == 0
    return datagram if whole and set(datagram[::PACKET_BYTES]) == {SYNC} else None


class Datagrams:
    """Receiver on a UDP port, and queue of what comes; its thread empties the system's buffer.

    `ended`: set when the feed ends. `reception`: told of what cannot be used. Raises `OSError` if
    the system refuses to listen: the port is taken, the address is none of this machine.
    """

    def __init__(self, address: UdpAddress, ended: threading.Event, reception: Reception) -> None:
        self.ended, self.reception = ended, reception
        self._socket = _listen(address)
        self.port: int = self._socket.getsockname()[1]
        self._waiting: queue.SimpleQueue[Datagram | None] = queue.SimpleQueue()
        self._peeked: Datagram | None = None
        self._n_foreign = 0
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._receive, name="datagrams", daemon=True)
        self._thread.start()

    def peek_kind(self) -> str | None:
        """Look at the next datagram; None if none comes, or one of no known kind."""
        datagram = self.get()
        if datagram is None:
            return None
        kind = kind_of(datagram.content)
        if kind is None:
            self.reception.note_fault(
                "something comes, but neither RTP H.264 nor MPEG-TS nor H.264"
            )
        self._peeked = None if kind is None else datagram
        return kind

    def get(self, timeout: float = WAIT_S) -> Datagram | None:
        """Return the oldest datagram, or None if there is none in time, or after `wake`.

        `timeout`: seconds.
        """
        peeked, self._peeked = self._peeked, None
        with contextlib.suppress(queue.Empty):
            return peeked or self._waiting.get(timeout=timeout)
        return None

    def is_late(self, datagram: Datagram) -> bool:
        """Return whether decoding the oldest lags too far behind; if so, drop what waits."""
        if time.monotonic() - datagram.arrival < _MAX_LAG_S:
            return False
        for _ in range(self._waiting.qsize()):
            self._waiting.get()
        return True

    def is_foreign(self, datagram: Datagram, *, fits: bool) -> bool:
        """Return whether the sender has changed its kind; `fits`: whether this one is as before."""
        self._n_foreign = 0 if fits else self._n_foreign + 1
        if self._n_foreign < MAX_FOREIGN:
            return False
        self._n_foreign = 0
        return kind_of(datagram.content) is not None

    def wake(self) -> None:
        """End a `get` that waits; called from any thread."""
        self._waiting.put(None)

    def close(self) -> None:
        """Stop listening."""
        self._closed.set()
        self._thread.join()
        self._socket.close()

    def _receive(self) -> None:
        # Period in which the receiver checks whether to end.
        look_s = 0.2
        self._socket.settimeout(look_s)
        # Datagrams kept for a late reader; further ones are lost, and counted as such.
        max_waiting = 20_000
        now = time.monotonic()
        while not self._closed.is_set():
            content = None
            try:
                content = self._socket.recv(65536)
            except TimeoutError:
                pass
            except OSError:  # Such as an ICMP error that Windows reports here.
                time.sleep(0.01)
            before, now = now, time.monotonic()
            if now - before > _MAX_LAG_S:
                # The process stood still, and what the system has kept meanwhile may be as old:
                # all but one is dropped, with an arrival that shows the reader that it is late.
                content, arrival = self._latest(look_s) or content, before
            else:
                arrival = now
            if content is not None and self._waiting.qsize() < max_waiting:
                self._waiting.put(Datagram(content, arrival))

    def _latest(self, timeout: float) -> bytes | None:
        """Empty the system's buffer; return the last datagram of it."""
        content = None
        self._socket.setblocking(False)
        with contextlib.suppress(OSError):
            while True:
                content = self._socket.recv(65536)
        self._socket.settimeout(timeout)
        return content
