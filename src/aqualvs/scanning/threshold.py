"""The paper's stripe detection, for comparison: pixels above one threshold (section 3.1)."""

from dataclasses import dataclass

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import kernel
from aqualvs.scanning.contrast import BLOCK
from aqualvs.scanning.lanes import U8Array, whole_lanes
from aqualvs.scanning.runs import Runs
from aqualvs.scanning.search import SearchAxis
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
    axis : SearchAxis
        Direction of the search lines.
    size_px : (int, int)
        Image width and height.
    lowest, highest : int array, shape (n_lines,)
        First and last position of interest on each line.
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
        along_x = axis is SearchAxis.ALONG_X
        length = size_px[0] if along_x else size_px[1]
        self._finder = Runs(length, lowest, highest, options.max_returns)
        # One grey level below the threshold everywhere: what stands above it by one is bright.
        n_blocks = whole_lanes(length) // BLOCK
        self._below: U8Array = np.full((len(lowest), n_blocks), options.level - 1, np.uint8)

    def detect(self, view: SearchView) -> Returns:
        """Find the returns of one frame; colour is not looked at."""
        runs = self._finder.find(view.lines, self._below, 1, self._finder.in_band)
        n = len(runs)
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
