"""Refusals of `calibrate dome`: no rig is better than a wrong one."""

from collections.abc import Sequence

import numpy as np

from aqualvs.calibration.board_sets import BoardSet, PoseKind
from aqualvs.calibration.bundle import BundleState
from aqualvs.calibration.degenerate import (
    all_alike,
    length_ratio,
    scale_fault,
    unbelievable_distance,
)
from aqualvs.calibration.distance_check import distance_blocks
from aqualvs.calibration.dome_problem import LENS, DomeProblem
from aqualvs.calibration.least_squares import Solution, solve
from aqualvs.calibration.medium_check import (
    MAX_NOISE_PX,
    in_other_medium,
    noise_px,
    other_medium,
    wrong_medium,
)
from aqualvs.calibration.pose_terms import plane_distance
from aqualvs.calibration.start import start_pose
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.uncertainty import RigUncertainty

# A lens this near the inner surface (in radii) was stopped by it.
_AT_THE_WALL = 0.995
# A lens known worse than this (metres) costs 0.4 % of range.
_MAX_LENS_SIGMA = 2e-3
# Differences of scale that the sizes of boards and rails do not have by chance.
_FINE_SCALE, _EXACT_SCALE = 0.003, 0.02
# Before the solve a wrong medium or lens position may look like a wrong scale.
_COARSE_SCALE = 0.5
# Ratios of lengths that scatter less than this tell one wrong scale.
_SAME_RATIO = 0.05
# Distance from the image's centre, in its sizes, beyond which no start puts what can be seen.
_SURELY_SEEN = 2.0
# Typical residual of distances, in sigmas, that have nothing against a solution.
_FITTING_DISTANCE = 1.5
_POSE_RULES = (
    "poses must be dome_from_board in millimetres, with OpenCV's board axes (x right, y down, z "
    "into the board) and dome axes x right, y forward, z up"
)


def check_start(problem: DomeProblem) -> None:
    """Refuse boards at distances that cannot be, or that given distances contradict grossly.

    Raises
    ------
    CalibrationError
        With the likely mistake.
    """
    _check_seen(problem)
    views = problem.bundle.views
    away = [float(np.linalg.norm(v.dome_from_target.apply(v.view.middle))) for v in views]
    _refuse_if(unbelievable_distance(np.array(away), [shot.label for shot in problem.shots]))
    exact = any(view.fixed for view in views)
    if not exact and all_alike(
        np.array([view.dome_from_target.rotation[:, 2] for view in views]), np.array(away)
    ):
        raise CalibrationError(
            "all boards are parallel and at one distance, so that nothing checks the lens "
            "position; tilt the board by 20 to 40 degrees, and show it from as near as possible to "
            "the end of the working range"
        )
    boards = [i for i, shot in enumerate(problem.shots) if shot.kind is PoseKind.DISTANCE]
    if boards:
        given = np.array([problem.given_distance(i) for i in boards])
        found = np.array([plane_distance(views[i].dome_from_target) for i in boards])
        _refuse_if(_sign_fault(given))
        _refuse_if(scale_fault(length_ratio(given, found), _COARSE_SCALE))


def _check_seen(problem: DomeProblem) -> None:
    """Refuse exact poses at which the camera cannot see the board at all."""
    bundle = problem.bundle
    fixed = [i for i, view in enumerate(bundle.views) if view.fixed]
    unseen = []
    for i in fixed:
        view = bundle.views[i]
        camera = bundle.start.camera(view.medium)
        pixels, _ = camera.project(view.dome_from_target.apply(view.view.points))
        # Far outside the picture is as good as not to be seen; NaN compares false.
        off_centre = np.abs(pixels / camera.size_px - 0.5).max(axis=1)
        if np.mean(off_centre < _SURELY_SEEN) < 0.5:
            unseen.append(i)
    if len(unseen) > 0.5 * len(fixed):
        raise CalibrationError(
            f"{problem.shots[unseen[0]].label}: the camera cannot see a board at the given pose; "
            f"{_POSE_RULES}"
        )


def contradicted_distances(
    problem: DomeProblem, solution: Solution[BundleState], sets: Sequence[BoardSet]
) -> CalibrationError:
    """Return what to say of given distances most of which the pictures contradict."""
    for medium, one in enumerate(sets):
        rival = in_other_medium(problem, medium)
        if rival is not None and _distances_fit(problem, rival):
            return wrong_medium(one, other_medium(one.n_medium))
    return _wrong_lengths(problem, solution)


def _distances_fit(problem: DomeProblem, solution: Solution[BundleState]) -> bool:
    off = [block.lengths[0] for block in distance_blocks(problem, solution).values()]
    return bool(np.median(off) < _FITTING_DISTANCE)


