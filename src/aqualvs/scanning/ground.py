"""The ground that stripes stand on: the background along search lines, and where light is green."""

import numpy as np

from aqualvs.scanning.contrast import BackgroundWorkspace, flank_background
from aqualvs.scanning.green_cells import WordArray, cells_near_green
from aqualvs.scanning.lanes import U8Array


class Ground:
    """The ground of search images of one shape; allocates once.

    Parameters
    ----------
    length, n_lines : int
        Positions on a search line, and search lines.
    reach_px : int
        How far the background is looked for on each side.
    min_green : int
        Least height of green above its background, in grey levels.
    in_band : uint64 array, shape (n_groups, n_words)
        As `Runs.in_band`.
    """

    def __init__(
        self, length: int, n_lines: int, reach_px: int, min_green: int, in_band: WordArray
    ) -> None:
        self._in_band = in_band
        self._min_green = np.uint8(min_green)
        self._luma = BackgroundWorkspace(n_lines, length, reach_px)
        self._chroma = BackgroundWorkspace(-(-n_lines // 2), -(-length // 2), -(-reach_px // 2))
        self._marks = np.zeros(in_band.shape[1] + 3, np.uint64)
        self._cells = np.empty_like(in_band)

    def background(self, lines: U8Array) -> U8Array:
        """Return the background of every block of luma, shape (n_lines, lanes / BLOCK)."""
        return flank_background(lines, self._luma)

    def near_green(self, green: U8Array) -> WordArray:
        """Return the cells that a band reaches and where something is green."""
        background = flank_background(green, self._chroma)
        cells_near_green(
            green, background, self._min_green, self._in_band, self._marks, self._cells
        )
        return self._cells
