"""Runs: unbroken stretches of marked pixels along search lines, found without looking everywhere.

The search image is divided into cells of `BLOCK` positions by 8 lines; only cells that a laser's
band reaches, and where something is green, are looked at, 8 lines (one machine word) at a time.
"""

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, IntArray
from aqualvs.geometry.compiled import kernel
from aqualvs.scanning.contrast import BLOCK, U8Array


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


@kernel
def find_runs(
    cells: BoolArray,
    words: NDArray[np.uint64],
    contrast: U8Array,
    lowest: IntArray,
    highest: IntArray,
    open_start: IntArray,
    open_last: IntArray,
    runs: IntArray,
) -> int:
    """Collect runs (line, first, last) of non-zero contrast along the lines; 8 lines a look."""
    length, n_words = words.shape
    n_lines = lowest.shape[0]
    n = 0
    for x in range(n_lines):
        open_start[x] = -1
        open_last[x] = -2
    active = np.empty(n_words, np.int64)
    for b in range(cells.shape[0]):
        n_active = 0
        for w in range(n_words):
            if cells[b, w]:
                active[n_active] = w
                n_active += 1
        for v in range(b * BLOCK, min((b + 1) * BLOCK, length)):
            for k in range(n_active):
                w = active[k]
                if words[v, w] == 0:
                    continue
                for x in range(8 * w, min(8 * w + 8, n_lines)):
                    if contrast[v, x] == 0 or v < lowest[x] or v > highest[x]:
                        continue
                    if open_last[x] == v - 1:
                        open_last[x] = v
                        continue
                    if open_start[x] >= 0 and n < runs.shape[0]:
                        runs[n, 0], runs[n, 1], runs[n, 2] = x, open_start[x], open_last[x]
                        n += 1
                    open_start[x] = v
                    open_last[x] = v
    for x in range(n_lines):
        if open_start[x] >= 0 and n < runs.shape[0]:
            runs[n, 0], runs[n, 1], runs[n, 2] = x, open_start[x], open_last[x]
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
