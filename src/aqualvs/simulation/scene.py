"""Scene before the simulated vehicle: surfaces, water and sensor, in SI units.

Surfaces live in the frame `scene`: x right, y away from the vehicle, z up. The target (net or
wall) is the plane y = 0, and `Scene.dome_from_scene` places all of it before the vehicle.

Colours are (red, green, blue). Radiance 1 is the sensor's full scale at gain 1.
"""

from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Literal, Self, TypeAlias

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane, upright_axes
from aqualvs.geometry.transforms import SE3

Vector: TypeAlias = tuple[float, float, float]
Mesh: TypeAlias = Literal["diamond", "square", "hexagon"]
Target: TypeAlias = Literal["net", "wall", "none"]


class SurfaceKind(IntEnum):
    """Kind of surface of a lit point; the lower-case names are `labels` in truth files."""

    NONE = 0
    NET = 1
    WALL = 2
    FISH = 3
    BUBBLE = 4
    SOLID = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Wall:
    """Wall: a plane with a procedural texture, parallel to the target plane unless turned."""

    depth: float = 0.0  # Place of the wall on the scene's y axis, in metres; 0 is the target plane.
    # Turn of the wall against the target plane, in radians; signs as for postures.
    yaw: float = 0.0
    pitch: float = 0.0
    albedo: Vector = (0.50, 0.54, 0.52)  # Mean diffuse reflectance.
    contrast: float = 0.35  # Relative swing of the stains, 0 to 1.
    # Distance of the joints between tiles in metres; 0 leaves the wall without joints.
    tile_pitch: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Fold:
    """Fold: a smooth ridge across a net, or an endless row of them.

    Over the distance s from its crest the net stands out by height * cos²(pi s / (2 width)) up to
    s = width, and not beyond. With a period of twice the width a row of folds is a sine wave, as
    on a slack net.
    """

    # Direction from the crest into the fold's flank, in radians from x towards z; the crest is at
    # right angles to it.
    direction: float = 0.0
    # Place of the crest along that direction, from the target's origin, in metres.
    place: float = 0.0
    height: float = -0.03  # In metres; positive away from the vehicle, as curvature.
    width: float = 0.05  # Half the width at the foot, in metres.
    period: float = 0.0  # Distance from crest to crest in metres; 0 is a single fold.

    @property
    def overlaps(self) -> bool:
        """Whether the folds of a row run into each other."""
        return 0.0 < self.period < 2.0 * self.width


@dataclass(frozen=True, slots=True, kw_only=True)
class Net:
    """A fish net in (or bulging or folded out of) the target plane y = 0.

    The twine is a true cylinder around an axis in that plane: lit points lie within one twine
    radius (plus growth) of the net plane, on the side that faces the vehicle. Where the net leaves
    the plane, its mesh is stretched: seen along the plane's normal it stays unchanged.
    """

    mesh: Mesh = "diamond"  # Shape of the openings.
    bar: float = 0.025  # Length of one side of an opening, in metres.
    twine: float = 0.002  # Diameter of the clean twine, in metres.
    # Turn of the mesh about the net's normal, in radians, counter-clockwise for the vehicle.
    roll: float = 0.0
    # Width of a diamond over its stretched width; 0.707 makes it a square on its corner.
    hanging_ratio: float = 0.7071
    fouling: float = 0.0  # Fraction of the twine's length that carries growth, 0 to 1.
    growth: float = 1.0  # Thickness of the growth at its thickest, in twine diameters.
    missing: float = 0.0  # Fraction of the bars that are cut out, 0 to 1.
    holes: tuple[Vector, ...] = ()  # Round holes in scene coordinates, in metres.
    # Along x and z in 1/m; positive bulges away from the vehicle.
    curvature: tuple[float, float] = (0.0, 0.0)
    folds: tuple[Fold, ...] = ()  # Folds on top of that; heights add up.
    # Half extent along x and z in metres; infinite by default.
    half_size: tuple[float, float] = (np.inf, np.inf)
    # Slide of the mesh in its plane along x and z, in metres.
    offset: tuple[float, float] = (0.0, 0.0)
    albedo: Vector = (0.60, 0.62, 0.62)  # Diffuse reflectance of the clean twine.
    seed: int = 0  # Seed of missing bars and growth.


@dataclass(frozen=True, slots=True, kw_only=True)
class Swimmer:
    """Body that moves straight on."""

    # In `scene`, in metres and m/s, at time 0.
    position: Vector
    velocity: Vector

    def at(self, t: float) -> Self:
        """Return the body `t` seconds later."""
        x, y, z = (p + v * t for p, v in zip(self.position, self.velocity, strict=True))
        return replace(self, position=(x, y, z))


