"""Planes and their meeting with rays."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from aqualvs.geometry.planes import Plane, Rays, exchanged_plane, shifted_plane

COORDINATE = st.floats(-2.0, 2.0)
VECTOR = st.tuples(COORDINATE, COORDINATE, COORDINATE).map(np.array)
NORMAL = VECTOR.filter(lambda v: np.linalg.norm(v) > 1e-2)
LAWS = settings(deadline=None, derandomize=True)


def rays_from(origins: object, directions: object, valid: object = True) -> Rays:
    o = np.asarray(origins, dtype=np.float64)
    d = np.asarray(directions, dtype=np.float64)
    return Rays(o, d, np.broadcast_to(np.asarray(valid, dtype=np.bool_), o.shape[:-1]))


@LAWS
@given(NORMAL, COORDINATE, VECTOR)
def test_normalising_keeps_the_plane(normal: np.ndarray, offset: float, p: np.ndarray) -> None:
    plane = Plane.from_normal(normal, offset)
    assert np.linalg.norm(plane.normal) == pytest.approx(1.0, abs=1e-15)
    length = np.linalg.norm(normal)
    # normal·X - offset grows with the normal; roundings of 1e-16 over a length of 1e-2.
    expected = (normal @ p - offset) / length
    assert plane.signed_distance(p) == pytest.approx(expected, abs=1e-13)


@LAWS
@given(NORMAL, COORDINATE, VECTOR, NORMAL)
def test_intersections_lie_on_plane_and_ray(
    normal: np.ndarray, offset: float, origin: np.ndarray, direction: np.ndarray
) -> None:
    plane = Plane.from_normal(normal, offset)
    direction = direction / np.linalg.norm(direction)
    point, valid = plane.intersect(rays_from(origin, direction))
    approach, gap = plane.normal @ direction, plane.signed_distance(origin)
    assume(abs(approach) > 1e-6)  # nearly parallel: the point's place is a matter of rounding
    assert valid == (-gap / approach >= 0.0)
    if valid:
        # The ray runs at most 1e7 m; errors are relative to that.
        reach = 1.0 + abs(gap / approach)
        assert plane.signed_distance(point) == pytest.approx(0.0, abs=1e-14 * reach)
        np.testing.assert_allclose(np.cross(point - origin, direction), 0.0, atol=1e-14 * reach)
    else:
        assert np.isnan(point).all()


def test_only_what_lies_ahead_counts() -> None:
    plane = Plane(np.array([0.0, 1.0, 0.0]), 2.0)
    directions = [[0, 1, 0], [0, -1, 0], [1, 0, 0], [0.6, 0.8, 0], [0, 1, 0], [np.nan] * 3]
    valid_in = [True, True, True, True, False, True]
    points, valid = plane.intersect(rays_from(np.zeros((6, 3)), directions, valid_in))
    np.testing.assert_array_equal(valid, [True, False, False, True, False, False])
    np.testing.assert_allclose(points[[0, 3]], [[0, 2, 0], [1.5, 2, 0]], atol=1e-15)
    assert np.isnan(points[~valid]).all()


def test_a_ray_that_starts_on_the_plane_meets_it_there() -> None:
    plane = Plane(np.array([0.0, 1.0, 0.0]), 2.0)
    points, valid = plane.intersect(rays_from([5.0, 2.0, 1.0], [0.0, 1.0, 0.0]))
    assert valid
    np.testing.assert_array_equal(points, [5.0, 2.0, 1.0])
    # A ray inside the plane meets it everywhere, which is no point.
    assert not plane.intersect(rays_from([5.0, 2.0, 1.0], [1.0, 0.0, 0.0]))[1]


@LAWS
@given(NORMAL, COORDINATE, VECTOR)
def test_facing_origin_is_the_same_plane(normal: np.ndarray, offset: float, p: np.ndarray) -> None:
    plane = Plane.from_normal(normal, offset)
    facing = plane.facing_origin()
    assert facing.offset >= 0.0
    assert abs(facing.signed_distance(p)) == abs(plane.signed_distance(p))


def test_batches_keep_their_shape() -> None:
    plane = Plane.from_normal([0.0, 2.0, 0.0], 3.0)
    assert plane.offset == 1.5
    assert plane.signed_distance(np.zeros((4, 5, 3))).shape == (4, 5)
    points, valid = plane.intersect(rays_from(np.zeros((4, 5, 3)), np.ones((4, 5, 3))))
    assert (points.shape, valid.shape) == ((4, 5, 3), (4, 5))


@pytest.mark.parametrize("normal", [[0.0, 0.0, 0.0], [np.nan, 1.0, 0.0], [np.inf, 0.0, 0.0]])
def test_normals_without_direction_are_refused(normal: list[float]) -> None:
    with pytest.raises(ValueError, match="has no direction"):
        Plane.from_normal(normal, 1.0)


def test_points_along_rays() -> None:
    rays = rays_from([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    expected = [[1.0, 0.0, 2.0], [3.0, 1.0, 0.0]]
    np.testing.assert_array_equal(rays.points_at(np.array([2.0, 3.0])), expected)


def test_two_stripes_share_a_plane_with_their_lasers_exchanged_too() -> None:
    wall = Plane.from_normal((0.1, 1.0, -0.2), 0.8)
    sheets = (
        Plane.from_normal((0.05, -0.24, 1.0), -0.15),
        Plane.from_normal((-0.1, 0.14, 1.0), 0.12),
    )
    other = exchanged_plane(wall, *sheets)
    assert other is not None
    for sheet, read_as in (sheets, sheets[::-1]):
        # Two points of the stripe, and the points of the other sheet that are seen there.
        system = np.array([wall.normal, sheet.normal, [1.0, 0.0, 0.0]])
        for x in (-0.2, 0.3):
            point = np.linalg.solve(system, [wall.offset, sheet.offset, x])
            seen = point * read_as.offset / (read_as.normal @ point)
            assert other.signed_distance(seen) == pytest.approx(0.0, abs=1e-12)
    back = exchanged_plane(other, *sheets)
    assert back is not None
    np.testing.assert_allclose(back.packed(), wall.packed(), atol=1e-12)
    assert exchanged_plane(wall, Plane(wall.normal, 0.0), sheets[0]) is None
    # The same plane is found without knowledge that two sheets are exchanged.
    also = shifted_plane(wall, sheets, sheets[::-1])
    assert also is not None
    np.testing.assert_allclose(also.packed(), other.packed(), atol=1e-9)


def test_stripes_read_as_those_of_the_next_lasers_show_a_nearer_plane() -> None:
    fan = [Plane.from_normal((1.0, rise, 0.1), 0.1 - 0.02 * rise) for rise in (-0.3, -0.1, 0.1)]
    wall = Plane.from_normal((0.1, 1.0, -0.2), 1.6)
    nearer = shifted_plane(wall, fan[1:], fan[:-1])
    assert nearer is not None
    assert 0.1 < nearer.offset < 0.5 * wall.offset
    # Read back, they are on the wall again; sheets read as themselves move nothing.
    back = shifted_plane(nearer, fan[:-1], fan[1:])
    same = shifted_plane(wall, fan, fan)
    assert back is not None
    assert same is not None
    np.testing.assert_allclose(back.packed(), wall.packed(), atol=0.02)
    np.testing.assert_allclose(same.packed(), wall.packed(), atol=1e-9)
    # One stripe determines no plane.
    assert shifted_plane(wall, fan[:1], fan[1:2]) is None
    assert shifted_plane(wall, [*fan[:1], Plane(wall.normal, 0.0)], fan[1:]) is None
