"""`calibrate dome`: where the lens sits in the dome, and how the camera is turned (paper, 2.2).

Boards seen through the dome at poses that are known, of which only the distance is known (the
paper's rail), or of which nothing is known; in air, in water, or both in one solve. Tolerances of
the dome and the covariance of the intrinsics are priors, so that what pictures cannot tell keeps
the uncertainty it had.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from aqualvs.calibration.board_sets import BoardSet, DomeOptions, check_sets
from aqualvs.calibration.bundle import CORNER_SIGMA_PX, BundleState
from aqualvs.calibration.consider import considered
from aqualvs.calibration.distance_check import (
    check_shared_errors,
    distance_blocks,
    solved_by_offset,
)
from aqualvs.calibration.dome_checks import (
    check_solution,
    check_start,
    contradicted_distances,
)
from aqualvs.calibration.dome_problem import DomeProblem, dome_problem, start_rigs
from aqualvs.calibration.dome_result import DomeCalibration, SolvedMedium, ViewFit, view_fit
from aqualvs.calibration.dome_words import findings
from aqualvs.calibration.held_back import compare_with_bare_lens
from aqualvs.calibration.lean_scale import with_leaning_as_found
from aqualvs.calibration.least_squares import Solution, solve
from aqualvs.calibration.medium_check import check_media, noise_px
from aqualvs.errors import CalibrationError, RigError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.rig import Rig
from aqualvs.optics.solved import rig_uncertainty
from aqualvs.optics.uncertainty import RigUncertainty

# A solve that leaves less than this has found the place; one that leaves more may be elsewhere.
_GOOD_NOISE_PX = 0.5
# A view is bad if it is this many times noisier than the typical one, and noisier than this.
_BAD_VIEW, _BAD_NOISE_PX = 5.0, 0.5
_BAD_SHARE = 1.0 / 3.0
# A given distance this many sigmas off is a mistake.
_WRONG_DISTANCE = 5.0


def dome(
    rig: Rig,
    sets: Sequence[BoardSet],
    options: DomeOptions | None = None,
    known: RigUncertainty | None = None,
) -> DomeCalibration:
    """Solve lens position, camera rotation and all that goes with them.

    Parameters
    ----------
    rig : Rig
        Intrinsics from `calibrate camera`, the dome's nominal sizes, and any lens position inside
        it. Without known poses its rotation is kept.
    sets : sequence of BoardSet
        One for each medium.
    options : DomeOptions, optional
    known : RigUncertainty, optional
        Of the intrinsics (and of the rotation, where no pose is known); by default what the rig
        itself has written down. Intrinsics without any are taken as exact.

    Returns
    -------
    DomeCalibration

    Raises
    ------
    CalibrationError
        If the views do not determine the lens, or contradict the board's file, the given poses,
        the medium or the dome.
    """
    check_sets(rig, sets)
    options = options or DomeOptions()
    known = rig_uncertainty(rig) if known is None else known
    problem, solution = _solved(rig, sets, known, options)
    problem, solution = _without_bad_views(problem, solution)
    problem, solution = _without_wrong_distances(problem, solution, sets)
    problem, solution = with_leaning_as_found(problem, solution, options.tilt_sigma)
    names, covariance = considered(problem.bundle, solution, problem.held)
    n_solved = len(solution.covariance)
    doubts = check_shared_errors(problem, solution, covariance[:n_solved, :n_solved])
    doubts += check_media(problem, solution, sets)
    covariance[:n_solved, :n_solved] += _of_rail(problem, solution, options)
    result = _result(problem, solution, sets, names, covariance)
    check_solution(problem, solution, result.uncertainty)
    if options.check_held_back:
        result = replace(result, held_back=compare_with_bare_lens(problem, solution))
    words = findings(problem, solution, result)
    return replace(result, findings=(*doubts, *words))


def _solved(
    rig: Rig, sets: Sequence[BoardSet], known: RigUncertainty, options: DomeOptions
) -> tuple[DomeProblem, Solution[BundleState]]:
    """Solve from where the rig puts the lens, or else from the dome's centre."""
    best: tuple[DomeProblem, Solution[BundleState]] | None = None
    trouble: list[CalibrationError | RigError] = []
    for start in start_rigs(rig):
        try:
            problem = dome_problem(start, sets, known, options)
        except CalibrationError as error:
            trouble.append(error)
            continue
        check_start(problem)
        try:
            solution = solve(problem.bundle, problem.bundle.start)
        except (CalibrationError, RigError) as error:
            trouble.append(error)
            continue
        if best is None or noise_px(solution) < noise_px(best[1]):
            best = problem, solution
        if solution.converged and noise_px(solution) < _GOOD_NOISE_PX:
            break
    if best is None:
        raise trouble[0]
    return best


