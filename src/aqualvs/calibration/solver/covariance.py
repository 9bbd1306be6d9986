"""Covariance and observability of the parameters that all views share.

By views (`view_covariance`): errors of corners that are common to a view (the board bends, the
camera moves during the exposure, a rolling shutter) leave residuals that vary smoothly over the
picture. A covariance that counts every corner as independent is then too small. Each view's score
of the shared parameters is taken as one observation instead: the cluster-robust "sandwich" (Liang &
Zeger 1986, doi:10.1093/biomet/73.1.13), with the bias correction CR2 for views of unequal leverage
(Bell & McCaffrey 2002, Survey Methodology 28, 169-181). Few views determine the covariance of many
parameters badly; it is shrunk towards a multiple of the corners' (Ledoit & Wolf 2004,
doi:10.1016/S0047-259X(03)00096-4).

Considered parameters (`consider_covariance`): errors of numbers that were held fixed, though not
known exactly, pass into the numbers that were solved for, through the derivatives of both. This is
the "consider" covariance (Schmidt 1966, doi:10.1016/B978-1-4831-6716-9.50011-4).

Observability (`observability`): combinations of numbers that the data determined, and those that
rest on their priors. Degenerate sets of views, such as boards that are all alike or distances in a
wrong unit, are recognised and described with a remedy (`all_alike`, `scale_fault`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from aqualvs.calibration.solver.bundle import PRIORS, Bundle, BundleState
from aqualvs.calibration.solver.least_squares import Block, Solution, inverse, normal_equations
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.optics.rig import RigUncertainty

# Ratios of found to given lengths that a wrong unit explains, and the tolerance of the ratio.
_UNITS = {
    1e3: "distances written in metres, or square_mm in micrometres",
    1e-3: "distances written in micrometres, or square_mm in metres",
    1e2: "distances off by a factor of 100",
    1e-2: "distances off by a factor of 100",
    25.4: "distances in inches",
    1 / 25.4: "square_mm in inches",
    10.0: "distances in centimetres",
    0.1: "square_mm in centimetres",
}


def largest_angle(normals: FloatArray) -> float:
    """Return the largest angle between boards, in radians, by their unit normals (V, 3)."""
    return float(np.arccos(np.clip(np.abs(normals @ normals.T), 0.0, 1.0).min()))


def all_alike(normals: FloatArray, distances: FloatArray) -> bool:
    """Return whether all boards are parallel and at one distance."""
    distance = float(np.ptp(distances) / np.median(distances))
    # Boards less than this apart in direction (radians) and in distance (share) are all alike.
    same_direction, same_distance = np.deg2rad(3.0), 0.05
    return largest_angle(normals) < same_direction and distance < same_distance


def length_ratio(given: FloatArray, found: FloatArray) -> float:
    """Return the ratio of distances found in pictures to those given.

    From the differences between views if they differ enough (a median, so that a few wrong ones do
    not count): an offset, such as of a lens that is not yet known, then cancels.
    """
    i, j = np.triu_indices(len(given), 1)
    apart = np.abs(given[i] - given[j]) > 0.1 * np.median(np.abs(given))
    if np.count_nonzero(apart) >= len(given):
        return float(np.median((found[i] - found[j])[apart] / (given[i] - given[j])[apart]))
    return float(np.median(found / given))


def scale_fault(ratio: float, tolerance: float) -> str | None:
    """Return what a ratio of found to given distances means; None if it is near 1."""
    if abs(ratio - 1.0) <= tolerance:
        return None
    unit_tolerance = 0.12
    for unit, meaning in _UNITS.items():
        if abs(ratio / unit - 1.0) < unit_tolerance:
            return (
                f"the pictures put the boards {ratio:.4g} times as far away as the given distances "
                f"do: {meaning}? Distances and square_mm are in millimetres"
            )
    if ratio < 0.0:
        return (
            "the given distances grow where the pictures show the board coming nearer; measure "
            "them from the dome's centre forward, along its y axis"
        )
    return (
        f"the pictures put the boards {ratio:.4g} times as far apart as the given distances do; "
        f"measure the board's squares: square_mm would have to be {1.0 / ratio:.4g} times what "
        "its file says, if the distances are right, and camera and housing those of the rig file"
    )


def implausible_distance(distances: FloatArray, labels: Sequence[str]) -> str | None:
    """Return the fault of boards at unlikely distances (metres)."""
    median = float(np.median(distances))
    label = labels[int(np.argsort(distances)[len(distances) // 2])]
    if 0.03 < median < 30.0:
        return None
    return (
        f"{label}: the board would stand {1e3 * median:.4g} mm away; is square_mm in its file in "
        "millimetres?"
    )


@dataclass(frozen=True, slots=True)
class Direction:
    """A combination of numbers, each in sigmas of its prior."""

    weights: dict[str, float]  # Component of every number, squares adding up to 1.
    gain: float  # Ratio of the information of the data to that of the prior.

    @property
    def main(self) -> dict[str, float]:
        """Numbers that make up nearly all of it, largest first."""
        order = sorted(self.weights, key=lambda name: -abs(self.weights[name]))
        return {name: self.weights[name] for name in order if abs(self.weights[name]) > 0.3}


@dataclass(frozen=True, slots=True)
class Observability:
    """Observability of numbers with a prior: how far the data determined them."""

    # Ratio of each number's sigma after the solve to that before: 1 if the data added nothing.
    shrinkage: dict[str, float]
    # Independent combinations, best determined first.
    directions: tuple[Direction, ...]

    def unobservable(self) -> list[Direction]:
        """Return the combinations with far less information from the data than from the priors."""
        least_gain = 0.1
        return [direction for direction in self.directions if direction.gain < least_gain]


def observability(
    bundle: Bundle,
    solution: Solution[BundleState],
    uncertainty: RigUncertainty,
    names: Sequence[str],
) -> Observability:
    """Compare the information that a solve adds about some numbers with their priors.

    All else is marginalised, with its priors: poses, the lens, the intrinsics. `uncertainty` is
    that after the solve, with considered numbers propagated. Priors of `names` are independent of
    those of others; names without a prior are skipped.
    """
    names = [name for name in names if name in bundle.free and name in bundle.priors.names]
    if not names:
        return Observability({}, ())
    columns = np.array([bundle.free.index(name) for name in names])
    prior = bundle.priors.of(names)
    learnt = solution.information.copy()
    learnt[np.ix_(columns, columns)] -= np.linalg.inv(prior)
    root = np.linalg.cholesky(prior)
    others = np.setdiff1d(np.arange(len(learnt)), columns)
    cross, own = learnt[np.ix_(columns, others)], learnt[np.ix_(columns, columns)]
    marginal = own - cross @ inverse(learnt[np.ix_(others, others)]) @ cross.T
    gains, vectors = np.linalg.eigh(root.T @ marginal @ root)
    # In the numbers themselves a direction is root @ vector; given in sigmas of each one's prior.
    shares = root @ vectors / np.sqrt(np.diag(prior))[:, None]
    shares /= np.linalg.norm(shares, axis=0)
    directions = tuple(
        Direction(dict(zip(names, shares[:, k].tolist(), strict=True)), max(float(gains[k]), 0.0))
        for k in np.argsort(-gains)
    )
    before, after = bundle.priors.sigmas, uncertainty.sigmas
    return Observability({name: after[name] / before[name] for name in names}, directions)


def consider_covariance(
    bundle: Bundle, solution: Solution[BundleState], considered: RigUncertainty
) -> tuple[tuple[str, ...], FloatArray]:
    """Return the joint covariance of solved and considered numbers, and the rig's names in it.

    Rows are the bundle's columns (P), then those of `considered`, which the bundle does not solve
    for.
    """
    if not considered.names:
        return bundle.free, solution.covariance.copy()
    wider = replace(bundle, free=(*bundle.free, *considered.names))
    kept = [i for i, b in enumerate(solution.blocks) if b.group != PRIORS]
    # Priors stand at the end, so both problems begin with the same blocks.
    blocks = wider.blocks(solution.state)[: len(kept)]
    inliers = [solution.inliers[i] for i in kept]
    scales = [solution.block_scales[i] for i in kept]
    information = normal_equations(wider.n_parameters, blocks, inliers, scales).information
    n, m = len(bundle.free), len(considered.names)
    solved = np.r_[0:n, n + m : wider.n_parameters]
    gain = -solution.covariance @ information[np.ix_(solved, np.arange(n, n + m))]
    passed_on = gain @ considered.covariance
    joint = np.block(
        [
            [solution.covariance + passed_on @ gain.T, passed_on],
            [passed_on.T, considered.covariance],
        ]
    )
    return (*bundle.free, *considered.names), joint


@dataclass(frozen=True, slots=True)
class ViewCovariance:
    """Covariance of the shared parameters, by corners and by views."""

    by_corners: FloatArray  # Shape (S, S): as if the errors of all corners were independent.
    # Shape (S, S): from the disagreement of the views; nowhere smaller than `by_corners`.
    by_views: FloatArray
    # Ratio of the variance by views to that by corners, over all combinations; 1 if the corners'
    # errors are independent, or less by chance.
    inflation: float
    # Shape (S,): one Gauss-Newton step of the parameters; zero at the solution. The disagreement of
    # the views is evaluated after this step.
    step: FloatArray


def shared_covariance(bundle: Bundle, solution: Solution[BundleState]) -> ViewCovariance:
    """Estimate the covariance of the parameters that a bundle's views share, by `view_covariance`.

    Neither bundle nor poses have priors, and all poses are free. Columns of the solution beyond
    those of the bundle are shared, too, and come last.
    """
    n = len(bundle.views)
    beyond = np.arange(bundle.n_parameters, len(solution.covariance))
    shared = np.concatenate([np.arange(bundle.n_shared), beyond])
    return view_covariance(
        solution.blocks[:n], solution.inliers[:n], solution.block_scales[:n], shared
    )


def view_covariance(
    blocks: Sequence[Block], inliers: Sequence[BoolArray], scales: Sequence[float], shared: IntArray
) -> ViewCovariance:
    """Estimate the covariance of shared parameters from views with a pose each.

    Parameters
    ----------
    blocks : sequence of Block
        One for each view, at the solution or near it. Columns that are not shared
        belong to its pose alone.
    inliers : sequence of bool array, shape (N,)
        Inlier corners.
    scales : sequence of float
        Noise of each view as a multiple of the nominal one.
    shared : int array, shape (S,)
        Columns of the parameters that all views share.

    Raises
    ------
    CalibrationError
        If the views give no information on one of the parameters.
    """
    each = zip(blocks, inliers, scales, strict=True)
    own, pulls = zip(*(_without_pose(*one, shared) for one in each), strict=True)
    by_corners = inverse(np.sum(own, axis=0))
    root = _root(by_corners)
    white = [root.T @ information @ root for information in own]
    step = -by_corners @ np.sum(pulls, axis=0)
    scores = [root.T @ (pull + mine @ step) for mine, pull in zip(own, pulls, strict=True)]
    spread, inflation = _spread(white, scores)
    return ViewCovariance(by_corners, root @ spread @ root.T, inflation, step)


def _without_pose(
    block: Block, inside: BoolArray, scale: float, shared: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return one view's information (S, S) on the shared parameters, and its score (S,)."""
    n = len(block.columns)
    equations = normal_equations(n, [replace(block, columns=np.arange(n))], [inside], [scale])
    place = {int(column): i for i, column in enumerate(shared)}
    mine = np.array([i for i, c in enumerate(block.columns) if int(c) in place], np.int64)
    pose = np.setdiff1d(np.arange(n), mine)
    cross = equations.information[np.ix_(mine, pose)]
    by_pose = cross @ inverse(equations.information[np.ix_(pose, pose)])
    rows = np.array([place[int(c)] for c in block.columns[mine]], np.int64)
    information, pull = np.zeros((len(shared), len(shared))), np.zeros(len(shared))
    information[np.ix_(rows, rows)] = equations.information[np.ix_(mine, mine)] - by_pose @ cross.T
    pull[rows] = equations.gradient[mine] - by_pose @ equations.gradient[pose]
    return information, pull


