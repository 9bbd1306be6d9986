"""The rig: one camera, its housing, the water and the lasers, in SI units.

`RigUncertainty` is the joint covariance of a rig's numbers; `rig_moved_by` adds a small step to
them. Planes of lasers are perturbed by rotations towards `tangent_basis` and by their offset.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.compiled import python_of
from aqualvs.geometry.linear_algebra import cross
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.camera import POSE_PARAMETERS, Camera, Housing
from aqualvs.optics.dome import DOME_PARAMETERS, Dome
from aqualvs.optics.flat_port import FLAT_PARAMETERS, FlatPort
from aqualvs.optics.lens import Lens
from aqualvs.optics.shutter import AT_ONCE, Shutter

DOME_FROM_CAM_NOMINAL: FloatArray = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation of a camera mounted without error; columns are x, y and z of `cam` in `dome`.

The camera looks along the dome's y axis: x_cam -> +x, y_cam -> -z, z_cam -> +y.
"""
DOME_FROM_CAM_NOMINAL.flags.writeable = False


@dataclass(frozen=True, slots=True)
class Window:
    """A flat window that a laser's light leaves its housing by."""

    # The outer face in `dome`; the normal may point either way. The pane counts as thin; a thick
    # one shifts the light as a source would that is nearer to the outer face by a third of the pane
    # (glass of index 1.5), to 0.12 mm for 6 mm tilted by 25 degrees.
    face: Plane
    # Shape (3,): point in `dome` that the light fans out from, in metres. It is projected onto the
    # laser's plane.
    source: FloatArray


@dataclass(frozen=True, slots=True)
class Laser:
    """A line laser, a thin sheet of light."""

    name: str  # Name in reports.
    # The sheet in `dome`: in the water, or, behind a window, in the air of the laser's housing.
    plane: Plane
    # Window that bends the sheet, see `aqualvs.optics.sheet`. None where the sheet in the water is
    # the plane.
    window: Window | None = None
    # Of the light, in nanometres; None if not stated: green, 520 to 532.
    wavelength_nm: float | None = None


def common_wavelength(lasers: Sequence[Laser]) -> float | None:
    """Return the common wavelength of lasers (nm); None if they differ or it is unknown."""
    found = {laser.wavelength_nm for laser in lasers}
    return found.pop() if len(found) == 1 else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Rig:
    """Camera, housing, water and lasers: the data needed to turn a stripe pixel into a point.

    Attributes
    ----------
    name : str
        Name in reports.
    size_px : (int, int)
        Image width and height.
    lens : Lens
        Intrinsics, calibrated in air without the housing.
    dome_from_cam : SE3
        Camera pose in `dome`; the translation is the lens position L.
    housing : Dome, FlatPort or None
        None for a bare lens in the outer medium.
    n_air, n_water : float
        Refractive indices (vacuum = 1) inside and outside the housing.
    lasers : tuple of Laser
        In the order in which `points.parquet` numbers them.
    working_range : (float, float)
        Nearest and farthest target range at which stripes are accepted, in metres.
    solved_from : mapping
        Records of calibrations (`aqualvs.optics.solved`); kept and written back, not interpreted
        here.
    shutter : Shutter
        When each row of a picture is exposed.
    """

    name: str
    size_px: tuple[int, int]
    lens: Lens
    dome_from_cam: SE3
    housing: Housing | None
    n_air: float
    n_water: float
    lasers: tuple[Laser, ...]
    working_range: tuple[float, float]
    solved_from: Mapping[str, Any] = field(default_factory=dict)
    shutter: Shutter = AT_ONCE

    def camera(self) -> Camera:
        """Return the camera as it looks into the outer medium."""
        return Camera(
            size_px=self.size_px,
            lens=self.lens,
            dome_from_cam=self.dome_from_cam,
            housing=self.housing,
            n_air=self.n_air,
            n_water=self.n_water,
        )

    def bare_camera(self) -> Camera:
        """Return the same camera without the housing, which ignores refraction."""
        return Camera(size_px=self.size_px, lens=self.lens, dome_from_cam=self.dome_from_cam)

    @property
    def dome(self) -> Dome | None:
        """The housing if it is a dome."""
        return self.housing if isinstance(self.housing, Dome) else None

    @property
    def flat_port(self) -> FlatPort | None:
        """The housing if it is a flat port."""
        return self.housing if isinstance(self.housing, FlatPort) else None

    @property
    def focal_px(self) -> float:
        """Pixels per radian near the image centre, in air: a scale for lengths in the image."""
        return max(self.lens.fx, self.lens.fy)

    def in_water(self, n_water: float) -> "Rig":
        """Return the same rig in a medium of another index."""
        return replace(self, n_water=n_water)

    def is_air(self, index: float) -> bool:
        """Return whether a medium of this refractive index is the air inside the housing."""
        tolerance = 1e-3
        return abs(index - self.n_air) < tolerance


