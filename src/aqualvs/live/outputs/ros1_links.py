"""Messages of ROS 1 and connections to its subscribers (TCPROS), all served by one thread.

A subscriber opens a connection for one topic, states its name and the type that it expects in a
header of `key=value` fields, gets such a header in return, and then messages, each behind its
length (http://wiki.ros.org/ROS/TCPROS).

Messages have definitions and checksums; their bytes are little-endian without padding, and a string
or list follows its length (http://wiki.ros.org/ROS/Connection%20Header and msg).
"""

import contextlib
import logging
import selectors
import socket
import struct
import threading
import time
from collections import Counter, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from aqualvs.live.outputs.ros_messages import (
    POINT_FIELDS,
    POINT_TYPE,
    CloudMessage,
    DiagnosticsMessage,
    DiagnosticStatus,
    Message,
    PoseMessage,
    PublishedTopic,
    RangeMessage,
)

_RULE = 80 * "="

_PARTS = {
    "std_msgs/Header": "uint32 seq\ntime stamp\nstring frame_id",
    "geometry_msgs/PoseWithCovariance": "Pose pose\nfloat64[36] covariance",
    "geometry_msgs/Pose": "Point position\nQuaternion orientation",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "sensor_msgs/PointField": (
        "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\n"
        "uint8 UINT32=6\nuint8 FLOAT32=7\nuint8 FLOAT64=8\n"
        "string name\nuint32 offset\nuint8 datatype\nuint32 count"
    ),
    "diagnostic_msgs/DiagnosticStatus": (
        "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\nbyte level\nstring name\n"
        "string message\nstring hardware_id\nKeyValue[] values"
    ),
    "diagnostic_msgs/KeyValue": "string key\nstring value",
}


@dataclass(frozen=True, slots=True)
class Ros1Type:
    """A message type as publishers and subscribers agree on it."""

    name: str
    md5sum: str  # Of the definition; subscribers with another one are refused.
    definition: str  # Its text and those of all parts, as bags keep it.


def _type(name: str, text: str, parts: Iterable[str], md5sum: str) -> Ros1Type:
    more = (f"{_RULE}\nMSG: {part}\n{_PARTS[part]}\n" for part in parts)
    return Ros1Type(name, md5sum, "".join((f"{text}\n", *more)))


_POSE_TYPE = _type(
    "geometry_msgs/PoseWithCovarianceStamped",
    "Header header\nPoseWithCovariance pose",
    (
        "std_msgs/Header",
        "geometry_msgs/PoseWithCovariance",
        "geometry_msgs/Pose",
        "geometry_msgs/Point",
        "geometry_msgs/Quaternion",
    ),
    "953b798c0f514ff060a53a3498ce6246",
)

ROS1_TYPES = {
    PublishedTopic.POSTURE: _POSE_TYPE,
    PublishedTopic.FILTERED: _POSE_TYPE,
    PublishedTopic.RANGE: _type(
        "sensor_msgs/Range",
        "Header header\nuint8 ULTRASOUND=0\nuint8 INFRARED=1\nuint8 radiation_type\n"
        "float32 field_of_view\nfloat32 min_range\nfloat32 max_range\nfloat32 range",
        ("std_msgs/Header",),
        "c005c34273dc426c67a020a87bc24148",
    ),
    PublishedTopic.CLOUD: _type(
        "sensor_msgs/PointCloud2",
        "Header header\nuint32 height\nuint32 width\nPointField[] fields\nbool is_bigendian\n"
        "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense",
        ("std_msgs/Header", "sensor_msgs/PointField"),
        "1158d486dd51d683ce2f1be655c3c181",
    ),
    PublishedTopic.DIAGNOSTICS: _type(
        "diagnostic_msgs/DiagnosticArray",
        "Header header\nDiagnosticStatus[] status",
        ("std_msgs/Header", "diagnostic_msgs/DiagnosticStatus", "diagnostic_msgs/KeyValue"),
        "60810da900de1dd6ddd437c3503511da",
    ),
}
"""Type of each topic."""


def to_ros1(message: Message, seq: int) -> bytes:
    """Return a message as bytes.

    `seq`: number of the message on its topic.
    """
    match message:
        case PoseMessage():
            numbers = (*message.position, *message.quaternion, *message.covariance)
            content = struct.pack("<43d", *numbers)
            return _header(seq, message.stamp_ns, message.frame_id) + content
        case RangeMessage():
            infrared, view = 1, message.field_of_view
            ranges = message.min_range, message.max_range, message.range
            content = struct.pack("<B4f", infrared, view, *ranges)
            return _header(seq, message.stamp_ns, message.frame_id) + content
        case CloudMessage():
            return _cloud(message, seq)
        case DiagnosticsMessage():
            return _diagnostics(message, seq)


def text(value: str) -> bytes:
    """Return a string behind its length."""
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def _header(seq: int, stamp_ns: int, frame_id: str) -> bytes:
    secs, nsecs = divmod(stamp_ns, 10**9)
    return struct.pack("<III", seq & 0xFFFFFFFF, secs, nsecs) + text(frame_id)


_FIELDS = struct.pack("<I", len(POINT_FIELDS)) + b"".join(
    text(field.name) + struct.pack("<IBI", field.offset, field.datatype, 1)
    for field in POINT_FIELDS
)


