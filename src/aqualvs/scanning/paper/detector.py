"""The paper's stripe detection (section 3.1), and its mesh filter behind either detector.

For comparison: every pixel above one threshold is detected. Consecutive bright pixels on a search
line are one peak; its position and width determine them exactly, and `pixels_of_peaks` returns them
one by one.

The paper treats every bright pixel as a point of its own, so that its regions count the lit cells
of whole reflections. `PaperFilter` passes peaks of the threshold detector to the mesh filter in
that form; those of the sub-pixel detector are one point each, their centre.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import Rig
from aqualvs.optics.sheet import sheets_of
from aqualvs.scanning.laser_bands import LaserBand, SearchAxis
from aqualvs.scanning.paper.mesh_filter import MeshFilterOptions, mesh_filter
from aqualvs.scanning.stripe import StripePeaks, ThresholdOptions
from aqualvs.scanning.triangulate import Triangulator

# Grey levels of 8-bit images.
_LEVELS = 256


class ThresholdDetector:
    """Detector of the bright pixels on every search line of one direction, inside the band.

    Parameters
    ----------
    axis : SearchAxis
        Direction of the search lines.
    size_px : (int, int)
        Image width and height.
    lowest, highest : int array, shape (n_lines,)
        First and last position of interest on each line (an empty interval skips the line).
    options : ThresholdOptions
    """

    def __init__(
        self,
        axis: SearchAxis,
        size_px: tuple[int, int],
        lowest: IntArray,
        highest: IntArray,
        options: ThresholdOptions,
    ) -> None:
        self._options = options
        length = size_px[0] if axis is SearchAxis.ALONG_X else size_px[1]
        along = np.arange(length)
        self._in_band: BoolArray = (lowest[:, None] <= along) & (along <= highest[:, None])
        # Zero outside the band; an additional column of zeros ends the runs of every line.
        self._lines: NDArray[np.uint8] = np.zeros((len(lowest), length + 1), np.uint8)

    def detect(self, lines: NDArray[np.uint8]) -> StripePeaks:
        """Find the runs of bright pixels of one frame; ignore colour.

        Parameters
        ----------
        lines : uint8 array, shape (n_lines, length)
            Luma, with search lines as rows.

        Returns
        -------
        StripePeaks
            Position is the middle of a run, width the number of its pixels, height its largest grey
            level.
        """
        np.multiply(lines, self._in_band, out=self._lines[:, :-1])
        flat = self._lines.ravel()
        first, end = _runs(flat, self._options.level)
        if len(first) > self._options.max_returns or np.sum(end - first) > self._options.max_pixels:
            first, end = _runs(flat, self._raised_level(flat))
        line, start = np.divmod(first, self._lines.shape[1])
        width = end - first
        return StripePeaks(
            line=line,
            position=start + 0.5 * (width - 1),
            height=_brightest(flat, first, end),
            width=width.astype(np.float64),
            likelihood=np.ones(len(first)),
            pull=np.zeros(len(first)),
        )

    def _raised_level(self, flat: NDArray[np.uint8]) -> int:
        """Return the lowest level at which both limits hold; 256 if there is none."""
        # A run begins where a pixel reaches a level and the one before it does not.
        inside = np.minimum(flat[1:], flat[:-1])
        n_pixels, n_inside = _counts_from(flat), _counts_from(inside)
        fits = n_pixels <= self._options.max_pixels
        fits &= n_pixels - n_inside <= self._options.max_returns
        fits[: self._options.level] = False
        return int(np.argmax(fits)) if fits.any() else _LEVELS


def pixels_of_peaks(position: FloatArray, width: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the pixels of N peaks, along their search lines.

    These are the bright pixels of a peak of the threshold detector, each once; of a sub-pixel peak,
    those above half its height, at least one.

    Parameters
    ----------
    position, width : array, shape (N,)
        As in `StripePeaks`.

    Returns
    -------
    source : int array, shape (M,)
        Row of the peak that each pixel belongs to, ascending.
    place : array, shape (M,)
        Integer position of each pixel.
    """
    first, last = np.ceil(position - 0.5 * width), np.floor(position + 0.5 * width)
    none = last < first
    first, last = np.where(none, np.rint(position), first), np.where(none, np.rint(position), last)
    count = (last - first).astype(np.int64) + 1
    source = np.repeat(np.arange(len(count)), count)
    step = np.arange(len(source)) - np.repeat(np.cumsum(count) - count, count)
    return source, first[source] + step


