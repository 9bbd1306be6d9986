"""Estimation of the posture to one surface: inliers, fit, and checks of the result.

`PostureEstimator.measure` averages the stripes on the surface to observations, fits a plane or a
paraboloid to them, follows a net where it leaves the surface, and replaces the posture by that to
the mean plane, or inflates its covariance, if a net is mostly folds.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import lazy_borrowing_kernel, python_of
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Rig
from aqualvs.scanning.candidates import Candidates, LinkedCandidates, Subsegments
from aqualvs.scanning.laser_bands import LaserBand
from aqualvs.scanning.net_surfaces import (
    disagreement,
    distances_off,
    fit_mean_plane,
    inflate_covariance,
    inflate_for_plane,
    mark_beside,
    share_near,
)
from aqualvs.scanning.observations import Observations, Observed, StripeObserver
from aqualvs.scanning.paraboloid import (
    MIN_BEND,
    PatchFit,
    fit_patch,
    refit_at_nearest,
    shows_curvature,
)
from aqualvs.scanning.patch import (
    COEFFICIENTS,
    heights_over,
    intensity_share_near,
    nearest_in_view,
    nearest_tangent,
    packed_plane,
    tangent_covariance,
)
from aqualvs.scanning.plane_fit import (
    GLOW_PX,
    GLOW_SHARE,
    TWINE_SHARE,
    PlaneFit,
    SharedError,
    fit_pseudo_inverse,
    fit_robust,
    mark_inliers,
    shared_error,
    weigh_candidates,
)
from aqualvs.scanning.posture import MAX_RMS_SHARE, Posture, Reason, Refusal, posture_of, validate
from aqualvs.scanning.region_growing import MODERATELY_BESIDE, grow_region, has_much_beside
from aqualvs.scanning.segments import CURVED_PX, is_bent
from aqualvs.scanning.surfaces import Surface


@lazy_borrowing_kernel
def places_along(line: FloatArray, laser: IntArray, n_lines: IntArray, along: FloatArray) -> None:
    """Write the places (N,) along the stripes, from -1 at one image border to 1 at the other.

    `n_lines`, shape (n_lasers,), is the number of search lines in the picture.
    """
    for k in range(line.shape[0]):
        along[k] = 2.0 * line[k] / n_lines[laser[k]] - 1.0


MIN_LINES = 30
"""Least number of stripe points of a posture."""

# Largest distance of a net from the plane that touches it, as a share of the range.
_DEEPEST_BEND = 0.15
# With fewer strands, only a bend of at least the second number, as a share of the range, counts.
_FEW_STRANDS, _STRONG_BEND = 36, 0.02
# With a smaller share of a net's strands on the surface than the first, the net's mean plane
# replaces it; with a smaller one than the second, the plane of all strands inflates the covariance.
_MAIN_SHARE, _WHOLE_SHARE = 0.4, 0.9
# Least number of strands that show whether a net is folded.
_MIN_FOLDED = 12
# Largest scatter of strands about the mean plane of a folded net, as a share of the range.
_FOLDED_RMS_SHARE = 0.04
# Largest distance of strands on the surface, as a share of the range.
_NEAR_SHARE = 0.005
# Candidates within the first share of the range of the plane may be on the net if no other surface
# explains them. A net is mostly folds if at most the second share of its strands, and less than the
# third of its light, lie on the surface. Flat nets in strong sun and with growth have at least 0.36
# of the strands and 0.31 of the light there, folded ones at most 0.5 and 0.62.
_BESIDE_SHARE, _FOLDED_STRANDS, _FOLDED_INTENSITY = 0.06, 0.5, 0.47
# With less than both shares, of strands and of light, the surface may be a flank: its plane counts
# only if the mean plane agrees. 96 of 586 random folded nets have less, 28 of the 46 that were off
# by more than 4 sigmas among them, and 10 of 426 random flat ones.
_FLANK_STRANDS, _FLANK_INTENSITY = 0.73, 0.76
# Squared Mahalanobis distance between two postures: its expected value if they differ by chance,
# and the quantile 0.999 (chi-squared, 3 degrees of freedom).
_EXPECTED, _CONTRADICTS = 3.0, 16.27
# Least number of observations of the second best laser.
_MIN_OBSERVATIONS = 3


class FitMethod(StrEnum):
    """Method of the plane fit to the target's points."""

    ROBUST = "robust"
    """Weighted by each point's uncertainty, outliers rejected."""
    PSEUDO_INVERSE = "pseudo_inverse"
    """The paper's Eq. 24, for comparison: equal weights."""


