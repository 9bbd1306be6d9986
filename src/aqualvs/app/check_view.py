"""How much of the outer medium a camera sees."""

import numpy as np

from aqualvs.geometry.rays import Rays
from aqualvs.optics.camera import Camera


def field_of_view(camera: Camera) -> tuple[float, float]:
    """Horizontal and vertical field of view in the outer medium, in radians; NaN where none."""
    width, height = camera.size_px
    middle_x, middle_y = (width - 1) / 2.0, (height - 1) / 2.0
    ends = [[-0.5, middle_y], [width - 0.5, middle_y], [middle_x, -0.5], [middle_x, height - 0.5]]
    rays = camera.rays(ends)
    return _angle(rays, 0, 1), _angle(rays, 2, 3)


def blind_fraction(camera: Camera) -> float:
    """Fraction of the pixels, on a grid, that see nothing of the outer medium."""
    width, height = camera.size_px
    x, y = np.meshgrid(np.linspace(0, width - 1, 33), np.linspace(0, height - 1, 33))
    rays = camera.rays(np.stack([x, y], axis=-1))
    return float(np.mean(~rays.valid))


def _angle(rays: Rays, first: int, second: int) -> float:
    cosine = float(rays.directions[first] @ rays.directions[second])
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))
