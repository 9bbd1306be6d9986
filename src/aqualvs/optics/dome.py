"""Refraction by the dome: two concentric spheres with acrylic or glass between them.

`trace_direction` follows a ray from the lens into the outer medium; the way back is that of
`aqualvs.optics.port_projection`.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from aqualvs.errors import RigError
from aqualvs.geometry.compiled import inline_kernel
from aqualvs.geometry.linear_algebra import Vec
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.refraction import as_triple, check_index, leave_sphere

DOME_PARAMETERS = ("inner_radius", "thickness", "n_air", "n_acrylic", "n_water")
"""Parameters of a camera behind a dome, after those of its pose; `inner_radius` moves the outer
sphere along."""


class DomeParams(NamedTuple):
    """A dome as kernels take it; `Dome.params` makes it."""

    centre: Vec  # The lens position L in `dome`, metres.
    # Metres.
    inner_radius: float
    outer_radius: float
    # Refractive indices, vacuum = 1.
    n_air: float
    n_acrylic: float
    n_water: float
    # |L| in metres.
    decentring: float
    # L/|L| in `dome`; any unit vector when L is zero.
    axis: Vec


@inline_kernel
def trace_direction(
    port: DomeParams, dx: float, dy: float, dz: float
) -> tuple[bool, float, float, float, float, float, float]:
    """Trace a unit direction in `dome` from the lens through both surfaces of the dome.

    Returns
    -------
    valid, ox, oy, oz, dx, dy, dz
        False under total reflection; origin on the outer surface and unit direction in the outer
        medium, both in `dome`.
    """
    inner, px, py, pz, dx, dy, dz = leave_sphere(
        port.centre[0],
        port.centre[1],
        port.centre[2],
        dx,
        dy,
        dz,
        port.inner_radius,
        port.n_air / port.n_acrylic,
    )
    outer, px, py, pz, dx, dy, dz = leave_sphere(
        px, py, pz, dx, dy, dz, port.outer_radius, port.n_acrylic / port.n_water
    )
    return (inner >= 0.0) & (outer >= 0.0), px, py, pz, dx, dy, dz


@dataclass(frozen=True, slots=True)
class Dome:
    """A hemispherical port; its centre is the origin of `dome`.

    Raises `RigError` if a value is not finite, the inner radius is not positive, the thickness is
    negative, or the index lies outside 1 to 3.
    """

    inner_radius: float  # In metres.
    thickness: float  # In metres; zero gives an infinitely thin dome.
    n_acrylic: float  # Refractive index of the dome's material, vacuum = 1.

    parameter_names: ClassVar[tuple[str, ...]] = DOME_PARAMETERS

    def __post_init__(self) -> None:
        if not (math.isfinite(self.inner_radius) and self.inner_radius > 0.0):
            raise RigError(
                f"dome has inner radius {self.inner_radius * 1e3:g} mm; it must be positive"
            )
        if not (math.isfinite(self.thickness) and self.thickness >= 0.0):
            raise RigError(
                f"dome has thickness {self.thickness * 1e3:g} mm; it must not be negative"
            )
        check_index("dome", "n_acrylic", self.n_acrylic)

    @property
    def outer_radius(self) -> float:
        """Radius of the outer sphere in metres."""
        return self.inner_radius + self.thickness

    def numbers(self) -> dict[str, float]:
        """Return the sizes and the index by the names of their parameters."""
        return asdict(self)

    def moved_by(self, step: Mapping[str, float]) -> "Dome":
        """Return the dome with steps added to the parameters that are named."""
        return Dome(**{name: value + step.get(name, 0.0) for name, value in self.numbers().items()})

    def params(self, dome_from_cam: SE3, n_air: float, n_water: float) -> DomeParams:
        """Return the dome around a camera as kernels take it.

        Raises `RigError` if the lens lies outside the inner sphere.
        """
        centre = np.asarray(dome_from_cam.translation, dtype=np.float64)
        decentring = float(np.linalg.norm(centre))
        if decentring >= self.inner_radius:
            raise RigError(
                f"lens at {np.round(centre * 1e3, 3).tolist()} mm is {decentring * 1e3:.3f} mm "
                f"from the dome's centre but the inner radius is {self.inner_radius * 1e3:.3f} mm; "
                "move the lens inside or correct the radius"
            )
        axis = centre / decentring if decentring > 0.0 else np.array([0.0, 0.0, 1.0])
        return DomeParams(
            centre=as_triple(centre),
            inner_radius=float(self.inner_radius),
            outer_radius=float(self.outer_radius),
            n_air=float(n_air),
            n_acrylic=float(self.n_acrylic),
            n_water=float(n_water),
            decentring=decentring,
            axis=as_triple(axis),
        )
