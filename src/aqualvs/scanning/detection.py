"""Stripe detection in a whole frame: one search for each direction of the lasers' stripes.

`SearchLines` makes the search images, in which search lines are rows; `FrameDetector` finds the
peaks in them within the lasers' bands.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from aqualvs.errors import FrameError
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray, U8Array
from aqualvs.geometry.compiled import inline_kernel, inner_kernel, kernel, lazy_kernel
from aqualvs.geometry.linear_algebra import flatnonzero, hypot, lower_quantile, take
from aqualvs.optics.shutter import FIRST_ROW, Field
from aqualvs.scanning.laser_bands import LaserBand, SearchAxis
from aqualvs.scanning.laser_colour import (
    HIGHEST_USEFUL,
    RATIO_MIN,
    Paint,
    channel_image,
    expected_colour,
    laser_likelihood,
    learn_colour,
    learn_paint,
    useful_height,
)
from aqualvs.scanning.scan import Frame, without_neutral_chroma
from aqualvs.scanning.segments import in_a_row
from aqualvs.scanning.stripe import (
    HEIGHT,
    N_MEASURES,
    POSITION,
    PULL,
    STEP_U,
    STEP_V,
    PeakFinder,
    SearchImage,
    StripeOptions,
    StripePeaks,
    ThresholdOptions,
)

if TYPE_CHECKING:
    from aqualvs.scanning.paper.detector import ThresholdDetector


class SearchLines:
    """Search lines of pictures of one size, as rows; buffers are allocated once.

    In wide pictures a search line is the mean of two rows or columns, smoothed along itself by
    (1, 2, 1) / 4: a stripe may be only a pixel or two wide there, and its centre would be biased to
    the pixel grid. All means are of two bytes, rounded up: processors have an instruction for that.

    Parameters
    ----------
    size_px : (int, int)
        Image width and height.
    axis : SearchAxis
        Direction of the search lines.
    line_px : int
        Pixels across a search line, 1 or 2.
    """

    def __init__(self, size_px: tuple[int, int], axis: SearchAxis, line_px: int) -> None:
        width, height = size_px
        self._along_x, self._paired = axis is SearchAxis.ALONG_X, line_px == 2
        shape = (height // line_px, width) if self._along_x else (height, width // line_px)
        self._pairs = np.empty(shape, np.uint8)
        self._turned = np.empty(shape[::-1], np.uint8)
        self._means = np.empty((3, shape[1]), np.uint8)

    def of(self, luma: U8Array) -> U8Array:
        """Return the search lines of a picture.

        Parameters
        ----------
        luma : uint8 array, shape (height, width)
            Contiguous.

        Returns
        -------
        uint8 array, shape (n_lines, length)
            Overwritten by the next call; `luma` itself if its rows are the search lines.
        """
        lines = luma
        if self._paired:
            lines = self._pairs
            (_pair_rows if self._along_x else _pair_columns)(luma, self._means, lines)
        return lines if self._along_x else np.asarray(cv2.transpose(lines, self._turned), np.uint8)


@inline_kernel
def _mean(one: np.uint8, other: np.uint8) -> np.uint8:
    """Return the mean, rounded up; compiled to one vector instruction."""
    return np.uint8((np.uint16(one) + np.uint16(other) + np.uint16(1)) >> np.uint16(1))


@kernel
def _pair_rows(luma: U8Array, means: U8Array, lines: U8Array) -> None:
    """Write the means of two rows each, smoothed along them; `means` is scratch."""
    mean = means[0]
    last = mean.shape[0] - 1
    before, middle, after = mean[:-2], mean[1:-1], mean[2:]
    for k in range(lines.shape[0]):
        one, other, out = luma[2 * k], luma[2 * k + 1], lines[k]
        for x in range(mean.shape[0]):
            mean[x] = _mean(one[x], other[x])
        inner = out[1:-1]
        for x in range(inner.shape[0]):
            inner[x] = _mean(_mean(before[x], after[x]), middle[x])
        out[0] = _mean(_mean(mean[0], mean[1]), mean[0])
        out[last] = _mean(_mean(mean[last - 1], mean[last]), mean[last])


@kernel
def _pair_columns(luma: U8Array, means: U8Array, columns: U8Array) -> None:
    """Write the means of two columns each, smoothed along them; `means` is scratch."""
    height = luma.shape[0]
    _pair_pixels(luma[0], means[0])
    _pair_pixels(luma[0], means[1])
    for y in range(height):
        before, middle, after = means[y % 3], means[(y + 1) % 3], means[(y + 2) % 3]
        _pair_pixels(luma[min(y + 1, height - 1)], after)
        out = columns[y]
        for x in range(out.shape[0]):
            out[x] = _mean(_mean(before[x], after[x]), middle[x])


@inner_kernel
def _pair_pixels(row: U8Array, mean: U8Array) -> None:
    """Write the means of two neighbours each."""
    for x in range(mean.shape[0]):
        mean[x] = _mean(row[2 * x], row[2 * x + 1])


DetectorOptions = StripeOptions | ThresholdOptions
DETECTORS: dict[str, type[DetectorOptions]] = {
    "ridge": StripeOptions,
    "threshold": ThresholdOptions,
}
"""Options of every detector, by its name on the command line and in files."""


class _SampleOptions(NamedTuple):
    """Sample of a frame's search lines, from which the contrast threshold follows."""

    # One search line in this many is sampled first. The threshold is raised until there are at most
    # this many times as many peaks as the lasers can make.
    sample_every: int = 48
    max_peaks: float = 2.0
    # A picture with fewer peaks than this many times that number is quiet.
    quiet: float = 0.25
    # Quantile of the height of a frame's bright peaks.
    bright_quantile: float = 0.9
    # Float64 numbers in a cache line of 64 bytes.
    cache_line: int = 8
    # Largest width of an overexposed line, as a share of the picture's width.
    widest_white: float = 0.02
    # Largest number of the tallest peaks, as a share of what the lasers can make: nets are lit on
    # less than a quarter of the search lines, walls on most.
    tallest: float = 0.6


