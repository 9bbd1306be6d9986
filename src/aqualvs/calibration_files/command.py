"""`aqualvs import` and `aqualvs export`: calibrations of other programs into rigs, and back.

`read_camera`, `read_board` and `camera_text` read and write all formats; errors name the file.
"""

import contextlib
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from aqualvs.calibration.targets.target_files import save_board
from aqualvs.calibration.targets.targets import Board
from aqualvs.calibration_files.camera import ForeignCamera, camera_of_rig, rig_of_camera
from aqualvs.calibration_files.colmap import colmap_text, read_colmap
from aqualvs.calibration_files.kalibr import kalibr_text, read_kalibr, read_kalibr_target
from aqualvs.calibration_files.opencv import (
    mrcal_text,
    opencv_text,
    read_mrcal,
    read_opencv,
    read_ros,
    ros_text,
)
from aqualvs.calibration_formats import FORMAT_TEXTS, CalibrationFormat, recognised
from aqualvs.errors import OptionError, RigError
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import check_rig_place, load_rig, save_rig
from aqualvs.optics.shutter import AT_ONCE
from aqualvs.optics.solved import assumptions, rig_uncertainty
from aqualvs.results.files import Claim, replace_text, writing
from aqualvs.terminal import Echo
from aqualvs.text import count_text
from aqualvs.yamlfile import read_text

EXPORTS: Final = ("ros", "opencv", "kalibr", "mrcal", "colmap", "colmap-underwater")
"""Formats that a rig's camera can be written in."""

_WHAT = "a calibration file of another program"


def format_of(path: Path) -> tuple[CalibrationFormat, str]:
    """Return the format of a file, and its text.

    Raises `RigError` if the file cannot be read, or its format is not known.
    """
    text = read_text(path, _WHAT, RigError)
    found = recognised(text)
    if found is None:
        if "aqualvs_rig" in text:
            raise RigError(f"{path}: is a rig file already; give it to --rig")
        *most, last = FORMAT_TEXTS.values()
        known = f"{', '.join(most)}, or {last}"
        raise RigError(f"{path}: is not a calibration in a known format; give {known}")
    return found, text


def read_camera(
    path: str | Path, *, camera: str | None = None, model: str | None = None
) -> ForeignCamera:
    """Read a camera from the file of another program.

    Parameters
    ----------
    camera : str, optional
        Name of the camera, if a file of Kalibr or COLMAP has several.
    model : str, optional
        "opencv" or "fisheye", if a FileStorage of OpenCV does not state it.

    Raises
    ------
    RigError
        One line that names the file, the value and the remedy.
    """
    found, text = format_of(Path(path))
    with _naming(path):
        if found is CalibrationFormat.ROS:
            return read_ros(text, str(path))
        if found is CalibrationFormat.OPENCV:
            return read_opencv(text, str(path), model=model)
        if found is CalibrationFormat.KALIBR:
            return read_kalibr(text, str(path), name=camera)
        if found is CalibrationFormat.MRCAL:
            return read_mrcal(text, str(path))
        if found is CalibrationFormat.COLMAP:
            return read_colmap(text, str(path), name=camera)
        raise RigError("is a target of Kalibr and holds no camera; import it with --as board")


def read_board(path: str | Path) -> Board:
    """Read a board from a target file of Kalibr.

    Raises `RigError` with one line that names the file, the value and the remedy.
    """
    found, text = format_of(Path(path))
    with _naming(path):
        if found is not CalibrationFormat.KALIBR_TARGET:
            raise RigError(f"is {FORMAT_TEXTS[found]} and holds no board; leave out --as board")
        return read_kalibr_target(text, str(path))


def camera_text(camera: ForeignCamera, to: str, *, suffix: str = "") -> str:
    """Return the text of a camera's file.

    Parameters
    ----------
    to : str
        One of `EXPORTS`.
    suffix : str
        Suffix of the file; .xml and .json choose the form of a FileStorage.

    Raises
    ------
    RigError
        If the format cannot represent the camera.
    """
    writers = {"ros": ros_text, "kalibr": kalibr_text, "mrcal": mrcal_text}
    if to in writers:
        return writers[to](camera)
    if to == "opencv":
        return opencv_text(camera, suffix)
    if to in EXPORTS:
        return colmap_text(camera, refractive=to == "colmap-underwater")
    raise RigError(f"{to!r} is not a format; use one of {', '.join(EXPORTS)}")


@contextlib.contextmanager
def _naming(path: str | Path) -> Iterator[None]:
    """Prefix errors with the file's name, unless they have it."""
    try:
        yield
    except RigError as fault:
        text = str(fault)
        if text.startswith(f"{path}: "):
            raise
        raise RigError(f"{path}: {text}") from None


