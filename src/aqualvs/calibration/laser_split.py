"""Which stripe points belong to which laser, when all lasers shine at once.

Points on known surfaces fall apart into laser planes in space. On each surface a laser plane draws
a straight line; lines on different surfaces tell which planes there are, and how many lasers.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.calibration.laser_candidates import (
    find_candidates,
    fitted_plane,
    plane_residuals_px,
)
from aqualvs.calibration.laser_verdicts import JudgedPlane, Verdict, judged
from aqualvs.calibration.stripe_lines import StripeLine, lines_on_patch
from aqualvs.calibration.stripes_on_planes import PlacedStripes, PooledStripes
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.planes import Plane

TOLERANCE_PX = 3.0
"""A stripe this near to a plane may be the plane's; poses add to the noise of stripes."""
BENT_TOLERANCE_PX = 10.0
"""Likewise where the light may be bent at a window, so that no plane fits well."""
# Points this near to the stripe of a second laser have its light in their centre.
_CROSSING_PX = 9.0
_LEAST_POINTS = 40
_N_FITS = 5
# A straight stripe holds this share of the chains that it is cut from, or is a chord of a curve.
_LEAST_OF_CHAIN = 0.25
# Accidents are so many times as likely (natural logarithm) to make a plane that is clearly worse.
_CLEARLY_WORSE = 3.0
# Accidents that a plane which is asked for may be expected to be, at most, and how many times as
# long as its own a stripe in no plane may be: tuned on 24 simulated scenes of one picture of a box
# with glints. Accidents that a plane which has to be asked about may be expected to be.
_TOLD = float(np.log(0.2))
_LONGER = 1.5
_HARDLY_AN_ACCIDENT = float(np.log(0.05))


@dataclass(frozen=True, slots=True)
class LaserSplit:
    """Points sorted by laser.

    Attributes
    ----------
    planes : tuple of Plane
        Rough planes of the lasers, the one with the best evidence first.
    laser : int array, shape (N,)
        Index into `planes`; -1 for points of none, or near where two stripes cross.
    unmatched : tuple of StripeLine
        Long stripes that belong to none of the planes, the longest first.
    spare : tuple of JudgedPlane
        Further planes of light, which are not taken for lasers; undecided ones first.
    """

    planes: tuple[Plane, ...]
    laser: IntArray
    unmatched: tuple[StripeLine, ...]
    spare: tuple[JudgedPlane, ...] = ()

    @property
    def undecided(self) -> tuple[JudgedPlane, ...]:
        """Planes that accidents hardly make, and that may be lasers nevertheless."""
        return self._undecided(_HARDLY_AN_ACCIDENT)

    @property
    def possible(self) -> tuple[JudgedPlane, ...]:
        """Planes that may be lasers if there must be more of them."""
        return self._undecided(_TOLD)

    def _undecided(self, most: float) -> tuple[JudgedPlane, ...]:
        return tuple(
            plane
            for plane in self.spare
            if plane.verdict is not Verdict.OTHER and plane.candidate.log_false_alarms <= most
        )

    @property
    def torn(self) -> bool:
        """Whether a laser seems to lie in several planes, as on a board that is not flat."""
        return any(plane.verdict is Verdict.TORN for plane in self.spare)


def split_lasers(
    pooled: PooledStripes,
    lens_in_dome: FloatArray,
    *,
    n_lasers: int | None = None,
    tolerance_px: float = TOLERANCE_PX,
) -> LaserSplit:
    """Sort stripe points by the laser plane that they lie in.

    Parameters
    ----------
    pooled : PooledStripes
        Points of all views.
    lens_in_dome : array, shape (3,)
        The lens's projection centre; a plane through it is no laser.
    n_lasers : int, optional
        How many lasers shine; if left out, all planes of which the evidence is clear.
    tolerance_px : float
        How far a stripe may be from its plane.

    Returns
    -------
    LaserSplit
        All planes that are clear, be there more than `n_lasers`. Where there are fewer, the best
        undecided ones, if they are clearly better than the rest of those.
    """
    lines = _all_lines(pooled)
    found = judged(pooled, lines, find_candidates(pooled, lines, tolerance_px), lens_in_dome)
    taken = [plane for plane in found if plane.verdict is Verdict.LASER]
    in_planes = {int(i) for plane in found for i in plane.candidate.lines}
    lonely = [len(line.members) for i, line in enumerate(lines) if i not in in_planes]
    longest = max(lonely, default=0)
    perhaps = [plane for plane in found if _may_be_laser(plane, lines, longest)]
    missing = 0 if n_lasers is None else max(n_lasers - len(taken), 0)
    if 0 < missing <= len(perhaps):
        best, rest = perhaps[:missing], perhaps[missing:]
        if not any(_as_good(plane, best[-1]) for plane in rest):
            taken += best
    planes = _refined(pooled, [plane.candidate.plane for plane in taken], tolerance_px)
    laser = assigned(pooled, planes, tolerance_px)
    spare = tuple(plane for plane in found if plane not in taken)
    return LaserSplit(tuple(planes), laser, _unmatched(lines, laser), spare)


