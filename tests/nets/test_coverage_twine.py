"""Twine from made-up kinds of dashes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.nets.coverage import DashKind, measure_twine

# Silhouette of a diameter, how much of it is lit and what blur adds at the usual height with search
# lines STEP apart; widths of the sheet, lit and at half height; as `net_twine` expects them.
BODY, SEEN, STEP, PIXEL, HALO = 0.95, 0.82, 6e-4, 6e-4, 0.694e-3
SHEET, HALF_HEIGHT = 2.8e-3, 2.66e-3


def kinds_of(
    twine: float, across: list[float], slant: list[float], height: float = 100.0
) -> list[DashKind]:
    """Dashes exactly as the model has them."""
    body = BODY * twine
    lit = SEEN * body + HALO
    # Brighter dashes are longer.
    brighter = (height / 100.0) ** 0.25
    return [
        DashKind(
            laser=i % 3,
            family=i // 3,
            across=a,
            slant=k,
            length=float(brighter * np.hypot(lit / a, SHEET * k)),
            width=float(
                (HALF_HEIGHT**-2.5 + (k * a / (body + 0.95 * PIXEL)) ** 2.5) ** (-1.0 / 2.5)
            ),
            height=height,
            step=STEP,
            pixel=PIXEL,
            spread=0.1,
            count=100,
        )
        for i, (a, k) in enumerate(zip(across, slant, strict=True))
    ]


@settings(max_examples=40, deadline=None)
@given(
    twine=st.floats(1.0e-3, 5e-3), angles=st.lists(st.floats(30.0, 90.0), min_size=3, max_size=6)
)
def test_twine_is_found_at_any_angles(twine: float, angles: list[float]) -> None:
    across = [float(np.sin(np.deg2rad(a))) for a in angles]
    slant = [float(1.0 / np.tan(np.deg2rad(a))) for a in angles]
    found = measure_twine(kinds_of(twine, across, slant))
    assert found is not None
    # The prior of the sheet is met exactly, that of the twine pulls a little: most where it is thin
    # and no strand is square to its line.
    assert found.thickness == pytest.approx(twine, rel=0.08)
    assert abs(found.thickness - twine) < 2.0 * found.sigma


def test_one_kind_that_lies_does_not_decide() -> None:
    kinds = kinds_of(3e-3, [1.0, 0.9, 0.8, 0.95], [0.0, 0.3, 0.5, 0.2])
    wrong = replace(kinds[0], length=9e-3)
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
    excess, sigma = found.excess(across, slant, np.full(3, STEP), np.full(3, 100.0))
    length = np.array([kind.length for kind in kinds])
    body = BODY * 2.5e-3 / across
    np.testing.assert_allclose(length - excess, body, rtol=0.08)
    assert np.all(sigma > 0.0)


def test_known_twine_measures_the_halo() -> None:
    kinds = kinds_of(2.0e-3, [1.0, 0.9, 0.7], [0.0, 0.2, 0.6])
    found = measure_twine(kinds, known=1.6e-3)
    assert found is not None
    assert found.thickness == pytest.approx(1.6e-3)
    # What is lit is as before: what was twine is halo now.
    lit = found.dash_length(np.ones(1), np.zeros(1), np.full(1, STEP), np.full(1, 100.0))
    assert lit[0] == pytest.approx(SEEN * BODY * 2.0e-3 + HALO, rel=0.05)
    assert found.halo == pytest.approx(lit[0] - BODY * 1.6e-3 - 0.44 * STEP)


@pytest.mark.parametrize("height", [30.0, 200.0])
def test_brightness_is_not_taken_for_thickness(height: float) -> None:
    found = measure_twine(kinds_of(2.0e-3, [1.0, 0.9, 0.7], [0.0, 0.2, 0.6], height))
    assert found is not None
    assert found.thickness == pytest.approx(2.0e-3, rel=0.05)


def test_faint_and_far_strands_are_less_certain() -> None:
    across, slant = [1.0, 0.9, 0.7], [0.0, 0.2, 0.6]
    near = measure_twine(kinds_of(2.0e-3, across, slant))
    faint = measure_twine(kinds_of(2.0e-3, across, slant, 30.0))
    far = measure_twine(
        [replace(k, step=2.0 * STEP, pixel=2.0 * PIXEL) for k in kinds_of(2.0e-3, across, slant)]
    )
    assert near is not None
    assert faint is not None
    assert far is not None
    assert faint.sigma > 1.5 * near.sigma
    assert far.sigma > 1.4 * near.sigma


def test_no_dashes_no_twine() -> None:
    assert measure_twine([]) is None
