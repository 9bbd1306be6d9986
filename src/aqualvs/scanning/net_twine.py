"""Thickness of twine, from how long and how wide the light is on strands that cross at angles.

The light on a strand is where strand and laser sheet overlap: a parallelogram with rounded corners.
Search lines meet it over a length that follows in quadrature from strand and sheet, and across the
line it is as wide as the sheet or as the strand lets it be, whichever is less:

    length² = (d / sin a)² + (w k)²,        width⁻³ = (r w)⁻³ + (k sin a / (d + e))³,

with the crossing angle a, the sheet's lit width w and the slant k, by which the strand runs away
from the search lines on its way across the sheet. Dashes at several angles tell strand and sheet
apart; r and e say how a width at half height compares with what is lit. What the detector takes
for lit reaches beyond the twine: blur of lens and water, brightness far above the faintest stripe
that counts. How far was measured in simulation; the uncertainty holds what it varied.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import FloatArray

# How much wider than the twine its light is, in metres and in steps of the search lines, and what
# that varies: 170 simulated dives at 0.3 to 1.0 m with two rigs, in clear and in turbid water.
_HALO, _HALO_STEPS, _SIGMA_HALO = 0.60e-3, 0.2, 0.19e-3
# Where the light is fainter than this, in grey levels, the halo depends on it and is less certain.
_FAINT, _SIGMA_FAINT = 45.0, 0.4e-3
# The silhouette of twisted twine is on average narrower than its diameter.
_SILHOUETTE = 0.95
# Width of a strand at half height less its lit width, in metres (same dives).
_STRAND_MORE = 0.45e-3
# Before any dash was seen: lit width of a strand and of the sheet in metres, width of the sheet at
# half height over its lit width; and their spreads as logarithms.
_USUAL, _SPREAD = np.log([2.5e-3, 4.2e-3, 1.16]), np.array([1.5, 0.25, 0.12])
# Errors of a kind's length and width: relative, relative for one dash, and in search lines.
_LENGTH_ERROR, _WIDTH_ERROR, _DASH_ERROR, _ERROR_PX = 0.06, 0.08, 0.3, 0.2
# Error of bare twine's length for the spread of all lengths: growth may be taken for twine.
_SPREAD_ERROR = 0.25
# The model holds the less the more slanted the strand is.
_SLANT_ERROR = 0.4
# Uncertainty of what slant adds to a dash, as a share.
_SLANT_TOLD = 0.1
_ROUNDS = 40


@dataclass(frozen=True, slots=True)
class DashKind:
    """Dashes of one laser on one family of strands, taken together.

    Attributes
    ----------
    laser, family : int
        Of the dashes.
    across : float
        Sine of the angle between the laser's line and the strands, 0 to 1.
    slant : float
        How far the strand gets along the line, measured by search lines, per metre across it.
    length : float
        Of a usual dash along the line, in metres.
    width : float
        Of its light at half height, square to the line, in metres.
    height : float
        Of its light, in grey levels.
    step : float
        Length of laser line that a search line stands for, in metres.
    spread : float
        Logarithm of long dashes over short ones: how much growth there is.
    count : int
        Dashes.
    """

    laser: int
    family: int
    across: float
    slant: float
    length: float
    width: float
    height: float
    step: float
    spread: float
    count: int


@dataclass(frozen=True, slots=True)
class Twine:
    """Thickness of twine.

    Attributes
    ----------
    thickness, sigma : float
        Diameter and its standard deviation, in metres.
    body : float
        Width of its silhouette, in metres.
    sheet : float
        Width within which the light sheet is seen, in metres.
    halo, sigma_halo : float
        How much wider than its body a strand looks lit where search lines are close, in metres, and
        how well body and halo are told apart.
    """

    thickness: float
    sigma: float
    body: float
    sheet: float
    halo: float
    sigma_halo: float

    def usual(self, across: FloatArray, slant: FloatArray, step: FloatArray) -> FloatArray:
        """Length of dashes, in metres, by crossing angle, slant and step as in `DashKind`."""
        lit = self.body + self.halo + _HALO_STEPS * step
        return np.asarray(np.hypot(lit / across, self.sheet * slant))

    def excess(
        self, across: FloatArray, slant: FloatArray, step: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return what of `usual` is not twine, in metres, and its standard deviation."""
        usual = self.usual(across, slant, step)
        straight = (self.body + self.halo + _HALO_STEPS * step) / across
        sigma = np.hypot(self.sigma_halo / across, _SLANT_TOLD * (usual - straight))
        return usual - self.body / across, np.asarray(sigma)