LASER_PARAMETERS = ("tilt_1", "tilt_2", "offset")
"""Small changes of a laser plane: rotations of its normal towards `tangent_basis` (radians), and
of its offset (metres)."""
LASER_WINDOW_PARAMETERS = (
    "window_tilt_1",
    "window_tilt_2",
    "window_offset",
    "source_1",
    "source_2",
)
"""The same changes of a laser's window, and shifts (metres) of the source along the `tangent_basis`
of the laser plane's normal."""


@dataclass(frozen=True, slots=True)
class RigUncertainty:
    """Joint covariance of some of a rig's numbers."""

    # As `parameter_names(camera)` has them, and `<laser's name>:tilt_1`, `:tilt_2`, `:offset` for
    # lasers, see `laser_parameter_names`. Numbers that are not named are taken as exact.
    names: tuple[str, ...]
    # Shape (P, P): SI units and radians.
    covariance: FloatArray

    def __post_init__(self) -> None:
        n = len(self.names)
        if len(set(self.names)) != n:
            raise ValueError(f"names repeat in {self.names}")
        if self.covariance.shape != (n, n):
            raise ValueError(f"{self.covariance.shape=} but expected {(n, n)}")

    @classmethod
    def none(cls) -> "RigUncertainty":
        """Return the uncertainty of a rig whose numbers are all exact."""
        return cls((), np.zeros((0, 0)))

    @classmethod
    def independent(cls, sigmas: Mapping[str, float]) -> "RigUncertainty":
        """Return the uncertainty of independent numbers, such as tolerances."""
        return cls(tuple(sigmas), np.diag(np.array([*sigmas.values()], np.float64) ** 2))

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviation of every number, SI units and radians."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def of(self, names: Sequence[str]) -> FloatArray:
        """Return the covariance (Q, Q) of the named numbers; zero for those not known here."""
        covariance = np.zeros((len(names), len(names)))
        known = [(i, self.names.index(name)) for i, name in enumerate(names) if name in self.names]
        if known:
            here, there = map(list, zip(*known, strict=True))
            covariance[np.ix_(here, here)] = self.covariance[np.ix_(there, there)]
        return covariance

    def only(self, names: Sequence[str]) -> "RigUncertainty":
        """Return the uncertainty of those of the named numbers that are known here."""
        kept = tuple(name for name in self.names if name in names)
        return RigUncertainty(kept, self.of(kept))

    def renamed(self, lasers: Mapping[str, str]) -> "RigUncertainty":
        """Return the uncertainty with new names, by old ones, of some lasers."""
        parts = [name.rpartition(":") for name in self.names]
        names = tuple(f"{lasers.get(owner, owner)}{colon}{what}" for owner, colon, what in parts)
        return RigUncertainty(names, self.covariance)


def merged(old: RigUncertainty, new: RigUncertainty) -> RigUncertainty:
    """Return the uncertainty of a rig after a calibration has solved some of its numbers anew.

    The numbers of `new` replace those of `old`; the others keep their covariance with each other.
    The covariance between the two groups is zero: the new numbers come from new pictures, and any
    others that they were solved from must be in `new.names`. A solve that depends on numbers known
    before (laser planes on the dome, say) therefore has to return the joint covariance of both;
    otherwise its results would look independent of the inputs whose errors they carry.
    """
    kept = old.only([name for name in old.names if name not in new.names])
    return combined(new, kept)


