"""Sorting stripe points by laser when all lasers shine at once."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.calibration.lasers.candidates import lines_on_patch
from aqualvs.calibration.lasers.laser_assignment import LaserAssignment, assign_lasers
from aqualvs.calibration.lasers.stripes_on_planes import (
    PooledStripes,
    StripePoints,
    TargetSurfaces,
    board_surface,
)
from aqualvs.calibration.lasers.views import LaserView, place_views, pooled
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Laser, Rig
from aqualvs.simulation.scenarios import example_rig
from laser_cases import Noise, board_views, box, box_views, laser_error

RIG = example_rig()
LENS = RIG.dome_from_cam.translation
NOISE = Noise(corner_px=0.05, stripe_px=0.2)


def placed(views: list[LaserView], surfaces: TargetSurfaces, rig: Rig = RIG) -> PooledStripes:
    return pooled(place_views(rig.camera(), views, surfaces)[0], surfaces)


def true_lasers(views: list[LaserView], stripes: PooledStripes, n_surfaces: int) -> np.ndarray:
    """Which laser drew each point; stripes were simulated laser by laser, surface by surface."""
    ends = np.flatnonzero(np.diff(stripes.placed.index) < 0) + 1
    parts = np.split(stripes.placed.index, ends)
    chains = [v.stripes.chain[i] for v, i in zip(views, parts, strict=True)]
    return np.concatenate(chains) // n_surfaces


def with_junk(view: LaserView, n: int, seed: int) -> LaserView:
    """The view with points scattered all over it."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0.0, np.pi, n)
    s = view.stripes
    stripes = StripePoints(
        np.concatenate([s.pixels, rng.uniform((0.0, 0.0), RIG.size_px, (n, 2))]),
        np.concatenate([s.across, np.stack([np.cos(angle), np.sin(angle)], axis=-1)]),
        np.concatenate([s.chain, np.full(n, 1000)]),
        np.concatenate([s.sigma_px, np.full(n, 0.1)]),
    )
    return replace(view, stripes=stripes)


def matched(split: LaserAssignment, rig: Rig = RIG) -> list[int]:
    """Which of the split's planes is nearest to each laser of the rig."""
    errors = [[laser_error(p, laser.plane)[0] for p in split.planes] for laser in rig.lasers]
    return [int(np.argmin(row)) for row in errors]


@pytest.mark.parametrize("n_lasers", [3, None], ids=["told", "untold"])
@pytest.mark.parametrize("target", ["box", "board"])
def test_lasers_fall_apart(target: str, n_lasers: int | None) -> None:
    surfaces = box() if target == "box" else board_surface()
    views = (box_views if target == "box" else board_views)(RIG, noise=NOISE)
    stripes = placed(views, surfaces)
    split = assign_lasers(stripes, LENS, n_lasers=n_lasers)
    assert len(split.planes) == 3
    order = matched(split)
    assert sorted(order) == [0, 1, 2]
    true = np.array(order)[true_lasers(views, stripes, len(surfaces.planes))]
    given = split.laser >= 0
    # What is left out lies where stripes cross.
    assert np.mean(given) > 0.85
    assert np.mean(split.laser[given] == true[given]) > 0.999
    for laser, i in zip(RIG.lasers, order, strict=True):
        angle, offset = laser_error(split.planes[i], laser.plane)
        # Rough: 0.2 px at 0.7 m are 0.15 mm, over surfaces a few tenths of a metre apart.
        assert np.rad2deg(angle) < 0.2
        assert abs(offset) < 2e-3


def test_scattered_points_do_not_mislead() -> None:
    views = [with_junk(v, 300, i) for i, v in enumerate(box_views(RIG, noise=NOISE))]
    split = assign_lasers(placed(views, box()), LENS)
    assert sorted(matched(split)) == [0, 1, 2]
    assert len(split.planes) == 3


def pencil() -> Rig:
    """A rig of fifteen lasers from one emitter."""
    emitter = np.array([0.06, 0.02, 0.05])
    lasers = []
    for i, angle in enumerate(np.deg2rad(np.linspace(-20.0, 4.0, 15))):
        normal = np.array([np.cos(angle), -np.sin(angle), 0.1])
        lasers.append(Laser(f"laser_{i + 1}", Plane.from_normal(normal, float(normal @ emitter))))
    return replace(RIG, lasers=tuple(lasers))


