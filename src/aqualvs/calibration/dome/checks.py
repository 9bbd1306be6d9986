"""Checks of `calibrate dome`: refusals of pictures and solutions that would make a wrong rig.

- Start and solution: distances that cannot be, poses from which the board is not seen, wrong units,
  views that the solution does not explain, numbers that the pictures do not determine.
- Medium: the stated index of each set against the one that the pictures fit best, and against the
  other medium (water for air, air for water).
- Rail: errors that all given distances share, their zero and their scale against the board's.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from aqualvs.calibration.dome.problem import (
    LENS,
    ROTATION,
    BoardSet,
    DomeProblem,
    PoseKind,
    place_names,
    restarted,
)
from aqualvs.calibration.solver.bundle import (
    CORNER_SIGMA_PX,
    CORNERS,
    DISTANCES,
    PRIORS,
    Bundle,
    BundleState,
    plane_distance,
)
from aqualvs.calibration.solver.covariance import (
    all_alike,
    implausible_distance,
    length_ratio,
    scale_fault,
)
from aqualvs.calibration.solver.initial_pose import start_pose
from aqualvs.calibration.solver.least_squares import (
    Block,
    Solution,
    cost,
    inverse,
    normal_equations,
    solve,
)
from aqualvs.errors import CalibrationError, RigError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import skew
from aqualvs.optics.rig import RigUncertainty
from aqualvs.optics.water import N_AIR


class _MediumOptions(NamedTuple):
    """Test whether the boards were in the medium that is stated."""

    sure: float = 5.0  # An index this many sigmas from the stated one contradicts it.
    # Between air and water.
    halfway: float = 1.15
    air: float = N_AIR
    water: float = 1.3335


_MEDIUM = _MediumOptions()

MAX_NOISE_PX = 1.0
"""Corners noisier than this indicate an error other than noise."""


def noise_px(solution: Solution[BundleState]) -> float:
    """Return the typical standard deviation of a corner's coordinate, in pixels."""
    return CORNER_SIGMA_PX * solution.scales[CORNERS]


def check_media(
    problem: DomeProblem, solution: Solution[BundleState], sets: Sequence[BoardSet]
) -> list[str]:
    """Compare every stated index with the one that fits the pictures best; return warnings.

    Raises `CalibrationError` if the pictures were taken in another medium.
    """
    doubts = []
    for medium, one in enumerate(sets):
        if _suspicion(problem, solution, medium, one) is None:
            continue
        # Errors of considered numbers and of a rail's zero bias the solution; they must not be
        # attributed to the medium.
        bare = problem.with_considered_free().without_distances(problem.measured_views)
        own = solve(bare.bundle, solution.state)
        weighed = _suspicion(bare, own, medium, one)
        if weighed is not None:
            doubts += weighed(bare, own, medium, one)
    return doubts


def in_other_medium(problem: DomeProblem, medium: int) -> Solution[BundleState] | None:
    """Solve with a set's medium swapped, water for air and air for water; None if impossible."""
    start = problem.bundle.start
    media = start.media.copy()
    media[medium] = other_medium(float(media[medium]))
    there = replace(start, media=media)
    poses = list(there.poses)
    for i, target in enumerate(problem.bundle.views):
        if target.medium == medium:
            poses[i] = restarted(there.camera(medium), target, poses[i])
    exact = replace(problem.bundle, media_sigma=np.zeros(len(media)))
    try:
        solution = solve(exact, replace(there, poses=tuple(poses)))
    except (CalibrationError, RigError):
        return None
    return solution if noise_px(solution) < MAX_NOISE_PX else None


def other_medium(n: float) -> float:
    """Return the index of water for air, and of air for water."""
    return _MEDIUM.water if n < _MEDIUM.halfway else _MEDIUM.air


