"""Bundle adjustment through the dome: views of targets, one camera, one or several media.

The common problem of `calibrate camera`, `calibrate dome` and the poses of `calibrate lasers`:
reprojection residuals of all corners, with analytic derivatives by the camera's numbers, the
indices of the media and the targets' poses; and priors as residuals, of a rig's numbers, of the
indices of media, and of a board's pose.

A step of a pose has six numbers: a rotation vector about a point of the target (the middle of the
view's points) and a shift, both in `dome`. Poses are solved, and their covariance is given, in such
steps (`moved_target`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from aqualvs.calibration.solver.least_squares import Block, RobustLoss
from aqualvs.calibration.targets.targets import View
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec, rotvec_from_rotation, skew
from aqualvs.optics.camera import POSE_PARAMETERS, Camera, parameter_names
from aqualvs.optics.rig import Rig, RigUncertainty, rig_moved_by
from aqualvs.optics.solved import rig_numbers

DISTANCES = "distances"
TILTS = "tilts"
ROLLS = "rolls"


@dataclass(frozen=True, slots=True)
class KnownDistance:
    """Prior on a pose: the board's measured distance along the dome's y axis (paper, 2.2)."""

    distance: float  # Of the board's plane from the dome's centre, in metres.
    sigma: float  # Its standard deviation, in metres.

    def blocks(self, dome_from_target: SE3, centre: FloatArray, columns: IntArray) -> list[Block]:
        """Return one residual, found minus given distance, by a step of `moved_target`."""
        normal = dome_from_target.rotation[:, 2]
        found = plane_distance(dome_from_target)
        # normal x (centre - found * y axis), written out.
        nx, ny, nz = normal.tolist()
        x, y, z = float(centre[0]), float(centre[1]) - found, float(centre[2])
        by_turn = np.array([ny * z - nz * y, nz * x - nx * z, nx * y - ny * x])
        jacobian = np.concatenate([by_turn, normal]) / (normal[1] * self.sigma)
        residual = np.array([[(found - self.distance) / self.sigma]])
        return [Block(DISTANCES, columns, residual, jacobian[None, None, :], scaled=False)]


@dataclass(frozen=True, slots=True)
class SquareBoard:
    """Prior on a pose: the board stands square to the dome's axes, with possible outliers."""

    square: FloatArray  # Shape (3, 3): `dome_from_target` rotation of a board without tilt.
    # Standard deviations of well set up boards, in radians about each axis; boards far beyond count
    # little (Cauchy), so that the square majority decides. Tilt (about x and z) and roll (about y)
    # are judged separately: a rail keeps the roll of all.
    board_tilt_sigma: float
    roll_sigma: float

    def blocks(self, dome_from_target: SE3, centre: FloatArray, columns: IntArray) -> list[Block]:
        """Return the tilt of the board (about x and z), and its roll (about y)."""
        del centre
        off_square = dome_from_target.rotation @ self.square.T
        # The axis of the rotation times the sine of its angle.
        r = off_square
        tilt = 0.5 * np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
        by_turn = 0.5 * (np.trace(off_square) * np.eye(3) - off_square)

        def block(group: str, axes: list[int], sigma: float) -> Block:
            off, slopes = tilt[None, axes] / sigma, by_turn[None, axes, :] / sigma
            return Block(group, columns[:3], off, slopes, RobustLoss.CAUCHY, scaled=False)

        return [block(TILTS, [0, 2], self.board_tilt_sigma), block(ROLLS, [1], self.roll_sigma)]


def plane_distance(dome_from_target: SE3) -> float:
    """Return where a board's plane (its z = 0) meets the dome's y axis, in metres, or NaN."""
    normal = dome_from_target.rotation[:, 2]
    if normal[1] == 0.0:
        return float("nan")
    return float(normal @ dome_from_target.translation / normal[1])


PRIORS = "priors"
_ROTATION = POSE_PARAMETERS[3:]


def rig_difference(start: Rig, rig: Rig, names: Sequence[str]) -> FloatArray:
    """Return the step (P,) of `rig_moved_by` that leads from `start` to `rig`, by named numbers."""
    a, b = rig_numbers(start), rig_numbers(rig)
    turn = rotvec_from_rotation(rig.dome_from_cam.rotation @ start.dome_from_cam.rotation.T)
    rotation = dict(zip(_ROTATION, turn, strict=True))
    return np.array([rotation[n] if n in rotation else b[n] - a[n] for n in names])


