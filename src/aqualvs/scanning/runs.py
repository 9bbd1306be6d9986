"""Runs: unbroken stretches of marked pixels along search lines, found without looking everywhere.

The search image is divided into cells of `BLOCK` positions by 8 lines; only cells that a laser's
band reaches, and where something is green, are looked at, one machine word at a time: a word is 8
lines where lines are columns, and 8 positions where they are rows.
"""

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel
from aqualvs.scanning.byte_words import (
    HIGH_BITS,
    at_least,
    first_marked,
    same_in_all,
    without_first,
)
from aqualvs.scanning.contrast import BLOCK, U8Array
from aqualvs.scanning.green_cells import cells_in_band

_NOTHING = np.uint64(0)
_BYTE, _TOP_BYTE = np.uint64(8), np.uint64(56)


class ColumnRuns:
    """Finds runs in search images of one shape whose lines are columns; allocates once.

    Parameters
    ----------
    length : int
        Positions on a search line.
    lowest, highest : int array, shape (n_lines,)
        First and last position of interest on each line (an empty interval skips the line).
    capacity : int
        Runs kept; what exceeds it is dropped.

    Attributes
    ----------
    in_band : bool array, shape (n_blocks, n_words)
        Cells that a line's interval reaches.
    capacity : int
        As given.
    """

    def __init__(self, length: int, lowest: IntArray, highest: IntArray, capacity: int) -> None:
        self.in_band = cells_in_band(length, lowest, highest)
        self.capacity = capacity
        self._lowest, self._highest = lowest, highest
        n_words = self.in_band.shape[1]
        self._marks: U8Array = np.zeros((BLOCK + 1, 8 * n_words), np.uint8)
        self._open_start = np.empty(8 * n_words, np.int64)
        self._runs = np.empty((capacity, 3), np.int64)
        self._ordered = np.empty_like(self._runs)
        self._line_start = np.empty(len(lowest) + 1, np.int64)

    def find(
        self, image: U8Array, background: U8Array, min_contrast: int, cells: BoolArray
    ) -> IntArray:
        """Find the runs that stand above the background.

        Parameters
        ----------
        image : uint8 array, shape (length, 8 n_words)
            Search lines are columns; 255 beyond the last.
        background : uint8 array, shape (n_blocks, 8 n_words)
            Of the image.
        min_contrast : int
            Least height above it, in grey levels.
        cells : bool array, shape (n_blocks, n_words)
            Where to look.

        Returns
        -------
        int array, shape (n, 3)
            (line, first, last), ordered by line, then by position. A view: overwritten by the next
            call.
        """
        n = _find_in_columns(
            image,
            background,
            np.uint8(min_contrast),
            cells,
            self._lowest,
            self._highest,
            self._marks,
            self._marks.view(np.uint64),
            self._open_start,
            self._runs,
        )
        _sort_by_line(self._runs[:n], self._line_start, self._ordered)
        return self._ordered[:n]


class RowRuns:
    """Finds runs in search images of one shape whose lines are rows; allocates once.

    Parameters
    ----------
    length, lowest, highest, capacity
        As for `ColumnRuns`.

    Attributes
    ----------
    in_band : bool array, shape (n_words, n_blocks)
        Cells that a line's interval reaches.
    capacity : int
        As given.
    """

    def __init__(self, length: int, lowest: IntArray, highest: IntArray, capacity: int) -> None:
        self.in_band = np.ascontiguousarray(cells_in_band(length, lowest, highest).T)
        self.capacity = capacity
        self._length = length
        self._lowest, self._highest = lowest, highest
        self._runs = np.empty((capacity, 3), np.int64)

    def find(
        self, image: U8Array, background: U8Array, min_contrast: int, cells: BoolArray
    ) -> IntArray:
        """Find the runs that stand above the background.

        Parameters
        ----------
        image : uint8 array, shape (n_lines, 8 n_blocks)
            Search lines are rows.
        background : uint8 array, shape (n_lines, n_blocks)
            Of the image.
        min_contrast : int
            Least height above it, in grey levels.
        cells : bool array, shape (n_words, n_blocks)
            Where to look.

        Returns
        -------
        int array, shape (n, 3)
            As from `ColumnRuns.find`.
        """
        n = _find_in_rows(
            image.view(np.uint64),
            background,
            np.uint16(min_contrast),
            cells,
            self._length,
            self._lowest,
            self._highest,
            self._runs,
        )
        return self._runs[:n]


