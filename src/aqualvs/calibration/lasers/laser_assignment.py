"""Assignment of stripe points to lasers when all lasers shine at once.

The points lie on known surfaces. On each surface a laser plane draws a straight line; lines on
different surfaces together determine planes and number of lasers (`candidates`). Each candidate
plane is judged by its evidence and against the better planes: laser, no laser, or undecided
(`judged`). `assign_lasers` then assigns every point to the plane it lies in.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np

from aqualvs.calibration.lasers.candidates import (
    LineTable,
    PlaneCandidate,
    StripeLine,
    find_candidates,
    fitted_plane,
    lines_on_patch,
    ordered_candidates,
    plane_residuals_px,
)
from aqualvs.calibration.lasers.stripes_on_planes import PooledStripes
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Plane


class _AssignmentOptions(NamedTuple):
    """Evidence that a plane is a laser's, and limits of its stripes in pixels."""

    # False discovery rate of planes that are accepted as lasers (Benjamini & Hochberg 1995,
    # doi:10.1111/j.2517-6161.1995.tb02031.x); least number of points of a laser.
    false_share: float = 1e-3
    min_points: int = 40
    # Share of points or surfaces that must agree.
    most: float = 0.8
    # Distance from the stripe of a second laser within which its light biases a point's centre.
    crossing_px: float = 9.0
    n_fits: int = 5


_SURE = _AssignmentOptions()


class PlaneVerdict(Enum):
    """Verdict on a plane of light."""

    LASER = "laser"
    WEAK = "plane of little evidence"
    DOUBTFUL = "plane that something speaks against"
    TORN = "perhaps part of another laser"
    OTHER = "no laser of its own"


@dataclass(frozen=True, slots=True, eq=False)
class JudgedPlane:
    """Plane of light with the verdict on it."""

    candidate: PlaneCandidate
    patches: tuple[int, ...]  # Surfaces of views that it is seen on.
    verdict: PlaneVerdict
    why: str = ""  # In words, the reason why it is no laser or may be none; empty for lasers.


def judged(
    table: LineTable, candidates: Sequence[PlaneCandidate], lens_in_dome: FloatArray
) -> list[JudgedPlane]:
    """Judge planes by their evidence, and by each other; return them by verdict and evidence.

    `candidates`: the best first. `lens_in_dome`, shape (3,): the lens's projection centre.
    """
    pooled = table.pooled
    # The best planes within the allowed false discovery rate.
    alarms = np.sort([c.log_false_alarms for c in candidates])
    allowed = _SURE.false_share * np.arange(1, len(alarms) + 1)
    n_sure = int(np.flatnonzero(np.exp(alarms) <= allowed).max(initial=-1)) + 1
    stay = _stay_in_picture(pooled, candidates, lens_in_dome)
    # Planes with light on the target are judged before those beside it.
    beside = [float(np.mean(pooled.on_target[c.members])) < 1.0 - _SURE.most for c in candidates]
    seen: list[JudgedPlane] = []
    for i in sorted(range(len(candidates)), key=lambda i: (beside[i], i)):
        fault = _fault(pooled, candidates[i], seen)
        if stay[i]:
            fault = PlaneVerdict.OTHER, "it stays in one place of the picture, near or far"
        if fault is None and i >= n_sure:
            fault = PlaneVerdict.WEAK, "too few stripes lie in it to distinguish it from chance"
        verdict, why = fault or (PlaneVerdict.LASER, "")
        patches = tuple(np.unique(pooled.patch[candidates[i].members]).tolist())
        seen.append(JudgedPlane(candidates[i], patches, verdict, why))
    ranks = list(PlaneVerdict)
    return sorted(seen, key=lambda j: (ranks.index(j.verdict), j.candidate.log_false_alarms))


def _fault(
    pooled: PooledStripes, candidate: PlaneCandidate, seen: Sequence[JudgedPlane]
) -> tuple[PlaneVerdict, str] | None:
    """Return the reason against a plane as a laser of its own, or None."""
    members = candidate.members
    if len(members) < _SURE.min_points:
        return PlaneVerdict.OTHER, f"it has {len(members)} points only"
    if _is_fixed(pooled, members):
        return PlaneVerdict.DOUBTFUL, (
            "its stripe stays in one place of the target, as print or an edge would; move the "
            "camera sideways, or turn it, between pictures"
        )
    for other in seen:
        if other.verdict is not PlaneVerdict.OTHER:
            fault = _same_light(pooled, members, other)
            if fault is not None:
                return fault
    best = min(
        (other.candidate.residual_px for other in seen if other.verdict is PlaneVerdict.LASER),
        default=np.inf,
    )
    # Ratio of a plane's residual to the best laser's from which its light lies on something else;
    # errors of the poses make a tenth of a pixel for every stripe.
    poorer, min_residual_px = 5.0, 0.1
    if candidate.residual_px > poorer * max(best, min_residual_px):
        return PlaneVerdict.DOUBTFUL, (
            f"its stripes miss a plane by {candidate.residual_px:.1f} px, those of another laser "
            f"by {best:.1f} px; they may lie on something else than the target"
        )
    return None


