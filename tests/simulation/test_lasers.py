"""Light behind windows: its brightness follows the bent sheets, and shortcuts change nothing."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.errors import RigError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.rig import Rig
from aqualvs.optics.sheet import sheets_of
from aqualvs.simulation.lasers import Sheets, default_sources, light_on_points, pack_sheets
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenario import dome_from_target
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig
from aqualvs.simulation.scene import Box, Label, Net, Scene, Wall, WaterOptics
from aqualvs.simulation.shading import crossing_sheet
from windowed_cases import windowed

RIGS = [windowed(example_rig()), windowed(bluerov2_rig())]

_NO_DIMMING, _DIMMING = (0.0, 0.0, 0.0), (0.3, 0.3, 0.3)


def one_laser(rig: Rig, i: int) -> tuple[Rig, Sheets]:
    alone = replace(rig, lasers=(rig.lasers[i],))
    return alone, pack_sheets(alone, default_sources(alone))


def fan_points(rig: Rig, i: int, reach: float) -> FloatArray:
    """Points in the middle of laser i's sheet, so far beyond its window."""
    sheet, source = sheets_of(rig)[i], default_sources(rig)[i]
    angle = np.linspace(-0.5, 0.5, 21)[:, None]
    side = np.cross(sheet.plane.normal, source.direction)
    rays, _ = sheet.shine(np.cos(angle) * source.direction + np.sin(angle) * side)
    return rays.points_at(np.full(21, reach))


@pytest.mark.parametrize("rig", RIGS, ids=lambda rig: rig.name)
@pytest.mark.parametrize("i", range(3))
def test_light_falls_off_with_the_distance_from_the_sheet(rig: Rig, i: int) -> None:
    alone, packed = one_laser(rig, i)
    sheet, source = sheets_of(alone)[0], default_sources(alone)[0]
    points = fan_points(rig, i, 0.6)
    middle = light_on_points(points, packed, _NO_DIMMING)[:, 1]
    assert np.all(middle > 0.5 * source.power)
    gradient = sheet.gradient(points)
    way = np.linalg.norm(points - sheet.source, axis=1)
    for sigmas in (-2.0, -1.0, 1.0, 2.0):
        off = sigmas * (source.sigma + source.divergence * way)
        moved = points + off[:, None] * gradient / np.linalg.norm(gradient, axis=1)[:, None]
        ratio = light_on_points(moved, packed, _NO_DIMMING)[:, 1] / middle
        # Distances are metres to 2 % here, and the light's way is bent.
        np.testing.assert_allclose(ratio, np.exp(-0.5 * sigmas**2), rtol=0.0, atol=0.012)


@pytest.mark.parametrize("rig", RIGS, ids=lambda rig: rig.name)
def test_leaving_out_what_is_far_from_a_sheet_changes_nothing(rig: Rig) -> None:
    packed = pack_sheets(rig, default_sources(rig))
    rng = np.random.default_rng(2)
    sheet_points = np.concatenate(
        [fan_points(rig, i, r) for i in range(3) for r in (0.01, 0.3, 3.0)]
    )
    points = np.concatenate(
        [
            rng.uniform([-0.6, 0.1, -0.5], [0.6, 1.5, 0.5], (20000, 3)),
            sheet_points + 2e-3 * rng.normal(size=sheet_points.shape),
        ]
    )
    everywhere = packed._replace(stray=np.full_like(packed.stray, np.inf))
    light, expected = (light_on_points(points, one, _DIMMING) for one in (packed, everywhere))
    # A sheet's light ends at so many sigma; what is left out is beyond.
    np.testing.assert_allclose(light, expected, rtol=0.0, atol=10.0 * np.exp(-8.0))
    assert np.count_nonzero(light > 0.01) > 100


@pytest.mark.parametrize("rig", RIGS, ids=lambda rig: rig.name)
def test_view_rays_cross_the_glow_where_the_sheet_is(rig: Rig) -> None:
    packed = pack_sheets(rig, default_sources(rig))
    camera = rig.camera()
    pixels = np.random.default_rng(3).uniform([0, 0], rig.size_px, (400, 2))
    rays = camera.rays(pixels)
    compared = 0
    for i, sheet in enumerate(sheets_of(rig)):
        points, valid = sheet.intersect(rays)
        gradient = sheet.gradient(np.where(valid[:, None], points, 1.0))
        steep = np.abs(np.sum(rays.directions * gradient, axis=1)) > 0.1
        usual = valid & steep & (points[:, 1] > 0.3) & (points[:, 1] < 1.2)
        for k in np.flatnonzero(usual):
            o, d = tuple(rays.origins[k].tolist()), tuple(rays.directions[k].tolist())
            t, slope = crossing_sheet(o, d, packed, i)
            assert abs(sheet.signed_distance(np.array(o) + t * np.array(d))) < 2e-4
            assert slope == pytest.approx(float(rays.directions[k] @ gradient[k]), abs=5e-3)
            compared += 1
    assert compared > 200


