"""Simulate lasers behind tilted windows, scan with bent sheets and with planes, compare."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import load_rig, save_rig
from aqualvs.optics.sheet import sheets_of
from aqualvs.scanner import Scanner
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.scan import Frame, Scan
from aqualvs.simulation.scenarios import example_rig, load_scenario
from aqualvs.simulation.scene import Scene
from aqualvs.simulation.scene import SurfaceKind as Kind
from aqualvs.simulation.truth import visible_fit
from net_dives import frame_of
from quick_pictures import QuickRenderer
from windowed_cases import windowed

WALLS = [("wall", 0.2), ("wall_yaw", 1.0), ("wall_pitch", 3.0), ("wall_range", 2.5)]


@cache
def rig() -> Rig:
    return windowed(example_rig())


@cache
def renderer() -> QuickRenderer:
    return QuickRenderer(rig())


@cache
def shoot(name: str, t: float) -> tuple[Frame, Scene, Plane | None]:
    """A rendered frame, its scene, and the plane of the light on its net."""
    scene = load_scenario(name).scene_at(t)
    picture = renderer().render(scene, t, np.random.default_rng([7, round(1000 * t)]))
    seen = visible_fit(picture.lit, Kind.NET)
    return frame_of(0, t, picture.image), scene, None if seen is None else seen[0]


def errors(posture: Posture, truth: Plane) -> tuple[float, float]:
    """Range error as a share, angle between the normals in degrees."""
    n = truth.normal
    pitch, yaw = posture.pitch - np.arctan2(n[2], n[1]), posture.yaw - np.arctan2(n[0], n[1])
    return posture.range / truth.offset - 1.0, float(np.rad2deg(np.hypot(pitch, yaw)))


def off_target(scan: Scan, truth: Plane) -> float:
    """Root mean square distance of what was believed from the truth, in metres."""
    believed = scan.points.used
    off = truth.signed_distance(scan.points.points_in_dome[believed])
    return float(np.sqrt(np.mean(off**2)))


@pytest.mark.parametrize(("name", "t"), WALLS)
def test_a_wall(name: str, t: float, tmp_path: Path) -> None:
    save_rig(rig(), tmp_path / "rig.yaml")
    frame, scene, _ = shoot(name, t)
    truth = scene.target_plane()
    scan = Scanner(load_rig(tmp_path / "rig.yaml")).process(frame)
    assert scan.posture, scan.posture
    share, angle = errors(scan.posture, truth)
    # As for planes, in test_simulated_posture.
    assert abs(share) < 0.001
    assert angle < 0.2
    assert off_target(scan, truth) < 1e-3 * truth.offset
    # Errors that the covariance explains: a wrong sheet would leave residuals of a common sign.
    sigma = float(np.sqrt(scan.posture.covariance[0, 0]))
    assert abs(scan.posture.range - truth.offset) < 5.0 * sigma


@pytest.mark.parametrize(("name", "t"), WALLS)
def test_planes_in_place_of_the_sheets_are_visibly_wrong(name: str, t: float) -> None:
    """Even the planes that fit the sheets best, as a calibration without windows finds them."""
    camera, reach = rig().camera(), rig().working_range
    planes = tuple(
        replace(laser, plane=sheet.best_plane(camera, reach), window=None)
        for laser, sheet in zip(rig().lasers, sheets_of(rig()), strict=True)
    )
    frame, scene, _ = shoot(name, t)
    scan = Scanner(replace(rig(), lasers=planes)).process(frame)
    assert scan.posture, scan.posture
    share, angle = errors(scan.posture, scene.target_plane())
    assert abs(share) > 0.002 or angle > 1.0
    # Straight stripes are expected where bent ones are: 2 to 12 mm.
    assert off_target(scan, scene.target_plane()) > 4e-3 * scene.target_plane().offset


def test_a_net() -> None:
    frame, _, truth = shoot("net_diamond", 2.0)
    assert truth is not None
    scan = Scanner(rig()).process(frame)
    assert scan.posture, scan.posture
    share, angle = errors(scan.posture, truth)
    assert abs(share) < 0.01
    assert angle < 1.5


def test_the_sheets_move_with_the_index() -> None:
    """Sheets computed for fresh water are wrong in the sea: the index is not only the camera's."""
    sea = replace(rig(), n_water=1.3430)
    frame, scene, _ = shoot("wall_range", 2.5)
    truth = scene.target_plane()
    right, wrong = (errors(Scanner(one).process(frame).posture, truth) for one in (rig(), sea))
    assert abs(wrong[0]) > 5.0 * abs(right[0])
