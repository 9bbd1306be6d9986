"""Stripe peaks: sub-pixel detection along search lines.

A peak is a run of pixels above the local background with one maximum. The background on one side is
the minimum within reach; the higher of the two sides counts, so that neither a step edge (a box
before a dark wall) nor a stripe that runs along the search line has contrast. The centre is the
centroid of the profile above half height, which does not move when the top saturates; for a stripe
narrower than two pixels, the peak of a Gaussian through three pixels.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray, IntArray, U8Array
from aqualvs.geometry.compiled import ZERO, borrowing_kernel, inline_borrowing_kernel

# Marks, bytes of 0 or 1, are read eight at a time.
_WORD = 8
_NOTHING, _ALL_BITS = np.uint64(0), np.uint64(0xFFFFFFFFFFFFFFFF)
_BYTE_NUMBERS = np.uint64(0x0001020304050607)
_BRIGHT = np.uint8(255)
# The profile of a stripe narrower than this is not linear between pixels: linear interpolation
# pulls its centroid to the pixel grid by up to 0.05 px, at half of this width by 0.15 px. At this
# width noise moves centroid and Gaussian peak alike. A pixel at least as bright as `_WHITE` (grey
# levels) is saturated: a Gaussian does not fit it.
_NARROW_PX, _WHITE = 2.0, 250
# Bytes that compiled loops process at a time, or a multiple of them.
_VECTOR = 128
# Luma up to which flanks are dark, in grey levels; black is 16.
_DARK = 36.0
_THIRD = 1.0 / 3.0
# If the flanks differ by more than this share of a peak's height, one of them is another stripe.
# They are read this many pixels beyond the peak's width.
_OTHER_STRIPE, _FLANK_PX = 0.25, 4
# Shift of the centroid above half height of a Gaussian of width w on a ramp, over w² times the
# ramp's slope over the Gaussian's height: (1 / 12) / (0.810 - 1 / 2), the area above half height.
_PULL_OF_RAMP = 0.269
PULL_OF_STEP = 0.222
"""Shift of the centroid above half height of a Gaussian of width w on a step that is blurred as the
Gaussian is, over w times the step's height over the Gaussian's; integrated numerically."""
POSITION, HEIGHT, WIDTH, TOP, STEP_U, STEP_V, IMBALANCE, TINT_U, TINT_V, PULL = range(10)
"""Rows of a table of peaks: position and full width at half height along the search line (px);
height above the background and luma of the highest pixel (grey levels); chroma of the peak less
that of its flanks; difference of chroma between the flanks, along the laser's colour; chroma of the
flanks for each level of their luma, 0 if dark; shift of the position by an uneven background (px).
"""
N_MEASURES = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class StripeOptions:
    """Options of the sub-pixel detector."""

    # Smallest height of a peak above its background, in grey levels; raised if hardly any peak of
    # that height is laser light, halved if hardly anything in a colour picture is as high.
    min_contrast: int = 6
    # Reach of the search for the background on each side, as a share of the image width; must
    # exceed the width of the widest stripe.
    reach_share: float = 0.045
    # Least likelihood, 0 to 1, that the colour of a peak is laser light. Only used where the source
    # has colour.
    min_likelihood: float = 0.1
    # Peaks lower than this share of the frame's bright peaks (their 90 % quantile) are kept only
    # if many follow one another, as on a distant wall or of a weak laser; others are noise, or
    # the glow beside a strand.
    min_share: float = 0.25
    # Largest number of peaks per frame and search direction; if there are more, the contrast
    # threshold is doubled until there are not.
    max_returns: int = 16384

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        if not 1 <= self.min_contrast <= 254:
            raise OptionError(f"min_contrast is {self.min_contrast}; use 1 to 254 grey levels")
        if not 0.0 <= self.min_share < 1.0:
            raise OptionError(f"min_share is {self.min_share}; use 0 to 1")
        if not 0.0 <= self.min_likelihood < 1.0:
            raise OptionError(f"min_likelihood is {self.min_likelihood}; use 0 to 1")
        if not 0.0 < self.reach_share < 0.5:
            raise OptionError(f"reach_share is {self.reach_share}; use 0 to 0.5 of the width")


@dataclass(frozen=True, slots=True, kw_only=True)
class ThresholdOptions:
    """Options of the threshold detector."""

    # Pixels at least this bright are laser light, in grey levels.
    level: int = 140
    # Largest number of runs of bright pixels, and of bright pixels, per frame and search direction.
    # If there are more, the level is raised until there are not; a frame with too much white has no
    # peaks.
    max_returns: int = 16384
    max_pixels: int = 131072

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        if not 1 <= self.level <= 255:
            raise OptionError(f"threshold level is {self.level}; use 1 to 255 grey levels")


class StripePeaks(NamedTuple):
    """Stripe peaks of one search direction, ordered by search line, then by position."""

    # Shape (N,): search line: x for searches along y, y for searches along x.
    line: IntArray
    # Shape (N,): sub-pixel centre along the line.
    position: FloatArray
    # Shape (N,): peak above background, in grey levels.
    height: FloatArray
    # Shape (N,): full width at half height along the line, in pixels.
    width: FloatArray
    # Shape (N,): likelihood that the peak is laser light, by its colour: 0 to 1; 1 for a grey
    # source.
    likelihood: FloatArray
    # Shape (N,): shift of `position` by a background that is brighter on one side, taken for a ramp
    # between the flanks; in pixels. 0 where it is not measured.
    pull: FloatArray

    @property
    def n(self) -> int:
        """Number of peaks."""
        return len(self.line)


class SearchImage(NamedTuple):
    """A frame laid out for one search direction, with search lines as rows."""

    # Shape (n_lines, length): search lines as rows.
    lines: U8Array
    # Shape (ceil(height / 2), ceil(width / 2)): chroma of the frame as it is, not turned; of shape
    # (0, 0) for a grey source.
    u: U8Array
    v: U8Array
    # Pixels across one search line.
    line_px: int
    # Whether search lines are rows of the frame; else they are columns.
    along_x: bool


class _Workspace(NamedTuple):
    """Buffers of one search line; an element stands for a pair of pixels."""

    # Minimum and maximum of each pair, with a margin of the reach at both ends.
    least: U8Array
    most: U8Array
    # Minima over windows, and a second buffer for them.
    minima: U8Array
    spare: U8Array
    background: U8Array
    # 1 if a pixel of the pair is above the background, else 0; and the same bytes, eight at a time.
    above: U8Array
    words: NDArray[np.uint64]


class PeakFinder:
    """Detector of peaks along the search lines of one direction.

    Parameters
    ----------
    length : int
        Positions on a search line.
    lowest, highest : int array, shape (n_lines,)
        First and last position of interest on each line (an empty interval skips the line).
    reach_px : int
        Reach of the search for the background on each side; wider stripes are left out.
    directions : array, shape (n_colours, 2)
        The lasers' colours in the (U, V) plane.
    """

    def __init__(
        self,
        length: int,
        lowest: IntArray,
        highest: IntArray,
        reach_px: int,
        directions: FloatArray,
    ) -> None:
        self._lowest, self._highest = lowest, highest
        self._reach_px, self._directions = reach_px, directions
        # Lines are processed in whole vectors, beyond their last pixel.
        pairs = (length + 1) // 2
        least, most, minima, spare = np.full((4, pairs + 2 * reach_px + _VECTOR), 255, np.uint8)
        # With room for a mark after the last pair, in whole words.
        background, above = np.zeros((2, (pairs + _VECTOR) // _WORD * _WORD + _WORD), np.uint8)
        words = above.view(np.uint64)
        self._scratch = _Workspace(least, most, minima, spare, background, above, words)

    def find(
        self, image: SearchImage, min_contrast: int, every: int, line: IntArray, table: FloatArray
    ) -> int:
        """Find the peaks of one frame, and return their number.

        Parameters
        ----------
        image : SearchImage
            Of the shape that the finder was made for.
        min_contrast : int
            Least height above the background, in grey levels; doubled while there are N peaks or
            more.
        every : int
            Use one search line of this many.
        line : int array, shape (N,)
            Written: search line of each peak; ascending.
        table : array, shape (10, N)
            Written: measures of each peak, rows as named above.
        """
        # Contrast threshold above which it is not doubled, in grey levels: twice this is 240.
        max_contrast = 120
        while True:
            n = _find_peaks(
                image,
                self._lowest,
                self._highest,
                min_contrast,
                every,
                self._reach_px,
                self._directions,
                self._scratch,
                line,
                table,
            )
            if n < len(line) or min_contrast > max_contrast:
                return n
            min_contrast *= 2


@borrowing_kernel
def _find_peaks(
    image: SearchImage,
    lowest: IntArray,
    highest: IntArray,
    min_contrast: int,
    every: int,
    reach_px: int,
    directions: FloatArray,
    scratch: _Workspace,
    line: IntArray,
    table: FloatArray,
) -> int:
    """Write the search line and the measures of each peak; return the number of peaks."""
    n = ZERO
    for x in range(0, lowest.shape[0], every):
        if lowest[x] > highest[x]:
            continue
        row = image.lines[x]
        # Runs may extend beyond the band.
        first = max(lowest[x] - reach_px, 0) >> 1
        end = (min(highest[x] + reach_px, row.shape[0] - 1) >> 1) + 1
        _mark_above(row, first, end, min_contrast, max((reach_px - 1) >> 1, 1), scratch)
        pair = _next_marked(scratch.words, ZERO)
        while pair < end - first:
            run = _run_in(row, 2 * first, pair, 2 * end, min_contrast, scratch.background)
            if run[0] <= highest[x] and run[1] > lowest[x]:
                n = _measure_run(
                    image, x, 2 * first, run, scratch, reach_px, directions, line, table, n
                )
                if n == line.shape[0]:
                    return n
            # The pixel after a run is not above the background.
            pair = _next_marked(scratch.words, ((run[1] + 1) >> 1) - first)
    return n


@inline_borrowing_kernel
def _run_in(
    row: U8Array, first: int, pair: int, end: int, min_contrast: int, background: U8Array
) -> tuple[int, int]:
    """Return the run [start, stop) of pixels above the background that begins in a marked pair.

    Pairs count from position `first` on; the run stops at `end` at the latest.
    """
    start, end = first + 2 * pair, min(end, row.shape[0])
    start += row[start] < background[pair] + min_contrast
    stop = start + 1
    while stop < end and row[stop] >= background[(stop - first) >> 1] + min_contrast:
        stop += 1
    return start, stop


@inline_borrowing_kernel
def _mark_above(
    row: U8Array, first: int, end: int, min_contrast: int, reach: int, scratch: _Workspace
) -> None:
    """Mark the pairs of pixels [first, end) that stand above the background; index 0 is `first`.

    The background of a pair is the higher of the two minima over `reach` pairs on either side. The
    pair itself does not count: one of its pixels may lie on the dark side of a step edge.
    """
    n = end - first
    # With slices that start at 0 LLVM knows that no index is negative, and uses vector
    # instructions.
    least, most = scratch.least[: n + 2 * reach], scratch.most[: n + 2 * reach]
    # Pixels beyond the border count as white: a peak with one invisible flank is not found.
    seen, ahead = min(reach, first), min(reach, ((row.shape[0] + 1) >> 1) - end)
    least[: reach - seen] = _BRIGHT
    _pair(
        row[2 * (first - seen) : 2 * (end + ahead)],
        least[reach - seen : reach + n + ahead],
        most[reach - seen : reach + n + ahead],
    )
    least[reach + n + ahead :] = _BRIGHT
    # Minima over windows that grow to `reach` pairs, four times as wide at each step.
    here, there = scratch.least, scratch.minima
    span = 1
    while 2 * span < reach:
        grown = min(4 * span, reach)
        last = grown - span
        _least_of_four(
            here,
            here[min(span, last) :],
            here[min(2 * span, last) :],
            here[last:],
            _whole_vectors(n + 2 * reach - grown + 1),
            there,
        )
        here, there = there, here if span > 1 else scratch.spare
        span = grown
    # The last step joins two windows of `span` pairs, before a pair and behind it.
    near_before, near_behind = here, here[reach + 1 :]
    far_before, far_behind = here[reach - span :], here[2 * reach + 1 - span :]
    pairs, background, above = scratch.most[reach:], scratch.background, scratch.above
    enough = np.uint8(min_contrast)
    for i in range(_whole_vectors(n)):
        before = near_before[i] if near_before[i] < far_before[i] else far_before[i]
        behind = near_behind[i] if near_behind[i] < far_behind[i] else far_behind[i]
        base = before if before > behind else behind
        background[i] = base
        base = base if base < pairs[i] else pairs[i]
        above[i] = np.uint8(np.uint8(pairs[i] - base) >= enough)
    # Sentinel for `_next_marked`.
    above[n] = np.uint8(1)


@inline_borrowing_kernel
def _pair(row: U8Array, least: U8Array, most: U8Array) -> None:
    """Write minimum and maximum of each pair of pixels; an odd last pixel is both."""
    for i in range(row.shape[0] >> 1):
        one, other = row[2 * i], row[2 * i + 1]
        least[i] = one if one < other else other
        most[i] = other if one < other else one
    if row.shape[0] & 1:
        least[row.shape[0] >> 1] = most[row.shape[0] >> 1] = row[row.shape[0] - 1]


@inline_borrowing_kernel
def _whole_vectors(n: int) -> int:
    """Round a number of pairs up to whole vectors: compiled loops handle a remainder one by one."""
    return (n + _VECTOR - 1) // _VECTOR * _VECTOR


@inline_borrowing_kernel
def _least_of_four(
    one: U8Array, two: U8Array, three: U8Array, four: U8Array, n: int, least: U8Array
) -> None:
    """Write the elementwise minimum of four arrays (n,)."""
    for i in range(n):
        first = one[i] if one[i] < two[i] else two[i]
        second = three[i] if three[i] < four[i] else four[i]
        least[i] = first if first < second else second


@inline_borrowing_kernel
def _next_marked(words: NDArray[np.uint64], at: int) -> int:
    """Return the index of the first mark from `at` on; there must be one."""
    index = at >> 3
    found = words[index] & (_ALL_BITS << np.uint64(8 * (at & 7)))
    while found == _NOTHING:
        index += 1
        found = words[index]
    # The lowest set bit is 1 << 8 k; multiplying by it shifts byte 7 - k of the constant, which is
    # k, to the top.
    lowest = found & (~found + np.uint64(1))
    return (index << 3) + int((lowest * _BYTE_NUMBERS) >> np.uint64(56))


@inline_borrowing_kernel
def _measure_run(
    image: SearchImage,
    x: int,
    first: int,
    run: tuple[int, int],
    scratch: _Workspace,
    reach_px: int,
    directions: FloatArray,
    line: IntArray,
    table: FloatArray,
    n: int,
) -> int:
    """Append the peaks of a run [start, end) of search line `x`; return the new number of peaks.

    Element 0 of the background is the pair at position `first`.
    """
    row, background = image.lines[x], scratch.background
    start, end = run
    base = np.int64(background[(start - first) >> 1])
    low = max(start - reach_px, 0)
    # Outside the run the profile may still fall towards half height.
    high = min(end + reach_px, row.shape[0]) - 1
    while start < end and n < line.shape[0]:
        peak, start = _next_peak(row, start, end, base)
        last = high if start >= end else start
        # Doubled grey levels, so that half a level is a whole number.
        level = np.int64(row[peak]) + np.int64(background[(peak - first) >> 1])
        a, b = _feet(row, peak, low, last, level)
        low = start
        if a < 0:
            continue
        crossings = _crossings(row, a, b, level)
        width = (b - crossings[1]) - (a + crossings[0])
        if width > reach_px:
            continue
        line[n] = x
        table[POSITION, n] = (
            _gaussian_peak(row, peak, level - np.int64(row[peak]))
            if width < _NARROW_PX and row[peak] < _WHITE
            else _centroid(row, a, b, level, crossings)
        )
        table[HEIGHT, n] = 2 * np.int64(row[peak]) - level
        table[WIDTH, n], table[TOP, n] = width, row[peak]
        table[PULL, n] = _pull(row, peak, width, table[HEIGHT, n])
        if image.u.shape[0] > 0:
            _measure_chroma(image, x, peak, width, directions, table[:, n])
        n += 1
    return n


@inline_borrowing_kernel
def _next_peak(row: U8Array, start: int, end: int, base: np.int64) -> tuple[int, int]:
    """Return maximum and end of the first peak in [start, end); the next peak begins at its end."""
    peak, valley_at = start, start
    top = np.int64(row[start])
    valley = top
    for v in range(start + 1, end):
        value = np.int64(row[v])
        if value > top:
            if valley_at > start and _separates(valley, top, base):
                return peak, valley_at
            top, peak = value, v
            valley, valley_at = value, v
        elif value < valley:
            valley, valley_at = value, v
        elif valley_at > start and _separates(valley, value, base):
            return peak, valley_at
    return peak, end


@inline_borrowing_kernel
def _separates(valley: np.int64, lower_peak: np.int64, base: np.int64) -> bool:
    """Return whether a valley separates two peaks, of which the lower one is given."""
    # It does below this many tenths of the height of the lower peak.
    valley_tenths = 6
    return bool(10 * (valley - base) < valley_tenths * (lower_peak - base))


@inline_borrowing_kernel
def _feet(row: U8Array, peak: int, low: int, high: int, level: np.int64) -> tuple[int, int]:
    """Return the nearest positions in [low, high] before and after the peak below half height.

    -1 for both if one is missing, or if a pixel higher than the peak lies nearer: the foot is then
    that of another stripe. `level` is twice the half height, as in `_measure_run`.
    """
    top = row[peak]
    a = peak - 1
    while a >= low and 2 * np.int64(row[a]) > level and row[a] <= top:
        a -= 1
    b = peak + 1
    while b <= high and 2 * np.int64(row[b]) > level and row[b] <= top:
        b += 1
    if a < low or b > high or row[a] > top or row[b] > top:
        return -1, -1
    return a, b


@inline_borrowing_kernel
def _crossings(row: U8Array, a: int, b: int, level: np.int64) -> tuple[float, float]:
    """Return where the profile crosses half height, in pixels after `a` and before `b`."""
    below, above = 2 * np.int64(row[a]) - level, 2 * np.int64(row[a + 1]) - level
    rise = -below / (above - below)
    below, above = 2 * np.int64(row[b]) - level, 2 * np.int64(row[b - 1]) - level
    return rise, -below / (above - below)


@inline_borrowing_kernel
def _centroid(
    row: U8Array, a: int, b: int, level: np.int64, crossings: tuple[float, float]
) -> float:
    """Return the centroid of the profile above half height, between its `crossings`.

    The profile is linear between pixels. Sums over whole pixels would pull the centroid of a stripe
    that is two pixels wide to the pixel grid by up to 0.09 px; this one does by 0.01 px.
    """
    total, moment = np.int64(0), np.int64(0)
    for k in range(1, b - a):
        value = 2 * np.int64(row[a + k]) - level
        total += value
        moment += value * k
    # Half of the first and of the last pixel lies outside the polygon; triangles replace them.
    first, last = 2 * np.int64(row[a + 1]) - level, 2 * np.int64(row[b - 1]) - level
    rise, fall = 1.0 - crossings[0], 1.0 - crossings[1]
    end = b - a - 1
    area = total - 0.5 * ((1.0 - rise) * first + (1.0 - fall) * last)
    moments = moment - first * (1.0 / 3.0) - last * (0.5 * end + 1.0 / 6.0)
    moments += 0.5 * (rise * first * (1.0 - rise / 3.0) + fall * last * (end + fall / 3.0))
    return a + moments / area


@inline_borrowing_kernel
def _gaussian_peak(row: U8Array, peak: int, base: np.int64) -> float:
    """Return the peak of a Gaussian through the highest pixel and its two neighbours.

    Source: Fisher and Naidu, "A comparison of algorithms for subpixel peak detection", 1996.
    """
    # A pixel at the background may be half a grey level above it, before rounding.
    before = math.log(max(float(np.int64(row[peak - 1]) - base), 0.5))
    top = math.log(np.int64(row[peak]) - base)
    after = math.log(max(float(np.int64(row[peak + 1]) - base), 0.5))
    return peak + 0.5 * (before - after) / (before - 2.0 * top + after)


@inline_borrowing_kernel
def _pull(row: U8Array, peak: int, width: float, height: float) -> float:
    """Return the shift (px) of the centroid if the flanks differ because of a linear ramp."""
    flank = int(width) + _FLANK_PX
    before, after = max(peak - flank, 0), min(peak + flank, row.shape[0] - 1)
    difference = np.int64(row[after]) - np.int64(row[before])
    if abs(difference) > _OTHER_STRIPE * height:
        return 0.0
    return float(_PULL_OF_RAMP * width * width * difference / ((after - before) * height))


@inline_borrowing_kernel
def flank_difference(pull: float, width: float) -> float:
    """Return the difference between a peak's flanks, over its height, from its pull and width."""
    return 2.0 * (int(width) + _FLANK_PX) * pull / (_PULL_OF_RAMP * width * width)


