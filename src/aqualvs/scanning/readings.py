"""Readings: every return, read as a point of each laser that could have made it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel
from aqualvs.scanning.chunk_kernels import chunk_facts, hush, number_chunks, summarise
from aqualvs.scanning.chunks import Chunks
from aqualvs.scanning.search import SearchAxis, StripeSearch
from aqualvs.scanning.segments import Segments, link_segments
from aqualvs.scanning.stretch_shape import StretchShapes, stretch_shapes
from aqualvs.scanning.stripe import Returns
from aqualvs.scanning.triangulate import Triangulator

# Position noise of a return: a floor (texture, compression), and what grey-level noise makes of
# the two flanks of a stripe of given width and height.
_FLOOR_PX = 0.1
_FLANK_NOISE = 1.35  # 0.45 (geometry of two flanks) times 3 grey levels
# The best returns of a frame are those from this quantile on.
_BEST_SHARE = 0.95
_NOTHING = np.empty(0)

FORWARD: FloatArray = np.array([0.0, 1.0, 0.0])
"""The vehicle's forward axis in `dome`: the normal of a target that is square to it."""


@dataclass(frozen=True, slots=True)
class Readings:
    """Triangulated readings, N of them, ordered by laser, segment and chunk.

    Attributes
    ----------
    source : int array, shape (N,)
        Number of the return; equal for several readings of one return.
    laser : int array, shape (N,)
        Index of the laser that the return is read as.
    line : int array, shape (N,)
        Search line.
    stretch, chunk : int array, shape (N,)
        Numbers of the stretch and the chunk of stripe; those of the chunks ascend.
    pixels : array, shape (N, 2)
        In `image`.
    height, width : array, shape (N,)
        Of the return: grey levels, pixels.
    sigma_px : array, shape (N,)
        Standard deviation of the position along the search line.
    trust : array, shape (N,)
        How much the return looks like laser light: its height, and where there is colour its green
        fall, as shares of the frame's best; 0 to 1.
    points : array, shape (N, 3)
        In `dome`, metres.
    sensitivity : array, shape (N, 3)
        Derivative of the point by the position, m/px.
    """

    source: IntArray
    laser: IntArray
    line: IntArray
    stretch: IntArray
    chunk: IntArray
    pixels: FloatArray
    height: FloatArray
    width: FloatArray
    sigma_px: FloatArray
    trust: FloatArray
    points: FloatArray
    sensitivity: FloatArray

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.source)

    def where(self, mask: BoolArray) -> "Readings":
        """Return the readings that a mask of shape (N,) selects."""
        return Readings(*(getattr(self, item.name)[mask] for item in fields(self)))

    def chunks(self) -> tuple[Chunks, IntArray]:
        """Summarise the chunks by their centroids.

        Returns
        -------
        Chunks
            C of them, ordered by laser.
        index : int array, shape (N,)
            Row of each reading's chunk.
        """
        index = np.empty(len(self), np.int64)
        n = number_chunks(self.chunk, index)
        facts = np.empty((4, n), np.int64)
        voice, light = np.empty(n), np.zeros(n)
        chunk_facts(index, self.line, self.laser, self.stretch, self.trust, facts, voice, light)
        curved = self.shapes().curved()
        if curved.any():
            hush(index, self.stretch, curved, voice)
        pieces = self.observations(index, n, FORWARD)
        table = np.vstack([pieces.points.T, pieces.sensitivity.T, voice])
        return Chunks(table, light, *facts), index

    def shapes(self) -> StretchShapes:
        """Describe the shape of every stretch."""
        return stretch_shapes(
            self.stretch, self.line, self.points, self.sensitivity, self.width, self.height
        )

    def observations(self, index: IntArray, n: int, normal: FloatArray) -> "Observations":
        """Average groups of readings, weighted by the light in each return.

        A strand is lit where it crosses the laser sheet, brightest in the sheet's middle; the
        centroid of that light lies on the sheet whatever the strand's direction.

        Parameters
        ----------
        index : int array, shape (N,)
            Group of each reading, 0 to n - 1, or -1 to leave it out; no group is empty.
        n : int
            Number of groups.
        normal : array, shape (3,)
            Normal of the surface as far as it is known; spread is measured along it.
        """
        seen = Observations(
            points=np.zeros((n, 3)),
            sensitivity=np.zeros((n, 3)),
            sigma_px=np.zeros(n),
            line=np.zeros(n),
            laser=np.empty(n, np.int64),
        )
        summarise(
            index,
            self.laser,
            self.line,
            self.height,
            self.width,
            self.points,
            self.sensitivity,
            self.sigma_px,
            normal,
            seen.points,
            seen.sensitivity,
            seen.sigma_px,
            seen.line,
            seen.laser,
        )
        return seen