def combined(one: RigUncertainty, other: RigUncertainty) -> RigUncertainty:
    """Return the fusion of two independent uncertainties, such as a prior and a tolerance.

    Numbers that only one source knows are taken over with their covariance; numbers that both know
    become more certain, and so do those correlated with them. The names of `one` come first.
    """
    shared = [name for name in one.names if name in other.names]
    n = len(one.names)
    both = np.zeros((n + len(other.names),) * 2)
    both[:n, :n], both[n:, n:] = one.covariance, other.covariance
    # Both mean the same number: their difference is measured to be zero (a Kalman update).
    difference = np.zeros((len(shared), len(both)))
    for row, name in enumerate(shared):
        difference[row, one.names.index(name)] = 1.0
        difference[row, n + other.names.index(name)] = -1.0
    reach = both @ difference.T
    variance = difference @ reach
    size = np.sqrt(np.diag(variance))
    size[size == 0.0] = 1.0
    reach /= size
    both -= reach @ np.linalg.pinv(variance / np.outer(size, size), hermitian=True) @ reach.T
    own = [i for i, name in enumerate(other.names) if name not in shared]
    rows = [*range(n), *(n + i for i in own)]
    names = one.names + tuple(other.names[i] for i in own)
    return RigUncertainty(names, both[np.ix_(rows, rows)])


# `np.cross` takes ten times as long for one vector.
_cross = python_of(cross)


def tangent_basis(normal: FloatArray) -> FloatArray:
    """Return two unit vectors (2, 3) at right angles to a unit normal (3,) and to each other.

    The first is normal x the axis of the normal's smallest component, the second normal x the
    first: a fixed choice, so that covariances in it can be stored.
    """
    across = normal.tolist()
    axis = [0.0, 0.0, 0.0]
    axis[min(range(3), key=lambda i: abs(across[i]))] = 1.0
    first = np.array(_cross(across, axis))
    first /= np.linalg.norm(first)
    return np.array([first, _cross(across, first.tolist())])


def moved_plane(plane: Plane, tilt_1: float, tilt_2: float, offset: float) -> Plane:
    """Return the plane with its normal turned towards `tangent_basis` and its offset changed."""
    normal = plane.normal + np.array([tilt_1, tilt_2]) @ tangent_basis(plane.normal)
    return Plane(normal / np.linalg.norm(normal), plane.offset + offset)


def laser_parameter_names(laser: Laser) -> tuple[str, ...]:
    """Return the names of a laser's numbers in a `RigUncertainty`, its window's last."""
    window = () if laser.window is None else LASER_WINDOW_PARAMETERS
    return tuple(f"{laser.name}:{name}" for name in LASER_PARAMETERS + window)


def rig_parameter_names(rig: Rig) -> tuple[str, ...]:
    """Return the names of all numbers of a rig that a `RigUncertainty` may hold.

    A bare lens has those of a dome: the same rig may be used without it.
    """
    lasers = (name for laser in rig.lasers for name in laser_parameter_names(laser))
    port = DOME_PARAMETERS if rig.flat_port is None else FLAT_PARAMETERS
    return (*POSE_PARAMETERS, *port, *rig.lens.parameter_names, *lasers)


def rig_moved_by(rig: Rig, names: Sequence[str], step: FloatArray) -> Rig:
    """Return the rig with `step` (P,) added to the named numbers.

    Raises `RigError` if the moved rig is not valid.
    """
    values = dict(zip(names, np.asarray(step, np.float64).tolist(), strict=True))
    *shift, wx, wy, wz = (values.get(name, 0.0) for name in POSE_PARAMETERS)
    rotation = rotation_from_rotvec([wx, wy, wz]) @ rig.dome_from_cam.rotation
    return replace(
        rig,
        dome_from_cam=SE3(rotation, rig.dome_from_cam.translation + np.array(shift)),
        lens=rig.lens.moved_by(values),
        housing=None if rig.housing is None else rig.housing.moved_by(values),
        n_air=rig.n_air + values.get("n_air", 0.0),
        n_water=rig.n_water + values.get("n_water", 0.0),
        lasers=tuple(_moved_laser(laser, values) for laser in rig.lasers),
    )


def _moved_laser(laser: Laser, values: dict[str, float]) -> Laser:
    step = [values.get(name, 0.0) for name in laser_parameter_names(laser)]
    if not any(step):
        return laser
    window = laser.window
    if window is not None:
        shift = np.array(step[6:]) @ tangent_basis(laser.plane.normal)
        window = Window(moved_plane(window.face, *step[3:6]), window.source + shift)
    return replace(laser, plane=moved_plane(laser.plane, *step[:3]), window=window)
