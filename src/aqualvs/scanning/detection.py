"""Detection in a whole frame: one detector for each search direction that the lasers need."""

from collections.abc import Sequence
from typing import Protocol

import cv2
import numpy as np

from aqualvs.geometry.arrays import IntArray
from aqualvs.scanning.contrast import U8Array
from aqualvs.scanning.scan import Frame
from aqualvs.scanning.search import SearchAxis, StripeSearch
from aqualvs.scanning.stripe import Returns, SearchView, StripeDetector, StripeOptions
from aqualvs.scanning.threshold import ThresholdDetector, ThresholdOptions


class Detector(Protocol):
    """Finds returns along the columns of a search image."""

    def detect(self, view: SearchView) -> Returns:
        """Return what was found in one frame."""


DetectorOptions = StripeOptions | ThresholdOptions


class FrameDetector:
    """Detects stripes in frames of one size, within the bands of all lasers.

    Parameters
    ----------
    size_px : (int, int)
        Image width and height.
    searches : sequence of StripeSearch
        One for each laser.
    options : StripeOptions or ThresholdOptions
        Which detector, and how.
    """

    def __init__(
        self,
        size_px: tuple[int, int],
        searches: Sequence[StripeSearch],
        options: DetectorOptions,
    ) -> None:
        self._size_px = size_px
        self._line_px = searches[0].line_px if searches else 1
        self._detectors: dict[SearchAxis, Detector] = {}
        for axis in SearchAxis:
            mine = [search for search in searches if search.axis is axis and search.visible]
            if mine:
                self._detectors[axis] = _make_detector(size_px, axis, mine, options)

    def detect(self, frame: Frame) -> dict[SearchAxis, Returns]:
        """Find the returns of every search direction.

        Parameters
        ----------
        frame : Frame
            Of the size the detector was made for.

        Raises
        ------
        ValueError
            If the frame has another size.
        """
        height, width = frame.luma.shape
        if (width, height) != self._size_px:
            raise ValueError(f"frame is {width} x {height} but the rig's image is {self._size_px}")
        rows = _view(frame, SearchAxis.ALONG_X, self._line_px)
        columns = rows.turned() if self._line_px == 1 else None
        found: dict[SearchAxis, Returns] = {}
        for axis, detector in self._detectors.items():
            if axis is SearchAxis.ALONG_X:
                found[axis] = detector.detect(rows)
            else:
                found[axis] = detector.detect(columns or _view(frame, axis, self._line_px))
        return found


def _view(frame: Frame, axis: SearchAxis, line_px: int) -> SearchView:
    """See the frame with its rows (searches along x) or columns as search lines."""
    height, width = frame.luma.shape
    n_lines = (height if axis is SearchAxis.ALONG_X else width) // line_px
    luma, luma_lines = _both_ways(frame.luma, axis, n_lines, line_px)
    if frame.chroma is None:
        return SearchView(luma, luma_lines, None, None)
    # An interleaved chroma plane (NV12) has gaps between its pixels; vector loops want none.
    u_plane = np.ascontiguousarray(frame.chroma[0])
    u, u_lines = _both_ways(u_plane, axis, -(-n_lines // 2), line_px)
    return SearchView(luma, luma_lines, u, u_lines)


def _both_ways(
    image: U8Array, axis: SearchAxis, n_lines: int, line_px: int
) -> tuple[U8Array, U8Array]:
    """Return the image with its search lines as columns, and as rows."""
    along_x = axis is SearchAxis.ALONG_X
    if line_px > 1:
        height, width = image.shape
        # A last line that is not whole is left out; chroma may have a line more than its half.
        used = min(n_lines * line_px, height if along_x else width)
        whole = image[:used] if along_x else image[:, :used]
        size = (width, n_lines) if along_x else (n_lines, height)
        image = cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
    turned: U8Array = cv2.transpose(image)
    return (turned, image) if along_x else (image, turned)


def _make_detector(
    size_px: tuple[int, int],
    axis: SearchAxis,
    searches: Sequence[StripeSearch],
    options: DetectorOptions,
) -> Detector:
    width, height = size_px
    length = height if axis is SearchAxis.ALONG_Y else width
    lowest: IntArray = np.min([search.lowest for search in searches], axis=0)
    highest: IntArray = np.max([search.highest for search in searches], axis=0)
    if isinstance(options, ThresholdOptions):
        return ThresholdDetector(length, len(lowest), lowest, highest, options)
    reach_px = max(8, round(options.reach_share * width))
    return StripeDetector(length, len(lowest), lowest, highest, reach_px, options)
