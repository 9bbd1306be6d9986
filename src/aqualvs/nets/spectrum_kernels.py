"""Compiled kernels of `aqualvs.nets.spectrum`: sums of plane waves, and log-likelihood gains.

A piece of line of length l with ends b and e adds l sinc(q·(e - b)) exp(2 pi i q·(b + e)/2), times
the crossings per metre that are expected on it.

Powers are exponentially distributed about their mean: 1 where crossings lie at random, more on the
waves that a lattice is made of. The gain is the log-likelihood of the crossings with the lattice
over that of random ones.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import inline_kernel, inner_kernel, kernel

# Largest distance of a crossing of the wave's family from a crest, in periods.
_ON_CREST = 0.12
_TURN = 2.0 * np.pi


class AllCrossings(NamedTuple):
    """Crossings of F frames, N of them, and the visible pieces of their lines: M spans."""

    place: FloatArray  # Shape (N, 2): in `net`, metres.
    line: IntArray  # Shape (N,): number of the line of each, counted through all frames.
    start: IntArray  # Shape (F + 1,): where each frame's begin.
    # The same for the spans; shape (M, 2), (M,) and (F + 1,).
    begin: FloatArray
    end: FloatArray
    span_line: IntArray
    span_start: IntArray
    # Shape (M,): crossings on every span if those of its line were spread evenly.
    expected: FloatArray


@kernel
def comb_power(crossings: AllCrossings, qx: float, qy: float, n: int) -> FloatArray:
    """Return the power at n harmonics of the wave (qx, qy); 1 is what random crossings have."""
    place, start, span_start = crossings.place, crossings.start, crossings.span_start
    power, real, imaginary, share = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    for g in range(start.shape[0] - 1):
        real[:] = 0.0
        imaginary[:] = 0.0
        for i in range(start[g], start[g + 1]):
            angle = _TURN * (qx * place[i, 0] + qy * place[i, 1])
            c, s = np.cos(angle), np.sin(angle)
            x, y = 1.0, 0.0
            for h in range(n):
                x, y = x * c - y * s, x * s + y * c
                real[h] += x
                imaginary[h] += y
        _add_spans(crossings, span_start[g], span_start[g + 1], qx, qy, real, imaginary, share)
        for h in range(n):
            power[h] += real[h] ** 2 + imaginary[h] ** 2
    return power / max(len(place), 1)


@inline_kernel
def _add_spans(
    crossings: AllCrossings,
    from_: int,
    to: int,
    qx: float,
    qy: float,
    real: FloatArray,
    imaginary: FloatArray,
    share: FloatArray,
) -> None:
    """Subtract the expected crossings on some spans from the sums of a wave's harmonics.

    Evenly spaced pieces of one line turn by the same angle, which saves most of the sines.
    """
    begin, end, expected, n = crossings.begin, crossings.end, crossings.expected, real.shape[0]
    c, s, turn_c, turn_s, ch, sh = 1.0, 0.0, 1.0, 0.0, 1.0, 0.0
    middle_x, middle_y, step_x, step_y, half_x, half_y = 0.0, 0.0, np.inf, 0.0, np.inf, 0.0
    # Difference of lengths that count as equal, in metres, and half a span's phase that counts as
    # zero.
    same, short = 1e-10, 1e-6
    for i in range(from_, to):
        x, y = 0.5 * (begin[i, 0] + end[i, 0]), 0.5 * (begin[i, 1] + end[i, 1])
        u, v = 0.5 * (end[i, 0] - begin[i, 0]), 0.5 * (end[i, 1] - begin[i, 1])
        if abs(x - middle_x - step_x) + abs(y - middle_y - step_y) < same:
            c, s = c * turn_c - s * turn_s, s * turn_c + c * turn_s
        else:
            angle = _TURN * (qx * x + qy * y)
            before_c, before_s = c, s
            c, s = np.cos(angle), np.sin(angle)
            turn_c, turn_s = c * before_c + s * before_s, s * before_c - c * before_s
            step_x, step_y = x - middle_x, y - middle_y
        middle_x, middle_y = x, y
        if abs(u - half_x) + abs(v - half_y) > same:
            half_x, half_y = u, v
            half = _TURN * (qx * u + qy * v)
            ch, sh = np.cos(half), np.sin(half)
            xh, yh = 1.0, 0.0
            for h in range(n):
                xh, yh = xh * ch - yh * sh, xh * sh + yh * ch
                share[h] = yh / ((h + 1) * half) if abs(half) > short else 1.0
        a, b = 1.0, 0.0
        for h in range(n):
            a, b = a * c - b * s, a * s + b * c
            real[h] -= expected[i] * share[h] * a
            imaginary[h] -= expected[i] * share[h] * b


@inner_kernel
def _crest_phases(place: FloatArray, start: IntArray, qx: float, qy: float) -> FloatArray:
    """Return the phase of the crests in each frame's crossings, in periods, shape (F,)."""
    phase = np.zeros(start.shape[0] - 1)
    for g in range(len(phase)):
        real, imaginary = 0.0, 0.0
        for i in range(start[g], start[g + 1]):
            angle = _TURN * (qx * place[i, 0] + qy * place[i, 1])
            real += np.cos(angle)
            imaginary += np.sin(angle)
        phase[g] = np.arctan2(imaginary, real) / _TURN
    return phase


