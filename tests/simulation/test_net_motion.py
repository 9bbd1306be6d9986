"""A net that moves: true posture, clearance and scene against each other."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.errors import OptionError
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.scanning.patch import COEFFICIENTS, RIGHT, UP, nearest_tangent, packed_plane
from aqualvs.scanning.posture import range_pitch_yaw
from aqualvs.simulation.net_motion import NetWall
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenarios import example_rig
from aqualvs.simulation.scene import Box, Fish, Fold, Net, Scene, Wall
from aqualvs.simulation.surfaces import pack_surfaces

CURVATURES = st.sampled_from([0.0, 0.1, -0.1, 0.25, -0.25])
TIMES = st.floats(0.0, 30.0)
MOVING = {"sway": 0.1, "drift": 0.01, "tilt": 0.05, "rock": 0.04, "bearing": 1.1}
SCENE = Scene(dome_from_scene=SE3.identity(), nets=(Net(),), target="net")


def near(wall: NetWall, rng: np.random.Generator, time_s: float, along: float = 2.0) -> SE3:
    """A pose that is near the net and turned a little every way."""
    level = wall.station(
        rng.uniform(0.3, 1.2),
        along=rng.uniform(-along, along),
        up=rng.uniform(-1, 1),
        time_s=time_s,
    )
    turn = rotation_from_rotvec(rng.uniform(-0.25, 0.25, 3))
    return SE3(level.rotation @ turn, level.translation)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10000), time_s=TIMES)
def test_flat_posture_is_the_rendered_plane(seed: int, time_s: float) -> None:
    wall = NetWall(**MOVING)
    pose = near(wall, np.random.default_rng(seed), time_s)
    truth = wall.posture_at(pose, time_s)
    plane = wall.scene_at(pose, time_s, SCENE).target_plane()
    expected = range_pitch_yaw(plane.normal / plane.offset)
    assert truth[:3] == pytest.approx(expected, abs=1e-10)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10000), time_s=TIMES, curvature=CURVATURES)
def test_posture_is_that_of_the_nearest_point(seed: int, time_s: float, curvature: float) -> None:
    wall = NetWall(curvature=curvature, **MOVING)
    pose = near(wall, np.random.default_rng(seed), time_s)
    truth = wall.posture_at(pose, time_s)
    # The surface by its definition: arcs along, straight up; refined around the best of a grid.
    dome_from_net = pose.inverse() @ wall.world_from_net(time_s)
    along, up, reach = truth.along, truth.up, 0.5
    best = np.inf
    for _ in range(5):
        a, b = np.meshgrid(np.linspace(-reach, reach, 41), np.linspace(-reach, reach, 41))
        x, z = a.ravel() + along, b.ravel() + up
        k = curvature
        bend = (
            np.stack([np.sin(k * x) / k, (1.0 - np.cos(k * x)) / k, z])
            if k
            else (np.stack([x, 0.0 * x, z]))
        )
        points = dome_from_net.apply(bend.T)
        far = np.linalg.norm(points, axis=1)
        i = int(np.argmin(far))
        best, along, up, reach = far[i], x[i], z[i], reach / 10.0
    assert truth.range == pytest.approx(best, abs=1e-8)
    # At the nearest point the normal is the way there.
    toward = points[i] / best
    assert math.atan2(toward[0], toward[1]) == pytest.approx(truth.yaw, abs=1e-4)
    assert math.atan2(toward[2], toward[1]) == pytest.approx(truth.pitch, abs=1e-4)


def lit_points(wall: NetWall, pose: SE3, twine: float) -> tuple[np.ndarray, Scene]:
    """What the lasers light of a fine net, in the dome's frame."""
    fine = Scene(dome_from_scene=pose, nets=(Net(bar=5.0 * twine, twine=twine),), target="net")
    scene = wall.scene_at(pose, 2.0, fine)
    points = Renderer(example_rig()).lit_points(scene, 2.0).points_in_dome
    assert len(points) > 1000
    return points, scene


