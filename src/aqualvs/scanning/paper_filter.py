"""The paper's mesh filter behind either detector.

The paper takes every bright pixel for a point of its own, so that its regions count the lit cells
of whole reflections. Returns of the threshold detector are given to it so; those of the sub-pixel
detector are one point each, their centre.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import Rig
from aqualvs.optics.sheet import sheets_of
from aqualvs.scanning.mesh import MeshFilterOptions, mesh_filter
from aqualvs.scanning.search import SearchAxis, StripeSearch
from aqualvs.scanning.threshold import pixels_of_returns
from aqualvs.scanning.triangulate import Triangulator


@dataclass(frozen=True, slots=True)
class FilteredPoints:
    """Points of N returns as the paper's filter takes them, M of them, and its answer.

    Attributes
    ----------
    source : int array, shape (M,)
        Row of the return that each point belongs to, ascending.
    laser : int array, shape (M,)
        Index of its laser.
    pixels : array, shape (M, 2)
        In `image`.
    points_in_dome : array, shape (M, 3)
        Metres. A pixel whose ray misses the laser's sheet is no point.
    on_mesh : bool array, shape (M,)
        What the filter keeps.
    """

    source: IntArray
    laser: IntArray
    pixels: FloatArray
    points_in_dome: FloatArray
    on_mesh: BoolArray

    def returns_on_mesh(self, n: int) -> BoolArray:
        """Return which of the N returns have more than half of their points on the mesh."""
        n_points = np.bincount(self.source, minlength=n)
        n_on_mesh = np.bincount(self.source[self.on_mesh], minlength=n)
        return np.asarray(2 * n_on_mesh > n_points)


class PaperFilter:
    """Applies the paper's filter to returns whose laser is known.

    Parameters
    ----------
    rig : Rig
        Lasers and working range.
    camera : Camera
        Of the rig.
    searches : sequence of StripeSearch
        One for each laser.
    options : MeshFilterOptions
        Of the filter.
    every_pixel : bool
        Whether every pixel of a return is a point, or its centre alone.
    """

    def __init__(
        self,
        rig: Rig,
        camera: Camera,
        searches: Sequence[StripeSearch],
        options: MeshFilterOptions,
        *,
        every_pixel: bool,
    ) -> None:
        self._options, self._every_pixel = options, every_pixel
        self._working_range = rig.working_range
        self._triangulator = Triangulator(rig, camera)
        self._planes = [one.best_plane(camera, rig.working_range) for one in sheets_of(rig)]
        self._along_x = np.array([one.axis is SearchAxis.ALONG_X for one in searches], np.int64)

    def apply(self, pixels: FloatArray, width: FloatArray, laser: IntArray) -> FilteredPoints:
        """Triangulate the returns, and filter the points of each laser.

        Parameters
        ----------
        pixels : array, shape (N, 2)
            Centres of the returns in `image`.
        width : array, shape (N,)
            As in `Returns`.
        laser : int array, shape (N,)
            Index of the laser that made each return. The paper divides its picture by hand into
            one area for each laser.
        """
        source, each = self._places(pixels, width, laser)
        of_laser = laser[source]
        found = self._triangulator.triangulate(each, self._along_x[of_laser], of_laser)
        source, laser, each = source[found.valid], of_laser[found.valid], each[found.valid]
        points = found.points_in_dome[found.valid]
        on_mesh = np.zeros(len(each), np.bool_)
        for i, plane in enumerate(self._planes):
            mine = laser == i
            on_mesh[mine] = mesh_filter(
                points[mine], plane, self._options, working_range=self._working_range
            )
        return FilteredPoints(source, laser, each, points, on_mesh)

    def _places(
        self, pixels: FloatArray, width: FloatArray, laser: IntArray
    ) -> tuple[IntArray, FloatArray]:
        """Return the row of the return and the place in `image` of each point, (M,) and (M, 2)."""
        rows = np.arange(len(pixels))
        if not self._every_pixel:
            return rows, np.ascontiguousarray(pixels, np.float64)
        # Column of the coordinate that runs along the search line.
        along = 1 - self._along_x[laser]
        source, place = pixels_of_returns(pixels[rows, along], width)
        each = np.ascontiguousarray(pixels[source], np.float64)
        each[np.arange(len(each)), along[source]] = place
        return source, each
