"""Lattices that a net may have, and how likely each is.

Which lattice explains the peaks of a spectrum is decided by likelihood. How many crossings there
are per metre of line tells a lattice from its multiples and fractions, and that the sides of a mesh
are equally long tells it from chance.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.scanning.net_spectrum import HIGHEST, LARGEST_PITCH, N_ANGLES, STEP, Spectrum

# Length of bars down to which lattices are looked for, in metres.
_SHORTEST_BAR = 0.010
# Waves looked at, and how many of the best that are not neighbours are followed up; for each of
# them so many second families.
_TRIED, _KEPT, _SECONDS = 1000, 6, 2
# How far apart in frequency two waves are at least.
_APART = 2.5
# Harmonics of a family's wave that are looked at; each is this much weaker than the one before.
_MOST_HARMONICS, _REGULAR = 6, 0.92
# Amplitude of the waves in the first shell of a honeycomb's reciprocal lattice. The double of such
# a wave may be strong or weak, as the lines cut the net: worth its likelihood, less this. Where a
# frame has few crossings, about as many as this, strong ones are not to be expected: less is due.
_SHELL_1, _FREEDOM, _FEW_CROSSINGS = 0.37, 0.7, 15.0
# Crossings seen over crossings that a lattice must have, less those that merge: spread of its
# logarithm among lasers, variance of a frame's count of one, and spread of the mean towards fewer
# (missing strands) and towards more.
_SEEN_SPREAD, _COUNT_NOISE, _FEW_SEEN, _MANY_SEEN = 0.2, 0.3, 0.2, 0.12
# Of what the crossings on a family's crests leave, the other family has this share; nothing left at
# all is worth this much.
_SHARE_OF_REST, _NOTHING_LEFT = 0.8, 5.0
# Spread of the logarithm of the ratio of the pitches of two families.
_EVEN = 0.05
# Families that run more nearly alike than this have no mesh between them.
_LEAST_ANGLE = np.deg2rad(25.0)


class Mesh(StrEnum):
    """Shape of the openings."""

    FOUR_SIDED = "four-sided"
    """Squares or diamonds: two families of strands."""
    SIX_SIDED = "six-sided"
    """Hexagons: three families of short bars."""


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
    if hypothesis.mesh is Mesh.FOUR_SIDED:
        gain = _one_by_one(spectrum, hypothesis.basis)
    else:
        gain = _shell_gain(spectrum, hypothesis) + _one_by_one(spectrum, hypothesis.families())
    return gain - _miscount(spectrum, hypothesis) - _uneven(hypothesis)


def _shell_gain(spectrum: Spectrum, hypothesis: Hypothesis) -> float:
    """Gain from the waves of a honeycomb that are longer than those of its bars' lines."""
    a, b = hypothesis.basis
    gain = 0.0
    for wave in (a, b, b - a):
        once, twice = spectrum.at(wave, 2)
        gain += float(_gain(once, 1.0 + spectrum.per_frame * _SHELL_1**2))
        gain += float(_free_gain(twice, spectrum.per_frame))
    return gain


def _one_by_one(spectrum: Spectrum, families: FloatArray) -> float:
    """Gain from the strongest family, from the next among what that leaves, and so on."""
    strength = [_comb_gain(spectrum, f, 1.0 / len(families)) for f in families]
    strongest, *others = np.argsort(strength)[::-1]
    gain = float(strength[strongest])
    left, before = spectrum, families[strongest]
    for k, i in enumerate(others):
        left = left.without(before)
        # Crossings of the families that remain, less those that lie on a crest by chance.
        gain += _comb_gain(left, families[i], _SHARE_OF_REST / (len(others) - k))
        before = families[i]
    return gain


def _comb_gain(spectrum: Spectrum, wave: FloatArray, share: float) -> float:
    """Gain from a family's harmonics that holds a share of the crossings."""
    if spectrum.n_crossings == 0:
        return -_NOTHING_LEFT
    harmonics = _harmonics(float(np.hypot(*wave)))
    power = spectrum.at(wave, len(harmonics))
    mean = 1.0 + spectrum.per_frame * (share * _left(harmonics)) ** 2
    return float(np.sum(_gain(power, mean)))


def _miscount(spectrum: Spectrum, hypothesis: Hypothesis) -> float:
    """How unlikely the numbers of crossings are that the lasers have seen."""
    families, density = hypothesis.families(), hypothesis.density()
    crossed = (np.abs(spectrum.lines[:, :2] @ families.T) @ density) * spectrum.lines[:, 2]
    expected = np.bincount(spectrum.laser, crossed, minlength=len(spectrum.seen))
    known = expected > 0.0
    seen = np.maximum(spectrum.seen[known], 0.5)
    off = np.log(seen / (expected[known] * max(1.0 - spectrum.lit, 0.1)))
    variance = _SEEN_SPREAD**2 + _COUNT_NOISE * spectrum.n_frames / seen
    mean = float(np.sum(off / variance) / np.sum(1.0 / variance))
    apart = float(np.sum((off - mean) ** 2 / (2.0 * variance)))
    return apart + mean**2 / (2.0 * (_FEW_SEEN if mean < 0.0 else _MANY_SEEN) ** 2)


