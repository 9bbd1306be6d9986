"""Calibration of the lasers: planes from pictures of a box, board or wall that they shine on.

This is the paper's automatic calibration (section 3.3) with all lasers on at once, several pictures
in one solve, and a covariance that includes the camera's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from aqualvs.calibration.lasers import checks
from aqualvs.calibration.lasers.covariance import CameraCovariance, joint_uncertainty
from aqualvs.calibration.lasers.laser_assignment import (
    BENT_TOLERANCE_PX,
    LaserAssignment,
    assign_lasers,
)
from aqualvs.calibration.lasers.solve import InitialGuess, paper_planes, solve_lasers, tolerance_px
from aqualvs.calibration.lasers.stripes_on_planes import TargetSurfaces
from aqualvs.calibration.lasers.views import LaserView, PlacedView, place_views, pooled
from aqualvs.errors import CalibrationError, OptionError, check_not_negative
from aqualvs.geometry.arrays import IntArray
from aqualvs.optics.rig import Laser, Rig, RigUncertainty


@dataclass(frozen=True, slots=True, kw_only=True)
class LaserOptions:
    """Options of `calibrate_lasers`."""

    # Number of lasers that shine. None for as many as the rig has, or, if it has none, as many as
    # can be distinguished.
    n_lasers: int | None = None
    # Exact index of the medium in the pictures; None for the rig's own water, as uncertain as the
    # rig says.
    n_medium: float | None = None
    # Whether the camera's uncertain numbers are solved too, with their uncertainty as prior; else
    # they are held, and their uncertainty is propagated.
    refine: bool = False
    # Standard deviation of the error that all centres of one laser's stripe share on one surface:
    # by glow in the water, or by a gradient of the surface's lightness.
    stripe_bias_px: float = 0.03
    # Whether a board may lie unevenly on the surface that the stripes are on, or bend. None to
    # decide by the pictures: it does if stripes and corners contradict each other.
    loose: bool | None = None

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        if self.n_lasers is not None and self.n_lasers < 1:
            raise OptionError(f"n_lasers is {self.n_lasers}; use 1 or more")
        check_not_negative("lasers", self, "stripe_bias_px")


def calibrate_lasers(
    rig: Rig,
    views: Sequence[LaserView],
    surfaces: TargetSurfaces,
    *,
    options: LaserOptions | None = None,
    uncertainty: RigUncertainty | None = None,
) -> checks.LaserCalibration:
    """Solve the lasers of a rig from pictures of a target that they shine on.

    Lasers of `rig`, if any, give names, order and windows. `surfaces` are those of the target, by
    `box_surfaces` or `board_surface`. Without an `uncertainty` the camera's numbers are exact.

    Raises
    ------
    CalibrationError
        If the pictures do not determine the lasers, or contradict what is expected.
    OptionError
        If refinement is requested and nothing is uncertain.
    """
    options = options or LaserOptions()
    known = uncertainty or RigUncertainty.none()
    camera_covariance = CameraCovariance.of(rig, known, options.n_medium)
    if options.refine and not camera_covariance.columns:
        raise OptionError(
            "refinement is asked for, but the rig says of none of its camera's numbers how well "
            "it is known; calibrate the camera and dome first, or leave refinement out"
        )
    checks.check_size(views)
    seen_rig = rig if options.n_medium is None else rig.in_water(options.n_medium)
    placed, left_out = place_views(seen_rig.camera(), views, surfaces)
    checks.check_medium(placed, rig, seen_rig)
    checks.check_poses(placed)
    checks.check_distances(placed, rig)
    lasers, laser_of, warnings = _sorted_stripes(rig, placed, surfaces, options)
    start = InitialGuess(
        seen_rig, surfaces, tuple(placed), camera_covariance if options.refine else None
    )
    solved, words = solve_lasers(start, lasers, laser_of, options.loose)
    result = _result_rig(rig, solved, lasers, start.camera_covariance)
    joint, planes = joint_uncertainty(
        solved.solution,
        solved.problem,
        camera_covariance,
        result.lasers,
        refined=options.refine,
        stripe_bias_px=options.stripe_bias_px,
    )
    each = zip(result.lasers, paper_planes(solved), words, strict=True)
    figures = [checks.laser_figures(solved, planes[i], i, *one) for i, one in enumerate(each)]
    pictures = [checks.view_figures(solved, i, view) for i, view in enumerate(solved.views)]
    return checks.LaserCalibration(
        rig=result,
        uncertainty=joint,
        lasers=tuple(figures),
        views=tuple(pictures),
        left_out=left_out,
        warnings=(*warnings, *_warnings(solved, figures, pictures)),
        refined=options.refine,
    )


def _sorted_stripes(
    rig: Rig, views: Sequence[PlacedView], surfaces: TargetSurfaces, options: LaserOptions
) -> tuple[list[Laser], IntArray, list[str]]:
    """Return the lasers with rough planes, the index of each point's laser, and warnings."""
    split, warnings = _split(rig, views, surfaces, options)
    if len(rig.lasers) == len(split.planes):
        order = [i for i in checks.match_to_rig(rig, split.planes) if i is not None]
        lasers = [
            replace(laser, plane=checks.like(split.planes[i], laser.plane))
            for laser, i in zip(rig.lasers, order, strict=True)
        ]
        warnings += [
            f"laser '{old.name}' is far from where the rig had it; check that it is the same one"
            for old, new in zip(rig.lasers, lasers, strict=True)
            if checks.far_apart(old, new.plane)
        ]
    else:
        order, lasers = checks.named(split.planes)
    place = np.full(len(order) + 1, -1)
    place[order] = np.arange(len(order))
    return lasers, place[split.laser], warnings


