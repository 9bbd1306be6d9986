"""A board that is not quite flat: its bend as parameters, where the views ask for it.

The board's surface is a polynomial of second, or second and third, degree over its corners, the
same in all views. Poses and lens take up a part of what a bent board does to the corners, so the
bend is solved together with them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import f as f_distribution

from aqualvs.calibration.blocks import Block
from aqualvs.calibration.bundle import Bundle, BundleState
from aqualvs.calibration.least_squares import Solution, solve
from aqualvs.calibration.view import View
from aqualvs.calibration.view_covariance import view_covariance
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import FloatArray, IntArray

BEND_DEGREES = (2, 3)
"""Degrees of a bend's polynomial, each with the terms of those before it."""
# Exponents of x and y in each term, by degree.
_TERMS = {2: ((2, 0), (1, 1), (0, 2)), 3: ((3, 0), (2, 1), (1, 2), (0, 3))}
# A flat board passes for bent in one calibration of so many.
_CHANCE = 1e-3
# Views beyond the number of terms, from which on their scatter can be told.
_SPARE_VIEWS = 3


@dataclass(frozen=True, slots=True)
class BoardBend:
    """A board's surface: z = sum of coefficient times x^i y^j, beside a plane.

    Attributes
    ----------
    centre : array, shape (2,)
        Where x and y count from, in `board`, metres.
    half_size : float
        What they are counted in, in metres: half of the corners' longer extent.
    exponents : tuple of (int, int)
        i and j of every term.
    coefficients : array, shape (K,)
        In metres.
    """

    centre: FloatArray
    half_size: float
    exponents: tuple[tuple[int, int], ...]
    coefficients: FloatArray

    @classmethod
    def flat(cls, views: Sequence[View], degree: int) -> "BoardBend":
        """Return a flat surface over the corners of views, with terms up to a degree."""
        points = np.concatenate([view.points[:, :2] for view in views])
        low, high = points.min(axis=0), points.max(axis=0)
        terms = tuple(term for d in range(2, degree + 1) for term in _TERMS[d])
        half = 0.5 * float((high - low).max())
        return cls(0.5 * (low + high), half, terms, np.zeros(len(terms)))

    def terms_at(self, points: FloatArray) -> FloatArray:
        """Return the terms (N, K) at points (N, 3) of the board, without their coefficients."""
        x, y = (points[:, :2] - self.centre).T / self.half_size
        terms: FloatArray = np.stack([x**i * y**j for i, j in self.exponents], axis=-1)
        return terms

    def applied(self, view: View) -> View:
        """Return a view of the flat board with its points on the bent one."""
        points = view.points.copy()
        points[:, 2] += self.terms_at(view.points) @ self.coefficients
        return replace(view, points=points)

    def height(self, views: Sequence[View]) -> float:
        """Return how far apart the highest and the lowest corner are, from the best plane, metres.

        Parameters
        ----------
        views : sequence of View
            Of the flat board.
        """
        points = np.unique(np.concatenate([view.points for view in views]), axis=0)
        z = self.terms_at(points) @ self.coefficients
        plane = np.column_stack([points[:, :2], np.ones(len(points))])
        off = z - plane @ np.linalg.lstsq(plane, z, rcond=None)[0]
        return float(np.ptp(off))


@dataclass(frozen=True, slots=True)
class _BentState:
    flat: BundleState
    coefficients: FloatArray


