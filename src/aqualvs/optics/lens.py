"""The lens: pixels to directions in `cam` and back, with OpenCV's two distortion models."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike

from aqualvs.errors import RigError
from aqualvs.geometry.arrays import BoolArray, FloatArray, as_vectors
from aqualvs.optics import lens_batch
from aqualvs.optics.lens_fisheye import fisheye_limits
from aqualvs.optics.lens_opencv import opencv_limits
from aqualvs.optics.lens_params import LensParams

_OPENCV_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE_NAMES = ("k1", "k2", "k3", "k4")


class LensModel(StrEnum):
    """How a lens bends directions."""

    OPENCV = "opencv"
    """Brown-Conrady and its rational extension, as `cv2.projectPoints`."""
    FISHEYE = "fisheye"
    """Equidistant with an odd polynomial in the angle, as `cv2.fisheye` (Kannala-Brandt)."""


_COEFFICIENTS = {LensModel.OPENCV: (0, 4, 5, 8), LensModel.FISHEYE: (0, 4)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Lens:
    """Intrinsics of a camera, calibrated in air without the dome.

    Attributes
    ----------
    model : LensModel
        Distortion model.
    fx, fy : float
        Focal lengths in pixels.
    cx, cy : float
        Image centre in pixels; the centre of the top-left pixel is (0, 0).
    distortion : tuple of float
        `opencv`: none, or k1 k2 p1 p2 [k3 [k4 k5 k6]]; `fisheye`: none, or k1 k2 k3 k4.

    Raises
    ------
    RigError
        If a value is not finite, a focal length is not positive, or the number of coefficients
        does not fit the model.

    Notes
    -----
    The distortion is believed only where it is monotone. Valid are directions inside the largest
    disc round the image centre in which the Jacobian determinant of the distortion is positive,
    and the pixels they map to: outside, two directions share a pixel.
    """

    model: LensModel = LensModel.OPENCV
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    params: LensParams = field(init=False, repr=False, compare=False)
    """What compiled kernels take."""

    def __post_init__(self) -> None:
        _check(self)
        object.__setattr__(self, "params", _params(self))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the intrinsics, in the order of every intrinsics Jacobian."""
        names = _FISHEYE_NAMES if self.model is LensModel.FISHEYE else _OPENCV_NAMES
        return ("fx", "fy", "cx", "cy", *names[: len(self.distortion)])

    @property
    def max_angle(self) -> float:
        """Angle to the optical axis, in radians, inside which directions are valid."""
        limit = self.params.limit
        return limit if self.model is LensModel.FISHEYE else float(np.arctan(np.sqrt(limit)))

    def directions(self, pixels: ArrayLike) -> tuple[FloatArray, BoolArray]:
        """Return the directions that pixels see.

        Parameters
        ----------
        pixels : array, shape (..., 2)
            In `image`, in pixels.

        Returns
        -------
        directions_in_cam : array, shape (..., 3)
            Unit directions away from the camera; NaN where not valid.
        valid : bool array, shape (...)
            False where no direction inside the monotone region maps to the pixel.

        Notes
        -----
        Newton's method on the exact Jacobian, to machine precision.
        """
        p = as_vectors(pixels, 2, "pixels")
        directions, valid = _empty(p, 3), np.empty(p.shape[:-1], dtype=np.bool_)
        lens_batch.directions_all(
            self.params, p.reshape(-1, 2), directions.reshape(-1, 3), valid.reshape(-1)
        )
        return directions, valid

    def directions_with_jacobian(
        self, pixels: ArrayLike
    ) -> tuple[FloatArray, BoolArray, FloatArray]:
        """Return `directions` and their derivatives by the pixel, shape (..., 3, 2)."""
        p = as_vectors(pixels, 2, "pixels")
        directions, valid = _empty(p, 3), np.empty(p.shape[:-1], dtype=np.bool_)
        jacobian = _empty(p, 3, 2)
        lens_batch.directions_jacobian_all(
            self.params,
            p.reshape(-1, 2),
            directions.reshape(-1, 3),
            valid.reshape(-1),
            jacobian.reshape(-1, 3, 2),
        )
        return directions, valid, jacobian

    def pixels(self, directions_in_cam: ArrayLike) -> tuple[FloatArray, BoolArray]:
        """Return the pixels that directions are seen at.

        Parameters
        ----------
        directions_in_cam : array, shape (..., 3)
            Directions away from the camera, of any length: points in `cam` will do.

        Returns
        -------
        pixels : array, shape (..., 2)
            In `image`, in pixels, possibly outside the picture; NaN where not valid.
        valid : bool array, shape (...)
            False outside the monotone region, and behind the camera for `opencv`.
        """
        d = as_vectors(directions_in_cam, 3, "directions_in_cam")
        pixels, valid = _empty(d, 2), np.empty(d.shape[:-1], dtype=np.bool_)
        lens_batch.pixels_all(
            self.params, d.reshape(-1, 3), pixels.reshape(-1, 2), valid.reshape(-1)
        )
        return pixels, valid

    def pixels_with_jacobian(
        self, directions_in_cam: ArrayLike
    ) -> tuple[FloatArray, BoolArray, FloatArray]:
        """Return `pixels` and their derivatives by the direction as given, shape (..., 2, 3)."""
        d = as_vectors(directions_in_cam, 3, "directions_in_cam")
        pixels, valid = _empty(d, 2), np.empty(d.shape[:-1], dtype=np.bool_)
        jacobian = _empty(d, 2, 3)
        lens_batch.pixels_jacobian_all(
            self.params,
            d.reshape(-1, 3),
            pixels.reshape(-1, 2),
            valid.reshape(-1),
            jacobian.reshape(-1, 2, 3),
        )
        return pixels, valid, jacobian

    def pixels_with_parameter_jacobian(
        self, directions_in_cam: ArrayLike
    ) -> tuple[FloatArray, BoolArray, FloatArray, FloatArray]:
        """Return `pixels_with_jacobian` and the derivatives by the intrinsics.

        Returns
        -------
        pixels, valid, direction_jacobian
            As `pixels_with_jacobian` gives them.
        parameter_jacobian : array, shape (..., 2, P)
            Columns in the order of `parameter_names`; NaN where not valid.
        """
        d = as_vectors(directions_in_cam, 3, "directions_in_cam")
        pixels, valid, jacobian = self.pixels_with_jacobian(d)
        n_parameters = 4 + len(self.distortion)
        by_parameter = _empty(d, 2, n_parameters)
        lens_batch.intrinsics_jacobian_all(
            self.params,
            d.reshape(-1, 3),
            valid.reshape(-1),
            by_parameter.reshape(-1, 2, n_parameters),
        )
        return pixels, valid, jacobian, by_parameter