@dataclass(frozen=True, slots=True)
class Measurement:
    """A posture or its refusal, with the inliers and their weights."""

    posture: Posture | Refusal
    inliers: BoolArray  # Shape (N,): candidates in the posture; none if it is refused.
    # Shape (16,): the curved surface, see `patch`, if a plane does not describe the net.
    patch: FloatArray | None = None
    # Shape (N,): candidates on the net, also where its folds leave the surface; None if the target
    # is no net.
    net_mask: BoolArray | None = None
    # Shape (N,): weight of each candidate in the fit, 1 over the variance of m·X; None without a
    # posture.
    weights: FloatArray | None = None
    # Whether the posture is that to a folded net's mean plane.
    folded: bool = False

    @classmethod
    def refused(
        cls, refusal: Refusal, n_candidates: int, net_mask: BoolArray | None = None
    ) -> "Measurement":
        """Return a refusal, without inliers among the candidates."""
        return cls(refusal, np.zeros(n_candidates, np.bool_), net_mask=net_mask)

    def among(self, mask: BoolArray) -> "Measurement":
        """Return the measurement of the candidates that a mask (M,) selects, among all M."""

        def spread(column: NDArray[Any]) -> NDArray[Any]:
            whole = np.zeros(len(mask), column.dtype)
            whole[mask] = column
            return whole

        net_mask = None if self.net_mask is None else spread(self.net_mask)
        weights = None if self.weights is None else spread(self.weights)
        return replace(self, inliers=spread(self.inliers), net_mask=net_mask, weights=weights)


