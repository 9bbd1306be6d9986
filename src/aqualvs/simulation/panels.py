"""Pictures of printed panels: calibration boards, boxes of markers, plates.

A panel is a rectangle anywhere in `dome` with a texture on it. Every pixel's corners are traced
through the housing once; rays inside a pixel are interpolated between them, as in
`aqualvs.simulation.render`. A ray takes the mean of the texture over its own share of the pixel,
exactly (the sum of a grid of cells over a rectangle is bilinear in its corners), so that no
aliasing pulls an edge to one side.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from aqualvs.errors import OptionError
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import Rig
from aqualvs.simulation.cameras import IDEAL, SimulatedCamera
from aqualvs.simulation.lasers import COLOUR, Sheets, default_sources, pack_sheets
from aqualvs.simulation.panel_kernels import COLUMNS, CornerRays, Lamp, PanelTables, render_panels
from aqualvs.simulation.panel_textures import Texture
from aqualvs.simulation.scene import Sensor, Vector, WaterOptics
from aqualvs.simulation.spectrum import COLOUR_BALANCED, ColourFilters


@dataclass(frozen=True, slots=True)
class Panel:
    """A printed rectangle.

    Attributes
    ----------
    dome_from_panel : SE3
        Of the frame with x to the right, y down, z into the panel and its origin at the outer
        corner of the top-left cell.
    texture : Texture
        What is printed; from behind it is seen through, mirrored.
    """

    dome_from_panel: SE3
    texture: Texture


@dataclass(frozen=True, slots=True, kw_only=True)
class RoomLight:
    """Light that is on besides the lasers: even, and some more from a lamp far behind the camera.

    Attributes
    ----------
    level : float
        Radiance of a white panel that faces the lamp.
    lamp : (float, float, float)
        The lamp's place in `dome`, in metres.
    lamp_share : float
        Share of the light that falls off with the angle to the lamp, 0 to 1.
    tint : (float, float, float)
        Red, green and blue of white.
    veil : (float, float, float)
        Radiance that the water adds everywhere.
    """

    level: float = 0.62
    lamp: Vector = (0.5, -0.6, 0.9)
    lamp_share: float = 0.45
    tint: Vector = (1.0, 0.98, 0.93)
    veil: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class PanelScene:
    """What is in front of the camera.

    Attributes
    ----------
    panels : sequence of Panel
        Where several meet a ray, the nearest is seen.
    light : RoomLight
        Light besides the lasers.
    sensor : Sensor
        Blur, noise and tone of the camera.
    """

    panels: Sequence[Panel]
    light: RoomLight = field(default_factory=RoomLight)
    sensor: Sensor = field(default_factory=Sensor)


@dataclass(slots=True)
class PanelRenderer:
    """Renders panels as one camera sees them.

    Attributes
    ----------
    camera : Camera
        Behind its dome, in whatever medium it is, or bare.
    sheets : Sheets or None
        The lasers, see `panel_sheets`; None leaves them off.
    samples : int
        Rays along each side of a pixel.
    eye : SimulatedCamera
        Sensor and processing; the sheets must be packed with its filters.
    """

    camera: Camera
    sheets: Sheets | None = None
    samples: int = 2
    eye: SimulatedCamera = IDEAL
    _rays: CornerRays = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._rays = _corner_rays(self.camera)

    def render(
        self, scene: PanelScene, rng: np.random.Generator | None = None, t: float = 0.0
    ) -> NDArray[np.uint8]:
        """Return the picture (height, width, 3), red, green, blue; without `rng` no noise.

        Exposure and white balance of `eye` drift with the time `t`, in seconds.

        Raises
        ------
        OptionError
            If the scene has no panels.
        """
        clear = WaterOptics(forward_scatter=0.0)
        return self.eye.picture(self.radiance(scene), clear, scene.sensor, t, rng)

    def radiance(self, scene: PanelScene) -> NDArray[np.float32]:
        """Return what reaches the lens, float32 (height, width, 3), before blur and saturation.

        1 is the sensor's full scale at gain 1; black where a ray meets no panel, or where the lens
        model or the housing lets no light through.
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

    Raises
    ------
    RigError
        If a laser's plane is square to the view.
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


def _corner_rays(camera: Camera) -> CornerRays:
    width, height = camera.size_px
    x, y = np.meshgrid(np.arange(width + 1) - 0.5, np.arange(height + 1) - 0.5)
    rays = camera.rays(np.stack([x, y], axis=-1))
    return CornerRays(
        np.ascontiguousarray(rays.origins), np.ascontiguousarray(rays.directions), rays.valid
    )


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
