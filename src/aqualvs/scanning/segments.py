"""Segments: returns of neighbouring search lines that follow one another.

A stripe on a wall makes segments of hundreds of returns, a strand of a net one of a few. A long
segment that runs in a direction in which its laser's stripe cannot run belongs to another laser;
a short one says nothing by its direction, because it follows the strand, not the stripe. Segments
that go on where another ends, or meet there, make a stretch: one strand with its knots.
"""

from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import kernel
from aqualvs.scanning.search import SLOPE_CELL, StripeSearch
from aqualvs.scanning.stripe import Returns

CHUNK_LINES = 16
"""A long segment is cut into chunks of at most this many returns."""

# A gap of one search line does not end a segment: H.264 and specks make such gaps.
_MAX_LINE_STEP = 2
_LINK_GATE_PX = 2.0
# Segments shorter than this follow the strand; longer ones must follow the stripe.
_LONG_SEGMENT = 24
# A segment that begins this near to another one's end belongs to the same stretch.
_JOIN_LINES = 4
_JOIN_PX = 4.0
# Direction of a measured segment against the bounds for a plane target; covers curvature.
_SLOPE_MARGIN = 0.15


@dataclass(frozen=True, slots=True)
class Segments:
    """Returns of one laser's search, grouped.

    Attributes
    ----------
    order : int array, shape (N,)
        Indices into the `Returns`, segment by segment, along each segment.
    stretch : int array, shape (N,)
        Number of the stretch that the segment belongs to, in the order of `order`.
    chunk : int array, shape (N,)
        Number of the chunk, likewise; a segment's chunks are consecutive. A short segment, such as
        the light on one strand of a net, is one chunk.
    """

    order: IntArray
    stretch: IntArray
    chunk: IntArray


def link_segments(returns: Returns, search: StripeSearch) -> Segments:
    """Group the returns inside a laser's band; segments of another laser's direction are dropped.

    Parameters
    ----------
    returns : Returns
        Of the search direction of `search`.
    search : StripeSearch
        Band and slopes of the laser.

    Returns
    -------
    Segments
    """
    numbers = np.empty((3, len(returns)), np.int64)
    n = _segment(
        returns.line,
        returns.position,
        search.lowest,
        search.highest,
        search.slope_low,
        search.slope_high,
        numbers,
    )
    order, stretch, chunk = numbers[:, :n]
    return Segments(order, stretch, chunk)


@kernel
def _link(
    line: IntArray,
    position: FloatArray,
    lowest: IntArray,
    highest: IntArray,
    segment_of: IntArray,
) -> int:
    """Give each return the segment that it continues, or a new one; -1 outside the band."""
    n = line.shape[0]
    last_line = np.empty(n, np.int64)
    last_position = np.empty(n)
    slope = np.zeros(n)
    count = np.zeros(n, np.int64)
    alive = np.empty(n, np.int64)
    n_alive = 0
    n_segments = 0
    for i in range(n):
        x = line[i]
        segment_of[i] = -1
        if position[i] < lowest[x] or position[i] > highest[x]:
            continue
        kept = 0
        best = -1
        best_miss = _LINK_GATE_PX
        for k in range(n_alive):
            s = alive[k]
            step = x - last_line[s]
            if step > _MAX_LINE_STEP:
                continue
            alive[kept] = s
            kept += 1
            if step == 0:
                continue
            miss = abs(position[i] - last_position[s] - slope[s] * step)
            if miss < best_miss:
                best, best_miss = s, miss
        n_alive = kept
        if best < 0:
            best = n_segments
            n_segments += 1
            alive[n_alive] = best
            n_alive += 1
        else:
            step = x - last_line[best]
            seen = (position[i] - last_position[best]) / step
            gain = max(1.0 / count[best], 0.15)
            slope[best] += gain * (seen - slope[best])
        last_line[best] = x
        last_position[best] = position[i]
        count[best] += 1
        segment_of[i] = best
    return n_segments


