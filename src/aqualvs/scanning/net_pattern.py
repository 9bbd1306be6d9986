"""Whether the stripes on a surface are broken as those on a net are, and how far they reach."""

from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import kernel
from aqualvs.scanning.chunks import Chunks
from aqualvs.scanning.plane_search import WEIGHT

# A typical lit stretch over itself and a typical gap: below, it is a mesh. Strands of a net leave
# longer gaps than they light; a wall behind a net is lit between short shadows.
_MESH_DUTY = 0.6
# Below this the gaps are at least no specks: a dense net, or a wall in a net's shadows.
_GAPPY_DUTY = 0.9
# Lit stretches with fewer dark search lines between them are one.
_MIN_GAP_LINES = 3
_MIN_STRETCHES = 3
# So many short stretches on all lasers, and none longer, are a net of which little is seen.
_FEW_STRETCHES = 5
LONGEST_STRETCH = 0.03
"""The light on one strand is typically shorter than this, in metres."""
# A stripe with this share of its light in stretches so much longer lies on something solid that is
# partly hidden or broken by its texture; growth and strands along a laser make few of them.
_UNBROKEN_SHARE, _UNBROKEN_LENGTHS = 0.4, 2.0
# A chunk with a smaller share of its light as voice lies in a curved stretch.
_CURVED_VOICE = 0.21
# Share of the lines at each end of a stripe that may be stragglers.
_STRAGGLERS = 0.1


class Pattern(NamedTuple):
    """How the stripes on a surface are broken.

    Attributes
    ----------
    is_mesh : bool
        As on a net: two lasers (or the only one asked) show short lit stretches between longer
        gaps. One laser may run along a strand and look unbroken even on a net. Where little is
        seen, a few short stretches and nothing longer are enough.
    is_gappy : bool
        As on a dense net, or as on a wall in the shadows of a net: short stretches at any gaps.
    is_unbroken : bool
        As on something solid, if need be with gaps: on two lasers (or the only one asked) much
        of the light is in stretches longer than those on strands.
    extent : float
        Search lines over which the gappy stripes reach, summed over the lasers.
    on_strands : array, shape (n_lasers,)
        Light in stretches as short as those on a strand, and not curved.
    """

    is_mesh: bool
    is_gappy: bool
    is_unbroken: bool
    extent: float
    on_strands: FloatArray


def describe_pattern(
    chunks: Chunks, members: BoolArray, n_lasers: int, min_lines: int, focal_px: float
) -> Pattern:
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
    Pattern
    """
    on_strands = np.zeros(n_lasers)
    is_mesh, is_gappy, is_unbroken, extent = _describe(
        chunks.table,
        chunks.light,
        chunks.n_lines,
        chunks.first_line,
        chunks.last_line,
        chunks.laser,
        members,
        min_lines,
        focal_px,
        on_strands,
    )
    return Pattern(is_mesh, is_gappy, is_unbroken, extent, on_strands)


@kernel
def _describe(
    table: FloatArray,
    light: FloatArray,
    n_lines: IntArray,
    first_line: IntArray,
    last_line: IntArray,
    laser: IntArray,
    members: BoolArray,
    min_lines: int,
    focal_px: float,
    on_strands: FloatArray,
) -> tuple[bool, bool, bool, float]:
    """Write the light on strands; returns the rest of a `Pattern`."""
    asked, broken, gappy, long, unbroken, n_stretches = 0, 0, 0, 0, 0, 0
    total = 0.0
    for index in range(on_strands.shape[0]):
        order, n_mine = _in_order(first_line, n_lines, laser, members, index)
        if n_mine < min_lines:
            continue
        asked += 1
        n, duty, length, extent, on_strands[index], share = _describe_stripe(
            table, light, n_lines, first_line, last_line, order, focal_px
        )
        n_stretches += n
        unbroken += share >= _UNBROKEN_SHARE
        is_short = length < LONGEST_STRETCH
        long += not is_short
        is_gappy = n >= _MIN_STRETCHES and is_short and duty < _GAPPY_DUTY
        gappy += is_gappy
        broken += is_gappy and duty < _MESH_DUTY
        total += extent if is_gappy else 0.0
    few = not long and gappy == broken and n_stretches >= _FEW_STRETCHES
    enough = min(2, asked)
    return broken >= enough or few, gappy >= enough or few, unbroken >= enough, total


@kernel
def _in_order(
    first_line: IntArray, n_lines: IntArray, laser: IntArray, members: BoolArray, index: int
) -> tuple[IntArray, int]:
    """Return a laser's chunks on a surface in their order along the stripe, and their lines."""
    order, n, total = np.empty(members.shape[0], np.int64), 0, 0
    for c in range(members.shape[0]):
        if not members[c] or laser[c] != index:
            continue
        # Chunks come almost in order.
        at = n
        while at > 0 and first_line[order[at - 1]] > first_line[c]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = c
        n += 1
        total += n_lines[c]
    return order[:n], total


@kernel
def _describe_stripe(
    table: FloatArray,
    light: FloatArray,
    n_lines: IntArray,
    first_line: IntArray,
    last_line: IntArray,
    order: IntArray,
    focal_px: float,
) -> tuple[int, float, float, float, float, float]:
    """Stretches of one laser's stripe: number, duty, typical length (m), extent, light on strands.

    Last the share of the lit search lines that are in stretches much longer than a strand's light.

    Medians, so that what hides behind a fish or a box for a while does not count.
    """
    n = order.shape[0]
    lit, dark, distance, bright = np.empty(n), np.empty(n), np.empty(n), np.zeros(n)
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
        if table[WEIGHT, c] > _CURVED_VOICE * light[c]:
            bright[n_stretches] += light[c]
    extent = _extent(n_lines, first_line, last_line, order)
    gap = np.median(dark[:n_stretches]) if n_stretches else 0.0
    lit[n_stretches] = end - begin
    n_stretches += 1
    stretch = np.median(lit[:n_stretches])
    m_per_line = np.median(distance) / focal_px
    on_strands, all_lines, unbroken = 0.0, 0.0, 0.0
    for k in range(n_stretches):
        all_lines += lit[k]
        if lit[k] * m_per_line < LONGEST_STRETCH:
            on_strands += bright[k]
        elif lit[k] * m_per_line > _UNBROKEN_LENGTHS * LONGEST_STRETCH:
            unbroken += lit[k]
    share = float(unbroken / all_lines)
    duty = float(stretch / (stretch + gap))
    return n_stretches, duty, float(stretch * m_per_line), extent, on_strands, share


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
