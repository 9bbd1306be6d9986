"""`aqualvs calibrate camera`: intrinsics in air, without the dome."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from aqualvs.calibrate.common import (
    N_LASERS,
    WAVELENGTH_NM,
    Found,
    Nominal,
    Tell,
    corner_residuals,
    corner_rows,
    find_targets,
    finish,
    load_nominal,
)
from aqualvs.calibration.camera.calibrate import CameraCalibration, camera
from aqualvs.calibration.detection.detection import detect_board
from aqualvs.calibration.targets.pose_files import picture_paths
from aqualvs.calibration.targets.target_files import load_board
from aqualvs.errors import CalibrationError
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.lens import LensModel
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Rig
from aqualvs.optics.rigfile import check_rig_place
from aqualvs.optics.solved import SolvedStep, with_step, with_uncertainty
from aqualvs.report.calibration_material import (
    CalibrationPage,
    facts,
    parameter_rows,
)
from aqualvs.report.html import Card


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraRequest:
    """Request of `aqualvs calibrate camera`, see its `--help`."""

    images: tuple[str, ...]
    board: Path
    out: Path
    nominal: Path | None
    model: str
    n_coefficients: int | None


def calibrate_camera(request: CameraRequest, tell: Tell) -> None:
    """Solve the intrinsics from pictures and write the rig and its report.

    Raises
    ------
    AqualvsError
        If a file, a picture or its content cannot be used.
    """
    check_rig_place(request.out)
    nominal = Nominal() if request.nominal is None else load_nominal(request.nominal)
    board = load_board(request.board)
    found = find_targets(
        picture_paths(request.images),
        lambda path, image: detect_board(image, board, path.name),
        request.board.name,
    )
    _check_size(found, nominal, request)
    result = camera(
        found.views,
        found.size_px,
        model=LensModel(request.model),
        n_coefficients=request.n_coefficients,
    )
    rig = _rig(result, nominal)
    n_pictures = len(found.views) + len(found.missed)
    of = f" of {n_pictures}" if len(result.views) < n_pictures else ""
    tell(
        f"{len(result.views)}{of} pictures, {result.n_points} corners, residual "
        f"{result.rms_px:.3f} px (rms)"
    )
    for line in (*found.remarks, *result.findings):
        tell(line)
    finish(rig, _page(rig, result, found, request), request.out, "camera", tell)


def _check_size(found: Found, nominal: Nominal, request: CameraRequest) -> None:
    if nominal.size_px is not None and nominal.size_px != found.size_px:
        (w, h), (nw, nh) = found.size_px, nominal.size_px
        raise CalibrationError(
            f"{found.paths[0]}: {w}x{h} px, but {request.nominal} says {nw}x{nh} px; calibrate at "
            "the size that the camera is used at, or correct that file"
        )


def _rig(result: CameraCalibration, nominal: Nominal) -> Rig:
    rig = Rig(
        name=nominal.name,
        size_px=result.size_px,
        lens=result.lens,
        dome_from_cam=SE3(DOME_FROM_CAM_NOMINAL.copy(), np.zeros(3)),
        dome=nominal.dome,
        n_air=nominal.n_air,
        n_water=nominal.n_water,
        lasers=(),
        working_range=nominal.working_range,
    )
    step = SolvedStep(
        pictures=len(result.views), points=result.n_points, rms_px=result.rms_px, extras={}
    )
    # The calibration of the lasers searches for this number and colour.
    said = {N_LASERS: nominal.n_lasers, WAVELENGTH_NM: nominal.wavelength_nm}
    rig = replace(rig, solved_from={key: value for key, value in said.items() if value is not None})
    return with_uncertainty(with_step(rig, "camera", step), result.uncertainty)


def _page(
    rig: Rig, result: CameraCalibration, found: Found, request: CameraRequest
) -> CalibrationPage:
    sigmas = result.uncertainty.sigmas
    lens = result.lens
    cards = [
        Card("residual", f"{result.rms_px:.3f} px", "rms distance of corners"),
        Card(
            "focal lengths",
            f"{lens.fx:.1f}, {lens.fy:.1f} px",
            f"± {max(sigmas['fx'], sigmas['fy']):.2f} px",
        ),
        Card("pictures", str(len(result.views)), f"{result.n_points:,} corners"),
        Card(
            "coverage",
            f"{np.mean(result.coverage > 0):.0%}",
            "of the picture's cells hold corners",
        ),
    ]
    if np.isfinite(result.held_back_rms_px):
        cards.append(
            Card("held-back views", f"{result.held_back_rms_px:.3f} px", "corners predicted, rms")
        )
    return CalibrationPage(
        title="Calibration of the camera",
        subtitle=f"Rig “{rig.name}”",
        cards=tuple(cards),
        warnings=(
            *found.remarks,
            *(f"{name}: {why}" for name, why in result.left_out.items()),
        ),
        words=result.findings,
        parameters=parameter_rows(rig, result.uncertainty, lens.parameter_names),
        residual_maps=(corner_residuals(result.views, result.size_px),),
        views=corner_rows(result.views, {**found.missed, **result.left_out}),
        facts=facts(
            ("board", str(request.board)),
            ("nominal rig", str(request.nominal or "none")),
            ("distortion", f"{lens.model.value}, {len(lens.distortion)} coefficients"),
        ),
    )
