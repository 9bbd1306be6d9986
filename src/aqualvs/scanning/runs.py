"""Runs: unbroken stretches of marked pixels along search lines, found without looking everywhere.

The search image is divided into cells of `BLOCK` positions by 8 lines; only cells that a laser's
band reaches, and where something is green, are looked at, 8 lines (one machine word) at a time.
"""

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel
from aqualvs.scanning.contrast import BLOCK, U8Array

_HIGH_BITS = np.uint64(0x8080808080808080)
_ONE = np.uint64(1)


class RunFinder:
    """Finds runs in search images of one shape; allocates once.

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
        self.in_band = _cells_in_band(length, lowest, highest)
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
        image : uint8 array, shape (length, n_lines)
            Search lines are columns.
        background : uint8 array, shape (n_blocks, n_lines)
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
        n = _find_runs(
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


def _cells_in_band(length: int, lowest: IntArray, highest: IntArray) -> BoolArray:
    """Mark the cells of `BLOCK` positions by 8 lines that any line's interval reaches."""
    n_blocks, n_words = -(-length // BLOCK), -(-len(lowest) // 8)
    blocks = np.arange(n_blocks)[:, None]
    hit = (blocks >= lowest // BLOCK) & (blocks <= highest // BLOCK) & (lowest <= highest)
    padded = np.zeros((n_blocks, n_words * 8), np.bool_)
    padded[:, : len(lowest)] = hit
    cells: BoolArray = np.any(padded.reshape(n_blocks, n_words, 8), axis=2)
    return cells


@borrowing_kernel
def mark_green(image: U8Array, background: U8Array, least: np.uint8, green: U8Array) -> None:
    """Mark, for every `BLOCK` / 2 rows, the columns in which something stands above the background.

    Parameters
    ----------
    image : uint8 array, shape (length, n_lines)
        Chroma at half the size of luma, inverted so that green is high.
    background : uint8 array, shape (ceil(length / BLOCK), n_lines)
        Of the image.
    least : uint8
        Least contrast.
    green : uint8 array, shape (n_blocks of luma, at least n_lines)
        Written up to column n_lines: not zero where marked.
    """
    length, n_lines = image.shape
    for b in range(green.shape[0]):
        for x in range(n_lines):
            green[b, x] = np.uint8(0)
        for v in range(b * BLOCK // 2, min((b + 1) * BLOCK // 2, length)):
            row = v // BLOCK
            for x in range(n_lines):
                value, floor = image[v, x], background[row, x]
                height = np.uint8(value - floor) if value > floor else np.uint8(0)
                green[b, x] |= np.uint8(255) if height >= least else np.uint8(0)


@borrowing_kernel
def cells_near_green(in_band: BoolArray, green: NDArray[np.uint32], cells: BoolArray) -> None:
    """Keep the cells with green in them or in the block before or after (a white core)."""
    n_blocks, n_words = in_band.shape
    for b in range(n_blocks):
        before, after = max(b - 1, 0), min(b + 1, n_blocks - 1)
        for w in range(n_words):
            near = green[before, w] | green[b, w] | green[after, w]
            cells[b, w] = in_band[b, w] and near != 0


@borrowing_kernel
def _find_runs(
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
    image : uint8 array, shape (length, n_lines)
        Search lines are columns.
    background : uint8 array, shape (n_blocks, n_lines)
        Of the image.
    least : uint8
        Least contrast.
    cells : bool array, shape (n_blocks, n_words)
        Where to look.
    lowest, highest : int array, shape (n_lines,)
        Runs that lie wholly outside are left out.
    marks, words : uint8 array, shape (BLOCK + 1, 8 * n_words), and its view as 64-bit words
        Scratch, zero beyond n_lines. Holds one block, so that it stays in the nearest cache.
    open_start : int array, shape (8 * n_words,)
        Scratch.
    runs : int array, shape (capacity, 3)
        Written, up to its capacity.

    Returns
    -------
    int
        Number of runs written.
    """
    length, n_lines = image.shape
    n_blocks, n_words = cells.shape
    nothing = np.uint64(0)
    n = 0
    for w in range(n_words):
        words[BLOCK, w] = nothing
    for b in range(n_blocks):
        first_row = b * BLOCK
        n_rows = min(BLOCK, length - first_row)
        for r in range(n_rows):
            for x in range(n_lines):
                value, floor = image[first_row + r, x], background[b, x]
                height = np.uint8(value - floor) if value > floor else np.uint8(0)
                marks[r, x] = np.uint8(255) if height >= least else np.uint8(0)
        for w in range(n_words):
            before = words[BLOCK, w]
            if not cells[b, w]:
                if before != nothing:
                    n = _close_runs(before, w, first_row - 1, lowest, highest, open_start, runs, n)
                    words[BLOCK, w] = nothing
                continue
            for r in range(n_rows):
                here = words[r, w] & _HIGH_BITS
                starts, ends = here & ~before, before & ~here
                before = here
                if starts != nothing:
                    for k in range(8):
                        if starts >> np.uint64(8 * k + 7) & _ONE != nothing:
                            open_start[8 * w + k] = first_row + r
                if ends != nothing:
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
    for k in range(8):
        if ends >> np.uint64(8 * k + 7) & _ONE == np.uint64(0):
            continue
        x = 8 * w + k
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
