"""Solidity of a net, and thickness of its twine, from the lit parts of the lasers' lines.

**Solidity.** The share of a line that is lit is, in expectation, the share of the area that strands
cover (Delesse, C. R. Acad. Sci. 25 (1847) 544; Rosiwal, Verh. k. k. geol. Reichsanst. 1898, 143).
The amount that the detector adds to every dash is subtracted (`Twine.excess`).

**Twine.** The light on a strand is where strand and laser sheet overlap: a parallelogram with
rounded corners. Search lines meet it over a length that follows in quadrature from strand and
sheet, and across the line it is as wide as the narrower of sheet and strand:

    (length / b)² = (l / sin a)² + (w k)²,    width⁻ᵖ = (r w)⁻ᵖ + (k sin a / (d + e))ᵖ,

with the silhouette d, its lit width l, the crossing angle a, the sheet's lit width w and the slant
k, by which the strand runs away from the search lines on its way across the sheet; r is the ratio
of the sheet's width at half height to its lit width. Dashes at several angles separate strand and
sheet. A dash ends where its light falls below a share of its own peak (`aqualvs.nets.dashes`), so
that its length depends only weakly on brightness, by the factor b: overexposed tops are cut off,
and faint edges are lost. l is less than d, because round strands are dim at their edges, and more
by blur; the amount was measured in simulation, and the uncertainty covers its variation.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.nets.dashes import NetView
from aqualvs.nets.lattice import Fit, NetLattice
from aqualvs.nets.spectrum import Mesh


class _TwineOptions(NamedTuple):
    """Lit width of a strand and its error."""

    # Lit width of a strand: a share of its silhouette, plus a length in metres and one in steps of
    # the search lines; and the power of its height over the usual one, in grey levels, with which
    # dashes grow. From simulated dives in clear and turbid water at 0.3 to 1.0 m with known twine.
    seen: float = 0.82
    halo: float = 0.43e-3
    halo_steps: float = 0.44
    brighter: float = 0.25
    min_height: float = 25.0
    # Variation of that in steps; and as a share of the strand at zero height, falling to zero at a
    # height from which strands are seen in full.
    sigma_halo: float = 0.07
    sigma_faint: float = 0.12
    faint: float = 90.0
    # Width of a strand at half height less its silhouette, in pixels; and the exponent p (same
    # dives).
    strand_more: float = 0.95
    corner: float = 2.5
    # True errors over those of the fit, which overestimates them with single kinds.
    true_error: float = 0.7
    rounds: int = 40


_TWINE = _TwineOptions()

USUAL_HEIGHT = np.array(100.0)
"""Height of a dash at which `Twine.halo` holds, in grey levels."""
# Priors: silhouette of a strand and lit width of the sheet in metres, the sheet's width at half
# height over its lit one; and their spreads as logarithms.
_USUAL, _SPREAD = np.log([2.2e-3, 2.8e-3, 0.95]), np.array([1.5, 0.2, 0.1])


@dataclass(frozen=True, slots=True)
class DashKind:
    """Mean dash of one laser on one family of strands."""

    # Of the dashes.
    laser: int
    family: int
    # Sine of the angle between the laser's line and the strands, 0 to 1.
    across: float
    # Displacement of the strand along the line, measured by search lines, per metre across it.
    slant: float
    # Of a typical dash along the line, in metres.
    length: float
    # Of its light at half height, square to the line, in metres.
    width: float
    # Of its light, in grey levels.
    height: float
    # Length of laser line per search line, in metres.
    step: float
    # Size of a pixel on the net, in metres.
    pixel: float
    # Logarithm of the ratio of long dashes to short ones: a measure of growth.
    spread: float
    # Dashes.
    count: int


@dataclass(frozen=True, slots=True)
class Twine:
    """Estimated thickness of twine, and the widths that explain its dashes."""

    # Diameter and its standard deviation, in metres.
    thickness: float
    sigma: float
    # Width of its silhouette, in metres.
    body: float
    # Width within which the light sheet is seen, in metres.
    sheet: float
    # Lit width of a strand beyond its body where search lines are close, in metres, and the
    # standard deviation of the separation of body and halo.
    halo: float
    sigma_halo: float

    def dash_length(
        self, across: FloatArray, slant: FloatArray, step: FloatArray, height: FloatArray
    ) -> FloatArray:
        """Return the length of dashes (m) by crossing angle, slant, step, height (`DashKind`)."""
        straight = self._lit(step) / across
        return np.asarray(_length_factor(height) * np.hypot(straight, self.sheet * slant))

    def excess(
        self, across: FloatArray, slant: FloatArray, step: FloatArray, height: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the part of `dash_length` not due to twine (m), and its standard deviation."""
        length = self.dash_length(across, slant, step, height)
        straight = _length_factor(height) * self._lit(step) / across
        # Relative uncertainty of the length that slant adds to a dash.
        slant_error_share = 0.1
        sigma = np.hypot(self.sigma_halo / across, slant_error_share * (length - straight))
        return length - self.body / across, np.asarray(sigma)

    def _lit(self, step: FloatArray) -> FloatArray:
        """Return the lit width at the usual height, in metres."""
        return np.asarray(self.body + self.halo + _TWINE.halo_steps * step)


