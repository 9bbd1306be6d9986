"""The whole calibration from independently rendered pictures alone, against their truth."""

import csv
import math
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from aqualvs.cli.main import main
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import rotvec_from_rotation
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import load_rig
from aqualvs.optics.solved import rig_uncertainty, solved_steps
from aqualvs.scanner import Scanner
from aqualvs.sources import open_source
from dome_cases import leave_bare_lenses_out
from rig_from_sample_truth import load_truth
from whole import WHOLE

pytestmark = pytest.mark.samples


def sample_rig(folder: Path) -> Rig:
    return load_truth(folder / "truth" / "rig_truth.json")


@pytest.fixture(scope="module")
def folder(samples: Path) -> Path:
    return samples / "lab-paper"


@pytest.fixture(scope="module")
def truth(folder: Path) -> Rig:
    return sample_rig(folder)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("calibration")


def _run(*arguments: object) -> None:
    """Run a command whose last argument is the file to write, unless that is there already."""
    if not Path(str(arguments[-1])).exists():
        assert main(["calibrate", *map(str, arguments)]) == 0


@pytest.fixture(scope="module")
def camera_rig(folder: Path, out: Path) -> Path:
    path, source = out / "camera.yaml", folder / "camera_air"
    nominal = folder / "rig_nominal.yaml"
    _run("camera", source, "--board", source / "board.yaml", "--nominal", nominal, "-o", path)
    return path


def _dome(folder: Path, camera_rig: Path, name: str, *, poses: bool) -> Path:
    path, source = camera_rig.parent / f"{name}_{poses}.yaml", folder / name
    known = ("--poses", source / "poses.csv") if poses else ()
    with pytest.MonkeyPatch.context() as patch:
        # dome/test_recovery.py does it, on the same pictures.
        leave_bare_lenses_out(patch)
        given = ("--board", source / "board.yaml", *known)
        _run("dome", source, *given, "--rig", camera_rig, "-o", path)
    return path


@pytest.fixture(scope="module")
def dome_rig(folder: Path, camera_rig: Path) -> Path:
    return _dome(folder, camera_rig, "dome_air", poses=True)


# In air, by the function: lasers/test_recovery.py.
BOXES = ["box", "box_water"] if WHOLE else ["box_water"]


@pytest.fixture(scope="module", params=BOXES)
def laser_rig(request: pytest.FixtureRequest, folder: Path, dome_rig: Path) -> Path:
    source = folder / request.param
    path = dome_rig.parent / f"{request.param}.yaml"
    pictures = [source] if WHOLE else sorted(source.glob("*.png"))[:4]
    _run("lasers", *pictures, "--box", source / "box.yaml", "--rig", dome_rig, "-o", path)
    return path


def test_camera(camera_rig: Path, truth: Rig) -> None:
    rig = load_rig(camera_rig, need_lasers=False)
    step = solved_steps(rig)["camera"]
    assert step.rms_px <= 0.1
    sigmas = rig_uncertainty(rig).sigmas
    for name in ("fx", "fy", "cx", "cy"):
        found, true = getattr(rig.lens, name), getattr(truth.lens, name)
        assert abs(found - true) <= 2e-3 * truth.lens.fx
        # Corners of a ChArUco board are a few hundredths of a pixel off, not all at random.
        assert abs(found - true) <= 4.0 * sigmas[name]
    assert camera_rig.with_suffix(".camera.html").exists()


# Whole poses, and none, by the function: dome/test_recovery.py.
CASES = [("dome_air", True, 0.2)]
if WHOLE:
    CASES += [("dome_air_exact", True, 0.1), ("dome_air_exact", False, 1.0)]


@pytest.mark.parametrize(("name", "poses", "limit_mm"), CASES)
def test_dome(
    folder: Path, camera_rig: Path, truth: Rig, name: str, poses: bool, limit_mm: float
) -> None:
    rig = load_rig(_dome(folder, camera_rig, name, poses=poses), need_lasers=False)
    sigmas = rig_uncertainty(rig).sigmas
    found, true = rig.dome_from_cam, truth.dome_from_cam
    if poses:
        error = found.translation - true.translation
        turn = rotvec_from_rotation(found.rotation @ true.rotation.T)
        assert np.rad2deg(np.abs(turn).max()) <= 0.1
        for i, axis in enumerate("xyz"):
            assert abs(error[i]) <= 3.0 * sigmas[f"lens_{axis}"]
            assert abs(turn[i]) <= 3.0 * sigmas[f"rotation_{axis}"]
    else:
        # Without poses the dome's axes are the user's word; the lens is compared in the camera's.
        error = found.rotation.T @ found.translation - true.rotation.T @ true.translation
    assert 1e3 * np.linalg.norm(error) <= limit_mm


def test_lasers(laser_rig: Path, truth: Rig) -> None:
    rig = load_rig(laser_rig)
    assert len(rig.lasers) == 3
    # Relative to the camera, as the dome's axes come from the boards being square: what the box
    # itself must find. In the dome's axes the camera's own turn, 0.05 degrees, comes on top.
    turn = truth.dome_from_cam.rotation @ rig.dome_from_cam.rotation.T
    for laser in rig.lasers:
        true = min(
            (other.plane for other in truth.lasers),
            key=lambda plane: -abs(float(plane.normal @ laser.plane.normal)),
        )
        normal = turn @ laser.plane.normal
        sign = math.copysign(1.0, float(normal @ true.normal))
        assert math.degrees(math.acos(min(1.0, sign * float(normal @ true.normal)))) <= 0.05
        assert 1e3 * abs(sign * laser.plane.offset - true.offset) <= 0.3


@pytest.mark.parametrize("dive", ["wall", "wall_range"])
def test_whole_chain(laser_rig: Path, folder: Path, dive: str) -> None:
    """Calibrated in air or water, used in water of an index that the index target tells."""
    path = laser_rig.with_name(f"{laser_rig.stem}_water.yaml")
    clip, target = folder / "index" / "clip_3", folder / "index" / "target.yaml"
    _run("water", clip, "--target", target, "--rig", laser_rig, "-o", path)
    range_share, angles_deg = _errors(load_rig(path), folder, dive, every=1 if WHOLE else 2)
    assert np.sqrt(np.mean(range_share**2)) <= 3e-3
    assert np.abs(range_share).max() <= 6e-3
    assert np.abs(angles_deg).max() <= 0.5


def _errors(rig: Rig, folder: Path, dive: str, every: int) -> tuple[FloatArray, FloatArray]:
    with (folder / "truth" / "dives" / f"{dive}.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    keys = ("range_mm", "pitch_deg", "yaw_deg")
    true = np.array([[float(row[key]) for key in keys] for row in rows[::every]])
    scanner = Scanner(rig)
    postures = []
    with open_source(folder / "dives" / f"{dive}.mp4") as source:
        for frame in islice(source, None, None, every):
            posture = scanner.process(frame).posture
            assert posture
            postures.append((posture.range, posture.pitch, posture.yaw))
    found = np.array(postures) * [1e3, math.degrees(1.0), math.degrees(1.0)]
    return found[:, 0] / true[:, 0] - 1.0, found[:, 1:] - true[:, 1:]
