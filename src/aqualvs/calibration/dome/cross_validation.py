"""Cross-validation of the dome: its prediction of unused corners against that of a bare lens."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from aqualvs.calibration.dome.problem import LENS, ROTATION, DomeProblem
from aqualvs.calibration.solver.bundle import Bundle, BundleState, TargetView
from aqualvs.calibration.solver.initial_pose import start_pose, target_pose
from aqualvs.calibration.solver.least_squares import Solution, solve
from aqualvs.calibration.solver.result import CrossValidation, rms_px
from aqualvs.calibration.targets.targets import View
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.camera import Camera

# Number of folds, and least number of views; with fewer all are needed for the solve.
_PARTS, _MIN_VIEWS = 4, 8
# Half a view must still determine a pose.
_MIN_POINTS = 12


def compare_with_bare_lens(
    problem: DomeProblem, solution: Solution[BundleState]
) -> CrossValidation | None:
    """Solve both models from three views in four and predict the fourth; four times.

    The pose of a view held out is found from half of its corners; the other half is predicted.
    Outliers of the whole solve and corners that either model cannot see are left out for both.

    Returns
    -------
    CrossValidation or None
        None if there are too few views.
    """
    n = len(problem.shots)
    believed = [
        shot.view.where(inliers)
        for shot, inliers in zip(problem.shots, solution.inliers[:n], strict=True)
    ]
    usable = [i for i in range(n) if len(believed[i]) >= _MIN_POINTS]
    if len(usable) < _MIN_VIEWS:
        return None
    pairs: list[tuple[FloatArray, FloatArray]] = []
    for part in range(_PARTS):
        held_out = usable[part::_PARTS]
        rest = [i for i in range(n) if i not in held_out]
        media = [problem.shots[i].i_set for i in held_out]
        views = [believed[i] for i in held_out]
        try:
            with_dome = predicted(_dome_state(problem, solution, rest), media, views)
            bare = predicted(_bare_state(problem, solution, rest), media, views)
        except CalibrationError:
            return None
        pairs += zip(with_dome, bare, strict=True)
    return _compared(pairs)


def _compared(pairs: Sequence[tuple[FloatArray, FloatArray]]) -> CrossValidation | None:
    """Compare residuals (N, 2) of the same corners, view by view."""
    rows = []
    for dome, bare in pairs:
        both = np.isfinite(dome).all(axis=1) & np.isfinite(bare).all(axis=1)
        if both.any():
            rows.append((rms_px(dome[both]), rms_px(bare[both]), np.count_nonzero(both)))
    if not rows:
        return None
    dome_px, bare_px, counts = np.array(rows).T
    return CrossValidation(dome_px, bare_px, counts.astype(np.int64))


def _dome_state(
    problem: DomeProblem, solution: Solution[BundleState], rest: Sequence[int]
) -> BundleState:
    part = problem.only(rest)
    poses = tuple(solution.state.poses[i] for i in rest)
    return solve(part.bundle, replace(solution.state, poses=poses)).state


def _bare_state(
    problem: DomeProblem, solution: Solution[BundleState], rest: Sequence[int]
) -> BundleState:
    """Solve a bare lens with free pose from the same pictures."""
    bundle = problem.bundle
    rig = replace(solution.state.rig, housing=None)
    views = [_bare_view(rig.camera(), bundle.views[i], solution.state, i) for i in rest]
    intrinsics = tuple(name for name in bundle.free if name in rig.lens.parameter_names)
    # With unknown poses the place is arbitrary.
    free = (LENS + ROTATION if problem.rotation_is_solved else ()) + intrinsics
    start_rig = replace(bundle.start.rig, housing=None)
    start = BundleState(start_rig, solution.state.media, tuple(v.dome_from_target for v in views))
    bare = Bundle(
        tuple(views),
        free,
        start,
        bundle.priors.only(intrinsics),
        np.zeros(len(bundle.media_sigma)),
    )
    return solve(bare, replace(start, rig=rig)).state


def _bare_view(camera: Camera, target: TargetView, state: BundleState, i: int) -> TargetView:
    if target.fixed:
        return target
    found = start_pose(camera, target.view)
    pose = state.poses[i] if isinstance(found, str) else found.dome_from_target
    return replace(target, dome_from_target=pose)


def predicted(state: BundleState, media: Sequence[int], views: Sequence[View]) -> list[FloatArray]:
    """Return residuals (N, 2) of each view's odd corners, from poses found with the even ones.

    NaN for corners that the model cannot see.
    """
    errors = []
    for medium, view in zip(media, views, strict=True):
        camera = state.camera(medium)
        even = np.arange(len(view)) % 2 == 0
        pose = target_pose(camera, view.where(even), max_rms_px=float("inf")).dome_from_target
        odd = view.where(~even)
        pixels, _ = camera.project(pose.apply(odd.points))
        errors.append(odd.pixels - pixels)
    return errors