def measure_twine(kinds: Sequence[DashKind], known: float | None = None) -> Twine | None:
    """Fit twine and sheet to the dashes of several kinds; None without any.

    The more different the angles and slants of the kinds, the better. Where the diameter of the
    bare twine is `known`, in metres, the halo is measured.
    """
    if not kinds:
        return None
    at, covariance = _fit(kinds)
    strand, sheet, _ = np.exp(at)
    sigma_strand = _TWINE.true_error * float(strand * np.sqrt(covariance[0, 0]))
    # The silhouette of twisted twine is on average narrower than its diameter.
    silhouette = 0.95
    if known is not None:
        body = silhouette * known
        halo = _TWINE.seen * float(strand) + _TWINE.halo - body
        return Twine(known, 0.0, body, float(sheet), halo, _TWINE.seen * sigma_strand)
    step, height = np.median([[k.step, k.height] for k in kinds], axis=0)
    faint = max(1.0 - float(height) / _TWINE.faint, 0.0)
    body = float(strand)
    of_halo = math.hypot(_TWINE.sigma_halo * float(step), _TWINE.sigma_faint * faint * body)
    sigma = math.hypot(sigma_strand, of_halo / _TWINE.seen)
    return Twine(
        thickness=body / silhouette,
        sigma=sigma / silhouette,
        body=body,
        sheet=float(sheet),
        halo=_TWINE.halo - (1.0 - _TWINE.seen) * body,
        sigma_halo=_TWINE.seen * sigma,
    )


def _length_factor(height: FloatArray) -> FloatArray:
    """Return the ratio of the length of dashes to that of dashes of the usual height."""
    return np.asarray((np.maximum(height, _TWINE.min_height) / USUAL_HEIGHT) ** _TWINE.brighter)


def _fit(kinds: Sequence[DashKind]) -> tuple[FloatArray, FloatArray]:
    """Fit the logarithms (3,) of silhouette, sheet and sheet's half-height ratio.

    Gauss-Newton with Huber's weights of lengths and widths. Return them and their covariance.
    """
    across, slant, length, width, step, pixel, height, count = np.array(
        [[k.across, k.slant, k.length, k.width, k.step, k.pixel, k.height, k.count] for k in kinds],
        np.float64,
    ).T
    blur = _TWINE.halo + _TWINE.halo_steps * step, _TWINE.strand_more * pixel
    seen = np.log(np.r_[length / _length_factor(height), width])
    # Error of bare twine's length for the spread of all lengths: growth may be taken for twine.
    spread_error = 0.15
    grown = spread_error * np.array([k.spread for k in kinds])
    # Errors of a kind's length and width: relative, relative for one dash, and in search lines.
    length_error, width_error, dash_error, error_px = 0.06, 0.115, 0.2, 0.2
    of_length = np.hypot(np.hypot(length_error, grown), error_px * step / length)
    error = np.r_[of_length, np.full(len(kinds), width_error)]
    error = np.hypot(error, np.tile(dash_error / np.sqrt(count), 2))
    # Error of the model, which grows with the slant of the strand.
    slant_error = 0.7
    error *= np.tile(1.0 + slant_error * slant, 2)
    prior = np.diag(_SPREAD**-2)
    at, normal = _USUAL.copy(), prior
    at[0] = np.log(np.clip(np.min(length * across) - _TWINE.halo, 3e-4, 2e-2))
    for _ in range(_TWINE.rounds):
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
    """Return logarithms (2K,) of lengths, then widths, and their derivatives (2K, 3) by `at`."""
    strand, sheet, ratio = np.exp(at)
    lit = _TWINE.seen * strand + halo
    one, other = (lit / across) ** 2, (sheet * slant) ** 2
    by_strand = one / (one + other)
    wide = strand + more
    full, clipped = (ratio * sheet) ** -_TWINE.corner, (slant * across / wide) ** _TWINE.corner
    by_clip = clipped / (full + clipped)
    slope = np.zeros((2, len(across), 3))
    slope[0, :, 0], slope[0, :, 1] = by_strand * _TWINE.seen * strand / lit, 1.0 - by_strand
    slope[1, :, 0] = by_clip * strand / wide
    slope[1, :, 1] = slope[1, :, 2] = 1.0 - by_clip
    expected = np.r_[0.5 * np.log(one + other), -np.log(full + clipped) / _TWINE.corner]
    return expected, slope.reshape(-1, 3)


