"""Segments: linked stripe peaks on neighbouring search lines, and the shapes of their components.

A stripe on a wall makes segments of hundreds of peaks, a strand of a net one of a few. A long
segment whose direction is impossible for its laser's stripe belongs to another laser; the direction
of a short one carries no information, because it follows the strand, not the stripe. Segments whose
ends meet form a connected component, such as a strand with its knots.

`ComponentShapes` describes components: straight, bent smoothly, or as high as they are wide. The
flank of a fish bends the stripe in one smooth sweep; a face of a box keeps it straight, and its
edge breaks it; a bubble is a spot.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import (
    ZERO,
    inline_borrowing_kernel,
    inner_borrowing_kernel,
    inner_kernel,
    lazy_kernel,
)
from aqualvs.geometry.linear_algebra import n_bins, solve_symmetric
from aqualvs.scanning.laser_bands import SLOPE_CELL, BandLines, LaserBand
from aqualvs.scanning.stripe import StripePeaks

# Least sagitta of a bend, in pixels; errors of the lens are smaller.
_MIN_SAGITTA_PX = 1.0
CURVED_PX = 2.0
"""Sagitta, in pixels, that lies beyond the gate for planes."""
# Least number of search lines of a component with a distinctive shape; the light on a strand is
# shorter.
_MIN_LINES = 16
# A spot: limits of length over width, least number of search lines, largest length in metres, and
# least height as a share of that of the frame's bright peaks, because bubbles glint.
_ROUND_FROM, _ROUND_TO = 0.5, 2.6
_SPOT_LINES = 4
_LARGEST_SPOT = 0.012
_GLINT_SHARE = 0.75
# Columns of the sums over a component: powers 0 to 4 of the place along its chord (0 to 4), three
# moments of the offset beside it (5 to 7), and the offset squared.
_MOMENTS, _SQUARES, _N_SUMS = 5, 8, 9


class ComponentShapes(NamedTuple):
    """Shapes of components (connected segments), one row for each component number."""

    n_lines: FloatArray  # Shape (S,): search lines in it.
    # Shape (S,): height of a parabola over the component's chord, as a shift of the stripe; 0 if
    # the component is too short to have a shape.
    sagitta_px: FloatArray
    # Shape (S,): root mean square of the residuals of the parabola, likewise.
    rough_px: FloatArray
    # Shape (S,): length of the chord in metres.
    size: FloatArray
    # Shape (S,): mean width of its peaks in pixels.
    thickness: FloatArray
    # Shape (S,): mean height of its peaks in grey levels.
    height: FloatArray


@inline_borrowing_kernel
def is_bent(shapes: ComponentShapes, s: int) -> bool:
    """Return whether component s is bent smoothly, as the flank of a fish."""
    sagitta_px = shapes.sagitta_px[s]
    # Largest residual of a smooth bend: a floor, and a share of its sagitta. A corner leaves more.
    rough_px = 0.3
    rough_share = 0.05
    smooth = shapes.rough_px[s] < rough_px + rough_share * sagitta_px
    bent = sagitta_px > _MIN_SAGITTA_PX and smooth
    return bool(shapes.n_lines[s] >= _MIN_LINES and bent)


@inline_borrowing_kernel
def is_curved(shapes: ComponentShapes, s: int) -> bool:
    """Return whether component s is not straight for any reason, so not on a plane."""
    return bool(shapes.n_lines[s] >= _MIN_LINES and shapes.sagitta_px[s] > CURVED_PX)


@inline_borrowing_kernel
def is_straight(shapes: ComponentShapes, s: int) -> bool:
    """Return whether component s is long and straight, as on a plane."""
    is_long = shapes.n_lines[s] >= 2 * _MIN_LINES
    return bool(is_long and shapes.sagitta_px[s] <= _MIN_SAGITTA_PX)


@inline_borrowing_kernel
def is_round(shapes: ComponentShapes, s: int, bright: float) -> bool:
    """Return whether component s is a spot about as high as `bright` (grey levels) or higher."""
    n_lines = shapes.n_lines[s]
    ratio = n_lines / max(shapes.thickness[s], 1.0)
    spot = _ROUND_FROM <= ratio <= _ROUND_TO and n_lines >= _SPOT_LINES
    small = shapes.size[s] < _LARGEST_SPOT
    return bool(spot and small and shapes.height[s] >= _GLINT_SHARE * bright)


@lazy_kernel
def describe_components(
    component: IntArray,
    line: IntArray,
    points: FloatArray,
    sensitivity: FloatArray,
    width: FloatArray,
    height: FloatArray,
) -> FloatArray:
    """Describe the components of N candidates.

    Parameters
    ----------
    component, line, points, sensitivity, width, height
        As in `Candidates`.

    Returns
    -------
    array, shape (6, S)
        The fields of `ComponentShapes`; S is one more than the highest component number.
    """
    n = n_bins(component)
    table = np.zeros((6, n))
    shapes = ComponentShapes(table[0], table[1], table[2], table[3], table[4], table[5])
    first, last = np.full(n, -1), np.full(n, -1)
    _measure_components(component, line, width, height, shapes, first, last)
    chord = np.empty((n, 3))
    for s in range(n):
        if shapes.n_lines[s] == 0.0:
            continue
        shapes.thickness[s] /= shapes.n_lines[s]
        shapes.height[s] /= shapes.n_lines[s]
        square = 0.0
        for k in range(3):
            chord[s, k] = points[last[s], k] - points[first[s], k]
            square += chord[s, k] * chord[s, k]
        shapes.size[s] = np.sqrt(square)
    _fit_parabolas(component, points, sensitivity, first, chord, shapes)
    return table


@inline_borrowing_kernel
def run_end(numbers: IntArray, begin: int) -> int:
    """Return the end of the run of equal numbers that begins at `begin`."""
    end, number = begin + 1, numbers[begin]
    while end < numbers.shape[0] and numbers[end] == number:
        end += 1
    return end


@inner_borrowing_kernel
def _measure_components(
    component: IntArray,
    line: IntArray,
    width: FloatArray,
    height: FloatArray,
    shapes: ComponentShapes,
    first: IntArray,
    last: IntArray,
) -> None:
    """Sum lines, widths and heights of each component, and find the candidates at its ends."""
    begin = ZERO
    while begin < component.shape[0]:
        s, end = component[begin], run_end(component, begin)
        widths, heights = 0.0, 0.0
        low, high = begin, begin
        for i in range(begin, end):
            widths += width[i]
            heights += height[i]
            low = i if line[i] < line[low] else low
            high = i if line[i] > line[high] else high
        if first[s] < 0 or line[low] < line[first[s]]:
            first[s] = low
        if last[s] < 0 or line[high] > line[last[s]]:
            last[s] = high
        shapes.n_lines[s] += end - begin
        shapes.thickness[s] += widths
        shapes.height[s] += heights
        begin = end


@inner_kernel
def _fit_parabolas(
    component: IntArray,
    points: FloatArray,
    sensitivity: FloatArray,
    first: IntArray,
    chord: FloatArray,
    shapes: ComponentShapes,
) -> None:
    """Fit a parabola over the chord of each component that is long enough to have a shape."""
    n = shapes.n_lines.shape[0]
    sums = np.zeros((n, _N_SUMS))
    begin = ZERO
    while begin < component.shape[0]:
        s, end = component[begin], run_end(component, begin)
        if shapes.n_lines[s] >= _MIN_LINES and shapes.size[s] > 0.0:
            _add_powers(
                points, sensitivity, begin, end, first[s], chord[s], shapes.size[s], sums[s]
            )
        begin = end
    normal, inverse, parabola = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for s in range(n):
        if sums[s, 0] == 0.0:
            continue
        moments = sums[s, _MOMENTS:]
        for j in range(3):
            for k in range(3):
                normal[j, k] = sums[s, j + k]
        if solve_symmetric(normal, moments, inverse, parabola):
            shapes.sagitta_px[s] = 0.25 * abs(parabola[2])
            explained = 0.0
            for k in range(3):
                explained += parabola[k] * moments[k]
            left = max(sums[s, _SQUARES] - explained, 0.0)
            shapes.rough_px[s] = np.sqrt(left / shapes.n_lines[s])


@inline_borrowing_kernel
def _add_powers(
    points: FloatArray,
    sensitivity: FloatArray,
    begin: int,
    end: int,
    first: int,
    chord: FloatArray,
    length: float,
    sums: FloatArray,
) -> None:
    """Add the powers of the place t along a chord, 0 to 1, and the moments of the offset beside it.

    The offset is the shift of the stripe, in pixels, that moves the point off the chord.
    """
    scale = 1.0 / length
    ex, ey, ez = chord[0] * scale, chord[1] * scale, chord[2] * scale
    ax, ay, az = points[first, 0], points[first, 1], points[first, 2]
    p1, p2, p3, p4, m0, m1, m2, squares = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(begin, end):
        x, y, z = points[i, 0] - ax, points[i, 1] - ay, points[i, 2] - az
        jx, jy, jz = sensitivity[i, 0], sensitivity[i, 1], sensitivity[i, 2]
        along = ex * x + ey * y + ez * z
        slope = ex * jx + ey * jy + ez * jz
        across_x, across_y, across_z = jx - slope * ex, jy - slope * ey, jz - slope * ez
        product = (
            across_x * (x - along * ex) + across_y * (y - along * ey) + across_z * (z - along * ez)
        )
        square = across_x * across_x + across_y * across_y + across_z * across_z
        beside = product / square if square > 0.0 else 0.0
        t = along * scale
        tt = t * t
        p1, p2, p3, p4 = p1 + t, p2 + tt, p3 + t * tt, p4 + tt * tt
        m0, m1, m2 = m0 + beside, m1 + t * beside, m2 + tt * beside
        squares += beside * beside
    sums[0] += end - begin
    sums[1] += p1
    sums[2] += p2
    sums[3] += p3
    sums[4] += p4
    sums[_MOMENTS] += m0
    sums[_MOMENTS + 1] += m1
    sums[_MOMENTS + 2] += m2
    sums[_SQUARES] += squares


SUBSEGMENT_LINES = 16
"""A long segment is cut into subsegments of at most this many peaks."""

# A gap of one search line does not end a segment: H.264 and specks make such gaps.
_MAX_LINE_STEP = 2
# Largest distance of a peak from the predicted position. The second peak of a segment, whose slope
# is not known yet, may be as far away for each pixel of a search line: search lines of two pixels
# see twice the slope.
_LINK_GATE_PX = 2.0


@dataclass(frozen=True, slots=True)
class Segments:
    """Peaks in one laser's band, grouped by segment, component and subsegment."""

    # Shape (N,): indices into the `StripePeaks`, segment by segment, along each segment.
    order: IntArray
    # Shape (N,): number of the component (connected segments) of each peak, in the order of
    # `order`.
    component: IntArray
    # Shape (N,): number of the subsegment, likewise; a segment's subsegments are consecutive. A
    # short segment, such as the light on one strand of a net, is one subsegment.
    subsegment: IntArray


