"""Surfaces: planes that stripes of several lasers agree on.

One pixel may belong to the bands of several lasers. Every reading of it is triangulated; wrong
readings scatter in space, right ones share a plane. Planes are found one after another; the light
that one explains is free for no other.
"""

from dataclasses import dataclass, replace

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel, kernel
from aqualvs.geometry.planes import Plane
from aqualvs.scanning.chunks import Chunks
from aqualvs.scanning.net_pattern import describe_pattern
from aqualvs.scanning.net_pieces import continues, joined_plane, seen_through
from aqualvs.scanning.plane_search import (
    JX,
    JY,
    JZ,
    MOST_TO_SECOND,
    WEIGHT,
    X,
    Y,
    Z,
    search_plane,
    squared_gate,
)

_MAX_SURFACES = 5
_MIN_CHUNKS = 6
# Planes through noise hold up to a hundredth of the light in the frame, all readings counted.
_LEAST_SHARE = 0.03
# So much of a net's light lies on strands; that of a fish lies in long or bent stretches.
_STRANDS_SHARE = 0.4
# A wall's shadows reach nearly as far as the net that casts them.
_EXTENT_SHARE = 0.6
_MIN_LINES = 30
MIN_LINES_PER_LASER = 8
"""Search lines with which a laser supports a surface."""
WORTH_SHARE = 0.08
"""A surface with a smaller share of the best one's support is left-over, not a target."""
# Light within cells of this size is the same, by whichever laser or search it was read.
_SAME_LIGHT_CELL_PX = 6


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
        Light on it, without what one laser has beyond three times the second: a plane rests on
        two lasers.
    voice : float
        The same, but a long stretch counts as a few strands.
    extent : float
        Search lines over which its broken stripes reach, summed over the lasers, stragglers left
        out.
    is_mesh : bool
        Whether its stripes are broken as those on a net are.
    is_gappy : bool
        Whether they are broken at least, as on a dense net or in a net's shadows.
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
        All readings of all returns.
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
    surfaces: list[Surface] = []
    free = np.ones(len(chunks), np.bool_)
    enough = float(_MIN_LINES)
    for attempt in range(_MAX_SURFACES):
        if chunks.n_lines @ free < enough or np.count_nonzero(free) < _MIN_CHUNKS:
            break
        surface = _find_surface(chunks, free, n_lasers, working_range, focal_px, attempt)
        if surface is None:
            break
        surfaces.append(surface)
        enough = max(enough, WORTH_SHARE * surface.n_lines)
        _claim_light(pixels, chunk_index, surface.members, free)
    told = [
        replace(one, is_mesh=one.is_mesh or _is_dense_net(one, surfaces, chunks))
        for one in surfaces
    ]
    return _join_pieces(told, chunks)


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
    """Whether another surface, broken by shadows, is seen through the gaps of this one."""
    return surface.is_gappy and any(
        other.is_gappy
        and other.plane.offset > surface.plane.offset
        and other.extent >= _EXTENT_SHARE * surface.extent
        and seen_through(surface.members, other.members, chunks)
        for other in surfaces
    )


def _find_surface(
    chunks: Chunks,
    free: BoolArray,
    n_lasers: int,
    working_range: tuple[float, float],
    focal_px: float,
    seed: int,
) -> Surface | None:
    rows = np.flatnonzero(free)
    laser = chunks.laser[rows]
    table = np.ascontiguousarray(chunks.table[:, rows])
    laser_start = np.searchsorted(laser, np.arange(n_lasers + 1))
    plane = np.empty(4)
    if not search_plane(table, laser, laser_start, *working_range, seed, plane):
        return None
    members, sums = np.zeros(len(free), np.bool_), np.zeros((3, n_lasers))
    n_members = _collect(
        table, rows, plane, chunks.n_lines, chunks.light, chunks.laser, members, sums
    )
    lines, light, voice = sums
    n_lines = int(lines.sum())
    enough = np.count_nonzero(lines >= MIN_LINES_PER_LASER) >= 2 and n_lines >= _MIN_LINES
    if not enough or n_members < _MIN_CHUNKS:
        return None
    if light.sum() < _LEAST_SHARE * chunks.light.sum():
        return None
    support, loud = _on_two(light), _on_two(voice)
    pattern = describe_pattern(chunks, members, n_lasers, MIN_LINES_PER_LASER, focal_px)
    # Strands near the vehicle are long in search lines, and still short.
    on_strands = max(loud, _on_two(pattern.on_strands)) > _STRANDS_SHARE * support
    return Surface(
        plane=Plane(plane[:3], float(plane[3])),
        members=members,
        n_lines=n_lines,
        support=support,
        voice=loud,
        extent=pattern.extent,
        is_mesh=pattern.is_mesh and on_strands,
        is_gappy=pattern.is_gappy and on_strands,
    )