def test_points_on_twine_are_bright() -> None:
    """Light comes from the window's face: strands shade what is behind them as seen from there."""
    renderer = Renderer(RIGS[0], samples=1)
    dark = WaterOptics(ambient=(0.0, 0.0, 0.0), veil=(0.0, 0.0, 0.0), sheet_scatter=0.0)
    pose = dome_from_target(0.45, 0.1, -0.1)
    scene = Scene(
        dome_from_scene=pose,
        nets=(Net(bar=0.025, twine=0.003, roll=0.2),),
        target="net",
        water=dark,
    )
    image, lit = renderer.radiance(scene)[..., 1], renderer.lit_points(scene)
    assert len(lit) > 200
    x, y = np.rint(lit.pixels).astype(int).clip([0, 0], [719, 575]).T
    assert np.mean(image[y, x] > 0.05) > 0.95
    bright = np.argwhere(image > 1.0)[:, ::-1]
    gap = [np.min(np.linalg.norm(lit.pixels - pixel, axis=1)) for pixel in bright[::5]]
    assert np.percentile(gap, 98) < 12.0


def test_shadows_fall_where_bent_light_is_kept_out() -> None:
    """The edge of a box's shadow on the wall behind it, as traced and as painted."""
    renderer = Renderer(RIGS[0])
    clear = WaterOptics(
        ambient=(0.0, 0.0, 0.0),
        veil=(0.0, 0.0, 0.0),
        attenuation=(0.0, 0.0, 0.0),
        sheet_scatter=0.0,
    )
    pose = dome_from_target(0.5, 0.0, 0.0)
    open_wall = Scene(dome_from_scene=pose, walls=(Wall(contrast=0.0),), target="wall", water=clear)
    box = Box(centre=(0.0, -0.25, -0.09), size=(0.05, 0.02, 0.03))
    shaded = replace(open_wall, boxes=(box,))
    every, some = (renderer.lit_points(scene) for scene in (open_wall, shaded))
    points, pixels = every.points_in_dome[every.laser == 0], every.pixels[every.laser == 0]
    still_lit = some.points_in_dome[(some.laser == 0) & (some.label == Label.WALL)]
    gap = np.array([np.min(np.linalg.norm(still_lit - point, axis=1)) for point in points])
    x, y = np.rint(pixels).astype(int).clip([0, 0], [719, 575]).T
    before, after = (renderer.radiance(scene)[y, x, 1] for scene in (open_wall, shaded))
    left = after / before
    assert np.count_nonzero(gap > 1e-3) > 400
    # Whole pixels, of 0.6 mm, at either edge; light from the source itself, past the window's
    # bend, would move the edges by millimetres.
    assert np.all(left[gap > 1e-3] < 0.5)
    assert np.count_nonzero(left[gap < 1e-6] < 0.5) <= 3


def test_the_source_is_the_windows() -> None:
    rig = RIGS[0]
    sources = default_sources(rig)
    for laser, source in zip(rig.lasers, sources, strict=True):
        assert laser.window is not None
        np.testing.assert_allclose(source.position, laser.window.source, rtol=0.0, atol=1e-16)
    moved = replace(sources[0], position=sources[0].position + 0.003 * sources[0].direction)
    with pytest.raises(
        RigError, match=r"laser lower: its source is 3\.000 mm from where its window"
    ):
        pack_sheets(rig, [moved, *sources[1:]])


def test_a_fan_wider_than_its_window_lights_what_it_can() -> None:
    rig = RIGS[0]
    wide = [replace(one, half_angle=np.deg2rad(84.0)) for one in default_sources(rig)]
    packed = pack_sheets(rig, wide)
    assert np.isfinite(packed.stray).all()
    lit = Renderer(rig, wide, samples=1).lit_points(
        Scene(dome_from_scene=dome_from_target(0.5, 0.0, 0.0), walls=(Wall(),), target="wall")
    )
    assert np.isfinite(lit.points_in_dome).all()
    assert len(lit) > 200
