"""What the experiments on rig, dome, index and box compute beside the calibrations themselves."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.calibration.lasers.checks import LaserFigures
from aqualvs.calibration.targets.pose_files import BoardPose
from aqualvs.calibration.targets.targets import View
from aqualvs.errors import CalibrationError, RigError
from aqualvs.experiments.dome_boards import read_with_errors
from aqualvs.experiments.laser_box import angle_between, matched, plane_error, remaining
from aqualvs.experiments.rig_table import band_shares, bending
from aqualvs.experiments.water_index import decentred, paper_index
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.rig import moved_plane
from aqualvs.simulation.scenarios import example_rig

RIG = example_rig()
PIXELS = np.array([[20.0, 30.0], [369.0, 282.0], [700.0, 560.0]])


def figures(plane, name="left", paper=None):
    return LaserFigures(
        laser=replace(RIG.lasers[0], name=name, plane=plane),
        sigma_normal=1e-3,
        sigma_offset=2e-4,
        rms_px=0.1,
        rms=1e-4,
        n_points=100,
        surfaces=("left",),
        paper_plane=paper or plane,
        sheet="plane",
    )


def with_lens(y_mm):
    pose = SE3(RIG.dome_from_cam.rotation, np.array([0.0, y_mm / 1e3, 0.0]))
    return replace(RIG, dome_from_cam=pose)


def test_rays_obey_snell_at_both_surfaces():
    traced = bending(RIG, PIXELS)
    acrylic = traced.outer - traced.inner
    acrylic /= np.linalg.norm(acrylic, axis=-1, keepdims=True)

    def tangential(ways, points):
        return np.linalg.norm(np.cross(ways, points), axis=-1) / np.linalg.norm(points, axis=-1)

    inside = RIG.n_air * tangential(traced.straight, traced.inner)
    np.testing.assert_allclose(inside, 1.49 * tangential(acrylic, traced.inner), rtol=1e-9)
    outside = RIG.n_water * tangential(traced.water, traced.outer)
    np.testing.assert_allclose(outside, 1.49 * tangential(acrylic, traced.outer), rtol=1e-9)
    assert np.all(traced.bent > np.deg2rad(0.1))
    assert np.all(traced.missed_at(1.0) > 1e-3)


def test_rays_from_the_centre_do_not_bend():
    traced = bending(with_lens(0.0), PIXELS)
    # Rounding of unit vectors.
    np.testing.assert_allclose(traced.bent, 0.0, atol=1e-12)
    np.testing.assert_allclose(traced.missed_at(1.0), 0.0, atol=1e-12)


def test_bare_lens_has_no_rays_through_a_dome():
    with pytest.raises(RigError, match="no dome"):
        bending(replace(RIG, housing=None), PIXELS)


def test_bands_take_more_of_the_picture_the_longer_the_range():
    near, wide = (replace(RIG, working_range=r) for r in ((0.5, 0.55), (0.3, 1.0)))
    for few, many in zip(band_shares(near), band_shares(wide), strict=True):
        assert 0.0 < few < many <= 1.0


def test_distances_are_read_off_with_errors_of_their_own_and_one_that_is_shared():
    rows = [BoardPose(f"{i}.png", 0.3 + 0.1 * i, None) for i in range(400)]
    off = np.array([r.distance for r in read_with_errors(rows)]) - [r.distance for r in rows]
    # 400 readings know their spread to 3.5 %, and their mean to 0.01 mm.
    assert np.std(off) == pytest.approx(0.2e-3, rel=0.12)
    means = [
        np.mean(
            [a.distance - b.distance for a, b in zip(read_with_errors(rows, s), rows, strict=True)]
        )
        for s in range(40)
    ]
    assert np.std(means) == pytest.approx(0.2e-3, rel=0.4)
    unknown = BoardPose("x.png", None, None)
    assert read_with_errors([unknown]) == (unknown,)


def seen_plate(rig, n, shift=(0.0, 0.0, 0.0)):
    x, z = np.meshgrid(np.linspace(-0.05, 0.05, 4), np.linspace(0.02, 0.10, 3))
    points = np.stack([x.ravel(), np.full(x.size, 0.35), z.ravel()], axis=-1)
    pixels, valid = rig.in_water(n).camera().project(points + np.array(shift))
    assert valid.all()
    return View("plate", np.arange(len(points)), points, pixels)


@pytest.mark.parametrize("n", [1.0003, 1.3333, 1.343])
def test_paper_s_index_is_exact_without_errors(n):
    # The search stops at 1e-7.
    assert paper_index(RIG, seen_plate(RIG, n)) == pytest.approx(n, abs=1e-5)


def test_paper_s_index_takes_a_target_out_of_place_for_other_water():
    off = paper_index(RIG, seen_plate(RIG, 1.3333, (0.0, 0.3e-3, 0.0)))
    assert abs(off - 1.3333) > 5e-4


def test_index_is_unobservable_at_the_centre_only():
    spread = decentred(RIG, (0.0, 16.0, 41.7))
    assert list(spread.observable) == [False, True, True]
    assert spread.noise[0] > 0.05
    assert spread.noise[2] < spread.noise[1] < spread.placed[1]
    # A hundredfold of what noise alone leaves at the paper's lens.
    assert spread.noise[2] < 1e-4


def test_plane_errors_are_those_that_were_made():
    true = RIG.lasers[1].plane
    found = moved_plane(true, 2e-3, 0.0, 1e-4)
    paper = moved_plane(true, 0.0, 5e-3, -3e-4)
    # The same plane, told from its other side.
    turned = Plane(-found.normal, -found.offset)
    for plane in (found, turned):
        error = plane_error(figures(plane, paper=paper), true)
        assert error.angle == pytest.approx(2e-3, rel=1e-4)
        assert error.offset == pytest.approx(1e-4, rel=1e-6)
        assert error.paper_angle == pytest.approx(5e-3, rel=1e-4)
        assert error.paper_offset == pytest.approx(-3e-4, rel=1e-6)


def test_small_angles_are_exact():
    turned = rotation_from_rotvec([0.0, 0.0, 1e-9]) @ np.array([1.0, 0.0, 0.0])
    assert angle_between(turned, np.array([1.0, 0.0, 0.0])) == pytest.approx(1e-9, rel=1e-6)


def test_lasers_are_matched_by_their_planes_whatever_their_names():
    order = (2, 0, 1)
    found = [figures(moved_plane(RIG.lasers[i].plane, 1e-3, 0.0, 0.0), f"laser_{i}") for i in order]
    assert [f.laser.name for f in matched(found, RIG.lasers)] == ["laser_0", "laser_1", "laser_2"]
    with pytest.raises(CalibrationError, match="1 lasers found for 3"):
        matched(found[:1], RIG.lasers)


def test_nothing_remains_of_a_perfect_calibration():
    left = remaining(RIG, RIG, (0.3, 1.0))
    # Root finding of stripes and rounding.
    np.testing.assert_allclose(left.errors, 0.0, atol=1e-9)


def test_a_shifted_lens_shows_in_the_range():
    moved = replace(
        RIG,
        dome_from_cam=SE3(
            RIG.dome_from_cam.rotation, RIG.dome_from_cam.translation - np.array([0.0, 5e-3, 0.0])
        ),
    )
    percent = np.abs(remaining(RIG, moved, (0.3, 0.6)).percent)
    assert np.all((percent > 0.2) & (percent < 5.0))
