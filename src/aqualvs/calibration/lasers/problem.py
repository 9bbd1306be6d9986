"""The least-squares problem of `calibrate lasers`: corners and stripes, poses, sheets and camera.

The pixel of a stripe sees one point of a surface of the target; the laser's sheet should pass
through that point. The residual is its distance from the sheet, converted to pixels across the
stripe, as it was measured. It depends on the target's pose, the camera's numbers and the sheet's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from aqualvs.calibration.lasers.stripes_on_planes import (
    StripeGroup,
    TargetSurfaces,
    points_on,
    solve_on_surface,
)
from aqualvs.calibration.solver.bundle import Bundle, BundleState, point_by_pose
from aqualvs.calibration.solver.least_squares import Block, RobustLoss
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.camera import Camera, parameter_names
from aqualvs.optics.rig import LASER_PARAMETERS, tangent_basis
from aqualvs.optics.sheet import Sheet

N_LASER = len(LASER_PARAMETERS)
N_BOARD_POSE = 3
BOARD_POSES = "board poses"
"""Group of the priors on a board's pose on its surface."""


@dataclass(frozen=True, slots=True)
class LaserState:
    """Unknowns of the problem."""

    bundle: BundleState  # Camera, medium and poses.
    sheets: tuple[Sheet, ...]  # Sheet of every laser.
    # Shape (V, 3): difference between the surface of the stripes and the target's own in every
    # view: two tilts about the target's middle (radians), and an offset away from the camera
    # (metres).
    board_poses: FloatArray


class _Distances(NamedTuple):
    """Distances of a group's points (N) from their sheet, with derivatives."""

    distance: FloatArray
    by_point: FloatArray
    by_laser: FloatArray
    by_water: FloatArray
    by_air: FloatArray