@inline_borrowing_kernel
def _measure_chroma(
    image: SearchImage,
    x: int,
    peak: int,
    width: float,
    directions: FloatArray,
    measures: FloatArray,
) -> None:
    """Write the difference of chroma between a peak of search line `x` and its flanks.

    The peak's chroma is that of its middle or of an edge, whichever is more of the laser's colour:
    a saturated core is white.
    """
    row, chroma_line = image.lines[x], (x * image.line_px) >> 1
    edge, flank = int(0.5 * width) + 1, int(width) + _FLANK_PX
    before, after = max(peak - flank, 0), min(peak + flank, row.shape[0] - 1)
    u_before, v_before = _chroma(image, chroma_line, before)
    u_after, v_after = _chroma(image, chroma_line, after)
    # If one flank is much brighter, another stripe lies there, and only the darker one counts.
    difference = np.int64(row[before]) - np.int64(row[after])
    weight = 0.5
    if abs(difference) > _OTHER_STRIPE * measures[HEIGHT]:
        weight = 1.0 if difference < 0 else 0.0
    u_flank = weight * u_before + (1.0 - weight) * u_after
    v_flank = weight * v_before + (1.0 - weight) * v_after
    luma = weight * row[before] + (1.0 - weight) * row[after]
    best = -np.inf
    for offset in (0, -edge, edge):
        u, v = _chroma(image, chroma_line, peak + offset)
        u, v = u - u_flank, v - v_flank
        for k in range(directions.shape[0]):
            along_u, along_v = directions[k, 0], directions[k, 1]
            along = along_u * u + along_v * v
            if along > best:
                best = along
                measures[STEP_U], measures[STEP_V] = u, v
                measures[IMBALANCE] = along_u * (u_after - u_before) + along_v * (
                    v_after - v_before
                )
    # Dark flanks have no tint of paint in ambient light, only the line's own glow.
    per_level = 1.0 / luma if luma > _DARK else 0.0
    measures[TINT_U], measures[TINT_V] = (
        (u_flank - 128.0) * per_level,
        (v_flank - 128.0) * per_level,
    )


@inline_borrowing_kernel
def _chroma(image: SearchImage, chroma_line: int, position: int) -> tuple[float, float]:
    """Return U and V at a position of a search line, means over three neighbours along stripes."""
    u, v = image.u, image.v
    n_lines, length = u.shape if image.along_x else (u.shape[1], u.shape[0])
    p = min(max(position >> 1, 0), length - 1)
    total_u, total_v = np.int64(0), np.int64(0)
    for offset in range(-1, 2):
        line = min(max(chroma_line + offset, 0), n_lines - 1)
        y, x = (line, p) if image.along_x else (p, line)
        total_u += np.int64(u[y, x])
        total_v += np.int64(v[y, x])
    return total_u * _THIRD, total_v * _THIRD
