"""Sub-pixel refinement of marker corners, without the bias of blur and gamma.

An outer corner of a marker lies between light paper and dark ink. Blur and gamma shift both of its
edges towards the dark side, by about a third of a pixel, and the corner with them. Therefore the
whole marker is fitted to the pixels at once, by Levenberg-Marquardt in compiled kernels: it has
edges of both directions, outside and among its bits, which separate that shift from the marker's
size. Pixels that something else covers, such as a laser stripe, do not fit. They and their
surroundings are left out, and corners that the rest does not determine are not valid.

Model: a grid of dark and light cells with a light margin around it; a homography with a slight bend
(a dome bends straight lines) from marker to picture; a Gaussian blur of the light; a power law from
light to grey level, the camera's gamma; a level (the dark cells' grey) and a contrast, which may
vary linearly across the marker.

Marker coordinates q: (-1, -1) is the top-left corner, (1, 1) the bottom-right one.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from aqualvs.calibration.detection.saddle_corners import MIN_PIVOT, GreyImage, blurred_edge
from aqualvs.calibration.targets.targets import aruco_dictionary
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import (
    inline_borrowing_kernel,
    inner_borrowing_kernel,
    inner_kernel,
    kernel,
)
from aqualvs.geometry.linear_algebra import cholesky, cholesky_inverse, cholesky_solve

# Unknowns: centre 0-1; linear part 2-5, row by row; perspective 6-7; bend of x and of y 8-13, in
# pixels per q0 q0, q0 q1, q1 q1; log of the blur 14; log of gamma 15; level 16, contrast 17; slopes
# of the level 18-19 and of the contrast 20-21 along q.
N_UNKNOWNS = 22
BLUR, GAMMA, LEVEL, CONTRAST = 14, 15, 16, 17


def marker_to_pixel(unknowns: FloatArray, q_0: float, q_1: float) -> tuple[float, float]:
    """Return the pixel of a point of the marker."""
    w = 1.0 + unknowns[6] * q_0 + unknowns[7] * q_1
    a, b, c = q_0 * q_0, q_0 * q_1, q_1 * q_1
    x = unknowns[0] + (unknowns[2] * q_0 + unknowns[3] * q_1) / w
    y = unknowns[1] + (unknowns[4] * q_0 + unknowns[5] * q_1) / w
    x += unknowns[8] * a + unknowns[9] * b + unknowns[10] * c
    y += unknowns[11] * a + unknowns[12] * b + unknowns[13] * c
    return x, y


@inline_borrowing_kernel
def _marker_jacobian(
    unknowns: FloatArray, q_0: float, q_1: float
) -> tuple[float, float, float, float]:
    """Return d pixel / d q, row by row."""
    w = 1.0 + unknowns[6] * q_0 + unknowns[7] * q_1
    x, y = unknowns[2] * q_0 + unknowns[3] * q_1, unknowns[4] * q_0 + unknowns[5] * q_1
    x_0 = (unknowns[2] - x * unknowns[6] / w) / w + 2.0 * unknowns[8] * q_0 + unknowns[9] * q_1
    x_1 = (unknowns[3] - x * unknowns[7] / w) / w + unknowns[9] * q_0 + 2.0 * unknowns[10] * q_1
    y_0 = (unknowns[4] - y * unknowns[6] / w) / w + 2.0 * unknowns[11] * q_0 + unknowns[12] * q_1
    y_1 = (unknowns[5] - y * unknowns[7] / w) / w + unknowns[12] * q_0 + 2.0 * unknowns[13] * q_1
    return x_0, x_1, y_0, y_1


@inline_borrowing_kernel
def _coverage(
    cells: FloatArray, u: float, v: float, sigma_u: float, sigma_v: float, rho: float
) -> tuple[float, float, float, float, float]:
    """Return the light's share in a Gaussian about (u, v), and its derivatives.

    Cell i, j of `cells` spans [i - 1, i] x [j - 1, j] with v as the row: the light margin is
    included. The Gaussian has standard deviations `sigma_u`, `sigma_v` and correlation `rho`, which
    Mehler's series takes into account to its second order around every corner of a cell.

    Returns
    -------
    value, by_u, by_v, by_log_sigma, by_log_sigma_of_v
    """
    n = len(cells)
    value, by_u, by_v, by_s, by_t = 0.0, 0.0, 0.0, 0.0, 0.0
    first_i = min(max(math.floor(u - 4.0 * sigma_u) + 1, 0), n - 1)
    last_i = min(max(math.floor(u + 4.0 * sigma_u) + 1, 0), n - 1)
    first_j = min(max(math.floor(v - 4.0 * sigma_v) + 1, 0), n - 1)
    last_j = min(max(math.floor(v + 4.0 * sigma_v) + 1, 0), n - 1)
    low_v, low_slope_v = 0.0, 0.0
    for j in range(first_j, last_j + 1):
        high_v, high_slope_v = 1.0, 0.0
        if j < last_j:
            high_v, high_slope_v = blurred_edge(j - v, sigma_v)
        low_u, low_slope_u = 0.0, 0.0
        share_v = high_v - low_v
        for i in range(first_i, last_i + 1):
            high_u, high_slope_u = 1.0, 0.0
            if i < last_i:
                high_u, high_slope_u = blurred_edge(i - u, sigma_u)
            share_u = high_u - low_u
            cell = cells[j, i]
            value += cell * share_u * share_v
            by_u += cell * (low_slope_u - high_slope_u) * share_v
            by_v += cell * share_u * (low_slope_v - high_slope_v)
            by_s += cell * ((i - 1 - u) * low_slope_u - (i - u) * high_slope_u) * share_v
            by_t += cell * share_u * ((j - 1 - v) * low_slope_v - (j - v) * high_slope_v)
            if i < last_i and j < last_j:
                mixed = cell - cells[j, i + 1] - cells[j + 1, i] + cells[j + 1, i + 1]
                both = sigma_u * high_slope_u * sigma_v * high_slope_v
                product = (i - u) * (j - v) / (sigma_u * sigma_v)
                value += mixed * rho * both * (1.0 + 0.5 * rho * product)
            low_u, low_slope_u = high_u, high_slope_u
        low_v, low_slope_v = high_v, high_slope_v
    return value, by_u, by_v, by_s, by_t


@inline_borrowing_kernel
def _tone(h: float, gamma: float, darkness: float) -> tuple[float, float, float, float]:
    """Return the tone, 0 to 1, of a share of light after the camera's gamma.

    Light adds up linearly and grey levels are its power 1 / gamma: `darkness` is the dark tone's
    grey level over the contrast.

    Returns
    -------
    tone, by_h, by_log_gamma, by_darkness
    """
    if h <= 0.0 or h >= 1.0:
        return h, 1.0, 0.0, 0.0
    # Ratio of the ink's tone to the contrast below which ink is taken as black.
    min_darkness = 0.02
    r = max(darkness, min_darkness)
    log_low, log_high = math.log(r), math.log(1.0 + r)
    low, high = math.exp(gamma * log_low), math.exp(gamma * log_high)
    light = low + h * (high - low)
    log_light = math.log(light)
    grey = math.exp(log_light / gamma)
    scale = grey / (gamma * light)
    by_gamma = low * log_low + h * (high * log_high - low * log_low)
    by_r = gamma * (low / r * (1.0 - h) + high / (1.0 + r) * h)
    tone_by_r = scale * by_r - 1.0 if darkness > min_darkness else 0.0
    by_log_gamma = scale * by_gamma * gamma - grey * log_light / gamma
    return grey - r, scale * (high - low), by_log_gamma, tone_by_r


@inline_borrowing_kernel
def _model_row(
    cells: FloatArray, unknowns: FloatArray, q_0: float, q_1: float, row: FloatArray
) -> tuple[float, bool]:
    """Return the grey value at a marker's point, and if an edge is near; fill `row` (P,).

    `row` holds the derivatives of the grey value at the *pixel* by all unknowns.
    """
    half = 0.5 * (len(cells) - 2)
    x_0, x_1, y_0, y_1 = _marker_jacobian(unknowns, q_0, q_1)
    area = x_0 * y_1 - x_1 * y_0
    # q by pixel; then the blur, round in the picture, in cells.
    i_00, i_01, i_10, i_11 = y_1 / area, -x_1 / area, -y_0 / area, x_0 / area
    blur = half * math.exp(unknowns[BLUR])
    length_u, length_v = math.hypot(i_00, i_01), math.hypot(i_10, i_11)
    rho = (i_00 * i_10 + i_01 * i_11) / (length_u * length_v)
    h, by_u, by_v, by_s, by_t = _coverage(
        cells, half * (q_0 + 1.0), half * (q_1 + 1.0), blur * length_u, blur * length_v, rho
    )
    contrast = unknowns[CONTRAST] + unknowns[20] * q_0 + unknowns[21] * q_1
    level = unknowns[LEVEL] + unknowns[18] * q_0 + unknowns[19] * q_1
    darkness = level / contrast
    toned, by_h, by_gamma, by_darkness = _tone(h, math.exp(unknowns[GAMMA]), darkness)
    slope = contrast * by_h
    by_level, by_contrast = 1.0 + by_darkness, toned - darkness * by_darkness
    row[GAMMA] = contrast * by_gamma
    row[LEVEL], row[18], row[19] = by_level, by_level * q_0, by_level * q_1
    row[CONTRAST], row[20], row[21] = by_contrast, by_contrast * q_0, by_contrast * q_1
    near = by_u != 0.0 or by_v != 0.0
    if near:
        # By the pixel; a move of the marker has the opposite sign.
        by_0, by_1 = slope * half * by_u, slope * half * by_v
        g_x, g_y = -(by_0 * i_00 + by_1 * i_10), -(by_0 * i_01 + by_1 * i_11)
        w = 1.0 + unknowns[6] * q_0 + unknowns[7] * q_1
        x, y = unknowns[2] * q_0 + unknowns[3] * q_1, unknowns[4] * q_0 + unknowns[5] * q_1
        row[0], row[1] = g_x, g_y
        row[2], row[3] = g_x * q_0 / w, g_x * q_1 / w
        row[4], row[5] = g_y * q_0 / w, g_y * q_1 / w
        along = -(g_x * x + g_y * y) / (w * w)
        row[6], row[7] = along * q_0, along * q_1
        row[8], row[9], row[10] = g_x * q_0 * q_0, g_x * q_0 * q_1, g_x * q_1 * q_1
        row[11], row[12], row[13] = g_y * q_0 * q_0, g_y * q_0 * q_1, g_y * q_1 * q_1
        row[BLUR] = slope * (by_s + by_t)
    return level + contrast * toned, near


@inline_borrowing_kernel
def _pixel_to_marker(unknowns: FloatArray, x: float, y: float) -> tuple[float, float]:
    """Return the marker's point at a pixel; NaN where the homography turns over."""
    q_0, q_1 = 0.0, 0.0
    # The bend is at most a few pixels: two corrections suffice.
    for _ in range(3):
        a, b, c = q_0 * q_0, q_0 * q_1, q_1 * q_1
        dx = x - unknowns[0] - (unknowns[8] * a + unknowns[9] * b + unknowns[10] * c)
        dy = y - unknowns[1] - (unknowns[11] * a + unknowns[12] * b + unknowns[13] * c)
        # (A q) / (1 + g q) = d  <=>  (A - d g') q = d
        a_00, a_01 = unknowns[2] - dx * unknowns[6], unknowns[3] - dx * unknowns[7]
        a_10, a_11 = unknowns[4] - dy * unknowns[6], unknowns[5] - dy * unknowns[7]
        area = a_00 * a_11 - a_01 * a_10
        q_0, q_1 = (a_11 * dx - a_01 * dy) / area, (a_00 * dy - a_10 * dx) / area
        if not 1.0 + unknowns[6] * q_0 + unknowns[7] * q_1 > 0.1:
            return np.nan, np.nan
    return q_0, q_1


