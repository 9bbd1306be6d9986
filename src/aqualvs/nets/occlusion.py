"""Occlusion of the net by objects before it: from the camera, and from the lasers' light.

Only the stripes on an object are seen, not its outline; it is taken to be half as wide as they are
long. Too large an occlusion costs looks at the net, too small a one would turn fish into holes.
"""

from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import kernel
from aqualvs.scanning.scan import Label, ScanPoints

# Labels of things, at the net's plane or before it; clutter at the plane may be the net's own. A
# point that several lasers could have made may be none.
_THINGS = (Label.SOLID, Label.FISH, Label.BUBBLE)
# Light of less quality (the root of its height, as a share of the frame's best, and its likelihood)
# is too likely no laser's to hide the net: in a hole nothing else lights up, and it would keep the
# hole from being looked at. Half as high as the best, that is a likelihood of 0.18.
_LEAST_QUALITY = 0.3
# Pieces of light are on one thing where no more than so many search lines are between them, and
# no more than so many pixels along these, and as many more for each. One with this much light is no
# bubble or speck.
_BETWEEN_LINES, _BETWEEN_PX, _SLOPE_PX, _LARGE_LINES = 8, 3.0, 1.0, 40
# How far a small thing reaches beside its light: pixels, and a share of its length.
_BESIDE_PX, _BESIDE = 8.0, 0.3
# The same for a large thing, seen on the net: share of its light's length.
_HALF_WIDE = 0.5
# A shadow is longer than the light on what throws it.
_SHADOW_SHARE, _SHADOW = 0.2, 5e-3
# So many places along the light on a large thing stand for it.
_FEW = 12
# Search lines to each side of light beyond the net that it stands for.
_SPREAD_LINES = 2


@dataclass(frozen=True, slots=True)
class LaserLines:
    """The lasers' lines across the net's plane; L lasers, J search lines.

    Attributes
    ----------
    origin, direction : array, shape (L, 2)
        A place on every line in `net` and its unit direction.
    along, position, step : array, shape (L, J)
        Where each search line looks: metres along the laser's line, pixels along the search line,
        and metres of laser line that it stands for.
    """

    origin: FloatArray
    direction: FloatArray
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
    """Mark where things before the net hide it from the camera, or from the light.

    Bubbles and specks hide what they cover in the picture; larger things what is behind them as
    the camera sees it, and what they keep their own laser's light from.

    Parameters
    ----------
    points : ScanPoints
        N of them; what is labelled as on the net is never before it.
    in_net : array, shape (N, 3)
        Their places in `net`; z is the distance before the net.
    row : int array, shape (N,)
        Their search lines.
    position : array, shape (N,)
        Where they are along their search lines, in pixels.
    line_px : int array, shape (L,)
        Pixels across each laser's search lines.
    eye : array, shape (3,)
        The camera in `net`.
    sources : array, shape (L, 3)
        Roughly where each laser's light comes from, in `net`.
    lines : LaserLines
        Where the lasers' lines run.
    off : float
        What is nearer to the net's plane is on it, in metres.

    Returns
    -------
    bool array, shape (L, J)
    """
    hidden = np.zeros(lines.along.shape, np.bool_)
    before = (points.label == Label.CLUTTER) & (in_net[:, 2] > off)
    before |= np.isin(points.label, _THINGS) & (in_net[:, 2] > -off)
    before &= points.quality >= _LEAST_QUALITY
    index = np.flatnonzero(before)
    index = index[np.lexsort((row[index], points.laser[index]))]
    laser = points.laser[index].astype(np.int64)
    thing = _chain(laser, row[index], position[index])
    order = np.argsort(thing, kind="stable")
    index, laser, thing = index[order], laser[order], thing[order]
    _hide(
        thing,
        laser,
        row[index],
        position[index],
        np.ascontiguousarray(in_net[index]),
        line_px,
        eye,
        sources,
        lines.origin,
        lines.direction,
        lines.along,
        lines.position,
        hidden,
    )
    return hidden


def light_beyond(
    points: ScanPoints, in_net: FloatArray, sources: FloatArray, lines: LaserLines, off: float
) -> BoolArray:
    """Mark where light went through the net: it is seen on something behind.

    Parameters
    ----------
    points : ScanPoints
        N of them.
    in_net : array, shape (N, 3)
        Their places in `net`.
    sources : array, shape (L, 3)
        Roughly where each laser's light comes from, in `net`.
    lines : LaserLines
        Where the lasers' lines run.
    off : float
        What is nearer to the net's plane is on it, in metres.

    Returns
    -------
    bool array, shape (L, J)
    """
    beyond = np.zeros(lines.along.shape, np.bool_)
    behind = points.label == Label.BACKGROUND
    behind &= in_net[:, 2] < -off
    if behind.any():
        _mark_beyond(
            points.laser[behind].astype(np.int64),
            in_net[behind],
            sources,
            lines.origin,
            lines.direction,
            lines.along,
            beyond,
        )
    return beyond


