"""Sub-pixel refinement of chessboard corners, where four squares meet.

Around such a corner the picture is point-symmetric: blur, gamma and the printer's ink change the
look of the edges but not their crossing. A model of that neighbourhood is fitted to the pixels by
damped least squares, in compiled kernels.

Model: two straight edges cross; two opposite quadrants are light. On a ChArUco board a dark marker
begins in each light quadrant, a margin away from both edges. On small squares that is a few pixels
from the corner, so the markers are part of the model instead of a disturbance. The blur is
Gaussian and the same everywhere; the tones are a level, a contrast and a slope of the level.
`tag_corners` uses the same blurred edge.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.compiled import (
    borrowing_kernel,
    inline_borrowing_kernel,
    inner_borrowing_kernel,
    kernel,
)
from aqualvs.geometry.linear_algebra import cholesky, cholesky_solve

MIN_PIVOT = 1e-12
"""Ratio of a pivot of the normal matrix to its diagonal below which there is no information."""

_SQRT_HALF = math.sqrt(0.5)
_DENSITY_AT_ZERO = 1.0 / math.sqrt(2.0 * math.pi)


@inline_borrowing_kernel
def blurred_edge(distance: float, blur: float) -> tuple[float, float]:
    """Return the height of a Gaussian edge, 0 to 1, and its derivative by `distance`."""
    t = distance / blur
    # Beyond this many standard deviations of the blur an edge has its full height.
    reach = 4.0
    if t > reach:
        return 1.0, 0.0
    if t < -reach:
        return 0.0, 0.0
    return 0.5 + 0.5 * math.erf(_SQRT_HALF * t), _DENSITY_AT_ZERO * math.exp(-0.5 * t * t) / blur


GreyImage = NDArray[np.uint8]
"""A grey picture, shape (height, width)."""

# Unknowns: centre x, y; angles of the edges' normals; log of the blur; level, contrast, slopes.
_N = 9


class _FitOptions(NamedTuple):
    """Window, steps and convergence of the fit of a corner."""

    max_rounds: int = 3
    max_iterations: int = 12
    settled_px: float = 4e-3
    settled_log_blur: float = 0.03
    recentre_px: float = 0.6
    radius_limit_px: float = 8.0
    radius_share: float = 0.47
    min_radius_px: float = 2.4
    # Initial guess of the blur, as a share of the square.
    blur_share: float = 0.06
    max_step_px: float = 2.0
    max_step_angle: float = 0.2
    max_step_log_blur: float = 0.5
    blur_px: tuple[float, float] = (0.25, 6.0)


_FIT = _FitOptions()


# The constants of one window, in this order, as kernels take them.
_X, _Y, _RADIUS, _REACH_1, _REACH_2, _SIGN, _MARGIN, _BITS_FROM = range(8)


@kernel
def fit_saddles(
    image: GreyImage,
    axes: FloatArray,
    light_first: BoolArray,
    margin: float,
    bits_from: float,
    pixels: FloatArray,
    quality: FloatArray,
) -> None:
    """Move `pixels` (N, 2) onto the crossings; write sigma, residual share, turn (N, 3).

    Sigma stays 0 where nothing could be fitted; arguments as in `refine_saddles`.
    """
    window, matrices, vectors = np.empty(8), np.empty((3, _N, _N)), np.empty((6, _N))
    window[_MARGIN], window[_BITS_FROM] = margin, bits_from
    best = vectors[0]
    for i in range(len(pixels)):
        window[_SIGN] = 1.0 if light_first[i] else -1.0
        quality[i] = 0.0
        if not _start(axes[i], pixels[i], window, best):
            continue
        turn_1, turn_2 = best[2], best[3]
        sigma, share = _fit(image, window, matrices, vectors)
        if not sigma > 0.0:
            continue
        pixels[i, 0], pixels[i, 1] = best[0], best[1]
        quality[i, 0], quality[i, 1] = sigma, share
        quality[i, 2] = max(abs(best[2] - turn_1), abs(best[3] - turn_2))


@inline_borrowing_kernel
def _start(axes: FloatArray, pixel: FloatArray, window: FloatArray, unknowns: FloatArray) -> bool:
    """Write the initial guess; return False if the axes span no area."""
    area = axes[0, 0] * axes[1, 1] - axes[0, 1] * axes[1, 0]
    side_1 = math.hypot(axes[0, 0], axes[1, 0])
    side_2 = math.hypot(axes[0, 1], axes[1, 1])
    # Sine of the angle between the edges below which they no longer cross in a point.
    min_sine = 0.25
    if not abs(area) > min_sine * side_1 * side_2:
        return False
    window[_REACH_1], window[_REACH_2] = abs(area) / side_2, abs(area) / side_1
    # The edge along the board's y separates its x: its normal points to +x, the other's to +y.
    turn = 1.0 if area > 0.0 else -1.0
    unknowns[0], unknowns[1] = pixel[0], pixel[1]
    unknowns[2] = math.atan2(-turn * axes[0, 1], turn * axes[1, 1])
    unknowns[3] = math.atan2(turn * axes[0, 0], -turn * axes[1, 0])
    narrow = min(window[_REACH_1], window[_REACH_2])
    unknowns[4] = math.log(min(max(_FIT.blur_share * narrow, 0.7), 2.0))
    return True


@borrowing_kernel
def _fit(
    image: GreyImage, window: FloatArray, matrices: FloatArray, vectors: FloatArray
) -> tuple[float, float]:
    """Fit one corner in vectors[0]; return sigma of a coordinate and the residual's share."""
    best, unit, column = vectors[0], vectors[1], vectors[2]
    rss, count = np.inf, 0
    for _ in range(_FIT.max_rounds):
        if not _place_window(image, best, window):
            return 0.0, 1.0
        rss, count = _descend(image, window, matrices, vectors)
        if not rss < np.inf:
            return 0.0, 1.0
        if max(abs(best[0] - window[_X]), abs(best[1] - window[_Y])) < _FIT.recentre_px:
            break
    if not best[6] > 0.0 or not cholesky(matrices[0], 0.0, MIN_PIVOT, matrices[2]):
        return 0.0, 1.0
    variance = rss / (count - _N)
    spread = 0.0
    for i in range(2):
        unit[:] = 0.0
        unit[i] = 1.0
        cholesky_solve(matrices[2], unit, column)
        spread += 0.5 * variance * column[i]
    return math.sqrt(spread), math.sqrt(variance) / best[6]


