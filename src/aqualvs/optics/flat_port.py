"""Refraction by a flat port: two parallel planes with glass or acrylic between them.

The port belongs to the camera: it stands at a distance along its normal in front of the lens, and a
step of the camera's pose carries it along. `trace_flat` follows a ray from the lens into the outer
medium; the way back is that of `aqualvs.optics.port_projection`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from aqualvs.errors import RigError
from aqualvs.geometry.compiled import inline_kernel
from aqualvs.geometry.linear_algebra import Vec
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.refraction import as_triple, check_index, leave_plane

FLAT_PARAMETERS = (
    "port_distance",
    "thickness",
    "n_air",
    "n_port",
    "n_water",
    "port_tilt_x",
    "port_tilt_y",
)
"""Parameters of a camera behind a flat port, after those of its pose."""

MAX_TILT = math.radians(45.0)
"""Of a port's normal about each axis; beyond, most of a picture sees the housing's wall."""


class FlatParams(NamedTuple):
    """A flat port as kernels take it; `FlatPort.params` makes it."""

    centre: Vec  # The lens position L in `dome`, metres.
    # The port's normal away from the camera, and the axes about which its tilts turn it; unit
    # vectors in `dome`.
    normal: Vec
    turn_x: Vec
    turn_y: Vec
    # Metres.
    distance: float
    thickness: float
    # Refractive indices, vacuum = 1.
    n_air: float
    n_port: float
    n_water: float


@inline_kernel
def trace_flat(
    port: FlatParams, dx: float, dy: float, dz: float
) -> tuple[bool, float, float, float, float, float, float]:
    """Trace a unit direction in `dome` from the lens through both faces of the port.

    Returns
    -------
    valid, ox, oy, oz, dx, dy, dz
        False under total reflection, and where the direction does not meet the port; origin on the
        outer face and unit direction in the outer medium, both in `dome`.
    """
    inner, p, d = leave_plane(
        port.centre, (dx, dy, dz), port.normal, port.distance, port.n_air / port.n_port
    )
    outer, p, d = leave_plane(p, d, port.normal, port.thickness, port.n_port / port.n_water)
    return (inner > 0.0) & (outer > 0.0), p[0], p[1], p[2], d[0], d[1], d[2]


@dataclass(frozen=True, slots=True)
class FlatPort:
    """A flat window in front of the camera, fixed to it.

    Raises `RigError` if a value is not finite, the distance is not positive, the thickness is
    negative, the index lies outside 1 to 3, or a tilt exceeds 45 degrees.
    """

    # From the lens's projection centre to the inner face, along the normal, in metres.
    distance: float
    # In metres; zero gives an infinitely thin port.
    thickness: float
    # Refractive index of the port's material, vacuum = 1: acrylic 1.49, glass 1.46 to 1.52.
    n_port: float
    # Of the port's normal from the optical axis, in radians: turned about the camera's y axis by
    # `tilt_y`, then about its x axis by `tilt_x`.
    tilt_x: float = 0.0
    tilt_y: float = 0.0

    parameter_names: ClassVar[tuple[str, ...]] = FLAT_PARAMETERS

    def __post_init__(self) -> None:
        if not (math.isfinite(self.distance) and self.distance > 0.0):
            raise RigError(
                f"flat port is {self.distance * 1e3:g} mm from the lens; it must be in front of it"
            )
        if not (math.isfinite(self.thickness) and self.thickness >= 0.0):
            raise RigError(
                f"flat port has thickness {self.thickness * 1e3:g} mm; it must not be negative"
            )
        check_index("flat port", "n_port", self.n_port)
        for tilt in (self.tilt_x, self.tilt_y):
            if not abs(tilt) <= MAX_TILT:
                raise RigError(
                    f"flat port is tilted by {math.degrees(tilt):g} degrees; its normal lies "
                    f"within {math.degrees(MAX_TILT):g} degrees of the optical axis"
                )

    def numbers(self) -> dict[str, float]:
        """Return sizes, index and tilts by the names of their parameters."""
        return {
            "port_distance": self.distance,
            "thickness": self.thickness,
            "n_port": self.n_port,
            "port_tilt_x": self.tilt_x,
            "port_tilt_y": self.tilt_y,
        }

    def moved_by(self, step: Mapping[str, float]) -> "FlatPort":
        """Return the port with steps added to the parameters that are named."""
        return FlatPort(*(value + step.get(name, 0.0) for name, value in self.numbers().items()))

    @property
    def normal_in_cam(self) -> Vec:
        """Unit normal in `cam`, away from the camera."""
        across = math.cos(self.tilt_y)
        return (
            math.sin(self.tilt_y),
            -math.sin(self.tilt_x) * across,
            math.cos(self.tilt_x) * across,
        )

    def params(self, dome_from_cam: SE3, n_air: float, n_water: float) -> FlatParams:
        """Return the port in front of a camera as kernels take it."""
        sin_x, cos_x = math.sin(self.tilt_x), math.cos(self.tilt_x)
        rotation = np.asarray(dome_from_cam.rotation, dtype=np.float64)
        return FlatParams(
            centre=as_triple(dome_from_cam.translation),
            normal=as_triple(rotation @ np.array(self.normal_in_cam)),
            turn_x=as_triple(rotation[:, 0]),
            turn_y=as_triple(rotation @ np.array([0.0, cos_x, sin_x])),
            distance=float(self.distance),
            thickness=float(self.thickness),
            n_air=float(n_air),
            n_port=float(self.n_port),
            n_water=float(n_water),
        )
