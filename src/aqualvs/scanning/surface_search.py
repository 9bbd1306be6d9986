"""The search for all surfaces of a frame: planes one after another, each with the light it takes.

The light that one plane explains is free for no other, by whichever laser it was read.
"""

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel, kernel
from aqualvs.scanning.light_cells import light_up, number_cells
from aqualvs.scanning.plane_search import (
    JX,
    JY,
    JZ,
    MOST_TO_SECOND,
    N_ROWS,
    WEIGHT,
    X,
    Y,
    Z,
    search_plane,
    squared_gate,
)

MOST_SURFACES = 5
"""So many surfaces are looked for."""
MIN_LINES_PER_LASER = 8
"""Search lines with which a laser supports a surface."""
WORTH_SHARE = 0.08
"""A surface with a smaller share of the best one's support is left-over, not a target."""
LINES, SUPPORT, VOICE = range(3)
"""What is summed over a surface: search lines on it, light, and voice."""

_MIN_CHUNKS = 6
_MIN_LINES = 30
# Planes through noise hold up to a hundredth of the light in the frame, all readings counted.
_LEAST_SHARE = 0.03


@kernel
def search_surfaces(
    table: FloatArray,
    light: FloatArray,
    n_lines: IntArray,
    laser: IntArray,
    chunk_index: IntArray,
    pixels: FloatArray,
    n_lasers: int,
    nearest: float,
    farthest: float,
    planes: FloatArray,
    members: BoolArray,
    sums: FloatArray,
) -> int:
    """Find planes that two lasers agree on, best supported first; returns how many.

    Parameters
    ----------
    table, light, n_lines, laser
        As in `Chunks`, C of them.
    chunk_index : int array, shape (N,)
        Row of each reading's chunk.
    pixels : array, shape (N, 2)
        Each reading's place in the image.
    n_lasers : int
        Lasers of the rig.
    nearest, farthest : float
        Hypotheses beyond are not considered, in metres.
    planes : array, shape (5, 4)
        Written: normals and offsets.
    members : bool array, shape (5, C)
        Written: chunks on each; False at first.
    sums : array, shape (5, 3)
        Written: search lines, light and voice of each. Of light and voice without what one laser
        has beyond three times the second.
    """
    free = np.ones(laser.shape[0], np.bool_)
    cell = np.empty(pixels.shape[0], np.int64)
    n_cells, n_columns = 0, 0
    enough = float(_MIN_LINES)
    by_laser = np.empty((3, n_lasers))
    for found in range(MOST_SURFACES):
        rows = np.flatnonzero(free)
        if np.sum(n_lines[rows]) < enough or rows.shape[0] < _MIN_CHUNKS:
            return found
        if not _find_plane(table, laser, rows, n_lasers, nearest, farthest, found, planes[found]):
            return found
        by_laser[:] = 0.0
        mine = members[found]
        n = _collect(table, rows, planes[found], n_lines, light, laser, mine, by_laser)
        supporting = np.sum(by_laser[LINES] >= MIN_LINES_PER_LASER)
        sums[found, LINES] = np.sum(by_laser[LINES])
        if n < _MIN_CHUNKS or supporting < 2 or sums[found, LINES] < _MIN_LINES:
            return found
        if np.sum(by_laser[SUPPORT]) < _LEAST_SHARE * np.sum(light):
            return found
        sums[found, SUPPORT] = on_two(by_laser[SUPPORT])
        sums[found, VOICE] = on_two(by_laser[VOICE])
        enough = max(enough, WORTH_SHARE * sums[found, LINES])
        if n_cells == 0:
            n_cells, n_columns = number_cells(pixels, cell)
        _claim_light(chunk_index, cell, n_cells, n_columns, mine, free)
    return MOST_SURFACES


