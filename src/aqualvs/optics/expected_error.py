"""Expected error of the posture to a wall, from a rig's calibration and from pixel noise.

The plane m·X = 1 is fitted by least squares (paper, Eq. 23-26) to a wall square ahead,
m = (0, 1/range, 0), each point weighted by the effect of its pixel error on m·X. The points are
those of the stripes that the camera sees on the wall (`StripeView`). Pixel errors differ from point
to point and from frame to frame; calibration errors are the same in all frames of a dive, and
averaging does not reduce them.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import Rig, RigUncertainty
from aqualvs.optics.rig_covariance import PostureErrors, fitted_plane
from aqualvs.optics.sheet import Sheet, sheets_of


@dataclass(frozen=True, slots=True)
class StripeView:
    """The visible part of one stripe on a wall square to the forward axis."""

    sheet: Sheet  # The laser's light, in `dome`.
    # Shape (N, 3): along the stripe, metres; none where the stripe is out of the picture.
    points_in_dome: FloatArray
    # Shape (N, 2): where the camera sees them.
    pixels: FloatArray
    # Length of the stripe in the picture.
    length_px: float

    @property
    def visible(self) -> bool:
        """Whether a stripe of nonzero length lies in the picture."""
        return len(self.pixels) > 1

    def thinned(self, n_points: int) -> "StripeView":
        """Return the same stripe with `n_points` points, or all if there are fewer."""
        # No point twice: a stripe has no direction between a point and itself.
        n = min(n_points, len(self.pixels))
        pick = np.linspace(0, len(self.pixels) - 1, n).round().astype(int)
        return StripeView(self.sheet, self.points_in_dome[pick], self.pixels[pick], self.length_px)


def visible_stripe(camera: Camera, sheet: Sheet, wall_range: float) -> StripeView:
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
    """Return points (N, 3) where a sheet cuts the wall y = `wall_range`; none if parallel."""
    line = _line_on_wall(sheet.plane, wall_range)
    if sheet.is_plane or not len(line):
        return line
    line = _line_on_wall(sheet.tangent_plane(line[len(line) // 2]), wall_range)
    # Newton steps on the wall from a bent sheet's tangent plane, which is centimetres off at most.
    n_steps = 5
    for _ in range(n_steps):
        gradient = sheet.gradient(line) * [1.0, 0.0, 1.0]
        steepness = np.sum(gradient**2, axis=-1)
        line = line - (sheet.signed_distance(line) / steepness)[:, None] * gradient
    return line


def _line_on_wall(plane: Plane, wall_range: float) -> FloatArray:
    across = np.array([plane.normal[0], 0.0, plane.normal[2]])
    length = float(np.linalg.norm(across))
    # A sheet whose intersection with the wall is this ill-defined is parallel to it.
    parallel = 1e-6
    if length < parallel:
        return np.empty((0, 3))
    across /= length
    foot = across * (plane.offset - plane.normal[1] * wall_range) / length
    along = np.array([-across[2], 0.0, across[0]])
    # Stripes are followed this far to both sides of the wall's nearest point, in even angular
    # steps.
    half_angle = np.deg2rad(75.0)
    n_samples = 1501
    reach = wall_range * np.tan(np.linspace(-half_angle, half_angle, n_samples))
    line: FloatArray = foot + np.array([0.0, wall_range, 0.0]) + reach[:, None] * along
    return line


SIGMA_PX = 0.1
"""Standard deviation of a stripe point across the stripe, in pixels."""
N_POINTS = 100
"""Points on every stripe that is long enough in the picture."""
USUAL_RANGES = (0.3, 0.6, 1.0)
"""Ranges at which errors are reported, in metres."""


@dataclass(frozen=True, slots=True)
class ExpectedError:
    """Expected error of the posture to a wall square to the forward axis."""

    wall_range: float  # Metres.
    # Range error for one pixel across the stripe, for every laser, in m/px; NaN where its stripe is
    # out of the picture.
    per_pixel: tuple[float, ...]
    # Shape (3, 3): covariance of (range, pitch, yaw), in m and rad, from pixel noise in one frame
    # and from the uncertainty of the rig; NaN where the stripes determine no plane.
    noise: FloatArray
    calibration: FloatArray

    @property
    def valid(self) -> bool:
        """Whether there is a posture at this range."""
        return bool(np.isfinite(self.noise).all() and np.isfinite(self.calibration).all())

    @property
    def sigma_noise(self) -> FloatArray:
        """Standard deviations (range, pitch, yaw) of one frame's noise alone."""
        return _sigmas(self.noise)

    @property
    def sigma_calibration(self) -> FloatArray:
        """Standard deviations (range, pitch, yaw) of the systematic part."""
        return _sigmas(self.calibration)

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations (range, pitch, yaw) of both together."""
        return _sigmas(self.noise + self.calibration)


def in_mm_and_degrees(sigmas: FloatArray) -> tuple[float, float, float]:
    """Return standard deviations of (range, pitch, yaw) in millimetres and degrees."""
    range_m, pitch, yaw = sigmas.tolist()
    return 1e3 * range_m, math.degrees(pitch), math.degrees(yaw)


def expected_posture_errors(
    rig: Rig, uncertainty: RigUncertainty, ranges: Sequence[float] = USUAL_RANGES
) -> tuple[ExpectedError, ...]:
    """Propagate a rig's uncertainty, and noise of the pixels, to range, pitch and yaw.

    Parameters
    ----------
    rig : Rig
        With lasers.
    uncertainty : RigUncertainty
        Joint covariance of camera, dome, water and lasers; numbers not in it are taken as exact.
    ranges : sequence of float
        Walls square to the forward axis, metres.
    """
    errors = PostureErrors(rig, rig.camera(), uncertainty)
    return tuple(
        ExpectedError(wall.wall_range, wall.per_pixel, wall.noise(), wall.calibration(errors))
        for wall in (WallView.ahead(rig, wall_range) for wall_range in ranges)
    )


@dataclass(frozen=True, slots=True)
class WallView:
    """The stripes that a rig sees on a wall square ahead, and the posture error they give."""

    wall_range: float  # Metres.
    # For every laser; `N_POINTS` each, fewer where the stripe is hardly in the picture, none where
    # it is out of it.
    stripes: tuple[StripeView, ...]
    # Shape (N,): for every laser, the change of its points' distance ahead by a pixel across the
    # stripe, in m/px.
    slopes: tuple[FloatArray, ...]

    determined: bool = field(init=False)
    """Whether the stripes determine a plane."""
    _points: FloatArray = field(init=False, repr=False, compare=False)
    # Shape (N,): standard deviation of m·X from `SIGMA_PX`, for every point.
    _sigma: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        seen = [stripe.points_in_dome for stripe in self.stripes if stripe.visible]
        object.__setattr__(self, "_points", np.concatenate([np.empty((0, 3)), *seen]))
        # With m = (0, 1/range, 0) an error of a point changes m·X by its y part over the range.
        sigma = np.abs(np.concatenate([np.empty(0), *self.slopes])) * SIGMA_PX / self.wall_range
        object.__setattr__(self, "_sigma", sigma)
        points, _ = self._weighted(self._points)
        singular = np.linalg.svd(points, compute_uv=False)
        # Points on one line leave one direction of m·X = 1 to rounding.
        rounding = 1e-10
        found = len(singular) == 3 and singular[-1] > rounding * singular[0]
        object.__setattr__(self, "determined", bool(found))

    @classmethod
    def ahead(cls, rig: Rig, wall_range: float) -> "WallView":
        """Return what a rig sees on the wall y = `wall_range` (metres)."""
        camera = rig.camera()
        seen = (visible_stripe(camera, sheet, wall_range) for sheet in sheets_of(rig))
        stripes = tuple(one.thinned(N_POINTS) if one.visible else one for one in seen)
        slopes = tuple(
            point_per_pixel(camera, one)[:, 1] if one.visible else np.empty(0) for one in stripes
        )
        return cls(wall_range, stripes, slopes)

    @property
    def per_pixel(self) -> tuple[float, ...]:
        """As in `ExpectedError`."""
        known = (np.abs(s[~np.isnan(s)]) for s in self.slopes)
        return tuple(float(np.median(s)) if len(s) else np.nan for s in known)

    def measured_by(self, rig: Rig) -> FloatArray:
        """Return range, pitch and yaw (3,) that a rig computes from the same pixels; NaN if none.

        The rig has the same lasers in the same order.
        """
        if not self.determined:
            return np.full(3, np.nan)
        camera, sheets = rig.camera(), sheets_of(rig)
        read = [
            sheet.intersect(camera.rays(stripe.pixels))[0]
            for sheet, stripe in zip(sheets, self.stripes, strict=True)
            if stripe.visible
        ]
        points, weights = self._weighted(np.concatenate(read))
        if len(points) < 3:
            return np.full(3, np.nan)
        x, y, z = np.linalg.lstsq(points, weights)[0].tolist()
        return np.array([1.0 / np.hypot(np.hypot(x, y), z), np.arctan2(z, y), np.arctan2(x, y)])

    def noise(self) -> FloatArray:
        """Return the covariance (3, 3) of range, pitch and yaw by `SIGMA_PX`; NaN where none."""
        if not self.determined:
            return np.full((3, 3), np.nan)
        points, _ = self._weighted(self._points)
        by_m = self._by_m()
        return by_m @ np.linalg.inv(points.T @ points) @ by_m.T

    def by_rates(self, row_times: Callable[[FloatArray], FloatArray]) -> FloatArray:
        """Return the error (3, 3) of range, pitch and yaw by their rates; NaN where none.

        All points are read as if they had been taken at the picture's middle.

        `row_times`: from rows to the times of their exposure, in seconds from the picture's middle.
        """
        if not self.determined:
            return np.full((3, 3), np.nan)
        rows = np.concatenate([stripe.pixels[:, 1] for stripe in self.stripes if stripe.visible])
        # At its time t a point lies on the plane m + t * rate, so m is off by what explains
        # t * rate·X, of which the wall's rate is one column for each part of m.
        points = self._points
        moved, _ = self._weighted(points * row_times(rows)[:, None])
        by_rate = np.linalg.lstsq(self._weighted(points)[0], moved)[0]
        errors: FloatArray = self._by_m() @ by_rate @ np.linalg.inv(self._by_m())
        return errors

    def _by_m(self) -> FloatArray:
        """Return the change of range, pitch and yaw by m = (x, y, z) at (0, 1/range, 0)."""
        far = self.wall_range
        return np.array([[0.0, -(far**2), 0.0], [0.0, 0.0, far], [far, 0.0, 0.0]])

    def calibration(self, errors: PostureErrors) -> FloatArray:
        """Return the covariance (3, 3) by a rig's uncertainty; NaN where there is no posture."""
        if not self.determined:
            return np.full((3, 3), np.nan)
        seen = [i for i, stripe in enumerate(self.stripes) if stripe.visible]
        pixels = np.concatenate([self.stripes[i].pixels for i in seen])
        laser = np.concatenate([np.full(len(self.stripes[i].pixels), i) for i in seen])
        sigma, points = self._sigma, self._points
        good = self._good(points)
        wall = fitted_plane(np.array([0.0, 1.0 / self.wall_range, 0.0]), points[good])
        _, covariance = errors.propagate(
            wall, pixels[good], laser[good], points[good], sigma[good] ** -2.0, N_POINTS
        )
        return covariance

    def _good(self, points: FloatArray) -> BoolArray:
        """Return which points (N, 3) are known, and how far a pixel moves them."""
        known: BoolArray = np.isfinite(self._sigma) & (self._sigma > 0.0)
        return known & np.isfinite(points).all(axis=-1)

    def _weighted(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the points (N, 3) that are seen, times their weights (N,), and the weights."""
        good = self._good(points)
        weights = 1.0 / self._sigma[good]
        return points[good] * weights[:, None], weights


def _sigmas(covariance: FloatArray) -> FloatArray:
    # Cancellation leaves rounding errors, which may be negative.
    return np.sqrt(np.maximum(np.diag(covariance), 0.0))
