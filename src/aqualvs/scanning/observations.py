"""Observations: the light of stripe units on a surface, averaged outside crossings.

A unit of stripe has one independent error: on a net a component, which is the light on one strand;
on a wall a subsegment. `observe` selects the units on a target, leaves out candidates where the
stripe of another laser crosses them, and averages the rest of each unit, weighted by intensity.
"""

from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import ZERO, inline_borrowing_kernel, inner_kernel, kernel
from aqualvs.geometry.linear_algebra import median_of, n_bins, squared
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Rig
from aqualvs.optics.sheet import COLUMNS, planes_and_bent, sheet_distance, sheets_of
from aqualvs.scanning.candidates import Candidates
from aqualvs.scanning.laser_bands import pixels_per_line
from aqualvs.scanning.stripe import PULL_OF_STEP, flank_difference

# Position noise of a unit's centroid beyond that of its peaks: a floor that neighbouring peaks
# share, and a share of the spread, because a strand's light may be cut off on one side by a knot or
# the border.
_SUBSEGMENT_FLOOR_PX = 0.08
_SPREAD_SHARE = 0.12
# Least number of search lines of the light on a strand; less is a fragment, off the strand's
# middle. Rows of a field and the search lines of wide pictures are two pixels apart, and thin twine
# across them is rarely seen in more than two.
_SHORTEST_STRAND, _SHORTEST_IF_COARSE = 3, 2
# Share of a strand's maximum height below which a peak does not count. On rendered nets, in clear
# and turbid water, it reduces the scatter of strands by 10 to 20 %; 0.3 and 0.5 do about the same.
_DIM_SHARE = 0.4


class Observations(NamedTuple):
    """Independent observations of a surface: centroids of M units of stripe."""

    # Shape (M, 3): centroid in `dome` (m) and its derivative by the stripe's position (m/px).
    points: FloatArray
    sensitivity: FloatArray
    # Shape (M,): standard deviation of the stripe's position.
    sigma_px: FloatArray
    # Shape (M,): mean difference between the flanks of its peaks, as a share of their height,
    # positive if the background is brighter at larger positions; on a net, the mean over all
    # strands of the laser.
    glow: FloatArray
    # Shape (M,): means over its peaks: full width at half height along the search line, in pixels;
    # height above the background, in grey levels.
    width: FloatArray
    height: FloatArray
    # Shape (M,): mean search line.
    line: FloatArray
    # Shape (M,): index of the laser.
    laser: IntArray

    @property
    def n(self) -> int:
        """Number of observations."""
        return len(self.laser)


class Observed(NamedTuple):
    """Observations of one surface in a frame, and the candidates that they average."""

    group: IntArray  # Shape (N,): each candidate's observation; -1 for those in none.
    n_candidates: int  # Number of candidates in observations.
    observations: Observations


class StripeObserver:
    """Selection and averaging of the units of stripe on surfaces in front of one rig.

    Parameters
    ----------
    rig : Rig
        Its lasers, focal length and shutter.
    """

    def __init__(self, rig: Rig) -> None:
        sheets = np.array([one.packed() for one in sheets_of(rig)]).reshape(-1, COLUMNS)
        self.planes, self.bent = planes_and_bent(sheets)
        self._focal_px = rig.focal_px
        is_coarse = rig.shutter.is_interlaced or pixels_per_line(rig.size_px) > 1
        self._shortest_strand = _SHORTEST_IF_COARSE if is_coarse else _SHORTEST_STRAND

    def observe(
        self,
        candidates: Candidates,
        on_target: BoolArray,
        plane: Plane,
        *,
        on_twine: bool,
        flat: bool = False,
    ) -> Observed:
        """Average the units of stripe on a target, without candidates in crossings.

        Parameters
        ----------
        candidates : Candidates
            N of them.
        on_target : bool array, shape (N,)
            Candidates on the target.
        plane : Plane
            Approximate plane of the surface; spread is measured along its normal.
        on_twine : bool
            Whether the target is a net.
        flat : bool
            Whether the whole target lies on the plane.
        """
        unit = candidates.component if on_twine else candidates.subsegment
        min_lines = self._shortest_strand if on_twine else 1
        m = plane.normal / plane.offset if flat else np.zeros(3)
        return _observe(
            candidates,
            unit,
            min_lines,
            on_target,
            plane.normal,
            m,
            self.planes,
            self.bent,
            self._focal_px,
            on_twine,
        )


