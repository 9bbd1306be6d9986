"""Reading and writing of any of the formats; faults name the file."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from aqualvs.calibration.targets.targets import Board
from aqualvs.calibration_files.camera import ForeignCamera
from aqualvs.calibration_files.colmap import colmap_text, read_colmap
from aqualvs.calibration_files.kalibr import kalibr_text, read_kalibr, read_kalibr_target
from aqualvs.calibration_files.mrcal import mrcal_text, read_mrcal
from aqualvs.calibration_files.opencv import opencv_text, read_opencv, read_ros, ros_text
from aqualvs.calibration_formats import FORMAT_TEXTS, CalibrationFormat, recognised
from aqualvs.errors import RigError
from aqualvs.yamlfile import read_text

EXPORTS: Final = ("ros", "opencv", "kalibr", "mrcal", "colmap", "colmap-underwater")
"""Formats that a rig's camera can be written in."""

_WHAT = "a calibration file of another program"


def format_of(path: Path) -> tuple[CalibrationFormat, str]:
    """Return the format of a file, and its text.

    Raises
    ------
    RigError
        If the file cannot be read, or is of none of the formats.
    """
    text = read_text(path, _WHAT, RigError)
    found = recognised(text)
    if found is None:
        is_rig = "aqualvs_rig" in text
        raise RigError(
            f"{path}: is a rig file already; give it to --rig"
            if is_rig
            else f"{path}: is no calibration that is known; give {', '.join(_known())}"
        )
    return found, text


def _known() -> list[str]:
    texts = [*FORMAT_TEXTS.values()]
    return [*texts[:-1], f"or {texts[-1]}"]


def read_camera(
    path: str | Path, *, camera: str | None = None, model: str | None = None
) -> ForeignCamera:
    """Read a camera from the file of another program.

    Parameters
    ----------
    path : str or Path
    camera : str, optional
        Name of the camera, where a file of Kalibr or COLMAP holds several.
    model : str, optional
        "opencv" or "fisheye", where a FileStorage of OpenCV does not say it.

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

    Raises
    ------
    RigError
        One line that names the file, the value and the remedy.
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
    camera : ForeignCamera
    to : str
        One of `EXPORTS`.
    suffix : str
        Of the file; .xml and .json choose the form of a FileStorage.

    Raises
    ------
    RigError
        If the format cannot hold the camera.
    """
    if to == "ros":
        return ros_text(camera)
    if to == "opencv":
        return opencv_text(camera, suffix)
    if to == "kalibr":
        return kalibr_text(camera)
    if to == "mrcal":
        return mrcal_text(camera)
    if to in EXPORTS:
        return colmap_text(camera, refractive=to == "colmap-underwater")
    raise RigError(f"{to!r} is no format; use one of {', '.join(EXPORTS)}")


@contextlib.contextmanager
def _naming(path: str | Path) -> Iterator[None]:
    """Put the file's name before a fault that lacks it."""
    try:
        yield
    except RigError as fault:
        text = str(fault)
        if text.startswith(f"{path}: "):
            raise
        raise RigError(f"{path}: {text}") from None
