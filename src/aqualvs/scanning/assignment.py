"""Laser assignment test: a surface against rival assignments of the same peaks to lasers.

If lasers are nearly parallel, a picture in which every stripe is assigned to the neighbouring laser
may show a plane as well: shifted and tilted, with small residuals. The rivals of a surface are
found by assigning the peaks of two of its stripes to other lasers, which gives a plane, and
refining that plane on all peaks. Each hypothesis is then judged by

- the peaks that it explains: peaks of the same appearance that are left over count against it;
- the lasers that are dark: a laser whose stripe would lie in the picture, beside visible ones, and
  shows nothing. It may be switched off or hidden, so this is a cost, not a gate;
- the residuals of each laser's stripe as a whole: the log-likelihood ratio of two fits with unknown
  noise is half the degrees of freedom times the logarithm of the ratio of the variances.

The order of the stripes needs no test: on a plane in front of camera and emitter the stripes of a
fan appear in the order of its lasers, and only such planes are considered.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from enum import Enum
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import lazy_kernel
from aqualvs.geometry.linear_algebra import n_bins
from aqualvs.geometry.planes import Plane, exchanged_plane, shifted_plane
from aqualvs.scanning.assignment_kernels import (
    CELL_LINES,
    DARK,
    FREEDOM,
    INTENSITY_WEIGHT,
    N_MEASURES,
    PER_LASER,
    SAME_ANGLE,
    SAME_RANGE,
    VARIANCE,
    exclusive_share,
    find_rivals,
    judge_planes,
    loose_share_before,
    stripe_visibility,
    two_longest_stripes,
)
from aqualvs.scanning.candidates import (
    Candidates,
    LinkedCandidates,
    Subsegments,
    lit_cells,
    number_cells,
)
from aqualvs.scanning.laser_bands import LaserBand, SearchAxis, sample_bands
from aqualvs.scanning.net_surfaces import has_strands_before, inflate_for_plane, seen_through
from aqualvs.scanning.plane_search import MIN_FACING, WEIGHT, X, Z
from aqualvs.scanning.posture import Refusal
from aqualvs.scanning.posture_estimator import Measurement
from aqualvs.scanning.segments import ComponentShapes, is_straight
from aqualvs.scanning.surfaces import Surface
from aqualvs.scanning.triangulate import Triangulator


class _AssignmentOptions(NamedTuple):
    """Evidence for and against an assignment, and surfaces that may be there by chance.

    The light of a surface is the confidence of its peaks, as a share of that of all peaks that no
    other surface explains. A stripe's visible share is that of its search lines in the picture that
    show it.
    """

    # Log-odds of a laser that is dark though it should be visible (7 %), of a false stripe as good
    # as the others (5 %), and of a third stripe that is on the plane of two by chance (13 %); odds
    # of 20 to 1 decide.
    dark_laser: float = 2.6
    foreign_stripe: float = 3.0
    third_stripe: float = 2.0
    decided: float = 3.0
    # Residuals of half stripes count as at most this many independent ones, because errors of the
    # rig are not noise. Then the limit of the evidence from residuals, in log-odds.
    max_freedom: float = 10.0
    max_by_residuals: float = 12.0
    # A surface with less than this share of the light, or a solid one whose best stripe has a
    # smaller visible share, must show its lasers evenly, as caustics and fish do not: at most this
    # share of the lasers may be faint. Tuned on rendered dives: planes through caustics have up to
    # 0.14 of the light, most below 0.1; nets come down to 0.15, folded ones to 0.14.
    small_share: float = 0.12
    short_visible: float = 0.15
    may_be_faint: float = 0.25
    # Least extent of the gappy stripes of a net that may hang in front of all of a target, as a
    # share of the search lines of something solid, or of a net's extent: fish have 0.5 at most.
    min_extent: float = 0.6
    # With more light than this as well, it need not show all lasers: a coarse net has few strands.
    wide_share: float = 0.2
    # Least visible share of the best stripe of a surface with so little light: 0.12 to 0.25 on
    # nets, 0.05 to 0.09 where strands in daylight make a plane by chance.
    min_visible: float = 0.1
    # Least share of the light of a surface if colour is no evidence: nets whose dashes lost their
    # chroma have 0.18 to 0.26.
    certain_share: float = 0.15
    # Least visible share of the best stripe of something solid without colour, or that noise or a
    # codec broke: walls have 0.66 and more, a plane through a net and what is behind it had 0.17.
    filled: float = 0.4
    # With less light than this, a surface is there by chance whatever else it shows: specks of a
    # fouled net that made a plane at a third of its range had 0.05, 1,100 nets and walls in
    # rendered dives 0.075 and more.
    least_share: float = 0.065
    # A net on which a laser is dark, with less than this share of the light, may be a single strand
    # along another laser's sheet, which then has more than this visible share. If a laser has
    # moved, the other two have more of the light.
    max_share_along: float = 0.3
    max_visible_along: float = 0.24
    # On a search line a laser lights something solid once, and through a net perhaps what is behind
    # it as well. With more light in other lines, as a share of the surface's own, the rig does not
    # name all lasers; up to `may_be_chance` lasers then make planes by chance. Complete rigs have
    # 0.05 at most (before nets 0.95), three of 15 real lasers 0.5 to 4. Of 87 postures by rigs that
    # name four or five of the 15, five were those of other lasers, all with four on the surface.
    max_other_lines: float = 0.5
    max_other_lines_of_net: float = 1.25
    may_be_chance: int = 4
    # Two lasers are alone on a solid target if the others have less than this share of the search
    # lines; a target is steep below this cosine of its tilt. Planes by exchanged lasers, as of a
    # floor close below the vehicle, are tilted by 44 to 61 degrees.
    two_alone: float = 0.1
    steep: float = 0.8
    # In a rig of two lasers that cross in the working range, walls beyond it make planes tilted by
    # 34 to 60 degrees. No light returns from beyond this many times the range.
    steep_of_two: float = 0.87
    max_lit: float = 3.0


_ODDS = _AssignmentOptions()
_FEW = 3  # Lasers of a fan that are not many: hardly more than one may have made a peak.


class Verdict(Enum):
    """Result of the test of a surface."""

    CLEAR = "clear"
    """No rival is about as good."""
    RIVAL = "rival"
    """Another plane explains the picture better."""
    NEAR = "near"
    """Another plane is about as good, and near: the posture's sigma must cover both."""
    AMBIGUOUS = "ambiguous"
    """Another plane is about as good, and far away."""


