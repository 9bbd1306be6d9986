"""The ground that stripes stand on: the background along search lines, and where light is green."""

import numpy as np

from aqualvs.geometry.arrays import BoolArray
from aqualvs.scanning.contrast import (
    BLOCK,
    BackgroundWorkspace,
    RowBackgroundWorkspace,
    U8Array,
    flank_background,
    row_background,
)
from aqualvs.scanning.green_cells import (
    cells_near_green,
    mark_green,
    mark_green_rows,
    row_cells_near_green,
)


class ColumnGround:
    """The ground of search images of one shape whose lines are columns; allocates once.

    Parameters
    ----------
    length, n_lines : int
        Positions on a search line, and search lines.
    reach_px : int
        How far the background is looked for on each side.
    min_green : int
        Least height of green above its background, in grey levels.
    in_band : bool array, shape (n_blocks, n_words)
        As `ColumnRuns.in_band`.

    Attributes
    ----------
    lines : uint8 array, shape (n_lines or more, n_blocks)
        The last background with search lines as rows.
    """

    def __init__(
        self, length: int, n_lines: int, reach_px: int, min_green: int, in_band: BoolArray
    ) -> None:
        self._in_band = in_band
        self._min_green = np.uint8(min_green)
        self._luma = BackgroundWorkspace(length, _whole(n_lines), reach_px)
        half_length, half_lines = -(-length // 2), -(-n_lines // 2)
        self._chroma = BackgroundWorkspace(half_length, _whole(half_lines), -(-reach_px // 2))
        n_blocks, n_words = in_band.shape
        self._green: U8Array = np.zeros((n_blocks, 4 * n_words), np.uint8)
        self._cells = np.empty_like(in_band)
        self.lines = self._luma.background.T

    def background(self, image: U8Array) -> U8Array:
        """Return the background of every block of luma, shape (n_blocks, width of the image)."""
        return flank_background(image, self._luma)

    def near_green(self, green: U8Array) -> BoolArray:
        """Return the cells that a band reaches and where something is green."""
        background = flank_background(green, self._chroma)
        mark_green(green, background, self._min_green, self._green)
        cells_near_green(self._in_band, self._green.view(np.uint32), self._cells)
        return self._cells


class RowGround:
    """The ground of search images of one shape whose lines are rows; allocates once.

    Parameters
    ----------
    length, n_lines, reach_px, min_green
        As for `ColumnGround`.
    in_band : bool array, shape (n_words, n_blocks)
        As `RowRuns.in_band`.

    Attributes
    ----------
    lines : uint8 array, shape (n_lines, n_blocks)
        The last background.
    """

    def __init__(
        self, length: int, n_lines: int, reach_px: int, min_green: int, in_band: BoolArray
    ) -> None:
        self._in_band = in_band
        self._min_green = np.uint8(min_green)
        self._luma = RowBackgroundWorkspace(n_lines, _whole(length), reach_px)
        half_length, half_lines = -(-length // 2), -(-n_lines // 2)
        self._chroma = RowBackgroundWorkspace(half_lines, _whole(half_length), -(-reach_px // 2))
        self._green: U8Array = np.zeros(in_band.shape, np.uint8)
        self._cells = np.empty_like(in_band)
        self.lines = self._luma.background

    def background(self, image: U8Array) -> U8Array:
        """Return the background of every block of luma, shape (n_lines, n_blocks)."""
        return row_background(image, self._luma)

    def near_green(self, green: U8Array) -> BoolArray:
        """Return the cells that a band reaches and where something is green."""
        background = row_background(green, self._chroma)
        mark_green_rows(green.view(np.uint64), background, self._min_green, self._green)
        row_cells_near_green(self._in_band, self._green, self._cells)
        return self._cells


def _whole(n: int) -> int:
    """Round up to whole blocks."""
    return -(-n // BLOCK) * BLOCK
