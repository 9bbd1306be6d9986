"""Predicted errors of a design: Monte Carlo through the scanner's own fit, closed forms, laws."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.design.judge import predict, score
from aqualvs.design.settings import (
    Design,
    Mount,
    Noise,
    Tolerances,
    index_step,
    mount_of_laser,
    ring,
)
from aqualvs.design.stripes import see_stripes
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.camera import parameter_names
from aqualvs.optics.lens import Lens
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Laser, Rig, rig_moved_by
from aqualvs.scanning.laser_bands import SearchAxis, plan_bands
from aqualvs.scanning.plane_fit import SharedError, fit_robust
from aqualvs.scanning.posture import range_pitch_yaw
from aqualvs.scanning.triangulate import Triangulator
from aqualvs.simulation.scenarios import example_rig
from scanning_cases import everywhere, lit_stripe

WIDE = math.radians(160.0)
POINT_ONLY = Noise(point=0.1, strand=0.1, shared=0.0, twine=0.0)


NO_TOLERANCES = Tolerances(
    lens=0.0, rotation=0.0, focal=0.0, dome=0.0, n_water=0.0, laser_angle=0.0, laser_offset=0.0
)


def as_design(rig: Rig, **changes) -> Design:
    mounts = tuple(mount_of_laser(laser, rig, WIDE) for laser in rig.lasers)
    return replace(Design(rig=rig, mounts=mounts), **changes)


def pinhole(width: int = 1000, focal: float = 700.0, **changes) -> Rig:
    """A bare lens in the origin without distortion."""
    middle = (width - 1) / 2.0
    rig = Rig(
        name="pinhole",
        size_px=(width, width),
        lens=Lens(fx=focal, fy=focal, cx=middle, cy=middle),
        dome_from_cam=SE3(DOME_FROM_CAM_NOMINAL, np.zeros(3)),
        housing=None,
        n_air=1.0,
        n_water=1.0,
        lasers=(),
        working_range=(0.4, 1.0),
    )
    return replace(rig, **changes)


def pair(baseline: float, **changes) -> Design:
    """Level lasers above and below a pinhole, parallel to its view."""
    mounts = tuple(
        Mount(name=name, position=(0.0, 0.0, z), stripe=0.0, tilt=0.0, fan=WIDE)
        for name, z in (("upper", baseline), ("lower", -baseline))
    )
    return replace(Design(rig=pinhole(), mounts=mounts, noise=POINT_ONLY), **changes)


class Wall:
    """All stripes of a rig on a wall ahead: exact pixels, and what a rig makes of noisy ones."""

    def __init__(self, rig: Rig, wall_range: float) -> None:
        camera = rig.camera()
        laser_bands = plan_bands(rig, camera)
        wall = Plane(np.array([0.0, 1.0, 0.0]), wall_range)
        pixels, along_x, laser, place = [], [], [], []
        for i, (one, search) in enumerate(zip(rig.lasers, laser_bands, strict=True)):
            line, position = lit_stripe(rig, search, one.plane, wall, everywhere)
            is_row = search.axis is SearchAxis.ALONG_X
            pixels.append(np.stack([position, line] if is_row else [line, position], axis=-1))
            along_x += [is_row] * len(line)
            laser += [i] * len(line)
            n_lines = camera.size_px[1 if is_row else 0]
            place.append(2.0 * line / (n_lines - 1) - 1.0)
        self.pixels = np.concatenate(pixels).astype(np.float64)
        self.along_x = np.array(along_x, np.int64)
        self.laser, self.place = np.array(laser, np.int64), np.concatenate(place)
        self.start = np.array([0.0, 1.0 / wall_range, 0.0])

    def read(self, rig: Rig, shift: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points, and their sensitivities, of the pixels moved along their search lines."""
        moved = self.pixels.copy()
        moved[np.arange(len(moved)), 1 - self.along_x] += shift
        group = np.arange(len(moved))
        found = Triangulator(rig, rig.camera()).triangulate(moved, self.along_x, self.laser, group)
        return found.points_in_dome, found.sensitivity


