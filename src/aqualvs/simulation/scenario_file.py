"""Scenario files: short YAML with the unit in every key."""

import difflib
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from aqualvs.errors import OptionError
from aqualvs.simulation.clutter import random_bubbles, random_fish
from aqualvs.simulation.scenario import Scenario
from aqualvs.simulation.scene import Box, Fold, Mesh, Net, Sensor, Target, Wall, WaterOptics
from aqualvs.simulation.trajectory import Course, Trajectory
from aqualvs.simulation.vectors import Vec
from aqualvs.yamlfile import read_yaml

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Triple: TypeAlias = tuple[Finite, Finite, Finite]


class _Strict(BaseModel):
    """Every model refuses keys that it does not know."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class CourseFile(_Strict):
    """One quantity over the dive; see `trajectory.Course`."""

    values: Annotated[list[Finite], Field(min_length=1)]
    mode: Literal["smooth", "steps"] = "smooth"
    sway: NotNegative = 0.0
    period_s: Positive = 4.0


Motion: TypeAlias = Finite | list[Finite] | CourseFile


class MotionFile(_Strict):
    """Posture over the dive: numbers, lists of numbers to pass through, or `CourseFile`."""

    range_mm: Motion = 600.0
    pitch_deg: Motion = 0.0
    yaw_deg: Motion = 0.0
    slide_x_mm: Motion = 0.0
    slide_z_mm: Motion = 0.0


class FoldFile(_Strict):
    """A fold across the net, or a row of them; see `scene.Fold`."""

    direction_deg: Finite = 0.0
    place_mm: Finite = 0.0
    height_mm: Finite = -30.0
    width_mm: Positive = 50.0
    every_mm: NotNegative = 0.0


class NetFile(_Strict):
    """A net in the target plane; see `scene.Net`."""

    mesh: Mesh = "diamond"
    bar_mm: Positive = 25.0
    twine_mm: Positive = 2.0
    roll_deg: Finite = 0.0
    hanging_ratio: Annotated[float, Field(ge=0.2, le=0.98)] = 0.7071
    fouling: Fraction = 0.0
    growth: NotNegative = 1.0
    missing: Fraction = 0.0
    holes_mm: list[Triple] = []
    curvature_per_m: tuple[Finite, Finite] = (0.0, 0.0)
    folds: list[FoldFile] = []
    half_size_mm: tuple[Positive, Positive] | None = None


class WallFile(_Strict):
    """A wall; `behind_mm` 0 puts it in the target plane; see `scene.Wall`."""

    behind_mm: NotNegative = 0.0
    yaw_deg: Annotated[float, Field(gt=-80.0, lt=80.0)] = 0.0
    pitch_deg: Annotated[float, Field(gt=-80.0, lt=80.0)] = 0.0
    contrast: Fraction = 0.35
    tile_mm: NotNegative = 0.0


class BoxFile(_Strict):
    """A box, its position from the target plane's middle; see `scene.Box`."""

    centre_mm: Triple
    size_mm: tuple[Positive, Positive, Positive] = (300.0, 200.0, 300.0)
    heading_deg: Finite = 0.0


class WaterFile(_Strict):
    """Water; see `scene.WaterOptics`."""

    attenuation_per_m: tuple[NotNegative, NotNegative, NotNegative] = WaterOptics().attenuation
    veil: tuple[NotNegative, NotNegative, NotNegative] = WaterOptics().veil
    ambient: tuple[NotNegative, NotNegative, NotNegative] = WaterOptics().ambient
    sheet_scatter_per_m: NotNegative = WaterOptics().sheet_scatter
    forward_scatter: Fraction = WaterOptics().forward_scatter
    halo_px: Positive = WaterOptics().halo_px
    caustics: Fraction = 0.0
    glare: NotNegative = 0.0
    snow: Annotated[int, Field(ge=0, le=20_000)] = 0


class SensorFile(_Strict):
    """Sensor; see `scene.Sensor`."""

    gain: Positive = 1.0
    gamma: Positive = Sensor().gamma
    read_noise: NotNegative = Sensor().read_noise
    shot_noise: NotNegative = Sensor().shot_noise
    defocus_px: NotNegative = Sensor().defocus_px


