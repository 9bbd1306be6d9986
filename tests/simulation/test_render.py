"""The picture: laws of light that must hold in it."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.errors import RigError
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Laser
from aqualvs.simulation import render as render_module
from aqualvs.simulation.cameras import corner_rays, expose, spread
from aqualvs.simulation.lasers import default_sources, light_on_points, pack_sheets
from aqualvs.simulation.render import Renderer, TileMembers, tile_members
from aqualvs.simulation.scenario import dome_from_target
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig, load_scenario
from aqualvs.simulation.scene import Box, Net, Scene, Wall, WaterOptics

_NO_DIMMING, _DIMMING = (0.0, 0.0, 0.0), (0.3, 0.3, 0.3)
_CLEAR = WaterOptics(attenuation=(0.0, 0.0, 0.0), sheet_scatter=0.0, forward_scatter=0.0)
_PLAIN = Wall(contrast=0.0)


@pytest.fixture(scope="module")
def renderer():
    return Renderer(example_rig(), samples=1)


def _wall_at(distance, **changes):
    scene = Scene(
        dome_from_scene=dome_from_target(distance, 0.0, 0.0), walls=(_PLAIN,), target="wall"
    )
    return replace(scene, **changes)


def _path_to_wall(distance, column, row):
    ray = example_rig().camera().rays([column, row])
    return (distance - ray.origins[1]) / ray.directions[1]


def test_daylight_dims_by_beer_lambert(renderer):
    water = WaterOptics(attenuation=(1.5, 0.5, 1.0), veil=(0.0, 0.0, 0.0))
    near, far = (renderer.radiance(_wall_at(d, water=water, lasers_on=False)) for d in (0.4, 1.0))
    for column, row in [(360, 288), (30, 40), (700, 500)]:
        path = _path_to_wall(1.0, column, row) - _path_to_wall(0.4, column, row)
        ratio = far[row, column] / near[row, column]
        # Single precision of the pictures.
        assert np.allclose(ratio, np.exp(-path * np.array(water.attenuation)), rtol=1e-5)


def test_veil_fills_endless_water_and_vanishes_in_clear_water(renderer):
    empty = renderer.radiance(_wall_at(0.5, walls=(), lasers_on=False))
    far = renderer.radiance(_wall_at(60.0, lasers_on=False))
    # exp(-0.3 / m * 60 m) is 1.5e-8.
    assert np.allclose(empty, far, atol=1e-6)
    assert np.allclose(empty[300, 360] / empty[300, 360, 1] * 0.205, WaterOptics().veil, rtol=1e-5)
    clear = renderer.radiance(_wall_at(0.5, walls=(), lasers_on=False, water=_CLEAR))
    assert np.all(clear == 0.0)


def test_without_lasers_there_is_no_stripe(renderer):
    off = renderer.radiance(_wall_at(0.5, lasers_on=False))
    on = renderer.radiance(_wall_at(0.5))
    lit = renderer.lit_points(_wall_at(0.5))
    x, y = np.rint(lit.pixels[len(lit) // 7 :: 97]).astype(int).clip([0, 0], [719, 575]).T
    assert np.all(on[y, x, 1] > off[y, x, 1] + 0.5)
    # Plain wall, veil and daylight alone change slowly: neighbours differ by less than 1 %.
    assert np.abs(np.diff(off[..., 1], axis=1)).max() < 0.01 * off[..., 1].max()
    assert len(renderer.lit_points(_wall_at(0.5, lasers_on=False))) == 0


def test_power_is_stated_half_a_metre_from_the_source():
    rig = example_rig()
    sources = default_sources(rig)
    sheets = pack_sheets(rig, sources)
    for i, source in enumerate(sources):
        sheets_of_one = pack_sheets(replace(rig, lasers=rig.lasers[i : i + 1]), [source])
        at = source.position + np.outer([0.5, 1.0], source.direction)
        light = light_on_points(at, sheets_of_one, _NO_DIMMING)[:, 1]
        assert light[0] == pytest.approx(source.power, rel=1e-3)
        # The fan spreads as 1/s, the sheet's thickness as its sigma.
        spread_ratio = 0.5 * (source.sigma + 0.5 * source.divergence)
        spread_ratio /= source.sigma + 1.0 * source.divergence
        assert light[1] / light[0] == pytest.approx(spread_ratio, rel=1e-6)
        off = at[:1] + rig.lasers[i].plane.normal * (source.sigma + 0.5 * source.divergence)
        assert light_on_points(off, sheets_of_one, _NO_DIMMING)[0, 1] / light[0] == pytest.approx(
            np.exp(-0.5), rel=1e-6
        )
    # At a common point the sheets' lights add.
    cross = np.linalg.solve(
        [laser.plane.normal for laser in rig.lasers], [laser.plane.offset for laser in rig.lasers]
    )[None]
    alone = [
        light_on_points(cross, pack_sheets(replace(rig, lasers=(laser,)), [source]), _DIMMING)[0, 1]
        for laser, source in zip(rig.lasers, sources, strict=True)
    ]
    assert light_on_points(cross, sheets, _DIMMING)[0, 1] == pytest.approx(sum(alone))


def test_same_seed_same_picture_other_seed_other_noise(renderer):
    scenario = load_scenario("net_clutter")
    scene = scenario.scene_at(1.0)
    first, again, other = (
        renderer.render(scene, 1.0, np.random.default_rng(seed)).image for seed in (1, 1, 2)
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    # Two noises of the default sensor: about 1 to 2 grey levels each.
    difference = first.astype(float) - other
    assert 0.5 < difference.std() < 6.0
    assert abs(difference.mean()) < 0.05


def test_strands_and_box_keep_the_laser_from_what_is_behind(renderer):
    box = Box(centre=(0.0, 0.15, -0.05), size=(0.12, 0.05, 0.25))
    scene = Scene(
        dome_from_scene=dome_from_target(0.45, 0.0, 0.0),
        walls=(Wall(depth=0.35, contrast=0.0),),
        nets=(Net(bar=0.025, twine=0.003),),
        boxes=(box,),
        target="net",
        water=replace(_CLEAR, ambient=(0.0, 0.0, 0.0)),
    )
    image = renderer.radiance(scene)[..., 1]
    without = renderer.radiance(replace(scene, nets=(), boxes=()))[..., 1]
    open_wall = renderer.lit_points(replace(scene, nets=(), boxes=()))
    points, laser = open_wall.points_in_dome, open_wall.laser
    x, y = np.rint(open_wall.pixels).astype(int).clip([0, 0], [719, 575]).T
    lens = renderer.rig.dome_from_cam.translation
    in_view = ~_crosses_strand(scene, np.tile(lens, (len(points), 1)), points, 1.8)
    in_view &= ~_through_box(scene, lens, points)
    starts = np.array([source.position for source in renderer.sources])[laser]
    behind_box = np.zeros(len(points), dtype=bool)
    for i, source in enumerate(renderer.sources):
        behind_box[laser == i] = _through_box(scene, source.position, points[laser == i])
    # Nothing is claimed of half-shadows: the sheet is about as thick as a strand's radius.
    dark = in_view & (behind_box | _crosses_strand(scene, starts, points, 0.3))
    lit = in_view & ~behind_box & ~_crosses_strand(scene, starts, points, 3.0)
    assert (dark & behind_box).sum() > 20
    assert (dark & ~behind_box).sum() > 20
    assert lit.sum() > 150
    for part in (dark & behind_box, dark & ~behind_box):
        assert np.median(image[y, x][part]) < 0.02 * np.median(without[y, x][part])
    assert np.allclose(image[y, x][lit], without[y, x][lit], rtol=0.02)


def _crosses_strand(scene, starts, points, radii):
    """Whether straight lines pass the net plane within so many twine radii of a strand."""
    pose, net = scene.dome_from_scene.inverse(), scene.nets[0]
    a, b = pose.apply(starts), pose.apply(points)
    s = a[:, 1] / (a[:, 1] - b[:, 1])
    crossing = a + s[:, None] * (b - a)
    half = np.arcsin(net.hanging_ratio)
    spacing = net.bar * np.sin(2 * half)
    near = np.zeros(len(a), dtype=bool)
    for angle in (np.pi / 2 - half, np.pi / 2 + half):
        w = -np.sin(angle) * crossing[:, 0] + np.cos(angle) * crossing[:, 2]
        near |= np.abs(w - spacing * np.rint(w / spacing)) < radii * net.twine / 2
    return near


def _through_box(scene, start, points):
    """Whether straight lines from one start pass through the scene's box."""
    pose, box = scene.dome_from_scene.inverse(), scene.boxes[0]
    a, b = pose.apply(start) - box.centre, pose.apply(points) - box.centre
    steps = a + np.linspace(0.0, 1.0, 500)[:, None, None] * (b - a)
    return np.any(np.all(np.abs(steps) < np.array(box.size) / 2, axis=-1), axis=0)