class AssignmentOutcome(NamedTuple):
    """The verdict, the other plane where there is one, and the log-odds of the better one."""

    verdict: Verdict
    other: Plane | None = None
    log_odds: float = math.inf


NOT_TESTED = AssignmentOutcome(Verdict.CLEAR)
"""The outcome if there is nothing to test, or no evidence against the surface."""


class AssignmentTest:
    """Tests surfaces of one rig against rival assignments.

    Its methods judge one surface, `target`, of a frame. `linked` are the frame's candidates with
    their `subsegments`, `surfaces` all surfaces found in it: light on the others is no evidence
    against the target.

    Parameters
    ----------
    laser_bands : sequence of LaserBand
        One for each laser.
    triangulator : Triangulator
        Of the same rig.
    searched : (float, float)
        Nearest and farthest plane that is considered, in metres.
    """

    def __init__(
        self,
        laser_bands: Sequence[LaserBand],
        triangulator: Triangulator,
        searched: tuple[float, float],
    ) -> None:
        self._searched = searched
        self._along_x = np.array([one.axis is SearchAxis.ALONG_X for one in laser_bands], np.bool_)
        self._bands = sample_bands(laser_bands, triangulator, CELL_LINES)
        self._sheets = [Plane(row[:3], float(row[3])) for row in triangulator.planes]
        rows = [_in_order(self._sheets, self._along_x, axis) for axis in (True, False)]
        self._rows = [row for row in rows if len(row) >= _FEW]
        self.fans = [row for row in rows if len(row) > _FEW]

    def is_by_chance(
        self, linked: LinkedCandidates, surfaces: Sequence[Surface], target: Surface
    ) -> bool:
        """Return whether a surface may be there by chance: small, or with lasers unevenly shown."""
        share = self._light_share(linked, surfaces, target)
        visible, faint, dark, _ = self._visibility(target, linked.subsegments)
        if target.is_mesh and dark > _ODDS.may_be_faint and visible > _ODDS.max_visible_along:
            return share < _ODDS.max_share_along
        # Planes by chance are steep, because there are more steep planes: those that caustics make
        # of this much light are tilted by 39 to 58 degrees, nets of random scenes by 26 at most.
        share *= float(target.plane.normal[1]) ** 2
        # Two lasers are on any plane that is found, so they show it evenly.
        least = _ODDS.small_share if len(self._along_x) == 2 else _ODDS.least_share
        if share < least or (share < _ODDS.small_share and visible < _ODDS.min_visible):
            return True
        # A fish in front of a wall that is out of range: neither is a target.
        outweighed = not target.is_mesh and any(
            one.inlier_weight > target.inlier_weight for one in surfaces
        )
        return (outweighed or _is_small(target, share, visible)) and faint > _ODDS.may_be_faint

    def is_certain(
        self, linked: LinkedCandidates, surfaces: Sequence[Surface], target: Surface
    ) -> bool:
        """Return whether a surface is there although colour does not tell.

        Three lasers show it evenly, and no net is in front: a wall's tallest peaks look like one.
        """
        subsegments = linked.subsegments
        for one in surfaces:
            is_wide = one.is_mesh and one.extent >= _ODDS.min_extent * target.extent
            if one is not target and is_wide and _is_nearer(one, target, subsegments):
                return False
        share = self._light_share(linked, surfaces, target)
        visible, faint, _, n_even = self._visibility(target, subsegments)
        few, least = 3, _ODDS.small_share if target.is_mesh else _ODDS.filled
        is_even = n_even >= few and faint <= _ODDS.may_be_faint
        return is_even and share >= _ODDS.certain_share and visible >= least

    def fills_lines(self, subsegments: Subsegments, surface: Surface) -> bool:
        """Return whether a surface shows as much of its best stripe as something solid.

        One laser may light a strand that lies along its sheet: the others must show as much as
        broken lines do.
        """
        mine, least_of_mean = surface.members, 0.75
        lines = np.bincount(subsegments.laser[mine], subsegments.n_lines[mine])
        mean_of_best = lines.sum() / (np.count_nonzero(lines) * lines.max())
        filled = self._visibility(surface, subsegments)[0] / _ODDS.filled
        return bool(filled >= 1.0 and filled * mean_of_best >= least_of_mean)

    def overlooked(
        self, linked: LinkedCandidates, surfaces: Sequence[Surface], target: Surface
    ) -> Surface | None:
        """Return a surface before the target that may be the net instead, if there is one.

        It has light that no other surface explains, all lasers show it, and its stripes are broken;
        a fish shows few lasers and long stripes, and specks on a plane by chance have little light.
        Of a target that looks like a net itself, it must hide parts. `is_mesh` of the surface
        returned is set if it has the pattern of a net, or if the target alternates with it along
        the stripes; otherwise it may still be a net.
        """
        subsegments = linked.subsegments
        # A net's shadows may break a wall's stripes finely.
        broken = target.is_mesh and not target.is_unbroken
        for one in surfaces:
            # Only gappy stripes have an extent, but not where a coarse net shows few strands.
            may_be_net = one.is_mesh or (one.extent > 0.0 and not broken)
            if one is target or not may_be_net or not _is_nearer(one, target, subsegments):
                continue
            if broken and one.extent < _ODDS.min_extent * target.extent:
                continue
            share = self._light_share(linked, surfaces, one)
            # As wide as the target, it may be a net one of whose strands lies along a sheet.
            is_wide = one.extent >= _ODDS.min_extent * target.n_lines
            visible, faint, _, _ = self._visibility(one, subsegments, along_strand=is_wide)
            is_uneven = faint > _ODDS.may_be_faint and not (is_wide and share > _ODDS.wide_share)
            if _is_small(one, share, visible) or is_uneven:
                continue
            is_mesh = one.is_mesh and not broken
            is_mesh = is_mesh or seen_through(one.members, target.members, subsegments)
            if (is_mesh or not broken) and not is_reflection(linked, one, target):
                return replace(one, is_mesh=is_mesh)
        return None

    def may_hide_net(
        self, linked: LinkedCandidates, surfaces: Sequence[Surface], target: Surface
    ) -> bool:
        """Return whether a net without a plane, all folds, may hang in front of a solid target.

        If another surface lies behind the target, it is not a wall behind a net.
        """
        if target.is_mesh or any(one.plane.offset > target.plane.offset for one in surfaces):
            return False
        candidates, subsegments, shapes = linked
        rows, n_lines = subsegments.of_candidate, shapes.n_lines
        share = loose_share_before(
            candidates,
            rows,
            n_lines,
            target.members,
            np.any([one.members for one in surfaces], axis=0),
            target.plane.packed(),
            self._searched[0],
        )
        # Rendered walls have up to 0.06 with faint lines on rough texture, 0.10 among fish, bubbles
        # and caustics; walls behind a folded net have 0.20 to 0.74.
        max_loose_share = 0.15
        if share > max_loose_share or not self.fans:
            return bool(share > max_loose_share)
        # One of many lasers places nearly all light at the target or behind it.
        return has_strands_before(candidates, rows, n_lines, target.members, target.plane)

    def other_lines(
        self,
        linked: LinkedCandidates,
        surfaces: Sequence[Surface],
        target: Surface,
        *,
        has_colour: bool,
    ) -> float | None:
        """Return the light in other lines beside a target's stripes, if it is too much.

        A rig that names only three lasers of 15 finds planes by chance among the stripes of all. A
        solid surface behind a net that shows as many lasers, at most twice as many, is no other
        line. Without colour, there may be less such light before a net.

        Returns
        -------
        float or None
            As a share of the target's own light. None if it is no evidence against the target.
        """
        subsegments, n_lasers = linked.subsegments, len(self._along_x)
        n_on_target = _n_lasers_on(target, subsegments)
        if n_on_target > _ODDS.may_be_chance:
            return None
        # Two lasers of many make planes by chance behind the target, too, and more of them meshes;
        # and a net shows at least half of the lasers that a wall behind it does.
        behind, few, half = np.zeros(subsegments.n, np.bool_), 3, 0.5
        for one in surfaces if target.is_mesh else ():
            if one.is_mesh or not _is_nearer(target, one, subsegments):
                continue
            n_behind = _n_lasers_on(one, subsegments)
            if max(n_on_target, few) <= n_behind and n_on_target >= half * n_behind:
                behind |= one.members
        share = other_lines_share(
            linked.candidates,
            subsegments.of_candidate,
            target.members,
            behind,
            linked.shapes,
            n_lasers,
        )
        of_net = target.is_mesh and has_colour
        most = _ODDS.max_other_lines_of_net if of_net else _ODDS.max_other_lines
        return share if share > most else None

    def may_be_exchanged(self, subsegments: Subsegments, target: Surface) -> bool:
        """Return whether a target may be two lasers' stripes, each read as the other's.

        Only a third laser decides (`exchanged_plane`). If it should be visible on the target and is
        not, the stripes may be those of a wall out of the working range, or, on a steep solid
        target, of a floor or a side wall nearer than that. Without a third laser the less steep
        plane is more likely.
        """
        n_lasers, facing = len(self._sheets), target.plane.normal[1]
        first, second, of_others = two_longest_stripes(subsegments, target.members, n_lasers)
        if of_others >= _ODDS.two_alone:
            return False
        other = exchanged_plane(target.plane, self._sheets[first], self._sheets[second])
        other_facing = -1.0 if other is None else other.normal[1]
        nearest, farthest = self._searched
        may_be_lit = other is not None and nearest <= other.offset <= _ODDS.max_lit * farthest
        may_be_lit = may_be_lit and other_facing >= MIN_FACING
        if n_lasers == 2:
            return bool(may_be_lit and facing < min(other_facing, _ODDS.steep_of_two))
        is_steep = not target.is_mesh and facing <= _ODDS.steep
        return bool(may_be_lit or is_steep) and self.is_faint(target, subsegments)

    def may_be_shifted(
        self, subsegments: Subsegments, surfaces: Sequence[Surface], target: Surface
    ) -> bool:
        """Return whether a target may be a wall out of the range, read as the next lasers' stripes.

        The wall is seen through a net, which shows as a mesh behind the target: with more lasers,
        though the target fills much of its stripes. Tuned on nets rendered for 5 and 8 lasers.
        """
        if not target.is_mesh:
            return False
        laser = subsegments.laser[target.members]
        if not any(self._beyond(target.plane, fan, laser) for fan in self.fans):
            return False
        visible, _, _, n_shown = self._visibility(target, subsegments)
        if visible < _ODDS.filled:
            return False
        behind = (one for one in surfaces if one.is_mesh and _is_nearer(target, one, subsegments))
        return any(self._visibility(one, subsegments)[3] > n_shown for one in behind)

    def beyond(self, subsegments: Subsegments, target: Surface) -> Plane | None:
        """Return a plane out of range whose stripes may have made the target, if there is one.

        The target lacks lasers that should be visible on it, among them the first or last of three
        or more in a row. Read as the next lasers', the stripes of the others are those of a surface
        so far away that one more stripe lies where it is not searched for.
        """
        if not self._rows or not self.is_faint(target, subsegments):
            return None
        laser = subsegments.laser[target.members]
        found = (self._beyond(target.plane, row, laser, lacks_last=True) for row in self._rows)
        return next((one for one in found if one is not None), None)

    def _beyond(
        self, plane: Plane, row: IntArray, laser: IntArray, *, lacks_last: bool = False
    ) -> Plane | None:
        """Return the plane out of range that stripes of a row show, read as the next lasers'.

        `lacks_last`: only if the last laser, which no stripe can be read from, is not on the plane.
        """
        # Lines of sight do not quite meet, so that the plane is known to a twentieth only.
        known = 0.95
        nearest, farthest = known * self._searched[1], _ODDS.max_lit * self._searched[1]
        for one_way in (row, row[::-1]):
            if lacks_last and one_way[-1] in laser:
                continue
            is_lit = np.isin(one_way[:-1], laser)
            sheets = [self._sheets[i] for i in one_way[:-1][is_lit]]
            read_as = [self._sheets[i] for i in one_way[1:][is_lit]]
            other = shifted_plane(plane, sheets, read_as) if len(sheets) > 1 else None
            if other is None:
                continue
            if nearest <= other.offset <= farthest and other.normal[1] >= MIN_FACING:
                return other
        return None

    def _light_share(
        self, linked: LinkedCandidates, surfaces: Sequence[Surface], surface: Surface
    ) -> float:
        """Return a surface's share of the light that no other surface explains."""
        candidates, subsegments, _ = linked
        others = np.zeros(subsegments.n, np.bool_)
        for one in surfaces:
            if one is not surface:
                others |= one.members
        return exclusive_share(
            candidates.source,
            candidates.confidence,
            subsegments,
            surface.members,
            others,
            surface.inlier_weight,
        )

    def is_faint(self, surface: Surface, subsegments: Subsegments) -> bool:
        """Return whether too many of the lasers that should show a surface are faint on it."""
        return self._visibility(surface, subsegments)[1] > _ODDS.may_be_faint

    def _visibility(
        self, surface: Surface, subsegments: Subsegments, *, along_strand: bool = False
    ) -> tuple[float, float, float, int]:
        """Return the `stripe_visibility` of a surface."""
        return stripe_visibility(
            surface.plane.packed(), surface.members, subsegments, self._bands, along_strand
        )

    def nearer_net(
        self, subsegments: Subsegments, surfaces: Sequence[Surface], target: Surface
    ) -> Surface | None:
        """Return a nearer net with as much light as a net that lacks a laser, if there is one.

        Two stripes determine a plane with one redundant number only. Two parts of a folded net may
        fit that by chance, while the third laser, which should be visible there, lights the net
        elsewhere. Other light behind a net is normal; light in front of it is not.
        """
        if not target.is_mesh:
            return None
        for one in surfaces:
            if one is target or not one.is_mesh or one.sampling_weight < target.sampling_weight:
                continue
            if _is_nearer(one, target, subsegments):
                return one if self.is_faint(target, subsegments) else None
        return None

    def test(self, linked: LinkedCandidates, target: Surface) -> AssignmentOutcome:
        """Test a surface against rival assignments of its peaks."""
        (candidates, subsegments, _), n_lasers = linked, len(self._along_x)
        if n_lasers < 2:
            return NOT_TESTED
        n_rivals = 6  # Number of rivals that are refined.
        planes = np.empty((n_rivals + 1, 4))
        measures = np.empty((n_rivals + 1, N_MEASURES))
        planes[0] = target.plane.packed()
        n = find_rivals(
            candidates,
            subsegments.of_candidate,
            subsegments.table,
            target.members,
            *self._searched,
            n_lasers,
            planes,
        )
        if n == 0:
            return NOT_TESTED
        judge_planes(planes[: n + 1], candidates, subsegments, self._along_x, self._bands, measures)
        return _verdict(planes[: n + 1], measures[: n + 1])


