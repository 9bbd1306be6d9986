"""Scenarios: the scene before the vehicle and the vehicle's motion over the time of a dive.

The posture follows smooth functions of time (`Course`, `Trajectory`). Fish and bubbles are placed
at random such that the camera meets them. A scenario file is short YAML with the unit in every key
(`read_scenario`).
"""

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import ConfigDict, Field
from scipy.interpolate import PchipInterpolator

from aqualvs.errors import OptionError
from aqualvs.geometry.transforms import SE3
from aqualvs.schema import (
    BY_KIND,
    KEYS,
    LIST,
    NUMBER,
    NotNegative,
    Number,
    Positive,
    StrictPart,
    si_values,
    twine_fault,
    validated,
)
from aqualvs.simulation.scene import (
    Box,
    Bubble,
    CameraSensor,
    Fish,
    Fold,
    Mesh,
    Net,
    Scene,
    SceneContent,
    Target,
    Wall,
    WaterOptics,
    target_axes,
)
from aqualvs.yamlfile import parse_yaml, read_yaml

_IN_FRONT = 0.10
_SIDE, _HEIGHT = 0.20, 0.13


def random_fish(rng: np.random.Generator, duration: float, behind: float) -> Fish:
    """Return a fish that crosses the view at some time of the dive.

    `duration`: of the dive, in seconds. `behind`: free room behind the target plane, in metres, for
    example before a wall.
    """
    length = float(rng.uniform(0.12, 0.34))
    depth = float(rng.uniform(-_IN_FRONT, max(behind - 0.3 * length, -0.05)))
    side = float(rng.choice([-1.0, 1.0]))
    speed = side * float(rng.uniform(0.05, 0.30))
    middle, when = float(rng.uniform(-_SIDE, _SIDE)), float(rng.uniform(0.0, duration))
    height, climb = float(rng.uniform(-_HEIGHT, _HEIGHT)), float(rng.normal(0.0, 0.01))
    return Fish(
        position=(middle - speed * when, depth, height - climb * when),
        velocity=(speed, 0.0, climb),
        length=length,
        beat=float(rng.uniform(0.8, 2.5)),
    )


def random_bubble(rng: np.random.Generator, duration: float, behind: float) -> Bubble:
    """Return a bubble that rises through the view at some time of the dive; see `random_fish`."""
    rise, when = float(rng.uniform(0.10, 0.25)), float(rng.uniform(0.0, duration))
    place = (
        float(rng.uniform(-_SIDE, _SIDE)),
        float(rng.uniform(-_IN_FRONT, max(behind, 0.0))),
        float(rng.uniform(-_HEIGHT, _HEIGHT)) - rise * when,
    )
    drift = (float(rng.normal(0.0, 0.01)), float(rng.normal(0.0, 0.01)), rise)
    radius = float(np.clip(rng.lognormal(np.log(2.2e-3), 0.45), 0.8e-3, 7e-3))
    return Bubble(position=place, velocity=drift, radius=radius)


def dome_from_target(
    distance: float, pitch: float, yaw: float, slide: tuple[float, float] = (0.0, 0.0)
) -> SE3:
    """Return the pose of a target frame from the posture (docs/conventions.md).

    y of the target frame is the far normal n; its z is as near to the dome's z as possible; without
    slide its origin is the foot of the perpendicular from the dome's centre.

    Parameters
    ----------
    distance : float
        Range: distance of the dome's centre from the target plane, in metres.
    pitch, yaw : float
        tan(pitch) = n_z / n_y and tan(yaw) = n_x / n_y, in radians.
    slide : (float, float)
        Shift of the target in its plane, right and up, in metres.

    Raises
    ------
    OptionError
        If the distance is not positive or an angle is 85 degrees or steeper.
    """
    if not distance > 0.0:
        raise OptionError(f"range is {1e3 * distance:g} mm; it must be positive")
    steepest = np.deg2rad(85.0)
    if max(abs(pitch), abs(yaw)) >= steepest:
        raise OptionError(
            f"pitch {np.rad2deg(pitch):g} and yaw {np.rad2deg(yaw):g} deg: the target would be "
            "seen edge on; keep both below 85 deg"
        )
    axes = target_axes(pitch, yaw)
    right, normal, up = axes.T
    return SE3(axes, distance * normal + slide[0] * right + slide[1] * up)


