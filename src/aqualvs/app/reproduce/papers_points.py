"""Reflections as the paper takes them: above a threshold, divided by laser, mesh-filtered."""

from dataclasses import dataclass

import numpy as np

from aqualvs.app.reproduce.laboratory import Dive, Laboratory
from aqualvs.app.reproduce.point_truth import Judged, LitTruth, judge_pixels
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.optics.rig import Rig
from aqualvs.scanning.mesh import MeshFilterOptions, mesh_filter
from aqualvs.scanning.pipeline import ScannerOptions
from aqualvs.scanning.scan import ScanPoints
from aqualvs.scanning.threshold import ThresholdOptions


@dataclass(frozen=True, slots=True)
class PapersPoints:
    """Middles of bright runs across the stripes of a frame, N of them.

    Attributes
    ----------
    pixels : array, shape (N, 2)
    points_in_dome : array, shape (N, 3)
        In metres.
    laser : int array, shape (N,)
        The paper divides its picture by hand into one area for each laser; here our own
        classification does it, which is better than such areas.
    net : bool array, shape (N,)
        What the paper's filter keeps.
    """

    pixels: FloatArray
    points_in_dome: FloatArray
    laser: IntArray
    net: BoolArray

    def judged(self, truth: LitTruth) -> Judged:
        """Return precision and recall of the points kept."""
        return judge_pixels(self.pixels[self.net], self.laser[self.net], truth)


def papers_points(
    laboratory: Laboratory, dive: Dive, options: MeshFilterOptions
) -> list[PapersPoints]:
    """Return the reflections above the paper's threshold, frame by frame.

    Parameters
    ----------
    laboratory : Laboratory
    dive : Dive
    options : MeshFilterOptions
        Of the filter; by default those of section 5.2.
    """
    bright = laboratory.measure(dive, ScannerOptions(detector=ThresholdOptions()))
    return [_filtered(scan.points, dive.rig, options) for scan in bright.scans]


def _filtered(points: ScanPoints, rig: Rig, options: MeshFilterOptions) -> PapersPoints:
    net = np.zeros(len(points), np.bool_)
    for i, laser in enumerate(rig.lasers):
        mine = points.laser == i
        net[mine] = mesh_filter(
            points.points_in_dome[mine], laser.plane, options, working_range=rig.working_range
        )
    return PapersPoints(points.pixels, points.points_in_dome, points.laser.astype(np.int64), net)
