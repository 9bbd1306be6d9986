"""Random short dives along nets: scene, motion and truth, and scans of them from pictures."""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from benchmarks.random_scenes import Difficulty, random_scene
from numpy.typing import NDArray

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.rig import Rig
from aqualvs.scanner import Scanner
from aqualvs.scanning.scan import Frame, Scan, planes_of_image
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenario import dome_from_target, random_bubble, random_fish
from aqualvs.simulation.scene import Net, Scene, SurfaceKind, Wall
from aqualvs.simulation.surfaces import pack_surfaces
from aqualvs.simulation.truth import cast
from aqualvs.simulation.video import VideoWriter
from aqualvs.sources.opening import open_source

# Period of pitch and yaw, in seconds.
_SWAY_S = 3.0
# How far the camera sees to the side, and a wall's least distance behind a net, in metres.
_VIEW, _CLEAR = 0.6, 0.05
# What is seen to each side, in ranges.
_SEEN_BESIDE = 0.3
# Pictures in which a laser's line must cross a hole that was passed.
_LOOKS = 3
# Long dives: pictures, bars from one to the next, frame rate at most; share with holes, and how far
# these are apart; things a second are as many as in a dive of so many seconds.
_LONG, _PACE, _MAX_FPS = 240, 0.35, 25.0
_WITH_HOLES, _APART, _COMPANY_S = 0.85, (0.35, 0.9), 3.0
# A frame is measured at its true range within this share; a line of light has no break where it
# has none of so many usual steps.
_TRUE_RANGE, _BREAK = 0.05, 6.0


@dataclass(frozen=True, slots=True)
class Dive:
    """A vehicle that passes a net in a straight line.

    Attributes
    ----------
    scene : Scene
        At time 0.
    fps, n_frames
        Of the camera.
    range, pitch, yaw : (float, float)
        Range at the beginning and at the end; angle and its sway.
    phase : (float, float)
        Of the sways.
    velocity : array, shape (2,)
        Right and up along the net, in m/s.
    """

    scene: Scene
    fps: float
    n_frames: int
    range: tuple[float, float]
    pitch: tuple[float, float]
    yaw: tuple[float, float]
    phase: tuple[float, float]
    velocity: FloatArray

    @property
    def net(self) -> Net:
        """The net that is passed."""
        return self.scene.nets[0]

    @property
    def times(self) -> FloatArray:
        """Of the frames, in seconds."""
        return np.arange(self.n_frames) / self.fps

    def pose(self, t: float) -> SE3:
        """Where the net's frame is in `dome`."""
        share = t * self.fps / self.n_frames
        turn = 2.0 * np.pi * t / _SWAY_S
        slide = -self.velocity * t
        return dome_from_target(
            self.range[0] + (self.range[1] - self.range[0]) * share,
            self.pitch[0] + self.pitch[1] * float(np.sin(turn + self.phase[0])),
            self.yaw[0] + self.yaw[1] * float(np.sin(turn + self.phase[1])),
            (float(slide[0]), float(slide[1])),
        )

    def scene_at(self, t: float) -> Scene:
        """All that is before the vehicle."""
        fish = tuple(one.at(t) for one in self.scene.fish)
        bubbles = tuple(one.at(t) for one in self.scene.bubbles)
        return replace(self.scene, dome_from_scene=self.pose(t), fish=fish, bubbles=bubbles)