@pytest.mark.parametrize("wall_range", [0.4, 0.9])
def test_noise_is_that_of_a_monte_carlo_through_the_scanners_fit(wall_range):
    rig, rng = example_rig(), np.random.default_rng(3)
    noise = Noise(point=0.3, shared=0.04)
    told = predict(as_design(rig, noise=noise), [wall_range])
    wall = Wall(rig, wall_range)
    found, stated, n_lasers = [], [], len(rig.lasers)
    n = len(wall.pixels)
    own = SharedError(np.full(n, noise.shared), np.empty((0, n)))
    for _ in range(500):
        shared = rng.normal(0.0, noise.shared, n_lasers)[wall.laser]
        shared += rng.normal(0.0, noise.shared, n_lasers)[wall.laser] * wall.place
        points, slope = wall.read(rig, shared + rng.normal(0.0, noise.point, len(shared)))
        sigma = np.full(len(points), noise.point)
        fit = fit_robust(points, slope, sigma, wall.laser, wall.place, wall.start, own)
        assert fit is not None
        found.append(range_pitch_yaw(fit.m))
        stated.append(fit.covariance[1, 1])
    # A standard deviation from 500 trials is known to 3.2 %, three times that; and the biweight
    # of the robust fit costs 2.5 %.
    np.testing.assert_allclose(np.std(found, axis=0), told.wall[0], rtol=0.12)
    # What the fit itself says of the range, -range² dm_y. A frame judges what its stripes share by
    # three numbers, so that this differs from frame to frame.
    sigma_range = wall_range**2 * np.sqrt(np.median(stated))
    np.testing.assert_allclose(told.wall[0, 0], sigma_range, rtol=0.2)


def test_tolerances_are_what_moved_rigs_read():
    """Each number of the rig is moved by its sigma, and the same pixels read and fitted again."""
    rig, wall_range = example_rig(), 0.6
    design = as_design(rig)
    told, wall, sizes = predict(design, [wall_range]), Wall(rig, wall_range), design.tolerances
    _, slope = wall.read(rig, np.zeros(len(wall.pixels)))
    # The weights of the fit at a wall square ahead.
    weight = 1.0 / np.abs(slope[:, 1])

    def moved_to(names, steps) -> FloatArray:
        moved, _ = wall.read(rig_moved_by(rig, names, np.array(steps)), np.zeros(len(weight)))
        m = np.linalg.lstsq(moved * weight[:, None], weight)[0]
        return np.array(range_pitch_yaw(m)) - [wall_range, 0.0, 0.0]

    step = index_step(rig.camera(), sizes)
    expected = {"water index": moved_to(parameter_names(rig.camera()), step[:, 0]) ** 2}
    for laser in rig.lasers:
        for name, size, cause in (
            ("tilt_1", sizes.laser_angle, "laser angles"),
            ("tilt_2", sizes.laser_angle, "laser angles"),
            ("offset", sizes.laser_offset, "laser offsets"),
        ):
            error = moved_to([f"{laser.name}:{name}"], [size])
            expected[cause] = expected.get(cause, np.zeros(3)) + error**2
    assert set(told.systematic) == set(expected)
    for cause, variance in expected.items():
        # Points sit on whole search lines here, and the steps are not infinitely small.
        floor = 2e-3 * told.systematic_total[0]
        difference = np.abs(told.systematic[cause][0] - np.sqrt(variance))
        assert np.all(difference < 0.02 * np.sqrt(variance) + floor), cause


def test_the_water_does_not_matter_to_a_bare_lens():
    told = predict(as_design(replace(example_rig(), housing=None)), [0.5])
    np.testing.assert_array_equal(told.systematic["water index"], 0.0)


def test_a_pair_of_lasers_has_a_closed_form():
    """Two level stripes of N points: range² sigma / (f B sqrt(2 N))."""
    for wall_range in (0.4, 0.7):
        told = predict(pair(0.1), [wall_range])
        n = told.stripes.lines[0, 0]
        # The picture's width less nothing: both borders are met to a hundredth of a pixel.
        assert n == pytest.approx(1000.0, abs=0.01)
        expected = wall_range**2 * 0.1 / (700.0 * 0.1 * math.sqrt(2.0 * n))
        # Points far from the axis weigh as those on it: exact, but for the ends found.
        assert told.wall[0, 0] == pytest.approx(expected, rel=1e-5)


def test_the_shift_of_light_on_twine_is_a_length_on_the_target():
    """Each stripe as far from the lens tells a wrong range alike: range e / B, whatever f is."""
    twine_only = replace(POINT_ONLY, point=1e-9, strand=1e-9, twine=0.02, stripe=4e-3)
    beside = tuple(
        Mount(name=name, position=(x, 0.0, 0.0), stripe=math.pi / 2, tilt=0.0, fan=WIDE)
        for name, x in (("left", -0.1), ("right", 0.1))
    )
    for rig in (pinhole(), pinhole(width=500, focal=350.0)):
        two = pair(0.1, noise=twine_only, rig=rig)
        for design in (two, two.with_mounts([*two.mounts, *beside])):
            told = predict(design, [0.4, 0.7])
            # All strands share it, and as much again those of one laser, which averages away.
            all_share = np.array([0.4, 0.7]) * 0.02 * 4e-3 / 0.1
            expected = all_share * math.sqrt(1.0 + 1.0 / len(design.mounts))
            np.testing.assert_allclose(told.net[:, 0], expected, rtol=1e-5)
            # A wall has no twine.
            assert np.all(told.wall < 1e-8)


