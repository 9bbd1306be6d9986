"""The net wall unrolled into a plane: what the map and `net.geojson` are drawn in.

x is metres along the net to the right, as seen from the vehicle, from where the dive began; y is
minus the depth in metres, or, without a log, metres above the start. Where there is no track, x is
the bearing of the net in degrees.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.app.net_places import NetPlace, NetPlaces, PlacedBy
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.rig import Rig
from aqualvs.scanning.net_condition import NetStretch
from aqualvs.scanning.net_holes import Hole

# A stretch in which the vehicle moved less than this share of what the picture shows is no band.
_LEAST_MOVE = 0.15
# Bands meet in one edge where the cosine of the turn between them is above this.
_SHARP = 0.5
_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
METRES_PER_DEGREE = 0.17
"""In which widths are drawn where x is a bearing: a cage of 10 m radius."""


@dataclass(frozen=True, slots=True)
class NetWall:
    """Stretches and holes on the unrolled net.

    Attributes
    ----------
    stretches, holes : sequence
        What was found.
    places : NetPlaces
        Where.
    by_bearing : bool
        Whether x is a bearing in degrees, for want of a track.
    by_depth : bool
        Whether y is minus a depth, or metres above the start.
    outlines : list of array, shape (4, 2)
        Of what the picture passed over in every stretch: x and y, counter-clockwise.
    path : list of array, shape (n, 2)
        Of the vehicle's foot on the net: one line for every piece in which the track holds.
    holes_xy : array, shape (H, 2)
        Middles of the holes.
    """

    stretches: Sequence[NetStretch]
    holes: Sequence[Hole]
    places: NetPlaces
    by_bearing: bool
    by_depth: bool
    outlines: list[FloatArray]
    path: list[FloatArray]
    holes_xy: FloatArray


def unroll(
    stretches: Sequence[NetStretch], holes: Sequence[Hole], places: NetPlaces, rig: Rig
) -> NetWall:
    """Lay what was found into the plane of the unrolled net.

    Parameters
    ----------
    stretches, holes : sequence
        Of a dive.
    places : NetPlaces
        Theirs.
    rig : Rig
        Whose picture tells how much of the net is seen at a time.
    """
    nodes = [*places.begin[:1], *places.end]
    by_bearing = all(one.placed_by is PlacedBy.NOTHING for one in nodes) and any(
        one.bearing is not None for one in nodes
    )
    by_depth = any(one.depth is not None for one in nodes)
    y = _heights([*nodes, *places.holes], by_depth)
    x = _bearings(nodes) if by_bearing else np.array([one.along for one in nodes])
    at_nodes = np.stack([x, y[: len(nodes)]], axis=-1) if nodes else np.empty((0, 2))
    holes_x = np.array([one.along for one in places.holes])
    if by_bearing:
        when = [one.end_s for one in stretches]
        holes_x = np.interp([hole.time_s for hole in holes], when, x[1:])
    ranges = np.array([one.range for one in stretches])
    half = 0.5 * np.array(rig.size_px) / rig.focal_px * ranges[:, None]
    if by_bearing:
        half[:, 0] /= METRES_PER_DEGREE
    return NetWall(
        stretches=stretches,
        holes=holes,
        places=places,
        by_bearing=by_bearing,
        by_depth=by_depth,
        outlines=bands(at_nodes, half),
        path=_path(at_nodes, stretches),
        holes_xy=np.stack([holes_x, y[len(nodes) :]], axis=-1),
    )


def _heights(places: Sequence[NetPlace], by_depth: bool) -> FloatArray:
    """Return minus the depth; where the log has a gap the track carries it on."""
    up = np.array([one.up for one in places])
    if not by_depth:
        return up
    minus = np.array([np.nan if one.depth is None else -one.depth for one in places])
    level = float(np.nanmedian(minus - up))
    return np.where(np.isfinite(minus), minus, up + level)


def _bearings(nodes: Sequence[NetPlace]) -> FloatArray:
    """Return bearings in degrees that do not jump by a full turn."""
    found = np.array([np.nan if one.bearing is None else one.bearing for one in nodes])
    known = np.isfinite(found)
    turned = np.rad2deg(np.unwrap(found[known]))
    return np.asarray(np.interp(np.arange(len(found)), np.flatnonzero(known), turned))


def _path(nodes: FloatArray, stretches: Sequence[NetStretch]) -> list[FloatArray]:
    """Cut the vehicle's path where the track was lost."""
    pieces = np.array([one.piece for one in stretches])
    parts = np.split(np.arange(len(nodes)), np.flatnonzero(np.diff(pieces)) + 2)
    return [nodes[part] for part in parts if len(part)]


def bands(nodes: FloatArray, half: FloatArray) -> list[FloatArray]:
    """Return the outlines of what a picture passes over from node to node.

    Parameters
    ----------
    nodes : array, shape (n + 1, 2)
        Places of the picture's middle, in turn.
    half : array, shape (n, 2)
        Half its width and height on the way from each to the next.

    Returns
    -------
    outlines : list of n arrays, shape (4, 2)
        Counter-clockwise. Bands that follow each other meet in one edge, unless the way turns
        sharply; where the picture hardly moves, it is the picture itself.
    """
    moves = np.diff(nodes, axis=0)
    length = np.hypot(*moves.T)
    still = length < _LEAST_MOVE * half.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        across = np.stack([-moves[:, 1], moves[:, 0]], axis=-1) / length[:, None]
    # From the middle to the left edge: half of what the picture measures square to the way.
    reach = across * np.sum(np.abs(across) * half, axis=1)[:, None]
    reach[still] = np.nan
    found = []
    for i, (begin, end) in enumerate(itertools.pairwise(nodes)):
        if still[i]:
            found.append(0.5 * (begin + end) + _CORNERS * half[i])
            continue
        first = _edge(reach[i], reach[i - 1] if i else None)
        last = _edge(reach[i], reach[i + 1] if i + 1 < len(reach) else None)
        found.append(np.array([begin - first, end - last, end + last, begin + first]))
    return found


def _edge(reach: FloatArray, beside: FloatArray | None) -> FloatArray:
    """Return the edge that two bands share, halfway between theirs; its own after a sharp turn."""
    if beside is None or not np.isfinite(beside).all():
        return reach
    straight = float(reach @ beside) > _SHARP * float(np.hypot(*reach) * np.hypot(*beside))
    return np.asarray(0.5 * (reach + beside)) if straight else reach
