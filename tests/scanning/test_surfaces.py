"""Surfaces: which planes several lasers agree on, and which of them is the target."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Rig
from aqualvs.scanning.candidates import Candidates, find_candidates
from aqualvs.scanning.laser_bands import SearchAxis, plan_bands
from aqualvs.scanning.stripe import StripePeaks
from aqualvs.scanning.surfaces import Surface, SurfaceFinder
from aqualvs.scanning.target import TargetKind, choose_target
from aqualvs.scanning.triangulate import Triangulator
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig
from scanning_cases import Lit, everywhere, peaks_of, strands

NOISE_PX = 0.15


def plane(distance: float, pitch: float = 0.0, yaw: float = 0.0) -> Plane:
    normal = np.array([np.tan(np.deg2rad(yaw)), 1.0, np.tan(np.deg2rad(pitch))])
    return Plane(normal / np.linalg.norm(normal), distance)


def behind_strands(points: FloatArray) -> BoolArray:
    """The wall behind: what a net lets through, its shadow grown by half."""
    lit: BoolArray = (points[:, 0] + points[:, 2] + 0.002) % 0.04 > 0.012
    return lit


def right_half(points: FloatArray) -> BoolArray:
    lit: BoolArray = points[:, 0] > 0.02
    return lit


def left_half(points: FloatArray) -> BoolArray:
    return ~right_half(points)


def surfaces_of(
    rig: Rig, targets: Sequence[tuple[Plane, Lit]], noise_px: float = NOISE_PX
) -> tuple[list[Surface], Candidates, IntArray]:
    camera = rig.camera()
    candidates = find_candidates(
        peaks_of(rig, targets, noise_px), plan_bands(rig, camera), Triangulator(rig, camera)
    )
    linked = candidates.linked()
    return SurfaceFinder(rig).find(linked), candidates, linked.subsegments.of_candidate


def assert_near(found: Plane, expected: Plane, share: float = 0.01, deg: float = 1.5) -> None:
    assert abs(found.offset / expected.offset - 1.0) < share
    assert np.rad2deg(np.arccos(min(1.0, float(found.normal @ expected.normal)))) < deg


def binned(make_rig: Callable[[], Rig]) -> Rig:
    """Pixels of the returns are made for search lines one pixel wide."""
    rig = make_rig()
    return rig if rig.size_px[0] < 1280 else replace(rig, size_px=(1278, 1080))


@pytest.mark.parametrize("make_rig", [example_rig, bluerov2_rig])
@pytest.mark.parametrize(
    "target", [plane(0.35), plane(0.6, 15.0, -20.0), plane(0.9, -10.0, 12.0)], ids=str
)
def test_a_wall_alone(make_rig: Callable[[], Rig], target: Plane) -> None:
    rig = binned(make_rig)
    found, candidates, index = surfaces_of(rig, [(target, everywhere)])
    assert len(found) >= 1
    first = found[0]
    assert_near(first.plane, target)
    assert not first.is_mesh
    assert first.plane.offset > 0.0
    on_it = first.members[index]
    right = np.abs(target.signed_distance(candidates.points)) < 0.01 * target.offset
    # Nearly all right readings belong to it, and hardly a wrong one.
    assert np.mean(on_it[right]) > 0.95
    assert np.mean(right[on_it]) > 0.97
    assert choose(found, TargetKind.AUTO) is first
    assert choose(found, TargetKind.SOLID) is first
    assert choose(found, TargetKind.NET) is None


@pytest.mark.parametrize("target", [plane(0.4), plane(0.55, -8.0, 14.0)], ids=str)
def test_a_net_alone(target: Plane) -> None:
    found, *_ = surfaces_of(example_rig(), [(target, strands)])
    net = choose(found, TargetKind.NET)
    assert net is not None
    assert net.is_mesh
    assert_near(net.plane, target)
    assert choose(found, TargetKind.AUTO) is net


@pytest.mark.parametrize("gap", [0.25, 0.4])
def test_a_net_before_a_wall_is_the_target_though_the_wall_shows_more(gap: float) -> None:
    net, wall = plane(0.45, 3.0, -6.0), plane(0.45 + gap, 0.0, 4.0)
    found, *_ = surfaces_of(example_rig(), [(net, strands), (wall, behind_strands)])
    target = choose(found, TargetKind.AUTO)
    assert target is not None
    assert_near(target.plane, net)
    assert choose(found, TargetKind.NET) is target
    solid = choose(found, TargetKind.SOLID)
    assert solid is not None
    assert_near(solid.plane, wall)
    assert solid.n_lines > target.n_lines


def test_two_faces_of_a_box_are_two_surfaces() -> None:
    left, right = plane(0.45, 0.0, 25.0), plane(0.5, 0.0, -25.0)
    found, *_ = surfaces_of(example_rig(), [(left, left_half), (right, right_half)])
    yaws = [np.rad2deg(np.arctan2(s.plane.normal[0], s.plane.normal[1])) for s in found[:2]]
    np.testing.assert_allclose(sorted(yaws), [-25.0, 25.0], atol=2.0)
    # No light belongs to both.
    assert not np.any(found[0].members & found[1].members)


def test_the_same_readings_give_the_same_surfaces() -> None:
    net, wall = plane(0.45, 3.0, -6.0), plane(0.8, 0.0, 4.0)
    one, other = (
        surfaces_of(example_rig(), [(net, strands), (wall, behind_strands)])[0] for _ in range(2)
    )
    assert len(one) == len(other) > 1
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.plane.normal, b.plane.normal)
        assert a.plane.offset == b.plane.offset
        np.testing.assert_array_equal(a.members, b.members)


def test_one_laser_gives_no_surface() -> None:
    rig = example_rig()
    single = replace(rig, lasers=rig.lasers[:1])
    found, candidates, _ = surfaces_of(single, [(plane(0.5), everywhere)])
    assert candidates.n > 300
    assert found == []
    assert choose(found, TargetKind.AUTO) is None


def test_two_lasers_are_enough() -> None:
    rig = example_rig()
    target = plane(0.5, 6.0, -9.0)
    pair = replace(rig, lasers=rig.lasers[:2])
    found, *_ = surfaces_of(pair, [(target, everywhere)])
    assert_near(found[0].plane, target)


def test_nothing_gives_no_surface() -> None:
    def nowhere(points: FloatArray) -> BoolArray:
        return np.zeros(len(points), np.bool_)

    found, candidates, _ = surfaces_of(example_rig(), [(plane(0.5), nowhere)])
    assert candidates.n == 0
    assert found == []


def near_strands(points: FloatArray) -> BoolArray:
    """Thick twine so near that 4 cm are lit, and 1 cm is not."""
    lit: BoolArray = (points[:, 0] + 0.6 * points[:, 2]) % 0.05 < 0.04
    return lit


def seen_in_gaps(points: FloatArray) -> BoolArray:
    lit: BoolArray = (points[:, 0] + 0.6 * points[:, 2]) % 0.03 < 0.01
    return lit


def test_a_near_net_that_fills_the_stripes_is_a_net() -> None:
    """Nothing is seen through the gaps of a wall."""
    behind = (plane(0.9), seen_in_gaps)
    found, _, _ = surfaces_of(example_rig(), [(plane(0.35), near_strands), behind])
    front = min(found, key=lambda surface: surface.plane.offset)
    assert_near(front.plane, plane(0.35))
    assert front.is_mesh
    alone, _, _ = surfaces_of(example_rig(), [(plane(0.35), near_strands)])
    assert not alone[0].is_mesh


def test_scattered_light_gives_no_surface_worth_a_target() -> None:
    """Marine snow: returns anywhere, as many as a wall's."""
    rig = example_rig()
    rng = np.random.default_rng(5)
    peaks = {}
    for axis in SearchAxis:
        length, n_lines = rig.size_px if axis is SearchAxis.ALONG_X else rig.size_px[::-1]
        line = np.sort(rng.integers(0, n_lines, 300))
        peaks[axis] = StripePeaks(
            line=line,
            position=rng.uniform(10.0, length - 10.0, 300),
            height=np.full(300, 30.0),
            width=np.full(300, 4.0),
            likelihood=np.full(300, 10.0),
            pull=np.zeros(300),
        )
    camera = rig.camera()
    candidates = find_candidates(peaks, plan_bands(rig, camera), Triangulator(rig, camera))
    found = SurfaceFinder(rig).find(candidates.linked())
    # Chance puts some specks on a plane, never a fifth of them.
    assert all(surface.n_lines < 0.2 * candidates.n for surface in found)


