"""Covariance of what all views share, estimated from how the views disagree.

Errors of corners that are common to a view (the board bends, the camera moves during the exposure,
a rolling shutter) leave residuals that vary smoothly over the picture. A covariance that counts
every corner as independent is then too small. Each view's pull on the shared parameters is taken as
one observation instead: the cluster-robust "sandwich" (Liang & Zeger 1986,
doi:10.1093/biomet/73.1.13), with the bias correction CR2 for views of unequal leverage (Bell &
McCaffrey 2002, Survey Methodology 28, 169-181). A few views tell many parameters' covariance badly;
it is shrunk towards a multiple of the corners' (Ledoit & Wolf 2004,
doi:10.1016/S0047-259X(03)00096-4).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from aqualvs.calibration.blocks import Block, normal_equations
from aqualvs.calibration.bundle import Bundle, BundleState
from aqualvs.calibration.least_squares import Solution, inverse
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray

# A view that determines a combination by itself to more than this share has nothing to be compared
# with there.
_ALONE = 0.999
# Student's distribution has a variance from three views on; fewer are taken as so many.
_FEWEST_VIEWS = 3.0


@dataclass(frozen=True, slots=True)
class ViewCovariance:
    """Covariance of the shared parameters, by corners and by views.

    Attributes
    ----------
    by_corners : array, shape (S, S)
        As if the errors of all corners were independent.
    by_views : array, shape (S, S)
        From the disagreement of the views; nowhere smaller than `by_corners`.
    inflation : float
        How many times larger the variance by views is, over all combinations; 1 if the corners'
        errors are independent, and by chance below.
    step : array, shape (S,)
        What one Gauss-Newton step would add to the parameters; zero at the solution. The
        disagreement of the views is that after this step.
    """

    by_corners: FloatArray
    by_views: FloatArray
    inflation: float
    step: FloatArray


def shared_covariance(bundle: Bundle, solution: Solution[BundleState]) -> ViewCovariance:
    """Estimate the covariance of what the views of a bundle share, see `view_covariance`.

    Parameters
    ----------
    bundle : Bundle
        Without priors, and with free poses of which nothing is known.
    solution : Solution
        Of it; columns beyond those of the bundle are shared, too, and come last.
    """
    n = len(bundle.views)
    beyond = np.arange(bundle.n_parameters, len(solution.covariance))
    shared = np.concatenate([np.arange(bundle.n_shared), beyond])
    return view_covariance(
        solution.blocks[:n], solution.inliers[:n], solution.block_scales[:n], shared
    )


def view_covariance(
    blocks: Sequence[Block],
    inliers: Sequence[BoolArray],
    scales: Sequence[float],
    shared: IntArray,
) -> ViewCovariance:
    """Estimate the covariance of shared parameters from views with a pose each.

    Parameters
    ----------
    blocks : sequence of Block
        One for each view, at the solution or near it. Columns that are not shared
        belong to its pose alone.
    inliers : sequence of bool array, shape (N,)
        Corners that were believed.
    scales : sequence of float
        Noise of each view as a multiple of the nominal one.
    shared : int array, shape (S,)
        Columns of the parameters that all views share.

    Raises
    ------
    CalibrationError
        If the views say nothing at all about one of the parameters.
    """
    own, pulls = [], []
    for block, inside, scale in zip(blocks, inliers, scales, strict=True):
        information, pull = _without_pose(block, inside, scale, shared)
        own.append(information)
        pulls.append(pull)
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
    """Return what one view says (S, S) of the shared parameters, and its pull (S,) on them."""
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

    Parameters
    ----------
    own : sequence of array, shape (S, S)
        What each view says; they add up to the unit matrix.
    scores : sequence of array, shape (S,)
        Its pull; of covariance own (1 - own) if the errors of corners are independent.
    """
    n, size = len(own), len(own[0])
    corrected, expected = np.zeros((n, size)), 0.0
    for i, (information, score) in enumerate(zip(own, scores, strict=True)):
        values, vectors = np.linalg.eigh(information)
        values = np.clip(values, 0.0, 1.0)
        alone = values > _ALONE
        factor = np.where(alone, 0.0, 1.0 / np.sqrt(np.maximum(1.0 - values, 1.0 - _ALONE)))
        corrected[i] = vectors @ (factor * (vectors.T @ score))
        expected += float(values[~alone].sum())
    if expected <= 0.0:
        return np.eye(size), 1.0
    sandwich = corrected.T @ corrected
    inflation = float(np.trace(sandwich)) / expected
    values, vectors = np.linalg.eigh(_shrunk(corrected, sandwich, inflation))
    # Few views tell their own scatter badly: a ratio to it is Student's, of a variance so much
    # larger. Corners' own noise is known from many, and is there in any case.
    shares = np.einsum("sk,nst,tk->nk", vectors, np.array(own), vectors)
    effective = np.maximum(np.sum(shares, axis=0) ** 2 / np.sum(shares**2, axis=0), _FEWEST_VIEWS)
    students = effective / (effective - 2.0)
    values = 1.0 + students * np.maximum(values - 1.0, 0.0)
    return (vectors * values) @ vectors.T, inflation


def _shrunk(corrected: FloatArray, sandwich: FloatArray, inflation: float) -> FloatArray:
    """Shrink the sandwich towards a multiple of one, by how uncertain it is itself."""
    n, size = corrected.shape
    target = inflation * np.eye(size)
    outer = corrected[:, :, None] * corrected[:, None, :]
    uncertain = float(np.sum(np.square(outer - sandwich / n)))
    apart = float(np.sum(np.square(sandwich - target)))
    share = min(uncertain / apart, 1.0) if apart > 0.0 else 1.0
    return share * target + (1.0 - share) * sandwich