@inline_kernel
def _off(turns: float) -> float:
    """Return the distance from the nearest whole number."""
    return float(abs(turns - np.rint(turns)))


@kernel
def off_crests(crossings: AllCrossings, qx: float, qy: float, n_lines: int) -> AllCrossings:
    """Remove the crossings and the pieces of spans on the crests of the wave (qx, qy).

    `n_lines` is the number of the lines of all frames.
    """
    place, start, begin, end = crossings.place, crossings.start, crossings.begin, crossings.end
    span_start, n_frames = crossings.span_start, len(crossings.start) - 1
    phase = _crest_phases(place, start, qx, qy)
    kept = np.zeros(place.shape[0], np.bool_)
    new_start, new_span_start = np.zeros_like(start), np.zeros_like(span_start)
    most = 0
    for i in range(begin.shape[0]):
        turns = qx * (end[i, 0] - begin[i, 0]) + qy * (end[i, 1] - begin[i, 1])
        most += int(abs(turns)) + 3
    low, high = np.empty((most, 2)), np.empty((most, 2))
    origin = np.empty(most, np.int64)
    n, m = 0, 0
    for g in range(n_frames):
        for i in range(start[g], start[g + 1]):
            kept[i] = _off(qx * place[i, 0] + qy * place[i, 1] - phase[g]) > _ON_CREST
            n += kept[i]
        new_start[g + 1] = n
        for i in range(span_start[g], span_start[g + 1]):
            a = qx * begin[i, 0] + qy * begin[i, 1] - phase[g]
            b = qx * end[i, 0] + qy * end[i, 1] - phase[g]
            m = _between(i, a, b, begin, end, low, high, origin, m)
        new_span_start[g + 1] = m
    low, high = low[:m].copy(), high[:m].copy()
    line, span_line = crossings.line[kept], crossings.span_line[origin[:m]]
    return AllCrossings(
        place[kept],
        line,
        new_start,
        low,
        high,
        span_line,
        new_span_start,
        expected_on(line, low, high, span_line, n_lines),
    )


