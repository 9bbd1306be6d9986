"""Crossing zones, as wide as the other laser's stripe; and the sigma of bent bodies."""

from collections.abc import Callable

import numpy as np
import pytest

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Rig
from aqualvs.optics.sheet import sheets_of
from aqualvs.scanner import Scanner
from aqualvs.scanning.observations import StripeObserver, in_crossing
from aqualvs.scanning.posture import Posture
from aqualvs.simulation.scenarios import example_rig
from fan_cases import Fan, fan_rig
from scanning_cases import Lit, everywhere, peaks_of
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


def hull(radius: float, distance: float) -> list[tuple[Plane, Lit]]:
    """A level cylinder in 30 facets of 3 degrees, each lit where it touches the cylinder."""
    axis, step = np.array([0.0, distance + radius, 0.0]), np.deg2rad(3.0)
    facets: list[tuple[Plane, Lit]] = []
    for angle in step * np.arange(-15, 16):
        normal = np.array([0.0, np.cos(angle), -np.sin(angle)])

        def lit(points: FloatArray, angle: float = angle) -> BoolArray:
            _, away, up = (points - axis).T
            near: BoolArray = abs(np.arctan2(up, -away) - angle) < 0.5 * step
            return near

        facets.append((Plane.from_normal(normal, float(normal @ axis) - radius), lit))
    return facets


def test_the_sigma_of_a_bent_body_covers_its_bend() -> None:
    """Two upright stripes over a hull lie on some plane that touches it above or below."""
    fan = Fan(n_lines=2, spacing_deg=12.0, baseline=(-0.12, 0.0, 0.0), aim_deg=10.0, roll_deg=0.0)
    scanner = Scanner(fan_rig(fan, (0.25, 1.3)))
    wall = Plane.from_normal((0.0, 1.0, -0.06), 0.6)
    for body, least_deg, most_deg in (
        (hull(0.3, 0.6), 3.0, 12.0),
        ([(wall, everywhere)], 0.0, 0.1),
    ):
        found = scanner.measure(0, 0.0, peaks_of(scanner.rig, body, 0.1)).posture
        assert isinstance(found, Posture)
        sigma_deg = np.degrees(np.sqrt(found.covariance[1, 1]))
        assert least_deg <= sigma_deg <= most_deg
        if least_deg:
            assert abs(np.degrees(found.pitch)) < 3.0 * sigma_deg
