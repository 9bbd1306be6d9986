"""Colour of laser light: how it moves a pixel's chroma, and how likely a peak is laser light.

A camera sees a 532 nm line neither as pure green nor always as green: its colour filters overlap,
white balance scales the channels, and an overexposed core is white inside a green halo. On nine
cameras, in air and under water, green lines lower V in 94 to 100 % of their pixels, but U in 0 to
100 %; red lines raise V. So colour is evidence and no gate: the wavelength says in which half of
the chroma plane to look, the frame's own best stripes say in which direction, and how far for each
grey level of height, its lines move the chroma, and every peak gets the likelihood that it is such
a line and not paint, twine or glare. A frame learns from itself, so that a white balance that
drifts needs no tracking, and a frame's answer depends on nothing but the frame.
"""

import math
from enum import Enum
from typing import NamedTuple

import cv2
import numpy as np

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import inline_kernel, kernel
from aqualvs.scanning.scan import Frame, ImagePlane
from aqualvs.scanning.stripe import HEIGHT, IMBALANCE, STEP_U, STEP_V, TINT_U, TINT_V, TOP, WIDTH

# Wavelengths (nm) that part blue, green and red lines.
_BLUE_TO_GREEN_NM, _GREEN_TO_RED_NM = 490.0, 580.0
# R and B by V and U, in the scale of limited-range luma (BT.601).
_RED_OF_V, _BLUE_OF_U = 1.596 / 1.164, 2.018 / 1.164
# The thresholds of learning were tuned on the rendered sample and benchmark dives, the photographs
# of the sample folders and dives of the simulated cameras.
# Stripes to learn from: peaks of so many grey levels, with a chroma step beyond that of paint of so
# many standard deviations and so many levels, within an angle of this cosine to the wavelength's
# direction, and at least a share of the largest for their height; how many of them it takes, and
# by what shares of their mean step half of them scatter at most, and are taken to at least.
_MIN_HEIGHT, _CLEAR_SIGMAS, _CLEAR_LEVELS, _LEAST_COSINE = 12.0, 3.0, 3.0, 0.2
_BEST_SHARE, _MIN_LEARNED, _MOST_SCATTER, _LEAST_SCATTER = 0.6, 16, 0.4, 0.22
# So many peaks are enough to learn from.
_ENOUGH = 2500
# So tall peaks, so many times as many as the lasers can make, are mostly paint. Lines then lie so
# many standard deviations off it, and it spreads by so much at least and at most, as chroma for
# each level.
_TALL, _CROWD, _CLEAR_OF_PAINT, _MAD_TO_SIGMA = 20.0, 2.0, 4.0, 1.4826
_LEAST_SPREAD, _MOST_PAINT_SPREAD = 0.02, 0.07
# Chroma levels for each grey level of height: what a line is expected to show where none is clear
# enough to learn from, the least and the most that is believed of a learned one, and how far paint
# and glare spread about none. Lines of nine cameras show 0.15 to 0.7.
_RATIO_EXPECTED, _RATIO_LEAST, _RATIO_MOST, _RATIO_OF_PAINT = 0.25, 0.1, 0.75, 0.05
# One frame's lines spread about their ratio by this share, and by the second one across their
# direction: overexposed ones show less and differ in hue, faint ones more.
_RATIO_SPREAD, _ACROSS_SPREAD = 0.35, 0.5
# Paint shows up to this share of the tint of its flanks, and no more than the second share of what
# a line would, be the scene ever so green.
_TINT_SHARE, _PAINT_SHARE = 0.5, 0.5
# The learned ratio is that which so many of the best stripes exceed.
_LEARNED_QUANTILE = 0.35
# Levels: what rounding and subsampling leave of chroma noise.
_LEAST_SIGMA = 0.7
# Heights that are counted as one kind, and how often the shares of lines among them are refined.
_KINDS_PER_OCTAVE, _N_KINDS, _ROUNDS = 2.0, 16, 3
_KIND_OF_HEIGHT = np.minimum(_KINDS_PER_OCTAVE * np.log2(np.arange(256).clip(1)), _N_KINDS - 1)
_KIND_OF_HEIGHT = _KIND_OF_HEIGHT.astype(np.int64)
# Heights of which so few, or no more than this share, of a sample's peaks are clearly lines are not
# looked at.
_FEW_LINES, _USEFUL_SHARE, _CLEARLY = 4, 0.05, 0.8
# A core this bright, in limited-range luma, says nothing by its colour: every light is white there.
_WHITE = 225.0
# A quarter of a normal distribution lies within this many standard deviations.
_QUARTER_OF_NORMAL = 0.3186
# The largest of three normal numbers is so many standard deviations above their mean; up to so many
# levels of noise the lines' own differences are larger.
_LARGEST_OF_THREE, _QUIET = 0.85, 1.4
# Nothing is more certain than e to this power.
_MAX_LOG_ODDS = 12.0

