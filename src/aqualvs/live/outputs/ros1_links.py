"""Connections to subscribers of ROS 1 (TCPROS), all served by one thread.

A subscriber opens a connection for one topic, states its name and the type that it expects in a
header of `key=value` fields, gets such a header in return, and then messages, each behind its
length (http://wiki.ros.org/ROS/TCPROS, http://wiki.ros.org/ROS/Connection%20Header).
"""

import contextlib
import logging
import selectors
import socket
import struct
import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from typing import NamedTuple


class Ros1Type(NamedTuple):
    """A message type as publishers and subscribers agree on it."""

    name: str
    md5sum: str  # Of the definition; subscribers with another one are refused.
    definition: str  # Its text and those of all parts, as bags keep it.


# Messages that wait for a slow subscriber; newer ones replace older ones.
_WAITING = 2
_MAX_LINKS = 64
_MAX_HEADER = 65_536
_HANDSHAKE_S = 5.0
_LOOK_EVERY_S = 0.5
_TIMEOUT_S = 2.0
_ANY = "*"
_log = logging.getLogger(__name__)


class _RefusedError(Exception):
    """Refusal of a subscriber's request; the message is sent to the subscriber."""


class _Link:
    """One connection; used under the lock of `Ros1Links` only."""

    def __init__(self, connection: socket.socket, peer: str) -> None:
        self.connection, self.peer = connection, peer
        self.since_s = time.monotonic()
        self.topic = ""
        self.caller = ""
        self.received = bytearray()
        self.waiting: deque[bytes] = deque()
        self.rest = memoryview(b"")

    def wants_to_write(self) -> bool:
        return bool(self.rest or self.waiting)

    def write(self) -> None:
        """Send as much as goes.

        Raises `OSError` if the peer is gone.
        """
        while self.wants_to_write():
            if not self.rest:
                self.rest = memoryview(self.waiting.popleft())
            try:
                sent = self.connection.send(self.rest)
            except BlockingIOError:
                return
            self.rest = self.rest[sent:]


