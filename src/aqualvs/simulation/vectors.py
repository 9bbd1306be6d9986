"""Three-vectors as tuples, for kernels: they stay in registers."""

from typing import TypeAlias

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.compiled import inline_borrowing_kernel

Vec: TypeAlias = tuple[float, float, float]


@inline_borrowing_kernel
def dot(a: Vec, b: Vec) -> float:
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inline_borrowing_kernel
def cross(a: Vec, b: Vec) -> Vec:
    """Return the vector product."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


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
    """Return a with length 1."""
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
