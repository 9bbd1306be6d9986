"""Thickness of twine, from how long and how wide the light is on strands that cross at angles.

The light on a strand is where strand and laser sheet overlap: a parallelogram with rounded corners.
Search lines meet it over a length that follows in quadrature from strand and sheet, and across the
line it is as wide as the sheet or as the strand lets it be, whichever is less:

    (length / b)² = (l / sin a)² + (w k)²,    width⁻ᵖ = (r w)⁻ᵖ + (k sin a / (d + e))ᵖ,

with the silhouette d, its lit width l, the crossing angle a, the sheet's lit width w and the slant
k, by which the strand runs away from the search lines on its way across the sheet. Dashes at
several angles tell strand and sheet apart; r says how the sheet's width at half height compares
with its lit one. A dash ends where its light falls below a share of its own peak (`net_dashes`), so
that its length depends on brightness little, as b says: overexposed tops are cut off, and faint
edges are lost. l is less than d, because round strands are dim at their edges, and more by blur.
How much was measured in simulation; the uncertainty holds what it varied.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import FloatArray

# Lit width of a strand: so much of its silhouette, and so much more in metres and in steps of the
# search lines; and the power of its height over the usual one, in grey levels, with which dashes
# grow. From simulated dives in clear and turbid water at 0.3 to 1.0 m whose twine was known.
_SEEN, _HALO, _HALO_STEPS, _BRIGHTER = 0.82, 0.43e-3, 0.44, 0.25
_LEAST_HEIGHT = 25.0
USUAL_HEIGHT = np.array(100.0)
"""Height of a dash at which `Twine.halo` holds, in grey levels."""
# What that varies in steps; and as a share of the strand where there is no light at all, less up to
# a height at which strands are no longer seen in part.
_SIGMA_HALO, _SIGMA_FAINT, _FAINT = 0.07, 0.12, 90.0
# The silhouette of twisted twine is on average narrower than its diameter.
_SILHOUETTE = 0.95
# Width of a strand at half height less its silhouette, in pixels; and the exponent p (same dives).
_STRAND_MORE, _CORNER = 0.95, 2.5
# Before any dash was seen: silhouette of a strand and lit width of the sheet in metres, the sheet's
# width at half height over its lit one; and their spreads as logarithms.
_USUAL, _SPREAD = np.log([2.2e-3, 2.8e-3, 0.95]), np.array([1.5, 0.2, 0.1])
# Errors of a kind's length and width: relative, relative for one dash, and in search lines.
_LENGTH_ERROR, _WIDTH_ERROR, _DASH_ERROR, _ERROR_PX = 0.06, 0.115, 0.2, 0.2
# Error of bare twine's length for the spread of all lengths: growth may be taken for twine.
_SPREAD_ERROR = 0.15
# The model holds the less the more slanted the strand is.
_SLANT_ERROR = 0.7
# Uncertainty of what slant adds to a dash, as a share.
_SLANT_TOLD = 0.1
# True errors over those of the fit, which is cautious with single kinds.
_TRUE_ERROR = 0.7
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
    pixel : float
        Size of a pixel on the net, in metres.
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
    pixel: float
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

    def usual(
        self, across: FloatArray, slant: FloatArray, step: FloatArray, height: FloatArray
    ) -> FloatArray:
        """Length of dashes, in metres, by crossing angle, slant, step, height as in `DashKind`."""
        return np.asarray(_bright(height) * np.hypot(self._lit(step) / across, self.sheet * slant))

    def excess(
        self, across: FloatArray, slant: FloatArray, step: FloatArray, height: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return what of `usual` is not twine, in metres, and its standard deviation."""
        usual = self.usual(across, slant, step, height)
        straight = _bright(height) * self._lit(step) / across
        sigma = np.hypot(self.sigma_halo / across, _SLANT_TOLD * (usual - straight))
        return usual - self.body / across, np.asarray(sigma)

    def _lit(self, step: FloatArray) -> FloatArray:
        """Lit width at the usual height, in metres."""
        return np.asarray(self.body + self.halo + _HALO_STEPS * step)


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
    sigma_strand = _TRUE_ERROR * float(strand * np.sqrt(covariance[0, 0]))
    if known is not None:
        body = _SILHOUETTE * known
        halo = _SEEN * float(strand) + _HALO - body
        return Twine(known, 0.0, body, float(sheet), halo, _SEEN * sigma_strand)
    step, height = np.median([[k.step, k.height] for k in kinds], axis=0)
    faint = max(1.0 - float(height) / _FAINT, 0.0)
    of_halo = math.hypot(_SIGMA_HALO * float(step), _SIGMA_FAINT * faint * float(strand)) / _SEEN
    sigma = math.hypot(sigma_strand, of_halo)
    body = float(strand)
    return Twine(
        thickness=body / _SILHOUETTE,
        sigma=sigma / _SILHOUETTE,
        body=body,
        sheet=float(sheet),
        halo=_HALO - (1.0 - _SEEN) * body,
        sigma_halo=_SEEN * sigma,
    )


def _bright(height: FloatArray) -> FloatArray:
    """How much longer dashes are than those of the usual height."""
    return np.asarray((np.maximum(height, _LEAST_HEIGHT) / USUAL_HEIGHT) ** _BRIGHTER)


def _fit(kinds: Sequence[DashKind]) -> tuple[FloatArray, FloatArray]:
    """Logarithms (3,) of silhouette, sheet and sheet's half-height ratio, and their covariance.

    Gauss-Newton; lengths and widths far off count less (Huber's weights).
    """
    across, slant, length, width, step, pixel, height, count = np.array(
        [[k.across, k.slant, k.length, k.width, k.step, k.pixel, k.height, k.count] for k in kinds],
        np.float64,
    ).T
    blur = _HALO + _HALO_STEPS * step, _STRAND_MORE * pixel
    seen = np.log(np.r_[length / _bright(height), width])
    grown = _SPREAD_ERROR * np.array([k.spread for k in kinds])
    of_length = np.hypot(np.hypot(_LENGTH_ERROR, grown), _ERROR_PX * step / length)
    error = np.r_[of_length, np.full(len(kinds), _WIDTH_ERROR)]
    error = np.hypot(error, np.tile(_DASH_ERROR / np.sqrt(count), 2))
    error *= np.tile(1.0 + _SLANT_ERROR * slant, 2)
    prior = np.diag(_SPREAD**-2)
    at, normal = _USUAL.copy(), prior
    at[0] = np.log(np.clip(np.min(length * across) - _HALO, 3e-4, 2e-2))
    for _ in range(_ROUNDS):
        expected, slope = _model(at, across, slant, *blur)
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
    at: FloatArray, across: FloatArray, slant: FloatArray, halo: FloatArray, more: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Logarithms (2K,) of lengths, then widths, and their derivatives (2K, 3) by `at`."""
    strand, sheet, ratio = np.exp(at)
    lit = _SEEN * strand + halo
    one, other = (lit / across) ** 2, (sheet * slant) ** 2
    by_strand = one / (one + other)
    wide = strand + more
    full, clipped = (ratio * sheet) ** -_CORNER, (slant * across / wide) ** _CORNER
    by_clip = clipped / (full + clipped)
    slope = np.zeros((2, len(across), 3))
    slope[0, :, 0], slope[0, :, 1] = by_strand * _SEEN * strand / lit, 1.0 - by_strand
    slope[1, :, 0] = by_clip * strand / wide
    slope[1, :, 1] = slope[1, :, 2] = 1.0 - by_clip
    expected = np.r_[0.5 * np.log(one + other), -np.log(full + clipped) / _CORNER]
    return expected, slope.reshape(-1, 3)
