"""Renderer of a scene as the rig's camera takes it.

Every pixel's corners are traced through the housing once; rays inside a pixel are interpolated
between its four corners (the housing bends them by less than 1e-6 px from that inside a pixel),
so any number of them costs no further refraction. The picture is divided into tiles; each tile
lists the ellipsoids and bubbles that it can show, and rays try only those (`tile_members`).

Marine snow is added after that: particles that drift before the camera and light up where a laser
sheet meets them (`add_snow`).
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel
from aqualvs.geometry.linear_algebra import unit
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import Rig
from aqualvs.simulation.cameras import (
    IDEAL,
    CornerRays,
    SimulatedCamera,
    between_corners,
    corner_rays,
    sees_out,
)
from aqualvs.simulation.lasers import (
    LaserSource,
    Sheets,
    default_sources,
    light_on_points,
    pack_sheets,
)
from aqualvs.simulation.scene import Scene
from aqualvs.simulation.shading import Light, Members, pack_light, radiance
from aqualvs.simulation.surfaces import Surfaces, pack_surfaces
from aqualvs.simulation.truth import Beams, LitPoints, beams_of, find_lit_points

# Particles drift in this box in `dome` and re-enter on the other side, in metres.
_LOW, _HIGH = np.array([-0.6, 0.12, -0.5]), np.array([0.6, 1.3, 0.5])
_DRIFT = np.array([0.03, -0.02, -0.012])
_RADII = (0.2e-3, 1.0e-3)


def add_snow(
    radiance: NDArray[np.float32], camera: Camera, scene: Scene, t: float, sheets: Sheets
) -> None:
    """Add the scene's marine snow to a radiance picture in place."""
    if scene.water.snow <= 0:
        return
    points, radii = _particles(scene.water.snow, t)
    if scene.target != "none":
        before = scene.target_plane().signed_distance(points) < 0.0
        points, radii = points[before], radii[before]
    pixels, valid = camera.project(points)
    points, radii = points[valid], radii[valid]
    lit = light_on_points(points, sheets, scene.water.attenuation)
    distance = np.linalg.norm(points, axis=-1)
    reach = np.exp(-np.outer(distance, scene.water.attenuation))
    colour = np.array(scene.water.ambient) + lit
    sizes = radii / distance * _pixels_per_radian(camera)
    reflectance = 0.7
    for pixel, size, light in zip(pixels[valid], sizes, reflectance * colour * reach, strict=True):
        _splat(radiance, pixel, float(size), light)


def _particles(count: int, t: float) -> tuple[FloatArray, FloatArray]:
    """Return positions and radii; each particle keeps its own drift through all frames."""
    rng = np.random.default_rng(20210126)
    start = rng.random((count, 3))
    own = 1.0 + 0.6 * rng.standard_normal((count, 3))
    turns = start + own * _DRIFT * t / (_HIGH - _LOW)
    radii = rng.uniform(*_RADII, count)
    return _LOW + (turns % 1.0) * (_HIGH - _LOW), radii


def _pixels_per_radian(camera: Camera) -> float:
    """Return the scale in the middle of the image, from two neighbouring rays."""
    width, height = camera.size_px
    pair = np.array([[width / 2.0, height / 2.0], [width / 2.0 + 1.0, height / 2.0]])
    directions = camera.rays(pair).directions
    return float(1.0 / np.linalg.norm(directions[1] - directions[0]))


def _splat(
    radiance: NDArray[np.float32], pixel: FloatArray, size: float, light: FloatArray
) -> None:
    """Add a round blob that keeps the light of particles smaller than a pixel."""
    smallest_px = 0.45
    sigma = max(0.6 * size, smallest_px)
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


# Side of a tile, in pixels.
TILE = 32


class TileMembers(NamedTuple):
    """Rows of the tables that each tile can show, as one array with the start of each tile."""

    n_columns: int  # Number of tiles in a row.
    ellipsoids: IntArray  # Rows, tile after tile.
    ellipsoid_start: IntArray  # Shape (n_tiles + 1,): start of each tile's part.
    bubbles: IntArray  # As `ellipsoids`.
    bubble_start: IntArray  # As `ellipsoid_start`.