@borrowing_kernel
def _find_in_columns(
    image: U8Array,
    background: U8Array,
    least: np.uint8,
    cells: BoolArray,
    lowest: IntArray,
    highest: IntArray,
    marks: U8Array,
    words: NDArray[np.uint64],
    open_start: IntArray,
    runs: IntArray,
) -> int:
    """Collect runs (line, first, last) of pixels above the background; 8 lines a look.

    Parameters
    ----------
    image, background, cells
        As in `ColumnRuns.find`.
    least : uint8
        Least contrast.
    lowest, highest : int array, shape (n_lines,)
        Runs that lie wholly outside are left out.
    marks, words : uint8 array, shape (BLOCK + 1, 8 * n_words), and its view as 64-bit words
        Scratch. Holds one block, so that it stays in the nearest cache.
    open_start : int array, shape (8 * n_words,)
        Scratch.
    runs : int array, shape (capacity, 3)
        Written, up to its capacity.

    Returns
    -------
    int
        Number of runs written.
    """
    length = image.shape[0]
    n_blocks, n_words = cells.shape
    n = 0
    for w in range(n_words):
        words[BLOCK, w] = _NOTHING
    for b in range(n_blocks):
        first_row = b * BLOCK
        n_rows = min(BLOCK, length - first_row)
        for r in range(n_rows):
            for x in range(marks.shape[1]):
                value, floor = image[first_row + r, x], background[b, x]
                height = np.uint8(value - floor) if value > floor else np.uint8(0)
                marks[r, x] = np.uint8(255) if height >= least else np.uint8(0)
        for w in range(n_words):
            before = words[BLOCK, w]
            if not cells[b, w]:
                if before != _NOTHING:
                    n = _close_runs(before, w, first_row - 1, lowest, highest, open_start, runs, n)
                    words[BLOCK, w] = _NOTHING
                continue
            for r in range(n_rows):
                here = words[r, w] & HIGH_BITS
                starts, ends = here & ~before, before & ~here
                before = here
                while starts != _NOTHING:
                    open_start[8 * w + first_marked(starts)] = first_row + r
                    starts = without_first(starts)
                if ends != _NOTHING:
                    last = first_row + r - 1
                    n = _close_runs(ends, w, last, lowest, highest, open_start, runs, n)
            words[BLOCK, w] = before
    for w in range(n_words):
        n = _close_runs(words[BLOCK, w], w, length - 1, lowest, highest, open_start, runs, n)
    return n


@inline_borrowing_kernel
def _close_runs(
    ends: np.uint64,
    w: int,
    last: int,
    lowest: IntArray,
    highest: IntArray,
    open_start: IntArray,
    runs: IntArray,
    n: int,
) -> int:
    """Append the runs whose bytes are set and that reach their line's interval; the new count."""
    while ends != _NOTHING:
        x = 8 * w + first_marked(ends)
        ends = without_first(ends)
        if open_start[x] <= highest[x] and last >= lowest[x] and n < runs.shape[0]:
            runs[n, 0], runs[n, 1], runs[n, 2] = x, open_start[x], last
            n += 1
    return n


@borrowing_kernel
def _sort_by_line(runs: IntArray, line_start: IntArray, ordered: IntArray) -> None:
    """Sort runs by line, counting; those of one line arrive in order of position and keep it."""
    for x in range(line_start.shape[0]):
        line_start[x] = 0
    for i in range(runs.shape[0]):
        line_start[runs[i, 0] + 1] += 1
    for x in range(1, line_start.shape[0]):
        line_start[x] += line_start[x - 1]
    for i in range(runs.shape[0]):
        x = runs[i, 0]
        row = line_start[x]
        line_start[x] += 1
        for k in range(3):
            ordered[row, k] = runs[i, k]


@borrowing_kernel
def _find_in_rows(
    words: NDArray[np.uint64],
    background: U8Array,
    least: np.uint16,
    cells: BoolArray,
    length: int,
    lowest: IntArray,
    highest: IntArray,
    runs: IntArray,
) -> int:
    """Collect runs (line, first, last) of pixels above the background; 8 positions a look.

    See `_find_in_columns`; `words` are the image's, and what lies beyond `length` is none of it.
    """
    n_lines, n_blocks = background.shape
    n = 0
    for x in range(n_lines):
        start = -1
        before = _NOTHING
        for b in range(n_blocks):
            here = _NOTHING
            if cells[x >> 3, b]:
                level = np.uint16(background[x, b]) + least
                if level <= np.uint16(255):
                    here = at_least(words[x, b], same_in_all(level))
            elif start < 0:
                continue
            shifted = (here << _BYTE) | (before >> _TOP_BYTE)
            starts, ends = here & ~shifted, shifted & ~here
            before = here
            while starts != _NOTHING or ends != _NOTHING:
                if start < 0:
                    start = b * BLOCK + first_marked(starts)
                    starts = without_first(starts)
                    if ends == _NOTHING:
                        break
                last = b * BLOCK + first_marked(ends) - 1
                ends = without_first(ends)
                n = _append(x, start, min(last, length - 1), lowest, highest, runs, n)
                start = -1
        if start >= 0:
            n = _append(x, start, length - 1, lowest, highest, runs, n)
    return n


@inline_borrowing_kernel
def _append(
    x: int, start: int, last: int, lowest: IntArray, highest: IntArray, runs: IntArray, n: int
) -> int:
    """Append a run that reaches its line's interval; the new count."""
    if start <= last and start <= highest[x] and last >= lowest[x] and n < runs.shape[0]:
        runs[n, 0], runs[n, 1], runs[n, 2] = x, start, last
        n += 1
    return n
