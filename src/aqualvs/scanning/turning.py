"""Squares of a picture turned, so that its columns become rows: 64 by 64 bytes at a time.

As in `lanes`, LLVM's portable vector types are used: bytes of eight rows are brought together by
interleaving, then the pieces of eight such bands.
"""

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import types
from numba.extending import intrinsic

from aqualvs.geometry.compiled import inline_borrowing_kernel
from aqualvs.scanning.lanes import LANES, Generate, U8Array, byte_address, load_bytes

SQUARE = LANES
"""Rows and columns of a square."""

_ROWS = 8
_WORDS = ir.VectorType(ir.IntType(64), SQUARE // _ROWS)


@inline_borrowing_kernel
def turn_slab(slab: U8Array, pieces: U8Array, out: U8Array, at: int) -> None:
    """Write the columns of `SQUARE` rows.

    Parameters
    ----------
    slab : uint8 array, shape (SQUARE, whole squares)
        Rows of a picture.
    pieces : uint8 array, shape (SQUARE, SQUARE)
        Scratch.
    out : uint8 array, shape (as many as the slab has columns, length)
        Written, from position `at` of each row on.
    at : int
        Where.
    """
    width, length = slab.shape[1], out.shape[1]
    for first in range(0, width, SQUARE):
        for row in range(0, SQUARE, _ROWS):
            _interleave(slab, row * width + first, width, pieces, row * SQUARE)
        for piece in range(_ROWS):
            # Two neighbouring columns lie in each sixteenth byte of the row, eight in a piece.
            to = (first + 2 * piece) * length + at
            _gather(pieces, piece * SQUARE, out, to, length)


def _type_interleave(
    _context: Any, slab: Any, _at: Any, _width: Any, pieces: Any, _to: Any
) -> tuple[Any, Generate]:
    """Make eight pieces of eight columns from eight rows of 64 bytes.

    Word 2k and 2k + 1 of piece j are the columns 16k + 2j and 16k + 2j + 1.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        slab, at, width, pieces, to = arguments
        rows = []
        for _ in range(_ROWS):
            rows.append(load_bytes(context, builder, signature.args[0], slab, at, LANES))
            at = builder.add(at, width)
        # Rows 0 and 4, 1 and 5, ...; then 0, 2, 4, 6; then all.
        pairs = [_zip(builder, rows[i], rows[i + 4]) for i in range(4)]
        fours = [
            [half for k in range(2) for half in _zip(builder, pairs[i][k], pairs[i + 2][k])]
            for i in range(2)
        ]
        columns = [half for k in range(4) for half in _zip(builder, fours[0][k], fours[1][k])]
        for j, column in enumerate(columns):
            where = builder.add(to, to.type(j * SQUARE))
            _store(context, builder, signature.args[3], pieces, where, column)
        return context.get_dummy_value()

    return types.void(slab, types.intp, types.intp, pieces, types.intp), generate


def _type_gather(
    _context: Any, pieces: Any, _at: Any, out: Any, _to: Any, _length: Any
) -> tuple[Any, Generate]:
    """Make 64 bytes of eight columns from the same piece of eight bands."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pieces, at, out, to, length = arguments
        bands = []
        for k in range(_ROWS):
            where = builder.add(at, at.type(k * _ROWS * SQUARE))
            read = load_bytes(context, builder, signature.args[0], pieces, where, LANES)
            bands.append(builder.bitcast(read, _WORDS))
        for column, words in enumerate(_turned(builder, bands)):
            offset = builder.mul(length, to.type(16 * (column // 2) + column % 2))
            where = builder.add(to, offset)
            _store(context, builder, signature.args[2], out, where, words)
        return context.get_dummy_value()

    return types.void(pieces, types.intp, out, types.intp, types.intp), generate


def _zip(builder: Any, one: Any, other: Any) -> tuple[Any, Any]:
    """Interleave the lower halves of each 16 bytes of two vectors, and the upper halves."""
    halves = []
    for start in (0, 8):
        taken = [
            lane + start + k + source
            for lane in range(0, LANES, 16)
            for k in range(8)
            for source in (0, LANES)
        ]
        halves.append(_shuffled(builder, one, other, taken))
    return halves[0], halves[1]


def _turned(builder: Any, rows: list[Any]) -> list[Any]:
    """Turn eight vectors of eight words, exchanging ever smaller squares."""
    n = len(rows)
    size = n // 2
    while size:
        turned = list(rows)
        for i in range(n):
            if i & size:
                continue
            upper = [k if not k & size else n + k - size for k in range(n)]
            lower = [k + size if not k & size else n + k for k in range(n)]
            turned[i] = _shuffled(builder, rows[i], rows[i + size], upper)
            turned[i + size] = _shuffled(builder, rows[i], rows[i + size], lower)
        rows = turned
        size //= 2
    return rows


def _shuffled(builder: Any, one: Any, other: Any, taken: list[int]) -> Any:
    order = ir.Constant(ir.VectorType(ir.IntType(32), len(taken)), taken)
    return builder.shuffle_vector(one, other, order)


def _store(context: Any, builder: Any, kind: Any, rows: Any, at: Any, values: Any) -> None:
    builder.store(values, byte_address(context, builder, kind, rows, at, values.type), align=1)


_interleave, _gather = intrinsic(_type_interleave), intrinsic(_type_gather)
