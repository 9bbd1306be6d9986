"""The arithmetic of `quadric`: weighted least squares in six coefficients, without LAPACK.

Systems of six unknowns are solved in less time than it takes to hand them to a library.
"""

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import inline_borrowing_kernel, kernel

N = 6
"""Coefficients a, b, c, p, q, r."""
GATE_SHARE, GATE_PX = 0.004, 1.2
"""What lies on a patch is so near to it: in shares of the range, and in pixels."""
MIN_PIECES = 12
"""Observations that a patch needs."""

_STEPS = 16
_TUKEY = 4.685  # 95 % efficiency for normal errors
_REWEIGHTS = 6
# What is expected of nets before looking, in 1/m: bent by a metre's radius, hardly twisted.
_SIGMA_CURVATURE = 2.0
_SIGMA_TWIST = 0.5
# Steeper bends than a radius of half a metre are something else.
_STRONGEST = 2.0
# A pivot below this share of its diagonal is rounding, not information.
_SINGULAR = 1e-13


@inline_borrowing_kernel
def write_terms(u: float, v: float, terms: FloatArray) -> None:
    """Write the terms of the height at (u, v), shape (6,)."""
    terms[0], terms[1], terms[2] = 1.0, u, v
    terms[3], terms[4], terms[5] = 0.5 * u * u, u * v, 0.5 * v * v


@kernel
def heights_over(
    points: FloatArray,
    normal: FloatArray,
    offset: float,
    right: FloatArray,
    up: FloatArray,
    coefficients: FloatArray,
) -> FloatArray:
    """Return by how much points (N, 3) lie behind a patch, along its base's normal, in metres."""
    a, b, c, p, q, r = coefficients
    off = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        u = right[0] * x + right[1] * y + right[2] * z
        v = up[0] * x + up[1] * y + up[2] * z
        height = a + b * u + c * v + 0.5 * (p * u * u + r * v * v) + q * u * v
        off[i] = normal[0] * x + normal[1] * y + normal[2] * z - offset - height
    return off


@kernel
def over_plane(
    points: FloatArray,
    sensitivity: FloatArray,
    normal: FloatArray,
    offset: float,
    right: FloatArray,
    up: FloatArray,
    terms: FloatArray,
    height: FloatArray,
    per_px: FloatArray,
) -> None:
    """Write what a fit over a plane needs of M observations.

    Parameters
    ----------
    points, sensitivity : array, shape (M, 3)
        In `dome`: metres, and m/px.
    normal, offset
        The plane.
    right, up : array, shape (3,)
        Unit vectors in it.
    terms : array, shape (M, 6)
        Written.
    height, per_px : array, shape (M,)
        Written: distance behind the plane, and its change by the stripe's position.
    """
    for i in range(points.shape[0]):
        u, v, h, d = 0.0, 0.0, -offset, 0.0
        for k in range(3):
            u += right[k] * points[i, k]
            v += up[k] * points[i, k]
            h += normal[k] * points[i, k]
            d += normal[k] * sensitivity[i, k]
        write_terms(u, v, terms[i])
        height[i], per_px[i] = h, abs(d)


@kernel
def _solve(
    terms: FloatArray,
    height: FloatArray,
    weight: FloatArray,
    factor: FloatArray,
    coefficients: FloatArray,
) -> bool:
    """Fit the coefficients; `factor` gets the Cholesky factor of the normal matrix.

    False where the observations do not determine them.
    """
    right = np.zeros(N)
    factor[:] = 0.0
    for k in (3, 5):
        factor[k, k] = 1.0 / _SIGMA_CURVATURE**2
    factor[4, 4] = 1.0 / _SIGMA_TWIST**2
    for i in range(terms.shape[0]):
        w = weight[i]
        if w == 0.0:
            continue
        for j in range(N):
            part = w * terms[i, j]
            right[j] += part * height[i]
            for k in range(j + 1):
                factor[j, k] += part * terms[i, k]
    for j in range(N):
        own = factor[j, j]
        for k in range(j):
            rest = factor[j, k]
            for a in range(k):
                rest -= factor[j, a] * factor[k, a]
            factor[j, k] = rest / factor[k, k]
        pivot = own
        for a in range(j):
            pivot -= factor[j, a] * factor[j, a]
        if not pivot > _SINGULAR * own:
            return False
        factor[j, j] = np.sqrt(pivot)
    _substitute(factor, right)
    coefficients[:] = right
    return True


@kernel
def _substitute(factor: FloatArray, right: FloatArray) -> None:
    """Solve the system whose Cholesky factor is known, in place."""
    for j in range(N):
        for k in range(j):
            right[j] -= factor[j, k] * right[k]
        right[j] /= factor[j, j]
    for j in range(N - 1, -1, -1):
        for k in range(j + 1, N):
            right[j] -= factor[k, j] * right[k]
        right[j] /= factor[j, j]


@kernel
def _inverse(factor: FloatArray) -> FloatArray:
    """Return the inverse of the matrix whose Cholesky factor is known."""
    inverse = np.zeros((N, N))
    for k in range(N):
        inverse[k, k] = 1.0
        _substitute(factor, inverse[k])
    return inverse


