"""Laser assignment test: a surface against rival assignments of the same peaks to lasers.

Where lasers are nearly parallel, a picture in which every stripe is read as its neighbour's may
show a plane as well: shifted and tilted, with small residuals. The rivals of a surface are found by
reading the peaks of two of its stripes as other lasers', which gives a plane, and refining that
plane on all peaks. Each hypothesis is then judged by

- the light that it explains: peaks of the same appearance that are left over count against it;
- the light that it lacks: a laser whose stripe would lie in the picture, beside others that are
  seen, and shows nothing. It may be switched off or hidden, so this is a cost, not a gate;
- the residuals of each laser's stripe as a whole: the log-likelihood ratio of two fits with unknown
  noise is half the degrees of freedom times the logarithm of the ratio of the variances.

The order of the stripes needs no rule of its own: on a plane in front of camera and emitter a fan's
stripes appear in the order of its lasers, and only such planes are considered.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from enum import Enum
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.compiled import lazy_kernel
from aqualvs.geometry.linear_algebra import n_bins
from aqualvs.geometry.planes import Plane
from aqualvs.scanning.assignment_kernels import (
    CELL_LINES,
    DARK,
    FREEDOM,
    INTENSITY_WEIGHT,
    N_FACTS,
    PER_LASER,
    SAME_ANGLE,
    SAME_RANGE,
    VARIANCE,
    exclusive_share,
    find_rivals,
    judge_planes,
    loose_share_before,
    seen_of,
)
from aqualvs.scanning.candidates import Candidates, Subsegments
from aqualvs.scanning.laser_bands import LaserBand, SearchAxis
from aqualvs.scanning.net_surfaces import inflate_covariance, seen_through
from aqualvs.scanning.plane_search import WEIGHT, X, Z
from aqualvs.scanning.posture import Refusal, range_pitch_yaw
from aqualvs.scanning.posture_estimator import Measurement
from aqualvs.scanning.segments import ComponentShapes, is_straight
from aqualvs.scanning.surfaces import Surface
from aqualvs.scanning.triangulate import Triangulator


class _AssignmentOptions(NamedTuple):
    """Evidence for and against an assignment."""

    # Log-odds of a laser that shows nothing though it should (7 %), and of a false stripe as good
    # as the others (5 %); odds of 20 to 1 decide.
    dark_laser: float = 2.6
    foreign_stripe: float = 3.0
    decided: float = 3.0
    # Residuals of half stripes count as at most this many independent ones, because errors of the
    # rig are not noise. Then the limit of the evidence from residuals.
    max_freedom: float = 10.0
    max_by_residuals: float = 12.0
    # A surface with less than this share of the light that no other explains, or a solid one whose
    # stripes are nowhere seen over this share of their way through the picture, must be seen
    # evenly: caustics and fish are not. This share of the lasers may be faint. Found on rendered
    # dives: planes through caustics have up to 0.14 of the light, most below 0.1; nets come down to
    # 0.15, folded ones to 0.14.
    small_share: float = 0.12
    short_way: float = 0.15
    may_be_faint: float = 0.25
    # With so little light, stripes must be seen over this share of their way at least: 0.12 to 0.25
    # on nets, 0.05 to 0.09 where strands in daylight make a plane by chance.
    least_way: float = 0.1
    # A net with less than this share of the light, on which a laser is dark, may not show another
    # one over more than this share of its way: that is a strand along its sheet. Where a laser has
    # moved, the other two have more of the light.
    most_share: float = 0.3
    along_way: float = 0.24
    # On a search line a laser lights something solid once, and through a net perhaps what is behind
    # it as well. With more light in other lines than these shares of the surface's, the rig does
    # not name all lasers, and up to this many of them make planes by chance. Complete rigs have
    # 0.05 at most (before nets 0.95), three of 15 real lasers 0.5 to 4. Of 87 postures by rigs that
    # name four or five of the 15, five were those of other lasers, all with four on the surface.
    max_other_lines: float = 0.5
    max_other_lines_of_net: float = 1.25
    may_be_chance: int = 4


_ODDS = _AssignmentOptions()


class Verdict(Enum):
    """Result of the test of a surface."""

    CLEAR = "clear"
    """No rival comes near it."""
    RIVAL = "rival"
    """Another plane explains the picture better."""
    NEAR = "near"
    """Another plane is as good, and near: the posture's sigma must cover both."""
    AMBIGUOUS = "ambiguous"
    """Another plane is as good, and far off."""


class AssignmentOutcome(NamedTuple):
    """The verdict, the other plane where there is one, and the log-odds of the better one."""

    verdict: Verdict
    other: Plane | None = None
    log_odds: float = math.inf


