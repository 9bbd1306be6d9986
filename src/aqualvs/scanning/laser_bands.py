"""Laser bands: the part of the image where each laser can appear, and its possible slopes there.

A laser sheet, limited to the working range, is visible only in a band of the image, which follows
from the rig. The band replaces the hand-drawn areas of the paper (section 3.1).
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Rays
from aqualvs.geometry.transforms import rotation_from_rotvec
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import Rig
from aqualvs.optics.sheet import Sheet, sheets_of
from aqualvs.optics.shutter import FIRST_ROW, Field
from aqualvs.scanning.laser_colour import LaserColour
from aqualvs.scanning.triangulate import Triangulator

SLOPE_CELL = 8
"""Positions, and search lines, per cell of the slope tables and of the grid that is intersected."""


class SearchAxis(Enum):
    """Image axis of the search lines: across the usual direction of a stripe."""

    ALONG_Y = "y"
    """Search lines are columns; for stripes that run more horizontal than vertical."""
    ALONG_X = "x"
    """Search lines are rows; for stripes that run more vertical than horizontal."""


class BandLines(NamedTuple):
    """The search lines of a laser's band, for kernels; attributes as in `LaserBand`."""

    lowest: IntArray
    highest: IntArray
    slope_low: FloatArray
    slope_high: FloatArray
    line_px: int
    shift_px: float


@dataclass(frozen=True, slots=True)
class LaserBand:
    """The search band of one laser in the image."""

    axis: SearchAxis  # Direction of the search lines.
    # Pixels across one search line, 1 or 2: it is the mean of that many rows or columns of pixels,
    # or in a field one row of two.
    line_px: int
    # Shape (n_lines,): first and last position of the band on each search line; lowest > highest
    # where the laser cannot be seen.
    lowest: IntArray
    highest: IntArray
    # Shape (ceil(length/8), ceil(n_lines/8)): range of d(position)/d(line) that a plane target
    # within 45 degrees of square allows, by cell of 8 positions by 8 lines.
    slope_low: FloatArray
    slope_high: FloatArray
    colour: LaserColour = LaserColour.GREEN  # Of the laser's light.
    # Shift of each search line from the middle of its `line_px` pixels; nonzero for rows of a field
    # only.
    shift_px: float = 0.0
    # Pixels from one position to the next; 2 along the columns of a field, else 1.
    position_px: float = 1.0

    @property
    def lines(self) -> BandLines:
        """Arguments of kernels: the band without its axis and colour."""
        return BandLines(
            self.lowest, self.highest, self.slope_low, self.slope_high, self.line_px, self.shift_px
        )

    @property
    def visible(self) -> bool:
        """Whether the laser can appear in the image."""
        return self.n_lit > 0

    @property
    def n_lit(self) -> int:
        """Number of search lines on which the laser can appear."""
        return int(np.count_nonzero(self.lowest <= self.highest))

    @property
    def slant(self) -> float:
        """Mean slope of the stripe, in pixels along a search line for each pixel across it."""
        return float(np.mean(np.abs(self.slope_low + self.slope_high))) / (2 * self.line_px)


def search_range(working_range: tuple[float, float]) -> tuple[float, float]:
    """Return the working range (m) widened, so that a target beyond it is detected and reported."""
    near, far = working_range
    return 0.8 * near, 1.2 * far


def pixels_per_line(size_px: tuple[int, int]) -> int:
    """Return the number of rows or columns of pixels in a search line: 2 in wide pictures, else 1.

    Wide pictures have finer pixels than stripes need.
    """
    wide_px = 1280
    return 2 if size_px[0] >= wide_px else 1


def plan_bands(rig: Rig, camera: Camera, field: Field | None = None) -> tuple[LaserBand, ...]:
    """Compute the search band of each of the rig's lasers.

    Parameters
    ----------
    rig : Rig
        Lasers and working range.
    camera : Camera
        The camera that will see them; with or without its dome.
    field : {"top", "bottom"} or None
        Field whose rows are the search lines along x; None for whole pictures.

    Returns
    -------
    tuple of LaserBand
        In the order of `rig.lasers`.
    """
    # The rays of the grid are the same for all lasers.
    rays = functools.cache(functools.partial(_rays_on_grid, camera))
    return tuple(
        _plan_band(
            sheet, LaserColour.of(laser.wavelength_nm), rig.working_range, camera, field, rays
        )
        for sheet, laser in zip(sheets_of(rig), rig.lasers, strict=True)
    )


