"""Rotations and rigid transforms, frozen and batched."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from aqualvs.geometry.arrays import FloatArray, as_vectors

# Below this angle the series of sin(x)/x and its kin are exact to machine precision with two terms.
_SMALL_ANGLE = 1e-4


def skew(vectors: ArrayLike) -> FloatArray:
    """Return the matrices [v]x with [v]x w = v x w, shape (..., 3, 3), for vectors (..., 3)."""
    v = as_vectors(vectors, 3, "vectors")
    matrices = np.zeros((*v.shape, 3))
    matrices[..., 0, 1], matrices[..., 0, 2] = -v[..., 2], v[..., 1]
    matrices[..., 1, 0], matrices[..., 1, 2] = v[..., 2], -v[..., 0]
    matrices[..., 2, 0], matrices[..., 2, 1] = -v[..., 1], v[..., 0]
    return matrices


def rotation_from_rotvec(rotvecs: ArrayLike) -> FloatArray:
    """Return rotation matrices (..., 3, 3) of rotation vectors (..., 3) in radians.

    Rodrigues' formula. Near zero the coefficients come from their Taylor series, so the map is
    smooth there.
    """
    v = as_vectors(rotvecs, 3, "rotvecs")
    angle_sq = np.sum(v * v, axis=-1)[..., None, None]
    angle = np.sqrt(angle_sq)
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    sine = np.where(small, 1.0 - angle_sq / 6.0, np.sin(safe) / safe)
    versine = np.where(small, 0.5 - angle_sq / 24.0, (1.0 - np.cos(safe)) / safe**2)
    k = skew(v)
    rotation: FloatArray = np.eye(3) + sine * k + versine * (k @ k)
    return rotation


def rotvec_from_rotation(rotations: ArrayLike) -> FloatArray:
    """Return rotation vectors (..., 3) in radians, |v| <= pi, of rotation matrices (..., 3, 3).

    Goes through the unit quaternion by its largest component (Shepperd 1978,
    doi:10.2514/3.55767b), which stays exact at 0 and at pi.
    """
    r = np.asarray(rotations, dtype=np.float64)
    trace = r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2]
    four_sq = np.stack(
        [1.0 + trace] + [1.0 + 2.0 * r[..., i, i] - trace for i in range(3)], axis=-1
    )
    transposed = np.swapaxes(r, -1, -2)
    odd, even = r - transposed, r + transposed
    wx, wy, wz = odd[..., 2, 1], odd[..., 0, 2], odd[..., 1, 0]
    xy, yz, zx = even[..., 0, 1], even[..., 1, 2], even[..., 2, 0]
    rows = np.stack(
        [
            np.stack([four_sq[..., 0], wx, wy, wz], axis=-1),
            np.stack([wx, four_sq[..., 1], xy, zx], axis=-1),
            np.stack([wy, xy, four_sq[..., 2], yz], axis=-1),
            np.stack([wz, zx, yz, four_sq[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(four_sq, axis=-1)
    q = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    q = np.where(q[..., :1] < 0.0, -q, q)
    sin_half = np.linalg.norm(q[..., 1:], axis=-1)
    angle = 2.0 * np.arctan2(sin_half, q[..., 0])
    small = sin_half < _SMALL_ANGLE
    factor = np.where(small, 2.0 + sin_half**2 / 3.0, angle / np.where(small, 1.0, sin_half))
    rotvec: FloatArray = factor[..., None] * q[..., 1:]
    return rotvec


def quaternion_from_rotation(rotation: FloatArray) -> tuple[float, float, float, float]:
    """Return a rotation matrix (3, 3) as a unit quaternion x, y, z, w."""
    turn = rotvec_from_rotation(rotation)
    angle = float(np.linalg.norm(turn))
    x, y, z = turn * (0.5 * np.sinc(angle / (2.0 * math.pi)))
    return float(x), float(y), float(z), math.cos(0.5 * angle)


@dataclass(frozen=True, slots=True)
class SE3:
    """A rigid transform `dst_from_src`, possibly a batch of them."""

    rotation: FloatArray  # Shape (..., 3, 3): rotation part.
    # Shape (..., 3): origin of the source frame in the destination frame, in metres.
    translation: FloatArray

    @classmethod
    def identity(cls) -> "SE3":
        """Return the transform that changes nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_rotvec(cls, rotvec: ArrayLike, translation: ArrayLike) -> "SE3":
        """Make a transform from rotation vectors (..., 3) in radians and translations (..., 3)."""
        return cls(rotation_from_rotvec(rotvec), as_vectors(translation, 3, "translation"))

    def inverse(self) -> "SE3":
        """Return `src_from_dst`."""
        transposed = np.swapaxes(self.rotation, -1, -2)
        return SE3(transposed, -np.einsum("...ij,...j->...i", transposed, self.translation))

    def __matmul__(self, other: "SE3") -> "SE3":
        """Compose: `a_from_c = a_from_b @ b_from_c`."""
        return SE3(self.rotation @ other.rotation, self.apply(other.translation))

    def apply(self, points: ArrayLike) -> FloatArray:
        """Transform points (..., 3) from the source to the destination frame."""
        p = as_vectors(points, 3, "points")
        moved: FloatArray = np.einsum("...ij,...j->...i", self.rotation, p) + self.translation
        return moved

    def rotate(self, directions: ArrayLike) -> FloatArray:
        """Transform directions (..., 3): the rotation alone."""
        d = as_vectors(directions, 3, "directions")
        turned: FloatArray = np.einsum("...ij,...j->...i", self.rotation, d)
        return turned