@inline_borrowing_kernel
def _place_window(image: GreyImage, unknowns: FloatArray, window: FloatArray) -> bool:
    """Centre the window on the corner; return False if it is too small at the border.

    The window stays symmetric about the corner, so that effects outside the model cancel.
    """
    height, width = image.shape
    if not (0.0 <= unknowns[0] <= width - 1.0 and 0.0 <= unknowns[1] <= height - 1.0):
        return False
    x, y = round(unknowns[0]), round(unknowns[1])
    border = min(min(x, width - 1 - x), min(y, height - 1 - y)) + 0.5
    narrow = _FIT.radius_share * min(window[_REACH_1], window[_REACH_2])
    window[_X], window[_Y] = x, y
    window[_RADIUS] = min(min(narrow, _FIT.radius_limit_px), border)
    return bool(window[_RADIUS] >= _FIT.min_radius_px)


@inner_borrowing_kernel
def _descend(
    image: GreyImage, window: FloatArray, matrices: FloatArray, vectors: FloatArray
) -> tuple[float, int]:
    """Run Levenberg-Marquardt in one window; return the sum of squares and number of pixels.

    vectors[0] is the start and becomes the best; matrices[0] its normal matrix.
    """
    best, tried, gradient, step = vectors[0], vectors[1], vectors[2], vectors[4]
    _first_tones(image, window, best)
    rss, count = _sums(image, window, best, matrices[0], gradient, vectors[5])
    damping = 1e-3
    for _ in range(_FIT.max_iterations):
        if count < 2 * _N or not cholesky(matrices[0], damping, MIN_PIVOT, matrices[2]):
            return np.inf, 0
        cholesky_solve(matrices[2], gradient, step)
        _advance(best, step, tried)
        new_rss, _ = _sums(image, window, tried, matrices[1], vectors[3], vectors[5])
        if new_rss <= rss:
            settled = max(abs(step[0]), abs(step[1])) < _FIT.settled_px
            settled = settled and abs(step[4]) < _FIT.settled_log_blur
            rss, damping = new_rss, 0.1 * damping
            _keep(matrices, vectors)
            if settled:
                break
        else:
            damping = 10.0 * max(damping, 1e-3)
    return rss, count


@inline_borrowing_kernel
def _keep(matrices: FloatArray, vectors: FloatArray) -> None:
    """Copy the trial to the best, element by element: this kernel may not create arrays."""
    for i in range(_N):
        vectors[0, i], vectors[2, i] = vectors[1, i], vectors[3, i]
        for j in range(i + 1):
            matrices[0, i, j] = matrices[1, i, j]


