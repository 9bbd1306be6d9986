"""Views: a frame as each search direction sees it, with search lines as rows.

The decoder's planes are read once. Search lines are the columns of the picture, turned into rows,
or its rows; where they are two pixels wide, they are the means of two columns, or of two rows.
Green is U turned over, so that laser light is high.
"""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import as_strided

from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel
from aqualvs.scanning.lanes import U8Array, margined
from aqualvs.scanning.scan import Frame
from aqualvs.scanning.search import SearchAxis
from aqualvs.scanning.turning import SQUARE, turn_slab

_AS_IT_IS, _TURNED_OVER = np.uint8(0), np.uint8(255)


@dataclass(frozen=True, slots=True)
class SearchView:
    """A frame as one search direction sees it.

    Attributes
    ----------
    lines : uint8 array, shape (n_lines, whole lanes)
        Search lines, allocated with `margined`: 255 beyond the picture.
    green : uint8 array or None
        255 less U, of half the size, likewise; None for a grey source.
    """

    lines: U8Array
    green: U8Array | None


class FrameViews:
    """Makes the views of frames of one size; allocates once.

    Parameters
    ----------
    size_px : (int, int)
        Image width and height.
    line_px : int
        Pixels across a search line, 1 or 2.
    """

    def __init__(self, size_px: tuple[int, int], line_px: int) -> None:
        width, height = size_px
        across, down = width // line_px, height // line_px
        self._luma = _Plane((height, width), (across, down), line_px, _AS_IT_IS)
        chroma = (-(-height // 2), -(-width // 2))
        halves = (-(-across // 2), -(-down // 2))
        self._green = _Plane(chroma, halves, line_px, _TURNED_OVER)

    def of(self, frame: Frame) -> dict[SearchAxis, SearchView]:
        """Return the views of a frame; the next call overwrites them."""
        luma = self._luma.take(frame.luma)
        if frame.chroma is None:
            return {axis: SearchView(luma[axis], None) for axis in SearchAxis}
        green = self._green.take(frame.chroma[0])
        return {axis: SearchView(luma[axis], green[axis]) for axis in SearchAxis}


class _Plane:
    """One image plane: its columns and its rows, or the means of two of them, as search lines."""

    def __init__(
        self, shape: tuple[int, int], n_lines: tuple[int, int], line_px: int, flip: np.uint8
    ) -> None:
        height, width = shape
        self._shape, self._flip = shape, flip
        self._take = _copy if line_px == 1 else _halve
        self._columns = margined(-(-n_lines[0] // SQUARE) * SQUARE, height)
        self._rows = margined(n_lines[1], width)
        self._slab: U8Array = np.zeros((SQUARE, len(self._columns)), np.uint8)
        self._pieces: U8Array = np.empty((SQUARE, SQUARE), np.uint8)
        self._views = {
            SearchAxis.ALONG_Y: self._columns[: n_lines[0]],
            SearchAxis.ALONG_X: self._rows,
        }
        self._n_columns = n_lines[0]

    def take(self, plane: U8Array) -> dict[SearchAxis, U8Array]:
        self._take(
            *_memory(plane),
            self._shape,
            self._flip,
            self._n_columns,
            self._slab,
            self._pieces,
            self._columns,
            self._rows,
        )
        return self._views


def _memory(plane: U8Array) -> tuple[U8Array, int]:
    """Return all of a plane's memory from its first pixel to its last, and the step to a next row.

    Decoders pad rows, and loops over rows with gaps become no vector instructions.
    """
    height, width = plane.shape
    step, along = plane.strides
    if along != 1 or step < width:
        # An interleaved chroma plane (NV12) has gaps between its pixels as well.
        plane, step = np.ascontiguousarray(plane), width
    n_bytes = (height - 1) * step + width
    return as_strided(plane, (n_bytes,), (1,), writeable=False), step


@inline_borrowing_kernel
def _mean(one: np.uint8, other: np.uint8) -> np.uint8:
    """Return the mean, rounded up, without a wider sum."""
    return np.uint8((one | other) - np.uint8((one ^ other) >> np.uint8(1)))


@borrowing_kernel
def _copy(
    memory: U8Array,
    step: int,
    shape: tuple[int, int],
    flip: np.uint8,
    _: int,
    slab: U8Array,
    pieces: U8Array,
    columns: U8Array,
    rows: U8Array,
) -> None:
    """Copy rows, and turn columns into rows."""
    height, width = shape
    for y in range(height):
        line, own, out = memory[y * step : y * step + width], slab[y % SQUARE], rows[y]
        for x in range(width):
            value = line[x] ^ flip
            own[x] = value
            out[x] = value
        _turn_when_full(slab, pieces, y, height, columns)


@borrowing_kernel
def _halve(
    memory: U8Array,
    step: int,
    shape: tuple[int, int],
    flip: np.uint8,
    n_columns: int,
    slab: U8Array,
    pieces: U8Array,
    columns: U8Array,
    rows: U8Array,
) -> None:
    """Average columns two by two, and rows likewise, rounding up; an odd one stands for itself."""
    height, width = shape
    pairs = min(n_columns, width // 2)
    for y in range(height):
        line, own = memory[y * step : y * step + width], slab[y % SQUARE]
        for x in range(pairs):
            own[x] = _mean(line[2 * x], line[2 * x + 1]) ^ flip
        for x in range(pairs, n_columns):
            own[x] = line[width - 1] ^ flip
        if y % 2 == 0 and y // 2 < rows.shape[0]:
            other = min(y + 1, height - 1)
            below, out = memory[other * step : other * step + width], rows[y // 2]
            for x in range(width):
                out[x] = _mean(line[x], below[x]) ^ flip
        _turn_when_full(slab, pieces, y, height, columns)


@inline_borrowing_kernel
def _turn_when_full(slab: U8Array, pieces: U8Array, y: int, height: int, columns: U8Array) -> None:
    """Write the columns of a slab when row `y` of the picture was its last; 255 beyond the end."""
    row = y % SQUARE
    if y + 1 == height:
        for i in range(row + 1, SQUARE):
            slab[i, :] = np.uint8(255)
    elif row + 1 < SQUARE:
        return
    turn_slab(slab, pieces, columns, y - row)
