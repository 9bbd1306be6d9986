"""Uncertainty of a rig: joining, replacing, and what a step does to a rig."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import rotvec_from_rotation
from aqualvs.optics.rig import (
    Laser,
    RigUncertainty,
    Window,
    combined,
    laser_parameter_names,
    merged,
    moved_plane,
    rig_moved_by,
    rig_parameter_names,
    tangent_basis,
)
from aqualvs.optics.sheet import sheets_of
from aqualvs.simulation.scenarios import example_rig

A, B, C = "fx", "fy", "k1"


def known(*names: str, seed: int = 0) -> RigUncertainty:
    root = np.random.default_rng(seed).normal(size=(len(names), len(names)))
    return RigUncertainty(names, root @ root.T)


def test_new_numbers_replace_old_ones_and_their_cross_terms() -> None:
    old, new = known(A, B, C), known(B, seed=1)
    found = merged(old, new)
    assert found.names == (B, A, C)
    np.testing.assert_array_equal(found.of((A, C)), old.of((A, C)))
    np.testing.assert_array_equal(found.of((B,)), new.of((B,)))
    np.testing.assert_array_equal(found.of((A, B, C))[1, [0, 2]], 0.0)


def test_merging_with_nothing_changes_nothing() -> None:
    one = known(A, B)
    for found in (merged(one, RigUncertainty.none()), merged(RigUncertainty.none(), one)):
        assert found.names == one.names
        np.testing.assert_array_equal(found.covariance, one.covariance)


def test_two_sources_add_their_information() -> None:
    one, other = known(A, B), known(A, B, seed=1)
    expected = np.linalg.inv(np.linalg.inv(one.covariance) + np.linalg.inv(other.covariance))
    np.testing.assert_allclose(combined(one, other).covariance, expected, rtol=1e-9)


def test_what_is_correlated_with_a_better_known_number_gets_better() -> None:
    one, other = known(A, B), RigUncertainty.independent({B: 0.1, C: 2.0})
    found = combined(one, other)
    assert found.names == (A, B, C)
    information = np.linalg.inv(one.covariance) + np.diag([0.0, 1.0 / 0.1**2])
    np.testing.assert_allclose(found.of((A, B)), np.linalg.inv(information), rtol=1e-9)
    assert found.sigmas[C] == pytest.approx(2.0)


def test_units_of_any_size_combine() -> None:
    one = RigUncertainty.independent({A: 1.0, C: 1e-9})
    other = RigUncertainty.independent({A: 1.0, C: 1e-9})
    # Information doubles for both, though their variances differ by 18 orders of magnitude.
    np.testing.assert_allclose(
        [*combined(one, other).sigmas.values()], np.sqrt(0.5) * np.array([1.0, 1e-9]), rtol=1e-12
    )


def test_exact_numbers_stay_exact() -> None:
    found = combined(RigUncertainty.independent({A: 0.0, B: 1.0}), known(A, B))
    assert found.sigmas[A] == 0.0
    assert combined(RigUncertainty.independent({A: 0.0}), RigUncertainty.independent({A: 0.0}))


def test_misuse_is_refused() -> None:
    with pytest.raises(ValueError, match="names repeat"):
        RigUncertainty((A, A), np.eye(2))
    with pytest.raises(ValueError, match="expected"):
        RigUncertainty((A, B), np.eye(3))


@pytest.mark.parametrize("laser", example_rig().lasers, ids=lambda laser: laser.name)
def test_tangent_basis_is_orthonormal(laser: Laser) -> None:
    normal = laser.plane.normal
    frame = np.vstack([normal, tangent_basis(normal)])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-15)


def test_a_plane_turns_by_its_tilt() -> None:
    plane = Plane.from_normal([0.2, -0.3, 0.9], -0.14)
    moved = moved_plane(plane, 3e-4, -4e-4, 1e-3)
    # tan(5e-4) differs from 5e-4 by 4e-11.
    assert np.arccos(moved.normal @ plane.normal) == pytest.approx(5e-4, rel=1e-6)
    assert moved.offset - plane.offset == pytest.approx(1e-3)


def test_every_number_of_a_rig_moves_by_its_step() -> None:
    rig = example_rig()
    names = rig_parameter_names(rig)
    step = np.linspace(1.0, 2.0, len(names)) * 1e-5
    moved = rig_moved_by(rig, names, step)
    by = dict(zip(names, step, strict=True))
    assert rig.dome is not None
    assert moved.dome is not None
    shift = moved.dome_from_cam.translation - rig.dome_from_cam.translation
    turn = rotvec_from_rotation(moved.dome_from_cam.rotation @ rig.dome_from_cam.rotation.T)
    # Differences of numbers up to 900, of which doubles keep 1e-13.
    for found, name in [
        *zip(shift, ("lens_x", "lens_y", "lens_z"), strict=True),
        *zip(turn, ("rotation_x", "rotation_y", "rotation_z"), strict=True),
        (moved.lens.fy - rig.lens.fy, "fy"),
        (moved.lens.distortion[2] - rig.lens.distortion[2], "p1"),
        (moved.dome.inner_radius - rig.dome.inner_radius, "inner_radius"),
        (moved.dome.n_acrylic - rig.dome.n_acrylic, "n_acrylic"),
        (moved.n_air - rig.n_air, "n_air"),
        (moved.n_water - rig.n_water, "n_water"),
        (moved.lasers[1].plane.offset - rig.lasers[1].plane.offset, "left:offset"),
    ]:
        assert found == pytest.approx(by[name], abs=2e-13), name
    tilt = tangent_basis(rig.lasers[2].plane.normal) @ moved.lasers[2].plane.normal
    # The tangent of the tilt is divided by its length: 1e-10 of it.
    np.testing.assert_allclose(tilt, [by["right:tilt_1"], by["right:tilt_2"]], rtol=1e-8)


def test_a_window_moves_as_its_sheet_does() -> None:
    laser = example_rig().lasers[1]
    beside = laser.plane.offset * laser.plane.normal + 0.02 * tangent_basis(laser.plane.normal)[0]
    window = Window(Plane.from_normal([0.1, 0.98, 0.15], beside[1] + 0.05), beside)
    laser = replace(laser, window=window)
    rig = replace(example_rig(), lasers=(laser,))
    names = laser_parameter_names(laser)
    step = np.linspace(1.0, 2.0, len(names)) * 1e-3
    moved = sheets_of(rig_moved_by(rig, names, step))[0]
    expected = sheets_of(rig)[0].moved_by([*step, 0.0])
    points = np.random.default_rng(1).uniform([-0.3, 0.4, -0.3], [0.3, 1.0, 0.3], (20, 3))
    # The sheet keeps its source in the moved plane, off by the square of the step.
    np.testing.assert_allclose(
        moved.signed_distance(points), expected.signed_distance(points), atol=1e-8
    )
    assert abs(moved.signed_distance(points) - sheets_of(rig)[0].signed_distance(points)).min() > 0
