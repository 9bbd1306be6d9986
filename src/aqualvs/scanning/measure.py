"""The posture to one surface: which readings it rests on, and the fit to them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel, kernel
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Rig
from aqualvs.optics.sheet import sheets_of
from aqualvs.optics.sheet_kernels import COLUMNS, START, WINDOWED, sheet_distance
from aqualvs.scanning.net_growth import follow_net
from aqualvs.scanning.net_labels import SOME, much_beside
from aqualvs.scanning.net_mean import doubted, fit_mean
from aqualvs.scanning.patch import (
    Patch,
    flat_patch,
    nearest_in_view,
    nearest_tangent,
    tangent_covariance,
)
from aqualvs.scanning.plane_fit import (
    MESH_ERROR,
    SOLID_ERROR,
    PlaneFit,
    fit_pseudo_inverse,
    fit_robust,
)
from aqualvs.scanning.posture import Posture, Reason, Refusal, believable, posture_from_fit
from aqualvs.scanning.quadric import LEAST_BEND, fit_patch, hints_at_curvature, refit_at_nearest
from aqualvs.scanning.readings import Observations, Readings
from aqualvs.scanning.search import StripeSearch
from aqualvs.scanning.surfaces import Surface

MIN_LINES = 30
"""Stripe points that a posture needs."""

# Two stripes disturb each other within this many full widths, and this many pixels more.
_CROSSING_WIDTHS = 1.2
_CROSSING_PX = 2.0
# The light on a strand covers this many search lines; less is a fragment, off the strand's middle.
_SHORTEST_STRAND = 3
# A net bends out of the plane that touches it by at most this share of the range.
_DEEPEST_BEND = 0.15
_FEW_STRANDS, _STRONG_BEND = 36, 0.02
# With less than this share of a net's light a surface does not stand for the net: its mean plane
# does, of which so many strands err independently. Up to the greater share that casts doubt.
_MAIN_SHARE, _WHOLE_SHARE = 0.4, 0.9
_FOLDS = 6
_NEAR_SHARE = 0.005
# Independent pieces of stripe that the second best laser must show.
_MIN_PIECES = 3


class FitMethod(StrEnum):
    """How the plane is fitted to the target's points."""

    ROBUST = "robust"
    """Weighted by each point's uncertainty, outliers rejected."""
    PSEUDO_INVERSE = "pseudo_inverse"
    """The paper's Eq. 24, for comparison: all points alike."""


@dataclass(frozen=True, slots=True)
class Measurement:
    """A posture, or why there is none, and the readings it rests on.

    Attributes
    ----------
    posture : Posture or Refusal
        The answer.
    rests_on : bool array, shape (N,)
        Readings in the posture; none where it is refused.
    patch : Patch or None
        The curved surface, where the net is none that a plane describes.
    whole : bool array, shape (N,), or None
        Readings on the net, also where its folds leave the surface; None for what is no net.
    """

    posture: Posture | Refusal
    rests_on: BoolArray
    patch: Patch | None = None
    whole: BoolArray | None = None


