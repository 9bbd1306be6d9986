"""The least-squares problem of `calibrate dome`: its input, free and known numbers, initial guess.

A flat port is solved in the same way. It belongs to the camera, so that boards say where it is
before the lens, and nothing about where the camera is: their poses are unknown.

The input is sets of views of boards, each set in one medium, and options (`BoardSet`,
`DomeOptions`).

Prior of the boards' tilt: most boards of a rail stand square, some lean by a degree or more. How
closely the good ones agree is not known beforehand. It is estimated by maximum likelihood, over a
ladder of scales (`with_board_tilt_as_found`).

Cross-validation: the dome's prediction of unused corners against that of a bare lens
(`compare_with_bare_lens`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from aqualvs.calibration.solver.bundle import (
    TILTS,
    Bundle,
    BundleState,
    KnownDistance,
    SquareBoard,
    TargetView,
)
from aqualvs.calibration.solver.covariance import implausible_distance
from aqualvs.calibration.solver.initial_pose import (
    StartPose,
    square_rotation,
    start_pose,
    target_pose,
    turned_square,
)
from aqualvs.calibration.solver.least_squares import Solution, solve
from aqualvs.calibration.solver.result import CrossValidation, rms_px
from aqualvs.calibration.targets.pose_files import BoardPose
from aqualvs.calibration.targets.targets import View, check_enough
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import Rig, RigUncertainty, combined
from aqualvs.optics.water import N_AIR


class PoseKind(StrEnum):
    """Kind of knowledge of a board's pose."""

    EXACT = "exact"
    DISTANCE = "distance"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardSet:
    """Views taken in one medium."""

    name: str  # For messages: "air", "pool", a folder.
    views: tuple[View, ...]  # One for each picture.
    # Measurements of each view's board; empty if nothing is known of any.
    poses: Sequence[BoardPose | None] = ()
    # Index outside the dome (vacuum = 1).
    n_medium: float = N_AIR
    # Its standard deviation; 0 takes it as exact.
    sigma_medium: float = 0.0

    def __post_init__(self) -> None:
        if self.poses and len(self.poses) != len(self.views):
            raise ValueError(f"{len(self.poses)} poses given for {len(self.views)} views")


@dataclass(frozen=True, slots=True, kw_only=True)
class DomeOptions:
    """Options of `calibrate dome`; SI units and radians."""

    # Standard deviations of the housing's sizes; 0 takes one as exact. A flat port has no radius.
    inner_radius_sigma: float = 1e-4
    thickness_sigma: float = 1e-4
    # Standard deviation of the index of the dome or the flat port.
    n_acrylic_sigma: float = 3e-3
    # Standard deviation of given distances, independent of each other.
    distance_sigma: float = 2e-4
    # Standard deviation of the zero of all distances: this shared error shifts the lens as a whole.
    distance_offset_sigma: float = 2e-4
    # Standard deviation, about each axis, of well set up boards at known distances from square to
    # the dome. A minority of boards may be off by any amount.
    tilt_sigma: float = float(np.deg2rad(0.2))
    # Standard deviation, about each axis, of a tilt that all these boards share, as on a carriage
    # that is not square to its rail: it turns the dome's axes, and pictures do not show it.
    shared_tilt_sigma: float = 0.0
    # Whether intrinsics are solved too, with the camera's calibration as their prior. If not, they
    # are held, and their uncertainty is propagated to the result.
    refine_intrinsics: bool = True
    # Whether to compare the dome with a bare lens on views held out.
    check_cross_validation: bool = True

    def __post_init__(self) -> None:
        if self.shared_tilt_sigma < 0.0:
            raise CalibrationError(
                f"tilt shared by all boards is {np.rad2deg(self.shared_tilt_sigma):g} deg; use 0 "
                "or more"
            )
        if self.distance_sigma <= 0.0 or self.tilt_sigma <= 0.0:
            raise CalibrationError(
                f"distances known to {1e3 * self.distance_sigma:g} mm and boards square to "
                f"{np.rad2deg(self.tilt_sigma):g} deg; both must be positive"
            )