class TagWindow(NamedTuple):
    """Pixels around a marker, and what the marker looks like."""

    image: GreyImage  # Shape (height, width): grey picture.
    corner: FloatArray  # Shape (2,): column and row of the window's first pixel.
    weights: FloatArray  # Shape (rows, columns): of each pixel of the window; 0 leaves it out.
    # Shape (n + 2, n + 2): the marker's cells, 1 where light, and a light ring around them.
    cells: FloatArray
    reach: float  # Largest q of the pixels that count; 1 is the marker's edge.
    every: int  # Subsampling: 1 takes all pixels, 2 those of one colour of a chessboard.


@inner_borrowing_kernel
def tag_sums(
    window: TagWindow,
    unknowns: FloatArray,
    normal: FloatArray,
    gradient: FloatArray,
    residuals: FloatArray,
    row: FloatArray,
) -> float:
    """Sum the weighted squares of a window's residuals, their normal matrix and gradient.

    Parameters
    ----------
    window : TagWindow
    unknowns : array, shape (22,)
        Values of the unknowns.
    normal, gradient : array, shape (22, 22) and (22,)
        Written; of `normal` the lower half.
    residuals : array, shape (rows, columns)
        Written: picture minus model; NaN outside the marker.
    row : array, shape (22,)
        Work space.

    Returns
    -------
    squares : float
        Weighted sum.
    """
    normal[:, :] = 0.0
    gradient[:] = 0.0
    image, corner, weights, cells, reach, every = window
    squares = 0.0
    rows, columns = weights.shape
    for i_row in range(rows):
        for i_column in range(columns):
            residuals[i_row, i_column] = np.nan
            if (i_row + i_column) % every != 0:
                continue
            x, y = int(corner[0]) + i_column, int(corner[1]) + i_row
            q_0, q_1 = _pixel_to_marker(unknowns, x, y)
            if not max(abs(q_0), abs(q_1)) <= reach:
                continue
            value, near = _model_row(cells, unknowns, q_0, q_1, row)
            residual = image[y, x] - value
            residuals[i_row, i_column] = residual
            weight = weights[i_row, i_column]
            if weight == 0.0:
                continue
            squares += weight * residual * residual
            # Away from edges, in much of the window, only the tones matter.
            first = 0 if near else GAMMA
            for i in range(first, N_UNKNOWNS):
                weighted = weight * row[i]
                gradient[i] += weighted * residual
                for j in range(first, i + 1):
                    normal[i, j] += weighted * row[j]
    return squares


