"""Where a solve of poses starts: each view's pose by itself, then all of them turned square."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from aqualvs.calibration.target_pose import closed_form_poses, target_pose
from aqualvs.calibration.view import View
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec, rotvec_from_rotation
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Rig

# Points of a view that a starting pose is found from: more gain nothing.
_ENOUGH_POINTS = 48
# A closed solution whose median corner is this near needs no refinement of its own.
_NEAR_PX = 2.0
_MIN_POINTS = 6
_QUARTER = 0.5 * np.pi


@dataclass(frozen=True, slots=True)
class StartPose:
    """A first pose of a view.

    Attributes
    ----------
    dome_from_target : SE3
    median_px : float
        How far off the median point is that it was found from.
    """

    dome_from_target: SE3
    median_px: float


def start_pose(camera: Camera, view: View) -> StartPose | str:
    """Return a view's pose, however badly the starting camera explains it, or why there is none."""
    few = thinned(view)
    rays = camera.rays(few.pixels)
    if np.count_nonzero(rays.valid) >= _MIN_POINTS:
        quick = [_judged(camera, few, pose) for pose in closed_form_poses(few, rays)]
        best = min(quick, key=lambda start: start.median_px, default=None)
        if best is not None and best.median_px < _NEAR_PX:
            return best
    try:
        found = target_pose(camera, few, max_rms_px=float("inf"))
    except CalibrationError as error:
        return str(error)
    return _judged(camera, few, found.dome_from_target)


def _judged(camera: Camera, view: View, pose: SE3) -> StartPose:
    pixels, _ = camera.project(pose.apply(view.points))
    off = np.linalg.norm(np.nan_to_num(pixels - view.pixels, nan=np.inf), axis=1)
    return StartPose(pose, float(np.median(off)))


def thinned(view: View, n_points: int = _ENOUGH_POINTS) -> View:
    """Return a view with at most so many points, spread over the target."""
    if len(view) <= n_points:
        return view
    keep = np.zeros(len(view), np.bool_)
    # A fixed stride would keep few columns of a board whose rows it divides.
    keep[np.random.default_rng(len(view)).permutation(len(view))[:n_points]] = True
    return view.where(keep)


def square_rotation(rotations: Sequence[FloatArray]) -> FloatArray:
    """Return the nearest `dome_from_board` rotation of boards square to the dome.

    Boards stand upright, on a side or upside down: x and y along the dome's x and -z axes, or a
    quarter turn about y further.

    Parameters
    ----------
    rotations : sequence of array, shape (3, 3)
        Of the boards; the majority decides.
    """
    choices = [
        rotation_from_rotvec([0.0, k * _QUARTER, 0.0]) @ DOME_FROM_CAM_NOMINAL for k in range(4)
    ]
    nearness = [np.median([np.trace(r @ choice.T) for r in rotations]) for choice in choices]
    return choices[int(np.argmax(nearness))]


def turned_square(
    rig: Rig, poses: Sequence[SE3], square: FloatArray, boards: Sequence[int], sigma: float
) -> tuple[Rig, list[SE3]]:
    """Turn camera and boards together about the dome's centre until most boards stand square.

    Pictures cannot tell: through a sphere the turn changes nothing. The turn is that which makes
    one of the boards exactly square and leaves the smallest robust tilt of the others.

    Parameters
    ----------
    rig : Rig
    poses : sequence of SE3
        Of all boards.
    square : array, shape (3, 3)
        Rotation of a square board.
    boards : sequence of int
        Those of which it is known that most are square.
    sigma : float
        How square, in radians.
    """
    tilts = np.array([rotvec_from_rotation(poses[i].rotation @ square.T) for i in boards])
    apart = np.sum((tilts[:, None] - tilts[None]) ** 2, axis=-1)
    best = int(np.argmin(np.sum(np.log1p(apart / sigma**2), axis=1)))
    turn = SE3(rotation_from_rotvec(-tilts[best]), np.zeros(3))
    return replace(rig, dome_from_cam=turn @ rig.dome_from_cam), [turn @ pose for pose in poses]
