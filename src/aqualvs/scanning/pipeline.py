"""The main path: a frame in, posture and points out."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from aqualvs.geometry.arrays import BoolArray, IntArray
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import Rig
from aqualvs.scanning.detection import DetectorOptions, FrameDetector
from aqualvs.scanning.labels import crossing_zone, label_readings
from aqualvs.scanning.mesh import MeshFilterOptions, mesh_filter
from aqualvs.scanning.plane_fit import PlaneFit, fit_pseudo_inverse, fit_robust
from aqualvs.scanning.posture import Posture, Reason, Refusal, posture_from_fit
from aqualvs.scanning.readings import Readings, read_returns
from aqualvs.scanning.scan import Frame, Scan
from aqualvs.scanning.search import plan_searches
from aqualvs.scanning.stripe import StripeOptions
from aqualvs.scanning.surfaces import Surface, TargetKind, choose_target, find_surfaces
from aqualvs.scanning.triangulate import Triangulator

_MIN_LINES = 30


class FitMethod(StrEnum):
    """How the plane is fitted to the target's points."""

    ROBUST = "robust"
    """Weighted by each point's uncertainty, outliers rejected."""
    PSEUDO_INVERSE = "pseudo_inverse"
    """The paper's Eq. 24, for comparison: all points alike."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScannerOptions:
    """What a user may choose; the defaults need no tuning.

    Attributes
    ----------
    detector : StripeOptions or ThresholdOptions
        Which stripe detector, and how.
    mesh_filter : MeshFilterOptions or None
        The paper's mesh filter in front of the search for surfaces; off by default.
    target : TargetKind
        What the posture is measured to.
    fit : FitMethod
        How the plane is fitted.
    """

    detector: DetectorOptions = field(default_factory=StripeOptions)
    mesh_filter: MeshFilterOptions | None = None
    target: TargetKind = TargetKind.AUTO
    fit: FitMethod = FitMethod.ROBUST


class Scanner:
    """Turns frames into postures; a frame's answer depends on nothing but the frame.

    Parameters
    ----------
    rig : Rig
        Camera, housing, water and lasers.
    options : ScannerOptions, optional
        Defaults if left out.
    camera : Camera, optional
        In place of `rig.camera()`, such as `rig.bare_camera()` to see what ignoring the dome costs.
    """

    def __init__(
        self, rig: Rig, options: ScannerOptions | None = None, camera: Camera | None = None
    ) -> None:
        self.rig = rig
        self.options = options or ScannerOptions()
        camera = camera or rig.camera()
        self._searches = plan_searches(rig, camera)
        self._detector = FrameDetector(rig.size_px, self._searches, self.options.detector)
        self._triangulator = Triangulator(rig, camera)
        self._planes = np.array([[*one.plane.normal, one.plane.offset] for one in rig.lasers])
        self._axis_in_dome = rig.dome_from_cam.rotate([0.0, 0.0, 1.0])
        # Angles shrink by the water's index behind a centred dome hardly at all; a rough scale.
        self._focal_px = max(rig.lens.fx, rig.lens.fy)

    def process(self, frame: Frame) -> Scan:
        """Measure the posture in one frame.

        Parameters
        ----------
        frame : Frame
            Of the rig's image size.

        Returns
        -------
        Scan
            Posture or refusal, and every stripe point with its label.

        Raises
        ------
        ValueError
            If the frame has another size than the rig's image.
        """
        # Sub-pixel returns along the search lines, within the lasers' bands.
        returns = self._detector.detect(frame)
        # Each return read as a point of every laser that could have made it.
        readings = self._filtered(read_returns(returns, self._searches, self._triangulator))
        # Planes that several lasers agree on, and the one that is the target.
        chunks, chunk_index = readings.chunks()
        surfaces = find_surfaces(
            chunks,
            chunk_index,
            readings.pixels,
            len(self.rig.lasers),
            self._search_range(),
            self._focal_px,
        )
        target = choose_target(surfaces, self.options.target)
        # The posture from the target's points outside crossing zones.
        posture, in_posture = self._measure(readings, chunk_index, target, surfaces)
        points = label_readings(readings, chunk_index, surfaces, target, in_posture)
        return Scan(frame.index, frame.time_s, posture, points, self.rig.n_water)

    def _search_range(self) -> tuple[float, float]:
        """Wider than the working range, so that a target beyond it is named as such."""
        near, far = self.rig.working_range
        return 0.8 * near, 1.2 * far

    def _filtered(self, readings: Readings) -> Readings:
        if self.options.mesh_filter is None or not len(readings):
            return readings
        kept = np.zeros(len(readings), np.bool_)
        for i, laser in enumerate(self.rig.lasers):
            mine = readings.laser == i
            kept[mine] = mesh_filter(
                readings.points[mine],
                laser.plane,
                self.options.mesh_filter,
                working_range=self.rig.working_range,
            )
        return readings.where(kept)

    def _measure(
        self,
        readings: Readings,
        chunk_index: IntArray,
        target: Surface | None,
        surfaces: list[Surface],
    ) -> tuple[Posture | Refusal, BoolArray]:
        nothing = np.zeros(len(readings), np.bool_)
        if target is None:
            return _why_no_target(readings, surfaces, self.options.target), nothing
        on_target = target.members[chunk_index]
        if target.is_mesh:
            # All the light on a strand: a part of it would have its centre off the sheet.
            on_target = np.isin(readings.stretch, readings.stretch[on_target])
        on_target &= ~crossing_zone(readings, self._planes, self._focal_px, on_target)
        selected = readings.where(on_target)
        if len(selected) < _MIN_LINES:
            return Refusal(Reason.TOO_FEW_POINTS, "too few points outside crossings"), nothing
        fit, unit = self._fit(selected, target)
        if fit is None:
            return Refusal(Reason.COLLINEAR, "the points do not fix a plane"), nothing
        used = fit.weights[unit] > 0.0
        posture = posture_from_fit(
            fit,
            selected.points[used],
            camera_axis_in_dome=self._axis_in_dome,
            working_range=self.rig.working_range,
        )
        in_posture = nothing
        in_posture[np.flatnonzero(on_target)[used]] = bool(posture)
        return posture, in_posture

    def _fit(self, selected: Readings, target: Surface) -> tuple[PlaneFit | None, IntArray]:
        """Fit the plane; also tell which observation of the fit each reading belongs to."""
        # On a net a stretch is one strand, whose light has one centre; on a wall a chunk is enough
        # for errors to be independent.
        pieces = selected.stretch if target.is_mesh else selected.chunk
        groups, index = np.unique(pieces, return_inverse=True)
        seen = selected.observations(index, len(groups), target.plane.normal)
        robust = fit_robust(
            seen.points,
            seen.sensitivity,
            seen.sigma_px,
            seen.laser,
            target.plane.normal / target.plane.offset,
        )
        if robust is None or self.options.fit is FitMethod.ROBUST:
            return robust, index
        paper = fit_pseudo_inverse(selected.points, robust.covariance)
        return paper, np.arange(len(selected))


def _why_no_target(readings: Readings, surfaces: list[Surface], wanted: TargetKind) -> Refusal:
    if not len(readings):
        return Refusal(Reason.NO_STRIPES, "no laser stripe in the picture")
    if surfaces:
        return Refusal(Reason.NO_TARGET, f"surfaces in view, but none of kind {wanted.value}")
    if len(readings) < _MIN_LINES:
        return Refusal(Reason.TOO_FEW_POINTS, f"only {len(readings)} stripe points")
    if len(np.unique(readings.laser)) < 2:
        return Refusal(Reason.ONE_LASER, "stripes of one laser only")
    return Refusal(Reason.NOT_A_PLANE, f"{len(readings)} stripe points share no plane")
