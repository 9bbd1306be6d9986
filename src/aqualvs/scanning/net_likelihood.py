"""How much likelier a lattice makes the crossings that were seen: kernels of `net_hypotheses`.

Powers of plane waves (`net_spectrum`) are exponentially distributed about their mean: 1 where
crossings lie at random, more on the waves that a lattice is made of.
"""

import numpy as np

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import inline_kernel, kernel
from aqualvs.scanning.net_waves import comb_power, crest_phases, expected_on, off_crests

HIGHEST = 125.0
"""Waves are looked at up to so many periods a metre."""
MOST_HARMONICS, REGULAR = 6, 0.92
"""Harmonics of a family's wave that are looked at; each is this much weaker than the one before."""
SHELL_1 = 0.37
"""Amplitude of the waves in the first shell of a honeycomb's reciprocal lattice."""
SHARE_OF_REST = 0.8
"""Of what the crossings on a family's crests leave, the other family has this share."""
# No crossings left at all is worth this much.
_NOTHING_LEFT = 5.0
# The double of a first shell's wave may be strong or weak, as the lines cut the net: worth its
# likelihood, less this. Where a frame has few crossings, about as many as this, strong ones are not
# to be expected: less is due.
_FREEDOM, _FEW_CROSSINGS = 0.7, 15.0
# Crossings seen over crossings that a lattice must have, less those that merge: spread of its
# logarithm among lasers, variance of a frame's count of one, and spread of the mean towards fewer
# (missing strands) and towards more.
_SEEN_SPREAD, _COUNT_NOISE, _FEW_SEEN, _MANY_SEEN = 0.2, 0.3, 0.2, 0.12


@inline_kernel
def gain_of(power: float, mean: float) -> float:
    """Log-likelihood of a power over random crossings, where a peak of a given mean should be.

    A peak much higher than the model's proves no more than one twice as high.
    """
    return float(min(power, 2.0 * mean) * (1.0 - 1.0 / mean) - np.log(mean))


@inline_kernel
def free_gain_of(power: float, per_frame: float) -> float:
    """Return the same where the mean is not known; freedom has its price."""
    mean = max(power, 1.0)
    price = _FREEDOM * per_frame / (per_frame + _FEW_CROSSINGS)
    return float(mean - 1.0 - np.log(mean) - price)


def free_gains(power: FloatArray, per_frame: float) -> FloatArray:
    """`free_gain_of` for many powers."""
    mean = np.maximum(power, 1.0)
    price = _FREEDOM * per_frame / (per_frame + _FEW_CROSSINGS)
    gain: FloatArray = mean - 1.0 - np.log(mean) - price
    return gain


@kernel
def shell_gain(
    place: FloatArray,
    start: IntArray,
    begin: FloatArray,
    end: FloatArray,
    expected: FloatArray,
    span_start: IntArray,
    basis: FloatArray,
) -> float:
    """Gain from the waves of a honeycomb that are longer than those of its bars' lines.

    Parameters
    ----------
    place, start, begin, end, expected, span_start
        As for `net_waves.comb_power`.
    basis : array, shape (2, 2)
        Two waves of the first shell.
    """
    per_frame = place.shape[0] / (start.shape[0] - 1)
    gain, power = 0.0, np.empty(2)
    for k in range(3):
        qx = basis[k, 0] if k < 2 else basis[1, 0] - basis[0, 0]
        qy = basis[k, 1] if k < 2 else basis[1, 1] - basis[0, 1]
        power[:] = 0.0
        comb_power(place, start, begin, end, expected, span_start, qx, qy, power)
        power /= max(place.shape[0], 1)
        gain += gain_of(power[0], 1.0 + per_frame * SHELL_1**2)
        gain += free_gain_of(power[1], per_frame)
    return gain


@kernel
def families_gain(
    place: FloatArray,
    line: IntArray,
    start: IntArray,
    begin: FloatArray,
    end: FloatArray,
    expected: FloatArray,
    span_line: IntArray,
    span_start: IntArray,
    n_lines: int,
    families: FloatArray,
) -> float:
    """Gain from the strongest family, from the next among what that leaves, and so on.

    Parameters
    ----------
    place, start, begin, end, expected, span_start
        As for `net_waves.comb_power`.
    line, span_line : int array, shape (N,) and (M,)
        Lines that crossings and spans lie on.
    n_lines : int
        Of all frames.
    families : array, shape (F, 2)
        Their waves.
    """
    n = families.shape[0]
    strength = np.empty(n)
    for k in range(n):
        strength[k] = _comb_gain(
            place, start, begin, end, expected, span_start, families[k], 1.0 / n
        )
    order = np.argsort(strength)[::-1]
    gain = strength[order[0]]
    for k in range(1, n):
        before = families[order[k - 1]]
        phase = crest_phases(place, start, before[0], before[1])
        kept, start, begin, end, origin, span_start = off_crests(
            place, start, begin, end, span_start, phase, before[0], before[1]
        )
        place, line, span_line = place[kept], line[kept], span_line[origin]
        expected = expected_on(line, begin, end, span_line, n_lines)
        # Crossings of the families that remain, less those that lie on a crest by chance.
        share = SHARE_OF_REST / (n - k)
        gain += _comb_gain(
            place, start, begin, end, expected, span_start, families[order[k]], share
        )
    return float(gain)


@kernel
def _comb_gain(
    place: FloatArray,
    start: IntArray,
    begin: FloatArray,
    end: FloatArray,
    expected: FloatArray,
    span_start: IntArray,
    wave: FloatArray,
    share: float,
) -> float:
    """Gain from a family's harmonics that holds a share of the crossings."""
    if place.shape[0] == 0:
        return -_NOTHING_LEFT
    per_frame = place.shape[0] / (start.shape[0] - 1)
    size = np.hypot(wave[0], wave[1])
    power = np.zeros(int(max(1.0, min(HIGHEST // size, MOST_HARMONICS))))
    comb_power(place, start, begin, end, expected, span_start, wave[0], wave[1], power)
    gain = 0.0
    for h in range(len(power)):
        mean = 1.0 + per_frame * (share * REGULAR ** (h + 1.0)) ** 2
        gain += gain_of(power[h] / place.shape[0], mean)
    return gain


@kernel
def miscount(
    lines: FloatArray,
    laser: IntArray,
    seen: IntArray,
    lit: float,
    n_frames: int,
    families: FloatArray,
    density: float,
) -> float:
    """How unlikely the numbers of crossings are that the lasers have seen.

    Parameters
    ----------
    lines, laser, seen, lit, n_frames
        As attributes of `Spectrum`.
    families : array, shape (F, 2)
        Waves of the strands.
    density : float
        Share of each family's lines that is really there.
    """
    expected = np.zeros(len(seen))
    for i in range(len(lines)):
        rate = 0.0
        for wave in families:
            rate += abs(lines[i, 0] * wave[0] + lines[i, 1] * wave[1])
        expected[laser[i]] += rate * density * lines[i, 2]
    weight, mean, square = 0.0, 0.0, 0.0
    for k in range(len(seen)):
        if expected[k] > 0.0:
            count = max(float(seen[k]), 0.5)
            off = np.log(count / (expected[k] * max(1.0 - lit, 0.1)))
            one = 1.0 / (_SEEN_SPREAD**2 + _COUNT_NOISE * n_frames / count)
            weight, mean, square = weight + one, mean + one * off, square + one * off**2
    mean /= weight
    spread = _FEW_SEEN if mean < 0.0 else _MANY_SEEN
    return float(0.5 * (square - weight * mean**2) + mean**2 / (2.0 * spread**2))
