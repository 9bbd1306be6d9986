"""Robust non-linear least squares over blocks of residuals, with an estimated covariance.

Levenberg-Marquardt on the normal equations (Marquardt 1963, doi:10.1137/0111030), made robust by
iteratively reweighted least squares (Huber 1964, doi:10.1214/aoms/1177703732). A loss is a function
of the length of an observation's residual in standard deviations (`RobustLoss`).

The noise of each block (`Block`) is estimated from its residuals, shrunk towards the noise of its
group; the covariance follows from that estimate, not from the nominal noise.
"""

import contextlib
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from scipy.special import gammaincinv

from aqualvs.errors import CalibrationError, RigError
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray

# Few good residuals exceed this, so that the estimate stays efficient; outliers count linearly.
_HUBER = 3.0
# The estimate is 95 % efficient on normal errors (Holland & Welsch 1977,
# doi:10.1080/03610927708827533), and its covariance follows from the weights.
_CAUCHY = 2.385


class RobustLoss(StrEnum):
    """Loss function of the length of a residual."""

    SQUARE = "square"
    """As its square: for priors."""
    HUBER = "huber"
    """As its square up to three standard deviations, linearly beyond: for measurements."""
    CAUCHY = "cauchy"
    """Logarithmically beyond about two: if a large part of the data has another distribution."""

    def cost(self, lengths: FloatArray) -> FloatArray:
        """Return the loss of residuals (N,), half the square for short ones."""
        square: FloatArray = 0.5 * lengths**2
        if self is RobustLoss.HUBER:
            return np.where(lengths <= _HUBER, square, _HUBER * (lengths - 0.5 * _HUBER))
        if self is RobustLoss.CAUCHY:
            return 0.5 * _CAUCHY**2 * np.log1p((lengths / _CAUCHY) ** 2)
        return square

    def weight(self, lengths: FloatArray) -> FloatArray:
        """Return d cost / d length over length, the weight of iterative reweighting."""
        if self is RobustLoss.HUBER:
            return np.where(lengths <= _HUBER, 1.0, _HUBER / np.maximum(lengths, _HUBER))
        if self is RobustLoss.CAUCHY:
            return 1.0 / (1.0 + (lengths / _CAUCHY) ** 2)
        return np.ones_like(lengths)


@dataclass(frozen=True, slots=True)
class Block:
    """Residuals that depend on the same parameters."""

    group: str  # Measurements of one group are of one kind, with much the same noise.
    columns: IntArray  # Shape (C,): parameters these residuals depend on.
    # Shape (N, K): measured minus predicted, or its negative, over its nominal standard deviation.
    # K values belong to one observation, such as x and y of a corner. NaN rows are not seen.
    residuals: FloatArray
    # Shape (N, K, C): derivative of `residuals`.
    jacobian: FloatArray
    # Loss of the length of an observation's residual.
    loss: RobustLoss = RobustLoss.HUBER
    # Whether the noise is estimated, as a multiple of the nominal one; for priors it is not.
    scaled: bool = True

    lengths: FloatArray = field(init=False, repr=False, compare=False)
    """Lengths (N,) of the observations' residuals."""

    def __post_init__(self) -> None:
        squares = np.einsum("nk,nk->n", self.residuals, self.residuals)
        object.__setattr__(self, "lengths", np.sqrt(squares))

    @property
    def seen(self) -> BoolArray:
        """Mask (N,) of observations that have a residual."""
        return np.isfinite(self.lengths)

    def values(self, inliers: BoolArray) -> int:
        """Return the number of values in the marked observations."""
        n_values: int = self.residuals.shape[1]
        return int(np.count_nonzero(inliers)) * n_values


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """Normal equations of Gauss-Newton at one state."""

    information: FloatArray  # Shape (P, P).
    gradient: FloatArray  # Shape (P,).
    # Shape (C, C): every block's part of `information`, in its own columns.
    own: tuple[FloatArray, ...]


def normal_equations(
    n_parameters: int,
    blocks: Sequence[Block],
    inliers: Sequence[BoolArray],
    scales: Sequence[float],
) -> NormalEquations:
    """Return the normal equations of blocks with their inliers and noise scales."""
    information, gradient = np.zeros((n_parameters, n_parameters)), np.zeros(n_parameters)
    own = []
    for block, inside, scale in zip(blocks, inliers, scales, strict=True):
        weights = block.loss.weight(block.lengths / scale)
        # A point that a step made invisible has no derivative.
        believed = inside & np.isfinite(weights)
        residuals, jacobian = block.residuals, block.jacobian
        if not believed.all():
            weights, residuals = weights[believed], residuals[believed]
            jacobian = jacobian[believed]
        root = np.repeat(np.sqrt(weights) / scale, residuals.shape[1])
        slopes = jacobian.reshape(-1, len(block.columns)) * root[:, None]
        own.append(slopes.T @ slopes)
        information[block.columns[:, None], block.columns] += own[-1]
        gradient[block.columns] += slopes.T @ (residuals.reshape(-1) * root)
    return NormalEquations(information, gradient, tuple(own))


