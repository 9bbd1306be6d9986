"""The picture and its truth tell the same story."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from aqualvs.geometry.planes import Rays
from aqualvs.optics.sheet import sheets_of
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenario import dome_from_target
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig, load_scenario
from aqualvs.simulation.scene import Net, Scene, SurfaceKind, Wall, WaterOptics
from aqualvs.simulation.truth import LitPoints, target_fit, visible_fit
from whole import part_of
from windowed_cases import windowed

# Laser light alone: nothing else can pull a stripe's centre.
_DARK = WaterOptics(ambient=(0.0, 0.0, 0.0), veil=(0.0, 0.0, 0.0), sheet_scatter=0.0)
_HALF_WINDOW = 16


_RIGS = {
    "example": example_rig,
    "bluerov2": bluerov2_rig,
    "windowed": lambda: windowed(example_rig()),
}


@pytest.fixture(scope="module", params=list(_RIGS))
def renderer(request):
    return Renderer(_RIGS[request.param]())


def _wall(distance, pitch_deg, yaw_deg):
    pose = dome_from_target(distance, np.deg2rad(pitch_deg), np.deg2rad(yaw_deg))
    return Scene(dome_from_scene=pose, walls=(Wall(contrast=0.0),), target="wall", water=_DARK)


def _centre_errors(image, pixels, axis, others):
    """Intensity-weighted centre minus truth, along image columns (axis 1) or rows (axis 0)."""
    order = np.argsort(pixels[:, 1 - axis])
    along, across = pixels[order, 1 - axis], pixels[order, axis]
    errors = []
    lines = image if axis == 0 else image.T
    for line in range(int(np.ceil(along[0])) + 12, int(along[-1]) - 12, 7):
        centre = float(np.interp(line, along, across))
        low, high = round(centre) - _HALF_WINDOW, round(centre) + _HALF_WINDOW + 1
        at = np.array([line, centre] if axis == 1 else [centre, line])
        alone = np.min(np.linalg.norm(others - at, axis=1)) > 2.5 * _HALF_WINDOW
        if low < 0 or high > lines.shape[1] or not alone:
            continue
        weight = lines[line, low:high]
        errors.append(weight @ np.arange(low, high) / weight.sum() - centre)
    return np.array(errors)


def _near(pixels, rig):
    """Mark the pixels (height, width) in which the centres of stripes are looked for, and more."""
    width, height = rig.size_px
    marked = np.zeros((height, width), np.uint8)
    x, y = np.rint(pixels).astype(int).T
    marked[y.clip(0, height - 1), x.clip(0, width - 1)] = 1
    side = 4 * _HALF_WINDOW + 1
    return cv2.dilate(marked, np.ones((side, side), np.uint8)) > 0


@pytest.mark.parametrize(
    ("distance", "pitch", "yaw"),
    part_of([(0.37, 0, 0), (0.6, -15, 20), (0.6, 15, -20), (1.2, 0, 0)]),
)
def test_stripe_centres_are_the_projected_intersections(renderer, distance, pitch, yaw):
    scene = _wall(distance, pitch, yaw)
    lit = renderer.lit_points(scene)
    image = renderer.radiance(scene, where=_near(lit.pixels, renderer.rig))[..., 1].astype(float)
    for i in range(3):
        mine = lit.laser == i
        spread = np.ptp(lit.pixels[mine], axis=0)
        axis = 1 if spread[0] > spread[1] else 0
        errors = _centre_errors(image, lit.pixels[mine], axis, lit.pixels[~mine])
        assert len(errors) > 15
        # Perspective over the stripe's own thickness skews its profile by about 0.01 px; a shift
        # of the sub-samples by a quarter of a pixel would show as 0.25.
        assert np.median(np.abs(errors)) < 0.02
        assert np.abs(errors).max() < 0.06


def test_truth_points_lie_on_sheet_and_wall_and_project_to_their_pixels(renderer):
    scene = _wall(0.5, 8, -12)
    lit = renderer.lit_points(scene)
    rig = renderer.rig
    # Rounding only.
    assert np.abs(scene.target_plane().signed_distance(lit.points_in_dome)).max() < 1e-12
    for i, sheet in enumerate(sheets_of(rig)):
        off = sheet.signed_distance(lit.points_in_dome[lit.laser == i])
        assert np.abs(off).max() < 1e-12
    rays = rig.camera().rays(lit.pixels)
    back, valid = scene.target_plane().intersect(rays)
    assert valid.all()
    # Newton's residue of the projection, at most 1e-9 px.
    assert np.abs(back - lit.points_in_dome).max() < 1e-9


def test_points_on_twine_are_bright_and_within_a_radius_of_the_net_plane():
    renderer = Renderer(example_rig())
    net = Net(bar=0.025, twine=0.003, roll=0.2)
    pose = dome_from_target(0.45, 0.1, -0.1)
    scene = Scene(dome_from_scene=pose, nets=(net,), target="net", water=_DARK)
    image = renderer.radiance(scene)[..., 1]
    lit = renderer.lit_points(scene)
    distance = scene.target_plane().signed_distance(lit.points_in_dome)
    assert np.all(lit.label == SurfaceKind.NET)
    assert len(lit) > 200
    assert np.all(np.abs(distance) < 1.45 * 0.0015)
    # Lit and seen from the front: never behind the axis by more than where both views graze.
    assert np.mean(distance < 0.0) > 0.97
    x, y = np.rint(lit.pixels).astype(int).clip([0, 0], [719, 575]).T
    assert np.mean(image[y, x] > 0.05) > 0.95
    # Nothing shines where no truth point is near (a sheet is at most 4 sigma, 9 px, thick here,
    # and its light runs along a strand that lies in it).
    bright = np.argwhere(image > 1.0)[:, ::-1]
    gap = [np.min(np.linalg.norm(lit.pixels - pixel, axis=1)) for pixel in bright[::5]]
    assert np.percentile(gap, 98) < 12.0


@pytest.mark.parametrize(("distance", "yaw"), [(0.4, 0.0), (0.8, 15.0)])
def test_upright_strands_stand_where_their_axes_project(distance, yaw):
    rig = example_rig()
    net = Net(mesh="square", bar=0.03, twine=0.003)
    pose = dome_from_target(distance, 0.0, np.deg2rad(yaw))
    # A net of white twine, lit evenly, in clear water: any light is a strand.
    scene = Scene(
        dome_from_scene=pose,
        nets=(net,),
        target="net",
        lasers_on=False,
        water=WaterOptics(veil=(0.0, 0.0, 0.0)),
    )
    image = Renderer(rig).radiance(scene)[..., 1]
    camera = rig.camera()
    checked = 0
    # Half way between level strands, far from knots.
    for k in range(-12, 13):
        heights = np.linspace(-0.25, 0.25, 2001)
        axis = pose.apply(np.column_stack([np.full(2001, 0.03 * k), 0 * heights, heights]))
        pixels, valid = camera.project(axis)
        mid = np.abs(heights / 0.03 - np.floor(heights / 0.03) - 0.5) < 0.02
        inside = valid & mid & camera.inside_image(pixels)
        for x, y in pixels[inside][::5]:
            row, left, right = round(y), round(x) - 9, round(x) + 10
            if left < 0 or right > 720:
                continue
            x_axis = float(np.interp(row, pixels[::-1, 1], pixels[::-1, 0]))
            half = 0.5 * image[row, left:right].max()
            covered = np.flatnonzero(image[row, left:right] > 0.3 * half) + left
            # Whole pixels and uneven light on the twine: half a pixel.
            assert abs(covered.mean() - x_axis) < 0.5
            checked += 1
    assert checked > 30


def test_hidden_points_are_no_truth():
    scenario = load_scenario("net_clutter")
    renderer = Renderer(example_rig())
    scene = scenario.scene_at(0.0)
    lit = renderer.lit_points(scene)
    kinds = np.bincount(lit.label, minlength=6)
    assert kinds[SurfaceKind.NET] > 100
    assert kinds[SurfaceKind.WALL] > 500
    assert kinds[SurfaceKind.SOLID] > 50
    # No wall or box point may be seen through a strand: march from the lens side to the point.
    rays = renderer.rig.camera().rays(lit.pixels)
    behind = lit.label != SurfaceKind.NET
    crossing, valid = scene.target_plane().intersect(
        Rays(rays.origins[behind], rays.directions[behind], rays.valid[behind])
    )
    local = scene.dome_from_scene.inverse().apply(crossing[valid])
    net = replace(scene.nets[0])
    half = np.arcsin(net.hanging_ratio)
    pitch = net.bar * np.sin(2 * half)
    hole = np.hypot(local[:, 0] - 0.06, local[:, 2] - 0.04) < 0.036
    for angle in (np.pi / 2 - half, np.pi / 2 + half):
        across = -np.sin(angle) * local[:, 0] + np.cos(angle) * local[:, 2]
        gap = np.abs(across - pitch * np.rint(across / pitch))
        # The thinnest clean radius, seen up to 35 degrees off the strand's cross-section.
        assert np.all(gap[~hole] > 0.8 * 0.86 * net.twine / 2)


@pytest.mark.parametrize("curvature", [(0.0, 0.0), (0.5, 0.1), (-0.4, 0.3)])
def test_the_plane_of_a_net_touches_it_where_it_is_nearest(curvature):
    pose = dome_from_target(0.5, np.deg2rad(5.0), np.deg2rad(-8.0))
    scene = Scene(dome_from_scene=pose, nets=(Net(curvature=curvature),), target="net")
    x, z = (one.ravel() for one in np.meshgrid(*[np.linspace(-0.3, 0.3, 601)] * 2))
    y = 0.5 * (curvature[0] * x**2 + curvature[1] * z**2)
    points = pose.apply(np.column_stack([x, y, z]))
    on_net = np.full(len(x), SurfaceKind.NET, np.int32)
    lit = LitPoints(points, np.zeros((len(x), 2)), np.zeros(len(x), np.int32), on_net)
    found = target_fit(scene, lit)
    assert found is not None
    plane, residual = found
    away = np.linalg.norm(points, axis=1)
    nearest = points[np.argmin(away)] / away.min()
    assert plane.offset == pytest.approx(away.min(), abs=1e-6)
    # The grid's nearest point is within 0.7 mm of the net's.
    np.testing.assert_allclose(plane.normal, nearest, atol=2e-3)
    assert residual < 1e-12
    if not any(curvature):
        flat = visible_fit(lit, SurfaceKind.NET)
        assert flat is not None
        np.testing.assert_allclose(plane.normal, flat[0].normal, atol=1e-12)


def test_the_plane_of_a_wall_is_that_of_its_own_light(renderer):
    scene = replace(_wall(0.6, 4.0, -6.0), walls=(Wall(), Wall(depth=0.1, yaw=1.2)))
    lit = renderer.lit_points(scene)
    on_target = np.abs(scene.target_plane().signed_distance(lit.points_in_dome)) < 1e-9
    assert 0.2 < on_target.mean() < 0.9
    found = target_fit(scene, lit)
    assert found is not None
    plane, residual = found
    assert residual < 1e-9
    assert plane.offset == pytest.approx(0.6, abs=1e-9)
    np.testing.assert_allclose(plane.normal, scene.target_plane().normal, atol=1e-9)
