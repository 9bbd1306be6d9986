"""The paper's filter behind the detectors: every bright pixel a point, or one centre a return."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.optics.rig import Rig
from aqualvs.scanner import Scanner, ScannerOptions
from aqualvs.scanning.laser_bands import plan_bands
from aqualvs.scanning.paper.detector import FilteredPeaks, PaperFilter
from aqualvs.scanning.paper.mesh_filter import MeshFilterOptions, mesh_filter_dense
from aqualvs.scanning.scan import Frame
from aqualvs.scanning.stripe import ThresholdOptions
from aqualvs.scanning.triangulate import Triangulator
from aqualvs.simulation.scenarios import example_rig

RANGE = 0.643
LEVEL_ONLY = ScannerOptions(detector=ThresholdOptions(), mesh_filter=MeshFilterOptions())


@pytest.fixture(scope="module")
def rig() -> Rig:
    """Of one laser, so that every bright pixel is known to be its."""
    rig = example_rig()
    return replace(rig, lasers=rig.lasers[:1])


@pytest.fixture(scope="module")
def picture(rig: Rig) -> FloatArray:
    """Reflections every 25 mm on a plane square ahead, 5 x 3 pixels each."""
    plane = rig.lasers[0].plane
    x = 0.025 * np.arange(-6, 7)
    z = (plane.offset - plane.normal[0] * x - plane.normal[1] * RANGE) / plane.normal[2]
    points = np.column_stack([x, np.full(len(x), RANGE), z])
    luma = np.full((576, 720), 40, np.uint8)
    for u, v in np.rint(rig.camera().project(points)[0]).astype(int):
        luma[v - 1 : v + 2, u - 2 : u + 3] = 200
    return luma


def kept_by_reference(rig: Rig, luma: FloatArray) -> BoolArray:
    """Algorithm 1, line by line, on the pixels that NumPy finds; where they are in the picture."""
    v, u = np.nonzero(luma >= 140)
    pixels, zeros = np.column_stack([u, v]).astype(float), np.zeros(len(u), np.int64)
    points = Triangulator(rig, rig.camera()).triangulate(pixels, zeros, zeros).points_in_dome
    plane = rig.lasers[0].plane
    kept = np.zeros(luma.shape, np.bool_)
    kept[v, u] = mesh_filter_dense(points, plane, working_range=rig.working_range)
    return kept


def filtered(rig: Rig, luma: FloatArray, *, every_pixel: bool) -> tuple[FilteredPeaks, int]:
    camera = rig.camera()
    scanner = Scanner(rig, replace(LEVEL_ONLY, mesh_filter=None))
    points = scanner.process(Frame(0, 0.0, luma)).points
    laser_bands = plan_bands(rig, camera)
    papers = PaperFilter(rig, camera, laser_bands, MeshFilterOptions(), every_pixel=every_pixel)
    laser = points.laser.astype(np.int64)
    return papers.apply(points.pixels, points.width, laser), len(points)


def test_every_bright_pixel_is_a_point(rig: Rig, picture: FloatArray) -> None:
    found, _ = filtered(rig, picture, every_pixel=True)
    u, v = found.pixels.astype(int).T
    seen = np.zeros(picture.shape, np.int64)
    np.add.at(seen, (v, u), 1)
    np.testing.assert_array_equal(seen, picture >= 140)
    reference = kept_by_reference(rig, picture)
    np.testing.assert_array_equal(found.on_mesh, reference[v, u])
    # With section 5.2's parameters: all but the outermost, which have one neighbour.
    assert 0.7 * 13 * 15 < reference.sum() < 12 * 15
    distance = rig.lasers[0].plane.signed_distance(found.points_in_dome)
    np.testing.assert_allclose(distance, 0.0, atol=1e-12)


def test_a_return_is_kept_if_most_of_its_pixels_are(rig: Rig, picture: FloatArray) -> None:
    found, n = filtered(rig, picture, every_pixel=True)
    share = np.bincount(found.source, found.on_mesh) / np.bincount(found.source)
    assert len(share) == n
    np.testing.assert_array_equal(found.peaks_on_mesh(n), share > 0.5)
    scan = Scanner(rig, LEVEL_ONLY).process(Frame(0, 0.0, picture))
    assert len(scan.points) == np.count_nonzero(share > 0.5) > 30
    assert (scan.points.width == 3.0).all()


def test_sub_pixel_returns_are_one_point_each(rig: Rig, picture: FloatArray) -> None:
    found, n = filtered(rig, picture, every_pixel=False)
    np.testing.assert_array_equal(found.source, np.arange(n))
    assert n == 13 * 5
    # Five cells of one row are less than half of dg_theta.
    assert not found.on_mesh.any()


def test_nothing_in_gives_nothing(rig: Rig) -> None:
    scan = Scanner(rig, LEVEL_ONLY).process(Frame(0, 0.0, np.zeros((576, 720), np.uint8)))
    assert not scan.posture
    assert len(scan.points) == 0
