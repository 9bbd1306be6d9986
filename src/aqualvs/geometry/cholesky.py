"""Positive definite systems of a few unknowns inside compiled kernels, by Cholesky's factor.

They are solved in less time than it takes to hand them to LAPACK.
"""

import math

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.compiled import borrowing_kernel, kernel


@borrowing_kernel
def factorise(matrix: FloatArray, damping: float, least: float, factor: FloatArray) -> bool:
    """Write the lower factor of a matrix (N, N), its diagonal times 1 + damping, to `factor`.

    Only the lower half of the matrix is read; `factor` may be the matrix itself. False where a
    pivot is not above `least` of its diagonal element: it is rounding, not information.
    """
    n = len(matrix)
    for i in range(n):
        own = matrix[i, i]
        for j in range(i + 1):
            rest = matrix[i, j]
            if i == j:
                rest += damping * own
            for k in range(j):
                rest -= factor[i, k] * factor[j, k]
            if i != j:
                factor[i, j] = rest / factor[j, j]
            elif rest > least * own:
                factor[i, i] = math.sqrt(rest)
            else:
                return False
    return True


@borrowing_kernel
def solve_factorised(factor: FloatArray, right: FloatArray, out: FloatArray) -> None:
    """Write the solution (N,) of factor factor' x = right to `out`, which may be `right` itself."""
    n = len(right)
    for i in range(n):
        rest = right[i]
        for k in range(i):
            rest -= factor[i, k] * out[k]
        out[i] = rest / factor[i, i]
    for i in range(n - 1, -1, -1):
        rest = out[i]
        for k in range(i + 1, n):
            rest -= factor[k, i] * out[k]
        out[i] = rest / factor[i, i]


@kernel
def inverse_of(factor: FloatArray) -> FloatArray:
    """Return the inverse (N, N) of the matrix that a factor was made from."""
    inverse = np.eye(len(factor))
    for k in range(len(factor)):
        solve_factorised(factor, inverse[k], inverse[k])
    return inverse
