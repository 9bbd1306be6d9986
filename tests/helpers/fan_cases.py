"""Returns of many lasers on a wall, with what makes an assignment wrong: gaps, dim lasers, edges.

A fan is a laser with a grating: near-parallel lines from one emitter, with sines of their angles
evenly spaced, each of finite length. A pinhole camera beside it sees them on a wall.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.lens import Lens
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Laser, Rig
from aqualvs.scanning.laser_bands import LaserBand, SearchAxis, plan_bands
from aqualvs.scanning.stripe import StripePeaks


@dataclass(frozen=True, slots=True, kw_only=True)
class Fan:
    """Lines of one emitter: their number, spacing, and the emitter's place beside the camera."""

    n_lines: int = 15
    spacing_deg: float = 1.5
    baseline: tuple[float, float, float] = (0.10, 0.0, 0.02)
    aim_deg: float = -4.0
    roll_deg: float = 4.0
    half_length_deg: float = 12.0


def fan_rig(fan: Fan, working_range: tuple[float, float] = (0.3, 1.0)) -> Rig:
    """Return a bare camera in air beside a fan."""
    roll, n = np.deg2rad(fan.roll_deg), fan.n_lines
    sines = (np.arange(n) - 0.5 * (n - 1)) * np.sin(np.deg2rad(fan.spacing_deg))
    emitter = np.array([fan.baseline[0], fan.baseline[2], fan.baseline[1]])
    lasers = []
    for i, sine in enumerate(sines):
        angle = np.arcsin(sine) + np.deg2rad(fan.aim_deg)
        forward = np.array([np.sin(angle), np.cos(angle), 0.0])
        along = np.array([np.sin(roll), 0.0, np.cos(roll)])
        normal = np.cross(forward, along)
        normal /= np.linalg.norm(normal)
        lasers.append(Laser(f"line{i}", Plane.from_normal(normal, float(normal @ emitter))))
    return Rig(
        name="fan",
        size_px=(2208, 1242),
        lens=Lens(fx=1407.86, fy=1407.12, cx=1083.25, cy=623.67, distortion=(0.0, 0.0, 0.0, 0.0)),
        dome_from_cam=SE3(DOME_FROM_CAM_NOMINAL, np.zeros(3)),
        housing=None,
        n_air=1.0003,
        n_water=1.0003,
        lasers=tuple(lasers),
        working_range=working_range,
    )


class Trouble(NamedTuple):
    """What goes wrong in a scene."""

    noise_px: float = 0.2
    missing: float = 0.15
    p_dim: float = 0.15
    p_off: float = 0.05
    n_edges: int = 0
    n_glints: int = 0
    hidden: bool = False
    strands: bool = False
    n_dark_end: int = 0


class Scene(NamedTuple):
    """Returns, and the plane that they were made on."""

    peaks: dict[SearchAxis, StripePeaks]
    plane: Plane


class _Part(NamedTuple):
    line: FloatArray
    place: FloatArray
    height: FloatArray


