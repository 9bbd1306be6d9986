"""Symmetric 3 x 3 systems inside compiled kernels, where calling LAPACK costs more than the job."""

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.compiled import inline_kernel

# Relative to the product of the diagonal: a smaller determinant is rounding, not information.
_SINGULAR = 1e-13


@inline_kernel
def invert_symmetric(matrix: FloatArray, inverse: FloatArray) -> bool:
    """Invert a positive definite 3 x 3 matrix by its cofactors; only its lower half is read.

    False, and nothing written, where the matrix is singular to rounding or not positive.
    """
    a, b, c = matrix[0, 0], matrix[1, 0], matrix[2, 0]
    d, e, f = matrix[1, 1], matrix[2, 1], matrix[2, 2]
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * c00 + b * c01 + c * c02
    if not determinant > _SINGULAR * a * d * f:
        return False
    inverse[0, 0] = c00 / determinant
    inverse[0, 1] = inverse[1, 0] = c01 / determinant
    inverse[0, 2] = inverse[2, 0] = c02 / determinant
    inverse[1, 1] = (a * f - c * c) / determinant
    inverse[1, 2] = inverse[2, 1] = (b * c - a * e) / determinant
    inverse[2, 2] = (a * d - b * b) / determinant
    return bool(determinant < np.inf)


@inline_kernel
def solve_symmetric(
    matrix: FloatArray, right: FloatArray, scratch: FloatArray, solution: FloatArray
) -> bool:
    """Solve a positive definite 3 x 3 system; False, and nothing written, where it is singular."""
    if not invert_symmetric(matrix, scratch):
        return False
    for i in range(3):
        solution[i] = scratch[i, 0] * right[0] + scratch[i, 1] * right[1] + scratch[i, 2] * right[2]
    return True