def test_the_scores_error_counts_the_shift_of_light_on_twine():
    design = pair(0.1, tolerances=NO_TOLERANCES)
    wider = replace(design, noise=replace(design.noise, twine=0.02))
    squares = score(wider).error ** 2 - score(design).error ** 2
    more = predict(wider).net ** 2 - predict(design).net ** 2
    goals = np.full(more.shape, design.goals.angle)
    goals[:, 0] = design.ranges * design.goals.range_share
    # On the net alone: one of two targets.
    assert squares == pytest.approx(0.5 * np.mean(more / goals**2), rel=1e-6)
    assert squares > 0.0


@settings(max_examples=25)
@given(grow=st.floats(1.05, 2.0), wall_range=st.floats(0.4, 0.9), focal=st.floats(400.0, 900.0))
def test_range_error_falls_with_the_baseline_and_grows_with_the_square_of_range(
    grow, wall_range, focal
):
    rig = pinhole(focal=focal)
    near, wide = pair(0.08, rig=rig), pair(0.08 * grow, rig=rig)
    far = min(wall_range * grow, 1.2)
    told, at = predict(near, [wall_range, far]), predict(wide, [wall_range])
    same = told.stripes.lines.min() > 0 and at.stripes.lines.min() > 0
    assert same
    assert told.wall[0, 0] / at.wall[0, 0] == pytest.approx(grow, rel=1e-4)
    assert told.wall[1, 0] / told.wall[0, 0] == pytest.approx((far / wall_range) ** 2, rel=1e-4)
    # What the calibration leaves open of the lasers' angles grows alike.
    angles = told.systematic["laser angles"][:, 0]
    assert angles[1] >= angles[0] * (far / wall_range) ** 1.5


@settings(max_examples=25)
@given(share=st.floats(1.1, 3.0))
def test_finer_pixels_help_points_more_than_what_a_stripe_shares(share):
    """f and N grow alike: point noise falls with the power 3/2, a shift with 1."""
    finer = pinhole(width=round(1000 * share), focal=0.7 * round(1000 * share))
    grown = finer.size_px[0] / 1000.0
    # Search lines of two pixels, from 1280 on, halve the points.
    lines = 1.0 if finer.size_px[0] < 1280 else 0.5
    shift = Noise(point=1e-9, shared=0.05)
    for noise, power, fewer in ((POINT_ONLY, 1.5, lines), (shift, 1.0, 1.0)):
        now = predict(pair(0.1, noise=noise), [0.6]).wall[0, 0]
        then = predict(pair(0.1, noise=noise, rig=finer), [0.6]).wall[0, 0]
        assert now / then == pytest.approx(grown**power * math.sqrt(fewer), rel=2e-3)


@settings(max_examples=25)
@given(
    round_axis=st.floats(0.0, math.tau),
    baseline=st.floats(0.05, 0.2),
    tilt=st.floats(-0.1, 0.4),
    stripe=st.floats(0.0, 3.1),
)
def test_one_more_laser_never_hurts_independent_noise(round_axis, baseline, tilt, stripe):
    design = as_design(example_rig(), noise=POINT_ONLY)
    place = (baseline * math.cos(round_axis), 0.0, baseline * math.sin(round_axis))
    extra = Mount(name="extra", position=place, stripe=stripe, tilt=tilt, fan=1.2)
    more = predict(design.with_mounts([*design.mounts, extra]), [0.35, 0.6, 1.0])
    before = predict(design, [0.35, 0.6, 1.0])
    assert np.all(more.wall <= before.wall * (1.0 + 1e-9))
    assert np.all(more.net <= before.net * (1.0 + 1e-9))


def test_a_net_tells_less_than_a_wall_and_less_the_wider_its_meshes():
    design = as_design(example_rig())
    told = predict(design, [0.4, 0.8])
    wider = predict(replace(design, net=replace(design.net, bar=2 * design.net.bar)), [0.4, 0.8])
    assert np.all(told.net > told.wall)
    assert np.all(wider.net > told.net)
    np.testing.assert_allclose(wider.strands, told.strands / 2.0)


