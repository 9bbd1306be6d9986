"""NAL units of H.264 and HEVC: their types, and the frame numbers that reveal lost pictures.

Receivers read only what shows whether a picture is missing (`FrameNumbers`, H.264); the search for
places to cut a video reads only the types of the units (`unit_reader`, H.264 and HEVC). Sections
and tables without another source are those of ITU-T H.264.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import TypeAlias

_START_CODE = b"\x00\x00\x01"


@dataclass(frozen=True, slots=True)
class Units:
    """Units of a packet up to its first coded slice.

    Attributes
    ----------
    is_refresh : bool
        Whether the picture is an IDR picture: decoding may begin with it.
    has_parameter_sets, has_all_parameter_sets : bool
        Whether there are any before it, and all that decoding needs.
    """

    is_refresh: bool
    has_parameter_sets: bool
    has_all_parameter_sets: bool


UnitReader: TypeAlias = Callable[[memoryview], Units]
"""Reader of the units of a packet."""


@dataclass(frozen=True, slots=True)
class _Codec:
    """Codec's unit types by their number (ITU-T H.264, table 7-1; H.265, table 7-1)."""

    shift: int
    mask: int
    refresh: frozenset[int]
    slices: range
    parameter_sets: frozenset[int]
    # Position of the size of a unit's length in the extradata of a file (ISO/IEC 14496-15).
    length_at: int


_CODECS = {
    "h264": _Codec(0, 0x1F, frozenset({5}), range(1, 6), frozenset({7, 8}), 4),
    "hevc": _Codec(1, 0x3F, frozenset({19, 20}), range(32), frozenset({32, 33, 34}), 21),
}


def unit_reader(codec: str, extradata: bytes) -> UnitReader | None:
    """Return the function that reads a stream's packets; None for a codec without such units.

    Parameters
    ----------
    codec : str
        As FFmpeg names it.
    extradata : bytes
        Of the stream; states whether units begin with their length or with a start code.
    """
    found = _CODECS.get(codec)
    if found is None:
        return None
    if extradata[:1] == b"\x01" and len(extradata) > found.length_at:
        n_length = (extradata[found.length_at] & 3) + 1
        return lambda packet: _units(found, _by_length(packet, n_length))
    return lambda packet: _units(found, _by_start_code(bytes(packet)))


def _units(codec: _Codec, heads: Iterator[int]) -> Units:
    sets: set[int] = set()
    for head in heads:
        kind = (head >> codec.shift) & codec.mask
        if kind in codec.parameter_sets:
            sets.add(kind)
        elif kind in codec.slices:
            return Units(kind in codec.refresh, bool(sets), sets == codec.parameter_sets)
    return Units(False, bool(sets), False)


def _by_length(packet: memoryview, n_length: int) -> Iterator[int]:
    """Yield the first byte of each unit."""
    at = 0
    while at + n_length < len(packet):
        yield packet[at + n_length]
        at += n_length + int.from_bytes(packet[at : at + n_length], "big")


def _by_start_code(packet: bytes) -> Iterator[int]:
    at = packet.find(_START_CODE)
    while 0 <= at < len(packet) - len(_START_CODE):
        at += len(_START_CODE)
        yield packet[at]
        at = packet.find(_START_CODE, at)


class NalType(IntEnum):
    """Types of NAL units (table 7-1)."""

    SLICE = 1
    IDR = 5
    SEI = 6
    SPS = 7
    PPS = 8
    DELIMITER = 9


START_CODE = b"\x00\x00\x00\x01"

_START = re.compile(b"\x00\x00\x01")

_CHROMA_PROFILES = frozenset({100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135})


def nal_units(data: bytes) -> list[bytes]:
    """Return the beginnings of the NAL units of a byte stream (annex B).

    Parameters
    ----------
    data : bytes

    Returns
    -------
    units : list of bytes
        At most 64 bytes of each, without start code.
    """
    # Bytes of a unit that hold all fields read here; a long scaling list is left unread.
    head = 64
    return [data[m.end() : m.end() + head] for m in _START.finditer(data)]


class FrameNumbers:
    """Detector of missing reference pictures by their frame numbers (7.4.3, `frame_num`).

    Needed where the transport does not report losses. A decoder copies the missing picture from
    another one and says nothing.
    """

    def __init__(self) -> None:
        self._bits: int | None = None
        self._last: tuple[int, bool] | None = None

    def restart(self) -> None:
        """Forget the last picture."""
        self._last = None

    def is_gap_before(self, data: bytes) -> bool:
        """Return whether a reference picture is missing before this one.

        Parameters
        ----------
        data : bytes
            All units of a picture, as a byte stream (annex B).

        Returns
        -------
        gap : bool
            False also where that is unknown: before a parameter set, in streams that leave
            numbers out on purpose.
        """
        for unit in nal_units(data):
            if len(unit) < 4:
                continue
            kind = unit[0] & 31
            if kind == NalType.SPS:
                self._bits = _frame_number_bits(unit)
            elif kind in (NalType.SLICE, NalType.IDR):
                return self._check(unit, is_idr=kind == NalType.IDR)
        return False

    def _check(self, unit: bytes, *, is_idr: bool) -> bool:
        if self._bits is None:
            return False
        bits = _Bits(unit[1:])
        for _ in range(3):  # first_mb_in_slice, slice_type, pic_parameter_set_id
            bits.golomb()
        number = bits.read(self._bits)
        last, self._last = self._last, (number, bool(unit[0] & 0x60))
        if last is None or is_idr:
            return False
        if number == last[0]:  # After a picture that is no reference, or the other field of one.
            return False
        return not last[1] or number != (last[0] + 1) % (1 << self._bits)


class _Bits:
    """Reader of bits and Exp-Golomb codes (9.1) of a unit's payload; zeros past its end."""

    def __init__(self, payload: bytes) -> None:
        raw = payload.replace(b"\x00\x00\x03", b"\x00\x00")
        self._value = int.from_bytes(raw, "big")
        self._left = 8 * len(raw)

    def read(self, n: int) -> int:
        self._left -= n
        if self._left < 0:
            return 0
        return (self._value >> self._left) & ((1 << n) - 1)

    def golomb(self) -> int:
        zeros = 0
        while self._left > 0 and not self.read(1):
            zeros += 1
        return (1 << zeros) - 1 + self.read(zeros)


def _frame_number_bits(unit: bytes) -> int | None:
    """Return the width of `frame_num` that a sequence parameter set states (7.3.2.1.1).

    None if numbers may be left out, or the set is one that this reader does not follow.
    """
    bits = _Bits(unit[1:])
    profile = bits.read(8)
    bits.read(16)
    bits.golomb()
    if profile in _CHROMA_PROFILES and not _skip_chroma(bits):
        return None
    width = bits.golomb() + 4
    if not _skip_order(bits):
        return None
    bits.golomb()
    may_leave_out = bits.read(1)
    return None if may_leave_out or width > 16 else width


def _skip_chroma(bits: _Bits) -> bool:
    """Skip the fields of the high profiles; return False if scaling matrices follow."""
    if bits.golomb() == 3:
        bits.read(1)
    bits.golomb()
    bits.golomb()
    bits.read(1)
    return not bits.read(1)


def _skip_order(bits: _Bits) -> bool:
    """Skip the fields of the picture order; return False for its rare type 1."""
    kind = bits.golomb()
    if kind == 0:
        bits.golomb()
    return kind != 1