def _may_be_laser(plane: JudgedPlane, lines: Sequence[StripeLine], longest: int) -> bool:
    """Return whether a plane can be a laser if there are known to be more of them.

    Not if a much longer stripe, of `longest` points, is in no plane: then that may be the laser,
    seen on one surface only.
    """
    perhaps = plane.verdict in (Verdict.WEAK, Verdict.DOUBTFUL)
    own = max(len(lines[int(i)].members) for i in plane.candidate.lines)
    return perhaps and plane.candidate.log_false_alarms <= _TOLD and longest <= _LONGER * own


def _as_good(plane: JudgedPlane, other: JudgedPlane) -> bool:
    """Return whether a plane is nearly as good as another that is a little better."""
    worse = plane.candidate.log_false_alarms - other.candidate.log_false_alarms
    return plane.verdict is other.verdict and worse < _CLEARLY_WORSE


def _all_lines(pooled: PooledStripes) -> list[StripeLine]:
    lines = []
    n_of_chain = _counts_on_patch(pooled)
    for patch in range(len(pooled.patch_planes)):
        members = np.flatnonzero(pooled.patch == patch)
        lines += [
            line
            for line in lines_on_patch(pooled, members, patch)
            if _share_of_chains(pooled, line, n_of_chain) >= _LEAST_OF_CHAIN
        ]
    return lines


def _counts_on_patch(pooled: PooledStripes) -> IntArray:
    """Return how many points (N,) of its own chain lie on a point's surface."""
    n_chains = int(pooled.chain.max(initial=-1)) + 1
    _, place, counts = np.unique(
        pooled.patch * n_chains + pooled.chain, return_inverse=True, return_counts=True
    )
    n_of_chain: IntArray = counts[place]
    return n_of_chain


def _share_of_chains(pooled: PooledStripes, line: StripeLine, n_of_chain: IntArray) -> float:
    """Return which share of its chains' points a line holds, the mean over its points."""
    chains, place = np.unique(pooled.chain[line.members], return_inverse=True)
    mine = np.bincount(place, minlength=len(chains))[place]
    return float(np.mean(mine / n_of_chain[line.members]))


def _refined(pooled: PooledStripes, planes: list[Plane], tolerance_px: float) -> list[Plane]:
    """Fit planes to all points near them and near no other."""
    for _ in range(_N_FITS):
        laser = assigned(pooled, planes, tolerance_px)
        planes = [
            fitted_plane(pooled.placed, np.flatnonzero(laser == i), plane)
            if np.count_nonzero(laser == i) >= _LEAST_POINTS
            else plane
            for i, plane in enumerate(planes)
        ]
    return planes


def assigned(
    pooled: PooledStripes, planes: Sequence[Plane], tolerance_px: float = TOLERANCE_PX
) -> IntArray:
    """Return which plane each point (N,) belongs to; -1 for none, or where stripes cross."""
    n = len(pooled.patch)
    if not planes:
        return np.full(n, -1)
    residuals = np.abs(plane_residuals_px(pooled.placed, planes))
    nearest = np.argmin(residuals, axis=1)
    clear = residuals[np.arange(n), nearest] <= tolerance_px
    clear &= np.count_nonzero(_crossed_px(pooled.placed, planes) <= _CROSSING_PX, axis=1) <= 1
    laser: IntArray = np.where(clear, nearest, -1)
    return laser


def _crossed_px(placed: PlacedStripes, planes: Sequence[Plane]) -> FloatArray:
    """Return how far points are from where planes cut their surface, in pixels, (N, L)."""
    normals = np.array([p.normal for p in planes])
    offsets = np.array([p.offset for p in planes])
    gain = np.hypot(placed.by_across @ normals.T, placed.by_along @ normals.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance: FloatArray = np.abs(placed.points_in_dome @ normals.T - offsets) / gain
    return np.nan_to_num(distance, nan=np.inf)


def _unmatched(lines: Sequence[StripeLine], laser: IntArray) -> tuple[StripeLine, ...]:
    """Return lines of which hardly a point was given to a laser."""
    free = [
        line
        for line in lines
        if len(line.members) >= _LEAST_POINTS and np.mean(laser[line.members] >= 0) < 0.2
    ]
    return tuple(sorted(free, key=lambda line: -len(line.members)))