def _on_two(weight: FloatArray) -> float:
    """Sum over the lasers, the first of them with at most three times the second's share."""
    shares: list[float] = sorted(weight.tolist())
    total = sum(shares)
    return min(total, total - shares[-1] + MOST_TO_SECOND * shares[-2])


@borrowing_kernel
def _collect(
    table: FloatArray,
    rows: IntArray,
    plane: FloatArray,
    n_lines: IntArray,
    light: FloatArray,
    laser: IntArray,
    members: BoolArray,
    sums: FloatArray,
) -> int:
    """Mark the chunks on the plane; their number, and each laser's search lines, light, voice."""
    n = 0
    for k in range(rows.shape[0]):
        residual = (
            plane[0] * table[X, k] + plane[1] * table[Y, k] + plane[2] * table[Z, k] - plane[3]
        )
        per_px = plane[0] * table[JX, k] + plane[1] * table[JY, k] + plane[2] * table[JZ, k]
        if residual * residual < squared_gate(per_px, plane[3]):
            c = rows[k]
            members[c] = True
            sums[0, laser[c]] += n_lines[c]
            sums[1, laser[c]] += light[c]
            sums[2, laser[c]] += table[WEIGHT, k]
            n += 1
    return n


@kernel
def _claim_light(
    pixels: FloatArray, chunk_index: IntArray, members: BoolArray, free: BoolArray
) -> None:
    """Take the members, and every other reading of the same light, out of the free chunks."""
    lit = lit_cells(pixels, members[chunk_index])
    claimed = np.zeros(free.shape[0])
    for i in range(pixels.shape[0]):
        claimed[chunk_index[i]] += 1.0 if in_lit_cell(pixels, i, lit) else -1.0
    for c in range(free.shape[0]):
        if members[c] or claimed[c] > 0.0:
            free[c] = False


@kernel
def lit_cells(pixels: FloatArray, explained: BoolArray) -> BoolArray:
    """Mark the cells of the image in and around which explained readings lie.

    Parameters
    ----------
    pixels : array, shape (N, 2)
        In `image`.
    explained : bool array, shape (N,)
        Readings that lie on a surface.
    """
    rows = 0
    columns = 0
    for i in range(pixels.shape[0]):
        rows = max(rows, int(pixels[i, 1]) // _SAME_LIGHT_CELL_PX)
        columns = max(columns, int(pixels[i, 0]) // _SAME_LIGHT_CELL_PX)
    lit = np.zeros((rows + 3, columns + 3), np.bool_)
    for i in range(pixels.shape[0]):
        if explained[i]:
            row = max(int(pixels[i, 1]) // _SAME_LIGHT_CELL_PX, 0)
            column = max(int(pixels[i, 0]) // _SAME_LIGHT_CELL_PX, 0)
            for r in range(row, row + 3):
                for c in range(column, column + 3):
                    lit[r, c] = True
    return lit


@kernel
def in_lit_cell(pixels: FloatArray, i: int, lit: BoolArray) -> bool:
    """Whether reading `i` lies in a cell that `lit_cells` marked."""
    row = max(int(pixels[i, 1]) // _SAME_LIGHT_CELL_PX, 0) + 1
    column = max(int(pixels[i, 0]) // _SAME_LIGHT_CELL_PX, 0) + 1
    return bool(lit[row, column])