def _prior(columns: IntArray, moved: FloatArray, whiten: FloatArray) -> Block:
    residuals = (whiten @ moved)[:, None]
    return Block(PRIORS, columns, residuals, whiten[:, None, :], RobustLoss.SQUARE, False)


def moved_target(pose: SE3, middle: FloatArray, step: FloatArray) -> SE3:
    """Return `dome_from_target` turned about a point of the target, then shifted.

    `middle` (3,) is that point in the target's frame; `step` (6,) has a rotation vector (radians)
    and a shift (metres), both in `dome`.
    """
    turn, arm = rotation_from_rotvec(step[:3]), pose.rotation @ middle
    # The middle lies at arm + translation, and stays there under the turn.
    return SE3(turn @ pose.rotation, arm - turn @ arm + pose.translation + step[3:])


def point_by_pose(points_in_dome: FloatArray, centre: FloatArray) -> FloatArray:
    """Return the derivative (N, 3, 6) of points (N, 3) by the step of `moved_target` at zero.

    `centre` (3,): of the turn, in `dome`.
    """
    by_pose = np.zeros((len(points_in_dome), 3, 6))
    by_pose[:, :, :3] = -skew(points_in_dome - centre)
    by_pose[:, :, 3:] = np.eye(3)
    return by_pose


CORNERS = "corners"
CORNER_SIGMA_PX = 0.1
"""Nominal noise of a corner; solves estimate the real one."""


def _cross(arms: FloatArray, by_point: FloatArray) -> FloatArray:
    """Return the derivative (N, 2, 3) by a turn of points at arms (N, 3) from its centre."""
    x, y, z = arms[:, 0, None], arms[:, 1, None], arms[:, 2, None]
    gx, gy, gz = by_point[..., 0], by_point[..., 1], by_point[..., 2]
    return np.stack([y * gz - z * gy, z * gx - x * gz, x * gy - y * gx], axis=-1)


_N_WATER = "n_water"


@dataclass(frozen=True, slots=True)
class TargetView:
    """A view with the starting pose of its target and the priors on it."""

    view: View  # Points and pixels.
    medium: int  # Index into `BundleState.media`.
    dome_from_target: SE3  # Initial guess of the pose, or the exact pose.
    fixed: bool = False  # Whether the pose is exact.
    # Priors on the pose.
    distance: KnownDistance | None = None
    square: SquareBoard | None = None


@dataclass(frozen=True, slots=True)
class BundleState:
    """Unknowns of a bundle."""

    rig: Rig  # Camera and housing; its own `n_water` plays no part.
    media: FloatArray  # Shape (M,): refractive indices outside the dome.
    poses: tuple[SE3, ...]  # `dome_from_target` of every view.

    def only(self, keep: Sequence[int]) -> "BundleState":
        """Return the state of some of the views."""
        return replace(self, poses=tuple(self.poses[i] for i in keep))

    def camera(self, medium: int) -> Camera:
        """Return the camera looking into one of the media."""
        return self.rig.in_water(float(self.media[medium])).camera()