class ScenarioFile(_Strict):
    """The whole file. Without `net` and without a wall in the target plane there is no target."""

    duration_s: Positive = 4.0
    fps: Positive = 25.0
    seed: Annotated[int, Field(ge=0)] = 0
    motion: MotionFile = MotionFile()
    net: NetFile | None = None
    walls: list[WallFile] = []
    boxes: list[BoxFile] = []
    fish: Annotated[int, Field(ge=0, le=50)] = 0
    bubbles: Annotated[int, Field(ge=0, le=500)] = 0
    water: WaterFile = WaterFile()
    sensor: SensorFile = SensorFile()
    lasers_on: bool = True

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
            fish=random_fish(rng, self.fish, self.duration_s, behind),
            bubbles=random_bubbles(rng, self.bubbles, self.duration_s, behind),
            boxes=tuple(_box(box) for box in self.boxes),
            water=_water(self.water),
            sensor=Sensor(**self.sensor.model_dump()),
            lasers_on=self.lasers_on,
        )


def read_scenario(path: Path) -> Scenario:
    """Read a scenario file; the scenario is called as the file.

    Raises
    ------
    OptionError
        If the file cannot be read, is not YAML, or holds a key or value that makes no sense; the
        message names the file, the key and the remedy.
    """
    content = read_yaml(path, "a scenario file, or the name of a built-in scenario", OptionError)
    return parse_scenario(content, path.stem, str(path))


def parse_scenario(content: Any, name: str, source: str) -> Scenario:
    """Return the scenario that a mapping describes; `source` is named in the error.

    Raises
    ------
    OptionError
        If a key is unknown or a value makes no sense.
    """
    try:
        return ScenarioFile.model_validate({} if content is None else content).scenario(name)
    except ValidationError as error:
        raise OptionError(f"scenario {source}: {_first_fault(error)}") from None


def _first_fault(error: ValidationError) -> str:
    fault = error.errors(include_url=False)[0]
    names = [str(part) for part in fault["loc"]]
    where = ".".join(names) or "the file"
    if fault["type"] != "extra_forbidden":
        return f"{where} is {fault['input']!r}: {fault['msg'].lower()}"
    known = _known_keys(names[:-1])
    near = difflib.get_close_matches(names[-1], known, n=1)
    hint = f"did you mean {near[0]}?" if near else f"known keys: {', '.join(known)}"
    return f"unknown key {where}; {hint}"


_MODELS: dict[str, type[_Strict]] = {
    "motion": MotionFile,
    "net": NetFile,
    "walls": WallFile,
    "boxes": BoxFile,
    "water": WaterFile,
    "sensor": SensorFile,
}


def _known_keys(parents: list[str]) -> list[str]:
    model: type[_Strict] = _MODELS.get(parents[0], ScenarioFile) if parents else ScenarioFile
    if "CourseFile" in parents:
        model = CourseFile
    if "folds" in parents:
        model = FoldFile
    return list(model.model_fields)


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


def _metres(values: tuple[float, float, float]) -> Vec:
    return values[0] / 1e3, values[1] / 1e3, values[2] / 1e3


def _net(net: NetFile, seed: int) -> Net:
    half = net.half_size_mm or (np.inf, np.inf)
    return Net(
        mesh=net.mesh,
        bar=net.bar_mm / 1e3,
        twine=net.twine_mm / 1e3,
        roll=float(np.deg2rad(net.roll_deg)),
        hanging_ratio=net.hanging_ratio,
        fouling=net.fouling,
        growth=net.growth,
        missing=net.missing,
        holes=tuple(_metres(hole) for hole in net.holes_mm),
        curvature=net.curvature_per_m,
        folds=tuple(_fold(fold) for fold in net.folds),
        half_size=(half[0] / 1e3, half[1] / 1e3),
        seed=seed,
    )


def _fold(fold: FoldFile) -> Fold:
    return Fold(
        direction=float(np.deg2rad(fold.direction_deg)),
        place=fold.place_mm / 1e3,
        height=fold.height_mm / 1e3,
        width=fold.width_mm / 1e3,
        period=fold.every_mm / 1e3,
    )


def _wall(wall: WallFile) -> Wall:
    return Wall(
        depth=wall.behind_mm / 1e3,
        yaw=float(np.deg2rad(wall.yaw_deg)),
        pitch=float(np.deg2rad(wall.pitch_deg)),
        contrast=wall.contrast,
        tile_pitch=wall.tile_mm / 1e3,
    )


def _box(box: BoxFile) -> Box:
    return Box(
        centre=_metres(box.centre_mm),
        size=_metres(box.size_mm),
        heading=float(np.deg2rad(box.heading_deg)),
    )


def _water(water: WaterFile) -> WaterOptics:
    values = water.model_dump()
    attenuation, scatter = values.pop("attenuation_per_m"), values.pop("sheet_scatter_per_m")
    return WaterOptics(attenuation=attenuation, sheet_scatter=scatter, **values)
