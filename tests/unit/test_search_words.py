"""Along rows and along columns the same is found, and eight bytes at once as one by one."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from aqualvs.scanning.byte_words import at_least, first_marked, same_in_all, without_first
from aqualvs.scanning.contrast import BLOCK
from aqualvs.scanning.ground import ColumnGround, RowGround
from aqualvs.scanning.runs import ColumnRuns, RowRuns
from aqualvs.scanning.scan import Frame
from aqualvs.scanning.search import SearchAxis
from aqualvs.scanning.view import FrameViews

U8 = NDArray[np.uint8]
CAPACITY = 5000


def blocks(image: U8) -> U8:
    """Whole blocks of columns, 255 beyond the picture."""
    rest = -image.shape[1] % BLOCK
    return np.pad(image, ((0, 0), (0, rest)), constant_values=255)


def spotted(rng: np.random.Generator, shape: tuple[int, int]) -> U8:
    """Noise with bright spots, so that there are runs of all lengths, at borders as well."""
    image = rng.integers(20, 40, shape)
    for _ in range(12):
        y, x = rng.integers(0, shape[0]), rng.integers(0, shape[1])
        image[y : y + rng.integers(1, 12), x : x + rng.integers(1, 12)] += rng.integers(10, 215)
    return image.astype(np.uint8)


@settings(deadline=None)  # the first call compiles
@given(values=st.binary(min_size=8, max_size=8), level=st.integers(0, 255))
def test_eight_bytes_are_compared_as_one_by_one(values: bytes, level: int) -> None:
    word = np.frombuffer(values, np.uint64)[0]
    # Outside compiled code a word comes back as Python's integer.
    marks = np.uint64(at_least(word, np.uint64(same_in_all(np.uint16(level)))))
    found = []
    while marks:
        found.append(int(first_marked(marks)))
        marks = np.uint64(without_first(marks))
    assert found == [k for k in range(8) if values[k] >= level]


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    length=st.integers(9, 90),
    n_lines=st.integers(1, 40),
    reach_px=st.integers(8, 26),
    least=st.integers(1, 60),
)
def test_rows_give_what_columns_give(
    seed: int, length: int, n_lines: int, reach_px: int, least: int
) -> None:
    rng = np.random.default_rng(seed)
    image = spotted(rng, (length, n_lines))
    green = spotted(rng, (-(-length // 2), -(-n_lines // 2)))
    lowest = rng.integers(0, length, n_lines)
    highest = lowest + rng.integers(-3, length, n_lines)
    found = []
    for runs_of, ground_of, turned in (
        (ColumnRuns, ColumnGround, False),
        (RowRuns, RowGround, True),
    ):
        finder = runs_of(length, lowest, highest, CAPACITY)
        ground = ground_of(length, n_lines, reach_px, 3, finder.in_band)
        picture = blocks(image.T.copy() if turned else image)
        chroma = blocks(green.T.copy() if turned else green)
        background = ground.background(picture)
        cells = ground.near_green(chroma)
        runs = finder.find(picture, background, least, cells)
        found.append((cells.T if turned else cells, ground.lines[:n_lines], runs.copy()))
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_runs_of_rows_end_with_the_picture() -> None:
    """The threshold detector has a background of its own, which knows no border."""
    image = np.full((2, 13), 10, np.uint8)
    image[0, 9:] = 200
    nowhere, everywhere = np.zeros(2, np.int64), np.full(2, 12)
    finder = RowRuns(13, nowhere, everywhere, CAPACITY)
    runs = finder.find(blocks(image), np.full((2, 2), 99, np.uint8), 1, finder.in_band)
    assert runs.tolist() == [[0, 9, 12]]


def plain_halves(plane: U8) -> tuple[U8, U8]:
    """Means of columns and of rows two by two, rounded up; an odd one stands for itself."""
    wide = plane.astype(int)
    columns = np.pad(wide, ((0, 0), (0, wide.shape[1] % 2)), "edge")
    rows = np.pad(wide, ((0, wide.shape[0] % 2), (0, 0)), "edge")
    return (
        ((columns[:, ::2] + columns[:, 1::2] + 1) // 2).astype(np.uint8),
        ((rows[::2] + rows[1::2] + 1) // 2).astype(np.uint8),
    )


@pytest.mark.parametrize("size_px", [(40, 24), (37, 23), (38, 21), (21, 46)])
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
        np.testing.assert_array_equal(view.lines, lines[:n_lines])
        u_lines = green[i].T if axis is SearchAxis.ALONG_Y else green[i]
        assert view.green_lines is not None
        np.testing.assert_array_equal(255 - view.green_lines, u_lines[: -(-n_lines // 2)])
        assert (view.image.shape[1] % BLOCK, view.image.flags.c_contiguous) == (0, True)
    np.testing.assert_array_equal((luma, u)[0], before[0])
    np.testing.assert_array_equal(u, before[1])
