"""Spectrum of the crossings of laser lines with strands, and lattice hypotheses from its peaks.

Strands of one family are parallel and evenly spaced, so their crossings with the lasers' lines all
have nearly one phase in a plane wave whose crests are the strands. The power of such waves, summed
over frames, peaks at the families' wave vectors, wherever the net was in each frame. Uneven
coverage (the lasers' lines themselves) would peak as well; it is removed by comparison with
crossings spread evenly over the visible parts of the lines. Power spectra of point processes:
Bartlett, J. R. Stat. Soc. B 25 (1963) 264, doi:10.1111/j.2517-6161.1963.tb00508.x.

The lattice that explains the peaks is chosen by likelihood (`score`). The number of crossings per
metre of line separates a lattice from its multiples and fractions; equal lengths of the sides of a
mesh separate it from chance.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import pairwise
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import python_of
from aqualvs.nets.spectrum_kernels import (
    HIGHEST,
    MAX_HARMONICS,
    REGULAR,
    SHARE_OF_REST,
    SHELL_1,
    AllCrossings,
    expected_on,
    families_gain,
    free_gain_of,
    gain_of,
    miscount,
    off_crests,
    shell_gain,
)

LARGEST_PITCH = 0.09
"""Largest distance between parallel strands in the search, in metres."""
N_ANGLES = 180
"""Directions of waves in half a turn."""
STEP = 0.9
"""Step of the spectrum, in periods a metre."""

_ALONG: FloatArray = np.arange(-HIGHEST, HIGHEST + STEP, STEP)
_UPWARD: FloatArray = np.arange(-2.0 * STEP, HIGHEST + STEP, STEP)
# On the grid evenly spread crossings are this far apart, in metres: their own period is beyond its
# end. The grid gives initial guesses only, so this number of frames is enough.
_APART = 7.5e-3
_MAX_ON_GRID = 12

T = TypeVar("T")

# For arrays of powers.
_gains, _free_gains = python_of(gain_of), python_of(free_gain_of)


@dataclass(frozen=True, slots=True)
class Crossings:
    """Crossings of one frame's lasers with strands, and the visible pieces of their lines."""

    place: FloatArray  # Shape (N, 2): middles of the dashes in `net`, metres.
    laser: IntArray  # Shape (N,): index of the laser.
    # Shape (M, 2): ends of the visible pieces of line, in `net`, metres.
    begin: FloatArray
    end: FloatArray
    # Shape (M,): index of the laser of each of them.
    span_laser: IntArray
    # Shape (L, 2): of the lasers' lines; NaN where there is none.
    direction: FloatArray
    # Shape (L,): visible metres of line.
    length: FloatArray
    # Share of it that is lit, which is the share of crossings that merge with others.
    lit: float