def _split(
    rig: Rig, views: Sequence[PlacedView], surfaces: TargetSurfaces, options: LaserOptions
) -> tuple[LaserAssignment, list[str]]:
    """Split the stripes, with a larger tolerance if a tilted board may have split lasers."""
    expected = options.n_lasers or len(rig.lasers) or None
    stripes, lens = pooled(views, surfaces), rig.dome_from_cam.translation

    def split_within(tolerance: float) -> LaserAssignment:
        return assign_lasers(stripes, lens, n_lasers=expected, tolerance_px=tolerance)

    split = split_within(tolerance_px(rig.lasers))
    if len(surfaces.planes) == 1 and (split.torn or len(split.planes) < (expected or 1)):
        lenient = split_within(BENT_TOLERANCE_PX)
        try:
            return lenient, checks.check_count(lenient, expected, rig, views, surfaces)
        except CalibrationError:
            # The message about the stricter split is the plainer one.
            pass
    return split, checks.check_count(split, expected, rig, views, surfaces)


def _result_rig(
    rig: Rig,
    solved: checks.SolvedLasers,
    lasers: Sequence[Laser],
    camera_covariance: CameraCovariance | None,
) -> Rig:
    state = solved.state
    found = tuple(sheet.laser(laser) for laser, sheet in zip(lasers, state.sheets, strict=True))
    if camera_covariance is None:
        return replace(rig, lasers=found)
    in_water = camera_covariance.sigma_medium > 0.0
    n_water = float(state.bundle.media[0]) if in_water else rig.n_water
    return replace(state.bundle.rig, lasers=found, n_water=n_water)


def _warnings(
    solved: checks.SolvedLasers,
    lasers: Sequence[checks.LaserFigures],
    views: Sequence[checks.ViewFigures],
) -> list[str]:
    # Larger residuals of corners, in pixels, indicate a wrong rig, medium or target.
    bad_corners_px = 0.5
    # The same of stripes; paint and speckle leave a tenth to a third of a pixel.
    bad_stripes_px = 0.7
    words = [
        f"{view.name}: corners miss by {view.rms_corners_px:.2f} px (rms); check the rig, the "
        "medium and the target's file"
        for view in views
        if view.rms_corners_px > bad_corners_px
    ]
    # A metre away this is 7 mm: too much to call a laser calibrated.
    uncertain_normal = np.deg2rad(0.4)
    words += [
        f"laser '{figures.laser.name}' is known to {np.rad2deg(figures.sigma_normal):.2f} deg "
        "only; add pictures in which its stripe lies on planes further apart"
        for figures in lasers
        if figures.sigma_normal > uncertain_normal
    ]
    words += [
        f"stripes of laser '{figures.laser.name}' miss by {figures.rms_px:.2f} px (rms); check "
        "the planes in the target's file, or whether the laser's window is in the rig"
        for figures in lasers
        if figures.rms_px > bad_stripes_px
    ]
    if solved.problem.board_pose_prior is not None:
        words.append(checks.loose_text(solved))
    if not solved.solution.converged:
        words.append("the solve did not settle; look at the residuals before using this rig")
    return words
