"""How good lasers are on pictures that they were not calibrated from: leave one out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.calibration.laser_candidates import plane_residuals_px
from aqualvs.calibration.laser_report import LaserCalibration
from aqualvs.calibration.laser_views import LaserView, PlacedView, place_views, pooled
from aqualvs.calibration.lasers import LaserOptions, calibrate_lasers
from aqualvs.calibration.stripes_on_planes import PooledStripes, Surfaces
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Rig
from aqualvs.optics.uncertainty import RigUncertainty

# Where the board says that a laser's stripe is, to tell the lasers from each other.
_NEAR_PX = 8.0
_FEWEST_POINTS = 20
_N_FITS = 10


@dataclass(frozen=True, slots=True)
class HeldOutView:
    """One picture, measured by lasers that were calibrated from the others.

    Attributes
    ----------
    name : str
        File name.
    n_lasers : int
        Lasers that were seen in it.
    by_lasers, by_board : Plane
        The surface in `dome` as the lasers measure it, and as the board's corners tell it.
    range_error, pitch_error, yaw_error : float
        Lasers minus board, in metres and radians; of the board's own errors, too.
    """

    name: str
    n_lasers: int
    by_lasers: Plane
    by_board: Plane
    range_error: float
    pitch_error: float
    yaw_error: float


def leave_one_out(
    rig: Rig,
    views: Sequence[LaserView],
    surfaces: Surfaces,
    *,
    options: LaserOptions | None = None,
    uncertainty: RigUncertainty | None = None,
) -> list[HeldOutView]:
    """Calibrate without each picture in turn, and measure that picture's board with the lasers.

    Parameters
    ----------
    rig, views, surfaces, options, uncertainty
        As `calibrate_lasers`; the target must be a board.

    Returns
    -------
    list of HeldOutView
        One for each picture.

    Raises
    ------
    CalibrationError
        If a calibration fails, or a picture shows too little to be measured.
    """
    if len(surfaces.planes) != 1:
        raise CalibrationError("pictures are left out in turn only with a board, not with a box")
    found = []
    for i, view in enumerate(views):
        others = [*views[:i], *views[i + 1 :]]
        calibration = calibrate_lasers(
            rig, others, surfaces, options=options, uncertainty=uncertainty
        )
        found.append(_measured(calibration, view, surfaces, options or LaserOptions()))
    return found


def _measured(
    calibration: LaserCalibration, view: LaserView, surfaces: Surfaces, options: LaserOptions
) -> HeldOutView:
    rig = calibration.rig
    seen_rig = rig if options.n_medium is None else rig.in_water(options.n_medium)
    placed = place_views(seen_rig.camera(), [view], surfaces)[0][0]
    planes = [figures.laser.plane for figures in calibration.lasers]
    points, laser = _triangulated(seen_rig, placed, pooled([placed], surfaces), planes)
    if len(points) < _FEWEST_POINTS or len(np.unique(laser)) < 2:
        raise CalibrationError(
            f"{view.view.name}: {len(points)} points on {len(np.unique(laser))} stripes; a plane "
            "needs two stripes"
        )
    by_lasers = fitted(points)
    by_board = surfaces.placed(0, placed.dome_from_target).facing_origin()
    ours, theirs = posture(by_lasers), posture(by_board)
    return HeldOutView(
        name=view.view.name,
        n_lasers=len(np.unique(laser)),
        by_lasers=by_lasers,
        by_board=by_board,
        range_error=ours[0] - theirs[0],
        pitch_error=ours[1] - theirs[1],
        yaw_error=ours[2] - theirs[2],
    )


def _triangulated(
    rig: Rig, view: PlacedView, stripes: PooledStripes, planes: Sequence[Plane]
) -> tuple[FloatArray, FloatArray]:
    """Return points (N, 3) where pixels meet their laser's plane, and which laser's it is."""
    residuals = np.abs(plane_residuals_px(stripes.placed, planes))
    nearest = np.argmin(residuals, axis=1)
    near = residuals[np.arange(len(nearest)), nearest] <= _NEAR_PX
    laser = nearest[near]
    rays = rig.camera().rays(view.stripes.pixels[stripes.placed.index[near]])
    points = np.full((len(laser), 3), np.nan)
    for i, plane in enumerate(planes):
        mine = laser == i
        points[mine] = plane.intersect(rays)[0][mine]
    seen = np.all(np.isfinite(points), axis=1)
    return points[seen], laser[seen]


def fitted(points: FloatArray) -> Plane:
    """Fit a plane to points (N, 3), robustly (Cauchy weights); it faces away from the origin."""
    weights = np.ones(len(points))
    for _ in range(_N_FITS):
        middle = weights @ points / weights.sum()
        offsets = points - middle
        normal = np.linalg.eigh((weights[:, None] * offsets).T @ offsets)[1][:, 0]
        distance = offsets @ normal
        scale = max(1.4826 * float(np.median(np.abs(distance))), 1e-9)
        weights = 1.0 / (1.0 + (distance / scale) ** 2)
    return Plane(normal, float(normal @ middle)).facing_origin()


def posture(plane: Plane) -> tuple[float, float, float]:
    """Return range (m), pitch and yaw (radians) of a plane, as docs/conventions.md has them."""
    n = plane.normal
    return plane.offset, float(np.arctan2(n[2], n[1])), float(np.arctan2(n[0], n[1]))
