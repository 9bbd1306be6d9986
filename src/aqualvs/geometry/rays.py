"""Rays: where light enters the outer medium, and whither it goes."""

from dataclasses import dataclass

from aqualvs.geometry.arrays import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class Rays:
    """Rays in one frame.

    Attributes
    ----------
    origins : array, shape (..., 3)
        Where each ray starts, in metres.
    directions : array, shape (..., 3)
        Unit directions, away from the camera.
    valid : bool array, shape (...)
        False where no such ray exists (total reflection, pixel outside the lens model). Origins
        and directions are NaN there.
    """

    origins: FloatArray
    directions: FloatArray
    valid: BoolArray

    def points_at(self, distances: FloatArray) -> FloatArray:
        """Return the points `distances` (shape (...), metres) along the rays, shape (..., 3)."""
        points: FloatArray = self.origins + distances[..., None] * self.directions
        return points
