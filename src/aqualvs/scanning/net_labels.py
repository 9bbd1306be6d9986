"""Light that belongs to the target although the search for planes left it out.

A plane is sought with a narrow gate, among whole pieces of stripe, so that nothing foreign enters
the posture. To say what a point lies on, the gate may be wider: a strand's light is off the plane
by the strand's thickness, a net bulges, and where stripes cross two lasers share the light.
"""

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import kernel

# Distance from the target at which light belongs to it: a share of the range, and pixels.
_NEAR_SHARE = 0.010
_NEAR_PX = 2.0
# What of a piece must be near.
_MOST = 0.5
# Light counts as on a plane, or beside it, within these shares of the range.
_ON_IT, _BESIDE = 0.008, 0.04
MUCH, SOME = 0.85, 0.5
"""Light beside a plane over light on it."""


def much_beside(off: FloatArray, much: float = MUCH) -> bool:
    """Tell whether so much light lies just off a plane that the net may bend away from it.

    Where stripes cross, wrong readings lie there as well.

    Parameters
    ----------
    off : array, shape (N,)
        Distances of the readings from the plane, as shares of the range.
    much : float
        Light beside the plane over light on it.
    """
    on_it, near = np.count_nonzero(off < _ON_IT), np.count_nonzero(off < _BESIDE)
    return bool(near - on_it > much * on_it)


@kernel
def recruit(
    points: FloatArray,
    sensitivity: FloatArray,
    chunk_index: IntArray,
    n_chunks: int,
    patch: FloatArray,
    other: BoolArray,
    taken: BoolArray,
    on_target: BoolArray,
) -> None:
    """Mark readings near the target as on it.

    Parameters
    ----------
    points, sensitivity : array, shape (N, 3)
        Of the readings, in `dome`: metres, and m/px.
    chunk_index : int array, shape (N,)
        Chunk of each reading, below `n_chunks`.
    patch : array, shape (16,)
        The target as `Patch.packed` gives it.
    other : bool array, shape (N,)
        Readings that another surface explains.
    taken : bool array, shape (N,)
        Readings of light that another surface explains by some reading.
    on_target : bool array, shape (N,)
        Readings on the target; completed in place.
    """
    n = points.shape[0]
    near = np.zeros(n, np.bool_)
    n_near, n_all = np.zeros(n_chunks), np.zeros(n_chunks)
    by_range = _NEAR_SHARE * patch[3]
    for i in range(n):
        off = -patch[3]
        per_px = 0.0
        u = 0.0
        v = 0.0
        for k in range(3):
            off += patch[k] * points[i, k]
            per_px += patch[k] * sensitivity[i, k]
            u += patch[4 + k] * points[i, k]
            v += patch[7 + k] * points[i, k]
        off -= patch[10] + patch[11] * u + patch[12] * v
        off -= 0.5 * (patch[13] * u * u + patch[15] * v * v) + patch[14] * u * v
        by_pixel = _NEAR_PX * per_px
        near[i] = off * off < by_range * by_range + by_pixel * by_pixel
        n_all[chunk_index[i]] += 1.0
        n_near[chunk_index[i]] += near[i]
    for i in range(n):
        c = chunk_index[i]
        if near[i] and n_near[c] >= _MOST * n_all[c] and (other[i] or not taken[i]):
            on_target[i] = True