def measure_twine(kinds: Sequence[DashKind], known: float | None = None) -> Twine | None:
    """Fit twine and sheet to the dashes of several kinds; None without any.

    Parameters
    ----------
    kinds : sequence of DashKind
        The more different their angles and slants, the better.
    known : float, optional
        Diameter of the bare twine in metres, where somebody knows it: then the halo is measured.
    """
    if not kinds:
        return None
    at, covariance = _fit(kinds)
    strand, sheet, _ = np.exp(at)
    sigma_strand = float(strand * np.sqrt(covariance[0, 0]))
    if known is not None:
        body = _SILHOUETTE * known
        return Twine(known, 0.0, body, float(sheet), float(strand) - body, sigma_strand)
    faint = max(1.0 - float(np.median([k.height for k in kinds])) / _FAINT, 0.0)
    sigma = math.hypot(sigma_strand, math.hypot(_SIGMA_HALO, _SIGMA_FAINT * faint))
    body = _positive(float(strand) - _HALO, math.hypot(sigma, 0.1 * float(strand)))
    return Twine(
        thickness=body / _SILHOUETTE,
        sigma=sigma / _SILHOUETTE,
        body=body,
        sheet=float(sheet),
        halo=float(strand) - body,
        sigma_halo=sigma,
    )


def _positive(value: float, sigma: float) -> float:
    """Return the expectation of what was measured as `value` and cannot be negative."""
    x = value / sigma
    if x < -4.0:
        return sigma / 4.0
    below = 0.5 * (1.0 + math.erf(x / math.sqrt(2.0)))
    return value + sigma * math.exp(-0.5 * x * x) / (math.sqrt(2.0 * math.pi) * below)


def _fit(kinds: Sequence[DashKind]) -> tuple[FloatArray, FloatArray]:
    """Logarithms (3,) of strand, sheet and sheet's half-height ratio, and their covariance.

    Gauss-Newton; lengths and widths far off count less (Huber's weights).
    """
    across, slant, length, width, step, count = np.array(
        [[k.across, k.slant, k.length, k.width, k.step, k.count] for k in kinds], np.float64
    ).T
    seen = np.log(np.r_[length, width])
    grown = _SPREAD_ERROR * np.array([k.spread for k in kinds])
    of_length = np.hypot(np.hypot(_LENGTH_ERROR, grown), _ERROR_PX * step / length)
    error = np.r_[of_length, np.full(len(kinds), _WIDTH_ERROR)]
    error = np.hypot(error, np.tile(_DASH_ERROR / np.sqrt(count), 2))
    error *= np.tile(1.0 + _SLANT_ERROR * slant, 2)
    prior = np.diag(_SPREAD**-2)
    at, normal = _USUAL.copy(), prior
    at[0] = np.log(np.clip(0.8 * np.min(length * across), 3e-4, 2e-2))
    for _ in range(_ROUNDS):
        expected, slope = _model(at, across, slant, step)
        off = (seen - expected) / error
        jacobian = slope / error[:, None]
        weight = 1.0 / np.maximum(np.abs(off), 1.0)
        normal = (jacobian * weight[:, None]).T @ jacobian + prior
        move = np.linalg.solve(normal, jacobian.T @ (weight * off) - prior @ (at - _USUAL))
        at = at + np.clip(move, -0.5, 0.5)
        if float(np.abs(move).max()) < 1e-4:
            break
    return at, np.asarray(np.linalg.inv(normal), np.float64)


def _model(
    at: FloatArray, across: FloatArray, slant: FloatArray, step: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Logarithms (2K,) of lengths, then widths, and their derivatives (2K, 3) by `at`."""
    strand, sheet, ratio = np.exp(at)
    lit = strand + _HALO_STEPS * step
    one, other = (lit / across) ** 2, (sheet * slant) ** 2
    by_strand = one / (one + other)
    wide = strand + _STRAND_MORE
    full, clipped = (ratio * sheet) ** -3, (slant * across / wide) ** 3
    by_clip = clipped / (full + clipped)
    slope = np.zeros((2, len(across), 3))
    slope[0, :, 0], slope[0, :, 1] = by_strand * strand / lit, 1.0 - by_strand
    slope[1, :, 0] = by_clip * strand / wide
    slope[1, :, 1] = slope[1, :, 2] = 1.0 - by_clip
    expected = np.r_[0.5 * np.log(one + other), -np.log(full + clipped) / 3.0]
    return expected, slope.reshape(-1, 3)
