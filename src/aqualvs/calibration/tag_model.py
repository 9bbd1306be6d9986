"""What a marker looks like, and the compiled sums of its fit to pixels.

A marker is a grid of dark and light cells with a light margin around it. Its model: a homography
with a slight bend (a dome bends straight lines) from marker to picture; a Gaussian blur of the
light; a power law from light to grey level, the camera's gamma; a level (the dark cells' grey) and
a contrast that may vary linearly across the marker. Blur and gamma move every edge towards its dark
side; because the model has edges of both directions, outside and among the bits, that shift is told
apart from the marker's size, and the corners come out where they are printed.

Marker coordinates q: (-1, -1) the top-left corner, (1, 1) the bottom-right one.
"""

import math

import numpy as np
from numpy.typing import NDArray

from aqualvs.calibration.pixel_fit import blurred_edge
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel, kernel

U8Array = NDArray[np.uint8]

# Unknowns: centre 0-1; linear part 2-5, row by row; perspective 6-7; bend of x and of y 8-13, in
# pixels per q0 q0, q0 q1, q1 q1; log of the blur 14; log of gamma 15; level 16, contrast 17; slopes
# of the level 18-19 and of the contrast 20-21 along q.
N_UNKNOWNS = 22
BLUR, GAMMA, LEVEL, CONTRAST = 14, 15, 16, 17
# The tone of ink over the contrast; below this black is black.
_LEAST_DARKNESS = 0.02


@inline_borrowing_kernel
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

    Cell i, j of `cells` spans [i - 1, i] x [j - 1, j] with v as the row: the light margin is part
    of it. The Gaussian has standard deviations `sigma_u`, `sigma_v` and correlation `rho`, which
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
    """Return the tone, 0 to 1, of a share of light, as a camera with this gamma shows it.

    Light adds up linearly and grey levels are its power 1 / gamma: `darkness` is the dark tone's
    grey level over the contrast.

    Returns
    -------
    tone, by_h, by_log_gamma, by_darkness
    """
    if h <= 0.0 or h >= 1.0:
        return h, 1.0, 0.0, 0.0
    r = max(darkness, _LEAST_DARKNESS)
    log_low, log_high = math.log(r), math.log(1.0 + r)
    low, high = math.exp(gamma * log_low), math.exp(gamma * log_high)
    light = low + h * (high - low)
    log_light = math.log(light)
    grey = math.exp(log_light / gamma)
    scale = grey / (gamma * light)
    by_gamma = low * log_low + h * (high * log_high - low * log_low)
    by_r = gamma * (low / r * (1.0 - h) + high / (1.0 + r) * h)
    tone_by_r = scale * by_r - 1.0 if darkness > _LEAST_DARKNESS else 0.0
    by_log_gamma = scale * by_gamma * gamma - grey * log_light / gamma
    return grey - r, scale * (high - low), by_log_gamma, tone_by_r


@inline_borrowing_kernel
def _model_row(
    cells: FloatArray, unknowns: FloatArray, q_0: float, q_1: float, row: FloatArray
) -> tuple[float, bool]:
    """Return the grey value at a marker's point, and whether an edge is near; fill `row` (P,).

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
        # By pixel, and the marker moves against it.
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
    # The bend is a small part of a pixel to a few: two corrections leave nothing of it.
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


@kernel
def tag_sums(
    image: U8Array,
    corner: FloatArray,
    weights: FloatArray,
    cells: FloatArray,
    reach: float,
    unknowns: FloatArray,
    normal: FloatArray,
    gradient: FloatArray,
    residuals: FloatArray,
    every: int,
) -> float:
    """Sum the weighted squares of a window's residuals, their normal matrix and gradient.

    Parameters
    ----------
    image : uint8 array, shape (height, width)
        Grey picture.
    corner : array, shape (2,)
        Column and row of the window's first pixel.
    weights : array, shape (rows, columns)
        Weight of each pixel of the window; 0 leaves it out.
    cells : array, shape (n + 2, n + 2)
        The marker's cells, 1 where light, and a light ring around them.
    reach : float
        Up to where in q pixels count; 1 is the marker's edge.
    unknowns : array, shape (22,)
        Where to evaluate.
    normal, gradient : array, shape (22, 22) and (22,)
        Written; of `normal` the lower half.
    residuals : array, shape (rows, columns)
        Written: picture minus model; NaN outside the marker.
    every : int
        Take one pixel of so many: 1 all of them, 2 like the dark squares of a chessboard.

    Returns
    -------
    squares : float
        Weighted sum.
    """
    row = np.empty(N_UNKNOWNS)
    normal[:, :] = 0.0
    gradient[:] = 0.0
    return _sums(
        image, corner, weights, cells, reach, unknowns, normal, gradient, residuals, every, row
    )


@borrowing_kernel
def _sums(
    image: U8Array,
    corner: FloatArray,
    weights: FloatArray,
    cells: FloatArray,
    reach: float,
    unknowns: FloatArray,
    normal: FloatArray,
    gradient: FloatArray,
    residuals: FloatArray,
    every: int,
    row: FloatArray,
) -> float:
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
            # Away from edges only the tones matter, which is much of the window.
            first = 0 if near else GAMMA
            for i in range(first, N_UNKNOWNS):
                weighted = weight * row[i]
                gradient[i] += weighted * residual
                for j in range(first, i + 1):
                    normal[i, j] += weighted * row[j]
    return squares
