"""What a rig can measure: the propagated covariance against Monte Carlo, and closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.expected_error import (
    N_POINTS,
    SIGMA_PX,
    USUAL_RANGES,
    StripeView,
    WallView,
    expected_posture_errors,
    point_per_pixel,
    visible_stripe,
)
from aqualvs.optics.rig import Rig, RigUncertainty, Window, rig_moved_by, rig_parameter_names
from aqualvs.optics.sheet import sheets_of
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig

SIGMAS = {
    "lens": 2e-4,
    "rotation": 5e-4,
    "inner_radius": 1e-4,
    "thickness": 1e-4,
    "n_acrylic": 2e-3,
    "n_water": 5e-4,
    "fx": 0.6,
    "fy": 0.6,
    "cx": 0.8,
    "cy": 0.8,
    "k1": 2e-3,
    "tilt": 4e-4,
    "offset": 2e-4,
}


def joint_uncertainty(rig: Rig) -> RigUncertainty:
    """Uncertainty as of a calibration, with errors of all numbers mixed by a random rotation."""
    names = rig_parameter_names(rig)
    stems = [name.rpartition(":")[2].removesuffix("_1").removesuffix("_2") for name in names]
    sigma = np.array([SIGMAS.get(stem, SIGMAS.get(stem[:-2], 0.0)) for stem in stems])
    root = np.random.default_rng(5).normal(size=(len(names), len(names)))
    correlation = root @ root.T + len(names) * np.eye(len(names))
    scale = sigma / np.sqrt(np.diag(correlation))
    return RigUncertainty(names, correlation * np.outer(scale, scale))


def posture_by_points(
    pixels: list[FloatArray], rig: Rig, weights: list[FloatArray]
) -> tuple[float, float, float]:
    """Triangulate and fit without the code under test."""
    rows, right = [], []
    for laser, seen, weight in zip(rig.lasers, pixels, weights, strict=True):
        rays = rig.camera().rays(seen)
        n, d = laser.plane.normal, laser.plane.offset
        reach = (d - rays.origins @ n) / (rays.directions @ n)
        rows.append((rays.origins + reach[:, None] * rays.directions) * weight[:, None])
        right.append(weight)
    x, y, z = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right))[0]
    return 1.0 / np.sqrt(x * x + y * y + z * z), np.arctan(z / y), np.arctan(x / y)


def test_a_stripe_that_is_hardly_in_the_picture_has_a_direction_at_every_point() -> None:
    rig = example_rig()
    whole = visible_stripe(rig.camera(), sheets_of(rig)[0], 0.6)
    few = StripeView(whole.sheet, whole.points_in_dome[:5], whole.pixels[:5], 7.0).thinned(N_POINTS)
    assert len(few.pixels) == 5
    assert np.isfinite(point_per_pixel(rig.camera(), few)).all()


@pytest.mark.parametrize("rig", [example_rig(), bluerov2_rig()], ids=lambda rig: rig.name)
def test_calibration_errors_are_those_of_a_monte_carlo(rig: Rig) -> None:
    uncertainty, rng = joint_uncertainty(rig), np.random.default_rng(4)
    root = np.linalg.cholesky(uncertainty.covariance + 1e-30 * np.eye(len(uncertainty.names)))
    told = expected_posture_errors(rig, uncertainty)
    n_trials = 500
    rigs = [
        rig_moved_by(rig, uncertainty.names, root @ rng.normal(size=len(root)))
        for _ in range(n_trials)
    ]
    for expected in told:
        views = [
            visible_stripe(rig.camera(), sheet, expected.wall_range).thinned(N_POINTS)
            for sheet in sheets_of(rig)
        ]
        weights = [1.0 / np.abs(point_per_pixel(rig.camera(), view)[:, 1]) for view in views]
        pixels = [view.pixels for view in views]
        found = np.array([posture_by_points(pixels, moved, weights) for moved in rigs])
        # A standard deviation from 500 trials is known to 3.2 %: three times that.
        np.testing.assert_allclose(found.std(axis=0), expected.sigma_calibration, rtol=0.10)
        correlation = np.corrcoef(found.T)
        scale = np.outer(expected.sigma_calibration, expected.sigma_calibration)
        np.testing.assert_allclose(correlation, expected.calibration / scale, atol=0.15)


def test_noise_is_that_of_a_monte_carlo() -> None:
    rig, rng = example_rig(), np.random.default_rng(11)
    views = [visible_stripe(rig.camera(), s, 0.6).thinned(N_POINTS) for s in sheets_of(rig)]
    slopes = [point_per_pixel(rig.camera(), view) for view in views]
    true, slope = np.concatenate([v.points_in_dome for v in views]), np.concatenate(slopes)
    weight = 1.0 / np.abs(slope[:, 1])
    posture = np.empty((600, 3))
    for i in range(len(posture)):
        noisy = true + slope * rng.normal(0.0, SIGMA_PX, size=(len(true), 1))
        m = np.linalg.lstsq(noisy * weight[:, None], weight)[0]
        posture[i] = 1.0 / np.linalg.norm(m), np.arctan2(m[2], m[1]), np.arctan2(m[0], m[1])
    (told,) = expected_posture_errors(rig, RigUncertainty.none(), (0.6,))
    # A standard deviation from 600 trials is known to 1/sqrt(1200) = 3 %; four times that.
    np.testing.assert_allclose(posture.std(axis=0), told.sigma_noise, rtol=0.12)
    np.testing.assert_array_equal(told.sigma_calibration, 0.0)


def test_both_errors_add_as_variances() -> None:
    rig = example_rig()
    for told in expected_posture_errors(rig, joint_uncertainty(rig)):
        both = np.hypot(told.sigma_noise, told.sigma_calibration)
        np.testing.assert_allclose(told.sigma, both, rtol=1e-12)
        assert told.valid
    assert [t.wall_range for t in expected_posture_errors(rig, RigUncertainty.none())] == [
        *USUAL_RANGES
    ]


def test_one_metre_of_offset_is_worth_what_geometry_says() -> None:
    """All sheets and the lens scaled alike scale the range: an error of scale is an error of 1."""
    rig = replace(example_rig(), housing=None)
    names = ["lens_x", "lens_y", "lens_z", *(f"{laser.name}:offset" for laser in rig.lasers)]
    lengths = [*rig.dome_from_cam.translation, *(laser.plane.offset for laser in rig.lasers)]
    error = 1e-3 * np.array(lengths)
    uncertainty = RigUncertainty(tuple(names), np.outer(error, error))
    for told in expected_posture_errors(rig, uncertainty):
        # Rays between the nodes of the lattice are good to 1e-4.
        np.testing.assert_allclose(
            told.sigma_calibration, [1e-3 * told.wall_range, 0.0, 0.0], rtol=1e-4, atol=1e-7
        )


def test_a_wall_reads_right_with_the_rig_that_saw_it() -> None:
    rig = example_rig()
    window = Window(Plane.from_normal([-0.3, 0.95, 0.1], 0.05), np.array([-0.15, 0.0, 0.0]))
    bent = replace(rig, lasers=(rig.lasers[0], replace(rig.lasers[1], window=window)))
    for one in (rig, bent):
        read = WallView.ahead(one, 0.6).measured_by(one)
        # Projection and its inverse agree to 1e-11 px; a bent sheet is met to 1e-12 m.
        np.testing.assert_allclose(read, [0.6, 0.0, 0.0], atol=1e-9)
    # The window matters, so that the test above has tested it: millimetres at this tilt.
    flat = WallView.ahead(bent, 0.6).measured_by(replace(rig, lasers=rig.lasers[:2]))
    assert abs(flat[0] - 0.6) > 1e-3


def test_stripes_that_determine_no_plane_say_so() -> None:
    rig = example_rig()
    for lasers in ((), rig.lasers[:1]):
        bad = replace(rig, lasers=lasers)
        (told,) = expected_posture_errors(bad, RigUncertainty.independent({"lens_y": 1e-4}), (0.6,))
        assert not told.valid
        assert np.isnan(told.sigma).all()
