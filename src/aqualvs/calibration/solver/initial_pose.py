"""Pose of a target from one picture, without starting values, for flat and other targets.

Through a dome there is no closed form. The rays that the pixels see in the outer medium are first
taken to start at the one point nearest to them all, for which perspective-n-point has closed
solutions: IPPE for flat targets with both of its answers (Collins & Bartoli 2014,
doi:10.1007/s11263-014-0725-5), SQPnP for others (Terzakis & Lourakis 2020,
doi:10.1007/978-3-030-58452-8_28). Each is then refined robustly through the true optics
(`target_pose`).

`start_pose` gives the faster initial guess of each view for a bundle; `turned_square` then turns
camera and boards together until most boards stand square to the dome.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import cv2
import numpy as np

from aqualvs.calibration.solver.bundle import CORNER_SIGMA_PX, CORNERS, moved_target, point_by_pose
from aqualvs.calibration.solver.least_squares import Block, Solution, solve
from aqualvs.calibration.targets.targets import View
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.planes import Rays
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec, rotvec_from_rotation
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Rig

MAX_RMS_PX = 5.0
"""Largest residual of corners of the right target."""


class _PoseOptions(NamedTuple):
    """Initial guess of a target's pose."""

    min_points: int = 4
    # Extents of a target, relative to its largest, below which it is a line, flat, and nearly flat.
    line: float = 1e-3
    flat: float = 1e-6
    nearly_flat: float = 0.05
    # Error, in pixels, of taking all rays to meet in one point, which behind a dome they do not.
    start_error_px: float = 8.0
    few_inliers: float = 0.7
    # A second pose with residuals less than this many times larger may be the true one.
    rival: float = 1.5
    # Number of points of a view used for a starting pose: more gain nothing.
    enough_points: int = 48
    # A closed solution with a median error below this needs no refinement.
    near_px: float = 2.0
    start_min_points: int = 6


_POSE = _PoseOptions()


@dataclass(frozen=True, slots=True)
class TargetPose:
    """A target's pose and how well it fits."""

    dome_from_target: SE3  # The pose.
    # Root mean square distance of the inliers from their predicted pixels.
    rms_px: float
    # Shape (N,): mask of the view's points that were used.
    inliers: BoolArray
    # True if a second pose, a flat target leaning the other way, explains the view nearly as well.
    ambiguous: bool


def target_pose(
    camera: Camera, view: View, *, start: SE3 | None = None, max_rms_px: float = MAX_RMS_PX
) -> TargetPose:
    """Find the pose of a target, by default without an initial guess.

    Parameters
    ----------
    camera : Camera
        Looks into the medium of the picture.
    view : View
        At least four points that are not on one line; up to about a third may be wrong.
    start : SE3, optional
        A roughly known pose: no other is tried unless it fails.
    max_rms_px : float
        Largest residual of the inliers of a view of this target. Infinite accepts any pose.

    Raises
    ------
    CalibrationError
        If the view has too few points, points on one line, or no pose explains it.
    """
    rays = camera.rays(view.pixels)
    _check(view, rays)
    starts = closed_form_poses(view, rays) if start is None else iter([start])
    best, rival = _best_two(camera, view, starts)
    if best is None or _doubtful(best, max_rms_px):
        robust = _start_despite_outliers(camera, view, rays)
        if robust is not None:
            again, second = _best_two(camera, view, iter([robust]))
            if again is not None and (best is None or _better(again, best)):
                best, rival = again, second
    if best is None or _rms_px(best) > max_rms_px or _believed(best) < _POSE.min_points:
        fit = "" if best is None else f" (the best leaves {_rms_px(best):.1f} px)"
        raise CalibrationError(
            f"{view.name}: no pose of the target explains its {len(view)} points{fit}; check the "
            "target's file against the print, and the rig and medium against the picture"
        )
    rms = _rms_px(best)
    ambiguous = rival is not None and _rms_px(rival) < _POSE.rival * rms + 0.1 * CORNER_SIGMA_PX
    return TargetPose(best.state, rms, best.inliers[0], ambiguous)


@dataclass(frozen=True, slots=True)
class _PoseProblem:
    """One view of a target with a known camera."""

    camera: Camera
    view: View
    n_parameters: ClassVar[int] = 6

    def blocks(self, state: SE3) -> list[Block]:
        points = state.apply(self.view.points)
        pixels, _, by_point = self.camera.project_with_jacobian(points)
        middle = state.apply(self.view.middle)
        residuals = (pixels - self.view.pixels) / CORNER_SIGMA_PX
        by_pose = by_point @ point_by_pose(points, middle) / CORNER_SIGMA_PX
        return [Block(CORNERS, np.arange(6), residuals, by_pose)]

    def moved(self, state: SE3, step: FloatArray) -> SE3:
        return moved_target(state, self.view.middle, step)


