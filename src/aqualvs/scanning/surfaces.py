"""Surfaces of a frame: planes that the stripes of several lasers agree on.

One pixel may belong to the bands of several lasers. Every candidate of it is triangulated; wrong
candidates scatter in space, right ones share a plane. Planes are found one after another; light
that one explains is not available to the next, whichever laser it was read as.

Light is identified by cells of the image: one peak yields candidates of several lasers, and one
stripe may be found by two search directions, so candidates in or beside a cell in which a surface
has light count as the same light.
"""

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel, kernel
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.quantile import sum_of
from aqualvs.scanning.candidates import Chunks
from aqualvs.scanning.net_surfaces import continues, describe_pattern, joined_plane, seen_through
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

U8Array: TypeAlias = NDArray[np.uint8]

# Marks of a cell: light beside it at least, or light in it.
_BESIDE, _MIDDLE = np.uint8(1), np.uint8(2)
# Light within cells of six pixels is the same, whichever laser or search it was read by.
_SIXTH_BITS = 18
_SIXTH = (1 << _SIXTH_BITS) // 6 + 1


@inline_borrowing_kernel
def _cell(coordinate: float) -> int:
    """Return the row or column of the cell of a coordinate, from 1; there is a margin of one."""
    # Division by six by multiplication, for whole numbers below a hundred thousand.
    return (int(max(coordinate, 0.0)) * _SIXTH >> _SIXTH_BITS) + 1


@kernel
def number_cells(pixels: FloatArray, cell: IntArray) -> tuple[int, int]:
    """Write the number of the cell in which each of N readings lies.

    Parameters
    ----------
    pixels : array, shape (N, 2)
        In `image`.
    cell : int array, shape (N,)
        Written.

    Returns
    -------
    n_cells, n_columns : int
        Cells in total, and in a row; cells are numbered row by row, as the pixels of a picture.
    """
    right, low = 0.0, 0.0
    for i in range(pixels.shape[0]):
        right, low = max(right, pixels[i, 0]), max(low, pixels[i, 1])
    n_columns = _cell(right) + 2
    for i in range(pixels.shape[0]):
        cell[i] = _cell(pixels[i, 1]) * n_columns + _cell(pixels[i, 0])
    return (_cell(low) + 2) * n_columns, n_columns


@inline_borrowing_kernel
def light_up(middle: int, n_columns: int, lit: U8Array) -> None:
    """Mark a cell and those around it, as far as they lie in `lit`, with nonzero values."""
    if lit[middle] == _MIDDLE:
        return
    for row in (middle - n_columns, middle, middle + n_columns):
        for near in range(row - 1, row + 2):
            lit[near] = max(lit[near], _BESIDE)
    lit[middle] = _MIDDLE


@kernel
def lit_cells(cell: IntArray, explained: BoolArray, n_cells: int, n_columns: int) -> U8Array:
    """Mark the cells in and around which explained candidates lie, with nonzero values.

    Parameters
    ----------
    cell, n_cells, n_columns
        From `number_cells`.
    explained : bool array, shape (N,)
        Readings that lie on a surface.
    """
    lit = np.zeros(n_cells, np.uint8)
    for i in range(cell.shape[0]):
        if explained[i]:
            light_up(cell[i], n_columns, lit)
    return lit


