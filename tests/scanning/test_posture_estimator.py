"""Crossing zones: as far around another laser's sheet as its stripe is wide, bent or not."""

from collections.abc import Callable

import numpy as np
import pytest

from aqualvs.optics.rig import Rig
from aqualvs.optics.sheet import sheets_of
from aqualvs.scanning.observations import StripeObserver, in_crossing
from aqualvs.simulation.scenarios import example_rig
from windowed_cases import windowed


@pytest.mark.parametrize(
    "make_rig", [example_rig, lambda: windowed(example_rig())], ids=["planes", "bent"]
)
def test_a_crossing_zone_follows_the_other_sheet(make_rig: Callable[[], Rig]) -> None:
    rig = make_rig()
    camera, sheets = rig.camera(), sheets_of(rig)
    observer = StripeObserver(rig)
    pixels = np.random.default_rng(1).uniform([0, 0], rig.size_px, (20000, 2))
    points, valid = sheets[0].intersect(camera.rays(pixels))
    points = points[valid & (np.linalg.norm(points, axis=1) < 1.2)]
    # Laser 2 is not lit; the stripes of the others are 6 and 4 px wide.
    width = np.array([6.0, 4.0, -1.0])
    off_px = sheets[1].signed_distance(points) * rig.focal_px / np.linalg.norm(points, axis=1)
    expected = np.abs(off_px) < 1.2 * 6.0 + 2.0
    found = np.array(
        [
            in_crossing(points, i, 0, observer.planes, observer.bent, width, rig.focal_px)
            for i in range(len(points))
        ]
    )
    assert np.count_nonzero(expected) > 100
    np.testing.assert_array_equal(found, expected)
