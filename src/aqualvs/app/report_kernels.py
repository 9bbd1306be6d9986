"""The one loop of the report that touches every point of a dive."""

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel


@borrowing_kernel
def add_points(
    frame: IntArray,
    laser: IntArray,
    label: IntArray,
    used: BoolArray,
    x: FloatArray,
    y: FloatArray,
    z: FloatArray,
    frames: IntArray,
    planes: FloatArray,
    labels: IntArray,
    on_target: IntArray,
    squares: FloatArray,
    n_squares: IntArray,
    residual: IntArray,
    lowest: float,
    step: float,
    target: IntArray,
) -> int:
    """Add points to the sums of a dive, and list those on the target.

    Parameters
    ----------
    frame, laser, label, used : array, shape (N,)
        Points of a frame that is not among `frames`, or of a laser beyond those of `labels`, are
        passed over.
    x, y, z : array, shape (N,)
        Metres in `dome`.
    frames : int array, shape (T,), ascending
    planes : array, shape (T, 4)
        Unit normal and distance in metres of each frame's target; NaN where it has none.
    labels, on_target, squares, n_squares, residual : array
        As `PointSummary` has them, added to; squares in mm².
    lowest, step : float
        First edge and width of the bins of `residual`, in mm.
    target : int array, shape (N,)
        Receives the numbers of the points on the target.

    Returns
    -------
    n_target : int
        How many those are.
    """
    n_target, row, known = 0, -1, False
    last_bin = residual.shape[1] - 1
    for i in range(frame.shape[0]):
        if row < 0 or frames[row] != frame[i]:
            row = np.searchsorted(frames, frame[i])
            row = min(row, frames.shape[0] - 1)
            known = frames[row] == frame[i]
        k = laser[i]
        if not known or k < 0 or k >= labels.shape[0]:
            continue
        labels[k, min(max(label[i], 0), labels.shape[1] - 1)] += 1
        if not (used[i] and np.isfinite(x[i]) and np.isfinite(y[i]) and np.isfinite(z[i])):
            continue
        target[n_target] = i
        n_target += 1
        on_target[row, k] += 1
        off = planes[row, 0] * x[i] + planes[row, 1] * y[i] + planes[row, 2] * z[i]
        off = 1e3 * (off - planes[row, 3])
        if np.isfinite(off):
            squares[row] += off * off
            n_squares[row] += 1
            place = (off - lowest) / step
            residual[k, int(min(max(place, 0.0), float(last_bin)))] += 1
    return n_target