class _DescentOptions(NamedTuple):
    """Steps of a marker's unknowns, and when they are settled."""

    settled_px: float = 5e-3
    settled_log_blur: float = 0.03
    # Steps stay where the model still sees the edges.
    max_step_px: float = 1.5
    max_step_log_blur: float = 0.4


_DESCENT = _DescentOptions()

_LOG_BLUR = (math.log(0.25), math.log(8.0))
_LOG_GAMMA = (math.log(0.5), math.log(5.0))


@kernel
def descend(
    window: TagWindow,
    prior: FloatArray,
    unknowns: FloatArray,
    residuals: FloatArray,
    covariance: FloatArray,
    n_steps: int,
) -> bool:
    """Improve `unknowns` (22,) in place; return False if the pixels do not determine them.

    Parameters
    ----------
    window : TagWindow
    prior : array, shape (2, 22)
        Expected values, and their weight in the sum of squares.
    unknowns : array, shape (22,)
        Start and result.
    residuals : array, shape (rows, columns)
        Written: picture minus model.
    covariance : array, shape (22, 22)
        Written: the inverse of the normal matrix; times the noise variance it is the covariance.
    n_steps : int
        Greatest number of steps.
    """
    normal, gradient = np.empty((N_UNKNOWNS, N_UNKNOWNS)), np.empty(N_UNKNOWNS)
    new_normal, new_gradient = np.empty((N_UNKNOWNS, N_UNKNOWNS)), np.empty(N_UNKNOWNS)
    lower, step = np.zeros((N_UNKNOWNS, N_UNKNOWNS)), np.empty(N_UNKNOWNS)
    new_residuals, row = np.empty_like(residuals), np.empty(N_UNKNOWNS)
    squares = tag_sums(window, unknowns, normal, gradient, residuals, row)
    squares += _add_prior(prior, unknowns, normal, gradient)
    damping = 1e-3
    for _ in range(n_steps):
        if not cholesky(normal, damping, MIN_PIVOT, lower):
            return False
        cholesky_solve(lower, gradient, step)
        _shorten(step, unknowns)
        tried = unknowns + step
        tried[BLUR] = min(max(tried[BLUR], _LOG_BLUR[0]), _LOG_BLUR[1])
        tried[GAMMA] = min(max(tried[GAMMA], _LOG_GAMMA[0]), _LOG_GAMMA[1])
        new_squares = tag_sums(window, tried, new_normal, new_gradient, new_residuals, row)
        new_squares += _add_prior(prior, tried, new_normal, new_gradient)
        if not new_squares <= squares:
            damping = 10.0 * max(damping, 1e-3)
            continue
        squares, damping = new_squares, 0.1 * damping
        unknowns[:] = tried
        normal[:, :] = new_normal
        gradient[:] = new_gradient
        residuals[:, :] = new_residuals
        if (
            np.max(np.abs(step[:6])) < _DESCENT.settled_px
            and abs(step[BLUR]) < _DESCENT.settled_log_blur
        ):
            break
    if not cholesky(normal, 0.0, MIN_PIVOT, lower):
        return False
    covariance[:, :] = cholesky_inverse(lower)
    return True


