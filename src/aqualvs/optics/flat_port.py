"""Refraction by a flat port: two parallel planes with glass or acrylic between them.

The port belongs to the camera: it stands at a distance D along its normal m in front of the lens,
and a step of the camera's pose carries it along. Every ray lies in a plane that contains m through
the lens (Agrawal et al., A theory of multi-layer flat refractive geometry, CVPR 2012), and
n sin(incidence) is constant along it. With t the tangent of the ray's angle alpha to m at the lens
and k = n_air / n for each medium, the light that meets a point at the height h above the outer face
passes the distance from the axis

    rho(t) = D t + T g + h w,    g, w = k t / sqrt(1 + (1 - k^2) t^2) with k of the port, the water.

For k < 1 all terms grow and bend downwards; Halley's steps for rho(t) = rho of the point converge
from the straight line of the paraxial image, within three steps up to 60 degrees.

The derivatives of the projection follow from the implicit function theorem. With e the unit vector
from the axis to the point, p the point seen from the lens, u the unit vector along which the
direction d turns as alpha grows, and m' = m x e, the derivative of d is

    by the point        u (e - w m)^T alpha_rho + (sin alpha / rho) m' m'^T
    by D, T, an index   -u rho_x alpha_rho
    by a turn of m      that of turning point and direction, less that of the point

where alpha_rho = cos^2 alpha / rho'(t), and t / rho is rho's own factor of t: nothing is divided by
the distance from the axis.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from aqualvs.errors import RigError
from aqualvs.geometry.compiled import inline_kernel, inner_kernel
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.lens_kernels import Vector
from aqualvs.optics.refraction import as_triple, check_index, leave_plane, leave_plane_tangent

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

# Points this much (relative) inside the outer face are still on it: rounding, not geometry.
_SURFACE_SLACK = 1e-9
_TINY = 1e-300


class FlatParams(NamedTuple):
    """A flat port as kernels take it; `FlatPort.params` makes it.

    Attributes
    ----------
    centre : tuple of 3 float
        The lens position L in `dome`, metres.
    normal, turn_x, turn_y : tuple of 3 float
        The port's normal away from the camera, and the axes about which its tilts turn it; unit
        vectors in `dome`.
    distance, thickness : float
        Metres.
    n_air, n_port, n_water : float
        Refractive indices, vacuum = 1.
    """

    centre: Vector
    normal: Vector
    turn_x: Vector
    turn_y: Vector
    distance: float
    thickness: float
    n_air: float
    n_port: float
    n_water: float

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return FLAT_PARAMETERS


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


@inline_kernel
def trace_flat_tangent(
    port: FlatParams, direction: Vector, direction_dot: Vector
) -> tuple[Vector, Vector]:
    """Return the derivative of `trace_flat`'s origin and direction along direction_dot."""
    still = (0.0, 0.0, 0.0)
    ratio = port.n_air / port.n_port
    _, _, d = leave_plane(port.centre, direction, port.normal, port.distance, ratio)
    p_dot, d_dot = leave_plane_tangent(
        direction, still, direction_dot, port.normal, port.distance, ratio
    )
    return leave_plane_tangent(
        d, p_dot, d_dot, port.normal, port.thickness, port.n_port / port.n_water
    )


@inline_kernel
def height_and_reach(port: FlatParams, x: float, y: float, z: float) -> tuple[float, float, Vector]:
    """Return (h, rho, e) of a point: its height above the outer face, and where it is beside m.

    e is a unit vector, or zero for a point exactly on the axis.
    """
    m = port.normal
    x, y, z = x - port.centre[0], y - port.centre[1], z - port.centre[2]
    along = x * m[0] + y * m[1] + z * m[2]
    ex, ey, ez = x - along * m[0], y - along * m[1], z - along * m[2]
    rho = math.sqrt(ex * ex + ey * ey + ez * ez)
    scale = 1.0 / max(rho, _TINY)
    return along - port.distance - port.thickness, rho, (ex * scale, ey * scale, ez * scale)


@inline_kernel
def is_in_front(port: FlatParams, height: float) -> bool:
    """Return whether a point at this height above the outer face lies in the outer medium."""
    return height >= -_SURFACE_SLACK * (port.distance + port.thickness)


@inline_kernel
def layer(k: float, t: float) -> tuple[float, float]:
    """Return (1 + (1 - k^2) t^2, its inverse square root); tiny under total reflection."""
    square = max(1.0 + (1.0 - k * k) * t * t, 1e-30)
    return square, 1.0 / math.sqrt(square)


@inline_kernel
def tangent_start(port: FlatParams, height: float, rho: float) -> float:
    """Return t of the straight line from the lens's image to the point, exact near the axis.

    Or, far from the axis, the least t with which the air alone can bridge what glass and water
    cannot: the larger of two lower bounds.
    """
    glass, water = port.n_air / port.n_port, port.n_air / port.n_water
    start = rho / (port.distance + port.thickness * glass + height * water)
    rest = rho - port.thickness * _widest(glass) - height * _widest(water)
    return max(start, rest / port.distance)


@inline_kernel
def _widest(k: float) -> float:
    """Return the tangent of the critical angle, 1e30 where there is none."""
    return k / math.sqrt(max(1.0 - k * k, 1e-60))


