"""Snell's law in vector form: two square roots a surface, no trigonometry, no singularity."""

import math

import numpy as np
from numpy.typing import ArrayLike

from aqualvs.errors import RigError
from aqualvs.geometry.arrays import BoolArray, FloatArray, as_vectors
from aqualvs.geometry.compiled import inline_kernel
from aqualvs.geometry.linear_algebra import Vec


def check_index(owner: str, name: str, value: float) -> None:
    """Raise RigError unless `value` can be a refractive index relative to vacuum."""
    if not 1.0 <= value <= 3.0:
        raise RigError(
            f"{owner} has {name} = {value:g}; a refractive index relative to vacuum lies "
            "between 1 and 3"
        )


def as_triple(vector: FloatArray) -> Vec:
    """Return a vector (3,) as kernels take it."""
    return float(vector[0]), float(vector[1]), float(vector[2])


@inline_kernel
def snell_weight(cos_in: float, ratio: float) -> tuple[float, float]:
    """Return (k, radicand) with refracted = ratio * direction + k * normal.

    `ratio` is n_in / n_out and the normal points into the incoming medium. A negative radicand
    means total reflection; k is then finite but meaningless.
    """
    radicand = 1.0 - ratio * ratio * (1.0 - cos_in * cos_in)
    return ratio * cos_in - math.sqrt(max(radicand, 0.0)), radicand


@inline_kernel
def leave_sphere(
    px: float, py: float, pz: float, dx: float, dy: float, dz: float, radius: float, ratio: float
) -> tuple[float, float, float, float, float, float, float]:
    """Carry a ray from inside a sphere round the origin to its surface and refract it there.

    Parameters
    ----------
    px, py, pz : float
        Start, inside the sphere or on it.
    dx, dy, dz : float
        Unit direction.
    radius : float
        Of the sphere.
    ratio : float
        n inside / n outside.

    Returns
    -------
    radicand, qx, qy, qz, ex, ey, ez : float
        Point on the sphere and unit direction outside it. A radicand that is not >= 0 means total
        reflection; point and direction are then meaningless.
    """
    along = px * dx + py * dy + pz * dz
    # The cosine of incidence times the radius, because the normal is the point itself.
    reach = math.sqrt(along * along + radius * radius - (px * px + py * py + pz * pz))
    step = reach - along
    qx, qy, qz = px + step * dx, py + step * dy, pz + step * dz
    # One quotient for all rays of a loop.
    inverse = 1.0 / radius
    k, radicand = snell_weight(reach * inverse, ratio)
    k = k * inverse
    ex, ey, ez = ratio * dx - k * qx, ratio * dy - k * qy, ratio * dz - k * qz
    return radicand, qx, qy, qz, ex, ey, ez


@inline_kernel
def leave_plane(p: Vec, d: Vec, normal: Vec, height: float, ratio: float) -> tuple[float, Vec, Vec]:
    """Carry a ray from `height` behind a plane to it and refract it there.

    Parameters
    ----------
    p, d : vector
        Start and unit direction.
    normal : vector
        Of the plane, away from the start.
    height : float
        Distance of the plane from the start along the normal.
    ratio : float
        n before / n behind the plane.

    Returns
    -------
    radicand, q, e
        Point on the plane and unit direction behind it. A radicand that is not positive means
        total reflection, or a direction that does not meet the plane; both are then meaningless.
    """
    cos_in = d[0] * normal[0] + d[1] * normal[1] + d[2] * normal[2]
    step = height / cos_in
    k, radicand = snell_weight(cos_in, ratio)
    return (
        radicand if cos_in > 0.0 else -1.0,
        (p[0] + step * d[0], p[1] + step * d[1], p[2] + step * d[2]),
        (ratio * d[0] - k * normal[0], ratio * d[1] - k * normal[1], ratio * d[2] - k * normal[2]),
    )


def refract(
    directions: ArrayLike, normals: ArrayLike, *, n_in: float, n_out: float
) -> tuple[FloatArray, BoolArray]:
    """Refract unit directions at a smooth interface.

    Parameters
    ----------
    directions : array, shape (..., 3)
        Unit directions of travel, same frame as `normals`.
    normals : array, shape (..., 3)
        Unit normals pointing into the incoming medium; broadcast against `directions`.
    n_in, n_out : float
        Refractive indices before and behind the interface.

    Returns
    -------
    refracted : array, shape (..., 3)
        Unit directions behind the interface; NaN where not valid.
    valid : bool array, shape (...)
        False under total reflection, and where the direction runs away from the interface.

    Raises
    ------
    ValueError
        If an array does not end in an axis of length 3, or an index is not positive.

    Notes
    -----
    Snell's law in vector form; see Glassner, An Introduction to Ray Tracing (1989), 5.2.
    """
    if not (n_in > 0.0 and n_out > 0.0):
        raise ValueError(f"refractive indices must be positive, not {n_in} and {n_out}")
    d, n = np.broadcast_arrays(
        as_vectors(directions, 3, "directions"), as_vectors(normals, 3, "normals")
    )
    ratio = n_in / n_out
    cos_in = -(d[..., 0] * n[..., 0] + d[..., 1] * n[..., 1] + d[..., 2] * n[..., 2])
    radicand = 1.0 - ratio * ratio * (1.0 - cos_in * cos_in)
    k = ratio * cos_in - np.sqrt(np.maximum(radicand, 0.0))
    valid: BoolArray = np.asarray((radicand >= 0.0) & (cos_in >= 0.0))
    refracted = np.where(valid[..., None], ratio * d + k[..., None] * n, np.nan)
    return refracted, valid
