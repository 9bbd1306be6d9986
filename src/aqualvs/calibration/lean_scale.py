"""How well boards were set up square to the rail, as the boards themselves tell.

Most boards of a rail stand square, some lean by a degree or more. How closely the good ones agree
is not known beforehand: it is estimated by likelihood, on a ladder of scales.
"""

import numpy as np

from aqualvs.calibration.bundle import BundleState
from aqualvs.calibration.dome_problem import DomeProblem
from aqualvs.calibration.least_squares import Solution, solve
from aqualvs.calibration.pose_terms import TILTS

# Nobody sets up boards better than this: 0.9 mm a metre.
_FINEST = float(np.deg2rad(0.05))
_STEP = 0.5
# A finer scale must explain the boards so much better (natural logarithm): odds of 20 to 1.
_EVIDENCE = 3.0


def with_leaning_as_found(
    problem: DomeProblem, solution: Solution[BundleState], sigma: float
) -> tuple[DomeProblem, Solution[BundleState]]:
    """Solve with a finer scale of leaning as long as boards agree that closely.

    Parameters
    ----------
    problem, solution
        Solved with `sigma`.
    sigma : float
        Scale of leaning, in radians.

    Returns
    -------
    problem, solution
        The same, where boards do not agree better, or nothing is known of their poses.
    """
    while sigma * _STEP >= _FINEST * (1.0 - 1e-9):
        finer = problem.with_lean_sigma(sigma * _STEP)
        trial = solve(finer.bundle, solution.state)
        gain = _misfit(solution, sigma) - _misfit(trial, sigma * _STEP)
        if not (trial.converged and gain > _EVIDENCE):
            break
        problem, solution, sigma = finer, trial, sigma * _STEP
    return problem, solution


def _misfit(solution: Solution[BundleState], sigma: float) -> float:
    """Negative log likelihood of two-dimensional Cauchy leaning, but for a constant."""
    leaning = [block.residuals[0] for block in solution.blocks if block.group == TILTS]
    if not leaning:
        return 0.0
    squares = np.sum(np.square(leaning), axis=1)
    return float(1.5 * np.sum(np.log1p(squares)) + 2.0 * len(leaning) * np.log(sigma))
