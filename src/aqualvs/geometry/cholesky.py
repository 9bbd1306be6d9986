"""Positive definite systems of a few unknowns inside compiled kernels, by Cholesky's factor.

Six unknowns are solved in less time than it takes to hand them to LAPACK.
"""

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.compiled import borrowing_kernel, kernel

# A pivot below this share of its diagonal is rounding, not information.
_SINGULAR = 1e-13


@borrowing_kernel
def factorise(matrix: FloatArray) -> bool:
    """Turn a matrix (N, N), of which only the lower half is read, into its factor, in place.

    False where it is singular to rounding, or not positive; half of it is overwritten then.
    """
    for j in range(matrix.shape[0]):
        own = matrix[j, j]
        for k in range(j):
            rest = matrix[j, k]
            for a in range(k):
                rest -= matrix[j, a] * matrix[k, a]
            matrix[j, k] = rest / matrix[k, k]
        pivot = own
        for a in range(j):
            pivot -= matrix[j, a] * matrix[j, a]
        if not pivot > _SINGULAR * own:
            return False
        matrix[j, j] = np.sqrt(pivot)
    return True


@borrowing_kernel
def substitute(factor: FloatArray, right: FloatArray) -> None:
    """Solve the system of a factor (N, N) for a right-hand side (N), in place."""
    n = right.shape[0]
    for j in range(n):
        rest = right[j]
        for k in range(j):
            rest -= factor[j, k] * right[k]
        right[j] = rest / factor[j, j]
    for j in range(n - 1, -1, -1):
        rest = right[j]
        for k in range(j + 1, n):
            rest -= factor[k, j] * right[k]
        right[j] = rest / factor[j, j]


@kernel
def inverse_of(factor: FloatArray) -> FloatArray:
    """Return the inverse (N, N) of the matrix that a factor was made from."""
    inverse = np.eye(factor.shape[0])
    for k in range(factor.shape[0]):
        substitute(factor, inverse[k])
    return inverse
