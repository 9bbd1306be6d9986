"""Where something is green: the cells of a search image in which laser light may be.

The search image is divided into cells of `BLOCK` positions by 8 lines. Chroma has half the size of
luma, so that a cell has 4 x 4 pixels of it.
"""

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel
from aqualvs.scanning.byte_words import at_least, same_in_all
from aqualvs.scanning.contrast import BLOCK, U8Array

_LOW_HALF = np.uint64(0xFFFFFFFF)
_NOTHING = np.uint64(0)


def cells_in_band(length: int, lowest: IntArray, highest: IntArray) -> BoolArray:
    """Mark the cells that any line's interval reaches.

    Parameters
    ----------
    length : int
        Positions on a search line.
    lowest, highest : int array, shape (n_lines,)
        First and last position of interest on each line (an empty interval skips the line).

    Returns
    -------
    bool array, shape (n_blocks, n_words)
        Blocks of positions, and words of 8 lines.
    """
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
    image : uint8 array, shape (length, at least n_lines)
        Green at half the size of luma; search lines are columns.
    background : uint8 array, shape (ceil(length / BLOCK), at least n_lines)
        Of the image.
    least : uint8
        Least contrast.
    green : uint8 array, shape (n_blocks of luma, n_lines)
        Written: not zero where marked.
    """
    length = image.shape[0]
    n_lines = green.shape[1]
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
    """Keep the cells with green in them or in the block before or after (a white core).

    Parameters
    ----------
    in_band : bool array, shape (n_blocks, n_words)
        From `cells_in_band`.
    green : uint32 array, shape (n_blocks, n_words)
        From `mark_green`, four columns a word.
    cells : bool array, shape (n_blocks, n_words)
        Written.
    """
    n_blocks, n_words = in_band.shape
    for b in range(n_blocks):
        before, after = max(b - 1, 0), min(b + 1, n_blocks - 1)
        for w in range(n_words):
            near = green[before, w] | green[b, w] | green[after, w]
            cells[b, w] = in_band[b, w] and near != 0


@borrowing_kernel
def mark_green_rows(
    words: NDArray[np.uint64], background: U8Array, least: np.uint8, green: U8Array
) -> None:
    """Mark the cells in which something stands above the background, where lines are rows.

    Parameters
    ----------
    words : uint64 array, shape (n_lines, at least n_blocks / 2)
        Green at half the size of luma, `BLOCK` positions a word.
    background : uint8 array, shape (n_lines, at least n_blocks / 2)
        Of the words.
    least : uint8
        Least contrast.
    green : uint8 array, shape (n_words, n_blocks)
        Written: words of 8 lines of luma by blocks of it; not zero where marked.
    """
    n_blocks = green.shape[1]
    for w in range(green.shape[0]):
        for b in range(n_blocks):
            green[w, b] = np.uint8(0)
        for x in range(4 * w, min(4 * w + 4, words.shape[0])):
            for k in range((n_blocks + 1) // 2):
                level = np.uint16(background[x, k]) + np.uint16(least)
                if level > np.uint16(255):
                    continue
                marks = at_least(words[x, k], same_in_all(level))
                if marks & _LOW_HALF != _NOTHING:
                    green[w, 2 * k] = np.uint8(255)
                if marks & ~_LOW_HALF != _NOTHING and 2 * k + 1 < n_blocks:
                    green[w, 2 * k + 1] = np.uint8(255)


@borrowing_kernel
def row_cells_near_green(in_band: BoolArray, green: U8Array, cells: BoolArray) -> None:
    """Keep the cells as `cells_near_green`, where lines are rows: shape (n_words, n_blocks)."""
    n_words, n_blocks = in_band.shape
    for w in range(n_words):
        for b in range(n_blocks):
            before, after = max(b - 1, 0), min(b + 1, n_blocks - 1)
            near = green[w, before] | green[w, b] | green[w, after]
            cells[w, b] = in_band[w, b] and near != 0
