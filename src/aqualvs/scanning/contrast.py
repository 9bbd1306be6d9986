"""Background along search lines: what a pixel must stand above on both sides.

The background on one side is the minimum over a few blocks of `BLOCK` pixels; the darker side of
the two loses, so that a step edge (a box before a dark wall) has no contrast, and a stripe that
runs along the search line has none either.

Search lines are the columns of a picture or its rows. Neither is transposed: along columns many
lines are looked at at once, along rows many blocks of one line.
"""

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.compiled import borrowing_kernel

BLOCK = 8
"""Pixels per background block."""

U8Array = NDArray[np.uint8]

# Beyond the border all is light: next to it nothing can stand out, because one of its flanks is
# not visible.
_BEYOND = np.uint8(255)


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
        self.minima: U8Array = np.full(
            (n_blocks + 2 * self.n_reach + 1, n_lines), _BEYOND, np.uint8
        )
        self.background: U8Array = np.empty((n_blocks, n_lines), np.uint8)


def flank_background(search_image: U8Array, workspace: BackgroundWorkspace) -> U8Array:
    """Return the background of every block: the lighter of the minima on both sides.

    Parameters
    ----------
    search_image : uint8 array, shape (length, n_lines)
        Search lines are columns; unit step along the second axis.
    workspace : BackgroundWorkspace
        Made for this shape.

    Returns
    -------
    uint8 array, shape (ceil(length / BLOCK), n_lines)
        A view of the workspace: overwritten by the next call.
    """
    _flank_background(search_image, workspace.n_reach, workspace.minima, workspace.background)
    return workspace.background


class RowBackgroundWorkspace:
    """Buffers of `row_background` for one image size, allocated once.

    Parameters
    ----------
    n_lines, length : int
        Shape of the search image; whole blocks.
    reach_px : int
        As in `BackgroundWorkspace`.
    """

    def __init__(self, n_lines: int, length: int, reach_px: int) -> None:
        self.n_reach = -(-reach_px // BLOCK)
        n_blocks = length // BLOCK
        self.of_two: U8Array = np.empty(length // 2, np.uint8)
        self.of_four: U8Array = np.empty(length // 4, np.uint8)
        self.minima: U8Array = np.full(n_blocks + 2 * self.n_reach + 1, _BEYOND, np.uint8)
        self.wider = np.empty_like(self.minima)
        self.spare = np.empty_like(self.minima)
        self.background: U8Array = np.empty((n_lines, n_blocks), np.uint8)


def row_background(search_image: U8Array, workspace: RowBackgroundWorkspace) -> U8Array:
    """Return the background of every block, as `flank_background`, but along rows.

    Parameters
    ----------
    search_image : uint8 array, shape (n_lines, length)
        Search lines are rows, without gaps in memory; 255 beyond the picture.
    workspace : RowBackgroundWorkspace
        Made for this shape.

    Returns
    -------
    uint8 array, shape (n_lines, length / BLOCK)
        A view of the workspace: overwritten by the next call.
    """
    _row_background(
        search_image,
        workspace.n_reach,
        workspace.of_two,
        workspace.of_four,
        workspace.minima,
        workspace.wider,
        workspace.spare,
        workspace.background,
    )
    return workspace.background


@borrowing_kernel
def _flank_background(image: U8Array, n_reach: int, minima: U8Array, background: U8Array) -> None:
    length = image.shape[0]
    n_blocks, n_lines = background.shape
    n_rows = minima.shape[0]
    for b in range(n_reach):
        for x in range(n_lines):
            minima[b, x] = _BEYOND
    for b in range(n_blocks):
        start = b * BLOCK
        own = minima[n_reach + b]
        for x in range(n_lines):
            own[x] = image[start, x]
        for i in range(start + 1, min(start + BLOCK, length)):
            line = image[i]
            for x in range(n_lines):
                low, value = own[x], line[x]
                own[x] = low if low < value else value
    # Each row becomes the minimum of itself and so many after it: twice as many each time.
    span = 1
    while span < n_reach:
        step = min(span, n_reach - span)
        for b in range(n_rows - step):
            for x in range(n_lines):
                low = minima[b, x]
                value = minima[b + step, x]
                minima[b, x] = low if low < value else value
        span += step
    for b in range(n_blocks):
        for x in range(n_lines):
            before = minima[b, x]
            after = minima[b + n_reach + 1, x]
            background[b, x] = before if before > after else after


@borrowing_kernel
def _row_background(
    image: U8Array,
    n_reach: int,
    of_two: U8Array,
    of_four: U8Array,
    minima: U8Array,
    wider: U8Array,
    spare: U8Array,
    background: U8Array,
) -> None:
    n_lines, n_blocks = background.shape
    for x in range(n_lines):
        line, ground = image[x], background[x]
        for i in range(of_two.shape[0]):
            low, value = line[2 * i], line[2 * i + 1]
            of_two[i] = low if low < value else value
        for i in range(of_four.shape[0]):
            low, value = of_two[2 * i], of_two[2 * i + 1]
            of_four[i] = low if low < value else value
        own = minima[n_reach:]
        for b in range(n_blocks):
            low, value = of_four[2 * b], of_four[2 * b + 1]
            own[b] = low if low < value else value
        # There and back between two buffers: in place it would be done one by one.
        span, here, there, other = 1, minima, wider, spare
        while span < n_reach:
            step = min(span, n_reach - span)
            ahead = here[step:]
            for b in range(ahead.shape[0]):
                low, value = here[b], ahead[b]
                there[b] = low if low < value else value
            here, there, other = there, other, there
            span += step
        after = here[n_reach + 1 :]
        for b in range(n_blocks):
            low, value = here[b], after[b]
            ground[b] = low if low > value else value