def _check(view: View, rays: Rays) -> None:
    n = int(np.count_nonzero(rays.valid))
    if n < _POSE.min_points:
        raise CalibrationError(
            f"{view.name}: {n} points of the target can be used but a pose needs "
            f"{_POSE.min_points}; show more of the target"
        )
    extents = _extents(view.points[rays.valid])[0]
    if extents[1] < _POSE.line * extents[0]:
        raise CalibrationError(
            f"{view.name}: the {n} points found lie on one line; show more of the target"
        )


def _extents(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return extents (3,) along principal axes, those axes as a rotation's rows, the middle."""
    middle: FloatArray = points.mean(axis=0)
    _, extents, axes = np.linalg.svd(points - middle, full_matrices=False)
    axes[2] *= np.sign(np.linalg.det(axes))
    return np.pad(extents, (0, 3 - len(extents))), axes, middle


def _best_two(
    camera: Camera, view: View, starts: Iterator[SE3]
) -> tuple[Solution[SE3] | None, Solution[SE3] | None]:
    problem = _PoseProblem(camera, view)
    found: list[Solution[SE3]] = []
    for start in starts:
        try:
            solution = solve(problem, start)
        except (CalibrationError, np.linalg.LinAlgError):
            continue
        if not any(_same(solution.state, other.state) for other in found):
            found.append(solution)
    found.sort(key=lambda s: (-round(4.0 * _believed(s) / len(view)), s.scales[CORNERS]))
    return (found[0] if found else None), (found[1] if len(found) > 1 else None)


def _same(a: SE3, b: SE3) -> bool:
    return bool(np.linalg.norm(a.rotation - b.rotation) < 1e-4)


def _believed(solution: Solution[SE3]) -> int:
    return int(np.count_nonzero(solution.inliers[0]))


def _rms_px(solution: Solution[SE3]) -> float:
    residuals = solution.blocks[0].residuals[solution.inliers[0]] * CORNER_SIGMA_PX
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=1)))) if len(residuals) else np.inf


def _doubtful(solution: Solution[SE3], max_rms_px: float) -> bool:
    share = _believed(solution) / len(solution.inliers[0])
    return share < _POSE.few_inliers or _rms_px(solution) > min(max_rms_px, MAX_RMS_PX)


def _better(a: Solution[SE3], b: Solution[SE3]) -> bool:
    """Return whether `a` is the better pose, by the median residual of all points."""
    a_all, b_all = (np.linalg.norm(s.blocks[0].residuals, axis=1) for s in (a, b))
    return bool(np.median(np.nan_to_num(a_all, nan=np.inf)) < np.nanmedian(b_all))


@dataclass(frozen=True, slots=True)
class _Pinhole:
    """Pinhole camera that is nearest to the rays of a view."""

    dome_from_pinhole: SE3
    points: FloatArray
    normalised: FloatArray

    def pose(self, rotvec: FloatArray, translation: FloatArray) -> SE3:
        return self.dome_from_pinhole @ SE3.from_rotvec(rotvec.ravel(), translation.ravel())


def _pinhole(view: View, rays: Rays) -> _Pinhole:
    origins, directions = rays.origins[rays.valid], rays.directions[rays.valid]
    forward = directions.mean(axis=0)
    forward /= np.linalg.norm(forward)
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    # Rays of a narrow view nearly meet anywhere along them: a weak prior on the mean origin selects
    # one place.
    pull = 1e-6 * len(directions) * np.eye(3)
    right = np.einsum("nij,nj->i", across, origins) + pull @ origins.mean(axis=0)
    centre = np.linalg.solve(across.sum(axis=0) + pull, right)
    side = np.cross(forward, np.eye(3)[int(np.argmin(np.abs(forward)))])
    side /= np.linalg.norm(side)
    pose = SE3(np.stack([side, np.cross(forward, side), forward], axis=1), centre)
    in_pinhole = directions @ pose.rotation
    # Rays further than this from their mean (cosine) are not used in the initial guess.
    sideways = 0.15
    ahead = in_pinhole[:, 2] > sideways
    normalised = in_pinhole[ahead, :2] / in_pinhole[ahead, 2:]
    return _Pinhole(pose, view.points[rays.valid][ahead], np.ascontiguousarray(normalised))


def closed_form_poses(view: View, rays: Rays) -> Iterator[SE3]:
    """Yield the closed-form poses of a view whose pixels see these rays.

    All rays are taken to start at the one point nearest to them all.
    """
    pinhole = _pinhole(view, rays)
    extents, axes, middle = _extents(pinhole.points)
    if extents[2] < _POSE.nearly_flat * extents[0]:
        flat = (pinhole.points - middle) @ axes.T
        flat[:, 2] = 0.0
        target_from_flat = SE3(axes.T, middle)
        for pose in _closed_form(pinhole, flat, cv2.SOLVEPNP_IPPE):
            yield pose @ target_from_flat.inverse()
    if extents[2] > _POSE.flat * extents[0]:
        yield from _closed_form(pinhole, pinhole.points, cv2.SOLVEPNP_SQPNP)