_SAMPLE = _SampleOptions()


class _DashOptions(NamedTuple):
    """Limits for stripes on thin twine whose chroma the codec dropped.

    Tall peaks are those that are always used (`HIGHEST_USEFUL`); coloured ones show as much of the
    lasers' colour as the weakest line; long ones lie in a segment that is longer than a dash.

    Tuned on rendered dives of nets: as H.264 at 640x480, of an interlaced camera, and as MPEG-4
    (Part 2) at 0.4 to 2 Mbit/s with a wall behind the net. In the first two, up to 0.18 of the tall
    peaks are coloured; if the stripes keep their chroma, 0.27 and more. In the last, up to 0.28 of
    the dashes and 0.73 of the long lines are; if the chroma is kept, 0.31 and 0.82.
    """

    # Least number of tall peaks; the largest ratio of it to the number that the lasers can make;
    # the largest shares of coloured and of long peaks: codecs keep the chroma of long ones.
    min_tall: int = 48
    crowd: float = 1.5
    max_coloured: float = 0.2
    max_long: float = 0.5
    # If more are long, as with a wall behind the net: the largest ratio of tall peaks, and the
    # least of long ones, to what the lasers can make; the largest coloured shares of the dashes
    # and of the long ones.
    crowd_before_wall: float = 2.0
    min_lines: float = 0.5
    max_coloured_dashes: float = 0.3
    max_coloured_lines: float = 0.75
    # Largest coloured share of the dashes whatever colour the lines have, if tall peaks are few:
    # light along a strand keeps it. At 640x480, of nets in PAL and at 320x240, up to 0.15.
    max_coloured_beside_lines: float = 0.15


_DASH = _DashOptions()

_NO_CHROMA = np.empty((0, 0), np.uint8)


def detector_word(options: DetectorOptions) -> str:
    """Return the name of the detector with these options."""
    return next(word for word, kind in DETECTORS.items() if isinstance(options, kind))


class FramePeaks(dict[SearchAxis, StripePeaks]):
    """Stripe peaks of a frame by search direction.

    Attributes
    ----------
    coloured_share : float
        Of all peaks that are as tall as the median of these, the share that is among these: 1 if
        none was left out for its colour.
    """

    coloured_share = 1.0


