"""Crossing zones: as far around another laser's sheet as its stripe is wide, bent or not."""

from collections.abc import Callable

import numpy as np
import pytest

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.optics.rig import Rig
from aqualvs.optics.sheet import sheets_of
from aqualvs.scanning.observations import StripeObserver, in_crossing
from aqualvs.simulation.scenarios import example_rig
from windowed_cases import windowed

ANYWHERE = np.zeros(3)


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
            in_crossing(points, i, 0, ANYWHERE, observer.planes, observer.bent, width, rig.focal_px)
            for i in range(len(points))
        ]
    )
    assert np.count_nonzero(expected) > 100
    np.testing.assert_array_equal(found, expected)


def test_where_two_stripes_merge_the_place_on_the_target_counts() -> None:
    """Light between two stripes lies off the target with either laser."""
    rig = example_rig()
    observer, width = StripeObserver(rig), np.array([6.0, 4.0, -1.0])
    m = np.array([0.0, 2.0, 0.0])
    pixels = np.random.default_rng(1).uniform([0, 0], rig.size_px, (20000, 2))
    points, valid = sheets_of(rig)[0].intersect(rig.camera().rays(pixels))
    points = points[valid & (np.abs(points @ m - 1.0) < 0.01)]
    points /= (points @ m)[:, None]

    def crossed(points: FloatArray, m: FloatArray) -> BoolArray:
        crosses = [
            in_crossing(points, i, 0, m, observer.planes, None, width, rig.focal_px)
            for i in range(len(points))
        ]
        return np.array(crosses, np.bool_)

    crossing = points[crossed(points, m)]
    assert len(crossing) > 5
    assert crossed(0.95 * crossing, m).all()
    assert not crossed(0.95 * crossing, ANYWHERE).all()