@kernel
def _observe(
    candidates: Candidates,
    unit: IntArray,
    min_lines: int,
    on_target: BoolArray,
    normal: FloatArray,
    m: FloatArray,
    planes: FloatArray,
    bent: FloatArray | None,
    focal_px: float,
    on_twine: bool,
) -> Observed:
    """Average the units of stripe on a target, given the lasers' sheets.

    A unit counts as a whole if one of its candidates is on the target: the centroid of a part of a
    strand's light would be off the sheet. Outside a crossing it must still be long enough.
    """
    points, laser = candidates.points, candidates.laser
    number = _units_on(unit, min_lines, on_target)
    mean_width = _mean_widths(laser, candidates.width, unit, number, planes.shape[0])
    group, lines = np.full(unit.shape[0], -1), np.zeros(number.shape[0], np.int64)
    for i in range(unit.shape[0]):
        p = unit[i]
        if number[p] != -1 and not in_crossing(
            points, i, laser[i], m, planes, bent, mean_width, focal_px
        ):
            group[i] = p
            lines[p] += 1
    n_groups, n_candidates = ZERO, 0
    for i in range(unit.shape[0]):
        p = group[i]
        if p == -1:
            continue
        if lines[p] < min_lines:
            group[i] = -1
            continue
        if number[p] == -2:
            number[p] = n_groups
            n_groups += 1
        group[i] = number[p]
        n_candidates += 1
    seen = average_groups(candidates, group, n_groups, normal, on_twine)
    return Observed(group, n_candidates, seen)


@inner_kernel
def _units_on(unit: IntArray, min_lines: int, on_target: BoolArray) -> IntArray:
    """Return -2 for each unit on the target that is long enough, -1 for others."""
    n_units = n_bins(unit)
    number, lines = np.full(n_units, -1), np.zeros(n_units, np.int64)
    for i in range(unit.shape[0]):
        lines[unit[i]] += 1
        if on_target[i]:
            number[unit[i]] = -2
    for p in range(n_units):
        if lines[p] < min_lines:
            number[p] = -1
    return number


@inner_kernel
def _mean_widths(
    laser: IntArray, width: FloatArray, unit: IntArray, number: IntArray, n_lasers: int
) -> FloatArray:
    """Return each laser's mean stripe width in pixels, -1 without a stripe.

    Means, because a crossing inflates the widths of the peaks in it. A few stray peaks of a dark
    laser, often wide, are no stripe: their crossing with another one could cover all of it.
    """
    # Least number of peaks of a stripe, as a share of that of the longest.
    stray_share = 0.05
    total, count = np.zeros(n_lasers), np.zeros(n_lasers)
    for i in range(unit.shape[0]):
        if number[unit[i]] != -1:
            total[laser[i]] += width[i]
            count[laser[i]] += 1.0
    least = stray_share * count.max()
    for index in range(n_lasers):
        total[index] = total[index] / count[index] if count[index] > least else -1.0
    return total


@inline_borrowing_kernel
def in_crossing(
    points: FloatArray,
    i: int,
    own: int,
    m: FloatArray,
    planes: FloatArray,
    bent: FloatArray | None,
    mean_width: FloatArray,
    focal_px: float,
) -> bool:
    """Return whether another laser's stripe crosses the target here (paper, section 3.1).

    If the target is the plane m·X = 1, the point is projected to it along the line of sight, which
    passes near the dome's centre: where two stripes merge, the point is off the plane with either
    laser. m is zero if the target is no plane.
    """
    x, y, z = points[i, 0], points[i, 1], points[i, 2]
    depth = m[0] * x + m[1] * y + m[2] * z
    if depth > 0.0:
        x, y, z = x / depth, y / depth, z / depth
    m_per_px = np.sqrt(x * x + y * y + z * z) / focal_px
    # Half size of a crossing: this many full widths of the wider stripe, plus this many pixels.
    crossing_widths = 1.2
    crossing_px = 2.0
    for b in range(planes.shape[0]):
        if b == own or mean_width[b] < 0.0:
            continue
        gap = planes[b, 0] * x + planes[b, 1] * y + planes[b, 2] * z - planes[b, 3]
        if bent is not None:
            gap = sheet_distance(bent[b], x, y, z)
        wide = max(mean_width[b], mean_width[own])
        if abs(gap) < (crossing_widths * wide + crossing_px) * m_per_px:
            return True
    return False


