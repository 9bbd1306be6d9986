"""Stripes in a whole picture, for lasers whose planes are not known yet.

Compression removes the colour of parts of a thin line, and print or a dark surface their height, so
that the segments left over are not certain to be laser light when judged alone. They are therefore
linked to certain ones. From the end of a line, along its direction there, a window opens that
widens with distance, as the direction is uncertain and the surface may bend. The density of other
segments that are at least as likely to be a line, and run the same way, is counted in the picture
itself. A segment continues the line if at most a hundredth of such a segment is expected by chance
in the window up to it (the number of false alarms of Desolneux, Moisan and Morel 2000, "Meaningful
Alignments"). Only detected peaks are added, and no line begins without a certain segment.
"""

import math
from collections import deque
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import cv2
import numpy as np

from aqualvs.calibration.lasers.stripes_on_planes import StripePoints
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import kernel
from aqualvs.scanning.laser_bands import SLOPE_CELL, LaserBand, SearchAxis, pixels_per_line
from aqualvs.scanning.laser_colour import LaserColour
from aqualvs.scanning.scan import Frame, ImagePlane, planes_of_image, without_neutral_chroma
from aqualvs.scanning.stripe import StripePeaks
from aqualvs.scanning.stripe_segments import (
    LENGTH,
    SMOOTHING,
    StripeSegments,
    find_segments,
    line_log_odds,
)

# Largest slope, in pixels across search lines per pixel: steeper stripes, at less than 45 degrees
# to their search lines, are left to the other axis.
_MAX_SLOPE = 1.0
# Full width at half height of a normal distribution, in standard deviations.
_WIDTH_OF_SIGMA = 2.355
# Longest side of a map of `cv2.remap`, which must stay below 32768.
_MAP_LENGTH = 30000
# Least probability that a segment is a laser's line, by its shape and colour and by the picture's
# other lines.
_MIN_LIKELIHOOD = 0.5
# A segment whose log odds are below the threshold by more than this continues no line.
_MAX_SHORTFALL = 2.0
# Shortest segment that may begin a line, as a share of the picture's width.
_MIN_LENGTH_SHARE = 0.015


@dataclass(frozen=True, slots=True)
class StripePixels(StripePoints):
    """Points on stripes of a picture, N of them, ordered along each unbroken chain."""

    height: FloatArray  # Shape (N,): peak above background, in grey levels.
    width: FloatArray  # Shape (N,): full width at half height across the stripe, in pixels.


def find_stripes(image: ImagePlane | Frame, wavelength_nm: float | None = None) -> StripePixels:
    """Find laser lines: thin, long, of the lasers' colour, and similar to each other.

    The picture is grey (height, width), or BGR as OpenCV reads it (height, width, 3); in a grey one
    every thin bright line counts. Each segment is searched along the axis that crosses it at the
    larger angle. `wavelength_nm` is that of the lasers; green if None. Empty if no segment is
    certain.
    """
    frame = image if isinstance(image, Frame) else Frame(0, 0.0, *planes_of_image(image))
    frame = without_neutral_chroma(frame)
    width = frame.luma.shape[1]
    found = find_all_segments(frame, wavelength_nm)
    table = np.concatenate([segments.table for segments in found], axis=1)
    log_odds = line_log_odds(table, width, has_colour=frame.chroma is not None)
    least = math.log(_MIN_LIKELIHOOD / (1.0 - _MIN_LIKELIHOOD))
    size_px = width, frame.luma.shape[0]
    line = continued(found, log_odds, least, _MIN_LENGTH_SHARE * width, size_px)
    lines: dict[int, list[StripePixels]] = {}
    first = 0
    for segments in found:
        here = slice(first, first + len(segments.start) - 1)
        keep = line[here] >= 0
        for number, chain in zip(line[here][keep], extended(segments, keep), strict=True):
            points = _pixels_of(segments.search, segments.peaks, chain)
            lines.setdefault(int(number), []).append(points)
        first = here.stop
    chains = [chain for one in lines.values() for chain in _unless_blob(one)]
    # Chains are numbered consecutively.
    none = np.zeros(0)
    places = none.reshape(0, 2)
    each = [StripePixels(places, places, none.astype(np.int64), none, none, none)]
    each += [replace(one, chain=np.full(len(one), i)) for i, one in enumerate(chains)]
    names = [field.name for field in fields(StripePixels)]
    stripes = StripePixels(
        *(np.concatenate([getattr(one, name) for one in each]) for name in names)
    )
    return replace(stripes, sigma_px=_sigma_px(frame.luma, stripes))


