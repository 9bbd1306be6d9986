"""Calibration of the dome: position of the lens in it and rotation of the camera (paper, 2.2).

Boards are seen through the dome at poses that are known, known by their distance only (the paper's
rail), or unknown; in air, in water, or both in one solve. Tolerances of the dome and the covariance
of the intrinsics are priors, so that a number that the pictures do not determine keeps the
uncertainty it had. `findings` says in plain words what the pictures determined. Of a flat port the
same solve finds its distance from the lens and its tilt.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from aqualvs.calibration.dome.checks import (
    check_initial_guess,
    check_media,
    check_shared_errors,
    check_solution,
    contradicted_distances,
    distance_blocks,
    noise_px,
    solved_by_offset,
    solved_by_shared_tilt,
)
from aqualvs.calibration.dome.problem import (
    LENS,
    ROTATION,
    BoardSet,
    DomeOptions,
    DomeProblem,
    check_sets,
    compare_with_bare_lens,
    dome_problem,
    place_names,
    with_board_tilt_as_found,
)
from aqualvs.calibration.solver.bundle import CORNER_SIGMA_PX, BundleState, rig_difference
from aqualvs.calibration.solver.covariance import Observability, consider_covariance, observability
from aqualvs.calibration.solver.least_squares import Solution, solve
from aqualvs.calibration.solver.result import (
    CrossValidation,
    DomeCalibration,
    SolvedMedium,
    view_fits,
)
from aqualvs.errors import CalibrationError, RigError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.rig import Rig, RigUncertainty
from aqualvs.optics.solved import rig_numbers, rig_uncertainty

_SIZES = ("inner_radius", "thickness", "n_acrylic", "n_port")
_WORDS = {
    **{f"lens_{axis}": f"lens {axis}" for axis in "xyz"},
    **{f"rotation_{axis}": f"rotation about {axis}" for axis in "xyz"},
    **{f"port_tilt_{axis}": f"tilt of the port about {axis}" for axis in "xy"},
    "inner_radius": "inner radius",
    "thickness": "thickness",
    "n_acrylic": "acrylic index",
    "n_port": "index of the port",
    "port_distance": "distance of the port",
}


def findings(
    problem: DomeProblem,
    solution: Solution[BundleState],
    result: DomeCalibration,
    shared_tilt_sigma: float,
) -> list[str]:
    """Return one sentence for each finding."""
    bundle, uncertainty = problem.bundle, result.uncertainty
    housing = result.rig.housing
    names = () if housing is None else tuple(n for n in _SIZES if n in housing.numbers())
    seen = observability(bundle, solution, uncertainty, names)
    place = _lens(result) if result.rig.flat_port is None else _port(result)
    rotation = _rotation(problem, result, shared_tilt_sigma)
    lines = [place, rotation, *_dome(names, result, seen), *_unobservable(seen)]
    lens = observability(bundle, solution, uncertainty, result.rig.lens.parameter_names)
    what = "dome" if result.rig.flat_port is None else "port"
    lines += [
        *_intrinsics(problem, result, lens),
        *_entangled(result),
        *(
            f"{medium.name}: n = {medium.n:.5f} ± {medium.sigma:.5f}"
            for i, medium in enumerate(result.media)
            if i in bundle.free_media
        ),
        *_against_priors(problem, solution),
        *_cross_validation(result.cross_validation, what),
        *(f"left out, {label}: {why}" for label, why in result.left_out.items()),
    ]
    return lines


def _lens(result: DomeCalibration) -> str:
    sigmas = result.uncertainty.sigmas
    position = 1e3 * result.rig.dome_from_cam.translation
    coordinates = ", ".join(
        f"{axis} {value:.3f} ± {1e3 * sigmas[name]:.4f}"
        for axis, value, name in zip("xyz", position, LENS, strict=True)
    )
    return f"lens position: {coordinates} mm"


def _port(result: DomeCalibration) -> str:
    sigmas, numbers = result.uncertainty.sigmas, rig_numbers(result.rig)
    x, y = (
        f"{math.degrees(numbers[name]):.3f} ± {math.degrees(sigmas[name]):.4f}"
        for name in ("port_tilt_x", "port_tilt_y")
    )
    return (
        f"flat port: {1e3 * numbers['port_distance']:.3f} ± {1e3 * sigmas['port_distance']:.4f} mm "
        f"from the lens, tilted by {x} deg about the camera's x axis and {y} deg about y"
    )


def _rotation(problem: DomeProblem, result: DomeCalibration, shared_tilt_sigma: float) -> str:
    if not result.rotation_is_solved:
        taken = "camera rotation: taken from the rig; boards at unknown poses do not determine it"
        place = ", and the lens position is given in axes turned by it"
        return taken + (place if result.rig.flat_port is None else "")
    sigma = np.rad2deg([result.uncertainty.sigmas[name] for name in ROTATION])
    sigmas = ", ".join(f"{axis} {value:.4f}" for axis, value in zip("xyz", sigma, strict=True))
    found = f"uncertain by {sigmas} deg about the dome's axes"
    if not problem.axes_are_of_boards:
        return f"camera rotation: from boards at known poses; {found}"
    shared = (
        f"of which a tilt that all these boards share is {np.rad2deg(shared_tilt_sigma):.2g} deg"
        if shared_tilt_sigma > 0.0
        else "and by a tilt that all these boards share (--shared-tilt-sigma-deg)"
    )
    return f"camera rotation: from most boards standing square to the dome; {found}, {shared}"


def _dome(names: Sequence[str], result: DomeCalibration, seen: Observability) -> list[str]:
    # By the least ratio of sigma to the prior's sigma: 1 if nothing was learnt.
    verdicts = {
        0.9: "not determined by the pictures, taken as given",
        0.5: "hardly determined by the pictures, mostly taken as given",
        -np.inf: "determined by the pictures",
    }
    groups: dict[str, list[str]] = {verdict: [] for verdict in verdicts.values()}
    for name in names:
        if name in seen.shrinkage:
            verdict = next(v for least, v in verdicts.items() if not seen.shrinkage[name] <= least)
            sigma = result.uncertainty.sigmas[name]
            size = f"{sigma:.4f}" if name.startswith("n_") else f"{1e3 * sigma:.3f} mm"
            groups[verdict].append(f"{_WORDS[name]} (± {size})")
    lines = [f"{', '.join(group)}: {verdict}" for verdict, group in groups.items() if group]
    exact = [_WORDS[name] for name in names if name not in seen.shrinkage]
    if exact:
        lines.append(f"{', '.join(exact)}: taken as exact")
    return lines


def _intrinsics(problem: DomeProblem, result: DomeCalibration, seen: Observability) -> list[str]:
    names = result.rig.lens.parameter_names
    refined = [name for name in names if name in seen.shrinkage]
    if refined:
        share = np.median([seen.shrinkage[name] for name in refined])
        focal = result.uncertainty.sigmas["fx"] if "fx" in refined else float("nan")
        return [
            f"intrinsics: refined within the uncertainty of the camera's calibration, to "
            f"{100.0 * share:.0f} % of it; that of fx is now {focal:.2f} px"
        ]
    if problem.considered.names:
        return ["intrinsics: held fixed; their uncertainty is propagated to the result"]
    return [
        "intrinsics: taken as exact, because the rig file does not state their uncertainty; "
        "calibrate the camera with this version to add it"
    ]


def _unobservable(seen: Observability) -> list[str]:
    """Name the combinations that the pictures do not determine."""
    unobservable = seen.unobservable()
    if not unobservable:
        return []
    names = "; ".join(" with ".join(_WORDS.get(n, n) for n in d.main) for d in unobservable)
    return [
        f"the pictures determine {len(seen.directions) - len(unobservable)} of the "
        f"{len(seen.directions)} combinations of the housing's parameters; not determined: {names}"
    ]


def _entangled(result: DomeCalibration) -> list[str]:
    """Name the pair of numbers with the strongest correlation, if the data hardly separate them."""
    correlated = 0.95
    uncertainty = result.uncertainty
    sigma = np.sqrt(np.diag(uncertainty.covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = uncertainty.covariance / np.outer(sigma, sigma)
    worst, pair, place = correlated, None, place_names(result.rig)
    for (i, name), (j, other) in itertools.product(enumerate(uncertainty.names), repeat=2):
        if name in place and other not in place and abs(correlation[i, j]) > worst:
            worst, pair = abs(float(correlation[i, j])), (name, other)
    if pair is None:
        return []
    one, other = (_WORDS.get(name, name) for name in pair)
    return [
        f"{one} and {other}: only their combination is known (correlation {worst:.3f}); an error "
        "of one compensates that of the other"
    ]


def _against_priors(problem: DomeProblem, solution: Solution[BundleState]) -> list[str]:
    """Name the numbers that moved further than their priors allow."""
    far_from_prior = 3.5
    bundle = problem.bundle
    names = [name for name in bundle.free if name in bundle.priors.names]
    moved = rig_difference(bundle.start.rig, solution.state.rig, names)
    sigmas = bundle.priors.sigmas
    return [
        f"{_WORDS.get(name, name)}: moved by {off:.1f} sigma from its given value; check that value"
        for name, off in zip(names, np.abs(moved / [sigmas[n] for n in names]), strict=True)
        if off > far_from_prior
    ]


def _cross_validation(found: CrossValidation | None, what: str) -> list[str]:
    if found is None:
        return []
    text = (
        f"{found.n_points} corners of {found.n_views} views, each held out once, are predicted to "
        f"{found.dome_rms_px:.3f} px with the {what}, to {found.bare_rms_px:.3f} px with a bare "
        f"lens; the {what} is better in {found.n_dome_better} of the views"
    )
    if found.dome_is_better:
        return [f"{text}: the {what} model is needed"]
    if found.n_dome_better > found.n_views // 2:
        return [f"{text}, but by too little: they do not show that there is a {what}"]
    return [f"{text}: the pictures do not show that there is a {what}"]


class _BadViews(NamedTuple):
    """Views that are left out, and how many may be."""

    # A view is bad if it is this many times noisier than the typical one, and noisier than this.
    times_typical: float = 5.0
    noise_px: float = 0.5
    max_share: float = 1.0 / 3.0


_BAD = _BadViews()


def dome(
    rig: Rig,
    sets: Sequence[BoardSet],
    options: DomeOptions | None = None,
    known: RigUncertainty | None = None,
) -> DomeCalibration:
    """Solve lens position, camera rotation and the other free numbers.

    Parameters
    ----------
    rig : Rig
        Intrinsics from `calibrate camera`, the housing's nominal sizes, and any lens position
        inside a dome. Without known poses its rotation is kept.
    sets : sequence of BoardSet
        One for each medium.
    known : RigUncertainty, optional
        Of the intrinsics (and of the rotation, if no pose is known); by default the rig's own.
        Intrinsics without an uncertainty are taken as exact.

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
    problem, solution = with_board_tilt_as_found(problem, solution, options.tilt_sigma)
    names, covariance = consider_covariance(problem.bundle, solution, problem.considered)
    n_solved = len(solution.covariance)
    doubts = check_shared_errors(problem, solution, covariance[:n_solved, :n_solved])
    doubts += check_media(problem, solution, sets)
    # All given distances share an error, and so do the tilts of boards at known distances.
    by_offset = options.distance_offset_sigma * solved_by_offset(problem, solution)
    by_tilt = options.shared_tilt_sigma * solved_by_shared_tilt(problem, solution)
    covariance[:n_solved, :n_solved] += np.outer(by_offset, by_offset) + by_tilt @ by_tilt.T
    result = _result(problem, solution, sets, names, covariance)
    check_solution(problem, solution, result.uncertainty)
    if options.check_cross_validation:
        result = replace(result, cross_validation=compare_with_bare_lens(problem, solution))
    words = findings(problem, solution, result, options.shared_tilt_sigma)
    return replace(result, findings=(*doubts, *words))


