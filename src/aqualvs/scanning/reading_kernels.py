"""The arithmetic of `read_returns`: what a laser makes of the returns of its search direction."""

import numpy as np

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import kernel
from aqualvs.scanning.segments import segment_returns

SOURCE, LASER, LINE, STRETCH, CHUNK, ALONG_X = range(6)
"""Rows of a table of readings' whole numbers, the last 1 where the search runs along x."""
N_NUMBERS = 6
HEIGHT, WIDTH, SIGMA_PX, TRUST = range(4)
"""Rows of a table of readings' measures."""
N_MEASURES = 4

# Position noise of a return: a floor (texture, compression), and what grey-level noise makes of
# the two flanks of a stripe of given width and height.
_FLOOR_PX = 0.1
_FLANK_NOISE = 1.35  # 0.45 (geometry of two flanks) times 3 grey levels


@kernel
def read_laser(
    line: IntArray,
    position: FloatArray,
    height: FloatArray,
    width: FloatArray,
    likelihood: FloatArray,
    lowest: IntArray,
    highest: IntArray,
    slope_low: FloatArray,
    slope_high: FloatArray,
    laser: int,
    along_x: int,
    line_px: int,
    best_height: float,
    begin: int,
    numbers: IntArray,
    measures: FloatArray,
    pixels: FloatArray,
) -> int:
    """Append one laser's readings to the tables from column `begin` on; returns where they end.

    Parameters
    ----------
    line, position, height, width, likelihood
        As in `Returns`, of the laser's search direction.
    lowest, highest, slope_low, slope_high, line_px
        As in the laser's `StripeSearch`.
    laser : int
        Its index.
    along_x : int
        1 where its search lines run along x.
    best_height : float
        Of the frame's best returns.
    begin : int
        How many readings other lasers have.
    numbers : int array, shape (6, N), measures : array, shape (4, N)
        Written, see `SOURCE` and `HEIGHT`.
    pixels : array, shape (N, 2)
        Written.
    """
    found = np.empty((3, line.shape[0]), np.int64)
    n = segment_returns(line, position, lowest, highest, slope_low, slope_high, found)
    # Stretches and chunks of different lasers must differ.
    first_stretch, first_chunk = 0, 0
    for i in range(begin):
        first_stretch = max(first_stretch, numbers[STRETCH, i] + 1)
    if begin > 0:
        first_chunk = numbers[CHUNK, begin - 1] + 1
    across, along = (1, 0) if along_x else (0, 1)
    height_share = 1.0 / best_height
    for k in range(n):
        i, r = begin + k, found[0, k]
        # Returns of the two search directions get odd and even numbers.
        numbers[SOURCE, i] = 2 * r + along_x
        numbers[LASER, i] = laser
        numbers[LINE, i] = line[r]
        numbers[STRETCH, i] = first_stretch + found[1, k]
        numbers[CHUNK, i] = first_chunk + found[2, k]
        numbers[ALONG_X, i] = along_x
        measures[HEIGHT, i] = height[r]
        measures[WIDTH, i] = width[r]
        flank = _FLANK_NOISE * width[r] / height[r]
        measures[SIGMA_PX, i] = np.sqrt(_FLOOR_PX * _FLOOR_PX + flank * flank)
        measures[TRUST, i] = np.sqrt(min(height[r] * height_share, 1.0) * likelihood[r])
        # The middle of a search line that is several pixels wide.
        pixels[i, across] = (line[r] + 0.5) * line_px - 0.5
        pixels[i, along] = position[r]
    return begin + n
