"""Labels: what each stripe point was found to be."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import kernel
from aqualvs.scanning.readings import Readings
from aqualvs.scanning.scan import Label, ScanPoints
from aqualvs.scanning.surfaces import Surface

# Two stripes disturb each other within this many full widths, and this many pixels more.
_CROSSING_WIDTHS = 1.2
_CROSSING_PX = 2.0
# Readings this near to an explained return are the same light, seen by the other search.
_SAME_LIGHT_CELL_PX = 6


def crossing_zone(
    readings: Readings, planes: FloatArray, focal_px: float, candidates: BoolArray
) -> BoolArray:
    """Return which candidates lie where another laser's stripe crosses (paper, section 3.1).

    Parameters
    ----------
    readings : Readings
        N of them.
    planes : array, shape (n_lasers, 4)
        Laser planes as (normal, offset).
    focal_px : float
        Pixels per radian, roughly: turns distances on the target into pixels.
    candidates : bool array, shape (N,)
        Points on the target; others are not looked at.
    """
    zone = np.zeros(len(readings), np.bool_)
    _mark_crossings(
        readings.points, readings.laser, readings.width, planes, focal_px, candidates, zone
    )
    return zone


@kernel
def _mark_crossings(
    points: FloatArray,
    laser: IntArray,
    width: FloatArray,
    planes: FloatArray,
    focal_px: float,
    candidates: BoolArray,
    zone: BoolArray,
) -> None:
    n_lasers = planes.shape[0]
    # The mean width of each laser's stripe: a single width is inflated by the crossing itself.
    total = np.zeros(n_lasers)
    count = np.zeros(n_lasers)
    for i in range(points.shape[0]):
        if candidates[i]:
            total[laser[i]] += width[i]
            count[laser[i]] += 1.0
    for i in range(points.shape[0]):
        if not candidates[i]:
            continue
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        px_per_m = focal_px / np.sqrt(x * x + y * y + z * z)
        for b in range(n_lasers):
            if b == laser[i] or count[b] == 0.0:
                continue
            gap = abs(planes[b, 0] * x + planes[b, 1] * y + planes[b, 2] * z - planes[b, 3])
            mean_width = max(total[b] / count[b], total[laser[i]] / count[laser[i]])
            if gap * px_per_m < _CROSSING_WIDTHS * mean_width + _CROSSING_PX:
                zone[i] = True


def label_readings(
    readings: Readings,
    chunk_index: IntArray,
    surfaces: Sequence[Surface],
    target: Surface | None,
    in_posture: BoolArray,
) -> ScanPoints:
    """Label every return once, as the laser that explains it best.

    Parameters
    ----------
    readings : Readings
        N of them.
    chunk_index : int array, shape (N,)
        Row of each reading's chunk in the surfaces' `members`.
    surfaces : sequence of Surface
        All that were found.
    target : Surface or None
        The one the posture is measured to.
    in_posture : bool array, shape (N,)
        Points that the posture rests on.

    Returns
    -------
    ScanPoints
        Readings of a return that another reading explains are left out. A return that nothing
        explains is clutter, or ambiguous when several lasers could have made it.
    """
    label = np.full(len(readings), Label.CLUTTER, np.uint8)
    explained = np.zeros(len(readings), np.bool_)
    for surface in surfaces:
        on_it = surface.members[chunk_index]
        explained |= on_it
        label[on_it] = Label.AMBIGUOUS if surface is target else Label.OTHER_SURFACE
    label[in_posture] = Label.TARGET
    kept, shared = np.ones(len(readings), np.bool_), np.zeros(len(readings), np.bool_)
    if len(readings):
        _drop_explained(readings.source, readings.pixels, explained, kept, shared)
    label[shared & ~explained] = Label.AMBIGUOUS
    return _scan_points(readings.where(kept), label[kept])


@kernel
def _drop_explained(
    source: IntArray,
    pixels: FloatArray,
    explained: BoolArray,
    kept: BoolArray,
    shared: BoolArray,
) -> None:
    """Drop unexplained readings of explained light; mark returns with several readings left."""
    n = source.shape[0]
    rows = int(pixels[:, 1].max()) // _SAME_LIGHT_CELL_PX + 3
    columns = int(pixels[:, 0].max()) // _SAME_LIGHT_CELL_PX + 3
    lit = np.zeros((rows, columns), np.bool_)
    for i in range(n):
        if explained[i]:
            row = max(int(pixels[i, 1]) // _SAME_LIGHT_CELL_PX, 0)
            column = max(int(pixels[i, 0]) // _SAME_LIGHT_CELL_PX, 0)
            lit[row : row + 3, column : column + 3] = True
    readings_of = np.zeros(source.max() + 1, np.int64)
    for i in range(n):
        if not explained[i]:
            row = max(int(pixels[i, 1]) // _SAME_LIGHT_CELL_PX, 0) + 1
            column = max(int(pixels[i, 0]) // _SAME_LIGHT_CELL_PX, 0) + 1
            kept[i] = not lit[row, column]
        if kept[i]:
            readings_of[source[i]] += 1
    for i in range(n):
        shared[i] = kept[i] and readings_of[source[i]] > 1


def _scan_points(readings: Readings, label: NDArray[np.uint8]) -> ScanPoints:
    return ScanPoints(
        laser=readings.laser.astype(np.int8),
        pixels=readings.pixels,
        points_in_dome=readings.points,
        sigma=readings.sigma_px * np.sqrt(np.einsum("ij,ij->i", *[readings.sensitivity] * 2)),
        intensity=readings.height,
        width=readings.width,
        quality=np.minimum(0.1 / readings.sigma_px, 1.0),
        label=label,
    )
