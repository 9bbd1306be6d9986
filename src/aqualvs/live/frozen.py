"""Notice a picture that stands still while its time stamps run on.

Encoders and capture cards repeat their last picture when the camera fails; the stream looks alive.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.scanning.scan import ImagePlane

# Means over cells of so many pixels a side; every fourth row of cells is looked at.
_CELL, _EVERY = 8, 4
_ONES = np.ones(_CELL, np.float32)
# Stripes of lasers fill a hundredth of a picture and more.
_QUANTILE = 0.99
# Changes of a live picture that are kept, and how many are needed to know what is usual.
_N_KEPT, _N_KNOWN = 250, 25
_USUAL = 0.05
# A stream that has been away for so long begins anew, in seconds.
_GAP_S = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FrozenOptions:
    """When a picture counts as frozen.

    Attributes
    ----------
    span_s : float
        Pictures so far apart, in seconds, are compared: long enough for cameras that repeat each
        picture two or four times, as they do in dim light.
    greatest : float
        A greater change is never that of a frozen picture, in grey levels. What an encoder goes on
        to improve in a still is less after 0.4 s.
    least : float
        A smaller change is always that of a frozen picture, in grey levels.
    share : float
        Between these two: as share of the change that this stream shows at its quietest (5 % of
        its last pictures change less).
    """

    span_s: float = 0.24
    greatest: float = 0.8
    least: float = 0.1
    share: float = 0.65

    def __post_init__(self) -> None:
        """Refuse what makes no sense.

        Raises
        ------
        OptionError
            Naming the value.
        """
        for name in ("span_s", "greatest", "least", "share"):
            value = getattr(self, name)
            if not (value > 0.0 and math.isfinite(value)):
                raise OptionError(f"frozen pictures, {name} {value:g}: must be positive")


class FrozenPicture:
    """Compares each picture of a stream with one a quarter of a second older.

    The statistic is the 99 % quantile, over cells of 8 x 8 pixels in a quarter of the rows, of how
    much a cell's mean luma has changed. Means tell motion, and noise of the sensor, from what an
    encoder does to a still: it adds detail to the cells and leaves their means. A stripe that moves
    by a thirtieth of a pixel changes its cells by half a grey level.

    Parameters
    ----------
    options : FrozenOptions, optional
        Defaults if left out.

    Attributes
    ----------
    change : float
        The statistic of the last picture, in grey levels; NaN where there was nothing to compare.
    """

    def __init__(self, options: FrozenOptions | None = None) -> None:
        self.options = options or FrozenOptions()
        self._usual: deque[float] = deque(maxlen=_N_KEPT)
        self._begin()

    def update(self, time_s: float, luma: ImagePlane) -> float:
        """Return for how long the picture has stood still, in seconds; 0 for a live one.

        Parameters
        ----------
        time_s : float
            By the stream's clock.
        luma : uint8 array, shape (height, width)
        """
        cells = _cell_means(luma)
        if self._kept and not self._continues(time_s, cells):
            self._begin()
        while len(self._kept) > 1 and time_s - self._kept[1][0] >= self._span_s:
            self._kept.popleft()
        self._change_since(time_s, cells)
        self._kept.append((time_s, cells))
        self._judge(time_s)
        return 0.0 if math.isnan(self._since_s) else time_s - self._since_s

    def _begin(self) -> None:
        self._kept: deque[tuple[float, FloatArray]] = deque()
        self._span_s = self.options.span_s - 1e-6
        self.change = math.nan
        self._since_s = self._moved_s = math.nan

    def _continues(self, time_s: float, cells: FloatArray) -> bool:
        last_s, last = self._kept[-1]
        return last_s <= time_s <= last_s + _GAP_S and last.shape == cells.shape

    def _change_since(self, time_s: float, cells: FloatArray) -> None:
        """Compare with the oldest picture kept, if it is old enough."""
        self.change = math.nan
        if not (self._kept and time_s - self._kept[0][0] >= self._span_s) or not cells.size:
            return
        changes = np.abs(cells - self._kept[0][1]).ravel()
        rank = min(int(_QUANTILE * changes.size), changes.size - 1)
        self.change = float(np.partition(changes, rank)[rank])

    def _limit(self) -> float:
        """Return the change below which a picture stands still."""
        options = self.options
        if len(self._usual) < _N_KNOWN:
            return options.least
        quiet = float(np.quantile(np.array(self._usual), _USUAL))
        return min(max(options.share * quiet, options.least), options.greatest)

    def _judge(self, time_s: float) -> None:
        if math.isnan(self.change):
            return
        still = self.change < self._limit()
        if math.isnan(self._since_s):
            if still:
                self._since_s, self._moved_s = self._kept[0][0], math.nan
            else:
                self._usual.append(self.change)
            return
        if still:
            self._moved_s = math.nan
        elif math.isnan(self._moved_s):
            self._moved_s = time_s
        elif time_s - self._moved_s > self.options.span_s:
            # A key frame changes a still once: it is in the comparison for one span.
            self._since_s = self._moved_s = math.nan


def _cell_means(luma: ImagePlane) -> FloatArray:
    """Return the means of the cells, shape (rows, columns)."""
    rows, columns = luma.shape[0] // (_EVERY * _CELL), luma.shape[1] // _CELL
    step = luma.strides[0]
    bands = np.lib.stride_tricks.as_strided(
        luma,
        (rows, _CELL, columns * _CELL),
        (_EVERY * _CELL * step, step, luma.strides[1]),
        writeable=False,
    )
    sums = bands[:, 0].astype(np.uint16)
    for k in range(1, _CELL):
        sums += bands[:, k]
    return np.asarray(sums.reshape(rows, columns, _CELL) @ _ONES / _CELL**2, np.float64)
