"""Joint covariance of camera, medium and lasers after a calibration of the lasers.

The camera's numbers come from another calibration, with their own uncertainty (`CameraCovariance`).
Either they are held, and their uncertainty is propagated to the planes to first order (a "consider"
covariance, Schmidt 1966, doi:10.1016/B978-1-4831-6716-9.50011-4), or they are refined with that
uncertainty as their prior. In both cases planes and camera remain correlated, and the result holds
their correlation. The error that all stripe centres on one surface share is propagated in the same
way: more points do not reduce it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from aqualvs.calibration.lasers.problem import N_LASER, LaserProblem, LaserState
from aqualvs.calibration.lasers.stripes_on_planes import correlation_factor
from aqualvs.calibration.solver.least_squares import Solution, inverse, normal_equations
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.optics.camera import parameter_names
from aqualvs.optics.rig import LASER_PARAMETERS, Laser, Rig, RigUncertainty


@dataclass(frozen=True, slots=True)
class CameraCovariance:
    """Uncertain numbers of the camera, and uncertainty of the medium's index."""

    names: tuple[str, ...]  # Of the rig's numbers, without the medium's index.
    # Standard deviation of that index, `n_water`; 0 if it is exact.
    sigma_medium: float
    # Prior uncertainty.
    given: RigUncertainty

    @classmethod
    def of(cls, rig: Rig, given: RigUncertainty, n_medium: float | None) -> "CameraCovariance":
        """Return the uncertain numbers of a rig before the calibration.

        `n_medium` is the exact index of the medium in the pictures, None for the rig's own water.
        """
        # Earlier knowledge of the lasers is replaced.
        given = given.only([name for name in given.names if ":" not in name])
        sigmas = given.sigmas
        known = set(parameter_names(rig.camera())) - {"n_water"}
        names = tuple(n for n in given.names if n in known and sigmas[n] > 0.0)
        is_water = n_medium is None and rig.housing is not None
        return cls(names, sigmas.get("n_water", 0.0) if is_water else 0.0, given)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of all uncertain numbers, in the order of the problem's first columns."""
        return (*self.names, "n_water") if self.sigma_medium > 0.0 else self.names

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the uncertain numbers, in the order of `columns`."""
        return self.given.of(self.columns)


def joint_uncertainty(
    solution: Solution[LaserState],
    problem: LaserProblem,
    camera_covariance: CameraCovariance,
    lasers: Sequence[Laser],
    *,
    refined: bool,
    stripe_bias_px: float,
) -> tuple[RigUncertainty, list[FloatArray]]:
    """Return the joint covariance of camera, medium and lasers, and that (3, 3) of each plane.

    Windows are taken as given.

    Parameters
    ----------
    solution, problem
        With free uncertain numbers if `refined`, else held ones.
    camera_covariance : CameraCovariance
        Numbers that were uncertain before.
    lasers : sequence of Laser
        In the problem's order.
    stripe_bias_px : float
        Standard deviation of the error that all centres of one laser's stripe share on one
        surface, across the stripe.
    """
    correlation = _correlation(solution, problem)
    information = _data_information(solution, problem, camera_covariance, correlation)
    covariance = _all_covariance(information, problem, camera_covariance, stripe_bias_px, refined)
    # Poses, board poses and bias are marginalised.
    n, mine = len(camera_covariance.columns), np.arange(N_LASER * problem.n_lasers)
    mine += problem.laser_columns(0)[0] + n - problem.bundle.n_shared
    kept = np.concatenate([np.arange(n), mine])
    joint = _with_given(covariance[np.ix_(kept, kept)], camera_covariance)
    names = [f"{laser.name}:{name}" for laser in lasers for name in LASER_PARAMETERS]
    planes = [covariance[np.ix_(one, one)] for one in np.split(mine, problem.n_lasers)]
    return RigUncertainty((*camera_covariance.given.names, *names), joint), planes


def _all_covariance(
    information: FloatArray,
    problem: LaserProblem,
    camera_covariance: CameraCovariance,
    stripe_bias_px: float,
    refined: bool,
) -> FloatArray:
    """Return the covariance of all numbers from the information of the data alone."""
    n, n_bias = len(camera_covariance.columns), problem.n_lasers * len(problem.surfaces.planes)
    bias = np.arange(len(information) - n_bias, len(information))
    bias_prior = np.diag(np.full(n_bias, stripe_bias_px**2))
    if refined:
        informed = information.copy()
        informed[:n, :n] += inverse(camera_covariance.covariance)
        return _consider_covariance(informed, bias, bias_prior)
    prior = np.zeros((n + n_bias, n + n_bias))
    prior[:n, :n], prior[n:, n:] = camera_covariance.covariance, bias_prior
    return _consider_covariance(information, np.concatenate([np.arange(n), bias]), prior)


def _correlation(solution: Solution[LaserState], problem: LaserProblem) -> tuple[float, ...]:
    if problem.board_pose_prior is not None:
        # The noise of stripes then includes the errors that bins share.
        return (1.0,) * problem.n_lasers
    sequences: list[list[FloatArray]] = [[] for _ in range(problem.n_lasers)]
    # Stripes come before all other blocks.
    parts = zip(
        problem.groups, solution.blocks, solution.inliers, solution.block_scales, strict=False
    )
    for group, block, inside, scale in parts:
        residuals = np.where(inside, block.residuals[:, 0] / scale, np.nan)
        for i in np.unique(group.surface):
            sequences[group.laser].append(residuals[group.surface == i])
    return tuple(correlation_factor(mine) for mine in sequences)


def _data_information(
    solution: Solution[LaserState],
    problem: LaserProblem,
    camera_covariance: CameraCovariance,
    correlation: Sequence[float],
) -> FloatArray:
    """Return the information of all data: uncertain numbers first, biases last."""
    bundle = replace(
        problem.bundle,
        free=camera_covariance.names,
        priors=RigUncertainty.none(),
        media_sigma=np.array([camera_covariance.sigma_medium]),
    )
    full = replace(problem, bundle=bundle)
    blocks = full.blocks(solution.state)
    n_data = len(problem.groups) + len(bundle.views)
    n_board_pose = 0 if problem.board_pose_prior is None else len(bundle.views)

    def of_interest(n_blocks: int) -> list[int]:
        # The priors of the camera, different in the two problems, are in between.
        return [*range(n_data), *range(n_blocks - n_board_pose, n_blocks)]

    then = of_interest(len(solution.blocks))
    scales = [solution.block_scales[i] for i in then]
    taken = [blocks[i] for i in of_interest(len(blocks))]
    n_surfaces = len(problem.surfaces.planes)
    for i, group in enumerate(problem.groups):
        scales[i] *= float(np.sqrt(correlation[group.laser]))
        # One more unknown for each surface: a shift of the stripe across, in pixels.
        first = full.n_parameters + n_surfaces * group.laser
        by_bias = np.zeros((len(group), 1, n_surfaces))
        by_bias[np.arange(len(group)), 0, group.surface] = 1.0 / group.sigma_px
        taken[i] = replace(
            taken[i],
            columns=np.concatenate([taken[i].columns, np.arange(first, first + n_surfaces)]),
            jacobian=np.concatenate([taken[i].jacobian, by_bias], axis=2),
        )
    inliers = [solution.inliers[i] for i in then]
    n_all = full.n_parameters + n_surfaces * problem.n_lasers
    return normal_equations(n_all, taken, inliers, scales).information


def _consider_covariance(
    information: FloatArray, considered: IntArray, prior: FloatArray
) -> FloatArray:
    """Return the covariance of all numbers if some were held at values of covariance `prior`."""
    solved = np.setdiff1d(np.arange(len(information)), considered)
    noise = inverse(information[np.ix_(solved, solved)])
    by_considered = -noise @ information[np.ix_(solved, considered)]
    covariance = np.empty_like(information)
    covariance[np.ix_(considered, considered)] = prior
    covariance[np.ix_(solved, considered)] = by_considered @ prior
    covariance[np.ix_(considered, solved)] = (by_considered @ prior).T
    covariance[np.ix_(solved, solved)] = noise + by_considered @ prior @ by_considered.T
    return covariance


def _with_given(covariance: FloatArray, camera_covariance: CameraCovariance) -> FloatArray:
    """Return the covariance of all given numbers and the lasers.

    Numbers outside the solve follow those in it by their prior correlation.
    """
    given = camera_covariance.given
    n, n_given = len(camera_covariance.columns), len(given.names)
    crossed = given.covariance[[given.names.index(name) for name in camera_covariance.columns]]
    sigma = np.sqrt(np.diag(camera_covariance.covariance))
    # Units have many sizes, and numbers may be dependent.
    size = np.outer(sigma, sigma)
    follow = crossed.T @ (np.linalg.pinv(camera_covariance.covariance / size, rcond=1e-10) / size)
    joint = np.empty((n_given + len(covariance) - n,) * 2)
    rest = given.covariance - follow @ crossed
    joint[:n_given, :n_given] = rest + follow @ covariance[:n, :n] @ follow.T
    joint[:n_given, n_given:] = follow @ covariance[:n, n:]
    joint[n_given:, :n_given] = joint[:n_given, n_given:].T
    joint[n_given:, n_given:] = covariance[n:, n:]
    return 0.5 * (joint + joint.T)
