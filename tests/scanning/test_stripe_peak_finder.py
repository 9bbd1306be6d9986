"""`PeakFinder` against a slow reference in plain Python, on random pictures."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.scanning.stripe import (
    HEIGHT,
    N_MEASURES,
    POSITION,
    STEP_U,
    STEP_V,
    TINT_U,
    TOP,
    WIDTH,
    PeakFinder,
    SearchImage,
)

U8 = NDArray[np.uint8]
GREEN = np.array([[-0.29, -0.957]])
NO_CHROMA = np.empty((0, 0), np.uint8)


class Peak(NamedTuple):
    """What the reference says of a peak."""

    line: int
    position: float
    height: float
    width: float
    top: int


def background_of(row: list[int], reach: int) -> list[int]:
    """The higher of the least values of pairs of pixels to either side; white beyond the row."""
    least, half = [min(row[i : i + 2]) for i in range(0, len(row), 2)], max((reach - 1) // 2, 1)
    of_pair = [
        max(min(least[max(k - half, 0) : k], default=255), min(least[k + 1 :][:half], default=255))
        for k in range(len(least))
    ]
    return [of_pair[i // 2] for i in range(len(row))]


def segments(run: list[int], base: int) -> list[tuple[int, int]]:
    """Part a run where a valley has less than 0.6 of the lower of two peaks above the base."""
    start, found = 0, []
    while start < len(run):
        peak, end = start, len(run)
        for at in range(start + 1, len(run)):
            behind = run[peak:at]
            valley, lower = min(behind), min(run[at], run[peak])
            place = peak + behind.index(valley)
            if place > start and run[at] >= valley and 10 * (valley - base) < 6 * (lower - base):
                end = place
                break
            peak = at if run[at] > run[peak] else peak
        found.append((start, end))
        start = end
    return found


def peaks_of(row: list[int], x: int, low: int, high: int, contrast: int, reach: int) -> list[Peak]:
    n, background = len(row), background_of(row, reach)
    # Whole pairs of pixels.
    first, end = max(low - reach, 0) // 2 * 2, min(min(high + reach, n - 1) // 2 * 2 + 2, n)
    above = [first <= i < end and row[i] - background[i] >= contrast for i in range(n)] + [False]
    found, i = [], first
    while i < end:
        if not above[i]:
            i += 1
            continue
        stop = above.index(False, i)
        if i <= high and stop > low:
            found += _peaks_of_run(row, background, x, i, stop, reach)
        i = stop
    return found


def _peaks_of_run(
    row: list[int], background: list[int], x: int, start: int, stop: int, reach: int
) -> list[Peak]:
    found = []
    parts = segments(row[start:stop], background[start])
    for k, (one, other) in enumerate(parts):
        mine = row[start + one : start + other]
        peak = start + one + mine.index(max(mine))
        # Feet are looked for as far as the valleys beside the peak, or beyond the run's ends.
        least = max(start - reach, 0) if k == 0 else start + one
        most = min(stop + reach, len(row)) - 1 if k == len(parts) - 1 else start + other
        level = (row[peak] + background[peak]) / 2
        a = next((i for i in range(peak, least - 1, -1) if row[i] <= level), None)
        b = next((i for i in range(peak, most + 1) if row[i] <= level), None)
        if a is None or b is None or max(row[a : b + 1]) > row[peak]:
            continue
        left = a + (level - row[a]) / (row[a + 1] - row[a])
        right = b - (level - row[b]) / (row[b - 1] - row[b])
        if right - left > reach:
            continue
        nodes = [(left, 0.0), *((i, row[i] - level) for i in range(a + 1, b)), (right, 0.0)]
        centre = centroid_of(nodes)
        if right - left < 2.0 and row[peak] < 250:
            centre = gaussian_peak(row, peak, background[peak])
        height = row[peak] - background[peak]
        found.append(Peak(x, centre, height, right - left, row[peak]))
    return found


def centroid_of(nodes: list[tuple[float, float]]) -> float:
    """Return the centroid below a line through nodes (x, y), by Simpson's rule: exact for it."""
    area, moment = 0.0, 0.0
    for (x0, y0), (x1, y1) in pairwise(nodes):
        area += (x1 - x0) * (y0 + y1) / 2
        middle = (x0 + x1) / 2 * (y0 + y1) / 2
        moment += (x1 - x0) * (x0 * y0 + 4 * middle + x1 * y1) / 6
    return moment / area


def gaussian_peak(row: list[int], peak: int, base: int) -> float:
    """Return the vertex of the parabola through the logarithms of three heights."""
    heights = [max(row[peak + k] - base, 0.5) for k in (-1, 0, 1)]
    curve = np.polynomial.Polynomial.fit([-1, 0, 1], np.log(heights), 2).convert()
    return float(peak - curve.coef[1] / (2.0 * curve.coef[2]))


def find(
    image: SearchImage,
    band: tuple[IntArray, IntArray],
    reach: int,
    contrast: int,
    *,
    every: int = 1,
    capacity: int = 100_000,
) -> tuple[IntArray, FloatArray]:
    line, table = np.empty(capacity, np.int64), np.empty((N_MEASURES, capacity))
    finder = PeakFinder(image.lines.shape[1], *band, reach, GREEN)
    n = finder.find(image, contrast, every, line, table)
    return line[:n], table[:, :n]


