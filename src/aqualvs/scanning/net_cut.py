"""Cutting the lasers' lines into dashes, gaps and spans."""

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import kernel

# A dark gap of one search line does not end a dash: compression and specks make such gaps. Nor does
# one of a few lines between two that are as bright as it gets on this laser's line, where the dash
# begins fainter: light fades at the edge of a strand; a white, overexposed core is not laser green.
_BRIDGED, _WHITE, _UNFADED = 1, 3, 0.85
# A dash is as long as its light stands above this share of its peak, whatever the exposure; above
# the greater one it is as wide as it gets.
_LEVEL, _BRIGHT = 0.4, 0.8


@kernel
def cut_lines(
    state: IntArray,
    along: FloatArray,
    step: FloatArray,
    height: FloatArray,
    width: FloatArray,
    beyond: BoolArray,
    dash: FloatArray,
    gap: FloatArray,
    span: FloatArray,
    usual: FloatArray,
) -> tuple[int, int, int]:
    """Write what the lines are cut into; the numbers of dashes, gaps and spans.

    Parameters
    ----------
    state : uint8 array, shape (L, J)
        `LineState` values.
    along, step, height, width, beyond : arrays, shape (L, J)
        As in `NetSignal`.
    dash : array, shape (N, 6)
        Rows laser, whole, middle, length, height, width as in `Dashes`; written.
    gap : array, shape (K, 8)
        Rows laser, ends, middles, closed, beyond as in `Gaps`; written.
    span : array, shape (M, 3)
        Rows laser, ends as in `NetView`; written.
    usual : array, shape (L, 2)
        `step` and `beyond` as in `NetView`; written.
    """
    n_lasers, n_lines = state.shape
    n, k, m = 0, 0, 0
    for i in range(n_lasers):
        steps = step[i][step[i] > 0.0]
        usual[i, 0] = np.median(steps) if len(steps) else 0.0
        n_dark, n_beyond = 0, 0
        # Gaps and dashes ascend along the line, whichever way the search lines run.
        back = _descends(along[i])
        begin = 0
        while begin < n_lines:
            end = begin
            while end < n_lines and state[i, _turned(end, n_lines, back)] != 0:
                j = _turned(end, n_lines, back)
                dark = state[i, j] == 1
                n_dark += dark
                n_beyond += dark and beyond[i, j]
                end += 1
            if end == begin:
                begin += 1
                continue
            span[m, 0] = i
            span[m, 1], span[m, 2] = _ends(i, begin, end - 1, back, along, step)
            n, k = _cut_span(
                i, begin, end, back, state, along, step, height, width, beyond, dash, n, gap, k
            )
            m += 1
            begin = end
        usual[i, 1] = n_beyond / max(n_dark, 1)
    return n, k, m


@kernel
def _cut_span(
    i: int,
    begin: int,
    end: int,
    back: bool,
    state: IntArray,
    along: FloatArray,
    step: FloatArray,
    height: FloatArray,
    width: FloatArray,
    beyond: BoolArray,
    dash: FloatArray,
    n: int,
    gap: FloatArray,
    k: int,
) -> tuple[int, int]:
    """Append the dashes and gaps of one span; the new counts."""
    n_lines = state.shape[1]
    brightest = height[i].max()
    j, dark_from, before = begin, begin, -1
    while j < end:
        if state[i, _turned(j, n_lines, back)] != 2:
            j += 1
            continue
        first, last = j, j
        bridged = _BRIDGED
        if height[i, _turned(first, n_lines, back)] < _UNFADED * brightest:
            bridged = _WHITE
        while j < end and j - last <= bridged + 1:
            b = _turned(j, n_lines, back)
            if state[i, b] == 2:
                ends = min(height[i, _turned(last, n_lines, back)], height[i, b])
                if j - last > _BRIDGED + 1 and ends < _UNFADED * brightest:
                    break
                last = j
            j += 1
        j = last + 1
        peak, wide, n_bright = 0.0, 0.0, 0
        for a in range(first, last + 1):
            peak = max(peak, height[i, _turned(a, n_lines, back)])
        for a in range(first, last + 1):
            b = _turned(a, n_lines, back)
            if height[i, b] >= _BRIGHT * peak:
                wide += width[i, b]
                n_bright += 1
        length = _length_above(i, first, last, back, _LEVEL * peak, step, height)
        low, high = _ends(i, first, last, back, along, step)
        dash[n, 0], dash[n, 1] = i, 1.0 if first > begin and last < end - 1 else 0.0
        dash[n, 2], dash[n, 3] = 0.5 * (low + high), length
        dash[n, 4], dash[n, 5] = peak, wide / n_bright
        if first > dark_from:
            _put_gap(i, dark_from, first - 1, back, along, step, beyond, gap, k, dash, before, n)
            k += 1
        dark_from, before = last + 1, n
        n += 1
    if end > dark_from:
        _put_gap(i, dark_from, end - 1, back, along, step, beyond, gap, k, dash, before, -1)
        k += 1
    return n, k


@kernel
def _length_above(
    i: int, first: int, last: int, back: bool, level: float, step: FloatArray, height: FloatArray
) -> float:
    """Metres of a run of search lines above a level; heights change evenly, beyond it is dark.

    Bridged lines are as bright as the one before.
    """
    n_lines = step.shape[1]
    length, before = 0.0, 0.0
    for a in range(first, last + 1):
        b = _turned(a, n_lines, back)
        here = height[i, b] if height[i, b] > 0.0 else before
        after = height[i, _turned(a + 1, n_lines, back)] if a < last else 0.0
        if after == 0.0 and a < last:
            after = here
        if here >= level:
            length += step[i, b]
            if before < level:
                length += step[i, b] * ((here - level) / (here - before) - 0.5)
            if after < level:
                length += step[i, b] * ((here - level) / (here - after) - 0.5)
        before = here
    return length


@kernel
def _put_gap(
    i: int,
    first: int,
    last: int,
    back: bool,
    along: FloatArray,
    step: FloatArray,
    beyond: BoolArray,
    gap: FloatArray,
    k: int,
    dash: FloatArray,
    before: int,
    behind: int,
) -> None:
    """Write gap k between two dashes by their rows; -1 where the span ends."""
    seen = 0
    for a in range(first, last + 1):
        seen += beyond[i, _turned(a, along.shape[1], back)]
    gap[k, 0] = i
    gap[k, 1], gap[k, 2] = _ends(i, first, last, back, along, step)
    gap[k, 3] = dash[before, 2] if before >= 0 else gap[k, 1]
    gap[k, 4] = dash[behind, 2] if behind >= 0 else gap[k, 2]
    gap[k, 5], gap[k, 6] = 1.0 if before >= 0 else 0.0, 1.0 if behind >= 0 else 0.0
    gap[k, 7] = seen / (last - first + 1)


@kernel
def _ends(
    i: int, first: int, last: int, back: bool, along: FloatArray, step: FloatArray
) -> tuple[float, float]:
    """Both ends of a run of search lines on the laser's line, ascending."""
    a, b = _turned(first, along.shape[1], back), _turned(last, along.shape[1], back)
    return along[i, a] - 0.5 * step[i, a], along[i, b] + 0.5 * step[i, b]


@kernel
def _turned(j: int, n: int, back: bool) -> int:
    return n - 1 - j if back else j


@kernel
def _descends(along: FloatArray) -> bool:
    first, last = np.nan, np.nan
    for value in along:
        if np.isfinite(value):
            if not np.isfinite(first):
                first = value
            last = value
    return bool(last < first)
