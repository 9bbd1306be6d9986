"""Array types, and checks of the array arguments of public functions."""

from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray: TypeAlias = NDArray[np.float64]
BoolArray: TypeAlias = NDArray[np.bool_]
IntArray: TypeAlias = NDArray[np.int64]
U8Array: TypeAlias = NDArray[np.uint8]


def as_vectors(values: ArrayLike, size: int, name: str) -> FloatArray:
    """Return `values` as a contiguous float64 array of shape (..., size).

    Raises
    ------
    ValueError
        If the last axis does not have length `size`; the message names `name` and the shape.
    """
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != size:
        raise ValueError(f"{name} has shape {array.shape} but expected (..., {size})")
    return array


def runs_of(mask: BoolArray) -> IntArray:
    """Return first and last index of each run of True in a mask (N,), shape (K, 2)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return np.asarray(edges.reshape(-1, 2) - np.array([0, 1]))