@dataclass(frozen=True, slots=True)
class RegisteredView:
    """A frame with the place of the lattice in it."""

    view: NetView  # Dashes and gaps of the frame.
    fit: Fit  # Assignment of its dashes to strands.
    # Shape (2,): place of the origin of `net` on the net itself, as `NetTrack.place`.
    place: FloatArray


@dataclass(frozen=True, slots=True)
class _Angles:
    """Angles between strands and a laser's line and search lines; arrays of equal shape."""

    across: FloatArray  # Sine of the angle between line and strand.
    slant: FloatArray  # As in `DashKind`.
    square: FloatArray  # Sine of the angle between line and search lines.

    @classmethod
    def of(cls, line: FloatArray, search: FloatArray, normal: FloatArray) -> "_Angles":
        beside = np.stack([-line[..., 1], line[..., 0]], axis=-1)
        # At smaller sines of the angle a strand counts as parallel to the line.
        nearly_along = 0.02
        across = np.maximum(np.abs(np.sum(line * normal, axis=-1)), nearly_along)
        square = np.maximum(np.abs(np.sum(search * beside, axis=-1)), nearly_along)
        slant = np.abs(np.sum(search * normal, axis=-1)) / (across * square)
        return cls(across, slant, square)


def _angles(lattice: NetLattice, one: RegisteredView) -> _Angles:
    """Return the angles of every dash."""
    laser = one.view.dashes.laser
    normal = lattice.normals[one.fit.family]
    return _Angles.of(one.view.direction[laser], one.view.search[laser], normal)


def dash_kinds(lattice: NetLattice, frames: Sequence[RegisteredView]) -> list[DashKind]:
    """Group whole dashes that lie clearly on one strand by laser and family."""
    rows = [_rows(lattice, one) for one in frames]
    table = np.concatenate([np.empty((0, 9)), *rows])
    kinds = np.unique(table[:, :2], axis=0)
    each = [table[np.all(table[:, :2] == kind, axis=1)] for kind in kinds]
    min_dashes, slanted, usual_spread, short, long = 6, 1.5, 0.15, 0.25, 0.7
    each = [mine for mine in each if len(mine) >= min_dashes]
    # Long dashes against short ones; on slanted strands the light sheet evens them out.
    even = [mine for mine in each if np.median(mine[:, 3]) < slanted]
    spreads = [np.log(_length_at(mine, long) / _length_at(mine, short)) for mine in even]
    spread = float(np.median(spreads)) if spreads else usual_spread
    return [_kind(mine, spread) for mine in each]