def _runs(flat: NDArray[np.uint8], level: int) -> tuple[IntArray, IntArray]:
    """Return where runs of bright pixels begin and, one place later, where they end."""
    if level >= _LEVELS:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    bright = flat >= level
    edges = np.flatnonzero(bright[1:] != bright[:-1]) + 1
    if bright[0]:
        edges = np.concatenate([[0], edges])
    return edges[::2], edges[1::2]


def _counts_from(values: NDArray[np.uint8]) -> IntArray:
    """Return the number of values (256,) that are at least 0, 1, ... 255."""
    return np.cumsum(np.bincount(values, minlength=_LEVELS)[::-1])[::-1]


def _brightest(flat: NDArray[np.uint8], first: IntArray, end: IntArray) -> FloatArray:
    """Return the largest grey level of each run."""
    if not len(first):
        return np.empty(0)
    bounds = np.column_stack([first, end]).ravel()
    return np.maximum.reduceat(flat, bounds)[::2].astype(np.float64)


@dataclass(frozen=True, slots=True)
class FilteredPeaks:
    """M points of N peaks, in the form of the paper's filter, and its result."""

    source: IntArray  # Shape (M,): row of the peak that each point belongs to, ascending.
    laser: IntArray  # Shape (M,): index of its laser.
    pixels: FloatArray  # Shape (M, 2): in `image`.
    # Shape (M, 3): metres. Pixels whose ray misses the laser's sheet are left out.
    points_in_dome: FloatArray
    # Shape (M,): points that the filter keeps.
    on_mesh: BoolArray

    def peaks_on_mesh(self, n: int) -> BoolArray:
        """Mark the peaks (N,) that have more than half of their points on the mesh."""
        n_points = np.bincount(self.source, minlength=n)
        n_on_mesh = np.bincount(self.source[self.on_mesh], minlength=n)
        return np.asarray(2 * n_on_mesh > n_points)


class PaperFilter:
    """The paper's filter, applied to peaks of known lasers.

    Parameters
    ----------
    rig : Rig
        Lasers and working range.
    camera : Camera
        Of the rig.
    laser_bands : sequence of LaserBand
        One for each laser.
    options : MeshFilterOptions
        Of the filter.
    every_pixel : bool
        Whether every pixel of a peak is a point, or its centre alone.
    """

    def __init__(
        self,
        rig: Rig,
        camera: Camera,
        laser_bands: Sequence[LaserBand],
        options: MeshFilterOptions,
        *,
        every_pixel: bool,
    ) -> None:
        self._options, self._every_pixel = options, every_pixel
        self._working_range = rig.working_range
        self._triangulator = Triangulator(rig, camera)
        self._planes = [one.best_plane(camera, rig.working_range) for one in sheets_of(rig)]
        self._along_x = np.array([one.axis is SearchAxis.ALONG_X for one in laser_bands], np.int64)

    def apply(self, pixels: FloatArray, width: FloatArray, laser: IntArray) -> FilteredPeaks:
        """Triangulate N peaks, and filter the points of each laser.

        Parameters
        ----------
        pixels : array, shape (N, 2)
            Centres of the peaks in `image`.
        width : array, shape (N,)
            As in `StripePeaks`.
        laser : int array, shape (N,)
            Index of the laser of each peak. In the paper, its picture is divided by hand into one
            area for each laser.
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
        return FilteredPeaks(source, laser, each, points, on_mesh)

    def _places(
        self, pixels: FloatArray, width: FloatArray, laser: IntArray
    ) -> tuple[IntArray, FloatArray]:
        """Return the row of the peak and the place in `image` of each point, (M,) and (M, 2)."""
        rows = np.arange(len(pixels))
        if not self._every_pixel:
            return rows, np.ascontiguousarray(pixels, np.float64)
        # Column of the coordinate that runs along the search line.
        along = 1 - self._along_x[laser]
        source, place = pixels_of_peaks(pixels[rows, along], width)
        each = np.ascontiguousarray(pixels[source], np.float64)
        each[np.arange(len(each)), along[source]] = place
        return source, each
