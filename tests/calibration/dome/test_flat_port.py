"""`calibrate dome` on rigs with a flat port: recovery, true sigmas, refusals."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.calibration.dome.calibrate import dome
from aqualvs.calibration.dome.problem import BoardSet, DomeOptions
from aqualvs.calibration.solver.result import DomeCalibration
from aqualvs.errors import CalibrationError
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.flat_port import FlatPort
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Rig, RigUncertainty, rig_moved_by
from aqualvs.simulation.scenarios import flat_port_rig
from dome_cases import AIR, INTRINSICS, WATER, Given, Shoot, board_points, normalised_errors, see
from whole import WHOLE

QUICK = DomeOptions(check_cross_validation=False)
SIGMA_WATER = 5e-4
START = replace(flat_port_rig(), housing=FlatPort(0.016, 0.005, 1.49))
TOLERANCES = RigUncertainty.independent({"thickness": 1e-4, "n_port": 3e-3})


def drawn(rng: np.random.Generator) -> Rig:
    """The rig with port and intrinsics off by what is not known of them."""
    rig = flat_port_rig()
    for known in (TOLERANCES, INTRINSICS):
        rig = rig_moved_by(rig, known.names, rng.normal(0.0, np.sqrt(np.diag(known.covariance))))
    return rig


def shoot(
    rig: Rig,
    n: float,
    rng: np.random.Generator,
    n_views: int = 12,
    *,
    nearest: float = 0.2,
    at_most: int = 130,
) -> Shoot:
    """Boards in the hand, up to 0.9 m away, turned by 20 degrees."""
    camera, points = rig.in_water(n).camera(), board_points(13, 10)
    views, poses = [], []
    for i, distance in enumerate(np.linspace(nearest, 0.9, n_views)):
        rotation = rotation_from_rotvec(rng.normal(0.0, 0.35, 3)) @ DOME_FROM_CAM_NOMINAL
        middle = np.array([rng.normal(0.0, 0.05), distance, rng.normal(0.0, 0.05)])
        pose = SE3(rotation, middle - rotation @ points.mean(axis=0))
        views.append(see(camera, pose, points, rng, name=f"view_{i}", at_most=at_most))
        poses.append(pose)
    return Shoot(tuple(views), (None,) * n_views, tuple(poses))


def solved(seed: int, options: DomeOptions = QUICK) -> tuple[Rig, Shoot, float, DomeCalibration]:
    rng = np.random.default_rng(seed)
    rig, n = drawn(rng), WATER + rng.normal(0.0, SIGMA_WATER)
    boards = shoot(rig, n, rng)
    found = dome(START, [boards.as_set(WATER, SIGMA_WATER, "pool")], options, INTRINSICS)
    return rig, boards, n, found


def test_normalised_errors_are_normal() -> None:
    runs = []
    for seed in range(15 if WHOLE else 8):
        rig, boards, n, found = solved(seed)
        errors = normalised_errors(found, rig, boards.poses, (n,))
        runs.append([errors[name] for name in sorted(errors)])
        assert found.uncertainty.sigmas["port_distance"] < 0.4e-3
        assert np.rad2deg(found.uncertainty.sigmas["port_tilt_x"]) < 0.05
    values = np.array(runs)
    # 8 runs know a spread to 25 %; the many poses know theirs to 3 %.
    assert np.abs(values).max() < 5.0
    assert np.sqrt(np.mean(values**2)) == pytest.approx(1.0, abs=0.1)


def test_findings_and_the_comparison_with_a_bare_lens() -> None:
    _, _, _, found = solved(0, DomeOptions())
    assert found.cross_validation is not None
    assert found.cross_validation.dome_rms_px < 0.05 * found.cross_validation.bare_rms_px
    said = "\n".join(found.findings)
    assert said.startswith("flat port: 1")
    assert "mm from the lens, tilted by 0.5" in said
    assert "index of the port" in said
    assert "dome" not in said
    pose = START.dome_from_cam
    np.testing.assert_array_equal(found.rig.dome_from_cam.translation, pose.translation)


def test_camera_in_air_and_water_in_one_solve() -> None:
    rng = np.random.default_rng(5)
    rig = drawn(rng)
    air, water = shoot(rig, AIR, rng, 4), shoot(rig, WATER, rng)
    found = dome(START, [air.as_set(), water.as_set(WATER, SIGMA_WATER, "pool")], QUICK, INTRINSICS)
    errors = normalised_errors(found, rig, air.poses + water.poses, (AIR, WATER))
    assert max(map(abs, errors.values())) < 4.5


def test_air_alone_is_refused() -> None:
    boards = shoot(flat_port_rig(), AIR, np.random.default_rng(0), 4)
    with pytest.raises(CalibrationError, match="with the port in water"):
        dome(START, [boards.as_set()], QUICK, INTRINSICS)


def test_poses_are_refused() -> None:
    boards = shoot(flat_port_rig(), WATER, np.random.default_rng(0), 4)
    given = BoardSet(
        name="pool", views=boards.views, poses=[Given(distance=0.3)] * 4, n_medium=WATER
    )
    with pytest.raises(CalibrationError, match="leave the poses out"):
        dome(START, [given], QUICK, INTRINSICS)


def test_too_little_in_the_pictures_is_refused() -> None:
    boards = shoot(flat_port_rig(), WATER, np.random.default_rng(1), 3, nearest=0.7, at_most=25)
    vague = RigUncertainty.independent(dict.fromkeys(("fx", "fy", "cx", "cy"), 10.0))
    with pytest.raises(CalibrationError, match="do not determine the port's distance"):
        dome(START, [boards.as_set(WATER)], QUICK, vague)
