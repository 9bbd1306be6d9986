"""Cells of the image that hold the light of a surface.

One return is read as several lasers' points, and one stripe by two search directions: what lies in
or beside a cell in which a surface has light is the same light.
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import inline_borrowing_kernel, kernel

U8Array: TypeAlias = NDArray[np.uint8]

# What marks of a lit cell say: that there is light beside it at least, or in it.
_BESIDE, _MIDDLE = np.uint8(1), np.uint8(2)
# Light within cells of six pixels is the same, by whichever laser or search it was read.
_SIXTH_BITS = 18
_SIXTH = (1 << _SIXTH_BITS) // 6 + 1


@inline_borrowing_kernel
def _cell(coordinate: float) -> int:
    """Return the row or column of a place, from 1; one is left free on each side."""
    # Whole numbers below a hundred thousand divided by six, without a division.
    return (int(max(coordinate, 0.0)) * _SIXTH >> _SIXTH_BITS) + 1


@kernel
def number_cells(pixels: FloatArray, cell: IntArray) -> tuple[int, int]:
    """Write the number of the cell in which each of N readings lies.

    Parameters
    ----------
    pixels : array, shape (N, 2)
        In `image`.
    cell : int array, shape (N,)
        Written.

    Returns
    -------
    n_cells, n_columns : int
        Cells in all, and in a row; a cell's neighbours are numbered as those of a picture's pixels.
    """
    right, low = 0.0, 0.0
    for i in range(pixels.shape[0]):
        right, low = max(right, pixels[i, 0]), max(low, pixels[i, 1])
    n_columns = _cell(right) + 2
    for i in range(pixels.shape[0]):
        cell[i] = _cell(pixels[i, 1]) * n_columns + _cell(pixels[i, 0])
    return (_cell(low) + 2) * n_columns, n_columns


@inline_borrowing_kernel
def light_up(middle: int, n_columns: int, lit: U8Array) -> None:
    """Mark a cell and those around it, where they lie in `lit`: not 0."""
    if lit[middle] == _MIDDLE:
        return
    for row in (middle - n_columns, middle, middle + n_columns):
        for near in range(row - 1, row + 2):
            lit[near] = max(lit[near], _BESIDE)
    lit[middle] = _MIDDLE


@kernel
def lit_cells(cell: IntArray, explained: BoolArray, n_cells: int, n_columns: int) -> U8Array:
    """Mark the cells in and around which explained readings lie: those that are not 0.

    Parameters
    ----------
    cell, n_cells, n_columns
        From `number_cells`.
    explained : bool array, shape (N,)
        Readings that lie on a surface.
    """
    lit = np.zeros(n_cells, np.uint8)
    for i in range(cell.shape[0]):
        if explained[i]:
            light_up(cell[i], n_columns, lit)
    return lit
