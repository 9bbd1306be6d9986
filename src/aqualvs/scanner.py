"""The main path: a frame in, posture and points out."""

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import Rig
from aqualvs.optics.rig_covariance import FittedSurface, PostureErrors, fitted_plane
from aqualvs.optics.shutter import Field
from aqualvs.scanning.assignment import NOT_TESTED, AssignmentTest, Verdict, inflate_for_rival
from aqualvs.scanning.candidates import Candidates, Subsegments, find_candidates
from aqualvs.scanning.detection import DetectorOptions, FrameDetector
from aqualvs.scanning.labels import label_candidates
from aqualvs.scanning.laser_bands import LaserBand, SearchAxis, plan_bands, search_range
from aqualvs.scanning.patch import Patch, fitted_patch
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.posture_estimator import MIN_LINES, FitMethod, Measurement, PostureEstimator
from aqualvs.scanning.row_motion import RowMotion
from aqualvs.scanning.scan import Frame, Scan, ScanPoints
from aqualvs.scanning.stripe import StripeOptions, StripePeaks
from aqualvs.scanning.surfaces import (
    MIN_LINES_PER_LASER,
    Surface,
    TargetKind,
    as_requested_kind,
    choose_target,
    find_surfaces,
    shares_peaks,
    surface_on,
)
from aqualvs.scanning.triangulate import Triangulator

if TYPE_CHECKING:
    from aqualvs.scanning.paper.detector import PaperFilter
    from aqualvs.scanning.paper.mesh_filter import MeshFilterOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class ScannerOptions:
    """Options of the scanner; the defaults need no tuning.

    Attributes
    ----------
    detector : StripeOptions or ThresholdOptions
        Kind of stripe detector, and its options.
    mesh_filter : MeshFilterOptions or None
        The paper's mesh filter; off by default. Points that it rejects are dropped, and the frame
        is measured once more from the rest.
    target : TargetKind
        Kind of surface that the posture is measured to.
    fit : FitMethod
        Method of the plane fit.
    """

    detector: DetectorOptions = field(default_factory=StripeOptions)
    mesh_filter: "MeshFilterOptions | None" = None
    target: TargetKind = TargetKind.AUTO
    fit: FitMethod = FitMethod.ROBUST


@dataclass(frozen=True, slots=True)
class _View:
    """Search for stripes in whole pictures, or in one field of them."""

    laser_bands: tuple[LaserBand, ...]
    detector: FrameDetector
    assignment: AssignmentTest


