"""Refraction, the camera behind a dome, water, and the rig file."""

from aqualvs.optics.camera import Camera, parameter_names
from aqualvs.optics.dome import Dome
from aqualvs.optics.flat_port import FlatPort
from aqualvs.optics.lens import Lens, LensModel
from aqualvs.optics.refraction import refract
from aqualvs.optics.water import seawater_index, seawater_index_vacuum

__all__ = [
    "Camera",
    "Dome",
    "FlatPort",
    "Lens",
    "LensModel",
    "parameter_names",
    "refract",
    "seawater_index",
    "seawater_index_vacuum",
]
