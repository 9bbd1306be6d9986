"""Background along search lines: what a pixel must stand above on both sides.

The background on one side is the minimum over a few blocks of `BLOCK` pixels; the darker side of
the two loses, so that a step edge (a box before a dark wall) has no contrast, and a stripe that
runs along the search line has none either.
"""

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.compiled import borrowing_kernel
from aqualvs.scanning.lanes import LANES, U8Array, lowest_of_eights, whole_lanes

BLOCK = 8
"""Pixels per background block."""

# Beyond the border all is light: next to it nothing can stand out, because one of its flanks is
# not visible.
_BEYOND = np.uint8(255)


# Lines that are looked at together: vectors reach over their ends, and all stay in the nearest
# cache.
_LINES = 16


class BackgroundWorkspace:
    """Buffers of `flank_background` for search images of one shape, allocated once.

    Parameters
    ----------
    n_lines, length : int
        Search lines, and positions on each.
    reach_px : int
        How far the background is looked for on each side; at least the widest stripe's width.
    """

    def __init__(self, n_lines: int, length: int, reach_px: int) -> None:
        self.n_reach = -(-reach_px // BLOCK)
        # Between two lines is as much light as a flank is long, in whole words.
        gap = -(-self.n_reach // BLOCK) * BLOCK
        pitch = whole_lanes(length) // BLOCK + gap
        n_groups = -(-n_lines // _LINES)
        self.minima: U8Array = np.full(_LINES * pitch + 2 * gap + BLOCK, _BEYOND, np.uint8)
        self.wider = np.empty_like(self.minima)
        self.spare = np.empty_like(self.minima)
        self.groups: U8Array = np.empty((n_groups, _LINES * pitch), np.uint8)
        self.background: U8Array = self.groups.reshape(n_groups * _LINES, pitch)[:n_lines]


def flank_background(lines: U8Array, workspace: BackgroundWorkspace) -> U8Array:
    """Return the background of every block: the lighter of the minima on both sides.

    Parameters
    ----------
    lines : uint8 array, shape (n_lines, whole lanes)
        Search lines, allocated with `margined`; 255 beyond the picture.
    workspace : BackgroundWorkspace
        Made for this shape.

    Returns
    -------
    uint8 array, shape (n_lines, lanes / BLOCK or more)
        A view of the workspace: overwritten by the next call. 255 between the end of the picture
        and the end of the lanes; what lies beyond has no meaning.
    """
    _flank_background(
        lines,
        workspace.n_reach,
        workspace.minima,
        workspace.minima.view(np.uint64),
        workspace.wider,
        workspace.spare,
        workspace.groups,
    )
    return workspace.background


@borrowing_kernel
def _flank_background(
    lines: U8Array,
    n_reach: int,
    minima: U8Array,
    words: NDArray[np.uint64],
    wider: U8Array,
    spare: U8Array,
    groups: U8Array,
) -> None:
    n_lines, width = lines.shape
    n_words = width // LANES
    gap = -(-n_reach // BLOCK)
    for group in range(groups.shape[0]):
        for i in range(min(_LINES, n_lines - group * _LINES)):
            first, at = (group * _LINES + i) * width, gap + i * (n_words + gap)
            for w in range(n_words):
                words[at + w] = lowest_of_eights(lines, first + w * LANES)
        # Each becomes the minimum of itself and so many after it: twice as many each time. There
        # and back between two buffers: in place it would be done one by one.
        span, here, there, other = 1, minima, wider, spare
        while span < n_reach:
            step = min(span, n_reach - span)
            ahead = here[step:]
            for b in range(ahead.shape[0]):
                low, value = here[b], ahead[b]
                there[b] = low if low < value else value
            here, there, other = there, other, there
            span += step
        before, after = here[gap * BLOCK - n_reach :], here[gap * BLOCK + 1 :]
        ground = groups[group]
        for b in range(ground.shape[0]):
            low, value = before[b], after[b]
            ground[b] = low if low > value else value