def _empty(like: FloatArray, *shape: int) -> FloatArray:
    return np.empty((*like.shape[:-1], *shape))


def _check(lens: Lens) -> None:
    values = (lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion)
    if not np.all(np.isfinite(values)):
        raise RigError(f"lens has intrinsics {values}; every one must be a finite number")
    if not (lens.fx > 0.0 and lens.fy > 0.0):
        raise RigError(
            f"lens has focal lengths fx = {lens.fx}, fy = {lens.fy} px; both must be positive"
        )
    allowed = _COEFFICIENTS[LensModel(lens.model)]
    if len(lens.distortion) not in allowed:
        raise RigError(
            f"lens has {len(lens.distortion)} distortion coefficients; the {lens.model} model "
            f"takes {' or '.join(map(str, allowed))}"
        )


def _params(lens: Lens) -> LensParams:
    fisheye = lens.model is LensModel.FISHEYE
    names = _FISHEYE_NAMES if fisheye else _OPENCV_NAMES
    values = dict.fromkeys(_OPENCV_NAMES, 0.0)
    values.update(zip(names, map(float, lens.distortion), strict=False))
    params = LensParams(
        fisheye=fisheye,
        fx=float(lens.fx),
        fy=float(lens.fy),
        cx=float(lens.cx),
        cy=float(lens.cy),
        limit=0.0,
        limit_distorted=0.0,
        **values,
    )
    limit, limit_distorted = fisheye_limits(params) if fisheye else opencv_limits(params)
    return params._replace(limit=limit, limit_distorted=limit_distorted)
