"""Posture as one line of JSON in a datagram, for whatever can read that."""

import errno
import math
import socket
import threading
import time
from collections.abc import Sequence

from aqualvs.errors import OptionError
from aqualvs.live.health import PartHealth, State
from aqualvs.live.outputs.mavlink_address import parse_host_port
from aqualvs.live.outputs.udp_json_line import json_line
from aqualvs.live.sample import LiveSample

_NOT_NOW = (errno.EAGAIN, errno.EWOULDBLOCK, errno.ENOBUFS, errno.EINTR)
_REOPEN_EVERY_S = 0.25
_RESOLVE_EVERY_S = 2.0
_REFUSED_FOR_S = 3.0


class UdpJsonOutput:
    """Sends every sample to every receiver.

    Parameters
    ----------
    receivers : str or sequence of str
        `HOST:PORT`, or `[IPV6]:PORT`; a broadcast address reaches all that listen in the network.

    Raises
    ------
    OptionError
        If there is none, or one that makes no sense.
    """

    inline = True
    keeps_all = False

    def __init__(self, receivers: str | Sequence[str]) -> None:
        addresses = [receivers] if isinstance(receivers, str) else list(receivers)
        if not addresses:
            raise OptionError("JSON over UDP: no receiver; give at least one HOST:PORT")
        self.name = f"json {','.join(addresses)}"
        self._receivers = [_Receiver(address) for address in addresses]
        self._closed = False

    def send(self, sample: LiveSample) -> None:
        """Send one sample; never waits, and what cannot be sent is dropped."""
        if self._closed:
            return
        line = json_line(sample)
        for receiver in self._receivers:
            receiver.send(line)

    def health(self) -> PartHealth:
        """Return how many receivers are reached, and what keeps the others."""
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


class _Receiver:
    """One address, found once and then sent to by a socket that never waits."""

    def __init__(self, address: str) -> None:
        found = parse_host_port(address)
        if found is None or not all(found):
            raise OptionError(f"JSON over UDP, receiver {address!r}: write HOST:PORT")
        self._address, (self._host, self._port) = address, found
        self.n_dropped = 0
        self._trouble = ""
        self._refused_s = self._opened_s = -math.inf
        self._socket: socket.socket | None = None
        self._closing = threading.Event()
        self._where = self._lookup(socket.AI_NUMERICHOST)
        if self._where is None:
            # Looking a name up may take seconds.
            threading.Thread(target=self._resolve, name=f"find {self._host}", daemon=True).start()

    def fault(self) -> str:
        """Return what keeps this receiver, empty if nothing does."""
        if time.monotonic() - self._refused_s < _REFUSED_FOR_S:
            return f"nobody listens at {self._address}"
        return f"{self._address}: {self._trouble}" if self._trouble else ""

    def send(self, line: bytes) -> None:
        """Send a line or drop it."""
        try:
            sent = self._open() and self._sent(line)
        except OSError as fault:
            self._trouble = fault.strerror or str(fault)
            self._drop_socket()
            sent = False
        self.n_dropped += not sent

    def close(self) -> None:
        self._closing.set()
        self._drop_socket()

    def _sent(self, line: bytes) -> bool:
        if self._socket is None:
            return False
        # A refusal belongs to an earlier datagram; this one has not been tried yet.
        for _ in range(2):
            try:
                self._socket.send(line)
            except (ConnectionRefusedError, ConnectionResetError):
                self._refused_s = time.monotonic()
            except OSError as fault:
                if fault.errno in _NOT_NOW:
                    return False
                raise
            else:
                self._trouble = ""
                return True
        return False

    def _open(self) -> bool:
        """Open the socket if it is not; return whether it is."""
        if self._socket is not None:
            return True
        now = time.monotonic()
        if self._where is None or now - self._opened_s < _REOPEN_EVERY_S:
            return False
        self._opened_s = now
        family, where = self._where
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        # Connected, so that the system tells when nobody listens.
        self._socket.connect(where)
        return True

    def _drop_socket(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _resolve(self) -> None:
        while self._where is None and not self._closing.is_set():
            self._where = self._lookup(0)
            if self._where is None:
                self._closing.wait(_RESOLVE_EVERY_S)

    def _lookup(self, flags: int) -> tuple[int, tuple[object, ...]] | None:
        """Return family and address of the host, IPv4 first; None if it is not known."""
        try:
            found = socket.getaddrinfo(self._host, self._port, type=socket.SOCK_DGRAM, flags=flags)
        except (OSError, UnicodeError) as fault:
            self._trouble = (fault.strerror if isinstance(fault, OSError) else "") or str(fault)
            return None
        self._trouble = ""
        family, _, _, _, where = min(found, key=lambda entry: entry[0] != socket.AF_INET)
        return family, where
