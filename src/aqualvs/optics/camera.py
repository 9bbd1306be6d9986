"""The camera: pixels to rays in the outer medium, points to pixels with derivatives.

`parameter_names` gives the order of a camera's numbers in every parameter Jacobian, and
`Camera.params` packs them for kernels. `rays_all` traces pixels, in blocks as
`aqualvs.optics.lens` lays them out, and is compiled for the class of port that it is called with.
A scan projects no points, so the kernels of `aqualvs.optics.projection` are imported when they are
used.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from aqualvs.errors import RigError
from aqualvs.geometry.arrays import BoolArray, FloatArray, as_vectors
from aqualvs.geometry.compiled import dispatch_by_class, inline_kernel, kernel
from aqualvs.geometry.linear_algebra import Vec
from aqualvs.geometry.planes import Rays
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.dome import Dome, DomeParams, trace_direction
from aqualvs.optics.flat_port import FlatParams, FlatPort, trace_flat
from aqualvs.optics.lens import (
    BLOCK,
    DX,
    DY,
    DZ,
    LENS_OK,
    N_LENS_ROWS,
    Lens,
    directions_block,
    load_pixels,
)
from aqualvs.optics.lens_kernels import LensParams
from aqualvs.optics.refraction import as_triple, check_index

POSE_PARAMETERS = ("lens_x", "lens_y", "lens_z", "rotation_x", "rotation_y", "rotation_z")
"""First columns of every parameter Jacobian.

