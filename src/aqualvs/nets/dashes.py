"""Dashes: the lit pieces of a laser's line on strands, and the dark gaps between them.

`find_dashes` cuts the lines of one frame into dashes, gaps and spans (pieces of line seen without
interruption).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import inner_kernel, kernel
from aqualvs.nets.lit_intervals import LineState, NetFrame, NetSignal
from aqualvs.nets.spectrum import Crossings


class _DashOptions(NamedTuple):
    """Dashes of light along a stripe, and the gaps between them."""

    # A dark gap of one search line does not end a dash: compression and specks make such gaps. A
    # gap of a few lines does not either, if both its ends are near the greatest brightness on this
    # laser's line and the dash begins fainter: light fades at the edge of a strand, whereas the
    # detector drops a white, overexposed core because it is not laser green.
    bridged: int = 1
    white: int = 3
    unfaded: float = 0.85
    # The length of a dash is measured above this share of its peak, regardless of exposure; its
    # width above the greater share.
    level: float = 0.4
    bright: float = 0.8


_DASH = _DashOptions()


class _LaserLines(NamedTuple):
    """The lasers' lines on a net in one frame, L of them, as in `NetSignal`; `along` ascends."""

    # Shape (L, J).
    state: NDArray[np.uint8]
    along: FloatArray
    step: FloatArray
    height: FloatArray
    width: FloatArray
    beyond: BoolArray


@kernel
def _cut_lines(
    lines: _LaserLines, dash: FloatArray, gap: FloatArray, span: FloatArray, usual: FloatArray
) -> tuple[int, int, int]:
    """Cut the lines into dashes, gaps and spans; return their numbers.

    Written are rows of `dash`, shape (N, 6): laser, whole, middle, length, height, width; of `gap`,
    shape (K, 6): laser, ends, closed, beyond; of `span`, shape (M, 3): laser, ends; and of `usual`,
    shape (L, 2): step, beyond; all as in `NetView`.
    """
    state, n, k, m = lines.state, 0, 0, 0
    n_lasers, n_lines = state.shape
    for i in range(n_lasers):
        steps = lines.step[i][lines.step[i] > 0.0]
        usual[i, 0] = np.median(steps) if len(steps) else 0.0
        n_dark, n_beyond = 0, 0
        begin = 0
        while begin < n_lines:
            end = begin
            while end < n_lines and state[i, end] != 0:
                dark = state[i, end] == 1
                n_dark += dark
                n_beyond += dark and lines.beyond[i, end]
                end += 1
            if end == begin:
                begin += 1
                continue
            span[m, 0] = i
            span[m, 1], span[m, 2] = _ends(lines, i, begin, end - 1)
            n, k = _cut_span(lines, i, begin, end, dash, n, gap, k)
            m += 1
            begin = end
        usual[i, 1] = n_beyond / max(n_dark, 1)
    return n, k, m


@inner_kernel
def _cut_span(
    lines: _LaserLines,
    i: int,
    begin: int,
    end: int,
    dash: FloatArray,
    n: int,
    gap: FloatArray,
    k: int,
) -> tuple[int, int]:
    """Append the dashes and gaps of one span; return the new counts."""
    state, height = lines.state, lines.height
    brightest = height[i].max()
    j, dark_from = begin, begin
    while j < end:
        if state[i, j] != 2:
            j += 1
            continue
        first, last = j, j
        bridged = _DASH.bridged
        if height[i, first] < _DASH.unfaded * brightest:
            bridged = _DASH.white
        while j < end and j - last <= bridged + 1:
            if state[i, j] == 2:
                ends = min(height[i, last], height[i, j])
                if j - last > _DASH.bridged + 1 and ends < _DASH.unfaded * brightest:
                    break
                last = j
            j += 1
        j = last + 1
        peak, wide, n_bright = 0.0, 0.0, 0
        for a in range(first, last + 1):
            peak = max(peak, height[i, a])
        for a in range(first, last + 1):
            if height[i, a] >= _DASH.bright * peak:
                wide += lines.width[i, a]
                n_bright += 1
        length = _length_above(lines, i, first, last, _DASH.level * peak)
        low, high = _ends(lines, i, first, last)
        dash[n, 0], dash[n, 1] = i, 1.0 if first > begin and last < end - 1 else 0.0
        dash[n, 2], dash[n, 3] = 0.5 * (low + high), length
        dash[n, 4], dash[n, 5] = peak, wide / n_bright
        if first > dark_from:
            _put_gap(lines, i, dark_from, first - 1, gap, k, dark_from > begin, True)
            k += 1
        dark_from = last + 1
        n += 1
    if end > dark_from:
        _put_gap(lines, i, dark_from, end - 1, gap, k, dark_from > begin, False)
        k += 1
    return n, k


