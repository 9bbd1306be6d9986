"""NAL units of H.264 and HEVC: their types, and the frame numbers that reveal lost pictures.

Receivers read only what shows whether a picture is missing (`FrameNumbers`, H.264), and which
packets complete a picture that another one began (`FieldPairs`, H.264); the search for places to
cut a video reads only the types of the units (`unit_reader`, H.264 and HEVC). Sections and tables
without another source are those of ITU-T H.264.
"""

import re
from collections.abc import Callable, Iterator
from enum import IntEnum
from typing import NamedTuple, TypeAlias


class Units(NamedTuple):
    """Units of a packet up to its first coded slice."""

    is_refresh: bool  # Whether the picture is an IDR picture: decoding may begin with it.
    # Whether there are any before it, and all that decoding needs.
    has_parameter_sets: bool
    has_all_parameter_sets: bool


UnitReader: TypeAlias = Callable[[memoryview], Units]
"""Reader of the units of a packet."""


class _Codec(NamedTuple):
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

    `codec`: as FFmpeg names it. `extradata`: of the stream; states whether units begin with their
    length or with a start code.
    """
    found = _CODECS.get(codec)
    if found is None:
        return None
    has_lengths = extradata[:1] == b"\x01" and len(extradata) > found.length_at
    n_length = (extradata[found.length_at] & 3) + 1 if has_lengths else 0
    return lambda packet: _units(found, (packet[at] for at in _begins(packet, n_length)))


def _units(codec: _Codec, heads: Iterator[int]) -> Units:
    sets: set[int] = set()
    for head in heads:
        kind = (head >> codec.shift) & codec.mask
        if kind in codec.parameter_sets:
            sets.add(kind)
        elif kind in codec.slices:
            return Units(kind in codec.refresh, bool(sets), sets == codec.parameter_sets)
    return Units(False, bool(sets), False)


def _begins(packet: bytes | memoryview, n_length: int) -> Iterator[int]:
    """Yield where each unit that is not empty begins, behind its length or, without, a start code.

    Found as they are asked for: most of a packet is behind its first slice.
    """
    if not n_length:
        yield from (m.end() for m in _START.finditer(packet) if m.end() < len(packet))
        return
    at = 0
    while at + n_length < len(packet):
        yield at + n_length
        at += n_length + int.from_bytes(packet[at : at + n_length], "big")


def _heads(packet: bytes | memoryview, n_length: int = 0) -> Iterator[bytes]:
    """Yield the first bytes of each unit, as many as hold all fields read here."""
    return (bytes(packet[at : at + _HEAD]) for at in _begins(packet, n_length))


class NalType(IntEnum):
    """Types of NAL units (table 7-1)."""

    SLICE = 1
    IDR = 5
    SEI = 6
    SPS = 7
    DELIMITER = 9


START_CODE = b"\x00\x00\x00\x01"

_START = re.compile(b"\x00\x00\x01")

# Bytes of a unit that hold all fields read here; a long scaling list is left unread.
_HEAD = 64

_CHROMA_PROFILES = frozenset({100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135})


class FrameNumbers:
    """Detector of missing reference pictures by their frame numbers (7.4.3, `frame_num`).

    Needed where the transport does not report losses. A decoder copies the missing picture from
    another one and says nothing.
    """

    def __init__(self) -> None:
        self._form: _SliceForm | None = None
        self._last: tuple[int, bool] | None = None

    def restart(self) -> None:
        """Forget the last picture."""
        self._last = None

    def is_gap_before(self, data: bytes) -> bool:
        """Return whether a reference picture is missing before this one.

        False also where that is unknown: before a parameter set, in streams that leave numbers out
        on purpose. `data`: all units of a picture, as a byte stream (annex B).
        """
        for unit in _heads(data):
            if len(unit) < 4:
                continue
            kind = unit[0] & 31
            if kind == NalType.SPS:
                form = _slice_form(unit)
                self._form = None if form is None or form.may_skip_numbers else form
            elif kind in (NalType.SLICE, NalType.IDR):
                if self._form is None:
                    return False
                number = self._form.number(_Bits(unit[1:]))
                last, self._last = self._last, (number, bool(unit[0] & 0x60))
                # The same number: after a picture that is no reference, or the other field of one.
                if last is None or kind == NalType.IDR or number == last[0]:
                    return False
                return not last[1] or number != (last[0] + 1) % (1 << self._form.number_bits)
        return False


class FieldPairs:
    """Detector of packets with the second field of a picture, of streams that code fields singly.

    An encoder of interlaced video may code each field by itself (PAFF), in a packet of its own. The
    decoder makes one picture of two such packets.

    `extradata`: of the stream: parameter sets, each after its length (ISO/IEC 14496-15) or a start
    code; or nothing.
    """

    def __init__(self, extradata: bytes) -> None:
        self._n_length = 0
        self._form: _SliceForm | None = None
        self._first: tuple[int, int] | None = None
        length_at = _CODECS["h264"].length_at
        if extradata[:1] == b"\x01" and len(extradata) > length_at + 3:
            self._n_length = (extradata[length_at] & 3) + 1
            # One byte for the number of sets, two for the length of the first.
            self._form = _slice_form(extradata[length_at + 4 :])
        else:
            self.is_second(extradata)

    def is_second(self, packet: bytes | memoryview) -> bool:
        """Return whether the next packet, in the order of decoding, completes the last picture."""
        for unit in _heads(packet, self._n_length):
            kind = unit[0] & 31
            if kind == NalType.SPS:
                self._form = _slice_form(unit)
            elif kind in (NalType.SLICE, NalType.IDR):
                first = None if kind == NalType.IDR else self._first
                field = None if self._form is None else self._form.field(unit)
                # 7.4.1.2.4: both fields of a picture have one frame number, and differ in parity;
                # the second one is no IDR picture.
                is_second = first is not None and field == (first[0], 1 - first[1])
                self._first = None if is_second else field
                return is_second
        return False


def field_pairs(codec: str, extradata: bytes | None) -> FieldPairs | None:
    """Return the detector of second fields for a stream; None if it is not H.264."""
    return FieldPairs(extradata or b"") if codec == "h264" else None


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


class _SliceForm(NamedTuple):
    """What a sequence parameter set says of the heads of slices (7.3.2.1.1, 7.3.3)."""

    number_bits: int  # Width of `frame_num`.
    may_skip_numbers: bool  # Whether numbers may be left out on purpose.
    may_hold_fields: bool  # Whether slices say if they are of a field.

    def number(self, bits: "_Bits") -> int:
        """Return `frame_num`, of a slice whose type byte has been read."""
        for _ in range(3):  # first_mb_in_slice, slice_type, pic_parameter_set_id
            bits.golomb()
        return bits.read(self.number_bits)

    def field(self, unit: bytes) -> tuple[int, int] | None:
        """Return frame number and parity (1: bottom) of a slice's field; None for a frame's."""
        if not self.may_hold_fields:
            return None
        bits = _Bits(unit[1:])
        number = self.number(bits)
        return (number, bits.read(1)) if bits.read(1) else None


def _slice_form(unit: bytes) -> _SliceForm | None:
    """Return what a sequence parameter set says; None if this reader does not follow it."""
    bits = _Bits(unit[1:])
    profile = bits.read(8)
    bits.read(16)
    bits.golomb()
    if profile in _CHROMA_PROFILES and not _skip_chroma(bits):
        return None
    width, order = bits.golomb() + 4, bits.golomb()
    if width > 16 or order == 1:
        return None  # Fields of the picture order's rare type 1 follow.
    if order == 0:
        bits.golomb()
    bits.golomb()
    may_skip_numbers = bool(bits.read(1))
    for _ in range(2):  # pic_width_in_mbs_minus1, pic_height_in_map_units_minus1
        bits.golomb()
    return _SliceForm(width, may_skip_numbers, may_hold_fields=not bits.read(1))


def _skip_chroma(bits: _Bits) -> bool:
    """Skip the fields of the high profiles; return False if this reader does not follow them."""
    if bits.golomb() == 3 and bits.read(1):
        return False  # Slices begin with a number of their colour plane.
    bits.golomb()
    bits.golomb()
    bits.read(1)
    return not bits.read(1)  # Scaling matrices follow.
