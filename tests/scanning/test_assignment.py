"""Which laser made which stripe: rivals, light that is missing, planes by chance."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.planes import Plane, exchanged_plane
from aqualvs.scanner import Scanner, ScannerOptions
from aqualvs.scanning import assignment
from aqualvs.scanning.assignment import NOT_TESTED, AssignmentOutcome, Verdict, inflate_for_rival
from aqualvs.scanning.assignment_kernels import (
    CELL_LINES,
    FREEDOM,
    INTENSITY_WEIGHT,
    N_MEASURES,
    PER_LASER,
    VARIANCE,
    judge_planes,
)
from aqualvs.scanning.candidates import find_candidates
from aqualvs.scanning.laser_bands import SearchAxis, plan_bands, sample_bands
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.posture_estimator import Measurement
from aqualvs.scanning.stripe import StripePeaks
from aqualvs.scanning.surfaces import Surface, SurfaceFinder
from aqualvs.scanning.target import TargetKind
from aqualvs.scanning.triangulate import Triangulator
from aqualvs.simulation.scenarios import example_rig
from fan_cases import Fan, Stage, Trouble, fan_rig, miscalibrated
from scanning_cases import Lit, everywhere, peaks_of, strands

FAN = Fan()
FAR_FAN = Fan(baseline=(0.2, 0.0, 0.02), aim_deg=-10.0)
FEW = Fan(n_lines=3, spacing_deg=8.0, baseline=(0.15, 0.0, 0.0), aim_deg=-8.0)
EASY = Trouble(p_dim=0.0, p_off=0.0, missing=0.05)
EDGES = Trouble(n_edges=8, n_glints=60)
STRANDS = Trouble(strands=True, missing=0.2, n_glints=40)
WALL = Plane.from_normal((0.1, 1.0, -0.05), 0.6)


class RunSummary(NamedTuple):
    """Random walls before a fan: how many are measured, and how many wrongly by over 5 %."""

    valid: int
    wrong: int


def summary(fan: Fan, trouble: Trouble, own_deg: float) -> RunSummary:
    rig, valid, wrong = fan_rig(fan), 0, 0
    for case in range(2):
        told = miscalibrated(rig, np.random.default_rng([5, case]), own_deg=own_deg)
        stage, scanner = Stage(told, fan, rig), Scanner(told)
        for k in range(4):
            scene = stage.scene(np.random.default_rng([9, case, k]), trouble)
            found = scanner.measure(0, 0.0, scene.peaks).posture
            if isinstance(found, Posture):
                valid += 1
                wrong += abs(found.range / scene.plane.offset - 1.0) > 0.05
    return RunSummary(valid, wrong)


def untested(*_: object) -> AssignmentOutcome:
    return NOT_TESTED


def measured(fan: Fan, trouble: Trouble) -> Posture | Refusal:
    stage = Stage(fan_rig(fan), fan)
    scene = stage.scene_of(np.random.default_rng(3), trouble, WALL)
    return Scanner(stage.rig).measure(0, 0.0, scene.peaks).posture


CASES = {
    "gaps": (FAN, Trouble(missing=0.5, p_dim=0.3, p_off=0.1)),
    "edges": (FAN, EDGES),
    "far strands": (FAR_FAN, STRANDS),
    "far edges": (FAR_FAN, EDGES),
}


@pytest.mark.parametrize("case", CASES)
def test_no_stripe_of_a_fan_is_taken_for_its_neighbours(case: str) -> None:
    found = summary(*CASES[case], own_deg=0.02)
    assert found.wrong == 0
    # Measured: all eight; one may be refused as ambiguous.
    assert found.valid >= 7


def test_without_the_test_of_rivals_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(assignment.AssignmentTest, "test", untested)
    assert summary(FAR_FAN, STRANDS, own_deg=0.02).wrong >= 2


def test_lines_that_might_be_their_neighbours_are_ambiguous() -> None:
    """Two lines of three: they might be the other two on a nearer or farther wall."""
    found = measured(FEW, EASY._replace(n_dark_end=1))
    assert isinstance(found, Refusal)
    assert found.reason is Reason.AMBIGUOUS
    assert found.detail.endswith("explain the stripes about as well")
    assert measured(FEW, EASY)


@pytest.mark.parametrize("distance", [0.6, 2.6, 3.4])
def test_a_wall_out_of_range_is_not_read_as_the_next_lasers(distance: float) -> None:
    """The third stripe of the far wall lies where no laser of three is searched for."""
    fan = Fan(n_lines=3, spacing_deg=12.0, baseline=(-0.16, 0.0, 0.0), aim_deg=14.0, roll_deg=0.0)
    rig, wall = fan_rig(fan, (0.25, 1.3)), Plane.from_normal((0.1, 1.0, 0.05), distance)
    found = Scanner(rig).measure(0, 0.0, peaks_of(rig, [(wall, everywhere)], 0.1)).posture
    if distance < rig.working_range[1]:
        assert isinstance(found, Posture)
        assert found.range == pytest.approx(wall.offset, rel=0.01)
    else:
        assert isinstance(found, Refusal)
        assert found.reason is Reason.AMBIGUOUS
        # Lines of sight do not quite meet the camera's centre.
        beyond = float(found.detail.split()[5])
        assert beyond == pytest.approx(wall.offset, rel=0.02)


def test_light_that_must_be_there_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the count of dark lasers and of foreign light, only residuals are left."""
    fan = Fan(n_lines=5, spacing_deg=2.0)
    assert measured(fan, EASY)
    odds = assignment._ODDS._replace(dark_laser=0.0, foreign_stripe=0.0, max_freedom=0.0)
    monkeypatch.setattr(assignment, "_ODDS", odds)
    assert not measured(fan, EASY)


