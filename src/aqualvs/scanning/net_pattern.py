"""Whether the stripes on a surface are broken as those on a net are, and how far they reach."""

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import kernel
from aqualvs.scanning.chunks import Chunks

# A typical lit stretch over itself and a typical gap: below, it is a mesh. Strands of a net leave
# longer gaps than they light; a wall behind a net is lit between short shadows.
_MESH_DUTY = 0.6
# Lit stretches with fewer dark search lines between them are one.
_MIN_GAP_LINES = 3
_MIN_STRETCHES = 3
# The light on one strand is typically shorter than this, in metres.
_LONGEST_STRETCH = 0.03
# Share of the lines at each end of a stripe that may be stragglers.
_STRAGGLERS = 0.1


def describe_pattern(
    chunks: Chunks, members: BoolArray, n_lasers: int, min_lines: int, focal_px: float
) -> tuple[bool, float]:
    """Describe the stripes on a surface.

    Parameters
    ----------
    chunks : Chunks
        C of them.
    members : bool array, shape (C,)
        Those on the surface.
    n_lasers : int
        Lasers of the rig.
    min_lines : int
        Lasers with fewer search lines on the surface are not asked.
    focal_px : float
        Pixels per radian, roughly.

    Returns
    -------
    is_mesh : bool
        Whether at least two lasers (or the only one asked) show broken stripes. One laser may run
        along a strand and look unbroken even on a net.
    extent : float
        Search lines over which the broken stripes reach, summed over the lasers.
    """
    asked = 0
    broken = 0
    total = 0.0
    for index in range(n_lasers):
        mine = np.flatnonzero(members & (chunks.laser == index))
        if chunks.n_lines[mine].sum() < min_lines:
            continue
        asked += 1
        order = mine[np.argsort(chunks.first_line[mine])]
        is_broken, extent = _describe_stripe(
            chunks.table, chunks.n_lines, chunks.first_line, chunks.last_line, order, focal_px
        )
        broken += is_broken
        total += extent if is_broken else 0.0
    return broken >= min(2, asked), total


@kernel
def _describe_stripe(
    table: FloatArray,
    n_lines: IntArray,
    first_line: IntArray,
    last_line: IntArray,
    order: IntArray,
    focal_px: float,
) -> tuple[bool, float]:
    """Whether one laser's stripe is broken as on a net, and its extent in search lines.

    Medians, so that what hides behind a fish or a box for a while does not count.
    """
    n = order.shape[0]
    lit, dark, distance = np.empty(n), np.empty(n), np.empty(n)
    n_stretches = 0
    begin = first_line[order[0]]
    end = last_line[order[0]] + 1
    for k in range(n):
        c = order[k]
        distance[k] = np.sqrt(table[0, c] ** 2 + table[1, c] ** 2 + table[2, c] ** 2)
        gap = first_line[c] - end
        if gap >= _MIN_GAP_LINES:
            lit[n_stretches] = end - begin
            dark[n_stretches] = gap
            n_stretches += 1
            begin = first_line[c]
        end = max(end, last_line[c] + 1)
    extent = _extent(n_lines, first_line, last_line, order)
    if n_stretches + 1 < _MIN_STRETCHES:
        return False, extent
    gap = np.median(dark[:n_stretches])
    lit[n_stretches] = end - begin
    stretch = np.median(lit[: n_stretches + 1])
    length = stretch / focal_px * np.median(distance)
    is_broken = stretch < _MESH_DUTY * (stretch + gap) and length < _LONGEST_STRETCH
    return bool(is_broken), extent


@kernel
def _extent(n_lines: IntArray, first_line: IntArray, last_line: IntArray, order: IntArray) -> float:
    """Search lines between the 10 % and the 90 % point of one laser's light."""
    total = 0
    for k in range(order.shape[0]):
        total += n_lines[order[k]]
    seen = 0
    begin = 0
    end = 0
    for k in range(order.shape[0]):
        c = order[k]
        if seen <= _STRAGGLERS * total:
            begin = first_line[c]
        if seen < (1.0 - _STRAGGLERS) * total:
            end = last_line[c]
        seen += n_lines[c]
    return float(end - begin + 1)
