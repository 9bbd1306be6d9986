"""The paper's stripe detection, for comparison: every pixel above one threshold (section 3.1).

Bright pixels that follow one another on a search line are one return: position and width say
exactly which they are, and `pixels_of_returns` gives them back one by one.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.scanning.search import SearchAxis
from aqualvs.scanning.stripe import Returns

_LEVELS = 256


@dataclass(frozen=True, slots=True, kw_only=True)
class ThresholdOptions:
    """Options of the threshold detector.

    Attributes
    ----------
    level : int
        Pixels at least this bright are laser light, in grey levels.
    max_returns, max_pixels : int
        Runs of bright pixels, and bright pixels, allowed per frame and search direction. Where
        there are more, the lowest higher level is used at which there are not; if even white is
        too much, the frame has no returns.
    """

    level: int = 140
    max_returns: int = 16384
    max_pixels: int = 131072

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        if not 1 <= self.level <= 255:
            raise OptionError(f"threshold level is {self.level}; use 1 to 255 grey levels")


class ThresholdDetector:
    """Finds the bright pixels on every search line of one direction, inside its band.

    Parameters
    ----------
    axis : SearchAxis
        Direction of the search lines.
    size_px : (int, int)
        Image width and height.
    lowest, highest : int array, shape (n_lines,)
        First and last position of interest on each line (an empty interval skips the line).
    options : ThresholdOptions
        Options.
    """

    def __init__(
        self,
        axis: SearchAxis,
        size_px: tuple[int, int],
        lowest: IntArray,
        highest: IntArray,
        options: ThresholdOptions,
    ) -> None:
        self._options = options
        length = size_px[0] if axis is SearchAxis.ALONG_X else size_px[1]
        along = np.arange(length)
        self._in_band: BoolArray = (lowest[:, None] <= along) & (along <= highest[:, None])
        # Zero outside the band; the zeros of one more column end the runs of every line.
        self._lines: NDArray[np.uint8] = np.zeros((len(lowest), length + 1), np.uint8)

    def detect(self, lines: NDArray[np.uint8]) -> Returns:
        """Find the runs of bright pixels of one frame; colour is not looked at.

        Parameters
        ----------
        lines : uint8 array, shape (n_lines, length)
            Luma, with search lines as rows.

        Returns
        -------
        found : Returns
            Position is the middle of a run, width the number of its pixels, height its brightest
            value.
        """
        np.multiply(lines, self._in_band, out=self._lines[:, :-1])
        flat = self._lines.ravel()
        first, end = _runs(flat, self._options.level)
        if len(first) > self._options.max_returns or np.sum(end - first) > self._options.max_pixels:
            first, end = _runs(flat, self._raised_level(flat))
        line, start = np.divmod(first, self._lines.shape[1])
        width = end - first
        return Returns(
            line=line,
            position=start + 0.5 * (width - 1),
            height=_brightest(flat, first, end),
            width=width.astype(np.float64),
            likelihood=np.ones(len(first)),
        )

    def _raised_level(self, flat: NDArray[np.uint8]) -> int:
        """Return the lowest level at which both limits hold; 256 where none is."""
        # A run begins where a pixel reaches a level and the one before it does not.
        inside = np.minimum(flat[1:], flat[:-1])
        n_pixels, n_inside = _counts_from(flat), _counts_from(inside)
        fits = n_pixels <= self._options.max_pixels
        fits &= n_pixels - n_inside <= self._options.max_returns
        fits[: self._options.level] = False
        return int(np.argmax(fits)) if fits.any() else _LEVELS


def pixels_of_returns(position: FloatArray, width: FloatArray) -> tuple[IntArray, FloatArray]:
    """List the pixels that returns are made of, along their search lines.

    A return of the threshold detector gives its bright pixels, each once; a sub-pixel one those
    above half its height, at least one.

    Parameters
    ----------
    position, width : array, shape (N,)
        As in `Returns`.

    Returns
    -------
    source : int array, shape (M,)
        Row of the return that each pixel belongs to, ascending.
    place : array, shape (M,)
        Whole position of each pixel.
    """
    first, last = np.ceil(position - 0.5 * width), np.floor(position + 0.5 * width)
    none = last < first
    first, last = np.where(none, np.rint(position), first), np.where(none, np.rint(position), last)
    count = (last - first).astype(np.int64) + 1
    source = np.repeat(np.arange(len(count)), count)
    step = np.arange(len(source)) - np.repeat(np.cumsum(count) - count, count)
    return source, first[source] + step


def _runs(flat: NDArray[np.uint8], level: int) -> tuple[IntArray, IntArray]:
    """Return where runs of bright pixels begin and, one place later, where they end."""
    if level >= _LEVELS:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    bright = flat >= level
    edges = np.flatnonzero(bright[1:] != bright[:-1]) + 1
    if bright[0]:
        edges = np.concatenate([[0], edges])
    return edges[::2], edges[1::2]


def _counts_from(values: NDArray[np.uint8]) -> IntArray:
    """Return how many values are at least 0, 1, ... 255."""
    return np.cumsum(np.bincount(values, minlength=_LEVELS)[::-1])[::-1]


def _brightest(flat: NDArray[np.uint8], first: IntArray, end: IntArray) -> FloatArray:
    if not len(first):
        return np.empty(0)
    bounds = np.column_stack([first, end]).ravel()
    return np.maximum.reduceat(flat, bounds)[::2].astype(np.float64)
