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
from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.compiled import kernel
from aqualvs.scanning.scan import Frame, ImagePlane

# Wavelengths (nm) that part blue, green and red lines.
_BLUE_TO_GREEN_NM, _GREEN_TO_RED_NM = 490.0, 580.0
# R and B by V and U, in the scale of limited-range luma (BT.601).
_RED_OF_V, _BLUE_OF_U = 1.596 / 1.164, 2.018 / 1.164
# Stripes to learn from: peaks with a chroma step of at least this share of the frame's largest, of
# so many standard deviations, and of so many levels; and how many of them it takes.
_BEST_SHARE, _CLEAR_SIGMAS, _CLEAR_LEVELS, _MIN_LEARNED = 0.4, 3.0, 3.0, 24
# Chroma levels for each grey level of height: what a line is expected to show where none is clear
# enough to learn from, the least that a learned one counts with, and how far paint and glare spread
# about none. Lines of nine cameras show 0.15 to 0.7, rendered ones 0.5.
_RATIO_EXPECTED, _RATIO_LEAST, _RATIO_OF_PAINT = 0.25, 0.1, 0.05
# Ratios of one frame's lines spread by this share: overexposed ones show less, faint ones more. So
# much of a line's ratio is never taken for that of paint, be the scene ever so green.
_RATIO_SPREAD, _PAINT_SHARE = 0.35, 0.5
# The learned ratio is that which so many of the best stripes exceed.
_LEARNED_QUANTILE = 0.35
# Levels: what rounding and subsampling leave of chroma noise.
_LEAST_SIGMA = 0.7
# Heights that are counted as one kind, and how often the shares of lines among them are refined.
_KINDS_PER_OCTAVE, _N_KINDS, _ROUNDS = 2.0, 16, 3
# Nothing is more certain than e to this power.
_MAX_LOG_ODDS = 12.0


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


@dataclass(frozen=True, slots=True)
class ChromaSteps:
    """How the chroma of peaks differs from that of their flanks, N of them.

    Attributes
    ----------
    height : array, shape (N,)
        Of the peaks above their background, in grey levels.
    step : array, shape (2, N)
        U and V of the peak, or of its edge if that is more of the laser's colour (a saturated core
        is white), less the mean of both flanks.
    imbalance : array, shape (N,)
        Difference of the two flanks along the laser's colour: noise and shading.
    tint : array, shape (N,)
        How much the flanks have of the laser's colour, for each grey level of their luma.
    """

    height: FloatArray
    step: FloatArray
    imbalance: FloatArray
    tint: FloatArray


def laser_likelihood(peaks: ChromaSteps, colour: LaserColour) -> FloatArray:
    """Return how likely each peak of a frame is laser light, and not something else that is bright.

    Compares two explanations of a chroma step: a line moves the chroma in proportion to its height,
    as the frame's best stripes do; noise does not move it, and brighter paint under the same light
    shows more of the tint that its flanks have, which is none where the light is white. How many
    peaks of about the same height are lines is found from the same steps: low ones are mostly
    noise.

    Parameters
    ----------
    peaks : ChromaSteps
        All peaks of one frame, N of them.
    colour : LaserColour

    Returns
    -------
    array, shape (N,)
        0 to 1; 0.5 where colour says nothing.
    """
    likelihood = np.empty(len(peaks.height))
    if len(likelihood):
        noise = float(np.median(np.abs(peaks.imbalance)))
        sigma = max(1.4826 * noise / math.sqrt(2.0), _LEAST_SIGMA)
        direction, ratio = _learn(peaks, np.array(colour.value), sigma)
        _weigh(direction @ peaks.step, peaks.height, peaks.tint, ratio, sigma, likelihood)
    return likelihood


@kernel
def _weigh(
    step: FloatArray,
    height: FloatArray,
    tint: FloatArray,
    ratio: float,
    sigma: float,
    likelihood: FloatArray,
) -> None:
    """Write the likelihood of each peak, given what a line shows for each level of height."""
    n = step.shape[0]
    odds, kind = np.empty(n), np.empty(n, np.int64)
    for i in range(n):
        line = ratio * height[i]
        paint = min(max(tint[i], 0.0), _PAINT_SHARE * ratio) * height[i]
        # More of the colour than expected is no evidence against a line, less than paint none for.
        off_line, off_paint = min(step[i] - line, 0.0), max(step[i] - paint, 0.0)
        var_line = sigma**2 + (_RATIO_SPREAD * line) ** 2
        var_paint = sigma**2 + (_RATIO_OF_PAINT * height[i]) ** 2
        log_odds = 0.5 * (off_paint**2 / var_paint - off_line**2 / var_line)
        odds[i] = math.exp(min(max(log_odds, -_MAX_LOG_ODDS), _MAX_LOG_ODDS))
        kind[i] = min(int(_KINDS_PER_OCTAVE * math.log2(max(height[i], 1.0))), _N_KINDS - 1)
    share = np.full(_N_KINDS, 0.5)
    for _ in range(_ROUNDS):
        lines, all_of = np.full(_N_KINDS, 1.0), np.full(_N_KINDS, 2.0)
        for i in range(n):
            prior = share[kind[i]]
            likelihood[i] = prior * odds[i] / (prior * odds[i] + 1.0 - prior)
            lines[kind[i]] += likelihood[i]
            all_of[kind[i]] += 1.0
        share = lines / all_of


def _learn(peaks: ChromaSteps, expected: FloatArray, sigma: float) -> tuple[FloatArray, float]:
    """Return the direction (2,) and the ratio of step to height of the frame's best stripes."""
    step = expected @ peaks.step
    clear: BoolArray = step > max(_CLEAR_SIGMAS * sigma, _CLEAR_LEVELS)
    if np.count_nonzero(clear) < _MIN_LEARNED:
        return expected, _RATIO_EXPECTED
    # Chosen by chroma: the highest peaks may be edges of paper, which hardly move it.
    best = clear & (step >= _BEST_SHARE * np.quantile(step[clear], 0.9))
    if np.count_nonzero(best) < _MIN_LEARNED:
        return expected, _RATIO_EXPECTED
    mean = np.median(peaks.step[:, best] / peaks.height[best], axis=1)
    direction: FloatArray = mean / np.linalg.norm(mean)
    ratios = (direction @ peaks.step[:, best]) / peaks.height[best]
    return direction, max(float(np.quantile(ratios, _LEARNED_QUANTILE)), _RATIO_LEAST)