NOT_TESTED = AssignmentOutcome(Verdict.CLEAR)
"""The outcome if there is nothing to test, or no evidence against the surface."""


class AssignmentTest:
    """Tests surfaces of one rig against rival assignments.

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
        self._bands = _sample_bands(laser_bands, triangulator)

    def is_by_chance(
        self,
        candidates: Candidates,
        subsegments: Subsegments,
        surfaces: Sequence[Surface],
        target: Surface,
    ) -> bool:
        """Return whether a surface is so small, and seen so unevenly, that it may be chance.

        Parameters
        ----------
        candidates, subsegments
            As in `test`.
        surfaces : sequence of Surface
            All that were found: light on the others does not speak against this one.
        target : Surface
            The one to judge.
        """
        share = self._light_share(candidates, subsegments, surfaces, target)
        way, faint, dark = self._seen_of(target, subsegments)
        if target.is_mesh and dark > _ODDS.may_be_faint and way > _ODDS.along_way:
            return share < _ODDS.most_share
        # Planes by chance are steep, because there are more of those: the ones that caustics make
        # of this much light are tilted by 39 to 58 degrees, nets of random scenes by 26 at most.
        share *= float(target.plane.normal[1]) ** 2
        if share < _ODDS.small_share and way < _ODDS.least_way:
            return True
        # A fish before a wall that is out of range: the wall is no target, and the fish is none.
        outweighed = not target.is_mesh and any(
            one.inlier_weight > target.inlier_weight for one in surfaces
        )
        return (outweighed or _is_small(target, share, way)) and faint > _ODDS.may_be_faint

    def overlooked(
        self,
        candidates: Candidates,
        subsegments: Subsegments,
        surfaces: Sequence[Surface],
        target: Surface,
    ) -> Surface | None:
        """Return a surface before something solid that may be a net, if there is one.

        It has light that no other surface explains, all lasers show it, and its stripes are broken:
        a fish shows few lasers and long stripes, and specks that share a plane by chance have
        little light.

        Parameters
        ----------
        candidates, subsegments, surfaces
            As in `is_by_chance`.
        target : Surface
            The one that was chosen.

        Returns
        -------
        Surface or None
            A net if it has the pattern of one, or if the target alternates with it along the
            stripes. A surface that is no mesh may be one all the same.
        """
        if target.is_mesh and not target.is_unbroken:
            return None
        for one in surfaces:
            # Only broken stripes have an extent.
            if one is target or one.extent <= 0.0 or not _is_nearer(one, target, subsegments):
                continue
            share = self._light_share(candidates, subsegments, surfaces, one)
            way, faint, _ = self._seen_of(one, subsegments)
            if _is_small(one, share, way) or faint > _ODDS.may_be_faint:
                continue
            is_net = one.is_mesh or seen_through(one.members, target.members, subsegments)
            return replace(one, is_mesh=is_net)
        return None

    def may_hide_net(
        self,
        candidates: Candidates,
        subsegments: Subsegments,
        shapes: ComponentShapes,
        surfaces: Sequence[Surface],
        target: Surface,
    ) -> bool:
        """Return whether a net that makes no plane, all folds, may hang before something solid.

        Its light lies loose before the target, in short pieces. Where something is seen behind the
        target, that is no wall behind a net.

        Parameters
        ----------
        candidates, subsegments, surfaces, target
            As in `is_by_chance`.
        shapes : ComponentShapes
            Of the candidates' components.
        """
        if target.is_mesh or any(one.plane.offset > target.plane.offset for one in surfaces):
            return False
        share = loose_share_before(
            candidates,
            subsegments.of_candidate,
            shapes.n_lines,
            target.members,
            np.any([one.members for one in surfaces], axis=0),
            np.append(target.plane.normal, target.plane.offset),
            self._searched[0],
        )
        # With more loose light before it, over its own, something solid may be seen through a net
        # that makes no plane. On rendered walls this share is 0.01 at most, on real ones with 15
        # lasers, whose lines noise nearly hides, 0.09; walls that were taken for the folded net
        # before them have 0.21 to 0.83, half of them 0.32 and more.
        max_loose_share = 0.25
        return bool(share > max_loose_share)

    def other_lines(
        self,
        candidates: Candidates,
        subsegments: Subsegments,
        shapes: ComponentShapes,
        target: Surface,
    ) -> float | None:
        """Return the light in other lines beside a target's stripes, if it makes them doubtful.

        A rig that names three lasers of 15 finds planes by chance among the stripes of all.

        Parameters
        ----------
        candidates, subsegments, shapes, target
            As in `may_hide_net`.

        Returns
        -------
        float or None
            As a share of the target's own light. None where the target is not in doubt.
        """
        n_lasers = len(self._along_x)
        n_on_target = np.count_nonzero(np.bincount(subsegments.laser[target.members]))
        if n_on_target > _ODDS.may_be_chance:
            return None
        on_target = target.members[subsegments.of_candidate]
        share: float = other_lines_share(candidates, on_target, shapes, n_lasers)
        most = _ODDS.max_other_lines_of_net if target.is_mesh else _ODDS.max_other_lines
        return share if share > most else None

    def _light_share(
        self,
        candidates: Candidates,
        subsegments: Subsegments,
        surfaces: Sequence[Surface],
        surface: Surface,
    ) -> float:
        """Return a surface's share of the light that no other surface explains."""
        others = np.zeros(subsegments.n, np.bool_)
        for one in surfaces:
            if one is not surface:
                others |= one.members
        # A plane needs two lasers: the surplus of one is no evidence for it.
        share: float = exclusive_share(
            candidates.source,
            candidates.confidence,
            subsegments,
            surface.members,
            others,
            surface.inlier_weight,
        )
        return share

    def _is_faint(self, surface: Surface, subsegments: Subsegments) -> bool:
        """Return whether a laser that should be seen on a surface is faint there, or missing."""
        return self._seen_of(surface, subsegments)[1] > _ODDS.may_be_faint

    def _seen_of(self, surface: Surface, subsegments: Subsegments) -> tuple[float, float, float]:
        """Return the share of its best stripe that a surface shows, and of faint, dark lasers."""
        packed = np.empty(4)
        packed[:3], packed[3] = surface.plane.normal, surface.plane.offset
        seen: tuple[float, float, float] = seen_of(
            packed, surface.members, subsegments, self._bands
        )
        return seen

    def nearer_net(
        self, subsegments: Subsegments, surfaces: Sequence[Surface], target: Surface
    ) -> Surface | None:
        """Return a nearer net with as much light as a net that lacks a laser, if there is one.

        Two stripes test a plane by one number. Of the many pieces of a folded net two may pass that
        test without being a plane, while the third laser, which should be seen there, lights the
        net elsewhere. Other light behind a net is normal; light nearer than the net is not.

        Parameters
        ----------
        subsegments : Subsegments
            C of them.
        surfaces : sequence of Surface
            All that were found.
        target : Surface
            The one to judge.
        """
        if not target.is_mesh:
            return None
        for one in surfaces:
            rivals = (
                one is not target and one.is_mesh and one.sampling_weight >= target.sampling_weight
            )
            if rivals and _is_nearer(one, target, subsegments):
                return one if self._is_faint(target, subsegments) else None
        return None

    def test(
        self, candidates: Candidates, subsegments: Subsegments, surface: Surface
    ) -> AssignmentOutcome:
        """Test a surface.

        Parameters
        ----------
        candidates : Candidates
            N of them.
        subsegments : Subsegments
            C of them.
        surface : Surface
            The one to test.
        """
        n_lasers = len(self._along_x)
        if n_lasers < 2:
            return NOT_TESTED
        # Number of rivals that are refined.
        n_rivals = 6
        planes = np.empty((n_rivals + 1, 4))
        facts = np.empty((n_rivals + 1, N_FACTS))
        planes[0, :3], planes[0, 3] = surface.plane.normal, surface.plane.offset
        n = find_rivals(
            candidates,
            subsegments.of_candidate,
            subsegments.table,
            surface.members,
            *self._searched,
            n_lasers,
            planes,
        )
        if n == 0:
            return NOT_TESTED
        judge_planes(planes[: n + 1], candidates, subsegments, self._along_x, self._bands, facts)
        return _verdict(planes[: n + 1], facts[: n + 1])


