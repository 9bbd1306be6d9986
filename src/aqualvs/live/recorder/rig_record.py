"""A rig and the scanner's options as a recording keeps them."""

import json
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from aqualvs.errors import RigError
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.dome import Dome
from aqualvs.optics.rig import Laser, Rig, Window
from aqualvs.optics.rigfile import rig_from_mapping, rig_to_mapping
from aqualvs.optics.rigtext import rig_text
from aqualvs.scanning.measure import FitMethod
from aqualvs.scanning.mesh import MeshFilterOptions
from aqualvs.scanning.pipeline import ScannerOptions
from aqualvs.scanning.stripe import StripeOptions
from aqualvs.scanning.target import TargetKind
from aqualvs.scanning.threshold import ThresholdOptions
from aqualvs.yamlfile import parse_yaml


def rig_yaml(rig: Rig) -> str:
    """Return the text of a rig file."""
    return rig_text(rig_to_mapping(rig))


def rig_exact(rig: Rig) -> str:
    """Return what a rig file rounds, as JSON, whose numbers lead back to the same bits."""
    pose, dome = rig.dome_from_cam, rig.dome
    found = {
        "rotation": pose.rotation.tolist(),
        "translation": pose.translation.tolist(),
        "dome": None if dome is None else [dome.inner_radius, dome.thickness, dome.n_acrylic],
        "n_air": rig.n_air,
        "n_water": rig.n_water,
        "lasers": [_laser_numbers(laser) for laser in rig.lasers],
        "working_range": list(rig.working_range),
    }
    return json.dumps(found)


def rig_from_record(text: str, exact: str, source_name: str) -> Rig:
    """Return the rig of a recording, to the last bit.

    Parameters
    ----------
    text, exact : str
        From `rig_yaml` and `rig_exact`.
    source_name : str
        How messages call the recording.

    Raises
    ------
    RigError
        If the text holds no rig.
    ValueError
        If the numbers do not belong to it.
    """
    content = parse_yaml(text, source_name, RigError)
    rig = rig_from_mapping(content, source_name=source_name, need_lasers=False)
    numbers = json.loads(exact)
    return replace(
        rig,
        dome_from_cam=SE3(np.array(numbers["rotation"]), np.array(numbers["translation"])),
        dome=None if numbers["dome"] is None else Dome(*numbers["dome"]),
        n_air=numbers["n_air"],
        n_water=numbers["n_water"],
        lasers=tuple(
            _with_numbers(laser, own)
            for laser, own in zip(rig.lasers, numbers["lasers"], strict=True)
        ),
        working_range=tuple(numbers["working_range"]),
    )


def options_text(options: ScannerOptions) -> str:
    """Return the scanner's options as JSON."""
    found = asdict(options)
    threshold = isinstance(options.detector, ThresholdOptions)
    found["detector"]["kind"] = "threshold" if threshold else "ridge"
    return json.dumps(found)


def options_from_text(text: str) -> ScannerOptions:
    """Return the scanner's options that `options_text` wrote.

    Raises
    ------
    ValueError, KeyError, TypeError
        If the text is none that this version knows.
    """
    found = json.loads(text)
    detector = dict(found["detector"])
    kind = {"ridge": StripeOptions, "threshold": ThresholdOptions}[detector.pop("kind")]
    # Recordings of 0.1.0 name the gate on colour that likelihoods have replaced.
    detector.pop("min_green_fall", None)
    mesh = found["mesh_filter"]
    return ScannerOptions(
        detector=kind(**detector),
        mesh_filter=None if mesh is None else MeshFilterOptions(**mesh),
        target=TargetKind(found["target"]),
        fit=FitMethod(found["fit"]),
    )


def _laser_numbers(laser: Laser) -> list[Any]:
    window = laser.window
    own = _plane_numbers(laser.plane)
    return own if window is None else [*own, *_plane_numbers(window.face), window.source.tolist()]


def _plane_numbers(plane: Plane) -> list[Any]:
    return [plane.normal.tolist(), float(plane.offset)]


def _with_numbers(laser: Laser, numbers: list[Any]) -> Laser:
    plane = Plane(np.array(numbers[0]), numbers[1])
    if len(numbers) == 2:
        return replace(laser, plane=plane, window=None)
    window = Window(Plane(np.array(numbers[2]), numbers[3]), np.array(numbers[4]))
    return replace(laser, plane=plane, window=window)