@kernel
def _chain(laser: IntArray, row: IntArray, position: FloatArray) -> IntArray:
    """Tell the things apart, by number, that pieces of light sorted by search line are on."""
    n = len(row)
    thing = np.empty(n, np.int64)
    # Last piece of every chain that may go on.
    ends = np.empty(n, np.int64)
    n_ends, n_things = 0, 0
    for k in range(n):
        kept, best, least = 0, -1, np.inf
        for e in range(n_ends):
            last = ends[e]
            if laser[last] != laser[k] or row[k] - row[last] > _BETWEEN_LINES:
                continue
            ends[kept] = last
            between = row[k] - row[last]
            away = abs(position[k] - position[last])
            if between > 0 and away <= _BETWEEN_PX + _SLOPE_PX * between and away < least:
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
    origin: FloatArray,
    direction: FloatArray,
    along: FloatArray,
    expected: FloatArray,
    hidden: BoolArray,
) -> None:
    """Mark what things hide; their light is sorted by thing and search line."""
    first = 0
    n = len(thing)
    for k in range(1, n + 1):
        if k < n and thing[k] == thing[first]:
            continue
        i = laser[first]
        if k - first < _LARGE_LINES:
            _hide_beside(row[first:k], position[first:k], line_px[i], expected[i], hidden[i])
        else:
            _hide_behind(in_net[first:k], eye, origin, direction, along, hidden)
            _hide_in_shadow(
                in_net[first:k], sources[i], origin[i], direction[i], along[i], hidden[i]
            )
        first = k


@kernel
def _hide_beside(
    row: IntArray, position: FloatArray, line_px: int, expected: FloatArray, hidden: BoolArray
) -> None:
    """Mark where a laser's line passes, in the picture, beside its light on a small thing."""
    reach = _BESIDE_PX + _BESIDE * line_px * (row[-1] - row[0])
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


@kernel
def _cast(point: FloatArray, source: FloatArray) -> tuple[float, float]:
    """Where the ray from a source through a point meets the net."""
    share = source[2] / max(source[2] - point[2], 1e-3)
    x = source[0] + share * (point[0] - source[0])
    y = source[1] + share * (point[1] - source[1])
    return x, y


@kernel
def _hide_behind(
    in_net: FloatArray,
    eye: FloatArray,
    origin: FloatArray,
    direction: FloatArray,
    along: FloatArray,
    hidden: BoolArray,
) -> None:
    """Mark what the camera cannot see for a large thing."""
    n = len(in_net)
    on_net = np.empty((n, 2))
    for k in range(n):
        on_net[k, 0], on_net[k, 1] = _cast(in_net[k], eye)
    wide = on_net[:, 0].max() - on_net[:, 0].min()
    high = on_net[:, 1].max() - on_net[:, 1].min()
    radius = _HALF_WIDE * np.hypot(wide, high)
    for few in range(_FEW):
        x, y = on_net[few * (n - 1) // (_FEW - 1)]
        for i in range(along.shape[0]):
            # Where the line is that near to the place.
            s = (x - origin[i, 0]) * direction[i, 0] + (y - origin[i, 1]) * direction[i, 1]
            beside = (y - origin[i, 1]) * direction[i, 0] - (x - origin[i, 0]) * direction[i, 1]
            if not abs(beside) < radius:
                continue
            half = np.sqrt(radius**2 - beside**2)
            for j in range(along.shape[1]):
                if abs(along[i, j] - s) < half:
                    hidden[i, j] = True


@kernel
def _hide_in_shadow(
    in_net: FloatArray,
    source: FloatArray,
    origin: FloatArray,
    direction: FloatArray,
    along: FloatArray,
    hidden: BoolArray,
) -> None:
    """Mark what a large thing keeps its own laser's light from."""
    low, high = np.inf, -np.inf
    for k in range(len(in_net)):
        x, y = _cast(in_net[k], source)
        s = (x - origin[0]) * direction[0] + (y - origin[1]) * direction[1]
        low, high = min(low, s), max(high, s)
    margin = _SHADOW_SHARE * (high - low) + _SHADOW
    for j in range(len(along)):
        if low - margin < along[j] < high + margin:
            hidden[j] = True


@kernel
def _mark_beyond(
    laser: IntArray,
    in_net: FloatArray,
    sources: FloatArray,
    origin: FloatArray,
    direction: FloatArray,
    along: FloatArray,
    beyond: BoolArray,
) -> None:
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
            # What is farther away covers fewer search lines than where its light crossed the net.
            for j in range(known[at] - _SPREAD_LINES, known[at] + _SPREAD_LINES + 1):
                if 0 <= j < along.shape[1]:
                    beyond[i, j] = True