def wrong_medium(one: BoardSet, index: float) -> CalibrationError:
    """Return the message on pictures that were taken in another medium than stated."""
    crossed = (index < _MEDIUM.halfway) != (one.n_medium < _MEDIUM.halfway)
    taken = "in air" if index < _MEDIUM.halfway else "in water"
    remedy = (
        f"were they taken {taken}?"
        if crossed
        else "check the medium, the dome's sizes and the camera's calibration"
    )
    return CalibrationError(
        f"{one.name}: the pictures fit n = {index:.3f} far better than the stated "
        f"{one.n_medium:.4f}; {remedy}"
    )


def _freed(bundle: Bundle, medium: int) -> Bundle:
    sigma = bundle.media_sigma.copy()
    sigma[medium] = np.inf
    return replace(bundle, media_sigma=sigma)


def _suspicion(
    problem: DomeProblem, solution: Solution[BundleState], medium: int, one: BoardSet
) -> Callable[[DomeProblem, Solution[BundleState], int, BoardSet], list[str]] | None:
    """Return how to weigh another index if the residuals do not speak for the stated one."""
    n, sigma = _nearby(_freed(problem.bundle, medium), solution, medium, one.n_medium)
    # With a larger uncertainty than this, an index near the stated one may be that of the other
    # medium.
    vague = 0.03
    if sigma > vague or noise_px(solution) > MAX_NOISE_PX:
        return _weighed_against_other
    far = abs(n - one.n_medium) > _MEDIUM.sure * sigma
    return _weighed_against_best if far else None


def _nearby(
    bundle: Bundle, solution: Solution[BundleState], medium: int, stated: float
) -> tuple[float, float]:
    """Return the index that fits the residuals, one Newton step from the solution; its sigma."""
    blocks = bundle.blocks(solution.state)
    n_data = sum(1 for b in solution.blocks if b.group != PRIORS)
    equations = normal_equations(
        bundle.n_parameters,
        blocks,
        [*solution.inliers[:n_data], *(b.seen for b in blocks[n_data:])],
        [*solution.block_scales[:n_data], *(1.0 for _ in blocks[n_data:])],
    )
    column = int(bundle.medium_columns(medium)[0])
    if equations.information[column, column] == 0.0:
        return stated, float("inf")
    covariance = inverse(equations.information)
    step = -float(covariance[column] @ equations.gradient)
    return float(solution.state.media[medium]) + step, float(np.sqrt(covariance[column, column]))


def _weighed_against_best(
    problem: DomeProblem, solution: Solution[BundleState], medium: int, one: BoardSet
) -> list[str]:
    """Solve with a free index of the medium, and compare."""
    free = _freed(problem.bundle, medium)
    try:
        best = solve(free, solution.state)
    except (CalibrationError, RigError):
        return []
    column = int(free.medium_columns(medium)[0])
    n, sigma = float(best.state.media[medium]), float(np.sqrt(best.covariance[column, column]))
    off = abs(n - one.n_medium)
    sure = off > _MEDIUM.sure * float(np.hypot(sigma, one.sigma_medium))
    # Differences that are refused, and that are reported.
    wrong, worth_saying = 0.02, 0.003
    if not sure or off < worth_saying or _gain(solution, best) < 0.5 * _MEDIUM.sure**2:
        return []
    if off > wrong:
        raise wrong_medium(one, n)
    return [
        f"{one.name}: the pictures fit n = {n:.4f} ± {sigma:.4f} rather than {one.n_medium:.4f}; "
        "check temperature and salinity, or the dome's sizes"
    ]


def _weighed_against_other(
    problem: DomeProblem, solution: Solution[BundleState], medium: int, one: BoardSet
) -> list[str]:
    """Solve with the other medium too, if a lens near the centre hides the difference."""
    rival = in_other_medium(problem, medium)
    if rival is None:
        return []
    gain = _gain(solution, rival)
    n = other_medium(one.n_medium)
    if gain > 0.5 * _MEDIUM.sure**2:
        raise wrong_medium(one, n)
    if gain > -0.5 * _MEDIUM.sure**2:
        return [
            f"{one.name}: the pictures do not distinguish n = {one.n_medium:.4f} from {n:.4f}; "
            "the lens position relies on the stated medium"
        ]
    return []