@kernel
def curvature_in_sigmas(
    terms: FloatArray, height: FloatArray, sigma: FloatArray, weights: FloatArray
) -> float:
    """Return the strongest curvature that M observations show, over its sigma; 0 for too few."""
    n = height.shape[0]
    weight, factor, coefficients = np.empty(n), np.empty((N, N)), np.empty(N)
    for i in range(n):
        weight[i] = weights[i] / (sigma[i] * sigma[i])
    if not _solve(terms, height, weight, factor, coefficients) or n <= N:
        return 0.0
    square = 0.0
    for i in range(n):
        off = height[i]
        for k in range(N):
            off -= terms[i, k] * coefficients[k]
        square += weight[i] * off * off
    scale = max(np.sqrt(square / (n - N)), 1.0)
    inverse = _inverse(factor)
    most = 0.0
    for k in range(3, N):
        most = max(most, abs(coefficients[k]) / (np.sqrt(inverse[k, k]) * scale))
    return most


@kernel
def grow(
    terms: FloatArray,
    height: FloatArray,
    gate: FloatArray,
    inside: BoolArray,
    coefficients: FloatArray,
) -> bool:
    """Refit and take in what the fit predicts until nothing changes; False where it comes to none.

    `inside` is where the fit begins and then what it has taken in.
    """
    n = height.shape[0]
    weight, factor = np.empty(n), np.empty((N, N))
    for _ in range(_STEPS):
        for i in range(n):
            weight[i] = 1.0 / (gate[i] * gate[i]) if inside[i] else 0.0
        if np.sum(inside) < MIN_PIECES or not _solve(terms, height, weight, factor, coefficients):
            return False
        if np.abs(coefficients[3:]).max() > _STRONGEST:
            return False
        changed = False
        for i in range(n):
            off = height[i]
            for k in range(N):
                off -= terms[i, k] * coefficients[k]
            now = abs(off) < gate[i]
            changed |= now != inside[i]
            inside[i] = now
        if not changed:
            break
    return bool(np.sum(inside) >= MIN_PIECES)


@kernel
def reweight(
    terms: FloatArray,
    height: FloatArray,
    sigma: FloatArray,
    inside: BoolArray,
    coefficients: FloatArray,
    weights: FloatArray,
    covariance: FloatArray,
) -> tuple[float, float]:
    """Go on from a grown fit with Tukey's biweight, in place; the scale, and the rms in metres.

    `covariance` gets the inverse of the normal matrix.
    """
    n = height.shape[0]
    z, weight = np.empty(n), np.empty(n)
    factor, known, better = np.empty((N, N)), np.eye(N), np.empty(N)
    scale = 1.0
    for _ in range(_REWEIGHTS):
        for i in range(n):
            off = height[i]
            for k in range(N):
                off -= terms[i, k] * coefficients[k]
            z[i] = off / sigma[i]
        scale = max(1.4826 * np.median(np.abs(z[inside])), 0.1)
        for i in range(n):
            rest = max(1.0 - (z[i] / (_TUKEY * scale)) ** 2, 0.0)
            weights[i] = rest * rest if inside[i] else 0.0
            weight[i] = weights[i] / (sigma[i] * sigma[i])
        if not _solve(terms, height, weight, factor, better):
            break
        coefficients[:] = better
        known[:] = factor
    covariance[:] = _inverse(known)
    square, total = 0.0, 0.0
    for i in range(n):
        off = height[i]
        for k in range(N):
            off -= terms[i, k] * coefficients[k]
        square += weights[i] * off * off
        total += weights[i]
    return scale, np.sqrt(square / total)


@kernel
def add_shared(
    terms: FloatArray,
    pull: FloatArray,
    line: FloatArray,
    laser: IntArray,
    shift_px: float,
    tilt_px: float,
    inverse: FloatArray,
    covariance: FloatArray,
) -> None:
    """Add the covariance of a shift and a tilt that all of a laser's stripe may share.

    Parameters
    ----------
    terms : array, shape (M, 6)
    pull : array, shape (M,)
        Weight of each observation times its height by the stripe's position.
    line : array, shape (M,)
        Search lines.
    laser : int array, shape (M,)
    shift_px, tilt_px : float
        Standard deviations.
    inverse : array, shape (6, 6)
        Of the normal matrix.
    covariance : array, shape (6, 6)
        Completed in place.
    """
    for index in range(laser.max() + 1):
        low, high = np.inf, -np.inf
        for i in range(laser.shape[0]):
            if laser[i] == index:
                low, high = min(low, line[i]), max(high, line[i])
        if low == np.inf:
            continue
        sums = np.zeros((2, N))
        for i in range(laser.shape[0]):
            if laser[i] == index:
                along = 2.0 * (line[i] - low) / max(high - low, 1.0) - 1.0
                for k in range(N):
                    sums[0, k] += shift_px * pull[i] * terms[i, k]
                    sums[1, k] += tilt_px * pull[i] * terms[i, k] * along
        for mode in range(2):
            moved = np.zeros(N)
            for j in range(N):
                for k in range(N):
                    moved[j] += inverse[j, k] * sums[mode, k]
            for j in range(N):
                for k in range(N):
                    covariance[j, k] += moved[j] * moved[k]
