"""The index of the water from a target on the vehicle: simulated corners, then real pictures."""

import json
from pathlib import Path

import numpy as np
import pytest

from aqualvs.calibration.targets.targets import View
from aqualvs.calibration.water_index.estimator import (
    IndexEstimator,
    WaterCalibration,
    calibrate_water,
)
from aqualvs.calibration.water_index.state import IndexOptions, IndexPrior
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.rig import Rig, RigUncertainty, rig_moved_by
from aqualvs.simulation.scenarios import example_rig, flat_port_rig
from rig_from_sample_truth import load_truth
from whole import WHOLE

FPS = 25.0


def sample_rig(folder: Path) -> Rig:
    return load_truth(folder / "truth" / "rig_truth.json")


def target_points() -> FloatArray:
    """Six tags of 12 mm, 25 cm ahead, as a user would mount them."""
    corners = []
    for x in (-0.055, -0.04, -0.025):
        for z in (-0.01, -0.025):
            for dx, dz in ((0, 0), (0.012, 0), (0.012, -0.012), (0, -0.012)):
                corners.append((x + dx, 0.254, z + dz))
    return np.array(corners)


def water(rig: Rig, shots: list[tuple[float, View]], **known: object) -> WaterCalibration:
    return calibrate_water(rig, [view for _, view in shots], [t for t, _ in shots], **known)


def seen(rig: Rig, points: FloatArray, n: float, noise: FloatArray, name: str = "frame") -> View:
    pixels, valid = rig.in_water(n).camera().project(points)
    assert valid.all()
    return View(name, np.arange(len(points)), points, pixels + noise)


LENS = {"lens_x": 5e-5, "lens_y": 7e-5, "lens_z": 5e-5, "fx": 0.05, "fy": 0.05}
PORT = {"port_distance": 3e-5, "port_tilt_x": 3e-5, "port_tilt_y": 3e-5, "fx": 0.05, "fy": 0.05}


@pytest.mark.parametrize(
    ("rig", "sigmas"), [(example_rig(), LENS), (flat_port_rig(), PORT)], ids=["dome", "flat"]
)
def test_normalised_errors_over_uncertain_rigs_and_places(
    rig: Rig, sigmas: dict[str, float]
) -> None:
    rng = np.random.default_rng(4)
    points, options = target_points(), IndexOptions()
    uncertainty = RigUncertainty.independent(sigmas)
    errors = []
    for _ in range(60 if WHOLE else 40):
        true = rig_moved_by(rig, tuple(sigmas), rng.normal(0.0, list(sigmas.values())))
        turn = rng.normal(0.0, options.sigma_turn, 3)
        shift = rng.normal(0.0, options.sigma_place, 3)
        middle = points.mean(axis=0)
        moved = SE3.from_rotvec(turn, shift).apply(points - middle) + middle
        n = rng.uniform(1.331, 1.345)
        bias = rng.normal(0.0, options.sigma_corner_px, (len(points), 2))
        shots = [
            (i / FPS, seen(true, moved, n, bias + rng.normal(0.0, 0.05, bias.shape)))
            for i in range(6 if WHOLE else 3)
        ]
        shots = [(t, View(v.name, v.ids, points, v.pixels)) for t, v in shots]
        last = water(rig, shots, uncertainty=uncertainty)
        errors.append((last.n - n) / last.sigma)
    # 40 samples know a standard deviation to 11 %; the bar is 0.8 to 1.25.
    assert 0.8 < np.std(errors) < 1.25
    assert abs(np.mean(errors)) < 0.35


def test_a_plate_behind_a_flat_port_gives_the_index() -> None:
    """A plate of 180 by 100 mm, 0.35 m ahead, 0.1 px of noise, the rig and the place exact."""
    rig, rng = flat_port_rig(), np.random.default_rng(8)
    x, z = np.meshgrid(np.linspace(-0.09, 0.09, 10), np.linspace(-0.05, 0.05, 6))
    points = np.stack([x, np.full_like(x, 0.35), z], axis=-1).reshape(-1, 3)
    for n in (1.3335, 1.3420):
        shots = [
            (i / FPS, seen(rig, points, n, rng.normal(0.0, 0.1, (len(points), 2))))
            for i in range(5)
        ]
        result = water(rig, shots)
        assert abs(result.n - n) < min(5e-4, 3.0 * result.sigma)


def test_air_is_found_from_a_rig_in_water() -> None:
    rng = np.random.default_rng(5)
    rig, points = example_rig(), target_points()
    shots = [
        (i / FPS, seen(rig, points, 1.0003, rng.normal(0.0, 0.02, (len(points), 2))))
        for i in range(20)
    ]
    result = water(rig, shots)
    assert abs(result.n - 1.0003) < 3 * result.sigma
    assert not result.steps


