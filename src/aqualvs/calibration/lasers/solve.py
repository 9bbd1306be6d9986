"""The solver of `calibrate lasers`: poses and planes together, and the model of each sheet.

`solve_lasers` solves the lasers as planes, assigns the stripe points anew by those planes, solves
again, and then chooses between plane and bent sheet. The light of a laser behind a window is not
exactly a plane in the water; the Bayesian information criterion of the residuals decides
(`choose_sheets`). `paper_planes` gives the paper's planes (Eq. 33-36) for comparison.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aqualvs.calibration.lasers.checks import SolvedLasers, contradicts, like
from aqualvs.calibration.lasers.covariance import CameraCovariance
from aqualvs.calibration.lasers.laser_assignment import BENT_TOLERANCE_PX, TOLERANCE_PX, assigned
from aqualvs.calibration.lasers.problem import N_BOARD_POSE, LaserProblem, LaserState
from aqualvs.calibration.lasers.stripes_on_planes import (
    TargetSurfaces,
    binned,
    correlation_factor,
    place_stripes,
    points_on,
    with_gain,
)
from aqualvs.calibration.lasers.views import PlacedView, pooled, split_by_view
from aqualvs.calibration.solver.bundle import Bundle, BundleState, TargetView
from aqualvs.calibration.solver.least_squares import solve
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Laser, Rig, RigUncertainty
from aqualvs.optics.sheet import Sheet, sheet_in


def start_sheets(rig: Rig, lasers: Sequence[Laser], *, bent: bool) -> tuple[Sheet, ...]:
    """Return the initial sheets: planes, or, if `bent`, bent ones for lasers with a window.

    The lasers' planes fit the light in the medium of the pictures, in which the rig is.
    """
    return tuple(
        _bent(rig, laser)
        if bent and laser.window is not None
        else Sheet(plane=laser.plane, window=None, n_air=rig.n_air, n_water=rig.n_water)
        for laser in lasers
    )


def _bent(rig: Rig, laser: Laser) -> Sheet:
    """Return the bent sheet whose light in the medium is nearly in `laser.plane`."""
    in_air = laser.plane
    for _ in range(5):
        sheet = sheet_in(Laser(laser.name, in_air, laser.window), rig.n_air, rig.n_water)
        reached = like(sheet.best_plane(rig.camera(), rig.working_range), laser.plane)
        in_air = Plane.from_normal(
            in_air.normal + laser.plane.normal - reached.normal,
            in_air.offset + laser.plane.offset - reached.offset,
        )
    return sheet_in(Laser(laser.name, in_air, laser.window), rig.n_air, rig.n_water)


def choose_sheets(
    flat: SolvedLasers,
    rig: Rig,
    lasers: Sequence[Laser],
    solve_with: Callable[[tuple[Sheet, ...]], SolvedLasers],
) -> tuple[SolvedLasers, list[str]]:
    """Choose plane or bent sheet for every laser that has a window, and solve with these.

    In `flat` all lasers are planes, as in `lasers`; the rig is in the medium of the pictures;
    `solve_with` solves again with given initial sheets. The words tell the choice for every laser,
    and its reason.
    """
    if all(laser.window is None for laser in lasers):
        return flat, ["plane"] * len(lasers)
    bent = solve_with(start_sheets(rig, lasers, bent=True))
    choices = [
        (flat, "plane") if laser.window is None else _choice(flat, bent, i)
        for i, laser in enumerate(lasers)
    ]
    sheets = tuple(better.state.sheets[i] for i, (better, _) in enumerate(choices))
    return solve_with(sheets), [words for _, words in choices]


def _choice(flat: SolvedLasers, bent: SolvedLasers, i_laser: int) -> tuple[SolvedLasers, str]:
    """Return the solution with the better sheet of a laser, and why."""
    (flat_px, n_flat), (bent_px, n_bent) = _fit(flat, i_laser), _fit(bent, i_laser)
    # Both have three unknowns, so that only the residuals count.
    evidence = 2.0 * min(n_flat, n_bent) * float(np.log(max(flat_px, 1e-9) / max(bent_px, 1e-9)))
    residuals = f"residuals {bent_px:.3f} px if bent at the window, {flat_px:.3f} px if not"
    # Difference of the Bayesian information criterion that is strong evidence (Kass & Raftery 1995,
    # doi:10.1080/01621459.1995.10476572).
    strong = 6.0
    if evidence > strong:
        return bent, f"bent at its window: {residuals}"
    if evidence < -strong:
        return flat, f"plane, its window left out: {residuals}"
    return bent, f"bent at its window as the rig says, though stripes cannot tell: {residuals}"


def _fit(solved: SolvedLasers, i_laser: int) -> tuple[float, float]:
    """Return the rms of a laser's residuals, in pixels, and their number as if independent."""
    squares: list[FloatArray] = []
    sequences: list[FloatArray] = []
    for i in solved.groups_of(laser=i_laser):
        residuals, inside = solved.stripe_residuals_px(i)
        squares.append(residuals[inside] ** 2)
        surface = solved.problem.groups[i].surface
        known = np.where(inside, residuals, np.nan)
        sequences += [known[surface == k] for k in np.unique(surface)]
    everything = np.concatenate(squares)
    # A plane fitted to bent light leaves long waves; their shape counts, not the number of points.
    n_effective = len(everything) / correlation_factor(sequences)
    return float(np.sqrt(np.mean(everything))), n_effective


