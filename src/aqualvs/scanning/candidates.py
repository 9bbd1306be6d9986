"""Candidates: every stripe peak, triangulated as a point of each laser that could have made it.

`find_candidates` links each laser's peaks (`StripePeaks`) to segments and triangulates them; the
result, `Candidates`, holds the candidate correspondences of peaks and lasers. `Subsegments`
summarises them: a subsegment as a whole lies on a surface or does not.

Cells of the image identify light: one peak yields candidates of several lasers, and one stripe may
be found by two search directions, so candidates in or next to a cell in which a surface has
candidates count as the same light (`number_cells`).
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray, U8Array
from aqualvs.geometry.compiled import (
    ZERO,
    inline_borrowing_kernel,
    inner_kernel,
    lazy_borrowing_kernel,
    lazy_kernel,
)
from aqualvs.geometry.linear_algebra import lower_quantile, median_of
from aqualvs.scanning.laser_bands import BandLines, LaserBand, SearchAxis
from aqualvs.scanning.segments import (
    ComponentShapes,
    describe_components,
    is_curved,
    run_end,
    segment_peaks,
)
from aqualvs.scanning.stripe import StripePeaks
from aqualvs.scanning.triangulate import Triangulator

SOURCE, LASER, LINE, COMPONENT, SUBSEGMENT, ALONG_X = range(6)
"""Rows of a table of candidates' integers, as in `Candidates`; ALONG_X is 1 if the search lines run
along x."""
N_NUMBERS = 6
HEIGHT, WIDTH, SIGMA_PX, CONFIDENCE, PULL = range(5)
"""Rows of a table of candidates' measures, as in `Candidates`."""
N_MEASURES = 5

# Standard deviation of a peak's position: a floor in pixels (texture, compression), and this factor
# on width over height: 0.45 (geometry of two flanks) times noise of 3 grey levels.
_FLOOR_PX = 0.1
_FLANK_NOISE = 1.35


FORWARD: FloatArray = np.array([0.0, 1.0, 0.0])
"""The vehicle's forward axis in `dome`: the normal of a target that is square to it."""


class Subsegments(NamedTuple):
    """Subsegments of stripes, C of them, ordered by laser."""

    # Shape (N,): row of the subsegment that each candidate belongs to; ascending.
    of_candidate: IntArray
    # Shape (7, C): rows as `plane_search` names them: centroid in `dome` (m), mean derivative of
    # the points by the stripe's position (m/px), and sampling weight: the intensity weight, but a
    # long component weighs no more than a few strands, because it may follow one strand off the
    # sheet's middle.
    table: FloatArray
    # Shape (C,): sum of its candidates' confidences, in search lines.
    intensity_weight: FloatArray
    # Shape (C,): mean width of its peaks, in pixels.
    width: FloatArray
    # Shape (C,): search lines in it.
    n_lines: IntArray
    # Shape (C,): its first and last search line.
    first_line: IntArray
    last_line: IntArray
    # Shape (C,): index of the laser; ascending.
    laser: IntArray

    @property
    def n(self) -> int:
        """Number of subsegments."""
        return len(self.laser)


class Candidates(NamedTuple):
    """Triangulated candidates, N of them, ordered by laser, segment and subsegment."""

    source: IntArray  # Shape (N,): number of the peak; equal for all candidates of one peak.
    laser: IntArray  # Shape (N,): index of the laser that the peak is assigned to.
    line: IntArray  # Shape (N,): search line.
    # Shape (N,): numbers of the component (connected segments) and the subsegment; those of the
    # subsegments ascend.
    component: IntArray
    subsegment: IntArray
    # Shape (N, 2): in `image`.
    pixels: FloatArray
    # Shape (N,): height and width of the peak: grey levels, pixels.
    height: FloatArray
    width: FloatArray
    # Shape (N,): standard deviation of the position along the search line.
    sigma_px: FloatArray
    # Shape (N,): confidence that the peak is laser light, 0 to 1: geometric mean of its height, as
    # a share of that of the frame's best peaks, and its likelihood.
    confidence: FloatArray
    # Shape (N,): shift of the position by an uneven background, in pixels, as in `StripePeaks`.
    pull: FloatArray
    # Shape (N, 3): in `dome`, metres.
    points: FloatArray
    # Shape (N, 3): derivative of the point by the position, m/px.
    sensitivity: FloatArray

    @property
    def n(self) -> int:
        """Number of candidates."""
        return len(self.source)

    def where(self, mask: BoolArray) -> "Candidates":
        """Return the candidates that a mask of shape (N,) selects."""
        return Candidates._make(column[mask] for column in self)

    def without_pull(self) -> "Candidates":
        """Return the candidates with `pull` subtracted from their positions on the stripe."""
        return self._replace(points=self.points - self.pull[:, None] * self.sensitivity)

    def linked(self) -> "LinkedCandidates":
        """Summarise the subsegments by their centroids; describe the components by their shapes."""
        n = count_subsegments(self.subsegment)
        found = Subsegments(
            np.empty(self.n, np.int64),
            np.empty((7, n)),
            *np.empty((2, n)),
            *np.empty((4, n), np.int64),
        )
        shapes = summarise_subsegments(self, found)
        return LinkedCandidates(self, found, ComponentShapes(*shapes))