HIGHEST_USEFUL = 32
"""Peaks of so many grey levels are always looked at."""


class LaserColour(Enum):
    """Channel of the camera in which a laser's light is brightest.

    The value is the direction in the (U, V) plane in which the light moves the chroma of a typical
    camera: for green and red the mean over the cameras measured, for blue that of the primary.
    """

    BLUE = (0.987, -0.16)
    GREEN = (-0.29, -0.957)
    RED = (-0.1, 0.995)

    @classmethod
    def of(cls, wavelength_nm: float | None) -> "LaserColour":
        """Return the colour of a wavelength in nanometres; green if it is None."""
        if wavelength_nm is None:
            return cls.GREEN
        if wavelength_nm < _BLUE_TO_GREEN_NM:
            return cls.BLUE
        return cls.GREEN if wavelength_nm < _GREEN_TO_RED_NM else cls.RED


def channel_image(frame: Frame, colour: LaserColour) -> ImagePlane:
    """Return the picture in which a laser's light stands out best.

    This is luma for green, of which luma mostly consists. A blue line raises luma by a ninth of
    what it raises blue, a red one by a third, so blue and red are made of luma and chroma.

    Parameters
    ----------
    frame : Frame
        Luma itself is returned where the frame has no chroma.
    colour : LaserColour

    Returns
    -------
    uint8 array, shape (height, width)
    """
    if colour is LaserColour.GREEN or frame.chroma is None:
        return frame.luma
    height, width = frame.luma.shape
    half = frame.chroma[1 if colour is LaserColour.RED else 0].astype(np.float32)
    full = cv2.resize(half, (2 * half.shape[1], 2 * half.shape[0]), interpolation=cv2.INTER_LINEAR)
    weight = _RED_OF_V if colour is LaserColour.RED else _BLUE_OF_U
    mixed = frame.luma + weight * (full[:height, :width] - 128.0)
    image: ImagePlane = np.clip(np.rint(mixed), 0, 255).astype(np.uint8)
    return image


class LineColour(NamedTuple):
    """What the lines of one frame do to the chroma.

    Attributes
    ----------
    u, v : float
        Unit vector in the (U, V) plane.
    ratio : float
        Levels along it for each grey level of a line's height.
    sigma : float
        Standard deviation of a step that nothing but noise makes, in levels.
    paint_u, paint_v : float
        What the frame's paint shows for each grey level of height, where it was learned.
    spread_u, spread_v : float
        Standard deviations of that; 0 where it was not learned.
    along, across : float
        How lines spread about their mean, as shares of `ratio`, along their direction and across.
    """

    u: float
    v: float
    ratio: float
    sigma: float
    paint_u: float = 0.0
    paint_v: float = 0.0
    spread_u: float = 0.0
    spread_v: float = 0.0
    along: float = _RATIO_SPREAD
    across: float = _ACROSS_SPREAD


