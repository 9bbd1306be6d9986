"""Segments of stripes in a whole picture, and the log odds that each is a laser's line.

For pictures without a rig. A segment is a smooth chain of peaks of neighbouring search lines. One
peak carries little evidence: noise, texture and printed edges make thousands, some of them of the
laser's colour. Pooled along a segment, the evidence is strong: a laser's line is long for its
width, thin, brighter than both sides, and moves the chroma along the wavelength's direction and not
across it. If a camera or codec has blurred the chroma, a line shows it only in a halo beside
itself. Logistic regression weights the evidence twice: first with general statistics of lines, then
with those of the picture's own lines, which are learned from the segments that are certain. Their
positions and directions are evidence, too. If no segment is certain, the picture has no line.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import ZERO, inner_kernel, kernel
from aqualvs.scanning.laser_bands import LaserBand, SearchAxis
from aqualvs.scanning.laser_colour import RATIO_EXPECTED, RATIO_MIN, WHITE, channel_image, full_size
from aqualvs.scanning.scan import Frame, ImagePlane
from aqualvs.scanning.segments import link_segments
from aqualvs.scanning.stripe import HEIGHT as PEAK_HEIGHT
from aqualvs.scanning.stripe import N_MEASURES, POSITION, PeakFinder, SearchImage, StripePeaks
from aqualvs.scanning.stripe import WIDTH as PEAK_WIDTH

Rows = NDArray[np.float32]

LENGTH, HEIGHT, WIDTH, TOP, ONE_SIDED, ALONG, ACROSS, HALO = range(8)
FIRST_X, FIRST_Y, LAST_X, LAST_Y = range(8, 12)
"""Rows of a table of segments: lengths and places in pixels, heights in grey levels."""

# Least height of peaks in grey levels; standard deviation in search lines of the Gaussian that
# smooths the picture along the stripes, so that noise of one pixel does not break a faint line;
# largest number of peaks per search line.
_MIN_CONTRAST, SMOOTHING, _PEAKS_PER_LINE = 3, 1.0, 120
# A segment ends where the next peak is farther away, in search lines or in pixels, or where three
# peaks bend by more than this, in pixels and as a share of the width. Least number of peaks.
_MAX_LINE_STEP, _MAX_STEP_PX = 2, 4.0
_KINK_PX, _KINK_IN_WIDTHS, MIN_PEAKS = 1.0, 0.25, 5
# Intensity and chroma of a stripe are summed up to its flanks, this many pixels beyond half height.
_FLANK_PX = 2


class _EvidenceOptions(NamedTuple):
    """Bounds of the evidence, and segments that are certainly lines.

    Tuned on the photographs of docs/real-light.md and on rendered caustics.
    """

    # Bounds of the chroma for each grey level of intensity, along and across the laser's colour,
    # and of the difference between the flanks as a share of the height. Every red line of the
    # photographs has at least the expected halo, in every coding.
    max_ratio: float = 1.0
    min_ratio: float = -0.5
    max_across: float = 0.6
    max_one_sided: float = 3.0
    halo_expected: float = 0.3
    # Segments above these log odds, by the general statistics of lines, are certain if they are
    # longer than this share of the picture's width. Without laser, long segments of its colour are
    # rare: those of rendered caustics have up to 3.0, longer gaps between lines of another colour
    # up to 1.3. Segments with less chroma than any camera's lines, on themselves or beside them,
    # are not certain: a highlight on steel, for example.
    certain: float = 3.2
    certain_share: float = 0.08
    certain_if_long: float = 1.4
    long_share: float = 0.2
    # Segments that continue one another: largest gap as a share of the picture's width; largest
    # distance from the straight continuation in pixels, and as a share of the gap.
    max_gap: float = 0.1
    off_px: float = 1.5
    off_share: float = 0.05


_EVIDENCE = _EvidenceOptions()


class Weights(NamedTuple):
    """Weights of the evidence, as log odds."""

    general: FloatArray  # Shape (15,): weights of what `general_evidence` returns.
    own: FloatArray  # Shape (18,): weights of what `own_evidence` returns.


WEIGHTS = Weights(
    np.concatenate(
        [
            [-5.32, -1.41, 0.834, 0.189, -0.0757, 0.121, -1.5, -1.01],
            [7.99, 5.92, 0.83, 3.04, 1.09, -0.535, -0.0397],
        ]
    ),
    np.concatenate(
        [
            [-3.82, -1.37, 0.57, 0.235, -0.185, 0.234, -1.29, -0.867],
            [9.35, 8.12, 0.773, 0.78, 0.756, 0.241, 0.602, -0.208, -0.778, 0.677],
        ]
    ),
)
"""Fitted by tools/fit_stripe_pieces.py."""


class StripeSegments(NamedTuple):
    """Segments of stripes, P of them, along one search direction."""

    search: LaserBand  # Of the whole picture.
    peaks: StripePeaks  # All peaks of the search direction.
    order: IntArray  # Shape (N,): indices into the peaks, segment by segment, along each segment.
    start: IntArray  # Shape (P + 1,): where each segment begins in `order`, and N.
    table: FloatArray  # Shape (12, P): measures of the segments, rows as named above.


class PictureRows(NamedTuple):
    """A picture laid out for one search direction, with search lines as rows."""

    # Shape (n_lines, length): grey levels of the picture in which the laser has the most contrast.
    intensity: Rows
    # Shape (n_lines, length): chroma along the direction of the laser's colour and at right angles
    # to it; of shape (0, 0) for a grey picture.
    along: Rows
    across: Rows


def picture_rows(frame: Frame, search: LaserBand) -> PictureRows:
    """Return a picture as the rows of a search, its intensity smoothed along the stripes.

    Parameters
    ----------
    frame : Frame
    search : LaserBand
        Of the whole picture, with the colour of the laser.
    """
    light = _rows(channel_image(frame, search.colour), search)
    # In wide pictures, a stripe of a pixel or two is smoothed across as well.
    across = np.array([1.0]) if search.line_px == 1 else np.array([0.25, 0.5, 0.25])
    along = cv2.getGaussianKernel(5, SMOOTHING)
    light = np.asarray(
        cv2.sepFilter2D(light, -1, across, along, borderType=cv2.BORDER_REPLICATE), np.float32
    )
    if frame.chroma is None:
        none = np.empty((0, 0), np.float32)
        return PictureRows(light, none, none)
    u, v = (plane.astype(np.float32) - 128.0 for plane in frame.chroma)
    to_u, to_v = search.colour.value
    off = (to_u * u + to_v * v, to_u * v - to_v * u)
    return PictureRows(light, *(_rows(full_size(one, frame), search) for one in off))


def _rows(image: ImagePlane | Rows, search: LaserBand) -> Rows:
    """Return the search lines (n_lines, length) of an image, means of several pixels if need be."""
    lines = image.T if search.axis is SearchAxis.ALONG_Y else image
    step = search.line_px
    n = len(lines) // step
    rows = lines[: n * step].astype(np.float32)
    if step > 1:
        rows = sum((rows[i::step] for i in range(1, step)), rows[::step]) / np.float32(step)
    return np.ascontiguousarray(rows)


def find_segments(frame: Frame, search: LaserBand) -> StripeSegments:
    """Find and measure all segments, of whatever colour, along one search direction.

    Parameters
    ----------
    frame : Frame
    search : LaserBand
        Of the whole picture, with the colour of the laser.
    """
    rows = picture_rows(frame, search)
    peaks = _peaks(rows.intensity, search, frame.luma.shape[1])
    order, start = _smooth_chains(peaks, search)
    n_measures = 12
    table = np.empty((n_measures, len(start) - 1))
    along_x = search.axis is SearchAxis.ALONG_X
    _measure(rows, peaks, order, start, search.line_px, along_x, table)
    return StripeSegments(search, peaks, order, start, table)


def _peaks(light: Rows, search: LaserBand, width_px: int) -> StripePeaks:
    """Return the peaks of a picture of this width whose flanks lie in the picture."""
    n_lines, length = light.shape
    # Reach of the search for the background: a share of the picture's width, or this many pixels.
    reach_share, min_reach = 0.045, 8
    reach_px = max(min_reach, round(reach_share * width_px))
    directions = np.array([search.colour.value])
    finder = PeakFinder(length, search.lowest, search.highest, reach_px, directions)
    grey = np.empty((0, 0), np.uint8)
    image = SearchImage(np.rint(light).astype(np.uint8), grey, grey, search.line_px, along_x=False)
    most = _PEAKS_PER_LINE * n_lines
    # Part of a larger array, as the scanner's: for another kind the finder is compiled once more.
    line, table = np.empty(most, np.int64), np.empty((N_MEASURES, most + 1))[:, :most]
    n = finder.find(image, _MIN_CONTRAST, 1, line, table)
    line, table = line[:n], table[:, :n]
    position, height, width = table[POSITION], table[PEAK_HEIGHT], table[PEAK_WIDTH]
    margin = np.ceil(0.5 * width) + _FLANK_PX + 2.0
    inside = (position >= margin) & (position < length - 1 - margin)
    position, height, width = (column[inside] for column in (position, height, width))
    likelihood, pull = np.ones(len(position)), np.zeros(len(position))
    return StripePeaks(line[inside], position, height, width, likelihood, pull)


def _smooth_chains(peaks: StripePeaks, search: LaserBand) -> tuple[IntArray, IntArray]:
    """Return chains of peaks without gaps, kinks and steps: `order`, `start` of `StripeSegments`.

    Chains shorter than MIN_PEAKS are dropped.
    """
    segments = link_segments(peaks, search)
    order = segments.order
    if len(order) == 0:
        return order, np.zeros(1, np.int64)
    line, position, width = peaks.line[order], peaks.position[order], peaks.width[order]
    step = np.diff(line)
    ends = (np.diff(segments.component) != 0) | (step <= 0) | (step > _MAX_LINE_STEP)
    ends |= np.abs(np.diff(position)) > _MAX_STEP_PX
    bend = np.abs(position[2:] - 2.0 * position[1:-1] + position[:-2])
    kinks = np.flatnonzero(bend > np.maximum(_KINK_PX, _KINK_IN_WIDTHS * width[1:-1])) + 1
    ends[kinks - 1] = ends[kinks] = True
    ends[_height_steps(peaks.height[order], ends)] = True
    start = np.concatenate([[0], np.flatnonzero(ends) + 1, [len(order)]])
    long = np.diff(start) >= MIN_PEAKS
    order = order[np.repeat(long, np.diff(start))]
    return order, np.concatenate([[0], np.cumsum(np.diff(start)[long])])


def _height_steps(height: FloatArray, ends: BoolArray) -> IntArray:
    """Return the peaks (of N) after which the height changes lastingly, but not beside an end."""
    n, half = len(height), MIN_PEAKS
    if n < 2 * half:
        return np.zeros(0, np.int64)
    median = np.median(np.lib.stride_tricks.sliding_window_view(np.log(height), half), axis=1)
    change = np.zeros(n - 1)
    change[half - 1 : n - half] = np.abs(median[half:] - median[:-half])
    chain = np.concatenate([[0], np.cumsum(ends)])
    change[half - 1 : n - half][chain[: n - 2 * half + 1] != chain[2 * half - 1 :]] = 0.0
    # A step is one end only: at the largest difference of the medians.
    largest = np.lib.stride_tricks.sliding_window_view(np.pad(change, half), 2 * half + 1).max(1)
    # If the median height of MIN_PEAKS peaks changes by this factor, another object begins: noise
    # and the ringing of a codec continue many lines.
    height_step = 3.0
    return np.flatnonzero((change > math.log(height_step)) & (change >= largest))


@kernel
def _measure(
    rows: PictureRows,
    peaks: StripePeaks,
    order: IntArray,
    start: IntArray,
    line_px: int,
    along_x: bool,
    table: FloatArray,
) -> None:
    """Write the measures of all segments; fields and shapes as in `StripeSegments`."""
    light, along, across = rows
    line, position, width = peaks.line, peaks.position, peaks.width
    has_colour = along.shape[0] > 0
    # The halo is summed up to this many pixels beyond the flanks: codecs keep chroma in blocks of
    # 16 pixels.
    halo_px = 6
    # The halo ends at another stripe: a segment over this share of the search lines, which noise
    # and broken lines do not reach.
    long_share = 0.1
    is_long = np.zeros(line.shape[0], np.bool_)
    for k in range(start.shape[0] - 1):
        for i in order[start[k] : start[k + 1]]:
            is_long[i] = start[k + 1] - start[k] >= long_share * light.shape[0]
    for k in range(start.shape[0] - 1):
        members = order[start[k] : start[k + 1]]
        n = members.shape[0]
        tops, above, one_sided = np.empty(n), np.empty(n), np.empty(n)
        total, total_along, total_across, halo = 0.0, 0.0, 0.0, 0.0
        for i in range(n):
            x, peak = line[members[i]], int(position[members[i]] + 0.5)
            reach = int(np.ceil(0.5 * width[members[i]])) + _FLANK_PX
            low, high = peak - reach, peak + reach
            left = 0.5 * (light[x, low] + light[x, low - 1])
            right = 0.5 * (light[x, high] + light[x, high + 1])
            top = max(light[x, peak], light[x, peak - 1], light[x, peak + 1])
            tops[i], above[i], one_sided[i] = top, top - max(left, right), abs(right - left)
            if has_colour:
                total += _sum_above_flanks(light[x], low, high)
                total_along += _sum_above_flanks(along[x], low, high)
                total_across += _sum_above_flanks(across[x], low, high)
                before = _middle(peaks, is_long, members[i], ZERO - 1)
                after = _middle(peaks, is_long, members[i], ZERO + 1)
                low = min(int(np.ceil(max(low - halo_px, before, 1.0))), low)
                high = max(int(min(high + halo_px, after, light.shape[1] - 2.0)), high)
                halo += _sum_above_flanks(along[x], low, high)
        total = max(total, 1.0)
        first, last = members[0], members[n - 1]
        begin, end = line_px * (line[first] + 0.5) - 0.5, line_px * (line[last] + 0.5) - 0.5
        table[LENGTH, k] = np.hypot(end - begin, position[last] - position[first])
        table[HEIGHT, k] = np.median(peaks.height[members])
        table[WIDTH, k] = np.median(width[members])
        table[TOP, k] = np.median(tops)
        table[ONE_SIDED, k] = np.median(one_sided) / max(np.median(above), 1.0)
        table[ALONG, k], table[ACROSS, k] = total_along / total, total_across / total
        table[HALO, k] = halo / total
        x, y = (FIRST_Y, FIRST_X) if along_x else (FIRST_X, FIRST_Y)
        table[x, k], table[y, k] = begin, position[first]
        x, y = (LAST_Y, LAST_X) if along_x else (LAST_X, LAST_Y)
        table[x, k], table[y, k] = end, position[last]


@inner_kernel
def _middle(peaks: StripePeaks, is_long: BoolArray, i: int, step: int) -> float:
    """Return the midpoint between peak i and the next long segment, before (step -1) or after (1).

    Position along the search line in pixels; infinite where there is no such segment.
    """
    line, position, k = peaks.line, peaks.position, i + step
    while 0 <= k < line.shape[0] and line[k] == line[i]:
        if is_long[k]:
            return float(0.5 * (position[k] + position[i]))
        k += step
    return step * np.inf


@inner_kernel
def _sum_above_flanks(row: Rows, low: int, high: int) -> float:
    """Return the sum of a row between two flanks, above the straight line that joins them."""
    left, right = 0.5 * (row[low] + row[low - 1]), 0.5 * (row[high] + row[high + 1])
    total = 0.0
    for k in range(low + 1, high):
        share = (k - low + 0.5) / (high - low + 1.0)
        total += row[k] - (1.0 - share) * left - share * right
    return total


def general_evidence(table: FloatArray, width_px: int, *, has_colour: bool) -> FloatArray:
    """Return the evidence that separates lines from other objects in any picture.

    Parameters
    ----------
    table : array, shape (12, P)
        Measures of segments.
    width_px : int
        Of the picture: the width of stripes is about the same share of it in every camera.
    has_colour : bool
        Whether the picture has chroma; else every segment counts as of the laser's colour.

    Returns
    -------
    array, shape (P, 15)
        A row for each segment.
    """
    length = np.log(32.0 * table[LENGTH] / width_px + 0.1)
    slimness = np.log(table[LENGTH] / table[WIDTH] + 0.5)
    height = np.log(np.maximum(table[HEIGHT], _MIN_CONTRAST) / 20.0)
    width = np.log(200.0 * table[WIDTH] / width_px + 0.1)
    n = table.shape[1]
    along, halo = np.full(n, RATIO_EXPECTED), np.full(n, _EVIDENCE.halo_expected)
    most, across = halo, np.zeros(n)
    if has_colour:
        along = _clip_ratio(table, ALONG, RATIO_MIN)
        halo = _clip_ratio(table, HALO, _EVIDENCE.halo_expected)
        most, across = np.maximum(table[ALONG], table[HALO]), table[ACROSS]
    levels = np.maximum(np.maximum(along, halo), 0.0) * table[HEIGHT]
    as_expected = np.clip(halo, 0.0, _EVIDENCE.halo_expected)
    # More chroma for each level than this is coloured paint, or the halo of another object; the
    # logarithm of the excess is clipped.
    painted_ratio, max_excess = 1.5, 3.0
    # Chroma that counts as noise, in levels.
    chroma_noise = 2.0
    return np.stack(
        [
            np.ones(n),
            length,
            slimness,
            height,
            height**2,
            length * height,
            width,
            np.minimum(table[ONE_SIDED], _EVIDENCE.max_one_sided),
            as_expected,
            # Noise hides the colour of a short segment, not that of a long one.
            as_expected * length,
            np.clip(halo, _EVIDENCE.min_ratio, 0.0),
            np.clip(along, _EVIDENCE.min_ratio, 0.0),
            np.log1p(levels / chroma_noise),
            np.clip(np.log(np.maximum(most, 1e-3) / painted_ratio), 0.0, max_excess),
            np.minimum(np.abs(across), _EVIDENCE.max_across),
        ],
        axis=-1,
    )


def _clip_ratio(table: FloatArray, row: int, in_white: float) -> FloatArray:
    """Return a clipped ratio of chroma to intensity (P,); at least `in_white` in a white core."""
    ratio = np.minimum(table[row], _EVIDENCE.max_ratio)
    believed: FloatArray = np.where(table[TOP] >= WHITE, np.maximum(ratio, in_white), ratio)
    return believed


class OwnLines(NamedTuple):
    """Medians over a picture's lines: chroma for each level, logarithms of width and height."""

    along: float
    across: float
    log_width: float
    log_height: float


