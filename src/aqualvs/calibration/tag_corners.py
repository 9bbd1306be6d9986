"""Corners of markers without the pull of blur and gamma.

An outer corner of a marker lies between light paper and dark ink. Blur and gamma shift both of its
edges towards the dark, by a third of a pixel or so, and with them the corner. So the whole marker
is fitted at once (`tag_model`): edges of both directions among its bits tell that shift apart from
the marker's size. Pixels that something else covers, a laser stripe above all, do not fit; they and
their surroundings are left out, and corners that the rest does not determine are not valid.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from aqualvs.calibration.saddle_corners import GreyImage
from aqualvs.calibration.tag_descent import descend
from aqualvs.calibration.tag_model import (
    BLUR,
    CONTRAST,
    GAMMA,
    LEVEL,
    N_UNKNOWNS,
    marker_to_pixel,
)
from aqualvs.calibration.targets import aruco_dictionary
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray

# Share of the light ring's cell that counts: a print may be cut off behind it.
_RING_SHARE = 0.7
_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
# What is known beforehand: bend as a share of the side, log of blur and gamma, slopes of tones as
# shares of the contrast.
_BEND_SHARE = 0.004
_BLUR = (np.log(0.8), 0.7)
_GAMMA = (np.log(1.6), 0.5)
_SLOPE_SHARE = 0.3
_N_ROBUST_ROUNDS = 3
_N_CLEAN_ROUNDS = 2
_STEPS = 4
# Pixels this many noise scales off, or this share of the contrast, are something else's.
_POLLUTED_SCALES = 4.5
_POLLUTED_SHARE = 0.08
# Rounding to whole grey levels alone makes so much noise.
_LEAST_NOISE = 0.3
_MIN_CONTRAST = 8.0
_MAX_RESIDUAL_SHARE = 0.06
_MIN_CLEAN_SHARE = 0.4
_MAX_SIGMA_PX = 0.15
_MAX_WANDER_SHARE = 0.1


@dataclass(frozen=True, slots=True)
class TagFit:
    """Refined corners of markers.

    Attributes
    ----------
    pixels : array, shape (M, 4, 2)
        In `image`, in OpenCV's order; NaN where not valid.
    sigma : array, shape (M, 4)
        Standard deviation of a coordinate, from the residual, in pixels; NaN where not valid.
    valid : bool array, shape (M, 4)
        False where a corner could not be refined cleanly.
    """

    pixels: FloatArray
    sigma: FloatArray
    valid: BoolArray


def refine_tags(image: GreyImage, ids: IntArray, quads: FloatArray, family: str) -> TagFit:
    """Fit markers to a picture.

    Parameters
    ----------
    image : uint8 array, shape (height, width)
        Grey picture.
    ids : int array, shape (M,)
        Numbers of the markers in their dictionary.
    quads : array, shape (M, 4, 2)
        About where their corners are, in OpenCV's order, pixels.
    family : str
        Name of the dictionary.
    """
    image = np.ascontiguousarray(image)
    pixels, sigma = np.full((len(ids), 4, 2), np.nan), np.full((len(ids), 4), np.nan)
    for i, (number, quad) in enumerate(zip(ids, quads, strict=True)):
        found = _fit(image, marker_cells(family, int(number)), quad)
        if found is not None:
            pixels[i], sigma[i] = found
    valid = sigma < _MAX_SIGMA_PX
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
    """Return the corners (4, 2) and their sigmas (4,), None where the marker does not fit."""
    reach = 1.0 + 2.0 * _RING_SHARE / (len(cells) - 2)
    corner, shape = _window(image, quad, reach)
    unknowns = _start(image, cells, quad)
    if unknowns is None:
        return None
    side = float(np.sqrt(abs(unknowns[2] * unknowns[5] - unknowns[3] * unknowns[4])))
    weights, residuals = np.ones(shape), np.empty(shape)
    covariance = np.empty((N_UNKNOWNS, N_UNKNOWNS))
    noise = 0.05 * unknowns[CONTRAST]
    for i in range(_N_ROBUST_ROUNDS + _N_CLEAN_ROUNDS):
        prior = _prior(side, unknowns[CONTRAST], noise)
        # Half of the pixels tell what is polluted; all of them place the corners.
        every = 2 if i < _N_ROBUST_ROUNDS else 1
        if not descend(
            image,
            corner,
            weights,
            cells,
            reach,
            prior,
            unknowns,
            residuals,
            covariance,
            _STEPS,
            every,
        ):
            return None
        if not unknowns[CONTRAST] > _MIN_CONTRAST:
            return None
        robust = i < _N_ROBUST_ROUNDS - 1
        last_weights = weights
        weights, noise = _weigh(residuals, float(unknowns[CONTRAST]), robust)
    clean = last_weights > 0.0
    seen = np.isfinite(residuals)
    if np.count_nonzero(clean & seen) < _MIN_CLEAN_SHARE * np.count_nonzero(seen):
        return None
    rms = float(np.sqrt(np.mean(np.square(residuals[clean & seen]))))
    if rms > _MAX_RESIDUAL_SHARE * unknowns[CONTRAST] + 1.0:
        return None
    return _corners(unknowns, covariance * max(rms, _LEAST_NOISE) ** 2, quad, side)


def _window(image: GreyImage, quad: FloatArray, reach: float) -> tuple[FloatArray, tuple[int, int]]:
    """Return the first column and row, and the rows and columns, of what a marker covers."""
    middle = quad.mean(axis=0)
    # Two pixels more than the ring, for a start that is not quite right.
    spread = reach * (quad - middle)
    height, width = image.shape
    low = np.floor(np.clip(middle + spread.min(axis=0) - 2.0, 0, (width - 1, height - 1)))
    high = np.ceil(np.clip(middle + spread.max(axis=0) + 2.0, 0, (width - 1, height - 1)))
    columns, rows = (high - low).astype(int) + 1
    return low, (int(rows), int(columns))


def _start(image: GreyImage, cells: FloatArray, quad: FloatArray) -> FloatArray | None:
    """Return the unknowns that the rough corners and the cells' middles suggest."""
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
    return unknowns if unknowns[CONTRAST] > _MIN_CONTRAST else None


def _prior(side: float, contrast: float, noise: float) -> FloatArray:
    """Return the expected unknowns and their weights (2, 22), for noise of that size."""
    mean, spread = np.zeros(N_UNKNOWNS), np.full(N_UNKNOWNS, np.inf)
    spread[6:8] = 0.5
    spread[8:14] = _BEND_SHARE * side
    mean[BLUR], spread[BLUR] = _BLUR
    mean[GAMMA], spread[GAMMA] = _GAMMA
    spread[18:] = _SLOPE_SHARE * contrast
    return np.stack([mean, np.square(noise / spread)])


def _weigh(residuals: FloatArray, contrast: float, robust: bool) -> tuple[FloatArray, float]:
    """Return weights by the residuals, and the noise: soft ones first, then in or out.

    The surroundings of polluted pixels are left out as well: a stripe's foot is faint, but pulls.
    """
    size = np.abs(residuals)
    noise = max(1.4826 * float(np.nanmedian(size)), _LEAST_NOISE)
    size = np.nan_to_num(size)
    limit = max(_POLLUTED_SCALES * noise, _POLLUTED_SHARE * contrast)
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
    sigma[wander > _MAX_WANDER_SHARE * 2.0 * side + 1.0] = np.inf
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
