"""Folded nets: where rays meet them, and how scenario files write them."""

import numpy as np
import pytest

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.simulation.net import folded, pack_fold
from aqualvs.simulation.scenario import dome_from_target, parse_scenario
from aqualvs.simulation.scene import Fold, Net, Scene
from aqualvs.simulation.surfaces import pack_surfaces
from aqualvs.simulation.truth import cast

# Twine with its knots is at most so thick, in clean radii.
_THICKEST = 1.45


def table(*folds: Fold) -> FloatArray:
    return np.array([pack_fold(0, fold) for fold in folds])


def rays(n: int, seed: int = 1) -> tuple[FloatArray, FloatArray]:
    """Rays from about the dome's centre, within 25 degrees of straight ahead."""
    rng = np.random.default_rng(seed)
    directions = np.column_stack(
        [rng.uniform(-0.45, 0.45, n), np.ones(n), rng.uniform(-0.45, 0.45, n)]
    )
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return rng.normal(0.0, 0.01, (n, 3)), directions


def hits(net: Net, n: int = 4000) -> tuple[FloatArray, BoolArray]:
    """Where rays meet a net, in `scene`, and which rays do."""
    pose = dome_from_target(0.5, 0.1, -0.15)
    origins, directions = rays(n)
    scene = Scene(dome_from_scene=pose, nets=(net,), target="net")
    reach = cast(origins, directions, pack_surfaces(scene, 0.0)).solid
    hit = np.isfinite(reach)
    return pose.inverse().apply((origins + reach[:, None] * directions)[hit]), hit


def test_a_fold_has_its_crest_its_foot_and_its_slope() -> None:
    folds = table(Fold(direction=np.pi / 2, place=0.1, height=-0.04, width=0.03))
    assert folded(0.3, 0.1, folds, 0)[0] == pytest.approx(-0.04)
    assert folded(0.3, 0.115, folds, 0)[0] == pytest.approx(-0.02)
    assert folded(0.3, 0.131, folds, 0) == (0.0, 0.0, 0.0)
    assert folded(0.3, 0.1, folds, 1)[0] == 0.0
    step = 1e-6
    for v in (0.08, 0.11, 0.12):
        rise = (folded(0.0, v + step, folds, 0)[0] - folded(0.0, v - step, folds, 0)[0]) / 2 / step
        assert folded(0.0, v, folds, 0)[2] == pytest.approx(rise, abs=1e-6)


def test_a_row_of_folds_that_touch_is_a_wave() -> None:
    folds = table(Fold(place=0.02, height=0.03, width=0.1, period=0.2))
    for u in np.linspace(-1.0, 1.0, 17):
        wave = 0.015 * (1.0 + np.cos(2.0 * np.pi * (u - 0.02) / 0.2))
        assert folded(float(u), 0.0, folds, 0)[0] == pytest.approx(wave, abs=1e-12)


@pytest.mark.parametrize("curvature", [(0.0, 0.0), (0.4, 0.0)])
def test_rays_meet_the_twine_on_the_folded_surface(curvature: tuple[float, float]) -> None:
    folds = (Fold(direction=0.4, place=0.02, height=-0.05, width=0.06), Fold(height=0.02))
    net = Net(bar=0.02, twine=0.003, curvature=curvature, folds=folds)
    points, hit = hits(net)
    assert np.count_nonzero(hit) > 500
    x, y, z = points.T
    rows = table(*folds)
    found = np.array([folded(u, v, rows, 0) for u, v in zip(x, z, strict=True)])
    height = found[:, 0] + 0.5 * (curvature[0] * x**2 + curvature[1] * z**2)
    slope = np.hypot(found[:, 1] + curvature[0] * x, found[:, 2] + curvature[1] * z)
    # The distance from the surface, where the surface bends little over a radius.
    off = np.abs(y - height) / np.hypot(1.0, slope)
    assert np.quantile(off, 0.99) < _THICKEST * 0.0015
    assert np.ptp(height) > 0.05


def test_rays_go_on_to_the_next_layer_of_a_steep_fold() -> None:
    # A ray that passes the flank that faces it meets the one behind: more twine is in its way.
    flat = np.mean(hits(Net(bar=0.02, twine=0.002))[1])
    steep = Fold(height=-0.12, width=0.03, period=0.06)
    points, hit = hits(Net(bar=0.02, twine=0.002, folds=(steep,)))
    # With the first layer alone it is as much as flat; sampling adds 0.006 (one sigma).
    assert np.mean(hit) > 1.15 * flat
    assert np.ptp(points[:, 1]) > 0.10


def test_a_fold_of_no_height_changes_nothing() -> None:
    plain, hit = hits(Net(bar=0.02, curvature=(0.3, -0.2)))
    same, hit_again = hits(Net(bar=0.02, curvature=(0.3, -0.2), folds=(Fold(height=0.0),)))
    np.testing.assert_array_equal(hit, hit_again)
    np.testing.assert_array_equal(plain, same)


def test_folds_that_cannot_be_are_refused() -> None:
    with pytest.raises(OptionError, match="width is 0 mm"):
        pack_fold(0, Fold(width=0.0))
    with pytest.raises(OptionError, match="period is 50 mm, less than the 100 mm"):
        pack_fold(0, Fold(width=0.05, period=0.05))


def test_scenario_files_have_folds() -> None:
    content = {"net": {"folds": [{"direction_deg": 90, "height_mm": -20, "every_mm": 200}]}}
    fold = parse_scenario(content, "pleats", "pleats.yaml").nets[0].folds[0]
    assert fold == Fold(direction=np.pi / 2, height=-0.02, width=0.05, period=0.2)
    with pytest.raises(OptionError, match="did you mean 'height_mm'"):
        parse_scenario({"net": {"folds": [{"hight_mm": 3}]}}, "pleats", "pleats.yaml")
