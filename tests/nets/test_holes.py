"""Strands seen and missed, and the map of holes, from made-up views of ideal nets."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.nets.dashes import Dashes, Gaps, NetView
from aqualvs.nets.hole_candidates import LASERS, Looks, Strands, find_discs, predicted_strands
from aqualvs.nets.holes import Hole, HoleMap, opening_area
from aqualvs.nets.lattice import NetLattice
from aqualvs.nets.spectrum import Mesh

BAR, HALF = 0.025, 0.2
NET = NetLattice(Mesh.FOUR_SIDED, BAR, 1e-4, np.eye(2) / BAR, 5.0)


def _dark(view: NetView, strands: Strands, which: BoolArray) -> NetView:
    """Return a view in which some strands that were seen are dark."""
    rows, gaps = [], view.gaps
    for i in range(2):
        mine = gaps.laser == i
        ends, closed = gaps.ends[mine], gaps.closed[mine]
        strand = 0.5 * (ends[:-1, 1] + ends[1:, 0])
        gone = strands.along[which & (strands.laser == i)]
        kept = np.array([np.abs(gone - m).min(initial=1.0) > 2e-3 for m in strand])
        first, last = np.r_[True, kept], np.r_[kept, True]
        rows.append(
            np.c_[
                np.full(first.sum(), i),
                ends[first, 0],
                ends[last, 1],
                closed[first, 0],
                closed[last, 1],
                np.zeros(first.sum()),
            ]
        )
    return replace(view, gaps=_gaps(np.concatenate(rows)))


def _gaps(table: FloatArray) -> Gaps:
    return Gaps(table[:, 0].astype(int), table[:, 1:3].copy(), table[:, 3:5] == 1.0, table[:, 5])


def view_at(
    foot: FloatArray,
    index: int = 0,
    *,
    hole: tuple[float, float, float] | None = None,
    beyond: float = 0.0,
    lost: FloatArray | None = None,
) -> NetView:
    """What two lasers, one level and one upright, show of a square net around a place on it.

    A hole lets the share `beyond` of the light through, as the openings do. Of the strands those
    for which `lost` (as many as both lines may cross) says so are dark.
    """
    direction = np.eye(2)
    rows: list[tuple[float, ...]] = []
    for i, t in enumerate(direction):
        start = float(foot @ t)
        number = np.arange(np.ceil((start - HALF) / BAR), (start + HALF) / BAR)
        s = number * BAR - start
        place = foot + s[:, None] * t
        there = np.ones(len(s), np.bool_)
        if hole is not None:
            there &= np.hypot(*(place - hole[:2]).T) > hole[2]
        if lost is not None:
            there &= ~lost[20 * i : 20 * i + len(s)]
        low, high = s[there] - 1e-3, s[there] + 1e-3
        edges = np.r_[-HALF, np.stack([low, high], axis=1).ravel(), HALF].reshape(-1, 2)
        last = len(edges) - 1
        for k, ends in enumerate(edges):
            rows.append((i, *ends, k > 0, k < last, beyond))
    table = np.array(rows)
    none = np.empty(0)
    return NetView(
        index=index,
        time_s=index / 25.0,
        range=0.5,
        origin=np.zeros((2, 2)),
        direction=direction,
        search=direction[::-1],
        pixel=6e-4,
        step=np.full(2, 6e-4),
        beyond=np.full(2, 0.8 if beyond else 0.0),
        dashes=Dashes(
            none.astype(int), none, np.empty((0, 2)), none, none, none, none.astype(bool)
        ),
        gaps=_gaps(table),
        span_laser=np.arange(2),
        span=np.tile([-HALF, HALF], (2, 1)),
    )


def strands_at(foot: FloatArray, view: NetView) -> Strands:
    """Of a view from a foot on the net, one of whose knots lies at the origin."""
    return predicted_strands(NET, view, -foot)


def passing(
    holes: HoleMap,
    n: int = 60,
    step: float = 8e-3,
    first: int = 0,
    up: float = 0.0,
    **options: object,
) -> None:
    """Pass a net on a slant from its origin, two steps right for one up."""
    for i in range(first, first + n):
        foot = i * step * np.array([1.0, 0.5]) + [0.0, up]
        holes.add(NET, view_at(foot, i, **options), -foot, foot, 0)
    holes.update(NET)


def passed(**options: object) -> list[Hole]:
    """Holes found on a pass."""
    holes = HoleMap()
    passing(holes, **options)
    return holes.holes


@pytest.mark.parametrize("foot", [np.zeros(2), np.array([0.013, 0.4])])
def test_strands_of_a_sound_net_are_all_seen(foot: FloatArray) -> None:
    strands = strands_at(foot, view_at(foot))
    # Those at the very ends of the lines may be cut off.
    assert 2 * 15 <= len(strands.missed) <= 2 * 17
    assert not strands.missed.any()
    knots = (strands.place + foot) / BAR
    np.testing.assert_allclose(np.abs(knots - np.rint(knots)).min(axis=1), 0.0, atol=1e-9)
    at = strands.along[:, None] * np.eye(2)[strands.laser]
    np.testing.assert_allclose(strands.place, at, atol=1e-12)


def test_strands_are_missed_where_the_hole_is() -> None:
    strands = strands_at(np.zeros(2), view_at(np.zeros(2), hole=(0.0, 0.0, 0.06)))
    away = np.hypot(*strands.place.T)
    np.testing.assert_array_equal(strands.missed, away < 0.06)
    # Five on each line, in one dark piece between strands.
    assert set(strands.run[strands.missed]) == {5}
    assert strands.closed[strands.missed].all()
    assert set(strands.run[~strands.missed]) == {0}


def test_a_lattice_that_lies_elsewhere_misses_strands() -> None:
    view = view_at(np.zeros(2))
    assert predicted_strands(NET, view, np.full(2, 0.5 * BAR)).missed.mean() > 0.9
    assert not predicted_strands(NET, view, np.full(2, 0.1 * BAR)).missed.any()


def test_openings_of_hexagons_are_not_missed_bars() -> None:
    # A first-shell pair of a honeycomb: middles of openings 1.5 bars apart, row by row.
    a = np.array([0.0, 1.0 / (1.5 * BAR)])
    b = np.array([np.sqrt(0.75) * a[1], 0.5 * a[1]])
    families = np.array([a + b, 2.0 * b - a, 2.0 * a - b])
    net = NetLattice(Mesh.SIX_SIDED, BAR, 1e-4, families, 5.0)
    np.testing.assert_allclose(net.basis, [a, b], atol=1e-9)
    dark = view_at(np.zeros(2), hole=(0.0, 0.0, 1.0))
    rng = np.random.default_rng(2)
    shifts = rng.uniform(-0.1, 0.1, (300, 2))
    places = [predicted_strands(net, dark, shift).place - shift for shift in shifts]
    # Bars are half a width of the opening, 0.866 bars, from the two nearest middles.
    index = np.stack(np.meshgrid(*[np.arange(-30, 31)] * 2), axis=-1).reshape(-1, 2)
    middles = np.linalg.solve(net.basis, index.T).T
    for place in np.concatenate(places)[::40]:
        near = np.sort(np.hypot(*(middles - place).T))[:3] / BAR
        assert near[0] == pytest.approx(near[1], abs=1e-6)
        assert np.sqrt(0.75) - 1e-9 < near[0] < near[2] - 0.19
    # Two of five bars' lengths are too near to a knot.
    count = np.mean([len(one) for one in places])
    metres = 2 * 2 * HALF
    steep = np.abs(families @ np.eye(2)) * BAR / np.sqrt(4.0 / 3.0)
    per_metre = float(np.sum(np.abs(families @ np.eye(2))[steep > 0.3])) / 3.0 / 2.0
    assert 0.4 < count / (per_metre * metres) < 0.9


def test_what_hides_the_wall_behind_is_no_hole() -> None:
    dark = view_at(np.zeros(2), hole=(0.0, 0.0, 0.06), beyond=0.3)
    open_ = view_at(np.zeros(2), hole=(0.0, 0.0, 0.06), beyond=0.7)
    assert not strands_at(np.zeros(2), dark).missed.any()
    assert strands_at(np.zeros(2), open_).missed.any()


def test_a_hole_is_found_with_place_and_size() -> None:
    (hole,) = passed(hole=(0.25, 0.14, 0.06))
    np.testing.assert_allclose(hole.place, [0.25, 0.14], atol=0.4 * BAR)
    # Strands are cut at a whole number of meshes.
    assert hole.diameter == pytest.approx(0.12, abs=0.6 * BAR)
    assert abs(hole.diameter - 0.12) < 2.0 * hole.sigma_diameter
    assert hole.sigma_diameter < BAR
    assert max(hole.extent) == pytest.approx(0.12, abs=BAR)
    assert hole.missing_meshes == pytest.approx(np.pi * 0.06**2 / opening_area(NET), rel=0.3)
    assert hole.n_looks > 10
    # Seen from where the vehicle was then.
    foot = hole.frame * 8e-3 * np.array([1.0, 0.5])
    np.testing.assert_allclose(foot + hole.from_foot, hole.place, atol=1e-9)
    assert hole.time_s == pytest.approx(hole.frame / 25.0)


def test_a_hole_at_the_edge_of_what_was_seen_is_as_large_as_its_rim_tells() -> None:
    # The upright line reaches 0.2 m up: to the hole's middle, and a mesh farther.
    along, up = 0.25, 0.5 * 0.25 + HALF
    for beyond in (0.0, -BAR):
        (hole,) = passed(hole=(along, up + beyond, 0.06))
        assert abs(hole.diameter - 0.12) < 2.0 * hole.sigma_diameter
        assert hole.diameter == pytest.approx(0.12, rel=0.4)


def test_what_is_known_less_has_a_larger_sigma() -> None:
    (half,) = passed(hole=(0.25, 0.5 * 0.25 + HALF + 0.3 * BAR, 0.06))
    (whole,) = passed(hole=(0.25, 0.14, 0.06))
    assert half.sigma_diameter > 1.2 * whole.sigma_diameter


@pytest.mark.parametrize("radius", [1.55, 2.0, 3.0])
def test_holes_of_three_meshes_are_found_wherever_they_lie(radius: float) -> None:
    rng = np.random.default_rng(5)
    for _ in range(10):
        middle = np.array([0.25, 0.125]) + rng.uniform(-0.05, 0.05, 2)
        lost = rng.random(40) < 0.03
        holes = passed(hole=(*middle, radius * BAR), lost=lost)
        assert len(holes) == 1
        assert holes[0].diameter == pytest.approx(2.0 * radius * BAR, abs=BAR)


def test_a_hole_that_two_stretches_see_is_one() -> None:
    holes = HoleMap()
    passing(holes, 30, hole=(0.25, 0.14, 0.06))
    passing(holes, 30, first=30, hole=(0.25, 0.14, 0.06))
    assert len(holes.holes) == 1


def test_a_rip_is_one_hole_as_long_as_it_is() -> None:
    holes = HoleMap()
    for i in range(60):
        foot = i * 8e-3 * np.array([1.0, 0.5])
        view = view_at(foot, i)
        strands = strands_at(foot, view)
        place = strands.place + foot - [0.25, 0.125]
        rip = (np.abs(place[:, 0]) < 5.5 * BAR) & (np.abs(place[:, 1]) < 1.6 * BAR)
        holes.add(NET, _dark(view, strands, rip), -foot, foot, 0)
    holes.update(NET)
    (hole,) = holes.holes
    assert hole.extent[0] == pytest.approx(11.0 * BAR, abs=2.0 * BAR)
    assert hole.extent[1] == pytest.approx(3.2 * BAR, abs=2.0 * BAR)


def test_one_missing_bar_is_no_hole() -> None:
    for middle in ((10.0, 5.5), (10.5, 5.0)):
        holes = HoleMap()
        passing(holes, hole=(middle[0] * BAR, middle[1] * BAR, 0.45 * BAR))
        assert np.any(holes._looks.weights() > 0.0)
        assert holes.holes == []


def test_strands_lost_at_random_are_no_hole() -> None:
    rng = np.random.default_rng(3)
    for share in (0.05, 0.15, 0.3):
        holes = HoleMap()
        for i in range(300):
            foot = i * 8e-3 * np.array([1.0, 0.5])
            view = view_at(foot, i, lost=rng.random(40) < share)
            holes.add(NET, view, -foot, foot, 0)
        holes.update(NET)
        assert holes.holes == []


@pytest.mark.parametrize("share", [0.3, 0.6, 0.75])
def test_the_dim_end_of_a_line_is_no_hole(share: float) -> None:
    rng = np.random.default_rng(4)
    holes = HoleMap()
    for i in range(60):
        foot = i * 8e-3 * np.array([1.0, 0.5])
        lost = np.zeros(40, np.bool_)
        lost[12:16] = rng.random(4) < share
        holes.add(NET, view_at(foot, i, lost=lost), -foot, foot, 0)
    holes.update(NET)
    assert holes.holes == []


def test_a_finer_lattice_than_the_nets_has_no_holes() -> None:
    fine = NetLattice(Mesh.FOUR_SIDED, BAR / 3.0, 1e-4, 3.0 * np.eye(2) / BAR, 5.0)
    holes = HoleMap()
    for i in range(60):
        foot = i * 8e-3 * np.array([1.0, 0.5])
        holes.add(fine, view_at(foot, i), -foot, foot, 0)
    holes.update(fine)
    assert holes.holes == []


def test_the_map_does_not_grow_on_one_spot() -> None:
    holes = HoleMap()
    rng = np.random.default_rng(1)

    def size() -> int:
        return len(holes._looks.keys) + len(holes._feet) + len(holes._meshes)

    sizes = []
    for k in range(8):
        for i in range(100):
            foot = rng.uniform(-0.03, 0.03, 2)
            holes.add(NET, view_at(foot, 100 * k + i), -foot, foot, 0)
        holes.update(NET)
        sizes.append(size())
    assert sizes[-1] < 1.1 * sizes[3]
    assert holes.area < (2.0 * HALF + 0.1) ** 2


def test_looking_for_long_proves_no_more() -> None:
    sums = np.array([[1.0, 0.0, 0.0, 3.0], [50.0, 0.0, 0.0, 150.0], [50.0, 0.0, 0.0, -150.0]])
    looks = Looks(np.array([1, 65, 128]), sums)
    np.testing.assert_allclose(looks.weights(), [3.0, 3.0, -4.0])
    # Seen as often as missed, a strand proves nothing.
    both = Looks(np.array([64, 65]), sums[[2, 1]])
    np.testing.assert_allclose(both.weights(), 0.0)


def test_what_is_far_behind_is_settled_but_counts() -> None:
    holes = HoleMap()
    passing(holes, 60, hole=(0.25, 0.14, 0.06))
    here = holes.area
    passing(holes, 500, first=60)
    assert len(holes.holes) == 1
    assert holes._last is not None
    assert np.abs(holes._looks.places - holes._last).max() < 2.0 + BAR
    assert holes.area > 3.0 * here


def test_a_new_piece_of_track_is_a_new_map() -> None:
    holes = HoleMap()
    passing(holes, 60, hole=(0.25, 0.14, 0.06))
    for i in range(60):
        foot = i * 8e-3 * np.array([1.0, 0.5])
        view = view_at(foot, 60 + i, hole=(0.25, 0.14, 0.06))
        holes.add(NET, view, -foot, foot, 1)
    holes.update(NET)
    assert [hole.piece for hole in holes.holes] == [0, 1]


def test_a_hole_in_which_the_way_is_lost_is_found() -> None:
    holes = HoleMap()
    for i in range(60):
        foot = i * 8e-3 * np.array([1.0, 0.5])
        # The second half is of another piece of track.
        view = view_at(foot, i, hole=(0.25, 0.14, 0.06))
        holes.add(NET, view, -foot, foot, int(i >= 40))
    assert [hole.piece for hole in holes.holes] == [0]


def test_two_holes_are_two_discs() -> None:
    grid = np.stack(np.meshgrid(np.arange(0.0, 20.0, 0.5), np.arange(0.0, 10.0, 0.5)), axis=-1)
    place = grid.reshape(-1, 2) * BAR
    away = [np.hypot(*(place / BAR - middle).T) for middle in ((5.0, 5.0), (14.0, 5.0))]
    weight = np.where((away[0] < 2.2) | (away[1] < 1.7), 3.0, -3.5)
    first, second = find_discs(place, weight, BAR)
    np.testing.assert_allclose(first.middle / BAR, [5.0, 5.0], atol=0.3)
    np.testing.assert_allclose(second.middle / BAR, [14.0, 5.0], atol=0.3)
    assert first.radius == pytest.approx(2.2 * BAR, abs=0.3 * BAR)
    assert second.radius == pytest.approx(1.7 * BAR, abs=0.3 * BAR)
    assert first.score > second.score > 12.0


@pytest.mark.parametrize("apart", [9.0, 9.5])
def test_a_hole_at_the_border_of_anothers_surroundings_keeps_its_size(apart: float) -> None:
    side = np.arange(-9.0, 20.0, 0.4)
    place = BAR * np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    n = len(place)
    middles = BAR * np.array([[0.0, 0.0], [apart, 0.0]])
    dark = np.any(np.hypot(*(place[:, None] - middles).transpose(2, 0, 1)) < 2.4 * BAR, axis=1)
    rows = np.c_[np.ones(n), place, np.where(dark, 3.0, -3.0)]
    holes = HoleMap(_bar=BAR, _mesh=BAR, _feet={(0, 0): (0, 0.0, np.zeros(2))})
    for laser in range(2):
        keys = (np.arange(n) * LASERS + laser) * 2 + dark
        holes._looks = holes._looks.added(keys, rows, np.zeros(n, np.int64))
    found = sorted(holes._find(NET), key=lambda hole: float(hole.place[0]))
    np.testing.assert_allclose([hole.place for hole in found], middles, atol=0.3 * BAR)
    np.testing.assert_allclose([hole.diameter for hole in found], 4.8 * BAR, atol=0.5 * BAR)