@inner_kernel
def average_groups(
    candidates: Candidates, group: IntArray, n: int, normal: FloatArray, on_twine: bool
) -> Observations:
    """Average groups of candidates, weighted by intensity.

    A strand is lit where it crosses the laser sheet, brightest in the sheet's middle; the centroid
    of that light lies on the sheet, whatever the strand's direction. The dim ends are mostly noise,
    and on the near side glow of the water: only intensity above a share of the strand's maximum
    counts. The glow ends with the sheet, at the strand: a step of background, blurred as the
    stripe, whose pull is subtracted.

    Parameters
    ----------
    candidates : Candidates
        N of them.
    group : int array, shape (N,)
        Group of each candidate, 0 to `n` - 1, or -1 to leave it out; no group is empty.
    n : int
        Number of groups.
    normal : array, shape (3,)
        Approximate normal of the surface; spread is measured along it.
    on_twine : bool
        Whether the groups are strands of a net.
    """
    height, width, points = candidates.height, candidates.width, candidates.points
    floor = np.zeros(n)
    if on_twine:
        for i in range(group.shape[0]):
            if group[i] >= 0:
                floor[group[i]] = max(floor[group[i]], _DIM_SHARE * height[i])
    seen = Observations(
        np.zeros((n, 3)),
        np.zeros((n, 3)),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.empty(n, np.int64),
    )
    total, spread, full = np.zeros(n), np.zeros(n), np.zeros(n)
    lines = np.zeros(n, np.int64)
    for i in range(group.shape[0]):
        c = group[i]
        if c < 0:
            continue
        intensity_weight = max(height[i] - floor[c], 0.0) * width[i]
        total[c] += intensity_weight
        lines[c] += 1
        for k in range(3):
            seen.points[c, k] += intensity_weight * points[i, k]
            seen.sensitivity[c, k] += intensity_weight * candidates.sensitivity[i, k]
        # Variance of a weighted mean of independent positions.
        seen.sigma_px[c] += squared(intensity_weight * candidates.sigma_px[i])
        seen.glow[c] += intensity_weight * flank_difference(candidates.pull[i], width[i])
        seen.width[c] += intensity_weight * width[i]
        seen.height[c] += intensity_weight * height[i]
        seen.line[c] += intensity_weight * candidates.line[i]
        seen.laser[c] = candidates.laser[i]
    middle = np.empty(n)
    for c in range(n):
        share = 1.0 / total[c]
        middle[c] = 0.0
        for k in range(3):
            seen.points[c, k] *= share
            seen.sensitivity[c, k] *= share
            middle[c] += normal[k] * seen.points[c, k]
        seen.sigma_px[c] *= share * share
        seen.glow[c] *= share
        seen.width[c] *= share
        seen.height[c] *= share
        seen.line[c] *= share
    for i in range(group.shape[0]):
        c = group[i]
        if c >= 0:
            off = -middle[c]
            for k in range(3):
                off += normal[k] * points[i, k]
            spread[c] += height[i] * width[i] * off * off
            full[c] += height[i] * width[i]
    for c in range(n):
        per_px = 0.0
        for k in range(3):
            per_px += normal[k] * seen.sensitivity[c, k]
        # From here on a variance in px².
        spread[c] /= full[c] * per_px * per_px
        variance = seen.sigma_px[c] + squared(_SPREAD_SHARE) * spread[c]
        seen.sigma_px[c] = np.sqrt(variance + squared(_SUBSEGMENT_FLOOR_PX))
    if on_twine:
        _subtract_glow(seen, total)
        _widen_along_strands(seen, lines, spread)
    return seen


@inner_kernel
def _widen_along_strands(seen: Observations, lines: IntArray, spread: FloatArray) -> None:
    """Inflate the sigma of strands that lie along the sheet.

    Such a strand need not cross the middle of the sheet: its light lies where the strand is. Thin
    twine shows less than the sheet's full width there, and the rest is where the middle may be. A
    strand that crosses all of the sheet at a small angle spreads as far as the sheet is wide.
    `lines` (M,) is the number of search lines of each of M strands, `spread` (M,) the variance of
    the positions of its peaks about their mean, in px².
    """
    # A strand lies along the sheet if its light is longer than so many of its widths, and narrower
    # than this share of the sheet.
    along_widths, narrow_share = 4.0, 0.85
    # Its distance from the sheet's middle, as a share of the width that it does not show: on
    # rendered level nets 0.3 to 0.7. Standard deviation of the light on a strand that crosses all
    # of the sheet, as a share of the sheet's width.
    off_share, crossed_share = 0.6, 0.25
    # The sheet's width is that of the light across strands, whatever the laser: light of others,
    # assigned to one, may be narrower.
    across, n = np.empty(lines.shape[0]), 0
    for c in range(lines.shape[0]):
        if lines[c] < along_widths * seen.width[c]:
            across[n] = seen.width[c]
            n += 1
    sheet = median_of(across[:n]) if n else 0.0
    for c in range(lines.shape[0]):
        if lines[c] < along_widths * seen.width[c] or seen.width[c] > narrow_share * sheet:
            continue
        crossed = spread[c] / squared(crossed_share * sheet)
        hidden = (sheet - seen.width[c]) * max(1.0 - crossed, 0.0)
        seen.sigma_px[c] = np.sqrt(squared(seen.sigma_px[c]) + squared(off_share * hidden))


@inner_kernel
def _subtract_glow(seen: Observations, intensity: FloatArray) -> None:
    """Subtract the pull of the glow from the points on strands, given their total intensity (M,).

    The glow of a sheet is the same beside all of its strands, while light on other twine disturbs
    the measured glow of a single strand: `glow` is replaced by the mean over the laser's strands.
    """
    n_lasers = n_bins(seen.laser)
    levels, total = np.zeros(n_lasers), np.zeros(n_lasers)
    for c in range(seen.laser.shape[0]):
        levels[seen.laser[c]] += intensity[c] * seen.glow[c] * seen.height[c]
        total[seen.laser[c]] += intensity[c]
    for c in range(seen.laser.shape[0]):
        seen.glow[c] = levels[seen.laser[c]] / (total[seen.laser[c]] * seen.height[c])
        for k in range(3):
            moved = PULL_OF_STEP * seen.width[c] * seen.glow[c] * seen.sensitivity[c, k]
            seen.points[c, k] -= moved