class Ros1Links:
    """Server of the subscribers of some topics, on any free port.

    `host`: address to listen at. `caller`: full name of the node. `topics`: type of each topic by
    its full name.
    """

    def __init__(self, host: str, caller: str, topics: Mapping[str, Ros1Type]) -> None:
        self._caller, self._topics = caller, dict(topics)
        self._links: set[_Link] = set()
        self._lock = threading.Lock()
        self._closing = False
        self.n_dropped = 0  # Messages that slow subscribers have missed.
        self._server = socket.create_server((host, 0), backlog=16)
        self._server.setblocking(False)
        self._wake, self._woken = socket.socketpair()
        self._wake.setblocking(False)
        self._woken.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._server, selectors.EVENT_READ)
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run, name="ros1 links", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """Port that subscribers connect to."""
        return int(self._server.getsockname()[1])

    def listeners(self) -> Counter[str]:
        """Return the number of subscribers of each topic."""
        with self._lock:
            return Counter(link.topic for link in self._links if link.topic)

    def connections(self) -> list[tuple[str, str]]:
        """Return name and topic of each subscriber."""
        with self._lock:
            return [(link.caller, link.topic) for link in self._links if link.topic]

    def publish(self, topic: str, body: bytes | memoryview) -> None:
        """Send a message to all subscribers of a topic; returns at once."""
        packet = struct.pack("<I", len(body)) + body
        with self._lock:
            for link in self._links:
                if link.topic != topic:
                    continue
                if len(link.waiting) >= _WAITING:
                    link.waiting.popleft()
                    self.n_dropped += 1
                link.waiting.append(packet)
        self._wake_thread()

    def close(self) -> None:
        """Close all connections and the port."""
        self._closing = True
        self._wake_thread()
        self._thread.join(_TIMEOUT_S)

    def _wake_thread(self) -> None:
        # If the pipe is full, the thread will wake anyway.
        with contextlib.suppress(OSError):
            self._wake.send(b"!")

    def _run(self) -> None:
        try:
            while not self._closing:
                self._poll()
        finally:
            with self._lock:
                for link in list(self._links):
                    self._disconnect(link)
            for one in (self._server, self._wake, self._woken):
                one.close()
            self._selector.close()

    def _poll(self) -> None:
        """Wait for something to happen, and deal with it."""
        ready = self._selector.select(_LOOK_EVERY_S)
        with self._lock:
            for key, _ in ready:
                if key.fileobj is self._server:
                    self._accept()
                elif key.fileobj is self._woken:
                    self._woken.recv(4096)
                else:
                    self._receive(key.data)
            for link in list(self._links):
                self._send(link)

    def _accept(self) -> None:
        try:
            connection, address = self._server.accept()
        except OSError:
            return
        if len(self._links) >= _MAX_LINKS:
            connection.close()
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link = _Link(connection, str(address[0]))
        self._links.add(link)
        self._selector.register(connection, selectors.EVENT_READ, link)

    def _receive(self, link: _Link) -> None:
        """Read from a subscriber; after the handshake only the end of the connection comes."""
        if link not in self._links:
            return
        try:
            data = link.connection.recv(4096)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._disconnect(link)
        elif not link.topic:
            link.received += data
            self._shake_hands(link)

    def _shake_hands(self, link: _Link) -> None:
        try:
            fields = _whole_header(link.received)
            if fields is None:
                return
            reply = self._reply(fields)
        except _RefusedError as refusal:
            _log.warning("subscriber at %s refused: %s", link.peer, refusal)
            link.waiting.append(_tcpros_header({"error": str(refusal)}))
            # A few octets always fit; the peer may ignore them.
            self._send(link)
            self._disconnect(link)
            return
        link.topic, link.caller = fields["topic"], fields.get("callerid", "")
        link.waiting.append(reply)

    def _reply(self, fields: Mapping[str, str]) -> bytes:
        """Return the answer to a subscriber's header."""
        topic = fields.get("topic", "")
        offered = self._topics.get(topic)
        if offered is None:
            raise _RefusedError(f"{topic or 'no topic'} is not published by {self._caller}")
        for key, own in (("type", offered.name), ("md5sum", offered.md5sum)):
            if fields.get(key, _ANY) not in (own, _ANY):
                raise _RefusedError(f"{topic} has {key} {own}, not {fields[key]}")
        return _tcpros_header(
            {
                "callerid": self._caller,
                "latching": "0",
                "md5sum": offered.md5sum,
                "message_definition": offered.definition,
                "topic": topic,
                "type": offered.name,
            }
        )

    def _send(self, link: _Link) -> None:
        if link not in self._links:
            return
        idle = not link.topic and time.monotonic() - link.since_s > _HANDSHAKE_S
        try:
            link.write()
        except OSError:
            idle = True
        if idle:
            self._disconnect(link)
            return
        events = selectors.EVENT_READ
        if link.wants_to_write():
            events |= selectors.EVENT_WRITE
        if self._selector.get_key(link.connection).events != events:
            self._selector.modify(link.connection, events, link)

    def _disconnect(self, link: _Link) -> None:
        if link in self._links:
            self._links.discard(link)
            self._selector.unregister(link.connection)
            link.connection.close()


def _tcpros_header(fields: Mapping[str, str]) -> bytes:
    body = b"".join(
        struct.pack("<I", len(pair)) + pair
        for pair in (f"{key}={value}".encode() for key, value in fields.items())
    )
    return struct.pack("<I", len(body)) + body


def _whole_header(data: bytearray) -> dict[str, str] | None:
    """Return the fields of a header; None as long as it is not complete."""
    if len(data) < 4:
        return None
    (length,) = struct.unpack_from("<I", data)
    if length > _MAX_HEADER:
        raise _RefusedError(f"header of {length} octets is too long")
    if len(data) < 4 + length:
        return None
    fields, at, end = {}, 4, 4 + length
    while at < end:
        size = struct.unpack_from("<I", data, at)[0] if at + 4 <= end else end
        if at + 4 + size > end:
            raise _RefusedError("header is damaged")
        key, _, value = data[at + 4 : at + 4 + size].decode(errors="replace").partition("=")
        fields[key] = value
        at += 4 + size
    return fields