class LinkedCandidates(NamedTuple):
    """The candidates of a frame with what they are linked to."""

    candidates: Candidates
    subsegments: Subsegments
    shapes: ComponentShapes  # Of the components.

    def where(self, mask: BoolArray) -> "LinkedCandidates":
        """Return those that a mask (N,) selects; subsegments and components stay as they were."""
        rows = self.subsegments.of_candidate[mask]
        subsegments = self.subsegments._replace(of_candidate=rows)
        return self._replace(candidates=self.candidates.where(mask), subsegments=subsegments)


class CandidateTables(NamedTuple):
    """Columns of candidates as kernels write them."""

    numbers: IntArray  # Shape (6, N): rows as `SOURCE` and the others.
    measures: FloatArray  # Shape (5, N): rows as `HEIGHT` and the others.
    pixels: FloatArray  # Shape (N, 2): in `image`.


@lazy_kernel
def append_candidates(
    peaks: StripePeaks,
    band: BandLines,
    laser: int,
    along_x: int,
    best_height: float,
    begin: int,
    tables: CandidateTables,
) -> int:
    """Append one laser's candidates to the tables from column `begin` on; return the end column.

    Parameters
    ----------
    peaks : StripePeaks
        Of the laser's search direction.
    band : BandLines
        Of the laser.
    laser : int
        Its index.
    along_x : int
        1 if its search lines run along x, else 0.
    best_height : float
        Height of the frame's best peaks, in grey levels.
    begin : int
        Number of candidates of the lasers before.
    tables : CandidateTables
        Written.
    """
    numbers, measures, pixels = tables
    line, height, width = peaks.line, peaks.height, peaks.width
    found = np.empty((3, line.shape[0]), np.int64)
    n = segment_peaks(peaks, band, found)
    # Components and subsegments of different lasers must have different numbers.
    first_component, first_subsegment = 0, 0
    for i in range(begin):
        first_component = max(first_component, numbers[COMPONENT, i] + 1)
    if begin > 0:
        first_subsegment = numbers[SUBSEGMENT, begin - 1] + 1
    across, along = (1, 0) if along_x else (0, 1)
    height_share = 1.0 / best_height
    for k in range(n):
        i, r = begin + k, found[0, k]
        # Peaks of the two search directions get odd and even numbers.
        numbers[SOURCE, i] = 2 * r + along_x
        numbers[LASER, i] = laser
        numbers[LINE, i] = line[r]
        numbers[COMPONENT, i] = first_component + found[1, k]
        numbers[SUBSEGMENT, i] = first_subsegment + found[2, k]
        numbers[ALONG_X, i] = along_x
        measures[HEIGHT, i] = height[r]
        measures[WIDTH, i] = width[r]
        flank = _FLANK_NOISE * width[r] / height[r]
        measures[SIGMA_PX, i] = np.sqrt(_FLOOR_PX * _FLOOR_PX + flank * flank)
        measures[PULL, i] = peaks.pull[r]
        measures[CONFIDENCE, i] = np.sqrt(min(height[r] * height_share, 1.0) * peaks.likelihood[r])
        # Middle of the pixels that make the search line.
        pixels[i, across] = (line[r] + 0.5) * band.line_px - 0.5 + band.shift_px
        pixels[i, along] = peaks.position[r]
    return begin + n