@pytest.mark.parametrize(("before", "after"), [(1.3333, 1.3400), (1.3400, 1.3333), (1.334, 1.336)])
def test_a_step_is_flagged_within_two_seconds_and_followed(before: float, after: float) -> None:
    rng = np.random.default_rng(6)
    rig, points = example_rig(), target_points()
    bias = rng.normal(0.0, 0.03, (len(points), 2))
    shots = [
        (
            i / FPS,
            seen(
                rig, points, before if i < 40 else after, bias + rng.normal(0.0, 0.05, bias.shape)
            ),
        )
        for i in range(90)
    ]
    result = water(rig, shots)
    assert len(result.steps) == 1
    step = result.steps[0]
    assert step.by_medium
    rung = next(reading.time for reading in result.readings if reading.step is not None)
    assert 1.6 <= rung <= 3.6
    # The size of a step is free of what is constant: only the noise of a few pictures is left.
    assert step.size == pytest.approx(after - before, abs=5e-4)
    assert abs(result.n - after) < 3 * result.sigma


def test_a_slow_drift_is_followed_without_alarm() -> None:
    rng = np.random.default_rng(7)
    rig, points = example_rig(), target_points()
    # Half a degree a minute is 5e-5 a minute; thirty times that for ten seconds.
    shots = [
        (i / FPS, seen(rig, points, 1.3350 - 1.5e-3 / 60 * i / FPS, rng.normal(0, 0.05, (24, 2))))
        for i in range(250)
    ]
    result = water(rig, shots)
    assert not result.steps
    # The drift itself is seen, whatever is constant: both ends are off alike.
    counted = [reading for reading in result.readings if reading]
    assert counted[-1].n - counted[30].n == pytest.approx(-2.2e-4, abs=1e-4)


def test_a_centred_lens_cannot_see_the_index() -> None:
    rig, points = example_rig(), target_points()
    at_centre = rig_moved_by(
        rig, ("lens_x", "lens_y", "lens_z"), -rig.dome_from_cam.translation + 1e-5
    )
    shots = [(i / FPS, seen(at_centre, points, 1.3333, np.zeros((24, 2)))) for i in range(5)]
    assert not water(at_centre, shots).observable
    prior = IndexPrior.seawater(15.0, 35.0, n_air=rig.n_air)
    result = water(at_centre, shots, prior=prior)
    assert not result.observable
    assert result.n == pytest.approx(prior.n, abs=prior.sigma)


def test_a_prior_that_contradicts_is_named_and_not_believed() -> None:
    rig, points = example_rig(), target_points()
    shots = [(i / FPS, seen(rig, points, 1.3333, np.zeros((24, 2)))) for i in range(5)]
    result = water(rig, shots, prior=IndexPrior(1.3600, 1e-4))
    assert result.n == pytest.approx(1.3333, abs=2e-3)
    assert not result.readings[-1].prior_used


def test_hidden_corners_late_pictures_and_nan_are_passed_over() -> None:
    rng = np.random.default_rng(9)
    rig, points = example_rig(), target_points()
    estimator = IndexEstimator(rig)
    good = [seen(rig, points, 1.3333, rng.normal(0, 0.03, (24, 2))) for _ in range(20)]
    for i, view in enumerate(good):
        pixels = view.pixels.copy()
        pixels[i % 24] += 30.0
        pixels[(i + 7) % 24] = np.nan
        half = np.arange(24) % 2 == i % 2 if i > 10 else np.ones(24, np.bool_)
        reading = estimator.add(i / FPS, View(view.name, view.ids, points, pixels).where(half))
        assert reading
        assert abs(reading.n - 1.3333) < 1e-3
    assert not estimator.add(0.1, good[0])
    few = good[0].where(np.arange(24) < 2)
    assert not estimator.add(5.0, few)


@pytest.mark.samples
# Those of the least and of the greatest index; clip 3, by the command: calibration/test_samples.py.
@pytest.mark.parametrize("clip", range(5) if WHOLE else (1, 4))
def test_samples_within_a_thousandth(samples: Path, clip: int) -> None:
    import cv2

    from aqualvs.calibration.detection.detection import detect_markers
    from aqualvs.calibration.targets.target_files import load_target

    folder = samples / "lab-paper"
    markers = load_target(folder / "index" / "target.yaml")
    truth = json.loads((folder / "truth" / "index.json").read_text())[clip]
    pictures = sorted((folder / "index" / truth["clip"]).glob("*.png"))
    shots = []
    for i, path in enumerate(pictures if WHOLE else pictures[:8]):
        view = detect_markers(cv2.imread(str(path), 0), markers, path.name)
        assert isinstance(view, View)
        shots.append((i / FPS, view))
    last = water(sample_rig(folder), shots)
    assert abs(last.n - truth["n_outside"]) < 1e-3
    assert abs(last.n - truth["n_outside"]) < 3 * last.sigma
