"""Planes n·X = d, and the rays of a camera in the outer medium that intersect them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from aqualvs.geometry.arrays import BoolArray, FloatArray, as_vectors


@dataclass(frozen=True, slots=True)
class Rays:
    """A batch of rays in one coordinate frame."""

    origins: FloatArray  # Shape (..., 3): where each ray starts, in metres.
    directions: FloatArray  # Shape (..., 3): unit directions, away from the camera.
    # Shape (...): False where no such ray exists (total reflection, pixel outside the lens model).
    # Origins and directions are NaN there.
    valid: BoolArray

    def points_at(self, distances: FloatArray) -> FloatArray:
        """Return the points `distances` (shape (...), metres) along the rays, shape (..., 3)."""
        return self.origins + distances[..., None] * self.directions


@dataclass(frozen=True, slots=True)
class Plane:
    """The plane normal·X = offset in one coordinate frame."""

    normal: FloatArray  # Shape (3,): unit normal.
    offset: float  # Signed distance of the plane from the origin along the normal, in metres.

    @classmethod
    def from_normal(cls, normal: ArrayLike, offset: float) -> "Plane":
        """Make a plane from a normal of any length; `offset` belongs to the normal as given.

        Raises
        ------
        ValueError
            If the normal is zero or not finite.
        """
        vector = as_vectors(normal, 3, "normal")
        length = float(np.linalg.norm(vector))
        if not np.isfinite(length) or length == 0.0:
            raise ValueError(f"plane normal {vector.tolist()} has no direction")
        return cls(vector / length, float(offset) / length)

    @classmethod
    def fitted(cls, points: FloatArray) -> "Plane":
        """Return the plane with the least squared distances from points (N, 3)."""
        middle = points.mean(axis=0)
        normal = np.linalg.svd(points - middle, full_matrices=False)[2][-1]
        return cls(normal, float(normal @ middle))

    def packed(self) -> FloatArray:
        """Return normal and offset as one array (4,), for kernels."""
        packed = np.empty(4)
        packed[:3], packed[3] = self.normal, self.offset
        return packed

    def signed_distance(self, points: FloatArray) -> FloatArray:
        """Return normal·X - offset for points of shape (..., 3)."""
        return points @ self.normal - self.offset

    def intersect(self, rays: Rays) -> tuple[FloatArray, BoolArray]:
        """Intersect rays with the plane (paper, Eq. 16 and 20).

        Returns
        -------
        points : array, shape (..., 3)
            NaN where there is no intersection ahead of the ray's origin.
        valid : bool array, shape (...)
        """
        approach = rays.directions @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (self.offset - rays.origins @ self.normal) / approach
        valid = rays.valid & np.isfinite(distance) & (distance >= 0.0)
        points = rays.points_at(np.where(valid, distance, np.nan))
        return points, valid

    def facing_origin(self) -> "Plane":
        """Return the same plane with offset >= 0, as target planes have it."""
        if self.offset < 0.0:
            return Plane(-self.normal, -self.offset)
        return self


def exchanged_plane(plane: Plane, first: Plane, second: Plane) -> Plane | None:
    """Return the plane of two laser stripes if each is read as the other laser's.

    Two sheets s·X = 1 and t·X = 1 meet a plane m·X = 1 in stripes, which are seen along lines of
    sight through the origin. These meet the other sheet on the plane (s + t - m)·X = 1, so two
    stripes alone do not tell which of the two planes is there.

    Parameters
    ----------
    plane : Plane
        On which the stripes are.
    first, second : Plane
        The sheets.

    Returns
    -------
    Plane or None
        Its offset is positive; None if it is infinitely far, or a sheet passes the origin.
    """
    offsets = np.array([first.offset, second.offset, plane.offset])
    if not offsets.all():
        return None
    m = first.normal / offsets[0] + second.normal / offsets[1] - plane.normal / offsets[2]
    length = float(np.linalg.norm(m))
    return Plane(m / length, 1.0 / length) if length > 0.0 else None


def shifted_plane(plane: Plane, sheets: Sequence[Plane], read_as: Sequence[Plane]) -> Plane | None:
    """Return the plane that laser stripes show if each is read as that of another sheet.

    A stripe on m·X = 1 by a sheet s·X = 1 is seen along (s - m)·X = 0. These lines of sight meet
    another sheet t·X = 1 on all planes (t + a (s - m))·X = 1; the plane returned is nearest to one
    of these for each stripe. For two sheets that are exchanged it is `exchanged_plane`.

    Parameters
    ----------
    plane : Plane
        On which the stripes are.
    sheets, read_as : sequence of Plane
        The sheet of each stripe, and that which it is read as; two or more.

    Returns
    -------
    Plane or None
        The offset is positive. None if the plane is not determined or a sheet passes the origin.
    """
    if not all(one.offset for one in (plane, *sheets, *read_as)):
        return None
    m, *rest = (one.normal / one.offset for one in (plane, *sheets, *read_as))
    along = np.array(rest[: len(sheets)]) - m
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    # Projections onto what is across each stripe's planes, (N, 3, 3).
    across = np.eye(3) - along[:, :, None] * along[:, None]
    normal = across.sum(axis=0)
    smallest_share = 1e-9
    if np.linalg.eigvalsh(normal)[0] < smallest_share * len(sheets):
        return None
    found = np.linalg.solve(normal, np.einsum("nij,nj->i", across, np.array(rest[len(sheets) :])))
    length = float(np.linalg.norm(found))
    return Plane(found / length, 1.0 / length) if length > 0.0 else None


def upright_axes(normal: FloatArray) -> FloatArray:
    """Return axes on a plane in `dome`, the columns of a rotation (3, 3).

    They are horizontal to the right, along the normal, and up the plane.

    Parameters
    ----------
    normal : array, shape (3,)
        Unit normal that points away from the vehicle; not vertical.
    """
    up = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    up /= max(float(np.linalg.norm(up)), 1e-9)
    return np.stack([np.cross(normal, up), normal, up], axis=1)


def normals_of(pitch: FloatArray, yaw: FloatArray) -> FloatArray:
    """Return the unit normals (..., 3) of target planes, away from the vehicle.

    Inverse of the paper's Eq. 25-26: they are along (tan yaw, 1, tan pitch).
    """
    along = np.stack([np.tan(yaw), np.ones_like(yaw), np.tan(pitch)], axis=-1)
    return np.asarray(along / np.linalg.norm(along, axis=-1, keepdims=True), np.float64)