def random_dive(
    rng: np.random.Generator,
    difficulty: Difficulty = "usual",
    *,
    seconds: float = 0.8,
    fps: float = 25.0,
    speed: tuple[float, float] = (0.06, 0.18),
    hole_bars: tuple[float, float] | None = None,
) -> Dive:
    """Return a dive along a random net.

    Parameters
    ----------
    rng : Generator
        Source of chance.
    difficulty : {"clean", "usual", "hard"}
        As for `random_scene`.
    seconds, fps : float
        Length and frame rate.
    speed : (float, float)
        Least and greatest, in m/s.
    hole_bars : (float, float), optional
        A hole of a diameter between these many bars lies in the way.
    """
    scene = random_scene(rng, difficulty)
    angle, size = float(rng.uniform(0.0, 2.0 * np.pi)), float(rng.uniform(*speed))
    velocity = size * np.array([np.cos(angle), np.sin(angle)])
    begin = float(rng.uniform(0.32, 0.97))
    end = float(np.clip(begin + rng.uniform(-0.04, 0.04) * seconds, 0.31, 0.98))
    pitch, yaw = np.deg2rad(rng.uniform(-18.0, 18.0, 2))
    sway = np.deg2rad(rng.uniform(0.0, 1.5, 2))
    phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    net = scene.nets[0]
    if hole_bars is not None:
        middle = 0.5 * seconds * velocity + rng.uniform(-0.05, 0.05, 2)
        radius = 0.5 * net.bar * float(rng.uniform(*hole_bars))
        net = replace(net, holes=((float(middle[0]), float(middle[1]), radius),))
    return Dive(
        scene=_with_company(rng, replace(scene, nets=(net,)), seconds, velocity),
        fps=fps,
        n_frames=round(seconds * fps),
        range=(begin, end),
        pitch=(float(pitch), float(sway[0])),
        yaw=(float(yaw), float(sway[1])),
        phase=(float(phase[0]), float(phase[1])),
        velocity=velocity,
    )


def long_dive(rng: np.random.Generator, difficulty: Difficulty = "usual") -> Dive:
    """Return a dive of some metres along a random net with a hole every half metre, or none.

    The frame rate is as low as the track allows: a third of a bar from picture to picture.
    """
    scene = random_scene(rng, difficulty)
    net = scene.nets[0]
    speed = min(float(rng.uniform(0.2, 0.3)), _PACE * net.bar * _MAX_FPS)
    fps = speed / (_PACE * net.bar)
    angle = float(rng.uniform(0.0, 2.0 * np.pi))
    velocity = speed * np.array([np.cos(angle), np.sin(angle)])
    begin = float(rng.uniform(0.45, 0.9))
    end = float(np.clip(begin + rng.uniform(-0.25, 0.25), 0.42, 0.95))
    pitch, yaw = np.deg2rad(rng.uniform(-18.0, 18.0, 2))
    sway = np.deg2rad(rng.uniform(0.0, 1.5, 2))
    phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    seconds = _LONG / fps
    net = replace(net, holes=_holes_on_the_way(rng, net.bar, seconds, velocity))
    many = max(1, round(seconds / _COMPANY_S))
    scene = replace(scene, nets=(net,), fish=scene.fish * many, bubbles=scene.bubbles * many)
    return Dive(
        scene=_with_company(rng, scene, seconds, velocity),
        fps=fps,
        n_frames=_LONG,
        range=(begin, end),
        pitch=(float(pitch), float(sway[0])),
        yaw=(float(yaw), float(sway[1])),
        phase=(float(phase[0]), float(phase[1])),
        velocity=velocity,
    )


def _holes_on_the_way(
    rng: np.random.Generator, bar: float, seconds: float, velocity: FloatArray
) -> tuple[tuple[float, float, float], ...]:
    """Return holes of 2.5 bars or more, well apart, up to 0.1 m beside the way."""
    holes: list[tuple[float, float, float]] = []
    if rng.random() >= _WITH_HOLES:
        return ()
    speed, before = float(np.hypot(*velocity)), 0.0
    ahead = velocity / speed
    at = float(rng.uniform(0.1, 0.4))
    while at < speed * seconds - 0.05:
        radius = 0.5 * bar * float(rng.uniform(2.5, max(3.5, min(8.0, 0.22 / bar))))
        if holes:
            at = max(at, before + radius + holes[-1][2] + max(0.1, 4.0 * bar))
        middle = at * ahead + np.array([-ahead[1], ahead[0]]) * rng.uniform(-0.1, 0.1)
        holes.append((float(middle[0]), float(middle[1]), radius))
        before = at
        at += float(rng.uniform(*_APART))
    return tuple(holes)


