"""Local contrast: what stands above both flanks, and nothing else."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from aqualvs.scanning.contrast import BLOCK, BackgroundWorkspace, flank_background
from aqualvs.scanning.lanes import margined

U8 = NDArray[np.uint8]
REACH_PX = 24


def lines_of(image: U8) -> U8:
    """The columns of an image as search lines: rows of whole lanes, 255 beyond the image."""
    lines = margined(image.shape[1], len(image))
    lines[:, : len(image)] = image.T
    return lines


def contrast_of(image: U8, min_contrast: int = 1, reach_px: int = REACH_PX) -> U8:
    """What stands above the background by at least so much, as the detector sees it."""
    length, n_lines = image.shape
    background = flank_background(lines_of(image), BackgroundWorkspace(n_lines, length, reach_px))
    spread = np.repeat(background, BLOCK, axis=1)[:, :length].T.astype(int)
    height = image.astype(int) - spread
    return np.where(height >= min_contrast, height, 0).astype(np.uint8)


def plain_contrast(image: U8, min_contrast: int, reach_px: int) -> U8:
    """Return the contrast as the module's docstring defines it, pixel by pixel."""
    n_blocks = -(-reach_px // BLOCK)
    length, n_lines = image.shape
    out = np.zeros_like(image)
    for v in range(length):
        first = v // BLOCK
        for x in range(n_lines):
            flanks = []
            for blocks in (
                range(first - n_blocks, first),
                range(first + 1, first + 1 + n_blocks),
            ):
                # A flank beyond the border is as good as white.
                seen = [image[b * BLOCK : (b + 1) * BLOCK, x] for b in blocks if b >= 0]
                flanks.append(min([255, *(int(s.min()) for s in seen if len(s))]))
            height = int(image[v, x]) - max(flanks)
            out[v, x] = height if height >= min_contrast else 0
    return out


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    length=st.integers(1, 70),
    n_lines=st.integers(1, 19),
    reach_px=st.integers(1, 30),
    min_contrast=st.integers(1, 254),
)
def test_equals_its_definition(
    seed: int, length: int, n_lines: int, reach_px: int, min_contrast: int
) -> None:
    image = np.random.default_rng(seed).integers(0, 256, (length, n_lines), dtype=np.uint8)
    found = contrast_of(image, min_contrast, reach_px)
    np.testing.assert_array_equal(found, plain_contrast(image, min_contrast, reach_px))


@pytest.mark.parametrize("level", [0, 1, 128, 255])
def test_an_even_picture_has_none(level: int) -> None:
    assert not contrast_of(np.full((100, 13), level, np.uint8)).any()


@pytest.mark.parametrize("at", range(40, 48))
@pytest.mark.parametrize("rising", [True, False])
def test_a_step_has_none(at: int, rising: bool) -> None:
    image = np.zeros((100, 9), np.uint8)
    image[at:] = 200
    assert not contrast_of(image if rising else image[::-1].copy()).any()


def test_a_stripe_along_the_search_line_has_none() -> None:
    image = np.full((100, 20), 30, np.uint8)
    image[:, 8:12] = 250
    assert not contrast_of(image).any()


@pytest.mark.parametrize("at", range(BLOCK))
def test_a_stripe_has_its_height_wherever_the_blocks_begin(at: int) -> None:
    image = np.full((104, 9), 60, np.uint8)
    image[48 + at : 51 + at] = 160
    found = contrast_of(image)
    np.testing.assert_array_equal(found[48 + at : 51 + at], 100)
    assert np.count_nonzero(found) == 3 * 9


def test_white_on_nearly_white_does_not_wrap() -> None:
    image = np.full((104, 9), 250, np.uint8)
    image[50] = 255
    image[60] = 5
    found = contrast_of(image)
    np.testing.assert_array_equal(found[50], 5)
    assert not found[60].any()


def test_what_is_low_is_cut_and_what_reaches_the_bound_is_kept() -> None:
    image = np.full((104, 2), 100, np.uint8)
    image[50] = [111, 112]
    np.testing.assert_array_equal(contrast_of(image, min_contrast=12)[50], [0, 12])


def test_nothing_stands_out_beside_a_border() -> None:
    image = np.full((104, 9), 20, np.uint8)
    image[:4] = 220
    image[-4:] = 220
    assert not contrast_of(image).any()


def test_a_workspace_keeps_nothing_of_the_frame_before() -> None:
    rng = np.random.default_rng(5)
    workspace = BackgroundWorkspace(21, 93, REACH_PX)
    for _ in range(4):
        lines = lines_of(rng.integers(0, 256, (93, 21), dtype=np.uint8))
        fresh = flank_background(lines, BackgroundWorkspace(21, 93, REACH_PX))
        np.testing.assert_array_equal(flank_background(lines, workspace), fresh)