@inner_kernel
def _between(
    i: int,
    a: float,
    b: float,
    begin: FloatArray,
    end: FloatArray,
    low: FloatArray,
    high: FloatArray,
    origin: IntArray,
    m: int,
) -> int:
    """Append the pieces of span i, whose phase runs from a to b, between crests."""
    if abs(b - a) < 1e-9:
        if _off(a) > _ON_CREST:
            low[m], high[m], origin[m] = begin[i], end[i], i
            m += 1
        return m
    least, greatest = min(a, b), max(a, b)
    crest = np.floor(least)
    while crest < greatest:
        first, last = max(crest + _ON_CREST, least), min(crest + 1.0 - _ON_CREST, greatest)
        if last > first:
            s, t = (first - a) / (b - a), (last - a) / (b - a)
            for k in range(2):
                low[m, k] = begin[i, k] + s * (end[i, k] - begin[i, k])
                high[m, k] = begin[i, k] + t * (end[i, k] - begin[i, k])
            origin[m] = i
            m += 1
        crest += 1.0
    return m


@kernel
def expected_on(
    line: IntArray, begin: FloatArray, end: FloatArray, span_line: IntArray, n_lines: int
) -> FloatArray:
    """Return the crossings (M,) on every span if those of its line were spread evenly."""
    length, total, seen = np.empty(len(span_line)), np.zeros(n_lines), np.zeros(n_lines)
    for i in range(len(span_line)):
        length[i] = np.hypot(end[i, 0] - begin[i, 0], end[i, 1] - begin[i, 1])
        total[span_line[i]] += length[i]
    for one in line:
        seen[one] += 1.0
    for i in range(len(span_line)):
        length[i] *= seen[span_line[i]] / max(total[span_line[i]], 1e-9)
    return length


@kernel
def wave_sums(
    place: FloatArray, begin: FloatArray, end: FloatArray, expected: FloatArray, waves: FloatArray
) -> NDArray[np.complex128]:
    """Return the sums (Q,) of waves over places, less those expected over spans.

    Parameters
    ----------
    place : array, shape (N, 2)
        Crossings of one frame.
    begin, end : array, shape (M, 2)
        Ends of the visible pieces of line.
    expected : array, shape (M,)
        Crossings expected on each.
    waves : array, shape (Q, 2)
        Wave vectors.
    """
    sums = np.zeros(len(waves), np.complex128)
    for k in range(len(waves)):
        qx, qy = waves[k]
        for i in range(len(place)):
            angle = _TURN * (qx * place[i, 0] + qy * place[i, 1])
            sums[k] += complex(np.cos(angle), np.sin(angle))
        for i in range(len(begin)):
            first = _TURN * (qx * begin[i, 0] + qy * begin[i, 1])
            last = _TURN * (qx * end[i, 0] + qy * end[i, 1])
            middle, half = 0.5 * (first + last), 0.5 * (last - first)
            share = np.sin(half) / half if abs(half) > 1e-6 else 1.0
            weight = expected[i] * share
            sums[k] -= complex(weight * np.cos(middle), weight * np.sin(middle))
    return sums


HIGHEST = 125.0
"""Largest frequency of waves, in periods a metre."""
MAX_HARMONICS, REGULAR = 6, 0.92
"""Harmonics of a family's wave that are used; each is weaker than the one before by the factor."""
SHELL_1 = 0.37
"""Amplitude of the waves in the first shell of a honeycomb's reciprocal lattice."""
SHARE_OF_REST = 0.8
"""Share of the other family in the crossings that are not on a family's crests."""
# The double of a first shell's wave may be strong or weak, depending on how the lines cut the net:
# its gain is its likelihood, less this. Where a frame has few crossings, about as many as this,
# strong waves are not expected, and the deduction is smaller.
_FREEDOM, _FEW_CROSSINGS = 0.7, 15.0


@inline_kernel
def gain_of(power: Any, mean: float) -> Any:
    """Return the log-likelihood of a power over random crossings, at an expected peak.

    `mean` is the expected power. A peak much higher than the model's counts as one twice as high.
    """
    return np.minimum(power, 2.0 * mean) * (1.0 - 1.0 / mean) - np.log(mean)


@inline_kernel
def free_gain_of(power: Any, per_frame: float) -> Any:
    """Return the gain where the mean is not known, less a penalty for the free parameter."""
    mean = np.maximum(power, 1.0)
    price = _FREEDOM * per_frame / (per_frame + _FEW_CROSSINGS)
    return mean - 1.0 - np.log(mean) - price