def _with_company(
    rng: np.random.Generator, scene: Scene, seconds: float, velocity: FloatArray
) -> Scene:
    """Spread fish and bubbles over the whole dive, where the vehicle is then."""
    behind = scene.walls[0].depth if scene.walls else 0.5
    reach = seconds * float(np.hypot(*velocity)) + _VIEW
    # A turned wall must not cut through the net on the way.
    walls = tuple(
        wall if abs(np.tan(wall.yaw)) * reach < wall.depth - _CLEAR else replace(wall, yaw=0.0)
        for wall in scene.walls
    )
    fish = [random_fish(rng, seconds, behind) for _ in scene.fish]
    bubbles = [random_bubble(rng, seconds, behind) for _ in scene.bubbles]

    def along(own: tuple[float, float, float]) -> tuple[float, float, float]:
        return (own[0] + float(velocity[0]), own[1], own[2] + float(velocity[1]))

    return replace(
        scene,
        walls=walls,
        fish=tuple(replace(one, velocity=along(one.velocity)) for one in fish),
        bubbles=tuple(replace(one, velocity=along(one.velocity)) for one in bubbles),
    )


def scans_of(dive: Dive, rig: Rig, *, h264: bool = False, seed: int = 0) -> list[Scan]:
    """Render a dive and scan the pictures, straight or by way of a compressed video."""
    scanner = Scanner(rig)
    if not h264:
        frames = enumerate(_pictures(dive, rig, seed))
        return [scanner.process(frame_of(i, dive.times[i], image)) for i, image in frames]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "dive.mp4"
        with VideoWriter(path, rig.size_px, dive.fps) as video:
            for image in _pictures(dive, rig, seed):
                video.write(image)
        return [scanner.process(frame) for frame in open_source(str(path))]


def _pictures(dive: Dive, rig: Rig, seed: int) -> Iterator[NDArray[np.uint8]]:
    renderer = Renderer(rig)
    for i, t in enumerate(dive.times):
        yield renderer.render(dive.scene_at(t), t, np.random.default_rng([seed, i])).image


