"""Runs: unbroken stretches of marked pixels along search lines, found without looking everywhere.

The search image is divided into cells of `BLOCK` positions by 8 lines; only cells that a laser's
band reaches, and where something is green, are looked at, 64 positions at a time.
"""

import numpy as np

from aqualvs.geometry.arrays import IntArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel
from aqualvs.scanning.contrast import BLOCK
from aqualvs.scanning.green_cells import WordArray, cells_in_band
from aqualvs.scanning.lanes import LANES, U8Array, first_mark, marks_above, n_marks

_NOTHING, _ONE, _LAST = np.uint64(0), np.uint64(1), np.uint64(LANES - 1)
_TOGETHER = 4


class Runs:
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
    in_band : uint64 array, shape (n_groups, n_words)
        Cells that a line's interval reaches, from `cells_in_band`.
    capacity : int
        As given.
    """

    def __init__(self, length: int, lowest: IntArray, highest: IntArray, capacity: int) -> None:
        self.in_band = cells_in_band(length, lowest, highest)
        self.capacity = capacity
        self._lowest, self._highest = lowest, highest
        self._edges = np.empty(length + 2 * _TOGETHER, np.int64)
        self._runs = np.empty((capacity, 3), np.int64)

    def find(
        self, lines: U8Array, background: U8Array, min_contrast: int, cells: WordArray
    ) -> IntArray:
        """Find the runs that stand above the background.

        Parameters
        ----------
        lines : uint8 array, shape (n_lines, whole lanes)
            Search lines, allocated with `margined`.
        background : uint8 array, shape (n_lines, lanes / BLOCK)
            Of the lines.
        min_contrast : int
            Least height above it, in grey levels; not 0.
        cells : uint64 array, shape (n_groups, n_words)
            Where to look.

        Returns
        -------
        int array, shape (n, 3)
            (line, first, last), ordered by line, then by position. A view: overwritten by the next
            call.
        """
        n = _find(
            lines,
            background,
            np.uint8(min_contrast),
            cells,
            self._lowest,
            self._highest,
            self._edges,
            self._runs,
        )
        return self._runs[:n]


@borrowing_kernel
def _find(
    lines: U8Array,
    background: U8Array,
    least: np.uint8,
    cells: WordArray,
    lowest: IntArray,
    highest: IntArray,
    edges: IntArray,
    runs: IntArray,
) -> int:
    """Collect runs (line, first, last) that reach their line's interval; return how many.

    `edges` is scratch, for all edges of a line and a few more.
    """
    n_words = cells.shape[1]
    n = 0
    for x in range(lowest.shape[0]):
        n_edges = _edges_of(lines, background, least, x, cells[x >> 3], n_words, edges)
        low, high = lowest[x], highest[x]
        for k in range(0, n_edges, 2):
            if n == runs.shape[0]:
                return n
            start, last = edges[k], edges[k + 1] - 1
            runs[n, 0], runs[n, 1], runs[n, 2] = x, start, last
            # The next one is written over it where it lies outside: cheaper than a choice.
            n += (start <= high) & (last >= low)
    return n


@inline_borrowing_kernel
def _edges_of(
    lines: U8Array,
    background: U8Array,
    least: np.uint8,
    x: int,
    cells: WordArray,
    n_words: int,
    edges: IntArray,
) -> int:
    """Write where runs of a line begin and, one position later, where they end, by turns."""
    row, ground = x * lines.shape[1], x * background.shape[1]
    n = 0
    before = _NOTHING
    # One word more than there are closes what is open at the end.
    for w in range(n_words + 1):
        here = _NOTHING
        if w < n_words and cells[w] != _NOTHING:
            above = marks_above(lines, row + w * LANES, background, ground + w * BLOCK, least)
            here = above & cells[w]
        marks = here ^ ((here << _ONE) | (before >> _LAST))
        before = here
        if marks == _NOTHING:
            continue
        # Four at a time, whether there are as many or not: how many cannot be foreseen.
        end = n + n_marks(marks)
        while n < end:
            for k in range(_TOGETHER):
                edges[n + k] = w * LANES + first_mark(marks)
                marks &= marks - _ONE
            n += _TOGETHER
        n = end
    return n
