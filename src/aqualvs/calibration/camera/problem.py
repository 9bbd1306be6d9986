"""The least-squares problem of `calibrate camera`: initial guess, lens model and bend of the board.

The number of distortion coefficients is chosen by an information criterion (`fitted_camera`).

A board that is not quite flat is a polynomial surface of second, or second and third, degree over
its corners, the same in all views. Poses and lens take up a part of what a bent board does to the
corners, so the bend is solved together with them, and only if the views show it to be significant
(`bend_is_significant`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from scipy.special import fdtri

from aqualvs.calibration.solver.bundle import (
    CORNER_SIGMA_PX,
    CORNERS,
    Bundle,
    BundleState,
    TargetView,
)
from aqualvs.calibration.solver.covariance import shared_covariance, view_covariance
from aqualvs.calibration.solver.initial_pose import start_pose
from aqualvs.calibration.solver.least_squares import (
    Block,
    Solution,
    inverse,
    normal_equations,
    solve,
)
from aqualvs.calibration.targets.targets import View
from aqualvs.errors import CalibrationError, RigError
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.camera import POSE_PARAMETERS, Camera
from aqualvs.optics.lens import Lens, LensModel
from aqualvs.optics.rig import Rig, RigUncertainty

BEND_DEGREES = (2, 3)
"""Degrees of a bend's polynomial, each with the terms of those before it."""
# Exponents of x and y in each term, by degree.
_TERMS = {2: ((2, 0), (1, 1), (0, 2)), 3: ((3, 0), (2, 1), (1, 2), (0, 3))}


@dataclass(frozen=True, slots=True)
class BoardBend:
    """A board's surface: z = sum of coefficient times x^i y^j, beside a plane."""

    centre: FloatArray  # Shape (2,): origin of x and y, in `board`, metres.
    half_size: float  # Unit of x and y, in metres: half of the corners' longer extent.
    exponents: tuple[tuple[int, int], ...]  # i and j of every term.
    coefficients: FloatArray  # Shape (K,): in metres.

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
        return np.stack([x**i * y**j for i, j in self.exponents], axis=-1)

    def applied(self, view: View) -> View:
        """Return a view of the flat board with its points on the bent one."""
        points = view.points.copy()
        points[:, 2] += self.terms_at(view.points) @ self.coefficients
        return replace(view, points=points)

    def height(self, views: Sequence[View]) -> float:
        """Return the height difference of the corners over their best plane, in metres.

        `views`: of the flat board.
        """
        points = np.unique(np.concatenate([view.points for view in views]), axis=0)
        z = self.terms_at(points) @ self.coefficients
        plane = np.column_stack([points[:, :2], np.ones(len(points))])
        off = z - plane @ np.linalg.lstsq(plane, z, rcond=None)[0]
        return float(np.ptp(off))


class _BentState(NamedTuple):
    flat: BundleState
    coefficients: FloatArray


@dataclass(frozen=True, slots=True)
class _BentBundle:
    """A bundle whose boards share a bend: a problem of `least_squares.solve`.

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


class BentFit(NamedTuple):
    """A bundle solved together with its board's bend."""

    bend: BoardBend
    bundle: Bundle  # With its points on the bent board.
    # The bend's coefficients are the last columns of its covariance.
    solution: Solution[BundleState]


def bend_is_significant(
    bundle: Bundle, solution: Solution[BundleState], degree: int, n_solved: int
) -> bool:
    """Return whether further terms of a bend exceed the scatter of the views.

    From the derivatives at the solution, without solving again: Rao's score, in Wald's test with
    the covariance by views. The points include the first `n_solved` of the terms up to `degree`,
    one of `BEND_DEGREES`, already.
    """
    bend = BoardBend.flat([target.view for target in bundle.views], degree)
    n, n_terms = len(bundle.views), len(bend.exponents) - n_solved
    # Views needed beyond the number of terms to estimate their scatter.
    spare_views = 3
    if n < n_terms + spare_views:
        return False
    problem = _BentBundle(bundle, bend)
    blocks = problem.blocks(_BentState(solution.state, bend.coefficients))
    shared = np.concatenate([np.arange(bundle.n_shared), problem.bend_columns])
    found = view_covariance(blocks[:n], solution.inliers[:n], solution.block_scales[:n], shared)
    terms, covariance = found.step[-n_terms:], found.by_views[-n_terms:, -n_terms:]
    size = np.sqrt(np.diag(covariance))
    squares = terms / size @ np.linalg.solve(covariance / np.outer(size, size), terms / size)
    # Probability that a flat board is taken for bent.
    chance = 1e-3
    threshold = fdtri(n_terms, n - n_terms, 1.0 - chance)
    return bool(squares / n_terms > threshold)