def frame_of(index: int, time_s: float, image: NDArray[np.uint8]) -> Frame:
    """Return a picture (red, green, blue) as a camera's frame."""
    luma, chroma = planes_of_image(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    return Frame(index, float(time_s), luma, chroma)


def true_solidity(dive: Dive, n: int = 60_000) -> float:
    """Share of the area passed that net and growth cover, seen straight on; without the holes."""
    whole = replace(dive.net, holes=(), curvature=(0.0, 0.0))
    surfaces = pack_surfaces(Scene(dome_from_scene=SE3.identity(), nets=(whole,)), 0.0)
    rng = np.random.default_rng(1)
    foot = rng.uniform(0.0, dive.times[-1], (n, 1)) * dive.velocity
    place = foot + rng.uniform(-1.0, 1.0, (n, 2)) * _SEEN_BESIDE * np.mean(dive.range)
    origins = np.stack([place[:, 0], np.full(n, -0.5), place[:, 1]], axis=1)
    ahead = np.tile([0.0, 1.0, 0.0], (n, 1))
    return float(np.isfinite(cast(origins, ahead, surfaces).solid).mean())


def passed_holes(dive: Dive, rig: Rig) -> list[tuple[FloatArray, float]]:
    """Middle and radius of the holes that one laser's line, at least, swept half over.

    Told from the truth alone: where light would fall on a wall in place of the net, and be seen.
    """
    renderer = Renderer(rig)
    found = []
    for x, z, radius in dive.net.holes:
        middle = np.array([x, z])
        offsets = np.array(
            [_offsets(renderer, dive.scene_at(t), t, middle, radius) for t in dive.times]
        )
        seen = np.count_nonzero(np.isfinite(offsets), axis=0) >= _LOOKS
        offsets = offsets[:, seen]
        if seen.any() and np.max(np.nanmax(offsets, 0) - np.nanmin(offsets, 0)) > radius:
            found.append((middle, radius))
    return found


def _offsets(
    renderer: Renderer, scene: Scene, t: float, middle: FloatArray, radius: float
) -> list[float]:
    """How far from a hole's middle each laser's line crosses it; NaN where it does not for long."""
    solid = replace(scene, nets=(), walls=(Wall(depth=0.0),), target="wall")
    lit = renderer.lit_points(solid, t)
    own = scene.dome_from_scene.inverse().apply(lit.points_in_dome)[:, [0, 2]] - middle
    offsets = []
    for laser in range(len(renderer.rig.lasers)):
        line = own[(lit.laser == laser) & (lit.label == SurfaceKind.WALL)]
        inside = line[np.hypot(*line.T) < radius]
        along = inside[-1] - inside[0] if len(inside) else np.zeros(2)
        length = float(np.hypot(*along))
        # A fish may hide some of it.
        step = np.median(np.hypot(*np.diff(line, axis=0).T)) if len(line) > 1 else np.inf
        if length < radius or len(inside) * step < 0.7 * length:
            offsets.append(np.nan)
        else:
            normal = np.array([-along[1], along[0]]) / length
            offsets.append(float(np.mean(inside @ normal)) * (1.0 if along[0] > 0.0 else -1.0))
    return offsets


def shown_holes(
    dive: Dive, rig: Rig, scans: Sequence[Scan], opening: float
) -> list[tuple[FloatArray, float]]:
    """Middle and radius of the holes of which one laser's line showed two meshes, in three frames.

    Without interruption, in frames that measured the net at its true range. Told from the truth.

    Parameters
    ----------
    dive, rig, scans
        What was scanned, and what came of it.
    opening : float
        Area of a mesh in square metres.
    """
    renderer = Renderer(rig)
    shown = np.zeros((len(dive.net.holes), len(rig.lasers)), np.int64)
    for scan, t in zip(scans, dive.times, strict=True):
        plane = dive.scene_at(t).target_plane()
        if scan.posture and abs(scan.posture.range / plane.offset - 1.0) < _TRUE_RANGE:
            shown += _longest_chords(renderer, dive, t) >= 2.0 * np.sqrt(opening)
    return [
        (np.array([x, z]), radius)
        for (x, z, radius), n in zip(dive.net.holes, shown, strict=True)
        if n.max() >= _LOOKS
    ]


def _longest_chords(renderer: Renderer, dive: Dive, t: float) -> FloatArray:
    """Longest unbroken piece (holes, lasers) of every line inside every hole, in metres."""
    scene = dive.scene_at(t)
    solid = replace(scene, nets=(), walls=(Wall(depth=0.0),), target="wall")
    lit = renderer.lit_points(solid, t)
    own = scene.dome_from_scene.inverse().apply(lit.points_in_dome)[:, [0, 2]]
    longest = np.zeros((len(dive.net.holes), len(renderer.rig.lasers)))
    for k, (x, z, radius) in enumerate(dive.net.holes):
        for i in range(longest.shape[1]):
            line = own[(lit.laser == i) & (lit.label == SurfaceKind.WALL)] - [x, z]
            inside = line[np.hypot(*line.T) < radius]
            if len(inside) < 2:
                continue
            steps = np.hypot(*np.diff(inside, axis=0).T)
            pieces = np.split(inside, np.flatnonzero(steps > _BREAK * np.median(steps)) + 1)
            longest[k, i] = max(float(np.hypot(*(one[-1] - one[0]))) for one in pieces)
    return longest
