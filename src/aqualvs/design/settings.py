"""Settings of a design in SI units: nominal rig, mounts of the lasers, noise, tolerances and goals.

A `Mount` is the position of a line laser on the vehicle and the sheet of light that leaves it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from aqualvs.errors import RigError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.camera import Camera, parameter_names
from aqualvs.optics.rig import Laser, Rig
from aqualvs.optics.sheet import sheet_in
from aqualvs.scanning.plane_fit import SHARED_ERROR_PX


@dataclass(frozen=True, slots=True, kw_only=True)
class Mount:
    """Mount of a line laser."""

    name: str  # Name in tables.
    position: tuple[float, float, float]  # Origin of the fan, in `dome`, metres.
    # Direction of the stripe on a wall square ahead, in radians: 0 level, pi/2 upright,
    # counter-clockwise as the camera sees it.
    stripe: float
    # Tilt of the sheet towards the forward axis through the dome's centre, in radians; negative is
    # away from it.
    tilt: float
    # Full fan angle, in radians.
    fan: float
    # Rotation of the fan's middle within its sheet, along the stripe's direction, in radians.
    swing: float = 0.0
    # Whether to optimise tilt and stripe.
    free_tilt: bool = True
    free_stripe: bool = False
    # As `Laser.wavelength_nm`.
    wavelength_nm: float | None = None

    @property
    def axes(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Unit vectors in `dome`: along the stripe, across it away from the axis, along the beam.

        If the stripe runs through the axis, the vector across points upwards, or else to the left.
        """
        along = np.array([math.cos(self.stripe), 0.0, math.sin(self.stripe)])
        across = np.array([-along[2], 0.0, along[0]])
        if float(across @ self.position) < 0.0:
            across = -across
        beam = math.cos(self.tilt) * np.array([0.0, 1.0, 0.0]) - math.sin(self.tilt) * across
        return along, across, beam

    @property
    def baseline(self) -> float:
        """Distance of the dome's centre from the stripe's line through the mount, metres."""
        return abs(float(self.axes[1] @ self.position))

    @property
    def plane(self) -> Plane:
        """The sheet in `dome`."""
        along, _, beam = self.axes
        normal = np.array(
            [-along[2] * beam[1], along[2] * beam[0] - along[0] * beam[2], along[0] * beam[1]]
        )
        return Plane(normal, float(normal @ self.position))

    def laser(self) -> Laser:
        """Return the laser for a rig."""
        return Laser(self.name, self.plane, wavelength_nm=self.wavelength_nm)

    def aimed_at(self, wall_range: float) -> "Mount":
        """Return the mount with its fan swung so that its middle is beside the forward axis.

        `wall_range`: range, in metres, at which it is.
        """
        along, _, beam = self.axes
        distance = (wall_range - self.position[1]) / float(beam[1])
        return replace(self, swing=math.atan2(-float(along @ self.position), distance))


def ring(count: int, baseline: float, back: float, fan: float) -> tuple[Mount, ...]:
    """Return mounts evenly spaced around the forward axis, their stripes tangential to the circle.

    The first is below. Two are put below and beside, because opposite ones draw parallel stripes.
    The `baseline` is the distance from the forward axis, `back` that behind the dome's centre, in
    metres; `fan` is the full fan angle in radians.
    """
    step = math.tau / count if count > 2 else math.pi / 2
    mounts = []
    for i in range(count):
        polar = -math.pi / 2 - i * step
        x, z = math.cos(polar), math.sin(polar)
        upright = "lower" if z < -0.4 else "upper" if z > 0.4 else ""
        level = "left" if x < -0.4 else "right" if x > 0.4 else ""
        mounts.append(
            Mount(
                name="_".join(filter(None, (upright, level))) or f"laser_{i + 1}",
                position=(baseline * x, -back, baseline * z),
                stripe=_line_direction(polar + math.pi / 2),
                tilt=0.0,
                fan=fan,
            )
        )
    return tuple(mounts)


def tangential(position: Sequence[float]) -> float:
    """Return the direction of a stripe that is tangential to the circle of a mount, in radians."""
    if math.hypot(position[0], position[2]) == 0.0:
        return 0.0
    return _line_direction(math.atan2(position[2], position[0]) + math.pi / 2)