def _cloud(message: CloudMessage, seq: int) -> bytes:
    step = POINT_TYPE.itemsize
    return b"".join(
        (
            _header(seq, message.stamp_ns, message.frame_id),
            struct.pack("<II", 1, message.width),
            _FIELDS,
            struct.pack("<BIII", 0, step, step * message.width, len(message.data)),
            message.data,
            struct.pack("<B", message.is_dense),
        )
    )


def _diagnostics(message: DiagnosticsMessage, seq: int) -> bytes:
    return b"".join(
        (
            _header(seq, message.stamp_ns, ""),
            struct.pack("<I", len(message.statuses)),
            *(_status(status) for status in message.statuses),
        )
    )


def _status(status: DiagnosticStatus) -> bytes:
    return b"".join(
        (
            struct.pack("<b", status.level),
            text(status.name),
            text(status.message),
            text(status.hardware_id),
            struct.pack("<I", len(status.values)),
            *(text(one) for pair in status.values for one in pair),
        )
    )


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
        self.asked = bytearray()
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
    """Server of the subscribers of some topics.

    Parameters
    ----------
    host : str
        Address to listen at, on any free port.
    caller : str
        Full name of the node.
    topics : mapping
        Type of each topic by its full name.
    """

    def __init__(self, host: str, caller: str, topics: Mapping[str, Ros1Type]) -> None:
        self._caller, self._topics = caller, dict(topics)
        self._links: set[_Link] = set()
        self._lock = threading.Lock()
        self._closing = False
        self._n_dropped = 0
        self._server = socket.create_server((host, 0), backlog=16)
        self._server.setblocking(False)
        self._wake, self._woken = socket.socketpair()
        self._wake.setblocking(False)
        self._woken.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._server, selectors.EVENT_READ)
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._work, name="ros1 links", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """Port that subscribers connect to."""
        return int(self._server.getsockname()[1])

    @property
    def n_dropped(self) -> int:
        """Messages that a slow subscriber has missed."""
        return self._n_dropped

    def listeners(self) -> Counter[str]:
        """Return the number of subscribers of each topic."""
        with self._lock:
            return Counter(link.topic for link in self._links if link.topic)

    def connections(self) -> list[tuple[str, str]]:
        """Return name and topic of each subscriber."""
        with self._lock:
            return [(link.caller, link.topic) for link in self._links if link.topic]

    def publish(self, topic: str, body: bytes) -> None:
        """Send a message to all subscribers of a topic; returns at once."""
        packet = struct.pack("<I", len(body)) + body
        with self._lock:
            for link in self._links:
                if link.topic != topic:
                    continue
                if len(link.waiting) >= _WAITING:
                    link.waiting.popleft()
                    self._n_dropped += 1
                link.waiting.append(packet)
        self._rouse()

    def close(self) -> None:
        """Close all connections and the port."""
        self._closing = True
        self._rouse()
        self._thread.join(_TIMEOUT_S)

    def _rouse(self) -> None:
        # If the pipe is full, the thread will wake anyway.
        with contextlib.suppress(OSError):
            self._wake.send(b"!")

    def _work(self) -> None:
        try:
            while not self._closing:
                self._attend()
        finally:
            with self._lock:
                for link in list(self._links):
                    self._part(link)
            for one in (self._server, self._wake, self._woken):
                one.close()
            self._selector.close()

    def _attend(self) -> None:
        """Wait for something to happen, and deal with it."""
        ready = self._selector.select(_LOOK_EVERY_S)
        with self._lock:
            for key, _ in ready:
                if key.fileobj is self._server:
                    self._greet()
                elif key.fileobj is self._woken:
                    self._woken.recv(4096)
                else:
                    self._hear(key.data)
            for link in list(self._links):
                self._serve(link)

    def _greet(self) -> None:
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

    def _hear(self, link: _Link) -> None:
        """Read from a subscriber; after the handshake only the end of the connection comes."""
        if link not in self._links:
            return
        try:
            told = link.connection.recv(4096)
        except BlockingIOError:
            return
        except OSError:
            told = b""
        if not told:
            self._part(link)
        elif not link.topic:
            link.asked += told
            self._shake_hands(link)

    def _shake_hands(self, link: _Link) -> None:
        try:
            fields = _whole_header(link.asked)
            if fields is None:
                return
            reply = self._accepted(fields)
        except _RefusedError as refusal:
            _log.warning("subscriber at %s refused: %s", link.peer, refusal)
            link.waiting.append(_tcpros_header({"error": str(refusal)}))
            # A few octets always fit; the peer may ignore them.
            self._serve(link)
            self._part(link)
            return
        link.topic, link.caller = fields["topic"], fields.get("callerid", "")
        link.waiting.append(reply)

    def _accepted(self, fields: Mapping[str, str]) -> bytes:
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

    def _serve(self, link: _Link) -> None:
        if link not in self._links:
            return
        idle = not link.topic and time.monotonic() - link.since_s > _HANDSHAKE_S
        try:
            link.write()
        except OSError:
            idle = True
        if idle:
            self._part(link)
            return
        events = selectors.EVENT_READ
        if link.wants_to_write():
            events |= selectors.EVENT_WRITE
        if self._selector.get_key(link.connection).events != events:
            self._selector.modify(link.connection, events, link)

    def _part(self, link: _Link) -> None:
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