def _solved(
    rig: Rig, sets: Sequence[BoardSet], known: RigUncertainty, options: DomeOptions
) -> tuple[DomeProblem, Solution[BundleState]]:
    """Solve from the rig's lens position, or else from the dome's centre."""
    best: tuple[DomeProblem, Solution[BundleState]] | None = None
    trouble: list[CalibrationError | RigError] = []
    # A solve with smaller residuals has found the minimum; one with larger ones may be in another.
    good_noise_px = 0.5
    starts = [rig]
    if rig.flat_port is None:
        # A lens position far to the wrong side may leave no pose of a board to start from; from the
        # centre solves converge.
        starts.append(replace(rig, dome_from_cam=SE3(rig.dome_from_cam.rotation, np.zeros(3))))
    for start in starts:
        try:
            problem = dome_problem(start, sets, known, options)
        except CalibrationError as error:
            trouble.append(error)
            continue
        check_initial_guess(problem)
        try:
            solution = solve(problem.bundle, problem.bundle.start)
        except (CalibrationError, RigError) as error:
            trouble.append(error)
            continue
        if best is None or noise_px(solution) < noise_px(best[1]):
            best = problem, solution
        if solution.converged and noise_px(solution) < good_noise_px:
            break
    if best is None:
        raise trouble[0]
    return best


