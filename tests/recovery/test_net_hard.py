"""Nets that are no plain lattice in a plane: folded, torn, bent, slack, one behind the other."""

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from benchmarks.random_nets import shots
from scipy.spatial import cKDTree

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.scanner import Scanner
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.scan import Label, Scan
from aqualvs.simulation.scenario import dome_from_target
from aqualvs.simulation.scenarios import example_rig
from aqualvs.simulation.scene import Fold, Net, Scene, Wall
from aqualvs.simulation.scene import SurfaceKind as Kind
from aqualvs.simulation.truth import LitPoints, visible_fit
from net_dives import frame_of
from quick_pictures import QuickRenderer
from whole import WHOLE, part_of

PITCH, YAW = 4.0, -6.0
NET = Net(bar=0.022, twine=0.002, roll=0.3)
WALLS = (Wall(depth=0.5),)


class Shot(NamedTuple):
    scan: Scan
    lit: LitPoints
    in_scene: FloatArray

    @property
    def on_net(self) -> BoolArray:
        mask: BoolArray = self.lit.label == Kind.NET
        return mask

    @property
    def posture(self) -> Posture:
        assert isinstance(self.scan.posture, Posture), self.scan.posture
        return self.scan.posture

    def error(self) -> FloatArray:
        """Error of range (m), pitch and yaw (rad) against the plane through all lit twine."""
        seen = visible_fit(self.lit, Kind.NET)
        assert seen is not None
        x, y, z = seen[0].normal
        true = np.array([seen[0].offset, np.arctan2(z, y), np.arctan2(x, y)])
        found = self.posture
        error: FloatArray = np.array([found.range, found.pitch, found.yaw]) - true
        return error

    def recall(self, mask: BoolArray | None = None) -> float:
        """Share of true points of the net within 3 px of one that is labelled net."""
        wanted = self.on_net if mask is None else self.on_net & mask
        points = self.scan.points
        tree = cKDTree(points.pixels[points.label == Label.NET])
        return float(np.mean(tree.query(self.lit.pixels[wanted])[0] < 3.0))

    def precision(self) -> float:
        """Share of the points labelled net whose nearest true point of that laser is on a net."""
        right, judged = 0, 0
        for laser in range(3):
            mine = (self.scan.points.label == Label.NET) & (self.scan.points.laser == laser)
            true = self.lit.laser == laser
            distance, nearest = cKDTree(self.lit.pixels[true]).query(self.scan.points.pixels[mine])
            known = distance < 9.0
            right += np.count_nonzero(self.on_net[true][nearest[known]])
            judged += np.count_nonzero(known)
        return right / judged


@cache
def equipment() -> tuple[QuickRenderer, Scanner]:
    # Light more than 7 px beside a sheet's is little, and takes two thirds of the time of folds.
    return QuickRenderer(example_rig(), halo_px=31 if WHOLE else 15), Scanner(example_rig())


def shoot(
    *nets: Net,
    walls: tuple[Wall, ...] = WALLS,
    slide: tuple[float, float] = (0.0, 0.0),
    posture: tuple[float, float, float] = (0.6, PITCH, YAW),
) -> Shot:
    """Measure nets and walls at a range in metres, and pitch and yaw in degrees."""
    distance, pitch, yaw = posture
    pose = dome_from_target(distance, np.deg2rad(pitch), np.deg2rad(yaw), slide)
    scene = Scene(dome_from_scene=pose, nets=nets, walls=walls)
    renderer, scanner = equipment()
    picture = renderer.render(scene, 0.0, np.random.default_rng(7))
    scan = scanner.process(frame_of(0, 0.0, picture.image))
    return Shot(scan, picture.lit, pose.inverse().apply(picture.lit.points_in_dome))


def check_posture(posture: Posture, *, share: float = 0.006, degrees: float = 0.6) -> None:
    """Against the net's plane; lit twine stands 0.15 % of the range before it."""
    assert abs(posture.range / 0.6 - 1.0) < share
    assert abs(np.rad2deg(posture.pitch) - PITCH) < degrees
    assert abs(np.rad2deg(posture.yaw) - YAW) < degrees


def test_folds_are_net_and_move_a_posture_little() -> None:
    found, all_of_it = [], []
    # A fold across the strands that carry most of the light moves the plane with it.
    for direction, share, degrees in ((0.2, 0.006, 0.9), (1.7, 0.02, 2.0)):
        for height in (-0.025, 0.02):
            fold = Fold(direction=direction, place=0.03, height=height, width=0.035)
            shot = shoot(replace(NET, folds=(fold,)))
            check_posture(shot.posture, share=share, degrees=degrees)
            way = np.array([np.cos(direction), 0.0, np.sin(direction)])
            found.append(shot.recall(np.abs(shot.in_scene @ way - 0.03) < 0.025))
            all_of_it.append(shot.recall())
            assert shot.precision() > 0.98
    # Measured with eight seeds of the noise: 0.67 to 0.87 and 0.81 to 0.94, for the last fold may
    # be followed or not, and one bit of its pose decides. Without following the net into its folds
    # it is 0.19 and 0.61.
    assert np.mean(found) > 0.6
    assert np.mean(all_of_it) > 0.77