def _is_small(surface: Surface, share: float, way: float) -> bool:
    """Return whether a surface has little light of its own, or, if no mesh, short stripes."""
    return share < _ODDS.small_share or (not surface.is_mesh and way < _ODDS.short_way)


def _is_nearer(one: Surface, target: Surface, subsegments: Subsegments) -> bool:
    """Return whether most of a surface's light lies before another surface's plane."""
    sampling_weight, plane = subsegments.table[WEIGHT], target.plane
    near = plane.normal @ subsegments.table[X : Z + 1] < plane.offset
    return bool(
        sampling_weight[one.members & near].sum() > 0.5 * sampling_weight[one.members].sum()
    )


@lazy_kernel
def other_lines_share(
    candidates: Candidates, on_target: BoolArray, shapes: ComponentShapes, n_lasers: int
) -> float:
    """Return the light in other long lines on the search lines of a surface, over the surface's.

    Straight lines that no laser makes on the surface are counted where a laser's stripe is on it.

    Parameters
    ----------
    candidates : Candidates
        N of them.
    on_target : bool array, shape (N,)
        Candidates on the surface.
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
        if on_target[i]:
            own[source[i]] = True
            lit[laser[i], line[i]] = True
            of_surface += candidates.confidence[i]
    for i in range(source.shape[0]):
        is_other = lit[laser[i], line[i]] and not own[source[i]]
        if is_other and is_straight(shapes, candidates.component[i]):
            others += candidates.confidence[i]
    return others / max(of_surface, 1e-12)


def inflate_for_rival(found: Measurement, outcome: AssignmentOutcome) -> Measurement:
    """Return a measurement with its covariance widened by a near rival.

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
    distance, pitch, yaw = range_pitch_yaw(other.normal / other.offset)
    rival = replace(posture, range=distance, pitch=pitch, yaw=yaw)
    share = 1.0 / (1.0 + math.exp(outcome.log_odds))
    return replace(found, posture=inflate_covariance(posture, rival, share))


