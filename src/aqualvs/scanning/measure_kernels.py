"""The arithmetic of `PostureMeter`: what is measured of a surface, and what a fit rests on."""

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel, kernel
from aqualvs.optics.sheet_kernels import sheet_distance
from aqualvs.scanning.patch_kernels import heights_over

# Two stripes disturb each other within this many full widths, and this many pixels more.
_CROSSING_WIDTHS = 1.2
_CROSSING_PX = 2.0


@kernel
def select_pieces(
    points: FloatArray,
    laser: IntArray,
    width: FloatArray,
    piece: IntArray,
    min_lines: int,
    on_target: BoolArray,
    planes: FloatArray,
    bent: FloatArray | None,
    focal_px: float,
    group: IntArray,
) -> tuple[int, int]:
    """Give numbers to pieces of stripe on the target, -1 to readings elsewhere or in crossings.

    A piece belongs as a whole: a part of a strand's light would have its centre off the sheet.

    Parameters
    ----------
    points, laser, width
        Of N readings.
    piece : int array, shape (N,)
        Number of each reading's piece: its stretch or its chunk.
    min_lines : int
        Shorter pieces are left out.
    on_target : bool array, shape (N,)
        Readings on the target.
    planes : array, shape (n_lasers, 4)
        The lasers' sheets, normal and offset.
    bent : array, shape (n_lasers, COLUMNS), or None
        The sheets, if windows bend any of them.
    focal_px : float
        Pixels per radian, roughly.
    group : int array, shape (N,)
        Written.

    Returns
    -------
    n_groups, n_readings : int
        How many groups there are, and readings in them.
    """
    number = _pieces_on(piece, min_lines, on_target)
    mean_width = _mean_widths(laser, width, piece, number, planes.shape[0])
    n_groups = 0
    n_readings = 0
    for i in range(piece.shape[0]):
        group[i] = -1
        p = piece[i]
        if number[p] == -1 or in_crossing(points, i, laser[i], planes, bent, mean_width, focal_px):
            continue
        if number[p] == -2:
            number[p] = n_groups
            n_groups += 1
        group[i] = number[p]
        n_readings += 1
    return n_groups, n_readings


@kernel
def _pieces_on(piece: IntArray, min_lines: int, on_target: BoolArray) -> IntArray:
    """Return -2 for each piece on the target that is long enough, -1 for others."""
    n_pieces = 0
    for i in range(piece.shape[0]):
        n_pieces = max(n_pieces, piece[i] + 1)
    number, lines = np.full(n_pieces, -1), np.zeros(n_pieces, np.int64)
    for i in range(piece.shape[0]):
        lines[piece[i]] += 1
        if on_target[i]:
            number[piece[i]] = -2
    for p in range(n_pieces):
        if lines[p] < min_lines:
            number[p] = -1
    return number


@kernel
def _mean_widths(
    laser: IntArray, width: FloatArray, piece: IntArray, number: IntArray, n_lasers: int
) -> FloatArray:
    """Mean stripe width of each laser; a single width is inflated by the crossing itself."""
    total, count = np.zeros(n_lasers), np.zeros(n_lasers)
    for i in range(piece.shape[0]):
        if number[piece[i]] != -1:
            total[laser[i]] += width[i]
            count[laser[i]] += 1.0
    for index in range(n_lasers):
        total[index] = total[index] / count[index] if count[index] > 0.0 else -1.0
    return total


@inline_borrowing_kernel
def in_crossing(
    points: FloatArray,
    i: int,
    own: int,
    planes: FloatArray,
    bent: FloatArray | None,
    mean_width: FloatArray,
    focal_px: float,
) -> bool:
    """Whether another laser's stripe crosses the target here (paper, section 3.1)."""
    x, y, z = points[i, 0], points[i, 1], points[i, 2]
    m_per_px = np.sqrt(x * x + y * y + z * z) / focal_px
    for b in range(planes.shape[0]):
        if b == own or mean_width[b] < 0.0:
            continue
        gap = planes[b, 0] * x + planes[b, 1] * y + planes[b, 2] * z - planes[b, 3]
        if bent is not None:
            gap = sheet_distance(bent[b], x, y, z)
        wide = max(mean_width[b], mean_width[own])
        if abs(gap) < (_CROSSING_WIDTHS * wide + _CROSSING_PX) * m_per_px:
            return True
    return False


@borrowing_kernel
def places_along(line: FloatArray, laser: IntArray, n_lines: IntArray, along: FloatArray) -> None:
    """Write places along the stripes, from -1 at one image border to 1 at the other.

    `n_lines`, shape (n_lasers,), are the search lines in the picture.
    """
    for k in range(line.shape[0]):
        along[k] = 2.0 * line[k] / n_lines[laser[k]] - 1.0


