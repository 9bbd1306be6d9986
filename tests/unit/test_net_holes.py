"""Looks and the map of holes, from made-up views of ideal nets."""

import numpy as np
import pytest

from aqualvs.geometry.arrays import FloatArray
from aqualvs.scanning.net_dashes import Dashes, Gaps, NetView
from aqualvs.scanning.net_holes import HoleMap, find_looks, opening_area
from aqualvs.scanning.net_hypotheses import Mesh
from aqualvs.scanning.net_lattice import NetLattice

BAR, HALF = 0.025, 0.2
NET = NetLattice(Mesh.FOUR_SIDED, BAR, 1e-4, np.eye(2) / BAR, 5.0, np.ones(2))


def view_at(
    foot: FloatArray,
    index: int = 0,
    *,
    hole: tuple[float, float, float] | None = None,
    beyond: float = 0.0,
) -> NetView:
    """What two lasers, one level and one upright, show of a square net around a place on it.

    A hole lets the share `beyond` of the light through, as the openings do.
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
        low, high = s[there] - 1e-3, s[there] + 1e-3
        edges = np.r_[-HALF, np.stack([low, high], axis=1).ravel(), HALF].reshape(-1, 2)
        middles = np.r_[-HALF, np.repeat(s[there], 2), HALF].reshape(-1, 2)
        last = len(edges) - 1
        for k, (ends, middle) in enumerate(zip(edges, middles, strict=True)):
            rows.append((i, *ends, *middle, k > 0, k < last, beyond))
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
        gaps=Gaps(
            table[:, 0].astype(int),
            table[:, 1:3],
            table[:, 3:5],
            table[:, 5:7] == 1.0,
            table[:, 7],
        ),
        span_laser=np.arange(2),
        span=np.tile([-HALF, HALF], (2, 1)),
    )


def passing(
    holes: HoleMap, n: int = 60, step: float = 8e-3, first: int = 0, **options: object
) -> None:
    """Pass a net on a slant from its origin, two steps right for one up."""
    for i in range(first, first + n):
        foot = i * step * np.array([1.0, 0.5])
        holes.add(NET, view_at(foot, i, **options), foot, 0)  # type: ignore[arg-type]
    holes.update(NET)


def test_sound_net_is_sound() -> None:
    looks = find_looks(NET, view_at(np.zeros(2)))
    assert not looks.through.any()
    # From the first strand to the last on both lines.
    length = np.hypot(*(looks.end - looks.begin).T)
    assert length.sum() == pytest.approx(2 * 16 * BAR, abs=2 * BAR)


def test_a_hole_is_looked_through_where_it_is() -> None:
    looks = find_looks(NET, view_at(np.zeros(2), hole=(0.0, 0.0, 0.06)))
    assert np.count_nonzero(looks.through) == 2
    begin, end = looks.begin[looks.through], looks.end[looks.through]
    np.testing.assert_allclose(0.5 * (begin + end), 0.0, atol=1e-9)
    # The strands beside it are at 75 mm, so it reaches somewhere from 50 to 75 mm.
    np.testing.assert_allclose(np.hypot(*(end - begin).T), 0.125, atol=3e-3)


def test_what_hides_the_wall_behind_is_no_hole() -> None:
    dark = view_at(np.zeros(2), hole=(0.0, 0.0, 0.06), beyond=0.3)
    open_ = view_at(np.zeros(2), hole=(0.0, 0.0, 0.06), beyond=0.7)
    assert not find_looks(NET, dark).through.any()
    assert find_looks(NET, open_).through.any()


def test_a_hole_is_found_with_place_and_size() -> None:
    holes = HoleMap()
    passing(holes, hole=(0.25, 0.14, 0.06))
    (hole,) = holes.holes
    np.testing.assert_allclose(hole.place, [0.25, 0.14], atol=0.5 * BAR)
    # Strands are cut at a whole number of meshes.
    assert hole.diameter == pytest.approx(0.12, abs=BAR)
    assert abs(hole.diameter - 0.12) < 3.0 * hole.sigma_diameter
    assert max(hole.extent) == pytest.approx(0.12, abs=1.5 * BAR)
    assert hole.missing_meshes == pytest.approx(np.pi * 0.06**2 / opening_area(NET), rel=0.5)
    # Seen from where the vehicle was then.
    foot = hole.frame * 8e-3 * np.array([1.0, 0.5])
    np.testing.assert_allclose(foot + hole.from_foot, hole.place, atol=1e-9)
    assert hole.time_s == pytest.approx(hole.frame / 25.0)


def test_a_hole_that_two_stretches_see_is_one() -> None:
    holes = HoleMap()
    passing(holes, 30, hole=(0.25, 0.14, 0.06))
    passing(holes, 30, first=30, hole=(0.25, 0.14, 0.06))
    assert len(holes.holes) == 1


def test_one_missing_bar_is_no_hole() -> None:
    holes = HoleMap()
    passing(holes, hole=(10.0 * BAR, 5.5 * BAR, 0.45 * BAR))
    assert holes._through.sum() > 0.0
    assert holes.holes == []


def test_the_map_does_not_grow_on_one_spot() -> None:
    holes = HoleMap()
    rng = np.random.default_rng(1)

    def size() -> int:
        return len(holes._keys) + len(holes._looks)

    sizes = []
    for k in range(8):
        for i in range(100):
            foot = rng.uniform(-0.03, 0.03, 2)
            holes.add(NET, view_at(foot, 100 * k + i), foot, 0)
        holes.update(NET)
        sizes.append(size())
    assert sizes[-1] < 1.1 * sizes[3]
    assert holes._sound.max() <= 25.0 + 1e-9
    assert holes.area < (2.0 * HALF + 0.1) ** 2


def test_what_is_far_behind_is_settled_but_counts() -> None:
    holes = HoleMap()
    passing(holes, 60, hole=(0.25, 0.14, 0.06))
    here = holes.area
    passing(holes, 500, first=60)
    assert len(holes.holes) == 1
    far = np.abs(holes._centres() - holes._last).max()
    assert far < 2.0 + BAR
    assert holes.area > 3.0 * here


def test_a_new_piece_of_track_is_a_new_map() -> None:
    holes = HoleMap()
    passing(holes, 60, hole=(0.25, 0.14, 0.06))
    for i in range(60):
        foot = i * 8e-3 * np.array([1.0, 0.5])
        holes.add(NET, view_at(foot, 60 + i, hole=(0.25, 0.14, 0.06)), foot, 1)
    holes.update(NET)
    assert [hole.piece for hole in holes.holes] == [0, 1]
