"""The readout of a rolling shutter, from rendered dives."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from aqualvs.calibrate.shutter import ShutterRequest, calibrate_shutter, run_shutter
from aqualvs.errors import CalibrationError, RigError
from aqualvs.optics.rigfile import load_rig, save_rig
from aqualvs.optics.shutter import AT_ONCE, Shutter, ShutterKind
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenario import dome_from_target
from aqualvs.simulation.scenarios import example_rig
from aqualvs.simulation.scene import Scene, Wall
from aqualvs.sources.images import ImageSource
from whole import WHOLE

FPS = 25.0
N = 80 if WHOLE else 54


def rig_with(shutter):
    """The example rig at a third of its resolution, for speed."""
    rig = example_rig()
    lens = replace(rig.lens, fx=272.3, fy=292.7, cx=122.7, cy=93.7)
    return replace(rig, size_px=(240, 192), lens=lens, shutter=shutter)


def swinging(t):
    """Up to 40 degrees/s in pitch and yaw, and 0.1 m/s."""
    turn = np.deg2rad([8.0, 10.0]) * np.sin(2.0 * np.pi * t / np.array([1.26, 1.57]))
    pose = dome_from_target(0.55 + 0.03 * np.sin(2.0 * np.pi * t / 1.9), *turn)
    return Scene(dome_from_scene=pose, walls=(Wall(),), target="wall")


@pytest.fixture(scope="module")
def pictures():
    """Consecutive pictures, blue, green, red."""
    eye = Renderer(rig_with(Shutter(kind=ShutterKind.ROLLING, readout=0.025)), samples=1)
    images = [eye.take(swinging, i / FPS, np.random.default_rng(i)).image for i in range(N)]
    return [np.ascontiguousarray(image[:, :, ::-1]) for image in images]


def source(folder, images):
    """A folder of pictures as a source."""
    folder.mkdir()
    for i, image in enumerate(images):
        cv2.imwrite(str(folder / f"{i:04d}.png"), image)
    return ImageSource(sorted(folder.glob("*.png")), fps=FPS)


def test_the_readout_is_found_and_written(tmp_path, pictures):
    source(tmp_path / "dive", pictures)
    # What the rig says of its shutter, other than the exposure, is of no account.
    save_rig(rig_with(Shutter(exposure=0.004)), tmp_path / "rig.yaml")
    told = []
    request = ShutterRequest(
        source=str(tmp_path / "dive"), rig=tmp_path / "rig.yaml", out=tmp_path / "rig.yaml", fps=FPS
    )
    run_shutter(request, told.append)
    rig = load_rig(tmp_path / "rig.yaml")
    note = rig.solved_from["shutter"]
    assert rig.shutter.kind is ShutterKind.ROLLING
    assert rig.shutter.exposure == 0.004
    assert 1e3 * rig.shutter.readout == pytest.approx(note["readout_ms"], abs=0.01)
    assert note["frames"] > 0.9 * N
    assert abs(note["readout_ms"] - 25.0) < min(3.0 * note["sigma_ms"], 2.0)
    assert re.match(r"readout \d+\.\d+ ± \d\.\d+ ms from \d+ frames", told[0])
    assert "first row to the last" in told[1]
    assert "exposure is not observable" in told[2]
    assert (tmp_path / "rig.shutter.html").stat().st_size > 1000


def test_rows_from_the_bottom_have_a_negative_readout(tmp_path, pictures):
    # Backwards in time, the last row comes first.
    found = calibrate_shutter(source(tmp_path / "dive", pictures[::-1]), rig_with(AT_ONCE))
    assert abs(found.readout + 0.025) < min(3.0 * found.sigma, 2e-3)
    assert found.rolls


def test_without_motion_it_is_not_observable(tmp_path):
    still = Renderer(rig_with(AT_ONCE)).render(swinging(0.0)).image[:, :, ::-1]
    rng = np.random.default_rng(1)
    noisy = [np.clip(still + rng.normal(0.0, 3.0, still.shape), 0, 255) for _ in range(N)]
    with pytest.raises(CalibrationError, match=r"not observable.*; swing the vehicle") as fault:
        calibrate_shutter(source(tmp_path / "still", noisy), rig_with(AT_ONCE))
    assert "\n" not in str(fault.value)


def test_a_dive_without_postures_is_refused(tmp_path, pictures):
    with pytest.raises(CalibrationError, match="a posture in 9 frames only; give a dive of 20 s"):
        calibrate_shutter(source(tmp_path / "few", pictures[:9]), rig_with(AT_ONCE))


def test_interlaced_cameras_are_refused(tmp_path):
    fields = Shutter(kind=ShutterKind.INTERLACED, readout=0.02)
    save_rig(rig_with(fields), tmp_path / "rig.yaml")
    request = ShutterRequest(
        source="none.mp4", rig=tmp_path / "rig.yaml", out=tmp_path / "out.yaml", fps=None
    )
    with pytest.raises(RigError, match=r"rig\.yaml: camera\.shutter\.kind is interlaced"):
        run_shutter(request, print)
