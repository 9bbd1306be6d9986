"""Counting lasers among clutter: random scenes with their truth, told the number and untold."""

from functools import cache

import numpy as np
import pytest

from aqualvs.calibration.lasers.laser_assignment import LaserAssignment, assign_lasers
from aqualvs.calibration.lasers.stripes_on_planes import board_surface
from aqualvs.calibration.lasers.views import pooled
from laser_cases import laser_error
from laser_scenes import Clutter, Scene, scene
from whole import WHOLE

CLUTTER = Clutter(edges=0.2, glints=4.0, behind=0.11, gaps=0.3)
NOISE_PX = (0.05, 0.1, 0.3)


def split(made: Scene, n_lasers: int | None) -> LaserAssignment:
    stripes = pooled(made.views, board_surface())
    return assign_lasers(stripes, made.rig.dome_from_cam.translation, n_lasers=n_lasers)


def n_right(found: LaserAssignment, made: Scene) -> int:
    """How many lasers of the scene are among the planes."""
    right = 0
    for laser in made.rig.lasers:
        errors = [laser_error(plane, laser.plane) for plane in found.planes]
        # Rough planes by points of 0.05 to 0.3 px; other lasers are ten times as far away.
        right += any(np.rad2deg(a) < 1.0 and abs(o) < 6e-3 for a, o in errors)
    return right


@cache
def scenes(n_lasers: int, n_views: int, n_seeds: int, clutter: Clutter = CLUTTER) -> list[Scene]:
    return [
        scene(
            1000 * n_lasers + seed,
            n_lasers,
            n_views,
            clutter=clutter,
            noise_px=NOISE_PX[seed % len(NOISE_PX)],
            # Fifteen need a wall.
            margin=0.1 if n_lasers <= 5 else 0.6,
        )
        for seed in range(n_seeds)
    ]


@pytest.mark.parametrize("told", [True, False], ids=["told", "untold"])
@pytest.mark.parametrize(
    ("n_lasers", "n_views", "n_seeds"),
    [(1, 5, 20), (2, 5, 20), (3, 5, 10), (5, 6, 6), (15, 8, 2)]
    if WHOLE
    else [(1, 5, 5), (2, 5, 5), (3, 5, 3), (5, 6, 2), (15, 8, 1)],
)
def test_lasers_are_found_and_nothing_else(
    n_lasers: int, n_views: int, n_seeds: int, told: bool
) -> None:
    decided = 0
    for made in scenes(n_lasers, n_views, n_seeds):
        found = split(made, n_lasers if told else None)
        # Whatever is called a laser is one.
        assert n_right(found, made) == len(found.planes)
        if len(found.planes) == n_lasers and (told or not found.undecided):
            decided += 1
    # A laser can miss a small board in most of a few pictures; then it cannot be found.
    assert decided >= 0.8 * n_seeds


@pytest.mark.parametrize("n_views", [3, 8])
def test_where_no_laser_shines_none_is_found(n_views: int) -> None:
    for made in scenes(0, n_views, 10 if WHOLE else 3, Clutter(edges=0.3, glints=6.0)):
        assert not split(made, None).planes


def test_one_laser_in_two_pictures_is_found_where_it_is_told() -> None:
    for made in scenes(1, 2, 20 if WHOLE else 6, Clutter(glints=1.0)):
        found = split(made, 1)
        assert n_right(found, made) == len(found.planes)
