"""The joint covariance of camera and lasers."""

import functools

import numpy as np
import pytest

from aqualvs.calibration.lasers.calibrate import LaserOptions, calibrate_lasers
from aqualvs.calibration.lasers.covariance import CameraCovariance
from aqualvs.calibration.lasers.views import LaserView
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.rig import LASER_PARAMETERS, Rig, RigUncertainty, rig_moved_by, tangent_basis
from aqualvs.simulation.scenarios import example_rig
from laser_cases import Noise, box, box_views, camera_uncertainty
from whole import part_of

RIG = example_rig()


@functools.cache
def views() -> list[LaserView]:
    return box_views(RIG, noise=Noise(corner_px=0.05, stripe_px=0.05), spacing=0.006)


def laser_names(rig: Rig) -> list[str]:
    return [f"{laser.name}:{name}" for laser in rig.lasers for name in LASER_PARAMETERS]


def steps(start: Rig, end: Rig) -> FloatArray:
    """By how much the lasers of two rigs differ, as `LASER_PARAMETERS` (3 L,)."""
    found = []
    for a, b in zip(start.lasers, end.lasers, strict=True):
        found += (tangent_basis(a.plane.normal) @ b.plane.normal).tolist()
        found.append(b.plane.offset - a.plane.offset)
    return np.array(found)


def block(uncertainty: RigUncertainty, rows: list[str], columns: list[str]) -> FloatArray:
    i = [uncertainty.names.index(name) for name in rows]
    j = [uncertainty.names.index(name) for name in columns]
    part: FloatArray = uncertainty.covariance[np.ix_(i, j)]
    return part


@pytest.mark.parametrize(
    ("name", "size"),
    part_of([("lens_y", 1e-4), ("rotation_x", 1e-4), ("fx", 0.1), ("cx", 0.1), ("n_water", 1e-4)]),
)
def test_errors_of_held_numbers_move_the_planes_as_told(name: str, size: float) -> None:
    """Solve again with a camera that is a little wrong: the planes follow their covariance."""
    given = RigUncertainty((name,), np.array([[size**2]]))
    result = calibrate_lasers(RIG, views(), box(), uncertainty=given)
    lasers = laser_names(RIG)
    told = block(result.uncertainty, lasers, [name])[:, 0] / size**2
    wrong = [
        calibrate_lasers(rig_moved_by(RIG, [name], np.array([s * size])), views(), box()).rig
        for s in (1.0, -1.0)
    ]
    seen = steps(wrong[1], wrong[0]) / (2.0 * size)
    # Noise scales and outliers are estimated anew, which moves planes by hundredths of a sigma.
    np.testing.assert_allclose(seen, told, atol=0.05 * float(np.abs(told).max()))
    assert block(result.uncertainty, [name], [name])[0, 0] == pytest.approx(size**2)


def test_held_doubt_only_adds() -> None:
    exact = calibrate_lasers(RIG, views(), box())
    doubtful = calibrate_lasers(RIG, views(), box(), uncertainty=camera_uncertainty())
    names = laser_names(RIG)
    more = doubtful.uncertainty.of(names) - exact.uncertainty.of(names)
    sigma = np.sqrt(np.diag(doubtful.uncertainty.of(names)))
    assert np.linalg.eigvalsh(more / np.outer(sigma, sigma)).min() > -1e-9
    for a, b in zip(exact.rig.lasers, doubtful.rig.lasers, strict=True):
        np.testing.assert_array_equal(a.plane.normal, b.plane.normal)


def test_refinement_learns_and_never_unlearns() -> None:
    given = camera_uncertainty()
    held = calibrate_lasers(RIG, views(), box(), uncertainty=given)
    refined = calibrate_lasers(
        RIG, views(), box(), uncertainty=given, options=LaserOptions(refine=True)
    )
    names = [*given.names, *laser_names(RIG)]
    before, after = held.uncertainty.of(names), refined.uncertainty.of(names)
    ratio = np.sqrt(np.diag(after) / np.diag(before))
    # Held, the bias of stripes and a wrong camera are separate; a refined camera soaks up a little.
    assert np.all(ratio < 1.05)
    assert ratio[names.index("lens_y")] < 0.9
    assert refined.refined
    assert not held.refined
    assert refined.rig.lens.fx != RIG.lens.fx
    assert held.rig.lens == RIG.lens


def test_numbers_that_play_no_part_follow_those_that_do() -> None:
    """`n_water` is no part of a calibration in air, but may be correlated with the lens."""
    covariance = np.array([[1e-8, 0.8e-8], [0.8e-8, 1e-8]])
    given = RigUncertainty(("lens_y", "n_water"), covariance)
    in_air = box_views(RIG.in_water(1.0003), noise=Noise(corner_px=0.05, stripe_px=0.05))
    options = LaserOptions(n_medium=1.0003)
    result = calibrate_lasers(RIG, in_air, box(), uncertainty=given, options=options)
    names = laser_names(RIG)
    assert result.rig.n_water == RIG.n_water
    np.testing.assert_allclose(result.uncertainty.of(("lens_y", "n_water")), covariance)
    by_lens = block(result.uncertainty, names, ["lens_y"])
    np.testing.assert_allclose(
        block(result.uncertainty, names, ["n_water"]), 0.8 * by_lens, rtol=1e-9, atol=1e-18
    )
    # Never less than nothing.
    assert np.linalg.eigvalsh(result.uncertainty.covariance).min() > -1e-18


def test_what_was_known_of_the_lasers_is_replaced() -> None:
    old = RigUncertainty(("lens_x", "lower:offset"), np.diag([1e-8, 1.0]))
    result = calibrate_lasers(RIG, views(), box(), uncertainty=old)
    assert result.uncertainty.names == ("lens_x", *laser_names(RIG))
    assert result.uncertainty.sigmas["lower:offset"] < 1e-3


def test_bias_of_stripes_does_not_average_out() -> None:
    clean, biased = (
        calibrate_lasers(RIG, views(), box(), options=LaserOptions(stripe_bias_px=b))
        for b in (1e-6, 0.3)
    )
    for a, b in zip(clean.lasers, biased.lasers, strict=True):
        assert b.sigma_offset > 3.0 * a.sigma_offset


def test_doubt_knows_its_medium() -> None:
    given = RigUncertainty(("fx", "n_water", "k1"), np.diag([1.0, 1e-6, 0.0]))
    water = CameraCovariance.of(RIG, given, None)
    assert water.names == ("fx",)
    assert water.columns == ("fx", "n_water")
    assert water.sigma_medium == pytest.approx(1e-3)
    np.testing.assert_array_equal(water.covariance, np.diag([1.0, 1e-6]))
    air = CameraCovariance.of(RIG, given, 1.0003)
    assert air.sigma_medium == 0.0
    assert air.columns == ("fx",)
    np.testing.assert_array_equal(air.covariance, [[1.0]])
