"""Whether pictures were taken in the medium that they are said to have been taken in."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum, auto

import numpy as np

from aqualvs.calibration.blocks import cost, normal_equations
from aqualvs.calibration.board_sets import BoardSet
from aqualvs.calibration.bundle import CORNER_SIGMA_PX, CORNERS, PRIORS, Bundle, BundleState
from aqualvs.calibration.dome_problem import DomeProblem
from aqualvs.calibration.least_squares import Solution, inverse, solve
from aqualvs.calibration.start import start_pose
from aqualvs.errors import CalibrationError, RigError

# An index this many sigmas from the stated one is not it.
_SURE = 5.0
MAX_NOISE_PX = 1.0
"""Corners noisier than this mean that something else is wrong than noise."""
# Differences that make a wrong rig, and that are worth a remark.
_WRONG, _WORTH_SAYING = 0.02, 0.003
# Between air and water.
_HALFWAY = 1.15
_AIR, _WATER = 1.0003, 1.3335
# An index that the pictures tell worse than this, near the stated one, may be a wholly other one.
_VAGUE = 0.03


@dataclass(frozen=True, slots=True)
class FittedIndex:
    """The index that pictures call for, and how well they tell it."""

    n: float
    sigma: float


def noise_px(solution: Solution[BundleState]) -> float:
    """Return the typical standard deviation of a corner's coordinate, in pixels."""
    return CORNER_SIGMA_PX * solution.scales[CORNERS]


def check_media(
    problem: DomeProblem, solution: Solution[BundleState], sets: Sequence[BoardSet]
) -> list[str]:
    """Compare every stated index with that which the pictures fit best.

    Returns
    -------
    list of str
        Doubts, in plain words.

    Raises
    ------
    CalibrationError
        If the pictures were taken in another medium.
    """
    doubts = []
    for medium, one in enumerate(sets):
        if _suspicion(problem, solution, medium, one) is _Suspicion.NONE:
            continue
        # Numbers that were held, and a rail's zero, bend the solution; the medium must not take
        # the blame for them.
        bare = problem.with_held_free().without_distances(problem.measured_views)
        own = solve(bare.bundle, solution.state)
        suspicion = _suspicion(bare, own, medium, one)
        if suspicion is _Suspicion.OTHER:
            doubts += _weighed_against_other(bare, own, medium, one)
        elif suspicion is _Suspicion.NEARBY:
            doubts += _weighed_against_best(bare, own, medium, one)
    return doubts


def in_other_medium(problem: DomeProblem, medium: int) -> Solution[BundleState] | None:
    """Solve with a set's pictures in water for air, in air for water; None if that cannot be."""
    start = problem.bundle.start
    media = start.media.copy()
    media[medium] = other_medium(float(media[medium]))
    there = replace(start, media=media)
    poses = list(there.poses)
    for i, target in enumerate(problem.bundle.views):
        if target.medium == medium and not target.fixed:
            found = start_pose(there.camera(medium), target.view)
            poses[i] = poses[i] if isinstance(found, str) else found.dome_from_target
    exact = replace(problem.bundle, media_sigma=np.zeros(len(media)))
    try:
        solution = solve(exact, replace(there, poses=tuple(poses)))
    except (CalibrationError, RigError):
        return None
    return solution if noise_px(solution) < MAX_NOISE_PX else None


def other_medium(n: float) -> float:
    """Return the index of water for air, and of air for water."""
    return _WATER if n < _HALFWAY else _AIR


def wrong_medium(one: BoardSet, index: float) -> CalibrationError:
    """Return what to say of pictures that were taken in another medium than stated."""
    crossed = (index < _HALFWAY) != (one.n_medium < _HALFWAY)
    taken = "in air" if index < _HALFWAY else "in water"
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


class _Suspicion(Enum):
    NONE = auto()
    NEARBY = auto()
    """The residuals call for another index."""
    OTHER = auto()
    """The residuals do not tell the index, or there is something else wrong."""


def _suspicion(
    problem: DomeProblem, solution: Solution[BundleState], medium: int, one: BoardSet
) -> _Suspicion:
    near = _nearby(_freed(problem.bundle, medium), solution, medium, one.n_medium)
    if near.sigma > _VAGUE or noise_px(solution) > MAX_NOISE_PX:
        return _Suspicion.OTHER
    far = abs(near.n - one.n_medium) > _SURE * near.sigma
    return _Suspicion.NEARBY if far else _Suspicion.NONE


def _nearby(
    bundle: Bundle, solution: Solution[BundleState], medium: int, stated: float
) -> FittedIndex:
    """Return the index that the residuals call for: Newton's step from the solution."""
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
        return FittedIndex(stated, float("inf"))
    covariance = inverse(equations.information)
    step = -float(covariance[column] @ equations.gradient)
    sigma = float(np.sqrt(covariance[column, column]))
    return FittedIndex(float(solution.state.media[medium]) + step, sigma)


def _weighed_against_best(
    problem: DomeProblem, solution: Solution[BundleState], medium: int, one: BoardSet
) -> list[str]:
    """Solve with the medium free, and compare."""
    free = _freed(problem.bundle, medium)
    try:
        best = solve(free, solution.state)
    except (CalibrationError, RigError):
        return []
    column = int(free.medium_columns(medium)[0])
    n, sigma = float(best.state.media[medium]), float(np.sqrt(best.covariance[column, column]))
    off = abs(n - one.n_medium)
    sure = off > _SURE * float(np.hypot(sigma, one.sigma_medium))
    if not sure or off < _WORTH_SAYING or _gain(solution, best) < 0.5 * _SURE**2:
        return []
    if off > _WRONG:
        raise wrong_medium(one, n)
    return [
        f"{one.name}: the pictures fit n = {n:.4f} ± {sigma:.4f} rather than {one.n_medium:.4f}; "
        "check temperature and salinity, or the dome's sizes"
    ]


def _weighed_against_other(
    problem: DomeProblem, solution: Solution[BundleState], medium: int, one: BoardSet
) -> list[str]:
    """Solve with the other medium too, where a lens near the centre hides which one it is."""
    rival = in_other_medium(problem, medium)
    if rival is None:
        return []
    gain = _gain(solution, rival)
    n = other_medium(one.n_medium)
    if gain > 0.5 * _SURE**2:
        raise wrong_medium(one, n)
    if gain > -0.5 * _SURE**2:
        return [
            f"{one.name}: the pictures do not tell n = {one.n_medium:.4f} from {n:.4f}; the lens "
            "position rests on the medium being the stated one"
        ]
    return []


def _gain(solution: Solution[BundleState], rival: Solution[BundleState]) -> float:
    """Return how much better a rival explains all but the media; both at the smaller noise."""
    # The prior of the media stands last, where there is one.
    n = min(len(solution.blocks), len(rival.blocks))
    pairs = zip(solution.block_scales[:n], rival.block_scales[:n], strict=True)
    scales = [min(a, b) for a, b in pairs]
    inliers = zip(solution.inliers[:n], rival.inliers[:n], strict=True)
    both = [a & b for a, b in inliers]
    own, its = (cost(s.blocks[:n], both, scales, 0.0) for s in (solution, rival))
    return own - its