@inline_borrowing_kernel
def _advance(best: FloatArray, step: FloatArray, tried: FloatArray) -> None:
    """Write the next trial; limit it to where the model still sees the edges."""
    limit = _FIT.max_step_px / max(_FIT.max_step_px, math.hypot(step[0], step[1]))
    for i in range(_N):
        tried[i] = best[i] + limit * step[i]
    for i in range(2, 4):
        tried[i] = best[i] + min(max(step[i], -_FIT.max_step_angle), _FIT.max_step_angle)
    log_blur = best[4] + min(max(step[4], -_FIT.max_step_log_blur), _FIT.max_step_log_blur)
    tried[4] = min(max(log_blur, math.log(_FIT.blur_px[0])), math.log(_FIT.blur_px[1]))


@inner_borrowing_kernel
def _first_tones(image: GreyImage, window: FloatArray, unknowns: FloatArray) -> None:
    """Write level and contrast from the means of the two kinds of quadrants."""
    radius = window[_RADIUS]
    light, n_light, dark, n_dark = 0.0, 1e-9, 0.0, 1e-9
    for dy in range(-int(radius), int(radius) + 1):
        for dx in range(-int(radius), int(radius) + 1):
            x, y = int(window[_X]) + dx, int(window[_Y]) + dy
            d_1 = math.cos(unknowns[2]) * dx + math.sin(unknowns[2]) * dy
            d_2 = math.cos(unknowns[3]) * dx + math.sin(unknowns[3]) * dy
            closest = min(abs(d_1), abs(d_2)) / radius
            if closest < 0.15 or dx * dx + dy * dy > radius * radius:
                continue
            if window[_SIGN] * d_1 * d_2 < 0.0:
                dark, n_dark = dark + image[y, x], n_dark + 1.0
            elif closest * radius < window[_MARGIN] * min(window[_REACH_1], window[_REACH_2]):
                light, n_light = light + image[y, x], n_light + 1.0
    unknowns[5] = dark / n_dark
    unknowns[6] = max(light / n_light - unknowns[5], 1.0)
    unknowns[7], unknowns[8] = 0.0, 0.0


@inner_borrowing_kernel
def _sums(
    image: GreyImage,
    window: FloatArray,
    unknowns: FloatArray,
    normal: FloatArray,
    gradient: FloatArray,
    row: FloatArray,
) -> tuple[float, int]:
    """Sum the squared residuals of the window, their normal matrix (lower half) and gradient."""
    radius = window[_RADIUS]
    cos_1, sin_1 = math.cos(unknowns[2]), math.sin(unknowns[2])
    cos_2, sin_2 = math.cos(unknowns[3]), math.sin(unknowns[3])
    blur, contrast = math.exp(unknowns[4]), unknowns[6]
    normal[:, :] = 0.0
    gradient[:] = 0.0
    rss, count = 0.0, 0
    for offset_y in range(-int(radius), int(radius) + 1):
        for offset_x in range(-int(radius), int(radius) + 1):
            if offset_x * offset_x + offset_y * offset_y > radius * radius:
                continue
            x, y = int(window[_X]) + offset_x, int(window[_Y]) + offset_y
            dx, dy = x - unknowns[0], y - unknowns[1]
            d_1, d_2 = cos_1 * dx + sin_1 * dy, cos_2 * dx + sin_2 * dy
            if _among_bits(d_1, d_2, blur, window):
                continue
            value, by_1, by_2, by_blur = _lightness(d_1, d_2, blur, window)
            row[0] = -contrast * (by_1 * cos_1 + by_2 * cos_2)
            row[1] = -contrast * (by_1 * sin_1 + by_2 * sin_2)
            row[2] = contrast * by_1 * (cos_1 * dy - sin_1 * dx)
            row[3] = contrast * by_2 * (cos_2 * dy - sin_2 * dx)
            row[4] = contrast * by_blur
            row[5], row[6], row[7], row[8] = 1.0, value, offset_x, offset_y
            model = unknowns[5] + contrast * value
            model += unknowns[7] * offset_x + unknowns[8] * offset_y
            residual = image[y, x] - model
            rss += residual * residual
            count += 1
            # Away from the edges only the tones matter, which is most of the window.
            first = 0 if by_1 != 0.0 or by_2 != 0.0 else 5
            for i in range(first, _N):
                gradient[i] += row[i] * residual
                for j in range(first, i + 1):
                    normal[i, j] += row[i] * row[j]
    return rss, count


@inline_borrowing_kernel
def _among_bits(d_1: float, d_2: float, blur: float, window: FloatArray) -> bool:
    """Return whether a pixel belongs to, or is blurred with, a marker's bits (not modelled)."""
    if window[_SIGN] * d_1 * d_2 <= 0.0:
        return False
    # Bits of a marker affect its border up to this many standard deviations of the blur.
    bits_reach = 2.0
    u = (abs(d_1) + bits_reach * blur) / window[_REACH_1]
    v = (abs(d_2) + bits_reach * blur) / window[_REACH_2]
    return bool(min(u, v) > window[_BITS_FROM])


