"""What a rig can measure: millimetres a pixel, and the uncertainty of posture and water index."""

from dataclasses import dataclass

import numpy as np

from aqualvs.app.check_stripes import StripeView, point_per_pixel, see_stripe
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.rig import Rig

SIGMA_PX = 0.1
"""Standard deviation of a stripe point across the stripe, in pixels."""
N_POINTS = 100
"""Points on every stripe."""
_INDEX_STEP = 1e-4
# Points on one line leave one direction of m·X = 1 to rounding.
_SINGULAR = 1e-10


@dataclass(frozen=True, slots=True)
class Accuracy:
    """What to expect on a wall square to the forward axis.

    Attributes
    ----------
    wall_range : float
        Metres.
    per_pixel : tuple of float
        Range error for one pixel across the stripe, for every laser, in m/px; NaN where its
        stripe is out of the picture.
    sigma_range, sigma_pitch, sigma_yaw : float
        Standard deviations in metres and radians; NaN where the stripes determine no plane.
    """

    wall_range: float
    per_pixel: tuple[float, ...]
    sigma_range: float
    sigma_pitch: float
    sigma_yaw: float

    @property
    def valid(self) -> bool:
        """Whether there is a posture at this range."""
        return bool(np.isfinite(self.sigma_range))


def expect(rig: Rig, wall_range: float) -> Accuracy:
    """Propagate `SIGMA_PX` on `N_POINTS` points a laser to range, pitch and yaw.

    The plane m·X = 1 is fitted by least squares (paper, Eq. 23-26) at the wall m = (0, 1/range, 0),
    each point weighed by what its pixel error makes of m·X.
    """
    camera = rig.camera()
    stripes = [see_stripe(camera, laser.plane, wall_range) for laser in rig.lasers]
    seen = [stripe.thinned(N_POINTS) if stripe.visible else None for stripe in stripes]
    slopes = [None if stripe is None else point_per_pixel(camera, stripe) for stripe in seen]
    per_pixel = tuple(
        np.nan if slope is None else float(np.nanmedian(np.abs(slope[:, 1]))) for slope in slopes
    )
    sigmas = _posture_sigmas(
        [stripe for stripe in seen if stripe is not None],
        [slope for slope in slopes if slope is not None],
        wall_range,
    )
    return Accuracy(wall_range, per_pixel, *sigmas)


def _posture_sigmas(
    stripes: list[StripeView], slopes: list[FloatArray], wall_range: float
) -> tuple[float, float, float]:
    if not stripes:
        return np.nan, np.nan, np.nan
    points = np.concatenate([stripe.points_in_dome for stripe in stripes])
    # With m = (0, 1/range, 0) an error of the point changes m·X by its y part over the range.
    sigma = np.abs(np.concatenate(slopes)[:, 1]) * SIGMA_PX / wall_range
    good = np.isfinite(sigma) & (sigma > 0.0)
    weighted = points[good] / sigma[good, None]
    singular = np.linalg.svd(weighted / wall_range, compute_uv=False)
    if len(singular) < 3 or singular[-1] <= _SINGULAR * singular[0]:
        return np.nan, np.nan, np.nan
    covariance = np.linalg.inv(weighted.T @ weighted)
    yaw, range_, pitch = np.sqrt(np.diag(covariance))
    return (
        float(range_) * wall_range**2,
        float(pitch) * wall_range,
        float(yaw) * wall_range,
    )


def index_sigma(rig: Rig) -> float:
    """Uncertainty of the water's index from a known target, infinite where it cannot be seen.

    The target is a plate of 10 by 6 corners, 180 by 100 mm, held 0.4 m ahead at a known place,
    each corner found to 0.1 px: what an index target on the vehicle gives in one picture.
    """
    if rig.dome is None:
        return np.inf
    x, z = np.meshgrid(np.linspace(-0.09, 0.09, 10), np.linspace(-0.05, 0.05, 6))
    corners = np.stack([x, np.full_like(x, 0.4), z], axis=-1).reshape(-1, 3)
    more, seen_more = rig.in_water(rig.n_water + _INDEX_STEP).camera().project(corners)
    here, seen = rig.camera().project(corners)
    slope = (more - here)[seen & seen_more] / _INDEX_STEP
    information = float(np.sum(slope**2)) / SIGMA_PX**2
    return 1.0 / np.sqrt(information) if information > 0.0 else np.inf
