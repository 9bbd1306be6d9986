"""`aqualvs calibrate camera`: intrinsics in air, without the dome."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from aqualvs.calibrate import common
from aqualvs.calibration.camera.calibrate import CameraCalibration
from aqualvs.calibration.camera.calibrate import camera as solve_camera
from aqualvs.calibration.targets.targets import Board
from aqualvs.errors import CalibrationError, OptionError
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.lens import LensModel
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Rig
from aqualvs.optics.rigfile import check_rig_place
from aqualvs.optics.solved import SolvedStep, with_step, with_uncertainty
from aqualvs.report.calibration_material import CalibrationPage, facts, parameter_rows
from aqualvs.report.html import Card
from aqualvs.terminal import Echo


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraRequest:
    """Request of `aqualvs calibrate camera`, see its `--help`."""

    images: tuple[str, ...]
    board: Path
    out: Path
    nominal: Path | None = None
    model: str = "opencv"
    n_coefficients: int | None = None


def calibrate_camera(
    pictures: common.Pictures,
    board: Board | str | Path,
    *,
    nominal: common.Nominal | str | Path | None = None,
    model: LensModel | str = LensModel.OPENCV,
    n_coefficients: int | None = None,
) -> common.Calibration[CameraCalibration]:
    """Solve the intrinsics from pictures of a board in air, taken without the dome.

    Parameters
    ----------
    pictures : iterable of str, Path or array, or a str or Path
        Files or pixels (grey, or blue, green, red), or one folder or pattern; all of one size, with
        the board tilted by 20 to 40 degrees in most of them.
    board : Board, str or Path
        The board or its file.
    nominal : Nominal, str or Path, optional
        What is known of the rig beforehand, or its file: name, dome, number of lasers.
    model : LensModel or str
        Distortion model: "opencv" or "fisheye".
    n_coefficients : int, optional
        Number of distortion coefficients; by default as many as the pictures support.

    Returns
    -------
    Calibration
        `solution` is a `CameraCalibration`.

    Raises
    ------
    AqualvsError
        If a file, a picture or its content cannot be used.
    """
    if model not in list(LensModel):
        raise OptionError(f"model is {model!r}; give one of {', '.join(LensModel)}")
    known = (
        common.load_nominal(Path(nominal))
        if isinstance(nominal, str | Path)
        else nominal or common.Nominal()
    )
    found = common.detect_boards(pictures, board)
    if known.size_px is not None and known.size_px != found.size_px:
        (w, h), (nw, nh) = found.size_px, known.size_px
        raise CalibrationError(
            f"{found.first}: {w}x{h} px, but {common.path_text(nominal, 'the nominal rig')} says "
            f"{nw}x{nh} px; calibrate at the size that the camera is used at, or correct that file"
        )
    with common.counting_missed(found):
        result = solve_camera(
            found.views, found.size_px, model=LensModel(model), n_coefficients=n_coefficients
        )
    return common.Calibration(
        rig=_solved_rig(result, known),
        uncertainty=result.uncertainty,
        residuals_px={view.label: view.residuals for view in result.views},
        left_out={**found.missed, **result.left_out},
        notes=(*found.notes, *result.findings),
        solution=result,
        found=(found,),
    )


def run_camera(request: CameraRequest, echo: Echo) -> None:
    """Calibrate the camera and write the rig and its report.

    Raises `AqualvsError` as `calibrate_camera`, or if an output cannot be written.
    """
    check_rig_place(request.out)
    done = calibrate_camera(
        common.picture_paths(request.images),
        request.board,
        nominal=request.nominal,
        model=request.model,
        n_coefficients=request.n_coefficients,
    )
    for line in common.summary(done):
        echo(line)
    common.finish(done.rig, _page(done, request), request.out, "camera", echo)


def _solved_rig(result: CameraCalibration, nominal: common.Nominal) -> Rig:
    """Return the nominal rig with the solved intrinsics and a note of this step."""
    rig = Rig(
        name=nominal.name,
        size_px=result.size_px,
        lens=result.lens,
        dome_from_cam=SE3(DOME_FROM_CAM_NOMINAL.copy(), np.zeros(3)),
        housing=nominal.housing,
        n_air=nominal.n_air,
        n_water=nominal.n_water,
        lasers=(),
        working_range=nominal.working_range,
        shutter=nominal.shutter,
    )
    step = SolvedStep(
        pictures=len(result.views), points=result.n_points, rms_px=result.rms_px, extras={}
    )
    # The calibration of the lasers searches for this number and colour.
    planned = {common.N_LASERS: nominal.n_lasers, common.WAVELENGTH_NM: nominal.wavelength_nm}
    rig = replace(rig, solved_from={k: value for k, value in planned.items() if value is not None})
    return with_uncertainty(with_step(rig, "camera", step), result.uncertainty)


def _page(done: common.Calibration[CameraCalibration], request: CameraRequest) -> CalibrationPage:
    rig, result, found = done.rig, done.solution, done.found[0]
    sigmas, lens = result.uncertainty.sigmas, result.lens
    cards = [
        Card("residual", f"{result.rms_px:.3f} px", "rms distance of corners"),
        Card(
            "focal lengths",
            f"{lens.fx:.1f}, {lens.fy:.1f} px",
            f"± {max(sigmas['fx'], sigmas['fy']):.2f} px",
        ),
        Card("pictures", str(len(result.views)), f"{result.n_points:,} corners"),
    ]
    if np.isfinite(result.cross_validation_rms_px):
        held_px = f"{result.cross_validation_rms_px:.3f} px"
        cards.append(Card("held-out views", held_px, "corners predicted, rms"))
    return CalibrationPage(
        title="Calibration of the camera",
        subtitle=f"Rig “{rig.name}”",
        cards=tuple(cards),
        warnings=(*found.remarks, *(f"{name}: {why}" for name, why in result.left_out.items())),
        words=result.findings,
        parameters=parameter_rows(rig, result.uncertainty, lens.parameter_names),
        residual_maps=(common.corner_residuals(result.views, result.size_px),),
        views=common.corner_rows(result.views, {**found.missed, **result.left_out}),
        facts=facts(
            ("board", str(request.board)),
            ("nominal rig", str(request.nominal or "none")),
            ("distortion", f"{lens.model.value}, {len(lens.distortion)} coefficients"),
        ),
    )
