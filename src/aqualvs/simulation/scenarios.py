"""Built-in scenarios by name, and example rigs.

`load_scenario` takes a name or the path of a scenario file.

The rigs are in round numbers. `example_rig` resembles the rig of the paper: a lens strongly off the
dome's centre and three lasers, one nearly level below, one nearly upright on the left, one diagonal
on the right. `bluerov2_rig` resembles a BlueROV2: a wide camera near the centre of a 4-inch dome;
`flat_port_rig` has its camera and lasers behind a flat port.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

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
from aqualvs.simulation.scenario import (
    Scenario,
    parse_scenario,
    read_scenario,
)

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


_NET_MOTION: dict[str, Any] = {
    "range_mm": {"values": [350, 520, 430], "sway": 4, "period_s": 2.3},
    "pitch_deg": {"values": [5, -3, 2], "sway": 1.5, "period_s": 3.1},
    "yaw_deg": {"values": [-6, 8, 0], "sway": 1.5, "period_s": 2.7},
    "slide_x_mm": [0, 90, 200],
    "slide_z_mm": [0, -15, 20],
}
_TURBID: dict[str, Any] = {
    "attenuation_per_m": [2.0, 1.25, 1.6],
    "veil": [0.115, 0.235, 0.165],
    "sheet_scatter_per_m": 1.5,
    "forward_scatter": 0.16,
    "halo_px": 12,
    "snow": 1500,
}
_SUN: dict[str, Any] = {"caustics": 0.65, "glare": 0.5, "ambient": [0.50, 0.82, 0.78]}

_BUILT_IN: Mapping[str, tuple[str, dict[str, Any]]] = MappingProxyType(
    {
        "wall": (
            "a wall square to the vehicle at 374, 438, 525 and 659 mm",
            {
                "duration_s": 1.6,
                "motion": {"range_mm": {"values": [374, 438, 525, 659], "mode": "steps"}},
                "walls": [{}],
            },
        ),
        "wall_range": (
            "a wall that recedes from 300 to 1250 mm",
            {"motion": {"range_mm": [300, 1250]}, "walls": [{}]},
        ),
        "wall_yaw": (
            "a wall at 600 mm, yaw swings through 20 degrees to either side",
            {"motion": {"yaw_deg": {"values": [0], "sway": 20, "period_s": 4}}, "walls": [{}]},
        ),
        "wall_pitch": (
            "a wall at 600 mm, pitch swings through 20 degrees to either side",
            {"motion": {"pitch_deg": {"values": [0], "sway": 20, "period_s": 4}}, "walls": [{}]},
        ),
        "net_diamond": (
            "a diamond net in open water",
            {"motion": _NET_MOTION, "net": {"twine_mm": 2.2, "roll_deg": 3}},
        ),
        "net_square": (
            "a square net with some growth on it",
            {
                "motion": _NET_MOTION,
                "net": {"mesh": "square", "bar_mm": 22, "roll_deg": 8, "fouling": 0.15},
            },
        ),
        "net_hexagon": (
            "a hexagonal net, slightly bulging",
            {
                "motion": _NET_MOTION,
                "net": {
                    "mesh": "hexagon",
                    "bar_mm": 18,
                    "roll_deg": 12,
                    "curvature_per_m": [0.25, 0.1],
                },
            },
        ),
        "net_clutter": (
            "a net with a hole, a tiled wall behind it, fish, bubbles and a box",
            {
                "motion": {**_NET_MOTION, "range_mm": [420, 600, 500]},
                "net": {"bar_mm": 30, "fouling": 0.1, "holes_mm": [[60, 40, 35]]},
                "walls": [{"behind_mm": 450, "yaw_deg": 4, "tile_mm": 150}],
                "boxes": [{"centre_mm": [330, 300, -60], "heading_deg": 12}],
                "fish": 3,
                "bubbles": 40,
            },
        ),
        "net_holes": (
            "along a fouled net with three holes at 0.2 m/s, with the vehicle's log",
            {
                "duration_s": 12.0,
                "motion": {
                    "range_mm": {"values": [480, 430, 520, 450], "sway": 6, "period_s": 2.9},
                    "pitch_deg": {"values": [2, -3, 3, -1], "sway": 1.5, "period_s": 3.1},
                    "yaw_deg": {"values": [-5, 7, -3, 6], "sway": 4, "period_s": 4.3},
                    # From rest to 0.2 m/s and to rest again.
                    "slide_x_mm": [0, -70, -270, *range(-490, -2200, -220), -2250, -2300],
                    "slide_z_mm": [0, -120, 60, -40],
                },
                "net": {
                    "bar_mm": 25,
                    "twine_mm": 2.5,
                    "fouling": 0.45,
                    "growth": 1.5,
                    "holes_mm": [[500, 40, 55], [1250, -20, 75], [1950, 90, 65]],
                },
            },
        ),
        "demo": (
            "the bundled dive: along a fouled net with a hole, among fish and bubbles",
            {
                "duration_s": 6.0,
                "motion": {
                    "range_mm": {"values": [800, 450, 600, 520], "sway": 8, "period_s": 2.9},
                    "pitch_deg": {"values": [-6, 4, -2, 3], "sway": 2, "period_s": 3.1},
                    "yaw_deg": {"values": [12, -4, -10, 2], "sway": 2, "period_s": 2.3},
                    "slide_x_mm": [0, 120, 260],
                    "slide_z_mm": [0, -30, 25],
                },
                "net": {"bar_mm": 25, "twine_mm": 2.5, "fouling": 0.12, "holes_mm": [[80, 10, 40]]},
                "walls": [{"behind_mm": 600, "yaw_deg": 5, "tile_mm": 200}],
                "fish": 4,
                "bubbles": 30,
            },
        ),
        "lasers_off": (
            "a wall with the lasers off: no posture may come of it",
            {"duration_s": 1.0, "walls": [{}], "lasers_on": False},
        ),
        "empty": (
            "open water with nothing in range: no posture may come of it",
            {"duration_s": 1.0, "bubbles": 10, "water": {"snow": 200}},
        ),
        "turbid": (
            "a net in turbid water: glowing sheets, halo and marine snow",
            {"motion": _NET_MOTION, "net": {"fouling": 0.1}, "water": _TURBID},
        ),
        "sun": (
            "a net and a wall behind it close below the surface: caustics and glare",
            {
                "motion": _NET_MOTION,
                "net": {"twine_mm": 2.2},
                "walls": [{"behind_mm": 350}],
                "water": _SUN,
            },
        ),
    }
)


def list_scenarios() -> dict[str, str]:
    """Return the names of the built-in scenarios, each with one line about it."""
    return {name: about for name, (about, _) in _BUILT_IN.items()}


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Return a built-in scenario by its name, or the one that a YAML file describes.

    Raises `OptionError` if there is no such name or file, or the file makes no sense.
    """
    name = str(name_or_path)
    if name in _BUILT_IN:
        return parse_scenario(_BUILT_IN[name][1], name, name)
    path = Path(name_or_path)
    if path.suffix.lower() not in {".yaml", ".yml"}:
        known = ", ".join(_BUILT_IN)
        raise OptionError(
            f"scenario {name}: no such name; choose one of {known}, or give the path of a .yaml "
            "file"
        )
    return read_scenario(path)
