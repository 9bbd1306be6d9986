"""Occlusion of the net by objects before it: from the camera, and from the lasers' light.

Only the stripes on an object are seen, not its outline; it is taken to be half as wide as they are
long. Too large an occlusion costs looks at the net, too small a one would turn fish into holes.
"""

from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import inner_kernel, kernel
from aqualvs.scanning.scan import Label, ScanPoints

# Labels of objects, at the net's plane or before it; clutter at the plane may be part of the net.
# Ambiguous points are left out: they may be wrong.
_THINGS = (Label.SOLID, Label.FISH, Label.BUBBLE)


class LaserLines(NamedTuple):
    """The lasers' lines across the net's plane; L lasers, J search lines."""

    # Shape (L, 2): a place on every line in `net` and its unit direction.
    origin: FloatArray
    direction: FloatArray
    # Shape (L, J): place of each search line: metres along the laser's line, pixels along the
    # search line, and metres of laser line per search line.
    along: FloatArray
    position: FloatArray
    step: FloatArray


def hidden_lines(
    points: ScanPoints,
    in_net: FloatArray,
    row: IntArray,
    position: FloatArray,
    line_px: IntArray,
    eye: FloatArray,
    sources: FloatArray,
    lines: LaserLines,
    off: float,
) -> BoolArray:
    """Mark where objects before the net hide it from the camera, or from the light.

    Bubbles and specks hide the area that they cover in the picture; larger objects hide the net
    behind them as the camera sees it, and the net in their own laser's shadow.

    Parameters
    ----------
    points : ScanPoints
        N of them; points labelled as on the net are never before it.
    in_net : array, shape (N, 3)
        Their places in `net`; z is the distance before the net.
    row, position : array, shape (N,)
        Their search lines, and positions along these in pixels.
    line_px : int array, shape (L,)
        Pixels across each laser's search lines.
    eye, sources : array, shape (3,) and (L, 3)
        The camera in `net`, and roughly where each laser's light comes from.
    off : float
        What is nearer to the net's plane is on it, in metres.

    Returns
    -------
    bool array, shape (L, J)
    """
    hidden = np.zeros(lines.along.shape, np.bool_)
    before = (points.label == Label.CLUTTER) & (in_net[:, 2] > off)
    before |= np.isin(points.label, _THINGS) & (in_net[:, 2] > -off)
    # Least quality of light (the root of its height, as a share of the frame's best, and its
    # likelihood) that hides the net: weaker light is probably not laser light, and in a hole, where
    # there is no other light, it would prevent looks at the hole. At half the best height, this is
    # a likelihood of 0.18.
    min_quality = 0.3
    before &= points.quality >= min_quality
    index = np.flatnonzero(before)
    index = index[np.lexsort((row[index], points.laser[index]))]
    laser = points.laser[index].astype(np.int64)
    thing = _chain(laser, row[index], position[index])
    order = np.argsort(thing, kind="stable")
    index, laser, thing = index[order], laser[order], thing[order]
    light = thing, laser, row[index], position[index], np.ascontiguousarray(in_net[index])
    _hide(*light, line_px, eye, sources, lines, hidden)
    return hidden


def light_beyond(
    points: ScanPoints, in_net: FloatArray, sources: FloatArray, lines: LaserLines, off: float
) -> BoolArray:
    """Mark where light passed through the net and is seen on something behind it, shape (L, J).

    Parameters are those of `hidden_lines`.
    """
    beyond = np.zeros(lines.along.shape, np.bool_)
    behind = points.label == Label.BACKGROUND
    behind &= in_net[:, 2] < -off
    if behind.any():
        _mark_beyond(points.laser[behind].astype(np.int64), in_net[behind], sources, lines, beyond)
    return beyond


@kernel
def _chain(laser: IntArray, row: IntArray, position: FloatArray) -> IntArray:
    """Return the number of the object that each piece of light is on, sorted by search line."""
    # Pieces of light are on one object if at most this many search lines are between them, and at
    # most this many pixels along these, plus as many for each line.
    between_lines, between_px, slope_px = 8, 3.0, 1.0
    n = len(row)
    thing = np.empty(n, np.int64)
    # Last piece of every chain that may continue.
    ends = np.empty(n, np.int64)
    n_ends, n_things = 0, 0
    for k in range(n):
        kept, best, least = 0, -1, np.inf
        for e in range(n_ends):
            last = ends[e]
            if laser[last] != laser[k] or row[k] - row[last] > between_lines:
                continue
            ends[kept] = last
            between = row[k] - row[last]
            away = abs(position[k] - position[last])
            reach = between_px + slope_px * between
            if between > 0 and away <= reach and away < least:
                best, least = kept, away
            kept += 1
        n_ends = kept
        if best < 0:
            best = n_ends
            n_ends += 1
            thing[k] = n_things
            n_things += 1
        else:
            thing[k] = thing[ends[best]]
        ends[best] = k
    return thing