def learn_colour(
    table: FloatArray, colour: LaserColour, n_possible: float, *, is_sample: bool = False
) -> LineColour | None:
    """Learn from a frame's peaks what its lines do to the chroma.

    Where there are many more tall peaks than the lasers can make, most are something else, such as
    twine in the sun: then its colour is learned too, and lines are what differs from it.

    Parameters
    ----------
    table : array, shape (9, N)
        Measures of peaks, rows as `stripe` names them.
    colour : LaserColour
    n_possible : float
        Peaks that the lasers can make.
    is_sample : bool
        Whether there are more peaks to learn from.

    Returns
    -------
    LineColour or None
        None where too few peaks are clearly of the laser's colour.
    """
    every = 1 + table.shape[1] // _ENOUGH
    table, n_possible = table[:, ::every], n_possible / every
    tall = np.flatnonzero(table[HEIGHT] >= _TALL)
    if len(tall) > _CROWD * n_possible:
        crowded = LineColour(*_learn_from_crowd(table[:, tall], *colour.value))
        # Peaks of one colour, and so no mixture of lines and noise. A sample may hold too few lines
        # to find them in a crowd, where all peaks do not.
        is_paint = crowded.spread_u * crowded.spread_v < _MOST_PAINT_SPREAD**2
        if is_paint and (crowded.ratio > 0.0 or is_sample):
            return crowded if crowded.ratio > 0.0 else None
    found = LineColour(*_learn(np.ascontiguousarray(table), *colour.value))
    return found if found.ratio > 0.0 else None


def expected_colour(table: FloatArray, colour: LaserColour) -> LineColour:
    """Return what lines do to the chroma of a typical camera, with the noise of these peaks."""
    return LineColour(*colour.value, _RATIO_EXPECTED, float(_noise(table)))


def laser_likelihood(table: FloatArray, line: LineColour, widest_white_px: float) -> FloatArray:
    """Return how likely each peak of a frame is laser light, and not something else that is bright.

    Compares two explanations of a chroma step: a line moves the chroma in proportion to its height,
    as the frame's best stripes do; noise does not move it, and brighter paint under the same light
    shows more of the tint that its flanks have, which is none where the light is white. How many
    peaks of about the same height are lines is found from the same steps: low ones are mostly
    noise.

    Parameters
    ----------
    table : array, shape (9, N)
        Measures of all peaks of one frame, rows as `stripe` names them.
    line : LineColour
        From `learn_colour` or `expected_colour`.
    widest_white_px : float
        Overexposed peaks up to this width may be a line's white core, whatever their colour; wider
        ones are paper or a window.

    Returns
    -------
    array, shape (N,)
        0 to 1; 0.5 where colour says nothing.
    """
    likelihood = np.empty(table.shape[1])
    _weigh(table, *line, widest_white_px, likelihood)
    return likelihood


def useful_height(height: FloatArray, likelihood: FloatArray) -> int:
    """Return the height up to which hardly any peak is clearly laser light, in grey levels.

    Parameters
    ----------
    height, likelihood : array, shape (N,)
        Of a sample of peaks.
    """
    return int(_useful_height(height, likelihood))


@kernel
def element_at(values: FloatArray, share: float) -> float:
    """Return the value that a share of the values exceeds no more: one of them; 0 of none."""
    n = values.shape[0]
    rank = int(share * (n - 1))
    return float(np.partition(values, rank)[rank]) if n else 0.0


@inline_kernel
def _kind_of(height: float) -> int:
    return int(_KIND_OF_HEIGHT[min(int(height), 255)])


@kernel
def _noise(table: FloatArray) -> float:
    """Return the standard deviation of a step, from how the two flanks of peaks differ.

    A low quantile: beside other stripes and edges the flanks differ by more than noise.
    """
    noise = element_at(np.abs(table[IMBALANCE]), 0.25) / _QUARTER_OF_NORMAL
    return max(noise / math.sqrt(2.0), _LEAST_SIGMA)


@inline_kernel
def _beyond_paint(
    table: FloatArray, i: int, left: float, tint_share: float, most: float
) -> tuple[float, float]:
    """Return what paint leaves unexplained of a share `left` of a peak's chroma step, as U and V.

    Brighter paint shows up to `tint_share` of the tint that its flanks have, and at most `most`.
    """
    u, v, height = left * table[STEP_U, i], left * table[STEP_V, i], table[HEIGHT, i]
    tint_u, tint_v = height * table[TINT_U, i], height * table[TINT_V, i]
    size = math.sqrt(tint_u**2 + tint_v**2)
    if size < 1e-9:
        return u, v
    share = (u * tint_u + v * tint_v) / (size * size)
    share = min(max(share, 0.0), min(tint_share, most / size))
    return u - share * tint_u, v - share * tint_v


