"""Strands that the lattice predicts, one by one: seen, missed, or not to be seen.

Where the lattice lies in a frame is known, and so is where each laser's line crosses each strand.
What is lit there is a strand seen; what is dark, with light enough to either side, one missed.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import kernel
from aqualvs.scanning.net_dashes import NetView
from aqualvs.scanning.net_hypotheses import Mesh
from aqualvs.scanning.net_lattice import NetLattice

# A strand lies within this share of its pitch of where it is predicted, and at least within so many
# steps of the search lines.
_OFF, _OFF_STEPS = 0.2, 1.5
# Strands that the line crosses at a smaller sine: where, is uncertain.
_LEAST_ACROSS = 0.3
# Bars of hexagons: farther from their ends than this share of a bar, there is one, or none.
_KNOT = 0.2
# Through a hole as much light is seen on what is behind the net as elsewhere, but for this share.
_LET_THROUGH = 0.5


@dataclass(frozen=True, slots=True)
class Strands:
    """Crossings of one frame that the lattice predicts and that could be seen, N of them.

    Attributes
    ----------
    place : array, shape (N, 2)
        In `net`, in metres.
    along : array, shape (N,)
        The same on the laser's line, in metres.
    laser, family : int array, shape (N,)
        Laser, and family of the strand.
    missed : bool array, shape (N,)
        Whether it is dark there.
    run : int array, shape (N,)
        Crossings that are missed in the same dark piece; 0 for those seen.
    closed : bool array, shape (N,)
        Whether strands are seen at both ends of that piece; False for those seen.
    """

    place: FloatArray
    along: FloatArray
    laser: IntArray
    family: IntArray
    missed: BoolArray
    run: IntArray
    closed: BoolArray


def predicted_strands(lattice: NetLattice, view: NetView, place: FloatArray) -> Strands:
    """Tell which of the strands that a frame's lines must cross are there.

    Parameters
    ----------
    lattice : NetLattice
        Of the net.
    view : NetView
        What the frame shows.
    place : array, shape (2,)
        Where the lattice lies in `net` (`Shift.place`), in metres.
    """
    gaps = view.gaps
    # A hole lets light through; what is dark without is hidden by something.
    open_ = gaps.beyond >= _LET_THROUGH * view.beyond[gaps.laser]
    turns = np.abs(lattice.waves).sum(axis=0) @ np.ones(2)
    most = int(np.sum(turns * (view.span[:, 1] - view.span[:, 0]) + len(lattice.waves) + 1.0))
    row, gap = np.empty((most, 3)), np.empty((most, 3), np.int64)
    n = _predict(
        lattice.waves,
        lattice.basis,
        lattice.mesh is Mesh.SIX_SIDED,
        lattice.bar,
        np.asarray(place, np.float64),
        view.origin,
        view.direction,
        _OFF_STEPS * view.step,
        view.span_laser,
        view.span,
        gaps.laser,
        gaps.ends,
        open_,
        row,
        gap,
    )
    gap = gap[:n]
    missed = gap[:, 2] >= 0
    dark = gap[missed, 2]
    run, closed = np.zeros(n, np.int64), np.zeros(n, np.bool_)
    run[missed] = np.bincount(dark, minlength=len(gaps.laser))[dark]
    closed[missed] = gaps.closed[dark].all(axis=1)
    return Strands(row[:n, :2].copy(), row[:n, 2].copy(), gap[:, 0], gap[:, 1], missed, run, closed)


@kernel
def _predict(
    waves: FloatArray,
    basis: FloatArray,
    six_sided: bool,
    bar: float,
    place: FloatArray,
    origin: FloatArray,
    direction: FloatArray,
    least_off: FloatArray,
    span_laser: IntArray,
    span: FloatArray,
    gap_laser: IntArray,
    gap: FloatArray,
    gap_open: BoolArray,
    where: FloatArray,
    row: NDArray[np.int64],
) -> int:
    """Write (place, along) and (laser, family, gap or -1) of every crossing told; their number."""
    n = 0
    for m in range(len(span)):
        i = span_laser[m]
        for f in range(len(waves)):
            qx, qy = waves[f]
            rate = qx * direction[i, 0] + qy * direction[i, 1]
            size = np.sqrt(qx * qx + qy * qy)
            if not abs(rate) > _LEAST_ACROSS * size:
                continue
            start = qx * (origin[i, 0] - place[0]) + qy * (origin[i, 1] - place[1])
            off = max(_OFF / abs(rate), least_off[i])
            a, b = start + rate * span[m, 0], start + rate * span[m, 1]
            for number in range(int(np.ceil(min(a, b))), int(np.floor(max(a, b))) + 1):
                s = (number - start) / rate
                x = origin[i, 0] + s * direction[i, 0]
                y = origin[i, 1] + s * direction[i, 1]
                if s - off < span[m, 0] or s + off > span[m, 1]:
                    continue
                if six_sided and not _on_bar(x - place[0], y - place[1], basis, bar):
                    continue
                k = _gap_around(s, off, i, gap_laser, gap)
                if k >= 0 and not gap_open[k]:
                    continue
                where[n, 0], where[n, 1], where[n, 2] = x, y, s
                row[n, 0], row[n, 1], row[n, 2] = i, f, k
                n += 1
    return n


@kernel
def _gap_around(s: float, off: float, i: int, gap_laser: IntArray, gap: FloatArray) -> int:
    """Row of the dark piece that reaches farther than `off` to both sides of s, or -1."""
    for k in range(len(gap)):
        if gap_laser[k] == i and gap[k, 0] < s - off and gap[k, 1] > s + off:
            return k
    return -1


@kernel
def _on_bar(x: float, y: float, basis: FloatArray, bar: float) -> bool:
    """Whether a place on a line of bars of hexagons is on a bar, well within.

    A bar is as far from the middles of the two openings beside it, and farther from all others.
    """
    det = basis[0, 0] * basis[1, 1] - basis[0, 1] * basis[1, 0]
    u = np.floor(basis[0, 0] * x + basis[0, 1] * y)
    v = np.floor(basis[1, 0] * x + basis[1, 1] * y)
    first, second, third = np.inf, np.inf, np.inf
    for p in range(-1, 3):
        for q in range(-1, 3):
            a, b = u + p, v + q
            cx = (basis[1, 1] * a - basis[0, 1] * b) / det
            cy = (basis[0, 0] * b - basis[1, 0] * a) / det
            d = np.sqrt((x - cx) ** 2 + (y - cy) ** 2)
            if d < first:
                first, second, third = d, first, second
            elif d < second:
                second, third = d, second
            elif d < third:
                third = d
    return bool(second - first < 0.05 * bar and third - second > _KNOT * bar)