def _wrong_lengths(problem: DomeProblem, solution: Solution[BundleState]) -> CalibrationError:
    boards = [i for i, shot in enumerate(problem.shots) if shot.kind is PoseKind.DISTANCE]
    free = problem.without_distances(boards)
    try:
        state = solve(free.bundle, solution.state).state
    except CalibrationError:
        state = solution.state
    given = np.array([problem.given_distance(i) for i in boards])
    found = np.array([plane_distance(state.poses[i]) for i in boards])
    fault = scale_fault(length_ratio(given, found), _FINE_SCALE)
    if fault is not None:
        return CalibrationError(fault)
    offset = 1e3 * float(np.median(found - given))
    return CalibrationError(
        f"the given distances contradict the pictures, typically by {offset:+.1f} mm (found minus "
        "given); they count from the dome's centre along its y axis to the board's plane: measure "
        "them again, or say that they are known less well"
    )


def check_solution(
    problem: DomeProblem, solution: Solution[BundleState], uncertainty: RigUncertainty
) -> None:
    """Refuse a solution that does not explain the pictures, or that they do not determine.

    Parameters
    ----------
    problem : DomeProblem
    solution : Solution
        Of it.
    uncertainty : RigUncertainty
        Of what was solved, with that of numbers that were held passed on.

    Raises
    ------
    CalibrationError
        With the likely cause and the remedy.
    """
    noise = noise_px(solution)
    if noise > MAX_NOISE_PX:
        _refuse_if(_exact_pose_fault(problem, solution))
        raise CalibrationError(
            f"no lens position explains the pictures: corners are {noise:.2g} px off (0.1 px is "
            "usual); check the board's file against the print, the camera's calibration, the "
            "dome's sizes and the medium"
        )
    if not solution.converged:
        raise CalibrationError(
            "the solve does not come to rest; add views at other distances and tilts, and check "
            "the rig's dome"
        )
    _check_lens(problem, solution, uncertainty)


def _check_lens(
    problem: DomeProblem, solution: Solution[BundleState], uncertainty: RigUncertainty
) -> None:
    rig = solution.state.rig
    lens = rig.dome_from_cam.translation
    if rig.dome is not None and np.linalg.norm(lens) > _AT_THE_WALL * rig.dome.inner_radius:
        raise CalibrationError(
            f"the lens ends at the dome's wall, at {np.round(1e3 * lens, 1).tolist()} mm; check "
            "the dome's inner radius, the board's square_mm, the given distances and the medium"
        )
    values, vectors = np.linalg.eigh(uncertainty.of(LENS))
    sigma, axis = float(np.sqrt(values[-1])), vectors[:, -1] * np.sign(vectors[:, -1].sum())
    if sigma > _MAX_LENS_SIGMA:
        raise CalibrationError(
            f"the pictures do not tell where the lens is: {1e3 * sigma:.1f} mm uncertain along "
            f"{np.round(axis, 1).tolist()}; {_remedy(problem)}"
        )


def _remedy(problem: DomeProblem) -> str:
    if all(shot.kind is PoseKind.UNKNOWN for shot in problem.shots):
        return (
            "give the boards' distances, show the board nearer and in more views, or take the "
            "pictures in water, where refraction is five times stronger"
        )
    return "show more views, nearer, and with corners all over the picture"


def _exact_pose_fault(problem: DomeProblem, solution: Solution[BundleState]) -> str | None:
    """Return what is wrong with poses given as exact, compared with what each picture says."""
    given, found = [], []
    for i, shot in enumerate(problem.shots):
        if shot.kind is not PoseKind.EXACT:
            continue
        pose = start_pose(solution.state.camera(shot.i_set), shot.view)
        if not isinstance(pose, str):
            middle = shot.view.middle
            given.append(float(np.linalg.norm(solution.state.poses[i].apply(middle))))
            found.append(float(np.linalg.norm(pose.dome_from_target.apply(middle))))
    if not given:
        return None
    ratios = np.array(found) / np.array(given)
    ratio = float(np.median(ratios))
    one_scale = float(np.median(np.abs(ratios / ratio - 1.0))) < _SAME_RATIO
    fault = scale_fault(ratio, _EXACT_SCALE) if one_scale else None
    return fault or f"the given poses contradict the pictures; {_POSE_RULES}"


def _sign_fault(given: FloatArray) -> str | None:
    if np.all(given > 0.0):
        return None
    return (
        f"a board at the distance {1e3 * float(given.min()):g} mm; distances count forward from "
        "the dome's centre and are positive"
    )


def _refuse_if(fault: str | None) -> None:
    if fault is not None:
        raise CalibrationError(fault)
