"""The command's part of the lasers: the colour of their light, and markers that do not fit."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import aqualvs
from aqualvs.calibrate import common, lasers
from aqualvs.calibrate.common import DetectedTargets
from aqualvs.calibrate.lasers import _misplaced
from aqualvs.optics.water import Dispersion
from aqualvs.simulation.scenarios import example_rig, flat_port_rig
from laser_cases import Noise, board_views, laser_error

MARKERS = np.array([10, 11, 12, 13])


def notes(pictures):
    """By the markers (indices) that each picture shows, and those whose corners it leaves out."""
    views, used = [], []
    for number, (shown, left_out) in enumerate(pictures):
        ids = (4 * np.array(shown)[:, None] + np.arange(4)).ravel()
        name, inside = f"view_{number}.png", ~np.isin(ids // 4, left_out)
        views.append(SimpleNamespace(view=SimpleNamespace(name=name, ids=ids)))
        # Some are left out by the pose of the picture alone, some by all pictures together.
        kept = inside | (np.arange(len(ids)) % 2 == 0)
        corners = SimpleNamespace(ids=ids[kept])
        used.append(SimpleNamespace(name=name, corners=corners, corner_inliers=inside[kept]))
    views.append(SimpleNamespace(view=SimpleNamespace(name="not used", ids=np.arange(16))))
    return _misplaced(MARKERS, views, SimpleNamespace(views=used))


def test_a_marker_that_most_pictures_leave_out_is_named():
    assert notes([([0, 1, 2], [1]), ([0, 1, 3], [1]), ([1, 2, 3], [])]) == [
        "marker 11: left out of 2 of 3 pictures, where it does not fit the others; check its place "
        "and number in the box's file"
    ]


def test_one_bad_picture_of_a_marker_is_no_fault_of_the_box():
    assert notes([([0, 1], [1]), ([0, 1], []), ([2, 3], [3])]) == []


@pytest.mark.parametrize("light_nm", [None, 450.0, 650.0])
@pytest.mark.parametrize("make", [example_rig, flat_port_rig])
@pytest.mark.parametrize("medium", [None, "water", "number", "air"])
def test_a_target_in_water_is_seen_in_green_light(monkeypatch, make, light_nm, medium):
    """Read in the light of the lasers, it puts these planes off by 0.2 to 0.6 mm."""
    rig = make()
    coloured = tuple(replace(one, wavelength_nm=light_nm) for one in rig.lasers)
    rig = replace(rig, lasers=coloured)
    light = Dispersion.of(light_nm, rig.n_air)
    n_green = rig.n_air if medium == "air" else light.to_green(rig.n_water)
    noise = Noise(corner_px=0.05, stripe_px=0.1)
    corners = [one.view for one in board_views(rig.in_water(n_green), noise=noise)]
    there = rig.in_water(light.from_green(n_green))
    stripes = [one.stripes for one in board_views(there, noise=noise)]
    pictures = tuple(np.zeros((*rig.size_px[::-1], 3), np.uint8) for _ in stripes)
    found = DetectedTargets(tuple(corners), pictures, rig.size_px, {})
    monkeypatch.setattr(common, "detect_boards", lambda *_: found)
    monkeypatch.setattr(lasers, "find_stripes", lambda *_: stripes.pop(0))
    given = n_green if medium == "number" else medium
    done = aqualvs.calibrate_lasers(pictures, rig, board="board.yaml", medium=given)
    assert done.n_medium == pytest.approx(light.from_green(n_green), abs=1e-9)
    for figures, laser in zip(done.solution.lasers, rig.lasers, strict=True):
        _, offset = laser_error(figures.laser.plane, laser.plane)
        # Noise of the pictures makes 0.02 mm.
        assert abs(offset) < 1e-4
