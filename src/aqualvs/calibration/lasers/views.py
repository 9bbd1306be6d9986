"""Pictures of a laser calibration: pose of the target in each, and stripe points on its surfaces.

Poses are solved by reprojection, which weighs corners in pixels, as they are measured. For
comparison `spatial_pose` solves the paper's least squares of distances in space: V (Eq. 32-33) is
minimised over the pose and the distance along every ray. Each distance has a closed form, so that V
is the sum of squared distances of the markers' corners from their rays. Reprojection is better;
both are reported.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from aqualvs.calibration.lasers.stripes_on_planes import (
    PlacedStripes,
    PooledStripes,
    StripePoints,
    TargetSurfaces,
    place_stripes,
)
from aqualvs.calibration.solver.bundle import moved_target, point_by_pose
from aqualvs.calibration.solver.initial_pose import target_pose
from aqualvs.calibration.targets.targets import View
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3, rotvec_from_rotation
from aqualvs.optics.camera import Camera

# A corner belongs to a plane of the box within this distance, in metres.
_ON_PLANE = 1e-4


def spatial_pose(camera: Camera, view: View, start: SE3) -> SE3:
    """Return the pose that minimises the paper's V (Eq. 32-33), from one near it.

    Both are `dome_from_target`, the inverse of the paper's (S^G, R_S^G). The view has inlier
    corners alone: this cost is not robust. Raises `CalibrationError` if fewer than three corners
    have rays (the paper's minimum).
    """
    rays = camera.rays(view.pixels)
    n = int(np.count_nonzero(rays.valid))
    if n < 3:
        raise CalibrationError(f"{view.name}: {n} corners can be used but a pose needs 3")
    origins, directions = rays.origins[rays.valid], rays.directions[rays.valid]
    points = view.points[rays.valid]
    # With the closed form of lambda the residual is the part at right angles to the ray.
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    middle, pose = points.mean(axis=0), start
    max_steps, small_turn, small_shift = 50, 1e-10, 1e-10
    for _ in range(max_steps):
        in_dome = pose.apply(points)
        rows = np.einsum("nij,nj->ni", across, in_dome - origins).reshape(-1)
        slopes = (across @ point_by_pose(in_dome, pose.apply(middle))).reshape(-1, 6)
        step = -np.linalg.lstsq(slopes, rows, rcond=None)[0]
        pose = moved_target(pose, middle, step)
        if np.all(np.abs(step[:3]) < small_turn) and np.all(np.abs(step[3:]) < small_shift):
            break
    return pose


def planes_with_points(view: View, planes: Sequence[Plane]) -> tuple[int, ...]:
    """Return the planes of a target that hold three or more of the view's points."""
    near = [np.abs(plane.signed_distance(view.points)) < _ON_PLANE for plane in planes]
    return tuple(i for i, on in enumerate(near) if np.count_nonzero(on) >= 3)


def pose_difference(a: SE3, b: SE3, middle: FloatArray) -> tuple[float, float]:
    """Return the difference of two poses: angle (radians), and shift of a point `middle` (m)."""
    turn = rotvec_from_rotation(a.rotation @ b.rotation.T)
    shift = a.apply(middle) - b.apply(middle)
    return float(np.linalg.norm(turn)), float(np.linalg.norm(shift))


@dataclass(frozen=True, slots=True)
class LaserView:
    """Points of the target and of stripes on it in one picture."""

    view: View  # Corners of markers or of the board.
    stripes: StripePoints  # Of all lasers together.


@dataclass(frozen=True, slots=True)
class PlacedView:
    """Picture with the target's pose and the stripes on its surfaces."""

    view: View  # Inlier corners.
    stripes: StripePoints  # As found.
    dome_from_target: SE3  # By reprojection.
    spatial: SE3  # The same by the paper's cost.
    placed: PlacedStripes  # Stripe points on the target's surfaces.
    n_corners_rejected: int  # Number of outlier corners.
    rms_px: float  # Root mean square residual of the corners for the pose by them alone.


def corners_in_lasers_light(view: LaserView, green: Camera, camera: Camera) -> LaserView:
    """Return a picture with its corners where light of the lasers would show them.

    A target is seen in green or white light, which water bends otherwise than that of red or blue
    lasers. Without a pose, the picture is returned as it is.

    Parameters
    ----------
    view : LaserView
        As seen.
    green, camera : Camera
        Into the medium of the pictures, for green light and for that of the lasers.
    """
    try:
        pose = target_pose(green, view.view)
    except CalibrationError:
        return view
    points = pose.dome_from_target.apply(view.view.points)
    (there, there_valid), (here, here_valid) = camera.project(points), green.project(points)
    shift = np.where((there_valid & here_valid)[:, None], there - here, 0.0)
    return replace(view, view=replace(view.view, pixels=view.view.pixels + shift))


def place_views(
    camera: Camera, views: Sequence[LaserView], surfaces: TargetSurfaces
) -> tuple[list[PlacedView], dict[str, str]]:
    """Find the pose of every picture, and its stripes on the surfaces.

    The camera looks into the medium of the pictures. If the target has several surfaces, markers
    must be seen on at least two. Returned, too, are the names of the pictures that could not be
    used, with the reason. Raises `CalibrationError` if no picture can be used.
    """
    found: list[PlacedView] = []
    left_out: dict[str, str] = {}
    for view in views:
        name = view.view.name
        try:
            found.append(_placed_view(camera, view, surfaces))
        except CalibrationError as fault:
            left_out[name] = str(fault).removeprefix(f"{name}: ")
    if not found:
        few = f" (and {len(left_out) - 1} more likewise)" if len(left_out) > 1 else ""
        reasons = [f"{name}: {why}" for name, why in left_out.items()]
        reason = reasons[0] if reasons else "no pictures were given"
        raise CalibrationError(f"no picture can be used: {reason}{few}")
    return found, left_out


def _placed_view(camera: Camera, laser_view: LaserView, surfaces: TargetSurfaces) -> PlacedView:
    view = laser_view.view
    min_corners = 4
    if len(view) < min_corners:
        raise CalibrationError(
            f"{view.name}: {len(view)} corners of the target found; show more of it, with better "
            "light, or check the family and sizes in its file"
        )
    pose = target_pose(camera, view)
    believed = view.where(pose.inliers)
    if len(surfaces.planes) > 1:
        seen = planes_with_points(believed, surfaces.planes)
        if len(seen) < 2:
            where = f"plane '{surfaces.names[seen[0]]}' only" if seen else "none of the planes"
            raise CalibrationError(
                f"{view.name}: markers are seen on {where}; turn the vehicle so that markers on "
                "two planes of the box are in the picture"
            )
    elif pose.ambiguous:
        raise CalibrationError(
            f"{view.name}: the board could lean either way; take this picture from nearer, or "
            "more from the side"
        )
    # Neighbouring points of a stripe are nearly redundant.
    enough_points = 2000
    stripes = laser_view.stripes.thinned(enough_points)
    return PlacedView(
        believed,
        stripes,
        pose.dome_from_target,
        spatial_pose(camera, believed, pose.dome_from_target),
        place_stripes(camera, stripes, pose.dome_from_target, surfaces),
        len(view) - len(believed),
        pose.rms_px,
    )


def pooled(views: Sequence[PlacedView], surfaces: TargetSurfaces) -> PooledStripes:
    """Return the stripe points of all pictures joined."""
    n_surfaces = len(surfaces.planes)
    parts = [view.placed for view in views]
    joined = [np.concatenate([getattr(p, name) for p in parts]) for name in PlacedStripes.__slots__]
    patch = [p.surface + n_surfaces * i for i, p in enumerate(parts)]
    planes: list[Plane] = []
    chain, first = [], 0
    for view in views:
        planes += surfaces.placed(view.dome_from_target)
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
        PlacedStripes(*joined),
        np.concatenate(patch),
        tuple(planes),
        np.repeat(np.arange(len(views)), [len(p) for p in parts]),
        in_target,
        inside,
        np.concatenate(chain),
    )


def split_by_view(values: IntArray, views: Sequence[PlacedView]) -> list[IntArray]:
    """Split values (N,) of all points by picture."""
    ends = np.cumsum([len(view.placed) for view in views])[:-1]
    return np.split(values, ends)
