"""The index estimator: what averages out and what does not, alarms, words, and what is refused."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from aqualvs.calibration.solver.bundle import moved_target
from aqualvs.calibration.targets.targets import View
from aqualvs.calibration.water_index.estimator import N_WATER, IndexEstimator, calibrate_water
from aqualvs.calibration.water_index.filter import MAX_POINTS, FrameCorners
from aqualvs.calibration.water_index.state import CusumTest, IndexOptions, IndexPrior, IndexReading
from aqualvs.errors import CalibrationError, OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.rig import Rig, RigUncertainty, rig_moved_by
from aqualvs.optics.water import seawater_index_vacuum
from aqualvs.simulation.scenarios import example_rig
from target_cases import index_target
from whole import WHOLE

FPS = 25.0
RIG = example_rig()
OPTIONS = IndexOptions()
MEASURED_WELL = IndexOptions(sigma_place=2e-5, sigma_turn=2e-4, sigma_corner_px=0.03)
CAMERA = RigUncertainty.independent(
    {
        "lens_x": 1e-4,
        "lens_y": 2e-4,
        "lens_z": 1e-4,
        "rotation_x": 3e-4,
        "rotation_y": 3e-4,
        "rotation_z": 3e-4,
        "n_acrylic": 1e-3,
        "fx": 0.3,
        "cx": 0.5,
        "k1": 1e-3,
        "left:offset": 1e-4,
    }
)


def plate() -> FloatArray:
    return index_target().points()


@dataclass
class Vehicle:
    """A rig and a plate that are not quite what they are said to be."""

    rng: np.random.Generator
    rig: Rig = RIG
    uncertainty: RigUncertainty = field(default_factory=RigUncertainty.none)
    options: IndexOptions = OPTIONS
    noise: float = 0.05
    points: FloatArray = field(default_factory=plate)

    def __post_init__(self) -> None:
        names = self.uncertainty.names
        # All covariances here are diagonal.
        self.errors = self.rng.normal(size=len(names)) * np.sqrt(
            np.diag(self.uncertainty.covariance)
        )
        self.true_rig = rig_moved_by(self.rig, names, self.errors)
        step = self.rng.normal(size=6) * self.options.pose_sigmas
        self.true_points = moved_target(SE3.identity(), self.points.mean(axis=0), step).apply(
            self.points
        )
        self.bias = self.rng.normal(size=(len(self.points), 2)) * self.options.sigma_corner_px

    def estimator(self, prior: IndexPrior | None = None) -> IndexEstimator:
        return IndexEstimator(
            self.rig, uncertainty=self.uncertainty, options=self.options, prior=prior
        )

    def sees(self, n: float) -> View:
        pixels, valid = self.true_rig.in_water(n).camera().project(self.true_points)
        assert valid.all()
        noise = self.noise * self.rng.normal(size=pixels.shape)
        return View("frame", np.arange(len(pixels)), self.points, pixels + self.bias + noise)

    def film(self, estimator: IndexEstimator, indices: Sequence[float]) -> list[IndexReading]:
        return [estimator.add(i / FPS, self.sees(n)) for i, n in enumerate(indices)]


def decentred(lens_mm: tuple[float, float, float]) -> Rig:
    pose = SE3(RIG.dome_from_cam.rotation, np.array(lens_mm) * 1e-3)
    return replace(RIG, dome_from_cam=pose)


def spread(errors: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def test_normalised_errors_of_many_vehicles() -> None:
    alone, with_prior, by_camera = [], [], []
    names = CAMERA.names
    for seed in range(200 if WHOLE else 40):
        vehicle = Vehicle(np.random.default_rng(seed), uncertainty=CAMERA)
        n = vehicle.rng.uniform(1.331, 1.345)
        prior = IndexPrior(n + 3e-3 * vehicle.rng.normal(), 3e-3)
        views = [vehicle.sees(n) for _ in range(3)]
        result = calibrate_water(RIG, views, uncertainty=CAMERA, prior=prior)
        last = result.readings[-1]
        alone.append((last.n_pictures - n) / last.sigma_pictures)
        with_prior.append((result.n - n) / result.sigma)
        # The stated joint covariance must foretell what a known error of the camera does to n.
        c = result.uncertainty.covariance[:-1, :-1]
        reach = np.linalg.solve(c, result.uncertainty.covariance[:-1, -1])
        left = result.uncertainty.covariance[-1, -1] - reach @ c @ reach
        by_camera.append((result.n - n + reach @ vehicle.errors) / np.sqrt(left))
        assert result.uncertainty.names == (*names, N_WATER)
    # 40 samples know a standard deviation to 11 %; the bar is 0.8 to 1.25.
    assert 0.8 < spread(alone) < 1.25
    assert 0.8 < spread(with_prior) < 1.25
    assert 0.8 < spread(by_camera) < 1.25


def test_begun_in_air_the_vehicle_knows_its_water_better() -> None:
    in_air, errors, sizes = [], [], []
    for seed in range(25 if WHOLE else 16):
        vehicle = Vehicle(np.random.default_rng(seed), options=OPTIONS)
        n = vehicle.rng.uniform(1.331, 1.345)
        estimator = vehicle.estimator(IndexPrior.air())
        vehicle.film(estimator, [1.0003] * 6)
        # The picture moves by many pixels, where the detector has other errors.
        vehicle.bias = vehicle.rng.normal(0.0, OPTIONS.sigma_corner_px, vehicle.bias.shape)
        last = [estimator.add(i / FPS, vehicle.sees(n)) for i in range(6, 14)][-1]
        assert len(estimator.steps) == 1
        step = estimator.steps[0]
        assert step.by_medium
        assert step.time == pytest.approx(6 / FPS, abs=1e-9)
        errors.append((last.n - n) / last.sigma)
        sizes.append((step.size - (n - 1.0003)) / step.sigma)
        in_air.append(last.sigma / last.sigma_pictures)
        assert last.observable
    # 16 samples know a standard deviation to 18 %.
    assert 0.65 < spread(errors) < 1.4
    assert 0.65 < spread(sizes) < 1.4
    assert np.median(in_air) < 0.5


def test_frames_average_out_noise_and_never_the_constants() -> None:
    """Derivatives taken anew for every frame would let sigma shrink by half here."""
    vehicle = Vehicle(np.random.default_rng(3), uncertainty=CAMERA)
    readings = vehicle.film(vehicle.estimator(), [1.34] * 60)
    first, last = readings[4], readings[-1]
    assert 0.95 * first.sigma < last.sigma < 1.01 * first.sigma
    # Down to where a random walk of 1e-5 a root second holds it, 0.8e-5 here.
    assert last.sigma_random < 0.5 * first.sigma_random
    assert last.sigma > 50 * last.sigma_random


@pytest.mark.parametrize(("start", "n"), [(1.36, 1.0003), (1.0003, 1.36), (1.3333, 1.2)])
def test_any_medium_is_found_from_any_start(start: float, n: float) -> None:
    vehicle = Vehicle(np.random.default_rng(4), rig=RIG.in_water(start), options=MEASURED_WELL)
    reading = vehicle.film(vehicle.estimator(), [n] * 3)[-1]
    assert reading
    assert abs(reading.n - n) < 3.0 * reading.sigma
    assert reading.sigma < 3e-4


@pytest.mark.parametrize("noise", [0.05, 0.4])
@pytest.mark.parametrize("size", [-0.0067, 0.001, 0.0067])
def test_a_step_is_found_within_two_seconds(size: float, noise: float) -> None:
    vehicle = Vehicle(np.random.default_rng(5), options=MEASURED_WELL, noise=noise)
    estimator = vehicle.estimator(IndexPrior(1.3333, 2e-4))
    readings = vehicle.film(estimator, [1.3333] * 30 + [1.3333 + size] * 50)
    rung = [i for i, reading in enumerate(readings) if reading.step is not None]
    assert len(rung) == 1
    assert rung[0] < 30 + 2.0 * FPS
    step = readings[rung[0]].step
    assert step is not None
    assert step.by_medium
    assert abs(step.size - size) < 3.0 * step.sigma
    assert step.sigma < 5e-4
    # A step as small as the noise of a frame is dated within a few frames.
    assert abs(step.time - 30 / FPS) <= 5 / FPS
    assert abs(readings[-1].n - 1.3333 - size) < 3.0 * readings[-1].sigma
    assert readings[-1].sigma < 4e-4


def test_a_frame_every_four_tenths_of_a_second_is_enough() -> None:
    vehicle = Vehicle(np.random.default_rng(6), options=MEASURED_WELL)
    estimator = vehicle.estimator()
    for i in range(10):
        estimator.add(0.4 * i, vehicle.sees(1.3333))
    rung = [i for i in range(10, 20) if estimator.add(0.4 * i, vehicle.sees(1.3400)).step]
    assert len(rung) == 1
    assert 0.4 * (rung[0] - 9) <= 2.0


def test_wrong_frames_ring_no_alarm() -> None:
    vehicle = Vehicle(np.random.default_rng(7), options=MEASURED_WELL)
    estimator = vehicle.estimator()
    readings = vehicle.film(estimator, [1.31 if i in (8, 20, 21) else 1.3333 for i in range(40)])
    assert not estimator.steps
    assert not readings[8]
    assert "next frames" in readings[8].refused
    assert readings[8].n_frame == pytest.approx(1.31, abs=1e-3)
    assert abs(readings[-1].n - 1.3333) < 3.0 * readings[-1].sigma


def test_a_plate_that_moves_is_no_other_water() -> None:
    for shift_mm, axis in ((0.05, 0), (0.05, 2), (1.0, 0)):
        vehicle = Vehicle(np.random.default_rng(8), options=MEASURED_WELL, noise=0.03)
        estimator = vehicle.estimator()
        vehicle.film(estimator, [1.34] * 20)
        vehicle.true_points = vehicle.true_points + shift_mm * 1e-3 * np.eye(3)[axis]
        last = [estimator.add(1.0 + i / FPS, vehicle.sees(1.34)) for i in range(20)][-1]
        assert not last.observable
        assert "moved" in " ".join(last.remarks)
        assert all(not step.by_medium for step in estimator.steps)


def test_a_slow_change_of_temperature_rings_no_alarm() -> None:
    """Half a degree a minute changes the index by 5e-5 a minute: here twenty times that."""
    vehicle = Vehicle(np.random.default_rng(9), options=MEASURED_WELL)
    estimator = vehicle.estimator()
    truth = 1.34 - 1e-3 / 60 / FPS * np.arange(300)
    readings = vehicle.film(estimator, truth.tolist())
    assert not estimator.steps
    apart = (readings[-1].n - truth[-1]) - (readings[20].n - truth[20])
    # The filter lags by about a second of drift, 1.7e-5, and knows changes to 1e-5.
    assert abs(apart) < 6e-5


def test_surprises_by_chance_ring_no_alarm_and_small_changes_do() -> None:
    rng = np.random.default_rng(10)
    test = CusumTest()
    assert not any(test.add(u) for u in rng.normal(size=200_000).tolist())
    assert test.inflation < 1.3
    began = [test.add(u) for u in rng.normal(1.0, 1.0, 100).tolist()]
    rung = int(np.flatnonzero(began)[0])
    # 20 / (1 - 0.5) frames on average.
    assert 20 <= rung < 80
    assert abs(began[rung] - 1 - rung) <= 12


def test_surprises_that_repeat_themselves_inflate_the_noise() -> None:
    rng = np.random.default_rng(11)
    test, last, n_alarms = CusumTest(), 0.0, 0
    for _ in range(5000):
        last = 0.8 * last + 0.6 * float(rng.normal())
        n_alarms += test.add(last / test.inflation) > 0
    # Blocks of twelve of such a sequence spread 2.5 times as much as they should.
    assert 1.8 < test.inflation < 3.2
    assert n_alarms <= 3


def test_a_lens_in_the_centre_sees_no_index_and_says_so() -> None:
    vehicle = Vehicle(np.random.default_rng(12), rig=decentred((0, 0, 0)), options=MEASURED_WELL)
    last = vehicle.film(vehicle.estimator(), [1.34] * 5)[-1]
    assert not last.observable
    assert last.sigma > 0.1
    assert "0.0 mm from the dome's centre" in last.remarks[0]
    prior = IndexPrior.seawater(15.0, 35.0)
    last = vehicle.film(vehicle.estimator(prior), [1.34] * 5)[-1]
    assert not last.observable
    assert last.n == pytest.approx(prior.n, abs=1e-9)
    assert last.sigma == pytest.approx(prior.sigma, rel=1e-3)


def test_what_is_unobservable_for_the_plates_sake_is_said_otherwise() -> None:
    vehicle = Vehicle(np.random.default_rng(13), rig=decentred((0.5, 6.0, 0.3)))
    last = vehicle.film(vehicle.estimator(), [1.34] * 3)[-1]
    assert not last.observable
    assert last.remarks[0].endswith(
        "measure them better, begin with pictures in air, or give --temperature-c and --salinity"
    )
    last = vehicle.film(vehicle.estimator(IndexPrior(1.34, 2e-4)), [1.34] * 3)[-1]
    assert not last.observable
    assert last.prior_used
    assert "changes are still detected" in last.remarks[0]


def test_a_prior_that_contradicts_is_left_out() -> None:
    vehicle = Vehicle(np.random.default_rng(14), options=MEASURED_WELL)
    estimator = vehicle.estimator(IndexPrior.air())
    last = vehicle.film(estimator, [1.34] * 5)[-1]
    assert not last.prior_used
    assert (last.n, last.sigma) == (last.n_pictures, last.sigma_pictures)
    assert any("the prior (air)" in remark for remark in last.remarks)


def test_bad_corners_and_hidden_ones_do_no_harm() -> None:
    vehicle = Vehicle(np.random.default_rng(15), options=MEASURED_WELL)
    estimator, rng = vehicle.estimator(), vehicle.rng
    for i in range(30):
        view = vehicle.sees(1.34)
        pixels = view.pixels.copy()
        pixels[rng.choice(24, 5, replace=False)] += rng.normal(0.0, 5.0, (5, 2))
        pixels[rng.choice(24, 3, replace=False)] = np.nan
        hidden = rng.random(24) < (0.4 if i % 2 else 0.0)
        reading = estimator.add(i / FPS, replace(view, pixels=pixels).where(~hidden))
        if reading:
            assert abs(reading.n - 1.34) < 4.0 * reading.sigma
    assert not estimator.steps
    assert reading.n_points < 22


def test_what_cannot_be_used_is_refused_with_its_reason() -> None:
    vehicle = Vehicle(np.random.default_rng(16), options=MEASURED_WELL)
    estimator = vehicle.estimator()
    blank = estimator.add(0.0, vehicle.sees(1.34).where(np.arange(24) < 3))
    assert not blank
    assert np.isnan(blank.n)
    assert np.isinf(blank.sigma)
    assert "3 corners" in blank.refused
    far_off = vehicle.sees(1.34)
    wrong = estimator.add(0.0, replace(far_off, pixels=far_off.pixels[::-1].copy()))
    assert "target.yaml" in wrong.refused
    assert estimator.add(1.0, vehicle.sees(1.34))
    assert "earlier frame" in estimator.add(0.5, vehicle.sees(1.34)).refused
    assert "no time" in estimator.add(float("nan"), vehicle.sees(1.34)).refused
    # A gap without frames is bridged, and what may have changed in it added.
    before = estimator.add(1.04, vehicle.sees(1.34))
    wandered = OPTIONS.drift * np.sqrt(600.0)
    lost = estimator.add(601.04, replace(far_off, pixels=far_off.pixels[::-1].copy()))
    assert not lost
    assert lost.sigma == pytest.approx(np.hypot(before.sigma, wandered), rel=1e-3)
    assert estimator.add(602.0, vehicle.sees(1.34)).sigma_random > before.sigma_random


def test_a_plate_that_stays_hidden_makes_the_index_unobservable() -> None:
    vehicle = Vehicle(np.random.default_rng(17), options=MEASURED_WELL)
    estimator = vehicle.estimator()
    first = vehicle.film(estimator, [1.34] * 5)[-1]
    assert first.observable
    view = vehicle.sees(1.34)
    scattered = [
        replace(view, pixels=view.pixels + vehicle.rng.normal(0.0, 40.0, view.pixels.shape))
        for _ in range(12)
    ]
    last = [estimator.add(1.0 + i / FPS, bad) for i, bad in enumerate(scattered)][-1]
    assert not last.observable
    assert "hidden" in last.remarks[-1]
    assert estimator.add(3.0, vehicle.sees(1.34)).observable


def test_corners_that_are_always_off_and_a_plate_elsewhere_are_named() -> None:
    vehicle = Vehicle(np.random.default_rng(18), options=MEASURED_WELL, noise=0.02)
    vehicle.bias = vehicle.rng.normal(0.0, 0.15, (24, 2))
    last = vehicle.film(vehicle.estimator(), [1.34] * 30)[-1]
    assert "corners are always off by 0." in last.remarks[-1]
    vehicle = Vehicle(np.random.default_rng(18), options=MEASURED_WELL, noise=0.02)
    middle = vehicle.points.mean(axis=0)
    step = np.array([0.0, np.deg2rad(0.3), 0.0, 0.0, 0.0, 0.0])
    vehicle.true_points = moved_target(SE3.identity(), middle, step).apply(vehicle.points)
    last = vehicle.film(vehicle.estimator(), [1.34] * 5)[-1]
    assert "where target.yaml has it" in last.remarks[-1]


def test_a_frame_takes_each_corner_once_and_not_too_many() -> None:
    n = 3 * MAX_POINTS
    view = View("many", np.arange(n), np.ones((n, 3)), np.ones((n, 2)))
    frame = FrameCorners.of(0.0, view, ())
    assert len(frame.ids) == MAX_POINTS
    assert max(frame.ids) == n - 1
    known = (5, 6, 7, *range(100, 161))
    assert FrameCorners.of(0.0, view, known).ids == known
    twice = View("twice", np.array([1, 1, 2]), np.ones((3, 3)), np.ones((3, 2)))
    assert FrameCorners.of(0.0, twice).ids == (1, 2)


def test_priors() -> None:
    prior = IndexPrior.seawater(15.0, 35.0)
    assert prior.n == pytest.approx(float(seawater_index_vacuum(15.0, 35.0)))
    by_temperature = float(seawater_index_vacuum(15.5, 35.0)) - prior.n
    by_salinity = float(seawater_index_vacuum(15.0, 35.5)) - prior.n
    by_colour = float(seawater_index_vacuum(15.0, 35.0, 537.0)) - prior.n
    parts = (by_temperature, by_salinity, by_colour, 1.5e-5)
    assert prior.sigma == pytest.approx(np.linalg.norm(parts), rel=0.02)
    with pytest.raises(OptionError, match="1 to 2"):
        IndexPrior(0.9, 1e-4)
    with pytest.raises(OptionError, match="positive"):
        IndexPrior(1.34, 0.0)
    with pytest.raises(OptionError, match="sigma_place"):
        IndexOptions(sigma_place=-1.0)


def test_sets_from_which_nothing_can_be_solved() -> None:
    vehicle = Vehicle(np.random.default_rng(19))
    with pytest.raises(CalibrationError, match="no pictures"):
        calibrate_water(RIG, [])
    few = vehicle.sees(1.34).where(np.arange(24) < 2)
    with pytest.raises(CalibrationError, match=r"none of 2 pictures.*2 corners"):
        calibrate_water(RIG, [few, few])
    with pytest.raises(CalibrationError, match="has no housing"):
        calibrate_water(replace(RIG, housing=None), [vehicle.sees(1.34)])
    with pytest.raises(CalibrationError, match="no picture"):
        vehicle.estimator().residuals(few)


def test_residuals_of_a_set_are_the_noise() -> None:
    vehicle = Vehicle(np.random.default_rng(20), options=MEASURED_WELL)
    views = [vehicle.sees(1.34) for _ in range(12)]
    result = calibrate_water(RIG, views, options=MEASURED_WELL)
    assert result.rms_px == pytest.approx(0.05, rel=0.2)
    assert result.rig.n_water == result.n
    assert result.observable
    estimator = vehicle.estimator()
    for view in views:
        estimator.add(0.0, view)
    assert estimator.residuals(views[3]).std() == pytest.approx(0.05, rel=0.3)