def _without_bad_views(
    problem: DomeProblem, solution: Solution[BundleState]
) -> tuple[DomeProblem, Solution[BundleState]]:
    """Leave out views that fit far worse than the others, and solve again."""
    n = len(problem.shots)
    noise = CORNER_SIGMA_PX * np.array(solution.block_scales[:n])
    typical = noise_px(solution)
    bad = {}
    for i in np.flatnonzero((noise > _BAD_VIEW * typical) & (noise > _BAD_NOISE_PX)):
        bad[int(i)] = (
            f"its corners are {noise[i]:.2g} px off, those of other views {typical:.2g} px; wrong "
            "pose, bent board or blurred picture?"
        )
    if not bad or len(bad) > _BAD_SHARE * n:
        return problem, solution
    return _again(problem.without(bad), solution, [i for i in range(n) if i not in bad])


def _without_wrong_distances(
    problem: DomeProblem, solution: Solution[BundleState], sets: Sequence[BoardSet]
) -> tuple[DomeProblem, Solution[BundleState]]:
    """Forget given distances that the pictures contradict, if they are few."""
    wrong = _wrong_distances(problem, solution)
    if wrong and problem.held.names:
        # Numbers that were held bend all distances; they must not be blamed for it.
        free = problem.with_held_free()
        wrong = _wrong_distances(free, solve(free.bundle, solution.state))
    if not wrong:
        return problem, solution
    if len(wrong) > _BAD_SHARE * len(problem.measured_views):
        raise contradicted_distances(problem, solution, sets)
    reasons = {
        f"distance of {problem.shots[i].label}": (
            f"{1e3 * problem.given_distance(i):.2f} mm contradicts the pictures"
        )
        for i in wrong
    }
    forgotten = problem.without_distances(wrong)
    forgotten = replace(forgotten, left_out={**problem.left_out, **reasons})
    return _again(forgotten, solution, list(range(len(problem.shots))))


def _wrong_distances(problem: DomeProblem, solution: Solution[BundleState]) -> list[int]:
    off = distance_blocks(problem, solution)
    return [i for i, block in off.items() if block.lengths[0] > _WRONG_DISTANCE]


def _again(
    problem: DomeProblem, solution: Solution[BundleState], kept: Sequence[int]
) -> tuple[DomeProblem, Solution[BundleState]]:
    state = solution.state
    start = replace(state, poses=tuple(state.poses[i] for i in kept))
    return problem, solve(problem.bundle, start)


def _of_rail(
    problem: DomeProblem, solution: Solution[BundleState], options: DomeOptions
) -> FloatArray:
    """Return the covariance that an error shared by all given distances adds."""
    by_offset = options.distance_offset_sigma * solved_by_offset(problem, solution)
    return np.outer(by_offset, by_offset)


def _result(
    problem: DomeProblem,
    solution: Solution[BundleState],
    sets: Sequence[BoardSet],
    names: tuple[str, ...],
    covariance: FloatArray,
) -> DomeCalibration:
    bundle, state = problem.bundle, solution.state
    n_free, n_held = len(bundle.free), len(problem.held.names)
    columns = [*range(n_free), *range(len(covariance) - n_held, len(covariance))]
    rig = state.rig.in_water(bundle.start.rig.n_water)
    if len(bundle.free_media) == 1:
        # The one medium that was solved for is the water that the rig will be used in.
        rig = rig.in_water(float(state.media[bundle.free_media[0]]))
        names, columns = (*names, "n_water"), [*columns, n_free]
    return DomeCalibration(
        rig=rig,
        uncertainty=RigUncertainty(names, covariance[np.ix_(columns, columns)]),
        media=_media(problem, solution, sets, covariance),
        views=_view_fits(problem, solution, covariance),
        left_out=problem.left_out,
        noise_px=noise_px(solution),
        rotation_is_solved=problem.rotation_is_solved,
        held_back=None,
        findings=(),
        n_iterations=solution.n_iterations,
    )


def _media(
    problem: DomeProblem,
    solution: Solution[BundleState],
    sets: Sequence[BoardSet],
    covariance: FloatArray,
) -> tuple[SolvedMedium, ...]:
    media = []
    for i, one in enumerate(sets):
        column = problem.bundle.medium_columns(i)
        sigma = float(np.sqrt(covariance[column[0], column[0]])) if len(column) else 0.0
        media.append(SolvedMedium(one.name, float(solution.state.media[i]), sigma))
    return tuple(media)


def _view_fits(
    problem: DomeProblem, solution: Solution[BundleState], covariance: FloatArray
) -> tuple[ViewFit, ...]:
    fits = []
    for i, shot in enumerate(problem.shots):
        columns = problem.bundle.pose_columns(i)
        fits.append(
            view_fit(
                shot.label,
                shot.view,
                solution.state.poses[i],
                covariance[np.ix_(columns, columns)],
                solution.blocks[i],
                solution.inliers[i],
                solution.block_scales[i],
            )
        )
    return tuple(fits)