def test_culling_changes_nothing(renderer, monkeypatch):
    scene = load_scenario("net_clutter").scene_at(1.5)
    culled = renderer.radiance(scene, 1.5)

    def everywhere(camera, surfaces):
        real = tile_members(camera, surfaces)
        n, e, b = len(real.ellipsoid_start) - 1, len(surfaces.ellipsoids), len(surfaces.bubbles)
        assert len(real.bubbles) < 0.2 * n * b
        return TileMembers(
            real.n_columns,
            np.tile(np.arange(e), n),
            np.arange(n + 1) * e,
            np.tile(np.arange(b), n),
            np.arange(n + 1) * b,
        )

    monkeypatch.setattr(render_module, "tile_members", everywhere)
    assert np.array_equal(renderer.radiance(scene, 1.5), culled)


def test_rays_between_corners_are_the_cameras_rays():
    rig = example_rig()
    corners = corner_rays(rig.camera())
    rng = np.random.default_rng(4)
    pixels = rng.integers(0, [720, 576], (500, 2))
    i, j = pixels.T
    mean = 0.25 * sum(corners.directions[j + v, i + u] for u in (0, 1) for v in (0, 1))
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    exact = rig.camera().rays(pixels.astype(float)).directions
    # A pixel is about 9e-4 rad in water: 1e-3 px.
    assert np.abs(mean - exact).max() < 1e-6