# Standard deviations of tilts (radians) and offset (metres) of a board of paper or foam that is
# fixed to a wall by hand.
_LOOSE = np.array([*np.deg2rad([1.0, 1.0]), 2e-3])
# Least number of a laser's points in a view.
_MIN_POINTS = 5


@dataclass(frozen=True, slots=True)
class InitialGuess:
    """Input and initial guess of a solve."""

    rig: Rig  # In the medium of the pictures.
    surfaces: TargetSurfaces  # Of the target.
    views: tuple[PlacedView, ...]
    # Numbers that are refined too; None if the camera is held.
    camera_covariance: CameraCovariance | None
    # As in `LaserProblem`.
    board_pose_prior: FloatArray | None = None
    # Error that shifts or turns a whole stripe in its picture.
    shared_error_px: float = 0.0

    def bundle(self) -> Bundle:
        """Return the bundle of the corners alone."""
        views = tuple(TargetView(v.view, 0, v.dome_from_target) for v in self.views)
        known = self.camera_covariance
        if known is None:
            return Bundle(views, (), self.state(), RigUncertainty.none(), np.zeros(1))
        return Bundle(views, known.names, self.state(), known.given, np.array([known.sigma_medium]))

    def state(self) -> BundleState:
        """Return the initial guess of camera, medium and poses."""
        poses = tuple(v.dome_from_target for v in self.views)
        return BundleState(self.rig, np.array([self.rig.n_water]), poses)


def tolerance_px(lasers: Sequence[Laser]) -> float:
    """Return the largest distance of a stripe from its assigned plane, in pixels."""
    bent = any(laser.window is not None for laser in lasers)
    return BENT_TOLERANCE_PX if bent else TOLERANCE_PX


def solve_lasers(
    start: InitialGuess, lasers: Sequence[Laser], laser_of: IntArray, loose: bool | None
) -> tuple[SolvedLasers, list[str]]:
    """Solve lasers as planes, again with points assigned by those planes, then their sheets.

    The planes of `lasers` fit the light in the medium of the pictures roughly. `laser_of` (N,) is
    the index of the laser of each stripe point of all views, -1 for none; `loose` is as in
    `LaserOptions`. The words tell the chosen sheet of every laser, and the reason.
    """
    names = [laser.name for laser in lasers]
    first = _solve_from(start, start_sheets(start.rig, lasers, bent=False), laser_of, names)
    if len(start.surfaces.planes) == 1 and (contradicts(first) if loose is None else loose):
        # In each direction, after poses by corners alone.
        error = float(np.median([view.rms_px for view in start.views]) / np.sqrt(2.0))
        again = replace(start, board_pose_prior=_LOOSE, shared_error_px=error)
    else:
        again, laser_of = _sorted_again(start, first, laser_of, tolerance_px(lasers))
    flat = _solve_from(again, first.state.sheets, laser_of, names)
    found = [
        replace(laser, plane=sheet.plane)
        for laser, sheet in zip(lasers, flat.state.sheets, strict=True)
    ]
    return choose_sheets(
        flat, start.rig, found, lambda sheets: _solve_from(again, sheets, laser_of, names)
    )


