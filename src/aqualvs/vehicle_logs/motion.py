"""Angular motion as band-passed rates on a uniform grid, and the correlation of two motions.

`rates_of` computes the rates; `scores_of` scores the agreement at every time offset, `match_at` at
one offset, sample by sample.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft, ndimage

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.vehicle_logs.vehicle_log import Interpolation, Signal

STEP_S = 0.05
"""Step of the grid: a finer one would resolve only what the smoothing below removes."""
SMOOTHING_S = 0.4
"""Standard deviation of the Gaussian window of a rate. Noise of the posture of 0.4 degrees at 25 Hz
leaves 0.1 degrees/s; a vehicle's own motion is slower than this window."""
_TREND_S = 5.0
"""Standard deviation of the window whose mean is subtracted, which removes slower changes: the
net's own bearing along a cage, the drift of a compass."""


class Rates(NamedTuple):
    """Band-passed rates of one angle."""

    start_s: float  # Time of the first rate; the step is `STEP_S`.
    rate: FloatArray  # Shape (n,): rad/s, with outliers clipped; 0 where not valid.
    valid: BoolArray  # Shape (n,): False where there are too few values.

    @property
    def time_s(self) -> FloatArray:
        """Times of the rates, shape (n,)."""
        return self.start_s + STEP_S * np.arange(len(self.rate), dtype=np.float64)


def rates_of(angle: Signal, start_s: float, end_s: float) -> Rates:
    """Return the band-passed rates of an angle on a grid from one time to another."""
    times: FloatArray = np.arange(start_s, end_s + STEP_S, STEP_S, dtype=np.float64)
    unwrapped = Signal(angle.time_s, np.unwrap(angle.values), Interpolation.LINEAR, angle.max_gap_s)
    values, valid = unwrapped.at(times)
    rate, known = _slopes(np.where(valid, values, 0.0), valid)
    rate = rate - _smooth(np.where(known, rate, 0.0), known)
    # Rates are clipped to the larger of these limits, so that no single false reading decides.
    clip_sigmas, clip_rate = 4.0, math.radians(5.0)
    limit = max(clip_sigmas * robust_sigma(rate[known]), clip_rate)
    return Rates(float(times[0]), np.where(known, np.clip(rate, -limit, limit), 0.0), known)


def without_outliers(angle: ArrayLike, valid: ArrayLike) -> BoolArray:
    """Return the mask (n,) of valid samples near their neighbours (a Hampel filter).

    `angle`, shape (n,): in radians and in the order of time.
    """
    values, kept = np.asarray(angle, float), np.array(valid, bool)
    kept &= np.isfinite(values)
    # Samples of the running median; deviations up to the larger of both limits are kept.
    n_samples, max_sigmas, max_angle = 11, 5.0, math.radians(2.0)
    if np.count_nonzero(kept) < n_samples:
        return kept
    chosen = values[kept]
    deviation = np.abs(chosen - ndimage.median_filter(chosen, n_samples, mode="nearest"))
    kept[kept] = deviation <= max(max_sigmas * robust_sigma(deviation), max_angle)
    return kept


def robust_sigma(values: FloatArray) -> float:
    """Return the standard deviation by the median of the magnitudes; 0 for no values."""
    return 1.4826 * float(np.median(np.abs(values))) if len(values) else 0.0


def _slopes(values: FloatArray, valid: BoolArray) -> tuple[FloatArray, BoolArray]:
    """Return the slope of the best line in a Gaussian window around each sample, and where valid.

    Unlike differences, this tolerates missing samples and averages over the others.
    """
    reach = math.ceil(3.0 * SMOOTHING_S / STEP_S)
    lag = STEP_S * np.arange(-reach, reach + 1)
    window = np.exp(-0.5 * (lag / SMOOTHING_S) ** 2)
    centred = np.where(valid, values - values[valid].mean(), 0.0) if valid.any() else values
    count = valid.astype(float)
    # Odd kernels are negated, because convolution reverses them.
    s0, s2 = _convolve(count, window), _convolve(count, window * lag**2)
    s1, sx = _convolve(count, -window * lag), _convolve(centred, window)
    stx = _convolve(centred, -window * lag)
    spread = s0 * s2 - s1**2
    whole = window.sum()
    # Least share of the window's weight with values.
    min_cover = 0.5
    known = (s0 >= min_cover * whole) & (spread >= min_cover**2 * whole * window @ lag**2)
    slope = (s0 * stx - s1 * sx) / np.where(known, spread, 1.0)
    return np.where(known, slope, 0.0), known


def _smooth(values: FloatArray, valid: BoolArray) -> FloatArray:
    """Return the mean of valid samples in a wide Gaussian window."""
    reach = math.ceil(3.0 * _TREND_S / STEP_S)
    window = np.exp(-0.5 * (STEP_S * np.arange(-reach, reach + 1) / _TREND_S) ** 2)
    weight = _convolve(valid.astype(float), window)
    # Rounding of the transform leaves tiny weights where there is no sample.
    found = weight > 1e-6 * window.sum()
    total: FloatArray = _convolve(values, window)
    return np.where(found, total / np.where(found, weight, 1.0), 0.0)