def _gain(solution: Solution[BundleState], rival: Solution[BundleState]) -> float:
    """Return how much better a rival explains all but the media, both at the smaller noise."""
    # The prior of the media stands last, where there is one.
    n = min(len(solution.blocks), len(rival.blocks))
    pairs = zip(solution.block_scales[:n], rival.block_scales[:n], strict=True)
    scales = [min(a, b) for a, b in pairs]
    inliers = zip(solution.inliers[:n], rival.inliers[:n], strict=True)
    both = [a & b for a, b in inliers]
    own, its = (cost(s.blocks[:n], both, scales, 0.0) for s in (solution, rival))
    return own - its


class _SharedError(NamedTuple):
    """An error that all given distances share, estimated from the pictures."""

    # In metres for an offset; a share for a scale. Given minus true.
    value: float
    sigma: float

    @property
    def sigmas(self) -> float:
        """Size of the error in sigmas."""
        return abs(self.value) / self.sigma


def check_shared_errors(
    problem: DomeProblem, solution: Solution[BundleState], covariance: FloatArray
) -> list[str]:
    """Compare the distances as a whole with the pictures; return warnings, in plain words.

    `covariance` (P, P): of the solved numbers, with the uncertainty of considered ones propagated.
    Raises `CalibrationError` if the shared error of the distances is too large for a good rig.
    """
    blocks = distance_blocks(problem, solution)
    if len(blocks) < 2:
        return []
    given = {i: problem.given_distance(i) for i in blocks}
    offset = _shared_error(covariance, blocks, dict.fromkeys(blocks, 1.0))
    scale = _shared_error(covariance, blocks, given)
    check_sure = 3.5
    if max(offset.sigmas, scale.sigmas) < check_sure:
        return []
    # Shared errors beyond these (metres, share) are refused; smaller ones are reported.
    max_offset, max_scale = 1e-3, 0.005
    if offset.sigmas >= scale.sigmas:
        text = (
            f"all given distances are {1e3 * offset.value:+.2f} ± {1e3 * offset.sigma:.2f} mm off "
            "together; they count from the dome's centre along its y axis, not from its front or "
            "from the lens; or the dome's radius is not that of the rig file"
        )
        fatal = abs(offset.value) > max_offset
    else:
        text = (
            f"all given distances are {100.0 * scale.value:+.2f} ± {100.0 * scale.sigma:.2f} % off "
            "together, measured in the board's squares; measure the squares, and check the medium"
        )
        fatal = abs(scale.value) > max_scale
    if fatal:
        raise CalibrationError(text)
    return [text]


def distance_blocks(problem: DomeProblem, solution: Solution[BundleState]) -> dict[int, Block]:
    """Return the residuals of given distances by view."""
    blocks = [block for block in solution.blocks if block.group == DISTANCES]
    return dict(zip(problem.measured_views, blocks, strict=True))


def solved_by_offset(problem: DomeProblem, solution: Solution[BundleState]) -> FloatArray:
    """Return the derivative (P,) of the solution by an error that all distances share."""
    blocks = distance_blocks(problem, solution)
    slopes, _, _ = _slopes(len(solution.covariance), blocks, dict.fromkeys(blocks, 1.0))
    return solution.covariance @ slopes


def solved_by_shared_tilt(problem: DomeProblem, solution: Solution[BundleState]) -> FloatArray:
    """Return the derivative (P, 3) of the solution by a tilt, about each axis, of all boards.

    Camera and boards turn together about the dome's centre; distances along the dome's y axis
    change by the square of the tilt only. Zero if boards at exactly known poses give the axes.
    """
    bundle, state = problem.bundle, solution.state
    by_tilt = np.zeros((len(solution.covariance), 3))
    if not problem.axes_are_of_boards:
        return by_tilt
    by_tilt[[bundle.free.index(name) for name in ROTATION]] = np.eye(3)
    by_tilt[[bundle.free.index(name) for name in LENS]] = -skew(state.rig.dome_from_cam.translation)
    for i, (pose, view) in enumerate(zip(state.poses, bundle.views, strict=True)):
        columns = bundle.pose_columns(i)
        by_tilt[columns[:3]] = np.eye(3)
        by_tilt[columns[3:]] = -skew(pose.apply(view.view.middle))
    return by_tilt


