"""Runs: unbroken stretches of marked pixels along search lines, found without looking everywhere.

The search image is divided into cells of `BLOCK` positions by 8 lines; only cells that a laser's
band reaches, and where something is green, are looked at, 8 lines (one machine word) at a time.
"""

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, IntArray
from aqualvs.geometry.compiled import inline_kernel, kernel
from aqualvs.scanning.contrast import BLOCK

_LOW_BITS = np.uint64(0x7F7F7F7F7F7F7F7F)
_HIGH_BITS = np.uint64(0x8080808080808080)
_FIRST_BIT = np.uint64(0x80)


def cells_in_band(length: int, lowest: IntArray, highest: IntArray) -> BoolArray:
    """Mark the cells of `BLOCK` positions by 8 lines that any line's interval reaches."""
    n_blocks, n_words = -(-length // BLOCK), -(-len(lowest) // 8)
    blocks = np.arange(n_blocks)[:, None]
    hit = (blocks >= lowest // BLOCK) & (blocks <= highest // BLOCK) & (lowest <= highest)
    padded = np.zeros((n_blocks, n_words * 8), np.bool_)
    padded[:, : len(lowest)] = hit
    cells: BoolArray = np.any(padded.reshape(n_blocks, n_words, 8), axis=2)
    return cells


@kernel
def cells_near_green(
    in_band: BoolArray, green: NDArray[np.uint32], any_green: NDArray[np.uint32], cells: BoolArray
) -> None:
    """Keep the cells with green in them or in the block before or after (a white core)."""
    n_blocks, n_words = in_band.shape
    rows = BLOCK // 2
    for b in range(n_blocks):
        for w in range(n_words):
            any_green[b, w] = green[rows * b, w]
        for v in range(rows * b + 1, min(rows * (b + 1), green.shape[0])):
            for w in range(n_words):
                any_green[b, w] |= green[v, w]
    for b in range(n_blocks):
        before, after = max(b - 1, 0), min(b + 1, n_blocks - 1)
        for w in range(n_words):
            near = any_green[before, w] | any_green[b, w] | any_green[after, w]
            cells[b, w] = in_band[b, w] and near != 0


@inline_kernel
def _lit_bytes(word: np.uint64) -> np.uint64:
    """Set the highest bit of every byte that is not zero, and no other bit."""
    return ((word & _LOW_BITS) + _LOW_BITS | word) & _HIGH_BITS


@kernel
def find_runs(
    cells: BoolArray,
    words: NDArray[np.uint64],
    lowest: IntArray,
    highest: IntArray,
    open_start: IntArray,
    runs: IntArray,
) -> int:
    """Collect runs (line, first, last) of marked pixels along the lines; 8 lines a look.

    Parameters
    ----------
    cells : bool array, shape (n_blocks, n_words)
        Where to look.
    words : uint64 array, shape (length, n_words)
        The marked image, zero where a pixel is not marked; 8 lines a word.
    lowest, highest : int array, shape (n_lines,)
        Runs that lie wholly outside are left out.
    open_start : int array, shape (8 * n_words,)
        Scratch.
    runs : int array, shape (capacity, 3)
        Written, up to its capacity.

    Returns
    -------
    int
        Number of runs written.
    """
    length, n_words = words.shape
    nothing = np.uint64(0)
    n = 0
    for b in range(cells.shape[0]):
        first_row, last_row = b * BLOCK, min((b + 1) * BLOCK, length) - 1
        for w in range(n_words):
            if not cells[b, w]:
                continue
            goes_on_before = b > 0 and cells[b - 1, w]
            goes_on_after = last_row + 1 < length and cells[b + 1, w]
            before = _lit_bytes(words[first_row - 1, w]) if goes_on_before else nothing
            here = _lit_bytes(words[first_row, w])
            for v in range(first_row, last_row + 1):
                after = nothing
                if v < last_row or goes_on_after:
                    after = _lit_bytes(words[v + 1, w])
                starts, ends = here & ~before, here & ~after
                before, here = here, after
                if starts | ends == nothing:
                    continue
                for k in range(8):
                    bit = _FIRST_BIT << np.uint64(8 * k)
                    x = 8 * w + k
                    if starts & bit != nothing:
                        open_start[x] = v
                    if ends & bit == nothing or open_start[x] > highest[x] or v < lowest[x]:
                        continue
                    if n < runs.shape[0]:
                        runs[n, 0], runs[n, 1], runs[n, 2] = x, open_start[x], v
                        n += 1
    return n


@kernel
def sort_by_line(runs: IntArray, line_start: IntArray, ordered: IntArray) -> None:
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