def test_what_is_not_seen_is_not_predicted():
    design = as_design(example_rig())
    one = design.with_mounts(design.mounts[:1])
    told = predict(one, [0.5])
    assert told.visible.all()
    assert not told.valid.any()
    assert np.isnan(told.wall).all()
    away = replace(design.mounts[0], tilt=math.radians(-60.0))
    told = predict(design.with_mounts([away]), [0.5])
    assert not told.visible.any()
    assert told.stripes.lines[0, 0] == 0.0


def test_stripes_end_at_the_border_or_at_the_end_of_the_fan():
    rig = example_rig()
    mounts = [mount_of_laser(rig.lasers[0], rig, fan) for fan in (WIDE, math.radians(20.0))]
    camera = rig.camera()
    seen = see_stripes(camera, mounts, np.array([0.5]), index_step(camera, Tolerances()))
    for i, mount in enumerate(mounts):
        points = seen.centre[i, 0] + seen.ends[i, 0][:, None] * seen.along[i]
        pixels, _ = camera.project(points)
        if mount.fan == WIDE:
            # Left and right border; the border is interpolated between points of 30 px apart.
            np.testing.assert_allclose(pixels[:, 0], [-0.5, 719.5], atol=0.2)
        else:
            way = points - mount.position
            angle = np.arctan2(way @ mount.axes[0], way @ mount.axes[2])
            np.testing.assert_allclose(angle, np.deg2rad([-10.0, 10.0]), atol=1e-12)


def test_crossings_are_where_two_stripes_meet_in_the_picture():
    rig = example_rig()
    design = as_design(rig)
    walls = np.linspace(0.3, 1.0, 15)
    told, camera = predict(design, walls), rig.camera()
    for i, j in ((0, 1), (0, 2), (1, 2)):
        planes = rig.lasers[i].plane, rig.lasers[j].plane
        for k, wall in enumerate(walls):
            rows = np.array([*(plane.normal for plane in planes), [0.0, 1.0, 0.0]])
            point = np.linalg.solve(rows, [planes[0].offset, planes[1].offset, wall])
            pixel, valid = camera.project(point)
            inside = bool(valid and camera.inside_image(pixel))
            assert told.crossing[i, j, k] == told.crossing[j, i, k] == inside
    assert told.crossing.any()
    assert not told.crossing.all(axis=-1)[~np.eye(3, dtype=bool)].all()


def test_stripes_cross_only_where_both_fans_reach():
    """A level and an upright stripe, each aside; narrow fans end before they would meet."""
    narrow, wide = math.radians(10.0), math.radians(100.0)
    for fan_lower, fan_left, met in (
        (wide, wide, True),
        (narrow, wide, False),
        (wide, narrow, False),
        (narrow, narrow, False),
    ):
        lower = Mount(name="lower", position=(0.0, 0.0, -0.2), stripe=0.0, tilt=0.0, fan=fan_lower)
        left = Mount(
            name="left", position=(-0.2, 0.0, 0.0), stripe=math.pi / 2, tilt=0.0, fan=fan_left
        )
        design = Design(rig=pinhole(), mounts=(lower, left))
        # 0.2 m to the side is 14 degrees, which 5 to each side of the beam do not reach.
        assert predict(design, [0.8]).crossing[0, 1, 0] == met


@settings(max_examples=25)
@given(
    normal=st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda n: math.hypot(n[0], n[2]) > 0.3),
    offset=st.floats(-0.2, 0.2),
)
def test_a_lasers_mount_has_its_plane(normal, offset):
    plane = Plane.from_normal(normal, offset * math.hypot(*normal))
    mount = mount_of_laser(Laser("one", plane), example_rig(), WIDE)
    turned = math.copysign(1.0, float(mount.plane.normal @ plane.normal))
    # Rounding of a few operations on unit vectors and lengths below a metre.
    np.testing.assert_allclose(turned * mount.plane.normal, plane.normal, atol=1e-12)
    assert turned * mount.plane.offset == pytest.approx(plane.offset, abs=1e-12)


@pytest.mark.parametrize("count", range(1, 9))
def test_lasers_round_the_dome_have_names_of_their_own_and_their_whole_baseline(count):
    mounts = ring(count, 0.15, 0.02, 1.0)
    assert len({mount.name for mount in mounts}) == count
    for mount in mounts:
        assert mount.baseline == pytest.approx(0.15)
        assert mount.position[1] == -0.02
    # The sheet leans towards the axis where the tilt is positive.
    leaning = replace(mounts[0], tilt=0.3)
    assert leaning.plane.signed_distance(np.array([0.0, 0.0, 0.0])) != 0.0
    crossing = leaning.position[1] + leaning.baseline / math.tan(0.3)
    assert leaning.plane.signed_distance(np.array([0.0, crossing, 0.0])) == pytest.approx(0.0)
