"""Pictures of printed panels: calibration boards, boxes of markers, plates.

A panel is a rectangle anywhere in `dome` with a texture on it. Every pixel's corners are traced
through the housing once; rays inside a pixel are interpolated between them, as in
`aqualvs.simulation.render`. Compiled kernels give a ray the exact mean of the texture over its own
share of the pixel (the sum of a grid of cells over a rectangle is bilinear in its corners), so that
no aliasing shifts an edge.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel
from aqualvs.geometry.linear_algebra import Vec, along, dot, minus, row3, unit
from aqualvs.geometry.transforms import SE3
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
    COLOUR,
    COLOUR_BALANCED,
    CUT,
    SOURCE,
    ColourFilters,
    Sheets,
    default_sources,
    pack_sheets,
    peak_irradiance,
    sheet_coordinates,
)
from aqualvs.simulation.scene import CameraSensor, Vector, WaterOptics
from aqualvs.simulation.textures import Texture

# Columns of the panel table.
_ORIGIN, _RIGHT, _DOWN, _INTO = 0, 3, 6, 9
COLUMNS = 12


class PanelTables(NamedTuple):
    """Panels as tables."""

    # Shape (P, 12): top-left corner, then unit vectors to the right, down and into the panel, in
    # `dome`.
    frames: FloatArray
    cells: FloatArray  # Shape (P,): side of a cell, in metres.
    shape: IntArray  # Shape (P, 2): rows and columns.
    start: IntArray  # Shape (P,): start of each panel's part of `sums`.
    # `sums[start[i] + r * (columns + 1) + c]` is the sum of the albedo over the first r rows and c
    # columns of panel i.
    sums: FloatArray


class Lamp(NamedTuple):
    """Lamp: place in `dome`, radiance of white that faces it, and the lamp's share of that."""

    place: Vec
    level: float
    share: float