class Stage:
    """A rig, and the scenes before it.

    `rig` is what the scanner is told; the light falls along `true_rig`.
    """

    def __init__(self, rig: Rig, fan: Fan, true_rig: Rig | None = None) -> None:
        self.rig, self.fan = rig, fan
        self.true_rig = true_rig or rig
        self.laser_bands = plan_bands(rig, rig.camera())

    def scene(self, rng: np.random.Generator, trouble: Trouble) -> Scene:
        """Make the returns of one random wall."""
        near, far = self.rig.working_range
        pitch, yaw = np.deg2rad(rng.uniform(-20.0, 20.0, 2)).tolist()
        normal = np.array([np.tan(yaw), 1.0, np.tan(pitch)])
        distance = float(rng.uniform(near * 1.15, far * 0.9))
        return self.scene_of(
            rng, trouble, Plane.from_normal(normal, distance * float(np.linalg.norm(normal)))
        )

    def scene_of(self, rng: np.random.Generator, trouble: Trouble, plane: Plane) -> Scene:
        """Make the returns of one wall."""
        parts: dict[SearchAxis, list[_Part]] = {}
        state = self._states(rng, trouble)
        hide = rng.uniform(0.2, 0.8, 2) * self.rig.size_px if trouble.hidden else None
        for k, (laser, search) in enumerate(
            zip(self.true_rig.lasers, self.laser_bands, strict=True)
        ):
            if state[k] > 0.0:
                part = self._stripe(rng, laser.plane, search, plane, trouble, state[k], hide)
                parts.setdefault(search.axis, []).append(part)
        axis = self.laser_bands[0].axis
        parts.setdefault(axis, []).extend(self._clutter(rng, trouble))
        found = {one: peaks_from(some) for one, some in parts.items() if some}
        return Scene(found, plane)

    def _states(self, rng: np.random.Generator, trouble: Trouble) -> FloatArray:
        n = len(self.rig.lasers)
        draw, dim = rng.random(n), rng.uniform(0.2, 0.6, n)
        state = np.where(draw < trouble.p_off, 0.0, 1.0)
        state = np.where(
            (draw >= trouble.p_off) & (draw < trouble.p_off + trouble.p_dim), dim, state
        )
        if trouble.n_dark_end:
            state[: trouble.n_dark_end] = 0.0
        return state

    def _stripe(
        self,
        rng: np.random.Generator,
        sheet: Plane,
        search: LaserBand,
        plane: Plane,
        trouble: Trouble,
        state: float,
        hide: FloatArray | None,
    ) -> _Part:
        along = np.cross(sheet.normal, plane.normal)
        along /= np.linalg.norm(along)
        foot = np.linalg.solve(
            np.array([sheet.normal, plane.normal, along]), [sheet.offset, plane.offset, 0.0]
        )
        points = foot + np.linspace(-0.6, 0.6, 2401)[:, None] * along
        reach = np.tan(np.deg2rad(self.fan.half_length_deg)) * plane.offset
        points = points[np.abs(points[:, 2]) < reach]
        camera = self.true_rig.camera()
        pixels, valid = camera.project(points)
        pixels = pixels[valid & camera.inside_image(pixels)]
        along_x = search.axis is SearchAxis.ALONG_X
        across, position = (1, 0) if along_x else (0, 1)
        if len(pixels) < 2:
            return _Part(np.empty(0), np.empty(0), np.empty(0))
        pixels = pixels[np.argsort(pixels[:, across])]
        line_at = (pixels[:, across] + 0.5) / search.line_px - 0.5
        line = np.arange(np.ceil(line_at[0]), np.floor(line_at[-1]) + 1.0)
        place = np.interp(line, line_at, pixels[:, position])
        # A slow wander of the stripe (texture, compression) and the noise of each return.
        wander = np.cumsum(rng.normal(0.0, 0.02, len(line)))
        wander -= np.linspace(0.0, 1.0, len(line)) * (wander[-1] if len(line) else 0.0)
        place += wander + rng.normal(0.0, 0.05) + rng.normal(0.0, trouble.noise_px, len(line))
        keep = _pieces(rng, len(line), 1.0 - (1.0 - trouble.missing) * state)
        if trouble.strands:
            keep &= (line * search.line_px) % 44.0 < 12.0
        if hide is not None:
            at = (
                np.stack([place, line * search.line_px], axis=1)
                if along_x
                else np.stack([line * search.line_px, place], axis=1)
            )
            keep &= np.any(np.abs(at - hide) > [260.0, 200.0], axis=1)
        height = (80.0 if state == 1.0 else 45.0) * rng.uniform(0.8, 1.2, len(line))
        return _Part(line[keep], place[keep], height[keep])

    def _clutter(self, rng: np.random.Generator, trouble: Trouble) -> Iterator[_Part]:
        """Yield edges of a chessboard (straight, parallel, in squares) and glints."""
        search = self.laser_bands[0]
        n_lines, length = (
            len(search.lowest),
            self.rig.size_px[0 if search.axis is SearchAxis.ALONG_X else 1],
        )
        tilt, step = rng.normal(0.0, 0.15), rng.uniform(30.0, 110.0)
        start, low = rng.uniform(0.1, 0.6) * length, rng.uniform(0.0, 0.5) * n_lines
        for k in range(trouble.n_edges):
            line = np.arange(int(low), min(int(low + 0.4 * n_lines), n_lines), dtype=np.float64)
            square = ((line - low) // (0.5 * step)).astype(int)
            line = line[square % 2 == k % 2]
            place = start + step * k + tilt * (line - low) * search.line_px
            place = place + rng.normal(0.0, 0.3, len(line))
            keep = (place > 5.0) & (place < length - 5.0)
            yield _Part(line[keep], place[keep], np.full(keep.sum(), 35.0))
        for _ in range(trouble.n_glints):
            size = int(rng.integers(3, 25))
            line = np.arange(size) + rng.integers(0, max(n_lines - size, 1))
            place = rng.uniform(5.0, length - 5.0) + rng.normal(0.0, 0.5) * np.arange(size)
            keep = (place > 5.0) & (place < length - 5.0)
            yield _Part(line[keep].astype(np.float64), place[keep], np.full(keep.sum(), 60.0))


def _pieces(rng: np.random.Generator, n: int, missing: float) -> BoolArray:
    """Keep pieces of a stripe; a share is missing in runs of 5 to 60 search lines."""
    keep = np.ones(n, np.bool_)
    while n and keep.mean() > 1.0 - missing + 1e-9:
        at, size = rng.integers(0, n), int(rng.integers(5, 60))
        keep[at : at + size] = False
    return keep


def peaks_from(parts: list[_Part]) -> StripePeaks:
    """Return parts as what a detector gives."""
    line = np.concatenate([part.line for part in parts]).astype(np.int64)
    place = np.concatenate([part.place for part in parts])
    height = np.concatenate([part.height for part in parts])
    order = np.lexsort((place, line))
    line, place, height = line[order], place[order], height[order]
    # Two returns nearer than a stripe is wide are one.
    apart = np.ones(len(line), np.bool_)
    apart[1:] = (np.diff(line) > 0) | (np.diff(place) > 4.0)
    n = int(apart.sum())
    return StripePeaks(
        line[apart], place[apart], height[apart], np.full(n, 5.0), np.ones(n), np.zeros(n)
    )


def miscalibrated(
    rig: Rig, rng: np.random.Generator, common_deg: float = 0.05, own_deg: float = 0.008
) -> Rig:
    """Return a rig whose sheets are off as after a calibration from a few pictures.

    Errors of the boards' poses move all sheets alike; those of the stripes move each on its own.
    Shifts are in proportion: 0.1 mm for 0.02 degrees.
    """
    turn, shift = _error(rng, common_deg)
    lasers = []
    for laser in rig.lasers:
        own_turn, own_shift = _error(rng, own_deg)
        normal = own_turn @ turn @ laser.plane.normal
        offset = laser.plane.offset + float(normal @ (shift + own_shift))
        lasers.append(replace(laser, plane=Plane(normal, offset)))
    return replace(rig, lasers=tuple(lasers))


def _error(rng: np.random.Generator, deg: float) -> tuple[FloatArray, FloatArray]:
    turn = rotation_from_rotvec(rng.normal(0.0, np.deg2rad(deg), 3))
    return turn, rng.normal(0.0, deg * 5e-3, 3)
