"""Forward through the dome: from a pixel to the ray that it sees in the outer medium."""

from typing import NamedTuple

from aqualvs.geometry.compiled import inline_kernel
from aqualvs.optics.lens_kernels import lens_direction
from aqualvs.optics.lens_params import LensParams, Vector
from aqualvs.optics.refraction import leave_sphere, leave_sphere_tangent


class CameraParams(NamedTuple):
    """A camera as kernels take it; `camera.params` makes it.

    Attributes
    ----------
    lens : LensParams
        Intrinsics.
    has_dome : bool
        False for a bare lens; the fields of the dome then hold harmless values.
    rotation : tuple of 9 float
        `dome_from_cam`, row by row.
    centre : tuple of 3 float
        The lens position L in `dome`, metres.
    inner_radius, outer_radius : float
        Metres.
    n_air, n_acrylic, n_water : float
        Refractive indices, vacuum = 1.
    decentring : float
        |L| in metres.
    axis : tuple of 3 float
        L/|L| in `dome`; any unit vector when L is zero.
    """

    lens: LensParams
    has_dome: bool
    rotation: tuple[float, float, float, float, float, float, float, float, float]
    centre: Vector
    inner_radius: float
    outer_radius: float
    n_air: float
    n_acrylic: float
    n_water: float
    decentring: float
    axis: Vector


@inline_kernel
def dome_from_cam(camera: CameraParams, x: float, y: float, z: float) -> Vector:
    """Rotate a direction from `cam` to `dome`."""
    r = camera.rotation
    return (
        r[0] * x + r[1] * y + r[2] * z,
        r[3] * x + r[4] * y + r[5] * z,
        r[6] * x + r[7] * y + r[8] * z,
    )


@inline_kernel
def cam_from_dome(camera: CameraParams, x: float, y: float, z: float) -> Vector:
    """Rotate a direction from `dome` to `cam`."""
    r = camera.rotation
    return (
        r[0] * x + r[3] * y + r[6] * z,
        r[1] * x + r[4] * y + r[7] * z,
        r[2] * x + r[5] * y + r[8] * z,
    )


@inline_kernel
def trace_direction(
    camera: CameraParams, dx: float, dy: float, dz: float
) -> tuple[bool, float, float, float, float, float, float]:
    """Trace a unit direction in `dome` from the lens through both surfaces of the dome.

    Returns
    -------
    valid, ox, oy, oz, dx, dy, dz
        False under total reflection; origin on the outer surface and unit direction in the outer
        medium, both in `dome`.
    """
    inner, px, py, pz, dx, dy, dz = leave_sphere(
        camera.centre[0],
        camera.centre[1],
        camera.centre[2],
        dx,
        dy,
        dz,
        camera.inner_radius,
        camera.n_air / camera.n_acrylic,
    )
    outer, px, py, pz, dx, dy, dz = leave_sphere(
        px, py, pz, dx, dy, dz, camera.outer_radius, camera.n_acrylic / camera.n_water
    )
    return (inner >= 0.0) & (outer >= 0.0), px, py, pz, dx, dy, dz


@inline_kernel
def trace_pixel(
    camera: CameraParams, u: float, v: float
) -> tuple[bool, float, float, float, float, float, float]:
    """Trace the pixel (u, v) into the outer medium; for use inside other kernels.

    Returns
    -------
    valid, ox, oy, oz, dx, dy, dz
        Origin (metres) and unit direction in `dome`, as `Rays` has them. Where `valid` is False
        the numbers mean nothing.
    """
    seen, cx, cy, cz = lens_direction(camera.lens, u, v)
    dx, dy, dz = dome_from_cam(camera, cx, cy, cz)
    if not camera.has_dome:
        ox, oy, oz = camera.centre
        return seen, ox, oy, oz, dx, dy, dz
    passed, ox, oy, oz, dx, dy, dz = trace_direction(camera, dx, dy, dz)
    return seen and passed, ox, oy, oz, dx, dy, dz


@inline_kernel
def trace_tangent(
    camera: CameraParams,
    direction: Vector,
    direction_dot: Vector,
) -> tuple[Vector, Vector]:
    """Return the derivative of `trace_direction`'s origin and direction along direction_dot."""
    still = (0.0, 0.0, 0.0)
    ratio = camera.n_air / camera.n_acrylic
    c = camera.centre
    d = direction
    _, px, py, pz, ex, ey, ez = leave_sphere(
        c[0], c[1], c[2], d[0], d[1], d[2], camera.inner_radius, ratio
    )
    p_dot, e_dot = leave_sphere_tangent(c, d, still, direction_dot, camera.inner_radius, ratio)
    return leave_sphere_tangent(
        (px, py, pz),
        (ex, ey, ez),
        p_dot,
        e_dot,
        camera.outer_radius,
        camera.n_acrylic / camera.n_water,
    )