@kernel
def _group(
    line: IntArray,
    position: FloatArray,
    segment_of: IntArray,
    slope_low: FloatArray,
    slope_high: FloatArray,
    start: IntArray,
    order: IntArray,
    segment: IntArray,
    chunk: IntArray,
) -> int:
    """Sort by segment, counting, and keep the segments whose direction is possible."""
    n_segments = start.shape[0] - 1
    for i in range(segment_of.shape[0]):
        if segment_of[i] >= 0:
            start[segment_of[i] + 1] += 1
    for s in range(n_segments):
        start[s + 1] += start[s]
    grouped = np.empty(start[n_segments], np.int64)
    fill = start[:-1].copy()
    for i in range(segment_of.shape[0]):
        s = segment_of[i]
        if s >= 0:
            grouped[fill[s]] = i
            fill[s] += 1
    n = 0
    n_chunks = 0
    n_kept_segments = 0
    for s in range(n_segments):
        members = grouped[start[s] : start[s + 1]]
        if not _direction_possible(line, position, members, slope_low, slope_high):
            continue
        n_pieces = 1
        if members.shape[0] >= _LONG_SEGMENT:
            n_pieces = (members.shape[0] + CHUNK_LINES - 1) // CHUNK_LINES
        for k in range(members.shape[0]):
            order[n] = members[k]
            segment[n] = n_kept_segments
            chunk[n] = n_chunks + k * n_pieces // members.shape[0]
            n += 1
        n_chunks += n_pieces
        n_kept_segments += 1
    return n


@kernel
def _direction_possible(
    line: IntArray,
    position: FloatArray,
    members: IntArray,
    slope_low: FloatArray,
    slope_high: FloatArray,
) -> bool:
    """Whether a segment runs as its laser's stripe can; always so for a short one."""
    n = members.shape[0]
    if n < _LONG_SEGMENT:
        return True
    mean_line = 0.0
    mean_position = 0.0
    for k in range(n):
        mean_line += line[members[k]]
        mean_position += position[members[k]]
    mean_line /= n
    mean_position /= n
    spread = 0.0
    product = 0.0
    for k in range(n):
        offset = line[members[k]] - mean_line
        spread += offset * offset
        product += offset * (position[members[k]] - mean_position)
    slope = product / spread
    row = int(mean_position) // SLOPE_CELL
    column = int(mean_line) // SLOPE_CELL
    low = slope_low[row, column] - _SLOPE_MARGIN
    high = slope_high[row, column] + _SLOPE_MARGIN
    return bool(low <= slope <= high)


@kernel
def _join(
    line: IntArray, position: FloatArray, order: IntArray, segment: IntArray, stretch: IntArray
) -> None:
    """Give one number to segments whose ends meet, transitively."""
    n = order.shape[0]
    n_segments = segment[n - 1] + 1 if n else 0
    first = np.empty(n_segments, np.int64)
    last = np.empty(n_segments, np.int64)
    for k in range(n):
        if k == 0 or segment[k] != segment[k - 1]:
            first[segment[k]] = order[k]
        last[segment[k]] = order[k]
    root = np.arange(n_segments)
    for a in range(n_segments):
        for b in range(n_segments):
            step = line[first[b]] - line[last[a]]
            if (
                a != b
                and abs(step) <= _JOIN_LINES
                and abs(position[first[b]] - position[last[a]]) <= _JOIN_PX
            ):
                low, high = min(root[a], root[b]), max(root[a], root[b])
                for c in range(n_segments):
                    if root[c] == high:
                        root[c] = low
    for k in range(n):
        stretch[k] = root[segment[k]]


@kernel
def _segment(
    line: IntArray,
    position: FloatArray,
    lowest: IntArray,
    highest: IntArray,
    slope_low: FloatArray,
    slope_high: FloatArray,
    numbers: IntArray,
) -> int:
    """Write (order, stretch, chunk) of the kept returns; returns how many they are."""
    n = line.shape[0]
    segment_of, segment = np.empty(n, np.int64), np.empty(n, np.int64)
    n_segments = _link(line, position, lowest, highest, segment_of)
    order, stretch, chunk = numbers[0], numbers[1], numbers[2]
    start = np.zeros(n_segments + 1, np.int64)
    n_kept = _group(line, position, segment_of, slope_low, slope_high, start, order, segment, chunk)
    _join(line, position, order[:n_kept], segment[:n_kept], stretch)
    return n_kept
