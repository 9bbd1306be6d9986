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
from aqualvs.simulation.lasers import Sheets, default_sources, pack_sheets
from aqualvs.simulation.panel_kernels import COLUMNS, CornerRays, Lamp, PanelTables, render_panels
from aqualvs.simulation.panel_textures import Texture
from aqualvs.simulation.scene import Sensor, Vector, WaterOptics
from aqualvs.simulation.sensor import expose, spread
from aqualvs.simulation.shading import LASER_BLUE, LASER_GREEN, LASER_RED


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
    """

    camera: Camera
    sheets: Sheets | None = None
    samples: int = 2
    _rays: CornerRays = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._rays = _corner_rays(self.camera)

    def render(
        self, scene: PanelScene, rng: np.random.Generator | None = None
    ) -> NDArray[np.uint8]:
        """Return the picture (height, width, 3), red, green, blue; without `rng` no noise.

        Raises
        ------
        OptionError
            If the scene has no panels.
        """
        clear = WaterOptics(forward_scatter=0.0)
        return expose(spread(self.radiance(scene), clear, scene.sensor), scene.sensor, rng)

    def radiance(self, scene: PanelScene) -> NDArray[np.float32]:
        """Return what reaches the lens, float32 (height, width, 3), before blur and saturation.

        1 is the sensor's full scale at gain 1; black where a ray meets no panel, or where the lens
        model or the housing lets no light through.
        """
        if not scene.panels:
            raise OptionError("a picture of no panels; give one at least")
        width, height = self.camera.size_px
        seen = np.zeros((height, width, 2), dtype=np.float32)
        light = scene.light
        lamp = Lamp(light.lamp, light.level, light.lamp_share)
        sheets = _dark_sheets() if self.sheets is None else self.sheets
        render_panels(self._rays, self.samples, _pack(scene.panels), sheets, lamp, seen)
        laser = np.array([LASER_RED, LASER_GREEN, LASER_BLUE], np.float32)
        room, veil = np.array(light.tint, np.float32), np.array(light.veil, np.float32)
        return np.asarray(seen[..., :1] * room + seen[..., 1:] * laser + veil)


def panel_sheets(rig: Rig, *, power: float = 8.0) -> Sheets:
    """Return the sheets of a rig's lasers in the rig's medium, all of one power.

    Raises
    ------
    RigError
        If a laser's plane is square to the view.
    """
    sources = [replace(source, power=power) for source in default_sources(rig)]
    return pack_sheets(rig, sources)


def _dark_sheets() -> Sheets:
    none = np.zeros((0, 1))
    return Sheets(none, none, none, none, none)


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
