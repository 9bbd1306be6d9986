"""Calibration of the camera: intrinsics from views of a board in air, without the dome.

OpenCV's calibration (Zhang 2000, doi:10.1109/34.888718) gives the starting values. The robust
bundle adjustment of `solver.bundle`, which `calibrate dome` uses too, refines them, estimates their
covariance and names the views that do not fit. The checks refuse views that are too few or too much
alike and intrinsics that do not explain them. The result names the areas of the picture with no
corners or uncertain intrinsics.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from aqualvs.calibration.camera.problem import (
    BEND_DEGREES,
    BentFit,
    bend_is_significant,
    direction_sigma_px,
    fit_bend,
    fitted_camera,
    with_supported_coefficients,
)
from aqualvs.calibration.dome.problem import predicted
from aqualvs.calibration.solver.bundle import CORNER_SIGMA_PX, CORNERS, Bundle, BundleState
from aqualvs.calibration.solver.covariance import (
    ViewCovariance,
    implausible_distance,
    largest_angle,
    shared_covariance,
)
from aqualvs.calibration.solver.least_squares import Solution, solve
from aqualvs.calibration.solver.result import FittedViews, ViewFit, rms_px, view_fits
from aqualvs.calibration.targets.targets import View, check_enough
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.optics.lens import Lens, LensModel
from aqualvs.optics.rig import RigUncertainty

COVERAGE_CELLS = (6, 8)
"""Rows and columns of the coverage grid."""


def check_camera_views(views: Sequence[View], size_px: tuple[int, int]) -> None:
    """Refuse too few views, or views of another picture size.

    Raises `CalibrationError` with what is given and what is needed.
    """
    check_enough(views, 3, "camera", "15 to 20 from different sides")
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

    `covariance`, shape (P, P): of the intrinsics, as if corners were independent: focal lengths and
    image centre first. Raises `CalibrationError` with the likely cause and the remedy.
    """
    noise = CORNER_SIGMA_PX * solution.scales[CORNERS]
    # Corners noisier than this indicate an error other than noise.
    max_noise_px = 1.0
    if noise > max_noise_px:
        raise CalibrationError(
            f"no camera explains the views: corners are {noise:.2g} px off (0.1 px is usual); "
            "check squares_x, squares_y and the dictionary against the print, that the board is "
            "flat, and that zoom and focus stood still"
        )
    _check_determined(solution, covariance)
    placed = zip(solution.state.poses, views, strict=True)
    away = np.array([np.linalg.norm(pose.apply(view.middle)) for pose, view in placed])
    fault = implausible_distance(away, [view.name for view in views])
    if fault is not None:
        raise CalibrationError(fault)


def _check_determined(solution: Solution[BundleState], covariance: FloatArray) -> None:
    rig = solution.state.rig
    sigma = np.sqrt(np.diag(covariance)[:4])
    focal = max(sigma[0] / rig.lens.fx, sigma[1] / rig.lens.fy)
    centre = float(sigma[2:].max()) / rig.size_px[0]
    normals = np.array([pose.rotation[:, 2] for pose in solution.state.poses])
    lean = largest_angle(normals)
    # Angle between boards below which they count as parallel.
    parallel = np.deg2rad(5.0)
    remedy = (
        f"all boards are parallel within {np.rad2deg(lean):.1f} deg: tilt the board by 20 to 40 "
        "degrees, to different sides"
        if lean < parallel
        else "take more views, with the board tilted by 20 to 40 degrees to different sides, near, "
        "and in all parts of the picture"
    )
    # Focal lengths (share) and image centre (share of the width) known worse than this are of no
    # use.
    max_focal_sigma, max_centre_sigma = 0.01, 0.02
    if not focal < max_focal_sigma:
        raise CalibrationError(
            f"the views do not determine the focal length ({100.0 * focal:.2g} % uncertain); "
            f"{remedy}"
        )
    if not centre < max_centre_sigma:
        raise CalibrationError(
            f"the views do not determine the principal point ({float(sigma[2:].max()):.2g} px "
            f"uncertain); {remedy}"
        )
    if not solution.converged:
        model = "" if rig.lens.model is LensModel.FISHEYE else "try --model fisheye, or "
        raise CalibrationError(f"the solve does not come to rest; {model}{remedy}")


