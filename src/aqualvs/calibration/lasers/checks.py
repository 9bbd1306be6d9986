"""Result of `calibrate lasers`, its checks, and the assignment of planes to the lasers of the rig.

The result has lasers, poses, residuals and findings (`SolvedLasers`). The checks refuse targets,
poses, distances and numbers of lasers that no calibration can be made from, with the remedy. Planes
are matched to the rig's lasers by direction and distance; lasers that the rig does not have are
named after the direction of their stripe.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from aqualvs.calibration.lasers.laser_assignment import JudgedPlane, LaserAssignment, PlaneVerdict
from aqualvs.calibration.lasers.problem import LaserProblem, LaserState, distances_of
from aqualvs.calibration.lasers.stripes_on_planes import TargetSurfaces, way_along
from aqualvs.calibration.lasers.views import LaserView, PlacedView, pose_difference
from aqualvs.calibration.solver.bundle import CORNER_SIGMA_PX
from aqualvs.calibration.solver.initial_pose import target_pose
from aqualvs.calibration.solver.least_squares import Solution
from aqualvs.calibration.solver.result import rms_px
from aqualvs.calibration.targets.targets import View
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.rig import Laser, Rig, RigUncertainty


@dataclass(frozen=True, slots=True)
class LaserFigures:
    """Figures of one calibrated laser."""

    laser: Laser  # As solved.
    # Standard deviation of the normal's direction, along the worst axis, in radians.
    sigma_normal: float
    # Standard deviation of the offset, in metres.
    sigma_offset: float
    # Root mean square distance of stripe points, by bins, from the sheet: in pixels across the
    # stripe, and in metres.
    rms_px: float
    rms: float
    # Stripe points used.
    n_points: int
    # Surfaces that the laser was seen on.
    surfaces: tuple[str, ...]
    # By the paper's method (Eq. 33-36), for comparison: poses by distances in space, then the
    # pseudo-inverse.
    paper_plane: Plane
    # In words, the chosen model of the sheet and the reason.
    sheet: str


@dataclass(frozen=True, slots=True)
class ViewFigures:
    """Figures of one picture of the calibration."""

    name: str  # File name.
    dome_from_target: SE3  # Pose by corners and stripes together.
    # Of the inliers; NaN if there are none.
    rms_corners_px: float
    rms_stripes_px: float
    # Corners found, and stripe points on surfaces.
    n_corners: int
    n_stripe_points: int
    # Difference from the pose by the paper's cost (Eq. 32-33), in radians, and in metres at the
    # middle of the corners.
    pose_angle: float
    pose_shift: float
    corners: View  # Measured corners.
    corner_residuals_px: FloatArray  # Shape (N, 2).
    # Shape (N,): inlier corners.
    corner_inliers: BoolArray


@dataclass(frozen=True, slots=True)
class LaserCalibration:
    """Result of a calibration of lasers."""

    rig: Rig  # With the lasers, and the camera's numbers if they were refined.
    # Joint, of all numbers that were uncertain before and of the lasers.
    uncertainty: RigUncertainty
    # In the order of `rig.lasers`.
    lasers: tuple[LaserFigures, ...]
    # Pictures that were used.
    views: tuple[ViewFigures, ...]
    # Names of the others, with the reason.
    left_out: dict[str, str]
    # Warnings for the user, in words.
    warnings: tuple[str, ...]
    # Whether the camera's numbers were solved too.
    refined: bool


@dataclass(frozen=True, slots=True)
class SolvedLasers:
    """A solved problem with its parts."""

    problem: LaserProblem
    solution: Solution[LaserState]
    views: tuple[PlacedView, ...]

    @property
    def state(self) -> LaserState:
        """The solution."""
        return self.solution.state

    def stripe_residuals_px(self, i_group: int) -> tuple[FloatArray, BoolArray]:
        """Return a group's residuals (B,) in pixels, and the mask of inliers."""
        group = self.problem.groups[i_group]
        residuals = self.solution.blocks[i_group].residuals[:, 0]
        return residuals * group.sigma_px, self.solution.inliers[i_group]

    def groups_of(self, *, laser: int | None = None, view: int | None = None) -> list[int]:
        """Return the groups of a laser, or of a view."""
        return [
            i
            for i, group in enumerate(self.problem.groups)
            if (laser is None or group.laser == laser) and (view is None or group.view == view)
        ]