@lazy_borrowing_kernel
def count_subsegments(subsegment: IntArray) -> int:
    """Return the number of different values in ascending subsegment numbers (N,)."""
    n = 0
    for i in range(subsegment.shape[0]):
        n += i == 0 or subsegment[i] != subsegment[i - 1]
    return n


@lazy_kernel
def summarise_subsegments(candidates: Candidates, found: Subsegments) -> FloatArray:
    """Write the subsegments of candidates; return the fields (6, S) of their `ComponentShapes`."""
    line, begin = candidates.line, ZERO
    for c in range(found.laser.shape[0]):
        end = run_end(candidates.subsegment, begin)
        for i in range(begin, end):
            found.of_candidate[i] = c
        found.n_lines[c], found.laser[c] = end - begin, candidates.laser[begin]
        found.first_line[c], found.last_line[c] = line[begin], line[end - 1]
        total, wide = 0.0, 0.0
        for i in range(begin, end):
            total += candidates.confidence[i]
            wide += candidates.width[i]
        found.intensity_weight[c], found.width[c] = total, wide / (end - begin)
        _write_centroid(candidates, begin, end, found.table, c)
        begin = end
    shapes = describe_components(
        candidates.component,
        line,
        candidates.points,
        candidates.sensitivity,
        candidates.width,
        candidates.height,
    )
    _write_sampling_weights(found, candidates.component, shapes)
    return shapes


@inline_borrowing_kernel
def _write_centroid(
    candidates: Candidates, begin: int, end: int, table: FloatArray, c: int
) -> None:
    """Write mean point and sensitivity of subsegment c, weighted by each peak's height x width."""
    points, sensitivity = candidates.points, candidates.sensitivity
    total, x, y, z, jx, jy, jz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(begin, end):
        intensity_weight = candidates.height[i] * candidates.width[i]
        total += intensity_weight
        x += intensity_weight * points[i, 0]
        y += intensity_weight * points[i, 1]
        z += intensity_weight * points[i, 2]
        jx += intensity_weight * sensitivity[i, 0]
        jy += intensity_weight * sensitivity[i, 1]
        jz += intensity_weight * sensitivity[i, 2]
    share = 1.0 / total
    table[0, c], table[1, c], table[2, c] = share * x, share * y, share * z
    table[3, c], table[4, c], table[5, c] = share * jx, share * jy, share * jz


@inner_kernel
def _write_sampling_weights(found: Subsegments, component: IntArray, table: FloatArray) -> None:
    """Write each subsegment's sampling weight, reduced in long or curved components."""
    shapes = ComponentShapes(table[0], table[1], table[2], table[3], table[4], table[5])
    # Components with fewer search lines are specks, and do not count for the typical length.
    speck_lines = 3.0
    strands, n = np.empty(shapes.n_lines.shape[0]), 0
    for s in range(shapes.n_lines.shape[0]):
        if shapes.n_lines[s] >= speck_lines:
            strands[n] = shapes.n_lines[s]
            n += 1
    typical = median_of(strands[:n]) if n else 0.0
    # A component counts with at most this many times the typical number of search lines, but with
    # this many at least.
    weight_limit_share = 2.0
    min_weight_limit = 16.0
    most_lines = max(weight_limit_share * typical, min_weight_limit)
    # Factor on the sampling weight of a curved component: any tangent plane fits a part of a fish.
    curved_weight, begin = 0.2, 0
    for c in range(found.laser.shape[0]):
        s = component[begin]
        weight = found.intensity_weight[c] * min(1.0, most_lines / shapes.n_lines[s])
        found.table[6, c] = curved_weight * weight if is_curved(shapes, s) else weight
        begin += found.n_lines[c]


# Marks of a cell: light in a neighbouring cell, or in the cell itself.
_BESIDE, _MIDDLE = np.uint8(1), np.uint8(2)
# Cells have six pixels. Division by six is a multiplication and a shift, exact for integers below
# 100,000.
_SIXTH_BITS = 18
_SIXTH = (1 << _SIXTH_BITS) // 6 + 1


@inline_borrowing_kernel
def _cell(coordinate: float) -> int:
    """Return the row or column of the cell of a coordinate (px), from 1: cell 0 is a margin."""
    return (int(max(coordinate, 0.0)) * _SIXTH >> _SIXTH_BITS) + 1