def coverage(pixels: FloatArray, size_px: tuple[int, int]) -> IntArray:
    """Return how many pixels (N, 2) fall into each cell of a grid over the picture."""
    rows, columns = COVERAGE_CELLS
    width, height = size_px
    y, x = pixels[:, 1] + 0.5, pixels[:, 0] + 0.5
    extent = ((0.0, height), (0.0, width))
    return np.histogram2d(y, x, bins=(rows, columns), range=extent)[0].astype(np.int64)


def pixel_grid(size_px: tuple[int, int]) -> FloatArray:
    """Return the pixels (N, 2) of a grid over the picture, borders included."""
    rows, columns = COVERAGE_CELLS
    u = np.linspace(0.0, size_px[0] - 1.0, columns + 1)
    v = np.linspace(0.0, size_px[1] - 1.0, rows + 1)
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


@dataclass(frozen=True, slots=True)
class CameraCalibration(FittedViews):
    """Result of a camera calibration: intrinsics with their uncertainty."""

    lens: Lens
    size_px: tuple[int, int]  # Image width and height.
    # Of the intrinsics, from the disagreement of the views (`solver.covariance`).
    uncertainty: RigUncertainty
    # Ratio of that variance to the variance for independent errors of corners.
    inflation: float
    # Poses are `cam_from_target`.
    views: tuple[ViewFit, ...]
    # Names of views that were not used, with the reason.
    left_out: dict[str, str]
    # Typical standard deviation of a corner's coordinate.
    noise_px: float
    # Shape (6, 8): number of corners in each cell of the picture.
    coverage: IntArray
    # Root mean square error of a model from three views in four for the corners of the fourth; NaN
    # where there are too few views.
    cross_validation_rms_px: float
    # Height difference between the highest and the lowest corner of a bent board, in metres; 0 for
    # a board whose views show no bend.
    bend_height: float
    # Remarks for the user, in plain words.
    findings: tuple[str, ...]


def camera(
    views: Sequence[View],
    size_px: tuple[int, int],
    *,
    model: LensModel = LensModel.OPENCV,
    n_coefficients: int | None = None,
) -> CameraCalibration:
    """Solve the intrinsics.

    Parameters
    ----------
    views : sequence of View
        Of a flat board in air, without the dome, tilted by 20 to 40 degrees in most of them.
    size_px : (int, int)
        Image width and height.
    n_coefficients : int, optional
        Number of distortion coefficients; by default as many as the views support.

    Raises
    ------
    CalibrationError
        If the views are too few or too much alike to determine the intrinsics, or do not show the
        given board.
    """
    check_camera_views(views, size_px)
    bundle, solution = fitted_camera(views, size_px, model, n_coefficients)
    bundle, solution, left_out = _without_bad_views(bundle, solution)
    flat = [target.view for target in bundle.views]
    bent = _bent(bundle, solution, n_coefficients)
    if bent is not None:
        bundle, solution = bent.bundle, bent.solution
    covariance = shared_covariance(bundle, solution)
    check_camera_solution(solution, covariance.by_corners, flat)
    result = _result(bundle, solution, covariance, left_out)
    if bent is not None:
        result = replace(result, bend_height=bent.bend.height(flat))
    return replace(result, findings=tuple(_findings(result)))


def _bent(
    bundle: Bundle, solution: Solution[BundleState], n_coefficients: int | None
) -> BentFit | None:
    """Solve with a bend of the board, of the highest degree that is significant."""
    best: BentFit | None = None
    flat = bundle
    for degree in BEND_DEGREES:
        n_solved = 0 if best is None else len(best.bend.exponents)
        if not bend_is_significant(bundle, solution, degree, n_solved):
            continue
        fit = fit_bend(flat, solution.state, degree)
        if fit is None:
            break
        if n_coefficients is None:
            # Without a bend, distortion may have taken up its effect.
            straight, settled = with_supported_coefficients(fit.bundle, fit.solution)
            if straight.free != flat.free:
                flat = replace(straight, views=flat.views)
                fit = fit_bend(flat, settled.state, degree) or fit
        best, bundle, solution = fit, fit.bundle, fit.solution
    return best


