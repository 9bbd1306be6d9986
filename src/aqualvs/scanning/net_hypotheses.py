"""Lattices that a net may have, and how likely each is.

Which lattice explains the peaks of a spectrum is decided by likelihood. How many crossings there
are per metre of line tells a lattice from its multiples and fractions, and that the sides of a mesh
are equally long tells it from chance.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.scanning.net_likelihood import (
    HIGHEST,
    MOST_HARMONICS,
    REGULAR,
    SHARE_OF_REST,
    SHELL_1,
    families_gain,
    free_gains,
    miscount,
    shell_gain,
)
from aqualvs.scanning.net_spectrum import LARGEST_PITCH, N_ANGLES, STEP, Spectrum

# Length of bars down to which lattices are looked for, in metres.
_SHORTEST_BAR = 0.010
# Waves looked at, and how many of the best that are not neighbours are followed up; for each of
# them so many second families.
_TRIED, _KEPT, _SECONDS = 1000, 6, 2
# These are looked for in so many frames.
_MOST_OF_REST = 6
# How far apart in frequency two waves are at least.
_APART = 2.5
# Spread of the logarithm of the ratio of the pitches of two families.
_EVEN = 0.05
# The strongest waves of a honeycomb look like a diamond whose families lie sixty degrees apart, and
# few diamonds do so by chance: within this angle they are unlikely by as much.
_AS_HONEYCOMB, _RARE = np.deg2rad(2.5), 1.0
# Families that run more nearly alike than this have no mesh between them.
_LEAST_ANGLE = np.deg2rad(25.0)


class Mesh(StrEnum):
    """Shape of the openings."""

    FOUR_SIDED = "four-sided"
    """Squares or diamonds: two families of strands."""
    SIX_SIDED = "six-sided"
    """Hexagons: three families of short bars."""


# Coordinates in which lattices may differ: wave and axis.
_COORDINATES = {
    Mesh.FOUR_SIDED: ((0, 0), (0, 1), (1, 0), (1, 1)),
    Mesh.SIX_SIDED: ((0, 0), (0, 1)),
}


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """Two wave vectors that span a lattice; of a honeycomb two of its first shell."""

    mesh: Mesh
    basis: FloatArray
    score: float = -np.inf

    def scored(self, score: float) -> "Hypothesis":
        """Return the same with a score."""
        return Hypothesis(self.mesh, self.basis, score)

    def families(self) -> FloatArray:
        """Wave vectors of the strands."""
        a, b = self.basis
        if self.mesh is Mesh.FOUR_SIDED:
            return self.basis
        return np.array([a + b, 2.0 * b - a, 2.0 * a - b])

    def density(self) -> FloatArray:
        """Share of each family's lines that is really there."""
        return np.ones(2) if self.mesh is Mesh.FOUR_SIDED else np.full(3, 1.0 / 3.0)


def score(spectrum: Spectrum, hypothesis: Hypothesis) -> float:
    """Log-likelihood per frame over random crossings, less what is unlikely beforehand."""
    families = np.ascontiguousarray(hypothesis.families())
    gain = families_gain(
        spectrum.place,
        spectrum.line,
        spectrum.start,
        spectrum.begin,
        spectrum.end,
        spectrum.expected,
        spectrum.span_line,
        spectrum.span_start,
        len(spectrum.lines),
        families,
    )
    if hypothesis.mesh is Mesh.SIX_SIDED:
        basis = np.ascontiguousarray(hypothesis.basis)
        gain += shell_gain(
            spectrum.place,
            spectrum.start,
            spectrum.begin,
            spectrum.end,
            spectrum.expected,
            spectrum.span_start,
            basis,
        )
    off = miscount(
        spectrum.lines,
        spectrum.laser,
        spectrum.seen,
        spectrum.lit,
        spectrum.n_frames,
        families,
        float(hypothesis.density()[0]),
    )
    return gain - off - _uneven(hypothesis)


def _gain(power: FloatArray, mean: float) -> FloatArray:
    """`gain_of` for many powers."""
    gain: FloatArray = np.minimum(power, 2.0 * mean) * (1.0 - 1.0 / mean) - np.log(mean)
    return gain


def _uneven(hypothesis: Hypothesis) -> float:
    """How unlikely two families are for their pitches and angle: sides are equally long."""
    if hypothesis.mesh is Mesh.SIX_SIDED:
        return 0.0
    first, second = hypothesis.basis
    a, b = np.hypot(*first), np.hypot(*second)
    angle = np.arccos(min(abs(first @ second) / (a * b), 1.0))
    rare = _RARE * np.exp(-0.5 * ((angle - np.pi / 3.0) / _AS_HONEYCOMB) ** 2)
    return float(0.5 * (np.log(a / b) / _EVEN) ** 2 + rare)


def hypotheses(spectrum: Spectrum) -> list[Hypothesis]:
    """Lattices that the power at their peaks speaks for, most of them wrong."""
    size, angle, power = spectrum.polar()
    return [
        *_four_sided(spectrum, size, angle, power),
        *_six_sided(spectrum, size, angle, power),
    ]


def _family_gain(power: FloatArray, size: FloatArray, per_frame: float, share: float) -> FloatArray:
    """Gain (K, A) from a family's harmonics, the family's wave at every size and direction."""
    gain = np.zeros_like(power)
    for h in range(1, MOST_HARMONICS + 1):
        k = np.rint((h * size - size[0]) / (size[1] - size[0])).astype(int)
        inside = (k < len(size)) & ((h == 1) | (h * size < HIGHEST))
        gain[inside] += _gain(power[k[inside]], 1.0 + per_frame * (share * REGULAR**h) ** 2)
    return gain