def cost(
    blocks: Sequence[Block],
    inliers: Sequence[BoolArray],
    scales: Sequence[float],
    lost_length: float,
) -> float:
    """Return the robust cost; inliers that are no longer seen count as `lost_length`."""
    total = 0.0
    for block, inside, scale in zip(blocks, inliers, scales, strict=True):
        lengths = block.lengths[inside] / scale
        lost = ~np.isfinite(lengths)
        if lost.any():
            lengths[lost] = lost_length
        total += float(np.sum(block.loss.cost(lengths)))
    return total


# Least scale, for data without noise.
_TINY = 1e-6
# Least number of degrees of freedom for an estimate of the noise.
_MIN_FREEDOM = 0.5


def _believed(
    blocks: Sequence[Block], scales: Sequence[float], largest: Sequence[float]
) -> list[BoolArray]:
    """Return the inliers of every block."""
    # Residuals longer than this, in scales, are outliers: 4e-6 of good corners.
    reject = 5.0
    return [
        # NaN compares false.
        block.lengths < reject * min(scale, limit) if block.scaled else block.seen
        for block, scale, limit in zip(blocks, scales, largest, strict=True)
    ]


def _group_scales(
    blocks: Sequence[Block],
    inliers: Sequence[BoolArray],
    scales: Sequence[float],
    freedom: Sequence[float],
    largest: Sequence[float],
) -> dict[str, float]:
    """Return the typical scale of every group: the median of its blocks' own scales.

    Blocks are weighted by their degrees of freedom. A few bad ones do not count.
    """
    typical = {}
    for group in {b.group for b in blocks if b.scaled}:
        mine = [i for i, b in enumerate(blocks) if b.scaled and b.group == group]
        useful = [i for i in mine if freedom[i] > _MIN_FREEDOM]
        if not useful:
            typical[group] = scales[mine[0]]
            continue
        by_itself = [_squares(blocks[i], inliers[i], scales[i]) / freedom[i] for i in useful]
        weights = np.array([freedom[i] for i in useful])
        scale = float(np.sqrt(_weighted_median(np.array(by_itself), weights)))
        limit = _weighted_median(np.array([largest[i] for i in useful]), weights)
        typical[group] = max(min(scale, limit), _TINY)
    return typical


def _block_scales(
    blocks: Sequence[Block],
    inliers: Sequence[BoolArray],
    scales: Sequence[float],
    freedom: Sequence[float],
    largest: Sequence[float],
    typical: dict[str, float],
) -> list[float]:
    """Return the scale of every block: from its own residuals, shrunk towards its group's."""
    found = []
    # Weight of the group's noise in that of a block, as a number of values.
    group_freedom = 10.0
    each = zip(blocks, inliers, scales, freedom, largest, strict=True)
    for block, inside, scale, free, limit in each:
        if not block.scaled:
            found.append(1.0)
            continue
        prior = typical[block.group]
        squares = _squares(block, inside, scale) + group_freedom * prior**2
        tempered = float(np.sqrt(squares / (max(free, 0.0) + group_freedom)))
        found.append(min(tempered, max(limit, prior)))
    return found


def _largest_scale(block: Block, freedom: float) -> float:
    """Return the upper limit of a block's scale from the median of its residuals.

    Many outliers would raise the scale that accepts them; the limit prevents that. Blocks that are
    not scaled have none.
    """
    values = block.values(block.seen)
    if not block.scaled or freedom <= _MIN_FREEDOM or not values:
        return float("inf")
    # Factor by which the median's scale may be too small by chance.
    doubt = 1.5
    return doubt * _median_scale([block]) * float(np.sqrt(values / freedom))


def _squares(block: Block, inliers: BoolArray, scale: float) -> float:
    lengths = block.lengths[inliers]
    return float(np.sum(block.loss.weight(lengths / scale) * lengths**2))


def _median_scale(blocks: Sequence[Block]) -> float:
    lengths = np.concatenate([b.lengths for b in blocks])
    lengths = lengths[np.isfinite(lengths)]
    if not len(lengths):
        return 1.0
    return max(float(np.median(lengths)) / _median_length(blocks[0].residuals.shape[1]), _TINY)


