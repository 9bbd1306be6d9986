"""Reprojection residuals of many views at once, with derivatives by camera, medium and poses."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.calibration.blocks import Block
from aqualvs.calibration.view import View
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.camera import Camera, parameter_names

CORNERS = "corners"
CORNER_SIGMA_PX = 0.1
"""Nominal noise of a corner; solves estimate the real one."""


@dataclass(frozen=True, slots=True)
class PosedView:
    """A view, where its target is taken to be, and where its derivatives belong.

    Attributes
    ----------
    view : View
    dome_from_target : SE3
    shared_columns : int array, shape (S,)
        Of the camera's numbers, in the order that `corner_blocks` is given.
    pose_columns : int array, shape (6,) or (0,)
        Of the pose; none where it is exact.
    """

    view: View
    dome_from_target: SE3
    shared_columns: IntArray
    pose_columns: IntArray


def corner_blocks(camera: Camera, shared: Sequence[str], views: Sequence[PosedView]) -> list[Block]:
    """Return one block a view, for views of one medium.

    Parameters
    ----------
    camera : Camera
        As it looks into that medium.
    shared : sequence of str
        The camera's numbers that are solved for, as `parameter_names` has them.
    views : sequence of PosedView
    """
    if not views:
        return []
    counts = [len(v.view) for v in views]
    points = np.concatenate([_in_dome(v) for v in views])
    centres = np.repeat([v.dome_from_target.apply(v.view.middle) for v in views], counts, axis=0)
    pixels, _, by_point, by_number = camera.project_with_parameter_jacobian(points)
    found = np.concatenate([v.view.pixels for v in views])
    residuals = (pixels - found) / CORNER_SIGMA_PX
    names = parameter_names(camera)
    jacobian = np.empty((len(points), 2, len(shared) + 6))
    jacobian[:, :, : len(shared)] = by_number[:, :, [names.index(name) for name in shared]]
    jacobian[:, :, len(shared) : -3] = _cross(points - centres, by_point)
    jacobian[:, :, -3:] = by_point
    jacobian /= CORNER_SIGMA_PX
    ends = np.cumsum(counts)
    return [
        _block(v, len(shared), residuals[end - n : end], jacobian[end - n : end])
        for v, n, end in zip(views, counts, ends, strict=True)
    ]


def _block(posed: PosedView, n_shared: int, residuals: FloatArray, jacobian: FloatArray) -> Block:
    columns = np.concatenate([posed.shared_columns, posed.pose_columns])
    if not len(posed.pose_columns):
        jacobian = jacobian[:, :, :n_shared]
    return Block(CORNERS, columns, residuals, jacobian)


def _in_dome(posed: PosedView) -> FloatArray:
    pose = posed.dome_from_target
    points: FloatArray = posed.view.points @ pose.rotation.T + pose.translation
    return points


def _cross(arms: FloatArray, by_point: FloatArray) -> FloatArray:
    """Return the derivative (N, 2, 3) by a turn of points at arms (N, 3) from its centre."""
    x, y, z = arms[:, 0, None], arms[:, 1, None], arms[:, 2, None]
    gx, gy, gz = by_point[..., 0], by_point[..., 1], by_point[..., 2]
    return np.stack([y * gz - z * gy, z * gx - x * gz, x * gy - y * gx], axis=-1)
