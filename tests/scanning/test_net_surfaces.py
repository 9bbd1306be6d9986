"""Nets that leave their plane: strands that are followed, planes that are joined, doubt."""

import numpy as np
import pytest

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.scanning.candidates import Candidates, Subsegments
from aqualvs.scanning.net_surfaces import (
    fit_mean_plane,
    inflate_covariance,
    is_continuation,
    merged_plane,
    seen_through,
    share_near,
)
from aqualvs.scanning.patch import packed_plane
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.region_growing import grow_region

RANGE = 0.6
M_PER_LINE = 0.7e-3
PERIOD = 36
LINES = 5
FLAT = Plane(np.array([0.0, 1.0, 0.0]), RANGE)


class Stripes:
    """Strands every 25 mm along three stripes, of five readings each, at heights over a plane."""

    def __init__(self, height: FloatArray) -> None:
        n_lasers, n_strands = height.shape
        strand = np.repeat(np.arange(n_lasers * n_strands), LINES)
        self.laser = strand // n_strands
        self.line = (strand % n_strands) * PERIOD + np.tile(np.arange(LINES), height.size)
        self.height = height.ravel()[strand]
        self.component = strand
        self.source = np.arange(len(strand))
        self.confidence = np.full(len(strand), 0.8)
        x = (self.line - self.line.mean()) * M_PER_LINE
        self.points = np.stack([x, RANGE + self.height, 0.1 * self.laser], axis=-1)

    def followed(self, on_net: BoolArray) -> BoolArray:
        """Which strands are on the net in the end, shape of the heights."""
        marked = on_net.ravel()[self.component]
        n = len(marked)
        candidates = Candidates(
            self.source,
            self.laser,
            self.line,
            self.component,
            subsegment=self.component,
            pixels=np.zeros((n, 2)),
            height=np.zeros(n),
            width=np.zeros(n),
            sigma_px=np.zeros(n),
            confidence=self.confidence,
            pull=np.zeros(n),
            points=self.points,
            sensitivity=np.zeros((n, 3)),
        )
        grow_region(candidates, self.height, RANGE, M_PER_LINE, marked)
        return marked[::LINES].reshape(on_net.shape)


def fold(steps: list[float]) -> FloatArray:
    """Heights of 20 strands on three lasers; a fold begins at the eighth strand."""
    height = np.zeros((3, 20))
    height[:, 8 : 8 + len(steps)] = steps
    return height


def test_a_fold_is_followed_up_and_down() -> None:
    height = fold([-0.015, -0.03, -0.015])
    assert Stripes(height).followed(height == 0.0).all()


def test_a_flank_that_leaves_the_picture_is_followed() -> None:
    height = np.zeros((3, 20))
    height[:, 15:] = np.cumsum(np.full(5, 0.015))
    assert Stripes(height).followed(height == 0.0).all()


def test_a_cliff_is_not_followed() -> None:
    height = fold([-0.08, -0.08, -0.08])
    np.testing.assert_array_equal(Stripes(height).followed(height == 0.0), height == 0.0)


def test_a_few_strands_are_no_fold() -> None:
    height = np.zeros((3, 20))
    height[0, 8:11] = [-0.015, -0.03, -0.015]
    np.testing.assert_array_equal(Stripes(height).followed(height == 0.0), height == 0.0)


def test_light_between_strands_that_follow_one_another_is_none_of_the_net() -> None:
    height = fold([-0.015, -0.03, -0.015])
    stripes = Stripes(np.concatenate([height, np.zeros((3, 20))], axis=1))
    # The second half are strands of the plane on the lines of the fold: nothing is missing there.
    stripes.line = stripes.line % (20 * PERIOD)
    on_net = stripes.height[::LINES].reshape(3, 40) == 0.0
    np.testing.assert_array_equal(stripes.followed(on_net), on_net)


def test_dim_light_is_not_followed() -> None:
    height = fold([-0.015, -0.03, -0.015])
    stripes = Stripes(height)
    stripes.confidence[stripes.height < 0.0] = 0.3
    np.testing.assert_array_equal(stripes.followed(height == 0.0), height == 0.0)


