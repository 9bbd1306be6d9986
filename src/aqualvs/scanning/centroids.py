"""Sub-pixel returns from runs: how many peaks a run has, where each lies, and how green it is.

Of thousands of runs in a frame most are noise. Each costs little, because what decides over it is
read from the marks of 64 pixels at once, without a loop whose end no processor can foresee.
"""

import numpy as np

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel
from aqualvs.scanning.lanes import (
    LANES,
    U8Array,
    first_mark,
    highest_of,
    last_mark,
    marks_at_least,
    marks_in_valleys,
    marks_where_falling,
    marks_where_rising,
)

# A valley below this many tenths of the lower of two peaks separates two returns.
_VALLEY_TENTHS = 6
_NOTHING, _ALL, _ONE = np.uint64(0), np.uint64(0xFFFFFFFFFFFFFFFF), np.uint64(1)
_HIGHEST = np.uint8(255)
_NOT_FOUND = -1
_FEW = 16

BATCH = 256
"""Peaks that are looked at together: they stay in the nearest cache."""


@inline_borrowing_kernel
def _next_peak(line: U8Array, start: int, last: int, base: np.int64) -> tuple[int, int]:
    """Return (peak, end) of the first return in [start, last]; the next one begins at `end`.

    `base` is the background: a valley between two returns is shallow or deep against it.
    """
    peak = start
    top = np.int64(line[start])
    valley_at = start
    valley = top
    for v in range(start + 1, last + 1):
        value = np.int64(line[v])
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
def _only_peak(lines: U8Array, at: int, size: int, base: np.uint8) -> int:
    """Return the highest of `size` bytes, the first of them, counted from the first.

    `_NOT_FOUND` where a valley may separate two returns, or they are more than `LANES`.
    """
    if size > LANES:
        return _NOT_FOUND
    run = _ALL >> np.uint64(LANES - size)
    top = highest_of(lines, at, run)
    peak = first_mark(marks_at_least(lines, at, top) & run)
    before = (_ONE << np.uint64(peak)) - _ONE
    steps = run >> _ONE
    wrong = (marks_where_falling(lines, at) & before) | (marks_where_rising(lines, at) & ~before)
    # Most runs rise to their peak and fall from it.
    if wrong & steps == _NOTHING:
        return peak
    valleys = marks_in_valleys(lines, at, run, base, np.uint16(_VALLEY_TENTHS))
    return peak if valleys == _NOTHING else _NOT_FOUND


@inline_borrowing_kernel
def _foot_before(
    lines: U8Array, row: int, peak: int, low: int, half: np.uint8, top: np.uint8
) -> int:
    """Return the nearest position before the peak, down to `low`, that is lower than `half`.

    `_NOT_FOUND` where there is none, or something higher than the peak lies nearer: then this is
    the foot of another stripe.
    """
    at = peak - LANES
    outside = ~marks_at_least(lines, row + at, half)
    higher = _marks_above(lines, row + at, top)
    while outside == _NOTHING and higher == _NOTHING and at > low:
        at -= LANES
        outside = ~marks_at_least(lines, row + at, half)
        higher = _marks_above(lines, row + at, top)
    foot = at + last_mark(outside)
    # Of the two marks the foot is the nearer, where it is the greater number.
    return foot if (outside > higher) & (foot >= low) else _NOT_FOUND


@inline_borrowing_kernel
def _foot_after(
    lines: U8Array, row: int, peak: int, high: int, half: np.uint8, top: np.uint8
) -> int:
    """Return the nearest position after the peak, up to `high`; see `_foot_before`."""
    at = peak + 1
    outside = ~marks_at_least(lines, row + at, half)
    higher = _marks_above(lines, row + at, top)
    while outside == _NOTHING and higher == _NOTHING and at + LANES <= high:
        at += LANES
        outside = ~marks_at_least(lines, row + at, half)
        higher = _marks_above(lines, row + at, top)
    foot = at + first_mark(outside)
    nearer = first_mark(outside) < first_mark(higher)
    return foot if nearer & (foot <= high) else _NOT_FOUND


@inline_borrowing_kernel
def _marks_above(lines: U8Array, at: int, level: np.uint8) -> np.uint64:
    above = marks_at_least(lines, at, np.uint8(level + np.uint8(1)))
    return above if level < _HIGHEST else _NOTHING


@inline_borrowing_kernel
def _moments(line: U8Array, a: int, b: int) -> tuple[np.int64, np.int64]:
    """Return the sum of the values between `a` and `b`, and of each times its way from `a`."""
    total, moment = np.int32(0), np.int32(0)
    n = np.int32(b - a)
    if n <= _FEW:
        # All stripes but the widest: always as many, so that no end has to be foreseen.
        for k in range(_FEW):
            value = np.int32(line[a + k])
            value = value if (k > 0) & (k < n) else np.int32(0)
            total += value
            moment += value * np.int32(k)
    else:
        for k in range(1, n):
            total += np.int32(line[a + k])
            moment += np.int32(line[a + k]) * np.int32(k)
    return np.int64(total), np.int64(moment)