@dataclass(frozen=True, slots=True)
class LaserProblem:
    """The joint problem of `calibrate lasers`, see `least_squares.solve`.

    Columns: those of `bundle`, then `LASER_PARAMETERS` of every laser, then, with a
    prior on the boards' poses, three for every view.
    """

    bundle: Bundle  # Corners and priors; all views in its first medium.
    surfaces: TargetSurfaces  # Of the target.
    groups: tuple[StripeGroup, ...]  # Stripes; their residuals come before the corners'.
    n_lasers: int
    # Shape (3,): standard deviations of a board's pose, as `LaserState.board_poses`; None if the
    # target is the surface.
    board_pose_prior: FloatArray | None = None

    @property
    def n_parameters(self) -> int:
        """Length of a step."""
        n_board_pose = 0 if self.board_pose_prior is None else N_BOARD_POSE * len(self.bundle.views)
        return self.bundle.n_parameters + N_LASER * self.n_lasers + n_board_pose

    def laser_columns(self, i_laser: int) -> IntArray:
        """Return the columns of a laser."""
        first = self.bundle.n_parameters + N_LASER * i_laser
        return np.arange(first, first + N_LASER)

    def board_pose_columns(self, i_view: int) -> IntArray:
        """Return the columns of a view's board pose; none without a prior."""
        if self.board_pose_prior is None:
            return np.zeros(0, np.int64)
        first = self.bundle.n_parameters + N_LASER * self.n_lasers + N_BOARD_POSE * i_view
        return np.arange(first, first + N_BOARD_POSE)

    def blocks(self, state: LaserState) -> list[Block]:
        """Return the residuals of all stripes, then those of the bundle, then the board poses'."""
        camera = state.bundle.camera(0)
        seen = self._seen(state, camera)
        lit = self._lit(state, [points for points, _ in seen])
        blocks = [
            self._stripe_block(group, moves, distances)
            for group, (_, moves), distances in zip(self.groups, seen, lit, strict=True)
        ]
        blocks += self.bundle.blocks(state.bundle)
        if self.board_pose_prior is not None:
            sigma = self.board_pose_prior
            for i, row in enumerate(state.board_poses):
                columns, off = self.board_pose_columns(i), (row / sigma)[None]
                slopes = np.diag(1.0 / sigma)[None]
                square = RobustLoss.SQUARE
                blocks.append(Block(BOARD_POSES, columns, off, slopes, square, scaled=False))
        return blocks

    def moved(self, state: LaserState, step: FloatArray) -> LaserState:
        """Return the state moved by a step (P,)."""
        n = self.bundle.n_parameters
        bundle = self.bundle.moved(state.bundle, step[:n])
        sheets = []
        for i, sheet in enumerate(state.sheets):
            moves = np.zeros(len(sheet.parameter_names))
            moves[:N_LASER] = step[self.laser_columns(i)]
            moved = replace(sheet, n_air=bundle.rig.n_air, n_water=float(bundle.media[0]))
            sheets.append(moved.moved_by(moves))
        board_pose = state.board_poses
        if self.board_pose_prior is not None:
            board_pose = board_pose + step[-board_pose.size :].reshape(board_pose.shape)
        return LaserState(bundle, tuple(sheets), board_pose)

    def surface_planes(self, state: LaserState, i_view: int) -> list[Plane]:
        """Return the surfaces of the stripes in a view, in `dome`."""
        pose, board_pose = state.bundle.poses[i_view], state.board_poses[i_view]
        planes = self.surfaces.placed(pose)
        if self.board_pose_prior is None:
            return planes
        middle = pose.apply(self.bundle.views[i_view].view.middle)
        return [_displaced(plane, self._tangents(pose), middle, board_pose) for plane in planes]

    def _tangents(self, pose: SE3) -> FloatArray:
        """Return the axes (2, 3) of the tilts in `dome`, fixed to the target."""
        return pose.rotate(tangent_basis(self.surfaces.planes[0].normal))

    def _seen(self, state: LaserState, camera: Camera) -> list[tuple[FloatArray, FloatArray]]:
        """Return for every group its points and their derivatives, see `_moves`."""
        found: dict[int, tuple[FloatArray, FloatArray]] = {}
        for i_view in sorted({group.view for group in self.groups}):
            mine = [i for i, group in enumerate(self.groups) if group.view == i_view]
            groups = [self.groups[i] for i in mine]
            pixels = np.concatenate([group.pixels for group in groups])
            surface = np.concatenate([group.surface for group in groups])
            planes = self.surface_planes(state, i_view)
            points, normals = points_on(camera, pixels, surface, planes)
            moves = self._moves(i_view, points, normals, camera, state.bundle.poses[i_view])
            for i, rows in zip(mine, _rows(groups), strict=True):
                found[i] = points[rows], moves[rows]
        return [found[i] for i in range(len(self.groups))]

    def _lit(self, state: LaserState, points: Sequence[FloatArray]) -> list[_Distances]:
        """Return for every group the distances of its points from their sheet, with derivatives."""
        found: dict[int, _Distances] = {}
        for i_laser in sorted({group.laser for group in self.groups}):
            sheet = state.sheets[i_laser]
            mine = [i for i, group in enumerate(self.groups) if group.laser == i_laser]
            distance, by_point, by_laser = sheet.signed_distance_with_parameter_jacobian(
                np.concatenate([points[i] for i in mine])
            )
            by_water = np.zeros(len(distance))
            if not sheet.is_plane:
                by_water = by_laser[:, sheet.parameter_names.index("n_water")]
            by_air = -by_water * (sheet.n_water / sheet.n_air)
            for i, rows in zip(mine, _rows([self.groups[i] for i in mine]), strict=True):
                of_group = (distance, by_point, by_laser[:, :N_LASER], by_water, by_air)
                found[i] = _Distances(*(values[rows] for values in of_group))
        return [found[i] for i in range(len(self.groups))]

    def _stripe_block(self, group: StripeGroup, moves: FloatArray, lit: _Distances) -> Block:
        bundle = self.bundle
        slopes = np.einsum("ni,nic->nc", lit.by_point, moves)
        # A window refracts light by the ratio of the two.
        if bundle.free_media:
            slopes[:, len(bundle.free)] += lit.by_water
        if "n_air" in bundle.free:
            slopes[:, bundle.free.index("n_air")] += lit.by_air
        slopes = np.concatenate([slopes, lit.by_laser], axis=1)
        columns = [
            np.arange(bundle.n_shared),
            bundle.pose_columns(group.view),
            self.board_pose_columns(group.view),
            self.laser_columns(group.laser),
        ]
        unit = group.gain * group.sigma_px
        return Block(
            f"stripes of laser {group.laser}",
            np.concatenate(columns),
            (lit.distance / unit)[:, None],
            (slopes / unit[:, None])[:, None, :],
            # With free board poses, residuals do not determine the noise of stripes.
            scaled=self.board_pose_prior is None,
        )

    def _moves(
        self, i_view: int, points: FloatArray, normals: FloatArray, camera: Camera, pose: SE3
    ) -> FloatArray:
        """Return the derivatives (N, 3, C) of points by shared numbers and pose at fixed pixels."""
        bundle, view = self.bundle, self.bundle.views[i_view]
        n_free, n_shared = len(bundle.free), bundle.n_shared
        n_pose = 0 if view.fixed else 6
        n_board_pose = len(self.board_pose_columns(i_view))
        right = np.zeros((len(points), 3, n_shared + n_pose + n_board_pose))
        if n_shared:
            _, _, by_point, by_number = camera.project_with_parameter_jacobian(points)
            names = parameter_names(camera)
            wanted = [names.index(name) for name in bundle.free]
            right[:, :2, :n_free] = -by_number[..., wanted]
            if bundle.free_media:
                right[:, :2, n_free] = -by_number[..., names.index("n_water")]
        else:
            _, _, by_point = camera.project_with_jacobian(points)
        middle = pose.apply(view.view.middle)
        if n_pose:
            by_pose = point_by_pose(points, middle)
            right[:, 2, n_shared : n_shared + n_pose] = np.einsum("ni,nic->nc", normals, by_pose)
        if n_board_pose:
            right[:, 2, -N_BOARD_POSE:-1] = -(points - middle) @ self._tangents(pose).T
            right[:, 2, -1] = 1.0
        return solve_on_surface(by_point, normals, right)


def _rows(groups: Sequence[StripeGroup]) -> list[slice]:
    """Return the rows of every group in the joined arrays."""
    ends = np.cumsum([0, *[len(group) for group in groups]]).tolist()
    return [slice(a, b) for a, b in pairwise(ends)]


def _displaced(
    plane: Plane, tangents: FloatArray, middle: FloatArray, board_pose: FloatArray
) -> Plane:
    """Return the plane tilted about the foot of `middle`, and moved along its normal.

    The normal is not normalised, so that the board's pose enters linearly.
    """
    foot = middle - float(plane.signed_distance(middle)) * plane.normal
    normal = plane.normal + board_pose[:2] @ tangents
    return Plane(normal, float(normal @ foot) + float(board_pose[2]))


def distances_of(problem: LaserProblem, state: LaserState, group: StripeGroup) -> FloatArray:
    """Return the distances (B,) of a group's bins from their sheet, in metres."""
    planes = problem.surface_planes(state, group.view)
    points, _ = points_on(state.bundle.camera(0), group.pixels, group.surface, planes)
    return state.sheets[group.laser].signed_distance(points)
