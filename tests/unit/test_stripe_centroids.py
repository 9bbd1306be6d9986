"""Returns are measured as they are defined, pixel by pixel."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from aqualvs.scanning.centroids import BATCH, measure_runs
from aqualvs.scanning.contrast import BLOCK
from aqualvs.scanning.lanes import margined

U8 = NDArray[np.uint8]
Return = tuple[int, float, int, float, float]
GREY = np.empty((0, 0), np.uint8)
LEAST = 12


def plain_pieces(line: list[int], start: int, last: int, base: int) -> list[tuple[int, int]]:
    """(peak, end) of each return in a run: apart where a valley is under 0.6 of the lower peak."""
    pieces = []
    while start <= last:
        peak = valley_at = start
        end = last + 1
        for v in range(start + 1, last + 1):
            lower = min(line[v], line[peak])
            deep = 10 * (line[valley_at] - base) < 6 * (lower - base)
            if line[v] >= line[valley_at] and deep and valley_at > start:
                end = valley_at
                break
            if line[v] > line[peak]:
                peak = valley_at = v
            elif line[v] < line[valley_at]:
                valley_at = v
        pieces.append((peak, end))
        start = end
    return pieces


def plain_feet(line: list[int], peak: int, low: int, high: int, level: int) -> tuple[int, int]:
    """Nearest positions not above half height, in doubled grey levels; ValueError if none."""
    feet = []
    for way in (range(peak, low - 1, -1), range(peak + 1, high + 1)):
        for v in way:
            if 2 * line[v] <= level:
                feet.append(v)
                break
            if line[v] > line[peak]:
                raise ValueError("the foot of another stripe")
        else:
            raise ValueError("no foot")
    return feet[0], feet[1]


def plain_fall(green: list[int], peak: int, width: float) -> float:
    last = len(green) - 1
    edge, flank = int(0.5 * width) + 1, int(width) + 4
    spots = [peak // 2, max(peak - edge, 0) // 2, min((peak + edge) // 2, last)]
    beside = green[max(peak - flank, 0) // 2] + green[min((peak + flank) // 2, last)]
    return max(green[spot] for spot in spots) - 0.5 * beside


def plain_returns(
    image: U8, background: U8, green: U8, runs: list[list[int]], reach_px: int
) -> list[Return]:
    found = []
    for x, start, last in runs:
        line = image[x].tolist()
        low = max(start - reach_px, 0)
        for peak, end in plain_pieces(line, start, last, int(background[x, start // BLOCK])):
            high = min(last + reach_px, len(line) - 1) if end > last else end
            height = line[peak] - int(background[x, peak // BLOCK])
            level = 2 * line[peak] - height
            first, low = low, end
            try:
                a, b = plain_feet(line, peak, first, high, level)
            except ValueError:
                continue
            rise = (level - 2 * line[a]) / (2 * (line[a + 1] - line[a]))
            fall = (level - 2 * line[b]) / (2 * (line[b - 1] - line[b]))
            width = b - (a + rise + fall)
            fall_of_green = plain_fall(green[x // 2].tolist(), peak, width) if len(green) else 0.0
            if width > reach_px or (len(green) and fall_of_green < 3.0):
                continue
            light = [(2 * line[v] - level, v - peak) for v in range(a + 1, b)]
            moment = sum(excess * way for excess, way in light)
            centre = peak + moment / sum(excess for excess, _ in light)
            found.append((x, centre, height, width, fall_of_green))
    return found


def lines_of(image: U8) -> U8:
    lines = margined(*image.shape)
    lines[:, : image.shape[1]] = image
    return lines


def measured(
    image: U8, background: U8, green: U8, runs: list[list[int]], reach_px: int, capacity: int
) -> list[Return]:
    length = image.shape[1]
    line, measures = np.empty(capacity, np.int64), np.empty((4, capacity))
    n = measure_runs(
        lines_of(image),
        length,
        background,
        lines_of(green) if len(green) else GREY,
        np.array(runs, np.int64).reshape(-1, 3),
        reach_px,
        3.0,
        np.empty((BATCH + length, 5), np.int64),
        line,
        measures,
    )
    rows = zip(line[:n].tolist(), *measures[:, :n].tolist(), strict=True)
    return [(x, *(0.0 if np.isnan(value) else value for value in rest)) for x, *rest in rows]


def runs_in(image: U8, background: U8) -> list[list[int]]:
    runs = []
    for x, line in enumerate(image.astype(int)):
        spread = np.repeat(background[x].astype(int), BLOCK)[: len(line)]
        edges = np.flatnonzero(np.diff(np.pad(line - spread >= LEAST, 1).astype(int)))
        runs += [[x, a, b - 1] for a, b in zip(edges[::2].tolist(), edges[1::2], strict=True)]
    return runs


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    length=st.integers(20, 330),
    widest=st.sampled_from([3.0, 12.0, 80.0]),
    noise=st.sampled_from([0.0, 3.0, 25.0]),
    reach_px=st.sampled_from([8, 40, 150]),
    coloured=st.booleans(),
)
def test_equals_its_definition(
    seed: int, length: int, widest: float, noise: float, reach_px: int, coloured: bool
) -> None:
    rng = np.random.default_rng(seed)
    n_lines, v = 6, np.arange(length)
    light = 60.0 + noise * rng.standard_normal((n_lines, length))
    for x in range(n_lines):
        for _ in range(rng.integers(1, 6)):
            place, sigma = rng.uniform(0, length), rng.uniform(0.7, widest)
            light[x] += rng.uniform(10, 260) * np.exp(-0.5 * ((v - place) / sigma) ** 2)
    image = np.clip(np.rint(light), 0, 255).astype(np.uint8)
    n_blocks = -(-length // BLOCK)
    background = rng.integers(55, 70, (n_lines, n_blocks)).astype(np.uint8)
    green = rng.integers(100, 120, (n_lines // 2, -(-length // 2))).astype(np.uint8)
    green = green if coloured else GREY
    runs = runs_in(image, background)
    expected = plain_returns(image, background, green, runs, reach_px)
    # Not nearly: the same sums in the same order.
    assert measured(image, background, green, runs, reach_px, 5000) == expected


@pytest.mark.parametrize("capacity", [1, BATCH, BATCH + 1, 3 * BATCH])
def test_of_too_many_the_first_are_kept(capacity: int) -> None:
    image = np.full((BATCH, 120), 60, np.uint8)
    for place in (20, 60, 100):
        image[:, place - 1 : place + 2] = [120, 200, 130]
    background = np.full((BATCH, 15), 60, np.uint8)
    runs = runs_in(image, background)
    every = measured(image, background, GREY, runs, 30, 4 * BATCH)
    assert len(every) == 3 * BATCH
    assert measured(image, background, GREY, runs, 30, capacity) == every[:capacity]
