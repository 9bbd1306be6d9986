"""The numbers behind the experiments: true points, variants, distances, and the laboratory."""

import numpy as np
import pytest

from aqualvs.experiments.dome_or_not import Distances, _calibrated_without, distances, level_laser
from aqualvs.experiments.laboratory import Laboratory, MeasuredDive, numbers_text
from aqualvs.experiments.mesh_filter import LitTruth, mean_score, score_pixels, score_reflections
from aqualvs.scanning.paper.detector import FilteredPeaks
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.scanning.scan import Scan, ScanPoints
from aqualvs.simulation.scenario import parse_scenario


def stripe(n=20, laser=0, v=100.0):
    """True points of one laser, 4 px apart: the left half on the net, the right half on a wall."""
    u = 50.0 + 4.0 * np.arange(n)
    pixels = np.column_stack([u, np.full(n, v)])
    return LitTruth(pixels, np.full(n, laser, np.int64), np.arange(n) < n // 2)


def test_points_are_judged_by_the_nearest_true_one():
    truth = stripe()
    lasers = np.zeros(20, np.int64)
    assert score_pixels(truth.pixels, lasers, truth) == (0.5, 1.0)
    net = truth.pixels[:10]
    assert score_pixels(net, lasers[:10], truth) == (1.0, 1.0)
    # Every other one: the true ones between lie 4 px off, beyond the 3 that count as found.
    assert score_pixels(net[::2], lasers[:5], truth) == (1.0, 0.5)
    # Of another laser they are not found, and nothing can be judged.
    precision, recall = score_pixels(net, lasers[:10] + 1, truth)
    assert np.isnan(precision)
    assert recall == 0.0


def blobs(kept):
    """Blobs of 3 x 3 pixels every 20 px along one search line, with how many pixels are kept."""
    step = np.arange(3) - 1.0
    offsets = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    centres = np.column_stack([50.0 + 20.0 * np.arange(len(kept)), np.full(len(kept), 100.0)])
    pixels = (centres[:, None] + offsets).reshape(-1, 2)
    on_mesh = (np.arange(9) < np.array(kept)[:, None]).ravel()
    zeros = np.zeros(len(pixels), np.int64)
    return FilteredPeaks(zeros, zeros, pixels, np.zeros((len(pixels), 3)), on_mesh)


def test_reflections_count_as_most_of_their_pixels_do():
    # Two true points 4 px apart in each blob; three on the net, one on a wall.
    u = np.repeat(50.0 + 20.0 * np.arange(4), 2) + np.tile([-2.0, 2.0], 4)
    truth = LitTruth(np.column_stack([u, np.full(8, 100.0)]), np.zeros(8, np.int64), u < 100.0)
    assert score_reflections(blobs([9, 9, 9, 0]), truth) == (1.0, 1.0)
    assert score_reflections(blobs([5, 4, 0, 5]), truth) == (0.5, 1 / 3)
    precision, recall = score_reflections(blobs([4, 4, 4, 4]), truth)
    assert np.isnan(precision)
    assert recall == 0.0
    # One blob of two touching ones is one reflection, though the true points are two.
    joined = blobs([9, 0, 0, 0])
    joined.pixels[9:18] = joined.pixels[:9] + np.array([3.0, 0.0])
    assert score_reflections(joined, truth) == pytest.approx((np.nan, 0.0), nan_ok=True)


def test_the_mean_leaves_out_what_nothing_is_said_of():
    from aqualvs.experiments.mesh_filter import PrecisionRecall

    found = mean_score([PrecisionRecall(1.0, 0.4), PrecisionRecall(np.nan, 0.0)])
    assert found == (1.0, 0.2)


def refused(n=2):
    none = Refusal(Reason.NO_STRIPES)
    scans = [Scan(i, 0.04 * i, none, ScanPoints.none(), 1.333) for i in range(n)]
    return MeasuredDive(scans, np.tile([0.5, 0.0, 0.1], (n, 1)))


def test_frames_without_a_posture_have_no_error():
    one = refused()
    assert one.valid_percent == 0.0
    assert np.isnan(one.rms).all()
    assert numbers_text(one.rms) == "-, -, -"


def test_lines_through_distances():
    true = np.linspace(0.3, 1.2, 10)
    found = np.column_stack([1.02 * true + 0.003] * 4)
    one = Distances(true, found, found, found)
    assert one.line_percent(found, 0) == pytest.approx(one.percent(found)[:, 0])
    assert one.percent(found)[-1, 2] == pytest.approx(2.25)


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """Two frames of a wall, near and far, measured by the true rig."""
    rendered = []
    laboratory = Laboratory(tmp_path_factory.mktemp("tank"), rendered.append)
    motion = {"range_mm": {"values": [350, 500], "mode": "steps"}}
    facts = {"duration_s": 0.08, "motion": motion, "walls": [{}]}
    dive = laboratory.dive(parse_scenario(facts, "near_far", "near_far"))
    return laboratory, dive, laboratory.measure(dive), rendered


def test_a_dive_is_rendered_and_measured_once(seen):
    laboratory, dive, measured, rendered = seen
    assert rendered == [1, 1]
    again = laboratory.dive(dive.scenario)
    assert again == dive
    assert rendered == [1, 1]
    assert laboratory.measure(again) is measured
    assert len(laboratory.frame_s) == 2


def test_the_laboratory_knows_the_truth(seen):
    _, _, measured, _ = seen
    assert measured.valid.all()
    assert measured.truth[:, 0] == pytest.approx([0.35, 0.5])
    # A still wall in clear water: some hundredths of a percent and of a degree.
    assert np.abs(measured.errors[:, 0]).max() < 0.05
    assert np.abs(measured.errors[:, 1:]).max() < 0.2
    assert (measured.sigmas > 0.0).all()


def test_single_points_with_and_without_the_dome(seen):
    laboratory, _, measured, _ = seen
    rig = laboratory.rig
    assert rig.lasers[level_laser(rig)].name == "lower"
    found = distances(measured, rig, level_laser(rig))
    # A single point has its own noise, a tenth of a percent at half a metre.
    assert np.abs(found.percent(found.dome)).max() < 0.5
    assert np.abs(found.percent(found.bare)).max() > 3.0
    assert found.dome[:, 3] == pytest.approx(found.dome[:, :3].mean(axis=1))


def test_a_laser_calibrated_with_straight_rays_is_right_where_it_was_calibrated(seen):
    laboratory, _, _, _ = seen
    rig = laboratory.rig
    camera = rig.bare_camera()
    plane = rig.lasers[0].plane
    # Points where straight rays meet the plane on square walls: then that plane is the answer.
    rays = camera.rays(np.array([[[200.0, 420.0], [360.0, 430.0], [520.0, 440.0]]]))
    points, valid = plane.intersect(rays)
    assert valid.all()
    walls = points[..., 1].ravel()
    each = camera.rays(np.array([[200.0, 420.0], [360.0, 430.0], [520.0, 440.0]])[:, None])
    assert np.all(walls <= 0.65)
    found = _calibrated_without(each, walls)
    again, _ = found.intersect(each)
    assert again[:, 0, 1] == pytest.approx(walls, rel=1e-9)