@functools.cache
def _median_length(n_values: int) -> float:
    """Return the median length of a vector of values with unit noise, that of chi."""
    return float(np.sqrt(2.0 * gammaincinv(0.5 * n_values, 0.5)))


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
    order = np.argsort(values)
    heaped = np.cumsum(weights[order])
    return float(np.interp(0.5 * heaped[-1], heaped - 0.5 * weights[order], values[order]))


class _DescentOptions(NamedTuple):
    """Damping of the steps (Levenberg-Marquardt), and convergence."""

    damping_start: float = 1e-4
    damping_least: float = 1e-12
    damping_limit: float = 1e10
    # Damping up to which a step is almost Newton's.
    free: float = 1e-2
    # Convergence: steps shorter than this, in sigmas, or a relative decrease of the cost below
    # rounding. The noise can be estimated before that.
    small_step: float = 2e-2
    small_fall: float = 1e-10
    near: float = 0.5


_DESCENT = _DescentOptions()


State = TypeVar("State")


class FreeParameterError(CalibrationError):
    """Error: neither measurements nor priors determine a parameter."""

    def __init__(self, parameter: int) -> None:
        super().__init__(
            f"parameter {parameter} of the solve is entirely free: no picture says anything about "
            "it; take more pictures, from other distances and angles"
        )
        self.parameter = parameter  # Its index in the problem.


class Problem(Protocol[State]):
    """A least-squares problem: residuals of a state, and steps of a state."""

    @property
    def n_parameters(self) -> int:
        """Length of a step."""

    def blocks(self, state: State) -> Sequence[Block]:
        """Return the residuals of a state; always the same blocks with as many rows."""

    def moved(self, state: State, step: FloatArray) -> State:
        """Return the state moved by a step (P,).

        Raises RigError, as may `blocks`, if such a state cannot exist.
        """


@dataclass(frozen=True, slots=True)
class Solution(Generic[State]):
    """Result of a solve."""

    state: State  # The solution.
    blocks: tuple[Block, ...]  # Residuals there.
    inliers: tuple[BoolArray, ...]  # Shape (N,): for every block, the mask of inlier observations.
    block_scales: tuple[float, ...]  # For every block, its noise as a multiple of the nominal one.
    scales: dict[str, float]  # The typical noise of every group whose noise was estimated.
    information: FloatArray  # Shape (P, P): of data and priors together, at the estimated noise.
    covariance: FloatArray  # Shape (P, P): inverse of `information`.
    converged: bool
    n_iterations: int


def solve(
    problem: Problem[State], start: State, *, remedy: Callable[[int], str] | None = None
) -> Solution[State]:
    """Minimise the residuals of a problem, without observations beyond five scales.

    `start` is near enough to the solution for Newton's method; `remedy` gives the message, with
    the remedy, for a parameter that is not determined. Raises `CalibrationError` if there is such a
    parameter, or nothing can be seen from the start.
    """
    max_rounds = 20
    try:
        run = _Run(problem, start)
        run.descend(_DESCENT.near)
        for _ in range(max_rounds):
            if not run.rescale():
                break
            run.descend(_DESCENT.near)
        run.descend(_DESCENT.small_step)
        return run.solution()
    except FreeParameterError as fault:
        if remedy is None:
            raise
        raise CalibrationError(remedy(fault.parameter)) from fault


def inverse(information: FloatArray) -> FloatArray:
    """Invert a positive semidefinite matrix whose units differ by many orders of magnitude.

    Combinations known to rounding only get a variance that is huge, but finite. Raises
    `CalibrationError` if one of the parameters is not determined at all.
    """
    if not len(information):
        return information
    size = _sizes(information)
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    # Relative information below which a combination is known to rounding only.
    rank = 1e-13
    values = np.maximum(values, rank * values[-1])
    inverted: FloatArray = (vectors / values) @ vectors.T / np.outer(size, size)
    return inverted


