"""What must hold of every calibration, whatever the rig."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.calibration.dome.calibrate import dome
from aqualvs.calibration.dome.problem import BoardSet, DomeOptions
from aqualvs.calibration.solver.bundle import Bundle, BundleState, TargetView
from aqualvs.calibration.solver.initial_pose import target_pose
from aqualvs.calibration.targets.targets import View
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec, rotvec_from_rotation
from aqualvs.optics.dome import Dome
from aqualvs.optics.rig import Rig, RigUncertainty
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig
from dome_cases import AIR, INTRINSICS, WATER, board_points, guessed, rail, see

QUICK = DomeOptions(check_cross_validation=False)
turns = st.tuples(*[st.floats(-3.0, 3.0)] * 3).map(np.array)
rigs = st.sampled_from([example_rig(), bluerov2_rig()])
media = st.sampled_from([AIR, WATER])


def _one_view(rig: Rig, n: float, seed: int = 1) -> tuple[View, SE3]:
    rng, points = np.random.default_rng(seed), board_points(8, 6, 0.03)
    rotation = rotation_from_rotvec(rng.normal(0.0, 0.2, 3)) @ rig.dome_from_cam.rotation
    ahead = rig.in_water(n).camera().rays(0.5 * np.array(rig.size_px)).directions
    pose = SE3(rotation, 0.5 * ahead - rotation @ points.mean(axis=0))
    return see(rig.in_water(n).camera(), pose, points, rng), pose


@settings(max_examples=25, deadline=None)
@given(rigs, media, turns)
def test_turning_camera_and_target_about_the_centre_changes_nothing(
    rig: Rig, n: float, rotvec: np.ndarray
) -> None:
    """Why boards at unknown poses say nothing about the camera's rotation."""
    view, pose = _one_view(rig, n)
    turn = SE3.from_rotvec(rotvec, np.zeros(3))
    residuals = []
    for whole in (SE3.identity(), turn):
        turned = replace(rig, dome_from_cam=whole @ rig.dome_from_cam)
        state = BundleState(turned, np.array([n]), (whole @ pose,))
        bundle = Bundle(
            (TargetView(view, 0, whole @ pose),), (), state, RigUncertainty.none(), np.zeros(1)
        )
        residuals.append(bundle.blocks(state)[0].residuals)
    # Pixels near 1000 in tenths, to a few roundings through the dome.
    np.testing.assert_allclose(residuals[1], residuals[0], atol=1e-8)


@settings(max_examples=15, deadline=None)
@given(rigs, media, turns)
def test_a_target_may_be_told_in_any_axes(rig: Rig, n: float, rotvec: np.ndarray) -> None:
    view, _ = _one_view(rig, n)
    other_from_target = SE3.from_rotvec(rotvec, np.array([0.3, -0.2, 0.1]))
    moved = View(view.name, view.ids, other_from_target.apply(view.points), view.pixels)
    camera = rig.in_water(n).camera()
    here, there = target_pose(camera, view), target_pose(camera, moved)
    off = (there.dome_from_target @ other_from_target) @ here.dome_from_target.inverse()
    # A fiftieth of a sigma, which is 0.1 mrad and 0.1 mm.
    assert np.linalg.norm(rotvec_from_rotation(off.rotation)) < 2e-5
    np.testing.assert_array_equal(there.inliers, here.inliers)
    assert there.rms_px == pytest.approx(here.rms_px, rel=1e-4)


@settings(max_examples=10, deadline=None)
@given(media)
def test_a_centred_dome_changes_no_pose(n: float) -> None:
    rig = guessed(bluerov2_rig(), rotation_known=True)
    view, _ = _one_view(rig, n)
    behind, bare = target_pose(rig.in_water(n).camera(), view), target_pose(rig.bare_camera(), view)
    np.testing.assert_allclose(
        behind.dome_from_target.translation, bare.dome_from_target.translation, atol=1e-5
    )


def test_the_order_of_views_plays_no_part() -> None:
    shoot = rail(example_rig(), AIR, "distance", np.random.default_rng(2), n_views=6)
    forth = shoot.as_set()
    back = BoardSet(name="air", views=shoot.views[::-1], poses=shoot.given[::-1])
    start = guessed(example_rig(), rotation_known=False)
    one, other = (dome(start, [s], QUICK, INTRINSICS) for s in (forth, back))
    sigma = np.sqrt(np.diag(one.uncertainty.of(("lens_x", "lens_y", "lens_z"))))
    off = one.rig.dome_from_cam.translation - other.rig.dome_from_cam.translation
    # Solves stop within a fiftieth of a sigma.
    assert np.all(np.abs(off) < 0.03 * sigma)
    assert [fit.label for fit in other.views] == [fit.label for fit in one.views][::-1]


@pytest.mark.parametrize("factor", [0.5, 3.0])
def test_a_larger_world_gives_a_larger_rig(factor: float) -> None:
    """Pictures do not change when dome, lens position and board all grow alike."""
    rig = example_rig()
    assert rig.dome is not None
    shoot = rail(rig, AIR, "unknown", np.random.default_rng(3), n_views=6)
    views = tuple(View(v.name, v.ids, factor * v.points, v.pixels) for v in shoot.views)
    shell = rig.dome
    grown = replace(
        rig, housing=Dome(factor * shell.inner_radius, factor * shell.thickness, shell.n_acrylic)
    )
    wider = replace(QUICK, inner_radius_sigma=factor * 1e-4, thickness_sigma=factor * 1e-4)
    small = dome(guessed(rig, rotation_known=True), [shoot.as_set()], QUICK, INTRINSICS)
    large = dome(
        guessed(grown, rotation_known=True), [BoardSet(name="air", views=views)], wider, INTRINSICS
    )
    sigma = np.sqrt(np.diag(small.uncertainty.of(("lens_x", "lens_y", "lens_z"))))
    off = large.rig.dome_from_cam.translation / factor - small.rig.dome_from_cam.translation
    assert np.all(np.abs(off) < 0.03 * sigma)