def choose(
    found: Sequence[Surface], kind: TargetKind, working_range: tuple[float, float] = (0.3, 1.0)
) -> Surface | None:
    return choose_target(found, kind, working_range)


def surface(offset: float, inlier_weight: float, is_mesh: bool, extent: float = 300.0) -> Surface:
    return Surface(
        plane=plane(offset),
        members=np.ones(4, np.bool_),
        n_lines=int(inlier_weight),
        inlier_weight=inlier_weight,
        sampling_weight=inlier_weight,
        extent=extent,
        is_mesh=is_mesh,
    )


def test_specks_that_reach_farther_than_an_unbroken_wall_has_gaps_are_no_net() -> None:
    wall = surface(0.61, 1588, False, extent=0.0)
    specks, net = surface(0.35, 130, True, extent=68.0), surface(0.35, 130, True, extent=1400.0)
    assert choose([wall, specks], TargetKind.AUTO) is wall
    assert choose([wall, net], TargetKind.AUTO) is net


def test_a_walls_light_is_no_measure_of_the_net_that_shadows_it() -> None:
    wall = replace(surface(0.8, 400, True, extent=1200.0), is_unbroken=True)
    net, specks = surface(0.6, 130, True, extent=1500.0), surface(0.4, 40, True, extent=1300.0)
    assert choose([wall, net, specks], TargetKind.AUTO) is net
    # What has nothing but strands is one.
    assert choose([replace(wall, is_unbroken=False), net], TargetKind.AUTO) is not net


