"""Dashes: the pieces of a laser's line that strands light, and the dark gaps between them."""

from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.scanning.net_cut import cut_lines
from aqualvs.scanning.net_lines import LineState, NetSignal
from aqualvs.scanning.net_spectrum import Crossings

# Dark pieces so many times longer than most (this quantile) are holes; a lattice is not looked for
# there.
_HOLE, _MOST = 2.5, 0.8


@dataclass(frozen=True, slots=True)
class Dashes:
    """Lit pieces of the lasers' lines in one frame, N of them.

    Attributes
    ----------
    laser : int array, shape (N,)
        Index of the laser.
    along : array, shape (N,)
        Middle of the dash on the laser's line, in metres.
    place : array, shape (N, 2)
        The same in `net`.
    length : array, shape (N,)
        Length along the line within which its light is above a share of its peak, in metres.
    height, width : array, shape (N,)
        Peak height (grey levels) and, where it is bright, mean width across the search line (m).
    whole : bool array, shape (N,)
        Whether both ends were seen: what is cut off says nothing about length.
    """

    laser: IntArray
    along: FloatArray
    place: FloatArray
    length: FloatArray
    height: FloatArray
    width: FloatArray
    whole: BoolArray

    def __len__(self) -> int:
        """Return the number of dashes."""
        return len(self.laser)


@dataclass(frozen=True, slots=True)
class Gaps:
    """Dark pieces of the lasers' lines in one frame, K of them; ends ascend along the line.

    Attributes
    ----------
    laser : int array, shape (K,)
        Index of the laser.
    ends : array, shape (K, 2)
        On the laser's line, in metres.
    middles : array, shape (K, 2)
        Middles of the dashes at both ends; as `ends` where there is none.
    closed : bool array, shape (K, 2)
        Whether a dash is at that end; else the view ends there.
    beyond : array, shape (K,)
        Share of its search lines whose light is seen on something behind the net.
    """

    laser: IntArray
    ends: FloatArray
    middles: FloatArray
    closed: BoolArray
    beyond: FloatArray

    @property
    def length(self) -> FloatArray:
        """Length in metres, shape (K,)."""
        return np.asarray(self.ends[:, 1] - self.ends[:, 0])


@dataclass(frozen=True, slots=True)
class NetView:
    """What one frame shows of the net, L lasers, without what single search lines said.

    Attributes
    ----------
    index, time_s, range, origin, direction, search, pixel
        As in the `NetSignal`.
    step : array, shape (L,)
        Length of laser line that a search line usually stands for, in metres.
    beyond : array, shape (L,)
        Share of each laser's dark search lines whose light is seen on something behind the net.
    dashes : Dashes
        Lit pieces.
    gaps : Gaps
        Dark pieces.
    span_laser : int array, shape (M,)
        Index of the laser of every span: a piece of line that was seen without interruption.
    span : array, shape (M, 2)
        Its two ends on the laser's line, ascending, in metres.
    """

    index: int
    time_s: float
    range: float
    origin: FloatArray
    direction: FloatArray
    search: FloatArray
    pixel: float
    step: FloatArray
    beyond: FloatArray
    dashes: Dashes
    gaps: Gaps
    span_laser: IntArray
    span: FloatArray

    @property
    def seen_length(self) -> float:
        """Metres of laser line that could be seen."""
        return float(np.sum(self.span[:, 1] - self.span[:, 0]))

    def at(self, laser: IntArray, along: FloatArray) -> FloatArray:
        """Places in `net`, shape (n, 2), of places on lasers' lines, shape (n,) each."""
        return np.asarray(self.origin[laser] + along[:, None] * self.direction[laser])


def find_dashes(signal: NetSignal, usable: BoolArray | None = None) -> NetView:
    """Cut the lasers' lines into dashes and gaps.

    Parameters
    ----------
    signal : NetSignal
        Of one frame.
    usable : bool array, shape (L, J), optional
        Search lines to look at; the others count as hidden.
    """
    state = signal.state if usable is None else np.where(usable, signal.state, LineState.HIDDEN)
    n_lasers, n_lines = state.shape
    most = n_lasers * n_lines
    dash, gap, span = np.empty((most, 6)), np.empty((2 * most, 8)), np.empty((most, 3))
    usual = np.empty((n_lasers, 2))
    n, k, m = cut_lines(
        np.ascontiguousarray(state, np.uint8),
        signal.along,
        signal.step,
        signal.height,
        signal.width,
        signal.beyond,
        dash,
        gap,
        span,
        usual,
    )
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
            middles=gap[:k, 3:5].copy(),
            closed=gap[:k, 5:7] == 1.0,
            beyond=gap[:k, 7].copy(),
        ),
        span_laser=span[:m, 0].astype(np.int64),
        span=span[:m, 1:].copy(),
    )


def crossings_of(view: NetView) -> Crossings:
    """Return a frame's crossings to find the lattice: no dash cut off, nothing like a hole."""
    gaps, dashes = view.gaps, view.dashes
    inner = gaps.length[gaps.closed.all(axis=1)]
    longest = _HOLE * float(np.quantile(inner, _MOST)) if len(inner) else np.inf
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
    """Cut gaps out of spans; laser (n,) and ends (n, 2) of what remains."""
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
