"""The main path: a frame in, posture and points out."""

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from aqualvs.errors import FrameError, OptionError
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import Rig
from aqualvs.optics.rig_covariance import FittedSurface, PostureErrors, fitted_plane
from aqualvs.optics.shutter import Field
from aqualvs.scanning.assignment import (
    NOT_TESTED,
    AssignmentOutcome,
    AssignmentTest,
    Verdict,
    inflate_for_rival,
)
from aqualvs.scanning.candidates import Candidates, Subsegments, find_candidates
from aqualvs.scanning.detection import DetectorOptions, FrameDetector, FramePeaks
from aqualvs.scanning.labels import label_candidates
from aqualvs.scanning.laser_bands import LaserBand, SearchAxis, plan_bands, search_range
from aqualvs.scanning.patch import Patch, fitted_patch
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.posture_estimator import MIN_LINES, FitMethod, Measurement, PostureEstimator
from aqualvs.scanning.scan import Frame, Scan, ScanPoints
from aqualvs.scanning.segments import ComponentShapes
from aqualvs.scanning.stripe import StripeOptions, StripePeaks
from aqualvs.scanning.surfaces import (
    MIN_LINES_PER_LASER,
    Surface,
    TargetKind,
    as_requested_kind,
    choose_target,
    find_surfaces,
    left_over,
    shares_peaks,
    surface_on,
)
from aqualvs.scanning.triangulate import Triangulator

if TYPE_CHECKING:
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

    def __post_init__(self) -> None:
        """Convert strings to members of their enumerations.

        Raises `OptionError` if there is no such member, or a string stands for options.
        """
        for name in ("detector", "mesh_filter"):
            if isinstance(getattr(self, name), str):
                raise OptionError(
                    f"ScannerOptions: {name} is {getattr(self, name)!r}; give its options, such as "
                    "ThresholdOptions() of aqualvs.scanning.stripe, or MeshFilterOptions() of "
                    "aqualvs.scanning.paper.mesh_filter"
                )
        for name, kind in (("target", TargetKind), ("fit", FitMethod)):
            value, known = getattr(self, name), ", ".join(kind)
            if value not in list(kind):
                raise OptionError(f"ScannerOptions: {name} is {value!r}; give one of {known}")
            object.__setattr__(self, name, kind(value))


# Number of times that a rival replaces the target, and is tested in its turn.
_MAX_RIVALS = 3


class _Stripes(NamedTuple):
    """Stripes of a frame, and the test of how its peaks are assigned to lasers."""

    candidates: Candidates
    subsegments: Subsegments
    shapes: ComponentShapes  # Of the candidates' components.
    assignment: AssignmentTest
    has_colour: bool  # Whether colour was evidence for the peaks.


class _Choice(NamedTuple):
    """The target among the surfaces of a frame, and evidence against it."""

    surfaces: list[Surface]  # Of the requested kind.
    target: Surface | None = None
    overlooked: Surface | None = None  # Nearer than the target; may be the net instead.
    # Test of the target's peaks against their assignment to other lasers.
    tested: AssignmentOutcome = NOT_TESTED