def learn_lines(
    table: FloatArray, log_odds: FloatArray, width_px: int, *, has_colour: bool
) -> OwnLines | None:
    """Learn the statistics of the picture's lines from the segments that are certain.

    Parameters
    ----------
    table : array, shape (12, P)
        Measures of segments; lengths include the segments that continue them.
    log_odds : array, shape (P,)
        By the general evidence.
    width_px : int
        Of the picture.
    has_colour : bool
        Whether the picture has chroma.

    Returns
    -------
    OwnLines or None
        None where no segment is certain.
    """
    share = table[LENGTH] / width_px
    is_certain = (log_odds > _EVIDENCE.certain) & (share >= _EVIDENCE.certain_share)
    is_certain |= (log_odds > _EVIDENCE.certain_if_long) & (share >= _EVIDENCE.long_share)
    if has_colour:
        is_certain &= np.minimum(table[ALONG], table[HALO]) >= RATIO_MIN
    certain = np.flatnonzero(is_certain)
    if len(certain) == 0:
        return None
    weight = table[LENGTH, certain] * np.clip(log_odds[certain] - _EVIDENCE.certain + 0.5, 0.5, 3.0)

    def median(values: FloatArray) -> float:
        by_size = np.argsort(values)
        total = np.cumsum(weight[by_size])
        return float(values[by_size[np.searchsorted(total, 0.5 * total[-1])]])

    of = table[:, certain]
    return OwnLines(
        median(of[ALONG]), median(of[ACROSS]), median(np.log(of[WIDTH])), median(np.log(of[HEIGHT]))
    )


