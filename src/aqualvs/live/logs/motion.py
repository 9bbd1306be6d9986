"""Angles over time as band-passed rates on an even grid, the form in which motions are compared."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft, ndimage

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.live.logs.signals import Interpolation, Signal

STEP_S = 0.05
"""Of the grid; what is faster than the smoothing below is noise, so finer would tell nothing."""
SMOOTHING_S = 0.4
"""Standard deviation of the window over which a rate is taken. Posture's noise of 0.4 degrees at
25 Hz leaves a rate of 0.1 degrees a second; a vehicle's own motion is slower than this window."""
_TREND_S = 5.0
"""What changes more slowly is left out: the net's own bearing along a cage, drift of a compass."""
_LEAST_COVER = 0.5
"""Share of the window that must hold values."""
_CLIP_SIGMAS = 4.0
_CLIP_RATE = math.radians(5.0)
"""Rates beyond both are cut down to the larger one, lest one false reading decides."""
_HAMPEL_SAMPLES = 11
_HAMPEL_SIGMAS = 5.0
_HAMPEL_ANGLE = math.radians(2.0)


@dataclass(frozen=True, slots=True)
class Rates:
    """Band-passed rates of one angle.

    Attributes
    ----------
    start_s : float
        Time of the first; they are `STEP_S` apart.
    rate : array, shape (n,)
        Radians a second, extreme ones cut down; 0 where not valid.
    valid : bool array, shape (n,)
        Where there are values enough to tell.
    """

    start_s: float
    rate: FloatArray
    valid: BoolArray

    @property
    def time_s(self) -> FloatArray:
        """Times of the rates, shape (n,)."""
        return self.start_s + STEP_S * np.arange(len(self.rate), dtype=np.float64)


def rates_of(angle: Signal, start_s: float, end_s: float) -> Rates:
    """Return the band-passed rates of an angle on a grid from one time to another."""
    times: FloatArray = np.arange(start_s, end_s + STEP_S, STEP_S, dtype=np.float64)
    unwrapped = Signal(angle.time_s, angle.unwrapped(), Interpolation.LINEAR, angle.max_gap_s)
    values, valid = unwrapped.at(times)
    rate, known = _slopes(np.where(valid, values, 0.0), valid)
    rate = rate - _smooth(np.where(known, rate, 0.0), known)
    limit = max(_CLIP_SIGMAS * robust_sigma(rate[known]), _CLIP_RATE)
    return Rates(float(times[0]), np.where(known, np.clip(rate, -limit, limit), 0.0), known)


def without_outliers(angle: ArrayLike, valid: ArrayLike) -> BoolArray:
    """Return which valid samples are not far from their neighbours.

    Parameters
    ----------
    angle : array, shape (n,)
        Radians, in the order of time.
    valid : bool array, shape (n,)
        Samples that count at all.
    """
    values, kept = np.asarray(angle, float), np.array(valid, bool)
    kept &= np.isfinite(values)
    if np.count_nonzero(kept) < _HAMPEL_SAMPLES:
        return kept
    chosen = values[kept]
    off = np.abs(chosen - ndimage.median_filter(chosen, _HAMPEL_SAMPLES, mode="nearest"))
    limit = max(_HAMPEL_SIGMAS * 1.4826 * float(np.median(off)), _HAMPEL_ANGLE)
    kept[kept] = off <= limit
    return kept


def robust_sigma(values: FloatArray) -> float:
    """Return the standard deviation that the median of the magnitudes stands for; 0 for none."""
    return 1.4826 * float(np.median(np.abs(values))) if len(values) else 0.0


def _slopes(values: FloatArray, valid: BoolArray) -> tuple[FloatArray, BoolArray]:
    """Return the slope of the line that fits best within a Gaussian window about each sample.

    Unlike a difference, it copes with missing samples and averages the others.
    """
    reach = math.ceil(3.0 * SMOOTHING_S / STEP_S)
    lag = STEP_S * np.arange(-reach, reach + 1)
    window = np.exp(-0.5 * (lag / SMOOTHING_S) ** 2)
    centred = np.where(valid, values - values[valid].mean(), 0.0) if valid.any() else values
    count = valid.astype(float)
    # Reversed kernels, since convolution turns them round.
    s0, s2 = _convolve(count, window), _convolve(count, window * lag**2)
    s1, sx = _convolve(count, -window * lag), _convolve(centred, window)
    stx = _convolve(centred, -window * lag)
    spread = s0 * s2 - s1**2
    whole = window.sum()
    known = (s0 >= _LEAST_COVER * whole) & (spread >= _LEAST_COVER**2 * whole * window @ lag**2)
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
    # A second to import, which only this needs.
    from scipy.signal import oaconvolve

    whole: FloatArray = oaconvolve(values, window, mode="full")
    reach = len(window) // 2
    return whole[reach : reach + len(values)]


def correlation_time(first: Rates, second: Rates) -> float:
    """Return how much time one independent pair of values takes, in seconds (Bartlett, 1946).

    It is the integral over lag of the product of both autocorrelations.
    """
    reach = round(4.0 * _TREND_S / STEP_S)
    product = _autocorrelation(first, reach) * _autocorrelation(second, reach)
    return max(STEP_S * float(2.0 * product.sum() - product[0]), STEP_S)


def _autocorrelation(rates: Rates, reach: int) -> FloatArray:
    values = rates.rate
    size = fft.next_fast_len(len(values) + reach, real=True)
    spectrum = np.abs(fft.rfft(values, size)) ** 2
    counts = np.abs(fft.rfft(rates.valid.astype(float), size)) ** 2
    products = fft.irfft(spectrum, size)[:reach]
    pairs = np.maximum(fft.irfft(counts, size)[:reach], 1.0)
    mean: FloatArray = products / pairs
    return mean / mean[0] if mean[0] > 0.0 else np.ones(reach)