@dataclass(frozen=True, slots=True)
class _StripeSearch:
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
        self._searches = {field: self._make_search(camera, field) for field in fields}
        laser_bands = self._search(0).laser_bands
        self._posture_estimator = PostureEstimator(rig, laser_bands, self.options.fit)
        self._paper_filter = None
        if self.options.mesh_filter is not None:
            # Only for comparisons with the paper.
            from aqualvs.scanning.paper.detector import PaperFilter

            every_pixel = not isinstance(self.options.detector, StripeOptions)
            self._paper_filter = PaperFilter(
                rig, camera, laser_bands, self.options.mesh_filter, every_pixel=every_pixel
            )
        self._row_motion = None
        if rig.shutter.rolls:
            # Only for rolling shutters.
            from aqualvs.scanning.row_motion import RowMotion

            self._row_motion = RowMotion(rig)
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
        FrameError
            If it is no frame, has another size than the rig's image, or is another field.
        """
        if not isinstance(frame, Frame):
            raise FrameError(
                f"expected a Frame but got {type(frame).__name__}; make one of an image by "
                "aqualvs.Frame(index, time_s, *aqualvs.planes_of_image(image))"
            )
        return self.scan(frame)[1]

    def scan(self, frame: Frame) -> tuple[FramePeaks, Scan]:
        """Return the peaks of a frame as well as what `process` does. Raises as `detect`."""
        peaks = self.detect(frame)
        return self.without_colour(frame, peaks, self.measure(frame.index, frame.time_s, peaks))

    def without_colour(
        self, frame: Frame, peaks: FramePeaks, scan: Scan
    ) -> tuple[FramePeaks, Scan]:
        """Measure a frame once more from its tallest peaks if its colours leave little of them.

        Codecs drop the chroma of short dashes, and at low quality that of most of a line; in turbid
        water the glow beside a line is as green as the line. Lamps and daylight make more peaks on
        twine than the lasers, but lower ones.

        `peaks` are from `detect`, and `scan` is what `measure` makes of them. Returns those of the
        tallest peaks if they give a posture that is certain without colour, and has many more
        points than any before; else as given.
        """
        finds_stripes = isinstance(self.options.detector, StripeOptions)
        if not (finds_stripes and _may_lack_colour(peaks, scan)):
            return peaks, scan
        by_luma = peaks if frame.chroma is None else self.detect(replace(frame, chroma=None))
        tallest = self._search(frame.index).detector.tallest(by_luma)
        again = self.measure(frame.index, frame.time_s, tallest, has_colour=False)
        n_before = scan.posture.n_points if scan.posture else 0
        many_more = 1.5
        is_better = again.posture and again.posture.n_points > many_more * n_before
        return (tallest, again) if is_better else (peaks, scan)

    def detect(self, frame: Frame) -> FramePeaks:
        """Find the sub-pixel peaks along the search lines, within the lasers' bands.

        Raises
        ------
        FrameError
            If the frame has another size than the rig's image, or is another field.
        """
        if frame.field != self.rig.shutter.field_of(frame.index):
            raise FrameError(
                f"frame {frame.index} is {frame.field or 'a whole picture'} but expected "
                f"{self.rig.shutter.field_of(frame.index) or 'a whole picture'}; the rig's "
                "camera.shutter must be that of the source"
            )
        return self._search(frame.index).detector.detect(frame)

    def measure(
        self,
        index: int,
        time_s: float,
        peaks: dict[SearchAxis, StripePeaks],
        *,
        has_colour: bool = True,
    ) -> Scan:
        """Measure the posture from the peaks of one frame.

        Parameters
        ----------
        index : int
            Of the frame.
        time_s : float
            Of the frame.
        peaks : dict
            From `detect`; recorded peaks give the same result as their frame.
        has_colour : bool
            If false, the target must be certain without colour.
        """
        # Candidates: each peak as a point of every laser that could have made it.
        search = self._search(index)
        candidates = find_candidates(peaks, search.laser_bands, self._triangulator)
        measurement, points, rows = self._estimate(candidates, search.assignment, has_colour)
        if self._paper_filter is not None:
            # The paper's filter needs the laser of each peak, which is known by now.
            kept, laser = np.zeros(candidates.n, np.bool_), points.laser.astype(np.int64)
            found = self._paper_filter.apply(points.pixels, points.width, laser)
            kept[rows] = found.peaks_on_mesh(len(points))
            candidates = candidates.where(kept)
            measurement, points, _ = self._estimate(candidates, search.assignment, has_colour)
        posture = self._with_rig_covariance(measurement, candidates)
        return Scan(index, time_s, posture, points, self.rig.n_water)

    def _make_search(self, camera: Camera, field: Field | None) -> _StripeSearch:
        laser_bands = plan_bands(self.rig, camera, field)
        limits = search_range(self.rig.working_range)
        return _StripeSearch(
            laser_bands,
            FrameDetector(self.rig.size_px, laser_bands, self.options.detector, field),
            AssignmentTest(laser_bands, self._triangulator, limits),
        )

    def _search(self, index: int) -> _StripeSearch:
        return self._searches[self.rig.shutter.field_of(index)]

    def _estimate(
        self, candidates: Candidates, assignment: AssignmentTest, has_colour: bool
    ) -> tuple[Measurement, ScanPoints, IntArray]:
        """Return the posture, the labelled points, and the rows of their candidates."""
        # Planes that several lasers agree on.
        subsegments, shapes = candidates.subsegments()
        surfaces = find_surfaces(
            subsegments,
            candidates.pixels,
            len(self.rig.lasers),
            search_range(self.rig.working_range),
            self.rig.focal_px,
        )
        # The target among them, and the posture from its points outside crossing zones.
        stripes = _Stripes(candidates, subsegments, shapes, assignment, has_colour)
        choice = self._choose_target(stripes, surfaces)
        measurement = self._measure_target(stripes, choice)
        other = _as_other_kind(stripes, choice.target, measurement, self.rig.focal_px)
        if self.options.target is TargetKind.AUTO and other is not None:
            surfaces = _with_replaced(choice.surfaces, other)
            changed = choice._replace(surfaces=surfaces, target=other)
            again = self._measure_target(stripes, changed)
            if _is_better(again, measurement):
                choice, measurement = changed, again
        # The kind of surface that every point lies on.
        points, rows = label_candidates(
            candidates,
            subsegments,
            shapes,
            choice.surfaces,
            choice.target,
            measurement,
            self.rig.working_range,
        )
        return measurement, points, rows

    def _choose_target(self, stripes: _Stripes, surfaces: list[Surface]) -> _Choice:
        """Choose the target among the surfaces of the requested kind."""
        choice = self._choose_and_test(stripes, as_requested_kind(surfaces, self.options.target))
        for _ in range(_MAX_RIVALS):
            surfaces, target, _, (verdict, other, _) = choice
            if target is None or verdict is not Verdict.RIVAL or other is None:
                break
            surfaces = self._with_rival(surfaces, target, other, stripes)
            choice = self._choose_and_test(stripes, surfaces)
        return choice

    def _choose_and_test(self, stripes: _Stripes, surfaces: list[Surface]) -> _Choice:
        """Choose the target, and test whether other lasers explain its peaks as well."""
        surfaces, target, overlooked = self._best_target(stripes, surfaces)
        if target is None:
            return _Choice(surfaces)
        candidates, subsegments, _, assignment, _ = stripes
        outcome = assignment.test(candidates, subsegments, target)
        return _Choice(surfaces, target, overlooked, outcome)

    def _best_target(
        self, stripes: _Stripes, surfaces: list[Surface]
    ) -> tuple[list[Surface], Surface | None, Surface | None]:
        """Return the surfaces, the target, and a nearer surface that may be the net instead."""
        kind = self.options.target
        candidates, subsegments, _, assignment, _ = stripes
        target = choose_target(surfaces, kind, self.rig.working_range)
        while target is not None and len(surfaces) > 1:
            if not (
                assignment.may_be_exchanged(subsegments, target)
                or (assignment.fans and assignment.may_be_shifted(subsegments, surfaces, target))
            ):
                break
            surfaces = [one for one in surfaces if one is not target]
            target = choose_target(surfaces, kind, self.rig.working_range)
        if target is None or kind is not TargetKind.AUTO:
            return surfaces, target, None
        nearer = assignment.overlooked(candidates, subsegments, surfaces, target)
        if nearer is None or not nearer.is_mesh:
            return surfaces, target, nearer
        return _with_replaced(surfaces, nearer), nearer, None

    def _measure_target(self, stripes: _Stripes, choice: _Choice) -> Measurement:
        """Return the posture to the target, or the refusal."""
        candidates, subsegments, _, assignment, _ = stripes
        surfaces, target, _, tested = choice
        if target is None:
            missing = _no_target(candidates, surfaces, self.options.target)
            return Measurement.refused(missing, candidates.n)
        refusal = self._refusal(stripes, choice, target)
        if refusal is not None:
            return Measurement.refused(refusal, candidates.n)
        found = inflate_for_rival(self._fit_posture(candidates, subsegments, target), tested)
        # The mean plane of folds covers all of a net's light, nearer parts included.
        nearer = None if found.folded else assignment.nearer_net(subsegments, surfaces, target)
        if nearer is None or not found.posture:
            return found
        return Measurement.refused(_ambiguous(target.plane, nearer.plane), candidates.n)

    def _refusal(self, stripes: _Stripes, choice: _Choice, target: Surface) -> Refusal | None:
        """Return the refusal of a target that is ambiguous or found by chance; else None."""
        candidates, subsegments, _, assignment, _ = stripes
        if choice.overlooked is not None:
            return _ambiguous(target.plane, choice.overlooked.plane)
        if assignment.is_by_chance(candidates, subsegments, choice.surfaces, target):
            detail = "the best plane is small, and lasers that should be seen on it are not"
            return Refusal(Reason.NOT_A_PLANE, detail)
        if not stripes.has_colour and not assignment.is_certain(
            candidates, subsegments, choice.surfaces, target
        ):
            detail = "without colour, the lasers do not show the best plane evenly enough"
            return Refusal(Reason.NOT_A_PLANE, detail)
        if choice.tested.verdict is Verdict.AMBIGUOUS and choice.tested.other is not None:
            return _ambiguous(target.plane, choice.tested.other)
        if assignment.may_be_exchanged(subsegments, target):
            detail = (
                f"two lasers alone show a steep surface at {target.plane.offset:.3f} m, and would "
                "show another if each stripe were the other laser's"
            )
            return Refusal(Reason.AMBIGUOUS, detail)
        others = assignment.other_lines(
            candidates,
            subsegments,
            stripes.shapes,
            choice.surfaces,
            target,
            has_colour=stripes.has_colour,
        )
        if others is not None:
            detail = (
                f"beside the stripes on the surface at {target.plane.offset:.3f} m there is "
                f"{others:.1f} times their light in other lines; does the rig name all lasers?"
            )
            return Refusal(Reason.AMBIGUOUS, detail)
        if self.options.target is TargetKind.AUTO and assignment.may_hide_net(
            candidates, subsegments, stripes.shapes, choice.surfaces, target
        ):
            detail = (
                f"much light in front of the surface at {target.plane.offset:.3f} m lies in no "
                "common plane, as on a net in folds"
            )
            return Refusal(Reason.AMBIGUOUS, detail)
        return None

    def _fit_posture(
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
        surface, weights = _fitted_surface(posture, found.patch, candidates.points, found.weights)
        exposed = self._row_motion.as_exposed(posture, surface, still, candidates, weights)
        return replace(found, posture=exposed)

    def _with_rig_covariance(self, found: Measurement, candidates: Candidates) -> Posture | Refusal:
        """Return the posture with its covariance by the rig's uncertainty."""
        posture = found.posture
        if not isinstance(posture, Posture) or found.weights is None:
            return posture
        surface, weights = _fitted_surface(posture, found.patch, candidates.points, found.weights)
        _, covariance = self._rig_errors.propagate(
            surface, candidates.pixels, candidates.laser, candidates.points, weights
        )
        return replace(posture, rig_covariance=covariance)

    def _with_rival(
        self, surfaces: list[Surface], target: Surface, other: Plane, stripes: _Stripes
    ) -> list[Surface]:
        """Replace a surface by the rival that explains the picture better.

        A net before the rival remains with the light that is not the rival's.
        """
        candidates, subsegments = stripes.candidates, stripes.subsegments
        of_rig = len(self.rig.lasers), self.rig.focal_px
        rival = surface_on(other, subsegments, *of_rig)
        rest = left_over(target, rival, subsegments, candidates.pixels, *of_rig)
        kept = [] if rest is None or not rest.is_mesh else [rest]
        kept += [
            one
            for one in surfaces
            if one is not target and not shares_peaks(one, rival, subsegments)
        ]
        return as_requested_kind([rival, *kept], self.options.target)


