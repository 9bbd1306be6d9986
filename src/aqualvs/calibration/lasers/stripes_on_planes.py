"""Stripe points of calibration pictures and their places on the flat surfaces of a target.

`StripePoints` are the points of one picture, of all lasers together. `place_stripes` intersects
their rays with the surfaces (paper, Eq. 34); `PooledStripes` joins the points of all pictures.
`binned` puts the points of one laser in one picture into bins, the measurements of the joint
least-squares problem.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Plane, Rays
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.camera import Camera
from aqualvs.optics.sheet import Sheet


@dataclass(frozen=True, slots=True)
class StripePoints:
    """Points on laser stripes, found in one picture."""

    pixels: FloatArray  # Shape (N, 2): sub-pixel centres, in `image`.
    # Shape (N, 2): unit vectors in `image` at right angles to the stripe: a point is measured along
    # these only.
    across: FloatArray
    # Shape (N,): index of the unbroken segment of a stripe that a point belongs to; segments may
    # bend.
    chain: IntArray
    # Shape (N,): nominal standard deviation along `across`; solves estimate the real one.
    sigma_px: FloatArray

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.chain)

    def thinned(self, n_points: int) -> "StripePoints":
        """Return every k-th point, so that hardly more than `n_points` are left."""
        every = -(-len(self) // n_points) if len(self) else 1
        return self if every == 1 else self.at(np.arange(0, len(self), every))

    def at(self, index: IntArray) -> "StripePoints":
        """Return the points with these indices (M,)."""
        pixels, across = self.pixels[index], self.across[index]
        return StripePoints(pixels, across, self.chain[index], self.sigma_px[index])


# An open side of a box ends this share of the box's size beyond the outermost marker.
_RIM_SHARE = 0.02
_ON_PLANE = 1e-4
_PIXEL_STEPS: FloatArray = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])


@dataclass(frozen=True, slots=True)
class TargetSurfaces:
    """Flat surfaces of a target that stripes are seen on, in the target's frame."""

    names: tuple[str, ...]  # Names in messages.
    planes: tuple[Plane, ...]  # Normals point away from the side that is seen.
    # Shape (3,): bounds in metres; stripes outside lie on something else.
    lowest: FloatArray
    highest: FloatArray

    def hits(self, rays_in_target: Rays) -> tuple[FloatArray, IntArray]:
        """Intersect rays with the surfaces.

        Returns
        -------
        points : array, shape (N, 3)
            In the target's frame; NaN if a ray meets none.
        surface : int array, shape (N,)
            Index of the surface; -1 if there is none, or the hit lies near another surface.
        """
        n = len(rays_in_target.origins)
        points, surface = np.full((n, 3), np.nan), np.full(n, -1)
        for i, plane in enumerate(self.planes):
            there, valid = plane.intersect(rays_in_target)
            valid &= rays_in_target.directions @ plane.normal > 0.0
            valid &= self._inside(there, i) & (surface < 0)
            points[valid], surface[valid] = there[valid], i
        return points, surface

    def placed(self, dome_from_target: SE3) -> list[Plane]:
        """Return the planes of the surfaces in `dome`."""
        normals = [dome_from_target.rotate(plane.normal) for plane in self.planes]
        return [
            Plane(normal, plane.offset + float(normal @ dome_from_target.translation))
            for plane, normal in zip(self.planes, normals, strict=True)
        ]

    def _inside(self, points: FloatArray, i_own: int) -> BoolArray:
        # Points this near to the edge of two surfaces may be light of the other one, or of both.
        edge = 0.006
        with np.errstate(invalid="ignore"):
            inside: BoolArray = np.all((points >= self.lowest) & (points <= self.highest), axis=1)
            for i, plane in enumerate(self.planes):
                if i != i_own:
                    inside &= plane.signed_distance(points) <= -edge
        return inside


def box_surfaces(planes: Mapping[str, Plane], points: FloatArray) -> TargetSurfaces:
    """Return the surfaces of an open box.

    Planes and points are in `box`. Normals may point either way; surfaces end at their
    intersections. `points` (N, 3) are all corners of all markers: on its open sides the box ends
    just beyond the outermost of them, along the axes of `box`. Raises `CalibrationError` if there
    are fewer than two planes, or markers on both sides of one.
    """
    if len(planes) < 2:
        raise CalibrationError(
            f"the box has {len(planes)} plane; a laser's plane needs stripes on two or more"
        )
    outward = []
    for name, plane in planes.items():
        beyond = plane.signed_distance(points)
        if beyond.max() > _ON_PLANE and beyond.min() < -_ON_PLANE:
            raise CalibrationError(
                f"plane '{name}' of the box has markers {beyond.max() * 1e3:.1f} mm on one side "
                f"and {-beyond.min() * 1e3:.1f} mm on the other; correct its normal, its d, or "
                "the markers' corners"
            )
        outward.append(plane if beyond.max() <= _ON_PLANE else Plane(-plane.normal, -plane.offset))
    lowest, highest = points.min(axis=0), points.max(axis=0)
    rim = _RIM_SHARE * float(np.max(highest - lowest))
    return TargetSurfaces(tuple(planes), tuple(outward), lowest - rim, highest + rim)