def laser_figures(
    solved: SolvedLasers,
    covariance: FloatArray,
    i_laser: int,
    laser: Laser,
    paper: Plane,
    words: str,
) -> LaserFigures:
    """Return the figures of a laser; `paper` and `words` become its `paper_plane` and `sheet`.

    `covariance` (3, 3): of its plane.
    """
    mine = solved.groups_of(laser=i_laser)
    residuals, inside, weights, metres = _stripes(solved, mine)
    on = sorted({int(s) for i in mine for s in solved.problem.groups[i].surface})
    return LaserFigures(
        laser=laser,
        sigma_normal=float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])),
        sigma_offset=float(np.sqrt(covariance[2, 2])),
        rms_px=_rms(residuals[inside], weights[inside]),
        rms=_rms(metres[inside], weights[inside]),
        n_points=int(weights.sum()),
        surfaces=tuple(solved.problem.surfaces.names[i] for i in on),
        paper_plane=paper,
        sheet=words,
    )


def _stripes(
    solved: SolvedLasers, groups: Sequence[int]
) -> tuple[FloatArray, BoolArray, IntArray, FloatArray]:
    """Return residuals (px), inlier mask, counts and distances (m) of groups' bins."""
    parts = [(np.zeros(0), np.zeros(0, np.bool_), np.zeros(0, np.int64), np.zeros(0))]
    for i in groups:
        group = solved.problem.groups[i]
        metres = distances_of(solved.problem, solved.state, group)
        parts.append((*solved.stripe_residuals_px(i), group.counts, metres))
    residuals, inside, weights, metres = map(np.concatenate, zip(*parts, strict=True))
    return residuals, inside, weights, metres


def _rms(values: FloatArray, weights: IntArray) -> float:
    if not len(values):
        return float("nan")
    return float(np.sqrt(np.average(values**2, weights=weights)))


def view_figures(solved: SolvedLasers, i_view: int, view: PlacedView) -> ViewFigures:
    """Return the figures of a picture."""
    n_groups = len(solved.problem.groups)
    block = solved.solution.blocks[n_groups + i_view]
    inside = solved.solution.inliers[n_groups + i_view]
    corners = block.residuals * CORNER_SIGMA_PX
    residuals, believed, weights, _ = _stripes(solved, solved.groups_of(view=i_view))
    pose = solved.state.bundle.poses[i_view]
    angle, shift = pose_difference(pose, view.spatial, view.view.middle)
    return ViewFigures(
        name=view.view.name,
        dome_from_target=pose,
        rms_corners_px=rms_px(corners[inside]),
        rms_stripes_px=_rms(residuals[believed], weights[believed]),
        n_corners=len(view.view) + view.n_corners_rejected,
        n_stripe_points=len(view.placed),
        pose_angle=angle,
        pose_shift=shift,
        corners=view.view,
        corner_residuals_px=corners,
        corner_inliers=inside,
    )


def match_to_rig(rig: Rig, planes: Sequence[Plane]) -> list[int | None]:
    """Return the index of the nearest plane for every laser of the rig, each plane used once.

    None for lasers that are left over where there are fewer planes.
    """
    costs = np.array([[_apart(laser.plane, plane) for plane in planes] for laser in rig.lasers])
    pairs = zip(*linear_sum_assignment(costs), strict=True) if costs.size else ()
    matched = {int(i_laser): int(i_plane) for i_laser, i_plane in pairs}
    return [matched.get(i) for i in range(len(rig.lasers))]


def far_apart(laser: Laser, plane: Plane) -> bool:
    """Return whether a plane is too far from the rig's laser to be surely the same."""
    return _apart(laser.plane, plane) > 1.0


def named(planes: Sequence[Plane]) -> tuple[list[int], list[Laser]]:
    """Name lasers after the directions of their stripes, or number them.

    A single plane near level is `horizontal`, near upright `vertical`, between them `diagonal`;
    if two would have one name, all are numbered from the left.

    Returns
    -------
    order : list of int
        Index into `planes` of every laser.
    lasers : list of Laser
    """
    words = [_word(plane) for plane in planes]
    if len(set(words)) == len(words):
        order = sorted(range(len(planes)), key=lambda i: _WORDS.index(words[i]))
        return order, [Laser(words[i], positive(planes[i])) for i in order]
    order = sorted(range(len(planes)), key=lambda i: _place(planes[i]))
    return order, [Laser(f"laser_{k + 1}", positive(planes[i])) for k, i in enumerate(order)]


