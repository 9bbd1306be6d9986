"""The camera: pixels to rays in the outer medium, points to pixels, and every derivative.

For kernels of other modules: `trace_pixel(camera.params, u, v)` and
`project_point(camera.params, x, y, z)` are scalar compiled functions to call inside a `@kernel`.
"""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from aqualvs.geometry.arrays import BoolArray, FloatArray, as_vectors
from aqualvs.geometry.rays import Rays
from aqualvs.geometry.transforms import SE3
from aqualvs.optics import project_batch, project_jacobian_batch, rays_batch
from aqualvs.optics.camera_params import (
    DOME_PARAMETERS,
    POSE_PARAMETERS,
    camera_params,
    moved_lens,
    moved_pose,
    named_step,
    parameter_names,
)
from aqualvs.optics.dome import Dome
from aqualvs.optics.dome_forward import CameraParams, trace_pixel
from aqualvs.optics.lens import Lens
from aqualvs.optics.project_batch import project_point

__all__ = [
    "DOME_PARAMETERS",
    "POSE_PARAMETERS",
    "BareCamera",
    "Camera",
    "CameraParams",
    "Dome",
    "DomeCamera",
    "parameter_names",
    "project_point",
    "trace_pixel",
]


class Camera(Protocol):
    """What the rest of the project asks of a camera. Frames: `image` and `dome`."""

    @property
    def size_px(self) -> tuple[int, int]:
        """Image width and height."""

    @property
    def lens(self) -> Lens:
        """Intrinsics."""

    @property
    def dome_from_cam(self) -> SE3:
        """Pose; the translation is the lens position L."""

    @property
    def params(self) -> CameraParams:
        """What compiled kernels take."""

    def rays(self, pixels: ArrayLike) -> Rays:
        """Return the rays in `dome` that pixels (..., 2) see."""

    def rays_into(
        self,
        pixels: FloatArray,
        out_origins: FloatArray,
        out_directions: FloatArray,
        out_valid: BoolArray,
    ) -> None:
        """Write the rays of pixels (N, 2) into (N, 3), (N, 3) and (N) without allocation."""

    def rays_with_jacobian(self, pixels: ArrayLike) -> tuple[Rays, FloatArray, FloatArray]:
        """Return the rays and the derivatives (..., 3, 2) of origins and directions."""

    def project(self, points_in_dome: ArrayLike) -> tuple[FloatArray, BoolArray]:
        """Return pixels (..., 2) of points (..., 3) and whether they can be seen."""

    def project_into(
        self, points_in_dome: FloatArray, out_pixels: FloatArray, out_valid: BoolArray
    ) -> None:
        """Write the pixels of points (N, 3) into (N, 2) and (N) without allocation."""

    def project_with_jacobian(
        self, points_in_dome: ArrayLike
    ) -> tuple[FloatArray, BoolArray, FloatArray]:
        """Return `project` and the derivatives (..., 2, 3) by the point."""

    def project_with_parameter_jacobian(
        self, points_in_dome: ArrayLike
    ) -> tuple[FloatArray, BoolArray, FloatArray, FloatArray]:
        """Return `project_with_jacobian` and the derivatives (..., 2, P) by the parameters."""

    def inside_image(self, pixels: ArrayLike) -> BoolArray:
        """Return which pixels (..., 2) lie in the picture, edges of border pixels included."""

    def moved_by(self, step: ArrayLike) -> "Camera":
        """Return the camera with `step` (P,) added to its parameters, see `parameter_names`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _CompiledCamera:
    """A camera whose arithmetic is all in compiled kernels, told by `params`.

    Attributes
    ----------
    size_px : (int, int)
        Image width and height.
    lens : Lens
        Intrinsics, calibrated in air without the dome.
    dome_from_cam : SE3
        Camera pose in `dome`; the translation is the lens position L in metres.
    """

    size_px: tuple[int, int]
    lens: Lens
    dome_from_cam: SE3
    params: CameraParams = field(init=False, repr=False, compare=False)
    """What compiled kernels take."""

    def rays(self, pixels: ArrayLike) -> Rays:
        """Trace pixels into the outer medium.

        Parameters
        ----------
        pixels : array, shape (..., 2)
            In `image`, in pixels.

        Returns
        -------
        Rays
            In `dome`, batch shape (...). Origins lie on the outer surface of the dome (metres), or
            at the lens of a bare camera; directions are unit, in the outer medium, away from the
            camera. Not valid, and NaN, where the lens model ends or light is totally reflected.
        """
        p = as_vectors(pixels, 2, "pixels")
        origins, directions = np.empty((*p.shape[:-1], 3)), np.empty((*p.shape[:-1], 3))
        valid = np.empty(p.shape[:-1], dtype=np.bool_)
        rays_batch.rays_all(
            self.params,
            p.reshape(-1, 2),
            origins.reshape(-1, 3),
            directions.reshape(-1, 3),
            valid.reshape(-1),
        )
        return Rays(origins, directions, valid)

    def rays_into(
        self,
        pixels: FloatArray,
        out_origins: FloatArray,
        out_directions: FloatArray,
        out_valid: BoolArray,
    ) -> None:
        """Write the rays of pixels (N, 2) into arrays of shape (N, 3), (N, 3) and (N).

        All float64 (bool for `out_valid`) and C-contiguous; nothing is allocated.
        """
        rays_batch.rays_all(self.params, pixels, out_origins, out_directions, out_valid)

    def rays_with_jacobian(self, pixels: ArrayLike) -> tuple[Rays, FloatArray, FloatArray]:
        """Trace pixels into the outer medium, with derivatives.

        Returns
        -------
        rays : Rays
            As `rays` gives them.
        origin_jacobian, direction_jacobian : array, shape (..., 3, 2)
            d origin / d pixel (metres per pixel) and d direction / d pixel; NaN where not valid.
        """
        p = as_vectors(pixels, 2, "pixels")
        rays = self.rays(p)
        by_origin, by_direction = np.empty((*p.shape[:-1], 3, 2)), np.empty((*p.shape[:-1], 3, 2))
        rays_batch.rays_jacobian_all(
            self.params,
            p.reshape(-1, 2),
            rays.valid.reshape(-1),
            by_origin.reshape(-1, 3, 2),
            by_direction.reshape(-1, 3, 2),
        )
        return rays, by_origin, by_direction

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
            False for points inside the dome, points that no ray reaches, and directions in which
            the lens model does not hold.
        """
        p = as_vectors(points_in_dome, 3, "points_in_dome")
        pixels = np.empty((*p.shape[:-1], 2))
        valid = np.empty(p.shape[:-1], dtype=np.bool_)
        self.project_into(p.reshape(-1, 3), pixels.reshape(-1, 2), valid.reshape(-1))
        return pixels, valid

    def project_into(
        self, points_in_dome: FloatArray, out_pixels: FloatArray, out_valid: BoolArray
    ) -> None:
        """Write the pixels of points (N, 3) into arrays of shape (N, 2) and (N).

        All float64 (bool for `out_valid`) and C-contiguous; nothing is allocated.
        """
        project_batch.project_all(self.params, points_in_dome, out_pixels, out_valid)

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
        project_jacobian_batch.project_jacobian_all(
            self.params,
            points.reshape(-1, 3),
            pixels.reshape(-1, 2),
            valid.reshape(-1),
            by_point.reshape(-1, 2, 3),
            by_parameter,
        )
        return pixels, valid, by_point

    def inside_image(self, pixels: ArrayLike) -> BoolArray:
        """Return which pixels (..., 2) lie in the picture; NaN does not.

        The picture spans (-0.5, -0.5) to (width - 0.5, height - 0.5).
        """
        p = as_vectors(pixels, 2, "pixels") + 0.5
        inside: BoolArray = np.all((p >= 0.0) & (p < np.asarray(self.size_px)), axis=-1)
        return inside


