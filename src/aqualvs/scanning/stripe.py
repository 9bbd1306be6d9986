"""Stripe detection: sub-pixel returns along search lines."""

from dataclasses import dataclass

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel, kernel
from aqualvs.scanning.contrast import BLOCK, U8Array
from aqualvs.scanning.ground import ColumnGround, RowGround
from aqualvs.scanning.runs import ColumnRuns, RowRuns
from aqualvs.scanning.search import SearchAxis
from aqualvs.scanning.view import SearchView

# A valley below this many tenths of the lower of two peaks separates two returns.
_VALLEY_TENTHS = 6
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
        finder = RowRuns if along_x else ColumnRuns
        self._finder = finder(length, lowest, highest, options.max_returns)
        ground = RowGround if along_x else ColumnGround
        self._ground = ground(
            length,
            len(lowest),
            self._reach_px,
            max(1, int(options.min_green_fall)),
            self._finder.in_band,
        )
        self._line = np.empty(options.max_returns, np.int64)
        self._measures = np.empty((4, options.max_returns))

    def detect(self, view: SearchView) -> Returns:
        """Find the returns of one frame.

        Returns
        -------
        found : Returns
            Copies: they stay valid after the next call.
        """
        background = self._ground.background(view.image)
        cells = self._finder.in_band if view.green is None else self._ground.near_green(view.green)
        min_contrast = self._options.min_contrast
        while True:
            runs = self._finder.find(view.image, background, min_contrast, cells)
            if len(runs) < self._finder.capacity or min_contrast > _HIGHEST_CONTRAST:
                break
            # So many runs are noise; stripes stand higher than noise.
            min_contrast *= 2
        n = _measure_runs(
            view.lines,
            self._ground.lines,
            _GREY if view.green_lines is None else view.green_lines,
            runs,
            self._reach_px,
            self._options.min_green_fall,
            self._line,
            self._measures,
        )
        n = _drop_faint(self._options.min_share, self._line[:n], self._measures[:, :n])
        position, height, width, green_fall = self._measures[:, :n].copy()
        return Returns(self._line[:n].copy(), position, height, width, green_fall)


@inline_borrowing_kernel
def _next_peak(lines: U8Array, x: int, start: int, last: int, base: np.int64) -> tuple[int, int]:
    """Return (peak, end) of the first return in [start, last]; the next one begins at `end`.

    `base` is the background: a valley between two returns is shallow or deep against it.
    """
    peak = start
    top = np.int64(lines[x, start])
    valley_at = start
    valley = top
    for v in range(start + 1, last + 1):
        value = np.int64(lines[x, v])
        if value > top:
            if _separates(valley, top, base) and valley_at > start:
                return peak, valley_at
            top, peak = value, v
            valley, valley_at = value, v
        elif value < valley:
            valley, valley_at = value, v
        elif _separates(valley, value, base) and valley_at > start:
            return peak, valley_at
    return peak, last + 1


@inline_borrowing_kernel
def _separates(valley: np.int64, lower_peak: np.int64, base: np.int64) -> bool:
    return bool(10 * (valley - base) < _VALLEY_TENTHS * (lower_peak - base))


@inline_borrowing_kernel
def _half_height_centroid(
    lines: U8Array, x: int, peak: int, low: int, high: int, height: np.int64
) -> tuple[float, float, bool]:
    """Centroid and width of what stands above half `height` at `peak`, searched in [low, high].

    False when the profile does not fall to that level inside the interval, or rises above the peak
    before it does: then this is the foot of another stripe.
    """
    # Twice the grey levels keep half a level a whole number.
    level = 2 * np.int64(lines[x, peak]) - height
    total = np.int64(0)
    moment = np.int64(0)
    a = peak
    while a >= low:
        excess = 2 * np.int64(lines[x, a]) - level
        if excess <= 0:
            break
        if excess > height:
            return 0.0, 0.0, False
        total += excess
        moment += excess * (a - peak)
        a -= 1
    b = peak + 1
    while b <= high:
        excess = 2 * np.int64(lines[x, b]) - level
        if excess <= 0:
            break
        if excess > height:
            return 0.0, 0.0, False
        total += excess
        moment += excess * (b - peak)
        b += 1
    if a < low or b > high:
        return 0.0, 0.0, False
    below, above = 2 * np.int64(lines[x, a]) - level, 2 * np.int64(lines[x, a + 1]) - level
    rise = -below / (above - below)
    below, above = 2 * np.int64(lines[x, b]) - level, 2 * np.int64(lines[x, b - 1]) - level
    fall = -below / (above - below)
    return peak + moment / total, (b - fall) - (a + rise), True


@inline_borrowing_kernel
def _green_fall(green_lines: U8Array, x: int, peak: int, width: float) -> float:
    """Fall of U against both flanks, where it is deepest: a saturated core is white, not green."""
    row = x // 2
    last = green_lines.shape[1] - 1
    edge = int(0.5 * width) + 1
    flank = int(width) + 4
    here = max(
        green_lines[row, peak // 2],
        green_lines[row, max(peak - edge, 0) // 2],
        green_lines[row, min((peak + edge) // 2, last)],
    )
    before = float(green_lines[row, max(peak - flank, 0) // 2])
    after = float(green_lines[row, min((peak + flank) // 2, last)])
    return float(here) - 0.5 * (before + after)


@borrowing_kernel
def _measure_runs(
    lines: U8Array,
    background: U8Array,
    green_lines: U8Array,
    runs: IntArray,
    reach_px: int,
    min_green_fall: float,
    line: IntArray,
    measures: FloatArray,
) -> int:
    """Write the line and (position, height, width, green fall) of every return in the runs."""
    length = lines.shape[1]
    n = 0
    for i in range(runs.shape[0]):
        x, start, last = runs[i, 0], runs[i, 1], runs[i, 2]
        first = max(start - reach_px, 0)
        base = np.int64(background[x, start // BLOCK])
        while start <= last and n < line.shape[0]:
            peak, end = _next_peak(lines, x, start, last, base)
            # Beyond the run the profile may still be falling towards half height.
            bound = min(last + reach_px, length - 1) if end > last else end
            height = np.int64(lines[x, peak]) - np.int64(background[x, peak // BLOCK])
            centre, width, found = _half_height_centroid(lines, x, peak, first, bound, height)
            first = end
            start = end
            if not found or width > reach_px:
                continue
            green = np.nan
            if green_lines.shape[0] > 0:
                green = _green_fall(green_lines, x, peak, width)
                if green < min_green_fall:
                    continue
            line[n] = x
            measures[0, n] = centre
            measures[1, n] = height
            measures[2, n] = width
            measures[3, n] = green
            n += 1
    return n


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