def positive(plane: Plane) -> Plane:
    """Return the plane with the largest component of its normal positive."""
    if plane.normal[int(np.argmax(np.abs(plane.normal)))] < 0.0:
        return Plane(-plane.normal, -plane.offset)
    return plane


def like(plane: Plane, other: Plane) -> Plane:
    """Return the plane with its normal on the same side as another's."""
    if plane.normal @ other.normal < 0.0:
        return Plane(-plane.normal, -plane.offset)
    return plane


_WORDS = ("horizontal", "vertical", "diagonal")


def _word(plane: Plane) -> str:
    # Cosine between a sheet's normal and an axis of `dome` from which stripes are level or upright.
    along_axis = 0.9
    if abs(plane.normal[2]) > along_axis:
        return _WORDS[0]
    return _WORDS[1] if abs(plane.normal[0]) > along_axis else _WORDS[2]


def _place(plane: Plane) -> float:
    """Return where the plane crosses the view half a metre ahead, from the left or the top."""
    ahead = plane.offset - 0.5 * plane.normal[1]
    if abs(plane.normal[0]) >= abs(plane.normal[2]):
        return float(ahead / plane.normal[0])
    return float(-ahead / plane.normal[2]) + 1e3


def _apart(a: Plane, b: Plane) -> float:
    b = like(b, a)
    sine = float(np.linalg.norm(np.cross(a.normal, b.normal)))
    cosine = float(a.normal @ b.normal)
    # Scales of the distance between planes: lasers are remounted within half a radian and 0.1 m.
    far_angle, far_offset = 0.5, 0.1
    angle = float(np.arctan2(sine, cosine)) / far_angle
    return float(np.hypot(angle, (a.offset - b.offset) / far_offset))


def check_size(views: Sequence[LaserView]) -> None:
    """Raise `CalibrationError` for targets whose size indicates a wrong unit."""
    points = [v.view.points for v in views if len(v.view)]
    if not points:
        return
    everything = np.concatenate(points)
    size = float(np.max(everything.max(axis=0) - everything.min(axis=0)))
    # Sizes of targets, in metres, beyond which their lengths must be in another unit.
    smallest, largest = 0.02, 10.0
    if not smallest <= size <= largest:
        raise CalibrationError(
            f"the target's points span {size * 1e3:.4g} mm; lengths in its file are millimetres: "
            "check them against the print"
        )


def check_poses(views: Sequence[PlacedView]) -> None:
    """Raise `CalibrationError` if corners contradict the rig, the medium or the target's file."""
    misses = float(np.median([view.rms_px for view in views]))
    # Larger than any error of detection, in pixels.
    impossible_px = 2.0
    if misses > impossible_px:
        raise CalibrationError(
            f"corners miss by {misses:.1f} px (rms, median of {len(views)} pictures); the rig, the "
            "medium (air or water?) or the target's file is wrong"
        )


def check_medium(views: Sequence[PlacedView], rig: Rig, seen_rig: Rig) -> None:
    """Raise `CalibrationError` if corners fit the other medium, air or the rig's water, far better.

    Views were placed in the stated medium, in which `seen_rig` is.
    """
    if rig.housing is None:
        return
    stated = seen_rig.n_water
    other = max(rig.n_air, rig.n_water, key=lambda n: abs(n - stated))
    camera = rig.in_water(other).camera()
    there = []
    for view in views:
        try:
            there.append(target_pose(camera, view.view).rms_px)
        except CalibrationError:
            there.append(np.inf)
    misses = float(np.median([view.rms_px for view in views]))
    # Ratio of the corners' residuals from which the other medium is the right one; through a lens
    # at the dome's centre it is 1, and the medium does not matter.
    far_better = 2.0
    if misses > far_better * float(np.median(there)):
        word = "air" if other == rig.n_air else "water"
        raise CalibrationError(
            f"the pictures fit n = {other:.4f} far better than the stated {stated:.4f}: corners "
            f"miss by {np.median(there):.2g} instead of {misses:.2g} px (rms, median of "
            f"{len(views)} pictures); were they taken in {word}? Give --medium {word}"
        )