def board_surface(*, thickness: float = 0.0) -> TargetSurfaces:
    """Return the surface of a board, for stripes on the board or beside it.

    `thickness`: distance of the board's printed face in front of the surface of the stripes, in
    metres; 0 if the print is on the surface itself.
    """
    far = np.full(3, np.inf)
    # A board's z axis points into it (OpenCV).
    return TargetSurfaces(("board",), (Plane(np.array([0.0, 0.0, 1.0]), thickness),), -far, far)


@dataclass(frozen=True, slots=True)
class PlacedStripes:
    """Stripe points of one picture on the surfaces of its target, N of them."""

    index: IntArray  # Shape (N,): indices into the `StripePoints`.
    surface: IntArray  # Shape (N,): index into `TargetSurfaces`.
    points_in_dome: FloatArray  # Shape (N, 3): in metres.
    # Shape (N, 3, 2): derivative of a point on its surface by its pixel, metres per pixel.
    by_pixel: FloatArray
    # Shape (N, 2): as `StripePoints.across`.
    across: FloatArray

    @property
    def by_across(self) -> FloatArray:
        """Derivative of points by their pixel across the stripe, shape (N, 3)."""
        moved: FloatArray = np.einsum("nij,nj->ni", self.by_pixel, self.across)
        return moved

    @property
    def by_along(self) -> FloatArray:
        """Derivative of points by their pixel along the stripe, shape (N, 3)."""
        along = np.stack([-self.across[:, 1], self.across[:, 0]], axis=-1)
        moved: FloatArray = np.einsum("nij,nj->ni", self.by_pixel, along)
        return moved

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.index)


@dataclass(frozen=True, slots=True)
class PooledStripes:
    """Stripe points of all views, on all surfaces."""

    placed: PlacedStripes  # N points of all views; `index` counts within each view.
    # Shape (N,): surface of a view that a point lies on, counted through all views.
    patch: IntArray
    # Surface of every patch, in `dome`.
    patch_planes: tuple[Plane, ...]
    # Shape (N,): view of each point.
    view: IntArray
    # Shape (N, 3): in metres.
    points_in_target: FloatArray
    # Shape (N,): True for points within the bounds of the target's corners.
    on_target: BoolArray
    # Shape (N,): unbroken segment of a stripe, counted through all views.
    chain: IntArray


def place_stripes(
    camera: Camera, stripes: StripePoints, dome_from_target: SE3, surfaces: TargetSurfaces
) -> PlacedStripes:
    """Find the surface and place of every stripe point (paper, Eq. 34).

    The camera looks into the medium of the picture. Only points that lie on a surface of the target
    and not near its edge to another are returned.
    """
    rays = camera.rays(stripes.pixels)
    target_from_dome = dome_from_target.inverse()
    in_target = Rays(
        target_from_dome.apply(rays.origins), target_from_dome.rotate(rays.directions), rays.valid
    )
    points, surface = surfaces.hits(in_target)
    index = np.flatnonzero(surface >= 0)
    points_in_dome = dome_from_target.apply(points[index])
    normals = np.stack([dome_from_target.rotate(p.normal) for p in surfaces.planes])
    _, _, by_point = camera.project_with_jacobian(points_in_dome)
    by_pixel = solve_on_surface(by_point, normals[surface[index]], _PIXEL_STEPS)
    seen = np.all(np.isfinite(by_pixel), axis=(1, 2))
    index = index[seen]
    return PlacedStripes(
        index, surface[index], points_in_dome[seen], by_pixel[seen], stripes.across[index]
    )


def solve_on_surface(by_point: FloatArray, normals: FloatArray, right: FloatArray) -> FloatArray:
    """Return the moves (N, 3, K) of points on surfaces that cause given changes.

    The inverse of the projection within the surface: three equations for a point's three
    coordinates, two of them the pixel's.

    Parameters
    ----------
    by_point : array, shape (N, 2, 3)
        Derivative of the projection.
    normals : array, shape (N, 3)
        Of the surfaces, in `dome`.
    right : array, shape (N, 3, K) or (3, K)
        Changes of the pixel's x and y, and of the distance along the normal.
    """
    system = np.concatenate([by_point, normals[:, None, :]], axis=1)
    finite = np.all(np.isfinite(system), axis=(1, 2))
    system[~finite] = np.eye(3)
    moved: FloatArray = np.linalg.solve(
        system, np.broadcast_to(right, (len(system), *right.shape[-2:]))
    )
    moved[~finite] = np.nan
    return moved


BIN_PX = 12.0
"""Length of a bin along a stripe: neighbouring points share speckle, paint and blur."""


