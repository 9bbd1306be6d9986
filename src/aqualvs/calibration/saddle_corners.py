"""Sub-pixel place of the corners where four squares of a chessboard meet.

Around such a corner the picture is point-symmetric: blur, gamma and the printer's ink change the
look of the edges but not their crossing. A small model of that neighbourhood, blur included, is
fitted to the pixels by damped least squares (`saddle_model`); the markers of a ChArUco board, which
begin a few pixels away on small squares, are part of the model instead of a disturbance.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aqualvs.calibration.saddle_model import fit_saddles
from aqualvs.geometry.arrays import BoolArray, FloatArray

GreyImage = NDArray[np.uint8]
"""A grey picture, shape (height, width)."""

# What a fit must reach to be believed: share of the contrast that is left unexplained, how far
# either edge turned, and the uncertainty of the crossing.
_MAX_RESIDUAL_SHARE = 0.15
_MAX_TURN = np.deg2rad(12.0)
_MAX_SIGMA_PX = 0.3


@dataclass(frozen=True, slots=True)
class SaddleFit:
    """Refined corners.

    Attributes
    ----------
    pixels : array, shape (N, 2)
        In `image`; the start where not valid.
    sigma : array, shape (N,)
        Standard deviation of a coordinate from the fit's own residual, in pixels.
    blur : array, shape (N,)
        Standard deviation of the blur across the edges, in pixels.
    valid : bool array, shape (N,)
        False where the pixels do not look like this corner, or it wandered off.
    """

    pixels: FloatArray
    sigma: FloatArray
    blur: FloatArray
    valid: BoolArray


def refine_saddles(
    image: GreyImage,
    starts: FloatArray,
    axes: FloatArray,
    light_first: BoolArray,
    *,
    margin: float,
    bits_from: float,
    max_wander: float = 0.25,
) -> SaddleFit:
    """Fit the crossing of the edges at each start.

    Parameters
    ----------
    image : uint8 array, shape (height, width)
        Grey picture.
    starts : array, shape (N, 2)
        About where the corners are, in `image`, pixels.
    axes : array, shape (N, 2, 2)
        `axes[:, :, 0]` and `axes[:, :, 1]`: one square's side along the board's x and y, in pixels.
    light_first : bool array, shape (N,)
        Whether the square towards +x, +y of the board is light.
    margin : float
        Light margin around the marker in a light square, as a share of the square; 1 without
        markers.
    bits_from : float
        From where in the square on its content is unknown, as a share of the square; 1 without
        markers.
    max_wander : float
        Farthest that a corner may move away from its start, in sides of a square.

    Returns
    -------
    SaddleFit
        The refined corners; those that the picture does not bear out are not valid.
    """
    pixels = np.array(starts, dtype=np.float64, order="C")
    quality = np.zeros((len(pixels), 4))
    fit_saddles(
        np.ascontiguousarray(image),
        np.ascontiguousarray(axes, dtype=np.float64),
        np.ascontiguousarray(light_first),
        float(margin),
        float(bits_from),
        pixels,
        quality,
    )
    sigma, residual_share, turn, blur = quality.T
    side = np.sqrt(np.min(np.sum(np.square(axes), axis=1), axis=-1, initial=np.inf))
    wander = np.linalg.norm(pixels - starts, axis=1)
    valid = (sigma > 0.0) & (sigma < _MAX_SIGMA_PX) & (wander <= max_wander * side)
    valid &= (residual_share < _MAX_RESIDUAL_SHARE) & (turn < _MAX_TURN)
    return SaddleFit(np.where(valid[:, None], pixels, starts), sigma, blur, valid)
