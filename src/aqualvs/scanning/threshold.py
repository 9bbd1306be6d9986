"""The paper's stripe detection, for comparison: pixels above one threshold (section 3.1)."""

from dataclasses import dataclass

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import kernel
from aqualvs.scanning.contrast import BLOCK, U8Array
from aqualvs.scanning.runs import cells_in_band, find_runs, sort_by_line
from aqualvs.scanning.stripe import Returns
from aqualvs.scanning.view import SearchView


@dataclass(frozen=True, slots=True, kw_only=True)
class ThresholdOptions:
    """Options of the threshold detector.

    Attributes
    ----------
    level : int
        Pixels at least this bright are laser light, in grey levels.
    max_returns : int
        Returns kept per frame and search direction; what exceeds it is dropped.
    """

    level: int = 140
    max_returns: int = 16384

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        if not 1 <= self.level <= 255:
            raise OptionError(f"threshold level is {self.level}; use 1 to 255 grey levels")


class ThresholdDetector:
    """Finds runs of bright pixels along every search line of one direction.

    Each run gives one return at its middle, to half a pixel. The paper takes every bright pixel
    as a point, which has the same mean.

    Parameters
    ----------
    length, n_lines : int
        Shape of the search image.
    lowest, highest : int array, shape (n_lines,)
        First and last position of interest on each line.
    options : ThresholdOptions
        Options.
    """

    def __init__(
        self,
        length: int,
        n_lines: int,
        lowest: IntArray,
        highest: IntArray,
        options: ThresholdOptions,
    ) -> None:
        self._options = options
        self._lowest, self._highest = lowest, highest
        self._cells = cells_in_band(length, lowest, highest)
        # One grey level below the threshold everywhere: what stands above it by one is bright.
        self._background: U8Array = np.full(
            (len(self._cells), n_lines), options.level - 1, np.uint8
        )
        self._marks: U8Array = np.zeros((BLOCK + 1, 8 * self._cells.shape[1]), np.uint8)
        self._open_start = np.empty(8 * self._cells.shape[1], np.int64)
        self._runs = np.empty((options.max_returns, 3), np.int64)
        self._line_start = np.empty(n_lines + 1, np.int64)

    def detect(self, view: SearchView) -> Returns:
        """Find the returns of one frame; colour is not looked at."""
        n = find_runs(
            view.luma,
            self._background,
            np.uint8(1),
            self._cells,
            self._lowest,
            self._highest,
            self._marks,
            self._marks.view(np.uint64),
            self._open_start,
            self._runs,
        )
        runs = np.empty((n, 3), np.int64)
        sort_by_line(self._runs[:n], self._line_start, runs)
        return Returns(
            line=runs[:, 0].copy(),
            position=0.5 * (runs[:, 1] + runs[:, 2]).astype(np.float64),
            height=_peaks(view.lines, runs),
            width=(runs[:, 2] - runs[:, 1] + 1).astype(np.float64),
            green_fall=np.full(n, np.nan),
        )


@kernel
def _peaks(lines: U8Array, runs: IntArray) -> FloatArray:
    """Brightest value of each run (line, first, last)."""
    peaks = np.zeros(runs.shape[0])
    for i in range(runs.shape[0]):
        for v in range(runs[i, 1], runs[i, 2] + 1):
            peaks[i] = max(peaks[i], float(lines[runs[i, 0], v]))
    return peaks
