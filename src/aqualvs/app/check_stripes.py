"""Where a rig's stripes fall in the picture, and what a pixel on them is worth."""

from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.rays import Rays
from aqualvs.optics.camera import Camera

# Stripes are followed this far to both sides of the wall's nearest point, in even angular steps.
_HALF_ANGLE = np.deg2rad(75.0)
_N_SAMPLES = 1501
# A laser plane whose intersection with the wall is this ill-defined is parallel to it.
_PARALLEL = 1e-6


@dataclass(frozen=True, slots=True)
class StripeView:
    """The visible part of one stripe on a wall square to the forward axis.

    Attributes
    ----------
    plane : Plane
        The laser's, in `dome`.
    points_in_dome : array, shape (N, 3)
        Along the stripe, metres; none where the stripe is out of the picture.
    pixels : array, shape (N, 2)
        Where the camera sees them.
    length_px : float
        Length of the stripe in the picture.
    """

    plane: Plane
    points_in_dome: FloatArray
    pixels: FloatArray
    length_px: float

    @property
    def visible(self) -> bool:
        """Whether there is a stripe in the picture that has a length."""
        return len(self.pixels) > 1

    def thinned(self, n_points: int) -> "StripeView":
        """Return the same stripe with `n_points` points."""
        pick = np.linspace(0, len(self.pixels) - 1, n_points).round().astype(int)
        return StripeView(self.plane, self.points_in_dome[pick], self.pixels[pick], self.length_px)


def see_stripe(camera: Camera, plane: Plane, wall_range: float) -> StripeView:
    """Return what a camera sees of a laser's stripe on the wall y = `wall_range` (metres)."""
    points = _line_on_wall(plane, wall_range)
    pixels, valid = camera.project(points)
    inside = valid & camera.inside_image(pixels)
    steps = np.linalg.norm(np.diff(pixels, axis=0), axis=-1)
    length = float(steps[inside[1:] & inside[:-1]].sum())
    return StripeView(plane, points[inside], pixels[inside], length)


def _line_on_wall(plane: Plane, wall_range: float) -> FloatArray:
    """Points (N, 3) where a plane cuts the wall y = `wall_range`; none if it is parallel."""
    across = np.array([plane.normal[0], 0.0, plane.normal[2]])
    length = float(np.linalg.norm(across))
    if length < _PARALLEL:
        return np.empty((0, 3))
    across /= length
    foot = across * (plane.offset - plane.normal[1] * wall_range) / length
    along = np.array([-across[2], 0.0, across[0]])
    reach = wall_range * np.tan(np.linspace(-_HALF_ANGLE, _HALF_ANGLE, _N_SAMPLES))
    line: FloatArray = foot + np.array([0.0, wall_range, 0.0]) + reach[:, None] * along
    return line


def point_per_pixel(camera: Camera, stripe: StripeView) -> FloatArray:
    """Return how triangulated points move by a step across the stripe, (N, 3), in m/px."""
    tangent = np.gradient(stripe.pixels, axis=0)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    half = 0.5 * np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
    ahead, _ = stripe.plane.intersect(camera.rays(stripe.pixels + half))
    behind, _ = stripe.plane.intersect(camera.rays(stripe.pixels - half))
    return ahead - behind


def field_of_view(camera: Camera) -> tuple[float, float]:
    """Horizontal and vertical field of view in the outer medium, in radians; NaN where none."""
    width, height = camera.size_px
    middle_x, middle_y = (width - 1) / 2.0, (height - 1) / 2.0
    ends = [[-0.5, middle_y], [width - 0.5, middle_y], [middle_x, -0.5], [middle_x, height - 0.5]]
    rays = camera.rays(ends)
    return _angle(rays, 0, 1), _angle(rays, 2, 3)


def blind_fraction(camera: Camera) -> float:
    """Fraction of the pixels, on a grid, that see nothing of the outer medium."""
    width, height = camera.size_px
    x, y = np.meshgrid(np.linspace(0, width - 1, 33), np.linspace(0, height - 1, 33))
    rays = camera.rays(np.stack([x, y], axis=-1))
    return float(np.mean(~rays.valid))


def _angle(rays: Rays, first: int, second: int) -> float:
    cosine = float(rays.directions[first] @ rays.directions[second])
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))