def test_of_several_readings_of_one_return_the_nearest_to_the_net_is_kept() -> None:
    height = fold([-0.015, -0.03, -0.015])
    height[2, 8:11] = [-0.02, -0.036, -0.02]
    stripes = Stripes(height)
    # The third laser's light in the fold is the first one's, read once more.
    first, third = (np.flatnonzero((stripes.laser == k) & (stripes.height < 0.0)) for k in (0, 2))
    stripes.source[third] = stripes.source[first]
    found = stripes.followed(height == 0.0)
    assert found[:2].all()
    assert not found[2, 8:11].any()


def subsegments_on(laser: IntArray, line: IntArray, points: FloatArray) -> Subsegments:
    table = np.zeros((7, len(laser)))
    table[:3] = points.T
    table[6] = 5.0
    n, light = len(laser), np.full(len(laser), 5.0)
    width, n_lines = np.full(n, 4.0), np.full(n, 5)
    return Subsegments(np.arange(n), table, light, width, n_lines, line, line + 4, laser)


def two_surfaces(second: BoolArray, height: FloatArray) -> Subsegments:
    """Chunks of three lasers, 24 each, those of the second surface at a height over the first."""
    laser = np.repeat([0, 1, 2], 24)
    line = np.tile(np.arange(24) * PERIOD, 3)
    x = (line - 400.0) * M_PER_LINE
    points = np.stack([x, RANGE + np.where(second, height, 0.0), 0.1 * laser - 0.1], axis=-1)
    return subsegments_on(laser, line, points)


def test_flanks_side_by_side_are_one_net() -> None:
    second = np.tile(np.arange(24) >= 14, 3)
    height = 0.8 * (np.tile(np.arange(24), 3) - 13) * PERIOD * M_PER_LINE
    subsegments = two_surfaces(second, height)
    assert is_continuation(FLAT, ~second, second, subsegments)
    assert not seen_through(~second, second, subsegments)


def test_a_net_that_hangs_beside_and_behind_is_another() -> None:
    second = np.tile(np.arange(24) >= 14, 3)
    assert not is_continuation(FLAT, ~second, second, two_surfaces(second, np.full(72, 0.15)))


def test_what_takes_turns_is_seen_through() -> None:
    second = np.tile(np.arange(24) % 2 == 1, 3)
    subsegments = two_surfaces(second, np.full(72, 0.3))
    assert seen_through(~second, second, subsegments)
    assert not is_continuation(FLAT, ~second, second, subsegments)


def test_two_turns_are_not_enough_to_see_through() -> None:
    second = np.zeros(72, np.bool_)
    second[30] = True
    assert not seen_through(~second, second, two_surfaces(second, np.full(72, 0.3)))


def test_the_main_piece_gives_the_plane_and_else_their_mean() -> None:
    second = np.tile(np.arange(24) >= 14, 3)
    subsegments = two_surfaces(second, np.full(72, 0.02))
    other = Plane(FLAT.normal, RANGE + 0.02)
    assert merged_plane([FLAT, other], [~second, second], subsegments) is FLAT
    even = np.tile(np.arange(24) % 2 == 0, 3)
    subsegments = two_surfaces(even, np.full(72, 0.02))
    mean = merged_plane([FLAT, other], [~even, even], subsegments)
    assert mean.offset == pytest.approx(RANGE + 0.01, abs=1e-3)


def wavy(n: int = 60) -> FloatArray:
    x, z = np.random.default_rng(4).uniform(-0.2, 0.2, (2, n))
    return np.stack([x, RANGE + 0.01 * np.sign(np.sin(40.0 * x)), z], axis=-1)


def in_turn(n: int) -> IntArray:
    """Return lasers of strands, each of three in turn."""
    return np.arange(n) % 3


def test_the_mean_plane_of_folds_is_as_uncertain_as_they_are_few() -> None:
    few = fit_mean_plane(wavy(60), in_turn(60), FLAT)
    many = fit_mean_plane(wavy(240), in_turn(240), FLAT)
    assert few is not None
    assert many is not None
    assert 1.0 / np.linalg.norm(few.m) == pytest.approx(RANGE, abs=4e-3)
    # Four times the strands at other random places: a quarter of the variance, within a third.
    ratio = np.diag(few.covariance) / np.diag(many.covariance)
    np.testing.assert_allclose(ratio, 4.0, rtol=0.33)
    assert 8e-3 < few.rms < 11e-3


