"""Loss functions of robust least squares, by the length of a residual in standard deviations."""

from enum import StrEnum

import numpy as np

from aqualvs.geometry.arrays import FloatArray

# Good residuals hardly reach this, so that the estimate stays efficient; outliers count linearly.
_HUBER = 3.0
# At this, the estimate is 95 % efficient on normal errors (Holland & Welsch 1977,
# doi:10.1080/03610927708827533), and the weights tell its covariance rightly.
_CAUCHY = 2.385


class Loss(StrEnum):
    """How the length of a residual counts."""

    SQUARE = "square"
    """As its square: for priors."""
    HUBER = "huber"
    """As its square up to three standard deviations, linearly beyond: for measurements."""
    CAUCHY = "cauchy"
    """Logarithmically beyond two or so: where a good part of the data obeys another law."""

    def cost(self, lengths: FloatArray) -> FloatArray:
        """Return the loss of residuals (N,), half the square for short ones."""
        square: FloatArray = 0.5 * lengths**2
        if self is Loss.HUBER:
            return np.where(lengths <= _HUBER, square, _HUBER * (lengths - 0.5 * _HUBER))
        if self is Loss.CAUCHY:
            logarithm: FloatArray = 0.5 * _CAUCHY**2 * np.log1p((lengths / _CAUCHY) ** 2)
            return logarithm
        return square

    def weight(self, lengths: FloatArray) -> FloatArray:
        """Return d cost / d length over length: what iterated reweighting multiplies with."""
        if self is Loss.HUBER:
            return np.where(lengths <= _HUBER, 1.0, _HUBER / np.maximum(lengths, _HUBER))
        if self is Loss.CAUCHY:
            weight: FloatArray = 1.0 / (1.0 + (lengths / _CAUCHY) ** 2)
            return weight
        return np.ones_like(lengths)