class PostureMeter:
    """Measures postures to surfaces with one rig.

    Parameters
    ----------
    rig : Rig
        Lasers, working range and camera axis.
    searches : sequence of StripeSearch
        One for each laser.
    fit : FitMethod
        How planes are fitted.
    """

    def __init__(self, rig: Rig, searches: Sequence[StripeSearch], fit: FitMethod) -> None:
        self._fit_method = fit
        self._n_lines = np.array([len(search.lowest) for search in searches])
        self._working_range = rig.working_range
        sheets = np.array([one.packed() for one in sheets_of(rig)]).reshape(-1, COLUMNS)
        self._planes = np.ascontiguousarray(sheets[:, START : START + 4])
        # A kernel that is given None is compiled without the way to bent sheets.
        self._bent = sheets if sheets[:, WINDOWED].any() else None
        self._focal_px = rig.focal_px
        self._line_px = max((search.line_px for search in searches), default=1)
        self._axis_in_dome = rig.dome_from_cam.rotate([0.0, 0.0, 1.0])

    def measure(self, readings: Readings, chunk_index: IntArray, target: Surface) -> Measurement:
        """Measure the posture to a surface.

        Parameters
        ----------
        readings : Readings
            N of them.
        chunk_index : int array, shape (N,)
            Row of each reading's chunk in the surface's `members`.
        target : Surface
            What to measure to.
        """
        # On a net a stretch is one strand, whose light has one centre; on a wall a chunk is enough
        # for errors to be independent.
        piece = readings.stretch if target.is_mesh else readings.chunk
        group = np.empty(len(readings), np.int64)
        n_groups, n_readings = self._select(
            readings,
            piece,
            _SHORTEST_STRAND if target.is_mesh else 1,
            target.members[chunk_index],
            group,
        )
        if n_readings < MIN_LINES:
            detail = f"only {n_readings} stripe points outside crossings"
            return _nothing(readings, Refusal(Reason.TOO_FEW_POINTS, detail))
        observed = readings.observations(group, n_groups, target.plane.normal)
        fit = self._fit(readings, group, observed, target)
        if fit is None:
            return _nothing(readings, Refusal(Reason.COLLINEAR, "the points do not fix a plane"))
        if not _held_by_two_lasers(observed.laser[fit.weights > 0.0]):
            detail = "all lasers but one show too little of the target"
            return _nothing(readings, Refusal(Reason.ONE_LASER, detail))
        rests_on = (group >= 0) & (fit.weights[group] > 0.0)
        measured = posture_from_fit(fit, readings.points[rests_on], self._axis_in_dome)
        flat = Measurement(measured, rests_on)
        if target.is_mesh and self._fit_method is FitMethod.ROBUST:
            plane = _plane_of(fit)
            off = np.abs(readings.points @ plane.normal - plane.offset) / plane.offset
            # Few strands hint at nothing; only a strong bend is believed then.
            few = n_groups < _FEW_STRANDS and much_beside(off, SOME)
            bends = target.n_pieces > 1 or much_beside(off)
            bends = bends or hints_at_curvature(observed, fit.weights, plane)
            least = LEAST_BEND if bends else few * _STRONG_BEND
            found, whole = self._measure_bent(readings, plane, off, flat, least)
            return replace(self._believed(readings, found), whole=whole)
        return self._believed(readings, flat)

    def _believed(self, readings: Readings, found: Measurement) -> Measurement:
        """Return what was found if a pilot may rely on it, else why not."""
        if isinstance(found.posture, Refusal):
            return found
        posture = believable(found.posture, self._working_range)
        return found if posture else _nothing(readings, posture)

    def _measure_bent(
        self, readings: Readings, plane: Plane, off: FloatArray, flat: Measurement, least: float
    ) -> tuple[Measurement, BoolArray]:
        """Measure the posture to a net that may bend or fold; also return what is seen of it."""
        curved = None if least == 0.0 else self._measure_curved(readings, plane, off, least)
        best = flat if curved is None else curved
        if curved is not None and not self._tells(readings, curved):
            # The net bends, but how it stands at its nearest point cannot be told.
            best = _doubted(flat, curved, 1.0)
        patch, whole = best.patch or flat_patch(plane), best.rests_on.copy()
        follow_net(
            readings.points,
            readings.line,
            readings.laser,
            readings.stretch,
            readings.trust,
            readings.source,
            patch.height(readings.points),
            plane.offset,
            plane.offset * self._line_px / self._focal_px,
            whole,
        )
        group = np.empty(len(readings), np.int64)
        n_groups, _ = self._select(readings, readings.stretch, _SHORTEST_STRAND, whole, group)
        if n_groups < 2 * _FOLDS:
            return best, whole
        seen = readings.observations(group, n_groups, plane.normal)
        share = float(np.mean(np.abs(patch.height(seen.points)) < _NEAR_SHARE * plane.offset))
        if share >= _MAIN_SHARE and (share >= _WHOLE_SHARE or best is curved):
            return best, whole
        mean = self._measure_mean(readings, seen, plane, group)
        if mean is None:
            return best, whole
        return (mean if share < _MAIN_SHARE else _doubted(best, mean, 1.0 - share)), whole

    def _tells(self, readings: Readings, curved: Measurement) -> bool:
        """Tell whether the posture to a curved net may be relied on."""
        posture = curved.posture
        return (
            isinstance(posture, Posture)
            and bool(believable(posture, self._working_range))
            and nearest_in_view(
                posture.normal_in_dome / posture.range, readings.points[curved.rests_on]
            )
        )

    def _measure_mean(
        self, readings: Readings, seen: Observations, plane: Plane, group: IntArray
    ) -> Measurement | None:
        """Measure the posture to the mean plane of all of a net; None where too little is seen."""
        fit = fit_mean(seen.points, plane, _FOLDS) if _held_by_two_lasers(seen.laser) else None
        if fit is None:
            return None
        rests_on = (group >= 0) & (fit.weights[group] > 0.0)
        posture = posture_from_fit(fit, readings.points[rests_on], self._axis_in_dome)
        return Measurement(posture, rests_on)

    def _measure_curved(
        self, readings: Readings, plane: Plane, off: FloatArray, least_bend: float
    ) -> Measurement | None:
        """Measure the posture to a curved net; None where a plane does."""
        candidates = off < _DEEPEST_BEND
        group = np.empty(len(readings), np.int64)
        n_groups, _ = self._select(readings, readings.stretch, _SHORTEST_STRAND, candidates, group)
        if n_groups == 0:
            return None
        seen = readings.observations(group, n_groups, plane.normal)
        fit = fit_patch(seen, plane, MESH_ERROR, least_bend)
        fit = fit and refit_at_nearest(fit, seen, MESH_ERROR)
        if fit is None or not _held_by_two_lasers(seen.laser[fit.weights > 0.0]):
            return None
        m = nearest_tangent(fit.patch)
        if m is None:
            return None
        rests_on = (group >= 0) & (fit.weights[group] > 0.0)
        tangent = PlaneFit(m, tangent_covariance(fit, m), fit.weights, fit.rms)
        measured = posture_from_fit(tangent, readings.points[rests_on], self._axis_in_dome)
        along = fit.patch.coefficients[[3, 5]].tolist()
        sigma = np.sqrt(np.diag(fit.covariance))[[3, 5]].tolist()
        bent = replace(measured, curvature=tuple(along), sigma_curvature=tuple(sigma))
        return Measurement(bent, rests_on, fit.patch)

    def _select(
        self,
        readings: Readings,
        piece: IntArray,
        min_lines: int,
        on_target: BoolArray,
        group: IntArray,
    ) -> tuple[int, int]:
        """Write the pieces' numbers to `group`; return how many they and their readings are."""
        return _select(
            readings.points,
            readings.laser,
            readings.width,
            piece,
            min_lines,
            on_target,
            self._planes,
            self._bent,
            self._focal_px,
            group,
        )

    def _fit(
        self, readings: Readings, group: IntArray, seen: Observations, target: Surface
    ) -> PlaneFit | None:
        start = target.plane.normal / target.plane.offset
        robust = fit_robust(
            seen.points,
            seen.sensitivity,
            seen.sigma_px,
            seen.laser,
            2.0 * seen.line / self._n_lines[seen.laser] - 1.0,
            start,
            MESH_ERROR if target.is_mesh else SOLID_ERROR,
        )
        if robust is None or self._fit_method is FitMethod.ROBUST:
            return robust
        return fit_pseudo_inverse(readings.points[group >= 0], len(seen.laser), robust.covariance)