def check_sets(rig: Rig, sets: Sequence[BoardSet]) -> None:
    """Refuse a rig without a housing, and sets with too little in them.

    Raises `CalibrationError` with what is given and what is needed.
    """
    if rig.housing is None:
        raise CalibrationError(
            f"rig {rig.name} has no dome; write its inner_radius_mm, thickness_mm and n_acrylic "
            "into the rig file, or those of a flat port"
        )
    if rig.flat_port is not None:
        _check_flat(rig, sets)
    views = [view for one in sets for view in one.views]
    exact = any(shot.kind is PoseKind.EXACT for shot in shots_of(sets))
    good = "10 to 15 at distances all over the working range"
    check_enough(views, 1 if exact else 3, "dome", good)


def _check_flat(rig: Rig, sets: Sequence[BoardSet]) -> None:
    if any(given is not None for one in sets for given in one.poses):
        raise CalibrationError(
            f"rig {rig.name} has a flat port, whose place does not depend on the boards' poses; "
            "leave the poses out"
        )
    # Indices on both sides of a port that differ by less tell nothing of its place.
    bending = 0.01
    if all(abs(one.n_medium - rig.n_air) < bending for one in sets):
        raise CalibrationError(
            "all pictures were taken in air, where a flat port looks the same at any distance; "
            "take some with the port in water"
        )


LENS = ("lens_x", "lens_y", "lens_z")
PORT = ("port_distance", "port_tilt_x", "port_tilt_y")
ROTATION = ("rotation_x", "rotation_y", "rotation_z")


def place_names(rig: Rig) -> tuple[str, ...]:
    """Return the names of the numbers that say where lens and housing are to each other."""
    return LENS if rig.flat_port is None else PORT


@dataclass(frozen=True, slots=True)
class Shot:
    """One view with its set and the measurements of its board; `label` names it in messages."""

    label: str
    view: View
    i_set: int
    given: BoardPose | None

    @property
    def kind(self) -> PoseKind:
        """Kind of knowledge of the board's pose."""
        if self.given is None:
            return PoseKind.UNKNOWN
        if self.given.dome_from_board is not None:
            return PoseKind.EXACT
        return PoseKind.UNKNOWN if self.given.distance is None else PoseKind.DISTANCE


@dataclass(frozen=True, slots=True)
class DomeProblem:
    """The least-squares problem: a bundle and the views it was made of."""

    bundle: Bundle
    shots: tuple[Shot, ...]  # One for each of the bundle's views.
    considered: RigUncertainty  # Uncertainty of numbers that are not solved for.
    left_out: dict[str, str]  # Labels of views that could not be used, with the reason.

    @property
    def rotation_is_solved(self) -> bool:
        """True if known poses of boards determine the camera's rotation."""
        return any(shot.kind is not PoseKind.UNKNOWN for shot in self.shots)

    @property
    def axes_are_of_boards(self) -> bool:
        """True if the dome's axes are those of boards standing square to it."""
        kinds = {shot.kind for shot in self.shots}
        return PoseKind.DISTANCE in kinds and PoseKind.EXACT not in kinds

    @property
    def measured_views(self) -> list[int]:
        """Indices of views whose board's distance is given and used."""
        return [i for i, view in enumerate(self.bundle.views) if view.distance is not None]

    def given_distance(self, i_view: int) -> float:
        """Return the given distance of a view's board; NaN if none is given."""
        given = self.shots[i_view].given
        return float("nan") if given is None or given.distance is None else given.distance

    def without(self, bad: dict[int, str]) -> "DomeProblem":
        """Return the problem without some of its views, with the reasons."""
        reasons = {self.shots[i].label: why for i, why in bad.items()}
        part = self.only([i for i in range(len(self.shots)) if i not in bad])
        return replace(part, left_out={**self.left_out, **reasons})

    def only(self, keep: Sequence[int]) -> "DomeProblem":
        """Return the problem of some of its views."""
        shots = tuple(self.shots[i] for i in keep)
        return replace(self, bundle=self.bundle.only(keep), shots=shots)

    def with_considered_free(self) -> "DomeProblem":
        """Return the problem with the considered numbers solved for, with priors."""
        bundle = replace(
            self.bundle,
            free=(*self.bundle.free, *self.considered.names),
            priors=combined(self.bundle.priors, self.considered),
        )
        return replace(self, bundle=bundle, considered=RigUncertainty.none())

    def without_distances(self, wrong: Sequence[int]) -> "DomeProblem":
        """Return the problem without some of the given distances."""
        views = tuple(
            replace(view, distance=None) if i in wrong else view
            for i, view in enumerate(self.bundle.views)
        )
        return replace(self, bundle=replace(self.bundle, views=views))

    def with_board_tilt_prior(self, sigma: float) -> "DomeProblem":
        """Return the problem with another prior scale of the boards' tilt."""
        views = tuple(
            view
            if view.square is None
            else replace(view, square=replace(view.square, board_tilt_sigma=sigma))
            for view in self.bundle.views
        )
        return replace(self, bundle=replace(self.bundle, views=views))


