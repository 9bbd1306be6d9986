"""Covariance of a solve that took some numbers as they are, though they are not known exactly.

The "consider" covariance (Schmidt 1966, doi:10.1016/B978-1-4831-6716-9.50011-4): the errors of
numbers that were held pass into those that were solved for, through the slopes of both.
"""

from dataclasses import replace

import numpy as np

from aqualvs.calibration.blocks import normal_equations
from aqualvs.calibration.bundle import Bundle, BundleState
from aqualvs.calibration.least_squares import Solution
from aqualvs.calibration.rig_priors import PRIORS
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.uncertainty import RigUncertainty


def considered(
    bundle: Bundle, solution: Solution[BundleState], held: RigUncertainty
) -> tuple[tuple[str, ...], FloatArray]:
    """Return the joint covariance of what was solved for and of what was held.

    Parameters
    ----------
    bundle : Bundle
        The problem.
    solution : Solution
        Of it.
    held : RigUncertainty
        Of numbers that the bundle does not solve for.

    Returns
    -------
    names : tuple of str
        `bundle.free`, then those of `held`.
    covariance : array, shape (P + H, P + H)
        In the bundle's columns, then those of `held`.
    """
    if not held.names:
        return bundle.free, solution.covariance.copy()
    cross = _cross_information(bundle, solution, held.names)
    gain = -solution.covariance @ cross
    passed_on = gain @ held.covariance
    joint = np.block(
        [
            [solution.covariance + passed_on @ gain.T, passed_on],
            [passed_on.T, held.covariance],
        ]
    )
    return (*bundle.free, *held.names), joint


def _cross_information(
    bundle: Bundle, solution: Solution[BundleState], held: tuple[str, ...]
) -> FloatArray:
    """Return what the data say about solved and held numbers together, shape (P, H)."""
    wider = replace(bundle, free=(*bundle.free, *held))
    kept = [i for i, b in enumerate(solution.blocks) if b.group != PRIORS]
    # Priors stand at the end, so both problems begin with the same blocks.
    blocks = wider.blocks(solution.state)[: len(kept)]
    information = normal_equations(
        wider.n_parameters,
        blocks,
        [solution.inliers[i] for i in kept],
        [solution.block_scales[i] for i in kept],
    ).information
    n, m = len(bundle.free), len(held)
    solved = np.r_[0:n, n + m : wider.n_parameters]
    cross: FloatArray = information[np.ix_(solved, np.arange(n, n + m))]
    return cross
