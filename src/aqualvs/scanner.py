"""The main path: a frame in, posture and points out."""

import threading
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Self

import numpy as np

from aqualvs.errors import FrameError, OptionError, RigError
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import Rig
from aqualvs.optics.rig_covariance import FittedSurface, PostureErrors, fitted_plane
from aqualvs.optics.shutter import Field
from aqualvs.scanning.assignment import AssignmentTest, inflate_for_rival
from aqualvs.scanning.candidates import Candidates, LinkedCandidates, find_candidates
from aqualvs.scanning.detection import DetectorOptions, FrameDetector, FramePeaks
from aqualvs.scanning.labels import label_candidates
from aqualvs.scanning.laser_bands import LaserBand, SearchAxis, plan_bands, search_range
from aqualvs.scanning.patch import fitted_patch
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.posture_estimator import (
    FitMethod,
    Measurement,
    PostureEstimator,
    inflate_for_bend,
)
from aqualvs.scanning.scan import Frame, Scan, ScanPoints
from aqualvs.scanning.stripe import StripeOptions, StripePeaks
from aqualvs.scanning.surfaces import Surface, SurfaceFinder, not_on_others
from aqualvs.scanning.target import TargetChoice, TargetKind, TargetSelector, is_better
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


@dataclass(frozen=True, slots=True)
class _StripeSearch:
    """Search for stripes in whole pictures, or in one field of them."""

    laser_bands: tuple[LaserBand, ...]
    detector: FrameDetector
    targets: TargetSelector


