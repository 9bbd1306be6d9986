"""Search lines as rows: against plain NumPy, for all sizes and layouts in memory."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from aqualvs.scanning.detection import FrameDetector, SearchLines
from aqualvs.scanning.laser_bands import SearchAxis, plan_bands
from aqualvs.scanning.scan import Frame
from aqualvs.scanning.stripe import StripeOptions
from aqualvs.simulation.scenarios import bluerov2_rig

U8 = NDArray[np.uint8]


def plain(luma: U8, axis: SearchAxis, line_px: int) -> U8:
    """Search lines as rows; pairs are averaged, and smoothed along themselves by (1, 2, 1) / 4.

    Every mean of two is rounded up.
    """
    lines = (luma if axis is SearchAxis.ALONG_X else luma.T).astype(int)
    if line_px == 1:
        return lines.astype(np.uint8)
    even = lines[: len(lines) // 2 * 2]
    pairs = (even[::2] + even[1::2] + 1) // 2
    wide = np.pad(pairs, ((0, 0), (1, 1)), mode="edge")
    smooth = ((wide[:, :-2] + wide[:, 2:] + 1) // 2 + pairs + 1) // 2
    return smooth.astype(np.uint8)


@pytest.mark.parametrize("axis", list(SearchAxis))
@pytest.mark.parametrize("line_px", [1, 2])
@pytest.mark.parametrize("size", [(64, 48), (65, 48), (64, 47), (33, 31), (2, 2), (3, 2), (2, 3)])
def test_search_lines_are_those_of_plain_numpy(
    axis: SearchAxis, line_px: int, size: tuple[int, int]
) -> None:
    width, height = size
    rng = np.random.default_rng(width + 100 * height)
    lines = SearchLines(size, axis, line_px)
    # Twice, so that nothing of the first picture is left; and what overflows a byte or a half.
    for top in (256, 2):
        luma = 255 - rng.integers(0, top, (height, width), dtype=np.uint8)
        np.testing.assert_array_equal(lines.of(luma), plain(luma, axis, line_px))


@pytest.mark.parametrize("axis", list(SearchAxis))
def test_a_border_is_as_bright_as_its_neighbour(axis: SearchAxis) -> None:
    flat = np.full((40, 60), 201, np.uint8)
    found = SearchLines((60, 40), axis, 2).of(flat)
    np.testing.assert_array_equal(found, 201)
    assert found.shape == ((20, 60) if axis is SearchAxis.ALONG_X else (30, 40))


@pytest.mark.parametrize("size", [(1280, 720), (1281, 723)])
def test_padded_rows_and_interleaved_chroma_give_the_same_returns(size: tuple[int, int]) -> None:
    rig = replace(bluerov2_rig(), size_px=size)
    width, height = size
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:height, :width]
    off = np.minimum(np.abs(y - 300.3 - 0.05 * x), np.abs(x - 640.2 + 0.1 * y))
    light = np.exp(-0.5 * (off / 3.0) ** 2)
    luma = np.rint(40.0 + 90.0 * light + rng.normal(0.0, 1.5, light.shape)).astype(np.uint8)
    rows, columns = -(-height // 2), -(-width // 2)
    u, v = (np.rint(120.0 - 30.0 * light[::2, ::2]).astype(np.uint8) for _ in range(2))
    plain_frame = Frame(0, 0.0, luma, (u, v))
    padded = rng.integers(0, 256, (height, width + 61), dtype=np.uint8)
    padded[:, :width] = luma
    nv12 = rng.integers(0, 256, (rows, columns + 9, 2), dtype=np.uint8)
    nv12[:, :columns, 0], nv12[:, :columns, 1] = u, v
    planes = padded[:, :width], nv12[:, :columns, 0], nv12[:, :columns, 1]
    for plane in planes:
        plane.flags.writeable = False
    strange_frame = Frame(0, 0.0, planes[0], planes[1:])
    detector = FrameDetector(size, plan_bands(rig, rig.camera()), StripeOptions())
    expected, found = detector.detect(plain_frame), detector.detect(strange_frame)
    assert set(found) == set(expected) == set(SearchAxis)
    for axis, peaks in found.items():
        assert peaks.n > 300
        for name in ("line", "position", "height", "width", "likelihood"):
            np.testing.assert_array_equal(getattr(peaks, name), getattr(expected[axis], name))