class Scanner:
    """The scanner of one rig: frames in, postures out, each from its frame alone.

    Frames of an interlaced camera are fields (`Shutter.field_of`); their points are in pixels of
    the whole picture, whose camera model holds.

    Parameters
    ----------
    rig : Rig
        Camera, housing, water and lasers.
    options : ScannerOptions, optional
        Defaults if left out.
    camera : Camera, optional
        Replaces `rig.camera()`, such as `rig.bare_camera()` for the error of ignoring the dome.
    """

    def __init__(
        self, rig: Rig, options: ScannerOptions | None = None, camera: Camera | None = None
    ) -> None:
        self.rig = rig
        self.options = options or ScannerOptions()
        # The rig's own record of its uncertainty; no frame needs it.
        from aqualvs.optics.solved import completed_uncertainty

        camera = camera or rig.camera()
        self._triangulator = Triangulator(rig, camera)
        fields = {rig.shutter.field_of(index) for index in range(2)}
        self._views = {field: self._make_view(camera, field) for field in fields}
        laser_bands = self._view(0).laser_bands
        self._posture_estimator = PostureEstimator(rig, laser_bands, self.options.fit)
        self._paper_filter = self._make_paper_filter(camera, laser_bands)
        self._row_motion = RowMotion(rig) if rig.shutter.rolls else None
        self._rig_errors = PostureErrors(rig, camera, completed_uncertainty(rig))

    def process(self, frame: Frame) -> Scan:
        """Measure the posture in one frame.

        Parameters
        ----------
        frame : Frame
            Of the rig's image size, or the field that its index says.

        Returns
        -------
        Scan
            Posture or refusal, and every stripe point with its label.

        Raises
        ------
        ValueError
            If the frame has another size than the rig's image, or is another field.
        """
        return self.measure(frame.index, frame.time_s, self.detect(frame))

    def detect(self, frame: Frame) -> dict[SearchAxis, StripePeaks]:
        """Find the sub-pixel peaks along the search lines, within the lasers' bands.

        Raises
        ------
        ValueError
            If the frame has another size than the rig's image, or is another field.
        """
        if frame.field != self.rig.shutter.field_of(frame.index):
            raise ValueError(
                f"frame {frame.index} is {frame.field or 'a whole picture'} but expected "
                f"{self.rig.shutter.field_of(frame.index) or 'a whole picture'}"
            )
        return self._view(frame.index).detector.detect(frame)

    def measure(self, index: int, time_s: float, peaks: dict[SearchAxis, StripePeaks]) -> Scan:
        """Measure the posture from the peaks of one frame.

        Parameters
        ----------
        index : int
            Of the frame.
        time_s : float
            Of the frame.
        peaks : dict
            From `detect`; recorded peaks give the same result as their frame.
        """
        # Candidates: each peak as a point of every laser that could have made it.
        view = self._view(index)
        candidates = find_candidates(peaks, view.laser_bands, self._triangulator)
        found, points, listed = self._estimate(candidates, view.assignment)
        if self._paper_filter is not None:
            # The paper's filter needs the laser of each peak, which is known by now.
            kept = np.zeros(len(candidates), np.bool_)
            kept[listed] = _on_mesh(self._paper_filter, points)
            candidates = candidates.where(kept)
            found, points, _ = self._estimate(candidates, view.assignment)
        posture = self._with_rig_covariance(found, candidates)
        return Scan(index, time_s, posture, points, self.rig.n_water)

    def _make_view(self, camera: Camera, field: Field | None) -> _View:
        laser_bands = plan_bands(self.rig, camera, field)
        limits = search_range(self.rig.working_range)
        return _View(
            laser_bands,
            FrameDetector(self.rig.size_px, laser_bands, self.options.detector, field),
            AssignmentTest(laser_bands, self._triangulator, limits),
        )

    def _view(self, index: int) -> _View:
        return self._views[self.rig.shutter.field_of(index)]

    def _make_paper_filter(
        self, camera: Camera, laser_bands: tuple[LaserBand, ...]
    ) -> "PaperFilter | None":
        options = self.options.mesh_filter
        if options is None:
            return None
        # Only for comparisons with the paper.
        from aqualvs.scanning.paper.detector import PaperFilter

        every_pixel = not isinstance(self.options.detector, StripeOptions)
        return PaperFilter(self.rig, camera, laser_bands, options, every_pixel=every_pixel)

    def _estimate(
        self, candidates: Candidates, assignment: AssignmentTest
    ) -> tuple[Measurement, ScanPoints, IntArray]:
        """Return the posture, the labelled points, and the rows of their candidates."""
        # Planes that several lasers agree on, and the one that is the target.
        subsegments = candidates.subsegments()
        surfaces = find_surfaces(
            subsegments,
            candidates.pixels,
            len(self.rig.lasers),
            search_range(self.rig.working_range),
            self.rig.focal_px,
        )
        surfaces = as_requested_kind(surfaces, self.options.target)
        surfaces, target, doubtful = self._chosen(candidates, subsegments, surfaces, assignment)
        tested = NOT_TESTED
        if target is not None:
            # The same peaks, read as other lasers', may give a plane that is as good or better.
            tested = assignment.test(candidates, subsegments, target)
            if tested.verdict is Verdict.RIVAL and tested.other is not None:
                surfaces = self._with_rival(surfaces, target, tested.other, subsegments)
                surfaces, target, doubtful = self._chosen(
                    candidates, subsegments, surfaces, assignment
                )
        # The posture from the target's points outside crossing zones.
        if target is None:
            found = _refuse_no_target(candidates, surfaces, self.options.target)
        elif doubtful is not None:
            found = _refuse_ambiguous(candidates, target.plane, doubtful.plane)
        elif assignment.is_by_chance(candidates, subsegments, surfaces, target):
            found = _refuse_chance_plane(candidates)
        elif tested.verdict is Verdict.AMBIGUOUS and tested.other is not None:
            found = _refuse_ambiguous(candidates, target.plane, tested.other)
        elif self.options.target is TargetKind.AUTO and assignment.may_hide_net(
            candidates, subsegments, surfaces, target
        ):
            found = _refuse_hidden_net(candidates, target.plane)
        else:
            found = self._measured(candidates, subsegments, target)
            found = inflate_for_rival(found, tested)
            # The mean plane of folds covers all of a net's light, nearer parts included.
            other = None if found.folded else assignment.nearer_net(subsegments, surfaces, target)
            if other is not None and found.posture:
                found = _refuse_ambiguous(candidates, target.plane, other.plane)
        points, listed = label_candidates(
            candidates, subsegments, surfaces, target, found, self.rig.working_range
        )
        return found, points, listed

    def _chosen(
        self,
        candidates: Candidates,
        subsegments: Subsegments,
        surfaces: list[Surface],
        assignment: AssignmentTest,
    ) -> tuple[list[Surface], Surface | None, Surface | None]:
        """Return the surfaces, the target, and a surface before it that may be the net instead."""
        kind = self.options.target
        target = choose_target(surfaces, kind, self.rig.working_range)
        if target is None or kind is not TargetKind.AUTO:
            return surfaces, target, None
        before = assignment.overlooked(candidates, subsegments, surfaces, target)
        if before is None or not before.is_mesh:
            return surfaces, target, before
        surfaces = [before if one.members is before.members else one for one in surfaces]
        return surfaces, before, None

    def _measured(
        self, candidates: Candidates, subsegments: Subsegments, target: Surface
    ) -> Measurement:
        """Return the posture to the target, as the rows of the picture show it."""
        if self._row_motion is None:
            return self._posture_estimator.measure(candidates, subsegments, target)
        on_target = target.members[subsegments.of_candidate]
        still = self._row_motion.stilled(candidates, on_target, target.plane)
        found = self._posture_estimator.measure(still, subsegments, target)
        posture = found.posture
        if not isinstance(posture, Posture) or found.weights is None:
            return found
        surface, weights = _fitted(posture, found.patch, candidates.points, found.weights)
        exposed = self._row_motion.as_exposed(posture, surface, still, candidates, weights)
        return replace(found, posture=exposed)

    def _with_rig_covariance(self, found: Measurement, candidates: Candidates) -> Posture | Refusal:
        """Return the posture with its covariance by the rig's uncertainty."""
        posture = found.posture
        if not isinstance(posture, Posture) or found.weights is None:
            return posture
        surface, weights = _fitted(posture, found.patch, candidates.points, found.weights)
        _, covariance = self._rig_errors.propagate(
            surface, candidates.pixels, candidates.laser, candidates.points, weights
        )
        return replace(posture, rig_covariance=covariance)

    def _with_rival(
        self, surfaces: list[Surface], target: Surface, other: Plane, subsegments: Subsegments
    ) -> list[Surface]:
        """Replace a surface by the rival that explains the picture better."""
        rival = surface_on(other, subsegments, len(self.rig.lasers), self.rig.focal_px)
        kept = [
            one
            for one in surfaces
            if one is not target and not shares_peaks(one, rival, subsegments)
        ]
        return as_requested_kind([rival, *kept], self.options.target)


