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
        turned = _view_along_x(frame)
        views = {
            SearchAxis.ALONG_X: turned,
            SearchAxis.ALONG_Y: SearchView(turned.lines, turned.luma, turned.u_lines, turned.u),
        }
        return {axis: detector.detect(views[axis]) for axis, detector in self._detectors.items()}


def _view_along_x(frame: Frame) -> SearchView:
    """See the rows of the picture as search lines."""
    luma: U8Array = cv2.transpose(frame.luma)
    if frame.chroma is None:
        return SearchView(luma, frame.luma, None, None)
    # An interleaved chroma plane (NV12) has gaps between its pixels; vector loops want none.
    u_lines = np.ascontiguousarray(frame.chroma[0])
    return SearchView(luma, frame.luma, cv2.transpose(u_lines), u_lines)


def _make_detector(
    size_px: tuple[int, int],
    axis: SearchAxis,
    searches: Sequence[StripeSearch],
    options: DetectorOptions,
) -> Detector:
    width, height = size_px
    length, n_lines = (height, width) if axis is SearchAxis.ALONG_Y else (width, height)
    lowest: IntArray = np.min([search.lowest for search in searches], axis=0)
    highest: IntArray = np.max([search.highest for search in searches], axis=0)
    if isinstance(options, ThresholdOptions):
        return ThresholdDetector(length, n_lines, lowest, highest, options)
    reach_px = max(8, round(options.reach_share * width))
    return StripeDetector(length, n_lines, lowest, highest, reach_px, options)
