"""Detection in a whole frame: one detector for each search direction that the lasers need."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from aqualvs.geometry.arrays import IntArray
from aqualvs.scanning.scan import Frame
from aqualvs.scanning.search import SearchAxis, StripeSearch
from aqualvs.scanning.stripe import Returns, StripeDetector, StripeOptions
from aqualvs.scanning.threshold import ThresholdDetector, ThresholdOptions
from aqualvs.scanning.view import FrameViews, SearchView


class Detector(Protocol):
    """Finds returns along the columns of a search image."""

    def detect(self, view: SearchView) -> Returns:
        """Return what was found in one frame."""


DetectorOptions = StripeOptions | ThresholdOptions


class _OnView:
    """The threshold detector, given a search view without its margin."""

    def __init__(self, detector: ThresholdDetector, length: int) -> None:
        self._detector, self._length = detector, length

    def detect(self, view: SearchView) -> Returns:
        return self._detector.detect(view.lines[:, : self._length])


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
        self._views = FrameViews(size_px, max((search.line_px for search in searches), default=1))
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
            If the frame has another size, or is not of 8 bits.
        """
        if frame.luma.dtype != np.uint8:
            raise ValueError(f"frame holds {frame.luma.dtype} but expected uint8")
        height, width = frame.luma.shape
        if (width, height) != self._size_px:
            raise ValueError(f"frame is {width} x {height} but the rig's image is {self._size_px}")
        views = self._views.of(frame)
        return {axis: detector.detect(views[axis]) for axis, detector in self._detectors.items()}


def _make_detector(
    size_px: tuple[int, int],
    axis: SearchAxis,
    searches: Sequence[StripeSearch],
    options: DetectorOptions,
) -> Detector:
    lowest: IntArray = np.min([search.lowest for search in searches], axis=0)
    highest: IntArray = np.max([search.highest for search in searches], axis=0)
    if isinstance(options, ThresholdOptions):
        length = size_px[0] if axis is SearchAxis.ALONG_X else size_px[1]
        return _OnView(ThresholdDetector(axis, size_px, lowest, highest, options), length)
    return StripeDetector(axis, size_px, lowest, highest, options)