def shots_of(sets: Sequence[BoardSet]) -> list[Shot]:
    """Return all views of all sets."""
    return [
        Shot(f"{one.name}: {view.name}" if len(sets) > 1 else view.name, view, i_set, given)
        for i_set, one in enumerate(sets)
        for view, given in zip(one.views, one.poses or [None] * len(one.views), strict=True)
    ]


def dome_problem(
    rig: Rig, sets: Sequence[BoardSet], known: RigUncertainty, options: DomeOptions
) -> DomeProblem:
    """Return the problem with starting poses.

    The lens of `rig`, the initial guess, lies inside the dome, or behind the flat port; `known` is
    its uncertainty beforehand. Raises `CalibrationError` if no view has a starting pose.
    """
    shots, poses, left_out = _started(rig, sets)
    boards = [i for i, shot in enumerate(shots) if shot.kind is PoseKind.DISTANCE]
    exact = any(shot.kind is PoseKind.EXACT for shot in shots)
    square = square_rotation([poses[i].rotation for i in boards or range(len(poses))])
    if boards and not exact:
        rig, poses = turned_square(rig, poses, square, boards, options.tilt_sigma)
    solves_rotation = bool(boards) or exact
    priors, considered = _priors(rig, known, options, solves_rotation)
    rotation = tuple(name for name in ROTATION if solves_rotation or name in priors.names)
    free = (*place_names(rig), *rotation, *(name for name in priors.names if name not in ROTATION))
    views = tuple(
        TargetView(
            shot.view, shot.i_set, pose, shot.kind is PoseKind.EXACT, *_known(shot, square, options)
        )
        for shot, pose in zip(shots, poses, strict=True)
    )
    media = np.array([one.n_medium for one in sets], np.float64)
    sigma = np.array([one.sigma_medium for one in sets], np.float64)
    bundle = Bundle(views, free, BundleState(rig, media, tuple(poses)), priors, sigma)
    return DomeProblem(bundle, tuple(shots), considered, left_out)


def _started(rig: Rig, sets: Sequence[BoardSet]) -> tuple[list[Shot], list[SE3], dict[str, str]]:
    cameras = [rig.in_water(one.n_medium).camera() for one in sets]
    shots, poses, misfits, left_out = [], [], [], {}
    for shot in shots_of(sets):
        start: StartPose | str
        if shot.given is not None and shot.given.dome_from_board is not None:
            start = StartPose(shot.given.dome_from_board, 0.0)
        else:
            start = start_pose(cameras[shot.i_set], shot.view)
        if isinstance(start, str):
            left_out[shot.label] = start
            continue
        shots.append(shot)
        poses.append(start.dome_from_target)
        misfits.append(start.median_px)
    if not shots:
        raise CalibrationError(_why_none(rig, sets) or next(iter(left_out.values())))
    # For every lens position, poses of the right board are nearer than this.
    max_misfit_px = 30.0
    if np.median(misfits) > max_misfit_px:
        raise CalibrationError(
            f"no pose of the board explains the pictures: corners are {np.median(misfits):.0f} px "
            "off; check the board's file against the print, and the camera's calibration"
        )
    return shots, poses, left_out


