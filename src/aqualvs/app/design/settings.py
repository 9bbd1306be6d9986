"""A design in SI units: the nominal rig, the lasers' mounts, and what may be off."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from aqualvs.app.design.mount import Mount
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.camera import Camera
from aqualvs.optics.camera_params import parameter_names
from aqualvs.optics.rig import Rig
from aqualvs.scanning.plane_fit import MESH_ERROR, SOLID_ERROR, SharedError

N_WALLS = 9
"""Ranges at which a design is judged, evenly spaced in their logarithm."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """Standard deviations of what the scanner finds in one frame, in pixels.

    Attributes
    ----------
    point : float
        Of a point of a stripe on a wall, on its search line.
    strand : float
        Of the light on one strand of a net.
    wall, net : SharedError
        Of what a whole stripe shares.
    """

    point: float = 0.3
    strand: float = 0.15
    wall: SharedError = SOLID_ERROR
    net: SharedError = MESH_ERROR


@dataclass(frozen=True, slots=True, kw_only=True)
class Tolerances:
    """One sigma of what calibration leaves open, in metres, radians and shares.

    Attributes
    ----------
    lens : float
        Of the lens's place, along each axis.
    rotation : float
        Of the camera's rotation, about each axis.
    focal : float
        Of the focal length, as a share of it.
    dome : float
        Of the dome's inner radius and of its thickness.
    n_water : float
        Of the water's index.
    laser_angle, laser_offset : float
        Of each laser's plane.
    """

    lens: float = 0.03e-3
    rotation: float = math.radians(0.01)
    focal: float = 1e-4
    dome: float = 0.05e-3
    n_water: float = 3e-4
    laser_angle: float = math.radians(0.005)
    laser_offset: float = 0.07e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class NetFacts:
    """A net as its maker describes it: length of a bar and diameter of its twine, in metres."""

    bar: float
    twine: float

    @property
    def strands_per_metre(self) -> float:
        """How often a stripe meets a strand: of two families, the mean over all directions."""
        return 4.0 / math.pi / self.bar

    @property
    def lit_share(self) -> float:
        """Share of a stripe that falls on twine: a square mesh's solidity."""
        share = min(self.twine / self.bar, 1.0)
        return 2.0 * share - share**2


@dataclass(frozen=True, slots=True)
class Goals:
    """Errors that count as equally bad: a share of the range, and an angle in radians."""

    range_share: float = 0.005
    angle: float = math.radians(0.5)


@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """What is to be judged.

    Attributes
    ----------
    rig : Rig
        Nominal camera, dome, water and working range. Its lasers do not count.
    mounts : tuple of Mount
    centring : float
        How far the lens may be off its place before a calibration, metres.
    noise : Noise
    tolerances : Tolerances
    net : NetFacts
    goals : Goals
    avoid_crossings : bool
        Whether stripes that cross in the picture count against a design.
    """

    rig: Rig
    mounts: tuple[Mount, ...]
    centring: float = 1e-3
    noise: Noise = field(default_factory=Noise)
    tolerances: Tolerances = field(default_factory=Tolerances)
    net: NetFacts = field(default_factory=lambda: NetFacts(bar=15e-3, twine=2.5e-3))
    goals: Goals = field(default_factory=Goals)
    avoid_crossings: bool = True

    @property
    def ranges(self) -> FloatArray:
        """Walls at which the design is judged, metres, shape (N_WALLS,)."""
        return np.geomspace(*self.rig.working_range, N_WALLS)

    def with_mounts(self, mounts: Sequence[Mount]) -> "Design":
        """Return the design with other mounts."""
        return replace(self, mounts=tuple(mounts))

    def nominal_rig(self) -> Rig:
        """Return the rig with the lasers of the mounts."""
        return replace(self.rig, lasers=tuple(mount.laser() for mount in self.mounts))


def index_step(camera: Camera, tolerances: Tolerances) -> FloatArray:
    """Return a step of one sigma of the water's index, in the camera's parameters (P, G).

    Of all that stripes share only the water changes after the lasers have been calibrated. G is 1,
    or 0 for a bare lens, to which the water does not matter.
    """
    names = parameter_names(camera)
    if "n_water" not in names:
        return np.zeros((len(names), 0))
    step = np.zeros((len(names), 1))
    step[names.index("n_water")] = tolerances.n_water
    return step