def _is_small(surface: Surface, share: float, visible: float) -> bool:
    """Return whether a surface has a small share of the light, or, if no mesh, short stripes."""
    return share < _ODDS.small_share or (not surface.is_mesh and visible < _ODDS.short_visible)


def _n_lasers_on(surface: Surface, subsegments: Subsegments) -> int:
    return int(np.count_nonzero(np.bincount(subsegments.laser[surface.members])))


def _is_nearer(one: Surface, target: Surface, subsegments: Subsegments) -> bool:
    """Return whether most of a surface's light lies in front of another surface's plane."""
    sampling_weight, plane = subsegments.table[WEIGHT], target.plane
    near = plane.normal @ subsegments.table[X : Z + 1] < plane.offset
    return bool(
        sampling_weight[one.members & near].sum() > 0.5 * sampling_weight[one.members].sum()
    )


def _in_order(sheets: Sequence[Plane], along_x: BoolArray, axis: bool) -> IntArray:
    """Return the lasers of one search axis as they follow each other 1 m ahead of the dome."""
    across = 0 if axis else 2
    place = [(one.offset - one.normal[1]) / (one.normal[across] or 1.0) for one in sheets]
    mine = np.flatnonzero(along_x == axis)
    return mine[np.argsort(np.array(place)[mine], kind="stable")]


