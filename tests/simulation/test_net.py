"""Rays against twine: exact cylinders at the right places."""

import numpy as np
import pytest

from aqualvs.simulation.scenario import dome_from_target
from aqualvs.simulation.scene import Label, Net, Scene
from aqualvs.simulation.surfaces import pack_surfaces
from aqualvs.simulation.truth import cast

# Grooves swing the radius between 1 - 2 * 0.07 and 1 of the clean one, a knot adds up to 0.45.
_THINNEST, _THICKEST = 0.86, 1.45


def _hits(net, origins, directions, pose=None):
    pose = pose or dome_from_target(0.5, 0.1, -0.15)
    scene = Scene(dome_from_scene=pose, nets=(net,), target="net")
    reach = cast(origins, directions, pack_surfaces(scene, 0.0))
    hit = np.isfinite(reach.solid)
    assert np.all(reach.kind[hit] == Label.NET)
    points = origins[hit] + reach.solid[hit, None] * directions[hit]
    return pose.inverse().apply(points), hit


def _fan(n=4000, seed=1):
    """Rays from about the dome's centre, within 25 degrees of straight ahead."""
    rng = np.random.default_rng(seed)
    directions = np.column_stack(
        [rng.uniform(-0.45, 0.45, n), np.ones(n), rng.uniform(-0.45, 0.45, n)]
    )
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return rng.normal(0.0, 0.01, (n, 3)), directions


def _axis_distance(points, angle, spacing):
    """Distance of points in the scene frame from the nearest axis of a family of strands."""
    across = -np.sin(angle) * points[:, 0] + np.cos(angle) * points[:, 2]
    return np.hypot(across - spacing * np.rint(across / spacing), points[:, 1])


@pytest.mark.parametrize("roll", [0.0, 0.3, 1.2])
@pytest.mark.parametrize("mesh", ["square", "diamond"])
def test_hits_lie_on_cylinders_around_the_axes(mesh, roll):
    net = Net(mesh=mesh, bar=0.02, twine=0.003, roll=roll, hanging_ratio=0.6)
    points, hit = _hits(net, *_fan())
    half = np.arcsin(0.6)
    angles, spacing = (roll, roll + np.pi / 2), 0.02
    if mesh == "diamond":
        angles = (roll + np.pi / 2 - half, roll + np.pi / 2 + half)
        spacing = 0.02 * np.sin(2 * half)
    nearest = np.minimum(*(_axis_distance(points, angle, spacing) for angle in angles))
    assert hit.sum() > 500
    # A point near a knot lies on one cylinder and may be inside the other, which is then hidden.
    assert np.all(nearest <= _THICKEST * 0.0015 + 1e-9)
    assert np.mean(nearest >= _THINNEST * 0.0015 - 1e-9) > 0.97
    assert np.all(points[:, 1] < 0.0015)


def test_the_share_of_rays_that_hit_is_the_nets_solidity():
    net = Net(mesh="square", bar=0.02, twine=0.002)
    _, hit = _hits(net, *_fan(40_000), pose=dome_from_target(0.5, 0.0, 0.0))
    clean = 1.0 - (1.0 - 0.002 / 0.02) ** 2
    # Grooves take up to 7 % on the mean, knots add; slant rays see up to 10 % more twine. Sampling
    # adds 0.002 (one sigma).
    assert 0.93 * clean < hit.mean() < 1.15 * clean


