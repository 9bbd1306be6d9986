"""Kernels that find by a shortcut what sorting or dividing finds as well."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.linear_algebra import lower_quantile
from aqualvs.scanning.candidates import lit_cells, number_cells
from aqualvs.scanning.plane_search import _guide, _median_weight, _pick

# Repeated values among them, and such as leave the others in one bin.
VALUES = st.floats(-300.0, 300.0) | st.sampled_from([0.0, 12.0, 12.5, -1e30, 1e300, np.inf, np.nan])
SAMPLING_WEIGHTS = arrays(np.float64, st.integers(1, 60), elements=st.integers(1, 40).map(float))


@settings(deadline=None, max_examples=300)
@given(
    arrays(np.float64, st.integers(0, 80), elements=VALUES),
    st.sampled_from([0.0, 0.5, 0.9, 0.95, 1.0]),
)
def test_a_quantile_is_the_value_that_sorting_gives(values: FloatArray, share: float) -> None:
    expected = np.sort(values)[int(share * (len(values) - 1))] if len(values) else 0.0
    # Zeros of both signs are equal, and sorted in any order.
    np.testing.assert_equal(lower_quantile(values, share) + 0.0, expected + 0.0)


@settings(deadline=None, max_examples=200)
@given(SAMPLING_WEIGHTS)
def test_half_of_all_voice_is_at_most_as_loud_as_the_middle_one(
    sampling_weight: FloatArray,
) -> None:
    # Whole numbers add up exactly in any order.
    ordered = np.sort(sampling_weight)
    expected = ordered[np.searchsorted(np.cumsum(ordered), 0.5 * sampling_weight.sum())]
    assert _median_weight(sampling_weight) == expected


@settings(deadline=None, max_examples=100)
@given(SAMPLING_WEIGHTS, st.lists(st.floats(0.0, 1.0, exclude_max=True), min_size=1, max_size=50))
def test_chunks_are_drawn_in_proportion_to_their_voice(
    sampling_weight: FloatArray, draws: list[float]
) -> None:
    up_to = np.cumsum(sampling_weight)
    guide = np.empty(len(sampling_weight), np.int64)
    _guide(up_to, guide)
    found = [_pick(up_to, guide, draw) for draw in draws]
    expected = np.searchsorted(up_to, np.array(draws) * up_to[-1], side="right")
    np.testing.assert_array_equal(found, expected.clip(max=len(sampling_weight) - 1))


@pytest.mark.parametrize("size_px", [(720, 576), (1920, 1080)])
def test_cells_are_six_pixels_wide_and_light_their_neighbours(size_px: tuple[int, int]) -> None:
    rng = np.random.default_rng(5)
    pixels = rng.uniform((-0.5, -0.5), np.array(size_px) - 0.5, (3000, 2))
    # Search lines are whole numbers, so that many readings lie on borders of cells.
    pixels[::2, 0], pixels[1::2, 1] = np.rint(pixels[::2, 0]), np.rint(pixels[1::2, 1])
    cells = number_cells(pixels)
    row, column = np.maximum(pixels.astype(np.int64), 0).T[::-1] // 6
    np.testing.assert_array_equal(cells.of_candidate, (row + 1) * cells.n_columns + column + 1)
    explained = rng.random(len(pixels)) < 0.1
    lit = lit_cells(cells, explained)[cells.of_candidate] != 0
    near_row = np.abs(row[:, None] - row[explained]) <= 1
    near_column = np.abs(column[:, None] - column[explained]) <= 1
    np.testing.assert_array_equal(lit, (near_row & near_column).any(axis=1))
    assert 0.05 < lit.mean() < 0.9