def link_segments(peaks: StripePeaks, band: LaserBand) -> Segments:
    """Group the peaks inside a laser's band; drop segments that only another laser can make.

    Parameters
    ----------
    peaks : StripePeaks
        Of the search direction of `band`.
    band : LaserBand
        Band and slopes of the laser.

    Returns
    -------
    Segments
    """
    numbers = np.empty((3, peaks.n), np.int64)
    n = segment_peaks(peaks, band.lines, numbers)
    return Segments(*numbers[:, :n])


@inner_kernel
def in_a_row(line: IntArray, position: FloatArray) -> BoolArray:
    """Mark the peaks (N,) in segments of at least `SUBSEGMENT_LINES` peaks, in any direction.

    Parameters
    ----------
    line, position
        As in `StripePeaks`.
    """
    n = line.shape[0]
    n_lines = line[n - 1] + 1 if n else 0
    segment_of = np.empty(n, np.int64)
    first, last, count = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    # No band: limits beyond any position on a search line.
    anywhere = 1 << 40
    lowest, highest = np.full(n_lines, -anywhere), np.full(n_lines, anywhere)
    _link(line, position, lowest, highest, ZERO + 1, segment_of, first, last, count)
    long = np.empty(n, np.bool_)
    for i in range(n):
        long[i] = count[segment_of[i]] >= SUBSEGMENT_LINES
    return long


