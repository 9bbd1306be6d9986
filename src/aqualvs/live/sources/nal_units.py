"""Which units a packet of H.264 or HEVC holds, as far as it matters for cutting."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

_START_CODE = b"\x00\x00\x01"


@dataclass(frozen=True, slots=True)
class Units:
    """What comes before and with the first coded slice of a packet.

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
"""Tells what a packet holds."""


@dataclass(frozen=True, slots=True)
class _Codec:
    """Types of units by their number (ITU-T H.264, table 7-1; H.265, table 7-1)."""

    shift: int
    mask: int
    refresh: frozenset[int]
    slices: range
    parameter_sets: frozenset[int]
    # Where the size of a unit's length stands in the extradata of a file (ISO/IEC 14496-15).
    length_at: int


_CODECS = {
    "h264": _Codec(0, 0x1F, frozenset({5}), range(1, 6), frozenset({7, 8}), 4),
    "hevc": _Codec(1, 0x3F, frozenset({19, 20}), range(32), frozenset({32, 33, 34}), 21),
}


def unit_reader(codec: str, extradata: bytes) -> UnitReader | None:
    """Return what reads the packets of a stream; None for a codec without such units.

    Parameters
    ----------
    codec : str
        As FFmpeg names it.
    extradata : bytes
        Of the stream; tells whether units begin with their length or with a start code.
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
