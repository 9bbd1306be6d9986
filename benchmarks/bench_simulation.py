"""One simulated frame with its truth on one core, after the one-time trace of all pixels.

Run `python -m benchmarks simulation` for a table. For the wall the reference is a picture in plain
NumPy with as many rays a pixel, from rays that are traced before as well: daylight, lasers, water
and sensor, but no texture, shadow, light scattered by the sheets, nor truth. Both must be equally
bright. Threads, fish and bubbles nobody traces in NumPy; there the reference is what was asked for.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.rig import Rig
from aqualvs.simulation.cameras import expose, spread
from aqualvs.simulation.lasers import default_sources
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig, load_scenario
from aqualvs.simulation.scene import Scene

_TARGET_MS = 400.0
_NETS = ("net_diamond", "net_clutter")
_LASER = np.array([0.40, 1.0, 0.27])
_UP = np.array([0.10, -0.42, 0.90])


def run(quick: bool = False) -> list[dict[str, Any]]:
    """Least processor time of a frame."""
    rounds = 2 if quick else 5
    rows = [_wall_row(example_rig(), rounds)]
    rows += [_net_row(example_rig(), name, _TARGET_MS, rounds) for name in _NETS]
    if not quick:
        rows.append(_net_row(bluerov2_rig(), "net_clutter", None, rounds))
    return rows


def _wall_row(rig: Rig, rounds: int) -> dict[str, Any]:
    renderer, rays = Renderer(rig), plain_rays(rig)
    scene = load_scenario("wall").scene_at(0.0)
    ours = renderer.render(scene, 0.0, np.random.default_rng(0)).image
    plain = plain_wall(rig, scene, rays, np.random.default_rng(0))
    apart = float(np.median(plain)) / float(np.median(ours)) - 1.0
    # The wall's texture moves its own median by some percent.
    if abs(apart) > 0.1:
        raise RuntimeError(f"the reference is {100 * apart:.0f} % brighter")
    value = _best_ms(lambda: renderer.render(scene, 0.0, np.random.default_rng(0)), rounds)
    reference = _best_ms(lambda: plain_wall(rig, scene, rays, np.random.default_rng(0)), rounds)
    return _row(rig, "wall", value, reference)


def _net_row(rig: Rig, scenario: str, target: float | None, rounds: int) -> dict[str, Any]:
    renderer, rng = Renderer(rig), np.random.default_rng(0)
    scene = load_scenario(scenario).scene_at(0.0)
    return _row(rig, scenario, _best_ms(lambda: renderer.render(scene, 0.0, rng), rounds), target)


def _row(rig: Rig, scenario: str, value: float, reference: float | None) -> dict[str, Any]:
    width, height = rig.size_px
    return {
        "name": f"simulate {scenario} {width}x{height}",
        "value": value,
        "unit": "ms CPU",
        "reference": reference,
        "ratio": reference / value if reference else None,
    }


def plain_rays(rig: Rig) -> tuple[FloatArray, FloatArray]:
    """Origins and directions of 2 x 2 rays a pixel, shape (4 * height * width, 3)."""
    width, height = rig.size_px
    x, y = np.meshgrid(np.arange(2 * width) / 2 - 0.25, np.arange(2 * height) / 2 - 0.25)
    rays = rig.camera().rays(np.stack([x.ravel(), y.ravel()], axis=-1))
    return rays.origins, rays.directions


def plain_wall(
    rig: Rig, scene: Scene, rays: tuple[FloatArray, FloatArray], rng: np.random.Generator
) -> NDArray[np.uint8]:
    """A flat wall of one colour in the scene's light, water and sensor."""
    origins, directions = rays
    plane, water = scene.target_plane(), scene.water
    reach = (plane.offset - origins @ plane.normal) / (directions @ plane.normal)
    points = origins + reach[:, None] * directions
    sun = 0.55 + 0.72 * max(float(-plane.normal @ _UP), 0.0)
    laser = plain_laser_light(rig, points, water.attenuation[1])
    arriving = np.array(water.ambient) * sun + laser[:, None] * _LASER
    left = np.exp(-reach[:, None] * np.array(water.attenuation))
    veil = 1.0 + 0.55 * directions[:, 2] + 0.12 * directions[:, 0]
    seen = np.array(scene.walls[0].albedo) * arriving * left
    seen += np.array(water.veil) * veil[:, None] * (1.0 - left)
    width, height = rig.size_px
    light = seen.reshape(height, 2, width, 2, 3).mean(axis=(1, 3)).astype(np.float32)
    return expose(spread(light, water, scene.sensor), scene.sensor, rng)


def plain_laser_light(rig: Rig, points: FloatArray, attenuation: float) -> FloatArray:
    total = np.zeros(len(points))
    for laser, source in zip(rig.lasers, default_sources(rig), strict=True):
        off = points @ laser.plane.normal - laser.plane.offset
        distance = np.linalg.norm(points - source.position, axis=1)
        sigma = source.sigma + source.divergence * distance
        peak = source.power * 0.5 / distance * np.exp(-attenuation * distance)
        total += peak * source.sigma / sigma * np.exp(-0.5 * (off / sigma) ** 2)
    return total


def _best_ms(call: Callable[[], object], rounds: int) -> float:
    call()
    times = []
    for _ in range(rounds):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return 1e3 * min(times)
