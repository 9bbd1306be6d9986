"""Detection in a whole frame: one search for each direction that the lasers need."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.scanning.laser_colour import ChromaSteps, channel_image, laser_likelihood
from aqualvs.scanning.scan import Frame, ImagePlane
from aqualvs.scanning.search import SearchAxis, StripeSearch
from aqualvs.scanning.stripe import (
    HEIGHT,
    IMBALANCE,
    POSITION,
    STEP_U,
    STEP_V,
    TINT,
    WIDTH,
    PeakFinder,
    Returns,
    SearchImage,
    StripeOptions,
)
from aqualvs.scanning.threshold import ThresholdDetector, ThresholdOptions

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
        self._options = options
        seen = [search for search in searches if search.visible]
        self._colours = sorted({one.colour for one in seen}, key=lambda colour: colour.name)
        self._line_px = max((one.line_px for one in seen), default=1)
        self._bands = {
            axis: _band([one for one in seen if one.axis is axis])
            for axis in SearchAxis
            if any(one.axis is axis for one in seen)
        }
        self._finders: Mapping[SearchAxis, PeakFinder] = (
            {axis: self._finder(axis, options) for axis in self._bands}
            if isinstance(options, StripeOptions)
            else {}
        )
        half = (-(-size_px[1] // 2), -(-size_px[0] // 2))
        self._chroma: ImagePlane = np.empty((2, *half), np.uint8)
        self._no_chroma: ImagePlane = np.empty((2, 0, 0), np.uint8)

    def _finder(self, axis: SearchAxis, options: StripeOptions) -> PeakFinder:
        width, height = self._size_px
        return PeakFinder(
            width if axis is SearchAxis.ALONG_X else height,
            *self._bands[axis],
            max(8, round(options.reach_share * width)),
            options.max_returns,
            np.array([colour.value for colour in self._colours]),
        )

    def detect(self, frame: Frame) -> dict[SearchAxis, Returns]:
        """Find the returns of every search direction.

        Parameters
        ----------
        frame : Frame
            Of the size the detector was made for.

        Returns
        -------
        dict of SearchAxis to Returns
            Copies: they stay valid after the next call.

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
        if isinstance(self._options, ThresholdOptions):
            return {
                axis: ThresholdDetector(axis, self._size_px, *band, self._options).detect(
                    _search_lines(frame.luma, axis, self._line_px)
                )
                for axis, band in self._bands.items()
            }
        return self._find_stripes(frame, self._options)

    def _find_stripes(self, frame: Frame, options: StripeOptions) -> dict[SearchAxis, Returns]:
        chroma = self._no_chroma
        if frame.chroma is not None:
            chroma = self._chroma
            np.copyto(chroma[0], frame.chroma[0])
            np.copyto(chroma[1], frame.chroma[1])
        luma = _brightest([channel_image(frame, colour) for colour in self._colours])
        found = {}
        for axis, finder in self._finders.items():
            lines = _search_lines(luma, axis, self._line_px)
            along_x = axis is SearchAxis.ALONG_X
            image = SearchImage(lines, chroma[0], chroma[1], along_x, self._line_px)
            contrast = max(options.min_contrast, min(round(finder.noise_contrast(image)), 14))
            found[axis] = finder.find(image, contrast)
        line = np.concatenate([line for line, _ in found.values()] or [np.zeros(0, np.int64)])
        table = np.concatenate([table for _, table in found.values()] or [np.zeros((7, 0))], axis=1)
        likelihood = self._likelihood(table, frame.chroma is not None)
        keep = (likelihood >= options.min_likelihood) & _is_high(table[HEIGHT], options.min_share)
        returns, start = {}, 0
        for axis, (mine, _) in found.items():
            rows = np.flatnonzero(keep[start : start + len(mine)]) + start
            position, height, width = (table[k][rows] for k in (POSITION, HEIGHT, WIDTH))
            returns[axis] = Returns(line[rows], position, height, width, likelihood[rows])
            start += len(mine)
        return returns

    def _likelihood(self, table: FloatArray, has_colour: bool) -> FloatArray:
        """Return how likely each peak is laser light of any of the rig's colours."""
        if not has_colour:
            return np.ones(table.shape[1])
        steps = ChromaSteps(
            table[HEIGHT], table[STEP_U : STEP_V + 1], table[IMBALANCE], table[TINT]
        )
        return np.max([laser_likelihood(steps, colour) for colour in self._colours], axis=0)


def _band(searches: Sequence[StripeSearch]) -> tuple[IntArray, IntArray]:
    """Return the first and the last position (n_lines,) of any of the lasers."""
    lowest: IntArray = np.min([search.lowest for search in searches], axis=0)
    highest: IntArray = np.max([search.highest for search in searches], axis=0)
    return lowest, highest


def _brightest(channels: Sequence[ImagePlane]) -> ImagePlane:
    image = channels[0]
    for channel in channels[1:]:
        image = np.maximum(image, channel)
    return image


def _search_lines(luma: ImagePlane, axis: SearchAxis, line_px: int) -> ImagePlane:
    """Return the search lines of a picture as rows, shape (n_lines, length).

    In wide pictures a search line is the mean of two rows or columns, and smoothed along itself: a
    stripe can be a pixel or two thin there, its centre then locked to the pixels.
    """
    height, width = luma.shape
    along_x = axis is SearchAxis.ALONG_X
    lines = luma
    if line_px == 2:
        across = (width, height // 2) if along_x else (width // 2, height)
        even = luma[: across[1] * 2] if along_x else luma[:, : across[0] * 2]
        lines = np.asarray(cv2.resize(even, across, interpolation=cv2.INTER_AREA), np.uint8)
    lines = np.ascontiguousarray(lines) if along_x else np.asarray(cv2.transpose(lines), np.uint8)
    if line_px == 2:
        lines = np.asarray(cv2.GaussianBlur(lines, (3, 1), 0.0), np.uint8)
    return lines if lines.flags.writeable else lines.copy()


def _is_high(height: FloatArray, share: float) -> BoolArray:
    """Mark the peaks of at least `share` of the 90 % quantile of heights."""
    if not len(height):
        return np.zeros(0, np.bool_)
    return height >= share * float(np.quantile(height, 0.9))