def _closed_form(pinhole: _Pinhole, points: FloatArray, method: int) -> Iterator[SE3]:
    if len(points) < _POSE.min_points:
        return
    try:
        _, rotvecs, translations, errors = cv2.solvePnPGeneric(
            points, pinhole.normalised, np.eye(3), None, flags=method
        )
    except cv2.error:  # it asserts where points are degenerate
        return
    # Closed solutions this many times worse than the best are not worth refining.
    hopeless = 5.0
    for rotvec, translation, error in zip(rotvecs, translations, np.ravel(errors), strict=True):
        if error > hopeless * np.min(errors):
            continue
        if np.all(np.isfinite(rotvec)) and np.all(np.isfinite(translation)):
            yield pinhole.pose(rotvec, translation)


def _start_despite_outliers(camera: Camera, view: View, rays: Rays) -> SE3 | None:
    pinhole = _pinhole(view, rays)
    if len(pinhole.points) < _POSE.min_points + 1:
        return None
    try:
        found, rotvec, translation, _ = cv2.solvePnPRansac(
            pinhole.points,
            pinhole.normalised,
            np.eye(3),
            None,
            iterationsCount=300,
            reprojectionError=_POSE.start_error_px / max(camera.lens.fx, camera.lens.fy),
            confidence=0.999,
            flags=cv2.SOLVEPNP_SQPNP,
        )
    except cv2.error:
        return None
    return pinhole.pose(rotvec, translation) if found else None


@dataclass(frozen=True, slots=True)
class StartPose:
    """A first pose of a view."""

    dome_from_target: SE3
    median_px: float  # Median error of the points it was found from.


def start_pose(camera: Camera, view: View) -> StartPose | str:
    """Return a view's pose, even if the starting camera fits badly, or why there is none."""
    few = thinned(view)
    rays = camera.rays(few.pixels)
    if np.count_nonzero(rays.valid) >= _POSE.start_min_points:
        quick = [_judged(camera, few, pose) for pose in closed_form_poses(few, rays)]
        best = min(quick, key=lambda start: start.median_px, default=None)
        if best is not None and best.median_px < _POSE.near_px:
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


def thinned(view: View) -> View:
    """Return a view with a limited number of points, spread over the target."""
    n_points = _POSE.enough_points
    if len(view) <= n_points:
        return view
    keep = np.zeros(len(view), np.bool_)
    # A fixed stride would keep few columns if it divides the length of the rows.
    keep[np.random.default_rng(len(view)).permutation(len(view))[:n_points]] = True
    return view.where(keep)


def square_rotation(rotations: Sequence[FloatArray]) -> FloatArray:
    """Return the nearest `dome_from_board` rotation (3, 3) of boards square to the dome.

    Boards stand upright, on a side or upside down: x and y along the dome's x and -z axes, or a
    quarter turn about y further. The majority of the rotations decides.
    """
    quarter = 0.5 * np.pi
    choices = [
        rotation_from_rotvec([0.0, k * quarter, 0.0]) @ DOME_FROM_CAM_NOMINAL for k in range(4)
    ]
    nearness = [np.median([np.trace(r @ choice.T) for r in rotations]) for choice in choices]
    return choices[int(np.argmax(nearness))]


def turned_square(
    rig: Rig, poses: Sequence[SE3], square: FloatArray, boards: Sequence[int], sigma: float
) -> tuple[Rig, list[SE3]]:
    """Turn camera and boards together about the dome's centre until most boards stand square.

    The pictures do not determine this turn: through a sphere it changes nothing. The turn chosen
    makes one of the boards exactly square and leaves the smallest robust tilt of the others.

    Parameters
    ----------
    square : array, shape (3, 3)
        Rotation of a square board.
    boards : sequence of int
        Indices of boards most of which are known to be square.
    sigma : float
        Standard deviation of their tilt, in radians.
    """
    tilts = np.array([rotvec_from_rotation(poses[i].rotation @ square.T) for i in boards])
    apart = np.sum((tilts[:, None] - tilts[None]) ** 2, axis=-1)
    best = int(np.argmin(np.sum(np.log1p(apart / sigma**2), axis=1)))
    turn = SE3(rotation_from_rotvec(-tilts[best]), np.zeros(3))
    return replace(rig, dome_from_cam=turn @ rig.dome_from_cam), [turn @ pose for pose in poses]