@borrowing_kernel
def render_panels(
    rays: CornerRays,
    samples: int,
    panels: PanelTables,
    sheets: Sheets,
    lamp: Lamp,
    out: NDArray[np.float32],
) -> None:
    """Average samples x samples rays over every pixel whose four corners see out."""
    weight, step = 1.0 / (samples * samples), 1.0 / samples
    valid = rays.valid
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            if not sees_out(valid, row, column):
                continue
            room, laser = 0.0, 0.0
            for k in range(samples * samples):
                x, y = (k % samples + 0.5) * step, (k // samples + 0.5) * step
                seen = _radiance(rays, row, column, x, y, step, panels, sheets, lamp)
                room, laser = room + seen[0], laser + seen[1]
            out[row, column, 0] = room * weight
            out[row, column, 1] = laser * weight


@inline_borrowing_kernel
def _radiance(
    rays: CornerRays,
    row: int,
    column: int,
    x: float,
    y: float,
    step: float,
    panels: PanelTables,
    sheets: Sheets,
    lamp: Lamp,
) -> tuple[float, float]:
    """Return room light and laser light along a ray, `step` pixels wide."""
    o, d = _ray(rays, row, column, x, y)
    i, t = _nearest(o, d, panels)
    if i < 0:
        return 0.0, 0.0
    p = along(o, d, t)
    u, v = _cell_of(p, panels, i)
    u_x, v_x = _shift(rays, row, column, x + 0.5 * step, y, panels, i, u, v)
    u_y, v_y = _shift(rays, row, column, x, y + 0.5 * step, panels, i, u, v)
    albedo = _mean(panels, i, u, v, abs(u_x) + abs(u_y), abs(v_x) + abs(v_y))
    normal = row3(panels.frames, i, _INTO)
    to_lamp = unit(minus(lamp.place, p))
    room = lamp.level * (1.0 - lamp.share * (1.0 - abs(dot(normal, to_lamp))))
    return albedo * room, albedo * _laser_light(p, normal, i, panels, sheets)


@inline_borrowing_kernel
def _ray(rays: CornerRays, row: int, column: int, x: float, y: float) -> tuple[Vec, Vec]:
    """Return the ray at (x, y) in 0..1 inside a pixel."""
    return (
        between_corners(rays.origins, row, column, x, y),
        unit(between_corners(rays.directions, row, column, x, y)),
    )


@inline_borrowing_kernel
def _meet(o: Vec, d: Vec, panels: PanelTables, i: int) -> float:
    """Return the distance to a panel's plane along a ray; infinite or NaN if parallel."""
    into = row3(panels.frames, i, _INTO)
    return dot(minus(row3(panels.frames, i, _ORIGIN), o), into) / dot(d, into)


@inline_borrowing_kernel
def _cell_of(p: Vec, panels: PanelTables, i: int) -> tuple[float, float]:
    """Return column and row of a point of a panel's plane, in cells from its top left."""
    rel = minus(p, row3(panels.frames, i, _ORIGIN))
    scale = 1.0 / panels.cells[i]
    return (
        scale * dot(rel, row3(panels.frames, i, _RIGHT)),
        scale * dot(rel, row3(panels.frames, i, _DOWN)),
    )


@inline_borrowing_kernel
def _covers(p: Vec, panels: PanelTables, i: int) -> bool:
    u, v = _cell_of(p, panels, i)
    return bool(0.0 <= u <= panels.shape[i, 1] and 0.0 <= v <= panels.shape[i, 0])


@inline_borrowing_kernel
def _nearest(o: Vec, d: Vec, panels: PanelTables) -> tuple[int, float]:
    """Return the first panel that a ray meets and its distance; -1 if none."""
    best, where = -1, np.inf
    for i in range(panels.frames.shape[0]):
        t = _meet(o, d, panels, i)
        if 0.0 < t < where and _covers(along(o, d, t), panels, i):
            best, where = i, t
    return best, where


@inline_borrowing_kernel
def _shift(
    rays: CornerRays,
    row: int,
    column: int,
    x: float,
    y: float,
    panels: PanelTables,
    i: int,
    u: float,
    v: float,
) -> tuple[float, float]:
    """Return the offset from (u, v), in cells, of a neighbouring ray on the panel's plane."""
    o, d = _ray(rays, row, column, x, y)
    near = _cell_of(along(o, d, _meet(o, d, panels, i)), panels, i)
    return near[0] - u, near[1] - v


@inline_borrowing_kernel
def _mean(panels: PanelTables, i: int, u: float, v: float, half_u: float, half_v: float) -> float:
    """Return the mean albedo over the part of a rectangle around (u, v) on the panel."""
    rows, columns = panels.shape[i]
    # Avoid 0 / 0 for a rectangle without area.
    half_u, half_v = max(half_u, 1e-6), max(half_v, 1e-6)
    left, right = max(u - half_u, 0.0), min(u + half_u, float(columns))
    top, low = max(v - half_v, 0.0), min(v + half_v, float(rows))
    total = _sum_to(panels, i, right, low) - _sum_to(panels, i, left, low)
    total -= _sum_to(panels, i, right, top) - _sum_to(panels, i, left, top)
    return total / ((right - left) * (low - top))


@inline_borrowing_kernel
def _sum_to(panels: PanelTables, i: int, u: float, v: float) -> float:
    """Return the sum of the albedo left of u and above v."""
    rows, columns = panels.shape[i]
    c, r = min(int(u), columns - 1), min(int(v), rows - 1)
    a, b = u - c, v - r
    k = panels.start[i] + r * (columns + 1) + c
    sums, below = panels.sums, k + columns + 1
    upper = sums[k] * (1.0 - a) + sums[k + 1] * a
    lower = sums[below] * (1.0 - a) + sums[below + 1] * a
    return float(upper * (1.0 - b) + lower * b)


@inline_borrowing_kernel
def _laser_light(p: Vec, normal: Vec, own: int, panels: PanelTables, sheets: Sheets) -> float:
    """Return the laser light that reaches a point of a panel, all sheets together."""
    light = 0.0
    for j in range(sheets.table.shape[0]):
        off, distance, place, sigma = sheet_coordinates(p, sheets, j)
        if place < 0.0 or abs(off) > CUT * sigma:
            continue
        way = minus(row3(sheets.table, j, SOURCE), p)
        if _is_shadowed(p, way, own, panels):
            continue
        peak = peak_irradiance(distance, sigma, place, 0.0, sheets, j)
        light += peak * np.exp(-0.5 * (off / sigma) ** 2) * abs(dot(unit(way), normal))
    return light


@inline_borrowing_kernel
def _is_shadowed(p: Vec, way: Vec, own: int, panels: PanelTables) -> bool:
    """Return whether a panel stands on the straight way from a point to a source."""
    # A laser's light that ends within this share of its way from a panel has met it there.
    at_end = 1e-6
    for i in range(panels.frames.shape[0]):
        if i != own:
            t = _meet(p, way, panels, i)
            if at_end < t < 1.0 - at_end and _covers(along(p, way, t), panels, i):
                return True
    return False


@dataclass(frozen=True, slots=True)
class Panel:
    """A printed rectangle."""

    # Of the frame with x to the right, y down, z into the panel and its origin at the outer corner
    # of the top-left cell.
    dome_from_panel: SE3
    texture: Texture  # The print; from behind it is seen mirrored.


@dataclass(frozen=True, slots=True, kw_only=True)
class RoomLight:
    """Light besides the lasers: an even part, and that of a lamp far behind the camera."""

    level: float = 0.62  # Radiance of a white panel that faces the lamp.
    lamp: Vector = (0.5, -0.6, 0.9)  # The lamp's place in `dome`, in metres.
    # Share of the light that falls off with the angle to the lamp, 0 to 1.
    lamp_share: float = 0.45
    tint: Vector = (1.0, 0.98, 0.93)  # Red, green and blue of white.
    veil: Vector = (0.0, 0.0, 0.0)  # Radiance that the water adds everywhere.


@dataclass(frozen=True, slots=True, kw_only=True)
class PanelScene:
    """Scene of panels in front of the camera."""

    panels: Sequence[Panel]  # The nearest one on a ray is seen.
    light: RoomLight = field(default_factory=RoomLight)  # Light besides the lasers.
    # Blur, noise and tone of the camera.
    sensor: CameraSensor = field(default_factory=CameraSensor)


@dataclass(slots=True)
class PanelRenderer:
    """Renderer of panels for one camera."""

    camera: Camera  # Behind its dome, in any medium, or bare.
    sheets: Sheets | None = None  # The lasers, see `panel_sheets`; None switches them off.
    samples: int = 2  # Rays along each side of a pixel.
    # Sensor and processing; the sheets must be packed with its filters.
    eye: SimulatedCamera = IDEAL

    _rays: CornerRays = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._rays = corner_rays(self.camera)

    def render(
        self, scene: PanelScene, rng: np.random.Generator | None = None, t: float = 0.0
    ) -> NDArray[np.uint8]:
        """Return the picture (height, width, 3), red, green, blue; without `rng` no noise.

        Exposure and white balance of `eye` drift with the time `t`, in seconds. Raises
        `OptionError` if the scene has no panels.
        """
        clear = WaterOptics(forward_scatter=0.0)
        return self.eye.picture(self.radiance(scene), clear, scene.sensor, t, rng)

    def radiance(self, scene: PanelScene) -> NDArray[np.float32]:
        """Return the radiance at the lens, float32 (height, width, 3), before blur.

        It is not clipped: 1 is the sensor's full scale at gain 1. Black where a ray meets no
        panel, or the lens model or the housing lets no light through.
        """
        if not scene.panels:
            raise OptionError("a picture of no panels; give one at least")
        width, height = self.camera.size_px
        light, tables = scene.light, _pack(scene.panels)
        lamp = Lamp(light.lamp, light.level, light.lamp_share)
        room, veil = np.array(light.tint, np.float32), np.array(light.veil, np.float32)
        out = np.zeros((height, width, 3), dtype=np.float32)
        for k, sheets in enumerate(_by_colour(self.sheets)):
            seen = np.zeros((height, width, 2), dtype=np.float32)
            render_panels(self._rays, self.samples, tables, sheets, lamp, seen)
            if k == 0:
                out += seen[..., :1] * room
            if len(sheets.table):
                out += seen[..., 1:] * sheets.table[0, COLOUR : COLOUR + 3].astype(np.float32)
        return np.asarray(out + veil)


def panel_sheets(
    rig: Rig, *, power: float = 8.0, filters: ColourFilters = COLOUR_BALANCED
) -> Sheets:
    """Return the sheets of a rig's lasers in the rig's medium, all of one power.

    Raises `RigError` if a laser's plane is square to the view.
    """
    sources = [replace(source, power=power) for source in default_sources(rig)]
    return pack_sheets(rig, sources, filters)


def _by_colour(sheets: Sheets | None) -> list[Sheets]:
    """Return the sheets of each colour; one empty table where there are none."""
    if sheets is None or not len(sheets.table):
        none = np.zeros((0, 1))
        return [Sheets(none, none, none, none, none)]
    _, kind = np.unique(sheets.table[:, COLOUR : COLOUR + 3], axis=0, return_inverse=True)
    return [Sheets(*(part[kind == k] for part in sheets)) for k in range(int(kind.max()) + 1)]


def _pack(panels: Sequence[Panel]) -> PanelTables:
    frames, sums = np.empty((len(panels), COLUMNS)), []
    for row, panel in zip(frames, panels, strict=True):
        pose = panel.dome_from_panel
        row[:3], row[3:] = pose.translation, pose.rotation.T.ravel()
        sums.append(np.pad(panel.texture.albedo, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1))
    sizes = [0, *(table.size for table in sums)]
    return PanelTables(
        frames,
        np.array([panel.texture.cell for panel in panels]),
        np.array([panel.texture.albedo.shape for panel in panels], np.int64),
        np.cumsum(sizes)[:-1].astype(np.int64),
        np.concatenate([table.ravel() for table in sums]),
    )