@lazy_kernel
def other_lines_share(
    candidates: Candidates,
    of_candidate: IntArray,
    members: BoolArray,
    behind: BoolArray,
    shapes: ComponentShapes,
    n_lasers: int,
) -> float:
    """Return the light in other lines on the search lines of a surface, over the surface's light.

    Other lines are long straight components of a laser, on the search lines of its stripe on the
    surface, neither on the surface nor in the place of its light: a slanting stripe makes peaks in
    both search directions.

    Parameters
    ----------
    candidates : Candidates
        N of them.
    of_candidate : int array, shape (N,)
        Row of each one's subsegment.
    members, behind : bool array, shape (C,)
        Subsegments on the surface, and on those behind it whose peaks do not count.
    shapes : ComponentShapes
        Of the candidates' components.
    n_lasers : int
        Lasers of the rig.
    """
    source, laser, line = candidates.source, candidates.laser, candidates.line
    own = np.zeros(n_bins(source), np.bool_)
    lit = np.zeros((n_lasers, n_bins(line)), np.bool_)
    of_surface, others = 0.0, 0.0
    for i in range(source.shape[0]):
        c = of_candidate[i]
        own[source[i]] |= members[c] or behind[c]
        if members[c]:
            lit[laser[i], line[i]] = True
            of_surface += candidates.confidence[i]
    cells = number_cells(candidates.pixels)
    stripes, cell = lit_cells(cells, members[of_candidate]), cells.of_candidate
    for i in range(source.shape[0]):
        is_other = lit[laser[i], line[i]] and not own[source[i]] and not stripes[cell[i]]
        if is_other and is_straight(shapes, candidates.component[i]):
            others += candidates.confidence[i]
    return others / max(of_surface, 1e-12)