@lazy_kernel
def segment_peaks(peaks: StripePeaks, band: BandLines, numbers: IntArray) -> int:
    """Write the fields of `Segments` as rows (3, N); return the number of peaks kept.

    Peaks outside the band, and of segments of another laser's direction, are left out.
    """
    line, position, n = peaks.line, peaks.position, peaks.line.shape[0]
    segment_of = np.empty(n, np.int64)
    # First and last peak of each segment, and the number of its peaks.
    first, last, count = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    n_segments = _link(
        line, position, band.lowest, band.highest, band.line_px, segment_of, first, last, count
    )
    start = _sort_by_segment(segment_of, count[:n_segments], numbers)
    n_kept = _drop_foreign(peaks, band, start, first, last, numbers)
    root = _join_components(line, position, first[:n_kept], last[:n_kept])
    order, component = numbers[0], numbers[1]
    n = 0
    for s in range(n_kept):
        mine = root[s]
        while True:
            component[n] = mine
            n += 1
            if order[n - 1] == last[s]:
                break
    return n


@inline_borrowing_kernel
def _predict(x: int, n_alive: int, alive: IntArray, track: FloatArray, due: FloatArray) -> int:
    """Predict the segments' positions on search line x; drop ended ones, return the number left."""
    kept = 0
    for k in range(n_alive):
        step = x - alive[1, k]
        if step <= _MAX_LINE_STEP:
            if kept != k:
                for j in range(alive.shape[0]):
                    alive[j, kept] = alive[j, k]
                for j in range(track.shape[0]):
                    track[j, kept] = track[j, k]
            due[kept] = track[0, kept] + track[1, kept] * step
            kept += 1
    return kept