def test_residuals_tell_a_fan_with_a_dark_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sines that are evenly spaced are no tangents: a shifted fan leaves residuals."""
    trouble = EASY._replace(n_dark_end=1)
    found = measured(FAN, trouble)
    assert isinstance(found, Posture)
    assert found.range == pytest.approx(WALL.offset, rel=0.01)
    monkeypatch.setattr(assignment, "_ODDS", assignment._ODDS._replace(max_freedom=0.0))
    assert not measured(FAN, trouble)


def posture(distance: float, yaw: float) -> Posture:
    return Posture(
        range=distance,
        pitch=0.0,
        yaw=yaw,
        covariance=np.diag([1e-6, 1e-6, 1e-6]),
        normal_in_dome=np.array([0.0, 1.0, 0.0]),
        slant_range=distance,
        nearest=distance,
        n_points=100,
        rms=1e-3,
    )


def test_two_bright_stripes_do_not_outweigh_three_that_are_left_over() -> None:
    """A plane of two lasers leaves over 1.6 stripes of five lasers, not one of its brighter two."""
    five = measures(light=277.0, n_lasers=5, freedom=7.0)
    two = measures(light=189.0, n_lasers=2, freedom=1.0)
    planes = np.array([[0.0, 1.0, 0.0, 0.67], [0.0, 0.94, -0.34, 0.37]])
    assert assignment._verdict(planes, np.array([five, two])) == NOT_TESTED
    assert assignment._log_odds(five, two) == -assignment._log_odds(two, five)


def measures(*, light: float, n_lasers: int, freedom: float) -> FloatArray:
    found = np.zeros(N_MEASURES)
    found[[INTENSITY_WEIGHT, PER_LASER]] = light, light / n_lasers
    found[[VARIANCE, FREEDOM]] = 0.08, freedom
    return found


def test_a_stripe_that_crosses_a_rival_is_none_of_its_stripes() -> None:
    """Two upright stripes that cross, each read as the other's, and a level one."""
    normals = [(-0.96, -0.235, -0.16), (0.96, -0.265, 0.0), (0.0, -0.21, 0.98)]
    sheets = [Plane(n / np.linalg.norm(n), -0.1285) for n in np.array(normals)]
    rig = example_rig()
    lasers = [replace(one, plane=sheet) for one, sheet in zip(rig.lasers, sheets, strict=True)]
    rig, wall = replace(rig, lasers=tuple(lasers)), Plane.from_normal((0.3, 1.0, 0.0), 0.5)
    rival = exchanged_plane(wall, *sheets[:2])
    assert rival is not None
    bands = plan_bands(rig, rig.camera())
    triangulator = Triangulator(rig, rig.camera())
    candidates = find_candidates(peaks_of(rig, [(wall, everywhere)]), bands, triangulator)
    subsegments = candidates.linked().subsegments
    found = np.empty((2, N_MEASURES))
    judge_planes(
        np.stack([wall.packed(), rival.packed()]),
        candidates,
        subsegments,
        np.array([one.axis is SearchAxis.ALONG_X for one in bands]),
        sample_bands(bands, triangulator, CELL_LINES),
        found,
    )
    np.testing.assert_allclose(found[:, INTENSITY_WEIGHT] / found[:, PER_LASER], [3.0, 2.0])