def lit_posture(wall: NetWall, pose: SE3, twine: float) -> np.ndarray:
    """Posture from the lit points of a fine net: a paraboloid by least squares."""
    points, scene = lit_points(wall, pose, twine)
    plane = scene.target_plane()
    patch = packed_plane(plane)
    u, v = points @ patch[RIGHT:UP], points @ patch[UP:COEFFICIENTS]
    terms = np.stack([np.ones_like(u), u, v, 0.5 * u * u, u * v, 0.5 * v * v], axis=-1)
    patch[COEFFICIENTS:] = np.linalg.lstsq(terms, plane.signed_distance(points), rcond=None)[0]
    m = nearest_tangent(patch)
    assert m is not None
    return np.array(range_pitch_yaw(m))


@pytest.mark.parametrize("curvature", [0.0, 0.25, -0.2])
def test_rendered_net_is_where_posture_says(curvature: float) -> None:
    wall = NetWall(curvature=curvature, **MOVING)
    level = wall.station(0.6, along=1.7, up=0.3, time_s=2.0)
    pose = SE3(level.rotation @ rotation_from_rotvec([0.06, 0.0, 0.09]), level.translation)
    truth = wall.posture_at(pose, 2.0)
    # Lit points lie on the front of the twine: what is left without twine is the net.
    thick, thin = lit_posture(wall, pose, 6e-4), lit_posture(wall, pose, 3e-4)
    found = 2.0 * thin - thick
    assert found[0] == pytest.approx(truth.range, abs=1e-4)
    assert found[1:] == pytest.approx(truth[1:3], abs=math.radians(0.01))
    assert abs(truth.yaw) > 0.05


@pytest.mark.parametrize("curvature", [0.0, 0.25, -0.2])
def test_rendered_net_is_on_the_wall(curvature: float) -> None:
    wall = NetWall(curvature=curvature, **MOVING)
    pose = wall.station(0.6, along=1.7, up=0.3, yaw=0.1, time_s=2.0)
    points = pose.apply(lit_points(wall, pose, 3e-4)[0])[::7]
    before = [wall.posture_at(SE3(np.eye(3), point), 2.0).range for point in points]
    # Within the twine's radius and its knots, on the vehicle's side; 0.05 mm for the paraboloid.
    assert min(before) > -5e-5
    assert max(before) < 0.75 * 3e-4 + 5e-5
    assert np.linalg.norm(np.ptp(points, axis=0)) > 0.3


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10000), curvature=CURVATURES)
def test_clearance_is_the_least_over_the_hull(seed: int, curvature: float) -> None:
    wall = NetWall(curvature=curvature, **MOVING)
    rng = np.random.default_rng(seed)
    pose = near(wall, rng, 1.0)
    half = np.array([0.23, 0.29, 0.13])
    # The body's axes: forward, right, down.
    body = SE3(pose.rotation[:, [1, 0, 2]] * np.array([1.0, 1.0, -1.0]), pose.translation)
    grid = np.linspace(-1.0, 1.0, 21)
    hull = np.stack(np.meshgrid(grid, grid, grid), axis=-1).reshape(-1, 3) * half
    # Range of a dome that sits at the point is the point's distance.
    points = (wall.world_from_net(1.0).inverse() @ body).apply(hull)
    if curvature == 0.0:
        distances = -points[:, 1]
    else:
        reach = np.hypot(points[:, 0], points[:, 1] - 1.0 / curvature)
        distances = np.sign(curvature) * (reach - 1.0 / abs(curvature))
    found = wall.clearance(body, half, 1.0)
    assert found <= distances.min() + 1e-12
    # Between the points of the grid, 29 mm apart, a curve of 4 m bends by 0.03 mm.
    assert found == pytest.approx(distances.min(), abs=1e-4)


def test_it_moves_as_it_says() -> None:
    wall = NetWall(bearing=0.4, sway=0.2, sway_period=8.0, drift=0.05, rock=0.1, rock_period=4.0)
    eye = wall.station(1.0)
    assert wall.posture_at(eye, 2.0).range == pytest.approx(1.0 + 0.2 + 0.1, abs=1e-12)
    assert wall.posture_at(eye, 6.0).range == pytest.approx(1.0 - 0.2 + 0.3, abs=1e-12)
    # The far normal points up when the net is tilted by a positive angle.
    assert wall.posture_at(eye, 1.0).pitch == pytest.approx(0.1, abs=1e-12)