def mount_of_laser(laser: Laser, rig: Rig, fan: float) -> Mount:
    """Return a mount for a laser of a rig, with defaults for values that its plane does not give.

    Behind a window the plane that fits the laser's light best is used. `fan`: full fan angle,
    radians. Raises `RigError` if the laser's sheet is square to the view, so that it draws no
    stripe.
    """
    sheet = sheet_in(laser, rig.n_air, rig.n_water)
    plane = sheet.best_plane(rig.camera(), rig.working_range)
    normal = plane.normal
    side = np.array([normal[0], 0.0, normal[2]])
    length = float(np.linalg.norm(side))
    # Below this, the sheet is perpendicular to the forward axis.
    min_across = 1e-3
    if length < min_across:
        raise RigError(
            f"laser {laser.name}: its plane is square to the forward axis, so it draws no stripe "
            "on a wall ahead; check its normal"
        )
    side /= length
    if laser.window is None:
        # Without a known source: the plane's point nearest to the forward axis, this far forward of
        # the dome's centre, in metres.
        forward = 0.01
        position = side * (plane.offset - normal[1] * forward) / length
        position[1] = forward
    else:
        source = np.array(sheet.source)
        position = source - float(plane.signed_distance(source)) * normal
    stripe = _line_direction(math.atan2(-side[0], side[2]))
    mount = Mount(
        name=laser.name,
        position=(float(position[0]), float(position[1]), float(position[2])),
        stripe=stripe,
        tilt=0.0,
        fan=fan,
        wavelength_nm=laser.wavelength_nm,
    )
    beam = np.array([0.0, 1.0, 0.0]) - normal[1] * normal
    lean = -float(beam @ mount.axes[1])
    return replace(mount, tilt=math.atan2(lean, float(beam[1])))


def _line_direction(angle: float) -> float:
    """Return the direction of a line between 0 and pi; just below pi, by rounding, is 0."""
    turned = angle % math.pi
    return 0.0 if math.pi - turned < 1e-12 else turned


N_WALLS = 9
"""Number of ranges in the evaluation of a design, evenly spaced in their logarithm."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """Noise of the scanner in one frame: standard deviations in pixels."""

    point: float = 0.3  # Of a point of a stripe on a wall, on its search line.
    strand: float = 0.15  # Of the light on one strand of a net.
    # Of the shift that a whole stripe shares, and of its tilt at the image border.
    shared: float = SHARED_ERROR_PX
    # Width of a stripe on the target, in metres.
    stripe: float = 3e-3
    # Of the shift of the light on twine, as a share of the width of the stripe: one that all
    # strands of a net share, towards the camera or away from it, and another of the same size that
    # those of one laser share. Roundness of the twine causes 0.006, glow in the water the rest.
    twine: float = 0.0146


@dataclass(frozen=True, slots=True, kw_only=True)
class Tolerances:
    """Tolerances: one sigma of the errors after calibration, in metres, radians and shares."""

    lens: float = 0.03e-3  # Of the lens's position, along each axis.
    rotation: float = math.radians(0.01)  # Of the camera's rotation, about each axis.
    focal: float = 1e-4  # Of the focal length, as a share of it.
    dome: float = 0.05e-3  # Of the dome's inner radius and of its thickness.
    n_water: float = 3e-4  # Of the water's index.
    # Of each laser's plane.
    laser_angle: float = math.radians(0.005)
    laser_offset: float = 0.07e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class NominalNet:
    """Nominal net: length of a bar and diameter of its twine, in metres."""

    bar: float
    twine: float

    @property
    def strands_per_metre(self) -> float:
        """Strands that a stripe meets per metre, of two families, averaged over all directions."""
        return 4.0 / math.pi / self.bar

    @property
    def lit_share(self) -> float:
        """Share of a stripe that falls on twine: a square mesh's solidity."""
        share = min(self.twine / self.bar, 1.0)
        return 2.0 * share - share**2


@dataclass(frozen=True, slots=True)
class Goals:
    """Goals: equally bad errors, as a share of the range and as an angle in radians."""

    range_share: float = 0.005
    angle: float = math.radians(0.5)


@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """Design to be evaluated."""

    rig: Rig  # Nominal camera, dome, water and working range. Its lasers are ignored.
    mounts: tuple[Mount, ...]
    centring: float = 1e-3  # Standard deviation of the lens's position before calibration, metres.
    noise: Noise = field(default_factory=Noise)
    tolerances: Tolerances = field(default_factory=Tolerances)
    net: NominalNet = field(default_factory=lambda: NominalNet(bar=15e-3, twine=2.5e-3))
    goals: Goals = field(default_factory=Goals)
    # Whether stripes that cross in the picture count against a design.
    avoid_crossings: bool = True

    @property
    def ranges(self) -> FloatArray:
        """Ranges of the walls for the evaluation, metres, shape (N_WALLS,)."""
        return np.geomspace(*self.rig.working_range, N_WALLS)

    def with_mounts(self, mounts: Sequence[Mount]) -> "Design":
        """Return the design with other mounts."""
        return replace(self, mounts=tuple(mounts))

    def nominal_rig(self) -> Rig:
        """Return the rig with the lasers of the mounts."""
        return replace(self.rig, lasers=tuple(mount.laser() for mount in self.mounts))


def index_step(camera: Camera, tolerances: Tolerances) -> FloatArray:
    """Return a step of one sigma of the water's index, as steps (P, G) of the camera's parameters.

    Of all that stripes share, only the water changes after the calibration of the lasers. G is 1,
    or 0 for a bare lens, which does not depend on the water.
    """
    names = parameter_names(camera)
    if "n_water" not in names:
        return np.zeros((len(names), 0))
    step = np.zeros((len(names), 1))
    step[names.index("n_water")] = tolerances.n_water
    return step