@pytest.mark.parametrize(
    ("direction", "height", "width", "bar"),
    part_of(
        [
            # One flank's points lie nearly on a line.
            (0.6, 0.03, 0.06, 0.022),
            (0.2, 0.03, 0.06, 0.022),
            # A steep plane holds all strands of one laser, and those of the others beside them.
            (0.7, 0.03, 0.06, 0.0215),
            # One laser alone shows a flank.
            (0.8, 0.024, 0.045, 0.025),
        ]
    ),
)
def test_a_net_that_is_all_folds_is_measured_by_all_of_its_light(
    direction: float, height: float, width: float, bar: float
) -> None:
    fold = Fold(direction=direction, place=0.0, height=-height, width=width, period=2.0 * width)
    errors, scores = [], []
    for share in (1.0, 1.05, 1.1):
        shot = shoot(replace(NET, bar=share * bar, folds=(fold,)), walls=())
        error = shot.error()
        errors.append(abs(error[0]))
        scores.append(np.abs(error / np.sqrt(np.diag(shot.posture.covariance))).max())
    # Refused without it, or measured on one row of flanks: up to 20 mm and 5 degrees off. With the
    # strands of some nets that still happens; it is in the sigma.
    assert np.median(errors) < 5e-3
    assert max(scores) < 3.0


def shoot_random_folds(seed: int) -> Shot:
    rng = np.random.default_rng([1, seed])
    bar, height, width = rng.uniform((0.018, 0.01, 0.03), (0.035, 0.05, 0.1))
    period = width * rng.uniform(2.0, 3.5)
    fold = Fold(
        direction=rng.uniform(0.0, 1.57), place=0.0, height=-height, width=width, period=period
    )
    net = replace(NET, bar=bar, twine=bar * rng.uniform(0.05, 0.12), folds=(fold,))
    return shoot(net, walls=(), posture=rng.uniform((0.32, -12.0, -12.0), (0.8, 12.0, 12.0)))