def _verdict(planes: FloatArray, facts: FloatArray) -> AssignmentOutcome:
    """Compare the surface, the first plane, with its rivals, and those with each other."""
    best = 0
    for k in range(1, len(planes)):
        if _log_odds(facts[best], facts[k]) < 0.0:
            best = k
    # The nearest rival of the best one.
    second, odds = -1, math.inf
    for k in range(len(planes)):
        one = _log_odds(facts[best], facts[k]) if not _alike(planes[best], planes[k]) else math.inf
        if one < odds:
            second, odds = k, one
    kept = _alike(planes[best], planes[0])
    # Hypotheses nearer to each other than this are covered by a larger sigma instead of a refusal.
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
    # What the other leaves over are stripes of the one that explains more light.
    more = one if one[INTENSITY_WEIGHT] > other[INTENSITY_WEIGHT] else other
    foreign = (one[INTENSITY_WEIGHT] - other[INTENSITY_WEIGHT]) / max(more[PER_LASER], 1e-9)
    dark = _ODDS.dark_laser * (other[DARK] - one[DARK])
    freedom = min(one[FREEDOM], other[FREEDOM], _ODDS.max_freedom)
    residuals = 0.0
    if freedom > 0.0:
        residuals = 0.5 * freedom * math.log(other[VARIANCE] / one[VARIANCE])
    return float(
        _ODDS.foreign_stripe * foreign
        + dark
        + min(max(residuals, -_ODDS.max_by_residuals), _ODDS.max_by_residuals)
    )


def _alike(
    one: FloatArray, other: FloatArray, share: float = SAME_RANGE, angle: float = SAME_ANGLE
) -> bool:
    cosine = float(one[:3] @ other[:3])
    return bool(abs(one[3] / other[3] - 1.0) < share and cosine > math.cos(angle))


def _sample_bands(laser_bands: Sequence[LaserBand], triangulator: Triangulator) -> FloatArray:
    """Sample the points that each laser's band sees: (n_lasers, cells, samples, 4).

    A point P is kept as (P, 1) / |P|: with it (m·X - 1) / |X| changes nearly evenly across a band.
    NaN where nothing is seen.
    """
    n_cells = max((len(one.lowest) for one in laser_bands), default=0) // CELL_LINES + 1
    # Samples across a laser's band, in which its stripe on a plane is looked up.
    n_samples = 16
    bands = np.full((len(laser_bands), n_cells, n_samples, 4), np.nan)
    for i, band in enumerate(laser_bands):
        lines = np.arange(CELL_LINES // 2, len(band.lowest), CELL_LINES)
        lines = lines[band.lowest[lines] <= band.highest[lines]]
        if not len(lines):
            continue
        places = np.linspace(band.lowest[lines], band.highest[lines], n_samples, axis=1)
        middle = (lines + 0.5)[:, None] * band.line_px - 0.5 + band.shift_px
        across = np.broadcast_to(middle, places.shape)
        along_x = band.axis is SearchAxis.ALONG_X
        pixels = np.stack([places, across] if along_x else [across, places], axis=-1)
        n = places.size
        found = triangulator.triangulate(
            np.ascontiguousarray(pixels.reshape(n, 2)), np.full(n, int(along_x)), np.full(n, i)
        )
        points = found.points_in_dome
        share = 1.0 / np.linalg.norm(points, axis=1)
        packed = np.column_stack([points * share[:, None], share])
        packed[~found.valid] = np.nan
        bands[i, lines // CELL_LINES] = packed.reshape(*places.shape, 4)
    return bands
