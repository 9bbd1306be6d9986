"""Built-in scenarios by name, and example rigs.

`load_scenario` takes a name or the path of a scenario file; `data/scenarios/built_in.yaml` has the
named ones.

The rigs are in round numbers. `example_rig` resembles the rig of the paper: a lens strongly off the
dome's centre and three lasers, one nearly level below, one nearly upright on the left, one diagonal
on the right. `bluerov2_rig` resembles a BlueROV2: a wide camera near the centre of a 4-inch dome;
`flat_port_rig` has its camera and lasers behind a flat port.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.geometry.linear_algebra import Vec
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.dome import Dome
from aqualvs.optics.flat_port import FlatPort
from aqualvs.optics.lens import Lens
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Laser, Rig
from aqualvs.optics.water import N_AIR
from aqualvs.simulation.scenario import Scenario, packaged, parse_scenario, read_scenario

_BUILT_IN = "built_in.yaml"
_N_FRESH_WATER = 1.3333


def example_rig() -> Rig:
    """Return a rig like the paper's: 720x576, lens 41.7 mm off the centre of a small dome."""
    return Rig(
        name="example",
        size_px=(720, 576),
        lens=Lens(
            fx=817.0, fy=878.0, cx=369.0, cy=282.0, distortion=(-0.126, 0.083, 0.0006, -0.0004)
        ),
        dome_from_cam=_pose((2.3, 1.7, 0.9), (3.0, 41.5, 3.0)),
        housing=Dome(inner_radius=44.25e-3, thickness=5.75e-3, n_acrylic=1.49),
        n_air=N_AIR,
        n_water=_N_FRESH_WATER,
        lasers=(
            Laser("lower", Plane.from_normal((-0.020, -0.340, 0.940), -0.143)),
            Laser("left", Plane.from_normal((0.960, -0.253, -0.121), -0.138)),
            Laser("right", Plane.from_normal((0.724, 0.155, 0.672), 0.093)),
        ),
        working_range=(0.3, 1.0),
    )


def bluerov2_rig() -> Rig:
    """Return a rig like a BlueROV2's: 1920x1080, lens 6 mm off the centre of a 4-inch dome."""
    return Rig(
        name="bluerov2",
        size_px=(1920, 1080),
        lens=Lens(
            fx=1390.0, fy=1390.0, cx=957.0, cy=543.0, distortion=(-0.11, 0.05, 0.0003, -0.0002)
        ),
        dome_from_cam=_pose((0.6, -0.4, 0.2), (0.8, 5.8, -0.6)),
        housing=Dome(inner_radius=51.0e-3, thickness=6.0e-3, n_acrylic=1.49),
        n_air=N_AIR,
        n_water=_N_FRESH_WATER,
        lasers=(
            Laser("lower", Plane.from_normal((0.015, -0.300, 0.954), -0.150)),
            Laser("left", Plane.from_normal((0.962, -0.265, 0.060), -0.165)),
            Laser("right", Plane.from_normal((0.730, 0.170, 0.662), 0.110)),
        ),
        working_range=(0.3, 1.2),
    )


def flat_port_rig() -> Rig:
    """Return the camera and lasers of `bluerov2_rig` behind a flat port, its lens the origin."""
    rig = bluerov2_rig()
    return replace(
        rig,
        name="flat port",
        dome_from_cam=SE3(rig.dome_from_cam.rotation, np.zeros(3)),
        housing=FlatPort(0.012, 0.005, 1.49, math.radians(0.6), math.radians(-0.4)),
    )


def _pose(rotation_deg: Vec, lens_mm: Vec) -> SE3:
    turn = rotation_from_rotvec(np.deg2rad(rotation_deg))
    return SE3(turn @ DOME_FROM_CAM_NOMINAL, np.array(lens_mm) / 1e3)


def list_scenarios() -> dict[str, str]:
    """Return the names of the built-in scenarios, each with one line about it."""
    return {name: content["about"] for name, content in packaged(_BUILT_IN).items()}


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Return a built-in scenario by its name, or the one that a YAML file describes.

    Raises `OptionError` if there is no such name or file, or the file makes no sense.
    """
    name = str(name_or_path)
    built_in = packaged(_BUILT_IN)
    if name in built_in:
        content = {key: value for key, value in built_in[name].items() if key != "about"}
        return parse_scenario(content, name, name)
    path = Path(name_or_path)
    if path.suffix.lower() not in {".yaml", ".yml"}:
        known = ", ".join(built_in)
        raise OptionError(
            f"scenario {name}: no such name; choose one of {known}, or give the path of a .yaml "
            "file"
        )
    return read_scenario(path)
