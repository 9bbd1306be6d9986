"""Labels: every return once, and what each was found to be."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.scanning.candidates import Candidates, LinkedCandidates, Subsegments, find_candidates
from aqualvs.scanning.labels import label_candidates
from aqualvs.scanning.laser_bands import SearchAxis, plan_bands
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.scanning.posture_estimator import Measurement
from aqualvs.scanning.scan import Label, ScanPoints
from aqualvs.scanning.segments import ComponentShapes
from aqualvs.scanning.stripe import StripePeaks
from aqualvs.scanning.surfaces import Surface, SurfaceFinder
from aqualvs.scanning.triangulate import Triangulator
from aqualvs.simulation.scenarios import example_rig
from scanning_cases import Lit, behind_strands, everywhere, peaks_of, strands

NET = Plane.from_normal([-0.1, 1.0, 0.05], 0.45)
NONE = Refusal(Reason.COLLINEAR)
RANGE = (0.3, 1.0)
SHORT = (0.3, 0.46)
WALL = Plane.from_normal([0.07, 1.0, 0.0], 0.8)


class Labelled(NamedTuple):
    peaks: dict[SearchAxis, StripePeaks]
    candidates: Candidates
    subsegments: Subsegments
    shapes: ComponentShapes
    surfaces: list[Surface]
    points: ScanPoints


def label(targets: Sequence[tuple[Plane, Lit]], posture_to: Plane | None) -> Labelled:
    """Label the light on some targets; the posture rests on all that lies on one of them."""
    rig = example_rig()
    camera = rig.camera()
    peaks = peaks_of(rig, targets, 0.1)
    candidates = find_candidates(peaks, plan_bands(rig, camera), Triangulator(rig, camera))
    linked = candidates.linked()
    subsegments = linked.subsegments
    surfaces = SurfaceFinder(rig).find(linked)
    target = None
    in_posture = np.zeros(candidates.n, np.bool_)
    if posture_to is not None:
        offsets = [abs(one.plane.offset - posture_to.offset) for one in surfaces]
        target = surfaces[int(np.argmin(offsets))]
        in_posture = target.members[subsegments.of_candidate]
    found = Measurement(NONE, in_posture)
    points, _ = label_candidates(linked, surfaces, target, found, RANGE)
    return Labelled(peaks, *linked, surfaces, points)


def all_pixels(peaks: dict[SearchAxis, StripePeaks]) -> FloatArray:
    along_x, along_y = peaks[SearchAxis.ALONG_X], peaks[SearchAxis.ALONG_Y]
    return np.concatenate(
        [
            np.stack([along_x.position, along_x.line], axis=-1),
            np.stack([along_y.line, along_y.position], axis=-1),
        ]
    )


def times_seen(points: ScanPoints) -> IntArray:
    """How often each of the points' pixels is among them."""
    _, inverse, counts = np.unique(points.pixels, axis=0, return_inverse=True, return_counts=True)
    times: IntArray = counts[inverse.ravel()]
    return times


def test_light_on_the_target_is_labelled_once_with_its_laser() -> None:
    found = label([(WALL, everywhere)], WALL)
    points = found.points
    on_target = points.used
    assert np.all(times_seen(points)[on_target] == 1)
    off = np.abs(WALL.signed_distance(points.points_in_dome[on_target]))
    assert np.percentile(off, 99) < 0.005
    n_peaks = len(all_pixels(found.peaks))
    assert np.count_nonzero(on_target) > 0.95 * n_peaks
    assert np.all(np.diff(points.laser) >= 0)


def test_no_return_is_lost() -> None:
    found = label([(NET, strands), (WALL, behind_strands)], NET)
    missing = 0
    for pixel in all_pixels(found.peaks):
        gap = np.abs(found.points.pixels - pixel).max(axis=1).min()
        # What another reading of the same light explains is left out: within two cells of 6 px.
        missing += gap > 12.0
    # Long segments that no laser could have made are dropped before.
    assert missing < 0.02 * len(all_pixels(found.peaks))


