"""Search images: a picture as each search direction sees it, with search lines as rows."""

import cv2
import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.compiled import kernel
from aqualvs.scanning.search import SearchAxis
from aqualvs.scanning.stripe import U8Array


class SearchLines:
    """Makes the search lines of pictures of one size, as rows; allocates once.

    In wide pictures a search line is the mean of two rows or columns, smoothed along itself by
    (1, 2, 1) / 4: a stripe can be a pixel or two thin there, its centre then locked to the pixels.

    Parameters
    ----------
    size_px : (int, int)
        Image width and height.
    axis : SearchAxis
        Direction of the search lines.
    line_px : int
        Pixels across a search line, 1 or 2.
    """

    def __init__(self, size_px: tuple[int, int], axis: SearchAxis, line_px: int) -> None:
        width, height = size_px
        self._along_x, self._paired = axis is SearchAxis.ALONG_X, line_px == 2
        shape = (height // line_px, width) if self._along_x else (height, width // line_px)
        self._pairs = np.empty(shape, np.uint8)
        self._turned = np.empty(shape[::-1], np.uint8)
        self._totals = np.empty((3, shape[1]), np.uint16)

    def of(self, luma: U8Array) -> U8Array:
        """Return the search lines of a picture.

        Parameters
        ----------
        luma : uint8 array, shape (height, width)
            Contiguous.

        Returns
        -------
        uint8 array, shape (n_lines, length)
            Overwritten by the next call; the picture itself where that is the same.
        """
        lines = luma
        if self._paired:
            lines = self._pairs
            (_pair_rows if self._along_x else _pair_columns)(luma, self._totals, lines)
        return lines if self._along_x else np.asarray(cv2.transpose(lines, self._turned), np.uint8)


@kernel
def _pair_rows(luma: U8Array, totals: NDArray[np.uint16], lines: U8Array) -> None:
    """Write the means of two rows each, smoothed along them; `totals` is scratch."""
    last, total = luma.shape[1] - 1, totals[0]
    for k in range(lines.shape[0]):
        one, other, out = luma[2 * k], luma[2 * k + 1], lines[k]
        for x in range(total.shape[0]):
            total[x] = np.uint16(one[x]) + np.uint16(other[x])
        before, after, inner = total[:-2], total[2:], out[1:-1]
        middle = total[1:-1]
        for x in range(inner.shape[0]):
            inner[x] = np.uint8((before[x] + np.uint16(2) * middle[x] + after[x] + 4) >> 3)
        out[0] = np.uint8((3 * total[0] + total[1] + 4) >> 3)
        out[last] = np.uint8((3 * total[last] + total[last - 1] + 4) >> 3)


@kernel
def _pair_columns(luma: U8Array, totals: NDArray[np.uint16], columns: U8Array) -> None:
    """Write the means of two columns each, smoothed along them; `totals` is scratch."""
    height = luma.shape[0]
    _add_pairs(luma[0], totals[0])
    _add_pairs(luma[0], totals[1])
    for y in range(height):
        before, middle, after = totals[y % 3], totals[(y + 1) % 3], totals[(y + 2) % 3]
        _add_pairs(luma[min(y + 1, height - 1)], after)
        out = columns[y]
        for x in range(out.shape[0]):
            out[x] = np.uint8((before[x] + np.uint16(2) * middle[x] + after[x] + 4) >> 3)


@kernel
def _add_pairs(row: U8Array, total: NDArray[np.uint16]) -> None:
    for x in range(total.shape[0]):
        total[x] = np.uint16(row[2 * x]) + np.uint16(row[2 * x + 1])