def picture(rng: np.random.Generator, shape: tuple[int, int], kind: str) -> U8:
    if kind == "noise":
        return rng.integers(0, 256, shape, dtype=np.uint8)
    if kind == "few levels":
        return np.asarray(40 * rng.integers(0, 5, shape), np.uint8)
    x = np.arange(shape[1])
    light = np.zeros(shape)
    for _ in range(6):
        at, sigma = rng.uniform(0.0, shape[1]), rng.uniform(0.7, 6.0)
        light += rng.uniform(20.0, 250.0) * np.exp(-0.5 * ((x - at) / sigma) ** 2)
    light += rng.normal(0.0, 3.0, shape)
    return np.clip(np.rint(30.0 + light), 0, 255).astype(np.uint8)


def assert_same(line: IntArray, table: FloatArray, expected: list[Peak]) -> None:
    np.testing.assert_array_equal(line, [one.line for one in expected])
    np.testing.assert_array_equal(table[HEIGHT], [one.height for one in expected])
    np.testing.assert_array_equal(table[TOP], [one.top for one in expected])
    # Sums in another order.
    rounding = {"rtol": 0.0, "atol": 1e-9}
    np.testing.assert_allclose(table[POSITION], [one.position for one in expected], **rounding)
    np.testing.assert_allclose(table[WIDTH], [one.width for one in expected], **rounding)


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_lines=st.integers(1, 5),
    length=st.integers(1, 150),
    reach=st.integers(2, 40),
    contrast=st.sampled_from([1, 6, 20, 90]),
    every=st.sampled_from([1, 2, 3]),
    kind=st.sampled_from(["noise", "few levels", "stripes"]),
)
def test_peaks_are_those_of_the_reference(
    seed: int, n_lines: int, length: int, reach: int, contrast: int, every: int, kind: str
) -> None:
    rng = np.random.default_rng(seed)
    lines = picture(rng, (n_lines, length), kind)
    # Bands of all kinds, empty ones among them.
    low, high = rng.integers(0, length, (2, n_lines))
    image = SearchImage(lines, NO_CHROMA, NO_CHROMA, 1, False)
    found = find(image, (low, high), reach, contrast, every=every)
    expected = [
        peak
        for x in range(0, n_lines, every)
        if low[x] <= high[x]
        for peak in peaks_of(
            [int(value) for value in lines[x]], x, int(low[x]), int(high[x]), contrast, reach
        )
    ]
    assert_same(*found, expected)


def test_the_background_is_the_higher_of_the_two_sliding_minima() -> None:
    row = np.full(60, 20, np.uint8)
    row[30:] = 90
    row[28:31] = [120, 150, 120]
    net_mask = np.array([0]), np.array([59])
    image = SearchImage(row[None], NO_CHROMA, NO_CHROMA, 1, False)
    _, table = find(image, net_mask, 10, 6)
    # A stripe on the edge of a box counts from the brighter side.
    np.testing.assert_array_equal(table[HEIGHT], [60.0])
    row[40:] = 20
    _, table = find(image, net_mask, 40, 6)
    # Within reach the box has another side, and is dark behind it: all of it stands out.
    np.testing.assert_array_equal(table[HEIGHT], [130.0])


def test_more_peaks_than_there_is_room_for_double_the_contrast() -> None:
    rng = np.random.default_rng(4)
    lines = picture(rng, (20, 400), "noise")
    low, high = np.zeros(20, np.int64), np.full(20, 399)
    image = SearchImage(lines, NO_CHROMA, NO_CHROMA, 1, False)
    sizes = {
        contrast: len(find(image, (low, high), 12, contrast)[0]) for contrast in (10, 20, 40, 80)
    }
    line, table = find(image, (low, high), 12, 10, capacity=sizes[40] + 1)
    assert sizes[10] > sizes[40] == len(line) > 0
    assert_same(
        line,
        table,
        [
            peak
            for x in range(20)
            for peak in peaks_of([int(value) for value in lines[x]], x, 0, 399, 40, 12)
        ],
    )


@pytest.mark.parametrize("line_px", [1, 2])
@pytest.mark.parametrize("along_x", [True, False])
def test_a_chroma_step_is_that_from_the_flanks_to_the_peak(line_px: int, along_x: bool) -> None:
    length, n_lines = 80, 24
    lines = np.full((n_lines, length), 60, np.uint8)
    lines[:, 38:43] = [80, 120, 160, 120, 80]
    half_lines = n_lines * line_px // 2
    u = np.full((half_lines, length // 2), 118, np.uint8)
    v = np.full((half_lines, 40), 124, np.uint8)
    u[:, 18:23], v[:, 18:23] = 108, 94
    # One line of U is an outlier: the mean is taken over it and its two neighbours, or over it
    # twice and one neighbour at the border.
    u[0] += 30
    u, v = (plane if along_x else np.ascontiguousarray(plane.T) for plane in (u, v))
    low, high = np.zeros(n_lines, np.int64), np.full(n_lines, length - 1)
    image = SearchImage(lines, u, v, line_px, along_x)
    line, table = find(image, (low, high), 12, 6)
    np.testing.assert_array_equal(line, np.arange(n_lines))
    np.testing.assert_allclose(table[STEP_U], -10.0)
    np.testing.assert_allclose(table[STEP_V], -30.0)
    # As levels of chroma for each of luma, of which the flanks have 60.
    raised = np.array([20.0, 10.0, 0.0])[np.minimum(line * line_px // 2, 2)]
    np.testing.assert_allclose(table[TINT_U], (118.0 + raised - 128.0) / 60.0)