@inline_borrowing_kernel
def _find_peaks(
    lines: U8Array,
    length: int,
    background: U8Array,
    runs: IntArray,
    first: int,
    reach_px: int,
    peaks: IntArray,
) -> tuple[int, int]:
    """Write the peaks with both feet in the runs from `first` on; return how many, and up to where.

    Ends after the run with which there are `BATCH` of them.

    A peak is its line, its position, those of its feet, and the grey level, doubled, that is half
    as high: above it lies what counts.
    """
    n, i = 0, first
    pitch = lines.shape[1]
    while i < runs.shape[0] and n < BATCH:
        x, start, last = runs[i, 0], runs[i, 1], runs[i, 2]
        i += 1
        own, ground = lines[x], background[x]
        low = max(start - reach_px, 0)
        # Beyond the run the profile may still be falling towards half height.
        high = min(last + reach_px, length - 1)
        base = ground[start >> 3]
        peak = _only_peak(lines, x * pitch + start, last - start + 1, base)
        if peak != _NOT_FOUND:
            n = _append(lines, x, start + peak, ground, low, high, peaks, n)
            continue
        while start <= last:
            peak, start = _next_peak(own, start, last, np.int64(base))
            n = _append(lines, x, peak, ground, low, high if start > last else start, peaks, n)
            low = start
    return n, i


@inline_borrowing_kernel
def _append(
    lines: U8Array,
    x: int,
    peak: int,
    ground: U8Array,
    low: int,
    high: int,
    peaks: IntArray,
    n: int,
) -> int:
    """Append a peak if it has feet between two positions; the new number of peaks."""
    row = x * lines.shape[1]
    top = lines[x, peak]
    # Twice the grey levels keep half a level a whole number.
    level = np.int64(top) + np.int64(ground[peak >> 3])
    half = np.uint8((level >> 1) + 1)
    a = _foot_before(lines, row, peak, low, half, top)
    b = _foot_after(lines, row, peak, high, half, top)
    peaks[n, 0], peaks[n, 1], peaks[n, 2], peaks[n, 3], peaks[n, 4] = x, peak, a, b, level
    # The next one is written over it where it has none: cheaper than a choice.
    return n + ((a >= 0) & (b >= 0))


@inline_borrowing_kernel
def _width(line: U8Array, a: int, b: int, level: np.int64) -> float:
    """Return the full width at half height."""
    below, above = 2 * np.int64(line[a]) - level, 2 * np.int64(line[a + 1]) - level
    rise = -below / (above - below)
    below, above = 2 * np.int64(line[b]) - level, 2 * np.int64(line[b - 1]) - level
    fall = -below / (above - below)
    return b - ((a + rise) + fall)


@inline_borrowing_kernel
def _green_fall(green: U8Array, last: int, peak: int, width: float) -> float:
    """Fall of U against both flanks, where it is deepest: a saturated core is white, not green."""
    edge = int(0.5 * width) + 1
    flank = int(width) + 4
    here = max(
        green[peak >> 1],
        green[max(peak - edge, 0) >> 1],
        green[min((peak + edge) >> 1, last)],
    )
    before = np.int64(green[max(peak - flank, 0) >> 1])
    after = np.int64(green[min((peak + flank) >> 1, last)])
    return np.int64(here) - 0.5 * (before + after)


@inline_borrowing_kernel
def _centre(line: U8Array, peak: int, a: int, b: int, level: np.int64) -> float:
    """Return the centroid of what stands above half height, between the feet."""
    light, moment = _moments(line, a, b)
    inside = b - a - 1
    total = 2 * light - inside * level
    moment = 2 * moment - (inside * (b - a) >> 1) * level
    return peak + (moment - (peak - a) * total) / total


@borrowing_kernel
def measure_runs(
    lines: U8Array,
    length: int,
    background: U8Array,
    green: U8Array,
    runs: IntArray,
    reach_px: int,
    min_green_fall: float,
    peaks: IntArray,
    line: IntArray,
    measures: FloatArray,
) -> int:
    """Measure the returns in runs.

    Parameters
    ----------
    lines : uint8 array, shape (n_lines, whole lanes)
        Search lines, allocated with `margined`.
    length : int
        Positions on a line.
    background : uint8 array, shape (n_lines, lanes / BLOCK or more)
        Of the lines.
    green : uint8 array, shape (n_lines / 2, whole lanes)
        At half the size; empty for a grey source.
    runs : int array, shape (N, 3)
        (line, first, last).
    reach_px : int
        Wider returns are left out.
    min_green_fall : float
        Returns that are less green than their flanks by less are left out.
    peaks : int array, shape (BATCH + length, 5)
        Scratch.
    line : int array, shape (capacity,)
        Written: the search line of each return.
    measures : array, shape (4, capacity)
        Written: position, height, width, fall of green.

    Returns
    -------
    int
        Number of returns.
    """
    n = 0
    seen = 0
    while seen < runs.shape[0]:
        n_peaks, seen = _find_peaks(lines, length, background, runs, seen, reach_px, peaks)
        before = n
        for k in range(n_peaks):
            if n == line.shape[0]:
                break
            x, peak, a, b, level = peaks[k, 0], peaks[k, 1], peaks[k, 2], peaks[k, 3], peaks[k, 4]
            own = lines[x]
            width = _width(own, a, b, level)
            green_fall = np.nan
            if green.shape[0] > 0:
                green_fall = _green_fall(green[x >> 1], (length - 1) >> 1, peak, width)
            line[n] = x
            measures[1, n] = 2 * np.int64(own[peak]) - level
            measures[2, n] = width
            measures[3, n] = green_fall
            for i in range(5):
                peaks[n - before, i] = peaks[k, i]
            n += (width <= reach_px) & (not green_fall < min_green_fall)
        for k in range(n - before):
            measures[0, before + k] = _centre(
                lines[peaks[k, 0]], peaks[k, 1], peaks[k, 2], peaks[k, 3], peaks[k, 4]
            )
    return n
