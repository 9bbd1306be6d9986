"""Where the vehicle is in a box of markers: the paper's least squares of distances in space.

The paper minimises V (Eq. 32-33) over the pose and the distance along every ray; each distance has
a closed form, so that V is the sum of squared distances of the markers' corners from their rays.
Reprojection weighs corners as they are measured, in pixels, and is better; both are reported.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.calibration.pose_steps import moved_target, point_by_pose
from aqualvs.calibration.view import View
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.camera import Camera

# A corner belongs to a plane of the box that it is this near to, in metres.
_ON_PLANE = 1e-4
_MAX_STEPS = 50
_SMALL_TURN, _SMALL_SHIFT = 1e-10, 1e-10


@dataclass(frozen=True, slots=True)
class SpatialPose:
    """A pose by the paper's cost function.

    Attributes
    ----------
    dome_from_target : SE3
        The inverse of the paper's (S^G, R_S^G).
    cost : float
        V of Eq. 32 at its minimum, in square metres.
    rms : float
        Root mean square distance of corners from their rays, in metres.
    """

    dome_from_target: SE3
    cost: float
    rms: float


def spatial_pose(camera: Camera, view: View, start: SE3) -> SpatialPose:
    """Minimise the paper's V (Eq. 32-33).

    Parameters
    ----------
    camera : Camera
        Looking into the medium of the picture.
    view : View
        Corners that are believed; this cost has no defence against wrong ones.
    start : SE3
        `dome_from_target` near the solution.

    Returns
    -------
    SpatialPose

    Raises
    ------
    CalibrationError
        If fewer than three corners have rays (the paper's least number).
    """
    rays = camera.rays(view.pixels)
    n = int(np.count_nonzero(rays.valid))
    if n < 3:
        raise CalibrationError(f"{view.name}: {n} corners can be used but a pose needs 3")
    origins, directions = rays.origins[rays.valid], rays.directions[rays.valid]
    points = view.points[rays.valid]
    # The closed form of lambda leaves of every equation what is at right angles to its ray.
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    middle, pose = points.mean(axis=0), start
    for _ in range(_MAX_STEPS):
        in_dome = pose.apply(points)
        rows = np.einsum("nij,nj->ni", across, in_dome - origins).reshape(-1)
        slopes = (across @ point_by_pose(in_dome, pose.apply(middle))).reshape(-1, 6)
        step = -np.linalg.lstsq(slopes, rows, rcond=None)[0]
        pose = moved_target(pose, middle, step)
        if np.all(np.abs(step[:3]) < _SMALL_TURN) and np.all(np.abs(step[3:]) < _SMALL_SHIFT):
            break
    missed = np.einsum("nij,nj->ni", across, pose.apply(points) - origins)
    cost = float(np.sum(missed**2))
    return SpatialPose(pose, cost, float(np.sqrt(cost / n)))


def planes_with_points(view: View, planes: Sequence[Plane]) -> tuple[int, ...]:
    """Return which of a target's planes the view's points lie on, three or more each."""
    near = [np.abs(plane.signed_distance(view.points)) < _ON_PLANE for plane in planes]
    return tuple(i for i, on in enumerate(near) if np.count_nonzero(on) >= 3)


def pose_difference(a: SE3, b: SE3, middle: FloatArray) -> tuple[float, float]:
    """Return by how much two poses differ: angle (radians), and shift of a point `middle` (m)."""
    turn = a.rotation @ b.rotation.T
    # Accurate near zero, unlike the arc cosine of the trace.
    sine = 0.5 * np.linalg.norm(
        [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    )
    angle = float(np.arctan2(sine, 0.5 * (np.trace(turn) - 1.0)))
    return angle, float(np.linalg.norm(a.apply(middle) - b.apply(middle)))