class Cells(NamedTuple):
    """Cells of the image, numbered row by row."""

    of_candidate: IntArray  # Shape (N,): number of the cell in which each candidate lies.
    n: int  # In total.
    n_columns: int  # In a row.


@inner_kernel
def number_cells(pixels: FloatArray) -> Cells:
    """Return the cells of candidates whose pixels (N, 2) in `image` are given."""
    right, low = 0.0, 0.0
    for i in range(pixels.shape[0]):
        right, low = max(right, pixels[i, 0]), max(low, pixels[i, 1])
    n_columns, cell = _cell(right) + 2, np.empty(pixels.shape[0], np.int64)
    for i in range(pixels.shape[0]):
        cell[i] = _cell(pixels[i, 1]) * n_columns + _cell(pixels[i, 0])
    return Cells(cell, (_cell(low) + 2) * n_columns, n_columns)


@inline_borrowing_kernel
def mark_cells(middle: int, n_columns: int, lit: U8Array) -> None:
    """Mark a cell and the eight around it with nonzero values in `lit`, shape (n_cells,)."""
    if lit[middle] == _MIDDLE:
        return
    for row in (middle - n_columns, middle, middle + n_columns):
        for near in range(row - 1, row + 2):
            lit[near] = max(lit[near], _BESIDE)
    lit[middle] = _MIDDLE


@inner_kernel
def lit_cells(cells: Cells, explained: BoolArray) -> U8Array:
    """Mark the cells with explained candidates, and those around them.

    Parameters
    ----------
    cells : Cells
        From `number_cells`.
    explained : bool array, shape (N,)
        Candidates that lie on a surface.

    Returns
    -------
    uint8 array, shape (n_cells,)
        Nonzero in marked cells.
    """
    lit = np.zeros(cells.n, np.uint8)
    for i in range(explained.shape[0]):
        if explained[i]:
            mark_cells(cells.of_candidate[i], cells.n_columns, lit)
    return lit


# Quantile of the heights of a frame's peaks that is the height of the best ones.
_BEST_QUANTILE = 0.95
_AXES = (SearchAxis.ALONG_X, SearchAxis.ALONG_Y)
_NOTHING = np.empty(0)
_NO_PEAKS = StripePeaks(np.empty(0, np.int64), _NOTHING, _NOTHING, _NOTHING, _NOTHING, _NOTHING)


def find_candidates(
    peaks: Mapping[SearchAxis, StripePeaks],
    laser_bands: Sequence[LaserBand],
    triangulator: Triangulator,
) -> Candidates:
    """Link each laser's peaks to segments and triangulate them.

    Parameters
    ----------
    peaks : mapping of SearchAxis to StripePeaks
        As `FrameDetector.detect` gives them.
    laser_bands : sequence of LaserBand
        One for each laser.
    triangulator : Triangulator
        Of the same rig.

    Returns
    -------
    Candidates
        Only those whose ray meets the laser's sheet in front of the camera.
    """
    along_x, along_y = (peaks.get(axis, _NO_PEAKS) for axis in _AXES)
    by_search = [along_x if one.axis is SearchAxis.ALONG_X else along_y for one in laser_bands]
    capacity = sum(found.n for found in by_search)
    tables = CandidateTables(
        np.empty((N_NUMBERS, capacity), np.int64),
        np.empty((N_MEASURES, capacity)),
        np.empty((capacity, 2)),
    )
    best_height = lower_quantile(np.concatenate((along_x.height, along_y.height)), _BEST_QUANTILE)
    n = 0
    for i, (band, found) in enumerate(zip(laser_bands, by_search, strict=True)):
        n = append_candidates(found, band.lines, i, found is along_x, best_height, n, tables)
    pixels, numbers = tables.pixels[:n], tables.numbers[:, :n]
    points, sensitivity, valid, all_valid = triangulator.triangulate(
        pixels, numbers[ALONG_X], numbers[LASER], numbers[SUBSEGMENT]
    )
    # The rows of the tables are in the order of the fields.
    measures = tables.measures[:, :n]
    candidates = Candidates._make([*numbers[:ALONG_X], pixels, *measures, points, sensitivity])
    return candidates if all_valid else candidates.where(valid)