def is_reflection(linked: LinkedCandidates, one: Surface, other: Surface) -> bool:
    """Return whether a surface may be a double reflection of another one, which is brighter.

    Panes and domes reflect a little light twice, which shows every stripe once more beside itself.
    Anything in front of a surface hides from a laser what is behind it: a net with many lit search
    lines leaves many dark ones there, a double reflection leaves none.

    Parameters
    ----------
    linked : LinkedCandidates
        Of a frame.
    one, other : Surface
        Found in it.
    """
    # Least share of the search lines on which the other surface is lit as well, and brighter: on
    # walls behind 450 nets, of three lasers and of fans, it is 0.91 at most. Then the least number
    # of search lines, as a share of the other surface's: fewer leave too few in a shadow.
    min_lit_again, min_lines = 0.95, 0.2
    if one.n_lines < min_lines * other.n_lines:
        return False
    candidates, subsegments, _ = linked
    share = _brighter_share(candidates, subsegments.of_candidate, one.members, other.members)
    return bool(share >= min_lit_again)


@lazy_kernel
def _brighter_share(
    candidates: Candidates, of_candidate: IntArray, members: BoolArray, others: BoolArray
) -> float:
    """Return the share of a surface's search lines on which another surface is brighter.

    `members` and `others`, shape (C,), are the subsegments on the two. Peaks on both do not count.
    """
    source, laser, line = candidates.source, candidates.laser, candidates.line
    own = np.zeros(n_bins(source), np.bool_)
    for i in range(source.shape[0]):
        own[source[i]] |= members[of_candidate[i]]
    height = np.zeros((2, n_bins(laser), n_bins(line)))
    for i in range(source.shape[0]):
        c = of_candidate[i]
        if members[c] or (others[c] and not own[source[i]]):
            k = 0 if members[c] else 1
            height[k, laser[i], line[i]] = max(height[k, laser[i], line[i]], candidates.height[i])
    lit, brighter = 0, 0
    for k in range(height.shape[1]):
        for j in range(height.shape[2]):
            lit += height[0, k, j] > 0.0
            brighter += height[1, k, j] > height[0, k, j] > 0.0
    return brighter / max(lit, 1)


