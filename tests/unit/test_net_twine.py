"""Twine from made-up kinds of dashes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.scanning.net_twine import DashKind, measure_twine

# How much wider than the twine its light is where search lines are STEP apart, and sheet's widths:
# lit, and at half height; as `net_twine` expects them.
STEP, HALO = 6e-4, 0.72e-3
SHEET, HALF_HEIGHT = 4.2e-3, 4.87e-3


def kinds_of(twine: float, across: list[float], slant: list[float]) -> list[DashKind]:
    """Dashes exactly as the model has them; a silhouette is 0.95 of the diameter."""
    lit = 0.95 * twine + HALO
    return [
        DashKind(
            laser=i % 3,
            family=i // 3,
            across=a,
            slant=k,
            length=float(np.hypot(lit / a, SHEET * k)),
            width=float((HALF_HEIGHT**-3 + (k * a / (lit + 0.33e-3)) ** 3) ** (-1.0 / 3.0)),
            height=120.0,
            step=STEP,
            spread=0.1,
            count=100,
        )
        for i, (a, k) in enumerate(zip(across, slant, strict=True))
    ]


@settings(max_examples=40, deadline=None)
@given(
    twine=st.floats(1.0e-3, 5e-3),
    angles=st.lists(st.floats(30.0, 90.0), min_size=3, max_size=6),
)
def test_twine_is_found_at_any_angles(twine: float, angles: list[float]) -> None:
    across = [float(np.sin(np.deg2rad(a))) for a in angles]
    slant = [float(1.0 / np.tan(np.deg2rad(a))) for a in angles]
    found = measure_twine(kinds_of(twine, across, slant))
    assert found is not None
    # The prior of the sheet is met exactly, that of the twine pulls a little.
    assert found.thickness == pytest.approx(twine, rel=0.06)
    assert abs(found.thickness - twine) < 2.0 * found.sigma


def test_one_kind_that_lies_does_not_decide() -> None:
    kinds = kinds_of(3e-3, [1.0, 0.9, 0.8, 0.95], [0.0, 0.3, 0.5, 0.2])
    wrong = kinds[0].__class__(
        **{**{f: getattr(kinds[0], f) for f in kinds[0].__slots__}, "length": 9e-3}
    )
    found = measure_twine([*kinds[1:], wrong])
    assert found is not None
    assert found.thickness == pytest.approx(3e-3, rel=0.12)


def test_thinner_than_the_halo_is_thin_and_uncertain_but_positive() -> None:
    kinds = kinds_of(0.1e-3, [1.0, 0.9], [0.0, 0.1])
    found = measure_twine(kinds)
    assert found is not None
    assert 0.0 < found.thickness < 0.6e-3
    assert found.sigma > 0.3 * found.thickness


def test_excess_is_what_is_not_twine() -> None:
    across, slant = np.array([1.0, 0.8, 0.6]), np.array([0.0, 0.4, 0.8])
    kinds = kinds_of(2.5e-3, across.tolist(), slant.tolist())
    found = measure_twine(kinds)
    assert found is not None
    excess, sigma = found.excess(across, slant, np.full(3, STEP))
    length = np.array([kind.length for kind in kinds])
    body = 0.95 * 2.5e-3 / across
    np.testing.assert_allclose(length - excess, body, rtol=0.08)
    assert np.all(sigma > 0.0)


def test_known_twine_measures_the_halo() -> None:
    kinds = kinds_of(2.0e-3, [1.0, 0.9, 0.7], [0.0, 0.2, 0.6])
    found = measure_twine(kinds, known=1.6e-3)
    assert found is not None
    assert found.thickness == pytest.approx(1.6e-3)
    # 0.38 mm of what was twine is halo now.
    assert found.halo + 0.2 * STEP == pytest.approx(HALO + 0.95 * 0.4e-3, rel=0.1)


def test_no_dashes_no_twine() -> None:
    assert measure_twine([]) is None