def test_threads_change_nothing(renderer):
    scene = load_scenario("net_square").scene_at(0.0)
    banded = Renderer(example_rig(), samples=1, threads=5).radiance(scene)
    assert np.array_equal(banded, renderer.radiance(scene))


def test_sources_must_fit_the_lasers():
    rig = example_rig()
    sources = default_sources(rig)
    scene = _wall_at(0.5)
    with pytest.raises(RigError, match="3 lasers but 2 sources"):
        Renderer(rig, sources[:2]).lit_points(scene)
    off = replace(sources[0], position=sources[0].position + np.array([0.0, 0.0, 0.002]))
    with pytest.raises(RigError, match="off its plane"):
        Renderer(rig, [off, *sources[1:]]).lit_points(scene)
    across = Laser("across", Plane.from_normal((0.0, 1.0, 0.01), 0.5))
    with pytest.raises(RigError, match="laser across"):
        default_sources(replace(rig, lasers=(across,)))


def test_rig_without_lasers_renders(renderer):
    bare = Renderer(replace(example_rig(), lasers=()), samples=1)
    assert np.array_equal(
        bare.radiance(_wall_at(0.5)), renderer.radiance(_wall_at(0.5, lasers_on=False))
    )


def test_wide_rig_sees_its_three_stripes():
    renderer = Renderer(bluerov2_rig(), samples=1)
    lit = renderer.lit_points(_wall_at(0.6))
    assert np.all(np.bincount(lit.laser, minlength=3) > 300)


def test_blur_keeps_light_and_saturation_cuts_it():
    scene = _wall_at(0.5)
    picture = np.zeros((96, 96, 3), dtype=np.float32)
    picture[48, 48] = 100.0
    blurred = spread(picture, replace(scene.water, forward_scatter=0.2), scene.sensor)
    assert blurred.sum() == pytest.approx(picture.sum(), rel=1e-3)
    # The halo reaches where the sharp image does not.
    assert blurred[48, 62, 1] > 1e-3
    image = expose(picture, scene.sensor, None)
    assert image[48, 48, 1] == 255
    assert image[0, 0, 1] == 0


def test_noise_has_the_variance_asked_for():
    sensor = replace(_wall_at(0.5).sensor, gamma=1.0, read_noise=0.01, shot_noise=4e-4)
    picture = np.full((200, 200, 3), 0.5, dtype=np.float32)
    image = expose(picture, sensor, np.random.default_rng(0)) / 255.0
    # Read and shot noise together with the rounding to 8 bits; 1 % sampling error.
    expected = np.sqrt(0.01**2 + 4e-4 * 0.5 + (1 / 255) ** 2 / 12)
    assert image.std() == pytest.approx(expected, rel=0.03)
    assert image.mean() == pytest.approx(0.5, abs=1e-3)


def test_snow_adds_specks_before_the_target_only(renderer):
    water = replace(WaterOptics(), snow=3000)
    clean, snowy = (renderer.radiance(_wall_at(0.5, water=w), 2.0) for w in (WaterOptics(), water))
    added = (snowy - clean)[..., 1]
    assert added.min() >= 0.0
    # About 3 % of the box in which particles drift lies before the wall and in view.
    assert 0.001 < np.mean(added > 0.005) < 0.2
    near = renderer.radiance(_wall_at(0.13, water=water), 2.0)[..., 1]
    near -= renderer.radiance(_wall_at(0.13), 2.0)[..., 1]
    assert np.sum(near > 0.005) < 0.1 * np.sum(added > 0.005)
