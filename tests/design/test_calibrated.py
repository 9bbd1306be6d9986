"""Lasers calibrated with a camera that is not quite right."""

import math
from dataclasses import replace

import numpy as np
import pytest

from aqualvs.design.calibrated import camera_errors, lasers_by
from aqualvs.design.changes import best_angles
from aqualvs.design.settings import Design, Tolerances, ring
from aqualvs.geometry.transforms import SE3
from aqualvs.simulation.scenarios import bluerov2_rig

RANGES = (0.35, 1.0)
EXACT = Tolerances(lens=0.0, rotation=0.0, focal=0.0, dome=0.0)


@pytest.fixture(scope="module")
def design() -> Design:
    mounts = ring(3, 0.15, 0.0, math.radians(68.0))
    return best_angles(Design(rig=bluerov2_rig(), mounts=mounts), quick=True)


def test_a_right_camera_finds_the_lasers_and_a_wrong_one_others(design):
    rig = design.nominal_rig()
    found = lasers_by(replace(rig, lasers=()), rig)
    assert found is not None
    for laser, true in zip(found.lasers, rig.lasers, strict=True):
        turn = math.copysign(1.0, float(laser.plane.normal @ true.plane.normal))
        # The boards' places are solved to about a micrometre.
        np.testing.assert_allclose(turn * laser.plane.normal, true.plane.normal, atol=1e-5)
        assert turn * laser.plane.offset == pytest.approx(true.plane.offset, abs=1e-5)
    moved = replace(rig, dome_from_cam=SE3(rig.dome_from_cam.rotation, np.array([0, 2e-2, 0])))
    wrong = lasers_by(rig, moved)
    assert wrong is not None
    off = [
        abs(abs(a.plane.offset) - abs(b.plane.offset))
        for a, b in zip(wrong.lasers, rig.lasers, strict=True)
    ]
    assert max(off) > 1e-3


def test_lasers_that_light_no_board_are_not_found(design):
    rig = design.nominal_rig()
    away = design.with_mounts([replace(design.mounts[0], tilt=math.radians(-60.0))]).nominal_rig()
    assert lasers_by(rig, away) is None
    lost = design.with_mounts([*design.mounts[1:], replace(design.mounts[0], tilt=-1.0)])
    assert np.isnan(camera_errors(lost, RANGES)["lens place"]).all()


def test_a_turned_camera_turns_the_world_and_leaves_the_range(design):
    """Boards and lasers turn with it; the dome's centre is 6 mm off, so hardly anything else."""
    turn = math.radians(0.05)
    tolerances = replace(EXACT, rotation=turn)
    errors = camera_errors(replace(design, tolerances=tolerances), RANGES)
    assert np.all(errors["camera rotation"][:, 0] < 2e-5 * np.array(RANGES))
    np.testing.assert_allclose(errors["camera rotation"][:, 1:], turn, rtol=0.05)
    for cause in ("lens place", "focal length", "dome"):
        # Poses of boards are solved to so much of the range, and of a radian.
        assert np.all(errors[cause] < 1e-6)


def test_a_wrong_focal_length_scales_the_range(design):
    """Boards seem farther by as much as the focal length is too long; pinholes, and nearly here."""
    tolerances = replace(EXACT, focal=1e-3)
    share = camera_errors(replace(design, tolerances=tolerances), RANGES)["focal length"][:, 0]
    np.testing.assert_allclose(share / RANGES, 1e-3, rtol=0.1)


def test_what_the_camera_costs_hardly_depends_on_the_lasers_angles(design):
    """This is why the search for the best angles leaves it out."""
    other = design.with_mounts(
        [replace(m, stripe=m.stripe + 0.3, tilt=m.tilt - 0.05) for m in design.mounts]
    )
    for cause, sigma in camera_errors(design, RANGES).items():
        changed = camera_errors(other, RANGES)[cause]
        np.testing.assert_allclose(changed[:, 0], sigma[:, 0], rtol=0.05, atol=2e-6)