def _kind(mine: FloatArray, spread: float) -> DashKind:
    """Average dashes, given as rows of `_rows`."""
    across, slant, height, step, pixel = np.median(mine[:, [2, 3, 6, 7, 8]], axis=0)
    # Growth lengthens dashes and makes them differ. Share of all light on a kind's dashes up to
    # which they are bare, and the scale of the spread with which it falls; then the spread by
    # noise, in grey levels, and without noise. From simulated dives.
    bare_share, differ, min_bare, noise, no_noise = 0.45, 0.22, 0.08, 7.0, 0.03
    noise = np.hypot(noise / max(height, 1.0), no_noise)
    grown = np.sqrt(max(spread**2 - noise**2, 0.0))
    share = float(max(bare_share * np.exp(-grown / differ), min_bare))
    width_quantile = 0.4
    return DashKind(
        laser=int(mine[0, 0]),
        family=int(mine[0, 1]),
        across=float(across),
        slant=float(slant),
        length=_length_at(mine, share),
        width=float(np.quantile(mine[:, 5], width_quantile)),
        height=float(height),
        step=float(step),
        pixel=float(pixel),
        spread=spread,
        count=len(mine),
    )


def _length_at(mine: FloatArray, share: float) -> float:
    """Return the light-weighted quantile of the lengths of dashes; fragments count less."""
    ordered = np.sort(mine[:, 4])
    light = np.cumsum(ordered)
    return float(ordered[np.searchsorted(light, share * light[-1])])


def _rows(lattice: NetLattice, one: RegisteredView) -> FloatArray:
    """Return rows (laser, family, across, slant, length, width, height, step) of clear dashes."""
    pitch, dashes, fit = lattice.pitch, one.view.dashes, one.fit
    angles = _angles(lattice, one)
    # Crossing angle (sine), distance from the strand and from others (pitches).
    min_across, on_strand, clear_of_others = 0.4, 0.12, 0.2
    clear = dashes.whole & (fit.off < on_strand * pitch[fit.family])
    clear &= angles.across > min_across
    if lattice.mesh is Mesh.FOUR_SIDED:
        clear &= fit.clear > clear_of_others * pitch.min()
    step = one.view.step[dashes.laser]
    # A search line is a whole number of pixels wide; its step gives their size on the net more
    # accurately than the range does.
    lines = np.maximum(np.rint(step * angles.square / one.view.pixel), 1.0)
    pixel = step * angles.square / lines
    columns = [
        dashes.laser,
        fit.family,
        angles.across,
        angles.slant,
        dashes.length,
        dashes.width * angles.square * pixel / one.view.pixel,
        dashes.height,
        step,
        pixel,
    ]
    return np.stack([column[clear].astype(np.float64) for column in columns], axis=1)