@dataclass(frozen=True, slots=True, kw_only=True)
class Course:
    """One quantity over time: interpolated values, with a sway on top."""

    # Passed at equal intervals from the start to the end of the dive; one value holds still.
    values: Sequence[float] = (0.0,)
    # Smooth passes through the values without overshoot; steps holds each of them for its share of
    # the dive.
    mode: Literal["smooth", "steps"] = "smooth"
    sway: float = 0.0  # Amplitude of a sine on top.
    period: float = 4.0  # Of that sine, in seconds.

    def at(self, t: float, duration: float) -> float:
        """Return the value at time `t` of a dive of `duration` seconds."""
        # Rows of the first and the last picture of a rolling shutter are exposed beyond the dive.
        beyond_s = 0.1
        during = min(max(t, -beyond_s), duration + beyond_s)
        share = during / duration if duration > 0.0 else 0.0
        value = self._base(share)
        return value + self.sway * float(np.sin(2.0 * np.pi * t / self.period))

    def _base(self, share: float) -> float:
        n = len(self.values)
        if n == 1:
            return float(self.values[0])
        if self.mode == "steps":
            # The small addition keeps frame times such as 0.4 s after a step despite rounding.
            return float(self.values[min(max(int(share * n + 1e-9), 0), n - 1)])
        return float(_smooth(tuple(self.values))(share))


# Pictures of a shutter that rolls ask for some hundred times each.
@functools.lru_cache(maxsize=64)
def _smooth(values: tuple[float, ...]) -> PchipInterpolator:
    return PchipInterpolator(np.linspace(0.0, 1.0, len(values)), values)


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectory:
    """Posture over time."""

    # Metres and radians.
    distance: Course = field(default_factory=lambda: Course(values=(0.6,)))
    pitch: Course = field(default_factory=Course)
    yaw: Course = field(default_factory=Course)
    # Shift of the target in its plane, in metres.
    slide_x: Course = field(default_factory=Course)
    slide_z: Course = field(default_factory=Course)

    def pose_at(self, t: float, duration: float) -> SE3:
        """Return `dome_from_target` at time `t`."""
        courses = (self.distance, self.pitch, self.yaw, self.slide_x, self.slide_z)
        distance, pitch, yaw, *slide = (course.at(t, duration) for course in courses)
        return dome_from_target(distance, pitch, yaw, (slide[0], slide[1]))


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario(SceneContent):
    """Scenario of a dive, before rendering: a scene, which moves with the target, and motion."""

    name: str  # Name in reports.
    duration: float  # In seconds.
    fps: float = 25.0  # Frames a second.
    seed: int = 0  # Seed of noise and everything else that is random.
    trajectory: Trajectory = field(default_factory=Trajectory)  # Posture of the vehicle over time.
    shutter: str | None = None  # Of the camera, in the words of `--shutter`; None leaves the rig's.

    @property
    def n_frames(self) -> int:
        """Number of frames; at least one."""
        return max(round(self.duration * self.fps), 1)

    def times(self) -> Iterator[float]:
        """Yield the time of every frame in seconds."""
        return (i / self.fps for i in range(self.n_frames))

    def scene_at(self, t: float) -> Scene:
        """Return the scene before the vehicle at time `t`; render it at the same `t`."""
        content = {part.name: getattr(self, part.name) for part in fields(SceneContent)}
        return Scene(dome_from_scene=self.trajectory.pose_at(t, self.duration), **content)


Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Triple: TypeAlias = tuple[Number, Number, Number]
_Values: TypeAlias = Annotated[list[Number], Field(min_length=1)]


class _Part(StrictPart):
    """Base of the schemas: a list may stand for a tuple."""

    model_config = ConfigDict(strict=False)


class CourseFile(_Part):
    """Schema of one quantity over the dive; see `Course`."""

    values: _Values
    mode: Literal["smooth", "steps"] = "smooth"
    sway: NotNegative = 0.0
    period_s: Positive = 4.0


Motion: TypeAlias = Annotated[
    Annotated[Number, NUMBER] | Annotated[_Values, LIST] | Annotated[CourseFile, KEYS], BY_KIND
]


