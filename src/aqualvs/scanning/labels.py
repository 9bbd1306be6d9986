"""Labels: what each stripe point was found to be."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.scanning.label_kernels import copy_points, label_loose, label_other, label_target
from aqualvs.scanning.measure import Measurement
from aqualvs.scanning.patch import packed_plane
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.readings import Readings
from aqualvs.scanning.scan import ScanPoints
from aqualvs.scanning.surfaces import Surface

# What kernels are given where there is no target, and no net.
_NOTHING, _NOWHERE = np.empty(0), np.empty(0, np.bool_)


def label_readings(
    readings: Readings,
    chunk_index: IntArray,
    surfaces: Sequence[Surface],
    target: Surface | None,
    found: Measurement,
    working_range: tuple[float, float],
) -> tuple[ScanPoints, IntArray]:
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
    found : Measurement
        The posture, and the readings that it rests on.
    working_range : (float, float)
        Distances from the dome's centre, in metres, beyond which clutter is out of range.

    Returns
    -------
    points : ScanPoints
        Readings of a return that another reading explains are left out. A return that nothing
        explains is told by its shape, and ambiguous where that says nothing and several lasers
        could have made it.
    listed : int array, shape (P,)
        Row of each point's reading.
    """
    n, shapes = len(readings), readings.shapes()
    label, explained = np.empty(n, np.uint8), np.zeros(n, np.bool_)
    facing = _facing(target, found)
    for surface in surfaces:
        if surface is not target:
            label_other(
                surface.members,
                surface.is_mesh,
                chunk_index,
                readings.stretch,
                readings.points,
                shapes,
                facing,
                explained,
                label,
            )
    if target is not None:
        label_target(
            target.members,
            target.is_mesh,
            chunk_index,
            readings.source,
            readings.points,
            readings.sensitivity,
            facing,
            found.rests_on,
            _NOWHERE if found.whole is None else found.whole,
            explained,
            label,
        )
    rows = np.empty(n, np.int64)
    n_listed = label_loose(
        readings.source,
        readings.stretch,
        readings.pixels,
        readings.points,
        readings.height,
        shapes,
        facing,
        working_range,
        explained,
        label,
        rows,
    )
    listed = rows[:n_listed]
    return _scan_points(readings, label, found.rests_on, listed), listed


def _facing(target: Surface | None, found: Measurement) -> FloatArray:
    """Return the target's surface, as well as it is known, as `Patch.packed` gives it."""
    if target is None:
        return _NOTHING
    if found.patch is not None:
        return found.patch.packed()
    posture = found.posture
    if isinstance(posture, Posture):
        return packed_plane(Plane(posture.normal_in_dome, posture.range))
    return packed_plane(target.plane)


def _scan_points(
    readings: Readings, label: NDArray[np.uint8], used: BoolArray, rows: IntArray
) -> ScanPoints:
    n = len(rows)
    measures = np.empty((4, n))
    sigma, intensity, width, quality = measures
    found = ScanPoints(
        laser=np.empty(n, np.int8),
        pixels=np.empty((n, 2)),
        points_in_dome=np.empty((n, 3)),
        sigma=sigma,
        intensity=intensity,
        width=width,
        quality=quality,
        label=np.empty(n, np.uint8),
        used=np.empty(n, np.bool_),
    )
    copy_points(
        rows,
        readings.laser,
        readings.pixels,
        readings.points,
        readings.sensitivity,
        readings.sigma_px,
        readings.height,
        readings.width,
        label,
        used,
        found.laser,
        found.pixels,
        found.points_in_dome,
        measures,
        found.label,
        found.used,
    )
    return found