@dataclass(frozen=True, slots=True, kw_only=True)
class BareCamera(_CompiledCamera):
    """A camera without a dome: the lens itself in the outer medium.

    Attributes
    ----------
    size_px : (int, int)
        Image width and height.
    lens : Lens
        Intrinsics.
    dome_from_cam : SE3
        Camera pose in `dome`; the translation is the lens position L in metres.

    Raises
    ------
    RigError
        If the size is not positive or the pose is not one finite rigid transform.
    """

    def __post_init__(self) -> None:
        params = camera_params(
            size_px=self.size_px,
            lens=self.lens,
            dome_from_cam=self.dome_from_cam,
            dome=None,
            n_air=1.0,
            n_water=1.0,
        )
        object.__setattr__(self, "params", params)

    def moved_by(self, step: ArrayLike) -> "BareCamera":
        """Return the camera with `step` (P,) added to its parameters, see `parameter_names`."""
        values = named_step(self, step)
        return BareCamera(
            size_px=self.size_px,
            lens=moved_lens(self.lens, values),
            dome_from_cam=moved_pose(self.dome_from_cam, values),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class DomeCamera(_CompiledCamera):
    """A camera behind a dome.

    Attributes
    ----------
    size_px : (int, int)
        Image width and height.
    lens : Lens
        Intrinsics, calibrated in air without the dome.
    dome_from_cam : SE3
        Camera pose in `dome`; the translation is the lens position L in metres.
    dome : Dome
        Radii and material.
    n_air, n_water : float
        Refractive indices (vacuum = 1) inside and outside the dome.

    Raises
    ------
    RigError
        If the lens lies outside the inner sphere, an index or the size cannot be, or the pose is
        not one finite rigid transform.
    """

    dome: Dome
    n_air: float
    n_water: float

    def __post_init__(self) -> None:
        params = camera_params(
            size_px=self.size_px,
            lens=self.lens,
            dome_from_cam=self.dome_from_cam,
            dome=self.dome,
            n_air=self.n_air,
            n_water=self.n_water,
        )
        object.__setattr__(self, "params", params)

    def moved_by(self, step: ArrayLike) -> "DomeCamera":
        """Return the camera with `step` (P,) added to its parameters, see `parameter_names`."""
        values = named_step(self, step)
        return DomeCamera(
            size_px=self.size_px,
            lens=moved_lens(self.lens, values),
            dome_from_cam=moved_pose(self.dome_from_cam, values),
            dome=Dome(
                self.dome.inner_radius + values["inner_radius"],
                self.dome.thickness + values["thickness"],
                self.dome.n_acrylic + values["n_acrylic"],
            ),
            n_air=self.n_air + values["n_air"],
            n_water=self.n_water + values["n_water"],
        )
