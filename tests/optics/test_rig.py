"""The rig: its cameras, and the true rig of the independently rendered samples."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import rig_from_sample_truth
from aqualvs.errors import RigError
from aqualvs.geometry import rotvec_from_rotation
from aqualvs.optics.dome import Dome
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Rig
from aqualvs.optics.rigfile import load_rig
from aqualvs.simulation.scenarios import example_rig
from repository import ROOT

TOOL = ROOT / "tools" / "rig_from_sample_truth.py"


def test_nominal_mounting_is_a_rotation_that_nobody_can_change() -> None:
    np.testing.assert_array_equal(DOME_FROM_CAM_NOMINAL @ DOME_FROM_CAM_NOMINAL.T, np.eye(3))
    assert np.linalg.det(DOME_FROM_CAM_NOMINAL) == pytest.approx(1.0, abs=1e-15)
    with pytest.raises(ValueError, match="read-only"):
        DOME_FROM_CAM_NOMINAL[0, 0] = 2.0


def test_rig_gives_its_cameras() -> None:
    rig = example_rig()
    camera = rig.camera()
    assert camera.housing is not None
    assert isinstance(camera.housing, Dome)
    assert rig.bare_camera().housing is None
    bare = Rig(**{name: getattr(rig, name) for name in Rig.__slots__} | {"housing": None})
    assert bare.camera().housing is None


def test_in_water_changes_the_index_alone() -> None:
    rig = example_rig()
    salty = rig.in_water(1.342)
    assert salty.n_water == 1.342
    assert salty.lasers is rig.lasers
    pixel = [700.0, 20.0]
    bent = salty.camera().rays(pixel).directions @ rig.camera().rays(pixel).directions
    assert bent < 1.0 - 1e-9


TRUTH = {
    "name": "tiny",
    "camera": {"width": 640, "height": 480, "fx": 800, "fy": 801, "cx": 320, "cy": 240, "dist": []},
    "lens_mm": [1.0, 20.0, -2.0],
    "camera_rotvec": [0.02, 0.0, -0.01],
    "n_air": 1.0003,
    "n_water": 1.34,
    "dome": {"inner_mm": 50.0, "thickness_mm": 5.0, "n_acrylic": 1.49},
    "lasers": [{"normal": [0.6, 0.0, 0.8], "d_mm": -120.0, "power": 1.0}] * 4,
}


def test_tool_converts() -> None:
    rig = rig_from_sample_truth.rig_from_truth(TRUTH)
    assert rig.size_px == (640, 480)
    assert (rig.dome.inner_radius, rig.dome.thickness) == (0.05, 0.005)
    assert [laser.name for laser in rig.lasers] == ["horizontal", "vertical", "diagonal", "laser 4"]
    assert rig.lasers[0].plane.offset == -0.12
    np.testing.assert_array_equal(rig.dome_from_cam.translation, [0.001, 0.02, -0.002])
    turn = rotvec_from_rotation(rig.dome_from_cam.rotation @ DOME_FROM_CAM_NOMINAL.T)
    np.testing.assert_allclose(turn, TRUTH["camera_rotvec"], atol=1e-15)
    assert rig.working_range == (0.25, 1.3)


def test_tool_runs_and_refuses(tmp_path: Path) -> None:
    truth, out = tmp_path / "rig_truth.json", tmp_path / "rig.yaml"
    truth.write_text(json.dumps(TRUTH))
    command = [sys.executable, str(TOOL), str(truth), "-o", str(out)]
    subprocess.run(command, check=True, timeout=300)
    assert load_rig(out).name == "tiny"
    for text in ("{", json.dumps({"name": "x"}), "[]"):
        truth.write_text(text)
        with pytest.raises(RigError, match=r"rig_truth\.json"):
            rig_from_sample_truth.load_truth(truth)
    with pytest.raises(RigError, match=r"none\.json"):
        rig_from_sample_truth.load_truth(tmp_path / "none.json")


@pytest.mark.samples
def test_true_rig_projects_the_samples_points(samples: Path) -> None:
    """The samples' generator shares no code with this project; its pixels are exact."""
    truth = samples / "lab-paper" / "truth"
    rig = rig_from_sample_truth.load_truth(truth / "rig_truth.json")
    for path in sorted((truth / "dives" / "wall").glob("*.npz"))[::5]:
        frame = np.load(path)
        pixels, valid = rig.camera().project(frame["xyz"] / 1e3)
        assert valid.all()
        # The files hold single precision: 700 px to 3e-5, a metre to 6e-8 (about 1e-4 px).
        np.testing.assert_allclose(pixels, frame["px"], atol=1e-3)
        for i, laser in enumerate(rig.lasers):
            own = frame["xyz"][frame["laser"] == i] / 1e3
            np.testing.assert_allclose(laser.plane.signed_distance(own), 0.0, atol=1e-6)
