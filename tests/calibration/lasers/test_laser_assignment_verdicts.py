"""Planes of light that are no lasers, or may be none."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.calibration.lasers.laser_assignment import (
    BENT_TOLERANCE_PX,
    TOLERANCE_PX,
    JudgedPlane,
    LaserAssignment,
    PlaneVerdict,
    assign_lasers,
)
from aqualvs.calibration.lasers.stripes_on_planes import board_surface, place_stripes
from aqualvs.calibration.lasers.views import pooled
from aqualvs.geometry.arrays import FloatArray
from laser_scenes import Clutter, Scene, joined, scene
from whole import part_of

RAIL = [(0.02, 0.01, 0.0)] * 6
QUIET = Clutter()


def split(made: Scene, n_lasers: int | None = None) -> LaserAssignment:
    stripes = pooled(made.views, board_surface())
    return assign_lasers(stripes, made.rig.dome_from_cam.translation, n_lasers=n_lasers)


def only(planes: tuple[JudgedPlane, ...]) -> JudgedPlane:
    assert len(planes) == 1
    return planes[0]


def with_points(made: Scene, *adds: FloatArray, unsteady_px: float = 0.0) -> Scene:
    """The scene with more chains, in the same places of every picture, but for `unsteady_px`."""
    camera, views, rng = made.rig.camera(), [], np.random.default_rng(0)
    for view in made.views:
        stripes = view.stripes
        for add in adds:
            stripes = joined(stripes, add + rng.normal(0.0, unsteady_px, 2))
        placed = place_stripes(camera, stripes, view.dome_from_target, board_surface())
        views.append(replace(view, stripes=stripes, placed=placed))
    return replace(made, views=views)


def test_a_scratch_in_the_picture_is_no_laser() -> None:
    made = scene(7, 1, 6, clutter=QUIET, noise_px=0.1)
    line = np.stack([np.arange(250.0, 450.0, 2.0), np.arange(200.0, 300.0, 1.0)], axis=-1)
    found = split(with_points(made, line))
    assert len(found.planes) == 1
    assert "one place of the picture" in only(found.spare).why


@pytest.mark.parametrize("seed", part_of(range(3), every=3))
def test_edges_behind_a_board_before_a_still_camera_are_no_lasers(seed: int) -> None:
    """As many straight edges as a room has; some near others lie in planes beside the lens."""
    made, rng = scene(seed, 0, 8, clutter=QUIET, noise_px=0.1), np.random.default_rng(seed)
    edges = []
    for _ in range(24):
        middle, angle = rng.uniform([60.0, 60.0], [660.0, 510.0]), rng.uniform(0.0, np.pi)
        way = np.arange(-60.0, 60.0, 2.0)[:, None] * np.array([np.cos(angle), np.sin(angle)])
        edges.append(middle + way)
    stripes = pooled(with_points(made, *edges, unsteady_px=1.5).views, board_surface())
    lens = made.rig.dome_from_cam.translation
    for n_lasers, tolerance_px in ((None, TOLERANCE_PX), (1, BENT_TOLERANCE_PX)):
        found = assign_lasers(stripes, lens, n_lasers=n_lasers, tolerance_px=tolerance_px)
        assert not found.planes


def test_light_on_a_wall_behind_is_not_another_laser() -> None:
    others = []
    for seed in range(12):
        made = scene(seed, 1, 8, clutter=Clutter(behind=0.11), noise_px=0.1, margin=0.02)
        found = split(made)
        assert len(found.planes) == 1
        others += [plane.why for plane in found.spare if plane.verdict is PlaneVerdict.OTHER]
    assert any("begins where another stripe ends" in why for why in others)


def test_print_on_a_board_that_comes_nearer_is_asked_about() -> None:
    """Along a rail every edge of the print sweeps a plane in space, as a laser's light does."""
    made = scene(3, 1, 8, clutter=Clutter(edges=0.6), noise_px=0.1, rail=True)
    found = split(made)
    assert len(found.undecided) >= 1
    assert all("stays in one place of the target" in plane.why for plane in found.undecided)
    assert len(split(made, 1).planes) == 1


def test_a_board_that_bends_tears_a_laser() -> None:
    """Half of the pictures put the laser 2 mm, about 8 px, beside where the others put it."""
    made = scene(11, 1, 10, clutter=QUIET, noise_px=0.1)
    away = scene(11, 1, 10, clutter=QUIET, noise_px=0.1, shift=4e-3)
    mixed = replace(made, views=[*made.views[:5], *away.views[5:]])
    found = split(mixed)
    assert found.torn
    assert any("seen in other pictures" in plane.why for plane in found.spare)


def test_light_that_no_plane_explains_is_asked_about() -> None:
    """A second stripe that wanders by a pixel or two, beside one that fits to a tenth of it."""
    steady = scene(5, 1, 10, clutter=QUIET, noise_px=0.05)
    unsteady = scene(5, 1, 10, clutter=QUIET, noise_px=0.05, shift=0.06, wander=1.2e-3)
    camera, views = steady.rig.camera(), []
    for view, other in zip(steady.views, unsteady.views, strict=True):
        stripes = joined(view.stripes, other.stripes.pixels)
        placed = place_stripes(camera, stripes, view.dome_from_target, board_surface())
        views.append(replace(view, stripes=stripes, placed=placed))
    found = split(replace(steady, views=views))
    assert len(found.planes) == 1
    assert "those of another laser" in only(found.undecided).why
