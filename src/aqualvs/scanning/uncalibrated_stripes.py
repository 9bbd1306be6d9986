"""Stripes in a whole picture, for lasers whose planes are not known yet."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.scanning.laser_bands import SLOPE_CELL, LaserBand, SearchAxis, pixels_per_line
from aqualvs.scanning.laser_colour import LaserColour
from aqualvs.scanning.scan import Frame, ImagePlane, planes_of_image
from aqualvs.scanning.stripe import StripePeaks
from aqualvs.scanning.stripe_continuation import continued, extended
from aqualvs.scanning.stripe_segments import (
    SMOOTHING as SMOOTHING,
)
from aqualvs.scanning.stripe_segments import (
    StripeSegments as StripeSegments,
)
from aqualvs.scanning.stripe_segments import (
    find_segments as find_segments,
)
from aqualvs.scanning.stripe_segments import (
    line_log_odds as line_log_odds,
)

# A stripe at less than 45 degrees to a search line is left to the other axis.
_STEEPEST = 1.0
# Full width at half height of a normal distribution, in standard deviations.
_WIDTH_OF_SIGMA = 2.355
_MAP_LENGTH = 30000


@dataclass(frozen=True, slots=True, kw_only=True)
class UncalibratedStripeOptions:
    """Options of `find_stripes`.

    Attributes
    ----------
    min_likelihood : float
        Least likelihood, 0 to 1, that a piece of stripe is a laser's line, by its shape and colour
        and by the picture's other lines.
    min_length_share : float
        Shortest unbroken piece of a stripe that continues no other, as a share of the picture's
        width.
    wavelength_nm : float or None
        Of the lasers; green if None.
    """

    min_likelihood: float = 0.5
    min_length_share: float = 0.015
    wavelength_nm: float | None = None

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        if not 0.0 < self.min_likelihood < 1.0:
            raise OptionError(f"min_likelihood is {self.min_likelihood}; use 0 to 1")
        if not 0.0 < self.min_length_share < 1.0:
            raise OptionError(f"min_length_share is {self.min_length_share}; use 0 to 1")


@dataclass(frozen=True, slots=True)
class StripePixels:
    """Points on stripes of a picture, N of them, chain by chain along each stripe.

    Attributes
    ----------
    pixels : array, shape (N, 2)
        Sub-pixel centres, in `image`.
    across : array, shape (N, 2)
        Unit vectors at right angles to the stripe.
    chain : int array, shape (N,)
        Number of the unbroken piece of a stripe that a point belongs to.
    height : array, shape (N,)
        Peak above background, in grey levels.
    width : array, shape (N,)
        Full width at half height across the stripe, in pixels.
    sigma_px : array, shape (N,)
        Nominal standard deviation of the centre across the stripe.
    """

    pixels: FloatArray
    across: FloatArray
    chain: IntArray
    height: FloatArray
    width: FloatArray
    sigma_px: FloatArray

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.chain)


def find_stripes(
    image: ImagePlane | Frame, options: UncalibratedStripeOptions | None = None
) -> StripePixels:
    """Find the lines of lasers: thin, long, of the lasers' colour, and similar to each other.

    Parameters
    ----------
    image : uint8 array, shape (height, width) or (height, width, 3), or Frame
        Grey, or BGR as OpenCV reads it. In a grey picture every thin bright line counts.
    options : UncalibratedStripeOptions, optional

    Returns
    -------
    StripePixels
        Each piece of a stripe is searched along the axis that crosses it nearer to a right angle.
        Empty if no piece is certain.
    """
    options = options or UncalibratedStripeOptions()
    frame = image if isinstance(image, Frame) else Frame(0, 0.0, *planes_of_image(image))
    width = frame.luma.shape[1]
    found = find_all_segments(frame, options)
    table = np.concatenate([segments.table for segments in found], axis=1)
    log_odds = line_log_odds(table, width, has_colour=frame.chroma is not None)
    least = math.log(options.min_likelihood / (1.0 - options.min_likelihood))
    size_px = width, frame.luma.shape[0]
    keep, line = continued(found, log_odds, least, options.min_length_share * width, size_px)
    parts: dict[int, list[StripePixels]] = {}
    first = 0
    for segments in found:
        here = slice(first, first + len(segments.start) - 1)
        chains = extended(segments, keep[here])
        for of, chain in zip(line[here][keep[here]], chains, strict=True):
            parts.setdefault(int(of), []).append(_piece(segments.search, segments.peaks, chain))
        first = here.stop
    stripes = _joined([piece for of in parts.values() for piece in _unless_blob(of)])
    return replace(stripes, sigma_px=_sigma_px(frame.luma, stripes))


def find_all_segments(frame: Frame, options: UncalibratedStripeOptions) -> list[StripeSegments]:
    """Find pieces of stripes along both search directions, lines of lasers and others.

    Parameters
    ----------
    frame : Frame
    options : UncalibratedStripeOptions
        The wavelength says in which channel lines are brightest.
    """
    size_px = frame.luma.shape[1], frame.luma.shape[0]
    colour = LaserColour.of(options.wavelength_nm)
    return [find_segments(frame, _whole_band(size_px, axis, colour)) for axis in SearchAxis]


def _whole_band(size_px: tuple[int, int], axis: SearchAxis, colour: LaserColour) -> LaserBand:
    line_px = pixels_per_line(size_px)
    n_pixels, length = size_px if axis is SearchAxis.ALONG_Y else size_px[::-1]
    n_lines = n_pixels // line_px
    slopes = np.full((-(-length // SLOPE_CELL), -(-n_lines // SLOPE_CELL)), _STEEPEST * line_px)
    lowest, highest = np.zeros(n_lines, np.int64), np.full(n_lines, length - 1)
    return LaserBand(axis, line_px, lowest, highest, -slopes, slopes, colour)


def _piece(search: LaserBand, peaks: StripePeaks, chain: IntArray) -> StripePixels:
    axis = search.axis
    line = search.line_px * (peaks.line[chain].astype(np.float64) + 0.5) - 0.5
    slope = _slopes(line, peaks.position[chain])
    width = peaks.width[chain]
    # At just 45 degrees one of the axes must have it.
    steep_enough = np.abs(slope) <= _STEEPEST * (1.0 if axis is SearchAxis.ALONG_Y else 0.999999)
    keep = steep_enough & ~_in_dot(width, search.line_px)
    chain, line, slope = chain[keep], line[keep], slope[keep]
    along_x = axis is SearchAxis.ALONG_X
    cosine = 1.0 / np.hypot(1.0, slope)
    pixels = np.stack([line, peaks.position[chain]], axis=-1)
    across = np.stack([-slope * cosine, cosine], axis=-1)
    width = _unsmoothed(peaks.width[chain], slope * search.line_px) * cosine
    return StripePixels(
        pixels[:, ::-1] if along_x else pixels,
        across[:, ::-1] if along_x else across,
        np.zeros(len(chain), np.int64),
        peaks.height[chain],
        width,
        np.zeros(len(chain)),
    )


def _in_dot(width: FloatArray, line_px: int) -> BoolArray:
    """Mark the peaks (N,) of a chain that lie on a dot, by their widths in pixels."""
    # Returns wider than this many median widths of their chain are a dot on the stripe, unless they
    # go on for longer than this many of their own widths: then a pale surface saturates the camera.
    max_width, longest_dot = 1.8, 1.5
    # The measured width of a thinner line tells where it lies between two pixels.
    thinnest_px = 2.0
    wide = width > max_width * max(float(np.median(width)), thinnest_px)
    bounds = np.flatnonzero(np.diff(wide, prepend=False, append=False))
    for first, end in bounds.reshape(-1, 2):
        if line_px * (end - first) > longest_dot * np.median(width[first:end]):
            wide[first:end] = False
    return wide


def _unsmoothed(width: FloatArray, slope: FloatArray) -> FloatArray:
    """Return widths (N,) without what smoothing along slanted stripes adds to them."""
    added = _WIDTH_OF_SIGMA * SMOOTHING * slope
    squared: FloatArray = np.maximum(width**2 - added**2, (0.5 * width) ** 2)
    return np.sqrt(squared)


def _sigma_px(luma: ImagePlane, stripes: StripePixels) -> FloatArray:
    """Return the nominal noise (N,) of points across their stripes."""

    def lopsided(at: float) -> FloatArray:
        arms = at * stripes.width[:, None] * stripes.across
        sides = [_bilinear(luma, stripes.pixels + sign * arms) for sign in (-1.0, 1.0)]
        share: FloatArray = (sides[1] - sides[0]) / stripes.height
        return share

    # Where one side is lighter than the other, beyond the stripe or on its slopes, paint shifts the
    # centre by about this many widths, relative to the height of the stripe.
    flank_at, flank_pull = 1.3, 0.2
    slope_at, slope_pull = 0.5, 0.35
    pull = np.hypot(flank_pull * lopsided(flank_at), slope_pull * lopsided(slope_at))
    # Noise of the centre of a stripe by speckle, as a share of its width; the least noise is that
    # of 8 bits and a Bayer pattern.
    sigma_in_widths, min_sigma_px = 0.01, 0.05
    in_widths = np.hypot(sigma_in_widths, pull)
    return np.hypot(min_sigma_px, in_widths * stripes.width)


def _bilinear(luma: ImagePlane, pixels: FloatArray) -> FloatArray:
    x, y = np.ascontiguousarray(pixels.T, np.float32)
    # OpenCV's maps are pictures, of which the sides have a limit.
    rows = [slice(i, i + _MAP_LENGTH) for i in range(0, len(x), _MAP_LENGTH)]
    values = [
        cv2.remap(luma, x[r], y[r], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel()
        for r in rows
    ]
    return np.concatenate([np.zeros(0), *values])


def _slopes(line: FloatArray, position: FloatArray) -> FloatArray:
    """Return d position / d line (N,), by a straight fit to the neighbours along the chain."""
    index = np.arange(len(line))
    # Slopes are computed from this many peaks on either side.
    slope_reach = 6
    first = np.maximum(index - slope_reach, 0)
    last = np.minimum(index + slope_reach + 1, len(line))
    x, y = line - line.mean(), position - position.mean()

    def window(values: FloatArray) -> FloatArray:
        total = np.concatenate([[0.0], np.cumsum(values)])
        summed: FloatArray = total[last] - total[first]
        return summed

    n = (last - first).astype(np.float64)
    spread = window(x * x) - window(x) ** 2 / n
    slope: FloatArray = (window(x * y) - window(x) * window(y) / n) / np.maximum(spread, 1e-9)
    return slope


def _unless_blob(line: list[StripePixels]) -> list[StripePixels]:
    """Return the pieces of a line that have at least three points; none if they are a blob."""
    pieces = [piece for piece in line if len(piece) >= 3]
    if not pieces:
        return []
    length = sum(float(np.hypot(*(piece.pixels[-1] - piece.pixels[0]))) for piece in pieces)
    # A line shorter than this many of its own widths is a blob: the beam's own dot, a glint, a
    # mark.
    min_length_in_widths = 2.5
    width = np.median(np.concatenate([piece.width for piece in pieces]))
    return pieces if length >= min_length_in_widths * float(width) else []


def _joined(parts: list[StripePixels]) -> StripePixels:
    """Return all parts as one, with chains numbered through."""
    if not parts:
        none = np.zeros(0)
        return StripePixels(
            np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.int64), none, none, none
        )
    chains, first = [], 0
    for part in parts:
        chains.append(part.chain + first)
        first += int(part.chain.max(initial=-1)) + 1
    return StripePixels(
        np.concatenate([part.pixels for part in parts]),
        np.concatenate([part.across for part in parts]),
        np.concatenate(chains),
        np.concatenate([part.height for part in parts]),
        np.concatenate([part.width for part in parts]),
        np.concatenate([part.sigma_px for part in parts]),
    )