@inner_kernel
def _add_prior(
    prior: FloatArray, unknowns: FloatArray, normal: FloatArray, gradient: FloatArray
) -> float:
    squares = 0.0
    for i in range(N_UNKNOWNS):
        off = prior[0, i] - unknowns[i]
        squares += prior[1, i] * off * off
        gradient[i] += prior[1, i] * off
        normal[i, i] += prior[1, i]
    return squares


@inner_kernel
def _shorten(step: FloatArray, unknowns: FloatArray) -> None:
    """Limit the shift of the marker's points and the change of the blur."""
    side = np.sqrt(abs(unknowns[2] * unknowns[5] - unknowns[3] * unknowns[4])) + 1e-9
    moved = np.max(np.abs(step[:6])) + side * np.max(np.abs(step[6:8]))
    share = min(1.0, _DESCENT.max_step_px / (moved + 1e-12))
    share = min(share, _DESCENT.max_step_log_blur / (abs(step[BLUR]) + 1e-12))
    step *= share


class _FitOptions(NamedTuple):
    """Fit of a marker's border, and what a good one is."""

    # Share of the light ring's cell that counts: a print may be cut off behind it.
    ring_share: float = 0.7
    # Prior standard deviations: bend as a share of the side, log of blur and gamma, slopes of tones
    # as shares of the contrast.
    bend_share: float = 0.004
    slope_share: float = 0.3
    n_robust_rounds: int = 3
    n_clean_rounds: int = 2
    steps: int = 4
    # Noise of rounding to whole grey levels.
    min_noise: float = 0.3
    min_contrast: float = 8.0
    max_residual_share: float = 0.15
    min_clean_share: float = 0.4
    max_sigma_px: float = 0.15
    max_wander_share: float = 0.1