def own_evidence(
    table: FloatArray, lines: OwnLines, width_px: int, *, has_colour: bool
) -> FloatArray:
    """Return the general evidence, and the differences of segments from the picture's own lines.

    Parameters
    ----------
    table, width_px, has_colour
        As in `general_evidence`.
    lines : OwnLines
        From `learn_lines`.

    Returns
    -------
    array, shape (P, 18)
    """
    general = general_evidence(table, width_px, has_colour=has_colour)
    off_across = np.zeros(table.shape[1])
    # Spread of the colour of a picture's lines: chroma for each level, and a share of their chroma.
    across_spread, share_spread = 0.08, 0.3
    # Largest evidence from one difference: three standard deviations, squared.
    max_own = 9.0
    if has_colour:
        spread = across_spread + share_spread * np.hypot(lines.along, lines.across)
        off_across = (
            np.clip(table[ACROSS] - lines.across, -_EVIDENCE.max_across, _EVIDENCE.max_across)
            / spread
        )
    off_width = np.log(table[WIDTH]) - lines.log_width
    higher = np.maximum(np.log(table[HEIGHT]) - lines.log_height, 0.0)
    own = np.minimum(np.stack([off_across**2, off_width**2, higher], axis=-1), max_own)
    return np.concatenate([general, own], axis=1)


