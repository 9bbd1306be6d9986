"""Small linear algebra, quantiles and sums for compiled kernels.

For small systems, calling LAPACK costs more than the solution. Three-vectors are tuples, so that
they stay in registers. Symmetric 3 x 3 systems are solved by cofactors, positive definite systems
of a few unknowns by their Cholesky factor. Functions named as NumPy's do the same for 1-D arrays,
and take less time to compile.
"""

import math
from typing import TypeAlias

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import (
    inline_borrowing_kernel,
    inline_kernel,
    inner_borrowing_kernel,
    inner_kernel,
    lazy_kernel,
)

Vec: TypeAlias = tuple[float, float, float]
"""A vector as scalar kernels take and return it."""


@inline_borrowing_kernel
def squared(x: float) -> float:
    """Return x * x. Python rounds `x**2` otherwise, because it calls `pow`."""
    return x * x


@inline_borrowing_kernel
def hypot(x: float, y: float) -> float:
    """Return the length of (x, y). Python and compiled code round `math.hypot` differently."""
    return math.sqrt(x * x + y * y)


@inline_borrowing_kernel
def dot(a: Vec, b: Vec) -> float:
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inline_borrowing_kernel
def cross(a: Vec, b: Vec) -> Vec:
    """Return the vector product."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@inline_borrowing_kernel
def minus(a: Vec, b: Vec) -> Vec:
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inline_borrowing_kernel
def along(origin: Vec, direction: Vec, t: float) -> Vec:
    """Return origin + t * direction."""
    return (
        origin[0] + t * direction[0],
        origin[1] + t * direction[1],
        origin[2] + t * direction[2],
    )


@inline_borrowing_kernel
def scaled(a: Vec, factor: float) -> Vec:
    """Return factor * a."""
    return a[0] * factor, a[1] * factor, a[2] * factor


@inline_borrowing_kernel
def unit(a: Vec) -> Vec:
    """Return a / |a|."""
    inverse = 1.0 / np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    return a[0] * inverse, a[1] * inverse, a[2] * inverse


@inline_borrowing_kernel
def combine(a: Vec, x: float, b: Vec, y: float, c: Vec, z: float) -> Vec:
    """Return x a + y b + z c."""
    return (
        x * a[0] + y * b[0] + z * c[0],
        x * a[1] + y * b[1] + z * c[1],
        x * a[2] + y * b[2] + z * c[2],
    )


@inline_borrowing_kernel
def row3(values: FloatArray, i: int, j: int) -> Vec:
    """Return values[i, j:j+3] as a tuple."""
    return values[i, j], values[i, j + 1], values[i, j + 2]


@inline_kernel
def invert_symmetric(matrix: FloatArray, inverse: FloatArray) -> bool:
    """Invert a positive definite 3 x 3 matrix by its cofactors; only its lower triangle is read.

    Return False, and write nothing, if the matrix is singular to rounding or not positive definite.
    """
    a, b, c = matrix[0, 0], matrix[1, 0], matrix[2, 0]
    d, e, f = matrix[1, 1], matrix[2, 1], matrix[2, 2]
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * c00 + b * c01 + c * c02
    # A determinant that is smaller relative to the product of the diagonal is rounding error.
    singular = 1e-13
    if not determinant > singular * a * d * f:
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
    """Solve a positive definite 3 x 3 system; return False, and write nothing, if singular.

    `scratch` (3, 3) is overwritten by the inverse of the matrix.
    """
    if not invert_symmetric(matrix, scratch):
        return False
    for i in range(3):
        solution[i] = scratch[i, 0] * right[0] + scratch[i, 1] * right[1] + scratch[i, 2] * right[2]
    return True


@inner_borrowing_kernel
def cholesky(matrix: FloatArray, damping: float, min_pivot: float, factor: FloatArray) -> bool:
    """Write the lower Cholesky factor of a positive definite matrix.

    Parameters
    ----------
    matrix : array, shape (N, N)
        Only its lower triangle is read.
    damping : float
        The diagonal is multiplied by 1 + damping first (Levenberg-Marquardt).
    min_pivot : float
        Least pivot, as a share of its diagonal element; a smaller one is rounding error.
    factor : array, shape (N, N)
        Written in its lower triangle; may be `matrix`.

    Returns
    -------
    bool
        False if a pivot is too small: the factor is incomplete then.
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
            elif rest > min_pivot * own:
                factor[i, i] = math.sqrt(rest)
            else:
                return False
    return True


