"""Sixty-four bytes compared at once: the marks of 64 pixels in one machine word.

LLVM turns loops over long arrays into vector instructions by itself, but not the search for the
few pixels that stand out. These are the primitives of such a search, written in LLVM's portable
vector types: any processor is served with what it has. Mark k of a word is bit k, the byte k
after the first.

They read memory without looking at the bounds of the array: whoever calls them allocates with
`margined` and begins no more than `LANES` bytes before the array, and none behind it.
"""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from aqualvs.geometry.compiled import inline_borrowing_kernel

U8Array = NDArray[np.uint8]

LANES = 64
"""Bytes that are looked at together."""

_PER_FLOOR = 8
_BIT, _BYTE, _TWO_BYTES, _INDEX, _WORD = (ir.IntType(n) for n in (1, 8, 16, 32, 64))
_ZEROS = ir.Constant(ir.VectorType(_BYTE, LANES), [0] * LANES)
# Writes LLVM's instructions, given Numba's context, builder, signature and arguments.
Generate = Callable[[Any, Any, Any, Any], Any]
_Typed = tuple[Any, Generate]


def margined(n_rows: int, length: int) -> U8Array:
    """Allocate rows of bytes, all 255, with memory for `LANES` more before and after them.

    Parameters
    ----------
    n_rows : int
        Number of rows.
    length : int
        Bytes in a row.

    Returns
    -------
    uint8 array, shape (n_rows, whole lanes)
        In the midst of the memory; as wide as `whole_lanes` says.
    """
    width = whole_lanes(length)
    memory = np.full(n_rows * width + 2 * LANES, 255, np.uint8)
    return memory[LANES:-LANES].reshape(n_rows, width)


