"""Readings: every return, read as a point of each laser that could have made it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from aqualvs.geometry.arrays import AnyArray, BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import kernel
from aqualvs.scanning.search import SearchAxis, StripeSearch
from aqualvs.scanning.segments import link_segments
from aqualvs.scanning.stripe import Returns
from aqualvs.scanning.surfaces import Chunks
from aqualvs.scanning.triangulate import Triangulator

# Position noise of a return: a floor (texture, compression), and what grey-level noise makes of
# the two flanks of a stripe of given width and height.
_FLOOR_PX = 0.1
_FLANK_NOISE = 1.35  # 0.45 (geometry of two flanks) times 3 grey levels
# Position noise of a chunk's centroid beyond that: a floor that neighbouring returns share, and a
# share of the spread, because a strand's light may be cut off on one side by a knot or the border.
_CHUNK_FLOOR_PX = 0.07
_SPREAD_SHARE = 0.12
# Search lines whose voice a whole stretch has at most when surfaces are sought.
_LOUDEST_STRETCH = 48.0

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
        is_first = np.diff(self.chunk, prepend=-1) != 0
        index = np.cumsum(is_first) - 1
        first = np.flatnonzero(is_first)
        n_lines = np.diff(first, append=len(self))
        lines_of_stretch = np.bincount(self.stretch)[self.stretch[first]]
        pieces = self.observations(index, len(first), FORWARD)
        chunks = Chunks(
            centroid=pieces.points,
            sensitivity=pieces.sensitivity,
            n_lines=n_lines,
            weight=n_lines * np.minimum(1.0, _LOUDEST_STRETCH / lines_of_stretch),
            first_line=self.line[first],
            last_line=self.line[first + n_lines - 1],
            laser=self.laser[first],
        )
        return chunks, index

    def observations(self, index: IntArray, n: int, normal: FloatArray) -> "Observations":
        """Average groups of readings, weighted by the light in each return.

        A strand is lit where it crosses the laser sheet, brightest in the sheet's middle; the
        centroid of that light lies on the sheet whatever the strand's direction.

        Parameters
        ----------
        index : int array, shape (N,)
            Group of each reading, 0 to n - 1; no group is empty.
        n : int
            Number of groups.
        normal : array, shape (3,)
            Normal of the surface as far as it is known; spread is measured along it.
        """
        table = np.zeros((n, 9))
        light = self.height * self.width
        _summarise(index, light, self.points, self.sensitivity, self.sigma_px, normal, table)
        laser = np.empty(n, np.int64)
        laser[index] = self.laser
        return Observations(table[:, 0:3].copy(), table[:, 3:6].copy(), table[:, 6].copy(), laser)


@dataclass(frozen=True, slots=True)
class Observations:
    """Independent observations of a surface: centroids of pieces of stripe, M of them.

    Attributes
    ----------
    points, sensitivity : array, shape (M, 3)
        Centroid in `dome` (m) and its derivative by the stripe's position (m/px).
    sigma_px : array, shape (M,)
        Standard deviation of that position.
    laser : int array, shape (M,)
        Index of the laser.
    """

    points: FloatArray
    sensitivity: FloatArray
    sigma_px: FloatArray
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
    parts = [
        _candidates(i, search, returns[search.axis])
        for i, search in enumerate(searches)
        if search.axis in returns
    ]
    joined = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    # Stretches and chunks of different lasers must differ.
    for key in ("stretch", "chunk"):
        count = [int(part[key].max(initial=-1)) + 1 for part in parts]
        joined[key] += np.repeat(np.cumsum([0, *count[:-1]]), [len(part[key]) for part in parts])
    along_x = joined.pop("along_x")
    position = joined.pop("position")
    pixels = np.stack([joined["line"], position], axis=-1)
    pixels[along_x] = pixels[along_x, ::-1]
    found = triangulator.triangulate(pixels, along_x, joined["laser"])
    readings = Readings(
        **joined,
        pixels=pixels,
        sigma_px=np.hypot(_FLOOR_PX, _FLANK_NOISE * joined["width"] / joined["height"]),
        points=found.points_in_dome,
        sensitivity=found.sensitivity,
    )
    return readings if found.valid.all() else readings.where(found.valid)


def _candidates(laser: int, search: StripeSearch, returns: Returns) -> dict[str, AnyArray]:
    segments = link_segments(returns, search)
    order = segments.order
    along_x = search.axis is SearchAxis.ALONG_X
    return {
        # Returns of the two search directions get odd and even numbers.
        "source": 2 * order + along_x,
        "laser": np.full(len(order), laser),
        "line": returns.line[order],
        "stretch": segments.stretch,
        "chunk": segments.chunk,
        "along_x": np.full(len(order), along_x),
        "position": returns.position[order],
        "height": returns.height[order],
        "width": returns.width[order],
    }


@kernel
def _summarise(
    index: IntArray,
    light: FloatArray,
    points: FloatArray,
    sensitivity: FloatArray,
    sigma_px: FloatArray,
    normal: FloatArray,
    table: FloatArray,
) -> None:
    """Fill rows of (centroid 3, sensitivity 3, sigma_px, spread², light), one a chunk."""
    for i in range(index.shape[0]):
        row = table[index[i]]
        row[8] += light[i]
        for k in range(3):
            row[k] += light[i] * points[i, k]
            row[3 + k] += light[i] * sensitivity[i, k]
        # Error of a weighted mean of independent positions.
        row[6] += (light[i] * sigma_px[i]) ** 2
    for c in range(table.shape[0]):
        for k in range(6):
            table[c, k] /= table[c, 8]
        table[c, 6] /= table[c, 8] * table[c, 8]
    for i in range(index.shape[0]):
        row = table[index[i]]
        offset = 0.0
        per_px = 0.0
        for k in range(3):
            offset += normal[k] * (points[i, k] - row[k])
            per_px += normal[k] * row[3 + k]
        row[7] += light[i] * (offset / per_px) ** 2
    for c in range(table.shape[0]):
        spread_sq = table[c, 7] / table[c, 8]
        table[c, 6] = np.sqrt(table[c, 6] + _CHUNK_FLOOR_PX**2 + _SPREAD_SHARE**2 * spread_sq)
