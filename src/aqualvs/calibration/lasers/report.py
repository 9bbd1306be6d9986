"""The result of a laser calibration: lasers, poses, residuals and findings."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.calibration.lasers.covariance import JointResult
from aqualvs.calibration.lasers.problem import LaserProblem, LaserState, distances_of
from aqualvs.calibration.lasers.views import PlacedView, pose_difference
from aqualvs.calibration.solver.bundle import CORNER_SIGMA_PX
from aqualvs.calibration.solver.least_squares import Solution
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.rig import Laser, Rig, RigUncertainty


@dataclass(frozen=True, slots=True)
class LaserFigures:
    """Figures of one calibrated laser.

    Attributes
    ----------
    laser : Laser
        As solved.
    sigma_normal : float
        Standard deviation of the normal's direction, along the worst axis, in radians.
    sigma_offset : float
        Standard deviation of the offset, in metres.
    rms_px, rms : float
        Root mean square distance of stripe points, by bins, from the sheet: in pixels across the
        stripe, and in metres.
    n_points, n_outliers : int
        Stripe points used, and outliers among them.
    n_effective : float
        Number of independent measurements that the points are worth.
    surfaces : tuple of str
        Surfaces that the laser was seen on.
    n_views : int
        Number of pictures that it was seen in.
    paper_plane : Plane
        By the paper's method (Eq. 33-36), for comparison: poses by distances in space, then the
        pseudo-inverse.
    sheet : str
        In words, the chosen model of the sheet and the reason.
    """

    laser: Laser
    sigma_normal: float
    sigma_offset: float
    rms_px: float
    rms: float
    n_points: int
    n_outliers: int
    n_effective: float
    surfaces: tuple[str, ...]
    n_views: int
    paper_plane: Plane
    sheet: str


@dataclass(frozen=True, slots=True)
class ViewFigures:
    """Figures of one picture of the calibration.

    Attributes
    ----------
    name : str
        File name.
    dome_from_target : SE3
        Pose by corners and stripes together.
    rms_corners_px, rms_stripes_px : float
        Of the inliers; NaN if there are none.
    n_corners, n_corners_rejected, n_stripe_points : int
        Corners found, outliers among them, and stripe points on surfaces.
    spatial_pose : SE3
        `dome_from_target` by the paper's cost (Eq. 32-33).
    spatial_cost : float
        The paper's V at its minimum, in square metres.
    spatial_rms : float
        Root mean square distance of corners from their rays, in metres.
    pose_angle, pose_shift : float
        Difference of the two poses, in radians, and in metres at the middle of the corners.
    corners_px, corner_residuals_px : array, shape (N, 2)
        Measured corners, and their residuals.
    corner_inliers : bool array, shape (N,)
        Inlier corners.
    """

    name: str
    dome_from_target: SE3
    rms_corners_px: float
    rms_stripes_px: float
    n_corners: int
    n_corners_rejected: int
    n_stripe_points: int
    spatial_pose: SE3
    spatial_cost: float
    spatial_rms: float
    pose_angle: float
    pose_shift: float
    corners_px: FloatArray
    corner_residuals_px: FloatArray
    corner_inliers: BoolArray


@dataclass(frozen=True, slots=True)
class LaserCalibration:
    """Result of a calibration of lasers.

    Attributes
    ----------
    rig : Rig
        With the lasers, and the camera's numbers if they were refined.
    uncertainty : RigUncertainty
        Joint, of all numbers that were uncertain before and of the lasers.
    lasers : tuple of LaserFigures
        In the order of `rig.lasers`.
    views : tuple of ViewFigures
        Pictures that were used.
    left_out : dict
        Names of the others, with the reason.
    warnings : tuple of str
        Warnings for the user, in words.
    refined : bool
        Whether the camera's numbers were solved too.
    """

    rig: Rig
    uncertainty: RigUncertainty
    lasers: tuple[LaserFigures, ...]
    views: tuple[ViewFigures, ...]
    left_out: dict[str, str]
    warnings: tuple[str, ...]
    refined: bool


@dataclass(frozen=True, slots=True)
class SolvedLasers:
    """A solved problem with its parts."""

    problem: LaserProblem
    solution: Solution[LaserState]
    views: tuple[PlacedView, ...]

    @property
    def state(self) -> LaserState:
        """The solution."""
        return self.solution.state

    def stripe_residuals_px(self, i_group: int) -> tuple[FloatArray, BoolArray]:
        """Return a group's residuals (B,) in pixels, and the mask of inliers."""
        group = self.problem.groups[i_group]
        residuals = self.solution.blocks[i_group].residuals[:, 0]
        return residuals * group.sigma_px, self.solution.inliers[i_group]

    def groups_of(self, *, laser: int | None = None, view: int | None = None) -> list[int]:
        """Return the groups of a laser, or of a view."""
        return [
            i
            for i, group in enumerate(self.problem.groups)
            if (laser is None or group.laser == laser) and (view is None or group.view == view)
        ]