@pytest.mark.parametrize("n_boards", [3, 4], ids=["by order", "by evidence"])
def test_a_pencil_of_fifteen_near_parallel_lasers(n_boards: int) -> None:
    rig = pencil()
    views = board_views(rig, noise=NOISE)[:n_boards]
    split = assign_lasers(placed(views, board_surface(), rig), LENS, n_lasers=15)
    assert len(split.planes) == 15
    assert sorted(matched(split, rig)) == list(range(15))
    errors = [laser_error(p, rig.lasers[i].plane)[0] for i, p in enumerate(_sorted(split, rig))]
    assert np.rad2deg(max(errors)) < 0.2


def _sorted(split: LaserAssignment, rig: Rig) -> list[Plane]:
    """The split's planes in the order of the rig's lasers."""
    return [split.planes[i] for i in matched(split, rig)]


@pytest.mark.parametrize(("n_boards", "n_told"), [(2, 15), (3, 14), (3, 16), (3, None)])
def test_the_order_of_stripes_needs_three_boards_that_show_all_of_them(
    n_boards: int, n_told: int | None
) -> None:
    rig = pencil()
    views = board_views(rig, noise=NOISE)[:n_boards]
    split = assign_lasers(placed(views, board_surface(), rig), LENS, n_lasers=n_told)
    assert len(split.planes) < 14


def test_the_order_of_stripes_does_not_mislead_where_one_of_them_is_missing() -> None:
    """In one picture the first laser is hidden, in another one the last."""
    rig = pencil()
    some = [rig.lasers[1:], rig.lasers[:-1], rig.lasers]
    views = [
        board_views(replace(rig, lasers=lasers), noise=NOISE)[i] for i, lasers in enumerate(some)
    ]
    split = assign_lasers(placed(views, board_surface(), rig), LENS, n_lasers=14)
    assert len(split.planes) < 14


def test_a_surface_is_never_taken_for_a_laser() -> None:
    """Many stripes on one plane all lie in it; that is no plane of light."""
    views = box_views(RIG, noise=NOISE)
    split = assign_lasers(placed(views, box()), LENS, n_lasers=5)
    assert len(split.planes) == 3


def test_stripes_on_one_surface_alone_stay_unmatched() -> None:
    views, n = box_views(RIG, noise=NOISE), 4
    # The third laser is seen on the forward plane of the first picture only.
    kept = []
    for view, first in zip(views, (True, False, False), strict=True):
        chain = view.stripes.chain
        keep = (chain < 2 * n) | (first & (chain == 2 * n + 2))
        kept.append(replace(view, stripes=view.stripes.at(np.flatnonzero(keep))))
    split = assign_lasers(placed(kept, box()), LENS, n_lasers=3)
    assert len(split.planes) == 2
    assert [line.patch for line in split.unmatched] == [2]


def test_a_further_laser_is_counted() -> None:
    split = assign_lasers(placed(box_views(RIG, noise=NOISE), box()), LENS, n_lasers=2)
    assert len(split.planes) == 3


def test_crossing_stripes_leave_a_gap() -> None:
    views = box_views(RIG, noise=NOISE)
    stripes = placed(views, box())
    split = assign_lasers(stripes, LENS)
    lone = split.laser < 0
    normals = np.array([p.normal for p in split.planes])
    offsets = np.array([p.offset for p in split.planes])
    distance = np.sort(np.abs(stripes.placed.points_in_dome @ normals.T - offsets), axis=1)
    # Near two planes at once: within a centimetre of the second.
    assert np.median(distance[lone, 1]) < 0.01
    assert np.median(distance[~lone, 1]) > 0.03


def test_lines_on_a_patch_need_points() -> None:
    stripes = placed(box_views(RIG), box())
    few = np.flatnonzero(stripes.patch == 2)[:5]
    assert lines_on_patch(stripes, few, 2) == []
    assert lines_on_patch(stripes, few[:0], 2) == []