class MotionFile(_Part):
    """Schema of the posture over the dive: numbers, lists of numbers, or `CourseFile`."""

    range_mm: Motion = 600.0
    pitch_deg: Motion = 0.0
    yaw_deg: Motion = 0.0
    slide_x_mm: Motion = 0.0
    slide_z_mm: Motion = 0.0


class FoldFile(_Part):
    """Schema of a fold across the net, or a row of them; see `scene.Fold`."""

    direction_deg: Number = 0.0
    place_mm: Number = 0.0
    height_mm: Number = -30.0
    width_mm: Positive = 50.0
    every_mm: NotNegative = 0.0


class NetFile(_Part):
    """Schema of a net in the target plane; see `scene.Net`."""

    mesh: Mesh = "diamond"
    bar_mm: Positive = 25.0
    twine_mm: Positive = 2.0
    roll_deg: Number = 0.0
    hanging_ratio: Annotated[float, Field(ge=0.2, le=0.98)] = 0.7071
    fouling: Fraction = 0.0
    growth: NotNegative = 1.0
    missing: Fraction = 0.0
    holes_mm: list[Triple] = Field(default=[])
    curvature_per_m: tuple[Number, Number] = (0.0, 0.0)
    folds: list[FoldFile] = Field(default=[])
    half_size_mm: tuple[Positive, Positive] | None = None


class WallFile(_Part):
    """Schema of a wall; `behind_mm` 0 puts it in the target plane; see `scene.Wall`."""

    behind_mm: NotNegative = 0.0
    yaw_deg: Annotated[float, Field(gt=-80.0, lt=80.0)] = 0.0
    pitch_deg: Annotated[float, Field(gt=-80.0, lt=80.0)] = 0.0
    contrast: Fraction = 0.35
    tile_mm: NotNegative = 0.0


class BoxFile(_Part):
    """Schema of a box, its position from the target plane's middle; see `scene.Box`."""

    centre_mm: Triple
    size_mm: tuple[Positive, Positive, Positive] = (300.0, 200.0, 300.0)
    heading_deg: Number = 0.0


class WaterFile(_Part):
    """Schema of the water; see `scene.WaterOptics`."""

    attenuation_per_m: tuple[NotNegative, NotNegative, NotNegative] = WaterOptics().attenuation
    veil: tuple[NotNegative, NotNegative, NotNegative] = WaterOptics().veil
    ambient: tuple[NotNegative, NotNegative, NotNegative] = WaterOptics().ambient
    sheet_scatter_per_m: NotNegative = WaterOptics().sheet_scatter
    forward_scatter: Fraction = WaterOptics().forward_scatter
    halo_px: Positive = WaterOptics().halo_px
    caustics: Fraction = 0.0
    glare: NotNegative = 0.0
    snow: Annotated[int, Field(ge=0, le=20_000)] = 0


class SensorFile(_Part):
    """Schema of the sensor; see `scene.Sensor`."""

    gain: Positive = 1.0
    gamma: Positive = CameraSensor().gamma
    read_noise: NotNegative = CameraSensor().read_noise
    shot_noise: NotNegative = CameraSensor().shot_noise
    defocus_px: NotNegative = CameraSensor().defocus_px


class ScenarioFile(_Part):
    """Schema of the whole file; the target is `net`, a wall in the target plane, or none."""

    duration_s: Positive = 4.0
    fps: Positive = 25.0
    seed: Annotated[int, Field(ge=0)] = 0
    motion: MotionFile = MotionFile()
    net: NetFile | None = None
    walls: list[WallFile] = Field(default=[])
    boxes: list[BoxFile] = Field(default=[])
    fish: Annotated[int, Field(ge=0, le=50)] = 0
    bubbles: Annotated[int, Field(ge=0, le=500)] = 0
    water: WaterFile = WaterFile()
    sensor: SensorFile = SensorFile()
    lasers_on: bool = True
    shutter: str | None = None

    def scenario(self, name: str) -> Scenario:
        """Return the scenario that the file describes, in SI units."""
        rng = np.random.default_rng([self.seed, 7])
        walls = tuple(_wall(wall) for wall in self.walls)
        behind = min((wall.depth for wall in walls), default=0.6)
        return Scenario(
            name=name,
            duration=self.duration_s,
            fps=self.fps,
            seed=self.seed,
            trajectory=_trajectory(self.motion),
            target=_target(self),
            walls=walls,
            nets=(_net(self.net, self.seed),) if self.net else (),
            fish=tuple(random_fish(rng, self.duration_s, behind) for _ in range(self.fish)),
            bubbles=tuple(random_bubble(rng, self.duration_s, behind) for _ in range(self.bubbles)),
            boxes=tuple(Box(**si_values(box)) for box in self.boxes),
            water=_water(self.water),
            sensor=CameraSensor(**self.sensor.model_dump()),
            lasers_on=self.lasers_on,
            shutter=self.shutter,
        )