@inner_borrowing_kernel
def cholesky_solve(factor: FloatArray, right: FloatArray, out: FloatArray) -> None:
    """Write the solution (N,) of factor factorᵀ x = right to `out`, which may be `right` itself."""
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


@inner_kernel
def cholesky_inverse(factor: FloatArray) -> FloatArray:
    """Return the inverse (N, N) of the matrix with this Cholesky factor."""
    inverse = np.zeros(factor.shape)
    for k in range(factor.shape[0]):
        inverse[k, k] = 1.0
        cholesky_solve(factor, inverse[k], inverse[k])
    return inverse


_N_BINS = 256


@lazy_kernel
def lower_quantile(values: FloatArray, q: float) -> float:
    """Return the quantile `q`, 0 to 1, of values (N,), as `numpy.quantile(method="lower")`.

    0 if there are no values; NaN counts as highest. The values are counted in bins, and only one
    bin is searched: a partition of all takes longer, because its branches cannot be predicted.
    """
    n = values.shape[0]
    if n == 0:
        return 0.0
    low, high = np.inf, -np.inf
    for i in range(n):
        low = values[i] if values[i] < low else low
        high = values[i] if values[i] > high else high
    per_level = _N_BINS / (high - low) if low < high else 0.0
    count, rank = np.zeros(_N_BINS + 1, np.int64), int(q * (n - 1))
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
    return select_nth(found, rank - below)


@inner_borrowing_kernel
def select_nth(values: FloatArray, n: int) -> float:
    """Return the element that sorted values (N,) have at index `n`; reorder them in place.

    NaN counts as highest. Hoare's algorithm (1961); compiles in a tenth of the time of
    `numpy.partition`.
    """
    low, high, i = 0, values.shape[0] - 1, 0
    while i <= high:
        if values[i] == values[i]:
            i += 1
        else:
            values[i], values[high] = values[high], values[i]
            high -= 1
    if n > high:
        return float(values[n])
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if n <= j:
            high = j
        elif n >= i:
            low = i
        else:
            break
    return float(values[n])


@inner_borrowing_kernel
def median_of(values: FloatArray) -> float:
    """Return the median of values (N,), NaN if there are none; reorder them in place."""
    n = values.shape[0]
    if n == 0:
        return math.nan
    upper = select_nth(values, n // 2)
    if n % 2 == 1:
        return upper
    # `select_nth` has moved all smaller values before index n // 2.
    lower = values[0]
    for i in range(1, n // 2):
        lower = values[i] if values[i] > lower else lower
    return float((lower + upper) / 2.0)


@inner_kernel
def argsort(values: FloatArray) -> IntArray:
    """Return the indices (N,) that sort values (N,) stably; Shell's sort (1959)."""
    n = values.shape[0]
    order = np.empty(n, np.int64)
    for i in range(n):
        order[i] = i
    gap = 1
    while 3 * gap + 1 < n:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(gap, n):
            one, at = order[i], i
            while at >= gap and (
                values[order[at - gap]] > values[one]
                or (values[order[at - gap]] == values[one] and order[at - gap] > one)
            ):
                order[at] = order[at - gap]
                at -= gap
            order[at] = one
        gap //= 3
    return order


@inner_kernel
def flatnonzero(mask: BoolArray) -> IntArray:
    """Return the indices at which a mask (N,) is True."""
    n = 0
    for i in range(mask.shape[0]):
        n += mask[i]
    rows, n = np.empty(n, np.int64), 0
    for i in range(mask.shape[0]):
        if mask[i]:
            rows[n] = i
            n += 1
    return rows


@inner_borrowing_kernel
def n_bins(numbers: IntArray) -> int:
    """Return the number of bins of `numpy.bincount`: the highest number plus 1, or 0 for none."""
    n = 0
    for i in range(numbers.shape[0]):
        n = max(n, numbers[i] + 1)
    return n


@inner_kernel
def take(values: FloatArray, rows: IntArray) -> FloatArray:
    """Return values[rows]."""
    some = np.empty(rows.shape[0])
    for k in range(rows.shape[0]):
        some[k] = values[rows[k]]
    return some


@inline_kernel
def sum_of(values: FloatArray | IntArray) -> float:
    """Return the sum of values (N,), added in their order."""
    found = 0.0
    for i in range(values.shape[0]):
        found += values[i]
    return found


@inline_borrowing_kernel
def _bin_of(value: float, low: float, per_level: float) -> int:
    place = (value - low) * per_level
    return int(place) if place < _N_BINS else _N_BINS
