"""Rays against walls, boxes, fish and bubbles."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.simulation.scenario import dome_from_target
from aqualvs.simulation.scene import Box, Bubble, Fish, Label, Scene, Wall
from aqualvs.simulation.surfaces import pack_surfaces
from aqualvs.simulation.truth import cast

_AHEAD = dome_from_target(0.6, 0.0, 0.0)
angle = st.floats(-0.6, 0.6)


def _reach(scene, directions, origin=(0.0, 0.0, 0.0), t=0.0):
    directions = np.atleast_2d(np.asarray(directions, dtype=float))
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.tile(np.asarray(origin, dtype=float), (len(directions), 1))
    reach = cast(origins, directions, pack_surfaces(scene, t))
    solid = np.where(np.isfinite(reach.solid), reach.solid, np.nan)
    return reach, origins + solid[:, None] * directions


@settings(max_examples=50, deadline=None)
@given(distance=st.floats(0.2, 2.0), pitch=angle, yaw=angle, x=angle, z=angle)
def test_wall_points_lie_on_the_target_plane(distance, pitch, yaw, x, z):
    scene = Scene(
        dome_from_scene=dome_from_target(distance, pitch, yaw), walls=(Wall(),), target="wall"
    )
    reach, points = _reach(scene, [x, 1.0, z])
    plane = scene.target_plane()
    if np.isfinite(reach.solid[0]):
        # Fused multiply-add leaves a few units in the last place of distances up to 100 m.
        assert abs(plane.signed_distance(points)[0]) < 1e-12 * max(1.0, reach.solid[0])
        assert reach.kind[0] == Label.WALL
    else:
        assert np.array([x, 1.0, z]) @ plane.normal <= 1e-3


def test_a_wall_behind_the_vehicle_is_not_seen():
    scene = Scene(dome_from_scene=_AHEAD, walls=(Wall(),))
    reach, _ = _reach(scene, [0.0, -1.0, 0.1])
    assert np.isinf(reach.solid[0])
    assert reach.kind[0] == Label.NONE


def test_turned_wall_keeps_the_sign_convention():
    scene = Scene(dome_from_scene=_AHEAD, walls=(Wall(yaw=0.3),))
    _, points = _reach(scene, [[-0.3, 1.0, 0.0], [0.3, 1.0, 0.0]])
    # The far normal points right, so the wall comes nearer on the right.
    assert points[0, 1] > points[1, 1]
    slope = (points[1, 1] - points[0, 1]) / (points[1, 0] - points[0, 0])
    assert abs(np.arctan(-slope) - 0.3) < 1e-12


@settings(max_examples=50, deadline=None)
@given(x=st.floats(-0.2, 0.2), z=st.floats(-0.2, 0.2), heading=angle)
def test_box_points_lie_on_a_face(x, z, heading):
    box = Box(centre=(0.02, 0.3, -0.01), size=(0.2, 0.3, 0.1), heading=heading)
    reach, points = _reach(Scene(dome_from_scene=_AHEAD, boxes=(box,)), [x, 1.0, z])
    if not np.isfinite(reach.solid[0]):
        return
    turn = SE3(rotation_from_rotvec([0.0, 0.0, heading]), np.array(box.centre))
    local = (_AHEAD @ turn).inverse().apply(points[0])
    shares = np.abs(local) / (np.array(box.size) / 2.0)
    assert abs(shares.max() - 1.0) < 1e-9
    assert reach.kind[0] == Label.SOLID


def test_box_is_hit_where_it_must_be():
    box = Box(centre=(0.0, 0.3, 0.0), size=(0.2, 0.3, 0.1))
    reach, _ = _reach(Scene(dome_from_scene=_AHEAD, boxes=(box,)), [[0, 1, 0], [0.3, 1, 0]])
    assert abs(reach.solid[0] - 0.75) < 1e-12
    assert np.isinf(reach.solid[1])


def test_fish_swims_and_is_thinner_than_long():
    fish = Fish(position=(0.0, -0.1, 0.0), velocity=(0.2, 0.0, 0.0), length=0.2)
    scene = Scene(dome_from_scene=_AHEAD, fish=(fish,))
    reach, _ = _reach(scene, [0.0, 1.0, 0.0])
    assert abs(reach.solid[0] - (0.5 - 0.016)) < 1e-12
    assert reach.kind[0] == Label.FISH
    away = np.array([0.2, 0.5, 0.0])
    assert np.isfinite(_reach(scene, away, t=1.0)[0].solid[0])
    assert np.isinf(_reach(scene, [0.0, 1.0, 0.0], t=1.0)[0].solid[0])


def test_bubble_is_reported_apart_and_rises():
    bubble = Bubble(position=(0.0, -0.2, 0.0), velocity=(0.0, 0.0, 0.1), radius=0.01)
    scene = Scene(dome_from_scene=_AHEAD, walls=(Wall(),), bubbles=(bubble,))
    reach, _ = _reach(scene, [0.0, 1.0, 0.0])
    assert abs(reach.bubble[0] - 0.39) < 1e-12
    assert abs(reach.solid[0] - 0.6) < 1e-12
    assert np.isinf(_reach(scene, [0.0, 1.0, 0.0], t=1.0)[0].bubble[0])