@inner_kernel
def _link(
    line: IntArray,
    position: FloatArray,
    lowest: IntArray,
    highest: IntArray,
    line_px: int,
    segment_of: IntArray,
    first: IntArray,
    last: IntArray,
    count: IntArray,
) -> int:
    """Assign each peak to the segment that it continues, or to a new one; -1 outside the band.

    Write `segment_of` (N,), and first peak, last peak and count of each segment; return the number
    of segments. A segment predicts its next peak by its last position and an averaged slope.
    """
    n = line.shape[0]
    # Active segments: number and last search line; last position, slope, weight of the next peak in
    # the slope, and its gate; and the predicted position on this search line.
    alive, track, due = np.empty((2, n), np.int64), np.empty((4, n)), np.empty(n)
    n_alive = ZERO
    n_segments = 0
    here = -1
    for i in range(n):
        x, place = line[i], position[i]
        segment_of[i] = -1
        # Peaks of a damaged recording may be anywhere.
        if not (0 <= x < lowest.shape[0] and lowest[x] <= place <= highest[x]):
            continue
        if x != here:
            n_alive = _predict(x, n_alive, alive, track, due)
            here = x
        best, best_miss = -1, np.inf
        for k in range(n_alive):
            miss = abs(place - due[k])
            if miss < min(best_miss, track[3, k]):
                best, best_miss = k, miss
        if best < 0:
            s, best = n_segments, n_alive
            alive[0, best], first[s], count[s] = s, i, 1
            track[1, best], track[2, best], track[3, best] = 0.0, 1.0, _LINK_GATE_PX * line_px
            n_segments += 1
            n_alive += 1
        else:
            s = alive[0, best]
            # The last peak is one or two search lines away.
            slope = (place - track[0, best]) * (1.0 if x - alive[1, best] == 1 else 0.5)
            track[1, best] += track[2, best] * (slope - track[1, best])
            count[s] += 1
            track[2, best], track[3, best] = max(1.0 / count[s], 0.15), _LINK_GATE_PX
        # A segment has one peak on a search line: no other one is near the prediction.
        alive[1, best], track[0, best], due[best] = x, place, np.inf
        segment_of[i], last[s] = s, i
    return n_segments