def _shared_error(
    covariance: FloatArray, blocks: Mapping[int, Block], shape: Mapping[int, float]
) -> _SharedError:
    """Fit an error of a given shape over the distances, from derivatives at the solution."""
    slopes, own, gradient = _slopes(len(covariance), blocks, shape)
    left = own - float(slopes @ covariance @ slopes)
    if left <= 1e-9 * own:
        return _SharedError(0.0, float("inf"))
    return _SharedError(gradient / left, 1.0 / float(np.sqrt(left)))


def _slopes(
    n_parameters: int, blocks: Mapping[int, Block], shape: Mapping[int, float]
) -> tuple[FloatArray, float, float]:
    """Return cross information with the solved numbers, own information, and minus the gradient."""
    slopes, own, gradient = np.zeros(n_parameters), 0.0, 0.0
    # Index of the shift along y in a step of a pose.
    shift_y = 4
    for i, block in blocks.items():
        weight = float(block.loss.weight(block.lengths)[0])
        # A given distance that is too large acts as a shift of the board along y.
        by_error = shape[i] * float(block.jacobian[0, 0, shift_y])
        slopes[block.columns] += weight * by_error * block.jacobian[0, 0]
        own += weight * by_error**2
        gradient -= weight * by_error * float(block.residuals[0, 0])
    return slopes, own, gradient


# Differences of scale that are too large for errors of boards and rails.
_FINE_SCALE, _EXACT_SCALE = 0.003, 0.02
_POSE_RULES = (
    "poses must be dome_from_board in millimetres, with OpenCV's board axes (x right, y down, z "
    "into the board) and dome axes x right, y forward, z up"
)


def check_initial_guess(problem: DomeProblem) -> None:
    """Refuse boards at impossible distances, or grossly different from the given ones.

    Raises `CalibrationError` with the likely mistake.
    """
    _check_seen(problem)
    views = problem.bundle.views
    away = [float(np.linalg.norm(v.dome_from_target.apply(v.view.middle))) for v in views]
    _refuse_if(implausible_distance(np.array(away), [shot.label for shot in problem.shots]))
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
    # Larger limit before the solve: a wrong medium or lens position may look like a wrong scale.
    coarse_scale = 0.5
    if boards:
        given = np.array([problem.given_distance(i) for i in boards])
        found = np.array([plane_distance(views[i].dome_from_target) for i in boards])
        if not np.all(given > 0.0):
            raise CalibrationError(
                f"a board at the distance {1e3 * float(given.min()):g} mm; distances count forward "
                "from the dome's centre and are positive"
            )
        _refuse_if(scale_fault(length_ratio(given, found), coarse_scale))


def _check_seen(problem: DomeProblem) -> None:
    """Refuse exact poses from which the camera cannot see the board at all."""
    bundle = problem.bundle
    fixed = [i for i, view in enumerate(bundle.views) if view.fixed]
    unseen = []
    # Distance from the image's centre, in its sizes, beyond which a board counts as not seen.
    surely_seen = 2.0
    for i in fixed:
        view = bundle.views[i]
        camera = bundle.start.camera(view.medium)
        pixels, _ = camera.project(view.dome_from_target.apply(view.view.points))
        # Far outside the picture counts as not seen; NaN compares false.
        off_centre = np.abs(pixels / camera.size_px - 0.5).max(axis=1)
        if np.mean(off_centre < surely_seen) < 0.5:
            unseen.append(i)
    if len(unseen) > 0.5 * len(fixed):
        raise CalibrationError(
            f"{problem.shots[unseen[0]].label}: the camera cannot see a board at the given pose; "
            f"{_POSE_RULES}"
        )


