"""Refusals of `calibrate camera`, and where in the picture its intrinsics are to be trusted."""

from collections.abc import Sequence

import numpy as np

from aqualvs.calibration.bundle import CORNER_SIGMA_PX, CORNERS, BundleState
from aqualvs.calibration.degenerate import unbelievable_distance
from aqualvs.calibration.least_squares import Solution
from aqualvs.calibration.view import View
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import FloatArray, IntArray

COVERAGE_CELLS = (6, 8)
"""Rows and columns of the coverage grid."""
_MIN_VIEWS = 3
_MIN_POINTS = 60
# Corners noisier than this mean that something else is wrong than noise.
_MAX_NOISE_PX = 1.0
# Focal lengths (share) and image centre (share of the width) known worse than this are of no use.
_MAX_FOCAL_SIGMA, _MAX_CENTRE_SIGMA = 0.01, 0.02
# Views whose boards lean less than this from each other are parallel.
_PARALLEL = np.deg2rad(5.0)


def check_camera_views(views: Sequence[View], size_px: tuple[int, int]) -> None:
    """Refuse views that are too few, or are not of this size.

    Raises
    ------
    CalibrationError
        With what there is and what it takes.
    """
    if len(views) < _MIN_VIEWS:
        raise CalibrationError(
            f"{len(views)} pictures show the board; the camera needs {_MIN_VIEWS} at least, and "
            "15 to 20 from different sides to be good"
        )
    points = sum(len(view) for view in views)
    if points < _MIN_POINTS:
        raise CalibrationError(
            f"{points} board corners in {len(views)} pictures; the camera needs {_MIN_POINTS} at "
            "least; show more of the board, or more often"
        )
    for view in views:
        inside = np.all((view.pixels > -1.0) & (view.pixels < size_px), axis=1)
        if not inside.all():
            raise CalibrationError(
                f"{view.name}: corners outside a picture of {size_px[0]}x{size_px[1]} px; all "
                "pictures of a calibration must have one size"
            )


def check_camera_solution(
    solution: Solution[BundleState], covariance: FloatArray, views: Sequence[View]
) -> None:
    """Refuse intrinsics that do not explain the views, or that the views do not determine.

    Parameters
    ----------
    solution : Solution
    covariance : array, shape (P, P)
        Of the intrinsics, by corners: focal lengths and image centre first.
    views : sequence of View

    Raises
    ------
    CalibrationError
        With the likely cause and the remedy.
    """
    noise = CORNER_SIGMA_PX * solution.scales[CORNERS]
    if noise > _MAX_NOISE_PX:
        raise CalibrationError(
            f"no camera explains the views: corners are {noise:.2g} px off (0.1 px is usual); "
            "check squares_x, squares_y and the dictionary against the print, that the board is "
            "flat, and that zoom and focus stood still"
        )
    _check_determined(solution, covariance)
    poses = solution.state.poses
    away = [np.linalg.norm(p.apply(v.middle)) for p, v in zip(poses, views, strict=True)]
    fault = unbelievable_distance(np.array(away), [view.name for view in views])
    if fault is not None:
        raise CalibrationError(fault)


def _check_determined(solution: Solution[BundleState], covariance: FloatArray) -> None:
    rig = solution.state.rig
    sigma = np.sqrt(np.diag(covariance)[:4])
    focal = max(sigma[0] / rig.lens.fx, sigma[1] / rig.lens.fy)
    centre = float(sigma[2:].max()) / rig.size_px[0]
    normals = np.array([pose.rotation[:, 2] for pose in solution.state.poses])
    lean = float(np.arccos(np.clip(np.abs(normals @ normals.T), 0.0, 1.0).min()))
    remedy = (
        f"all boards are parallel within {np.rad2deg(lean):.1f} deg: tilt the board by 20 to 40 "
        "degrees, to different sides"
        if lean < _PARALLEL
        else "take more views, with the board tilted by 20 to 40 degrees to different sides, near, "
        "and in all parts of the picture"
    )
    if not focal < _MAX_FOCAL_SIGMA:
        raise CalibrationError(
            f"the views do not determine the focal length ({100.0 * focal:.2g} % uncertain); "
            f"{remedy}"
        )
    if not centre < _MAX_CENTRE_SIGMA:
        raise CalibrationError(
            f"the views do not determine the image centre ({float(sigma[2:].max()):.2g} px "
            f"uncertain); {remedy}"
        )
    if not solution.converged:
        raise CalibrationError(f"the solve does not come to rest; {remedy}")


def coverage(pixels: FloatArray, size_px: tuple[int, int]) -> IntArray:
    """Return how many pixels (N, 2) fall into each cell of a grid over the picture."""
    rows, columns = COVERAGE_CELLS
    width, height = size_px
    counts, _, _ = np.histogram2d(
        pixels[:, 1] + 0.5,
        pixels[:, 0] + 0.5,
        bins=(rows, columns),
        range=((0.0, height), (0.0, width)),
    )
    return counts.astype(np.int64)


def pixel_grid(size_px: tuple[int, int]) -> FloatArray:
    """Return the pixels (N, 2) of a grid over the picture, borders included."""
    rows, columns = COVERAGE_CELLS
    u, v = np.meshgrid(
        np.linspace(0.0, size_px[0] - 1.0, columns + 1),
        np.linspace(0.0, size_px[1] - 1.0, rows + 1),
    )
    return np.stack([u.ravel(), v.ravel()], axis=-1)