@dataclass(frozen=True, slots=True)
class Observations:
    """Independent observations of a surface: centroids of pieces of stripe, M of them.

    Attributes
    ----------
    points, sensitivity : array, shape (M, 3)
        Centroid in `dome` (m) and its derivative by the stripe's position (m/px).
    sigma_px : array, shape (M,)
        Standard deviation of that position.
    line : array, shape (M,)
        Mean search line.
    laser : int array, shape (M,)
        Index of the laser.
    """

    points: FloatArray
    sensitivity: FloatArray
    sigma_px: FloatArray
    line: FloatArray
    laser: IntArray


def read_returns(
    returns: Mapping[SearchAxis, Returns],
    searches: Sequence[StripeSearch],
    triangulator: Triangulator,
) -> Readings:
    """Link each laser's candidates to segments and triangulate them.

    Parameters
    ----------
    returns : mapping of SearchAxis to Returns
        As `FrameDetector.detect` gives them.
    searches : sequence of StripeSearch
        One for each laser.
    triangulator : Triangulator
        Of the same rig.

    Returns
    -------
    Readings
        Only those whose ray meets the laser's sheet in front of the camera.
    """
    capacity = sum(len(returns[one.axis]) for one in searches if one.axis in returns)
    numbers, measures = np.empty((6, capacity), np.int64), np.empty((4, capacity))
    best = _best(returns)
    pixels = np.empty((capacity, 2))
    n = 0
    for i, search in enumerate(searches):
        if search.axis in returns:
            found = returns[search.axis]
            segments = link_segments(found, search)
            along_x = search.axis is SearchAxis.ALONG_X
            n = _append(
                i, along_x, found, segments, search.line_px, best, n, numbers, measures, pixels
            )
    source, laser, line, stretch, chunk, along = numbers[:, :n]
    located = triangulator.triangulate(pixels[:n], along, laser, chunk)
    readings = Readings(
        source,
        laser,
        line,
        stretch,
        chunk,
        pixels[:n],
        measures[0, :n],
        measures[1, :n],
        measures[2, :n],
        measures[3, :n],
        located.points_in_dome,
        located.sensitivity,
    )
    return readings if located.valid.all() else readings.where(located.valid)


def _best(returns: Mapping[SearchAxis, Returns]) -> tuple[float, float]:
    """Height and green fall of the frame's best returns."""
    height = [one.height for one in returns.values()]
    green = [one.green_fall for one in returns.values()]
    return _high(np.concatenate(height or [_NOTHING])), _high(np.concatenate(green or [_NOTHING]))


def _high(values: FloatArray) -> float:
    if not len(values):
        return 1.0
    rank = int(_BEST_SHARE * (len(values) - 1))
    return float(np.partition(values, rank)[rank])


def _append(
    laser: int,
    along_x: bool,
    found: Returns,
    segments: Segments,
    line_px: int,
    best: tuple[float, float],
    n: int,
    numbers: IntArray,
    measures: FloatArray,
    pixels: FloatArray,
) -> int:
    """Append one laser's candidates to the columns from `n` on; returns the new count."""
    _gather(
        laser,
        along_x,
        line_px,
        *best,
        found.line,
        found.position,
        found.height,
        found.width,
        found.green_fall,
        segments.order,
        segments.stretch,
        segments.chunk,
        n,
        numbers,
        measures,
        pixels,
    )
    return n + len(segments.order)


@borrowing_kernel
def _gather(
    laser: int,
    along_x: bool,
    line_px: int,
    best_height: float,
    best_green: float,
    line: IntArray,
    position: FloatArray,
    height: FloatArray,
    width: FloatArray,
    green_fall: FloatArray,
    order: IntArray,
    stretch: IntArray,
    chunk: IntArray,
    begin: int,
    numbers: IntArray,
    measures: FloatArray,
    pixels: FloatArray,
) -> None:
    # Stretches and chunks of different lasers must differ.
    first_stretch = 0
    for i in range(begin):
        first_stretch = max(first_stretch, numbers[3, i] + 1)
    first_chunk = numbers[4, begin - 1] + 1 if begin > 0 else 0
    across, along = (1, 0) if along_x else (0, 1)
    for k in range(order.shape[0]):
        i, r = begin + k, order[k]
        # Returns of the two search directions get odd and even numbers.
        numbers[0, i] = 2 * r + along_x
        numbers[1, i] = laser
        numbers[2, i] = line[r]
        numbers[3, i] = first_stretch + stretch[k]
        numbers[4, i] = first_chunk + chunk[k]
        numbers[5, i] = along_x
        measures[0, i] = height[r]
        measures[1, i] = width[r]
        measures[2, i] = np.hypot(_FLOOR_PX, _FLANK_NOISE * width[r] / height[r])
        trust = min(height[r] / best_height, 1.0)
        if green_fall[r] == green_fall[r]:
            trust *= min(green_fall[r] / best_green, 1.0)
        measures[3, i] = np.sqrt(trust)
        # The middle of a search line that is several pixels wide.
        pixels[i, across] = (line[r] + 0.5) * line_px - 0.5
        pixels[i, along] = position[r]
