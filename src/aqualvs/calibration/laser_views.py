"""The pictures of a laser calibration: where the vehicle was in each, and what its stripes lit."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from aqualvs.calibration.box_pose import SpatialPose, planes_with_points, spatial_pose
from aqualvs.calibration.stripe_points import StripePoints
from aqualvs.calibration.stripes_on_planes import (
    PlacedStripes,
    PooledStripes,
    Surfaces,
    place_stripes,
)
from aqualvs.calibration.target_pose import target_pose
from aqualvs.calibration.view import View
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.camera import Camera

_FEWEST_CORNERS = 4
# Neighbouring points of a stripe say much the same.
_ENOUGH_POINTS = 2000


@dataclass(frozen=True, slots=True)
class LaserView:
    """One picture: points of the target, and of stripes on it.

    Attributes
    ----------
    view : View
        Corners of markers or of the board.
    stripes : StripePoints
        Of all lasers together.
    """

    view: View
    stripes: StripePoints


@dataclass(frozen=True, slots=True)
class PlacedView:
    """A picture with the target's pose in it.

    Attributes
    ----------
    view : View
        Corners that were believed.
    stripes : StripePoints
        As found.
    dome_from_target : SE3
        By reprojection.
    spatial : SpatialPose
        By the paper's cost.
    placed : PlacedStripes
        Stripe points on the target's surfaces.
    n_corners_rejected : int
        Corners that were not believed.
    rms_px : float
        Root mean square distance of the corners from where the pose by them alone puts them.
    """

    view: View
    stripes: StripePoints
    dome_from_target: SE3
    spatial: SpatialPose
    placed: PlacedStripes
    n_corners_rejected: int
    rms_px: float


def place_views(
    camera: Camera, views: Sequence[LaserView], surfaces: Surfaces
) -> tuple[list[PlacedView], list[str]]:
    """Find the pose of every picture, and its stripes on the surfaces.

    Parameters
    ----------
    camera : Camera
        Looking into the medium of the pictures.
    views : sequence of LaserView
        One for each picture.
    surfaces : Surfaces
        Of the target. Where it has several, markers must be seen on two or more.

    Returns
    -------
    placed : list of PlacedView
    left_out : list of str
        Why others could not be used, in words, the picture's name first.

    Raises
    ------
    CalibrationError
        If no picture can be used.
    """
    found, left_out = [], []
    for view in views:
        try:
            found.append(_placed_view(camera, view, surfaces))
        except CalibrationError as fault:
            left_out.append(str(fault))
    if not found:
        few = f" (and {len(left_out) - 1} others likewise)" if len(left_out) > 1 else ""
        reason = left_out[0] if left_out else "no pictures were given"
        raise CalibrationError(f"no picture can be used: {reason}{few}")
    return found, left_out


def _placed_view(camera: Camera, laser_view: LaserView, surfaces: Surfaces) -> PlacedView:
    view = laser_view.view
    if len(view) < _FEWEST_CORNERS:
        raise CalibrationError(
            f"{view.name}: {len(view)} corners of the target found; show more of it, with better "
            "light, or check the family and sizes in its file"
        )
    pose = target_pose(camera, view)
    believed = view.where(pose.inliers)
    if len(surfaces.planes) > 1:
        _check_surfaces(believed, surfaces)
    elif pose.ambiguous:
        raise CalibrationError(
            f"{view.name}: the board could lean either way; take this picture from nearer, or "
            "more from the side"
        )
    return replaced(
        camera,
        PlacedView(
            believed,
            laser_view.stripes.thinned(_ENOUGH_POINTS),
            pose.dome_from_target,
            spatial_pose(camera, believed, pose.dome_from_target),
            _none(),
            len(view) - len(believed),
            pose.rms_px,
        ),
        pose.dome_from_target,
        surfaces,
    )


def replaced(camera: Camera, view: PlacedView, pose: SE3, surfaces: Surfaces) -> PlacedView:
    """Return the picture with another pose, and its stripes where that puts them."""
    placed = place_stripes(camera, view.stripes, pose, surfaces)
    return replace(view, dome_from_target=pose, placed=placed)


def _check_surfaces(view: View, surfaces: Surfaces) -> None:
    seen = planes_with_points(view, surfaces.planes)
    if len(seen) < 2:
        where = f"plane '{surfaces.names[seen[0]]}' only" if seen else "none of the planes"
        raise CalibrationError(
            f"{view.name}: markers are seen on {where}; turn the vehicle so that markers on two "
            "planes of the box are in the picture"
        )


def _none() -> PlacedStripes:
    return PlacedStripes(
        np.zeros(0, np.int64),
        np.zeros(0, np.int64),
        np.zeros((0, 3)),
        np.zeros((0, 3, 2)),
        np.zeros((0, 2)),
    )


def pooled(views: Sequence[PlacedView], surfaces: Surfaces) -> PooledStripes:
    """Return the stripe points of all pictures as one."""
    n_surfaces = len(surfaces.planes)
    parts = [view.placed for view in views]
    placed = PlacedStripes(
        np.concatenate([p.index for p in parts]),
        np.concatenate([p.surface for p in parts]),
        np.concatenate([p.points_in_dome for p in parts]),
        np.concatenate([p.by_pixel for p in parts]),
        np.concatenate([p.across for p in parts]),
    )
    patch = [p.surface + n_surfaces * i for i, p in enumerate(parts)]
    planes: list[Plane] = []
    chain, first = [], 0
    for view in views:
        planes += [surfaces.placed(i, view.dome_from_target) for i in range(n_surfaces)]
        chain.append(view.stripes.chain[view.placed.index] + first)
        first += int(view.stripes.chain.max(initial=-1)) + 1
    in_target = np.concatenate(
        [v.dome_from_target.inverse().apply(v.placed.points_in_dome) for v in views]
    )
    corners = np.concatenate([v.view.points for v in views])
    low, high = corners.min(axis=0), corners.max(axis=0)
    # A flat target has bounds along its face only.
    inside = np.all((in_target >= low) & (in_target <= high) | (high <= low), axis=1)
    return PooledStripes(
        placed,
        np.concatenate(patch),
        tuple(planes),
        np.repeat(np.arange(len(views)), [len(p) for p in parts]),
        in_target,
        inside,
        np.concatenate(chain),
    )


def split_by_view(values: IntArray, views: Sequence[PlacedView]) -> list[IntArray]:
    """Return what belongs to each picture of values (N,) of all points."""
    ends = np.cumsum([len(view.placed) for view in views])[:-1]
    return np.split(values, ends)