def test_errors_on_random_folds_are_as_large_as_stated() -> None:
    """On one flank of a fold a plane fits to a tenth of a millimetre, and the net is elsewhere."""
    n = 90 if WHOLE else 8
    scores = []
    for seed in range(115, 115 + n):
        shot = shoot_random_folds(seed)
        if isinstance(shot.scan.posture, Posture):
            scores.append(shot.error() / np.sqrt(np.diag(shot.posture.covariance)))
    assert len(scores) >= 0.85 * n
    # By the planes of flanks alone one in six, some by 30 sigmas. In steep folds all lasers may
    # agree on one row of flanks.
    beyond = np.abs(scores).max(axis=1) > 4.0
    assert np.count_nonzero(beyond) <= max(1, n // 22)
    # Of a normal distribution: 0.67.
    assert (np.median(np.abs(scores), axis=0) > 0.25).all()
    assert (np.median(np.abs(scores), axis=0) < 1.0).all()


@pytest.mark.parametrize("seed", part_of([199, 241, 398]))
def test_a_flank_with_most_of_the_strands_is_no_sure_posture(seed: int) -> None:
    shot = shoot_random_folds(seed)
    if isinstance(shot.scan.posture, Posture):
        # By the flank's plane alone: 14 to 38.
        assert np.abs(shot.error() / np.sqrt(np.diag(shot.posture.covariance))).max() < 5.0


@pytest.mark.parametrize(
    ("direction", "height", "width", "bar", "behind"),
    part_of(
        [
            (0.6, 0.035, 0.05, 0.03, 0.3),
            (2.0, 0.045, 0.07, 0.03, 0.3),
            (0.3, 0.05, 0.08, 0.035, 0.3),
        ],
        every=3,
    ),
)
def test_a_wall_is_no_target_where_a_net_before_it_makes_no_plane(
    direction: float, height: float, width: float, bar: float, behind: float
) -> None:
    fold = Fold(direction=direction, place=0.03, height=-height, width=width, period=2.0 * width)
    thin = replace(NET, bar=bar, twine=0.05 * bar, folds=(fold,))
    posture = shoot(thin, walls=(Wall(depth=behind),)).scan.posture
    # Measured to the wall, 0.2 or 0.3 m farther, without a look at the loose light before it.
    assert not posture or abs(posture.range / 0.6 - 1.0) < 0.06


def test_a_slack_net() -> None:
    wave = Fold(direction=0.5, place=0.1, height=0.008, width=0.15, period=0.3)
    shot = shoot(replace(NET, folds=(wave,)))
    # The mean of the wave stands half its height behind; its flanks lean by 5 degrees.
    check_posture(shot.posture, share=0.02, degrees=3.5)
    assert shot.recall() > 0.85


@pytest.mark.parametrize(
    "bend", part_of([(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)], every=3), ids=str
)
def test_a_bend_of_a_metres_radius_is_known_to_three_sigma(bend: tuple[float, float]) -> None:
    posture = shoot(replace(NET, curvature=bend)).posture
    assert posture.curvature is not None
    assert posture.sigma_curvature is not None
    z = (np.array(posture.curvature) - bend) / np.array(posture.sigma_curvature)
    assert np.abs(z).max() < 3.0
    assert max(posture.sigma_curvature) < 0.12
    check_posture(posture, degrees=1.5)


def test_missing_strands_and_holes() -> None:
    holes = ((0.05, 0.04, 0.05), (-0.09, -0.08, 0.04))
    shot = shoot(replace(NET, missing=0.25, holes=holes))
    check_posture(shot.posture)
    assert shot.recall() > 0.88
    assert shot.precision() > 0.98


@pytest.mark.parametrize("slide", [(0.55, 0.0), (0.0, -0.57)])
def test_a_torn_edge_in_view(slide: tuple[float, float]) -> None:
    rng = np.random.default_rng(3)
    along = np.arange(-0.6, 0.6, 0.05)
    if slide[0]:
        tears = tuple((-0.6, float(z), float(rng.uniform(0.01, 0.06))) for z in along)
    else:
        tears = tuple((float(x), 0.6, float(rng.uniform(0.01, 0.06))) for x in along)
    shot = shoot(replace(NET, half_size=(0.6, 0.6), holes=tears), slide=slide)
    check_posture(shot.posture, degrees=1.0)
    assert shot.recall() > 0.85
    assert shot.precision() > 0.98


def test_of_two_nets_the_nearer_one_is_measured() -> None:
    # A fold without end moves the whole net.
    behind = Net(mesh="square", bar=0.03, twine=0.003, folds=(Fold(height=0.25, width=1e4),))
    shot = shoot(NET, behind)
    check_posture(shot.posture)
    nearer = shot.in_scene[:, 1] < 0.1
    assert shot.recall(nearer) > 0.85
    assert shot.precision() > 0.95


def test_a_near_net_of_thick_twine_is_no_wall() -> None:
    """Its strands are long in search lines, and still short on the net."""
    pose = dome_from_target(0.34, 0.0, np.deg2rad(-10.0))
    net = Net(mesh="hexagon", bar=0.035, twine=0.0033, roll=0.2, fouling=0.2)
    renderer, scanner = equipment()
    picture = renderer.render(
        Scene(dome_from_scene=pose, nets=(net,), walls=(Wall(depth=0.31),)),
        0.0,
        np.random.default_rng(5),
    )
    posture = scanner.process(frame_of(0, 0.0, picture.image)).posture
    assert posture
    assert abs(posture.range / 0.34 - 1.0) < 0.02


@pytest.mark.parametrize("slide", [(0.0, 0.0), (0.429, 0.02475)])
def test_a_laser_along_a_strand_makes_no_wall_of_a_net(slide: tuple[float, float]) -> None:
    """An ROV and a square net hang level: now and then a laser lights one strand and no gap.

    The light lies where the strand is, not where the laser's sheet is brightest: by 4 mm on a wall.
    """
    pitch, yaw = np.deg2rad([0.5, 2.0])
    pose = dome_from_target(0.5, pitch, yaw, slide)
    scene = Scene(dome_from_scene=pose, nets=(Net(mesh="square"),))
    renderer, scanner = equipment()
    picture = renderer.render(scene, 0.0, np.random.default_rng(7))
    scan = scanner.process(frame_of(0, 0.0, picture.image))
    posture = scan.posture
    assert posture
    off = np.array([posture.pitch - pitch, posture.yaw - yaw])
    assert np.all(np.abs(off) < 4.0 * np.sqrt(np.diag(posture.covariance)[1:]))
    # The strand alone is much of the light.
    assert np.ptp(scan.points.pixels[scan.points.laser == 0, 0]) > 600
    assert np.mean(scan.points.label == Label.SOLID) < 0.05


@pytest.mark.parametrize("number", part_of([7024, 41003, 41087]))
def test_what_is_behind_a_coarse_net_is_not_its_posture(number: int) -> None:
    """The wall has ten times the light of the few lit strands, and looks like a net in shadows."""
    (shot,) = shots(1, number, None)
    posture = equipment()[1].process(shot.frame).posture
    assert not posture or abs(posture.range / shot.plane[3] - 1.0) < 0.005