def _fitted(
    posture: Posture, patch: Patch | None, points: FloatArray, weights: FloatArray
) -> tuple[FittedSurface, FloatArray]:
    """Return the surface of a posture as fitted to points, and their weights for its residuals."""
    m = posture.normal_in_dome / posture.range
    if patch is None:
        return fitted_plane(m, points), weights
    # Heights over a patch are in metres; m·X is relative to the range.
    return fitted_patch(patch, m, points), weights / posture.range**2


def _on_mesh(paper_filter: "PaperFilter", points: ScanPoints) -> BoolArray:
    laser = points.laser.astype(np.int64)
    return paper_filter.apply(points.pixels, points.width, laser).peaks_on_mesh(len(points))


def _refuse_chance_plane(candidates: Candidates) -> Measurement:
    detail = "the best plane is small, and lasers that should be seen on it are not"
    return Measurement(Refusal(Reason.NOT_A_PLANE, detail), np.zeros(len(candidates), np.bool_))


def _refuse_hidden_net(candidates: Candidates, plane: Plane) -> Measurement:
    detail = (
        f"much light before the surface at {plane.offset:.3f} m shares no plane, such as that on a "
        "net in folds"
    )
    return Measurement(Refusal(Reason.AMBIGUOUS, detail), np.zeros(len(candidates), np.bool_))


def _refuse_ambiguous(candidates: Candidates, one: Plane, other: Plane) -> Measurement:
    apart = np.rad2deg(np.arccos(min(float(one.normal @ other.normal), 1.0)))
    detail = (
        f"planes at {one.offset:.3f} m and {other.offset:.3f} m, {apart:.1f} deg apart, explain "
        "the stripes about as well"
    )
    return Measurement(Refusal(Reason.AMBIGUOUS, detail), np.zeros(len(candidates), np.bool_))


def _refuse_no_target(
    candidates: Candidates, surfaces: list[Surface], wanted: TargetKind
) -> Measurement:
    refusal = _no_target_reason(candidates, surfaces, wanted)
    return Measurement(refusal, np.zeros(len(candidates), np.bool_))


def _no_target_reason(
    candidates: Candidates, surfaces: list[Surface], wanted: TargetKind
) -> Refusal:
    peaks, candidate, candidates_of = np.unique(
        candidates.source, return_index=True, return_counts=True
    )
    if not len(peaks):
        return Refusal(Reason.NO_STRIPES, "no laser stripe in the picture")
    if surfaces:
        return Refusal(Reason.NO_TARGET, f"surfaces in view, but none of kind {wanted.value}")
    if len(peaks) < MIN_LINES:
        return Refusal(Reason.TOO_FEW_POINTS, f"only {len(peaks)} stripe points")
    # Lasers with many peaks that can belong to no other laser.
    own = np.bincount(candidates.laser[candidate[candidates_of == 1]])
    if np.count_nonzero(own >= MIN_LINES_PER_LASER) == 1:
        return Refusal(Reason.ONE_LASER, "stripes of one laser only")
    return Refusal(Reason.NOT_A_PLANE, f"{len(peaks)} stripe points share no plane")