def whole_lanes(length: int) -> int:
    """Round up to an odd number of lanes.

    With an even number the pixels of a column would crowd into a few sets of the cache.
    """
    return (-(-length // LANES) | 1) * LANES


@inline_borrowing_kernel
def marks_at_least(rows: U8Array, at: int, level: np.uint8) -> np.uint64:
    """Mark the bytes from `at` on that are no less than `level`."""
    return np.uint64(_at_least(rows, at, level))


@inline_borrowing_kernel
def marks_above(
    rows: U8Array, at: int, floors: U8Array, floor_at: int, least: np.uint8
) -> np.uint64:
    """Mark the bytes from `at` on that stand at least so far, not 0, above their floor.

    Eight bytes in a row share one of the eight floors from `floor_at` on.
    """
    return np.uint64(_above(rows, at, floors, floor_at, least))


@inline_borrowing_kernel
def marks_where_rising(rows: U8Array, at: int) -> np.uint64:
    """Mark the bytes from `at` on that the next one exceeds."""
    return np.uint64(_rising(rows, at))


@inline_borrowing_kernel
def marks_where_falling(rows: U8Array, at: int) -> np.uint64:
    """Mark the bytes from `at` on that exceed the next one."""
    return np.uint64(_falling(rows, at))


@inline_borrowing_kernel
def highest_of(rows: U8Array, at: int, marks: np.uint64) -> np.uint8:
    """Return the highest of the marked bytes from `at` on; 0 if none is marked."""
    return np.uint8(_highest(rows, at, marks))


@inline_borrowing_kernel
def marks_in_valleys(
    rows: U8Array, at: int, marks: np.uint64, base: np.uint8, tenths: np.uint16
) -> np.uint64:
    """Mark the marked bytes from `at` on that lie in a valley between higher marked ones.

    In a valley is what stands less than so many tenths as high above `base` as the lower of the
    highest byte up to there and the highest from there on.
    """
    return np.uint64(_valleys(rows, at, marks, base, tenths))


@inline_borrowing_kernel
def lowest_of_eights(rows: U8Array, at: int) -> np.uint64:
    """Return the lowest of each eight bytes from `at` on, as the eight bytes of a word."""
    return np.uint64(_lowest(rows, at))


@inline_borrowing_kernel
def first_mark(marks: np.uint64) -> int:
    """Return the number of the lowest mark; 64 if there is none."""
    return int(_first(marks))


@inline_borrowing_kernel
def last_mark(marks: np.uint64) -> int:
    """Return the number of the highest mark; -1 if there is none."""
    return int(_last(marks))


@inline_borrowing_kernel
def n_marks(marks: np.uint64) -> int:
    """Return how many marks there are."""
    return int(_number(marks))


def _type_at_least(_context: Any, rows: Any, _at: Any, _level: Any) -> _Typed:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        values = load_bytes(context, builder, signature.args[0], arguments[0], arguments[1], LANES)
        level = _in_all(builder, arguments[2])
        return builder.bitcast(builder.icmp_unsigned(">=", values, level), _WORD)

    return types.uint64(rows, types.intp, types.uint8), generate


def _type_above(
    _context: Any, rows: Any, _at: Any, floors: Any, _floor_at: Any, _least: Any
) -> _Typed:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        values = load_bytes(context, builder, signature.args[0], arguments[0], arguments[1], LANES)
        n_floors = LANES // _PER_FLOOR
        few = load_bytes(context, builder, signature.args[2], arguments[2], arguments[3], n_floors)
        floors = builder.shuffle_vector(few, few, _lanes(k // _PER_FLOOR for k in range(LANES)))
        # A difference that ends at 0.
        higher = builder.icmp_unsigned(">", values, floors)
        height = builder.select(higher, builder.sub(values, floors), _ZEROS)
        least = _in_all(builder, arguments[4])
        return builder.bitcast(builder.icmp_unsigned(">=", height, least), _WORD)

    return types.uint64(rows, types.intp, floors, types.intp, types.uint8), generate


def _type_highest(_context: Any, rows: Any, _at: Any, _marks: Any) -> _Typed:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        values = load_bytes(context, builder, signature.args[0], arguments[0], arguments[1], LANES)
        marked = builder.bitcast(arguments[2], ir.VectorType(_BIT, LANES))
        left = builder.select(marked, values, _ZEROS)
        n = LANES
        while n > 1:
            n //= 2
            one = builder.shuffle_vector(left, left, _lanes(range(n)))
            other = builder.shuffle_vector(left, left, _lanes(range(n, 2 * n)))
            left = _higher(builder, one, other)
        return builder.extract_element(left, _INDEX(0))

    return types.uint8(rows, types.intp, types.uint64), generate


def _type_valleys(
    _context: Any, rows: Any, _at: Any, _marks: Any, _base: Any, _tenths: Any
) -> _Typed:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        values = load_bytes(context, builder, signature.args[0], arguments[0], arguments[1], LANES)
        marked = builder.bitcast(arguments[2], ir.VectorType(_BIT, LANES))
        values = builder.select(marked, values, _ZEROS)
        before = after = values
        distance = 1
        while distance < LANES:
            down = _lanes(max(k - distance, -1) % (LANES + 1) for k in range(LANES))
            up = _lanes(min(k + distance, LANES) for k in range(LANES))
            before = _higher(builder, before, builder.shuffle_vector(before, _ZEROS, down))
            after = _higher(builder, after, builder.shuffle_vector(after, _ZEROS, up))
            distance *= 2
        lower = builder.select(builder.icmp_unsigned("<", before, after), before, after)
        wide = ir.VectorType(_TWO_BYTES, LANES)
        tenths = arguments[4]
        rest = builder.sub(_TWO_BYTES(10), tenths)
        above = builder.mul(builder.zext(lower, wide), _in_all(builder, tenths))
        base = builder.mul(builder.zext(arguments[3], _TWO_BYTES), rest)
        level = builder.add(above, _in_all(builder, base))
        height = builder.mul(builder.zext(values, wide), ir.Constant(wide, [10] * LANES))
        valleys = builder.and_(builder.icmp_unsigned("<", height, level), marked)
        return builder.bitcast(valleys, _WORD)

    arguments = (rows, types.intp, types.uint64, types.uint8, types.uint16)
    return types.uint64(*arguments), generate


def _type_lowest(_context: Any, rows: Any, _at: Any) -> _Typed:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        left = load_bytes(context, builder, signature.args[0], arguments[0], arguments[1], LANES)
        words = ir.VectorType(_WORD, LANES // _PER_FLOOR)
        for distance in (8, 16, 32):
            shift = ir.Constant(words, [distance] * words.count)
            shifted = builder.lshr(builder.bitcast(left, words), shift)
            other = builder.bitcast(shifted, left.type)
            left = builder.select(builder.icmp_unsigned("<", left, other), left, other)
        lowest = builder.trunc(builder.bitcast(left, words), ir.VectorType(_BYTE, words.count))
        return builder.bitcast(lowest, _WORD)

    return types.uint64(rows, types.intp), generate


def _type_first(_context: Any, _marks: Any) -> _Typed:
    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], _BIT(0))

    return types.int64(types.uint64), generate


def _type_last(_context: Any, _marks: Any) -> _Typed:
    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.sub(_WORD(LANES - 1), builder.ctlz(arguments[0], _BIT(0)))

    return types.int64(types.uint64), generate


def _type_number(_context: Any, _marks: Any) -> _Typed:
    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.int64(types.uint64), generate


def _type_rising(_context: Any, rows: Any, _at: Any) -> _Typed:
    return types.uint64(rows, types.intp), _steps(">")


def _type_falling(_context: Any, rows: Any, _at: Any) -> _Typed:
    return types.uint64(rows, types.intp), _steps("<")


def _steps(relation: str) -> Generate:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        rows, at = arguments
        here = load_bytes(context, builder, signature.args[0], rows, at, LANES)
        after = builder.add(at, at.type(1))
        following = load_bytes(context, builder, signature.args[0], rows, after, LANES)
        return builder.bitcast(builder.icmp_unsigned(relation, following, here), _WORD)

    return generate


def load_bytes(context: Any, builder: Any, kind: Any, rows: Any, at: Any, n: int) -> Any:
    """Load `n` bytes, `at` bytes after the first of an array of a Numba type."""
    address = byte_address(context, builder, kind, rows, at, ir.VectorType(_BYTE, n))
    return builder.load(address, align=1)


def byte_address(context: Any, builder: Any, kind: Any, rows: Any, at: Any, what: Any) -> Any:
    """Return where something lies, `at` bytes after the first of an array of a Numba type."""
    first = context.make_array(kind)(context, builder, rows).data
    return builder.bitcast(builder.gep(first, [at]), what.as_pointer())


def _in_all(builder: Any, value: Any) -> Any:
    nothing = ir.Constant(ir.VectorType(value.type, LANES), ir.Undefined)
    one = builder.insert_element(nothing, value, _INDEX(0))
    return builder.shuffle_vector(one, one, _lanes(0 for _ in range(LANES)))


def _higher(builder: Any, one: Any, other: Any) -> Any:
    return builder.select(builder.icmp_unsigned(">", one, other), one, other)


def _lanes(numbers: Iterable[int]) -> Any:
    chosen = list(numbers)
    return ir.Constant(ir.VectorType(_INDEX, len(chosen)), chosen)


# Numba's intrinsics, which the typed kernels above make callable.
_at_least, _above = intrinsic(_type_at_least), intrinsic(_type_above)
_rising, _falling = intrinsic(_type_rising), intrinsic(_type_falling)
_highest, _lowest = intrinsic(_type_highest), intrinsic(_type_lowest)
_valleys = intrinsic(_type_valleys)
_first, _last, _number = (intrinsic(t) for t in (_type_first, _type_last, _type_number))