def fit_bend(flat: Bundle, start: BundleState, degree: int) -> BentFit | None:
    """Solve a bundle together with a bend that its boards share; None if no bend helps.

    `flat` has the points of the flat board, and free poses; `degree` is one of `BEND_DEGREES`.
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


# Fields of view, in radians across the picture, that a lens is tried with where OpenCV finds none.
_FIELDS = tuple(np.deg2rad([30.0, 50.0, 70.0, 95.0]))
_FISHEYE_FIELDS = tuple(np.deg2rad([60.0, 100.0, 140.0, 180.0]))
# Numbers of coefficients, each with those before it; fisheye lenses have all four or none.
_STEPS = {LensModel.OPENCV: (4, 5, 8), LensModel.FISHEYE: (4,)}


def fitted_camera(
    views: Sequence[View], size_px: tuple[int, int], model: LensModel, n_coefficients: int | None
) -> tuple[Bundle, Solution[BundleState]]:
    """Solve the camera, with as many distortion coefficients as the views support.

    Coefficients are added only while they lower the cost by more than the information criterion
    of Schwarz (1978, doi:10.1214/aos/1176344136) requires: superfluous ones would distort the
    picture's corners, where no board was seen.

    Raises `CalibrationError` if no camera model explains the views.
    """
    first = _STEPS[model][0] if n_coefficients is None else n_coefficients
    bundle, solution = _first_fit(views, size_px, model, first)
    if n_coefficients is not None:
        return bundle, solution
    return with_supported_coefficients(bundle, solution)


def with_supported_coefficients(
    bundle: Bundle, solution: Solution[BundleState]
) -> tuple[Bundle, Solution[BundleState]]:
    """Solve with as many distortion coefficients as the views support."""
    steps = _STEPS[solution.state.rig.lens.model]
    if len(solution.state.rig.lens.distortion) != steps[0]:
        bundle, solution = with_coefficients(bundle, solution, steps[0])
    lens = solution.state.rig.lens
    if lens.model is LensModel.OPENCV:
        columns, values = np.arange(4, 4 + len(lens.distortion)), np.array(lens.distortion)
        squares = values @ np.linalg.solve(solution.covariance[np.ix_(columns, columns)], values)
        if not squares > _price(bundle, solution, 0):
            return with_coefficients(bundle, solution, 0)
    for n in steps[1:]:
        if gain_of_coefficients(bundle, solution, n) < _price(bundle, solution, n):
            break
        bundle, solution = with_coefficients(bundle, solution, n)
    return bundle, solution


def with_coefficients(
    bundle: Bundle, solution: Solution[BundleState], n: int
) -> tuple[Bundle, Solution[BundleState]]:
    """Solve again with another number of distortion coefficients."""
    other, state = _resized(bundle, solution.state, n)
    return other, solve(other, state)


def gain_of_coefficients(bundle: Bundle, solution: Solution[BundleState], n: int) -> float:
    """Return the decrease of the sum of squares by further coefficients, in sigmas squared.

    Rao's score test: from the derivatives at the solution, without solving again.
    """
    wider, state = _resized(bundle, solution.state, n)
    blocks = wider.blocks(state)
    equations = normal_equations(
        wider.n_parameters, blocks, solution.inliers, solution.block_scales
    )
    new = np.arange(len(bundle.free), len(wider.free))
    old = np.setdiff1d(np.arange(wider.n_parameters), new)
    information, gradient = equations.information, equations.gradient
    by_old = information[np.ix_(new, old)] @ inverse(information[np.ix_(old, old)])
    left = information[np.ix_(new, new)] - by_old @ information[np.ix_(old, new)]
    slope = gradient[new] - by_old @ gradient[old]
    size = np.sqrt(np.diag(information)[new])
    values, vectors = np.linalg.eigh(left / np.outer(size, size))
    # Share of a coefficient's effect that no other has, below which it adds nothing.
    redundant = 1e-7
    # Combinations whose effect others have already are known to rounding only.
    known = values > redundant
    along = (vectors.T @ (slope / size))[known]
    return float(np.sum(along**2 / values[known]))


def _price(bundle: Bundle, solution: Solution[BundleState], n: int) -> float:
    more = abs(n - len(solution.state.rig.lens.distortion))
    values = sum(2 * int(np.count_nonzero(i)) for i in solution.inliers[: len(bundle.views)])
    # Errors that the corners of a view share make chance gains larger by this factor.
    inflation = max(shared_covariance(bundle, solution).inflation, 1.0)
    return more * inflation * float(np.log(values))


def _resized(bundle: Bundle, state: BundleState, n: int) -> tuple[Bundle, BundleState]:
    lens = state.rig.lens
    coefficients = (*lens.distortion, *(0.0,) * 8)[:n]
    rig = replace(state.rig, lens=replace(lens, distortion=coefficients))
    there = replace(state, rig=rig)
    return replace(bundle, free=rig.lens.parameter_names, start=there), there


def _first_fit(
    views: Sequence[View], size_px: tuple[int, int], model: LensModel, n_coefficients: int
) -> tuple[Bundle, Solution[BundleState]]:
    best: tuple[Bundle, Solution[BundleState]] | None = None
    # An initial guess that leaves less than this needs no alternative.
    good_noise_px = 1.0
    for lens in _lenses(views, size_px, model, n_coefficients):
        try:
            bundle = _bundle(lens, size_px, views)
            solution = solve(bundle, bundle.start)
        except (CalibrationError, RigError):
            continue
        if best is None or solution.scales[CORNERS] < best[1].scales[CORNERS]:
            best = bundle, solution
        if CORNER_SIGMA_PX * solution.scales[CORNERS] < good_noise_px:
            break
    if best is None:
        raise CalibrationError(
            f"no camera can have taken the {len(views)} views; is the board's file that of the "
            "print, and was the board flat?"
        )
    return best


def _lenses(
    views: Sequence[View], size_px: tuple[int, int], model: LensModel, n_coefficients: int
) -> Iterator[Lens]:
    if model is LensModel.OPENCV:
        found = _by_opencv(views, size_px)
        if found is not None:
            # A number of coefficients that no lens has is a fault of the caller, not of OpenCV.
            yield replace(found, distortion=(*found.distortion, *(0.0,) * 4)[:n_coefficients])
    fisheye = model is LensModel.FISHEYE
    for field in _FISHEYE_FIELDS if fisheye else _FIELDS:
        focal = size_px[0] / field if fisheye else 0.5 * size_px[0] / np.tan(0.5 * field)
        yield Lens(
            model=model,
            fx=float(focal),
            fy=float(focal),
            cx=0.5 * (size_px[0] - 1),
            cy=0.5 * (size_px[1] - 1),
            distortion=(0.0,) * n_coefficients,
        )


def _by_opencv(views: Sequence[View], size_px: tuple[int, int]) -> Lens | None:
    points = [v.points.astype(np.float32) for v in views]
    pixels = [v.pixels.astype(np.float32) for v in views]
    try:
        _, matrix, distortion, _, _ = cv2.calibrateCamera(
            points, pixels, size_px, None, None, flags=cv2.CALIB_FIX_K3
        )
        return Lens(
            fx=float(matrix[0, 0]),
            fy=float(matrix[1, 1]),
            cx=float(matrix[0, 2]),
            cy=float(matrix[1, 2]),
            distortion=tuple(map(float, np.ravel(distortion)[:4])),
        )
    except (cv2.error, RigError):
        return None


def _bundle(lens: Lens, size_px: tuple[int, int], views: Sequence[View]) -> Bundle:
    """Return the problem of a bare camera at the origin, with poses to start from."""
    rig = Rig(
        name="camera",
        size_px=size_px,
        lens=lens,
        dome_from_cam=SE3.identity(),
        housing=None,
        n_air=1.0,
        n_water=1.0,
        lasers=(),
        working_range=(0.1, 10.0),
    )
    targets = []
    for view in views:
        found = start_pose(rig.camera(), view)
        if isinstance(found, str):
            raise CalibrationError(found)
        targets.append(TargetView(view, 0, found.dome_from_target))
    start = BundleState(rig, np.ones(1), tuple(t.dome_from_target for t in targets))
    return Bundle(tuple(targets), lens.parameter_names, start, RigUncertainty.none(), np.zeros(1))


def direction_sigma_px(lens: Lens, covariance: FloatArray, pixels: FloatArray) -> FloatArray:
    """Return the uncertainty (N,), in pixels, of the pixels (N, 2) of fixed directions.

    `covariance` (P, P) is that of the lens's parameters. NaN where the lens model does not hold.
    """
    directions, _ = lens.directions(pixels)
    # A point seen by a bare lens in the origin is a direction.
    bare = Camera(size_px=(1, 1), lens=lens, dome_from_cam=SE3.identity())
    by_number = bare.project_with_parameter_jacobian(directions)[3][..., len(POSE_PARAMETERS) :]
    spread = np.einsum("nip,pq,niq->ni", by_number, covariance, by_number)
    sigma: FloatArray = np.sqrt(spread.sum(axis=-1))
    return sigma
