"""What continues a line, and how seldom other things do."""

import math

import numpy as np
import pytest

from aqualvs.scanning.laser_bands import LaserBand, SearchAxis
from aqualvs.scanning.laser_colour import LaserColour
from aqualvs.scanning.stripe import StripePeaks
from aqualvs.scanning.stripe_continuation import continued as continued
from aqualvs.scanning.stripe_segments import FIRST_X, FIRST_Y, LAST_X, LAST_Y, LENGTH, WIDTH
from aqualvs.scanning.stripe_segments import StripeSegments as StripeSegments

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
    keep, _ = continued(found, np.array(log_odds), 0.0, 10.0, SIZE)
    return list(np.flatnonzero(keep))


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
    keep, line = continued([found], np.array([3.0, -1.0, 3.0, 3.0]), 0.0, 10.0, SIZE)
    assert keep.all()
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
        keep, _ = continued([found], log_odds, 0.0, 10.0, SIZE)
        n_added += int(np.count_nonzero(keep)) - 1
    # Two ends, a hundredth over k for the k-th likeliest of those that run alike, and what goes on
    # from there. A third of all run alike: 1 + 1/2 + ... + 1/70 is 4.8. Three sigmas of a count.
    expected = 2 * 0.01 * 4.8 * n_pictures
    assert n_added < expected + 3.0 * math.sqrt(expected)