@dataclass(frozen=True, slots=True, kw_only=True)
class Fish(Swimmer):
    """Fish: an ellipsoid with tail and eye that swims straight on and beats its tail."""

    velocity: Vector = (0.15, 0.0, 0.0)
    length: float = 0.25  # Length of the body in metres; height and thickness follow.
    albedo: Vector = (0.40, 0.43, 0.42)  # Diffuse reflectance of the flank.
    beat: float = 1.5  # Beats of the tail a second.


@dataclass(frozen=True, slots=True, kw_only=True)
class Bubble(Swimmer):
    """Bubble with a bright rim, a clear middle and glints of sun and lasers."""

    velocity: Vector = (0.0, 0.0, 0.2)
    radius: float = 0.004  # In metres.


@dataclass(frozen=True, slots=True, kw_only=True)
class Box:
    """A box, turned about the vertical."""

    centre: Vector  # In `scene`, in metres.
    size: Vector = (0.3, 0.2, 0.3)  # Edge lengths along its x, y, z, in metres.
    heading: float = 0.0  # Turn about z, in radians.
    albedo: Vector = (0.46, 0.42, 0.26)  # Diffuse reflectance.


@dataclass(frozen=True, slots=True, kw_only=True)
class WaterOptics:
    """Optical properties of water: attenuation, veil, scatter, blur."""

    # Beam attenuation per metre for red, green and blue; the lasers use the green one.
    attenuation: Vector = (0.75, 0.30, 0.42)
    # Radiance of endless water, the limit of the veil with distance.
    veil: Vector = (0.072, 0.205, 0.165)
    # Daylight that reaches a surface; a white one has this radiance.
    ambient: Vector = (0.36, 0.62, 0.60)
    # Light that the water scatters from a laser sheet to the camera, per metre and steradian.
    sheet_scatter: float = 0.25
    forward_scatter: float = 0.04  # Fraction of the light that arrives in a halo, out of focus.
    halo_px: float = 9.0  # Standard deviation of that halo, in pixels.
    caustics: float = 0.0  # Relative strength of the moving light network of the waves, 0 to 1.
    glare: float = 0.0  # Radiance of the sun's glare at its brightest.
    snow: int = 0  # Number of drifting particles before the camera.


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSensor:
    """Sensor of the ideal camera: from radiance to grey levels."""

    # Exposure: factor on the radiance before it is clipped at the full scale of 1.
    gain: float = 1.0
    gamma: float = 1.25  # Grey level = 255 * radiance**(1 / gamma).
    read_noise: float = 0.004  # Standard deviation in the dark, of full scale.
    shot_noise: float = 1.5e-4  # Variance of the noise per unit of radiance, of full scale squared.
    defocus_px: float = 0.75  # Standard deviation of the blur of lens and sensor, in pixels.


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneContent:
    """Content of a scene, wherever it is: surfaces, water, sensor."""

    # Surfaces; moving bodies have their velocity.
    walls: tuple[Wall, ...] = ()
    nets: tuple[Net, ...] = ()
    fish: tuple[Fish, ...] = ()
    bubbles: tuple[Bubble, ...] = ()
    boxes: tuple[Box, ...] = ()
    target: Target = "none"  # Content of the plane y = 0, for the truth files.
    water: WaterOptics = field(default_factory=WaterOptics)  # Optical properties of the water.
    # Optical and electronic properties of the camera.
    sensor: CameraSensor = field(default_factory=CameraSensor)
    lasers_on: bool = True  # False switches all lasers off.


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene(SceneContent):
    """Scene in front of the camera at one instant."""

    dome_from_scene: SE3  # Places the scene; see `aqualvs.simulation.scenario.dome_from_target`.

    @property
    def target_kind(self) -> SurfaceKind:
        """Kind of surface that the target is."""
        return SurfaceKind[self.target.upper()]

    def target_plane(self) -> Plane:
        """Return the target plane in `dome`, its normal away from the vehicle."""
        normal = self.dome_from_scene.rotation[:, 1]
        offset = float(normal @ self.dome_from_scene.translation)
        return Plane(normal, offset).facing_origin()


def target_axes(pitch: float, yaw: float) -> FloatArray:
    """Return axes (columns) of a plane whose far normal points right by yaw and up by pitch."""
    normal = np.array([np.tan(yaw), 1.0, np.tan(pitch)])
    return upright_axes(normal / np.linalg.norm(normal))
