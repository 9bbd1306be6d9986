"""Where in the image each laser can appear, and which way its stripe may run there.

A laser sheet, limited to the working range, is seen only in a band of the image that follows from
the rig. The band replaces the hand-drawn areas of the paper (section 3.1).
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import rotation_from_rotvec
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import Rig

SLOPE_CELL = 8
"""Pixels per cell of the slope tables, and step of the grid that bands are computed on."""

# Points of a target at the far end of the range lie up to this much farther out, off the axis.
_OFF_AXIS_STRETCH = 1.5
# Targets are expected within this angle of facing the vehicle; it bounds the stripe's direction.
_MAX_TARGET_TILT = np.deg2rad(45.0)
# Slopes beyond this are as good as along the search line.
_STEEPEST = 5.0


class SearchAxis(Enum):
    """Along which image axis a stripe is searched: across its usual direction."""

    ALONG_Y = "y"
    """Search lines are columns; for stripes that run more horizontal than vertical."""
    ALONG_X = "x"
    """Search lines are rows; for stripes that run more vertical than horizontal."""


@dataclass(frozen=True, slots=True)
class StripeSearch:
    """Where to look for one laser.

    Attributes
    ----------
    axis : SearchAxis
        Direction of the search lines.
    lowest, highest : int array, shape (n_lines,)
        First and last position of the band on each search line; lowest > highest where the laser
        cannot be seen.
    slope_low, slope_high : array, shape (ceil(length/8), ceil(n_lines/8))
        Range of d(position)/d(line) that a plane target within 45 degrees of square allows, by
        cell of 8 x 8 pixels.
    """

    axis: SearchAxis
    lowest: IntArray
    highest: IntArray
    slope_low: FloatArray
    slope_high: FloatArray

    @property
    def visible(self) -> bool:
        """Whether the laser can appear in the image at all."""
        return bool(np.any(self.lowest <= self.highest))


def plan_searches(rig: Rig, camera: Camera) -> tuple[StripeSearch, ...]:
    """Work out the search of each of the rig's lasers.

    Parameters
    ----------
    rig : Rig
        Lasers and working range.
    camera : Camera
        The camera that will see them; with or without its dome.

    Returns
    -------
    tuple of StripeSearch
        In the order of `rig.lasers`.
    """
    return tuple(_plan_search(laser.plane, rig.working_range, camera) for laser in rig.lasers)


def _plan_search(plane: Plane, working_range: tuple[float, float], camera: Camera) -> StripeSearch:
    width, height = camera.size_px
    x = np.arange(0, width + SLOPE_CELL, SLOPE_CELL, dtype=np.float64)
    y = np.arange(0, height + SLOPE_CELL, SLOPE_CELL, dtype=np.float64)
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    points, valid = plane.intersect(camera.rays(grid))
    distance = np.linalg.norm(points, axis=-1)
    near, far = working_range
    # A plane at range d has no point nearer than d, so the near bound is exact.
    with np.errstate(invalid="ignore"):
        in_band = valid & (distance >= near) & (distance <= far * _OFF_AXIS_STRETCH)
    rise, run = _stripe_directions(points)
    axis = _search_axis(rise[0], run[0], in_band)
    if axis is SearchAxis.ALONG_X:
        in_band, rise, run = in_band.T, run.swapaxes(1, 2), rise.swapaxes(1, 2)
        n_lines, length = height, width
    else:
        n_lines, length = width, height
    slope_low, slope_high = _slope_bounds(rise, run)
    lowest, highest = _band_limits(in_band, n_lines, length)
    return StripeSearch(axis, lowest, highest, slope_low, slope_high)


def _stripe_directions(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Stripe direction (rise along y, run along x) at each grid point for several targets.

    The stripe of a target n·X = d is the contour line of n·X over the image; square first.
    """
    tilts = [np.zeros(3)]
    for sign in (-1.0, 1.0):
        tilts += [np.array([sign * _MAX_TARGET_TILT, 0.0, 0.0])]
        tilts += [np.array([0.0, 0.0, sign * _MAX_TARGET_TILT])]
    normals = np.stack([rotation_from_rotvec(tilt) @ np.array([0.0, 1.0, 0.0]) for tilt in tilts])
    with np.errstate(invalid="ignore"):
        height = np.einsum("nk,vuk->nvu", normals, points)
        along_y, along_x = np.gradient(height, axis=(1, 2))
    return -along_x, along_y


def _search_axis(rise: FloatArray, run: FloatArray, in_band: BoolArray) -> SearchAxis:
    steep = np.abs(rise) > np.abs(run)
    share = np.mean(steep[in_band]) if np.any(in_band) else 0.0
    return SearchAxis.ALONG_X if share > 0.5 else SearchAxis.ALONG_Y


def _slope_bounds(rise: FloatArray, run: FloatArray) -> tuple[FloatArray, FloatArray]:
    with np.errstate(invalid="ignore", divide="ignore"):
        slopes = rise / run
    slopes = np.where(np.isfinite(slopes), slopes, np.nan)
    known = np.isfinite(slopes).any(axis=0)
    low = np.min(np.where(np.isfinite(slopes), slopes, np.inf), axis=0)
    high = np.max(np.where(np.isfinite(slopes), slopes, -np.inf), axis=0)
    low = np.where(known, np.clip(low, -_STEEPEST, _STEEPEST), -_STEEPEST)
    high = np.where(known, np.clip(high, -_STEEPEST, _STEEPEST), _STEEPEST)
    return np.ascontiguousarray(low), np.ascontiguousarray(high)


def _band_limits(in_band: BoolArray, n_lines: int, length: int) -> tuple[IntArray, IntArray]:
    """First and last position on each line, one cell wider than the grid says."""
    any_in = in_band.any(axis=0)
    first = np.argmax(in_band, axis=0)
    last = in_band.shape[0] - 1 - np.argmax(in_band[::-1], axis=0)
    lowest = np.where(any_in, np.maximum((first - 1) * SLOPE_CELL, 0), length)
    highest = np.where(any_in, np.minimum((last + 1) * SLOPE_CELL, length - 1), -1)
    cell = np.arange(n_lines) // SLOPE_CELL
    nearest = np.minimum(lowest[cell], lowest[cell + 1])
    farthest = np.maximum(highest[cell], highest[cell + 1])
    return nearest.astype(np.int64), farthest.astype(np.int64)
