"""Stripe points of one laser in one picture, in bins: what the joint problem measures."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from aqualvs.calibration.stripe_points import StripePoints
from aqualvs.calibration.stripes_on_planes import solve_on_surface
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.camera import Camera
from aqualvs.optics.sheet import Sheet

BIN_PX = 12.0
"""Neighbouring points share speckle, paint and blur; so many pixels along count as one."""
# A gap of more pixels than this along a stripe ends a bin.
_GAP_PX = 10.0
# Autocorrelation is looked at over so many bins, each from so many pairs at least.
_MAX_LAG, _LEAST_PAIRS = 12, 20


@dataclass(frozen=True, slots=True)
class StripeGroup:
    """Bins of points of one laser in one view, B of them, along each surface in turn.

    Attributes
    ----------
    view, laser : int
        Which.
    pixels : array, shape (B, 2)
        Means of the points' centres, weighed by their noise, in `image`.
    across : array, shape (B, 2)
        As `StripePoints`.
    surface : int array, shape (B,)
        Index into `Surfaces`.
    sigma_px : array, shape (B,)
        Nominal noise across the stripe.
    counts : int array, shape (B,)
        Number of points in every bin.
    gain : array, shape (B,)
        How far the point moves away from the sheet as its pixel moves across the stripe, metres
        per pixel; taken at the start and held, so that residuals stay plain squares.
    """

    view: int
    laser: int
    pixels: FloatArray
    across: FloatArray
    surface: IntArray
    sigma_px: FloatArray
    counts: IntArray
    gain: FloatArray

    def __len__(self) -> int:
        """Return the number of bins."""
        return len(self.counts)


def binned(i_view: int, i_laser: int, points: StripePoints, surface: IntArray) -> StripeGroup:
    """Put the points of one stripe into bins along it.

    Parameters
    ----------
    i_view, i_laser : int
        Which view and laser.
    points : StripePoints
        Of that laser alone, N of them.
    surface : int array, shape (N,)
        Which surface each lies on.

    Returns
    -------
    StripeGroup
        With a gain of 1.

    Notes
    -----
    Within a bin a stripe is straight to a hundredth of a pixel, so that means of pixels stand for
    means of residuals.
    """
    order, starts = _ordered(points.pixels, surface)
    weights = 1.0 / points.sigma_px[order] ** 2
    total = np.add.reduceat(weights, starts)
    counts = np.diff(np.append(starts, len(order)))

    def mean(values: FloatArray) -> FloatArray:
        summed = np.add.reduceat(values[order] * weights[:, None], starts, axis=0)
        result: FloatArray = summed / total[:, None]
        return result

    # Stripes found along x and along y may have opposite signs.
    along_first = np.sign(points.across @ points.across[0])
    across = mean(points.across * np.where(along_first < 0.0, -1.0, 1.0)[:, None])
    return StripeGroup(
        view=i_view,
        laser=i_laser,
        pixels=mean(points.pixels),
        across=across / np.linalg.norm(across, axis=1, keepdims=True),
        surface=surface[order][starts],
        # A full bin counts as one point, for its points share most of their error.
        sigma_px=np.sqrt(counts.max() / total),
        counts=counts.astype(np.int64),
        gain=np.ones(len(starts)),
    )


def _ordered(pixels: FloatArray, surface: IntArray) -> tuple[IntArray, IntArray]:
    """Return the order of points along their stripe, surface by surface, and bins' first places."""
    order, starts, n = [], [], 0
    for i in np.unique(surface):
        mine = np.flatnonzero(surface == i)
        offsets = pixels[mine] - pixels[mine].mean(axis=0)
        way = offsets @ np.linalg.svd(offsets, full_matrices=False)[2][0]
        along = np.argsort(way, kind="stable")
        order.append(mine[along])
        first = last = -np.inf
        for k, here in enumerate(way[along].tolist()):
            if here - first >= BIN_PX or here - last > _GAP_PX:
                starts.append(n + k)
                first = here
            last = here
        n += len(mine)
    return np.concatenate(order), np.array(starts, np.int64)


def points_on(
    camera: Camera, pixels: FloatArray, surface: IntArray, planes: Sequence[Plane]
) -> tuple[FloatArray, FloatArray]:
    """Return where pixels meet their surfaces, and the surfaces' normals, (N, 3) each.

    Parameters
    ----------
    camera : Camera
        Looking into the medium of the picture.
    pixels : array, shape (N, 2)
        Of the picture.
    surface : int array, shape (N,)
        Index into `planes`.
    planes : sequence of Plane
        The target's surfaces in `dome`; their normals need not be units.
    """
    rays = camera.rays(pixels)
    normals = np.stack([plane.normal for plane in planes])[surface]
    offsets = np.array([plane.offset for plane in planes])[surface]
    ahead = np.einsum("ni,ni->n", rays.directions, normals)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (offsets - np.einsum("ni,ni->n", rays.origins, normals)) / ahead
    return rays.points_at(distance), normals


def with_gain(
    group: StripeGroup, camera: Camera, planes: Sequence[Plane], sheet: Sheet
) -> StripeGroup:
    """Return the group with its gain by the present surfaces and sheet."""
    points, normals = points_on(camera, group.pixels, group.surface, planes)
    _, _, by_point = camera.project_with_jacobian(points)
    right = np.concatenate([group.across, np.zeros((len(points), 1))], axis=1)[..., None]
    by_across = solve_on_surface(by_point, normals, right)[..., 0]
    gain = np.einsum("ni,ni->n", sheet.gradient(points), by_across)
    return replace(group, gain=np.abs(gain))


def with_shared_error(group: StripeGroup, error_px: float) -> StripeGroup:
    """Return the group with the noise of its bins raised by an error that they share.

    Parameters
    ----------
    group : StripeGroup
    error_px : float
        Standard deviation of what shifts and turns the whole stripe in its picture. All bins
        together then tell a place and a direction no better than that.
    """
    shared = error_px * np.sqrt(0.5 * len(group))
    return replace(group, sigma_px=np.hypot(group.sigma_px, shared))


def correlation_factor(sequences: Sequence[FloatArray]) -> float:
    """Return by how much the variance of a mean exceeds that of independent values.

    Parameters
    ----------
    sequences : sequence of array, shape (B,)
        Residuals in order along stripes; NaN where there is none.

    Notes
    -----
    One plus twice the sum of autocorrelations, up to the first that is not positive (Geyer 1992,
    doi:10.1214/ss/1177011137, initial positive sequence). At least 1.
    """
    products = np.zeros(_MAX_LAG + 1)
    pairs = np.zeros(_MAX_LAG + 1)
    for values in sequences:
        known = np.isfinite(values)
        filled = np.where(known, values, 0.0)
        for lag in range(min(_MAX_LAG + 1, len(values))):
            end = len(values) - lag
            products[lag] += float(filled[:end] @ filled[lag:])
            pairs[lag] += float(np.count_nonzero(known[:end] & known[lag:]))
    if products[0] <= 0.0:
        return 1.0
    factor = 1.0
    for lag in range(1, _MAX_LAG + 1):
        if pairs[lag] < _LEAST_PAIRS or products[lag] <= 0.0:
            break
        factor += 2.0 * (products[lag] / pairs[lag]) / (products[0] / pairs[0])
    return factor
