"""Surfaces: planes that stripes of several lasers agree on.

One pixel may belong to the bands of several lasers. Every reading of it is triangulated; wrong
readings scatter in space, right ones share a plane. Planes are found one after another; the light
that one explains is free for no other.
"""

from dataclasses import dataclass, replace

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.scanning.chunks import Chunks
from aqualvs.scanning.net_pattern import describe_pattern
from aqualvs.scanning.net_pieces import continues, joined_plane, seen_through
from aqualvs.scanning.surface_search import (
    MIN_LINES_PER_LASER,
    MOST_SURFACES,
    WORTH_SHARE,
    collect_surface,
    on_two,
    search_surfaces,
)

__all__ = (
    "MIN_LINES_PER_LASER",
    "WORTH_SHARE",
    "Surface",
    "find_surfaces",
    "shares_light",
    "surface_on",
)

# So much of a net's light lies on strands; that of a fish lies in long or bent stretches.
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
    """Return the surface of all chunks on a plane, whatever else explains their light.

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
    """Tell whether half of a surface's chunks are on another one as well."""
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
    """Make a surface of what was found."""
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
    """Whether another surface, broken by shadows, is seen through the gaps of this one.

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