def _gain(power: FloatArray, mean: FloatArray | float) -> FloatArray:
    """Log-likelihood of powers over random crossings, where peaks of given means should be.

    Powers are exponentially distributed about their mean. A peak much higher than the model's
    proves no more than one twice as high.
    """
    gain: FloatArray = np.minimum(power, 2.0 * mean) * (1.0 - 1.0 / mean) - np.log(mean)
    return gain


def _free_gain(power: FloatArray, per_frame: float) -> FloatArray:
    """Return the same where the mean is not known; freedom has its price."""
    mean = np.maximum(power, 1.0)
    price = _FREEDOM * per_frame / (per_frame + _FEW_CROSSINGS)
    gain: FloatArray = mean - 1.0 - np.log(mean) - price
    return gain


def _uneven(hypothesis: Hypothesis) -> float:
    """How unlikely two families of different pitch are: the sides of a mesh are equally long."""
    if hypothesis.mesh is Mesh.SIX_SIDED:
        return 0.0
    a, b = np.linalg.norm(hypothesis.basis, axis=1)
    return float(0.5 * (np.log(a / b) / _EVEN) ** 2)


def hypotheses(spectrum: Spectrum) -> list[Hypothesis]:
    """Lattices that the power at their peaks speaks for, most of them wrong."""
    size, angle, power = spectrum.polar()
    return [
        *_four_sided(spectrum, size, angle, power),
        *_six_sided(spectrum, size, angle, power),
    ]


def _harmonics(size: float) -> FloatArray:
    """Numbers of the harmonics of a wave that are looked at."""
    return np.arange(1.0, max(1.0, min(HIGHEST // size, _MOST_HARMONICS)) + 1.0)


def _left(harmonic: FloatArray | float) -> FloatArray:
    """Return what is left of a harmonic's amplitude: strands are not spaced perfectly."""
    return np.asarray(_REGULAR**harmonic)


def _family_gain(power: FloatArray, size: FloatArray, per_frame: float, share: float) -> FloatArray:
    """Gain (K, A) from a family's harmonics, the family's wave at every size and direction."""
    gain = np.zeros_like(power)
    for h in range(1, _MOST_HARMONICS + 1):
        k = np.rint((h * size - size[0]) / (size[1] - size[0])).astype(int)
        inside = (k < len(size)) & ((h == 1) | (h * size < HIGHEST))
        gain[inside] += _gain(power[k[inside]], 1.0 + per_frame * float(share * _left(h)) ** 2)
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
        left = _family_gain(rest.polar()[2], size, rest.per_frame, _SHARE_OF_REST)
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
    shell = _gain(power, 1.0 + spectrum.per_frame * _SHELL_1**2)
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
        total[inside] += _free_gain(power[double[inside]][:, at], spectrum.per_frame)
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
    """Climb to the highest score near a hypothesis: pattern search with shrinking steps."""
    best = start.scored(score(spectrum, start))
    step = 0.5 * STEP
    for _ in range(rounds):
        better = best
        for moved in _neighbours(best, step):
            found = score(spectrum, moved)
            if found > better.score:
                better = moved.scored(found)
        if better is best:
            step *= 0.5
        best = better
    return best


def _neighbours(at: Hypothesis, step: float) -> list[Hypothesis]:
    """Lattices a step away: each wave on its own, or a regular honeycomb as a whole."""
    moved = []
    for axis in range(2):
        for sign in (-step, step):
            shift = np.zeros(2)
            shift[axis] = sign
            if at.mesh is Mesh.SIX_SIDED:
                a = at.basis[0] + shift
                moved.append(Hypothesis(at.mesh, np.array([a, turned(np.pi / 3.0) @ a])))
                continue
            for k in range(2):
                basis = at.basis.copy()
                basis[k] += shift
                moved.append(Hypothesis(at.mesh, basis))
    return moved


def bar_of(hypothesis: Hypothesis) -> float:
    """Length of a side of the openings, in metres."""
    a, b = hypothesis.basis
    size_a, size_b = np.hypot(*a), np.hypot(*b)
    if hypothesis.mesh is Mesh.SIX_SIDED:
        return float(1.0 / (0.75 * (size_a + size_b)))
    sine = abs(a[0] * b[1] - a[1] * b[0]) / (size_a * size_b)
    return float(0.5 * (1.0 / size_a + 1.0 / size_b) / sine)