The lens position L in `dome` (metres), and a rotation vector w (radians) in `dome` that is applied
after the camera's rotation: `dome_from_cam.rotation = Rodrigues(w) @ rotation`, taken at w = 0.
"""
Housing = Dome | FlatPort
"""What keeps the water from a camera, and refracts what it sees."""


class BareParams(NamedTuple):
    """A lens in the outer medium itself, as kernels take it."""

    centre: Vec  # The lens position L in `dome`, metres.


@inline_kernel
def _trace_bare(
    port: BareParams, dx: float, dy: float, dz: float
) -> tuple[bool, float, float, float, float, float, float]:
    ox, oy, oz = port.centre
    return True, ox, oy, oz, dx, dy, dz


trace_port = dispatch_by_class(
    {BareParams: _trace_bare, DomeParams: trace_direction, FlatParams: trace_flat}
)
"""`trace_port(port, dx, dy, dz)`: a unit direction at the lens as the ray in the outer medium, see
`trace_direction`."""


class CameraParams(NamedTuple):
    """A camera as kernels take it; `camera.params` makes it."""

    lens: LensParams  # Intrinsics.
    # `dome_from_cam`, row by row.
    rotation: tuple[float, float, float, float, float, float, float, float, float]
    # What stands between the lens and the outer medium, and the lens position.
    port: BareParams | DomeParams | FlatParams


@inline_kernel
def rotate_to_dome(camera: CameraParams, x: float, y: float, z: float) -> Vec:
    """Rotate a direction from `cam` to `dome`."""
    r = camera.rotation
    return (
        r[0] * x + r[1] * y + r[2] * z,
        r[3] * x + r[4] * y + r[5] * z,
        r[6] * x + r[7] * y + r[8] * z,
    )


# Rows of the scratch array after those of the lens: the origin of the ray.
OX, OY, OZ = ((N_LENS_ROWS + i_row) * BLOCK for i_row in range(3))
N_RAY_ROWS = N_LENS_ROWS + 3


@kernel
def rays_all(
    camera: CameraParams,
    pixels: FloatArray,
    origins: FloatArray,
    directions: FloatArray,
    valid: BoolArray,
) -> None:
    """Write rays of pixels (N, 2): origins (N, 3), directions (N, 3), valid (N)."""
    w = np.zeros(N_RAY_ROWS * BLOCK)
    for start in range(0, pixels.shape[0], BLOCK):
        count = min(BLOCK, pixels.shape[0] - start)
        load_pixels(camera.lens, pixels, start, count, w)
        directions_block(camera.lens, count, w)
        for j in range(BLOCK):
            x, y, z = rotate_to_dome(camera, w[DX + j], w[DY + j], w[DZ + j])
            w[DX + j], w[DY + j], w[DZ + j] = x, y, z
        for j in range(BLOCK):
            passed, ox, oy, oz, x, y, z = trace_port(camera.port, w[DX + j], w[DY + j], w[DZ + j])
            w[OX + j], w[OY + j], w[OZ + j] = ox, oy, oz
            w[DX + j], w[DY + j], w[DZ + j] = x, y, z
            w[LENS_OK + j] = w[LENS_OK + j] if passed else -1.0
        for j in range(count):
            ok = w[LENS_OK + j] > 0.0
            valid[start + j] = ok
            origins[start + j, 0] = w[OX + j] if ok else np.nan
            origins[start + j, 1] = w[OY + j] if ok else np.nan
            origins[start + j, 2] = w[OZ + j] if ok else np.nan
            directions[start + j, 0] = w[DX + j] if ok else np.nan
            directions[start + j, 1] = w[DY + j] if ok else np.nan
            directions[start + j, 2] = w[DZ + j] if ok else np.nan


def parameter_names(camera: "Camera") -> tuple[str, ...]:
    """Return the names of a camera's parameters, in the order of every parameter Jacobian.

    `POSE_PARAMETERS`, then `DOME_PARAMETERS` behind a dome or `FLAT_PARAMETERS` behind a flat port,
    then the intrinsics: fx, fy, cx, cy and as many distortion coefficients as the lens has, in
    OpenCV's order.
    """
    port = () if camera.housing is None else camera.housing.parameter_names
    return POSE_PARAMETERS + port + camera.lens.parameter_names


def _checked_pose(pose: SE3) -> tuple[FloatArray, FloatArray]:
    rotation = np.asarray(pose.rotation, dtype=np.float64)
    centre = np.asarray(pose.translation, dtype=np.float64)
    if rotation.shape != (3, 3) or centre.shape != (3,):
        raise RigError(
            f"camera pose has shapes {rotation.shape} and {centre.shape}; give one rotation "
            "(3, 3) and one position (3,)"
        )
    if not np.all(np.isfinite(centre)):
        raise RigError(f"lens position {centre.tolist()} m is not finite; give three numbers")
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not (error < 1e-6 and np.linalg.det(rotation) > 0.0):
        raise RigError(
            f"camera rotation {rotation.tolist()} is not a rotation matrix; give an orthogonal "
            "matrix with determinant 1"
        )
    return rotation, centre


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """A camera behind a dome or a flat port, or a bare lens in the outer medium itself.

    Computed by compiled kernels from the numbers in `params`. Frames: `image` and `dome`.

    Raises `RigError` if the lens lies outside the inner sphere of a dome, an index or the size is
    not valid, or the pose is not one finite rigid transform.
    """

    size_px: tuple[int, int]  # Image width and height.
    lens: Lens  # Intrinsics, calibrated in air without the housing.
    dome_from_cam: SE3  # Camera pose in `dome`; the translation is the lens position L in metres.
    # Sizes and material; a flat port is fixed to the camera. None for a bare lens.
    housing: Housing | None = None
    # Refractive indices (vacuum = 1) inside and outside the housing.
    n_air: float = 1.0
    n_water: float = 1.0
    params: CameraParams = field(init=False, repr=False, compare=False)
    """Packed numbers for compiled kernels."""

    def __post_init__(self) -> None:
        if len(self.size_px) != 2 or not all(side > 0 for side in self.size_px):
            size = self.size_px
            raise RigError(f"camera has size {size} px; width and height must be positive")
        check_index("camera", "n_air", self.n_air)
        check_index("camera", "n_water", self.n_water)
        rotation, centre = _checked_pose(self.dome_from_cam)
        params = CameraParams(
            lens=self.lens.params,
            rotation=(*as_triple(rotation[0]), *as_triple(rotation[1]), *as_triple(rotation[2])),
            port=BareParams(as_triple(centre))
            if self.housing is None
            else self.housing.params(self.dome_from_cam, self.n_air, self.n_water),
        )
        object.__setattr__(self, "params", params)

    def rays(self, pixels: ArrayLike) -> Rays:
        """Trace pixels into the outer medium.

        Parameters
        ----------
        pixels : array, shape (..., 2)
            In `image`, in pixels.

        Returns
        -------
        Rays
            In `dome`, batch shape (...). Origins lie on the outer surface of the housing (metres),
            or at the lens of a bare camera; directions are unit, in the outer medium, away from the
            camera. Not valid, and NaN, where the lens model ends or light is totally reflected.
        """
        p = as_vectors(pixels, 2, "pixels")
        origins, directions = np.empty((*p.shape[:-1], 3)), np.empty((*p.shape[:-1], 3))
        valid = np.empty(p.shape[:-1], dtype=np.bool_)
        rays_all(
            self.params,
            p.reshape(-1, 2),
            origins.reshape(-1, 3),
            directions.reshape(-1, 3),
            valid.reshape(-1),
        )
        return Rays(origins, directions, valid)

    def project(self, points_in_dome: ArrayLike) -> tuple[FloatArray, BoolArray]:
        """Project points of the outer medium.

        Parameters
        ----------
        points_in_dome : array, shape (..., 3)
            In metres.

        Returns
        -------
        pixels : array, shape (..., 2)
            In `image`, possibly outside the picture (see `inside_image`); NaN where not valid.
        valid : bool array, shape (...)
            False for points inside the housing, points that no ray reaches, and directions in which
            the lens model does not hold.
        """
        p = as_vectors(points_in_dome, 3, "points_in_dome")
        pixels = np.empty((*p.shape[:-1], 2))
        valid = np.empty(p.shape[:-1], dtype=np.bool_)
        from aqualvs.optics.projection import project_all

        project_all(self.params, p.reshape(-1, 3), pixels.reshape(-1, 2), valid.reshape(-1))
        return pixels, valid

    def project_with_jacobian(
        self, points_in_dome: ArrayLike
    ) -> tuple[FloatArray, BoolArray, FloatArray]:
        """Project points, with derivatives.

        Returns
        -------
        pixels, valid
            As `project` gives them.
        jacobian : array, shape (..., 2, 3)
            d pixel / d point in pixels per metre; NaN where not valid.
        """
        p = as_vectors(points_in_dome, 3, "points_in_dome")
        return self._project_jacobians(p, np.empty((0, 2, 0)))

    def project_with_parameter_jacobian(
        self, points_in_dome: ArrayLike
    ) -> tuple[FloatArray, BoolArray, FloatArray, FloatArray]:
        """Project points, with derivatives by point and by every parameter of the camera.

        Returns
        -------
        pixels, valid, point_jacobian
            As `project_with_jacobian` gives them.
        parameter_jacobian : array, shape (..., 2, P)
            Columns in the order of `parameter_names(camera)`; NaN where not valid.
        """
        p = as_vectors(points_in_dome, 3, "points_in_dome")
        n_parameters = len(parameter_names(self))
        by_parameter = np.empty((*p.shape[:-1], 2, n_parameters))
        flat = by_parameter.reshape(-1, 2, n_parameters)
        return (*self._project_jacobians(p, flat), by_parameter)

    def _project_jacobians(
        self, points: FloatArray, by_parameter: FloatArray
    ) -> tuple[FloatArray, BoolArray, FloatArray]:
        shape = points.shape[:-1]
        pixels, valid = np.empty((*shape, 2)), np.empty(shape, dtype=np.bool_)
        by_point = np.empty((*shape, 2, 3))
        from aqualvs.optics.projection import project_jacobian_all

        project_jacobian_all(
            self.params,
            points.reshape(-1, 3),
            pixels.reshape(-1, 2),
            valid.reshape(-1),
            by_point.reshape(-1, 2, 3),
            by_parameter,
            len(parameter_names(self)) - len(self.lens.parameter_names),
        )
        return pixels, valid, by_point

    def inside_image(self, pixels: ArrayLike) -> BoolArray:
        """Return which pixels (..., 2) lie in the picture; NaN does not.

        The picture spans (-0.5, -0.5) to (width - 0.5, height - 0.5).
        """
        p = as_vectors(pixels, 2, "pixels") + 0.5
        inside: BoolArray = np.all((p >= 0.0) & (p < np.asarray(self.size_px)), axis=-1)
        return inside
