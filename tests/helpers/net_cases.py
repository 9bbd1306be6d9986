"""Scans of simulated nets without pictures: the true lit points, as a good detector sees them."""

from dataclasses import dataclass, replace

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.optics.rig import Rig
from aqualvs.scanning.laser_bands import SearchAxis, plan_bands
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.scan import Label, Scan, ScanPoints
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenario import dome_from_target
from aqualvs.simulation.scenarios import example_rig
from aqualvs.simulation.scene import Net, Scene
from aqualvs.simulation.scene import SurfaceKind as TrueLabel
from aqualvs.simulation.truth import LitPoints

# How much wider than the twine a detector sees its light, as `net_twine` assumes.
HALO = 0.72e-3
# Strands are dark or not in pieces of this size, in metres.
_PIECE = 0.012
STRIPE_WIDTH_PX = 5.0
_SEEN_AS = {
    TrueLabel.NET: Label.NET,
    TrueLabel.WALL: Label.BACKGROUND,
    TrueLabel.FISH: Label.FISH,
    TrueLabel.BUBBLE: Label.BUBBLE,
    TrueLabel.SOLID: Label.SOLID,
}


@dataclass
class NetCamera:
    """Takes scans of scenes.

    Of the strands' lights a share `missed` is lost in each frame anew, and those on a share `dark`
    of the strands, in pieces of 12 mm, in every frame.
    """

    rig: Rig
    halo: float = HALO
    missed: float = 0.0
    dark: float = 0.0

    def __post_init__(self) -> None:
        self._renderer = Renderer(self.rig)
        self._laser_bands = plan_bands(self.rig, self.rig.camera())
        self._rng = np.random.default_rng(11)

    def scan(self, scene: Scene, time_s: float, index: int) -> Scan:
        """Return the scan of a scene."""
        lit = self._renderer.lit_points(scene, time_s)
        plane = scene.target_plane()
        n = plane.normal
        posture = Posture(
            range=plane.offset,
            pitch=float(np.arctan2(n[2], n[1])),
            yaw=float(np.arctan2(n[0], n[1])),
            covariance=1e-8 * np.eye(3),
            normal_in_dome=n,
            slant_range=plane.offset / float(n[1]),
            nearest=plane.offset,
            n_points=len(lit),
            rms=0.0,
        )
        lost = self._lost(scene, lit)
        points = self._points(lit, lost, plane.offset)
        return Scan(index, time_s, posture, points, self.rig.n_water)

    def _lost(self, scene: Scene, lit: LitPoints) -> BoolArray:
        """Lights on strands that are always dark, told by their place on the net."""
        on_net = scene.dome_from_scene.inverse().apply(lit.points_in_dome)[:, [0, 2]]
        column, row = np.floor(on_net / _PIECE).astype(np.int64).T
        chance = np.modf(np.abs(np.sin(column * 12.9898 + row * 78.233)) * 43758.5453)[0]
        return np.asarray((chance < self.dark) & (lit.label == TrueLabel.NET))

    def _points(self, lit: LitPoints, lost: BoolArray, distance: float) -> ScanPoints:
        parts = [self._of_laser(lit, lost, i, distance) for i in range(len(self.rig.lasers))]
        laser, pixels, points, label = (
            np.concatenate(column) for column in zip(*parts, strict=True)
        )
        count = len(laser)
        return ScanPoints(
            laser=laser.astype(np.int8),
            pixels=pixels,
            points_in_dome=points,
            sigma=np.full(count, 1e-3),
            intensity=np.full(count, 120.0),
            width=np.full(count, STRIPE_WIDTH_PX),
            quality=np.ones(count),
            label=label.astype(np.uint8),
            used=label == Label.NET,
        )

    def _of_laser(
        self, lit: LitPoints, lost: BoolArray, i: int, distance: float
    ) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
        """One return for every search line and kind of thing that this laser lights there."""
        search = self._laser_bands[i]
        across = 1 if search.axis is SearchAxis.ALONG_X else 0
        pixels, points, label = [], [], []
        beside = round(0.5 * self.halo / distance * self.rig.focal_px / search.line_px)
        for kind, seen_as in _SEEN_AS.items():
            mine = np.flatnonzero((lit.laser == i) & (lit.label == kind) & ~lost)
            row = np.rint((lit.pixels[mine, across] + 0.5) / search.line_px - 0.5).astype(int)
            row, first = np.unique(row, return_index=True)
            for run in np.split(np.arange(len(row)), np.flatnonzero(np.diff(row) > 2) + 1):
                if not len(run) or (kind == TrueLabel.NET and self._rng.random() < self.missed):
                    continue
                wider = beside if kind == TrueLabel.NET else 0
                rows = np.arange(row[run[0]] - wider, row[run[-1]] + wider + 1)
                at = mine[first[run[np.abs(row[run] - rows[:, None]).argmin(axis=1)]]]
                place = lit.pixels[at].copy()
                place[:, across] = (rows + 0.5) * search.line_px - 0.5
                inside = (place[:, across] >= 0) & (
                    place[:, across] <= self.rig.size_px[across] - 1
                )
                pixels.append(place[inside])
                points.append(lit.points_in_dome[at][inside])
                label.append(np.full(np.count_nonzero(inside), seen_as))
        if not pixels:
            return np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 3)), np.empty(0, np.int64)
        count = sum(len(part) for part in pixels)
        laser = np.full(count, i)
        return laser, np.concatenate(pixels), np.concatenate(points), np.concatenate(label)


def passing(
    net: Net,
    *,
    distance: float = 0.5,
    speed: tuple[float, float] = (0.12, 0.0),
    n_frames: int = 40,
    fps: float = 20.0,
    yaw_deg: float = 5.0,
    camera: NetCamera | None = None,
    scene: Scene | None = None,
) -> list[Scan]:
    """Scans of a net that the vehicle passes, at a speed (right, up) in m/s."""
    camera = camera or NetCamera(example_rig())
    scans = []
    for i in range(n_frames):
        t = i / fps
        pose = dome_from_target(
            distance, np.deg2rad(3.0), np.deg2rad(yaw_deg), (-speed[0] * t, -speed[1] * t)
        )
        base = scene or Scene(dome_from_scene=pose, target="net")
        scans.append(camera.scan(replace(base, dome_from_scene=pose, nets=(net,)), t, i))
    return scans
