"""Background along search lines: what a pixel must stand above on both sides.

The search image is `(length, lines)`: a search line is a column, so that every inner loop runs
along memory over many lines at once and becomes vector instructions.

The background on one side is the minimum over a few blocks of `BLOCK` pixels; the darker side of
the two loses, so that a step edge (a box before a dark wall) has no contrast, and a stripe that
runs along the search line has none either.
"""

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.compiled import borrowing_kernel

BLOCK = 8
"""Pixels per background block."""

U8Array = NDArray[np.uint8]


class BackgroundWorkspace:
    """Buffers of `flank_background` for one image size, allocated once.

    Parameters
    ----------
    length, n_lines : int
        Shape of the search image.
    reach_px : int
        How far the background is looked for on each side; at least the widest stripe's width.
    """

    def __init__(self, length: int, n_lines: int, reach_px: int) -> None:
        self.n_reach = -(-reach_px // BLOCK)
        n_blocks = -(-length // BLOCK)
        # Rows beyond the image stay at 255: next to a border nothing can stand out, because one
        # of its flanks is not visible.
        self.minima: U8Array = np.full((n_blocks + 2 * self.n_reach + 1, n_lines), 255, np.uint8)
        self.background: U8Array = np.empty((n_blocks, n_lines), np.uint8)
        self.after: U8Array = np.empty(n_lines, np.uint8)


def flank_background(search_image: U8Array, workspace: BackgroundWorkspace) -> U8Array:
    """Return the background of every block: the lighter of the minima on both sides.

    Parameters
    ----------
    search_image : uint8 array, shape (length, n_lines)
        Unit step along the second axis.
    workspace : BackgroundWorkspace
        Made for this shape.

    Returns
    -------
    uint8 array, shape (ceil(length / BLOCK), n_lines)
        A view of the workspace: overwritten by the next call.
    """
    _flank_background(
        search_image, workspace.n_reach, workspace.minima, workspace.background, workspace.after
    )
    return workspace.background


@borrowing_kernel
def _flank_background(
    image: U8Array, n_reach: int, minima: U8Array, background: U8Array, after: U8Array
) -> None:
    length, n_lines = image.shape
    n_blocks = background.shape[0]
    for b in range(n_blocks):
        start = b * BLOCK
        for x in range(n_lines):
            minima[n_reach + b, x] = image[start, x]
        for i in range(1, min(BLOCK, length - start)):
            for x in range(n_lines):
                low = minima[n_reach + b, x]
                value = image[start + i, x]
                minima[n_reach + b, x] = low if low < value else value
    for b in range(n_blocks):
        for x in range(n_lines):
            background[b, x] = minima[b, x]
            after[x] = minima[b + n_reach + 1, x]
        for i in range(1, n_reach):
            for x in range(n_lines):
                low = background[b, x]
                value = minima[b + i, x]
                background[b, x] = low if low < value else value
                low = after[x]
                value = minima[b + n_reach + 1 + i, x]
                after[x] = low if low < value else value
        for x in range(n_lines):
            low = background[b, x]
            high = after[x]
            background[b, x] = low if low > high else high
