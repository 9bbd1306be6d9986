"""The paper's detector: runs of bright pixels, their middles."""

import numpy as np
import pytest
from numpy.typing import NDArray

from aqualvs.errors import OptionError
from aqualvs.scanning.detection import FrameDetector
from aqualvs.scanning.scan import Frame
from aqualvs.scanning.search import SearchAxis, StripeSearch
from aqualvs.scanning.stripe import Returns
from aqualvs.scanning.threshold import ThresholdOptions

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
    search = StripeSearch(
        axis=axis,
        line_px=1,
        lowest=np.full(n_lines, low),
        highest=np.full(n_lines, high),
        slope_low=free - 5.0,
        slope_high=free + 5.0,
    )
    return FrameDetector((width, height), [search], options)


def detect(image: U8, level: int = 140, band: tuple[int, int] | None = None) -> Returns:
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
    np.testing.assert_array_equal(found.likelihood, 1.0)
    assert len(found) == 3


def test_the_level_itself_is_bright_and_one_below_is_not() -> None:
    image = np.full((20, 2), 139, np.uint8)
    image[10] = [140, 139]
    np.testing.assert_array_equal(detect(image).line, [0])


@pytest.mark.parametrize("shape", [(1, 1), (7, 3), (8, 8), (65, 129)])
def test_every_run_of_any_picture_is_found_once(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(3).integers(0, 256, shape, dtype=np.uint8)
    bright = np.pad(image >= 200, ((1, 1), (0, 0)))
    starts = bright[1:-1] & ~bright[:-2]
    found = detect(image, level=200)
    np.testing.assert_array_equal(np.bincount(found.line, minlength=shape[1]), starts.sum(axis=0))
    assert found.width.sum() == np.count_nonzero(image >= 200)


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
    assert len(detector.detect(Frame(1, 0.0, dark))[SearchAxis.ALONG_Y]) == 0
    np.testing.assert_array_equal(first.position, np.full(n, 30.0))


def test_more_than_may_be_kept_is_dropped_without_harm() -> None:
    image = np.zeros((64, 64), np.uint8)
    image[::2] = 255
    detector = full_detector((64, 64), ThresholdOptions(max_returns=100))
    assert len(detector.detect(Frame(0, 0.0, image))[SearchAxis.ALONG_Y]) == 100


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