def _why_none(rig: Rig, sets: Sequence[BoardSet]) -> str | None:
    """Return why no board has a pose outside the dome, from its distance without a dome."""
    bare = rig.bare_camera()
    found = {}
    for shot in shots_of(sets):
        start = start_pose(bare, shot.view)
        if not isinstance(start, str):
            middle = start.dome_from_target.apply(shot.view.middle)
            found[shot.label] = float(np.linalg.norm(middle - rig.dome_from_cam.translation))
    return implausible_distance(np.array([*found.values()]), [*found]) if found else None


def _known(
    shot: Shot, square: FloatArray, options: DomeOptions
) -> tuple[KnownDistance | None, SquareBoard | None]:
    if shot.given is None or shot.given.distance is None or shot.kind is PoseKind.EXACT:
        return None, None
    return (
        KnownDistance(shot.given.distance, options.distance_sigma),
        SquareBoard(square, options.tilt_sigma, options.tilt_sigma),
    )


def _priors(
    rig: Rig, known: RigUncertainty, options: DomeOptions, solves_rotation: bool
) -> tuple[RigUncertainty, RigUncertainty]:
    """Return the prior uncertainty of solved numbers, and the uncertainty of considered ones."""
    intrinsics = [n for n in rig.lens.parameter_names if known.sigmas.get(n, 0.0) > 0.0]
    rotation = [n for n in ROTATION if known.sigmas.get(n, 0.0) > 0.0 and not solves_rotation]
    tolerances = {"thickness": options.thickness_sigma}
    if rig.flat_port is not None:
        tolerances |= {"n_port": options.n_acrylic_sigma}
    else:
        tolerances = {"inner_radius": options.inner_radius_sigma, **tolerances}
        tolerances |= {"n_acrylic": options.n_acrylic_sigma}
    dome = RigUncertainty.independent({n: s for n, s in tolerances.items() if s > 0.0})
    moving = known.only(rotation + (intrinsics if options.refine_intrinsics else []))
    considered = known.only([] if options.refine_intrinsics else intrinsics)
    return combined(dome, moving), considered


def with_board_tilt_as_found(
    problem: DomeProblem, solution: Solution[BundleState], sigma: float
) -> tuple[DomeProblem, Solution[BundleState]]:
    """Solve with a finer scale of the boards' tilt as long as they agree that closely.

    `sigma` is the scale, in radians, that the problem was solved with. Both are returned unchanged
    if boards do not agree better, or nothing is known of their poses.
    """
    # Boards are not set up better than this: 0.9 mm a metre.
    finest, step = float(np.deg2rad(0.05)), 0.5
    # A finer scale must raise the log likelihood by this much: odds of 20 to 1.
    evidence = 3.0
    while sigma * step >= finest * (1.0 - 1e-9):
        finer = problem.with_board_tilt_prior(sigma * step)
        trial = solve(finer.bundle, solution.state)
        gain = _misfit(solution, sigma) - _misfit(trial, sigma * step)
        if not (trial.converged and gain > evidence):
            break
        problem, solution, sigma = finer, trial, sigma * step
    return problem, solution


def _misfit(solution: Solution[BundleState], sigma: float) -> float:
    """Return the negative log likelihood of two-dimensional Cauchy tilts, up to a constant."""
    leaning = [block.residuals[0] for block in solution.blocks if block.group == TILTS]
    if not leaning:
        return 0.0
    squares = np.sum(np.square(leaning), axis=1)
    return float(1.5 * np.sum(np.log1p(squares)) + 2.0 * len(leaning) * np.log(sigma))