def _root(covariance: FloatArray) -> FloatArray:
    """Return R with R R' = covariance, for units of any size."""
    sigma = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(sigma, sigma))
    root: FloatArray = sigma[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def _spread(own: Sequence[FloatArray], scores: Sequence[FloatArray]) -> tuple[FloatArray, float]:
    """Return the covariance (S, S) of the parameters in units of that by corners, and its mean.

    `own`, each (S, S): information of each view; they add up to the unit matrix. `scores`, each
    (S,): of covariance own (1 - own) if the errors of corners are independent.
    """
    n, size = len(own), len(own[0])
    corrected, expected = np.zeros((n, size)), 0.0
    # A view with more than this share of the information on a combination has no other view to be
    # compared with there.
    lone_share = 0.999
    for i, (information, score) in enumerate(zip(own, scores, strict=True)):
        values, vectors = np.linalg.eigh(information)
        values = np.clip(values, 0.0, 1.0)
        alone = values > lone_share
        factor = np.where(alone, 0.0, 1.0 / np.sqrt(np.maximum(1.0 - values, 1.0 - lone_share)))
        corrected[i] = vectors @ (factor * (vectors.T @ score))
        expected += float(values[~alone].sum())
    if expected <= 0.0:
        return np.eye(size), 1.0
    sandwich = corrected.T @ corrected
    inflation = float(np.trace(sandwich)) / expected
    values, vectors = np.linalg.eigh(_shrunk(corrected, sandwich, inflation))
    # Few views determine their own scatter badly: a ratio to it has Student's distribution, whose
    # variance is larger. The noise of corners is known from many, and is present in any case.
    shares = np.einsum("sk,nst,tk->nk", vectors, np.array(own), vectors)
    # Student's distribution has a variance from three views on; fewer count as this number.
    min_views = 3.0
    effective = np.maximum(np.sum(shares, axis=0) ** 2 / np.sum(shares**2, axis=0), min_views)
    students = effective / (effective - 2.0)
    values = 1.0 + students * np.maximum(values - 1.0, 0.0)
    return (vectors * values) @ vectors.T, inflation


def _shrunk(corrected: FloatArray, sandwich: FloatArray, inflation: float) -> FloatArray:
    """Shrink the sandwich towards a multiple of the unit matrix, by its own uncertainty."""
    n, size = corrected.shape
    target = inflation * np.eye(size)
    outer = corrected[:, :, None] * corrected[:, None, :]
    uncertain = float(np.sum(np.square(outer - sandwich / n)))
    apart = float(np.sum(np.square(sandwich - target)))
    share = min(uncertain / apart, 1.0) if apart > 0.0 else 1.0
    return share * target + (1.0 - share) * sandwich