def _without_bad_views(
    problem: DomeProblem, solution: Solution[BundleState]
) -> tuple[DomeProblem, Solution[BundleState]]:
    """Leave out views that fit much worse than the others, and solve again."""
    n = len(problem.shots)
    noise = CORNER_SIGMA_PX * np.array(solution.block_scales[:n])
    typical = noise_px(solution)
    bad = {
        i: f"its corners are {noise[i]:.2g} px off, those of other views {typical:.2g} px; wrong "
        "pose, bent board or blurred picture?"
        for i in range(n)
        if noise[i] > max(_BAD.times_typical * typical, _BAD.noise_px)
    }
    if not bad or len(bad) > _BAD.max_share * n:
        return problem, solution
    problem = problem.without(bad)
    kept = [i for i in range(n) if i not in bad]
    return problem, solve(problem.bundle, solution.state.only(kept))


def _without_wrong_distances(
    problem: DomeProblem, solution: Solution[BundleState], sets: Sequence[BoardSet]
) -> tuple[DomeProblem, Solution[BundleState]]:
    """Drop given distances that the pictures contradict, if they are few."""
    wrong = _wrong_distances(problem, solution)
    if wrong and problem.considered.names:
        # Errors of considered numbers bias all distances; distances must not be rejected for that.
        free = problem.with_considered_free()
        wrong = _wrong_distances(free, solve(free.bundle, solution.state))
    if not wrong:
        return problem, solution
    if len(wrong) > _BAD.max_share * len(problem.measured_views):
        raise contradicted_distances(problem, solution, sets)
    reasons = {
        f"distance of {problem.shots[i].label}": (
            f"{1e3 * problem.given_distance(i):.2f} mm contradicts the pictures"
        )
        for i in wrong
    }
    forgotten = problem.without_distances(wrong)
    forgotten = replace(forgotten, left_out={**problem.left_out, **reasons})
    return forgotten, solve(forgotten.bundle, solution.state)


