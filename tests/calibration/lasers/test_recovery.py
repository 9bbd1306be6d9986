"""Lasers: simulated calibrations against their promised uncertainty, samples against truth."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from aqualvs.calibrate.uncalibrated_stripes import find_stripes
from aqualvs.calibration.detection.detection import detect_markers
from aqualvs.calibration.lasers.calibrate import LaserOptions, calibrate_lasers
from aqualvs.calibration.lasers.stripes_on_planes import board_surface, box_surfaces
from aqualvs.calibration.lasers.views import LaserView
from aqualvs.calibration.targets.target_files import load_box
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.rig import LASER_PARAMETERS, Rig, RigUncertainty, rig_moved_by, tangent_basis
from aqualvs.simulation.scenarios import example_rig
from laser_cases import (
    Noise,
    board_views,
    box,
    box_views,
    camera_uncertainty,
    laser_error,
    without_lasers,
)
from rig_from_sample_truth import load_truth
from whole import WHOLE

BIAS_PX = 0.03


def whitened(found: Rig, true: Rig, uncertainty: RigUncertainty, held: FloatArray) -> FloatArray:
    """Errors of camera and lasers together, in standard deviations, made independent.

    `held` (C,) are the errors of the camera's numbers, where they were held.
    """
    errors = list(held)
    names = list(camera_uncertainty().names)
    for a, b in zip(found.lasers, true.lasers, strict=True):
        errors += (tangent_basis(a.plane.normal) @ b.plane.normal).tolist()
        errors.append(b.plane.offset - a.plane.offset)
        names += [f"{a.name}:{name}" for name in LASER_PARAMETERS]
    covariance = uncertainty.of(names)
    size = np.sqrt(np.diag(covariance))
    lower = np.linalg.cholesky(covariance / np.outer(size, size))
    independent: FloatArray = np.linalg.solve(lower, np.array(errors) / size)
    return independent


@pytest.mark.parametrize("target", ["box", "board"])
def test_errors_are_as_large_as_promised(target: str) -> None:
    """Cameras drawn from their covariance, noisy corners and stripes, stripes with a bias."""
    given, nominal = camera_uncertainty(), example_rig()
    lower = np.linalg.cholesky(given.covariance)
    surfaces = box() if target == "box" else board_surface()
    scores = []
    for k in range(30 if WHOLE else 8):
        rng = np.random.default_rng(1000 + k)
        camera_error = lower @ rng.standard_normal(len(given.names))
        true = rig_moved_by(nominal, given.names, camera_error)
        bias = BIAS_PX * rng.standard_normal((3, len(surfaces.planes)))
        noise = Noise(corner_px=0.1, stripe_px=0.1, bias_px=bias, correlation=0.3)
        make = box_views if target == "box" else board_views
        views = make(true, noise=noise, seed=k, spacing=0.006)
        result = calibrate_lasers(
            nominal,
            views,
            surfaces,
            uncertainty=given,
            options=LaserOptions(stripe_bias_px=BIAS_PX),
        )
        scores.append(whitened(result.rig, true, result.uncertainty, camera_error))
    lasers = np.array(scores)[:, len(given.names) :]
    # Nine values of each: independent, the standard deviation of 72 is known to 8 %.
    allowed = 3.5 / np.sqrt(2.0 * lasers.size)
    assert 1.0 - allowed < lasers.std() < 1.0 + allowed
    assert np.abs(lasers).max() < 4.5


def true_rig(folder: Path) -> Rig:
    return load_truth(folder / "truth" / "rig_truth.json")


@pytest.mark.samples
# In water, by the command: calibration/test_samples.py.
@pytest.mark.parametrize("folder", ["box", "box_water"] if WHOLE else ["box"])
def test_lasers_of_the_sample_box(folder: str, samples: Path) -> None:
    rig = true_rig(samples / "lab-paper")
    markers, n_medium = load_box(samples / "lab-paper" / folder / "box.yaml")
    views, n_views = [], 6 if WHOLE else 4
    for path in sorted((samples / "lab-paper" / folder).glob("*.png"))[:n_views]:
        image = cv2.imread(str(path))
        assert image is not None
        view = detect_markers(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), markers, path.name)
        assert view, str(view)
        views.append(LaserView(view, find_stripes(image)))
    assert len(views) == n_views
    options = LaserOptions(n_lasers=3, n_medium=n_medium if folder == "box" else None)
    surfaces = box_surfaces(markers.planes, markers.points())
    result = calibrate_lasers(without_lasers(rig), views, surfaces, options=options)
    assert [f.laser.name for f in result.lasers] == ["horizontal", "vertical", "diagonal"]
    # Faint reflections on the box's sides are found too, and named in one note.
    assert len(result.warnings) <= 1
    for figures, laser in zip(result.lasers, rig.lasers, strict=True):
        angle, offset = laser_error(figures.laser.plane, laser.plane)
        assert np.rad2deg(angle) < 0.05
        assert abs(offset) < 0.3e-3
        assert angle < 3.0 * figures.sigma_normal
        assert abs(offset) < 3.0 * figures.sigma_offset