def check_distances(views: Sequence[PlacedView], rig: Rig) -> None:
    """Raise `CalibrationError` if no stripes are on the target, or at distances of a wrong unit."""
    if not any(len(view.placed) for view in views):
        raise CalibrationError(
            f"{views[0].view.name}: no stripe lies on the target's surfaces; switch the lasers on, "
            "let them shine on it, and give the --wavelength-nm of their colour"
        )
    points = np.concatenate([view.placed.points_in_dome for view in views])
    distance = float(np.median(np.linalg.norm(points, axis=1)))
    near, far = rig.working_range
    # Multiple of the working range beyond which stripes are refused.
    nearer, farther = 0.2, 5.0
    if not nearer * near <= distance <= farther * far:
        raise CalibrationError(
            f"stripes lie {distance * 1e3:.4g} mm away, but the rig works from {near * 1e3:.4g} "
            f"to {far * 1e3:.4g} mm; check the units of the target's file and of the rig"
        )


def check_count(
    split: LaserAssignment,
    expected: int | None,
    rig: Rig,
    views: Sequence[PlacedView],
    surfaces: TargetSurfaces,
) -> list[str]:
    """Refuse fewer or more lasers than expected, or an undecided number; warn of uncertain ones.

    Raises `CalibrationError` if there are fewer, more, or none, or if the pictures do not decide
    whether planes of light are lasers.
    """
    found = len(split.planes)
    # By patch.
    places = [f"{view.view.name}, plane '{name}'" for view in views for name in surfaces.names]
    wanted = "on two places of the board that differ"
    remedy = "add pictures with the board nearer, farther or tilted another way"
    if len(surfaces.planes) > 1:
        wanted = "on two planes of the box"
        remedy = "add pictures in which every stripe crosses from one plane to another"
    if found < (expected or 1):
        raise CalibrationError(f"{_too_few(split, expected, rig, places, wanted)}{remedy}")
    if expected is not None and found > expected:
        raise CalibrationError(
            f"more lasers are seen than {expected}: {found} planes of light explain the stripes; "
            "correct the number of lasers, or cover what reflects them"
        )
    if expected is None and split.undecided:
        several = "another plane" if len(split.undecided) == 1 else "further planes"
        raise CalibrationError(
            f"{found} {'laser is' if found == 1 else 'lasers are'} certain, but {several} of light "
            "may also be from lasers: "
            f"{_planes(split.undecided, places)}; give their number (--lasers N), or {remedy}"
        )
    return _other_light(split, places, len(views))


def _other_light(split: LaserAssignment, places: Sequence[str], n_views: int) -> list[str]:
    """Return warnings of planes of light and stripes that are not taken for lasers."""
    named_planes = [
        plane
        for plane in split.spare
        if plane.verdict is PlaneVerdict.OTHER or plane in split.undecided
    ]
    words = [
        f"a plane of light ({_plane(plane, places)}) is not taken for a laser: {plane.why}"
        for plane in named_planes
    ]
    # Their stripes need no further remark; those of other planes do.
    taken = [line for plane in named_planes for line in plane.candidate.members.tolist()]
    counts = np.bincount(split.laser[split.laser >= 0], minlength=len(split.planes))
    # Share of the weakest laser's points in a picture from which a further stripe is reported.
    as_strong = 0.5
    unmatched = [
        line
        for line in split.unmatched
        # The lasers' counts are over all pictures, a line is in one.
        if len(line.members) >= as_strong * counts.min() / n_views
        and not np.isin(line.members, taken).any()
    ]
    if unmatched:
        longest = max(unmatched, key=lambda line: len(line.members))
        alone = len(unmatched) == 1
        rest = "belongs" if alone else f"and {len(unmatched) - 1} shorter ones belong"
        words.append(
            f"a stripe of {len(longest.members)} points "
            f"({places[longest.patch]}) {rest} to no laser; "
            f"perhaps {'a reflection' if alone else 'reflections'}"
        )
    return words