class PostureEstimator:
    """Estimator of postures to surfaces with one rig.

    Parameters
    ----------
    rig : Rig
        Lasers, working range and camera axis.
    laser_bands : sequence of LaserBand
        One for each laser.
    fit : FitMethod
        Method of the plane fit.
    """

    def __init__(self, rig: Rig, laser_bands: Sequence[LaserBand], fit: FitMethod) -> None:
        self._fit_method = fit
        self._n_lines = np.array([len(band.lowest) for band in laser_bands])
        self._position_px = np.array([band.position_px for band in laser_bands])
        self._working_range = rig.working_range
        self._n_lasers = len(rig.lasers)
        self._observer = StripeObserver(rig)
        self._focal_px = rig.focal_px
        self._line_px = max((band.line_px for band in laser_bands), default=1)
        self._axis_in_dome = rig.dome_from_cam.rotate([0.0, 0.0, 1.0])

    def measure(
        self, candidates: Candidates, subsegments: Subsegments, target: Surface
    ) -> Measurement:
        """Measure the posture to a surface.

        Parameters
        ----------
        candidates : Candidates
            N of them.
        subsegments : Subsegments
            Those of the candidates.
        target : Surface
            Surface that the posture is measured to.
        """
        mesh = target.is_mesh
        candidates = candidates if mesh else candidates.without_pull()
        on_target = target.members[subsegments.of_candidate]
        seen = self._observer.observe(candidates, on_target, target.plane, on_twine=mesh, flat=True)
        if seen.n_candidates < MIN_LINES:
            detail = f"only {seen.n_candidates} stripe points outside crossings"
            return Measurement.refused(Refusal(Reason.TOO_FEW_POINTS, detail), candidates.n)
        fit = self._fit(candidates, seen, target)
        if fit is None:
            refusal = Refusal(Reason.COLLINEAR, "the points do not fix a plane")
            return Measurement.refused(refusal, candidates.n)
        if not mesh and _do_two_disagree(seen.observations.laser, fit.weights):
            detail = "two lasers show the plane, and most of the light of one is off it"
            return Measurement.refused(Refusal(Reason.ONE_LASER, detail), candidates.n)
        flat = self._posture_of_fit(candidates, seen, fit)
        found = flat
        if mesh and self._fit_method is FitMethod.ROBUST:
            if flat is not None:
                found = self._measure_net(candidates, seen, fit, flat, target)
            else:
                found = self._measure_folded(candidates, seen, fit)
        if found is None:
            detail = "all lasers but one show too little of the target"
            return Measurement.refused(Refusal(Reason.ONE_LASER, detail), candidates.n)
        if isinstance(found.posture, Refusal):
            return found
        max_rms_share = _FOLDED_RMS_SHARE if found.folded else MAX_RMS_SHARE
        posture = validate(found.posture, self._working_range, max_rms_share)
        if isinstance(posture, Refusal):
            return Measurement.refused(posture, candidates.n, found.net_mask)
        return found

    def _measure_net(
        self,
        candidates: Candidates,
        seen: Observed,
        fit: PlaneFit,
        flat: Measurement,
        target: Surface,
    ) -> Measurement:
        """Measure the posture to a net, which may bend or fold, and mark its candidates.

        `flat` is the posture to the plane that was fitted to the target.
        """
        plane = _plane_of(fit)
        off = np.empty(candidates.n)
        distances_off(candidates.points, plane.normal, plane.offset, off)
        few = seen.observations.n < _FEW_STRANDS and has_much_beside(off, MODERATELY_BESIDE)
        bends = target.n_planes > 1 or has_much_beside(off)
        patch = packed_plane(plane)
        bends = bends or shows_curvature(seen.observations, fit.weights, patch)
        least = MIN_BEND if bends else few * _STRONG_BEND
        curved, is_clear = None, False
        if least > 0.0:
            curved, is_clear = self._measure_curved(candidates, plane, off, least)
        best = flat
        if curved is not None:
            is_observable = self._is_observable(candidates, curved)
            if is_clear and is_observable:
                best = curved
            elif (is_clear or is_observable) and flat.posture and curved.posture:
                # The nearest point is out of view, or the bend may be due to chance.
                posture = inflate_covariance(flat.posture, curved.posture, 1.0)
                best = replace(flat, posture=posture)
        patch = patch if best.patch is None else best.patch
        net_mask = self._grow_net_mask(candidates, best.inliers, plane, patch)
        seen = self._observe_near(candidates, net_mask, off, plane)
        share = _share_on(seen, patch, plane)
        if share < _WHOLE_SHARE:
            is_curved = best is curved
            folded = self._mean_plane_of_folds(
                candidates, net_mask, seen, share, plane, patch, best
            )
            best = folded or best
            if not best.folded:
                best = self._checked_for_folds(candidates, net_mask, plane, patch, best, is_curved)
        return replace(best, net_mask=net_mask)

    def _measure_folded(
        self, candidates: Candidates, seen: Observed, fit: PlaneFit
    ) -> Measurement | None:
        """Measure the posture to the mean plane of a net on whose plane only one laser lies.

        Such a plane has no fixed angles: the mean plane counts only if every laser confirms it.
        """
        plane = _plane_of(fit)
        off = np.empty(candidates.n)
        distances_off(candidates.points, plane.normal, plane.offset, off)
        inliers = (seen.group >= 0) & (fit.weights[seen.group] > 0.0)
        patch = packed_plane(plane)
        net_mask = self._grow_net_mask(candidates, inliers, plane, patch)
        seen = self._observe_near(candidates, net_mask, off, plane)
        share = _share_on(seen, patch, plane)
        if share >= _FOLDED_STRANDS:
            return None
        folded = self._mean_plane_of_folds(candidates, net_mask, seen, share, plane, patch, None)
        if folded is None:
            return None
        for index in range(self._n_lasers):
            mine = folded.inliers & (candidates.laser == index)
            if len(np.unique(candidates.component[mine])) < _MIN_OBSERVATIONS:
                return None
        return replace(folded, net_mask=net_mask)

    def _grow_net_mask(
        self, candidates: Candidates, inliers: BoolArray, plane: Plane, patch: FloatArray
    ) -> BoolArray:
        """Mark the candidates on a net (N,), also where its folds leave the surface."""
        net_mask, height = inliers.copy(), np.empty(candidates.n)
        heights_over(candidates.points, patch, height)
        grow_region(
            candidates,
            height,
            plane.offset,
            plane.offset * self._line_px / self._focal_px,
            net_mask,
        )
        return net_mask

    def _mean_plane_of_folds(
        self,
        candidates: Candidates,
        net_mask: BoolArray,
        seen: Observed,
        share: float,
        plane: Plane,
        patch: FloatArray,
        best: Measurement | None,
    ) -> Measurement | None:
        """Return the posture to the mean plane if the surface is only one flank of a fold.

        Such a surface holds little of the light around it, or the mean plane of all that light
        contradicts it. `seen` are the strands around the surface, `share` is the share of strands
        on it. `best` is the posture to the surface, if any: if the surface is the main part of the
        net, it is returned, with its covariance inflated by the disagreement with the mean plane.
        """
        intensity_share = intensity_share_near(
            seen.group,
            candidates.confidence,
            seen.observations.points,
            patch,
            _NEAR_SHARE * plane.offset,
        )
        # With most of the light on the surface, many strands beside it are specks.
        may_be_flank = share < _FLANK_STRANDS and intensity_share < _FLANK_INTENSITY
        if best and not may_be_flank:
            return self._inflated_by_mean(best, seen, plane, intensity_share)
        mean = self._reselected(candidates, net_mask, self._mean_plane(candidates, seen, plane))
        if mean is None:
            return None
        if best and intensity_share >= _FOLDED_INTENSITY:
            one, other = best.posture, mean.found.posture
            if not (one and other):
                return None
            if disagreement(one, other) <= _CONTRADICTS:
                is_folded = share <= _FOLDED_STRANDS
                return self._inflated_by_all(best, seen, intensity_share, folded=is_folded)
        return self._inflated_by_all(mean.found, mean.seen, mean.share, folded=True)

    def _inflated_by_mean(
        self, best: Measurement, seen: Observed, plane: Plane, intensity_share: float
    ) -> Measurement:
        """Inflate the covariance of a posture by the mean plane of the strands around it.

        `intensity_share` is the share of their light on the surface.
        """
        fit = fit_mean_plane(seen.observations.points, seen.observations.laser, plane)
        if fit is None or not isinstance(best.posture, Posture):
            return best
        mean = posture_of(fit, 0.0, 0, self._axis_in_dome)
        # Share of the squared difference that the scatter of the strands does not explain.
        excess = 1.0 - _EXPECTED / max(disagreement(best.posture, mean), _EXPECTED)
        share = (1.0 - intensity_share) * excess
        return replace(best, posture=inflate_covariance(best.posture, mean, share))

    def _inflated_by_all(
        self, found: Measurement, seen: Observed, share: float, *, folded: bool = False
    ) -> Measurement:
        """Inflate the covariance of a posture by the plane of all strands, outliers included.

        `share` is the share of the net's light that supports the posture. The plane of all strands
        of a folded net is uncertain itself, and adds its own covariance.
        """
        if not isinstance(found.posture, Posture):
            return found
        plane = Plane(found.posture.normal_in_dome, found.posture.range)
        fit = fit_mean_plane(seen.observations.points, seen.observations.laser, plane, reject=False)
        if fit is None:
            return found
        other = posture_of(fit, 0.0, 0, self._axis_in_dome)
        posture = inflate_covariance(found.posture, other, 1.0 - share)
        if folded:
            covariance = posture.covariance + (1.0 - share) * other.covariance
            posture = replace(posture, covariance=covariance)
        return replace(found, posture=posture)

    def _observe_near(
        self, candidates: Candidates, net_mask: BoolArray, off: FloatArray, plane: Plane
    ) -> Observed:
        """Return the observations of a net, and of candidates near a plane that may be on it."""
        beside = np.empty(candidates.n, np.bool_)
        mark_beside(candidates.source, net_mask, off, _BESIDE_SHARE, beside)
        return self._observer.observe(candidates, beside, plane, on_twine=True)

    def _reselected(
        self, candidates: Candidates, net_mask: BoolArray, mean: "_MeanPlane | None"
    ) -> "_MeanPlane | None":
        """Fit a mean plane again to the strands around it, until the selection is stable.

        The first selection is that around one flank, and holds more strands of that side.
        """
        off = np.empty(candidates.n)
        max_selections = 5
        for _ in range(max_selections):
            if mean is None or not isinstance(mean.found.posture, Posture):
                break
            plane = Plane(mean.found.posture.normal_in_dome, mean.found.posture.range)
            distances_off(candidates.points, plane.normal, plane.offset, off)
            seen = self._observe_near(candidates, net_mask, off, plane)
            if np.array_equal(seen.group >= 0, mean.seen.group >= 0):
                break
            mean = self._mean_plane(candidates, seen, plane)
        return mean

    def _mean_plane(
        self, candidates: Candidates, seen: Observed, plane: Plane
    ) -> "_MeanPlane | None":
        """Measure the posture to the mean plane of a folded net."""
        fit = fit_mean_plane(seen.observations.points, seen.observations.laser, plane)
        if fit is None:
            return None
        found = self._posture_of_fit(candidates, seen, fit, of_all=True)
        if found is None:
            return None
        return _MeanPlane(replace(found, folded=True), seen, float(np.mean(fit.weights)))

    def _checked_for_folds(
        self,
        candidates: Candidates,
        net_mask: BoolArray,
        plane: Plane,
        patch: FloatArray,
        best: Measurement,
        is_curved: bool,
    ) -> Measurement:
        """Return the measurement, or that to the mean plane if the net is mostly folds.

        In between, the covariance of the measurement is inflated.
        """
        seen = self._observer.observe(candidates, net_mask, plane, on_twine=True)
        share = _share_on(seen, patch, plane)
        if share >= _MAIN_SHARE:
            is_whole = is_curved or share >= _WHOLE_SHARE
            return best if is_whole else self._inflated_by_all(best, seen, share)
        mean = self._mean_plane(candidates, seen, plane)
        if mean is None:
            return best
        return self._inflated_by_all(mean.found, seen, mean.share, folded=True)

    def _is_observable(self, candidates: Candidates, curved: Measurement) -> bool:
        """Return whether the posture to a curved net is accurate, and its nearest point visible."""
        posture = curved.posture
        return (
            isinstance(posture, Posture)
            and bool(validate(posture, self._working_range))
            and nearest_in_view(
                posture.normal_in_dome / posture.range, candidates.points[curved.inliers]
            )
        )

    def _measure_curved(
        self, candidates: Candidates, plane: Plane, off: FloatArray, min_bend: float
    ) -> tuple[Measurement | None, bool]:
        """Measure the posture to a net that may bend, and return whether it clearly does.

        None if the strands of a flat net may look so by chance.
        """
        near = off < _DEEPEST_BEND
        seen = self._observer.observe(candidates, near, plane, on_twine=True)
        if not seen.observations.n:
            return None, False
        shared = self._shared_error(seen.observations, plane.normal, on_twine=True)
        first = fit_patch(seen.observations, plane, shared, min_bend)
        if first is None or not (first.is_clear or _may_bend(first)):
            return None, False
        fit = refit_at_nearest(first, seen.observations, shared)
        m = None if fit is None else nearest_tangent(fit.patch)
        if fit is None or m is None:
            return None, False
        covariance = tangent_covariance(fit.patch, fit.covariance, m)
        tangent = PlaneFit(m, covariance, fit.weights, fit.rms)
        found = self._posture_of_fit(candidates, seen, tangent)
        if found is None or isinstance(found.posture, Refusal):
            return None, False
        along = fit.patch[COEFFICIENTS:][[3, 5]].tolist()
        sigma = np.sqrt(np.diag(fit.covariance))[[3, 5]].tolist()
        bent = replace(found.posture, curvature=tuple(along), sigma_curvature=tuple(sigma))
        return replace(found, posture=bent, patch=fit.patch), first.is_clear

    def _fit(self, candidates: Candidates, seen: Observed, target: Surface) -> PlaneFit | None:
        """Fit a plane to the observations of a target by the chosen method."""
        observations = seen.observations
        along = np.empty(observations.n)
        places_along(observations.line, observations.laser, self._n_lines, along)
        robust = fit_robust(
            observations.points,
            observations.sensitivity,
            observations.sigma_px,
            observations.laser,
            along,
            target.plane.normal / target.plane.offset,
            self._shared_error(observations, target.plane.normal, on_twine=target.is_mesh),
        )
        if robust is None or self._fit_method is FitMethod.ROBUST:
            return robust
        points = candidates.points[seen.group >= 0]
        return fit_pseudo_inverse(points, observations.n, robust.covariance)

    def _shared_error(
        self, seen: Observations, normal: FloatArray, *, on_twine: bool
    ) -> SharedError:
        """Return the errors that observations of a surface share, given its approximate normal."""
        position_px = self._position_px[seen.laser]
        if not on_twine:
            return shared_error(GLOW_PX * seen.glow, position_px=position_px)
        nearer = -np.sign(seen.sensitivity @ normal)
        glow, twine = GLOW_SHARE * seen.glow, TWINE_SHARE * nearer
        return shared_error(glow * seen.width, twine * seen.width, position_px)

    def _posture_of_fit(
        self, candidates: Candidates, seen: Observed, fit: PlaneFit, *, of_all: bool = False
    ) -> Measurement | None:
        """Return the posture of a fit; None unless a second laser determines the plane's angles.

        A line and one point always share a plane: an error of a single observation would not show.
        With `of_all`, observations that the fit has rejected count, too.
        """
        inliers = np.empty(candidates.n, np.bool_)
        laser = seen.observations.laser
        n_points, nearest, second = mark_inliers(
            seen.group, laser, fit.weights, of_all, candidates.points, inliers
        )
        if second < _MIN_OBSERVATIONS:
            return None
        weights, observations = np.empty(candidates.n), seen.observations
        # The mean plane of folds and the pseudo-inverse do not weight by the errors.
        alike = of_all or self._fit_method is FitMethod.PSEUDO_INVERSE
        weigh_candidates(
            seen.group,
            fit.m,
            observations.sensitivity,
            observations.sigma_px,
            fit.weights,
            alike,
            weights,
        )
        posture = posture_of(fit, nearest, n_points, self._axis_in_dome)
        return Measurement(posture, inliers, weights=weights)