@inner_kernel
def _length_above(lines: _LaserLines, i: int, first: int, last: int, level: float) -> float:
    """Return the metres of a run of search lines above a level, by linear interpolation.

    Outside the run it is dark; bridged lines are as bright as the one before.
    """
    step, height = lines.step, lines.height
    length, before = 0.0, 0.0
    for a in range(first, last + 1):
        here = height[i, a] if height[i, a] > 0.0 else before
        after = height[i, a + 1] if a < last else 0.0
        if after == 0.0 and a < last:
            after = here
        if here >= level:
            length += step[i, a]
            if before < level:
                length += step[i, a] * ((here - level) / (here - before) - 0.5)
            if after < level:
                length += step[i, a] * ((here - level) / (here - after) - 0.5)
        before = here
    return length


@inner_kernel
def _put_gap(
    lines: _LaserLines,
    i: int,
    first: int,
    last: int,
    gap: FloatArray,
    k: int,
    before: bool,
    behind: bool,
) -> None:
    """Write gap k, and whether there are dashes before and behind it; else the span ends there."""
    seen = 0
    for a in range(first, last + 1):
        seen += lines.beyond[i, a]
    gap[k, 0] = i
    gap[k, 1], gap[k, 2] = _ends(lines, i, first, last)
    gap[k, 3], gap[k, 4] = before, behind
    gap[k, 5] = seen / (last - first + 1)


@inner_kernel
def _ends(lines: _LaserLines, i: int, first: int, last: int) -> tuple[float, float]:
    """Return both ends of a run of search lines on the laser's line, ascending."""
    along, step = lines.along, lines.step
    return along[i, first] - 0.5 * step[i, first], along[i, last] + 0.5 * step[i, last]


@dataclass(frozen=True, slots=True)
class Dashes:
    """Lit pieces of the lasers' lines in one frame, N of them."""

    laser: IntArray  # Shape (N,): index of the laser.
    along: FloatArray  # Shape (N,): middle of the dash on the laser's line, in metres.
    place: FloatArray  # Shape (N, 2): the same in `net`.
    # Shape (N,): length along the line within which its light is above a share of its peak, in
    # metres.
    length: FloatArray
    # Shape (N,): peak height (grey levels) and, where it is bright, mean width across the search
    # line (m).
    height: FloatArray
    width: FloatArray
    # Shape (N,): whether both ends were seen: the length of a cut-off dash is not known.
    whole: BoolArray

    def __len__(self) -> int:
        """Return the number of dashes."""
        return len(self.laser)


@dataclass(frozen=True, slots=True)
class Gaps:
    """Dark pieces of the lasers' lines in one frame, K of them; ends ascend along the line."""

    laser: IntArray  # Shape (K,): index of the laser.
    ends: FloatArray  # Shape (K, 2): on the laser's line, in metres.
    # Shape (K, 2): whether a dash ends the gap there; otherwise the view ends.
    closed: BoolArray
    # Shape (K,): share of its search lines whose light is seen on something behind the net.
    beyond: FloatArray

    @property
    def length(self) -> FloatArray:
        """Length in metres, shape (K,)."""
        return np.asarray(self.ends[:, 1] - self.ends[:, 0])


@dataclass(frozen=True, slots=True)
class NetView(NetFrame):
    """Dashes and gaps of the net in one frame; a summary of the `NetSignal`."""

    # Shape (L,): typical length of laser line per search line, in metres.
    step: FloatArray
    # Shape (L,): share of each laser's dark search lines whose light is seen on something behind
    # the net.
    beyond: FloatArray
    # Lit pieces.
    dashes: Dashes
    # Dark pieces.
    gaps: Gaps
    # Shape (M,): index of the laser of every span: a piece of line that was seen without
    # interruption.
    span_laser: IntArray
    # Shape (M, 2): its two ends on the laser's line, ascending, in metres.
    span: FloatArray

    @property
    def seen_length(self) -> float:
        """Visible length of laser line, in metres."""
        return float(np.sum(self.span[:, 1] - self.span[:, 0]))

    def at(self, laser: IntArray, along: FloatArray) -> FloatArray:
        """Return the places in `net`, shape (n, 2), of places on lasers' lines, shape (n,) each."""
        return np.asarray(self.origin[laser] + along[:, None] * self.direction[laser])


