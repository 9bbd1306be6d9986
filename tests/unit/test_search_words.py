"""Search lines: sixty-four bytes at once as one by one, cells and runs as they are defined."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray
from aqualvs.geometry.compiled import kernel
from aqualvs.scanning.contrast import BLOCK, BackgroundWorkspace, flank_background
from aqualvs.scanning.ground import Ground
from aqualvs.scanning.lanes import (
    LANES,
    first_mark,
    highest_of,
    last_mark,
    lowest_of_eights,
    margined,
    marks_above,
    marks_at_least,
    marks_in_valleys,
    marks_where_falling,
    marks_where_rising,
    n_marks,
)
from aqualvs.scanning.runs import Runs
from aqualvs.scanning.scan import Frame
from aqualvs.scanning.search import SearchAxis
from aqualvs.scanning.view import FrameViews

U8 = NDArray[np.uint8]
CAPACITY = 5000


def lines_of(image: U8) -> U8:
    """Rows of whole lanes, 255 beyond the image."""
    lines = margined(*image.shape)
    lines[:, : image.shape[1]] = image
    return lines


def spotted(rng: np.random.Generator, shape: tuple[int, int]) -> U8:
    """Noise with bright spots, so that there are runs of all lengths, at borders as well."""
    image = rng.integers(20, 40, shape)
    for _ in range(12):
        y, x = rng.integers(0, shape[0]), rng.integers(0, shape[1])
        image[y : y + rng.integers(1, 12), x : x + rng.integers(1, 12)] += rng.integers(10, 215)
    return image.astype(np.uint8)


@kernel
def all_marks(
    rows: U8, at: int, level: int, floors: U8, least: int, marks: np.uint64
) -> tuple[np.uint64, np.uint64, np.uint64, np.uint64, int]:
    return (
        marks_at_least(rows, at, np.uint8(level)),
        marks_above(rows, at, floors, 3, np.uint8(least)),
        marks_where_rising(rows, at),
        marks_where_falling(rows, at),
        highest_of(rows, at, marks),
    )


@kernel
def ends_of(marks: np.uint64) -> tuple[int, int, int]:
    return first_mark(marks), last_mark(marks), n_marks(marks)


def word(marks: NDArray[np.bool_]) -> int:
    return sum(1 << k for k in range(LANES) if marks[k])


@settings(deadline=None)  # the first call compiles
@given(
    seed=st.integers(0, 2**32 - 1),
    spread=st.sampled_from([3, 256]),
    at=st.integers(-LANES, LANES - 1),
    least=st.integers(1, 255),
    marks=st.integers(0, 2**64 - 1),
)
def test_sixty_four_bytes_are_marked_as_one_by_one(
    seed: int, spread: int, at: int, least: int, marks: int
) -> None:
    rng = np.random.default_rng(seed)
    rows = margined(1, LANES)
    rows[0] = rng.integers(0, spread, LANES)
    floors = rng.integers(0, spread, 11).astype(np.uint8)
    level = int(rng.integers(0, spread))
    around = np.concatenate([np.full(LANES, 255), rows[0], np.full(LANES, 255)]).astype(int)
    values = around[LANES + at : LANES + at + LANES]
    following = np.append(values, 255)[1:] if at == LANES - 1 else around[LANES + at + 1 :][:LANES]
    found = all_marks(rows, at, level, floors, least, np.uint64(marks))
    chosen = np.array([bool(marks >> k & 1) for k in range(LANES)])
    assert [int(value) for value in found] == [
        word(values >= level),
        word(values - np.repeat(floors[3:].astype(int), BLOCK) >= least),
        word(following > values),
        word(following < values),
        max([0, *values[chosen]]),
    ]


@settings(deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    spread=st.sampled_from([3, 40, 256]),
    marks=st.integers(0, 2**64 - 1),
    base=st.integers(0, 255),
)
def test_lowest_and_valleys_are_found_as_one_by_one(
    seed: int, spread: int, marks: int, base: int
) -> None:
    rows = margined(1, LANES)
    rows[0, :LANES] = np.random.default_rng(seed).integers(0, spread, LANES)
    values = rows[0, :LANES].astype(int)
    lowest = int(lowest_of_eights(rows, 0)).to_bytes(8, "little")
    assert list(lowest) == values.reshape(-1, 8).min(axis=1).tolist()
    chosen = [k for k in range(LANES) if marks >> k & 1]
    valleys = 0
    for k in chosen:
        before = max(values[i] for i in chosen if i <= k)
        after = max(values[i] for i in chosen if i >= k)
        if 10 * (values[k] - base) < 6 * (min(before, after) - base):
            valleys |= 1 << k
    found = marks_in_valleys(rows, 0, np.uint64(marks), np.uint8(base), np.uint16(6))
    assert int(found) == valleys


@pytest.mark.parametrize("marks", [0, 1, 1 << 63, 0b10110 << 20, 2**64 - 1])
def test_marks_are_counted_from_the_first_byte(marks: int) -> None:
    first = (marks & -marks).bit_length() - 1 if marks else LANES
    assert ends_of(np.uint64(marks)) == (first, marks.bit_length() - 1, marks.bit_count())


def marked(words: NDArray[np.uint64]) -> BoolArray:
    """One truth a position."""
    return np.unpackbits(words.view(np.uint8), axis=1, bitorder="little").astype(np.bool_)


def plain_cells(
    green: U8, reach_px: int, least: int, lowest: NDArray[np.int64], highest: NDArray[np.int64]
) -> BoolArray:
    """Cells that a band reaches and that have green in them or in a neighbour along the line."""
    n_lines, length = len(lowest), 2 * green.shape[1]
    workspace = BackgroundWorkspace(*green.shape, reach_px)
    background = flank_background(lines_of(green), workspace)
    spread = np.repeat(background, BLOCK, axis=1)[:, : green.shape[1]].astype(int)
    is_green = green.astype(int) - spread >= least
    shape = (-(-n_lines // 8), -(-length // BLOCK))
    own, band = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    for y, x in zip(*np.nonzero(is_green), strict=True):
        own[y // 4, x // 4] = True
    for x in range(n_lines):
        if lowest[x] <= highest[x]:
            band[x // 8, lowest[x] // BLOCK : highest[x] // BLOCK + 1] = True
    padded = np.pad(own, ((0, 0), (1, 1)))
    return band & (padded[:, :-2] | padded[:, 1:-1] | padded[:, 2:])


def plain_runs(
    image: U8,
    background: U8,
    least: int,
    cells: BoolArray,
    lowest: NDArray[np.int64],
    highest: NDArray[np.int64],
) -> list[list[int]]:
    runs = []
    for x, line in enumerate(image.astype(int)):
        above = [
            cells[x // 8, v // BLOCK] and line[v] - int(background[x, v // BLOCK]) >= least
            for v in range(len(line))
        ]
        start = None
        for v, is_above in enumerate([*above, False]):
            if is_above and start is None:
                start = v
            elif not is_above and start is not None:
                if start <= highest[x] and v - 1 >= lowest[x]:
                    runs.append([x, start, v - 1])
                start = None
    return runs


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    length=st.integers(9, 150),
    n_lines=st.integers(1, 40),
    reach_px=st.integers(8, 26),
    least=st.integers(1, 60),
)
def test_cells_and_runs_are_what_their_definitions_say(
    seed: int, length: int, n_lines: int, reach_px: int, least: int
) -> None:
    rng = np.random.default_rng(seed)
    image = spotted(rng, (n_lines, length))
    green = spotted(rng, (-(-n_lines // 2), -(-length // 2)))
    lowest = rng.integers(0, length, n_lines)
    highest = np.minimum(lowest + rng.integers(-3, length, n_lines), length - 1)
    finder = Runs(length, lowest, highest, CAPACITY)
    ground = Ground(length, n_lines, reach_px, 3, finder.in_band)
    background = ground.background(lines_of(image))
    words = ground.near_green(lines_of(green))
    cells = plain_cells(green, -(-reach_px // 2), 3, lowest, highest)
    expected = np.repeat(cells, BLOCK, axis=1)[:, :length]
    np.testing.assert_array_equal(marked(words)[:, :length], expected)
    assert not marked(words)[:, length:].any()
    runs = finder.find(lines_of(image), background, least, words)
    assert runs.tolist() == plain_runs(image, background, least, cells, lowest, highest)


def test_runs_end_with_the_picture() -> None:
    """The threshold detector has a background of its own, which knows no border."""
    image = np.full((2, 13), 10, np.uint8)
    image[0, 9:] = 200
    nowhere, everywhere = np.zeros(2, np.int64), np.full(2, 12)
    finder = Runs(13, nowhere, everywhere, CAPACITY)
    below = np.full((2, LANES // BLOCK), 99, np.uint8)
    runs = finder.find(lines_of(image), below, 1, finder.in_band)
    assert runs.tolist() == [[0, 9, 12]]


def test_a_run_may_be_longer_than_a_word() -> None:
    image = np.full((1, 300), 10, np.uint8)
    image[0, 20:280] = 200
    finder = Runs(300, np.zeros(1, np.int64), np.full(1, 299), CAPACITY)
    below = np.full((1, 5 * LANES // BLOCK), 99, np.uint8)
    runs = finder.find(lines_of(image), below, 1, finder.in_band)
    assert runs.tolist() == [[0, 20, 279]]


def plain_halves(plane: U8) -> tuple[U8, U8]:
    """Means of columns and of rows two by two, rounded up; an odd one stands for itself."""
    wide = plane.astype(int)
    columns = np.pad(wide, ((0, 0), (0, wide.shape[1] % 2)), "edge")
    rows = np.pad(wide, ((0, wide.shape[0] % 2), (0, 0)), "edge")
    return (
        ((columns[:, ::2] + columns[:, 1::2] + 1) // 2).astype(np.uint8),
        ((rows[::2] + rows[1::2] + 1) // 2).astype(np.uint8),
    )


@pytest.mark.parametrize("size_px", [(40, 24), (37, 23), (131, 70), (21, 146)])
@pytest.mark.parametrize("line_px", [1, 2])
@pytest.mark.parametrize("kind", ["tight", "padded", "interleaved"])
def test_views_are_the_means_of_the_planes(
    size_px: tuple[int, int], line_px: int, kind: str
) -> None:
    width, height = size_px
    rng = np.random.default_rng(3)
    chroma_shape = (-(-height // 2), -(-width // 2))
    luma = rng.integers(0, 256, (height, width + 7), dtype=np.uint8)[:, :width]
    u = rng.integers(0, 256, (chroma_shape[0], 2 * chroma_shape[1] + 3), dtype=np.uint8)
    u = u[:, : 2 * chroma_shape[1] : 2] if kind == "interleaved" else u[:, : chroma_shape[1]]
    if kind == "tight":
        luma, u = luma.copy(), u.copy()
    before = luma.copy(), u.copy()
    views = FrameViews(size_px, line_px).of(Frame(0, 0.0, luma, (u, u)))
    expected = plain_halves(luma) if line_px == 2 else (luma, luma)
    green = plain_halves(u) if line_px == 2 else (u, u)
    for i, axis in enumerate((SearchAxis.ALONG_Y, SearchAxis.ALONG_X)):
        view, n_lines = views[axis], size_px[i] // line_px
        lines = expected[i].T if axis is SearchAxis.ALONG_Y else expected[i]
        length = lines.shape[1]
        np.testing.assert_array_equal(view.lines[:, :length], lines[:n_lines])
        u_lines = green[i].T if axis is SearchAxis.ALONG_Y else green[i]
        assert view.green is not None
        half = u_lines.shape[1]
        np.testing.assert_array_equal(255 - view.green[:, :half], u_lines[: -(-n_lines // 2)])
        for rows, used in ((view.lines, length), (view.green, half)):
            assert (rows.shape[1] % LANES, rows.flags.c_contiguous) == (0, True)
            np.testing.assert_array_equal(rows[:, used:], 255)
    np.testing.assert_array_equal((luma, u)[0], before[0])
    np.testing.assert_array_equal(u, before[1])
