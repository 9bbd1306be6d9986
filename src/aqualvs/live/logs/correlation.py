"""How well two motions agree at every time offset, and at one offset in detail."""

from dataclasses import dataclass

import numpy as np
from scipy import fft

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.live.logs.motion import STEP_S, Rates, correlation_time


@dataclass(frozen=True, slots=True)
class Channel:
    """One angle, seen from the net and logged by the vehicle.

    Attributes
    ----------
    name : str
        'yaw' or 'pitch'.
    seen : Rates
        Of the posture, in dive time.
    logged : Rates
        Of the vehicle, in log time. Posture's angles change opposite to the vehicle's.
    """

    name: str
    seen: Rates
    logged: Rates


@dataclass(frozen=True, slots=True)
class Scores:
    """Agreement of all channels at every offset of the grid.

    Attributes
    ----------
    offset_s : array, shape (k,)
        Log time minus dive time, rising by `STEP_S`.
    score : array, shape (k,)
        Logarithm of the likelihood ratio between "the motions agree" and "they do not".
    overlap_s : array, shape (k,)
        Time for which both are known, of the channel that has most.
    """

    offset_s: FloatArray
    score: FloatArray
    overlap_s: FloatArray


def scores_of(channels: tuple[Channel, ...]) -> Scores:
    """Return the agreement at every offset at which dive and log overlap.

    Channels must start at the same times and have the same lengths.
    """
    first = channels[0]
    before = len(first.seen.rate) - 1
    lags = np.arange(-before, len(first.logged.rate))
    score, overlap = np.zeros(len(lags)), np.zeros(len(lags))
    for channel in channels:
        rho, count = _correlations(channel.seen, channel.logged)
        independent = count * STEP_S / correlation_time(channel.seen, channel.logged)
        opposite = np.clip(-rho, 0.0, 0.9999)
        score -= 0.5 * independent * np.log1p(-(opposite**2))
        overlap = np.maximum(overlap, count * STEP_S)
    offset_s: FloatArray = (
        first.logged.start_s - first.seen.start_s + STEP_S * lags.astype(np.float64)
    )
    return Scores(offset_s, score, overlap)


def _correlations(seen: Rates, logged: Rates) -> tuple[FloatArray, FloatArray]:
    """Return the correlation coefficient, and the pairs it rests on, for every lag."""
    a, b = seen.rate, logged.rate
    size = fft.next_fast_len(len(a) + len(b) - 1, real=True)
    fa, fa2, fma = (fft.rfft(x, size) for x in (a, a**2, seen.valid.astype(float)))
    fb, fb2, fmb = (fft.rfft(x, size) for x in (b, b**2, logged.valid.astype(float)))

    def pairs(x: np.ndarray, y: np.ndarray) -> FloatArray:
        products: FloatArray = fft.irfft(np.conj(x) * y, size)
        return np.concatenate([products[size - len(a) + 1 :], products[: len(b)]])

    count = np.round(pairs(fma, fmb))
    n = np.maximum(count, 1.0)
    mean_a, mean_b = pairs(fa, fmb) / n, pairs(fma, fb) / n
    var_a, var_b = pairs(fa2, fmb) / n - mean_a**2, pairs(fma, fb2) / n - mean_b**2
    # Relative to the whole, so that rounding of the transform cannot pass for motion.
    moving = (var_a > 1e-6 * np.mean(a**2)) & (var_b > 1e-6 * np.mean(b**2)) & (count > 0)
    spread = np.sqrt(np.where(moving, var_a * var_b, 1.0))
    rho = np.where(moving, (pairs(fa, fb) / n - mean_a * mean_b) / spread, 0.0)
    return np.clip(rho, -1.0, 1.0), count


@dataclass(frozen=True, slots=True)
class Match:
    """Seen and logged rates of a channel at one offset, sample by sample of the seen ones.

    Attributes
    ----------
    residual : array, shape (n,)
        Seen rate less what the logged one predicts; less the mean only, where it is not known.
    predicted : bool array, shape (n,)
        Where both rates are known.
    gain : float
        Share of the vehicle's motion that the net shows: 1 for a plane, still net.
    slope : array, shape (n,)
        Change of the logged rate with time, 0 where not known.
    correlation : float
        Between seen and opposite logged rates.
    """

    residual: FloatArray
    predicted: BoolArray
    gain: float
    slope: FloatArray
    correlation: float


def match_at(channel: Channel, offset_s: float) -> Match:
    """Return how a channel agrees at one offset, not bound to the grid."""
    seen, logged = channel.seen, channel.logged
    where = (seen.time_s + offset_s - logged.start_s) / STEP_S
    below = np.floor(where).astype(np.int64)
    inside = (below >= 0) & (below < len(logged.rate) - 1)
    below = np.where(inside, below, 0)
    both = inside & seen.valid & logged.valid[below]
    both &= logged.valid[np.minimum(below + 1, len(logged.rate) - 1)]
    rate, slope = _between(logged.rate, below, where - below)
    y = seen.rate
    residual = np.where(seen.valid, y, 0.0)
    if np.count_nonzero(both) < 3:
        return Match(residual, both, 0.0, np.zeros(len(y)), 0.0)
    dx, dy = rate - rate[both].mean(), y - y[both].mean()
    sxx, syy, sxy = dx[both] @ dx[both], dy[both] @ dy[both], dx[both] @ dy[both]
    if sxx <= 0.0 or syy <= 0.0:
        return Match(residual, both, 0.0, np.zeros(len(y)), 0.0)
    gain = max(-float(sxy / sxx), 0.0)
    residual = np.where(both, dy + gain * dx, residual)
    correlation = -float(sxy / np.sqrt(sxx * syy))
    return Match(residual, both, gain, np.where(both, slope, 0.0), correlation)


def _between(
    values: FloatArray, below: IntArray, share: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return values between grid points, and their slopes (central differences)."""
    last = len(values) - 1
    before, first, second, after = (
        values[np.clip(below + step, 0, last)] for step in (-1, 0, 1, 2)
    )
    rise, next_rise = (second - before) / (2.0 * STEP_S), (after - first) / (2.0 * STEP_S)
    return first + share * (second - first), rise + share * (next_rise - rise)