@kernel
def _learn(table: FloatArray, u: float, v: float) -> tuple[float, float, float, float]:
    """Return direction, ratio and noise of the frame's best stripes; a ratio of 0 if unknown."""
    sigma = _noise(table)
    # What differs from all that paint may show is the surest; a line as green as the water is not.
    for tint_share in (1.0, _TINT_SHARE):
        best = _best_stripes(table, u, v, sigma, tint_share)
        if best.shape[0] < _MIN_LEARNED:
            continue
        height = table[HEIGHT][best]
        of_u, of_v = table[STEP_U][best] / height, table[STEP_V][best] / height
        line_u, line_v = element_at(of_u, 0.5), element_at(of_v, 0.5)
        size = math.hypot(line_u, line_v)
        if element_at(np.hypot(of_u - line_u, of_v - line_v), 0.5) > _MOST_SCATTER * size:
            continue
        line_u, line_v = line_u / size, line_v / size
        ratio = element_at(line_u * of_u + line_v * of_v, _LEARNED_QUANTILE)
        return line_u, line_v, max(ratio, _RATIO_LEAST), sigma
    return u, v, 0.0, sigma


@kernel
def _learn_from_crowd(
    table: FloatArray, u: float, v: float
) -> tuple[float, float, float, float, float, float, float, float, float, float]:
    """Return the fields of a `LineColour` where most peaks are paint; a ratio of 0 if unknown."""
    sigma = _noise(table)
    height = table[HEIGHT]
    of_u, of_v = table[STEP_U] / height, table[STEP_V] / height
    paint_u, paint_v = element_at(of_u, 0.5), element_at(of_v, 0.5)
    spread_u = max(_MAD_TO_SIGMA * element_at(np.abs(of_u - paint_u), 0.5), _LEAST_SPREAD)
    spread_v = max(_MAD_TO_SIGMA * element_at(np.abs(of_v - paint_v), 0.5), _LEAST_SPREAD)
    off_u = (of_u - paint_u) / np.hypot(spread_u, sigma / height)
    off_v = (of_v - paint_v) / np.hypot(spread_v, sigma / height)
    is_near = u * of_u + v * of_v > _LEAST_COSINE * np.hypot(of_u, of_v)
    best = np.flatnonzero(is_near & (np.hypot(off_u, off_v) > _CLEAR_OF_PAINT))
    nothing = (u, v, 0.0, sigma, paint_u, paint_v, spread_u, spread_v, 1.0, 1.0)
    if best.shape[0] < _MIN_LEARNED:
        return nothing
    line_u, line_v = element_at(of_u[best], 0.5), element_at(of_v[best], 0.5)
    size = math.hypot(line_u, line_v)
    if element_at(np.hypot(of_u[best] - line_u, of_v[best] - line_v), 0.5) > _MOST_SCATTER * size:
        return nothing
    if size > _RATIO_MOST:
        return nothing
    line_u, line_v, ratio = line_u / size, line_v / size, max(size, _RATIO_LEAST)
    off_along = np.abs(line_u * of_u[best] + line_v * of_v[best] - size)
    off_across = np.abs(line_v * of_u[best] - line_u * of_v[best])
    along = max(_MAD_TO_SIGMA * element_at(off_along, 0.5) / size, _LEAST_SCATTER)
    across = max(_MAD_TO_SIGMA * element_at(off_across, 0.5) / size, _LEAST_SCATTER)
    return line_u, line_v, ratio, sigma, paint_u, paint_v, spread_u, spread_v, along, across


@kernel
def _best_stripes(
    table: FloatArray, u: float, v: float, sigma: float, tint_share: float
) -> IntArray:
    """Return the peaks with the most chroma beyond that of paint, for their height.

    The highest peaks may be paper.
    """
    share = np.zeros(table.shape[1])
    for i in range(table.shape[1]):
        beyond_u, beyond_v = _beyond_paint(table, i, 1.0, tint_share, np.inf)
        size = math.hypot(beyond_u, beyond_v)
        step_u, step_v = table[STEP_U, i], table[STEP_V, i]
        near = u * step_u + v * step_v > _LEAST_COSINE * math.hypot(step_u, step_v)
        is_clear = size > max(_CLEAR_SIGMAS * sigma, _CLEAR_LEVELS)
        if near and is_clear and table[HEIGHT, i] >= _MIN_HEIGHT:
            share[i] = size / table[HEIGHT, i]
    return np.flatnonzero(share > _BEST_SHARE * element_at(share[share > 0.0], 0.95))