def _convolve(values: FloatArray, window: FloatArray) -> FloatArray:
    # Imported here: it takes a second, and only this function needs it.
    from scipy.signal import oaconvolve

    whole: FloatArray = oaconvolve(values, window, mode="full")
    reach = len(window) // 2
    return whole[reach : reach + len(values)]


def correlation_time(first: Rates, second: Rates) -> float:
    """Return the time per independent pair of values, in seconds (Bartlett, 1946).

    It is the integral over lag of the product of both autocorrelations.
    """
    reach = round(4.0 * _TREND_S / STEP_S)
    product = _autocorrelation(first, reach) * _autocorrelation(second, reach)
    return max(STEP_S * float(2.0 * product.sum() - product[0]), STEP_S)


def _autocorrelation(rates: Rates, reach: int) -> FloatArray:
    """Return the autocorrelation at lags 0 to `reach` - 1, over valid pairs."""
    values = rates.rate
    size = fft.next_fast_len(len(values) + reach, real=True)
    spectrum = np.abs(fft.rfft(values, size)) ** 2
    counts = np.abs(fft.rfft(rates.valid.astype(float), size)) ** 2
    products = fft.irfft(spectrum, size)[:reach]
    pairs = np.maximum(fft.irfft(counts, size)[:reach], 1.0)
    mean: FloatArray = products / pairs
    return mean / mean[0] if mean[0] > 0.0 else np.ones(reach)


class Channel(NamedTuple):
    """Rates of one angle, measured relative to the net and logged by the vehicle."""

    name: str  # 'yaw' or 'pitch'.
    seen: Rates  # Of the posture, in dive time.
    logged: Rates  # Of the vehicle, in log time; of opposite sign.


@dataclass(frozen=True, slots=True)
class OffsetScores:
    """Agreement of all channels at every offset of the grid."""

    offset_s: FloatArray  # Shape (k,): log time minus dive time, rising by `STEP_S`.
    # Shape (k,): logarithm of the likelihood ratio between "the motions agree" and "they do not".
    score: FloatArray
    # Shape (k,): duration for which both rates are valid, of the channel with the longest.
    overlap_s: FloatArray


def scores_of(channels: tuple[Channel, ...]) -> OffsetScores:
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
    begin_s = first.logged.start_s - first.seen.start_s
    return OffsetScores(begin_s + STEP_S * lags.astype(np.float64), score, overlap)


def _correlations(seen: Rates, logged: Rates) -> tuple[FloatArray, FloatArray]:
    """Return the correlation coefficient and the number of valid pairs for every lag."""
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
    # Relative to the sum, so that rounding errors of the transform do not count as motion.
    moving = (var_a > 1e-6 * np.mean(a**2)) & (var_b > 1e-6 * np.mean(b**2)) & (count > 0)
    spread = np.sqrt(np.where(moving, var_a * var_b, 1.0))
    rho = np.where(moving, (pairs(fa, fb) / n - mean_a * mean_b) / spread, 0.0)
    return np.clip(rho, -1.0, 1.0), count


class Match(NamedTuple):
    """Seen and logged rates of a channel at one offset, sample by sample of the seen ones."""

    # Shape (n,): seen rate minus its prediction from the logged one; the seen rate itself where the
    # logged one is not valid.
    residual: FloatArray
    predicted: BoolArray  # Shape (n,): where both rates are valid.
    gain: float  # Ratio of the seen to the (opposite) logged motion: 1 for a plane, still net.
    slope: FloatArray  # Shape (n,): derivative of the logged rate, 0 where not valid.
    correlation: float  # Of seen and opposite logged rates.


def match_at(channel: Channel, offset_s: float) -> Match:
    """Return the agreement of a channel at one offset, which need not be on the grid."""
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
    nothing = Match(residual, both, 0.0, np.zeros(len(y)), 0.0)
    if np.count_nonzero(both) < 3:
        return nothing
    dx, dy = rate - rate[both].mean(), y - y[both].mean()
    sxx, syy, sxy = dx[both] @ dx[both], dy[both] @ dy[both], dx[both] @ dy[both]
    if sxx <= 0.0 or syy <= 0.0:
        return nothing
    gain = max(-float(sxy / sxx), 0.0)
    residual = np.where(both, dy + gain * dx, residual)
    correlation = -float(sxy / np.sqrt(sxx * syy))
    return Match(residual, both, gain, np.where(both, slope, 0.0), correlation)


def _between(
    values: FloatArray, below: IntArray, share: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Interpolate values and their slopes (central differences) between grid points."""
    last = len(values) - 1
    before, first, second, after = (
        values[np.clip(below + step, 0, last)] for step in (-1, 0, 1, 2)
    )
    rise, next_rise = (second - before) / (2.0 * STEP_S), (after - first) / (2.0 * STEP_S)
    return first + share * (second - first), rise + share * (next_rise - rise)
