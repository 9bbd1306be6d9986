"""How two surfaces share the stripes: side by side, or the one seen through the other.

A net is the only surface that another one is seen through: along a stripe, light on it takes turns
with light behind it. The flanks of a fold, which are found as planes of their own, lie side by
side, and the one begins where the other ends.
"""

from collections.abc import Sequence

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import kernel
from aqualvs.geometry.planes import Plane
from aqualvs.scanning.chunks import Chunks
from aqualvs.scanning.plane_search import WEIGHT, X, Z

# Turns along the stripes, as a share of those that light in random order takes: fewer are side by
# side, more are seen through each other if there are enough of them.
_MOST_TURNS = 0.5
_LEAST_TURNS = 0.6
_ENOUGH_TURNS = 8
# The steepest flank of a fold, and what noise adds to the step from one piece to the next, as a
# share of the range.
_STEEPEST = 2.0
_LOOSE_SHARE = 0.01
# Share of the turns at which the one must begin where the other ends.
_MOST = 0.5
# With this share of a net's light a plane is the net's, and the rest is folds in it.
_MAIN_SHARE = 0.5


def continues(plane: Plane, first: BoolArray, second: BoolArray, chunks: Chunks) -> bool:
    """Tell whether what lies on one surface goes on, side by side, as another one.

    Parameters
    ----------
    plane : Plane
        Of the first.
    first, second : bool array, shape (C,)
        Chunks on them.
    chunks : Chunks
        C of them.
    """
    packed = np.append(plane.normal, plane.offset)
    turns, at_random, met = _turns(
        chunks.table, chunks.laser, chunks.first_line, first, second, packed
    )
    return bool(0 < turns <= max(_MOST_TURNS * at_random, 1.0) and met >= _MOST * turns)


def seen_through(first: BoolArray, second: BoolArray, chunks: Chunks) -> bool:
    """Tell whether one surface is seen through the gaps of another.

    Parameters
    ----------
    first, second : bool array, shape (C,)
        Chunks on them.
    chunks : Chunks
        C of them.
    """
    turns, at_random, _ = _turns(
        chunks.table, chunks.laser, chunks.first_line, first, second, np.zeros(4)
    )
    return bool(turns >= _ENOUGH_TURNS and turns >= _LEAST_TURNS * at_random)


@kernel
def _turns(
    table: FloatArray,
    laser: IntArray,
    first_line: IntArray,
    first: BoolArray,
    second: BoolArray,
    plane: FloatArray,
) -> tuple[int, float, int]:
    """Count the turns from one surface to the other along the stripes.

    Also how many there would be in random order, and at how many the step over the plane is one
    that a fold makes.
    """
    rows = np.flatnonzero(first | second)
    order = rows[np.argsort(laser[rows] * 1_000_000 + first_line[rows])]
    turns, met, n, n_second = 0, 0, 0, 0
    at_random = 0.0
    for k in range(order.shape[0]):
        c = order[k]
        n += 1
        n_second += second[c]
        if k + 1 == order.shape[0] or laser[order[k + 1]] != laser[c]:
            at_random += 2.0 * n_second * (n - n_second) / n
            n, n_second = 0, 0
        elif second[order[k + 1]] != second[c]:
            turns += 1
            met += _meet(table, c, order[k + 1], plane)
    return turns, at_random, met


@kernel
def _meet(table: FloatArray, a: int, b: int, plane: FloatArray) -> bool:
    """Tell whether the step from one chunk to another is one that a fold makes."""
    square = 0.0
    step = 0.0
    for k in range(3):
        apart = table[k, b] - table[k, a]
        square += apart * apart
        step += plane[k] * apart
    beside = np.sqrt(max(square - step * step, 0.0))
    return bool(abs(step) <= _STEEPEST * beside + _LOOSE_SHARE * plane[3])


def joined_plane(planes: Sequence[Plane], members: Sequence[BoolArray], chunks: Chunks) -> Plane:
    """Return the plane of a net in several pieces: that of the main one, else the mean.

    Parameters
    ----------
    planes : sequence of Plane
        Of the pieces.
    members : sequence of bool array, shape (C,)
        Chunks on them.
    chunks : Chunks
        C of them.
    """
    voice = np.array([chunks.table[WEIGHT] @ mine for mine in members])
    main = int(np.argmax(voice))
    if voice[main] > _MAIN_SHARE * voice.sum():
        return planes[main]
    mine = np.logical_or.reduce(members)
    weight = np.sqrt(chunks.table[WEIGHT, mine])
    points = chunks.table[X : Z + 1, mine].T
    m = np.linalg.lstsq(weight[:, None] * points, weight)[0]
    length = float(np.linalg.norm(m))
    return Plane(m / length, 1.0 / length)
