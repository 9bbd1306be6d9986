"""The rig as a user gets it: calibrated from pictures, as the commands do it."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from aqualvs.app.calibrate_camera import CameraRequest, calibrate_camera
from aqualvs.app.calibrate_dome import DomeRequest, calibrate_dome
from aqualvs.app.calibrate_lasers import LasersRequest, calibrate_lasers
from aqualvs.app.reproduce.laboratory import Laboratory
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import load_rig
from aqualvs.simulation.calibration_set import CalibrationFiles, SetSize, simulate_calibration

_SIZE = SetSize(camera=12, dome=10, box=4, index=1, dive=0)
_RIG, _DRAFT, _READY = "rig.yaml", "draft.yaml", "pictures.json"


def calibration_pictures(laboratory: Laboratory) -> CalibrationFiles:
    """Return rendered pictures for a whole calibration of the laboratory's rig.

    12 boards in air for the lens, 10 at known places in air for the dome, 4 of the box, in
    air too, for the lasers. Rendered once.
    """
    folder = laboratory.folder("calibration")
    if not (folder / _READY).exists():
        files = simulate_calibration(
            laboratory.rig, folder, size=_SIZE, progress=laboratory.rendered
        )
        _note_files(files, folder)
    return _noted_files(folder)


def calibrated_rig(laboratory: Laboratory) -> Rig:
    """Return the laboratory's rig as calibrated from those pictures, in the tank's own water.

    It carries its covariance, and the working range that `aqualvs calibrate` gives.
    """
    folder = laboratory.folder("calibration")
    if not (folder / _RIG).exists():
        _calibrate(calibration_pictures(laboratory), folder / _RIG, len(laboratory.rig.lasers))
    return load_rig(folder / _RIG).in_water(laboratory.rig.n_water)


def rig_without_lasers(laboratory: Laboratory) -> Rig:
    """Return what `calibrated_rig` came from: camera and dome solved, with their covariance."""
    calibrated_rig(laboratory)
    draft = laboratory.folder("calibration") / _DRAFT
    return load_rig(draft, need_lasers=False).in_water(laboratory.rig.n_water)


def _note_files(files: CalibrationFiles, folder: Path) -> None:
    noted = {
        name: str(value.relative_to(folder)) if isinstance(value, Path) else value
        for name, value in asdict(files).items()
    }
    (folder / _READY).write_text(json.dumps(noted), encoding="utf-8")


def _noted_files(folder: Path) -> CalibrationFiles:
    noted: dict[str, Any] = json.loads((folder / _READY).read_text(encoding="utf-8"))
    files: dict[str, Any] = {
        name: folder / value if isinstance(value, str) else value for name, value in noted.items()
    }
    return CalibrationFiles(**files)


def _calibrate(files: CalibrationFiles, rig: Path, n_lasers: int) -> None:
    # The last step writes the file that tells that all is done.
    draft = rig.with_name(_DRAFT)
    for step in (_camera, _dome):
        step(files, draft)
    _lasers(files, draft, rig, n_lasers)


def _camera(files: CalibrationFiles, rig: Path) -> None:
    calibrate_camera(
        CameraRequest(
            images=(str(files.camera),),
            board=files.board,
            out=rig,
            nominal=files.nominal,
            model="opencv",
            n_coefficients=None,
        ),
        _say_nothing,
    )


def _dome(files: CalibrationFiles, rig: Path) -> None:
    calibrate_dome(
        DomeRequest(
            images=(str(files.dome),),
            board=files.rail_board,
            rig=rig,
            out=rig,
            poses=files.poses,
            medium="air",
            water_images=(),
            water_board=None,
            water_poses=None,
            inner_radius_mm=None,
            thickness_mm=None,
            n_acrylic=None,
            radius_tolerance_mm=0.1,
            thickness_tolerance_mm=0.1,
            acrylic_tolerance=0.003,
            distance_sigma_mm=0.2,
            refine_intrinsics=True,
        ),
        _say_nothing,
    )


def _lasers(files: CalibrationFiles, draft: Path, rig: Path, n_lasers: int) -> None:
    calibrate_lasers(
        LasersRequest(
            images=(str(files.box),),
            rig=draft,
            out=rig,
            box=files.box_file,
            board=None,
            medium=None,
            n_lasers=n_lasers,
            names=None,
            board_offset_mm=0.0,
            refine=False,
        ),
        _say_nothing,
    )


def _say_nothing(_line: str) -> None:
    """Take a line for the user, whom the experiment's own result interests more."""
