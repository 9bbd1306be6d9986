"""Power of plane waves in where lasers cross the strands of a net.

Strands of one family are parallel and evenly spaced, so their crossings with the lasers' lines all
have nearly one phase in a plane wave whose crests are the strands. The power of such waves, summed
over frames, peaks at the families' wave vectors, wherever the net was in each frame. Uneven cover
(the lasers' lines themselves) would peak as well; it is taken out by comparing with crossings
spread evenly over what could be seen. Power spectra of point processes: Bartlett, J. R. Stat. Soc.
B 25 (1963) 264, doi:10.1111/j.2517-6161.1963.tb00508.x.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.scanning.net_likelihood import HIGHEST
from aqualvs.scanning.net_waves import comb_power, crest_phases, expected_on, off_crests

LARGEST_PITCH = 0.09
"""Distance between parallel strands up to which they are looked for, in metres."""
N_ANGLES = 180
"""Directions of waves in half a turn."""
STEP = 0.9
"""Step of the spectrum, in periods a metre."""

_ALONG: FloatArray = np.arange(-HIGHEST, HIGHEST + STEP, STEP)
_UPWARD: FloatArray = np.arange(-2.0 * STEP, HIGHEST + STEP, STEP)
# On the grid evenly spread crossings are so far apart, in metres: their own period is beyond its
# end. The grid shows where to look, so some of the frames are enough.
_APART = 7.5e-3
_MOST_ON_GRID = 12


Swings: TypeAlias = NDArray[np.complex64]


@dataclass(frozen=True, slots=True)
class Crossings:
    """Where one frame's lasers cross strands, and where they would have been seen.

    Attributes
    ----------
    place : array, shape (N, 2)
        Middles of the dashes in `net`, metres.
    laser : int array, shape (N,)
        Index of the laser.
    begin, end : array, shape (M, 2)
        Ends of the pieces of line that could be seen, in `net`, metres.
    span_laser : int array, shape (M,)
        Index of the laser of each of them.
    direction : array, shape (L, 2)
        Of the lasers' lines; NaN where there is none.
    length : array, shape (L,)
        Metres of line that could be seen.
    lit : float
        Share of it that is lit: so many crossings merge with others.
    """

    place: FloatArray
    laser: IntArray
    begin: FloatArray
    end: FloatArray
    span_laser: IntArray
    direction: FloatArray
    length: FloatArray
    lit: float


class Spectrum:
    """Power of plane waves in the crossings of some frames; 1 is what random ones have.

    Parameters
    ----------
    place, line, start : array, int array, int array
        Crossings (N, 2), the number of the line that each lies on (N,), counted through all
        frames, and where each frame's begin (F + 1,).
    begin, end, span_line, span_start : array, array, int array, int array
        The same for pieces of line that could be seen.
    lines : array, shape (n, 3)
        Direction and seen length of every line; zero where there is none.
    laser : int array, shape (n,)
        Its laser.
    lit : float
        Share of the lines that is lit.

    Attributes
    ----------
    place, line, start, begin, end, span_line, span_start, lines, laser, lit
        As given.
    expected : array, shape (M,)
        Crossings on every piece if those of its line were spread evenly.
    n_frames, n_crossings : int
        Frames and all crossings.
    per_frame : float
        Crossings in a frame, on average.
    seen : array, shape (L,)
        Crossings of each laser.
    """

    def __init__(
        self,
        place: FloatArray,
        line: IntArray,
        start: IntArray,
        begin: FloatArray,
        end: FloatArray,
        span_line: IntArray,
        span_start: IntArray,
        lines: FloatArray,
        laser: IntArray,
        lit: float,
    ) -> None:
        self.place, self.line, self.start = place, line, start
        self.begin, self.end = begin, end
        self.span_line, self.span_start = span_line, span_start
        self.lines, self.laser, self.lit = lines, laser, lit
        self.n_frames = len(start) - 1
        self.n_crossings = len(place)
        self.per_frame = self.n_crossings / self.n_frames
        seen = np.bincount(line, minlength=len(lines))
        self.expected = expected_on(line, begin, end, span_line, len(lines))
        self.seen = np.bincount(laser, seen, minlength=laser.max(initial=0) + 1)

    @classmethod
    def of(cls, frames: Sequence[Crossings]) -> "Spectrum":
        """Join frames."""
        n_lasers = len(frames[0].length)
        return cls(
            np.concatenate([f.place for f in frames]),
            np.concatenate([f.laser + i * n_lasers for i, f in enumerate(frames)]),
            np.cumsum([0, *(len(f.place) for f in frames)]),
            np.concatenate([f.begin for f in frames]),
            np.concatenate([f.end for f in frames]),
            np.concatenate([f.span_laser + i * n_lasers for i, f in enumerate(frames)]),
            np.cumsum([0, *(len(f.begin) for f in frames)]),
            np.nan_to_num(np.concatenate([np.c_[f.direction, f.length] for f in frames])),
            np.tile(np.arange(n_lasers), len(frames)),
            float(np.mean([f.lit for f in frames])),
        )

    def without(self, wave: FloatArray) -> "Spectrum":
        """Return the spectrum of what does not lie on the crests of a wave."""
        phase = crest_phases(self.place, self.start, wave[0], wave[1])
        kept, start, begin, end, origin, span_start = off_crests(
            self.place,
            self.start,
            self.begin,
            self.end,
            self.span_start,
            phase,
            wave[0],
            wave[1],
        )
        return Spectrum(
            self.place[kept],
            self.line[kept],
            start,
            begin,
            end,
            self.span_line[origin],
            span_start,
            self.lines,
            self.laser,
            self.lit,
        )

    def _on_grid(self, most: int) -> FloatArray:
        """Power over the upper half plane, some rows more; the rest of the plane is its mirror."""
        power = np.zeros((len(_ALONG), len(_UPWARD)), np.float32)
        count = 0
        every = max(1, -(-self.n_frames // most))
        frames = list(zip(pairwise(self.start), pairwise(self.span_start), strict=True))
        for (first, last), (from_, to) in frames[::every]:
            even, weight = self._evenly_spread(from_, to)
            place = np.concatenate([self.place[first:last], even])
            x = _swings(place[:, 0], _ALONG[0], len(_ALONG))
            x *= np.r_[np.ones(last - first), -weight].astype(np.float32)[:, None]
            amplitude = x.T @ _swings(place[:, 1], _UPWARD[0], len(_UPWARD))
            power += amplitude.real**2 + amplitude.imag**2
            count += last - first
        return power.astype(np.float64) / max(count, 1)

    def _evenly_spread(self, first: int, last: int) -> tuple[FloatArray, FloatArray]:
        """Places spread over some spans, and how many crossings each of them stands for."""
        begin, end = self.begin[first:last], self.end[first:last]
        length = np.hypot(*(end - begin).T)
        pieces = np.maximum(np.ceil(length / _APART), 1.0).astype(np.int64)
        number = np.repeat(np.arange(len(pieces)), pieces)
        share = np.arange(len(number)) - np.repeat(np.cumsum(pieces) - pieces, pieces) + 0.5
        share /= pieces[number]
        place = begin[number] + share[:, None] * (end - begin)[number]
        return place, (self.expected[first:last] / pieces)[number]

    def at(self, wave: FloatArray, n_harmonics: int = 1) -> FloatArray:
        """Power at the first harmonics of a wave, shape (n_harmonics,), exactly."""
        power = np.zeros(n_harmonics)
        comb_power(
            self.place,
            self.start,
            self.begin,
            self.end,
            self.expected,
            self.span_start,
            wave[0],
            wave[1],
            power,
        )
        return power / max(self.n_crossings, 1)

    def polar(self, most: int = _MOST_ON_GRID) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Power at sizes (K,) and directions (A,) of waves, the highest nearby, shape (K, A).

        So many frames at most are looked at, evenly spread.
        """
        highest: FloatArray = maximum_filter(self._on_grid(most), 3)
        step = 0.5 * STEP
        n_sizes = int((HIGHEST - 2.0 * STEP - 0.5 / LARGEST_PITCH) / step)
        size: FloatArray = 0.5 / LARGEST_PITCH + step * np.arange(n_sizes, dtype=np.float64)
        angle: FloatArray = np.arange(N_ANGLES, dtype=np.float64) * (np.pi / N_ANGLES)
        x, y = np.outer(size, np.cos(angle)), np.outer(size, np.sin(angle))
        i = np.rint((x - _ALONG[0]) / STEP).astype(int)
        j = np.rint((y - _UPWARD[0]) / STEP).astype(int)
        return size, angle, highest[i, j]


def _swings(place: FloatArray, first: float, n: int) -> Swings:
    """Waves of frequencies first, first + STEP and so on at places (N,), shape (N, n).

    Each as a product of a coarse and a fine one, of which few are needed.
    """
    size = int(np.ceil(np.sqrt(n)))
    turn = 2j * np.pi * place[:, None]
    fine = np.exp(turn * (STEP * np.arange(size)))
    coarse = np.exp(turn * (first + STEP * size * np.arange(size)))
    both = coarse.astype(np.complex64)[:, :, None] * fine.astype(np.complex64)[:, None, :]
    return np.asarray(both.reshape(len(place), -1)[:, :n])
