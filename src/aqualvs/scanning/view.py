"""Views: a frame as each search direction sees it.

The decoder's planes are read once. Search lines are the columns of the picture, or its rows; where
they are two pixels wide, the means of columns and those of rows are two small pictures, else both
directions look at the same one. Green is U turned over, so that laser light is high.
"""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import as_strided

from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel
from aqualvs.scanning.contrast import BLOCK, U8Array
from aqualvs.scanning.scan import Frame
from aqualvs.scanning.search import SearchAxis

_AS_IT_IS, _TURNED_OVER = np.uint8(0), np.uint8(255)


@dataclass(frozen=True, slots=True)
class SearchView:
    """A frame as one search direction sees it.

    Attributes
    ----------
    image : uint8 array, shape (height, width)
        Without gaps in memory, in whole blocks of `BLOCK` columns: 255 beyond the picture. Search
        lines are its columns for searches along y, its rows for searches along x.
    lines : uint8 array, shape (n_lines, length)
        The same memory with search lines as rows.
    green, green_lines : uint8 array or None
        255 less U, of half the size, likewise; None for a grey source.
    """

    image: U8Array
    lines: U8Array
    green: U8Array | None
    green_lines: U8Array | None


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
        plane = _Plane if line_px == 1 else _HalvedPlane
        self._luma = plane((height, width), (across, down), _AS_IT_IS)
        chroma = (-(-height // 2), -(-width // 2))
        self._green = plane(chroma, (-(-across // 2), -(-down // 2)), _TURNED_OVER)

    def of(self, frame: Frame) -> dict[SearchAxis, SearchView]:
        """Return the views of a frame; the next call overwrites them."""
        luma = self._luma.take(frame.luma)
        if frame.chroma is None:
            return {axis: SearchView(*luma[axis], None, None) for axis in SearchAxis}
        green = self._green.take(frame.chroma[0])
        return {axis: SearchView(*luma[axis], *green[axis]) for axis in SearchAxis}


BothWays = dict[SearchAxis, tuple[U8Array, U8Array]]


class _Plane:
    """One image plane, the same for both directions."""

    def __init__(self, shape: tuple[int, int], _: tuple[int, int], flip: np.uint8) -> None:
        self._flip, self._width = flip, shape[1]
        self._image = _blocks(*shape)
        picture = self._image[:, : shape[1]]
        self._views: BothWays = {
            SearchAxis.ALONG_Y: (self._image, picture.T),
            SearchAxis.ALONG_X: (self._image, picture),
        }

    def take(self, plane: U8Array) -> BothWays:
        _copy(*_memory(plane), self._width, self._flip, self._image)
        return self._views


class _HalvedPlane:
    """One image plane: the means of neighbouring columns, and those of neighbouring rows."""

    def __init__(self, shape: tuple[int, int], n_lines: tuple[int, int], flip: np.uint8) -> None:
        height, width = shape
        self._flip, self._shape = flip, shape
        self._n_lines = n_lines
        self._columns, self._rows = _blocks(height, n_lines[0]), _blocks(n_lines[1], width)
        self._views: BothWays = {
            SearchAxis.ALONG_Y: (self._columns, self._columns[:, : n_lines[0]].T),
            SearchAxis.ALONG_X: (self._rows, self._rows[:, :width]),
        }

    def take(self, plane: U8Array) -> BothWays:
        _halve(*_memory(plane), self._shape, self._flip, *self._n_lines, self._columns, self._rows)
        return self._views


def _blocks(height: int, width: int) -> U8Array:
    return np.full((height, -(-width // BLOCK) * BLOCK), 255, np.uint8)


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
def _copy(memory: U8Array, step: int, width: int, flip: np.uint8, image: U8Array) -> None:
    for y in range(image.shape[0]):
        line, out = memory[y * step : y * step + width], image[y]
        for x in range(width):
            out[x] = line[x] ^ flip


@borrowing_kernel
def _halve(
    memory: U8Array,
    step: int,
    shape: tuple[int, int],
    flip: np.uint8,
    across: int,
    down: int,
    columns: U8Array,
    rows: U8Array,
) -> None:
    """Average columns two by two, and rows likewise, rounding up; an odd one stands for itself."""
    height, width = shape
    pairs = min(across, width // 2)
    for i in range((height + 1) // 2):
        a, b = 2 * i, min(2 * i + 1, height - 1)
        first, second = memory[a * step : a * step + width], memory[b * step : b * step + width]
        if i < down:
            out = rows[i]
            for x in range(width):
                out[x] = _mean(first[x], second[x]) ^ flip
        for y in range(a, b + 1):
            line, out = memory[y * step : y * step + width], columns[y]
            for x in range(pairs):
                out[x] = _mean(line[2 * x], line[2 * x + 1]) ^ flip
            for x in range(pairs, across):
                out[x] = line[width - 1] ^ flip