@kernel
def shell_gain(crossings: AllCrossings, basis: FloatArray) -> float:
    """Return the gain from the waves of a honeycomb that are longer than those of its bars' lines.

    `basis`, shape (2, 2): two waves of the first shell.
    """
    per_frame = len(crossings.place) / (len(crossings.start) - 1)
    gain = 0.0
    for k in range(3):
        qx = basis[k, 0] if k < 2 else basis[1, 0] - basis[0, 0]
        qy = basis[k, 1] if k < 2 else basis[1, 1] - basis[0, 1]
        power = comb_power(crossings, qx, qy, 2)
        gain += gain_of(power[0], 1.0 + per_frame * SHELL_1**2)
        gain += free_gain_of(power[1], per_frame)
    return gain


@kernel
def families_gain(crossings: AllCrossings, families: FloatArray, n_lines: int) -> float:
    """Return the gain from the strongest family, the next in the remainder, and so on.

    `families`, shape (F, 2): their waves; `n_lines`: number of the lines of all frames.
    """
    n = families.shape[0]
    strength = np.empty(n)
    for k in range(n):
        strength[k] = _comb_gain(crossings, families[k], 1.0 / n)
    order = np.argsort(strength)[::-1]
    gain = strength[order[0]]
    for k in range(1, n):
        before = families[order[k - 1]]
        crossings = off_crests(crossings, before[0], before[1], n_lines)
        # Crossings of the remaining families, less those on a crest by chance.
        share = SHARE_OF_REST / (n - k)
        gain += _comb_gain(crossings, families[order[k]], share)
    return float(gain)


@inner_kernel
def _comb_gain(crossings: AllCrossings, wave: FloatArray, share: float) -> float:
    """Return the gain from a family's harmonics that holds a share of the crossings."""
    # Gain if no crossings are left.
    nothing_left = 5.0
    if len(crossings.place) == 0:
        return -nothing_left
    per_frame = len(crossings.place) / (len(crossings.start) - 1)
    size = np.hypot(wave[0], wave[1])
    n_harmonics = int(max(1.0, min(HIGHEST // size, MAX_HARMONICS)))
    power = comb_power(crossings, wave[0], wave[1], n_harmonics)
    gain = 0.0
    for h in range(len(power)):
        mean = 1.0 + per_frame * (share * REGULAR ** (h + 1.0)) ** 2
        gain += gain_of(power[h], mean)
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
    """Return the penalty for the numbers of crossings that the lasers have seen.

    `families`, shape (F, 2): waves of the strands. `density`: share of each family's lines that
    exists. The others are attributes of `Spectrum`.
    """
    expected = np.zeros(len(seen))
    for i in range(len(lines)):
        rate = 0.0
        for wave in families:
            rate += abs(lines[i, 0] * wave[0] + lines[i, 1] * wave[1])
        expected[laser[i]] += rate * density * lines[i, 2]
    weight, mean, square = 0.0, 0.0, 0.0
    # Crossings seen over crossings that a lattice must have, less those that merge: spread of its
    # logarithm among lasers, variance of a frame's count of one, and spread of the mean towards
    # fewer (missing strands) and towards more.
    seen_spread, count_noise, few_seen, many_seen = 0.2, 0.3, 0.2, 0.12
    for k in range(len(seen)):
        if expected[k] > 0.0:
            count = max(float(seen[k]), 0.5)
            off = np.log(count / (expected[k] * max(1.0 - lit, 0.1)))
            one = 1.0 / (seen_spread**2 + count_noise * n_frames / count)
            weight, mean, square = weight + one, mean + one * off, square + one * off**2
    mean /= weight
    spread = few_seen if mean < 0.0 else many_seen
    return float(0.5 * (square - weight * mean**2) + mean**2 / (2.0 * spread**2))