@dataclass(frozen=True, slots=True)
class _BentBundle:
    """A bundle whose boards share a bend; see `least_squares.solve`.

    Columns: those of the bundle, then the bend's coefficients.
    """

    bundle: Bundle
    bend: BoardBend

    @property
    def n_parameters(self) -> int:
        return self.bundle.n_parameters + len(self.bend.exponents)

    @property
    def bend_columns(self) -> IntArray:
        return np.arange(self.bundle.n_parameters, self.n_parameters)

    def blocks(self, state: _BentState) -> list[Block]:
        bent = self.bent(state)
        blocks = bent.blocks(state.flat)
        for i, (target, pose) in enumerate(zip(bent.views, state.flat.poses, strict=True)):
            # The last three columns of a corner's block are its pose's shift.
            along_z = blocks[i].jacobian[..., -3:] @ pose.rotation[:, 2]
            by_bend = along_z[..., None] * self.bend.terms_at(target.view.points)[:, None, :]
            blocks[i] = replace(
                blocks[i],
                columns=np.concatenate([blocks[i].columns, self.bend_columns]),
                jacobian=np.concatenate([blocks[i].jacobian, by_bend], axis=2),
            )
        return blocks

    def moved(self, state: _BentState, step: FloatArray) -> _BentState:
        n = self.bundle.n_parameters
        flat = self.bent(state).moved(state.flat, step[:n])
        return _BentState(flat, state.coefficients + step[n:])

    def bent(self, state: _BentState) -> Bundle:
        """Return the bundle with its points on the bent board."""
        bend = replace(self.bend, coefficients=state.coefficients)
        views = tuple(replace(v, view=bend.applied(v.view)) for v in self.bundle.views)
        return replace(self.bundle, views=views)


@dataclass(frozen=True, slots=True)
class BentFit:
    """A bundle solved together with its board's bend.

    Attributes
    ----------
    bend : BoardBend
    bundle : Bundle
        With its points on the bent board.
    solution : Solution
        The bend's coefficients are the last columns of its covariance.
    """

    bend: BoardBend
    bundle: Bundle
    solution: Solution[BundleState]


def bend_is_significant(
    bundle: Bundle, solution: Solution[BundleState], degree: int, n_solved: int
) -> bool:
    """Whether further terms of a bend are more than the scatter of the views makes of none.

    From the slopes at the solution, without solving again: Rao's score, by Wald's test with the
    covariance by views.

    Parameters
    ----------
    bundle : Bundle
        With points on a flat board, or one bent by terms of lower degree.
    solution : Solution
        Of it.
    degree : int
        Of the terms in question, one of `BEND_DEGREES`.
    n_solved : int
        How many of the terms up to that degree are in the points already.
    """
    bend = BoardBend.flat([target.view for target in bundle.views], degree)
    n, n_terms = len(bundle.views), len(bend.exponents) - n_solved
    if n < n_terms + _SPARE_VIEWS:
        return False
    problem = _BentBundle(bundle, bend)
    blocks = problem.blocks(_BentState(solution.state, bend.coefficients))
    shared = np.concatenate([np.arange(bundle.n_shared), problem.bend_columns])
    found = view_covariance(blocks[:n], solution.inliers[:n], solution.block_scales[:n], shared)
    terms, covariance = found.step[-n_terms:], found.by_views[-n_terms:, -n_terms:]
    size = np.sqrt(np.diag(covariance))
    squares = terms / size @ np.linalg.solve(covariance / np.outer(size, size), terms / size)
    threshold = f_distribution.isf(_CHANCE, n_terms, n - n_terms)
    return bool(squares / n_terms > threshold)


def fit_bend(flat: Bundle, start: BundleState, degree: int) -> BentFit | None:
    """Solve a bundle together with a bend that its boards share.

    Parameters
    ----------
    flat : Bundle
        Of views whose poses are free, with the points of the flat board.
    start : BundleState
        Where the solve starts.
    degree : int
        Of the polynomial, one of `BEND_DEGREES`.

    Returns
    -------
    BentFit or None
        None where no bend helps to explain the views.
    """
    bend = BoardBend.flat([target.view for target in flat.views], degree)
    problem = _BentBundle(flat, bend)
    try:
        solved = solve(problem, _BentState(start, bend.coefficients))
    except CalibrationError:
        return None
    bend = replace(bend, coefficients=solved.state.coefficients)
    solution = Solution(
        **{name: getattr(solved, name) for name in Solution.__slots__ if name != "state"},
        state=solved.state.flat,
    )
    return BentFit(bend, problem.bent(solved.state), solution)
