"""Calibration files of other programs, converted to rigs and from rigs.

ROS, OpenCV, Kalibr, mrcal, COLMAP and Refractive COLMAP; docs/formats.md has the conventions.
Imports `optics` and `calibration.targets`.
"""

from aqualvs.calibration_files.camera import ForeignCamera, camera_of_rig, rig_of_camera
from aqualvs.calibration_files.command import EXPORTS, camera_text, read_board, read_camera

__all__ = [
    "EXPORTS",
    "ForeignCamera",
    "camera_of_rig",
    "camera_text",
    "read_board",
    "read_camera",
    "rig_of_camera",
]