def test_the_wall_behind_the_net_is_background() -> None:
    found = label([(NET, strands), (WALL, behind_strands)], NET)
    points = found.points
    on_wall = np.abs(WALL.signed_distance(points.points_in_dome)) < 0.004
    on_net = np.abs(NET.signed_distance(points.points_in_dome)) < 0.003
    assert np.mean(points.label[on_net & ~on_wall] == Label.NET) > 0.98
    assert np.mean(points.label[on_wall & ~on_net] == Label.BACKGROUND) > 0.9


def test_a_net_before_the_wall_that_is_the_target_stays_a_net() -> None:
    points = label([(NET, strands), (WALL, behind_strands)], WALL).points
    on_wall = np.abs(WALL.signed_distance(points.points_in_dome)) < 0.004
    on_net = np.abs(NET.signed_distance(points.points_in_dome)) < 0.003
    assert np.mean(points.label[on_net & ~on_wall] == Label.NET) > 0.9
    assert np.mean(points.label[on_wall & ~on_net] == Label.SOLID) > 0.9


def test_without_a_target_nothing_is_used() -> None:
    found = label([(WALL, everywhere)], None)
    assert len(found.surfaces) >= 1
    assert not np.any(found.points.used)
    assert np.mean(found.points.label == Label.SOLID) > 0.9


def test_what_the_posture_left_out_of_its_target_is_still_on_it() -> None:
    found = label([(WALL, everywhere)], WALL)
    target = found.surfaces[0]
    on_it = target.members[found.subsegments.of_candidate]
    left_out = on_it & (found.candidates.pixels[:, 1] < 200.0)
    points, _ = label_candidates(
        LinkedCandidates(found.candidates, found.subsegments, found.shapes),
        found.surfaces,
        target,
        Measurement(NONE, on_it & ~left_out),
        RANGE,
    )
    assert np.count_nonzero(left_out) > 50
    assert np.count_nonzero((points.label == Label.SOLID) & ~points.used) >= np.count_nonzero(
        left_out
    )
    assert not np.any(points.used & (points.pixels[:, 1] < 200.0))


def test_short_pieces_that_nothing_explains_are_clutter_or_ambiguous() -> None:
    found = label([(NET, strands)], None)
    points, _ = label_candidates(
        LinkedCandidates(found.candidates, found.subsegments, found.shapes),
        [],
        None,
        Measurement(NONE, np.zeros(found.candidates.n, np.bool_)),
        SHORT,
    )
    assert len(points) == found.candidates.n
    several = times_seen(points) > 1
    assert np.all(points.label[several] == Label.AMBIGUOUS)
    distance = np.linalg.norm(points.points_in_dome, axis=1)
    outside = distance > SHORT[1]
    far = points.label == Label.OUT_OF_RANGE
    assert far.any()
    assert np.all(outside[far])
    assert not np.any(outside & (points.label == Label.CLUTTER))
    # One laser runs along a lit band: long and straight, as on something solid.
    assert np.all(np.isin(points.label[~several & ~far], (Label.CLUTTER, Label.SOLID)))
    assert np.mean(points.label[~several & ~far] == Label.CLUTTER) > 0.4
    assert several.any()
    assert (~several).any()


def test_sigma_and_quality_follow_from_the_returns() -> None:
    points = label([(WALL, everywhere)], WALL).points
    assert np.all(points.sigma > 0.0)
    assert np.all((points.quality > 0.0) & (points.quality <= 1.0))
    np.testing.assert_array_equal(points.intensity, 80.0)
    np.testing.assert_array_equal(points.width, 5.0)
    for name in ("laser", "pixels", "points_in_dome", "sigma", "quality", "label"):
        assert len(getattr(points, name)) == len(points)


def test_no_readings() -> None:
    def nowhere(points: FloatArray) -> BoolArray:
        return np.zeros(len(points), np.bool_)

    points = label([(WALL, nowhere)], None).points
    assert len(points) == 0
    assert points.points_in_dome.shape == (0, 3)