def inflate_for_rival(found: Measurement, outcome: AssignmentOutcome) -> Measurement:
    """Return a measurement with its covariance inflated by a near rival.

    Parameters
    ----------
    found : Measurement
        Of the surface that was tested.
    outcome : AssignmentOutcome
        Of the test.
    """
    posture, other = found.posture, outcome.other
    if outcome.verdict is not Verdict.NEAR or other is None or isinstance(posture, Refusal):
        return found
    share = 1.0 / (1.0 + math.exp(outcome.log_odds))
    return replace(found, posture=inflate_for_plane(posture, other, share))


def _verdict(planes: FloatArray, measures: FloatArray) -> AssignmentOutcome:
    """Compare the surface, the first plane, with its rivals, and these with each other."""
    best = 0
    for k in range(1, len(planes)):
        if _log_odds(measures[best], measures[k]) < 0.0:
            best = k
    # The best one of those that differ from it.
    others = [k for k in range(len(planes)) if not _alike(planes[best], planes[k])]
    all_odds = ((_log_odds(measures[best], measures[k]), k) for k in others)
    odds, second = min(all_odds, default=(math.inf, -1))
    kept = _alike(planes[best], planes[0])
    # Limits of range (as a share) and angle within which a larger sigma covers both hypotheses;
    # farther apart, the posture is refused.
    near_range, near_angle = 0.02, math.radians(2.0)
    if odds < _ODDS.decided:
        other = _plane(planes[second] if kept else planes[best])
        if not _alike(planes[best], planes[second], near_range, near_angle):
            return AssignmentOutcome(Verdict.AMBIGUOUS, other, odds)
        if kept:
            return AssignmentOutcome(Verdict.NEAR, other, odds)
    return NOT_TESTED if kept else AssignmentOutcome(Verdict.RIVAL, _plane(planes[best]), odds)