def test_a_better_plane_is_tested_in_its_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the search missed the wall, its first rival may be read as other lasers' as well."""
    rig = example_rig()
    wall = Plane.from_normal((0.0, 1.0, 0.1), 0.6)
    missed = Plane.from_normal((0.0, 1.0, 0.1), 0.604)
    tested: list[float] = []

    def outcome(_: object, *arguments: object) -> AssignmentOutcome:
        target = arguments[-1]
        assert isinstance(target, Surface)
        tested.append(target.plane.offset)
        other = (missed, wall, None)[len(tested) - 1]
        return NOT_TESTED if other is None else AssignmentOutcome(Verdict.RIVAL, other)

    monkeypatch.setattr(assignment.AssignmentTest, "test", outcome)
    posture = Scanner(rig).measure(0, 0.0, peaks_of(rig, [(wall, everywhere)], 0.1)).posture
    assert tested[1:] == [missed.offset, wall.offset]
    assert isinstance(posture, Posture)
    assert posture.range == pytest.approx(wall.offset, rel=1e-3)


def test_a_near_rival_widens_and_a_far_one_does_not() -> None:
    found = Measurement(posture(0.6, 0.0), np.ones(1, np.bool_))
    other = Plane.from_normal((np.tan(0.02), 1.0, 0.0), 0.606 / np.cos(0.02))
    near = inflate_for_rival(found, AssignmentOutcome(Verdict.NEAR, other, 0.0)).posture
    assert isinstance(near, Posture)
    # Even odds: half of the squared distance between the two.
    assert near.covariance[2, 2] == pytest.approx(1e-6 + 0.5 * 0.02**2)
    assert near.range == 0.6
    assert inflate_for_rival(found, NOT_TESTED) is found


def small(points: FloatArray) -> BoolArray:
    """Light on a flank of 8 cm, where two of the example rig's stripes cross at 0.95 m."""
    lit: BoolArray = np.hypot(points[:, 0] - 0.085, points[:, 2] + 0.172) < 0.04
    return lit


def test_a_flank_that_one_laser_misses_is_no_wall() -> None:
    rig, flank = example_rig(), Plane.from_normal((0.0, 1.0, 0.0), 0.95)
    scanner = Scanner(rig, ScannerOptions(target=TargetKind.SOLID))
    found = scanner.measure(0, 0.0, peaks_of(rig, [(flank, small)], 0.1)).posture
    assert isinstance(found, Refusal)
    assert found.reason is Reason.NOT_A_PLANE
    assert "lasers that should be seen on it are not" in found.detail
    assert scanner.measure(0, 0.0, peaks_of(rig, [(flank, everywhere)], 0.1)).posture


def planks(points: FloatArray) -> BoolArray:
    """Planks of 3 to 9 cm by the stripe's direction, and specks of texture between them."""
    place = (points[:, 0] + 0.4 * points[:, 2]) % 0.1
    lit: BoolArray = (place < 0.034) | ((place > 0.036) & ((place - 0.036) % 0.0056 < 0.0024))
    return lit


def test_a_table_with_gaps_is_solid_where_something_solid_is_asked_for() -> None:
    rig = example_rig()
    peaks = peaks_of(rig, [(Plane.from_normal((0.1, 1.0, 0.0), 0.6), planks)], 0.1)
    labels = {}
    for kind in (TargetKind.AUTO, TargetKind.SOLID):
        scan = Scanner(rig, ScannerOptions(target=kind)).measure(0, 0.0, peaks)
        assert isinstance(scan.posture, Posture), scan.posture
        assert scan.posture.range == pytest.approx(0.6 / np.hypot(0.1, 1.0), rel=2e-3)
        labels[kind] = np.bincount(scan.points.label, minlength=2)
    assert labels[TargetKind.AUTO][0] > labels[TargetKind.AUTO][1]
    assert labels[TargetKind.SOLID][1] > labels[TargetKind.SOLID][0]


def nearer_strands(points: FloatArray) -> BoolArray:
    return strands(points) & (points[:, 0] < 0.0)


def farther_strands(points: FloatArray) -> BoolArray:
    return strands(points) & (points[:, 0] > 0.0)


