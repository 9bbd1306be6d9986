"""The little of H.264 that a receiver must read itself, to know whether a picture is missing.

Sections and tables are those of ITU-T H.264.
"""

import re

SLICE, IDR, SEI, SPS, PPS, DELIMITER = 1, 5, 6, 7, 8, 9
"""Types of NAL units (table 7-1)."""

START_CODE = b"\x00\x00\x00\x01"

_START = re.compile(b"\x00\x00\x01")
_HEAD = 64
"""Bytes of a unit that hold all that is read here; a long scaling list is left unread."""

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
    return [data[m.end() : m.end() + _HEAD] for m in _START.finditer(data)]


class FrameNumbers:
    """Finds missing reference pictures by the numbers that pictures carry (7.4.3, `frame_num`).

    Needed where the transport does not tell of losses. A decoder copies the missing picture from
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
            False also where that cannot be told: before a parameter set, in streams that leave
            numbers out on purpose.
        """
        for unit in nal_units(data):
            if len(unit) < 4:
                continue
            kind = unit[0] & 31
            if kind == SPS:
                self._bits = _frame_number_bits(unit)
            elif kind in (SLICE, IDR):
                return self._check(unit, is_idr=kind == IDR)
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
        if number == last[0]:  # After a picture nobody refers to, or the other field of one.
            return False
        return not last[1] or number != (last[0] + 1) % (1 << self._bits)


class _Bits:
    """Reads bits and Exp-Golomb codes (9.1) from a unit's payload; past its end come zeros."""

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
    """Pass the fields of the high profiles; False if scaling matrices follow."""
    if bits.golomb() == 3:
        bits.read(1)
    bits.golomb()
    bits.golomb()
    bits.read(1)
    return not bits.read(1)


def _skip_order(bits: _Bits) -> bool:
    """Pass the fields of the picture order; False for its type 1, which nobody sends."""
    kind = bits.golomb()
    if kind == 0:
        bits.golomb()
    return kind != 1