def _plane(packed: FloatArray) -> Plane:
    return Plane(packed[:3].copy(), float(packed[3]))


def _log_odds(one: FloatArray, other: FloatArray) -> float:
    """Return the log-odds of one hypothesis against another."""
    # The difference in light, in stripes of the hypothesis that explains more.
    more = one if one[INTENSITY_WEIGHT] > other[INTENSITY_WEIGHT] else other
    foreign = (one[INTENSITY_WEIGHT] - other[INTENSITY_WEIGHT]) / max(more[PER_LASER], 1e-9)
    dark = _ODDS.dark_laser * (other[DARK] - one[DARK])
    # Two stripes share a plane with any assignment, a third one only by chance.
    third = _ODDS.third_stripe * (float(_n_lit(one) > 2) - float(_n_lit(other) > 2))
    freedom = min(one[FREEDOM], other[FREEDOM], _ODDS.max_freedom)
    residuals = 0.5 * freedom * math.log(other[VARIANCE] / one[VARIANCE]) if freedom > 0.0 else 0.0
    return float(
        _ODDS.foreign_stripe * foreign
        + dark
        + third
        + min(max(residuals, -_ODDS.max_by_residuals), _ODDS.max_by_residuals)
    )


def _n_lit(measures: FloatArray) -> int:
    """Return the number of lasers with a stripe on a hypothesis."""
    return round(float(measures[INTENSITY_WEIGHT] / max(measures[PER_LASER], 1e-9)))


def _alike(
    one: FloatArray, other: FloatArray, share: float = SAME_RANGE, angle: float = SAME_ANGLE
) -> bool:
    cosine = float(one[:3] @ other[:3])
    return bool(abs(one[3] / other[3] - 1.0) < share and cosine > math.cos(angle))
