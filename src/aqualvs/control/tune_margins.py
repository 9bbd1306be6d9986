"""How far a loop is from instability: the delay and the gain that may still be added to it."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import FloatArray

ComplexArray: TypeAlias = NDArray[np.complex128]

# From a slow drift to what thrusters no longer follow, in rad/s.
_OMEGA = np.geomspace(1e-2, 1e2, 1600)
_PADE = 4


@dataclass(frozen=True, slots=True)
class Loop:
    """An open loop: numerator over denominator, polynomials in s, and a delay.

    Attributes
    ----------
    above, below : array
        Coefficients, highest power first.
    delay : float
        In seconds.
    """

    above: FloatArray
    below: FloatArray
    delay: float

    def at(self, omega: FloatArray) -> ComplexArray:
        """Return the response at frequencies in rad/s, shape (N,)."""
        s = 1j * omega
        ratio = np.polyval(self.above, s) / np.polyval(self.below, s)
        return np.asarray(ratio * np.exp(-self.delay * s), dtype=np.complex128)

    def poles(self) -> ComplexArray:
        """Return the poles of the closed loop, the delay as a Padé approximant of order 4.

        That approximant's phase is right within a degree up to 4 rad / delay; crossovers lie below.
        """
        lag = _pade(self.delay)
        lead = lag * (-1.0) ** np.arange(len(lag) - 1, -1, -1)
        closed = np.polyadd(np.polymul(self.below, lag), np.polymul(self.above, lead))
        return np.asarray(np.roots(closed), dtype=np.complex128)


@dataclass(frozen=True, slots=True)
class Margins:
    """Of one loop.

    Attributes
    ----------
    stable : bool
        The others mean nothing where it is False.
    crossover : float
        Highest frequency at which the loop's gain is 1, in rad/s; NaN if there is none.
    phase : float
        Least phase that may still be lost at such a frequency, in radians.
    gain : float
        Factor by which the gain may grow.
    delay : float
        That may be added, in seconds.
    modulus : float
        Least distance of the loop from -1; 1 / modulus is the greatest amplification of a
        disturbance.
    """

    stable: bool
    crossover: float
    phase: float
    gain: float
    delay: float
    modulus: float


def margins(loop: Loop) -> Margins:
    """Return the margins of a loop."""
    along = loop.at(_OMEGA)
    size = np.abs(along)
    # Phase beyond -180 degrees, 0 to 2 pi: what is left where the gain is 1.
    left = np.mod(np.angle(along) + math.pi, 2.0 * math.pi)
    ones = np.flatnonzero((size[:-1] > 1.0) != (size[1:] > 1.0))
    return Margins(
        stable=bool(loop.poles().real.max() < 0.0),
        crossover=float(_OMEGA[ones[-1]]) if len(ones) else math.nan,
        phase=min((float(left[k]) for k in ones), default=math.inf),
        gain=_gain_margin(along),
        delay=min((float(left[k] / _OMEGA[k]) for k in ones), default=math.inf),
        modulus=float(np.min(np.abs(1.0 + along))),
    )


def worst(of: Iterable[Margins]) -> Margins:
    """Return the margins that are nearest to instability."""
    return min(of, key=lambda one: (one.stable, one.modulus))


def _gain_margin(along: ComplexArray) -> float:
    """Return the least factor above 1 that brings the curve to -1."""
    turns = np.flatnonzero((along.imag[:-1] < 0.0) != (along.imag[1:] < 0.0))
    crossings = -along.real[turns]
    factors = 1.0 / crossings[(crossings > 0.0) & (crossings < 1.0)]
    return float(factors.min()) if len(factors) else math.inf


def _pade(delay: float) -> FloatArray:
    """Return the denominator of exp(-delay s); the numerator is that of -s."""
    n = _PADE
    terms = [
        math.factorial(2 * n - k) / (math.factorial(k) * math.factorial(n - k)) * delay**k
        for k in range(n, -1, -1)
    ]
    # A vanishing delay leaves zeros in front, which are no powers of s.
    return np.trim_zeros(np.array(terms) / terms[-1], "f")
