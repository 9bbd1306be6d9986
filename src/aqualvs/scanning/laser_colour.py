"""Colour of laser light: its effect on a pixel's chroma, and the likelihood that a peak is laser.

A camera sees a 532 nm line neither as pure green nor always as green: its colour filters overlap,
white balance scales the channels, and an overexposed core is white inside a green halo. On nine
cameras, in air and under water, green lines lower V in 94 to 100 % of their pixels, but U in 0 to
100 %; red lines raise V. So colour is evidence, not a gate: the wavelength gives the half of the
(U, V) plane to look in; the frame's own best stripes give the direction in which its lines move the
chroma, and the amount for each grey level of height; and every peak gets the likelihood that it is
such a line and not paint, twine or glare. The colour is learned from each frame alone: a drifting
white balance needs no tracking, and the result for a frame depends on that frame only.
"""

import math
from enum import Enum
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import inline_kernel, inner_kernel, kernel, lazy_kernel
from aqualvs.geometry.linear_algebra import (
    flatnonzero,
    hypot,
    lower_quantile,
    squared,
    sum_of,
    take,
)
from aqualvs.scanning.scan import Frame, ImagePlane
from aqualvs.scanning.stripe import HEIGHT, IMBALANCE, STEP_U, STEP_V, TINT_U, TINT_V, TOP, WIDTH


class _LearnOptions(NamedTuple):
    """Peaks from which the colour of the lines is learned.

    A step is the chroma of a peak less that of its flanks, in levels. Tuned on the rendered sample
    and benchmark dives, the photographs of the sample folders and dives of the simulated cameras.
    """

    min_height: float = 12.0  # Least height of the peaks, in grey levels.
    # Least chroma step beyond that of paint, in standard deviations and in levels.
    clear_sigmas: float = 3.0
    clear_levels: float = 3.0
    min_cosine: float = 0.2  # Least cosine of its angle to the wavelength's direction.
    best_share: float = 0.6  # Least share of the largest step relative to the height.
    min_learned: int = 16  # Least number of such peaks.
    # Largest and smallest scatter of half of them, as shares of their median step.
    max_scatter: float = 0.4
    min_scatter: float = 0.22


_LEARN = _LearnOptions()


class _PaintOptions(NamedTuple):
    """Paint: objects of one colour that make most of the tall peaks, such as twine in the sun.

    Tuned on the same pictures as `_LearnOptions`.
    """

    tall: float = 20.0  # Least height of its peaks, in grey levels.
    crowd: float = 1.5  # Least ratio of their number to the number that the lasers can make.
    # Least spread of its chroma for each level of height, and largest spread across the tint of its
    # light.
    min_spread: float = 0.02
    max_across: float = 0.045
    # Peaks within the first distance from its median colour are paint, those beyond the second may
    # be lines; in standard deviations.
    of_crowd: float = 2.5
    clear_of_paint: float = 4.0
    # Standard deviation of a normal distribution, in median absolute deviations.
    mad_to_sigma: float = 1.4826


_PAINT = _PaintOptions()

# Chroma levels for each grey level of height: expected of a line if none is clear enough to learn
# from, least and largest learned value that is accepted, and standard deviation of paint and glare
# about zero. Lines of nine cameras have 0.15 to 0.7.
RATIO_EXPECTED, RATIO_MIN, _RATIO_MAX, _RATIO_OF_PAINT = 0.25, 0.1, 0.75, 0.05


class _LikelihoodOptions(NamedTuple):
    """Likelihood that a peak is a laser line, by its colour.

    Tuned on the same pictures as `_LearnOptions`.
    """

    # Standard deviations of one frame's lines about their mean step, as shares of it: along its
    # direction and across. Overexposed lines show less chroma and differ in hue, faint ones more.
    ratio_spread: float = 0.35
    across_spread: float = 0.5
    # Paint shows up to this share of the tint of its flanks, and at most the second share of the
    # chroma of a line, however green the scene is.
    tint_share: float = 0.5
    paint_share: float = 0.5
    # Expected maximum of three normal numbers, in standard deviations; up to this noise, in levels,
    # the lines' own differences are larger.
    largest_of_three: float = 0.85
    quiet: float = 1.4
    # Limit of the log-likelihood ratio.
    max_log_odds: float = 12.0


_LIKELIHOOD = _LikelihoodOptions()