@inner_kernel
def _sort_by_segment(segment_of: IntArray, count: IntArray, numbers: IntArray) -> IntArray:
    """Sort the peaks by segment into the first row of `numbers`; return the segments' starts."""
    n_segments = count.shape[0]
    start, fill = np.empty(n_segments + 1, np.int64), np.empty(n_segments, np.int64)
    start[0] = 0
    for s in range(n_segments):
        fill[s] = start[s]
        start[s + 1] = start[s] + count[s]
    for i in range(segment_of.shape[0]):
        s = segment_of[i]
        if s >= 0:
            numbers[0, fill[s]] = i
            fill[s] += 1
    return start


@inner_kernel
def _drop_foreign(
    peaks: StripePeaks,
    band: BandLines,
    start: IntArray,
    first: IntArray,
    last: IntArray,
    numbers: IntArray,
) -> int:
    """Keep the segments whose direction is possible; number their subsegments.

    Return the number of segments kept. `numbers`, `first` and `last` are compacted in place.
    """
    order, subsegment = numbers[0], numbers[2]
    n, n_subsegments, n_kept = 0, 0, 0
    # Least number of peaks of a segment that must follow the stripe; shorter ones follow strands.
    long_segment = 24
    for s in range(start.shape[0] - 1):
        begin, size = start[s], start[s + 1] - start[s]
        if size >= long_segment:
            members = order[begin : begin + size]
            if not _direction_possible(peaks, members, band):
                continue
            n_parts = (size + SUBSEGMENT_LINES - 1) // SUBSEGMENT_LINES
            for k in range(size):
                subsegment[n + k] = n_subsegments + k * n_parts // size
            n_subsegments += n_parts
        else:
            for k in range(size):
                subsegment[n + k] = n_subsegments
            n_subsegments += 1
        if n < begin:
            for k in range(size):
                order[n + k] = order[begin + k]
        n += size
        first[n_kept], last[n_kept] = first[s], last[s]
        n_kept += 1
    return n_kept


@inner_kernel
def _direction_possible(peaks: StripePeaks, members: IntArray, band: BandLines) -> bool:
    """Return whether the slope of a long segment is possible for its laser's stripe.

    The slope is that of a straight line through its peaks, by least squares.
    """
    line, position, n = peaks.line, peaks.position, members.shape[0]
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
    # Tolerance of a slope beyond the bounds for a plane target; covers curvature.
    slope_margin = 0.15
    low = band.slope_low[row, column] - slope_margin
    high = band.slope_high[row, column] + slope_margin
    return bool(low <= slope <= high)


@inner_kernel
def _join_components(
    line: IntArray, position: FloatArray, first: IntArray, last: IntArray
) -> IntArray:
    """Return for each segment the number of the first segment of its connected component.

    `first` and `last` are the peaks at the segments' ends; segments are ordered by the first.
    """
    n = first.shape[0]
    root = np.empty(n, np.int64)
    for s in range(n):
        root[s] = s
    # A segment that begins within this distance of another one's end belongs to the same component:
    # in search lines, and in pixels.
    join_lines = 4
    join_px = 4.0
    for a in range(n):
        end, place = line[last[a]], position[last[a]]
        b = _first_from(line, first, end - join_lines)
        while b < n and line[first[b]] <= end + join_lines:
            if a != b and abs(position[first[b]] - place) <= join_px:
                one, other = _root_of(root, a), _root_of(root, b)
                root[max(one, other)] = min(one, other)
            b += 1
    for a in range(n):
        # Roots come before their children.
        root[a] = root[root[a]]
    return root


@inner_borrowing_kernel
def _first_from(line: IntArray, first: IntArray, wanted: int) -> int:
    """Return the first segment that begins on the wanted search line or after it."""
    low, high = 0, first.shape[0]
    while low < high:
        middle = (low + high) // 2
        if line[first[middle]] < wanted:
            low = middle + 1
        else:
            high = middle
    return low


@inline_borrowing_kernel
def _root_of(root: IntArray, a: int) -> int:
    """Return the root of a segment in the union-find forest."""
    while root[a] != a:
        a = root[a]
    return a
