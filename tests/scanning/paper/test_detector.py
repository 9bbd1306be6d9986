"""The paper's detector: every bright pixel, in runs along the search lines."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray

from aqualvs.errors import OptionError
from aqualvs.scanning.detection import FrameDetector
from aqualvs.scanning.laser_bands import LaserBand, SearchAxis
from aqualvs.scanning.paper.detector import ThresholdDetector, pixels_of_peaks
from aqualvs.scanning.scan import Frame
from aqualvs.scanning.stripe import StripePeaks, ThresholdOptions

U8 = NDArray[np.uint8]


def full_detector(
    shape: tuple[int, int],
    options: ThresholdOptions,
    band: tuple[int, int] | None = None,
    axis: SearchAxis = SearchAxis.ALONG_Y,
) -> FrameDetector:
    """Search the whole picture, or the same stretch of every search line."""
    height, width = shape
    length, n_lines = (height, width) if axis is SearchAxis.ALONG_Y else (width, height)
    low, high = band or (0, length - 1)
    free = np.zeros((-(-length // 8), -(-n_lines // 8)))
    search = LaserBand(
        axis=axis,
        line_px=1,
        lowest=np.full(n_lines, low),
        highest=np.full(n_lines, high),
        slope_low=free - 5.0,
        slope_high=free + 5.0,
    )
    return FrameDetector((width, height), [search], options)


def detect(image: U8, level: int = 140, band: tuple[int, int] | None = None) -> StripePeaks:
    detector = full_detector(image.shape, ThresholdOptions(level=level), band)
    return detector.detect(Frame(0, 0.0, image))[SearchAxis.ALONG_Y]


def test_runs_come_in_order_with_middle_width_and_peak() -> None:
    image = np.full((61, 11), 100, np.uint8)
    image[20:24, 3] = [140, 200, 190, 150]
    image[40, 3] = 141
    image[7:10, 10] = 255
    found = detect(image)
    np.testing.assert_array_equal(found.line, [3, 3, 10])
    np.testing.assert_array_equal(found.position, [21.5, 40.0, 8.0])
    np.testing.assert_array_equal(found.width, [4.0, 1.0, 3.0])
    np.testing.assert_array_equal(found.height, [200.0, 141.0, 255.0])
    np.testing.assert_array_equal(found.likelihood, np.ones(3))
    assert found.n == 3


def test_the_level_itself_is_bright_and_one_below_is_not() -> None:
    image = np.full((20, 2), 139, np.uint8)
    image[10] = [140, 139]
    np.testing.assert_array_equal(detect(image).line, [0])


def lit_pixels(lines: U8, low: int, high: int, options: ThresholdOptions) -> U8:
    """Mark the pixels that the returns are made of, once for every time they are listed."""
    n_lines, length = lines.shape
    bounds = np.full(n_lines, low), np.full(n_lines, high)
    detector = ThresholdDetector(SearchAxis.ALONG_X, (length, n_lines), *bounds, options)
    found = detector.detect(lines)
    source, place = pixels_of_peaks(found.position, found.width)
    seen = np.zeros(lines.shape, np.uint8)
    np.add.at(seen, (found.line[source], place.astype(np.int64)), 1)
    for line, position, height, width in zip(
        found.line, found.position, found.height, found.width, strict=True
    ):
        first = int(position - 0.5 * (width - 1.0))
        assert height == lines[line, first : first + int(width)].max()
    return seen


@given(
    arrays(np.uint8, array_shapes(min_dims=2, max_dims=2, max_side=24)),
    st.integers(-3, 26),
    st.integers(-3, 26),
    st.integers(1, 255),
)
def test_every_bright_pixel_of_the_band_is_listed_once_and_no_other(
    lines: U8, low: int, high: int, level: int
) -> None:
    seen = lit_pixels(lines, low, high, ThresholdOptions(level=level))
    place = np.arange(lines.shape[1])
    np.testing.assert_array_equal(seen, (lines >= level) & (place >= low) & (place <= high))


@given(arrays(np.uint8, array_shapes(min_dims=2, max_dims=2, max_side=16)), st.integers(1, 40))
def test_where_there_are_too_many_the_lowest_level_that_suits_is_used(lines: U8, most: int) -> None:
    options = ThresholdOptions(level=10, max_returns=most, max_pixels=2 * most)
    seen = lit_pixels(lines, 0, lines.shape[1], options)
    for level in range(10, 257):
        bright = np.pad(lines, ((0, 0), (1, 0))) >= level
        n_runs = np.count_nonzero(bright[:, 1:] & ~bright[:, :-1])
        if n_runs <= most and np.count_nonzero(bright) <= 2 * most:
            break
    np.testing.assert_array_equal(seen, bright[:, 1:])


def test_a_white_picture_has_no_returns() -> None:
    white = np.full((64, 64), 255, np.uint8)
    detector = full_detector((64, 64), ThresholdOptions(max_pixels=4000))
    assert detector.detect(Frame(0, 0.0, white))[SearchAxis.ALONG_Y].n == 0


def test_a_sub_pixel_return_has_the_pixels_above_half_its_height() -> None:
    source, place = pixels_of_peaks(np.array([20.4, 10.5, 7.0]), np.array([4.0, 0.5, 1.9]))
    np.testing.assert_array_equal(source, [0, 0, 0, 0, 1, 2])
    np.testing.assert_array_equal(place, [19, 20, 21, 22, 10, 7])


def test_only_the_band_is_searched() -> None:
    image = np.full((64, 5), 20, np.uint8)
    image[[10, 30, 50]] = 255
    np.testing.assert_array_equal(detect(image, band=(20, 40)).position, np.full(5, 30.0))


def test_a_second_frame_is_not_mixed_with_the_first() -> None:
    n = 9
    detector = full_detector((64, n), ThresholdOptions(level=100))
    bright = np.full((64, n), 20, np.uint8)
    bright[30] = 255
    first = detector.detect(Frame(0, 0.0, bright))[SearchAxis.ALONG_Y]
    dark = np.full((64, n), 20, np.uint8)
    assert detector.detect(Frame(1, 0.0, dark))[SearchAxis.ALONG_Y].n == 0
    np.testing.assert_array_equal(first.position, np.full(n, 30.0))


def test_rows_are_searched_where_the_stripe_stands_upright() -> None:
    image = np.full((33, 50), 10, np.uint8)
    image[:, 20:23] = 220
    detector = full_detector(image.shape, ThresholdOptions(), axis=SearchAxis.ALONG_X)
    found = detector.detect(Frame(0, 0.0, image))[SearchAxis.ALONG_X]
    np.testing.assert_array_equal(found.line, np.arange(33))
    np.testing.assert_array_equal(found.position, 21.0)


@pytest.mark.parametrize("level", [0, 256, -3])
def test_an_impossible_level_is_refused(level: int) -> None:
    with pytest.raises(OptionError, match=f"level is {level};"):
        ThresholdOptions(level=level)