def _same_light(
    pooled: PooledStripes, members: IntArray, other: JudgedPlane
) -> tuple[PlaneVerdict, str] | None:
    """Return the reason why a plane's stripes may be of another plane's laser, or None."""
    mine = set(pooled.patch[members].tolist())
    shared = mine & set(other.patches)
    away = plane_residuals_px(pooled.placed, [other.candidate.plane])[members, 0]
    distance = float(np.median(np.abs(away)))
    # Distance from another laser's stripe, in pixels, within which light is its halo; on other
    # surfaces, where that laser is not seen, it may be the same laser on a board that is not flat.
    halo_px, torn_px = 6.0, 15.0
    if distance <= halo_px and shared:
        return PlaneVerdict.OTHER, "it is the halo of another stripe"
    if distance <= torn_px and len(shared) <= (1.0 - _SURE.most) * len(mine):
        return PlaneVerdict.TORN, (
            f"it is {distance:.0f} px away from a laser that is seen in other pictures"
        )
    goes_on = sum(_goes_on(pooled, members, other.candidate.members, patch) for patch in shared)
    if len(shared) >= 2 and goes_on >= _SURE.most * len(mine):
        return (
            PlaneVerdict.OTHER,
            "it begins where another stripe ends, as that laser's light does on ",
        )
    return None


def _goes_on(pooled: PooledStripes, members: IntArray, others: IntArray, patch: int) -> bool:
    """Return whether a stripe continues another one of the surface beyond its ends."""
    points = pooled.placed.points_in_dome
    mine = points[members[pooled.patch[members] == patch]]
    theirs = points[others[pooled.patch[others] == patch]]
    middle, direction = theirs.mean(axis=0), _direction(theirs)
    # Largest overlap, as a share of their length, of two stripes of one laser that continues from
    # the target to a surface behind or before it; stripes of two lasers overlap for most of their
    # length. Least cosine between such stripes.
    little, alike = 0.15, 0.8
    if abs(float(direction @ _direction(mine))) < alike:
        return False
    first, last = np.quantile((theirs - middle) @ direction, [0.02, 0.98])
    way = (mine - middle) @ direction
    return float(np.mean((way >= first) & (way <= last))) <= little


def _direction(points: FloatArray) -> FloatArray:
    """Return the unit vector along points (N, 3) of a line."""
    offsets = points - points.mean(axis=0)
    direction: FloatArray = np.linalg.svd(offsets, full_matrices=False)[2][0]
    return direction


def _stay_in_picture(
    pooled: PooledStripes, candidates: Sequence[PlaneCandidate], lens_in_dome: FloatArray
) -> BoolArray:
    """Mark planes (C,) whose stripe stays in one place of the picture, near or far.

    It does so if it is a scratch, an overlaid text, or the background of a camera that stands
    still; then many edges stay, and some of them together lie in a plane near the lens.
    """
    # Distance to the lens, in metres, within which no plane is a laser's.
    min_baseline = 2e-3
    # Ratios of the residuals from a plane through the lens to those from a stripe's own plane: of
    # edges that stay, as many as in a background, and from which stripes move before one. In
    # photographs of a chessboard before a still camera, groups of edges reach 4.3; lasers 24 to 47
    # mm from the lens have 7 and more, or 2 if uneven boards stand at hardly differing distances.
    stays, background, moves = 1.2, 3, 5.0
    near = np.zeros(len(candidates), np.bool_)
    own_px, fixed_px = np.zeros((2, len(candidates)))
    for i, candidate in enumerate(candidates):
        members, plane = candidate.members, candidate.plane
        near[i] = abs(float(plane.signed_distance(lens_in_dome))) < min_baseline
        fixed = fitted_plane(pooled.placed, members, plane, through=lens_in_dome)
        away = np.abs(plane_residuals_px(pooled.placed, [plane, fixed])[members])
        own_px[i], fixed_px[i] = np.median(away, axis=0)
    if np.count_nonzero(near | (fixed_px < stays * own_px)) < background:
        return near
    return near | (fixed_px < moves * own_px)


