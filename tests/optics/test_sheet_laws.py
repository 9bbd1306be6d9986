"""What must hold for light behind any window."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.rig import Window
from aqualvs.optics.sheet import Sheet, crossing

TILT = st.floats(-0.5, 0.5)
SHIFT = st.floats(-0.3, 0.3)
DEPTH = st.floats(1e-3, 0.1)
INDEX = st.floats(1.3, 1.4)
LAWS = settings(max_examples=60, deadline=None, derandomize=True)

NORMAL, FORWARD, SIDE = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), np.array([0.0, 0, 1])
SOURCE = np.array([0.0, 0.02, -0.05])
PLANE = Plane(NORMAL, 0.0)


def points_ahead() -> FloatArray:
    return np.random.default_rng(4).uniform([-0.3, 0.25, -0.4], [0.3, 1.5, 0.4], (200, 3))


def sheet(across: float, along: float, depth: float, n_water: float, n_air: float = 1.0) -> Sheet:
    face = FORWARD + np.tan(across) * NORMAL + np.tan(along) * SIDE
    face /= np.linalg.norm(face)
    window = Window(Plane(face, float(face @ SOURCE) + depth), SOURCE)
    return Sheet(plane=PLANE, window=window, n_air=n_air, n_water=n_water)


@LAWS
@given(across=TILT, along=TILT, depth=DEPTH, n=INDEX)
def test_equal_indices_leave_the_plane(across: float, along: float, depth: float, n: float) -> None:
    points = points_ahead()
    one = sheet(across, along, depth, n, n_air=n)
    np.testing.assert_allclose(
        one.signed_distance(points), PLANE.signed_distance(points), rtol=0.0, atol=1e-14
    )
    np.testing.assert_allclose(one.gradient(points), np.tile(NORMAL, (200, 1)), rtol=0, atol=1e-13)


@LAWS
@given(along=TILT, depth=DEPTH, n=INDEX)
def test_a_window_square_to_the_plane_leaves_it(along: float, depth: float, n: float) -> None:
    """Light is bent within the plane that holds the window's normal."""
    points = points_ahead()
    np.testing.assert_allclose(
        sheet(0.0, along, depth, n).signed_distance(points),
        PLANE.signed_distance(points),
        rtol=0.0,
        atol=1e-15,
    )


@LAWS
@given(across=TILT, along=TILT, depth=DEPTH, n=INDEX)
def test_mirrored_windows_make_mirrored_sheets(
    across: float, along: float, depth: float, n: float
) -> None:
    points = points_ahead()
    np.testing.assert_allclose(
        sheet(-across, along, depth, n).signed_distance(points * [-1.0, 1.0, 1.0]),
        -sheet(across, along, depth, n).signed_distance(points),
        rtol=0.0,
        atol=1e-14,
    )


@LAWS
@given(across=TILT, along=TILT, depth=DEPTH, n=INDEX, turn=st.tuples(SHIFT, SHIFT, SHIFT))
def test_moving_everything_changes_no_distance(
    across: float, along: float, depth: float, n: float, turn: tuple[float, float, float]
) -> None:
    one = sheet(across, along, depth, n)
    assert one.window is not None
    pose = SE3.from_rotvec(3.0 * np.array(turn), np.array(turn[::-1]))

    def moved(plane: Plane) -> Plane:
        normal = pose.rotate(plane.normal)
        return Plane(normal, plane.offset + float(normal @ pose.translation))

    window = Window(moved(one.window.face), pose.apply(one.window.source))
    other = Sheet(plane=moved(one.plane), window=window, n_air=1.0, n_water=n)
    points = points_ahead()
    np.testing.assert_allclose(
        other.signed_distance(pose.apply(points)), one.signed_distance(points), rtol=0, atol=1e-13
    )
    np.testing.assert_allclose(
        other.gradient(pose.apply(points)), pose.rotate(one.gradient(points)), rtol=0, atol=1e-12
    )


@LAWS
@given(across=TILT, along=TILT, depth=DEPTH, n=INDEX)
def test_light_takes_the_shortest_time(across: float, along: float, depth: float, n: float) -> None:
    """Fermat: no neighbour of the crossing makes the optical path shorter."""
    one = sheet(across, along, depth, n)
    assert one.window is not None
    face = one.window.face
    basis = np.linalg.svd(face.normal[None])[2][1:]
    for point in points_ahead()[:20]:
        if face.signed_distance(point) <= 0.0:
            continue
        at = SOURCE + np.array(crossing(one.packed(), *point)[1:4])
        assert abs(face.signed_distance(at)) < 1e-15

        def path(p: FloatArray, end: FloatArray = point) -> float:
            return float(np.linalg.norm(p - SOURCE) + n * np.linalg.norm(end - p))

        step = 1e-3 * depth
        for direction in (basis[0], basis[1], -basis[0], -basis[1]):
            assert path(at + step * direction) > path(at)


@LAWS
@given(across=st.floats(0.01, 0.5), along=TILT, depth=DEPTH)
def test_little_refraction_bends_little(across: float, along: float, depth: float) -> None:
    points, bend = points_ahead(), 1e-6
    one = sheet(across, along, depth, 1.0 + bend)
    assert one.window is not None
    way = points - SOURCE
    length = np.linalg.norm(way, axis=1)
    cosine = np.maximum(way @ one.window.face.normal / length, 1e-9)
    # A ray turns by the change of the index times the tangent of its angle to the window; the
    # distance's scale changes by no more than as much again.
    turn = bend * np.sqrt(1.0 / cosine**2 - 1.0)
    off = np.abs(one.signed_distance(points) - PLANE.signed_distance(points))
    assert np.all(off < 1.01 * length * (turn + bend / cosine**2))
    assert off.max() > 0.0


@LAWS
@given(across=TILT, along=TILT, depth=DEPTH, n=INDEX, scale=st.floats(0.05, 20.0))
def test_a_rig_of_another_size_has_a_sheet_of_another_size(
    across: float, along: float, depth: float, n: float, scale: float
) -> None:
    one = sheet(across, along, depth, n)
    assert one.window is not None
    face = one.window.face
    window = Window(Plane(face.normal, face.offset * scale), SOURCE * scale)
    other = Sheet(plane=PLANE, window=window, n_air=1.0, n_water=n)
    points = points_ahead()
    np.testing.assert_allclose(
        other.signed_distance(points * scale) / scale, one.signed_distance(points), atol=1e-13
    )