def _plane_of(fit: PlaneFit) -> Plane:
    length = float(np.linalg.norm(fit.m))
    return Plane(fit.m / length, 1.0 / length)


def _doubted(found: Measurement, other: Measurement, share: float) -> Measurement:
    """Widen a posture's covariance by another opinion, which so much of the light holds."""
    one, two = found.posture, other.posture
    return replace(found, posture=doubted(one, two, share)) if one and two else found


def _held_by_two_lasers(laser: IntArray) -> bool:
    """Whether a second laser fixes the plane's turn about the first one's stripe.

    A line and one point always share a plane: a single piece would not show that it is wrong.
    """
    pieces = np.sort(np.bincount(laser, minlength=2))
    return bool(pieces[-2] >= _MIN_PIECES)


def _nothing(readings: Readings, refusal: Refusal) -> Measurement:
    return Measurement(refusal, np.zeros(len(readings), np.bool_))


@kernel
def _select(
    points: FloatArray,
    laser: IntArray,
    width: FloatArray,
    piece: IntArray,
    min_lines: int,
    on_target: BoolArray,
    planes: FloatArray,
    bent: FloatArray | None,
    focal_px: float,
    group: IntArray,
) -> tuple[int, int]:
    """Give numbers to pieces of stripe on the target, -1 to readings elsewhere or in crossings.

    A piece belongs as a whole: a part of a strand's light would have its centre off the sheet.
    The answer is the number of groups and of readings in them.
    """
    n = piece.shape[0]
    n_pieces = 0
    for i in range(n):
        n_pieces = max(n_pieces, piece[i] + 1)
    number = np.full(n_pieces, -1)
    lines = np.zeros(n_pieces, np.int64)
    for i in range(n):
        lines[piece[i]] += 1
    for i in range(n):
        if on_target[i] and lines[piece[i]] >= min_lines:
            number[piece[i]] = -2
    mean_width = _mean_widths(laser, width, piece, number, planes.shape[0])
    n_groups = 0
    n_readings = 0
    for i in range(n):
        group[i] = -1
        p = piece[i]
        if number[p] == -1 or _in_crossing(points, i, laser[i], planes, bent, mean_width, focal_px):
            continue
        if number[p] == -2:
            number[p] = n_groups
            n_groups += 1
        group[i] = number[p]
        n_readings += 1
    return n_groups, n_readings


