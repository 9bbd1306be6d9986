"""The paper's stripe detection, for comparison: pixels above one threshold (section 3.1)."""

from dataclasses import dataclass

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import IntArray
from aqualvs.scanning.scan import ImagePlane
from aqualvs.scanning.search import SearchAxis
from aqualvs.scanning.stripe import Returns


@dataclass(frozen=True, slots=True, kw_only=True)
class ThresholdOptions:
    """Options of the threshold detector.

    Attributes
    ----------
    level : int
        Pixels at least this bright are laser light, in grey levels.
    max_returns : int
        Returns kept per frame and search direction; what exceeds it is dropped.
    """

    level: int = 140
    max_returns: int = 16384

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        if not 1 <= self.level <= 255:
            raise OptionError(f"threshold level is {self.level}; use 1 to 255 grey levels")


class ThresholdDetector:
    """Finds runs of bright pixels along every search line of one direction.

    Each run gives one return at its middle, to half a pixel. The paper takes every bright pixel
    as a point, which has the same mean.

    Parameters
    ----------
    axis : SearchAxis
        Direction of the search lines.
    size_px : (int, int)
        Image width and height.
    lowest, highest : int array, shape (n_lines,)
        First and last position of interest on each line.
    options : ThresholdOptions
        Options.
    """

    def __init__(
        self,
        axis: SearchAxis,
        size_px: tuple[int, int],
        lowest: IntArray,
        highest: IntArray,
        options: ThresholdOptions,
    ) -> None:
        self._options = options
        self._lowest, self._highest = lowest[:, None], highest[:, None]

    def detect(self, lines: ImagePlane) -> Returns:
        """Find the returns of one frame; colour is not looked at.

        Parameters
        ----------
        lines : uint8 array, shape (n_lines, length)
            Search lines as rows.
        """
        bright = np.zeros((len(lines), lines.shape[1] + 2), np.int8)
        bright[:, 1:-1] = lines >= self._options.level
        change = np.diff(bright, axis=1)
        line, start = np.nonzero(change == 1)
        last = np.nonzero(change == -1)[1] - 1
        low, high = self._lowest[line, 0], self._highest[line, 0]
        reaches = np.flatnonzero((start <= high) & (last >= low))[: self._options.max_returns]
        line, start, last = line[reaches], start[reaches], last[reaches]
        height = [
            float(lines[x, a : b + 1].max()) for x, a, b in zip(line, start, last, strict=True)
        ]
        return Returns(
            line=line,
            position=0.5 * (start + last),
            height=np.array(height),
            width=(last - start + 1).astype(np.float64),
            likelihood=np.ones(len(line)),
        )
