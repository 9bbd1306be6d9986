"""Labels of stripe points: the kind of object that each lies on.

`label_candidates` labels candidates on the other surfaces first, then those on the target (on a net
also nearby ones that the search left out). Candidates on no surface are labelled by the shape of
their component.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import (
    inner_borrowing_kernel,
    inner_kernel,
    lazy_borrowing_kernel,
    lazy_kernel,
)
from aqualvs.geometry.linear_algebra import lower_quantile, n_bins
from aqualvs.geometry.planes import Plane
from aqualvs.scanning.candidates import Candidates, LinkedCandidates, lit_cells, number_cells
from aqualvs.scanning.patch import height_over, packed_plane
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.posture_estimator import Measurement
from aqualvs.scanning.region_growing import recruit_candidates
from aqualvs.scanning.scan import Label, ScanPoints
from aqualvs.scanning.segments import ComponentShapes, is_bent, is_round, is_straight
from aqualvs.scanning.surfaces import Surface

# Numba compiles plain numbers faster than members of an enumeration.
_NET, _SOLID, _FISH = np.uint8(Label.NET), np.uint8(Label.SOLID), np.uint8(Label.FISH)
_BUBBLE, _BACKGROUND = np.uint8(Label.BUBBLE), np.uint8(Label.BACKGROUND)
_CLUTTER, _AMBIGUOUS = np.uint8(Label.CLUTTER), np.uint8(Label.AMBIGUOUS)
_OUT_OF_RANGE = np.uint8(Label.OUT_OF_RANGE)


@lazy_kernel
def label_other(
    candidates: Candidates,
    of_candidate: IntArray,
    shapes: ComponentShapes,
    members: BoolArray,
    is_mesh: bool,
    target: FloatArray,
    explained: BoolArray,
    label: NDArray[np.uint8],
) -> None:
    """Label the candidates on a surface that is not the target, and mark them as explained.

    Parameters
    ----------
    candidates : Candidates
        N of them.
    of_candidate : int array, shape (N,)
        Row of each one's subsegment.
    shapes : ComponentShapes
        Of their components.
    members : bool array, shape (C,)
        Subsegments on the surface.
    is_mesh : bool
        As in `Surface`.
    target : array, shape (16,)
        The target as a patch; empty where there is none.
    explained : bool array, shape (N,), label : uint8 array, shape (N,)
        Completed in place.
    """
    points = candidates.points
    n, n_bent, n_behind = 0, 0, 0
    # A surface is behind the target if most candidates are. Of an even number, exactly half may be:
    # then the nearest to the target on either side decide, as in a median.
    nearest_before, nearest_behind = -np.inf, np.inf
    for i in range(points.shape[0]):
        if not members[of_candidate[i]]:
            continue
        n += 1
        n_bent += is_bent(shapes, candidates.component[i])
        if target.shape[0]:
            behind = height_over(target, points[i, 0], points[i, 1], points[i, 2])
            if behind > 0.0:
                n_behind += 1
                nearest_behind = min(nearest_behind, behind)
            else:
                nearest_before = max(nearest_before, behind)
    is_behind = 2 * n_behind > n
    if n > 0 and 2 * n_behind == n:
        is_behind = nearest_before + nearest_behind > 0.0
    kind = _BACKGROUND
    # A surface is a fish if more than this share of its candidates lie in bent components.
    mostly = 0.5
    if not is_behind:
        kind = _NET if is_mesh else _FISH if n_bent > mostly * n else _SOLID
    for i in range(points.shape[0]):
        if members[of_candidate[i]]:
            label[i] = kind
            explained[i] = True


@lazy_kernel
def label_target(
    candidates: Candidates,
    of_candidate: IntArray,
    members: BoolArray,
    is_mesh: bool,
    target: FloatArray,
    inliers: BoolArray,
    net_mask: BoolArray,
    explained: BoolArray,
    label: NDArray[np.uint8],
) -> None:
    """Label the candidates on the target, on a net also nearby ones; mark them as explained.

    Parameters
    ----------
    candidates, of_candidate, members, is_mesh, target, explained, label
        As of `label_other`, after it, for the surface that is the target.
    inliers, net_mask : bool array, shape (N,)
        As in `Measurement`; the second empty where there is none.
    """
    source = candidates.source
    n = source.shape[0]
    on_target = np.empty(n, np.bool_)
    for i in range(n):
        on_target[i] = members[of_candidate[i]]
    if is_mesh:
        taken = _of_same_peak(source, explained, explained)
        n_subsegments = members.shape[0]
        recruit_candidates(
            candidates, of_candidate, n_subsegments, target, explained, taken, on_target
        )
    for i in range(n):
        on_target[i] |= inliers[i]
    if net_mask.shape[0]:
        elsewhere = _of_same_peak(source, explained, on_target)
        for i in range(n):
            on_target[i] |= net_mask[i] and not elsewhere[i]
    for i in range(n):
        if on_target[i]:
            label[i] = _NET if is_mesh else _SOLID
            explained[i] = True


@inner_kernel
def _of_same_peak(source: IntArray, one: BoolArray, other: BoolArray) -> BoolArray:
    """Mark every candidate of those peaks of which a candidate is marked in `one` or `other`."""
    known = np.zeros(n_bins(source), np.bool_)
    for i in range(source.shape[0]):
        if one[i] or other[i]:
            known[source[i]] = True
    same = np.empty(source.shape[0], np.bool_)
    for i in range(source.shape[0]):
        same[i] = known[source[i]]
    return same


@lazy_kernel
def label_loose(
    candidates: Candidates,
    shapes: ComponentShapes,
    target: FloatArray,
    working_range: tuple[float, float],
    explained: BoolArray,
    label: NDArray[np.uint8],
    rows: IntArray,
) -> int:
    """Label candidates on no surface by their shape; select the candidates to list as points.

    Parameters
    ----------
    candidates, shapes, target
        As of `label_other`.
    working_range : (float, float)
        Distances from the dome's centre beyond which clutter is out of range, in metres.
    explained : bool array, shape (N,)
        Candidates on surfaces. Others in the same cells of the image are not listed.
    label : uint8 array, shape (N,)
        Completed in place, for listed candidates.
    rows : int array, shape (N,)
        Written: indices of the listed candidates.

    Returns
    -------
    int
        Number of listed candidates.
    """
    source = candidates.source
    n = _list_kept(source, candidates.pixels, explained, rows)
    candidates_of = np.zeros(n_bins(source), np.int64)
    for k in range(n):
        candidates_of[source[rows[k]]] += 1
    # Height of the frame's bright peaks; NaN until it is needed.
    bright, bright_quantile = np.nan, 0.9
    for k in range(n):
        i = rows[k]
        if explained[i]:
            continue
        s = candidates.component[i]
        label[i] = _AMBIGUOUS
        if candidates_of[source[i]] == 1:
            straight = is_straight(shapes, s)
            label[i] = _single_label(candidates.points, i, straight, target, working_range)
        if is_round(shapes, s, 0.0) and bright != bright:
            bright = lower_quantile(candidates.height, bright_quantile)
        if is_round(shapes, s, bright):
            label[i] = _BUBBLE
        elif is_bent(shapes, s):
            label[i] = _FISH
    return n


@inner_kernel
def _list_kept(source: IntArray, pixels: FloatArray, explained: BoolArray, rows: IntArray) -> int:
    """Write the explained candidates and those in no cell of one; return their number."""
    cells, n = number_cells(pixels), 0
    lit = lit_cells(cells, explained)
    for i in range(source.shape[0]):
        rows[n] = i
        n += explained[i] or lit[cells.of_candidate[i]] == 0
    return n


@inner_borrowing_kernel
def _single_label(
    points: FloatArray,
    i: int,
    straight: bool,
    target: FloatArray,
    working_range: tuple[float, float],
) -> np.uint8:
    """Return the label of a candidate that is the only one of its peak."""
    x, y, z = points[i, 0], points[i, 1], points[i, 2]
    if straight:
        if target.shape[0] and height_over(target, x, y, z) > 0.0:
            return _BACKGROUND
        return _SOLID
    distance = np.sqrt(x * x + y * y + z * z)
    outside = distance < working_range[0] or distance > working_range[1]
    return _OUT_OF_RANGE if outside else _CLUTTER


@lazy_borrowing_kernel
def copy_points(
    candidates: Candidates,
    rows: IntArray,
    label: NDArray[np.uint8],
    used: BoolArray,
    out_laser: NDArray[np.int8],
    out_pixels: FloatArray,
    out_points: FloatArray,
    out_measures: FloatArray,
    out_label: NDArray[np.uint8],
    out_used: BoolArray,
) -> None:
    """Write some candidates as `ScanPoints` has them.

    `out_measures`, shape (4, len(rows)), gets sigma, intensity, width and quality.
    """
    # Position error of the best peaks, which have quality 1: the floor of `Candidates.sigma_px`.
    best_sigma_px = 0.1
    pixels, sensitivity, sigma_px = candidates.pixels, candidates.sensitivity, candidates.sigma_px
    for k in range(rows.shape[0]):
        i = rows[k]
        out_laser[k], out_label[k], out_used[k] = candidates.laser[i], label[i], used[i]
        out_pixels[k, 0], out_pixels[k, 1] = pixels[i, 0], pixels[i, 1]
        square = 0.0
        for axis in range(3):
            out_points[k, axis] = candidates.points[i, axis]
            square += sensitivity[i, axis] * sensitivity[i, axis]
        out_measures[0, k] = sigma_px[i] * np.sqrt(square)
        out_measures[1, k], out_measures[2, k] = candidates.height[i], candidates.width[i]
        out_measures[3, k] = min(best_sigma_px / sigma_px[i], 1.0)


# Arguments of kernels if there is no target, and no net.
_NOTHING, _NOWHERE = np.empty(0), np.empty(0, np.bool_)


def label_candidates(
    linked: LinkedCandidates,
    surfaces: Sequence[Surface],
    target: Surface | None,
    found: Measurement,
    working_range: tuple[float, float],
) -> tuple[ScanPoints, IntArray]:
    """Label every peak once, as the laser that explains it best.

    Parameters
    ----------
    linked : LinkedCandidates
        Of a frame.
    surfaces : sequence of Surface
        All that were found.
    target : Surface or None
        The one the posture is measured to.
    found : Measurement
        The posture and its inliers.
    working_range : (float, float)
        Distances from the dome's centre, in metres, beyond which clutter is out of range.

    Returns
    -------
    points : ScanPoints
        Candidates of a peak that another candidate explains are left out. A peak that no surface
        explains is labelled by its shape, or as ambiguous if the shape is not distinctive and
        several lasers could have made it.
    listed : int array, shape (P,)
        Row of each point's candidate.
    """
    candidates, subsegments, shapes = linked
    n, of_candidate = candidates.n, subsegments.of_candidate
    label, explained = np.empty(n, np.uint8), np.zeros(n, np.bool_)
    patch = _target_surface(target, found)
    for surface in surfaces:
        if surface is not target:
            label_other(
                candidates,
                of_candidate,
                shapes,
                surface.members,
                surface.is_mesh,
                patch,
                explained,
                label,
            )
    if target is not None:
        label_target(
            candidates,
            of_candidate,
            target.members,
            target.is_mesh,
            patch,
            found.inliers,
            _NOWHERE if found.net_mask is None else found.net_mask,
            explained,
            label,
        )
    rows = np.empty(n, np.int64)
    n_listed = label_loose(candidates, shapes, patch, working_range, explained, label, rows)
    listed = rows[:n_listed]
    return _scan_points(candidates, label, found.inliers, listed), listed


def _target_surface(target: Surface | None, found: Measurement) -> FloatArray:
    """Return the best estimate of the target's surface as a patch (16,); empty if none."""
    if target is None:
        return _NOTHING
    if found.patch is not None:
        return found.patch
    posture = found.posture
    if isinstance(posture, Posture):
        return packed_plane(Plane(posture.normal_in_dome, posture.range))
    return packed_plane(target.plane)


def _scan_points(
    candidates: Candidates, label: NDArray[np.uint8], used: BoolArray, rows: IntArray
) -> ScanPoints:
    """Return the candidates of some rows as points."""
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
        candidates,
        rows,
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
