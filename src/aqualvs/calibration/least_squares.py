"""Robust non-linear least squares over blocks of residuals, with an honest covariance.

Levenberg-Marquardt on the normal equations (Marquardt 1963, doi:10.1137/0111030), robust by
iterated reweighting (Huber 1964, doi:10.1214/aoms/1177703732). The noise of measurements is
estimated from their residuals, and the covariance rests on that, not on a promise.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

import numpy as np

from aqualvs.calibration import noise
from aqualvs.calibration.blocks import Block, NormalEquations, cost, normal_equations
from aqualvs.errors import CalibrationError, RigError
from aqualvs.geometry.arrays import BoolArray, FloatArray

__all__ = [
    "Block",
    "FreeParameterError",
    "Problem",
    "Solution",
    "information_of",
    "inverse",
    "solve",
]

_MAX_ROUNDS = 20
_MAX_ITERATIONS = 60
_DAMPING_START, _DAMPING_LEAST, _DAMPING_LIMIT, _FREE = 1e-4, 1e-12, 1e10, 1e-3
# Steps shorter than this, in sigmas, leave nothing to gain; so does a relative fall of the cost
# below rounding. Noise can be told from nearby.
_SMALL_STEP, _SMALL_FALL, _NEAR = 2e-2, 1e-10, 0.5
# Relative change of a noise scale that the solution does not feel.
_SAME_SCALE = 5e-3
# An observation that a step makes invisible costs as much as one that is so many sigmas off.
_LOST = 1e3
# Combinations known worse than this, relative to the best known one, are known to rounding only.
_RANK = 1e-13

State = TypeVar("State")


class FreeParameterError(CalibrationError):
    """A parameter that neither measurements nor priors say anything about.

    Attributes
    ----------
    parameter : int
        Its place among those of the problem.
    """

    def __init__(self, parameter: int) -> None:
        super().__init__(
            f"parameter {parameter} of the solve is entirely free: no picture says anything about "
            "it; take more pictures, from other distances and angles"
        )
        self.parameter = parameter


class Problem(Protocol[State]):
    """What is solved: residuals of a state, and how a state moves."""

    @property
    def n_parameters(self) -> int:
        """Length of a step."""

    def blocks(self, state: State) -> Sequence[Block]:
        """Return the residuals of a state; always the same blocks with as many rows."""

    def moved(self, state: State, step: FloatArray) -> State:
        """Return the state moved by a step (P,).

        A RigError, here or in `blocks`, says that such a state cannot exist.
        """


@dataclass(frozen=True, slots=True)
class Solution(Generic[State]):
    """What a solve found.

    Attributes
    ----------
    state : State
        The solution.
    blocks : tuple of Block
        Residuals there.
    inliers : tuple of bool array, shape (N,)
        For every block, the observations that were believed.
    block_scales : tuple of float
        For every block, its noise as a multiple of the nominal one.
    scales : dict
        The typical noise of every group of which noise was estimated.
    information : array, shape (P, P)
        Of data and priors together, by the estimated noise.
    covariance : array, shape (P, P)
        Inverse of `information`.
    cost : float
        What was minimised, at the estimated noise.
    converged : bool
    n_iterations : int
    """

    state: State
    blocks: tuple[Block, ...]
    inliers: tuple[BoolArray, ...]
    block_scales: tuple[float, ...]
    scales: dict[str, float]
    information: FloatArray
    covariance: FloatArray
    cost: float
    converged: bool
    n_iterations: int


def solve(
    problem: Problem[State],
    start: State,
    *,
    reject: bool = True,
    remedy: Callable[[int], str] | None = None,
) -> Solution[State]:
    """Minimise the residuals of a problem.

    Parameters
    ----------
    problem : Problem
        What is solved.
    start : State
        Near enough to the solution for Newton's method.
    reject : bool
        Whether observations beyond five scales are left out.
    remedy : callable, optional
        Gives the message, with what the user should do, for a parameter that nothing is known of.

    Returns
    -------
    Solution

    Raises
    ------
    CalibrationError
        If nothing is known about one of the parameters, or nothing can be seen from the start.
    """
    try:
        return _solved(_Run(problem, start, reject))
    except FreeParameterError as fault:
        if remedy is None:
            raise
        raise CalibrationError(remedy(fault.parameter)) from fault


def _solved(run: "_Run[State]") -> Solution[State]:
    run.descend(_NEAR)
    for _ in range(_MAX_ROUNDS):
        if not run.rescale():
            break
        run.descend(_NEAR)
    run.descend(_SMALL_STEP)
    return run.solution()


def information_of(
    solution: Solution[State], n_parameters: int, wanted: Callable[[Block], bool]
) -> FloatArray:
    """Return the part of a solution's information (P, P) that some of its blocks bring."""
    chosen = [i for i, block in enumerate(solution.blocks) if wanted(block)]
    return normal_equations(
        n_parameters,
        [solution.blocks[i] for i in chosen],
        [solution.inliers[i] for i in chosen],
        [solution.block_scales[i] for i in chosen],
    ).information