def find_all_segments(frame: Frame, wavelength_nm: float | None) -> list[StripeSegments]:
    """Find the segments of all lines, laser light or not, one set for each search axis.

    The wavelength of the lasers, green if None, selects the channel in which lines are brightest.
    """
    size_px = frame.luma.shape[1], frame.luma.shape[0]
    colour, line_px = LaserColour.of(wavelength_nm), pixels_per_line(size_px)
    found = []
    for axis in SearchAxis:
        # A band that covers the whole picture, for slopes up to `_MAX_SLOPE`.
        n_pixels, length = size_px if axis is SearchAxis.ALONG_Y else size_px[::-1]
        n_lines = n_pixels // line_px
        cells = -(-length // SLOPE_CELL), -(-n_lines // SLOPE_CELL)
        slopes = np.full(cells, _MAX_SLOPE * line_px)
        lowest, highest = np.zeros(n_lines, np.int64), np.full(n_lines, length - 1)
        band = LaserBand(axis, line_px, lowest, highest, -slopes, slopes, colour)
        found.append(find_segments(frame, band))
    return found


def _pixels_of(search: LaserBand, peaks: StripePeaks, chain: IntArray) -> StripePixels:
    """Return the points of one chain of peaks, without dots and parts that are too steep."""
    axis = search.axis
    line = search.line_px * (peaks.line[chain].astype(np.float64) + 0.5) - 0.5
    slope = _slopes(line, peaks.position[chain])
    width = peaks.width[chain]
    # A stripe at exactly 45 degrees belongs to one axis only.
    not_steep = np.abs(slope) <= _MAX_SLOPE * (1.0 if axis is SearchAxis.ALONG_Y else 0.999999)
    keep = not_steep & ~_in_dot(width, search.line_px)
    chain, line, slope = chain[keep], line[keep], slope[keep]
    along_x = axis is SearchAxis.ALONG_X
    cosine = 1.0 / np.hypot(1.0, slope)
    pixels = np.stack([line, peaks.position[chain]], axis=-1)
    across = np.stack([-slope * cosine, cosine], axis=-1)
    # Without the broadening by smoothing along slanted stripes.
    width, added = peaks.width[chain], _WIDTH_OF_SIGMA * SMOOTHING * (slope * search.line_px)
    width = np.sqrt(np.maximum(width**2 - added**2, (0.5 * width) ** 2)) * cosine
    return StripePixels(
        pixels[:, ::-1] if along_x else pixels,
        across[:, ::-1] if along_x else across,
        np.zeros(len(chain), np.int64),
        np.zeros(len(chain)),
        peaks.height[chain],
        width,
    )


def _in_dot(width: FloatArray, line_px: int) -> BoolArray:
    """Mark the peaks (N,) of a chain that lie on a dot, by their widths in pixels."""
    # Peaks wider than `max_width` medians of their chain are a dot on the stripe, unless the wide
    # part is longer than `longest_dot` of its own widths: then a pale surface saturates the camera.
    max_width, longest_dot = 1.8, 1.5
    # The measured width of thinner lines varies with their position between two pixels.
    thinnest_px = 2.0
    wide = width > max_width * max(float(np.median(width)), thinnest_px)
    bounds = np.flatnonzero(np.diff(wide, prepend=False, append=False))
    for first, end in bounds.reshape(-1, 2):
        if line_px * (end - first) > longest_dot * np.median(width[first:end]):
            wide[first:end] = False
    return wide


def _sigma_px(luma: ImagePlane, stripes: StripePixels) -> FloatArray:
    """Return the nominal noise (N,) of points across their stripes, in pixels."""

    def asymmetry(at: float) -> FloatArray:
        """Return the brightness of one side minus the other, `at` widths away, by peak height."""
        arms = at * stripes.width[:, None] * stripes.across
        sides = [_bilinear(luma, stripes.pixels + sign * arms) for sign in (-1.0, 1.0)]
        return (sides[1] - sides[0]) / stripes.height

    # A painted surface that is lighter on one side, beyond the stripe or on its slopes, shifts the
    # centre by about this many widths per unit of asymmetry.
    flank_at, flank_shift = 1.3, 0.2
    slope_at, slope_shift = 0.5, 0.35
    shift = np.hypot(flank_shift * asymmetry(flank_at), slope_shift * asymmetry(slope_at))
    # Noise of the centre by speckle, as a share of the width; and the least noise, by 8 bits and a
    # Bayer pattern.
    sigma_in_widths, min_sigma_px = 0.01, 0.05
    in_widths = np.hypot(sigma_in_widths, shift)
    return np.hypot(min_sigma_px, in_widths * stripes.width)


def _bilinear(luma: ImagePlane, pixels: FloatArray) -> FloatArray:
    x, y = np.ascontiguousarray(pixels.T, np.float32)
    rows = [slice(i, i + _MAP_LENGTH) for i in range(0, len(x), _MAP_LENGTH)]
    values = [
        cv2.remap(luma, x[r], y[r], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel()
        for r in rows
    ]
    return np.concatenate([np.zeros(0), *values])


def _slopes(line: FloatArray, position: FloatArray) -> FloatArray:
    """Return d position / d line (N,), by a straight fit to the neighbours along the chain."""
    index = np.arange(len(line))
    # Peaks on either side that a slope is fitted to.
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
    return (window(x * y) - window(x) * window(y) / n) / np.maximum(spread, 1e-9)


def _unless_blob(line: list[StripePixels]) -> list[StripePixels]:
    """Return the chains of a line that have at least three points; none if they are a blob."""
    chains = [chain for chain in line if len(chain) >= 3]
    if not chains:
        return []
    length = sum(float(np.hypot(*(chain.pixels[-1] - chain.pixels[0]))) for chain in chains)
    # A line shorter than this many of its own widths is a blob: the beam's own dot, a glint, a
    # mark.
    min_length_in_widths = 2.5
    width = np.median(np.concatenate([chain.width for chain in chains]))
    return chains if length >= min_length_in_widths * float(width) else []


class _Window(NamedTuple):
    """Window beyond the end of a line in which the line may continue."""

    # Half width at the end of the line, and its growth per pixel of distance, for bent surfaces.
    half_px: float = 0.75
    widening: float = 0.04
    # Largest change of direction.
    turn_rad: float = 0.15
    # Standard deviations of noise by which half width and change of direction may be larger.
    n_sigmas: float = 2.0
    # Largest overlap of two segments along the line.
    overlap_px: float = 2.5


_WINDOW = _Window()


class _Ends(NamedTuple):
    """First and last end of segments, P of them, by a straight fit to the peaks at each end."""

    # Shape (P, 2, 2): position of each end.
    at: FloatArray
    # Shape (P, 2, 2): unit vectors along the fit, away from the segment.
    outward: FloatArray
    # Shape (P, 2): standard deviations of position across the segment, and of direction.
    sigma_px: FloatArray
    sigma_rad: FloatArray
    # Shape (P,): whether the segment makes less than 45 degrees with its search lines; the other
    # search axis finds it then, too.
    is_steep: BoolArray


def continued(
    found: list[StripeSegments],
    log_odds: FloatArray,
    least: float,
    min_length_px: float,
    size_px: tuple[int, int],
) -> IntArray:
    """Find the segments of lines: long and likely ones, and others that continue these.

    Returns the number (P,) of the line that each segment belongs to, or -1. A line may have
    segments of both search axes.

    Parameters
    ----------
    found : list of StripeSegments
        All segments of one picture, by search axis; P in all.
    log_odds : array, shape (P,)
        Log odds that each segment is a line.
    least, min_length_px : float
        Log odds and length from which on a segment is a line by itself.
    size_px : tuple of int
        Width and height of the picture.
    """
    length = np.concatenate([segments.table[LENGTH] for segments in found])
    pool = np.flatnonzero(log_odds >= least - _MAX_SHORTFALL)
    ends, log_odds = _ends(found, pool), log_odds[pool]
    in_line = (log_odds >= least) & (length[pool] >= min_length_px)
    by_chance = np.flatnonzero(~in_line & ~ends.is_steep)
    root = np.arange(len(pool))
    waiting = deque(int(a) for a in np.flatnonzero(in_line))
    area_px = float(size_px[0] * size_px[1])
    while waiting:
        a = waiting.popleft()
        for end in (0, 1):
            b = _next_segment(ends, a, end, log_odds, in_line, by_chance, area_px)
            if b < 0:
                continue
            root[root == root[b]] = root[a]
            if not in_line[b]:
                in_line[b] = True
                waiting.append(b)
    line = np.full(len(length), -1)
    line[pool[in_line]] = root[in_line]
    return line


def _next_segment(
    ends: _Ends,
    a: int,
    end: int,
    log_odds: FloatArray,
    in_line: BoolArray,
    by_chance: IntArray,
    area_px: float,
) -> int:
    """Return the segment that continues segment `a` beyond one of its ends, or -1.

    `by_chance` are the segments that serve to count how many are met by chance.
    """
    # Largest number of segments expected by chance in the window up to one that continues a line.
    # The k-th likeliest segment is met by chance with this probability divided by k, so that some
    # hundredths of all ends are continued wrongly.
    max_false_alarms = 0.01
    ahead, way_px, near = _ahead(ends, a, end)
    turn = _turn(ends.outward[a, end], ends.outward[by_chance, 1])
    half_px = _WINDOW.half_px + _WINDOW.n_sigmas * float(ends.sigma_px[a, end])
    widening = _WINDOW.widening + _WINDOW.n_sigmas * float(ends.sigma_rad[a, end])
    for b in ahead[np.argsort(way_px[ahead])]:
        turn_rad = _turn_limit(ends.sigma_rad[a, end], ends.sigma_rad[b, near[b]])
        others = (log_odds[by_chance] >= log_odds[b]) & (turn <= turn_rad)
        # One at least, so that windows do not reach across a picture with little else in it.
        n = max(int(np.count_nonzero(others)), 1)
        # Area of the window up to the segment, in square pixels.
        far_px = max(way_px[b], 1.0)
        window_px = (2.0 * half_px + widening * far_px) * far_px
        if n / area_px * window_px <= max_false_alarms:
            return int(b)
        if in_line[b]:
            break
    return -1


def _ahead(ends: _Ends, a: int, end: int) -> tuple[IntArray, FloatArray, IntArray]:
    """Return the segments in the window of an end; of all, the distance along it and near end."""
    along = ends.outward[a, end]
    off = ends.at - ends.at[a, end]
    way, across = off @ along, off @ np.array([-along[1], along[0]])
    near = np.argmin(way, axis=1)
    every = np.arange(len(way))
    way_px, far_px, beside_px = way[every, near], way[every, 1 - near], across[every, near]
    noise = ends.sigma_px[a, end] ** 2 + (ends.sigma_rad[a, end] * way_px) ** 2
    noise = np.sqrt(noise + ends.sigma_px[every, near] ** 2)
    half_px = _WINDOW.half_px + _WINDOW.widening * np.maximum(way_px, 0.0)
    inside = np.abs(beside_px) <= half_px + _WINDOW.n_sigmas * noise
    inside &= (way_px > -_WINDOW.overlap_px) & (far_px > np.maximum(way_px, 0.0))
    limit = _turn_limit(ends.sigma_rad[a, end], ends.sigma_rad[every, near])
    inside &= _turn(along, ends.outward[every, 1 - near]) <= limit
    inside &= ~ends.is_steep
    inside[a] = False
    return np.flatnonzero(inside), way_px, near


def _turn(along: FloatArray, others: FloatArray) -> FloatArray:
    """Return the angles (N,) between a direction and others (N, 2), regardless of their sign."""
    return np.arccos(np.minimum(np.abs(others @ along), 1.0))


def _turn_limit(one_rad: FloatArray, other_rad: FloatArray) -> FloatArray:
    return _WINDOW.turn_rad + _WINDOW.n_sigmas * np.hypot(one_rad, other_rad)


def _ends(found: list[StripeSegments], pool: IntArray) -> _Ends:
    """Fit straight lines to both ends of the segments with the numbers `pool`."""
    n = len(pool)
    points, sigmas = np.zeros((2, n, 2, 2)), np.zeros((2, n, 2))
    ends = _Ends(points[0], points[1], sigmas[0], sigmas[1], np.zeros(n, bool))
    first = 0
    for segments in found:
        last = first + len(segments.start) - 1
        line = segments.search.line_px * (segments.peaks.line.astype(np.float64) + 0.5) - 0.5
        mine = np.flatnonzero((pool >= first) & (pool < last))
        for i in mine:
            k = pool[i] - first
            chain = segments.order[segments.start[k] : segments.start[k + 1]]
            x, y = line[chain], segments.peaks.position[chain]
            _fit_ends(x, y, ends, int(i))
            ends.is_steep[i] = abs(y[-1] - y[0]) > x[-1] - x[0]
        if segments.search.axis is SearchAxis.ALONG_X:
            ends.at[mine] = ends.at[mine][..., ::-1]
            ends.outward[mine] = ends.outward[mine][..., ::-1]
        first = last
    return ends


def _fit_ends(line: FloatArray, position: FloatArray, ends: _Ends, i: int) -> None:
    """Write the ends of segment i to `ends`, with search lines as x."""
    # Peaks to fit, and least noise of a peak in pixels: smoothing along the stripe correlates the
    # noise of neighbours, so that residuals show too little of it.
    n_fit, min_sigma_px = 16, 0.3
    for end, peaks in ((0, slice(None, n_fit)), (1, slice(-n_fit, None))):
        x, y = line[peaks], position[peaks]
        n, middle = len(x), x.mean()
        spread = float(((x - middle) ** 2).sum())
        slope = float(((x - middle) * y).sum()) / spread
        residuals = y - y.mean() - slope * (x - middle)
        sigma = max(math.sqrt(float((residuals**2).sum()) / max(n - 2, 1)), min_sigma_px)
        cosine = 1.0 / math.hypot(1.0, slope)
        at = x[-end]
        ends.at[i, end] = at, y.mean() + slope * (at - middle)
        ends.outward[i, end] = np.array([cosine, slope * cosine]) * (1.0 if end else -1.0)
        place = math.sqrt(1.0 / n + (at - middle) ** 2 / spread)
        ends.sigma_px[i, end] = sigma * cosine * place
        ends.sigma_rad[i, end] = sigma * cosine**2 / math.sqrt(spread)


def extended(segments: StripeSegments, keep: BoolArray) -> list[IntArray]:
    """Return the chains of peaks of some segments, extended by the peaks beyond their ends.

    A segment ends at a kink or a gap; a few peaks beyond may still belong to the line. `keep` (P,)
    marks the segments that are lines; chains are indices of peaks along each.
    """
    peaks = segments.peaks
    first_of = np.searchsorted(peaks.line, np.arange(len(segments.search.lowest) + 1))
    bounds = zip(segments.start[:-1][keep], segments.start[1:][keep], strict=True)
    chains = [segments.order[start:end] for start, end in bounds]
    used = np.zeros(peaks.n, bool)
    for chain in chains:
        used[chain] = True
    longer = []
    for chain in chains:
        after = _following(chain, 1, peaks.line, peaks.position, peaks.height, first_of, used)
        before = _following(
            chain[::-1].copy(), -1, peaks.line, peaks.position, peaks.height, first_of, used
        )
        longer.append(np.concatenate([before[::-1], chain, after]))
    return longer


@kernel
def _following(
    chain: IntArray,
    step: int,
    line: IntArray,
    position: FloatArray,
    height: FloatArray,
    first_of: IntArray,
    used: BoolArray,
) -> IntArray:
    """Return the peaks that follow the last one of a chain, one a search line; mark them as used.

    `step` is 1 or -1, the direction in search lines.
    """
    n = chain.shape[0]
    # Most peaks that extend a line; largest distance in pixels from the extrapolation by the slope
    # over `slope_peaks`; least height as a share of the chain's median; search lines without a peak
    # at which to stop.
    max_following, follow_px, slope_peaks, min_height_share, max_missed = 8, 1.2, 6, 0.3, 4
    last, back = chain[n - 1], chain[max(n - 1 - slope_peaks, 0)]
    slope = (position[last] - position[back]) / max(abs(line[last] - line[back]), 1)
    least = min_height_share * np.median(height[chain])
    found = np.empty(max_following, np.int64)
    n_found, x, place, gap = 0, line[last], position[last], 0
    while n_found < max_following and gap < max_missed:
        x += step
        if x < 0 or x >= first_of.shape[0] - 1:
            break
        gap += 1
        best, best_miss = -1, follow_px
        for i in range(first_of[x], first_of[x + 1]):
            miss = abs(position[i] - (place + slope * gap))
            if miss < best_miss and height[i] >= least:
                best, best_miss = i, miss
        if best < 0:
            continue
        if used[best]:
            break
        place, gap = position[best], 0
        used[best] = True
        found[n_found] = best
        n_found += 1
    return found[:n_found].copy()
