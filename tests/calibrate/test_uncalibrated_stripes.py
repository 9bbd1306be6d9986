"""What continues a line, and how seldom other things do."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from aqualvs.calibrate.uncalibrated_stripes import continued
from aqualvs.scanning.laser_bands import LaserBand, SearchAxis
from aqualvs.scanning.laser_colour import LaserColour
from aqualvs.scanning.stripe import StripePeaks
from aqualvs.scanning.stripe_segments import (
    FIRST_X,
    FIRST_Y,
    LAST_X,
    LAST_Y,
    LENGTH,
    WIDTH,
    StripeSegments,
    place_evidence,
)

SIZE = (320, 240)
# x of the first and of the last peak, y of the first, and slope.
Piece = tuple[float, float, float, float]


def pieces(
    of: list[Piece], axis: SearchAxis = SearchAxis.ALONG_Y, noise_px: float = 0.2
) -> StripeSegments:
    """Straight pieces, a peak every pixel; x and y change places for searches along x."""
    rng = np.random.default_rng(1)
    line, position, start = [], [], [0]
    table = np.zeros((12, len(of)))
    for k, (first, last, y, slope) in enumerate(of):
        x = np.arange(round(first), round(last) + 1)
        line.append(x)
        position.append(y + slope * (x - x[0]) + noise_px * rng.standard_normal(len(x)))
        start.append(start[-1] + len(x))
        table[LENGTH, k] = math.hypot(x[-1] - x[0], slope * (x[-1] - x[0]))
        table[[FIRST_X, LAST_X], k] = x[0], x[-1]
        table[[FIRST_Y, LAST_Y], k] = y, y + slope * (x[-1] - x[0])
        table[WIDTH, k] = 2.0
    n = start[-1]
    peaks = StripePeaks(
        np.concatenate(line), np.concatenate(position), *np.full((4, n), [[20.0], [2.0], [1], [0]])
    )
    none = np.zeros(0, np.int64)
    search = LaserBand(axis, 1, none, none, np.zeros((0, 0)), np.zeros((0, 0)), LaserColour.of(532))
    return StripeSegments(search, peaks, np.arange(n), np.array(start), table)


def added(found: list[StripeSegments], log_odds: list[float]) -> list[int]:
    line = continued(found, np.array(log_odds), 0.0, 10.0, SIZE)
    return list(np.flatnonzero(line >= 0))


@pytest.mark.parametrize("axis", list(SearchAxis))
def test_a_less_likely_piece_continues_a_line_straight_on(axis: SearchAxis) -> None:
    of = [(40, 100, 80.0, 0.1), (112, 125, 87.2, 0.1)]
    assert added([pieces(of, axis)], [3.0, -1.5]) == [0, 1]
    # By itself it is no line, nor one that is far too unlikely.
    assert added([pieces(of, axis)], [-1.0, -1.5]) == []
    assert added([pieces(of, axis)], [3.0, -2.5]) == [0]


def test_a_short_piece_counts_where_it_continues_a_line() -> None:
    found = pieces([(40, 100, 80.0, 0.0), (104, 109, 80.0, 0.0), (40, 45, 160.0, 0.0)])
    assert added([found], [3.0, 2.0, 2.0]) == [0, 1]


def test_pieces_in_a_row_are_one_line() -> None:
    found = pieces([(40, 70, 80, 0.0), (74, 84, 80, 0), (88, 120, 80, 0), (40, 120, 160, 0)])
    line = continued([found], np.array([3.0, -1.0, 3.0, 3.0]), 0.0, 10.0, SIZE)
    assert (line >= 0).all()
    assert line[0] == line[1] == line[2] != line[3]


@pytest.mark.parametrize(
    "other",
    [(104, 117, 88.0, 0.0), (104, 117, 80.0, 0.45), (90, 103, 80.5, 0.0)],
    ids=["beside", "across", "along"],
)
def test_what_lies_elsewhere_continues_no_line(other: Piece) -> None:
    assert added([pieces([(40, 100, 80.0, 0.0), other])], [3.0, -1.0]) == [0]


def test_among_many_like_it_a_piece_continues_a_line_only_from_nearby() -> None:
    """What is certain to be met by chance tells nothing."""
    rng = np.random.default_rng(2)
    others = [(x, x + 13, y, 0.0) for x, y in rng.uniform((0, 120), (300, 240), (100, 2))]
    far, near = (140, 153, 80.0, 0.0), (102, 115, 80.0, 0.0)
    log_odds = [3.0, -1.5] + [-1.0] * 100
    line = (40, 100, 80.0, 0.0)
    assert added([pieces([line, far])], log_odds[:2]) == [0, 1]
    assert added([pieces([line, far, *others])], log_odds) == [0]
    assert added([pieces([line, near, *others])], log_odds) == [0, 1]


@pytest.mark.parametrize("n_others", [30, 200])
def test_other_things_continue_a_line_as_seldom_as_stated(n_others: int) -> None:
    rng = np.random.default_rng(3)
    n_pictures, n_added = 6000 // n_others, 0
    for _ in range(n_pictures):
        x, y = rng.uniform((0.0, 10.0), (SIZE[0] - 10.0, SIZE[1] - 10.0), (n_others, 2)).T
        slope = rng.uniform(-0.9, 0.9, n_others)
        others = [(a, a + 8, b, c) for a, b, c in zip(x, y, slope, strict=True)]
        log_odds = np.concatenate([[3.0], rng.uniform(-2.0, 0.0, n_others)])
        found = pieces([(130, 190, 120.0, 0.0), *others])
        line = continued([found], log_odds, 0.0, 10.0, SIZE)
        n_added += int(np.count_nonzero(line >= 0)) - 1
    # Two ends, a hundredth over k for the k-th likeliest of those that run alike, and what goes on
    # from there. A third of all run alike: 1 + 1/2 + ... + 1/70 is 4.8. Three sigmas of a count.
    expected = 2 * 0.01 * 4.8 * n_pictures
    assert n_added < expected + 3.0 * math.sqrt(expected)


def table_of(middle: NDArray[np.float64], angle: NDArray[np.float64]) -> NDArray[np.float64]:
    table = np.zeros((12, len(angle)))
    half = 10.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    table[[FIRST_X, FIRST_Y]], table[[LAST_X, LAST_Y]] = (middle - half).T, (middle + half).T
    table[LENGTH] = 20.0
    return table


def test_where_the_lines_of_a_picture_lie_is_evidence() -> None:
    rng = np.random.default_rng(4)
    n_lines, n_others = 10, 200
    at = np.stack([rng.uniform(0, 320, n_lines), rng.normal(100.0, 3.0, n_lines)], axis=-1)
    others = rng.uniform((0, 0), SIZE, (n_others, 2))
    asked = np.array([[150.0, 102.0], [150.0, 102.0], [150.0, 200.0]])
    table = table_of(
        np.concatenate([asked, at, others]),
        np.concatenate([[0.0, 1.2, 0.0], rng.normal(0.0, 0.05, n_lines), rng.uniform(0, 3, 200)]),
    )
    log_odds = np.concatenate([[0.5] * 3, np.full(n_lines, 3.0), np.full(n_others, -3.0)])
    along, across, below = place_evidence(table, log_odds, SIZE[0])[:3]
    assert along > 2.0
    # Lines may lie elsewhere: as five unknown ones of fifteen.
    assert across == pytest.approx(math.log(5.0 / 15.0), abs=0.1)
    assert below == pytest.approx(math.log(5.0 / 15.0), abs=0.1)


def test_without_certain_lines_places_tell_nothing() -> None:
    rng = np.random.default_rng(5)
    table = table_of(rng.uniform((0, 0), SIZE, (50, 2)), rng.uniform(0, 3, 50))
    assert place_evidence(table, np.full(50, 1.0), SIZE[0]) == pytest.approx(0.0, abs=1e-9)


def test_one_certain_line_rules_out_little() -> None:
    """Lasers that cross: one was seen well, the other not."""
    rng = np.random.default_rng(6)
    table = table_of(np.full((102, 2), 100.0), np.concatenate([[0.0, 1.5], rng.uniform(0, 3, 100)]))
    log_odds = np.concatenate([[3.0, 0.5], np.full(100, -3.0)])
    assert place_evidence(table, log_odds, SIZE[0])[1] > math.log(5.0 / 6.0) - 0.01


def test_lines_that_lie_as_other_things_do_tell_nothing() -> None:
    rng = np.random.default_rng(7)
    table = table_of(rng.uniform((0, 0), SIZE, (2000, 2)), rng.uniform(0, math.pi, 2000))
    log_odds = np.where(np.arange(2000) % 2 == 0, 3.0, -3.0)
    # Each density is the mean of some twenty neighbours, a third of them.
    assert np.abs(np.median(place_evidence(table, log_odds, SIZE[0]))) < 0.2