def test_which_of_several_is_the_target() -> None:
    net, far_net = surface(0.5, 200, True), surface(0.9, 400, True)
    wall, box = surface(0.9, 900, False), surface(0.4, 300, False)
    assert choose([wall, box, net], TargetKind.AUTO) is net
    assert choose([wall, box, net], TargetKind.SOLID) is wall
    assert choose([far_net, net], TargetKind.AUTO) is net
    assert choose([box, wall], TargetKind.AUTO) is wall
    assert choose([box, wall], TargetKind.NET) is None
    assert choose([net], TargetKind.SOLID) is None
    # Left-overs that look like a mesh are no net.
    crumbs = surface(0.3, 20, True)
    assert choose([wall, crumbs], TargetKind.AUTO) is wall
    # A small mesh before a wide one is not the net.
    fish = surface(0.35, 150, True, extent=60.0)
    assert choose([net, fish], TargetKind.AUTO) is net
    assert choose([], TargetKind.AUTO) is None
    # What lies outside the working range is only taken where there is nothing inside.
    assert choose([wall, net], TargetKind.AUTO, (0.7, 1.0)) is wall
    assert choose([wall, net], TargetKind.AUTO, (0.1, 0.2)) is net


def test_a_net_with_most_light_may_be_half_hidden_by_a_fish() -> None:
    net, wall = surface(0.47, 570, True, extent=1218.0), surface(0.95, 540, True, extent=1728.0)
    assert choose([net, wall], TargetKind.AUTO) is net
    assert choose([replace(net, sampling_weight=500), wall], TargetKind.AUTO) is wall


def test_specks_on_a_plane_are_no_net_before_a_wall_of_light() -> None:
    """Caustics: a few dozen lines share a plane by chance, beside a wall's thousand."""
    wall = surface(0.6, 1200.0, False, extent=1400.0)
    specks = replace(surface(0.45, 84.0, True, extent=350.0), sampling_weight=400.0)
    assert choose([wall, specks], TargetKind.AUTO) is wall
    # A sparse net reaches far, and a near one has more light.
    sparse = replace(specks, extent=950.0)
    near = replace(surface(0.45, 190.0, True, extent=350.0), sampling_weight=400.0)
    assert choose([wall, sparse], TargetKind.AUTO) is sparse
    assert choose([wall, near], TargetKind.AUTO) is near


def test_a_few_intervals_beside_a_net_are_no_net() -> None:
    """With too few intervals on each laser to be seen as broken, a mesh has no extent."""
    wall, net = surface(0.96, 1066.0, False, extent=0.0), surface(0.51, 330.0, False, extent=1373.0)
    few = surface(0.31, 150.0, True, extent=0.0)
    assert choose([wall, net, few], TargetKind.AUTO) is wall
    # Of a net far away no more is seen.
    behind = surface(1.2, 200.0, False, extent=0.0)
    assert choose([few, behind], TargetKind.AUTO) is few


def test_light_far_behind_a_plane_is_not_on_it_however_far_a_pixel_moves_it() -> None:
    """Read as the wrong laser's, a neighbour's light lies where rays are parallel to the sheet."""
    wall = plane(0.5)
    rig, camera = example_rig(), example_rig().camera()
    subsegments = (
        find_candidates(
            peaks_of(rig, [(wall, everywhere)], NOISE_PX),
            plan_bands(rig, camera),
            Triangulator(rig, camera),
        )
        .linked()
        .subsegments
    )
    last = subsegments.n - 1
    table = subsegments.table.copy()
    place = table[:3, last].copy()
    # At 20 m, where a pixel is worth a kilometre.
    table[:3, last], table[3:6, last] = 40.0 * place, 40.0**2 * place
    far = subsegments._replace(table=table)
    assert SurfaceFinder(rig).on_plane(subsegments, wall).members[last]
    assert not SurfaceFinder(rig).on_plane(far, wall).members[last]
