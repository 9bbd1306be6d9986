"""MAVLink frames from a telemetry log; only frames of the wanted messages are decoded.

A telemetry log is a sequence of records: the time of receipt (UTC, microseconds, big-endian, 8
bytes) and a MAVLink 1 or 2 frame (https://mavlink.io/en/guide/serialization.html). The reader goes
from header to header, and checks and decodes only wanted frames, all of one kind at once.
"""

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, IntArray

# First byte of a frame of MAVLink 1 and 2.
MAGIC_1, MAGIC_2 = 0xFE, 0xFD
# Bytes of the time of receipt, of a frame's header and of its checksum.
_STAMP = 8
_HEADER = {MAGIC_1: 6, MAGIC_2: 10}
_CHECKSUM = 2
_SHORTEST = _STAMP + _HEADER[MAGIC_1] + _CHECKSUM
# Time of receipt up to the year 2100, and the first byte of a frame.
_RECORD = re.compile(rb"\x00[\x00-\x0e].{6}[\xfd\xfe]", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Message:
    """Wire layout of one message: fields in the order of their transfer, little-endian."""

    name: str  # As in MAVLink's definitions.
    fields: tuple[tuple[str, str], ...]  # Name and NumPy type; extensions are left out.
    crc_extra: int  # Seed of the checksum, which depends on the definition of the message.

    @property
    def dtype(self) -> np.dtype[np.void]:
        """NumPy type of the payload."""
        return np.dtype(list(self.fields))


def _fields(**names: str) -> tuple[tuple[str, str], ...]:
    """Return fields by their type, as MAVLink orders them: the longest first."""
    return tuple((name, f"<{kind}") for kind, listed in names.items() for name in listed.split())


_BOOT = ("time_boot_ms", "<u4")
MESSAGES: Mapping[int, Message] = {
    0: Message(
        "HEARTBEAT",
        _fields(u4="custom_mode", u1="type autopilot base_mode system_status mavlink_version"),
        50,
    ),
    30: Message(
        "ATTITUDE", (_BOOT, *_fields(f4="roll pitch yaw rollspeed pitchspeed yawspeed")), 39
    ),
    # For its time alone.
    32: Message("LOCAL_POSITION_NED", (_BOOT, *_fields(f4="x y z vx vy vz")), 185),
    33: Message(
        "GLOBAL_POSITION_INT",
        (_BOOT, *_fields(i4="lat lon alt relative_alt", i2="vx vy vz", u2="hdg")),
        104,
    ),
    74: Message(
        "VFR_HUD", _fields(f4="airspeed groundspeed alt climb", i2="heading", u2="throttle"), 20
    ),
    137: Message(
        "SCALED_PRESSURE2", (_BOOT, *_fields(f4="press_abs press_diff", i2="temperature")), 195
    ),
    178: Message("AHRS2", _fields(f4="roll pitch yaw altitude", i4="lat lng"), 47),
}
"""By message id: the messages that are read (definitions: common.xml, ardupilotmega.xml)."""


@dataclass(frozen=True, slots=True)
class Table:
    """All valid frames of one message, in the order of the file."""

    at: IntArray  # Shape (n,): offsets in the file.
    received_us: IntArray  # Shape (n,): time of receipt, UTC, in microseconds.
    source: IntArray  # Shape (n,): sender: 256 times the system id plus the component id.
    payload: np.ndarray  # Shape (n,): fields as in `MESSAGES`.

    def __getitem__(self, rows: BoolArray | IntArray) -> "Table":
        """Return the frames marked by a mask (n,), or with these numbers, in their order."""
        return Table(self.at[rows], self.received_us[rows], self.source[rows], self.payload[rows])


class SelectedMessages(NamedTuple):
    """Wanted messages of a telemetry log."""

    tables: Mapping[str, Table]  # By message name; messages without a frame are missing.
    n_frames: int  # Number of frames of any kind.
    n_failed: int  # Number of wanted frames with a wrong checksum, which are left out.
    # Sections without frames: offset in the file, and length in bytes.
    skipped: tuple[tuple[int, int], ...]


def looks_like_frames(head: bytes) -> bool:
    """Return whether the beginning of a file contains two consecutive records."""
    return _next_record(head, 0) is not None


def read_frames(data: bytes) -> SelectedMessages:
    """Read the wanted messages of a telemetry log.

    `data`: the whole file.
    """
    places, n_frames, skipped = _scan(data)
    octets = np.frombuffer(data, np.uint8)
    tables: dict[str, list[Table]] = defaultdict(list)
    n_failed = 0
    for (number, magic), starts in places.items():
        at = np.array(starts, np.int64)
        table, sound = _decode(octets, at, MESSAGES[number], magic)
        n_failed += int(np.count_nonzero(~sound))
        if sound.any():
            tables[MESSAGES[number].name].append(table[sound])
    joined = {name: _joined(versions) for name, versions in tables.items()}
    return SelectedMessages(joined, n_frames, n_failed, tuple(skipped))


def _scan(data: bytes) -> tuple[dict[tuple[int, int], list[int]], int, list[tuple[int, int]]]:
    """Walk over the records.

    Returns the offsets of wanted frames by message id and first byte, the number of frames, and the
    sections without frames.
    """
    places: dict[tuple[int, int], list[int]] = defaultdict(list)
    skipped: list[tuple[int, int]] = []
    size, n_frames, last, at = len(data), 0, 0, 0
    while at + _SHORTEST <= size:
        end = _record_end(data, at)
        if end is None:
            # A record that lost bytes overlaps the next ones, so the search begins within it.
            found = _next_record(data, last + 1 if n_frames else 0)
            begin = at if found is None or found >= at else last
            skipped.append((begin, (size if found is None else found) - begin))
            if found is None:
                return places, n_frames, skipped
            last = at = found
            continue
        if end > size:
            break
        n_frames += 1
        magic = data[at + _STAMP]
        number = data[at + 13]
        if magic == MAGIC_2:
            number = data[at + 15] | data[at + 16] << 8 | data[at + 17] << 16
        if number in MESSAGES:
            places[number, magic].append(at)
        last, at = at, end
    if at < size:
        skipped.append((at, size - at))
    return places, n_frames, skipped


def _record_end(data: bytes, start: int) -> int | None:
    """Return the end of the record that starts at `start`; None if there is no record."""
    magic = data[start + _STAMP]
    # Second byte of the microseconds since 1970 in the year 2100; the first is 0.
    latest = 0x0E
    if (magic != MAGIC_2 and magic != MAGIC_1) or data[start] or data[start + 1] > latest:
        return None
    end = start + _STAMP + _HEADER[magic] + data[start + 9] + _CHECKSUM
    if magic == MAGIC_1:
        return end
    # Flags are 0, or 1 for a frame with a signature.
    flags, signature = data[start + 10], 13
    return end + flags * signature if flags <= 1 else None


def _next_record(data: bytes, start: int) -> int | None:
    """Return the offset of the next record that another, or the end of the file, follows."""
    for match in _RECORD.finditer(data, start):
        at = match.start()
        if at + _SHORTEST > len(data):
            break
        end = _record_end(data, at)
        if end is None or end > len(data):
            continue
        if end + _SHORTEST > len(data) or _record_end(data, end) is not None:
            return at
    return None


def _decode(
    octets: np.ndarray, at: IntArray, message: Message, magic: int
) -> tuple[Table, BoolArray]:
    """Decode frames of one message and version; return them, and the mask of valid ones."""
    header = _HEADER[magic]
    frame = at + _STAMP
    length = octets[frame + 1].astype(np.int64)
    size = message.dtype.itemsize
    # MAVLink 2 truncates trailing zeros; they are restored as zeros.
    column = np.arange(size)
    inside = column < length[:, None]
    places = np.where(inside, frame[:, None] + header + column, 0)
    payload = np.where(inside, octets[places], 0).astype(np.uint8)
    stamps = octets[at[:, None] + np.arange(_STAMP)].astype(np.int64)
    received_us = (stamps << (8 * np.arange(_STAMP)[::-1])).sum(axis=1)
    sender = frame + (5 if magic == MAGIC_2 else 3)
    source = octets[sender].astype(np.int64) * 256 + octets[sender + 1]
    sound = _checksums_agree(octets, frame, header - 1 + length, message.crc_extra)
    if magic == MAGIC_1:
        sound &= length >= size
    table = Table(at, received_us, source, np.ascontiguousarray(payload).view(message.dtype)[:, 0])
    return table, sound


def _checksums_agree(
    octets: np.ndarray, frame: IntArray, length: IntArray, crc_extra: int
) -> BoolArray:
    """Check CRC-16/MCRF4XX over all but the magic, with the message's seed at the end."""
    crc = np.full(len(frame), 0xFFFF, np.uint16)
    for i in range(int(length.max(initial=0))):
        going = i < length
        crc[going] = _updated(crc[going], octets[frame[going] + 1 + i])
    crc = _updated(crc, np.full(len(frame), crc_extra, np.uint8))
    end = frame + 1 + length
    agree: BoolArray = (crc & 0xFF == octets[end]) & (crc >> 8 == octets[end + 1])
    return agree


def _updated(crc: np.ndarray, octet: np.ndarray) -> np.ndarray:
    updated: np.ndarray = _CRC[(crc ^ octet) & 0xFF] ^ (crc >> 8)
    return updated


def _crc_table() -> np.ndarray:
    table = np.arange(256, dtype=np.uint16)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ 0x8408, table >> 1).astype(np.uint16)
    return table


_CRC = _crc_table()


def _joined(versions: Sequence[Table]) -> Table:
    """Return the frames of both versions of MAVLink, in the order of the file."""
    columns = ([getattr(one, f.name) for one in versions] for f in fields(Table))
    joined = Table(*map(np.concatenate, columns))
    return joined[np.argsort(joined.at, kind="stable")]