# Bins of height (grey levels): their number for each doubling, and in total; refinements of the
# share of lines in them, and of the paint.
_BINS_PER_OCTAVE, _N_BINS, _ROUNDS = 2.0, 16, 3
_BIN_OF_HEIGHT = np.minimum(_BINS_PER_OCTAVE * np.log2(np.arange(256).clip(1)), _N_BINS - 1)
_BIN_OF_HEIGHT = _BIN_OF_HEIGHT.astype(np.int64)
WHITE = 225.0
"""Luma from which on the colour of a peak's core is ignored: every overexposed light is white."""
HIGHEST_USEFUL = 32
"""Height in grey levels from which on peaks are always used."""
_N_LOW_BINS = int(_BIN_OF_HEIGHT[HIGHEST_USEFUL])


class LaserColour(Enum):
    """The camera channel in which a laser's light is brightest.

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
        # Wavelengths (nm) that separate blue, green and red lines.
        blue_to_green_nm, green_to_red_nm = 490.0, 580.0
        if wavelength_nm < blue_to_green_nm:
            return cls.BLUE
        return cls.GREEN if wavelength_nm < green_to_red_nm else cls.RED


def channel_image(frame: Frame, colour: LaserColour) -> ImagePlane:
    """Return the picture in which a laser's light has the most contrast.

    For green this is luma, most of which is green. A blue line raises luma by a ninth of what it
    raises the blue channel, a red one by a third of the red: these channels are computed from luma
    and chroma.

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
    # Factors of V in R and of U in B, in the scale of limited-range luma (BT.601).
    red_of_v, blue_of_u = 1.596 / 1.164, 2.018 / 1.164
    chroma, weight = (
        (frame.chroma[1], red_of_v) if colour is LaserColour.RED else (frame.chroma[0], blue_of_u)
    )
    mixed = frame.luma + weight * (full_size(chroma.astype(np.float32), frame) - 128.0)
    return np.clip(np.rint(mixed), 0, 255).astype(np.uint8)


def full_size(half: NDArray[np.float32], frame: Frame) -> NDArray[np.float32]:
    """Return an image of the size of a frame's chroma, interpolated to the size of its luma."""
    size = 2 * half.shape[1], 2 * half.shape[0]
    full = cv2.resize(half, size, interpolation=cv2.INTER_LINEAR)
    height, width = frame.luma.shape
    return np.asarray(full[:height, :width], np.float32)


class Paint(NamedTuple):
    """Colour of the paint in one frame, in levels of chroma for each grey level of height."""

    # Median.
    u: float
    v: float
    # Standard deviations, those of noise taken off.
    spread_u: float
    spread_v: float


class LineColour(NamedTuple):
    """Chroma step of the laser lines of one frame."""

    # Unit vector in the (U, V) plane.
    u: float
    v: float
    # Levels along it for each grey level of a line's height.
    ratio: float
    # Standard deviation of a step by noise alone, in levels.
    sigma: float
    # Spread of lines about their mean, as shares of `ratio`, along their direction and across.
    along: float = _LIKELIHOOD.ratio_spread
    across: float = _LIKELIHOOD.across_spread
    # Colour of the peaks that are not lines, where most are of one colour.
    paint: Paint | None = None


def learn_paint(table: FloatArray, n_possible: float) -> Paint | None:
    """Learn the colour of most tall peaks, where there are more than the lasers can make.

    An example is twine in the sun.

    Parameters
    ----------
    table : array, shape (10, N)
        Measures of a sample of peaks, rows as `stripe` names them.
    n_possible : float
        Peaks that the lasers can make in the sample.

    Returns
    -------
    Paint or None
        None where there are few tall peaks, or they are not of one colour.
    """
    *paint, across_tint, n_near = _learn_paint(table, _PAINT.crowd * n_possible)
    # Paint varies along the tint of its light; a spread across it is due to lines among the peaks.
    return (
        Paint(*paint)
        if across_tint < _PAINT.max_across and n_near > _PAINT.crowd * n_possible
        else None
    )