def _sorted_again(
    start: InitialGuess, solved: SolvedLasers, laser_of: IntArray, tolerance: float
) -> tuple[InitialGuess, IntArray]:
    """Return the start with solved poses, and each point's laser by solved planes.

    Both are unchanged if a laser would lose its points.
    """
    state = solved.state
    camera = state.bundle.camera(0)
    views = tuple(
        replace(
            view,
            dome_from_target=pose,
            placed=place_stripes(camera, view.stripes, pose, start.surfaces),
        )
        for view, pose in zip(start.views, state.bundle.poses, strict=True)
    )
    planes = [sheet.plane for sheet in state.sheets]
    sorted_anew = assigned(pooled(views, start.surfaces), planes, tolerance)
    counts = np.bincount(sorted_anew[sorted_anew >= 0], minlength=len(planes))
    if counts.min() < _MIN_POINTS:
        return start, laser_of
    return replace(start, views=views), sorted_anew


def _solve_from(
    start: InitialGuess, sheets: tuple[Sheet, ...], laser_of: IntArray, names: Sequence[str]
) -> SolvedLasers:
    camera, groups = start.rig.camera(), []
    for i_view, mine in enumerate(split_by_view(laser_of, start.views)):
        view = start.views[i_view]
        planes = start.surfaces.placed(view.dome_from_target)
        for i_laser, sheet in enumerate(sheets):
            members = np.flatnonzero(mine == i_laser)
            if len(members) >= _MIN_POINTS:
                stripes = view.stripes.at(view.placed.index[members])
                surface = view.placed.surface[members]
                group = binned(i_view, i_laser, stripes, surface, start.shared_error_px)
                groups.append(with_gain(group, camera, planes, sheet))
    problem = LaserProblem(
        start.bundle(), start.surfaces, tuple(groups), len(sheets), start.board_pose_prior
    )
    board_pose = np.zeros((len(start.views), N_BOARD_POSE))
    state = LaserState(start.state(), sheets, board_pose)
    solution = solve(problem, state, remedy=lambda i: free_text(problem, names, start.views, i))
    return SolvedLasers(problem, solution, start.views)


def free_text(
    problem: LaserProblem, names: Sequence[str], views: Sequence[PlacedView], parameter: int
) -> str:
    """Return the remedy for the column of a parameter that the pictures do not determine.

    `names`: of the lasers.
    """
    for i, name in enumerate(names):
        if parameter in problem.laser_columns(i):
            seen = [group for group in problem.groups if group.laser == i]
            points = sum(int(group.counts.sum()) for group in seen)
            return (
                f"laser '{name}' cannot be solved from its {points} points in {len(seen)} "
                "pictures; take more pictures in which its stripe crosses the target, with the "
                "target nearer, farther and tilted, or correct the number of lasers (--lasers N)"
            )
    for i, view in enumerate(views):
        if parameter in problem.bundle.pose_columns(i):
            return (
                f"{view.view.name}: its {len(view.view)} corners do not determine the pose of the "
                "target; leave this picture out, or show more of the target in it"
            )
    return (
        "the pictures do not determine the camera's parameters to refine; leave --refine "
        "out, or add pictures with the target nearer, farther and tilted"
    )


def paper_planes(solved: SolvedLasers) -> list[Plane]:
    """Return the planes of all lasers by the paper's method (Eq. 33-36)."""
    camera = solved.problem.bundle.start.camera(0)
    surfaces, planes = solved.problem.surfaces, []
    spatial = [surfaces.placed(view.spatial) for view in solved.views]
    for i, sheet in enumerate(solved.state.sheets):
        groups = [solved.problem.groups[k] for k in solved.groups_of(laser=i)]
        points = [points_on(camera, g.pixels, g.surface, spatial[g.view])[0] for g in groups]
        planes.append(like(paper_plane(np.concatenate(points)), sheet.plane))
    return planes


def paper_plane(points_in_dome: FloatArray) -> Plane:
    """Fit a plane to points (N, 3) by the paper's pseudo-inverse (Eq. 35-36).

    It minimises neither distances in space nor in the picture, and fails for planes through the
    dome's centre; kept for comparison.
    """
    finite = points_in_dome[np.all(np.isfinite(points_in_dome), axis=1)]
    normal_over_offset = np.linalg.lstsq(finite, np.ones(len(finite)), rcond=None)[0]
    return Plane.from_normal(normal_over_offset, 1.0)
