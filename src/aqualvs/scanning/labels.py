"""Labels: what each stripe point was found to be."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel, kernel
from aqualvs.scanning.readings import Readings
from aqualvs.scanning.scan import Label, ScanPoints
from aqualvs.scanning.surfaces import Surface, in_lit_cell, lit_cells

# Position error of the best returns there are: quality 1.
_BEST_SIGMA_PX = 0.1


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
    return _scan_points(readings, label, np.flatnonzero(kept))


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
    lit = lit_cells(pixels, explained)
    readings_of = np.zeros(source.max() + 1, np.int64)
    for i in range(n):
        if not explained[i]:
            kept[i] = not in_lit_cell(pixels, i, lit)
        if kept[i]:
            readings_of[source[i]] += 1
    for i in range(n):
        shared[i] = kept[i] and readings_of[source[i]] > 1


def _scan_points(readings: Readings, label: NDArray[np.uint8], rows: IntArray) -> ScanPoints:
    found = ScanPoints(
        laser=np.empty(len(rows), np.int8),
        pixels=np.empty((len(rows), 2)),
        points_in_dome=np.empty((len(rows), 3)),
        sigma=np.empty(len(rows)),
        intensity=np.empty(len(rows)),
        width=np.empty(len(rows)),
        quality=np.empty(len(rows)),
        label=label[rows],
    )
    _copy_numbers(
        rows,
        readings.laser,
        readings.height,
        readings.width,
        found.laser,
        found.intensity,
        found.width,
    )
    _copy_places(
        rows,
        readings.pixels,
        readings.points,
        readings.sensitivity,
        readings.sigma_px,
        found.pixels,
        found.points_in_dome,
        found.sigma,
        found.quality,
    )
    return found


@borrowing_kernel
def _copy_numbers(
    rows: IntArray,
    laser: IntArray,
    height: FloatArray,
    width: FloatArray,
    out_laser: NDArray[np.int8],
    out_height: FloatArray,
    out_width: FloatArray,
) -> None:
    for k in range(rows.shape[0]):
        i = rows[k]
        out_laser[k] = laser[i]
        out_height[k] = height[i]
        out_width[k] = width[i]


@borrowing_kernel
def _copy_places(
    rows: IntArray,
    pixels: FloatArray,
    points: FloatArray,
    sensitivity: FloatArray,
    sigma_px: FloatArray,
    out_pixels: FloatArray,
    out_points: FloatArray,
    out_sigma: FloatArray,
    out_quality: FloatArray,
) -> None:
    for k in range(rows.shape[0]):
        i = rows[k]
        for axis in range(2):
            out_pixels[k, axis] = pixels[i, axis]
        square = 0.0
        for axis in range(3):
            out_points[k, axis] = points[i, axis]
            square += sensitivity[i, axis] * sensitivity[i, axis]
        out_sigma[k] = sigma_px[i] * np.sqrt(square)
        out_quality[k] = min(_BEST_SIGMA_PX / sigma_px[i], 1.0)