def _without_bad_views(
    bundle: Bundle, solution: Solution[BundleState]
) -> tuple[Bundle, Solution[BundleState], dict[str, str]]:
    """Leave out views that fit much worse than the others, and solve again."""
    typical = CORNER_SIGMA_PX * solution.scales[CORNERS]
    bad: dict[int, str] = {}
    # A view is bad if it is this many times noisier than the typical one, and noisier than this.
    bad_view, bad_noise_px = 5.0, 0.3
    mostly_wrong, bad_share = 0.6, 1.0 / 3.0
    for i, target in enumerate(bundle.views):
        noise = CORNER_SIGMA_PX * solution.block_scales[i]
        share = float(np.mean(solution.inliers[i]))
        if noise > max(bad_view * typical, bad_noise_px):
            bad[i] = f"its corners are {noise:.2g} px off, those of other views {typical:.2g} px"
        elif share < mostly_wrong:
            bad[i] = f"only {100.0 * share:.0f} % of its {len(target.view)} corners fit"
    if not bad or len(bad) > bad_share * len(bundle.views):
        return bundle, solution, {}
    keep = [i for i in range(len(bundle.views)) if i not in bad]
    part = bundle.only(keep)
    reasons = {
        bundle.views[i].view.name: f"{why}; blurred, or the board bent?" for i, why in bad.items()
    }
    return part, solve(part, solution.state.only(keep)), reasons


def _result(
    bundle: Bundle,
    solution: Solution[BundleState],
    covariance: ViewCovariance,
    left_out: dict[str, str],
) -> CameraCalibration:
    rig, n = solution.state.rig, len(bundle.free)
    labels = [target.view.name for target in bundle.views]
    fits = view_fits(labels, bundle, solution, solution.covariance)
    seen = np.concatenate([fit.view.pixels[fit.inliers] for fit in fits])
    return CameraCalibration(
        lens=rig.lens,
        size_px=rig.size_px,
        uncertainty=RigUncertainty(bundle.free, covariance.by_views[:n, :n]),
        inflation=covariance.inflation,
        views=fits,
        left_out=left_out,
        noise_px=CORNER_SIGMA_PX * solution.scales[CORNERS],
        coverage=coverage(seen, rig.size_px),
        cross_validation_rms_px=_cross_validation(bundle, solution),
        bend_height=0.0,
        findings=(),
    )


def _cross_validation(bundle: Bundle, solution: Solution[BundleState]) -> float:
    # One view out of this number is held out; least number of views and of corners in one for that.
    folds, min_views, min_points = 4, 8, 12
    n = len(bundle.views)
    believed = [bundle.views[i].view.where(solution.inliers[i]) for i in range(n)]
    held_out = [i for i in range(1, n, folds) if len(believed[i]) >= min_points]
    if n < min_views or not held_out:
        return float("nan")
    rest = [i for i in range(n) if i not in held_out]
    try:
        state = solve(bundle.only(rest), solution.state.only(rest)).state
        views = [believed[i] for i in held_out]
        errors = np.concatenate(predicted(state, [0] * len(views), views))
        return rms_px(errors[np.isfinite(errors).all(axis=1)])
    except CalibrationError:
        return float("nan")