MOST_SURFACES = 5
"""Largest number of surfaces in a frame."""
MIN_LINES_PER_LASER = 8
"""Least number of search lines with which a laser supports a surface."""
WORTH_SHARE = 0.08
"""Least support of a surface, as a share of the best one's; less is left-over light."""
LINES, SUPPORT, VOICE = range(3)
"""Sums over a surface: search lines on it, light, and sampling weight."""

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
    """Find planes that two lasers agree on, best supported first; return their number.

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
        Limits of the hypotheses, in metres.
    planes : array, shape (5, 4)
        Written: normals and offsets.
    members : bool array, shape (5, C)
        Written: chunks on each; False at first.
    sums : array, shape (5, 3)
        Written: search lines, light and sampling weight of each. Light and weight of the best laser
        count up to three times those of the second.
    """
    free = np.ones(laser.shape[0], np.bool_)
    cell = np.empty(pixels.shape[0], np.int64)
    n_cells, n_columns = 0, 0
    enough = float(_MIN_LINES)
    by_laser = np.empty((3, n_lasers))
    for found in range(MOST_SURFACES):
        rows = np.flatnonzero(free)
        if sum_of(n_lines[rows]) < enough or rows.shape[0] < _MIN_CHUNKS:
            return found
        if not _find_plane(table, laser, rows, n_lasers, nearest, farthest, found, planes[found]):
            return found
        by_laser[:] = 0.0
        mine = members[found]
        n = _collect(table, rows, planes[found], n_lines, light, laser, mine, by_laser)
        supporting = np.count_nonzero(by_laser[LINES] >= MIN_LINES_PER_LASER)
        sums[found, LINES] = sum_of(by_laser[LINES])
        if n < _MIN_CHUNKS or supporting < 2 or sums[found, LINES] < _MIN_LINES:
            return found
        if sum_of(by_laser[SUPPORT]) < _LEAST_SHARE * sum_of(light):
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
    """Mark the chunks on the plane; return their number, and each laser's lines, light, weight."""
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
    """Mark the chunks on a plane; write the sums of its surface as `search_surfaces` does.

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
        Written: search lines, light and sampling weight.
    """
    by_laser = np.zeros((3, n_lasers))
    rows = np.arange(laser.shape[0])
    _collect(table, rows, plane, n_lines, light, laser, members, by_laser)
    sums[LINES] = sum_of(by_laser[LINES])
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
    """Remove the members, and every other candidate of the same light, from the free chunks."""
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


__all__ = (
    "MIN_LINES_PER_LASER",
    "WORTH_SHARE",
    "Surface",
    "find_surfaces",
    "shares_light",
    "surface_on",
)

# Least share of a net's light on strands; that of a fish lies in long or bent stretches.
_STRANDS_SHARE = 0.4
# A wall's shadows reach nearly as far as the net that casts them.
_EXTENT_SHARE = 0.6
# With more of its search lines on another surface it is a part of that one.
_SHARED = 0.5


@dataclass(frozen=True, slots=True)
class Surface:
    """A plane that chunks of at least two lasers agree on.

    Attributes
    ----------
    plane : Plane
        In `dome`, offset > 0.
    members : bool array, shape (C,)
        Chunks on it.
    n_lines : int
        Search lines on it.
    support : float
        Inlier weight: light on it, that of the best laser up to three times the second's, because
        a plane needs two lasers.
    voice : float
        Sampling weight: the same, but a long stretch counts as a few strands.
    extent : float
        Search lines over which its broken stripes reach, summed over the lasers, stragglers left
        out.
    is_mesh : bool
        Whether its stripes are broken as those on a net are.
    is_gappy : bool
        Whether they are broken at least, as on a dense net or in a net's shadows.
    is_unbroken : bool
        Whether much of the light is in long stretches all the same, as on a table with gaps.
    n_pieces : int
        Planes that were joined, because a folded or bent net goes on from one to the next. `plane`
        is then that of the largest, or their mean where none of them has half of the light.
    """

    plane: Plane
    members: BoolArray
    n_lines: int
    support: float
    voice: float
    extent: float
    is_mesh: bool
    is_gappy: bool = False
    is_unbroken: bool = False
    n_pieces: int = 1


def find_surfaces(
    chunks: Chunks,
    chunk_index: IntArray,
    pixels: FloatArray,
    n_lasers: int,
    working_range: tuple[float, float],
    focal_px: float,
) -> list[Surface]:
    """Find the planes in a frame, best supported first.

    Parameters
    ----------
    chunks : Chunks
        Of all candidates.
    chunk_index : int array, shape (N,)
        Row of each reading's chunk.
    pixels : array, shape (N, 2)
        Each reading's place in the image.
    n_lasers : int
        Lasers of the rig.
    working_range : (float, float)
        Hypotheses nearer or farther are not considered, in metres.
    focal_px : float
        Pixels per radian, roughly: turns search lines into lengths on the surface.

    Returns
    -------
    list of Surface
        Deterministic: the same chunks give the same surfaces.
    """
    planes, sums = np.empty((MOST_SURFACES, 4)), np.empty((MOST_SURFACES, 3))
    members = np.zeros((MOST_SURFACES, len(chunks)), np.bool_)
    n = search_surfaces(
        chunks.table,
        chunks.light,
        chunks.n_lines,
        chunks.laser,
        chunk_index,
        pixels,
        n_lasers,
        *working_range,
        planes,
        members,
        sums,
    )
    surfaces = [
        _describe(chunks, planes[i], members[i], sums[i], n_lasers, focal_px) for i in range(n)
    ]
    if n < 2:
        return surfaces
    told = [
        replace(one, is_mesh=True) if _is_dense_net(one, surfaces, chunks) else one
        for one in surfaces
    ]
    return _join_pieces(told, chunks)


