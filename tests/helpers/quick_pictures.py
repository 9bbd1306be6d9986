"""Rendered pictures in a quarter of the time, for tests of what the scanner makes of light."""

from dataclasses import replace

import cv2
import numpy as np

from aqualvs.geometry.arrays import BoolArray
from aqualvs.optics.rig import Rig
from aqualvs.scanner import Scanner
from aqualvs.scanning.scan import Scan
from aqualvs.simulation.cameras import IDEAL, SimulatedCamera
from aqualvs.simulation.lasers import NORMAL
from aqualvs.simulation.render import RenderedFrame, Renderer, SceneAt
from aqualvs.simulation.scene import Scene
from aqualvs.simulation.surfaces import pack_surfaces
from aqualvs.simulation.truth import beams_of, cast
from net_dives import Dive, frame_of

# Every third pixel away from the lasers' light, which reaches so far to each side on surfaces, in
# metres; and the share of a fan's power that counts.
_COARSE, _THICK, _FAN = 3, 1.5e-3, 0.05


class QuickRenderer:
    """Renderer that traces every ray only where laser light can be seen.

    There, pictures are as ever. Elsewhere, where the detector finds nothing green, they are of a
    third of the resolution, but with the same noise. Postures differ by a third of their sigma at
    most on walls and nets of usual twine; light beside thick twine and slack folds is cut off,
    unless `halo_px` is 31.

    Parameters
    ----------
    rig : Rig
        The sides of its pictures must be divisible by three.
    halo_px : int
        Width of what is traced around a pixel that shows where a sheet meets a surface.
    threads : int
        As of a `Renderer`.
    camera : SimulatedCamera
        As of a `Renderer`.
    """

    def __init__(
        self, rig: Rig, halo_px: int = 11, *, threads: int = 1, camera: SimulatedCamera = IDEAL
    ) -> None:
        self.rig, self._halo = rig, np.ones((halo_px, halo_px), np.uint8)
        self._full = Renderer(rig, threads=threads, camera=camera)
        self._coarse = Renderer(_coarse(rig), samples=1, camera=camera)
        self._beams = beams_of(rig, self._full.sources)

    def render(self, scene: Scene, t: float, rng: np.random.Generator) -> RenderedFrame:
        """Return the picture at time `t` and its truth."""
        lit = self.lit(scene, t)
        light = self._full.radiance(scene, t, lit)
        plain = replace(scene, water=replace(scene.water, snow=0))
        dim = cv2.resize(
            self._coarse.radiance(plain, t), self.rig.size_px, interpolation=cv2.INTER_LINEAR
        )
        light += np.where(lit[..., None], np.float32(0.0), dim)
        image = self._full.camera.picture(light, scene.water, scene.sensor, t, rng)
        return RenderedFrame(image, self._full.lit_points(scene, t))

    def take(self, scene_at: SceneAt, t: float, rng: np.random.Generator) -> RenderedFrame:
        """Return the picture at time `t` and its truth, as `Renderer.take` of a global shutter."""
        assert self.rig.shutter.instant
        return self.render(scene_at(t), t, rng)

    def lit(self, scene: Scene, t: float) -> BoolArray:
        """Mark the pixels (height, width) that can show what the lasers' sheets meet."""
        surfaces = pack_surfaces(scene, t)
        sheets = self._beams.sheets
        points = []
        for i, (origins, ahead, way) in enumerate(self._beams.fans):
            on = np.isfinite(way) & (sheets.fan[i] > _FAN)
            for off in (-_THICK, 0.0, _THICK):
                begin = origins[on] + off * sheets.table[i, NORMAL : NORMAL + 3]
                reach = cast(begin, ahead[on], surfaces)
                for far in (reach.solid, reach.bubble):
                    met = np.isfinite(far)
                    points.append(begin[met] + far[met, None] * ahead[on][met])
        camera, (width, height) = self.rig.camera(), self.rig.size_px
        pixels, valid = camera.project(np.concatenate(points))
        x, y = np.rint(pixels[valid & camera.inside_image(pixels)]).astype(int).T
        marked = np.zeros((height, width), np.uint8)
        marked[y.clip(0, height - 1), x.clip(0, width - 1)] = 1
        return np.asarray(cv2.dilate(marked, self._halo) > 0)


def quick_scans(dive: Dive, rig: Rig, seed: int = 0) -> list[Scan]:
    """Render a dive and scan the pictures."""
    scanner, renderer = Scanner(rig), QuickRenderer(rig)
    scans = []
    for i, t in enumerate(dive.times):
        rng = np.random.default_rng([seed, i])
        image = renderer.render(dive.scene_at(t), t, rng).image
        scans.append(scanner.process(frame_of(i, t, image)))
    return scans


def _coarse(rig: Rig) -> Rig:
    """Return a rig with every third pixel."""
    lens, (width, height) = rig.lens, rig.size_px
    first = 0.5 * (_COARSE - 1)
    lens = replace(
        lens,
        fx=lens.fx / _COARSE,
        fy=lens.fy / _COARSE,
        cx=(lens.cx - first) / _COARSE,
        cy=(lens.cy - first) / _COARSE,
    )
    return replace(rig, lens=lens, size_px=(width // _COARSE, height // _COARSE))