def read_scenario(path: Path) -> Scenario:
    """Read a scenario file; the scenario has the file's name.

    Raises `OptionError` if the file cannot be read, is not YAML, or holds a key or value that makes
    no sense; the message names the file, the key and the remedy.
    """
    content = read_yaml(path, "a scenario file, or the name of a built-in scenario", OptionError)
    if not content:
        raise OptionError(f"{path}: an empty scenario; give it a wall, `walls: [{{}}]`, or a net")
    return parse_scenario(content, path.stem, str(path))


@functools.cache
def packaged(name: str) -> dict[str, Any]:
    """Return the content of a file of the folder `data/scenarios`; it must not be changed."""
    text = (files("aqualvs") / "data" / "scenarios" / name).read_text(encoding="utf-8")
    content: dict[str, Any] = parse_yaml(text, name, OptionError)
    return content


def parse_scenario(content: Any, name: str, source: str) -> Scenario:
    """Return the scenario that a mapping describes; `source` is named in the error.

    Raises `OptionError` if a key is unknown or a value makes no sense.
    """
    file = validated(ScenarioFile, content, f"scenario {source}", OptionError)
    if file.net and (fault := twine_fault(file.net.twine_mm, file.net.bar_mm)):
        raise OptionError(f"scenario {source}: {fault}")
    for i, fold in enumerate(file.net.folds if file.net else []):
        if _fold(fold).overlaps:
            raise OptionError(
                f"scenario {source}: net.folds[{i}].every_mm is {fold.every_mm:g}; it must be 0 or "
                f"at least {2.0 * fold.width_mm:g}, twice width_mm"
            )
    return file.scenario(name)


def _course(motion: Motion, unit: float) -> Course:
    if isinstance(motion, CourseFile):
        values = [value * unit for value in motion.values]
        sway = motion.sway * unit
        return Course(values=values, mode=motion.mode, sway=sway, period=motion.period_s)
    values = motion if isinstance(motion, list) else [motion]
    return Course(values=[value * unit for value in values])


def _trajectory(motion: MotionFile) -> Trajectory:
    mm, deg = 1e-3, float(np.deg2rad(1.0))
    return Trajectory(
        distance=_course(motion.range_mm, mm),
        pitch=_course(motion.pitch_deg, deg),
        yaw=_course(motion.yaw_deg, deg),
        slide_x=_course(motion.slide_x_mm, mm),
        slide_z=_course(motion.slide_z_mm, mm),
    )


def _target(file: ScenarioFile) -> Target:
    if file.net:
        return "net"
    upright = [w for w in file.walls if w.behind_mm == w.yaw_deg == w.pitch_deg == 0.0]
    return "wall" if upright else "none"


def _net(net: NetFile, seed: int) -> Net:
    values = si_values(net)
    values["folds"] = tuple(_fold(fold) for fold in net.folds)
    values["half_size"] = values["half_size"] or (np.inf, np.inf)
    return Net(**values, seed=seed)


def _fold(fold: FoldFile) -> Fold:
    values = si_values(fold)
    return Fold(period=values.pop("every"), **values)


def _wall(wall: WallFile) -> Wall:
    values = si_values(wall)
    return Wall(depth=values.pop("behind"), tile_pitch=values.pop("tile"), **values)


def _water(water: WaterFile) -> WaterOptics:
    values = water.model_dump()
    attenuation, scatter = values.pop("attenuation_per_m"), values.pop("sheet_scatter_per_m")
    return WaterOptics(attenuation=attenuation, sheet_scatter=scatter, **values)