IMPORTED = "imported"
"""Key of `Rig.solved_from`: the file from which the camera was imported."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImportRequest:
    """Request of `aqualvs import`, see its `--help`."""

    source: Path
    out: Path
    what: str | None = None
    camera: str | None = None
    model: str | None = None
    image: str | None = None
    overwrite: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportRequest:
    """Request of `aqualvs export`, see its `--help`."""

    rig: Path
    to: str
    out: Path
    overwrite: bool = False


def run_import(request: ImportRequest, echo: Echo) -> None:
    """Write the rig or the board of a calibration file.

    Raises `AqualvsError` if the file cannot be read or converted, or the output cannot be written.
    """
    found, _ = format_of(request.source)
    what = request.what or ("board" if found is CalibrationFormat.KALIBR_TARGET else "rig")
    if what == "board":
        board = read_board(request.source)
        with Claim("import", [request.out], overwrite=request.overwrite):
            save_board(board, request.out, note=f"imported from {request.source.name}")
        echo(f"board: {request.out} ({board.describe()})")
        return
    check_rig_place(request.out)
    camera = read_camera(request.source, camera=request.camera, model=request.model)
    camera = _with_size(camera, request)
    dropped = what == "camera" and camera.port is not None
    if dropped:
        camera = replace(camera, port=None)
    note = {"file": request.source.name, "format": str(found), "camera": camera.name}
    rig = rig_of_camera(camera, str(request.source), solved_from={IMPORTED: note})
    copy = save_rig(rig, request.out)
    kept = "" if copy is None else f"; the one before is {copy}"
    echo(f"rig: {request.out} (from {FORMAT_TEXTS[found]}){kept}")
    for line in _remarks(rig, dropped=dropped):
        echo(line)


def _with_size(camera: ForeignCamera, request: ImportRequest) -> ForeignCamera:
    """Return the camera with the picture size of `--image`, for files that do not state it."""
    if request.image is None:
        return camera
    match = re.fullmatch(r"(\d{1,6})x(\d{1,6})", request.image)
    if match is None:
        raise OptionError(f"--image {request.image!r}: write width x height, such as 1920x1080")
    size_px = (int(match[1]), int(match[2]))
    if camera.size_px is not None and camera.size_px != size_px:
        raise OptionError(
            f"--image {request.image}: {request.source} says "
            f"{'x'.join(map(str, camera.size_px))}; leave --image out"
        )
    return replace(camera, size_px=size_px)


def _remarks(rig: Rig, *, dropped: bool) -> list[str]:
    """Return lines on what was imported, left out and assumed."""
    lens = rig.lens
    lines = [
        f"camera: {lens.model}, {len(lens.distortion)} distortion coefficients, "
        f"{rig.size_px[0]}x{rig.size_px[1]} px, fx {lens.fx:.2f} px"
    ]
    if dropped:
        lines.append("left out: the housing; --as rig takes it too")
    elif rig.flat_port is not None:
        lines.append(
            f"flat port: {rig.flat_port.distance * 1e3:g} mm from the lens; the camera counts as "
            "looking along the vehicle's y axis"
        )
    elif rig.dome is None:
        lines.append("no housing: the lens is bare, in air; 'aqualvs calibrate dome' adds a dome")
    else:
        lines.append(
            f"dome: inner radius {rig.dome.inner_radius * 1e3:g} mm; the camera counts as looking "
            "along the dome's y axis"
        )
    sigmas = "; ".join(f"{one.words} ({one.what})" for one in assumptions(rig))
    lines.append(f"uncertainty: the file has none; assumed (one sigma): {sigmas}")
    lines.append("next: lasers, by 'aqualvs calibrate lasers' or by hand (docs/rig.md)")
    return lines


def run_export(request: ExportRequest, echo: Echo) -> None:
    """Write the camera of a rig in the format of another program.

    Raises `AqualvsError` if the rig cannot be read, the format cannot represent it, or the file
    cannot be written.
    """
    rig = load_rig(request.rig, need_lasers=False)
    try:
        text = camera_text(camera_of_rig(rig), request.to, suffix=request.out.suffix)
    except RigError as fault:
        raise RigError(f"{request.rig}: {fault}") from None
    with Claim("export", [request.out], overwrite=request.overwrite), writing(request.out):
        replace_text(request.out, text)
    echo(f"{request.to}: {request.out}")
    left_out = _left_out(rig, request.to)
    if left_out:
        echo(f"left out, as the format lacks it: {', '.join(left_out)}")


def _left_out(rig: Rig, to: str) -> list[str]:
    """Return the parts of a rig that a format cannot represent."""
    refractive = to == "colmap-underwater"
    housing = "dome" if rig.dome else "flat port" if rig.flat_port else ""
    names = []
    if housing and not refractive:
        names.append(f"the {housing} (the intrinsics are those in air)")
    names += [count_text(len(rig.lasers), "laser")] if rig.lasers else []
    if housing and refractive:
        names.append("the camera's rotation" + (" in the dome" if rig.dome else " and place"))
    names += ["the shutter"] if rig.shutter != AT_ONCE else []
    names += ["the covariance"] if rig_uncertainty(rig).names else []
    return names
