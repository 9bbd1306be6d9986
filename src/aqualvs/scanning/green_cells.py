"""Where something is green: the cells of a search image in which laser light may be.

The search image is divided into cells of `BLOCK` positions by 8 lines. Chroma has half the size of
luma, so that a cell has 4 x 4 pixels of it. Cells are kept as marks of their positions, 64 to a
word: eight marks for each of eight cells.
"""

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel
from aqualvs.scanning.contrast import BLOCK
from aqualvs.scanning.lanes import LANES, U8Array, marks_above

WordArray = NDArray[np.uint64]

_NOTHING = np.uint64(0)
# Every fourth, and every eighth bit.
_EVERY_4TH = np.uint64(0x1111111111111111)
_EVERY_8TH = np.uint64(0x0101010101010101)
_LOW_HALF = np.uint64(0xFFFFFFFF)


def cells_in_band(length: int, lowest: IntArray, highest: IntArray) -> WordArray:
    """Mark the cells that any line's interval reaches.

    Parameters
    ----------
    length : int
        Positions on a search line.
    lowest, highest : int array, shape (n_lines,)
        First and last position of interest on each line (an empty interval skips the line).

    Returns
    -------
    uint64 array, shape (ceil(n_lines / 8), ceil(length / LANES))
        Marks of the positions below `length` in each cell of 8 lines.
    """
    n_groups, n_words = -(-len(lowest) // 8), -(-length // LANES)
    blocks = np.arange(n_words * LANES // BLOCK)
    first, last = lowest[:, None] // BLOCK, highest[:, None] // BLOCK
    hit = (blocks >= first) & (blocks <= last) & (lowest <= highest)[:, None]
    padded = np.zeros((n_groups * 8, len(blocks)), np.bool_)
    padded[: len(lowest)] = hit
    cells: BoolArray = np.any(padded.reshape(n_groups, 8, -1), axis=1)
    marks: BoolArray = np.repeat(cells, BLOCK, axis=1)
    marks[:, length:] = False
    return np.packbits(marks, axis=1, bitorder="little").view("<u8").astype(np.uint64)


@borrowing_kernel
def cells_near_green(
    green: U8Array,
    background: U8Array,
    least: np.uint8,
    in_band: WordArray,
    marks: WordArray,
    cells: WordArray,
) -> None:
    """Keep the cells with green in them or in the block before or after (a white core).

    Parameters
    ----------
    green : uint8 array, shape (n_lines, whole lanes)
        Green at half the size of luma.
    background : uint8 array, shape (n_lines, lanes / BLOCK)
        Of green.
    least : uint8
        Least height of green above its background.
    in_band : uint64 array, shape (n_groups, n_words)
        From `cells_in_band`.
    marks : uint64 array, shape (n_words + 3,)
        Scratch.
    cells : uint64 array, shape (n_groups, n_words)
        Written: the marks that are kept.
    """
    n_groups, n_words = cells.shape
    pitch, n_blocks = green.shape[1], background.shape[1]
    for group in range(n_groups):
        for w in range(marks.shape[0]):
            marks[w] = _NOTHING
        first, end = 4 * group, min(4 * group + 4, green.shape[0])
        for k in range((n_words + 1) // 2):
            found = _NOTHING
            for x in range(first, end):
                found |= marks_above(
                    green, x * pitch + k * LANES, background, x * n_blocks + k * BLOCK, least
                )
            if found != _NOTHING:
                marks[1 + 2 * k] = _cells_of_halves(found & _LOW_HALF)
                marks[2 + 2 * k] = _cells_of_halves(found >> np.uint64(32))
        for w in range(n_words):
            before, own, after = marks[w], marks[w + 1], marks[w + 2]
            near = own | (own << np.uint64(8)) | (own >> np.uint64(8))
            near |= (before >> np.uint64(56)) | (after << np.uint64(56))
            cells[group, w] = near & in_band[group, w]


@inline_borrowing_kernel
def _cells_of_halves(found: np.uint64) -> np.uint64:
    """Return eight marks for each four of the lower 32, where any of the four is set."""
    found |= found >> np.uint64(2)
    found = (found | (found >> np.uint64(1))) & _EVERY_4TH
    found = (found | (found << np.uint64(16))) & np.uint64(0x0000FFFF0000FFFF)
    found = (found | (found << np.uint64(8))) & np.uint64(0x00FF00FF00FF00FF)
    found = (found | (found << np.uint64(4))) & _EVERY_8TH
    return np.uint64(found * np.uint64(255))
