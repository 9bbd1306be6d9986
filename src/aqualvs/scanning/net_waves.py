"""Kernels of `net_spectrum`: sums of plane waves over places and over pieces of line.

A piece of line of length l with ends b and e adds l sinc(q·(e - b)) exp(2 pi i q·(b + e)/2), times
the crossings per metre that are expected on it.
"""

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import inline_kernel, kernel

# So near to a crest, in periods, a crossing belongs to the wave's family.
_ON_CREST = 0.12
_TURN = 2.0 * np.pi
# Lengths that differ by no more, in metres, and half a span's phase that counts as none.
_SAME, _SHORT = 1e-10, 1e-6


@kernel
def comb_power(
    place: FloatArray,
    start: IntArray,
    begin: FloatArray,
    end: FloatArray,
    expected: FloatArray,
    span_start: IntArray,
    qx: float,
    qy: float,
    power: FloatArray,
) -> None:
    """Add up the power of a wave's harmonics over frames.

    Parameters
    ----------
    place, start
        As `Spectrum`.
    begin, end, expected, span_start
        As `Spectrum`, with the crossings expected on each span, shape (M,).
    qx, qy : float
        The wave, in periods a metre.
    power : array, shape (n,)
        Of n harmonics; added to in place.
    """
    n = power.shape[0]
    real, imaginary, share = np.zeros(n), np.zeros(n), np.zeros(n)
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
        _add_spans(
            begin, end, expected, span_start[g], span_start[g + 1], qx, qy, real, imaginary, share
        )
        for h in range(n):
            power[h] += real[h] ** 2 + imaginary[h] ** 2


@inline_kernel
def _add_spans(
    begin: FloatArray,
    end: FloatArray,
    expected: FloatArray,
    from_: int,
    to: int,
    qx: float,
    qy: float,
    real: FloatArray,
    imaginary: FloatArray,
    share: FloatArray,
) -> None:
    """Take what is expected on some spans off the sums of a wave's harmonics.

    Pieces of one line that follow one another evenly turn by the same angle: that saves most of
    the sines.
    """
    n = real.shape[0]
    c, s, turn_c, turn_s, ch, sh = 1.0, 0.0, 1.0, 0.0, 1.0, 0.0
    middle_x, middle_y, step_x, step_y, half_x, half_y = 0.0, 0.0, np.inf, 0.0, np.inf, 0.0
    for i in range(from_, to):
        x, y = 0.5 * (begin[i, 0] + end[i, 0]), 0.5 * (begin[i, 1] + end[i, 1])
        u, v = 0.5 * (end[i, 0] - begin[i, 0]), 0.5 * (end[i, 1] - begin[i, 1])
        if abs(x - middle_x - step_x) + abs(y - middle_y - step_y) < _SAME:
            c, s = c * turn_c - s * turn_s, s * turn_c + c * turn_s
        else:
            angle = _TURN * (qx * x + qy * y)
            before_c, before_s = c, s
            c, s = np.cos(angle), np.sin(angle)
            turn_c, turn_s = c * before_c + s * before_s, s * before_c - c * before_s
            step_x, step_y = x - middle_x, y - middle_y
        middle_x, middle_y = x, y
        if abs(u - half_x) + abs(v - half_y) > _SAME:
            half_x, half_y = u, v
            half = _TURN * (qx * u + qy * v)
            ch, sh = np.cos(half), np.sin(half)
            xh, yh = 1.0, 0.0
            for h in range(n):
                xh, yh = xh * ch - yh * sh, xh * sh + yh * ch
                share[h] = yh / ((h + 1) * half) if abs(half) > _SHORT else 1.0
        a, b = 1.0, 0.0
        for h in range(n):
            a, b = a * c - b * s, a * s + b * c
            real[h] -= expected[i] * share[h] * a
            imaginary[h] -= expected[i] * share[h] * b


@kernel
def crest_phases(place: FloatArray, start: IntArray, qx: float, qy: float) -> FloatArray:
    """Where each frame's crossings have their crests in a wave, in periods, shape (F,)."""
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
    """Distance from the nearest whole number."""
    return float(abs(turns - np.rint(turns)))


@kernel
def off_crests(
    place: FloatArray,
    start: IntArray,
    begin: FloatArray,
    end: FloatArray,
    span_start: IntArray,
    phase: FloatArray,
    qx: float,
    qy: float,
) -> tuple[BoolArray, IntArray, FloatArray, FloatArray, IntArray, IntArray]:
    """Leave out what lies on the crests of a wave.

    Parameters
    ----------
    place, start, begin, end, span_start
        As `Spectrum`.
    phase : array, shape (F,)
        Of the crests in each frame.
    qx, qy : float
        The wave.

    Returns
    -------
    kept : bool array, shape (N,)
        Crossings between crests.
    start : int array, shape (F + 1,)
        Where each frame's begin among those.
    begin, end : array, shape (m, 2)
        Pieces of spans between crests.
    origin : int array, shape (m,)
        Spans that they are pieces of.
    span_start : int array, shape (F + 1,)
        Where each frame's pieces begin.
    """
    n_frames = start.shape[0] - 1
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
    return kept, new_start, low[:m].copy(), high[:m].copy(), origin[:m].copy(), new_span_start


@kernel
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
    """Crossings (M,) on every span if those of its line were spread evenly over what is seen."""
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
) -> tuple[FloatArray, FloatArray]:
    """Return the sums of waves over places, less what is expected over spans.

    Parameters
    ----------
    place : array, shape (N, 2)
        Crossings of one frame.
    begin, end : array, shape (M, 2)
        Of pieces of line that could be seen.
    expected : array, shape (M,)
        Crossings expected on each.
    waves : array, shape (Q, 2)
        Wave vectors.

    Returns
    -------
    real, imaginary : array, shape (Q,)
    """
    real, imaginary = np.zeros(len(waves)), np.zeros(len(waves))
    for k in range(len(waves)):
        qx, qy = waves[k]
        for i in range(len(place)):
            angle = _TURN * (qx * place[i, 0] + qy * place[i, 1])
            real[k] += np.cos(angle)
            imaginary[k] += np.sin(angle)
        for i in range(len(begin)):
            first = _TURN * (qx * begin[i, 0] + qy * begin[i, 1])
            last = _TURN * (qx * end[i, 0] + qy * end[i, 1])
            middle, half = 0.5 * (first + last), 0.5 * (last - first)
            share = np.sin(half) / half if abs(half) > 1e-6 else 1.0
            real[k] -= expected[i] * share * np.cos(middle)
            imaginary[k] -= expected[i] * share * np.sin(middle)
    return real, imaginary