@settings(max_examples=25, deadline=None)
@given(
    distance=st.floats(0.3, 1.5),
    along=st.floats(-3.0, 3.0),
    yaw=st.floats(-0.6, 0.6),
    time_s=TIMES,
    curvature=CURVATURES,
)
def test_station_has_the_posture_asked_for(
    distance: float, along: float, yaw: float, time_s: float, curvature: float
) -> None:
    wall = NetWall(curvature=curvature, **MOVING)
    pose = wall.station(distance, along=along, up=0.2, yaw=yaw, time_s=time_s)
    truth = wall.posture_at(pose, time_s)
    # The yaw of a level vehicle: clockwise, the right way round.
    assert truth.range == pytest.approx(distance, abs=1e-9)
    assert truth.yaw == pytest.approx(yaw, abs=1e-9)
    assert (truth.along, truth.up) == pytest.approx((along, 0.2), abs=1e-9)


def test_yaw_is_positive_when_the_vehicle_must_turn_right() -> None:
    wall = NetWall()
    # Heading north-west before a net to the north.
    c = math.sqrt(0.5)
    pose = SE3(np.array([[c, c, 0.0], [c, -c, 0.0], [0.0, 0.0, -1.0]]), np.array([-1.0, 0.0, 5.0]))
    assert wall.posture_at(pose, 0.0).yaw == pytest.approx(math.radians(45.0))


@pytest.mark.parametrize("curvature", [0.0, 0.2, -0.2])
def test_scene_stays_while_the_vehicle_moves(curvature: float) -> None:
    wall = NetWall(curvature=curvature, **MOVING)
    base = Scene(
        dome_from_scene=SE3.identity(),
        nets=(Net(holes=((1.2, 0.1, 0.05),), folds=(Fold(direction=0.3, place=1.3),)),),
        walls=(Wall(depth=0.8, yaw=0.2, pitch=-0.1),),
        fish=(Fish(position=(1.0, 0.2, 0.1)),),
        boxes=(Box(centre=(1.0, 0.4, 0.0), heading=0.3),),
        target="net",
    )
    seen = []
    for along in (1.0, 1.4):
        pose = wall.station(0.7, along=along, up=0.1, time_s=3.0)
        scene = wall.scene_at(pose, 3.0, base)
        world_from_scene = pose @ scene.dome_from_scene
        net = scene.nets[0]
        x, z, _ = net.holes[0]
        place = world_from_scene.apply([x, 0.5 * curvature * x * x, z])
        surfaces = pack_surfaces(scene, 1.5)
        wall_normal = pose.rotate(surfaces.walls[0, 9:12])
        wall_offset = wall_normal @ pose.apply(surfaces.walls[0, :3])
        fish = pose.apply(surfaces.ellipsoids[0, :3])
        box_axis = pose.rotate(surfaces.boxes[0, 3:6])
        crest = net.folds[0].place - net.holes[0][0] * math.cos(0.3) - z * math.sin(0.3)
        mesh = (net.offset[0] - x, net.offset[1] - z)
        seen.append([*place, *wall_normal, wall_offset, *fish, *box_axis, crest, *mesh])
    # Holes 0.2 m beside the foot slide by u³/(6 R²) = 0.05 mm to either side.
    assert seen[0] == pytest.approx(seen[1], abs=1.2e-4)


def test_faults_are_refused() -> None:
    pose = NetWall().station(0.5)
    with pytest.raises(OptionError, match="curvature"):
        NetWall().scene_at(
            pose, 0.0, Scene(dome_from_scene=pose, nets=(Net(curvature=(0.1, 0.0)),))
        )
    with pytest.raises(OptionError, match="half size"):
        NetWall(curvature=0.1).scene_at(
            pose, 0.0, Scene(dome_from_scene=pose, nets=(Net(half_size=(1.0, 1.0)),))
        )
    with pytest.raises(OptionError, match="station"):
        NetWall(curvature=-0.5).station(2.5)