@dataclass(frozen=True, slots=True)
class StripeGroup:
    """B bins of points of one laser in one view, along each surface in turn."""

    view: int  # Index of the view.
    laser: int  # Index of the laser.
    # Shape (B, 2): means of the points' centres, weighted by their noise, in `image`.
    pixels: FloatArray
    across: FloatArray  # Shape (B, 2): as `StripePoints`.
    surface: IntArray  # Shape (B,): index into `TargetSurfaces`.
    sigma_px: FloatArray  # Shape (B,): nominal noise across the stripe.
    counts: IntArray  # Shape (B,): number of points in every bin.
    # Shape (B,): derivative of the distance from the sheet by the pixel across the stripe, metres
    # per pixel; taken at the start and held, so that residuals stay plain squares.
    gain: FloatArray

    def __len__(self) -> int:
        """Return the number of bins."""
        return len(self.counts)


def binned(
    i_view: int, i_laser: int, points: StripePoints, surface: IntArray, shared_error_px: float = 0.0
) -> StripeGroup:
    """Put the points of one stripe, on surfaces (N,), into bins along it, with a gain of 1.

    Within a bin a stripe is straight to a hundredth of a pixel, so that means of pixels can
    replace means of residuals. `shared_error_px`: standard deviation of a shift and turn of the
    whole stripe in its picture; all bins together determine place and direction no better than
    that.
    """
    order, starts = _ordered(points.pixels, surface)
    weights = 1.0 / points.sigma_px[order] ** 2
    total = np.add.reduceat(weights, starts)
    counts = np.diff(np.append(starts, len(order)))

    def mean(values: FloatArray) -> FloatArray:
        summed = np.add.reduceat(values[order] * weights[:, None], starts, axis=0)
        return summed / total[:, None]

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
        sigma_px=np.hypot(
            np.sqrt(counts.max() / total), shared_error_px * np.sqrt(0.5 * len(starts))
        ),
        counts=counts.astype(np.int64),
        gain=np.ones(len(starts)),
    )


def way_along(points: FloatArray) -> FloatArray:
    """Return how far along their line points (N, K) lie from their middle, shape (N,)."""
    offsets = points - points.mean(axis=0)
    way: FloatArray = offsets @ np.linalg.svd(offsets, full_matrices=False)[2][0]
    return way


def _ordered(pixels: FloatArray, surface: IntArray) -> tuple[IntArray, IntArray]:
    """Return the order of points along their stripe, by surface, and each bin's first index."""
    order, starts, n = [], [], 0
    # A gap of more pixels than this along a stripe ends a bin.
    gap_px = 10.0
    for i in np.unique(surface):
        mine = np.flatnonzero(surface == i)
        way = way_along(pixels[mine])
        along = np.argsort(way, kind="stable")
        order.append(mine[along])
        first = last = -np.inf
        for k, here in enumerate(way[along].tolist()):
            if here - first >= BIN_PX or here - last > gap_px:
                starts.append(n + k)
                first = here
            last = here
        n += len(mine)
    return np.concatenate(order), np.array(starts, np.int64)


def points_on(
    camera: Camera, pixels: FloatArray, surface: IntArray, planes: Sequence[Plane]
) -> tuple[FloatArray, FloatArray]:
    """Return the points where pixels meet their surfaces, and the normals there, (N, 3) each.

    Parameters
    ----------
    camera : Camera
        Looking into the medium of the picture.
    pixels : array, shape (N, 2)
        Of the picture.
    surface : int array, shape (N,)
        Index into `planes`.
    planes : sequence of Plane
        The target's surfaces in `dome`; their normals may have any length.
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
    """Return the group with its gain for the present surfaces and sheet."""
    points, normals = points_on(camera, group.pixels, group.surface, planes)
    _, _, by_point = camera.project_with_jacobian(points)
    right = np.concatenate([group.across, np.zeros((len(points), 1))], axis=1)[..., None]
    by_across = solve_on_surface(by_point, normals, right)[..., 0]
    gain = np.einsum("ni,ni->n", sheet.gradient(points), by_across)
    return replace(group, gain=np.abs(gain))


def correlation_factor(sequences: Sequence[FloatArray]) -> float:
    """Return the ratio of the variance of a mean to that for independent values.

    One plus twice the sum of autocorrelations, up to the first that is not positive (Geyer 1992,
    doi:10.1214/ss/1177011137, initial positive sequence). At least 1. Each sequence (B,) has
    residuals in order along a stripe; NaN for missing ones.
    """
    # Greatest lag of the autocorrelation, in bins, and least number of pairs at each lag.
    max_lag, min_pairs = 12, 20
    products = np.zeros(max_lag + 1)
    pairs = np.zeros(max_lag + 1)
    for values in sequences:
        known = np.isfinite(values)
        filled = np.where(known, values, 0.0)
        for lag in range(min(max_lag + 1, len(values))):
            end = len(values) - lag
            products[lag] += float(filled[:end] @ filled[lag:])
            pairs[lag] += float(np.count_nonzero(known[:end] & known[lag:]))
    if products[0] <= 0.0:
        return 1.0
    factor = 1.0
    for lag in range(1, max_lag + 1):
        if pairs[lag] < min_pairs or products[lag] <= 0.0:
            break
        factor += 2.0 * (products[lag] / pairs[lag]) / (products[0] / pairs[0])
    return factor