def _is_fixed(pooled: PooledStripes, members: IntArray) -> bool:
    """Return whether the points stay on one line of each surface of the target in all views."""
    worst, several = 0.0, False
    for surface in np.unique(pooled.placed.surface[members]):
        mine = members[pooled.placed.surface[members] == surface]
        views = np.unique(pooled.view[mine])
        if len(views) < 2:
            continue
        several = True
        points = pooled.points_in_target[mine]
        size = np.linalg.norm(pooled.placed.by_across[mine], axis=1)
        middle = np.array([points[pooled.view[mine] == v].mean(axis=0) for v in views])
        offsets = points - middle.mean(axis=0)
        across = np.linalg.svd(offsets, full_matrices=False)[2][1]
        by_view = [offsets[pooled.view[mine] == v] @ across for v in views]
        sizes = [float(np.median(size[pooled.view[mine] == v])) for v in views]
        rms = [np.sqrt(np.mean(d**2)) / px for d, px in zip(by_view, sizes, strict=True)]
        worst = max(worst, float(np.sqrt(np.mean(np.square(rms)))))
    # A stripe that stays in one place of the target to within this, in pixels, may be printed
    # there.
    fixed_px = 1.5
    return several and worst <= fixed_px


TOLERANCE_PX = 3.0
"""Greatest distance of a stripe from its plane; errors of poses add to the noise of stripes."""
BENT_TOLERANCE_PX = 10.0
"""The same for light that may be refracted at a window, so that no plane fits well."""
# Greatest expected number of accidents of a plane that is needed for the given number of lasers,
# and greatest length of a stripe in no plane as a multiple of its own: tuned on 24 simulated scenes
# of one picture of a box with glints. Greatest expected number of accidents of an undecided plane.
_TOLD = float(np.log(0.2))
_LONGER = 1.5
_HARDLY_AN_ACCIDENT = float(np.log(0.05))


@dataclass(frozen=True, slots=True)
class LaserAssignment:
    """Points sorted by laser."""

    planes: tuple[Plane, ...]  # Rough planes of the lasers, the one with the best evidence first.
    # Shape (N,): index into `planes`; -1 for points of none, or near the crossing of two stripes.
    laser: IntArray
    # Long stripes that belong to none of the planes, the longest first.
    unmatched: tuple[StripeLine, ...]
    # Further planes of light that are not accepted as lasers; undecided ones first.
    spare: tuple[JudgedPlane, ...] = ()

    @property
    def undecided(self) -> tuple[JudgedPlane, ...]:
        """Further planes that are hardly accidents and may be lasers."""
        return self._undecided(_HARDLY_AN_ACCIDENT)

    @property
    def possible(self) -> tuple[JudgedPlane, ...]:
        """Further planes that may be lasers if more are known to shine."""
        return self._undecided(_TOLD)

    def _undecided(self, most: float) -> tuple[JudgedPlane, ...]:
        return tuple(
            plane
            for plane in self.spare
            if plane.verdict is not PlaneVerdict.OTHER and plane.candidate.log_false_alarms <= most
        )

    @property
    def torn(self) -> bool:
        """True if a laser appears as several planes, as on a board that is not flat."""
        return any(plane.verdict is PlaneVerdict.TORN for plane in self.spare)