@kernel
def mark_rested_on(
    group: IntArray,
    laser: IntArray,
    weights: FloatArray,
    of_all: bool,
    points: FloatArray,
    rests_on: BoolArray,
) -> tuple[int, float, int]:
    """Mark the readings that a fit rests on.

    Parameters
    ----------
    group : int array, shape (N,)
        From `select_pieces`.
    laser : int array, shape (M,), weights : array, shape (M,)
        Of the observations.
    of_all : bool
        Whether observations without weight count for `second`.
    points : array, shape (N, 3)
        Of the readings.
    rests_on : bool array, shape (N,)
        Written.

    Returns
    -------
    n_points : int
        How many are marked.
    nearest : float
        Distance of the nearest of them from the origin.
    second : int
        Observations that the second best laser has, those without weight counted if asked for.
    """
    n, square = 0, np.inf
    for i in range(group.shape[0]):
        rests_on[i] = group[i] >= 0 and weights[group[i]] > 0.0
        if rests_on[i]:
            n += 1
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            square = min(square, x * x + y * y + z * z)
    n_lasers = 0
    for k in range(laser.shape[0]):
        n_lasers = max(n_lasers, laser[k] + 1)
    pieces = np.zeros(n_lasers, np.int64)
    for k in range(laser.shape[0]):
        pieces[laser[k]] += of_all or weights[k] > 0.0
    best, second = 0, 0
    for index in range(n_lasers):
        second = max(second, min(best, pieces[index]))
        best = max(best, pieces[index])
    return n, np.sqrt(square), second


@borrowing_kernel
def distances_off(points: FloatArray, normal: FloatArray, offset: float, off: FloatArray) -> None:
    """Write the distances of points (N, 3) from a plane, as shares of its own."""
    nx, ny, nz = normal[0] / offset, normal[1] / offset, normal[2] / offset
    for i in range(points.shape[0]):
        off[i] = abs(nx * points[i, 0] + ny * points[i, 1] + nz * points[i, 2] - 1.0)


@kernel
def mark_beside(
    source: IntArray, whole: BoolArray, off: FloatArray, most: float, beside: BoolArray
) -> None:
    """Mark the readings of a net, and those near its plane whose light the net does not explain.

    Parameters
    ----------
    source : int array, shape (N,)
        Number of each reading's return.
    whole : bool array, shape (N,)
        Readings of the net.
    off : array, shape (N,)
        From `distances_off`.
    most : float
        What is farther off is not near.
    beside : bool array, shape (N,)
        Written.
    """
    last = 0
    for i in range(source.shape[0]):
        last = max(last, source[i])
    explained = np.zeros(last + 1, np.bool_)
    for i in range(source.shape[0]):
        if whole[i]:
            explained[source[i]] = True
    for i in range(source.shape[0]):
        beside[i] = whole[i] or (off[i] < most and not explained[source[i]])


@kernel
def light_share_near(
    group: IntArray, trust: FloatArray, points: FloatArray, patch: FloatArray, near: float
) -> float:
    """Return the share of the light that is in pieces nearer to a patch than `near`, in metres.

    Parameters
    ----------
    group : int array, shape (N,)
        From `select_pieces`.
    trust : array, shape (N,)
        Of the readings.
    points : array, shape (M, 3)
        Of the pieces.
    patch : array, shape (16,)
        As `Patch.packed` gives it.
    """
    height = np.empty(points.shape[0])
    heights_over(points, patch, height)
    total, on = 0.0, 0.0
    for i in range(group.shape[0]):
        if group[i] >= 0:
            total += trust[i]
            on += trust[i] if abs(height[group[i]]) < near else 0.0
    return on / max(total, 1e-12)


@kernel
def weigh_readings(
    group: IntArray,
    m: FloatArray,
    sensitivity: FloatArray,
    sigma_px: FloatArray,
    fit_weights: FloatArray,
    alike: bool,
    weights: FloatArray,
) -> None:
    """Write what each reading weighs in a fit of m·X = 1, its piece's weight in equal shares.

    Parameters
    ----------
    group : int array, shape (N,)
        From `select_pieces`.
    m : array, shape (3,)
        Of the plane.
    sensitivity, sigma_px, fit_weights : array, shape (M, 3), (M,), (M,)
        Of the observations.
    alike : bool
        Whether the fit took all observations alike, and not by their errors.
    weights : array, shape (N,)
        Written: 1 over the variance of m·X; 0 where the fit does not rest on a reading.
    """
    count, weight = np.zeros(sigma_px.shape[0]), np.empty(sigma_px.shape[0])
    for i in range(group.shape[0]):
        if group[i] >= 0:
            count[group[i]] += 1.0
    for c in range(sigma_px.shape[0]):
        per_px = m[0] * sensitivity[c, 0] + m[1] * sensitivity[c, 1] + m[2] * sensitivity[c, 2]
        sigma = 1.0 if alike else abs(per_px) * sigma_px[c] + 1e-12
        weight[c] = fit_weights[c] / (sigma * sigma * count[c])
    for i in range(group.shape[0]):
        weights[i] = weight[group[i]] if group[i] >= 0 else 0.0