@inline_borrowing_kernel
def _lightness(
    d_1: float, d_2: float, blur: float, window: FloatArray
) -> tuple[float, float, float, float]:
    """Return the light's share at signed distances from the edges, and its derivatives.

    Derivatives are by the two distances and by the logarithm of the blur; the latter is minus the
    distance times the slope of the edge.
    """
    sign = window[_SIGN]
    d_2 = sign * d_2
    e_1, s_1 = blurred_edge(d_1, blur)
    e_2, s_2 = blurred_edge(d_2, blur)
    value = e_1 * e_2 + (1.0 - e_1) * (1.0 - e_2)
    by_1, by_2 = s_1 * (2.0 * e_2 - 1.0), s_2 * (2.0 * e_1 - 1.0)
    by_blur = -d_1 * by_1 - d_2 * by_2
    if window[_MARGIN] < 1.0:
        m_1, m_2 = window[_MARGIN] * window[_REACH_1], window[_MARGIN] * window[_REACH_2]
        f_1, t_1 = blurred_edge(d_1 - m_1, blur)
        f_2, t_2 = blurred_edge(d_2 - m_2, blur)
        g_1, q_1 = blurred_edge(-d_1 - m_1, blur)
        g_2, q_2 = blurred_edge(-d_2 - m_2, blur)
        value -= f_1 * f_2 + g_1 * g_2
        by_1 -= t_1 * f_2 - q_1 * g_2
        by_2 -= f_1 * t_2 - g_1 * q_2
        by_blur += (d_1 - m_1) * t_1 * f_2 + (d_2 - m_2) * f_1 * t_2
        by_blur += (-d_1 - m_1) * q_1 * g_2 + (-d_2 - m_2) * g_1 * q_2
    return value, by_1, sign * by_2, by_blur


@dataclass(frozen=True, slots=True)
class SaddleFit:
    """Corners refined to sub-pixel accuracy."""

    pixels: FloatArray  # Shape (N, 2): in `image`; the starting place where not valid.
    # Shape (N,): standard deviation of a coordinate from the fit's own residual, in pixels.
    sigma: FloatArray
    # Shape (N,): False where the pixels do not fit the model, or the corner moved too far.
    valid: BoolArray


def refine_saddles(
    image: GreyImage,
    starts: FloatArray,
    axes: FloatArray,
    light_first: BoolArray,
    *,
    margin: float,
    bits_from: float,
) -> SaddleFit:
    """Fit the crossing of the edges at each start.

    Parameters
    ----------
    image : uint8 array, shape (height, width)
        Grey picture.
    starts : array, shape (N, 2)
        Approximate places of the corners, in `image`, pixels.
    axes : array, shape (N, 2, 2)
        `axes[:, :, 0]` and `axes[:, :, 1]`: one square's side along the board's x and y, in pixels.
    light_first : bool array, shape (N,)
        True where the square towards +x, +y of the board is light.
    margin : float
        Light margin around the marker in a light square, as a share of the square; 1 without
        markers.
    bits_from : float
        Distance from the corner beyond which the square's content is unknown, as a share of the
        square; 1 without markers.

    Returns
    -------
    SaddleFit
        Refined corners; those that the picture does not confirm are not valid.
    """
    pixels = np.array(starts, dtype=np.float64, order="C")
    quality = np.zeros((len(pixels), 3))
    fit_saddles(
        np.ascontiguousarray(image),
        np.ascontiguousarray(axes, dtype=np.float64),
        np.ascontiguousarray(light_first),
        float(margin),
        float(bits_from),
        pixels,
        quality,
    )
    sigma, residual_share, turn = quality.T
    side = np.sqrt(np.min(np.sum(np.square(axes), axis=1), axis=-1, initial=np.inf))
    wander = np.linalg.norm(pixels - starts, axis=1)
    # Limits of an accepted fit: move from the start in sides of a square, residual as a share of
    # the contrast, turn of either edge, and uncertainty of the crossing.
    max_wander = 0.25
    max_residual_share = 0.15
    max_turn = np.deg2rad(12.0)
    max_sigma_px = 0.3
    valid = (sigma > 0.0) & (sigma < max_sigma_px) & (wander <= max_wander * side)
    valid &= (residual_share < max_residual_share) & (turn < max_turn)
    return SaddleFit(np.where(valid[:, None], pixels, starts), sigma, valid)