class FrameDetector:
    """Detector of stripes in frames of one size, within the bands of all lasers.

    Parameters
    ----------
    size_px : (int, int)
        Image width and height.
    laser_bands : sequence of LaserBand
        One for each laser.
    options : StripeOptions or ThresholdOptions
        Kind of detector, and its options.
    field : {"top", "bottom"} or None
        Field that the frames hold; bands and peaks are in pixels of the whole picture. An odd last
        row of the picture belongs to no field. None for whole pictures.
    """

    def __init__(
        self,
        size_px: tuple[int, int],
        laser_bands: Sequence[LaserBand],
        options: DetectorOptions,
        field: Field | None = None,
    ) -> None:
        self._field, self._options = field, options
        width, height = self._size_px = size_px if field is None else (size_px[0], size_px[1] // 2)
        visible = [band for band in laser_bands if band.visible]
        self._colours = sorted({one.colour for one in visible}, key=lambda colour: colour.name)
        # Each laser makes about one peak on a search line.
        self._n_possible = float(sum(one.n_lit for one in visible))
        by_axis = {axis: [one for one in visible if one.axis is axis] for axis in SearchAxis}
        self._bands = {axis: _band(ones) for axis, ones in by_axis.items() if ones}
        # Its stripe, if it slants, crosses search lines of the other direction as well.
        n_across = sum(one.n_lit * min(one.slant, 1.0) for one in visible)
        self._n_seen = self._n_possible + (n_across if len(self._bands) == len(SearchAxis) else 0.0)
        # A search line along x of a field is one of its rows.
        self._line_px = {
            axis: 1 if field and axis is SearchAxis.ALONG_X else by_axis[axis][0].line_px
            for axis in self._bands
        }
        if field and SearchAxis.ALONG_Y in self._bands:
            lowest, highest = self._bands[SearchAxis.ALONG_Y]
            self._bands[SearchAxis.ALONG_Y] = lowest // 2, highest // 2
        self._finders: Mapping[SearchAxis, PeakFinder] = {}
        self._threshold: Mapping[SearchAxis, ThresholdDetector] = {}
        if isinstance(options, StripeOptions):
            self._finders = {axis: self._finder(axis, options) for axis in self._bands}
        else:
            # Imported only for comparisons with the paper.
            from aqualvs.scanning.paper import detector as paper

            self._threshold = {
                axis: paper.ThresholdDetector(axis, self._size_px, *band, options)
                for axis, band in self._bands.items()
            }
        self._room = options.max_returns
        # Peaks of all directions, one after the other. Rows whose length is a power of two would
        # map to the same few lines of the processor's cache: they are one cache line longer.
        self._line = np.empty(len(self._finders) * self._room, np.int64)
        self._table = np.empty((N_MEASURES, len(self._line) + _SAMPLE.cache_line))
        self._lines = {
            axis: SearchLines(self._size_px, axis, line_px)
            for axis, line_px in self._line_px.items()
        }
        self._luma = np.empty((height, width), np.uint8)
        self._chroma = np.empty((2, -(-height // 2), -(-width // 2)), np.uint8)

    def _finder(self, axis: SearchAxis, options: StripeOptions) -> PeakFinder:
        width, height = self._size_px
        along_x = axis is SearchAxis.ALONG_X
        reach = options.reach_share * (width if along_x or not self._field else 0.5 * width)
        return PeakFinder(
            width if along_x else height,
            *self._bands[axis],
            max(8, round(reach)),
            np.array([colour.value for colour in self._colours]),
        )

    def detect(self, frame: Frame) -> FramePeaks:
        """Find the peaks of every search direction.

        Parameters
        ----------
        frame : Frame
            Of the size the detector was made for.

        Returns
        -------
        FramePeaks
            Copies: they stay valid after the next call.

        Raises
        ------
        FrameError
            If the frame has another size, or is not of 8 bits, or its chroma is not half as large.
        """
        self._check(frame)
        if not self._bands:
            return FramePeaks()
        if isinstance(self._options, StripeOptions):
            found = self._find_stripes(frame, self._options)
        else:
            np.copyto(self._luma, frame.luma)
            found = FramePeaks(
                (axis, detector.detect(self._lines[axis].of(self._luma)))
                for axis, detector in self._threshold.items()
            )
        if self._field and SearchAxis.ALONG_Y in found:
            found[SearchAxis.ALONG_Y] = _in_picture(found[SearchAxis.ALONG_Y], self._field)
        return found

    def _check(self, frame: Frame) -> None:
        """Refuse a frame that kernels would read wrongly."""
        luma = frame.luma
        if not isinstance(luma, np.ndarray):
            raise FrameError(
                f"frame {frame.index} holds {type(luma).__name__} but expected an array of uint8; "
                "give a picture as OpenCV reads it to aqualvs.planes_of_image"
            )
        if luma.dtype != np.uint8 or luma.ndim != 2:
            raise FrameError(
                f"frame {frame.index} holds {luma.dtype} of {luma.ndim} dimensions but "
                "expected uint8 of 2; convert it, colours by aqualvs.planes_of_image"
            )
        height, width = luma.shape
        if (width, height) != self._size_px:
            raise FrameError(
                f"frame {frame.index} is {width} x {height} px but the rig's image is "
                f"{self._size_px[0]} x {self._size_px[1]} px; use the rig of this camera"
            )
        if frame.chroma is None:
            return
        # An array of both planes is no pair of them.
        planes = frame.chroma if isinstance(frame.chroma, tuple | list) else [frame.chroma]
        found = [(getattr(one, "dtype", None), getattr(one, "shape", None)) for one in planes]
        half = self._chroma.shape[1:]
        if found != [(np.uint8, half)] * 2:
            words = ", ".join(f"{dtype} of shape {shape}" for dtype, shape in found)
            raise FrameError(
                f"frame {frame.index} has chroma {words} but expected a pair (U, V), both uint8 of "
                f"shape {half}; make it by aqualvs.planes_of_image, or give None for a grey picture"
            )

    def tallest(self, peaks: FramePeaks) -> FramePeaks:
        """Return the tallest peaks of a frame, fewer than the lasers can make.

        Lamps and daylight make many more peaks on twine, but lower ones than the lasers.
        """
        most = int(_SAMPLE.tallest * self._n_possible)
        heights = np.concatenate([np.empty(0), *(found.height for found in peaks.values())])
        if most >= len(heights):
            return peaks
        least = np.partition(heights, -most)[-most]
        return FramePeaks(
            (axis, StripePeaks(*(column[found.height >= least] for column in found)))
            for axis, found in peaks.items()
        )

    def _find_stripes(self, frame: Frame, options: StripeOptions) -> FramePeaks:
        frame = without_neutral_chroma(frame)
        luma, has_colour = self._contrast_image(frame), frame.chroma is not None
        planes = frame.chroma or (_NO_CHROMA, _NO_CHROMA)
        u, v = (_contiguous(plane, out) for plane, out in zip(planes, self._chroma, strict=True))
        images = {
            axis: SearchImage(lines.of(luma), u, v, self._line_px[axis], axis is SearchAxis.ALONG_X)
            for axis, lines in self._lines.items()
        }
        contrast, paint = self._measure_sample(images, options.min_contrast, has_colour)
        line, table, ends = self._find(images, contrast)
        if not has_colour or are_colourless_dashes(line, table, ends, self._n_possible):
            likelihood = np.ones(len(line))
        else:
            likelihood = self._likelihood(table, paint, self._n_possible)
        rows = select_peaks(
            line, table, likelihood, ends, options.min_likelihood, options.min_share
        )
        line, likelihood = line[rows], likelihood[rows]
        position, height, width = table[:3].take(rows, axis=1)
        pull = table[PULL].take(rows)
        bounds = np.searchsorted(rows, ends)
        found = FramePeaks()
        for axis, start, end in zip(images, bounds[:-1], bounds[1:], strict=True):
            found[axis] = StripePeaks(
                line[start:end],
                position[start:end],
                height[start:end],
                width[start:end],
                likelihood[start:end],
                pull[start:end],
            )
        if has_colour and len(rows):
            tall = lower_quantile(height, 0.5)
            n_tall = np.count_nonzero(table[HEIGHT] >= tall)
            found.coloured_share = np.count_nonzero(height >= tall) / n_tall
        return found

    def _contrast_image(self, frame: Frame) -> U8Array:
        """Return the picture in which the lasers have the most contrast.

        Overwritten by the next call; may be the frame's luma itself.
        """
        first, *others = (channel_image(frame, colour) for colour in self._colours)
        if not others:
            return _contiguous(first, self._luma)
        np.copyto(self._luma, first)
        for image in others:
            np.maximum(self._luma, image, out=self._luma)
        return self._luma

    def _find(
        self, images: Mapping[SearchAxis, SearchImage], contrast: int, every: int = 1
    ) -> tuple[IntArray, FloatArray, IntArray]:
        """Find the peaks of all directions on one search line in `every`.

        Returns search lines (N,), measures (10, N), and where the peaks of each direction end
        (n_directions + 1,), from 0 on. The next call overwrites the first two.
        """
        ends = [0]
        for axis, image in images.items():
            room = slice(ends[-1], ends[-1] + self._room)
            n = self._finders[axis].find(
                image, contrast, every, self._line[room], self._table[:, room]
            )
            ends.append(ends[-1] + n)
        return self._line[: ends[-1]], self._table[:, : ends[-1]], np.array(ends)

    def _measure_sample(
        self, images: Mapping[SearchAxis, SearchImage], least: int, has_colour: bool
    ) -> tuple[int, Paint | None]:
        """Return the contrast threshold and the paint's colour, from a sample of the search lines.

        In a quiet picture `least` is halved: lines far away or out of focus are visible there, too,
        and only colour separates them from faint texture. Above the threshold there are not many
        more peaks than the lasers can make.
        """
        n_possible = self._n_possible / _SAMPLE.sample_every
        _, sample, _ = self._find(images, least, _SAMPLE.sample_every)
        if has_colour and sample.shape[1] < _SAMPLE.quiet * n_possible:
            least = (least + 1) // 2
            _, sample, _ = self._find(images, least, _SAMPLE.sample_every)
        most = _SAMPLE.max_peaks * n_possible
        heights = np.sort(sample[HEIGHT])
        n = len(heights)
        if n > most:
            least = max(least, round(min(float(heights[n - 1 - int(most)]), HIGHEST_USEFUL)))
        # Few peaks are used whatever their colour: codecs drop that of thin lines.
        if not has_colour or n <= n_possible:
            return least, None
        paint = learn_paint(sample, self._n_seen / _SAMPLE.sample_every)
        likelihood = self._likelihood(sample, paint, n_possible)
        return max(least, useful_height(sample[HEIGHT], likelihood)), paint

    def _likelihood(self, table: FloatArray, paint: Paint | None, n_possible: float) -> FloatArray:
        """Return the likelihood that each peak is laser light of any of the colours.

        A colour that cannot be learned from these peaks is that of a typical camera.
        """
        found = [
            laser_likelihood(
                table,
                learn_colour(table, colour, paint) or expected_colour(table, colour, paint),
                _SAMPLE.widest_white * self._size_px[0],
                n_possible,
            )
            for colour in self._colours
        ]
        return np.asarray(np.max(found, axis=0), np.float64) if len(found) > 1 else found[0]


@lazy_kernel
def are_colourless_dashes(
    line: IntArray, table: FloatArray, ends: IntArray, n_possible: float
) -> bool:
    """Return whether most tall peaks are short dashes without colour, perhaps before a wall.

    At low bit rates a codec drops the chroma of stripes that are a few pixels long, as on thin
    twine, but keeps that of a wall's long lines. Then colour is no evidence, as in a grey picture.
    Twine in white light is different: it makes long segments without colour.

    Parameters
    ----------
    line, table, ends
        As in `select_peaks`.
    n_possible : float
        Number of peaks that the lasers can make; if many more are tall, most are other objects.
    """
    tall, coloured = np.empty(line.shape[0], np.bool_), np.empty(line.shape[0], np.bool_)
    n_tall, n_coloured = 0, 0
    for i in range(line.shape[0]):
        tall[i] = table[HEIGHT, i] >= HIGHEST_USEFUL
        step = hypot(table[STEP_U, i], table[STEP_V, i])
        coloured[i] = tall[i] and step > RATIO_MIN * table[HEIGHT, i]
        n_tall += tall[i]
        n_coloured += coloured[i]
    # These counts decide most frames; linking the peaks takes longer.
    if not _DASH.min_tall <= n_tall <= _DASH.crowd_before_wall * n_possible:
        return False
    if n_tall - n_coloured < (1.0 - _DASH.max_coloured_dashes) * _DASH.min_tall:
        return False
    n_dashes, n_lines, n_coloured_dashes, n_coloured_lines = 0, 0, 0, 0
    for k in range(ends.shape[0] - 1):
        rows = _marked_rows(tall, ends[k], ends[k + 1])
        long = _are_in_a_row(line, table, rows)
        for i in range(rows.shape[0]):
            n_lines += long[i]
            n_dashes += not long[i]
            n_coloured_lines += long[i] and coloured[rows[i]]
            n_coloured_dashes += not long[i] and coloured[rows[i]]
    few = n_tall <= _DASH.crowd * n_possible
    many_dashes = n_dashes >= _DASH.min_tall
    few_coloured = n_coloured_dashes <= _DASH.max_coloured_beside_lines * n_dashes
    if few and many_dashes and few_coloured:
        return True
    if n_lines <= _DASH.max_long * n_tall:
        return bool(few and n_coloured <= _DASH.max_coloured * n_tall)
    enough = many_dashes and n_lines >= _DASH.min_lines * n_possible
    pale = n_coloured_dashes <= _DASH.max_coloured_dashes * n_dashes
    return bool(enough and pale and n_coloured_lines <= _DASH.max_coloured_lines * n_lines)


@lazy_kernel
def select_peaks(
    line: IntArray,
    table: FloatArray,
    likelihood: FloatArray,
    ends: IntArray,
    min_likelihood: float,
    min_share: float,
) -> IntArray:
    """Return the peaks that are likely laser light, and bright or in a long segment.

    Parameters
    ----------
    line : int array, shape (N,)
        Search line of each peak, direction after direction.
    table : array, shape (10, N)
        Measures of the peaks, rows as `stripe` names them.
    likelihood : array, shape (N,)
        Of being laser light, 0 to 1.
    ends : int array, shape (n_directions + 1,)
        0, and where the peaks of each direction end.
    min_likelihood, min_share : float
        As in `StripeOptions`.

    Returns
    -------
    int array, shape (K,)
        Their indices, ascending.
    """
    keep = np.empty(likelihood.shape[0], np.bool_)
    for i in range(keep.shape[0]):
        keep[i] = likelihood[i] >= min_likelihood
    bright = min_share * lower_quantile(
        take(table[HEIGHT], flatnonzero(keep)), _SAMPLE.bright_quantile
    )
    for k in range(ends.shape[0] - 1):
        rows = _marked_rows(keep, ends[k], ends[k + 1])
        long = _are_in_a_row(line, table, rows)
        for i in range(rows.shape[0]):
            keep[rows[i]] = long[i] or table[HEIGHT, rows[i]] >= bright
    return flatnonzero(keep)


@inner_kernel
def _marked_rows(marks: BoolArray, start: int, end: int) -> IntArray:
    """Return the indices in [start, end) that are marked."""
    rows = flatnonzero(marks[start:end])
    for i in range(rows.shape[0]):
        rows[i] += start
    return rows


@inner_kernel
def _are_in_a_row(line: IntArray, table: FloatArray, rows: IntArray) -> BoolArray:
    """Mark which of the peaks `rows`, of one direction, lie in a long segment."""
    its_line = np.empty(rows.shape[0], np.int64)
    for i in range(rows.shape[0]):
        its_line[i] = line[rows[i]]
    return in_a_row(its_line, take(table[POSITION], rows))


def _in_picture(peaks: StripePeaks, field: Field) -> StripePeaks:
    """Convert peaks on columns of a field: positions and widths in pixels of the picture."""
    position = 2.0 * peaks.position + FIRST_ROW[field]
    return peaks._replace(position=position, width=2.0 * peaks.width)


def _contiguous(plane: U8Array, copy: U8Array) -> U8Array:
    """Return a plane if it is contiguous, as kernels are compiled for, else a copy in `copy`."""
    if plane.flags.carray:
        return plane
    np.copyto(copy, plane)
    return copy


def _band(laser_bands: Sequence[LaserBand]) -> tuple[IntArray, IntArray]:
    """Return the first and last position (n_lines,) of the union of the bands."""
    lowest: IntArray = np.min([band.lowest for band in laser_bands], axis=0)
    highest: IntArray = np.max([band.highest for band in laser_bands], axis=0)
    return lowest, highest