def _plan_band(
    sheet: Sheet,
    colour: LaserColour,
    working_range: tuple[float, float],
    camera: Camera,
    field: Field | None,
    rays: Callable[[tuple[int, int]], Rays],
) -> LaserBand:
    """Compute the band of one laser; `rays` gives those of a grid with steps along x and y (px)."""
    fine = (SLOPE_CELL, SLOPE_CELL)
    points, in_band = _points_on_grid(sheet, working_range, rays(fine))
    rise, run = _stripe_directions(points, _target_normals()[:1])
    axis = _search_axis(rise[0], run[0], in_band)
    along_x = axis is SearchAxis.ALONG_X
    line_px, shift_px = pixels_per_line(camera.size_px), 0.0
    if along_x and field is not None:
        line_px, shift_px = 2, FIRST_ROW[field] - 0.5
    wide = SLOPE_CELL * line_px
    steps = (SLOPE_CELL, wide) if along_x else (wide, SLOPE_CELL)
    if steps != fine:
        points, in_band = _points_on_grid(sheet, working_range, rays(steps))
    if along_x:
        points, in_band = points.swapaxes(0, 1), in_band.T
    # The grid now has search lines as columns: the slope d(position)/d(line) is rise over run.
    rise, run = _stripe_directions(points, _target_normals())
    length, n_pixels = camera.size_px if along_x else camera.size_px[::-1]
    lowest, highest = _band_limits(in_band, n_pixels // line_px, length)
    position_px = 1.0 if along_x or field is None else 2.0
    slopes = _slope_bounds(rise, run)
    return LaserBand(axis, line_px, lowest, highest, *slopes, colour, shift_px, position_px)


def _rays_on_grid(camera: Camera, steps: tuple[int, int]) -> Rays:
    """Return the rays of a grid of pixels, rows first: steps along x and y, in pixels."""
    width, height = camera.size_px
    x = np.arange(0, width + steps[0], steps[0], dtype=np.float64)
    y = np.arange(0, height + steps[1], steps[1], dtype=np.float64)
    return camera.rays(np.stack(np.meshgrid(x, y), axis=-1))


def _points_on_grid(
    sheet: Sheet, working_range: tuple[float, float], rays: Rays
) -> tuple[FloatArray, BoolArray]:
    """Return the points (..., 3) where rays meet the sheet, and a mask of those in range.

    In `dome`, metres.
    """
    points, valid = sheet.intersect(rays)
    distance = np.linalg.norm(points, axis=-1)
    near, far = search_range(working_range)
    # Points of a target at the far range are farther away by up to this factor, off the axis. At
    # the near range no point is nearer than the target's plane, so that bound is exact.
    off_axis_stretch = 1.5
    with np.errstate(invalid="ignore"):
        in_band = valid & (distance >= near) & (distance <= far * off_axis_stretch)
    return points, in_band


@functools.cache
def _target_normals() -> FloatArray:
    """Return the normals (5, 3) of a target square to the vehicle, and of the most tilted ones.

    They bound the direction of a stripe.
    """
    max_tilt, right, up = np.deg2rad(45.0), np.eye(3)[0], np.eye(3)[2]
    tilts = (np.zeros(3), -max_tilt * right, -max_tilt * up, max_tilt * right, max_tilt * up)
    return np.stack([rotation_from_rotvec(tilt) @ np.array([0.0, 1.0, 0.0]) for tilt in tilts])


def _stripe_directions(points: FloatArray, normals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the direction of the stripe at points (V, U, 3) for targets with normals (N, 3).

    The stripe of a target n·X = d is the contour line of n·X over the image: its direction is the
    gradient, turned by a right angle. Rise and run (N, V, U) are its components along the first and
    the second axis of the grid.
    """
    with np.errstate(invalid="ignore"):
        height = np.einsum("nk,vuk->nvu", normals, points)
        along_y, along_x = np.gradient(height, axis=(1, 2))
    return -along_x, along_y


def _search_axis(rise: FloatArray, run: FloatArray, in_band: BoolArray) -> SearchAxis:
    """Return the image axis that crosses most of the stripe nearer to a right angle."""
    steep = np.abs(rise) > np.abs(run)
    share = np.mean(steep[in_band]) if np.any(in_band) else 0.0
    return SearchAxis.ALONG_X if share > 0.5 else SearchAxis.ALONG_Y


def _slope_bounds(rise: FloatArray, run: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the lowest and highest slope of each cell over all targets; all slopes if unknown."""
    with np.errstate(invalid="ignore", divide="ignore"):
        slopes = rise / run
    # Steeper stripes count as parallel to the search line.
    steepest = 5.0
    known, slopes = np.isfinite(slopes), np.clip(slopes, -steepest, steepest)
    unknown = ~known.any(axis=0)
    low = np.min(slopes, axis=0, where=known, initial=steepest)
    high = np.max(slopes, axis=0, where=known, initial=-steepest)
    low[unknown], high[unknown] = -steepest, steepest
    return np.ascontiguousarray(low), np.ascontiguousarray(high)


def _band_limits(in_band: BoolArray, n_lines: int, length: int) -> tuple[IntArray, IntArray]:
    """Return first and last position (n_lines,) of the band, widened by one cell of the grid."""
    any_in = in_band.any(axis=0)
    first = np.argmax(in_band, axis=0)
    last = in_band.shape[0] - 1 - np.argmax(in_band[::-1], axis=0)
    lowest = np.where(any_in, np.maximum((first - 1) * SLOPE_CELL, 0), length)
    highest = np.where(any_in, np.minimum((last + 1) * SLOPE_CELL, length - 1), -1)
    cell = np.arange(n_lines) // SLOPE_CELL
    nearest = np.minimum(lowest[cell], lowest[cell + 1])
    farthest = np.maximum(highest[cell], highest[cell + 1])
    return nearest.astype(np.int64), farthest.astype(np.int64)


def sample_bands(
    laser_bands: Sequence[LaserBand], triangulator: Triangulator, cell_lines: int
) -> FloatArray:
    """Sample points of each laser's sheet across its band, on one search line of each cell.

    Parameters
    ----------
    laser_bands : sequence of LaserBand
        One for each laser.
    triangulator : Triangulator
        Of the same rig.
    cell_lines : int
        Search lines per cell.

    Returns
    -------
    float array, shape (n_lasers, cells, samples, 4)
        A point P in `dome` is stored as (P, 1) / |P|, because (m·P - 1) / |P| is nearly linear
        across a band. NaN where the laser cannot be seen.
    """
    n_cells = max((len(one.lowest) for one in laser_bands), default=0) // cell_lines + 1
    # Samples across a laser's band, between which its stripe on a plane is located.
    n_samples = 16
    bands = np.full((len(laser_bands), n_cells, n_samples, 4), np.nan)
    for i, band in enumerate(laser_bands):
        lines = np.arange(cell_lines // 2, len(band.lowest), cell_lines)
        lines = lines[band.lowest[lines] <= band.highest[lines]]
        if not len(lines):
            continue
        places = np.linspace(band.lowest[lines], band.highest[lines], n_samples, axis=1)
        middle = (lines + 0.5)[:, None] * band.line_px - 0.5 + band.shift_px
        across = np.broadcast_to(middle, places.shape)
        along_x = band.axis is SearchAxis.ALONG_X
        pixels = np.stack([places, across] if along_x else [across, places], axis=-1)
        n = places.size
        found = triangulator.triangulate(
            np.ascontiguousarray(pixels.reshape(n, 2)), np.full(n, int(along_x)), np.full(n, i)
        )
        points = found.points_in_dome
        share = 1.0 / np.linalg.norm(points, axis=1)
        packed = np.column_stack([points * share[:, None], share])
        packed[~found.valid] = np.nan
        bands[i, lines // cell_lines] = packed.reshape(*places.shape, 4)
    return bands