@dataclass(slots=True)
class _Run(Generic[State]):
    """State of a running solve."""

    problem: Problem[State]
    state: State
    blocks: tuple[Block, ...] = ()
    inliers: list[BoolArray] = field(default_factory=list)
    scales: list[float] = field(default_factory=list)
    typical: dict[str, float] = field(default_factory=dict)
    damping: float = _DESCENT.damping_start
    converged: bool = False
    n_iterations: int = 0

    def __post_init__(self) -> None:
        self.blocks = tuple(self.problem.blocks(self.state))
        self.inliers = [b.seen for b in self.blocks]
        if not any(seen.any() for seen in self.inliers):
            raise CalibrationError(
                "no point can be seen from the starting values; check the rig's lens and dome"
            )
        # The median of a group's residuals is robust to outliers.
        scaled = [b for b in self.blocks if b.scaled]
        groups = {b.group for b in scaled}
        scale = {g: _median_scale([b for b in scaled if b.group == g]) for g in groups}
        self.scales = [scale[b.group] if b.scaled else 1.0 for b in self.blocks]

    def descend(self, small_step: float) -> None:
        """Iterate towards the minimum at the present scales and inliers, until steps are small."""
        self.converged = not self.problem.n_parameters
        # Where an earlier descent ended, rounding may have raised it.
        self.damping = min(self.damping, _DESCENT.damping_start)
        here = self._cost(self.blocks)
        max_iterations = 60
        for _ in range(max_iterations):
            if self.converged:
                return
            equations = self._equations()
            # A damped step is always short: it is no sign of convergence.
            free = self.damping <= _DESCENT.free
            step = self._damped_step(equations)
            in_sigmas = float(np.sqrt(step @ equations.information @ step))
            there = self._lower(equations, step, here)
            if there is None:
                # No decrease beyond rounding: the remaining gradient means nothing.
                self.damping, self.converged = _DESCENT.damping_start, True
                return
            little = here - there <= _DESCENT.small_fall * here and in_sigmas < 1.0
            self.converged = free and (in_sigmas < small_step or little)
            here = there

    def rescale(self) -> bool:
        """Estimate noise and outliers anew; return whether that moves the minimum."""
        before = self.scales, self.inliers
        equations = self._equations()
        covariance = inverse(equations.information)
        # Residual degrees of freedom of every block.
        freedom = [
            b.values(inside) - float(np.sum(own * covariance[b.columns[:, None], b.columns]))
            for b, inside, own in zip(self.blocks, self.inliers, equations.own, strict=True)
        ]
        largest = [_largest_scale(*pair) for pair in zip(self.blocks, freedom, strict=True)]
        self.inliers = _believed(self.blocks, self.scales, largest)
        now = self.blocks, self.inliers, self.scales, freedom, largest
        self.typical = _group_scales(*now)
        self.scales = _block_scales(*now, self.typical)
        same = all(np.array_equal(a, b) for a, b in zip(before[1], self.inliers, strict=True))
        # Relative change of a noise scale that does not affect the solution.
        same_scale = 5e-3
        return not (same and np.allclose(self.scales, before[0], rtol=same_scale, atol=0.0))

    def solution(self) -> Solution[State]:
        """Return the result."""
        information = self._equations().information
        return Solution(
            state=self.state,
            blocks=self.blocks,
            inliers=tuple(self.inliers),
            block_scales=tuple(self.scales),
            scales=self.typical,
            information=information,
            covariance=inverse(information),
            converged=self.converged,
            n_iterations=self.n_iterations,
        )

    def _damped_step(self, equations: NormalEquations) -> FloatArray:
        diagonal = np.diag(equations.information)
        damped = equations.information + np.diag(self.damping * diagonal)
        size = _sizes(damped)
        return np.linalg.solve(damped / np.outer(size, size), -equations.gradient / size) / size

    def _lower(self, equations: NormalEquations, step: FloatArray, here: float) -> float | None:
        """Take the step, or a shorter one that does not raise the cost; return the cost there.

        None if there is no such step.
        """
        while self.damping < _DESCENT.damping_limit:
            self.n_iterations += 1
            # A step may lead to what cannot exist.
            with contextlib.suppress(RigError):
                state = self.problem.moved(self.state, step)
                blocks = tuple(self.problem.blocks(state))
                there = self._cost(blocks)
                if there <= here:
                    self.state, self.blocks = state, blocks
                    self.damping = max(self.damping * 0.1, _DESCENT.damping_least)
                    return there
            self.damping *= 10.0
            step = self._damped_step(equations)
        return None

    def _cost(self, blocks: Sequence[Block]) -> float:
        # Residual, in sigmas, that stands for an observation that a step makes invisible.
        lost = 1e3
        return cost(blocks, self.inliers, self.scales, lost)

    def _equations(self) -> NormalEquations:
        return normal_equations(self.problem.n_parameters, self.blocks, self.inliers, self.scales)


def _sizes(information: FloatArray) -> FloatArray:
    size: FloatArray = np.sqrt(np.diag(information))
    if not np.all(size > 0.0):
        raise FreeParameterError(int(np.argmin(size)))
    return size