def tile_members(camera: Camera, surfaces: Surfaces) -> TileMembers:
    """Return for every tile the ellipsoids and bubbles whose outline can reach it.

    A body that can be projected in part only (near the dome, or at the edge of the lens model) is
    listed everywhere: slower, but never wrong.
    """
    columns, rows = (-(-side // TILE) for side in camera.size_px)
    e, b = surfaces.ellipsoids, surfaces.bubbles
    reach = [1.0 / np.linalg.norm(row[3:12].reshape(3, 3), axis=1).min() for row in e]
    ellipsoids = _lists(camera, e[:, :3], np.array(reach), columns, rows)
    bubbles = _lists(camera, b[:, :3], b[:, 3], columns, rows)
    return TileMembers(columns, *ellipsoids, *bubbles)


def _lists(
    camera: Camera, centres: FloatArray, radii: FloatArray, columns: int, rows: int
) -> tuple[IntArray, IntArray]:
    shown = np.zeros((rows, columns, len(centres)), dtype=np.bool_)
    for i, (centre, radius) in enumerate(zip(centres, radii, strict=True)):
        shown[..., i] = _tiles_of(camera, centre, float(radius), columns, rows)
    flat = shown.reshape(rows * columns, len(centres))
    start = np.concatenate([[0], np.cumsum(flat.sum(axis=1))]).astype(np.int64)
    return np.nonzero(flat)[1].astype(np.int64), start


def _tiles_of(
    camera: Camera, centre: FloatArray, radius: float, columns: int, rows: int
) -> BoolArray:
    """Mark the tiles under the box around a sphere."""
    steps = np.linspace(-1.0, 1.0, 3)
    grid = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    pixels, valid = camera.project(centre + radius * grid)
    marked = np.ones((rows, columns), dtype=np.bool_)
    # Distance, in metres, beyond which a body that cannot be projected is out of sight.
    near = 0.2
    if not valid.any() and np.linalg.norm(centre) > radius + near:
        return ~marked
    if not valid.all():
        return marked
    # Margin of the outline of a sphere, which is sampled at points of a box around it.
    margin_px = 4.0
    low, high = pixels.min(axis=0) - margin_px, pixels.max(axis=0) + margin_px
    x, y = np.arange(columns) * TILE, np.arange(rows) * TILE
    marked &= ((x + TILE > low[0]) & (x < high[0]))[None, :]
    marked &= ((y + TILE > low[1]) & (y < high[1]))[:, None]
    return marked


SceneAt: TypeAlias = Callable[[float], Scene]
"""From a time in seconds to the scene at that time, such as `Scenario.scene_at`."""


@dataclass(frozen=True, slots=True)
class RenderedFrame:
    """One rendered frame and its truth."""

    image: NDArray[np.uint8]  # Shape (height, width, 3): red, green, blue.
    # Points where the middles of the laser sheets meet surfaces that the camera sees.
    lit: LitPoints


@dataclass(slots=True)
class Renderer:
    """Renderer of scenes for one rig in one water.

    Raises `RigError` if the sources do not fit the rig's lasers.
    """

    rig: Rig  # Camera, housing, water and lasers.
    # One for each laser; by default they follow from the rig (`default_sources`).
    sources: Sequence[LaserSource] = ()
    samples: int = 2  # Rays along each side of a pixel: 2 means four rays a pixel.
    # Number of bands of rows rendered in parallel; the picture does not depend on it.
    threads: int = 1
    camera: SimulatedCamera = IDEAL  # Sensor and processing; the rig has the place of the lens.

    _corners: CornerRays = field(init=False, repr=False)
    _beams: Beams = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.sources:
            self.sources = default_sources(self.rig)
        self._corners = corner_rays(self.rig.camera())
        self._beams = beams_of(self.rig, self.sources, self.camera.filters)

    def render(
        self, scene: Scene, t: float = 0.0, rng: np.random.Generator | None = None
    ) -> RenderedFrame:
        """Return the picture at time `t` and its truth; without `rng` it has no noise.

        The whole picture is taken at one instant, whatever the rig's shutter; see `take`.
        """
        surfaces, sheets = self._pack(scene, t)
        light = self._radiance(scene, t, surfaces, sheets)
        image = self.camera.picture(light, scene.water, scene.sensor, t, rng)
        return RenderedFrame(image, find_lit_points(self.rig, surfaces, sheets))

    def take(
        self, scene_at: SceneAt, t: float = 0.0, rng: np.random.Generator | None = None
    ) -> RenderedFrame:
        """Return the picture with its middle at time `t`, as the rig's shutter takes it.

        Truth and marine snow are those of the middle. Each field of an interlaced picture has its
        own blur and noise, as if the other one did not exist.

        Parameters
        ----------
        scene_at : callable
            Scene at any time from the first row to the last.
        t : float
            In seconds.
        rng : Generator, optional
            Without it the picture has no noise.
        """
        scene, shutter = scene_at(t), self.rig.shutter
        if shutter.instant:
            return self.render(scene, t, rng)
        if shutter.is_interlaced:
            half = 0.5 * shutter.readout
            fields = [self.exposed_at(scene_at, at, rng) for at in (t - half, t + half)]
            image = fields[1]
            image[shutter.first_row :: 2] = fields[0][shutter.first_row :: 2]
        else:
            image = self.exposed_at(scene_at, t, rng)
        return RenderedFrame(image, self.lit_points(scene, t))

    def exposed_at(
        self, scene_at: SceneAt, t: float, rng: np.random.Generator | None = None
    ) -> NDArray[np.uint8]:
        """Return a picture exposed around time `t`: of an interlaced camera, all rows at once.

        Of a field only its own rows count. See `take` for the arguments.
        """
        scene = scene_at(t)
        light = self._exposed(scene_at, t)
        add_snow(light, self.rig.camera(), self.camera.light(scene), t, self._pack(scene, t)[1])
        return self.camera.picture(light, scene.water, scene.sensor, t, rng)

    def _exposed(self, scene_at: SceneAt, t: float) -> NDArray[np.float32]:
        """Return the mean light of every row over its exposure, without marine snow."""
        width, height = self.rig.size_px
        shutter = self.rig.shutter
        n_bands = 1
        # Rows of a rolling picture that are rendered at one instant lie within this time; stripes
        # that move by 300 px a second are off by 0.04 px at most, to and fro.
        band_s = 0.25e-3
        if shutter.rolls:
            n_bands = min(math.ceil(abs(shutter.readout) / band_s), height)
        # Instants of an exposure are this near to each other: 0.6 px at the same speed, less than
        # the width of a stripe.
        instant_s = 2e-3
        n_instants = max(math.ceil(shutter.exposure / instant_s), 1)
        instants = ((np.arange(n_instants) + 0.5) / n_instants - 0.5) * shutter.exposure
        out = np.zeros((height, width, 3), dtype=np.float32)
        now = np.zeros_like(out)
        for low, high in pairwise(np.linspace(0, height, n_bands + 1).astype(int).tolist()):
            middle = t
            if shutter.rolls:
                middle += float(shutter.row_times(0.5 * (low + high - 1), height))
            for at in (middle + instants).tolist():
                scene = scene_at(at)
                self._trace(now, (low, high), scene, at, *self._pack(scene, at), self._corners)
                out[low:high] += now[low:high] / np.float32(n_instants)
        return out

    def radiance(
        self, scene: Scene, t: float = 0.0, where: BoolArray | None = None
    ) -> NDArray[np.float32]:
        """Return the radiance at the lens at time `t`, before blur, noise and saturation.

        Parameters
        ----------
        scene : Scene
            At time `t`.
        t : float
            In seconds.
        where : bool array, shape (height, width), optional
            Pixels to be traced; others may lack all light except that of marine snow.

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
            return surfaces, pack_sheets(replace(self.rig, lasers=()), ())
        return surfaces, self._beams.ended_by(surfaces)

    def _radiance(
        self,
        scene: Scene,
        t: float,
        surfaces: Surfaces,
        sheets: Sheets,
        where: BoolArray | None = None,
    ) -> NDArray[np.float32]:
        width, height = self.rig.size_px
        out = np.zeros((height, width, 3), dtype=np.float32)
        rays = self._corners if where is None else self._corners.only(where)
        self._trace(out, (0, height), scene, t, surfaces, sheets, rays)
        add_snow(out, self.rig.camera(), self.camera.light(scene), t, sheets)
        return out

    def _trace(
        self,
        out: NDArray[np.float32],
        rows: tuple[int, int],
        scene: Scene,
        t: float,
        surfaces: Surfaces,
        sheets: Sheets,
        rays: CornerRays,
    ) -> None:
        """Write the light of some rows, from the first to before the last, into a picture."""
        members = tile_members(self.rig.camera(), surfaces)
        light = pack_light(self.camera.light(scene), t)

        def render_band(band: tuple[int, int]) -> None:
            _render(band, rays, self.samples, surfaces, members, sheets, light, out)

        if self.threads == 1:
            # Of a picture that rolls this is called for every few rows.
            render_band(rows)
            return
        edges = np.linspace(*rows, self.threads + 1).astype(int).tolist()
        with ThreadPoolExecutor(self.threads) as pool:
            list(pool.map(render_band, pairwise(edges)))


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
    sheets: Sheets,
    light: Light,
    out: NDArray[np.float32],
) -> None:
    """Average samples x samples rays over every pixel whose four corners see out."""
    weight = 1.0 / (samples * samples)
    origins, directions, valid = rays
    for row in range(band[0], band[1]):
        for column in range(out.shape[1]):
            if not sees_out(valid, row, column):
                continue
            near = _members_at(members, row, column)
            red, green, blue = 0.0, 0.0, 0.0
            for k in range(samples * samples):
                x, y = (k % samples + 0.5) / samples, (k // samples + 0.5) / samples
                o = between_corners(origins, row, column, x, y)
                d = unit(between_corners(directions, row, column, x, y))
                seen = radiance(o, d, s, near, sheets, light)
                red, green, blue = red + seen[0], green + seen[1], blue + seen[2]
            out[row, column, 0] = red * weight
            out[row, column, 1] = green * weight
            out[row, column, 2] = blue * weight