def test_hexagon_has_bars_at_the_apothem_and_none_inside():
    net = Net(mesh="hexagon", bar=0.02, twine=0.002)
    points, hit = _hits(net, *_fan(20_000), pose=dome_from_target(0.5, 0.0, 0.0))
    pitch = 0.02 * np.sqrt(3.0)
    # Cell centres: rows along z every `pitch`, columns along x every 1.5 bars, shifted by half.
    i, j = np.meshgrid(np.arange(-40, 41), np.arange(-40, 41))
    centres = np.column_stack([(0.03 * i).ravel(), (pitch * (j + 0.5 * (i % 2))).ravel()])
    flat = points[:, [0, 2]]
    nearest = np.linalg.norm(flat[:, None] - centres[None], axis=-1)
    order = np.argmin(nearest, axis=1)
    offset = flat - centres[order]
    apothem = np.max(
        [
            np.abs(np.sin(a) * offset[:, 0] - np.cos(a) * offset[:, 1])
            for a in np.arange(3) * np.pi / 3
        ],
        axis=0,
    )
    assert hit.sum() > 1000
    assert np.all(apothem > pitch / 2 - _THICKEST * 0.001 - 1e-6)
    # Solidity of a thin honeycomb: bar length per area is 2 / (sqrt(3) bar), times the diameter.
    assert hit.mean() == pytest.approx(2.0 / np.sqrt(3.0) * 0.002 / 0.02, rel=0.15)


def test_curved_net_bulges_as_its_curvature_says():
    net = Net(bar=0.02, twine=0.002, curvature=(0.8, -0.5))
    points, hit = _hits(net, *_fan())
    surface = 0.4 * points[:, 0] ** 2 - 0.25 * points[:, 2] ** 2
    assert hit.sum() > 300
    # The tangent plane stands in for the surface over one twine: error about 1e-5 m.
    assert np.all(np.abs(points[:, 1] - surface) < _THICKEST * 0.001 + 2e-5)
    assert np.ptp(surface) > 0.01


def test_holes_missing_bars_and_edges_let_rays_through():
    rays = _fan()
    whole = _hits(Net(bar=0.02), *rays)[1].sum()
    points, _ = _hits(Net(bar=0.02, holes=((0.05, -0.02, 0.06),)), *rays)
    # A cylinder is met at most one radius before the plane that the hole is cut in.
    assert np.min(np.hypot(points[:, 0] - 0.05, points[:, 2] + 0.02)) > 0.058
    points, _ = _hits(Net(bar=0.02, half_size=(0.1, 0.07)), *rays)
    assert np.all(np.abs(points[:, [0, 2]]) < [0.102, 0.072])
    assert len(points) > 50
    assert _hits(Net(bar=0.02, missing=1.0), *rays)[1].sum() == 0
    share = _hits(Net(bar=0.02, missing=0.4), *rays)[1].sum() / whole
    # About 600 bars are in view: the share that is left scatters by 0.02.
    assert share == pytest.approx(0.6, abs=0.08)


def test_growth_thickens_the_asked_share_of_the_twine():
    rays = _fan(20_000)
    clean, _ = _hits(Net(bar=0.02, twine=0.002), *rays)
    fouled, _ = _hits(Net(bar=0.02, twine=0.002, fouling=0.5, growth=1.5), *rays)
    assert len(fouled) > 1.15 * len(clean)
    assert np.min(fouled[:, 1]) < -0.0018
    assert np.min(clean[:, 1]) > -_THICKEST * 0.001 - 1e-9


def test_offset_slides_the_mesh_with_its_knots():
    rays = _fan()
    pose = dome_from_target(0.5, 0.0, 0.0)
    still, _ = _hits(Net(mesh="square", bar=0.02), *rays, pose=pose)
    slid, _ = _hits(Net(mesh="square", bar=0.02, offset=(0.007, 0.0)), *rays, pose=pose)
    upright = _axis_distance(slid - [0.007, 0.0, 0.0], np.pi / 2, 0.02)
    level = _axis_distance(slid, 0.0, 0.02)
    assert np.all(np.minimum(upright, level) <= _THICKEST * 0.001 + 1e-9)
    upright = _axis_distance(still - [0.007, 0.0, 0.0], np.pi / 2, 0.02)
    level = _axis_distance(still, 0.0, 0.02)
    assert np.mean(np.minimum(upright, level) > 0.002) > 0.2