_FIT = _FitOptions()

_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
_BLUR = (np.log(0.8), 0.7)
_GAMMA = (np.log(1.6), 0.5)


@dataclass(frozen=True, slots=True)
class TagFit:
    """Corners of markers, refined to sub-pixel accuracy."""

    pixels: FloatArray  # Shape (M, 4, 2): in `image`, in OpenCV's order; NaN where not valid.
    # Shape (M, 4): standard deviation of a coordinate, from the residual, in pixels; NaN where not
    # valid.
    sigma: FloatArray
    # Shape (M, 4): False where a corner could not be refined cleanly.
    valid: BoolArray


def refine_tags(image: GreyImage, ids: IntArray, quads: FloatArray, family: str) -> TagFit:
    """Refine the corners of markers by a fit to the picture.

    Parameters
    ----------
    image : uint8 array, shape (height, width)
        Grey picture.
    ids : int array, shape (M,)
        Numbers of the markers in their dictionary.
    quads : array, shape (M, 4, 2)
        Approximate places of their corners, in OpenCV's order, pixels.
    family : str
        Name of the dictionary.
    """
    image = np.ascontiguousarray(image)
    pixels, sigma = np.full((len(ids), 4, 2), np.nan), np.full((len(ids), 4), np.nan)
    for i, (number, quad) in enumerate(zip(ids, quads, strict=True)):
        found = _fit(image, marker_cells(family, int(number)), quad)
        if found is not None:
            pixels[i], sigma[i] = found
    valid = sigma < _FIT.max_sigma_px
    return TagFit(np.where(valid[..., None], pixels, np.nan), sigma, valid)


