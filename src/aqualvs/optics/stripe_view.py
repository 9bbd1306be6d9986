"""Where a rig's stripes fall in the picture on a wall ahead, and what a pixel on them is worth."""

from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.camera import Camera
from aqualvs.optics.sheet import Sheet

# Stripes are followed this far to both sides of the wall's nearest point, in even angular steps.
_HALF_ANGLE = np.deg2rad(75.0)
_N_SAMPLES = 1501
# A sheet whose intersection with the wall is this ill-defined is parallel to it.
_PARALLEL = 1e-6
# Newton steps on the wall from a bent sheet's tangent plane, which is centimetres off at most.
_N_STEPS = 5


@dataclass(frozen=True, slots=True)
class StripeView:
    """The visible part of one stripe on a wall square to the forward axis.

    Attributes
    ----------
    sheet : Sheet
        The laser's light, in `dome`.
    points_in_dome : array, shape (N, 3)
        Along the stripe, metres; none where the stripe is out of the picture.
    pixels : array, shape (N, 2)
        Where the camera sees them.
    length_px : float
        Length of the stripe in the picture.
    """

    sheet: Sheet
    points_in_dome: FloatArray
    pixels: FloatArray
    length_px: float

    @property
    def visible(self) -> bool:
        """Whether there is a stripe in the picture that has a length."""
        return len(self.pixels) > 1

    def thinned(self, n_points: int) -> "StripeView":
        """Return the same stripe with `n_points` points, or all if there are fewer."""
        # No point twice: a stripe has no direction between a point and itself.
        n = min(n_points, len(self.pixels))
        pick = np.linspace(0, len(self.pixels) - 1, n).round().astype(int)
        return StripeView(self.sheet, self.points_in_dome[pick], self.pixels[pick], self.length_px)


def see_stripe(camera: Camera, sheet: Sheet, wall_range: float) -> StripeView:
    """Return what a camera sees of a laser's stripe on the wall y = `wall_range` (metres)."""
    points = _stripe_on_wall(sheet, wall_range)
    pixels, valid = camera.project(points)
    inside = valid & camera.inside_image(pixels)
    steps = np.linalg.norm(np.diff(pixels, axis=0), axis=-1)
    length = float(steps[inside[1:] & inside[:-1]].sum())
    return StripeView(sheet, points[inside], pixels[inside], length)


def point_per_pixel(camera: Camera, stripe: StripeView) -> FloatArray:
    """Return how triangulated points move by a step across the stripe, (N, 3), in m/px."""
    tangent = np.gradient(stripe.pixels, axis=0)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    half = 0.5 * np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
    ahead, _ = stripe.sheet.intersect(camera.rays(stripe.pixels + half))
    behind, _ = stripe.sheet.intersect(camera.rays(stripe.pixels - half))
    return ahead - behind


def _stripe_on_wall(sheet: Sheet, wall_range: float) -> FloatArray:
    """Points (N, 3) where a sheet cuts the wall y = `wall_range`; none if it is parallel."""
    line = _line_on_wall(sheet.plane, wall_range)
    if sheet.is_plane or not len(line):
        return line
    line = _line_on_wall(sheet.tangent_plane(line[len(line) // 2]), wall_range)
    for _ in range(_N_STEPS):
        gradient = sheet.gradient(line) * [1.0, 0.0, 1.0]
        steepness = np.sum(gradient**2, axis=-1)
        line = line - (sheet.signed_distance(line) / steepness)[:, None] * gradient
    return line


def _line_on_wall(plane: Plane, wall_range: float) -> FloatArray:
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
