"""Snell's law as a batched function."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from aqualvs.optics.refraction import refract

INDEX = st.floats(1.0, 2.5)
ANGLE = st.floats(0.0, np.pi / 2)


def at_incidence(angle: float) -> tuple[np.ndarray, np.ndarray]:
    """A direction in the x-z plane that meets the normal -z at `angle`."""
    return np.array([np.sin(angle), 0.0, np.cos(angle)]), np.array([0.0, 0.0, -1.0])


@settings(deadline=None, derandomize=True)
@given(ANGLE, INDEX, INDEX)
def test_obeys_snell_by_angles(angle: float, n_in: float, n_out: float) -> None:
    direction, normal = at_incidence(angle)
    refracted, valid = refract(direction, normal, n_in=n_in, n_out=n_out)
    sine = n_in / n_out * np.sin(angle)
    assume(abs(sine - 1.0) > 1e-12)  # on the critical angle itself a rounding decides
    assert valid == (sine < 1.0)
    if valid:
        expected = np.arcsin(sine)
        # arcsin loses half of the digits near the critical angle, the vector form does not.
        assert np.arctan2(refracted[0], refracted[2]) == pytest.approx(expected, abs=1e-7)
        assert refracted[0] == pytest.approx(sine, abs=1e-15)
        assert refracted[1] == 0.0
        assert np.linalg.norm(refracted) == pytest.approx(1.0, abs=1e-14)
    else:
        assert np.isnan(refracted).all()


@settings(deadline=None, derandomize=True)
@given(ANGLE, INDEX, INDEX)
def test_light_runs_the_same_way_back(angle: float, n_in: float, n_out: float) -> None:
    direction, normal = at_incidence(angle)
    there, valid = refract(direction, normal, n_in=n_in, n_out=n_out)
    assume(valid and min(direction[2], there[2]) > 1e-3)  # not grazing on either side
    back, valid = refract(-there, -normal, n_in=n_out, n_out=n_in)
    assert valid
    # Roundings grow by 1/cos, at most 1000 here, on either side.
    np.testing.assert_allclose(back, -direction, rtol=0.0, atol=1e-12)


def test_equal_indices_change_nothing() -> None:
    rng = np.random.default_rng(3)
    d = rng.normal(size=(50, 3))
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    normal = rng.normal(size=(50, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal *= -np.sign(np.sum(d * normal, axis=-1, keepdims=True))
    refracted, valid = refract(d, normal, n_in=1.3, n_out=1.3)
    assert valid.all()
    np.testing.assert_allclose(refracted, d, rtol=0.0, atol=1e-15)


def test_batches_broadcast_and_mask() -> None:
    directions = np.stack([at_incidence(a)[0] for a in (0.0, 0.5, 1.2)])
    refracted, valid = refract(directions, [0.0, 0.0, -1.0], n_in=1.5, n_out=1.0)
    np.testing.assert_array_equal(valid, [True, True, False])
    assert np.isnan(refracted[2]).all()
    np.testing.assert_array_equal(refracted[0], [0.0, 0.0, 1.0])
    # Away from the interface there is nothing to refract.
    assert not refract([0.0, 0.0, 1.0], [0.0, 0.0, 1.0], n_in=1.0, n_out=1.3)[1]


def test_misuse_is_refused() -> None:
    with pytest.raises(ValueError, match="indices must be positive"):
        refract([0.0, 0.0, 1.0], [0.0, 0.0, -1.0], n_in=0.0, n_out=1.0)
    with pytest.raises(ValueError, match="normals has shape"):
        refract([0.0, 0.0, 1.0], [0.0, -1.0], n_in=1.0, n_out=1.0)