class Spectrum:
    """Power of plane waves in the crossings of some frames; 1 is what random ones have.

    Parameters
    ----------
    lines : array, shape (n, 3)
        Direction and seen length of every line of all frames; zero where there is none.
    laser : int array, shape (n,)
        Its laser.
    lit : float
        Share of the lines that is lit.
    """

    def __init__(
        self, crossings: AllCrossings, lines: FloatArray, laser: IntArray, lit: float
    ) -> None:
        self.crossings, self.lines, self.laser, self.lit = crossings, lines, laser, lit
        self.n_frames, self.n_crossings = len(crossings.start) - 1, len(crossings.place)
        self.per_frame = self.n_crossings / self.n_frames
        seen = np.bincount(crossings.line, minlength=len(lines))
        # Crossings of each laser, shape (L,).
        self.seen = np.bincount(laser, seen, minlength=laser.max(initial=0) + 1)

    @classmethod
    def of(cls, frames: Sequence[Crossings]) -> "Spectrum":
        """Join frames."""
        n_lasers, n_frames = len(frames[0].length), len(frames)
        line = np.concatenate([f.laser + i * n_lasers for i, f in enumerate(frames)])
        begin = np.concatenate([f.begin for f in frames])
        end = np.concatenate([f.end for f in frames])
        span_line = np.concatenate([f.span_laser + i * n_lasers for i, f in enumerate(frames)])
        crossings = AllCrossings(
            place=np.concatenate([f.place for f in frames]),
            line=line,
            start=np.cumsum([0, *(len(f.place) for f in frames)]),
            begin=begin,
            end=end,
            span_line=span_line,
            span_start=np.cumsum([0, *(len(f.begin) for f in frames)]),
            expected=expected_on(line, begin, end, span_line, n_frames * n_lasers),
        )
        lines = np.nan_to_num(np.concatenate([np.c_[f.direction, f.length] for f in frames]))
        laser = np.tile(np.arange(n_lasers), n_frames)
        return cls(crossings, lines, laser, float(np.mean([f.lit for f in frames])))

    def without(self, wave: FloatArray) -> "Spectrum":
        """Return the spectrum of the crossings that do not lie on the crests of a wave."""
        rest = off_crests(self.crossings, wave[0], wave[1], len(self.lines))
        return Spectrum(rest, self.lines, self.laser, self.lit)

    def _on_grid(self, most: int) -> FloatArray:
        """Return the power over the upper half plane and some rows more; the rest mirrors it."""
        power = np.zeros((len(_ALONG), len(_UPWARD)), np.float32)
        count = 0
        every = max(1, -(-self.n_frames // most))
        seen = self.crossings
        frames = list(zip(pairwise(seen.start), pairwise(seen.span_start), strict=True))
        for (first, last), (from_, to) in frames[::every]:
            even, weight = self._evenly_spread(from_, to)
            place = np.concatenate([seen.place[first:last], even])
            x = _swings(place[:, 0], _ALONG[0], len(_ALONG))
            x *= np.r_[np.ones(last - first), -weight].astype(np.float32)[:, None]
            amplitude = x.T @ _swings(place[:, 1], _UPWARD[0], len(_UPWARD))
            power += amplitude.real**2 + amplitude.imag**2
            count += last - first
        return power.astype(np.float64) / max(count, 1)

    def _evenly_spread(self, first: int, last: int) -> tuple[FloatArray, FloatArray]:
        """Return places spread over some spans, and the crossings that each stands for."""
        begin, end = self.crossings.begin[first:last], self.crossings.end[first:last]
        length = np.hypot(*(end - begin).T)
        pieces = np.maximum(np.ceil(length / _APART), 1.0).astype(np.int64)
        number = np.repeat(np.arange(len(pieces)), pieces)
        share = np.arange(len(number)) - np.repeat(np.cumsum(pieces) - pieces, pieces) + 0.5
        share /= pieces[number]
        place = begin[number] + share[:, None] * (end - begin)[number]
        return place, (self.crossings.expected[first:last] / pieces)[number]

    def polar(self, most: int = _MAX_ON_GRID) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the local maximum power at sizes (K,) and directions (A,) of waves, shape (K, A).

        At most `most` frames are used, evenly spread.
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


def _swings(place: FloatArray, first: float, n: int) -> NDArray[np.complex64]:
    """Return the waves of frequencies first, first + STEP and so on at places (N,), shape (N, n).

    Each is the product of a coarse and a fine one, of which few have to be computed.
    """
    size = int(np.ceil(np.sqrt(n)))
    turn = 2j * np.pi * place[:, None]
    fine = np.exp(turn * (STEP * np.arange(size)))
    coarse = np.exp(turn * (first + STEP * size * np.arange(size)))
    both = coarse.astype(np.complex64)[:, :, None] * fine.astype(np.complex64)[:, None, :]
    return np.asarray(both.reshape(len(place), -1)[:, :n])


class _SearchOptions(NamedTuple):
    """Search for lattices in the spectrum of the crossings."""

    shortest_bar: float = 0.010  # Least length of bars in the search for lattices, in metres.
    # Number of waves, and of the best ones that are not neighbours and are followed up; number of
    # second families for each of them.
    tried: int = 1000
    kept: int = 6
    seconds: int = 2
    # Least distance in frequency of two waves.
    apart: float = 2.5
    # Spread of the logarithm of the ratio of the pitches of two families.
    even: float = 0.05


_SEARCH = _SearchOptions()


class Mesh(StrEnum):
    """Shape of the openings."""

    FOUR_SIDED = "four-sided"
    """Squares or diamonds: two families of strands."""
    SIX_SIDED = "six-sided"
    """Hexagons: three families of short bars."""

    @property
    def density(self) -> float:
        """Share of each family's lines that exists."""
        return 1.0 if self is Mesh.FOUR_SIDED else 1.0 / 3.0


# Coordinates in which lattices may differ: wave and axis.
_COORDINATES = {Mesh.FOUR_SIDED: ((0, 0), (0, 1), (1, 0), (1, 1)), Mesh.SIX_SIDED: ((0, 0), (0, 1))}


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A candidate lattice: two wave vectors that span it; of a honeycomb two of its first shell."""

    mesh: Mesh
    basis: FloatArray
    score: float = -np.inf

    def families(self) -> FloatArray:
        """Wave vectors of the strands."""
        a, b = self.basis
        if self.mesh is Mesh.FOUR_SIDED:
            return self.basis
        return np.array([a + b, 2.0 * b - a, 2.0 * a - b])


def score(spectrum: Spectrum, hypothesis: Hypothesis) -> float:
    """Return the log-likelihood per frame over random crossings, including the prior."""
    families = np.ascontiguousarray(hypothesis.families())
    gain = families_gain(spectrum.crossings, families, len(spectrum.lines))
    if hypothesis.mesh is Mesh.SIX_SIDED:
        gain += shell_gain(spectrum.crossings, np.ascontiguousarray(hypothesis.basis))
    off = miscount(
        spectrum.lines,
        spectrum.laser,
        spectrum.seen,
        spectrum.lit,
        spectrum.n_frames,
        families,
        hypothesis.mesh.density,
    )
    return gain - off - _uneven(hypothesis)


def _uneven(hypothesis: Hypothesis) -> float:
    """Return the penalty of two families by their pitches and angle: sides are equally long."""
    if hypothesis.mesh is Mesh.SIX_SIDED:
        return 0.0
    first, second = hypothesis.basis
    a, b = np.hypot(*first), np.hypot(*second)
    angle = np.arccos(min(abs(first @ second) / (a * b), 1.0))
    # The strongest waves of a honeycomb look like a diamond whose families lie sixty degrees apart,
    # and few diamonds do so by chance: penalty within this angle.
    honeycomb_angle, penalty = np.deg2rad(2.5), 1.0
    rare = penalty * np.exp(-0.5 * ((angle - np.pi / 3.0) / honeycomb_angle) ** 2)
    return float(0.5 * (np.log(a / b) / _SEARCH.even) ** 2 + rare)


def hypotheses(spectrum: Spectrum) -> list[Hypothesis]:
    """Return lattices that explain peaks of the spectrum; most of them are wrong."""
    size, angle, power = spectrum.polar()
    gain = _family_gain(power, size, spectrum.per_frame, 0.5)
    return [
        *_squares(size, angle, gain),
        *_four_sided(spectrum, size, angle, gain),
        *_six_sided(spectrum, size, angle, power),
    ]


def _family_gain(power: FloatArray, size: FloatArray, per_frame: float, share: float) -> FloatArray:
    """Return the gain (K, A) from a family's harmonics, for waves of every size and direction."""
    gain = np.zeros_like(power)
    for h in range(1, MAX_HARMONICS + 1):
        k = np.rint((h * size - size[0]) / (size[1] - size[0])).astype(int)
        inside = (k < len(size)) & ((h == 1) | (h * size < HIGHEST))
        gain[inside] += _gains(power[k[inside]], 1.0 + per_frame * (share * REGULAR**h) ** 2)
    return gain


def _squares(size: FloatArray, angle: FloatArray, gain: FloatArray) -> list[Hypothesis]:
    """Return pairs of perpendicular families with one pitch, likely together.

    A laser that crosses both families of a level net makes stronger waves of its own than either.
    """
    quarter = N_ANGLES // 2
    both = gain[:, :quarter] + gain[:, quarter:]
    waves = _best_waves(both, size, angle[:quarter], _SEARCH.kept)
    turn = turned(np.pi / 2.0)
    return [Hypothesis(Mesh.FOUR_SIDED, np.array([a, turn @ a])) for _, _, a in waves]


def _four_sided(
    spectrum: Spectrum, size: FloatArray, angle: FloatArray, gain: FloatArray
) -> list[Hypothesis]:
    """Return pairs of families: likely waves of the stronger one, and the best in the remainder."""
    found = []
    # Number of frames in the search for second families.
    max_of_rest = 6
    # Families that run more nearly alike than this have no mesh between them.
    min_angle = np.deg2rad(25.0)
    for k, i, a in _best_waves(gain, size, angle, _SEARCH.kept):
        rest = spectrum.without(a)
        if rest.n_crossings == 0:
            continue
        left = _family_gain(rest.polar(max_of_rest)[2], size, rest.per_frame, SHARE_OF_REST)
        between = np.abs((angle - angle[i] + 0.5 * np.pi) % np.pi - 0.5 * np.pi)
        left = left - 0.5 * (np.log(size / size[k])[:, None] / _SEARCH.even) ** 2
        left[:, between < min_angle] = -np.inf
        for _, _, b in _best_waves(left, size, angle, _SEARCH.seconds):
            found.append(Hypothesis(Mesh.FOUR_SIDED, np.array([a, b])))
    return found


def _best_waves(
    gain: FloatArray, size: FloatArray, angle: FloatArray, n: int
) -> list[tuple[int, int, FloatArray]]:
    """Return rows, columns and vectors of the best waves that are not neighbours, best first."""
    gain = np.where(
        ((size > 1.0 / LARGEST_PITCH) & (size < 1.0 / _SEARCH.shortest_bar))[:, None], gain, -np.inf
    )
    waves = ((k, i, _wave(size[k], angle[i])) for k, i in _best_cells(gain))
    return _first_apart(waves, lambda one, other: _distance(one[2], other[2]), n)


def _best_cells(gain: FloatArray) -> Iterator[tuple[int, int]]:
    order = np.argsort(gain, axis=None)[::-1][: _SEARCH.tried]
    return zip(*np.unravel_index(order, gain.shape), strict=True)


def _wave(size: float, angle: float) -> FloatArray:
    return size * np.array([np.cos(angle), np.sin(angle)])


def _six_sided(
    spectrum: Spectrum, size: FloatArray, angle: FloatArray, power: FloatArray
) -> list[Hypothesis]:
    bars = _family_gain(power, size, spectrum.per_frame, 1.0 / 3.0)
    shell = _gains(power, 1.0 + spectrum.per_frame * SHELL_1**2)
    # The first shell's waves are 1 / (1.5 bar) long.
    rows = np.flatnonzero(
        (size > 1.0 / LARGEST_PITCH) & (size < 1.0 / (1.5 * _SEARCH.shortest_bar))
    )
    double = np.rint((2.0 * size[rows] - size[0]) / (size[1] - size[0])).astype(int)
    longer = np.rint((np.sqrt(3.0) * size[rows] - size[0]) / (size[1] - size[0])).astype(int)
    inside = double < len(size)
    sixth = N_ANGLES // 6
    total = np.zeros((len(rows), 2 * sixth))
    for turn in range(3):
        at = (np.arange(2 * sixth) + 2 * sixth * turn) % N_ANGLES
        total += shell[rows][:, at]
        total[inside] += _free_gains(power[double[inside]][:, at], spectrum.per_frame)
        beside = (at + sixth) % N_ANGLES
        near = longer < len(size)
        total[near] += bars[longer[near]][:, beside]
    waves = (_wave(size[rows[k]], angle[i]) for k, i in _best_cells(total))
    found = (Hypothesis(Mesh.SIX_SIDED, np.array([a, turned(np.pi / 3.0) @ a])) for a in waves)
    return _first_apart(found, _apart, _SEARCH.kept)


def _first_apart(ordered: Iterable[T], distance: Callable[[T, T], float], n: int) -> list[T]:
    """Return the first `n` that are no neighbours of an earlier one."""
    kept: list[T] = []
    for one in ordered:
        if all(distance(one, other) > _SEARCH.apart for other in kept):
            kept.append(one)
        if len(kept) == n:
            break
    return kept


def _apart(one: Hypothesis, other: Hypothesis) -> float:
    """Return the larger distance between corresponding waves of two lattices of one kind."""
    distance = np.array([[_distance(a, b) for b in other.families()] for a in one.families()])
    return float(distance.min(axis=1).max())


def _distance(a: FloatArray, b: FloatArray) -> float:
    """Return the distance between two waves; a wave and its opposite are the same."""
    return float(min(np.hypot(*(a - b)), np.hypot(*(a + b))))


def turned(angle: float) -> FloatArray:
    """Return the matrix (2, 2) that turns counter-clockwise by an angle in radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def refine(start: Hypothesis, spectrum: Spectrum, rounds: int) -> Hypothesis:
    """Maximise the score near a hypothesis by pattern search with shrinking steps.

    In each round every coordinate is tried to either side.
    """
    best = replace(start, score=score(spectrum, start))
    step = 0.5 * STEP
    for _ in range(rounds):
        before = best
        for wave, axis in _COORDINATES[best.mesh]:
            for shift in (-step, step):
                moved = _moved(best, wave, axis, shift)
                found = score(spectrum, moved)
                if found > best.score:
                    best = replace(moved, score=found)
                    break
        if best is before:
            step *= 0.5
    return best


def _moved(at: Hypothesis, wave: int, axis: int, shift: float) -> Hypothesis:
    """Return a lattice a step away: with another wave, or a regular honeycomb as a whole."""
    basis = at.basis.copy()
    basis[wave, axis] += shift
    if at.mesh is Mesh.SIX_SIDED:
        basis[1] = turned(np.pi / 3.0) @ basis[0]
    return Hypothesis(at.mesh, basis)


def bar_of(hypothesis: Hypothesis) -> float:
    """Return the length of a side of the openings, in metres."""
    a, b = hypothesis.basis
    size_a, size_b = np.hypot(*a), np.hypot(*b)
    if hypothesis.mesh is Mesh.SIX_SIDED:
        return float(1.0 / (0.75 * (size_a + size_b)))
    sine = abs(a[0] * b[1] - a[1] * b[0]) / (size_a * size_b)
    return float(0.5 * (1.0 / size_a + 1.0 / size_b) / sine)
