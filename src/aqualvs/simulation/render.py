"""Pictures of a scene as the rig's camera takes them.

Every pixel's corners are traced through the housing once; rays inside a pixel are interpolated
between its four corners (the housing bends them by less than 1e-6 px from that inside a pixel),
so any number of them costs no further refraction.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel
from aqualvs.optics.rig import Rig
from aqualvs.simulation.cameras import IDEAL, SimulatedCamera
from aqualvs.simulation.culling import TILE, TileMembers, tile_members
from aqualvs.simulation.lasers import LaserSource, Sheets, default_sources
from aqualvs.simulation.lit_points import LitPoints, find_lit_points, light_sheets
from aqualvs.simulation.scene import Scene
from aqualvs.simulation.shading import Light, Members, pack_light, radiance
from aqualvs.simulation.snow import add_snow
from aqualvs.simulation.surfaces import Surfaces, pack_surfaces
from aqualvs.simulation.vectors import Vec, combine, row3, unit

_ZERO = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Picture:
    """One rendered frame and its truth.

    Attributes
    ----------
    image : uint8 array, shape (height, width, 3)
        Red, green, blue.
    lit : LitPoints
        Where the middles of the laser sheets meet surfaces that the camera sees.
    """

    image: NDArray[np.uint8]
    lit: LitPoints


@dataclass(slots=True)
class Renderer:
    """Renders scenes for one rig in one water.

    Attributes
    ----------
    rig : Rig
        Camera, housing, water and lasers.
    sources : sequence of LaserSource
        One for each laser; by default they follow from the rig (`default_sources`).
    samples : int
        Rays along each side of a pixel: 2 means four rays a pixel.
    threads : int
        Bands of rows that are rendered at the same time; the picture does not depend on it.
    camera : SimulatedCamera
        Sensor and processing; where the lens is, the rig says.

    Raises
    ------
    RigError
        If the sources do not fit the rig's lasers.
    """

    rig: Rig
    sources: Sequence[LaserSource] = ()
    samples: int = 2
    threads: int = 1
    camera: SimulatedCamera = IDEAL
    _corners: "CornerRays" = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.sources:
            self.sources = default_sources(self.rig)
        self._corners = corner_rays(self.rig)

    def render(
        self, scene: Scene, t: float = 0.0, rng: np.random.Generator | None = None
    ) -> Picture:
        """Return the picture at time `t` and its truth; without `rng` there is no noise."""
        surfaces, sheets = self._pack(scene, t)
        light = self._radiance(scene, t, surfaces, sheets)
        image = self.camera.picture(light, scene.water, scene.sensor, t, rng)
        return Picture(image, find_lit_points(self.rig, surfaces, sheets))

    def radiance(
        self, scene: Scene, t: float = 0.0, where: BoolArray | None = None
    ) -> NDArray[np.float32]:
        """Return what reaches the lens at time `t`, before blur, noise and saturation.

        Parameters
        ----------
        scene : Scene
            At time `t`.
        t : float
            In seconds.
        where : bool array, shape (height, width), optional
            Pixels that must be traced; others may lack all light but that of marine snow.

        Returns
        -------
        radiance : float32 array, shape (height, width, 3)
            Red, green, blue; 1 is the sensor's full scale at gain 1. Zero where the lens model
            or the housing lets no light through.
        """
        return self._radiance(scene, t, *self._pack(scene, t), where)

    def lit_points(self, scene: Scene, t: float = 0.0) -> LitPoints:
        """Return the truth of the stripes at time `t` without rendering a picture."""
        return find_lit_points(self.rig, *self._pack(scene, t))

    def _pack(self, scene: Scene, t: float) -> tuple[Surfaces, Sheets]:
        surfaces = pack_surfaces(scene, t)
        if not scene.lasers_on:
            return surfaces, light_sheets(replace(self.rig, lasers=()), (), surfaces)
        return surfaces, light_sheets(self.rig, self.sources, surfaces, self.camera.filters)

    def _radiance(
        self,
        scene: Scene,
        t: float,
        surfaces: Surfaces,
        sheets: Sheets,
        where: BoolArray | None = None,
    ) -> NDArray[np.float32]:
        width, height = self.rig.size_px
        camera = self.rig.camera()
        out = np.zeros((height, width, 3), dtype=np.float32)
        members = tile_members(camera, self.rig.size_px, surfaces)
        everything = np.arange(len(surfaces.ellipsoids), dtype=np.int64)
        light, rays = pack_light(self.camera.light(scene), t), self._corners
        if where is not None:
            rays = rays.only(where)

        def render_band(band: tuple[int, int]) -> None:
            _render(band, rays, self.samples, surfaces, members, everything, sheets, light, out)

        edges = np.linspace(0, height, self.threads + 1).astype(int).tolist()
        with ThreadPoolExecutor(self.threads) as pool:
            list(pool.map(render_band, pairwise(edges)))
        add_snow(out, camera, self.camera.light(scene), t, sheets)
        return out


class CornerRays(NamedTuple):
    """Rays through the corners of the pixels, shape (height + 1, width + 1, ...)."""

    origins: FloatArray
    directions: FloatArray
    valid: BoolArray

    def only(self, where: BoolArray) -> "CornerRays":
        """Return the same rays, invalid but at the corners of some pixels (height, width)."""
        wanted = np.zeros_like(self.valid)
        for rows in (slice(None, -1), slice(1, None)):
            for columns in (slice(None, -1), slice(1, None)):
                wanted[rows, columns] |= where
        return self._replace(valid=self.valid & wanted)


def corner_rays(rig: Rig) -> CornerRays:
    """Trace the corners of all pixels through the housing."""
    width, height = rig.size_px
    x, y = np.meshgrid(np.arange(width + 1) - 0.5, np.arange(height + 1) - 0.5)
    rays = rig.camera().rays(np.stack([x, y], axis=-1))
    return CornerRays(
        np.ascontiguousarray(rays.origins), np.ascontiguousarray(rays.directions), rays.valid
    )


@inline_borrowing_kernel
def _between(corners: FloatArray, row: int, column: int, x: float, y: float) -> Vec:
    """Bilinear value between the corners of a pixel, x and y in 0..1."""
    top = combine(
        row3(corners[row], column, 0), 1.0 - x, row3(corners[row], column + 1, 0), x, _ZERO, 0.0
    )
    low = combine(
        row3(corners[row + 1], column, 0),
        1.0 - x,
        row3(corners[row + 1], column + 1, 0),
        x,
        _ZERO,
        0.0,
    )
    return combine(top, 1.0 - y, low, y, _ZERO, 0.0)


@inline_borrowing_kernel
def _members_at(members: TileMembers, row: int, column: int) -> Members:
    i = (row // TILE) * members.n_columns + column // TILE
    return Members(
        members.ellipsoids,
        members.bubbles,
        members.ellipsoid_start[i],
        members.ellipsoid_start[i + 1],
        members.bubble_start[i],
        members.bubble_start[i + 1],
    )


@borrowing_kernel
def _render(
    band: tuple[int, int],
    rays: CornerRays,
    samples: int,
    s: Surfaces,
    members: TileMembers,
    everything: IntArray,
    sheets: Sheets,
    light: Light,
    out: NDArray[np.float32],
) -> None:
    """Average samples x samples rays over every pixel whose four corners see out."""
    weight = 1.0 / (samples * samples)
    origins, directions, valid = rays
    for row in range(band[0], band[1]):
        for column in range(out.shape[1]):
            if not (
                valid[row, column]
                and valid[row, column + 1]
                and valid[row + 1, column]
                and valid[row + 1, column + 1]
            ):
                continue
            near = _members_at(members, row, column)
            red, green, blue = 0.0, 0.0, 0.0
            for k in range(samples * samples):
                x, y = (k % samples + 0.5) / samples, (k // samples + 0.5) / samples
                o = _between(origins, row, column, x, y)
                d = unit(_between(directions, row, column, x, y))
                seen = radiance(o, d, s, near, everything, sheets, light)
                red, green, blue = red + seen[0], green + seen[1], blue + seen[2]
            out[row, column, 0] = red * weight
            out[row, column, 1] = green * weight
            out[row, column, 2] = blue * weight