def assign_lasers(
    pooled: PooledStripes,
    lens_in_dome: FloatArray,
    *,
    n_lasers: int | None = None,
    tolerance_px: float = TOLERANCE_PX,
) -> LaserAssignment:
    """Assign stripe points to the laser planes that they lie in.

    Parameters
    ----------
    pooled : PooledStripes
        Points of all views.
    lens_in_dome : array, shape (3,)
        The lens's projection centre; a plane through it is no laser.
    n_lasers : int, optional
        Number of lasers that shine; by default all planes with clear evidence.
    tolerance_px : float
        Greatest distance of a stripe from its plane.

    Returns
    -------
    LaserAssignment
        All planes with clear evidence, even more than `n_lasers`. If there are fewer, also the best
        undecided ones, if they are clearly better than the other undecided ones.
    """
    lines = _all_lines(pooled)
    table = LineTable.of(pooled, lines, tolerance_px)
    found = judged(table, find_candidates(table), lens_in_dome)
    taken = [plane for plane in found if plane.verdict is PlaneVerdict.LASER]
    if n_lasers is not None and len(taken) < n_lasers:
        ordered = judged(table, ordered_candidates(table, n_lasers), lens_in_dome)
        if ordered and all(plane.verdict is PlaneVerdict.LASER for plane in ordered):
            found = taken = ordered
    in_planes = {int(i) for plane in found for i in plane.candidate.lines}
    lonely = [len(line.members) for i, line in enumerate(lines) if i not in in_planes]
    longest = max(lonely, default=0)
    # Planes that can be lasers if more are known to shine: not if a much longer stripe is in no
    # plane, as that may be the laser then, seen on one surface only.
    perhaps = [
        plane
        for plane in found
        if plane.verdict in (PlaneVerdict.WEAK, PlaneVerdict.DOUBTFUL)
        and plane.candidate.log_false_alarms <= _TOLD
        and longest <= _LONGER * max(len(lines[int(i)].members) for i in plane.candidate.lines)
    ]
    missing = 0 if n_lasers is None else max(n_lasers - len(taken), 0)
    if 0 < missing <= len(perhaps):
        best, rest = perhaps[:missing], perhaps[missing:]
        if not any(_as_good(plane, best[-1]) for plane in rest):
            taken += best
    planes = _refined(pooled, [plane.candidate.plane for plane in taken], tolerance_px)
    laser = assigned(pooled, planes, tolerance_px)
    spare = tuple(plane for plane in found if plane not in taken)
    # Lines with hardly any point assigned to a laser.
    unmatched = [
        line
        for line in lines
        if len(line.members) >= _SURE.min_points and np.mean(laser[line.members] >= 0) < 0.2
    ]
    unmatched.sort(key=lambda line: -len(line.members))
    return LaserAssignment(tuple(planes), laser, tuple(unmatched), spare)


def _as_good(plane: JudgedPlane, other: JudgedPlane) -> bool:
    """Return whether a plane's evidence is nearly as good as that of a better one."""
    worse = plane.candidate.log_false_alarms - other.candidate.log_false_alarms
    # Difference of log false alarms from which a plane is clearly worse.
    clearly_worse = 3.0
    return plane.verdict is other.verdict and worse < clearly_worse


def _all_lines(pooled: PooledStripes) -> list[StripeLine]:
    # Number of points of each point's chain on its surface.
    key = pooled.patch * (int(pooled.chain.max(initial=-1)) + 1) + pooled.chain
    _, place, counts = np.unique(key, return_inverse=True, return_counts=True)
    n_of_chain = counts[place]
    # Least share of its chains that a straight stripe holds; with less it is a chord of a curve.
    min_of_chain = 0.25
    lines = []
    for patch in range(len(pooled.patch_planes)):
        for line in lines_on_patch(pooled, np.flatnonzero(pooled.patch == patch), patch):
            chains, at = np.unique(pooled.chain[line.members], return_inverse=True)
            mine = np.bincount(at, minlength=len(chains))[at]
            if np.mean(mine / n_of_chain[line.members]) >= min_of_chain:
                lines.append(line)
    return lines


def _refined(pooled: PooledStripes, planes: list[Plane], tolerance_px: float) -> list[Plane]:
    """Fit planes to all points near them and near no other."""
    for _ in range(_SURE.n_fits):
        laser = assigned(pooled, planes, tolerance_px)
        planes = [
            fitted_plane(pooled.placed, np.flatnonzero(laser == i), plane)
            if np.count_nonzero(laser == i) >= _SURE.min_points
            else plane
            for i, plane in enumerate(planes)
        ]
    return planes


def assigned(
    pooled: PooledStripes, planes: Sequence[Plane], tolerance_px: float = TOLERANCE_PX
) -> IntArray:
    """Return the index of each point's plane (N,); -1 for none, or where stripes cross."""
    n = len(pooled.patch)
    if not planes:
        return np.full(n, -1)
    residuals = np.abs(plane_residuals_px(pooled.placed, planes))
    nearest = np.argmin(residuals, axis=1)
    clear = residuals[np.arange(n), nearest] <= tolerance_px
    # Distances (N, L) of points from the planes' cuts with their surface.
    placed, normals = pooled.placed, np.array([p.normal for p in planes])
    offsets = np.array([p.offset for p in planes])
    gain = np.hypot(placed.by_across @ normals.T, placed.by_along @ normals.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        crossed_px = np.abs(placed.points_in_dome @ normals.T - offsets) / gain
    # NaN compares false.
    clear &= np.count_nonzero(crossed_px <= _SURE.crossing_px, axis=1) <= 1
    return np.where(clear, nearest, -1)
