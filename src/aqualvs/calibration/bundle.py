"""Bundle adjustment through the dome: views of targets, one camera, one or several media.

The one problem behind `calibrate camera`, `calibrate dome` and the poses of `calibrate lasers`:
reprojection residuals of all corners, with analytic derivatives by the camera's numbers, the media
outside and the targets' poses.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from aqualvs.calibration.blocks import Block
from aqualvs.calibration.corner_blocks import CORNER_SIGMA_PX, CORNERS, PosedView, corner_blocks
from aqualvs.calibration.pose_steps import moved_target, moved_targets, point_by_pose
from aqualvs.calibration.rig_priors import PRIORS, media_prior, rig_difference, rig_prior
from aqualvs.calibration.view import View
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import Rig
from aqualvs.optics.uncertainty import RigUncertainty, rig_moved_by

__all__ = [
    "CORNERS",
    "CORNER_SIGMA_PX",
    "PRIORS",
    "Bundle",
    "BundleState",
    "PoseTerm",
    "TargetView",
    "moved_target",
    "point_by_pose",
    "rig_difference",
]

_N_WATER = "n_water"


class PoseTerm(Protocol):
    """What is known beforehand about the pose of one target, as residuals of it."""

    def blocks(self, dome_from_target: SE3, centre: FloatArray, columns: IntArray) -> list[Block]:
        """Return residuals and their derivative by a step of the pose, see `pose_steps`."""


@dataclass(frozen=True, slots=True)
class TargetView:
    """One view with all that is given about it.

    Attributes
    ----------
    view : View
        Points and pixels.
    medium : int
        Index into `BundleState.media`.
    dome_from_target : SE3
        Start of the pose, or the pose itself.
    fixed : bool
        Whether the pose is exact.
    known : tuple of PoseTerm
        What else is known about the pose.
    """

    view: View
    medium: int
    dome_from_target: SE3
    fixed: bool = False
    known: tuple[PoseTerm, ...] = ()


@dataclass(frozen=True, slots=True)
class BundleState:
    """What a bundle solves for.

    Attributes
    ----------
    rig : Rig
        Camera and housing; its own `n_water` plays no part.
    media : array, shape (M,)
        Refractive indices outside the dome.
    poses : tuple of SE3
        `dome_from_target` of every view.
    """

    rig: Rig
    media: FloatArray
    poses: tuple[SE3, ...]

    def camera(self, medium: int) -> Camera:
        """Return the camera as it looks into one of the media."""
        return self.rig.in_water(float(self.media[medium])).camera()


@dataclass(frozen=True, slots=True)
class Bundle:
    """The problem; see `least_squares.solve`.

    Columns: the rig's free numbers, the free media, then six for each view whose pose is free (a
    turn about the middle of its points, radians in `dome`, and a shift, metres).

    Attributes
    ----------
    views : tuple of TargetView
    free : tuple of str
        Names of the rig's numbers that are solved for, as `parameter_names` has them, `n_water`
        not among them.
    start : BundleState
        Where the solve starts, and what priors are centred on.
    priors : RigUncertainty
        How well the start is known; numbers it does not name have no prior.
    media_sigma : array, shape (M,)
        How well the start's media are known: 0 keeps one exact, infinite leaves it free.
    """

    views: tuple[TargetView, ...]
    free: tuple[str, ...]
    start: BundleState
    priors: RigUncertainty
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

    def medium_columns(self, medium: int) -> IntArray:
        """Return the column of a medium; none where it is exact."""
        free = self.free_media
        return np.array([len(self.free) + free.index(medium)] if medium in free else [], np.int64)

    def pose_columns(self, i_view: int) -> IntArray:
        """Return the columns of a view's pose; none where it is exact."""
        if self.views[i_view].fixed:
            return np.zeros(0, np.int64)
        first = self.n_shared + 6 * sum(not v.fixed for v in self.views[:i_view])
        return np.arange(first, first + 6)

    def blocks(self, state: BundleState) -> list[Block]:
        """Return the residuals: one block of corners a view, in order; what is known; priors."""
        return [*self._corner_blocks(state), *self._known(state), *self._priors(state)]

    def moved(self, state: BundleState, step: FloatArray) -> BundleState:
        """Return the state moved by a step (P,)."""
        media = state.media.copy()
        media[self.free_media] += step[len(self.free) : self.n_shared]
        free = [i for i, target in enumerate(self.views) if not target.fixed]
        poses = list(state.poses)
        moved = moved_targets(
            [poses[i] for i in free],
            [self.views[i].view.middle for i in free],
            step[self.n_shared :].reshape(-1, 6),
        )
        for i, pose in zip(free, moved, strict=True):
            poses[i] = pose
        rig = rig_moved_by(state.rig, self.free, step[: len(self.free)])
        return BundleState(rig, media, tuple(poses))

    def _corner_blocks(self, state: BundleState) -> list[Block]:
        by_view: dict[int, Block] = {}
        for medium in range(len(state.media)):
            mine = [i for i, v in enumerate(self.views) if v.medium == medium]
            column = self.medium_columns(medium)
            shared = np.concatenate([np.arange(len(self.free)), column])
            views = [
                PosedView(self.views[i].view, state.poses[i], shared, self.pose_columns(i))
                for i in mine
            ]
            names = (*self.free, *([_N_WATER] if len(column) else []))
            blocks = corner_blocks(state.camera(medium), names, views)
            by_view.update(zip(mine, blocks, strict=True))
        return [by_view[i] for i in range(len(self.views))]

    def _known(self, state: BundleState) -> list[Block]:
        return [
            block
            for i, (target, pose) in enumerate(zip(self.views, state.poses, strict=True))
            if not target.fixed
            for term in target.known
            for block in term.blocks(pose, pose.apply(target.view.middle), self.pose_columns(i))
        ]

    def _priors(self, state: BundleState) -> list[Block]:
        media, free = self.free_media, self.free
        return rig_prior(self.start.rig, state.rig, free, self.priors) + media_prior(
            self.start.media[media],
            state.media[media],
            self.media_sigma[media],
            np.arange(len(free), self.n_shared),
        )
