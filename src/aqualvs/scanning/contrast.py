"""Local contrast along search lines: how far a pixel stands above the background on both sides.

The search image is `(length, lines)`: a search line is a column, so that every inner loop runs
along memory over many lines at once and becomes vector instructions.

The background on one side is the minimum over a few blocks of `BLOCK` pixels; the darker side of
the two loses, so that a step edge (a box before a dark wall) has no contrast, and a stripe that
runs along the search line has none either.
"""

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.compiled import kernel

BLOCK = 8
"""Pixels per background block."""

U8Array = NDArray[np.uint8]


class ContrastWorkspace:
    """Buffers of `local_contrast` for one image size, allocated once.

    Parameters
    ----------
    length, n_lines : int
        Shape of the search image.
    reach_px : int
        How far the background is looked for on each side; at least the widest stripe's width.
    """

    def __init__(self, length: int, n_lines: int, reach_px: int) -> None:
        self.n_blocks = -(-reach_px // BLOCK)
        n_rows = -(-length // BLOCK) + 2 * self.n_blocks + 1
        # Rows beyond the image stay at 255: next to a border nothing can stand out, because one
        # of its flanks is not visible.
        self.minima: U8Array = np.full((n_rows, n_lines), 255, np.uint8)
        self.flanks: U8Array = np.empty((2, n_lines), np.uint8)
        # Eight spare columns keep whole 8-byte words readable at the end of a row.
        self.contrast: U8Array = np.zeros((length, -(-n_lines // 8) * 8), np.uint8)


def local_contrast(
    search_image: U8Array, workspace: ContrastWorkspace, min_contrast: int
) -> U8Array:
    """Return the contrast of every pixel, zero below `min_contrast`.

    Parameters
    ----------
    search_image : uint8 array, shape (length, n_lines)
        Unit step along the second axis.
    workspace : ContrastWorkspace
        Made for this shape.
    min_contrast : int
        Grey levels.

    Returns
    -------
    uint8 array, shape (length, n_lines rounded up to a multiple of 8)
        A view of the workspace: overwritten by the next call.
    """
    _local_contrast(
        search_image,
        workspace.n_blocks,
        np.uint8(min_contrast),
        workspace.contrast,
        workspace.minima,
        workspace.flanks,
    )
    return workspace.contrast


@kernel
def _local_contrast(
    image: U8Array,
    n_blocks: int,
    threshold: np.uint8,
    contrast: U8Array,
    minima: U8Array,
    flanks: U8Array,
) -> None:
    length, n_lines = image.shape
    n_rows = (length + BLOCK - 1) // BLOCK
    for b in range(n_rows):
        start = b * BLOCK
        for x in range(n_lines):
            minima[n_blocks + b, x] = image[start, x]
        for i in range(1, min(BLOCK, length - start)):
            for x in range(n_lines):
                low = minima[n_blocks + b, x]
                value = image[start + i, x]
                minima[n_blocks + b, x] = low if low < value else value
    for b in range(n_rows):
        for x in range(n_lines):
            flanks[0, x] = minima[b, x]
            flanks[1, x] = minima[b + n_blocks + 1, x]
        for i in range(1, n_blocks):
            for x in range(n_lines):
                low = flanks[0, x]
                value = minima[b + i, x]
                flanks[0, x] = low if low < value else value
                low = flanks[1, x]
                value = minima[b + n_blocks + 1 + i, x]
                flanks[1, x] = low if low < value else value
        for x in range(n_lines):
            before = flanks[0, x]
            after = flanks[1, x]
            flanks[0, x] = before if before > after else after
        start = b * BLOCK
        for v in range(start, min(start + BLOCK, length)):
            for x in range(n_lines):
                value = image[v, x]
                background = flanks[0, x]
                height = np.uint8(value - background) if value > background else np.uint8(0)
                contrast[v, x] = height if height >= threshold else np.uint8(0)
