"""Rotations and rigid transforms: group laws, round trips near 0 and pi, batches."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.geometry.transforms import SE3, rotation_from_rotvec, rotvec_from_rotation, skew

COORDINATE = st.floats(-1.0, 1.0)
VECTOR = st.tuples(COORDINATE, COORDINATE, COORDINATE).map(np.array)
# Where the formulas change branch or lose digits, and ordinary angles between.
ANGLE = st.one_of(
    st.sampled_from(
        [0.0, 1e-300, 1e-12, 1e-8, 0.99e-4, 1.01e-4, 2e-4, 1.0, np.pi / 2, 2 * np.pi / 3]
        + [np.pi - gap for gap in (1e-3, 1e-8, 1e-15)]
        + [np.pi]
    ),
    st.floats(0.0, np.pi),
)
LAWS = settings(deadline=None, derandomize=True)


@st.composite
def rotvecs(draw: st.DrawFn) -> np.ndarray:
    axis = draw(VECTOR)
    length = np.linalg.norm(axis)
    unit = axis / length if length > 1e-3 else np.array([0.6, -0.64, 0.48])
    return draw(ANGLE) * unit


@st.composite
def poses(draw: st.DrawFn) -> SE3:
    return SE3.from_rotvec(draw(rotvecs()), draw(VECTOR))


def assert_same(a: SE3, b: SE3) -> None:
    # A few roundings of numbers up to 4.
    np.testing.assert_allclose(a.rotation, b.rotation, rtol=0.0, atol=5e-15)
    np.testing.assert_allclose(a.translation, b.translation, rtol=0.0, atol=1e-14)


@LAWS
@given(rotvecs())
def test_rodrigues_gives_a_rotation_by_the_angle_about_the_axis(v: np.ndarray) -> None:
    r = rotation_from_rotvec(v)
    np.testing.assert_allclose(r @ r.T, np.eye(3), rtol=0.0, atol=3e-15)
    assert np.linalg.det(r) == pytest.approx(1.0, abs=3e-15)
    np.testing.assert_allclose(r @ v, v, rtol=0.0, atol=3e-15)
    angle = np.linalg.norm(v)
    assert np.trace(r) == pytest.approx(1.0 + 2.0 * np.cos(angle), abs=3e-15)


@LAWS
@given(rotvecs())
def test_rotvec_round_trip(v: np.ndarray) -> None:
    back = rotvec_from_rotation(rotation_from_rotvec(v))
    angle = np.linalg.norm(v)
    # At pi the axis may point either way.
    if np.pi - angle < 1e-7 and back @ v < 0.0:
        back = back * (1.0 - 2.0 * np.pi / np.linalg.norm(back))
    np.testing.assert_allclose(back, v, rtol=0.0, atol=5e-15)


@LAWS
@given(st.floats(1e-150, 1e-3), VECTOR)
def test_small_rotvecs_keep_their_relative_precision(size: float, axis: np.ndarray) -> None:
    v = size * (axis + np.array([0.1, 0.0, 0.0]) + 1e-3)
    back = rotvec_from_rotation(rotation_from_rotvec(v))
    # The matrix holds v in its off-diagonal, next to second-order terms of relative size |v|.
    scale = np.linalg.norm(v)
    np.testing.assert_allclose(back / scale, v / scale, rtol=0.0, atol=1e-12)


def test_rodrigues_is_smooth_across_its_series() -> None:
    axis = np.array([0.6, -0.64, 0.48])
    angles = np.array([0.9999999e-4, 1.0000001e-4])
    below, above = rotation_from_rotvec(angles[:, None] * axis)
    k, change = skew(axis), angles[1] - angles[0]
    expected = change * k + 1e-4 * change * (k @ k)
    # The difference is 2e-11; roundings of 1 are what remains.
    np.testing.assert_allclose(above - below, expected, rtol=0.0, atol=5e-16)


def test_skew_is_the_cross_product() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 5, 4, 3))
    product = np.einsum("...ij,...j->...i", skew(a), b)
    np.testing.assert_allclose(product, np.cross(a, b), rtol=0.0, atol=1e-15)


@LAWS
@given(poses(), poses(), poses())
def test_composition_is_associative(a: SE3, b: SE3, c: SE3) -> None:
    assert_same((a @ b) @ c, a @ (b @ c))


@LAWS
@given(poses())
def test_identity_and_inverse(a: SE3) -> None:
    assert_same(a @ SE3.identity(), a)
    assert_same(SE3.identity() @ a, a)
    assert_same(a @ a.inverse(), SE3.identity())
    assert_same(a.inverse() @ a, SE3.identity())
    assert_same(a.inverse().inverse(), a)


@LAWS
@given(poses(), poses(), VECTOR)
def test_composition_acts_one_after_the_other(a: SE3, b: SE3, p: np.ndarray) -> None:
    np.testing.assert_allclose((a @ b).apply(p), a.apply(b.apply(p)), rtol=0.0, atol=1e-14)
    np.testing.assert_allclose((a @ b).rotate(p), a.rotate(b.rotate(p)), rtol=0.0, atol=1e-14)
    inverse = (a @ b).inverse()
    assert_same(inverse, b.inverse() @ a.inverse())


@LAWS
@given(poses(), VECTOR, VECTOR)
def test_distances_and_directions_are_kept(a: SE3, p: np.ndarray, q: np.ndarray) -> None:
    moved = a.apply(p) - a.apply(q)
    assert np.linalg.norm(moved) == pytest.approx(np.linalg.norm(p - q), abs=1e-14)
    np.testing.assert_allclose(moved, a.rotate(p - q), rtol=0.0, atol=1e-14)


def test_translation_is_the_source_origin_in_the_destination() -> None:
    a = SE3.from_rotvec([0.0, 0.0, np.pi / 2], [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(a.apply([0.0, 0.0, 0.0]), [1.0, 2.0, 3.0])
    np.testing.assert_allclose(a.apply([1.0, 0.0, 0.0]), [1.0, 3.0, 3.0], atol=1e-15)


@pytest.mark.parametrize("shape", [(), (1,), (4,), (2, 3)])
def test_batches_are_their_elements(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(5)
    v, t, p = rng.normal(size=(3, *shape, 3))
    other = SE3.from_rotvec([0.1, 0.2, 0.3], [1.0, 2.0, 3.0])
    a = SE3.from_rotvec(v, t)
    moved, composed, inverse = a.apply(p), a @ other, a.inverse()
    turned = other @ a
    assert moved.shape == (*shape, 3)
    assert composed.rotation.shape == (*shape, 3, 3)
    for i in np.ndindex(shape):
        one = SE3.from_rotvec(v[i], t[i])
        np.testing.assert_allclose(moved[i], one.apply(p[i]), rtol=0.0, atol=1e-15)
        assert_same(SE3(composed.rotation[i], composed.translation[i]), one @ other)
        assert_same(SE3(turned.rotation[i], turned.translation[i]), other @ one)
        assert_same(SE3(inverse.rotation[i], inverse.translation[i]), one.inverse())
        np.testing.assert_allclose(
            rotvec_from_rotation(a.rotation)[i], rotvec_from_rotation(one.rotation), atol=1e-15
        )


def test_one_transform_moves_many_points_and_many_transforms_one() -> None:
    rng = np.random.default_rng(6)
    one = SE3.from_rotvec([0.3, 0.2, 0.1], [1.0, 2.0, 3.0])
    assert one.apply(rng.normal(size=(7, 2, 3))).shape == (7, 2, 3)
    many = SE3.from_rotvec(rng.normal(size=(7, 3)), np.zeros(3))
    assert many.apply([1.0, 0.0, 0.0]).shape == (7, 3)


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="points has shape"):
        SE3.identity().apply([1.0, 2.0])
    with pytest.raises(ValueError, match="rotvecs has shape"):
        rotation_from_rotvec(1.0)