def _planes(planes: Sequence[JudgedPlane], places: Sequence[str]) -> str:
    some = [f"{_plane(plane, places)}: {plane.why}" for plane in planes[:3]]
    more = [f"and {len(planes) - 3} more"] if len(planes) > 3 else []
    return "; ".join(some + more)


def _plane(plane: JudgedPlane, places: Sequence[str]) -> str:
    """Return the number of a plane's points and the pictures it is seen in."""
    rest = f" and {len(plane.patches) - 1} more" if len(plane.patches) > 1 else ""
    return f"{len(plane.candidate.members)} points in {places[plane.patches[0]]}{rest}"


def contradicts(solved: SolvedLasers) -> bool:
    """Return whether corners and stripes of a board cannot both be right.

    Then stripes shift the board from its pose by corners alone, or stripes do not fit one plane
    although each is straight.
    """
    # Ratio of the corners' residuals with stripes to those without from which they contradict each
    # other; ratio of the stripes' residuals from a plane to those from lines from which they do.
    corners_contradict, stripes_contradict = 1.5, 3.0
    n_groups = len(solved.problem.groups)
    blocks = solved.solution.blocks[n_groups : n_groups + len(solved.views)]
    squares = [np.nanmean(np.sum(block.residuals**2, axis=1)) for block in blocks]
    corners_px = float(np.sqrt(np.mean(squares))) * CORNER_SIGMA_PX
    alone_px = float(np.sqrt(np.mean([view.rms_px**2 for view in solved.views])))
    return (
        corners_px / alone_px > corners_contradict or _stripes_misfit(solved) > stripes_contradict
    )


def _stripes_misfit(solved: SolvedLasers) -> float:
    """Return the ratio of the stripes' residuals from their plane to those from straight lines."""
    from_plane = from_line = 0.0
    min_bins = 5
    for i, group in enumerate(solved.problem.groups):
        residuals, _ = solved.stripe_residuals_px(i)
        seen = np.isfinite(residuals)
        if np.count_nonzero(seen) < min_bins:
            continue
        weights = 1.0 / group.sigma_px[seen]
        way = way_along(group.pixels[seen])
        basis = np.stack([np.ones(len(way)), way], axis=-1) * weights[:, None]
        values = residuals[seen] * weights
        left = values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0]
        from_plane += float(values @ values)
        from_line += float(left @ left)
    return float(np.sqrt(from_plane / max(from_line, 1e-12)))


def loose_text(solved: SolvedLasers) -> str:
    """Return the warning that a board is assumed to lie unevenly on its surface."""
    board_pose = solved.state.board_poses
    tilt = np.rad2deg(np.sqrt(np.mean(np.sum(board_pose[:, :2] ** 2, axis=1))))
    offset = np.sqrt(np.mean(board_pose[:, 2] ** 2)) * 1e3
    return (
        "the board is taken to lie unevenly on the surface that the stripes are on, or to bend, "
        f"because stripes and corners contradict each other; by {tilt:.1f} deg and {offset:.1f} mm "
        "(rms). Fix a flat board to a flat wall for better lasers"
    )


def _too_few(
    split: LaserAssignment, expected: int | None, rig: Rig, places: Sequence[str], wanted: str
) -> str:
    """Return which lasers cannot be solved, with what is undecided; `wanted` is where."""
    which = ""
    if split.planes and len(rig.lasers) == expected:
        matched = match_to_rig(rig, split.planes)
        missing = [laser.name for laser, i in zip(rig.lasers, matched, strict=True) if i is None]
        which = f" (not: {', '.join(missing)})"
    none = expected is None or not split.planes
    seen = "none of the" if none else f"{len(split.planes)} of {expected}"
    lonely = ""
    if split.unmatched:
        where = sorted({places[line.patch] for line in split.unmatched[:4]})
        what = "seen on one plane only" if len(where) == 1 else "that no certain plane explains"
        lonely = f"; stripes {what}: {'; '.join(where)}"
    if split.possible:
        lonely += f"; undecided: {_planes(split.possible, places)}"
    count = "give --lasers N, how many there are, or " if split.possible and not expected else ""
    return f"{seen} lasers can be solved{which}: each must be seen {wanted}{lonely}; {count}"
