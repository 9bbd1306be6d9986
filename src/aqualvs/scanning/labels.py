"""Labels: what each stripe point was found to be."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel, kernel
from aqualvs.geometry.planes import Plane
from aqualvs.scanning.measure import Measurement
from aqualvs.scanning.net_labels import recruit
from aqualvs.scanning.patch import Patch, flat_patch
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.readings import Readings
from aqualvs.scanning.scan import Label, ScanPoints
from aqualvs.scanning.stretch_shape import StretchShapes
from aqualvs.scanning.surfaces import Surface, in_lit_cell, lit_cells

# Position error of the best returns there are: quality 1.
_BEST_SIGMA_PX = 0.1
# A surface is a fish if this share of its light lies in bent stretches.
_MOSTLY = 0.5
_NOWHERE = np.empty(0)
# Compiled code takes numbers more easily than members of an enumeration.
_SOLID, _FISH, _BUBBLE = np.uint8(Label.SOLID), np.uint8(Label.FISH), np.uint8(Label.BUBBLE)
_BACKGROUND, _CLUTTER = np.uint8(Label.BACKGROUND), np.uint8(Label.CLUTTER)
_AMBIGUOUS, _OUT_OF_RANGE = np.uint8(Label.AMBIGUOUS), np.uint8(Label.OUT_OF_RANGE)


def label_readings(
    readings: Readings,
    chunk_index: IntArray,
    surfaces: Sequence[Surface],
    target: Surface | None,
    found: Measurement,
    working_range: tuple[float, float],
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
    found : Measurement
        The posture, and the readings that it rests on.
    working_range : (float, float)
        Distances from the dome's centre, in metres, beyond which clutter is out of range.

    Returns
    -------
    ScanPoints
        Readings of a return that another reading explains are left out. A return that nothing
        explains is told by its shape, and ambiguous where that says nothing and several lasers
        could have made it.
    """
    label = np.full(len(readings), Label.CLUTTER, np.uint8)
    if not len(readings):
        return _scan_points(readings, label, found.rests_on, np.empty(0, np.int64))
    shapes = readings.shapes()
    facing = None if target is None else _facing(target, found)
    explained = np.zeros(len(readings), np.bool_)
    for surface in surfaces:
        if surface is not target:
            on_it = surface.members[chunk_index]
            explained |= on_it
            label[on_it] = _kind(surface, on_it, readings, shapes, facing)
    if target is not None and facing is not None:
        on_target = _light_on(target, facing, readings, chunk_index, explained)
        on_target |= found.rests_on
        if found.whole is not None:
            elsewhere = _of_same_return(readings.source, explained | on_target)
            on_target |= found.whole & ~elsewhere
        label[on_target] = Label.NET if target.is_mesh else Label.SOLID
        explained |= on_target
    kept, shared = np.ones(len(readings), np.bool_), np.zeros(len(readings), np.bool_)
    _drop_explained(readings.source, readings.pixels, explained, kept, shared)
    _label_loose(label, kept & ~explained, shared, readings, shapes, facing, working_range)
    return _scan_points(readings, label, found.rests_on, np.flatnonzero(kept))


def _facing(target: Surface, found: Measurement) -> Patch:
    """Return the target's surface, as well as it is known."""
    if found.patch is not None:
        return found.patch
    posture = found.posture
    if isinstance(posture, Posture):
        return flat_patch(Plane(posture.normal_in_dome, posture.range))
    return flat_patch(target.plane)


def _light_on(
    target: Surface, facing: Patch, readings: Readings, chunk_index: IntArray, elsewhere: BoolArray
) -> BoolArray:
    """Mark the readings on the target; on a net also those that the search left out."""
    on_target = target.members[chunk_index]
    if target.is_mesh:
        recruit(
            readings.points,
            readings.sensitivity,
            chunk_index,
            len(target.members),
            facing.packed(),
            elsewhere,
            _of_same_return(readings.source, elsewhere),
            on_target,
        )
    return on_target


def _of_same_return(source: IntArray, explained: BoolArray) -> BoolArray:
    """Mark every reading of the returns that have an explained one."""
    known = np.zeros(int(source.max()) + 1, np.bool_)
    known[source[explained]] = True
    same: BoolArray = known[source]
    return same


def _kind(
    surface: Surface,
    on_it: BoolArray,
    readings: Readings,
    shapes: StretchShapes,
    target: Patch | None,
) -> Label:
    """Return what the light on a surface other than the target is on."""
    if target is not None and np.median(target.height(readings.points[on_it])) > 0.0:
        return Label.BACKGROUND
    if surface.is_mesh:
        return Label.NET
    bent = shapes.bent()[readings.stretch[on_it]]
    return Label.FISH if np.mean(bent) > _MOSTLY else Label.SOLID


def _label_loose(
    label: NDArray[np.uint8],
    loose: BoolArray,
    shared: BoolArray,
    readings: Readings,
    shapes: StretchShapes,
    target: Patch | None,
    working_range: tuple[float, float],
) -> None:
    """Label what lies on no surface by its shape, in place."""
    behind = _NOWHERE if target is None else target.height(readings.points)
    _tell_by_shape(
        loose,
        shared,
        readings.stretch,
        readings.points,
        behind,
        shapes.straight(),
        shapes.bent(),
        shapes.round(_bright(readings.height)),
        working_range,
        label,
    )


@borrowing_kernel
def _tell_by_shape(
    loose: BoolArray,
    shared: BoolArray,
    stretch: IntArray,
    points: FloatArray,
    behind: FloatArray,
    straight: BoolArray,
    bent: BoolArray,
    spot: BoolArray,
    working_range: tuple[float, float],
    label: NDArray[np.uint8],
) -> None:
    """Write the labels; `behind` is the distance behind the target, empty where there is none."""
    for i in range(loose.shape[0]):
        if not loose[i]:
            continue
        s = stretch[i]
        kind = _AMBIGUOUS
        if not shared[i]:
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            distance = np.sqrt(x * x + y * y + z * z)
            outside = distance < working_range[0] or distance > working_range[1]
            kind = _OUT_OF_RANGE if outside else _CLUTTER
            if straight[s]:
                is_behind = behind.shape[0] > 0 and behind[i] > 0.0
                kind = _BACKGROUND if is_behind else _SOLID
        if spot[s]:
            kind = _BUBBLE
        elif bent[s]:
            kind = _FISH
        label[i] = kind


def _bright(height: FloatArray) -> float:
    """Height of the frame's bright returns."""
    rank = int(0.9 * (len(height) - 1))
    return float(np.partition(height, rank)[rank])


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


def _scan_points(
    readings: Readings, label: NDArray[np.uint8], used: BoolArray, rows: IntArray
) -> ScanPoints:
    found = ScanPoints(
        laser=np.empty(len(rows), np.int8),
        pixels=np.empty((len(rows), 2)),
        points_in_dome=np.empty((len(rows), 3)),
        sigma=np.empty(len(rows)),
        intensity=np.empty(len(rows)),
        width=np.empty(len(rows)),
        quality=np.empty(len(rows)),
        label=label[rows],
        used=used[rows],
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
