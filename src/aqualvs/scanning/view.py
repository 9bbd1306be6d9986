"""Views: a frame as one search direction sees it, both ways round."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.compiled import borrowing_kernel
from aqualvs.scanning.contrast import U8Array
from aqualvs.scanning.scan import Frame
from aqualvs.scanning.search import SearchAxis


@dataclass(frozen=True, slots=True)
class SearchView:
    """A frame as one search direction sees it, both ways round.

    What looks at many lines at once runs along the rows of `luma`, what follows one line along
    the rows of `lines`: each along memory.

    Attributes
    ----------
    luma : uint8 array, shape (length, n_lines)
        Search lines are columns.
    lines : uint8 array, shape (n_lines, length)
        Its transpose: search lines are rows.
    u, u_lines : uint8 array or None
        U chroma of half the size, likewise; None for a grey source.
    """

    luma: U8Array
    lines: U8Array
    u: U8Array | None
    u_lines: U8Array | None


class FrameView:
    """Makes the views of frames of one size for one search direction; allocates once.

    Parameters
    ----------
    size_px : (int, int)
        Image width and height.
    axis : SearchAxis
        Along y the columns of the picture are search lines, along x its rows.
    line_px : int
        Pixels across a search line, 1 or 2.
    """

    def __init__(self, size_px: tuple[int, int], axis: SearchAxis, line_px: int) -> None:
        width, height = size_px
        across, length = (height, width) if axis is SearchAxis.ALONG_X else (width, height)
        n_lines = across // line_px
        self._luma = _Plane(axis, line_px, n_lines, length)
        self._u = _Plane(axis, line_px, -(-n_lines // 2), -(-length // 2))

    def of(self, frame: Frame) -> SearchView:
        """Return the view of a frame; the next call overwrites it."""
        luma, lines = self._luma.both_ways(frame.luma)
        if frame.chroma is None:
            return SearchView(luma, lines, None, None)
        # An interleaved chroma plane (NV12) has gaps between its pixels; vector loops want none.
        u, u_lines = self._u.both_ways(np.ascontiguousarray(frame.chroma[0]))
        return SearchView(luma, lines, u, u_lines)


class _Plane:
    """One image plane with its search lines as columns, and as rows."""

    def __init__(self, axis: SearchAxis, line_px: int, n_lines: int, length: int) -> None:
        self._along_x = axis is SearchAxis.ALONG_X
        self._line_px = line_px
        self._columns: U8Array = np.empty((length, n_lines), np.uint8)
        self._rows: U8Array = np.empty((n_lines, length), np.uint8)

    def both_ways(self, image: U8Array) -> tuple[U8Array, U8Array]:
        if self._line_px == 1:
            if self._along_x:
                cv2.transpose(image, self._columns)
                return self._columns, image
            cv2.transpose(image, self._rows)
            return image, self._rows
        if self._along_x:
            _average_rows(image, self._rows)
            cv2.transpose(self._rows, self._columns)
        else:
            _average_columns(self._pairs(image), self._columns)
            cv2.transpose(self._columns, self._rows)
        return self._columns, self._rows

    def _pairs(self, image: U8Array) -> NDArray[np.uint16]:
        """See neighbouring columns as one word; chroma may lack the last column of a pair."""
        width = 2 * self._columns.shape[1]
        if image.shape[1] < width:
            image = np.pad(image, ((0, 0), (0, width - image.shape[1])), "edge")
        return image[:, :width].view(np.uint16)


@borrowing_kernel
def _average_rows(image: U8Array, rows: U8Array) -> None:
    """Average rows two by two, rounding up; a last odd one stands for itself."""
    for i in range(rows.shape[0]):
        a, b = 2 * i, min(2 * i + 1, image.shape[0] - 1)
        for x in range(rows.shape[1]):
            total = np.uint16(image[a, x]) + np.uint16(image[b, x]) + np.uint16(1)
            rows[i, x] = np.uint8(total >> np.uint16(1))


@borrowing_kernel
def _average_columns(pairs: NDArray[np.uint16], columns: U8Array) -> None:
    """Average columns two by two, rounding up; a pair is one 16-bit word, whichever byte leads."""
    for v in range(columns.shape[0]):
        for x in range(columns.shape[1]):
            pair = pairs[v, x]
            total = (pair & np.uint16(255)) + (pair >> np.uint16(8)) + np.uint16(1)
            columns[v, x] = np.uint8(total >> np.uint16(1))