@kernel
def _find_plane(
    table: FloatArray,
    laser: IntArray,
    rows: IntArray,
    n_lasers: int,
    nearest: float,
    farthest: float,
    seed: int,
    plane: FloatArray,
) -> bool:
    """Search the chunks of some rows for a plane."""
    n = rows.shape[0]
    some, its_laser = np.empty((N_ROWS, n)), np.empty(n, np.int64)
    start = np.zeros(n_lasers + 1, np.int64)
    for k in range(n):
        c = rows[k]
        for j in range(N_ROWS):
            some[j, k] = table[j, c]
        its_laser[k] = laser[c]
        start[laser[c] + 1] += 1
    for i in range(n_lasers):
        start[i + 1] += start[i]
    return search_plane(some, its_laser, start, nearest, farthest, seed, plane)


@borrowing_kernel
def _collect(
    table: FloatArray,
    rows: IntArray,
    plane: FloatArray,
    n_lines: IntArray,
    light: FloatArray,
    laser: IntArray,
    members: BoolArray,
    by_laser: FloatArray,
) -> int:
    """Mark the chunks on the plane; their number, and each laser's search lines, light, voice."""
    n = 0
    nx, ny, nz, offset = plane[0], plane[1], plane[2], plane[3]
    for k in range(rows.shape[0]):
        c = rows[k]
        residual = nx * table[X, c] + ny * table[Y, c] + nz * table[Z, c] - offset
        per_px = nx * table[JX, c] + ny * table[JY, c] + nz * table[JZ, c]
        if residual * residual < squared_gate(per_px, offset):
            members[c] = True
            by_laser[LINES, laser[c]] += n_lines[c]
            by_laser[SUPPORT, laser[c]] += light[c]
            by_laser[VOICE, laser[c]] += table[WEIGHT, c]
            n += 1
    return n


@kernel
def collect_surface(
    table: FloatArray,
    n_lines: IntArray,
    light: FloatArray,
    laser: IntArray,
    n_lasers: int,
    plane: FloatArray,
    members: BoolArray,
    sums: FloatArray,
) -> None:
    """Mark the chunks on a plane; write what `search_surfaces` writes of a surface.

    Parameters
    ----------
    table, n_lines, light, laser
        As in `Chunks`, C of them.
    n_lasers : int
        Lasers of the rig.
    plane : array, shape (4,)
        Normal and offset.
    members : bool array, shape (C,)
        Written where True; False at first.
    sums : array, shape (3,)
        Written: search lines, light and voice.
    """
    by_laser = np.zeros((3, n_lasers))
    rows = np.arange(laser.shape[0])
    _collect(table, rows, plane, n_lines, light, laser, members, by_laser)
    sums[LINES] = np.sum(by_laser[LINES])
    sums[SUPPORT] = on_two(by_laser[SUPPORT])
    sums[VOICE] = on_two(by_laser[VOICE])


@borrowing_kernel
def on_two(weight: FloatArray) -> float:
    """Sum over the lasers, the first of them with at most three times the second's share."""
    total, first, second = 0.0, 0.0, 0.0
    for i in range(weight.shape[0]):
        total += weight[i]
        second = max(second, min(first, weight[i]))
        first = max(first, weight[i])
    return min(total, total - first + MOST_TO_SECOND * second)


@kernel
def _claim_light(
    chunk_index: IntArray,
    cell: IntArray,
    n_cells: int,
    n_columns: int,
    members: BoolArray,
    free: BoolArray,
) -> None:
    """Take the members, and every other reading of the same light, out of the free chunks."""
    lit = np.zeros(n_cells, np.uint8)
    for i in range(chunk_index.shape[0]):
        if members[chunk_index[i]]:
            light_up(cell[i], n_columns, lit)
    claimed = np.zeros(free.shape[0], np.int64)
    for i in range(chunk_index.shape[0]):
        claimed[chunk_index[i]] += 1 if lit[cell[i]] else -1
    for c in range(free.shape[0]):
        if members[c] or claimed[c] > 0:
            free[c] = False
