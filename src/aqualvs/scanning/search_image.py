"""Search images: a picture as each search direction sees it, with search lines as rows."""

import cv2
import numpy as np

from aqualvs.geometry.compiled import inline_kernel, kernel
from aqualvs.scanning.search import SearchAxis
from aqualvs.scanning.stripe import U8Array


class SearchLines:
    """Makes the search lines of pictures of one size, as rows; allocates once.

    In wide pictures a search line is the mean of two rows or columns, smoothed along itself by
    (1, 2, 1) / 4: a stripe can be a pixel or two thin there, its centre then locked to the pixels.
    All means are of two bytes and rounded up, for which processors have an instruction.

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
        self._means = np.empty((3, shape[1]), np.uint8)

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
            (_pair_rows if self._along_x else _pair_columns)(luma, self._means, lines)
        return lines if self._along_x else np.asarray(cv2.transpose(lines, self._turned), np.uint8)


@inline_kernel
def _mean(one: np.uint8, other: np.uint8) -> np.uint8:
    return np.uint8((np.uint16(one) + np.uint16(other) + np.uint16(1)) >> np.uint16(1))


@kernel
def _pair_rows(luma: U8Array, means: U8Array, lines: U8Array) -> None:
    """Write the means of two rows each, smoothed along them; `means` is scratch."""
    mean = means[0]
    last = mean.shape[0] - 1
    before, middle, after = mean[:-2], mean[1:-1], mean[2:]
    for k in range(lines.shape[0]):
        one, other, out = luma[2 * k], luma[2 * k + 1], lines[k]
        for x in range(mean.shape[0]):
            mean[x] = _mean(one[x], other[x])
        inner = out[1:-1]
        for x in range(inner.shape[0]):
            inner[x] = _mean(_mean(before[x], after[x]), middle[x])
        out[0] = _mean(_mean(mean[0], mean[1]), mean[0])
        out[last] = _mean(_mean(mean[last - 1], mean[last]), mean[last])


@kernel
def _pair_columns(luma: U8Array, means: U8Array, columns: U8Array) -> None:
    """Write the means of two columns each, smoothed along them; `means` is scratch."""
    height = luma.shape[0]
    _pair_pixels(luma[0], means[0])
    _pair_pixels(luma[0], means[1])
    for y in range(height):
        before, middle, after = means[y % 3], means[(y + 1) % 3], means[(y + 2) % 3]
        _pair_pixels(luma[min(y + 1, height - 1)], after)
        out = columns[y]
        for x in range(out.shape[0]):
            out[x] = _mean(_mean(before[x], after[x]), middle[x])


@kernel
def _pair_pixels(row: U8Array, mean: U8Array) -> None:
    for x in range(mean.shape[0]):
        mean[x] = _mean(row[2 * x], row[2 * x + 1])