def joined(parts: list[dict[SearchAxis, StripePeaks]]) -> dict[SearchAxis, StripePeaks]:
    """Returns of several parts of a scene, in the order that detection gives."""
    found = {}
    for axis in SearchAxis:
        mine = [part[axis] for part in parts if axis in part]
        if mine:
            rows = [np.concatenate(column) for column in zip(*map(columns, mine), strict=True)]
            order = np.lexsort((rows[1], rows[0]))
            found[axis] = StripePeaks(*(row[order] for row in rows))
    return found


def columns(part: StripePeaks) -> tuple[FloatArray, ...]:
    return part.line, part.position, part.height, part.width, part.likelihood, part.pull


def test_a_net_that_lacks_a_laser_is_outweighed_by_a_nearer_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each plane lacks a laser that lights the other one: which of them is the net?"""
    rig = example_rig()
    first, second, third = rig.lasers
    near, far = (Plane.from_normal((0.1 * k, 1.0, 0.0), 0.5 + 0.12 * k) for k in range(2))
    parts = [
        peaks_of(replace(rig, lasers=(second, third)), [(near, nearer_strands)], 0.1),
        peaks_of(replace(rig, lasers=(first, second)), [(far, farther_strands)], 0.1),
    ]
    camera = rig.camera()
    laser_bands, triangulator = plan_bands(rig, camera), Triangulator(rig, camera)
    test = assignment.AssignmentTest(laser_bands, triangulator, rig.working_range)

    def nearer_net(
        parts: list[dict[SearchAxis, StripePeaks]], *, share: float = 1.0, mesh: bool = True
    ) -> bool:
        subsegments = find_candidates(joined(parts), laser_bands, triangulator).linked().subsegments
        target, other = (SurfaceFinder(rig).on_plane(subsegments, one) for one in (far, near))
        target = replace(target, is_mesh=True)
        other = replace(other, is_mesh=mesh, sampling_weight=share * target.sampling_weight)
        assert test.nearer_net(subsegments, [target, other], other) is None
        return test.nearer_net(subsegments, [target, other], target) is other

    assert nearer_net(parts)
    # Not by less light, by something solid, or where every laser is on the net.
    assert not nearer_net(parts, share=0.9)
    assert not nearer_net(parts, mesh=False)
    net_mask = peaks_of(rig, [(far, strands)], 0.1)
    assert not nearer_net([parts[0], net_mask])
    scanner, peaks = Scanner(rig), joined(parts)
    subsegments = find_candidates(peaks, laser_bands, triangulator).linked().subsegments
    other = SurfaceFinder(rig).on_plane(subsegments, near)
    assert scanner.measure(0, 0.0, peaks).posture
    monkeypatch.setattr(assignment.AssignmentTest, "nearer_net", lambda *_: other)
    refused = scanner.measure(0, 0.0, peaks).posture
    assert isinstance(refused, Refusal)
    assert refused.reason is Reason.AMBIGUOUS


def slanted_strands(points: FloatArray) -> BoolArray:
    """Light on every laser's stripe, whichever way it runs."""
    lit: BoolArray = (points[:, 0] + 0.4 * points[:, 2]) % 0.03 < 0.006
    return lit


def every(one_of: int) -> Lit:
    """Light on one in so many of the slanted strands."""

    def lit(points: FloatArray) -> BoolArray:
        number = (points[:, 0] + 0.4 * points[:, 2]) // 0.03
        on: BoolArray = slanted_strands(points) & (number % one_of == 0)
        return on

    return lit


def few_strands(points: FloatArray) -> BoolArray:
    lit: BoolArray = (points[:, 0] + 0.4 * points[:, 2]) % 0.15 < 0.03
    return lit