def learn_colour(table: FloatArray, colour: LaserColour, paint: Paint | None) -> LineColour | None:
    """Learn the chroma step of the laser lines from a frame's peaks.

    Parameters
    ----------
    table : array, shape (10, N)
        Measures of peaks, rows as `stripe` names them.
    colour : LaserColour
    paint : Paint or None
        Colour of most of the peaks: then lines are the peaks that differ from it.

    Returns
    -------
    LineColour or None
        None where too few peaks are clearly of the laser's colour.
    """
    # Enough peaks to learn from; more are thinned, to save time.
    enough = 2500
    sample = table[:, :: 1 + table.shape[1] // enough]
    found = (
        LineColour(*_learn(sample, *colour.value))
        if paint is None
        else LineColour(*_learn_beside_paint(sample, *colour.value, paint), paint)
    )
    return found if found.ratio > 0.0 else None


def expected_colour(table: FloatArray, colour: LaserColour, paint: Paint | None) -> LineColour:
    """Return the chroma step of lines in a typical camera, with the noise of these peaks."""
    return LineColour(*colour.value, RATIO_EXPECTED, float(_noise(table)), paint=paint)


def laser_likelihood(
    table: FloatArray, line: LineColour, widest_white_px: float, n_possible: float = np.inf
) -> FloatArray:
    """Return the likelihood that each peak of a frame is laser light, not another bright object.

    Two explanations of a chroma step are compared: a line moves the chroma in proportion to its
    height, as the frame's best stripes do; noise does not move it, and brighter paint under the
    same light shows more of the tint that its flanks have, which is zero where the light is white.
    The share of lines among peaks of about the same height is estimated from the same steps: low
    peaks are mostly noise.

    Parameters
    ----------
    table : array, shape (10, N)
        Measures of all peaks of one frame, rows as `stripe` names them.
    line : LineColour
        From `learn_colour` or `expected_colour`.
    widest_white_px : float
        Overexposed peaks up to this width may be a line's white core, whatever their colour; wider
        ones are paper or a window.
    n_possible : float, optional
        Peaks that the lasers can make; any number if left out.

    Returns
    -------
    array, shape (N,)
        0 to 1; 0.5 where colour gives no evidence.
    """
    likelihood = np.empty(table.shape[1])
    # Spreads of 0 mean no paint.
    no_paint = Paint(0.0, 0.0, 0.0, 0.0)
    _write_likelihood(
        table, line[:6], line.paint or no_paint, widest_white_px, n_possible, likelihood
    )
    return likelihood


@inline_kernel
def _height_bin(height: float) -> int:
    return int(_BIN_OF_HEIGHT[min(int(height), 255)])


@lazy_kernel
def _noise(table: FloatArray) -> float:
    """Return the standard deviation of a step in levels, from the difference of the two flanks.

    From a low quantile, because beside other stripes and edges the flanks differ by more than
    noise.
    """
    # A quarter of a normal distribution lies within this many standard deviations of its mean.
    quarter_of_normal = 0.3186
    off = np.empty(table.shape[1])
    for i in range(table.shape[1]):
        off[i] = abs(table[IMBALANCE, i])
    noise = lower_quantile(off, 0.25) / quarter_of_normal
    # Least chroma noise after rounding and subsampling, in levels.
    min_sigma = 0.7
    return max(noise / math.sqrt(2.0), min_sigma)


@inline_kernel
def _chroma_beyond_paint(
    table: FloatArray, i: int, left: float, tint_share: float, most: float
) -> tuple[float, float]:
    """Return the part (U, V) of a peak's chroma step, times `left`, that is not due to paint.

    Brighter paint shows up to `tint_share` of the tint of its flanks, and at most `most` levels.
    """
    u, v, height = left * table[STEP_U, i], left * table[STEP_V, i], table[HEIGHT, i]
    tint_u, tint_v = height * table[TINT_U, i], height * table[TINT_V, i]
    size = hypot(tint_u, tint_v)
    if size < 1e-9:
        return u, v
    share = (u * tint_u + v * tint_v) / (size * size)
    share = min(max(share, 0.0), min(tint_share, most / size))
    return u - share * tint_u, v - share * tint_v


@lazy_kernel
def _learn(table: FloatArray, u: float, v: float) -> tuple[float, float, float, float]:
    """Return direction, ratio and noise of the frame's best stripes; a ratio of 0 if unknown."""
    sigma = _noise(table)
    # Quantile of the best stripes' ratios that is the learned one.
    learned_quantile = 0.35
    # First only steps that differ from any paint, which are the most certain; lines as green as the
    # water are found in the second pass.
    for tint_share in (1.0, _LIKELIHOOD.tint_share):
        best = _best_stripes(table, u, v, sigma, tint_share)
        if best.shape[0] < _LEARN.min_learned:
            continue
        of_u, of_v = _chroma_per_level(table, best)
        line_u, line_v, is_one_colour = _median_step(of_u, of_v)
        if is_one_colour:
            size = hypot(line_u, line_v)
            line_u, line_v = line_u / size, line_v / size
            for k in range(best.shape[0]):
                of_u[k] = line_u * of_u[k] + line_v * of_v[k]
            ratio = lower_quantile(of_u, learned_quantile)
            return line_u, line_v, max(ratio, RATIO_MIN), sigma
    return u, v, 0.0, sigma


@inner_kernel
def _chroma_per_level(table: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the steps of peaks in U and V for each level of height, corrected for overexposure."""
    of_u, of_v = np.empty(rows.shape[0]), np.empty(rows.shape[0])
    for k in range(rows.shape[0]):
        i = rows[k]
        height = table[HEIGHT, i] * _chroma_left(table[TOP, i])
        of_u[k], of_v[k] = table[STEP_U, i] / height, table[STEP_V, i] / height
    return of_u, of_v


@inner_kernel
def _median_step(of_u: FloatArray, of_v: FloatArray) -> tuple[float, float, bool]:
    """Return the median (U, V) of steps, and whether at least half of them are near it."""
    u, v = lower_quantile(of_u, 0.5), lower_quantile(of_v, 0.5)
    apart = np.empty(of_u.shape[0])
    for k in range(of_u.shape[0]):
        apart[k] = squared(of_u[k] - u) + squared(of_v[k] - v)
    usual = lower_quantile(apart, 0.5)
    return u, v, usual <= squared(_LEARN.max_scatter) * (squared(u) + squared(v))


@lazy_kernel
def _learn_paint(table: FloatArray, n_min: float) -> tuple[float, float, float, float, float, int]:
    """Return the fields of a `Paint`, its spread across the flanks' tint, and the number near it.

    The number is zero if at most `n_min` peaks are tall.
    """
    tall, n = np.empty(table.shape[1], np.int64), 0
    for i in range(table.shape[1]):
        if table[HEIGHT, i] >= _PAINT.tall:
            tall[n] = i
            n += 1
    if n <= n_min:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0
    height, of_u, of_v = np.empty(n), np.empty(n), np.empty(n)
    tint_of_u, tint_of_v = np.empty(n), np.empty(n)
    for k in range(n):
        i = tall[k]
        height[k] = table[HEIGHT, i]
        of_u[k], of_v[k] = table[STEP_U, i] / height[k], table[STEP_V, i] / height[k]
        tint_of_u[k], tint_of_v[k] = table[TINT_U, i], table[TINT_V, i]
    noise = _noise(table) / lower_quantile(height, 0.5)
    u, v, spread_u, spread_v = 0.0, 0.0, 0.0, 0.0
    near_u, near_v, n_near = np.empty(n), np.empty(n), n
    for k in range(n):
        near_u[k], near_v[k] = of_u[k], of_v[k]
    for _ in range(_ROUNDS):
        u, v = lower_quantile(near_u[:n_near], 0.5), lower_quantile(near_v[:n_near], 0.5)
        for k in range(n_near):
            near_u[k], near_v[k] = abs(near_u[k] - u), abs(near_v[k] - v)
        seen_u = _PAINT.mad_to_sigma * lower_quantile(near_u[:n_near], 0.5)
        seen_v = _PAINT.mad_to_sigma * lower_quantile(near_v[:n_near], 0.5)
        spread_u = math.sqrt(max(squared(seen_u) - squared(noise), squared(_PAINT.min_spread)))
        spread_v = math.sqrt(max(squared(seen_v) - squared(noise), squared(_PAINT.min_spread)))
        var_u, var_v = squared(spread_u) + squared(noise), squared(spread_v) + squared(noise)
        n_near = 0
        for k in range(n):
            off = squared(of_u[k] - u) / var_u + squared(of_v[k] - v) / var_v
            if off < squared(_PAINT.of_crowd):
                near_u[n_near], near_v[n_near] = of_u[k], of_v[k]
                n_near += 1
    tint_u, tint_v = lower_quantile(tint_of_u, 0.5), lower_quantile(tint_of_v, 0.5)
    size = hypot(tint_u, tint_v)
    across = hypot(spread_u, spread_v)
    if size > _PAINT.min_spread:
        across = hypot(tint_v * spread_u, tint_u * spread_v) / size
    return u, v, spread_u, spread_v, across, n_near


@lazy_kernel
def _learn_beside_paint(
    table: FloatArray, u: float, v: float, paint: Paint
) -> tuple[float, float, float, float, float, float]:
    """Return the fields of a `LineColour` of peaks that are not paint; a ratio of 0 if unknown."""
    paint_u, paint_v, spread_u, spread_v = paint
    sigma = _noise(table)
    is_clear = np.zeros(table.shape[1], np.bool_)
    for i in range(table.shape[1]):
        height, step_u, step_v = table[HEIGHT, i], table[STEP_U, i], table[STEP_V, i]
        if height >= _PAINT.tall and _is_towards(step_u, step_v, u, v):
            off_u, off_v = step_u - paint_u * height, step_v - paint_v * height
            var_u = squared(spread_u * height) + squared(sigma)
            var_v = squared(spread_v * height) + squared(sigma)
            off = squared(off_u) / var_u + squared(off_v) / var_v
            is_clear[i] = off > squared(_PAINT.clear_of_paint)
    best = flatnonzero(is_clear)
    if best.shape[0] < _LEARN.min_learned:
        return u, v, 0.0, sigma, 1.0, 1.0
    of_u, of_v = _chroma_per_level(table, best)
    line_u, line_v, is_one_colour = _median_step(of_u, of_v)
    size = hypot(line_u, line_v)
    if size > _RATIO_MAX or not is_one_colour:
        return u, v, 0.0, sigma, 1.0, 1.0
    line_u, line_v = line_u / size, line_v / size
    off_along, off_across = np.empty(best.shape[0]), np.empty(best.shape[0])
    for k in range(best.shape[0]):
        off_along[k] = abs(line_u * of_u[k] + line_v * of_v[k] - size)
        off_across[k] = abs(line_v * of_u[k] - line_u * of_v[k])
    along = max(_PAINT.mad_to_sigma * lower_quantile(off_along, 0.5) / size, _LEARN.min_scatter)
    across = max(_PAINT.mad_to_sigma * lower_quantile(off_across, 0.5) / size, _LEARN.min_scatter)
    return line_u, line_v, max(size, RATIO_MIN), sigma, along, across


@inline_kernel
def _is_towards(step_u: float, step_v: float, u: float, v: float) -> bool:
    """Return whether the angle of a chroma step to a direction is small enough for a line."""
    along = u * step_u + v * step_v
    size = squared(step_u) + squared(step_v)
    return along > 0.0 and squared(along) > squared(_LEARN.min_cosine) * size


@inline_kernel
def _chroma_left(top: float) -> float:
    """Return the share of its chroma that a line of this luma shows: 1, less if overexposed."""
    # Luma from which on a channel may be clipped, luma at full scale, and the share of the chroma
    # that remains there; measured on rendered stripes, at the middle or an edge.
    clipped, full, left_at_full = 185.0, 235.0, 0.33
    return 1.0 - (1.0 - left_at_full) * min(max((top - clipped) / (full - clipped), 0.0), 1.0)


@inner_kernel
def _best_stripes(
    table: FloatArray, u: float, v: float, sigma: float, tint_share: float
) -> IntArray:
    """Return the indices of the peaks with the most chroma beyond paint, relative to their height.

    Height alone would select white paper.
    """
    share, least = np.zeros(table.shape[1]), max(_LEARN.clear_sigmas * sigma, _LEARN.clear_levels)
    for i in range(table.shape[1]):
        height = table[HEIGHT, i]
        if height >= _LEARN.min_height and _is_towards(table[STEP_U, i], table[STEP_V, i], u, v):
            beyond_u, beyond_v = _chroma_beyond_paint(table, i, 1.0, tint_share, np.inf)
            size = hypot(beyond_u, beyond_v)
            share[i] = size / (height * _chroma_left(table[TOP, i])) if size > least else 0.0
    chosen = np.empty(table.shape[1], np.bool_)
    for i in range(table.shape[1]):
        chosen[i] = share[i] > 0.0
    lowest = _LEARN.best_share * lower_quantile(take(share, flatnonzero(chosen)), 0.95)
    for i in range(table.shape[1]):
        chosen[i] = share[i] > lowest
    return flatnonzero(chosen)


@lazy_kernel
def useful_height(height: FloatArray, likelihood: FloatArray) -> int:
    """Return the height in grey levels below which hardly any peak is clearly laser light.

    Parameters
    ----------
    height, likelihood : array, shape (N,)
        Of a sample of peaks.
    """
    lines, peaks = np.zeros(_N_BINS), np.zeros(_N_BINS)
    clearly = 0.8  # Likelihood of a clear line.
    for i in range(height.shape[0]):
        b = _height_bin(height[i])
        peaks[b] += 1.0
        lines[b] += likelihood[i] > clearly
    useful = HIGHEST_USEFUL
    # Both the peaks of a bin and all peaks from its height on must be useful.
    all_lines, all_peaks = 0.0, 0.0
    for b in range(_N_LOW_BINS - 1, -1, -1):
        all_lines, all_peaks = all_lines + lines[b], all_peaks + peaks[b]
        if _are_useful(lines[b], peaks[b]) and _are_useful(all_lines, all_peaks):
            useful = math.ceil(2.0 ** (b / _BINS_PER_OCTAVE))
    return useful


@inline_kernel
def _are_useful(lines: float, peaks: float) -> bool:
    """Return whether enough of a sample's peaks are clearly lines."""
    # Least number of lines, and least share of the peaks.
    few_lines, useful_share = 4.0, 0.05
    return bool(lines >= few_lines and lines > useful_share * peaks)


@kernel
def _write_likelihood(
    table: FloatArray,
    line_colour: tuple[float, float, float, float, float, float],
    paint: Paint,
    widest_white_px: float,
    n_possible: float,
    likelihood: FloatArray,
) -> None:
    """Write the likelihood (N,) of each peak, given the first six fields of a `LineColour`."""
    u, v, ratio, sigma, along_spread, across_spread = line_colour
    paint_u, paint_v, spread_u, spread_v = paint
    n = table.shape[1]
    odds, bin_of = np.empty(n), np.empty(n, np.int64)
    for i in range(n):
        height = table[HEIGHT, i]
        full = ratio * height
        line = full * _chroma_left(table[TOP, i])
        step_u, step_v = table[STEP_U, i], table[STEP_V, i]
        size = hypot(step_u, step_v)
        # A step is the largest of three, so its mean is not zero for pure noise: shrink it.
        left = (
            max(
                1.0 - _LIKELIHOOD.largest_of_three * max(sigma - _LIKELIHOOD.quiet, 0.0) / size, 0.0
            )
            if size > 0.0
            else 0.0
        )
        step_u, step_v = left * step_u, left * step_v
        along, across = u * step_u + v * step_v, v * step_u - u * step_v
        # More chroma than expected is no evidence against a line.
        off_line = min(along - line, 0.0)
        var_along = squared(sigma) + squared(along_spread * full)
        var_across = squared(sigma) + squared(across_spread * full)
        if spread_u > 0.0:
            off_u, off_v = step_u - paint_u * height, step_v - paint_v * height
            var_u = squared(sigma) + squared(spread_u * height)
            var_v = squared(sigma) + squared(spread_v * height)
            # Normalisation of the two densities: the narrower one is higher.
            off_paint = squared(off_u) / var_u + squared(off_v) / var_v
            off_paint -= math.log(var_along * var_across / (var_u * var_v))
        else:
            beyond_u, beyond_v = _chroma_beyond_paint(
                table, i, left, _LIKELIHOOD.tint_share, _LIKELIHOOD.paint_share * line
            )
            off_paint = (squared(beyond_u) + squared(beyond_v)) / (
                squared(sigma) + squared(_RATIO_OF_PAINT * height)
            )
        log_odds = 0.5 * (off_paint - squared(off_line) / var_along - squared(across) / var_across)
        if size > _LEARN.clear_sigmas * sigma and along < _LEARN.min_cosine * left * size:
            # Light of another colour.
            log_odds = -_LIKELIHOOD.max_log_odds
        odds[i] = math.exp(min(max(log_odds, -_LIKELIHOOD.max_log_odds), _LIKELIHOOD.max_log_odds))
        bin_of[i] = _height_bin(height)
    share, lines, peaks = np.empty(_N_BINS), np.empty(_N_BINS), np.empty(_N_BINS)
    for k in range(_N_BINS):
        share[k] = 0.5
    for _ in range(_ROUNDS):
        for k in range(_N_BINS):
            lines[k], peaks[k] = 1.0, 2.0
        for i in range(n):
            prior = share[bin_of[i]]
            likelihood[i] = prior * odds[i] / (prior * odds[i] + 1.0 - prior)
            lines[bin_of[i]] += likelihood[i]
            peaks[bin_of[i]] += 1.0
        # The lasers cannot make more lines than `n_possible`.
        most = min(n_possible / sum_of(lines), 1.0)
        for k in range(_N_BINS):
            share[k] = lines[k] / peaks[k] * most
    for i in range(n):
        if table[TOP, i] >= WHITE and table[WIDTH, i] <= widest_white_px:
            likelihood[i] = max(likelihood[i], 0.5)