def _may_lack_colour(peaks: FramePeaks, scan: Scan) -> bool:
    """Return whether most of the lasers' light may be missing because it has no colour."""
    hardly_any = (
        Reason.NO_STRIPES,
        Reason.TOO_FEW_POINTS,
        Reason.ONE_LASER,
        Reason.COLLINEAR,
        Reason.NOT_A_PLANE,
    )
    # Share of the tall peaks that have the lasers' colour. Of photographs of lines on a wall it is
    # 0.1 to 0.55 if a codec has dropped much of their chroma, else 0.7 and more.
    little = 0.6
    has_little_light = isinstance(scan.posture, Refusal) and scan.posture.reason in hardly_any
    return has_little_light or peaks.coloured_share < little


def _fitted_surface(
    posture: Posture, patch: Patch | None, points: FloatArray, weights: FloatArray
) -> tuple[FittedSurface, FloatArray]:
    """Return the surface of a posture as fitted to points, and their weights for its residuals."""
    m = posture.normal_in_dome / posture.range
    if patch is None:
        return fitted_plane(m, points), weights
    # Heights over a patch are in metres; m·X is relative to the range.
    return fitted_patch(patch, m, points), weights / posture.range**2


def _with_replaced(surfaces: list[Surface], changed: Surface) -> list[Surface]:
    """Return the surfaces with one of them replaced by its changed copy."""
    return [changed if one.members is changed.members else one for one in surfaces]