def test_strands_that_make_a_plane_by_chance_are_no_net() -> None:
    """In daylight without lasers: few pieces of strands, or strands along two of the sheets."""
    rig = example_rig()
    net = Plane.from_normal((0.1, 1.0, 0.0), 0.5)
    laser_bands, triangulator = plan_bands(rig, rig.camera()), Triangulator(rig, rig.camera())
    test = assignment.AssignmentTest(laser_bands, triangulator, rig.working_range)
    elsewhere = [((0.4, 1.0, 0.2), 0.7), ((-0.3, 1.0, 0.2), 0.8), ((0.1, 1.0, 0.2), 0.4)]
    elsewhere += [((-0.2, 1.0, -0.3), 0.6), ((0.3, 1.0, -0.2), 0.9), ((0.0, 1.0, 0.3), 0.7)]
    loose = [
        peaks_of(replace(rig, lasers=(laser,)), [(Plane.from_normal(*plane), slanted_strands)], 0.1)
        for laser, plane in zip(2 * rig.lasers, elsewhere, strict=True)
    ]

    def is_chance(*strands_of: int | None, net: Plane = net, height: float = 1.0) -> bool:
        """Whether each laser's light on every so many strands is; None: on all its way.

        Its peaks have this share of the height of others.
        """

        seen = [everywhere if one_of is None else every(one_of) for one_of in strands_of]
        of_net = [
            peaks_of(replace(rig, lasers=(laser,)), [(net, lit)], 0.1)
            for laser, lit in zip(rig.lasers, seen, strict=False)
        ]
        low = [
            {axis: one._replace(height=height * one.height) for axis, one in peaks.items()}
            for peaks in of_net
        ]
        linked = find_candidates(joined([*low, *loose]), laser_bands, triangulator).linked()
        subsegments = linked.subsegments
        target = replace(SurfaceFinder(rig).on_plane(subsegments, net), is_mesh=True)
        return test.is_by_chance(linked, [target], target)

    # A third of the light, and an eighth of it on few strands.
    assert not is_chance(1, 1, 1)
    assert is_chance(3, 3, 3)
    # A twentieth of the light is too little, on however many strands.
    assert not is_chance(1, 1, 1, height=1 / 16)
    assert is_chance(1, 1, 1, height=1 / 100)
    # A dark laser: on strands across the stripes, and along one of them.
    assert not is_chance(1, 1)
    assert not is_chance(2, 2)
    assert is_chance(None, 1)
    assert not is_chance(None, 1, 1)
    # With most of the light it is what is seen.
    assert not is_chance(None, None)
    # Planes by chance are steep: the same light is one there.
    steep = Plane.from_normal((0.7, 1.0, 0.7), 0.5)
    assert not is_chance(1, 1, net=steep)
    assert is_chance(2, 2, net=steep)


@pytest.mark.parametrize(("one_of", "is_chance"), [(1, False), (2, True)])
def test_two_lasers_show_any_plane_evenly(one_of: int, is_chance: bool) -> None:
    """A plane of two lasers with little of the light is not saved by lasers that are not dark."""
    rig = example_rig()
    rig = replace(rig, lasers=rig.lasers[:2])
    laser_bands, triangulator = plan_bands(rig, rig.camera()), Triangulator(rig, rig.camera())
    test = assignment.AssignmentTest(laser_bands, triangulator, rig.working_range)
    net = Plane.from_normal((0.1, 1.0, 0.0), 0.5)
    parts = [peaks_of(rig, [(net, every(one_of))], 0.1)]
    for x, z, distance in [(0.4, 0.2, 0.7), (-0.3, 0.2, 0.8), (0.1, 0.2, 0.4), (-0.2, -0.3, 0.6)]:
        for laser in rig.lasers:
            elsewhere = Plane.from_normal((x + 0.1 * (laser is rig.lasers[0]), 1.0, z), distance)
            parts.append(
                peaks_of(replace(rig, lasers=(laser,)), [(elsewhere, slanted_strands)], 0.1)
            )
    linked = find_candidates(joined(parts), laser_bands, triangulator).linked()
    subsegments = linked.subsegments
    target = replace(SurfaceFinder(rig).on_plane(subsegments, net), is_mesh=True)
    assert test.is_by_chance(linked, [target], target) is is_chance


