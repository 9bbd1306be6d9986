"""Readings: every return, read as a point of each laser that could have made it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.scanning.chunk_kernels import chunk_readings, count_chunks, summarise
from aqualvs.scanning.chunks import Chunks
from aqualvs.scanning.quantile import element_at
from aqualvs.scanning.reading_kernels import N_MEASURES, N_NUMBERS, read_laser
from aqualvs.scanning.search import SearchAxis, StripeSearch
from aqualvs.scanning.stretch_shape import StretchShapes, stretch_shapes
from aqualvs.scanning.stripe import Returns
from aqualvs.scanning.triangulate import Triangulator

# The best returns of a frame are those from this quantile on.
_BEST_SHARE = 0.95
_AXES = (SearchAxis.ALONG_X, SearchAxis.ALONG_Y)
_NOTHING = np.empty(0)
_NO_RETURNS = Returns(np.empty(0, np.int64), _NOTHING, _NOTHING, _NOTHING, _NOTHING)

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
        How much the return looks like laser light: its height as a share of the frame's best, and
        its likelihood; 0 to 1.
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
    # Asked for by the search for surfaces and by the labels.
    _shapes: StretchShapes | None = field(default=None, init=False, repr=False, compare=False)

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.source)

    def where(self, mask: BoolArray) -> "Readings":
        """Return the readings that a mask of shape (N,) selects."""
        return Readings(*(getattr(self, item.name)[mask] for item in fields(self) if item.init))

    def chunks(self) -> tuple[Chunks, IntArray]:
        """Summarise the chunks by their centroids.

        Returns
        -------
        Chunks
            C of them, ordered by laser.
        index : int array, shape (N,)
            Row of each reading's chunk.
        """
        n = count_chunks(self.chunk)
        index, facts = np.empty(len(self), np.int64), np.empty((4, n), np.int64)
        table, light = np.empty((7, n)), np.empty(n)
        shapes = chunk_readings(
            self.chunk,
            self.line,
            self.laser,
            self.stretch,
            self.trust,
            self.height,
            self.width,
            self.points,
            self.sensitivity,
            index,
            table,
            light,
            facts,
        )
        object.__setattr__(self, "_shapes", StretchShapes(*shapes))
        return Chunks(table, light, *facts), index

    def shapes(self) -> StretchShapes:
        """Describe the shape of every stretch."""
        if self._shapes is None:
            found = stretch_shapes(
                self.stretch, self.line, self.points, self.sensitivity, self.width, self.height
            )
            object.__setattr__(self, "_shapes", found)
            return found
        return self._shapes

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
    along_x, along_y = (returns.get(axis, _NO_RETURNS) for axis in _AXES)
    by_search = [along_x if one.axis is SearchAxis.ALONG_X else along_y for one in searches]
    capacity = sum(map(len, by_search))
    numbers, measures = np.empty((N_NUMBERS, capacity), np.int64), np.empty((N_MEASURES, capacity))
    pixels = np.empty((capacity, 2))
    best_height = element_at(np.concatenate((along_x.height, along_y.height)), _BEST_SHARE)
    n = 0
    for i, (search, found) in enumerate(zip(searches, by_search, strict=True)):
        n = read_laser(
            found.line,
            found.position,
            found.height,
            found.width,
            found.likelihood,
            search.lowest,
            search.highest,
            search.slope_low,
            search.slope_high,
            i,
            found is along_x,
            search.line_px,
            best_height,
            n,
            numbers,
            measures,
            pixels,
        )
    points, sensitivity, valid = np.empty((n, 3)), np.empty((n, 3)), np.empty(n, np.bool_)
    source, laser, line, stretch, chunk, along = numbers[:, :n]
    height, width, sigma_px, trust = measures[:, :n]
    pixels = pixels[:n]
    all_valid = triangulator.triangulate_into(
        pixels, along, laser, chunk, points, sensitivity, valid
    )
    readings = Readings(
        source,
        laser,
        line,
        stretch,
        chunk,
        pixels,
        height,
        width,
        sigma_px,
        trust,
        points,
        sensitivity,
    )
    return readings if all_valid else readings.where(valid)