class _MeanPlane(NamedTuple):
    """Mean plane of a folded net, the strands it is fitted to, and the share that it explains."""

    found: Measurement
    seen: Observed
    share: float


def _share_on(seen: Observed, patch: FloatArray, plane: Plane) -> float:
    """Return the share of a net's strands on its surface; 1 if they are too few to show folds."""
    if seen.observations.n < _MIN_FOLDED:
        return 1.0
    strands = seen.observations
    return share_near(strands.points, strands.laser, patch, _NEAR_SHARE * plane.offset)


def inflate_for_bend(found: Measurement, linked: LinkedCandidates, target: Surface) -> Measurement:
    """Return a measurement with its covariance inflated by the bend of a solid target.

    A plane through a hull or a pipe lies on a part of it that chance selects. Lines that go on
    beside the plane in a smooth bend show the rest: the plane through all of them is as good.

    Parameters
    ----------
    found : Measurement
        Of the target.
    linked : LinkedCandidates
        Of the frame.
    target : Surface
        Of `linked`.
    """
    posture, (candidates, subsegments, shapes) = found.posture, linked
    curved = np.flatnonzero(shapes.sagitta_px > CURVED_PX)
    if target.is_mesh or isinstance(posture, Refusal) or not len(curved):
        return found
    on_target = target.members[subsegments.of_candidate]
    touching = np.intersect1d(curved, candidates.component[on_target])
    bent = [s for s in touching.tolist() if python_of(is_bent)(shapes, s)]
    if not bent:
        return found
    whole = Plane.fitted(candidates.points[on_target | np.isin(candidates.component, bent)])
    return replace(found, posture=inflate_for_plane(posture, whole, 1.0))


def _do_two_disagree(laser: IntArray, weights: FloatArray) -> bool:
    """Return whether two lasers alone show a surface, and one has a low mean weight in the fit."""
    # Walls have 0.75 and more; where each laser shows another wall of a corner, 0.2 at most.
    min_weight = 0.3
    n = np.bincount(laser)
    lit = n > 0
    weight = np.bincount(laser, weights)[lit] / n[lit]
    return len(weight) == 2 and bool((weight < min_weight).any())


def _plane_of(fit: PlaneFit) -> Plane:
    """Return the plane of a fit, in `dome`."""
    distance = 1.0 / math.hypot(*fit.m.tolist())
    return Plane(fit.m * distance, distance)


def _may_bend(fit: PatchFit) -> bool:
    """Return whether a net's curvature is more than chance would make of a flat net's strands."""
    min_sigmas = 3.0  # Least significance of a curvature.
    curvature, variance = fit.patch[COEFFICIENTS + 3 :], np.diag(fit.covariance)[3:]
    return bool((curvature**2 > min_sigmas**2 * variance).any())