def compare_with_bare_lens(
    problem: DomeProblem, solution: Solution[BundleState]
) -> CrossValidation | None:
    """Solve both models from three views in four and predict the fourth; four times.

    The pose of a view held out is found from half of its corners; the other half is predicted.
    Outliers of the whole solve and corners that either model cannot see are left out for both. None
    if there are too few views.
    """
    n = len(problem.shots)
    believed = [
        shot.view.where(inliers)
        for shot, inliers in zip(problem.shots, solution.inliers[:n], strict=True)
    ]
    # Half a view must still determine a pose.
    min_split_points = 12
    usable = [i for i in range(n) if len(believed[i]) >= min_split_points]
    # Number of folds, and least number of views; with fewer all are needed for the solve.
    parts, min_split_views = 4, 8
    if len(usable) < min_split_views:
        return None
    pairs: list[tuple[FloatArray, FloatArray]] = []
    for part in range(parts):
        held_out = usable[part::parts]
        rest = [i for i in range(n) if i not in held_out]
        media = [problem.shots[i].i_set for i in held_out]
        views = [believed[i] for i in held_out]
        try:
            state = solve(problem.only(rest).bundle, solution.state.only(rest)).state
            with_dome = predicted(state, media, views)
            bare = predicted(_bare_state(problem, solution, rest), media, views)
        except CalibrationError:
            return None
        pairs += zip(with_dome, bare, strict=True)
    return _compared(pairs)


def _compared(pairs: Sequence[tuple[FloatArray, FloatArray]]) -> CrossValidation | None:
    """Compare residuals (N, 2) of the same corners, view by view."""
    rows = []
    for dome, bare in pairs:
        both = np.isfinite(dome).all(axis=1) & np.isfinite(bare).all(axis=1)
        if both.any():
            rows.append((rms_px(dome[both]), rms_px(bare[both]), np.count_nonzero(both)))
    if not rows:
        return None
    dome_px, bare_px, counts = np.array(rows).T
    return CrossValidation(dome_px, bare_px, counts.astype(np.int64))


def _bare_state(
    problem: DomeProblem, solution: Solution[BundleState], rest: Sequence[int]
) -> BundleState:
    """Solve a bare lens with free pose from the same pictures."""
    bundle = problem.bundle
    rig = replace(solution.state.rig, housing=None)
    views = []
    for i in rest:
        pose = restarted(rig.camera(), bundle.views[i], solution.state.poses[i])
        views.append(replace(bundle.views[i], dome_from_target=pose))
    intrinsics = tuple(name for name in bundle.free if name in rig.lens.parameter_names)
    # With unknown poses the place is arbitrary.
    free = (LENS + ROTATION if problem.rotation_is_solved else ()) + intrinsics
    start_rig = replace(bundle.start.rig, housing=None)
    start = BundleState(start_rig, solution.state.media, tuple(v.dome_from_target for v in views))
    bare = Bundle(
        tuple(views), free, start, bundle.priors.only(intrinsics), np.zeros(len(bundle.media_sigma))
    )
    return solve(bare, replace(start, rig=rig)).state


def restarted(camera: Camera, target: TargetView, pose: SE3) -> SE3:
    """Return a target's pose found with another camera; `pose` if it is exact or none is found."""
    if target.fixed:
        return pose
    found = start_pose(camera, target.view)
    return pose if isinstance(found, str) else found.dome_from_target


def predicted(state: BundleState, media: Sequence[int], views: Sequence[View]) -> list[FloatArray]:
    """Return residuals (N, 2) of each view's odd corners, from poses found with the even ones.

    NaN for corners that the model cannot see.
    """
    errors = []
    for medium, view in zip(media, views, strict=True):
        camera = state.camera(medium)
        even = np.arange(len(view)) % 2 == 0
        pose = target_pose(camera, view.where(even), max_rms_px=float("inf")).dome_from_target
        odd = view.where(~even)
        pixels, _ = camera.project(pose.apply(odd.points))
        errors.append(odd.pixels - pixels)
    return errors