def surface_on(plane: Plane, chunks: Chunks, n_lasers: int, focal_px: float) -> Surface:
    """Return the surface of all chunks on a plane, even if other surfaces explain their light.

    Parameters
    ----------
    plane : Plane
        In `dome`, offset > 0.
    chunks, n_lasers, focal_px
        As in `find_surfaces`.
    """
    packed, members = np.append(plane.normal, plane.offset), np.zeros(len(chunks), np.bool_)
    sums = np.empty(3)
    collect_surface(
        chunks.table, chunks.n_lines, chunks.light, chunks.laser, n_lasers, packed, members, sums
    )
    return _describe(chunks, packed, members, sums, n_lasers, focal_px)


def shares_light(one: Surface, other: Surface, chunks: Chunks) -> bool:
    """Return whether half of a surface's chunks are on another one as well."""
    shared = chunks.n_lines[one.members & other.members].sum()
    return bool(shared > _SHARED * chunks.n_lines[one.members].sum())


def _describe(
    chunks: Chunks,
    plane: FloatArray,
    members: BoolArray,
    sums: FloatArray,
    n_lasers: int,
    focal_px: float,
) -> Surface:
    """Make a surface from a plane and its chunks."""
    lines, support, voice = sums.tolist()
    pattern = describe_pattern(chunks, members, n_lasers, MIN_LINES_PER_LASER, focal_px)
    # Strands near the vehicle are long in search lines, and still short.
    on_strands = max(voice, on_two(pattern.on_strands)) > _STRANDS_SHARE * support
    return Surface(
        plane=Plane(plane[:3], float(plane[3])),
        members=members,
        n_lines=int(lines),
        support=support,
        voice=voice,
        extent=pattern.extent,
        is_mesh=pattern.is_mesh and on_strands,
        is_gappy=pattern.is_gappy and on_strands,
        is_unbroken=pattern.is_unbroken,
    )


def _join_pieces(surfaces: list[Surface], chunks: Chunks) -> list[Surface]:
    """Join planes that are pieces of one net; the others stay as they are."""
    rest, done = list(surfaces), []
    while rest:
        net = rest.pop(0)
        pieces = [net]
        while net.is_mesh:
            more = [
                one
                for one in rest
                if one.is_mesh
                and any(continues(p.plane, p.members, one.members, chunks) for p in pieces)
            ]
            if not more:
                break
            pieces += more
            rest = [one for one in rest if all(one is not piece for piece in more)]
        done.append(_joined(pieces, chunks) if len(pieces) > 1 else net)
    return done


def _joined(pieces: list[Surface], chunks: Chunks) -> Surface:
    members = [piece.members for piece in pieces]
    return Surface(
        plane=joined_plane([piece.plane for piece in pieces], members, chunks),
        members=np.logical_or.reduce(members),
        n_lines=sum(piece.n_lines for piece in pieces),
        support=sum(piece.support for piece in pieces),
        voice=sum(piece.voice for piece in pieces),
        extent=max(piece.extent for piece in pieces),
        is_mesh=True,
        is_gappy=True,
        n_pieces=len(pieces),
    )


def _is_dense_net(surface: Surface, surfaces: list[Surface], chunks: Chunks) -> bool:
    """Return whether another surface, broken by shadows, is seen through the gaps of this one.

    A net that is near may fill most of the stripes; it then has more light than what it shadows.
    """
    return not surface.is_mesh and any(
        other.is_gappy
        and (surface.is_gappy or surface.support > other.support)
        and other.plane.offset > surface.plane.offset
        and other.extent >= _EXTENT_SHARE * surface.extent
        and seen_through(surface.members, other.members, chunks)
        for other in surfaces
    )