def _wrong_distances(problem: DomeProblem, solution: Solution[BundleState]) -> list[int]:
    # A given distance with an error of this many sigmas is a mistake.
    wrong = 5.0
    off = distance_blocks(problem, solution)
    return [i for i, block in off.items() if block.lengths[0] > wrong]


def _result(
    problem: DomeProblem,
    solution: Solution[BundleState],
    sets: Sequence[BoardSet],
    names: tuple[str, ...],
    covariance: FloatArray,
) -> DomeCalibration:
    bundle, state = problem.bundle, solution.state
    n_free, n_considered = len(bundle.free), len(problem.considered.names)
    columns = [*range(n_free), *range(len(covariance) - n_considered, len(covariance))]
    rig = state.rig.in_water(bundle.start.rig.n_water)
    if len(bundle.free_media) == 1:
        # The one medium that was solved for is the water that the rig will be used in.
        rig = rig.in_water(float(state.media[bundle.free_media[0]]))
        names, columns = (*names, "n_water"), [*columns, n_free]
    media = []
    for i, one in enumerate(sets):
        column = bundle.medium_columns(i)
        sigma = float(np.sqrt(covariance[column[0], column[0]])) if len(column) else 0.0
        media.append(SolvedMedium(one.name, float(state.media[i]), sigma))
    labels = [shot.label for shot in problem.shots]
    return DomeCalibration(
        rig=rig,
        uncertainty=RigUncertainty(names, covariance[np.ix_(columns, columns)]),
        media=tuple(media),
        views=view_fits(labels, bundle, solution, covariance),
        left_out=problem.left_out,
        noise_px=noise_px(solution),
        rotation_is_solved=problem.rotation_is_solved,
        cross_validation=None,
        findings=(),
    )