def test_a_net_before_a_wall_is_not_overlooked(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = example_rig()
    net, wall = Plane.from_normal((0.1, 1.0, 0.0), 0.4), Plane.from_normal((0.0, 1.0, 0.1), 0.8)
    behind = peaks_of(rig, [(wall, everywhere)], 0.1)
    camera = rig.camera()
    laser_bands, triangulator = plan_bands(rig, camera), Triangulator(rig, camera)
    test = assignment.AssignmentTest(laser_bands, triangulator, rig.working_range)

    def overlooked(
        part: dict[SearchAxis, StripePeaks], *, mesh: bool = True, wall_is_mesh: bool = False
    ) -> Surface | None:
        linked = find_candidates(joined([part, behind]), laser_bands, triangulator).linked()
        subsegments = linked.subsegments
        near, far = (SurfaceFinder(rig).on_plane(subsegments, one) for one in (net, wall))
        near, far = replace(near, is_mesh=mesh), replace(far, is_mesh=wall_is_mesh)
        assert test.overlooked(linked, [far, near], near) is None
        return test.overlooked(linked, [far, near], far)

    seen = peaks_of(rig, [(net, slanted_strands)], 0.1)
    found = overlooked(seen)
    assert found is not None
    assert found.is_mesh
    assert found.plane.offset == net.offset
    # Nor is a coarse one, too few of whose strands are lit to give it an extent.
    few = overlooked(peaks_of(rig, [(net, few_strands)], 0.1))
    assert few is not None
    assert few.extent == 0.0
    # It need not have the pattern of one, if the wall is seen through it.
    dense = overlooked(seen, mesh=False)
    assert dense is not None
    assert dense.is_mesh
    # Not a plate, and not what one laser alone shows.
    assert overlooked(peaks_of(rig, [(net, everywhere)], 0.1), mesh=False) is None
    assert (
        overlooked(peaks_of(replace(rig, lasers=rig.lasers[:1]), [(net, slanted_strands)])) is None
    )
    # The wall in its shadows may look broken, and has long stretches all the same.
    assert overlooked(seen, wall_is_mesh=True) is not None
    scanner, peaks = Scanner(rig), joined([seen, behind])
    monkeypatch.setattr("aqualvs.scanning.target.choose_target", lambda surfaces, *_: surfaces[0])
    posture = scanner.measure(0, 0.0, peaks).posture
    assert isinstance(posture, Posture)
    assert posture.range == pytest.approx(0.4 / np.hypot(0.1, 1.0), rel=2e-3)
    monkeypatch.setattr(
        assignment.AssignmentTest, "overlooked", lambda *_: replace(found, is_mesh=False)
    )
    refused = scanner.measure(0, 0.0, peaks).posture
    assert isinstance(refused, Refusal)
    assert refused.reason is Reason.AMBIGUOUS


def between_strands(points: FloatArray) -> BoolArray:
    """What is visible between strands half as far away."""
    lit: BoolArray = ~strands(0.5 * points)
    return lit


@pytest.mark.parametrize("share", [1.0, 0.4])
def test_a_net_before_a_wall_that_its_shadows_break_is_not_overlooked(share: float) -> None:
    """Unless it is much narrower than the wall, as a fish is."""
    rig = example_rig()
    net, wall = Plane.from_normal((0.0, 1.0, 0.0), 0.4), Plane.from_normal((0.0, 1.0, 0.0), 0.8)
    camera = rig.camera()
    laser_bands, triangulator = plan_bands(rig, camera), Triangulator(rig, camera)
    seen = [peaks_of(rig, [one], 0.1) for one in ((net, strands), (wall, between_strands))]
    linked = find_candidates(joined(seen), laser_bands, triangulator).linked()
    subsegments = linked.subsegments
    near, far = (SurfaceFinder(rig).on_plane(subsegments, one) for one in (net, wall))
    far = replace(far, is_mesh=True, is_unbroken=False, extent=near.extent)
    near = replace(near, extent=share * near.extent)
    test = assignment.AssignmentTest(laser_bands, triangulator, rig.working_range)
    found = test.overlooked(linked, [far, near], far)
    assert (found is not None) == (share == 1.0)


def fish(points: FloatArray) -> BoolArray:
    """Light on a flank of 24 by 8 cm, where two of the stripes cross at 0.75 m."""
    lit: BoolArray = (abs(points[:, 0] - 0.069) < 0.12) & (abs(points[:, 2] - 0.121) < 0.04)
    return lit


def test_a_fish_before_a_wall_out_of_range_is_no_wall() -> None:
    """Not even a large one: the wall has more light, and a laser passes the fish."""
    rig = example_rig()
    flank, wall = (Plane.from_normal((0.0, 1.0, 0.0), d) for d in (0.75, 1.25))
    two = peaks_of(replace(rig, lasers=rig.lasers[:2]), [(flank, fish)], 0.1)
    scanner = Scanner(rig)
    assert scanner.measure(0, 0.0, two).posture
    found = scanner.measure(0, 0.0, joined([two, peaks_of(rig, [(wall, everywhere)], 0.1)])).posture
    assert isinstance(found, Refusal)
    assert found.reason is Reason.NOT_A_PLANE