def marker_cells(family: str, number: int) -> FloatArray:
    """Return a marker's cells (n + 2, n + 2), 1 where light, with a light ring around them."""
    dictionary = aruco_dictionary(family)
    n = dictionary.markerSize + 2
    picture = cv2.aruco.generateImageMarker(dictionary, number, n, borderBits=1)
    cells = np.ones((n + 2, n + 2))
    cells[1:-1, 1:-1] = np.asarray(picture) > 127
    return cells


def _fit(
    image: GreyImage, cells: FloatArray, quad: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Return the corners (4, 2) and their sigmas (4,); None if the marker does not fit."""
    reach = 1.0 + 2.0 * _FIT.ring_share / (len(cells) - 2)
    corner, shape = _window(image, quad, reach)
    unknowns = _start(image, cells, quad)
    if unknowns is None:
        return None
    side = float(np.sqrt(abs(unknowns[2] * unknowns[5] - unknowns[3] * unknowns[4])))
    weights, residuals = np.ones(shape), np.empty(shape)
    covariance = np.empty((N_UNKNOWNS, N_UNKNOWNS))
    noise = 0.05 * unknowns[CONTRAST]
    for i in range(_FIT.n_robust_rounds + _FIT.n_clean_rounds):
        prior = _prior(side, unknowns[CONTRAST], noise)
        # Half of the pixels suffice to find polluted ones; all of them place the corners.
        every = 2 if i < _FIT.n_robust_rounds else 1
        window = TagWindow(image, corner, weights, cells, reach, every)
        if not descend(window, prior, unknowns, residuals, covariance, _FIT.steps):
            return None
        if not unknowns[CONTRAST] > _FIT.min_contrast:
            return None
        robust = i < _FIT.n_robust_rounds - 1
        last_weights = weights
        weights, noise = _weigh(residuals, float(unknowns[CONTRAST]), robust)
    clean = last_weights > 0.0
    seen = np.isfinite(residuals)
    if np.count_nonzero(clean & seen) < _FIT.min_clean_share * np.count_nonzero(seen):
        return None
    rms = float(np.sqrt(np.mean(np.square(residuals[clean & seen]))))
    if rms > _FIT.max_residual_share * unknowns[CONTRAST] + 1.0:
        return None
    return _corners(unknowns, covariance * max(rms, _FIT.min_noise) ** 2, quad, side)


def _window(image: GreyImage, quad: FloatArray, reach: float) -> tuple[FloatArray, tuple[int, int]]:
    """Return first column and row, and numbers of rows and columns, of a marker's window."""
    middle = quad.mean(axis=0)
    # Two pixels more than the ring, to allow for errors of the start.
    spread = reach * (quad - middle)
    height, width = image.shape
    low = np.floor(np.clip(middle + spread.min(axis=0) - 2.0, 0, (width - 1, height - 1)))
    high = np.ceil(np.clip(middle + spread.max(axis=0) + 2.0, 0, (width - 1, height - 1)))
    columns, rows = (high - low).astype(int) + 1
    return low, (int(rows), int(columns))


def _start(image: GreyImage, cells: FloatArray, quad: FloatArray) -> FloatArray | None:
    """Return the initial guess from the rough corners and the middles of the cells."""
    h = cv2.getPerspectiveTransform(_CORNERS.astype(np.float32), quad.astype(np.float32))
    if not np.all(np.isfinite(h)):
        return None
    unknowns = np.zeros(N_UNKNOWNS)
    centre, tilt = h[:2, 2] / h[2, 2], h[2, :2] / h[2, 2]
    unknowns[:2] = centre
    unknowns[2:6] = (h[:2, :2] / h[2, 2] - np.outer(centre, tilt)).ravel()
    unknowns[6:8] = tilt
    unknowns[BLUR], unknowns[GAMMA] = _BLUR[0], _GAMMA[0]
    n = len(cells) - 2
    middles = (2.0 * np.arange(n) + 1.0) / n - 1.0
    grid = np.stack(np.meshgrid(middles, middles), axis=-1).reshape(1, -1, 2)
    x, y = np.rint(cv2.perspectiveTransform(grid, h)[0]).astype(np.int64).T
    height, width = image.shape
    tones = image[y.clip(0, height - 1), x.clip(0, width - 1)].reshape(n, n)
    light = cells[1:-1, 1:-1] > 0.5
    # Medians: a stripe covers fewer than half of the cells.
    unknowns[LEVEL] = np.median(tones[~light])
    unknowns[CONTRAST] = np.median(tones[light]) - unknowns[LEVEL]
    return unknowns if unknowns[CONTRAST] > _FIT.min_contrast else None


def _prior(side: float, contrast: float, noise: float) -> FloatArray:
    """Return the prior means of the unknowns and their weights (2, 22), for a given noise."""
    mean, spread = np.zeros(N_UNKNOWNS), np.full(N_UNKNOWNS, np.inf)
    spread[6:8] = 0.5
    spread[8:14] = _FIT.bend_share * side
    mean[BLUR], spread[BLUR] = _BLUR
    mean[GAMMA], spread[GAMMA] = _GAMMA
    spread[18:] = _FIT.slope_share * contrast
    return np.stack([mean, np.square(noise / spread)])


def _weigh(residuals: FloatArray, contrast: float, robust: bool) -> tuple[FloatArray, float]:
    """Return weights by the residuals, and the noise: soft weights first, then 0 or 1.

    The surroundings of polluted pixels are left out as well: the faint flank of a stripe biases.
    """
    size = np.abs(residuals)
    noise = max(1.4826 * float(np.nanmedian(size)), _FIT.min_noise)
    size = np.nan_to_num(size)
    # Pixels this many noise scales off, or this share of the contrast, show something else.
    polluted_scales, polluted_share = 4.5, 0.08
    limit = max(polluted_scales * noise, polluted_share * contrast)
    if robust:
        return np.square(1.0 / (1.0 + np.square(size / limit))), noise
    polluted = (size > limit).astype(np.uint8)
    return 1.0 - cv2.dilate(polluted, np.ones((5, 5), np.uint8)).astype(np.float64), noise


def _corners(
    unknowns: FloatArray, covariance: FloatArray, quad: FloatArray, side: float
) -> tuple[FloatArray, FloatArray] | None:
    pixels, sigma = np.empty((4, 2)), np.empty(4)
    for i, (q_0, q_1) in enumerate(_CORNERS):
        pixels[i] = marker_to_pixel(unknowns, q_0, q_1)
        by = _by_unknowns(unknowns, q_0, q_1)
        sigma[i] = np.sqrt(0.5 * np.trace(by @ covariance @ by.T))
    wander = np.linalg.norm(pixels - quad, axis=1)
    sigma[wander > _FIT.max_wander_share * 2.0 * side + 1.0] = np.inf
    return pixels, sigma


def _by_unknowns(unknowns: FloatArray, q_0: float, q_1: float) -> FloatArray:
    """Return the derivatives (2, 22) of a marker point's pixel by the unknowns."""
    w = 1.0 + unknowns[6] * q_0 + unknowns[7] * q_1
    moved = unknowns[2:6].reshape(2, 2) @ (q_0, q_1)
    by = np.zeros((2, N_UNKNOWNS))
    by[0, 0] = by[1, 1] = 1.0
    by[0, 2:4] = by[1, 4:6] = np.array([q_0, q_1]) / w
    by[:, 6:8] = -np.outer(moved, [q_0, q_1]) / (w * w)
    by[0, 8:11] = by[1, 11:14] = (q_0 * q_0, q_0 * q_1, q_1 * q_1)
    return by