def _findings(result: CameraCalibration) -> list[str]:
    many_outliers = 0.05
    sigmas, lens = result.uncertainty.sigmas, result.lens
    n = len(lens.distortion)
    lines = [
        f"focal lengths: {lens.fx:.2f} ± {sigmas['fx']:.2f} and {lens.fy:.2f} ± "
        f"{sigmas['fy']:.2f} px; principal point {lens.cx:.2f} ± {sigmas['cx']:.2f}, "
        f"{lens.cy:.2f} ± {sigmas['cy']:.2f} px",
        f"distortion: {n} coefficients of the {lens.model} model",
    ]
    lines += _shared_errors(result)
    if np.isfinite(result.cross_validation_rms_px):
        lines.append(
            f"corners of views held out are predicted to {result.cross_validation_rms_px:.3f} px"
        )
    lines += [f"left out, {name}: {why}" for name, why in result.left_out.items()]
    lines += _odd_views(result)
    for fit in result.views:
        wrong = int(np.count_nonzero(~fit.inliers))
        if wrong > many_outliers * len(fit.view):
            lines.append(f"{fit.label}: {wrong} of its {len(fit.view)} corners do not fit")
    return lines + _weak_places(result)


def _odd_views(result: CameraCalibration) -> list[str]:
    """Return remarks on views that were used, but fit much worse than the others."""
    # As of views that are left out, but at an error that may still be of the corners.
    odd_view, odd_noise_px = 5.0, 0.1
    rms = [fit.rms_px for fit in result.views]
    # Half of the pictures may be turned.
    typical = float(np.quantile(rms, 0.25))
    names = ", ".join(
        f"{fit.label} ({one:.2g} px)"
        for fit, one in zip(result.views, rms, strict=True)
        if one > max(odd_view * typical, odd_noise_px)
    )
    if not names:
        return []
    return [
        f"corners of {names} are far more off than those of other views ({typical:.2g} px), and "
        "count for little; turned upside down by the camera, blurred, or the board bent? Leave "
        "them out or take them again"
    ]


def _shared_errors(result: CameraCalibration) -> list[str]:
    lines = []
    if result.bend_height > 0.0:
        lines.append(
            f"the board is not flat: {1e3 * result.bend_height:.2g} mm between its highest and its "
            "lowest corner, the same in all views; this bend is estimated too. Glue the board to "
            "something stiff before the next step"
        )
    # Ratio of the variance by views to that by corners that is reported: sigmas 1.5 times as large.
    shared_errors = 2.25
    if result.inflation > shared_errors:
        lines.append(
            "views disagree more than their corners' noise explains: the uncertainties are "
            f"{np.sqrt(result.inflation):.1f} times larger than independent corners would make "
            "them. Usual causes: the board bends, it moves while the shutter is open, rolling "
            "shutter, autofocus"
        )
    sigmas, lens = result.uncertainty.sigmas, result.lens
    focal = max(sigmas["fx"] / lens.fx, sigmas["fy"] / lens.fy)
    # Relative uncertainty of the focal length that is reported: ranges have the same error.
    weak_focal = 0.005
    if focal > weak_focal:
        lines.append(
            f"the focal length is uncertain by {100.0 * focal:.2g} %: take more views, with a "
            "stiff board, tilted by 20 to 40 degrees to different sides, near, and in all parts of "
            "the picture"
        )
    return lines


def _weak_places(result: CameraCalibration) -> list[str]:
    weak_pixel_px, thin_coverage = 1.0, 0.6
    lines = []
    covered = float(np.mean(result.coverage > 0))
    if covered < thin_coverage:
        lines.append(
            f"corners were seen in {100.0 * covered:.0f} % of the picture; show the board in all "
            "parts of it"
        )
    grid = pixel_grid(result.size_px)
    sigma = direction_sigma_px(result.lens, result.uncertainty.covariance, grid)
    if not np.isfinite(sigma).all():
        remedy = "" if result.lens.model is LensModel.FISHEYE else "; try --model fisheye"
        lines.append(f"the distortion model does not reach all corners of the picture{remedy}")
    worst = int(np.argmax(np.nan_to_num(sigma)))
    if sigma[worst] > weak_pixel_px:
        u, v = grid[worst]
        lines.append(
            f"at pixel ({u:.0f}, {v:.0f}) the intrinsics are uncertain by {sigma[worst]:.1f} px; "
            "show the board there"
        )
    return lines