class Scanner:
    """The scanner of one rig: frames in, postures out, each from its frame alone.

    Frames of an interlaced camera are fields (`Shutter.field_of`); their points are in pixels of
    the whole picture, whose camera model holds. A single frame of a rolling shutter hardly shows
    the vehicle's motion: its sigma includes how such vehicles move; `run` uses the frames beside.

    `process` may be called from any thread, but measures one frame at a time; threads that are to
    measure at once need a scanner each. Copies and pickles are made anew of the same arguments.

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
        if not isinstance(rig, Rig):
            raise RigError(
                f"Scanner: rig is {rig!r}; give what aqualvs.load_rig makes of a rig file"
            )
        self.rig = rig
        self.options = options or ScannerOptions()
        self._camera = camera
        # Frames share the buffers of the detectors.
        self._lock = threading.Lock()
        # The rig's own record of its uncertainty; no frame needs it.
        from aqualvs.optics.solved import completed_uncertainty

        camera = camera or rig.camera()
        self._triangulator = Triangulator(rig, camera)
        self._surface_finder = SurfaceFinder(rig)
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

    def __reduce__(self) -> tuple[type[Self], tuple[object, ...]]:
        # Some buffers are views of others; copies of both would part.
        return type(self), (self.rig, self.options, self._camera)

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
        with self._lock:
            scan = self.scan(frame)[1]
        return scan if self._row_motion is None else self._row_motion.correct(scan, ())

    def scan(self, frame: Frame) -> tuple[FramePeaks, Scan]:
        """Return the peaks of a frame and its scan, as the rows are exposed. Raises as `detect`."""
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
        points than any before, or is nearer: a wall may keep its colour behind a net that lost it.
        Else as given.
        """
        finds_stripes = isinstance(self.options.detector, StripeOptions)
        if not (finds_stripes and _may_lack_colour(peaks, scan)):
            return peaks, scan
        by_luma = peaks if frame.chroma is None else self.detect(replace(frame, chroma=None))
        tallest = self._search(frame.index).detector.tallest(by_luma)
        again = self.measure(frame.index, frame.time_s, tallest, has_colour=False)
        n_before = scan.posture.n_points if scan.posture else 0
        many_more, nearer = 1.5, 0.95
        is_better = again.posture and (
            again.posture.n_points > many_more * n_before
            or (scan.posture and again.posture.range < nearer * scan.posture.range)
        )
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
        measurement, points, rows = self._estimate(candidates, search.targets, has_colour)
        if self._paper_filter is not None:
            # The paper's filter needs the laser of each peak, which is known by now.
            kept, laser = np.zeros(candidates.n, np.bool_), points.laser.astype(np.int64)
            found = self._paper_filter.apply(points.pixels, points.width, laser)
            kept[rows] = found.peaks_on_mesh(len(points))
            candidates = candidates.where(kept)
            measurement, points, _ = self._estimate(candidates, search.targets, has_colour)
        posture = self._with_rig_covariance(measurement, candidates)
        return Scan(index, time_s, posture, points, self.rig.n_water)

    def _make_search(self, camera: Camera, field: Field | None) -> _StripeSearch:
        laser_bands = plan_bands(self.rig, camera, field)
        limits = search_range(self.rig.working_range)
        assignment = AssignmentTest(laser_bands, self._triangulator, limits)
        return _StripeSearch(
            laser_bands,
            FrameDetector(self.rig.size_px, laser_bands, self.options.detector, field),
            TargetSelector(self.rig, self.options.target, assignment, self._surface_finder),
        )

    def _search(self, index: int) -> _StripeSearch:
        return self._searches[self.rig.shutter.field_of(index)]

    def _estimate(
        self, candidates: Candidates, targets: TargetSelector, has_colour: bool
    ) -> tuple[Measurement, ScanPoints, IntArray]:
        """Return the posture, the labelled points, and the rows of their candidates."""
        # Planes that several lasers agree on.
        linked = candidates.linked()
        surfaces = self._surface_finder.find(linked)
        # The target among them, and the posture from its points outside crossing zones.
        choice = targets.choose(linked, surfaces)
        measurement = self._measure_target(linked, choice, targets, has_colour)
        other = targets.as_other_kind(linked, choice, measurement)
        if other is not None:
            again = self._measure_target(linked, other, targets, has_colour)
            if is_better(again, measurement):
                choice, measurement = other, again
        # The kind of surface that every point lies on.
        points, rows = label_candidates(
            linked, choice.surfaces, choice.target, measurement, self.rig.working_range
        )
        return measurement, points, rows

    def _measure_target(
        self,
        linked: LinkedCandidates,
        choice: TargetChoice,
        targets: TargetSelector,
        has_colour: bool,
    ) -> Measurement:
        """Return the posture to the target, or the refusal."""
        target = targets.accept(linked, choice, has_colour=has_colour)
        if isinstance(target, Refusal):
            return Measurement.refused(target, linked.candidates.n)
        free = None
        if target.is_mesh and targets.has_fan:
            # One of many lasers places light of any other surface beside the net: no folds of it.
            source, subsegments = linked.candidates.source, linked.subsegments
            free = not_on_others(source, subsegments, choice.surfaces, target)
        if free is None:
            found = self._fit_posture(linked, target)
        else:
            found = self._fit_posture(linked.where(free), target).among(free)
        found = inflate_for_bend(inflate_for_rival(found, choice.tested), linked, target)
        # The mean plane of folds covers all of a net's light, nearer parts included.
        nearer = None if found.folded else targets.contradiction(linked, choice.surfaces, target)
        if nearer is None or not found.posture:
            return found
        return Measurement.refused(nearer, linked.candidates.n)

    def _fit_posture(self, linked: LinkedCandidates, target: Surface) -> Measurement:
        """Return the posture to the target, as the rows of the picture show it."""
        candidates, subsegments, _ = linked
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
    posture: Posture, patch: FloatArray | None, points: FloatArray, weights: FloatArray
) -> tuple[FittedSurface, FloatArray]:
    """Return the surface of a posture as fitted to points, and their weights for its residuals."""
    m = posture.normal_in_dome / posture.range
    if patch is None:
        return fitted_plane(m, points), weights
    # Heights over a patch are in metres; m·X is relative to the range.
    return fitted_patch(patch, m, points), weights / posture.range**2