@dataclass(frozen=True, slots=True)
class Bundle:
    """Bundle adjustment as a problem of `least_squares.solve`.

    Columns: the rig's free numbers, the free media, then six for each view whose pose is free (a
    turn about the middle of its points, radians in `dome`, and a shift, metres).
    """

    views: tuple[TargetView, ...]
    # Names of the rig's numbers that are solved for, as in `parameter_names`, without `n_water`.
    free: tuple[str, ...]
    # Initial guess, and mean of the priors.
    start: BundleState
    # Uncertainty of the start; numbers that it does not name have no prior.
    priors: RigUncertainty
    # Shape (M,): standard deviation of the start's media: 0 keeps one exact, infinite leaves it
    # free.
    media_sigma: FloatArray

    @property
    def free_media(self) -> list[int]:
        """Indices of the media that are solved for."""
        return [i for i, sigma in enumerate(self.media_sigma) if sigma > 0.0]

    @property
    def n_shared(self) -> int:
        """Columns that all views share."""
        return len(self.free) + len(self.free_media)

    @property
    def n_parameters(self) -> int:
        """Length of a step."""
        return self.n_shared + 6 * sum(not v.fixed for v in self.views)

    def only(self, keep: Sequence[int]) -> "Bundle":
        """Return the problem of some of its views."""
        views = tuple(self.views[i] for i in keep)
        return replace(self, views=views, start=self.start.only(keep))

    def medium_columns(self, medium: int) -> IntArray:
        """Return the column of a medium; none if it is exact."""
        free = self.free_media
        return np.array([len(self.free) + free.index(medium)] if medium in free else [], np.int64)

    def pose_columns(self, i_view: int) -> IntArray:
        """Return the columns of a view's pose; none if it is exact."""
        if self.views[i_view].fixed:
            return np.zeros(0, np.int64)
        first = self.n_shared + 6 * sum(not v.fixed for v in self.views[:i_view])
        return np.arange(first, first + 6)

    def blocks(self, state: BundleState) -> list[Block]:
        """Return the residuals: one block of corners a view, in order; then all priors."""
        return [*self._corner_blocks(state), *self._known(state), *self._priors(state)]

    def moved(self, state: BundleState, step: FloatArray) -> BundleState:
        """Return the state moved by a step (P,)."""
        media = state.media.copy()
        media[self.free_media] += step[len(self.free) : self.n_shared]
        poses = list(state.poses)
        for i, target in enumerate(self.views):
            if not target.fixed:
                poses[i] = moved_target(poses[i], target.view.middle, step[self.pose_columns(i)])
        rig = rig_moved_by(state.rig, self.free, step[: len(self.free)])
        return BundleState(rig, media, tuple(poses))

    def _corner_blocks(self, state: BundleState) -> list[Block]:
        """Return the corners' residuals; views of one medium are projected together."""
        by_view: dict[int, Block] = {}
        for medium in range(len(state.media)):
            mine = [i for i, target in enumerate(self.views) if target.medium == medium]
            if not mine:
                continue
            camera, column = state.camera(medium), self.medium_columns(medium)
            shared = (*self.free, *([_N_WATER] if len(column) else []))
            views, poses = [self.views[i].view for i in mine], [state.poses[i] for i in mine]
            seen = list(zip(views, poses, strict=True))
            counts = [len(view) for view in views]
            points = np.concatenate([v.points @ p.rotation.T + p.translation for v, p in seen])
            centres = np.repeat([p.apply(v.middle) for v, p in seen], counts, axis=0)
            pixels, _, by_point, by_number = camera.project_with_parameter_jacobian(points)
            residuals = (pixels - np.concatenate([v.pixels for v in views])) / CORNER_SIGMA_PX
            names = parameter_names(camera)
            jacobian = np.empty((len(points), 2, len(shared) + 6))
            jacobian[:, :, : len(shared)] = by_number[:, :, [names.index(name) for name in shared]]
            jacobian[:, :, len(shared) : -3] = _cross(points - centres, by_point)
            jacobian[:, :, -3:] = by_point
            jacobian /= CORNER_SIGMA_PX
            for i, n, end in zip(mine, counts, np.cumsum(counts), strict=True):
                columns = [np.arange(len(self.free)), column, self.pose_columns(i)]
                joined, rows = np.concatenate(columns), slice(end - n, end)
                by_view[i] = Block(
                    CORNERS, joined, residuals[rows], jacobian[rows, :, : len(joined)]
                )
        return [by_view[i] for i in range(len(self.views))]

    def _known(self, state: BundleState) -> list[Block]:
        return [
            block
            for i, (target, pose) in enumerate(zip(self.views, state.poses, strict=True))
            if not target.fixed
            for term in (target.distance, target.square)
            if term is not None
            for block in term.blocks(pose, pose.apply(target.view.middle), self.pose_columns(i))
        ]

    def _priors(self, state: BundleState) -> list[Block]:
        """Return the deviations of the rig and of media from their priors, in sigmas."""
        blocks = []
        known = [name for name in self.free if name in self.priors.names]
        if known:
            columns = np.array([self.free.index(name) for name in known])
            covariance = self.priors.of(known)
            sigma = np.sqrt(np.diag(covariance))
            # whiten.T @ whiten is the inverse of the covariance, whatever its units.
            lower = np.linalg.cholesky(covariance / np.outer(sigma, sigma))
            whiten = np.linalg.inv(lower) / sigma
            moved = rig_difference(self.start.rig, state.rig, known)
            blocks.append(_prior(columns, moved, whiten))
        bounded = [i for i in self.free_media if np.isfinite(self.media_sigma[i])]
        if bounded:
            columns = np.concatenate([self.medium_columns(i) for i in bounded])
            moved = state.media[bounded] - self.start.media[bounded]
            blocks.append(_prior(columns, moved, np.diag(1.0 / self.media_sigma[bounded])))
        return blocks
