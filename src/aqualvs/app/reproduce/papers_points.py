"""Points as the paper's filter takes them, and reflections that either filter keeps."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from aqualvs.app.reproduce.laboratory import Dive, Laboratory
from aqualvs.geometry.arrays import BoolArray
from aqualvs.optics.rig import Rig
from aqualvs.scanning.mesh import MeshFilterOptions
from aqualvs.scanning.paper_filter import FilteredPoints, PaperFilter
from aqualvs.scanning.pipeline import ScannerOptions
from aqualvs.scanning.scan import Label, Scan
from aqualvs.scanning.search import plan_searches
from aqualvs.scanning.threshold import ThresholdOptions


def papers_pixels(
    laboratory: Laboratory, dive: Dive, options: MeshFilterOptions, level: int | None = None
) -> list[FilteredPoints]:
    """Return the bright pixels of every frame, and what the paper's filter keeps of them.

    The paper divides its picture by hand into one area for each laser; here our own classification
    does it, which is better than such areas.

    Parameters
    ----------
    laboratory : Laboratory
    dive : Dive
    options : MeshFilterOptions
        Of the filter; by default those of section 5.2.
    level : int, optional
        Of the threshold, in grey levels.
    """
    detector = ThresholdOptions() if level is None else ThresholdOptions(level=level)
    scans = laboratory.measure(dive, ScannerOptions(detector=detector)).scans
    return filtered_points(scans, dive.rig, options, every_pixel=True)


def papers_centres(
    laboratory: Laboratory, dive: Dive, options: MeshFilterOptions
) -> list[FilteredPoints]:
    """Return the pixels of every frame, on the mesh where the paper's filter keeps their return.

    The filter is given one point for each sub-pixel return, as the paper does not do it.
    """
    scans = laboratory.measure(dive).scans
    centres = filtered_points(scans, dive.rig, options, every_pixel=False)
    return _pixels(scans, dive.rig, [one.on_mesh for one in centres])


def adaptive_pixels(scans: Sequence[Scan], rig: Rig) -> list[FilteredPoints]:
    """Return the pixels of scans, on the mesh where their return is labelled net."""
    return _pixels(scans, rig, [np.asarray(scan.points.label == Label.NET) for scan in scans])


def filtered_points(
    scans: Sequence[Scan], rig: Rig, options: MeshFilterOptions, *, every_pixel: bool
) -> list[FilteredPoints]:
    """Return the points of scans, and what the paper's filter keeps of them."""
    camera = rig.camera()
    searches = plan_searches(rig, camera)
    papers = PaperFilter(rig, camera, searches, options, every_pixel=every_pixel)
    return [
        papers.apply(scan.points.pixels, scan.points.width, scan.points.laser.astype(np.int64))
        for scan in scans
    ]


def _pixels(scans: Sequence[Scan], rig: Rig, kept: Sequence[BoolArray]) -> list[FilteredPoints]:
    found = filtered_points(scans, rig, MeshFilterOptions(), every_pixel=True)
    return [replace(one, on_mesh=mine[one.source]) for one, mine in zip(found, kept, strict=True)]