@kernel
def _mean_widths(
    laser: IntArray, width: FloatArray, piece: IntArray, number: IntArray, n_lasers: int
) -> FloatArray:
    """Mean stripe width of each laser; a single width is inflated by the crossing itself."""
    total, count = np.zeros(n_lasers), np.zeros(n_lasers)
    for i in range(piece.shape[0]):
        if number[piece[i]] != -1:
            total[laser[i]] += width[i]
            count[laser[i]] += 1.0
    for index in range(n_lasers):
        total[index] = total[index] / count[index] if count[index] > 0.0 else -1.0
    return total


@borrowing_kernel
def _in_crossing(
    points: FloatArray,
    i: int,
    own: int,
    planes: FloatArray,
    bent: FloatArray | None,
    mean_width: FloatArray,
    focal_px: float,
) -> bool:
    """Whether another laser's stripe crosses the target here (paper, section 3.1)."""
    x, y, z = points[i, 0], points[i, 1], points[i, 2]
    px_per_m = focal_px / np.sqrt(x * x + y * y + z * z)
    for b in range(planes.shape[0]):
        if b == own or mean_width[b] < 0.0:
            continue
        gap = planes[b, 0] * x + planes[b, 1] * y + planes[b, 2] * z - planes[b, 3]
        if bent is not None:
            gap = sheet_distance(bent[b], x, y, z)
        wide = max(mean_width[b], mean_width[own])
        if abs(gap) * px_per_m < _CROSSING_WIDTHS * wide + _CROSSING_PX:
            return True
    return False