def _as_other_kind(
    stripes: _Stripes, target: Surface | None, measurement: Measurement, focal_px: float
) -> Surface | None:
    """Return a target as solid, or as a net, if it is likely to be that.

    Noise and codecs break the lines of a dim or overexposed picture as twine does: a net whose
    strands are too few for a posture, or lie in no plane, is solid if it is lit on much of its
    lines. Growth fills the gaps of a net: what has small gaps only, but no long lines either, and
    is rough, is a net.
    """
    if target is None:
        return None
    no_net = (Reason.ONE_LASER, Reason.COLLINEAR, Reason.TOO_FEW_POINTS, Reason.NOT_A_PLANE)
    posture = measurement.posture
    is_no_net = isinstance(posture, Refusal) and posture.reason in no_net
    if target.is_mesh and (is_no_net or measurement.folded):
        is_solid = stripes.assignment.fills_lines(stripes.subsegments, target)
        return replace(target, is_mesh=False) if is_solid else None
    # Points scatter about walls by 0.15 to 0.5 px, in strong sun by 0.8, about grown nets that pass
    # as solid by 0.5 to 1.6.
    rough_px = 0.7
    if posture and posture.rms * focal_px > rough_px * posture.range:
        is_net = not target.is_mesh and not target.is_unbroken
        return replace(target, is_mesh=True) if is_net else None
    return None


def _is_better(again: Measurement, before: Measurement) -> bool:
    """Return whether a target is better measured as of the other kind."""
    if not before.posture:
        return True
    # A rough wall is no net in folds.
    if not again.posture or again.folded:
        return False
    # Ratio of the scatter about a wall to that about the mean plane of what were no folds: 0.1 on
    # overexposed photographs of a wall. Nets in folds, fitted as solid, have 0.4 and more.
    clearly_less = 0.25
    return not before.folded or again.posture.rms < clearly_less * before.posture.rms


def _ambiguous(one: Plane, other: Plane) -> Refusal:
    apart = np.rad2deg(np.arccos(min(float(one.normal @ other.normal), 1.0)))
    detail = (
        f"planes at {one.offset:.3f} m and {other.offset:.3f} m, {apart:.1f} deg apart, explain "
        "the stripes about as well"
    )
    return Refusal(Reason.AMBIGUOUS, detail)


def _no_target(candidates: Candidates, surfaces: list[Surface], wanted: TargetKind) -> Refusal:
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