@inline_kernel
def three_tangent_steps(
    port: FlatParams, height: float, rho: float, t: float
) -> tuple[float, bool]:
    """Return (t, solved) after three of Halley's steps towards rho(t) = rho, without branches."""
    t, _ = tangent_step(port, height, rho, t)
    t, _ = tangent_step(port, height, rho, t)
    return tangent_step(port, height, rho, t)


@inline_kernel
def tangent_step(port: FlatParams, height: float, rho: float, t: float) -> tuple[float, bool]:
    """Return t after one of Halley's steps, and whether that step was the last needed."""
    glass, water = port.n_air / port.n_port, port.n_air / port.n_water
    square_g, inverse_g = layer(glass, t)
    square_w, inverse_w = layer(water, t)
    g, w = port.thickness * glass * inverse_g, height * water * inverse_w
    g_slope, w_slope = g * inverse_g * inverse_g, w * inverse_w * inverse_w
    off = t * (port.distance + g + w) - rho
    slope = port.distance + g_slope + w_slope
    curve = (1.0 - glass * glass) * g_slope * inverse_g * inverse_g
    curve += (1.0 - water * water) * w_slope * inverse_w * inverse_w
    # Halley: off / (slope - off * second derivative / (2 slope)), that derivative -3 t curve.
    step = off * slope / (slope * slope + 1.5 * t * curve * off)
    t -= step
    # Halley's next error is about the cube of its step.
    step_solved = 1e-6
    solved = abs(step) < step_solved * (1.0 + t * t)
    return t, solved & (t >= 0.0) & (min(square_g, square_w) > 1e-20)


@inner_kernel
def tangent_guarded(port: FlatParams, height: float, rho: float) -> tuple[bool, float]:
    """Solve rho(t) = rho by bisection over alpha; return (found, t). Slow, but safe."""
    low, high = 0.0, math.asin(min(1.0, min(port.n_port, port.n_water) / port.n_air))
    glass, water = port.n_air / port.n_port, port.n_air / port.n_water
    for _ in range(60):
        middle = 0.5 * (low + high)
        t = math.tan(middle)
        g, w = layer(glass, t)[1], layer(water, t)[1]
        if t * (port.distance + port.thickness * glass * g + height * water * w) <= rho:
            low = middle
        else:
            high = middle
    t = math.tan(low)
    return math.isfinite(rho) & math.isfinite(t), t


class FlatDerivative(NamedTuple):
    """Terms of the derivatives of a solved projection behind a flat port.

    Attributes
    ----------
    turn : vector
        u of the module's docstring.
    by_reach : float
        d alpha / d rho, 1/m.
    across_point : float
        sin alpha / rho, 1/m.
    water_tangent : float
        w, the tangent of the angle in the water.
    by_distance, by_thickness, by_n_air, by_n_port, by_n_water : float
        d alpha by the parameters.
    """

    turn: Vector
    by_reach: float
    across_point: float
    water_tangent: float
    by_distance: float
    by_thickness: float
    by_n_air: float
    by_n_port: float
    by_n_water: float


@inline_kernel
def flat_derivative(
    port: FlatParams, height: float, e: Vector, solution: tuple[float, float]
) -> FlatDerivative:
    """Return the derivatives at a solution (cos alpha, sin alpha), without branches."""
    c, s = solution
    t = s / c
    glass, water = port.n_air / port.n_port, port.n_air / port.n_water
    _, inverse_g = layer(glass, t)
    _, inverse_w = layer(water, t)
    cube_g, cube_w = inverse_g * inverse_g * inverse_g, inverse_w * inverse_w * inverse_w
    slope = port.distance + port.thickness * glass * cube_g + height * water * cube_w
    factor = port.distance + port.thickness * glass * inverse_g + height * water * inverse_w
    by_reach = c * c / slope
    g, w = glass * t * inverse_g, water * t * inverse_w
    # rho by k of the port and of the water: 1 + t^2 is 1 / c^2, which by_reach undoes.
    by_k = t / slope
    by_glass, by_water = by_k * port.thickness * cube_g, by_k * height * cube_w
    m = port.normal
    return FlatDerivative(
        turn=(c * e[0] - s * m[0], c * e[1] - s * m[1], c * e[2] - s * m[2]),
        by_reach=by_reach,
        across_point=c / factor,
        water_tangent=w,
        by_distance=-by_reach * (t - w),
        by_thickness=-by_reach * (g - w),
        by_n_air=-(by_glass / port.n_port + by_water / port.n_water),
        by_n_port=by_glass * glass / port.n_port,
        by_n_water=by_water * water / port.n_water,
    )


@dataclass(frozen=True, slots=True)
class FlatPort:
    """A flat window in front of the camera, fixed to it.

    Attributes
    ----------
    distance : float
        From the lens's projection centre to the inner face, along the normal, in metres.
    thickness : float
        In metres; zero gives an infinitely thin port.
    n_port : float
        Refractive index of the port's material, vacuum = 1: acrylic 1.49, glass 1.46 to 1.52.
    tilt_x, tilt_y : float
        Of the port's normal from the optical axis, in radians: turned about the camera's y axis by
        `tilt_y`, then about its x axis by `tilt_x`.

    Raises
    ------
    RigError
        If a value is not finite, the distance is not positive, the thickness is negative, the index
        lies outside 1 to 3, or a tilt exceeds 45 degrees.
    """

    distance: float
    thickness: float
    n_port: float
    tilt_x: float = 0.0
    tilt_y: float = 0.0

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
    def normal_in_cam(self) -> Vector:
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