def inverse(information: FloatArray) -> FloatArray:
    """Invert a positive semidefinite matrix whose units differ by many orders of magnitude.

    Combinations known to rounding only get a variance that is huge, but finite.

    Raises
    ------
    CalibrationError
        If nothing at all is known about one of the parameters.
    """
    if not len(information):
        return information
    size = _sizes(information)
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    values = np.maximum(values, _RANK * values[-1])
    inverted: FloatArray = (vectors / values) @ vectors.T / np.outer(size, size)
    return inverted


@dataclass(slots=True)
class _Run(Generic[State]):
    """A solve under way."""

    problem: Problem[State]
    state: State
    reject: bool
    blocks: tuple[Block, ...] = ()
    inliers: list[BoolArray] = field(default_factory=list)
    scales: list[float] = field(default_factory=list)
    typical: dict[str, float] = field(default_factory=dict)
    damping: float = _DAMPING_START
    converged: bool = False
    n_iterations: int = 0

    def __post_init__(self) -> None:
        self.blocks = tuple(self.problem.blocks(self.state))
        self.inliers = [b.seen for b in self.blocks]
        if not any(seen.any() for seen in self.inliers):
            raise CalibrationError(
                "no point can be seen from the starting values; check the rig's lens and dome"
            )
        self.scales = noise.start_scales(self.blocks)

    def descend(self, small_step: float) -> None:
        """Go down towards the minimum at the present scales and inliers, until steps are small."""
        self.converged = not self.problem.n_parameters
        here = self._cost(self.blocks)
        for _ in range(_MAX_ITERATIONS):
            if self.converged:
                return
            equations = self._equations()
            there, step = self._lower(equations, here)
            in_sigmas = float(np.sqrt(step @ equations.information @ step))
            little = here - there <= _SMALL_FALL * here and in_sigmas < 1.0
            # A damped step is short wherever it is taken.
            free = self.damping <= _FREE
            self.converged = free and (in_sigmas < small_step or little)
            here = there

    def rescale(self) -> bool:
        """Estimate noise and outliers anew; say whether the minimum moves by it."""
        before = self.scales, self.inliers
        equations = self._equations()
        freedom = noise.freedoms(
            self.blocks, self.inliers, equations, inverse(equations.information)
        )
        if self.reject:
            self.inliers = noise.believed(self.blocks, self.scales, freedom)
        self.typical = noise.group_scales(self.blocks, self.inliers, self.scales, freedom)
        self.scales = noise.block_scales(
            self.blocks, self.inliers, self.scales, freedom, self.typical
        )
        same = all(np.array_equal(a, b) for a, b in zip(before[1], self.inliers, strict=True))
        return not (same and np.allclose(self.scales, before[0], rtol=_SAME_SCALE, atol=0.0))

    def solution(self) -> Solution[State]:
        """Return what was found."""
        information = self._equations().information
        return Solution(
            state=self.state,
            blocks=self.blocks,
            inliers=tuple(self.inliers),
            block_scales=tuple(self.scales),
            scales=self.typical,
            information=information,
            covariance=inverse(information),
            cost=self._cost(self.blocks),
            converged=self.converged,
            n_iterations=self.n_iterations,
        )

    def _lower(self, equations: NormalEquations, here: float) -> tuple[float, FloatArray]:
        """Take one step down, as long as it may be; return the cost there and the step."""
        diagonal = np.diag(equations.information)
        while self.damping < _DAMPING_LIMIT:
            self.n_iterations += 1
            damped = equations.information + np.diag(self.damping * diagonal)
            step = _solve(damped, -equations.gradient)
            trial = self._try(step)
            if trial is not None and trial[2] <= here:
                self.state, self.blocks, there = trial
                self.damping = max(self.damping * 0.1, _DAMPING_LEAST)
                return there, step
            self.damping *= 10.0
        # Nowhere down, to rounding: what slope is left means nothing.
        self.damping = _DAMPING_START
        return here, np.zeros(self.problem.n_parameters)

    def _try(self, step: FloatArray) -> tuple[State, tuple[Block, ...], float] | None:
        try:
            state = self.problem.moved(self.state, step)
            blocks = tuple(self.problem.blocks(state))
        except RigError:
            return None
        return state, blocks, self._cost(blocks)

    def _cost(self, blocks: Sequence[Block]) -> float:
        return cost(blocks, self.inliers, self.scales, _LOST)

    def _equations(self) -> NormalEquations:
        return normal_equations(self.problem.n_parameters, self.blocks, self.inliers, self.scales)


def _solve(matrix: FloatArray, right: FloatArray) -> FloatArray:
    size = _sizes(matrix)
    solved: FloatArray = np.linalg.solve(matrix / np.outer(size, size), right / size) / size
    return solved


def _sizes(information: FloatArray) -> FloatArray:
    size: FloatArray = np.sqrt(np.diag(information))
    if not np.all(size > 0.0):
        raise FreeParameterError(int(np.argmin(size)))
    return size