def place_evidence(table: FloatArray, log_odds: FloatArray, width_px: int) -> FloatArray:
    """Return the evidence, as log odds, from the position and direction of segments.

    Lines of one laser pass through a part of the picture only, in about one direction, or in a few
    on bent surfaces. The densities of lines and of other objects are estimated from the picture's
    other segments. Lines may lie where none is known: each segment that is certain makes that less
    likely, as in a Dirichlet process. If few are certain, or if lines and other objects lie alike,
    this evidence is weak.

    Parameters
    ----------
    table : array, shape (12, P)
        Measures of all segments of one picture.
    log_odds : array, shape (P,)
        That each is a line, by its shape and colour.
    width_px : int
        Of the picture.

    Returns
    -------
    array, shape (P,)
    """
    # Segments above these log odds give the density of lines, those below zero that of others.
    certain = 2.0
    # Weight of the uniform prior density, in segments: a picture has few lasers, and each of their
    # lines breaks into a few segments. With 3 or 8, as many red lines are found in the photographs
    # of docs/real-light.md; with more, more of a second, poorly visible laser.
    n_unknown = 5.0
    # The second round includes segments that the first one has made certain.
    n_rounds = 2
    # Enough segments of other objects for their density; more are thinned, to save time.
    n_enough = 500
    evidence = np.zeros(len(log_odds))
    for _ in range(n_rounds):
        now = log_odds + evidence
        lines, others = np.flatnonzero(now > certain), np.flatnonzero(now < 0.0)
        others = others[:: max(len(others) // n_enough, 1)]
        of_others = _density(table, others, width_px)
        of_others = (n_unknown + len(others) * of_others) / (n_unknown + len(others))
        ratio = _density(table, lines, width_px) / of_others
        evidence = np.log((n_unknown + len(lines) * ratio) / (n_unknown + len(lines)))
    return evidence


def _density(table: FloatArray, of: IntArray, width_px: int) -> FloatArray:
    """Return the density (P,) of segments `of` along each segment, itself left out; 1 if uniform.

    A kernel density estimate over the direction and the position across the lines.
    """
    # Kernel width in direction: that of one laser's lines on bent surfaces, and of short segments.
    # Kernel width in position, due to the depth of the scene, as a share of the picture's width.
    spread_rad, spread_share = 0.2, 0.04
    x, y = 0.5 * (table[FIRST_X] + table[LAST_X]), 0.5 * (table[FIRST_Y] + table[LAST_Y])
    angle = np.arctan2(table[LAST_Y] - table[FIRST_Y], table[LAST_X] - table[FIRST_X])
    cosine, sine = np.cos(angle), np.sin(angle)
    height = math.pi / (2.0 * math.pi * spread_rad * spread_share)
    density = np.zeros(len(x))
    total = float(table[LENGTH, of].sum())
    for k in of:
        turn = angle - angle[k]
        turn -= math.pi * np.rint(turn / math.pi)
        off = ((y - y[k]) * cosine[k] - (x - x[k]) * sine[k]) / (spread_share * width_px)
        near = np.exp(-0.5 * ((turn / spread_rad) ** 2 + off**2))
        near[k] = 0.0
        density += table[LENGTH, k] * near
    total_of_others = np.full(len(x), total)
    total_of_others[of] -= table[LENGTH, of]
    density *= height / np.maximum(total_of_others, 1e-9)
    return density


def line_log_odds(table: FloatArray, width_px: int, *, has_colour: bool) -> FloatArray:
    """Return the log odds that each segment is a laser's line.

    Parameters
    ----------
    table : array, shape (12, P)
        Measures of all segments of one picture.
    width_px : int
        Of the picture.
    has_colour : bool
        Whether the picture has chroma.

    Returns
    -------
    array, shape (P,)
        Minus infinity for all where none is certain.
    """
    log_odds = general_evidence(table, width_px, has_colour=has_colour) @ WEIGHTS.general
    # Segments that continue one another count with their total length.
    likely = np.flatnonzero(log_odds > 0.0)
    joined = table.copy()
    joined[LENGTH, likely] = _length_with_continuations(table[:, likely], width_px)
    log_odds = general_evidence(joined, width_px, has_colour=has_colour) @ WEIGHTS.general
    lines = learn_lines(joined, log_odds, width_px, has_colour=has_colour)
    if lines is None:
        return np.full(table.shape[1], -np.inf)
    found: FloatArray = own_evidence(table, lines, width_px, has_colour=has_colour) @ WEIGHTS.own
    return found + place_evidence(table, found, width_px)


def _length_with_continuations(table: FloatArray, width_px: int) -> FloatArray:
    """Return the length (P,) of each segment together with the segments that continue it."""
    if table.shape[1] == 0:
        return np.zeros(0)
    # First and last point of each segment.
    ends = table[[FIRST_X, FIRST_Y, LAST_X, LAST_Y]].T.reshape(-1, 2, 2)
    linked = np.array([_continuations(one, ends, width_px) for one in ends])
    linked |= linked.T | np.eye(len(ends), dtype=bool)
    _, line = connected_components(csr_array(linked), directed=False)
    return np.asarray(np.bincount(line, table[LENGTH])[line], np.float64)


def _continuations(segment: FloatArray, others: FloatArray, width_px: int) -> BoolArray:
    """Mark the segments (N, 2, 2) that lie on the straight continuation of a segment (2, 2)."""
    direction = segment[1] - segment[0]
    length = float(np.hypot(*direction))
    direction = direction / max(length, 1e-9)
    off = others - segment.mean(axis=0)
    along, across = off @ direction, off @ np.array([-direction[1], direction[0]])
    # The gap is at most the length of the segment, because its direction is uncertain.
    gap = np.abs(along).min(axis=1) - 0.5 * length
    reach = min(length, _EVIDENCE.max_gap * width_px)
    allowed = _EVIDENCE.off_px + _EVIDENCE.off_share * np.maximum(gap, 0.0)
    continues: BoolArray = np.abs(across).max(axis=1) <= allowed
    continues &= (gap > -0.5 * length) & (gap <= reach)
    return continues
