"""Marine snow: particles that drift before the camera and flash where a laser sheet meets them."""

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.optics.camera import Camera
from aqualvs.simulation.lasers import Sheets, light_on_points
from aqualvs.simulation.scene import Scene

# Particles drift in this box in `dome` and re-enter on the other side, in metres.
_LOW, _HIGH = np.array([-0.6, 0.12, -0.5]), np.array([0.6, 1.3, 0.5])
_DRIFT = np.array([0.03, -0.02, -0.012])
_RADII = (0.2e-3, 1.0e-3)
_REFLECTANCE = 0.7
_SMALLEST_PX = 0.45


def add_snow(
    radiance: NDArray[np.float32], camera: Camera, scene: Scene, t: float, sheets: Sheets
) -> None:
    """Add the scene's marine snow to a radiance picture in place."""
    if scene.water.snow <= 0:
        return
    points, radii = _particles(scene.water.snow, t)
    ahead = _before_target(points, scene)
    pixels, valid = camera.project(points[ahead])
    points, radii = points[ahead][valid], radii[ahead][valid]
    lit = light_on_points(points, sheets, scene.water.attenuation)
    distance = np.linalg.norm(points, axis=-1)
    reach = np.exp(-np.outer(distance, scene.water.attenuation))
    colour = np.array(scene.water.ambient) + lit
    sizes = radii / distance * _pixels_per_radian(camera)
    for pixel, size, light in zip(pixels[valid], sizes, _REFLECTANCE * colour * reach, strict=True):
        _splat(radiance, pixel, float(size), light)


def _particles(count: int, t: float) -> tuple[FloatArray, FloatArray]:
    """Positions and radii; each particle keeps its own drift through all frames."""
    rng = np.random.default_rng(20210126)
    start = rng.random((count, 3))
    own = 1.0 + 0.6 * rng.standard_normal((count, 3))
    turns = start + own * _DRIFT * t / (_HIGH - _LOW)
    radii = rng.uniform(*_RADII, count)
    return _LOW + (turns % 1.0) * (_HIGH - _LOW), radii


def _before_target(points: FloatArray, scene: Scene) -> BoolArray:
    if scene.target == "none":
        return np.ones(len(points), dtype=np.bool_)
    before: BoolArray = scene.target_plane().signed_distance(points) < 0.0
    return before


def _pixels_per_radian(camera: Camera) -> float:
    """Scale in the middle of the image, from two neighbouring rays."""
    width, height = camera.size_px
    pair = np.array([[width / 2.0, height / 2.0], [width / 2.0 + 1.0, height / 2.0]])
    directions = camera.rays(pair).directions
    return float(1.0 / np.linalg.norm(directions[1] - directions[0]))


def _splat(
    radiance: NDArray[np.float32], pixel: FloatArray, size: float, light: FloatArray
) -> None:
    """Add a round blob that keeps the particle's light when it is smaller than a pixel."""
    sigma = max(0.6 * size, _SMALLEST_PX)
    half = int(np.ceil(3.0 * sigma))
    x0, y0 = (int(value) for value in np.rint(pixel))
    height, width = radiance.shape[:2]
    left, right = max(x0 - half, 0), min(x0 + half + 1, width)
    top, bottom = max(y0 - half, 0), min(y0 + half + 1, height)
    if left >= right or top >= bottom:
        return
    x = np.exp(-0.5 * ((np.arange(left, right) - pixel[0]) / sigma) ** 2)
    y = np.exp(-0.5 * ((np.arange(top, bottom) - pixel[1]) / sigma) ** 2)
    cover = min((size / (2.0**0.5 * sigma)) ** 2, 0.8)
    radiance[top:bottom, left:right] += (cover * y[:, None, None] * x[:, None] * light).astype(
        np.float32
    )