def contradicted_distances(
    problem: DomeProblem, solution: Solution[BundleState], sets: Sequence[BoardSet]
) -> CalibrationError:
    """Return the message on given distances if the pictures contradict most of them."""
    # Typical residual of distances, in sigmas, that agree with a solution.
    fitting = 1.5
    for medium, one in enumerate(sets):
        rival = in_other_medium(problem, medium)
        if rival is not None:
            off = [block.lengths[0] for block in distance_blocks(problem, rival).values()]
            if np.median(off) < fitting:
                return wrong_medium(one, other_medium(one.n_medium))
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
    """Refuse a solution that does not explain the pictures, or is not determined by them.

    `uncertainty`: of the solved numbers, with the uncertainty of considered ones propagated. Raises
    `CalibrationError` with the likely cause and the remedy.
    """
    noise = noise_px(solution)
    if noise > MAX_NOISE_PX:
        _refuse_if(_exact_pose_fault(problem, solution))
        raise CalibrationError(
            f"no lens position explains the pictures: corners are {noise:.2g} px off (0.1 px is "
            "usual); check the board's file against the print, the camera's calibration, the "
            f"{'port' if solution.state.rig.flat_port else 'dome'}'s sizes and the medium"
        )
    if not solution.converged:
        raise CalibrationError(
            "the solve does not come to rest; add views at other distances and tilts, and check "
            "the rig's dome"
        )
    rig = solution.state.rig
    # Uncertainty of the lens position (metres) that makes an error of 0.4 % of range.
    max_lens_sigma = 2e-3
    if rig.flat_port is not None:
        sigma = uncertainty.sigmas["port_distance"]
        if sigma > max_lens_sigma:
            raise CalibrationError(
                f"the pictures do not determine the port's distance from the lens: "
                f"{1e3 * sigma:.1f} mm uncertain; show more views in water, some near, with "
                "corners all over the picture"
            )
        return
    lens = rig.dome_from_cam.translation
    # A lens this near the inner surface (in radii) was stopped by that limit.
    at_the_wall = 0.995
    if rig.dome is not None and np.linalg.norm(lens) > at_the_wall * rig.dome.inner_radius:
        raise CalibrationError(
            f"the lens ends at the dome's wall, at {np.round(1e3 * lens, 1).tolist()} mm; check "
            "the dome's inner radius, the board's square_mm, the given distances and the medium"
        )
    values, vectors = np.linalg.eigh(uncertainty.of(place_names(rig)))
    sigma, axis = float(np.sqrt(values[-1])), vectors[:, -1] * np.sign(vectors[:, -1].sum())
    if sigma > max_lens_sigma:
        remedy = "show more views, nearer, and with corners all over the picture"
        if all(shot.kind is PoseKind.UNKNOWN for shot in problem.shots):
            remedy = (
                "give the boards' distances, show the board nearer and in more views, or take the "
                "pictures in water, where refraction is five times stronger"
            )
        raise CalibrationError(
            f"the pictures do not determine the lens position: {1e3 * sigma:.1f} mm uncertain "
            f"along {np.round(axis, 1).tolist()}; {remedy}"
        )


def _exact_pose_fault(problem: DomeProblem, solution: Solution[BundleState]) -> str | None:
    """Return the fault of poses given as exact, compared with the pose from each picture."""
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
    # Ratios of lengths with less scatter than this show one wrong scale.
    same_ratio = 0.05
    one_scale = float(np.median(np.abs(ratios / ratio - 1.0))) < same_ratio
    fault = scale_fault(ratio, _EXACT_SCALE) if one_scale else None
    return fault or f"the given poses contradict the pictures; {_POSE_RULES}"


def _refuse_if(fault: str | None) -> None:
    if fault is not None:
        raise CalibrationError(fault)