@kernel
def _hide(
    thing: IntArray,
    laser: IntArray,
    row: IntArray,
    position: FloatArray,
    in_net: FloatArray,
    line_px: IntArray,
    eye: FloatArray,
    sources: FloatArray,
    lines: LaserLines,
    hidden: BoolArray,
) -> None:
    """Mark the places hidden by objects; their light is sorted by object and search line."""
    # An object with this much light is not a bubble or speck.
    large_lines = 40
    first = 0
    n = len(thing)
    for k in range(1, n + 1):
        if k < n and thing[k] == thing[first]:
            continue
        i = laser[first]
        if k - first < large_lines:
            _hide_beside(row[first:k], position[first:k], line_px[i], lines.position[i], hidden[i])
        else:
            _hide_behind(in_net[first:k], eye, lines, hidden)
            _hide_in_shadow(in_net[first:k], sources[i], lines, i, hidden[i])
        first = k


@inner_kernel
def _hide_beside(
    row: IntArray, position: FloatArray, line_px: int, expected: FloatArray, hidden: BoolArray
) -> None:
    """Mark where a laser's line passes, in the picture, beside its light on a small object."""
    # Extent of a small object beside its light: pixels, and a share of its length.
    beside_px, beside = 8.0, 0.3
    reach = beside_px + beside * line_px * (row[-1] - row[0])
    beyond = int(reach / line_px)
    at = 0
    for j in range(max(row[0] - beyond, 0), min(row[-1] + beyond + 1, len(hidden))):
        while at + 1 < len(row) and row[at + 1] <= j:
            at += 1
        middle = position[at]
        if row[at] < j and at + 1 < len(row):
            share = (j - row[at]) / (row[at + 1] - row[at])
            middle += share * (position[at + 1] - position[at])
        # False where the laser's line is not in the picture.
        if abs(expected[j] - middle) < reach:
            hidden[j] = True


@inner_kernel
def _cast(point: FloatArray, source: FloatArray) -> tuple[float, float]:
    """Return the intersection of the net with the ray from a source through a point."""
    share = source[2] / max(source[2] - point[2], 1e-3)
    x = source[0] + share * (point[0] - source[0])
    y = source[1] + share * (point[1] - source[1])
    return x, y


@inner_kernel
def _hide_behind(in_net: FloatArray, eye: FloatArray, lines: LaserLines, hidden: BoolArray) -> None:
    """Mark the places that a large object hides from the camera."""
    origin, direction, along = lines.origin, lines.direction, lines.along
    n = len(in_net)
    on_net = np.empty((n, 2))
    for k in range(n):
        on_net[k, 0], on_net[k, 1] = _cast(in_net[k], eye)
    wide = on_net[:, 0].max() - on_net[:, 0].min()
    high = on_net[:, 1].max() - on_net[:, 1].min()
    # Half the width of a large object, as a share of its light's length on the net; and number of
    # places along the light that represent it.
    half_wide, n_places = 0.5, 12
    radius = half_wide * np.hypot(wide, high)
    for few in range(n_places):
        x, y = on_net[few * (n - 1) // (n_places - 1)]
        for i in range(along.shape[0]):
            # Part of the line within that distance of the place.
            s = (x - origin[i, 0]) * direction[i, 0] + (y - origin[i, 1]) * direction[i, 1]
            beside = (y - origin[i, 1]) * direction[i, 0] - (x - origin[i, 0]) * direction[i, 1]
            if not abs(beside) < radius:
                continue
            half = np.sqrt(radius**2 - beside**2)
            for j in range(along.shape[1]):
                if abs(along[i, j] - s) < half:
                    hidden[i, j] = True


@inner_kernel
def _hide_in_shadow(
    in_net: FloatArray, source: FloatArray, lines: LaserLines, i: int, hidden: BoolArray
) -> None:
    """Mark the places of line `i` in the shadow of a large object in its own laser's light."""
    origin, direction, along = lines.origin[i], lines.direction[i], lines.along[i]
    low, high = np.inf, -np.inf
    for k in range(len(in_net)):
        x, y = _cast(in_net[k], source)
        s = (x - origin[0]) * direction[0] + (y - origin[1]) * direction[1]
        low, high = min(low, s), max(high, s)
    # A shadow is longer than the light on its object.
    shadow_share, shadow = 0.2, 5e-3
    margin = shadow_share * (high - low) + shadow
    for j in range(len(along)):
        if low - margin < along[j] < high + margin:
            hidden[j] = True


@kernel
def _mark_beyond(
    laser: IntArray, in_net: FloatArray, sources: FloatArray, lines: LaserLines, beyond: BoolArray
) -> None:
    origin, direction, along = lines.origin, lines.direction, lines.along
    # Search lines to each side of light beyond the net that it represents.
    spread_lines = 2
    for i in range(along.shape[0]):
        known = np.flatnonzero(np.isfinite(along[i]))
        if len(known) < 2:
            continue
        if along[i, known[-1]] < along[i, known[0]]:
            known = known[::-1]
        s = along[i][known]
        for k in range(len(laser)):
            if laser[k] != i:
                continue
            x, y = _cast(in_net[k], sources[i])
            at = np.searchsorted(
                s, (x - origin[i, 0]) * direction[i, 0] + (y - origin[i, 1]) * direction[i, 1]
            )
            if at == 0 or at == len(known):
                continue
            # Farther objects cover fewer search lines than the place where their light crossed.
            for j in range(known[at] - spread_lines, known[at] + spread_lines + 1):
                if 0 <= j < along.shape[1]:
                    beyond[i, j] = True