@kernel
def _useful_height(height: FloatArray, likelihood: FloatArray) -> float:
    lines, peaks = np.zeros(_N_KINDS), np.zeros(_N_KINDS)
    for i in range(height.shape[0]):
        kind = _kind_of(height[i])
        peaks[kind] += 1.0
        lines[kind] += likelihood[i] > _CLEARLY
    n_useless = 0
    while n_useless < _N_KINDS and (
        lines[n_useless] < _FEW_LINES or lines[n_useless] <= _USEFUL_SHARE * peaks[n_useless]
    ):
        n_useless += 1
    return float(min(math.ceil(2.0 ** (n_useless / _KINDS_PER_OCTAVE)), HIGHEST_USEFUL))


@kernel
def _weigh(
    table: FloatArray,
    u: float,
    v: float,
    ratio: float,
    sigma: float,
    paint_u: float,
    paint_v: float,
    spread_u: float,
    spread_v: float,
    along_spread: float,
    across_spread: float,
    widest_white_px: float,
    likelihood: FloatArray,
) -> None:
    """Write the likelihood of each peak, given what a line shows for each level of height."""
    n = table.shape[1]
    odds, kind = np.empty(n), np.empty(n, np.int64)
    for i in range(n):
        height = table[HEIGHT, i]
        line = ratio * height
        step_u, step_v = table[STEP_U, i], table[STEP_V, i]
        size = math.sqrt(step_u**2 + step_v**2)
        # A step is the largest of three, so that noise alone has one.
        left = (
            max(1.0 - _LARGEST_OF_THREE * max(sigma - _QUIET, 0.0) / size, 0.0)
            if size > 0.0
            else 0.0
        )
        step_u, step_v = left * step_u, left * step_v
        along, across = u * step_u + v * step_v, v * step_u - u * step_v
        # More of the colour than expected is no evidence against a line.
        off_line = min(along - line, 0.0)
        var_along = sigma**2 + (along_spread * line) ** 2
        var_across = sigma**2 + (across_spread * line) ** 2
        if spread_u > 0.0:
            off_u, off_v = step_u - paint_u * height, step_v - paint_v * height
            off_paint = off_u**2 / (sigma**2 + (spread_u * height) ** 2)
            off_paint += off_v**2 / (sigma**2 + (spread_v * height) ** 2)
        else:
            beyond_u, beyond_v = _beyond_paint(table, i, left, _TINT_SHARE, _PAINT_SHARE * line)
            off_paint = (beyond_u**2 + beyond_v**2) / (sigma**2 + (_RATIO_OF_PAINT * height) ** 2)
        log_odds = 0.5 * (off_paint - off_line**2 / var_along - across**2 / var_across)
        if size > _CLEAR_SIGMAS * sigma and along < _LEAST_COSINE * left * size:
            # Light of another colour.
            log_odds = -_MAX_LOG_ODDS
        odds[i] = math.exp(min(max(log_odds, -_MAX_LOG_ODDS), _MAX_LOG_ODDS))
        kind[i] = _kind_of(height)
    share = np.full(_N_KINDS, 0.5)
    for _ in range(_ROUNDS):
        lines, peaks = np.full(_N_KINDS, 1.0), np.full(_N_KINDS, 2.0)
        for i in range(n):
            prior = share[kind[i]]
            likelihood[i] = prior * odds[i] / (prior * odds[i] + 1.0 - prior)
            lines[kind[i]] += likelihood[i]
            peaks[kind[i]] += 1.0
        share = lines / peaks
    for i in range(n):
        if table[TOP, i] >= _WHITE and table[WIDTH, i] <= widest_white_px:
            likelihood[i] = max(likelihood[i], 0.5)
