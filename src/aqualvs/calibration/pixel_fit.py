"""Damped least squares inside compiled kernels: the linear algebra of small fits to pixels."""

import math

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel

_SQRT_HALF = math.sqrt(0.5)
_DENSITY_AT_ZERO = 1.0 / math.sqrt(2.0 * math.pi)
# Farther than this many blurs from where it lies, an edge is over.
_REACH = 4.0


@inline_borrowing_kernel
def blurred_edge(distance: float, blur: float) -> tuple[float, float]:
    """Return a Gaussian edge's height, 0 to 1, and its slope by `distance`."""
    t = distance / blur
    if t > _REACH:
        return 1.0, 0.0
    if t < -_REACH:
        return 0.0, 0.0
    return 0.5 + 0.5 * math.erf(_SQRT_HALF * t), _DENSITY_AT_ZERO * math.exp(-0.5 * t * t) / blur


@borrowing_kernel
def factorise(normal: FloatArray, damping: float, lower: FloatArray) -> bool:
    """Write the Cholesky factor of `normal` (P, P), its diagonal times 1 + damping, to `lower`.

    Only the lower triangle of `normal` is read. False where it is not positive definite.
    """
    n = len(normal)
    for i in range(n):
        for j in range(i + 1):
            rest = normal[i, j]
            if i == j:
                rest += damping * normal[i, i]
            for k in range(j):
                rest -= lower[i, k] * lower[j, k]
            if i != j:
                lower[i, j] = rest / lower[j, j]
            elif rest > 1e-12 * normal[i, i]:
                lower[i, i] = math.sqrt(rest)
            else:
                return False
    return True


@borrowing_kernel
def solve_factorised(lower: FloatArray, right: FloatArray, out: FloatArray) -> None:
    """Write the solution (P,) of lower lower' x = right to `out`."""
    n = len(right)
    for i in range(n):
        rest = right[i]
        for k in range(i):
            rest -= lower[i, k] * out[k]
        out[i] = rest / lower[i, i]
    for i in range(n - 1, -1, -1):
        rest = out[i]
        for k in range(i + 1, n):
            rest -= lower[k, i] * out[k]
        out[i] = rest / lower[i, i]
