"""Stripe detection: sub-pixel returns along search lines."""

from dataclasses import dataclass

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import kernel
from aqualvs.scanning.centroids import BATCH, measure_runs
from aqualvs.scanning.ground import Ground
from aqualvs.scanning.lanes import U8Array
from aqualvs.scanning.runs import Runs
from aqualvs.scanning.search import SearchAxis
from aqualvs.scanning.view import SearchView

# Doubling the contrast threshold ends here.
_HIGHEST_CONTRAST = 120
_GREY: U8Array = np.empty((0, 0), np.uint8)


@dataclass(frozen=True, slots=True, kw_only=True)
class StripeOptions:
    """Options of the sub-pixel detector.

    Attributes
    ----------
    min_contrast : int
        Smallest height of a return above its background, in grey levels.
    reach_share : float
        How far the background is looked for on each side, as a share of the image width; must
        exceed the width of the widest stripe.
    min_green_fall : float
        Smallest fall of the U chroma against the flanks, in grey levels: a laser line is greener
        than what surrounds it; twine and sun glare are not. Only used where the source has colour.
    min_share : float
        Returns lower than this share of the frame's bright returns (their 90 % quantile) are noise.
    max_returns : int
        Runs of pixels looked at per frame and search direction; where there are more, the contrast
        threshold is doubled until there are not.
    """

    min_contrast: int = 12
    reach_share: float = 0.045
    min_green_fall: float = 3.0
    min_share: float = 0.25
    max_returns: int = 16384

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        if not 1 <= self.min_contrast <= 254:
            raise OptionError(f"min_contrast is {self.min_contrast}; use 1 to 254 grey levels")
        if not 0.0 <= self.min_share < 1.0:
            raise OptionError(f"min_share is {self.min_share}; use 0 to 1")
        if not 0.0 < self.reach_share < 0.5:
            raise OptionError(f"reach_share is {self.reach_share}; use 0 to 0.5 of the width")


@dataclass(frozen=True, slots=True)
class Returns:
    """Returns of one search direction, ordered by search line, then by position.

    Attributes
    ----------
    line : int array, shape (N,)
        Search line: x for searches along y, y for searches along x.
    position : array, shape (N,)
        Sub-pixel centre along the line.
    height : array, shape (N,)
        Peak above background, in grey levels.
    width : array, shape (N,)
        Full width at half height along the line, in pixels.
    green_fall : array, shape (N,)
        Fall of the U chroma against the flanks, in grey levels; NaN for a grey source.
    """

    line: IntArray
    position: FloatArray
    height: FloatArray
    width: FloatArray
    green_fall: FloatArray

    def __len__(self) -> int:
        """Return the number of returns."""
        return len(self.line)


class StripeDetector:
    """Finds returns along every search line of one direction; several per line.

    Parameters
    ----------
    axis : SearchAxis
        Direction of the search lines.
    size_px : (int, int)
        Image width and height.
    lowest, highest : int array, shape (n_lines,)
        First and last position of interest on each line (an empty interval skips the line).
    options : StripeOptions
        Options.

    Notes
    -----
    A return is a run of pixels above the local background with one peak. Its centre is the
    centroid of what stands above half height, which keeps its place when the top saturates.
    """

    def __init__(
        self,
        axis: SearchAxis,
        size_px: tuple[int, int],
        lowest: IntArray,
        highest: IntArray,
        options: StripeOptions,
    ) -> None:
        self._options = options
        self._reach_px = max(8, round(options.reach_share * size_px[0]))
        along_x = axis is SearchAxis.ALONG_X
        length = size_px[0] if along_x else size_px[1]
        self._length = length
        self._finder = Runs(length, lowest, highest, options.max_returns)
        self._ground = Ground(
            length,
            len(lowest),
            self._reach_px,
            max(1, int(options.min_green_fall)),
            self._finder.in_band,
        )
        self._peaks = np.empty((BATCH + length, 5), np.int64)
        self._line = np.empty(options.max_returns, np.int64)
        self._measures = np.empty((4, options.max_returns))

    def detect(self, view: SearchView) -> Returns:
        """Find the returns of one frame.

        Returns
        -------
        found : Returns
            Copies: they stay valid after the next call.
        """
        background = self._ground.background(view.lines)
        cells = self._finder.in_band if view.green is None else self._ground.near_green(view.green)
        min_contrast = self._options.min_contrast
        while True:
            runs = self._finder.find(view.lines, background, min_contrast, cells)
            if len(runs) < self._finder.capacity or min_contrast > _HIGHEST_CONTRAST:
                break
            # So many runs are noise; stripes stand higher than noise.
            min_contrast *= 2
        n = measure_runs(
            view.lines,
            self._length,
            background,
            _GREY if view.green is None else view.green,
            runs,
            self._reach_px,
            self._options.min_green_fall,
            self._peaks,
            self._line,
            self._measures,
        )
        n = _drop_faint(self._options.min_share, self._line[:n], self._measures[:, :n])
        position, height, width, green_fall = self._measures[:, :n].copy()
        return Returns(self._line[:n].copy(), position, height, width, green_fall)


@kernel
def _drop_faint(share: float, line: IntArray, measures: FloatArray) -> int:
    """Keep the returns of at least `share` of the 90 % quantile of heights, in place."""
    n = line.shape[0]
    of_height = np.zeros(257, np.int64)
    for i in range(n):
        of_height[int(measures[1, i])] += 1
    bright = 256
    seen = 0
    while seen <= 0.1 * n and bright > 0:
        bright -= 1
        seen += of_height[bright]
    kept = 0
    for i in range(n):
        if measures[1, i] >= share * bright:
            line[kept] = line[i]
            for k in range(measures.shape[0]):
                measures[k, kept] = measures[k, i]
            kept += 1
    return kept