def test_errors_of_the_plane_of_all_strands_are_as_large_as_its_covariance_says() -> None:
    rng, n = np.random.default_rng(6), 400
    scores = np.empty((n, 3))
    for i in range(n):
        x, z = rng.uniform(-0.2, 0.2, (2, 30))
        points = np.stack([x, RANGE + rng.normal(0.0, 0.005, 30), z], axis=-1)
        found = fit_mean_plane(points, in_turn(30), FLAT, reject=False)
        assert found is not None
        error = found.m - FLAT.normal / RANGE
        scores[i] = error / np.sqrt(np.diag(found.covariance))
    # A root mean square of 400 is known within 3.5 %; that of Student's t with 27 degrees of
    # freedom is 1.04.
    np.testing.assert_allclose(np.sqrt(np.mean(scores**2, axis=0)), 1.04, atol=0.12)


def test_a_few_strands_elsewhere_do_not_move_the_mean_plane() -> None:
    points = wavy()
    clean = fit_mean_plane(points, in_turn(60), FLAT)
    elsewhere = points[:4] + np.array([0.0, 0.2, 0.0])
    spoilt = fit_mean_plane(np.vstack([points, elsewhere]), in_turn(64), FLAT)
    assert clean is not None
    assert spoilt is not None
    np.testing.assert_allclose(spoilt.m, clean.m, atol=2e-3)
    assert np.all(spoilt.weights[-4:] == 0.0)


def steep_plane_through_one_laser() -> tuple[FloatArray, IntArray, Plane]:
    """Return folded strands on three stripes of a plane, and another plane that holds one stripe.

    The second stripe has most strands, and those of the others near their crossing are on both.
    """
    s = np.linspace(-0.2, 0.2, 30)
    along = np.concatenate([s[::3], s, s[::3]])
    angle = np.deg2rad(np.repeat([0.0, 60.0, 120.0], [10, 30, 10]))
    fold = 0.005 * np.sign(np.sin(50.0 * along + angle))
    x, z = along * np.cos(angle), along * np.sin(angle)
    laser = np.repeat([0, 1, 2], [10, 30, 10])
    # The plane that holds the second stripe shows its noise alone.
    fold[laser == 1] = np.random.default_rng(5).normal(0.0, 3e-4, 30)
    across = np.array([-np.sin(angle[15]), 0.0, np.cos(angle[15])])
    normal = np.array([0.0, 1.0, 0.0]) + np.tan(np.deg2rad(40.0)) * across
    length = float(np.linalg.norm(normal))
    points = np.stack([x, RANGE + fold, z], axis=-1)
    return points, laser, Plane(normal / length, RANGE / length)


def test_a_plane_through_one_laser_s_strands_is_not_the_mean_plane() -> None:
    points, laser, steep = steep_plane_through_one_laser()
    assert np.mean(np.abs(points @ steep.normal - steep.offset) < 3e-3) > 0.6
    assert share_near(points, laser, packed_plane(steep), 3e-3) < 0.3
    mean = fit_mean_plane(points, laser, steep)
    assert mean is not None
    np.testing.assert_allclose(mean.m * RANGE, [0.0, 1.0, 0.0], atol=0.02)


def test_points_on_a_line_have_no_mean_plane() -> None:
    s = np.linspace(-0.2, 0.2, 20)
    line = np.stack([s, np.full(20, RANGE), np.zeros(20)], axis=-1)
    assert fit_mean_plane(line, in_turn(20), FLAT) is None
    assert fit_mean_plane(line, in_turn(20), FLAT, reject=False) is None


def posture(distance: float, yaw: float) -> Posture:
    return Posture(
        range=distance,
        pitch=0.0,
        yaw=yaw,
        covariance=np.diag([1e-6, 1e-6, 1e-6]),
        normal_in_dome=np.array([np.sin(yaw), np.cos(yaw), 0.0]),
        slant_range=distance,
        nearest=distance,
        n_points=100,
        rms=1e-3,
    )


def test_doubt_widens_what_the_opinions_disagree_on() -> None:
    wider = inflate_covariance(posture(0.6, 0.0), posture(0.61, 0.1), 0.25).covariance
    assert wider[0, 0] == pytest.approx(1e-6 + 0.25 * 0.01**2)
    assert wider[1, 1] == pytest.approx(1e-6)
    assert wider[2, 2] == pytest.approx(1e-6 + 0.25 * 0.1**2)
    assert wider[0, 2] == pytest.approx(0.25 * 0.01 * 0.1)
