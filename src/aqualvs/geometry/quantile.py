"""Quantiles and sums of arrays, for compiled kernels."""

import numpy as np

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import inline_borrowing_kernel, inline_kernel, kernel

_N_BINS = 256


@kernel
def element_at(values: FloatArray, share: float) -> float:
    """Return the element below which a share of the values lie; 0 if there are no values.

    NaN counts as highest. The values are counted in bins, and only one bin is sorted; a partition
    takes longer, because its branches cannot be predicted.
    """
    n = values.shape[0]
    if n == 0:
        return 0.0
    low, high = np.inf, -np.inf
    for i in range(n):
        low = values[i] if values[i] < low else low
        high = values[i] if values[i] > high else high
    per_level = _N_BINS / (high - low) if low < high else 0.0
    count, rank = np.zeros(_N_BINS + 1, np.int64), int(share * (n - 1))
    for i in range(n):
        count[_bin_of(values[i], low, per_level)] += 1
    # The bin that holds the element, and the number of values in lower bins.
    which, below = 0, 0
    while below + count[which] <= rank:
        below += count[which]
        which += 1
    found, n_found = np.empty(count[which]), 0
    for i in range(n):
        if _bin_of(values[i], low, per_level) == which:
            found[n_found] = values[i]
            n_found += 1
    # Sorted by indices, as elsewhere: each kind of sort takes long to compile.
    return float(found[np.argsort(found)[rank - below]])


@inline_kernel
def sum_of(values: FloatArray | IntArray) -> float:
    """Return the sum of values; takes less time to compile than `numpy.sum`."""
    found = 0.0
    for i in range(values.shape[0]):
        found += values[i]
    return found


@inline_borrowing_kernel
def _bin_of(value: float, low: float, per_level: float) -> int:
    place = (value - low) * per_level
    return int(place) if place < _N_BINS else _N_BINS
