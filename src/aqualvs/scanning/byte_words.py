"""Eight bytes in a machine word, compared and found at once.

Bytes are counted from the lowest, which is the first in memory on every machine that the compiled
code runs on. A mark is the highest bit of a byte.
"""

import numpy as np

from aqualvs.geometry.compiled import inline_borrowing_kernel

HIGH_BITS = np.uint64(0x8080808080808080)
"""A mark in every byte."""

_LOW_BITS = np.uint64(0x7F7F7F7F7F7F7F7F)
_ONES = np.uint64(0x0101010101010101)
# Times this, a word with one byte of 1 has that byte's number in its highest byte.
_NUMBERS = np.uint64(0x0001020304050607)
_ONE, _SEVEN, _HIGHEST = np.uint64(1), np.uint64(7), np.uint64(56)


@inline_borrowing_kernel
def same_in_all(value: np.uint16) -> np.uint64:
    """Return a word whose eight bytes are `value`, below 256."""
    return np.uint64(np.uint64(value) * _ONES)


@inline_borrowing_kernel
def at_least(values: np.uint64, levels: np.uint64) -> np.uint64:
    """Mark the bytes of `values` that are no less than those of `levels`."""
    # A borrow never leaves its byte; it clears the mark where the low seven bits are less.
    low = (values | HIGH_BITS) - (levels & _LOW_BITS)
    return np.uint64(((values & ~levels) | (~(values ^ levels) & low)) & HIGH_BITS)


@inline_borrowing_kernel
def first_marked(marks: np.uint64) -> int:
    """Return the number of the lowest marked byte; at least one is."""
    lowest = marks & (~marks + _ONE)
    return int(np.int64(((lowest >> _SEVEN) * _NUMBERS) >> _HIGHEST))


@inline_borrowing_kernel
def without_first(marks: np.uint64) -> np.uint64:
    """Return the marks without the lowest."""
    return np.uint64(marks & (marks - _ONE))