def _four_sided(
    spectrum: Spectrum, size: FloatArray, angle: FloatArray, power: FloatArray
) -> list[Hypothesis]:
    """Pairs of families: likely waves of the stronger one, and the best in what each leaves."""
    gain = _family_gain(power, size, spectrum.per_frame, 0.5)
    found = []
    for k, i in _best_waves(gain, size, angle, _KEPT):
        a = size[k] * np.array([np.cos(angle[i]), np.sin(angle[i])])
        rest = spectrum.without(a)
        if rest.n_crossings == 0:
            continue
        left = _family_gain(rest.polar(_MOST_OF_REST)[2], size, rest.per_frame, SHARE_OF_REST)
        between = np.abs((angle - angle[i] + 0.5 * np.pi) % np.pi - 0.5 * np.pi)
        left = left - 0.5 * (np.log(size / size[k])[:, None] / _EVEN) ** 2
        left[:, between < _LEAST_ANGLE] = -np.inf
        for m, j in _best_waves(left, size, angle, _SECONDS):
            b = size[m] * np.array([np.cos(angle[j]), np.sin(angle[j])])
            found.append(Hypothesis(Mesh.FOUR_SIDED, np.array([a, b])))
    return found


def _best_waves(
    gain: FloatArray, size: FloatArray, angle: FloatArray, n: int
) -> list[tuple[int, int]]:
    """Rows and columns of the best waves that are not neighbours, best first."""
    gain = np.where(
        ((size > 1.0 / LARGEST_PITCH) & (size < 1.0 / _SHORTEST_BAR))[:, None], gain, -np.inf
    )
    order = np.argsort(gain, axis=None)[::-1][:_TRIED]
    found: list[tuple[int, int]] = []
    waves: list[FloatArray] = []
    for k, i in zip(*np.unravel_index(order, gain.shape), strict=True):
        wave = size[k] * np.array([np.cos(angle[i]), np.sin(angle[i])])
        if all(_distance(wave, other) > _APART for other in waves):
            found.append((int(k), int(i)))
            waves.append(wave)
        if len(found) == n:
            break
    return found


def _six_sided(
    spectrum: Spectrum, size: FloatArray, angle: FloatArray, power: FloatArray
) -> list[Hypothesis]:
    bars = _family_gain(power, size, spectrum.per_frame, 1.0 / 3.0)
    shell = _gain(power, 1.0 + spectrum.per_frame * SHELL_1**2)
    # The first shell's waves are 1 / (1.5 bar) long.
    rows = np.flatnonzero((size > 1.0 / LARGEST_PITCH) & (size < 1.0 / (1.5 * _SHORTEST_BAR)))
    double = np.rint((2.0 * size[rows] - size[0]) / (size[1] - size[0])).astype(int)
    longer = np.rint((np.sqrt(3.0) * size[rows] - size[0]) / (size[1] - size[0])).astype(int)
    inside = double < len(size)
    sixth = N_ANGLES // 6
    total = np.zeros((len(rows), 2 * sixth))
    for turn in range(3):
        at = (np.arange(2 * sixth) + 2 * sixth * turn) % N_ANGLES
        total += shell[rows][:, at]
        total[inside] += free_gains(power[double[inside]][:, at], spectrum.per_frame)
        beside = (at + sixth) % N_ANGLES
        near = longer < len(size)
        total[near] += bars[longer[near]][:, beside]
    order = np.argsort(total, axis=None)[::-1][:_TRIED]
    found = []
    for k, i in zip(*np.unravel_index(order, total.shape), strict=True):
        a = size[rows[k]] * np.array([np.cos(angle[i]), np.sin(angle[i])])
        found.append(Hypothesis(Mesh.SIX_SIDED, np.array([a, turned(np.pi / 3.0) @ a])))
    return _spread_out(found)


def _spread_out(ordered: list[Hypothesis]) -> list[Hypothesis]:
    """Return the best of each group of neighbours."""
    kept: list[Hypothesis] = []
    for one in ordered:
        if len(kept) == _KEPT:
            break
        if all(_apart(one, other) > _APART for other in kept):
            kept.append(one)
    return kept


def _apart(one: Hypothesis, other: Hypothesis) -> float:
    """How far the farther of the waves of two lattices of one kind is from its like."""
    distance = np.array([[_distance(a, b) for b in other.families()] for a in one.families()])
    return float(distance.min(axis=1).max())


def _distance(a: FloatArray, b: FloatArray) -> float:
    """Distance between two waves; a wave and its opposite are the same."""
    return float(min(np.hypot(*(a - b)), np.hypot(*(a + b))))


def turned(angle: float) -> FloatArray:
    """Return the matrix (2, 2) that turns counter-clockwise by an angle in radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def refine(start: Hypothesis, spectrum: Spectrum, rounds: int) -> Hypothesis:
    """Climb to the highest score near a hypothesis: pattern search with shrinking steps.

    In each round every coordinate is tried to either side.
    """
    best = start.scored(score(spectrum, start))
    step = 0.5 * STEP
    for _ in range(rounds):
        before = best
        for wave, axis in _COORDINATES[best.mesh]:
            for shift in (-step, step):
                moved = _moved(best, wave, axis, shift)
                found = score(spectrum, moved)
                if found > best.score:
                    best = moved.scored(found)
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
    """Length of a side of the openings, in metres."""
    a, b = hypothesis.basis
    size_a, size_b = np.hypot(*a), np.hypot(*b)
    if hypothesis.mesh is Mesh.SIX_SIDED:
        return float(1.0 / (0.75 * (size_a + size_b)))
    sine = abs(a[0] * b[1] - a[1] * b[0]) / (size_a * size_b)
    return float(0.5 * (1.0 / size_a + 1.0 / size_b) / sine)
