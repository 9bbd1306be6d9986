"""Calibration files of other programs: their names, and how to recognise one by its text.

Readers of aqualvs's own files refuse such a file with the command that converts it. The conversion
itself is in `aqualvs.calibration_files`.
"""

import re
import shlex
from enum import StrEnum
from pathlib import Path

from aqualvs.errors import AqualvsError


class CalibrationFormat(StrEnum):
    """Format of a calibration file, by the program that writes it."""

    ROS = "ros"
    """`camera_info.yaml` of camera_calibration, or a printed sensor_msgs/CameraInfo."""
    OPENCV = "opencv"
    """FileStorage: YAML, XML or JSON."""
    KALIBR = "kalibr"
    """`camchain.yaml`."""
    KALIBR_TARGET = "kalibr-target"
    """Target of Kalibr: checkerboard or aprilgrid."""
    MRCAL = "mrcal"
    """`.cameramodel`."""
    COLMAP = "colmap"
    """`cameras.txt`, of Refractive COLMAP (colmap_underwater) as well."""


FORMAT_TEXTS = {
    CalibrationFormat.ROS: "a camera_info file of ROS",
    CalibrationFormat.OPENCV: "a FileStorage of OpenCV",
    CalibrationFormat.KALIBR: "a camchain of Kalibr",
    CalibrationFormat.KALIBR_TARGET: "a target of Kalibr",
    CalibrationFormat.MRCAL: "a cameramodel of mrcal",
    CalibrationFormat.COLMAP: "a cameras.txt of COLMAP",
}

# What tells a format is near the beginning; long lists and blobs follow.
_HEAD = 20_000
# All of them must match; the first format that does is taken.
_SIGNS: tuple[tuple[CalibrationFormat, tuple[str, ...]], ...] = (
    (CalibrationFormat.MRCAL, (r"[\"']lens_?model[\"'][ \t]*:[ \t]*[\"']LENSMODEL_",)),
    (CalibrationFormat.OPENCV, (r"\A%YAML:1\.|opencv-matrix|<opencv_storage>",)),
    (CalibrationFormat.KALIBR_TARGET, (r"^target_type[ \t]*:",)),
    (CalibrationFormat.KALIBR, (r"^[ \t]+camera_model[ \t]*:", r"^[ \t]+intrinsics[ \t]*:")),
    (CalibrationFormat.ROS, (r"^distortion_model[ \t]*:", r"^(?:camera_matrix|[kK])[ \t]*:")),
    (
        CalibrationFormat.COLMAP,
        (r"\A(?:[ \t]*(?:#[^\n]*)?\r?\n)*[ \t]*\d+[ \t]+[A-Z][A-Z_]+(?:[ \t]+[-+.\deE]+){5}",),
    ),
)


def recognised(text: str) -> CalibrationFormat | None:
    """Return the format of a text; None if it is none of those known."""
    head = text[:_HEAD]
    for found, signs in _SIGNS:
        if all(re.search(sign, head, re.MULTILINE) for sign in signs):
            return found
    return None


def refuse_foreign(text: str, path: Path, wanted: str, error: type[AqualvsError]) -> None:
    """Refuse the calibration file of another program, with the command that converts it.

    Parameters
    ----------
    text : str
        Content of the file.
    wanted : str
        What was expected, such as "a rig file".
    error : type
        Exception to raise.

    Raises
    ------
    AqualvsError
        Of type `error`, one line.
    """
    found = recognised(text)
    if found is None:
        return
    out = "board.yaml" if found is CalibrationFormat.KALIBR_TARGET else "rig.yaml"
    out = out if path.name != out else f"aqualvs-{out}"
    raise error(
        f"{path}: is {FORMAT_TEXTS[found]}, not {wanted}; run "
        f"'aqualvs import {shlex.quote(str(path))} -o {out}' and give {out}"
    )