def find_dashes(signal: NetSignal, usable: BoolArray | None = None) -> NetView:
    """Cut the lasers' lines in one frame into dashes and gaps.

    `usable`, shape (L, J): search lines to use; the others count as hidden.
    """
    state = signal.state
    if usable is not None:
        state = np.where(usable, state, LineState.HIDDEN).astype(np.uint8)
    n_lasers, n_lines = state.shape
    most = n_lasers * n_lines
    dash, gap, span = np.empty((most, 6)), np.empty((2 * most, 6)), np.empty((most, 3))
    usual = np.empty((n_lasers, 2))
    columns = (state, signal.along, signal.step, signal.height, signal.width, signal.beyond)
    back = _descends(signal.along)[:, None]
    lines = _LaserLines(*(np.where(back, column[:, ::-1], column) for column in columns))
    n, k, m = _cut_lines(lines, dash, gap, span, usual)
    laser, along = dash[:n, 0].astype(np.int64), dash[:n, 2].copy()
    return NetView(
        index=signal.index,
        time_s=signal.time_s,
        range=signal.range,
        origin=signal.origin,
        direction=signal.direction,
        search=signal.search,
        pixel=signal.pixel,
        step=np.where(usual[:, 0] > 0.0, usual[:, 0], signal.pixel),
        beyond=usual[:, 1],
        dashes=Dashes(
            laser=laser,
            along=along,
            place=signal.origin[laser] + along[:, None] * signal.direction[laser],
            length=dash[:n, 3].copy(),
            height=dash[:n, 4].copy(),
            width=dash[:n, 5].copy(),
            whole=dash[:n, 1] == 1.0,
        ),
        gaps=Gaps(
            laser=gap[:k, 0].astype(np.int64),
            ends=gap[:k, 1:3].copy(),
            closed=gap[:k, 3:5] == 1.0,
            beyond=gap[:k, 5].copy(),
        ),
        span_laser=span[:m, 0].astype(np.int64),
        span=span[:m, 1:].copy(),
    )


def _descends(along: FloatArray) -> BoolArray:
    """Return whether the places on each laser's line (L, J) fall with the search lines, (L,)."""
    known = [places[np.isfinite(places)] for places in along]
    return np.array([len(one) > 0 and one[-1] < one[0] for one in known], np.bool_)


def crossings_of(view: NetView) -> Crossings:
    """Return crossings for the lattice search, without cut-off dashes and likely holes."""
    gaps, dashes = view.gaps, view.dashes
    inner = gaps.length[gaps.closed.all(axis=1)]
    # Dark pieces this many times longer than this quantile may be holes, and are left out of the
    # search for a lattice.
    hole, most = 2.5, 0.8
    longest = hole * float(np.quantile(inner, most)) if len(inner) else np.inf
    long = gaps.length > longest
    laser, ends = _without(view.span_laser, view.span, gaps.laser[long], gaps.ends[long])
    seen = np.zeros(len(view.direction))
    np.add.at(seen, laser, ends[:, 1] - ends[:, 0])
    return Crossings(
        place=dashes.place[dashes.whole],
        laser=dashes.laser[dashes.whole],
        begin=view.at(laser, ends[:, 0]),
        end=view.at(laser, ends[:, 1]),
        span_laser=laser,
        direction=view.direction,
        length=seen,
        lit=float(np.sum(dashes.length)) / max(float(seen.sum()), 1e-9),
    )


def _without(
    laser: IntArray, span: FloatArray, gap_laser: IntArray, gap: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Cut gaps out of spans; return laser (n,) and ends (n, 2) of the remainder."""
    if not len(gap):
        return laser, span
    kept: list[tuple[int, float, float]] = []
    for i, (first, last) in zip(laser, span, strict=True):
        at = float(first)
        for low, high in gap[(gap_laser == i) & (gap[:, 0] >= first) & (gap[:, 1] <= last)]:
            kept.append((i, at, float(low)))
            at = float(high)
        kept.append((i, at, float(last)))
    table = np.array([one for one in kept if one[2] > one[1]], np.float64).reshape(-1, 3)
    return table[:, 0].astype(np.int64), table[:, 1:]