def measure_solidity(
    lattice: NetLattice, twine: Twine, frames: Sequence[RegisteredView]
) -> tuple[float, float] | None:
    """Return the share of the sound net that strands and growth cover, and its standard deviation.

    For hexagons, whose strands every laser crosses in three directions, the lasers' lines are
    evaluated as a whole. For meshes with four sides each family is evaluated from the lasers that
    cross it at an angle at which no dash is lost.
    """
    counts = np.ones((len(frames[0].view.step), len(lattice.waves)), np.bool_)
    if lattice.mesh is Mesh.FOUR_SIDED:
        counts = _reliable(lattice, twine, frames[len(frames) // 2].view)
    shape = (len(frames), *counts.shape)
    body, error, seen = np.zeros(shape), np.zeros(shape), np.zeros(shape[:2])
    rows = []
    for i, one in enumerate(frames):
        dashes, family = one.view.dashes, one.fit.family
        angles = _angles(lattice, one)
        at = angles.across, angles.slant, one.view.step[dashes.laser], dashes.height
        excess, sigma = twine.excess(*at)
        # A dash that is cut off, or lies along the edge of the light, has a share of the halo only.
        share = np.minimum(dashes.length / twine.dash_length(*at), 1.0)
        share = np.where(dashes.whole, share, 0.5 * share)
        mine = dashes.length - excess * share
        rows.append(np.c_[family, mine, dashes.place + one.place][counts[dashes.laser, family]])
        np.add.at(body[i], (dashes.laser, family), mine)
        np.add.at(error[i], (dashes.laser, family), sigma * share)
        seen[i] = sound_length(lattice, one.view)
    if not np.all(np.any(counts & (seen.sum(axis=0) > 0.0)[:, None], axis=0)):
        return None
    solidity = _family_sum(body, seen, counts)
    n_blocks = min(6, len(frames))
    blocks = np.array_split(np.arange(len(frames)), n_blocks)
    parts = [_family_sum(body[b], seen[b], counts) for b in blocks]
    chance = float(np.std(parts, ddof=1) / np.sqrt(len(parts))) if len(parts) > 1 else 0.1
    # Errors for dashes that run together or are not seen, as shares: of any net, and per pixel in
    # the distance of two strands (simulated dives); and as a share of the area that growth adds: it
    # stands out of the net, and is lit and seen askew.
    of_any, per_pixel, of_growth = 0.04, 1.5, 0.25
    pixel = frames[len(frames) // 2].view.pixel
    unresolved = per_pixel * pixel / float(lattice.pitch.min())
    shares = [_spread_of_mean(np.concatenate(rows)), of_any, unresolved]
    bare = float(np.sum(twine.body * lattice.mesh.density / lattice.pitch))
    grown = of_growth * max(solidity - bare, 0.0)
    sigmas = [chance, _family_sum(error, seen, counts), grown, *(solidity * one for one in shares)]
    return float(np.clip(solidity, 0.0, 1.0)), float(np.linalg.norm(sigmas))


def _spread_of_mean(rows: FloatArray) -> float:
    """Return the relative error of the mean of dashes (family, length, place) by their spread.

    Dashes near to one another show the same growth, even in different frames.
    """
    variance, weight = 0.0, 0.0
    # Distance along the net beyond which growth is independent, in metres.
    alike = 0.02
    for family in np.unique(rows[:, 0]):
        mine = rows[rows[:, 0] == family, 1:]
        total, mean = float(mine[:, 0].sum()), float(mine[:, 0].mean())
        independent = len(np.unique(np.floor(mine[:, 1:] / alike), axis=0))
        if mean > 0.0:
            variance += (total * float(mine[:, 0].std()) / mean) ** 2 / independent
            weight += total
    return float(np.sqrt(variance) / weight) if weight > 0.0 else 1.0


def long_gaps(lattice: NetLattice, view: NetView) -> BoolArray:
    """Mark the gaps of a frame that are longer than the lattice allows."""
    direction = np.where(np.isfinite(view.direction), view.direction, lattice.normals[0])
    longest = 1.0 / np.abs(direction @ lattice.waves.T).max(axis=1)
    # A dark piece this much longer than the lattice allows is no opening; openings of hexagons are
    # two bars long.
    too_long, hexagon_gap = 1.25, 2.0
    if lattice.mesh is Mesh.SIX_SIDED:
        longest = np.full(len(view.step), hexagon_gap * lattice.bar)
    return np.asarray(view.gaps.length > too_long * longest[view.gaps.laser])


def sound_length(lattice: NetLattice, view: NetView) -> FloatArray:
    """Return the visible metres of each laser's line (L,), without gaps that are too long."""
    length, long = np.zeros(len(view.step)), long_gaps(lattice, view)
    np.add.at(length, view.span_laser, view.span[:, 1] - view.span[:, 0])
    np.subtract.at(length, view.gaps.laser[long], view.gaps.length[long])
    return length


def _family_sum(body: FloatArray, seen: FloatArray, counts: BoolArray) -> float:
    """Return the covered share of the lines, summed over families; axes: frames, lasers, family."""
    covered = np.sum(body.sum(axis=0) * counts, axis=0)
    looked = np.sum(seen.sum(axis=0)[:, None] * counts, axis=0)
    return float(np.sum(covered / np.maximum(looked, 1e-9)))


def _reliable(lattice: NetLattice, twine: Twine, view: NetView) -> BoolArray:
    """Mark the lasers and families (L, F) without lost crossings.

    Light that runs along a strand for many search lines is taken for another laser's stripe. Where
    no laser crosses a family at a good angle, the one with the best angle is used.
    """
    line, search = np.nan_to_num(view.direction), np.nan_to_num(view.search)
    angles = _Angles.of(line[:, None], search[:, None], lattice.normals[None])
    step = view.step[:, None]
    lines = twine.dash_length(angles.across, angles.slant, step, USUAL_HEIGHT) / step
    max_lines = 20.0  # Longer dashes may be lost (`segments`).
    good: BoolArray = lines < max_lines
    best = lines.argmin(axis=0)
    good[best, np.arange(len(best))] = True
    return good