def laser_figures(
    solved: SolvedLasers,
    joint: JointResult,
    lasers: Sequence[Laser],
    papers: Sequence[Plane],
    words: Sequence[str],
) -> list[LaserFigures]:
    """Return the figures of every laser."""
    return [
        _laser_figures(solved, joint, i, laser, papers[i], words[i])
        for i, laser in enumerate(lasers)
    ]


def _laser_figures(
    solved: SolvedLasers, joint: JointResult, i_laser: int, laser: Laser, paper: Plane, words: str
) -> LaserFigures:
    mine = solved.groups_of(laser=i_laser)
    groups = [solved.problem.groups[i] for i in mine]
    residuals, inside, weights, metres = _stripes(solved, mine)
    covariance = joint.lasers[3 * i_laser : 3 * i_laser + 3, 3 * i_laser : 3 * i_laser + 3]
    on = sorted({int(s) for group in groups for s in group.surface})
    return LaserFigures(
        laser=laser,
        sigma_normal=float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])),
        sigma_offset=float(np.sqrt(covariance[2, 2])),
        rms_px=_rms(residuals[inside], weights[inside]),
        rms=_rms(metres[inside], weights[inside]),
        n_points=int(weights.sum()),
        n_outliers=int(weights[~inside].sum()),
        n_effective=float(np.count_nonzero(inside)) / joint.correlation[i_laser],
        surfaces=tuple(solved.problem.surfaces.names[i] for i in on),
        n_views=len({group.view for group in groups}),
        paper_plane=paper,
        sheet=words,
    )


def _stripes(
    solved: SolvedLasers, groups: Sequence[int]
) -> tuple[FloatArray, BoolArray, IntArray, FloatArray]:
    """Return residuals (px), inlier mask, counts and distances (m) of groups' bins."""
    parts = [solved.stripe_residuals_px(i) for i in groups]
    none = np.zeros(0)
    residuals = np.concatenate([none, *[p[0] for p in parts]])
    inside = np.concatenate([np.zeros(0, np.bool_), *[p[1] for p in parts]])
    members = [solved.problem.groups[i] for i in groups]
    weights = np.concatenate([np.zeros(0, np.int64), *[g.counts for g in members]])
    distances = [distances_of(solved.problem, solved.state, g) for g in members]
    return residuals, inside, weights, np.concatenate([none, *distances])


def _rms(values: FloatArray, weights: IntArray) -> float:
    if not len(values):
        return float("nan")
    return float(np.sqrt(np.average(values**2, weights=weights)))


def view_figures(solved: SolvedLasers) -> list[ViewFigures]:
    """Return the figures of every picture."""
    return [_view_figures(solved, i, view) for i, view in enumerate(solved.views)]


def _view_figures(solved: SolvedLasers, i_view: int, view: PlacedView) -> ViewFigures:
    n_groups = len(solved.problem.groups)
    block = solved.solution.blocks[n_groups + i_view]
    inside = solved.solution.inliers[n_groups + i_view]
    corners = block.residuals * CORNER_SIGMA_PX
    residuals, believed, weights, _ = _stripes(solved, solved.groups_of(view=i_view))
    pose = solved.state.bundle.poses[i_view]
    angle, shift = pose_difference(
        pose, view.spatial.dome_from_target, view.view.points.mean(axis=0)
    )
    squares = np.sum(corners[inside] ** 2, axis=1)
    rejected = view.n_corners_rejected + int(np.count_nonzero(~inside))
    return ViewFigures(
        name=view.view.name,
        dome_from_target=pose,
        rms_corners_px=float(np.sqrt(np.mean(squares))) if len(squares) else float("nan"),
        rms_stripes_px=_rms(residuals[believed], weights[believed]),
        n_corners=len(view.view) + view.n_corners_rejected,
        n_corners_rejected=rejected,
        n_stripe_points=len(view.placed),
        spatial_pose=view.spatial.dome_from_target,
        spatial_cost=view.spatial.cost,
        spatial_rms=view.spatial.rms,
        pose_angle=angle,
        pose_shift=shift,
        corners_px=view.view.pixels,
        corner_residuals_px=corners,
        corner_inliers=inside,
    )
